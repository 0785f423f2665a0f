"""Kinematic Luenberger observer with reset.

    samples (T, 4) of yaw_rate, vx, ay, ax --observe--> v, u
    training recordings --Nelder-Mead--> gain α, threshold ω_th

Source: Farrelly & Wellstead 1996, as in Da Lio et al. 2023, Appendix A.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from vehest.constants import FloatArray
from vehest.declared import fitted
from vehest.estimators.base import Trial
from vehest.estimators.recursive import Recursive
from vehest.training.search import DirectSearchSettings


def implicit_euler_observer(
    measurements: FloatArray,
    gain: float,
    threshold: float,
    step: float,
    v: float,
    u: float,
    vy: FloatArray,
    vx: FloatArray,
) -> None:
    """Run the observer over a recording, writing ``vy`` and ``vx`` [m/s] of each sample, (T,).

    (I - τA)x⁺ = x + τb with A = [[0, -α²ω], [ω, -2α|ω|]], b = [a_y + (α² - 1)ωu_m, a_x + 2α|ω|u_m]

    The 2 × 2 system is solved in closed form; its determinant is at least 1 for α ≥ 0. Where |ω| is
    below the threshold the state is not observable, and becomes v = 0, u = u_m.

    Parameters
    ----------
    measurements : FloatArray
        yaw_rate, vx, ay, ax, shape (T, 4).
    gain : float
        α.
    threshold : float
        |yaw rate| below which the state is reset [rad/s].
    step : float
        Sampling time τ [s].
    v, u : float
        Lateral and forward velocity to start from [m/s]; the measured one where u is NaN.

    Source: Da Lio et al. 2023, Appendix A, with the gains in the order of Appendix B; Farrelly &
    Wellstead 1996.
    """
    if math.isnan(u):
        u = measurements[0, 1]
    for k in range(measurements.shape[0]):
        omega = measurements[k, 0]
        speed = measurements[k, 1]
        ay = measurements[k, 2]
        ax = measurements[k, 3]
        if abs(omega) < threshold:
            v = 0.0
            u = speed
        else:
            from_u = step * gain * gain * omega
            from_v = step * omega
            damping = 1.0 + 2.0 * step * gain * abs(omega)
            right_v = v + step * (ay + (gain * gain - 1.0) * omega * speed)
            right_u = u + step * (ax + 2.0 * gain * abs(omega) * speed)
            determinant = damping + from_u * from_v
            v = (damping * right_v - from_u * right_u) / determinant
            u = (right_u + from_v * right_v) / determinant
        vy[k] = v
        vx[k] = u


# `implicit_euler_observer`, compiled
compiled_observer = numba.njit(cache=True, error_model="numpy")(implicit_euler_observer)


def observe(
    measurements: FloatArray,
    gain: float,
    threshold: float,
    step: float,
    v: float = 0.0,
    u: float = math.nan,
) -> tuple[FloatArray, FloatArray]:
    """Run the compiled observer over samples.

    Parameters
    ----------
    measurements : array
        yaw_rate [rad/s], vx [m/s], ay, ax [m/s²], (T, 4).
    gain, threshold, step, v, u
        See `implicit_euler_observer`.

    Returns
    -------
    tuple
        Estimated vy and vx [m/s], (T,) each.
    """
    vy = np.empty(len(measurements))
    vx = np.empty(len(measurements))
    compiled_observer(
        np.ascontiguousarray(measurements),
        float(gain),
        float(threshold),
        step,
        float(v),
        float(u),
        vy,
        vx,
    )
    return vy, vx


class Luenberger(Recursive):
    """Kinematic observer with both poles at -α|ω|, reset where the yaw rate is too small.

    Source: Da Lio et al. 2023, Appendix A (gains in the order that its Appendix B implies).
    """

    name = "luenberger"
    title = "Luenberger"
    trials = (
        Trial(
            4,
            "observer; a minute",
            "training.grid=2 training.max_evaluations=100",
        ),
    )
    channels = ("yaw_rate", "vx", "ay", "ax")
    states = ("vy", "vx")
    training_type = DirectSearchSettings
    template = "luenberger"
    gain: float = fitted("gain α", start=(3.0, 20.0), box=(0.0, 50.0))
    threshold: float = fitted(
        "yaw rate ω_th below which it is reset",
        unit="rad/s",
        start=(0.0, 0.3),
        box=(0.0, 0.5),
        of_largest="yaw_rate",
    )
    trace_note = "v is set to 0 where the yaw rate is below a threshold (reset of the method)"
    style = "#5b8c00", "solid", "s"

    def run(self, samples: FloatArray, state: Any) -> tuple[dict[str, FloatArray], Any]:
        """Lateral and forward velocity [m/s].

        Parameters
        ----------
        samples : array
            Of ``channels``, (T, 4).
        state : tuple
            v and u after the sample before [m/s].
        """
        vy, vx = observe(samples, self.gain, self.threshold, 1.0 / self.rate_hz, *state)
        return {"vy": vy, "vx": vx}, (float(vy[-1]), float(vx[-1]))

    def c_values(self) -> dict[str, Any]:
        """Gain and threshold for the C template."""
        return {**self.values, "step": 1.0 / self.rate_hz}


ESTIMATOR = Luenberger  # class by which the registry finds the family
