"""The records of inputs: what the check of an unchanged run costs, and their size."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

from faults.large import write_frames

from carlasc import FromScans, GridSpec, Run, regrid
from carlasc.groundtruth.inputs import InputCheck
from carlasc.motion import PoseOptions
from measuring.figures import Figure
from measuring.sizes import Size

_FRAMES, _POINTS = 400, 2000


def measure_records(size: Size, folder: Path) -> Iterator[tuple[str, Figure]]:
    """Yield the wall time per frame in which an unchanged run compares the inputs of a folder, and
    the share of the bytes of grids that records have.
    """
    write_frames(folder / "data", _FRAMES, _POINTS)
    still = FromScans(
        window=(-1, 1), dynamic="tube", poses=PoseOptions("file", "never", force=True)
    )

    def run() -> int:
        spec, alone = GridSpec.published(), Run(workers=1)
        return regrid(folder / "data", spec, observe=still, run=alone).made

    assert run() == _FRAMES
    took: list[float] = []
    look = InputCheck.look

    def timed(*arguments: Any) -> None:
        began = time.perf_counter()
        look(*arguments)
        took.append(time.perf_counter() - began)

    with mock.patch.object(InputCheck, "look", timed):
        for _ in range(size.slow_repeats):
            assert run() == 0
    text = f"{_FRAMES} frames, 128 x 128 x 8, scans merged over 3 frames, in a folder"
    yield (
        "records.check",
        Figure(1e3 * min(took) / _FRAMES, "ms", f"least wall time per frame of the check: {text}"),
    )
    files = [path for path in folder.rglob("*") if path.is_file()]
    records = sum(path.stat().st_size for path in files if ".carlasc" in path.parts)
    grids = sum(path.stat().st_size for path in files if path.parent.name.startswith("evaluation"))
    yield "records.size", Figure(100 * records / grids, "%", f"bytes of records by grids: {text}")
