"""The report: headline, how it was made, Tables II and III, Figures 4 to 14, what causal preprocessing costs, and another car."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from vehest.data.errors import DataError
from vehest.estimators.cnn_ukf import MOST_NOISE
from vehest.estimators.filtering.network_ukf import LEAST_VARIANCE
from vehest.report.document import REPORT, Block, Column, Document, Table, as_code
from vehest.report.style import fixed, listed
from vehest.studies.artefacts import PartArtefacts, StudyArtefacts
from vehest.studies.kit.order import differences, order_in_words, pairs_table
from vehest.studies.kit.reading import spans_in_words, words_of_kinds
from vehest_papers.cnn_ukf import distributions, paper, reasons, robustness, tables, traces
from vehest_papers.cnn_ukf.subjects import (
    CUTOFF_HZ,
    TEST,
    Prepared,
    Run,
    Runs,
    candidate_of,
    chosen,
    kpi_table,
    losses,
    runs_of,
)

FULL, LIMITED, ALONE, CAUSAL, FERRARI = "full", "limited", "limited_alone", "causal", "ferrari"
ON_THE_SAME_TEST = (FULL, LIMITED, ALONE, CAUSAL)
ROMAN = {FULL: "II", LIMITED: "III"}


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report of the study.

    Raises:
        DataError: part ``full`` or one of its four methods is missing, or test sets are not called ``test``.
    """
    if FULL not in artefacts.parts:
        raise DataError(f"study '{artefacts.study}' needs part '{FULL}'")
    for name, part in artefacts.parts.items():
        if set(part.split.tests) != {TEST}:
            raise DataError(f"study '{artefacts.study}': the test set of part '{name}' must be called {TEST}")
    parts = {name: artefacts.parts[name] for name in ON_THE_SAME_TEST if name in artefacts.parts}
    prepared = {name: Prepared(part) for name, part in parts.items()}
    runs = {name: runs_of(part, prepared[name]) for name, part in parts.items()}
    missing = [candidate for candidate in paper.TABLE_II if candidate not in runs[FULL]]
    if missing:
        raise DataError(f"study '{artefacts.study}': no {' and no '.join(missing)} among the models of part '{FULL}'; it needs all four")
    data: dict[str, pd.DataFrame] = {f"kpis_{name}": kpi_table(own) for name, own in runs.items()}
    blocks: list[Block] = [*_headline(artefacts, runs), overview(artefacts, runs), *_how_it_was_made(artefacts, parts)]
    main = {name: parts[name] for name in (FULL, LIMITED) if name in parts}
    kind = words_of_kinds(parts[FULL]).upper()
    blocks += ["## What was driven", distributions.figure_4(main, prepared, artefacts.titles, kind)]
    for name in main:
        blocks += _set(name, artefacts, runs[name], prepared[name], data)
    if ALONE in runs:
        blocks += _alone(runs, kind)
    blocks += _robustness(runs[FULL], prepared[FULL], kind, data)
    if CAUSAL in runs:
        blocks += _causal(runs, kind)
    if FERRARI in artefacts.parts:
        blocks += _ferrari(artefacts.parts[FERRARI], artefacts.titles[FERRARI])
    blocks += _filters_and_budget(artefacts, parts, runs)
    return {REPORT: Document(artefacts.title, blocks, data)}


def departures(parts: Mapping[str, PartArtefacts]) -> list[str]:
    """Sentences, of what departs; settings from the trainings."""
    trainings = {candidate_of(model): model.training for part in parts.values() for model in part.models}
    lines = [
        "Data: simulated manoeuvres in the place of recorded ones, in the mix of the paper's test set, by a car with the paper's mass, "
        "inertia and wheelbase; its tyres, springs and sensors are assumed, each drive has sensors' offsets of its own. Nothing is "
        "learnt, and nothing stopped, on moments that the split leaves out as beyond what the paper's drives show (docs/cnn_ukf.md).",
        "The filter of the CNN-UKF has the smooth tyres (Eq. 10) in use as well, identified with that curve; the paper says smooth tyres "
        "of the training only. The same filter alone stands beside it.",
        f"σ_DD is a standard deviation everywhere, R = σ_DD² + {LEAST_VARIANCE:g} rad², where Eq. 6 has a variance; Eq. 11 scales the "
        "variance of the networks' angles, in rad², and R is its result.",
        f"Pre-training aims at the levels of process noise that the identification finds for this data, but at {MOST_NOISE:g} at most, "
        "since a logistic function ends at 1; the paper's are far smaller.",
    ]
    if LIMITED in parts:
        lines.append(
            "The limited set's filters are given the tyres and levels of noise of the full one, as the paper's model has the same errors "
            "in both tables. It is cut where the unfiltered |ay| exceeds the limit, into whole stretches of two seconds and more."
        )
    if paper.DEEP in trainings:
        phase = trainings[paper.DEEP]["phase"]
        if phase["patience"]:
            lines.append(
                f"Ensemble: training ends {phase['patience']} epochs after the best mean likelihood on validation, at "
                f"{phase['max_epochs']} at the latest, and the best is kept (paper: {paper.MEMBER_EPOCHS} epochs)."
            )
    if paper.CNN in trainings:
        own = trainings[paper.CNN]
        if own["batch_size"] != paper.BATCH:
            lines.append(
                f"End to end, batches are {own['batch_size']} sequences of {own['steps']} samples (paper: batches of {paper.BATCH})."
            )
    return [
        *lines,
        "What the paper leaves open (epochs, patience, hysteresis and factor of the forces' noise): docs/estimators.md. It optimises "
        "further settings of its networks by Bayesian optimisation and does not say which; here none are.",
    ]


