"""`Dataset`: what training code imports. Sequences of any Source as samples: dicts of NumPy arrays.

It is a map-style data set as torch's DataLoader wants one, and loads no torch. A sample is one frame: the grid to predict, and
the last `history` scans moved into the frame's own sensor frame and binned (FORMAT section 5).
"""

from __future__ import annotations

import operator
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, SupportsIndex, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from carlasc.core.classes import ClassTable, Remap
from carlasc.core.grids import Coordinates, GridSpec
from carlasc.core.tables import remap_named
from carlasc.dataset.selection import Part, choose, common_frames, find_grids, grid_named
from carlasc.errors import ArgumentError, FormatError, MissingDataError, import_extra
from carlasc.storage import Sequence, Source, as_source, layout

Sample = dict[str, Any]

FIELDS = ("occupancy", "density", "labels", "known", "counts", "points", "point_labels", "flow", "poses")
ALWAYS = ("valid", "sequence", "frame")
RAGGED = ("points", "point_labels", "flow")  # as many rows as the scan has points
_STACKS = frozenset({"occupancy", "density"})
_OF_GRID = {"labels": "labels", "known": "counts", "counts": "counts"}  # a sample's field -> the grid's
_OF_SCAN = {"points": "points", "point_labels": "labels", "flow": "flow"}  # a sample's field -> the scan's


if TYPE_CHECKING:  # type checkers see that torch's DataLoader takes it; no torch is loaded when it runs
    from torch.utils.data import Dataset as TorchDataset

    _MapStyle = TorchDataset[Sample]
else:
    _MapStyle = object


