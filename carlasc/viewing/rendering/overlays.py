"""A grid over the photograph of a camera: for each pixel the first occupied voxel on its ray, half
transparent.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from carlasc.core.arrays import Uint8Array
from carlasc.core.cameras import CameraModel
from carlasc.core.geometry import rotate_vectors
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.metrics import cast_rays
from carlasc.storage.camera_files import camera_named, read_image, scan_T_camera
from carlasc.storage.files import check_target
from carlasc.viewing.rendering.encoding import (
    FILMS,
    STILLS,
    check_single,
    encodable_size,
    is_film,
    write_pictures,
)
from carlasc.viewing.rendering.render import RenderResult
from carlasc.viewing.scene import Scene, SceneReader, SceneSource, as_scene

_EDGE = 0.75  # brightness of a voxel at its edges in the picture


def overlay(
    source: Scene | SceneSource,
    camera: str,
    out: Path,
    *,
    opacity: float = 0.5,
    fps: float | None = None,
    overwrite: bool = False,
) -> RenderResult:
    """Draw the visible voxels of a grid over the images of a camera.

    Args:
        source: a `Scene`, or anything that a scene's `source` may be. Without `frames`, a picture
            shows the first one, a film all.
        camera: name of the camera.
        out: file name that ends in .png, .gif, .mp4 or .webp.
        opacity: 0 shows the photograph only, 1 the voxels only.
        fps: pictures per second of a film; None takes 10.
        overwrite: whether an existing file is replaced.

    Raises:
        ArgumentError: an argument has a wrong value, or the grid is cylindrical.
        MissingDataError: the camera, its images or the grid do not exist.
        FormatError: an image or the calibration is damaged, or the two do not match.
        ConflictError: `out` exists.
    """
    started = time.monotonic()
    scene = as_scene(source)
    if not 0 <= opacity <= 1:
        raise ArgumentError("opacity", expected="0 to 1", found=opacity)
    check_target(out, STILLS + FILMS, overwrite)
    reader = scene.open("grid")
    model = camera_named(reader.data.sequence, camera)
    frames = reader.frames if is_film(out) or scene.frames is not None else reader.frames[:1]
    check_single(out, frames)
    width, height = encodable_size(out, (model.width, model.height))
    write_pictures(
        out,
        _pictures(reader, model, frames, opacity, (width, height)),
        10.0 if fps is None else fps,
    )
    took = time.monotonic() - started
    path = reader.path
    table = reader.table.name
    size = (width, height)
    use = reader.table_use
    return RenderResult(
        out, path, ("grid",), frames, len(frames), size, table, took, reader.notes, None, use
    )


def _pictures(
    reader: SceneReader,
    camera: CameraModel,
    frames: tuple[int, ...],
    opacity: float,
    size: tuple[int, int],
) -> Iterator[Uint8Array]:
    rows, columns = np.mgrid[: camera.height, : camera.width].reshape(2, -1)
    looks = camera.unproject(np.stack([columns, rows], axis=1))
    looks_somewhere = np.isfinite(looks).all(axis=1)
    for frame in frames:
        place = scan_T_camera(reader.data.sequence, camera, frame)
        grid = reader.data.read_grid(frame)
        if place is None:
            where = f"{reader.path}: frame {frame}"
            advice = "choose other frames with `frames`"
            raise MissingDataError(
                where, expected=f"an image of {camera.name}", found="none", advice=advice
            )
        picture = read_image(reader.data.sequence, camera, frame)
        labels = grid.labels.reshape(-1)
        first, _ = cast_rays(
            grid.labels[None],
            grid.spec,
            place[:3, 3],
            rotate_vectors(place, looks[looks_somewhere]),
        )
        voxels = np.full(len(looks), -1, np.int64)
        voxels[looks_somewhere] = first[0]
        voxels[(voxels >= 0) & (labels[voxels] == 0)] = -1
        shaped = voxels.reshape(picture.shape[:2])
        colors = reader.colors.by_id[labels[shaped]].astype(np.float64)
        edge = np.zeros(shaped.shape, np.bool_)
        edge[:, 1:] |= shaped[:, 1:] != shaped[:, :-1]
        edge[1:] |= shaped[1:] != shaped[:-1]
        colors[edge] *= _EDGE
        drawn = np.where(
            (shaped >= 0)[..., None], picture * (1 - opacity) + colors * opacity, picture
        ).astype(np.uint8)
        yield np.pad(
            drawn, ((0, size[1] - camera.height), (0, size[0] - camera.width), (0, 0)), "edge"
        )
