"""Table of channels: canonical name, unit, meaning and the range that a road vehicle can reach.

Axes are those of ISO 8855 (x forward, y left, z up, counter-clockwise positive), units are SI,
angles are radians. Channels whose name ends in ``_ref`` come from a reference sensor; estimators
never see them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from vehest.data.errors import DataError

REFERENCE_SUFFIX = "_ref"  # end of the names of channels that come from a reference sensor


@dataclass(frozen=True)
class Channel:
    """One quantity of a recording."""

    name: str  # canonical name
    unit: str  # SI unit, ``1`` where the quantity has none
    meaning: str  # measured quantity, with its sign convention
    low: float  # smallest value that a road vehicle can produce [unit]
    high: float  # largest value that a road vehicle can produce [unit]
    rests: bool = False  # may stay exactly zero while the car moves, as a brake pressure does

    @property
    def is_reference(self) -> bool:
        """Whether the channel comes from a reference sensor."""
        return self.name.endswith(REFERENCE_SUFFIX)

    @property
    def is_angular(self) -> bool:
        """Whether the unit is an angle or angular rate, which files often give in degrees."""
        return self.unit in {"rad", "rad/s"} and not self.name.startswith(
            ("wheel_speed", "motor_speed")
        )


def _table() -> dict[str, Channel]:
    """Every channel by its name, those of the four wheels spelt out, in the order of the
    documentation.
    """
    corners = {"fl": "front left", "fr": "front right", "rl": "rear left", "rr": "rear right"}
    rows = [
        Channel("vx", "m/s", "measured forward velocity at the centre of gravity", -40.0, 140.0),
        Channel("yaw_rate", "rad/s", "measured yaw rate, positive in a left turn", -8.0, 8.0),
        Channel(
            "ax", "m/s²", "measured longitudinal acceleration at the centre of gravity", -80.0, 80.0
        ),
        Channel(
            "ay",
            "m/s²",
            "measured lateral acceleration at the centre of gravity, positive to the left",
            -80.0,
            80.0,
        ),
        Channel("steer", "rad", "mean road-wheel steering angle, positive to the left", -1.3, 1.3),
        Channel(
            "handwheel", "rad", "angle of the steering wheel, positive to the left", -25.0, 25.0
        ),
        Channel("roll", "rad", "measured roll angle, positive with the left side up", -1.6, 1.6),
        Channel("pitch", "rad", "measured pitch angle, positive with the nose down", -1.6, 1.6),
        Channel("roll_rate", "rad/s", "measured roll rate", -8.0, 8.0),
        Channel("pitch_rate", "rad/s", "measured pitch rate", -8.0, 8.0),
        Channel(
            "motor_speed",
            "rad/s",
            "speed of the drive motor, referred to the wheel",
            -3000.0,
            3000.0,
        ),
        Channel(
            "motor_current", "A", "torque-producing motor current", -2000.0, 2000.0, rests=True
        ),
        Channel(
            "brake_pressure_front", "Pa", "brake pressure of the front axle", -1e6, 4e7, rests=True
        ),
        Channel(
            "brake_pressure_rear", "Pa", "brake pressure of the rear axle", -1e6, 4e7, rests=True
        ),
    ]
    for corner, place in corners.items():
        meaning = f"rotational speed of the {place} wheel"
        rows.append(Channel(f"wheel_speed_{corner}", "rad/s", meaning, -500.0, 1000.0))
    for corner, place in corners.items():
        meaning = f"driving torque at the {place} wheel"
        rows.append(Channel(f"wheel_torque_{corner}", "N·m", meaning, -2e4, 2e4, rests=True))
    for axis, direction in {"x": "longitudinal", "y": "lateral", "z": "vertical"}.items():
        for corner, place in corners.items():
            meaning = f"{direction} tyre force, {place}"
            rows.append(Channel(f"f{axis}_{corner}", "N", meaning, -2e5, 2e5))
    rows += [
        Channel(
            "vx_ref", "m/s", "reference forward velocity at the centre of gravity", -40.0, 140.0
        ),
        Channel(
            "vy_ref",
            "m/s",
            "reference lateral velocity at the centre of gravity, positive to the left",
            -40.0,
            40.0,
        ),
        Channel("yaw_rate_ref", "rad/s", "reference yaw rate", -8.0, 8.0),
        Channel(
            "sideslip_ref", "rad", "reference sideslip angle, atan2(vy, vx)", -math.pi, math.pi
        ),
    ]
    return {channel.name: channel for channel in rows}


CHANNELS: dict[str, Channel] = _table()  # canonical name -> channel


def channel(name: str) -> Channel:
    """Look up a channel.

    Raises
    ------
    DataError
        The name is not in the table.
    """
    if name not in CHANNELS:
        raise DataError(
            f"channel '{name}' is not known to vehest; known channels: "
            f"{', '.join(sorted(CHANNELS))}"
        )
    return CHANNELS[name]
