"""Unscented Kalman filter on a single track with Dugoff tyres.

Source: the model-based part of Bertipaglia et al. 2024.

    training recordings --identify--> tyres of both axles, noise levels
    ay, yaw_rate, tyre forces --`DugoffFilter`--> vy, yaw rate

This module declares the estimator: settings, fitted numbers, names, files. It filters by
`filtering.dugoff_filter` and is identified by `filtering.dugoff_identification`.
"""

from __future__ import annotations

import fnmatch
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar

import numpy as np

from vehest.data.errors import ConfigurationError
from vehest.declared import Group, setting
from vehest.estimators.base import (
    FitData,
    FitRecord,
    Trial,
    require_shapes,
    require_within_bounds,
)
from vehest.estimators.filtering.dugoff_filter import (
    CHANNELS,
    INERTIAL,
    Curve,
    DugoffFilter,
    Inputs,
)
from vehest.estimators.filtering.dugoff_identification import (
    identify_tyres,
    read_sensor_levels,
    search_levels,
)
from vehest.estimators.filtering.track_c import track_c_values
from vehest.training.context import FitContext
from vehest.training.noise_tuning import IdentificationSettings
from vehest.vehicle.dugoff import BMW_545I, LoadedCar

SENSORS: dict[str, tuple[str, ...]] = {
    "full": ("ay", "yaw_rate", "fy_front", "fy_rear"),
    "imu": ("ay", "yaw_rate"),
}
"""Setting ``inputs`` -> sensors whose noise levels the filter needs."""
SEARCHED: dict[str, tuple[str, ...]] = {
    "full": ("process_vy", "process_yaw_rate", "force_factor"),
    "imu": ("process_vy", "process_yaw_rate"),
}
"""Setting ``inputs`` -> noise levels that the fit searches."""
# Levels where nothing is searched: process_vy [m/s] and process_yaw_rate [rad/s] of Bertipaglia et
# al. 2024.
ASSUMED_LEVELS = {"process_vy": 7e-4, "process_yaw_rate": 2e-3, "force_factor": 1.0}


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

    def unknown(self, names: Sequence[str]) -> list[str]:
        """Those of these levels that the settings leave to the fit."""
        return [name for name in names if getattr(self, name) is None]


LEVELS = tuple(entry.name for entry in fields(TrackLevels))  # names of all noise levels


@dataclass(frozen=True)
class AxleTyres(Group):
    """Dugoff's parameters of both axles, all or none.

    Where they are not given, the fit finds them.
    """

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
        """Raise `ConfigurationError` where some of the parameters are given, but not all."""
        super().__post_init__()
        values = [value for value in asdict(self).values() if value is not None]
        if values and len(values) < len(TYRES):
            raise ConfigurationError(
                f"estimator.tyres: give all of {', '.join(TYRES)}, or none of them"
            )

    @property
    def has_values(self) -> bool:
        """Whether the tyres of both axles are given, so that the fit identifies neither."""
        return self.friction_front is not None


TYRES = tuple(entry.name for entry in fields(AxleTyres))  # names of all tyre parameters


