"""Self-calibrating filter: finds the rear axle, roll leakage and offsets of a car on the drive, without any reference."""

from __future__ import annotations

import math
from collections import namedtuple
from collections.abc import Mapping
from dataclasses import fields
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError
from vehest.declared import UNSET, setting
from vehest.estimators.base import Trial, rate, require_positive, require_shapes
from vehest.estimators.kernels import self_calibrating as kernel
from vehest.estimators.kernels.ksnn import c_tables, packed
from vehest.estimators.ksnn import Ksnn
from vehest.estimators.model_files import load_model
from vehest.estimators.recursive import Recursive

TYPICAL_WHEELBASE = 2.7  # m
TYPICAL_REAR = 0.48  # of the wheelbase, where the centre of gravity is not given
SCALED = {
    **dict.fromkeys(
        ("axle_lag", "residual_time", "slow_time", "band_time", "memory", "decision_time"), 0.5
    ),
    **dict.fromkeys(
        ("minimum_speed", "noise_speed", "axle_constant", "axle_white", "residual_floor"), 0.5
    ),
    **{"noise_vy": 0.25, "noise_vx": 0.25, "noise_delay": 0.75, "compliance": -0.5},
}
"""Powers of the wheelbase over the typical one that scale settings: times and speeds go with its root, tyres of small cars slip more."""
REFERENCE_POINTS = ("cg", "rear_axle", "imu")
WINDOW = 30
NETWORK_HZ = 20.0  # samples that the network sees, and their rate
UNLIKELY = 1e-300  # weight of what does not count
UNMEASURED = 20.0  # m/s per √s: process noise of u where ax is not measured


