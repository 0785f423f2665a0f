"""What is proposed for a log, and what is left to be asked."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.units import factor_to_si


@dataclass(frozen=True)
class Proposal:
    """What a column is taken for.

    Args:
        column: its name in the log.
        channel: as `vehest data channels` lists it.
        unit: of the column, as vehest spells it.
        sign: 1, or -1 where it counts the other way round than ISO 8855.
        evidence: what speaks for it.
        asked: what the log does not decide; empty where it decides all of it.
        factor: what the column is multiplied by to be in ``unit``.
        offset: what the column shows at nil, in its own unit.
        others: channels or units that would do as well.
        delay: by how much it is late, as far as it is known [s].
        gappy: whether samples are missing.
    """

    column: str
    channel: str
    unit: str
    sign: int = 1
    evidence: tuple[str, ...] = ()
    asked: str = ""
    factor: float = 1.0
    offset: float = 0.0
    others: tuple[str, ...] = ()
    delay: float = 0.0
    gappy: bool = False

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
        told = CHANNELS[self.channel]
        samples = self.sign * self.factor * factor_to_si(self.unit, told.unit) * (values - self.offset)
        return np.asarray((samples < told.low) | (samples > told.high))

    def with_evidence(self, *more: str) -> Proposal:
        """The same with more of it."""
        return replace(self, evidence=(*self.evidence, *more))


@dataclass(frozen=True)
class Proposals:
    """What is proposed for a log.

    Args:
        channels: a column each.
        left_right: how it is known which way is left; empty where a log does not tell, and signs hold against each other only.
        wheel_radius: rolling radius that the wheels' speeds make with what the car does [m]; None where it is not needed.
        rate_hz: of a log without times, as far as accelerations tell [Hz]; None where it has times.
        unused: columns that belong to no channel.
        pose: part (``x``, ``y``, ``yaw``), column and unit of poses that a reference can be made of; empty where there are none.
        notes: what else should be known.
    """

    channels: tuple[Proposal, ...]
    left_right: str = ""
    wheel_radius: float | None = None
    rate_hz: float | None = None
    unused: tuple[str, ...] = ()
    pose: tuple[tuple[str, str, str], ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def by_channel(self) -> dict[str, Proposal]:
        """Channel -> its proposal."""
        return {proposal.channel: proposal for proposal in self.channels}

    def mirrored(self) -> Proposals:
        """The same for a car seen in a mirror: channels that know left and right count the other way."""
        turned = (replace(one, sign=-one.sign) if one.channel in LATERAL else one for one in self.channels)
        return replace(self, channels=tuple(turned))


LATERAL = frozenset({"yaw_rate", "ay", "steer", "handwheel", "vy_ref", "sideslip_ref", "yaw_rate_ref", "roll", "roll_rate"})
"""Channels whose sign depends on which way is left."""
