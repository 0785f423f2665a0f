"""Metrics of a comparison by run, and the seed by which an estimator is represented."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.splits import VALIDATION
from vehest.report.document import as_text
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts, nominal_rows

Name = tuple[str, str]  # estimator and variant

Runs = dict[
    tuple[str, str, int, str], dict[str, float]
]  # (estimator, variant, seed, test set) -> metric -> value


def runs_of(artefacts: PartArtefacts, column: str = "value") -> Runs:
    """Metrics of all samples under nominal conditions, by run and test set.

    Parameters
    ----------
    artefacts : PartArtefacts
        The comparison.
    column : str
        ``value``, or ``low`` or ``high`` for the ends of intervals.

    Returns
    -------
    Runs
        (estimator, variant, seed, test set) -> metric -> number; NaN entries are left out.

    Raises
    ------
    DataError
        A run has two different values of one metric.
    """
    nominal = nominal_rows(artefacts.metrics)
    columns = (
        nominal[name].tolist()
        for name in ("estimator", "variant", "seed", "test_set", "metric", column)
    )
    runs: Runs = {}
    for estimator, variant, seed, test_set, metric, value in zip(*columns, strict=True):
        run = runs.setdefault((_text(estimator), _text(variant), int(seed), _text(test_set)), {})
        number = float(value)
        if not (
            math.isnan(number) or math.isnan(run.get(metric, math.nan)) or run[metric] == number
        ):
            raise DataError(
                f"study '{artefacts.study}': {metric} of {estimator}/{variant}, seed {seed}, on "
                f"'{test_set}' is both {run[metric]:g} and "
                f"{number:g}; give models that differ in more than the seed different variants"
            )
        if not math.isnan(number):
            run[metric] = number
    return runs


def values_of(
    runs: Runs, name: Name, seeds: Sequence[int], test_set: str, metric: str
) -> FloatArray:
    """Values of a metric, one a seed; NaN where there is none."""
    return np.array([value_of_run(runs, name, seed, test_set, metric) for seed in seeds])


def value_of_run(runs: Runs, name: Name, seed: int, test_set: str, metric: str) -> float:
    """Value of a metric of one seed; NaN where there is none."""
    return runs.get((*name, seed, test_set), {}).get(metric, math.nan)


def of_model(runs: Runs, name: Name, seed: int, metric: str) -> float:
    """A metric of the model itself, which does not depend on the test set under which it is stored.

    Parameters
    ----------
    runs : Runs
        As `runs_of` returns them.
    name : Name
        Estimator and variant.
    seed : int
        Seed of the model.
    metric : str
        Name of the metric, such as ``n_parameters`` or ``epochs``.

    Returns
    -------
    float
        NaN where the metric is stored under no test set.
    """
    values = (
        run[metric] for (*key, _), run in runs.items() if (*key,) == (*name, seed) and metric in run
    )
    return next(values, math.nan)


def chosen_seed(seeds: Sequence[int], name: Name, runs: Runs) -> int:
    """The seed by which an estimator is represented: that with the lowest RMSE(v) on the validation
    range.


    Test data choose nothing.

    Parameters
    ----------
    seeds : sequence of int
        In ascending order: the first of equals is taken.
    name : Name
        Estimator and variant.
    runs : Runs
        As `runs_of` returns them.

    Returns
    -------
    int
        A seed without a finite value counts as infinite; a single seed needs no metrics.

    Raises
    ------
    DataError
        There are several seeds, and none has metrics on the validation range.
    """
    if len(seeds) > 1 and not any((*name, seed, VALIDATION) in runs for seed in seeds):
        raise DataError(
            f"{name[0]}/{name[1]} has {len(seeds)} seeds and no metrics on the validation range to "
            "choose one by; evaluate it there"
        )
    validation = values_of(runs, name, seeds, VALIDATION, "rmse_vy")
    return seeds[int(np.argmin(np.where(np.isfinite(validation), validation, np.inf)))]


def titles_of(models: Iterable[EvaluatedModel]) -> dict[Name, str]:
    """Estimator and variant -> title, as Markdown."""
    return {name: as_text(seeds[0].title) for name, seeds in by_name(models).items()}


def by_name(models: Iterable[EvaluatedModel]) -> dict[Name, list[EvaluatedModel]]:
    """Models by estimator and variant, in their order."""
    groups: dict[Name, list[EvaluatedModel]] = {}
    for model in models:
        groups.setdefault(model.name, []).append(model)
    return groups


def _text(value: object) -> str:
    """Text of a field of a table; empty for NaN, as which pandas reads an empty field."""
    return value if isinstance(value, str) else ""
