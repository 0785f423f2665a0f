"""Errors of every candidate, sequence by sequence and seed by seed, and how far each was trained:
blocks.csv and training.csv.

A block is a sequence of 10 s, as the paper scores it. The four folds over tyre A are one part,
``tyre_a_folds``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from vehest.constants import FloatArray
from vehest.data.splits import VALIDATION
from vehest.data.store import read_recording
from vehest.evaluation.metrics import WEIGHTS, Scored, pieces_of, weighted_errors
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest.training.through_filter import Drive
from vehest_papers.kit.block_errors import blocks_of
from vehest_papers.kit.block_rows import (
    BlockRow,
    TrainingRow,
    block_rows,
    checked_training,
    name_in_blocks,
    seed_rows,
)
from vehest_papers.kit.reading import metric_values, sideslip_error
from vehest_papers.learned_ukf import measures, paper
from vehest_papers.learned_ukf.candidates import (
    candidate_of_training,
    models_by_candidate,
    scored_of,
)
from vehest_papers.learned_ukf.filtering import MOVING
from vehest_papers.learned_ukf.prediction import AFTER, BEFORE, Compared

DOUBLED = "doubled"
FOLD = re.compile(r"(tyre_a_fold)_\d+")
LIKELIHOOD = "likelihood"
AUTHORS_NOISE = "given_noise"
DUPLICATE_NAMES = (
    DOUBLED,
    LIKELIHOOD,
    AUTHORS_NOISE,
)  # parts whose candidates have the names of others
SCRATCH = "scratch"
LENGTH = re.compile(r"length_(\d+)(_samples)?")
DATA_SHARE = re.compile(r"(half|quarter)_\d")
MAX_STEPS = 500  # samples of a sequence, which both ways of Figure 7 share
WHEEL_SPEED = {"rim_speed": "wheel_speed"}  # name of a state -> name in a metric
SWAPPED = f"{AFTER} predicting, {BEFORE} observing"


def part_name(name: str) -> str:
    """Part of the pipeline as blocks.csv has it."""
    fold = FOLD.fullmatch(name)
    return f"{fold[1]}s" if fold else name


def candidate_name(part: str, candidate: str) -> str:
    """Candidate of a part as blocks.csv has it: with the length of its training sequences, or its
    share of the training data, where parts differ in it.
    """
    if DATA_SHARE.fullmatch(part):
        return f"{candidate}, {part.replace('_', ' ')}"
    length = LENGTH.fullmatch(part)
    if length is None:
        return name_in_blocks(candidate)
    steps, by_samples = length.groups()
    if int(steps) == MAX_STEPS:
        return f"{candidate}, {steps} steps"
    return f"{candidate}, {steps} steps, constant {'samples' if by_samples else 'batch'}"


def losses_of(scored: Scored) -> Iterator[tuple[str, float, int]]:
    """Metric, sum of its loss over a sequence, and samples in the sum.

    The weighted losses of Tables I and II; squared errors of vx, vy [m²/s²], yaw rate [rad²/s²] and
    sideslip [deg²]. ``ae99_weighted`` is the sequence's 99th percentile times its samples.
    """
    samples = len(scored.vy)
    absolute = weighted_errors(scored, np.abs)
    yield "mse_weighted", float(weighted_errors(scored, np.square).sum()), samples
    yield "mae_weighted", float(absolute.sum()), samples
    yield "ae99_weighted", float(np.percentile(absolute, 99.0)) * samples, samples
    for name in WEIGHTS:
        yield f"rmse_{name}", float(np.square(scored.errors[name]).sum()), samples
    squares = np.square(sideslip_error(scored))[scored.is_sideslip_scored]
    yield "rmse_sideslip", float(squares.sum()), len(squares)


def sequence_names(part: PartArtefacts, test: str) -> list[str]:
    """Name of each sequence of a test set or the validation: its recording and first time."""
    pieces = pieces_of(
        part.split.validation if test == VALIDATION else part.split.tests[test],
        lambda span: read_recording(part.references[span.dataset, span.recording]),
        part.protocol,
    )
    return [
        f"{piece.recording} {max(piece.start, reference.start_time):.2f} s"
        for reference, piece in pieces
    ]


def error_rows(parts: Mapping[str, PartArtefacts]) -> list[BlockRow]:
    """Errors of every model on every sequence of its test sets."""
    rows = []
    for name, part in parts.items():
        names = {test: sequence_names(part, test) for test in part.split.tests}
        for candidate, models in models_by_candidate(part).items():
            for model, test in ((model, test) for model in models for test in names):
                for block, scored in zip(names[test], scored_of(part, model, test), strict=True):
                    rows += [
                        BlockRow(
                            part_name(name),
                            candidate_name(name, candidate),
                            model.seed,
                            test,
                            metric,
                            block,
                            value,
                            samples,
                        )
                        for metric, value, samples in losses_of(scored)
                    ]
    return rows


def prediction_rows(
    name: str,
    part: PartArtefacts,
    compared: Mapping[str, Compared],
    drives: Mapping[str, Drive],
    seeds: Sequence[int],
) -> list[BlockRow]:
    """Squared errors of one-step predictions, and the weighted loss of a filter that observes with
    another model than it predicts with.

    Parameters
    ----------
    name, part
        The part.
    compared
        Test set -> losses of both models.
    drives
        Test set -> its sequences, of T samples each.
    seeds
        Of the pairs of models.
    """
    rows = []
    skip = round(part.protocol.skip_seconds * part.protocol.rate_hz)
    for test, of_test in compared.items():
        names = sequence_names(part, test)
        samples = drives[test].states.shape[1]
        for place, seed in enumerate(seeds):
            for candidate, squares in zip((BEFORE, AFTER), of_test.one_step[:, place], strict=True):
                for k, state in enumerate(MOVING):
                    metric = f"one_step_rmse_{WHEEL_SPEED.get(state, state)}"
                    head = BlockRow(name, candidate, seed, test, metric)
                    rows += block_rows(head, names, (samples - 1) * squares[:, k], samples - 1)
            head = BlockRow(name, SWAPPED, seed, test, "mse_weighted")
            scored = samples - skip
            rows += block_rows(head, names, scored * of_test.swaps[1, 0][place], scored)
    return rows


def measured_rows(
    name: str,
    part: PartArtefacts,
    test: str,
    measured: Mapping[tuple[str, str], FloatArray],
    seeds: Sequence[int],
) -> list[BlockRow]:
    """Rows of the claims that are not comparisons of errors.

    Parameters
    ----------
    measured
        (id of the claim, candidate) -> value of each seed and sequence, (S, B).
    """
    names = sequence_names(part, test)
    rows = []
    for (claim, candidate), values in measured.items():
        head = BlockRow(name, candidate, 0, test, claim)
        rows += seed_rows(head, seeds, names, values)
    return rows


def scratch_rows(name: str, part: PartArtefacts, main: PartArtefacts) -> list[BlockRow]:
    """Validation losses of trainings from scratch over the highest of the pre-trained ones, by
    validation sequence.
    """
    (candidate,) = models_by_candidate(part)
    models_of_main = models_by_candidate(main).get(paper.NNTF_UH)
    if models_of_main is None:
        return []
    scratch, pre_trained = (
        np.array(
            [
                [
                    weighted_errors(piece, np.square).mean()
                    for piece in scored_of(of, model, VALIDATION)
                ]
                for model in models
            ]
        )
        for of, models in ((part, part.models), (main, models_of_main))
    )
    values = measures.validation_over_worst_pre_trained(scratch, pre_trained)
    measured = {("from_scratch_in_local_minima", candidate): values}
    seeds = [model.seed for model in part.models]
    return measured_rows(name, part, VALIDATION, measured, seeds)


def rise_rows(name: str, part: PartArtefacts, rows: Sequence[BlockRow]) -> list[BlockRow]:
    """Rise of the MSE of NNTF_UH on tyre D over that of the others, where all are trained."""
    values = measures.rise_over_least_rise_of_others(blocks_of(rows), name)
    if values is None:
        return []
    measured = {("nntf_uh_loses_least_on_unseen_tyre", paper.NNTF_UH): values}
    return measured_rows(name, part, "tyre_d", measured, range(len(values)))


def seeds_not_trained(not_trained: Mapping[str, Sequence[str]]) -> dict[str, int]:
    """Candidate as blocks.csv has it -> number of its trainings that are planned and not done.

    Those of `DUPLICATE_NAMES` and of folds belong to no candidate of their own.

    Parameters
    ----------
    not_trained
        Part of the pipeline -> names of its trainings.
    """
    counts: Counter[str] = Counter()
    for part, names in not_trained.items():
        if part in DUPLICATE_NAMES or FOLD.fullmatch(part):
            continue
        for name in names:
            from_scratch = paper.FROM_SCRATCH if part == SCRATCH else ""
            counts[candidate_name(part, candidate_of_training(name)) + from_scratch] += 1
    return dict(counts)


def training_rows(
    parts: Mapping[str, PartArtefacts], main: str, not_trained: Mapping[str, int]
) -> list[TrainingRow]:
    """How far every candidate was trained; those of the main part are checked by the part with
    twice the epochs.

    ``not_trained``: candidate -> number of its seeds that are not trained yet.
    """
    doubled = _validation(parts[DOUBLED]) if DOUBLED in parts else {}
    rows: dict[str, TrainingRow] = {}
    for name, part in parts.items():
        if name == DOUBLED or FOLD.fullmatch(name):
            continue
        errors = _validation(part)
        for candidate, models in models_by_candidate(part).items():
            named = candidate_name(name, candidate)
            if named in rows or candidate in paper.BASELINES:
                continue
            twice = doubled.get(_trained_as(candidate), {}) if name == main else {}
            row = checked_training(
                named, epochs_of(models[0]), paper.epochs(candidate), errors[candidate], twice
            )
            if named in not_trained:
                row = replace(row, seeds_planned=len(models) + not_trained[named])
            rows[named] = row
    for named, number in not_trained.items():
        if named not in rows:
            rows[named] = TrainingRow(
                named, "", paper.epochs(named), "not trained", "no seed is trained yet", number
            )
    for baseline in paper.BASELINES:
        named = name_in_blocks(baseline)
        rows[named] = TrainingRow(named, "", "", "not applicable", "nothing is learnt in epochs")
    return list(rows.values())


def epochs_of(model: EvaluatedModel) -> str:
    """Epochs of each phase, as configured."""
    training = model.training
    if "phase" in training:
        return str(training["phase"]["max_epochs"])
    phases = ["one_step", "through" if _learns_through(model) else "noise"]
    words = " + ".join(str(training[phase]["max_epochs"]) for phase in phases)
    return words if _learns_through(model) else f"{words} for the noise"


def _learns_through(model: EvaluatedModel) -> bool:
    """Whether the dynamics learn through the filter, by the subscript of the variant."""
    return re.search(r"_uh?(_|$)", model.variant) is not None


def _trained_as(candidate: str) -> str:
    """The candidate whose training it has: NNTF_UH* differs from NNTF_UH in use alone."""
    return paper.NNTF_UH if candidate == paper.NNTF_UH_LOW else candidate


def _validation(part: PartArtefacts) -> dict[str, dict[int, float]]:
    """Candidate -> seed -> weighted MSE on the validation range; baselines left out."""
    values = metric_values(part)
    return {
        candidate: {
            model.seed: values[
                model.estimator, model.variant, model.seed, VALIDATION, "mse_weighted"
            ]
            for model in models
        }
        for candidate, models in models_by_candidate(part).items()
        if candidate not in paper.BASELINES
    }
