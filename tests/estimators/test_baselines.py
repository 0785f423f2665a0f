"""Baselines: closed forms, one sample at a time, what they refuse."""

import itertools

import numpy as np
import pytest
from refusals import refusal
from scipy.integrate import solve_ivp

from conftest import planar_drive
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import Recording
from vehest.estimators.base import FitData
from vehest.estimators.registry import estimator_class
from vehest.training.context import NoTraining
from vehest.vehicle.parameters import SingleTrackParameters
from vehest.vehicle.single_track import lateral_model


def new(name, **settings):
    config = {"rate_hz": 20.0, **({"wheelbase": 2.4} if name == "data_sheet" else {}), **settings}
    return estimator_class(name).from_config(config)


def fitted(name, drive, **settings):
    estimator = new(name, **settings)
    record = estimator.fit(FitData([drive], [drive]), NoTraining())
    return estimator, record


def steady_drive(car):
    """Steady cornering of the linear single track at several speeds and steering angles: v and r
    solve 0 = A x + B δ at each sample.
    """
    generator = np.random.default_rng(3)
    vx = generator.uniform(8.0, 35.0, 600)
    steer = generator.uniform(-0.05, 0.05, len(vx))
    matrix, steering, *_ = lateral_model(car, vx)
    states = -np.linalg.solve(matrix, (steering * steer[:, None])[..., None])[..., 0]
    channels = {
        "vx": vx,
        "yaw_rate": states[:, 1],
        "ay": vx * states[:, 1],
        "vy_ref": vx * states[:, 0],
    }
    return Recording("steady", "car", 20.0, 0.0, channels, "simulated")


CAR = SingleTrackParameters(1000.0, 1600.0, 1.2, 1.3, 8.0e4, 1.1e5)


def test_static_map_identifies_and_data_sheet_computes_a_linear_single_track():
    estimator, record = fitted("static_map", steady_drive(CAR))
    assert estimator.values["b"] == pytest.approx(CAR.cg_to_rear_axle, rel=1e-9)
    wheelbase = CAR.cg_to_front_axle + CAR.cg_to_rear_axle
    assert estimator.values["k"] == pytest.approx(
        CAR.mass * CAR.cg_to_front_axle / (wheelbase * CAR.cornering_stiffness_rear), rel=1e-9
    )
    assert record.metrics["best_train_loss"] == pytest.approx(0.0, abs=1e-18)
    drive = steady_drive(CAR)
    wheelbase = CAR.cg_to_front_axle + CAR.cg_to_rear_axle
    coefficient = CAR.cornering_stiffness_rear / (
        CAR.mass * 9.81 * CAR.cg_to_front_axle / wheelbase
    )
    estimator = new(
        "data_sheet",
        wheelbase=wheelbase,
        cg_to_rear_axle=CAR.cg_to_rear_axle,
        cornering_coefficient=coefficient,
    )
    (estimate,) = estimator.estimate([drive.without_references()])
    np.testing.assert_allclose(estimate["vy"], drive["vy_ref"], atol=1e-12)


def test_prior_map_is_the_static_map_with_prior_parameters():
    """At the filter's centre of gravity, for a car of full size and for a small one whose tyres
    slip more.
    """
    drive = steady_drive(CAR)
    for wheelbase, compliance in ((2.7, 0.0045), (0.3, 0.0135)):
        (estimate,) = new("prior_map", wheelbase=wheelbase).estimate([drive.without_references()])
        fixed = new("static_map", b=0.48 * wheelbase, k=compliance)
        (expected,) = fixed.estimate([drive.without_references()])
        np.testing.assert_allclose(estimate["vy"], expected["vy"], rtol=0.0, atol=1e-12)
        model = new("self_calibrating", wheelbase=wheelbase)
        assert model.prior[0][6] == pytest.approx(compliance)  # the mean of C
        assert model.rear == pytest.approx(0.48 * wheelbase)
    prior_map = new("prior_map", wheelbase=2.7, cg_to_rear_axle=1.1)
    (estimate,) = prior_map.estimate([drive.without_references()])
    r = drive["yaw_rate"]
    np.testing.assert_allclose(estimate["vy"], r * (1.1 - 0.0045 * drive["vx"] ** 2), atol=1e-12)
    with pytest.raises(ConfigurationError, match="between 0 and the wheelbase"):
        new("prior_map", wheelbase=2.4, cg_to_rear_axle=3.0)


def test_kinematic_integration_solves_its_equation_and_fits_the_time_constant():
    drive = planar_drive(20.0)
    estimator = new("kinematic")
    estimator.values = {"time_constant": 2.5}
    (estimate,) = estimator.estimate([drive.without_references()])
    rate = drive["ay"] - drive["vx"] * drive["yaw_rate"]

    def derivative(t, v):
        return np.array(
            [rate[min(int(np.floor(t * 20.0 + 1e-9)) + 1, len(rate) - 1)] - v[0] / 2.5]
        )  # held from the sample before

    start = estimate["vy"][0]
    solved = [start]
    times = drive.time - drive.time[0]
    for begin, end in itertools.pairwise(times):
        solved.append(
            solve_ivp(derivative, (begin, end - 1e-12), [solved[-1]], rtol=1e-10, atol=1e-12).y[
                0, -1
            ]
        )
    np.testing.assert_allclose(estimate["vy"], solved, atol=1e-8)
    truth = new("kinematic")
    truth.values = {"time_constant": 1.7}
    drive = planar_drive(60.0)
    vy = truth.estimate([drive.without_references()])[0]["vy"]
    estimator, record = fitted("kinematic", drive.with_channels({"vy_ref": vy}))
    assert estimator.values["time_constant"] == pytest.approx(1.7, rel=1e-4)
    assert record.metrics["best_validation_loss"] < 1e-8


def test_zero_is_zero_and_a_map_that_is_not_fitted_or_not_determined_is_refused(drive):
    (estimate,) = new("zero").estimate([drive.without_references()])
    assert not estimate["vy"].any()
    assert not estimate["sideslip"].any()
    assert "has not been fitted" in refusal(lambda: new("static_map").online(), ConfigurationError)
    for channel, value in (("yaw_rate", 0.0), ("vx", 20.0)):
        with pytest.raises(DataError, match="do not determine a static map"):
            fitted("static_map", drive.with_channels({channel: np.full(len(drive), value)}))
