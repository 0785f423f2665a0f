"""Estimates of a fitted model on recordings, under the contract that holds online.

recording -> channels of the model at its rate -> `GuardedRun` -> estimate with bands and health
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context

import numpy as np

from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.resampling import resampled
from vehest.estimators.base import Estimator
from vehest.trust.contract import GuardedRun
from vehest.trust.record import Trust, is_other_vehicle


def estimate_recording(
    model: Estimator,
    recording: Recording,
    trust: Trust | None = None,
    same_vehicle: bool | None = None,
) -> Estimate:
    """Bring a recording to the model's rate and run the model on it, guarded as online.

    See `vehest.trust.contract`; raises `DataError`.

    Parameters
    ----------
    model : Estimator
        Fitted.
    recording : Recording
        With the model's channels, at any rate.
    trust : Trust or None
        Calibration of the model; None: limits of any car, no bands.
    same_vehicle : bool or None
        Whether the recording is of a calibrated car; None: by its vehicle and car, see
        `is_other_vehicle`.

    Returns
    -------
    Estimate
        At the model's rate, with bands and health where they are calibrated.
    """
    prepared = prepared_recording(model, recording)
    elsewhere = is_other_vehicle(trust, recording.vehicle, same_vehicle, recording.car)
    run = GuardedRun(model, trust, elsewhere=elsewhere)
    return require_estimate(model, recording, run(prepared.channels, prepared))


def estimate_parts(run: GuardedRun, parts: Iterable[Recording]) -> Iterator[Estimate]:
    """Estimate parts, each in a thread while the next one is read, checked and resampled.

    Parameters
    ----------
    run : GuardedRun
        Whose state passes from part to part; a single thread keeps their order.
    parts : iterable of Recording
        Parts of one recording that follow one another, at the model's rate; at least one.
    """
    with ThreadPoolExecutor(1) as thread:
        going: list[Future[Estimate]] = []
        for part in parts:
            going.append(thread.submit(copy_context().run, run, part.channels, part))
            if len(going) > 1:
                yield going.pop(0).result()
        yield going.pop().result()


def prepared_recording(
    model: Estimator, recording: Recording, rate_hz: float | None = None
) -> Recording:
    """The channels that a model reads, at its rate or another one [Hz].

    Raises as `estimate_recording` does.

    Resampling and transforms are those of the model's training data (``model.preparation``).
    """
    return resampled(
        recording.select(model.channels), rate_hz or model.settings.rate_hz, model.preparation
    )


def require_estimate(model: Estimator, recording: Recording, estimate: Estimate) -> Estimate:
    """The estimate; raises `DataError` where it is empty, since the recording is too short."""
    if np.isnan(estimate["vy"]).all():
        raise too_short_error(model, recording.id, recording.duration)
    return estimate


def too_short_error(model: Estimator, recording_id: str, seconds: float) -> DataError:
    """The error of a recording on which a model has no estimate."""
    return DataError(
        f"recording '{recording_id}' lasts {seconds:.3g} s, too short for '{model.name}' to "
        "estimate anything"
    )
