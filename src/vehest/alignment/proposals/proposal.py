"""Proposals of channels for the columns of a log, with open questions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehest.alignment.proposals.columns import stray_samples
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
    """Proposal that a column is a channel."""

    column: str  # name of the column in the log
    channel: str  # channel, as `vehest data channels` lists it
    unit: str  # unit of the column, as vehest spells it
    sign: int = 1  # -1 where its positive direction is opposite to ISO 8855
    evidence: tuple[str, ...] = ()  # pieces of evidence, for people
    question: str = ""  # question that the log leaves open; empty where it decides all
    factor: float = 1.0  # factor that brings the column to ``unit``
    offset: float = 0.0  # value of the column at zero, in its own unit
    alternatives: tuple[str, ...] = ()  # channels, units or columns that fit equally well
    delay: float = 0.0  # time by which the column is late, as far as it is known [s]
    is_weak: bool = False  # whether this proposal is left out unless an answer confirms it
    is_by_name: bool = False  # whether its name is all that supports it, and no relation to others
    is_repeated: bool = False  # whether another column measures the same

    def describe(self) -> str:
        """Text such as ``yaw_rate: column 'Gyro', deg/s, sign -1: name and unit``."""
        parts = [f"column '{self.column}'", self.unit]
        parts += [f"sign {self.sign}"] if self.sign != 1 else []
        parts += [f"factor {self.factor:.5g}"] if self.factor != 1.0 else []
        parts += [f"zero at {self.offset:.4g}"] if self.offset else []
        return f"{self.channel}: {', '.join(parts)}: {'; '.join(self.evidence)}"

    def as_plain(self) -> dict[str, Any]:
        """Fields as plain values, for JSON.

        Returns
        -------
        dict
            Field -> value; ``question`` is called ``asked`` (None where there is none),
            ``alternatives`` ``others``.
        """
        plain = asdict(self)
        plain["asked"] = plain.pop("question") or None
        plain["others"] = plain.pop("alternatives")
        return plain

    def is_impossible(self, values: FloatArray) -> NDArray[np.bool_]:
        """Whether values of the column are such as no vehicle can have, (T,), stray ones apart.

        Parameters
        ----------
        values : FloatArray
            (T,), as the column has them; NaN is not impossible.
        """
        channel = CHANNELS[self.channel]
        samples = self.si(values)
        impossible = (samples < channel.low) | (samples > channel.high)
        measured = np.isfinite(samples)
        if impossible[measured].any():
            impossible[measured] &= ~stray_samples(samples[measured])
        return np.asarray(impossible)

    def si(self, values: FloatArray) -> FloatArray:
        """Samples of the channel, (T,), of values as the column has them, (T,)."""
        factor = self.sign * self.factor * factor_to_si(self.unit, CHANNELS[self.channel].unit)
        return np.asarray(factor * (values - self.offset))

    def with_evidence(self, *evidence: str) -> Proposal:
        """The proposal with further evidence."""
        return replace(self, evidence=(*self.evidence, *evidence))

    def questioned(self, question: str) -> Proposal:
        """The proposal with a question, unless it has one already."""
        return replace(self, question=self.question or question)

    def merged_with(self, earlier: Proposal | None) -> Proposal:
        """The proposal with the evidence and questions of an earlier one for this column."""
        if earlier is None or earlier.column != self.column:
            return self
        return replace(
            self,
            evidence=(*earlier.evidence, *self.evidence),
            question=self.question or earlier.question,
            alternatives=self.alternatives or earlier.alternatives,
        )


@dataclass(frozen=True)
class Proposals:
    """Proposals for a log."""

    channels: tuple[Proposal, ...]  # proposals of channels
    # evidence by which left and right are told apart; empty where the log has none
    left_right: str = ""
    # rolling radius by which vx is made from the wheels [m]; None where vx has a column
    wheel_radius: float | None = None
    # rate of a log without times, by the accelerations [Hz]; else None
    rate_hz: float | None = None
    unused: tuple[str, ...] = ()  # columns that belong to no channel
    pose: tuple[tuple[str, str, str], ...] = ()  # part (``x``, ``y``, ``yaw``), column and unit
    notes: tuple[str, ...] = ()  # further remarks

    @property
    def by_channel(self) -> dict[str, Proposal]:
        """Channel -> its proposal."""
        return {proposal.channel: proposal for proposal in self.channels}

    def with_notes(self, *notes: str) -> Proposals:
        """The proposals with further remarks."""
        return replace(self, notes=(*self.notes, *notes))

    def changed(self, changes: Mapping[str, Proposal]) -> Proposals:
        """The proposals with others for some channels."""
        channels = tuple(changes.get(proposal.channel, proposal) for proposal in self.channels)
        return replace(self, channels=channels)

    def keeping(self, channels: Sequence[Proposal], notes: Sequence[str] = ()) -> Proposals:
        """Only these of the proposals, with further remarks.

        A radius stays only with a wheel's speed.
        """
        has_wheel = any(proposal.channel.startswith("wheel_speed") for proposal in channels)
        radius = self.wheel_radius if has_wheel else None
        return replace(self, channels=tuple(channels), wheel_radius=radius).with_notes(*notes)

    def mirrored(self) -> Proposals:
        """The proposals for a mirrored car: signs of `LATERAL` channels and of pitch reversed.

        A log alone cannot tell a car from its mirror image: all relations between its channels stay
        true if every lateral sign is reversed.
        """
        return self.changed(
            {
                proposal.channel: replace(proposal, sign=-proposal.sign)
                for proposal in self.channels
                if proposal.channel in LATERAL or TILT.get(proposal.channel) == "ay"
            }
        )

    def with_tilt_signs(self) -> Proposals:
        """The proposals with the signs of roll and pitch by the axes that other channels reveal.

        Roll counts about the axis of ax, pitch about that of ay; a question unless ax, ay and the
        yaw rate are along the axes of one right-handed set, as forward-left-up or
        forward-right-down, and unless ax counts ahead: else the unit is mounted backwards, or its
        accelerations alone are reversed, as those of telephones are.
        """
        signs = {name: proposal.sign for name, proposal in self.by_channel.items()}
        axes = [signs.get("ax", signs.get("vx", 0)), signs.get("ay", 0), signs.get("yaw_rate", 0)]
        is_right_handed = math.prod(axes) == 1
        doubt = "sign: ax, ay and yaw_rate do not form a right-handed set of axes"
        if is_right_handed and axes[0] == -1:
            is_right_handed = False
            doubt = "sign: the unit is mounted backwards, or only its accelerations are reversed"
        changes = {}
        for name, acceleration in TILT.items():
            if name in signs:
                signed = replace(self.by_channel[name], sign=signs.get(acceleration, 1))
                signed = signed.with_evidence("sign from the axes of ax, ay and yaw_rate")
                changes[name] = signed.questioned("" if is_right_handed else doubt)
        return self.changed(changes)
