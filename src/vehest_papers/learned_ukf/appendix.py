"""The appendices: orders, errors by state, consistency, slip angles, budgets, trials, departures, and what was used for what."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import pandas as pd

from vehest.data.splits import Span
from vehest.report.document import Block, Column, Table, as_code
from vehest.report.style import fixed
from vehest.studies.artefacts import PartArtefacts, StudyArtefacts
from vehest_papers.kit import methods
from vehest_papers.kit.reading import lengths_of, recordings_of, spans_in_words, words_of_kinds
from vehest_papers.learned_ukf import paper, slips, tables
from vehest_papers.learned_ukf.candidates import SETS
from vehest_papers.learned_ukf.departures import departures, settings_table
from vehest_papers.learned_ukf.errors import Losses
from vehest_papers.learned_ukf.filtering import loaded
from vehest_papers.learned_ukf.order import differences, order_in_words, pairs_table
from vehest_papers.learned_ukf.trials import trials_table


def appendix_of_part(
    title: str,
    name: str,
    part: PartArtefacts,
    runs: pd.DataFrame,
    errors: Mapping[str, Losses],
    where: str,
    data: dict[str, pd.DataFrame],
) -> list[Block]:
    """Orders of all pairs, errors by state, consistency, slip angles and budgets of a main part."""
    kind = words_of_kinds(part).upper()
    blocks: list[Block] = [f"## Appendix: the paper's order\n\n{title}, {kind}."]
    for test, tyre in SETS.items():
        published = {candidate: own.mse for candidate, own in paper.TABLES[test].items()}
        pairs = differences(
            errors[test].squared, errors[test].sequence, published, part.protocol.rate_hz
        )
        data[f"pairs_{test}_{name}"] = pairs
        if pairs.empty:
            continue
        blocks += [
            order_in_words(pairs, tables.medians(runs, f"mse_weighted.{test}"), f"on {tyre}"),
            pairs_table(
                pairs[pairs["neighbours"]],
                f"neighbours_{test}_{name}",
                f"Differences of MSE (weighted) between neighbours in the paper's order, {tyre}; negative where the paper's order holds. "
                f"All pairs: [CSV](tables/pairs_{test}_{name}.csv). Data: {kind}.",
            ),
        ]
    state = f"Root mean square errors by state, median and range of seeds; in brackets what the paper reports, on its own files. Data: {kind}."
    consistent = (
        f"Consistency of the filters: normalised estimation errors squared over vx, vy and yaw rate (NEES) and normalised innovations "
        f"squared (NIS), 1 for a consistent filter and above 1 for one too sure of itself; share of vy's errors within one and two of "
        f"the filter's own standard deviations. Data: {kind}."
    )
    budget = (
        f"What was spent: seeds, and epochs as medians of seeds. {paper.NNTF_UH_LOW} is {paper.NNTF_UH} with another start and shares its "
        f"training. Data: {kind}."
    )
    return [
        *blocks,
        "## Appendix: errors by state, and whether filters know them",
        tables.by_state(runs, list(SETS), f"by_state_{name}", state),
        tables.consistency(runs, list(SETS), f"consistency_{name}", consistent),
        *_slips(part, name, where, data),
        "## Appendix: budgets",
        tables.budget(part, runs, f"budget_{name}", budget),
    ]


def how_it_was_made(
    artefacts: StudyArtefacts,
    main: Mapping[str, PartArtefacts],
    data: dict[str, pd.DataFrame],
) -> list[Block]:
    """Trials, the protocol, what was used for what with its minutes, and what departs from the paper."""
    first = next(iter(main.values()))
    trained = {model.estimator for part in artefacts.parts.values() for model in part.models}
    data["training_settings"] = settings_table(main)
    lines = [
        f"Command: {as_code(artefacts.command)}",
        methods.scoring(first),
        "Metrics: squared and absolute errors of vx, vy [m/s] and yaw rate [rad/s], weighted 0.2225, 0.5064 and 0.1566 and summed at each "
        "sample; their means are MSE (weighted) and MAE, the 99th percentile of the absolute ones is 99%-AE. Units are mixed, as in the "
        "paper. NEES and NIS are divided by their dimension; coverage is that of the bands of vy.",
        "Figures that show one seed show the one with the lowest MSE (weighted) on the validation range. Test data choose nothing but the "
        "oracle, which learns from them.",
        "Intervals: block bootstrap over whole sequences and over seeds, paired by sequence, 95 % by Student's t.",
        _authors_code(),
        *(fact for fact in methods.facts_of(main.values()) if not fact.startswith(tuple(trained))),
        "Every setting of every training: [CSV](tables/training_settings.csv).",
    ]
    blocks: list[Block] = []
    if artefacts.trials:
        remarks = " ".join(f"{line[0].upper()}{line[1:]}." for line in artefacts.search_remarks)
        table = trials_table(artefacts.trials)
        blocks += ["## Appendix: trials", *([remarks] if remarks else []), table]
    return [
        *blocks,
        methods.how_it_was_made(lines),
        _ranges(artefacts, main),
        methods.bullets("## Appendix: what departs from the paper", departures(main)),
    ]


def _authors_code() -> str:
    """How the authors' code was measured, on the files that it was run on."""
    values = " and ".join(
        f"{fixed(value, 4)} on {SETS[test]}" for test, value in paper.AUTHORS_CODE.items()
    )
    return (
        f"Beside this study stands the authors' public code, run once on the same split: {paper.NNTF_UH}, 1000 epochs one-step and 1000 "
        f"through the filter, one seed, on a CPU, gave {values}. No interval, so no comparison is made."
    )


