"""Reports and audits as self-contained HTML pages, with charts in SVG and pictures of the worst
frames.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.core import notebook
from carlasc.core.grids import GridSpec
from carlasc.errors import count
from carlasc.groundtruth.reporting import LEFT_OUT, ActorTrack, PoseFacts, Report
from carlasc.inspection.auditing.audit import voxels_of
from carlasc.inspection.auditing.counting import FALSE_FREE
from carlasc.inspection.auditing.verdicts import STATES, AuditResult, Verdict
from carlasc.inspection.reports import ReportResult
from carlasc.inspection.texts import fill
from carlasc.motion.tracks import is_doubtful
from carlasc.storage.files import write_output
from carlasc.storage.resuming import RECORD

# colour of a bar, and the height of a row in pixels
_BAR = "#3566a8"
_ROW = 18


def write_report_page(result: ReportResult, out: str | Path) -> None:
    """Write reports as one self-contained HTML page.

    Args:
        result: as `report` returns it.
        out: the file.

    Raises:
        StorageError: the file cannot be written.
    """
    title = f"Ground truth of {escape(result.location)}"
    grids = "".join(_section(name, report) for name, report in result.reports.items())
    write_output(Path(out), fill("report.html", title=title, grids=grids).encode())


def describe(report: Report) -> list[tuple[str, str]]:
    """Return the content of a report, as pairs of a name and a text."""
    coverage = report.coverage
    convergence = report.convergence
    frames = report.frames
    span = f" ({frames[0]} to {frames[-1]})" if frames else ""
    rows = {
        "frames": f"{len(frames)}{span}",
        "known": f"{coverage.known_share:.1%} of the voxels",
        "occupied": f"{coverage.occupied_share:.1%} of the known voxels",
    }
    if coverage.mean_votes is not None:
        rows["votes"] = f"{coverage.mean_votes:.1f} per known voxel, on average"
    if convergence is not None:
        rows["convergence"] = (
            f"{convergence.changed_share:.2%} of the known voxels change their label if "
            f"{LEFT_OUT:.0%} of the scans are left out ({count(convergence.frames, 'frame')})"
        )
    if report.actors is not None:
        rows["actors"] = _count(report.actors)
    if report.poses is not None:
        rows["poses"] = _poses(report.poses)
    if report.inferred_share is not None:
        rows["inferred"] = f"{report.inferred_share:.1%} of the known voxels"
    if report.holdout is not None:
        rows["held-out rays"] = _held_out(report.holdout)
    settings = report.settings.get(RECORD)
    if isinstance(settings, dict):
        rows["settings"] = ", ".join(f"{name} {value}" for name, value in settings.items())
    rows["versions"] = ", ".join(f"{name} {value}" for name, value in report.versions.items())
    return [*rows.items()]


def _count(actors: Sequence[ActorTrack]) -> str:
    if not actors:
        return "no moving actor"
    labels = [actor.label for actor in actors]
    kinds = ", ".join(f"{labels.count(label)} {label}" for label in dict.fromkeys(sorted(labels)))
    residuals = sorted(actor.residual_m for actor in actors if actor.residual_m is not None)
    middle = f"; the median residual is {residuals[len(residuals) // 2]:.2f} m" if residuals else ""
    doubtful = sum(is_doubtful(actor.confidence) for actor in actors)
    unsure = f", {doubtful} of them doubtful" if doubtful else ""
    return f"{len(actors)} moving ({kinds}){unsure}{middle}"


def _poses(facts: PoseFacts) -> str:
    if facts.before_m is None or facts.after_m is None:
        return "as given: too few points to measure whether scans agree"
    if not any(facts.changed_m):
        return f"as given: neighbouring scans agree within {100 * facts.before_m:.1f} cm"
    moved = ", ".join(f"{100 * value:.1f}" for value in facts.changed_m)
    turned = ", ".join(f"{math.degrees(value):.2f}" for value in facts.changed_rad)
    text = (
        f"refined: neighbouring scans disagreed by {100 * facts.before_m:.1f} cm, now by "
        f"{100 * facts.after_m:.1f} cm; corrected by {moved} cm along x, y, z and {turned} degrees "
        "of roll, pitch, yaw per scan; the given height drifts by "
        f"{100 * facts.height_drift_m:.0f} cm within 100 scans"
    )
    left = ", ".join(f"{first} to {last}" for first, last in facts.left)
    return f"{text}; as given in frames {left}" if left else text


def _held_out(values: Mapping[str, Any]) -> str:
    rays = values["rays"]
    swept = values["swept"]["occupied_share"]
    if not rays["returns"]:
        return "none"
    text = (
        f"{rays['returns']} returns: {rays['free']:.2%} in free voxels, {rays['unknown']:.2%} in "
        f"unknown ones; {rays['passed_object']:.2%} pass through an object before their return"
    )
    if swept is not None:
        text += f"; {swept:.2%} of the voxels that the ego vehicle drove through are occupied"
    if given := values.get("given_poses"):
        text += f"; under the given poses {given['free']:.2%} are in free voxels, "
        text += f"{given['unknown']:.2%} in unknown ones"
    return text


def _section(name: str, report: Report) -> str:
    coverage = report.coverage
    known = max(report.coverage.known, 1)
    classes = sorted(
        ((label, count / known) for label, count in coverage.classes.items()),
        key=lambda pair: -pair[1],
    )
    votes = [(_bin_name(power), count / known) for power, count in enumerate(coverage.votes)]
    spec = GridSpec.from_params(report.settings, name)
    frames = report.frames
    digests = {field: digest.all for field, digest in report.digests.items()}
    digests |= {field: digest.digest for field, digest in report.documents.items()}
    held_out = ""
    actors = ""
    if report.holdout and report.holdout["by_distance"]:
        held_out = _part("Held-out rays", _held_out_table(report.holdout))
    if report.actors:
        content = f"{_timeline(report.actors, frames)}\n{_actor_table(report.actors)}"
        actors = _part("Moving actors by frame", content)
    return fill(
        "report-grid.html",
        name=escape(name),
        coordinates=spec.coordinates,
        size=" x ".join(map(str, spec.size)),
        figures=_table([], describe(report)),
        classes=_bars(classes),
        votes=_part("Known voxels by their number of votes", _bars(votes)) if votes else "",
        held_out=held_out,
        actors=actors,
        digests=_table(["file", "digest"], digests.items()),
    )


def _part(title: str, content: str) -> str:
    return f"<h3>{title}</h3>\n{content}\n"


def _table(
    header: Iterable[str], rows: Iterable[Iterable[object]], *, figures: bool = False
) -> str:
    """Return a table; with `figures`, all columns except the first hold numbers."""

    def line(cells: Iterable[object], tag: str) -> str:
        parts = []
        for column, cell in enumerate(cells):
            kind = ' class="n"' if figures and column else ""
            parts.append(f"<{tag}{kind}>{'' if cell is None else escape(str(cell))}</{tag}>")
        return f"<tr>{''.join(parts)}</tr>"

    head = line(header, "th") if header else ""
    return f"<table>{head}{''.join(line(row, 'td') for row in rows)}</table>"


def _bars(rows: Sequence[tuple[str, float]]) -> str:
    """Return horizontal bars of shares; a square-root scale shows small shares, too."""
    lines = []
    for row, (label, share) in enumerate(rows):
        width = 520 * share**0.5
        lines += _bar(row, label, 130, width)
        lines.append(f'<text x="{136 + width:.1f}" y="{row * _ROW + 13}">{share:.2%}</text>')
    return _svg(720, len(rows) * _ROW, lines)


def _bar(row: int, label: str, x: float, width: float, more: str = "") -> list[str]:
    y = row * _ROW
    place = f'x="{x:.1f}" y="{y + 3}" width="{width:.1f}" height="12"'
    return [
        f'<text x="0" y="{y + 13}">{escape(label)}</text>',
        f'<rect {place} fill="{_BAR}"{more}/>',
    ]


def _timeline(actors: Sequence[ActorTrack], frames: Sequence[int]) -> str:
    """Return one bar per actor, from its first to its last frame; it is paler if fewer frames in
    between show the actor.
    """
    first = min([*(actor.first for actor in actors), *frames[:1]])
    last = max([*(actor.last for actor in actors), *frames[-1:]])
    scale = 560 / max(last - first, 1)
    lines = []
    for row, actor in enumerate(actors):
        name = f"{actor.label} {actor.instance or ''}".strip()
        length = actor.last - actor.first
        opacity = f' fill-opacity="{actor.observations / (length + 1):.2f}"'
        x = 130 + (actor.first - first) * scale
        width = max(length * scale, 2)
        lines += _bar(row, name, x, width, opacity)
    axis = len(actors) * _ROW + 14
    lines += [f'<text x="130" y="{axis}">{first}</text>', f'<text x="680" y="{axis}">{last}</text>']
    return _svg(720, axis + 6, lines)


def _svg(width: int, height: int, lines: Sequence[str]) -> str:
    size = f'viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
    return f'<svg {size} font-size="12">{"".join(lines)}</svg>'


def _actor_table(actors: Sequence[ActorTrack]) -> str:
    rows = [
        {
            "class": actor.label,
            "instance": actor.instance or None,
            "first": actor.first,
            "last": actor.last,
            "observations": actor.observations,
            "points": actor.points,
            "m/s": f"{actor.speed_m_s:.1f}",
            "size, m": " x ".join(f"{side:.1f}" for side in actor.size_m),
            "residual, m": _metres(actor.residual_m),
            "static, m": _metres(actor.residual_static_m),
            "sure": f"{actor.confidence:.0%}",
        }
        for actor in actors
    ]
    table = _table(rows[0], [row.values() for row in rows], figures=True)
    return f"<details><summary>Table of the actors</summary>{table}</details>"


def _held_out_table(values: Mapping[str, Any]) -> str:
    shares = ("free", "unknown", "occupied", "passed", "passed_object", "missed")
    rows = []
    for label, rays in {
        "all": values["rays"],
        **values["by_distance"],
        **values["by_class"],
    }.items():
        row = {"rays": label, "returns": rays["returns"]}
        for name in shares:
            row[name.replace("_", " ")] = None if rays[name] is None else f"{rays[name]:.2%}"
        row |= {"error, m": _metres(rays["error_median_m"]), "90%, m": _metres(rays["error_90_m"])}
        rows.append(row)
    return _table(rows[0], [row.values() for row in rows], figures=True)


def _metres(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _bin_name(power: int) -> str:
    return "1" if power == 0 else f"{2**power} to {2 ** (power + 1) - 1}"


_PALETTE = np.array(
    [(255, 255, 255), (200, 204, 208), (30, 90, 200), (235, 130, 20), (215, 30, 30)], np.uint8
)


def write_audit_page(result: AuditResult, out: str | Path) -> None:
    """Write an audit as one self-contained HTML page.

    Args:
        result: as `audit` returns it; its grids and scans are read again for the pictures.
        out: the file.

    Raises:
        StorageError: the file cannot be written.
        CarlascError: a frame in a picture can no longer be read.
    """
    parts = []
    for path, verdicts in result.verdicts.items():
        rows = "".join(map(_row, sorted(verdicts, key=lambda v: STATES.index(v.state))))
        placed = escape(result.placed[path])
        frames = count(result.frames[path], "frame")
        about = f"{frames}; coordinate frame of the grids: {placed}."
        head = "<tr><th>check</th><th>verdict</th><th>what was found</th><th>what to do</th></tr>"
        parts.append(f"<h2>{escape(path)}</h2><p>{about}</p><table>{head}{rows}</table>")
    failed = [f"{f.where}: frame {f.frame}: {f.message}" for f in result.failures]
    lines = "".join(f"<br>{escape(text)}" for text in (*result.notes, *failed))
    state = "sound, as far as the drives tell" if result.ok else count(len(result.faults), "fault")
    text = f"Compared with the scans of {escape(result.scans)}: <b>{state}</b>.{lines}"
    title = f"Audit of {escape(result.grids)}"
    page = fill(
        "audit.html",
        title=title,
        summary=text,
        sequences="".join(parts),
        pictures=_pictures(result),
    )
    write_output(Path(out), page.encode())


def _row(verdict: Verdict) -> str:
    check, state, text, advice, more = map(
        escape, (verdict.check, verdict.state, verdict.text, verdict.advice, verdict.details)
    )
    more = (
        f"<details><summary>by class, distance and height</summary>{more}</details>" if more else ""
    )
    cells = f"<td>{text}{more}</td><td>{advice}</td>"
    return f'<tr><td>{check}</td><td class="{state}">{state}</td>{cells}</tr>'


def _pictures(result: AuditResult) -> str:
    figures = []
    for path, number, frame, wrong in result.worst:
        one, drawn = voxels_of(result, path, number, frame)
        # errors are drawn in the highest layer, where nothing hides them
        for kind in range(1, FALSE_FREE + 1):
            drawn[:, :, -1] = np.where((drawn == kind).any(axis=2), kind, drawn[:, :, -1])
        picture = one.spec.seen_from_above(drawn, _PALETTE, left_handed=one.axes == "left")
        title = f"{path}, scan {frame}: {count(wrong, 'wrong voxel')}"
        figures.append(f"<figure>{notebook.describe(title, {}, picture)}</figure>")
    return "".join(figures)