class Dataset(_MapStyle):
    """Frames of one or many sequences as training samples.

    A sample is a dict of the `fields` asked for, T being `history` and (X, Y, Z) the grid's size:

        occupancy     (T, X, Y, Z) uint8, 1 where a scan has a point; oldest scan first, the frame's own last
        density       (T, X, Y, Z) uint16, points a voxel
        labels        (X, Y, Z) uint8 class of each voxel (uint16 where ids go over 255); 0 is free, also where unknown
        known         (X, Y, Z) bool, voxels that were evaluated: leave the others out of losses and metrics
        counts        (X, Y, Z) float32 votes of each voxel
        points        (N, 3) float32 metres, the frame's sensor frame; all of them
        point_labels  (N,) uint8 class of each point
        flow          (N, 3) float32 m/s velocity of each point, sensor frame
        poses         (T, 4, 4) float64 current_T_past; the identity where not valid
        valid         (T,) bool, whether there is a scan; always there
        sequence      str, always there
        frame         int, always there

    The history stops at the start of a sequence and at a gap in its frame numbers: what would lie before is left empty
    and is not `valid`. Frames without a field that was asked for are left out. Points nearer than `min_range_m` or farther
    than `max_range_m` of carlasc.json go into no grid. Arrays come in the sequences' own frame: right-handed data
    are neither mirrored nor mixed with left-handed ones.

    Attributes:
        sequences: the sequences in use, in order; a sample's `sequence` is the name of its.
        axes: "left" (y to the right) or "right" (y to the left).
        classes: table of the label ids that samples hold, after the remap.
        transform: called with each sample, returns it changed; may be set later (see `carlasc.Flip`).
    """

    def __init__(
        self,
        root: str | os.PathLike[str] | Source,
        split: str | Iterable[str] | None = None,
        *,
        history: int = 1,
        coordinates: Coordinates = "cartesian",
        grid: str | GridSpec = layout.EVALUATION,
        grids_root: str | os.PathLike[str] | Source | None = None,
        fields: Iterable[str] = ("occupancy", "labels", "known"),
        remap: str | Remap | Mapping[int, int] | ArrayLike | None = "carlasc11",
        align: bool = True,
        transform: Callable[[Sample], Sample] | None = None,
    ) -> None:
        """Find the frames; no scan and no grid is read.

        Args:
            root: anything that `carlasc.open` takes, or a Source.
            split: "train", "val" or "test" in any case; or names of sequences; None takes all.
            history: T, number of scans in a stack, the frame's own included.
            coordinates: which grids: "cartesian" or "cylindrical" (a GridSpec as `grid` knows its own). Scans, poses and
                times come from the sequence's folder of that name if they are there, else from `cartesian/`.
            grid: name of the grid (its folder), whose params.json gives the geometry. Or a geometry: `labels`, `known` and
                `counts` then come from the grid that has it, and where none of them is asked for no grid need be there.
            grids_root: where grids are read from instead, for eval_fine.zip and eval_cylindrical.zip. Its sequences go to
                those of `root` by split and name.
            fields: what a sample holds, any of those above.
            remap: for `labels` and `point_labels`: a name in `carlasc.core.tables.REMAPS`, a Remap, a mapping or a table of
                ids; None keeps the ids as they stand.
            align: move past scans into the frame's sensor frame by their poses; False stacks them as they are.
            transform: called with each sample.

        Raises:
            ArgumentError: an argument makes no sense, or the remap is one for other classes.
            MissingDataError: there is no such split or sequence, or a sequence lacks what was asked for.
            FormatError: the sequences' grids or frames differ, or poses.txt does not fit the scans.
        """
        self.fields = _check_fields(fields)
        self.history = _check_history(history)
        self.align = align
        self.transform = transform
        coordinates = grid.coordinates if isinstance(grid, GridSpec) else coordinates
        if coordinates not in layout.COORDINATES:
            raise ArgumentError("coordinates", expected="cartesian or cylindrical", found=f"{coordinates!r}")

        source = as_source(root)
        chosen = choose(source, split, coordinates)
        if self._asks(_OF_GRID) or (self._asks(_STACKS) and isinstance(grid, str)):
            grids = find_grids(chosen, source if grids_root is None else as_source(grids_root), coordinates)
            self._parts = [self._part(*pair, grid_named(pair[1], grid)) for pair in zip(chosen, grids, strict=True)]
        else:
            self._parts = [self._part(scans, None, "") for scans in chosen]
        self._starts = np.cumsum([0, *(len(part.frames) for part in self._parts)])
        if not len(self):
            raise MissingDataError(
                source.location, expected=f"frames with {', '.join(self.fields)}", found="none that has all of them"
            )

        self.sequences = tuple(part.scans for part in self._parts)
        self.axes = _the_one({scans.location: scans.metadata.axes for scans in self.sequences}, "axes")
        self._spec = grid if isinstance(grid, GridSpec) else self._spec_of_grids()
        self._labels = self._labelling(remap)
        self.classes = self._labels.target

    @property
    def spec(self) -> GridSpec:
        """The geometry of the grids.

        Raises:
            ArgumentError: no field that was asked for needs a grid.
        """
        if self._spec is None:
            raise ArgumentError(
                "fields", expected="one that needs a grid, such as occupancy", found=f"{', '.join(self.fields)}"
            )
        return self._spec

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getitem__(self, index: SupportsIndex) -> Sample:
        """Return the sample at a place in `0..len - 1`; negative places count from the end.

        Raises:
            IndexError: it is beyond the end.
            FormatError: a file does not hold what it should; names the file.
        """
        place = operator.index(index)
        if not -len(self) <= place < len(self):
            raise IndexError(f"sample {place}: expected one of {len(self)}")
        part, frame = self._frame_at(place % len(self))
        past = part.history(frame, self.history)

        sample: Sample = {}
        if self._needs_poses:
            sample["poses"] = part.current_T_past(frame, past)
        if self._asks(_STACKS):
            sample |= self._stacks(part, past, sample.get("poses"))
        if self._asks(_OF_GRID):
            sample |= self._grid(part, frame)
        if self._asks(_OF_SCAN):
            sample |= self._scan(part, frame)
        sample["valid"] = np.array([number is not None for number in past])
        sample |= {"sequence": part.scans.name, "frame": frame}
        sample = {name: sample[name] for name in (*self.fields, *ALWAYS)}
        return sample if self.transform is None else self.transform(sample)

    def index_of(self, sequence: str, frame: int) -> int:
        """Return the place of a frame of a sequence.

        Raises:
            MissingDataError: it is no sample.
        """
        for part, start in zip(self._parts, self._starts, strict=False):
            if part.scans.name == sequence and frame in part.frames:
                return int(start + np.searchsorted(part.frames, frame))
        raise MissingDataError(f"frame {frame} of {sequence}: expected one of the {len(self)} samples")

    def __repr__(self) -> str:
        return f"<Dataset of {len(self)} frames in {len(self._parts)} sequences: {', '.join(self.fields)}>"

    def __getstate__(self) -> dict[str, Any]:
        """Leave decoded scans behind: each process keeps its own."""
        return {name: value for name, value in self.__dict__.items() if name != "_recent"}

    @cached_property
    def _recent(self) -> _RecentScans:
        return _RecentScans(self.history)

    def _asks(self, names: Iterable[str]) -> bool:
        return not set(names).isdisjoint(self.fields)

    @property
    def _needs_poses(self) -> bool:
        return "poses" in self.fields or (self._asks(_STACKS) and self.align and self.history > 1)

    def _part(self, scans: Sequence, grids: Sequence | None, grid: str) -> Part:
        wanted = {(scans, _OF_SCAN[field]): None for field in self.fields if field in _OF_SCAN}
        if self._asks(_STACKS) or not self._asks(_OF_GRID):
            wanted[scans, "points"] = None
        if grids is not None:
            uncounted = "counts" not in self.fields and not len(grids.frames(f"{grid}/counts"))
            parts = {_OF_GRID[field] for field in self.fields if field in _OF_GRID}
            # Without counts every voxel is known, in all frames that have labels.
            wanted |= {(grids, f"{grid}/{'labels' if uncounted else part}"): None for part in sorted(parts)}
        part = Part(scans, grids, grid, common_frames(wanted), frozenset(scans.frames("points").tolist()))
        if self._needs_poses:
            part.check_poses()
        return part

    def _spec_of_grids(self) -> GridSpec | None:
        specs = {part.grids.location: part.grids.grids[part.grid] for part in self._parts if part.grids is not None}
        return _the_one(specs, "grid geometry") if specs else None

    def _labelling(self, remap: str | Remap | Mapping[int, int] | ArrayLike | None) -> _Labelling:
        tables: dict[str, ClassTable] = {}
        for part in self._parts:
            if "point_labels" in self.fields:
                tables[part.scans.location] = part.scans.metadata.classes
            if "labels" in self.fields and part.grids is not None:
                tables[f"{part.grids.location}/{part.grid}"] = part.grids.classes_of(part.grid)
        where, found = next(iter(tables.items()), ("", self.sequences[0].metadata.classes))
        labelling = _Labelling(remap, found)
        if tables:
            _the_one({place: table.name for place, table in tables.items()}, "class table")
        if tables and labelling.source != found:
            raise ArgumentError(
                where,
                expected=f"labels of the class table {labelling.source.name} for the remap {labelling.name}",
                found=f"{found.name}",
                advice="give another remap=, or None to keep the ids",
            )
        return labelling

    def _frame_at(self, place: int) -> tuple[Part, int]:
        which = int(np.searchsorted(self._starts, place, side="right")) - 1
        return self._parts[which], int(self._parts[which].frames[place - self._starts[which]])

    def _stacks(self, part: Part, past: list[int | None], poses: NDArray[np.float64] | None) -> Sample:
        from carlasc.dataset.stacking import stack_scans

        spec = self.spec
        moves = poses if self.align and poses is not None else np.tile(np.eye(4), (self.history, 1, 1))
        scans = self._recent.read(part.scans, past)
        ranges = (part.scans.metadata.min_range_m, part.scans.metadata.max_range_m)
        if "density" not in self.fields:
            return {"occupancy": stack_scans(scans, moves, spec, "occupancy", *ranges)}
        density = stack_scans(scans, moves, spec, "density", *ranges)
        return {"density": density} | (
            {"occupancy": (density > 0).view(np.uint8)} if "occupancy" in self.fields else {}
        )

    def _grid(self, part: Part, frame: int) -> Sample:
        if part.grids is None:
            return {}
        sample: Sample = {}
        if "labels" in self.fields:
            field = f"{part.grid}/labels"
            sample["labels"] = self._labels(
                part.grids.read(field, frame), f"{part.grids.location}: {field} of frame {frame}"
            )
        if "known" in self.fields or "counts" in self.fields:
            field = f"{part.grid}/counts"
            counts = part.grids.read(field, frame) if len(part.grids.frames(field)) else None
            sample["known"] = np.ones(part.grids.grids[part.grid].size, np.bool_) if counts is None else counts > 0
            sample["counts"] = np.array(counts, np.float32) if "counts" in self.fields else None
        return sample

    def _scan(self, part: Part, frame: int) -> Sample:
        sample: Sample = {}
        if "points" in self.fields:
            (points,) = self._recent.read(part.scans, [frame])
            sample["points"] = np.array(points[:, :3] if points is not None else (), np.float32, order="C")
        if "point_labels" in self.fields:
            labels = part.scans.read("labels", frame)
            sample["point_labels"] = self._labels(labels, f"{part.scans.location}: labels of frame {frame}")
        if "flow" in self.fields:
            sample["flow"] = np.array(part.scans.read("flow", frame), np.float32, order="C")
        lengths = {name: len(array) for name, array in sample.items()}
        if len(set(lengths.values())) > 1:
            found = ", ".join(f"{length} {name}" for name, length in lengths.items())
            raise FormatError(f"{part.scans.location}: frame {frame}", expected="as many of each", found=f"{found}")
        return sample


