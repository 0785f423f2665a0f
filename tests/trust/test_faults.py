"""Each kind of fault does to its channel what it says, nothing to any other, and the same for the
same seed.
"""

import math
from pathlib import Path

import numpy as np
import pytest
from refusals import refusal

from conftest import planar_drive
from vehest.data.channels import CHANNELS
from vehest.data.errors import ConfigurationError
from vehest.trust.faults import KINDS, SEVERITIES, Fault, applies, inject, is_fault, size_of, window

RATE = 20.0
ONSET = 10.0
DURATION = 8.0
FIRST = 200
END = 360


@pytest.fixture
def samples():
    """A drive of 30 s at 20 Hz, with a wheel and a steering angle."""
    drive = planar_drive(30.0, RATE, noise=0.01)
    return {
        **{name: drive[name] for name in ("vx", "yaw_rate", "ay", "ax")},
        "steer": 0.1 * drive["yaw_rate"],
        "wheel_speed_fl": drive["vx"] / 0.3,
    }


def faulted(samples, kind, channel, severity="medium", **options):
    """The channel while the fault lasts: before, and after it was injected."""
    fault = Fault(kind, channel, severity, ONSET, DURATION, **options)
    return samples[channel][FIRST:END], inject(samples, RATE, fault)[channel][FIRST:END]


@pytest.mark.parametrize("severity", SEVERITIES)
@pytest.mark.parametrize("kind", KINDS)
def test_only_the_channel_changes_and_only_while_the_fault_lasts(samples, kind, severity):
    channel = "vx" if kind == "lost_wheel" else "ay"
    before = {name: values.copy() for name, values in samples.items()}
    faulty = inject(samples, RATE, Fault(kind, channel, severity, ONSET, DURATION, seed=3))
    for name, values in before.items():
        np.testing.assert_array_equal(samples[name], values)
        if name != channel:
            np.testing.assert_array_equal(faulty[name], values)
    for outside in (slice(0, FIRST), slice(END, None)):
        np.testing.assert_array_equal(faulty[channel][outside], before[channel][outside])
    assert not np.array_equal(faulty[channel][FIRST:END], before[channel][FIRST:END])


def test_offsets_are_physical_of_either_sign_and_the_same_again(samples):
    for severity, size in zip(SEVERITIES, (0.3, 1.0, 3.0), strict=True):
        before, after = faulted(samples, "bias", "ay", severity)
        assert np.abs(after - before) == pytest.approx(size)
        assert np.ptp(after - before) == pytest.approx(0.0, abs=1e-12)
    angles = {"yaw_rate": 10.0, "steer": 6.0, "handwheel": 90.0, "roll": 6.0}
    for channel, severe in {
        **{name: math.radians(degrees) for name, degrees in angles.items()},
        "vx": 5.0,
    }.items():
        assert size_of("bias", channel, "severe") == pytest.approx(severe), channel
    assert size_of("bias", "brake_pressure_front", "medium") == pytest.approx(
        0.05 * CHANNELS["brake_pressure_front"].high
    )
    before, after = faulted(samples, "bias", "wheel_speed_fl", "mild")
    assert np.abs(after - before) == pytest.approx(0.02 * samples["wheel_speed_fl"].max())
    signs = {
        np.sign(np.subtract(*faulted(samples, "bias", "ay", seed=seed)[::-1])[0])
        for seed in range(20)
    }
    assert signs == {-1.0, 1.0}
    for kind in KINDS:
        first, again = (
            faulted(samples, kind, "vx" if kind == "lost_wheel" else "ay", seed=5)[1]
            for _ in range(2)
        )
        np.testing.assert_array_equal(first, again, err_msg=kind)


