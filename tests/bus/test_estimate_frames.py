"""Estimates as frames: cantools reads back what was sent, finer than 1 mm/s and 0.001 degrees."""

import math
from functools import cache

import numpy as np
import pytest
from refusals import refusal

from vehest.data.errors import ConfigurationError
from vehest.trust.health import NO_ESTIMATE, reason_in_words

cantools = pytest.importorskip(
    "cantools", reason="cantools is not installed: pip install 'vehest[bus]'"
)
pytest.importorskip("can", reason="python-can is not installed: pip install 'vehest[bus]'")

from vehest.bus.messages import EstimateFrames, dbc_text  # noqa: E402

NAMES = {
    "vy": ("LateralVelocity", 1.0),
    "sideslip": ("SideslipAngle", 180 / math.pi),
    "yaw_rate": ("YawRate", 1.0),
    "band_vy": ("LateralVelocityBand", 1.0),
    "band_sideslip": ("SideslipAngleBand", 180 / math.pi),
}


@cache
def database(first_id):
    return cantools.database.load_string(dbc_text(first_id), "dbc")


def decoded(estimate, first_id=1776):
    signals = {}
    for frame in EstimateFrames(first_id)(estimate, 1.0):
        signals |= database(first_id).decode_message(frame.arbitration_id, frame.data)
    return signals


def test_cantools_decodes_the_sent_values_within_half_a_step():
    rng = np.random.default_rng(0)
    largest = {
        "vy": 60,
        "sideslip": math.pi,
        "yaw_rate": 4,
        "band_vy": 100,
        "band_sideslip": math.pi,
    }
    for _ in range(200):
        estimate = {
            name: rng.uniform(0 if "band" in name else -limit, limit)
            for name, limit in largest.items()
        }
        estimate |= {"health": float(rng.integers(3)), "health_reason": 10000.0 * NO_ESTIMATE}
        signals = decoded(estimate)
        for name, (signal, factor) in NAMES.items():
            assert float(str(signals[signal])) == pytest.approx(
                estimate[name] * factor, abs=0.00025 + 1e-9
            )
        assert str(signals["Health"]) == ("valid", "degraded", "invalid")[int(estimate["health"])]
        assert reason_in_words(float(str(signals["HealthReason"]))) == "there is no estimate"


def test_missing_values_are_not_available_and_excessive_ones_are_clipped():
    signals = decoded({"vy": math.nan, "sideslip": math.nan})
    assert {
        str(signals[name]) for name in (*(signal for signal, _ in NAMES.values()), "Health")
    } == {"not available"}
    signals = decoded(
        {
            "vy": 1e300,
            "sideslip": -math.inf,
            "yaw_rate": -50.0,
            "band_vy": math.inf,
            "band_sideslip": 1e9,
            "health": 2.0,
        }
    )
    ends = {
        "LateralVelocity": 262.1435,
        "SideslipAngle": -262.1435,
        "YawRate": -13.1071,
        "LateralVelocityBand": 524.287,
    }
    assert {name: signals[name] for name in ends} == pytest.approx(ends)
    assert decoded({"vy": 1.0, "sideslip": 0.0}, 0x123)["LateralVelocity"] == pytest.approx(1.0)
    assert "must lie between" in refusal(lambda: dbc_text(0x7FF), ConfigurationError)


def test_the_alive_counter_counts_estimates_modulo_16_in_both_frames():
    frames = EstimateFrames(1776)
    nothing = dict.fromkeys(("vy", "sideslip", "health", "health_reason"), 0.0)
    for k in range(20):
        for frame, counter in zip(
            frames(nothing, 0.0), ("AliveCounter", "BandAliveCounter"), strict=True
        ):
            signals = database(1776).decode_message(frame.arbitration_id, frame.data)
            assert signals[counter] == k % 16
