"""The makers of docs/studies/makers.py: ours, other programs, and rules of papers.

Each takes a drive and settings, and returns the grids at the judged frames. `SETTINGS` lists the
settings that take part in a sweep. The first ones of each maker are what its authors advise for
LiDARs with few channels and short drives; `BEST` are the best ones of the sweep.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import study

import carlasc
from carlasc import FromScans, Grid, GridSpec, Voting
from carlasc.core.frames import FrameRange
from carlasc.core.geometry import invert, transform_points
from carlasc.core.grids import most_frequent
from carlasc.core.tables import CARLA
from carlasc.groundtruth.from_scans.feed import ScanFeed, WithoutScans
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.groundtruth.inputs import GridPlan
from carlasc.inspection.auditing.counting import crossings
from carlasc.motion import MotionOptions
from carlasc.motion.tracks import Track
from carlasc.storage.views import SequenceView

WINDOW = (-10, 10)
JUDGED = (12, 17, 22, 27)
SPEC = GridSpec.published()
SENSOR_M = 1.8  # height of the sensor above the ground, which a user of a vehicle knows
Settings = Mapping[str, Any]
Maker = Callable[["Drive", Settings], dict[int, Grid]]


@dataclass
class Drive:
    """A drive without the scans that are left out."""

    whole: carlasc.storage.Sequence
    hidden: tuple[int, ...]

    @property
    def frames(self) -> list[int]:
        """The frames of the drive."""
        return self.whole.frames("points").tolist()

    @property
    def scans(self) -> WithoutScans:
        """The scans that makers may use."""
        return WithoutScans(self.whole, self.hidden)

    def window(self, frame: int) -> list[int]:
        """Return the frames whose scans a maker may merge into a frame."""
        return [
            f
            for f in range(frame + WINDOW[0], frame + WINDOW[1] + 1)
            if f in self.frames and f not in self.hidden
        ]


class Cleaned(SequenceView):
    """Scans without the points that a filter took away."""

    def __init__(self, whole: carlasc.storage.Sequence, keep: dict[int, np.ndarray]) -> None:
        super().__init__(whole)
        self.keep = keep

    def read(self, field: str, frame: int) -> np.ndarray:
        """Read a field of a frame, without the points that were taken away."""
        values = self.whole.read(field, frame)
        per_point = field in ("points", "labels", "flow", "instances") and frame in self.keep
        return values[self.keep[frame]] if per_point else values


def ours(drive: Drive, settings: Settings) -> dict[int, Grid]:
    """Return our grids. `motion` is the source of motion."""
    return merge(drive.scans, FromScans(WINDOW, motion=MotionOptions(settings["motion"])))


def tube(drive: Drive, settings: Settings) -> dict[int, Grid]:
    """Return what adding up all scans gives."""
    return merge(drive.scans, FromScans(WINDOW, dynamic="tube"))


def merge(scans: carlasc.storage.Sequence, observe: FromScans) -> dict[int, Grid]:
    """Return our grids at the judged frames."""
    feed = ScanFeed(scans, observe)
    plan = GridPlan(SPEC, "evaluation", observe, Voting(), FrameRange.of(None))
    actors = find_actors(feed)
    return {
        f: merge_frame(plan, feed, actors, f, feed.reaching(f, SPEC)).grid
        for f in study.few(JUDGED)
    }


def in_world(drive: Drive) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return (N, 3) points and (4, 4) pose of each scan that is left, by frame."""
    poses = {f: drive.whole.read_pose(f) for f in drive.frames if f not in drive.hidden}
    return {
        f: (transform_points(pose, drive.whole.scan(f, ()).points), pose)
        for f, pose in poses.items()
    }


def dufomap(drive: Drive, settings: Settings) -> dict[int, Grid]:
    """Return `tube` after DUFOMap. `cell_m`, `hits_m` and `unknown` are the size of its cells, and
    by how much hits and unknown cells are inflated.
    """
    scans = in_world(drive)
    cloud = importlib.import_module("dufomap").dufomap(
        settings["cell_m"], settings["hits_m"], settings["unknown"], num_threads=1
    )
    for points, pose in scans.values():
        cloud.run(points.astype(np.float32), pose, cloud_transform=False)
    cloud.oncePropagateCluster(if_propagate=True, if_cluster=False)
    keep = {
        f: np.asarray(cloud.segment(points.astype(np.float32), pose, cloud_transform=False)) == 0
        for f, (points, pose) in scans.items()
    }
    return merge(Cleaned(drive.scans, keep), FromScans(WINDOW, dynamic="tube"))


