"""Hostile packed stores: zarr, HDF5 and Parquet, made from stores of ours by changing what a reader
believes.
"""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from helpers.datasets.parquet_tables import seal_tables

import carlasc
from carlasc.testing import write_dataset
from faults.hostile import Case
from faults.hostile_files import DEEP, DEEP_OBJECT, ESCAPE, edit

WHOLE = "Train/Town01_Light/cartesian"
POINTS, LABELS = f"{WHOLE}/scans/points/xyz", f"{WHOLE}/scans/labels/values"
READ = "unpack x.{kind} out"
Json = dict[str, Any]
NAMES = ("../../victim", "/tmp/victim", "C:victim", "..\\victim", "a\0b")


def cases(base: Path) -> Iterator[Case]:
    """Yield the cases; what they are made from is written to `base`."""
    data = write_dataset(base / "for-stores")
    if find_spec("numcodecs") and find_spec("pcodec"):
        carlasc.pack(data, base / "x.zarr")
        carlasc.pack(data, base / "small.zarr", small=True)
        yield from _zarr(base)
    if find_spec("h5py") and find_spec("hdf5plugin"):
        carlasc.pack(data, base / "x.h5")
        yield from _hdf5(base)
    if find_spec("pyarrow"):
        carlasc.pack(data, base / "x.parquet")
        yield from _parquet(base)


def _sealed(write: Callable[[Path], object]) -> Callable[[Path], None]:
    """Return a function that writes a table and puts its checksum right."""

    def both(path: Path) -> None:
        write(path)
        seal_tables(path.parent)

    return both


def _changed(change: Callable[[Json], object]) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        root = json.loads(path.read_bytes())
        change(root)
        path.write_text(json.dumps(root))

    return write


def _node(root: Json, name: str) -> Json:
    return root["consolidated_metadata"]["metadata"][name]


def _set(name: str, *keys: Any, value: Any) -> Callable[[Json], None]:
    """Return a function that sets a value in the metadata of a node; "" is the root."""

    def change(root: Json) -> None:
        at = _node(root, name) if name else root
        for key in keys[:-1]:
            at = at[key]
        at[keys[-1]] = value

    return change


def _grow(root: Json) -> None:
    """Make the points' chunks claim 10^12 elements, in all places that say it."""
    _node(root, f"{WHOLE}/scans/points")["attributes"]["chunk"] = 1 << 30
    points = _node(root, POINTS)
    points["shape"][2] = 1 << 40
    points["chunk_grid"]["configuration"]["chunk_shape"][2] = 1 << 40
    points["codecs"][0]["configuration"]["chunk_shape"][2] = 1 << 30


