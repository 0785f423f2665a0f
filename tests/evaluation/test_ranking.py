"""Blocks, intervals of single figures, and who may be called best, on errors whose outcome is
known.
"""

import numpy as np
import pytest
from arch.bootstrap import optimal_block_length
from refusals import refusal
from scipy import signal

from vehest.evaluation.blocks import (
    COLUMNS,
    _length,
    _pooled_covariances,
    _window,
    block_labels,
    block_sums,
    figure_intervals,
    politis_white_length,
    read_segments,
    segments_of,
    write_segments,
)
from vehest.evaluation.metrics import Scored, accuracy
from vehest.evaluation.ranking import rank
from vehest.evaluation.significance import holm, root_intervals, unexplained_interval
from vehest.trust.bands import effective_blocks

RATE = 20.0


def scored(error, vy_ref=None):
    """A range whose lateral velocity is off by ``error`` [m/s] at 20 m/s."""
    reference = np.zeros_like(error) if vy_ref is None else vy_ref
    time = np.arange(len(error)) / RATE
    beta = np.arctan2(reference + error, 20.0)
    beta_ref = np.arctan2(reference, 20.0)
    is_scored = np.ones(len(error), dtype=bool)
    ay = np.zeros_like(error)
    return Scored(time, reference + error, reference, beta, beta_ref, ay, is_scored)


def coloured(generator, n, memory=0.95):
    return signal.lfilter(
        [np.sqrt(1.0 - memory**2)], [1.0, -memory], generator.standard_normal(n + 400)
    )[400:]


def test_segments_reproduce_the_metrics(tmp_path):
    generator = np.random.default_rng(0)
    parts = [scored(0.1 * coloured(generator, n), coloured(generator, n)) for n in (330, 95)]
    segments = segments_of(parts, RATE)
    figures = accuracy(parts)
    n = segments.samples.sum()
    assert n == 425
    assert list(segments.piece) == [0.0] * 17 + [1.0] * 5
    assert np.sqrt(segments.squared_error_vy.sum() / n) == pytest.approx(
        figures["rmse_vy"], rel=1e-12
    )
    assert np.sqrt(segments.squared_error_sideslip.sum() / n) == pytest.approx(
        figures["rmse_sideslip"], rel=1e-12
    )
    sums = [
        getattr(segments, name)
        for name in ("squared_error_vy", "error_vy", "squared_vy_ref", "vy_ref", "samples")
    ]
    assert unexplained_interval(*sums).value == pytest.approx(figures["fvu"], rel=1e-9)
    write_segments(tmp_path / "blocks.csv", {"test": segments})
    back = read_segments(tmp_path / "blocks.csv")["test"]
    assert all(np.array_equal(getattr(back, name), getattr(segments, name)) for name in COLUMNS)
    (tmp_path / "blocks.csv").write_text("test_set,piece\ntest,0\n")
    assert "start" in refusal(lambda: read_segments(tmp_path / "blocks.csv"))


def with_stop(part):
    """The same range with a stop at its end, in which sideslip is not scored and its error is 90
    degrees.
    """
    n = round(12.0 * RATE)
    columns = {"vy": 0.0, "vy_ref": 0.0, "sideslip": np.pi / 2, "sideslip_ref": 0.0, "ay": 0.0}
    stopped = {
        name: np.append(getattr(part, name), np.full(n, value)) for name, value in columns.items()
    }
    return Scored(
        time=np.arange(len(part.time) + n) / RATE,
        is_sideslip_scored=np.append(part.is_sideslip_scored, np.zeros(n, dtype=bool)),
        **stopped,
    )


def test_a_stop_changes_no_ranking_and_no_interval_of_sideslip():
    generator = np.random.default_rng(5)
    errors = {"zero": 0.5, "static_map": 0.4, "good": 0.05}
    parts = {name: scored(size * coloured(generator, 2000)) for name, size in errors.items()}
    rankings = [
        rank(
            {
                (name, ""): [segments_of([scored_part], RATE)]
                for name, scored_part in candidates.items()
            },
            RATE,
        )
        for candidates in (
            parts,
            {name: with_stop(scored_part) for name, scored_part in parts.items()},
        )
    ]
    assert rankings[0] == rankings[1]
    assert rankings[1].winner == ("good", "")
    part = parts["zero"]
    moving, stopping = (
        figure_intervals(segments_of([scored_part], RATE))
        for scored_part in (part, with_stop(part))
    )
    assert stopping["rmse_sideslip"] == moving["rmse_sideslip"]
    assert stopping["rmse_vy"] != moving["rmse_vy"]
    assert "mse_sideslip" in moving
    assert "mse_sideslip" not in stopping  # of all samples, those of the stop too


