"""Numbers on pages that nothing writes, and why they are right: most are constants of the code, and
a test compares them.
"""

from __future__ import annotations

import math
import re
from functools import reduce
from importlib import import_module
from typing import Any

FACTS = ("docs/format.md", "docs/packed-format.md")
"""Pages that define files: their numbers are the format."""

# page -> number as it stands there -> module:NAME, or module:NAME[place]
CONSTANTS: dict[str, dict[str, str]] = {
    "docs/commands/audit.md": {
        "0.06 s": "carlasc.inspection.auditing.matching:_SAME_TIME_S",
        "75%": "carlasc.inspection.auditing.geometry:_BELONGS",
        "2%": "carlasc.inspection.auditing.geometry:_ALIKE",
        "1.3 times": "carlasc.inspection.auditing.geometry:_FEWER",
        "6%": "carlasc.inspection.auditing.judging:_FREE",
        "40%": "carlasc.inspection.auditing.judging:_FREE_OF_CLASS",
        "3%": "carlasc.inspection.auditing.judging:_PHANTOM",
        "20%": "carlasc.inspection.auditing.judging:_PHANTOM_OF_CLASS",
        "10%": "carlasc.inspection.auditing.judging:_TRAIL",
        "5%": "carlasc.inspection.auditing.judging:_DOUBLED",
        "30%": "carlasc.inspection.auditing.judging:_OWN",
    },
    "docs/commands/capture.md": {"0.1 s": "carlasc.storage.layout:FRAME_PERIOD_S"},
    "docs/commands/convert.md": {"5%": "carlasc.groundtruth.heights:_BELOW"},
    "docs/commands/demo.md": {"240 MB": "carlasc.demo:_EXTRA_MB"},
    "docs/commands/evaluate.md": {
        "0.05 s": "carlasc.metrics.forecasts:_TOLERANCE_S",
        "2,000 times": "carlasc.metrics.results:_DRAWS",
    },
    "docs/commands/regrid.md": {"2 GB": "carlasc.cli.grid_flags:_LARGE_BYTES"},
    "docs/commands/validate.md": {
        "0.02 s": "carlasc.motion.mounting:_RELEVANT[6]",
    },
    "docs/commands/view.md": {
        "10 frames per second": "carlasc.viewing.rendering.render:_DRIVE_FPS",
        "0.1 s": "carlasc.storage.layout:FRAME_PERIOD_S",
    },
    "docs/ground-truth.md": {
        "5 s": "carlasc.motion.evidence:HORIZON_S",
        "0.5 s": "carlasc.motion.boxes:_SMOOTH_S",
        "0.85 s": "carlasc.groundtruth.from_scans.merging:_DEFORMABLE_S",
        "0.95": "carlasc.groundtruth.from_scans.frame:_DOUBTFUL",
        "0.75": "carlasc.groundtruth.from_scans.frame:_UNSURE",
        "0.05": "carlasc.groundtruth.voting.certainty:GROUND_PER_M",
        "0.15": "carlasc.groundtruth.voting.certainty:SOLID_PER_M",
        "0.02": "carlasc.groundtruth.from_scans.frame:_OUTLIER_PER_M",
    },
    "docs/howto/converter.md": {"0.1 s": "carlasc.storage.layout:FRAME_PERIOD_S"},
    "docs/howto/many-machines.md": {
        "10 s": "carlasc.running.clusters:_CONNECT_S",
        "10 minutes": "carlasc.running.clusters:_WORKERS_S",
    },
    "docs/reliability.md": {
        "10 s": "faults.mutations:CASE_S",
        "1 GiB": "faults.hostile:MEMORY",
        "30 s": "faults.hostile:LIMIT_S",
        "256 MiB": "carlasc.storage.arrays:_MOST_BYTES",
        "64 MiB": "carlasc.storage.arrays:_SMALL",
    },
    "docs/sets/argoverse2.md": {
        "1.35": "carlasc_converters.argoverse2:_ASSUMED_M[0]",
        "1.58": "carlasc_converters.argoverse2:_ASSUMED_M[2]",
    },
    "docs/sets/bag.md": {
        "4 ms": "carlasc_converters.point_fields:_SCAN_S[0]",
        "0.6 s": "carlasc_converters.point_fields:_SCAN_S[1]",
    },
    "docs/sets/carlaocc.md": {"0.1 s": "carlasc_converters.carlaocc:_PERIOD_S"},
    "docs/sets/kitti-tracking.md": {"0.1033 s": "carlasc_converters.kitti_tracking:PERIOD_S"},
    "docs/sets/scans.md": {
        "4 ms": "carlasc_converters.point_fields:_SCAN_S[0]",
        "0.6 s": "carlasc_converters.point_fields:_SCAN_S[1]",
        "0.1 s": "carlasc.storage.layout:FRAME_PERIOD_S",
    },
    "docs/sets/semanticposs.md": {"0.1 s": "carlasc.storage.layout:FRAME_PERIOD_S"},
    "docs/studies/scale.md": {
        "0.25 s": "carlasc.storage.transport.requests:RemoteSettings.backoff_s",
        "0.25": "carlasc.storage.transport.requests:RemoteSettings.backoff_s",
        "10 s": "carlasc.storage.transport.requests:RemoteSettings.longest_wait_s",
    },
    "docs/sets/synthcity.md": {"0.1 s": "carlasc.storage.layout:FRAME_PERIOD_S"},
}

