"""Unscented Kalman filter on a single track with Dugoff tyres: the model-based part of Bertipaglia et al. 2024."""

from __future__ import annotations

import fnmatch
import math
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vehest.constants import GRAVITY, FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.declared import Group, setting
from vehest.estimators.base import (
    FitData,
    FitRecord,
    Trial,
    require_shapes,
    require_within_bounds,
)
from vehest.estimators.filtering.dugoff_fit import fit_dugoff
from vehest.estimators.filtering.sigma_point_stepper import FilterStep, SigmaPointEstimator
from vehest.estimators.filtering.track_filter import (
    KAPPA,
    ROLLING,
    UNKNOWN,
    Over,
    TrackFilter,
    error_over,
    groups_of,
    in_nonlinear_range,
    padded,
)
from vehest.estimators.networks.sample_network import reference_sideslip
from vehest.filters.gating import Gate
from vehest.filters.gaussian import Filtered
from vehest.filters.noise_levels import quiet_level
from vehest.filters.sigma_points import symmetric_rule
from vehest.filters.unscented_scan import MARGIN, UnscentedStepper
from vehest.training.context import FitContext
from vehest.training.noise_tuning import LEAST_PROCESS_YAW_RATE, IdentificationSettings
from vehest.training.search import SearchRecord
from vehest.vehicle.dugoff import (
    BMW_545I,
    LARGEST_RATIO,
    LEAST_COSINE,
    LEAST_LOAD,
    LEAST_SHARE,
    TRACK_STATES,
    DugoffAxle,
    DugoffTrack,
    LoadedCar,
)

Inputs = Literal["full", "imu"]
WHEELS = {"fy_front": ("fy_fl", "fy_fr"), "fy_rear": ("fy_rl", "fy_rr")}
INERTIAL = ("yaw_rate", "vx", "ay", "steer", "ax")
CHANNELS: dict[str, tuple[str, ...]] = {
    "full": (*INERTIAL, *(wheel for pair in WHEELS.values() for wheel in pair)),
    "imu": INERTIAL,
}
SENSORS: dict[str, tuple[str, ...]] = {
    "full": ("ay", "yaw_rate", "fy_front", "fy_rear"),
    "imu": ("ay", "yaw_rate"),
}
SEARCHED: dict[str, tuple[str, ...]] = {
    "full": ("process_vy", "process_yaw_rate", "force_factor"),
    "imu": ("process_vy", "process_yaw_rate"),
}
ASSUMED = {
    "process_vy": 7e-4,
    "process_yaw_rate": 2e-3,
    "force_factor": 1.0,
}  # the first two: Bertipaglia et al. 2024
BOXES = {
    "process_vy": (-5.0, 0.0),
    "force_factor": (0.0, 2.0),
}  # powers of ten; that of the yaw rate is a setting
STARTS = {"process_vy": (-4.0, -2.0), "process_yaw_rate": (-4.0, -2.0), "force_factor": (0.3, 1.0)}
QUIET_SECONDS = (
    0.5  # of the pieces of drives in which the steering angle deviates least from a straight line
)
MOST_TOGETHER = 200_000  # samples that are filtered at a time


@dataclass(frozen=True)
class TrackLevels(Group):
    """Standard deviations; those that are not given are found by the fit."""

    group = "estimator.noise"
    process_vy: float | None = setting(
        None, "of the lateral velocity, over one sample's step", unit="m/s", positive=True
    )
    process_yaw_rate: float | None = setting(
        None, "of the yaw rate, over one sample's step", unit="rad/s", positive=True
    )
    force_factor: float | None = setting(
        None, "by which the forces' is larger where the car behaves linearly", positive=True
    )
    ay: float | None = setting(None, "of the accelerometer", unit="m/s²", positive=True)
    yaw_rate: float | None = setting(None, "of the gyroscope", unit="rad/s", positive=True)
    fy_front: float | None = setting(
        None, "of the front axle's lateral force", unit="N", positive=True
    )
    fy_rear: float | None = setting(
        None, "of the rear axle's lateral force", unit="N", positive=True
    )


LEVELS = tuple(entry.name for entry in fields(TrackLevels))


