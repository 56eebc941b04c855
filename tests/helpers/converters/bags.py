"""Bags that rosbags writes: messages of points, poses and transforms, of small clouds or of a
simulated drive, as ROS 1 and ROS 2.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from carlasc.core.geometry import quaternions_of
from carlasc.testing import SimulatedDrive

KINDS = ("bag", "db3", "mcap")
START_NS = 1_700_000_000_123_456_789
WORLD, BASE, LIDAR = "odom", "base_link", "lidar"
_TYPES = {
    np.dtype(kind): number for number, kind in enumerate("i1 u1 i2 u2 i4 u4 f4 f8".split(), 1)
}
_LIVOX = {
    "CustomPoint": "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 "
    "tag\nuint8 line\n",
    "CustomMsg": "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 "
    "lidar_id\nuint8[3] rsvd\nCustomPoint[] points\n",
}


class Messages:
    """Makes messages of ROS 1 (`bag`) or ROS 2, each as (topic, type, time in nanoseconds,
    message).
    """

    def __init__(self, kind: str) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.ros1 = kind == "bag"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:
            text = "geometry_msgs/TransformStamped[] transforms\n"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
        for package in ("livox_ros_driver", "livox_ros_driver2"):
            for name, text in _LIVOX.items():
                self.store.register(get_types_from_msg(text, f"{package}/msg/{name}"))

    def make(self, name, *values):
        return self.store.types[name](*values)

    def header(self, stamp_ns, frame):
        stamp = self.make("builtin_interfaces/msg/Time", *divmod(stamp_ns, 10**9))
        return self.make("std_msgs/msg/Header", *((0,) if self.ros1 else ()), stamp, frame)

    def cloud(
        self, topic, stamp_ns, points, frame=LIDAR, *, height=1, row_padding=0, big_endian=False
    ):
        """Points: a structured array whose layout is that of the message."""
        points = np.asarray(points)
        if big_endian:
            points = points.astype(points.dtype.newbyteorder(">"))
        rows = points.view(np.uint8).reshape(height, -1)
        rows = np.concatenate([rows, np.full((height, row_padding), 7, np.uint8)], axis=1)
        fields = [
            self.make("sensor_msgs/msg/PointField", name, offset, _TYPES[kind.newbyteorder("=")], 1)
            for name, (kind, offset) in points.dtype.fields.items()
        ]
        kind = "sensor_msgs/msg/PointCloud2"
        sizes = (height, len(points) // height, fields, big_endian, points.itemsize, rows.shape[1])
        return (
            topic,
            kind,
            stamp_ns,
            self.make(kind, self.header(stamp_ns, frame), *sizes, rows.reshape(-1), True),
        )

    def livox(self, topic, stamp_ns, rows, package="livox_ros_driver2"):
        """Rows: (offset in nanoseconds, x, y, z, reflectivity, tag, line)."""
        points = [self.make(f"{package}/msg/CustomPoint", *row) for row in rows]
        kind = f"{package}/msg/CustomMsg"
        values = (stamp_ns, len(points), 0, np.zeros(3, np.uint8), points)
        return topic, kind, stamp_ns, self.make(kind, self.header(stamp_ns, "livox_frame"), *values)

    def odometry(self, topic, stamp_ns, pose, child=BASE):
        covariance = np.zeros(36)
        vector = self.make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        twist = self.make(
            "geometry_msgs/msg/TwistWithCovariance",
            self.make("geometry_msgs/msg/Twist", vector, vector),
            covariance,
        )
        placed = self.make("geometry_msgs/msg/PoseWithCovariance", self.pose(pose), covariance)
        kind = "nav_msgs/msg/Odometry"
        return (
            topic,
            kind,
            stamp_ns,
            self.make(kind, self.header(stamp_ns, WORLD), child, placed, twist),
        )

    def pose_stamped(self, topic, stamp_ns, pose):
        kind = "geometry_msgs/msg/PoseStamped"
        return topic, kind, stamp_ns, self.make(kind, self.header(stamp_ns, WORLD), self.pose(pose))

    def pose_with_covariance(self, topic, stamp_ns, pose):
        kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
        placed = self.make("geometry_msgs/msg/PoseWithCovariance", self.pose(pose), np.zeros(36))
        return topic, kind, stamp_ns, self.make(kind, self.header(stamp_ns, WORLD), placed)

    def path(self, topic, stamps, poses):
        kind = "nav_msgs/msg/Path"
        placed = [
            self.pose_stamped("", stamp, pose)[3] for stamp, pose in zip(stamps, poses, strict=True)
        ]
        return topic, kind, stamps[-1], self.make(kind, self.header(stamps[-1], WORLD), placed)

    def transform(self, topic, stamp_ns, parent, child, pose):
        x, y, z, rotation = self._parts(pose)
        placed = self.make(
            "geometry_msgs/msg/Transform", self.make("geometry_msgs/msg/Vector3", x, y, z), rotation
        )
        stamped = self.make(
            "geometry_msgs/msg/TransformStamped", self.header(stamp_ns, parent), child, placed
        )
        kind = "tf2_msgs/msg/TFMessage"
        return topic, kind, stamp_ns, self.make(kind, [stamped])

    def camera_info(self, topic, stamp_ns, frame, size, matrix, model="plumb_bob", distortion=()):
        kind = "sensor_msgs/msg/CameraInfo"
        projection = np.column_stack([matrix, np.zeros(3)])
        numbers = [
            np.array(distortion, np.float64),
            np.ravel(matrix),
            np.eye(3).ravel(),
            projection.ravel(),
        ]
        region = self.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        values = (size[1], size[0], model, *numbers, 0, 0, region)
        return topic, kind, stamp_ns, self.make(kind, self.header(stamp_ns, frame), *values)

    def image(self, topic, stamp_ns, frame, pixels, encoding="bgr8"):
        kind, (height, width) = "sensor_msgs/msg/Image", pixels.shape[:2]
        rows = np.pad(pixels.reshape(height, -1), ((0, 0), (0, 3)))  # rows may be padded
        values = (height, width, encoding, 0, rows.shape[1], rows.reshape(-1))
        return topic, kind, stamp_ns, self.make(kind, self.header(stamp_ns, frame), *values)

    def compressed(self, topic, stamp_ns, frame, data):
        kind = "sensor_msgs/msg/CompressedImage"
        return (
            topic,
            kind,
            stamp_ns,
            self.make(kind, self.header(stamp_ns, frame), "jpeg", np.frombuffer(data, np.uint8)),
        )

    def imu(self, topic, stamp_ns):
        """A message of a type that is of no use."""
        kind = "std_msgs/msg/String"
        return topic, kind, stamp_ns, self.make(kind, "x" * 100)

    def pose(self, pose):
        x, y, z, rotation = self._parts(pose)
        return self.make(
            "geometry_msgs/msg/Pose", self.make("geometry_msgs/msg/Point", x, y, z), rotation
        )

    def _parts(self, pose):
        w, i, j, k = quaternions_of(np.asarray(pose, np.float64)[None, :3, :3])[0].tolist()
        return *pose[:3, 3].tolist(), self.make("geometry_msgs/msg/Quaternion", i, j, k, w)


def write_bag(
    folder: Path, kind: str, messages: Iterable[tuple], *, store: Messages, compressed: str = ""
) -> Path:
    """Write messages, in their order, and return the bag: a file, or a folder for ROS 2.

    `compressed`: "bz2" or "lz4" for ROS 1; "message" or "storage" for ROS 2.
    """
    from rosbags import rosbag1, rosbag2

    path = folder / ("drive.bag" if kind == "bag" else "drive")
    if kind == "bag":
        writer = rosbag1.Writer(path)
        if compressed:
            writer.set_compression(rosbag1.Writer.CompressionFormat[compressed.upper()])
    else:
        plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        if compressed:
            writer.set_compression(
                rosbag2.CompressionMode[compressed.upper()], rosbag2.CompressionFormat.ZSTD
            )
    serialize = store.store.serialize_ros1 if kind == "bag" else store.store.serialize_cdr
    connections = {}
    with writer:
        for topic, name, stamp_ns, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store.store)
            writer.write(connections[topic], stamp_ns, serialize(message, name))
    return path


def write_one_message(path: Path, encoding: str, data: bytes) -> None:
    """Write an MCAP file of one message of the type foxglove.PointCloud in some encoding."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("foxglove.PointCloud", encoding, b"")
        writer.add_message(writer.register_channel("/points", encoding, schema), 1, data, 1)
        writer.finish()


