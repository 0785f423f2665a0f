"""What a data set declares about a ROS 2 bag: topics and their clocks, fields and their units, poses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vehest.constants import FloatArray
from vehest.data.channels import channel
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.units import factor_to_si
from vehest.sources.columns import Column, column_from_config
from vehest.sources.pose import POSE_CHANNELS, UpAxis, require_filter, require_pose_channels


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
    stamps: str = "header"
    clock: str = "stamps"
    rate_hz: float | None = None
    max_gap: float = 0.05
    delay: float = 0.0
    interpolation: str = "linear"
    average: float = 0.0


@dataclass(frozen=True)
class Field:
    """Where a channel comes from.

    Args:
        topic: the topic's name in the data set.
        field: path of the field in the message.
        offset: what the field says where the channel is zero.
        column: unit, sign and factor.
        si_unit: unit of the channel.
    """

    topic: str
    field: str
    offset: float
    column: Column
    si_unit: str

    def to_si(self, values: FloatArray) -> FloatArray:
        """Values in SI units and ISO 8855 signs."""
        return self.column.to_si(values - self.offset if self.offset else values, self.si_unit)


@dataclass(frozen=True)
class Pose:
    """How the reference is made of poses; see `vehest.sources.pose.planar_motion`.

    Args:
        topic: the topic's name in the data set.
        field: path of a geometry_msgs/Pose in the message.
        up: upward axis of the world and of the rigid body, ``z`` or ``y``.
        window: samples of the Savitzky-Golay filter.
        order: of its polynomial.
        yaw: from the rigid body's x axis to the car's forward axis [rad].
        lever_x: from the rigid body's origin forward to the reference point [m].
        lever_y: from the rigid body's origin left to the reference point [m].
        channels: which of vx_ref, vy_ref, yaw_rate_ref, sideslip_ref.
    """

    topic: str
    field: str = "pose"
    up: UpAxis = "z"
    window: int = 9
    order: int = 2
    yaw: float = 0.0
    lever_x: float = 0.0
    lever_y: float = 0.0
    channels: tuple[str, ...] = POSE_CHANNELS


def topics_from_config(entries: Any, where: str) -> dict[str, Topic]:
    """Topics by the names that the data set gives them.

    Raises:
        ConfigurationError: an unknown key or value, or one bag's topic under two names.
    """
    topics = {str(name): _topic(entry, f"{where}: topic '{name}'") for name, entry in mapping(entries, f"{where}: topics").items()}
    names = [topic.topic for topic in topics.values()]
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise ConfigurationError(f"{where}: topics lists '{doubled[0]}' twice; name its channels under one")
    return topics


def channels_from_config(entries: Any, topics: Mapping[str, Topic], where: str) -> dict[str, Field]:
    """Where each channel comes from.

    Raises:
        ConfigurationError: an unknown channel, topic, unit or key.
    """
    channels = {}
    for name, entry in mapping(entries, f"{where}: channels").items():
        place = f"{where}: channel '{name}'"
        _require_keys(entry, place, {"topic", "field", "unit"}, {"topic", "field", "unit", "sign", "factor", "offset"})
        _require_topic(entry, topics, place)
        column = column_from_config(
            {"column": entry["field"], "unit": entry["unit"]} | {key: entry[key] for key in ("sign", "factor") if key in entry}, place
        )
        try:
            si_unit = channel(str(name)).unit
            factor_to_si(column.unit, si_unit)
        except DataError as error:
            raise ConfigurationError(f"{place}: {error}") from None
        offset = number(entry.get("offset", 0.0), f"{place}: offset", above=-math.inf)
        channels[str(name)] = Field(str(entry["topic"]), column.column, offset, column, si_unit)
    return channels


def pose_from_config(entry: Any, topics: Mapping[str, Topic], where: str) -> Pose:
    """How the reference is made of poses.

    Raises:
        ConfigurationError: an unknown topic, channel, key or value.
    """
    _require_keys(entry, where, {"topic"}, set(Pose.__dataclass_fields__))
    _require_topic(entry, topics, where)
    _require_choice(entry, "up", ("z", "y"), where)
    if topics[str(entry["topic"])].average:
        raise ConfigurationError(f"{where}: orientations cannot be averaged; leave average out of topic '{entry['topic']}'")
    window, order = require_filter(entry.get("window", Pose.window), entry.get("order", Pose.order), where)
    channels = require_pose_channels(entry.get("channels", POSE_CHANNELS), where)
    lengths = {key: number(entry.get(key, 0.0), f"{where}: {key}", above=-math.inf) for key in ("yaw", "lever_x", "lever_y")}
    return Pose(
        str(entry["topic"]),
        str(entry.get("field", Pose.field)),
        "y" if entry.get("up") == "y" else "z",
        window,
        order,
        lengths["yaw"],
        lengths["lever_x"],
        lengths["lever_y"],
        channels,
    )


def mapping(entries: Any, where: str) -> Mapping[str, Any]:
    """A declaration that must map names to something.

    Raises:
        ConfigurationError: it does not.
    """
    if not isinstance(entries, Mapping):
        raise ConfigurationError(f"{where} must map names to declarations, not {entries}")
    return entries


def number(value: Any, where: str, *, above: float, or_equal: bool = False) -> float:
    """A declared number.

    Raises:
        ConfigurationError: it is none, or out of range.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigurationError(f"{where} must be a number, not {value}")
    if not (value > above or (or_equal and value == above)):
        raise ConfigurationError(f"{where} must be above {above:g}, not {value}")
    return float(value)


