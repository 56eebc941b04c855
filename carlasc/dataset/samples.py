"""`Dataset`: the frames of any Source as training samples, which are dicts of NumPy arrays.

It is a map-style data set for the DataLoader of torch, and does not import torch. A sample is one
frame: the grid to predict, and the last `history` scans, moved to the sensor frame of the frame and
binned. See the format page, `docs/format.md#training-samples`.
"""

from __future__ import annotations

import copy
import operator
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, Self, SupportsIndex, cast, overload

import numpy as np

from carlasc.core.arrays import FloatArray, IntArray
from carlasc.core.choices import Axes
from carlasc.core.classes import ClassTable
from carlasc.core.grids import Coordinates, GridSpec
from carlasc.core.notebook import describe
from carlasc.dataset.fields import (
    ACTOR_FIELDS,
    ALWAYS,
    CAMERA_FIELDS,
    EVIDENCE_FIELDS,
    FIELDS,
    STACKS,
    Sample,
    Values,
)
from carlasc.dataset.labels import OF_GRID, GridFields, LabelMap, RemapLike
from carlasc.dataset.photographs import OF_CAMERAS, frames_with_images, read_cameras
from carlasc.dataset.selection import (
    RecentScans,
    SequenceFrames,
    choose_sequences,
    common_frames,
    common_value,
    find_grid_name,
    find_grid_sequences,
)
from carlasc.dataset.torch_bases import NoBase, inherit
from carlasc.dataset.transforms import Augment, Placement, check_symmetric, mirror, moved
from carlasc.errors import (
    ArgumentError,
    FormatError,
    MissingDataError,
    check_choice,
    check_types,
    count,
)
from carlasc.storage import Sequence, Source, as_source, layout
from carlasc.storage.camera_files import image_fields
from carlasc.storage.files import AnyPath
from carlasc.storage.transport.caching import CachedTree
from carlasc.storage.views import ChosenSequences

# field of a sample -> field of the scan
_OF_SCAN = {"points": "points", "point_labels": "labels", "flow": "flow", "remission": "points"}

if TYPE_CHECKING:
    from torch.utils.data import Dataset as TorchDataset

    _MapStyle = TorchDataset[Sample]
else:
    _MapStyle = NoBase  # until torch is imported


