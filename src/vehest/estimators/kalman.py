"""Kalman filter over the linear single track.

    high-passed signals --read_levels--> σ_r, σ_ay, σ_δ
    samples (T, 4) --filter_samples: `LinearModel`, kalman_scan--> β, r, offsets --> vy

The model is linear in the state for a known speed, so that the filter is exact but for the
discretisation by forward Euler.

Source: the KF of Leanza et al. 2021, as in Table VI of Da Lio et al. 2023.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.declared import Declaration, Group, setting
from vehest.estimators.base import FitData, FitRecord, Trial
from vehest.estimators.filtering.sideslip_filter import FilteredStates, SideslipFilter, read_levels
from vehest.filters.gating import Gate
from vehest.filters.gaussian import Gaussian
from vehest.filters.kalman import LinearModel
from vehest.filters.kalman_scan import kalman_scan
from vehest.training.context import FitContext

LEVELS = ("yaw_rate", "ay", "steer")  # channels whose noise level the filter needs
MIN_LEVEL = 1e-9  # rad/s, m/s², rad: a level below it is no noise but rounding


@dataclass(frozen=True)
class SensorNoise(Group):
    """Standard deviations of the sensors' noise, given or read off high-passed signals."""

    group = "estimator.noise"
    read_from: Literal["training", "recording"] = setting(
        "training", "recordings of the fit, or each recording as a whole (offline)"
    )
    yaw_rate: float | None = setting(
        None, "of the gyroscope; null: read off", unit="rad/s", positive=True
    )
    ay: float | None = setting(
        None, "of the accelerometer; null: read off", unit="m/s²", positive=True
    )
    steer: float | None = setting(
        None, "of the steering angle; null: read off", unit="rad", positive=True
    )
    cutoff: float = setting(
        0.2,
        "fraction of the Nyquist frequency above which signals count as noise",
        least=0.001,  # the filter's length grows with its inverse
        below=0.8,
    )
    steer_factor: float = setting(
        1000.0, "factor of the steering's level, as in the authors' code", positive=True
    )

    @property
    def unknown(self) -> tuple[str, ...]:
        """Noise levels that the settings leave to be read off the signals."""
        return tuple(name for name in LEVELS if getattr(self, name) is None)


@dataclass(frozen=True)
class SensorOffsets(Group):
    """Offsets that are states, first-order Gauss-Markov processes.

    As a state, an error that is constant within a manoeuvre adds to the covariance of the filter.

    Source: Bar-Shalom, Li & Kirubarajan 2001 (autocorrelated noise by augmentation).
    """

    group = "estimator.offsets"
    ay: float | None = setting(
        None,
        "of the accelerometer, or of the road's bank; null: no state",
        unit="m/s²",
        positive=True,
    )
    steer: float | None = setting(
        None, "of the steering angle; null: no state", unit="rad", positive=True
    )
    seconds: float = setting(
        60.0, "time in which an offset's correlation falls to 1/e", unit="s", positive=True
    )

    @property
    def names(self) -> tuple[str, ...]:
        """Channels whose offset is a state."""
        return tuple(name for name in ("ay", "steer") if getattr(self, name) is not None)


