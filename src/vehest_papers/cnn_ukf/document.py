"""The report: tables, figures and numbers of what is trained, for the places of its hand-written
template.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.estimators.model_files import load_model
from vehest.report.document import REPORT, Block, Column, Document, Table, as_code
from vehest.report.style import MISSING, fixed
from vehest.report.template import fill_template
from vehest.studies.artefacts import EvaluatedModel, StudyArtefacts
from vehest_papers.cnn_ukf import (
    block_errors,
    calibration,
    distributions,
    factorial,
    observability,
    paper,
    perturbed,
    tables,
    traces,
)
from vehest_papers.cnn_ukf.block_errors import DOUBLED, FULL, LIMITED
from vehest_papers.cnn_ukf.indicators import MSE, MSE_NL, ManoeuvreErrors
from vehest_papers.cnn_ukf.limited import Limited, limited
from vehest_papers.cnn_ukf.networks import oracles, outputs_of, shift_of
from vehest_papers.cnn_ukf.subjects import (
    KPIS,
    MAX_PAPER_SIDESLIP,
    TEST,
    Prepared,
    Run,
    Runs,
    chosen,
    filter_of,
    kpi_table,
    name_in,
    runs_of,
)
from vehest_papers.kit import methods
from vehest_papers.kit.block_rows import BlockRow, TrainingRow
from vehest_papers.kit.claim_files import Paper, claims_of
from vehest_papers.kit.loss_curves import NAME as LOSS_CURVES
from vehest_papers.kit.loss_curves import loss_curves, loss_figure
from vehest_papers.kit.reading import words_of_kinds
from vehest_papers.kit.verdict_table import (
    claim_files,
    claims_table,
    figure_in_words,
    without_line_breaks,
)
from vehest_papers.kit.verdicts import VERDICTS

NAME = "cnn_ukf"  # of the paper's package
TEMPLATE = Path(__file__).with_name("report.md.j2")
NOT_TRAINED = factorial.NOT_TRAINED
WITH_NETWORK = ("ensemble_ukf", "cnn_ukf")  # estimators
COMPARED = {
    "deep": paper.DEEP,
    "model": paper.MODEL,
    "data": paper.DATA,
    "smooth": paper.SMOOTH,
    "free": paper.FREE,
}
"""Place in the template -> with what CNN-UKF is compared there."""
FIGURE_CANDIDATES = (*paper.OF_FOUR, paper.SMOOTH, paper.FREE)
OVERVIEW_CANDIDATES = (
    paper.CNN,
    paper.DEEP,
    paper.DATA,
    paper.MODEL,
    paper.SMOOTH,
    paper.FREE,
    paper.STATIC_MAP,
    paper.ZERO,
)
FILTERS = (paper.MODEL, paper.SMOOTH, paper.FREE, paper.DEEP, paper.CNN)
ALONE = (paper.DATA, paper.RECURRENT, paper.STATIC_MAP, paper.ZERO)  # without a filter


@dataclass
class Outcome:
    """What the report is made from: blocks that the template places, tables that are files alone,
    errors by manoeuvre.
    """

    blocks: list[Block] = field(default_factory=list)
    data: dict[str, pd.DataFrame] = field(default_factory=dict)
    rows: list[BlockRow] = field(default_factory=list)


@dataclass(frozen=True)
class Subjects:
    """Candidates that are trained, with their test manoeuvres as the paper prepares them."""

    artefacts: StudyArtefacts
    prepared: Mapping[str, Prepared]  # by part
    parts: Mapping[str, Runs]  # by part
    runs: Runs  # of all parts on the full set, by unique names
    main: ManoeuvreErrors  # of `runs`
    within: Runs  # candidates of part ``full``, each drive until |β| first exceeds 12°
    kind: str  # of the data

    @property
    def full(self) -> Prepared:
        """Test manoeuvres of the full set."""
        return self.prepared[FULL]

    def among(self, names: Sequence[str]) -> dict[str, Sequence[Run]]:
        """Those of some candidates that are trained."""
        return {name: self.runs[name] for name in names if name in self.runs}

    def drawn(self, names: Sequence[str]) -> dict[str, Run]:
        """Of each the seed that validation chooses."""
        return {name: chosen(seeds) for name, seeds in self.among(names).items()}


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report of the study; candidates that are not trained yet are named, and claims on them
    not assessed.

    Raises
    ------
    DataError
        Part ``full`` is missing or has no model, or a test set is not called ``test``.
    """
    if FULL not in artefacts.parts or not artefacts.parts[FULL].models:
        raise DataError(f"study '{artefacts.study}' needs part '{FULL}'")
    for name, part in artefacts.parts.items():
        if set(part.split.tests) != {TEST}:
            raise DataError(
                f"study '{artefacts.study}': the test set of part '{name}' must be called {TEST}"
            )
    subjects = _subjects(artefacts)
    content = claims_of(NAME)
    outcome = Outcome()
    _accuracy(outcome, subjects)
    _hybrids(outcome, subjects, content)
    _manoeuvres(outcome, subjects)
    _files(outcome, subjects)
    trained = block_errors.training_rows(
        subjects.parts, content, is_complete=not artefacts.not_trained
    )
    claims = claims_table(content, outcome.rows, trained)
    outcome.blocks.append(_verdicts(claims))
    outcome.data |= claim_files(claims, outcome.rows, trained)
    values = _values(subjects, content, trained, sorted(outcome.data))
    blocks = fill_template(TEMPLATE, values, outcome.blocks)
    return {REPORT: Document(artefacts.title, blocks, outcome.data)}


