"""What data must show to be called sound: the checks that a grid needs, which scans and grids can
fail or leave open, and those that a user accepts.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from carlasc.core.arrays import Float32Array, FloatArray
from carlasc.errors import ArgumentError, CarlascError
from carlasc.inspection.findings import Finding, State
from carlasc.motion.ground import ground_plane
from carlasc.storage import layout
from carlasc.storage.folder import FolderSequence, FolderWriter
from carlasc.storage.protocol import Sequence, Source

RANGE, GROUND, OVERLAP, OCCUPIED = "range", "ground", "poses-on-scans", "occupied"
CHECKS = {
    RANGE: "points near the sensor",
    GROUND: "level ground below the sensor",
    OVERLAP: "scans that overlap under the poses",
    OCCUPIED: "occupied voxels",
}
"""What a grid needs, and what data must show for it. `SequenceReport.checks` has those that apply
to a sequence, and those that its converter recorded.
"""
ACCEPTED = "accepted"

_FAR_M, _FEW = 500.0, 1e-3  # no LiDAR sees farther; a greater share of such points is wrong
_TILT = 0.16  # slope of the ground against the sensor, above which grids are tilted
_STEEPEST = 0.8  # greatest slope that is looked for
_ABOVE_M = -0.05  # ground that is higher than this below the sensor is above it
_SEEN = 0.5  # ground must be found in this share of the scans
_EMPTY = 0.1  # greatest share of grids without an occupied voxel
# Scans that move so far while their poses stand are in one frame, which they were moved to.
_CENTRE_M, _STANDING = 3.0, 0.2


@dataclass
class ScanFacts:
    """What the scans of a sequence show of their sensor, frame by frame."""

    _scans: int = 0
    _far: list[float] = field(default_factory=list)
    _planes: list[FloatArray | None] = field(default_factory=list)
    _centres: list[FloatArray] = field(default_factory=list)

    def add(self, points: Float32Array) -> None:
        """Add the (N, 3) points of the next scan, metres, finite."""
        self._scans += 1
        points = points[points.any(axis=1)]  # no-returns are at the sensor
        if len(points):
            self._far.append(float((np.abs(points).max(axis=1) > _FAR_M).mean()))
            plane = ground_plane(points)
            self._planes.append(ground_plane(points, _STEEPEST) if plane is None else plane)
            self._centres.append(np.median(points[:, :2], axis=0).astype(np.float64))

    def findings(self, sequence: Sequence) -> Iterator[Finding]:
        """Yield what is wrong with the ranges and the ground, or what they leave open."""
        where = f"{sequence.location}/points"
        if not self._far:
            if self._scans:  # other checks report scans that cannot be read
                yield untested(RANGE, where, "no scan that was read has points")
            return
        if (far := float(np.mean(self._far))) > _FEW:
            yield Finding(
                "error",
                RANGE,
                where,
                f"points within {_FAR_M:g} m of the sensor",
                f"{far:.1%} of the points beyond it",
                "they are in a frame of the world, or belong to other times: convert again",
            )
        elif self._is_moved(sequence):
            yield Finding(
                "error",
                RANGE,
                where,
                "scans in the frame of their sensor",
                "scans whose points move by metres while their poses stand",
                "the scans are in one common frame: move each to the frame of its sensor, and "
                "write the poses of the sensor",
            )
        if sequence.metadata.has_rays:
            yield from self._ground(where)

    def _is_moved(self, sequence: Sequence) -> bool:
        """Return whether the points move although the poses stand."""
        part = max(1, len(self._centres) // 5)
        first, last = np.median([self._centres[:part], self._centres[-part:]], axis=1)
        try:
            places = sequence.poses[:, :2, 3]
        except CarlascError:  # which is reported elsewhere
            return False
        moved = np.linalg.norm(last - first)
        way = np.linalg.norm(places - places[:1], axis=1).max(initial=0.0)
        return bool(moved > _CENTRE_M and way < _STANDING * moved)

    def _ground(self, where: str) -> Iterator[Finding]:
        planes = np.array([plane for plane in self._planes if plane is not None]).reshape(-1, 3)
        expected, scans = CHECKS[GROUND], len(self._planes)
        if len(planes) < _SEEN * scans:
            yield untested(GROUND, where, f"{scans - len(planes)} of {scans} scans show no ground")
            return
        height = float(np.median(planes[:, 2]))
        tilt = float(np.median(np.hypot(planes[:, 0], planes[:, 1])))
        if height > _ABOVE_M:
            found = f"ground {height:.2f} m above it: the sensor is upside down, or z points down"
            yield Finding(
                "error", GROUND, where, expected, found, "convert again, with the right axes"
            )
        elif tilt > _TILT:
            yield Finding(
                "warning",
                GROUND,
                where,
                expected,
                f"ground that is tilted by {np.degrees(np.arctan(tilt)):.0f} degrees",
                "convert again, with the mount of the sensor",
            )


def check_occupied(sequence: Sequence, grid: str, occupied: list[bool]) -> Iterator[Finding]:
    """Yield a warning if many of the grids that were read have no occupied voxel."""
    empty = occupied.count(False)
    if empty > _EMPTY * len(occupied):
        yield Finding(
            "warning",
            OCCUPIED,
            f"{sequence.location}/{grid}",
            CHECKS[OCCUPIED],
            f"none in {empty} of {len(occupied)} frames",
            "check whether the points lie within the bounds of the grid",
        )


def untested(check: str, where: str, why: str) -> Finding:
    """Return the finding of a check that could not be made."""
    found = f"data that could not be tested, because {why}"
    advice = f"`--accept {check}` if this is true of the place"
    return Finding("warning", check, where, CHECKS[check], found, advice, tested=False)


def recorded(sequence: Sequence) -> Iterator[Finding]:
    """Yield what carlasc.json says of a sequence: the warnings of its converter, and notes of what
    was accepted.
    """
    where = f"{sequence.location}/{layout.METADATA}"
    for one in _entries(sequence):
        verdict, check = str(one.get("verdict")), str(one.get("check"))
        if verdict in ("warning", "error", ACCEPTED):
            yield Finding(
                "note" if verdict == ACCEPTED else "warning",
                check,
                where,
                "a recording without warnings",
                f"{verdict}: {one.get('message')}",
                "" if verdict == ACCEPTED else f"`--accept {check}` if this is true of the place",
            )


def judge(
    sequence: Sequence, findings: Iterable[Finding], made: Collection[str], accept: Collection[str]
) -> tuple[list[Finding], dict[str, State]]:
    """Return the findings, where accepted warnings are notes, and the state of each check.

    Args:
        sequence: its record says what was accepted before.
        findings: all findings of the sequence.
        made: those of `CHECKS` that apply to the sequence.
        accept: checks whose warnings are accepted now.
    """
    entries = _entries(sequence)
    accepted = {*accept, *(one.get("check") for one in entries if one.get("verdict") == ACCEPTED)}
    states: dict[str, State] = dict.fromkeys(made, "right")
    of_record = {str(one.get("check")) for one in entries}
    judged = []
    for finding in findings:
        blocks = finding.severity != "note" and (
            finding.check in states or finding.check in of_record
        )
        if blocks and finding.severity == "warning" and finding.check in accepted:
            states[finding.check] = "accepted"
            judged.append(replace(finding, severity="note"))
            continue
        if blocks and states.get(finding.check) != "wrong":
            states[finding.check] = "wrong" if finding.tested else "untested"
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
        own = [
            f for f in findings if f.sequence == path and f.check in accept and f.severity == "note"
        ]
        if not own:
            continue
        if not isinstance(sequence, FolderSequence):
            raise ArgumentError(
                "accept", expected="a folder, whose carlasc.json says so", found=source.location
            )
        kept = [one for one in _entries(sequence) if one.get("check") not in accept]
        new = [
            {"check": f.check, "verdict": ACCEPTED, "message": f.found.removeprefix("warning: ")}
            for f in own
        ]
        metadata = sequence.metadata
        extra = {**metadata.extra, "findings": [*kept, *new]}
        FolderWriter(sequence.folder).write_document(
            layout.METADATA, replace(metadata, extra=extra).to_json()
        )


def _entries(sequence: Sequence) -> list[dict[str, Any]]:
    """Return the entries of `findings` in carlasc.json."""
    try:
        entries = sequence.metadata.extra.get("findings")
    except CarlascError:  # which is reported elsewhere
        return []
    return [one for one in entries if isinstance(one, dict)] if isinstance(entries, list) else []
