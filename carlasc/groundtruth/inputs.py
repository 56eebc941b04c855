"""The inputs of a run: sequences and their frames, and the plan that they share, for every source
of grids; and whether they changed since an earlier run.

A sequence has its frames, and the data that exist once per sequence. A frame is a small object that
pickles into a worker process and is read there.
"""

from __future__ import annotations

import copy
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping
from collections.abc import Sequence as Series
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

from carlasc.core.arrays import AnyArray, FloatArray, IntArray, Uint8Array
from carlasc.core.choices import CompareInputs
from carlasc.core.frames import FrameRange
from carlasc.core.grids import Grid, GridSpec
from carlasc.errors import ArgumentError, CarlascError, MissingDataError, check_types, count
from carlasc.groundtruth.options import FromGrid, FromScans, Observe, VoteRule, Voting
from carlasc.groundtruth.reporting import PoseFacts, Residual
from carlasc.groundtruth.voting.ballot import Votes
from carlasc.groundtruth.voting.certainty import VoxelCertainty
from carlasc.groundtruth.voxel_actors import VoxelActors
from carlasc.running.spreading import Run, StepCounter
from carlasc.storage import layout
from carlasc.storage.camera_files import cameras_of, scan_T_camera
from carlasc.storage.inputs import (
    ACCEPTED,
    PROVISIONAL,
    FrameFiles,
    MadeFrom,
    SequenceFiles,
    combined,
    content_digests,
    describe_changes,
    made_again,
)
from carlasc.storage.layout import Metadata
from carlasc.storage.protocol import Sequence, SequenceWriter
from carlasc.storage.resuming import agree_lines

if TYPE_CHECKING:
    from carlasc.groundtruth.seen import Views


@dataclass(frozen=True)
class GridPlan:
    """The plan of a run, which is the same for all sequences and frames.

    Attributes:
        spec: geometry of the grids.
        grid: name of their folder.
        observe: what observes the scene.
        voting: how votes are counted.
        frames: frame numbers of the source.

    Raises:
        ArgumentError: `observe` has another type, or does not provide the certainty or the actors
            of voxels that `voting` requires.
    """

    spec: GridSpec
    grid: str
    observe: Observe
    voting: Voting
    frames: FrameRange

    def __post_init__(self) -> None:
        check_types(GridPlan, vars(self))
        if self.needs_evidence and not (isinstance(self.observe, FromScans) and self.rule == "ray"):
            name = "keep_evidence" if self.voting.keep_evidence else "min_confidence"
            kind = type(self.observe).__name__.removeprefix("From").lower()
            raise ArgumentError(
                name,
                expected='grids from scans with the rule "ray", which say how certain each voxel '
                "is",
                found=f"observe={kind}, rule={self.rule}",
                advice=f"make the grid from scans, or leave out `{name}`",
            )
        dynamic = self.observe.dynamic if isinstance(self.observe, FromScans) else "align"
        if self.voting.keep_actors and (isinstance(self.observe, FromGrid) or dynamic != "align"):
            raise ArgumentError(
                "keep_actors",
                expected='grids from a capture, or from scans with dynamic "align", which know '
                "the bodies of actors",
                found=f'dynamic "{dynamic}"'
                if isinstance(self.observe, FromScans)
                else "a finer grid",
                advice="make the grid from scans, or leave out `keep_actors`",
            )

    @property
    def rule(self) -> VoteRule:
        """The rule that counts votes: that of `voting`, or the default of `observe`."""
        return self.voting.rule or ("ray" if isinstance(self.observe, FromScans) else "sensor")

    @property
    def needs_evidence(self) -> bool:
        """Whether frames need the certainty of each voxel: `FrameData.evidence`."""
        return self.voting.keep_evidence or self.voting.min_confidence > 0

    @property
    def infers(self) -> bool:
        """Whether voxels that no scan saw may be completed, which the field `flags` marks."""
        observe = self.observe
        return (
            isinstance(observe, FromScans)
            and self.rule == "ray"
            and observe.dynamic != "tube"
            and observe.complete != "seen"
        )

    @property
    def needs_all(self) -> bool:
        """Whether a frame may depend on other frames than those that vote on it: for the motion of
        actors, or the poses of cameras.
        """
        return self.voting.keep_actors or self.voting.keep_seen

    def fields(self) -> tuple[str, ...]:
        """Return the names of the grid's fields."""
        votes = ("votes",) if self.voting.keep else ()
        flags = ("flags",) if self.infers else ()
        evidence = layout.EVIDENCE_FIELDS if self.voting.keep_evidence else flags
        actors = layout.ACTOR_FIELDS if self.voting.keep_actors else ()
        seen = ("seen",) if self.voting.keep_seen else ()
        return tuple(
            f"{self.grid}/{part}"
            for part in ("labels", "counts", *votes, *evidence, *actors, *seen)
        )


