"""Fields of ROS 2 bags' topics, each with the times of its messages."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from vehest.data.errors import DataError
from vehest.sources.rosbag.topics import read_bag
from vehest.sources.surveys.log import Log, RawColumn

IGNORED = ("rosout", "parameter_events", "tf", "tf_static", "diagnostics")
MOST_FIELDS = 60  # of a message
UNITS = {  # of ROS's own types, REP 103
    "sensor_msgs/msg/Imu": {"angular_velocity": "rad/s", "linear_acceleration": "m/s²"},
    "geometry_msgs/msg/Twist": {"linear": "m/s", "angular": "rad/s"},
    "geometry_msgs/msg/TwistStamped": {"twist.linear": "m/s", "twist.angular": "rad/s"},
    "geometry_msgs/msg/TwistWithCovarianceStamped": {"twist.twist.linear": "m/s", "twist.twist.angular": "rad/s"},
    "nav_msgs/msg/Odometry": {"twist.twist.linear": "m/s", "twist.twist.angular": "rad/s"},
    "geometry_msgs/msg/AccelStamped": {"accel.linear": "m/s²", "accel.angular": "rad/s²"},
}


def survey_bag(path: Path) -> Log:
    """What a bag holds, as far as the types of its messages are ROS's own; raises `MissingError` or, if none is readable, `DataError`."""
    reading = read_bag(path, "survey_topics", ignored=IGNORED, most_fields=MOST_FIELDS)
    columns, skipped = [], reading.summary["skipped"]
    for topic, kind, fields in reading.summary["topics"]:
        clock = "header" if f"{topic}@stamped" in reading.arrays else "received"
        stamps = reading.arrays[f"{topic}@{'stamped' if clock == 'header' else 'received'}"].astype(np.float64) * 1e-9
        for field in fields if len(stamps) > 1 else ():
            unit = UNITS.get(kind, {}).get(field.rpartition(".")[0], "")
            place = {"topic": topic, "type": kind, "stamps": clock, "field": field}
            columns.append(RawColumn(f"{topic} {field}", unit, reading.arrays[f"{topic}.{field}"], place, stamps))
    if not columns:
        raise DataError(f"'{path}' holds no topic of plain numbers ({'; '.join(skipped[:3]) or 'it is empty'})")
    start = min(float(column.stamps[0]) for column in columns if column.stamps is not None)
    shifted = [replace(column, stamps=column.stamps - start) for column in columns if column.stamps is not None]
    return Log(path, "rosbag", tuple(shifted), skipped=tuple(skipped))
