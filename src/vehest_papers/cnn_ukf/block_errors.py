"""Errors of every candidate by manoeuvre and seed, and how far each was trained: blocks.csv and
training.csv.

A block is a manoeuvre, or a group of manoeuvres where a claim counts groups.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.studies.artefacts import EvaluatedModel
from vehest_papers.cnn_ukf import measures, paper
from vehest_papers.cnn_ukf.indicators import (
    AT_PEAK,
    ME,
    ME_NL,
    MSE,
    MSE_NL,
    VARIANCE_NL,
    ManoeuvreErrors,
)
from vehest_papers.cnn_ukf.limited import Limited
from vehest_papers.cnn_ukf.manoeuvres import GROUPS, kpis
from vehest_papers.cnn_ukf.networks import Outputs
from vehest_papers.cnn_ukf.perturbed import NOMINAL, Perturbed
from vehest_papers.cnn_ukf.subjects import TEST, Runs, name_in
from vehest_papers.kit.block_rows import (
    BASELINE_NAMES,
    BlockRow,
    TrainingRow,
    checked_training,
    name_in_blocks,
    seed_rows,
)
from vehest_papers.kit.claim_files import Paper

DOUBLED = "doubled"  # part with twice the epochs
FULL = "full"
LIMITED = "limited"
METRICS = {
    "mse_sideslip": MSE,
    "mse_sideslip_nonlinear": MSE_NL,
    "max_error_sideslip": ME,
    "max_error_sideslip_nonlinear": ME_NL,
    "variance_sideslip_nonlinear": VARIANCE_NL,
    "error_at_peak_sideslip": AT_PEAK,
}
"""Metric of claims.yaml -> indicator."""
PSEUDO = "mse_pseudo_measurement"
GROUP_OF_TEST = {TEST: ""} | {f"{TEST}_{name}": group for name, group in GROUPS.items()}
"""Test set of claims.yaml -> group of manoeuvres."""
PHASES = ("phase", "pre_training", "end_to_end")


def error_rows(parts: Mapping[str, Runs], learnt: Limited | None, content: Paper) -> list[BlockRow]:
    """Errors of every candidate that the claims and tables name, in the metrics that they name.

    Parameters
    ----------
    parts
        Part -> its candidates.
    learnt
        Of part ``limited``, which has the filters of the full set as well.
    content
        Claims and tables of the paper.
    """
    rows = []
    comparisons = content.metrics()
    for part, runs in parts.items():
        compared = learnt.compared if part == LIMITED and learnt is not None else runs
        declared = {name_in_blocks(name_in(part, name)): name for name in compared}
        errors = ManoeuvreErrors(compared)
        for name, candidate in declared.items():
            if name not in content.candidates:
                continue
            for of_part, test_set, metric in comparisons:
                if of_part != part or metric not in METRICS:
                    continue
                of_candidate = errors.errors(candidate, METRICS[metric], GROUP_OF_TEST[test_set])
                head = BlockRow(part, name, 0, test_set, metric)
                rows += seed_rows(
                    head,
                    errors.seeds(candidate),
                    of_candidate.blocks,
                    of_candidate.sums,
                    of_candidate.sizes,
                )
    if learnt is not None:
        rows += _pseudo_measurement_rows(learnt)
    return rows


def _pseudo_measurement_rows(learnt: Limited) -> list[BlockRow]:
    """Squared errors of the sideslip angle that the hybrids' networks give."""
    rows = []
    for candidate, seeds in learnt.outputs.items():
        squares, sizes = network_squares(seeds)
        head = BlockRow(LIMITED, candidate, 0, TEST, PSEUDO)
        names = learnt.comparison.manoeuvres
        rows += seed_rows(head, learnt.comparison.seeds(candidate), names, squares, sizes)
    return rows


def network_squares(outputs: Sequence[Sequence[Outputs]]) -> tuple[FloatArray, FloatArray]:
    """Sums of the squared errors of β_DD by seed and manoeuvre.

    Parameters
    ----------
    outputs
        Outputs of a hybrid's network, seed by seed, manoeuvre by manoeuvre.

    Returns
    -------
    tuple of array
        Sums (S, M) [deg²] and samples of each manoeuvre (M,).
    """
    sums = np.array(
        [[float(np.square(manoeuvre.error).sum()) for manoeuvre in seed] for seed in outputs]
    )
    return sums, np.array([float(len(manoeuvre.error)) for manoeuvre in outputs[0]])


