"""From the sums of stretches to verdicts: false free space, phantoms, ghost trails, erased actors, labels and gaps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.inspection.auditing.counting import BANDS_M, HEIGHTS
from carlasc.inspection.auditing.judging import Stretches, interval
from carlasc.inspection.auditing.matching import MatchedGrids
from carlasc.inspection.auditing.verdicts import State, Verdict

# A share is a fault from the first value on; that of one class of at least so many counts from the second on.
_FREE, _FREE_OF_CLASS, _PHANTOM, _PHANTOM_OF_CLASS, _LEAST = 0.06, 0.4, 0.03, 0.2, 1000
_TRAIL, _TRAIL_VOXELS = 0.1, 30  # of the path of an actor
_ERASED, _ERASED_VOXELS = 0.2, 40  # of the voxels in which an actor was seen
_DOUBLED = 0.05  # of the columns with ground
_EXPLAINED, _OWN = 0.5, 0.3  # shares of a class that another name explains, and that its own name has then at most
_NONE = 0.002  # the share of its own name where a thin marking is lost in any case
_SHOWN = 4


def judge_shares(
    stretches: Stretches, matched: MatchedGrids, window: tuple[int, int] | None, wrong: str = ""
) -> Iterator[Verdict]:
    """Yield the verdicts on what is in voxels: free space, phantoms, moving actors, labels, and what is missing.

    Args:
        stretches: the sums of a sequence.
        matched: its grids and scans.
        window: first and last scan that a grid was made from; None if that is not known.
        wrong: the fault of geometry that was found, which makes voxels seem wrong that are not; empty for none.
    """
    for verdict in _in_voxels(stretches, matched, window):
        text = f"not judged before {wrong} is right: {verdict.text}"
        hidden = wrong and verdict.state == "fault"
        yield replace(verdict, state="undetermined", text=text, advice="") if hidden else verdict
    yield from _gaps(stretches, matched, wrong)


def _in_voxels(stretches: Stretches, matched: MatchedGrids, window: tuple[int, int] | None) -> Iterator[Verdict]:
    where, table = matched.path, matched.scans.metadata.classes
    if stretches.stacked("returns").shape[1]:
        origin = "these scans may have made the grids" if window is None else "the frame's own scan"
        yield _by_class(stretches, "returns", "false free", f"returns in free voxels ({origin})", (_FREE, _FREE_OF_CLASS), table, where)  # fmt: skip
    else:
        text = "the files do not tell free from unknown space"
        yield Verdict("false free", "undetermined", None, None, None, "share", text, where)
    if window is not None:
        yield _held_out(stretches, where)
    kinds = matched.grid_classes
    yield _by_class(stretches, "seen voxels", "phantoms", "occupied voxels that rays cross", (_PHANTOM, _PHANTOM_OF_CLASS), kinds, where)  # fmt: skip
    yield from _actors(stretches, matched)
    yield _doubled(stretches, where)
    yield from _labels(stretches, matched)


def _by_class(
    stretches: Stretches,
    name: str,
    check: str,
    what: str,
    limits: tuple[float, float],
    table: ClassTable | None,
    where: str,
) -> Verdict:
    sums = stretches.drawn(name)
    if sums.ndim < 5 or (found := interval(sums[..., 1].sum(axis=(1, 2, 3)), sums[..., 0].sum(axis=(1, 2, 3)))) is None:
        return Verdict(check, "undetermined", None, None, None, "share", "nothing could be counted", where)
    parts, wrong = [], []
    for index in range(sums.shape[1]):
        whole = sums[:, index, :, :, 0].sum(axis=(1, 2))
        share = interval(sums[:, index, :, :, 1].sum(axis=(1, 2)), whole)
        if share is not None and whole[0] >= _LEAST:
            label = str(index) if table is None else table.names.get(index, str(index))
            parts.append((share[0], f"{label} {share[0]:.1%}"))
            if share[1] > limits[1]:
                wrong.append(f"{label} {share[0]:.1%} ({share[1]:.1%} to {share[2]:.1%})")
    worst = ", ".join(text for _, text in sorted(parts, reverse=True)[:_SHOWN])
    bands = sums[0].sum(axis=(0, 2))
    near = [f"{low:.0f} m {n[1] / n[0]:.1%}" for low, n in zip(BANDS_M[:-1], bands, strict=True) if n[0]]
    levels = [f"{k + 1}/{HEIGHTS} {n[1] / n[0]:.1%}" for k, n in enumerate(sums[0].sum(axis=(0, 1))) if n[0]]
    text = f"{found[0]:.2%} of {what} (95 %: {found[1]:.2%} to {found[2]:.2%}); by class: {worst or 'too few'}"
    text += f"; from distance: {', '.join(near)}; by height: {', '.join(levels)}"
    fault = found[1] > limits[0] or bool(wrong)
    advice = ""
    if fault:
        of = f": of {', '.join(wrong[:_SHOWN])}" if wrong else ""
        advice = (f"what scans meet is missing in the grids{of}" if check == "false free" else f"rays pass through what is not there{of}")  # fmt: skip
    return Verdict(check, "fault" if fault else "sound", *found, "share", text, where, advice)


def _held_out(stretches: Stretches, where: str) -> Verdict:
    found = stretches.share("held out", 1, 0)
    if found is None:
        text = "no frame has a scan just outside of the window, and poses and a mask"
        return Verdict("false free, held out", "undetermined", None, None, None, "share", text, where)
    text = f"{found[0]:.2%} of the returns of static things in scans that did not make the grids are in free voxels"
    state: State = "fault" if found[1] > _FREE else "sound"
    advice = "the grids do not hold what later or earlier scans meet" if state == "fault" else ""
    return Verdict("false free, held out", state, *found, "share", text, where, advice)


def _actors(stretches: Stretches, matched: MatchedGrids) -> Iterator[Verdict]:
    where, volume = matched.path, float(np.prod(matched.spec.voxel_size))
    names = sorted({name for part in stretches.parts for name in part if name.startswith("actor ")})
    sums = {name: stretches.drawn(name) for name in names}
    paths = [s for s in sums.values() if s.shape[1] and s[0, 0] >= _TRAIL_VOXELS]
    trails, erased = [], []
    for name, drawn in sums.items():
        path, own = interval(drawn[:, 1], drawn[:, 0]), interval(drawn[:, 3], drawn[:, 2])
        if path is not None and drawn[0, 0] >= _TRAIL_VOXELS and path[1] > _TRAIL:
            trails.append((drawn[0, 1] * volume, name, path))
        if own is not None and drawn[0, 2] >= _ERASED_VOXELS and drawn[0, 4] >= 2 and own[2] < _ERASED:
            erased.append((drawn[0, 2], name, own, int(drawn[0, 4])))
    if not paths:
        text = "nothing moves in the recording, as far as its fields and free space show"
        yield Verdict("ghost trails", "undetermined", None, None, None, "share", text, where)
    else:
        total = np.sum(paths, axis=0)
        found = interval(total[:, 1], total[:, 0])
        frames = max(float(stretches.drawn("frames")[0, 0]), 1.0)
        text = f"{found[0] if found else 0:.2%} of the paths of {len(paths)} actors are occupied, {total[0, 1] * volume / frames:.2f} m3 in a frame"
        listed = ", ".join(f"{name} {path[0]:.0%} ({path[1]:.0%} to {path[2]:.0%})" for _, name, path in sorted(trails, reverse=True)[:_SHOWN])  # fmt: skip
        advice = f"leave out what moves, or move it along: {listed}" if trails else ""
        yield Verdict("ghost trails", "fault" if trails else "sound", *(found or (0.0, 0.0, 0.0)), "share", text, where, advice)  # fmt: skip
    seen = [s for s in sums.values() if s.shape[1] and s[0, 2] >= _ERASED_VOXELS]
    if not seen:
        text = "no actor is named in the recording"
        yield Verdict("erased actors", "undetermined", None, None, None, "actors", text, where)
        return
    listed = ", ".join(f"{name} ({share[0]:.0%} of its voxels in {frames} frames)" for _, name, share, frames in sorted(erased, reverse=True)[:_SHOWN])  # fmt: skip
    text = f"{len(erased)} of {len(seen)} actors have no voxels" + (f": {listed}" if erased else "")
    advice = "keep the voxels of these actors" if erased else ""
    yield Verdict("erased actors", "fault" if erased else "sound", len(erased), len(erased), len(erased), "actors", text, where, advice)  # fmt: skip


def _doubled(stretches: Stretches, where: str) -> Verdict:
    found = stretches.share("ground columns", 1, 0)
    if found is None:
        text = "no class of the grids is ground"
        return Verdict("doubled ground", "undetermined", None, None, None, "share", text, where)
    state: State = "fault" if found[1] > _DOUBLED else "sound"
    text = f"{found[0]:.2%} of the columns with ground have it at two heights (95 %: {found[1]:.2%} to {found[2]:.2%})"
    advice = "the poses behind the grids drift in height: refine them" if state == "fault" else ""
    return Verdict("doubled ground", state, *found, "share", text, where, advice)


def _labels(stretches: Stretches, matched: MatchedGrids) -> Iterator[Verdict]:
    where, table, drawn = matched.path, matched.grid_classes, stretches.drawn("confusion")
    if drawn.ndim < 3 or table is None or not drawn[0].sum():
        text = "scans or grids have no labels, or no map of their classes is known"
        yield Verdict("labels", "undetermined", None, None, None, "share", text, where)
        return
    rows, right = drawn.sum(axis=2), np.einsum("dkk->dk", drawn)
    found = interval(right.sum(axis=1), rows.sum(axis=1)) or (0.0, 0.0, 0.0)
    kinds = [int(i) for i in np.flatnonzero(rows[0] >= _LEAST)]
    names = {i: table.names.get(i, str(i)) for i in range(drawn.shape[1])}
    shares = ", ".join(f"{names[i]} {right[0, i] / rows[0, i]:.0%}" for i in sorted(kinds, key=lambda i: right[0, i] / rows[0, i])[:_SHOWN])  # fmt: skip
    text = f"{found[0]:.1%} of the points in occupied voxels have the class of their voxel; least: {shares}"
    ground = {int(lookup[i]) for i in matched.scans.metadata.classes.ground} if (lookup := matched.lookup) is not None else set()  # fmt: skip
    other = {i: j for i in kinds if (j := _explains(drawn, rows, right, i, {i} <= ground)) is not None}
    pairs = sorted({tuple(sorted((i, j))) for i, j in other.items() if other.get(j) == i})
    single = {i: j for i, j in other.items() if other.get(j) != i}
    yield Verdict("labels", "fault" if other else "sound", *found, "share", text, where, "correct the map of classes" if other else "")  # fmt: skip
    for i, j in pairs:
        one = interval(drawn[:, i, j] + drawn[:, j, i], rows[:, i] + rows[:, j]) or (0.0, 0.0, 0.0)
        text = f"{names[i]} and {names[j]} are exchanged: {one[0]:.1%} of their points are in voxels of the other (95 %: {one[1]:.1%} to {one[2]:.1%})"
        yield Verdict("classes exchanged", "fault", *one, "share", text, where, f"exchange the ids {i} and {j}")
    for i, j in single.items():
        one = interval(drawn[:, i, j], rows[:, i]) or (0.0, 0.0, 0.0)
        text = (
            f"{one[0]:.1%} of the points of {names[i]} are in voxels of {names[j]} (95 %: {one[1]:.1%} to {one[2]:.1%})"
        )
        yield Verdict("class mapped", "fault", *one, "share", text, where, f"map {names[i]} to id {i}, not {j}")


def _explains(
    drawn: NDArray[np.float64], rows: NDArray[np.float64], right: NDArray[np.float64], i: int, thin: bool
) -> int | None:
    """Return the class whose voxels hold most points of another one, which has nearly none of its own; None if there is none."""
    j = int(drawn[0, i].argmax())
    own, moved = interval(right[:, i], rows[:, i]), interval(drawn[:, i, j], rows[:, i])
    if j == i or own is None or moved is None:
        return None
    lost = thin and drawn[0, j, i] < _EXPLAINED * rows[0, j]  # a thin marking loses its voxels to the ground around it
    return j if own[2] < (_NONE if lost else _OWN) and moved[1] > _EXPLAINED else None


def _gaps(stretches: Stretches, matched: MatchedGrids, wrong: str) -> Iterator[Verdict]:
    where, made = matched.path, len(matched.frames)
    missing = matched.absent
    share = len(missing) / (made + len(missing))
    text = f"{len(missing)} of {made + len(missing)} frames have no grid ({share:.1%})"
    text += f": {', '.join(map(str, missing[:8]))}{' ...' if len(missing) > 8 else ''}" if missing else ""
    advice = "make these frames, or say why they are missing" if missing else ""
    yield Verdict("missing frames", "fault" if missing else "sound", share, share, share, "share", text, where, advice)
    frames, without = int(stretches.stacked("frames").sum()), int(stretches.stacked("without mask").sum())
    if 0 < without < frames:
        text = f"{without} of {frames} frames do not say which voxels are known"
        share = without / frames
        yield Verdict("missing masks", "fault", share, share, share, "share", text, where, "write the masks of all frames")  # fmt: skip
    kinds = stretches.stacked("classes of grids").sum(axis=0)
    rows = stretches.drawn("confusion")
    table = matched.grid_classes
    if not wrong and rows.ndim == 3 and table is not None and rows[0].sum():
        seen = np.flatnonzero(rows[0].sum(axis=1) >= _LEAST).tolist()
        gone = [table.names.get(i, str(i)) for i in seen if i >= len(kinds) or not kinds[i]]
        text = f"classes that scans show and no voxel has: {', '.join(gone)}" if gone else "every class of the scans is in the grids"  # fmt: skip
        yield Verdict("missing classes", "fault" if gone else "sound", len(gone), len(gone), len(gone), "classes", text, where, "label the voxels of these classes" if gone else "")  # fmt: skip
    unknown = stretches.drawn("unknown")
    if unknown.shape[1]:
        parts = unknown[0, 1:] / max(unknown[0, 0], 1)
        causes = ("hold a return", "are crossed by rays", "are outside the view", "are hidden")
        text = f"{parts.sum():.1%} of the voxels are unknown: " + ", ".join(f"{part:.1%} {cause}" for part, cause in zip(parts, causes, strict=True))  # fmt: skip
        whole = interval(unknown[:, 1:].sum(axis=1), unknown[:, 0]) or (0.0, 0.0, 0.0)
        yield Verdict("unknown space", "sound", *whole, "share", text, where)
