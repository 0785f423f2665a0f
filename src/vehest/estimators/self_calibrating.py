"""Self-calibrating filter: identifies rear axle, roll leakage and offsets of a car on the drive.

It needs neither training nor a reference sensor.

    sample --kernel.scan: bank of J filters, network, steady cornering--> vy, variance
    whole drive --filtering.self_calibrating_smoother.smooth--> vy, variance (offline)

States of each filter of the bank, (8,): v, u [m/s], offsets of ay and ax [m/s²], roll leakage κ
[1], distance b [m] and compliance C [rad s²/m] of the rear axle, and the axle's error e [1]. The
class turns settings into the numbers of the compiled recursion
(`vehest.estimators.kernels.self_calibrating`) and scales times, speeds and the compliance with the
wheelbase (`WHEELBASE_POWERS`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.estimators.base import Trial, require_positive, require_shapes
from vehest.estimators.filtering.self_calibrating_settings import (
    NUMERIC,
    TYPICAL_REAR,
    TYPICAL_WHEELBASE,
    WHEELBASE_POWERS,
    Numbers,
    SelfCalibratingSettings,
)
from vehest.estimators.filtering.self_calibrating_smoother import smooth
from vehest.estimators.kernels import self_calibrating as kernel
from vehest.estimators.kernels.ksnn import c_tables, packed
from vehest.estimators.ksnn import Ksnn
from vehest.estimators.model_files import load_model

WINDOW = 30  # samples in the window that the network reads
NETWORK_HZ = 20.0  # Hz, rate of these samples
NEGLIGIBLE_ODDS = 1e-300  # prior odds of a candidate that does not count
UNMEASURED_AX_NOISE = 20.0  # m/s per √s: process noise of u where ax is not measured


class SelfCalibrating(SelfCalibratingSettings):
    """A bank of Kalman filters over grip limits, compared with a network and steady cornering.

    v' = (1 - κ) ay - β_y - ω u,   u' = ax - β_x + ω v,   u measured,
    0 = v - b ω + C u φ(a_r) + s e,   a_r = (1 - κ)(ay - β_y) - b ω',
    φ(a) = a_m (1 - (1 - |a|/a_m)^p)/p sign(a),   a_m² = a_max² - ax²

    with offsets β, roll leakage κ, distance b and compliance C of the rear axle, and its correlated
    error e of size s. The filters differ in the grip limit a_max and are weighted by the likelihood
    of their innovations. Three candidates for v, the filters' mean, the network that comes with
    vehest, and v = ω (b - C u²) with the priors of b and C, are weighted by how well each explains
    v' and u' on the drive so far, which needs no reference.
    """

    name = "self_calibrating"
    title = "Self-calibrating filter"
    trials = (
        Trial(
            1.5,
            "filter that identifies the car on each drive; nothing is trained, compiled once",
            "estimator.wheelbase={wheelbase}",
        ),
    )
    version = "7"
    measured_only = ("ax",)  # d(vx)/dt would say that the car does not slip
    covariance_of = ("vy",)
    # ax may be absent
    channels: tuple[str, ...] = ("yaw_rate", "vx", "ay", "ax")  # type: ignore[misc]
    notice = Ksnn.notice
    slow_kernel = "vehest.estimators.kernels.self_calibrating:scan"
    offline = (
        "estimator 'self_calibrating' smooths a whole drive and cannot run online; use "
        "estimator.smoothed=false"
    )
    template = "self_calibrating"
    adapts = True  # the axle, the offsets and the weights of filters and candidates
    refuses = ("NaN", "infinite")

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self.channels = type(self).channels if self.measured_ax else type(self).channels[:3]
        self.network, self._width = _shipped_network()

    @property
    def causal(self) -> bool:
        """Whether no later measurements are used: true for the filter, false for the smoother."""
        return not self.smoothed

    @property
    def full_title(self) -> str:
        """Title, with ``smoothed`` if it smooths."""
        return f"{self.title}, smoothed" if self.smoothed else self.title

    @property
    def bank_arrays(self) -> tuple[FloatArray, FloatArray]:
        """Grip limits of the filters [m/s²] and logarithms of their weights at the start, (J,)."""
        grips = np.array(self.grips, dtype=np.float64)
        return grips, -0.5 * np.square(np.log(grips / self.grip) / self.grip_deviation)

    @property
    def prior(self) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation of the states at the start, (8,) each."""
        place, place_deviation = self.imu_prior
        compliance = self.numbers().compliance
        mean = np.array([0.0, 0.0, 0.0, 0.0, self.leakage, place, compliance, 0.0])
        deviation = np.array(
            [
                0.3,
                self.noise_speed,
                self.offset_ay,
                self.offset_ax,
                self.leakage_deviation,
                place_deviation,
                self.compliance_deviation * compliance,
                1.0,
            ]
        )
        return mean, deviation

    @property
    def decay(self) -> FloatArray:
        """Factors by which states return to the prior in a sample, (8,)."""
        times = np.full(kernel.STATES, np.inf)
        times[[kernel.OFFSET_Y, kernel.OFFSET_X]] = self.offset_ay_time, self.offset_ax_time
        times[kernel.ERROR] = self.axle_error_time
        return np.exp(-1.0 / (self.rate_hz * times * math.sqrt(self.wheelbase / TYPICAL_WHEELBASE)))

    @property
    def noise(self) -> FloatArray:
        """Variances that a sample of steady driving adds to the states, (8,)."""
        n = self.numbers()
        noise = np.square(self.prior[1]) * (1.0 - np.square(self.decay))
        noise[[kernel.V, kernel.U]] = n.dt * n.noise_vy**2, n.dt * n.noise_vx**2
        return noise

    def numbers(self) -> Any:
        """`Numbers` of the compiled recursion."""
        return Numbers(**self.number_values())

    def number_values(self) -> dict[str, float]:
        """Numbers of the compiled recursion: settings, scaled to the car, and derived ones."""
        values = {name: float(getattr(self.settings, name)) for name in NUMERIC}
        values |= {
            "dt": 1.0 / self.rate_hz,
            "point": self.rear if self.point == "cg" else 0.0,
            "is_moved": float(self.point != "imu"),
            "network_rear": TYPICAL_REAR * self.wheelbase,
            "yaw_rate_max": self._width,
            "without_ax": float(not self.measured_ax),
        }
        values["point_deviation"] *= self.wheelbase  # m
        if self.rate_hz != NETWORK_HZ or self.wheelbase < self.network_wheelbase:
            values["network_odds"] = NEGLIGIBLE_ODDS  # it was trained for its rate and larger cars
        powers = WHEELBASE_POWERS | {"steady_odds": -self.steady_power}
        for name, power in powers.items():
            values[name] *= (self.wheelbase / TYPICAL_WHEELBASE) ** power
        if not self.measured_ax:
            values |= {"noise_vx": UNMEASURED_AX_NOISE, "longitudinal_power": 0.0}
        return values

    def first_state(self, sample: FloatArray, initial_state: Mapping[str, float]) -> kernel.State:
        """State before the first sample: the priors, with v of the initial state, else 0, and u as
        measured.
        """
        mean, deviation = self.prior
        mean[kernel.V] = initial_state.get("vy", 0.0)
        mean[kernel.U] = sample[1]
        lags = np.zeros(kernel.LAGGED)
        first = self.with_ax(sample[None])[0]
        lags[[kernel.YAW_RATE, kernel.AY, kernel.AX, kernel.SPEED, kernel.AX_OF_SPEED]] = (
            *first[[0, 2, 3]],
            sample[1],
            sample[1],
        )
        lags[kernel.PREDICTED] = first[0] * (
            TYPICAL_REAR * self.wheelbase - mean[kernel.COMPLIANCE] * first[1] ** 2
        )
        weights = self.bank_arrays[1]
        means = np.tile(mean, (len(weights), 1))
        covariances = np.tile(np.diag(np.square(deviation)), (len(weights), 1, 1))
        candidates = np.zeros((kernel.CANDIDATES, kernel.MOMENTS)), np.ones(kernel.CANDIDATES)
        return kernel.State(
            means, covariances, weights, lags, *candidates, first, np.tile(first, (WINDOW, 1))
        )

    def run(self, samples: FloatArray, state: kernel.State) -> tuple[dict[str, Any], kernel.State]:
        """Estimate vy [m/s] and its variance [m²/s²] at each sample."""
        if self.smoothed:
            estimates = smooth(self, samples, state)
        else:
            estimates, _, state = self.trace(samples, state, last_only=True)
        variance = estimates[:, 1].reshape(-1, 1, 1).copy()
        return {"vy": estimates[:, 0].copy(), "covariance": variance}, state

    def trace(
        self, samples: FloatArray, state: kernel.State, last_only: bool = False
    ) -> tuple[FloatArray, FloatArray, kernel.State]:
        """Estimate further samples from a state, which is not changed, and return the identified
        parameters, too.

        Parameters
        ----------
        samples : array
            Values of ``channels``, (T, C).
        state : State
            That before the first of them.
        last_only : bool
            Whether to return the parameters at the last sample alone.

        Returns
        -------
        tuple
            vy at the reference point [m/s] and its variance, (T, 2); means and variances of the
            states over the bank, (T, 16) or (1, 16); the state after the last sample.
        """
        state = kernel.State(*(part.copy() for part in state))
        estimates = np.empty((len(samples), 2))
        parameters = np.empty((1 if last_only else len(samples), 2 * kernel.STATES))
        rows = self.with_ax(samples)
        kernel.scan(*self.recursion_arguments, self.network, state, rows, estimates, parameters)
        return estimates, parameters, state

    @cached_property
    def recursion_arguments(self) -> tuple[Any, ...]:
        """First arguments of `kernel.scan`: numbers, bank, priors, decay.

        Computed for every sample, they would take ten times as long as the recursion.
        """
        return (self.numbers(), *self.bank_arrays, *self.prior, self.decay)

    def with_ax(self, samples: FloatArray) -> FloatArray:
        """Samples with a column for ax, also where it is not measured."""
        return np.ascontiguousarray(
            samples if self.measured_ax else np.column_stack([samples, np.zeros(len(samples))])
        )

    def c_values(self) -> dict[str, Any]:
        """Numbers, priors and the network for the C template."""
        n = self.numbers()
        mean, deviation = self.prior
        grips, start = self.bank_arrays
        gain_times = {
            "g": n.axle_lag,
            "g_1": n.residual_time,
            "g_slow": n.slow_time,
            "g_band": n.band_time,
            "g_reached": n.reached_time,
        }
        gains = {name: -math.expm1(-n.dt / time) for name, time in gain_times.items()}
        return c_tables(self.network, WINDOW, self.rate_hz, self._width, bias=True) | {
            "numbers": self.number_values() | gains,
            "grips": grips,
            "start": start,
            "prior": mean,
            "spread": deviation,
            "decay": self.decay,
            "noise": self.noise,
            "odds": np.log([1.0, n.network_odds, n.steady_odds]),
            "measured_ax": self.measured_ax,
            "least_limit": kernel.MIN_GRIP_SHARE,
            "rolling": kernel.ROLLING_DEVIATION,
            "max_error_of_place": kernel.MAX_ERROR_OF_PLACE,
            "least_ay": kernel.LEAST_AY,
        }

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """The network's rows, (P, 8 + 6 Q), and the yaw rate of its last local model [rad/s]."""
        return {"network": self.network, "yaw_rate_max": np.array([self._width])}

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Set the network.

        Raises
        ------
        DataError
            A part is missing, has another shape, or spans no yaw rate.
        """
        require_shapes(
            self, weights, {name: values.shape for name, values in self.weights().items()}
        )
        require_positive("yaw_rate_max", float(weights["yaw_rate_max"][0]))
        self.network = np.ascontiguousarray(weights["network"])
        self._width = float(weights["yaw_rate_max"][0])
        self.__dict__.pop("recursion_arguments", None)


@cache
def _shipped_network() -> tuple[FloatArray, float]:
    """The network that comes with vehest.

    Returns its rows, (P, 8 + 6 Q), and the yaw rate of its last local model [rad/s].
    """
    weights = load_model(Path(__file__).parents[1] / "pretrained").weights()
    rows = packed({name: values.astype(np.float64) for name, values in weights.items()})
    return rows, float(weights["yaw_rate_max"])


ESTIMATOR = SelfCalibrating  # class by which the registry finds the family
