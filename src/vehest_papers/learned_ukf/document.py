"""The report: headline, how it was made, then for each data set the paper's tables and figures in its order, and sequence lengths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from vehest.data.errors import DataError
from vehest.report.document import REPORT, Block, Column, Document, Table, as_code, as_text
from vehest.report.style import fixed, listed
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts, StudyArtefacts
from vehest.studies.kit.order import differences, order_in_words, pairs_table
from vehest.studies.kit.reading import recordings_of, spans_in_words, words_of_kinds
from vehest_papers.learned_ukf import paper, prediction, slips, tables, traces
from vehest_papers.learned_ukf.candidates import SETS, chosen, losses, models_by_candidate, runs_of
from vehest_papers.learned_ukf.departures import departures, settings_table
from vehest_papers.learned_ukf.filtering import definiteness, drives_of, loaded
from vehest_papers.learned_ukf.lengths import figure_7

MAIN = ("real", "simulated")
LENGTH = "length_"
ROMAN = {"tyre_a": "I", "tyre_d": "II"}
SHOWN_IN_FIGURE_4 = (paper.NNTF_UH, paper.NNTF_UH_LOW, paper.GRU)
WITH_TYRE_NETWORK = (paper.NNT, paper.NNT_U, paper.NNTF, paper.NNTF_U, paper.NNTF_UH, paper.NNTF_UH_LOW)

Runs = Mapping[str, pd.DataFrame]
"""Part -> its runs."""


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report of the study.

    Raises:
        DataError: neither ``real`` nor ``simulated`` is there, their test sets are not ``tyre_a`` and ``tyre_d``, or metrics are missing.
        ConfigurationError: the protocol cuts no sequences.
    """
    main = {name: artefacts.parts[name] for name in MAIN if name in artefacts.parts}
    if not main:
        raise DataError(f"study '{artefacts.study}' needs one of the parts: {', '.join(MAIN)}")
    for name, part in main.items():
        if set(part.split.tests) != set(SETS):
            raise DataError(f"study '{artefacts.study}': the test sets of part '{name}' must be called {' and '.join(SETS)}")
    runs = {name: runs_of(part) for name, part in main.items()}
    data: dict[str, pd.DataFrame] = {}
    blocks: list[Block] = [*_headline(artefacts, main, runs), overview(artefacts, runs), *_how_it_was_made(artefacts, main, data)]
    for name, part in main.items():
        blocks += _part(artefacts.titles[name], name, part, runs[name], data)
    of_length = {name: part for name, part in artefacts.parts.items() if name.startswith(LENGTH)}
    if of_length:
        blocks += ["## Length of the training sequences", *figure_7(of_length)]
    return {REPORT: Document(artefacts.title, blocks, data)}


def overview(artefacts: StudyArtefacts, runs: Runs) -> Table:
    """What the terminal shows: weighted MSE on both tyres, beside the paper's."""
    rows = []
    for name, own in runs.items():
        middle = {test: tables.medians(own, f"mse_weighted.{test}") for test in SETS}
        for candidate in dict.fromkeys(own["candidate"]):
            row: dict[str, object] = {"part": artefacts.titles[name], "candidate": candidate}
            for test in SETS:
                known = paper.TABLES[test].get(candidate)
                row |= {f"paper_{test}": known.mse if known else np.nan, f"ours_{test}": middle[test][candidate]}
            rows.append(row | {"n_seeds": int((own["candidate"] == candidate).sum())})
    columns = {"part": Column("data"), "candidate": Column("method")}
    for test, tyre in SETS.items():
        columns[f"paper_{test}"] = Column(f"MSE (weighted), {tyre if test == 'tyre_a' else 'tyre C'}, paper", decimals=4)
        columns[f"ours_{test}"] = Column(f"MSE (weighted), {tyre}, ours", decimals=4)
    columns["n_seeds"] = Column("seeds", decimals=0)
    return Table("overview", "The short of it: MSE (weighted), ours as medians of seeds.", pd.DataFrame(rows), columns)


def _headline(artefacts: StudyArtefacts, main: Mapping[str, PartArtefacts], runs: Runs) -> list[Block]:
    kinds = {name: words_of_kinds(part).upper() for name, part in main.items()}
    words = "; ".join(f"**{artefacts.titles[name]}: {kind} data**" for name, kind in kinds.items()) + ". The paper's are real."
    if artefacts.absent:
        absent = "; ".join(artefacts.titles[name] for name in artefacts.absent)
        words += f" Not in this report, since the recordings were not at hand: {absent}."
    sentences = [_result(artefacts.titles[name], name, runs[name]) for name in main]
    return [words, "\n\n".join(sentences), artefacts.about]


def _result(title: str, name: str, runs: pd.DataFrame) -> str:
    sentences = []
    for test, tyre in SETS.items():
        middle = tables.medians(runs, f"mse_weighted.{test}")
        best = min(middle, key=middle.__getitem__)
        words = f"On {tyre} the lowest MSE (weighted) is {fixed(middle[best], 4)} by {best}"
        if paper.NNTF_UH in middle:
            words += "" if best == paper.NNTF_UH else f"; {paper.NNTF_UH} has {fixed(middle[paper.NNTF_UH], 4)}"
            beside = [f"{fixed(paper.TABLES[test][paper.NNTF_UH].mse, 4)} in the paper{', on tyre C' if test == 'tyre_d' else ''}"]
            words += f" ({paper.NNTF_UH}: {', '.join(beside)})"
        sentences.append(words + ".")
    return f"{title}. {' '.join(sentences)} Medians of seeds."