def _topic(entry: Any, where: str) -> Topic:
    _require_keys(entry, where, {"topic", "type"}, set(Topic.__dataclass_fields__))
    for key, known in (("stamps", ("header", "received")), ("clock", ("stamps", "uniform")), ("interpolation", ("linear", "hold"))):
        _require_choice(entry, key, known, where)
    rate = entry.get("rate_hz")
    clock = str(entry.get("clock", "stamps"))
    if clock == "uniform" and rate is None:
        raise ConfigurationError(f"{where}: a uniform clock needs the sensor's nominal rate_hz")
    average = number(entry.get("average", 0.0), f"{where}: average", above=0.0, or_equal=True)
    if average and (clock != "uniform" or average * float(rate or 0.0) < 1.5):
        raise ConfigurationError(f"{where}: a moving average needs clock: uniform and a width of two samples or more")
    return Topic(
        topic=str(entry["topic"]),
        type=str(entry["type"]),
        stamps=str(entry.get("stamps", "header")),
        clock=clock,
        rate_hz=None if rate is None else number(rate, f"{where}: rate_hz", above=0.0),
        max_gap=number(entry.get("max_gap", Topic.max_gap), f"{where}: max_gap", above=0.0),
        delay=number(entry.get("delay", 0.0), f"{where}: delay", above=-math.inf),
        interpolation=str(entry.get("interpolation", "linear")),
        average=average,
    )


def _require_keys(entry: Any, where: str, needed: set[str], known: set[str]) -> None:
    if not isinstance(entry, Mapping) or not needed <= set(entry) or set(entry) - known:
        optional = ", ".join(sorted(known - needed))
        raise ConfigurationError(f"{where} must say {', '.join(sorted(needed))} and may say {optional}, not {entry}")


def _require_topic(entry: Mapping[str, Any], topics: Mapping[str, Topic], where: str) -> None:
    if str(entry["topic"]) not in topics:
        raise ConfigurationError(f"{where}: topic '{entry['topic']}' is not one of topics: {', '.join(topics) or 'none'}")


def _require_choice(entry: Mapping[str, Any], key: str, known: tuple[str, ...], where: str) -> None:
    if key in entry and entry[key] not in known:
        raise ConfigurationError(f"{where}: {key} '{entry[key]}' is not one of: {', '.join(known)}")