@dataclass(frozen=True)
class AxleTyres(Group):
    """Dugoff's parameters of both axles, all or none; where they are not given, the fit finds them."""

    group = "estimator.tyres"
    cornering_stiffness_front: float | None = setting(
        None, "of the front axle", unit="N/rad", positive=True
    )
    friction_front: float | None = setting(
        None, "of its tyres where they hardly slide", positive=True
    )
    reduction_front: float | None = setting(
        None, "share of that which is lost per m/s of sliding", unit="s/m", least=0.0
    )
    cornering_stiffness_rear: float | None = setting(
        None, "of the rear axle", unit="N/rad", positive=True
    )
    friction_rear: float | None = setting(None, "likewise", positive=True)
    reduction_rear: float | None = setting(None, "likewise", unit="s/m", least=0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        given = [value for value in asdict(self).values() if value is not None]
        if given and len(given) < len(TYRES):
            raise ConfigurationError(
                f"estimator.tyres: give all of {', '.join(TYRES)}, or none of them"
            )


TYRES = tuple(entry.name for entry in fields(AxleTyres))


class PseudoMeasurement(NamedTuple):
    """What a network adds to T samples."""

    sideslip: FloatArray  # β_DD, (T,) [rad]
    variance: FloatArray  # of the measurement that the filter takes it for, (T,) [rad²]
    # variances of a step of lateral velocity and yaw rate, (T, 2) [m²/s², rad²/s²]; none: the filter's own
    process: FloatArray | None = None


class DugoffUkf(SigmaPointEstimator):
    """Unscented filter of lateral velocity and yaw rate over `DugoffTrack`.

    Measured are lateral acceleration, yaw rate and, if wanted, the lateral forces of both axles; forward speed, steering angle and
    longitudinal acceleration are inputs. The forces' noise is smaller where the car behaves non-linearly, by a hysteresis on |ay|.

    Source: Bertipaglia et al. 2024, Sections III-B and IV-C.
    """

    name = "dugoff_ukf"
    title = "UKF with Dugoff tyres"
    trials = (
        Trial(
            9,
            "unscented filter with Dugoff tyres; minutes",
            "estimator.inputs=imu {car} training.method=nelder_mead training.grid=1 training.max_evaluations=40 "
            "training.tyres_from='*' training.restarts=1 training.generations=60",
        ),
    )
    training_type: ClassVar[type] = IdentificationSettings
    template = "track_ukf"
    refuses = ("NaN", "infinite")
    skippable: ClassVar[tuple[str, ...]] = ("yaw_rate", "ay", *CHANNELS["full"][len(INERTIAL) :])
    states = TRACK_STATES
    covariance_of = TRACK_STATES
    channels: tuple[str, ...]  # type: ignore[misc]  # depends on the settings
    inputs: Inputs = setting(
        "full",
        "full: tyre forces are measured too; imu: yaw rate and lateral acceleration alone, as on any car",
    )
    curve: Literal["plain", "smooth"] = setting(
        "plain", "tyres of Eq. 9 (plain) or 10 (smooth), as in training through the filter"
    )
    minimum_speed: float = setting(
        3.0,
        "speed below which wheels roll without slip, and nothing counts as measured",
        unit="m/s",
        positive=True,
    )
    nonlinear_from: float = setting(
        4.0, "|ay| from which the car behaves non-linearly, so that forces are trusted", unit="m/s²"
    )
    linear_below: float = setting(
        3.0, "|ay| down to which it then stays so", unit="m/s²", least=0.0
    )
    correlated_samples: float = setting(
        1.0,
        "samples over which errors of sensors are alike, by which their variance is larger; about rate_hz / (2 f) of white noise behind a "
        "low-pass of f Hz",
        positive=True,
    )
    noise: TrackLevels = setting(TrackLevels(), "standard deviations; null: found by the training")
    tyres: AxleTyres = setting(
        AxleTyres(),
        "of both axles, all or none; null: identified on training recordings with a reference",
    )
    car: LoadedCar = setting(
        BMW_545I, "BMW 545i of Bertipaglia et al. 2024; replace by your car's parameters"
    )

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self.channels = CHANNELS[self.inputs]
        self.axle_tyres = np.array([getattr(settings.tyres, name) for name in TYRES], np.float64)
        given = np.array([getattr(settings.noise, name) for name in self.level_names], np.float64)
        self.levels = dict(zip(self.level_names, given.tolist(), strict=True))

    def check(self) -> None:
        """Raises `ConfigurationError`: thresholds of the non-linear range in the wrong order."""
        if not self.linear_below <= self.nonlinear_from:
            raise ConfigurationError(
                f"estimator.linear_below must lie between 0 and nonlinear_from ({self.nonlinear_from:g}), not at {self.linear_below:g}"
            )

    @property
    def level_names(self) -> tuple[str, ...]:
        """Levels of noise that these inputs need."""
        return (*SEARCHED[self.inputs], *SENSORS[self.inputs])

    @property
    def variant(self) -> str:
        """What is measured, the curve, and the gate."""
        s = self.settings
        return f"dugoff_{s.inputs}" + ("_smooth" if s.curve == "smooth" else "") + self.gate_suffix

    @property
    def full_title(self) -> str:
        """Title with what is measured, and the gate."""
        return f"{self.title}, {'with' if self.inputs == 'full' else 'without'} tyre forces{self.gate_title}"

    @property
    def n_parameters(self) -> int:
        """Tyre parameters and levels of noise that are not given."""
        return self.n_identified

    @property
    def n_identified(self) -> int:
        """Numbers that the identification of tyres and noise finds."""
        return len(TYRES) * (not self._tyres_given) + len(self._unknown(self.level_names))

    @property
    def _tyres_given(self) -> bool:
        return self.tyres.friction_front is not None

    def _unknown(self, names: Sequence[str]) -> list[str]:
        return [name for name in names if getattr(self.noise, name) is None]

    def require_fitted(self) -> None:
        """Raises `ConfigurationError`: tyres or levels are neither given nor found."""
        self.track()
        self.noise_covariances(self.levels)

    def track(self) -> DugoffTrack:
        """The model; raises `ConfigurationError`: the tyres are neither given nor identified."""
        if np.isnan(self.axle_tyres).any():
            raise ConfigurationError(
                f"estimator '{self.name}' has no tyres yet; fit or load it first, or give estimator.tyres"
            )
        s = self.settings
        front, rear = (
            DugoffAxle(*self.axle_tyres[part].tolist()) for part in (slice(0, 3), slice(3, 6))
        )
        return DugoffTrack(s.car, front, rear, 1.0 / s.rate_hz, s.curve, s.minimum_speed)

    @classmethod
    def fit_members(
        cls, members: Sequence[Any], data: FitData, training: Any, context: FitContext
    ) -> list[FitRecord]:
        """Identify tyres, read sensors' levels, find the process noise, each where it is not given; see `IdentificationSettings`."""
        return [member.identify(data, training, context) for member in members]

    def identify(
        self, data: FitData, training: IdentificationSettings, context: FitContext
    ) -> FitRecord:
        """Fit tyres and levels."""
        started = time.monotonic()
        metrics: dict[str, float] = {"epochs": 0}
        history: dict[str, list[float]] = {}
        interrupted = False
        if not self._tyres_given:
            metrics |= self._identify(data.train, training)
        self.levels |= self._sensor_levels(data.train)
        searched = self._unknown(SEARCHED[self.inputs])
        if training.method == "data":
            self.levels |= {name: ASSUMED[name] for name in searched}
        elif searched:
            search = self._tune(searched, data.train, training, context)
            history = search.history(searched)
            metrics |= {"evaluations": search.evaluations, "best_train_loss": search.cost}
            self.levels |= dict(zip(searched, (10.0**search.best).tolist(), strict=True))
            interrupted = search.interrupted
        if data.validation and all("vy_ref" in recording for recording in data.validation):
            metrics["best_validation_loss"] = self.mean_squared_error(
                data.validation, training.skip_seconds, over=training.error
            )
        metrics |= {f"noise_{name}": self.levels[name] for name in self.level_names}
        metrics["train_seconds"] = time.monotonic() - started
        return FitRecord(history=history, metrics=metrics, interrupted=interrupted)

    def _identify(
        self, recordings: Sequence[Recording], training: IdentificationSettings
    ) -> dict[str, float]:
        """Set the tyres; returns them with half of the range over restarts, and what forces are left over."""
        chosen = [
            recording
            for recording in recordings
            if fnmatch.fnmatch(recording.id, training.tyres_from)
        ]
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
        self.axle_tyres = fit.parameters.ravel()
        spread = dict(
            zip((f"{name}_spread" for name in TYRES), fit.spread.ravel().tolist(), strict=True)
        )
        rms = dict(zip(("residual_front", "residual_rear"), fit.residual_rms.tolist(), strict=True))
        return {**dict(zip(TYRES, self.axle_tyres.tolist(), strict=True)), **spread, **rms}

    def _sensor_levels(self, recordings: Sequence[Recording]) -> dict[str, float]:
        """Standard deviations of what is measured at speed where the steering angle deviates least from a straight line."""
        pieces = max(3, round(QUIET_SECONDS * self.rate_hz))
        found = {}
        for name in self._unknown(SENSORS[self.inputs]):
            series = [
                np.where(
                    recording["vx"] < self.minimum_speed,
                    np.nan,
                    recording.stack(WHEELS.get(name, (name,))).sum(1),
                )
                for recording in recordings
            ]
            try:
                found[name] = quiet_level(
                    series, [recording["steer"] for recording in recordings], pieces
                )
            except ValueError as error:
                raise DataError(
                    f"noise of '{name}' in the training recordings: {error}; give estimator.noise.{name}"
                ) from None
            if not found[name] > 0.0:
                raise DataError(
                    f"channel '{name}' of the training recordings has no noise that could be read off it; give estimator.noise"
                )
        return found

    def _tune(
        self,
        searched: Sequence[str],
        recordings: Sequence[Recording],
        training: IdentificationSettings,
        context: FitContext,
    ) -> SearchRecord:
        """Levels with the smallest error of sideslip, as powers of ten."""
        for recording in recordings:
            if "vy_ref" not in recording:
                raise DataError(
                    f"recording '{recording.id}' has no vy_ref to tune noise levels on; set method=data in the identification's settings"
                )

        def cost(powers: FloatArray) -> float:
            levels = self.levels | dict(zip(searched, (10.0**powers).tolist(), strict=True))
            return self.mean_squared_error(
                recordings, training.skip_seconds, levels, training.error
            )

        limits = BOXES | {
            "process_yaw_rate": (
                math.log10(LEAST_PROCESS_YAW_RATE),
                math.log10(training.most_process_yaw_rate),
            )
        }
        boxes = [limits[name] for name in searched]
        return training.search(
            cost, boxes, [STARTS[name] for name in searched], self._seed, context
        )

    def mean_squared_error(
        self,
        recordings: Sequence[Recording],
        skip_seconds: float = 0.0,
        levels: Mapping[str, float] | None = None,
        over: Over = "samples",
        pseudo: Sequence[PseudoMeasurement] | None = None,
    ) -> float:
        """Of sideslip [rad²], over samples fast enough for the model; see `error_over`."""
        skip = round(skip_seconds * self.rate_hz)
        sums: list[tuple[float, int]] = []
        for rows, steps in self.filtered(recordings, levels=levels, pseudo=pseudo):
            for row, states in zip(rows, steps.filtered.mean.numpy(), strict=True):
                vx = recordings[row]["vx"]
                reference = reference_sideslip(recordings[row])
                error = np.arctan2(states[: len(vx), 0], vx) - reference
                counted = (vx >= self.minimum_speed) & np.isfinite(reference)
                counted[:skip] = False
                sums.append((float(np.square(error[counted]).sum()), int(counted.sum())))
        return error_over(sums, over)

    def _estimate_all(
        self, recordings: Sequence[Recording], states: Sequence[Mapping[str, float] | None]
    ) -> list[Estimate]:
        """Recordings of similar length are filtered together."""
        estimates: dict[int, Estimate] = {}
        for rows, steps in self.filtered(
            recordings, states, gate=self.gate_in_use(), pseudo=self.pseudo_measurements(recordings)
        ):
            mean, covariance = (part.numpy() for part in steps.filtered)
            nis = (
                torch.linalg.solve_ex(steps.innovation_covariance, steps.innovation)
                .result.mul(steps.innovation)
                .sum(-1)
                .numpy()
            )
            dof = torch.as_tensor(steps.measured).sum(-1).double().numpy()
            for place, row in enumerate(rows):
                n = len(recordings[row])
                others = {
                    "yaw_rate": mean[place, :n, 1].copy(),
                    "nis": nis[place, :n].copy(),
                    "nis_dof": dof[place, :n].copy(),
                }
                vy = mean[place, :n, 0].copy()
                own = covariance[place, :n].copy()
                estimates[row] = self._wrapped(recordings[row], vy, own, TRACK_STATES, **others)
        return [estimates[row] for row in range(len(recordings))]

    def pseudo_measurements(
        self, recordings: Sequence[Recording]
    ) -> list[PseudoMeasurement] | None:
        """Of a network behind each recording; none: there is no network."""
        return None

    def filtered(
        self,
        recordings: Sequence[Recording],
        states: Sequence[Mapping[str, float] | None] | None = None,
        levels: Mapping[str, float] | None = None,
        gate: Gate | None = None,
        pseudo: Sequence[PseudoMeasurement] | None = None,
    ) -> Iterator[tuple[list[int], Filtered[Tensor]]]:
        """Rows of recordings that were filtered together, padded to the longest, and what came of them.

        Levels are found, and networks learn, without a gate: noise that is too small would close it.
        """
        model = TrackFilter(self.track())
        process, sensors = self.noise_covariances(self.levels if levels is None else levels)
        for rows in groups_of([len(recording) for recording in recordings], MOST_TOGETHER):
            parts = [self.taken(recordings[row].stack(self.channels)) for row in rows]
            seen = [part[0] for part in parts]
            steps_noise = process
            if pseudo is not None:
                own = [pseudo[row] for row in rows]
                seen = [
                    np.column_stack([one, added.sideslip])
                    for one, added in zip(seen, own, strict=True)
                ]
                if own[0].process is not None:
                    steps_noise = torch.diag_embed(
                        torch.as_tensor(padded([added.process for added in own], None))  # type: ignore[misc]
                    )
            measurements = torch.as_tensor(padded(seen, np.nan))
            inputs = torch.as_tensor(padded([part[1] for part in parts], None))
            noise = sensors[
                torch.as_tensor(
                    np.stack([self.trusts_forces(ay) for ay in measurements[..., 0].numpy()])
                ).long()
            ]
            if pseudo is not None:
                noise = with_variance(
                    noise,
                    torch.as_tensor(
                        padded([added.variance[:, None] for added in own], None)[..., 0]
                    ),
                )
            given = None if states is None else [states[row] for row in rows]
            with torch.no_grad():
                initial = model.start(inputs[:, 0], given)
                yield (
                    rows,
                    model.filtered(measurements, inputs, steps_noise, noise, initial, gate).steps,
                )

    def taken(self, samples: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Samples (T, n) of ``channels`` as the filter takes them: measurements (T, 4), NaN where there are no forces; inputs (T, 3)."""
        yaw_rate, vx, ay, steer, ax = samples.T[: len(INERTIAL)]
        wheels = samples[:, len(INERTIAL) : len(CHANNELS[self.inputs])]
        forces = (
            [wheels[:, 0] + wheels[:, 1], wheels[:, 2] + wheels[:, 3]]
            if wheels.shape[1]
            else [np.full(len(samples), np.nan)] * 2
        )
        return np.stack([ay, yaw_rate, *forces], 1), np.stack([vx, steer, ax], 1)

    def trusts_forces(self, ay: FloatArray, before: bool = False) -> NDArray[np.bool_]:
        """Where forces are trusted, (T,), given the measured lateral acceleration (T,) [m/s²]; see `in_nonlinear_range`."""
        return in_nonlinear_range(ay, self.nonlinear_from, self.linear_below, before)

    def noise_covariances(self, levels: Mapping[str, float]) -> tuple[Tensor, Tensor]:
        """Covariance of a step, (2, 2), and those of measurements where the car is linear and where it is not, (2, 4, 4).

        Raises `ConfigurationError`: a level is neither given nor found.
        """
        if any(math.isnan(level) for level in levels.values()):
            raise ConfigurationError(
                f"estimator '{self.name}' has no noise levels yet; fit or load it first, or give estimator.noise"
            )
        process = (
            torch.tensor([levels["process_vy"], levels["process_yaw_rate"]], dtype=torch.float64)
            .square()
            .diag()
        )
        factor = levels.get("force_factor", 1.0)
        rows = [
            [levels["ay"], levels["yaw_rate"], *(own * levels.get(name, 1.0) for name in WHEELS)]
            for own in (factor, 1.0)
        ]
        alike = self.correlated_samples
        return process, torch.diag_embed(torch.tensor(rows, dtype=torch.float64).square() * alike)

    def new_filter(self, first: FilterStep) -> UnscentedStepper:
        """Straight ahead and unknown, or rolling."""
        own = TrackFilter(self.track())
        mean, covariance = (
            part[0].numpy() for part in own.start(torch.as_tensor(first.inputs)[None])
        )
        return UnscentedStepper(
            own.model, mean, covariance, len(first.measurement), own.rule, gate=self.gate_in_use()
        )

    def filter_step(self, sample: FloatArray, memory: dict[str, Any]) -> FilterStep:
        """Measurements as far as the car is fast enough, and the noise of the range that it is in."""
        if not memory:
            process, sensors = (noise.numpy() for noise in self.noise_covariances(self.levels))
            memory |= {"process": process, "noise": process, "sensors": sensors, "trusts": False}
        measurements, inputs = (part[0] for part in self.taken(sample[None]))
        memory["trusts"] = bool(self.trusts_forces(measurements[:1], memory["trusts"])[0])
        noise = memory["sensors"][int(memory["trusts"])]
        process = memory["noise"]
        memory["noise"] = memory["process"]
        measurements, noise = self.with_pseudo(sample, measurements, noise, memory)
        if inputs[0] < self.minimum_speed:
            measurements = np.full_like(measurements, np.nan)
            memory["noise"] = ROLLING
        return FilterStep(measurements, inputs, process[None], noise[None])

    def with_pseudo(
        self, sample: FloatArray, measurement: FloatArray, noise: FloatArray, memory: dict[str, Any]
    ) -> tuple[FloatArray, FloatArray]:
        """A measurement (m,) and its covariance with those that a network adds, whose process noise is left in ``memory``."""
        return measurement, noise

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """Tyre parameters in the order of `AxleTyres`, and levels of noise in that of `level_names`."""
        return {
            "tyres": self.axle_tyres.copy(),
            "levels": np.array([self.levels[name] for name in self.level_names]),
        }

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Take tyres and levels back; raises `DataError`: they do not fit, or are out of their settings' bounds."""
        require_shapes(
            self, weights, {name: values.shape for name, values in DugoffUkf.weights(self).items()}
        )
        tyres = np.array(weights["tyres"], dtype=np.float64)
        levels = dict(zip(self.level_names, weights["levels"].tolist(), strict=True))
        require_within_bounds(
            dict(zip(TYRES, tyres.tolist(), strict=True)), AxleTyres.declarations(), "tyres"
        )
        require_within_bounds(levels, TrackLevels.declarations(), "levels")
        self.axle_tyres = tyres
        self.levels = levels

    def references(self, training: Any, channels: Collection[str]) -> tuple[str, ...]:
        """``vy_ref`` where a level is searched, or tyres are identified without a sideslip angle."""
        if training.method != "data" and self._unknown(SEARCHED[self.inputs]):
            return ("vy_ref",)
        return () if self._tyres_given or "sideslip_ref" in channels else ("vy_ref",)

    def unmatched_patterns(self, training: Any, recordings: Collection[str]) -> tuple[str, ...]:
        """Where no recording matches the pattern that names those to identify tyres on."""
        if self._tyres_given or any(
            fnmatch.fnmatchcase(name, training.tyres_from) for name in recordings
        ):
            return ()
        return ("training.tyres_from='*'",)

    def c_values(self) -> dict[str, Any]:
        """The filter alone."""
        s = self.settings
        car = s.car
        forces = s.inputs == "full"
        wheelbase = car.cg_to_front_axle + car.cg_to_rear_axle
        process, sensors = self.noise_covariances(self.levels)
        measured = 4 if forces else 2  # forces that are never measured need no row
        return {
            "network": False,
            **super().c_values(),
            "n": len(TRACK_STATES),
            "m": measured,
            "rule": symmetric_rule(len(TRACK_STATES), KAPPA),
            "lower": None,
            "repair": True,
            "margin": MARGIN,
            "forces": forces,
            "smooth": s.curve == "smooth",
            "car": car,
            "step": 1.0 / s.rate_hz,
            "transfer": car.cg_height / wheelbase,
            "load_front": GRAVITY * car.cg_to_rear_axle / wheelbase,
            "load_rear": GRAVITY * car.cg_to_front_axle / wheelbase,
            "minimum_speed": s.minimum_speed,
            "rolling": np.square(UNKNOWN),
            "process": process.diagonal().numpy(),
            "sensors": sensors.diagonal(dim1=-2, dim2=-1).numpy()[:, :measured],
            "front": self.axle_tyres[:3],
            "rear": self.axle_tyres[3:],
            "nonlinear_from": s.nonlinear_from,
            "linear_below": s.linear_below,
            "largest": LARGEST_RATIO[s.curve],
            "least_share": LEAST_SHARE,
            "least_load": LEAST_LOAD,
            "least_cosine": LEAST_COSINE,
        }


def with_variance(sensors: Tensor, variance: Tensor) -> Tensor:
    """Covariances of what sensors measure and a network adds, (..., 5, 5), differentiable in the variance.

    Args:
        sensors: of the four measured numbers, diagonal, (..., 4, 4).
        variance: of the network's angle (...) [rad²].
    """
    return torch.diag_embed(
        torch.cat([sensors.diagonal(dim1=-2, dim2=-1), variance.unsqueeze(-1)], -1)
    )


ESTIMATOR = DugoffUkf
