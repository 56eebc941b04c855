"""From the sums of stretches of frames to verdicts: the geometry, lags and drifts. Intervals come from drawing stretches with replacement.

The share of the points of scans that lie in occupied voxels is highest where scans and grids belong together, and falls within a tenth of a
voxel. Each correction is therefore a hypothesis, and the best one names the fault and its size.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import GridSpec
from carlasc.inspection.auditing.counting import Sums
from carlasc.inspection.auditing.hypotheses import AXES, Family, drift_family, families
from carlasc.inspection.auditing.tallies import LAGS
from carlasc.inspection.auditing.verdicts import Verdict

DRAWS = 300
_GAIN, _FEWER = (
    0.01,
    1.3,
)  # a correction must raise the share of points in occupied voxels by so much, and lower that of others by this factor
_ALIKE = 0.02  # axes and lags whose shares differ by less are not told apart
_SAME = 0.25  # of the gain: corrections whose gains differ by less are not told apart
_FLAT = 0.006  # values whose shares differ by less are equal
_BELONGS = 0.75  # share of points below which scans and grids do not belong together
_LEAST = {
    "shift": 0.2,
    "yaw": 0.4,
    "voxel size": 0.02,
    "height drift": 0.02,
}  # smaller faults are none; shifts in voxels
_WIDEST = {"shift": 1.0, "yaw": 1.5, "voxel size": 0.15, "height drift": 0.06}  # a wider interval determines nothing
_ADVICE = {
    "axes": "give grids and scans the same axes",
    "shift": "move the bounds, or the place of the sensor in the poses that the grids were made with",
    "yaw": "turn the calibration of the sensor that the grids were made with",
    "voxel size": "correct the voxel size or the bounds that are declared",
    "height drift": "refine the poses (`carlasc refine`) and make the grids again",
    "lag": "give the grids the numbers or times of these scans",
}


@dataclass(frozen=True)
class Stretches:
    """The sums of a sequence, stretch by stretch.

    Attributes:
        parts: the sums of each stretch, in order.
    """

    parts: Sequence[Sums]

    def stacked(self, name: str) -> NDArray[np.int64]:
        """Return (S, ...) the counts of each stretch, 0 where it has none; (S, 0) if no stretch has any."""
        found = [part[name] for part in self.parts if name in part]
        shape = tuple(np.max([f.shape for f in found], axis=0)) if found else (0,)
        stack = np.zeros((len(self.parts), *shape), np.int64)
        for row, part in enumerate(self.parts):
            if name in part:
                stack[row][tuple(slice(n) for n in part[name].shape)] = part[name]
        return stack

    @cached_property
    def _weights(self) -> NDArray[np.float64]:
        count = len(self.parts)
        drawn = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), DRAWS)
        return np.concatenate([np.ones((1, count)), drawn]).astype(np.float64)

    def drawn(self, name: str) -> NDArray[np.float64]:
        """Return (1 + DRAWS, ...) sums of all stretches, then of stretches drawn with replacement."""
        return np.einsum("ds,s...->d...", self._weights, self.stacked(name).astype(np.float64))

    def share(self, name: str, part: int, whole: int) -> tuple[float, float, float] | None:
        """Return a share of two counts of a row of counts, with its interval; None if there is nothing to share."""
        sums = self.drawn(name)
        return None if sums.shape[1] <= max(part, whole) else interval(sums[:, part], sums[:, whole])


def interval(part: NDArray[np.float64], whole: NDArray[np.float64]) -> tuple[float, float, float] | None:
    """Return a share and its interval of 95 % from (1 + DRAWS,) counts; None if the whole is 0."""
    if not whole[0] > 0:
        return None
    shares = part / np.where(whole > 0, whole, np.nan)
    low, high = np.nanquantile(shares[1:], (0.025, 0.975)).tolist()
    return float(shares[0]), min(low, float(shares[0])), max(high, float(shares[0]))


@dataclass(frozen=True)
class _Fit:
    """How well the corrections of a family fit."""

    family: Family
    shares: NDArray[np.float64]  # (1 + DRAWS, V)

    @cached_property
    def best(self) -> int:
        return int(self.shares[0].argmax())

    @property
    def kind(self) -> str:
        return next((kind for kind in _LEAST if self.family.name.startswith(kind)), self.family.name)

    @property
    def gain(self) -> float:
        return float(self.shares[0, self.best] - self.shares[0, self.family.neutral])

    @property
    def is_certain(self) -> bool:
        """Whether the gain is more than chance: positive in nearly all draws."""
        gains = self.shares[1:, self.best] - self.shares[1:, self.family.neutral]
        own, best = (1 - float(self.shares[0, row]) for row in (self.family.neutral, self.best))
        return self.gain >= _GAIN and own >= _FEWER * best and float(np.quantile(gains, 0.025)) > 0

    @cached_property
    def interval(self) -> tuple[float, float]:
        """The values about the best one that fit as well, and those that are best in nearly all draws."""
        values, flat = self.family.values, self.shares[0] >= self.shares[0, self.best] - _FLAT
        low = high = self.best
        while low > 0 and flat[low - 1]:
            low -= 1
        while high + 1 < len(values) and flat[high + 1]:
            high += 1
        drawn = np.quantile(values[self.shares[1:].argmax(axis=1)], (0.025, 0.975))
        return min(float(values[low]), float(drawn[0])), max(float(values[high]), float(drawn[1]))

    def size(self, spec: GridSpec) -> float:
        """Return one unit of the family's limits: the size of a voxel for shifts."""
        if self.kind != "shift":
            return 1.0
        axis = "xyz".index(self.family.name[-1])
        return float(spec.voxel_size[0 if spec.coordinates == "cylindrical" and axis < 2 else axis])


