"""Searches of a study: what each trial reached on the validation range, and which one that chooses.

planned trials -> `published_values` of results/STUDY/searches.csv, else their evaluations ->
`trials_of` -> `remarks_on` parts -> report

A search is finished where the file has all of its trials with today's origins (`run.weights`): then
none of them is trained, wherever the study runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from vehest.artefacts.keys import hash_of
from vehest.configuration.composition import Config, key_of
from vehest.data.errors import DataError
from vehest.data.splits import VALIDATION
from vehest.data.text_files import number_in, read_rows
from vehest.estimators.registry import new_estimator
from vehest.run.comparison import Comparison
from vehest.run.evaluate import evaluation_options, read_metrics
from vehest.run.evaluate_faults import faults_of
from vehest.run.study import Study
from vehest.run.train import TrainJob, training_options
from vehest.run.versions import code_of
from vehest.studies.artefacts import Trial, nominal_rows, write_frame

SEARCHES = "searches.csv"  # name of the table of trials in results/STUDY
# columns of that table
TRIAL_COLUMNS = (
    "search",
    "name",
    "options",
    "title",
    "seed",
    "metric",
    "validation",
    "origin",
    "evaluation",
    "chosen",
)
OriginOf = Callable[[TrainJob], str]
"""Function that returns the origin of a training (`vehest.run.runner.Runner.origin`)."""
DIGITS = 6  # significant digits of a validation value, as in published CSV files


def published_values(
    study: Study, comparisons: Mapping[str, Comparison], origin_of: OriginOf, path: Path
) -> dict[str, float]:
    """Published validation values of the trials, for those searches of which a file has all trials
    with today's origins.

    Parameters
    ----------
    study : Study
        With its searches.
    comparisons : mapping
        Part -> its planned jobs.
    path : Path
        searches.csv of the published study.

    Returns
    -------
    dict
        Trial -> value; empty where the file is not there.

    Raises
    ------
    DataError
        The file is damaged.
    """
    if not path.is_file():
        return {}
    values = {
        (row["origin"], row["evaluation"], row["metric"]): number_in(row, "validation", path)
        for row in read_rows(path, TRIAL_COLUMNS)
    }
    finished: dict[str, float] = {}
    for trials in study.searches.values():
        planned = [_planned_trial(study, name, comparisons, origin_of) for name in trials]
        published_trials = {
            trial.name: values[trial.origin, trial.evaluation, trial.metric]
            for trial in planned
            if trial is not None and (trial.origin, trial.evaluation, trial.metric) in values
        }
        if len(published_trials) == len(trials):
            finished |= published_trials
    return finished


def trials_of(
    study: Study,
    comparisons: Mapping[str, Comparison],
    origin_of: OriginOf,
    published: Mapping[str, float],
) -> list[Trial]:
    """The trials of every search for which all values are known: published, or from their
    evaluations.

    Parameters
    ----------
    study : Study
        With its searches.
    comparisons : mapping
        Part -> its comparison.
    origin_of : callable
        Origin of a training.
    published : mapping
        Trial -> published value.

    Returns
    -------
    list of Trial
        The one with the lowest value of its search is chosen, the first of equals.
    """
    finished: list[Trial] = []
    for names in study.searches.values():
        trials = []
        for name in names:
            trial = _planned_trial(study, name, comparisons, origin_of)
            if trial is None or not (name in published or comparisons[name].members):
                break
            value = published.get(name)
            if value is None:
                value = _validation_value(comparisons[name], trial)
            trials.append(replace(trial, validation=float(f"{value:.{DIGITS}g}")))
        if len(trials) == len(names):
            lowest = min(math.inf if math.isnan(t.validation) else t.validation for t in trials)
            best = next((t.name for t in trials if t.validation == lowest), "")
            finished += [replace(trial, chosen=trial.name == best) for trial in trials]
    return finished


def remarks_on(
    study: Study, comparisons: Mapping[str, Comparison], trials: Sequence[Trial]
) -> list[str]:
    """Sentences on parts that train what was searched for, with other options than the chosen ones.

    What was searched for is a job that differs from the trials in nothing but the options that they
    try, and the seed.
    """
    remarks: dict[str, None] = {}
    for chosen in (trial for trial in trials if trial.chosen):
        tried = {
            key_of(override)
            for trial in trials
            if trial.search == chosen.search
            for override in _options(study, trial.name)
        }
        best = comparisons[chosen.name].jobs[0].config
        for name, comparison in comparisons.items():
            if name in study.trials:
                continue
            for config in (job.config for job in comparison.usable):
                is_searched = settings_to_compare(config, tried) == settings_to_compare(best, tried)
                if is_searched and settings_to_compare(config) != settings_to_compare(best):
                    remarks[
                        f"part '{name}' does not use what the search '{chosen.search}' chose by "
                        f"{chosen.metric} on validation: {chosen.options}"
                    ] = None
    return list(remarks)


def write_trials(trials: Sequence[Trial], path: Path) -> None:
    """Write the trials of searches, a row each, with their origins."""
    rows = [{column: getattr(trial, column) for column in TRIAL_COLUMNS} for trial in trials]
    write_frame(pd.DataFrame(rows, columns=list(TRIAL_COLUMNS)), path)


def _options(study: Study, name: str) -> tuple[str, ...]:
    """The overrides that a trial tries."""
    search = study.parts[name].search
    assert search is not None
    return search.candidates[0]


def _planned_trial(
    study: Study, name: str, comparisons: Mapping[str, Comparison], origin_of: OriginOf
) -> Trial | None:
    """A trial before its value is known; None where its recordings are not available or it cannot
    be trained.
    """
    if name not in comparisons:
        return None
    comparison = comparisons[name]
    job = comparison.jobs[0]
    if job.training is None:
        return None
    search = study.parts[name].search
    assert search is not None
    estimator = new_estimator(job.config["estimator"])
    faults = faults_of(job.config)
    options = evaluation_options(comparison.evaluation.protocol, faults)
    code = code_of("evaluate", estimator.name, faults=bool(faults))
    return Trial(
        search=next(key for key, names in study.searches.items() if name in names),
        name=name,
        options=" ".join(_options(study, name)),
        estimator=estimator.name,
        variant=estimator.variant,
        title=estimator.full_title,
        seed=job.training.seed,
        training=dict(job.config["training"]),
        metric=search.metric,
        validation=math.nan,
        origin=origin_of(job.training),
        evaluation=f"{code} {hash_of(options)[:16]}",
    )


def _validation_value(comparison: Comparison, trial: Trial) -> float:
    """Value of the search's metric over all samples of the validation range."""
    evaluation = comparison.members[0].evaluation
    assert evaluation is not None
    table = nominal_rows(read_metrics(evaluation.folder))
    rows = table[(table["metric"] == trial.metric) & (table["test_set"] == VALIDATION)]
    if len(rows) != 1:
        raise DataError(
            f"the search '{trial.search}' cannot choose: {trial.title} has no {trial.metric} on a "
            "validation range"
        )
    return float(rows["value"].iloc[0])


def settings_to_compare(config: Config, tried: Collection[str] = ()) -> dict[str, Any]:
    """Configuration of everything that determines a training, without its seed and the dotted keys
    that are tried.
    """
    options = training_options(config)
    content = {key: options[key] for key in ("estimator", "training")} | {"split": config["split"]}
    for key in tried:
        content = _without(content, key.split("."))
    return content


def _without(content: Any, path: Sequence[str]) -> Any:
    """A mapping without a nested key, and without mappings that are empty then."""
    first, *nested_path = path
    if not isinstance(content, dict) or first not in content:
        return content
    siblings = {key: value for key, value in content.items() if key != first}
    nested = _without(content[first], nested_path) if nested_path else {}
    return {**siblings, first: nested} if nested else siblings
