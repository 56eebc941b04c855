"""Ground truth with a known fault: the grids of a sequence, written again with one thing wrong."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

import carlasc
from carlasc import Boxes, GridSpec
from carlasc.core.benchmarks import CARLAOCC_TO_CARLA
from carlasc.core.geometry import invert, quaternions_of, transform_points
from carlasc.groundtruth import FromScans
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.motion import MotionOptions
from carlasc.storage import FolderSink, Sequence, layout

GRID = "evaluation"
Change = Callable[[Sequence, int, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def sequence_of(place: Path | str) -> Sequence:
    return next(iter(carlasc.open(place).values()))


def write_grids(
    source: Path | str,
    out: Path,
    change: Change | None = None,
    *,
    spec: GridSpec | None = None,
    late: int = 0,
    absent: tuple[int, ...] = (),
    grid: str = GRID,
) -> Path:
    """Write the grids of a sequence to a folder of their own.

    Args:
        source: folder of the sequence.
        out: folder of the data set that is written.
        change: changes labels and counts of a frame.
        spec: geometry that is declared.
        late: frames by which the grids are late.
        absent: frames that are left out.
        grid: name of the grid.
    """
    sequence, writer = sequence_of(source), FolderSink(out).sequence("cartesian")
    writer.write_document(
        layout.params_file(GRID), json.dumps((spec or sequence.grids[grid]).to_params()).encode()
    )
    if layout.METADATA in sequence.documents():
        writer.write_document(layout.METADATA, sequence.read_document(layout.METADATA))
    frames = sequence.frames(f"{grid}/labels").tolist()
    for frame in frames:
        if frame in absent or frame - late not in frames:
            continue
        one = sequence.grid(grid, frame - late)
        labels, counts = one.labels, one.counts
        if change is not None:
            labels, counts = change(sequence, frame, labels.copy(), counts.copy())
        writer.write(f"{GRID}/labels", frame, labels.astype(np.uint32))
        writer.write(f"{GRID}/counts", frame, counts.astype(np.float32))
    return out


def moved(spec: GridSpec, offset_m: tuple[float, float, float]) -> GridSpec:
    """Return a geometry with bounds that are moved."""
    lower, upper = (tuple(np.add(bound, offset_m)) for bound in (spec.lower, spec.upper))
    return replace(spec, lower=lower, upper=upper)


def larger(spec: GridSpec, ratio: float) -> GridSpec:
    """Return a geometry whose voxels and bounds are larger."""
    return replace(
        spec,
        lower=tuple(np.multiply(spec.lower, ratio)),
        upper=tuple(np.multiply(spec.upper, ratio)),
    )


def mirrored(_sequence: Sequence, _frame: int, labels: np.ndarray, counts: np.ndarray) -> tuple:
    return labels[:, ::-1], counts[:, ::-1]


def swapped_axes(_sequence: Sequence, _frame: int, labels: np.ndarray, counts: np.ndarray) -> tuple:
    return labels.transpose(1, 0, 2), counts.transpose(1, 0, 2)


def exchanged(one: int, other: int) -> Change:
    """Return what exchanges two classes."""

    def change(_sequence: Sequence, _frame: int, labels: np.ndarray, counts: np.ndarray) -> tuple:
        return np.where(labels == one, other, np.where(labels == other, one, labels)), counts

    return change


def erased(instance: int) -> Change:
    """Return what takes away the voxels of an actor."""

    def change(sequence: Sequence, frame: int, labels: np.ndarray, counts: np.ndarray) -> tuple:
        voxels = voxels_of(sequence, frame, frame, instance)
        labels.reshape(-1)[voxels] = 0
        return labels, counts

    return change


def trail(instance: int, reach: int = 12) -> Change:
    """Return what leaves an actor where it was seen in other frames."""

    def change(sequence: Sequence, frame: int, labels: np.ndarray, counts: np.ndarray) -> tuple:
        for other in sequence.frames("points").tolist():
            if 0 < abs(other - frame) <= reach:
                voxels = voxels_of(sequence, frame, other, instance)
                labels.reshape(-1)[voxels] = 10
                counts.reshape(-1)[voxels] = 1
        return labels, counts

    return change


def voxels_of(sequence: Sequence, frame: int, other: int, instance: int) -> np.ndarray:
    """Return the voxels, in the grid of a frame, of an actor's points in the scan of another frame."""
    scan = sequence.scan(other, ("instances",))
    motion = invert(sequence.read_pose(frame)) @ sequence.read_pose(other)
    voxels = sequence.grids[GRID].flat_index(
        transform_points(motion, scan.points[scan.instances == instance])
    )
    return voxels[voxels >= 0]