def _zarr(base: Path) -> Iterator[Case]:
    inner, outer = (
        ("codecs", 0, "configuration", "chunk_shape"),
        ("chunk_grid", "configuration", "chunk_shape"),
    )
    changes: dict[str, Callable[[Json], object]] = {
        "a shape of 10^15 frames": _set(POINTS, "shape", value=[10**15, 3, 1 << 18]),
        "a shape of 10^15 elements": _set(POINTS, "shape", value=[16, 3, 10**15]),
        "a shape of 10^30 elements": _set(POINTS, "shape", value=[10**30, 3, 1 << 18]),
        "a shape of text": _set(POINTS, "shape", value="abc"),
        "a shape of fractions": _set(POINTS, "shape", value=[16, 3, 1.5]),
        "no axes": _set(POINTS, "shape", value=[]),
        "shards of 10^15 chunks": _set(POINTS, *outer, value=[10**15, 3, 1 << 18]),
        "chunks of 10^12 elements": _grow,
        "chunks of no elements": _set(POINTS, *inner, value=[1, 3, 0]),
        "negative chunks": _set(POINTS, *inner, value=[1, 3, -5]),
        "elements that are objects": _set(POINTS, "data_type", value="object"),
        "elements of a megabyte": _set(POINTS, "data_type", value="U1000000"),
        "codecs of another type": _set(POINTS, "codecs", value=7),
        "a codec without settings": _set(POINTS, "codecs", 0, "configuration", "codecs", value=[{"name": "blosc"}]),
        "frames in 10^12 elements": _set(f"{WHOLE}/frames", "shape", value=[10**12]),
        "frames in chunks of 10^12 elements": lambda root: (
            _set(f"{WHOLE}/frames", "shape", value=[10**12])(root),
            _set(f"{WHOLE}/frames", *outer, value=[10**12])(root),
        ),
        "columns that are no list": _set(f"{WHOLE}/counts", "attributes", "columns", value=5),
        "columns with other names": _set(f"{WHOLE}/counts", "attributes", "columns", value=[[], {}]),
        "a block of 10^18 frames": _set("", "attributes", "block", value=10**18),
        "a block that is text": _set("", "attributes", "block", value="1"),
        "no sequences": _set("", "attributes", "sequences", value=None),
        "sequences in a list": _set("", "attributes", "sequences", value=["a"]),
        "a version that is text": _set("", "attributes", "version", value="2"),
        "fields that are a number": _set(WHOLE, "attributes", "fields", value=5),
        "fields that are objects": _set(WHOLE, "attributes", "fields", value=[{}]),
        "text files that are numbers": _set(WHOLE, "attributes", "documents", value=[1]),
        "other coordinates": _set(WHOLE, "attributes", "coordinates", value=ESCAPE),
        "a step of coordinates that is text": _set(f"{WHOLE}/scans/points", "attributes", "scale_m", value="x"),
        "a step of coordinates of 10^308 m": _set(f"{WHOLE}/scans/points", "attributes", "scale_m", value=1e308),
        "a grid of another shape": _set(f"{WHOLE}/grids/evaluation/labels", "attributes", "shape", value=[2000, 2000, 500]),
        "a node that is no object": lambda root: root["consolidated_metadata"]["metadata"].update({WHOLE: 3}),
        "nodes that are no object": lambda root: root.update(consolidated_metadata=[1]),
        "attributes that are no object": lambda root: root.update(attributes=[1]),
    }  # fmt: skip
    for name in NAMES:
        changes[f"a sequence in {name!r}"] = _set(
            "", "attributes", "sequences", value={WHOLE: name}
        )
        changes[f"a sequence called {name!r}"] = _set(
            "", "attributes", "sequences", value={name: WHOLE}
        )
        changes[f"a field {name!r}"] = _set(WHOLE, "attributes", "fields", value=[f"{name}/labels"])
        changes[f"a text file {name!r}"] = _set(WHOLE, "attributes", "documents", value=[name])
    for what, change in changes.items():
        # no byte more is read than the frames have
        unread = what in (
            "a shape of 10^15 frames",
            "frames in 10^12 elements",
            "a block of 10^18 frames",
            "a block that is text",
        )
        yield Case(
            f"zarr with {what}",
            edit(base, "zarr.json", _changed(change), "x.zarr"),
            "unpack x.zarr out",
            "x.zarr",
            harmless=unread,
        )
    for what, content in {
        "deep arrays": DEEP,
        "deep objects": DEEP_OBJECT,
        "no JSON": b"\x00\xff",
        "a list": b"[]",
    }.items():
        write = lambda path, content=content: path.write_bytes(content)  # noqa: E731
        yield Case(
            f"zarr.json with {what}",
            edit(base, "zarr.json", write, "x.zarr"),
            "info x.zarr",
            "x.zarr",
        )
    shard = f"{POINTS}/c/0/0/0"
    for what, spoil in {
        "offsets beyond the file": lambda table: table.__setitem__(
            (..., 0), np.where(table[:, 0] < 2**63, 2**62, table[:, 0])
        ),
        "lengths of 2^62 bytes": lambda table: table.__setitem__(
            (..., 1), np.where(table[:, 1] < 2**63, 2**62, table[:, 1])
        ),
        "offsets and lengths that overflow": lambda table: table.__setitem__(
            (table[:, 0] < 2**63), 2**64 - 2
        ),
    }.items():
        yield Case(
            f"zarr shard with {what}",
            edit(base, shard, _index(spoil), "x.zarr"),
            "unpack x.zarr out",
            "x.zarr",
        )
    for what, content in _chunks().items():
        yield Case(
            f"zarr chunk that {what}",
            edit(base, shard, _first_chunk(content), "x.zarr"),
            "unpack x.zarr out",
            "x.zarr",
        )
    for what, content in {"is no PCodec": b"\xff" * 64, "is empty": b""}.items():
        yield Case(
            f"zarr chunk that {what}",
            edit(base, shard, _first_chunk(content), "small.zarr"),
            "unpack small.zarr out",
            "small.zarr",
        )
    links = lambda path: (path.unlink(), path.symlink_to("/dev/zero"))  # noqa: E731
    yield Case(
        "zarr shard that is an endless device",
        edit(base, shard, links, "x.zarr"),
        "unpack x.zarr out",
        "x.zarr",
    )


