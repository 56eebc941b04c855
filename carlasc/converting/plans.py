"""What a conversion will do: the recordings that were asked for, where each goes, and its poses and times."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

import carlasc
from carlasc.converting.axes import mirror_poses
from carlasc.converting.frames import Target, scan_fields
from carlasc.converting.protocol import Converter, Recording
from carlasc.converting.results import Steps
from carlasc.converting.trajectory import (
    KISS_ICP,
    PoseSource,
    check_poses,
    estimate_poses,
    read_poses,
    times_from_first,
)
from carlasc.core.grids import GridSpec
from carlasc.errors import ConflictError, MissingDataError
from carlasc.storage import layout
from carlasc.storage.files import to_json
from carlasc.storage.metadata import Metadata
from carlasc.storage.protocol import SequenceWriter, Sink
from carlasc.storage.resuming import agree_metadata, agree_poses, agree_times, check_grid

SplitName = Literal["train", "val", "test", "all"]


@dataclass
class RecordingPlan:
    """One recording and where it is written.

    Attributes:
        recording: what is read.
        writer: where it is written.
        poses: (F, 4, 4) first_T_sensor by frame number, right-handed; None until they are estimated.
        times: (F,) seconds since the first frame, by frame number.
        fields: names of the fields that are written for each scan.
        missing: places in `recording.frames` of the frames whose scan is not written yet.
    """

    recording: Recording
    writer: SequenceWriter
    poses: NDArray[np.float64] | None
    times: NDArray[np.float64]
    fields: tuple[str, ...]
    missing: list[int] = field(default_factory=list)


def choose_recordings(
    recordings: list[Recording], source: Path, wanted: Collection[str] | None, split: SplitName
) -> list[Recording]:
    """Return the recordings with the wanted numbers and of the wanted split.

    Raises:
        MissingDataError: a number does not exist, or no recording is left; lists those that exist.
    """
    by_number = {recording.name.rpartition("_")[2]: recording for recording in recordings}
    if wanted is not None and (unknown := [number for number in wanted if number not in by_number]):
        raise MissingDataError(
            source, expected=f"the sequences {', '.join(unknown)}", found=f"only {', '.join(by_number) or 'none'}"
        )
    chosen = [
        recording
        for number, recording in by_number.items()
        if (wanted is None or number in wanted) and split in ("all", recording.split.lower())
    ]
    chosen = [recording for recording in chosen if recording.frames or recording.problems()]
    if not chosen:
        found = ", ".join(f"{number} ({r.split}, {len(r.frames)} scans)" for number, r in by_number.items())
        raise MissingDataError(source, expected=f"sequences with scans in the split {split}", found=found or "none")
    if empty := [recording for recording in chosen if not recording.frames]:
        raise MissingDataError(f"{empty[0].location}/velodyne", expected="scans", found="none", advice="copy them")
    return chosen


def plan_recording(
    recording: Recording,
    converter: type[Converter],
    sink: Sink,
    pose_source: PoseSource,
    *,
    flow: bool,
    force: bool,
) -> RecordingPlan:
    """Read a recording's poses and times, check them, and find out which frames are missing. Nothing is written."""
    writer = sink.sequence(f"{recording.split}/{recording.name}/cartesian")
    poses = read_poses(recording, pose_source, force=force)
    if poses is not None and not force and writer.read_document(layout.POSES) is None:
        check_poses(recording, converter, poses)
    fields = scan_fields(labelled=recording.has_labels, flow=flow and recording.has_labels)
    missing = [
        index
        for index, handle in enumerate(recording.frames)
        if not all(writer.has(name, handle.number) for name in fields)
    ]
    return RecordingPlan(recording, writer, poses, times_from_first(recording), fields, missing)


def check_voxel_grid(plan: RecordingPlan, target: Target) -> None:
    """Check that the data set's own voxels may be written where the plan says.

    Raises:
        ConflictError: another grid of that name exists there.
    """
    if target.voxels is not None:
        frames = [handle.number for handle in plan.recording.frames]
        params = _voxel_params(target.voxels, target)
        check_grid(plan.writer, layout.grid_folder(target.voxels), params, frames, overwrite=False)


def write_documents(
    plan: RecordingPlan, target: Target, converter: type[Converter], metadata: Metadata, steps: Steps
) -> None:
    """Write poses, times, carlasc.json and the voxel grid's params.json. Poses that are missing are estimated first.

    Estimated poses of an earlier run are kept, because a second estimate might differ in its last digits.

    Raises:
        ConflictError: other poses, times or metadata exist there.
    """
    writer = plan.writer
    origin = "file" if plan.poses is not None else KISS_ICP
    metadata = replace(metadata, extra={"poses": origin})
    where = f"{writer.location}/{layout.METADATA}"
    existing = writer.read_document(layout.METADATA)
    before = None if existing is None else Metadata.from_json(existing, where)
    if before is not None and before.extra.get("poses") != origin:
        raise ConflictError(
            where,
            expected=f"poses from {origin}",
            found=str(before.extra.get("poses", "others")),
            advice="write to another place",
        )
    documents = {layout.METADATA: agree_metadata(writer, metadata)}
    estimated = writer.read_document(layout.POSES) if plan.poses is None else None
    if estimated is not None:
        stored = layout.decode_poses(estimated, f"{writer.location}/{layout.POSES}")
        plan.poses = mirror_poses(stored) if target.mirrored else stored
    elif plan.poses is None:
        steps.expect(len(plan.recording.frames))
        plan.poses = estimate_poses(plan.recording, converter, steps)
    documents[layout.POSES] = agree_poses(writer, mirror_poses(plan.poses) if target.mirrored else plan.poses)
    documents[layout.TIMES] = agree_times(writer, plan.times)
    if target.voxels is not None:
        params = _voxel_params(target.voxels, target)
        documents[layout.params_file(layout.grid_folder(target.voxels))] = to_json(params)
    for document, data in documents.items():
        if data is not None:
            writer.write_document(document, data)


def _voxel_params(spec: GridSpec, target: Target) -> dict[str, object]:
    record = {"version": carlasc.__version__, "source": "voxels"}
    return spec.to_params(target.classes.num_channels) | {"carlasc": record}
