"""Transforms that would make a channel which a log lacks from channels that it has."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from vehest.data.derived import WHEELS, AccelerationFromSpeed

# cut-off of a derived acceleration over the sampling rate, where the usual one does not lie below
# half of that rate
SHARE_OF_RATE = 0.2

UNKNOWN = {
    "wheel_radius": "rolling radius of the tyres [m]",
    "ratio": "overall steering ratio",
}
"""Options that only the user knows, with their meaning."""

MAKES = {
    "acceleration_from_speed": "ax",
    "sideslip_from_velocity": "sideslip_ref",
    "speed_from_wheels": "vx",
    "steering_ratio": "steer",
    "velocity_from_sideslip": "vy_ref",
}
"""Transform -> channel that it derives from others."""


@dataclass(frozen=True)
class Derivation:
    """How a missing channel is derived from others."""

    of: tuple[str, ...]  # channels of the log from which it is derived in the end
    # entries of a data set's ``transforms``, in order; None: a value that only the user knows
    transforms: tuple[Mapping[str, Any], ...]

    @property
    def meanings(self) -> dict[str, str]:
        """Option that is None -> its meaning, with its unit."""
        return {
            option: UNKNOWN[option]
            for entry in self.transforms
            for option, value in entry.items()
            if value is None
        }

    def in_words(self) -> str:
        """Text for messages, for example ``transforms: [{name: steering_ratio, ratio: …}] of
        handwheel (ratio: of …)``.
        """
        entries = ", ".join(
            "{" + ", ".join(f"{key}: {_as_text(value)}" for key, value in entry.items()) + "}"
            for entry in self.transforms
        )
        *first, last = self.of
        meanings = "; ".join(f"{name}: {meaning}" for name, meaning in self.meanings.items())
        inputs = f"{', '.join(first)} and {last}" if first else last
        return f"transforms: [{entries}] of {inputs}" + (f" ({meanings})" if meanings else "")


def derivation_of(
    channel: str, channels: Collection[str], gappy: Collection[str], rate_hz: float
) -> Derivation | None:
    """Derivation of a missing channel from those that are there, some with gaps.

    A forward speed is made of wheel speeds, a steering angle of the steering wheel's, ``ax`` of the
    speed, and ``vy_ref`` of the sideslip angle and a speed, which may itself be derived.

    Parameters
    ----------
    channel : str
        The channel that is missing.
    channels : collection of str
        Channels that are there.
    gappy : collection of str
        Those of them that have gaps; a speed with gaps is not differentiated.
    rate_hz : float
        Rate of the recording [Hz], by which the filter of a differentiated speed is chosen.

    Returns
    -------
    Derivation or None
        None where nothing makes it. Values that only the user knows, such as the radius of a wheel,
        are None in its transforms.
    """
    wheels = tuple(name for wheel in WHEELS if (name := f"wheel_speed_{wheel}") in channels)
    if channel == "vx" and wheels:
        return Derivation(wheels, ({"name": "speed_from_wheels", "wheel_radius": None},))
    if channel == "steer" and "handwheel" in channels:
        return Derivation(("handwheel",), ({"name": "steering_ratio", "ratio": None},))
    of: tuple[str, ...] = ()
    speed = "vx"
    entry = dict[str, Any](name="acceleration_from_speed")
    if channel == "ax" and "vx" not in gappy:
        if rate_hz <= 2.0 * AccelerationFromSpeed.cutoff_hz:
            entry["cutoff_hz"] = SHARE_OF_RATE * rate_hz
    elif channel == "vy_ref" and "sideslip_ref" in channels:
        of = ("sideslip_ref",)
        speed = "vx_ref" if "vx_ref" in channels else "vx"
        entry = {"name": "velocity_from_sideslip"}
    else:
        return None
    if speed in channels:
        return Derivation((*of, speed), (entry,))
    derived_speed = derivation_of("vx", channels, (), rate_hz)
    return (
        None
        if derived_speed is None
        else Derivation((*of, *derived_speed.of), (*derived_speed.transforms, entry))
    )


def channels_made_by(transforms: Iterable[Mapping[str, Any]]) -> frozenset[str]:
    """Channels that transforms derive from others, by the transforms' names."""
    return frozenset(
        MAKES[name] for entry in transforms if (name := str(entry.get("name"))) in MAKES
    )


def _as_text(value: Any) -> str:
    """Text of an option's value; ``…`` for one that only the user knows."""
    return "…" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