class DugoffUkf(DugoffFilter):
    """Unscented filter of lateral velocity and yaw rate over `DugoffTrack`.

    Measured are lateral acceleration, yaw rate and, depending on the settings, the lateral forces
    of both axles; forward speed, steering angle and longitudinal acceleration are inputs. The
    forces' noise is smaller where the car behaves non-linearly, by a hysteresis on |ay|.

    Source: Bertipaglia et al. 2024, Sections III-B and IV-C.
    """

    name = "dugoff_ukf"
    title = "UKF with Dugoff tyres"
    trials = (
        Trial(
            9,
            "unscented filter with Dugoff tyres; minutes",
            "estimator.inputs=imu {car} training.method=nelder_mead training.grid=1 "
            "training.max_evaluations=40 "
            "training.tyres_from='*' training.restarts=1 training.generations=60",
        ),
    )
    training_type: ClassVar[type] = IdentificationSettings
    template = "track_ukf"
    refuses = ("NaN", "infinite")
    skippable: ClassVar[tuple[str, ...]] = ("yaw_rate", "ay", *CHANNELS["full"][len(INERTIAL) :])
    inputs: Inputs = setting(
        "full",
        "full: tyre forces are measured too; imu: yaw rate and lateral acceleration alone, as on "
        "any car",
    )
    curve: Curve = setting(
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
        "samples over which errors of sensors are alike, by which their variance is larger; "
        "about rate_hz / (2 f) of white noise behind a low-pass of f Hz",
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
        levels = np.array([getattr(settings.noise, name) for name in self.level_names], np.float64)
        self.levels = dict(zip(self.level_names, levels.tolist(), strict=True))

    def check(self) -> None:
        """Check the thresholds of the non-linear range.

        Raises
        ------
        ConfigurationError
            Thresholds of the non-linear range in the wrong order.
        """
        if not self.linear_below <= self.nonlinear_from:
            raise ConfigurationError(
                "estimator.linear_below must lie between 0 and nonlinear_from "
                f"({self.nonlinear_from:g}), not at {self.linear_below:g}"
            )

    @property
    def level_names(self) -> tuple[str, ...]:
        """Levels of noise that these inputs need."""
        return (*SEARCHED[self.inputs], *SENSORS[self.inputs])

    @property
    def variant(self) -> str:
        """Identifier with the inputs, the tyre curve and the gate."""
        s = self.settings
        return f"dugoff_{s.inputs}" + ("_smooth" if s.curve == "smooth" else "") + self.gate_suffix

    @property
    def full_title(self) -> str:
        """Title with the use of tyre forces, and the gate."""
        return (
            f"{self.title}, {'with' if self.inputs == 'full' else 'without'} tyre "
            f"forces{self.gate_title}"
        )

    @property
    def n_parameters(self) -> int:
        """Number of tyre parameters and noise levels that are fitted."""
        return self.n_identified

    @property
    def n_identified(self) -> int:
        """Number of values that the identification of tyres and noise finds."""
        n_tyres = 0 if self.tyres.has_values else len(TYRES)
        return n_tyres + len(self.noise.unknown(self.level_names))

    @classmethod
    def fit_members(
        cls, members: Sequence[Any], data: FitData, training: Any, context: FitContext
    ) -> list[FitRecord]:
        """Identify tyres, levels of sensors and process noise, each where it is not given.

        See `IdentificationSettings`.
        """
        return [member.identify(data, training, context) for member in members]

    def identify(
        self, data: FitData, training: IdentificationSettings, context: FitContext
    ) -> FitRecord:
        """Fit tyres and levels.

        In this order: tyres by a genetic algorithm, sensor levels from quiet segments, process
        noise and ``force_factor`` by a search for the smallest error of sideslip, each where it is
        not given.
        """
        started = time.monotonic()
        metrics: dict[str, float] = {"epochs": 0}
        history: dict[str, list[float]] = {}
        interrupted = False
        if not self.tyres.has_values:
            metrics |= self._identify_tyres(data, training)
        self.levels |= read_sensor_levels(
            data.train,
            self.noise.unknown(SENSORS[self.inputs]),
            self.minimum_speed,
            self.rate_hz,
        )
        searched = self.noise.unknown(SEARCHED[self.inputs])
        if training.method == "data":
            self.levels |= {name: ASSUMED_LEVELS[name] for name in searched}
        elif searched:
            search = search_levels(self, searched, data.train, training, self.fit_seed, context)
            history = search.history(searched)
            metrics |= {"evaluations": search.evaluations, "best_train_loss": search.cost}
            self.levels |= dict(zip(searched, (10.0**search.best).tolist(), strict=True))
            interrupted = search.interrupted
        if data.validation and all("vy_ref" in recording for recording in data.validation):
            metrics["best_validation_loss"] = self.mean_squared_error(
                data.validation,
                training.skip_seconds,
                over=training.error,
                limit=training.error_limit,
            )
        metrics |= {f"noise_{name}": self.levels[name] for name in self.level_names}
        metrics["train_seconds"] = time.monotonic() - started
        return FitRecord(history=history, metrics=metrics, interrupted=interrupted)

    def _identify_tyres(self, data: FitData, training: IdentificationSettings) -> dict[str, float]:
        """Identify and set the tyre parameters of both axles.

        Returns metrics, name -> value: the parameters, half of their range over restarts, and the
        root mean square of residual forces [N].
        """
        fit = identify_tyres(
            data.train,
            self.car,
            self.curve,
            training,
            minimum_speed=self.minimum_speed,
            has_forces=self.inputs == "full",
            seed=self.fit_seed,
        )
        self.axle_tyres = fit.parameters.ravel()
        return {
            **dict(zip(TYRES, self.axle_tyres.tolist(), strict=True)),
            **dict(
                zip((f"{name}_spread" for name in TYRES), fit.spread.ravel().tolist(), strict=True)
            ),
            **dict(
                zip(("residual_front", "residual_rear"), fit.residual_rms.tolist(), strict=True)
            ),
        }

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """Tyre parameters in the order of `AxleTyres`, levels in that of `level_names`."""
        return {
            "tyres": self.axle_tyres.copy(),
            "levels": np.array([self.levels[name] for name in self.level_names]),
        }

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Set tyres and levels from stored weights.

        Raises
        ------
        DataError
            They do not fit, or are out of their settings' bounds.
        """
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
        """Reference channels that the fit needs: ``vy_ref`` for a searched level, or for tyres
        where there is no ``sideslip_ref``.
        """
        if training.method != "data" and self.noise.unknown(SEARCHED[self.inputs]):
            return ("vy_ref",)
        return () if self.tyres.has_values or "sideslip_ref" in channels else ("vy_ref",)

    def unmatched_patterns(self, training: Any, recordings: Collection[str]) -> tuple[str, ...]:
        """The override that lets tyres be fitted to all recordings, where none matches
        ``training.tyres_from``; else empty.
        """
        if self.tyres.has_values or any(
            fnmatch.fnmatchcase(name, training.tyres_from) for name in recordings
        ):
            return ()
        return ("training.tyres_from='*'",)

    def c_values(self) -> dict[str, Any]:
        """Values of the C template for the filter without a network."""
        return {"network": False, **super().c_values(), **track_c_values(self)}


ESTIMATOR = DugoffUkf  # class by which the registry finds the family
