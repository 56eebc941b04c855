import subprocess
import sys

import pytest

from carlasc.errors import (
    ArgumentError,
    CarlascError,
    ConflictError,
    DependencyError,
    FormatError,
    MissingDataError,
    import_extra,
)


def test_every_kind_is_a_carlasc_error():
    for kind in (FormatError, MissingDataError, DependencyError, ArgumentError, ConflictError):
        assert issubclass(kind, CarlascError)
    assert issubclass(ArgumentError, ValueError)


def test_a_missing_extra_is_one_line_that_says_what_to_install():
    with pytest.raises(
        DependencyError, match=r"no_such_module is not installed: .*pip install 'carlasc\[zarr\]'"
    ) as caught:
        import_extra("no_such_module.part", "zarr")
    assert "\n" not in str(caught.value)


def test_a_module_that_fails_to_load_says_why(tmp_path, monkeypatch):
    (tmp_path / "broken_module.py").write_text("import libfoo_that_is_not_there\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(DependencyError, match="broken_module does not load .*libfoo_that_is_not_there"):
        import_extra("broken_module", "view")


def test_importing_carlasc_loads_numpy_and_nothing_heavier():
    code = (
        "import sys, carlasc; heavy = {'numba', 'torch', 'typer', 'rich', 'zarr', 'h5py', 'pyarrow', 'trimesh', 'open3d', 'fsspec'};"
        "print(sorted(heavy & set(sys.modules)), 'numpy' in sys.modules or True)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.startswith("[]")


def test_every_public_name_resolves():
    import carlasc

    for name in carlasc.__all__:
        assert getattr(carlasc, name) is not None
    with pytest.raises(AttributeError, match="no_such_name"):
        carlasc.no_such_name  # noqa: B018
