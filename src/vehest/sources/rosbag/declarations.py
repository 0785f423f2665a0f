"""What a data set declares of ROS 2 bags: topics and their clocks, fields and their units,
poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from vehest.sources.columns import Positive
from vehest.sources.pose import PoseOptions, UpAxis


@dataclass(frozen=True)
class Topic:
    """Declaration of a topic, and of how its samples get their times."""

    topic: str  # name of the topic in the bag
    type: str  # type of its messages
    # whose time stamps are used: those of the messages' headers, or those of the bag
    stamps: Literal["header", "received"] = "header"
    # whether the stamps are the times, or the even clock behind them
    clock: Literal["stamps", "uniform"] = "stamps"
    rate_hz: Positive | None = None  # nominal rate of a uniform clock [Hz]
    max_gap: Positive = 0.05  # longest time between two stamps that is interpolated [s]
    delay: float = 0.0  # time by which the stamps are later than the samples [s]
    # whether samples are interpolated, or hold until the next one, as commands do
    interpolation: Literal["linear", "hold"] = "linear"
    # width of a centred moving average before interpolation [s]; 0: none
    average: Annotated[float, Field(ge=0.0, le=10.0)] = 0.0

    def __post_init__(self) -> None:
        if self.clock == "uniform" and self.rate_hz is None:
            raise ValueError("a uniform clock needs the sensor's nominal rate_hz")
        if self.average and (self.clock != "uniform" or self.average * (self.rate_hz or 0.0) < 1.5):
            raise ValueError(
                "a moving average needs clock: uniform and a width of two samples or more"
            )


@dataclass(frozen=True)
class BagChannel:
    """Declaration of a channel: sign · factor · (field - offset), in ``unit``."""

    topic: str  # name of the topic in the data set
    field: str  # path of the field in the message
    unit: str  # unit of the product
    sign: Literal[1, -1] = 1  # 1, or -1 where the field counts the other way round than ISO 8855
    factor: float = 1.0  # factor that brings the field to ``unit``
    offset: float = 0.0  # value of the field at zero


@dataclass(frozen=True)
class Pose(PoseOptions):
    """Declaration of poses."""

    topic: str  # name of the topic in the data set
    field: str = "pose"  # path of a geometry_msgs/Pose in the message
    up: UpAxis = "z"  # upward axis of the world and of the rigid body
    # angle from the rigid body's x axis to the car's forward axis, counter-clockwise [rad]
    yaw: float = 0.0


@dataclass(frozen=True)
class RosbagOptions:
    """Options of the source; see docs/sources/rosbag.md."""

    path: str | None = None  # folder of the bags
    files: str | tuple[str, ...] = "*.zip"  # pattern of the bags, or their names
    rate_hz: Positive = 100.0  # rate of the recordings [Hz]
    # start of the range that is read, after the first message of the bag [s]
    start: float | None = None
    stop: float | None = None  # end of this range, after the first message of the bag [s]
    # type of messages -> its definition, where ROS 2 Humble does not ship it
    messages: dict[str, str] | None = None
    topics: dict[str, Topic] | None = None  # name of a topic in the data set -> its declaration
    channels: dict[str, BagChannel] | None = None  # channel -> its declaration
    pose: Pose | None = None  # poses from which reference channels are made
    unpacked_limit: Positive = 8.0  # largest size to which an archive may unpack [GB]

    def __post_init__(self) -> None:
        topics = self.topics or {}
        channels = self.channels or {}
        names = [topic.topic for topic in topics.values()]
        if doubled := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"topics lists '{doubled[0]}' twice; name its channels under one")
        if self.start is not None and self.stop is not None and not self.stop > self.start:
            raise ValueError(f"stop must be above start, {self.start:g}, not {self.stop}")
        for topic in [
            *(declared.topic for declared in channels.values()),
            *([self.pose.topic] if self.pose else []),
        ]:
            if topic not in topics:
                raise ValueError(
                    f"topic '{topic}' is not one of topics: {', '.join(topics) or 'none'}"
                )
        if self.pose and topics[self.pose.topic].average:
            raise ValueError(
                f"orientations cannot be averaged; leave average out of topic '{self.pose.topic}'"
            )
        if doubled := sorted(set(channels) & set(self.pose.channels if self.pose else ())):
            raise ValueError(
                f"channel '{doubled[0]}' comes both from channels and from pose; leave one out"
            )
        if not channels and not self.pose:
            raise ValueError("neither channels nor a pose is declared")
