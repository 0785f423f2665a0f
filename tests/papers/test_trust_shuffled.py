"""How often 0.90 lies in the interval of a band's coverage where calibration and test are alike."""

import numpy as np
import pandas as pd
import pytest

from vehest_papers.trust.shuffled import LEARNT, Scores, in_words, over_parts, share_if_shuffled, shuffled_in_words, together


def scores(manoeuvres, alike, seed, samples=40):
    """Sizes of Gaussian errors, of which a share of the variance is one number a manoeuvre."""
    generator = np.random.default_rng(seed)
    labels = np.repeat(np.arange(manoeuvres), samples)
    common = generator.standard_normal(manoeuvres)[labels]
    errors = np.sqrt(alike) * common + np.sqrt(1.0 - alike) * generator.standard_normal(len(labels))
    return Scores(np.abs(errors), labels)


def test_few_manoeuvres_that_say_all_hold_less_often_than_many_that_say_nothing():
    many = np.mean([share_if_shuffled(scores(150, 0.0, seed), scores(30, 0.0, 100 + seed), 60, seed) for seed in range(5)])
    few = np.mean([share_if_shuffled(scores(9, 0.6, seed), scores(8, 0.6, 100 + seed), 60, seed) for seed in range(5)])
    assert many > 0.9
    assert few < many - 0.05


def test_draws_are_the_same_again_and_take_no_notice_of_which_manoeuvre_was_tested():
    calibration, test = scores(8, 0.4, 1), scores(8, 0.4, 2)
    louder = Scores(3.0 * test.values, test.manoeuvres)
    assert share_if_shuffled(calibration, test, 50) == share_if_shuffled(calibration, test, 50)
    assert share_if_shuffled(calibration, louder, 200) == pytest.approx(share_if_shuffled(louder, calibration, 200), abs=0.12)


def test_too_few_manoeuvres_give_no_share():
    assert np.isnan(share_if_shuffled(scores(8, 0.4, 1), scores(2, 0.4, 2)))


def test_several_tests_together_have_a_narrower_interval_than_one():
    tests = [scores(10, 0.3, seed) for seed in range(5)]
    share = together(tests)[0]
    assert share == pytest.approx(np.mean([np.mean(own.values <= 1.0) for own in tests]))
    alone, fourfold = together(tests[:1]), together(tests[:1] * 4)
    assert fourfold[0] == pytest.approx(alone[0])
    assert fourfold[2] - fourfold[1] < 0.55 * (alone[2] - alone[1])


def test_the_report_tells_both_shares_and_sums_over_the_parts_of_a_drive():
    board = pd.DataFrame(
        {
            "part": ["one", "two"],
            "title": ["Real car, lap 1", "Real car, lap 2"],
            "test_set": "test",
            "estimator": "gru",
            "variant": "",
            "estimator_title": "GRU",
            "car": LEARNT,
            "inside": ["yes", "too wide"],
            "if_shuffled": [80.0, 60.0],
        }
    )
    words = shuffled_in_words(board)
    assert "50 % hold it" in words
    assert "70 % do" in words
    tests = [scores(10, 0.3, seed) for seed in range(2)]
    (table,) = over_parts(board, tests)
    assert table.frame["manoeuvres"].tolist() == [20]
    assert table.frame["where"].tolist() == ["Real car"]
    assert table.frame["inside"].tolist() == [in_words(*together(tests)[1:])]
    assert over_parts(board.iloc[:1], tests[:1]) == []
