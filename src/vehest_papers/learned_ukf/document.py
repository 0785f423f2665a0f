"""The report: claims judged by the engine, Tables I and II, friction, bands and what training
through the filter changes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from vehest.data.errors import DataError
from vehest.report.document import REPORT, Block, Document, as_text
from vehest.report.style import MISSING, fixed, listed
from vehest.report.template import fill_template
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts, StudyArtefacts
from vehest_papers.kit.block_errors import BlockErrors, Key, blocks_of
from vehest_papers.kit.block_rows import (
    BASELINE_NAMES,
    BlockRow,
    TrainingRow,
)
from vehest_papers.kit.claim_files import Paper, claims_of
from vehest_papers.kit.loss_curves import NAME as LOSS_CURVES
from vehest_papers.kit.loss_curves import loss_curves, loss_figure
from vehest_papers.kit.methods import absent_parts
from vehest_papers.kit.reading import words_of_kinds
from vehest_papers.kit.verdict_table import (
    claim_files,
    claims_table,
    decided_claims,
    figure_in_words,
    without_line_breaks,
)
from vehest_papers.kit.verdicts import paired_errors, ratio_of
from vehest_papers.learned_ukf import (
    block_errors,
    coverage,
    friction,
    measures,
    paper,
    prediction,
    tables,
    traces,
)
from vehest_papers.learned_ukf.appendix import appendix_of_part, minutes, provenance
from vehest_papers.learned_ukf.budgets import Candidate, budgets
from vehest_papers.learned_ukf.candidates import SETS, chosen, models_by_candidate, runs_of
from vehest_papers.learned_ukf.data_amount import data_table
from vehest_papers.learned_ukf.filtering import drives_of, loaded, lost_sequences
from vehest_papers.learned_ukf.lengths import figure_7, lengths

NAME = "learned_ukf"  # of the paper's package
TEMPLATE = Path(__file__).with_name("report.md.j2")
MAIN = "real"
LENGTH = "length_"
VARIANTS = ("diagonal", block_errors.SCRATCH, "curvature")  # parts with a variant of a candidate
COMPARED_FIRST = (paper.GRU, paper.NNTF)  # with NNTF_UH, in the answer
OVERVIEW_CANDIDATES = (
    paper.NNTF_UH,
    paper.NNTF,
    paper.NN_U,
    paper.PC,
    paper.GRU,
    paper.LSTM,
    *BASELINE_NAMES.values(),
)
FIGURE_4_CANDIDATES = (paper.NNTF_UH, paper.NNTF_UH_LOW, paper.GRU)


@dataclass
class Outcome:
    """What the main part gives to the report."""

    front: list[Block] = field(default_factory=list)
    appendix: list[Block] = field(default_factory=list)
    rows: list[BlockRow] = field(default_factory=list)


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report of the study; candidates that are not trained yet are named, and claims on them
    not assessed.

    Raises
    ------
    DataError
        No candidate of part ``real`` is there, its test sets are not ``tyre_a`` and ``tyre_d``, or
        metrics are missing.
    ConfigurationError
        The protocol cuts no sequences.
    """
    part = artefacts.parts.get(MAIN)
    if part is None:
        raise DataError(f"study '{artefacts.study}' needs the part '{MAIN}'")
    if set(part.split.tests) != set(SETS):
        raise DataError(
            f"study '{artefacts.study}': the test sets of part '{MAIN}' must be called "
            f"{' and '.join(SETS)}"
        )
    content = claims_of(NAME)
    data: dict[str, pd.DataFrame] = {}
    rows = block_errors.error_rows(artefacts.parts)
    outcome = _outcome(MAIN, part, artefacts, blocks_of(rows), data)
    rows += [*outcome.rows, *block_errors.rise_rows(MAIN, part, rows)]
    if block_errors.SCRATCH in artefacts.parts:
        scratch = artefacts.parts[block_errors.SCRATCH]
        rows += block_errors.scratch_rows(block_errors.SCRATCH, scratch, part)
    not_trained = block_errors.seeds_not_trained(artefacts.not_trained)
    trained = block_errors.training_rows(artefacts.parts, MAIN, not_trained)
    kinds = {
        block_errors.part_name(name): words_of_kinds(study_part)
        for name, study_part in artefacts.parts.items()
    }
    claims = claims_table(content, rows, trained, kinds)
    values = _values(artefacts, part, content, rows, trained)
    blocks = [
        *fill_template(TEMPLATE, values, [*outcome.front, decided_claims(claims)]),
        *outcome.appendix,
        *provenance(artefacts, {MAIN: part}, data),
    ]
    data |= claim_files(claims, rows, trained)
    return {REPORT: Document(artefacts.title, blocks, data)}


