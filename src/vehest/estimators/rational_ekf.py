"""Kalman filter of a single track whose tyre model adapts.

Di Biase, Lenzo & Timpone, IEEE Access 8, 2020.

    training recordings --fit--> axle curves, their covariance, noise levels
    yaw_rate, vx, ay, steer --filter_samples--> β, r, tyre parameters
    --run--> vy, cornering stiffnesses

This module declares the estimator: settings, fitted numbers, names, files. The filters are in
`filtering.rational_model`, the fit in `filtering.rational_fit`, values for C in
`filtering.rational_c`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.declared import MAX_SETTING as LARGEST_SETTING
from vehest.declared import Group, setting
from vehest.estimators.base import (
    FitData,
    FitRecord,
    Trial,
    rate,
    require_shapes,
    require_within_bounds,
)
from vehest.estimators.filtering.rational_c import rational_c_values
from vehest.estimators.filtering.rational_fit import (
    LevelSearch,
    drives_of,
    fit_axle_curves,
    mean_squared_error,
    recordings_for_curves,
    searched_levels,
)
from vehest.estimators.filtering.rational_model import (
    CURVES,
    KINDS,
    LEVELS,
    MAX_MOTION,
    ROLLING,
    RationalModel,
    TyreKind,
    filter_extended,
    filter_unscented,
)
from vehest.estimators.filtering.rational_model import Tyres as Tyres
from vehest.estimators.filtering.sideslip_filter import FilteredStates, SideslipFilter, read_levels
from vehest.filters.gating import Gate
from vehest.filters.gaussian import Gaussian
from vehest.training.context import FitContext
from vehest.training.noise_tuning import NoiseTuningSettings
from vehest.vehicle.tyre_track import TyreTrack

# Noise levels where nothing is tuned (method=data): steer [rad/√s], tyres [1/√s].
ASSUMED_LEVELS = {"steer": 0.02, "tyres": 0.003}
NOISE_CUTOFF = 0.2  # frequency above which signals count as noise, over the Nyquist frequency
# Standard deviation of the logarithms of curves that are given, where no other is.
DEFAULT_CURVE_DEVIATION = 0.1
# Rounding of a covariance in a file, relative to its largest entry.
COVARIANCE_TOLERANCE = 1e-6


@dataclass(frozen=True)
class TrackNoise(Group):
    """Standard deviations, those of the three sensors all or none.

    Where they are not given, the fit finds them.
    """

    group = "estimator.noise"
    yaw_rate: float | None = setting(None, "of the gyroscope", unit="rad/s", positive=True)
    ay: float | None = setting(
        None, "of the accelerometer, and of what the model misses", unit="m/s²", positive=True
    )
    steer: float | None = setting(
        None, "of the steering angle, over a second's step", unit="rad/√s", positive=True
    )
    tyres: float | None = setting(
        None,
        "by which logarithms of tyre parameters wander; training drives on one set of tyres and "
        "one road say little of it",
        unit="1/√s",
        positive=True,
    )


@dataclass(frozen=True)
class AxleCurves(Group):
    """Axle curves at friction 1, all that the tyres need or none.

    Where they are not given, the fit finds them.
    """

    group = "estimator.curves"
    c1_front: float | None = setting(
        None, "where the front axle's curve bends; not of linear tyres", unit="rad²", positive=True
    )
    c2_front: float | None = setting(
        None, "cornering stiffness of the front axle", unit="N/rad", positive=True
    )
    c1_rear: float | None = setting(
        None, "where the rear axle's curve bends; not of linear tyres", unit="rad²", positive=True
    )
    c2_rear: float | None = setting(
        None, "cornering stiffness of the rear axle", unit="N/rad", positive=True
    )
    deviation: float | None = setting(
        None,
        "standard deviation of their logarithms at the start, on top of the fit's; null: 0 after "
        "a fit, else 0.1",
        positive=True,
    )

    @property
    def has_values(self) -> bool:
        """Whether the curves are given, so that none is fitted."""
        return self.c2_front is not None


class RationalTrack(SideslipFilter):
    """A filter over `TyreTrack`: its settings, its model, and how it filters samples.

    Attributes
    ----------
    axle_curves : array, shape (4,)
        c₁ [rad²] and c₂ [N/rad] of the front, then of the rear axle, NaN before the fit. c₁ is
        infinite where tyres are linear.
    curve_covariance : array, shape (4, 4)
        Covariance of their logarithms at the start.
    values : dict
        Noise levels by name (`LEVELS`); NaN before the fit.
    """

    rate_hz: float = rate(20.0)
    tyres: Tyres = setting(
        "rational_adaptive",
        "linear (LINT: cornering stiffnesses are states), rational (RATT: fixed), "
        "rational_adaptive (RATTE: c₁ and c₂ of both axles are states) or rational_friction "
        "(beyond the paper: the friction is)",
    )
    filter: Literal["extended", "unscented"] = setting("extended", "kind of Kalman filter")
    bound: float = setting(
        3.0,
        "factor by which tyre parameters may leave those at the start, three of their standard "
        "deviations at least",
        above=1.0,
    )
    largest_sideslip: float = setting(
        0.5,
        "beyond it the filter has diverged: motion and tyres restart",
        unit="rad",
        above=0.0,
        most=MAX_MOTION[0],
    )
    adapt_above: float = setting(
        0.0,
        "lateral acceleration |u r| below which tyre parameters are held; 0: never, as in the "
        "paper",
        unit="m/s²",
        least=0.0,
    )
    noise: TrackNoise = setting(
        TrackNoise(),
        "standard deviations, the first three all or none; null: found by the training",
    )
    curves: AxleCurves = setting(
        AxleCurves(),
        "of the axles at friction 1, all or none; null: fitted to the reference sideslip",
    )

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        curves = {name: getattr(settings.curves, name) for name in self.kind.curve_names}
        self.axle_curves = np.array([curves.get(name, math.inf) for name in CURVES], np.float64)
        deviation = settings.curves.deviation or DEFAULT_CURVE_DEVIATION
        self.curve_covariance = deviation**2 * np.eye(len(CURVES))
        levels = {
            name: getattr(settings.noise, name) if name in self.kind.level_names else 0.0
            for name in LEVELS
        }
        self.values = {name: math.nan if level is None else level for name, level in levels.items()}

    def check(self) -> None:
        """Check the gate, and that levels and curves are given together.

        Raises
        ------
        ConfigurationError
            A gate of the unscented filter, or levels or curves that are given in part.
        """
        if self.gate is not None and self.filter != "extended":
            raise ConfigurationError(
                "estimator.gate is there for estimator.filter=extended only; set gate to null, "
                "or the filter to extended"
            )
        for group, names in (("noise", LEVELS[:3]), ("curves", self.kind.curve_names)):
            values = [getattr(getattr(self, group), name) for name in names]
            if None in values and values.count(None) < len(values):
                raise ConfigurationError(
                    f"estimator.{group}: give all of {', '.join(names)}, or none of them"
                )

    @property
    def kind(self) -> TyreKind:
        """Names and parameters of the tyre model of the settings."""
        return KINDS[self.tyres]

    @property
    def adapts(self) -> bool:
        """Whether tyre parameters are states."""
        return bool(self.adapted)

    @property
    def adapted(self) -> tuple[str, ...]:
        """Names of the tyre parameters that are states."""
        return self.kind.adapted

    def model(self) -> RationalModel:
        """The model with the fitted curves, the limits and the start of the filter."""
        return RationalModel(
            self.car,
            self.axle_curves,
            self.curve_covariance,
            self.adapted,
            1.0 / self.rate_hz,
            self.minimum_speed,
            self.adapt_above,
            self.largest_sideslip,
            self.bound,
        )

    def track(self) -> TyreTrack:
        """The equations of motion in torch, at the curves that the filter starts with."""
        self.require_fitted({})
        return self.model().track()

    def first_gaussian(
        self, sample: FloatArray, initial_state: Mapping[str, float]
    ) -> Gaussian[FloatArray]:
        """State before the first sample.

        Straight ahead, or an initial state; tyre parameters as fitted.
        """
        tyres = self.model().start_tyre_covariance
        deviation = np.array([*ROLLING, *np.zeros(len(tyres))])
        first = self.first_motion(sample, deviation, initial_state)
        first.covariance[4:, 4:] = tyres
        return first

    def filter_samples(
        self,
        samples: FloatArray,
        first: Gaussian[FloatArray] | None = None,
        gate: Gate | None = None,
        refused: NDArray[np.int64] | None = None,
        levels: Mapping[str, float] | None = None,
        crossfall: float = 0.0,
    ) -> FilteredStates:
        """Filter samples of ``channels``, (T, 4); see `filter_extended`.

        Parameters
        ----------
        first : Gaussian, optional
            State at the first sample before its measurement; by default `first_gaussian` of it.
        levels : mapping, optional
            Noise levels; by default ``values``.

        Raises
        ------
        ConfigurationError
            Curves or levels are neither given nor fitted.
        """
        levels = self.values if levels is None else levels
        self.require_fitted(levels)
        first = self.first_gaussian(samples[0], {}) if first is None else first
        if self.filter == "unscented":
            return filter_unscented(self.model(), samples, levels, first)
        return filter_extended(self.model(), samples, levels, first, gate, refused, crossfall)

    def quantities(self, states: FloatArray) -> dict[str, FloatArray]:
        """Cornering stiffnesses [N/rad], c₁ [rad²] and friction of states (T, n)."""
        return self.model().quantities(states)

    def require_fitted(self, levels: Mapping[str, float] | None = None) -> None:
        """Check that curves and levels are given or fitted.

        Raises
        ------
        ConfigurationError
            Curves or levels are neither given nor fitted.
        """
        has_no_curves = np.isnan(self.axle_curves).any()
        levels = self.values if levels is None else levels
        if has_no_curves or any(math.isnan(level) for level in levels.values()):
            raise ConfigurationError(
                f"estimator '{self.name}' has no "
                f"{'axle curves' if has_no_curves else 'noise levels'} yet; fit or load it first, "
                "or give estimator.curves and estimator.noise"
            )


class RationalFilter(RationalTrack):
    """Kalman filter over `TyreTrack`.

    Its states are sideslip angle, yaw rate, their rates and, if adapted, tyre parameters.

    Measured are yaw rate and lateral acceleration; steering angle and speed are inputs. Process
    noise Δt B Λ Bᵀ comes from the steering angle and the drift of tyre parameters. Below the
    minimum speed wheels roll without slip, and tyre parameters stay.

    Source: Di Biase, Lenzo & Timpone 2020, Eqs. 11 to 60. Friction as a state and the unscented
    filter are not in the paper.
    """

    name = "rational_ekf"
    title = "EKF with tyres"
    trials = (
        Trial(
            6,
            "filter whose tyres adapt; a minute",
            "{car} training.grid=1 training.max_evaluations=40",
        ),
    )
    training_type = NoiseTuningSettings
    template = "rational_ekf"
    # Names

    @property
    def variant(self) -> str:
        """The paper's name of the tyres, with suffixes for an unscented filter, for tyres that are
        held straight ahead, and for a gate.
        """
        filter_suffix = "_ukf" if self.filter == "unscented" else ""
        stay_suffix = "_held" if self.adapted and self.adapt_above > 0.0 else ""
        return self.kind.variant + filter_suffix + stay_suffix + self.gate_suffix

    @property
    def full_title(self) -> str:
        """Title with the paper's name of the tyres, and the kind of filter."""
        stay = ", tyres held straight ahead" if self.adapted and self.adapt_above > 0.0 else ""
        return f"{self.kind.title}, {self.filter} Kalman filter{stay}{self.gate_title}"

    # Fit

    @property
    def unknown_levels(self) -> tuple[str, ...]:
        """Noise levels that the settings leave to the fit."""
        return tuple(name for name in self.kind.level_names if getattr(self.noise, name) is None)

    @property
    def n_parameters(self) -> int:
        """Number of parameters of curves and of noise levels that are fitted."""
        n_curves = 0 if self.curves.has_values else len(self.kind.curve_names)
        return n_curves + len(self.unknown_levels)

    def references(self, training: Any, channels: Collection[str]) -> tuple[str, ...]:
        """Reference channels that the fit needs: ``vy_ref`` for fitted curves or searched levels,
        unless recordings have ``sideslip_ref``.
        """
        is_searched = training.method != "data" and bool(searched_levels(self.unknown_levels))
        needs_none = self.curves.has_values and not is_searched
        return () if needs_none or "sideslip_ref" in channels else ("vy_ref",)

    @classmethod
    def fit_members(
        cls, members: Sequence[Any], data: FitData, training: Any, context: FitContext
    ) -> list[FitRecord]:
        """Fit axle curves to the reference sideslip, then search noise levels.

        See `NoiseTuningSettings`.

        Members of one seed cannot differ, others only by Optuna's trials.
        """
        return [_fit(member, data, training, context) for member in members]

    # Files

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """Curves, the covariance of their logarithms, and noise levels.

        The infinite c₁ of linear tyres is 0 in a file, whose numbers are finite.
        """
        return {
            "curves": np.where(np.isinf(self.axle_curves), 0.0, self.axle_curves),
            "curve_covariance": self.curve_covariance.copy(),
            "levels": np.array([self.values[name] for name in LEVELS]),
        }

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Set curves, their covariance and noise levels from a file.

        Raises
        ------
        DataError
            They do not fit, are out of their settings' bounds, or the covariance is none.
        """
        require_shapes(
            self, weights, {name: values.shape for name, values in self.weights().items()}
        )
        curves = np.array(weights["curves"], dtype=np.float64)
        covariance = np.array(weights["curve_covariance"], dtype=np.float64)
        levels = dict(zip(LEVELS, weights["levels"].tolist(), strict=True))
        curve_of = dict(zip(CURVES, curves.tolist(), strict=True))
        require_within_bounds(
            {name: curve_of[name] for name in self.kind.curve_names},
            AxleCurves.declarations(),
            "curves",
        )
        require_within_bounds(
            {name: levels[name] for name in self.kind.level_names},
            TrackNoise.declarations(),
            "levels",
        )
        _require_covariance("curve_covariance", covariance)
        self.axle_curves = np.where(curves == 0.0, math.inf, curves)
        self.curve_covariance = covariance
        self.values = levels

    def c_values(self) -> dict[str, Any]:
        """Values of the C template; raises `ConfigurationError`: the filter is unscented."""
        if self.filter != "extended":
            raise ConfigurationError(
                "estimator 'rational_ekf' with estimator.filter=unscented has no C; train it "
                "with filter=extended"
            )
        tables = rational_c_values(self.model(), self.values, is_linear=self.tyres == "linear")
        return {**super().c_values(), **tables}


def _fit(
    estimator: RationalFilter, data: FitData, training: NoiseTuningSettings, context: FitContext
) -> FitRecord:
    """Fit curves, then noise levels, each where it is not given.

    ``best_train_loss`` and ``best_validation_loss`` are mean squared errors of sideslip [rad²]. Of
    the levels that are not searched, the yaw rate's is calibrated by the innovations
    (`LevelSearch`), or all are read off or assumed (``method=data``).
    """
    started = time.monotonic()
    metrics: dict[str, float] = {"epochs": 0}
    history: dict[str, list[float]] = {}
    interrupted = False
    skip = round(training.skip_seconds * estimator.rate_hz)
    if not estimator.curves.has_values:
        fit = fit_axle_curves(
            recordings_for_curves(data.train, training.curves_from),
            estimator.car,
            estimator.minimum_speed,
            "linear" if estimator.tyres == "linear" else "rational",
            estimator.curves.deviation or 0.0,
        )
        estimator.axle_curves = fit.curves
        estimator.curve_covariance = fit.covariance
        metrics |= fit.metrics
    unknown = estimator.unknown_levels
    searched = searched_levels(unknown)
    if training.method == "data":
        sensors = [name for name in ("yaw_rate", "ay") if name in unknown]
        estimator.values |= {
            **{name: level for name, level in ASSUMED_LEVELS.items() if name in unknown},
            **read_levels(data.train, sensors, NOISE_CUTOFF),
        }
    elif searched:
        model = estimator.model()
        # The unscented filter takes the levels of the extended one: its own search would take
        # hours.
        search = LevelSearch(
            searched,
            estimator.values,
            estimator.noise.tyres or 0.0,
            lambda samples, levels: filter_extended(
                model, samples, levels, estimator.first_gaussian(samples[0], {})
            ),
            drives_of(data.train, estimator.channels),
            estimator.minimum_speed,
            skip,
        )
        outcome = search.run(training, estimator.fit_seed, context)
        history = outcome.history(searched)
        metrics |= {
            "evaluations": outcome.evaluations,
            "best_train_loss": outcome.cost,
            "levels_at_limits": search.n_at_limits(outcome.best),
        }
        estimator.values = search.levels_at(outcome.best)
        interrupted = outcome.interrupted
    if data.validation and all(
        "sideslip_ref" in recording or "vy_ref" in recording for recording in data.validation
    ):
        metrics["best_validation_loss"] = mean_squared_error(
            lambda samples, levels: estimator.filter_samples(samples, levels=levels),
            drives_of(data.validation, estimator.channels),
            estimator.values,
            estimator.minimum_speed,
            skip,
        )
    metrics |= {f"noise_{name}": estimator.values[name] for name in estimator.kind.level_names}
    metrics["train_seconds"] = time.monotonic() - started
    return FitRecord(history=history, metrics=metrics, interrupted=interrupted)


def _require_covariance(name: str, values: FloatArray) -> None:
    """Raise `DataError` for a loaded matrix that is no covariance.

    It is not symmetric, not positive semidefinite, or has too large a number.
    """
    largest = float(np.abs(values).max())
    if not largest <= LARGEST_SETTING:
        raise DataError(
            f"'{name}' must hold numbers of at most {LARGEST_SETTING:g}, not {largest:g}"
        )
    if not np.allclose(values, values.T, rtol=0.0, atol=COVARIANCE_TOLERANCE * largest):
        raise DataError(f"'{name}' is no covariance: it is not symmetric")
    lowest = float(np.linalg.eigvalsh(values)[0])
    if lowest < -COVARIANCE_TOLERANCE * largest:
        raise DataError(f"'{name}' is no covariance: it has the eigenvalue {lowest:g}")


ESTIMATOR = RationalFilter  # class by which the registry finds the family
