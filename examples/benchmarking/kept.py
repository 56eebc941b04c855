"""One file with the results of all runs, small enough to be kept beside the pages: what
`benchmark_page.py` makes tables of.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarking.runs import Result


def note(path: Path, study: str, row: str, result: Result) -> None:
    """Add a run to the file. A run that it has is replaced."""
    kept = (
        json.loads(path.read_text())
        if path.exists()
        else {"scenes": result.settings["scenes"], "studies": {}}
    )
    values = vars(result) | {"drives": result.drives.tolist(), "settings": result.settings["run"]}
    kept["studies"].setdefault(study, {}).setdefault(row, {})[
        str(result.settings["run"]["seed"])
    ] = values
    part = path.with_suffix(".part")
    part.write_text(_lines(kept))
    part.replace(path)


def read(path: Path) -> dict[str, dict[str, list[Result]]]:
    """Return the runs of each row of each study, in the order of their seeds."""
    kept = json.loads(path.read_text())
    return {
        study: {
            name: [_result(runs[seed], kept["scenes"]) for seed in sorted(runs)]
            for name, runs in rows.items()
        }
        for study, rows in kept["studies"].items()
    }


def _result(values: Mapping[str, Any], scenes: Mapping[str, Any]) -> Result:
    settings = {"scenes": scenes, "run": values["settings"]}
    return Result(
        **{**values, "settings": settings, "drives": np.array(values["drives"], np.int64)}
    )


def _lines(kept: Mapping[str, Any]) -> str:
    """Return JSON with a line for each run, so that what changes can be seen."""
    studies = []
    for study, rows in kept["studies"].items():
        texts = []
        for name, runs in rows.items():
            lines = ",\n".join(
                f"   {json.dumps(seed)}: {json.dumps(run, separators=(',', ':'))}"
                for seed, run in runs.items()
            )
            texts.append(f"  {json.dumps(name)}: {{\n{lines}\n  }}")
        body = ",\n".join(texts)
        studies.append(f" {json.dumps(study)}: {{\n{body}\n }}")
    body = ",\n".join(studies)
    return f'{{"scenes": {json.dumps(kept["scenes"])},\n"studies": {{\n{body}\n}}}}\n'
