"""The drives of `movers.py`, recorded once, and what other sensors saw at the judged frames: both
are kept in a folder.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from carlasc_recorders import TownActor, TownDrive
from carlasc_recorders.town.actors import EGO_ID
from carlasc_recorders.town.drive import REFERENCE_OFFSET_M, concatenate_scans, scan_snapshot
from crowded import FRAMES as CROWDED_FRAMES
from crowded import CrowdedDrive
from manoeuvring import FRAMES as MANOEUVRES_FRAMES
from manoeuvring import ManoeuvreDrive
from numpy.typing import NDArray
from railed import RailedDrive
from street import StreetDrive
from study import is_tiny, labels_of

import carlasc
from carlasc import Boxes, GridSpec
from carlasc.captures import Lidar, SensorRecording
from carlasc.core.geometry import Transform, invert, relative_to, transform_points, translation
from carlasc.core.tables import CARLA
from carlasc.groundtruth import Observation, count_votes
from carlasc.storage import FolderSink, Sequence, layout

# constants were chosen on others
SEEDS = {
    "town": range(61, 66),
    "street": range(261, 266),
    "railed": range(361, 366),
}
POINTS = {16: 29_000, 32: 65_000, 64: 130_000, 128: 236_000}  # rays per scan by channels
GRIDS = {"coarse": GridSpec.published(), "0.2 m": GridSpec.published().with_resolution(0.2)}
VEHICLE = CARLA.id_of("Vehicle")
MOVES_M_S = 1.0  # faster actors are movers; the voxels of the others are not judged
# frame, actor, points, sensor and half the size (3 each, metres, frame of the box) per actor and
# scan
SIGHTINGS = "sightings.npy"
_GROW_M = 0.4  # voxels this close to an actor's box may hold a part of it
# a side is seen from 15 degrees or more, by scans with so many points on the actor
_FACE_SINE, _FACE_POINTS = (
    0.26,
    12,
)


@dataclass(frozen=True)
class Kind:
    """A kind of drive.

    Attributes:
        make: makes the drive of a seed and a LiDAR.
        frames: number of frames.
        candidates: frames whose grids may be judged.
        judged: how many of them are: those with most moving vehicles nearby.
        sensors: number of sensors of the reference.
        movers_only: whether the voxels of actors that stand are left out.
    """

    make: Callable[[int, Lidar], TownDrive]
    frames: int
    candidates: tuple[int, ...]
    judged: int
    sensors: int
    movers_only: bool = True


def _town(seed: int, lidar: Lidar) -> TownDrive:
    return TownDrive(seed, "heavy", lidar)


def _town_without_parked_cars(seed: int, lidar: Lidar) -> TownDrive:
    drive = TownDrive(seed, "heavy", lidar)
    drive._population._parked = []
    return drive


KINDS = {
    "town": Kind(_town_without_parked_cars, 91, tuple(range(30, 61, 5)), 3, 40),
    "street": Kind(StreetDrive, 91, (30, 45, 60), 3, 40),
    "railed": Kind(RailedDrive, 91, (30, 45, 60), 3, 40),
    "manoeuvres": Kind(ManoeuvreDrive, MANOEUVRES_FRAMES, (45,), 1, 40),
    "crowded": Kind(CrowdedDrive, CROWDED_FRAMES, (20,), 1, 40),
    "parked": Kind(
        _town, 101, tuple(int(f) for f in np.linspace(0, 100, 10)), 10, 60, movers_only=False
    ),
}


def kind_of(name: str) -> Kind:
    """Return a kind of drive; a tiny study has the first frames of it only."""
    kind = KINDS[name]
    return replace(kind, frames=12, candidates=(4,), judged=1, sensors=2) if is_tiny() else kind


@dataclass(frozen=True)
class Setting:
    """A drive and the LiDAR that records it.

    Attributes:
        kind: kind of the drive.
        seed: its seed.
        channels: number of channels of each LiDAR.
        lidars: number of LiDARs that turn at one place, each from another azimuth; 0: one LiDAR
            that sees everything at one instant.
        parts: of a turn; 1: they do not turn.
    """

    kind: str
    seed: int
    channels: int
    lidars: int = 0
    parts: int = 20

    @property
    def drive(self) -> str:
        """Name of the drive."""
        return f"{self.kind}{self.seed}"

    def __str__(self) -> str:
        turning = f"_{self.lidars}x{self.parts}" if self.lidars else ""
        return f"{self.drive}_{self.channels}{turning}"

    @property
    def lidar(self) -> Lidar:
        """Each LiDAR; that of a tiny study has few rays."""
        points = POINTS[self.channels] // max(self.lidars, 1) // (12 if is_tiny() else 1)
        return Lidar(channels=self.channels, points=points)

    def record(self, drive: TownDrive, frame: int) -> SensorRecording:
        """Return what the LiDARs see."""
        if not self.lidars:
            noise = np.random.default_rng([self.seed, self.channels, frame])
            pose = drive.sensor_poses(frame, 1)[0]
            return scan_snapshot(drive.snapshot(frame), pose, self.lidar, noise)
        drive.lidar = self.lidar
        turns = [
            drive.sweep(frame, parts=self.parts, phase=k / self.lidars) for k in range(self.lidars)
        ]
        hit = np.unique(np.concatenate([turn.velocities for turn in turns]), axis=0)
        scan = concatenate_scans([turn.scan for turn in turns])
        return SensorRecording(scan, turns[0].world_T_sensor, hit)


@dataclass(frozen=True)
class Reference:
    """What other sensors saw at the instant of a frame.

    Attributes:
        labels: (X, Y, Z) class of each voxel.
        judged: (X, Y, Z) bool, the voxels that are known and whose actor, if they belong to one,
            moves.
        owner: (X, Y, Z) uint16, number of the actor that a voxel may belong to; 0 is none.
        speeds: speed of each actor in m/s.
    """

    labels: NDArray[np.uint8]
    judged: NDArray[np.bool_]
    owner: NDArray[np.uint16]
    speeds: dict[int, float]


@dataclass(frozen=True)
class Recorded:
    """A recorded drive.

    Attributes:
        setting: what it is.
        sequence: points, labels, flow, instances and exact boxes of all frames.
        folder: where things are kept that are made from it.
    """

    setting: Setting
    sequence: Sequence
    folder: Path

    def sides(self, frame: int, window: tuple[int, int]) -> dict[int, int]:
        """Return how many of its four sides the scans of a window saw of each actor."""
        kept = np.load(self.folder / SIGHTINGS)
        kept = kept[(kept[:, 0] >= frame + window[0]) & (kept[:, 0] <= frame + window[1])]
        actors, points, sensors, half = kept[:, 1], kept[:, 2], kept[:, 3:6], kept[:, 6:9]
        distance = np.linalg.norm(sensors[:, :2], axis=1)
        seen = {int(actor): 0 for actor in np.unique(actors)}
        for axis in (0, 1):
            for sign in (-1.0, 1.0):
                faces = sign * sensors[:, axis] - half[:, axis] > _FACE_SINE * distance
                for actor in seen:
                    seen[actor] += int(points[faces & (actors == actor)].sum() >= _FACE_POINTS)
        return seen


def record(kind: str, seed: int, channels: Iterable[int], work: Path) -> list[Recorded]:
    """Record a drive with everything that tells what moves, once for each LiDAR; those that were
    recorded before are opened.
    """
    return record_all([Setting(kind, seed, count) for count in channels], work)


def record_all(settings: Iterable[Setting], work: Path) -> list[Recorded]:
    """Record one drive in several settings; those that were recorded before are opened."""
    folders = {setting: work / "drives" / str(setting) for setting in settings}
    missing = {setting: folder for setting, folder in folders.items() if not folder.exists()}
    if missing:
        unfinished = {
            setting: folder.with_name(f"{folder.name}.{os.getpid()}")
            for setting, folder in missing.items()
        }
        for folder in unfinished.values():
            shutil.rmtree(folder, ignore_errors=True)
        _write(unfinished)
        for setting, folder in unfinished.items():
            folder.rename(missing[setting])
    return [Recorded(setting, _open(folder), folder) for setting, folder in folders.items()]


def _open(folder: Path) -> Sequence:
    (sequence,) = carlasc.open(folder).sequences().values()
    return sequence


def _write(folders: dict[Setting, Path]) -> None:
    """Record a drive in several settings, each in its folder."""
    first = next(iter(folders))
    frames = kind_of(first.kind).frames
    drive = kind_of(first.kind).make(first.seed, Lidar())
    poses = np.stack([drive.sensor_poses(frame, 1)[0] for frame in range(frames)])
    writers = {
        setting: FolderSink(folder).sequence("cartesian") for setting, folder in folders.items()
    }
    sightings: dict[Setting, list[NDArray[np.float64]]] = {setting: [] for setting in folders}
    for writer in writers.values():
        writer.write_document(layout.POSES, layout.encode_poses(relative_to(poses[0], poses)))
        writer.write_document(
            layout.TIMES,
            layout.encode_times(np.arange(frames, dtype=np.float64) * layout.FRAME_PERIOD_S),
        )
    for frame in range(frames):
        snapshot = drive.snapshot(frame)
        for setting, writer in writers.items():
            recording = setting.record(drive, frame)
            scan = recording.scan
            assert scan.instances is not None
            writer.write(
                "points", frame, np.column_stack([scan.points, np.zeros(len(scan), np.float32)])
            )
            writer.write("labels", frame, labels_of(scan))
            writer.write("instances", frame, scan.instances)
            writer.write("flow", frame, recording.flow())
            for name, values in scan.others.items():
                writer.write(name, frame, values)
            numbers, points = np.unique(scan.instances[scan.instances > 0], return_counts=True)
            boxes = boxes_of([snapshot.actors[int(number)] for number in numbers], poses[frame])
            writer.write("boxes", frame, boxes.to_table())
            sensors = np.array([invert(pose)[:3, 3] for pose in boxes.sensor_T_box]).reshape(-1, 3)
            at = np.full(len(numbers), frame)
            sightings[setting].append(
                np.column_stack([at, numbers, points, sensors, boxes.sizes / 2])
            )
    for setting, folder in folders.items():
        np.save(folder / SIGHTINGS, np.concatenate(sightings[setting]))


def boxes_of(actors: list[TownActor], world_T_sensor: Transform) -> Boxes:
    """Return the tight boxes of actors in the frame of a sensor; their tracks are the actors'
    numbers.
    """
    poses, sizes = np.zeros((len(actors), 4, 4)), np.zeros((len(actors), 3))
    for row, actor in enumerate(actors):
        lower, upper = actor.mesh.vertices.min(axis=0), actor.mesh.vertices.max(axis=0)
        poses[row] = invert(world_T_sensor) @ actor.world_T_actor @ translation((lower + upper) / 2)
        sizes[row] = upper - lower
    labels = np.array([label_of(actor) for actor in actors], np.uint32)
    return Boxes.from_poses(
        np.array([actor.id for actor in actors], np.uint32), labels, poses, sizes
    )


def label_of(actor: TownActor) -> int:
    """Return the class of an actor."""
    return int(np.bincount(actor.mesh.labels).argmax())


def reference(
    kind: str, seed: int, work: Path, grids: Mapping[str, GridSpec] = GRIDS
) -> dict[tuple[str, int], Reference]:
    """Return the references of a drive by grid and frame; they are made once."""
    others = "" if grids is GRIDS else "-".join(["", *grids]).replace(" ", "")
    path = work / "references" / f"{kind}{seed}{others}.npz"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_name(f"{kind}{seed}{others}.{os.getpid()}.npz")
        seen = _see(kind, seed, grids)
        # mypy: an array could be named like the option; none is
        np.savez_compressed(unfinished, **seen)  # type: ignore[arg-type]
        unfinished.rename(path)
    kept = np.load(path)
    found = {}
    for frame in kept["frames"].tolist():
        speeds = {int(actor): float(speed) for actor, speed in kept[f"{frame} speeds"]}
        for grid in grids:
            labels, known, owner = (
                kept[f"{frame} {grid} {name}"] for name in ("labels", "known", "owner")
            )
            if KINDS[kind].movers_only:
                known = known & ~np.isin(
                    owner, [actor for actor, speed in speeds.items() if speed <= MOVES_M_S]
                )
            found[grid, frame] = Reference(labels, known, owner, speeds)
    return found


def _see(name: str, seed: int, grids: Mapping[str, GridSpec]) -> dict[str, NDArray[Any]]:
    """Return the arrays of a drive's references."""
    kind = kind_of(name)
    drive = kind.make(seed, Lidar())
    arrays: dict[str, NDArray[Any]] = {}
    frames = choose_frames(drive, kind)
    arrays["frames"] = np.array(frames)
    for frame in frames:
        pose = drive.sensor_poses(frame, 1)[0]
        seen = [
            Observation(r.scan.points, labels_of(r.scan), invert(pose) @ r.world_T_sensor)
            for r in drive.reference_observations(frame, kind.sensors)
        ]
        actors = [actor for actor in drive.snapshot(frame).actors.values() if actor.id != EGO_ID]
        speeds = [(actor.id, np.linalg.norm(actor.velocity)) for actor in actors]
        arrays[f"{frame} speeds"] = np.array(speeds, np.float64).reshape(-1, 2)
        for size, spec in grids.items():
            grid = count_votes(seen, spec).to_grid()
            arrays[f"{frame} {size} labels"], arrays[f"{frame} {size} known"] = (
                grid.labels,
                grid.known,
            )
            arrays[f"{frame} {size} owner"] = owners(actors, invert(pose), spec)
    return arrays


