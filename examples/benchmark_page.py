"""The tables of docs/studies/networks.md, made of the results of `benchmark.py`: `python
examples/benchmark_page.py WORK/medium/results.json`.

The results are kept beside the page (networks.json), and its tables are made of them. Without an
argument the tables are made again of what is kept. A row has as many runs as every row of its study
has: a study that was stopped shows fewer seeds, not rows that differ.
"""

from __future__ import annotations

import csv
import io
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmark import ROWS, Study
from benchmarking.kept import read
from benchmarking.rows import CAPTURE_TRUTH, HITS
from benchmarking.runs import Result
from benchmarking.sizes import SIZES
from benchmarking.tables import (
    CAUSES,
    LABELS,
    MIOU,
    NETWORK,
    VEHICLES,
    Figure,
    class_figures,
    difference,
    figure_row,
    figure_table,
    spread,
    to_markdown,
    with_interval,
)

from carlasc.metrics import FigureTable

STUDIES = Path(__file__).parents[1] / "docs" / "studies"
KEPT, PAGE, EVERY_CLASS = (
    STUDIES / "networks.json",
    STUDIES / "networks.md",
    STUDIES / "networks-1.csv",
)
OURS = "Baseline T=5"
_BLOCK = re.compile(r"(<!-- study: ([\w-]+) -->\n).*?(<!-- study end -->)", re.DOTALL)
Groups = Mapping[str, Sequence[Result]]


def tables(kept: Mapping[str, Groups]) -> dict[str, str]:
    """Return the text of each block of the page."""
    studies = {name: _equally(name, groups) for name, groups in kept.items()}
    makers = {
        "networks": _networks,
        "differences": _differences,
        "labels": _labels,
        "rays": _rays,
        "history": _history,
        "js3cnet": _js3cnet,
    }
    study_of = {"differences": "networks", "rays": "parts"}
    made = {}
    for name, make in makers.items():
        study = study_of.get(name, name)
        if groups := studies.get(study):
            made[name] = f"{make(groups)}\n\n{_runs(groups)}{_missing(study, groups)}"
        else:
            made[name] = (
                f"Not run: `python examples/benchmark.py WORK --size medium --study {study}` makes "
                f"this table."
            )
    return made


def every_class(groups: Groups) -> str:
    """Return the table of networks with all classes, as CSV."""
    figures = {**NETWORK, **class_figures()}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["network", *figures])
    writer.writerows(
        [name, *figure_row(runs, figures)] for name, runs in _equally("networks", groups).items()
    )
    return text.getvalue()


def fill(page: str, made: Mapping[str, str]) -> str:
    """Return a page with its blocks filled."""
    return _BLOCK.sub(lambda found: f"{found[1]}\n{made[found[2]]}\n\n{found[3]}", page)


def _equally(study: str, groups: Groups) -> dict[str, Sequence[Result]]:
    """Return the rows of a study in their order, with as many runs of each as every row has."""
    count = min(map(len, groups.values()))
    names = [row.name for row in ROWS[Study(study)](SIZES["medium"])]
    return {name: groups[name][:count] for name in names if name in groups}


def _runs(groups: Groups) -> str:
    """Return what the runs of a table have in common."""
    runs = next(iter(groups.values()))
    seeds = f"{len(runs)} seeds" if len(runs) > 1 else "one seed"
    epochs, drives = runs[0].settings["run"]["epochs"], len(runs[0].drives)
    frames = runs[0].frames // drives
    return f"Each row: {seeds}, {epochs} epochs, {drives} test drives of {frames} frames."


def _missing(study: str, groups: Groups) -> str:
    """Return which rows of a study, or which of its seeds, have not been run."""
    rows = ROWS[Study(study)](SIZES["medium"])
    text = (
        [f"Not run yet: {'; '.join(names)}."]
        if (names := [row.name for row in rows if row.name not in groups])
        else []
    )
    done = min(map(len, groups.values()))
    if done < max(row.seeds for row in rows):
        text.append("More seeds are planned.")
    return " ".join(["", *text, f"`--study {study}` goes on."]) if text else ""


