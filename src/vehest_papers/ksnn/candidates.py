"""Candidates of a comparison: every run with its metrics, the category it falls into, and which of
them validation chooses.
"""

from __future__ import annotations

import re

import numpy as np
import pandas as pd

from vehest.data.errors import DataError
from vehest.data.splits import VALIDATION
from vehest.studies import artefacts
from vehest_papers.kit.reading import metric_values
from vehest_papers.ksnn import paper

METRICS = ("rmse_vy", "fvu", "r2", "rmse_sideslip")
OF_MODEL = ("n_parameters", "epochs")
_KINDS = {
    ("linear", "bias"): paper.LINEAR_BIAS,
    ("linear", "no_bias"): paper.LINEAR,
    ("nonlinear", "bias"): paper.NONLINEAR_BIAS,
    ("nonlinear", "no_bias"): paper.NONLINEAR,
}
_NAMES = {
    "luenberger": paper.LUENBERGER,
    "gru": paper.GRU,
    "lstm": paper.LSTM,
    "kalman": paper.KALMAN,
    "factor_graph": paper.FACTOR_GRAPH,
    "zero": paper.ZERO,
    "static_map": paper.STATIC_MAP,
    "kinematic": paper.KINEMATIC,
}


def runs_of(part: artefacts.PartArtefacts) -> pd.DataFrame:
    """One row a run, in the order of the pipeline.

    Columns: estimator, variant, title, category, structure, seed, ``n_parameters``, ``epochs``, and
    for each set ``rmse_vy.SET`` [m/s], ``fvu.SET``, ``r2.SET``, ``rmse_sideslip.SET`` [deg], where
    SET is ``validation`` or a test set.

    Raises
    ------
    DataError
        A metric is missing.
    """
    values = metric_values(part)
    sets = [*([VALIDATION] if part.split.validation else []), *part.split.tests]
    rows = []
    for model in part.models:
        run_key = (model.estimator, model.variant, model.seed)
        row: dict[str, object] = {
            "estimator": run_key[0],
            "variant": run_key[1],
            "title": model.title,
        }
        row |= {
            "category": category_of(*run_key[:2]),
            "structure": structure_of(run_key[1]),
            "seed": model.seed,
        }
        keys = {f"{metric}.{name}": (*run_key, name, metric) for name in sets for metric in METRICS}
        keys |= {metric: (*run_key, next(iter(part.split.tests)), metric) for metric in OF_MODEL}
        missing = [column for column, key in keys.items() if key not in values]
        if missing:
            raise DataError(
                f"study '{part.study}': {run_key[0]}-{run_key[1]}-seed{run_key[2]} has no "
                f"{missing[0]}; "
                "evaluate it again"
            )
        rows.append(row | {column: values[key] for column, key in keys.items()})
    return pd.DataFrame(rows)


def category_of(estimator: str, variant: str) -> str:
    """Category of Tables III to VI that a candidate falls into; the estimator's name if it is none
    of the paper's.
    """
    lag = re.search(r"_lag_([\d.]+s)", variant)
    if lag:
        return f"{paper.FIXED_LAG} {lag[1].removesuffix('s')} s"
    if estimator != "ksnn":
        return _NAMES.get(estimator, estimator)
    if "_kinematic_" in variant:
        return paper.KINEMATIC_GAIN
    kind = variant.split("_")[0]
    bias = "no_bias" if "_no_bias" in variant else "bias"
    return _KINDS[kind, bias]


def structure_of(variant: str) -> str:
    """Hyperparameters in words, for example ``P = 2, Q = 3`` or ``5 states``; a dash if there are
    none to choose.
    """
    states = re.search(r"states_(\d+)", variant)
    if states:
        return f"{states[1]} states"
    local = re.search(r"_p(\d+)", variant)
    hidden = re.search(r"_q(\d+)", variant)
    words = [f"P = {local[1]}"] if local else []
    words += [f"Q = {hidden[1]}"] if hidden else []
    return ", ".join(words) or "–"


def chosen(runs: pd.DataFrame) -> pd.Series:
    """The run with the lowest RMSE of v on the validation range; the first of equals. Test sets
    choose nothing.
    """
    column = f"rmse_vy.{VALIDATION}"
    if column not in runs:
        if len(runs) > 1:
            raise DataError(
                f"{len(runs)} runs of {runs.iloc[0]['title']} and no validation range to choose "
                "one by"
            )
        return runs.iloc[0]
    values = runs[column].to_numpy(dtype=float)
    return runs.iloc[int(np.argmin(np.where(np.isfinite(values), values, np.inf)))]


def chosen_by_category(runs: pd.DataFrame) -> dict[str, pd.Series]:
    """Category -> the run that validation chooses among all its structures and seeds.

    Baselines first, then in the order of Tables IV and V.
    """
    present = dict.fromkeys(runs["category"])
    ordered = (*paper.BASELINES, *paper.CATEGORIES)
    order = [
        *(name for name in ordered if name in present),
        *(name for name in present if name not in ordered),
    ]
    return {name: chosen(runs[runs["category"] == name]) for name in order}
