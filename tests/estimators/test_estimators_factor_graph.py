"""The factor graph against a smoother, a filter and dense least squares with the same noise; what it says without GTSAM."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from single_track_drive import linear_drive, with_gaps
from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.recording import Recording
from vehest.estimators.base import FitData
from vehest.estimators.factor_graph import FactorGraph, FactorGraphSettings
from vehest.estimators.registry import estimator_class
from vehest.filters.gating import Gate
from vehest.filters.gaussian import Gaussian
from vehest.filters.kalman import LinearModel, kalman_filter, smooth
from vehest.run.config import compose_config
from vehest.training.context import NoTraining

GAPS = {"ay": slice(40, 60), "yaw_rate": slice(50, 70)}


def factor_graph(**config) -> FactorGraph:
    estimator = estimator_class("factor_graph").from_config(config)
    assert isinstance(estimator, FactorGraph)
    return estimator


@pytest.fixture
def gtsam():
    return pytest.importorskip("gtsam", reason="the factor graph needs gtsam: pip install 'vehest[factor-graph]'")


def drive_with_gaps(seconds: float = 2.0) -> Recording:
    return with_gaps(linear_drive(seconds, seed=1)[0].without_references(), GAPS)


def same_as_filter(estimator: FactorGraph, drive: Recording) -> tuple[LinearModel, torch.Tensor, Gaussian]:
    """The factor graph's model in the terms of a Kalman filter."""
    noise, steer = estimator.settings.noise, drive["steer"]
    A, B, C, D = estimator.sampled_model(drive["vx"])
    rows = np.zeros((len(drive), 2, 2))
    rows[:, 0], rows[:, 1, 1] = C, 1.0
    parts = (
        A,
        B * steer[:, None],
        np.diag([noise.model_sideslip**2, noise.model_yaw_rate**2]),
        rows,
        np.stack([D * steer, 0 * steer], axis=1),
        np.diag([noise.measured_ay**2, noise.measured_yaw_rate**2]),
    )
    measurements = torch.from_numpy(np.stack([drive["ay"], drive["yaw_rate"]], axis=1))
    first = Gaussian(torch.zeros(2, dtype=torch.float64), noise.first_state**2 * torch.eye(2, dtype=torch.float64))
    return LinearModel(*(torch.from_numpy(part) for part in parts)), measurements, first


def least_squares(estimator: FactorGraph, drive: Recording, first: int, last: int, start: np.ndarray, deviation: float) -> np.ndarray:
    """States first … last by dense least squares over the equations that factors stand for, (last - first + 1, 2)."""
    noise = estimator.settings.noise
    A, B, C, D = estimator.sampled_model(drive["vx"])
    count = last - first + 1
    rows, right = [], []

    def equation(k: int, coefficients: np.ndarray, value: float, sigma: float, later: np.ndarray | None = None) -> None:
        row = np.zeros((count, 2))
        row[k - first] = coefficients
        if later is not None:
            row[k - first + 1] = later
        rows.append(row.ravel() / sigma)
        right.append(value / sigma)

    for i in (0, 1):
        equation(first, np.eye(2)[i], start[i], deviation)
    for k in range(first, last + 1):
        if np.isfinite(drive["yaw_rate"][k]):
            equation(k, np.array([0.0, 1.0]), drive["yaw_rate"][k], noise.measured_yaw_rate)
        if np.isfinite(drive["ay"][k]):
            equation(k, C[k], drive["ay"][k] - D[k] * drive["steer"][k], noise.measured_ay)
        if k < last:
            for i, sigma in enumerate((noise.model_sideslip, noise.model_yaw_rate)):
                equation(k, -A[k, i], B[k, i] * drive["steer"][k], sigma, np.eye(2)[i])
    return np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0].reshape(count, 2)


def states_of(estimate) -> np.ndarray:
    return np.stack([estimate["sideslip"], estimate["yaw_rate"]], axis=1)


def test_batch_is_the_smoother_with_the_same_noise(gtsam):
    estimator, drive = factor_graph(), drive_with_gaps()
    estimate = estimator.estimate([drive])[0]
    model, measurements, first = same_as_filter(estimator, drive)
    smoothed = smooth(model, kalman_filter(model, measurements, first)).mean.numpy()
    assert np.abs(states_of(estimate) - smoothed).max() < 1e-9
    assert estimate.mode == "offline"


def test_batch_is_dense_least_squares(gtsam):
    estimator, drive = factor_graph(), drive_with_gaps()
    expected = least_squares(estimator, drive, 0, len(drive) - 1, np.zeros(2), 100.0)
    assert np.abs(states_of(estimator.estimate([drive])[0]) - expected).max() < 1e-9


def test_a_window_as_long_as_the_drive_is_the_filter_with_the_same_noise(gtsam):
    estimator, drive = factor_graph(window=5.0), drive_with_gaps(1.0)
    estimate = estimator.estimate([drive])[0]
    filtered = kalman_filter(*same_as_filter(estimator, drive)).filtered.mean.numpy()
    assert np.abs(states_of(estimate) - filtered).max() < 1e-9
    assert estimate.mode == "causal"