def overview(artefacts: StudyArtefacts, runs: Mapping[str, Runs]) -> Table:
    """What the terminal shows: both errors of both sets, beside the paper's."""
    rows = []
    for name in (FULL, LIMITED):
        if name not in runs:
            continue
        middle = {kpi: tables.medians(runs[name], kpi) for kpi in ("mse", "mse_nonlinear")}
        for candidate, own in runs[name].items():
            known = paper.TABLES[name].get(candidate)
            row: dict[str, object] = {"part": artefacts.titles[name], "candidate": candidate}
            for kpi, values in middle.items():
                row |= {f"paper_{kpi}": getattr(known, kpi) if known else np.nan, f"ours_{kpi}": values[candidate]}
            rows.append(row | {"n_seeds": len(own)})
    columns = {"part": Column("learnt on"), "candidate": Column("method")}
    for kpi, header in (("mse", "MSE"), ("mse_nonlinear", "MSE_nl")):
        columns |= {f"paper_{kpi}": Column(f"{header}, paper [deg²]", decimals=3), f"ours_{kpi}": Column(f"{header}, ours", decimals=3)}
    columns["n_seeds"] = Column("seeds", decimals=0)
    kind = words_of_kinds(artefacts.parts[FULL]).upper()
    caption = f"The short of it: squared errors of the sideslip angle, ours as medians of seeds. Data: {kind}; the paper's are real."
    return Table("overview", caption, pd.DataFrame(rows), columns)


def _headline(artefacts: StudyArtefacts, runs: Mapping[str, Runs]) -> list[Block]:
    kinds = [f"**{artefacts.titles[name]}: {words_of_kinds(part).upper()} data**" for name, part in artefacts.parts.items()]
    words = "; ".join(kinds) + ". The paper's recordings are real, of a BMW 545i, and not public."
    if artefacts.absent:
        absent = "; ".join(artefacts.titles[name] for name in artefacts.absent)
        words += f" Not in this report, since the recordings were not at hand: {absent}."
    sentences = []
    for name in (FULL, LIMITED):
        if name in runs:
            middle = tables.medians(runs[name], "mse_nonlinear")
            shown = listed([f"{candidate} {fixed(middle[candidate], 3)}" for candidate in sorted(middle, key=middle.__getitem__)])
            known = listed([f"{candidate} {fixed(own.mse_nonlinear, 3)}" for candidate, own in paper.TABLES[name].items()])
            sentences.append(f"{artefacts.titles[name]}, MSE_nl [deg²], medians of seeds, best first: {shown} (paper: {known}).")
    if FERRARI in artefacts.parts:
        best = tables.another_car(artefacts.parts[FERRARI])
        shown = listed([f"{row['title']} {fixed(row['median'], 3)}°" for row in best.head(3).to_dict("records")])
        sentences.append(f"{artefacts.titles[FERRARI]}, RMSE(β), the best three of {len(best)}: {shown}.")
    return [words, "\n\n".join(sentences), artefacts.about]


