"""The Python interface: read recordings, train, score, save and load models, estimate, write.

>>> import vehest
>>> recording = vehest.read_recording("lap.csv")
>>> estimate = vehest.estimate(recording, wheelbase=2.7)
>>> vehest.write_estimate(estimate, "estimate.parquet")
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from vehest.alignment.checks import refuse_errors
from vehest.data.car import UNKNOWN_CAR
from vehest.data.car import CarValues as CarValues
from vehest.data.errors import ConfigurationError
from vehest.data.estimate import Estimate as PlainEstimate
from vehest.data.files import written_aside
from vehest.data.limits import use_limits
from vehest.data.recording import Recording as PlainRecording
from vehest.data.resampling import resampled
from vehest.data.schema import settings_from_config
from vehest.estimators.base import Estimator as Estimator
from vehest.estimators.base import FitData
from vehest.estimators.model_files import model_digest
from vehest.estimators.model_files import save_model as _save_model
from vehest.estimators.registry import new_estimator
from vehest.evaluation import metrics
from vehest.inference.car_values import (
    ASSUMED,
    adapted,
    settings_for_channels,
    with_car_values,
)
from vehest.inference.estimation import (
    estimate_recording,
    prepared_recording,
    require_estimate,
)
from vehest.inference.models import SELF_CALIBRATING, find_model, open_model
from vehest.inference.reading import read_checked, without_references
from vehest.inference.tables import write_estimate_table
from vehest.sources.named_columns import read_frame
from vehest.trust.calibration import CalibrationRange, learn_trust
from vehest.trust.contract import GuardedStepper
from vehest.trust.health import reason_in_words as reason_in_words
from vehest.trust.record import Trust, write_trust

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


class Recording(PlainRecording):
    """One uninterrupted drive; immutable. Sample k was taken at ``start_time + k / rate_hz``."""

    def plot(
        self, *estimates: PlainEstimate, start: float | None = None, stop: float | None = None
    ) -> Figure:
        """Draw the drive with estimates of it; see `vehest.report.drive_figure.drive_figure`.

        Parameters
        ----------
        *estimates : Estimate
            Of this recording; band, health and course are those of the first.
        start, stop : float, optional
            Range that is drawn [s]; by default all of it.

        Returns
        -------
        matplotlib.figure.Figure
            A notebook shows it; ``savefig`` writes PNG, PDF or SVG.
        """
        from vehest.report.drive_figure import drive_figure

        return drive_figure(self, estimates, start, stop)


class Estimate(PlainEstimate):
    """Estimated states of one recording; sample k holds for ``start_time + k / rate_hz``."""

    def plot(
        self,
        recording: PlainRecording | None = None,
        start: float | None = None,
        stop: float | None = None,
    ) -> Figure:
        """Draw the estimate, with its recording where that is passed; see `Recording.plot`."""
        from vehest.report.drive_figure import drive_figure

        return drive_figure(recording, [self], start, stop)


def load_model(model: str | Path = SELF_CALIBRATING, output: str | Path | None = None) -> Estimator:
    """Load a fitted estimator, with its calibration as the attribute `Estimator.trust`.

    Parameters
    ----------
    model : str or Path
        Its folder, or the start of its name in the output root; by default the self-calibrating
        filter that comes with vehest, as on the command line. ``pretrained`` is the network inside
        it.
    output : str or Path, optional
        The output root; by default VEHEST_OUTPUT, or ``outputs``.

    Raises
    ------
    MissingError
        There is no such model.
    DataError
        Its files are damaged.
    """
    root = Path(output or os.environ.get("VEHEST_OUTPUT", "outputs"))
    _, estimator, trust = open_model(str(model), root, partial(warnings.warn, stacklevel=4))
    estimator.trust = trust
    return estimator


def train(
    estimator: str | Estimator,
    train: Sequence[PlainRecording],
    validation: Sequence[PlainRecording],
    overrides: Sequence[str] = (),
    *,
    seed: int = 0,
) -> Estimator:
    """Fit an estimator to recordings, which are brought to its rate first.

    Parameters
    ----------
    estimator : str or Estimator
        Its name, as in conf/estimator; a wheelbase of null among its settings is that of the
        recordings' car. Or an estimator of your own, not fitted, such as ``Mine.from_config({})``,
        which is fitted with the defaults of its training.
    train : sequence of Recording
        To learn from, with ``vy_ref``, at any rate from the estimator's upwards.
    validation : sequence of Recording
        Decide when to stop, of the same kind; may be the same objects where the method does not
        stop early.
    overrides : sequence of str
        As of ``vehest train``, for example ``["estimator.n_local=3", "training.max_epochs=50"]``;
        of a named estimator only.
    seed : int
        Of all random numbers.

    Raises
    ------
    ConfigurationError
        An unknown name or setting.
    DataError
        A channel is missing, or the recordings are too short or sampled too slowly.
    """
    if isinstance(estimator, Estimator):
        if overrides:
            raise ConfigurationError(
                "overrides are for estimators of conf/estimator; "
                f"pass settings to {type(estimator).__name__}.from_config"
            )
        return _fitted(estimator, estimator.training_type(), train, validation, seed)
    from vehest.configuration.composition import compose_config  # imports Hydra

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
    return _fitted(model, settings, train, validation, seed)


def _fitted(
    model: Estimator,
    settings: Any,
    train: Sequence[PlainRecording],
    validation: Sequence[PlainRecording],
    seed: int,
) -> Estimator:
    """The model, fitted and calibrated."""
    model.seed(seed)
    parts = [
        [resampled(recording, model.settings.rate_hz, model.preparation) for recording in part]
        for part in (train, validation)
    ]
    model.fit(FitData(*parts), settings)
    learnt, stopped = (
        [CalibrationRange(own, own.start_time, "", own.id) for own in part] for part in parts
    )
    model.trust = learn_trust(model, learnt, stopped)
    return model


def score(
    estimate: PlainEstimate | Estimator, recordings: PlainRecording | Sequence[PlainRecording]
) -> dict[str, float]:
    """Metrics of an estimate against the reference of its recording, or of a model on recordings.

    Scored are 20 samples a second (all of a slower recording) where there is an estimate, after the
    first 1.5 s of a recording, over all recordings together. The caller has to make sure that a
    model was not trained on them. A model runs without the guard, health and bridging of gaps that
    it has online. Each recording's car is used as by `estimate`; sideslip is scored above a speed
    that follows from its wheelbase.

    Parameters
    ----------
    estimate : Estimate or Estimator
        As `estimate` makes it, or a fitted model.
    recordings : Recording or sequence of Recording
        With ``vy_ref`` or ``sideslip_ref``; of an estimate the one that it was made of.

    Returns
    -------
    dict
        Metric -> value: ``rmse_vy`` [m/s], ``rmse_sideslip`` [deg], ``fvu`` and others, as
        docs/evaluation.md defines them.

    Raises
    ------
    ConfigurationError
        An estimate with more recordings than its own.
    DataError
        A channel is missing or has gaps, or a recording is too short or sampled too slowly.
    """
    drives = [recordings] if isinstance(recordings, PlainRecording) else list(recordings)
    if isinstance(estimate, PlainEstimate):
        if len(drives) != 1:
            raise ConfigurationError(
                "an estimate is scored against the recording that it was made of, not "
                f"{len(drives)}"
            )
        return metrics.accuracy([metrics.score_whole(estimate, drives[0])])
    parts = []
    for drive in drives:
        of_car, _ = _for_car(estimate, drive.car, settings_for_channels(estimate, drive))
        needed = prepared_recording(of_car, drive.without_references())
        made = require_estimate(of_car, drive, of_car.estimate([needed])[0])
        parts.append(metrics.score_whole(made, drive, estimate.preparation))
    return metrics.accuracy(parts)


def save_model(model: Estimator, folder: str | Path) -> None:
    """Write a fitted estimator into a new folder, for `load_model` and ``vehest estimate``.

    Raises
    ------
    MissingError
        It cannot be written, or a folder that is not empty is there already.
    """
    with written_aside(Path(folder)) as aside:
        aside.mkdir()
        _save_model(
            model,
            aside,
            {"n_parameters": model.n_parameters, "downsample": dict(model.preparation)},
        )
        if model.trust is not None:
            write_trust(model.trust, aside, model_digest(aside))


def read_recording(
    log: str | Path | pd.DataFrame,
    overrides: Sequence[str] = (),
    *,
    columns: Mapping[str, str] | None = None,
    references: bool = False,
) -> Recording:
    """Read a file or a DataFrame as a recording.

    Parameters
    ----------
    log : str, Path or DataFrame
        A CSV, Parquet or MAT-file, one of the format that a data set describes, or a DataFrame
        with its times in a column or as index (seconds, time stamps or time differences).
        ``attrs["units"]`` of a DataFrame may have the units of its columns, ``attrs["name"]`` its
        name.
    overrides : sequence of str
        How to read it, for example ``["dataset=my_car"]``; by default columns carry the channels'
        names and SI units. The values ``car`` of the data set become `Recording.car`; without a
        data set give them as ``["dataset.car.wheelbase=2.9"]``.
    columns : mapping, optional
        Channel, or ``time``, -> its column in a table, with a sign before and the unit behind it,
        as in ``{"vx": "Speed:km/h", "ay": "-AccY:m/s²"}``; in place of those of the data set.
    references : bool
        Whether the reference channels that a data set declares have to be there; else they are left
        aside. Columns that carry the channels' names, or that ``columns`` names, are read in any
        case.

    Raises
    ------
    MissingError
        There is no such file.
    ConfigurationError
        ``columns`` names no channel, no column or no unit.
    DataError
        It cannot be used as it is.
    """
    from vehest.configuration.estimate_options import estimate_options  # imports Hydra

    options = estimate_options(overrides)
    dataset = options.dataset if references else without_references(options.dataset)
    if isinstance(log, str | Path):
        recording = read_checked(Path(log), dataset, options.limits, columns or {})
        return Recording(**_fields_of(recording))
    with use_limits(options.limits):
        recording = read_frame(log, dataset, columns or {})
    refuse_errors(recording, dataset.get("accept") or (), "DataFrame")
    return Recording(**_fields_of(recording))


def estimate(
    recording: PlainRecording,
    model: Estimator | str | Path | None = None,
    *,
    wheelbase: float | None = None,
    same_vehicle: bool | None = None,
) -> Estimate:
    """Run a model on a recording, at the model's rate, under the contract that holds online.

    The values of ``recording.car`` are used as ``vehest estimate`` uses those of a data set:
    settings of the self-calibrating filter that its training did not choose, and whether the bands
    apply.

    Parameters
    ----------
    recording : Recording
        As `read_recording` reads it. The order ``estimate(model, recording)`` of earlier versions
        is still accepted.
    model : Estimator, str or Path, optional
        Fitted, or its name as of `load_model`; by default the self-calibrating filter, as on the
        command line.
    wheelbase : float, optional
        Of the recording's car [m]; by default that of ``recording.car``.
    same_vehicle : bool, optional
        Whether it is of the car that bands were calibrated on; by default by the values and the
        names of the cars.

    Returns
    -------
    Estimate
        Its channels ``vy`` [m/s] and ``sideslip`` [rad], as ``estimate["sideslip"]``, each of shape
        (T,); NaN where the model's window is not full yet. ``health`` (0 valid, 1 degraded,
        2 invalid) and ``health_reason`` (`reason_in_words`); half widths of the 90 % band,
        ``band_vy`` and ``band_sideslip``, where the model was calibrated.

    Raises
    ------
    DataError
        A channel is missing, or the recording is sampled too slowly.
    """
    if isinstance(recording, Estimator):  # the order of earlier versions
        recording, model = cast(PlainRecording, model), recording
        warnings.warn("use vehest.estimate(recording, model)", DeprecationWarning, stacklevel=2)
    if not isinstance(recording, PlainRecording):
        raise ConfigurationError(
            "pass a recording, as vehest.read_recording(log, columns=…) reads it, "
            f"not a {type(recording).__name__}"
        )
    if wheelbase is not None:
        recording = replace(recording, car=replace(recording.car, wheelbase=wheelbase))
    if model is None:
        model = load_model()
    elif not isinstance(model, Estimator):
        model = load_model(model)
    of_car, trust = _for_car(model, recording.car, settings_for_channels(model, recording))
    return Estimate(**_fields_of(estimate_recording(of_car, recording, trust, same_vehicle)))


def _fields_of(series: PlainRecording | PlainEstimate) -> dict[str, Any]:
    """Name -> value of each field of a recording or an estimate."""
    return {field.name: getattr(series, field.name) for field in fields(series)}


def _for_car(
    model: Estimator, car: CarValues, settings: Mapping[str, Any]
) -> tuple[Estimator, Trust | None]:
    """A model and its calibration for a car; warns where the model's wheelbase is an assumption."""
    of_car, trust, remarks = adapted(model, model.trust, car, settings)
    for remark in remarks:
        if ASSUMED in remark:
            text = f"{ASSUMED} {of_car.settings.wheelbase:g} m; give your car's, as wheelbase=2.9"
            warnings.warn(text, stacklevel=3)  # at the caller of the public function
    return of_car, trust


