"""The unscented filter of a single track on Dugoff's tyres, on recordings and samples.

    recordings --split_samples--> measurements (T, 4), inputs (T, 3)
    --`TrackFilter`--> states --> estimates
    one sample --filter_step--> `FilterStep` --`UnscentedStepper`--> state

Measured are a_y, r and, where tyre forces are measured, those of both axles; forward speed,
steering angle and longitudinal acceleration are inputs. The forces' noise is smaller where the car
behaves non-linearly, by a hysteresis on |a_y|. A network behind the sensors may add a sideslip
angle (`PseudoMeasurement`).

Source: Bertipaglia et al. 2024, Sections III-B and IV-C.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.filtering.sigma_point_stepper import (
    FilterStep,
    SigmaPointEstimator,
    normalised_innovations,
)
from vehest.estimators.filtering.track_filter import (
    ROLLING,
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
from vehest.filters.unscented_scan import UnscentedStepper
from vehest.training.robust import robust_squares_of_array
from vehest.vehicle.dugoff import TRACK_STATES, DugoffAxle, DugoffTrack, LoadedCar

Inputs = Literal["full", "imu"]  # channels that are read: with or without measured tyre forces
Curve = Literal["plain", "smooth"]  # Dugoff's tyres by Eq. 9 or Eq. 10

WHEEL_FORCES = {"fy_front": ("fy_fl", "fy_fr"), "fy_rear": ("fy_rl", "fy_rr")}
"""Lateral force of an axle -> channels of its wheels."""
INERTIAL = ("yaw_rate", "vx", "ay", "steer", "ax")  # channels without tyre forces
CHANNELS: dict[str, tuple[str, ...]] = {
    "full": (*INERTIAL, *(wheel for pair in WHEEL_FORCES.values() for wheel in pair)),
    "imu": INERTIAL,
}
"""Setting ``inputs`` -> channels that the filter reads."""
MAX_SAMPLES_TOGETHER = 200_000  # samples that are filtered at a time


@dataclass(frozen=True, eq=False)
class PseudoMeasurement:
    """Sideslip angles that a network adds to T samples."""

    sideslip: FloatArray  # β_DD, (T,) [rad]
    variance: FloatArray  # variance of the angle as the filter's measurement, (T,) [rad²]
    # variances of a step of lateral velocity and yaw rate, (T, 2) [m²/s², rad²/s²]; none: the
    # filter's
    process: FloatArray | None = None


class DugoffFilter(SigmaPointEstimator):
    """An estimator by an unscented filter over `DugoffTrack`.

    A subclass has the settings and the fit.

    Attributes
    ----------
    axle_tyres : array, shape (6,)
        Cornering stiffness [N/rad], friction [1] and reduction [s/m] of the front, then of the rear
        axle.
    levels : dict
        Standard deviations by name: ``process_vy`` [m/s] and ``process_yaw_rate`` [rad/s] of a
        step, those of the sensors, and ``force_factor``.
    """

    channels: tuple[str, ...]  # type: ignore[misc]  # depends on the settings
    states: ClassVar[tuple[str, ...]] = TRACK_STATES
    covariance_of = TRACK_STATES
    axle_tyres: FloatArray
    levels: dict[str, float]
    inputs: Inputs  # channels that are read
    curve: Curve  # Dugoff's tyres by Eq. 9 or Eq. 10
    minimum_speed: float  # speed below which wheels roll without slip [m/s]
    # lateral acceleration from which on forces are trusted, see `in_nonlinear_range` [m/s²]
    nonlinear_from: float
    linear_below: float  # lateral acceleration below which they are not trusted any more [m/s²]
    # number of samples over which errors are correlated, by which variances of measurements are
    # multiplied
    correlated_samples: float
    car: LoadedCar  # parameters of the car

    def require_fitted(self) -> None:
        """Check that tyres and noise levels have values.

        Raises
        ------
        ConfigurationError
            Tyres or levels are neither given in the settings nor fitted.
        """
        self.track()
        self.noise_covariances(self.levels)

    def track(self) -> DugoffTrack:
        """The car model with the present tyres.

        Raises `ConfigurationError` where the tyres are neither given nor identified.
        """
        if np.isnan(self.axle_tyres).any():
            raise ConfigurationError(
                f"estimator '{self.name}' has no tyres yet; fit or load it first, or give "
                "estimator.tyres"
            )
        s = self.settings
        front, rear = (
            DugoffAxle(*self.axle_tyres[part].tolist()) for part in (slice(0, 3), slice(3, 6))
        )
        return DugoffTrack(s.car, front, rear, 1.0 / s.rate_hz, s.curve, s.minimum_speed)

    def noise_covariances(self, levels: Mapping[str, float]) -> tuple[Tensor, Tensor]:
        """Covariance of the process noise of a step, (2, 2), and covariances of the measurements,
        (2, 4, 4), first in the linear, then in the non-linear range.

        Raises
        ------
        ConfigurationError
            A level is neither given nor found.
        """
        if any(math.isnan(level) for level in levels.values()):
            raise ConfigurationError(
                f"estimator '{self.name}' has no noise levels yet; fit or load it first, or give "
                "estimator.noise"
            )
        process = (
            torch.tensor([levels["process_vy"], levels["process_yaw_rate"]], dtype=torch.float64)
            .square()
            .diag()
        )
        factor = levels.get("force_factor", 1.0)
        rows = [
            [
                levels["ay"],
                levels["yaw_rate"],
                *(force_factor * levels.get(name, 1.0) for name in WHEEL_FORCES),
            ]
            for force_factor in (factor, 1.0)
        ]
        variances = torch.tensor(rows, dtype=torch.float64).square() * self.correlated_samples
        return process, torch.diag_embed(variances)

    def split_samples(self, samples: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Measurements (T, 4) and inputs (T, 3) of samples (T, n) of ``channels``.

        Forces that are not measured are NaN.
        """
        yaw_rate, vx, ay, steer, ax = samples.T[: len(INERTIAL)]
        wheels = samples[:, len(INERTIAL) : len(CHANNELS[self.inputs])]
        forces = (
            [wheels[:, 0] + wheels[:, 1], wheels[:, 2] + wheels[:, 3]]
            if wheels.shape[1]
            else [np.full(len(samples), np.nan)] * 2
        )
        return np.stack([ay, yaw_rate, *forces], 1), np.stack([vx, steer, ax], 1)

    def trusts_forces(self, ay: FloatArray, before: bool = False) -> NDArray[np.bool_]:
        """Whether forces are trusted, (T,), by the measured lateral acceleration (T,) [m/s²].

        See `in_nonlinear_range`.
        """
        return in_nonlinear_range(ay, self.nonlinear_from, self.linear_below, before)

    def mean_squared_error(
        self,
        recordings: Sequence[Recording],
        skip_seconds: float = 0.0,
        levels: Mapping[str, float] | None = None,
        over: Over = "samples",
        pseudo: Sequence[PseudoMeasurement] | None = None,
        limit: float = 0.0,
    ) -> float:
        """Mean squared error of sideslip [rad²] over samples fast enough for the model.

        See `error_over`, and `robust_squares` for the limit [deg].
        """
        skip = round(skip_seconds * self.rate_hz)
        sums: list[tuple[float, int]] = []
        for rows, steps in self.filtered(recordings, levels=levels, pseudo=pseudo):
            for row, states in zip(rows, steps.filtered.mean.numpy(), strict=True):
                vx = recordings[row]["vx"]
                reference = reference_sideslip(recordings[row])
                error = np.arctan2(states[: len(vx), 0], vx) - reference
                is_counted = (vx >= self.minimum_speed) & np.isfinite(reference)
                is_counted[:skip] = False
                squares = robust_squares_of_array(error[is_counted], math.radians(limit))
                sums.append((float(squares.sum()), int(is_counted.sum())))
        return error_over(sums, over)

    def _estimate_all(
        self, recordings: Sequence[Recording], states: Sequence[Mapping[str, float] | None]
    ) -> list[Estimate]:
        """Estimate checked recordings; those of similar length are filtered together."""
        estimates: dict[int, Estimate] = {}
        for rows, steps in self.filtered(
            recordings, states, gate=self.gate_in_use(), pseudo=self.pseudo_measurements(recordings)
        ):
            mean, covariance = (part.numpy() for part in steps.filtered)
            nis, dof = normalised_innovations(steps)
            for place, row in enumerate(rows):
                n = len(recordings[row])
                quantities = {
                    "yaw_rate": mean[place, :n, 1].copy(),
                    "nis": nis[place, :n].copy(),
                    "nis_dof": dof[place, :n].copy(),
                }
                estimates[row] = self._wrapped(
                    recordings[row],
                    mean[place, :n, 0].copy(),
                    covariance[place, :n].copy(),
                    TRACK_STATES,
                    **quantities,
                )
        return [estimates[row] for row in range(len(recordings))]

    def pseudo_measurements(
        self, recordings: Sequence[Recording]
    ) -> list[PseudoMeasurement] | None:
        """Sideslip angles that a network adds to each recording; None without a network."""
        return None

    def filtered(
        self,
        recordings: Sequence[Recording],
        states: Sequence[Mapping[str, float] | None] | None = None,
        levels: Mapping[str, float] | None = None,
        gate: Gate | None = None,
        pseudo: Sequence[PseudoMeasurement] | None = None,
    ) -> Iterator[tuple[list[int], Filtered[Tensor]]]:
        """Filter recordings in groups of similar length, padded to the longest of each.

        Yields the indices of each group's recordings, and their filtered states. Levels are
        searched, and networks trained, without a gate: noise that is too small would close it.
        """
        model = TrackFilter(self.track())
        process, sensors = self.noise_covariances(self.levels if levels is None else levels)
        for rows in groups_of([len(recording) for recording in recordings], MAX_SAMPLES_TOGETHER):
            parts = [self.split_samples(recordings[row].stack(self.channels)) for row in rows]
            measurements = torch.as_tensor(padded([part[0] for part in parts], np.nan))
            inputs = torch.as_tensor(padded([part[1] for part in parts], None))
            is_trusted = [self.trusts_forces(ay) for ay in measurements[..., 0].numpy()]
            noise = sensors[torch.as_tensor(np.stack(is_trusted)).long()]
            step_noise = process
            if pseudo is not None:
                angles = [pseudo[row] for row in rows]
                measurements, noise = with_angles(measurements, noise, angles)
                step_variances = [angle.process for angle in angles if angle.process is not None]
                if step_variances:
                    step_noise = torch.diag_embed(torch.as_tensor(padded(step_variances, None)))
            initial_states = None if states is None else [states[row] for row in rows]
            with torch.no_grad():
                initial = model.start(inputs[:, 0], initial_states)
                passed = model.filtered(measurements, inputs, step_noise, noise, initial, gate)
                yield rows, passed.steps

    def new_filter(self, first: FilterStep) -> UnscentedStepper:
        """The stepwise filter before its first sample: straight ahead with wide deviations, or
        rolling without slip below the minimum speed.
        """
        track_filter = TrackFilter(self.track())
        mean, covariance = (
            part[0].numpy() for part in track_filter.start(torch.as_tensor(first.inputs)[None])
        )
        return UnscentedStepper(
            track_filter.model,
            mean,
            covariance,
            len(first.measurement),
            track_filter.rule,
            gate=self.gate_in_use(),
        )

    def filter_step(self, sample: FloatArray, memory: dict[str, Any]) -> FilterStep:
        """Measurements of one sample for the filter, none below the minimum speed, and their noise
        in the present, linear or non-linear, range.
        """
        if not memory:
            process, sensors = (noise.numpy() for noise in self.noise_covariances(self.levels))
            memory |= {"process": process, "noise": process, "sensors": sensors, "trusts": False}
        measurements, inputs = (part[0] for part in self.split_samples(sample[None]))
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
        """Append the measurement of a network, if there is one, to the sensors' measurement (m,)
        and its covariance; the network's process noise is stored in ``memory``.
        """
        return measurement, noise


