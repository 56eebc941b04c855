"""An audit as one page for a browser, with the worst frames drawn: a file that loads nothing else."""

from __future__ import annotations

from html import escape
from pathlib import Path

import numpy as np

from carlasc.core.notebook import describe
from carlasc.core.wording import count
from carlasc.inspection.auditing.audit import frame_errors
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
        table = (
            f"<table><tr><th>check</th><th>verdict</th><th>what was found</th><th>what to do</th></tr>{rows}</table>"
        )
        parts.append(f"<h2>{escape(path)}</h2><p>{about}</p>{table}")
    notes = "".join(f"<br>{escape(note)}" for note in result.notes)
    failed = "".join(f"<br>{escape(f'{f.where}: frame {f.frame}: {f.message}')}" for f in result.failures)
    state = "sound, as far as the drives tell" if result.ok else count(len(result.faults), "fault")
    text = f"Compared with the scans of {escape(result.scans)}: <b>{state}</b>.{notes}{failed}"
    title = f"Audit of {escape(result.grids)}"
    page = fill("audit.html", title=title, summary=text, sequences="".join(parts), pictures=_pictures(result))
    write_output(Path(out), page.encode())


def _row(verdict: Verdict) -> str:
    cells = [escape(text) for text in (verdict.check, verdict.state, verdict.text, verdict.advice)]
    return (
        f'<tr><td>{cells[0]}</td><td class="{verdict.state}">{cells[1]}</td><td>{cells[2]}</td><td>{cells[3]}</td></tr>'
    )


def _pictures(result: AuditResult) -> str:
    figures = []
    for path, number, frame, wrong in result.worst:
        spec, axes, errors = frame_errors(result, path, number, frame)
        drawn = np.where(errors.occupied, 1, 0)
        for color, mask in ((2, errors.phantoms), (3, errors.trails), (4, errors.false_free)):
            drawn[mask] = color
        # an error is drawn above what hides it: the highest layer of a column that has one
        for color in (1, 2, 3, 4):
            column = (drawn == color).any(axis=2)
            drawn[:, :, -1] = np.where(column, color, drawn[:, :, -1])
        picture = spec.seen_from_above(drawn, _PALETTE, left_handed=axes == "left")
        title = f"{path}, scan {frame}: {wrong} wrong voxels"
        figures.append(f"<figure>{describe(title, {}, picture)}</figure>")
    return "".join(figures)