def _with_checksum(data: bytes) -> bytes:
    import google_crc32c

    return data + struct.pack("<I", google_crc32c.value(data))


def _index(spoil: Callable[[np.ndarray], object]) -> Callable[[Path], None]:
    """Return a function that changes the index at the start of a shard, and its checksum."""

    def change(path: Path) -> None:
        data = path.read_bytes()
        slots = next(
            n
            for n in range(1, len(data) // 16)
            if _with_checksum(data[: 16 * n]) == data[: 16 * n + 4]
        )
        table = np.frombuffer(data[: 16 * slots], "<u8").reshape(-1, 2).copy()
        spoil(table)
        path.write_bytes(_with_checksum(table.tobytes()) + data[16 * slots + 4 :])

    return change


def _first_chunk(content: bytes) -> Callable[[Path], None]:
    """Return a function that replaces all chunks of a shard by one, with its checksum."""

    def change(path: Path) -> None:
        stored = _with_checksum(content)
        place = path.stat().st_size

        def point(table: np.ndarray) -> None:
            table[table[:, 0] < 2**63] = place, len(stored)

        _index(point)(path)
        path.write_bytes(path.read_bytes() + stored)

    return change


def _chunks() -> dict[str, bytes]:
    """Return bytes that are no chunk, which Blosc would believe."""
    from numcodecs import blosc

    whole = blosc.compress(np.zeros(3 * 1280, "<f4"), b"zstd", 5, 1, 1 << 21)
    more = blosc.compress(np.zeros(1 << 26, "<f4"), b"zstd", 5, 1, 1 << 21)

    def header(**changes: int) -> bytes:
        names = ("version", "codec", "flags", "type", "decoded", "block", "encoded")
        values = dict(zip(names, struct.unpack_from("<4B3I", whole), strict=True)) | changes
        return struct.pack("<4B3I", *values.values()) + whole[16:]

    return {
        "unpacks to 256 MB": more,
        "claims 4 GB": header(decoded=2**32 - 1),
        "claims to have 4 GB": header(encoded=2**32 - 1),
        "claims blocks of 4 GB": header(block=2**32 - 1),
        "claims blocks of no bytes": header(block=0),
        "claims another codec": header(flags=0xFF, codec=99),
        "claims an unknown version": header(version=99),
        "is a header only": whole[:16],
        "is three bytes": b"abc",
        "is empty": b"",
    }


def _hdf5(base: Path) -> Iterator[Case]:
    def change(work: Callable[[Any, Path], object]) -> Callable[[Path], None]:
        def make(folder: Path) -> None:
            import h5py

            shutil.copy2(base / "x.h5", folder / "x.h5")
            with h5py.File(folder / "other.h5", "w") as other:
                other["secret"] = np.frombuffer(b"this text is of another file", "u1")
                other.create_group("group").attrs["type"] = "carlasc.field"
            with h5py.File(folder / "x.h5", "r+") as file:
                work(file, folder)

        return make

    def replaced(node: str, create: Callable[[Any, str], object]) -> Callable[[Any, Path], None]:
        def work(file: Any, folder: Path) -> None:
            kept = dict(file[node].attrs)
            del file[node]
            create(file, node)
            if file.get(node, getlink=True).__class__.__name__ == "HardLink":
                file[node].attrs.update(kept)

        return work

    import h5py

    document, frames, counts = f"{WHOLE}/documents/poses.txt", f"{WHOLE}/frames", f"{WHOLE}/counts"
    secret = lambda file, node: file.__setitem__(node, h5py.ExternalLink("other.h5", "/secret"))  # noqa: E731

    def external(file: Any, node: str) -> None:
        file.create_dataset(node, (28,), "u1", external=[("../secret.txt", 0, 28)])

    def virtual(file: Any, node: str) -> None:
        plan = h5py.VirtualLayout((28,), "u1")
        plan[:] = h5py.VirtualSource("other.h5", "secret", (28,))
        file.create_virtual_dataset(node, plan)

    def late(
        shape: tuple[int, ...], dtype: str = "<i8", **options: Any
    ) -> Callable[[Any, str], object]:
        return lambda file, node: file.create_dataset(node, shape, dtype, **options)

    def bomb(file: Any, node: str) -> None:
        """A chunk of 100 elements that holds a gigabyte, packed."""
        import zlib

        dataset = file.create_dataset(node, (100,), "<i8", chunks=(100,), compression="gzip")
        packer = zlib.compressobj(1)
        packed = b"".join(packer.compress(bytes(1 << 24)) for _ in range(64)) + packer.flush()
        dataset.id.write_direct_chunk((0,), packed)

    def loop(file: Any, node: str) -> None:
        file[node] = h5py.SoftLink(f"/{node}")

    def counted(file: Any, folder: Path) -> None:
        huge = np.full(file[counts].shape, 2**62)
        replaced(counts, lambda file, node: file.create_dataset(node, data=huge))(file, folder)

    changes: dict[str, Callable[[Any, Path], object]] = {
        "a text file that is a link to another file": replaced(document, secret),
        "a text file in raw storage outside": replaced(document, external),
        "a text file that is a virtual data set": replaced(document, virtual),
        "a group that is a link to another file": lambda file, _: (file.__delitem__(f"{WHOLE}/scans"), file.__setitem__(f"{WHOLE}/scans", h5py.ExternalLink("other.h5", "/group"))),
        "a symbolic link to itself": replaced(document, loop),
        "frames of 10^12 elements that take nothing": replaced(frames, late((10**12,))),
        "frames of 10^12 elements in chunks": replaced(frames, late((10**12,), chunks=(10**6,), compression="gzip")),
        "frames in a bomb": replaced(frames, bomb),
        "frames that are text": replaced(frames, lambda file, node: file.create_dataset(node, data=["a", "b"])),
        "frames that are one number": replaced(frames, lambda file, node: file.create_dataset(node, data=5)),
        "frames that are a table": replaced(frames, lambda file, node: file.create_dataset(node, data=np.zeros((3, 3), "<i8"))),
        "frames that fall": replaced(frames, lambda file, node: file.create_dataset(node, data=np.array([3, 2, 1, 0]))),
        "frames through a filter that is not installed": replaced(frames, late((4,), chunks=(4,), compression=32004, compression_opts=(1,), allow_unknown_filter=True)),
        "counts of 2^62": counted,
        "a group in the place of counts": replaced(counts, lambda file, node: file.create_group(node)),
        "labels of 10^12 elements in one chunk": replaced(LABELS, late((10**12,), "u1", chunks=(10**6,), maxshape=(None,))),
        "attributes nested deeply": lambda file, _: file[WHOLE].attrs.create("fields:json", DEEP.decode()[:60_000]),
        "sequences nested deeply": lambda file, _: file.attrs.create("sequences:json", DEEP_OBJECT.decode()[:60_000]),
        "fields that are a number": lambda file, _: file[WHOLE].attrs.create("fields:json", 5),
        "a sequence that leads elsewhere": lambda file, _: file.attrs.create("sequences:json", json.dumps({WHOLE: "../../victim"})),
    }  # fmt: skip
    for what, work in changes.items():
        yield Case(f"HDF5 with {what}", change(work), "unpack x.h5 out", "x.h5")
    write = lambda folder: (folder / "x.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + b"\xff" * 500)  # noqa: E731
    yield Case("HDF5 with a header of ones", write, "info x.h5", "x.h5")


def _parquet(base: Path) -> Iterator[Case]:
    import pyarrow as pa
    from pyarrow import parquet

    def table(
        change: Callable[[Path, Json], object], name: str = "labels"
    ) -> Callable[[Path], None]:
        def write(path: Path) -> None:
            change(path, json.loads(parquet.ParquetFile(path).metadata.metadata[b"carlasc"]))
            seal_tables(path.parent)

        return edit(base, f"{WHOLE}/{name}.parquet", write, "x.parquet")

    def rewritten(
        columns: dict[str, Any], groups: int = 1, **about: Any
    ) -> Callable[[Path, Json], None]:
        def write(path: Path, found: Json) -> None:
            content = pa.table(columns)
            with parquet.ParquetWriter(path, content.schema, compression="zstd") as writer:
                for _ in range(groups):
                    writer.write_table(content, row_group_size=len(content))
                writer.add_key_value_metadata(
                    {
                        "carlasc": json.dumps({**found, **about})
                        if "raw" not in about
                        else about["raw"]
                    }
                )

        return write

    one = {"frame": pa.array([0]), "label": pa.array([1], pa.uint32())}
    many = 1 << 24
    zeros = {"frame": pa.array(np.zeros(many, "<i8")), "label": pa.array(np.zeros(many, "<u4"))}
    few = {"frame": pa.array([5] * 3), "label": pa.array([1, None, 2], pa.uint32())}
    rows = {"frames": [0, 1, 2, 5], "rows": [0, 0, 0, 1]}
    tables: dict[str, Callable[[Path, Json], object]] = {
        "no footer of ours": lambda path, _: parquet.write_table(pa.table(one), path),
        "a footer nested deeply": rewritten(one, raw=DEEP.decode()),
        "a footer that is a list": rewritten(one, raw="[]"),
        "frames that are text": rewritten(one, frames="abc", rows=[1]),
        "frames of 10^30": rewritten(one, frames=[10**30], rows=[1]),
        "fewer row groups than frames": rewritten(one, frames=[0, 1, 2, 5], rows=[1, 1, 1, 1]),
        "10^15 rows": rewritten(one, frames=[0], rows=[10**15]),
        "16 groups of 16 million zeros, and other numbers of rows": rewritten(
            zeros, 2, frames=[0, 1], rows=[1, 1]
        ),
        "text in the place of labels": rewritten(one | {"label": pa.array(["a"])}, **rows),
        "no labels": rewritten({"frame": pa.array([0])}, **rows),
        "nested labels": rewritten(one | {"label": pa.array([[1]])}, **rows),
        "missing values": rewritten(few, frames=[0, 1, 2, 5], rows=[0, 0, 0, 3]),
    }
    for what, change in tables.items():
        yield Case(f"Parquet table with {what}", table(change), "unpack x.parquet out", "labels")
    sequence = f"{WHOLE}/sequence.json"
    for what, content in {
        "another object": b"{}", "a list": b"[1]", "deep arrays": DEEP, "other types": b'{"split": [], "name": {}, "coordinates": 5, "fields": 3, "documents": null}',
        "text files that the table lacks": json.dumps({"split": None, "name": "a", "coordinates": "cartesian", "fields": [], "documents": ["poses.txt", "absent.txt"]}).encode(),
        "fields that lead elsewhere": json.dumps({"split": None, "name": "a", "coordinates": "cartesian", "fields": ["../../../../victim"], "documents": []}).encode(),
    }.items():  # fmt: skip
        write = lambda path, content=content: path.write_bytes(content)  # noqa: E731
        yield Case(
            f"sequence.json with {what}",
            edit(base, sequence, write, "x.parquet"),
            "unpack x.parquet out",
            "cartesian",
        )
    documents = f"{WHOLE}/documents.parquet"
    huge = pa.table({"name": ["poses.txt"], "data": pa.array([bytes(1 << 27)], pa.binary())})
    bomb = lambda path: parquet.write_table(huge, path, compression="zstd", use_dictionary=False)  # noqa: E731
    yield Case(
        "a text file of zeros, 128 MB, in Parquet",
        edit(base, documents, _sealed(bomb), "x.parquet"),
        "unpack x.parquet out",
        "documents.parquet",
    )
    other = lambda path: parquet.write_table(pa.table({"a": [1]}), path)  # noqa: E731
    yield Case(
        "a table of text files with other columns",
        edit(base, documents, _sealed(other), "x.parquet"),
        "unpack x.parquet out",
        "documents.parquet",
    )

    def link(path):
        return path.write_bytes(b"PAR1" + b"\xff" * 100 + struct.pack("<I", 2**31 - 1) + b"PAR1")

    yield Case(
        "a Parquet footer of 2 GB",
        edit(base, documents, link, "x.parquet"),
        "unpack x.parquet out",
        "documents.parquet",
    )
