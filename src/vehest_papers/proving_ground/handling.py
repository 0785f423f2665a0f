"""The handling diagram: how much more a car is steered than the curvature needs without slip, over
its lateral acceleration.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehest.constants import GRAVITY, FloatArray
from vehest.data.recording import Recording
from vehest.simulation.plant.handling import ramp_steer
from vehest.simulation.plant.motion import Motion
from vehest.simulation.plant.multi_body import MultiBodyPlant
from vehest.simulation.plant.parameters import Vehicle, compiled_parameters

Counts = NDArray[np.int64]

AY_WIDTH = 0.5
AY_LIMIT = 14.0  # m/s²
ANGLE_WIDTH = 0.1
ANGLE_LIMIT = 10.0  # deg
AY_EDGES: FloatArray = np.arange(-AY_LIMIT, AY_LIMIT + AY_WIDTH / 2, AY_WIDTH)
ANGLE_EDGES: FloatArray = np.linspace(
    -ANGLE_LIMIT, ANGLE_LIMIT, round(2 * ANGLE_LIMIT / ANGLE_WIDTH) + 1
)

MIN_SPEED = 5.0  # speed from which on samples count [m/s]
STEADY_ACCELERATION = 1.0
STEADY_YAW = 0.1
SMOOTHING_SECONDS = 0.3
"""Steady is a turn with |ax|, |ay - vx·yaw rate| [m/s²] and the change of the yaw rate [rad/s²]
below, averaged over so long [s].
"""
MIN_SAMPLES = 50
RAMP_SPEED = 25.0
"""Of the slow ramp [m/s], or half the top speed if that is less: that at which the driver's
knowledge of the car was measured.
"""


def _no_samples() -> Counts:
    return np.zeros((len(AY_EDGES) - 1, len(ANGLE_EDGES) - 1), dtype=np.int64)


@dataclass
class HandlingPoints:
    """Samples of recordings over centripetal acceleration and understeer angle, (bins of ay, bins
    of angle); does not grow with them.

    ``wheelbase`` [m] is the car's.
    """

    wheelbase: float  # [m]
    moving: Counts = field(default_factory=_no_samples)  # all samples above `MIN_SPEED`
    steady: Counts = field(default_factory=_no_samples)  # those of quasi-steady turns

    def add(self, recording: Recording) -> None:
        """Count a recording in; it is to be about as free of noise as one at 20 Hz."""
        vx = recording["vx"]
        yaw_rate = recording["yaw_rate"]
        moving = vx > MIN_SPEED
        ay = vx * yaw_rate
        angle = np.degrees(
            recording["steer"] - np.arctan(self.wheelbase * yaw_rate / np.where(moving, vx, np.inf))
        )
        turning = (
            np.gradient(yaw_rate) * recording.rate_hz
            if len(yaw_rate) > 1
            else np.zeros_like(yaw_rate)
        )
        limited = (
            (recording["ax"], STEADY_ACCELERATION),
            (recording["ay"] - ay, STEADY_ACCELERATION),
            (turning, STEADY_YAW),
        )
        steady = np.logical_and.reduce(
            [
                moving,
                *(np.abs(_smooth(signal, recording.rate_hz)) < limit for signal, limit in limited),
            ]
        )
        for counts, mask in ((self.moving, moving), (self.steady, steady)):
            drawn, _, _ = np.histogram2d(ay[mask], angle[mask], bins=(AY_EDGES, ANGLE_EDGES))
            counts += drawn.astype(np.int64)

    def medians(self) -> tuple[FloatArray, FloatArray]:
        """Lateral acceleration and median understeer angle of quasi-steady turns, a point a bin of
        enough samples.
        """
        totals = self.steady.sum(axis=1)
        enough = totals >= MIN_SAMPLES
        above = np.cumsum(self.steady, axis=1) >= 0.5 * totals[:, None]
        centres = ANGLE_EDGES[:-1] + ANGLE_WIDTH / 2
        return (AY_EDGES[:-1] + AY_WIDTH / 2)[enough], centres[np.argmax(above, axis=1)][enough]


@dataclass(frozen=True, eq=False)
class Characteristic:
    """What the plant does in a slow ramp of the steering at constant speed, and what a linear
    single track would do.
    """

    label: str  # which car on which road
    speed: float  # of the ramp [m/s]
    ay: FloatArray  # centripetal acceleration, from the right to the left limit (M,) [m/s²]
    angle: FloatArray  # understeer angle there (M,) [deg]
    # of the linear single track with the tyres' cornering stiffness at static load [deg/(m/s²)]
    gradient: float


def vehicle_of(provenance: Mapping[str, Any], name: str) -> Vehicle:
    """The car of a simulated recording, from its provenance."""
    return Vehicle(name, int(provenance["parameter_set"]), provenance["overrides"])


def wheelbase_of(vehicle: Vehicle) -> float:
    """[m]."""
    parameters = compiled_parameters(vehicle)
    return float(parameters.a + parameters.b)


def characteristic(vehicle: Vehicle, friction: float, label: str) -> Characteristic:
    """Ramps to either side up to the largest lateral acceleration."""
    plant = MultiBodyPlant(vehicle)
    speed = min(RAMP_SPEED, 0.5 * float(plant.parameters.longitudinal.v_max))
    halves = []
    for direction in (-1.0, 1.0):
        ramp = ramp_steer(plant, speed, friction=friction, direction=direction)
        ay = ramp.vx * ramp.yaw_rate
        end = int(np.argmax(np.abs(ay))) + 1
        halves.append((ay[:end], np.degrees(understeer_angle(ramp, plant.wheelbase))[:end]))
    (right_ay, right_angle), (left_ay, left_angle) = halves
    ay = np.append(right_ay[::-1], left_ay)
    angle = np.append(right_angle[::-1], left_angle)
    return Characteristic(label, speed, ay, angle, single_track_gradient(vehicle))


def understeer_angle(motion: Motion, wheelbase: float) -> FloatArray:
    """Steering angle beyond that of the path's curvature without slip, positive in understeer to
    the left (T,) [rad].
    """
    return motion.steer - np.arctan(wheelbase * motion.yaw_rate / motion.vx)


def single_track_gradient(vehicle: Vehicle) -> float:
    """Understeer gradient of the linear single track [deg/(m/s²)].

    m (b/C_f - a/C_r)/L with axle stiffnesses C = -p_ky1 times the static load is (1/|p_ky1 front| -
    1/|p_ky1 rear|)/g.
    """
    parameters = compiled_parameters(vehicle)
    return float(
        np.degrees(
            (1.0 / abs(parameters.tire.p_ky1) - 1.0 / abs(parameters.tire_rear.p_ky1)) / GRAVITY
        )
    )


def _smooth(samples: FloatArray, rate_hz: float) -> FloatArray:
    """Moving average; the ends are averaged over what there is."""
    length = max(round(SMOOTHING_SECONDS * rate_hz), 1)
    if len(samples) < length:
        return np.full_like(samples, samples.mean())
    weights = np.ones(length)
    return np.convolve(samples, weights, mode="same") / np.convolve(
        np.ones_like(samples), weights, mode="same"
    )
