"""The factor graph against sparse least squares over its factors, and against a filter with the
same noise.
"""

import numpy as np
import pytest
from refusals import refusal
from scipy import sparse
from scipy.sparse.linalg import spsolve

from single_track_drive import linear_drive, with_gaps
from vehest.data.errors import ConfigurationError
from vehest.estimators.base import FitData
from vehest.estimators.factor_graph import MEASURED
from vehest.estimators.registry import estimator_class
from vehest.filters.gating import Gate
from vehest.filters.gaussian import Gaussian
from vehest.filters.kalman_scan import kalman_scan
from vehest.training.context import NoTraining


def factor_graph(**config):
    return estimator_class("factor_graph").from_config(config)


def drive_with_gaps(seconds):
    return with_gaps(
        linear_drive(seconds, seed=1)[0].without_references(),
        {"ay": slice(40, 60), "yaw_rate": slice(50, 70)},
    )


def least_squares(estimator, drive, first, last, start, deviation):
    """States first … last by sparse least squares over the equations that factors stand for, (last
    - first + 1, 2).
    """
    noise = estimator.settings.noise
    A, B, C, D = estimator.sampled_model(drive["vx"])
    entries = []
    right = []

    def equation(coefficients, value, sigma):
        """Coefficients of state i of sample k."""
        entries.extend(
            (len(right), 2 * (k - first) + i, weight / sigma)
            for (k, i), weight in coefficients.items()
        )
        right.append(value / sigma)

    for i in (0, 1):
        equation({(first, i): 1.0}, start[i], deviation)
    for k in range(first, last + 1):
        if np.isfinite(drive["yaw_rate"][k]):
            equation({(k, 1): 1.0}, drive["yaw_rate"][k], noise.measured_yaw_rate)
        if np.isfinite(drive["ay"][k]):
            equation(
                {(k, 0): C[k, 0], (k, 1): C[k, 1]},
                drive["ay"][k] - D[k] * drive["steer"][k],
                noise.measured_ay,
            )
        if k < last:
            for i, sigma in enumerate((noise.model_sideslip, noise.model_yaw_rate)):
                offset = B[k, i] * drive["steer"][k]
                equation({(k, 0): -A[k, i, 0], (k, 1): -A[k, i, 1], (k + 1, i): 1.0}, offset, sigma)
    rows, columns, values = zip(*entries, strict=True)
    jacobian = sparse.csc_array((values, (rows, columns)))
    return spsolve(jacobian.T @ jacobian, jacobian.T @ np.array(right)).reshape(-1, 2)


def filtered(estimator, drive, gate=None):
    samples = drive.stack(estimator.channels)
    return kalman_scan(
        estimator.linear_model(samples),
        samples[:, MEASURED],
        Gaussian(np.zeros(2), 100.0**2 * np.eye(2)),
        gate,
    )


def states_of(estimate):
    return np.stack([estimate["sideslip"], estimate["yaw_rate"]], axis=1)


def test_factor_graph_equals_least_squares_and_the_filter_over_a_long_window():
    estimator = factor_graph()
    drive = drive_with_gaps(12.0)
    expected = least_squares(estimator, drive, 0, len(drive) - 1, np.zeros(2), 100.0)
    estimate = estimator.estimate([drive])[0]
    assert np.abs(states_of(estimate) - expected).max() < 1e-9
    assert estimate.mode == "offline"
    estimator = factor_graph(window=5.0)
    drive = drive_with_gaps(1.0)
    estimate = estimator.estimate([drive])[0]
    assert np.abs(states_of(estimate) - filtered(estimator, drive).filtered.mean).max() < 1e-9
    assert estimate.mode == "causal"
    # Its first state hangs on what the window before made of that state.
    estimator = factor_graph(window=0.05)
    drive = drive_with_gaps(0.8)
    expected = np.zeros((len(drive), 2))
    second = np.zeros(2)
    for k in range(len(drive)):
        first = max(k - 5, 0)
        start, deviation = (second, 1.0) if first > 0 else (np.zeros(2), 100.0)
        states = least_squares(estimator, drive, first, k, start, deviation)
        expected[k] = states[-1]
        second = states[min(1, len(states) - 1)]
    assert np.abs(states_of(estimator.estimate([drive])[0]) - expected).max() < 1e-9


def test_a_state_handed_over_is_believed():
    drive = linear_drive(1.0)[0]
    for window in (None, 0.05):
        estimate = factor_graph(window=window).estimate([drive], {"vy": 2.0, "yaw_rate": -0.3})[0]
        assert estimate["vy"][0] == pytest.approx(2.0, abs=1e-3)
        assert estimate["yaw_rate"][0] == pytest.approx(-0.3, abs=1e-6)


def test_variants_say_how_they_are_solved_and_learn_nothing():
    estimator = factor_graph()
    record = estimator.fit(FitData([], []), NoTraining())
    assert record.metrics["epochs"] == 0
    assert (estimator.learns, estimator.n_parameters, estimator.weights()) == (False, 0, {})
    assert "'gain' is missing, unknown or of another shape" in refusal(
        lambda: estimator.load_weights({"gain": np.ones(1)})
    )
    assert (factor_graph().variant, factor_graph().causal) == ("factor_graph_batch", False)
    assert (factor_graph(window=0.05).variant, factor_graph(window=0.05).causal) == (
        "factor_graph_lag_0.05s",
        True,
    )
    assert "cannot run along with a drive; set estimator.window" in refusal(
        lambda: factor_graph().online(), ConfigurationError
    )


def test_with_a_long_window_its_gate_is_that_of_the_kalman_filter():
    estimator = factor_graph(window=3.0, gate=4.0, noise={"measured_ay": 0.5})
    drive = drive_with_gaps(1.35)
    for name, samples, size in (
        ("ay", slice(75, 76), 1e6),
        ("yaw_rate", slice(80, 135), 3.0),
    ):  # longer than it is patient
        spoilt = drive[name].copy()
        spoilt[samples] += size
        drive = drive.with_channels({name: spoilt})
    expected = filtered(estimator, drive, Gate.of(4.0, 100.0))
    assert not expected.measured[75, 1]
    assert not expected.measured[80:130, 0].any(), "shut for half a second"
    assert expected.measured[130, 0], "and open then"
    assert np.abs(states_of(estimator.estimate([drive])[0]) - expected.filtered.mean).max() < 1e-9
