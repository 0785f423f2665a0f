"""The report: what came of the paper's claims on the first page, then everything else in appendices."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import pandas as pd

from vehest.data.errors import DataError
from vehest.report.document import PATENT_NOTE, REPORT, Block, Document, Table, as_code, as_text
from vehest.report.style import fixed, listed
from vehest.studies.artefacts import StudyArtefacts
from vehest_papers.kit import methods
from vehest_papers.kit.block_rows import BLOCKS, TRAINING, BlockRow, TrainingRow, frame
from vehest_papers.kit.claim_files import claims_of
from vehest_papers.kit.reading import words_of_kinds
from vehest_papers.kit.verdict_table import claims_table
from vehest_papers.ksnn import (
    analyses,
    behaviour_tables,
    block_errors,
    cost,
    paper,
    scatter,
    tables,
)
from vehest_papers.ksnn.behaviour import Behaviour
from vehest_papers.ksnn.causes import CAUSES, causes_table
from vehest_papers.ksnn.curve import Curve, curve_figure, curve_of, curve_table
from vehest_papers.ksnn.schemes import SET_TITLES, Scheme, with_common_blocks

SCHEMES = {"scheme_1": (paper.TABLE_IV, "c2", "f2"), "scheme_2": (paper.TABLE_V, "f2", "c2")}
"""Part -> the paper's table, test set of the car that is learnt on, test set of the other."""
OTHER_CARS = ("devbot_ferrari", "ferrari_devbot")
SMALL = ("f1tenth", "dart", "roboracer")
WINDOW = 30  # steps of a network for an estimate


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report of the study.

    Raises:
        DataError: a scheme is missing, it has no test sets ``c2`` and ``f2``, or metrics are missing.
    """
    for name in SCHEMES:
        if name not in artefacts.parts:
            raise DataError(f"study '{artefacts.study}' needs part '{name}'")
        if not {"c2", "f2"} <= set(artefacts.parts[name].split.tests):
            raise DataError(
                f"study '{artefacts.study}': two test sets of part '{name}' must be called c2 and f2"
            )
    parts = with_common_blocks({name: scheme_of(artefacts, name) for name in artefacts.parts})
    schemes = [parts[name] for name in SCHEMES]
    ablations = {
        cause: own
        for cause in CAUSES
        if (own := [parts[name] for number in "12" if (name := f"{cause}_{number}") in parts])
    }
    curve = curve_of(
        parts["scheme_2"], {name: own for name, own in parts.items() if name.startswith("minutes_")}
    )
    pairs = _pairs(parts)
    behaviours = {scheme.name: Behaviour.of(scheme) for scheme in schemes}
    claimed = claims_of("ksnn")
    rows = block_errors.error_rows(claimed, parts, behaviours)
    rows += block_errors.measured_rows(claimed, parts)
    trained = block_errors.training_rows(claimed, parts)
    kinds = {re.sub(r"_[a-z]$", "", name): own.kind for name, own in parts.items()}
    figure_6 = (
        f"The candidates on the two test sets (Figure 6 of the paper), ours on {schemes[0].kind.upper()} cars: filled marks, the seed "
        f"that validation chooses of each structure; faint ones, the other seeds; hollow ones, the paper's most general models. Above the "
        f"dashed line the own car is estimated better."
    )
    overview = (
        "FVU, with 95 % intervals over blocks of the drives and seeds, and RMSE(v), since v varies differently from car to car; of each "
        f"category the structure that validation chooses; all figures are in the CSV. {schemes[0].kind.upper()}."
    )
    blocks: list[Block] = [
        *_asked(artefacts),
        claims_table(claimed, rows, trained, kinds),
        "## On the own car, on the other and on a third",
        scatter.two_tests(schemes, figure_6),
        tables.across_cars(schemes, "overview", overview, without=(paper.KINEMATIC,)),
    ]
    if ablations:
        blocks += ["## Which difference between the cars matters", causes_table(schemes, ablations)]
    if curve is not None:
        blocks += ["## With fewer minutes", curve_figure(curve)]
    blocks += _appendices(artefacts, parts, schemes, curve, behaviours)
    data = {
        f"candidates_{name}": tables.candidates(
            parts[name].runs, list(parts[name].part.split.tests)
        )
        for name in SCHEMES
    }
    data |= {BLOCKS: frame(rows, BlockRow), TRAINING: frame(trained, TrainingRow)}
    if pairs:
        data["small_cars_all"] = tables.across_cars(pairs, "small_cars_all", "").frame
    return {REPORT: Document(artefacts.title, blocks, data)}


def scheme_of(artefacts: StudyArtefacts, name: str) -> Scheme:
    """A part with its cars: those of the paper's schemes by the name, others by which data set a test shares with what is learnt on."""
    part = artefacts.parts[name]
    title = as_text(artefacts.titles[name])
    if name in SCHEMES:
        published, own, other = SCHEMES[name]
        return Scheme(name, title, part, own, other, published)
    tests = list(part.split.tests)
    if {"c2", "f2"} <= set(tests):
        own = "c2" if name.endswith("_1") else "f2"
        return Scheme(name, title, part, own, "f2" if own == "c2" else "c2")
    learnt = {span.dataset for span in part.split.train}
    own = next(
        (test for test in tests if learnt & {span.dataset for span in part.split.tests[test]}),
        tests[0],
    )
    return Scheme(name, title, part, own, next((test for test in tests if test != own), own))


def _pairs(parts: Mapping[str, Scheme]) -> list[Scheme]:
    """Parts of small cars, which are called by both."""
    return [own for name, own in parts.items() if set(name.split("_")) <= set(SMALL)]


