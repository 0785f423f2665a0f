"""A trained KS-NN as what it is: local models, a linear parameter varying system, and three
sub-models that add up.

At constant yaw rate ω the linear network is, with e = û - u_m and s = a_y - u_m ω,

    v⁺ = γ₁v + β₁τs - ω(w₁₁e + b₁₁)                                         (Eqs. 7a, 10a)
    û⁺ = γ₂û + β₂τ(a_x + ωv) - (w₁₂e + b₁₂)                                 (Eqs. 7b, 10b)

and, since û⁺ = e⁺ + u_m⁺, with the pseudo-measurement p = (u_m⁺ - u_m)/τ - a_x of vω,

    e⁺ = (γ₂ - w₁₂)e + β₂τωv - β₂τp + (γ₂ - β₂)u_m - (1 - β₂)u_m⁺ - b₁₂.

The state (v, e) starts from zero, so its three inputs s, p and {u_m, biases} are all that v̂
consists of. With (zI - A)⁻¹ = [[z - γ₂ + w₁₂, -ωw₁₁], [β₂τω, z - γ₁]]/D and D = det(zI - A) as in
Eq. 12c,

    v̂ = β₁τ(z - γ₂ + w₁₂)/D · s                                             first sub-model, A/D
      + β₂τw₁₁ω/D · p                                                       second sub-model, B/D
      + ω[w₁₁(z - β₂z + β₂ - γ₂)u_m
          + (b₁₂w₁₁ - b₁₁(z + w₁₂ - γ₂)) z/(z - 1)]/D                       third sub-model, C/D·ω

which is Eq. 11 with Eqs. 12a-c. The biases are constant inputs from k = 0 on, so z/(z - 1) is their
transform; the printed Eq. 12b has the same with its denominator lost.

Eq. 11 takes differences of u_m from rest, p(0) ∋ u_m(0)/τ, and starts from û = 0. The network
starts from û = u_m(0), which adds -ωw₁₁ z u_m(0)/D. That is what turns both differences into those
from u_m(0) on: a share β₂ of it belongs to the second sub-model and 1 - β₂ to the third. Here both
belong there from the start, so no fourth part remains.

Where ω varies, the same recursion in (v, e) has coefficients that vary with |ω|; driven by each
input alone it gives three parts that add up to v̂ exactly. With nonlinear feedback superposition
holds for the gains that were in force: f(e) = f(0) + g(e)e with g(e) = (f(e) - f(0))/e.

Source: Da Lio et al. 2023, Section IV.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.estimators.ksnn import Ksnn

SMALL_ERROR = (
    1e-6  # below it the secant of a feedback function is taken to be its tangent at 0 [m/s]
)


@dataclass(frozen=True, eq=False)
class Gains:
    """Coefficients of the blended recursion (Eqs. 14, 15); the last axis of each is the equation,
    v̂ then û.
    """

    gamma: FloatArray  # γ₁, γ₂, shape (..., 2)
    beta: FloatArray  # β₁, β₂, shape (..., 2)
    weight: FloatArray  # w₁₁, w₁₂, shape (..., 2)
    bias: FloatArray  # b₁₁ [m/s], b₁₂ [m/s], shape (..., 2); b₁₁ still has to be multiplied with ω


@dataclass(frozen=True, eq=False)
class LocalModels:
    """The modules M_p of a KS-NN as float64 arrays (Eqs. 7 to 9)."""

    centres: FloatArray  # |ω| at which each is alone [rad/s], shape (P,)
    gamma: FloatArray  # γ₁, γ₂, shape (P, 2)
    beta: FloatArray  # β₁, β₂, shape (P, 2)
    weight: FloatArray  # slope of the linear branches of f₁, f₂, shape (P, 2)
    bias: FloatArray  # constants of f₁, f₂, shape (P, 2)
    hidden_weight: FloatArray  # w₂, shape (P, 2, Q)
    hidden_bias: FloatArray  # b₂, shape (P, 2, Q)
    output_weight: FloatArray  # w₃, shape (P, 2, Q)
    step: float  # τ [s]
    n_window: int  # samples N of a window

    @classmethod
    def of(cls, estimator: Ksnn) -> LocalModels:
        """Copy them out of an estimator."""
        settings = estimator.settings
        weights = {name: values.astype(np.float64) for name, values in estimator.weights().items()}
        none = np.zeros((settings.n_local, 2))
        neurons = np.zeros((settings.n_local, 2, settings.n_hidden))
        return cls(
            centres=np.linspace(0.0, float(weights["yaw_rate_max"]), settings.n_local),
            gamma=weights["gamma"],
            beta=weights["beta"],
            weight=weights["linear_weight"],
            bias=weights.get("linear_bias", none) + weights.get("output_bias", none),
            hidden_weight=weights.get("hidden_weight", neurons),
            hidden_bias=weights.get("hidden_bias", neurons),
            output_weight=weights.get("output_weight", neurons),
            step=1.0 / settings.rate_hz,
            n_window=settings.window,
        )

    def activations(self, yaw_rate: FloatArray) -> FloatArray:
        """Weights φ_p(|ω|), (...) -> (..., P); they add up to one (Fig. 3)."""
        if len(self.centres) == 1:
            return np.ones((*np.shape(yaw_rate), 1))
        position = np.clip(np.abs(yaw_rate) / self.centres[1], 0.0, len(self.centres) - 1.0)
        return np.clip(1.0 - np.abs(position[..., None] - np.arange(len(self.centres))), 0.0, None)

    def feedback(self, error: FloatArray) -> FloatArray:
        """f₁(e) and f₂(e) of every local model (Eq. 8), (...) -> (..., P, 2) [m/s]."""
        spread = np.asarray(error)[..., None, None]
        neurons = self.output_weight * np.tanh(
            self.hidden_weight * spread[..., None] + self.hidden_bias
        )
        return self.weight * spread + self.bias + neurons.sum(axis=-1)

    def slope(self, error: FloatArray) -> FloatArray:
        """df₁/de and df₂/de of every local model, (...) -> (..., P, 2)."""
        inner = np.tanh(
            self.hidden_weight * np.asarray(error)[..., None, None, None] + self.hidden_bias
        )
        return self.weight + (self.output_weight * self.hidden_weight * (1.0 - inner**2)).sum(
            axis=-1
        )

    def secant(self, error: FloatArray) -> FloatArray:
        """(f(e) - f(0))/e, the gain in force at e, (...) -> (..., P, 2)."""
        spread = np.asarray(error)[..., None, None]
        small = np.abs(spread) < SMALL_ERROR
        rise = (self.feedback(error) - self.feedback(np.zeros(()))) / np.where(small, 1.0, spread)
        return np.where(small, self.slope(np.zeros(())), rise)

    def linearised(self, error: float = 0.0) -> LpvModel:
        """The linear system that this is for linear feedback, and close to ``error`` e₀ [m/s]
        otherwise: f(e) ≈ f(e₀) + f'(e₀)(e - e₀).
        """
        at = np.asarray(error)
        slope = self.slope(at)
        return LpvModel(
            self.centres,
            self.gamma,
            self.beta,
            slope,
            self.feedback(at) - slope * error,
            self.step,
            self.n_window,
        )


@dataclass(frozen=True, eq=False)
class LpvModel:
    """A linear KS-NN: a linear system whose coefficients are piecewise linear in |ω| (Eqs. 14 and
    15).
    """

    centres: FloatArray  # breaks of the coefficients [rad/s], shape (P,)
    gamma: FloatArray  # γ₁, γ₂ at the breaks, shape (P, 2)
    beta: FloatArray  # β₁, β₂, shape (P, 2)
    weight: FloatArray  # w₁₁, w₁₂, shape (P, 2)
    bias: FloatArray  # b₁₁, b₁₂ [m/s], shape (P, 2)
    step: float  # τ [s]
    n_window: int  # samples N of a window

    def gains(self, yaw_rate: FloatArray | float) -> Gains:
        """Coefficients at yaw rates of any shape and sign [rad/s]; beyond the last break those of
        the last.
        """
        size = np.abs(np.asarray(yaw_rate, dtype=np.float64))
        tables = (self.gamma, self.beta, self.weight, self.bias)
        return Gains(
            *(
                np.stack([np.interp(size, self.centres, table[:, i]) for i in (0, 1)], axis=-1)
                for table in tables
            )
        )


@dataclass(frozen=True, eq=False)
class SubModels:
    """Parts of v̂ by what drives them (Eq. 11); all of one shape [m/s]."""

    slip_rate: FloatArray  # first sub-model: integrates a_y - ω u_m
    pseudo_measurement: FloatArray  # second sub-model: (u̇_m - a_x), which is vω
    speed: FloatArray  # third sub-model, its relation to ω at a forward speed
    bias: FloatArray  # third sub-model, what its learned offsets make
    error: FloatArray  # û - u_m along the way, for the gains that were in force

    @property
    def third(self) -> FloatArray:
        """The third sub-model as a whole."""
        return self.speed + self.bias

    @property
    def total(self) -> FloatArray:
        """v̂."""
        return self.slip_rate + self.pseudo_measurement + self.speed + self.bias


def decomposed(models: LocalModels, measurements: FloatArray) -> SubModels:
    """Superposition on the recursion of (v, û - u_m) from zero, driven by each input alone.

    Parameters
    ----------
    models
        Local models; nonlinear feedback enters with the gain that is in force at each step.
    measurements
        Columns yaw_rate [rad/s], vx [m/s], ay, ax [m/s²], shape (..., N, 4).

    Returns
    -------
    SubModels
        Parts one interval after each sample, each of shape (..., N); at constant ω they are the
        terms of Eq. 11.
    """
    omega, speed, ay, ax = np.moveaxis(np.asarray(measurements, dtype=np.float64), -1, 0)
    phi = models.activations(omega)
    gamma = phi @ models.gamma
    beta = phi @ models.beta
    offset = phi @ models.feedback(np.zeros(()))
    v, e = (np.zeros((*speed.shape[:-1], 4)) for _ in range(2))
    parts = np.empty((*speed.shape, 4))
    errors = np.empty_like(speed)
    tau = models.step
    last = speed.shape[-1] - 1
    for k in range(last + 1):
        now = np.s_[..., k]
        after = np.s_[..., min(k + 1, last)]  # what the last one gives e is no longer read
        error = e.sum(axis=-1)
        gain = (phi[..., k, :, None] * models.secant(error)).sum(axis=-2)
        (gamma_1, gamma_2), (beta_1, beta_2) = (
            np.moveaxis(gains[..., k, :], -1, 0) for gains in (gamma, beta)
        )
        pseudo = (speed[after] - speed[now]) / tau - ax[now]
        into_v = np.stack(
            [beta_1 * tau * (ay[now] - omega[now] * speed[now]), *3 * [np.zeros_like(error)]],
            axis=-1,
        )
        into_v[..., 3] = -omega[now] * offset[..., k, 0]
        into_e = np.zeros_like(into_v)
        into_e[..., 1] = -beta_2 * tau * pseudo
        into_e[..., 2] = (gamma_2 - beta_2) * speed[now] - (1.0 - beta_2) * speed[after]
        into_e[..., 3] = -offset[..., k, 1]
        v, e = (
            gamma_1[..., None] * v - (omega[now] * gain[..., 0])[..., None] * e + into_v,
            (gamma_2 - gain[..., 1])[..., None] * e
            + (beta_2 * tau * omega[now])[..., None] * v
            + into_e,
        )
        parts[..., k, :] = v
        errors[now] = error
    return SubModels(parts[..., 0], parts[..., 1], parts[..., 2], parts[..., 3], errors)


def decomposed_estimate(estimator: Ksnn, recording: Recording) -> SubModels:
    """The parts of the estimate of a recording: every sample by a window of its own, as the network
    sees it.

    Parameters
    ----------
    recording
        At the estimator's rate.

    Returns
    -------
    SubModels
        Parts on the clock of the estimate, each of shape (T,), NaN until a window is full; their
        sum is the estimate up to the precision that the network was trained in. ``error`` is û -
        u_m at the last sample of the window.

    Raises
    ------
    DataError
        The rate is another, or the recording is shorter than a window and the sample after it.
    """
    models = LocalModels.of(estimator)
    if abs(recording.rate_hz * models.step - 1.0) > 1e-9:
        raise DataError(
            f"recording '{recording.id}' is sampled at {recording.rate_hz:g} Hz, the KS-NN works "
            f"at {1.0 / models.step:g} Hz"
        )
    if len(recording) <= models.n_window:
        raise DataError(
            f"recording '{recording.id}' has {len(recording)} samples, a window and the one after "
            f"it {models.n_window + 1}"
        )
    series = recording.stack(estimator.channels)
    sub_models = decomposed(
        models, np.moveaxis(sliding_window_view(series, models.n_window, axis=0)[:-1], 1, 2)
    )
    padding = np.full(models.n_window, np.nan)
    names = ("slip_rate", "pseudo_measurement", "speed", "bias", "error")
    return SubModels(
        **{name: np.concatenate([padding, getattr(sub_models, name)[:, -1]]) for name in names}
    )
