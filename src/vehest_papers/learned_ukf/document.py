"""The report: claims judged by the engine, Tables I and II, friction, bands and what training through the filter changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from vehest.data.errors import DataError
from vehest.report.document import REPORT, Block, Document, as_text
from vehest.report.style import fixed, listed
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts, StudyArtefacts
from vehest_papers.kit.block_errors import BlockErrors, Key, blocks_of
from vehest_papers.kit.block_rows import BLOCKS, TRAINING, BlockRow, TrainingRow, frame
from vehest_papers.kit.claim_files import Paper, claims_of
from vehest_papers.kit.methods import absent_parts
from vehest_papers.kit.reading import words_of_kinds
from vehest_papers.kit.report_template import fill_template
from vehest_papers.kit.verdict_table import claims_table, one_line
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
from vehest_papers.learned_ukf.appendix import appendix_of_part, how_it_was_made, minutes
from vehest_papers.learned_ukf.budgets import Candidate, budgets_table
from vehest_papers.learned_ukf.candidates import SETS, chosen, models_by_candidate, runs_of
from vehest_papers.learned_ukf.filtering import drives_of, loaded, lost_sequences
from vehest_papers.learned_ukf.lengths import figure_7, lengths

NAME = "learned_ukf"  # of the paper's package
TEMPLATE = Path(__file__).with_name("report.md.j2")
MAIN = "real"
LIKELIHOOD = "likelihood"
SCRATCH = "scratch"
LENGTH = "length_"
VARIANTS = ("diagonal", SCRATCH, "curvature")  # parts with a variant of a candidate
ROMAN = {"tyre_a": "I", "tyre_d": "II"}
SHOWN_FIRST = (paper.NNTF_UH, paper.NNTF, paper.NN_U, paper.PC, paper.GRU, paper.LSTM, "zero")
SHOWN_IN_FIGURE_4 = (paper.NNTF_UH, paper.NNTF_UH_LOW, paper.GRU)


@dataclass
class Outcome:
    """What the main part gives to the report."""

    front: list[Block] = field(default_factory=list)
    appendix: list[Block] = field(default_factory=list)
    rows: list[BlockRow] = field(default_factory=list)


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report of the study; candidates that are not trained yet are named, and claims on them not assessed.

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
            f"study '{artefacts.study}': the test sets of part '{MAIN}' must be called {' and '.join(SETS)}"
        )
    content = claims_of(NAME)
    data: dict[str, pd.DataFrame] = {}
    rows = block_errors.error_rows(artefacts.parts)
    outcome = _outcome(MAIN, part, artefacts, blocks_of(rows), data)
    rows += [*outcome.rows, *block_errors.rise_rows(MAIN, part, rows)]
    if SCRATCH in artefacts.parts:
        rows += block_errors.scratch_rows(SCRATCH, artefacts.parts[SCRATCH], part)
    trained = block_errors.training_rows(artefacts.parts, MAIN)
    kinds = {
        block_errors.part_name(name): words_of_kinds(own) for name, own in artefacts.parts.items()
    }
    claims = claims_table(content, rows, trained, kinds)
    values = _values(artefacts, part, content, rows)
    blocks = [
        *fill_template(TEMPLATE, values, [*outcome.front, claims]),
        *outcome.appendix,
        *how_it_was_made(artefacts, {MAIN: part}, data),
    ]
    data |= {BLOCKS: frame(rows, BlockRow), TRAINING: frame(trained, TrainingRow)}
    return {REPORT: Document(artefacts.title, blocks, data)}


def _values(
    artefacts: StudyArtefacts, part: PartArtefacts, content: Paper, rows: Sequence[BlockRow]
) -> dict[str, object]:
    """Numbers and names that the template has places for."""
    blocks = blocks_of(rows)
    main_rows = [
        {"name": name} | {test: tables.mse_text(blocks, MAIN, name, test) for test in SETS}
        for name in SHOWN_FIRST
    ]
    return {
        "recommendation": one_line(content.recommendation),
        "kind": words_of_kinds(part).upper(),
        "minutes": fixed(minutes(part, part.split.train), 1),
        "minutes_paper": fixed(paper.MINUTES_LEARNT, 1),
        "main_rows": main_rows,
        "authors": {test: fixed(value, 4) for test, value in paper.AUTHORS_CODE.items()},
        "absent_parts": absent_parts(artefacts),
        "missing": _missing(artefacts, content, rows),
    }


def _missing(artefacts: StudyArtefacts, content: Paper, rows: Sequence[BlockRow]) -> list[str]:
    """Candidates of the claims that are not trained yet, and trainings of the parts that are there."""
    scored = {row.candidate for row in rows}
    absent = [name for name in content.candidates if name not in scored]
    unfinished = [
        f"{artefacts.titles.get(name, name)} has {len(part.models)} of {len(part.models) + len(part.failed)}"
        for name, part in artefacts.parts.items()
        if part.failed
    ]
    lines = []
    if absent:
        lines.append(
            f"**Not trained yet, so that claims on them are not assessed:** {'; '.join(absent)}."
        )
    if unfinished:
        lines.append(f"Trainings that are there: {'; '.join(unfinished)}.")
    return lines


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
    where = f"{kind.upper()}, {listed([as_text(part.data_titles.get(dataset, dataset)) for dataset in part.split.datasets])}"
    own = Outcome()
    _accuracy(own, name, blocks, kind)
    _friction(own, name, part, where, kind)
    _instability(own, name, part)
    beside = {
        title: other for title, other in artefacts.parts.items() if words_of_kinds(other) == kind
    }
    _likelihood(own, name, part, beside, kind)
    _prediction(own, name, part, where, data)
    _variants(own, name, part, beside, kind)
    _lengths(own, beside, blocks, kind)
    groups = models_by_candidate(part)
    shown: dict[str, EvaluatedModel] = {
        method: chosen(part, runs, method) for method in SHOWN_IN_FIGURE_4 if method in groups
    }
    if shown:
        figure, drawn = traces.hard_sequence(part, shown, "tyre_d", name, where)
        data[f"traces_{name}"] = drawn
        own.front.append(figure)
    own.appendix += appendix_of_part(name, part, runs, where, data)
    return own


def _accuracy(own: Outcome, name: str, blocks: Mapping[Key, BlockErrors], kind: str) -> None:
    own.front.append(tables.overview(blocks, name, kind))
    own.appendix.append(f"## Appendix: Tables I and II, {kind}")
    for test, tyre in SETS.items():
        which = (
            "which was trained on"
            if test == "tyre_a"
            else "unseen; the paper's are of tyre C and do not compare"
        )
        caption = (
            f"Table {ROMAN[test]} of the paper: {tyre}, {which}. Ours: {kind.upper()}, means over seeds, 95 % intervals over sequences "
            "and seeds; the 99th percentile is that of each sequence, averaged. Baselines take vx from the rims and the yaw rate from the "
            "gyroscope."
        )
        table = f"table_{1 if test == 'tyre_a' else 2}_{name}"
        own.appendix.append(tables.accuracy(blocks, name, test, table, caption))


def _friction(own: Outcome, name: str, part: PartArtefacts, where: str, kind: str) -> None:
    """Friction over time, what is measured of it, and what its start changes."""
    models = models_by_candidate(part).get(paper.NNTF_UH)
    if not models:
        return
    filters = [loaded(model) for model in models]
    drives = {test: drives_of(part, filters[0], test) for test in SETS}
    tracks = {
        test: {start: friction.tracks_of(filters, own_drives, start) for start in friction.STARTS}
        for test, own_drives in drives.items()
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
    own.rows += block_errors.measured_rows(name, part, "tyre_d", measured, seeds)
    own.front += [
        friction.figure(tracks, part.protocol.skip_seconds, name, where),
        friction.convergence_table(tracks, times, name, kind.upper()),
    ]
    own.appendix += [
        f"## Appendix: the start of the friction, {kind}",
        friction.start_table(filters, drives, part.protocol, name, kind.upper()),
    ]


def _instability(own: Outcome, name: str, part: PartArtefacts) -> None:
    claim = {paper.NNT: "nnt_becomes_unstable", paper.NNT_U: "nnt_u_becomes_unstable"}
    for method, models in models_by_candidate(part).items():
        if method not in claim:
            continue
        filters = [loaded(model) for model in models]
        drives = drives_of(part, filters[0], "tyre_d")
        of_seeds = np.array([lost_sequences(estimator, drives) for estimator in filters])
        measured = {(claim[method], method): of_seeds.astype(np.float64)}
        seeds = [model.seed for model in models]
        own.rows += block_errors.measured_rows(name, part, "tyre_d", measured, seeds)


def _variants(
    own: Outcome, name: str, part: PartArtefacts, beside: Mapping[str, PartArtefacts], kind: str
) -> None:
    """What the variants of a candidate were trained on, with the candidates that they are compared with."""
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
    own.appendix += [
        "## Appendix: variants",
        budgets_table(compared | variants, name, kind.upper()),
    ]


def _lengths(
    own: Outcome,
    beside: Mapping[str, PartArtefacts],
    blocks: Mapping[Key, BlockErrors],
    kind: str,
) -> None:
    trained = {title: other for title, other in beside.items() if title.startswith(LENGTH)}
    if trained:
        own.appendix += [
            "## Appendix: length of the training sequences",
            *figure_7(lengths(trained), blocks, kind.upper()),
        ]


def _likelihood(
    own: Outcome, name: str, part: PartArtefacts, beside: Mapping[str, PartArtefacts], kind: str
) -> None:
    if LIKELIHOOD not in beside:
        return
    trained = {
        words: (which, models_by_candidate(which)[paper.NNTF_UH])
        for words, which in (("squared errors", part), ("with likelihood", beside[LIKELIHOOD]))
        if paper.NNTF_UH in models_by_candidate(which)
    }
    if trained:
        own.appendix += [
            "## Appendix: bands",
            coverage.coverage_table(trained, paper.NNTF_UH, name, kind.upper()),
        ]


def _prediction(
    own: Outcome,
    name: str,
    part: PartArtefacts,
    where: str,
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
    found = prediction.compared(pairs, drives, part.protocol)
    states, swaps = prediction.frames(found, seeds)
    own.rows += block_errors.prediction_rows(name, part, found, drives, seeds)
    data |= {f"figure_5_{name}": states, f"figure_6_{name}": swaps}
    own.appendix += [
        "## Appendix: what training through the filter changes",
        prediction.figure_5(states, name, where),
        prediction.figure_6(swaps, name, where),
    ]