def _how_it_was_made(artefacts: StudyArtefacts, main: Mapping[str, PartArtefacts], data: dict[str, pd.DataFrame]) -> list[Block]:
    first = next(iter(main.values()))
    protocol = first.protocol
    trained = {model.estimator for part in artefacts.parts.values() for model in part.models}
    facts = dict.fromkeys(fact for part in main.values() for fact in part.facts if not fact.startswith(tuple(trained)))
    data["training_settings"] = settings_table(main)
    lines = [
        f"Command: {as_code(artefacts.command)}",
        f"Evaluation: every estimate is read at {protocol.rate_hz:g} Hz; the first {protocol.skip_seconds:g} s of each {protocol.piece} "
        f"are not scored, for anyone.{protocol.start_in_words}",
        "Metrics: squared and absolute errors of vx, vy [m/s] and yaw rate [rad/s], weighted 0.2225, 0.5064 and 0.1566 and summed at each "
        "sample; their means are MSE (weighted) and MAE, the 99th percentile of the absolute ones is 99%-AE. Units are mixed, as in the "
        "paper. NEES and NIS are divided by their dimension; coverage is that of the bands of vy.",
        "Ours: the median over seeds, and in brackets the lowest and the highest seed. Figures that show one seed show the one with the "
        "lowest MSE (weighted) on the validation range. Test data choose nothing.",
        "Intervals of differences: paired block bootstrap over whole sequences and over seeds, 95 % by Student's t.",
        *facts,
        "Every setting of every training: [CSV](tables/training_settings.csv).",
    ]
    ranges = pd.DataFrame(
        [
            {
                "part": artefacts.titles[name],
                "kind": words_of_kinds(part).upper(),
                "train": spans_in_words(part.split.train),
                "validation": spans_in_words(part.split.validation),
                **{test: f"{spans_in_words(spans)}{_sequences(part, test)}" for test, spans in part.split.tests.items()},
            }
            for name, part in main.items()
        ]
    )
    columns = {"part": Column("part"), "kind": Column("data"), "train": Column("training"), "validation": Column("validation")}
    columns |= {test: Column(f"test, {tyre}") for test, tyre in SETS.items()}
    return [
        "## How it was made\n\n" + "\n".join(f"- {line}" for line in lines),
        Table("data", "What was used for what.", ranges, columns),
        "## What departs from the paper\n\n" + "\n".join(f"- {line}" for line in departures(main)),
    ]


def _sequences(part: PartArtefacts, test: str) -> str:
    counted = part.metrics[(part.metrics["test_set"] == test) & (part.metrics["metric"] == "n_sequences")]["value"]
    return f"; {int(counted.iloc[0])} sequences" if len(counted) else ""


def _part(title: str, name: str, part: PartArtefacts, runs: pd.DataFrame, data: dict[str, pd.DataFrame]) -> list[Block]:
    kind = words_of_kinds(part).upper()
    where = f"{kind}, {listed([as_text(part.data_titles.get(dataset, dataset)) for dataset in part.split.datasets])}"
    blocks: list[Block] = [f"## {title}\n\nAll that follows in this section is {kind}.", *_slips(part, name, where, data)]
    for test, tyre in SETS.items():
        errors = losses(part, test)
        published = {candidate: own.mse for candidate, own in paper.TABLES[test].items()}
        pairs = differences(errors.squared, errors.sequence, published, part.protocol.rate_hz)
        data[f"pairs_{test}_{name}"] = pairs
        unseen = " The paper's unseen tyre is C, ours is D: the numbers stand beside each other, they do not measure the same." * (
            test == "tyre_d"
        )
        caption = (
            f"{'On the tyre that was learnt on' if test == 'tyre_a' else 'On the unseen tyre'} (Table {ROMAN[test]} of the paper): {tyre}."
        )
        blocks += [
            f"### {tyre[0].upper()}{tyre[1:]}, {'learnt on' if test == 'tyre_a' else 'unseen'}",
            tables.accuracy(errors, test, f"table_{1 if test == 'tyre_a' else 2}_{name}", f"{caption}{unseen} Ours: {kind}."),
            order_in_words(pairs, tables.medians(runs, f"mse_weighted.{test}"), f"on {tyre}"),
            pairs_table(
                pairs[pairs["neighbours"]],
                f"neighbours_{test}_{name}",
                f"Differences of MSE (weighted) between neighbours in the paper's order, {tyre}; negative where the paper's order holds. "
                f"All pairs: [CSV](tables/pairs_{test}_{name}.csv). Data: {kind}.",
            ),
        ]
    blocks += _errors_and_consistency(name, runs, kind)
    blocks += _definiteness(part, name, runs, kind)
    blocks += _figure_4(part, name, runs, where, data)
    blocks += _figures_5_and_6(part, name, where, data)
    caption = (
        f"What was spent: seeds, and epochs as medians of seeds. {paper.NNTF_UH_LOW} is {paper.NNTF_UH} with another start and shares its "
        f"training. Data: {kind}."
    )
    return [*blocks, "### Budget", tables.budget(part, runs, f"budget_{name}", caption)]