@dataclass(frozen=True)
class FrameData:
    """The data of one frame.

    Attributes:
        fields: the scan fields that are written beside the grid, by name.
        grid: the grid.
        votes: the votes that decided the grid; None for a resampled grid.
        evidence: the certainty of each voxel; None unless the plan needs it
            (`GridPlan.needs_evidence`).
        actors: the actor of each voxel; None unless the plan needs it.
        boxes: (V, 6) uint8 boxes around the points in each voxel; None unless the plan keeps the
            cameras that see each voxel.
        flags: (X, Y, Z) uint8 flags of each voxel (`VoxelFlag`); None if nothing can be inferred.
    """

    fields: Mapping[str, AnyArray]
    grid: Grid
    votes: Votes | None
    evidence: VoxelCertainty | None = None
    actors: VoxelActors | None = None
    boxes: Uint8Array | None = None
    flags: Uint8Array | None = None


class FrameInput(ABC):
    """One frame of a sequence; it holds only paths and numbers.

    Attributes:
        number: frame number in the output.
        source_frame: frame number in the source.
    """

    number: int
    source_frame: int

    @abstractmethod
    def fields(self) -> tuple[str, ...]:
        """Return the names of the scan fields that `make` returns."""

    @abstractmethod
    def make(self, plan: GridPlan) -> FrameData:
        """Read the frame and make its grid.

        Raises:
            MissingDataError: a file does not exist.
            FormatError: the content of a file is not valid.
        """

    def views(self) -> Views:
        """Return the cameras of the sequence, each with its pose when it took its image of the
        frame.
        """
        return ()

    def thinned(self, plan: GridPlan) -> Grid | None:
        """Return the grid without a tenth of the scans of other frames; None if it is not made from
        scans of other frames.
        """
        return None

    def residuals(self) -> Mapping[int, Residual]:
        """Return how well the observations of the moving actors in the frame align with the next
        ones, by number of the actor.
        """
        return {}


class StoredFrame(FrameInput):
    """One frame of a sequence of the layout, which keeps its number."""

    @abstractmethod
    def stored(self) -> Sequence:
        """Return the sequence."""

    def fields(self) -> tuple[str, ...]:
        """Return the names of the scan fields that the frame has."""
        sequence = self.stored()
        return tuple(
            name
            for name in layout.SCAN_FIELDS
            if name in sequence.fields() and self.number in sequence.frames(name)
        )

    def read(self) -> dict[str, AnyArray]:
        """Read the scan fields of the frame."""
        return {name: self.stored().read(name, self.number) for name in self.fields()}

    def views(self) -> Views:
        """Return the cameras of the sequence, each with its pose when it took its image of the
        frame.
        """
        sequence = self.stored()
        cameras = cameras_of(sequence).values()
        return [(camera, scan_T_camera(sequence, camera, self.number)) for camera in cameras]