def _ranges(artefacts: StudyArtefacts, main: Mapping[str, PartArtefacts]) -> Table:
    rows: list[dict[str, object]] = []
    for name, part in main.items():
        row: dict[str, object] = {
            "part": artefacts.titles[name],
            "kind": words_of_kinds(part).upper(),
        }
        for label, spans in (
            ("train", part.split.train),
            ("validation", part.split.validation),
            *part.split.tests.items(),
        ):
            row[label] = (
                f"{spans_in_words(spans)}; {fixed(minutes(part, spans), 1)} min{_sequences(part, label)}"
            )
        rows.append(row)
    columns = {
        "part": Column("part"),
        "kind": Column("data"),
        "train": Column("training"),
        "validation": Column("validation"),
    }
    columns |= {test: Column(f"test, {tyre}") for test, tyre in SETS.items()}
    caption = (
        f"What was used for what, with minutes of driving. The paper has {paper.MINUTES:g} min in all and learns on about "
        f"{fixed(paper.MINUTES_LEARNT, 1)} min of tyre A ({100 * paper.SHARE_LEARNT:g} % of {100 * paper.SHARE_OF_TYRE_A:g} %)."
    )
    return Table("data", caption, pd.DataFrame(rows), columns)


def minutes(part: PartArtefacts, spans: Sequence[Span]) -> float:
    """Of driving in ranges."""
    return sum(lengths_of(part, spans)) / part.protocol.rate_hz / 60.0


def _sequences(part: PartArtefacts, test: str) -> str:
    counted = part.metrics[
        (part.metrics["test_set"] == test) & (part.metrics["metric"] == "n_sequences")
    ]["value"]
    return (
        f"; {int(counted.iloc[0])} sequences"
        if len(counted) and math.isfinite(counted.iloc[0])
        else ""
    )


def _slips(
    part: PartArtefacts, name: str, where: str, data: dict[str, pd.DataFrame]
) -> list[Block]:
    filters = [model for model in part.models if model.estimator == "learned_ukf"]
    if not filters:
        return []
    distance = loaded(filters[0]).settings.car.cg_to_rear_axle
    sets = {
        "training": part.split.train,
        **{f"test, {tyre}": part.split.tests[test] for test, tyre in SETS.items()},
    }
    angles = {
        label: slips.rear_slip(recordings_of(part, own), distance) for label, own in sets.items()
    }
    note = f"The rear axle lies {distance:g} m behind the centre of gravity, where learning starts from."
    figure, table, drawn = slips.distribution(angles, name, where, note)
    data[f"slip_density_{name}"] = drawn
    return ["## Appendix: slip angles", figure, table]
