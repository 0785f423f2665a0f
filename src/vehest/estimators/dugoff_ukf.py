"""Unscented Kalman filter on a single track with Dugoff tyres: the model-based part of Bertipaglia et al. 2024."""

from __future__ import annotations

import fnmatch
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.base import Estimator, EstimatorSettings, FitData, FitRecord, Stepper
from vehest.estimators.filtering.dugoff_fit import DUGOFF_PARAMETERS, fit_dugoff
from vehest.estimators.filtering.single_track import checked_sample, require_positive
from vehest.estimators.filtering.track_filter import Over, TrackFilter, TrackStepper, error_over, groups_of, in_nonlinear_range, padded
from vehest.estimators.references import reference_sideslip
from vehest.filters.gating import Gate, in_words, suffix
from vehest.filters.gaussian import Filtered
from vehest.filters.noise_levels import quiet_level
from vehest.training.context import FitContext
from vehest.training.identification import LEAST_PROCESS_YAW_RATE, IdentificationSettings
from vehest.training.search import SearchRecord, nelder_mead_over_grid, staged_optuna_search
from vehest.vehicle.dugoff import BMW_545I, TRACK_STATES, DugoffAxle, DugoffTrack, LoadedCar

Inputs = Literal["full", "imu"]
WHEELS = {"fy_front": ("fy_fl", "fy_fr"), "fy_rear": ("fy_rl", "fy_rr")}
INERTIAL = ("yaw_rate", "vx", "ay", "steer", "ax")
CHANNELS: dict[str, tuple[str, ...]] = {"full": (*INERTIAL, *(wheel for pair in WHEELS.values() for wheel in pair)), "imu": INERTIAL}
SENSORS: dict[str, tuple[str, ...]] = {"full": ("ay", "yaw_rate", "fy_front", "fy_rear"), "imu": ("ay", "yaw_rate")}
SEARCHED: dict[str, tuple[str, ...]] = {
    "full": ("process_vy", "process_yaw_rate", "force_factor"),
    "imu": ("process_vy", "process_yaw_rate"),
}
ASSUMED = {"process_vy": 7e-4, "process_yaw_rate": 2e-3, "force_factor": 1.0}  # the first two: Bertipaglia et al. 2024
BOXES = {"process_vy": (-5.0, 0.0), "force_factor": (0.0, 2.0)}  # powers of ten; that of the yaw rate is a setting
STARTS = {"process_vy": (-4.0, -2.0), "process_yaw_rate": (-4.0, -2.0), "force_factor": (0.3, 1.0)}
QUIET_SECONDS = 0.5  # of the pieces of drives in which the steering angle deviates least from a straight line
MOST_TOGETHER = 200_000  # samples that are filtered at a time
BAD = 1e6  # rad², instead of a cost that is not finite


@dataclass(frozen=True)
class TrackLevels:
    """Standard deviations; those that are not given are found by the fit.

    Args:
        process_vy: of the lateral velocity, over one sample's step [m/s].
        process_yaw_rate: of the yaw rate, over one sample's step [rad/s].
        force_factor: by which the forces' is larger where the car behaves linearly [1]; only with forces.
        ay: of the accelerometer [m/s²].
        yaw_rate: of the gyroscope [rad/s].
        fy_front: of the front axle's lateral force [N].
        fy_rear: of the rear axle's lateral force [N].
    """

    process_vy: float | None = None
    process_yaw_rate: float | None = None
    force_factor: float | None = None
    ay: float | None = None
    yaw_rate: float | None = None
    fy_front: float | None = None
    fy_rear: float | None = None

    def __post_init__(self) -> None:
        require_positive("estimator.noise", asdict(self))


LEVELS = tuple(entry.name for entry in fields(TrackLevels))


@dataclass(frozen=True)
class AxleTyres:
    """Dugoff's parameters of both axles, all or none; where they are not given, the fit finds them.

    Args:
        cornering_stiffness_front: of the front axle [N/rad].
        friction_front: of its tyres where they hardly slide [1].
        reduction_front: share of that which is lost per m/s of sliding [s/m].
        cornering_stiffness_rear: of the rear axle [N/rad].
        friction_rear: likewise.
        reduction_rear: likewise.
    """

    cornering_stiffness_front: float | None = None
    friction_front: float | None = None
    reduction_front: float | None = None
    cornering_stiffness_rear: float | None = None
    friction_rear: float | None = None
    reduction_rear: float | None = None

    def __post_init__(self) -> None:
        given = {name: value for name, value in asdict(self).items() if value is not None}
        if given and len(given) < len(TYRES):
            raise ConfigurationError(f"estimator.tyres: give all of {', '.join(TYRES)}, or none of them")
        require_positive("estimator.tyres", {name: value for name, value in given.items() if not name.startswith("reduction")})


