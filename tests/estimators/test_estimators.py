"""Estimators: counts of the paper, one interface, online as in batch, files that execute nothing,
trainings that start from others.
"""

import math
from dataclasses import fields
from functools import cache

import numpy as np
import pytest
from refusals import refusal

import vehest
from conftest import flat_weights, planar_drive
from every_estimator import drive_for, fitted, online_rows
from single_track_drive import with_gaps
from vehest.configuration.composition import compose_config
from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.transforms import Resample
from vehest.estimators.base import FitData
from vehest.estimators.model_files import load_model, save_model
from vehest.estimators.registry import estimator_class, estimator_names
from vehest.training.search import DirectSearchSettings
from vehest.vehicle.parameters import FERRARI_250LM

fitted_once = cache(fitted)
"""The same estimator for several tests, which leave it as it is."""
OF_A_DTYPE = [
    name
    for name in estimator_names()
    if "dtype" in {field.name for field in fields(estimator_class(name).training_type)}
]
SLOW_TO_COMPILE = {"learned_ukf": pytest.mark.apart}  # a minute for each precision


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
    required = {"wheelbase": 2.7} if name == "data_sheet" else {}
    family = estimator_class(name)
    composed = compose_config("train", [f"estimator={name}"])["estimator"]
    assert (
        family.from_config({**composed, **required}).settings
        == family.from_config(required).settings
    )


@pytest.mark.parametrize(
    ("name", "dtype", "tolerance"),
    [
        *((name, "float64", 1e-9) for name in estimator_names()),
        *(
            pytest.param(name, "float32", 1e-4, marks=SLOW_TO_COMPILE.get(name, ()))
            for name in OF_A_DTYPE
        ),
    ],
)
def test_online_agrees_with_batch(name, dtype, tolerance):
    estimator = fitted_once(name, dtype)
    drive = drive_for(estimator)
    estimate = estimator.estimate([drive])[0]
    batch = estimate["vy"]
    assert estimator.online().horizon_steps == estimator.horizon_steps
    steps = online_rows(estimator, drive, drive.channels)
    online = np.array([math.nan] * estimator.horizon_steps + [row["vy"] for row in steps])[
        : len(drive)
    ]
    assert np.array_equal(np.isnan(online), np.isnan(batch))
    assert np.nanmax(np.abs(online - batch)) <= tolerance
    assert (
        np.isfinite(batch).sum() == len(drive) - estimator.warm_up_steps - estimator.horizon_steps
    )
    if "vy" in estimate.covariance_of:
        row = estimate.covariance_of.index("vy")
        np.testing.assert_allclose(
            [step["vy_variance"] for step in steps],
            estimate.covariance[:, row, row],
            rtol=10 * tolerance,
        )
    else:
        assert "vy_variance" not in steps[-1]


@pytest.mark.parametrize("name", estimator_names())
def test_model_read_back_estimates_the_same(tmp_path, name):
    is_single = name in OF_A_DTYPE and name not in SLOW_TO_COMPILE
    estimator = fitted_once(name, "float32" if is_single else "float64")
    save_model(estimator, tmp_path, {"seed": 0})
    loaded = load_model(tmp_path)
    drive = drive_for(estimator)
    estimate = estimator.estimate([drive])[0]
    loaded_estimate = loaded.estimate([drive])[0]
    assert np.array_equal(estimate["vy"], loaded_estimate["vy"], equal_nan=True)
    assert loaded.settings == estimator.settings
    assert sorted(file.name for file in tmp_path.iterdir()) == ["model.safetensors", "model.yaml"]


@pytest.mark.parametrize("size", [0, 40, -8])
def test_truncated_weights_are_a_clear_error(tmp_path, size):
    assert "holds no model" in refusal(lambda: load_model(tmp_path), MissingError)
    save_model(fitted_once("ksnn", "float64"), tmp_path)
    weights = tmp_path / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:size])
    assert "truncated or damaged" in refusal(lambda: load_model(tmp_path))