def judge_geometry(stretches: Stretches, spec: GridSpec, where: str, period_s: float) -> Iterator[Verdict]:
    """Yield the verdicts on axes, shifts, yaw, voxel size, drift of height, and lag.

    Args:
        stretches: the sums of a sequence.
        spec: geometry of its grids.
        where: name of the sequence in verdicts.
        period_s: seconds between two scans.
    """
    sums = stretches.drawn("fits")
    if not sums[0, 0]:
        yield Verdict("geometry", "undetermined", None, None, None, "", "no point of a scan is inside a grid", where)
        return
    fits, first = [], 1
    for family in families(spec):
        rows = slice(first, first + len(family.values))
        fits.append(_Fit(family, sums[:, rows] / np.maximum(sums[:, :1], 1)))
        first += len(family.values)
    lags = _lag_fit(stretches, fits[0])
    drifted, drift = stretches.drawn("drift"), drift_family()
    if drifted.shape[1] and drifted[0, 0]:
        fits.append(_Fit(drift, drifted[:, 1:] / np.maximum(drifted[:, :1], 1)))
    else:
        text = "no scans two seconds apart with poses"
        yield Verdict(drift.name, "undetermined", None, None, None, drift.unit, text, where)
    found = [fit for fit in [lags, *fits] if fit.is_certain and _counts(fit, spec)]
    top = max(float(fit.shares[0].max()) for fit in [lags, *fits])
    certain = stretches.drawn("fits")[:, 1] / np.maximum(sums[:, 0], 1)
    ends = [float(value) for value in np.quantile(certain[1:], (0.025, 0.975))]
    text = f"{certain[0]:.1%} of the points of scans are in occupied voxels, {top:.1%} under the best correction"
    if top < _BELONGS:
        advice = "these are scans of another sequence, or the grids are in a frame that no correction reaches"
        yield Verdict("fit", "fault", float(certain[0]), ends[0], ends[1], "share", text, where, advice)
        return
    yield Verdict("fit", "sound", float(certain[0]), ends[0], ends[1], "share", text, where)
    winner = _winner(found)
    if winner is None:
        yield from (_sound_or_not(fit, spec, where) for fit in [lags, *fits])
        return
    for fit in found:
        together = fit.kind == winner.kind == "shift" and fit.gain >= _SAME * winner.gain
        if fit is winner or together:
            yield _fault(fit, found, spec, where, period_s)
    text = f"the rest is not told before {winner.family.name} is right"
    yield Verdict("other geometry", "undetermined", None, None, None, "", text, where)


def _winner(found: list[_Fit]) -> _Fit | None:
    """Return the correction that fits best; of several that fit nearly as well, the one of the fewest values."""
    if not found:
        return None
    best = max(found, key=lambda fit: fit.gain)
    near = [fit for fit in found if fit.gain >= (1 - _SAME / 5) * best.gain]
    shifts = [fit for fit in near if fit.kind == "shift"]
    return best if best.kind != "voxel size" or not shifts else max(shifts, key=lambda fit: fit.gain)


def _counts(fit: _Fit, spec: GridSpec) -> bool:
    """Return whether a fault is large enough, and its interval does not hold the value of no fault."""
    if fit.kind in ("axes", "lag"):
        return fit.best != fit.family.neutral
    value, neutral = fit.family.values[fit.best], fit.family.values[fit.family.neutral]
    low, high = fit.interval
    return bool(abs(value - neutral) >= 0.99 * _LEAST[fit.kind] * fit.size(spec) and not low <= neutral <= high)


