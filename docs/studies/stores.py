"""How small packed stores are: `python docs/studies/stores.py` prints the table of docs/storage.md.

A simulated drive of full scans (64 channels, ground truth from 20 sensors, medium traffic, seed 0) is packed into each store. Shares are of the
fields that the published download has: `instances` is not among them, and the bird's-eye pictures are.
"""

from __future__ import annotations

from pathlib import Path

import study

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
ALL_FRAMES = 43_200
SIZES = {"tiny": (2, 2, Lidar(channels=8, points=2_000)), "whole": (24, 20, Lidar())}


def measure(folder: Path, size: str) -> tuple[int, dict[str, dict[str, int]]]:
    """Return the number of frames, and the bytes per field of the files ("published") and of each store."""
    frames, sensors, lidar = SIZES[size]
    drive = folder / "data" / "Train" / "Town"
    carlasc.simulate(drive, count=frames, sensors=sensors, lidar=lidar)
    carlasc.regrid(drive, GridSpec.published())
    found: dict[str, dict[str, int]] = {}
    for name, (store, small) in STORES.items():
        result = carlasc.pack(folder / "data", folder / store, small=small)
        found |= {"published": result.published_bytes, name: result.stored_bytes}
    return frames, found


def rows(frames: int, found: dict[str, dict[str, int]]) -> list[str]:
    """Return the lines of the table: bytes per frame."""
    lines = [f"| component | {' | '.join(found)} |", "|---|" + "---:|" * len(found)]
    for row in dict.fromkeys(FIELDS.values()):
        fields = [field for field, of in FIELDS.items() if of == row]
        sums = (sum(sizes.get(field, 0) for field in fields) / frames for sizes in found.values())
        lines.append(f"| {row} | {' | '.join(f'{size:,.0f}' for size in sums)} |")
    totals = {name: sum(sizes.get(field, 0) for field in FIELDS) / frames for name, sizes in found.items()}
    lines.append(f"| **together** | {' | '.join(f'**{total:,.0f}**' for total in totals.values())} |")
    shares = (f"**{total / totals['published']:.1%}**" for total in totals.values())
    lines.append(f"| **share** | {' | '.join(shares)} |")
    lines.append(
        f"| all {ALL_FRAMES:,} frames | {' | '.join(f'{t * ALL_FRAMES / 1e9:.0f} GB' for t in totals.values())} |"
    )
    others = sorted({field for sizes in found.values() for field in sizes} - set(FIELDS))
    for field in others:
        what = "not in the download" if field in SCAN_FIELDS and not SCAN_FIELDS[field].published else "not counted"
        sizes = (found[name].get(field, 0) / frames for name in found)
        lines.append(f"| {field} ({what}) | {' | '.join(f'{size:,.0f}' for size in sizes)} |")
    return lines


def main() -> None:
    """Print the table."""
    with study.begin(study.options(__doc__)) as given:
        print("\n".join(rows(*measure(given.work, given.size))))


if __name__ == "__main__":
    main()