def test_wrong_rate_missing_channel_gaps_and_unknown_names_are_refused(
    drive,
):
    estimator = fitted_once("ksnn", "float64")
    assert "works at 20 Hz; resample it first" in refusal(
        lambda: estimator.estimate([Resample(10).__call__(drive)])
    )
    assert "no channel 'ax'" in refusal(
        lambda: estimator.estimate([drive.select(["vx", "yaw_rate", "ay"])])
    )
    gappy = with_gaps(drive, {"ay": 7})
    assert "has gaps" in refusal(lambda: estimator.estimate([gappy]))
    with pytest.raises(
        ConfigurationError, match=f"is not one of: {', '.join(sorted(estimator_names()))}"
    ):
        estimator_class("kalman_filter_from_the_future")
    assert "'windowed' is not one of" in refusal(
        lambda: estimator_class("windowed"), ConfigurationError
    )


def test_models_of_other_versions_are_refused_and_unversioned_ones_load(tmp_path, monkeypatch):
    estimator = fitted_once("luenberger", "float64")
    save_model(estimator, tmp_path)
    description = tmp_path / "model.yaml"
    description.write_text(description.read_text().replace("version: '1'\n", ""))
    assert load_model(tmp_path).gain == estimator.gain
    monkeypatch.setattr(type(estimator), "version", "2")
    with pytest.raises(
        DataError, match=r"holds version 1 of 'luenberger'.*version 2 here; train it again"
    ):
        load_model(tmp_path)
    save_model(estimator, tmp_path)
    assert load_model(tmp_path).gain == estimator.gain


def test_configured_numbers_are_not_fitted(drive):
    estimator = estimator_class("luenberger").from_config({"gain": 7.0})
    assert estimator.n_parameters == 1
    estimator.fit(FitData([drive], [drive]), DirectSearchSettings(grid=2, max_evaluations=10))
    assert estimator.gain == 7.0
    assert estimator.threshold >= 0.0


def test_recordings_start_from_individual_or_shared_states(monkeypatch, drive):
    assert "no state to start from" in refusal(
        lambda: fitted_once("ksnn", "float64").estimate([drive], {"vy": 1.0}), ConfigurationError
    )
    estimator = fitted("luenberger")
    estimator.threshold, drive = 0.0, drive_for(estimator)
    free = estimator.estimate([drive])[0]["vy"]
    started = estimator.estimate([drive], {"vy": 2.0})[0]["vy"]
    assert abs(started[0] - free[0]) > 1.0
    assert abs(started[-1] - free[-1]) < 0.05, "the observer forgets where it started"
    estimator = fitted_once("luenberger", "float64")
    states = [{"vy": 2.0}, {"vy": -1.0, "vx": 20.0}]
    estimates = estimator.estimate([drive, drive], states)
    for state, estimate in zip(states, estimates, strict=True):
        assert np.array_equal(estimate["vy"], estimator.estimate([drive], state)[0]["vy"])
    from_shared_state = estimator.estimate([drive, drive], states[0])
    assert np.array_equal(from_shared_state[0]["vy"], from_shared_state[1]["vy"])
    assert "2 initial states for 1 recordings" in refusal(
        lambda: estimator.estimate([drive], states)
    )
    monkeypatch.setattr(type(estimator), "ignores_initial_state", True)
    assert np.array_equal(
        estimator.estimate([drive], states[0])[0]["vy"], estimator.estimate([drive])[0]["vy"]
    )


