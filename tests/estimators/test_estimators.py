"""Estimators: counts of the paper, one interface, online as in batch, files that execute nothing."""

import math
from dataclasses import fields
from functools import cache

import numpy as np
import pytest

from every_estimator import drive_for, fitted
from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.transforms import Resample
from vehest.estimators.base import FitData
from vehest.estimators.model_files import load_model, save_model
from vehest.estimators.registry import estimator_class, estimator_names
from vehest.run.config import compose_config
from vehest.training.search import DirectSearchSettings

known = cache(fitted)
"""The same estimator for several tests, which leave it as it is."""
OF_A_DTYPE = [name for name in estimator_names() if "dtype" in {own.name for own in fields(estimator_class(name).training_type)}]


def test_parameter_counts_are_those_of_the_paper():
    """Tables III to V of Da Lio et al. 2023."""

    def count(name, **config):
        return estimator_class(name).from_config(config).n_parameters

    for p in range(2, 7):
        assert count("ksnn", n_local=p, n_hidden=0, bias=False) == 6 * p
        assert count("ksnn", n_local=p, n_hidden=0, bias=True) == 8 * p
        for q in (1, 2, 3):
            assert count("ksnn", n_local=p, n_hidden=q, bias=False) == (4 * q + 6) * p
            assert count("ksnn", n_local=p, n_hidden=q, bias=True) == (6 * q + 10) * p
    assert count("ksnn", n_local=2, n_hidden=3, bias=False) == 36
    assert count("ksnn", n_local=2, n_hidden=3, bias=True) == 56
    assert [count("gru", n_states=n) for n in (2, 5, 6)] == [45, 156, 205]
    assert [count("lstm", n_states=n) for n in (2, 5, 6)] == [59, 206, 271]
    assert count("luenberger") == 2


@pytest.mark.parametrize("name", estimator_names())
def test_configuration_file_states_the_defaults(name):
    """What the pages' tables of settings say, from the class, is what `vehest train` takes."""
    needed = {"wheelbase": 2.7} if name == "data_sheet" else {}
    family, given = estimator_class(name), compose_config("train", [f"estimator={name}"])["estimator"]
    assert family.from_config({**given, **needed}).settings == family.from_config(needed).settings


@pytest.mark.parametrize(
    ("name", "dtype", "tolerance"),
    [*((name, "float64", 1e-9) for name in estimator_names()), *((name, "float32", 1e-4) for name in OF_A_DTYPE)],
)
def test_online_agrees_with_batch(name, dtype, tolerance):
    estimator = known(name, dtype)
    drive = drive_for(estimator)
    estimate = estimator.estimate([drive])[0]
    batch = estimate["vy"]
    stepper = estimator.online()
    assert stepper.horizon_steps == estimator.horizon_steps
    said = [stepper.step({channel: drive[channel][k] for channel in drive.channels}) for k in range(len(drive))]
    online = np.array([math.nan] * stepper.horizon_steps + [row["vy"] for row in said])[: len(drive)]
    assert np.array_equal(np.isnan(online), np.isnan(batch))
    assert np.nanmax(np.abs(online - batch)) <= tolerance
    assert np.isfinite(batch).sum() == len(drive) - estimator.warm_up_steps - estimator.horizon_steps
    if "vy" in estimate.covariance_of:
        row = estimate.covariance_of.index("vy")
        np.testing.assert_allclose([own["vy_variance"] for own in said], estimate.covariance[:, row, row], rtol=10 * tolerance)
    else:
        assert "vy_variance" not in said[-1]


@pytest.mark.parametrize("name", estimator_names())
def test_estimates_use_no_future_measurements(name):
    estimator = known(name, "float64")
    drive = drive_for(estimator)
    half = len(drive) // 2
    changed = {channel: np.concatenate([samples[:half], samples[half:] + 1.0]) for channel, samples in drive.channels.items()}
    other = type(drive)(drive.id, drive.vehicle, drive.rate_hz, drive.start_time, changed, drive.kind)
    before, after = (estimator.estimate([recording])[0]["vy"][:half] for recording in (drive, other))
    assert np.array_equal(before, after, equal_nan=True)


@pytest.mark.parametrize("name", estimator_names())
def test_model_read_back_estimates_the_same(tmp_path, name):
    estimator = known(name, "float32" if name in OF_A_DTYPE else "float64")
    save_model(estimator, tmp_path, {"seed": 0})
    loaded = load_model(tmp_path)
    drive = drive_for(estimator)
    one, other = estimator.estimate([drive])[0], loaded.estimate([drive])[0]
    assert np.array_equal(one["vy"], other["vy"], equal_nan=True)
    assert loaded.settings == estimator.settings
    assert sorted(file.name for file in tmp_path.iterdir()) == ["model.safetensors", "model.yaml"]


@pytest.mark.parametrize("size", [0, 40, -8])
def test_truncated_weights_are_one_clear_error(tmp_path, size):
    with pytest.raises(MissingError, match="holds no model"):
        load_model(tmp_path)
    save_model(known("ksnn", "float64"), tmp_path)
    weights = tmp_path / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:size])
    with pytest.raises(DataError, match="truncated or damaged"):
        load_model(tmp_path)


