"""Transforms that would make a channel which a log lacks from channels that it has."""

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
class Derivation:
    """How a channel is made of others.

    Args:
        channel: that is made.
        of: channels of the log that it is made of, in the end.
        transforms: entries of a data set's ``transforms``, in order; None stands for a value that only the user knows.
        meanings: option that is None -> its meaning, with its unit.
    """

    channel: str
    of: tuple[str, ...]
    transforms: tuple[Mapping[str, Any], ...]
    meanings: Mapping[str, str]

    def in_words(self) -> str:
        """For messages, for example ``transforms: [{name: steering_ratio, ratio: …}] of handwheel (ratio: of …)``."""
        entries = ", ".join("{" + ", ".join(f"{key}: {_shown(value)}" for key, value in entry.items()) + "}" for entry in self.transforms)
        *first, last = self.of
        meanings = "; ".join(f"{name}: {meaning}" for name, meaning in self.meanings.items())
        made_of = f"{', '.join(first)} and {last}" if first else last
        return f"transforms: [{entries}] of {made_of}" + (f" ({meanings})" if meanings else "")


def derivation_of(channel: str, channels: Collection[str], gappy: Collection[str], rate_hz: float) -> Derivation | None:
    """Derivation of a missing channel from those that are there; None where nothing makes it.

    Args:
        channel: that is missing.
        channels: that are there.
        gappy: those of them with gaps.
        rate_hz: sampling rate [Hz].
    """
    entry: dict[str, Any]
    wheels = tuple(name for wheel in WHEELS if (name := f"wheel_speed_{wheel}") in channels)
    if channel == "vx" and wheels:
        entry = {"name": "speed_from_wheels", "wheel_radius": None}
        return Derivation(channel, wheels, (entry,), {"wheel_radius": "rolling radius of the tyres [m]"})
    if channel == "steer" and "handwheel" in channels:
        entry = {"name": "steering_ratio", "ratio": None}
        return Derivation(channel, ("handwheel",), (entry,), {"ratio": "of the handwheel's angle to the road wheels'"})
    if channel == "ax" and "vx" not in gappy:
        usual = AccelerationFromSpeed.cutoff_hz < rate_hz / 2
        entry = {"name": "acceleration_from_speed"} | ({} if usual else {"cutoff_hz": SHARE_OF_RATE * rate_hz})
    elif channel == "vy_ref" and "sideslip_ref" in channels:
        entry = {"name": "velocity_from_sideslip"}
    else:
        return None
    of = ("sideslip_ref",) if channel == "vy_ref" else ()
    speed = "vx_ref" if channel == "vy_ref" and "vx_ref" in channels else "vx"
    if speed in channels:
        return Derivation(channel, (*of, speed), (entry,), {})
    made = derivation_of("vx", channels, (), rate_hz)
    return None if made is None else Derivation(channel, (*of, *made.of), (*made.transforms, entry), made.meanings)


def made_by(transforms: Iterable[Mapping[str, Any]]) -> frozenset[str]:
    """Channels that transforms make of others, as far as their names tell."""
    return frozenset(MAKES[name] for entry in transforms if (name := str(entry.get("name"))) in MAKES)


def _shown(value: Any) -> str:
    return "…" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
