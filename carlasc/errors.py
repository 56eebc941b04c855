"""The few kinds of error a user can meet, and the check for optional packages.

Every message is one line: the file (or argument) it is about, what was expected, what was found, what to do.
"""

from __future__ import annotations

import importlib
from types import ModuleType


class CarlascError(Exception):
    """Base of every error that `carlasc` raises on purpose."""


class FormatError(CarlascError):
    """A file or store does not hold what the format says it must."""


class MissingDataError(CarlascError):
    """Something that was asked for is not there: a file, a frame, a field, a sequence."""


class DependencyError(CarlascError):
    """An optional package is not installed, or cannot be loaded."""


class ArgumentError(CarlascError, ValueError):
    """A value given by the caller makes no sense (the command line exits with 2 for these)."""


class ConflictError(CarlascError):
    """Writing would destroy or mix with something that is already there."""


class StorageError(CarlascError):
    """The output cannot be written: a full disk, a folder that is not ours. Whatever comes next would meet the same."""


def import_extra(module: str, extra: str) -> ModuleType:
    """Import an optional module, or say in one line which extra to install.

    Args:
        module: dotted name of the module.
        extra: the extra of `carlasc` that brings it.

    Returns:
        The imported module.

    Raises:
        DependencyError: the module is not installed or fails to load.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        reason = "is not installed" if error.name == package else f"does not load ({error})"
        raise DependencyError(f"{package} {reason}: install it with `pip install 'carlasc[{extra}]'`") from error
