"""The Python interface: read recordings, train, score, save and load models, estimate, write.

>>> import vehest
>>> model = vehest.load_model("outputs/train/ksnn-linear_bias_p2-seed2-0123456789ab")
>>> recording = vehest.read_recording("lap.csv")
>>> estimate = vehest.estimate(model, recording)
>>> vehest.write_estimate(estimate, "estimate.parquet")
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

from vehest.data.car import UNKNOWN_CAR
from vehest.data.car import CarValues as CarValues
from vehest.data.estimate import Estimate as Estimate
from vehest.data.files import written_aside
from vehest.data.recording import Recording as Recording
from vehest.data.schema import settings_from_config
from vehest.data.splits import Span
from vehest.estimators.base import Estimator as Estimator
from vehest.estimators.base import FitData
from vehest.estimators.model_files import model_digest
from vehest.estimators.model_files import save_model as _save_model
from vehest.evaluation import metrics
from vehest.run.calibrate import Stretch, learn_trust
from vehest.run.car_record import ASSUMED, adapted, with_car_values
from vehest.run.config import compose_config
from vehest.run.downsample import resampled
from vehest.run.estimate import (
    PRETRAINED,
    estimate_recording,
    find_model,
    open_model,
    prepared_recording,
    read_table,
    require_estimate,
    write_estimate_table,
)
from vehest.run.train import new_estimator
from vehest.trust.contract import GuardedStepper
from vehest.trust.health import reason_in_words as reason_in_words
from vehest.trust.record import Trust, write_trust

_TRUST: WeakKeyDictionary[Estimator, Trust] = (
    WeakKeyDictionary()
)  # what was learnt with the estimators that were trained or loaded here


def load_model(model: str | Path = PRETRAINED, output: str | Path | None = None) -> Estimator:
    """Load a fitted estimator.

    Args:
        model: its folder, or the start of its name in the output root; by default the one that comes with vehest, which was trained on
            simulated cars and not on yours.
        output: the output root; by default VEHEST_OUTPUT, or ``outputs``.

    Raises:
        MissingError: there is no such model.
        DataError: its files are damaged.
    """
    root = Path(output or os.environ.get("VEHEST_OUTPUT", "outputs"))
    _, estimator, trust = open_model(str(model), root, partial(warnings.warn, stacklevel=4))
    if trust is not None:
        _TRUST[estimator] = trust
    return estimator


def train(
    estimator: str,
    train: Sequence[Recording],
    validation: Sequence[Recording],
    overrides: Sequence[str] = (),
    *,
    seed: int = 0,
) -> Estimator:
    """Fit an estimator to recordings, which are brought to its rate first.

    Args:
        estimator: its name, as in conf/estimator. A wheelbase of null among its settings is that of the recordings' car.
        train: recordings to learn from, with ``vy_ref``, at any rate from the estimator's upwards.
        validation: recordings that decide when to stop, of the same kind; may be the same objects where the method does not stop early.
        overrides: as of ``vehest train``, for example ``["estimator.n_local=3", "training.max_epochs=50"]``.
        seed: of all random numbers.

    Raises:
        ConfigurationError: an unknown name or setting.
        DataError: a channel is missing, or the recordings are too short or sampled too slowly.
    """
    config = compose_config("train", [f"estimator={estimator}", *overrides])
    config = with_car_values(config, [recording.car for recording in (*train, *validation)])
    model = new_estimator(config["estimator"])
    training = config["training"]
    if training.get("start_from") is not None:
        training["start_from"] = str(
            find_model(str(training["start_from"]), Path(config["output"]), warnings.warn)
        )
    settings: Any = settings_from_config(model.training_type, training, "training")
    model.preparation = {
        "method": config["downsample"]["method"],
        "transforms": list(config["downsample"]["transforms"] or []),
    }
    model.seed(seed)
    parts = [
        [resampled(recording, model.settings.rate_hz, model.preparation) for recording in part]
        for part in (train, validation)
    ]
    model.fit(FitData(*parts), settings)
    learnt, stopped = ([Stretch(own, own.start_time, "", own.id) for own in part] for part in parts)
    _TRUST[model] = learn_trust(model, learnt, stopped)
    return model


def score(model: Estimator, recordings: Sequence[Recording]) -> dict[str, float]:
    """Metrics of a model on whole recordings that have ``vy_ref``, over all of them together, on the grid and after the first seconds that
    conf/eval.yaml names. That the model has not learnt from them is for the caller to see to.

    Each recording's car is used as by `estimate`, and its wheelbase gives the speed from which sideslip counts.

    Returns:
        Metric -> value: ``rmse_vy`` [m/s], ``rmse_sideslip`` [deg], ``fvu`` and others, as docs/estimators.md defines them.

    Raises:
        DataError: a channel is missing or has gaps, or a recording is too short or sampled too slowly.
    """
    from vehest.run.evaluate import protocol_from_config

    evaluation = compose_config("eval")["evaluation"]
    protocol = protocol_from_config(
        {**evaluation, "warm_up_seconds": 0.0, "sequence_seconds": None, "initial_state": False}
    )
    parts = []
    for recording in recordings:
        of_car, _ = _for_car(model, recording.car)
        needed = prepared_recording(of_car, recording.without_references())
        own = require_estimate(of_car, recording, of_car.estimate([needed])[0])
        parts.append(
            metrics.score(
                own,
                resampled(recording, protocol.rate_hz, model.preparation),
                Span("", recording.id),
                protocol.with_wheelbases({"": recording.car.wheelbase}),
            )
        )
    return metrics.accuracy(parts)


def save_model(model: Estimator, folder: str | Path) -> None:
    """Write a fitted estimator into a new folder, for `load_model` and ``vehest estimate``.

    Raises:
        MissingError: it cannot be written, or a folder that is not empty is there already.
    """
    with written_aside(Path(folder)) as aside:
        aside.mkdir()
        _save_model(
            model,
            aside,
            {"n_parameters": model.n_parameters, "downsample": dict(model.preparation)},
        )
        if model in _TRUST:
            write_trust(_TRUST[model], aside, model_digest(aside))


def read_recording(
    path: str | Path, overrides: Sequence[str] = (), *, references: bool = False
) -> Recording:
    """Read a CSV or Parquet file as a recording.

    Args:
        path: the file.
        overrides: how to read it, for example ``["dataset=my_car"]``; by default columns carry the channels' names and SI units. The values
            ``car`` of the data set become `Recording.car`; without a data set give them as ``["dataset.car.wheelbase=2.9"]``.
        references: whether the reference channels that a data set declares have to be there; else they are left aside. Columns that carry
            the channels' names are read in any case.

    Raises:
        MissingError: there is no such file.
        DataError: it cannot be used as it is.
    """
    return read_table(Path(path), overrides, references=references)


def estimate(
    model: Estimator, recording: Recording, *, same_vehicle: bool | None = None
) -> Estimate:
    """Run a model on a recording, brought to the model's rate in the way it was trained with, under the contract that holds online.

    The values of ``recording.car`` are used as ``vehest estimate`` uses those of a data set: settings of the self-calibrating filter that
    its training did not choose, and whether the bands apply.

    Args:
        model: fitted.
        recording: as `read_recording` reads it.
        same_vehicle: whether it is of the car that bands were calibrated on; None: by the values and the names of the cars.

    Returns:
        ``vy`` [m/s] and ``sideslip`` [rad], each of shape (T,); NaN where the model's window is not full yet. ``health`` (0 valid,
        1 degraded, 2 invalid) and ``health_reason`` (`reason_in_words`); half widths of the 90 % band, ``band_vy`` and ``band_sideslip``,
        where the model was calibrated.

    Raises:
        DataError: a channel is missing, or the recording is sampled too slowly.
    """
    of_car, trust = _for_car(model, recording.car)
    return estimate_recording(of_car, recording, trust, same_vehicle)


def _for_car(model: Estimator, car: CarValues) -> tuple[Estimator, Trust | None]:
    """A model and its calibration for a car; warns where the model's wheelbase is an assumption."""
    of_car, trust, remarks = adapted(model, _TRUST.get(model), car, {})
    for remark in remarks:
        if ASSUMED in remark:
            warnings.warn(remark, stacklevel=3)
    return of_car, trust


