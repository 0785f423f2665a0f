"""Estimators by a `CarFilter`: recordings and single samples as the filter takes them.

recording --drive--> `Drive` of a training
recordings of one length --_filter--> states, covariances --> estimates
one sample --filter_step--> `FilterStep` --`UnscentedStepper`--> state
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vehest.constants import FloatArray
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.base import require_learnable
from vehest.estimators.filtering.car_filter import CarFilter
from vehest.estimators.filtering.sigma_point_stepper import (
    FilterStep,
    SigmaPointEstimator,
    normalised_innovations,
)
from vehest.estimators.network import Network
from vehest.filters.gaussian import Gaussian
from vehest.filters.unscented_scan import UnscentedStepper
from vehest.training.through_filter import Drive
from vehest.vehicle.dynamics import STATES

REFERENCES = ("vx_ref", "vy_ref", "yaw_rate_ref")  # channels of the true states in training
MEASURED = ("ax", "ay", "yaw_rate", "motor_speed")  # channels of the filter's measurements
INPUTS = ("steer", "motor_current")  # channels of the filter's inputs
# m/s, m/s, rad/s, m/s: standard deviations of vx, vy, yaw rate and rim speed at a start that is not
# given
UNKNOWN = (0.5, 0.3, 0.1, 0.1)


class CarFilterEstimator(Network, SigmaPointEstimator):
    """An estimator by an unscented filter of a planar car; a subclass has the settings and the fit.

    Measured are ax, ay, yaw rate and the motor's speed; steering angle and motor current are
    inputs. Samples that are missing are skipped, inputs that are missing are held.
    """

    channels = ("vx", *MEASURED, *INPUTS)
    skippable = channels
    refuses = ("infinite",)
    learns_from = REFERENCES
    states = STATES
    adapts = True  # friction is a state
    network: CarFilter  # filter with its learnt dynamics and noise
    car: Any  # parameters of the car
    friction: float  # friction at the start [1]

    @property
    def filter(self) -> CarFilter:
        """The trained module: the filter whose dynamics and noise are learnt."""
        return self.network

    def _samples(self, recording: Recording) -> tuple[FloatArray, FloatArray]:
        """Measurements (T, 4), with the motor's speed as rim speed [m/s] last, and inputs (T, 2),
        held where missing.
        """
        measurements = recording.stack(MEASURED)
        measurements[:, 3] *= self.car.wheel_radius
        return measurements, _hold_missing(recording.stack(INPUTS))

    def _start(
        self, measurement: FloatArray, state: Mapping[str, float] | None
    ) -> tuple[Tensor, Tensor]:
        """Mean and covariance at the first sample, by ``state`` where it is not None.

        Parameters
        ----------
        measurement : array
            The first one, (4,); rim speed and yaw rate start from it, 0 where they are NaN.
        state : mapping or None
            Known states; their variance is that of `CarFilter.initial_covariance` alone.

        Returns
        -------
        tuple
            Mean (5,) and covariance (5, 5) in the filter's precision.
        """
        dtype = next(self.filter.parameters()).dtype
        initial_state = dict(state or {})
        settings = self.settings
        rim, yaw_rate = (
            0.0 if math.isnan(value) else float(value) for value in (measurement[3], measurement[2])
        )
        values = {
            "vx": max(rim, settings.least_speed),
            "vy": 0.0,
            "yaw_rate": yaw_rate,
            "rim_speed": rim,
        }
        friction = settings.friction if settings.start_friction is None else settings.start_friction
        mean = [initial_state.get(name, values[name]) for name in STATES[:-1]] + [friction]
        extra = [
            0.0 if name in initial_state or (name == "rim_speed" and initial_state) else d**2
            for name, d in zip(STATES[:-1], UNKNOWN, strict=True)
        ]
        with torch.no_grad():
            covariance = (
                self.filter.initial_covariance().to(dtype)
                + torch.tensor([*extra, 0.0], dtype=dtype).diag()
            )
        return torch.tensor(mean, dtype=dtype), covariance

    def _estimate_all(
        self, recordings: Sequence[Recording], states: Sequence[Mapping[str, float] | None]
    ) -> list[Estimate]:
        """Estimate checked recordings; those of one length are filtered as one batch."""
        estimates: dict[int, Estimate] = {}
        for length in dict.fromkeys(len(recording) for recording in recordings):
            rows = [row for row, recording in enumerate(recordings) if len(recording) == length]
            together = self._filter(
                [recordings[row] for row in rows], [states[row] for row in rows]
            )
            estimates |= dict(zip(rows, together, strict=True))
        return [estimates[row] for row in range(len(recordings))]

    def _filter(
        self, recordings: Sequence[Recording], states: Sequence[Mapping[str, float] | None]
    ) -> list[Estimate]:
        """Estimates of recordings of one length, as one batch; the measured vx, where there is one,
        turns vy into the sideslip angle.
        """
        dtype = next(self.filter.parameters()).dtype
        samples = [self._samples(recording) for recording in recordings]
        measurements, inputs = (
            torch.as_tensor(np.stack(part), dtype=dtype) for part in zip(*samples, strict=True)
        )
        starts = [
            self._start(measured[0], state)
            for (measured, _), state in zip(samples, states, strict=True)
        ]
        initial = Gaussian(
            torch.stack([mean for mean, _ in starts]),
            torch.stack([covariance for _, covariance in starts]),
        )
        with torch.no_grad():
            steps = self.filter.filtered(
                measurements, inputs, initial, gate=self.gate_in_use()
            ).steps
            nis, dof = normalised_innovations(steps)
        mean = steps.filtered.mean.double().numpy()
        covariance = steps.filtered.covariance.double().numpy()
        estimates = []
        for row, recording in enumerate(recordings):
            quantities = {name: mean[row, :, k].copy() for k, name in enumerate(STATES)}
            quantities["nis"] = nis[row]
            quantities["nis_dof"] = dof[row]
            measured = recording["vx"]
            vx = np.where(np.isnan(measured), quantities["vx"], measured)
            filled = replace(recording, channels={**recording.channels, "vx": vx})
            estimates.append(
                self._wrapped(filled, quantities.pop("vy"), covariance[row], STATES, **quantities)
            )
        return estimates

    def drive(self, recording: Recording, dtype: torch.dtype) -> Drive:
        """A recording as the `Drive` that trains the filter: true states (T, 5), with the friction
        of the settings, inputs (T, 2) and measurements (T, 4).

        Raises
        ------
        DataError
            A reference, an input or the motor's speed is missing or has gaps.
        """
        require_learnable([recording], (*REFERENCES, "motor_speed", *INPUTS), self.name)
        measurements, inputs = self._samples(recording)
        states = [recording[name] for name in REFERENCES] + [
            measurements[:, 3],
            np.full(len(recording), self.friction),
        ]
        return Drive(
            *(
                torch.as_tensor(part, dtype=dtype)
                for part in (np.stack(states, 1), inputs, measurements)
            )
        )

    def new_filter(self, first: FilterStep) -> UnscentedStepper:
        """The stepwise filter in the state that the first measurement gives."""
        network = self.network
        mean, covariance = (part.numpy() for part in self._start(first.measurement, None))
        with torch.no_grad():
            return UnscentedStepper(
                network.point_model(),
                mean,
                covariance,
                len(MEASURED),
                network.rule,
                repair=network.repair,
                gate=self.gate_in_use(),
            )

    def filter_step(self, sample: FloatArray, memory: dict[str, Any]) -> FilterStep:
        """Measurements and inputs of one sample for the filter: NaN measurements are skipped,
        inputs that are NaN are held in ``memory``.
        """
        if not memory:
            memory |= {"inputs": np.zeros(2), "noises": self.network.noise_at()}
        measurement = sample[1:5].copy()
        measurement[3] *= self.car.wheel_radius
        memory["inputs"] = np.where(np.isnan(sample[5:]), memory["inputs"], sample[5:])
        return FilterStep(measurement, memory["inputs"], *memory["noises"])


def _hold_missing(values: FloatArray) -> FloatArray:
    """A copy of (T, p) in which the last finite value of the column replaces NaN, 0 before the
    first.
    """
    last = np.maximum.accumulate(
        np.where(np.isnan(values), 0, np.arange(1, len(values) + 1)[:, None])
    )
    return np.take_along_axis(np.concatenate([np.zeros_like(values[:1]), values]), last, axis=0)
