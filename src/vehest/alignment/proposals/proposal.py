"""Proposals of channels for the columns of a log, with open questions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.units import factor_to_si

LATERAL = frozenset(
    {
        "yaw_rate",
        "ay",
        "steer",
        "handwheel",
        "vy_ref",
        "sideslip_ref",
        "yaw_rate_ref",
    }
)
"""Channels whose sign depends on which way is left."""
TILT = {"roll": "ax", "roll_rate": "ax", "pitch": "ay", "pitch_rate": "ay"}
"""Channel of a rotation -> the acceleration along its axis."""


@dataclass(frozen=True)
class Proposal:
    """Channel of a column."""

    column: str  # its name in the log
    channel: str  # as `vehest data channels` lists it
    unit: str  # of the column, as vehest spells it
    sign: int = 1  # -1 where it counts the other way round than ISO 8855
    evidence: tuple[str, ...] = ()  # for people
    asked: str = ""  # question that the log leaves open; empty where it decides all
    factor: float = 1.0  # by which the column is multiplied to be in ``unit``
    offset: float = 0.0  # value of the column at zero, in its own unit
    others: tuple[str, ...] = ()  # channels or units that would do as well
    delay: float = 0.0  # by which it is late, as far as it is known [s]
    is_weak: bool = (
        False  # whether one piece of evidence is all: left out unless an answer takes it
    )

    @property
    def in_words(self) -> str:
        """For example ``yaw_rate: column Gyro, deg/s, sign -1: ay/vx agrees 0.97``."""
        parts = [f"column {self.column}", self.unit]
        parts += [f"sign {self.sign}"] if self.sign != 1 else []
        parts += [f"factor {self.factor:.5g}"] if self.factor != 1.0 else []
        parts += [f"less {self.offset:.4g}"] if self.offset else []
        return f"{self.channel}: {', '.join(parts)}: {'; '.join(self.evidence) or 'nothing but the order of columns'}"

    def beyond(self, values: FloatArray) -> NDArray[np.bool_]:
        """Which values of the column no vehicle can have, (T,)."""
        channel = CHANNELS[self.channel]
        samples = (
            self.sign * self.factor * factor_to_si(self.unit, channel.unit) * (values - self.offset)
        )
        return np.asarray((samples < channel.low) | (samples > channel.high))

    def with_evidence(self, *more: str) -> Proposal:
        """The same with more of it."""
        return replace(self, evidence=(*self.evidence, *more))


@dataclass(frozen=True)
class Proposals:
    """Proposals for a log."""

    channels: tuple[Proposal, ...]
    left_right: str = ""  # evidence of which way is left; empty where a log has none, and signs hold against each other only
    wheel_radius: float | None = (
        None  # rolling radius by which the wheels make the speed [m]; None where the speed has a column
    )
    rate_hz: float | None = (
        None  # of a log without times, as far as accelerations decide it [Hz]; None where it has times
    )
    unused: tuple[str, ...] = ()  # columns that belong to no channel
    pose: tuple[
        tuple[str, str, str], ...
    ] = ()  # part (``x``, ``y``, ``yaw``), column and unit, of which a reference can be made
    notes: tuple[str, ...] = ()  # further remarks

    @property
    def by_channel(self) -> dict[str, Proposal]:
        """Channel -> its proposal."""
        return {proposal.channel: proposal for proposal in self.channels}

    def keeping(self, channels: Sequence[Proposal], notes: Sequence[str] = ()) -> Proposals:
        """The same with these of its channels and further remarks; a radius stays only beside a wheel's speed."""
        radius = (
            self.wheel_radius
            if any(one.channel.startswith("wheel_speed") for one in channels)
            else None
        )
        return replace(
            self, channels=tuple(channels), wheel_radius=radius, notes=(*self.notes, *notes)
        )

    def mirrored(self) -> Proposals:
        """The same for a car seen in a mirror: signs of `LATERAL` channels and of pitch reversed."""
        turned = (
            replace(one, sign=-one.sign)
            if one.channel in LATERAL or TILT.get(one.channel) == "ay"
            else one
            for one in self.channels
        )
        return replace(self, channels=tuple(turned))

    def with_tilt_signs(self) -> Proposals:
        """The same with the signs of roll and pitch by the axes that other channels reveal.

        Roll counts about the axis of ax, pitch about that of ay; asked unless ax, ay and the yaw
        rate are along the axes of one right-handed set, as forward-left-up or forward-right-down.
        """
        signs = {name: one.sign for name, one in self.by_channel.items()}
        axes = [signs.get("ax", signs.get("vx")), signs.get("ay"), signs.get("yaw_rate")]
        axis_signs = [sign for sign in axes if sign is not None]
        is_right_handed = len(axis_signs) == len(axes) and math.prod(axis_signs) == 1
        doubt = (
            ""
            if is_right_handed
            else "sign: ax, ay and yaw_rate reveal no right-handed set of axes"
        )
        changed = [
            replace(
                one, sign=signs.get(TILT[one.channel], 1), asked=one.asked or doubt
            ).with_evidence("sign by the axes of ax, ay and yaw_rate")
            if one.channel in TILT
            else one
            for one in self.channels
        ]
        return replace(self, channels=tuple(changed))
