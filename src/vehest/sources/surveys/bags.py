"""Fields of ROS 2 bags' topics, each with the times of its messages."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vehest.data.errors import DataError
from vehest.sources.rosbag import topics
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
    """What a bag holds, as far as the types of its messages are ROS's own.

    Raises:
        MissingError: rosbags is not installed, or the bag is not there.
        DataError: it is damaged, or none of its topics can be read.
    """
    found, skipped = topics.survey_bag(path, IGNORED, MOST_FIELDS)
    columns = [column for wanted, data in found for column in _columns(wanted.topic, wanted.type, data)]
    if not columns:
        raise DataError(f"'{path}' holds no topic of plain numbers ({'; '.join(skipped[:3]) or 'it is empty'})")
    start = min(float(column.stamps[0]) for column in columns if column.stamps is not None)
    shifted = [RawColumn(one.name, one.unit, one.values, one.place, None if one.stamps is None else one.stamps - start) for one in columns]
    return Log(path, "rosbag", tuple(shifted), skipped=tuple(skipped))


def _columns(topic: str, kind: str, data: topics.TopicData) -> list[RawColumn]:
    header = data.stamped is not None
    stamps = np.asarray(data.stamped if data.stamped is not None else data.received, dtype=np.float64) * 1e-9
    if len(stamps) < 2:
        return []
    place = {"topic": topic, "type": kind, "stamps": "header" if header else "received"}
    units = UNITS.get(kind, {})
    return [
        RawColumn(f"{topic} {field}", units.get(field.rpartition(".")[0], ""), values, {**place, "field": field}, stamps)
        for field, values in data.fields.items()
    ]
