"""The Luenberger observer's recursion, compiled; the uncompiled function is the readable version that tests compare with."""

from __future__ import annotations

import math

import numba
import numpy as np

from vehest.constants import FloatArray


def implicit_euler_observer(
    measurements: FloatArray, gain: float, threshold: float, step: float, v: float, u: float, vy: FloatArray, vx: FloatArray
) -> None:
    """Run the observer over a recording, writing the estimates made for the time of each sample.

    (I - τA)x⁺ = x + τb with A = [[0, -α²ω], [ω, -2α|ω|]], b = [a_y + (α² - 1)ωu_m, a_x + 2α|ω|u_m]

    Args:
        measurements: yaw_rate, vx, ay, ax, shape (T, 4).
        gain: α.
        threshold: |yaw rate| below which the state is reset [rad/s].
        step: sampling time τ [s].
        v: lateral velocity to start from [m/s].
        u: forward velocity to start from [m/s]; the measured one if NaN.
        vy: output, shape (T,) [m/s].
        vx: output, shape (T,) [m/s].

    Source: Da Lio et al. 2023, Appendix A, with the gains in the order of Appendix B; Farrelly & Wellstead 1996.
    """
    if math.isnan(u):
        u = measurements[0, 1]
    for k in range(measurements.shape[0]):
        omega, speed, ay, ax = measurements[k, 0], measurements[k, 1], measurements[k, 2], measurements[k, 3]
        if abs(omega) < threshold:
            v, u = 0.0, speed
        else:
            from_u = step * gain * gain * omega
            from_v = step * omega
            damping = 1.0 + 2.0 * step * gain * abs(omega)
            right_v = v + step * (ay + (gain * gain - 1.0) * omega * speed)
            right_u = u + step * (ax + 2.0 * gain * abs(omega) * speed)
            determinant = damping + from_u * from_v
            v = (damping * right_v - from_u * right_u) / determinant
            u = (right_u + from_v * right_v) / determinant
        vy[k], vx[k] = v, u


compiled_observer = numba.njit(cache=True, error_model="numpy")(implicit_euler_observer)


def observe(
    measurements: FloatArray, gain: float, threshold: float, step: float, v: float = 0.0, u: float = math.nan
) -> tuple[FloatArray, FloatArray]:
    """Estimated vy and vx [m/s], each of shape (T,)."""
    vy, vx = np.empty(len(measurements)), np.empty(len(measurements))
    compiled_observer(np.ascontiguousarray(measurements), float(gain), float(threshold), step, float(v), float(u), vy, vx)
    return vy, vx
