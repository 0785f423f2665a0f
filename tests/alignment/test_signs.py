"""Signs, units and offsets: what contradicts what, and a channel only where the others decide."""

import warnings

import numpy as np
import pytest
from broadband_drive import broadband_drive, changed, found_by, warned, without
from scipy import signal

from vehest.alignment.band_pass import butterworth_band, without_phase
from vehest.alignment.checks import checks_of_recording
from vehest.alignment.signs import KINEMATIC_BAND_HZ
from vehest.constants import GRAVITY
from vehest.data.recording import Recording

REFERENCES = ("vy_ref", "sideslip_ref", "yaw_rate_ref", "vx_ref")


def turned(recording, *names):
    return changed(recording, **dict.fromkeys(names, np.negative))


def signs(recording):
    warnings = warned(recording)
    assert {finding.check for finding in warnings} <= {"sign"}, warnings
    return [finding.channel for finding in warnings]


@pytest.mark.parametrize("rate_hz", [5.5, 20.0, 125.0, 1000.0])
def test_the_band_of_the_checks_is_butterworths(rate_hz):
    samples = 30.0 + np.cumsum(np.random.default_rng(0).normal(size=3000))
    band = KINEMATIC_BAND_HZ
    expected = signal.sosfiltfilt(
        signal.butter(2, band, btype="bandpass", fs=rate_hz, output="sos"), samples
    )
    np.testing.assert_allclose(
        without_phase(butterworth_band(*band, rate_hz), samples),
        expected,
        rtol=0,
        atol=1e-9 * expected.std(),
    )


@pytest.mark.parametrize(
    "channel", ["ay", "yaw_rate", "ax", "steer", "vy_ref", "sideslip_ref", "yaw_rate_ref"]
)
def test_one_reversed_channel_is_named(channel):
    assert signs(turned(broadband_drive(rate_hz=25.0), channel)) == [channel]


def test_several_reversed_channels_are_all_named_with_the_products_that_contradict():
    assert signs(turned(broadband_drive(), "vy_ref", "sideslip_ref")) == ["sideslip_ref", "vy_ref"]
    assert signs(turned(broadband_drive(), "ax", "ay")) == ["ax", "ay"]
    (warning,) = warned(turned(without(broadband_drive(), *REFERENCES), "ay"))
    assert warning.channel == "ay"
    assert warning.message.startswith("sign reversed (ay vs. vx·yaw_rate: correlation -")
    assert "consistent: steer vs. yaw_rate" in warning.message
    assert "set sign: -1 for ay, or instead steer and yaw_rate together" in warning.message


@pytest.mark.parametrize("channel", ["ay", "yaw_rate"])
def test_without_steering_and_heading_no_channel_is_named(channel):
    (warning,) = warned(turned(without(broadband_drive(), *REFERENCES, "steer"), channel))
    assert (warning.check, warning.channel) == ("sign", "")
    assert "set sign: -1 for ay or yaw_rate; a steering angle or yaw_rate_ref" in warning.message
    assert set(warning.suspects) == {"ay", "yaw_rate"}


def test_without_a_channel_that_decides_none_is_named():
    """A unit and a slip sensor whose y axes point to the right are as likely as one whose yaw rate
    counts clockwise.
    """
    (warning,) = warned(
        turned(without(broadband_drive(), "sideslip_ref", "yaw_rate_ref", "steer"), "yaw_rate")
    )
    assert warning.channel == ""
    assert "set sign: -1 for yaw_rate or ay and vy_ref together" in warning.message


def test_steering_may_be_the_angle_of_the_steering_wheel():
    drive = broadband_drive()
    drive = changed(without(drive, "steer"), handwheel=15.0 * drive["steer"])
    assert signs(turned(drive, "ay")) == ["ay"]
    assert signs(turned(drive, "handwheel")) == ["handwheel"]


def test_counter_steering_and_late_yaw_rates_are_not_taken_for_reversed_channels():
    drive = broadband_drive()
    drifting = changed(
        drive, vy_ref=lambda vy: vy - 12.0 * np.sign(drive["yaw_rate_ref"]), steer=np.negative
    )
    assert "steer" not in [finding.channel for finding in warned(drifting)]
    for options in ({"late": {"yaw_rate": 0.1}}, {"slow_yaw_rate": 0.4}):
        assert not found_by("sign", broadband_drive(**options))


@pytest.mark.parametrize(
    ("channel", "factor", "units", "level"),
    [
        ("vy_ref", 3.6, "in km/h but read as m/s", "warning"),
        ("vx", 3.6, "in km/h but read as m/s", "warning"),
        ("ay", 1.0 / GRAVITY, "in g but read as m/s²", "warning"),
        ("ax", 1.0 / GRAVITY, "in g but read as m/s²", "warning"),
        ("yaw_rate", 180.0 / np.pi, "in deg/s but read as rad/s", "error"),
        ("sideslip_ref", 180.0 / np.pi, "in deg but read as rad", "error"),
        ("yaw_rate", np.pi / 180.0, "in rad/s but read as deg/s", "warning"),
    ],
)
def test_a_wrong_unit_is_named(channel, factor, units, level):
    unit_findings = [
        finding
        for finding in warned(
            changed(broadband_drive(), **{channel: lambda samples: factor * samples})
        )
        if finding.check != "impossible"
    ]
    assert [(finding.level, finding.check, finding.channel) for finding in unit_findings] == [
        (level, "unit", channel)
    ]
    assert f": {channel} is {units}; correct the unit" in unit_findings[0].message


