"""Scans as files of every format, written by NumPy, Open3D and laspy; and poses as files of every
format.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from carlasc.core.geometry import quaternions_of

PCD = {"ascii": {"write_ascii": True}, "binary": {}, "compressed": {"compressed": True}}


def write_scan(path: Path, fields: dict[str, np.ndarray], **how) -> None:
    """Write columns by name; the suffix says the format."""
    path.parent.mkdir(parents=True, exist_ok=True)
    suffix = path.suffix
    if suffix == ".bin":
        np.stack([values.astype("<f4") for values in fields.values()], axis=1).tofile(path)
    elif suffix == ".npy":
        rows = np.empty(len(fields["x"]), [(name, values.dtype) for name, values in fields.items()])
        for name, values in fields.items():
            rows[name] = values
        np.save(path, rows)
    elif suffix == ".npz":
        np.savez(path, **fields)
    elif suffix == ".csv":
        rows = np.stack([values.astype(np.float64) for values in fields.values()], axis=1)
        np.savetxt(path, rows, "%.9g", ",", header=",".join(fields), comments="")
    elif suffix in (".ply", ".pcd"):
        write_with_open3d(path, fields, **how)
    else:
        write_with_laspy(path, fields)


def write_with_open3d(path: Path, fields: dict[str, np.ndarray], **how) -> None:
    import open3d

    cloud = open3d.t.geometry.PointCloud()
    positions = np.stack([fields[axis] for axis in "xyz"], axis=1)
    cloud.point["positions"] = open3d.core.Tensor(positions)
    for name, values in fields.items():
        if name not in ("x", "y", "z"):
            # its PLY has no uint32
            kept = values.astype(np.int32) if values.dtype == np.uint32 else values
            cloud.point[name] = open3d.core.Tensor(kept.reshape(-1, 1))
    assert open3d.t.io.write_point_cloud(str(path), cloud, **how)


def write_with_laspy(path: Path, fields: dict[str, np.ndarray]) -> None:
    """Write LAS or LAZ, whose coordinates are whole tenths of a millimetre."""
    import laspy

    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = [1e-4] * 3
    cloud = laspy.LasData(header)
    for axis in "xyz":
        setattr(cloud, axis, fields[axis].astype(np.float64))
    cloud.intensity = (fields["intensity"] * 65535).astype(np.uint16)
    for name in fields.keys() - {"x", "y", "z", "intensity"}:
        cloud.add_extra_dim(laspy.ExtraBytesParams(name, fields[name].dtype))
        cloud[name] = fields[name]
    cloud.write(str(path))


def write_poses(
    path: Path, poses: np.ndarray, seconds: np.ndarray, kind: str, start_ns: int = 0
) -> None:
    """Write (K, 4, 4) poses at some times as a file of a kind: tum, kitti, euroc, csv or npy;
    `start_ns` is added to nanoseconds.
    """
    w, x, y, z = quaternions_of(poses[:, :3, :3]).T
    places = poses[:, :3, 3].T
    if kind == "npy":
        np.save(path, poses)
    elif kind == "kitti":
        np.savetxt(path, poses[:, :3].reshape(-1, 12), "%.18e")
    elif kind == "tum":
        np.savetxt(
            path,
            np.stack([seconds, *places, x, y, z, w], axis=1),
            "%.17g",
            header="t x y z qx qy qz qw",
        )
    else:
        stamps = [str(start_ns + round(second * 1e9)) for second in seconds.tolist()]
        rows = np.stack([*places, w, x, y, z], axis=1).tolist()
        euroc = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
        lines = [euroc if kind == "euroc" else "time_ns,x,y,z,qw,qx,qy,qz"]
        lines += [
            ",".join([stamp, *map(repr, row)]) for stamp, row in zip(stamps, rows, strict=True)
        ]
        path.write_text("\n".join(lines) + "\n")
