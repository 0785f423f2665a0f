"""Steady-state handling of a vehicle: a slow ramp of the steering angle at constant speed."""

from __future__ import annotations

import numpy as np

from vehest.constants import FloatArray
from vehest.simulation.errors import SimulationError
from vehest.simulation.plant.motion import Motion
from vehest.simulation.plant.multi_body import MultiBodyPlant, PlantState

RATE_HZ = 50.0  # Hz, rate of commands and of the motion
AY_RATE = 0.5  # rate at which the lateral acceleration of a neutral car would grow, m/s³
MAX_SECONDS = 60.0  # s, longest ramp


def ramp_steer(
    plant: MultiBodyPlant, speed: float, *, friction: float = 1.0, direction: float = 1.0
) -> Motion:
    """Motion at constant speed under a slowly growing steering angle, at 50 Hz.

    It ends where the lateral acceleration has fallen by 3 % from its largest value, or the car
    spins or rolls over. Towards the limit, where the lateral acceleration hardly grows any more,
    the steering angle grows up to ten times faster.

    Parameters
    ----------
    plant : MultiBodyPlant
        The car.
    speed : float
        Forward speed that a controller keeps [m/s].
    friction : float
        Scale of the tyres' friction.
    direction : float
        1: to the left, -1: to the right.

    Returns
    -------
    Motion
        (T,) at 50 Hz, at most MAX_SECONDS long; the car starts in equilibrium, straight ahead.
    """
    steering_velocity = direction * AY_RATE * plant.wheelbase / speed**2 * max(1.0, speed / 15.0)
    state = plant.initial_state(0.0, 0.0, 0.0, speed)
    per_sample = round(1.0 / (RATE_HZ * plant.step))
    states: list[PlantState] = []
    inputs: list[FloatArray] = []
    integral = largest = 0.0
    for _ in range(round(MAX_SECONDS * RATE_HZ)):
        now = abs(state.vx * state.yaw_rate)
        error = speed - state.vx
        integral += error / RATE_HZ
        spare = max(1.0 - (now / (friction * plant.grip)) ** 2, 0.1)
        command = np.array([steering_velocity / spare, 3.0 * error + 2.0 * integral, 0.0, 0.0, 0.0])
        states.append(state)
        inputs.append(command)
        largest = max(largest, now)
        if now < 0.97 * largest or state.spun:
            break
        try:
            state = plant.advance(state, command, per_sample, friction)
        except SimulationError:  # a rollover ends it too
            break
    return plant.motion(states, np.array(inputs), RATE_HZ, friction=friction)