class OnlineEstimate(NamedTuple):
    """Estimate of a model after a sample."""

    vy: float  # lateral velocity [m/s]; NaN only before the first estimate
    sideslip: float  # sideslip angle [rad]
    health: float  # 0: valid, 1: degraded, 2: invalid
    health_reason: float  # number of the reasons, for `reason_in_words`
    band_vy: float = math.nan  # half width of the 90 % band of vy [m/s]; NaN without a calibration
    # half width of the 90 % band of the sideslip angle [rad]; NaN likewise
    band_sideslip: float = math.nan


class OnlineEstimator:
    """A model that runs along with a drive.

    Attributes
    ----------
    stepper : GuardedStepper
        The model under its contract; its ``step`` returns a dictionary with all quantities.
    last : OnlineEstimate
        What the last step returned.
    """

    def __init__(self, stepper: GuardedStepper) -> None:
        self.stepper = stepper
        self._values: Mapping[str, float] = {}
        self.last = OnlineEstimate(math.nan, math.nan, 0.0, 0.0)

    def step(
        self,
        sample: Mapping[str, Any] | None = None,
        time: float | None = None,
        **channels: float | None,
    ) -> OnlineEstimate:
        """Take the sample received at one instant: ``step(vx=21.3, yaw_rate=0.1, ay=2.2, ax=0.0)``.

        Parameters
        ----------
        sample : mapping, optional
            Channel -> value [SI], in place of keywords or beside them. A channel that is missing,
            None or no number counts as not measured.
        time : float, optional
            Of the sample [s]; see `GuardedStepper.step`.
        **channels : float or None
            Channel -> value [SI].

        Returns
        -------
        OnlineEstimate
            The same object as the last time until the model has a new estimate.
        """
        values = self.stepper.step({**(sample or {}), **channels}, time)
        if values is not self._values:
            self._values = values
            self.last = OnlineEstimate(
                values["vy"],
                values["sideslip"],
                values.get("health", 0.0),
                values.get("health_reason", 0.0),
                values.get("band_vy", math.nan),
                values.get("band_sideslip", math.nan),
            )
        return self.last

    @property
    def lead_seconds(self) -> float:
        """Time from a sample to the instant for which its estimate holds [s]; negative behind a
        slow low-pass.
        """
        rate = self.stepper.estimator.settings.rate_hz
        return float(self.stepper.horizon_steps / rate - self.stepper.delay)


