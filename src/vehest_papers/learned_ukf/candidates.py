"""Candidates of a part: every run with its metrics, by what the paper calls it, and its losses sample by sample."""

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
    if model.estimator == "learned_ukf":
        name = (_FILTERS | _VARIANTS).get(model.variant, model.title)
        pre_training = model.training.get("one_step", {})
        return f"{name}{paper.FROM_SCRATCH}" if pre_training.get("max_epochs") == 0 else name
    return (_NETWORKS | _BASELINES).get(model.estimator, model.title)


def models_by_candidate(part: PartArtefacts) -> dict[str, list[EvaluatedModel]]:
    """Candidate -> its seeds, in the order of Table II; others come last."""
    return reading.models_by_candidate(part, candidate_of, (*paper.CANDIDATES, *paper.BASELINES))


def runs_of(part: PartArtefacts) -> pd.DataFrame:
    """One row a run, candidates in the order of Table II.

    Columns: candidate, estimator, variant, seed, ``mse_weighted.validation``, `OF_MODEL`, and for each test set ``METRIC.SET`` of
    `ACCURACY` and `CONSISTENCY`; the latter are NaN for methods without.

    Raises:
        DataError: a metric is missing.
    """
    known = metric_values(part)
    rows = []
    for candidate, models in models_by_candidate(part).items():
        for model in models:
            own = (model.estimator, model.variant, model.seed)
            needed = {
                f"{metric}.{test}": (*own, test, metric)
                for test in part.split.tests
                for metric in ACCURACY
            }
            needed |= {f"mse_weighted.{VALIDATION}": (*own, VALIDATION, "mse_weighted")}
            needed |= {metric: (*own, next(iter(part.split.tests)), metric) for metric in OF_MODEL}
            if candidate in paper.BASELINES:
                for test in (*part.split.tests, VALIDATION):
                    figures = accuracy(scored_of(part, model, test))
                    known |= {(*own, test, metric): figures[metric] for metric in ACCURACY}
                known |= {(*own, next(iter(part.split.tests)), "epochs"): math.nan}
            missing = [column for column, key in needed.items() if key not in known]
            if missing:
                raise DataError(
                    f"study '{part.study}': {own[0]}-{own[1]}-seed{own[2]} has no {missing[0]}; evaluate it again"
                )
            wanted = needed | {
                f"{metric}.{test}": (*own, test, metric)
                for test in part.split.tests
                for metric in CONSISTENCY
            }
            row = {"candidate": candidate, "estimator": own[0], "variant": own[1], "seed": own[2]}
            rows.append(row | {column: known.get(key, math.nan) for column, key in wanted.items()})
    return pd.DataFrame(rows)


def scored_of(part: PartArtefacts, model: EvaluatedModel, test: str) -> list[Scored]:
    """Estimate and reference of a model on each sequence of a test set, or of ``validation``.

    Baselines estimate the lateral velocity alone; their forward velocity is the measured rim speed, their yaw rate the gyroscope's.
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
    for own, (reference, piece) in zip(scored, pieces, strict=True):
        first, end = scored_range(reference, piece, part.protocol)
        others = {
            name: (reference[name][first:end], reference[REFERENCES[name]][first:end])
            for name in ("vx", "yaw_rate")
        }
        completed.append(replace(own, others=others))
    return completed


def of_candidate(runs: pd.DataFrame, candidate: str, column: str) -> FloatArray:
    """Values of a column, one a seed."""
    return runs[runs["candidate"] == candidate][column].to_numpy(dtype=np.float64)


def chosen(part: PartArtefacts, runs: pd.DataFrame, candidate: str) -> EvaluatedModel:
    """The seed with the lowest weighted MSE on the validation range. Test sets choose nothing."""
    own = of_candidate(runs, candidate, f"mse_weighted.{VALIDATION}")
    return models_by_candidate(part)[candidate][
        int(np.argmin(np.where(np.isfinite(own), own, np.inf)))
    ]