@pytest.mark.parametrize(
    ("name", "config", "message"),
    [
        ("ksnn", {"n_local": 0}, "n_local must lie between 1 and 4096"),
        ("gru", {"n_states": 2.5}, "n_states must be a whole number"),
        ("luenberger", {"gains": 3}, "gains is not an option"),
        ("kalman", {"noise": {"ay": -1}}, r"estimator\.noise\.ay must be positive"),
        ("kalman", {"noise": {"cutoff": 1.5}}, "cutoff must lie between"),
        (
            "kalman",
            {"car": {**vars(FERRARI_250LM), "mass": -3}},
            r"estimator\.car: mass must be positive, not -3",
        ),
        (
            "factor_graph",
            {"window": 0},
            "window must be null or at least one sampling interval, 0.01 s, not 0.0 s",
        ),
        ("factor_graph", {"gate": 5.0}, r"estimator\.gate needs estimator\.window"),
        ("rational_ekf", {"tyres": "square"}, "tyres 'square' is not one of: linear, rational"),
        ("rational_ekf", {"bound": 1.0}, "bound must be more than 1"),
        (
            "rational_ekf",
            {"largest_sideslip": 1.6},
            r"largest_sideslip must lie between 0 and 1\.5 rad, not at 1\.6",
        ),
        (
            "rational_ekf",
            {"noise": {"yaw_rate": 0.1}},
            "estimator.noise: give all of yaw_rate, ay, steer, or none",
        ),
        (
            "rational_ekf",
            {"curves": {"c1_front": 0.1}},
            "estimator.curves: give all of c1_front, c2_front, c1_rear, c2_rear, or none",
        ),
        ("velocity_gru", {"inputs": ["ax", "ax"]}, "list of different channels"),
        ("velocity_gru", {"inputs": ["warp"]}, "channel 'warp' is not known"),
        ("velocity_gru", {"inputs": ["vy_ref"]}, "'vy_ref' comes from a reference sensor"),
        ("velocity_gru", {"outputs": ["vx"]}, "vy among them, not vx"),
        ("learned_ukf", {"curvature": True}, "curvature is of estimator.dynamics=pacejka"),
        ("learned_ukf", {"start_friction": 0.01}, "start_friction must lie above least_friction"),
        ("learned_ukf", {"car": {"cg_to_rear_axle": 0.4}}, "less than the wheelbase"),
        ("data_sheet", {}, "needs your car's wheelbase"),
        ("data_sheet", {"wheelbase": -1}, "wheelbase must lie between 0.05 and 20 m"),
        ("data_sheet", {"wheelbase": 2.4, "cg_to_rear_axle": 3.0}, "between 0 and the wheelbase"),
        ("dugoff_ukf", {"tyres": {"friction_front": 1.0}}, r"estimator\.tyres: give all"),
        ("ensemble_ukf", {"members": 1}, "estimator"),
        ("sideslip_ffnn", {"hidden": [5]}, "estimator"),
        ("sideslip_ffnn", {"hidden": "ab"}, "estimator"),
        (
            "self_calibrating",
            {"wheelbase": 2.7, "cg_to_rear_axle": 3.0},
            "cg_to_rear_axle must lie between 0 and the wheelbase",
        ),
        ("self_calibrating", {"grips": [9.0, -1.0]}, "grips must be positive"),
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


OF_SHIPPED = ["estimator.n_local=2", "estimator.n_hidden=2", "estimator.bias=false"]
NO_TRAINING = ["training.max_epochs=1", "training.learning_rate=1e-12"]


def test_training_without_epochs_keeps_the_start_and_foreign_settings_are_refused():
    from vehest.inference.models import pretrained_folder

    drives = [planar_drive(30.0, 20.0, seed=seed) for seed in (1, 2)]
    started = vehest.train(
        "ksnn",
        drives[:1],
        drives[1:],
        [*OF_SHIPPED, *NO_TRAINING, f"training.start_from={pretrained_folder()}"],
    )
    assert flat_weights(started) == pytest.approx(
        flat_weights(vehest.load_model("pretrained")), abs=1e-6
    )
    scratch = vehest.train("ksnn", drives[:1], drives[1:], [*OF_SHIPPED, *NO_TRAINING])
    assert np.abs(flat_weights(scratch) - flat_weights(started)).max() > 0.01

    with pytest.raises(
        ConfigurationError,
        match=r"training\.start_from: 'pretrained' is KS-NN .*'n_hidden': 2.*'n_hidden': 0",
    ):
        vehest.train(
            "ksnn",
            drives[:1],
            drives[1:],
            ["estimator.n_hidden=0", f"training.start_from={pretrained_folder()}"],
        )


def test_models_are_inputs_and_are_resolved_by_name(place):
    common = ("estimator=ksnn", "split=mine", "training.max_epochs=1", "tracking=none", *OF_SHIPPED)
    plain = place.told("train", *common)
    started = place.told("train", *common, "training.start_from=pretrained")
    assert plain["model"] != started["model"]
    assert not started["skipped"]
    refusal = place.refused("train", *common, "training.start_from=nobody")[1]
    assert refusal.startswith("error: there is no model 'nobody'")
    assert refusal.rstrip().endswith("comes with vehest: pretrained, self_calibrating")
