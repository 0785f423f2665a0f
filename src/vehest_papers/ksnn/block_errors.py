"""Errors of the candidates that claims and tables name, by block and seed, and how far each was
trained: blocks.csv and training.csv.

A block is a stretch of a test drive that is about independent of its neighbours, the same for all
parts that are tested on the drive; 25.6 s where spectra are compared.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.splits import VALIDATION
from vehest.studies.artefacts import PartArtefacts
from vehest_papers.kit.block_errors import BlockErrors
from vehest_papers.kit.block_rows import (
    BlockRow,
    TrainingRow,
    block_rows,
    checked_training,
)
from vehest_papers.kit.claim_files import BASELINES, Paper
from vehest_papers.kit.verdicts import keys_of
from vehest_papers.ksnn import measures
from vehest_papers.ksnn.behaviour import Behaviour
from vehest_papers.ksnn.candidates import category_of, runs_of
from vehest_papers.ksnn.comparing import METRICS
from vehest_papers.ksnn.schemes import CANDIDATES, Scheme

BAND_POWER = re.compile(r"band_power_(\d+)(?:_(\d+))?_hz")
CORRECTED = ", acceleration bias removed"
LOW_YAW_RATE = "rmse_vy_low_yaw_rate"
DOUBLED = re.compile(r"doubled_(\d+)")
CLOSED_FORM = "a direct search, a filter or a fixed function; nothing is learnt in epochs"
Comparison = tuple[str, str, str]  # part, test set, metric


def error_rows(
    claimed: Paper, parts: Mapping[str, Scheme], behaviours: Mapping[str, Behaviour]
) -> list[BlockRow]:
    """Errors of all candidates that claims and tables name, with those of the baselines.

    Parameters
    ----------
    parts
        Of the study, on common blocks.
    behaviours
        Part -> what its candidates do at little yaw rate, after a start and without biases.
    """
    rows = []
    for (name, test, metric), candidates in compared_candidates(claimed).items():
        schemes = [
            of_scheme
            for part, of_scheme in parts.items()
            if re.fullmatch(rf"{re.escape(name)}(_[a-z])?", part)
        ]
        for candidate in dict.fromkeys([*candidates, *BASELINES]):
            errors = [
                of_scheme
                for scheme in schemes
                if test in scheme.part.split.tests
                and (of_scheme := errors_of(scheme, behaviours, candidate, test, metric))
                is not None
            ]
            if errors:
                rows += _rows(name, candidate, test, metric, _joined(errors))
    return rows


def compared_candidates(claimed: Paper) -> dict[Comparison, list[str]]:
    """Part, test set and metric -> candidates whose errors claims and tables compare there."""
    compared: dict[Comparison, list[str]] = {}
    for claim in claimed.claims:
        if claim.kind in ("order", "equal", "limit"):
            for key in keys_of(claim):
                compared.setdefault((key.part, key.test_set, key.metric), []).append(key.candidate)
    for table in claimed.tables:
        for row in table.rows:
            compared.setdefault((table.part, table.test_set, row.metric), []).append(row.candidate)
    return compared


def errors_of(
    scheme: Scheme, behaviours: Mapping[str, Behaviour], candidate: str, test: str, metric: str
) -> BlockErrors | None:
    """Errors of one candidate; None where it is not there."""
    behaviour = behaviours.get(scheme.name)
    if band := BAND_POWER.fullmatch(metric):
        return _band_power(scheme, candidate, test, float(f"{band[1]}.{band[2] or 0}"))
    if metric in METRICS and not candidate.endswith(CORRECTED):
        key = scheme.key_of(candidate)
        errors = scheme.errors(test)
    elif behaviour is None or test != scheme.other_test:
        return None
    elif metric == LOW_YAW_RATE:
        key = CANDIDATES.get(candidate, candidate)
        errors = behaviour.low_yaw_rate
    else:
        key = candidate.removesuffix(CORRECTED)
        errors = behaviour.corrected
    return errors.block_errors(key, metric) if key in errors.segments else None


def _band_power(scheme: Scheme, candidate: str, test: str, hz: float) -> BlockErrors | None:
    models = scheme.models_of(scheme.key_of(candidate))
    band = int(np.argmin(np.abs(np.log(np.array(measures.BANDS_HZ) / hz))))
    powers = [measures.band_powers(scheme, model, test) for model in models]
    if not powers or not powers[0][0]:
        return None
    names = tuple(powers[0][0])
    sums = np.stack([values[:, band] for _, values in powers])
    return BlockErrors(tuple(str(model.seed) for model in models), names, sums, np.ones(len(names)))


def _joined(errors: Sequence[BlockErrors]) -> BlockErrors:
    """Several trainings on parts of the same recordings as seeds of one candidate."""
    first = errors[0]
    if len(errors) == 1:
        return first
    sums = np.concatenate([of_part.sums for of_part in errors])
    return BlockErrors(tuple(map(str, range(len(sums)))), first.blocks, sums, first.sizes)


def _rows(part: str, candidate: str, test: str, metric: str, errors: BlockErrors) -> list[BlockRow]:
    rows = []
    for seed, sums in zip(errors.seeds, errors.sums, strict=True):
        head = BlockRow(part, candidate, int(seed), test, metric)
        rows += block_rows(head, errors.blocks, sums, errors.sizes)
    return rows


def measured_rows(claimed: Paper, parts: Mapping[str, Scheme]) -> list[BlockRow]:
    """Values of claims that need a measurement of their own; the metric is the claim's id."""
    rows = []
    for claim in claimed.claims:
        is_computed = claimed.parts.get(claim.part) == "computed"
        if claim.kind != "measured" or not (is_computed or claim.part in parts):
            continue
        assert claim.measure is not None
        measured = getattr(measures, claim.measure.rpartition(":")[2])(claim, parts)
        if measured is None:
            continue
        for seed, values in enumerate(measured.values):
            head = BlockRow(claim.part, claim.candidate or "-", seed, claim.test_set, claim.id)
            rows += block_rows(head, measured.blocks, values, 1.0)
    return rows