def with_angles(
    measurements: Tensor, noise: Tensor, angles: Sequence[PseudoMeasurement]
) -> tuple[Tensor, Tensor]:
    """Append a network's angles to measurements as the fifth: measurements (B, T, 5) and
    covariances (B, T, 5, 5).

    The fifth measurement is NaN beyond the end of a shorter recording.

    Parameters
    ----------
    measurements : Tensor
        Of the sensors, (B, T, 4).
    noise : Tensor
        Their covariances, diagonal, (B, T, 4, 4).
    angles : sequence of PseudoMeasurement
        One a recording, of at most T samples.
    """
    sideslip = torch.as_tensor(padded([angle.sideslip[:, None] for angle in angles], np.nan))
    variance = torch.as_tensor(padded([angle.variance[:, None] for angle in angles], None))
    return torch.cat([measurements, sideslip], -1), with_variance(noise, variance[..., 0])


def with_variance(sensors: Tensor, variance: Tensor) -> Tensor:
    """Covariances of sensors and of a network's angle, (..., 5, 5).

    They are differentiable in the variance of the angle.

    Parameters
    ----------
    sensors : Tensor
        Of the four measured numbers, diagonal, (..., 4, 4).
    variance : Tensor
        Of the network's angle (...) [rad²].
    """
    return torch.diag_embed(
        torch.cat([sensors.diagonal(dim1=-2, dim2=-1), variance.unsqueeze(-1)], -1)
    )
