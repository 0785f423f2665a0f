"""Which transforms would make a channel that a log lacks from channels that it has."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from vehest.data.derived import WHEELS, AccelerationFromSpeed

SHARE_OF_RATE = 0.2
"""Cut-off of a derived acceleration over the sampling rate, where the usual one does not lie below half of that rate."""

MAKES = {
    "acceleration_from_speed": "ax",
    "sideslip_from_velocity": "sideslip_ref",
    "speed_from_wheels": "vx",
    "steering_ratio": "steer",
    "velocity_from_sideslip": "vy_ref",
}
"""Transform -> channel that it makes of others."""


@dataclass(frozen=True)
class Supply:
    """How a channel is made of others.

    Args:
        channel: that is made.
        of: channels of the log that it is made of, in the end.
        transforms: entries of a data set's ``transforms``, in order; None stands for a value that only the user knows.
        meanings: option that is None -> what it is, with its unit.
    """

    channel: str
    of: tuple[str, ...]
    transforms: tuple[Mapping[str, Any], ...]
    meanings: Mapping[str, str]

    @property
    def entries(self) -> str:
        """The transforms as they stand in a data set; values that only the user knows are an ellipsis."""
        return ", ".join("{" + ", ".join(f"{key}: {_shown(value)}" for key, value in entry.items()) + "}" for entry in self.transforms)

    def in_words(self) -> str:
        """For people, for example ``transforms: [{name: steering_ratio, ratio: …}] (ratio: of handwheel to road-wheel angle)``."""
        told = "; ".join(f"{name}: {meaning}" for name, meaning in self.meanings.items())
        return f"transforms: [{self.entries}] of {_listed(self.of)}" + (f" ({told})" if told else "")


def supply_of(channel: str, channels: Collection[str], gappy: Collection[str], rate_hz: float) -> Supply | None:
    """What would make a channel of those that are there; None where nothing does.

    Args:
        channel: that is missing.
        channels: that are there.
        gappy: those of them with gaps.
        rate_hz: sampling rate [Hz].
    """
    match channel:
        case "vx":
            wheels = tuple(name for wheel in WHEELS if (name := f"wheel_speed_{wheel}") in channels)
            entry = {"name": "speed_from_wheels", "wheel_radius": None}
            return Supply(channel, wheels, (entry,), {"wheel_radius": "rolling radius of the tyres [m]"}) if wheels else None
        case "steer":
            entry = {"name": "steering_ratio", "ratio": None}
            meaning = {"ratio": "of the handwheel's angle to the road wheels'"}
            return Supply(channel, ("handwheel",), (entry,), meaning) if "handwheel" in channels else None
        case "ax":
            usual = AccelerationFromSpeed.cutoff_hz < rate_hz / 2
            own = {} if usual else {"cutoff_hz": SHARE_OF_RATE * rate_hz}
            return None if "vx" in gappy else _after_speed(channel, (), {"name": "acceleration_from_speed", **own}, channels, rate_hz)
        case "vy_ref" if "sideslip_ref" in channels:
            entry = {"name": "velocity_from_sideslip"}
            if "vx_ref" in channels:
                return Supply(channel, ("sideslip_ref", "vx_ref"), (entry,), {})
            return _after_speed(channel, ("sideslip_ref",), entry, channels, rate_hz)
    return None


def made_by(transforms: Iterable[Mapping[str, Any]]) -> frozenset[str]:
    """Channels that transforms make of others, as far as their names tell."""
    return frozenset(MAKES[name] for entry in transforms if (name := str(entry.get("name"))) in MAKES)


def _after_speed(channel: str, of: tuple[str, ...], entry: Mapping[str, Any], channels: Collection[str], rate_hz: float) -> Supply | None:
    """A channel that is made of ``vx`` and others, of a ``vx`` that is itself made where it is not there."""
    if "vx" in channels:
        return Supply(channel, (*of, "vx"), (entry,), {})
    speed = supply_of("vx", channels, (), rate_hz)
    return None if speed is None else Supply(channel, (*of, *speed.of), (*speed.transforms, entry), speed.meanings)


def _shown(value: Any) -> str:
    return "…" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _listed(names: Collection[str]) -> str:
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last
