"""The Kalman filter over the single track: consistent on its own model, honest about where its
noise levels come from.
"""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refusal

from single_track_drive import NOISE, linear_drive, with_gaps
from vehest.data.errors import ConfigurationError, DataError
from vehest.estimators.base import FitData
from vehest.estimators.registry import estimator_class
from vehest.filters.noise_levels import high_passed_level
from vehest.training.context import NoTraining

CONFIGURED_NOISE = {"noise": {**NOISE, "steer_factor": 1.0}}


def kalman(**config):
    return estimator_class("kalman").from_config(config)


def test_levels_are_those_of_high_passed_training_or_recording_signals():
    drives = [linear_drive(60.0, seed=seed, noise={**NOISE, "steer": 1e-3})[0] for seed in (1, 2)]
    estimator = kalman()
    assert "has not been fitted yet" in refusal(lambda: estimator.online(), ConfigurationError)
    record = estimator.fit(FitData(drives, []), NoTraining())
    assert estimator.values["ay"] == high_passed_level([drive["ay"] for drive in drives], 0.2)
    assert estimator.values["yaw_rate"] == pytest.approx(NOISE["yaw_rate"] * np.sqrt(0.8), rel=0.05)
    assert record.metrics["epochs"] == 0
    assert (estimator.n_parameters, estimator.learns, estimator.causal, estimator.variant) == (
        3,
        True,
        True,
        "kalman",
    )
    drive = linear_drive(30.0, seed=3)[0].without_references()
    offline = kalman(noise={"read_from": "recording"})
    trained = kalman()
    trained.fit(FitData([drive], []), NoTraining())
    first = offline.estimate([drive])[0]
    second = trained.estimate([drive])[0]
    assert np.array_equal(first["vy"], second["vy"])
    assert (first.mode, second.mode) == ("offline", "causal")
    assert (offline.learns, offline.n_parameters, offline.variant) == (False, 0, "kalman_own_noise")
    assert "cannot run along with a drive" in refusal(lambda: offline.online(), ConfigurationError)


def test_configured_levels_are_not_read_and_need_no_training():
    estimator = kalman(noise={"ay": 0.7})
    estimator.fit(FitData([linear_drive(60.0)[0]], []), NoTraining())
    assert estimator.values["ay"] == 0.7
    assert estimator.n_parameters == 2
    estimator = kalman(**CONFIGURED_NOISE)
    assert (estimator.learns, estimator.causal, estimator.variant) == (
        False,
        True,
        "kalman_given_noise",
    )
    assert np.isfinite(
        estimator.online().step({"vx": 20.0, "yaw_rate": 0.1, "ay": 2.0, "steer": 0.01})["vy"]
    )


def test_samples_that_are_missing_are_skipped():
    """Without ay and yaw rate for 2 s the estimate goes on by the model alone, and knows that it
    knows less.
    """
    drive, states = linear_drive(30.0, seed=5)
    gappy = with_gaps(drive, {"ay": slice(1000, 1200), "yaw_rate": slice(1100, 1200)})
    estimator = kalman(**CONFIGURED_NOISE)
    estimate = estimator.estimate([gappy])[0]
    complete = estimator.estimate([drive])[0]
    assert np.array_equal(estimate["vy"][:1000], complete["vy"][:1000])
    assert np.abs(estimate["vy"] - complete["vy"])[2000:].max() < 1e-6, "the gap is forgotten"
    assert (estimate.covariance[1100:1200, 0, 0] > 1.2 * complete.covariance[1100:1200, 0, 0]).all()
    error = np.degrees(estimate["sideslip"] - states[:, 0])[1100:1200]
    assert np.abs(error).max() < 2.0


def test_speed_and_steering_may_not_be_missing():
    with pytest.raises(DataError, match="'vx' is nan, which estimator 'kalman' cannot take"):
        kalman(**CONFIGURED_NOISE).online().step(
            {"vx": np.nan, "yaw_rate": 0.0, "ay": 0.0, "steer": 0.0}
        )
    with pytest.raises(DataError, match="channel 'steer' has gaps"):
        kalman(**CONFIGURED_NOISE).estimate(
            [with_gaps(linear_drive(2.0)[0], {"steer": slice(3, 5)})]
        )
    assert "no channel 'steer'" in refusal(
        lambda: kalman(**CONFIGURED_NOISE).online().step({"vx": 1.0, "yaw_rate": 0.0, "ay": 0.0})
    )