class SequenceInput(ABC):
    """One sequence of a source.

    Attributes:
        path: path of the sequence below the source; "" if the source is the sequence.
        location: name of the sequence in errors.
        metadata: content of its carlasc.json.
    """

    path: str
    location: str
    metadata: Metadata

    @cached_property
    def frames(self) -> tuple[FrameInput, ...]:
        """The chosen frames in increasing order.

        Raises:
            MissingDataError: no frame is in the range, or data that all frames need do not exist.
            FormatError: data that all frames need are not valid.
        """
        return self._find_frames()

    @abstractmethod
    def _find_frames(self) -> tuple[FrameInput, ...]:
        """Return the chosen frames: see `frames`."""

    @abstractmethod
    def poses(self) -> FloatArray | None:
        """Return (F, 4, 4) first_T_sensor by output frame, NaN where a pose cannot be read; None if
        there are no poses.
        """

    @abstractmethod
    def times(self) -> FloatArray | None:
        """Return (F,) seconds since the first frame by output frame; None if there are no times."""

    def cameras(self) -> bytes | None:
        """Return the content of cameras.json; None if the sequence has no cameras."""
        return None

    @abstractmethod
    def record(self) -> dict[str, Any]:
        """Return the record of the source in params.json.

        A run with another record does not continue the grid.
        """

    def most_points(self) -> int | None:
        """Return the largest number of points of some scans, for stores that reserve space; None if
        no scan can be read.
        """
        frames = self.frames
        chosen = {frames[place].source_frame for place in (0, len(frames) // 2, -1)}
        counts = []
        for frame in sorted(chosen):
            try:
                counts.append(self._count_points(frame))
            except CarlascError:
                continue  # making the frame raises the same error, and that one is reported
        return max(counts, default=None)

    @abstractmethod
    def _count_points(self, source_frame: int) -> int:
        """Return the number of points of a scan; 0 if the sequence has no scans."""

    def prepare(  # noqa: B027 (most sequences need nothing)
        self, writer: SequenceWriter | None, run: Run, steps: Callable[[int], None]
    ) -> None:
        """Do the work that comes once per sequence, before its frames are made. A second call does
        nothing.

        Args:
            writer: keeps the results beside the grids; None: they are not kept.
            run: how the work is spread.
            steps: called with the number of steps since the last call, `steps_before` in all.
        """

    @property
    def steps_before(self) -> int:
        """Number of steps of `prepare`, for progress."""
        return 0

    def frame(self, number: int) -> FrameInput | None:
        """Return a frame of the output that is not among `frames`, as one that only an earlier run
        chose; None if it is unknown.
        """
        return None

    def files(self) -> FrameFiles | None:
        """Return the files of each frame; None if the sequence is not read from files."""
        return None

    def depended(self) -> list[int]:
        """Return the frames of the source that the grids depend on."""
        return [frame.source_frame for frame in self.frames]

    def take_contents(self, contents: Mapping[int, str]) -> None:  # noqa: B027 (most need none)
        """Take the digests of the files of frames, by number."""

    def about(self, frame: int) -> object:
        """Return what text files say of a frame of the source and its grids depend on."""
        return None

    def shared(self) -> object:
        """Return what all frames depend on, besides the settings in params.json."""
        return self.metadata.classes.to_dict(), self.cameras()

    def available(self) -> Collection[int]:
        """Return the numbers of all frames that the source can have in the output."""
        return {frame.number for frame in self.frames}

    def made_from(self, number: int, own: Mapping[str, str], whole: str) -> str:
        """Return a digest of everything that the grid of a frame is made from, after `prepare`.

        Args:
            number: number of the frame in the output.
            own: digest of each frame of the source, by its number.
            whole: digest of all of these and of `shared`.
        """
        return whole

    def summaries(self) -> Series[Mapping[str, Any]] | None:
        """Return the facts of each actor, by number; None if actors are not tracked."""
        return None

    def pose_facts(self) -> PoseFacts | None:
        """Return how poses were refined; None if refinement is off."""
        return None

    def notes(self) -> list[str]:
        """Return remarks for the user of the grids, one line each."""
        return []


class StoredSequence(SequenceInput):
    """A sequence of the layout. Its scans, poses, times and frame numbers are kept.

    Attributes:
        sequence: the sequence.
        plan: the plan of the run.
        source: the field that grids are made from.
    """

    def __init__(self, sequence: Sequence, plan: GridPlan, source: str = "points") -> None:
        self.sequence = sequence
        self.plan = plan
        self.source = source
        self.path = layout.place_of(sequence.path)
        self.location = sequence.location
        self.metadata = sequence.metadata

    def _find_frames(self) -> tuple[FrameInput, ...]:
        available = self.sequence.frames(self.source)
        return tuple(map(self._frame, choose_frames(self.plan.frames, available, self.location)))

    @abstractmethod
    def _frame(self, number: int) -> FrameInput:
        """Return a frame that has the field which grids are made from."""

    def available(self) -> Collection[int]:
        """Return the frames with the field that grids are made from."""
        return frozenset(self.sequence.frames(self.source).tolist())

    def files(self) -> FrameFiles | None:
        """Return the files of the scans."""
        return SequenceFiles(without_caches(self.sequence))

    def _count_points(self, source_frame: int) -> int:
        sequence = self.sequence
        return (
            len(sequence.read("points", source_frame))
            if source_frame in sequence.frames("points")
            else 0
        )

    def poses(self) -> FloatArray | None:
        """Return the sequence's poses, one per line of poses.txt; None if it has none."""
        return self.sequence.poses if layout.POSES in self.sequence.documents() else None

    def times(self) -> FloatArray | None:
        """Return the sequence's times, one per line of times.txt; None if it has none."""
        return self.sequence.times if layout.TIMES in self.sequence.documents() else None

    def cameras(self) -> bytes | None:
        """Return the sequence's cameras.json; None if it has none."""
        has_cameras = layout.CAMERAS in self.sequence.documents()
        return self.sequence.read_document(layout.CAMERAS) if has_cameras else None


@dataclass
class InputCheck:
    """The comparison of the inputs of one sequence with those that its grid was made from.

    Attributes:
        inputs: the sequence.
        writer: the output.
        grid: name of the grid.
        compare: how files are compared.
        stale: frames that exist and must be made again.
        gone: frames of the output that the input has no longer.
        changed: whether any input changed since the report was written.
        must_record: whether the record must be written even if no frame is made.
        notes: what was made again, and why, one line each.
    """

    inputs: SequenceInput
    writer: SequenceWriter
    grid: str
    compare: CompareInputs
    stale: set[int] = field(default_factory=set)
    gone: set[int] = field(default_factory=set)
    changed: bool = False
    must_record: bool = False
    notes: list[str] = field(default_factory=list)
    _record: MadeFrom = field(default_factory=MadeFrom)
    _own: dict[str, str] = field(default_factory=dict)
    _whole: str = ""
    _made: dict[int, str] = field(default_factory=dict)

    @property
    def _name(self) -> str:
        return f"made-{self.grid}"

    def _read(self) -> MadeFrom:
        return MadeFrom.read(self.writer, self._name)

    @cached_property
    def copied(self) -> Collection[str]:
        """The fields of scans that the output may have; none if it is the input."""
        places = self.writer.location, self.inputs.location
        return layout.SCAN_FIELDS if len({*map(os.path.realpath, places)}) > 1 else ()

    @cached_property
    def is_provisional(self) -> bool:
        """Whether the grid was made while the input grew, so that all of its frames are made
        again.
        """
        return self._read().whole == PROVISIONAL

    def look(
        self,
        existing: Collection[int],
        begun: Collection[int],
        agrees: Callable[[int], bool | None],
        run: Run,
    ) -> None:
        """Find the frames that must be made again.

        Args:
            existing: frames that exist in the output.
            begun: frames of which the output has a scan and no grid.
            agrees: makes a frame again, and returns whether the existing one is equal; None if it
                cannot be made.
            run: how the reading of files is spread.
        """
        inputs = self.inputs
        files = self.inputs.files()
        record = self._record = self._read()
        kept = self.compare == "never" and existing and not self.is_provisional
        if files is None or kept:
            return
        contents = content_digests(files, inputs.depended(), self.writer, self.compare, run)
        inputs.take_contents(contents)
        self._own = self._own_of(contents)
        self._whole = combined(sorted(self._own.items()), inputs.shared())
        self.changed = self.must_record = bool(record.own) and self._whole != record.whole
        self.gone = {int(frame) for frame in record.frames} - set(inputs.available())
        again = dict.fromkeys(existing, "") if self.is_provisional else {}
        recorded = {frame: record.frames.get(str(frame)) for frame in existing} | again
        if record.own:  # a run that was killed had written their scans
            recorded |= {n: made for n in begun if (made := record.frames.get(str(n))) is not None}
        if not self.changed and all(recorded.values()):
            return
        inputs.prepare(self.writer, run, StepCounter(None))
        if all(self._own.get(frame, own) == own for frame, own in record.own.items()):
            accepted = [frame for frame, made in recorded.items() if made == ACCEPTED]
            recorded |= {frame: self._made_from(frame) for frame in accepted}
        self.stale = {
            frame for frame, made in recorded.items() if made not in (None, self._made_from(frame))
        }
        if self.stale:
            why = describe_changes(record.own, self._own)
            if self.is_provisional:
                why = "they were provisional"
            elif not why:
                was_interrupted = "" in recorded.values()
                why = "a run was interrupted" if was_interrupted else "what all scans share changed"
            self.notes.append(f"{self.writer.location}: {made_again(self.stale, why)}")
        if unknown := [frame for frame, made in sorted(recorded.items()) if made is None]:
            self._accept(unknown, agrees)
            self.must_record = True

    def _own_of(self, contents: Mapping[int, str]) -> dict[str, str]:
        return {
            str(frame): combined(content, self.inputs.about(frame))
            for frame, content in sorted(contents.items())
        }

    def is_of_input(self) -> bool:
        """Whether the grid was made from this input, of which some frames changed since: most
        others are as they were.
        """
        before = self._read().own
        files = self.inputs.files()
        if files is None or self.compare == "never":
            return False
        now = self._own_of(content_digests(files, self.inputs.depended()))
        return 2 * len(now.items() & before.items()) >= max(len(now), 1)

    def _made_from(self, frame: int) -> str:
        if frame not in self._made:
            self._made[frame] = self.inputs.made_from(frame, self._own, self._whole)
        return self._made[frame]

    def _accept(self, unknown: list[int], agrees: Callable[[int], bool | None]) -> None:
        """Compare some frames without a record with what is made now."""
        sample = {unknown[place] for place in (0, len(unknown) // 2, -1)}
        equal = [agree for frame in sorted(sample) if (agree := agrees(frame)) is not None]
        if not all(equal):
            self.stale |= set(unknown)
        what = "which are equal" if all(equal) else "which differ, so all are made again"
        self.notes.append(
            f"{self.writer.location}: {count(len(unknown), 'frame')} of {self.grid} without a "
            f"record of what they were made from: {len(equal)} made again, {what}"
        )

    def announce(self, numbers: Iterable[int]) -> None:
        """List the frames of a new grid, before text files are written: if the run is killed then,
        and the input loses frames, the next run removes their lines.
        """
        if self.inputs.files() is not None:
            MadeFrom(frames={str(frame): "" for frame in sorted(numbers)}).create(
                self.writer, self._name
            )

    def begin(self, numbers: Collection[int], missing: Collection[int]) -> None:
        """Write the record of the frames that are about to be made, and remove those of which
        the input has no scan any more. The sequence is prepared.

        Args:
            numbers: all frames of the run.
            missing: those that do not exist.
        """
        if not self._whole:
            return
        record = self._record
        writer = self.writer
        if self.gone:
            written = [f"{self.grid}/{part}" for part in layout.GRID_FIELDS]
            writer.remove_frames([*self.copied, *written], self.gone)
        if (self.changed or self.gone) and self.copied:
            self._remove_others()
        for frame in self.gone:
            del record.frames[str(frame)]
        record.frames |= {
            str(frame): "" if frame in self.stale else self._made_from(frame)
            for frame in sorted(numbers)
            if frame in missing
            or frame in self.stale
            or record.frames.get(str(frame), ACCEPTED) == ACCEPTED
        }
        # only a run that ends says that all frames and the report are of these inputs
        record.own = self._own
        record.whole = "" if self.changed or self.stale else self._whole
        record.write(self.writer, self._name)

    def _remove_others(self) -> None:
        """Remove from a copy the lines, text files and fields that the input has no longer."""
        inputs = self.inputs
        writer = self.writer
        of_frames = {layout.POSES: inputs.poses(), layout.TIMES: inputs.times()}
        for name, lines in of_frames.items():
            if self.gone and (left := agree_lines(writer, name, lines, is_whole=True)):
                writer.write_document(name, left)
        for name, content in ((layout.TIMES, inputs.times()), (layout.CAMERAS, inputs.cameras())):
            if content is None:
                writer.remove_document(name)
        for frame in inputs.frames:
            if frame.number in self.stale:
                others = {*layout.SCAN_FIELDS} - {*frame.fields()}
                if there := [name for name in others if writer.has(name, frame.number)]:
                    writer.remove_frames(there, [frame.number])

    def finish(self, made: Collection[int]) -> None:
        """Complete the record, after the frames and the report were written.

        Args:
            made: frames that were made.
        """
        if not self._whole:
            return
        record = self._read()  # other parts may have written it
        again = self.stale & set(made)
        record.frames |= {str(frame): self._made_from(frame) for frame in sorted(again)}
        record.whole = self._whole
        record.write(self.writer, self._name)


def remove_provisional(writer: SequenceWriter, sequence: Sequence) -> None:
    """Remove the provisional grids of a sequence: those of another geometry than the final ones."""
    for grid in sequence.grids:
        if MadeFrom.read(writer, f"made-{grid}").whole == PROVISIONAL:
            writer.remove_grid(grid)


def choose_frames(frames: FrameRange, available: IntArray, where: str) -> list[int]:
    """Return the available frame numbers in a range.

    Raises:
        MissingDataError: no number is in the range; the message starts with `where`.
    """
    chosen: list[int] = frames.select(available).tolist()
    if not chosen:
        found = f"only {available[0]} to {available[-1]}" if len(available) else "none"
        expected = "frames" if frames == FrameRange() else f"frames in {frames}"
        raise MissingDataError(where, expected=expected, found=found)
    return chosen


def without_caches(sequence: Sequence) -> Sequence:
    """Return a copy of a sequence without its cached properties, which is small enough to send to a
    worker with each frame.
    """
    light = copy.copy(sequence)
    for name in [
        n for n in vars(light) if isinstance(getattr(type(light), n, None), cached_property)
    ]:
        del vars(light)[name]
    return light