def collate(samples: list[Sample]) -> dict[str, Any]:
    """Make a batch of samples that may hold ragged fields: give it to a DataLoader as `collate_fn`.

    `points`, `point_labels` and `flow` become lists of B tensors, one a sample; everything else is stacked as torch's
    default collate does.

    Raises:
        DependencyError: torch is not installed.
    """
    torch = import_extra("torch", "torch")
    dense = [{name: value for name, value in sample.items() if name not in RAGGED} for sample in samples]
    batch: dict[str, Any] = import_extra("torch.utils.data", "torch").default_collate(dense)
    ragged = {name: [torch.from_numpy(sample[name]) for sample in samples] for name in samples[0] if name in RAGGED}
    return {name: ragged[name] if name in ragged else batch[name] for name in samples[0]}


class _RecentScans(threading.local):
    """The scans that a thread read last, decoded: frames taken in order share all but one with the frame before.

    What is dropped is memory for what comes next, so scans are for the reading thread alone.
    """

    def __init__(self, capacity: int) -> None:
        super().__init__()
        self.capacity = capacity
        self._scans: OrderedDict[tuple[Sequence, int], NDArray[np.float32]] = OrderedDict()

    def read(self, sequence: Sequence, frames: list[int | None]) -> list[NDArray[np.float32] | None]:
        """Return the points of each frame as `Sequence.read_xyz` does, None for None, good until the next call.

        What is not at hand is read in one go.
        """
        wanted = [(sequence, frame) for frame in frames if frame is not None]
        for key in wanted:
            if key in self._scans:
                self._scans.move_to_end(key)
        missing = [key for key in wanted if key not in self._scans]
        spare = []
        while self._scans and len(self._scans) + len(missing) > self.capacity:
            spare.append(self._scans.popitem(last=False)[1])
        if missing:
            read = sequence.read_xyz([frame for _, frame in missing], spare)
            self._scans.update(zip(missing, read, strict=True))
        return [None if frame is None else self._scans[sequence, frame] for frame in frames]


