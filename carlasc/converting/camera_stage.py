"""The cameras of a recording in the layout: cameras.json, and their images."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from carlasc.converting.layout_options import AxesAndClasses, Images
from carlasc.converting.plans import RecordingPlan
from carlasc.core.cameras import CameraModel
from carlasc.core.geometry import invert
from carlasc.storage import layout
from carlasc.storage.camera_files import cameras_to_json

_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def write_cameras(plan: RecordingPlan, target: AxesAndClasses, images: Images) -> list[str]:
    """Write the cameras of a recording, and return notes.

    Args:
        plan: the recording and its output.
        target: the axes of the output.
        images: "copy", "link" or "none".

    Raises:
        FormatError: a calibration is damaged.
        StorageError: the output cannot be written.
    """
    cameras = plan.recording.cameras()
    if not cameras:
        return []
    written = [_in_layout(camera, plan, target, images) for camera in cameras]
    content = cameras_to_json(written)
    if plan.writer.read_document(layout.CAMERAS) != content:
        plan.writer.write_document(layout.CAMERAS, content)
    if images == "link" and not any(camera.images for camera in cameras):
        return [
            "no camera has images in separate files to link to: --images copy writes the images"
        ]
    return _copy_images(plan, cameras) if images == "copy" else []


def _in_layout(
    camera: CameraModel, plan: RecordingPlan, target: AxesAndClasses, images: Images
) -> CameraModel:
    scan_T_camera = invert(plan.rig.vehicle_T_scan) @ camera.sensor_T_camera
    place = _MIRROR @ scan_T_camera if target.mirrored else scan_T_camera
    times = None if camera.times is None else camera.times - plan.times[0]
    return camera.replaced(
        sensor_T_camera=place, times=times, images=camera.images if images == "link" else None
    )


def _copy_images(plan: RecordingPlan, cameras: Sequence[CameraModel]) -> list[str]:
    """Copy the images of all frames, those that are stored together at once; return the number of
    missing images.
    """
    missing, blocks = 0, dict[int, list[int]]()
    for handle in plan.recording.frames:
        blocks.setdefault(handle.number // plan.writer.block, []).append(handle.number)
    for numbers in blocks.values():
        found: dict[int, dict[str, np.ndarray]] = {}
        for number in numbers:
            for camera in cameras:
                if any(
                    plan.writer.has(f"images.{camera.name}.{suffix}", number)
                    for suffix in layout.IMAGE_SUFFIXES
                ):
                    continue
                if (image := plan.recording.image(camera, number)) is None:
                    missing += 1
                    continue
                found.setdefault(number, {})[f"images.{camera.name}.{image[0]}"] = np.frombuffer(
                    image[1], np.uint8
                )
        if found:
            plan.writer.write_frames(found)
    return (
        [f"{missing} images of cameras do not exist, or are neither .jpg nor .png"]
        if missing
        else []
    )
