"""The report: headline, how it was made, the paper's tables and figures in its order, then what it does not have."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import pandas as pd

from vehest.data.errors import DataError
from vehest.data.splits import Span
from vehest.report.document import PATENT_NOTE, REPORT, Block, Column, Document, Table, as_code
from vehest.report.style import fixed, percent_below
from vehest.studies.artefacts import StudyArtefacts
from vehest.studies.kit.reading import spans_in_words, words_of_kinds
from vehest.studies.sweep import interval, mean_and_half
from vehest_papers.ksnn import analyses, paper, scatter, tables
from vehest_papers.ksnn.candidates import chosen_by_category, runs_of, seeds_like
from vehest_papers.ksnn.tilted import tilted

SCHEMES = {"scheme_1": (paper.TABLE_IV, "c2", "f2"), "scheme_2": (paper.TABLE_V, "f2", "c2")}
"""Part -> the paper's table, test set of the car that is learnt on, test set of the other."""

SIMULATED = "simulated"
ONE_SIMULATOR = (
    "The two cars of the schemes are two parameter sets of one simulator, driven by one driver on one course, with sensors of one kind. "
    "These two differ in all of that."
)
ALIKE = " With cars that differ this much, structure pays; the two simulated cars are most likely too much alike to show it."


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report of the study.

    Raises:
        DataError: a scheme is missing, its test sets are not ``c2`` and ``f2``, or metrics are missing.
    """
    for name in SCHEMES:
        if name not in artefacts.parts:
            raise DataError(f"study '{artefacts.study}' needs part '{name}'")
        if set(artefacts.parts[name].split.tests) != set(tables.SETS):
            raise DataError(f"study '{artefacts.study}': the test sets of part '{name}' must be called c2 and f2")
    runs = {name: runs_of(part) for name, part in artefacts.parts.items()}
    whole = pd.concat([runs[name] for name in SCHEMES], ignore_index=True)
    kind = words_of_kinds(artefacts.parts["scheme_2"])
    blocks: list[Block] = [
        *_headline(artefacts, runs),
        overview(artefacts, runs),
        *_how_it_was_made(artefacts),
        "## The data",
        *analyses.of_the_data(artefacts),
        "## The candidates",
        tables.instances(whole),
        *analyses.of_activation(artefacts, runs),
        "## On the car trained on and on the other one",
        *_schemes(artefacts, runs),
        *(tilted(artefacts, runs, SCHEMES) if kind == SIMULATED else []),
        "## Sideslip angle, beside Kalman filter and factor graph",
        tables.sideslip(runs["scheme_2"], runs.get("ferrari_drive"), runs.get("ferrari_whole"), kind),
    ]
    if "one_vehicle" in runs:
        blocks += ["## Without cross-vehicle regularisation", tables.regularisation(runs["scheme_2"], runs["one_vehicle"])]
    blocks += _other_cars(artefacts, runs, alike=kind == SIMULATED)
    chosen = "The models are those that validation chooses in both schemes, as in the tables above."
    blocks += [f"## How acceleration noise comes through\n\n{chosen}", *analyses.of_sensitivities(artefacts, runs)]
    blocks += ["## What is left of the lateral velocity", *analyses.of_residuals(artefacts, runs)]
    blocks += ["## What the networks have learnt", *analyses.of_interpretation(artefacts, runs)]
    blocks += ["## When training stopped", tables.stopping(runs, artefacts.titles), PATENT_NOTE]
    data = {f"candidates_{name}": tables.candidates(runs[name], list(tables.SETS)) for name in SCHEMES}
    return {REPORT: Document(artefacts.title, blocks, data)}


def _headline(artefacts: StudyArtefacts, runs: Mapping[str, pd.DataFrame]) -> list[Block]:
    kinds = {name: words_of_kinds(part) for name, part in artefacts.parts.items()}
    schemes = " and ".join(dict.fromkeys(kinds[name] for name in SCHEMES))
    others = [f"{artefacts.titles[name]}: {kind}" for name, kind in kinds.items() if name not in SCHEMES]
    words = f"**{schemes.upper()}:** the cars of both schemes are {schemes}; the paper's are real."
    if others:
        words += f" The other parts: {'; '.join(others)}."
    if artefacts.absent:
        words += (
            f" Not in this report, since the recordings were not at hand: {'; '.join(artefacts.titles[name] for name in artefacts.absent)}."
        )
    sentences = [_scheme_sentence(artefacts.titles[name], runs[name], other) for name, (_, _, other) in SCHEMES.items()]
    fits = sum(len(own) for own in runs.values())
    candidates = len(pd.concat([runs[name] for name in SCHEMES]).drop_duplicates(["estimator", "variant"]))
    sentences.append(f"{fits} fits in all; {candidates} candidates in each of two schemes.")
    return [words, " ".join(sentences), artefacts.about]


def _scheme_sentence(title: str, runs: pd.DataFrame, other: str) -> str:
    picked = chosen_by_category(runs)
    best = min(picked, key=lambda name: float(picked[name][f"fvu.{other}"]))
    words = (
        f"{title}: on {tables.SETS[other]}, the car not trained on, the lowest FVU is {fixed(picked[best][f'fvu.{other}'], 3)} by {best}"
    )
    if paper.LUENBERGER in picked and best != paper.LUENBERGER:
        against = float(picked[paper.LUENBERGER][f"fvu.{other}"])
        words += f", {percent_below(picked[best][f'fvu.{other}'], against)} below the Luenberger observer ({fixed(against, 3)})"
    return words + "."


def _how_it_was_made(artefacts: StudyArtefacts) -> list[Block]:
    first = artefacts.parts["scheme_1"]
    protocol = first.protocol
    facts = list(dict.fromkeys(fact for part in artefacts.parts.values() for fact in part.facts))
    lines = [
        f"Command: {as_code(artefacts.command)}",
        f"Evaluation: every estimate is read at {protocol.rate_hz:g} Hz, held and never interpolated from later values; the first "
        f"{protocol.skip_seconds:g} s of each {protocol.piece} are not scored, for anyone.{protocol.start_in_words}",
        "Metrics: FVU = var(v − v̂)/var(v), R² = 1 − FVU, RMSE(v) = √E[(v − v̂)²]; sideslip β = atan2(v, u) with the measured u.",
        "Of several structures and seeds, the one with the lowest RMSE(v) on the validation set is shown, which in both schemes is "
        "the other car. Test data choose nothing. `±` is half the 95 % confidence interval of the mean over seeds (Student's t).",
        *facts,
    ]
    ranges = pd.DataFrame(
        [
            {
                "part": artefacts.titles[name],
                "kind": words_of_kinds(part),
                "train": spans_in_words(part.split.train),
                "validation": spans_in_words(part.split.validation),
                **{"tests": "; ".join(f"{test}: {spans_in_words(spans)}" for test, spans in part.split.tests.items())},
            }
            for name, part in artefacts.parts.items()
        ]
    )
    columns = {"part": Column("part"), "kind": Column("data"), "train": Column("training"), "validation": Column("validation")}
    caption = "What was used for what (the first two rows are Table II of the paper)."
    return [
        "## How it was made\n\n" + "\n".join(f"- {line}" for line in lines),
        Table("table_2", caption, ranges, columns | {"tests": Column("tests")}),
    ]


def _schemes(artefacts: StudyArtefacts, runs: Mapping[str, pd.DataFrame]) -> list[Block]:
    kind = words_of_kinds(artefacts.parts["scheme_1"]).upper()
    columns = [scatter.Scheme(artefacts.titles[name], runs[name], *known) for name, known in SCHEMES.items()]
    caption = (
        f"The candidates on the two test sets (Figure 6 of the paper), ours on {kind} cars: filled marks, the seed that validation chooses "
        f"of each structure; faint ones, the other seeds; hollow ones, what the paper reports of its real cars for the most general model "
        f"of each category. On the dashed line both cars are estimated equally well. Seeds far outside are not shown; all figures are in "
        f"[scheme 1](tables/candidates_scheme_1.csv) and [scheme 2](tables/candidates_scheme_2.csv)."
    )
    blocks: list[Block] = [scatter.two_tests(columns, caption)]
    for number, (name, (published, own, other)) in zip(("IV", "V"), SCHEMES.items(), strict=True):
        part = artefacts.parts[name]
        learnt = ", ".join(dict.fromkeys(span.recording for span in part.split.train))
        caption = (
            f"Most general models per category, {artefacts.titles[name].lower()} (Table {number} of the paper): learnt on the car of "
            f"{tables.SETS[own]} ({learnt}), stopped and chosen on the other. Ours: {words_of_kinds(part).upper()}. "
            f"`seeds` is the mean over all seeds of that structure."
        )
        blocks += [tables.most_general(runs[name], published, f"table_{4 if name == 'scheme_1' else 5}", caption)]
        blocks += [tables.order_in_words(runs[name], published, other), tables.specialisation_in_words(runs[name], published, own, other)]
    return blocks


def _other_cars(artefacts: StudyArtefacts, runs: Mapping[str, pd.DataFrame], *, alike: bool) -> list[Block]:
    """Both schemes with other cars, where their recordings are at hand; ``alike`` where the cars of the schemes are simulated."""
    blocks: list[Block] = []
    for name in ("devbot_ferrari", "ferrari_devbot"):
        if name not in runs:
            continue
        part = artefacts.parts[name]
        tests = {
            test: f"{test} ({' and '.join(sorted({part.kinds[span.dataset] for span in spans}))})"
            for test, spans in part.split.tests.items()
        }
        caption = f"{artefacts.titles[name]}: of each category the run that the other car's validation range chooses."
        blocks.append(tables.most_general(runs[name], {}, f"table_{name}", caption, tests))
        unseen = [test for test, spans in part.split.tests.items() if not _shares_a_car(spans, part.split.train)]
        blocks += [tables.families_in_words(runs[name], test, tests[test], ALIKE if alike else "") for test in unseen]
    lead = "## The same with a real Ferrari and a simulated DevBot"
    return [f"{lead}\n\n{ONE_SIMULATOR}" if alike else lead, *blocks] if blocks else []


def _shares_a_car(spans: Sequence[Span], others: Sequence[Span]) -> bool:
    return bool({span.dataset for span in spans} & {span.dataset for span in others})


def overview(artefacts: StudyArtefacts, runs: Mapping[str, pd.DataFrame]) -> Table:
    """What the terminal shows: FVU on the car not trained on, beside the paper's."""
    rows = []
    for name, (published, own, other) in SCHEMES.items():
        for category, run in chosen_by_category(runs[name]).items():
            mean, half = interval(seeds_like(runs[name], run)[f"fvu.{other}"].to_numpy(dtype=float))
            row: dict[str, object] = {"scheme": artefacts.titles[name], "model": category, "structure": run["structure"]}
            row |= {"paper_fvu_other": published[category].fvu(other) if category in published else math.nan}
            row |= {"fvu_other": run[f"fvu.{other}"], "seeds": mean_and_half(mean, half, 3)}
            rows.append(row | {"fvu_own": run[f"fvu.{own}"], "rmse_vy_other": run[f"rmse_vy.{other}"]})
    columns = {
        "scheme": Column("scheme"),
        "model": Column("model"),
        "structure": Column("structure"),
        "paper_fvu_other": Column("FVU, other car, paper", decimals=3),
        "fvu_other": Column("FVU, other car", decimals=3),
        "seeds": Column("over seeds"),
        "fvu_own": Column("FVU, own car", decimals=3),
        "rmse_vy_other": Column("RMSE(v), other car [m/s]", decimals=3),
    }
    return Table("overview", "The short of it: FVU on the car that was not trained on.", pd.DataFrame(rows), columns)
