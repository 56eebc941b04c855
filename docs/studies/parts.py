"""What a part touches, and how even shares are: `python docs/studies/parts.py` prints the tables of
docs/studies/scale.md. Calls are counted with strace, if it is installed.
"""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

from carlasc.core.grids import GridSpec
from carlasc.running import Part
from carlasc.storage import FolderSink
from carlasc.testing import SimulatedDrive

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from helpers.converters.ncore_files import write_store

FRAMES, SEQUENCES = 10, (1, 100, 5_000)
CALLS = "trace=file,fsync,fdatasync"
GRID = GridSpec.published().with_size((16, 16, 4))
COMMANDS = {
    "regrid": "{folder}/in -o {out} --size 16,16,4 --workers 1",
    "regrid labelled": "{folder}/labelled -o {out} --size 16,16,4 --workers 1",
    "refine": "{folder}/labelled -o {out} --workers 1",
    "label": "{folder}/labelled -o {out} --from motion --workers 1",
    "pack": "{folder}/labelled {out}.zarr --workers 1",
    "export": "kitti {folder}/labelled {out} --workers 1",
    "audit": "{folder}/labelled {folder}/labelled --keep {out} --workers 1",
    "convert": "ncore {folder}/clips {out} --grids none --sequences-from {folder}/list --workers 1",
}


def write_sequences(folder: Path, count: int) -> None:
    """Write sequences of ten small scans, without waiting for the disk; in a folder "labelled" also
    labels and grids.
    """
    os.environ["CARLASC_DURABLE"] = "no"
    random = np.random.default_rng(0)
    points = random.uniform(-20, 20, (200, 4)).astype(np.float32)
    labels = random.integers(0, 2, GRID.size, dtype=np.uint32)
    fields = {
        "labels": np.ones(200, np.uint32),
        "evaluation/labels": labels,
        "evaluation/counts": np.ones(GRID.size, np.float32),
    }
    fields = {"points": points, **(fields if folder.name == "labelled" else {})}
    for index in range(len(list(folder.glob("Train/*"))), count):
        writer = FolderSink(folder).sequence(f"Train/clip_{index:06d}/cartesian")
        if len(fields) > 1:
            writer.write_document("evaluation/params.json", json.dumps(GRID.to_params()).encode())
        writer.write_frames(dict.fromkeys(range(FRAMES), fields))
        poses = [f"1 0 0 {0.1 * frame:g} 0 1 0 0 0 0 1 0\n" for frame in range(FRAMES)]
        writer.write_document("poses.txt", "".join(poses).encode())


def write_clips(folder: Path, count: int) -> None:
    """Write recordings of NCore with ten scans, which are all the same."""
    (folder / "clips").mkdir()
    first = write_store(folder, SimulatedDrive(FRAMES, channels=6, columns=40))
    for index in range(count):
        (folder / "clips" / f"clip_{index:06d}.ncore4.zarr.itar").hardlink_to(first)


def measure(root: Path, count: int, command: str) -> None:
    """Print the calls and the processor time of a part with one sequence."""
    names = sorted(path.name for path in (root / "clips").glob("*"))
    if command != "convert":
        names = [f"Train/clip_{index:06d}" for index in range(count)]
    parts = max(count, 1)
    number = next(n for n in range(1, 99) if len(Part(n, parts).share(names)[0]) == 1)
    own = Part(number, parts).share(names)[0][0].partition(".")[0]
    log, out = root / f"calls-{command}{count}", root / f"{command.replace(' ', '-')}{count}"
    arguments = COMMANDS[command].format(folder=root, out=out).split()
    call = ["strace", "-f", "-o", str(log), "-e", CALLS, sys.executable, "-c"]
    call += ["from carlasc.cli import main; main()", command.partition(" ")[0], *arguments]
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    durable = {**os.environ, "CARLASC_DURABLE": "yes"}
    call += ["--part", f"{number}/{parts}"]
    subprocess.run(call, check=False, env=durable, stdout=subprocess.DEVNULL)  # audits find faults
    spent = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
    lines = log.read_text(errors="replace").splitlines()
    calls = [line for line in lines if str(root) in line]
    others = [line for line in calls if "clip_" in line and own not in line]
    syncs = sum(bool(re.search(r"f(?:data)?sync\(", line)) for line in lines)
    row = f"{command} | {count:,} | {len(calls)} | {len(others)} | {syncs} | {spent:.1f} s"
    print(f"| {row} |", flush=True)


def print_evenness() -> None:
    """Print the largest share in units of the mean."""
    for count, parts in ((24, 8), (100, 10), (1_000, 10), (5_000, 100), (300_000, 1_000)):
        names = [f"Train/clip_{index:06d}" for index in range(count)]
        sizes = Counter(
            number
            for number in range(1, min(parts, 100) + 1)
            for _ in Part(number, parts).share(names)[0]
        )
        most = max(sizes.values()) * parts / count
        print(f"| {count:,} | {parts:,} | {count / parts:.0f} | {most:.2f} |")


if __name__ == "__main__":
    print_evenness()
    if shutil.which("strace"):
        with tempfile.TemporaryDirectory() as place:
            sizes = (1, 3) if "tiny" in sys.argv else SEQUENCES
            write_clips(Path(place), sizes[-1])
            for sequences in sizes:
                write_sequences(Path(place) / "in", sequences)
                if sequences == sizes[-1]:
                    write_sequences(Path(place) / "labelled", sequences)
                for name in COMMANDS if sequences == sizes[-1] else ["regrid"]:
                    measure(Path(place), sequences, name)
