"""Recordings for other viewers, and the page: time and size for a minute that people wait for."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from benchmarks.test_bench_rendering import street
from helpers.scenes.lidar_frames import street_frame

from carlasc import GridSpec, Scene, view
from carlasc.storage import layout
from carlasc.storage.files import to_json
from carlasc.storage.folder import FolderSink
from measuring.figures import Figure
from measuring.sizes import Size

_FRAMES, _PATH = 60, "Train/Town01_Light/cartesian"


def measure_recordings(size: Size, folder: Path) -> Iterator[tuple[str, Figure]]:
    """Yield the wall time and the size of a recording, and of a page, of 60 frames of the published
    grid with full scans.
    """
    _write(folder / "data")
    scene = Scene(folder / "data", frames=(0, _FRAMES))
    for ending in ("rrd", "mcap", "html"):
        out = folder / f"scene.{ending}"
        seconds = []
        for _ in range(1 if size.slow_repeats == 1 else 2):
            start = time.perf_counter()
            view(scene, out, overwrite=True)
            seconds.append(time.perf_counter() - start)
        text = f"view of {_FRAMES} frames, 128 x 128 x 8, scans of 130,000 points, into .{ending}"
        yield f"view.{ending}.time", Figure(min(seconds), "s", f"{text}: least wall time")
        yield f"view.{ending}.size", Figure(out.stat().st_size / 1e6, "MB", text)


def _write(folder: Path) -> None:
    """Write a drive: three scans in turn, a grid that moves on by a voxel per frame."""
    spec = GridSpec.published()
    scans, labels = street_frame(3, distinct=3), street(spec).labels
    with FolderSink(folder) as sink, sink.sequence(_PATH) as writer:
        writer.write_document("evaluation/params.json", to_json(spec.to_params()))
        writer.write_document(
            layout.POSES, layout.encode_poses(np.tile(np.eye(4), (_FRAMES, 1, 1)))
        )
        for frame in range(_FRAMES):
            scan = scans[frame % len(scans)]
            writer.write(
                "points",
                frame,
                np.column_stack([scan.points, np.zeros(len(scan.points), np.float32)]),
            )
            writer.write("labels", frame, scan.labels.astype(np.uint32))
            writer.write(
                "evaluation/labels", frame, np.roll(labels, frame, axis=0).astype(np.uint32)
            )
            writer.write("evaluation/counts", frame, np.ones(spec.size, np.float32))
