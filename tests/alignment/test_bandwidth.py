"""Low-passed and held channels: time constants and rates in closed form, and the real cars that
have them.
"""

import re

import numpy as np
import pytest
import yaml
from broadband_drive import Wave, broadband_drive, changed, found_by, warned, without

from real_drives import source_of
from vehest.alignment.bandwidth import update_rate_hz
from vehest.alignment.checks import checks_of_recording
from vehest.alignment.spectra import cross_spectra, lag_of
from vehest.data.transforms import transform_from_config


@pytest.mark.parametrize("time_constant", [0.2, 0.4, 1.0])
@pytest.mark.parametrize("late", [0.0, 0.05])
def test_delay_and_time_constant_are_told_apart(time_constant, late):
    generator = np.random.default_rng(1)
    wave = Wave.random(generator, 1.0, 0.05, 4.0)
    clock = np.arange(12000) / 100.0
    signals = {"source": wave(clock), "follower": wave.low_passed(time_constant)(clock - late)}
    noisy = {
        name: samples + 0.2 * samples.std() * generator.standard_normal(len(clock))
        for name, samples in signals.items()
    }
    spectra = cross_spectra(noisy, 100.0)
    lag = lag_of(spectra, "source", "follower", low_pass=True)
    assert lag.time_constant.value == pytest.approx(time_constant, rel=0.1)
    assert lag.delay.value == pytest.approx(late, abs=0.02)


@pytest.mark.parametrize("missing", [(), ("yaw_rate_ref",)])
def test_a_low_passed_yaw_rate_is_found_and_is_not_late_besides(missing):
    (warning,) = warned(without(broadband_drive(slow_yaw_rate=0.4), *missing))
    assert (warning.check, warning.channel) == ("bandwidth", "yaw_rate")
    assert re.search(r"time constant of 0\.(4|39) s", warning.message)


def test_late_channels_are_not_low_passed_and_steering_judges_a_slow_yaw_rate():
    for channel in ("yaw_rate", "ax", "ay"):
        assert not found_by("bandwidth", broadband_drive(late={channel: 0.15}))
    alone = ("ay", "yaw_rate_ref", "vy_ref", "sideslip_ref")
    assert not found_by("bandwidth", without(broadband_drive(), *alone))
    low_passed = found_by("bandwidth", without(broadband_drive(slow_yaw_rate=0.5), *alone))
    assert "more than the 0.3 s usual for cars" in low_passed["yaw_rate"].message


