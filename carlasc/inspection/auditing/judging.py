"""From the sums of stretches to verdicts: false free space, phantoms, ghost trails, erased actors,
labels and gaps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from carlasc.core.arrays import FloatArray, IntArray
from carlasc.core.classes import ClassTable
from carlasc.errors import count, first_names
from carlasc.inspection.auditing.counting import HEIGHTS
from carlasc.inspection.auditing.matching import MatchedGrids
from carlasc.inspection.auditing.verdicts import Share, State, Stretches, Verdict, share_of
from carlasc.inspection.heldout_scores import BANDS_M

# A share is a fault from the first value on; the share of one class is a fault from the second on,
# if it has at least so many counts.
_FREE = 0.06  # fact: audit-free
_FREE_OF_CLASS = 0.4  # fact: audit-free-class
_PHANTOM = 0.03  # fact: audit-phantom
_PHANTOM_OF_CLASS = 0.2  # fact: audit-phantom-class
_LEAST = 1000
# of the path of an actor
_TRAIL = 0.1  # fact: trail
_TRAIL_VOXELS = 30
# of the voxels in which an actor was seen
_ERASED = 0.2
_ERASED_VOXELS = 40
_DOUBLED = 0.05  # of the columns with ground; fact: doubled
# least share of the points of a class under another class, and largest share under its own
_EXPLAINED = 0.5
_OWN = 0.3  # fact: own-class
# largest share under its own class, for thin markings, which lose their voxels in any case
_NONE = 0.002
_SHOWN = 4


def judge_contents(
    stretches: Stretches, one: MatchedGrids, window: tuple[int, int] | None, wrong: str = ""
) -> Iterator[Verdict]:
    """Yield the verdicts on what is in voxels: free space, phantoms, moving actors, labels, and
    what is missing.

    Args:
        stretches: the sums of a sequence.
        one: its grids and scans.
        window: first and last scan that a grid was made from; None if that is not known.
        wrong: the fault of geometry, because of which other voxels seem wrong; empty for none.
    """
    judge = _Judge(stretches, one, window)
    for verdict in judge.voxels():
        text = f"not judged before the fault of {wrong} is corrected: {verdict.text}"
        hidden = wrong and verdict.state == "fault"
        yield replace(verdict, state="undetermined", text=text, advice="") if hidden else verdict
    yield from judge.gaps(wrong)


@dataclass(frozen=True)
class _Judge:
    stretches: Stretches
    one: MatchedGrids
    window: tuple[int, int] | None

    def _say(self, check: str, state: State | bool, text: str, *about: Any) -> Verdict:
        return Verdict.of(self.one.path, check, state, text, *about)

    def voxels(self) -> Iterator[Verdict]:
        """Yield what is wrong in voxels."""
        which = (
            "scans that may have made the grids" if self.window is None else "the frame's own scan"
        )
        yield self._by_class(
            "returns",
            "false free",
            f"returns of {which} are in voxels called free",
            (_FREE, _FREE_OF_CLASS),
            self.one.scans.metadata.classes,
            "make these voxels occupied",
        )
        if self.window is not None:
            yield self._share(
                "held out",
                "false free, held out",
                "of the returns of static objects in scans that took no part in the grids are in "
                "free voxels",
                _FREE,
                "no frame has a scan just outside of the window, with poses and a mask",
                "make these voxels occupied or unknown",
            )
        yield self._by_class(
            "seen voxels",
            "phantoms",
            "occupied voxels are crossed by rays",
            (_PHANTOM, _PHANTOM_OF_CLASS),
            self.one.classes,
            "make these voxels free",
        )
        if (depth := self.stretches.share("depth")) is not None:
            value, low, high = (1e-3 * share for share in depth)
            text = (
                f"{value:.2f} m ({low:.2f} to {high:.2f}) in the mean between a return and the "
                "first occupied voxel on its ray"
            )
            yield self._say("depth error", False, text, (value, low, high), "", "m")
        yield from self._actors()
        yield self._share(
            "ground columns",
            "doubled ground",
            "of the columns with ground have it at two heights",
            _DOUBLED,
            "no class of the grids is ground",
            "refine the poses that the grids were made with: they drift in height",
        )
        yield from self._labels()

    def _share(
        self, name: str, check: str, what: str, limit: float, unknown: str, advice: str
    ) -> Verdict:
        """Return the verdict on a share, a fault if its whole interval is above a limit."""
        share = self.stretches.share(name)
        if share is None:
            return self._say(check, "undetermined", unknown)
        return self._say(check, share[1] > limit, f"{_percent(share)} {what}", share, advice)

    def _by_class(
        self,
        name: str,
        check: str,
        what: str,
        limits: tuple[float, float],
        table: ClassTable | None,
        advice: str,
    ) -> Verdict:
        counts = self.stretches.stacked(name)
        if counts is None or not counts[..., 0].any():
            text = "nothing could be counted"
            if counts is None and name == "returns":
                text = "the files do not distinguish free from unknown space"
            return self._say(check, "undetermined", text)
        total = counts.sum(axis=0)
        drawn = self.stretches.draw(counts.sum(axis=(1, 2, 3)))
        whole = share_of(drawn[:, 1], drawn[:, 0]) or (0.0, 0.0, 0.0)
        worst = []
        for index in np.flatnonzero(total[..., 0].sum(axis=(1, 2)) >= _LEAST).tolist():
            of_class = self.stretches.draw(counts[:, index].sum(axis=(1, 2)))
            if (share := share_of(of_class[:, 1], of_class[:, 0])) is not None:
                worst.append((share, _name(table, index)))
        worst.sort(reverse=True)
        wrong = [f"{share[0]:.0%} of {name}" for share, name in worst if share[1] > limits[1]]
        text = f"{_percent(whole)} of the {what}{': ' if wrong else ''}{', '.join(wrong[:_SHOWN])}"
        if wrong and check == "false free":
            advice = (
                "use more scans or sensors: rays that pass beside thin objects outvote their "
                "returns"
            )
        named = [
            f"{name} {share[0]:.1%} ({share[1]:.1%} to {share[2]:.1%})" for share, name in worst
        ]
        by_distance = zip(BANDS_M, total.sum(axis=(0, 2)), strict=False)
        near = [f"from {low:.0f} m {n[1] / n[0]:.1%}" for low, n in by_distance if n[0]]
        by_height = enumerate(total.sum(axis=(0, 1)), 1)
        levels = [f"layer {k} of {HEIGHTS} {n[1] / n[0]:.1%}" for k, n in by_height if n[0]]
        verdict = self._say(check, whole[1] > limits[0] or bool(wrong), text, whole, advice)
        return replace(verdict, details=", ".join([*named, *near, *levels]))

    def _actors(self) -> Iterator[Verdict]:
        # voxels of the path of an actor, occupied ones, those it is seen in, occupied ones, frames
        actors = [
            (name, drawn)
            for name in sorted({name for part in self.stretches.parts for name in part})
            if name.startswith("actor ") and (drawn := self.stretches.drawn(name)) is not None
        ]
        moved = [(name, n) for name, n in actors if n[0, 0] >= _TRAIL_VOXELS]
        if moved:
            paths = [(n[0, 1], name, _share_of_actor(n, 0)) for name, n in moved]
            trails = sorted((row for row in paths if row[2][1] > _TRAIL), reverse=True)
            listed = [f"{name} {_percent(path, 0)}" for _, name, path in trails]
            total = np.sum([n for _, n in moved], axis=0)
            share = _share_of_actor(total, 0)
            volume = total[0, 1] * float(np.prod(self.one.spec.voxel_size)) / self._frames[0]
            text = (
                f"{share[0]:.2%} of the paths of {count(len(moved), 'actor')} are "
                f"occupied, {volume:.2f} m3 per frame"
            )
            advice = "leave out moving actors, or move their points along: "
            advice += first_names(listed, _SHOWN)
            yield self._say("ghost trails", bool(trails), text, share, advice)
        else:
            text = "no moving actor was found in the recording"
            yield self._say("ghost trails", "undetermined", text)
        seen = [(name, n) for name, n in actors if n[0, 2] >= _ERASED_VOXELS]
        if not seen:
            text = "no actor was found in the recording"
            yield self._say("erased actors", "undetermined", text, None, "", "actors")
            return
        own = [(n[0, 2], name, _share_of_actor(n, 2), n[0, 4]) for name, n in seen if n[0, 4] > 1]
        erased = sorted((row for row in own if row[2][2] < _ERASED), reverse=True)
        listed = [
            f"{name} ({share[0]:.0%} of its voxels in {frames:.0f} frames)"
            for _, name, share, frames in erased
        ]
        text = f"{len(erased)} of {count(len(seen), 'actor')} have no voxels"
        text += f": {first_names(listed, _SHOWN)}" if erased else ""
        advice = "keep the voxels of these actors"
        number = float(len(erased))
        yield self._say("erased actors", bool(erased), text, number, advice, "actors")

    @cached_property
    def _frames(self) -> tuple[int, int]:
        """Number of frames, and of those without a mask."""
        counts = self.stretches.stacked("frames")
        made, without = (0, 0) if counts is None else counts.sum(axis=0).tolist()
        return made, without

    @cached_property
    def _confusion(self) -> IntArray | None:
        """(S, K, K) points by their class and that of their voxel, of the classes of the grids;
        None without any.
        """
        counts = self.stretches.stacked("confusion")
        return None if counts is None or not counts.any() else counts

    def _labels(self) -> Iterator[Verdict]:
        counts = self._confusion
        table = self.one.classes
        if counts is None or table is None:
            text = "scans or grids have no labels, or no map of their classes is known"
            yield self._say("labels", "undetermined", text)
            return
        used = np.flatnonzero(counts.any(axis=(0, 1)) | counts.any(axis=(0, 2)))
        drawn = self.stretches.draw(counts[:, used][:, :, used])
        names = [_name(table, int(i)) for i in used]
        ground = np.isin(used, self.one.ground)
        rows = drawn.sum(axis=2)
        right = np.einsum("dkk->dk", drawn)
        kinds = [int(i) for i in np.flatnonzero(rows[0] >= _LEAST)]
        other = {
            i: j
            for i in kinds
            if (j := _explains(drawn, rows, right, i, bool(ground[i]))) is not None
        }
        right_share = share_of(right.sum(axis=1), rows.sum(axis=1))
        least = sorted(kinds, key=lambda i: right[0, i] / rows[0, i])
        shares = ", ".join(f"{names[i]} {right[0, i] / rows[0, i]:.0%}" for i in least[:_SHOWN])
        text = (
            f"{_percent(right_share)} of the points in occupied voxels have the class of their "
            f"voxel; least: {shares}"
        )
        yield self._say("labels", bool(other), text, right_share, "correct the map of classes")
        for i, j in other.items():
            if other.get(j) != i:
                moved = share_of(drawn[:, i, j], rows[:, i])
                text = f"{_percent(moved)} of the points of {names[i]} are in voxels of {names[j]}"
                advice = f"map {names[i]} to id {used[i]}, not {used[j]}"
                yield self._say("class mapped", True, text, moved, advice)
            elif i < j:
                moved = share_of(drawn[:, i, j] + drawn[:, j, i], rows[:, i] + rows[:, j])
                text = (
                    f"{names[i]} and {names[j]} are exchanged: {_percent(moved)} of their points "
                    "are in voxels of the other"
                )
                advice = f"exchange the ids {used[i]} and {used[j]}"
                yield self._say("classes exchanged", True, text, moved, advice)

    def gaps(self, wrong: str) -> Iterator[Verdict]:
        """Yield what is missing; classes only if the geometry is not `wrong`."""
        missing, (frames, without) = self.one.absent, self._frames
        made = len(self.one.frames) + len(missing)
        text = f"{len(missing)} of {made} frames have no grid ({len(missing) / made:.1%})"
        text += f": {first_names(map(str, missing))}" if missing else ""
        advice = "make these frames, or document why they are missing"
        yield self._say("missing frames", bool(missing), text, len(missing) / made, advice)
        if 0 < without < frames:
            text = f"{without} of {frames} frames have no mask of known voxels"
            advice = "write the masks of all frames"
            yield self._say("missing masks", True, text, without / frames, advice)
        counts = self._confusion
        kinds = self.stretches.stacked("classes of grids")
        if not wrong and counts is not None and kinds is not None and self.one.classes is not None:
            met = counts.sum(axis=(0, 2)) >= _LEAST
            made_of = kinds.sum(axis=0)
            gone = [
                _name(self.one.classes, i) for i in np.flatnonzero(met).tolist() if not made_of[i]
            ]
            text = "every class of the scans is in the grids"
            if gone:
                text = f"classes in the scans but not in the grids: {', '.join(gone)}"
            advice = "label the voxels of these classes"
            number = float(len(gone))
            yield self._say("missing classes", bool(gone), text, number, advice, "classes")
        if (unknown := self.stretches.drawn("unknown")) is not None:
            whole = share_of(unknown[:, 1:].sum(axis=1), unknown[:, 0])
            causes = ("hold a return", "are crossed by rays", "are outside the view", "are hidden")
            shares = zip(unknown[0, 1:] / unknown[0, 0], causes, strict=True)
            parts = ", ".join(f"{share:.1%} {cause}" for share, cause in shares)
            text = f"{_percent(whole)} of the voxels are unknown: {parts}"
            yield self._say("unknown space", False, text, whole)


def _explains(
    drawn: FloatArray,
    rows: FloatArray,
    right: FloatArray,
    i: int,
    thin: bool,
) -> int | None:
    """Return the class whose voxels hold most points of class `i`, if nearly no points are in
    voxels of class `i`; otherwise None.
    """
    j = int(drawn[0, i].argmax())
    own = share_of(right[:, i], rows[:, i])
    moved = share_of(drawn[:, i, j], rows[:, i])
    if j == i or own is None or moved is None:
        return None
    # the ground around a thin marking outvotes it
    lost = thin and drawn[0, j, i] < _EXPLAINED * rows[0, j]
    return j if own[2] < (_NONE if lost else _OWN) and moved[1] > _EXPLAINED else None


def _share_of_actor(drawn: FloatArray, column: int) -> Share:
    """Return the occupied share of the voxels of an actor, which has some."""
    return share_of(drawn[:, column + 1], drawn[:, column]) or (0.0, 0.0, 0.0)


def _percent(share: Share | None, digits: int = 2) -> str:
    value, low, high = share or (0.0, 0.0, 0.0)
    return f"{value:.{digits}%} ({low:.{digits}%} to {high:.{digits}%})"


def _name(table: ClassTable | None, index: int) -> str:
    return str(index) if table is None else table.names.get(index, str(index))
