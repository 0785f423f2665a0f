"""The plant: CommonRoad's multi-body car, integrated with a fixed step.

Source of the equations: Althoff and Würsching, "CommonRoad: Vehicle Models", 2020, the multi-body model of 29 states
with suspension, load transfer and combined-slip tyres. The library's vertical axis points down, so that a positive yaw
rate speeds up the wheels it calls left. Read as a mirror image, the equations are those of a car in ISO 8855 axes:
steering, yaw and lateral quantities keep their sign, left and right wheels change places, roll and pitch change sign.

The tyre formulas jump where camber changes sign (by about 4 % of the wheel load, laterally), so the integration converges
to first order there and to fourth order elsewhere. On a straight the lateral acceleration therefore has small steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from vehiclemodels.init_mb import init_mb

from vehest.data.errors import ConfigurationError
from vehest.simulation import compiled
from vehest.simulation.errors import SimulationError
from vehest.simulation.motion import Motion
from vehest.simulation.parameters import Vehicle, compiled_parameters, library_parameters

FloatArray = NDArray[np.float64]

# Places in the library's state vector.
POSITION_X, POSITION_Y, STEER, VX, YAW, YAW_RATE, ROLL, PITCH, VY = 0, 1, 2, 3, 4, 5, 6, 8, 10
FIRST_WHEEL = 23  # of four: what the library calls left front, right front, left rear, right rear
N_STATES = 29

SLOWEST_STEP_PER_SPEED = 0.55e-3
"""Largest stable Runge-Kutta step per forward speed [s per m/s].

The wheels' slip dynamics are the fastest: their eigenvalue is about -4700/vx [1/s] for the BMW 320i, and the method is
stable down to -2.785/step. At speed the compliant joints take over at about -250/s, far from the limit.
"""


@dataclass(frozen=True)
class MultiBodyPlant:
    """A vehicle and the step it is integrated with.

    A state is an array of shape (29,) in the library's order, inputs are an array of shape (2,): steering velocity of
    the front wheels [rad/s] and wanted longitudinal acceleration [m/s²], both limited by the vehicle's own limits.

    Args:
        vehicle: the car.
        step: integration step [s].

    Raises:
        ConfigurationError: the step is not positive.
    """

    vehicle: Vehicle
    step: float = 1e-3

    def __post_init__(self) -> None:
        if not self.step > 0:
            raise ConfigurationError(f"the plant's step must be positive, not {self.step} s")

    @cached_property
    def _parameters(self) -> Any:
        return compiled_parameters(self.vehicle)

    @property
    def wheelbase(self) -> float:
        """Distance between the axles [m]."""
        return float(self._parameters.a + self._parameters.b)

    @property
    def slowest_speed(self) -> float:
        """Forward speed below which the step would no longer be stable [m/s]."""
        return self.step / SLOWEST_STEP_PER_SPEED

    def initial_state(self, x: float, y: float, yaw: float, vx: float) -> FloatArray:
        """Rolling straight ahead at the given place [m], heading [rad] and speed [m/s]."""
        return np.array(init_mb([x, y, 0.0, vx, yaw, 0.0, 0.0], library_parameters(self.vehicle)), dtype=np.float64)

    def derivative(self, state: FloatArray, inputs: FloatArray) -> FloatArray:
        """Time derivative of the state, shape (29,)."""
        return compiled.derivative(state, inputs, self._parameters)

    def advance(self, state: FloatArray, inputs: FloatArray, n_steps: int) -> FloatArray:
        """The state ``n_steps`` steps later, inputs held; shape (29,).

        Raises:
            SimulationError: the car spun or became too slow for the step, or a state is not finite (a rollover, as a rule).
        """
        after = compiled.advance(state, inputs, self._parameters, self.step, n_steps)
        if not np.isfinite(after).all():
            raise SimulationError(
                f"vehicle '{self.vehicle.name}' left the range of its equations at {_describe(state)}: it rolled over or "
                f"spun; lower the grip fraction or the centre of gravity (h_s), or stiffen roll (K_tsf, K_tsr)"
            )
        if after[VX] < self.slowest_speed:
            raise SimulationError(
                f"vehicle '{self.vehicle.name}' spun or slowed to vx = {after[VX]:.3g} m/s; steps of {self.step:g} s are stable "
                f"from {self.slowest_speed:.3g} m/s: lower the grip fraction, or choose a smaller step"
            )
        return after

    def motion(self, states: FloatArray, derivatives: FloatArray, rate_hz: float) -> Motion:
        """States (T, 29) and their derivatives (T, 29), sampled at ``rate_hz``, as motion in ISO 8855 axes."""
        vx, vy, yaw_rate = states[:, VX], states[:, VY], states[:, YAW_RATE]
        wheel = FIRST_WHEEL
        return Motion(
            rate_hz=rate_hz,
            x=states[:, POSITION_X],
            y=states[:, POSITION_Y],
            yaw=states[:, YAW],
            vx=vx,
            vy=vy,
            yaw_rate=yaw_rate,
            ax=derivatives[:, VX] - vy * yaw_rate,
            ay=derivatives[:, VY] + vx * yaw_rate,
            steer=states[:, STEER],
            roll=-states[:, ROLL],
            pitch=-states[:, PITCH],
            wheel_speed_fl=states[:, wheel + 1],
            wheel_speed_fr=states[:, wheel],
            wheel_speed_rl=states[:, wheel + 3],
            wheel_speed_rr=states[:, wheel + 2],
        )


def _describe(state: FloatArray) -> str:
    return (
        f"vx = {state[VX]:.3g} m/s, vy = {state[VY]:.3g} m/s, yaw rate = {state[YAW_RATE]:.3g} rad/s, "
        f"roll = {-state[ROLL]:.3g} rad, steer = {state[STEER]:.3g} rad"
    )