def test_two_wrong_units_are_both_named_or_all_that_may_be_listed():
    unit_findings = warned(
        changed(broadband_drive(), ay=lambda ay: ay / GRAVITY, vy_ref=lambda vy: 3.6 * vy)
    )
    assert {(finding.check, finding.channel) for finding in unit_findings} == {
        ("unit", "ay"),
        ("unit", "vy_ref"),
    }
    # ay is a tenth of vx·yaw_rate: no factor of vx alone does that; a ninth of km/h and g together
    # is not looked for.
    unit_findings = warned(
        changed(without(broadband_drive(), *REFERENCES, "ax"), vx=lambda vx: vx * 3.6)
    )
    assert [(finding.check, finding.channel) for finding in unit_findings] == [("unit", "vx")]
    odd = warned(changed(without(broadband_drive(), *REFERENCES, "ax"), ay=lambda ay: ay * 2.0))
    assert (
        "gain 2.03 instead of 1 (correlation 0.99); check the units of ay, yaw_rate and vx"
        in odd[0].message
    )
    drive = broadband_drive()
    slipping = warned(changed(without(drive, "sideslip_ref"), vy_ref=lambda vy: 2.2 * vy))
    assert "and whether the reference is at the centre of gravity" in slipping[0].message
    for slip in (
        1.0 + 6.0 * (np.sin(0.5 * drive.time) > 0.3),
        3.4 + 0.8 * np.sin(0.5 * drive.time),
    ):
        assert not found_by("unit", changed(drive, vx=slip * drive["vx"]))


@pytest.mark.parametrize(
    ("offset", "level"),
    [(0.1, None), (0.3, "note"), (-0.3, "note"), (1.0, "warning"), (-1.0, "warning")],
)
@pytest.mark.parametrize("missing", [(), ("vy_ref", "sideslip_ref")])
def test_an_offset_of_ay_is_found_with_its_size(offset, level, missing):
    drive = without(changed(broadband_drive(), ay=lambda ay: ay + offset), *missing)
    offsets = found_by("offset", drive)
    assert {name: finding.level for name, finding in offsets.items()} == (
        {"ay": level} if level else {}
    )
    if level:
        assert float(offsets["ay"].message.split()[3]) == pytest.approx(offset, abs=0.03)


def test_gravity_that_roll_lets_in_is_no_offset_in_a_drive_of_left_turns():
    drive = broadband_drive()
    left = changed(
        drive,
        yaw_rate=lambda r: r + 0.4,
        yaw_rate_ref=lambda r: r + 0.4,
        ay=lambda ay: 1.06 * (ay + 0.4 * drive["vx_ref"]),
    )
    assert np.mean(left["ay"] - left["vx_ref"] * left["yaw_rate"]) > 0.4
    assert not found_by("offset", left)


@pytest.mark.parametrize("seed", range(25))
def test_no_recording_raises_or_warns(seed):
    generator = np.random.default_rng(seed)
    length = int(generator.choice([1, 2, 3, 50, 400, 4000]))
    rate = float(generator.choice([0.01, 5.0, 25.0, 100.0, 1e5]))
    walk = 0.02 * np.cumsum(generator.standard_normal(length))
    kinds = [
        np.zeros(length),
        np.full(length, 0.3),
        generator.standard_normal(length),
        1e308 * generator.choice([-1.0, 1.0], length),
        1e200 * generator.standard_normal(length),
        np.full(length, 1e-320),
        walk,
        -walk,
        20.0 + walk,
    ]
    channels = {}
    gappy = set()
    for name in (
        "vx",
        "yaw_rate",
        "ax",
        "ay",
        "steer",
        "vx_ref",
        "vy_ref",
        "sideslip_ref",
        "yaw_rate_ref",
        "motor_speed",
    ):
        samples = kinds[generator.integers(len(kinds))].copy()
        if generator.random() < 0.2:
            samples[generator.random(length) < generator.choice([0.01, 0.5, 1.0])] = np.nan
            gappy.add(name)
        if generator.random() < 0.85:
            channels[name] = samples
    recording = Recording(
        "r", "car", rate, 0.0, channels or {"vx": kinds[0]}, gappy=frozenset(gappy)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for finding in checks_of_recording(recording):
            assert "\n" not in finding.message


def test_a_drive_backwards_is_left_to_the_check_of_it():
    drive = without(broadband_drive(), "vx_ref", "vy_ref", "sideslip_ref", "yaw_rate_ref")
    assert not warned(turned(drive, "vx"))
    assert [finding.check for finding in checks_of_recording(turned(drive, "vx"))] == ["reverse"]
