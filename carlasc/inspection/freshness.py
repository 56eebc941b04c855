"""Whether the files of a grid are still those that its report was made from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from carlasc.errors import CarlascError
from carlasc.groundtruth.reporting.facts import digest_of
from carlasc.groundtruth.reporting.report import Report, short
from carlasc.inspection.findings import Finding
from carlasc.storage import layout
from carlasc.storage.protocol import Sequence

_ADVICE = "make the report again with `carlasc report --remake --save`, or the grid with `carlasc regrid --overwrite`"


class Freshness:
    """Compares the files of a sequence with the reports beside its grids.

    Args:
        sequence: the sequence; grids without a report are left out.
    """

    def __init__(self, sequence: Sequence) -> None:
        self.sequence = sequence
        self.reports: dict[str, Report] = {}
        self._damaged: list[Finding] = []
        self._rows: dict[str, dict[int, int]] = {}
        self._compared: dict[str, int] = {}
        self._changed: dict[tuple[str, str], list[int]] = {}  # frames by grid and field
        for name in sequence.documents():
            grid, _, file = name.rpartition("/")
            if file == layout.REPORT:
                self._read(grid, name)

    def _read(self, grid: str, name: str) -> None:
        where = f"{self.sequence.location}/{name}"
        try:
            report = Report.from_json(self.sequence.read_document(name), where)
        except CarlascError as error:
            finding = Finding.from_error("report", self.sequence.path, where, error, _ADVICE)
            self._damaged.append(replace(finding, severity="warning"))
            return
        self.reports[grid] = report
        self._rows[grid] = {frame: row for row, frame in enumerate(report.frames)}

    def compare(self, frame: int) -> None:
        """Compare the files of one frame. Files that cannot be read are skipped: other checks report them."""
        seen: dict[str, str | None] = {}
        for grid, report in self.reports.items():
            row = self._rows[grid].get(frame)
            if row is None:
                continue
            self._compared[grid] = self._compared.get(grid, 0) + 1
            for field, digests in report.digests.items():
                if field not in seen:
                    seen[field] = self._digest(field, frame)
                if seen[field] is not None and seen[field] != (digests.of(row) or ""):
                    self._changed.setdefault((grid, field), []).append(frame)

    def _digest(self, field: str, frame: int) -> str | None:
        """Return the digest of a field of a frame, "" if it does not exist; None if it cannot be read."""
        if frame not in self.sequence.frames(field):
            return ""
        try:
            return short(digest_of(field, self.sequence.read(field, frame)))
        except (CarlascError, OSError):
            return None

    def findings(self) -> Iterator[Finding]:
        """Yield what differs from the reports."""
        yield from self._damaged
        for grid, report in self.reports.items():
            yield from self._settings(grid, report)
            frames = self._compared.get(grid, 0)
            for (own, field), changed in self._changed.items():
                if own == grid:
                    what = f"{len(changed)} of {frames} compared frames changed since, the first is {changed[0]}"
                    yield self._finding(grid, f"the {field} that its report was made from", what)

    def _settings(self, grid: str, report: Report) -> Iterator[Finding]:
        if report.settings != self.sequence.params(grid):
            yield self._finding(grid, "the settings in its report", "another params.json")
        for name, digest in report.documents.items():
            if name == layout.params_file(grid):
                continue
            exists = name in self.sequence.documents()
            if not exists or not digest.matches(self.sequence.read_document(name)):
                found = f"a {name} that changed since" if exists else f"no {name}"
                yield self._finding(grid, f"the {name} that its report was made from", found)
        missing = set(self.sequence.frames(f"{grid}/labels").tolist()) - set(report.frames)
        if missing:
            finding = self._finding(grid, "a report of all frames", f"{len(missing)} frames that it does not cover")
            yield replace(finding, severity="note")

    def _finding(self, grid: str, expected: str, found: str) -> Finding:
        where = f"{self.sequence.location}/{grid}"
        return Finding("warning", "report", self.sequence.path, where, expected, found, _ADVICE)