class SelfCalibrating(Recursive):
    """A bank of Kalman filters over grip limits of the rear axle, weighed against a network and steady cornering.

    v' = (1 - κ) ay - β_y - ω u,   u' = ax - β_x + ω v,   u measured,
    0 = v - b ω + C u φ(a_r) + s e,   a_r = (1 - κ)(ay - β_y) - b ω',   φ(a) = a_m (1 - (1 - |a|/a_m)^p)/p sign(a),   a_m² = a_max² - ax²

    with offsets β, roll leakage κ, distance b and compliance C of the rear axle, and its correlated error e. Filters differ in a_max
    and count by the likelihood of their innovations. Their mean, the network that comes with vehest and
    v = ω (b - C u²) with the priors of b and C count by how well each explains v' and u' on the drive so far, which needs no reference.
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
    version = "6"
    covariance_of = ("vy",)
    channels: tuple[str, ...] = ("yaw_rate", "vx", "ay", "ax")  # type: ignore[misc]  # ax may be absent
    notice = Ksnn.notice
    slow_kernel = "vehest.estimators.kernels.self_calibrating:scan"
    offline = "estimator 'self_calibrating' smooths a whole drive and cannot run online; use estimator.smoothed=false"
    template = "self_calibrating"
    adapts = True  # the axle, the offsets and the weights of filters and candidates
    refuses = ("NaN", "infinite")
    rate_hz: float = rate(20.0)
    wheelbase: float = setting(TYPICAL_WHEELBASE, "wheelbase", unit="m", least=0.05, most=20.0)
    cg_to_rear_axle: float = setting(
        UNSET,
        "distance of the centre of gravity from the rear axle; null: 0.48 wheelbases",
        unit="m",
    )
    imu_to_rear_axle: float = setting(
        UNSET,
        "distance of the inertial unit from the rear axle, negative behind it; null: identified",
        unit="m",
    )
    reference_point: str = setting(
        "",
        "point of v: cg, rear_axle or imu; empty: cg where cg_to_rear_axle is given, else imu",
    )
    smoothed: bool = setting(False, "whether each estimate is made of the whole drive, offline")
    measured_ax: bool = setting(
        True, "whether ax is measured; else the longitudinal equation is unused"
    )
    grips: tuple[float, ...] = setting(
        (4.5, 6.0, 7.5, 9.0, 10.5, 12.0, 14.0, 17.0, 25.0), "grip limits a_max of the bank [m/s²]"
    )
    grip: float = setting(14.0, "median of the prior of a_max", unit="m/s²", positive=True)
    grip_deviation: float = setting(0.55, "deviation of its logarithm", positive=True)
    grip_excess: float = setting(
        2.0,
        "deviation over a second of accelerations beyond a grip limit",
        unit="m/s²",
        positive=True,
    )
    exponent: float = setting(0.25, "p of the axle's curve", above=0.0, most=1.0)
    largest_share: float = setting(
        0.98, "of the grip limit at which the curve is cut off", above=0.0, below=1.0
    )
    compliance: float = setting(
        0.0045, "prior of C of a car of 2.7 m", unit="rad s²/m", positive=True
    )
    compliance_deviation: float = setting(0.5, "its deviation over C", positive=True)
    leakage: float = setting(0.03, "prior of κ", least=-0.5, most=0.5)
    leakage_deviation: float = setting(0.05, "its deviation", positive=True)
    imu_deviation: float = setting(
        0.02, "deviation of a given imu_to_rear_axle over the wheelbase", positive=True
    )
    place: float = setting(
        0.35,
        "prior of b over the wheelbase where imu_to_rear_axle is not given",
        least=-1.0,
        most=2.0,
    )
    place_deviation: float = setting(0.5, "its deviation", positive=True)
    point_deviation: float = setting(
        0.07, "deviation of the reference point's place over the wheelbase, in bands", least=0.0
    )
    offset_ay: float = setting(0.65, "deviation of β_y", unit="m/s²", positive=True)
    offset_ay_time: float = setting(20.0, "time constant of β_y", unit="s", positive=True)
    offset_ax: float = setting(0.2, "deviation of β_x", unit="m/s²", positive=True)
    offset_ax_time: float = setting(10.0, "time constant of β_x", unit="s", positive=True)
    noise_vy: float = setting(0.05, "process noise of v over a second", unit="m/s", positive=True)
    noise_delay: float = setting(
        0.02, "process noise of v for each m/s³ by which u ω changes", unit="√s³", least=0.0
    )
    noise_vx: float = setting(0.1, "process noise of u over a second", unit="m/s", positive=True)
    noise_speed: float = setting(0.15, "deviation of the measured speed", unit="m/s", positive=True)
    axle_lag: float = setting(
        0.3, "low-pass of v, ω and ay in the axle's equation", unit="s", positive=True
    )
    axle_error_time: float = setting(2.0, "time constant of e", unit="s", positive=True)
    axle_constant: float = setting(
        0.007, "size s of the axle's error: constant", unit="m/s", positive=True
    )
    axle_per_speed: float = setting(0.0009, "size over speed", least=0.0)
    axle_per_slip: float = setting(0.03, "size over speed, prior of C and |φ|", least=0.0)
    axle_per_bend: float = setting(
        4.0, "size over speed and prior of C, times φ' - 1", unit="m/s²", least=0.0
    )
    axle_per_slope: float = setting(
        0.05, "size over speed and prior of C, times φ'", unit="m/s²", least=0.0
    )
    axle_white: float = setting(0.03, "white error of the axle", unit="m/s", positive=True)
    axle_white_share: float = setting(0.3, "white share of its variance", least=0.0)
    gate: float = setting(3.0, "deviations at which an innovation is cut off", positive=True)
    memory: float = setting(
        150.0,
        "time after which the drive counts e times less in all weights",
        unit="s",
        positive=True,
    )
    minimum_speed: float = setting(
        3.0, "speed below which v = b ω and parameters stay", unit="m/s", positive=True
    )
    variance_share: float = setting(
        0.3, "share of the filters' and candidates' variance that is reported", positive=True
    )
    error_share: float = setting(
        0.17, "share of the mean square of the axle's error s e that is reported, too", least=0.0
    )
    band_time: float = setting(
        1.0, "time over which that mean square is taken", unit="s", positive=True
    )
    angle_floor: float = setting(
        0.0024, "least deviation of the sideslip angle", unit="rad", least=0.0
    )
    residual_time: float = setting(
        1.0, "high-pass of v in the candidates' residuals", unit="s", positive=True
    )
    slow_time: float = setting(20.0, "high-pass of the residuals", unit="s", positive=True)
    residual_floor: float = setting(
        0.03, "residual below which candidates are alike", unit="m/s", positive=True
    )
    largest_leakage: float = setting(
        0.05, "of κ that residuals of the candidates are freed of", least=0.0
    )
    lateral_power: float = setting(5.0, "power by which the residual of v' counts", least=0.0)
    longitudinal_power: float = setting(7.0, "power by which the residual of u' counts", least=0.0)
    network_odds: float = setting(
        1.0, "weight of the network over the bank's at the start", positive=True
    )
    decision_time: float = setting(
        5.0, "driving after which residuals count half", unit="s", positive=True
    )
    steady_odds: float = setting(
        0.4, "weight of steady cornering over the bank's at the start", positive=True
    )
    steady_power: float = setting(
        3.0, "power of the typical wheelbase over the car's by which it grows", least=0.0
    )
    network_wheelbase: float = setting(
        1.5,
        "shortest wheelbase of cars for which the network counts and the place of the unit is identified",
        unit="m",
        least=0.0,
    )

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self.channels = type(self).channels if self.measured_ax else type(self).channels[:3]
        self.network, self._width = _shipped_network()

    def check(self) -> None:
        """Raises `ConfigurationError`: a centre of gravity outside of the wheelbase, or grip limits that are none."""
        if self.cg_to_rear_axle is not None and not 0.0 < self.cg_to_rear_axle < self.wheelbase:
            raise ConfigurationError(
                f"estimator.cg_to_rear_axle must lie between 0 and the wheelbase ({self.wheelbase} m), not at {self.cg_to_rear_axle}"
            )
        imu = self.imu_to_rear_axle
        if imu is not None and not -self.wheelbase <= imu <= 2.0 * self.wheelbase:
            raise ConfigurationError(
                "estimator.imu_to_rear_axle must lie between one wheelbase behind the rear axle and two ahead of it "
                f"({-self.wheelbase} to {2.0 * self.wheelbase} m), not at {imu}"
            )
        if self.reference_point not in ("", *REFERENCE_POINTS):
            raise ConfigurationError(
                f"estimator.reference_point must be {', '.join(REFERENCE_POINTS)} or empty, not '{self.reference_point}'"
            )
        if not self.grips or not all(limit > 0.0 for limit in self.grips):
            raise ConfigurationError(
                f"estimator.grips must be positive accelerations, not {list(self.grips)}"
            )

    @property
    def causal(self) -> bool:
        """Unless it smooths."""
        return not self.smoothed

    @property
    def full_title(self) -> str:
        """Title with whether it smooths."""
        return f"{self.title}, smoothed" if self.smoothed else self.title

    @property
    def point(self) -> str:
        """The point of the car that v belongs to: cg, rear_axle or imu."""
        return self.reference_point or ("imu" if self.cg_to_rear_axle is None else "cg")

    @property
    def rear(self) -> float:
        """Distance of the centre of gravity from the rear axle [m], as given or typical."""
        return (
            TYPICAL_REAR * self.wheelbase
            if self.cg_to_rear_axle is None
            else float(self.cg_to_rear_axle)
        )

    @property
    def imu_prior(self) -> tuple[float, float]:
        """Mean and standard deviation of the inertial unit's distance from the rear axle at the start [m]."""
        if self.imu_to_rear_axle is not None:
            return float(self.imu_to_rear_axle), self.imu_deviation * self.wheelbase
        if self.wheelbase < self.network_wheelbase:  # their sensors do not resolve the place
            return self.rear, self.imu_deviation * self.wheelbase
        mean = self.place * self.wheelbase if self.cg_to_rear_axle is None else self.rear
        return mean, self.place_deviation * self.wheelbase

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
        own = (
            self.leakage_deviation,
            place_deviation,
            self.compliance_deviation * compliance,
            1.0,
        )
        return mean, np.array([0.3, self.noise_speed, self.offset_ay, self.offset_ax, *own])

    @property
    def decay(self) -> FloatArray:
        """Factors by which states return to the prior in a sample, (8,)."""
        times = np.array(
            [
                np.inf,
                np.inf,
                self.offset_ay_time,
                self.offset_ax_time,
                np.inf,
                np.inf,
                np.inf,
                self.axle_error_time,
            ]
        )
        return np.exp(-1.0 / (self.rate_hz * times * math.sqrt(self.wheelbase / TYPICAL_WHEELBASE)))

    @property
    def noise(self) -> FloatArray:
        """Variances by which states grow in a sample of steady driving, (8,)."""
        n = self.numbers()
        noise = np.square(self.prior[1]) * (1.0 - np.square(self.decay))
        noise[[kernel.V, kernel.U]] = n.dt * n.noise_vy**2, n.dt * n.noise_vx**2
        return noise

    def numbers(self) -> Any:
        """What the compiled recursion takes: numeric settings, times scaled, and what follows from them."""
        own = {
            name: float(value)
            for name, value in vars(self.settings).items()
            if name in Numbers._fields
        }
        own |= {
            "dt": 1.0 / self.rate_hz,
            "network_rear": TYPICAL_REAR * self.wheelbase,
            "is_moved": float(self.point != "imu"),
            "point": self.rear if self.point == "cg" else 0.0,
        }
        own["point_deviation"] *= self.wheelbase  # m
        own |= {"yaw_rate_max": self._width, "without_ax": float(not self.measured_ax)}
        if self.rate_hz != NETWORK_HZ or self.wheelbase < self.network_wheelbase:
            own["network_odds"] = UNLIKELY  # its weights hold for its own steps alone
        powers = SCALED | {"steady_odds": -self.steady_power}
        own |= {
            name: own[name] * (self.wheelbase / TYPICAL_WHEELBASE) ** power
            for name, power in powers.items()
        }
        if not self.measured_ax:
            own |= {"noise_vx": UNMEASURED, "longitudinal_power": 0.0}
        return Numbers(**own)

    def first_state(self, sample: FloatArray, given: Mapping[str, float]) -> kernel.State:
        """The priors, v = 0 or what is given, and the measured speed."""
        mean, deviation = self.prior
        mean[kernel.V] = given.get("vy", 0.0)
        mean[kernel.U] = sample[1]
        lags = np.zeros(kernel.LAGS)
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
        """vy [m/s] and its variance."""
        if self.smoothed:
            found = _smoothed(self, samples, state)
        else:
            found, _, state = self.trace(samples, state, 1)
        return {"vy": found[:, 0].copy(), "covariance": found[:, 1].reshape(-1, 1, 1).copy()}, state

    def trace(
        self, samples: FloatArray, state: kernel.State, kept: int | None = None
    ) -> tuple[FloatArray, FloatArray, kernel.State]:
        """vy and its variance, (T, 2), means and variances of the states over the bank, (T, 16), and the state after the last sample.

        With ``kept=1`` those of the states are of the last sample alone.
        """
        state = kernel.State(*(part.copy() for part in state))
        found = np.empty((len(samples), 2))
        parameters = np.empty((kept or len(samples), 2 * kernel.STATES))
        rows = self.with_ax(samples)
        kernel.scan(*self._constants, self.network, state, rows, found, parameters)
        return found, parameters, state

    @cached_property
    def _constants(self) -> tuple[Any, ...]:
        """What the recursion takes of settings and network; made for every sample, they took ten times as long as the recursion."""
        return (self.numbers(), *self.bank_arrays, *self.prior, self.decay)

    def with_ax(self, samples: FloatArray) -> FloatArray:
        """Samples with a column for ax, also where it is not measured."""
        return np.ascontiguousarray(
            samples if self.measured_ax else np.column_stack([samples, np.zeros(len(samples))])
        )

    def c_values(self) -> dict[str, Any]:
        """Numbers, priors and the network."""
        n = self.numbers()
        (mean, deviation) = self.prior
        (grips, start) = self.bank_arrays
        gains = {"g": n.axle_lag, "g_1": n.residual_time, "g_slow": n.slow_time}
        gains["g_band"] = n.band_time
        return c_tables(self.network, WINDOW, self.rate_hz, self._width, bias=True) | {
            "numbers": n._asdict()
            | {name: -math.expm1(-n.dt / time) for name, time in gains.items()},
            "grips": grips,
            "start": start,
            "prior": mean,
            "spread": deviation,
            "decay": self.decay,
            "noise": self.noise,
            "odds": np.log([1.0, n.network_odds, n.steady_odds]),
            "measured_ax": self.measured_ax,
            "least_limit": kernel.LEAST_LIMIT,
            "rolling": kernel.ROLLING,
            "max_error_of_place": kernel.MAX_ERROR_OF_PLACE,
        }

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """The network's rows, and the yaw rate of its last local model."""
        return {"network": self.network, "yaw_rate_max": np.array([self._width])}

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Take the network back.

        Raises `DataError`: a part is missing, has another shape, or spans no yaw rate.
        """
        require_shapes(
            self, weights, {name: values.shape for name, values in self.weights().items()}
        )
        require_positive("yaw_rate_max", float(weights["yaw_rate_max"][0]))
        self.network = np.ascontiguousarray(weights["network"])
        self._width = float(weights["yaw_rate_max"][0])
        self.__dict__.pop("_constants", None)


@cache
def _shipped_network() -> tuple[FloatArray, float]:
    """Rows of the network that comes with vehest, (P, 8 + 6 Q), and the yaw rate of its last local model [rad/s]."""
    weights = load_model(Path(__file__).parents[1] / "pretrained").weights()
    return packed({name: values.astype(np.float64) for name, values in weights.items()}), float(
        weights["yaw_rate_max"]
    )


def _smoothed(estimator: Any, samples: FloatArray, state: kernel.State) -> FloatArray:
    """v [m/s] at the reference point and its variance, (T, 2), each from all samples.

    The filter that is likeliest at the drive's end is smoothed, its parameters included (Rauch, Tung & Striebel 1965). Network and steady
    cornering count by their weights at the end.

    Args:
        estimator: a `SelfCalibrating`.
        samples: of its channels, (T, C).
        state: before the first of them.
    """
    _, _, last = estimator.trace(samples, state)
    best = int(np.argmax(last.log_weights))
    n = estimator.numbers()
    mean = estimator.prior[0]
    decay = estimator.decay
    state = kernel.State(*(part.copy() for part in state))
    rows = estimator.with_ax(samples).copy()
    before = state.last.copy()
    means = np.empty((len(rows), kernel.STATES))
    covariances = np.empty((len(rows), kernel.STATES, kernel.STATES))
    network = np.empty(len(rows))
    turning = np.empty(len(rows))
    scratch = (np.empty((1, 2)), np.empty((1, 2 * kernel.STATES)))
    for k in range(len(rows)):
        network[k] = state.lags[kernel.PREDICTED]
        turning[k] = -state.lags[kernel.YAW_RATE]
        kernel.scan(*estimator._constants, estimator.network, state, rows[k : k + 1], *scratch)
        turning[k] += state.lags[kernel.YAW_RATE]
        means[k] = state.means[best]
        covariances[k] = state.covariances[best]
        rows[k] = state.last
    middle = (np.vstack([before, rows[:-1]]) + rows) / 2.0  # yaw rate, u, ay, ax
    turn = rows[:, 0] * rows[:, 1]
    turn = (np.append(before[0] * before[1], turn[:-1]) + turn) / 2.0
    constant = mean * (1.0 - decay)
    constant[[kernel.V, kernel.U]] = 0.0
    noise = np.tile(estimator.noise, (len(rows), 1))
    noise[:, kernel.V] += n.dt * (n.noise_delay * turning / n.dt * rows[:, 1]) ** 2
    x = means[-1].copy()
    p = covariances[-1].copy()
    found = np.empty((len(rows), 3))
    row = np.zeros(kernel.STATES)
    row[kernel.V] = 1.0
    for k in range(len(rows) - 1, -1, -1):
        row[kernel.REAR] = -n.is_moved * rows[k, 0]
        found[k] = x[kernel.V], x[kernel.REAR], row @ p @ row
        if k == 0:
            break
        step = np.eye(kernel.STATES)
        step[kernel.V, kernel.LEAKAGE] = -n.dt * middle[k, 2]
        step[kernel.V, kernel.OFFSET_Y] = -n.dt
        step[kernel.U, kernel.V] = n.dt * middle[k, 0]
        step[kernel.U, kernel.OFFSET_X] = -n.dt
        step *= decay[:, None]
        predicted = step @ means[k - 1] + constant
        predicted[[kernel.V, kernel.U]] += n.dt * (middle[k, 2] - turn[k]), n.dt * middle[k, 3]
        spread = step @ covariances[k - 1] @ step.T + np.diag(noise[k])
        gain = np.linalg.solve(spread, step @ covariances[k - 1]).T
        x = means[k - 1] + gain @ (x - predicted)
        p = covariances[k - 1] + gain @ (p - spread) @ gain.T
    shift = n.is_moved * (n.point - found[:, 1]) * rows[:, 0]
    own = found[:, 0] + shift
    network += (found[:, 1] - n.network_rear) * rows[:, 0] + shift
    steady = rows[:, 0] * (found[:, 1] - n.compliance * np.square(rows[:, 1])) + shift
    moving = np.clip(rows[:, 1] / n.minimum_speed - 1.0, 0.0, 1.0)
    shares = last.weights * np.column_stack([moving, moving, np.ones(len(rows))])
    shares[:, kernel.BANK] = 1.0 - shares[:, kernel.NETWORK] - shares[:, kernel.STEADY]
    values = np.column_stack([own, network, steady])
    vy = (shares * values).sum(axis=1)
    variance = found[:, 2] + (shares * np.square(values - vy[:, None])).sum(axis=1)
    return np.column_stack(
        [
            vy,
            variance
            + np.square(n.angle_floor * rows[:, 1])
            + np.square(n.point_deviation * rows[:, 0]),
        ]
    )


NUMERIC = [
    own.name
    for own in fields(SelfCalibrating.settings_type)
    if isinstance(own.default, int | float)
]
DERIVED = ["dt", "point", "is_moved", "network_rear", "yaw_rate_max", "without_ax"]
Numbers: Any = namedtuple("Numbers", NUMERIC + DERIVED)  # type: ignore[misc]  # importable by its name, else compiled code is not found again

ESTIMATOR = SelfCalibrating