class KalmanFilter(SideslipFilter):
    """Kalman filter of sideslip angle and yaw rate, which measures a_y and r.

    The steering angle is a noisy input.

    Process noise (σ_δ · factor)² B Bᵀ, measurement noise diag(σ_ay², σ_r²). The three levels, which
    are `values`, are standard deviations of the high-passed signals; no reference is looked at.

    Source: Leanza, Reina & Blanco-Claraco, Sensors 21 (16), 5409, 2021, and the authors' public
    code.
    """

    name = "kalman"
    title = "Kalman filter"
    trials = (
        Trial(
            5, "single-track (bicycle-model) Kalman filter; only noise levels are fitted", "{car}"
        ),
    )
    learns_from = ()
    may_be_nan = LEVELS
    template = "kalman"
    offline = (
        "a Kalman filter that reads its noise levels off the whole recording cannot run along "
        "with a drive; set estimator.noise.read_from=training, or give the levels"
    )
    noise: SensorNoise = setting(SensorNoise(), "standard deviations of the sensors' noise")
    offsets: SensorOffsets = setting(
        SensorOffsets(),
        "standard deviations of offsets that are states; null: none, as in the paper",
    )
    initial_deviation: float = setting(
        100.0, "of β and r before the first sample", unit="rad, rad/s", positive=True
    )

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self.values = {
            name: math.nan if name in self.noise.unknown else getattr(self.noise, name)
            for name in LEVELS
        }
        self.unknown = self.noise.unknown if self.noise.read_from == "training" else ()

    @property
    def causal(self) -> bool:
        """False where noise levels are read off the whole recording, later samples included."""
        return self.noise.read_from == "training" or not self.noise.unknown

    @property
    def adapts(self) -> bool:
        """Whether offsets are states."""
        return bool(self.offsets.names)

    @property
    def variant(self) -> str:
        """Identifier with the source of noise levels (unless it is the training), the offsets and
        the gate.
        """
        noise = "" if self.learns else "_given_noise" if self.causal else "_own_noise"
        offsets = "".join(f"_{name}_offset" for name in self.offsets.names)
        return self.name + noise + offsets + self.gate_suffix

    @property
    def full_title(self) -> str:
        """Title with the source of the noise levels, the offsets and the gate."""
        noise = (
            ""
            if self.learns
            else f", noise {'given' if self.causal else 'read off the recording itself'}"
        )
        names = {"ay": "ay", "steer": "the steering angle"}
        offsets = "".join(f", offset of {names[name]}" for name in self.offsets.names)
        return self.title + noise + offsets + self.gate_title

    def declarations_of_values(self) -> Mapping[str, Declaration]:
        """Declarations (units and bounds) of the noise levels, by name."""
        return self.noise.declarations()

    def find_numbers(
        self, data: FitData, training: Any, context: FitContext
    ) -> tuple[Mapping[str, float], FitRecord]:
        """Noise levels of the measured channels of the training recordings."""
        return self._levels_of(data.train), FitRecord()

    def _levels_of(self, recordings: Sequence[Recording]) -> dict[str, float]:
        """All noise levels, name -> value: those that are given, and those read off the measured
        channels of recordings.
        """
        return self.values | read_levels(
            recordings, self.noise.unknown, self.noise.cutoff, MIN_LEVEL
        )

    def estimate_recording(
        self, recording: Recording, initial_state: Mapping[str, float] | None
    ) -> Estimate:
        """Estimate a recording, with noise levels of its own where nothing else provides them."""
        fitted = self
        if not self.causal:
            fitted = copy(self)
            fitted.values = self._levels_of([recording])
        return super(KalmanFilter, fitted).estimate_recording(recording, initial_state)

    def first_gaussian(
        self, sample: FloatArray, initial_state: Mapping[str, float]
    ) -> Gaussian[FloatArray]:
        """State before the first sample: β and r, and offsets of 0 with the standard deviations of
        the settings.
        """
        offsets = [getattr(self.offsets, name) for name in self.offsets.names]
        return self.first_motion(
            sample,
            np.array([self.initial_deviation, self.initial_deviation, *offsets]),
            initial_state,
        )

    def filter_samples(
        self,
        samples: FloatArray,
        first: Gaussian[FloatArray],
        gate: Gate | None = None,
        refused: NDArray[np.int64] | None = None,
    ) -> FilteredStates:
        """Filter by `kalman_scan`.

        The state is (β [rad], r [rad/s]) and the offsets of ay [m/s²] and of the steering angle
        [rad] that are states, in this order. Measurements are a_y, then r. An offset b decays by
        exp(-τ/T) a sample and keeps the variance of its setting: a_y is measured as a_y + b_ay, and
        wheels stand at δ - b_δ.

        Parameters
        ----------
        samples : array
            Of ``channels``, (T, 4); NaN in yaw rate and ay was not measured.
        first : Gaussian
            State before the first measurement, mean (n,).
        gate : Gate, optional
            Which measurements are refused.
        refused : array, optional
            Counters of the gate, (2,), of a_y and r, changed in place.
        """
        yaw_rate, vx, ay, steer = samples.T
        A, B, C, D = self.sampled_model(vx)
        offsets = self.offsets
        steps = len(samples)
        n = 2 + len(offsets.names)
        transition = np.zeros((steps, n, n))
        noise = np.zeros((steps, n, n))
        observation = np.zeros((steps, 2, n))
        spread = self.values["steer"] * self.noise.steer_factor * B
        transition[:, :2, :2] = A
        noise[:, :2, :2] = spread[:, :, None] * spread[:, None, :]
        observation[:, 0, :2] = C
        observation[:, 1, 1] = 1.0
        decay = math.exp(-1.0 / (offsets.seconds * self.rate_hz))
        for row, name in enumerate(offsets.names, 2):
            transition[:, row, row] = decay
            noise[:, row, row] = getattr(offsets, name) ** 2 * (1.0 - decay**2)
            if name == "ay":
                observation[:, 0, row] = 1.0
            else:
                transition[:, :2, row] = -B
                observation[:, 0, row] = -D
        driven = np.zeros((steps, n))
        driven[:, :2] = B * steer[:, None]
        expected = np.stack([D * steer, np.zeros_like(steer)], axis=1)
        sensors = np.array([self.values["ay"] ** 2, self.values["yaw_rate"] ** 2])
        model = LinearModel(transition, driven, noise, observation, expected, sensors)
        filtered = kalman_scan(model, np.stack([ay, yaw_rate], axis=1), first, gate, refused)
        mean, covariance = filtered.filtered
        innovations = (
            filtered.innovation,
            filtered.innovation_covariance,
            np.asarray(filtered.measured),
        )
        return FilteredStates(
            mean, None, covariance[:, :2, :2], *innovations, Gaussian(mean[-1], covariance[-1])
        )

    def c_values(self) -> dict[str, Any]:
        """Car, noise levels, offsets and gate for the C template."""
        car = self.car
        decay = math.exp(-1.0 / (self.offsets.seconds * self.rate_hz))
        offsets = [
            {
                "name": name,
                "row": row,
                "initial": level,
                "wander": level * math.sqrt(1.0 - decay**2),
            }
            for row, name in enumerate(self.offsets.names, 2)
            for level in (getattr(self.offsets, name),)
        ]
        front = car.cornering_stiffness_front
        rear = car.cornering_stiffness_rear
        return {
            **super().c_values(),
            "n": 2 + len(offsets),
            "columns": 4 + len(offsets) + (len(offsets) > 1),
            "offsets": offsets,
            "kept": decay,
            "car": car,
            "step": 1.0 / self.rate_hz,
            "sum": front + rear,
            "moment": car.cg_to_front_axle * front - car.cg_to_rear_axle * rear,
            "damping": car.cg_to_front_axle**2 * front + car.cg_to_rear_axle**2 * rear,
            "minimum_speed": self.minimum_speed,
            "steer_level": self.values["steer"] * self.noise.steer_factor,
            "sensors": [self.values["ay"], self.values["yaw_rate"]],
            "initial": self.initial_deviation,
        }


ESTIMATOR = KalmanFilter  # class by which the registry finds the family
