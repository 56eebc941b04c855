"""A simulated drive as KITTI's raw data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from converters.formats.kitti_drive import (
    KittiDrive,
    packets_of,
    write_packets,
    write_scan,
    write_stamps,
)

from carlasc.core.boxes import Boxes
from carlasc.core.geometry import rotation_z, rotations_of, translation

LIDAR_T_IMU = translation((-0.81, 0.32, -0.8)) @ rotation_z(0.01)
TYPES = {"car": "Car", "van": "Van", "pedestrian": "Pedestrian", "cyclist": "Cyclist"}
DRIVE = "2011_09_26/2011_09_26_drive_0005_sync"


def write_raw(
    root: Path,
    drive: KittiDrive,
    labels: dict[str, int],
    name: str = DRIVE,
    *,
    oxts_late_s: float = 0.0,
) -> Path:
    """Write a drive and return its folder.

    Packets of the navigation system come `oxts_late_s` after the scans.

    Args:
        labels: the class ids of `drive.boxes`, by kind: the names of their types are written.
    """
    folder = root / name
    for frame in range(drive.frames):
        write_scan(folder / f"velodyne_points/data/{frame:010d}.bin", drive.scan(frame).points)
    write_stamps(folder / "velodyne_points/timestamps.txt", drive.times)
    times = drive.times + oxts_late_s
    packets = packets_of(drive.world_T_lidar(times) @ LIDAR_T_IMU)
    write_stamps(folder / "oxts/timestamps.txt", times)
    for frame, packet in enumerate(packets):
        write_packets(folder / f"oxts/data/{frame:010d}.txt", packet[None])
    rotation, place = LIDAR_T_IMU[:3, :3].reshape(-1).tolist(), LIDAR_T_IMU[:3, 3].tolist()
    (folder.parent / "calib_imu_to_velo.txt").write_text(
        f"calib_time: 25-May-2012 16:47:16\nR: {' '.join(map(repr, rotation))}\nT: "
        f"{' '.join(map(repr, place))}\n"
    )
    boxes = [drive.boxes(frame, labels) for frame in range(drive.frames)]
    (folder / "tracklet_labels.xml").write_text(
        tracklets_of(boxes, {labels[kind]: TYPES[kind] for kind in TYPES})
    )
    return folder


def tracklets_of(boxes: list[Boxes], types: dict[int, str], interpolated: int | None = None) -> str:
    """Return tracklet_labels.xml for the boxes of frames 0, 1, ...; those of one frame are marked
    as filled in.
    """
    last = max(int(found.tracks.max(initial=0)) for found in boxes)
    items = [_tracklet(boxes, track, types, interpolated) for track in range(1, last + 1)]
    return (
        '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n<!DOCTYPE boost_serialization>\n'
        '<boost_serialization signature="serialization::archive" version="9">\n<tracklets '
        'class_id="0">\n'
        f"<count>{len(items)}</count>\n<item_version>1</item_version>\n{''.join(items)}</tracklets>\n</boost_serialization>\n"
    )


def _tracklet(
    boxes: list[Boxes], track: int, types: dict[int, str], interpolated: int | None
) -> str:
    rows = [
        (frame, found, np.flatnonzero(found.tracks == track)) for frame, found in enumerate(boxes)
    ]
    rows = [(frame, found, row) for frame, found, row in rows if len(row)]
    first = rows[0][0] if rows else 0
    length, width, height = rows[0][1].sizes[rows[0][2][0]].tolist() if rows else (1.0, 1.0, 1.0)
    kind = types[int(rows[0][1].labels[rows[0][2][0]])] if rows else "Car"
    assert [frame for frame, _, _ in rows] == list(range(first, first + len(rows)))
    poses = ""
    for frame, found, row in rows:
        x, y, z = found.centers[row[0]].tolist()
        forward = rotations_of(found.quaternions[row])[0, :, 0]
        state = 1 if frame == interpolated else 2
        poses += (
            f"<item><tx>{x!r}</tx><ty>{y!r}</ty><tz>{z - height / 2!r}</tz><rx>0</rx><ry>0</ry>"
            f"<rz>{float(np.arctan2(forward[1], forward[0]))!r}</rz><state>{state}</state><truncation>0</truncation></item>\n"
        )
    return (
        f"<item><objectType>{kind}</objectType><h>{height!r}</h><w>{width!r}</w><l>{length!r}</l>"
        f"<first_frame>{first}</first_frame>\n<poses><count>{len(rows)}</count><item_version>2</item_version>\n{poses}</poses>"
        "<finished>1</finished></item>\n"
    )