# (page, number or heading of a section) -> why it is right; at most 20
EXCEPTIONS: dict[tuple[str, str], str] = {
    ("docs/performance.md", "20 minutes"): "what a run of `make figures` is allowed to take",
    ("docs/index.md", "0.7 GB"): "the size of a download of torch",
    (
        "docs/commands/audit.md",
        "0.25",
    ): "the step of a list of turns, which the code writes as a range",
    ("docs/commands/audit.md", "95%"): "the kind of an interval",
    ("docs/sets/argoverse2.md", "15 s"): "how long a drive of the data set is, by its authors",
    ("docs/sets/argoverse2.md", "200 MB"): "the size of a download",
    ("docs/sets/carlaocc.md", "0.10"): "a version of CARLA",
    ("docs/sets/kitti-raw.md", "10 s"): "how long a drive of the data set is, by its authors",
    ("docs/sets/kitti-raw.md", "0.1 s"): "how long the scanner needs for a turn, by its maker",
    ("docs/sets/nuscenes.md", "20 s"): "how long a drive of the data set is, by its authors",
    ("docs/storage.md", "100 MiB"): "from where on objects are sent in parts",
    ("docs/studies/networks.md", "## Published results"): "the numbers of the paper",
}

_UNITS = {
    "ms": 1e-3,
    "s": 1,
    "minutes": 60,
    "m": 60,
    "%": 0.01,
    "kB": 1e3,
    "MB": 1e6,
    "GB": 1e9,
    "KiB": 2**10,
    "MiB": 2**20,
    "GiB": 2**30,
}


def value_of(name: str) -> float:
    """Return a constant of the code, in seconds, bytes or as it is."""
    module, _, place = name.partition(":")
    path, index = re.fullmatch(r"([\w.]+)(?:\[(\d+)\])?", place).groups()  # type: ignore[union-attr]
    value: Any = reduce(getattr, path.split("."), import_module(module))
    value = value if index is None else value[int(index)]
    return value_of_text(value) if isinstance(value, str) else float(value)


def value_of_text(text: str) -> float:
    """Return a number of a page, in seconds, bytes, or as it is."""
    number, unit = re.fullmatch(r"([\d.,]+) ?(.*)", text).groups()  # type: ignore[union-attr]
    return float(number.replace(",", "")) * _UNITS.get(unit, 1)


def is_right(text: str, name: str) -> bool:
    """Return whether a number of a page is the constant of the code, or what it leaves of one."""
    shown, value = value_of_text(text), value_of(name)
    plain = float(re.split(r"[ %]", text)[0].replace(",", ""))
    return any(math.isclose(number, value) for number in (shown, plain, 1 - shown))