def _how_it_was_made(artefacts: StudyArtefacts, parts: Mapping[str, PartArtefacts]) -> list[Block]:
    protocol = parts[FULL].protocol
    facts = list(dict.fromkeys(fact for part in artefacts.parts.values() for fact in part.facts))
    lines = [
        f"Command: {as_code(artefacts.command)}, with Optuna installed",
        f"Evaluation: every estimate is read at {protocol.rate_hz:g} Hz; estimators may start up to {protocol.warm_up_seconds:g} s before "
        f"a {protocol.piece}, of which the first {protocol.skip_seconds:g} s are not scored, for anyone.{protocol.start_in_words}",
        f"Preprocessing of the full and the limited set, as in the paper: outliers removed, then a zero-phase low-pass of {CUTOFF_HZ:g} Hz "
        "on measurements and reference; both look ahead. KPIs are against the low-passed reference, whatever the estimator saw.",
        "KPIs: MSE over all samples; MSE_nl over those with |ay| ≥ 4 m/s²; ME and ME_nl are the largest absolute error of each manoeuvre, "
        "averaged over manoeuvres.",
        "Ours: the median over seeds, and in brackets the lowest and the highest seed. Figures that show one seed show the one with the "
        "lowest MSE on the validation manoeuvres. Test manoeuvres choose nothing.",
        "Intervals of differences: paired block bootstrap over whole manoeuvres and over seeds, 95 % by Student's t.",
        *facts,
    ]
    rows = pd.DataFrame(
        [
            {
                "part": artefacts.titles[name],
                "kind": words_of_kinds(part).upper(),
                "train": spans_in_words(part.split.train),
                "validation": spans_in_words(part.split.validation),
                "test": spans_in_words(part.split.tests[TEST]),
            }
            for name, part in artefacts.parts.items()
        ]
    )
    columns = {"part": Column("part"), "kind": Column("data"), "train": Column("training"), "validation": Column("validation")}
    return [
        "## How it was made\n\n" + "\n".join(f"- {line}" for line in lines),
        Table("data", "What was used for what.", rows, columns | {"test": Column("test")}),
        "## What departs from the paper\n\n" + "\n".join(f"- {line}" for line in departures(parts)),
    ]


def _set(name: str, artefacts: StudyArtefacts, runs: Runs, prepared: Prepared, data: dict[str, pd.DataFrame]) -> list[Block]:
    """Table II or III and what belongs to it."""
    part, title = artefacts.parts[name], artefacts.titles[name]
    kind, published = words_of_kinds(part).upper(), paper.TABLES[name]
    blocks: list[Block] = [
        f"## {title}",
        tables.accuracy(
            runs, published, f"table_{2 if name == FULL else 3}", f"Table {ROMAN[name]} of the paper, {title.lower()}. Ours: {kind}."
        ),
    ]
    for kpi, header, nonlinear in (("mse", "MSE", False), ("mse_nonlinear", "MSE_nl", True)):
        table, manoeuvre = losses(runs, nonlinear_only=nonlinear)
        known = {candidate: getattr(own, kpi) for candidate, own in published.items()}
        pairs = differences(table, manoeuvre, known, part.protocol.rate_hz)
        caption = f"Differences of {header} [deg²], {title.lower()}; negative where the paper's order holds. Data: {kind}."
        blocks += [
            order_in_words(pairs, tables.medians(runs, kpi), f"by {header}, {title.lower()},", 3),
            pairs_table(pairs, f"pairs_{kpi}_{name}", caption, 3),
        ]
    picked = {candidate: chosen(own) for candidate, own in runs.items()}
    figure, values = distributions.errors_figure(
        runs, f"figure_{5 if name == FULL else 11}", 5 if name == FULL else 11, title.lower(), kind
    )
    data[f"errors_{name}"] = values
    blocks += [
        figure,
        *distributions.groups(runs, "figure_6" if name == FULL else "groups_limited", title.lower(), kind, 6 if name == FULL else None),
    ]
    caption = (
        f"What hybrids' networks say, and what their filters make of it, {title.lower()}: medians of seeds, lowest and highest. σ_DD: "
        f"deviation of the network's angle as the filter takes it, median over samples. Data: {kind}."
    )
    networks = tables.networks_alone(runs, prepared, f"networks_{name}", caption)
    blocks += [networks, *([tables.trust_in_words(networks.frame)] if len(networks.frame) else [])]
    blocks += _traces(name, part, picked, prepared, kind)
    consistent = (
        f"What the paper does not report, {title.lower()}: MSE against the reference as it was measured, share of vy's errors within one "
        f"and two of the filter's own standard deviations, normalised innovations squared (1 for a consistent filter). Data: {kind}."
    )
    blocks += [
        tables.consistency(part, runs, f"consistency_{name}", consistent),
        *reasons.why(name, runs, title, part.protocol.rate_hz, kind),
    ]
    return blocks


