"""Opening a path or a URL as a Source. The kind of store is determined from its content."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.storage.folders.folder import FolderSource
from carlasc.storage.folders.published import PublishedSource
from carlasc.storage.folders.trees import LocalTree, RemoteTree, Tree
from carlasc.storage.folders.zipped import ZipTree
from carlasc.storage.packed.output import TABLES_MARK, UNFINISHED_MARK
from carlasc.storage.packed.protocol import Options, PackedSink
from carlasc.storage.protocol import Source

_ZIP, _EMPTY_ZIP, _HDF5, _PARQUET = b"PK\x03\x04", b"PK\x05\x06", b"\x89HDF\r\n\x1a\n", b"PAR1"
_SIGNATURE = 8  # number of leading bytes that identify the kind of file


def open(path: str | os.PathLike[str], **storage_options: Any) -> Source:
    """Open a store of sequences. Its kind is determined from its content, not from the ending of its name.

    Args:
        path: a folder of the published layout (the data set, a split, a sequence, one `<coordinates>` folder), a zip of such a folder (read
            in place), a packed store (zarr, HDF5, Parquet), or the URL of any of these (http, s3, and all other protocols of fsspec).
        **storage_options: options of fsspec for the URL, such as `anon=True` or `endpoint_url=...`.

    Returns:
        The source. It holds no open handles and can be pickled.

    Raises:
        MissingDataError: nothing exists at the path.
        FormatError: the content is none of these, or is damaged.
        DependencyError: a package is missing; the message names the extra of carlasc that installs it.
    """
    text = os.fspath(path)
    if "://" in text and not text.startswith("file://"):
        return _open_remote(RemoteTree(text, storage_options))
    local = Path(text.removeprefix("file://"))
    if local.is_dir():
        return _open_store(LocalTree(local)) or FolderSource(local)
    if local.is_file():
        return _open_file(LocalTree(local.parent), local.name)
    if (unfinished := local.with_name(f"{local.name}.part")).exists():
        raise MissingDataError(
            local,
            expected="a finished store",
            found=f"{unfinished.name}",
            advice="run the same command again to finish it",
        )
    raise MissingDataError(
        local, expected="a folder, a zip or a packed store", found="nothing", advice="check the path"
    )


def as_source(source: str | os.PathLike[str] | Source) -> Source:
    """Return a Source unchanged; open anything else with `open`."""
    return source if isinstance(source, Source) else open(source)


def open_sink(path: Path, options: Options, overwrite: bool) -> PackedSink:
    """Start a packed store. The ending of its name gives its kind: `.zarr`, `.h5` or `.hdf5`, `.parquet`.

    Raises:
        ArgumentError: another ending, or an option that the store does not have.
        ConflictError: the path already exists, and `overwrite` is not given.
        DependencyError: a package is missing.
    """
    if path.suffix == ".zarr":
        from carlasc.storage.packed.arrays.zarr_store import ZarrSink

        return ZarrSink(path, options, overwrite)
    if path.suffix in (".h5", ".hdf5"):
        from carlasc.storage.packed.arrays.hdf5_store import HDF5Sink

        return HDF5Sink(path, options, overwrite)
    if path.suffix == ".parquet":
        from carlasc.storage.packed.tables.writing import ParquetSink

        return ParquetSink(path, options, overwrite)
    raise ArgumentError(
        path, expected="a store ending in .zarr, .h5 or .parquet", found=f"{path.suffix or 'no ending'}"
    )


def _open_remote(tree: RemoteTree) -> Source:
    if tree.size() is not None:
        tree.check_ranges()
        return _open_file(tree, "")
    source = _open_store(tree)
    if source is None and not tree.entries():
        raise MissingDataError(
            tree.location,
            expected="a folder, a zip or a packed store",
            found="nothing (or a folder that cannot be listed)",
        )
    return source or PublishedSource(tree)


def _open_store(tree: Tree) -> Source | None:
    """Open a packed store that is a folder; return None if the folder is not a packed store."""
    if tree.is_file("zarr.json"):
        from carlasc.storage.packed.arrays.zarr_store import ZarrSource

        return ZarrSource(tree)
    if tree.is_file(UNFINISHED_MARK):
        raise FormatError(
            tree.location,
            expected="a finished store",
            found="one whose packing was cut off",
            advice="run the same command again",
        )
    if tree.is_file(TABLES_MARK):
        from carlasc.storage.packed.tables.reading import ParquetSource

        return ParquetSource(tree)
    return None


def _open_file(tree: Tree, name: str) -> Source:
    where = tree.where(name)
    try:
        signature = bytes(tree.read_range(name, 0, _SIGNATURE))
    except FormatError as error:
        raise FormatError(
            where, expected="a zip or a packed store", found="a file of a few bytes", advice="the file may be cut short"
        ) from error
    if signature.startswith((_ZIP, _EMPTY_ZIP)):
        inside = ZipTree(tree, name)
        return _open_store(inside) or PublishedSource(inside)
    if signature.startswith(_HDF5):
        from carlasc.storage.packed.arrays.hdf5_store import HDF5Source

        return HDF5Source(tree, name)
    if signature.startswith(_PARQUET):
        raise FormatError(
            where, expected="a packed store", found="one of its files", advice="give the folder that it is in"
        )
    raise FormatError(where, expected="a folder, a zip, or a packed store", found="a file that is none of these")
