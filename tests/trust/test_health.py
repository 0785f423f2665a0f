"""Health: healthy drives are not flagged, faults are, each with its reason.

Online agrees with batch to the last bit.
"""

import math
import os
import subprocess
import sys
from collections import Counter
from dataclasses import asdict
from functools import cache

import numpy as np
import pytest
import yaml
from measured_drive import CHANNELS, RATE, WHEELS, measured_drive
from refusals import refusal

from real_drives import real_drive
from small_car_drive import small_car_drive
from vehest.data.resampling import transforms_of
from vehest.data.schema import validated
from vehest.trust import health_kernel as kernel
from vehest.trust.front_end import FrontEnd
from vehest.trust.guard import usual_limits
from vehest.trust.health import (
    DEGRADED,
    HOLD_SECONDS,
    INVALID,
    NUMBERS,
    VALID,
    Health,
    HealthModel,
    domain_verdict,
    health_rows,
    learn_health,
    outside_domain,
    reason_in_words,
)

NAMES = {number: name for name, number in NUMBERS.items()}
ONSET = 2000  # sample, 40 s


@cache
def model_of(channels=CHANNELS):
    return learn_health([measured_drive(0), measured_drive(1)], [measured_drive(2)], channels, RATE)


def judged(model, drive, **faulty):
    """Health along a drive in which some channels are replaced."""
    rows = np.stack([faulty.get(name, np.asarray(drive[name])) for name in model.channels], axis=1)
    return health_rows(model.packed(), np.ascontiguousarray(rows), np.isfinite(rows), model.start())


def after(values, change, onset=ONSET):
    """The same samples, changed from the onset on."""
    changed = np.array(values)
    changed[onset:] = change(changed[onset:]) if callable(change) else change
    return changed


def reason_kind(code):
    return round(code) // 10_000


