"""Estimates as frames: cantools reads back what was sent, finer than 1 mm/s and 0.001 degrees."""

import math

import numpy as np
import pytest

from vehest.data.errors import ConfigurationError
from vehest.trust.health import NO_ESTIMATE, reason_in_words

cantools = pytest.importorskip("cantools", reason="cantools is not installed: pip install 'vehest[bus]'")
pytest.importorskip("can", reason="python-can is not installed: pip install 'vehest[bus]'")

from vehest.bus.messages import EstimateFrames, dbc_text  # noqa: E402

NAMES = {
    "vy": ("LateralVelocity", 1.0),
    "sideslip": ("SideslipAngle", 180 / math.pi),
    "yaw_rate": ("YawRate", 1.0),
    "band_vy": ("LateralVelocityBand", 1.0),
    "band_sideslip": ("SideslipAngleBand", 180 / math.pi),
}


def decoded(said, first_id=1776):
    database = cantools.database.load_string(dbc_text(first_id), "dbc")
    found = {}
    for frame in EstimateFrames(first_id)(said, 1.0):
        found |= database.decode_message(frame.arbitration_id, frame.data)
    return found


def test_cantools_reads_back_what_was_sent_within_half_a_step():
    rng = np.random.default_rng(0)
    for _ in range(200):
        said = {
            "vy": rng.uniform(-60, 60),
            "sideslip": rng.uniform(-math.pi, math.pi),
            "yaw_rate": rng.uniform(-4, 4),
            "band_vy": rng.uniform(0, 100),
            "band_sideslip": rng.uniform(0, math.pi),
            "health": float(rng.integers(3)),
            "health_reason": 10000.0 * NO_ESTIMATE,
        }
        found = decoded(said)
        for name, (signal, factor) in NAMES.items():
            assert float(str(found[signal])) == pytest.approx(said[name] * factor, abs=0.00025 + 1e-9)
        assert str(found["Health"]) == ("valid", "degraded", "invalid")[int(said["health"])]
        assert reason_in_words(float(str(found["HealthReason"]))) == "there is no estimate"


def test_resolution_is_below_1_mm_per_second_and_a_thousandth_of_a_degree():
    database = cantools.database.load_string(dbc_text(), "dbc")
    scales = {signal.name: signal.scale for message in database.messages for signal in message.signals}
    assert max(scales["LateralVelocity"], scales["LateralVelocityBand"]) < 1e-3
    assert max(scales["SideslipAngle"], scales["SideslipAngleBand"]) < 1e-3


def test_what_there_is_not_is_said_to_be_not_available():
    found = decoded({"vy": math.nan, "sideslip": math.nan})
    assert {str(found[name]) for name in ("LateralVelocity", "SideslipAngle", "YawRate", "LateralVelocityBand", "SideslipAngleBand")} == {
        "not available"
    }
    assert str(found["Health"]) == "not available"


def test_values_beyond_a_signal_are_cut_off_and_stay_values():
    found = decoded({"vy": 1e300, "sideslip": -math.inf, "yaw_rate": -50.0, "band_vy": math.inf, "band_sideslip": 1e9, "health": 2.0})
    assert found["LateralVelocity"] == pytest.approx(262.1435)
    assert found["SideslipAngle"] == pytest.approx(-262.1435)
    assert found["YawRate"] == pytest.approx(-13.1071)
    assert found["LateralVelocityBand"] == pytest.approx(524.287)


def test_the_alive_counter_counts_estimates_modulo_16_in_both_frames():
    database, frames = cantools.database.load_string(dbc_text(), "dbc"), EstimateFrames()
    for k in range(40):
        first, second = frames({"vy": 0.0, "sideslip": 0.0, "health": 0.0, "health_reason": 0.0}, 0.0)
        assert database.decode_message(first.arbitration_id, first.data)["AliveCounter"] == k % 16
        assert database.decode_message(second.arbitration_id, second.data)["BandAliveCounter"] == k % 16


def test_identifiers_can_be_moved_and_stay_standard_ones():
    assert decoded({"vy": 1.0, "sideslip": 0.0}, 0x123)["LateralVelocity"] == pytest.approx(1.0)
    with pytest.raises(ConfigurationError, match="must lie between"):
        dbc_text(0x7FF)