def test_estimator_refuses_wrong_rate_missing_channel_and_gaps(drive):
    estimator = known("ksnn", "float64")
    with pytest.raises(DataError, match="works at 20 Hz; resample it first"):
        estimator.estimate([Resample(10).__call__(drive)])
    with pytest.raises(DataError, match="no channel 'ax'"):
        estimator.estimate([drive.select(["vx", "yaw_rate", "ay"])])
    gaps = {**drive.channels, "ay": np.where(np.arange(len(drive)) == 7, np.nan, drive["ay"])}
    gappy = type(drive)(drive.id, drive.vehicle, drive.rate_hz, 0.0, gaps, "simulated", frozenset({"ay"}))
    with pytest.raises(DataError, match="has gaps"):
        estimator.estimate([gappy])


def test_a_model_of_another_version_is_refused_and_one_without_loads(tmp_path, monkeypatch):
    estimator = known("luenberger", "float64")
    save_model(estimator, tmp_path)
    description = tmp_path / "model.yaml"
    description.write_text(description.read_text().replace("version: '1'\n", ""))
    assert load_model(tmp_path).gain == estimator.gain
    monkeypatch.setattr(type(estimator), "version", "2")
    with pytest.raises(DataError, match=r"holds version 1 of 'luenberger'.*version 2 here; train it again"):
        load_model(tmp_path)
    save_model(estimator, tmp_path)
    assert load_model(tmp_path).gain == estimator.gain


def test_a_number_that_is_given_is_not_fitted(drive):
    estimator = estimator_class("luenberger").from_config({"gain": 7.0})
    assert estimator.n_parameters == 1
    estimator.fit(FitData([drive], [drive]), DirectSearchSettings(grid=2, max_evaluations=10))
    assert estimator.gain == 7.0
    assert estimator.threshold >= 0.0


def test_recordings_start_from_their_own_states_or_all_from_one_and_forget_them(monkeypatch, drive):
    estimator = fitted("luenberger")
    estimator.threshold = 0.0
    drive = drive_for(estimator)
    free = estimator.estimate([drive])[0]["vy"]
    started = estimator.estimate([drive], {"vy": 2.0})[0]["vy"]
    assert abs(started[0] - free[0]) > 1.0
    assert abs(started[-1] - free[-1]) < 0.05, "the observer forgets where it started"
    estimator = known("luenberger", "float64")
    drive = drive_for(estimator)
    states = [{"vy": 2.0}, {"vy": -1.0, "vx": 20.0}]
    both = estimator.estimate([drive, drive], states)
    for state, own in zip(states, both, strict=True):
        assert np.array_equal(own["vy"], estimator.estimate([drive], state)[0]["vy"])
    one = estimator.estimate([drive, drive], states[0])
    assert np.array_equal(one[0]["vy"], one[1]["vy"])
    with pytest.raises(DataError, match="2 initial states for 1 recordings"):
        estimator.estimate([drive], states)
    monkeypatch.setattr(type(estimator), "ignores_initial_state", True)
    assert np.array_equal(estimator.estimate([drive], states[0])[0]["vy"], estimator.estimate([drive])[0]["vy"])
    with pytest.raises(ConfigurationError, match="no state to start from"):
        known("ksnn", "float64").estimate([drive], {"vy": 1.0})


def test_registry_knows_names():
    first = "cnn_ukf, data_sheet, dugoff_ukf, ensemble_ukf, factor_graph, gru, kalman, kinematic, ksnn, learned_ukf"
    last = "self_calibrating, sideslip_ffnn, static_map, velocity_gru, velocity_lstm, zero"
    names = f"{first}, learned_ukf_variant, lstm, luenberger, rational_ekf, {last}"
    assert ", ".join(sorted(estimator_names())) == names
    with pytest.raises(ConfigurationError, match=f"is not one of: {names}"):
        estimator_class("kalman_filter_from_the_future")
    with pytest.raises(ConfigurationError, match="'windowed' is not one of"):
        estimator_class("windowed")


@pytest.mark.parametrize(
    ("name", "config", "message"),
    [
        ("ksnn", {"n_local": 0}, "n_local must be at least 1"),
        ("gru", {"n_states": 2.5}, "n_states must be a whole number"),
        ("luenberger", {"gains": 3}, "gains is not an option"),
    ],
)
def test_settings_that_make_no_sense_are_refused(name, config, message):
    with pytest.raises(ConfigurationError, match=message):
        estimator_class(name).from_config(config)


def test_activations_partition_unity_and_end_with_the_last_model():
    import torch

    from vehest.estimators.ksnn import Ksnn
    from vehest.estimators.networks.ksnn import KinematicsStructuredNetwork

    network = KinematicsStructuredNetwork(Ksnn.settings_type(n_local=3), yaw_rate_max=0.6)
    phi = network.activations(torch.tensor([0.0, 0.15, -0.3, 0.6, 2.0]))
    assert torch.allclose(phi.sum(-1), torch.ones(5))
    assert torch.allclose(phi[0], torch.tensor([1.0, 0.0, 0.0]))
    assert torch.allclose(phi[1], torch.tensor([0.5, 0.5, 0.0]))
    assert torch.allclose(phi[2], torch.tensor([0.0, 1.0, 0.0]), atol=1e-6)
    assert torch.allclose(phi[4], torch.tensor([0.0, 0.0, 1.0]))
