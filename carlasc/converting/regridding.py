"""Grids of converted scans: each frame's grid from the scans around it in time, where the ground is."""

from __future__ import annotations

from collections.abc import Sequence as Series
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from carlasc.converting.plans import sequence_path
from carlasc.converting.protocol import Recording
from carlasc.converting.results import Steps
from carlasc.converting.stages import Conversion
from carlasc.core.grids import GridSpec
from carlasc.groundtruth.heights import Ground, fit_to_ground, joined
from carlasc.motion.options import PoseOptions
from carlasc.running.engines import Engine
from carlasc.running.options import Run
from carlasc.storage.protocol import Sequence, Source
from carlasc.storage.sinks import Sink

if TYPE_CHECKING:
    from carlasc.groundtruth import RegridResult
    from carlasc.groundtruth.options import FromScans, Voting


@dataclass(frozen=True)
class Regridding:
    """How grids are made from converted scans; the arguments are those of `convert`."""

    spec: GridSpec | None
    observe: FromScans | None
    voting: Voting | None
    follow_ground: bool
    force: bool
    workers: int
    executor: Engine | None
    steps: Steps

    def run(self, conversion: Conversion, spec: GridSpec, sink: Sink) -> RegridResult:
        """Make the grids of a converted recording, in the geometry that `fit` returned, from what was written to the sink."""
        from carlasc.groundtruth import FromScans, Voting, regrid

        last = 0
        self.steps.expect(len(conversion.plan.recording.frames))

        def advance(done: int, total: int) -> None:
            nonlocal last
            self.steps(done - last)
            last = done

        return regrid(
            _Converted(sink.source(), conversion.plan.recording),
            spec,
            sink,
            observe=replace(self.observe or FromScans(), poses=PoseOptions("file", force=self.force)),
            voting=self.voting or Voting(),
            run=Run(self.workers, self.executor, progress=advance),
        )

    def fit(self, conversions: Series[Conversion], where: str) -> tuple[GridSpec, list[str]]:
        """Return the grid, moved to where the ground is if that is asked for, and what users must know of it.

        It is the same for all recordings, so that one training set can hold them. `where` is the place that is written to.
        """
        spec = self.spec or GridSpec.published()
        grounds = [conversion.ground for conversion in conversions if conversion.ground is not None]
        fitted = fit_to_ground(spec, joined(grounds)) if grounds and self.follow_ground else spec
        if fitted == spec:
            return spec, []
        return fitted, [
            f"{where}: {_heights(grounds)} above the ground, so grids reach from {fitted.lower[2]:g} to {fitted.upper[2]:g} m in z"
            f" instead of {spec.lower[2]:g} to {spec.upper[2]:g}; bounds that are given are kept"
        ]


class _Converted(Source):
    """The sequence that one recording was converted to."""

    def __init__(self, source: Source, recording: Recording) -> None:
        self.location = source.location
        self._source, self._path = source, sequence_path(recording)

    def sequences(self) -> dict[str, Sequence]:
        return {self._path: self._source.sequences()[self._path]}


def _heights(grounds: Series[Ground]) -> str:
    low, high = (f"{pick(ground.below_m for ground in grounds):.2f}" for pick in (min, max))
    return f"the sensor is {low} m" if low == high else f"the sensors are {low} to {high} m"