@pytest.mark.parametrize("memory", [0.3, 0.5, 0.9, 0.95])
def test_block_length_is_that_of_another_library(memory):
    """Which begins to look for insignificant autocorrelations one lag earlier than the paper says,
    and so has a window wider by two.
    """
    values = np.square(coloured(np.random.default_rng(7), 900, memory))
    expected = float(optimal_block_length(values)["circular"].iloc[0])
    covariances = _pooled_covariances([values])
    window = _window(covariances, 900)
    assert _length(covariances, min(window + 2, len(covariances) - 1), 900) == pytest.approx(
        expected, rel=1e-9
    )
    assert politis_white_length([values]) == _length(covariances, window, 900)


def test_blocks_are_ranges_where_many_and_cuts_where_few():
    generator = np.random.default_rng(1)
    many_ranges = segments_of([scored(coloured(generator, 100)) for _ in range(9)], RATE)
    assert list(block_labels(many_ranges, many_ranges.squared_error_vy[None])) == [
        label for label in range(9) for _ in range(5)
    ]
    few_ranges = segments_of([scored(coloured(generator, 4000)) for _ in range(2)], RATE)
    labels = block_labels(few_ranges, few_ranges.squared_error_vy[None])
    assert 2 < labels.max() + 1 < 400
    assert not set(labels[few_ranges.piece == 0]) & set(labels[few_ranges.piece == 1])
    assert politis_white_length([np.ones(50)]) == 1.0


@pytest.mark.parametrize("memory", [0.0, 0.98])
def test_intervals_of_an_rmse_cover_it_at_about_the_nominal_rate(memory):
    generator = np.random.default_rng(2)
    covered = []
    for _ in range(200):
        segments = segments_of([scored(coloured(generator, 6000, memory))], RATE)
        labels = block_labels(segments, segments.squared_error_vy[None])
        (interval,) = root_intervals(
            [block_sums(segments.squared_error_vy[None], labels)],
            block_sums(segments.samples, labels),
            n_resamples=400,
        )
        covered.append(interval.low <= 1.0 <= interval.high)
    assert 0.90 <= np.mean(covered) <= 0.99


def test_holm_and_effective_blocks_are_the_textbooks():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert effective_blocks(np.ones(20)) == pytest.approx(20.0)
    assert effective_blocks(np.array([1.0, *[0.0] * 19])) == pytest.approx(1.0)


def candidates(generator, **levels):
    """Three seeds each with errors of these sizes, partly common, over one drive of 300 s."""
    common = coloured(generator, 6000)
    return {
        (name, name): [
            segments_of([scored(level * (0.6 * common + 0.8 * coloured(generator, 6000)))], RATE)
            for _ in range(3)
        ]
        for name, level in levels.items()
    }


def test_winners_are_named_where_they_are_clear_and_beat_the_baselines():
    ranking = rank(
        candidates(np.random.default_rng(3), good=0.1, other=0.3, zero=2.0, static_map=1.0), RATE
    )
    assert ranking.winner == ("good", "good")
    assert ranking.order[0] == ("good", "good")
    assert ranking.beats(("other", "other"), "zero")
    assert ranking.pairs[ranking.order[0], ("other", "other")].high < 0.0
    low, high = ranking.intervals[("good", "good")]
    assert low < ranking.rmse[("good", "good")] < high
    wrongly = 0
    generator = np.random.default_rng(4)
    for _ in range(10):
        ranking = rank(candidates(generator, a=0.2, b=0.2, c=0.2, zero=2.0, static_map=1.0), RATE)
        wrongly += ranking.winner is not None
    assert wrongly <= 1
    ranking = rank(
        candidates(np.random.default_rng(5), a=1.0, b=3.0, zero=5.0, static_map=1.0), RATE
    )
    assert ranking.winner is None
    assert ranking.beats(("b", "b"), "static_map") is False
    without = rank(candidates(np.random.default_rng(5), a=0.1, b=3.0, zero=5.0), RATE)
    assert without.winner is None
    assert without.missing_baselines == ["static_map"]
    short = {
        name: [segments_of([scored(0.1 * np.ones(40))], RATE)]
        for name in (("a", "a"), ("zero", "zero"))
    }
    ranking = rank(short, RATE)
    assert ranking.n_blocks < 3
    assert ranking.winner is None
    assert not ranking.intervals
