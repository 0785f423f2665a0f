"""Calibrates a fitted estimator.

Bands, limits of samples and health, from its training and validation ranges.

ranges -> estimates through whole ranges from a start of their own, as on a new drive -> `Trust`
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vehest.data.car import UNKNOWN_CAR
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.estimators.base import Estimator
from vehest.trust.bands import Piece, band_inputs, calibrated, tyre_error_of
from vehest.trust.guard import learn_limits
from vehest.trust.health import learn_health
from vehest.trust.record import About, Trust
from vehest.trust.tyre_check import tyre_check_of

SKIP_SECONDS = 1.5  # s at the start of each range that are not scored, as in evaluations


@dataclass(frozen=True, eq=False)
class CalibrationRange:
    """A range of a recording that calibrates a model, with the part of the recording before it."""

    # recording at the model's rate, with references, and with a warm-up before the range where it
    # has one
    recording: Recording
    start: float  # time at which the range starts [s]
    dataset: str  # data set of the recording; may be empty
    name: str  # name of the range in trust.yaml and in messages

    @property
    def range(self) -> Recording:
        """The recording without its warm-up."""
        return self.recording.cut(self.start, self.recording.end_time)


def learn_trust(
    estimator: Estimator,
    train: Sequence[CalibrationRange],
    validation: Sequence[CalibrationRange],
    variant: str = "",
) -> Trust:
    """Calibrate bands, limits of plausible samples and health of a fitted estimator.

    Training ranges give scales, limits and relations between channels; validation ranges give
    factors of bands and, together with the others, thresholds of health.

    What cannot be learnt is None, and the reason is a note in `About`: a missing reference does not
    prevent limits and health.

    Parameters
    ----------
    estimator : Estimator
        Fitted.
    train, validation : sequence of CalibrationRange
        Ranges at the estimator's rate.
    variant : str
        The paper's name of the configuration, for people.
    """
    bands = None
    guard = None
    health = None
    notes = []
    cars = dict.fromkeys(stretch.recording.car for stretch in validation)
    cars.pop(UNKNOWN_CAR, None)
    try:
        bands = calibrated(
            pieces_of(estimator, train),
            pieces_of(estimator, validation),
            tuple(estimator.channels),
            vehicles=tuple(dict.fromkeys(stretch.recording.vehicle for stretch in validation)),
            datasets=tuple(dict.fromkeys(filter(None, (part.dataset for part in validation)))),
            scaled_on=tuple(stretch.name for stretch in train),
            calibrated_on=tuple(stretch.name for stretch in validation),
            horizon_steps=estimator.horizon_steps,
            tyre_check=tyre_check_of(estimator),
            cars=tuple(cars),
        )
    except DataError as error:  # such as a missing reference, which does not prevent an evaluation
        notes.append(str(error))
    try:
        if not train:
            raise DataError("there is no training range to learn limits and health from")
        guard = learn_limits(
            [stretch.range for stretch in train], estimator.channels, estimator.settings.rate_hz
        )
        learnt, stopped = (
            [stretch.range.without_references() for stretch in part] for part in (train, validation)
        )
        health = learn_health(learnt, stopped, estimator.channels, estimator.settings.rate_hz)
    except DataError as error:
        notes.append(str(error))
    return Trust(About(estimator.name, variant, "; ".join(notes)), bands, guard, health)


def pieces_of(estimator: Estimator, stretches: Sequence[CalibrationRange]) -> list[Piece]:
    """Estimate ranges with a model, and return inputs, estimates and errors for `calibrated`.

    Raises `DataError` where a recording lacks a channel.

    Errors are v̂ - v [m/s] and β̂ - β, wrapped to ±π [rad], against ``vy_ref`` and atan2(vy_ref,
    vx). The first `SKIP_SECONDS` of each range do not count; a warm-up before the range does not
    either.
    """
    pieces: list[Piece] = []
    check = tyre_check_of(estimator)
    estimates = estimator.estimate(
        [stretch.recording.without_references() for stretch in stretches]
    )
    for stretch, estimate in zip(stretches, estimates, strict=True):
        recording = stretch.recording
        rows, vy, variance = band_inputs(
            estimate, recording, tuple(estimator.channels), estimator.horizon_steps
        )
        tyre_error = tyre_error_of(check, estimate)
        scored = slice(*recording.index_range(stretch.start + SKIP_SECONDS, recording.end_time))
        turned = estimate["sideslip"] - np.arctan2(recording["vy_ref"], recording["vx"])
        errors = np.stack(
            [vy - recording["vy_ref"], np.remainder(turned + np.pi, 2.0 * np.pi) - np.pi], axis=1
        )
        yaw_rate = recording["yaw_rate"][scored] if "yaw_rate" in recording else None
        pieces.append(
            Piece(
                rows[scored],
                vy[scored],
                variance[scored],
                errors[scored],
                yaw_rate,
                recording.rate_hz,
                tyre_error[scored],
            )
        )
    return pieces