def _values(
    artefacts: StudyArtefacts,
    part: PartArtefacts,
    content: Paper,
    rows: Sequence[BlockRow],
    trained: Sequence[TrainingRow],
) -> dict[str, object]:
    """Numbers and names that the template has places for."""
    blocks = blocks_of(rows)
    seeds = {
        key.candidate: len(errors.seeds)
        for key, errors in blocks.items()
        if key.part == MAIN and key.metric == "mse_weighted"
    }
    main_rows = [
        {"name": name, "seeds": seeds[name]}
        | {test: tables.mse_text(blocks, MAIN, name, test) for test in SETS}
        for name in OVERVIEW_CANDIDATES
        if name in seeds
    ]
    titles = [as_text(part.data_titles.get(name, name)) for name in part.split.datasets]
    return {
        "recommendation": without_line_breaks(content.recommendation),
        "data": f"{words_of_kinds(part).upper()} data, {listed(titles)}",
        "minutes": fixed(minutes(part, part.split.train), 1),
        "minutes_paper": fixed(paper.MINUTES_LEARNT, 1),
        "main_rows": main_rows,
        "authors": {test: fixed(value, 4) for test, value in paper.AUTHORS_CODE.items()},
        "absent_parts": absent_parts(artefacts),
        "ratios": {
            reference: {test: _ratio(blocks, reference, test) for test in SETS}
            for reference in COMPARED_FIRST
        },
        "incomplete": _incomplete(artefacts, trained),
    }


def _ratio(blocks: Mapping[Key, BlockErrors], reference: str, test: str) -> str:
    """Weighted MSE of NNTF_UH over that of another with its interval; a dash where one is not
    trained.
    """
    first, second = (
        blocks.get(Key(MAIN, name, test, "mse_weighted")) for name in (paper.NNTF_UH, reference)
    )
    if first is None or second is None:
        return MISSING
    return figure_in_words(ratio_of(paired_errors(first, second, "mse_weighted", test)))


def _incomplete(
    artefacts: StudyArtefacts, trained: Sequence[TrainingRow]
) -> list[dict[str, object]]:
    """What the template says of trainings that are planned and not done: one entry, or none."""
    number = sum(len(names) for names in artefacts.not_trained.values())
    if not number:
        return []
    n_missing = block_errors.seeds_not_trained(artefacts.not_trained)
    fewer = [
        f"{row.candidate} {row.seeds_planned - n_missing[row.candidate]} of {row.seeds_planned}"
        for row in trained
        if row.seeds_planned and row.training != "not trained"
    ]
    not_trained = [row.candidate for row in trained if row.training == "not trained"]
    parts = [name for name in artefacts.titles if name not in artefacts.parts]
    return [
        {
            "number": number,
            "fewer": "; ".join(fewer) or MISSING,
            "candidates": "; ".join(not_trained) or MISSING,
            "parts": sum(name in artefacts.not_trained for name in parts),
        }
    ]