def measured_rows(
    main: ManoeuvreErrors,
    outputs: Mapping[str, Sequence[Sequence[Outputs]]],
    perturbed: Perturbed,
    table: pd.DataFrame,
) -> list[BlockRow]:
    """Values of the claims that measure something else than an error.

    Parameters
    ----------
    main
        Candidates of the full set.
    outputs
        Hybrid -> outputs of its networks, seed by seed, manoeuvre by manoeuvre.
    perturbed
        Filters with wrong stiffnesses.
    table
        Of `observability.local`; empty where the smooth filter is not fitted.
    """
    rows = _rows_among_four(main) if all(name in main for name in paper.OF_FOUR) else []
    by_claim = {}
    if paper.DEEP in outputs:
        deep = outputs[paper.DEEP]
        by_claim["de_ukf_distrust_grows_with_error", paper.DEEP] = measures.distrust_correlations(
            deep
        )
    if paper.CNN in outputs:
        cnn = outputs[paper.CNN]
        of_network = {
            "cnn_ukf_distrust_grows_with_error": measures.distrust_correlations(cnn),
            "yaw_rate_noise_grows_with_sideslip": measures.yaw_rate_noise_rises(cnn),
            "lateral_velocity_noise_grows_with_nonlinearity": (
                measures.lateral_velocity_noise_rises(cnn)
            ),
        }
        if paper.DEEP in outputs:
            of_network["cnn_ukf_distrust_spans_more_decades"] = measures.distrust_decades_ratios(
                cnn, outputs[paper.DEEP]
            )
        by_claim |= {(claim, paper.CNN): values for claim, values in of_network.items()}
    conditions = [ManoeuvreErrors(runs) for runs in perturbed.stiffness if runs]
    trained = perturbed.stiffness[NOMINAL]
    for claim, candidate, reference in (
        ("de_ukf_less_sensitive_to_stiffness_than_model", paper.DEEP, paper.MODEL),
        ("cnn_ukf_less_sensitive_to_stiffness_than_model", paper.CNN, paper.MODEL),
        ("de_ukf_less_sensitive_to_stiffness_than_cnn_ukf", paper.DEEP, paper.CNN),
    ):
        if candidate in trained and reference in trained:
            by_claim[claim, candidate] = measures.stiffness_rise_differences(
                conditions, conditions[NOMINAL], candidate, reference
            )
    if all(name in trained for name in paper.HYBRIDS):
        by_claim["cnn_ukf_below_de_ukf_at_all_stiffnesses", paper.CNN] = (
            measures.largest_ratios_over_stiffnesses(conditions, paper.CNN, paper.DEEP)
        )
    for (claim, candidate), values in by_claim.items():
        head = BlockRow(FULL, candidate, 0, TEST, claim)
        rows += seed_rows(head, range(len(values)), main.manoeuvres, values)
    turns = (
        ("observable_while_steering", "steady_turns", False),
        ("unobservable_at_zero_steering", "straights", True),
    )
    for claim, test_set, is_straight in turns if len(table) else ():
        names, values = measures.ranks(table, is_straight)
        head = BlockRow("observability", "-", 0, test_set, claim)
        rows += seed_rows(head, [0], names, values)
    return rows


def _rows_among_four(main: ManoeuvreErrors) -> list[BlockRow]:
    """CNN-UKF, and zero in its place, against the other three methods of Table II."""
    rivals = [name for name in paper.OF_FOUR if name != paper.CNN]
    rows = []
    for candidate in (paper.CNN, *(name for name in BASELINE_NAMES if name in main)):
        named = name_in_blocks(candidate)
        values = measures.mean_error_over_least_of_others(main, candidate, rivals)
        head = BlockRow(FULL, named, 0, TEST, "cnn_ukf_mean_error_nearest_zero")
        rows += seed_rows(head, range(len(values)), main.manoeuvres, values)
        groups, values = measures.is_best_in_group(main, candidate, rivals)
        rows += seed_rows(
            replace(head, metric="cnn_ukf_best_in_most_groups"), range(len(values)), groups, values
        )
    return rows


def training_rows(
    parts: Mapping[str, Runs], content: Paper, *, is_complete: bool = True
) -> list[TrainingRow]:
    """How far every candidate was trained; those of the full set are checked by a part with twice
    the epochs.

    Parameters
    ----------
    parts
        Part -> its candidates; the part `DOUBLED` has the trainings with twice the epochs, which
        are no candidates of their own.
    content
        Candidates of the paper, with its epochs; others have no row.
    is_complete
        Whether all planned trainings are done; else candidates without a training are rows as well.
    """
    doubled = _validation(parts.get(DOUBLED, {}))
    rows: dict[str, TrainingRow] = {}
    for part, runs in parts.items():
        if part == DOUBLED:
            continue
        errors = _validation(runs)
        for candidate, seeds in runs.items():
            named = name_in_blocks(name_in(part, candidate))
            if named in rows or named not in content.candidates:
                continue
            epochs = epochs_of(seeds[0].model)
            if not epochs:
                rows[named] = TrainingRow(
                    named, "", "", "not applicable", "nothing is learnt in epochs"
                )
                continue
            twice = doubled.get(candidate, {}) if part == FULL else {}
            rows[named] = checked_training(
                named,
                epochs,
                content.epochs_of(named),
                errors[candidate],
                twice,
            )
    if paper.FULL_SCALING in content.candidates and paper.DEEP in rows:
        rows[paper.FULL_SCALING] = replace(rows[paper.DEEP], candidate=paper.FULL_SCALING)
    not_trained = [] if is_complete else [name for name in content.candidates if name not in rows]
    for name in not_trained:
        rows[name] = TrainingRow(
            name, "", content.epochs_of(name), "not trained", "no seed is trained yet"
        )
    return list(rows.values())


def epochs_of(model: EvaluatedModel) -> str:
    """Epochs of each phase, as configured; empty where nothing is trained in epochs."""
    if model.estimator in BASELINE_NAMES.values():
        return ""
    phases = [model.training[phase] for phase in PHASES if phase in model.training]
    return " + ".join(str(phase["max_epochs"]) for phase in phases)


def _validation(runs: Runs) -> dict[str, dict[int, float]]:
    """Candidate -> seed -> MSE on the validation manoeuvres [deg²]."""
    return {
        candidate: {run.model.seed: kpis(run.validation).mse for run in seeds}
        for candidate, seeds in runs.items()
    }
