"""Estimates as frames of a bus, and the DBC that describes them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from vehest.data.errors import ConfigurationError
from vehest.sources.limited import require_package

FIRST_ID = 0x6F0  # default identifier of the estimates; the bands have the next one
# highest identifier of the estimates: that of the bands, 0x7FF, is the last of 11 bits
MAX_FIRST_ID = 0x7FE

COUNTS = 16  # values of the alive counter, after which it begins anew

# text of the DBC, with places for both identifiers
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
CM_ BO_ {estimate} "A frame an estimate. \
The smallest raw value of a signal, of a width the largest, says that there is none.";
CM_ BO_ {band} "Half widths of the calibrated 90 % bands, \
sent after the estimate with the same counter.";
CM_ SG_ {estimate} YawRate "Where the method estimates one.";
CM_ SG_ {estimate} AliveCounter "One more with each estimate, modulo 16.";
CM_ SG_ {band} HealthReason "0: none; else ten thousands are the kind, \
hundreds the channel: vehest.reason_in_words says it.";
VAL_ {estimate} LateralVelocity -524288 "not available" ;
VAL_ {estimate} SideslipAngle -524288 "not available" ;
VAL_ {estimate} YawRate -131072 "not available" ;
VAL_ {estimate} Health 0 "valid" 1 "degraded" 2 "invalid" 3 "not available" ;
VAL_ {band} LateralVelocityBand 1048575 "not available" ;
VAL_ {band} SideslipAngleBand 1048575 "not available" ;
"""


def dbc_text(first_id: int = FIRST_ID) -> str:
    """The DBC of vehest's two messages, whose identifiers follow each other.

    Parameters
    ----------
    first_id : int
        Standard identifier (11 bits) of the estimates; the bands have the next one.

    Raises
    ------
    ConfigurationError
        They are no standard identifiers.
    """
    if not 0 < first_id <= MAX_FIRST_ID:
        raise ConfigurationError(
            f"the identifier of estimates must lie between 0x1 and {MAX_FIRST_ID:#x}, not "
            f"{first_id:#x}"
        )
    return DBC.format(estimate=first_id, band=first_id + 1)


class EstimateFrames:
    """Writes estimates as frames; the identifier of the bands is the next one after ``first_id``.

    Raises `ConfigurationError`: it is no standard identifier. Raises `MissingError`: python-can or
    cantools is not installed.
    """

    def __init__(self, first_id: int = FIRST_ID) -> None:
        text = dbc_text(first_id)
        for package in ("can", "cantools"):
            require_package(package, "bus", "CAN")
        from can import Message
        from cantools.database import load_string

        self.identifiers = (first_id, first_id + 1)
        self._frame: Any = Message
        self._messages: Any = load_string(text, "dbc").messages
        self._count = 0

    def __call__(self, values: Mapping[str, float], stamp: float) -> list[Any]:
        """The two frames of an estimate as `vehest.trust.contract.GuardedStepper.step` returns it,
        stamped [s]; angles are in degrees.

        Parameters
        ----------
        values : mapping
            Quantity -> value in SI units; missing ones are sent as not available.
        stamp : float
            Of both frames [s].

        Returns
        -------
        list of can.Message
            Estimate and bands, with the same alive counter, which goes up by one with each call.
        """
        named = {
            "LateralVelocity": values.get("vy", math.nan),
            "SideslipAngle": math.degrees(values.get("sideslip", math.nan)),
            "YawRate": values.get("yaw_rate", math.nan),
            "Health": values.get("health", math.nan),
            "LateralVelocityBand": values.get("band_vy", math.nan),
            "SideslipAngleBand": math.degrees(values.get("band_sideslip", math.nan)),
            "HealthReason": values.get("health_reason", 0.0),
        }
        counters = dict.fromkeys(("AliveCounter", "BandAliveCounter"), self._count)
        self._count = (self._count + 1) % COUNTS
        frames = []
        for message in self._messages:
            raw = {
                signal.name: counters[signal.name]
                if signal.name in counters
                else raw_value(named[signal.name], signal)
                for signal in message.signals
            }
            data = message.encode(raw, scaling=False, strict=False)
            frames.append(self._frame(stamp, message.frame_id, False, data=data))
        return frames


def raw_value(value: float, signal: Any) -> int:
    """The nearest raw value of a signal of cantools, cut off at what it can hold.

    For NaN the one that says that there is none.

    Parameters
    ----------
    value : float
        In the signal's unit.
    signal : cantools.database.Signal
        With scale, length and whether it is signed; its offset is zero.

    Returns
    -------
    int
        The smallest raw value of a signed signal, and the largest of an unsigned one, are kept for
        NaN.
    """
    largest = (1 << signal.length - signal.is_signed) - 1
    if math.isnan(value):
        return -largest - 1 if signal.is_signed else largest
    steps = round(min(max(value / signal.scale, -1e9), 1e9))
    return (
        min(max(steps, -largest), largest) if signal.is_signed else min(max(steps, 0), largest - 1)
    )
