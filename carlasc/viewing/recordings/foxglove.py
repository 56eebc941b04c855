"""A recording for Foxglove (.mcap): one topic for each kind of content, in Foxglove's own schemas.

Topics, all in right-handed axes with z up; times are seconds since the first frame:

    /tf                      FrameTransforms: `ego`, the sensor, in `world`, the frame of the first
                             scan
    /points                  PointCloud: colours, class ids, and numbers of actors if they exist
    /grid                    VoxelGrid, or SceneUpdate with meshes for a cylindrical grid; with a
                             ground truth /prediction, /truth and /errors; /actors: its voxels by
                             actor
    /flow, /boxes, /tracks   SceneUpdate: arrows, boxes, the tracks of the actors
    /path                    SceneUpdate: the trajectory of the vehicle in the whole recording
    /picture                 CompressedImage: the bird's-eye camera picture
    /cameras/NAME/image, /cameras/NAME/calibration CompressedImage and CameraCalibration of each
                             camera, whose frame is NAME
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyFloatArray, FloatArray, RecordArray
from carlasc.core.boxes import Boxes
from carlasc.core.cameras import CameraModel
from carlasc.core.geometry import Transform, quaternions_of
from carlasc.core.grids import Grid
from carlasc.core.scans import Scan
from carlasc.errors import import_extra
from carlasc.storage.packed.output import DeferredErrorFile
from carlasc.viewing import colors as palette
from carlasc.viewing.recordings.content import RecordedFrame, class_surfaces
from carlasc.viewing.scene import GridPanel, SceneReader

WORLD = "world"
EGO = "ego"

_RGB = ("red", "green", "blue")
_CELL = [*((name, "u1") for name in (*_RGB, "alpha")), ("label", "<u2")]
_POINT = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), *_CELL]
_BOX_ALPHA = 0.35
_LINE_M = 0.15
_ARROW_M = 0.24


class FoxgloveWriter:
    """Writes an `.mcap` file.

    Raises:
        DependencyError: the Foxglove SDK is not installed.
    """

    def __init__(self, path: Path, reader: SceneReader) -> None:
        foxglove: Any = import_extra("foxglove", "foxglove")
        self._messages: Any = import_extra("foxglove.messages", "foxglove")
        self._types: Any = import_extra("foxglove.channels", "foxglove")
        self._reader = reader
        self._channels = dict[str, Any]()
        self._context = foxglove.Context()
        self._output = DeferredErrorFile(path, None)
        self._writer = foxglove.open_mcap(self._output, context=self._context)
        self._writer.write_metadata(
            "carlasc", {"sequence": reader.name, "classes": reader.table.name}
        )
        tables = {
            panel.colors.table.name: panel.colors
            for panel in reader.panels
            if panel.colors is not reader.colors
        }
        for name, colors in {"classes": reader.colors, **tables}.items():
            names = {str(entry.order): entry.name for entry in colors.entries(colors.table.names)}
            self._writer.write_metadata(name, names)
        self._path: FloatArray | None = reader.path_of_ego()

    def write(self, frame: RecordedFrame) -> None:
        """Append a frame."""
        m = self._messages
        nanoseconds = round(frame.time_s * 1e9)
        stamp = m.Timestamp(*divmod(nanoseconds, 10**9))
        ego = {"timestamp": stamp, "frame_id": EGO}

        def log(topic: str, kind: str, **content: Any) -> None:
            if topic not in self._channels:
                self._channels[topic] = getattr(self._types, f"{kind}Channel")(
                    topic, context=self._context
                )
            self._channels[topic].log(getattr(m, kind)(**content), log_time=nanoseconds)

        def log_scene(topic: str, entities: list[Any]) -> None:
            deletion = m.SceneEntityDeletion(timestamp=stamp, type=m.SceneEntityDeletionType.All)
            log(topic, "SceneUpdate", deletions=[deletion], entities=entities)

        def entity(name: str, frame_id: str, **content: Any) -> Any:
            return m.SceneEntity(timestamp=stamp, frame_id=frame_id, id=name, **content)

        pose = np.eye(4) if frame.pose is None else frame.pose
        places = {(WORLD, EGO): pose} | {
            (EGO, photo.camera.name): photo.ego_T_camera for photo in frame.photos
        }
        transforms = [
            m.FrameTransform(
                timestamp=stamp,
                parent_frame_id=parent,
                child_frame_id=child,
                translation=self._vector(place[:3, 3]),
                rotation=self._quaternion(place),
            )
            for (parent, child), place in places.items()
        ]
        log("/tf", "FrameTransforms", transforms=transforms)
        for panel, grid in zip(self._reader.panels, frame.grids, strict=True):
            if grid.spec.coordinates == "cylindrical":
                log_scene(
                    f"/{panel.name}",
                    [entity(n, EGO, triangles=[t]) for n, t in self._wedges(panel, grid)],
                )
            else:
                log(f"/{panel.name}", "VoxelGrid", **ego, **self._voxels(panel, grid))
        if frame.scan is not None:
            log("/points", "PointCloud", **ego, **self._points(frame.scan))
        if self._reader.has_motion:
            arrows = [
                self._arrow(tail, vector)
                for tail, vector in zip(frame.tails, frame.vectors, strict=True)
            ]
            log_scene("/flow", [entity("flow", EGO, arrows=arrows)])
        if self._reader.has("boxes"):
            log_scene(
                "/boxes", [] if frame.boxes is None else list(self._boxes(frame.boxes, entity))
            )
        if frame.pose is not None:
            lines = [self._line(trail.points, self._color(trail.label)) for trail in frame.trails]
            log_scene("/tracks", [entity("tracks", WORLD, lines=lines)])
        if self._path is not None and len(self._path) > 1:
            line = self._line(self._path, self._rgba(palette.PATH))
            log_scene("/path", [entity("path", WORLD, lines=[line])])
        self._path = None  # once
        if frame.picture is not None:
            log("/picture", "CompressedImage", **ego, data=frame.picture, format="jpeg")
        for photo in frame.photos:
            topic = f"/cameras/{photo.camera.name}"
            own = ego | {"frame_id": photo.camera.name}
            log(f"{topic}/image", "CompressedImage", data=photo.data, format=photo.kind, **own)
            log(f"{topic}/calibration", "CameraCalibration", **own, **_calibration(photo.camera))
        self._output.check()

    def close(self) -> None:
        """Finish the file.

        Raises:
            OSError: it could not be written.
        """
        self._writer.close()
        self._output.close()
        self._output.check()

    def _voxels(self, panel: GridPanel, grid: Grid) -> dict[str, Any]:
        """Return a grid as the content of a VoxelGrid: colours, transparent where free, and class
        ids, in the order z, y, x.
        """
        columns, rows, slices = grid.spec.size
        labels = grid.labels.transpose(2, 1, 0)
        cells = np.zeros((slices, rows, columns), _CELL)
        cells["alpha"] = np.where(labels, 255, 0)
        cells["label"] = labels
        for name, values in zip(_RGB, panel.colors.by_id.T, strict=True):
            cells[name] = np.where(labels, values[labels], 0)
        corner = np.eye(4)
        corner[:3, 3] = grid.spec.lower
        return {
            "pose": self._pose(corner),
            "row_count": rows,
            "column_count": columns,
            "cell_size": self._vector(grid.spec.voxel_size),
            "cell_stride": cells.itemsize,
            "row_stride": cells.itemsize * columns,
            "slice_stride": cells.itemsize * columns * rows,
            "fields": self._fields_of(cells),
            "data": cells.tobytes(),
        }

    def _points(self, scan: Scan) -> dict[str, Any]:
        """Return a scan as the content of a PointCloud."""
        numbered = scan.instances is not None
        points = np.zeros(len(scan), [*_POINT, ("instance", "<u4")] if numbered else _POINT)
        if numbered:
            points["instance"] = scan.instances
        points["alpha"] = 255
        points["label"] = 0 if scan.labels is None else scan.labels
        columns = *scan.points.T, *self._reader.colors.of_points(scan).T
        for name, values in zip((*"xyz", *_RGB), columns, strict=True):
            points[name] = values
        return {
            "pose": self._pose(np.eye(4)),
            "point_stride": points.itemsize,
            "fields": self._fields_of(points),
            "data": points.tobytes(),
        }

    def _wedges(self, panel: GridPanel, grid: Grid) -> Iterator[tuple[str, Any]]:
        """Yield each class of a cylindrical grid with the faces of its voxels."""
        m = self._messages
        for label, surface in class_surfaces(grid):
            color = self._rgba(panel.colors.by_id[label].tolist())
            name = panel.colors.table.names.get(label, f"class {label}")
            yield (
                name,
                m.TriangleListPrimitive(
                    pose=self._pose(np.eye(4)),
                    points=self._points3(surface.corners),
                    color=color,
                    indices=surface.indices.reshape(-1).tolist(),
                ),
            )

    def _boxes(self, boxes: Boxes, entity: Callable[..., Any]) -> Iterator[Any]:
        """Yield each box as an entity that is named by its track."""
        m = self._messages
        for row, pose in enumerate(boxes.sensor_T_box):
            label = int(boxes.labels[row])
            track = str(boxes.tracks[row])
            name = self._reader.table.names.get(label, f"class {label}")
            cube = m.CubePrimitive(
                pose=self._pose(pose),
                size=self._vector(boxes.sizes[row]),
                color=self._color(label, _BOX_ALPHA),
            )
            metadata = [
                m.KeyValuePair(key="class", value=name),
                m.KeyValuePair(key="track", value=track),
            ]
            yield entity(track, EGO, cubes=[cube], metadata=metadata)

    def _arrow(self, tail: FloatArray, vector: FloatArray) -> Any:
        """Return an arrow: in Foxglove it points along the x axis of its pose."""
        length = float(np.linalg.norm(vector))
        ahead = vector / length
        side = np.cross([0.0, 0.0, 1.0] if abs(ahead[2]) < 0.9 else [0.0, 1.0, 0.0], ahead)
        side /= np.linalg.norm(side)
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([ahead, side, np.cross(ahead, side)])
        pose[:3, 3] = tail
        head = min(4.5 * _ARROW_M, 0.5 * length)
        return self._messages.ArrowPrimitive(
            pose=self._pose(pose),
            shaft_length=length - head,
            shaft_diameter=_ARROW_M,
            head_length=head,
            head_diameter=3 * _ARROW_M,
            color=self._rgba(palette.ARROW),
        )

    def _line(self, points: FloatArray, color: Any) -> Any:
        m = self._messages
        return m.LinePrimitive(
            type=m.LinePrimitiveLineType.LineStrip,
            pose=self._pose(np.eye(4)),
            thickness=_LINE_M,
            points=self._points3(points),
            color=color,
        )

    def _points3(self, points: AnyFloatArray) -> list[Any]:
        return [self._messages.Point3(x=x, y=y, z=z) for x, y, z in points.tolist()]

    def _pose(self, dst_T_src: Transform) -> Any:
        return self._messages.Pose(
            position=self._vector(dst_T_src[:3, 3]), orientation=self._quaternion(dst_T_src)
        )

    def _quaternion(self, dst_T_src: Transform) -> Any:
        w, x, y, z = quaternions_of(dst_T_src[None, :3, :3])[0].tolist()
        return self._messages.Quaternion(x=x, y=y, z=z, w=w)

    def _vector(self, values: AnyFloatArray) -> Any:
        x, y, z = (float(value) for value in values)
        return self._messages.Vector3(x=x, y=y, z=z)

    def _color(self, label: int, alpha: float = 1.0) -> Any:
        return self._rgba(self._reader.colors.by_id[label].tolist(), alpha)

    def _rgba(self, color: Sequence[int], alpha: float = 1.0) -> Any:
        red, green, blue = (value / 255 for value in color)
        return self._messages.Color(r=red, g=green, b=blue, a=alpha)

    def _fields_of(self, elements: RecordArray) -> list[Any]:
        """Return the names, places and types of the fields of packed elements."""
        types = self._messages.PackedElementFieldNumericType
        return [
            self._messages.PackedElementField(
                name=name, offset=offset, type=getattr(types, kind.name.capitalize())
            )
            for name, (kind, offset, *_) in (elements.dtype.fields or {}).items()
        ]


def _calibration(camera: CameraModel) -> dict[str, Any]:
    """Return a camera as the content of a CameraCalibration."""
    models = {"pinhole": "", "fisheye": "kannala_brandt"}
    distorted = "rational_polynomial" if len(camera.distortion) > 5 else "plumb_bob"
    given = (
        (*camera.distortion, 0.0)
        if len(camera.distortion) == 4 and camera.model != "fisheye"
        else camera.distortion
    )
    return {
        "width": camera.width,
        "height": camera.height,
        "distortion_model": models.get(camera.model, distorted),
        "D": list(given),
        "K": camera.matrix.reshape(-1).tolist(),
        "R": np.eye(3).reshape(-1).tolist(),
        "P": np.column_stack([camera.matrix, np.zeros(3)]).reshape(-1).tolist(),
    }