def removal(drive: Drive, settings: Settings) -> dict[int, Grid]:
    """Return `tube` after dynamic-object-removal. `cleaners` names its cleaners and their options:
    points are removed that all of them remove. With `ground`, points below the height of the ground
    are kept.
    """
    scans = in_world(drive)
    points = np.concatenate([p for p, _ in scans.values()])
    sweeps = [(p, pose[:3, 3]) for p, pose in scans.values()]
    keep = kept_by_removal(points, sweeps, settings)
    parts = np.split(keep, np.cumsum([len(p) for p, _ in scans.values()])[:-1])
    return merge(
        Cleaned(drive.scans, dict(zip(scans, parts, strict=True))),
        FromScans(WINDOW, dynamic="tube"),
    )


def kept_by_removal(
    points: np.ndarray, sweeps: list[tuple[np.ndarray, np.ndarray]], settings: Settings
) -> np.ndarray:
    """Return which (N, 3) points of a map dynamic-object-removal keeps; sweeps are the points and
    the origin of each scan, on the axes of the map.
    """
    library, keep = importlib.import_module("dynamic_object_removal"), np.zeros(len(points), bool)
    for name, options in settings["cleaners"].items():
        heights = [origin[2] for _, origin in sweeps]
        ground = {"ground_z": float(np.median(heights)) - SENSOR_M + 0.2}
        extra = ground if settings.get("ground") and name == "visibility" else {}
        keep |= getattr(library, f"clean_map_by_{name}")(points, sweeps, **options, **extra)[1]
    return keep


def octomap(drive: Drive, settings: Settings) -> dict[int, Grid]:
    """Return the occupancy of OctoMap, with the most frequent class of the points in each voxel.

    Its cells are cubes. Heights are scaled, so that each voxel is one cube. `hit`, `miss` and
    `occupied` are its probabilities.
    """
    library, scans, grids = importlib.import_module("pyoctomap"), in_world(drive), {}
    edge = float(SPEC.voxel_size[0])
    scale, lower = edge / SPEC.voxel_size, np.array(SPEC.lower)
    for frame in study.few(JUDGED):
        tree = library.OcTree(edge)
        tree.setProbHit(settings["hit"])
        tree.setProbMiss(settings["miss"])
        tree.setOccupancyThres(settings["occupied"])
        grid_T_world = invert(drive.whole.read_pose(frame))
        for other in drive.window(frame):
            points, pose = scans[other]
            local = (transform_points(grid_T_world, points) - lower) * scale
            tree.insertPointCloud(local, ((grid_T_world @ pose)[:3, 3] - lower) * scale)
        nodes = [tree.search(center) for center in (SPEC.centers().reshape(-1, 3) - lower) * scale]
        known = np.array([node is not None for node in nodes])
        occupied = np.array([node is not None and tree.isNodeOccupied(node) for node in nodes])
        placed = {f: scans[f][0] for f in drive.window(frame)}
        grids[frame] = with_classes(drive, frame, placed, occupied, known)
    return grids


def surroundocc(drive: Drive, settings: Settings) -> dict[int, Grid]:
    """Return stacked points, those of objects in their boxes."""
    scans, grids, tracks = in_world(drive), {}, tracks_of(drive)
    for frame in study.few(JUDGED):
        placed = {
            other: with_objects(tracks, scans[other][0], other, frame)
            for other in drive.window(frame)
        }
        labels = classes_in(drive, frame, placed).reshape(SPEC.size)
        grids[frame] = Grid(SPEC, labels.astype(np.uint8), np.ones(SPEC.size))
    return grids