def test_drift_scale_spikes_and_sign_are_of_their_sizes(samples):
    before, after = faulted(samples, "drift", "ay", "medium")
    slope = np.polyfit(np.arange(len(before)) / RATE, after - before, 1)
    assert np.abs(slope) == pytest.approx([0.1, 0.0], abs=1e-12)
    before, after = faulted(samples, "scale", "ay", "mild")
    assert np.abs(after / before - 1.0) == pytest.approx(0.05)
    before, after = faulted(samples, "spikes", "ay", "medium")
    struck = after != before
    assert struck.sum() == round(0.02 * len(before))
    assert np.abs(after - before)[struck] == pytest.approx(10.0)
    before, after = faulted(samples, "sign", "ay", "severe")
    np.testing.assert_array_equal(after, -before)
    after = faulted(samples, "delay", "ay", "medium")[1]
    np.testing.assert_array_equal(after, samples["ay"][FIRST - 4 : END - 4])
    before, after = faulted(samples, "saturation", "ay", "medium")
    limit = 0.5 * np.abs(before).max()
    np.testing.assert_array_equal(after, np.clip(before, -limit, limit))
    after = faulted(samples, "held", "ay", "medium")[1]
    np.testing.assert_array_equal(after, np.repeat(samples["ay"][FIRST:END:5], 5))
    before, after = faulted(samples, "bias", "ay", size=-0.7)
    assert after - before == pytest.approx(-0.7)


def test_frozen_and_lost_samples_are_as_many_as_the_severity_says(samples):
    for severity, count in zip(SEVERITIES, (16, 80, 160), strict=True):
        before, after = faulted(samples, "frozen", "ay", severity)
        assert set(after[:count]) == {samples["ay"][FIRST - 1]}
        np.testing.assert_array_equal(after[count:], before[count:])
    for kind, lost in (("dropout", 0.0), ("nan", math.nan)):
        before, after = faulted(samples, kind, "ay", "medium")
        gone = ~(after == before)
        assert gone.sum() == 80
        assert all(len(set(piece)) == 1 for piece in gone.reshape(-1, 4)), "pieces of 0.2 s"
        np.testing.assert_array_equal(after[gone], lost)
    for kind in ("dropout", "nan", "inf"):
        after = faulted(samples, kind, "ay", "severe")[1]
        assert not np.any(np.isfinite(after) & (after != 0.0)), kind
    for severity, count in zip(SEVERITIES, (2, 16, 160), strict=True):
        after = faulted(samples, "inf", "ay", severity)[1]
        assert np.isinf(after).sum() == count
        assert not np.isnan(after).any()
        assert count == 2 or {-np.inf, np.inf} <= set(after)
        before, after = faulted(samples, "huge", "ay", severity)
        struck = after != before
        assert struck.sum() == 8
        assert np.isfinite(after).all()
        assert np.abs(after[struck]).min() >= 10 * CHANNELS["ay"].high


def test_noise_has_its_stated_deviation_short_faults_strike_and_gaps_stay(samples):
    long = {"ay": np.zeros(40_000)}
    noise = inject(long, RATE, Fault("noise", "ay", "medium"))["ay"]
    assert noise.std() == pytest.approx(1.0, abs=4.0 / math.sqrt(2 * len(noise))), (
        "within four standard errors"
    )
    assert abs(noise[1:] @ noise[:-1]) / len(noise) < 4.0 / math.sqrt(len(noise)), "white"
    faulty = inject(samples, RATE, Fault("inf", "ay", "mild", ONSET, 1.0 / RATE))["ay"]
    assert np.flatnonzero(~np.isfinite(faulty)).tolist() == [FIRST]
    samples["ay"] = np.where(np.arange(600) % 7 == 0, np.nan, samples["ay"])
    after = faulted(samples, "saturation", "ay", "severe")[1]
    np.testing.assert_array_equal(np.isnan(after), np.isnan(samples["ay"][FIRST:END]))


@pytest.mark.parametrize(
    ("channel", "severity", "factor"),
    [
        ("yaw_rate", "severe", 180.0 / math.pi),
        ("yaw_rate", "medium", math.pi / 180.0),
        ("vx", "severe", 3.6),
        ("ay", "medium", 1.0 / 9.81),
        ("wheel_speed_fl", "severe", 60.0 / (2.0 * math.pi)),
    ],
)
def test_a_wrong_unit_is_its_factor(samples, channel, severity, factor):
    before, after = faulted(samples, "unit", channel, severity)
    assert after == pytest.approx(factor * before)


def test_a_lost_wheel_drops_out_spins_or_locks(samples):
    before = samples["wheel_speed_fl"][FIRST:END]
    gone, spinning, locked = (
        faulted(samples, "lost_wheel", "wheel_speed_fl", severity)[1] for severity in SEVERITIES
    )
    assert np.isnan(gone).all()
    assert spinning[4:] == pytest.approx(1.5 * before[4:])
    assert locked[4:] == pytest.approx(0.0)
    assert locked[2] == pytest.approx(0.5 * before[2]), "within 0.2 s"