TYRES = tuple(entry.name for entry in fields(AxleTyres))


@dataclass(frozen=True)
class DugoffUkfSettings(EstimatorSettings):
    """Settings of the filter.

    Args:
        inputs: ``full``: tyre forces are measured too; ``imu``: yaw rate and lateral acceleration alone, as on any car.
        curve: ``plain`` (Eq. 9) or ``smooth`` (Eq. 10) tyres.
        minimum_speed: speed below which wheels roll without slip, and nothing counts as measured [m/s].
        nonlinear_from: |ay| from which the car behaves non-linearly, so that forces are trusted [m/s²].
        linear_below: |ay| down to which it then stays so [m/s²].
        gate: standard deviations of an innovation beyond which a measurement is refused in use; none: all are taken. See `Gate`.
        correlated_samples: over how many samples the errors of what sensors measure are alike, by which the variance of each is taken
            larger, since the filter takes them for independent; about ``rate_hz / (2 f)`` of white noise behind a low-pass of f Hz.
        noise: levels of noise.
        tyres: of both axles.
        car: the car.
    """

    rate_hz: float = 100.0
    inputs: Inputs = "full"
    curve: Literal["plain", "smooth"] = "plain"
    minimum_speed: float = 3.0
    nonlinear_from: float = 4.0
    linear_below: float = 3.0
    gate: float | None = None
    correlated_samples: float = 1.0
    noise: TrackLevels = TrackLevels()
    tyres: AxleTyres = AxleTyres()
    car: LoadedCar = BMW_545I

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, options in (("inputs", tuple(CHANNELS)), ("curve", ("plain", "smooth"))):
            if getattr(self, name) not in options:
                raise ConfigurationError(f"estimator.{name} '{getattr(self, name)}' is not one of: {', '.join(options)}")
        positive = {"minimum_speed": self.minimum_speed, "gate": self.gate, "correlated_samples": self.correlated_samples}
        require_positive("estimator", positive)
        if not 0.0 <= self.linear_below <= self.nonlinear_from:
            raise ConfigurationError(
                f"estimator.linear_below must lie between 0 and nonlinear_from ({self.nonlinear_from:g}), not at {self.linear_below:g}"
            )