def _verdicts(claims: Table) -> Table:
    """How many of the paper's claims, and of those added here, have which verdict."""
    counts = claims.frame["verdict"].value_counts()
    rows = [{"verdict": name, "claims": counts[name]} for name in VERDICTS if name in counts]
    columns = {"verdict": Column("verdict"), "claims": Column("claims", decimals=0)}
    return Table("verdicts", "Claims by verdict.", pd.DataFrame(rows), columns)


def _subjects(artefacts: StudyArtefacts) -> Subjects:
    read: dict[Path, Recording] = {}
    prepared = {name: Prepared(part, read=read) for name, part in artefacts.parts.items()}
    parts = {name: runs_of(part, prepared[name]) for name, part in artefacts.parts.items()}
    runs = _together(parts)
    runs |= oracles(runs, prepared[FULL])
    runs = {name: runs[name] for name in sorted(runs, key=_place)}
    kind = words_of_kinds(artefacts.parts[FULL]).upper()
    full = artefacts.parts[FULL]
    within = runs_of(full, Prepared(full, until_sideslip=MAX_PAPER_SIDESLIP, read=read))
    return Subjects(artefacts, prepared, parts, runs, ManoeuvreErrors(runs), within, kind)


def _place(candidate: str) -> int:
    return (
        paper.CANDIDATES.index(candidate)
        if candidate in paper.CANDIDATES
        else len(paper.CANDIDATES)
    )


def _together(parts: Mapping[str, Runs]) -> dict[str, Sequence[Run]]:
    """Candidates of all parts that were trained on the full set, by unique names."""
    runs: dict[str, Sequence[Run]] = {}
    for name, of_part in parts.items():
        if name not in (LIMITED, DOUBLED):
            runs |= {name_in(name, candidate): seeds for candidate, seeds in of_part.items()}
    return runs


def _accuracy(outcome: Outcome, subjects: Subjects) -> None:
    """Table II, its figures by car, errors within the paper's range, and networks and oracles
    beside it.
    """
    main = subjects.main
    in_table = subjects.among([name for name in paper.CANDIDATES if name not in tables.ORACLES])
    training = {
        name: tables.training_error(run, subjects.full)
        for name, run in subjects.drawn((*FIGURE_CANDIDATES, paper.RECURRENT)).items()
    }
    caption = f"Table II: ours with 95 % intervals (paper's in brackets). Data: {subjects.kind}."
    outcome.blocks += [
        tables.accuracy(
            ManoeuvreErrors(in_table),
            FULL,
            training,
            "table_2",
            caption,
            tuple(KPIS),
        ),
        tables.by_car(
            main, list(subjects.among((*FIGURE_CANDIDATES, paper.RECURRENT))), subjects.kind
        ),
        _overview(subjects),
    ]
    for name, candidates in (("networks_alone", ALONE), ("oracles", tables.ORACLES)):
        if among := subjects.among(candidates):
            errors = ManoeuvreErrors(among)
            outcome.data[name] = tables.accuracy(errors, "", training, name, "").frame
    outcome.data["within_12_deg"] = kpi_table(subjects.within)


def _overview(subjects: Subjects) -> Table:
    """Errors of what is trained, which the first screen and the terminal show."""
    within = ManoeuvreErrors(subjects.within)
    rows = [
        {
            "candidate": name,
            "mse": subjects.main.text(name, MSE),
            "mse_nl": subjects.main.text(name, MSE_NL),
            "within": within.text(name, MSE) if name in within else MISSING,
            "n_seeds": len(subjects.runs[name]),
        }
        for name in OVERVIEW_CANDIDATES
        if name in subjects.runs
    ]
    columns = {
        "candidate": Column("method"),
        "mse": Column("MSE"),
        "mse_nl": Column("MSE_nl"),
        "within": Column("MSE up to 12°"),
        "n_seeds": Column("seeds", decimals=0),
    }
    caption = f"Errors [deg²] with 95 % intervals. Data: {subjects.kind}."
    return Table("overview", caption, pd.DataFrame(rows, columns=list(columns)), columns)


