"""Kalman filter over the linear single track: the KF of Leanza et al. 2021, as in Table VI of Da Lio et al. 2023."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.base import Estimator, FitData, FitRecord
from vehest.estimators.filtering.single_track import SingleTrackEstimator, SingleTrackSettings, SingleTrackStepper, require_positive
from vehest.filters.gating import Gate, in_words, suffix
from vehest.filters.gaussian import Filtered, Gaussian
from vehest.filters.kalman import LinearModel
from vehest.filters.kalman_scan import kalman_scan
from vehest.filters.noise_levels import high_passed_level
from vehest.training.context import FitContext

LEVELS = ("yaw_rate", "ay", "steer")
SILENT = 1e-9  # rad/s, m/s², rad: a level below it is no noise but rounding


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations of the sensors' noise, given, or else read off measured signals above a frequency.

    Args:
        read_from: ``training`` (the recordings of the fit) or ``recording`` (each recording that is estimated, as a whole).
        yaw_rate: [rad/s]; read if none is given.
        ay: [m/s²]; read if none is given.
        steer: [rad]; read if none is given.
        cutoff: frequency above which signals count as noise, as a fraction of the Nyquist frequency.
        steer_factor: by which the steering's level is multiplied.
    """

    read_from: Literal["training", "recording"] = "training"
    yaw_rate: float | None = None
    ay: float | None = None
    steer: float | None = None
    cutoff: float = 0.2
    steer_factor: float = 1000.0

    def __post_init__(self) -> None:
        if self.read_from not in ("training", "recording"):
            raise ConfigurationError(f"estimator.noise.read_from '{self.read_from}' is not one of: training, recording")
        require_positive("estimator.noise", {name: getattr(self, name) for name in (*LEVELS, "steer_factor")})
        if not 0.0 < self.cutoff < 0.8:
            raise ConfigurationError(f"estimator.noise.cutoff must lie between 0 and 0.8 of the Nyquist frequency, not at {self.cutoff}")

    @property
    def unknown(self) -> tuple[str, ...]:
        """Levels that are not given."""
        return tuple(name for name in LEVELS if getattr(self, name) is None)


@dataclass(frozen=True)
class SensorOffsets:
    """Offsets that are states, first-order Gauss-Markov processes: an error that is constant within a manoeuvre is in the covariance.

    Args:
        ay: standard deviation of the accelerometer's offset, or of the road's bank [m/s²]; none: no such state.
        steer: of the steering angle's [rad]; none: no such state.
        seconds: how long an offset lasts: its correlation falls to 1/e [s].

    Source: Bar-Shalom, Li & Kirubarajan 2001 (autocorrelated noise by augmentation).
    """

    ay: float | None = None
    steer: float | None = None
    seconds: float = 60.0

    def __post_init__(self) -> None:
        require_positive("estimator.offsets", asdict(self))

    @property
    def given(self) -> tuple[str, ...]:
        """Which there are."""
        return tuple(name for name in ("ay", "steer") if getattr(self, name) is not None)


@dataclass(frozen=True)
class KalmanSettings(SingleTrackSettings):
    """Settings of the Kalman filter.

    Args:
        noise: levels of the sensors' noise.
        offsets: of sensors, that are states beside β and r.
        initial_deviation: standard deviation of β and r before the first sample [rad, rad/s].
        gate: standard deviations of an innovation beyond which a measurement is refused in use; none: all are taken. See `Gate`.
    """

    noise: SensorNoise = SensorNoise()
    offsets: SensorOffsets = SensorOffsets()
    initial_deviation: float = 100.0
    gate: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("estimator", {"initial_deviation": self.initial_deviation, "gate": self.gate})


