"""Simulated drives with four kinds of labels: what many sensors saw, and what one sensor's scans
give, with and without ghost trails.

Every scan of a drive is that of the ego LiDAR. The grids of its middle frames are named after their
labels:

    evaluation  capture truth: what all sensors of a capture saw at the instant of the frame
    tube        the scans around the frame, merged as they are (SemanticKITTI): what moves leaves
    traces align       the same scans, with each moving actor completed at its place in the frame;
    with the probability of each class wrong       as align, but 20% of the points of each scan
    have a wrong label, in clumps of 1 m
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from carlasc_recorders import TownDrive
from numpy.typing import NDArray

from benchmarking.sizes import SPLITS, Scenes, settings_of
from carlasc import FromScans, Grid, GridSpec, Run, Voting, label, regrid
from carlasc import open as open_source
from carlasc.captures import TrafficLevel
from carlasc.core import CARLA, invert, relative_to, transform_points
from carlasc.errors import ConflictError
from carlasc.groundtruth import Observation, count_votes
from carlasc.motion import MotionOptions
from carlasc.storage import FolderSink, SequenceWriter
from carlasc.testing import wrong_labels

TRAFFIC: TrafficLevel = "heavy"
_FIRST, _LAST, _EVERY = 50, 650, 10  # frames of a drive that are looked at to choose a stretch
_MOVES_M_S = 1.0
_PERIOD_S = 0.1
_WRONG, _CLUMP_M = 0.2, 1.0
_SETTINGS = "scenes.json"


def build_drives(
    out: Path,
    scenes: Scenes,
    *,
    merge: bool = True,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Simulate the drives and label them. A drive that exists is not made again.

    Args:
        out: root of the data set.
        scenes: what is simulated.
        merge: whether the scans are merged, too; if not, the only labels are capture truth.
        workers: number of processes that merge scans; None uses all cores.
        progress: called with the number of finished drives and the number of all drives.

    Raises:
        ConflictError: `out` holds other scenes.
    """
    settings = settings_of(scenes)
    kept = out / _SETTINGS
    if kept.exists() and json.loads(kept.read_text()) != settings:
        raise ConflictError(
            kept,
            expected=json.dumps(settings),
            found="other scenes",
            advice="choose another folder",
        )
    out.mkdir(parents=True, exist_ok=True)
    kept.write_text(json.dumps(settings))
    towns = [
        (split, first + index)
        for (split, first), count in zip(SPLITS, scenes.towns, strict=True)
        for index in range(count)
    ]
    for done, (split, seed) in enumerate(towns, 1):
        path = f"{split}/Town{seed}_{TRAFFIC.title()}"
        writer = FolderSink(out).sequence(f"{path}/cartesian")
        if writer.read_document("evaluation/params.json") is None:  # written last
            record_drive(writer, TownDrive(seed, TRAFFIC, scenes.lidar), scenes)
        if merge and split != "Test":  # all runs are scored on capture truth
            merge_scans(out / path, scenes, workers)
        if progress:
            progress(done, len(towns))


def record_drive(writer: SequenceWriter, drive: TownDrive, scenes: Scenes) -> None:
    """Write the scans of a stretch of a drive, with labels and flow, and the capture truth of its
    middle frames.
    """
    count = scenes.frames + 2 * scenes.margin
    first = choose_stretch(drive, scenes)
    poses = np.stack([drive.sensor_poses(frame, 1)[0] for frame in range(first, first + count)])
    for number in range(count):
        scan = drive.scan(first + number)
        arrays: dict[str, Any] = {
            "points": np.column_stack([scan.points, np.zeros(len(scan), np.float32)])
        }
        arrays |= {"labels": scan.labels, "flow": scan.flow}
        if scenes.margin <= number < count - scenes.margin:
            grid = see_all(drive, first + number, scenes.sensors, scenes.spec)
            arrays |= {"evaluation/labels": grid.labels, "evaluation/counts": grid.counts}
        for name, array in arrays.items():
            writer.write(name, number, array)
    writer.write_document("poses.txt", _lines(relative_to(poses[0], poses)[:, :3].reshape(-1, 12)))
    writer.write_document("times.txt", _lines(np.arange(count)[:, None] * _PERIOD_S))
    writer.write_document("evaluation/params.json", json.dumps(scenes.spec.to_params()).encode())


