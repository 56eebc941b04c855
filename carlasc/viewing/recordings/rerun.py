"""A recording for the Rerun viewer (.rrd): entities, a blueprint, and two timelines, `frame` and
`time`.

Entities, all in right-handed axes with z up:

    world                        class names and colours
    world/path                   the trajectory of the vehicle in the whole recording
    world/tracks                 the tracks of the actors up to the frame
    world/ego                    the pose of the sensor; everything below is in its frame
    world/ego/vehicle            a plain car
    world/ego/points, flow, boxes
    world/ego/instances          the points of actors, in a colour for each actor
    world/ego/cameras/NAME       the image of a camera, in its frustum
    world/ego/PANEL/CLASS        the voxels of each class: `grid`, or `prediction`, `truth` and
                                 `errors`; `actors`: by actor
    picture                      the bird's-eye camera picture
"""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from carlasc.core.boxes import Boxes
from carlasc.core.geometry import quaternions_of
from carlasc.core.grids import Grid
from carlasc.errors import import_extra
from carlasc.storage.layout import FRAME_PERIOD_S
from carlasc.viewing import colors as palette
from carlasc.viewing.photos import Photo
from carlasc.viewing.recordings.content import RecordedFrame, Triangles, class_cells, class_surfaces
from carlasc.viewing.rendering.drawings import ego_vehicle
from carlasc.viewing.scene import GridPanel, SceneReader

_BLOCK = 1 << 16  # bytes
_POINT_RADIUS_M = 0.1
_BATCH = 20  # frames that are written together: each batch costs a kilobyte for each entity
_TRAIL_RADIUS_M = 0.08
_IMAGES = 2  # cameras whose images have views of their own
_FRUSTUM_M = 2.0  # from a camera to where its image is drawn
_BACKGROUND = (246, 247, 249)
# behind and above: a published grid fits in a square view
_EYE = (-49.0, 0.0, 35.0)
_TARGET = (-3.0, 0.0, -3.0)


