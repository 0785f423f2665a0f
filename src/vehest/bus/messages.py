"""Estimates as frames of a bus, and the DBC that describes them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vehest.data.errors import ConfigurationError, MissingError

FIRST_ID = 0x6F0
LAST_STANDARD_ID = 0x7FE

METRES, DEGREES, RADIANS = 0.0005, 0.0005, 0.0001
"""Resolution of speeds [m/s], angles [deg] and yaw rates [rad/s]: below 1 mm/s and 0.001 deg."""

COUNTS = 16
"""After how many estimates the alive counter begins anew."""

DBC = """VERSION ""

NS_ :

BS_:

BU_: Vehest Car

BO_ {estimate} VehestEstimate: 8 Vehest
 SG_ LateralVelocity : 0|20@1- (0.0005,0) [-262.1435|262.1435] "m/s" Car
 SG_ SideslipAngle : 20|20@1- (0.0005,0) [-262.1435|262.1435] "deg" Car
 SG_ YawRate : 40|18@1- (0.0001,0) [-13.1071|13.1071] "rad/s" Car
 SG_ Health : 58|2@1+ (1,0) [0|3] "" Car
 SG_ AliveCounter : 60|4@1+ (1,0) [0|15] "" Car

BO_ {band} VehestBand: 8 Vehest
 SG_ LateralVelocityBand : 0|20@1+ (0.0005,0) [0|524.287] "m/s" Car
 SG_ SideslipAngleBand : 20|20@1+ (0.0005,0) [0|524.287] "deg" Car
 SG_ HealthReason : 40|20@1+ (1,0) [0|1048575] "" Car
 SG_ BandAliveCounter : 60|4@1+ (1,0) [0|15] "" Car

CM_ "Estimates of lateral velocity and sideslip angle by vehest; signs of ISO 8855.";
CM_ BO_ {estimate} "A frame an estimate. The smallest raw value of a signal, of a width the largest, says that there is none.";
CM_ BO_ {band} "Half widths of the calibrated 90 % bands, sent after the estimate with the same counter.";
CM_ SG_ {estimate} YawRate "Where the method estimates one.";
CM_ SG_ {estimate} AliveCounter "One more with each estimate, modulo 16.";
CM_ SG_ {band} HealthReason "0: none; else ten thousands are the kind, hundreds the channel: vehest.reason_in_words says it.";
VAL_ {estimate} LateralVelocity -524288 "not available" ;
VAL_ {estimate} SideslipAngle -524288 "not available" ;
VAL_ {estimate} YawRate -131072 "not available" ;
VAL_ {estimate} Health 0 "valid" 1 "degraded" 2 "invalid" 3 "not available" ;
VAL_ {band} LateralVelocityBand 1048575 "not available" ;
VAL_ {band} SideslipAngleBand 1048575 "not available" ;
"""


@dataclass(frozen=True)
class Field:
    """A signal's place in its frame of 64 bits, least significant bit first.

    Args:
        start: its first bit.
        bits: how many it has.
        signed: whether it has a sign.
        resolution: what one step stands for.
    """

    start: int
    bits: int
    signed: bool
    resolution: float

    @property
    def absent(self) -> int:
        """Raw value that says that there is none."""
        return -(1 << self.bits - 1) if self.signed else (1 << self.bits) - 1

    def raw(self, value: float) -> int:
        """The nearest raw value, cut off at what the signal can hold; ``absent`` for NaN."""
        if math.isnan(value):
            return self.absent
        largest = (1 << self.bits - 1) - 1 if self.signed else (1 << self.bits) - 2
        smallest = -largest if self.signed else 0
        return min(max(round(min(max(value / self.resolution, -1e9), 1e9)), smallest), largest)

    def packed(self, raw: int) -> int:
        """The raw value where it stands in the frame."""
        return (raw & ((1 << self.bits) - 1)) << self.start


VELOCITY, ANGLE = Field(0, 20, True, METRES), Field(20, 20, True, DEGREES)
YAW_RATE, HEALTH, COUNTER = Field(40, 18, True, RADIANS), Field(58, 2, False, 1.0), Field(60, 4, False, 1.0)
VELOCITY_BAND, ANGLE_BAND = Field(0, 20, False, METRES), Field(20, 20, False, DEGREES)
REASON = Field(40, 20, False, 1.0)


def dbc_text(first_id: int = FIRST_ID) -> str:
    """The DBC of vehest's two messages, which have two identifiers one after the other.

    Raises:
        ConfigurationError: they are no standard identifiers.
    """
    check_id(first_id)
    return DBC.format(estimate=first_id, band=first_id + 1)


def check_id(first_id: int) -> None:
    """See that two standard identifiers begin here.

    Raises:
        ConfigurationError: they do not.
    """
    if not 0 < first_id <= LAST_STANDARD_ID:
        raise ConfigurationError(f"the identifier of estimates must lie between 0x1 and {LAST_STANDARD_ID:#x}, not {first_id:#x}")


class EstimateFrames:
    """Writes estimates as frames.

    Args:
        first_id: identifier of the estimate; that of its bands is the next one.

    Raises:
        ConfigurationError: it is none.
        MissingError: python-can is not installed.
    """

    def __init__(self, first_id: int = FIRST_ID) -> None:
        check_id(first_id)
        try:
            from can import Message
        except ImportError:
            raise MissingError("CAN needs the packages python-can and cantools; pip install 'vehest[bus]'") from None
        self._message: Any = Message
        self.first_id, self._count = first_id, 0

    def __call__(self, said: Mapping[str, float], stamp: float) -> tuple[Any, Any]:
        """The frames of an estimate as `vehest.trust.contract.GuardedStepper.step` returns it, stamped [s]."""
        count = self._count
        self._count = (count + 1) % COUNTS
        first, second = payloads(said, count)
        return (
            self._message(stamp, self.first_id, False, data=first),
            self._message(stamp, self.first_id + 1, False, data=second),
        )


def payloads(said: Mapping[str, float], count: int) -> tuple[bytes, bytes]:
    """The eight bytes of an estimate, and those of its bands.

    Args:
        said: ``vy`` [m/s], ``sideslip`` [rad] and what else there is; angles are sent in degrees.
        count: of the alive counter.
    """
    nothing = math.nan
    estimate = (
        VELOCITY.packed(VELOCITY.raw(said.get("vy", nothing)))
        | ANGLE.packed(ANGLE.raw(math.degrees(said.get("sideslip", nothing))))
        | YAW_RATE.packed(YAW_RATE.raw(said.get("yaw_rate", nothing)))
        | HEALTH.packed(int(said["health"]) if "health" in said else 3)
        | COUNTER.packed(count)
    )
    band = (
        VELOCITY_BAND.packed(VELOCITY_BAND.raw(said.get("band_vy", nothing)))
        | ANGLE_BAND.packed(ANGLE_BAND.raw(math.degrees(said.get("band_sideslip", nothing))))
        | REASON.packed(int(said.get("health_reason", 0.0)))
        | COUNTER.packed(count)
    )
    return estimate.to_bytes(8, "little"), band.to_bytes(8, "little")
