"""Frames become samples at even instants: what is lost or late is missing, and nothing else."""

import numpy as np
import pytest
from refusals import refusal

from vehest.bus.sampling import Sampler, Timing, timing_of
from vehest.data.errors import ConfigurationError
from vehest.data.limits import Limits, use_limits

CYCLE = 0.01


def arrivals(n=2000, phase=0.003, jitter=0.0, period=CYCLE, seed=0):
    rng = np.random.default_rng(seed)
    return (
        phase + period * np.arange(n) + rng.uniform(0.0, jitter, n)
        if jitter
        else phase + period * np.arange(n)
    )


def run(timing, frames, until):
    sampler = Sampler(timing)
    samples = []
    for stamp, values in sorted(frames, key=lambda frame: frame[0]):
        while sampler.next_time < stamp:
            sample = sampler.sample()
            samples.append((sample.time, dict(sample.values), sample.missing))
        sampler.take(values, stamp)
    while sampler.next_time < until:
        sample = sampler.sample()
        samples.append((sample.time, dict(sample.values), sample.missing))
    return samples


def test_instants_lie_in_the_longest_pause_of_a_cycle():
    timing = timing_of(
        {"ay": arrivals(phase=0.001), "vx": arrivals(phase=0.003), "steer": arrivals(phase=0.002)}
    )
    assert timing.rate_hz == 100.0
    assert timing.start % CYCLE == pytest.approx(0.007, abs=1e-6)  # the pause from 3 ms to 11 ms
    clock = {"ay": 0.001, "vx": 0.003, "steer": 0.002}[timing.clock]
    assert timing.offset == pytest.approx((0.007 - clock) % CYCLE, abs=1e-6)
    assert "must be a positive number" in refusal(
        lambda: timing_of({"ay": arrivals()}, -5.0), ConfigurationError
    )
    assert "repeat their time stamps" in refusal(
        lambda: timing_of({"ay": np.zeros(10)}), ConfigurationError
    )


def test_every_frame_is_in_a_single_sample_despite_jitter_and_clock_error():
    stamps = arrivals(jitter=0.005, seed=4)
    timing = timing_of({"ay": stamps})
    samples = run(
        timing, [(stamp, {"ay": float(k)}) for k, stamp in enumerate(stamps)], stamps[-1] + 0.002
    )
    values = [sample["ay"] for _, sample, missing in samples if not missing]
    assert len(values) >= len(stamps) - 2
    assert np.diff(values).min() == np.diff(values).max() == 1.0
    stamps = arrivals(n=60_000, period=CYCLE * (1 + 1e-4))  # ten minutes, 60 ms of drift
    samples = run(
        Timing(100.0, {"ay": CYCLE}, "ay", 0.005, 0.008),
        [(stamp, {"ay": 1.0}) for stamp in stamps],
        stamps[-1],
    )
    assert not any(missing for _, _, missing in samples)
    assert len(samples) == pytest.approx(len(stamps), abs=1)


def test_lost_frames_are_missing_samples_and_a_late_frame_is_superseded():
    stamps = arrivals(jitter=0.001)
    lost = {50, 51, 700, 1203}
    timing = timing_of({"ay": stamps, "vx": stamps})
    frames = [
        (stamp, {"ay": float(k)} if k in lost else {"ay": float(k), "vx": float(k)})
        for k, stamp in enumerate(stamps)
    ]
    samples = run(timing, frames, stamps[-1])
    assert {int(values["ay"]) for _, values, missing in samples if missing == ["vx"]} == lost
    assert all("vx" not in values for _, values, missing in samples if missing)
    stamps = arrivals()
    timing = timing_of({"ay": stamps})
    late = stamps.copy()
    late[100] += 0.9 * CYCLE  # its instant is half a cycle after it was due
    samples = run(timing, [(stamp, {"ay": float(k)}) for k, stamp in enumerate(late)], late[-1])
    numbers = [values.get("ay") for _, values, _ in samples]
    at = numbers.index(99.0)
    assert numbers[at : at + 3] == [99.0, None, 101.0]


def test_slower_messages_are_valid_for_their_period_only():
    fast = arrivals()
    slow = arrivals(n=400, phase=0.0031, period=0.05)
    timing = timing_of({"ay": fast, "vx": slow})
    frames = [(stamp, {"ay": 1.0}) for stamp in fast] + [
        (stamp, {"vx": 2.0}) for k, stamp in enumerate(slow) if k != 200
    ]
    missing = [time for time, _, gone in run(timing, frames, fast[-1]) if "vx" in gone]
    assert len(missing) == 5
    assert missing[0] == pytest.approx(slow[200] + timing.offset, abs=CYCLE)


def test_a_stamp_far_ahead_is_refused_before_any_of_the_samples_in_between_is_formed():
    sampler = Sampler(timing_of({"ay": arrivals()}))
    first = sampler.next_time
    for ahead in (1e10, 1e308, np.inf):
        assert "remove a frame with a stray stamp" in refusal(
            lambda ahead=ahead: next(sampler.samples_before(ahead))
        )
    assert sampler.next_time == first
    with use_limits(Limits(samples=100)):
        assert len(list(sampler.samples_before(first + 99.5 * CYCLE))) == 100
