"""Hostile archives of NCore, and hostile images of cameras."""

from __future__ import annotations

import json
import lzma
import pickle
import shutil
import struct
import zlib
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from carlasc.testing import write_dataset
from faults.hostile import Case
from faults.hostile_files import ESCAPE, HTML, Runs

_CONVERT = "convert ncore store out --grids none --force --workers 1"
_CAMERA = "Train/Town01_Light/cartesian"


def cases(base: Path) -> Iterator[Case]:
    """Yield the cases; what they are made from is written to `base`."""
    if find_spec("cbor2") and find_spec("numcodecs"):
        yield from _ncore(base)
    if find_spec("PIL"):
        yield from _images(base)


def _ncore(base: Path) -> Iterator[Case]:
    from helpers.converters import ncore_files

    from faults.foreign import DATA_SETS

    DATA_SETS["ncore"](base / "ncore")

    def changed(
        change: Callable[[dict[str, bytes], dict[str, Any]], object],
    ) -> Callable[[Path], None]:
        """Return what writes an archive with other members, or with other metadata."""

        def make(work: Path) -> None:
            from carlasc_converters.ncore_store import NcoreStore

            (whole,) = (base / "ncore").iterdir()
            store = NcoreStore(str(whole))
            members = {name: store._read(name) or b"" for name in store._members}
            metadata = store._metadata
            del members[".zmetadata.cbor.xz"]
            change(members, metadata)
            packed = ncore_files._packed({"zarr_consolidated_format": 1, "metadata": metadata})
            (work / "store").mkdir()
            ncore_files._write_archive(
                work / "store" / whole.name, {".zmetadata.cbor.xz": packed} | members
            )

        return make

    def arrays(metadata: dict[str, Any]) -> list[dict[str, Any]]:
        return [about for name, about in metadata.items() if name.endswith("direction/.zarray")]

    def chunks(members: dict[str, bytes]) -> list[str]:
        return [name for name in members if "/direction/" in name]

    def set_all(**values: object) -> Callable[[dict[str, bytes], dict[str, Any]], object]:
        return lambda members, metadata: [about.update(values) for about in arrays(metadata)]

    def code(members: dict[str, bytes], metadata: dict[str, Any]) -> None:
        set_all(compressor={"id": "pickle", "protocol": 4})(members, metadata)
        members |= dict.fromkeys(chunks(members), pickle.dumps(Runs()))

    def claiming(size: int) -> Callable[[dict[str, bytes], dict[str, Any]], object]:
        def change(members: dict[str, bytes], metadata: dict[str, Any]) -> None:
            for name in chunks(members):
                members[name] = members[name][:4] + struct.pack("<I", size) + members[name][8:]

        return change

    def named(name: str) -> Callable[[dict[str, bytes], dict[str, Any]], object]:
        return lambda members, metadata: metadata[".zattrs"].update(sequence_id=name)

    table = {
        "whose chunks run code": code,
        "with a chunk that claims 2 GB": claiming(2**31 - 1),
        "with a chunk that claims nothing": claiming(0),
        "with rows of 10^12 bytes": set_all(shape=[10**12, 3], chunks=[10**12, 3]),
        "with chunks of 10^12 bytes": set_all(chunks=[10**12, 3]),
        "with a hundred million chunks": set_all(shape=[10**8, 1], chunks=[1, 1], dtype="|u1"),
        "with chunks of no rows": set_all(chunks=[0, 3]),
        "with a negative shape": set_all(shape=[-1, 3]),
        "of objects": set_all(dtype="|O"),
        "with metadata that unpack to 3 GB": lambda members, metadata: members.update(
            {".zmetadata.cbor.xz": _zeros()}
        ),
        "with metadata nested a million times": lambda members, metadata: members.update(
            {".zmetadata.cbor.xz": lzma.compress(b"\x81" * 1_000_000)}
        ),
        "whose metadata claim 10^15 elements": lambda members, metadata: members.update(
            {".zmetadata.cbor.xz": lzma.compress(b"\x9b" + (10**15).to_bytes(8, "big"))}
        ),
    }
    for name, change in table.items():
        yield Case(f"an archive of NCore {name}", changed(change), _CONVERT, ".zarr.itar")
    for kind, text in {"terminal codes": ESCAPE, "HTML": HTML, "a way out": "../../victim"}.items():
        yield Case(
            f"an archive of NCore named with {kind}", changed(named(text)), _CONVERT, harmless=True
        )

    def index(**values: object) -> Callable[[Path], None]:
        def make(work: Path) -> None:
            changed(lambda members, metadata: None)(work)
            (path,) = (work / "store").iterdir()
            data = path.read_bytes()
            _, _, place, length = struct.unpack_from("<4sIQI", data, len(data) - 512)
            import cbor2

            held = cbor2.loads(lzma.decompress(data[place : place + length]))
            held |= {key: [value] * len(held["items"]) for key, value in values.items()}
            packed = lzma.compress(cbor2.dumps(held))
            end = struct.pack("<4sIQI", b"itar", 1, place, len(packed)).ljust(512, b"\0")
            path.write_bytes(data[:place] + packed + end)

        return make

    for name, make in {
        "sizes of 10^15 bytes": index(sizes=10**15),
        "places behind the end": index(offset_datas=10**15),
        "negative places": index(offset_datas=-5),
        "negative sizes": index(sizes=-5),
        "sizes that are texts": index(sizes=HTML),
    }.items():
        yield Case(f"an archive of NCore whose index has {name}", make, _CONVERT, ".zarr.itar")


def _zeros() -> bytes:
    """Return a stream of LZMA that unpacks to 3 GB of zeros."""
    packer = lzma.LZMACompressor(preset=0)
    block = bytes(1 << 24)
    return b"".join([*(packer.compress(block) for _ in range(192)), packer.flush()])


def _images(base: Path) -> Iterator[Case]:
    write_dataset(base / "seen")

    def png(width: int, height: int, rows: bytes = b"") -> bytes:
        header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
        chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
        return b"\x89PNG\r\n\x1a\n" + b"".join(
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
            for kind, data in chunks
        )

    def seen(image: bytes, width: int = 64, height: int = 48) -> Callable[[Path], None]:
        def make(work: Path) -> None:
            shutil.copytree(base / "seen" / _CAMERA, work / "data" / _CAMERA)
            folder = work / "data" / _CAMERA
            camera = {
                "name": "front",
                "width": width,
                "height": height,
                "model": "pinhole",
                "matrix": [[50.0, 0, width / 2], [0, 50.0, height / 2], [0, 0, 1]],
                "sensor_T_camera": [[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]],
            }
            (folder / "cameras.json").write_text(json.dumps({"format": 1, "cameras": [camera]}))
            for name in ("images", "image_labels"):
                (folder / name / "front").mkdir(parents=True, exist_ok=True)
                for frame in range(8):
                    (folder / name / "front" / f"{frame:06d}.png").write_bytes(image)

        return make

    images = {
        "claims 60,000 x 60,000 pixels": seen(png(60_000, 60_000, bytes(1000)), 60_000, 60_000),
        "has another size than its camera": seen(png(60_000, 60_000)),
        "ends early": seen(png(64, 48, bytes(64))),
        "is no image": seen(b"\x89PNG\r\n\x1a\n" + bytes(range(256))),
        "is PostScript": seen(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 48\n"),
    }
    for name, make in images.items():
        for command in (
            "label data -o out --from images --workers 1",
            "view data -o out.html",
            "validate data --workers 1",
        ):
            yield Case(f"an image that {name}, {command.split()[0]}", make, command, harmless=True)