def choose_frames(drive: TownDrive, kind: Kind) -> list[int]:
    """Return the candidates with most moving vehicles in the grid's area, in their order."""
    counts = []
    for frame in kind.candidates:
        here = drive.sensor_poses(frame, 1)[0]
        moving = [
            a
            for a in drive.actors(frame)
            if np.linalg.norm(a.velocity) > MOVES_M_S and label_of(a) == VEHICLE
        ]
        places = np.array(
            [actor.world_T_actor[:3, 3] for actor in moving if actor.id != EGO_ID]
        ).reshape(-1, 3)
        near = np.abs(transform_points(invert(here), places)[:, :2]) < REFERENCE_OFFSET_M
        counts.append(int(near.all(axis=1).sum()))
    best = np.argsort(-np.array(counts), kind="stable")[: kind.judged]
    return sorted(kind.candidates[int(row)] for row in best)


def owners(actors: list[TownActor], grid_T_world: Transform, spec: GridSpec) -> NDArray[np.uint16]:
    """Return the actor that each voxel may belong to; the smaller one where boxes overlap."""
    owner = np.zeros(spec.num_voxels, np.uint16)
    centers = spec.from_axes(spec.centers()).reshape(-1, 3)
    bounds = {
        a.id: (a.mesh.vertices.min(axis=0) - _GROW_M, a.mesh.vertices.max(axis=0) + _GROW_M)
        for a in actors
    }
    for actor in sorted(actors, key=lambda a: -float(np.prod(bounds[a.id][1] - bounds[a.id][0]))):
        lower, upper = bounds[actor.id]
        actor_T_grid = invert(actor.world_T_actor) @ invert(grid_T_world)
        reach = np.linalg.norm(np.maximum(-lower, upper))
        near = np.flatnonzero((np.abs(centers - invert(actor_T_grid)[:3, 3]) <= reach).all(axis=1))
        local = transform_points(actor_T_grid, centers[near])
        owner[near[((local > lower) & (local < upper)).all(axis=1)]] = actor.id
    return owner.reshape(spec.size)
