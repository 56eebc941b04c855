"""Sequences of the layout as the files of Occ3D-nuScenes: `gts/{scene}/{token}/labels.npz` and
annotations.json.

The format is that of the benchmark's description and loaders. nuScenes has tokens; here they are
made from the name of the sequence and the number of the frame.
"""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from carlasc import storage
from carlasc.converting import Exported, Files, TargetFrame, resample_to
from carlasc.core.arrays import Uint8Array
from carlasc.core.benchmarks import TO_OCC3D
from carlasc.core.geometry import mirror_poses, quaternions_of, translation
from carlasc.core.grids import GridSpec
from carlasc.storage import layout
from carlasc.storage.files import parse_json
from carlasc_converters.exporters.grid_exporter import GridExporter, sensor_height

_ANNOTATIONS = "annotations.json"
_CAMERAS = "mask_camera is a copy of mask_lidar, because no cameras are known"
_SEEN = "mask_camera is 1 where a camera sees a known voxel"
_SPLITS = {"Train": "train_split", "Val": "val_split", "Test": "test_split"}


def scene_token(name: str) -> str:
    """Return a token of 32 hexadecimal digits for a sequence."""
    return blake2b(name.encode(), digest_size=16).hexdigest()


def frame_token(name: str, frame: int) -> str:
    """Return a token for a frame of a sequence. Tokens of a sequence sort as its frames do."""
    return f"{blake2b(name.encode(), digest_size=13).hexdigest()}{frame:06d}"


@dataclass(eq=False)
class Occ3dExporter(GridExporter):
    """Writes grids as Occ3D-nuScenes has them: 200 x 200 x 16 voxels of 0.4 m around the vehicle,
    with the origin on the ground.
    """

    title = "Occ3D-nuScenes: gts/SCENE/TOKEN/labels.npz and annotations.json"
    target = GridSpec("cartesian", (200, 200, 16), (-40.0, -40.0, -1.0), (40.0, 40.0, 5.4))
    maps = TO_OCC3D
    free = 17
    slug = "occ3d"

    height_m: Annotated[
        float | None,
        "Height of the sensor above the ground, in metres. Default: that in carlasc.json, or 1.8.",
    ] = field(default=None, kw_only=True)

    def frame_of(self, sequence: storage.Sequence) -> TargetFrame:
        """Return the frame of the vehicle, whose origin is on the ground below the sensor."""
        return TargetFrame(sensor_height(sequence, self.height_m)[0])

    def check(self, sequence: storage.Sequence) -> list[str]:
        """Return notes on what resampling loses, and on what is assumed."""
        notes = []
        height, assumed = sensor_height(sequence, self.height_m)
        if assumed:
            notes.append(
                f"the height of the sensor is not known: {height:g} m is assumed; `height_m` sets "
                f"it"
            )
        if layout.POSES not in sequence.documents():
            notes.append(f"{sequence.location} has no poses, and so annotations.json has none")
        if not self.predictions and not self._has_seen(sequence):
            notes.append(f"{_CAMERAS}: do not train or score with camera masks")
        return notes + super().check(sequence)

    def folders(self, names: Sequence[str]) -> dict[str, str]:
        """Return gts/NAME for each name."""
        return {name: f"gts/{name}" for name in names}

    def frame_files(self, sequence: storage.Sequence, frame: int) -> tuple[str, ...]:
        """Return the labels of a frame."""
        return (f"{frame_token(sequence.name, frame)}/labels.npz",)

    def make_frame(self, sequence: storage.Sequence, frame: int) -> Files:
        """Return semantics and masks.

        Without the field `seen`, voxels that the LiDAR observed count as observed by cameras.
        """
        labels, known = self.read(sequence, frame)
        semantics = np.where(known, labels, self.free).astype(np.uint8)
        mask = known.astype(np.uint8)
        seen = self._read_seen(sequence, frame) & mask if self._has_seen(sequence) else mask
        buffer = io.BytesIO()
        np.savez_compressed(buffer, semantics=semantics, mask_lidar=mask, mask_camera=seen)
        return {self.frame_files(sequence, frame)[0]: buffer.getbuffer()}

    def _has_seen(self, sequence: storage.Sequence) -> bool:
        return not self.predictions and f"{self.grid_of(sequence)}/seen" in sequence.fields()

    def _read_seen(self, sequence: storage.Sequence, frame: int) -> Uint8Array:
        """Return (200, 200, 16) 1 for voxels that any camera sees."""
        name = self.grid_of(sequence)
        axes = sequence.metadata.axes
        place = self.frame_of(sequence)
        seen = place.turn((sequence.read(f"{name}/seen", frame) > 0).astype(np.uint8), axes)
        spec = place.spec_in(sequence.grids[name], axes)
        return resample_to(seen, np.ones(spec.size, np.bool_), spec, self.target)[0].astype(
            np.uint8
        )

    def index(self, root: Path, exported: Sequence[Exported]) -> Files:
        """Return annotations.json, with the scenes that are in it already."""
        path = root / _ANNOTATIONS
        annotations = parse_json(path.read_bytes(), str(path)) if path.is_file() else {}
        scenes = annotations.get("scene_infos", {})
        splits = {key: set(annotations.get(key, ())) for key in _SPLITS.values()}
        for part in exported:
            for key, names in splits.items():
                names.discard(part.sequence.name)
                if _SPLITS.get(part.sequence.split or "") == key:
                    names.add(part.sequence.name)
            scenes[part.sequence.name] = self._scene(part)
        lists = {
            key: sorted(names) for key, names in splits.items() if names or key != "test_split"
        }
        copied = not all(self._has_seen(part.sequence) for part in exported)
        about = {"carlasc": _CAMERAS if copied else _SEEN}
        content = lists | about | {"scene_infos": {name: scenes[name] for name in sorted(scenes)}}
        return {_ANNOTATIONS: json.dumps(content, indent=1).encode()}

    def _scene(self, part: Exported) -> dict[str, Any]:
        sequence = part.sequence
        place = self.frame_of(part.sequence)
        tokens = ["", *(frame_token(sequence.name, frame) for frame in part.frames), ""]
        documents = sequence.documents()
        scene = {}
        rows = zip(
            tokens[:-2],
            part.frames,
            tokens[1:-1],
            tokens[2:],
            sequence.times_of(part.frames).tolist(),
            strict=True,
        )
        for before, frame, token, after, seconds in rows:
            scene[token] = {
                "timestamp": str(round(seconds * 1e6)),
                "camera_sensor": {},
                "ego_pose": _pose(sequence, frame, place) if layout.POSES in documents else None,
                "gt_path": f"{part.folder}/{token}/labels.npz",
                "prev": before,
                "next": after,
            }
        return scene


def _pose(sequence: storage.Sequence, frame: int, place: TargetFrame) -> dict[str, list[float]]:
    """Return the right-handed pose of the vehicle in its frame at the first scan."""
    first_T_scan = sequence.read_pose(frame)
    if sequence.metadata.axes == "left":
        first_T_scan = mirror_poses(first_T_scan)
    vehicle_T_scan = translation((0.0, 0.0, place.height_m))
    scan_T_vehicle = translation((0.0, 0.0, -place.height_m))
    pose = vehicle_T_scan @ first_T_scan @ scan_T_vehicle
    return {
        "translation": pose[:3, 3].tolist(),
        "rotation": quaternions_of(pose[None, :3, :3])[0].tolist(),
    }
