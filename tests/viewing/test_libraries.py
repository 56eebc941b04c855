import sys

import pytest

from carlasc.errors import DependencyError
from carlasc.viewing import libraries
from carlasc.viewing.libraries import import_open3d, missing_library


@pytest.mark.parametrize(
    ("message", "package"),
    [
        ("libEGL.so.1: cannot open shared object file: No such file or directory", "libegl1"),
        ("libGL.so.1: cannot open shared object file: No such file or directory", "libgl1"),
        ("libX11.so.6: cannot open shared object file: No such file or directory", "libx11-6"),
        ("libudev.so.1: cannot open shared object file: No such file or directory", "libudev1"),
        ("libusb-1.0.so.0: cannot open shared object file: No such file or directory", "libusb-1.0-0"),
        ("libidn2.so.0: cannot open shared object file: No such file or directory", "libidn2-0"),
        ("libgomp.so.1: cannot open shared object file: No such file or directory", "libgomp1"),
    ],
)
@pytest.mark.parametrize("kind", [ImportError, OSError])
def test_the_package_of_a_missing_library_is_named(monkeypatch, message, package, kind):
    def fail(_):
        raise kind(message)

    monkeypatch.setattr(libraries.importlib, "import_module", fail)
    with pytest.raises(DependencyError) as error:
        import_open3d()
    said = str(error.value)
    assert f"apt-get install {package} " in said and message.split(":")[0] in said and '`out="page.html"`' in said
    assert "\n" not in said


def test_an_unknown_library_is_named():
    assert missing_library("libstrange.so.3: cannot open shared object file: No such file") == "libstrange.so.3"
    assert "page.html" in libraries.advice("libstrange.so.3")
    assert missing_library("undefined symbol: foo") is None


def test_without_open3d_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(DependencyError, match=r"carlasc\[view\]"):
        import_open3d()
