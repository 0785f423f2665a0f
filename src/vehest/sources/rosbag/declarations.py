"""What a data set declares of ROS 2 bags: topics and their clocks, fields and their units, poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from vehest.sources.columns import Positive
from vehest.sources.pose import PoseOptions, UpAxis


@dataclass(frozen=True)
class Topic:
    """How a topic's samples come by their times.

    Args:
        topic: its name in the bag.
        type: its message type.
        stamps: ``header``, what the message says, or ``received``, what the bag says.
        clock: ``stamps`` takes the stamps as times, ``uniform`` the even clock behind them.
        rate_hz: nominal rate [Hz], for ``uniform``.
        max_gap: longest time between two stamps that is interpolated [s].
        delay: how much later than the sample its time says [s].
        interpolation: ``linear``, or ``hold`` for commands that stand until the next one.
        average: width of a centred moving average before interpolation [s]; 0 for none.
    """

    topic: str
    type: str
    stamps: Literal["header", "received"] = "header"
    clock: Literal["stamps", "uniform"] = "stamps"
    rate_hz: Positive | None = None
    max_gap: Positive = 0.05
    delay: float = 0.0
    interpolation: Literal["linear", "hold"] = "linear"
    average: Annotated[float, Field(ge=0.0)] = 0.0

    def __post_init__(self) -> None:
        if self.clock == "uniform" and self.rate_hz is None:
            raise ValueError("a uniform clock needs the sensor's nominal rate_hz")
        if self.average and (self.clock != "uniform" or self.average * (self.rate_hz or 0.0) < 1.5):
            raise ValueError("a moving average needs clock: uniform and a width of two samples or more")


@dataclass(frozen=True)
class BagChannel:
    """Where a channel comes from: sign · factor · (field - offset).

    Args:
        topic: the topic's name in the data set.
        field: path of the field in the message.
        unit: of the result.
        sign: 1 or -1.
        factor: other than 0.
        offset: the field's value where the channel is zero.
    """

    topic: str
    field: str
    unit: str
    sign: Literal[1, -1] = 1
    factor: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Pose(PoseOptions):
    """Where poses stand.

    Args:
        topic: the topic's name in the data set.
        field: path of a geometry_msgs/Pose in the message.
        up: upward axis of the world and of the rigid body.
        yaw: from the rigid body's x axis to the car's forward axis [rad].
    """

    topic: str
    field: str = "pose"
    up: UpAxis = "z"
    yaw: float = 0.0


@dataclass(frozen=True)
class RosbagOptions:
    """Options of the source; see docs/sources/rosbag.md."""

    path: str | None = None
    files: str | tuple[str, ...] = "*.zip"
    rate_hz: Positive = 100.0
    start: float | None = None
    stop: float | None = None
    messages: dict[str, str] | None = None
    topics: dict[str, Topic] | None = None
    channels: dict[str, BagChannel] | None = None
    pose: Pose | None = None
    unpacked_limit: Positive = 8.0

    def __post_init__(self) -> None:
        topics, channels = self.topics or {}, self.channels or {}
        names = [topic.topic for topic in topics.values()]
        if doubled := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"topics lists '{doubled[0]}' twice; name its channels under one")
        if self.start is not None and self.stop is not None and not self.stop > self.start:
            raise ValueError(f"stop must be above start, {self.start:g}, not {self.stop}")
        for topic in [*(declared.topic for declared in channels.values()), *([self.pose.topic] if self.pose else [])]:
            if topic not in topics:
                raise ValueError(f"topic '{topic}' is not one of topics: {', '.join(topics) or 'none'}")
        if self.pose and topics[self.pose.topic].average:
            raise ValueError(f"orientations cannot be averaged; leave average out of topic '{self.pose.topic}'")
        if doubled := sorted(set(channels) & set(self.pose.channels if self.pose else ())):
            raise ValueError(f"channel '{doubled[0]}' comes both from channels and from pose; leave one out")
        if not channels and not self.pose:
            raise ValueError("neither channels nor a pose is declared")
