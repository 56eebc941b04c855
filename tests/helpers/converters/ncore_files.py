"""A simulated drive as a store of NCore: written by ourselves as its library writes it, for quick
tests; and what its library is given.
"""

from __future__ import annotations

import io
import json
import lzma
import struct
import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from carlasc.testing import SimulatedDrive

START_US = 1_700_000_000_000_000
NAMES = {"car": "automobile", "van": "van", "pedestrian": "person", "cyclist": "cyclist"}


def contents(drive: SimulatedDrive) -> dict:
    """Return what a sequence holds: arrays of each frame of each LiDAR, poses, and observations of
    boxes in the frame of the rig.
    """
    half = round(drive.period_s * 5e5)
    # of frames, whose middle is the time of the drive
    ends = START_US + half + np.round(drive.times * 1e6).astype(np.int64)
    if not drive.rolling:
        ends = ends - half
    frames = {}
    for index, sensor in enumerate(drive.sensors):
        for number, end in enumerate(ends.tolist()):
            scan = drive.scan(number, index)
            stamps = START_US + np.round((drive.times[number] + scan.seconds) * 1e6).astype(
                np.int64
            )
            reach = np.linalg.norm(scan.points[:, :3], axis=1)
            direction = (scan.points[:, :3] / reach[:, None]).astype(np.float32)
            distance = np.full((2, len(reach)), np.nan, np.float32)
            distance[0] = reach
            distance[1, ::5] = reach[::5] + 1  # a second return
            intensity = np.where(np.isnan(distance), np.float32(np.nan), scan.points[:, 3])
            frames[sensor.name, number] = {
                "direction": direction,
                "timestamp_us": stamps.astype(np.uint64),
                "distance_m": distance,
                "intensity": intensity.astype(np.float32),
                "span": np.array([end - 2 * half, end], np.uint64),
            }
    pose_times = np.arange(
        -drive.period_s, drive.times[-1] + 2 * drive.period_s, drive.period_s / 4
    )
    observations = []
    for end in ends.tolist():
        seconds = (end - START_US) / 1e6
        rig_T_world = np.linalg.inv(drive.world_T_vehicle(seconds))
        for track, thing in enumerate((t for t in drive.things if t.kind in NAMES), 1):
            pose = rig_T_world @ thing.world_T_box(seconds)
            if np.linalg.norm(pose[:3, 3]) >= 60:
                continue
            box = {
                "centroid": pose[:3, 3].tolist(),
                "dim": [float(value) for value in thing.size],
                "rot": [
                    float(np.arctan2(pose[2, 1], pose[2, 2])),
                    float(-np.arcsin(pose[2, 0])),
                    float(np.arctan2(pose[1, 0], pose[0, 0])),
                ],
            }
            observations.append({
                "track_id": f"object-{track}",
                "class_id": NAMES[thing.kind],
                "timestamp_us": end,
                "reference_frame_id": "rig",
                "reference_frame_timestamp_us": end,
                "bbox3": box,
                "source": "GT_SYNTHETIC",
                "source_version": None,
            })  # fmt: skip
    return {
        "frames": frames,
        "mounts": {sensor.name: sensor.vehicle_T_sensor for sensor in drive.sensors},
        "poses": drive.world_T_vehicle(pose_times),
        "stamps": START_US + np.round(pose_times * 1e6).astype(np.int64),
        "observations": observations,
    }


def for_library(folder: Path, content: dict) -> None:
    """Write what the library is given as .npz and JSON: `tests/converters/ncore_library.py` reads
    it.
    """
    arrays = {
        f"{name}/{n}/{key}": value
        for (name, n), frame in content["frames"].items()
        for key, value in frame.items()
    }
    mounts = {f"mount/{name}": pose for name, pose in content["mounts"].items()}
    np.savez(
        folder / "given.npz", poses=content["poses"], stamps=content["stamps"], **arrays, **mounts
    )
    (folder / "given.json").write_text(json.dumps(content["observations"]))