class RerunWriter:
    """Writes a `.rrd` file.

    Raises:
        DependencyError: the Rerun SDK is not installed.
    """

    def __init__(self, path: Path, reader: SceneReader) -> None:
        self._rr: Any = import_extra("rerun", "rerun")
        self._reader = reader
        self._drawn: dict[str, set[int]] = {panel.name: set() for panel in reader.panels}
        # batches end by frames, not by time
        batches = self._rr.ChunkBatcherConfig(flush_tick=timedelta(days=1))
        self._waiting = 0
        self._recording = self._rr.RecordingStream(
            "carlasc", recording_id=uuid4(), batcher_config=batches
        )
        self._recording.set_log_time_enabled(False)
        self._recording.set_log_tick_enabled(False)
        self._stream = self._recording.binary_stream()
        self._file = path.open("wb")
        self._recording.send_blueprint(self._blueprint(), make_active=False)
        self._recording.send_recording_name(reader.name)
        self._write_static()

    def write(self, frame: RecordedFrame) -> None:
        """Append a frame."""
        rr = self._rr
        log = self._recording.log
        self._recording.set_time("frame", sequence=frame.number)
        self._recording.set_time("time", duration=frame.time_s)
        for panel, grid in zip(self._reader.panels, frame.grids, strict=True):
            self._write_grid(panel, grid)
        if frame.scan is not None:
            labels = (
                np.zeros(len(frame.scan), np.uint16)
                if frame.scan.labels is None
                else frame.scan.labels
            )
            log(
                "world/ego/points",
                rr.Points3D(frame.scan.points, class_ids=labels, radii=[_POINT_RADIUS_M]),
            )
            if (numbers := frame.scan.instances) is not None:
                colors = palette.ACTORS.palette[palette.actor_ids(numbers[numbers > 0])]
                points = frame.scan.points[numbers > 0]
                log(
                    "world/ego/instances",
                    rr.Points3D(points, colors=colors, radii=[_POINT_RADIUS_M]),
                )
        if self._reader.has_motion:
            log(
                "world/ego/flow",
                rr.Arrows3D(origins=frame.tails, vectors=frame.vectors, colors=[palette.ARROW]),
            )
        if self._reader.has("boxes"):
            self._write_boxes(frame.boxes)
        if frame.pose is not None:
            rotation = np.roll(quaternions_of(frame.pose[None, :3, :3])[0], -1)  # x, y, z, w
            log("world/ego", rr.Transform3D(translation=frame.pose[:3, 3], quaternion=rotation))
            ways = [trail.points for trail in frame.trails]
            classes = [trail.label for trail in frame.trails]
            log(
                "world/tracks",
                rr.LineStrips3D(
                    ways, class_ids=classes, radii=[_TRAIL_RADIUS_M], show_labels=False
                ),
            )
        if frame.picture is not None:
            log("picture", rr.EncodedImage(contents=frame.picture, media_type="image/jpeg"))
        for photo in frame.photos:
            self._write_photo(photo)
        self._waiting += 1
        if self._waiting == _BATCH:
            self._flush()

    def close(self) -> None:
        """Finish the file.

        Raises:
            OSError: it could not be written.
        """
        with self._file:
            self._flush()
            self._recording.disconnect()
            self._flush()

    def _flush(self) -> None:
        self._file.write(self._stream.read() or b"")
        self._waiting = 0

    def _write_static(self) -> None:
        """Write the entities that are the same in all frames."""
        rr = self._rr
        reader = self._reader

        def log(entity: str, *content: Any) -> None:
            self._recording.log(entity, *content, static=True)

        entries = reader.colors.entries(reader.table.names)
        classes = [(0, "unlabelled", palette.UNLABELLED)]
        classes += [(entry.order, entry.name, entry.color) for entry in entries]
        log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, rr.AnnotationContext(classes))
        if reader.shows_ego:
            car = ego_vehicle()
            corners, faces = car.triangles()
            surface = Triangles(corners, np.repeat(car.normals, 4, axis=0), faces.astype(np.uint32))
            paint = np.repeat(car.colors, 4, axis=0)
            log("world/ego/vehicle", self._mesh(surface, vertex_colors=paint))
        path = reader.path_of_ego()
        if len(path) > 1:
            log(
                "world/path",
                rr.LineStrips3D([path], colors=[palette.PATH], radii=[_TRAIL_RADIUS_M]),
            )

    def _write_grid(self, panel: GridPanel, grid: Grid) -> None:
        """Write the voxels of each class, and clear classes that only the previous frame had."""
        rr = self._rr
        colors = panel.colors.by_id
        if grid.spec.coordinates == "cylindrical":
            drawn = {
                label: self._mesh(surface, albedo_factor=colors[label])
                for label, surface in class_surfaces(grid)
            }
        else:
            drawn = {
                label: rr.VoxelGridMap(
                    cells, grid.spec.voxel_size, colors=[colors[label]], translation=grid.spec.lower
                )
                for label, cells in class_cells(grid)
            }
        drawn |= {
            label: rr.Clear(recursive=False) for label in self._drawn[panel.name] - set(drawn)
        }
        for label, content in drawn.items():
            part = rr.escape_entity_path_part(panel.colors.table.names.get(label, f"class {label}"))
            self._recording.log(f"world/ego/{panel.name}/{part}", content)
        self._drawn[panel.name] = set(drawn)

    def _write_boxes(self, boxes: Boxes | None) -> None:
        rr = self._rr
        if boxes is None:
            self._recording.log("world/ego/boxes", rr.Clear(recursive=False))
            return
        names = self._reader.table.names
        content = rr.Boxes3D(
            centers=boxes.centers,
            sizes=boxes.sizes,
            quaternions=np.roll(boxes.quaternions, -1, axis=1),  # x, y, z, w
            class_ids=boxes.labels,
            labels=[
                f"{names.get(label, f'class {label}')} {track}"
                for label, track in zip(boxes.labels.tolist(), boxes.tracks.tolist(), strict=True)
            ],
            show_labels=False,
        )
        self._recording.log("world/ego/boxes", content)

    def _write_photo(self, photo: Photo) -> None:
        """Write the image and the pose of a camera; distortion is left out, because Rerun has no
        model of it.
        """
        rr = self._rr
        camera = photo.camera
        place = photo.ego_T_camera
        name = f"world/ego/cameras/{rr.escape_entity_path_part(camera.name)}"
        lens = rr.Pinhole(
            image_from_camera=camera.matrix,
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=_FRUSTUM_M,
        )
        image = rr.EncodedImage(contents=photo.data, media_type=f"image/{photo.kind}")
        self._recording.log(
            name, rr.Transform3D(translation=place[:3, 3], mat3x3=place[:3, :3]), lens, image
        )

    def _mesh(self, surface: Triangles, **colors: Any) -> Any:
        return self._rr.Mesh3D(
            vertex_positions=surface.corners,
            vertex_normals=surface.normals,
            triangle_indices=surface.indices,
            **colors,
        )

    def _blueprint(self) -> Any:
        """Return the views at the start: the grids side by side, the points and the picture beside
        or below them.
        """
        blueprint = self._rr.blueprint
        reader = self._reader
        names = [panel.name for panel in reader.panels]
        grids = [
            self._view(
                panel.title, ["points", "instances", *(f"{n}/**" for n in names if n != panel.name)]
            )
            for panel in reader.panels
        ]
        clouds = [name for name in ("points", "instances") if reader.has(name)]
        others = [
            self._view(name, [*(f"{n}/**" for n in names), *(n for n in clouds if n != name)])
            for name in clouds
        ]
        if reader.has("bev"):
            others.append(blueprint.Spatial2DView(origin="/picture", name="picture"))
        for photo in reader.read_photos(reader.frames[0])[:_IMAGES]:
            origin = f"/world/ego/cameras/{self._rr.escape_entity_path_part(photo.camera.name)}"
            others.append(blueprint.Spatial2DView(origin=origin, name=photo.camera.name))
        if len(grids) == 1 and others:
            layout = blueprint.Horizontal(*grids, blueprint.Vertical(*others), column_shares=[3, 2])
        elif grids and others:
            rows = blueprint.Horizontal(*grids), blueprint.Horizontal(*others)
            layout = blueprint.Vertical(*rows, row_shares=[3, 2])
        else:
            layout = blueprint.Horizontal(*grids, *others)
        return blueprint.Blueprint(
            layout,
            blueprint.BlueprintPanel(state="collapsed"),
            blueprint.SelectionPanel(state="collapsed"),
            blueprint.TimePanel(
                state="collapsed", timeline="frame", play_state="paused", fps=1 / FRAME_PERIOD_S
            ),
        )

    def _view(self, name: str, hidden: list[str]) -> Any:
        """Return a view that moves with the vehicle, without some entities below `world/ego`."""
        blueprint = self._rr.blueprint
        return blueprint.Spatial3DView(
            name=name,
            origin="/world/ego",
            contents=["+ /world/**", *(f"- /world/ego/{entity}" for entity in hidden)],
            background=_BACKGROUND,
            line_grid=False,
            eye_controls=blueprint.EyeControls3D(
                position=_EYE, look_target=_TARGET, eye_up=(0, 0, 1)
            ),
        )
