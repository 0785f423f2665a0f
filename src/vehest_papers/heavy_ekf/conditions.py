"""The paper's orders by condition: ratio, interval, significance and power."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import pandas as pd

from vehest.report.document import Column, Table
from vehest_papers.heavy_ekf import paper
from vehest_papers.heavy_ekf.candidates import FILTERS, WITH_STATE
from vehest_papers.heavy_ekf.cross_validation import TEST_SET
from vehest_papers.heavy_ekf.drawn import (
    CONDITIONS,
    MATCHED,
    TUNED_ON_ALL,
    TUNINGS,
    UNMATCHED,
)
from vehest_papers.kit.block_errors import BlockErrors, Key, blocks_of, training_of
from vehest_papers.kit.block_rows import BASELINE_NAMES, BlockRow, TrainingRow
from vehest_papers.kit.claim_files import Claim, Paper
from vehest_papers.kit.verdict_table import figure_in_words
from vehest_papers.kit.verdicts import (
    ALPHA,
    Figure,
    Judgement,
    judge_paper,
    keys_of,
    paired_errors,
    value_of,
)

FERRARI = "ferrari"
ORDERS = {
    "ratt_below_lint": (paper.RATT, paper.LINT),
    "ratte_below_ratt": (paper.RATTE, paper.RATT),
    "ratte_below_lint": (paper.RATTE, paper.LINT),
}
"""Claim -> the filters that it compares."""
ORDERS_CAPTION = (
    "The paper's orders in every condition: ratio of RMSE(β), first filter over second, with its "
    "95 % interval. 'lower' and 'higher': significant by Holm over this table; 'n.s.': no "
    "significant difference, in brackets the power to detect the paper's ratio. Trucks: "
    "SIMULATED, 20 drawn trucks, noise levels tuned on all conditions. Slow laps: SIMULATED, "
    "three laps at 30 to 45 km/h. Ferrari: REAL."
)
TUNING_CAPTION = (
    "The same ratios on the 20 drawn trucks, SIMULATED, by what the noise levels are tuned on. "
    "With the crossfall state, both filters of a pair have it. Holm over this table."
)
OVERVIEW_CAPTION = (
    "RMSE(β) [deg]; trucks and laps SIMULATED, Ferrari REAL. Trucks: noise levels tuned on all "
    "conditions; rear slip: 99th percentile over all laps."
)


@dataclass(frozen=True)
class Condition:
    """A column: which errors decide it."""

    title: str
    part: str
    test_set: str
    state: str = ""  # suffix of the filters that have the crossfall state


@dataclass(frozen=True)
class Entry:
    """A claim in a condition."""

    first: str
    second: str
    condition: str
    ratio: float  # of RMSE(β), first over second, of pooled errors
    low: float  # of its 95 % interval
    high: float
    p_value: float  # of the order, corrected by Holm over the table
    outcome: str  # lower, higher or n.s.
    verdict: str
    power: float  # to detect the paper's ratio at the level of Bonferroni
    blocks: int

    @property
    def pair(self) -> tuple[str, str]:
        """Both filters."""
        return self.first, self.second

    @property
    def text(self) -> str:
        """Ratio, interval and outcome."""
        power = f" ({100 * self.power:.0f} %)" if self.outcome == "n.s." else ""
        ratio = figure_in_words(Figure(self.ratio, self.low, self.high))
        return f"{ratio} {self.outcome}{power}"


MAIN = (
    Condition("trucks, level, all tyres", TUNED_ON_ALL, "level"),
    Condition("nominal", TUNED_ON_ALL, "nominal_level"),
    Condition("worn", TUNED_ON_ALL, "worn_level"),
    Condition("wet", TUNED_ON_ALL, "wet_level"),
    Condition("crossfall, all tyres", TUNED_ON_ALL, "crossfall"),
    Condition("crossfall, with state", TUNED_ON_ALL, "crossfall", WITH_STATE),
    Condition("slow laps, nominal", "truck", "nominal_laps"),
    Condition("slow laps, worn", "truck", "worn_laps"),
    Condition("slow laps, wet", "truck", "wet_laps"),
    Condition("Ferrari", FERRARI, TEST_SET),
)
BY_TUNING = tuple(
    Condition(f"{road}, {'with' if state else 'without'} state, {TUNINGS[part]}", part, road, state)
    for part in (TUNED_ON_ALL, MATCHED, UNMATCHED)
    for road in ("level", "crossfall")
    for state in ("", WITH_STATE)
)


def orders_tables(
    content: Paper, rows: Sequence[BlockRow], trained: Sequence[TrainingRow]
) -> tuple[Table, Table, pd.DataFrame]:
    """Table ``orders``, table ``tuning`` and the figures of both.

    Returns
    -------
    tuple of Table, Table and DataFrame
        Claims are rows of ``orders`` and conditions its columns; conditions are rows of
        ``tuning``. The frame has a row for each claim and condition, with its power.
    """
    blocks = blocks_of(rows)
    main = _judged(content, MAIN, blocks, trained)
    by_tuning = _judged(content, BY_TUNING, blocks, trained)
    by_condition = _judged(content, _every_tyre(), blocks, trained)
    titles = list(dict.fromkeys(entry.condition for entry in main))
    orders = pd.DataFrame(
        {"claim": _title(pair)}
        | {entry.condition: entry.text for entry in main if entry.pair == pair}
        for pair in ORDERS.values()
    )
    columns = {"claim": Column("claim")} | {title: Column(title) for title in titles}
    tuning = pd.DataFrame(
        {"tuned": TUNINGS[condition.part], "road": condition.test_set}
        | {"state": "on" if condition.state else "off"}
        | {
            _title(entry.pair): entry.text
            for entry in by_tuning
            if entry.condition == condition.title
        }
        for condition in BY_TUNING
    )
    tuning_columns = {
        "tuned": Column("noise tuned on"),
        "road": Column("road"),
        "state": Column("crossfall state"),
    } | {_title(pair): Column(_title(pair)) for pair in ORDERS.values()}
    every_entry = pd.DataFrame([*main, *by_tuning, *by_condition])
    return (
        Table("orders", ORDERS_CAPTION, orders, columns),
        Table("tuning", TUNING_CAPTION, tuning, tuning_columns),
        every_entry,
    )


def _every_tyre() -> tuple[Condition, ...]:
    """Every tyre, road, tuning and state of the drawn trucks alone, for the CSV file."""
    return tuple(
        Condition(f"{test_set}, {TUNINGS[part]}{state}", part, test_set, state)
        for part in TUNINGS
        for test_set in CONDITIONS
        for state in ("", WITH_STATE)
    )


def _title(pair: tuple[str, str]) -> str:
    return f"{pair[0]} / {pair[1]} (paper {1.0 - paper.GAINS[pair] / 100.0:.2f})"


def _judged(
    content: Paper,
    conditions: Sequence[Condition],
    blocks: Mapping[Key, BlockErrors],
    trained: Sequence[TrainingRow],
) -> list[Entry]:
    """An entry for each claim and condition whose errors are there, all corrected as one family."""
    by_id = {claim.id: claim for claim in content.claims}
    claims: dict[str, tuple[Claim, Condition]] = {}
    for condition in conditions:
        for identifier in ORDERS:
            claim = _in_condition(by_id[identifier], condition, f"order_{len(claims)}")
            first, second = keys_of(claim)
            if first in blocks and second in blocks:
                claims[claim.id] = (claim, condition)
    judgements = judge_paper(
        replace(content, claims=[claim for claim, _ in claims.values()]),
        blocks,
        training_of(trained),
    )
    return [
        _entry(claim, condition, judgements[claim.id], blocks, len(claims))
        for claim, condition in claims.values()
    ]


def _in_condition(claim: Claim, condition: Condition, identifier: str) -> Claim:
    return replace(
        claim,
        id=identifier,
        candidate=f"{claim.candidate}{condition.state}",
        other=f"{claim.other}{condition.state}",
        part=condition.part,
        test_set=condition.test_set,
        family="conditions",
    )


def _entry(
    claim: Claim,
    condition: Condition,
    judgement: Judgement,
    blocks: Mapping[Key, BlockErrors],
    n_claims: int,
) -> Entry:
    first, second = (blocks[key] for key in keys_of(claim))
    order = paired_errors(first, second, claim.metric, claim.id).order()
    assert claim.ratio is not None
    assert judgement.size is not None
    outcomes = {"no significant difference": "n.s.", "contradicted": "higher"}
    names = [name.removesuffix(WITH_STATE) for name in claim.names]
    return Entry(
        names[0],
        names[1],
        condition.title,
        judgement.size.value,
        judgement.size.low,
        judgement.size.high,
        judgement.p_value,
        outcomes.get(judgement.verdict, "lower"),
        judgement.verdict,
        order.power(math.log(claim.ratio), ALPHA / n_claims),
        judgement.n_blocks,
    )


def overview_table(rows: Sequence[BlockRow], slips: Mapping[str, float]) -> Table:
    """RMSE(β) of all candidates in every condition; ``slips``: test -> rear slip [deg]."""
    blocks = blocks_of(rows)
    tests = {f"{name.replace('_', ', ')}": (TUNED_ON_ALL, name) for name in CONDITIONS}
    tests |= {
        f"{speed} laps, {tyres}": ("truck", f"{tyres}_{test}")
        for speed, test in (("slow", "laps"), ("fast", "fast"))
        for tyres in ("nominal", "worn", "wet")
    }
    tests["real Ferrari"] = (FERRARI, TEST_SET)
    columns = {"test": Column("test"), "slip": Column("rear slip [deg]", decimals=1)}
    titles = {name: name for name in FILTERS} | {
        name: title for title, name in BASELINE_NAMES.items()
    }
    columns |= {title: Column(title, decimals=2) for title in titles.values()}
    table = []
    for test, (part, test_set) in tests.items():
        errors = {
            title: blocks[Key(part, name, test_set, "rmse_sideslip")]
            for name, title in titles.items()
            if Key(part, name, test_set, "rmse_sideslip") in blocks
        }
        if errors:
            row: dict[str, object] = {"test": test, "slip": slips.get(test_set, math.nan)}
            row |= dict.fromkeys(titles.values(), math.nan)
            row |= {
                title: value_of(of_test, "rmse_sideslip")[1].value
                for title, of_test in errors.items()
            }
            table.append(row)
    return Table("overview", OVERVIEW_CAPTION, pd.DataFrame(table), columns)