def training_rows(
    claimed: Paper, parts: Mapping[str, PartArtefacts], schemes: Mapping[str, Scheme]
) -> list[TrainingRow]:
    """How far every candidate was trained, and whether twice the epochs are better.

    Parameters
    ----------
    parts
        Of the study, of which ``doubled_NN`` are trained twice as long as ``pair_NN_converged``.
    schemes
        Those that are no pairs of drawn cars.
    """
    validation, doubled = _validation_errors(parts)
    rows = []
    for candidate in claimed.candidates:
        trained_as = candidate.removesuffix(CORRECTED)
        models = [
            model
            for scheme in schemes.values()
            for model in scheme.models_of(scheme.key_of(trained_as))
        ]
        category = trained_as.split(",")[0]
        models += [
            model
            for name, part in parts.items()
            if not DOUBLED.fullmatch(name)
            for model in part.models
            if category_of(model.estimator, model.variant) == category
        ]
        budgets = sorted(
            {
                epochs_of_seeds
                for model in models
                if (epochs_of_seeds := _most_epochs(model.training))
            }
        )
        if not models:
            continue
        if candidate in BASELINES or not budgets:
            rows.append(TrainingRow(candidate, "", "", "not applicable", CLOSED_FORM))
            continue
        words = f"{budgets[-1]} at most"
        stops = [_epochs(scheme, trained_as) for scheme in schemes.values()]
        if any(len(epochs_of_seeds) for epochs_of_seeds in stops):
            epochs = np.concatenate(stops)
            words += f", {epochs.min():.0f} to {epochs.max():.0f} by early stopping"
        rows.append(
            checked_training(
                candidate,
                words,
                claimed.epochs_of(candidate),
                validation.get(category, {}),
                doubled.get(category, {}),
            )
        )
    return rows


def _validation_errors(
    parts: Mapping[str, PartArtefacts],
) -> tuple[dict[str, dict[int, float]], dict[str, dict[int, float]]]:
    """Category -> pair -> RMSE of v on validation, converged and with twice the epochs."""
    errors: tuple[dict[str, dict[int, float]], ...] = ({}, {})
    for name, part in parts.items():
        match = DOUBLED.fullmatch(name)
        converged = f"pair_{match[1]}_converged" if match else ""
        if match is None or converged not in parts:
            continue
        for by_category, trained_part in zip(errors, (parts[converged], part), strict=True):
            for run in runs_of(trained_part).to_dict("records"):
                value = float(run[f"rmse_vy.{VALIDATION}"])
                by_category.setdefault(str(run["category"]), {})[int(match[1])] = value
    return errors[0], errors[1]


def _most_epochs(training: Mapping[str, Any]) -> int:
    """Largest number of epochs, as configured; 0 where nothing is trained in epochs."""
    return int(training.get("phase", training).get("max_epochs") or 0)


def _epochs(scheme: Scheme, candidate: str) -> FloatArray:
    runs = scheme.runs
    is_candidate = runs["estimator"] + "/" + runs["variant"] == scheme.key_of(candidate)
    return np.asarray(runs[is_candidate]["epochs"], dtype=np.float64)
