"""The kinds of faults, and what was found, as the documentation shows it: `measuring` puts it into
the pages.
"""

from __future__ import annotations

import dataclasses
import datetime
import json
import os
import subprocess
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from faults.outcome import Outcome

ROOT = Path(__file__).parents[3]
FIGURES = ROOT / "docs" / "studies" / "faults.json"


@dataclass(frozen=True)
class Kind:
    """A kind of fault.

    Attributes:
        module: where its function `run(count, seed, folder)` is.
        cases: what its cases are called.
        what: what is done and checked, for the table.
        quick: number of cases that take minutes.
        long: number of cases that take hours.
    """

    module: str
    cases: str
    what: str
    quick: int
    long: int


KINDS = {
    "kills": Kind(
        "faults.kills",
        "kills",
        "A command is ended by a signal (SIGKILL, SIGTERM, SIGINT) at a random moment and run "
        "again, up to three times: the bytes are those of an undisturbed run, and nothing is left "
        "over",
        100,
        1000,
    ),
    "calls": Kind(
        "faults.calls",
        "failed system calls",
        "The k-th open, write, rename, sync or read of a command fails (EIO, ENOSPC, EDQUOT), or "
        "the process ends there: one line, and the next run completes",
        500,
        100_000,
    ),
    "crashes": Kind(
        "faults.crashes",
        "power losses",
        "The writes of a command are replayed up to a random point, and what was not synced is "
        "dropped, reordered or zeroed: every reader finds a file whole or not at all",
        500,
        100_000,
    ),
    "changes": Kind(
        "faults.changes",
        "changed inputs",
        "An input of a finished command changes (values, length, removed, text, time only), and the "
        "command runs again: the result is that of a run into an empty folder, or the run is "
        "refused",
        200,
        5_000,
    ),
    "large": Kind(
        "faults.large",
        "commands on large data",
        "Frames, sequences, points of a scan and voxels double twice: in the second doubling, an "
        "item costs no more time and memory than in the first",
        1,
        1_000,
    ),
    "mutations": Kind(
        "faults.mutations",
        "damaged files",
        "A file of any format is damaged: it is refused in one line, within bounded memory and time",
        20_000,
        1_000_000,
    ),
    "coverage": Kind(
        "faults.coverage",
        "inputs of libFuzzer",
        "The same, guided by the lines of carlasc that an input reaches (atheris, where it is "
        "installed)",
        5_000,
        500_000,
    ),
    "hostile": Kind(
        "faults.hostile",
        "hostile files",
        "Files and servers that were made to do harm: each is refused in one line that names it, "
        "and nothing outside the output is created",
        1_000,
        1_000,
    ),
}
"""Every kind, in the order of the table. A kind that has no module yet is left out of a run."""


def keep(
    outcome: Outcome, date: datetime.date, code: str | None = None, *, add: bool = False
) -> None:
    """Write an outcome into the figures, in place of the one of its kind, or added to it.

    Args:
        outcome: the outcome.
        date: when its cases were run.
        code: when the code that they were run with changed last; None: the code of now.
        add: whether it is added.
    """
    rows = read()
    row = dataclasses.asdict(outcome) | {"seconds": round(outcome.seconds)}
    run = {"date": date.isoformat(), "code": code or code_changed()}
    runs = Counter({tuple(run.values()): outcome.tried})
    if add and (before := rows.get(outcome.kind)):
        row |= {name: before[name] + row[name] for name in ("tried", "found", "seconds")}
        row["commands"] = dict(Counter(before.get("commands", {})) + Counter(outcome.commands))
        runs.update({(one["date"], one["code"]): one["tried"] for one in before["runs"]})
    listed = [dict(zip(run, key, strict=True), tried=tried) for key, tried in sorted(runs.items())]
    write(rows | {outcome.kind: {"date": run["date"], **row, "runs": listed}})


def write(rows: dict[str, dict[str, Any]]) -> None:
    """Write the figures, with when the code changed last."""
    kept = {kind: rows[kind] for kind in KINDS if kind in rows}
    FIGURES.write_text(json.dumps({"code": code_changed(), **kept}, indent=2) + "\n")


