"""How small packed stores are: `python docs/studies/stores.py` prints the tables of docs/storage.md
and docs/studies/stores.md.

A simulated drive of full scans (64 channels, ground truth from 20 sensors, medium traffic, seed 0)
is packed into each store. Shares are of the fields that the published download has: `instances` is
not among them, and the bird's-eye pictures are. "zip" are the same files as a zip has them. Codecs
are compared on the points of one scan, in one thread: the least processor time of ten turns.
"""

from __future__ import annotations

import time
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import study
from numcodecs import Blosc, blosc
from numcodecs.pcodec import PCodec

import carlasc
from carlasc import GridSpec
from carlasc.captures import Lidar
from carlasc.storage.layout import SCAN_FIELDS

STORES = {
    "zarr": ("data.zarr", False),
    "zarr `--small`": ("small.zarr", True),
    "HDF5": ("data.h5", False),
    "Parquet": ("data.parquet", False),
}
FIELDS = {  # of the store's fields, the row of the table
    "points": "points",
    "labels": "labels",
    "flow": "flow",
    "evaluation/labels": "grid's labels",
    "evaluation/counts": "grid's counts",
    "bev": "bird's-eye pictures",
    "documents": "text files, index",
    "index": "text files, index",
}
FILES = {  # folder and suffix of the files of a field
    "velodyne.bin": "points",
    "labels.label": "labels",
    "predictions.bin": "flow",
    "instances.label": "instances",
    "evaluation.label": "evaluation/labels",
    "evaluation.bin": "evaluation/counts",
    "bev.jpg": "bev",
}
ALL_FRAMES = 43_200
CODECS = {
    "Blosc Zstandard 5, bytes shuffled, 512 KiB blocks": Blosc("zstd", 5, Blosc.SHUFFLE, 512 << 10),
    "**Blosc Zstandard 5, bytes shuffled, a scan in one block** (default)": Blosc(
        "zstd", 5, Blosc.SHUFFLE, 1 << 24
    ),
    "Blosc Zstandard 7, bytes shuffled, a scan in one block": Blosc(
        "zstd", 7, Blosc.SHUFFLE, 1 << 24
    ),
    "Blosc Zstandard 3, bits shuffled": Blosc("zstd", 3, Blosc.BITSHUFFLE),
    "Blosc Zstandard 7, bits shuffled": Blosc("zstd", 7, Blosc.BITSHUFFLE),
    "PCodec 8": PCodec(8),
    "**PCodec 8, chunks of 8,192 points** (`--small`)": PCodec(8),
    "PCodec 10, chunks of 16,384 points": PCodec(10),
}
CHUNKS = {
    "**PCodec 8, chunks of 8,192 points** (`--small`)": 8_192,
    "PCodec 10, chunks of 16,384 points": 16_384,
}
SIZES = {"tiny": (2, 2, Lidar(channels=8, points=2_000)), "whole": (24, 20, Lidar())}


def measure(folder: Path, size: str) -> tuple[int, dict[str, dict[str, int]]]:
    """Return the number of frames, and the bytes per field of the files ("published") and of each
    store.
    """
    frames, sensors, lidar = SIZES[size]
    drive = folder / "data" / "Train" / "Town"
    run = carlasc.Run(workers=1)
    carlasc.simulate(drive, count=frames, sensors=sensors, lidar=lidar, run=run)
    carlasc.regrid(drive, GridSpec.published(), run=run)
    found: dict[str, dict[str, int]] = {}
    for name, (store, small) in STORES.items():
        result = carlasc.pack(folder / "data", folder / store, small=small, run=run)
        found |= {
            "published": result.published_bytes,
            "zip": zipped(drive / "cartesian"),
            name: result.stored_bytes,
        }
    return frames, found


def zipped(sequence: Path) -> dict[str, int]:
    """Return the bytes per field of the files of a sequence in a zip, each compressed by itself."""
    sizes: Counter[str] = Counter()
    for file in filter(Path.is_file, sequence.rglob("*")):
        field = FILES.get(file.parent.name + file.suffix, "documents")
        sizes[field] += len(zlib.compress(file.read_bytes()))
    return dict(sizes)


def rows(frames: int, found: dict[str, dict[str, int]]) -> list[str]:
    """Return the lines of the table: bytes per frame."""
    lines = [f"| component | {' | '.join(found)} |", "|---|" + "---:|" * len(found)]
    for row in dict.fromkeys(FIELDS.values()):
        fields = [field for field, of in FIELDS.items() if of == row]
        sums = (sum(sizes.get(field, 0) for field in fields) / frames for sizes in found.values())
        lines.append(f"| {row} | {' | '.join(f'{size:,.0f}' for size in sums)} |")
    totals = {
        name: sum(sizes.get(field, 0) for field in FIELDS) / frames for name, sizes in found.items()
    }
    lines.append(
        f"| **together** | {' | '.join(f'**{total:,.0f}**' for total in totals.values())} |"
    )
    shares = (f"**{total / totals['published']:.1%}**" for total in totals.values())
    lines.append(f"| **share** | {' | '.join(shares)} |")
    lines.append(
        f"| all {ALL_FRAMES:,} frames | "
        f"{' | '.join(f'{t * ALL_FRAMES / 1e9:.0f} GB' for t in totals.values())} |"
    )
    others = sorted({field for sizes in found.values() for field in sizes} - set(FIELDS))
    for field in others:
        what = (
            "not in the download"
            if field in SCAN_FIELDS and not SCAN_FIELDS[field].published
            else "not counted"
        )
        sizes = (found[name].get(field, 0) / frames for name in found)
        lines.append(f"| {field} ({what}) | {' | '.join(f'{size:,.0f}' for size in sizes)} |")
    return lines


def codecs(points: np.ndarray) -> list[str]:
    """Return the lines of the table of codecs: share of the published bytes, and milliseconds to
    encode and decode a scan.
    """
    blosc.set_nthreads(1)
    planes = np.ascontiguousarray(points[:, :3].T)
    lines = ["| points as planes x, y, z | share | encode | decode |", "|---|---:|---:|---:|"]
    for name, codec in CODECS.items():
        length = CHUNKS.get(name, len(points))
        parts = [
            np.ascontiguousarray(planes[:, i : i + length]) for i in range(0, len(points), length)
        ]
        encoded = [codec.encode(part) for part in parts]
        share = sum(map(len, encoded)) / points.nbytes
        times = [_least_ms(codec.encode, parts), _least_ms(codec.decode, encoded)]
        lines.append(f"| {name} | {share:.1%} | {times[0]:.0f} ms | {times[1]:.1f} ms |")
    return lines


def _least_ms(function: Callable[[object], object], parts: Sequence[object]) -> float:
    turns = []
    for _ in range(1 if study.is_tiny() else 10):
        start = time.process_time()
        for part in parts:
            function(part)
        turns.append(time.process_time() - start)
    return 1000 * min(turns)


def main() -> None:
    """Print the table."""
    with study.begin(study.options(__doc__)) as given:
        print("\n".join(rows(*measure(given.work, given.size))))
        (sequence,) = carlasc.open(given.work / "data").values()
        print("", *codecs(sequence.read("points", 0)), sep="\n")


if __name__ == "__main__":
    main()
