"""Check of a filter's tyre model: a planted wrong one, a planted right one, its constants."""

import math
from dataclasses import replace

import numpy as np
import pytest
from refusals import refusal

from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.run.versions import code_of
from vehest.trust.bands import CHANNEL_LEVEL, LEVELS, Piece, calibrated, with_bands
from vehest.trust.record import About, Trust, read_trust, write_trust
from vehest.trust.tyre_check import FRICTION_SLIP, TyreCheck, squared_error_rows

RATE = 100.0
CHECK = TyreCheck(friction=0.6)
CHANNELS = ("vx", "ay", "yaw_rate")
ORIGIN = {
    "vehicles": ("small car",),
    "datasets": ("planted",),
    "scaled_on": ("a",),
    "calibrated_on": ("b",),
    "horizon_steps": 0,
}


def piece_of(friction, seed, seconds=120.0):
    """A range of a filter trained at a friction of 0.6, on tyres of which it estimates another.

    Its variance says 0.05 m/s throughout, which is right at 0.6. On other tyres the slip angle of
    a force is wrong by 0.05 rad for a factor of e, to the side to which the car turns.
    """
    generator = np.random.default_rng(seed)
    time = np.arange(round(seconds * RATE)) / RATE
    u = 2.0 + 0.4 * np.sin(0.7 * time + generator.uniform(0.0, 6.0))
    r = 1.5 * np.sin(2.1 * time + generator.uniform(0.0, 6.0))
    noise = np.repeat(generator.standard_normal(len(time) // 25 + 1), 25)[: len(time)]
    wrong_slip = 0.05 * math.log(friction / 0.6) * np.sign(r)
    error = 0.05 * noise + u * wrong_slip
    estimated_friction = friction * np.exp(0.02 * generator.standard_normal(len(time)))
    return Piece(
        np.stack([u, u * r, r], axis=1),
        0.3 * r + error,
        np.full(len(time), 0.05**2),
        np.stack([error, error / u], axis=1),
        r,
        RATE,
        CHECK.squared_errors(u, estimated_friction),
    )


def unchecked(piece):
    return replace(piece, tyre_error=None)


def coverage_and_width(bands, piece):
    """Share of errors of v within the 90 % band, and its mean half width [m/s]."""
    half = bands.half_widths(piece.rows, piece.vy, piece.variance, piece.tyre_error)[:, 0]
    return np.mean(np.abs(piece.errors[:, 0]) <= half), half.mean()


def test_band_covers_a_wrong_tyre_model_and_stays_as_wide_for_a_right_one():
    training = piece_of(0.6, 1)
    validation = piece_of(0.6, 2)
    plain = calibrated([unchecked(training)], [unchecked(validation)], CHANNELS, **ORIGIN)
    checked = calibrated([training], [validation], CHANNELS, **ORIGIN, tyre_check=CHECK)
    right = piece_of(0.6, 3)
    wrong = piece_of(0.2, 3)
    plain_coverage, plain_width = coverage_and_width(plain, unchecked(right))
    coverage, width = coverage_and_width(checked, right)
    assert 0.87 <= plain_coverage <= 0.95
    assert 0.87 <= coverage <= 0.95
    assert width == pytest.approx(plain_width, rel=0.02)
    coverage_of_wrong, width_of_wrong = coverage_and_width(plain, unchecked(wrong))
    assert coverage_of_wrong < 0.45
    assert width_of_wrong == pytest.approx(plain_width, rel=1e-3)
    coverage_of_wrong, width_of_wrong = coverage_and_width(checked, wrong)
    assert coverage_of_wrong > 0.9
    expected = np.mean(np.hypot(width, 1.645 * 0.05 * math.log(3.0) * wrong.rows[:, 0]))
    assert width_of_wrong == pytest.approx(expected, rel=0.03)  # 0.2 instead of 0.08 m/s


def test_weight_makes_the_check_add_its_own_90_percent_whatever_the_factor():
    bands = calibrated([piece_of(0.6, 1)], [piece_of(0.6, 2)], CHANNELS, **ORIGIN, tyre_check=CHECK)
    bands = replace(bands, vy=replace(bands.vy, weights={"one": 0.0}, floor=1e-9))
    rows = np.tile([2.0, 0.0, 0.0], (1, 1))
    nothing = np.zeros(1)
    half = bands.half_widths(rows, nothing, nothing, np.array([0.01]))[0, 0]
    assert half == pytest.approx(1.645 * 0.1, rel=0.02)
    factor = bands.vy.factors[LEVELS.index(CHANNEL_LEVEL)]
    assert bands.tyre_check.weights[0] == pytest.approx((1.645 / factor) ** 2, rel=0.04)


def test_error_is_that_of_the_slip_angle_and_0_without_an_estimate():
    vx = np.array([2.0, 2.0, -1.0, math.nan, 2.0, 2.0])
    friction = np.array([0.6, 0.6 * math.e, 0.6 / math.e, 0.3, math.nan, -0.1])
    expected = [0.0, (2.0 * FRICTION_SLIP) ** 2, FRICTION_SLIP**2, 0.0, 0.0, 0.0]
    together = CHECK.squared_errors(vx, friction)
    np.testing.assert_allclose(together, expected, rtol=1e-12, atol=1e-30)
    single = np.empty(1)
    for k in range(len(vx)):
        squared_error_rows(vx[k : k + 1], friction[k : k + 1], 0.6, single)
        assert single[0] == together[k]


def test_an_estimate_gets_the_band_of_its_friction_and_a_file_keeps_the_check(tmp_path):
    bands = calibrated([piece_of(0.6, 1)], [piece_of(0.6, 2)], CHANNELS, **ORIGIN, tyre_check=CHECK)
    piece = piece_of(0.2, 3)
    measured = Recording(
        "lap", "small car", RATE, 0.0, dict(zip(CHANNELS, piece.rows.T, strict=True))
    )
    estimate = Estimate(
        "lap",
        "some",
        RATE,
        0.0,
        {
            "vy": piece.vy,
            "sideslip": piece.vy / piece.rows[:, 0],
            "vx": piece.rows[:, 0],
            "friction": np.full(len(piece.vy), 0.2),
        },
    )
    expected = bands.half_widths(
        piece.rows,
        piece.vy,
        np.full(len(piece.vy), math.nan),
        CHECK.squared_errors(piece.rows[:, 0], np.full(len(piece.vy), 0.2)),
    )
    assert np.array_equal(with_bands(estimate, measured, bands)["band_vy"], expected[:, 0])
    trust = Trust(About("learned_ukf", "nntf_uh"), bands)
    write_trust(trust, tmp_path)
    assert read_trust(tmp_path) == trust


def test_a_model_without_friction_has_no_check_and_its_calibrations_keep_their_version():
    assert code_of("calibrate", "kalman") == "calibrate=3 kalman=1"
    assert code_of("calibrate", "learned_ukf").endswith(" tyre_check=1")
    assert "tyre_check" not in code_of("train", "learned_ukf")
    assert "tyre_check.friction" in refusal(lambda: replace(CHECK, friction=0.0), DataError)
