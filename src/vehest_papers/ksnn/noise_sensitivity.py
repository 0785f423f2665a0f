"""How noise of the accelerations comes through to v̂ at constant yaw rate: KS-NN and Luenberger
observer in closed form.

KS-NN. With A, D and the first two sub-models of `vehest_papers.ksnn.linear_system`, δa_y enters s =
a_y - ωu_m and δa_x enters -p:

    H_Y(z) = β₁τ(z + w₁₂ - γ₂)/D(z),   H_X(z) = -β₂τω w₁₁/D(z),
    D(z) = z² + (w₁₂ - γ₁ - γ₂)z + β₂ω²τw₁₁ - w₁₂γ₁ + γ₂γ₁

Luenberger, implicit Euler: (M - z⁻¹I)x = τ(a_y, a_x) with M = [[1, α²ωτ], [-ωτ, 1 + d]], d =
2α|ω|τ, whence

    H_Y(z) = τz((1 + d)z - 1)/D(z),   H_X(z) = -α²ωτ²z²/D(z),
    D(z) = (1 + d + α²ω²τ²)z² - (2 + d)z + 1

Both agree with the printed Eq. 18 in every sign; the Luenberger's do so only with the gains of Eq.
17 exchanged, as `vehest.estimators.luenberger` has them.

The network forgets what is older than its window: its response to noise is the impulse response of
the first N lags (`NoiseSensitivity.truncated`); Appendix B approximates it by the whole one.

Source: Da Lio et al. 2023, Section VIII-E and Appendix B.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from vehest.constants import FloatArray
from vehest.estimators.luenberger import Luenberger
from vehest_papers.ksnn.linear_system import LpvModel

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class NoiseSensitivity:
    """Transfer functions from δa_y and δa_x [m/s²] to δv̂ [m/s] as polynomials in z, highest power
    first.
    """

    numerator_ay: FloatArray  # shape (3,)
    numerator_ax: FloatArray  # shape (3,)
    denominator: FloatArray  # shape (3,)
    rate_hz: float  # sampling rate [Hz]
    memory: int | None = None  # lags after which the response ends; none for one without end

    def truncated(self, n_window: int) -> NoiseSensitivity:
        """The same for an estimator that sees windows of N samples: lags 0 to N of the impulse
        response.
        """
        return replace(self, memory=n_window)

    def response(self, frequency: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """H_Y and H_X at frequencies [Hz], each of their shape [(m/s)/(m/s²)]."""
        z = np.exp(2j * np.pi * np.asarray(frequency) / self.rate_hz)
        if self.memory is None:
            powers = np.stack([z**2, z, np.ones_like(z)], axis=-1)
            below = powers @ self.denominator
            to_ay, to_ax = (
                powers @ numerator / below for numerator in (self.numerator_ay, self.numerator_ax)
            )
        else:
            delays = z[..., None] ** -np.arange(self.memory + 1.0)
            to_ay, to_ax = (
                delays @ response for response in self.impulse_responses(self.memory + 1)
            )
        return to_ay.astype(np.complex128), to_ax.astype(np.complex128)

    def impulse_responses(self, n_samples: int) -> tuple[FloatArray, FloatArray]:
        """δv̂ after an impulse of one sample of δa_y and of δa_x, lags 0 to ``n_samples - 1``."""
        impulse = np.zeros(n_samples)
        impulse[: 1 if n_samples else 0] = 1.0
        to_ay, to_ax = (
            signal.lfilter(numerator, self.denominator, impulse)
            for numerator in (self.numerator_ay, self.numerator_ax)
        )
        if self.memory is not None:
            to_ay[self.memory + 1 :] = 0.0
            to_ax[self.memory + 1 :] = 0.0
        return to_ay, to_ax

    def band_gains(self, highest_hz: float, n_lines: int = 4001) -> tuple[float, float]:
        """Standard deviation of δv̂ for noise of density 1 (m/s²)/√Hz from 0 to a frequency, for
        a_y and for a_x [m/s].

        So estimators of different rates compare: the noise is that of the sensor, not of the
        sample.
        """
        frequency = np.linspace(0.0, highest_hz, n_lines)
        to_ay, to_ax = self.response(frequency)
        return float(np.sqrt(np.trapezoid(np.abs(to_ay) ** 2, frequency))), float(
            np.sqrt(np.trapezoid(np.abs(to_ax) ** 2, frequency))
        )


def ksnn_sensitivity(model: LpvModel, yaw_rate: float) -> NoiseSensitivity:
    """Of a linear KS-NN without end, at constant yaw rate [rad/s]; `NoiseSensitivity.truncated`
    makes it that of its windows.
    """
    gains = model.gains(yaw_rate)
    tau = model.step
    (gamma_1, gamma_2) = gains.gamma
    (beta_1, beta_2) = gains.beta
    (weight_1, weight_2) = gains.weight
    constant = beta_2 * yaw_rate**2 * tau * weight_1 - weight_2 * gamma_1 + gamma_2 * gamma_1
    return NoiseSensitivity(
        numerator_ay=np.array([0.0, beta_1 * tau, beta_1 * tau * (weight_2 - gamma_2)]),
        numerator_ax=np.array([0.0, 0.0, -yaw_rate * weight_1 * beta_2 * tau]),
        denominator=np.array([1.0, weight_2 - gamma_1 - gamma_2, constant]),
        rate_hz=1.0 / tau,
    )


def luenberger_sensitivity(estimator: Luenberger, yaw_rate: float) -> NoiseSensitivity:
    """Of a fitted Luenberger observer at its own rate; zero where the yaw rate is so small that it
    resets its state.
    """
    tau = 1.0 / estimator.settings.rate_hz
    gain = estimator.gain
    damping = 2.0 * gain * abs(yaw_rate) * tau
    stiffness = (gain * yaw_rate * tau) ** 2
    if abs(yaw_rate) < estimator.threshold:
        return NoiseSensitivity(np.zeros(3), np.zeros(3), np.array([1.0, 0.0, 0.0]), 1.0 / tau)
    return NoiseSensitivity(
        numerator_ay=tau * np.array([1.0 + damping, -1.0, 0.0]),
        numerator_ax=np.array([-(gain**2) * yaw_rate * tau**2, 0.0, 0.0]),
        denominator=np.array([1.0 + damping + stiffness, -2.0 - damping, 1.0]),
        rate_hz=1.0 / tau,
    )
