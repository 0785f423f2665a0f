"""Filters of a single track on rational tyres.

Model, limits and start of a filter, and both filters.

    samples (T, 4) of yaw_rate, vx, ay, steer
    --filter_extended, filter_unscented--> `FilteredStates`

State x = (β, r, β', r', θ), (n,): sideslip angle [rad], yaw rate [rad/s], their rates, and
logarithms of adapted tyre parameters over their start values. Measured are r and a_y; speed and
steering angle are inputs. The equations of motion are in `vehest.vehicle.tyre_track`.

Below the minimum speed wheels roll without slip. Where |β| exceeds a limit the filter has diverged,
and motion and tyre parameters restart. Below a lateral acceleration |u r| tyre parameters stay.

Source: Di Biase, Lenzo & Timpone, IEEE Access 8, 2020, Eqs. 11 to 60. Friction as a state and the
unscented filter are not in the paper.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.estimators.filtering.sideslip_filter import FilteredStates
from vehest.estimators.kernels.rational_ekf import roll_without_slip, scan
from vehest.filters.gating import Gate
from vehest.filters.gaussian import Gaussian
from vehest.filters.sigma_points import symmetric_rule
from vehest.filters.unscented_scan import TorchModel, UnscentedStepper
from vehest.vehicle.parameters import SingleTrackParameters
from vehest.vehicle.tyre_track import MOTION, TYRE_PARAMETERS, TyreTrack

Tyres = Literal["linear", "rational", "rational_adaptive", "rational_friction"]  # keys of `KINDS`

LEVELS = ("yaw_rate", "ay", "steer", "tyres")
"""Noise levels: of the gyroscope [rad/s], the accelerometer [m/s²], the steering angle [rad/√s],
and the drift of tyre parameters [1/√s].
"""
CURVES = TYRE_PARAMETERS[:4]
"""Parameters of the axle curves: c₁ [rad²] and c₂ [N/rad] of the front, then of the rear axle."""

# Standard deviations of β [rad], r [rad/s], β' [rad/s] and r' [rad/s²] of a motion that is only
# assumed.
ROLLING = (0.05, 0.2, 1.0, 2.0)
# Largest absolute values of β [rad], r [rad/s], β' [rad/s] and r' [rad/s²].
MAX_MOTION = (1.5, 5.0, 20.0, 100.0)
MAX_SIDESLIP_DEVIATION = 1.0  # standard deviation of β [rad] beyond which the motion restarts
# Standard deviations at the start by which tyre parameters may always differ from their start
# values.
MIN_TYRE_BOUND = 3.0
FRICTION_DEVIATION = 0.1  # standard deviation of the logarithm of friction at the start


class TyreKind(NamedTuple):
    """A kind of tyre model: its curves, and which of its parameters are states."""

    variant: str  # part of a variant's name
    title: str  # the paper's name
    curve_names: tuple[str, ...]  # parameters of its axle curves, of `CURVES`
    adapted: tuple[str, ...]  # tyre parameters that are states, of `TYRE_PARAMETERS`

    @property
    def level_names(self) -> tuple[str, ...]:
        """Noise levels that a filter needs, of `LEVELS`."""
        return LEVELS if self.adapted else LEVELS[:3]


STIFFNESSES = ("c2_front", "c2_rear")  # parameters of linear tyres
# setting ``tyres`` -> kind of tyres
KINDS: dict[str, TyreKind] = {
    "linear": TyreKind("lint", "LINT", STIFFNESSES, STIFFNESSES),
    "rational": TyreKind("ratt", "RATT", CURVES, ()),
    "rational_adaptive": TyreKind("ratte", "RATTE", CURVES, CURVES),
    "rational_friction": TyreKind("ratmu", "RATT with friction", CURVES, ("friction",)),
}


@dataclass(frozen=True, eq=False)
class RationalModel:
    """A single track on rational tyres, with the limits and the start of its filter."""

    car: SingleTrackParameters  # parameters of the car; its cornering stiffnesses are not used
    curves: FloatArray  # axle curves at friction 1, (4,), in the order of `CURVES`; c₁ = ∞: linear
    curve_covariance: FloatArray  # covariance of the curves' logarithms at the start, (4, 4)
    adapted: tuple[str, ...]  # tyre parameters that are states
    step: float  # Δt [s]
    minimum_speed: float  # speed below which wheels roll without slip [m/s]
    adapt_above: float  # |u r| below which tyre parameters stay [m/s²]
    largest_sideslip: float  # |β| beyond which motion and tyres restart [rad]
    tyre_bound: float  # factor by which tyre parameters may differ from their start values

    @cached_property
    def nominal(self) -> FloatArray:
        """Tyre parameters at the start, (5,), in the order of `TYRE_PARAMETERS`; friction is 1."""
        return np.array([*self.curves, 1.0])

    @cached_property
    def start_tyre_covariance(self) -> FloatArray:
        """Covariance of the logarithms of adapted tyre parameters at the start, (n - 4, n - 4).

        The other four states are those of the motion.
        """
        if self.adapted == ("friction",):
            return np.array([[FRICTION_DEVIATION**2]])
        rows = [CURVES.index(name) for name in self.adapted]
        return np.ascontiguousarray(self.curve_covariance[np.ix_(rows, rows)])

    @cached_property
    def bounds(self) -> FloatArray:
        """Largest absolute value of each state, (n,)."""
        spread = MIN_TYRE_BOUND * np.sqrt(np.diagonal(self.start_tyre_covariance))
        return np.array([*MAX_MOTION, *np.maximum(spread, math.log(self.tyre_bound)).tolist()])

    def track(self) -> TyreTrack:
        """The equations of motion and measurement in torch."""
        adapted = tuple(TYRE_PARAMETERS.index(name) for name in self.adapted)
        return TyreTrack(  # type: ignore[arg-type]
            self.car, tuple(self.nominal.tolist()), adapted, self.step
        )

    def quantities(self, states: FloatArray) -> dict[str, FloatArray]:
        """Tyre parameters of states (T, n): name -> (T,).

        Cornering stiffnesses at the present friction [N/rad], c₁ [rad²] unless tyres are linear,
        and friction where it is a state.
        """
        parameters = {
            name: np.full(len(states), value)
            for name, value in zip(TYRE_PARAMETERS, self.nominal.tolist(), strict=True)
        }
        for column, name in enumerate(self.adapted, len(MOTION)):
            parameters[name] = parameters[name] * np.exp(states[:, column])
        values = {
            f"cornering_stiffness_{axle}": parameters[f"c2_{axle}"] * parameters["friction"]
            for axle in ("front", "rear")
        }
        if not np.isinf(self.curves[0]):
            values |= {f"tyre_c1_{axle}": parameters[f"c1_{axle}"] for axle in ("front", "rear")}
        if "friction" in self.adapted:
            values["friction"] = parameters["friction"]
        return values


def filter_extended(
    model: RationalModel,
    samples: FloatArray,
    levels: Mapping[str, float],
    first: Gaussian[FloatArray],
    gate: Gate | None = None,
    refused: NDArray[np.int64] | None = None,
    crossfall: float = 0.0,
) -> FilteredStates:
    """Filter samples by the compiled extended Kalman filter.

    Parameters
    ----------
    samples : array, shape (T, 4)
        Yaw rate, forward speed, lateral acceleration and steering angle; NaN in the first and third
        was not measured.
    levels : mapping
        Noise levels, `LEVELS`.
    first : Gaussian
        State at the first sample before its measurement, (n,), or (n + 1,) where the last state is
        the acceleration b = g sin φ of a crossfall [m/s²].
    gate : Gate, optional
        Which measurements are refused; none: all are used.
    refused : array, shape (2,), optional
        How often in a row yaw rate and ay were refused before; updated.
    crossfall : float
        Level of the drift of b [m/s² √s⁻¹].

    Returns
    -------
    FilteredStates
        (T, n); n counts the state of a crossfall where there is one. ``first`` is not changed.
    """
    mean = first.mean.copy()
    covariance = first.covariance.copy()
    n_crossfall = len(mean) - len(model.bounds)
    car = model.car
    track = (
        np.array([car.mass, car.yaw_inertia, car.cg_to_front_axle, car.cg_to_rear_axle]),
        model.nominal,
        np.array([TYRE_PARAMETERS.index(name) for name in model.adapted], dtype=np.int64),
        model.step,
        model.minimum_speed,
        model.adapt_above,
    )
    deviations = [
        levels["yaw_rate"],
        levels["ay"],
        levels["steer"],
        *[levels["tyres"]] * len(model.adapted),
        *[crossfall] * n_crossfall,
    ]
    restart = (model.largest_sideslip, MAX_SIDESLIP_DEVIATION**2, np.square(ROLLING))
    limit, patience = (math.inf, 0) if gate is None else (gate.deviations**2, gate.patience)
    states = _empty_states(len(samples), len(mean))
    scan(
        np.ascontiguousarray(samples),
        track,
        np.square(deviations),
        np.append(model.bounds, [math.inf] * n_crossfall),
        model.start_tyre_covariance,
        restart,
        (limit, patience, np.zeros(2, np.int64) if refused is None else refused),
        (mean, covariance),
        states,
    )
    return FilteredStates(*states, Gaussian(mean, covariance))


def filter_unscented(
    model: RationalModel,
    samples: FloatArray,
    levels: Mapping[str, float],
    first: Gaussian[FloatArray],
) -> FilteredStates:
    """Filter samples by the unscented Kalman filter (κ = 0).

    Arguments as those of `filter_extended`.

    Tyre parameters that stay keep their variance (Schmidt's consider states).

    It follows the same rules as the compiled extended filter: rolling below the minimum speed, a
    restart where the sideslip or its deviation is too large, bounds of all states, tyre parameters
    that stay below a lateral acceleration. It runs in Python, sample by sample, and has no gate.
    """
    car = model.car
    track = model.track()
    bounds = model.bounds
    # Points are drawn anew for each call, so that they may be clipped in place.
    limit = torch.as_tensor(bounds)
    point_model = TorchModel(
        lambda points, inputs: track.transition(points.clamp_(-limit, limit), inputs),
        lambda points, inputs: track.observation(points.clamp_(-limit, limit), inputs),
    )
    stepper = UnscentedStepper(point_model, *first, 2, symmetric_rule(len(bounds), 0.0))
    prior = stepper.prior
    mean, covariance = stepper.state
    mean[:] = first.mean
    covariance[:] = first.covariance
    sensors = np.square([[levels["yaw_rate"], levels["ay"]]])[..., None] * np.eye(2)
    geometry = np.array([car.mass, car.yaw_inertia, car.cg_to_front_axle, car.cg_to_rear_axle])
    rolling = np.square(ROLLING)
    states = _empty_states(len(samples), len(bounds))

    for k, (yaw_rate, vx, ay, steer) in enumerate(samples):
        if vx < model.minimum_speed:
            roll_without_slip.py_func(mean, covariance, rolling, geometry, vx, steer)
            innovation = np.zeros(2)
            spread = np.eye(2)
            measured = np.zeros(2, bool)
        else:
            if k:
                inputs = np.array([max(samples[k - 1, 1], model.minimum_speed), samples[k - 1, 3]])
                lateral = abs(inputs[0] * (mean[1] + track.step * mean[3]))
                noise = track.process_noise(
                    torch.as_tensor(mean[None]),
                    torch.as_tensor(inputs[None]),
                    levels["steer"],
                    levels["tyres"] * (lateral >= model.adapt_above),
                )
                stepper.predict(inputs, noise.numpy())
                prior.mean.clip(-bounds, bounds, out=prior.mean)
                has_diverged = not abs(prior.mean[0]) < model.largest_sideslip
                if has_diverged or not prior.covariance[0, 0] < MAX_SIDESLIP_DEVIATION**2:
                    roll_without_slip.py_func(*prior, rolling, geometry, vx, steer)
                if has_diverged:
                    prior.mean[4:] = 0.0
                    prior.covariance[4:, 4:] = model.start_tyre_covariance
            stepper.update(np.array([yaw_rate, ay]), np.array([vx, steer]), sensors)
            innovation = stepper.innovation
            spread = stepper.innovation_covariance
            measured = ~np.isnan([yaw_rate, ay])
            if abs(vx * prior.mean[1]) < model.adapt_above:
                gain = stepper.gain.copy()
                gain[4:] = 0.0
                cross = gain @ spread @ stepper.gain.T
                covariance[:] = prior.covariance - cross - cross.T + gain @ spread @ gain.T
                mean[:] = prior.mean + gain @ innovation
            mean.clip(-bounds, bounds, out=mean)
        deviation = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
        row = (mean, deviation, covariance[:2, :2], innovation, spread, measured)
        for target, values in zip(states, row, strict=True):
            target[k] = values
    return FilteredStates(*states, Gaussian(mean.copy(), covariance.copy()))


def _empty_states(
    steps: int, n: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Empty arrays for all fields of `FilteredStates` but ``last``, for T = ``steps`` samples and n
    states.
    """
    return (
        np.empty((steps, n)),
        np.empty((steps, n)),
        np.empty((steps, 2, 2)),
        np.empty((steps, 2)),
        np.empty((steps, 2, 2)),
        np.empty((steps, 2), np.bool_),
    )