def see_all(drive: TownDrive, frame: int, sensors: int, spec: GridSpec) -> Grid:
    """Return what all sensors of the vehicle see at the instant of a frame, in the ego sensor's
    frame.
    """
    ego = drive.sensor_poses(frame, 1)[0]
    recordings = (drive.record(frame, sensor) for sensor in range(sensors))
    seen = (
        Observation(each.scan.points, each.scan.labels, relative_to(ego, each.world_T_sensor))
        for each in recordings
        if each.scan.labels is not None
    )
    return count_votes(seen, spec).to_grid()


def merge_scans(folder: Path, scenes: Scenes, workers: int | None) -> None:
    """Make the labels that one sensor's scans give. Frames that exist are skipped."""
    frames = scenes.margin, scenes.margin + scenes.frames
    window = -scenes.margin, scenes.margin
    tube, align = (
        FromScans(window=window, dynamic="tube"),
        FromScans(window=window, dynamic="align", motion=MotionOptions("flow")),
    )
    regrid(folder, scenes.spec, observe=tube, name="tube", frames=frames, run=Run(workers=workers))
    run, evidence = Run(workers=workers), Voting(keep_evidence=True)
    regrid(
        folder, scenes.spec, observe=align, voting=evidence, name="align", frames=frames, run=run
    )
    if (folder / "cartesian" / "wrong").exists():
        return
    with TemporaryDirectory(dir=folder.parent.parent, prefix=".wrong-") as temporary:
        files, copy = Path(temporary) / "files", Path(temporary) / "copy"
        write_wrong_labels(folder, files)
        label(folder, copy, files, by="simulated errors", run=run)
        regrid(copy, scenes.spec, observe=align, name="wrong", frames=frames, run=run)
        (grid,) = copy.rglob("wrong")
        grid.rename(folder / "cartesian" / "wrong")


def write_wrong_labels(drive: Path, out: Path) -> None:
    """Write labels of all scans of a drive, of which 20% are wrong: in clumps of 1 m, which are
    others in each scan.
    """
    out.mkdir()
    (sequence,) = open_source(drive).sequences().values()
    for frame in sequence.frames("points").tolist():
        scan = sequence.scan(frame, ["labels"])
        if scan.labels is not None:
            np.save(
                out / f"{frame:06d}.npy",
                wrong_labels(scan.labels, scan.points, _WRONG, clump_m=_CLUMP_M, seed=frame),
            )


def choose_stretch(drive: TownDrive, scenes: Scenes) -> int:
    """Return the first frame of the stretch in which most frames show a pedestrian, and a vehicle
    that moves, in the grid.

    Both are rare at a random frame. The earliest of equal stretches is taken.
    """
    looked_at = np.arange(_FIRST, _LAST, _EVERY)
    shown = np.array([_who_is_near(drive, int(frame), scenes.half_width_m) for frame in looked_at])
    length = max(1, round(scenes.frames / _EVERY))
    scores = np.convolve(shown.sum(1), np.ones(length), "valid")
    return int(looked_at[scores.argmax()]) - scenes.margin


def _who_is_near(drive: TownDrive, frame: int, within_m: float) -> tuple[bool, bool]:
    """Return whether a pedestrian, and whether a moving vehicle other than the ego, is in the grid
    of a frame.
    """
    ego, *others = drive.actors(frame)
    places = np.array([actor.world_T_actor[:3, 3] for actor in others]).reshape(-1, 3)
    offsets = np.abs(transform_points(invert(ego.world_T_actor), places)[:, :2]).max(1, initial=0.0)
    near = [actor for actor, offset_m in zip(others, offsets, strict=True) if offset_m < within_m]
    walking = [int(np.bincount(actor.mesh.labels).argmax()) == _pedestrian() for actor in near]
    moving = [float(np.linalg.norm(actor.velocity)) > _MOVES_M_S for actor in near]
    driving = [moves and not walks for walks, moves in zip(walking, moving, strict=True)]
    return any(walking), any(driving)


@cache
def _pedestrian() -> int:
    return CARLA.id_of("Pedestrian")


def _lines(rows: NDArray[np.floating]) -> bytes:
    """Return rows of numbers as text, as poses.txt and times.txt have them."""
    return "".join(" ".join(f"{value:.18e}" for value in row) + "\n" for row in rows).encode()
