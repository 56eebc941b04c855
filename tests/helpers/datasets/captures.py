"""Small captures of random recordings, and the files of a folder as a dictionary."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from carlasc.captures import Capture, CaptureWriter, SensorRecording
from carlasc.core.geometry import rotation_z, translation
from carlasc.core.scans import Scan


def make_recording(points: int = 300, actors: int = 3, seed: int = 0) -> SensorRecording:
    """Return a recording of random points around the sensor, some of them on moving actors, at a
    random pose without roll and pitch.
    """
    rng = np.random.default_rng(seed)
    xyz = rng.uniform((-20, -20, -2), (20, 20, 1), (points, 3)).astype(np.float32)
    instances = rng.integers(0, actors + 1, points).astype(np.uint32)
    labels = np.where(instances > 0, 10, rng.integers(0, 23, points)).astype(np.uint32)
    velocities = np.column_stack([np.arange(1, actors + 1), rng.normal(size=(actors, 3))])
    pose = translation(rng.uniform(-5, 5, 3)) @ rotation_z(rng.uniform(-np.pi, np.pi))
    return SensorRecording(Scan(xyz, labels, None, instances), pose, velocities)


def write_capture(
    root: Path, frames: int = 3, sensors: int = 2, first: int = 100, points: int = 300
) -> Capture:
    """Write a capture of random recordings to a sequence's folder and return it.

    The picture of frame f is the text "picture f".
    """
    writer = CaptureWriter(root)
    for frame in range(first, first + frames):
        for sensor in range(sensors):
            writer.write(sensor, frame, make_recording(points, seed=1000 * sensor + frame))
        writer.write_times({frame: [frame * 0.1] * sensors})
        writer.write_bev(frame, f"picture {frame}".encode())
    return Capture(root)


def read_tree(folder: Path, leave_out: str = "raw") -> dict[str, bytes]:
    """Return the content of every file in a folder by its relative path, also of hidden files,
    except in folders called `leave_out`, and records of inputs, which have the times of files.
    """
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
        and leave_out not in path.relative_to(folder).parts
        and not (path.suffix == ".json" and path.parent.name == ".carlasc")
    }