def _outcome(
    name: str,
    part: PartArtefacts,
    artefacts: StudyArtefacts,
    blocks: Mapping[Key, BlockErrors],
    data: dict[str, pd.DataFrame],
) -> Outcome:
    """Everything of the main part and of those beside it on data of the same kind."""
    runs = runs_of(part)
    kind = words_of_kinds(part)
    outcome = Outcome()
    _accuracy(outcome, name, blocks, kind, data)
    _friction(outcome, name, part, kind)
    _instability(outcome, name, artefacts.parts, data)
    beside = {
        title: study_part
        for title, study_part in artefacts.parts.items()
        if words_of_kinds(study_part) == kind
    }
    _likelihood(outcome, name, part, beside, kind)
    _prediction(outcome, name, part, kind.upper(), data)
    _variants(name, part, beside, data)
    _lengths(outcome, beside, blocks, kind, data)
    _data_amount(outcome, name, part, beside, blocks, kind)
    groups = models_by_candidate(part)
    drawn_models: dict[str, EvaluatedModel] = {
        method: chosen(part, runs, method) for method in FIGURE_4_CANDIDATES if method in groups
    }
    if drawn_models:
        figure, drawn = traces.hard_sequence(part, drawn_models, "tyre_d", name, kind.upper())
        data[f"traces_{name}"] = drawn
        outcome.front.append(figure)
    losses = loss_curves(groups)
    data[LOSS_CURVES] = losses
    if len(losses):
        caption = (
            "Losses of the longest phase of each method's first seed, scaled. Data: "
            f"{kind.upper()}."
        )
        outcome.appendix += ["## Appendix: loss curves", loss_figure(losses, caption)]
    outcome.appendix += appendix_of_part(name, part, runs, data)
    return outcome


def _accuracy(
    outcome: Outcome,
    name: str,
    blocks: Mapping[Key, BlockErrors],
    kind: str,
    data: dict[str, pd.DataFrame],
) -> None:
    outcome.front.append(tables.overview(blocks, name, kind))
    for number, test in enumerate(SETS, start=1):
        data[f"table_{number}_{name}"] = tables.accuracy(blocks, name, test)


def _friction(outcome: Outcome, name: str, part: PartArtefacts, kind: str) -> None:
    """Friction over time, what is measured of it, and what its start changes."""
    models = models_by_candidate(part).get(paper.NNTF_UH)
    if not models:
        return
    filters = [loaded(model) for model in models]
    drives = {test: drives_of(part, filters[0], test) for test in SETS}
    tracks = {
        test: {start: friction.tracks_of(filters, of_test, start) for start in friction.STARTS}
        for test, of_test in drives.items()
    }
    times = {
        test: (
            measures.agreement_times(by_start),
            measures.agreement_times_in_deviations(by_start),
        )
        for test, by_start in tracks.items()
    }
    unseen = tracks["tyre_d"][friction.TRAINED_FROM]
    measured = {
        ("friction_settles_within_2_s", paper.NNTF_UH): times["tyre_d"][0],
        ("friction_agrees_within_a_deviation_in_2_s", paper.NNTF_UH): times["tyre_d"][1],
        ("friction_ends_near_nominal", paper.NNTF_UH): measures.final_deviations(
            unseen, paper.NOMINAL_FRICTION["tyre_d"]
        ),
    }
    seeds = [model.seed for model in models]
    outcome.rows += block_errors.measured_rows(name, part, "tyre_d", measured, seeds)
    outcome.front += [
        friction.figure(tracks, part.protocol.skip_seconds, name, kind.upper()),
        friction.convergence_table(tracks, times, part.protocol.skip_seconds, name, kind.upper()),
    ]
    outcome.appendix += [
        f"## Appendix: the start of the friction, {kind}",
        friction.start_table(filters, drives, part.protocol, name, kind.upper()),
    ]


def _instability(
    outcome: Outcome,
    name: str,
    parts: Mapping[str, PartArtefacts],
    data: dict[str, pd.DataFrame],
) -> None:
    """Sequences of tyre D whose covariance loses definiteness, with both starts of the noise; the
    main part decides the claims.
    """
    claim = {paper.NNT: "nnt_becomes_unstable", paper.NNT_U: "nnt_u_becomes_unstable"}
    shares = []
    for title in (name, block_errors.AUTHORS_NOISE):
        groups = models_by_candidate(parts[title]) if title in parts else {}
        for method, models in groups.items():
            if method not in claim:
                continue
            filters = [loaded(model) for model in models]
            drives = drives_of(parts[title], filters[0], "tyre_d")
            is_lost = np.array([lost_sequences(estimator, drives) for estimator in filters])
            shares += [
                {"part": title, "candidate": method, "seed": model.seed, "share_lost": float(lost)}
                for model, lost in zip(models, is_lost.mean(axis=1), strict=True)
            ]
            if title == name:
                measured = {(claim[method], method): is_lost.astype(np.float64)}
                seeds = [model.seed for model in models]
                outcome.rows += block_errors.measured_rows(
                    name, parts[name], "tyre_d", measured, seeds
                )
    if shares:
        data["unstable"] = pd.DataFrame(shares)