def code_changed() -> str:
    """Return when the package or the converters changed last, by the commits: "2026-11-26
    19:21", in UTC.
    """
    code, utc = ("--", "carlasc", "converters"), {**os.environ, "TZ": "UTC"}
    command = ["git", "log", "-1", "--date=format-local:%Y-%m-%d %H:%M", "--format=%cd", *code]
    done = subprocess.run(command, cwd=ROOT, env=utc, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def read() -> dict[str, dict[str, Any]]:
    """Return the figures of each kind that was run."""
    held = json.loads(FIGURES.read_text()) if FIGURES.exists() else {}
    return {kind: held[kind] for kind in KINDS if kind in held}


def known_code() -> str:
    """Return when the code changed last, as the documentation says."""
    return str(json.loads(FIGURES.read_text())["code"])


def runs(rows: dict[str, dict[str, Any]], code: str) -> str:
    """Return which cases were run when, and with which code, as a table and a sentence."""
    lines = ["| kind | cases | run on | code of | changed since |", "|---|---|---|---|---|"]
    for name, row in rows.items():
        lines += [
            f"| {name} | {one['tried']:,} | {one['date']} | {one['code']} | "
            f"{'no' if one['code'] == code else 'yes'} |"
            for one in row.get("runs", ())
        ]
    return "\n".join([*lines, "", f"The code changed last on {code} (UTC)."])


def large(rows: dict[str, dict[str, Any]]) -> str:
    """Return the table of what large data cost."""
    lines = [
        "| command | largest data | CPU time of a quarter, half and all, s | memory, MB |",
        "|---|---|---|---|",
    ]
    for name, size, seconds, kilobytes in rows.get("large", {}).get("measured", ()):
        cost = ", ".join(f"{one:.3g}" if one < 1000 else f"{one:,.0f}" for one in seconds)
        memory = ", ".join(f"{one / 1e3:,.0f}" for one in kilobytes)
        lines.append(f"| `{name}` | {size} | {cost} | {memory} |")
    return "\n".join(lines)


def table(rows: dict[str, dict[str, Any]]) -> str:
    """Return the table of the documentation."""
    lines = [
        "| kind | what is done, and what must hold | cases | faults found | minutes | date |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in rows.items():
        minutes = max(1, round(row["seconds"] / 60))
        lines.append(
            f"| {name} | {KINDS[name].what} | {row['tried']:,} | {len(row['found'])} | {minutes} | "
            f"{row['date']} |"
        )
    return "\n".join(lines)


def commands(rows: dict[str, dict[str, Any]]) -> str:
    """Return the table of the number of cases of each command."""
    kinds = {name: row["commands"] for name, row in rows.items() if row.get("commands")}
    lines = [f"| command | {' | '.join(kinds)} |", "|---|" + "---|" * len(kinds)]
    for command in sorted({command for counts in kinds.values() for command in counts}):
        counts = " | ".join(f"{counts.get(command, 0):,}" for counts in kinds.values())
        lines.append(f"| `{command}` | {counts} |")
    return "\n".join(lines)


def line(rows: dict[str, dict[str, Any]]) -> str:
    """Return the line of the README."""
    small = {name: row for name, row in rows.items() if name != "large"}
    tried = [f"{row['tried']:,} {KINDS[name].cases}" for name, row in small.items()]
    listed = " and ".join(filter(None, (", ".join(tried[:-1]), tried[-1])))
    found = sum(len(row["found"]) for row in rows.values())
    result = f"{found} faults found" if found else "no torn file, no lost frame"
    kills = rows.get("kills", {}).get("tried", 0)
    # None of n independent tries failed: with a confidence of 95%, fewer than 3 / n of all do.
    bound = (
        f" The share of kills with a fault is below {3 / kills:.1%} with a confidence of 95%."
        if kills and not found
        else ""
    )
    dates = sorted(row["date"] for row in rows.values())
    days = " to ".join(dict.fromkeys([dates[0], dates[-1]]))
    return (
        f"**Reliability**, tested with data of two frames ({days}): {listed}; {result}.{bound} "
        "[Figures and promises](docs/reliability.md)."
    )
