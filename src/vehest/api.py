"""The Python interface: read recordings, train, score, save and load models, estimate, write.

>>> import vehest
>>> model = vehest.load_model("outputs/train/ksnn-linear_bias_p2-seed2-0123456789ab")
>>> recording = vehest.read_recording("lap.csv")
>>> estimate = vehest.estimate(model, recording)
>>> vehest.write_estimate(estimate, "estimate.parquet")
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from vehest.data.estimate import Estimate
from vehest.data.files import written_aside
from vehest.data.recording import Recording
from vehest.estimators.base import Estimator
from vehest.estimators.model_files import load_model as _load_model
from vehest.estimators.model_files import save_model as _save_model
from vehest.stages.estimate import PRETRAINED, estimate_recording, find_model, preparation_of, read_table, write_estimate_table
from vehest.stages.in_memory import score_on, train_on

__all__ = [
    "Estimate",
    "Estimator",
    "Recording",
    "estimate",
    "load_model",
    "read_recording",
    "save_model",
    "score",
    "train",
    "write_estimate",
]


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
    folder = find_model(str(model), Path(output or os.environ.get("VEHEST_OUTPUT", "outputs")))
    estimator = _load_model(folder)
    estimator.preparation = preparation_of(folder)
    return estimator


def train(
    estimator: str, train: Sequence[Recording], validation: Sequence[Recording], overrides: Sequence[str] = (), *, seed: int = 0
) -> Estimator:
    """Fit an estimator to recordings, which are brought to its rate first.

    Args:
        estimator: its name, as in conf/estimator.
        train: recordings to learn from, with ``vy_ref``, at any rate from the estimator's upwards.
        validation: recordings that decide when to stop, of the same kind; may be the same objects where the method does not stop early.
        overrides: as of ``vehest train``, for example ``["estimator.n_local=3", "training.max_epochs=50"]``.
        seed: of whatever is random.

    Raises:
        ConfigurationError: an unknown name or setting.
        DataError: a channel is missing, or the recordings are too short or sampled too slowly.
    """
    return train_on(estimator, train, validation, overrides, seed)


def score(model: Estimator, recordings: Sequence[Recording]) -> dict[str, float]:
    """Metrics of a model on whole recordings that have ``vy_ref``, over all of them together, on the grid and after the first seconds that
    conf/eval.yaml names. That the model has not learnt from them is for the caller to see to.

    Returns:
        Metric -> value: ``rmse_vy`` [m/s], ``rmse_sideslip`` [deg], ``fvu`` and others, as docs/estimators.md defines them.

    Raises:
        DataError: a channel is missing or has gaps, or a recording is too short or sampled too slowly.
    """
    return score_on(model, recordings)


def save_model(model: Estimator, folder: str | Path) -> None:
    """Write a fitted estimator into a new folder, for `load_model` and ``vehest estimate``.

    Raises:
        MissingError: it cannot be written, or a folder that is not empty is there already.
    """
    with written_aside(Path(folder)) as aside:
        aside.mkdir()
        _save_model(model, aside, {"n_parameters": model.n_parameters, "downsample": dict(model.preparation)})


def read_recording(path: str | Path, overrides: Sequence[str] = (), *, references: bool = False) -> Recording:
    """Read a CSV or Parquet file as a recording.

    Args:
        path: the file.
        overrides: how to read it, for example ``["dataset=my_car"]``; by default columns carry the channels' names and SI units.
        references: whether the reference channels that a data set declares have to be there; else they are left aside. Columns that carry
            the channels' names are read in any case.

    Raises:
        MissingError: there is no such file.
        DataError: it cannot be used as it is.
    """
    return read_table(Path(path), overrides, references=references)


def estimate(model: Estimator, recording: Recording) -> Estimate:
    """Run a model on a recording, brought to the model's rate in the way it was trained with.

    Returns:
        ``vy`` [m/s] and ``sideslip`` [rad], each of shape (T,); NaN where the model's window is not full yet.

    Raises:
        DataError: a channel is missing, or the recording is sampled too slowly.
    """
    return estimate_recording(model, recording, dict(model.preparation))


def write_estimate(estimate: Estimate, path: str | Path) -> None:
    """Write an estimate as Parquet or CSV, by the file's ending.

    Raises:
        ConfigurationError: another ending.
        MissingError: it cannot be written.
    """
    write_estimate_table(estimate, Path(path))
