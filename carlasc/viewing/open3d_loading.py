"""Loading Open3D, which needs libraries of the system: the error says which one is missing, and what to install."""

from __future__ import annotations

import importlib
import re
import shutil
from types import ModuleType

from carlasc.errors import DependencyError, import_extra

PAGE_ADVICE = 'or write a page instead with `out="page.html"`'

_DEBIAN = {  # shared library -> its package in Debian and Ubuntu
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
        DependencyError: Open3D is not installed, or a system library is missing; the advice says what to install.
    """
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        missing = missing_library(str(error))
        if missing is None and isinstance(error, ImportError):
            return import_extra("open3d", "view")  # says that it is not installed, or what the loader said
        problem = str(error) if missing is None else f"{missing} is missing"
        raise DependencyError("open3d", problem=f"cannot be loaded: {problem}", advice=advice(missing)) from error


def missing_library(message: str) -> str | None:
    """Return the shared library that is missing according to a loader's message, or None."""
    match = re.search(r"(\S+\.so[.0-9]*): cannot open shared object file", message)
    return match[1] if match else None


def advice(library: str | None) -> str:
    """Return what to install for a library, or what to do if its package is not known."""
    package = _DEBIAN.get(library or "")
    if package is None:
        return f"install the library that the message names, {PAGE_ADVICE}"
    root = "sudo " if shutil.which("sudo") else ""
    return f"{root}apt-get install {package} (Debian, Ubuntu), {PAGE_ADVICE}"