class Dataset(_MapStyle):
    """Frames of one or more sequences as training samples.

    A sample is a dict with the requested `fields`. T is `history`, and (X, Y, Z) is the size of the
    grid:

        occupancy     (T, X, Y, Z) uint8, 1 where a scan has a point; the oldest scan first, the
                      scan of the frame last
        density       (T, X, Y, Z) int32, number of points per voxel
        visibility    (T, X, Y, Z) uint8, 2 where a scan has a point, 1 where only its rays passed,
                      0 elsewhere
        labels        (X, Y, Z) uint8 class of each voxel (int32 if ids exceed 255); 0 is free, and
                      also unknown
        known         (X, Y, Z) bool, voxels with a vote: ignore all other voxels in losses and
                      metrics
        counts        (X, Y, Z) float32, number of votes per voxel
        posterior     (K, X, Y, Z) float32, soft labels: probability of each class, 0 for free;
                      zeros where not known. K is the largest id of `classes` plus 1
        occupied      (X, Y, Z) float32, probability that the voxel is occupied; 0.5 where it is
                      unknown
        flags         (X, Y, Z) uint8, sums of `carlasc.VoxelFlag`
        views         (X, Y, Z) int32, number of scans that saw the voxel
        instances     (X, Y, Z) int64, number of the actor that the voxel belongs to, 0 for none;
                      the same in all frames of a sequence
        voxel_flow    (X, Y, Z, 3) float32 m/s, velocity of the actor in the voxel, sensor frame;
                      zero where nothing moves
        camera_visible (X, Y, Z) uint8, bit i: the i-th camera of cameras.json sees the voxel; see
                      `carlasc.Voting(keep_seen=True)`
        images        {camera: (H, W, 3) uint8}, RGB; `carlasc.dataset.ResizeImages` resizes them
        cameras       {camera: `carlasc.core.CameraModel`}, with their poses at the times of these
                      images
        points        (N, 3) float32 metres, sensor frame of the frame; all points of the scan
        point_labels  (N,) uint8 class of each point (int32 if ids exceed 255)
        flow          (N, 3) float32 m/s, velocity of each point, sensor frame
        remission     (N,) float32, fourth column of the scan: remission in KITTI, zero in CarlaSC
        poses         (T, 4, 4) float64 current_T_past; the identity where not valid
        valid         (T,) bool, whether the scan exists; in every sample
        sequence      str, name of the sequence; in every sample
        frame         int, number of the frame; in every sample

    The history ends at the start of a sequence and at a gap in its frame numbers: earlier grids are
    empty, and their `valid` is False. Frames that lack a requested field are left out. `posterior`,
    `occupied` and `views` need grids made with `carlasc.Voting(keep_evidence=True)`; `flags` needs
    these or grids from scans whose actors were completed;
    `instances` and `voxel_flow` need grids made with `keep_actors=True`. Points outside the range
    `min_range_m` to `max_range_m` of carlasc.json are left out. Arrays have the axes of the
    sequences, unless `axes` is set.

    Attributes:
        sequences: the sequences in use, in order. `sequence` of a sample is the name of one of
            them.
        classes: table of the class ids in samples, after the remap.
        transform: called with each sample; returns the sample to use. It can be set later (see
            `carlasc.Flip`).
    """

    def __init__(
        self,
        source: AnyPath | Source | Iterable[AnyPath | Source],
        split: str | Iterable[str] | None = None,
        *,
        history: int = 1,
        coordinates: Coordinates = "cartesian",
        grid: str | GridSpec = layout.EVALUATION,
        grids_source: AnyPath | Source | Iterable[AnyPath | Source] | None = None,
        fields: str | Iterable[str] = ("occupancy", "labels", "known"),
        remap: RemapLike = "auto",
        align: bool = True,
        inferred: bool = True,
        min_confidence: float = 0.0,
        transform: Callable[[Sample], Mapping[str, object]] | None = None,
    ) -> None:
        """Find the frames. No scans or grids are read.

        Args:
            source: anything that `carlasc.open` takes, or a Source, or several of them.
            split: "train", "val" or "test" (case-insensitive), the name of a sequence, or a list of
                names; None takes all sequences.
            history: T, number of scans in a stack, including the scan of the frame.
            coordinates: coordinates of the grids: "cartesian" or "cylindrical"; ignored if `grid`
                is a GridSpec. Scans, poses and times are read from the folder of that name if it
                has scans, otherwise from `cartesian/`.
            grid: name of the grid (its folder); its params.json has the geometry. Or a GridSpec:
                `labels`, `known` and `counts` are then read from the grid with this geometry;
                without these fields, the grid need not exist.
            grids_source: a separate source of grids, such as eval_fine.zip and
                eval_cylindrical.zip. Its sequences are matched to those of `source` by split and
                name. None reads grids from `source`.
            fields: the fields of a sample, from the list above.
            remap: mapping of `labels` and `point_labels`: "auto" to the usual training classes
                (carlasc11 or semantickitti19; other tables keep their ids), a name in
                `carlasc.core.REMAPS`, a Remap, a mapping of ids, or a table of new ids by old id;
                None keeps the ids of the data.
            align: move past scans to the sensor frame of the frame by their poses; False stacks
                them unmoved.
            inferred: False excludes completed voxels, which no scan saw, from `known` and
                `posterior`.
            min_confidence: minimum probability: voxels that are neither free nor occupied with at
                least this probability are excluded from `known` and `posterior`; 0 to 0.5 keeps
                all.
            transform: called with each sample. An `Augment` is applied before scans are binned.

        Raises:
            ArgumentError: an argument is not valid, or the remap is for another class table.
            MissingDataError: a split or sequence does not exist, or a sequence lacks a requested
                field.
            FormatError: sequences differ in grid, axes or class table, or poses.txt does not fit
                the scans.
        """
        check_types(Dataset.__init__, locals())
        self.fields = _check_fields(fields)
        if history < 1:
            raise ArgumentError("history", expected="a number of scans of 1 or more", found=history)
        self.history = int(history)
        self.align = align
        self._grid_fields = GridFields(frozenset(self.fields), inferred, min_confidence)
        self.transform = transform
        coordinates = grid.coordinates if isinstance(grid, GridSpec) else coordinates
        check_choice("coordinates", coordinates, layout.COORDINATES)

        opened = _opened(source)
        chosen = choose_sequences(opened, split, coordinates)
        if self._asks(OF_GRID) or (self._asks(STACKS) and isinstance(grid, str)):
            grids_opened = opened if grids_source is None else _opened(grids_source)
            grids = find_grid_sequences(chosen, grids_opened, coordinates)
            self._parts = [
                self._part(scans, sequence, find_grid_name(sequence, grid))
                for scans, sequence in zip(chosen, grids, strict=True)
            ]
        else:
            self._parts = [self._part(scans, None, "") for scans in chosen]
        self._starts = np.cumsum([0, *(len(part.frames) for part in self._parts)])
        if not len(self):
            raise MissingDataError(
                opened.location,
                expected=f"frames with {', '.join(self.fields)}",
                found="no frame with all of them",
            )

        self.sequences = tuple(part.scans for part in self._parts)
        self._axes: Axes = common_value(
            {scans.location: scans.metadata.axes for scans in self.sequences},
            "axes",
            "set `axes` of two data sets, and add them",
        )
        specs = {
            part.grids.location: part.grids.grids[part.grid]
            for part in self._parts
            if part.grids is not None
        }
        self._spec = grid if isinstance(grid, GridSpec) else None
        if specs and self._spec is None:
            self._spec = common_value(specs, "grid geometry")
        self._label_map = self._make_label_map(remap)
        self.classes: ClassTable = self._label_map.target

    @property
    def axes(self) -> Axes:
        """Handedness of the samples: "left" (CarlaSC: y to the right) or "right" (KITTI: y to the
        left). It is that of the data until another one is set, which mirrors samples in y.

        Raises:
            ArgumentError: the value is neither, or the grid is not symmetric in y.
        """
        return self._axes

    @axes.setter
    def axes(self, axes: Axes) -> None:
        check_choice("axes", axes, Axes)
        if self._spec is not None:
            check_symmetric(self._spec, "y")
        self._axes = axes

    @property
    def spec(self) -> GridSpec:
        """Geometry of the grids.

        Raises:
            ArgumentError: no requested field needs a grid.
        """
        if self._spec is None:
            raise ArgumentError(
                "fields",
                expected="a field that needs a grid, such as occupancy",
                found=", ".join(self.fields),
            )
        return self._spec

    def __len__(self) -> int:
        return int(self._starts[-1])

    @overload
    def __getitem__(self, index: SupportsIndex) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> Self: ...
    def __getitem__(self, index: SupportsIndex | slice) -> Sample | Self:
        """Return one sample.

        A negative index counts from the end. A slice returns a Dataset of these samples.

        Raises:
            IndexError: the index is out of range.
            ArgumentError: the step of a slice is negative: samples are always in the order of
                frames.
            FormatError: the content of a file is not valid; the message names the file.
        """
        if isinstance(index, slice):
            return self._part_of(index)
        place = operator.index(index)
        if not -len(self) <= place < len(self):
            raise IndexError(f"sample {place} is out of range: there are {len(self)} samples")
        part, frame = self._frame_at(place % len(self))
        past = part.history(frame, self.history)
        placement = self._placement(part, frame)

        sample: Values = {}
        if self._needs_poses:
            sample["poses"] = part.current_T_past(frame, past)
        if self._asks(STACKS):
            sample |= self._stacks(part, past, sample.get("poses"), placement)
        if part.grids is not None:
            sample |= self._grid_fields.read(part.grids, part.grid, frame, self._label_map)
        if self._asks(_OF_SCAN):
            sample |= self._scan(part, frame)
        if self._asks(OF_CAMERAS):
            sample |= read_cameras(part.scans, frame)
        sample["valid"] = np.array([number is not None for number in past])
        sample |= {"sequence": part.scans.name, "frame": frame}
        requested = {name: sample[name] for name in (*self.fields, *ALWAYS)}
        if placement is not None:  # stacks are in their place already
            requested = moved(requested, placement, self._spec, stacks=False)
        if self.transform is None or isinstance(self.transform, Augment):
            return cast(Sample, requested)
        return cast(Sample, self.transform(cast(Sample, requested)))

    def _part_of(self, chosen: slice) -> Self:
        """Return a Dataset of a slice of the samples."""
        if chosen.step is not None and chosen.step < 0:
            raise ArgumentError(
                "index", expected="a slice with a step of 1 or more", found=chosen.step
            )
        part = copy.copy(self)
        places = np.arange(len(self))[chosen]
        ends = zip(self._starts[:-1].tolist(), self._starts[1:].tolist(), self._parts, strict=True)
        part._parts = [
            replace(whole, frames=whole.frames[places[(places >= start) & (places < end)] - start])
            for start, end, whole in ends
        ]
        part._starts = np.cumsum([0, *(len(chosen.frames) for chosen in part._parts)])
        return part

    @property
    def frames(self) -> tuple[IntArray, ...]:
        """(N,) frame numbers of each of `sequences`. Samples are in this order."""
        return tuple(part.frames for part in self._parts)

    @property
    def is_cached(self) -> bool:
        """Whether at least a part of the data is remote and was opened with a cache."""
        return any(
            isinstance(sequence.tree, CachedTree)
            for part in self._parts
            for sequence, _ in part.fields
        )

    def cached_files(self, indices: Iterable[int]) -> list[tuple[CachedTree, str]]:
        """Return the files of samples that are read through a cache, each once."""
        frames: dict[SequenceFrames, list[int]] = {}
        for index in indices:
            part, frame = self._frame_at(index)
            frames.setdefault(part, []).append(frame)
        files: dict[tuple[CachedTree, str], None] = {}
        for part, numbers in frames.items():
            for sequence, field in part.fields:
                if isinstance(tree := sequence.tree, CachedTree):
                    read = (
                        part.with_history(numbers, self.history) if field == "points" else numbers
                    )
                    files |= dict.fromkeys((tree, path) for path in sequence.files_of(field, read))
        return list(files)

    def index_of(self, sequence: str, frame: int) -> int:
        """Return the index of the sample of a frame of a sequence.

        Raises:
            MissingDataError: the frame is not a sample.
        """
        for part, start in zip(self._parts, self._starts, strict=False):
            if part.scans.name == sequence and frame in part.frames:
                return int(start + np.searchsorted(part.frames, frame))
        raise MissingDataError(
            f"frame {frame} of {sequence}",
            expected=f"the frame of one of the {len(self)} samples",
            found="none",
        )

    def class_counts(self, field: Literal["labels", "point_labels"] = "labels") -> IntArray:
        """Count the classes of each sample, for samplers that draw rare classes more often.

        All samples are read, without their scans and augmentations.

        Args:
            field: "labels" counts voxels, without unknown ones if `known` is one of the fields;
                "point_labels" counts points.

        Returns:
            (N, K) int64, where K is the largest id of `classes` plus 1.

        Raises:
            ArgumentError: the samples do not have this field.
        """
        check_choice("field", field, [name for name in self.fields if name.endswith("labels")])
        plain = copy.copy(self)
        channels = max(self.classes.names) + 1
        plain.transform = None
        plain.fields = (field, *({"known"} & set(self.fields) if field == "labels" else ()))
        plain._grid_fields = replace(self._grid_fields, fields=frozenset(plain.fields))
        counts = np.zeros((len(self), channels), np.int64)
        for number in range(len(self)):
            sample = cast(Values, plain[number])
            labels = sample[field]
            known = labels[sample.get("known", ...)].ravel()
            counts[number] = np.bincount(known, minlength=channels)
        return counts

    def __repr__(self) -> str:
        sizes = f"{count(len(self), 'frame')} in {count(len(self._parts), 'sequence')}"
        return f"<Dataset of {sizes}: {', '.join(self.fields)}>"

    def _repr_html_(self) -> str:
        """Return the HTML for notebooks: the fields of samples, and the first sample from above."""
        rows = {
            "fields": ", ".join(self.fields),
            "history": self.history,
            "grid": self._spec,
            "classes": self.classes.name,
        }
        picture = None
        if self._spec is not None and "labels" in self.fields and len(self):
            labels = self[0]["labels"]
            picture = self._spec.seen_from_above(
                labels, self.classes.palette, left_handed=self.axes == "left"
            )
        return describe(repr(self), rows, picture)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the cached scans. Each process has its own cache."""
        return {name: value for name, value in self.__dict__.items() if name != "_recent"}

    @cached_property
    def _recent(self) -> RecentScans:
        return RecentScans(self.history)

    def _asks(self, names: Iterable[str]) -> bool:
        return not set(names).isdisjoint(self.fields)

    @property
    def _needs_poses(self) -> bool:
        return "poses" in self.fields or (self._asks(STACKS) and self.align and self.history > 1)

    def _part(self, scans: Sequence, grids: Sequence | None, grid: str) -> SequenceFrames:
        wanted = {(scans, _OF_SCAN[field]): None for field in self.fields if field in _OF_SCAN}
        if self._asks(STACKS) or not self._asks(OF_GRID):
            wanted[scans, "points"] = None
        if grids is not None:
            parts = self._grid_fields.parts(grids, grid)
            wanted |= {(grids, f"{grid}/{part}"): None for part in sorted(parts)}
        if shows := self._asks(OF_CAMERAS):
            wanted |= {(scans, field): None for field in image_fields(scans).values()}
        frames = common_frames(wanted)
        frames = frames_with_images(scans, frames) if shows else frames
        part = SequenceFrames(scans, grids, grid, frames, tuple(wanted))
        if self._needs_poses:
            part.check_poses()
        return part

    def _make_label_map(self, remap: RemapLike) -> LabelMap:
        tables: dict[str, ClassTable] = {}
        for part in self._parts:
            if "point_labels" in self.fields:
                tables[part.scans.location] = part.scans.metadata.classes
            if self._asks(("labels", "posterior")) and part.grids is not None:
                tables[f"{part.grids.location}/{part.grid}"] = part.grids.classes_of(part.grid)
        where, stored = next(iter(tables.items()), ("", self.sequences[0].metadata.classes))
        label_map = LabelMap(remap, stored)
        if tables:
            common_value({place: table.name for place, table in tables.items()}, "class table")
        if tables and label_map.source != stored:
            raise ArgumentError(
                "remap",
                expected=f"a remap of {where}'s class table {stored.name}",
                found=f"{label_map.name}, which maps {label_map.source.name}",
                advice="use another `remap`, or None to keep the ids",
            )
        return label_map

    def _frame_at(self, place: int) -> tuple[SequenceFrames, int]:
        which = int(np.searchsorted(self._starts, place, side="right")) - 1
        return self._parts[which], int(self._parts[which].frames[place - self._starts[which]])

    def _placement(self, part: SequenceFrames, frame: int) -> Placement | None:
        """Return where the sample of a frame is placed: mirrored to `axes`, and augmented."""
        mirrored = None if part.scans.metadata.axes == self.axes else mirror("y")
        if not isinstance(self.transform, Augment):
            return mirrored
        drawn = self.transform.place(part.scans.name, frame, self._spec)
        if mirrored is None:
            return drawn
        return replace(drawn, new_T_old=drawn.new_T_old @ mirrored.new_T_old)

    def _stacks(
        self,
        part: SequenceFrames,
        past: list[int | None],
        poses: FloatArray | None,
        placement: Placement | None,
    ) -> Values:
        from carlasc.dataset.stacking import stack_scans

        spec = self.spec
        if not self.align or poses is None:
            poses = np.tile(np.eye(4), (self.history, 1, 1))
        scans = self._recent.read(part.scans, past)
        if placement is not None:
            poses = placement.new_T_old @ poses
            if placement.drop:
                ages = range(len(scans) - 1, -1, -1)
                scans = [
                    None if scan is None else scan[placement.kept(len(scan), age)]
                    for scan, age in zip(scans, ages, strict=True)
                ]
        ranges = (part.scans.metadata.min_range_m, part.scans.metadata.max_range_m)
        stacks: Values = {}
        if "density" in self.fields:
            stacks["density"] = stack_scans(scans, poses, spec, "density", *ranges)
        if "visibility" in self.fields:
            from carlasc.dataset.visibility import stack_visibility

            try:
                stacks["visibility"] = stack_visibility(scans, poses, spec, *ranges)
            except FormatError as error:  # from poses.txt
                raise error.within(part.scans.location) from error
        if "occupancy" in self.fields:
            stacks["occupancy"] = (
                (stacks["density"] > 0).view(np.uint8)
                if "density" in stacks
                else stack_scans(scans, poses, spec, "occupancy", *ranges)
            )
        return stacks

    def _scan(self, part: SequenceFrames, frame: int) -> Values:
        sample: Values = {}
        if "points" in self.fields:
            (points,) = self._recent.read(part.scans, [frame])
            sample["points"] = np.array(
                points[:, :3] if points is not None else (), np.float32, order="C"
            )
        where = f"{part.scans.location}: labels of frame {frame}"
        if "point_labels" in self.fields:
            sample["point_labels"] = self._label_map(part.scans.read("labels", frame), where)
        if "flow" in self.fields:
            sample["flow"] = np.array(part.scans.read("flow", frame), np.float32, order="C")
        if "remission" in self.fields:
            sample["remission"] = np.array(part.scans.read("points", frame)[:, 3], np.float32)
        lengths = {name: len(array) for name, array in sample.items()}
        if len(set(lengths.values())) > 1:
            found = ", ".join(f"{length} {name}" for name, length in lengths.items())
            raise FormatError(
                f"{part.scans.location}: frame {frame}", expected="one value per point", found=found
            )
        return sample


inherit(Dataset, "Dataset")


def _opened(source: AnyPath | Source | Iterable[AnyPath | Source]) -> Source:
    """Return one Source of everything that is given."""
    if isinstance(source, str | os.PathLike | Source):
        return as_source(source)
    opened = [as_source(one) for one in source]
    sequences = {
        f"{number}/{path}": sequence
        for number, one in enumerate(opened)
        for path, sequence in one.sequences().items()
    }
    return ChosenSequences(", ".join(one.location for one in opened), sequences)


def _check_fields(fields: Iterable[str]) -> tuple[str, ...]:
    names = tuple(dict.fromkeys([fields] if isinstance(fields, str) else fields))
    known = (*FIELDS, *EVIDENCE_FIELDS, *ACTOR_FIELDS, *CAMERA_FIELDS)
    for name in names:
        check_choice("fields", name, (*known, *ALWAYS))
    chosen = tuple(name for name in names if name not in ALWAYS)
    if not chosen:
        raise ArgumentError("fields", expected=f"at least one of {', '.join(known)}", found="none")
    return chosen
