"""What a part touches, and how even shares are: `python docs/studies/parts.py` prints the tables of
docs/studies/scale.md. Calls are counted with strace, if it is installed.
"""

from __future__ import annotations

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

from carlasc.running import Part
from carlasc.storage import FolderSink

FRAMES, SEQUENCES = 10, (1, 100, 5_000)
CALLS = "trace=file,fsync,fdatasync"


def write_sequences(folder: Path, count: int) -> None:
    """Write sequences of ten small scans, without waiting for the disk."""
    os.environ["CARLASC_DURABLE"] = "no"
    points = np.random.default_rng(0).uniform(-20, 20, (200, 4)).astype(np.float32)
    for index in range(len(list(folder.glob("Train/*"))), count):
        writer = FolderSink(folder).sequence(f"Train/clip_{index:06d}/cartesian")
        writer.write_frames({frame: {"points": points} for frame in range(FRAMES)})
        poses = [f"1 0 0 {0.1 * frame:g} 0 1 0 0 0 0 1 0\n" for frame in range(FRAMES)]
        writer.write_document("poses.txt", "".join(poses).encode())


def measure(root: Path, count: int) -> None:
    """Print the calls and the processor time of a part with one sequence."""
    names = [f"Train/clip_{index:06d}" for index in range(count)]
    parts = max(count, 1)
    number = next(n for n in range(1, 99) if len(Part(n, parts).share(names)[0]) == 1)
    out, log = root / f"out{count}", root / f"calls{count}"
    command = [sys.executable, "-c", "from carlasc.cli import main; main()", "regrid"]
    command += [str(root / "in"), "-o", str(out), "--size", "16,16,4", "--workers", "1"]
    command += ["--part", f"{number}/{parts}"]
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    call = ["strace", "-f", "-o", str(log), "-e", CALLS, *command]
    own = {**os.environ, "CARLASC_DURABLE": "yes"}
    subprocess.run(call, check=True, env=own, stdout=subprocess.DEVNULL)
    spent = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
    lines = log.read_text(errors="replace").splitlines()
    files = sum(str(root) in line for line in lines)
    syncs = sum(bool(re.search(r"f(?:data)?sync\(", line)) for line in lines)
    print(f"| {count:,} | {files} | {syncs} | {spent:.1f} s |")


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
            for sequences in (1, 3) if "tiny" in sys.argv else SEQUENCES:
                write_sequences(Path(place) / "in", sequences)
                measure(Path(place), sequences)