def _asked(artefacts: StudyArtefacts) -> list[Block]:
    kinds = {name: words_of_kinds(part) for name, part in artefacts.parts.items()}
    schemes = " and ".join(dict.fromkeys(kinds[name] for name in SCHEMES))
    words = f"**{schemes.upper()}:** the cars of both schemes are {schemes}; the paper's are real."
    others = {
        kind: [artefacts.titles[name] for name in kinds if kinds[name] == kind]
        for kind in kinds.values()
        if kind != schemes
    }
    if others:
        counts = listed([f"{len(titles)} are {kind}" for kind, titles in others.items()])
        words += f" Of the other parts {counts}: see the appendix."
    return [f"{words}{methods.absent_parts(artefacts)} {artefacts.about}".strip()]


def _appendices(
    artefacts: StudyArtefacts,
    parts: Mapping[str, Scheme],
    schemes: Sequence[Scheme],
    curve: Curve | None,
    behaviours: Mapping[str, Behaviour],
) -> list[Block]:
    runs = {name: own.runs for name, own in parts.items()}
    blocks: list[Block] = ["## Appendix: how estimators behave", *_behaviour(schemes, behaviours)]
    if curve is not None:
        blocks.append(curve_table(curve))
    blocks += ["## Appendix: the paper's tables"]
    for scheme, number in zip(schemes, ("IV", "V"), strict=True):
        which = (
            f"{scheme.title.lower()} (Table {number} of the paper). Ours: {scheme.kind.upper()}."
        )
        caption = f"The one run of each category that validation chooses, {which}"
        blocks.append(tables.chosen_runs(scheme, f"table_{4 if number == 'IV' else 5}", caption))
    blocks.append(
        tables.sideslip(
            runs["scheme_2"], runs.get("ferrari_drive"), runs.get("ferrari_whole"), schemes[0].kind
        )
    )
    if "one_vehicle" in runs:
        blocks.append(tables.regularisation(runs["scheme_2"], runs["one_vehicle"]))
    others = [parts[name] for name in OTHER_CARS if name in parts]
    if others:
        caption = "FVU and RMSE(v) with 95 % intervals, of each category the structure that validation chooses."
        blocks += [
            "## Appendix: a simulated DevBot and the real Ferrari",
            tables.across_cars(others, "devbot", caption),
        ]
        blocks += map(tables.whether_an_order_means_anything, others)
    pairs = _pairs(parts)
    if pairs:
        blocks += [
            "## Appendix: pairs of small cars",
            tables.small_cars(pairs),
            *map(tables.whether_an_order_means_anything, pairs),
        ]
    blocks += ["## Appendix: noise of the accelerations", *analyses.of_sensitivities(schemes)]
    blocks += ["## Appendix: spectra of the residuals", *analyses.of_residuals(schemes)]
    blocks += ["## Appendix: what the networks have learnt", *analyses.of_interpretation(schemes)]
    warned = methods.warnings_in_words({scheme.title: scheme.part for scheme in schemes})
    blocks += [
        "## Appendix: the data",
        *analyses.of_the_data(artefacts),
        *([warned] if warned else []),
    ]
    blocks += _how_it_was_made(artefacts)
    whole = pd.concat([scheme.runs for scheme in schemes], ignore_index=True)
    blocks += [
        tables.instances(whole),
        *analyses.of_activation(schemes),
        tables.stopping(runs, artefacts.titles),
        PATENT_NOTE,
    ]
    return blocks


def _behaviour(schemes: Sequence[Scheme], behaviours: Mapping[str, Behaviour]) -> list[Table]:
    """Low yaw rates, starts, biases, learnt parameters and cost."""
    costs = cost.cost_rows(schemes[0], (paper.ZERO, paper.STATIC_MAP, *paper.CATEGORIES), WINDOW)
    tables_of = (
        behaviour_tables.low_yaw_rate_table(schemes, behaviours),
        behaviour_tables.after_start_table(schemes, behaviours),
        behaviour_tables.biases_table(schemes, behaviours),
        behaviour_tables.parameters_table(schemes),
        cost.cost_table(costs, WINDOW) if len(costs) else None,
    )
    return [table for table in tables_of if table is not None]


def _how_it_was_made(artefacts: StudyArtefacts) -> list[Block]:
    fits = sum(len(part.models) for part in artefacts.parts.values())
    lines = [
        f"Command: {as_code(artefacts.command)}; {fits} fits",
        methods.scoring(
            artefacts.parts["scheme_1"], ", held and never interpolated from later values"
        ),
        "Metrics: FVU = var(v − v̂)/var(v), R² = 1 − FVU, RMSE(v) = √E[(v − v̂)²]; sideslip β = atan2(v, u) with the measured u.",
        "Of several structures the one that holds the seed with the lowest RMSE(v) on the validation set is taken, which in both schemes "
        "is of the other car. Test data choose nothing.",
        _averaging(artefacts),
        "Intervals are over blocks of the drives and seeds, as `docs/scorecard.md` describes; spectra have segments of 25.6 s as blocks.",
        *methods.facts_of(artefacts.parts.values()),
    ]
    caption = "What was used for what (the first two rows are Table II of the paper)."
    return [
        methods.how_it_was_made(lines),
        methods.ranges_table(artefacts, "table_2", caption, SET_TITLES),
    ]


def _averaging(artefacts: StudyArtefacts) -> str:
    """Averaging of weights over training steps, where a training is configured with it."""
    trainings = [model.training for part in artefacts.parts.values() for model in part.models]
    decays = sorted({float(own["averaging"] or 0.0) for own in trainings if "averaging" in own})
    if decays in ([], [0.0]):
        return "Networks keep the weights of their best epoch."
    words = listed([fixed(own, 4).rstrip("0") for own in decays])
    return f"Networks keep an exponential average of their weights, decay {words} a step, at its best epoch: docs/estimators/training.md."