def _traces(name: str, part: PartArtefacts, picked: Mapping[str, Run], prepared: Prepared, kind: str) -> list[Block]:
    warm_up = part.protocol.warm_up_seconds
    if name == LIMITED:
        turn = traces.manoeuvre_of(part, prepared, "J-turn")
        what = "J-turn with the largest sideslip angle of those in the test in which the car does not spin, learnt on the limited set"
        blocks: list[Block] = [traces.compared(picked, turn, "figure_12", 12, what, kind)]
        return [*blocks, traces.angles_of_networks(picked, prepared, warm_up, turn, "figure_13", 13, "The same J-turn, hybrids", kind)]
    slalom, spiral, lap = (traces.manoeuvre_of(part, prepared, group) for group in ("slalom", "spiral", "lap"))
    deep = picked[paper.DEEP]
    return [
        traces.compared(picked, slalom, "figure_7", 7, "Slalom with the largest sideslip angle of those without a spin", kind),
        traces.inner_life(picked, prepared, warm_up, slalom, "figure_8", 8, "The same slalom, hybrids", tables.process_levels(deep), kind),
        traces.compared(picked, spiral, "figure_9", 9, "Spiral with the largest sideslip angle of those without a spin", kind),
        traces.lap(picked, prepared, warm_up, lap, kind),
    ]


def _alone(runs: Mapping[str, Runs], kind: str) -> list[Block]:
    """The filters with tyres of the full set and with tyres from the limited one."""
    shown, found = {}, []
    for candidate, own in runs[ALONE].items():
        if LIMITED in runs and candidate in runs[LIMITED]:
            shown[f"{candidate}, from the full set"] = runs[LIMITED][candidate]
            found.append(
                f"{candidate} {tables.frictions(runs[LIMITED], candidate)} from the full set, {tables.frictions(runs[ALONE], candidate)} "
                "from the limited one"
            )
        shown[f"{candidate}, from the limited set"] = own
    caption = f"The filters alone, tyres and noise identified on the full set and on the limited one. Data: {kind}."
    words = f"Friction of the front and the rear tyres: {'; '.join(found)}." if found else ""
    return ["## Tyres from the limited set", tables.accuracy(shown, {}, "limited_alone", caption), *([words] if words else [])]


def _robustness(runs: Runs, prepared: Prepared, kind: str, data: dict[str, pd.DataFrame]) -> list[Block]:
    table = robustness.errors(runs, prepared)
    data["stiffness"] = table
    return [
        "## Robustness to tyres",
        robustness.figure_14(table, kind),
        robustness.sensitivity_table(table, kind),
        robustness.in_words(table),
    ]


def _causal(runs: Mapping[str, Runs], kind: str) -> list[Block]:
    caption = (
        f"Cost of a preprocessing that a car can have: a second-order Butterworth low-pass of {CUTOFF_HZ:g} Hz, run forward, without "
        "removal of outliers, in training, identification and use, beside the paper's, which looks ahead. Both against the same "
        f"reference, low-passed at zero phase. Ratios are of the same seeds. Data: {kind}."
    )
    return ["## What causal preprocessing costs", tables.causal_cost(runs[FULL], runs[CAUSAL], "causal", caption)]


def _ferrari(part: PartArtefacts, title: str) -> list[Block]:
    kind = words_of_kinds(part).upper()
    caption = (
        f"{title}: the paper's methods as their titles say, beside the other families, read at {part.protocol.rate_hz:g} Hz. Learnt on "
        f"{spans_in_words(part.split.train)}, stopped on {spans_in_words(part.split.validation)}, tested on "
        f"{spans_in_words(part.split.tests[TEST])}; medians of seeds, lowest and highest. Data: {kind}."
    )
    return ["## Another car, without tyre forces", tables.another_car_table(part, "ferrari", caption)]


def _filters_and_budget(artefacts: StudyArtefacts, parts: Mapping[str, PartArtefacts], runs: Mapping[str, Runs]) -> list[Block]:
    titled = {name: (artefacts.titles[name], own) for name, own in runs.items()}
    blocks: list[Block] = ["## Filters and budget"]
    if LIMITED in runs:
        blocks.append(tables.given_as_found(runs[FULL], runs[LIMITED]))
    kind = words_of_kinds(parts[FULL]).upper()
    blocks += [
        tables.filters(
            titled,
            "filters",
            "Tyres and levels of noise of the filters; the paper does not give its tyres. A network that says the process noise takes the "
            f"filter's for its start alone. Data: {kind}.",
        ),
        tables.scaling(
            titled,
            "scaling",
            "Scaling of the ensemble's variance (Eq. 11), tuned on validation manoeuvres; ours is in rad², the paper's unit is not known. "
            f"Data: {kind}.",
        ),
        tables.budget(
            {name: (artefacts.titles[name], part, runs[name]) for name, part in parts.items()},
            "budget",
            f"What was spent: seeds and epochs. Data: {kind}.",
        ),
    ]
    return blocks