def online(
    model: Estimator,
    bus_rate_hz: float | None = None,
    *,
    elsewhere: bool = False,
    car: CarValues = UNKNOWN_CAR,
) -> GuardedStepper:
    """A model that runs along with a drive: ``online(model).step({"vx": 21.3, …})`` a sample.

    Args:
        model: fitted, causal.
        bus_rate_hz: rate at which samples come, if it is above the model's: they then go through a causal anti-aliasing filter first.
        elsewhere: whether the car or its tyres are others than those that were calibrated on; bands are wider then. They are, too, where
            the values of ``car`` say so.
        car: values of the car, for example ``CarValues(wheelbase=2.9)`` or `Recording.car`; used as `estimate` does.

    Raises:
        ConfigurationError: the model is not causal, or the bus is slower than it.
    """
    of_car, trust = _for_car(model, car)
    bands = None if trust is None else trust.bands
    is_other = elsewhere or (bands is not None and bool(bands.difference_to(car)))
    return GuardedStepper(of_car, trust, bus_rate_hz, elsewhere=is_other)


def write_estimate(estimate: Estimate, path: str | Path) -> None:
    """Write an estimate as Parquet or CSV, by the file's ending.

    Raises:
        ConfigurationError: another ending.
        MissingError: it cannot be written.
    """
    write_estimate_table([estimate], Path(path))
