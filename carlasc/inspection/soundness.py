"""What data must show to be called sound: the checks that a grid needs, which scans and grids can
fail or leave open, and those that a user accepts.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from carlasc.core.arrays import Float32Array, FloatArray
from carlasc.core.scans import ScanCentres
from carlasc.errors import ArgumentError, CarlascError
from carlasc.inspection.findings import Finding, State
from carlasc.motion.ground import ground_plane
from carlasc.storage import layout
from carlasc.storage.folder import FolderSequence, FolderWriter
from carlasc.storage.protocol import Sequence, Source

RANGE = "range"
GROUND = "ground"
OVERLAP = "poses-on-scans"
OCCUPIED = "occupied"
CHECKS = {
    RANGE: "points near the sensor",
    GROUND: "level ground below the sensor",
    OVERLAP: "scans that overlap under the poses",
    OCCUPIED: "occupied voxels",
}
"""What a grid needs, and what data must show for it. `SequenceReport.checks` has those that apply
to a sequence, and those that its converter recorded.
"""
ACCEPTED: Final = "accepted"
_FRAMES = "move each scan to the frame of its sensor, and write the poses of the sensor"
_UPRIGHT = "convert again with `--level`, or with the right axes or mount"

_FAR_M = 500.0  # no LiDAR sees farther
_FEW = 0.001  # a greater share of such points is wrong; fact: far-points
_TILT = 0.16  # slope of the ground against the sensor, above which grids are tilted
_STEEPEST = 0.8  # greatest slope that is looked for
_ABOVE_M = -0.05  # ground that is higher than this below the sensor is above it
_SEEN = 0.5  # ground must be found in this share of the scans
_EMPTY = 0.1  # greatest share of grids without an occupied voxel; fact: empty-grids


@dataclass
class ScanFacts:
    """What the scans and grids of a sequence show, frame by frame.

    Attributes:
        occupied: by grid, whether each frame has an occupied voxel.
    """

    occupied: dict[str, list[bool]] = field(default_factory=dict)
    _scans: int = 0
    _far: list[float] = field(default_factory=list)
    _planes: list[FloatArray | None] = field(default_factory=list)
    _centres: ScanCentres = field(default_factory=ScanCentres)

    def add(self, points: Float32Array) -> None:
        """Add the (N, 3) points of the next scan, metres, finite."""
        self._scans += 1
        points = points[points.any(axis=1)]  # no-returns are at the sensor
        if len(points):
            self._far.append(float((np.abs(points).max(axis=1) > _FAR_M).mean()))
            plane = ground_plane(points)
            self._planes.append(ground_plane(points, _STEEPEST) if plane is None else plane)
            self._centres.add(points)

    def made(self, sequence: Sequence) -> list[str]:
        """Return those of `CHECKS` that `findings` makes."""
        of_scans = [RANGE, GROUND] if sequence.metadata.has_rays else [RANGE]
        return [OCCUPIED] * bool(self.occupied) + of_scans * bool(self._scans)

    def findings(self, sequence: Sequence) -> Iterator[Finding]:
        """Yield what is wrong with ranges, ground and grids, or what they leave open."""
        for grid, occupied in self.occupied.items():
            empty = occupied.count(False)
            if empty > _EMPTY * len(occupied):
                where = f"{sequence.location}/{grid}"
                found = f"none in {empty} of {len(occupied)} frames"
                expected = CHECKS[OCCUPIED]
                advice = "check the bounds of the grid"
                yield Finding("warning", OCCUPIED, where, expected, found, advice)
        where = f"{sequence.location}/points"
        if not self._far:
            if self._scans:  # other checks report scans that cannot be read
                yield untested(RANGE, where, "no scan that was read has points")
            return
        if (far := float(np.mean(self._far))) > _FEW:
            found = f"{far:.1%} of the points more than {_FAR_M:g} m away"
            yield Finding("error", RANGE, where, CHECKS[RANGE], found, _FRAMES)
        elif moved_m := self._moved_m(sequence):
            found = f"points that move by {moved_m:.1f} m while the poses stand"
            yield Finding("error", RANGE, where, CHECKS[RANGE], found, _FRAMES)
        if sequence.metadata.has_rays:
            yield from self._ground(where)

    def _moved_m(self, sequence: Sequence) -> float:
        try:
            return self._centres.moved_m(sequence.poses)
        except CarlascError:  # which is reported elsewhere
            return 0.0

    def _ground(self, where: str) -> Iterator[Finding]:
        planes = np.array([plane for plane in self._planes if plane is not None]).reshape(-1, 3)
        expected = CHECKS[GROUND]
        scans = len(self._planes)
        if len(planes) < _SEEN * scans:
            yield untested(GROUND, where, f"{scans - len(planes)} of {scans} scans show no ground")
            return
        height = float(np.median(planes[:, 2]))
        tilt = float(np.median(np.hypot(planes[:, 0], planes[:, 1])))
        if height > _ABOVE_M:
            found = f"ground {height:.2f} m above it: the sensor is upside down, or z points down"
            yield Finding("error", GROUND, where, expected, found, _UPRIGHT)
        elif tilt > _TILT:
            found = f"ground that is tilted by {np.degrees(np.arctan(tilt)):.0f} degrees"
            yield Finding("warning", GROUND, where, expected, found, _UPRIGHT)


def untested(check: str, where: str, why: str) -> Finding:
    """Return the finding of a check that could not be made."""
    found = f"data that could not be tested, because {why}"
    return Finding("warning", check, where, CHECKS[check], found, _accept(check), tested=False)


def _accept(check: str) -> str:
    return f"`--accept {check}` if this is true of the place"


def judge(
    sequence: Sequence, findings: Iterable[Finding], made: Collection[str], accept: Collection[str]
) -> tuple[list[Finding], dict[str, State]]:
    """Return the findings, where accepted warnings are notes, with the warnings that the converter
    recorded in carlasc.json; and the state of each check.

    Args:
        sequence: its record says what was accepted before.
        findings: all findings of the sequence.
        made: those of `CHECKS` that apply to the sequence.
        accept: checks whose warnings are accepted now.
    """
    entries = _entries(sequence)
    before = [check for check, (verdict, _) in entries.items() if verdict == ACCEPTED]
    states: dict[str, State] = {**dict.fromkeys(made, "right"), **dict.fromkeys(before, ACCEPTED)}
    where = f"{sequence.location}/{layout.METADATA}"
    expected = "a recording without warnings"
    warned = [
        Finding("warning", check, where, expected, message, _accept(check))
        for check, (verdict, message) in entries.items()
        if verdict in ("warning", "error")
    ]
    judged = []
    for finding in [*findings, *warned]:
        check = finding.check
        if finding.severity == "warning" and (check in accept or check in before):
            finding, states[check] = replace(finding, severity="note"), ACCEPTED  # noqa: PLW2901
        elif (
            finding.severity != "note"
            and check in {*made, *entries}
            and states.get(check) != "wrong"
        ):
            states[check] = "wrong" if finding.tested else "untested"
        judged.append(finding)
    return judged, states


def record_accepted(source: Source, findings: Iterable[Finding], accept: Collection[str]) -> None:
    """Write to carlasc.json of each sequence which of its warnings were accepted.

    Args:
        source: a folder.
        findings: those of `judge`, with the paths of their sequences.
        accept: checks whose warnings are accepted.

    Raises:
        ArgumentError: the source is not a folder.
    """
    for path, sequence in source.sequences().items():
        own = {f.check: f.found for f in findings if f.sequence == path and f.severity == "note"}
        own = {check: own[check] for check in accept if check in own}
        if own and not isinstance(sequence, FolderSequence):
            raise ArgumentError(
                "accept", expected="a folder, whose carlasc.json says so", found=source.location
            )
        if own and isinstance(sequence, FolderSequence):
            kept = _entries(sequence) | {check: (ACCEPTED, own[check]) for check in own}
            entries = [
                {"check": check, "verdict": verdict, "message": message}
                for check, (verdict, message) in kept.items()
            ]
            metadata = sequence.metadata
            changed = replace(metadata, extra={**metadata.extra, "findings": entries})
            FolderWriter(sequence.folder).write_document(layout.METADATA, changed.to_json())


def _entries(sequence: Sequence) -> dict[str, tuple[str, str]]:
    """Return verdict and message by check, of `findings` in carlasc.json."""
    try:
        entries = sequence.metadata.extra.get("findings", [])
        return {one["check"]: (one["verdict"], one["message"]) for one in entries}
    except (CarlascError, TypeError, KeyError):  # of a broken file, which is reported elsewhere
        return {}