def evidential(drive: Drive, settings: Settings) -> dict[int, Grid]:
    """Return the evidential rule of Kälble et al. (CVPR 2024), written from the paper.

    A return is evidence for an occupied voxel, and a ray that crosses it for a free one.
    Dempster's rule joins them: `miss` is the probability that a ray crosses an occupied voxel,
    `false` that of a return in a free one. The rays near each object are counted in its box, all
    others in the world. A voxel is known if the mass of "unknown" is below one half. Rays are
    counted in the voxels; the paper resamples a spherical grid.
    """
    scans, grids, tracks = in_world(drive), {}, tracks_of(drive)
    for frame in study.few(JUDGED):
        grid_T_world = invert(drive.whole.read_pose(frame))
        counts, placed = np.zeros((2, SPEC.num_voxels)), {}
        objects = {number: np.zeros_like(counts) for number in range(len(tracks))}
        for other in drive.window(frame):
            points, pose = scans[other]
            placed[other] = with_objects(tracks, points, other, frame)
            still = np.ones(len(points), np.bool_)
            for number, track in enumerate(tracks):
                then, now = track.pose(other), track.pose(frame)
                still[np.asarray(track.members.get(other, ()), np.int64)] = False
                if then is not None and now is not None:
                    near = rays_near(track, then, pose[:3, 3], points)
                    moved = grid_T_world @ now @ invert(then)
                    objects[number] += count_rays(pose[:3, 3], points[near], moved, ())
            counts += count_rays(pose[:3, 3], points, grid_T_world, np.flatnonzero(~still))
        for number, track in enumerate(tracks):
            if (now := track.pose(frame)) is not None:
                body = in_body(track, grid_T_world @ now)
                counts[:, body] = objects[number][:, body]
        ends, crossed = counts
        doubt_full, doubt_free = settings["false"] ** ends, settings["miss"] ** crossed
        full, free = doubt_free * (1 - doubt_full), doubt_full * (1 - doubt_free)
        known = doubt_full * doubt_free < full + free
        grids[frame] = with_classes(drive, frame, placed, known & (full > free), known)
    return grids


def count_rays(
    origin: np.ndarray, points: np.ndarray, grid_T_points: np.ndarray, without: Any
) -> np.ndarray:
    """Return (2, V) returns in each voxel, and rays that cross it. Returns with the indices
    `without` are left out.
    """
    local = transform_points(grid_T_points, points)
    begun = np.broadcast_to(transform_points(grid_T_points, origin[None]), local.shape)
    crossed = crossings(begun, local, SPEC, float(SPEC.voxel_size[0]) / 2)
    inside = np.delete(SPEC.flat_index(local), without)
    ends = np.bincount(inside[inside >= 0], minlength=SPEC.num_voxels)
    return np.stack([ends, crossed.reshape(-1)]).astype(np.float64)