class DugoffUkf(Estimator):
    """Unscented filter of lateral velocity and yaw rate over `DugoffTrack`.

    Measured are lateral acceleration, yaw rate and, if wanted, the lateral forces of both axles; forward speed, steering angle and
    longitudinal acceleration are inputs. The forces' noise is smaller where the car behaves non-linearly, by a hysteresis on |ay|.

    Source: Bertipaglia et al. 2024, Sections III-B and IV-C.
    """

    name = "dugoff_ukf"
    title = "UKF with Dugoff tyres"
    settings_type = DugoffUkfSettings
    training_type = IdentificationSettings
    skippable = ("yaw_rate", "ay", *CHANNELS["full"][len(INERTIAL) :])
    channels: tuple[str, ...]  # type: ignore[misc]  # depends on the settings
    settings: DugoffUkfSettings

    def __init__(self, settings: DugoffUkfSettings) -> None:
        super().__init__(settings)
        self.channels = CHANNELS[settings.inputs]
        self.tyres = np.array([_number(getattr(settings.tyres, name)) for name in TYRES])
        self.levels = {name: _number(getattr(settings.noise, name)) for name in self.level_names}
        self._seed = 0

    @property
    def level_names(self) -> tuple[str, ...]:
        """Levels of noise that these inputs need."""
        return (*SEARCHED[self.settings.inputs], *SENSORS[self.settings.inputs])

    @property
    def variant(self) -> str:
        """What is measured, the curve, and the gate."""
        s = self.settings
        return f"dugoff_{s.inputs}" + ("_smooth" if s.curve == "smooth" else "") + suffix(s.gate)

    @property
    def full_title(self) -> str:
        """Title with what is measured, and the gate."""
        return f"{self.title}, {'with' if self.settings.inputs == 'full' else 'without'} tyre forces{in_words(self.settings.gate)}"

    @property
    def learns(self) -> bool:
        """Whether tyres or levels are not given."""
        return self.n_parameters > 0

    @property
    def n_parameters(self) -> int:
        """Tyre parameters and levels of noise that are not given."""
        return len(TYRES) * (not self._tyres_given) + len(self._unknown(self.level_names))

    @property
    def _tyres_given(self) -> bool:
        return self.settings.tyres.friction_front is not None

    def _unknown(self, names: Sequence[str]) -> list[str]:
        return [name for name in names if getattr(self.settings.noise, name) is None]

    def seed(self, seed: int) -> None:
        """Seed of the genetic searches and of Optuna's trials."""
        self._seed = seed

    def track(self, *, sees_sideslip: bool = False) -> DugoffTrack:
        """The model, with a sideslip angle among its measurements or without.

        Raises:
            ConfigurationError: the tyres are neither given nor identified.
        """
        if np.isnan(self.tyres).any():
            raise ConfigurationError(f"estimator '{self.name}' has no tyres yet; fit or load it first, or give estimator.tyres")
        s = self.settings
        front, rear = (DugoffAxle(*self.tyres[part].tolist()) for part in (slice(0, 3), slice(3, 6)))
        return DugoffTrack(s.car, front, rear, 1.0 / s.rate_hz, s.curve, s.minimum_speed, sees_sideslip)

    @classmethod
    def fit_members(cls, members: Sequence[Estimator], data: FitData, training: Any, context: FitContext) -> list[FitRecord]:
        """Identify tyres, read sensors' levels, find the process noise, each where it is not given; see `IdentificationSettings`."""
        return [member._fit_one(data, training, context) for member in members if isinstance(member, DugoffUkf)]

    def _fit_one(self, data: FitData, training: IdentificationSettings, context: FitContext) -> FitRecord:
        started = time.monotonic()
        metrics: dict[str, float] = {"epochs": 0}
        history: dict[str, list[float]] = {}
        interrupted = False
        if not self._tyres_given:
            metrics |= self._identify(data.train, training)
        self.levels |= self._sensor_levels(data.train)
        searched = self._unknown(SEARCHED[self.settings.inputs])
        if training.method == "data":
            self.levels |= {name: ASSUMED[name] for name in searched}
        elif searched:
            search = self._tune(searched, data.train, training, context)
            columns = [*(f"start_{name}" for name in searched), *searched, "train_loss"]
            history = {name: search.starts[:, column].tolist() for column, name in enumerate(columns)}
            metrics |= {"evaluations": search.evaluations, "best_train_loss": search.cost}
            self.levels |= dict(zip(searched, (10.0**search.best).tolist(), strict=True))
            interrupted = search.interrupted
        if data.validation and all("vy_ref" in recording for recording in data.validation):
            metrics["best_validation_loss"] = self._mean_squared_error(data.validation, training.skip_seconds, over=training.error)
        metrics |= {f"noise_{name}": self.levels[name] for name in self.level_names}
        metrics["train_seconds"] = time.monotonic() - started
        return FitRecord(history=history, metrics=metrics, interrupted=interrupted)

    def _identify(self, recordings: Sequence[Recording], training: IdentificationSettings) -> dict[str, float]:
        """Set the tyres; returns them with half of the range over restarts, and what forces are left over."""
        chosen = [recording for recording in recordings if fnmatch.fnmatch(recording.id, training.tyres_from)]
        if not chosen:
            raise DataError(
                f"no training recording is called '{training.tyres_from}', which tyres are to be identified on; "
                "set tyres_from in the identification's settings to another pattern ('*' for all), or give estimator.tyres"
            )
        s = self.settings
        fit = fit_dugoff(
            chosen,
            s.car,
            s.curve,
            minimum_speed=s.minimum_speed,
            measured_forces=s.inputs == "full",
            seed=self._seed,
            restarts=training.restarts,
            generations=training.generations,
        )
        self.tyres = np.array([getattr(axle, name) for axle in (fit.front, fit.rear) for name in DUGOFF_PARAMETERS])
        spread = dict(zip((f"{name}_spread" for name in TYRES), fit.spread.ravel().tolist(), strict=True))
        rms = dict(zip(("residual_front", "residual_rear"), fit.residual_rms.tolist(), strict=True))
        return {**dict(zip(TYRES, self.tyres.tolist(), strict=True)), **spread, **rms}

    def _sensor_levels(self, recordings: Sequence[Recording]) -> dict[str, float]:
        """Standard deviations of what is measured at speed where the steering angle deviates least from a straight line."""
        pieces = max(3, round(QUIET_SECONDS * self.settings.rate_hz))
        found = {}
        for name in self._unknown(SENSORS[self.settings.inputs]):
            series = [
                np.where(recording["vx"] < self.settings.minimum_speed, np.nan, recording.stack(WHEELS.get(name, (name,))).sum(1))
                for recording in recordings
            ]
            try:
                found[name] = quiet_level(series, [recording["steer"] for recording in recordings], pieces)
            except ValueError as error:
                raise DataError(f"noise of '{name}' in the training recordings: {error}; give estimator.noise.{name}") from None
            if not found[name] > 0.0:
                raise DataError(f"channel '{name}' of the training recordings has no noise that could be read off it; give estimator.noise")
        return found

    def _tune(
        self, searched: Sequence[str], recordings: Sequence[Recording], training: IdentificationSettings, context: FitContext
    ) -> SearchRecord:
        """Levels with the smallest error of sideslip, as powers of ten."""
        for recording in recordings:
            if "vy_ref" not in recording:
                raise DataError(
                    f"recording '{recording.id}' has no vy_ref to tune noise levels on; set method=data in the identification's settings"
                )

        def cost(powers: FloatArray) -> float:
            levels = self.levels | dict(zip(searched, (10.0**powers).tolist(), strict=True))
            return self._mean_squared_error(recordings, training.skip_seconds, levels, training.error)

        limits = BOXES | {"process_yaw_rate": (math.log10(LEAST_PROCESS_YAW_RATE), math.log10(training.most_process_yaw_rate))}
        boxes = [limits[name] for name in searched]
        if training.method == "optuna":
            return staged_optuna_search(cost, boxes, training.trials, self._seed, context, stages=training.stages, shrink=training.shrink)
        return nelder_mead_over_grid(cost, boxes, [STARTS[name] for name in searched], training.search, context)

    def _mean_squared_error(
        self, recordings: Sequence[Recording], skip_seconds: float, levels: Mapping[str, float] | None = None, over: Over = "samples"
    ) -> float:
        """Of sideslip [rad²], over samples fast enough for the model; see `error_over`."""
        skip = round(skip_seconds * self.settings.rate_hz)
        sums: list[tuple[float, int]] = []
        for rows, steps in self._filtered(recordings, levels=levels):
            for row, states in zip(rows, steps.filtered.mean.numpy(), strict=True):
                recording = recordings[row]
                vx, reference = recording["vx"], reference_sideslip(recording)
                error = np.arctan2(states[: len(vx), 0], vx) - reference
                counted = (vx >= self.settings.minimum_speed) & np.isfinite(reference)
                counted[:skip] = False
                sums.append((float(np.square(error[counted]).sum()), int(counted.sum())))
        value = error_over(sums, over)
        return value if math.isfinite(value) else BAD

    def _estimate_one(self, recording: Recording, initial_state: Mapping[str, float] | None) -> Estimate:
        return self._estimate_all([recording], [initial_state])[0]

    def _estimate_all(self, recordings: Sequence[Recording], states: Sequence[Mapping[str, float] | None]) -> list[Estimate]:
        """Recordings of similar length are filtered together."""
        estimates: dict[int, Estimate] = {}
        for rows, steps in self._filtered(recordings, states, gate=self.gate()):
            mean, covariance = (part.numpy() for part in steps.filtered)
            nis = torch.linalg.solve_ex(steps.innovation_covariance, steps.innovation).result.mul(steps.innovation).sum(-1).numpy()
            dof = torch.as_tensor(steps.measured).sum(-1).double().numpy()
            for place, row in enumerate(rows):
                n = len(recordings[row])
                others = {"yaw_rate": mean[place, :n, 1].copy(), "nis": nis[place, :n].copy(), "nis_dof": dof[place, :n].copy()}
                vy, own = mean[place, :n, 0].copy(), covariance[place, :n].copy()
                estimates[row] = self._wrapped(recordings[row], vy, own, TRACK_STATES, **others)
        return [estimates[row] for row in range(len(recordings))]

    def _filtered(
        self,
        recordings: Sequence[Recording],
        states: Sequence[Mapping[str, float] | None] | None = None,
        levels: Mapping[str, float] | None = None,
        gate: Gate | None = None,
    ) -> Iterator[tuple[list[int], Filtered[Tensor]]]:
        """Rows of recordings that were filtered together, padded to the longest, and what came of them.

        Levels are found without a gate, which noise that is too small would close.
        """
        model = TrackFilter(self.track())
        process, sensors = self.noise_covariances(self.levels if levels is None else levels)
        for rows in groups_of([len(recording) for recording in recordings], MOST_TOGETHER):
            parts = [samples_of(recordings[row].stack(self.channels)) for row in rows]
            measurements = torch.as_tensor(padded([part[0] for part in parts], np.nan))
            inputs = torch.as_tensor(padded([part[1] for part in parts], None))
            trusted = torch.as_tensor(np.stack([self.trusts_forces(ay) for ay in measurements[..., 0].numpy()]))
            given = None if states is None else [states[row] for row in rows]
            with torch.no_grad():
                initial = model.start(inputs[:, 0], given)
                outcome = model.filtered(measurements, inputs, process, sensors[trusted.long()], initial, gate)
            yield rows, outcome.steps

    def gate(self) -> Gate | None:
        """That of the filter in use."""
        return Gate.of(self.settings.gate, self.settings.rate_hz)

    def trusts_forces(self, ay: FloatArray, before: bool = False) -> NDArray[np.bool_]:
        """Where forces are trusted, (T,), given the measured lateral acceleration (T,) [m/s²]; see `in_nonlinear_range`."""
        return in_nonlinear_range(ay, self.settings.nonlinear_from, self.settings.linear_below, before)

    def noise_covariances(self, levels: Mapping[str, float]) -> tuple[Tensor, Tensor]:
        """Covariance of a step, (2, 2), and those of measurements where the car is linear and where it is not, (2, 4, 4).

        Raises:
            ConfigurationError: a level is neither given nor found.
        """
        if any(math.isnan(level) for level in levels.values()):
            raise ConfigurationError(f"estimator '{self.name}' has no noise levels yet; fit or load it first, or give estimator.noise")
        process = torch.tensor([levels["process_vy"], levels["process_yaw_rate"]], dtype=torch.float64).square().diag()
        factor = levels.get("force_factor", 1.0)
        rows = [[levels["ay"], levels["yaw_rate"], *(own * levels.get(name, 1.0) for name in WHEELS)] for own in (factor, 1.0)]
        alike = self.settings.correlated_samples
        return process, torch.diag_embed(torch.tensor(rows, dtype=torch.float64).square() * alike)

    def online(self) -> DugoffUkfStepper:
        """A stepper that starts from the first sample it sees."""
        return DugoffUkfStepper(self)

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """Tyre parameters in the order of `AxleTyres`, and levels of noise in that of `level_names`."""
        return {"tyres": self.tyres.copy(), "levels": np.array([self.levels[name] for name in self.level_names])}

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Take tyres and levels back."""
        shapes = {name: values.shape for name, values in self.weights().items()}
        if {name: values.shape for name, values in weights.items()} != shapes:
            raise DataError(f"weights of '{self.name}' must be {', '.join(shapes)} of these inputs, not {', '.join(weights)}")
        self.tyres = np.array(weights["tyres"], dtype=np.float64)
        self.levels = dict(zip(self.level_names, weights["levels"].tolist(), strict=True))


class DugoffUkfStepper(Stepper):
    """The filter, one sample at a time."""

    def __init__(self, estimator: DugoffUkf) -> None:
        self._estimator = estimator
        self._filter = TrackStepper(TrackFilter(estimator.track()), estimator.gate())
        self._process, self._sensors = (noise.numpy() for noise in estimator.noise_covariances(estimator.levels))
        self._trusts = False

    def step(self, sample: Mapping[str, float]) -> dict[str, float]:
        """Lateral velocity [m/s] and yaw rate [rad/s] at the time of the sample; measurements that are NaN are skipped."""
        estimator = self._estimator
        row = checked_sample(sample, estimator.channels, estimator.skippable)
        measurements, inputs = samples_of(row[None])
        self._trusts = bool(estimator.trusts_forces(measurements[:, 0], self._trusts)[0])
        state = self._filter.step(measurements[0], inputs[0], self._process, self._sensors[int(self._trusts)])
        return dict(zip(TRACK_STATES, state.tolist(), strict=True)) | {"vy_variance": self._filter.variance}


def samples_of(samples: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Samples of ``channels`` as the filter takes them.

    Args:
        samples: (T, 9), or (T, 5) without forces.

    Returns:
        Measurements (T, 4), NaN where there are no forces, and inputs (T, 3).
    """
    yaw_rate, vx, ay, steer, ax = samples.T[: len(INERTIAL)]
    wheels = samples[:, len(INERTIAL) :]
    forces = [wheels[:, 0] + wheels[:, 1], wheels[:, 2] + wheels[:, 3]] if wheels.shape[1] else [np.full(len(samples), np.nan)] * 2
    return np.stack([ay, yaw_rate, *forces], 1), np.stack([vx, steer, ax], 1)


def _number(value: float | None) -> float:
    return math.nan if value is None else value


ESTIMATOR = DugoffUkf
