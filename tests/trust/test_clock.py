"""Time stamps that stand still, go back, jump or are uneven make an estimate invalid, with a
reason, at the rates of estimators and of a bus.
"""

import math
import warnings
from functools import cache

import numpy as np
import pytest

from clock_faults import FAULTS, RATE_FAULTS, faulted_times
from every_estimator import drive_for, fitted
from vehest.trust.clock import CLOCK_JUMPED, CLOCK_STOPPED, CLOCK_UNEVEN, SampleClock
from vehest.trust.contract import GuardedStepper
from vehest.trust.health import INVALID, reason_in_words

START = 2.0  # s, of each fault
KINDS = {
    "constant": CLOCK_STOPPED,
    "runs_backwards": CLOCK_STOPPED,
    "back_one_sample_and_slow": CLOCK_UNEVEN,
    "back_far": CLOCK_JUMPED,
    "ahead_1_s": CLOCK_JUMPED,
    "ahead_1_h": CLOCK_JUMPED,
    "nan": CLOCK_UNEVEN,
    "inf": CLOCK_UNEVEN,
    "half_rate": CLOCK_UNEVEN,
    "double_rate": CLOCK_UNEVEN,
    "tenth_of_the_speed": None,  # of the two above whichever comes first at a rate
}


AT_EACH_RATE = pytest.mark.parametrize("name", ["kalman", "ksnn"])  # of 100 Hz and of 20 Hz


@cache
def ready(name):
    return fitted(name)


def run(stepper, times, samples):
    """Estimate, health and kind of reason of each call, (T, 3)."""
    rows = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for k, time in enumerate(times.tolist()):
            answer = stepper.step({name: values[k] for name, values in samples.items()}, time)
            rows.append((answer["vy"], answer["health"], answer["health_reason"] // 10_000))
    return np.array(rows)


def driven(name, kind, seconds=8.0):
    """A family's answers to a drive whose clock fails from `START` on, beside those with the right
    clock.
    """
    estimator = ready(name)
    rate = estimator.settings.rate_hz
    drive = drive_for(estimator)
    steps = min(len(drive), round(seconds * rate))
    samples = {channel: drive[channel][:steps] for channel in estimator.channels}
    times = np.arange(steps) / rate
    wrong = faulted_times(kind, times, round(START * rate), rate)
    return (
        run(GuardedStepper(estimator), wrong, samples),
        run(GuardedStepper(estimator), times, samples),
        rate,
    )


@pytest.mark.parametrize("kind", FAULTS + RATE_FAULTS)
@AT_EACH_RATE
def test_a_clock_fault_invalidates_within_a_fifth_of_a_second_at_every_rate(name, kind):
    answers, _, rate = driven(name, kind, 3.0)
    calls = max(round(0.2 * rate), 2)
    first = round(START * rate)
    at = first + calls
    assert (answers[at : at + calls, 1] == INVALID).all()
    expected = KINDS[kind]
    assert answers[at, 2] in ((CLOCK_UNEVEN, CLOCK_STOPPED) if expected is None else (expected,))
    assert reason_in_words(10_000.0 * answers[at, 2]).startswith("the time stamps")
    assert np.isfinite(answers[first:, 0]).all()


@pytest.mark.parametrize("kind", ["repeated_once", "back_once", "jitter", "nan_once", "each_twice"])
@AT_EACH_RATE
def test_a_repeated_stamp_and_jitter_leave_an_estimate_as_valid_as_it_was(name, kind):
    answers, right, _ = driven(name, kind, 4.0)
    assert not np.isin(answers[:, 2], [CLOCK_STOPPED, CLOCK_JUMPED, CLOCK_UNEVEN]).any()
    if kind == "jitter":
        np.testing.assert_array_equal(answers, right)


@pytest.mark.parametrize("stopped_seconds", [0.3, 3.0])
@pytest.mark.parametrize("resumes", ["where_it_stopped", "at_the_right_time"])
@AT_EACH_RATE
def test_an_estimate_is_valid_again_a_second_after_its_clock_resumed(
    name, resumes, stopped_seconds
):
    estimator = ready(name)
    rate = estimator.settings.rate_hz
    drive = drive_for(estimator)
    samples = {channel: drive[channel] for channel in estimator.channels}
    times = np.arange(len(drive)) / rate
    begin = round(START * rate)
    end = begin + round(stopped_seconds * rate)
    wrong = times.copy()
    wrong[begin:end] = times[begin - 1]
    if resumes == "where_it_stopped":
        wrong[end:] -= times[end] - times[begin]
    answers = run(GuardedStepper(estimator), wrong, samples)
    recovered = end + round(1.0 * rate)
    assert (answers[begin + round(0.2 * rate) : recovered - 1, 1] == INVALID).all()
    clock_kinds = [CLOCK_STOPPED, CLOCK_JUMPED, CLOCK_UNEVEN]
    assert not np.isin(answers[recovered + 1 :, 2], clock_kinds).any()
    right = run(GuardedStepper(estimator), times, samples)
    late = recovered + estimator.warm_up_steps + 1
    np.testing.assert_array_equal(answers[late:, 1], right[late:, 1])


def test_a_stopped_clock_fades_the_estimate_instead_of_repeating_it():
    """40 s of constant stamps: v goes to 0 with its band, instead of the last value with
    health 0.
    """
    estimator = ready("kalman")
    drive = drive_for(estimator)
    samples = {channel: drive[channel] for channel in estimator.channels}
    rate = estimator.settings.rate_hz
    times = np.minimum(np.arange(len(drive)) / rate, START)
    answers = run(GuardedStepper(estimator), times, samples)
    fades = round((START + 0.2 + 0.5 + 5.0) * rate)
    before = abs(answers[round((START + 0.6) * rate), 0])
    assert abs(answers[fades, 0]) <= before * math.exp(-4.9)
    assert (answers[round((START + 0.2) * rate) :, 1] == INVALID).all()


@pytest.mark.parametrize("kind", FAULTS)
def test_a_clock_fault_on_a_faster_bus_invalidates_after_a_fifth_of_a_second(
    kind,
):
    estimator = ready("ksnn")
    drive = drive_for(estimator)
    bus_rate = 200.0
    steps = round(6.0 * bus_rate)
    times = np.arange(steps) / bus_rate
    samples = {
        channel: np.interp(times, np.arange(len(drive)) / drive.rate_hz, drive[channel])
        for channel in estimator.channels
    }
    first = round(START * bus_rate)
    wrong = faulted_times(kind, times, first, bus_rate)
    answers = run(GuardedStepper(estimator, bus_rate_hz=bus_rate), wrong, samples)
    at = first + round(0.2 * bus_rate)
    assert (answers[at : at + 40, 1] == INVALID).all()
    assert (answers[at : at + 40, 2] == KINDS[kind]).all()


def test_calls_without_a_stamp_count_as_even_ones_and_end_a_fault():
    clock = SampleClock(100.0)
    clock.missing_before(0.0)
    clock.missing_before(5.0)
    assert clock.fault == CLOCK_JUMPED
    for _ in range(100):
        clock.unstamped()
    assert clock.fault == 0
    assert clock.missing_before(5.0 + 101 / 100.0) == 0


@pytest.mark.parametrize("time", [1e308, -1e308, 10**400, -(10**400), math.nan, math.inf, True])
def test_no_stamp_of_any_size_raises_or_makes_a_step_long(time):
    stepper = GuardedStepper(ready("zero"))
    sample = dict.fromkeys(ready("zero").channels, 1.0)
    for stamp in (0.0, 0.01, time, 0.02, time, 0.03):
        assert np.isfinite(stepper.step(sample, stamp)["vy"])