class _Labelling:
    """What `remap` makes of labels: one lookup table, and an error that names the file and the id."""

    def __init__(self, remap: str | Remap | Mapping[int, int] | ArrayLike | None, classes: ClassTable) -> None:
        self._remap = None if remap is None else _as_remap(remap, classes)
        self.name = self._remap.name if self._remap else "none"
        self.source = self._remap.source if self._remap else classes
        self.target = self._remap.target if self._remap else classes
        self._table = self._remap.table if self._remap else np.arange(classes.num_channels, dtype=np.int32)

    def __call__(self, labels: NDArray[np.unsignedinteger], where: str) -> NDArray[np.unsignedinteger]:
        """Return the labels in the target's dtype; `where` is what to call them in an error."""
        from carlasc.dataset.stacking import look_up

        found = look_up(labels, self._table, self.target.dtype)
        if found is None and self._remap is not None:
            return self._remap(labels, where)  # raises, naming the id
        if found is None:
            self.source.check(labels, where)
            raise FormatError(f"{where}: expected class ids of {self.source.name}")
        return found


def _as_remap(remap: str | Remap | Mapping[int, int] | ArrayLike, classes: ClassTable) -> Remap:
    if isinstance(remap, Remap):
        return remap
    if isinstance(remap, str):
        return remap_named(remap)
    if isinstance(remap, Mapping):
        mapping = {int(old): int(new) for old, new in remap.items()}
    else:
        table = np.asarray(remap)
        if table.ndim != 1 or table.dtype.kind not in "iu" or not table.size:
            raise ArgumentError(
                "remap", expected="a name, a mapping or a table of ids", found=f"{type(remap).__name__}"
            )
        mapping = dict(enumerate(table.tolist()))
    if not mapping or min(mapping.values()) < 0:
        raise ArgumentError("remap", expected="ids of 0 or more", found="none or a negative one")
    ids = sorted(set(mapping.values()))
    target = ClassTable("custom", {i: f"class {i}" for i in ids}, dict.fromkeys(ids, (128, 128, 128)))
    return Remap("custom", classes, target, mapping)


def _check_fields(fields: Iterable[str]) -> tuple[str, ...]:
    names = tuple(dict.fromkeys([fields] if isinstance(fields, str) else fields))
    unknown = [name for name in names if name not in (*FIELDS, *ALWAYS)]
    if unknown:
        raise ArgumentError("fields", expected=f"any of {', '.join(FIELDS)}", found=f"{', '.join(map(repr, unknown))}")
    chosen = tuple(name for name in names if name not in ALWAYS)
    if not chosen:
        raise ArgumentError("fields", expected=f"at least one of {', '.join(FIELDS)}", found="none")
    return chosen


def _check_history(history: int) -> int:
    if isinstance(history, bool) or not isinstance(history, int | np.integer) or history < 1:
        raise ArgumentError("history", expected="a number of scans of 1 or more", found=f"{history!r}")
    return int(history)


_T = TypeVar("_T")


def _the_one(values: Mapping[str, _T], what: str) -> _T:
    """Return the value that all places share.

    Raises:
        FormatError: two differ; names the places.
    """
    (place, value), *others = values.items()
    for other, found in others:
        if found != value:
            raise FormatError(
                other,
                expected=f"the {what} of {place} ({value})",
                found=f"{found}",
                advice="choose sequences alike with split=[names]",
            )
    return value
