"""Floors of a drive against closed forms, the information form of the bound, filters at work, and
planted noise.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from conftest import planar_drive
from single_track_drive import with_gaps
from vehest.data.recording import Recording
from vehest.data.splits import Span
from vehest.evaluation import floors
from vehest.evaluation.floors import (
    SETS,
    Drive,
    Noise,
    cramer_rao_floor,
    drive_of,
    gauss_markov,
    inputs_of,
    posterior_bound,
    quantisation_step,
    reference_floor,
    reference_spread,
    split_noise,
    white_level,
)
from vehest.evaluation.metrics import Protocol
from vehest.filters.kalman import LinearModel

RATE = 20.0
PROTOCOL = Protocol(RATE, 2.0, 1.5)


def noisy_reference(sigma):
    """A drive that obeys planar kinematics, white noise on its reference."""
    drive = planar_drive(400.0)
    generator = np.random.default_rng(3)
    channels = dict(drive.channels)
    channels["vy_ref"] = channels["vy_ref"] + sigma * generator.standard_normal(len(drive))
    return Recording("drive", "car", RATE, 0.0, channels, "simulated")


def single_track_drive(seconds=300.0):
    """A car on its axles: v from yaw rate and the rear axle's slip, with slow errors.

    Ax, ay with offset and noise; steering.
    """
    generator = np.random.default_rng(0)
    n = round(seconds * RATE)
    time = np.arange(n) / RATE
    u = 25.0 + 5.0 * np.sin(0.11 * time)
    r = 0.25 * np.sin(0.4 * time) + 0.15 * np.sin(1.1 * time + 1.0)
    a = u * r
    v = 1.1 * r - u * a / (10.0 * 9.81) + markov(generator, n, 0.08, 3.0)
    ay = (
        np.gradient(v) * RATE
        + u * r
        + markov(generator, n, 0.15, 10.0)
        + 0.2 * generator.standard_normal(n)
    )
    ax = (
        np.gradient(u) * RATE
        - v * r
        + markov(generator, n, 0.05, 10.0)
        + 0.2 * generator.standard_normal(n)
    )
    steer = (v + 1.3 * r) / u + a / (9.0 * 9.81) + markov(generator, n, 0.003, 3.0)
    channels = {
        "vx": u + 0.01 * generator.standard_normal(n),
        "yaw_rate": r,
        "ay": ay,
        "ax": ax,
        "steer": steer,
        "vy_ref": v,
    }
    return Recording("track", "car", RATE, 0.0, channels, "simulated")


def markov(generator, n, deviation, time_constant):
    decay = math.exp(-1.0 / (RATE * time_constant))
    values = np.empty(n)
    values[0] = deviation * generator.standard_normal()
    for k in range(1, n):
        values[k] = (
            decay * values[k - 1]
            + deviation * math.sqrt(1 - decay**2) * generator.standard_normal()
        )
    return values


def test_white_noise_of_a_reference_is_estimated_within_a_few_per_cent():
    """In sideslip too: the truth itself, held against the reference."""
    for sigma in (0.003, 0.02, 0.1):
        floor = reference_floor([drive_of(noisy_reference(sigma), Span("d", "drive"), PROTOCOL)])
        assert floor.vy == pytest.approx(sigma, rel=0.04)
    noisy = noisy_reference(0.05)
    drive = planar_drive(400.0)
    floor = reference_floor([drive_of(noisy, Span("d", "drive"), Protocol(RATE, 0.0, 0.0))])
    error = np.degrees(
        np.arctan2(drive["vy_ref"], drive["vx"]) - np.arctan2(noisy["vy_ref"], noisy["vx"])
    )
    assert floor.sideslip == pytest.approx(np.sqrt(np.mean(error**2)), rel=0.04)


def test_manoeuvres_that_the_inertial_signals_explain_are_no_noise():
    """Swings at 2 Hz have third differences like noise.

    Ay and yaw rate tell that they were driven.
    """
    time = np.arange(4000) / RATE
    v = 0.2 * np.sin(4 * np.pi * time)
    r = 0.1 * np.cos(4 * np.pi * time)
    u = np.full(4000, 20.0)
    ay = 0.8 * np.pi * np.cos(4 * np.pi * time) + u * r
    generator = np.random.default_rng(0)
    swings = Recording(
        "d",
        "car",
        RATE,
        0.0,
        {"vx": u, "yaw_rate": r, "ay": ay, "vy_ref": v + 0.005 * generator.standard_normal(4000)},
    )
    drive = drive_of(swings, Span("d", "d"), PROTOCOL)
    assert white_level([drive.vy_ref]) > 0.009
    assert reference_floor([drive]).vy == pytest.approx(0.005, rel=0.1)


def test_coarse_or_few_samples_bound_the_floor_and_smoothing_hides_noise():
    drive = planar_drive(200.0)
    coarse = drive.with_channels({"vy_ref": 0.1 * np.round(drive["vy_ref"] / 0.1)})
    assert quantisation_step(coarse["vy_ref"]) == pytest.approx(0.1)
    assert quantisation_step(drive["vy_ref"]) == 0.0
    assert (
        reference_floor([drive_of(coarse, Span("d", "d"), PROTOCOL)]).vy
        >= 0.1 / math.sqrt(12) - 1e-9
    )
    noisy = noisy_reference(0.05)
    smooth = np.convolve(noisy["vy_ref"], np.full(5, 0.2), "same")
    hidden = noisy.with_channels({"vy_ref": smooth})
    left = np.std((smooth - planar_drive(400.0)["vy_ref"])[10:-10])
    assert reference_floor([drive_of(hidden, Span("d", "d"), PROTOCOL)]).vy < left
    drive = drive_of(planar_drive(2.0), Span("d", "drive"), PROTOCOL)
    assert reference_floor([drive]) is None
    assert cramer_rao_floor([drive], SETS[1]) is None


def random_model(steps, n=4, m=2, seed=1):
    generator = np.random.default_rng(seed)
    A = np.eye(n) * 0.95 + 0.1 * generator.standard_normal((steps, n, n))
    Q, P = (root @ root.T + 0.1 * np.eye(n) for root in generator.standard_normal((2, n, n)))
    R = 0.1 + generator.random(m)
    return LinearModel(
        A, np.zeros(n), Q, generator.standard_normal((steps, m, n)), np.zeros(m), R
    ), P


def test_bound_is_that_of_tichavsky_and_others():
    """J(k+1) = D22 - D21 (J(k) + D11)⁻¹ D12 (their Eq. 21) with D11 = AᵀQ⁻¹A, D12 = -AᵀQ⁻¹, D22 =
    Q⁻¹ + CᵀR⁻¹C.
    """
    model, prior = random_model(200)
    bound = posterior_bound(model, prior)
    inverse_Q = np.linalg.inv(model.process_noise)
    inverse_R = np.diag(1.0 / model.observation_noise)
    measured_information = [C.T @ inverse_R @ C for C in model.observation]
    information = np.linalg.inv(prior) + measured_information[0]
    for k in range(200):
        assert np.allclose(bound[k], np.linalg.inv(information), rtol=1e-8)
        if k < 199:
            A = model.transition[k]
            D11 = A.T @ inverse_Q @ A
            D12 = -A.T @ inverse_Q
            information = (
                inverse_Q
                + measured_information[k + 1]
                - D12.T @ np.linalg.solve(information + D11, D12)
            )


def test_bound_of_a_long_drive_is_the_same_in_chunks(
    monkeypatch,
):
    drive = drive_of(single_track_drive(60.0), Span("d", "track"), PROTOCOL)
    undivided = cramer_rao_floor([drive], SETS[-1])
    monkeypatch.setattr(floors, "SAMPLES_TOGETHER", 97)
    chunks = cramer_rao_floor([drive], SETS[-1])
    assert (chunks.vy, chunks.sideslip) == (
        pytest.approx(undivided.vy, rel=1e-9),
        pytest.approx(undivided.sideslip, rel=1e-9),
    )
    drive = single_track_drive(60.0)
    vx = drive["vx"].copy()
    vx[400:600] = 0.0
    gappy = with_gaps(drive.with_channels({"vx": vx}), {"ay": slice(700, 720)})
    floor = cramer_rao_floor([drive_of(gappy, Span("d", "d"), PROTOCOL)], SETS[-1])
    assert 0 < floor.vy < 1
    assert 0 < floor.sideslip < 104


def test_white_and_correlated_noise_are_distinguished():
    """40 minutes of known noise: white of 0.3 at 20 Hz, a density of 0.0045, and a slow part of 0.2
    that lasts 8 s.
    """
    generator = np.random.default_rng(4)
    n = 48_000
    noise = split_noise([markov(generator, n, 0.2, 8.0) + 0.3 * generator.standard_normal(n)], RATE)
    assert noise.density == pytest.approx(0.3**2 / RATE, rel=0.15)
    assert noise.deviation == pytest.approx(0.2, rel=0.1)
    assert noise.time_constant == pytest.approx(8.0, rel=0.35)
    noise = split_noise([0.3 * np.random.default_rng(5).standard_normal(48_000)], RATE)
    assert noise.density == pytest.approx(0.3**2 / RATE, rel=0.15)
    assert noise.deviation < 0.02
    noise = gauss_markov([markov(np.random.default_rng(6), 48_000, 0.7, 2.5)], RATE)
    assert noise == Noise(0.0, pytest.approx(0.7, rel=0.1), pytest.approx(2.5, rel=0.2))


def test_more_inputs_never_raise_the_bound():
    drives = [drive_of(single_track_drive(), Span("d", "track"), PROTOCOL)]
    spread = reference_spread(drives)
    for car in (False, True):
        floors = {frozenset(inputs): cramer_rao_floor(drives, inputs, car=car) for inputs in SETS}
        assert all(floor.vy <= spread.vy * (1 + 1e-6) for floor in floors.values())
        same_a = [inputs for inputs in floors if "ay" in inputs]
        for fewer in same_a:
            for more in same_a:
                if fewer < more:
                    assert floors[more].vy <= floors[fewer].vy * (1 + 1e-9), (fewer, more)
        if car:
            assert floors[frozenset({"vx", "yaw_rate"})].vy < 0.5 * spread.vy


def test_kinematics_tell_v_by_accelerations_in_bends_alone():
    drives = [drive_of(single_track_drive(), Span("d", "track"), Protocol(RATE, 0.0, 0.0))]
    assert cramer_rao_floor(drives, SETS[0], car=False).vy == pytest.approx(
        reference_spread(drives).vy, rel=1e-6
    )
    bends = single_track_drive()
    straight = bends.with_channels({"yaw_rate": np.zeros(len(bends))})
    for recording, helps in ((bends, True), (straight, False)):
        drives = [drive_of(recording, Span("d", recording.id), PROTOCOL)]
        without, with_ax = (cramer_rao_floor(drives, inputs, car=False).vy for inputs in SETS[1:3])
        assert (with_ax < 0.8 * without) is helps


def test_a_filter_that_knows_the_model_reaches_the_bound_of_a_drive():
    """Drives drawn from v⁺ = φ v + ξ, ay = dv/dt + uω + offset + noise: an optimal filter's error
    is the bound's, to a few per cent.
    """
    generator = np.random.default_rng(7)
    n = 6000
    step = 1.0 / RATE
    v = markov(generator, n + 1, 0.8, 3.0)
    offset = markov(generator, n, 0.15, 10.0)
    white = 0.3
    ay = np.diff(v) * RATE - offset - white * generator.standard_normal(n)
    channels = {"vx": np.full(n, 20.0), "yaw_rate": np.zeros(n), "ay": ay, "vy_ref": v[:-1]}
    drives = [
        drive_of(
            Recording("d", "car", RATE, 0.0, channels), Span("d", "d"), Protocol(RATE, 0.0, 0.0)
        )
    ]
    decay = math.exp(-step / 3.0)
    slow = math.exp(-step / 10.0)
    kalman = KalmanFilter(dim_x=3, dim_z=1)  # v, v a sample earlier, offset
    kalman.x = np.zeros((3, 1))
    kalman.P = np.diag([0.8**2, 0.8**2, 0.15**2])
    kalman.F = np.array([[decay, 0, 0], [1, 0, 0], [0, 0, slow]])
    kalman.Q = np.diag([0.8**2 * (1 - decay**2), 0.0, 0.15**2 * (1 - slow**2)])
    kalman.H = np.array([[RATE, -RATE, -1.0]])
    kalman.R = np.array([[white**2]])
    errors = []
    for k in range(n):
        kalman.predict()
        kalman.update(ay[k])
        errors.append(kalman.x[1, 0] - v[k])
    assert cramer_rao_floor(drives, SETS[1], car=False).vy == pytest.approx(
        np.sqrt(np.mean(np.square(errors))), rel=0.1
    )


@pytest.mark.parametrize("scale", [0.0, 1e-6, 1.0])
def test_drives_without_noise_or_without_motion_leave_every_bound_finite(scale):
    drive = planar_drive(60.0)
    for vx in (drive["vx"], np.zeros(len(drive))):
        channels = {name: scale * samples for name, samples in drive.channels.items()} | {"vx": vx}
        drives = [drive_of(Recording("d", "car", RATE, 0.0, channels), Span("d", "d"), PROTOCOL)]
        spread = reference_spread(drives)
        for inputs in SETS[:3]:
            for car in (False, True):
                assert 0 <= cramer_rao_floor(drives, inputs, car=car).vy <= spread.vy + 1e-8


def test_inputs_of_an_estimator_decide_which_bound_it_has_if_any():
    assert inputs_of(("yaw_rate", "vx", "ay", "ax")) == {"yaw_rate", "vx", "ay", "ax"}
    assert inputs_of(("motor_speed", "motor_current", "yaw_rate", "steer")) == {
        "vx",
        "yaw_rate",
        "steer",
    }
    assert inputs_of(("wheel_speed_fl", "yaw_rate", "handwheel")) == {"vx", "yaw_rate", "steer"}
    assert inputs_of(("vx",)) is None
    assert inputs_of(("vx", "yaw_rate", "ay", "fy_front_left")) is None
    drives = [
        drive_of(
            single_track_drive(30.0).select(["vx", "yaw_rate", "vy_ref"]),
            Span("d", "track"),
            PROTOCOL,
        )
    ]
    assert cramer_rao_floor(drives, SETS[0]) is not None
    assert cramer_rao_floor(drives, SETS[1]) is None
    with pytest.raises(ValueError, match="inputs of a bound are vx, yaw_rate and some of"):
        cramer_rao_floor(drives, ("vx", "ay"))


def test_floors_of_sideslip_are_those_of_the_samples_at_which_it_is_scored():
    """A stop, of which any error of v makes an angle of which nothing is known."""
    generator = np.random.default_rng(8)
    n = 4000
    vx = np.where(np.arange(n) < 3000, 20.0, 0.001)
    vy = np.where(vx > 1.0, np.sin(np.arange(n) / 40.0), 0.0) + 0.01 * generator.standard_normal(n)
    drive = Drive(20.0, {"vx": vx, "yaw_rate": np.zeros(n)}, vy, 0)
    moving = replace(drive, min_sideslip_speed=1.0)
    everywhere = reference_floor([drive])
    floor = reference_floor([moving])
    assert floor.vy == everywhere.vy == pytest.approx(0.01, rel=0.1)
    assert floor.sideslip == pytest.approx(np.degrees(floor.vy / 20.0), rel=0.01)
    assert everywhere.sideslip > 10.0
    assert reference_spread([moving]).sideslip == pytest.approx(
        np.degrees(math.sqrt(0.5) / 20.0), rel=0.01
    )
    assert math.isnan(reference_spread([replace(drive, min_sideslip_speed=100.0)]).sideslip)
