"""How well a column agrees with the motion that is known so far, by the relations that recordings are checked with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vehest.alignment.motion import Motion
from vehest.alignment.proposals.columns import Candidate
from vehest.alignment.signs import Relation, relations_of
from vehest.constants import FloatArray
from vehest.data.units import factor_to_si

STANDING = 0.02  # of the top speed; below, the car may stand
ROAD_WHEEL, HAND_WHEEL = "steer", "handwheel"
LARGEST = {ROAD_WHEEL: 0.8, HAND_WHEEL: 16.0}  # rad
STRAIGHT_AHEAD = 0.1  # rad that a road wheel may show there, of an angle
LENGTHS = {ROAD_WHEEL: (1.2, 7.0), HAND_WHEEL: (12.0, 130.0)}  # m, wheelbase, and that times the ratio, of cars
SMALL = 0.08  # m, wheelbase of the smallest model
FASTEST_MODEL = 20.0  # m/s


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of the motion, in SI units and with ay = +vx·yaw_rate.

    Args:
        rate_hz: of the samples.
        vx: forward speed, (T,).
        yaw_rate: (T,).
        ay: (T,); empty where there is none.
    """

    rate_hz: float
    vx: FloatArray
    yaw_rate: FloatArray
    ay: FloatArray

    def motion(self, **more: FloatArray) -> Motion:
        """With further channels."""
        channels = {"vx": self.vx, **({"yaw_rate": self.yaw_rate} if len(self.yaw_rate) else {})}
        channels |= {"ay": self.ay} if len(self.ay) else {}
        channels |= more
        velocity = next((name for name in ("vy_ref", "sideslip_ref") if name in more), "")
        moving = np.abs(self.vx) > STANDING * float(np.quantile(np.abs(self.vx), 0.99))
        return Motion(self.rate_hz, channels, "vx", velocity, moving)


@dataclass(frozen=True)
class Agreement:
    """How a column in some unit agrees.

    Args:
        channel: that it would be.
        unit: of the column.
        relation: that was compared; None where nothing could be, or hardly anything was common.
    """

    channel: str
    unit: str
    relation: Relation | None

    @property
    def strength(self) -> float:
        """Absolute correlation; 0 where there is no relation."""
        return abs(self.relation.correlation) if self.relation else 0.0

    @property
    def sign(self) -> int:
        """Of the correlation."""
        return -1 if self.relation and self.relation.correlation < 0.0 else 1

    @property
    def mismatch(self) -> float:
        """Logarithm of a scale that should be 1."""
        return abs(math.log(abs(self.relation.scale))) if self.relation else math.inf

    @property
    def in_words(self) -> str:
        """For people; the scale where it must be 1."""
        if self.relation is None:
            return ""
        scale = f", {abs(self.relation.scale):.3g} times as large" if math.isfinite(self.relation.tolerance) else ""
        return f"{self.relation.left} and {self.relation.right} agree {self.relation.correlation:.2f}{scale}"


def longitudinal(known: Known, column: Candidate, units: Sequence[str]) -> list[Agreement]:
    """A column as ``ax``, in each unit, the best first."""
    found = [_agreement(known, column, "ax", unit, "m/s²", "ax") for unit in units]
    return sorted(found, key=lambda one: one.mismatch)


def lateral(known: Known, column: Candidate, kinds: Sequence[tuple[str, str, str]]) -> list[Agreement]:
    """A column as lateral velocity or sideslip angle, the best first.

    Args:
        known: the motion.
        column: to be looked at.
        kinds: channel, unit and SI unit to try.
    """
    if not len(known.ay):
        return [Agreement(channel, unit, None) for channel, unit, _ in kinds]
    found = [_agreement(known, column, channel, unit, si, f"d({channel})/dt") for channel, unit, si in kinds]
    return sorted(found, key=lambda one: 0.3 * one.mismatch - 2.0 * one.strength)


def steering(known: Known, column: Candidate) -> Agreement:
    """A column as an angle of steering in whatever unit."""
    return _agreement(known, column, ROAD_WHEEL, "rad", "rad", ROAD_WHEEL, offset=float(np.median(column.values)))


def _agreement(known: Known, column: Candidate, channel: str, unit: str, si: str, left: str, *, offset: float = 0.0) -> Agreement:
    samples = (column.values - offset) * factor_to_si(unit, si)
    with np.errstate(all="ignore"):
        relations = relations_of(known.motion(**{channel: samples}))
    return Agreement(channel, unit, next((one for one in relations if one.left == left), None))


@dataclass(frozen=True)
class Angle:
    """What an angle of steering could be.

    Args:
        channel: ``steer`` or ``handwheel``.
        unit: of the column.
        length: wheelbase, or that times the steering ratio, by slow cornering [m].
        largest: angle, straight ahead taken off [rad].
        offset: shown straight ahead, in the column's unit.
    """

    channel: str
    unit: str
    length: float
    largest: float
    offset: float

    @property
    def in_words(self) -> str:
        """For people."""
        what = "a wheelbase" if self.channel == ROAD_WHEEL else "wheelbase times ratio"
        return f"up to {math.degrees(self.largest):.3g}°, and {what} of {self.length:.3g} m by slow corners"


def angles(known: Known, column: Candidate, units: Sequence[str]) -> list[Angle]:
    """What range and slow corners leave of road wheel or steering wheel, in each unit, by angle = length·yaw_rate/vx + K·ay + offset."""
    moving = known.motion().moving & (known.vx > 0.2 * float(np.quantile(known.vx, 0.99)))
    ay = known.ay if len(known.ay) else known.vx * known.yaw_rate
    calm = moving & (np.abs(ay) <= 0.5 * float(np.quantile(np.abs(ay), 0.95)) + 1e-9)
    if calm.sum() < 100:
        calm = moving
    rows = np.stack([known.yaw_rate[calm] / known.vx[calm], ay[calm], np.ones(int(calm.sum()))], axis=1)
    slope, _, offset = np.linalg.lstsq(rows, column.values[calm], rcond=None)[0].tolist()
    slow = bool(np.quantile(known.vx, 0.99) < FASTEST_MODEL)
    found = []
    for channel in (ROAD_WHEEL, HAND_WHEEL):
        for unit in units:
            factor = factor_to_si(unit, "rad")
            largest = float(np.quantile(np.abs(column.values - offset), 0.995)) * factor
            low, high = LENGTHS[channel]
            low = SMALL if slow and channel == ROAD_WHEEL else low
            angle = Angle(channel, unit, abs(slope) * factor, largest, offset)
            straight = channel == HAND_WHEEL or abs(offset) * factor < STRAIGHT_AHEAD
            if low <= angle.length <= high and largest <= LARGEST[channel] and straight:
                found.append(angle)
    return found


def slope_of_steering(known: Known, column: Candidate) -> tuple[float, float]:
    """What a column shows for a unit of yaw_rate/vx [column's unit · m], and straight ahead [column's unit]."""
    moving = known.motion().moving & (known.vx > 0.2 * float(np.quantile(known.vx, 0.99)))
    rows = np.stack([known.yaw_rate[moving] / known.vx[moving], np.ones(int(moving.sum()))], axis=1)
    slope, offset = np.linalg.lstsq(rows, column.values[moving], rcond=None)[0].tolist()
    return slope, offset