def _slips(part: PartArtefacts, name: str, where: str, data: dict[str, pd.DataFrame]) -> list[Block]:
    filters = [model for model in part.models if model.estimator == "learned_ukf"]
    if not filters:
        return []
    distance = loaded(filters[0]).settings.car.cg_to_rear_axle
    sets = {"training": part.split.train, **{f"test, {tyre}": part.split.tests[test] for test, tyre in SETS.items()}}
    angles = {label: slips.rear_slip(recordings_of(part, own), distance) for label, own in sets.items()}
    note = f"The rear axle lies {distance:g} m behind the centre of gravity, where learning starts from."
    figure, table, drawn = slips.distribution(angles, name, where, note)
    data[f"slip_density_{name}"] = drawn
    return ["### Slip angles", figure, table]


def _errors_and_consistency(name: str, runs: pd.DataFrame, kind: str) -> list[Block]:
    state = f"Root mean square errors by state; in brackets what the paper reports, on its own files. Data: {kind}."
    consistent = (
        f"Consistency of the filters, which the paper does not report: normalised estimation errors squared over vx, vy and yaw rate "
        f"(NEES) and normalised innovations squared (NIS), 1 for a consistent filter and above 1 for one too sure of itself; share of "
        f"vy's errors within one and two of the filter's own standard deviations. Networks without covariances are left out. Data: {kind}."
    )
    return [
        "### Errors by state, and whether filters know them",
        tables.by_state(runs, list(SETS), f"by_state_{name}", state),
        tables.consistency(runs, list(SETS), f"consistency_{name}", consistent),
    ]


def _definiteness(part: PartArtefacts, name: str, runs: pd.DataFrame, kind: str) -> list[Block]:
    groups = {name: own for name, own in models_by_candidate(part).items() if name in WITH_TYRE_NETWORK}
    if not groups:
        return []
    filters = {candidate: [loaded(model) for model in models] for candidate, models in groups.items()}
    drives = {test: drives_of(part, next(iter(filters.values()))[0], test) for test in SETS}
    counted = {
        (candidate, test): [definiteness(estimator, drives[test]) for estimator in estimators]
        for candidate, estimators in filters.items()
        for test in SETS
    }
    caption = (
        f"Covariances that lose their definiteness, of filters whose tyres are a network, all seeds together. The paper has a dash for "
        f"{paper.NNT} and {paper.NNT_U} on its unseen tyre, since their filters became unstable; a repair would hide that. Everywhere else "
        f"in this report covariances are repaired. Data: {kind}."
    )
    lost = {key: sum(one.lost for one in own) for key, own in counted.items()}
    sentences = [
        f"{candidate} loses {lost[candidate, test]} of {sum(one.sequences for one in counted[candidate, test])} on {SETS[test]}"
        for candidate in (paper.NNT, paper.NNT_U)
        if candidate in filters
        for test in SETS
    ]
    words = f"Sequences that lose definiteness without repair: {'; '.join(sentences)}." if sentences else ""
    return [
        "### Filters without repair",
        *([words] if words else []),
        tables.definiteness(counted, runs, list(SETS), f"definiteness_{name}", caption),
    ]


def _figure_4(part: PartArtefacts, name: str, runs: pd.DataFrame, where: str, data: dict[str, pd.DataFrame]) -> list[Block]:
    groups = models_by_candidate(part)
    shown: dict[str, EvaluatedModel] = {candidate: chosen(part, runs, candidate) for candidate in SHOWN_IN_FIGURE_4 if candidate in groups}
    if not shown:
        return []
    figure, drawn = traces.hard_sequence(part, shown, "tyre_d", name, where)
    data[f"traces_{name}"] = drawn
    return ["### A hard sequence", figure]


def _figures_5_and_6(part: PartArtefacts, name: str, where: str, data: dict[str, pd.DataFrame]) -> list[Block]:
    groups = models_by_candidate(part)
    by_seed: Sequence[dict[int, EvaluatedModel]] = [
        {model.seed: model for model in groups.get(candidate, [])} for candidate in (prediction.BEFORE, prediction.AFTER)
    ]
    seeds = sorted(set(by_seed[0]) & set(by_seed[1]))
    if not seeds:
        return []
    pairs = {seed: (loaded(by_seed[0][seed]), loaded(by_seed[1][seed])) for seed in seeds}
    drives = {test: drives_of(part, pairs[seeds[0]][0], test) for test in SETS}
    states, swaps = prediction.compared(pairs, drives, part.protocol)
    data |= {f"figure_5_{name}": states, f"figure_6_{name}": swaps}
    return [
        "### What learning through the filter changes",
        *prediction.figure_5(states, name, where),
        *prediction.figure_6(swaps, name, where),
    ]