def _hybrids(outcome: Outcome, subjects: Subjects, content: Paper) -> None:
    """What the hybrids' networks do, the factorial, the floor ε, bands, wrong tyres, and the
    limited set.
    """
    main = subjects.main
    prepared = subjects.full
    kind = subjects.kind
    hybrids = {
        name: seeds
        for name, seeds in subjects.runs.items()
        if seeds[0].model.estimator in WITH_NETWORK and name != paper.ORACLE_DISTRUST
    }
    outputs = {name: [outputs_of(run, prepared) for run in hybrids[name]] for name in hybrids}
    shifts = {name: [shift_of(run, prepared) for run in hybrids[name]] for name in hybrids}
    active = tables.activity(outputs, shifts)
    off = perturbed.perturbed(subjects.runs, prepared)
    if hybrids:
        removed = [name for name in hybrids if "(" not in name and "ε" not in name]
        outcome.blocks.append(
            tables.ablation(main, active[active["candidate"].isin(removed)], kind)
        )
    part = subjects.artefacts.parts[FULL]
    outcome.blocks += [
        factorial.factorial_table(main, kind),
        factorial.effects_table(main, kind),
        factorial.floor_table(main, outputs, active, kind),
        calibration.calibration_table(
            part, prepared, {name: subjects.parts[FULL][name] for name in _filters(subjects)}, kind
        ),
    ]
    outcome.data["networks_full"] = tables.networks_alone(main, outputs)
    local = pd.DataFrame()
    if paper.SMOOTH in subjects.runs:
        smooth = filter_of(load_model(chosen(subjects.runs[paper.SMOOTH]).model.model_folder))
        assert smooth is not None
        local = observability.local(smooth)
        outcome.data["observability"] = local
    if off.stiffness[perturbed.NOMINAL]:
        outcome.blocks.append(perturbed.figure_14(off, kind))
        outcome.data["perturbed"] = perturbed.by_condition(off)
        outcome.data["stiffness"] = perturbed.values(off)
    learnt = None
    if LIMITED in subjects.parts:
        learnt = limited(subjects.runs, subjects.parts[LIMITED], subjects.prepared[LIMITED])
        _limited(outcome, subjects, learnt)
    outcome.rows += block_errors.error_rows(subjects.parts, learnt, content)
    outcome.rows += block_errors.measured_rows(main, outputs, off, local)


def _filters(subjects: Subjects) -> list[str]:
    return [name for name in FILTERS if name in subjects.parts[FULL]]


def _limited(outcome: Outcome, subjects: Subjects, learnt: Limited) -> None:
    """Table III and Figures 11 to 13."""
    part = subjects.artefacts.parts[LIMITED]
    prepared = subjects.prepared[LIMITED]
    runs = {
        name: seeds
        for name, seeds in learnt.comparison.runs.items()
        if name in paper.OF_FOUR or name == paper.SMOOTH
    }
    training = {
        name: tables.training_error(chosen(seeds), prepared) for name, seeds in learnt.runs.items()
    }
    caption = (
        "Table III, trained up to 7 m/s²; filters are those of the full set. Data: "
        f"{subjects.kind}."
    )
    turn = traces.manoeuvre_of(part, prepared, "J-turn")
    hybrids = {name: chosen(learnt.runs[name]) for name in paper.HYBRIDS if name in learnt.runs}
    picked = {name: chosen(seeds) for name, seeds in runs.items()}
    title = "J-turn, learnt on the limited set"
    outcome.blocks += [
        tables.accuracy(learnt.comparison, LIMITED, training, "table_3", caption),
        distributions.errors_figure(runs, 11, "limited set", subjects.kind)[0],
        traces.compared(picked, turn, 12, title, subjects.kind),
    ]
    if hybrids:
        warm_up = part.protocol.warm_up_seconds
        outcome.blocks.append(
            traces.angles_of_networks(hybrids, prepared, warm_up, turn, subjects.kind)
        )
    outcome.data["networks_limited"] = tables.networks_alone(learnt.comparison, learnt.outputs)


