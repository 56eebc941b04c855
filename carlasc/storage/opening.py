"""Opening a path or a URL as a Source. The kind of store is determined from its content."""

from __future__ import annotations

import os
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from carlasc.errors import ArgumentError, FormatError, MissingDataError, check_types
from carlasc.running.spreading import Part
from carlasc.storage.files import AnyPath, damaged, unfinished
from carlasc.storage.folder import FolderSink, FolderSource
from carlasc.storage.packed.output import TABLES_MARK, UNFINISHED_MARK, unfinished_error
from carlasc.storage.packed.stores import PackedSink, PackOptions
from carlasc.storage.protocol import Sink, Source
from carlasc.storage.published import PublishedSource
from carlasc.storage.transport.caching import Cache, CachedTree
from carlasc.storage.transport.clients import HUB
from carlasc.storage.transport.remote_tree import RemoteTree, target_of
from carlasc.storage.transport.trees import LocalTree, Target, Tree, is_url
from carlasc.storage.transport.zipped import ZipTree
from carlasc.storage.voxel_files import find_voxels

PACKED = (".zarr", ".h5", ".hdf5", ".parquet")
"""Suffixes of packed stores."""
VOXEL_SUFFIXES = (".npz", ".npy", ".label")  # of files that may be voxel grids of other programs

if TYPE_CHECKING:
    from carlasc.storage.zarr.zarr_sink import ZarrSink

_ZIP = b"PK\x03\x04"
_EMPTY_ZIP = b"PK\x05\x06"
_HDF5 = b"\x89HDF\r\n\x1a\n"
_PARQUET = b"PAR1"
_SIGNATURE = 8  # number of leading bytes that identify the kind of file


def open(
    path: AnyPath,
    *,
    cache: AnyPath | Cache | None = None,
    **storage_options: Any,
) -> Source:
    """Open a store of sequences. Its kind is determined from its content, not from its suffix.

    Args:
        path: a folder of the published layout (the data set, a split, a sequence, one
            `<coordinates>` folder), a zip of such a folder (read in place), a packed store (zarr,
            HDF5, Parquet), or the URL of any of these (http, s3, and all other protocols of
            fsspec).
        cache: a local folder, or a `carlasc.Cache`, for the files of a packed zarr store or a
            folder at a URL. Each file is fetched once for all processes. It is not used for local
            stores. None: no cache.
        **storage_options: options of fsspec for the URL, such as `anon=True` or `endpoint_url=...`.

    Returns:
        The source. It holds no open handles and can be pickled.

    Raises:
        MissingDataError: nothing exists at the path.
        ArgumentError: `cache` is given for a remote store that is a single file, or for tables.
        FormatError: the content is none of these, or is damaged.
        DependencyError: a package is missing; the message names the extra of carlasc that installs
            it.
    """
    check_types(open, locals())
    text = os.fspath(path)
    if is_url(text):
        return _open_remote(RemoteTree(text, storage_options), cache)
    local = Path(text.removeprefix("file://"))
    if _is_unfinished(local):
        raise unfinished_error(local)
    if local.is_dir():
        return _open_store(LocalTree(local)) or FolderSource(local)
    if local.suffix in VOXEL_SUFFIXES and (found := find_voxels(local)) is not None:
        return found
    if local.is_file():
        return _open_file(LocalTree(local.parent), local.name)
    raise MissingDataError(
        local,
        expected="a folder, a zip or a packed store",
        found="nothing",
        advice="check the path",
    )


def _is_unfinished(path: Path) -> bool:
    """Whether a path is an unfinished store: its final path, or that of its .part file."""
    if not path.exists():
        return bool(path.name) and unfinished(path).exists()
    return path.suffix == unfinished(Path("x")).suffix and path.with_suffix("").suffix in PACKED


def as_source(source: AnyPath | Source) -> Source:
    """Return a Source unchanged; open anything else with `open`."""
    return source if isinstance(source, Source) else open(source)


