"""Run by test_ncore.py in an environment with NCore's own library: writes what is given as a store,
and what the library reads of it.

Usage: python ncore_library.py FOLDER, with given.npz and given.json in it, or with a store.
"""

import json
import sys
from pathlib import Path

import numpy as np
from ncore.data import BBox3, CuboidTrackObservation, LabelSource
from ncore.data.v4 import (
    CuboidsComponent,
    IntrinsicsComponent,
    LidarSensorComponent,
    MasksComponent,
    PosesComponent,
    SequenceComponentGroupsReader,
    SequenceComponentGroupsWriter,
    SequenceLoaderV4,
)
from ncore.impl.common.transformations import HalfClosedInterval
from upath import UPath


def observation(entry):
    box = entry["bbox3"]
    return CuboidTrackObservation(**{
        **entry,
        "bbox3": BBox3(*(tuple(map(float, box[key])) for key in ("centroid", "dim", "rot"))),
        "source": LabelSource[entry["source"]],
    })  # fmt: skip


def write(folder, given, observations):
    stamps = given["stamps"].astype(np.uint64)
    writer = SequenceComponentGroupsWriter(
        output_dir_path=UPath(folder),
        store_base_name="drive",
        sequence_id="drive 1",
        sequence_timestamp_interval_us=HalfClosedInterval(int(stamps[0]), int(stamps[-1]) + 1),
        generic_meta_data={},
        store_type="itar",
    )
    for kind in (IntrinsicsComponent, MasksComponent):
        writer.register_component_writer(kind.Writer, "default")
    poses = writer.register_component_writer(PosesComponent.Writer, "default")
    poses.store_dynamic_pose("rig", "world", given["poses"], stamps)
    names = sorted({key.split("/")[0] for key in given.files if key.count("/") == 2})
    for name in names:
        poses.store_static_pose(name, "rig", given[f"mount/{name}"])
        lidar = writer.register_component_writer(LidarSensorComponent.Writer, name)
        count = len(
            {key for key in given.files if key.startswith(f"{name}/") and key.endswith("/span")}
        )
        for number in range(count):
            frame = {
                key: given[f"{name}/{number}/{key}"]
                for key in ("direction", "timestamp_us", "distance_m", "intensity")
            }
            lidar.store_frame(
                **frame,
                model_element=None,
                frame_timestamps_us=given[f"{name}/{number}/span"],
                generic_data={},
                generic_meta_data={},
            )
    cuboids = writer.register_component_writer(CuboidsComponent.Writer, "default")
    cuboids.store_observations([observation(entry) for entry in observations])
    return writer.finalize()


def read(paths):
    loader = SequenceLoaderV4(SequenceComponentGroupsReader(paths))
    found = {}
    for name in loader.lidar_ids:
        sensor = loader.get_lidar_sensor(name)
        found[f"{name}/spans"] = sensor.frames_timestamps_us
        found[f"{name}/mount"] = sensor.T_sensor_rig
        for number in range(sensor.frames_count):
            for which in range(2):
                cloud = sensor.get_frame_point_cloud(number, False, False, return_index=which)
                found[f"{name}/{number}/points{which}"] = cloud.xyz_m_end
            found[f"{name}/{number}/stamps"] = sensor.get_frame_ray_bundle_timestamp_us(number)
        ends = sensor.frames_timestamps_us[:, 1].astype(np.int64)
        found[f"{name}/poses"] = np.array(
            [loader.pose_graph.evaluate_poses("rig", "world", np.array(end)) for end in ends]
        )
    boxes = [
        [
            int(box.track_id.rpartition("-")[2]),
            box.timestamp_us,
            *box.bbox3.centroid,
            *box.bbox3.dim,
        ]
        for box in loader.get_cuboid_track_observations()
    ]
    return found | {"boxes": np.array(boxes)}


if __name__ == "__main__":
    place = Path(sys.argv[1])
    written = [UPath(path) for path in place.glob("*.itar")]
    if not written:
        with np.load(place / "given.npz") as arrays:
            written = write(place, arrays, json.loads((place / "given.json").read_text()))
    np.savez(place / "library.npz", **read(written))
