"""Whether a folder that was written with disturbances is the same as one that was written without."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

import carlasc
from carlasc.errors import CarlascError
from faults.commands import MESSAGES, TEMPORARY

RECORDS = ".carlasc"  # folder
STORES = (".zarr", ".h5", ".parquet")
Content = dict[str, bytes | None]
"""Every path below a folder, and the bytes of each file; None for a folder or a link."""


def content_of(folder: Path) -> Content:
    """Return what is in a folder, without the messages of commands, and without the file by which
    Python tries the folder for temporary files. Records of inputs are listed without their bytes,
    which have the times of files.
    """
    found: Content = {}
    for path in sorted(folder.rglob("*")):
        # a kill may leave the record of a copy, which is removed after the copy got its name
        if not (path.name == MESSAGES or _is_trial(path) or path.match("copied-*-of-*.json")):
            is_file = path.is_file() and not path.is_symlink() and not is_record(path)
            found[path.relative_to(folder).as_posix()] = path.read_bytes() if is_file else None
    return found


def is_record(path: Path) -> bool:
    """Whether a file is a record of inputs."""
    return path.suffix == ".json" and (
        path.parent.name == RECORDS or path.match("carlasc-*-of-*.json")
    )


def _is_trial(path: Path) -> bool:
    """Whether `tempfile` made a file to see whether it can; a process that is killed at that moment
    leaves these four bytes.
    """
    return (
        path.parent.name == TEMPORARY and path.is_file() and b"blat".startswith(path.read_bytes())
    )


def differences(expected: Content, found: Content) -> list[str]:
    """Describe how a folder differs: one line per file that is missing, too many, or has other
    bytes.
    """
    missing = [f"{name} is missing" for name in expected if name not in found]
    left = [f"{name} is left over" for name in found if name not in expected]
    return missing + left + changed(expected, found)


def changed(expected: Content, found: Content) -> list[str]:
    """Describe the files that have other bytes than they should."""
    return [
        f"{name} has other bytes: {_size(found[name])} instead of {_size(content)}"
        for name, content in expected.items()
        if name in found and found[name] != content
    ]


def arrays_of(store: Path) -> dict[str, str]:
    """Return a digest of every array that can be read from a store, by sequence, field and frame.

    Raises:
        CarlascError: it cannot be opened, or an array cannot be read.
    """
    return {
        f"{path}/{field}/{frame}": hashlib.sha256(
            np.ascontiguousarray(sequence.read(field, frame)).tobytes()
        ).hexdigest()
        for path, sequence in carlasc.open(store).sequences().items()
        for field in sequence.fields()
        for frame in sequence.frames(field).tolist()
    }


def wrong_arrays(store: Path, expected: dict[str, str]) -> list[str]:
    """Describe the arrays of a store that are not those of the finished one.

    A store that is not finished may refuse to be opened.
    """
    try:
        source = carlasc.open(store)
        source.sequences()
    except CarlascError:
        return []
    try:
        found = arrays_of(store)
    except CarlascError as error:
        return [f"the store opens, but {error}"]
    return [
        f"{name} is another array" for name, digest in found.items() if expected.get(name) != digest
    ]


def _size(content: bytes | None) -> str:
    return "no file" if content is None else str(len(content))
