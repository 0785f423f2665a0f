"""From time stamps to a uniform clock, and from a file's columns to channels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refusal

from vehest.data.errors import ConfigurationError, DataError
from vehest.data.limits import Limits, use_limits
from vehest.data.recording import Recording
from vehest.data.transforms import Resample
from vehest.sources.base import open_source
from vehest.sources.clocks import unevenness, uniform_clock, uniform_times
from vehest.sources.columns import Column, column_from_config, columns_from_config
from vehest.sources.surveys import survey

RATES = [1e-3, 10.0, 12.5, 20.0, 29.97, 51.2, 100.0, 125.0, 1000.0 / 3.0, 400.0, 1000.0]
PROPERTY = settings(max_examples=120, deadline=None, derandomize=True, database=None)


@PROPERTY
@given(
    st.sampled_from(RATES),
    st.integers(2, 2000),
    st.sampled_from([0.0, 149.99, -12.5, 1_700_000_123.456]),
)
def test_the_rate_that_was_meant_comes_back_at_any_start(rate, length, start):
    clock = uniform_clock(start + np.arange(length) / rate, "'file'")
    assert clock.rate_hz == pytest.approx(rate, rel=1e-12)
    assert (clock.start_time, clock.n_samples, clock.stamps) == (start, length, None)


@pytest.mark.parametrize("rate", [125.0, 1000.0 / 3.0])
def test_time_stamps_rounded_to_milliseconds_can_be_resampled_to_20_hz(rate):
    stamps = np.round(1_700_000_000.0 + np.arange(500) / rate, 3)
    clock = uniform_clock(stamps, "'file'", "interpolate")
    recording = Recording(
        "lap", "car", clock.rate_hz, clock.start_time, {"ay": np.zeros(clock.n_samples)}
    )
    assert clock.rate_hz == pytest.approx(rate, rel=1e-12)
    assert Resample(20.0)(recording).rate_hz == 20.0


@pytest.mark.parametrize(
    "share", [0.1, 0.2, 0.24]
)  # from a quarter on, a long step cannot be told from a lost sample
@pytest.mark.parametrize("rate", [20.0, 100.0, 125.0])
def test_the_rate_survives_strong_jitter_and_gaps(rate, share):
    generator = np.random.default_rng(5)
    stamps = (np.arange(1000) + share * generator.uniform(-1, 1, 1000)) / rate
    remaining_stamps = np.delete(stamps, [*range(300, 350), 500, 777])
    clock = uniform_clock(remaining_stamps, "'file'", "interpolate")
    assert clock.rate_hz == rate
    assert clock.n_samples == pytest.approx(1000, abs=1)


def test_jitter_beyond_a_hundredth_of_an_interval_and_gaps_need_interpolation():
    even = np.arange(1000) / 100.0
    noise = np.random.default_rng(0).uniform(-1, 1, 1000)
    assert uniform_clock(even + 4e-5 * noise, "'file'").rate_hz == 100.0
    assert "set dataset.clock=interpolate" in refusal(
        lambda: uniform_clock(even + 2e-3 * noise, "'file'")
    )
    assert uniform_clock(even + 2e-3 * noise, "'file'", "interpolate").rate_hz == 100.0
    stamps = np.delete(even[:300], np.s_[100:200])
    assert "cut the range out or set dataset.clock=interpolate" in refusal(
        lambda: uniform_clock(stamps, "'file'")
    )
    clock = uniform_clock(stamps, "'file'", "interpolate")
    assert (clock.rate_hz, clock.n_samples) == (100.0, 300)
    np.testing.assert_allclose(clock.align(5.0 * stamps), 5.0 * even[:300], atol=1e-12)
    stamps = even[:200] + 1e-3 * noise[:200]
    slow = np.where(np.arange(200) % 5 == 0, np.arange(200.0), np.nan)
    aligned = uniform_clock(stamps, "'file'", "interpolate").align(slow, gappy=True)
    measured = ~np.isnan(aligned)
    assert aligned[measured].tolist() == slow[::5].tolist(), (
        "every measured sample of a slow channel is kept"
    )
    assert np.abs(np.flatnonzero(measured) - aligned[measured]).max() <= 1


def test_units_and_signs_are_applied_and_misspelt_ones_refused():
    values = np.array([1.0, -2.0, 0.5])
    np.testing.assert_allclose(Column("a", "g", -1).to_si(values, "m/s²"), -9.80665 * values)
    np.testing.assert_allclose(Column("a", "deg/s").to_si(values, "rad/s"), np.deg2rad(values))
    np.testing.assert_array_equal(Column("a", "m/s").to_si(values, "m/s"), values)
    assert column_from_config({"column": "t", "unit": "ms"}, "here", "s") == Column("t", "ms")
    assert column_from_config({"column": 3, "unit": "s", "sign": -1}, "here", "s") == Column(
        "3", "s", -1
    ), "YAML reads it as a number"
    for act, message in (
        (
            lambda: columns_from_config({"vz": {"column": "a", "unit": "m/s"}}, "mine"),
            "data set 'mine': channel 'vz': channel 'vz' is not known",
        ),
        (
            lambda: columns_from_config({"vx": {"column": "a", "unit": "deg"}}, "mine"),
            "unit 'deg' cannot be converted to 'm/s'",
        ),
        (
            lambda: column_from_config({"column": "t", "unit": "km/h"}, "here", "s"),
            "here: unit 'km/h' cannot be converted to 's'",
        ),
    ):
        assert message in refusal(act, ConfigurationError)


EVEN = np.arange(1000) / 100.0


@pytest.mark.parametrize("policy", ["strict", "interpolate"])
@pytest.mark.parametrize(
    ("stamps", "message_part"),
    [
        (
            EVEN[[0, 1, 1, 2]],
            "time repeats 1 time, first at sample 2 (0.01 s); repair, remove or sort the rows",
        ),
        (EVEN[[0, 2, 1, 3]], "time goes backwards 1 time, first at sample 2"),
        (EVEN[:1], "fewer than two"),
        (
            np.append(EVEN, 1e9),
            "a gap of 1e+09 s between sample 999 (9.99 s) and 1000 (1000000000 s); remove the "
            "stray stamp",
        ),
        (EVEN * 1e-4, "the time stamps lie 1e-06 s apart"),
        (
            EVEN * 1e8,
            "the time stamps lie 1e+06 s apart (from 0 s to 999000000 s); correct the unit of time",
        ),
        (1.7e18 + EVEN * 1e9, "time stamp of sample 0 is 1.7e+18 s, which is no time of a drive"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_time_stamps_of_no_drive_are_refused_in_one_line_whatever_the_policy(
    policy, stamps, message_part
):
    message = refusal(lambda: uniform_clock(stamps, "'lap.csv'", policy))
    assert message.startswith("'lap.csv': ")
    assert message_part in message


def test_every_recording_of_a_source_keeps_the_rule_and_surveys_name_a_stray_time_stamp(tmp_path):
    file = tmp_path / "lap.csv"
    file.write_text("vx\n" + "1.0\n" * 100, encoding="utf-8")
    declared = {
        "name": "mine",
        "source": "tabular",
        "path": str(tmp_path),
        "channels": {"vx": {"column": "vx", "unit": "m/s"}},
    }
    assert open_source({**declared, "rate_hz": 9e4}).read("lap").rate_hz == 9e4
    for read in (lambda source: source.read("lap"), lambda source: source.read_file(file)):
        message = refusal(lambda read=read: read(open_source({**declared, "rate_hz": 2e5})))
        assert (
            "recording 'lap': the sampling rate must lie between 1e-06 and 100000 Hz, not at "
            "200000 Hz" in message
        )
    for rows in (1000, 400):
        stamps = np.where(np.arange(1000) == rows - 1, 1e9, EVEN)
        np.savetxt(
            file,
            np.stack([stamps, EVEN], axis=1),
            delimiter=",",
            header="time,vx",
            comments="",
            fmt="%.3f",
        )
        with pytest.raises(
            DataError,
            match=rf"lap\.csv': time spans .* between sample {rows - 2} .* and {rows - 1} "
            rf"\(1000000000 s\)",
        ):
            survey(file)


def test_an_even_clock_over_a_gap_stays_within_the_limit_of_samples_and_withstands_a_stall():
    stamps = np.append(EVEN, 3e5)
    message = refusal(lambda: uniform_clock(stamps, "'lap.csv'", "interpolate"))
    assert "over 1001 rows would hold 30000001 samples, more than the limit" in message
    assert "limits.samples=NUMBER" in message
    with use_limits(Limits(samples=30_000_001)):
        assert uniform_clock(stamps, "'lap.csv'", "interpolate").n_samples == 30_000_001
    times = np.arange(2000) / 100 * 1.00003
    stamps = times.copy()
    stamps[700:715] = stamps[715]  # 150 ms nothing, then all at once
    found, rate_hz, _ = uniform_times(stamps, 100.0, "topic")
    np.testing.assert_allclose(found, times, rtol=0, atol=1e-9)
    assert rate_hz == pytest.approx(100.0 / 1.00003, rel=1e-12)


@pytest.mark.parametrize(
    ("stamps", "found"),
    [
        (
            np.delete(EVEN, np.s_[300:350]),
            "1 gap, the longest of 0.51 s after 2.99 s (interval 0.01 s)",
        ),
        (np.delete(EVEN, 500), "1 gap, the longest of 0.02 s after 4.99 s"),
        (
            EVEN + np.where(np.arange(1000) % 2, 5e-4, 0.0),
            "intervals deviate by up to 9.5 % from the median of 0.0105 s",
        ),
        (np.cumsum(np.linspace(0.00995, 0.01005, 5000)), "the clock drifts: at "),
    ],
)
def test_gaps_jitter_and_drift_are_found_with_their_size(stamps, found):
    assert unevenness(stamps).startswith(found)


@pytest.mark.parametrize(
    ("stamps", "message_part"),
    [
        (EVEN[:10], "10 samples are too few"),
        (np.arange(300) / 99.0, "samples come at 99 Hz, not at 100 Hz"),
        (np.zeros(300), "inf Hz, not at 100 Hz"),
        (
            np.concatenate([EVEN[:150], EVEN[140:290]]),
            "time goes backwards 1 time, first at sample 150",
        ),
        (
            np.cumsum(np.linspace(0.996, 1.004, 3000)) / 100,
            "samples are missing or the clock drifts",
        ),
        *(
            (
                np.ceil(np.delete(np.arange(2000), at) / 100 / 0.00277) * 0.00277,
                "samples are missing or the",
            )
            for at in (300, 1000, 1800)
        ),
    ],
)
def test_stamps_without_an_even_clock_behind_them_are_refused(stamps, message_part):
    message = refusal(lambda: uniform_times(stamps, 100.0, "topic"))
    assert message.startswith("topic: ")
    assert message_part in message
