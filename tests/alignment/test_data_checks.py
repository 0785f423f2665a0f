"""Checks: each one fires on the fault it is for, and a clean drive gets none of them."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from broadband_drive import broadband_drive, changed, found_by, warned, without

from vehest.alignment.checks import checks_of_recording
from vehest.configuration.composition import compose_config
from vehest.data.recording import Recording
from vehest.data.transforms import MountingCorrection
from vehest.sources.base import open_source

RATE = 100.0
LENGTH = 6000
FERRARI = "20140222_01_01_03_250lm"


def clean_drive(rate=RATE, seconds=60.0, noise=1.0):
    """A car that obeys d(vy)/dt = ay - vx·yaw_rate and d(vx)/dt = ax + vy·yaw_rate, seen by sensors
    with a little noise.
    """
    time = np.arange(round(seconds * rate)) / rate
    generator = np.random.default_rng(0)
    yaw_rate = 0.25 * np.sin(2 * np.pi * 0.11 * time) + 0.15 * np.sin(2 * np.pi * 0.43 * time + 1.0)
    vx = 22.0 + 4.0 * np.sin(2 * np.pi * 0.05 * time)
    vy = -1.2 * yaw_rate + 0.4 * np.sin(2 * np.pi * 0.29 * time)
    ay = np.gradient(vy, 1 / rate) + vx * yaw_rate
    ax = np.gradient(vx, 1 / rate) - vy * yaw_rate
    exact = {"vx": vx, "yaw_rate": yaw_rate, "ax": ax, "ay": ay, "steer": 0.13 * yaw_rate}
    levels = {"vx": 0.02, "yaw_rate": 0.003, "ax": 0.1, "ay": 0.1, "steer": 0.001}
    channels = {
        name: samples + noise * levels[name] * generator.standard_normal(len(time))
        for name, samples in exact.items()
    }
    references = {"vx_ref": vx, "vy_ref": vy, "sideslip_ref": np.arctan2(vy, vx)}
    return Recording("lap", "car", rate, 10.0, {**channels, **references})


def with_standstill(recording, **resting):
    """The car stands from 20 s to 35 s; the inertial sensors show their noise."""
    inside = slice(*recording.index_range(20.0, 35.0))
    channels = {name: samples.copy() for name, samples in recording.channels.items()}
    generator = np.random.default_rng(7)
    for name, samples in channels.items():
        quiet = {"ax": 0.05, "ay": 0.05, "yaw_rate": 0.003}.get(name, 0.0)
        samples[inside] = resting.get(name, 0.0) + quiet * generator.standard_normal(
            len(samples[inside])
        )
    return replace(recording, channels=channels)


def stuck(value, start, stop):
    """What a channel becomes that shows one value from one sample to another."""
    return lambda samples: np.where(
        (np.arange(LENGTH) >= start) & (np.arange(LENGTH) < stop), value, samples
    )


def complaints(recording):
    return [(finding.level, finding.check, finding.channel) for finding in warned(recording)]


def only_complaint(recording):
    (finding,) = warned(recording)
    assert "\n" not in finding.message
    return finding


@pytest.mark.parametrize("rate", [20.0, 100.0, 1000.0 / 3.0])
@pytest.mark.parametrize("seconds", [0.01, 0.1, 1.0, 60.0])
def test_a_clean_drive_gets_no_complaint_at_any_rate_and_length(rate, seconds):
    recording = clean_drive(rate, max(seconds, 3.0 / rate))
    assert complaints(recording) == []


def test_a_clean_drive_is_noted_to_follow_the_kinematics_and_a_bias_is_the_accelerometers():
    notes = [finding for finding in checks_of_recording(clean_drive()) if finding.level == "note"]
    assert [(note.check, note.channel) for note in notes] == [("kinematics", "vy_ref")]
    note = checks_of_recording(changed(clean_drive(noise=0.0), ay=lambda ay: ay + 0.25))[0]
    assert "mean difference -0.250 m/s²" in note.message


def test_an_impossible_value_is_found_with_its_time_and_degrees_are_hinted_at():
    findings = only_complaint(changed(clean_drive(), ay=stuck(500.0, 1234, 1235)))
    assert (findings.level, findings.check, findings.channel) == ("error", "impossible", "ay")
    assert "1 sample outside" in findings.message
    assert "500 m/s² at t = 22.34 s" in findings.message
    findings = checks_of_recording(changed(clean_drive(), yaw_rate=np.rad2deg))
    assert (findings[0].level, findings[0].check, findings[0].channel) == (
        "error",
        "impossible",
        "yaw_rate",
    )
    assert "if the column is in degrees, set its unit" in findings[0].message


def test_ay_and_yaw_rate_turned_together_leave_two_explanations():
    finding = only_complaint(changed(clean_drive(), ay=np.negative, yaw_rate=np.negative))
    assert (finding.level, finding.check, finding.channel) == ("warning", "sign", "")
    assert (
        "set sign: -1 for ay and yaw_rate together or sideslip_ref, steer and vy_ref together"
        in finding.message
    )


def test_kinematics_are_judged_on_moving_cars_alone():
    finding = only_complaint(
        changed(clean_drive(), vy_ref=lambda vy: np.roll(vy, round(2.5 * RATE)))
    )
    assert (finding.level, finding.check, finding.channel) == ("warning", "kinematics", "vy_ref")
    generator = np.random.default_rng(0)
    parked = {"vx": 0.01, "yaw_rate": 0.002, "ax": 0.05, "ay": 0.05, "vy_ref": 0.01}
    channels = {name: level * generator.standard_normal(LENGTH) for name, level in parked.items()}
    assert complaints(Recording("parked", "car", RATE, 0.0, channels)) == []


def test_channels_with_gaps_are_noted_and_keep_the_checks_that_need_all_samples_silent():
    recording = clean_drive()
    slow = np.where(np.arange(LENGTH) % 5 == 0, recording["vy_ref"], np.nan)
    findings = checks_of_recording(changed(recording, gappy={"vy_ref"}, vy_ref=slow))
    assert [(finding.level, finding.check, finding.channel) for finding in findings] == [
        ("note", "nan", "vy_ref")
    ]
    assert "80.0 %" in findings[0].message


def test_a_stuck_channel_is_found_with_value_time_and_duration_and_short_or_held_ones_are_not():
    finding = only_complaint(changed(clean_drive(), ay=stuck(1.5, 2000, 2250)))
    assert (finding.level, finding.check, finding.channel) == ("warning", "stuck", "ay")
    assert "constant at 1.5 m/s² for 2.5 s from t = 30 s" in finding.message
    finding = only_complaint(changed(clean_drive(), steer=lambda steer: np.full_like(steer, 0.02)))
    assert (finding.check, finding.channel) == ("stuck", "steer")
    assert "constant at 0.02 rad throughout" in finding.message
    assert complaints(changed(clean_drive(), ay=stuck(1.5, 2000, 2050))) == []
    assert complaints(changed(clean_drive(), steer=lambda steer: np.repeat(steer[::10], 10))) == [
        ("warning", "held", "steer")
    ]
    recording = clean_drive()
    slow = np.where(np.arange(LENGTH) % 5 == 0, recording["steer"], np.nan)
    slow[2000:2500:5] = 0.03
    finding = only_complaint(changed(recording, gappy={"steer"}, steer=slow))
    assert (finding.check, finding.channel) == ("stuck", "steer")
    assert "4.96 s" in finding.message


def test_a_channel_of_coarse_steps_is_not_stuck_where_it_goes_on_by_one_of_them():
    coarse = changed(clean_drive(), steer=lambda steer: 0.005 * np.round(steer / 0.005))
    held = np.repeat(coarse["steer"][1000:1001], 150)
    slow = np.concatenate([coarse["steer"][:1000], held, coarse["steer"][1000:-150]])
    assert "stuck" not in {finding.check for finding in warned(changed(coarse, steer=slow))}
    jumping = stuck(0.08, 2000, 2250)(coarse["steer"])
    assert found_by("stuck", changed(coarse, steer=jumping)).keys() == {"steer"}


def test_an_offset_that_no_inclination_explains_questions_the_column():
    """As of a temperature that is named ay: before, the warning spoke of 90 degrees and offered to
    remove 25 m/s².
    """
    drive = changed(broadband_drive(), ax=lambda ax: ax + 25.0)
    message = found_by("offset", drive)["ax"].message
    assert "too large for an inclined sensor; check the column, its unit and its axis" in message
    assert "offset_correction" not in message


@pytest.mark.parametrize("offset", [-1.7, 0.0, 0.4, 1.0])
def test_an_accelerometer_that_is_pitched_has_an_offset_of_ax_without_a_reference(offset):
    drive = changed(broadband_drive(), ax=lambda ax: ax + offset)
    drive = without(drive, "vx_ref", "vy_ref", "sideslip_ref")
    found = found_by("offset", drive)
    assert set(found) == ({"ax"} if abs(offset) > 0.5 else set())
    if found:
        value = float(re.search(r"offset of (\S+) m", found["ax"].message)[1])
        assert value == pytest.approx(offset, abs=0.05)


@pytest.mark.parametrize("steer", [0.0, 0.4])
def test_a_car_at_standstill_may_rest_its_steering_wheel_at_any_angle(steer):
    assert complaints(with_standstill(clean_drive(), steer=steer)) == []


def test_stuck_channels_are_told_from_standstill():
    findings = found_by("stuck", changed(clean_drive(), vx=stuck(0.0, 2000, 3000)))
    assert findings.keys() == {"vx"}
    assert "constant at 0 m/s for 10 s from t = 30 s" in findings["vx"].message
    findings = only_complaint(
        changed(with_standstill(clean_drive()), steer=stuck(0.03, 4000, 4200))
    )
    assert (findings.check, findings.channel) == ("stuck", "steer")
    assert "0.03 rad for 2 s from t = 50 s" in findings.message


@pytest.mark.parametrize(
    ("low", "high", "sides"),
    [(-4.0, 4.0, 2), (-100.0, 4.0, 1), (-2.5, 100.0, 1), (-100.0, 2.0, 1), (-0.8, 0.8, 2)],
)
def test_a_saturated_channel_is_found_on_the_side_where_it_is(low, high, sides):
    findings = [
        finding
        for finding in warned(changed(clean_drive(), ay=lambda ay: ay.clip(low, high)))
        if finding.check == "saturated"
    ]
    assert [(finding.level, finding.channel) for finding in findings] == [("warning", "ay")] * sides
    for finding in findings:
        assert ("highest" in finding.message) == (f", {high:g} m/s²" in finding.message)


def test_quantised_resting_and_stepped_channels_are_not_saturated():
    for step in (0.05, 0.5):
        quantised = changed(clean_drive(), ay=lambda ay, step=step: np.round(ay / step) * step)
        assert {finding.check for finding in warned(quantised)} <= {"coarse"}
    time = np.arange(LENGTH) / RATE
    sine = np.round(8.0 * np.sin(2 * np.pi * 0.71 * time), 1)
    assert complaints(Recording("r", "car", RATE, 0.0, {"ay": sine})) == []
    findings = checks_of_recording(
        changed(clean_drive(), ay=lambda ay: (np.round(ay / 0.05) * 0.05).clip(-4, 4))
    )
    assert sum(finding.check == "saturated" for finding in findings) == 2
    recording = with_standstill(clean_drive())
    assert complaints(changed(recording, vx=lambda vx: vx.clip(0.0, None))) == []
    steer = np.where(np.arange(400) < 350, 0.01 * np.sin(np.arange(400)), 0.1)
    assert complaints(Recording("step", "car", RATE, 0.0, {"steer": steer})) == []


def test_a_steering_offset_shows_straight_ahead_and_a_wheel_that_drops_out_is_named():
    full_drive = clean_drive()
    assert complaints(changed(full_drive, steer=lambda samples: samples + np.deg2rad(1.0))) == []
    assert complaints(changed(full_drive, steer=lambda samples: samples - np.deg2rad(5.0))) == [
        ("warning", "offset", "steer")
    ]
    drive = clean_drive()
    wheels = {f"wheel_speed_{wheel}": drive["vx"] / 0.3 for wheel in ("fl", "fr", "rl", "rr")}
    full_drive = changed(drive, **wheels)
    assert not complaints(full_drive)
    dropped = changed(full_drive, wheel_speed_rl=stuck(0.0, 2000, 2060))
    assert complaints(dropped) == [("warning", "dropout", "wheel_speed_rl")]
    assert "dropout" not in {
        check for _, check, _ in complaints(changed(dropped, ax=stuck(-7.0, 2000, 2060)))
    }


def angle_of(finding):
    """Rotation that a finding states [rad]."""
    return float(re.search(r"yaw: (\S+) rad", finding.message)[1])


@pytest.mark.parametrize("degrees", [0.0, 2.0, 8.0, -15.0, 30.0])
def test_an_accelerometer_that_is_turned_about_the_vertical_is_found_with_its_angle(degrees):
    drive = MountingCorrection(yaw=-np.deg2rad(degrees))(broadband_drive())
    found = found_by("rotation", drive)
    assert set(found) == ({"ay"} if abs(degrees) > 4.0 else set())
    if found:
        angle = angle_of(found["ay"])
        assert np.rad2deg(angle) == pytest.approx(degrees, abs=1.5)
        assert not found_by("rotation", MountingCorrection(yaw=angle)(drive))


def test_a_dead_accelerometer_is_not_turned():
    dead = changed(broadband_drive(), ax=np.zeros_like, ay=np.zeros_like)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not found_by("rotation", dead)


@pytest.mark.parametrize("degrees", [0.0, 10.0])
def test_a_turned_accelerometer_is_found_on_the_real_ferrari(data_root, degrees):
    recording = open_source(compose_config("estimate", ["dataset=ferrari_250lm"])["dataset"])
    drive = MountingCorrection(yaw=-np.deg2rad(degrees))(recording.read(FERRARI))
    found = found_by("rotation", drive)
    assert set(found) == ({"ay"} if degrees else set())
    if found:
        assert np.rad2deg(angle_of(found["ay"])) == pytest.approx(degrees, abs=1.5)


def backwards(recording, *stretches, speed=-2.0):
    """The same drive, with stretches of samples in which its speed and its reference's are
    negative.
    """
    slow = {name: recording[name].copy() for name in ("vx", "vx_ref")}
    for samples in slow.values():
        for start, stop in stretches:
            samples[start:stop] = np.linspace(0.6 * speed, speed, stop - start)
    return changed(recording, **slow)


def reversing(recording):
    return list(found_by("reverse", recording).values())


def test_driving_backwards_is_noted_with_its_longest_stretch_and_lowest_speed():
    (finding,) = reversing(backwards(clean_drive(), (1000, 1150), (3000, 3250)))
    assert (finding.level, finding.channel) == ("note", "vx")
    assert "reversing in 2 segments" in finding.message
    assert "the longest for 2.5 s from t = 40 s, minimum -2 m/s" in finding.message
    assert "start and stop in the split" in finding.message
    assert "sign: -1" in finding.message
    (finding,) = reversing(changed(clean_drive(), vx=np.negative))
    assert "reversing in 1 segment (" in finding.message
    assert "for 60 s from t = 10 s" in finding.message


def test_the_reference_tells_of_driving_backwards_only_where_there_is_no_measured_speed():
    drive = backwards(clean_drive(), (1000, 1150))
    forwards = changed(drive, vx=np.abs)
    assert [
        (finding.level, "unsigned: positive while the car reverses in 1 segment" in finding.message)
        for finding in reversing(forwards)
    ] == [("warning", True)]
    assert found_by("reverse", without(forwards, "vx")).keys() == {"vx_ref"}
    assert not reversing(forwards.select(["yaw_rate", "ay"]))


@pytest.mark.parametrize(
    ("length", "speed", "noted"), [(99, -2.0, 0), (100, -2.0, 1), (200, -0.5, 0), (200, -0.9, 1)]
)
def test_rolling_back_slowly_or_shortly_is_not_driving_backwards(length, speed, noted):
    assert len(reversing(backwards(clean_drive(), (1000, 1000 + length), speed=speed))) == noted


def spikes(recording=None, **channels):
    """Messages about spikes by channel where channels of a clean drive have other samples."""
    drive = changed(recording or clean_drive(), gappy=channels, **channels)
    return {name: finding.message for name, finding in found_by("spike", drive).items()}


def steering_wheel():
    return 15.0 * clean_drive()["steer"]


@pytest.mark.parametrize(
    ("length", "value", "is_found"),
    [(1, 7.3, True), (20, 7.3, True), (300, 7.3, False), (1, 0.05, False)],
    ids=["one sample", "a fifth of a second", "a manoeuvre of 3 s", "within the usual range"],
)
def test_a_short_jump_far_beyond_the_usual_range_is_found(length, value, is_found):
    """419° at a steering wheel is possible, but not for one sample."""
    handwheel = steering_wheel()
    handwheel[3000 : 3000 + length] = value
    found = spikes(handwheel=handwheel)
    assert list(found) == ["handwheel"] * is_found
    for message in found.values():
        assert "1 spike of" in message
        assert "7.3 rad at t = 40 s" in message


@pytest.mark.parametrize(
    ("length", "value", "is_found"),
    [(1, 0.0, True), (30, 0.0, True), (30, 60.0, True), (1, 60.0, False), (120, 0.0, False)],
    ids=["one zero", "0.4 s of zeros", "one code", "a single sample", "a stop of 1.6 s"],
)
def test_a_speed_that_jumps_to_one_value_and_back_is_found_within_its_usual_range(
    length, value, is_found
):
    speed = clean_drive()["vx"].copy()
    speed[:1000] += np.linspace(60.0, 0.0, 1000)  # so that the code is no unusual speed
    speed[3000 : 3000 + length] = value
    message = spikes(vx=speed).get("vx", "")
    jump = f"jumps away and back 1 time within 1 s, the longest to {value:.4g} m/s"
    assert (jump if is_found else "") in message
    assert bool(message) == is_found


@pytest.mark.parametrize(
    "rows", [slice(0, 1), slice(0, 2), slice(1, 2), slice(-2, -1), slice(-1, None)]
)
@pytest.mark.parametrize(
    ("mean", "value", "words"), [(0.0, 7.3, "1 spike of"), (2.0, 0.0, "jumps away and back 1")]
)
def test_a_spike_in_the_first_or_last_samples_is_found(rows, mean, value, words):
    angle = mean + steering_wheel()
    assert not spikes(handwheel=angle)
    angle[rows] = value
    found = spikes(handwheel=angle)
    assert list(found) == ["handwheel"]
    assert words in found["handwheel"]


def test_spikes_with_and_beside_missing_samples_are_found_and_a_swerve_at_the_start_is_none():
    angle = steering_wheel()
    angle[3000:3003] = [7.1, np.nan, 7.3]
    time = clean_drive().time[3002]
    assert f"the largest 7.3 rad at t = {time:.12g} s" in spikes(handwheel=angle)["handwheel"]
    angle[2990:3000] = np.nan
    angle[3000:3003] = [7.3, *steering_wheel()[3001:3003]]
    assert list(spikes(handwheel=angle)) == ["handwheel"]
    swerve = steering_wheel()
    swerve[:20] += 4.0 * np.cos(np.linspace(0.0, 0.5 * np.pi, 20))
    assert not spikes(handwheel=swerve)


@pytest.mark.parametrize(("offset", "code"), [(2.0, 0.0), (3.0, -0.2778)])
def test_a_code_in_a_twentieth_of_the_samples_is_found_though_its_jumps_are_frequent(offset, code):
    angle = offset + steering_wheel()
    angle[np.random.default_rng(0).random(len(angle)) < 0.05] = code
    found = spikes(handwheel=angle)["handwheel"]
    assert re.search(r"jumps away and back \d{2,} times", found)
    assert f"to {code:.4g} rad" in found


@pytest.mark.parametrize("kind", ["counted to a turn", "zero found late"])
def test_steps_of_a_full_turn_of_a_steering_wheel_are_named_and_unwrapping_removes_them(kind):
    drive = clean_drive()
    angle = steering_wheel()
    if kind == "counted to a turn":
        angle %= 2.0 * np.pi
    else:
        angle[500:] += 2.0 * np.pi
    n_steps = int((np.abs(np.diff(angle)) > 5.0).sum())
    (finding,) = [
        finding
        for finding in warned(changed(drive, handwheel=angle))
        if finding.channel == "handwheel"
    ]
    assert finding.check == "full_turn"
    assert finding.message.startswith(f"{n_steps} step{'s' * (n_steps > 1)} of a full turn")
    unwrapped = np.radians(np.unwrap(np.degrees(angle), period=360))
    checks = [finding.check for finding in warned(changed(drive, handwheel=unwrapped))]
    assert "full_turn" not in checks


def test_a_shaking_sensor_and_a_sideslip_angle_at_standstill_make_no_spike():
    drive = clean_drive()
    shaking = 5.0 * (-1.0) ** np.arange(len(drive))
    shaking[3000] = 22.0  # by 27 m/s², two of its ranges, but not three of its steps of 10 m/s²
    assert not spikes(ax=shaking)
    sideslip = 0.02 * np.sin(0.01 * np.arange(len(drive)))
    sideslip[3200] = 3.0
    standing_car = changed(drive, **dict.fromkeys(drive.channels, stuck(0.0, 3000, 3400)))
    assert not spikes(standing_car, sideslip_ref=sideslip)


def test_an_acceleration_that_a_transform_made_of_the_speed_is_not_called_late(tmp_path):
    time = np.arange(0.0, 120.0, 0.02)
    speed = 15.0 + 5.0 * np.sin(0.5 * time) + np.sin(2.0 * time) + 0.2 * np.sin(7.0 * time)
    table = pd.DataFrame({"t": time, "vx": speed, "yaw_rate": 0.2 * np.sin(0.3 * time)})
    table.to_csv(tmp_path / "lap.csv", index=False)
    dataset = {
        "name": "mine",
        "source": "tabular",
        "licence": "-",
        "citation": "-",
        "path": str(tmp_path),
        "files": "*.csv",
        "time": {"column": "t", "unit": "s"},
        "channels": {
            "vx": {"column": "vx", "unit": "m/s"},
            "yaw_rate": {"column": "yaw_rate", "unit": "rad/s"},
        },
        "transforms": [{"name": "acceleration_from_speed"}],
    }
    recording = open_source(dataset).read("lap")
    assert "ax" in found_by("delay", replace(recording, provenance={}))
    assert not found_by("delay", recording)
