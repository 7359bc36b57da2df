"""Bags, written by rosbags, for the tests of reading them."""

import sqlite3
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2.enums import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

START = 1_700_000_000_250_000_000  # ns
POSE, COVARIANCE, ODOMETRY, TRANSFORM = (
    *("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"),
    *("nav_msgs/msg/Odometry", "geometry_msgs/msg/TransformStamped"),
)
TF = "tf2_msgs/msg/TFMessage"
KINDS = ("a.bag", "a.mcap", "a.db3", "a")  # ROS 1, ROS 2 in a single file each, and a folder

Sample = tuple[str, str, Any, int]  # topic, type, message, time of recording in ns


class Messages:
    """Makes messages of the types of one ROS version."""

    def __init__(self, name: str) -> None:
        self.first = name.endswith(".bag")
        self.store = get_typestore(Stores.ROS1_NOETIC if self.first else Stores.ROS2_HUMBLE)
        if self.first:
            self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))

    def make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, stamp: int, frame: str) -> Any:
        time = self.make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        return self.make(
            "std_msgs/msg/Header", **({"seq": 0} if self.first else {}), stamp=time, frame_id=frame
        )

    def numbers(self, pose: np.ndarray) -> tuple[dict[str, float], dict[str, float]]:
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
        return (
            dict(zip("xyz", map(float, pose[:3, 3]), strict=True)),
            dict(zip("xyzw", map(float, quaternion), strict=True)),
        )

    def pose(self, kind: str, stamp: int, pose: np.ndarray, frame: str = "map", child: str = "tool") -> Any:
        position, orientation = self.numbers(pose)
        header = self.header(stamp, frame)
        quaternion = self.make("geometry_msgs/msg/Quaternion", **orientation)
        if kind == TRANSFORM:
            vector = self.make("geometry_msgs/msg/Vector3", **position)
            moved = self.make("geometry_msgs/msg/Transform", translation=vector, rotation=quaternion)
            return self.make(kind, header=header, child_frame_id=child, transform=moved)
        point = self.make("geometry_msgs/msg/Point", **position)
        plain = self.make("geometry_msgs/msg/Pose", position=point, orientation=quaternion)
        if kind == POSE:
            return self.make(kind, header=header, pose=plain)
        uncertain = self.make("geometry_msgs/msg/PoseWithCovariance", pose=plain, covariance=np.zeros(36))
        if kind == COVARIANCE:
            return self.make(kind, header=header, pose=uncertain)
        zero = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        still = self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        twist = self.make("geometry_msgs/msg/TwistWithCovariance", twist=still, covariance=np.zeros(36))
        return self.make(kind, header=header, child_frame_id=child, pose=uncertain, twist=twist)

    def tf(self, stamp: int, transforms: Iterable[tuple[str, str, np.ndarray]]) -> Any:
        return self.make(
            TF,
            transforms=[
                self.pose(TRANSFORM, stamp, pose, parent, child) for parent, child, pose in transforms
            ],
        )


def write_bag(folder: Path, name: str, samples: Iterable[Sample], definitions: bool = True) -> Path:
    """Write a bag; ``name`` is one of KINDS. Without definitions, only those that SQLite holds."""
    messages = Messages(name)
    store = messages.store
    target = folder / name
    if messages.first:
        with rosbag1.Writer(target) as first:
            known: dict[str, Any] = {}
            for topic, kind, message, time in samples:
                if topic not in known:
                    known[topic] = first.add_connection(topic, kind, typestore=store)
                first.write(known[topic], time, store.serialize_ros1(message, kind))
        return target
    plugin = StoragePlugin.MCAP if name.endswith(".mcap") else StoragePlugin.SQLITE3
    made = folder / "rosbag"
    with rosbag2.Writer(made, version=8, storage_plugin=plugin) as second:
        known = {}
        for topic, kind, message, time in samples:
            if topic not in known:
                known[topic] = second.add_connection(topic, kind, typestore=store)
            second.write(known[topic], time, store.serialize_cdr(message, kind))
    if not definitions:  # as ROS 2 wrote them before Iron
        (storage,) = made.glob("*.db3")
        with closing(sqlite3.connect(storage)) as database, database:
            database.execute("DROP TABLE message_definitions")
            database.execute("DROP TABLE schema")
            database.execute("DROP TABLE metadata")
    if target.suffix:
        (storage,) = made.glob(f"*{target.suffix}")
        return storage.rename(target)
    return made.rename(target)