def open_sink(
    path: AnyPath | Target,
    options: PackOptions | None,
    overwrite: bool,
    **storage_options: Any,
) -> PackedSink | ZarrSink:
    """Start a packed store.

    The suffix determines its kind: `.zarr`, `.h5` or `.hdf5`, `.parquet`. None as `options` takes
    the defaults.

    Raises:
        ArgumentError: the suffix is another one, the store lacks an option, or `path` is a URL and
            the store can be written locally only.
        ConflictError: the path already exists, and `overwrite` is not given.
        DependencyError: a package is missing.
    """
    kind = PurePosixPath(path.location if isinstance(path, Target) else path).suffix
    if kind not in PACKED:
        raise ArgumentError(
            path, expected="a store ending in .zarr, .h5 or .parquet", found=kind or "no suffix"
        )
    if kind == ".zarr":
        from carlasc.storage.zarr.zarr_sink import ZarrSink

        return ZarrSink(target_of(path, **storage_options), options, overwrite)
    if isinstance(path, Target) or is_url(path):
        raise ArgumentError(
            "out",
            expected="a .zarr store, or a folder, in an object store",
            found=f"a {kind} store, which is one growing file",
            advice="write it to a file and upload it",
        )
    if kind == ".parquet":
        from carlasc.storage.parquet.parquet_sink import ParquetSink

        return ParquetSink(path, options, overwrite)
    from carlasc.storage.hdf5.hdf5_sink import HDF5Sink

    return HDF5Sink(path, options, overwrite)


def as_sink(
    out: AnyPath | Target | Sink,
    *,
    overwrite: bool = False,
    part: Part = Part(),  # noqa: B008 (frozen)
    **storage_options: Any,
) -> Sink:
    """Return a Sink unchanged; otherwise start a store at a path or a URL.

    Args:
        out: a folder of the published layout, or a packed store, whose name ends in .zarr, .h5,
            .hdf5 or .parquet; a path or a URL.
        overwrite: replace an existing packed store.
        part: the part of the run that writes to the store.
        **storage_options: options of fsspec for a URL.

    Raises:
        ArgumentError: the place cannot be written to, or not by several parts.
        ConflictError: a packed store exists at `out`, and `overwrite` is not given.
        DependencyError: a package is missing.
    """
    if isinstance(out, Sink):
        return out
    suffix = PurePosixPath(out.location if isinstance(out, Target) else out).suffix
    if part.count > 1 and suffix in PACKED[1:]:
        raise ArgumentError(
            "part", expected="a folder or a .zarr store as output of several parts", found=out
        )
    if suffix in PACKED:
        return open_sink(out, None, overwrite, **storage_options)
    return FolderSink(out, **storage_options)


def _open_remote(tree: RemoteTree, cache: AnyPath | Cache | None) -> Source:
    is_file = tree.size() is not None
    if cache is not None and (is_file or tree.is_file(TABLES_MARK)):
        raise ArgumentError(
            "cache",
            expected="a packed zarr store, or a folder of the layout",
            found=f"{tree.location}, which is {'one file' if is_file else 'a store of tables'}",
            advice="pack the data into a .zarr, or leave `cache` out",
        )
    if is_file:
        return _open_file(tree, "")
    if cache is not None:
        return _open_folder(CachedTree(tree, cache if isinstance(cache, Cache) else Cache(cache)))
    return _open_folder(tree)


def _open_folder(tree: Tree) -> Source:
    source = _open_store(tree)
    if source is None and not tree.entries():
        raise MissingDataError(
            tree.location,
            expected="a folder, a zip or a packed store",
            found="nothing, or a folder that cannot be listed",
            advice="check the name; private and gated data need a token in HF_TOKEN"
            if tree.location.startswith(f"{HUB}://")
            else "",
        )
    return source or PublishedSource(tree)


def _open_store(tree: Tree) -> Source | None:
    """Open a packed store that is a folder; return None if the folder is not a packed store."""
    if tree.is_file("zarr.json"):
        from carlasc.storage.zarr.zarr_source import ZarrSource

        return ZarrSource(tree)
    if tree.is_file(UNFINISHED_MARK):
        raise unfinished_error(tree.location)
    if tree.is_file(TABLES_MARK):
        from carlasc.storage.parquet.parquet_source import ParquetSource

        return ParquetSource(tree)
    return None


def _open_file(tree: Tree, name: str) -> Source:
    where = tree.where(name)
    try:
        signature = bytes(tree.read_range(name, 0, _SIGNATURE))
    except FormatError as error:
        raise damaged(
            where,
            "a zip or a packed store",
            f"a file of less than {_SIGNATURE} bytes",
            "the file may be cut short",
        ) from error
    if signature.startswith((_ZIP, _EMPTY_ZIP)):
        inside = ZipTree(tree, name)
        return _open_store(inside) or PublishedSource(inside)
    if signature.startswith(_HDF5):
        from carlasc.storage.hdf5.hdf5_source import HDF5Source

        return HDF5Source(tree, name)
    if signature.startswith(_PARQUET):
        raise FormatError(
            where,
            expected="a packed store",
            found="a file inside a packed store",
            advice="give the folder of the store",
        )
    raise FormatError(
        where, expected="a folder, a zip, or a packed store", found="a file that is none of these"
    )
