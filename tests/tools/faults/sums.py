"""`python -m faults.sums FOLDER`: run commands in a new folder, and print a SHA-256 sum of each
file that they write, as JSON.

With `--keep` the sums are written to `tests/data/sums.json`, with which every version of Python and
every processor is compared.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import os
import sys
import tarfile
from collections.abc import Collection
from pathlib import Path

import numpy as np
from helpers.datasets.tiny_kitti import write_tiny_kitti

from faults.commands import run_here
from faults.comparing import is_record

DATA = Path(__file__).parents[2] / "data"
SUMS = DATA / "sums.json"
GRID = "--size 16,16,8"
STEPS = {
    "regrid": f"regrid capture -o grids {GRID} --keep-votes",
    "cylinders": "regrid capture -o cylinders --size 16,16,8 --coordinates cylindrical",
    "scans": f"regrid grids -o scans {GRID} --observe scans --name merged --force",
    "coarse": "regrid grids -o coarse --size 8,8,4 --observe grid --name coarse",
    "convert": f"convert kitti kitti converted {GRID} --force",
    "export": "export kitti grids exported",
    "simulate": "simulate simulated --count 2 --sensors 2 --channels 8 --points 800 --range 20 "
    "--no-bev",
}
"""What is run, by the name of the step; those after the first read what it wrote."""


def sums_of(folder: Path, workers: int = 1, only: Collection[str] = STEPS.keys()) -> dict[str, str]:
    """Run steps in a new folder, and return the sum of every file that was written, by its path.

    Raises:
        RuntimeError: a step fails.
    """
    write_inputs(folder)
    given, before = sums_in(folder).keys(), Path.cwd()
    os.chdir(folder)
    try:
        for name in only:
            if code := run_here([*STEPS[name].split(), "--workers", str(workers)]):
                raise RuntimeError(f"{STEPS[name]}: exit code {code}")
    finally:
        os.chdir(before)
    return {name: digest for name, digest in sums_in(folder).items() if name not in given}


def write_inputs(folder: Path) -> None:
    """Write what the steps read: the golden capture, and a data set of SemanticKITTI."""
    with tarfile.open(DATA / "golden" / "capture.tar.xz") as archive:
        raw = [member for member in archive if member.name.startswith("./raw")]
        archive.extractall(folder / "capture", raw, filter="data")
    write_tiny_kitti(folder / "kitti", frames=3, voxels=True)


def sums_in(folder: Path) -> dict[str, str]:
    """Return the sum of every file in a folder but records of inputs, by its path."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(_of_no_version(path)).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not is_record(path)
    }


def _of_no_version(path: Path) -> bytes:
    """Return the bytes of a file without what names a version or a time, or depends on the version
    of zlib.
    """
    data = path.read_bytes()
    if path.name == "carlasc-report.json":
        report = json.loads(data)
        report.pop("versions", None)
        return json.dumps(report).encode()
    if path.suffix != ".npz":
        return data
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files if name != "about"}
    return b"".join(
        f"{name} {array.dtype.str} {array.shape}".encode() + array.tobytes()
        for name, array in arrays.items()
    )


def main() -> None:
    """Print or keep the sums."""
    parser = argparse.ArgumentParser(prog="faults.sums", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--keep", action="store_true")
    given = parser.parse_args()
    out, sys.stdout = sys.stdout, sys.stderr  # the commands print, too
    text = json.dumps(sums_of(given.folder, given.workers), indent=0)
    if given.keep:
        SUMS.write_text(text + "\n")
    print(text, file=out)


if __name__ == "__main__":
    main()