def write_store(
    folder: Path,
    drive: SimulatedDrive,
    *,
    version: str = "v4",
    sequence: str = "drive 1",
    edit: Callable[[dict], object] = bool,
) -> Path:
    """Write a store of a sequence, and return its file; `edit` may change what it holds, as `contents` returns
    it.

    `edit` may add "cameras": for each name `lens`, its attributes in the component "intrinsics",
    `rig_T_camera`, and `images`: file and format by (start, end) in microseconds.
    """
    content, file = contents(drive), f"{sequence.split(maxsplit=1)[0]}.ncore4.zarr.itar"
    edit(content)
    members: dict[str, bytes] = {}
    metadata: dict[str, dict] = {}

    def group(name: str, **attributes) -> None:
        for end in range(len(parts := name.split("/"))):
            metadata["/".join([*parts[: end + 1], ".zgroup"]).removeprefix("/")] = {
                "zarr_format": 2
            }
        metadata[f"{name}/.zattrs".removeprefix("/")] = attributes

    metadata[".zgroup"] = {"zarr_format": 2}
    metadata[".zattrs"] = {
        "sequence_id": sequence,
        "sequence_timestamp_interval_us": {
            "start": int(content["stamps"][0]),
            "stop": int(content["stamps"][-1]) + 1,
        },
        "version": version,
        "component_group_name": "",
        "generic_meta_data": {},
    }

    def component(name: str) -> None:
        kind, _, instance = name.partition("/")
        group(
            name,
            component_name=kind,
            component_instance_name=instance,
            component_version="v1",
            generic_meta_data={},
        )

    def array(name: str, values: np.ndarray, chunks: tuple[int, ...]) -> None:
        from numcodecs import Blosc

        codec = Blosc("lz4", 5, Blosc.BITSHUFFLE)
        metadata[f"{name}/.zarray"] = {
            "zarr_format": 2, "shape": list(values.shape), "chunks": list(chunks), "dtype": values.dtype.str,
            "compressor": codec.get_config(), "fill_value": 0, "filters": None, "order": "C",
        }  # fmt: skip
        for row in range(0, len(values), chunks[0]):
            key = ".".join(map(str, [row // chunks[0], *(0 for _ in chunks[1:])]))
            members[f"{name}/{key}"] = codec.encode(
                np.ascontiguousarray(values[row : row + chunks[0]])
            )

    for name in content["mounts"]:
        component(f"lidars/{name}")
        spans = [
            frame["span"].tolist() for (own, _), frame in content["frames"].items() if own == name
        ]
        group(f"lidars/{name}/frames", frames_timestamps_us=spans)
    for (name, _), frame in content["frames"].items():
        place = f"lidars/{name}/frames/{int(frame['span'][1])}"
        rays, returns = f"{place}/ray_bundle", f"{place}/ray_bundle_returns"
        group(rays, n_rays=len(frame["direction"]))
        group(returns, n_returns=2)
        array(f"{rays}/direction", frame["direction"], frame["direction"].shape)
        array(f"{rays}/timestamp_us", frame["timestamp_us"], frame["timestamp_us"].shape)
        for key in ("distance_m", "intensity"):
            array(f"{returns}/{key}", frame[key], (1, frame[key].shape[1]))
        group(f"{place}/generic_data")
        valid = f"{place}/ray_bundle_returns_valid_mask_packed"
        packed = np.packbits(~np.isnan(frame["distance_m"]))
        array(valid, packed, packed.shape)
        metadata[f"{valid}/.zattrs"] = {"n_rays": len(frame["direction"]), "n_returns": 2}
    component("poses/default")
    cameras = content.get("cameras", {})
    for name, camera in cameras.items():
        group(f"intrinsics/default/cameras/{name}", **camera["lens"])
        component(f"cameras/{name}")
        group(
            f"cameras/{name}/frames", frames_timestamps_us=[list(span) for span in camera["images"]]
        )
        for (_, end), (data, kind) in camera["images"].items():
            place = f"cameras/{name}/frames/{end}/image"
            metadata[f"{place}/.zarray"] = {
                "zarr_format": 2, "shape": [], "chunks": [], "dtype": f"|S{len(data)}", "compressor": None, "fill_value": "", "filters": None, "order": "C",
            }  # fmt: skip
            metadata[f"{place}/.zattrs"] = {"format": kind}
            members[f"{place}/0"] = data
    for kind, things in {"intrinsics": ("cameras", "lidars"), "masks": ("cameras",)}.items():
        component(f"{kind}/default")
        for thing in things:
            group(f"{kind}/default/{thing}")
    content["mounts"] |= {
        name: camera["rig_T_camera"] for name, camera in cameras.items() if "rig_T_camera" in camera
    }
    static = {
        str((name, "rig")): {"pose": pose.tolist(), "dtype": "float64"}
        for name, pose in content["mounts"].items()
    }
    moving = {
        "poses": content["poses"].tolist(),
        "timestamps_us": content["stamps"].tolist(),
        "dtype": "float64",
    }
    group("poses/default/static_poses", **static)
    group("poses/default/dynamic_poses", **{str(("rig", "world")): moving})
    component("cuboids/default")
    group("cuboids/default/cuboids", cuboid_track_observations=content["observations"])
    path = folder / file
    _write_archive(
        path,
        members
        | {".zmetadata.cbor.xz": _packed({"zarr_consolidated_format": 1, "metadata": metadata})},
    )
    return path


def _packed(values: object) -> bytes:
    import cbor2

    return lzma.compress(cbor2.dumps(values))


def _write_archive(path: Path, members: dict[str, bytes]) -> None:
    table: dict[str, list] = {"items": [], "offset_datas": [], "sizes": []}
    with path.open("wb+") as file:
        with tarfile.TarFile(fileobj=file, mode="w", format=tarfile.PAX_FORMAT) as archive:
            for name, data in members.items():
                entry = tarfile.TarInfo(name)
                entry.size = len(data)
                archive.addfile(entry, io.BytesIO(data))
                rows = (name, file.tell() - -(-len(data) // 512) * 512, len(data))
                for key, value in zip(table, rows, strict=True):
                    table[key].append(value)
        file.seek(0, 2)
        place, index = file.tell(), _packed(table)
        file.write(index.ljust(-(-len(index) // 512) * 512, b"\0"))
        file.write(struct.pack("<4sIQI", b"itar", 1, place, len(index)).ljust(512, b"\0"))