@pytest.mark.parametrize("step", [2, 5, 10, 33])
def test_a_held_channel_changes_at_its_own_rate(step):
    samples = np.repeat(np.random.default_rng(0).standard_normal(4000 // step + 1), step)[:4000]
    assert update_rate_hz(samples, 100.0) == pytest.approx(100.0 / step)


def test_held_rates_are_those_of_a_sensors_own_clock_and_none_of_noise_or_slow_steps():
    newest = (np.arange(4000) * 0.4).astype(int)
    assert update_rate_hz(
        np.random.default_rng(0).standard_normal(2000)[newest], 100.0
    ) == pytest.approx(45.0, abs=6.0)
    time = np.arange(6000) / 100.0
    for samples in (
        *(np.round(np.sin(0.3 * time) / resolution) * resolution for resolution in (0.05, 0.2)),
        np.random.default_rng(0).standard_normal(1000),
        np.ones(1000),
        np.full(1000, np.nan),
        np.ones(0),
    ):
        assert update_rate_hz(samples, 100.0) is None


def test_channels_held_together_are_told_of_together_by_what_it_delays():
    drive = broadband_drive()

    def hold_accelerations(step):
        def hold(samples):
            return np.repeat(samples[::step], step)[: len(drive)]

        return changed(drive, ax=hold, ay=hold)

    (slow,) = found_by("held", hold_accelerations(10)).values()
    assert (slow.level, slow.channel) == ("warning", "ax")
    assert (
        "updated at only 10 Hz and held in between (also ay), in a recording at 100 Hz, which "
        "delays it by 50 ms on average" in slow.message
    )
    (fast,) = found_by("held", hold_accelerations(2)).values()
    assert (fast.level, fast.channel) == ("note", "ax")


def rounded_to(step):
    return lambda samples: np.round(samples / step) * step


def test_coarse_channels_are_named_with_their_step_and_the_remedy_removes_them():
    drive = broadband_drive(rate_hz=20.0)
    coarse = changed(drive, vx=rounded_to(1.0 / 3.6), ay=rounded_to(1.0))
    findings = found_by("coarse", coarse)
    assert set(findings) == {"vx", "ay"}
    assert "in steps of 0.278 m/s" in findings["vx"].message
    (remedy,) = re.findall(r"transform (\{.*\}) removes", findings["vx"].message)
    smooth = transform_from_config(yaml.safe_load(remedy))(coarse)
    assert set(found_by("coarse", smooth)) == {"ay"}
    error = smooth["vx"] - drive["vx"]
    assert np.sqrt(np.mean(error[20:-20] ** 2)) < 0.06  # of 0.08 before


@pytest.mark.parametrize(
    "samples",
    [
        lambda vx: vx,
        lambda vx: np.round(vx, 3),
        lambda vx: np.repeat(vx[::4], 4)[: len(vx)],  # held
        lambda vx: np.where(np.arange(len(vx)) < 20, np.nan, rounded_to(0.3)(vx)),
        np.zeros_like,
    ],
)
def test_fine_held_missing_and_constant_speeds_are_not_coarse(samples):
    drive = broadband_drive(rate_hz=20.0)
    assert not found_by("coarse", changed(drive, vx=samples, gappy=["vx"]))


@pytest.mark.parametrize(
    ("channel", "step", "cutoff_hz"),
    [("vx", 1.0, 0.5), ("vx", 1.0 / 3.6, 1.8), ("yaw_rate", np.deg2rad(2.0), 3.0)],
)
def test_a_fast_recording_is_coarse_too_and_coarser_speeds_need_lower_cut_offs(
    channel, step, cutoff_hz
):
    drive = broadband_drive()
    coarse = changed(drive, **{channel: rounded_to(step)})
    findings = found_by("coarse", coarse)
    assert set(findings) == {channel}
    (remedy,) = re.findall(r"transform (\{.*\}) removes", findings[channel].message)
    low_pass = yaml.safe_load(remedy)
    assert low_pass["cutoff_hz"] == cutoff_hz
    smooth = transform_from_config(low_pass)(coarse)
    inside = slice(500, -500)
    slope, exact = (np.gradient(drive_[channel])[inside] for drive_ in (smooth, drive))
    steps = np.gradient(coarse[channel])[inside]
    assert np.std(slope - exact) < 0.3 * np.std(steps - exact)
    assert not found_by("coarse", smooth)


@pytest.mark.parametrize("step", [0.004, 0.01])
def test_fine_steps_of_a_fast_recording_are_averaged_out_by_the_rate_of_a_model(step):
    assert not found_by("coarse", changed(broadband_drive(noise=0.0), vx=rounded_to(step)))


def test_the_dallaras_ax_has_a_time_constant_of_two_to_three_seconds(data_root):
    for recording in source_of(data_root, "av21").recordings():
        low_passed = found_by("bandwidth", recording)
        assert set(low_passed) == {"ax", "yaw_rate"}
        assert (
            2.0 < float(low_passed["ax"].message.split("time constant of ")[1].split(" s")[0]) < 3.0
        )


@pytest.mark.parametrize("name", ["ferrari_250lm", "f1tenth", "ferrari_250lm_unlabelled", "tum"])
def test_no_other_cars_channels_are_low_passed_held_or_of_another_sign(data_root, name):
    for recording in source_of(data_root, name).recordings():
        checks = {finding.check for finding in checks_of_recording(recording)}
        assert checks.isdisjoint({"bandwidth", "held", "sign", "unit", "delay"})
