"""What is believed of a sample before an estimator sees it."""

import math

import numpy as np
import pytest

from conftest import planar_drive
from vehest.data.recording import Recording
from vehest.trust.guard import (
    RESTART,
    USE,
    WAIT,
    ChannelLimits,
    Guard,
    GuardLimits,
    learn_limits,
    usual_limits,
)

CHANNELS = ("yaw_rate", "vx", "ay", "ax")
RATE = 20.0


def rows_of(drive):
    return np.ascontiguousarray(drive.stack(CHANNELS))


def guard(skippable=(), limits=None):
    return Guard(CHANNELS, skippable, limits or usual_limits(CHANNELS, RATE), RATE)


def test_a_drive_without_faults_passes_as_it_is_once_every_channel_was_there(drive):
    cleaned = guard()(rows_of(drive))
    assert np.array_equal(cleaned.rows, rows_of(drive))
    assert cleaned.measured.all()
    assert cleaned.flow[0] == RESTART
    assert (cleaned.flow[1:] == USE).all()
    rows = rows_of(drive)
    rows[:5, 3] = math.nan
    flow = guard()(rows).flow
    assert (flow[:5] == WAIT).all()
    assert flow[5] == RESTART


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e6, -70.0, 30.0])
def test_an_impossible_value_is_replaced_by_the_last_valid_value(drive, value):
    rows = rows_of(drive)
    rows[100, 2] = value
    cleaned = guard()(rows)
    assert not cleaned.measured[100, 2]
    assert cleaned.rows[100, 2] == rows[99, 2]
    assert cleaned.measured.sum() == rows.size - 1


def test_a_channel_is_missing_for_as_long_as_another_can_be_skipped(drive):
    rows = rows_of(drive)
    rows[100, 2] = math.inf
    assert math.isnan(guard(("ay", "yaw_rate"))(rows).rows[100, 2])
    rows = rows_of(drive)
    rows[300:400, 0] = math.nan
    assert (guard(("ay", "yaw_rate"))(rows).flow[1:] == USE).all()
    rows[300:400, 2] = math.nan
    assert (guard(("ay", "yaw_rate"))(rows).flow == WAIT).sum() == 90


def test_a_spike_is_skipped_a_new_level_accepted_a_frozen_channel_unmeasured(drive):
    rows = rows_of(drive)
    rows[100, 2] += 12.0
    rows[200:, 2] += 12.0
    measured = guard(limits=learn_limits([drive], CHANNELS, RATE))(rows).measured[:, 2]
    assert np.flatnonzero(~measured).tolist() == [100, 200]
    limits = learn_limits([drive], CHANNELS, RATE)
    rows = rows_of(drive)
    rows[300:400, 0] = rows[299, 0]
    measured = guard(limits=limits)(rows).measured[:, 0]
    first = 300 + round(limits.channels["yaw_rate"].run * RATE)
    assert np.flatnonzero(~measured).tolist() == list(range(first, 400))


@pytest.mark.parametrize(("samples", "restarts"), [(10, 0), (11, 1), (60, 1)])
def test_gaps_up_to_half_a_second_are_bridged_and_longer_ones_start_anew(drive, samples, restarts):
    rows = rows_of(drive)
    rows[300 : 300 + samples, 1] = math.nan
    flow = guard()(rows).flow
    assert (flow[1:] == RESTART).sum() == restarts
    assert (flow == WAIT).sum() == max(samples - 10, 0)


@pytest.mark.parametrize(
    ("position", "believed"), [("at its lock", True), ("on the way there", False)]
)
def test_a_steering_that_stands_still_is_believed_at_its_lock_alone(drive, position, believed):
    steer = np.clip(0.4 * np.sin(0.5 * drive.time), -0.3, 0.35)
    driven = Recording("driven", "car", RATE, 0.0, {"vx": drive["vx"], "steer": steer})
    limits = learn_limits([driven], ("vx", "steer"), RATE)
    assert limits.channels["steer"].stops == pytest.approx((-0.3, 0.35), rel=3e-3)
    rows = np.stack([drive["vx"], steer], axis=1)
    first = int(np.flatnonzero(steer[:-1] == 0.35)[0]) if believed else int(np.argmax(steer > 0.1))
    rows[first : first + 60, 1] = rows[first, 1]
    measured = Guard(("vx", "steer"), (), limits, RATE)(rows).measured[first : first + 60, 1]
    assert measured.all() == believed


def test_speeds_have_no_lock_and_standing_cars_no_frozen_channels(drive):
    clipped_speed = np.minimum(drive["vx"], np.median(drive["vx"]))
    limits = learn_limits(
        [Recording("slow", "car", RATE, 0.0, {"vx": clipped_speed})], ("vx",), RATE
    )
    assert limits.channels["vx"].stops == (-1e300, 1e300)
    moving = planar_drive(20.0)
    rows = rows_of(moving)
    rows[100:300] = 0.0
    limits = learn_limits([moving], CHANNELS, RATE)
    stepped = guard(limits=limits)
    measured = np.concatenate([stepped(rows[k : k + 1]).measured for k in range(len(rows))])
    assert measured[110:300].all()


def test_limits_are_never_tighter_than_the_range_of_a_car(drive):
    gentle = Recording("gentle", "car", RATE, 0.0, {name: 0.1 * drive[name] for name in CHANNELS})
    limits = learn_limits([gentle], CHANNELS, RATE)
    usual = usual_limits(CHANNELS, RATE)
    for name, channel_limits in limits.channels.items():
        assert channel_limits.low <= usual.channels[name].low
        assert channel_limits.high >= usual.channels[name].high
        assert (
            channel_limits.jump
            >= usual.channels[name].jump - {"vx": 2.0, "yaw_rate": 0.5}.get(name, 6.0) - 1e-12
        )


def test_guard_row_by_row_equals_guard_at_once_to_the_last_bit(drive):
    generator = np.random.default_rng(3)
    rows = rows_of(drive)
    for _ in range(60):
        k = generator.integers(0, len(rows))
        c = generator.integers(0, 4)
        rows[k : k + generator.integers(1, 30), c] = generator.choice(
            [math.nan, math.inf, 0.0, 1e6, 3.0]
        )
    limits = GuardLimits({"ay": ChannelLimits(-20.0, 20.0, 2.0, 0.2)})
    at_once = guard(("ay",), limits)
    stepped = guard(("ay",), limits)
    together = at_once(rows)
    parts = [stepped(rows[k : k + 1]) for k in range(len(rows))]
    for name in ("rows", "measured", "flow"):
        assert np.array_equal(
            getattr(together, name),
            np.concatenate([getattr(part, name) for part in parts]),
            equal_nan=name == "rows",
        )
    assert (together.flow == WAIT).any()
    assert not together.measured.all()
