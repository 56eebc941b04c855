"""A small scene to export, and readers of the files of other data sets, by the facts of their
formats.
"""

from __future__ import annotations

import json
import pickletools
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import GridSpec
from carlasc.storage import layout
from carlasc.storage.files import to_json
from carlasc.storage.folder import FolderSink

PATH = "Val/Town07_Light/cartesian"
SPEC = GridSpec("cartesian", (80, 64, 30), (-8.0, -6.4, -2.8), (8.0, 6.4, 3.2))
"""0.2 m, from 8 m behind to 8 m before the sensor, in left-handed axes: y to the right."""
CAR, ROAD, PEDESTRIAN, SIGN = 10, 7, 4, 12
THINGS = {(5.1, 3.1, -1.1): CAR, (-4.9, -2.1, -0.5): PEDESTRIAN, (2.3, -5.9, 0.7): SIGN}
"""Blocks of 0.4 m: x forward, y to the right, z up from the sensor, metres -> CarlaSC's class."""


def scene_grid(
    spec: GridSpec = SPEC,
    shift_m: float = 0.0,
    things: dict[tuple[float, float, float], int] | None = None,
) -> tuple[NDArray[np.uint32], NDArray[np.float32]]:
    """Return labels and counts: a road at z = -1.8, things, and unknown space behind the sensor
    beyond 6 m.
    """
    centers = spec.centers()
    labels = np.zeros(spec.size, np.uint32)
    labels[np.abs(centers[..., 2] + 1.75) < 0.3 * spec.voxel_size[2]] = ROAD
    for place, label in (THINGS if things is None else things).items():
        labels[(np.abs(centers - place - [shift_m, 0, 0]) < 0.2).all(axis=-1)] = label
    counts = np.where(centers[..., 0] < -6, 0, 3).astype(np.float32)
    labels[counts == 0] = 0
    return labels, counts


def write_scene(
    root: Path,
    frames: int = 2,
    *,
    grid: str = "small",
    spec: GridSpec = SPEC,
    metadata: dict[str, Any] | None = None,
    counts: bool = True,
    path: str = PATH,
) -> Path:
    """Write a sequence in left-handed axes whose things move forward by 0.4 m a frame, and the
    vehicle by 1 m.
    """
    writer = FolderSink(root).sequence(path)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = np.arange(frames)
    writer.write_document(layout.POSES, layout.encode_poses(poses))
    writer.write_document(layout.TIMES, layout.encode_times(np.arange(frames) * 0.1))
    if metadata is not None:
        writer.write_document(layout.METADATA, to_json(metadata))
    writer.write_document(f"{grid}/params.json", to_json(spec.to_params()))
    for frame in range(frames):
        labels, votes = scene_grid(spec, 0.4 * frame)
        writer.write(f"{grid}/labels", frame, labels)
        if counts:
            writer.write(f"{grid}/counts", frame, votes)
        points = np.array(
            [[5.1 + 0.4 * frame, 3.1, -1.1, 0.0], [1.1, -0.3, -1.75, 0.0]], np.float32
        )
        writer.write("points", frame, points)
        writer.write("labels", frame, np.array([CAR, ROAD], np.uint32))
    return root


def files_and_bytes(root: Path) -> dict[str, bytes]:
    """Return every file below a folder, by its path, without the records of inputs."""
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file() and not path.match("carlasc-*-of-*.json")
    }


def read_occ3d(
    root: Path, scene: str
) -> tuple[dict[str, Any], dict[str, dict[str, NDArray[np.uint8]]]]:
    """Return annotations.json, and the arrays of each token's labels.npz."""
    annotations = json.loads((root / "annotations.json").read_text())
    arrays = {}
    for token, info in annotations["scene_infos"][scene].items():
        with np.load(root / info["gt_path"], allow_pickle=False) as file:
            arrays[token] = {name: file[name] for name in file.files}
    return annotations, arrays


def occ3d_cell(x: float, y: float, z: float) -> tuple[int, int, int]:
    """Return the voxel of a place in the vehicle's frame: x forward, y to the left, z up from the
    ground.
    """
    return int((x + 40) // 0.4), int((y + 40) // 0.4), int((z + 1) // 0.4)


def read_openoccupancy(file: Path) -> NDArray[np.uint8]:
    """Return (512, 512, 40) classes, x to the right, y forward: 255 where nothing is stored."""
    rows = np.load(file, allow_pickle=False)
    dense = np.full((512, 512, 40), 255, np.uint8)
    dense[rows[:, 2], rows[:, 1], rows[:, 0]] = rows[:, 3]
    return dense


def read_sscbench(
    folder: Path, frame: int
) -> tuple[NDArray[np.uint16], NDArray[np.uint8], NDArray[np.uint8]]:
    """Return (256, 256, 32) raw labels, invalid, one byte each, and occupancy, unpacked from bits."""
    shape = (256, 256, 32)
    labels = np.fromfile(folder / f"{frame:06d}.label", "<u2").reshape(shape)
    invalid = np.fromfile(folder / f"{frame:06d}.invalid", np.uint8).reshape(shape)
    bits = np.unpackbits(np.fromfile(folder / f"{frame:06d}.bin", np.uint8)).reshape(shape)
    return labels, invalid, bits


def read_index(file: Path) -> list[list[str]]:
    """Return the list of lists of texts that a pickle holds.

    Nothing but such lists is accepted, and nothing is executed.
    """
    stack: list[Any] = []
    marks: list[int] = []
    memo: list[Any] = []
    for opcode, argument, _ in pickletools.genops(file.read_bytes()):
        if opcode.name in ("PROTO", "FRAME"):
            continue
        if opcode.name == "STOP":
            break
        if opcode.name == "EMPTY_LIST":
            stack.append([])
        elif opcode.name in ("SHORT_BINUNICODE", "BINUNICODE"):
            stack.append(argument)
        elif opcode.name == "MEMOIZE":
            memo.append(stack[-1])
        elif opcode.name in ("BINGET", "LONG_BINGET"):
            stack.append(memo[argument])
        elif opcode.name == "MARK":
            marks.append(len(stack))
        elif opcode.name == "APPENDS":
            place = marks.pop()
            stack[place - 1].extend(stack[place:])
            del stack[place:]
        elif opcode.name == "APPEND":
            last = stack.pop()
            stack[-1].append(last)
        else:
            raise AssertionError(f"{opcode.name} in an index")
    (index,) = stack
    return index
