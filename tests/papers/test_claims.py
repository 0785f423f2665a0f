"""What a paper claims against errors whose outcome is known: reproduced, not reproduced, undecided, not testable."""

import math

import numpy as np
import pytest
from test_ranking import RATE, candidates, scored

from vehest.evaluation.blocks import segments_of
from vehest.evaluation.ranking import rank
from vehest_papers.kit.claims import bound_claim, claims_table, order_claim
from vehest_papers.kit.statements import percent

NAMES = {name: (name, name) for name in ("good", "other", "like", "zero", "static_map")}
TITLES = {pair: f"the {name}" for name, pair in NAMES.items()}


@pytest.fixture(scope="module")
def ranking():
    asked = [(NAMES["other"], NAMES["good"]), (NAMES["other"], NAMES["like"])]
    return rank(
        candidates(
            np.random.default_rng(3), good=0.1, other=0.3, like=0.3, zero=2.0, static_map=1.0
        ),
        RATE,
        asked=asked,
    )


def claimed(ranking, lower, higher):
    return order_claim(ranking, NAMES[lower], NAMES[higher], TITLES, "0.1° and 0.2°", "simulated")


def test_orders_and_limits_are_judged_by_their_intervals(ranking):
    right = claimed(ranking, "good", "other")
    wrong = claimed(ranking, "other", "good")
    open_ = claimed(ranking, "other", "like")
    assert [own.verdict for own in (right, wrong, open_)] == [
        "reproduced",
        "not reproduced",
        "undecided",
    ]
    one = ranking.pairs[NAMES["good"], NAMES["other"]]
    other = ranking.pairs[NAMES["other"], NAMES["good"]]
    assert (one.difference, one.low, one.high) == (-other.difference, -other.high, -other.low)
    assert one.high < 0 < other.low
    assert f"{one.difference:.3f}".replace("-", "−") in right.ours.replace("-", "−")
    low, high = ranking.intervals[NAMES["good"]]
    limits = (high * 1.01, low * 0.99, (low + high) / 2)
    verdicts = [
        bound_claim(ranking, NAMES["good"], "the good", limit, "below", "simulated").verdict
        for limit in limits
    ]
    assert verdicts == ["reproduced", "not reproduced", "undecided"]


def test_what_cannot_be_compared_is_not_testable_and_the_table_counts_its_verdicts(ranking):
    missing = order_claim(
        ranking,
        NAMES["good"],
        ("absent", "a"),
        {**TITLES, ("absent", "a"): "the absent"},
        "–",
        "real",
    )
    assert (missing.verdict, missing.why) == (
        "not testable on this data",
        "no finite error of the absent",
    )
    short = rank(
        {
            NAMES[name]: [segments_of([scored(0.1 * np.ones(40))], RATE)]
            for name in ("good", "zero")
        },
        RATE,
    )
    assert claimed(short, "good", "zero").verdict == "not testable on this data"
    assert (
        bound_claim(short, NAMES["good"], "the good", math.inf, "–", "real").verdict
        == "not testable on this data"
    )
    table = claims_table(
        [claimed(ranking, "good", "other"), claimed(ranking, "other", "like")], "A note."
    )
    assert "1 reproduced, 1 undecided" in table.caption
    assert table.caption.endswith("A note.")
    assert list(table.frame["verdict"]) == ["reproduced", "undecided"]


@pytest.mark.parametrize(
    ("ratio", "words"),
    [(0.76, "−24"), (1.03, "+3"), (0.9963, "−0.4"), (1.004, "+0.4"), (1.0002, "0"), (1.0, "0")],
)
def test_a_change_says_on_which_side_of_zero_it_lies(ratio, words):
    assert percent(ratio) == words
