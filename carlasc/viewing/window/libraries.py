"""Open3D, or exactly what is missing for it."""

from __future__ import annotations

import importlib
import re
import shutil
from types import ModuleType

from carlasc.errors import DependencyError, import_extra

_DEBIAN = {  # library that the loader names -> Debian's (and Ubuntu's) package
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libGLX.so.0": "libglx0",
    "libX11.so.6": "libx11-6",
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libidn2.so.0": "libidn2-0",
    "libgomp.so.1": "libgomp1",
    "libstdc++.so.6": "libstdc++6",
    "libz.so.1": "zlib1g",
}


def import_open3d() -> ModuleType:
    """Import Open3D.

    Raises:
        DependencyError: it is not installed, or a library of the system is missing; says what to install.
    """
    try:
        return importlib.import_module("open3d")
    except ImportError as error:
        missing = missing_library(str(error))
        if missing is None:
            return import_extra("open3d", "view")  # says that it is not installed, or the loader's own words
        raise DependencyError(f"open3d does not load: {missing} is missing: {advice(missing)}") from error
    except OSError as error:
        missing = missing_library(str(error))
        what = str(error) if missing is None else f"{missing} is missing"
        raise DependencyError(f"open3d does not load: {what}: {advice(missing)}") from error


def missing_library(message: str) -> str | None:
    """Return the shared library that a loader's message says is not there, None where it says something else."""
    match = re.search(r"(\S+\.so[.0-9]*): cannot open shared object file", message)
    return match[1] if match else None


def advice(library: str | None) -> str:
    """Return what to install for a library."""
    package = _DEBIAN.get(library or "")
    if package is None:
        return "install what it names, or open a page instead with --html"
    root = "sudo " if shutil.which("sudo") else ""
    return f"{root}apt-get install {package} (Debian, Ubuntu), or open a page instead with --html"