def rays_near(
    track: Track, world_T_actor: np.ndarray, origin: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Return the indices of the rays that pass the ball around an object, or end in it."""
    center = transform_points(world_T_actor, (track.lower + track.upper)[None] / 2)[0] - origin
    radius = float(np.linalg.norm(track.upper - track.lower)) / 2
    rays = points - origin
    lengths = np.linalg.norm(rays, axis=1)
    along = np.clip(rays @ center / np.maximum(lengths, 1e-9), 0, lengths)
    foot = rays * (along / np.maximum(lengths, 1e-9))[:, None]
    return np.flatnonzero(np.linalg.norm(foot - center, axis=1) < radius)


def in_body(track: Track, grid_T_actor: np.ndarray) -> np.ndarray:
    """Return the voxels whose centre lies in the box of an object."""
    own = transform_points(invert(grid_T_actor), SPEC.centers().reshape(-1, 3))
    return np.flatnonzero(((own >= track.lower) & (own <= track.upper)).all(axis=1))


def tracks_of(drive: Drive) -> list[Track]:
    """Return the tracks of the numbered objects."""
    feed = ScanFeed(drive.scans, FromScans(motion=MotionOptions("instances")))
    return list(find_actors(feed).tracks.values())


def with_objects(tracks: list[Track], points: np.ndarray, other: int, frame: int) -> np.ndarray:
    """Return the points of another scan, those of objects where their box is at a frame."""
    placed = points.copy()
    for track in tracks:
        own, then, now = track.members.get(other, ()), track.pose(other), track.pose(frame)
        if len(own) and then is not None:
            placed[own] = (
                np.nan if now is None else transform_points(now @ invert(then), points[own])
            )
    return placed


def with_classes(
    drive: Drive,
    frame: int,
    placed: dict[int, np.ndarray],
    occupied: np.ndarray,
    known: np.ndarray,
) -> Grid:
    """Return a grid from the states of its voxels; the class is the most frequent one of the points
    in it.
    """
    labels = classes_in(drive, frame, placed)
    labels = np.where(occupied, np.where(labels > 0, labels, CARLA.geometry_id), 0)
    return Grid(
        SPEC, labels.reshape(SPEC.size).astype(np.uint8), known.reshape(SPEC.size).astype(float)
    )


def classes_in(drive: Drive, frame: int, placed: dict[int, np.ndarray]) -> np.ndarray:
    """Return (V,) the most frequent class of the points in each voxel of a frame; 0 where there is
    none.
    """
    grid_T_world = invert(drive.whole.read_pose(frame))
    voxels = np.concatenate(
        [SPEC.flat_index(transform_points(grid_T_world, points)) for points in placed.values()]
    )
    labels = np.concatenate([drive.whole.read("labels", f) for f in placed])
    found = np.zeros(SPEC.num_voxels, np.int64)
    cells, kinds = most_frequent(voxels[voxels >= 0], labels[voxels >= 0])
    found[cells] = kinds
    return found


_RANGE = {"h_res_deg": 2.5, "v_res_deg": 2.5, "min_see_through": 3, "max_surface_hits": 5}
_FINE = {"h_res_deg": 1.0, "v_res_deg": 1.0, "min_see_through": 2, "max_surface_hits": 2}


@dataclass(frozen=True)
class Rival:
    """A maker that takes part.

    Attributes:
        told: what it is told besides points and poses.
        make: the maker.
        settings: those of the sweep; the first ones are what its authors advise.
        best: the place of the best settings in the sweep.
        module: what must be installed.
    """

    told: str
    make: Maker
    settings: tuple[Settings, ...] = ({},)
    best: int = 0
    module: str | None = None


RIVALS = {
    "`tube`": Rival("classes", tube),
    "DUFOMap, then `tube`": Rival(
        "classes",
        dufomap,
        tuple(
            {"cell_m": cell, "hits_m": hits, "unknown": unknown}
            for cell, hits, unknown in (
                (0.1, 0.2, 1),
                (0.1, 0.2, 2),
                (0.1, 0.1, 1),
                (0.1, 0.4, 1),
                (0.2, 0.2, 1),
                (0.2, 0.4, 1),
                (0.2, 0.2, 0),
                (0.3, 0.3, 1),
                (0.4, 0.2, 1),
                (0.4, 0.4, 1),
            )
        ),
        best=8,
        module="dufomap",
    ),
    "dynamic-object-removal, then `tube`": Rival(
        "classes",
        removal,
        (
            {"cleaners": {"visibility": _RANGE, "scan_ratio": {}}},
            {"cleaners": {"visibility": _RANGE}},
            {"cleaners": {"visibility": _RANGE}, "ground": True},
            {"cleaners": {"visibility": _RANGE | {"max_surface_hits": 2}}, "ground": True},
            {"cleaners": {"visibility": _RANGE | {"min_see_through": 2}}, "ground": True},
            {"cleaners": {"visibility": _FINE}, "ground": True},
            {"cleaners": {"visibility": _FINE | {"max_surface_hits": 5}}, "ground": True},
            {"cleaners": {"visibility": _FINE | {"max_surface_hits": 10}}, "ground": True},
            {"cleaners": {"scan_ratio": {}}},
            {"cleaners": {"scan_ratio": {"min_votes": 2}}},
        ),
        best=7,
        module="dynamic_object_removal",
    ),
    "OctoMap": Rival(
        "classes",
        octomap,
        tuple(
            {"hit": hit, "miss": miss, "occupied": occupied}
            for hit, miss, occupied in (
                (0.7, 0.4, 0.5),
                (0.7, 0.45, 0.5),
                (0.7, 0.49, 0.5),
                (0.85, 0.45, 0.5),
                (0.85, 0.4, 0.5),
                (0.6, 0.45, 0.5),
                (0.95, 0.45, 0.5),
                (0.95, 0.4, 0.5),
            )
        ),
        best=3,
        module="pyoctomap",
    ),
    "SurroundOcc's recipe": Rival("classes, boxes", surroundocc),
    "evidential rule": Rival(
        "classes, boxes",
        evidential,
        tuple(
            {"miss": miss, "false": false}
            for miss, false in (
                (0.95, 0.2),
                (0.8, 0.2),
                (0.9, 0.2),
                (0.9, 0.05),
                (0.95, 0.05),
                (0.8, 0.05),
                (0.97, 0.1),
                (0.97, 0.3),
                (0.98, 0.2),
                (0.99, 0.1),
                (0.99, 0.3),
            )
        ),
        best=10,
    ),
    "ours, flow": Rival("classes, flow", ours, ({"motion": "flow"},)),
    "ours, instances": Rival("classes, instances", ours, ({"motion": "instances"},)),
    "ours, free space": Rival("classes", ours, ({"motion": "evidence"},)),
}
