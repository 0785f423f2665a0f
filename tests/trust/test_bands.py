"""Bands: calibration against planted scales and exchangeable blocks, kernel against numpy, and what
is written and read back.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from refusals import refusal

from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.trust.bands import (
    CHANNEL_LEVEL,
    LEVELS,
    LOWEST_SPEED,
    OTHER_VEHICLE,
    TERMS,
    Piece,
    band_inputs,
    block_labels,
    calibrated,
    fitted_scale,
    pooled_quantile,
    terms_of,
    turns_of,
    with_bands,
)
from vehest.trust.record import TRUST, About, Trust, read_trust, write_trust

CHANNELS = ("yaw_rate", "vx", "ay", "ax", "steer")
ORIGIN = {
    "vehicles": ("my car",),
    "datasets": ("mine",),
    "scaled_on": ("one (all)",),
    "calibrated_on": ("two (all)",),
    "horizon_steps": 0,
}


def piece_of(rng, n, deviation=0.1, variance=math.nan):
    """A range at 20 Hz whose error grows with |ay|, σ² = deviation² + (0.05 ay)².

    One error a block of 100 samples, and noise.
    """
    rows = rng.standard_normal((n, 5)) * [0.3, 3.0, 3.0, 1.0, 0.05] + [0.0, 25.0, 0.0, 0.0, 0.0]
    sigma = np.sqrt(deviation**2 + (0.05 * rows[:, 2]) ** 2)
    shared = np.repeat(rng.standard_normal(n // 100 + 1), 100)[:n]
    error = sigma * (shared + rng.standard_normal(n)) / math.sqrt(2.0)
    time = np.arange(n) / 20.0
    return Piece(
        rows,
        rng.standard_normal(n),
        np.full(n, variance),
        np.stack([error, error / rows[:, 1]], 1),
        0.3 * np.sin(0.5 * time),
        20.0,
    )


def bands_of(**changes):
    rng = np.random.default_rng(0)
    return calibrated(
        [piece_of(rng, 6000, **changes)], [piece_of(rng, 4000, **changes)], CHANNELS, **ORIGIN
    )


def test_scale_follows_planted_growth_with_acceleration_or_filter_variance():
    rng = np.random.default_rng(1)
    terms = np.stack(
        [np.ones(200_000), 3.0 * rng.standard_normal(200_000), rng.standard_normal(200_000)], axis=1
    )
    errors = np.sqrt(0.04 + 0.01 * terms[:, 1] ** 2) * rng.standard_normal(200_000)
    weights, floor = fitted_scale(terms, errors)
    assert weights == pytest.approx([0.04, 0.01, 0.0], abs=1e-3)
    assert floor == pytest.approx(0.1 * np.sqrt(np.mean(errors**2)))
    rng = np.random.default_rng(2)
    deviation = rng.uniform(0.01, 0.3, 100_000)
    errors = 3.0 * np.sqrt(deviation**2 + 0.2**2) * rng.standard_normal(100_000)
    weights, _ = fitted_scale(np.stack([deviation, np.ones_like(deviation)], axis=1), errors)
    assert weights[0] == pytest.approx(9.0, rel=0.1)
    assert math.sqrt(weights[1] / weights[0]) == pytest.approx(0.2, rel=0.05)


def test_band_is_wider_where_errors_are_and_a_filters_takes_its_variance():
    assert set(bands_of(variance=0.01).vy.weights) <= {"variance", "one"}
    assert "ay" in bands_of().vy.weights
    bands = bands_of()
    rows = np.tile([0.0, 25.0, 0.0, 0.0, 0.0], (2, 1))
    rows[1, 2] = 6.0
    calm, hard = bands.half_widths(rows, np.zeros(2), np.full(2, np.nan))[:, 0]
    assert hard / calm == pytest.approx(math.sqrt(0.1**2 + 0.3**2) / 0.1, rel=0.25)


def test_pooled_quantile_of_single_samples_equals_split_conformal():
    scores = np.random.default_rng(3).exponential(size=40)
    for level in LEVELS:
        rank = math.ceil(level * 41)  # Lei et al. 2018, Theorem 2.2
        assert pooled_quantile(scores, np.arange(40), level) == (np.sort(scores)[rank - 1], False)


def test_each_block_counts_once_and_blocks_that_say_nothing_as_their_samples():
    scores = np.concatenate([np.full(1000, 5.0), np.arange(1.0, 9.0)])
    blocks = np.concatenate([np.zeros(1000, dtype=int), np.arange(1, 9)])
    assert pooled_quantile(scores, blocks, 0.5)[0] == 5.0
    assert pooled_quantile(scores, np.arange(1008), 0.003)[0] == 4.0
    scores = np.random.default_rng(5).permutation(np.arange(1.0, 1001.0))
    assert pooled_quantile(scores, np.arange(1000) // 100, 0.9)[0] == pytest.approx(901.0, abs=3.0)
    scores = np.repeat(np.arange(1.0, 6.0), 2)
    blocks = np.arange(10) // 2  # K = 5, alike within: levels up to 5/6
    assert pooled_quantile(scores, blocks, 0.9) == (pytest.approx(5.0 * 1.2), True)
    assert pooled_quantile(scores, blocks, 0.68)[1] is False


def test_coverage_of_a_further_block_averages_the_level():
    """Over 1000 draws of 12 blocks of unlike sizes and a further one.

    Tolerance: three standard errors, each about 0.012 at 0.5.
    """
    rng = np.random.default_rng(4)
    covered = {level: np.empty(1000) for level in (0.5, 0.68, 0.9)}
    for draw in range(1000):
        sizes = rng.integers(5, 60, 13)
        blocks = np.repeat(np.arange(13), sizes)
        scores = np.abs(
            np.exp(0.7 * rng.standard_normal(13))[blocks]
            * (rng.standard_normal(13)[blocks] + rng.standard_normal(len(blocks)))
        )
        is_calibration = blocks < 12
        for level, coverage in covered.items():
            coverage[draw] = np.mean(
                scores[~is_calibration]
                <= pooled_quantile(scores[is_calibration], blocks[is_calibration], level)[0]
            )
    for level, coverage in covered.items():
        error = coverage.std() / math.sqrt(len(coverage))
        assert (
            level - 3.0 * error <= coverage.mean() <= level + 0.02
        )  # with all weight of K at infinity it would be up to 1/13 more


def by_numpy(bands, rows, vy, variance, *, elsewhere):
    """Half widths at the level that is shown, (T, 2), by the formulas of `vehest.trust.bands`."""
    terms = terms_of(rows, vy, variance, bands.packed().columns)
    largest = np.array([bands.largest.get(name, 0.0) for name in TERMS])
    terms = np.where(np.isfinite(terms), terms, largest)
    features = np.array([name not in ("variance", "one") for name in TERMS]) & (largest > 0)
    wider = np.maximum((np.abs(terms[:, features]) / largest[features]).max(axis=1), 1.0) * (
        OTHER_VEHICLE if elsewhere else 1.0
    )
    half = []
    for channel_bands, feature in (
        (bands.vy, terms),
        (bands.sideslip, terms / np.maximum(np.abs(rows[:, [1]]), LOWEST_SPEED)),
    ):
        weights = np.array([channel_bands.weights.get(name, 0.0) for name in TERMS])
        scale = np.sqrt(np.maximum(np.square(feature) @ weights, channel_bands.floor**2))
        half.append(scale * wider * channel_bands.factors[LEVELS.index(CHANNEL_LEVEL)])
    half[1] = np.where(half[1] < math.pi, half[1], math.pi)
    return np.where(np.isfinite(vy)[:, None], np.stack(half, axis=1), np.nan)


@pytest.mark.parametrize("variance", [math.nan, 0.01])
@pytest.mark.parametrize("elsewhere", [False, True])
def test_kernel_agrees_with_numpy(variance, elsewhere):
    bands = bands_of(variance=variance)
    rng = np.random.default_rng(6)
    piece = piece_of(rng, 300, variance=variance)
    rows = piece.rows * 2.0
    vy = piece.vy.copy()
    spread = piece.variance.copy()
    rows[10, 0] = np.nan
    rows[20, 1] = np.nan
    vy[30] = np.nan
    spread[40] = -1.0
    rows[50, 1] = 0.0
    half_widths = bands.half_widths(rows, vy, spread, elsewhere=elsewhere)
    np.testing.assert_allclose(
        half_widths,
        by_numpy(bands, rows, vy, spread, elsewhere=elsewhere),
        rtol=1e-13,
        equal_nan=True,
    )


def test_blocks_are_ranges_where_there_are_ten_and_turns_of_two_seconds_elsewhere():
    yaw_rate = 0.3 * np.sin(
        2.0 * math.pi * np.arange(400) / 100.0
    )  # 20 s at 20 Hz, a turn each 2.5 s
    labels, kind = block_labels([yaw_rate] * 10, [400] * 10, 20.0)
    assert kind == "range"
    assert [block_of[0] for block_of in labels] == list(range(10))
    labels, kind = block_labels([yaw_rate, None], [400, 50], 20.0)
    assert kind == "turn"
    assert (
        len(np.unique(labels[0])) == 8
    )  # turns start at 0.13, 2.63 … s; that at 0.13 s comes too soon after the range's start
    assert np.unique(labels[1]).tolist() == [8]
    yaw_rate = np.zeros(200)
    yaw_rate[[50, 60, 70, 100, 190]] = 0.1
    labels = turns_of(yaw_rate, 20.0)
    assert np.flatnonzero(np.diff(labels)).tolist() == [49, 99]


def test_bands_record_their_calibration_and_need_a_reference():
    bands = bands_of()
    assert (bands.vehicles, bands.datasets, bands.calibrated_on) == (
        ("my car",),
        ("mine",),
        ("two (all)",),
    )
    assert bands.blocks == "turn"
    assert bands.n_blocks == 32  # 200 s, a turn each 2π s
    assert 1.0 < bands.vy.effective_blocks <= bands.n_blocks
    assert bands.seconds == 200.0
    rng = np.random.default_rng(9)
    blind = replace(piece_of(rng, 100), errors=np.full((100, 2), np.nan))
    assert "no sample of the validation ranges" in refusal(
        lambda: calibrated([piece_of(rng, 100)], [blind], CHANNELS, **ORIGIN)
    )


def test_an_estimate_gets_the_bands_of_the_last_sample_that_it_saw():
    rng = np.random.default_rng(10)
    n = 100
    piece = piece_of(rng, n)
    measured = Recording("lap", "my car", 20.0, 0.0, dict(zip(CHANNELS, piece.rows.T, strict=True)))
    estimate = Estimate(
        "lap",
        "some",
        20.0,
        0.0,
        {"vy": piece.vy, "sideslip": np.arctan2(piece.vy, piece.rows[:, 1])},
    )
    ahead = replace(bands_of(), horizon_steps=1)
    banded = with_bands(estimate, measured, ahead)
    expected = ahead.half_widths(piece.rows[:-1], piece.vy[1:], piece.variance[1:])
    np.testing.assert_allclose(
        np.stack([banded["band_vy"], banded["band_sideslip"]], 1)[1:], expected, rtol=1e-13
    )
    rows, _, variance = band_inputs(estimate, measured, CHANNELS, 0)
    assert np.array_equal(rows, piece.rows)
    assert np.isnan(variance).all()


def test_trust_is_read_back_as_it_was_written(tmp_path):
    trust = Trust(About("luenberger", "luenberger"), bands_of())
    write_trust(trust, tmp_path)
    assert read_trust(tmp_path) == trust
    write_trust(Trust(About("zero", note="no reference")), tmp_path)
    assert read_trust(tmp_path).bands is None


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("format: 1", "format: 2", "newer vehest"),
        ("floor: ", "floor: -", "floor must be positive"),
        ("n_blocks: 32", "n_blocks: many", "whole number"),
    ],
)
def test_a_damaged_record_is_refused(tmp_path, old, new, message):
    write_trust(Trust(About("luenberger"), bands_of()), tmp_path)
    file = tmp_path / TRUST
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(DataError, match=message):
        read_trust(tmp_path)