def _lag_fit(stretches: Stretches, axes: _Fit) -> _Fit:
    sums = stretches.drawn("lags").reshape(DRAWS + 1, -1, 2)
    values = np.array([*LAGS, 0.0])
    if not sums.shape[1]:
        sums = np.zeros((DRAWS + 1, len(LAGS), 2))
    others = np.where(sums[:, :, 0] > 0, sums[:, :, 1] / np.maximum(sums[:, :, 0], 1), 0.0)
    shares = np.column_stack([others, axes.shares[:, axes.family.neutral]])
    order = np.argsort(values)
    family = Family("lag", "frames", values[order], np.empty((0, 3, 5)), int(np.flatnonzero(values[order] == 0)[0]))
    return _Fit(family, shares[:, order])


def _fault(fit: _Fit, found: list[_Fit], spec: GridSpec, where: str, period_s: float) -> Verdict:
    name, family = fit.family.name, fit.family
    value, (low, high) = float(family.values[fit.best]), fit.interval
    rivals = [o.family.name for o in found if o is not fit and o.gain >= (1 - _SAME / 3) * fit.gain]
    rivals = [rival for rival in rivals if not rival.startswith("voxel size")]
    also = f"; {' or '.join(rivals)} explains it nearly as well" if rivals else ""
    own, share = float(fit.shares[0, family.neutral]), float(fit.shares[0, fit.best])
    text = f"{_describe(fit, spec, period_s)}: undone, {share:.1%} instead of {own:.1%} of points are in occupied voxels{also}"
    if fit.kind == "axes":
        value = low = high = float(fit.best)
    return Verdict(name, "fault", value, low, high, family.unit, text, where, _ADVICE[fit.kind])


def _sound_or_not(fit: _Fit, spec: GridSpec, where: str) -> Verdict:
    """Return the verdict of a family that explains nothing better: sound, if the right value is told from others."""
    family, shares = fit.family, fit.shares[0]
    neutral, (low, high) = float(family.values[family.neutral]), fit.interval
    value = float(family.values[fit.best])
    if fit.kind == "axes":
        others = [i for i in np.flatnonzero(shares >= shares[0] - _ALIKE).tolist() if i]
        if others:
            text = f"the scene looks the same with {AXES[others[0]][0]}"
            return Verdict("axes", "undetermined", None, None, None, "", text, where)
        return Verdict("axes", "sound", 0.0, 0.0, 0.0, "", "those of the scans", where)
    if fit.kind == "lag":
        near = shares[np.abs(family.values) == 1]
        wide = bool((near >= shares[family.neutral] - _ALIKE).any())
        text = "the vehicle hardly moves" if wide else "grids fit their own scans best"
        return Verdict("lag", "undetermined" if wide else "sound", None if wide else 0.0, None if wide else 0.0, None if wide else 0.0, "frames", text, where)  # fmt: skip
    wide = high - low > _WIDEST[fit.kind] * fit.size(spec)
    if wide:
        text = f"the drive does not tell values from {low:.3g} to {high:.3g} {family.unit} apart"
        return Verdict(family.name, "undetermined", None, low, high, family.unit, text, where)
    text = f"{value:.3g} {family.unit} (95 %: {low:.3g} to {high:.3g})"
    if value != neutral:
        text += ", too little to matter"
    return Verdict(family.name, "sound", value, low, high, family.unit, text, where)


def _describe(fit: _Fit, spec: GridSpec, period_s: float) -> str:
    value, (low, high), name = float(fit.family.values[fit.best]), fit.interval, fit.family.name
    ends = f"(95 %: {low:.3g} to {high:.3g})"
    if fit.kind == "axes":
        return AXES[fit.best][0]
    if fit.kind == "lag":
        late = "late" if value < 0 else "early"
        frames = f"{abs(value):.0f} frame{'s' if abs(value) > 1 else ''}"
        return f"grids are {frames} ({abs(value) * period_s:.2f} s) {late}: each shows what an {'earlier' if value < 0 else 'later'} scan saw"
    if fit.kind == "shift":
        return f"grids are moved by {value:.3f} m along {name[-1]}, {value / fit.size(spec):.2f} voxels {ends}"
    if fit.kind == "yaw":
        return f"grids are turned by {value:.2f} degrees {ends}"
    if fit.kind == "height drift":
        return f"places that were seen later are {value:.2f} m/s higher {ends}"
    axes = [
        "x, y" in name or name in ("voxel size", "voxel size, lower bound kept"),
        " z" in name or "x, y" not in name,
    ]
    sizes = spec.voxel_size / value
    true = ", ".join(f"{size:.3g}" for size, used in zip(sizes, (axes[0], axes[0], axes[1]), strict=True) if used)
    return f"{name}: declared is {value:.3f} times the true one {ends}, which is {true} m"
