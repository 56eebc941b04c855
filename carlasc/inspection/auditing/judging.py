"""From the sums of stretches to verdicts: false free space, phantoms, ghost trails, erased actors,
labels and gaps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.errors import count, first_names
from carlasc.inspection.auditing.counting import HEIGHTS
from carlasc.inspection.auditing.matching import MatchedGrids
from carlasc.inspection.auditing.verdicts import Share, State, Stretches, Verdict, share_of
from carlasc.inspection.heldout_scores import BANDS_M

# A share is a fault from the first value on; the share of one class is a fault from the second on,
# if it has at least so many counts.
_FREE, _FREE_OF_CLASS, _PHANTOM, _PHANTOM_OF_CLASS, _LEAST = 0.06, 0.4, 0.03, 0.2, 1000
_TRAIL, _TRAIL_VOXELS = 0.1, 30  # of the path of an actor
_ERASED, _ERASED_VOXELS = 0.2, 40  # of the voxels in which an actor was seen
_DOUBLED = 0.05  # of the columns with ground
# least share of the points of a class under another class, and largest share under its own
_EXPLAINED, _OWN = (0.5, 0.3)
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

    def _say(
        self,
        check: str,
        state: State | bool,
        text: str,
        found: Share | None = None,
        advice: str = "",
        unit: str = "share",
    ) -> Verdict:
        """Return a verdict; True is a fault, and False is sound. Only a fault has advice."""
        named: State = state if isinstance(state, str) else "fault" if state else "sound"
        value, low, high = found or (None, None, None)
        return Verdict(
            check,
            named,
            value,
            low,
            high,
            unit,
            text,
            self.one.path,
            advice if named == "fault" else "",
        )

    def voxels(self) -> Iterator[Verdict]:
        """Yield what is wrong in voxels."""
        if self.stretches.stacked("returns") is None:
            yield self._say(
                "false free", "undetermined", "the files do not distinguish free from unknown space"
            )
        else:
            by = (
                "scans that may have made the grids"
                if self.window is None
                else "the frame's own scan"
            )
            what, advice = (
                f"returns of {by} are in voxels called free",
                "make these voxels occupied",
            )
            classes = self.one.scans.metadata.classes
            yield self._by_class(
                "returns", "false free", what, (_FREE, _FREE_OF_CLASS), classes, advice
            )
        if self.window is not None:
            yield self._held_out()
        what, advice = "occupied voxels are crossed by rays", "make these voxels free"
        yield self._by_class(
            "seen voxels", "phantoms", what, (_PHANTOM, _PHANTOM_OF_CLASS), self.one.classes, advice
        )
        yield from self._actors()
        found = self.stretches.share("ground columns")
        text = "no class of the grids is ground" if found is None else f"{_percent(found)} of the columns with ground have it at two heights"  # fmt: skip
        state: State | bool = "undetermined" if found is None else found[1] > _DOUBLED
        yield self._say(
            "doubled ground",
            state,
            text,
            found,
            "refine the poses that the grids were made with: they drift in height",
        )
        yield from self._labels()

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
            return self._say(check, "undetermined", "nothing could be counted")
        total = counts.sum(axis=0)
        classes = np.flatnonzero(total[..., 0].sum(axis=(1, 2)) >= _LEAST).tolist()
        of_class = self.stretches.draw(counts[:, classes].sum(axis=(2, 3)))
        drawn = self.stretches.draw(counts.sum(axis=(1, 2, 3)))
        found = share_of(drawn[:, 1], drawn[:, 0]) or (0.0, 0.0, 0.0)
        shares = {
            i: share_of(of_class[:, row, 1], of_class[:, row, 0]) for row, i in enumerate(classes)
        }
        worst = sorted(
            ((share, _name(table, i)) for i, share in shares.items() if share is not None),
            reverse=True,
        )
        wrong = [f"{share[0]:.0%} of {name}" for share, name in worst if share[1] > limits[1]]
        text = f"{_percent(found)} of the {what}{': ' if wrong else ''}{', '.join(wrong[:_SHOWN])}"
        if wrong and check == "false free":
            advice = "use more scans or sensors: rays that pass beside thin objects outvote their returns"
        bands = zip(BANDS_M, total.sum(axis=(0, 2)), strict=False)
        near = [f"from {low:.0f} m {n[1] / n[0]:.1%}" for low, n in bands if n[0]]
        levels = [
            f"layer {k + 1} of {HEIGHTS} {n[1] / n[0]:.1%}"
            for k, n in enumerate(total.sum(axis=(0, 1)))
            if n[0]
        ]
        named = [
            f"{name} {share[0]:.1%} ({share[1]:.1%} to {share[2]:.1%})" for share, name in worst
        ]
        said = self._say(check, found[1] > limits[0] or bool(wrong), text, found, advice)
        return replace(said, details=", ".join([*named, *near, *levels]))

    def _held_out(self) -> Verdict:
        if (found := self.stretches.share("held out")) is None:
            text = "no frame has a scan just outside of the window, with poses and a mask"
            return self._say("false free, held out", "undetermined", text)
        text = f"{_percent(found)} of the returns of static objects in scans that took no part in the grids are in free voxels"
        advice = "make these voxels occupied or unknown"
        return self._say("false free, held out", found[1] > _FREE, text, found, advice)

    def _actors(self) -> Iterator[Verdict]:
        volume, names = (
            float(np.prod(self.one.spec.voxel_size)),
            {n for p in self.stretches.parts for n in p},
        )
        sums = {
            n.removeprefix("actor "): self.stretches.drawn(n)
            for n in sorted(names)
            if n.startswith("actor ")
        }
        actors = {name: drawn for name, drawn in sums.items() if drawn is not None}
        moved = {name: n for name, n in actors.items() if n[0, 0] >= _TRAIL_VOXELS}
        seen = {name: n for name, n in actors.items() if n[0, 2] >= _ERASED_VOXELS}
        paths = {name: share_of(n[:, 1], n[:, 0]) for name, n in moved.items()}
        trails = [
            (moved[name][0, 1], name, path)
            for name, path in paths.items()
            if path and path[1] > _TRAIL
        ]
        listed = [
            f"actor {name} {_percent(path, 0)}" for _, name, path in sorted(trails, reverse=True)
        ]
        advice = (
            f"leave out moving actors, or move their points along: {first_names(listed, _SHOWN)}"
        )
        if moved:
            total = np.sum(list(moved.values()), axis=0)
            found, frames = share_of(total[:, 1], total[:, 0]), self._frames[0]
            text = f"{found[0] if found else 0:.2%} of the paths of {count(len(moved), 'actor')} are occupied, {total[0, 1] * volume / frames:.2f} m3 per frame"
            yield self._say("ghost trails", bool(trails), text, found, advice)
        else:
            text = "no moving actor was found in the recording"
            yield self._say("ghost trails", "undetermined", text)
        own = {name: share_of(n[:, 3], n[:, 2]) for name, n in seen.items() if n[0, 4] >= 2}
        erased = [
            (seen[name][0, 2], name, share[0])
            for name, share in own.items()
            if share and share[2] < _ERASED
        ]
        listed = [f"actor {name} ({share:.0%} of its voxels in {seen[name][0, 4]:.0f} frames)" for _, name, share in sorted(erased, reverse=True)]  # fmt: skip
        text = f"{len(erased)} of {count(len(seen), 'actor')} have no voxels"
        text += f": {first_names(listed, _SHOWN)}" if erased else ""
        number = float(len(erased))
        yield self._say(
            "erased actors",
            bool(erased) if seen else "undetermined",
            text if seen else "no actor was found in the recording",
            (number, number, number) if seen else None,
            "keep the voxels of these actors",
            "actors",
        )

    @cached_property
    def _frames(self) -> tuple[int, int]:
        """Number of frames, and of those without a mask."""
        counts = self.stretches.stacked("frames")
        made, without = (0, 0) if counts is None else counts.sum(axis=0).tolist()
        return made, without

    @cached_property
    def _confusion(self) -> NDArray[np.int64] | None:
        """(S, K, K) points by their class and that of their voxel, of the classes of the grids;
        None without any.
        """
        counts = self.stretches.stacked("confusion")
        return None if counts is None or not counts.any() else counts

    def _labels(self) -> Iterator[Verdict]:
        counts, table = self._confusion, self.one.classes
        if counts is None or table is None:
            text = "scans or grids have no labels, or no map of their classes is known"
            yield self._say("labels", "undetermined", text)
            return
        used = np.flatnonzero(counts.any(axis=(0, 1)) | counts.any(axis=(0, 2)))
        drawn = self.stretches.draw(counts[:, used][:, :, used])
        names, ground = [_name(table, int(i)) for i in used], np.isin(used, sorted(self._ground))
        rows, right = drawn.sum(axis=2), np.einsum("dkk->dk", drawn)
        kinds = [int(i) for i in np.flatnonzero(rows[0] >= _LEAST)]
        other = {
            i: j
            for i in kinds
            if (j := _explains(drawn, rows, right, i, bool(ground[i]))) is not None
        }
        found = share_of(right.sum(axis=1), rows.sum(axis=1))
        least = sorted(kinds, key=lambda i: right[0, i] / rows[0, i])
        shares = ", ".join(f"{names[i]} {right[0, i] / rows[0, i]:.0%}" for i in least[:_SHOWN])
        text = f"{_percent(found)} of the points in occupied voxels have the class of their voxel; least: {shares}"
        yield self._say("labels", bool(other), text, found, "correct the map of classes")
        for i, j in other.items():
            if other.get(j) != i:
                one = share_of(drawn[:, i, j], rows[:, i])
                text = f"{_percent(one)} of the points of {names[i]} are in voxels of {names[j]}"
                yield self._say(
                    "class mapped",
                    True,
                    text,
                    one,
                    f"map {names[i]} to id {used[i]}, not {used[j]}",
                )
            elif i < j:
                one = share_of(drawn[:, i, j] + drawn[:, j, i], rows[:, i] + rows[:, j])
                text = f"{names[i]} and {names[j]} are exchanged: {_percent(one)} of their points are in voxels of the other"
                yield self._say(
                    "classes exchanged",
                    True,
                    text,
                    one,
                    f"exchange the ids {used[i]} and {used[j]}",
                )

    @property
    def _ground(self) -> set[int]:
        lookup = self.one.lookup
        return (
            set()
            if lookup is None
            else {int(lookup[i]) for i in self.one.scans.metadata.classes.ground}
        )

    def gaps(self, wrong: str) -> Iterator[Verdict]:
        """Yield what is missing; classes only if the geometry is not `wrong`."""
        missing, (frames, without) = self.one.absent, self._frames
        made = len(self.one.frames) + len(missing)
        share = len(missing) / made
        text = f"{len(missing)} of {made} frames have no grid ({share:.1%})"
        text += f": {first_names(map(str, missing))}" if missing else ""
        advice = "make these frames, or document why they are missing"
        yield self._say("missing frames", bool(missing), text, (share, share, share), advice)
        if 0 < without < frames:
            share, text = (
                without / frames,
                f"{without} of {frames} frames have no mask of known voxels",
            )
            yield self._say(
                "missing masks", True, text, (share, share, share), "write the masks of all frames"
            )
        counts, kinds, table = (
            self._confusion,
            self.stretches.stacked("classes of grids"),
            self.one.classes,
        )
        if not wrong and counts is not None and kinds is not None and table is not None:
            met, made_of = counts.sum(axis=(0, 2)), kinds.sum(axis=0)
            gone = [
                _name(table, i) for i in np.flatnonzero(met >= _LEAST).tolist() if not made_of[i]
            ]
            text = f"classes in the scans but not in the grids: {', '.join(gone)}" if gone else "every class of the scans is in the grids"  # fmt: skip
            number = float(len(gone))
            yield self._say("missing classes", bool(gone), text, (number, number, number), "label the voxels of these classes", "classes")  # fmt: skip
        if (unknown := self.stretches.drawn("unknown")) is not None:
            whole = share_of(unknown[:, 1:].sum(axis=1), unknown[:, 0])
            causes = ("hold a return", "are crossed by rays", "are outside the view", "are hidden")
            parts = [
                f"{part / unknown[0, 0]:.1%} {cause}"
                for part, cause in zip(unknown[0, 1:], causes, strict=True)
            ]
            yield self._say(
                "unknown space",
                False,
                f"{_percent(whole)} of the voxels are unknown: {', '.join(parts)}",
                whole,
            )


def _explains(
    drawn: NDArray[np.float64],
    rows: NDArray[np.float64],
    right: NDArray[np.float64],
    i: int,
    thin: bool,
) -> int | None:
    """Return the class whose voxels hold most points of class `i`, if nearly no points are in
    voxels of class `i`; otherwise None.
    """
    j = int(drawn[0, i].argmax())
    own, moved = share_of(right[:, i], rows[:, i]), share_of(drawn[:, i, j], rows[:, i])
    if j == i or own is None or moved is None:
        return None
    # the ground around a thin marking outvotes it
    lost = thin and drawn[0, j, i] < _EXPLAINED * rows[0, j]
    return j if own[2] < (_NONE if lost else _OWN) and moved[1] > _EXPLAINED else None


def _percent(share: Share | None, digits: int = 2) -> str:
    value, low, high = share or (0.0, 0.0, 0.0)
    return f"{value:.{digits}%} ({low:.{digits}%} to {high:.{digits}%})"


def _name(table: ClassTable | None, index: int) -> str:
    return str(index) if table is None else table.names.get(index, str(index))