def fastest(sequence: Sequence) -> int:
    """Return the number of the actor that moves and is seen best."""
    seen: dict[int, float] = {}
    for frame in sequence.frames("points").tolist():
        scan = sequence.scan(frame, ("instances", "flow"))
        fast = (np.linalg.norm(scan.flow[:, :2], axis=1) > 1.0) & (scan.instances > 0)
        inside = sequence.grids[GRID].flat_index(scan.points) >= 0
        for instance, count in zip(
            *np.unique(scan.instances[fast & inside], return_counts=True), strict=True
        ):
            seen[int(instance)] = seen.get(int(instance), 0) + int(count)
    return max(seen, key=seen.get)


def without_fields(source: Path, out: Path, *fields: str) -> Path:
    """Copy the recording of a sequence without some fields, and without its grids."""
    folders = [layout.field_named(field).file(0).split("/")[0] for field in fields]
    shutil.copytree(source, out, ignore=shutil.ignore_patterns(*folders, GRID))
    return out


def with_boxes(source: Path, out: Path) -> Path:
    """Copy the recording of a sequence with boxes around what moves, instead of instances and flow."""
    sequence = sequence_of(source)
    feed = ScanFeed(sequence, FromScans(motion=MotionOptions("instances")))
    tracks = find_actors(feed).tracks.values()
    writer = FolderSink(without_fields(source, out, "instances", "flow")).sequence("cartesian")
    for frame in sequence.frames("points").tolist():
        sensor_T_world = invert(sequence.read_pose(frame))
        seen = [
            (track, sensor_T_world @ pose)
            for track in tracks
            if (pose := track.pose(frame)) is not None
        ]
        poses = np.stack([pose for _, pose in seen]) if seen else np.empty((0, 4, 4))
        numbers = np.array([[t.instance, t.label] for t, _ in seen], np.uint32).reshape(-1, 2)
        sizes = np.array([t.size for t, _ in seen]).reshape(-1, 3)
        known = np.ones(len(seen), np.bool_)
        boxes = Boxes(*numbers.T, poses[:, :3, 3], quaternions_of(poses[:, :3, :3]), sizes, known)
        writer.write("boxes", frame, boxes.to_table())
    return out


def write_carlaocc(source: Path, out: Path, name: str = "Town01_Opt_Seq07") -> None:
    """Write left-handed grids of CARLA's classes as a sequence of CarlaOcc, whose axes are
    right-handed.
    """
    sequence = sequence_of(source)
    spec, folder = sequence.grids[GRID], out / name / "occupancy" / "vs_0_4_surround_view"
    tag_of = {new: tag for tag, new in reversed(CARLAOCC_TO_CARLA.mapping.items())}
    tags = np.array([tag_of.get(i, 0) for i in range(max(tag_of) + 1)], np.uint16)
    folder.mkdir(parents=True)
    for frame in sequence.frames(f"{GRID}/labels").tolist():
        labels = tags[sequence.grid(GRID, frame).labels[:, ::-1]]
        cells = np.argwhere(labels > 0)
        rows = np.column_stack([cells, 1000 * labels[labels > 0]]).astype(np.uint16)
        geometry = {
            "voxel_size": spec.voxel_size[0],
            "voxel_origin": np.float32(spec.lower),
            "volume_size": spec.size,
        }
        np.savez_compressed(folder / f"{frame:04d}.npz", occupancy=rows, **geometry)
