"""Extended Kalman filter on a model of one's own: a single track whose axles saturate; compiled, Jacobians by complex step.

    m(dv/dt + uω) = F_f + F_r,   J dω/dt = l_f F_f - l_r F_r,   F = μF_z tanh(Cα/(μF_z)),   a_y = (F_f + F_r)/m

Slip angles α_f = δ - atan((v + l_fω)/u), α_r = -atan((v - l_rω)/u); F_z is the axle's static load, u at least 3 m/s. States v, ω; measured
are a_y and ω; forward Euler. Filter: Jazwinski 1970, Chapter 8; complex step: Squire & Trapp, SIAM Review 40 (1), 1998.
"""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
from numba import njit

from vehest.constants import GRAVITY
from vehest.declared import fitted, setting
from vehest.estimators.base import FitRecord
from vehest.estimators.recursive import Recursive
from vehest.vehicle.parameters import FERRARI_250LM, SingleTrackParameters


@njit
def model(state, inputs, p):
    """(v, ω) one sample later, and a_y and ω now, (4,), at (v, ω), real or complex, and (u, δ); see `SaturatingEkf.parameters`."""
    mass, inertia, front_arm, rear_arm, front_stiffness, rear_stiffness, friction, step = p
    speed = max(inputs[0], 3.0)
    load = friction * mass * GRAVITY / (front_arm + rear_arm)
    front_slip = inputs[1] - np.arctan((state[0] + front_arm * state[1]) / speed)
    rear_slip = -np.arctan((state[0] - rear_arm * state[1]) / speed)
    front = load * rear_arm
    rear = load * front_arm  # the most that each axle can bear
    front = front * np.tanh(front_stiffness * front_slip / front)
    rear = rear * np.tanh(rear_stiffness * rear_slip / rear)
    ay = (front + rear) / mass
    angular = (front_arm * front - rear_arm * rear) / inertia
    return np.array(
        [state[0] + step * (ay - inputs[0] * state[1]), state[1] + step * angular, ay, state[1]]
    )


@njit
def linearised(state, inputs, p):
    """The same and its derivatives by (v, ω), (4, 2), exact: nothing is subtracted, so the complex step may be as small as it likes."""
    slope = np.empty((4, 2))
    for j in range(2):
        slope[:, j] = model(state + 1e-30j * np.eye(2)[j], inputs, p).imag / 1e-30
    return model(state, inputs, p), slope


@njit
def scan(rows, p, Q, R, mean, covariance, means):
    """Filter u, δ, a_y, ω, (T, 4), from a state at the first sample before its measurement; what is NaN was not measured."""
    for k in range(len(rows)):
        if k > 0:
            value, slope = linearised(mean, rows[k - 1, :2], p)
            mean = value[:2]
            covariance = slope[:2] @ covariance @ slope[:2].T + Q
        value, slope = linearised(mean, rows[k, :2], p)
        error = rows[k, 2:] - value[2:]
        C = slope[2:]
        for i in range(2):
            if np.isnan(error[i]):
                error[i] = 0.0
                C[i] = 0.0
        gain = covariance @ C.T @ np.linalg.inv(C @ covariance @ C.T + R)
        kept = np.eye(2) - gain @ C
        mean = mean + gain @ error
        covariance = kept @ covariance @ kept.T + gain @ R @ gain.T
        means[k] = mean
    return mean, covariance


class SaturatingEkf(Recursive):
    """Process noise is what the model leaves unexplained of the training recordings' motion from one sample to the next."""

    name = "saturating_ekf"
    title = "EKF with saturating axles"
    channels = ("vx", "steer", "ay", "yaw_rate")
    skippable = ("ay", "yaw_rate")
    variance_vy: float = fitted("variance of a step of the lateral velocity", unit="m²/s²")
    variance_yaw_rate: float = fitted("variance of a step of the yaw rate", unit="rad²/s²")
    car: SingleTrackParameters = setting(FERRARI_250LM, "the car")
    friction: float = setting(1.0, "friction of its tyres", positive=True)
    deviations: tuple[float, float] = setting(
        (0.3, 0.01), "of the accelerometer's and the gyro's noise", unit="m/s², rad/s"
    )

    @property
    def parameters(self):
        """Of the car, its tyres and the step."""
        return (*astuple(self.car), self.friction, 1.0 / self.rate_hz)

    def first_state(self, sample, given):
        """No sample before, and (v, ω), 0 where a protocol gives no initial state."""
        return (
            np.empty((0, 4)),
            np.array([given.get("vy", 0.0), given.get("yaw_rate", 0.0)]),
            np.diag([1.0, 0.5]),
        )

    def run(self, samples, state):
        """Filter on from the state at the last sample, whose measurements are part of it already."""
        rows = np.vstack([state[0], samples])
        means = np.empty((len(rows), 2))
        noises = (np.diag(list(self.values.values())), np.diag(np.square(self.deviations)))
        last = scan(rows, self.parameters, *noises, *state[1:], means)
        vy, yaw_rate = means[-len(samples) :].T
        return {"vy": vy, "yaw_rate": yaw_rate}, (rows[-1:] * [1.0, 1.0, np.nan, np.nan], *last)

    def find_numbers(self, data, training, context):
        """Mean squares of what the model leaves unexplained of a step."""
        drives = [(r.stack(("vy_ref", "yaw_rate")), r.stack(("vx", "steer"))) for r in data.train]
        left = [
            x[k + 1] - model(x[k], u[k], self.parameters)[:2]
            for x, u in drives
            for k in range(len(x) - 1)
        ]
        return dict(
            zip(self.values, np.nanmean(np.square(left), axis=0).tolist(), strict=True)
        ), FitRecord()