def test_a_car_that_stands_has_an_estimate_and_a_state_handed_over_is_believed():
    drive = linear_drive(20.0, seed=6)[0]
    slow = drive.with_channels({"vx": np.linspace(20.0, -1.0, len(drive))})
    estimate = kalman(**CONFIGURED_NOISE).estimate([slow])[0]
    assert np.isfinite(estimate["vy"]).all()
    assert np.isfinite(estimate.covariance).all()
    drive = linear_drive(2.0)[0]
    estimate = kalman(**CONFIGURED_NOISE).estimate([drive], {"vy": 2.0, "yaw_rate": -0.3})[0]
    assert estimate["vy"][0] == pytest.approx(2.0, abs=1e-3)
    assert estimate["yaw_rate"][0] == pytest.approx(-0.3, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "samples", "message"),
    [
        (
            "steer",
            np.zeros(3000),
            "'linear': channel 'steer' has no noise that could be read off it; give "
            "estimator.noise.steer",
        ),
        (
            "ay",
            np.full(3000, np.nan),
            "channel 'ay': 75 samples without a gap are needed to read a noise level; give "
            "estimator.noise.ay",
        ),
    ],
)
def test_unreadable_levels_are_a_clear_error(name, samples, message):
    drive = replace(linear_drive(30.0)[0], gappy=frozenset({"ay"}))
    wrong = drive.with_channels({name: samples})
    with pytest.raises(DataError, match=message):
        kalman().fit(FitData([wrong], []), NoTraining())


def with_planted_offsets(seed, ay, steer):
    """A drive whose accelerometer and steering angle are off by constants that are drawn."""
    drive, states = linear_drive(4.0, seed=seed)
    generator = np.random.default_rng(1000 + seed)
    shifted = {
        "ay": drive["ay"] + ay * generator.standard_normal(),
        "steer": drive["steer"] + steer * generator.standard_normal(),
    }
    return drive.without_references().with_channels(shifted), states


def augmented(drive, ay, steer, seconds):
    """β, r and two offsets filtered by the textbook's equations, all matrices written out: means
    (T, 4), covariances (T, 4, 4).
    """
    A, B, C, D = kalman(**CONFIGURED_NOISE).sampled_model(drive["vx"])
    decay = np.exp(-0.01 / seconds)
    mean = np.zeros(4)
    covariance = np.diag([1e4, 1e4, ay**2, steer**2])
    R = np.diag([NOISE["ay"] ** 2, NOISE["yaw_rate"] ** 2])
    means = []
    covariances = []
    for k in range(len(drive)):
        if k > 0:
            F = np.block(
                [
                    [A[k - 1], np.zeros((2, 1)), -B[k - 1][:, None]],
                    [np.zeros((2, 2)), decay * np.eye(2)],
                ]
            )
            Q = np.zeros((4, 4))
            Q[:2, :2] = NOISE["steer"] ** 2 * np.outer(B[k - 1], B[k - 1])
            Q[2:, 2:] = (1.0 - decay**2) * np.diag([ay**2, steer**2])
            mean = F @ mean
            mean[:2] += B[k - 1] * drive["steer"][k - 1]
            covariance = F @ covariance @ F.T + Q
        H = np.array([[*C[k], 1.0, -D[k]], [0.0, 1.0, 0.0, 0.0]])
        gain = covariance @ H.T @ np.linalg.inv(H @ covariance @ H.T + R)
        mean = mean + gain @ (
            np.array([drive["ay"][k] - D[k] * drive["steer"][k], drive["yaw_rate"][k]]) - H @ mean
        )
        left = np.eye(4) - gain @ H
        covariance = left @ covariance @ left.T + gain @ R @ gain.T
        means.append(mean)
        covariances.append(covariance)
    return np.array(means), np.array(covariances)


OFFSETS = {"ay": 0.6, "steer": 0.01, "seconds": 100.0}


def test_offsets_are_the_states_of_an_augmented_filter():
    drive, _ = with_planted_offsets(3, 0.6, 0.01)
    means, covariances = augmented(drive, **OFFSETS)
    estimator = kalman(**CONFIGURED_NOISE, offsets=OFFSETS)
    samples = drive.stack(estimator.channels)
    filtered = estimator.filter_samples(samples, estimator.first_gaussian(samples[0], {}))
    assert filtered.mean == pytest.approx(means, abs=1e-8)
    assert filtered.covariance == pytest.approx(covariances[:, :2, :2], abs=1e-8)
    assert estimator.estimate([drive])[0]["yaw_rate"] == pytest.approx(means[:, 1], abs=1e-8)
    estimator = kalman(**CONFIGURED_NOISE, offsets=OFFSETS, gate=5.0)
    assert estimator.variant == "kalman_given_noise_ay_offset_steer_offset_gate5"
