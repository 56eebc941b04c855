"""Figures of `tests/benchmarks`, as pytest-benchmark measures them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from measuring.figures import Figure, ratio
from measuring.sizes import Size

_TESTS = Path(__file__).parents[2]


@dataclass(frozen=True)
class Row:
    """A benchmark and the figure that it gives.

    Attributes:
        key: key of the figure.
        unit: "ms" or "s".
        what: what is measured.
        count: number of things that one round handles, such as frames.
    """

    key: str
    unit: str
    what: str
    count: int = 1


FILES: dict[str, dict[str, Row]] = {
    "exporting": {
        "test_bench_occluded_voxels[in the grid]": Row(
            "export.occlusion", "ms", "occlusion mask of 256 x 256 x 32"
        ),
        "test_bench_occluded_voxels[below the grid]": Row(
            "export.occlusion_below",
            "ms",
            "occlusion mask of 256 x 256 x 32, sensor below the grid",
        ),
        "test_bench_export_kitti": Row(
            "export.kitti", "ms", "export kitti, 256 x 256 x 32, per frame", 4
        ),
    },
    "inspection": {
        "test_bench_validate[cartesian]": Row(
            "validate.cartesian", "ms", "validate --full, 128 x 128 x 8, per frame", 40
        ),
        "test_bench_validate[cylindrical]": Row(
            "validate.cylindrical", "ms", "validate --full, cylindrical, per frame", 40
        ),
    },
    "votes": {
        "test_bench_numpy": Row(
            "votes_file.numpy", "s", "the votes of a frame at 0.1 m by numpy.savez_compressed"
        ),
        "test_bench_encode": Row("votes_file.encode", "s", "votes.npz of a frame at 0.1 m"),
        "test_bench_decode": Row("votes_file.decode", "s", "reading votes.npz of a frame at 0.1 m"),
    },
    "merging": {
        f"test_a_frame_from_merged_scans[{res}-{kind}]": Row(
            f"merging.{name}.{kind.split()[-1]}",
            "ms",
            f"a frame from 31 merged scans at {res} m, with votes, {kind}",
        )
        for res, name in ((0.4, "coarse"), (0.2, "fine"), (0.1, "finest"))
        for kind in ("grid", "and evidence")
    }
    | {
        f"test_a_frame_after_the_one_before[{res}-{kind}]": Row(
            f"merging.{name}.{kind}",
            "ms",
            f"a frame from 21 merged scans at {res} m after the one before, {kind}",
        )
        for res, name in ((0.4, "coarse"), (0.2, "fine"))
        for kind in ("consecutive", "turning")
    }
    | {
        "test_the_pass_that_finds_what_moves": Row(
            "merging.pass", "ms", "finding what moves by free space, per scan of 57,600 rays", 31
        )
    },
    "poses": {
        f"test_poses_of_a_drive[{name}]": Row(
            f"poses.{name.lower()}",
            "s",
            f"refining the poses of 60 scans of 28,800 rays, {name}: processor time",
        )
        for name in ("carlasc", "Open3D", "Open3D_best")
    },
    "converting": {
        "test_bench_copy": Row("convert.copy", "ms", "copying the files of a scan", 8),
        "test_bench_convert": Row(
            "convert.scan", "ms", "convert kitti --flow none --grids none, per scan", 8
        ),
        "test_bench_convert_with_flow[1]": Row(
            "convert.flow", "ms", "convert kitti --grids none with flow, per scan", 8
        ),
    },
    "rendering": {
        "test_bench_full_grid[coarse-perspective]": Row(
            "render.coarse", "ms", "render, 128 x 128 x 8, 1280 x 720"
        ),
        "test_bench_full_grid[fine-perspective]": Row(
            "render.fine", "ms", "render, 256 x 256 x 16, 1280 x 720"
        ),
        "test_bench_full_grid[cylindrical-perspective]": Row(
            "render.cylindrical", "ms", "render, cylindrical, 1280 x 720"
        ),
        "test_bench_scan": Row(
            "render.scan", "ms", "render of a scan of 130,000 points, 1280 x 720"
        ),
        "test_bench_film[1]": Row("render.film", "ms", "render, a film, per frame, one worker", 20),
        "test_bench_film[2]": Row(
            "render.film_two_workers", "ms", "render, a film, per frame, two workers", 20
        ),
    },
    "startup": {
        "test_bench_a_command[--help]": Row("start.help", "s", "start of carlasc --help"),
        "test_bench_a_command[info DATA]": Row("start.info", "s", "start of carlasc info FOLDER"),
        "test_bench_first_use[pictures]": Row(
            "first_use.pictures", "s", "the first picture on a new machine, with compiling"
        ),
        "test_bench_first_use[scores]": Row(
            "first_use.scores", "s", "the first scores on a new machine, with compiling"
        ),
    },
    "metrics": {
        "test_bench_confusion_matrix": Row(
            "metrics.confusion.carlasc", "ms", "confusion matrix of 128 x 128 x 8 voxels"
        ),
        "test_bench_per_class_loop": Row(
            "metrics.confusion.plain", "ms", "the same in plain NumPy"
        ),
        "test_bench_rayiou": Row("metrics.rayiou.carlasc", "ms", "RayIoU, 8 origins x 14,040 rays"),
        "test_bench_rayiou_in_numpy": Row("metrics.rayiou.plain", "ms", "the same in plain NumPy"),
        "test_bench_all_conventions": Row(
            "metrics.conventions", "ms", "evaluate --all-conventions, 128 x 128 x 8, per frame", 20
        ),
        "test_bench_panoptic_quality": Row(
            "metrics.panoptic.carlasc", "ms", "panoptic quality, 39 objects"
        ),
        "test_bench_panoptic_quality_in_numpy": Row(
            "metrics.panoptic.plain", "ms", "the same in plain NumPy"
        ),
    },
}
"""The figures of each file of benchmarks, by the name of the benchmark."""

_RATIOS = {  # key -> slower, faster
    "votes_file.ratio": ("votes_file.numpy", "votes_file.encode"),
    "metrics.confusion.ratio": ("metrics.confusion.plain", "metrics.confusion.carlasc"),
    "metrics.rayiou.ratio": ("metrics.rayiou.plain", "metrics.rayiou.carlasc"),
    "metrics.panoptic.ratio": ("metrics.panoptic.plain", "metrics.panoptic.carlasc"),
}


_BESIDE = {  # what a benchmark says beside its time -> ending of the key, unit, what it is
    "peak_mb": ("memory", "MB", "peak of what Python allocates"),
    "error_cm": ("error", "cm", "what is left of the errors of motions over 30 scans"),
}
# files with ratios: they run several times, so that what is compared takes turns
_COMPARED = (
    "votes",
    "metrics",
)


def measure_file(name: str, size: Size, folder: Path) -> Iterator[tuple[str, Figure]]:
    """Run a file of benchmarks, one with ratios several times, and yield the least time of each:
    wall time unless the file sets another clock.

    Raises:
        RuntimeError: a benchmark failed; the figures of the others were yielded before.
    """
    least: dict[str, float] = {}
    beside: dict[str, dict[str, float]] = {}
    problems = []
    for turn in range(size.runs if name in _COMPARED else 1):  # every benchmark comes again in each
        found, problem = _run(name, size, folder / f"{turn}.json")
        problems += filter(None, [problem])
        for one in found:
            least[one["name"]] = min(one["stats"]["min"], least.get(one["name"], float("inf")))
            beside[one["name"]] = one["extra_info"]
    figures = {}
    for test, row in FILES[name].items():
        if test in least:
            scale = {"ms": 1e3, "s": 1.0}[row.unit] / row.count
            figures[row.key] = Figure(least[test] * scale, row.unit, f"{row.what}: least time")
        for key, (ending, unit, what) in _BESIDE.items():
            if beside.get(test, {}).get(key):
                figures[f"{row.key}.{ending}"] = Figure(
                    beside[test][key], unit, f"{row.what}: {what}"
                )
    for key, (slower, faster) in _RATIOS.items():
        if {slower, faster} <= figures.keys():
            figures[key] = ratio(figures[slower], figures[faster], f"{slower} / {faster}")
    yield from figures.items()
    if problems or len(least) < len(FILES[name]):
        raise RuntimeError(
            f"benchmarks of {name} failed or are gone: "
            f"{', '.join(FILES[name].keys() - least.keys())}\n{''.join(problems)}"
        )


def _run(name: str, size: Size, out: Path) -> tuple[list[dict[str, Any]], str]:
    """Run a file of benchmarks; return what pytest-benchmark wrote, and what pytest printed if
    something failed.
    """
    options = [
        "-q",
        "-m",
        "slow",
        "-p",
        "no:xdist",
        "-p",
        "no:cacheprovider",
        "--benchmark-enable",
        "--benchmark-only",
    ]
    if size.repeats == 1:
        options += ["--benchmark-min-rounds=1", "--benchmark-max-time=0.001"]
    selected = [f"{_TESTS}/benchmarks/test_bench_{name}.py::{test}" for test in FILES[name]]
    # A test that measures may itself run in a worker of pytest-xdist, where benchmarks turn
    # themselves off.
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST_")}
    environment["PYTHONPATH"] = os.pathsep.join(
        [str(_TESTS.parent), os.environ.get("PYTHONPATH", "")]
    )
    ran = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            *options,
            f"--benchmark-json={out}",
            f"--basetemp={out.with_suffix('')}",
            *selected,
        ],
        cwd=_TESTS.parent,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    held = json.loads(out.read_text())["benchmarks"] if out.exists() and out.stat().st_size else []
    return held, f"{ran.stdout[-2000:]}{ran.stderr[-500:]}" if ran.returncode else ""
