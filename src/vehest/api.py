"""The Python interface: load a model, read a recording, estimate, write.

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
from vehest.data.recording import Recording
from vehest.estimators.base import Estimator
from vehest.estimators.model_files import load_model as _load_model
from vehest.stages.estimate import PRETRAINED, estimate_recording, find_model, preparation_of, read_table, write_estimate_table

__all__ = ["Estimate", "Estimator", "Recording", "estimate", "load_model", "read_recording", "write_estimate"]


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


def read_recording(path: str | Path, overrides: Sequence[str] = ()) -> Recording:
    """Read a CSV or Parquet file as a recording.

    Args:
        path: the file.
        overrides: how to read it, for example ``["dataset=my_car"]``; by default columns carry the channels' names and SI units.

    Raises:
        MissingError: there is no such file.
        DataError: it cannot be used as it is.
    """
    return read_table(Path(path), overrides)


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
