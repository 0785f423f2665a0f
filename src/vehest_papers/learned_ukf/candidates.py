"""Candidates of a part: every run with its metrics, by what the paper calls it, and its losses
sample by sample.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.splits import VALIDATION
from vehest.data.store import read_recording
from vehest.evaluation.metrics import (
    REFERENCES,
    Scored,
    accuracy,
    pieces_of,
    scored_range,
)
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts, Trial
from vehest_papers.kit import reading
from vehest_papers.kit.reading import metric_values
from vehest_papers.learned_ukf import paper

SETS: Mapping[str, str] = {"tyre_a": "tyre A", "tyre_d": "tyre D"}  # test set -> tyre

ACCURACY = ("mse_weighted", "mae_weighted", "ae99_weighted", "rmse_vx", "rmse_vy", "rmse_yaw_rate")
CONSISTENCY = ("nees", "nis", "coverage_1sigma", "coverage_2sigma")
OF_MODEL = ("n_parameters", "epochs")

_FILTERS = {
    "pc": paper.PC,
    "pcr": paper.PCR,
    "nn": paper.NN,
    "nn_u": paper.NN_U,
    "nnt": paper.NNT,
    "nnt_u": paper.NNT_U,
    "nntf": paper.NNTF,
    "nntf_u": paper.NNTF_U,
    "nntf_uh": paper.NNTF_UH,
    "nntf_uh_mu0.4": paper.NNTF_UH_LOW,
}
_VARIANTS = {"nntf_uh_diagonal": paper.DIAGONAL, "pc_curved": paper.CURVED}
_NETWORKS = {"velocity_gru": paper.GRU, "velocity_lstm": paper.LSTM}
_BASELINES = {"zero": paper.ZERO, "static_map": paper.STATIC_MAP, "data_sheet": paper.DATA_SHEET}


def candidate_of(model: EvaluatedModel | Trial) -> str:
    """What the paper calls a model; its own title if the paper has none like it."""
    name = _name_of(model.estimator, model.variant, model.title)
    pre_training = model.training.get("one_step", {})
    return f"{name}{paper.FROM_SCRATCH}" if pre_training.get("max_epochs") == 0 else name


def candidate_of_training(name: str) -> str:
    """What the paper calls a training that is planned, ``learned_ukf-nntf_u-seed0``; itself if the
    paper has none like it.
    """
    estimator, _, variant = name.rpartition("-seed")[0].partition("-")
    return _name_of(estimator, variant, name)


def _name_of(estimator: str, variant: str, title: str) -> str:
    if estimator == "learned_ukf":
        return (_FILTERS | _VARIANTS).get(variant, title)
    return (_NETWORKS | _BASELINES).get(estimator, title)


def models_by_candidate(part: PartArtefacts) -> dict[str, list[EvaluatedModel]]:
    """Candidate -> its seeds, in the order of Table II; others come last."""
    return reading.models_by_candidate(part, candidate_of, (*paper.CANDIDATES, *paper.BASELINES))


def runs_of(part: PartArtefacts) -> pd.DataFrame:
    """One row a run, candidates in the order of Table II.

    Returns
    -------
    DataFrame
        Columns candidate, estimator, variant, seed, ``mse_weighted.validation``, `OF_MODEL`, and
        for each test set ``METRIC.SET`` of `ACCURACY` and `CONSISTENCY`; the latter are NaN for
        methods without.

    Raises
    ------
    DataError
        A metric is missing.
    """
    values = metric_values(part)
    rows = []
    for candidate, models in models_by_candidate(part).items():
        for model in models:
            run_key = (model.estimator, model.variant, model.seed)
            required = {
                f"{metric}.{test}": (*run_key, test, metric)
                for test in part.split.tests
                for metric in ACCURACY
            }
            required |= {f"mse_weighted.{VALIDATION}": (*run_key, VALIDATION, "mse_weighted")}
            required |= {
                metric: (*run_key, next(iter(part.split.tests)), metric) for metric in OF_MODEL
            }
            if candidate in paper.BASELINES:
                for test in (*part.split.tests, VALIDATION):
                    figures = accuracy(scored_of(part, model, test))
                    values |= {(*run_key, test, metric): figures[metric] for metric in ACCURACY}
                values |= {(*run_key, next(iter(part.split.tests)), "epochs"): math.nan}
            missing = [column for column, key in required.items() if key not in values]
            if missing:
                raise DataError(
                    f"study '{part.study}': {run_key[0]}-{run_key[1]}-seed{run_key[2]} has no "
                    f"{missing[0]}; "
                    "evaluate it again"
                )
            keys = required | {
                f"{metric}.{test}": (*run_key, test, metric)
                for test in part.split.tests
                for metric in CONSISTENCY
            }
            row = {
                "candidate": candidate,
                "estimator": run_key[0],
                "variant": run_key[1],
                "seed": run_key[2],
            }
            rows.append(row | {column: values.get(key, math.nan) for column, key in keys.items()})
    return pd.DataFrame(rows)


def scored_of(part: PartArtefacts, model: EvaluatedModel, test: str) -> list[Scored]:
    """Estimate and reference of a model on each sequence of a test set, or of ``validation``.

    Baselines estimate the lateral velocity alone; their forward velocity is the measured rim speed,
    their yaw rate the gyroscope's.
    """
    scored = part.scored(model, test)
    if model.estimator not in _BASELINES:
        return scored
    spans = part.split.validation if test == VALIDATION else part.split.tests[test]
    pieces = pieces_of(
        spans,
        lambda span: read_recording(part.references[span.dataset, span.recording]),
        part.protocol,
    )
    completed = []
    for estimate, (reference, piece) in zip(scored, pieces, strict=True):
        first, end = scored_range(reference, piece, part.protocol)
        other_states = {
            name: (reference[name][first:end], reference[REFERENCES[name]][first:end])
            for name in ("vx", "yaw_rate")
        }
        completed.append(replace(estimate, other_states=other_states))
    return completed


def of_candidate(runs: pd.DataFrame, candidate: str, column: str) -> FloatArray:
    """Values of a column, one a seed."""
    return runs[runs["candidate"] == candidate][column].to_numpy(dtype=np.float64)


def chosen(part: PartArtefacts, runs: pd.DataFrame, candidate: str) -> EvaluatedModel:
    """The seed with the lowest weighted MSE on the validation range. Test sets choose nothing."""
    errors = of_candidate(runs, candidate, f"mse_weighted.{VALIDATION}")
    return models_by_candidate(part)[candidate][
        int(np.argmin(np.where(np.isfinite(errors), errors, np.inf)))
    ]