def online(
    model: Estimator | None = None,
    bus_rate_hz: float | None = None,
    *,
    wheelbase: float | None = None,
    elsewhere: bool = False,
    car: CarValues = UNKNOWN_CAR,
) -> OnlineEstimator:
    """A model that runs along with a drive: ``online(model).step(vx=…, yaw_rate=…, ay=…)``.

    Parameters
    ----------
    model : Estimator, optional
        Fitted, causal; by default that of `load_model`, which also reads ``ax``.
    bus_rate_hz : float, optional
        Rate at which samples come, if it is above the model's: they then go through a causal
        anti-aliasing filter first.
    wheelbase : float, optional
        Of the car [m]; by default that of ``car``.
    elsewhere : bool
        Whether the car or its tyres are others than those that were calibrated on; bands are wider
        then. They are, too, where the values of ``car`` say so.
    car : CarValues
        Values of the car, for example ``CarValues(wheelbase=2.9)`` or `Recording.car`; used as
        `estimate` does.

    Raises
    ------
    ConfigurationError
        The model is not causal, or the bus is slower than it.
    """
    if wheelbase is not None:
        car = replace(car, wheelbase=wheelbase)
    of_car, trust = _for_car(load_model() if model is None else model, car, {})
    bands = None if trust is None else trust.bands
    is_other = elsewhere or (bands is not None and bool(bands.difference_to(car)))
    return OnlineEstimator(GuardedStepper(of_car, trust, bus_rate_hz, elsewhere=is_other))


def write_estimate(estimate: PlainEstimate, path: str | Path) -> None:
    """Write an estimate as Parquet or CSV, by the file's ending.

    Raises
    ------
    ConfigurationError
        Another ending.
    MissingError
        It cannot be written.
    """
    write_estimate_table([estimate], Path(path))
