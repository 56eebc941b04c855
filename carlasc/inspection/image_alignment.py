"""The alignment of images with LiDAR scans: a shift in pixels and a delay in seconds, from edges of
depth and edges of the image.

Where the depth of a scan jumps between neighbouring points, an object ends, and the image has an
edge. At the right shift of the image, the contrast at these points is highest. The same holds for
the right time if the vehicle moves, because an image of another time was taken at another place.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from carlasc.core.arrays import AnyArray, Float32Array, FloatArray
from carlasc.core.cameras import CameraModel
from carlasc.core.geometry import invert, slerp, transform_points
from carlasc.errors import CarlascError
from carlasc.inspection.findings import Finding
from carlasc.storage import layout
from carlasc.storage.camera_files import cameras_of, has_image, read_image, scan_T_camera
from carlasc.storage.protocol import Sequence

UNDETERMINED = "undetermined"

# Chosen on simulated drives: see docs/howto/cameras.md.
_FRAMES = 9  # that are looked at
_BAND_PX = 4.0  # height of the rows of an image in which points are neighbours
_NEAR_PX = 14.0  # between points that are neighbours
# by which the depth jumps: share, and metres
_JUMP = 0.25
_JUMP_M = 2.0
_SHIFTS_PX = np.arange(-20, 21)
_TIMES_S = np.arange(-0.15, 0.1501, 0.01)
_LEAST = 25.0  # contrast in sum
_CLEAR = 3.0  # standard deviations by which the best shift is better than others
_ALONE = 1.5  # times as high as any other, from the mean: fences fit in several places
# less motion in these times says nothing of them
_MOVED_M = 0.5
_TURNED = 0.02
_WRONG_PX = 4.0
_WRONG_S = 0.05


@dataclass(frozen=True)
class ImageAgreement:
    """The alignment of the images of a camera with the scans.

    Attributes:
        camera: its name.
        shift_px: columns by which the images are too far to the right; None if it is undetermined.
        late_s: delay of the images against their times, seconds; None if it is undetermined.
    """

    camera: str
    shift_px: float | None
    late_s: float | None

    @property
    def is_wrong(self) -> bool:
        """Whether the calibration or the times are probably wrong."""
        return abs(self.shift_px or 0) > _WRONG_PX or abs(self.late_s or 0) > _WRONG_S

    def __str__(self) -> str:
        shift = (
            UNDETERMINED if self.shift_px is None else f"{self.shift_px:+.1f} pixels to the right"
        )
        late = UNDETERMINED if self.late_s is None else f"{self.late_s:+.2f} s late"
        return f"{shift}, {late}"


def compare_images(sequence: Sequence) -> list[ImageAgreement]:
    """Return the alignment of each camera with images. Files that cannot be read are left out."""
    try:
        cameras = cameras_of(sequence)
    except CarlascError:
        return []  # which is reported elsewhere
    compared = (_compare(sequence, camera) for camera in cameras.values())
    return [agreement for agreement in compared if agreement is not None]


def judge_images(sequence: Sequence, images: list[ImageAgreement]) -> Iterator[Finding]:
    """Yield a finding for each camera whose calibration or times are probably wrong."""
    for agreement in images:
        if agreement.is_wrong:
            yield Finding(
                "warning",
                "images-on-scans",
                f"{sequence.location}/{layout.CAMERAS}",
                "images with edges where the scans have them",
                f"{agreement.camera}: {agreement}",
                "check the calibration and the times of the camera, and draw a grid over it with "
                "`carlasc render --camera`",
            )


def _compare(sequence: Sequence, camera: CameraModel) -> ImageAgreement | None:
    frames = [
        frame for frame in sequence.frames("points").tolist() if has_image(sequence, camera, frame)
    ]
    if not frames:
        return None
    views = []
    for frame in frames[:: max(1, len(frames) // _FRAMES)]:
        try:
            view = _View.read(sequence, camera, frame)
        except CarlascError:
            continue  # which is reported elsewhere
        views += [] if view is None else [view]
    # The contrast by view, time and shift. A maximum counts only if all thirds of the views have
    # it.
    contrasts = [view.contrast(camera) for view in views]
    thirds = [np.sum(contrasts[i::3], axis=0) for i in range(3) if contrasts[i::3]]
    if len(thirds) < 3 or min(third.max() for third in thirds) < _LEAST:
        return ImageAgreement(camera.name, None, None)
    late, shift = np.unravel_index(int(np.sum(thirds, axis=0).argmax()), thirds[0].shape)
    shift_px = _clearest(_SHIFTS_PX, [third[late] for third in thirds], 2)
    tells = shift_px is not None and any(view.moves for view in views)
    late_s = _clearest(_TIMES_S, [third[:, shift] for third in thirds], 0.015) if tells else None
    return ImageAgreement(camera.name, shift_px, late_s)


@dataclass(frozen=True)
class _View:
    """An image, and the points of its scan.

    Attributes:
        edges: (E, 3) points where the depth of the scan jumps, metres, sensor frame.
        contrast_of: (H, W) change of brightness from column to column, from 0 to 1.
        places: (T, 4, 4) pose of the camera at each of `_TIMES_S` after the time of the image, in
            the frame of the scan.
        moves: whether the vehicle moved in this time.
    """

    edges: FloatArray
    contrast_of: Float32Array
    places: FloatArray
    moves: bool

    @classmethod
    def read(cls, sequence: Sequence, camera: CameraModel, frame: int) -> _View | None:
        """Read a frame; None if the camera took no image.

        Raises:
            CarlascError: a file cannot be read.
        """
        place = scan_T_camera(sequence, camera, frame)
        if place is None:
            return None
        bright = read_image(sequence, camera, frame).astype(np.float32).mean(axis=2)
        contrast = np.abs(np.diff(bright, axis=1, append=bright[:, -1:]))
        contrast = np.minimum(contrast / max(float(np.percentile(contrast, 99)), 1.0), 1.0)
        points = sequence.scan(frame, ()).points.astype(np.float64)
        edges = transform_points(
            place, _depth_edges(camera, transform_points(invert(place), points))
        )
        moved = np.tile(np.eye(4), (len(_TIMES_S), 1, 1))
        if {layout.POSES, layout.TIMES} <= set(sequence.documents()) and len(sequence.times) == len(
            sequence.poses
        ) > 1:
            times = sequence.times
            now = sequence.read_time(frame)
            then = (now + _TIMES_S).clip(times[0], times[-1])
            moved = invert(sequence.read_pose(frame)) @ slerp(sequence.poses, times, then)
        apart = np.abs(moved[-1, :3] - moved[0, :3])
        return cls(
            edges,
            contrast,
            moved @ place,
            bool(apart[:, 3].max() > _MOVED_M or apart[:, :3].max() > _TURNED),
        )

    def contrast(self, camera: CameraModel) -> FloatArray:
        """Return (T, S) the summed contrast of the image at the edges of depth, for each time and
        each shift.
        """
        contrast = np.zeros((len(_TIMES_S), len(_SHIFTS_PX)))
        for row, place in enumerate(self.places):
            pixels = camera.project(transform_points(invert(place), self.edges))
            kept = camera.contains(pixels)
            kept[kept] = (pixels[kept, 0] >= _SHIFTS_PX[-1]) & (
                pixels[kept, 0] < camera.width - 1 - _SHIFTS_PX[-1]
            )
            column, line = np.rint(pixels[kept]).astype(np.int64).T
            seen = self.contrast_of[line[:, None], column[:, None] + _SHIFTS_PX]
            contrast[row] = seen.sum(axis=0)
        return contrast


def _depth_edges(camera: CameraModel, points: FloatArray) -> FloatArray:
    """Return (E, 3) points between neighbours in the image whose depths differ much, at the smaller
    depth, in the camera's frame.
    """
    pixels = camera.project(points)
    seen = camera.contains(pixels)
    pixels = pixels[seen]
    depth = points[seen, 2]
    band = pixels[:, 1] // _BAND_PX
    order = np.lexsort((pixels[:, 0], band))
    pixels = pixels[order]
    depth = depth[order]
    band = band[order]
    near = np.minimum(depth[1:], depth[:-1])
    jumps = np.abs(np.diff(depth)) > np.maximum(_JUMP_M, _JUMP * near)
    edge = jumps & (np.diff(band) == 0) & (np.diff(pixels[:, 0]) < _NEAR_PX)
    edge[1:] &= ~jumps[:-1]  # the slats of a fence fit in several places
    edge[:-1] &= ~jumps[1:]
    looks = camera.unproject((pixels[1:] + pixels[:-1])[edge] / 2)
    return looks * (near[edge] / looks[:, 2])[:, None]


def _clearest(values: AnyArray, thirds: list[FloatArray], apart: float) -> float | None:
    """Return the value at which a curve is highest; None if its thirds disagree, or if the maximum
    is not clear.
    """
    total = np.sum(thirds, axis=0)
    best = int(total.argmax())
    elsewhere = np.abs(np.arange(len(values)) - best) > len(values) // 6
    usual = total[elsewhere].mean()
    above = total[best] - usual
    others = total[elsewhere] - usual
    agree = all(abs(values[int(third.argmax())] - values[best]) <= apart for third in thirds)
    is_clear = above > _CLEAR * float(others.std()) and above > _ALONE * float(others.max())
    return float(values[best]) if agree and is_clear and 0 < best < len(values) - 1 else None