def file_of(bag: Path) -> Path:
    """Return the file of a bag that holds the messages."""
    return bag if bag.is_file() else next(path for path in bag.iterdir() if path.suffix != ".yaml")


VELODYNE = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
        "offsets": [0, 4, 8, 16, 20, 24],
        "itemsize": 32,
    }
)


def velodyne(points, seconds=None):
    """Return points as Velodyne's driver lays them out: with holes."""
    packed = np.zeros(len(points), VELODYNE)
    for column, name in enumerate(("x", "y", "z", "intensity")):
        packed[name] = points[:, column]
    packed["ring"] = np.arange(len(points)) % 16
    packed["time"] = 0 if seconds is None else seconds
    return packed


def drive_messages(
    store: Messages, drive: SimulatedDrive, poses: str = "odometry"
) -> Sequence[tuple]:
    """Return the messages of a drive: a topic of points a sensor, its transform, and poses of
    `base_link`, by time.

    Poses: "odometry", "pose", "covariance", "path", "tf" or "none".
    """
    messages = []
    stamps = [START_NS + round(seconds * 1e9) for seconds in drive.times.tolist()]
    for index, sensor in enumerate(drive.sensors):
        name = sensor.name
        messages.append(
            store.transform("/tf_static", START_NS, BASE, name, sensor.vehicle_T_sensor)
        )
        for frame, stamp in enumerate(stamps):
            scan = drive.scan(frame, index)
            cloud = velodyne(scan.points, scan.seconds if drive.rolling else None)
            messages.append(store.cloud(f"/{name}/points", stamp, cloud, name))
    messages.extend(store.imu("/chatter", stamp + 1) for stamp in stamps)
    times = np.arange(-0.1, drive.times[-1] + 0.2, drive.period_s / 2)
    times[np.abs(times[:, None] - drive.times).argmin(axis=0)] = drive.times  # exact at the frames
    ticks = [START_NS + round(seconds * 1e9) for seconds in times.tolist()]
    placed = drive.world_T_vehicle(times)
    if poses == "path":
        messages.append(store.path("/path", ticks, placed))
    elif poses != "none":
        for tick, pose in zip(ticks, placed, strict=True):
            if poses == "odometry":
                messages.append(store.odometry("/odom", tick, pose))
            elif poses == "covariance":
                messages.append(store.pose_with_covariance("/pose", tick, pose))
            elif poses == "pose":
                messages.append(store.pose_stamped("/pose", tick, pose))
            else:
                messages.append(store.transform("/tf", tick, WORLD, BASE, pose))
    return sorted(messages, key=lambda message: message[2])
