"""The verdicts on the geometry, the times and the drift of grids.

The share of the points of scans in occupied voxels is highest if scans and grids are aligned, and
it already falls at a shift of a tenth of a voxel. Each correction is therefore a hypothesis, and
the best one gives the fault and its size. Corrections come in families, most of which move the
points of scans by an affine map.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from carlasc.core.arrays import FloatArray
from carlasc.core.geometry import choices_of_axes, rotation_z
from carlasc.core.grids import GridSpec
from carlasc.errors import count
from carlasc.inspection.auditing.matching import MatchedGrids
from carlasc.inspection.auditing.verdicts import Stretches, Verdict

# A correction must raise the share of points in occupied voxels by this much, and lower the share
# of other points by this factor.
_GAIN = 0.01
_FEWER = 1.3  # fact: fewer-conflicts
_ALIKE = 0.02  # axes and lags are not distinguished if their shares differ by less; fact: alike
_SAME = 0.25  # of the gain: corrections are not distinguished if their gains differ by less
_FLAT = 0.006  # values are equal if their shares differ by less
# fact: belongs
_BELONGS = 0.75  # with a smaller share of points, scans and grids do not belong together
_DRIFT = "height drift"  # kind and name of its family


@dataclass(frozen=True)
class _Fit:
    """How well the corrections of a family fit."""

    family: Family
    shares: FloatArray  # (1 + DRAWS, V), -1 where no point was tried

    @cached_property
    def best(self) -> int:
        return int(self.shares[0].argmax())

    @property
    def value(self) -> float:
        return float(self.family.values[self.best])

    @property
    def is_measured(self) -> bool:
        return float(np.delete(self.shares[0], self.family.neutral).max()) >= 0

    @property
    def gain(self) -> float:
        return float(self.shares[0, self.best] - self.shares[0, self.family.neutral])

    @property
    def is_fault(self) -> bool:
        """Whether a correction fits better than the data as they are, by more than chance, and the
        fault is large enough to matter.
        """
        family = self.family
        own, best = (1 - float(self.shares[0, row]) for row in (family.neutral, self.best))
        gains = self.shares[1:, self.best] - self.shares[1:, family.neutral]
        if self.gain < _GAIN or own < _FEWER * best or float(np.quantile(gains, 0.025)) <= 0:
            return False
        neutral = float(family.values[family.neutral])
        low, high = self.interval
        is_large = abs(self.value - neutral) >= 0.99 * family.least and not low <= neutral <= high
        return is_large or family.kind in ("axes", "lag")

    @cached_property
    def interval(self) -> tuple[float, float]:
        """The lowest and the highest value that fit as well as the best one, or are the best in
        nearly all draws.
        """
        values = self.family.values
        worse = np.flatnonzero(self.shares[0] < self.shares[0, self.best] - _FLAT)
        low = int(worse[worse < self.best].max(initial=-1)) + 1
        high = int(worse[worse > self.best].min(initial=len(values))) - 1
        drawn = np.quantile(values[self.shares[1:].argmax(axis=1)], (0.025, 0.975))
        return min(float(values[low]), float(drawn[0])), max(float(values[high]), float(drawn[1]))


def judge_geometry(stretches: Stretches, one: MatchedGrids) -> Iterator[Verdict]:
    """Yield the verdicts on axes, shifts, yaw, voxel size, drift of height, and lag, from the sums
    of a sequence.
    """
    sums = stretches.drawn("fits")
    if sums is None or not sums[0, 0, 0]:
        text = "no point of a scan is inside a grid"
        yield Verdict.of(one.path, "geometry", "undetermined", text, unit="")
        return
    shares = np.where(sums[..., 0] > 0, sums[..., 1] / np.maximum(sums[..., 0], 1), -1.0)
    kinds = families(one.spec)
    ends = np.cumsum([len(family.values) for family in kinds])
    fits = [
        _Fit(family, part)
        for family, part in zip(kinds, np.split(shares, ends[:-1], axis=1), strict=True)
    ]
    top = max(float(fit.shares[0].max()) for fit in fits)
    own = shares[:, 0]
    low, high = np.quantile(own[1:], (0.025, 0.975)).tolist()
    text = (
        f"{own[0]:.1%} of the points of scans are in occupied voxels, {top:.1%} with the best "
        "correction"
    )
    advice = (
        "check that scans and grids are of the same sequence and in a known coordinate frame; "
        f"tried: {one.pair}"
    )
    yield Verdict.of(one.path, "fit", top < _BELONGS, text, (float(own[0]), low, high), advice)
    if top < _BELONGS:
        return
    faults = [fit for fit in fits if fit.is_measured and fit.is_fault]
    if one.of_these_poses:  # a drift of height is theirs
        drifts = [fit for fit in faults if fit.family.kind == _DRIFT]
        faults = [fit for fit in faults if fit.family.kind != _DRIFT]
        fits = [fit for fit in fits if not drifts or fit.family.kind != _DRIFT]
        for fit in drifts:
            text = f"{_describe(fit, one)}: the poses of the recording drift, not the grids"
            found = (fit.value, *fit.interval)
            yield Verdict.of(one.path, _DRIFT, False, text, found, unit=fit.family.unit)
    if not faults:
        yield from (_sound_or_not(fit, one.path) for fit in fits)
        return
    winner = max(faults, key=lambda fit: fit.gain)
    if winner.family.kind == "voxel size":
        # a shift that fits nearly as well as another size is preferred: it needs fewer assumptions
        near = (1 - _SAME / 5) * winner.gain
        shifts = [fit for fit in faults if fit.family.kind == "shift" and fit.gain >= near]
        winner = max(shifts, key=lambda fit: fit.gain, default=winner)
    for fit in faults:
        both_shift = fit.family.kind == winner.family.kind == "shift"
        if fit is winner or (both_shift and fit.gain >= _SAME * winner.gain):
            yield _fault(fit, faults, one)
    text = f"not judged before the fault of {winner.family.name} is corrected"
    yield Verdict.of(one.path, "other geometry", "undetermined", text, unit="")


def _fault(fit: _Fit, faults: list[_Fit], one: MatchedGrids) -> Verdict:
    family, (low, high) = fit.family, fit.interval
    others = " or ".join(
        other.family.name
        for other in faults
        if other is not fit
        and other.family.kind != "voxel size"
        and other.gain >= (1 - _SAME / 3) * fit.gain
    )
    also = f"; {others} explains it nearly as well" if others else ""
    own, best = (float(fit.shares[0, row]) for row in (family.neutral, fit.best))
    text = (
        f"{_describe(fit, one)}: corrected, {best:.1%} instead of {own:.1%} of points are in "
        f"occupied voxels{also}"
    )
    if family.kind == "axes":
        low = high = fit.value
    found = (fit.value, low, high)
    return Verdict.of(one.path, family.name, True, text, found, family.advice, family.unit)


def _sound_or_not(fit: _Fit, where: str) -> Verdict:
    """Return the verdict of a family without a better correction: sound, if the data distinguish
    the right value from others.
    """
    family, shares, (low, high) = fit.family, fit.shares[0], fit.interval
    neutral = float(family.values[family.neutral])
    found = (neutral, neutral, neutral)
    unclear = ""
    if family.kind == "axes":
        text = "those of the scans"
        others = np.flatnonzero(shares[1:] >= shares[0] - _ALIKE)
        unclear = f"the scene looks the same with {AXES[others[0] + 1][0]}" if len(others) else ""
    elif family.kind == "lag":
        text = "grids fit their own scans best"
        near = shares[np.abs(family.values) == 1]
        is_alike = (near >= shares[family.neutral] - _ALIKE).any()
        unclear = "the vehicle hardly moves" if is_alike else ""
    else:
        found = (fit.value, low, high)
        small = "" if fit.value == neutral else ", too little to matter"
        text = f"{fit.value:.3g} {family.unit} (95%: {low:.3g} to {high:.3g}){small}"
        if high - low > family.widest:
            unclear = f"any value from {low:.3g} to {high:.3g} {family.unit} fits this drive"
    if not fit.is_measured:
        unclear = "no other scans near enough, or no poses"
    if unclear:
        return Verdict.of(where, family.name, "undetermined", unclear, unit=family.unit)
    return Verdict.of(where, family.name, False, text, found, unit=family.unit)


def _describe(fit: _Fit, one: MatchedGrids) -> str:
    value, (low, high), name = fit.value, fit.interval, fit.family.name
    ends = f"(95%: {low:.3g} to {high:.3g})"
    if fit.family.kind == "axes":
        return AXES[fit.best][0]
    if fit.family.kind == "lag":
        late, other = ("late", "before") if value < 0 else ("early", "after")
        frames = f"{count(round(abs(value)), 'frame')} ({abs(value) * one.period_s:.2f} s)"
        return f"grids are {frames} {late}: each fits a scan {other} its own"
    if fit.family.kind == "shift":
        voxels = value / shift_step(one.spec, name[-1])
        return f"grids are moved by {value:.3f} m along {name[-1]}, {voxels:.2f} voxels {ends}"
    if fit.family.kind == "yaw":
        return f"grids are turned by {value:.2f} degrees {ends}"
    if fit.family.kind == _DRIFT:
        return f"height increases with the time of the scan, by {value:.2f} m/s {ends}"
    axes = (0, 1) if "x, y" in name else (2,) if " z" in name else (0, 1, 2)
    true = ", ".join(f"{one.spec.voxel_size[axis] / value:.3g}" for axis in axes)
    return f"the declared size is {value:.3f} times the true one {ends}, which is {true} m"


# steps of a shift, in voxels, and as far as these go
_FINE = 0.1
_VOXELS = 1.5
_COARSE_M = {
    "x": np.arange(-4.0, 4.5, 0.5),
    "y": np.arange(-4.0, 4.5, 0.5),
    "z": np.arange(-3.0, 3.25, 0.25),
}
_YAW_DEG = np.sort([*np.arange(-6.0, 6.01, 0.25), -30, -20, -15, -10, -8, 8, 10, 15, 20, 30])
_RATIOS = np.unique(np.round([*np.geomspace(0.5, 2.0, 57), 0.8, 1.25, 2 / 3, 1.5], 6))
_DRIFT_M_S = np.round(np.arange(-0.3, 0.301, 0.01), 2)
_LAGS = np.arange(-3.0, 4.0)


@dataclass(frozen=True)
class Family:
    """Corrections of one kind, among them one that changes nothing.

    Attributes:
        name: name of the fault, such as "shift x".
        kind: "axes", "shift", "yaw", "voxel size", "height drift" or "lag".
        values: (V,) size of the fault that each correction removes, rising; numbers of the choices
            of axes.
        warps: (V, 3, 5) maps of points: p' = A p + b + c dt, as columns A, b, c; dt is how much
            later than the frame the points were seen.
        neutral: row of the correction that changes nothing.
        unit: of the values.
        least: smaller faults are ignored.
        widest: with a wider interval of values, the fault is undetermined.
        advice: what to do.
    """

    name: str
    kind: str
    values: FloatArray
    warps: FloatArray
    neutral: int
    unit: str
    least: float
    widest: float
    advice: str


@cache
def families(spec: GridSpec) -> list[Family]:
    """Return the families of corrections of a grid."""
    advice = "give grids and scans the same axes"
    still = [np.eye(3)]
    made = [_family("axes", "axes", range(len(AXES)), [m for _, m in AXES], advice)]
    advice = (
        "move the bounds, or correct the position of the sensor in the poses that the grids were "
        "made with"
    )
    for axis, name in enumerate("xyz"):
        step = shift_step(spec, name)
        coarse = _COARSE_M[name]
        fine = np.arange(-round(_VOXELS / _FINE), round(_VOXELS / _FINE) + 1) * _FINE * step
        values = np.sort([*fine, *coarse[np.abs(coarse) > _VOXELS * step + 0.01]])
        shifts = _family(f"shift {name}", "shift", values, still, advice, "m", 0.2 * step, step)
        shifts.warps[:, axis, 3] = values
        made.append(shifts)
    turns = [rotation_z(angle)[:3, :3] for angle in np.radians(_YAW_DEG)]
    advice = "correct the yaw of the sensor in the calibration that the grids were made with"
    made.append(_family("yaw", "yaw", _YAW_DEG, turns, advice, "degrees", 0.4, 1.5))
    anchors = {"": np.zeros(3), ", lower bound kept": np.array(spec.lower)}
    advice = "correct the declared voxel size or bounds"
    kind = "voxel size"
    for axes, which in (("", (1, 1, 1)), (" x, y", (1, 1, 0)), (" z", (0, 0, 1))):
        # the fault is declared = ratio * true size: p is in the true grid where p * ratio is in the
        # declared one
        scales = [np.diag(np.where(which, ratio, 1.0)) for ratio in _RATIOS]
        for anchor, fixed in anchors.items():
            if not anchor or spec.coordinates == "cartesian":
                name = f"{kind}{axes}{anchor}"
                sizes = _family(name, kind, _RATIOS, scales, advice, "times", 0.02, 0.15)
                sizes.warps[:, :, 3] = fixed - sizes.warps[:, :, :3] @ fixed
                made.append(sizes)
    advice = "refine the poses (`carlasc refine`) and make the grids again"
    drift = _family(_DRIFT, _DRIFT, _DRIFT_M_S, still, advice, "m/s", 0.02, 0.06)
    drift.warps[:, 2, 4] = _DRIFT_M_S
    advice = "give the grids the numbers or the times of these scans"
    return [*made, drift, _family("lag", "lag", _LAGS, still, advice, "frames", 1.0, 1.0)]


def shift_step(spec: GridSpec, axis: str) -> float:
    """Return the size of a voxel along x, y or z; in a cylindrical grid, x and y take the size
    along the radius.
    """
    radial = spec.coordinates == "cylindrical" and axis != "z"
    return float(spec.voxel_size[0 if radial else "xyz".index(axis)])


def _family(
    name: str,
    kind: str,
    values: Sequence[float] | FloatArray | range,
    matrices: Sequence[FloatArray],
    advice: str,
    unit: str = "",
    least: float = 0.0,
    widest: float = np.inf,
) -> Family:
    sizes = np.asarray(values, np.float64)
    warps = np.zeros((len(sizes), 3, 5))
    warps[:, :, :3] = matrices
    neutral = int(np.abs(sizes - (kind == "voxel size")).argmin())
    return Family(name, kind, sizes, warps, neutral, unit, least, widest, advice)


_MIRRORED = {"-x, y, z": "x mirrored", "x, -y, z": "y mirrored", "x, y, -z": "z mirrored"}
AXES = [
    (_MIRRORED.get(n, f"x, y, z of the grid are {n} of the scans"), matrix)
    for n, matrix in choices_of_axes()
]
"""The choices of axes: (description, (3, 3) matrix from the scans' axes to the grid's); the first
is the right one.
"""
