"""An audit as one page for a browser, with the worst frames drawn: a file that loads nothing else."""

from __future__ import annotations

from html import escape
from pathlib import Path

import numpy as np

from carlasc.core.notebook import describe
from carlasc.core.wording import count
from carlasc.inspection.auditing.audit import voxels_of
from carlasc.inspection.auditing.counting import FALSE_FREE
from carlasc.inspection.auditing.verdicts import STATES, AuditResult, Verdict
from carlasc.inspection.texts import fill
from carlasc.storage.files import write_output

_PALETTE = np.array([(255, 255, 255), (200, 204, 208), (30, 90, 200), (235, 130, 20), (215, 30, 30)], np.uint8)


def write_audit_page(result: AuditResult, out: str | Path) -> None:
    """Write an audit as one self-contained HTML page.

    Args:
        result: as `audit` returns it; its grids and scans are read again for the pictures.
        out: the file.

    Raises:
        StorageError: the file cannot be written.
        CarlascError: a frame that is drawn cannot be read any more.
    """
    parts = []
    for path, verdicts in result.verdicts.items():
        rows = "".join(map(_row, sorted(verdicts, key=lambda v: STATES.index(v.state))))
        about = f"{result.frames[path]} frames; the frame of the grids: {escape(result.placed[path])}."
        head = "<tr><th>check</th><th>verdict</th><th>what was found</th><th>what to do</th></tr>"
        parts.append(f"<h2>{escape(path)}</h2><p>{about}</p><table>{head}{rows}</table>")
    failed = [f"{f.where}: frame {f.frame}: {f.message}" for f in result.failures]
    lines = "".join(f"<br>{escape(text)}" for text in (*result.notes, *failed))
    state = "sound, as far as the drives tell" if result.ok else count(len(result.faults), "fault")
    text = f"Compared with the scans of {escape(result.scans)}: <b>{state}</b>.{lines}"
    title = f"Audit of {escape(result.grids)}"
    page = fill("audit.html", title=title, summary=text, sequences="".join(parts), pictures=_pictures(result))
    write_output(Path(out), page.encode())


def _row(verdict: Verdict) -> str:
    check, state, text, advice, more = map(
        escape, (verdict.check, verdict.state, verdict.text, verdict.advice, verdict.details)
    )
    more = f"<details><summary>by class, distance and height</summary>{more}</details>" if more else ""
    return f'<tr><td>{check}</td><td class="{state}">{state}</td><td>{text}{more}</td><td>{advice}</td></tr>'


def _pictures(result: AuditResult) -> str:
    figures = []
    for path, number, frame, wrong in result.worst:
        one, drawn = voxels_of(result, path, number, frame)
        for kind in range(1, FALSE_FREE + 1):  # an error is drawn above what hides it, in the highest layer
            drawn[:, :, -1] = np.where((drawn == kind).any(axis=2), kind, drawn[:, :, -1])
        picture = one.spec.seen_from_above(drawn, _PALETTE, left_handed=one.axes == "left")
        figures.append(f"<figure>{describe(f'{path}, scan {frame}: {wrong} wrong voxels', {}, picture)}</figure>")
    return "".join(figures)