def test_faults_start_at_onset_and_each_kind_fits_a_channel_but_no_reference():
    for onset, duration, samples in (
        (0.0, math.inf, (0, 600)),
        (10.0, 8.0, (200, 360)),
        (29.9, 5.0, (598, 600)),
        (40.0, 5.0, (600, 600)),
    ):
        assert window(Fault("bias", "ay", "mild", onset, duration), 600, RATE) == samples
    for kind in KINDS:
        assert any(applies(kind, channel) for channel in CHANNELS), kind
        assert not any(
            applies(kind, channel) for channel, entry in CHANNELS.items() if entry.is_reference
        )
    tried = ("vx", "wheel_speed_rr", "ay", "yaw_rate", "brake_pressure_rear")
    assert [channel for channel in tried if applies("sign", channel)] == ["ay", "yaw_rate"]


def test_a_condition_is_compact_and_a_channel_that_is_not_there_named(samples):
    assert Fault("frozen", "yaw_rate", "severe", 3.0, 5.0).condition == "frozen:yaw_rate:severe"
    assert Fault("bias", "ay", size=-0.25, seed=2).condition == "bias:ay:-0.25:2"
    assert is_fault(Fault("nan", "vx").condition)
    assert not is_fault("nominal")
    with pytest.raises(
        ConfigurationError,
        match=r"fault 'bias:handwheel:mild': there is no channel 'handwheel'; "
        r"there are: vx, yaw_rate",
    ):
        inject(samples, RATE, Fault("bias", "handwheel", "mild"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("frozn", "ay"), "fault.kind 'frozn' is not there; did you mean frozen?"),
        (("bias", "yawrate"), "fault.channel 'yawrate' is not there; did you mean yaw_rate?"),
        (("bias", "vy_ref"), "is a reference, which no estimator reads"),
        (("bias", "ay", "harsh"), "fault.severity 'harsh' is not there"),
        (("sign", "vx"), "a fault 'sign' makes no sense for channel 'vx'; it is for yaw_rate, ax"),
        (("lost_wheel", "ay"), "it is for vx, wheel_speed_fl"),
        (("bias", "ay", "mild", 0.0, 0.0), "fault.duration must be positive"),
        (
            ("bias", "ay", "mild", 0.0, 1.0, 0, 0.0),
            "fault.size of a fault 'bias' must be a number other than 0",
        ),
        (("nan", "ay", "mild", 0.0, 1.0, 0, 1.5), "must be a share above 0, up to 1, not 1.5"),
    ],
)
def test_a_senseless_fault_is_refused_in_a_line(arguments, message):
    assert message in refusal(lambda: Fault(*arguments), ConfigurationError)


def cells(start):
    """Cells of the row of docs/faults.md that begins with this."""
    text = (Path(__file__).parents[2] / "docs" / "faults.md").read_text(encoding="utf-8")
    row = next(line for line in text.splitlines() if line.startswith(f"| {start}"))
    return [cell.strip() for cell in row.strip("|").split("|")]


@pytest.mark.parametrize(
    "kind", sorted(set(KINDS) - {"bias", "drift", "spikes", "noise", "unit", "lost_wheel", "huge"})
)
def test_the_page_states_the_sizes_of_a_kind(kind):
    assert [float(cell) for cell in cells(f"`{kind}`")[-3:]] == [
        size_of(kind, "ay", severity) for severity in SEVERITIES
    ]


@pytest.mark.parametrize(
    ("row", "channel", "scale"),
    [
        ("`vx`", "vx", 1.0),
        ("`yaw_rate`", "roll_rate", math.degrees(1.0)),
        ("`ax`", "ay", 1.0),
        ("`steer`", "pitch", math.degrees(1.0)),
        ("`handwheel`", "handwheel", math.degrees(1.0)),
        ("wheel speeds", "wheel_speed_rl", 1.0),
        ("any other", "brake_pressure_rear", 1.0 / 4e7),
    ],
)
def test_the_page_states_the_offsets_of_a_channel(row, channel, scale):
    stated = [float(cell.split()[0]) for cell in cells(row)[-3:]]
    assert stated == pytest.approx(
        [scale * size_of("bias", channel, severity) for severity in SEVERITIES]
    )