def _manoeuvres(outcome: Outcome, subjects: Subjects) -> None:
    """Figures 4 to 10 of the paper."""
    artefacts = subjects.artefacts
    prepared = subjects.full
    kind = subjects.kind
    part = artefacts.parts[FULL]
    warm_up = part.protocol.warm_up_seconds
    title = artefacts.titles[FULL].lower()
    of_sets = {name: artefacts.parts[name] for name in (FULL, LIMITED) if name in artefacts.parts}
    figure_4 = distributions.figure_4(of_sets, subjects.prepared, artefacts.titles, kind)
    outcome.blocks.append(figure_4)
    compared = subjects.among(FIGURE_CANDIDATES)
    if not compared:
        return
    drawn = subjects.drawn(FIGURE_CANDIDATES)
    slalom, spiral, lap = (
        traces.manoeuvre_of(part, prepared, group) for group in ("slalom", "spiral", "lap")
    )
    figure_5, outcome.data["errors_full"] = distributions.errors_figure(compared, 5, title, kind)
    figure_6, outcome.data["figure_6"] = distributions.groups(compared, kind)
    of_four = {name: run for name, run in drawn.items() if name in paper.OF_FOUR} or drawn
    outcome.blocks += [
        figure_5,
        figure_6,
        traces.compared(of_four, slalom, 7, "Slalom", kind),
        traces.compared(drawn, spiral, 9, "Spiral", kind),
        traces.lap(drawn, prepared, warm_up, lap, kind),
    ]
    if all(name in drawn for name in paper.HYBRIDS):
        constant = tables.process_levels(drawn[paper.DEEP])
        outcome.blocks.append(traces.inner_life(drawn, prepared, warm_up, slalom, constant, kind))


def _files(outcome: Outcome, subjects: Subjects) -> None:
    """Loss curves, and tables on filters and budgets."""
    artefacts = subjects.artefacts
    parts = subjects.parts
    kind = subjects.kind
    titled = {name: (artefacts.titles[name], runs) for name, runs in parts.items()}
    models: dict[str, Sequence[EvaluatedModel]] = {
        name: [run.model for run in seeds]
        for name, seeds in subjects.runs.items()
        if name not in tables.ORACLES
    }
    losses = loss_curves(models)
    outcome.data[LOSS_CURVES] = losses
    if len(losses):
        caption = (
            "Losses of training and validation, the longest phase of each candidate's first "
            f"seed, scaled. Data: {kind}."
        )
        outcome.blocks.append(loss_figure(losses, caption))
    outcome.data |= {
        "filters": tables.filters([titled[name] for name in titled if name in (FULL, "free")]),
        "scaling": tables.scaling(titled),
        "budget": tables.budget(
            [(artefacts.titles[name], part, parts[name]) for name, part in artefacts.parts.items()]
        ),
    }
    outcome.data |= {f"kpis_{name}": kpi_table(runs) for name, runs in parts.items()}


def _values(
    subjects: Subjects, content: Paper, trained: Sequence[TrainingRow], files: Sequence[str]
) -> dict[str, object]:
    """Numbers and names that the template has places for."""
    main = subjects.main
    artefacts = subjects.artefacts
    estimators = tuple(
        model.estimator for part in artefacts.parts.values() for model in part.models
    )
    return {
        "recommendation": without_line_breaks(content.recommendation),
        "kind": subjects.kind,
        "manoeuvres": len(main.manoeuvres),
        "beyond": number_beyond(main, MAX_PAPER_SIDESLIP),
        "ratios": {place: _ratio(main, name, MSE_NL) for place, name in COMPARED.items()},
        "absent_parts": methods.absent_parts(artefacts),
        "incomplete": _incomplete(artefacts, trained),
        "limited_titles": ["Limited set"] if LIMITED in subjects.parts else [],
        "difference_of_tyres": fixed(tables.difference_of_tyres(subjects.runs), 1),
        "command": as_code(artefacts.command),
        "scoring": methods.scoring(artefacts.parts[FULL]),
        "facts": [
            fact
            for fact in methods.facts_of(artefacts.parts.values())
            if not fact.startswith(estimators)
        ],
        "files": files,
    }


def _ratio(main: ManoeuvreErrors, reference: str, kpi: str) -> str:
    """An indicator of CNN-UKF over that of another with its interval."""
    if paper.CNN not in main or reference not in main:
        return NOT_TRAINED
    return figure_in_words(main.ratio(paper.CNN, reference, kpi))


def number_beyond(main: ManoeuvreErrors, sideslip: float) -> int:
    """Test manoeuvres in which |β| exceeds an angle [rad]."""
    run = next(iter(main.runs.values()))[0]
    largest = [
        max(float(np.abs(part.sideslip_ref).max()) for part in parts) for parts in run.test.values()
    ]
    return int(np.count_nonzero(np.array(largest) > sideslip))


def _incomplete(
    artefacts: StudyArtefacts, trained: Sequence[TrainingRow]
) -> list[dict[str, object]]:
    """What the template says of trainings that are planned and not done: one entry, or none."""
    number = sum(len(names) for names in artefacts.not_trained.values())
    if not number:
        return []
    not_trained = [row.candidate for row in trained if row.training == "not trained"]
    parts = [as_code(name) for name, names in artefacts.not_trained.items() if names]
    return [
        {
            "number": number,
            "candidates": "; ".join(not_trained) or MISSING,
            "parts": ", ".join(parts),
        }
    ]
