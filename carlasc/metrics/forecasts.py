"""Scoring forecasts: grids that predict a later frame."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from carlasc.core.arrays import BoolArray, IntArray, LabelArray
from carlasc.core.choices import Around
from carlasc.core.classes import ClassTable
from carlasc.core.frames import Frames
from carlasc.core.geometry import invert
from carlasc.core.grids import Grid
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.metrics.conventions import Convention
from carlasc.metrics.evaluation import score_pairs
from carlasc.metrics.grids import SequenceGrid
from carlasc.metrics.pairs import Pair, Place, pair_grids
from carlasc.metrics.results import Evaluation
from carlasc.metrics.scoring import Scoring
from carlasc.metrics.temporal import moved_grid
from carlasc.running.spreading import Run
from carlasc.storage import as_source, layout
from carlasc.storage.files import AnyPath
from carlasc.storage.voxel_files import GridFrames, SeenBy

_NAMED = re.compile(r"(.+)_(\d+(?:\.\d+)?)s")  # name of a forecast grid: a name and a time horizon
# fact: forecast-time
_TOLERANCE_S = 0.05  # for the time of the later frame: half the period of most LiDARs


class FutureGrid(GridFrames):
    """The grids of later frames of a sequence, by the number of the present frame, in which the
    forecast is made.
    """

    def __init__(self, grid: GridFrames, horizon_s: float, around: Around) -> None:
        """Find the later frame of each frame.

        Args:
            grid: the grids of the sequence.
            horizon_s: time between the present and the later frame, seconds.
            around: sensor pose at the centre of the result: of the present frame ("present") or of
                the later frame ("future").

        Raises:
            MissingDataError: the grids have no sequence, no frame has a later frame, or poses to
                move it to the present are missing.
        """
        if not isinstance(grid, SequenceGrid):
            raise MissingDataError(
                grid.location, expected="a sequence with poses and times", found="files of grids"
            )
        self.grid = grid
        self.around = around
        self.path = grid.path
        self.location = grid.location
        self.spec = grid.spec
        self.classes = grid.classes
        self.named = grid.named
        numbers = grid.frames()
        sequence = grid.sequence
        times = sequence.times_of(numbers)
        wanted = times + horizon_s
        after = np.searchsorted(times, wanted).clip(max=len(times) - 1)
        before = np.maximum(after - 1, 0)
        later = np.where(wanted - times[before] < times[after] - wanted, before, after)
        near = np.abs(times[later] - wanted) <= _TOLERANCE_S
        self.later = dict(zip(numbers[near].tolist(), numbers[later[near]].tolist(), strict=True))
        if not self.later:
            found = f"frames of {np.ptp(times):g} s" if len(times) else "none"
            raise MissingDataError(
                self.location, expected=f"frames that are {horizon_s:g} s apart", found=found
            )
        if around == "present" and layout.POSES not in sequence.documents():
            raise MissingDataError(
                sequence.location,
                expected=f"{layout.POSES}, which moves later frames to the present",
                found="none",
                advice="for grids around the sensor pose of the later frame, use `around=future`",
            )

    def frames(self) -> IntArray:
        """Return the sorted frames that have a later frame."""
        return np.array(sorted(self.later), np.int64)

    def labels(self, frame: int) -> LabelArray:
        """Return (X, Y, Z) the labels of the later frame."""
        return self._later(frame).labels

    def known(self, frame: int, seen_by: SeenBy = "lidar") -> BoolArray | None:
        """Return (X, Y, Z) bool, the known voxels of the later frame; None for cameras, because
        their mask cannot be moved.
        """
        if seen_by == "camera" or f"{self.grid.grid}/counts" not in self.grid.sequence.fields():
            return None
        return self._later(frame).known

    def _later(self, frame: int) -> Grid:
        sequence = self.grid.sequence
        later = self.later[frame]
        grid = sequence.grid(self.grid.grid, later)
        if self.around == "future":
            return grid
        return moved_grid(grid, invert(sequence.read_pose(frame)) @ sequence.read_pose(later))


def evaluate_forecasts(
    source: Place,
    truth: Place,
    *,
    around: Around = "present",
    convention: str | Convention | None = None,
    grid: str | None = None,
    truth_grid: str | None = None,
    source_classes: AnyPath | ClassTable | None = None,
    scoring: Scoring = Scoring(),  # noqa: B008 (frozen)
    frames: Frames = None,
    run: Run = Run(workers=1),  # noqa: B008 (frozen)
) -> Mapping[float, Evaluation]:
    """Score forecasts against the ground truth of later frames, separately for each time horizon.

    The forecasts are grids of `source` whose names end with the horizon: frame 10 of
    `forecast_1.5s` is the forecast that was made in frame 10 for the time 1.5 s later. The later
    frame is found by times.txt, with a tolerance of 0.05 s (without times.txt: ten frames per
    second). Frames without a later frame are left out.

    Args:
        source: the forecasts: a data set in the layout, in any store.
        truth: the ground truth, in the same forms, with poses.txt.
        around: sensor pose at the centre of the forecast grids: of the frame in which they are made
            ("present"; the later grid is moved to it by the poses), or of the later frame
            ("future"). Voxels outside the moved grid are unknown.
        convention: as in `evaluate`.
        grid: name of the forecast grids without the horizon, such as `forecast`; None takes the
            only name.
        truth_grid: name of the true grid; None takes `evaluation`, or the only grid of a sequence.
        source_classes: as in `evaluate`.
        scoring: voxels to score. Rays, actors and motion are not supported.
        frames: frames in which the scored forecasts are made; None for all.
        run: how the work is distributed, and the progress callback.

    Returns:
        The scores by horizon, seconds, in ascending order.

    Raises:
        ArgumentError: an argument has an unknown value, or `scoring` requests rays, actors or
            motion.
        MissingDataError: no forecast grid or no later frame exists.
        FormatError: the grids or classes of prediction and ground truth cannot be compared.
    """
    if scoring.rays or scoring.actors or "motion" in scoring.by:
        asked = "rays" if scoring.rays else "actors" if scoring.actors else "by motion"
        raise ArgumentError(
            "scoring",
            expected="classes, by distance, height or visibility for forecasts",
            found=asked,
        )
    results = {}
    for horizon_s, name in _horizons(source, grid).items():
        pairs, notes = pair_grids(source, truth, name, truth_grid)
        pairs = [Pair(pair.prediction, FutureGrid(pair.truth, horizon_s, around)) for pair in pairs]
        results[horizon_s] = score_pairs(
            pairs, convention, source_classes, scoring, frames, f"{horizon_s:g} s", run, notes
        )
    return results


def _horizons(source: Place, grid: str | None) -> dict[float, str]:
    """Return the names of forecast grids by horizon, sorted.

    Raises:
        MissingDataError: no forecast grid exists.
        ArgumentError: several forecast grids have the same horizon.
    """
    opened = as_source(source)
    tokens = dict[float, str]()
    names = sorted({name for sequence in opened.sequences().values() for name in sequence.grids})
    for match in filter(None, map(_NAMED.fullmatch, names)):
        if (
            match[1] == (grid or match[1])
            and (other := tokens.setdefault(float(match[2]), match[0])) != match[0]
        ):
            both = f"{other} and {match[0]}"
            raise ArgumentError(
                "grid",
                expected="one forecast grid per horizon",
                found=both,
                advice="choose a name with `grid`",
            )
    if not tokens:
        expected = f"grids of forecasts such as {grid or 'forecast'}_1s"
        raise MissingDataError(
            opened.location, expected=expected, found=", ".join(names) or "no grid"
        )
    return dict(sorted(tokens.items()))