class KalmanFilter(SingleTrackEstimator):
    """Kalman filter of sideslip angle and yaw rate, which measures a_y and r; the steering angle is a noisy input.

    Process noise (σ_δ · factor)² B Bᵀ, measurement noise diag(σ_ay², σ_r²). The three levels are standard deviations of the
    high-passed signals; no reference is looked at.

    Source: Leanza, Reina & Blanco-Claraco, Sensors 21 (16), 5409, 2021, and the authors' public code.
    """

    name = "kalman"
    title = "Kalman filter"
    open_weights = LEVELS
    settings_type = KalmanSettings
    settings: KalmanSettings

    def __init__(self, settings: KalmanSettings) -> None:
        super().__init__(settings)
        self.levels = {name: _number(getattr(settings.noise, name)) for name in LEVELS}

    @property
    def causal(self) -> bool:
        """Not if noise levels are read off the whole recording, later samples included."""
        return self.settings.noise.read_from == "training" or not self.settings.noise.unknown

    @property
    def learns(self) -> bool:
        """Whether noise levels are read off the training recordings."""
        return self.settings.noise.read_from == "training" and bool(self.settings.noise.unknown)

    @property
    def adapts(self) -> bool:
        """Whether offsets are states."""
        return bool(self.settings.offsets.given)

    @property
    def variant(self) -> str:
        """Where the noise levels come from, unless it is the training; offsets and the gate."""
        noise = "" if self.learns else "_given_noise" if self.causal else "_own_noise"
        offsets = "".join(f"_{name}_offset" for name in self.settings.offsets.given)
        return self.name + noise + offsets + suffix(self.settings.gate)

    @property
    def full_title(self) -> str:
        """Title with where the noise levels come from, offsets, and the gate."""
        noise = "" if self.learns else f", noise {'given' if self.causal else 'read off the recording itself'}"
        names = {"ay": "ay", "steer": "the steering angle"}
        offsets = "".join(f", offset of {names[name]}" for name in self.settings.offsets.given)
        return self.title + noise + offsets + in_words(self.settings.gate)

    @property
    def n_parameters(self) -> int:
        """Noise levels that the fit reads."""
        return len(self.settings.noise.unknown) if self.learns else 0

    @classmethod
    def fit_members(cls, members: Sequence[Estimator], data: FitData, training: Any, context: FitContext) -> list[FitRecord]:
        """Read noise levels off the measured channels of the training recordings."""
        started = time.monotonic()
        for member in members:
            assert isinstance(member, KalmanFilter)
            if member.learns:
                member.levels = member._levels_of(data.train)
        return [FitRecord(metrics={"epochs": 0, "train_seconds": (time.monotonic() - started) / len(members)}) for _ in members]

    def _levels_of(self, recordings: Sequence[Recording]) -> dict[str, float]:
        levels = dict(self.levels)
        for name in self.settings.noise.unknown:
            among = f"recording{'s' if len(recordings) > 1 else ''} {', '.join(repr(recording.id) for recording in recordings)}"
            try:
                levels[name] = high_passed_level([recording[name] for recording in recordings], self.settings.noise.cutoff)
            except ValueError as error:
                raise DataError(f"{among}: channel '{name}': {error}; give estimator.noise.{name}") from None
            if not levels[name] > SILENT:
                raise DataError(f"{among}: channel '{name}' has no noise that could be read off it; give estimator.noise.{name}")
        return levels

    def _known_levels(self) -> dict[str, float]:
        if any(math.isnan(level) for level in self.levels.values()):
            raise ConfigurationError("the Kalman filter has no noise levels yet; fit or load it first, or give estimator.noise")
        return self.levels

    def _estimate_one(self, recording: Recording, initial_state: Mapping[str, float] | None) -> Estimate:
        levels = self._known_levels() if self.causal else self._levels_of([recording])
        measurements = recording.stack(self.channels)
        first = self.start(measurements[0, 1], initial_state)
        result = self.filter_samples(measurements, levels, first)
        scaled = np.linalg.solve(result.innovation_covariance, result.innovation[..., None])[..., 0]
        nis = np.einsum("ti,ti->t", result.innovation, scaled)
        n_measured: FloatArray = np.sum(np.asarray(result.measured), axis=1, dtype=np.float64)
        return self.wrapped_state(
            recording, result.filtered.mean[:, :2], result.filtered.covariance[:, :2, :2], nis=nis, nis_dof=n_measured
        )

    def start(self, vx: float, initial_state: Mapping[str, float] | None = None) -> Gaussian[FloatArray]:
        """State before the first sample: β and r, and offsets of 0 that are known to their standard deviations."""
        motion = self.first_state(vx, self.settings.initial_deviation, initial_state)
        variances = [getattr(self.settings.offsets, name) ** 2 for name in self.settings.offsets.given]
        mean, covariance = np.zeros(2 + len(variances)), np.diag([0.0, 0.0, *variances])
        mean[:2], covariance[:2, :2] = motion
        return Gaussian(mean, covariance)

    def filter_samples(
        self,
        samples: FloatArray,
        levels: Mapping[str, float],
        first: Gaussian[FloatArray],
        refused: NDArray[np.int64] | None = None,
    ) -> Filtered[FloatArray]:
        """Filter samples of ``channels``, (T, 4), from a state at the first one before its measurement; ``refused``: see `kalman_scan`."""
        yaw_rate, vx, ay, steer = samples.T
        A, B, C, D = self.sampled_model(vx)
        observation = np.zeros((len(samples), 2, 2))
        observation[:, 0], observation[:, 1, 1] = C, 1.0
        spread = levels["steer"] * self.settings.noise.steer_factor * B
        model = LinearModel(
            transition=A,
            transition_offset=B * steer[:, None],
            process_noise=spread[:, :, None] * spread[:, None, :],
            observation=observation,
            observation_offset=np.stack([D * steer, np.zeros_like(steer)], axis=1),
            observation_noise=np.diag([levels["ay"] ** 2, levels["yaw_rate"] ** 2]),
        )
        model = self._with_offsets(model, B, D)
        gate = Gate.of(self.settings.gate, self.settings.rate_hz)
        return kalman_scan(model, np.stack([ay, yaw_rate], axis=1), first, gate, refused)

    def _with_offsets(self, model: LinearModel[FloatArray], B: FloatArray, D: FloatArray) -> LinearModel[FloatArray]:
        """The model with offsets as states: what is measured is a_y + b_ay, and the wheels stand at δ - b_δ."""
        offsets = self.settings.offsets
        if not offsets.given:
            return model
        steps, n = len(B), 2 + len(offsets.given)
        kept = math.exp(-1.0 / (offsets.seconds * self.settings.rate_hz))
        transition, noise, observation = np.zeros((steps, n, n)), np.zeros((steps, n, n)), np.zeros((steps, 2, n))
        transition[:, :2, :2], noise[:, :2, :2], observation[:, :, :2] = model.transition, model.process_noise, model.observation
        for row, name in enumerate(offsets.given, 2):
            transition[:, row, row] = kept
            noise[:, row, row] = getattr(offsets, name) ** 2 * (1.0 - kept**2)
            if name == "ay":
                observation[:, 0, row] = 1.0
            else:
                transition[:, :2, row], observation[:, 0, row] = -B, -D
        offset = np.concatenate([model.transition_offset, np.zeros((steps, n - 2))], axis=1)
        return LinearModel(transition, offset, noise, observation, model.observation_offset, model.observation_noise)

    def online(self) -> KalmanStepper:
        """A stepper that knows nothing of the state yet."""
        if not self.causal:
            raise ConfigurationError(
                "a Kalman filter that reads its noise levels off the whole recording cannot run along with a drive; "
                "set estimator.noise.read_from=training, or give the levels"
            )
        self._known_levels()
        return KalmanStepper(self)

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """Noise levels; NaN where they are read off each recording."""
        return {name: np.array([level]) for name, level in self.levels.items()}

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Take noise levels back."""
        if set(weights) != set(LEVELS) or any(values.shape != (1,) for values in weights.values()):
            raise DataError(f"weights of 'kalman' must be one level each of {', '.join(LEVELS)}, not {', '.join(weights)}")
        self.levels = {name: float(weights[name][0]) for name in LEVELS}


class KalmanStepper(SingleTrackStepper):
    """The filter, one sample at a time."""

    _estimator: KalmanFilter

    def _first(self, row: FloatArray) -> Gaussian[FloatArray]:
        return self._estimator.start(row[1])

    def _filtered(
        self, rows: FloatArray, state: Gaussian[FloatArray], refused: NDArray[np.int64]
    ) -> tuple[Gaussian[FloatArray], dict[str, float]]:
        filtered = self._estimator.filter_samples(rows, self._estimator.levels, state, refused).filtered
        return Gaussian(filtered.mean[-1], filtered.covariance[-1]), {}


def _number(level: float | None) -> float:
    return math.nan if level is None else level


ESTIMATOR = KalmanFilter