def test_a_short_window_is_dense_least_squares_over_it(gtsam):
    """Its first state hangs on what the window before made of that state."""
    estimator, drive = factor_graph(window=0.05), drive_with_gaps(0.8)
    expected, second = np.zeros((len(drive), 2)), np.zeros(2)
    for k in range(len(drive)):
        first = max(k - 5, 0)
        start, deviation = (second, 1.0) if first > 0 else (np.zeros(2), 100.0)
        states = least_squares(estimator, drive, first, k, start, deviation)
        expected[k] = states[-1]
        second = states[min(1, len(states) - 1)]
    assert np.abs(states_of(estimator.estimate([drive])[0]) - expected).max() < 1e-9


def test_online_skips_gaps_as_batch_does(gtsam):
    estimator, drive = factor_graph(window=0.1), drive_with_gaps()
    stepper = estimator.online()
    online = np.array([stepper.step({name: drive[name][k] for name in estimator.channels})["vy"] for k in range(len(drive))])
    assert np.abs(online - estimator.estimate([drive])[0]["vy"]).max() < 1e-9


def test_a_state_that_is_handed_over_is_believed(gtsam):
    drive = linear_drive(1.0)[0]
    for window in (None, 0.05):
        estimate = factor_graph(window=window).estimate([drive], {"vy": 2.0, "yaw_rate": -0.3})[0]
        assert estimate["vy"][0] == pytest.approx(2.0, abs=1e-3)
        assert estimate["yaw_rate"][0] == pytest.approx(-0.3, abs=1e-6)


def test_batch_cannot_run_along_with_a_drive(gtsam):
    with pytest.raises(ConfigurationError, match=r"cannot run along with a drive; set estimator\.window"):
        factor_graph().online()


def test_it_learns_nothing(gtsam):
    estimator = factor_graph()
    record = estimator.fit(FitData([], []), NoTraining())
    assert record.metrics["epochs"] == 0
    assert (estimator.learns, estimator.n_parameters, estimator.weights()) == (False, 0, {})
    with pytest.raises(DataError, match="has no weights"):
        estimator.load_weights({"gain": np.ones(1)})


def test_variants_say_how_it_is_solved():
    assert (factor_graph().variant, factor_graph().causal) == ("factor_graph_batch", False)
    assert (factor_graph(window=0.05).variant, factor_graph(window=0.05).causal) == ("factor_graph_lag_0.05s", True)


def test_configuration_file_states_the_defaults():
    config = compose_config("train", ["estimator=factor_graph"])
    assert config["training"] == {"name": "none"}
    assert factor_graph(**config["estimator"]).settings == FactorGraphSettings()


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"window": 0}, "window must be null or at least one sampling interval, 0.01 s, not 0.0 s"),
        ({"window": "long"}, "window must be a number"),
        ({"noise": {"measured_ay": 0}}, r"estimator\.noise\.measured_ay must be positive"),
    ],
)
def test_settings_that_make_no_sense_are_refused(config, message):
    with pytest.raises(ConfigurationError, match=message):
        factor_graph(**config)


def test_without_gtsam_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gtsam", None)
    needs = r"needs the package gtsam; pip install 'vehest\[factor-graph\]'"
    drive = linear_drive(1.0)[0]
    for attempt in (
        lambda: factor_graph().fit(FitData([], []), NoTraining()),
        lambda: factor_graph().estimate([drive]),
        lambda: factor_graph(window=0.1).online(),
    ):
        with pytest.raises(MissingError, match=needs):
            attempt()


def test_gtsam_is_imported_only_to_work():
    known = "from vehest.estimators.registry import estimator_names; assert 'factor_graph' in estimator_names()"
    code = f"import sys; {known}; assert 'gtsam' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_with_a_long_window_its_gate_is_that_of_the_kalman_filter(gtsam):
    estimator = factor_graph(window=3.0, gate=4.0, noise={"measured_ay": 0.5})
    drive = drive_with_gaps(1.35)
    for name, samples, size in (("ay", slice(75, 76), 1e6), ("yaw_rate", slice(80, 135), 3.0)):  # longer than it is patient
        spoilt = drive[name].copy()
        spoilt[samples] += size
        drive = replace(drive, channels={**drive.channels, name: spoilt})
    model, measurements, first = same_as_filter(estimator, drive)
    filtered = kalman_filter(model, measurements, first, Gate.of(4.0, 100.0))
    assert not filtered.measured[75, 0]
    assert not filtered.measured[80:130, 1].any(), "shut for half a second"
    assert filtered.measured[130, 1], "and open then"
    found = estimator.estimate([drive])[0]
    assert np.abs(found["vy"] - drive["vx"] * np.tan(filtered.filtered.mean[:, 0].numpy())).max() < 1e-6
    assert np.abs(found["yaw_rate"] - filtered.filtered.mean[:, 1].numpy()).max() < 1e-7


def test_a_gate_without_a_window_is_refused():
    with pytest.raises(ConfigurationError, match=r"estimator\.gate needs estimator\.window"):
        factor_graph(gate=5.0)
