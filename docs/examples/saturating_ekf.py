"""Extended Kalman filter on a model of one's own: a single track whose axles saturate; compiled, Jacobians by complex step.

    m(dv/dt + uω) = F_f + F_r,   J dω/dt = l_f F_f - l_r F_r,   F = μF_z tanh(Cα/(μF_z)),   a_y = (F_f + F_r)/m

Slip angles α_f = δ - atan((v + l_fω)/u), α_r = -atan((v - l_rω)/u); F_z is the axle's static load, u at least 3 m/s. States v, ω; measured
are a_y and ω; forward Euler. Filter: Jazwinski 1970, Chapter 8, as `vehest.filters.extended_scan`.
"""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
from numba import njit

from vehest.constants import GRAVITY
from vehest.declared import fitted, setting
from vehest.estimators.base import FitRecord
from vehest.estimators.recursive import Recursive
from vehest.filters.extended_scan import CompiledModel, extended_scan, with_jacobian
from vehest.filters.gaussian import Gaussian
from vehest.vehicle.parameters import FERRARI_250LM, SingleTrackParameters


@njit
def accelerations(state, inputs, p):
    """Lateral [m/s²] and about the vertical axis [rad/s²] at (v, ω) and (u, δ); parameters as in `SaturatingEkf.model`."""
    mass, inertia, front_arm, rear_arm, front_stiffness, rear_stiffness, friction = p[0], p[1], p[2], p[3], p[4], p[5], p[6]
    speed, load = max(inputs[0], 3.0), friction * mass * GRAVITY / (front_arm + rear_arm)
    front_slip = inputs[1] - np.arctan((state[0] + front_arm * state[1]) / speed)
    rear_slip = -np.arctan((state[0] - rear_arm * state[1]) / speed)
    front, rear = load * rear_arm, load * front_arm  # the most that each axle can bear
    front, rear = front * np.tanh(front_stiffness * front_slip / front), rear * np.tanh(rear_stiffness * rear_slip / rear)
    return (front + rear) / mass, (front_arm * front - rear_arm * rear) / inertia


@with_jacobian
def transition(state, inputs, p):
    """(v, ω) one sample later."""
    lateral, angular = accelerations(state, inputs, p)
    return state + p[-1] * np.array([lateral - inputs[0] * state[1], angular])


@with_jacobian
def observation(state, inputs, p):
    """Lateral acceleration and yaw rate."""
    return np.array([accelerations(state, inputs, p)[0], state[1]])


class SaturatingEkf(Recursive):
    """Process noise is what the model leaves unexplained of the training recordings' motion from one sample to the next."""

    name, title = "saturating_ekf", "EKF with saturating axles"
    channels, skippable = ("vx", "steer", "ay", "yaw_rate"), ("ay", "yaw_rate")
    variance_vy: float = fitted("variance of a step of the lateral velocity", unit="m²/s²")
    variance_yaw_rate: float = fitted("variance of a step of the yaw rate", unit="rad²/s²")
    car: SingleTrackParameters = setting(FERRARI_250LM, "the car")
    friction: float = setting(1.0, "friction of its tyres", positive=True)
    deviations: tuple[float, float] = setting((0.3, 0.01), "of the accelerometer's and the gyro's noise", unit="m/s², rad/s")

    def model(self):
        """The compiled model with these settings."""
        parameters = np.array([*astuple(self.car), self.friction, 1.0 / self.rate_hz])
        noises = np.diag(list(self.values.values())), np.diag(np.square(self.deviations))
        return CompiledModel(transition, observation, parameters, *noises)

    def first_state(self, sample, given):
        """(v, ω), 0 where a protocol hands over nothing, and no sample before."""
        return Gaussian(np.array([given.get("vy", 0.0), given.get("yaw_rate", 0.0)]), np.diag([1.0, 0.5])), np.empty((0, 4))

    def run(self, samples, state):
        """Filter on from the state at the last sample, whose measurements are part of it already."""
        rows = np.vstack([state[1], samples])
        filtered = extended_scan(self.model(), rows[:, 2:], rows[:, :2], state[0]).filtered
        vy, yaw_rate = filtered.mean[-len(samples) :].T
        rows[-1, 2:] = np.nan
        return {"vy": vy, "yaw_rate": yaw_rate}, (Gaussian(filtered.mean[-1], filtered.covariance[-1]), rows[-1:])

    def find_numbers(self, data, training, context):
        """Mean squares of what the model leaves unexplained of a step."""
        p, drives = self.model().parameters, [(r.stack(("vy_ref", "yaw_rate")), r.stack(("vx", "steer"))) for r in data.train]
        left = [x[k + 1] - transition(x[k], u[k], p)[0] for x, u in drives for k in range(len(x) - 1)]
        return dict(zip(self.values, np.nanmean(np.square(left), axis=0).tolist(), strict=True)), FitRecord()