def _rate(runs: Sequence[Result]) -> str:
    return f"{runs[0].settings['run']['learning_rate']:g}"


def _networks(groups: Groups) -> str:
    rows = []
    for name, runs in groups.items():
        network, weighting = name.rsplit(", ", 1)
        rows.append((network, weighting, _rate(runs), *figure_row(runs, NETWORK)))
    return to_markdown(
        FigureTable("", ("network", "class weights", "learning rate", *NETWORK), tuple(rows))
    )


def _differences(groups: Groups) -> str:
    """Return how much each network is better than ours with the same weights, and what the weights
    change.
    """
    rows = []
    for network in dict.fromkeys(name.rsplit(", ", 1)[0] for name in groups):
        of = [groups.get(f"{network}, {weighting}") for weighting in ("log", "root")]
        ours = [groups.get(f"{OURS}, {weighting}") for weighting in ("log", "root")]
        pairs = [(of[0], ours[0]), (of[1], ours[1]), (of[1], of[0])]
        rows.append(
            (
                network,
                *(_compare(*pair, NETWORK[MIOU]) for pair in pairs),
                *(_compare(*pair, NETWORK[VEHICLES]) for pair in pairs),
            )
        )
    kinds = ("against ours, log", "against ours, root", "root against log")
    header = ("network", *(f"{figure}: {kind}" for figure in (MIOU, VEHICLES) for kind in kinds))
    return to_markdown(FigureTable("", header, tuple(rows)))


def _compare(
    first: Sequence[Result] | None, second: Sequence[Result] | None, figure: Figure
) -> str:
    if not first or not second or first is second:
        return ""
    return with_interval(difference(first, second, figure))


def _against(
    groups: Groups, rival: str, names: Sequence[str], figures: Mapping[str, Figure]
) -> str:
    """Return the differences of rows from one of them."""
    rows = tuple(
        (name, *(_compare(groups[name], groups[rival], figure) for figure in figures.values()))
        for name in names
        if name != rival
    )
    return to_markdown(FigureTable("", (f"against {rival}", *figures), rows))


def _labels(groups: Groups) -> str:
    parts = [to_markdown(figure_table("", groups, LABELS))]
    if CAPTURE_TRUTH in groups:
        parts.append(_against(groups, CAPTURE_TRUTH, list(groups), LABELS))
    rows = tuple(
        (
            name,
            *(
                spread([100 * getattr(run, error) for run in runs])
                for error in ("ece_free", "ece_occupied")
            ),
        )
        for name, runs in groups.items()
    )
    parts.append(to_markdown(FigureTable("", ("trained on", "ECE, free", "ECE, occupied"), rows)))
    return "\n\n".join(parts)


def _rays(groups: Groups) -> str:
    parts = [to_markdown(figure_table("", groups, CAUSES))]
    for weighting in ("log", "root"):
        hits, rays = f"{HITS}, {weighting}", f"{OURS}, {weighting}"
        if hits in groups and rays in groups:
            parts.append(_against(groups, rays, [hits], CAUSES))
    return "\n\n".join(parts)


def _history(groups: Groups) -> str:
    parts = [to_markdown(figure_table("", groups, NETWORK))]
    for network in ("MotionSC", "Baseline"):
        rows = [name for name in groups if name.startswith(network)]
        if f"{network} T=1" in rows:
            parts.append(_against(groups, f"{network} T=1", rows, NETWORK))
    return "\n\n".join(parts)


def _js3cnet(groups: Groups) -> str:
    (runs,) = groups.values()
    steps = spread([run.train_s for run in runs])
    return f"{to_markdown(figure_table('', groups, NETWORK))}\n\nTraining took {steps} s."


def main(arguments: Sequence[str]) -> None:
    """Keep the results, and write the page and the CSV beside it."""
    if arguments:
        KEPT.write_text(Path(arguments[0]).read_text())
    kept = read(KEPT)
    PAGE.write_text(fill(PAGE.read_text(), tables(kept)))
    EVERY_CLASS.write_text(every_class(kept["networks"]))


if __name__ == "__main__":
    main(sys.argv[1:])
