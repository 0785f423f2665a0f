"""Logs members of a group: figures of fits, calibrations and evaluations, learning curves and traces."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from vehest.data.splits import TRAINING, VALIDATION
from vehest.estimators.model_files import read_description
from vehest.run.artefacts import Artefact
from vehest.run.calibrate import calibration_figures
from vehest.run.evaluate import Evaluation, read_metrics, read_scored
from vehest.run.group import Member
from vehest.run.tracking import Tracker
from vehest.run.train import HISTORY, read_fit_metrics
from vehest.studies.artefacts import read_frame


def log_member(tracker: Tracker, member: Member, how: Evaluation | None) -> None:
    """Log a training, its calibration and its evaluation, each unless it is.

    Args:
        tracker: MLflow's.
        member: of a group.
        how: it was evaluated; none if it was trained only.
    """
    model = member.model
    if model is not None and not tracker.is_tracked(model):
        drawn = {"learning.png": partial(_learning_figure, model)}
        tracker.log(model, read_fit_metrics(model.folder), model.folder / HISTORY, drawn)
    if member.calibration is not None:
        log_calibration(tracker, member.calibration)
    if member.evaluation is not None and model is not None and how is not None:
        log_evaluation(tracker, member.evaluation, model, how)


def log_calibration(tracker: Tracker, calibration: Artefact) -> None:
    """Log a calibration unless it is: blocks and seconds behind its bands."""
    if not tracker.is_tracked(calibration):
        tracker.log(calibration, calibration_figures(calibration.folder))


def log_evaluation(tracker: Tracker, evaluation: Artefact, model: Artefact, how: Evaluation) -> None:
    """Log an evaluation unless it is: figures, and traces over each test set."""
    if not tracker.is_tracked(evaluation):
        drawn = {f"traces_{name}.png": partial(_trace_figure, evaluation, model, how, name) for name in how.split.tests}
        tracker.log(evaluation, test_figures(evaluation), None, drawn)


def rmse_of_tests(evaluation: Artefact) -> dict[str, float]:
    """RMSE(β) of an evaluation on each test set [deg]."""
    return {name: value for name, value in test_figures(evaluation).items() if name.startswith("rmse_sideslip")}


def test_figures(evaluation: Artefact) -> dict[str, float]:
    """Figures of an evaluation over all samples, ``<metric>.<test set>`` -> value."""
    table = read_metrics(evaluation.folder)
    tested = table[~table["test_set"].isin((VALIDATION, TRAINING)) & (table["subset"] == "all") & (table["condition"] == "nominal")]
    return {
        f"{metric}.{name}": float(value) for metric, name, value in zip(tested["metric"], tested["test_set"], tested["value"], strict=True)
    }


def _learning_figure(model: Artefact) -> Any:
    from vehest.report.run_figures import fit_figure

    if not (model.folder / HISTORY).is_file():
        return None
    about = read_description(model.folder)
    return fit_figure(model.label, about.estimator, about.variant, read_frame(model.folder / HISTORY))


def _trace_figure(evaluation: Artefact, model: Artefact, how: Evaluation, test_set: str) -> Any:
    from vehest.report.run_figures import trace_figure

    about = read_description(model.folder)
    parts = read_scored(evaluation, how.split, how.references, how.protocol, test_set)
    series = [np.concatenate([getattr(part, name) for part in parts]) for name in ("vy_ref", "sideslip_ref", "vy", "sideslip")]
    time = parts[0].time[0] + np.arange(len(series[0])) / how.protocol.rate_hz  # several ranges stand end to end
    return trace_figure(model.label, about.estimator, about.variant, time, (series[0], series[1]), (series[2], series[3]))