def reason_channel(code):
    return NAMES.get(round(code) % 10_000 // 100, "")


def usual_reason(health, begin, end):
    return Counter(health.reason[begin:end].tolist()).most_common(1)[0][0]


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_a_healthy_drive_that_was_not_learnt_from_is_valid(seed):
    health = judged(model_of(), measured_drive(seed))
    assert np.mean(health.status == VALID) > 0.999


FAULTS = {
    "frozen": ("yaw_rate", lambda part: part[0], kernel.FROZEN, 0.3),
    "sign of ay": ("ay", np.negative, kernel.SIGN, 1.0),
    "sign of the steering angle": ("steer", np.negative, kernel.SIGN, 1.0),
    "unit of the yaw rate": ("yaw_rate", np.degrees, kernel.UNIT, 0.1),
    "unit of ay": ("ay", lambda part: part / 9.81, kernel.UNIT, 1.0),
    "offset of ay": ("ay", lambda part: part + 1.5, kernel.OFFSET, 1.0),
    "offset of ax": ("ax", lambda part: part + 1.0, kernel.OFFSET, 1.0),
    "offset of the yaw rate": ("yaw_rate", lambda part: part + 0.05, kernel.OFFSET, 0.5),
    "held": ("ay", lambda part: np.repeat(part[::8], 8)[: len(part)], kernel.FROZEN, 0.5),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_faults_are_flagged_with_their_reason(fault):
    channel, change, kind, seconds = FAULTS[fault]
    drive = measured_drive(3)
    health = judged(model_of(), drive, **{channel: after(drive[channel], change)})
    assert (health.status[ONSET - 50 : ONSET] == VALID).all()
    assert (health.status[ONSET : ONSET + round(seconds * RATE)] > VALID).any()
    reason = usual_reason(health, ONSET + round(2 * RATE), ONSET + round(6 * RATE))
    equivalent_channels = (
        {"steer"} if fault == "offset of the yaw rate" else set()
    )  # the steering angle's relation holds as little as with an offset of its own
    assert reason_kind(reason) == kind, reason_in_words(reason)
    assert reason_channel(reason) in {channel} | equivalent_channels, reason_in_words(reason)


def test_without_a_steering_angle_ay_and_yaw_rate_contradict_each_other():
    model = model_of(("yaw_rate", "vx", "ay", "ax"))
    drive = measured_drive(3)
    health = judged(model, drive, ay=after(drive["ay"], np.negative))
    reason = usual_reason(health, ONSET + round(2 * RATE), ONSET + round(6 * RATE))
    assert reason_in_words(reason) == "ay and yaw_rate contradict each other"


def sliding(seed, slide=0.0):
    """A drive in which v grows by ``slide`` [m/s] and back within 2 s while the car turns, without
    a change of r or u.
    """
    drive = measured_drive(seed)
    ramp = np.zeros(len(measured_drive(seed)))
    first = ONSET + int(np.argmax(np.abs(drive["yaw_rate"][ONSET : ONSET + 1000]))) - 50
    ramp[first : first + 100] = slide * np.sin(np.linspace(0.0, np.pi, 100)) ** 2
    ax = drive["ax"] - ramp * drive["yaw_rate"]
    ay = drive["ay"] + np.gradient(ramp, 1.0 / RATE)
    return drive.with_channels({"ax": ax, "ay": ay})


@pytest.mark.parametrize(
    ("channels", "accused"),
    [(("yaw_rate", "vx", "ay", "ax"), False), (("yaw_rate", "vx", "ax"), True)],
)
def test_a_slide_does_not_accuse_the_longitudinal_acceleration_where_ay_tells_of_it(
    channels, accused
):
    """v r of a slide of 3 m/s is in ax. It is known from ay.

    Without ay it has to go with r², which it does in grip alone.
    """
    model = learn_health([sliding(0), sliding(1)], [sliding(2)], channels, RATE)
    rows = np.ascontiguousarray(sliding(3, 3.0).stack(channels))
    statistics = np.empty((len(rows), len(model.statistics)))
    kernel.health_kernel(
        rows, np.isfinite(rows), model.packed(), model.start(), np.empty((3, len(rows))), statistics
    )
    at = [
        k
        for k, statistic in enumerate(model.statistics)
        if (statistic.kind, statistic.channel) == (kernel.CONTRADICTION, "ax")
    ]
    assert bool((statistics[:, at] > np.array(model.limits)[at]).any()) is accused


def test_noise_jumps_and_lost_channels_are_reported():
    drive = measured_drive(3)
    health = judged(model_of(), drive, ay=after(drive["ay"], math.nan))
    assert health.status[ONSET] == DEGRADED
    assert health.status[ONSET + round(0.6 * RATE)] == INVALID
    assert reason_in_words(health.reason[ONSET]) == "ay is not measured"
    drive = measured_drive(3)
    generator = np.random.default_rng(0)
    noisy = judged(
        model_of(),
        drive,
        ax=after(drive["ax"], lambda part: part + 1.0 * generator.standard_normal(len(part))),
    )
    assert (
        reason_in_words(noisy.reason[ONSET + round(RATE)])
        == "ax jumps, or is noisier than in training"
    )
    spiky = np.array(drive["steer"])
    spiky[ONSET] += 0.1
    assert judged(model_of(), drive, steer=spiky).status[ONSET] > VALID


def test_a_flag_is_taken_back_after_the_fault():
    drive = measured_drive(3)
    part = np.array(drive["yaw_rate"])
    part[ONSET : ONSET + 100] += 0.05
    health = judged(model_of(), drive, yaw_rate=part)
    assert health.status[ONSET + round(0.1 * RATE) : ONSET + 100].all()
    assert health.status[ONSET + 100 : ONSET + 100 + round(HOLD_SECONDS * RATE)].all()
    assert not health.status[ONSET + round(20 * RATE) :].any()


def test_health_row_by_row_equals_health_at_once_to_the_last_bit():
    model = model_of()
    drive = measured_drive(4)
    rows = np.ascontiguousarray(drive.stack(CHANNELS))
    rows[1000:1200, 2] = np.nan
    rows[1500:1600, 0] = rows[1500, 0]
    rows[2000:2500, 1] *= 3.6
    rows[2600] = np.inf
    measured = np.isfinite(rows)
    packed = model.packed()
    at_once = health_rows(packed, rows, measured, model.start())
    state = model.start()
    single = [
        health_rows(packed, rows[k : k + 1], measured[k : k + 1], state) for k in range(len(rows))
    ]
    for name in Health._fields:
        np.testing.assert_array_equal(
            np.concatenate([getattr(part, name) for part in single]), getattr(at_once, name)
        )
    assert np.isfinite(at_once.ratio).all()


def test_without_compilation_health_is_the_same(tmp_path):
    """As under a debugger; 6 s of a drive with a fault."""
    model = model_of()
    drive = measured_drive(3)
    rows = np.ascontiguousarray(
        np.stack([np.asarray(drive[name]) for name in model.channels], axis=1)[:300]
    )
    rows[200:, 0] += 0.5
    measured = np.isfinite(rows)
    file = tmp_path / "health.npz"
    compiled = health_rows(model.packed(), rows, measured, model.start())
    np.savez(file, tables=model.packed(), rows=rows, measured=measured, start=model.start())
    program = "\n".join(
        (
            "import sys, numpy as np",
            "from vehest.trust.health import health_rows",
            "inputs = np.load(sys.argv[1])",
            "tables, rows, measured = inputs['tables'], inputs['rows'], inputs['measured']",
            "health = health_rows(tables, rows, measured, inputs['start'].copy())",
            "np.savez(sys.argv[1], status=health.status, reason=health.reason)",
        )
    )
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-c", program, str(file)], env=environment, check=True)
    plain = np.load(file)
    assert np.array_equal(plain["status"], compiled.status)
    assert np.array_equal(plain["reason"], compiled.reason)
    assert (compiled.status != VALID).any()


def test_senseless_values_leave_nothing_behind():
    model = model_of()
    drive = measured_drive(4)
    rows = np.ascontiguousarray(drive.stack(CHANNELS))
    healthy = health_rows(model.packed(), rows, np.isfinite(rows), model.start())
    for place, value in enumerate((1e200, -1e300, math.inf, math.nan, 1e7)):
        rows[1000 + 10 * place, place] = value
    health = health_rows(model.packed(), rows, np.ones(rows.shape, bool), model.start())
    assert (health.status[[1000, 1010, 1020, 1030, 1040]] > VALID).all()
    assert np.isfinite(health.ratio).all()
    later = slice(1040 + round(30 * RATE), None)
    np.testing.assert_allclose(health.ratio[later], healthy.ratio[later], rtol=0.2, atol=0.05)


def test_constant_training_channel_is_watched_and_a_training_glitch_sets_no_limit():
    drives = [
        drive.with_channels({"steer": np.zeros(len(drive))})
        for drive in map(measured_drive, range(4))
    ]
    model = learn_health(drives[:2], drives[2:3], CHANNELS, RATE)
    assert not judged(model, drives[3]).status.any()
    assert (
        judged(model, drives[3], steer=after(drives[3]["steer"], 0.01)).status[ONSET:] > VALID
    ).any()
    drive = measured_drive(0)
    steer = np.array(drive["steer"])
    steer[1234] += 0.2
    glitched = drive.with_channels({"steer": steer})
    model = learn_health([glitched, measured_drive(1)], [measured_drive(2)], CHANNELS, RATE)
    np.testing.assert_allclose(model.limits, model_of().limits, rtol=0.25)


MOTOR_CHANNELS = ("ax", "ay", "yaw_rate", "steer", "motor_speed", "motor_current")


def assert_faults_are_flagged(model, drive, onset, within):
    """Without a measured speed a wrong sign, a wrong unit and a frozen motor speed are flagged."""
    for channel, change in (
        ("yaw_rate", np.negative),
        ("ay", lambda part: part / 9.81),
        ("motor_speed", lambda part: part[0]),
    ):
        health = judged(model, drive, **{channel: after(drive[channel], change, onset)})
        assert (health.status[onset : onset + within] > VALID).any(), channel


def test_a_car_without_a_measured_speed_is_judged_by_its_motor():
    drives = [small_car_drive(60.0, seed) for seed in range(4)]
    model = learn_health(drives[:2], drives[2:3], MOTOR_CHANNELS, 100.0)
    assert np.mean(judged(model, drives[3]).status == VALID) > 0.99
    assert_faults_are_flagged(model, drives[3], ONSET, 100)


@pytest.mark.parametrize("braking", [False, True])
def test_a_locked_wheel_is_distinguished_from_a_lost_wheel_speed(braking):
    model = model_of((*CHANNELS, *WHEELS))
    drive = measured_drive(3)
    slows = np.clip(1.0 - np.arange(len(drive) - ONSET) / (0.2 * RATE), 0.0, 1.0)
    faulty = {"wheel_speed_fl": after(drive["wheel_speed_fl"], lambda part: part * slows)}
    if braking:
        slowing = np.minimum(np.arange(len(drive) - ONSET) / RATE, 1.0) * 8.0
        faulty["ax"] = after(drive["ax"], lambda part: part - 8.0 * (slowing < 8.0))
        faulty["vx"] = after(drive["vx"], lambda part: part - slowing)
        for name in WHEELS[1:]:
            faulty[name] = after(drive[name], lambda part: part - slowing / 0.3)
        faulty["wheel_speed_fl"] = after(
            drive["wheel_speed_fl"], lambda part: (part - slowing / 0.3) * slows
        )
    health = judged(model, drive, **faulty)
    words = reason_in_words(health.reason[ONSET + round(0.5 * RATE)])
    assert words == ("locked wheel: wheel_speed_fl" if braking else "lost wheel: wheel_speed_fl")


def test_saved_health_models_report_data_outside_training_and_other_rates():
    model = model_of()
    drive = measured_drive(3)
    fast = {name: np.array(drive[name]) for name in CHANNELS}
    assert domain_verdict(model, outside_domain(model, fast)) == ""
    fast["ay"][: len(drive) // 4] = 50.0
    assert domain_verdict(model, outside_domain(model, fast)).startswith(
        "25 % of the drive outside the range of the training: |ay| above "
    )
    model = model_of()
    read = validated(
        HealthModel, yaml.safe_load(yaml.safe_dump(plain(asdict(model)))), "'trust.yaml'"
    )
    np.testing.assert_array_equal(read.packed(), model.packed())
    assert "is sampled at 50 Hz, health was fitted at 20 Hz" in refusal(
        lambda: learn_health([measured_drive(0)], [], CHANNELS, 20.0)
    )


def plain(value):
    """Lists for tuples, as a writer of files has them."""
    if isinstance(value, dict):
        return {key: plain(inner) for key, inner in value.items()}
    return [plain(inner) for inner in value] if isinstance(value, (tuple, list)) else value


def ferrari(data_root, start, stop):
    return real_drive(data_root).cut(start, stop).without_references()


def test_the_ferrari_is_flagged_at_its_steering_glitches_and_rarely_elsewhere(
    data_root,
):
    train = ferrari(data_root, 150.0, 450.0)
    validation = ferrari(data_root, 450.0, 550.0)
    model = learn_health([train], [validation], CHANNELS, 100.0)
    health = judged(model, validation)
    at = [round((seconds - 450.0) * 100.0) for seconds in (503.49, 524.85)]
    assert (health.status[at] > VALID).all()
    assert all(reason_channel(health.reason[k]) == "steer" for k in at)
    assert not health.status[: at[0]].any()
    turned = judged(model, validation, yaw_rate=after(validation["yaw_rate"], np.degrees))
    assert turned.status[ONSET] == INVALID


def f1tenth(data_root, run):
    return real_drive(data_root, run, "f1tenth").without_references()


def f1tenth_model(data_root, runs):
    """Health fitted to runs, the last of which is for validation, and that one."""
    drives = [f1tenth(data_root, f"iros_hoons_1_with_friction_run_{k}") for k in runs]
    return learn_health(drives[:-1], drives[-1:], MOTOR_CHANNELS, 100.0), drives[-1]


def test_f1tenth_runs_are_judged_without_a_measured_speed(data_root):
    model, drive = f1tenth_model(data_root, (1, 3, 4, 0))
    healthy = judged(model, drive)
    outside = np.array(
        [reason_kind(code) == kernel.OUTSIDE for code in healthy.reason]
    )  # three runs hold less than all of ay
    assert not healthy.status[~outside].any()
    assert_faults_are_flagged(model, drive, len(drive) // 3, 300)


def test_a_steering_at_its_lock_is_not_frozen(data_root):
    model, _ = f1tenth_model(data_root, (1, 2, 3, 4, 0))
    assert model.stops[3] == pytest.approx((-0.531, 0.531), rel=3e-3)
    at_lock = f1tenth(data_root, "hoons_all_test_run_21")  # stays at full lock for 5 s
    health = judged(model, at_lock)
    assert kernel.FROZEN not in {
        reason_kind(code)
        for code, status in zip(health.reason, health.status, strict=True)
        if status > VALID
    }
    half = np.array(at_lock["steer"])
    half[400:] = 0.2
    frozen = judged(model, at_lock, steer=half)
    assert any(
        reason_kind(code) == kernel.FROZEN and reason_channel(code) == "steer"
        for code in frozen.reason[400:]
    )


def test_healthy_samples_behind_the_filter_from_a_faster_bus_are_not_flagged():
    slow = RATE / 5.0
    resampled = [
        transform(measured_drive(number).select(CHANNELS))
        for number in (0, 1, 2)
        for transform in transforms_of({"rate_hz": slow, "method": "polyphase", "transforms": []})
    ]
    model = learn_health(resampled[:2], resampled[2:], CHANNELS, slow)
    drive = measured_drive(3)
    front = FrontEnd(CHANNELS, (), usual_limits(CHANNELS, slow), RATE, slow)
    passed = [front(row[None]) for row in drive.stack(CHANNELS)]
    rows = np.concatenate([row for row in passed if row is not None])
    health = health_rows(
        model.packed(behind_front_end=True), rows, np.isfinite(rows), model.start()
    )
    assert (health.status > VALID).mean() < 0.02
    frozen = rows.copy()
    frozen[len(rows) // 2 :, 0] = frozen[len(rows) // 2, 0]
    flagged = health_rows(
        model.packed(behind_front_end=True), frozen, np.isfinite(frozen), model.start()
    )
    assert (flagged.status[len(rows) // 2 + 20 :] > VALID).mean() > 0.9