def _variants(
    name: str,
    part: PartArtefacts,
    beside: Mapping[str, PartArtefacts],
    data: dict[str, pd.DataFrame],
) -> None:
    """What the variants of a candidate were trained on, with the candidates that they are compared
    with.
    """
    groups = models_by_candidate(part)
    variants = {
        candidate: (beside[title], models)
        for title in VARIANTS
        if title in beside
        for candidate, models in models_by_candidate(beside[title]).items()
    }
    if not variants:
        return
    compared: dict[str, Candidate] = {
        title: (part, groups[title]) for title in (paper.NNTF_UH, paper.PC) if title in groups
    }
    data[f"budgets_{name}"] = budgets(compared | variants)


def _lengths(
    outcome: Outcome,
    beside: Mapping[str, PartArtefacts],
    blocks: Mapping[Key, BlockErrors],
    kind: str,
    data: dict[str, pd.DataFrame],
) -> None:
    trained = {
        title: study_part for title, study_part in beside.items() if title.startswith(LENGTH)
    }
    if trained:
        figure, data["sequence_length"] = figure_7(lengths(trained), blocks, kind.upper())
        outcome.appendix += ["## Appendix: length of the training sequences", figure]


def _data_amount(
    outcome: Outcome,
    name: str,
    part: PartArtefacts,
    beside: Mapping[str, PartArtefacts],
    blocks: Mapping[Key, BlockErrors],
    kind: str,
) -> None:
    shares = {
        title: study_part
        for title, study_part in beside.items()
        if block_errors.DATA_SHARE.fullmatch(title)
    }
    if shares and paper.NNTF_UH in models_by_candidate(part):
        outcome.appendix += [
            "## Appendix: minutes of training data",
            data_table({name: part, **shares}, blocks, kind.upper()),
        ]


def _likelihood(
    outcome: Outcome, name: str, part: PartArtefacts, beside: Mapping[str, PartArtefacts], kind: str
) -> None:
    if block_errors.LIKELIHOOD not in beside:
        return
    trained = {
        words: (study_part, models_by_candidate(study_part)[paper.NNTF_UH])
        for words, study_part in (
            ("squared errors", part),
            ("with likelihood", beside[block_errors.LIKELIHOOD]),
        )
        if paper.NNTF_UH in models_by_candidate(study_part)
    }
    if trained:
        outcome.appendix += [
            "## Appendix: bands",
            coverage.coverage_table(trained, paper.NNTF_UH, name, kind.upper()),
        ]


def _prediction(
    outcome: Outcome,
    name: str,
    part: PartArtefacts,
    source: str,
    data: dict[str, pd.DataFrame],
) -> None:
    groups = models_by_candidate(part)
    by_seed = [
        {model.seed: model for model in groups.get(method, [])}
        for method in (prediction.BEFORE, prediction.AFTER)
    ]
    seeds = sorted(set(by_seed[0]) & set(by_seed[1]))
    if not seeds:
        return
    pairs = {seed: (loaded(by_seed[0][seed]), loaded(by_seed[1][seed])) for seed in seeds}
    drives = {test: drives_of(part, pairs[seeds[0]][0], test) for test in SETS}
    comparisons = prediction.compared(pairs, drives, part.protocol)
    states, swaps = prediction.frames(comparisons, seeds)
    outcome.rows += block_errors.prediction_rows(name, part, comparisons, drives, seeds)
    data |= {f"figure_5_{name}": states, f"figure_6_{name}": swaps}
    outcome.appendix += [
        "## Appendix: what training through the filter changes",
        prediction.figure_5(states, name, source),
        prediction.figure_6(swaps, name, source),
    ]
