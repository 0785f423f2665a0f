"""Gates: outliers are refused as if they had not been measured, readable as compiled.

What contradicts for long is believed again.
"""

import math
from functools import partial

import numpy as np
import pytest
import torch
from readable_filters import gated, unscented_filter
from scipy.stats import chi2, norm
from test_filters_kalman import example
from test_filters_nonlinear import RULES, measured_pendulum, pendulum_with_radar

from vehest.filters.gating import Gate
from vehest.filters.gaussian import Gaussian
from vehest.filters.kalman import LinearModel
from vehest.filters.kalman_scan import kalman_scan
from vehest.filters.unscented_scan import TorchModel, unscented_scan

PATIENCE = 5
NOTHING = torch.zeros(3, dtype=torch.float64)


def walk(steps):
    """A position that wanders by 0.1 a sample, measured to 1 by two sensors."""
    model = LinearModel(
        np.eye(1), np.zeros(1), 0.01 * np.eye(1), np.ones((2, 1)), np.zeros(2), np.ones(2)
    )
    return LinearModel(*(np.broadcast_to(part, (steps, *part.shape)) for part in model)), Gaussian(
        np.zeros(1), np.eye(1)
    )


def noises_of(model):
    return [noise(NOTHING, NOTHING) for noise in (model.process_noise, model.observation_noise)]


def pendulum(y, u, first, gate, noises=None):
    model = pendulum_with_radar()
    return unscented_scan(
        TorchModel(model.transition, model.observation),
        y,
        u,
        first,
        *(noises or noises_of(model)),
        RULES["symmetric"],
        gate=gate,
    )


def by_the_filter(u, first, y):
    return unscented_filter(pendulum_with_radar(), y, u, first, RULES["symmetric"]).steps


def test_gates_have_the_limit_of_the_chi_square_distribution_and_patience_in_samples():
    limit = Gate(3.0, PATIENCE).deviations ** 2
    assert chi2.sf(limit, 1) == pytest.approx(2.0 * norm.sf(3.0))
    assert Gate.of(None, 100.0) is None
    assert Gate.of(5.0, 100.0) == Gate(5.0, 50)


def test_a_consistent_filter_refuses_as_often_as_the_normal_distribution_says():
    steps = 50_000
    generator = np.random.default_rng(0)
    model, first = walk(steps)
    truth = np.cumsum(0.1 * generator.standard_normal(steps))
    y = truth[:, None] + generator.standard_normal((steps, 2))
    is_accepted = kalman_scan(model, y, first, Gate(2.0, 10**9)).measured
    share = 2.0 * norm.sf(2.0)
    assert 1.0 - is_accepted.mean() == pytest.approx(
        share, abs=5.0 * math.sqrt(share / (2 * steps)) + 0.002
    )


def test_an_outlier_is_as_good_as_missing_and_takes_no_other_sensor_with_it():
    model, first = walk(40)
    y = np.random.default_rng(1).standard_normal((40, 2))
    missing = y.copy()
    missing[20, 0] = np.nan
    for size in (60.0, -1e6, np.inf):
        y[20, 0] = size
        gated = kalman_scan(model, y, first, Gate(5.0, PATIENCE))
        without_outlier = kalman_scan(model, missing, first)
        assert np.argwhere(~gated.measured).tolist() == [[20, 0]]
        for name in ("filtered", "predicted"):
            for a, b in zip(getattr(gated, name), getattr(without_outlier, name), strict=True):
                assert np.array_equal(a, b)
        assert np.array_equal(gated.innovation_covariance, without_outlier.innovation_covariance)


def test_after_a_jump_of_the_truth_the_gate_opens_and_the_filter_comes_back():
    model, first = walk(100)
    y = np.random.default_rng(2).standard_normal((100, 2))
    y[50:] += 1000.0
    gated = kalman_scan(model, y, first, Gate(5.0, PATIENCE))
    assert not gated.measured[50 : 50 + PATIENCE].any()
    assert gated.measured[50 + PATIENCE :].all()
    free = kalman_scan(model, y, first)
    assert abs(gated.filtered.mean[49 + PATIENCE, 0]) < 5.0, "shut, it stays where it was"
    assert gated.filtered.mean[-1] == pytest.approx(free.filtered.mean[-1], abs=1.0), (
        "open, it goes where the free one goes"
    )


def test_a_gate_that_refuses_nothing_changes_no_bit():
    model, measurements, first = example(60, seed=3, missing=0.2)
    plain = kalman_scan(model, measurements, first)
    wide = kalman_scan(model, measurements, first, Gate(1e9, PATIENCE))
    assert np.array_equal(plain.filtered.mean, wide.filtered.mean)
    assert np.array_equal(plain.filtered.covariance, wide.filtered.covariance)
    y, u, start = measured_pendulum(60, 3)
    without, within = (
        pendulum(y, u, start, gate).steps.filtered for gate in (None, Gate(1e9, PATIENCE))
    )
    assert torch.equal(without.mean, within.mean)
    assert torch.equal(without.covariance, within.covariance)


def outliers(sequences):
    y, u, first = measured_pendulum(30, sequences)
    y[0, 5, 0] = 40.0
    y[0, 9, 1] = -40.0
    y[-1, 12] = 1e3
    y[0, 15:, 1] += 30.0  # longer than the gate is patient
    y[-1, 20, 0] = torch.nan
    return y, u, first


def test_scan_and_readable_filter_refuse_the_same_samples():
    y, u, first = outliers(3)
    gate = Gate(4.0, PATIENCE)
    scanned = pendulum(y, u, first, gate).steps
    for row in range(3):
        judged = gated(partial(by_the_filter, u[row], first), y[row], gate)
        assert torch.equal(judged.measured, scanned.measured[row])
    readable = by_the_filter(u, first, torch.where(scanned.measured, y, torch.nan))
    assert not scanned.measured[0, 15 : 15 + PATIENCE, 1].any(), "shut"
    assert scanned.measured[0, 15 + PATIENCE, 1], "open again"
    for a, b in zip(readable.filtered, scanned.filtered, strict=True):
        assert torch.allclose(a, b, rtol=0, atol=1e-12 * float(a.abs().max()))
    assert torch.allclose(
        readable.innovation_covariance, scanned.innovation_covariance, rtol=1e-10, atol=1e-10
    )


def test_gradients_through_a_gate_are_those_of_missing_measurements():
    y, u, first = outliers(2)
    weights = torch.randn(2, 30, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    is_accepted = pendulum(y, u, first, Gate(4.0, PATIENCE)).steps.measured
    assert not is_accepted.all()
    gradients = []
    for measurements, gate in (
        (y, Gate(4.0, PATIENCE)),
        (torch.where(is_accepted, y, torch.nan), None),
    ):
        leaves = [part.clone().requires_grad_() for part in (measurements, *first)]
        noises = [noise.clone().requires_grad_() for noise in noises_of(pendulum_with_radar())]
        scanned = pendulum(leaves[0], u, Gaussian(*leaves[1:]), gate, noises)
        gradients.append(
            torch.autograd.grad((scanned.steps.filtered.mean * weights).sum(), (*leaves, *noises))
        )
    for a, b in zip(*gradients, strict=True):
        assert torch.isfinite(a).all()
        assert torch.equal(a, b)
    assert (gradients[0][0][~is_accepted] == 0.0).all(), "what is refused teaches nothing"
