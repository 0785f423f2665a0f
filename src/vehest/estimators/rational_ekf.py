"""Extended Kalman filter with a tyre model that adapts: Di Biase, Lenzo & Timpone, IEEE Access 8, 2020."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import Recording
from vehest.declared import LARGEST as LARGEST_SETTING
from vehest.declared import Group, setting
from vehest.estimators.base import (
    FitData,
    FitRecord,
    Trial,
    rate,
    require_shapes,
    require_within_bounds,
)
from vehest.estimators.filtering.sideslip_filter import FilteredStates, SideslipFilter, read_levels
from vehest.estimators.filtering.tyre_fit import (
    NORMAL_95,
    AxleMotion,
    TyreFit,
    axle_motion,
    fit_motion,
)
from vehest.estimators.kernels.rational_ekf import _roll, scan
from vehest.filters.gating import Gate
from vehest.filters.gaussian import Gaussian
from vehest.filters.sigma_points import symmetric_rule
from vehest.filters.unscented_scan import TorchModel, UnscentedStepper
from vehest.training.context import FitContext
from vehest.training.noise_tuning import NoiseTuningSettings
from vehest.training.search import SearchRecord
from vehest.vehicle.tyre_track import MOTION, TYRE_PARAMETERS, TyreTrack

LEVELS = ("yaw_rate", "ay", "steer", "tyres")
CURVES = TYRE_PARAMETERS[:4]
ASSUMED = {"steer": 0.02, "tyres": 0.003}  # rad √s, 1/√s: where nothing is tuned
CUTOFF = 0.2  # of the Nyquist frequency, above which signals count as noise
ROLLING = (
    0.05,
    0.2,
    1.0,
    2.0,
)  # rad, rad/s, rad/s, rad/s²: standard deviations of a motion that is only guessed
LOST = 1.0  # rad, standard deviation of a sideslip angle of which nothing is known any more
LARGEST = (1.5, 5.0, 20.0, 100.0)  # the same units: what estimates are kept within
WITHIN = 3.0  # standard deviations at the start that tyre parameters may leave their start by, whatever the bound
FORCE_SCALE = 0.05  # of axle forces from accelerations, one standard deviation: scale of the accelerometer, and what it feels of body roll
SLIP_OFFSET = math.radians(0.15)  # of slip angles by the reference, likewise: its mounting
FRICTION_START = 0.1  # standard deviation of its logarithm
ROUNDING = 1e-6  # of its largest entry, by which a covariance in a file may miss being one
GIVEN_DEVIATION = 0.1  # of the logarithms of curves that nobody fitted
BOXES = {
    "ay": (-1.0, 5.0),
    "steer": (-4.0, 4.0),
    "tyres": (-8.0, 1.0),
}  # powers of ten: ay and steer over yaw_rate, tyres as it is
EDGE = 0.01  # of a box's width: a search that ends nearer to its end has ended on it
STARTS = {"ay": (1.5, 2.0), "steer": (0.0, 1.5), "tyres": (-3.5, -2.0)}
FIRST_SCALE = 0.01
CALIBRATIONS = 2  # rad/s: where the level of the yaw rate starts, and how often it is scaled

Tyres = Literal["linear", "rational", "rational_adaptive", "rational_friction"]
KINDS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "linear": ("lint", "LINT", ("c2_front", "c2_rear")),
    "rational": ("ratt", "RATT", ()),
    "rational_adaptive": ("ratte", "RATTE", CURVES),
    "rational_friction": ("ratmu", "RATT with friction", ("friction",)),
}
"""Tyres -> variant, its name in the paper, tyre parameters that are states."""


@dataclass(frozen=True)
class TrackNoise(Group):
    """Standard deviations, those of the three sensors all or none; where they are not given, the fit finds them."""

    group = "estimator.noise"
    yaw_rate: float | None = setting(None, "of the gyroscope", unit="rad/s", positive=True)
    ay: float | None = setting(
        None, "of the accelerometer, and of what the model misses", unit="m/s²", positive=True
    )
    steer: float | None = setting(
        None, "of the steering angle, over a second's step", unit="rad √s", positive=True
    )
    tyres: float | None = setting(
        None,
        "by which logarithms of tyre parameters wander; training drives on one set of tyres and one road say little of it",
        unit="1/√s",
        positive=True,
    )


@dataclass(frozen=True)
class AxleCurves(Group):
    """Axle curves at friction 1, all that the tyres need or none; where they are not given, the fit finds them."""

    group = "estimator.curves"
    c1_front: float | None = setting(
        None, "where the front axle's curve bends; not of linear tyres", unit="rad²", positive=True
    )
    c2_front: float | None = setting(
        None, "cornering stiffness of the front axle", unit="N/rad", positive=True
    )
    c1_rear: float | None = setting(None, "of the rear axle", unit="rad²", positive=True)
    c2_rear: float | None = setting(None, "of the rear axle", unit="N/rad", positive=True)
    deviation: float | None = setting(
        None,
        "standard deviation of their logarithms at the start, on top of the fit's; null: 0 after a fit, else 0.1",
        positive=True,
    )


class RationalFilter(SideslipFilter):
    """Filter of sideslip angle, yaw rate, their rates and, if wanted, tyre parameters, over `TyreTrack`.

    Measured are yaw rate and lateral acceleration; steering angle and speed are inputs. Process noise Δt B Λ Bᵀ comes from the steering
    angle and the wandering parameters. Below the minimum speed wheels roll without slip, and tyre parameters are held.

    Source: Di Biase, Lenzo & Timpone 2020, Eqs. 11 to 60; friction as a state and the unscented filter are beyond it.
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
    rate_hz: float = rate(20.0)
    tyres: Tyres = setting(
        "rational_adaptive",
        "linear (LINT: cornering stiffnesses are states), rational (RATT: fixed), rational_adaptive (RATTE: c₁ and c₂ of both axles are "
        "states) or rational_friction (beyond the paper: the friction is)",
    )
    filter: Literal["extended", "unscented"] = setting("extended", "kind of Kalman filter")
    bound: float = setting(
        3.0,
        "factor by which tyre parameters may leave those at the start, three of their standard deviations at least",
        above=1.0,
    )
    largest_sideslip: float = setting(
        0.5,
        "beyond it the filter has diverged: motion and tyres restart",
        unit="rad",
        above=0.0,
        most=LARGEST[0],
    )
    adapt_above: float = setting(
        0.0,
        "lateral acceleration |u r| below which tyre parameters are held; 0: never, as in the paper",
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
        given = {name: getattr(settings.curves, name) for name in self.curve_names}
        self.axle_curves = np.array([given.get(name, math.inf) for name in CURVES], np.float64)
        self.curve_covariance = (settings.curves.deviation or GIVEN_DEVIATION) ** 2 * np.eye(
            len(CURVES)
        )
        levels = vars(settings.noise) | {
            name: 0.0 for name in LEVELS if name not in self.level_names
        }
        self.values = {name: math.nan if level is None else level for name, level in levels.items()}

    def check(self) -> None:
        """Raises `ConfigurationError`: a gate of the unscented filter, or levels or curves that are given in part."""
        if self.gate is not None and self.filter != "extended":
            raise ConfigurationError(
                "estimator.gate is there for estimator.filter=extended only; set gate to null, or the filter to extended"
            )
        for group, names in (("noise", LEVELS[:3]), ("curves", self.curve_names)):
            given = [name for name in names if getattr(getattr(self, group), name) is not None]
            if given and len(given) < len(names):
                raise ConfigurationError(
                    f"estimator.{group}: give all of {', '.join(names)}, or none of them"
                )

    @property
    def adapted(self) -> tuple[str, ...]:
        """Tyre parameters that are states."""
        return KINDS[self.tyres][2]

    @property
    def level_names(self) -> tuple[str, ...]:
        """Levels of noise that these tyres need."""
        return LEVELS if self.adapted else LEVELS[:3]

    @property
    def curve_names(self) -> tuple[str, ...]:
        """Parameters that these tyres' curves have."""
        return tuple(name for name in CURVES if self.tyres != "linear" or name.startswith("c2"))

    def references(self, training: Any, channels: Collection[str]) -> tuple[str, ...]:
        """None where curves are given and no level is searched; ``vy_ref`` unless there is a sideslip angle."""
        given = self._curves_given and (training.method == "data" or not self._searched)
        return () if given or "sideslip_ref" in channels else ("vy_ref",)

    @property
    def adapts(self) -> bool:
        """Whether tyres are states."""
        return self.tyres != "rational"

    @property
    def variant(self) -> str:
        """The paper's name for these tyres, and whether the filter is another one, holds them straight ahead, or has a gate."""
        kind = KINDS[self.tyres][0] + ("_ukf" if self.filter == "unscented" else "")
        return (
            kind + ("_held" if self.adapted and self.adapt_above > 0.0 else "") + self.gate_suffix
        )

    @property
    def full_title(self) -> str:
        """The paper's name for these tyres, and the filter."""
        held = ", tyres held straight ahead" if self.adapted and self.adapt_above > 0.0 else ""
        return f"{KINDS[self.tyres][1]}, {self.filter} Kalman filter{held}{self.gate_title}"

    @property
    def n_parameters(self) -> int:
        """Parameters of curves and levels of noise that are not given."""
        return len(self.curve_names) * (not self._curves_given) + len(self._unknown)

    @property
    def _curves_given(self) -> bool:
        return self.curves.c2_front is not None

    @property
    def _unknown(self) -> tuple[str, ...]:
        return tuple(name for name in self.level_names if getattr(self.noise, name) is None)

    @property
    def _searched(self) -> tuple[str, ...]:
        """Levels that are tuned: the sensors' as ratios to the first, whose size follows from the innovations."""
        return tuple(name for name in self._unknown if name != LEVELS[0])

    def track(self) -> TyreTrack:
        """The model in torch, at the curves that the filter starts with."""
        self.require_fitted({})
        adapted = tuple(TYRE_PARAMETERS.index(name) for name in self.adapted)
        return TyreTrack(self.car, (*self.axle_curves.tolist(), 1.0), adapted, 1.0 / self.rate_hz)  # type: ignore[arg-type]

    @classmethod
    def fit_members(
        cls, members: Sequence[Any], data: FitData, training: Any, context: FitContext
    ) -> list[FitRecord]:
        """Fit axle curves to the reference sideslip of the training recordings, then find the noise levels; see `NoiseTuningSettings`.

        Members of one seed cannot differ, others only by Optuna's trials.
        """
        return [member._fit_one(data, training, context) for member in members]

    def _fit_one(
        self, data: FitData, training: NoiseTuningSettings, context: FitContext
    ) -> FitRecord:
        started = time.monotonic()
        metrics: dict[str, float] = {"epochs": 0}
        history: dict[str, list[float]] = {}
        interrupted = False
        if not self._curves_given:
            metrics |= self._fit_curves(_named_like(data.train, training.curves_from))
        if training.method == "data":
            self.values = self._levels_of(data.train)
        elif self._searched:
            extended = self._extended()
            drives = self._drives(data.train)
            search = extended._tune(drives, training, context)
            n = len(self._searched)
            history = search.history(self._searched)
            boxes = np.array([BOXES[name] for name in self._searched])
            at_limits = np.minimum(
                search.best[:n] - boxes[:, 0], boxes[:, 1] - search.best[:n]
            ) < EDGE * np.ptp(boxes, axis=1)
            metrics |= {
                "evaluations": search.evaluations,
                "best_train_loss": search.cost,
                "levels_at_limits": int(at_limits.sum()),
            }
            self.values = extended._calibrated(search.best[:n], drives)
            interrupted = search.interrupted
        if data.validation and all(
            "sideslip_ref" in own or "vy_ref" in own for own in data.validation
        ):
            skip = round(training.skip_seconds * self.rate_hz)
            metrics["best_validation_loss"] = self._cost(
                self._drives(data.validation), self.values, skip
            )
        metrics |= {f"noise_{name}": self.values[name] for name in self.level_names}
        metrics["train_seconds"] = time.monotonic() - started
        return FitRecord(history=history, metrics=metrics, interrupted=interrupted)

    def _fit_curves(self, recordings: Sequence[Recording]) -> dict[str, float]:
        """Set curves and the covariance of their logarithms; returns them with half the width of their 95 % intervals."""
        linear = self.tyres == "linear"
        kind: Literal["linear", "rational"] = "linear" if linear else "rational"
        motion = axle_motion(recordings, self.car, self.minimum_speed)
        fit = fit_motion(motion, kind)
        rows = [1, 3] if linear else [0, 1, 2, 3]
        self.axle_curves[rows] = [*fit.front, *fit.rear]
        self.curve_covariance = np.zeros((len(CURVES), len(CURVES)))
        for axle, covariance in enumerate(_covariances_of_logarithms(motion, kind, fit)):
            own = rows[axle * len(covariance) : (axle + 1) * len(covariance)]
            self.curve_covariance[np.ix_(own, own)] = covariance
        found = {CURVES[row]: float(self.axle_curves[row]) for row in rows}
        half = NORMAL_95 * self.axle_curves * np.sqrt(np.diagonal(self.curve_covariance))
        intervals = {f"{CURVES[row]}_interval": float(half[row]) for row in rows}
        self.curve_covariance[np.ix_(rows, rows)] += (self.curves.deviation or 0.0) ** 2 * np.eye(
            len(rows)
        )
        rms = dict(zip(("residual_front", "residual_rear"), fit.residual_rms.tolist(), strict=True))
        return {**found, **intervals, **rms}

    def _levels_of(self, recordings: Sequence[Recording]) -> dict[str, float]:
        assumed = {name: value for name, value in ASSUMED.items() if name in self._unknown}
        return (
            self.values
            | assumed
            | read_levels(
                recordings, [name for name in LEVELS[:2] if name in self._unknown], CUTOFF
            )
        )

    def _extended(self) -> RationalFilter:
        """The extended filter of the same model, by which levels are found: a search through the unscented one would take hours."""
        if self.filter == "extended":
            return self
        twin = copy(self)
        twin.settings = replace(self.settings, filter="extended")
        return twin

    def _drives(self, recordings: Sequence[Recording]) -> list[tuple[FloatArray, FloatArray]]:
        """Samples of ``channels``, (T, 4), and the reference sideslip [rad], (T,), of each recording."""
        return [(recording.stack(self.channels), _reference(recording)) for recording in recordings]

    def _tune(
        self,
        drives: Sequence[tuple[FloatArray, FloatArray]],
        training: NoiseTuningSettings,
        context: FitContext,
    ) -> SearchRecord:
        """Levels with the smallest error of sideslip, as powers of ten."""
        skip = round(training.skip_seconds * self.rate_hz)

        def cost(powers: FloatArray) -> float:
            return self._cost(drives, self._calibrated(powers, drives), skip)

        boxes, starts = ([limits[name] for name in self._searched] for limits in (BOXES, STARTS))
        return training.search(cost, boxes, starts, self._seed, context)

    def _calibrated(
        self, powers: FloatArray, drives: Sequence[tuple[FloatArray, FloatArray]]
    ) -> dict[str, float]:
        """Levels at powers of ten of `_searched`; those of sensors are scaled so that innovations are as large as the filter expects."""
        found = dict(zip(self._searched, (10.0**powers).tolist(), strict=True))
        tyres = found.get("tyres", self.noise.tyres or 0.0)
        if "ay" not in found:
            return {**self.values, "tyres": tyres}

        def scaled(scale: float) -> dict[str, float]:
            return {
                "yaw_rate": scale,
                "ay": scale * found["ay"],
                "steer": scale * found["steer"],
                "tyres": tyres,
            }

        scale = FIRST_SCALE
        for _ in range(CALIBRATIONS):
            levels = scaled(scale)
            total = 0.0
            count = 0.0
            for samples, _ in drives:
                nis, n_measured = self.filter_samples(samples, levels=levels).nis()
                total = total + float(nis.sum())
                count = count + float(n_measured.sum())
            if not (math.isfinite(total) and total > 0.0):
                break
            scale *= math.sqrt(total / max(count, 1.0))
        return scaled(scale)

    def _cost(
        self,
        drives: Sequence[tuple[FloatArray, FloatArray]],
        levels: Mapping[str, float],
        skip: int,
    ) -> float:
        """Mean squared error of sideslip [rad²] over samples fast enough for the model."""
        total = 0.0
        count = 0
        for samples, reference in drives:
            error = (self.filter_samples(samples, levels=levels).mean[:, 0] - reference)[skip:]
            counted = (samples[skip:, 1] >= self.minimum_speed) & np.isfinite(reference[skip:])
            total = total + float(np.square(error[counted]).sum())
            count = count + int(counted.sum())
        return total / max(count, 1)

    def first_gaussian(
        self, sample: FloatArray, given: Mapping[str, float]
    ) -> Gaussian[FloatArray]:
        """At rest on its course, or what a protocol hands over; parameters as they were fitted."""
        tyres = self.start_tyres()
        first = self.first_motion(sample, np.array([*ROLLING, *np.zeros(len(tyres))]), given)
        first.covariance[4:, 4:] = tyres
        return first

    def start_tyres(self) -> FloatArray:
        """Covariance of the logarithms of the adapted tyre parameters at the start, (n - 4, n - 4)."""
        adapted = self.adapted
        if adapted == ("friction",):
            return np.array([[FRICTION_START**2]])
        rows = [CURVES.index(name) for name in adapted]
        return np.ascontiguousarray(self.curve_covariance[np.ix_(rows, rows)])

    def bounds(self) -> FloatArray:
        """Largest absolute value of each state, (n,)."""
        spread = WITHIN * np.sqrt(np.diagonal(self.start_tyres()))
        return np.array([*LARGEST, *np.maximum(spread, math.log(self.bound)).tolist()])

    def filter_samples(
        self,
        samples: FloatArray,
        first: Gaussian[FloatArray] | None = None,
        gate: Gate | None = None,
        refused: NDArray[np.int64] | None = None,
        levels: Mapping[str, float] | None = None,
        crossfall: float = 0.0,
    ) -> FilteredStates:
        """Filter samples of ``channels``, (T, 4), from a state at the first one before its measurement, by default `first_gaussian` of it.

        Args:
            gate: levels are found without.
            refused: see `Gate`.
            levels: of noise; none: `values`.
            crossfall: deviation by which the last state drifts where ``first`` has one more, the pull of a crossfall [m/s² √s⁻¹].

        Raises `ConfigurationError`: curves or levels are neither given nor fitted.
        """
        levels = self.values if levels is None else levels
        self.require_fitted(levels)
        first = self.first_gaussian(samples[0], {}) if first is None else first
        if self.filter == "unscented":
            return self._unscented(samples, first, levels)
        car = self.car
        adapted = self.adapted
        bounds = self.bounds()
        mean = first.mean.copy()
        covariance = first.covariance.copy()
        pull = [crossfall] * (len(mean) - len(bounds))
        out = _empty(len(samples), len(mean))
        track = (
            np.array([car.mass, car.yaw_inertia, car.cg_to_front_axle, car.cg_to_rear_axle]),
            np.array([*self.axle_curves, 1.0]),
            np.array([TYRE_PARAMETERS.index(name) for name in adapted], dtype=np.int64),
            *(1.0 / self.rate_hz, self.minimum_speed, self.adapt_above),
        )
        variances = np.square(
            [
                levels["yaw_rate"],
                levels["ay"],
                levels["steer"],
                *[levels["tyres"]] * len(adapted),
                *pull,
            ]
        )
        guessed = self.largest_sideslip, LOST**2, np.square(ROLLING)
        limit, patience = (math.inf, 0) if gate is None else (gate.deviations**2, gate.patience)
        gated = limit, patience, np.zeros(2, np.int64) if refused is None else refused
        bounds = np.append(bounds, [math.inf] * len(pull))
        scan(
            np.ascontiguousarray(samples),
            track,
            variances,
            bounds,
            self.start_tyres(),
            guessed,
            gated,
            (mean, covariance),
            out,
        )
        return FilteredStates(*out, Gaussian(mean, covariance))

    def _unscented(
        self, samples: FloatArray, first: Gaussian[FloatArray], levels: Mapping[str, float]
    ) -> FilteredStates:
        """The same by sigma points; what is held keeps its variance (Schmidt's consider state)."""
        car = self.car
        track = self.track()
        bound = self.bounds()
        limit = torch.as_tensor(
            bound
        )  # points are drawn again each time, so they may be kept within it in place
        model = TorchModel(
            lambda points, inputs: track.transition(points.clamp_(-limit, limit), inputs),
            lambda points, inputs: track.observation(points.clamp_(-limit, limit), inputs),
        )
        filtered = UnscentedStepper(model, *first, 2, symmetric_rule(len(bound), 0.0))
        prior = filtered.prior
        (mean, covariance) = filtered.state
        mean[:], covariance[:] = first
        sensors = np.square([[levels["yaw_rate"], levels["ay"]]])[..., None] * np.eye(2)
        geometry = np.array([car.mass, car.yaw_inertia, car.cg_to_front_axle, car.cg_to_rear_axle])
        out = _empty(len(samples), len(bound))

        for k, (yaw_rate, vx, ay, steer) in enumerate(samples):
            if vx < self.minimum_speed:
                _roll.py_func(mean, covariance, np.square(ROLLING), geometry, vx, steer)
                innovation = np.zeros(2)
                spread = np.eye(2)
                measured = np.zeros(2, bool)
            else:
                if k:
                    before = np.array(
                        [max(samples[k - 1, 1], self.minimum_speed), samples[k - 1, 3]]
                    )
                    wanders = abs(before[0] * (mean[1] + track.step * mean[3])) >= self.adapt_above
                    spreads = levels["steer"], levels["tyres"] * wanders
                    at = torch.as_tensor(mean[None]), torch.as_tensor(before[None])
                    filtered.predict(before, track.process_noise(*at, *spreads).numpy())
                    prior.mean.clip(-bound, bound, out=prior.mean)
                    diverged = not abs(prior.mean[0]) < self.largest_sideslip
                    if diverged or not prior.covariance[0, 0] < LOST**2:
                        _roll.py_func(*prior, np.square(ROLLING), geometry, vx, steer)
                    if diverged:
                        prior.mean[4:] = 0.0
                        prior.covariance[4:, 4:] = self.start_tyres()
                filtered.update(np.array([yaw_rate, ay]), np.array([vx, steer]), sensors)
                innovation = filtered.innovation
                spread = filtered.innovation_covariance
                measured = ~np.isnan([yaw_rate, ay])
                if abs(vx * prior.mean[1]) < self.adapt_above:
                    gain = filtered.gain.copy()
                    gain[4:] = 0.0
                    both = gain @ spread @ filtered.gain.T
                    covariance[:] = prior.covariance - both - both.T + gain @ spread @ gain.T
                    mean[:] = prior.mean + gain @ innovation
                mean.clip(-bound, bound, out=mean)
            deviation = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
            for target, values in zip(
                out,
                (mean, deviation, covariance[:2, :2], innovation, spread, measured),
                strict=True,
            ):
                target[k] = values
        return FilteredStates(*out, Gaussian(mean.copy(), covariance.copy()))

    def parameters_of(self, states: FloatArray) -> dict[str, FloatArray]:
        """Tyre parameters of states, (T, n), in SI units: name -> (T,)."""
        values = dict(
            zip(
                TYRE_PARAMETERS,
                np.repeat([*self.axle_curves, 1.0], len(states)).reshape(5, -1),
                strict=True,
            )
        )
        for column, name in enumerate(self.adapted, len(MOTION)):
            values[name] = values[name] * np.exp(states[:, column])
        return values

    def quantities(self, states: FloatArray) -> dict[str, FloatArray]:
        """What an estimate says of the tyres."""
        tyres = self.parameters_of(states)
        found = {
            f"cornering_stiffness_{axle}": tyres[f"c2_{axle}"] * tyres["friction"]
            for axle in ("front", "rear")
        }
        if self.tyres != "linear":
            found |= {f"tyre_c1_{axle}": tyres[f"c1_{axle}"] for axle in ("front", "rear")}
        if self.tyres == "rational_friction":
            found["friction"] = tyres["friction"]
        return found

    def require_fitted(self, levels: Mapping[str, float] | None = None) -> None:
        """Raises `ConfigurationError`: curves or levels are neither given nor fitted."""
        has_no_curves = np.isnan(self.axle_curves).any()
        if has_no_curves or any(
            math.isnan(level) for level in (self.values if levels is None else levels).values()
        ):
            raise ConfigurationError(
                f"estimator '{self.name}' has no {'axle curves' if has_no_curves else 'noise levels'} yet; "
                "fit or load it first, or give estimator.curves and estimator.noise"
            )

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """Curves c₁ and c₂ of the front, then of the rear axle, the covariance of their logarithms, and the levels of noise.

        Linear tyres have no c₁: 0 stands for it in a file, whose numbers are finite.
        """
        levels = np.array([self.values[name] for name in LEVELS])
        curves = np.where(np.isinf(self.axle_curves), 0.0, self.axle_curves)
        return {
            "curves": curves,
            "curve_covariance": self.curve_covariance.copy(),
            "levels": levels,
        }

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Take curves, their covariance and levels back.

        Raises `DataError`: they do not fit, are out of their settings' bounds, or the covariance is none.
        """
        require_shapes(
            self, weights, {name: values.shape for name, values in self.weights().items()}
        )
        curves = np.array(weights["curves"], dtype=np.float64)
        covariance = np.array(weights["curve_covariance"], dtype=np.float64)
        levels = dict(zip(LEVELS, weights["levels"].tolist(), strict=True))
        by_name = dict(zip(CURVES, curves.tolist(), strict=True))
        require_within_bounds(
            {name: by_name[name] for name in self.curve_names}, AxleCurves.declarations(), "curves"
        )
        require_within_bounds(
            {name: levels[name] for name in self.level_names}, TrackNoise.declarations(), "levels"
        )
        _require_covariance("curve_covariance", covariance)
        self.axle_curves = np.where(curves == 0.0, math.inf, curves)
        self.curve_covariance = covariance
        self.values = levels

    def c_values(self) -> dict[str, Any]:
        """Its car, curves, levels of noise and gate; raises `ConfigurationError`: its filter is unscented."""
        if self.filter != "extended":
            raise ConfigurationError(
                "estimator 'rational_ekf' with estimator.filter=unscented has no C; train it with filter=extended"
            )
        adapted = [_slope_in_c(name) for name in self.adapted]
        step = 1.0 / self.rate_hz
        return {
            **super().c_values(),
            "n": 4 + len(adapted),
            "columns": 4 + len(adapted) + max(2, 1 + len(adapted)),
            "linear": self.tyres == "linear",
            "adapted": adapted,
            "wanted": [
                part
                for part in ("c1", "friction")
                if any(part in tyre["slope"] for tyre in adapted)
            ],
            "states": {name: row for row, name in enumerate(self.adapted, 4)},
            "curves": dict(zip(TYRE_PARAMETERS, [*self.axle_curves.tolist(), 1.0], strict=True)),
            "car": self.car,
            "step": step,
            "minimum_speed": self.minimum_speed,
            "adapt_above": self.adapt_above,
            "sensors": [self.values["yaw_rate"], self.values["ay"]],
            "steer_spread": math.sqrt(step) * self.values["steer"],
            "tyre_spread": math.sqrt(step) * self.values["tyres"],
            "bounds": self.bounds(),
            "rolling": ROLLING,
            "largest_sideslip": self.largest_sideslip,
            "lost": LOST,
            "tyre_root": _root(self.start_tyres()),
        }


def _slope_in_c(name: str) -> dict[str, str]:
    """A tyre parameter that is a state: the axle it is of, and the member of the axle's force that is its slope."""
    if name == "friction":
        return {"name": name, "axle": "both", "slope": "per_log_friction"}
    curve, axle = name.split("_")
    return {"name": name, "axle": axle, "slope": "force" if curve == "c2" else "per_log_c1"}


def _root(covariance: FloatArray) -> FloatArray:
    """Lower triangular L with L Lᵀ = covariance, which need not be definite."""
    values, vectors = np.linalg.eigh(covariance)
    upper = np.linalg.qr((vectors * np.sqrt(np.maximum(values, 0.0))).T)[1]
    return np.ascontiguousarray(upper.T)


def _named_like(recordings: Sequence[Recording], pattern: str) -> list[Recording]:
    """Recordings whose id matches."""
    found = [recording for recording in recordings if fnmatchcase(recording.id, pattern)]
    if not found:
        known = ", ".join(sorted({recording.id for recording in recordings}))
        raise ConfigurationError(
            f"training.curves_from '{pattern}' matches no training recording ({known})"
        )
    return found


def _require_covariance(name: str, values: FloatArray) -> None:
    """Raise `DataError` for a loaded matrix that is no covariance: not symmetric, not positive semidefinite, or beyond any bound."""
    largest = float(np.abs(values).max())
    if not largest <= LARGEST_SETTING:
        raise DataError(
            f"'{name}' must hold numbers of at most {LARGEST_SETTING:g}, not {largest:g}"
        )
    if not np.allclose(values, values.T, rtol=0.0, atol=ROUNDING * largest):
        raise DataError(f"'{name}' is no covariance: it is not symmetric")
    lowest = float(np.linalg.eigvalsh(values)[0])
    if lowest < -ROUNDING * largest:
        raise DataError(f"'{name}' is no covariance: it has the eigenvalue {lowest:g}")


def _covariances_of_logarithms(
    motion: AxleMotion, kind: Literal["linear", "rational"], fit: TyreFit
) -> list[FloatArray]:
    """Covariance of the logarithms of each axle's parameters, least squares' own and what they cannot see: the scale of all forces, and an
    offset of all slip angles, whose effect is that of a fit to shifted ones."""
    shifted = fit_motion(motion._replace(slip=motion.slip + SLIP_OFFSET), kind)
    found = []
    for own, other, covariance in zip(
        (fit.front, fit.rear), (shifted.front, shifted.rear), fit.covariance, strict=True
    ):
        effect = np.log(other / own)
        scale = np.eye(len(own))[-1] * FORCE_SCALE
        found.append(
            covariance / np.outer(own, own) + np.outer(effect, effect) + np.outer(scale, scale)
        )
    return found


def _reference(recording: Recording) -> FloatArray:
    """Reference sideslip [rad], (T,)."""
    if "sideslip_ref" not in recording and "vy_ref" not in recording:
        raise DataError(
            f"recording '{recording.id}' has neither sideslip_ref nor vy_ref to tune noise levels on; set training.method=data"
        )
    return (
        recording["sideslip_ref"]
        if "sideslip_ref" in recording
        else np.arctan2(recording["vy_ref"], recording["vx"])
    )


def _empty(
    steps: int, n: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Room for everything in `FilteredStates` but the last state."""
    pairs = (np.empty((steps, 2, 2)), np.empty((steps, 2)), np.empty((steps, 2, 2)))
    return (np.empty((steps, n)), np.empty((steps, n)), *pairs, np.empty((steps, 2), np.bool_))


ESTIMATOR = RationalFilter
