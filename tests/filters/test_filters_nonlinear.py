"""Unscented and extended Kalman filters against the linear one, an independent library, closed
forms and finite differences.
"""

import filterpy.kalman as filterpy
import numpy as np
import pytest
import torch
from readable_filters import (
    NonlinearModel,
    extended_filter,
    log_likelihood,
    scaled_rule,
    unscented_filter,
)
from test_filters_kalman import arrays, example, tensors

from vehest.filters.gaussian import Gaussian
from vehest.filters.kalman_scan import kalman_scan
from vehest.filters.sigma_points import symmetric_rule

RULES = {
    "symmetric": symmetric_rule(3, 0.5),
    "scaled": scaled_rule(3, 0.5, 2.0, 1.0),
    "cubature": symmetric_rule(3, 0.0),
}
STEP = 0.1


def constant(matrix):
    return lambda state, u: matrix.expand(*state.shape[:-1], *matrix.shape)


def linear_as_nonlinear(model):
    """A linear model that varies in time, with the sample's number as the input."""

    def at(part, u):
        return part[u[..., :1].long()].select(u.dim() - 1, 0)

    return NonlinearModel(
        lambda x, u: (
            (at(model.transition, u) @ x.unsqueeze(-1)).squeeze(-1) + at(model.transition_offset, u)
        ),
        lambda x, u: (
            (at(model.observation, u) @ x.unsqueeze(-1)).squeeze(-1)
            + at(model.observation_offset, u)
        ),
        lambda x, u: at(model.process_noise, u),
        lambda x, u: torch.diag_embed(at(model.observation_noise, u)),
    )


def pendulum_with_radar(gravity=9.81):
    """Angle, rate and an unknown damping; measured are the bob's height and its rate.

    Inputs push.
    """

    def transition(x, u):
        angle, rate, damping = x.unbind(-1)
        return torch.stack(
            [
                angle + STEP * rate,
                rate + STEP * (u[..., 0] - gravity * torch.sin(angle) - damping * rate),
                damping,
            ],
            -1,
        )

    def observation(x, u):
        return torch.stack([1.0 - torch.cos(x[..., 0]), torch.sin(x[..., 0]) * x[..., 1]], -1)

    process = torch.diag(torch.tensor([1e-4, 1e-3, 1e-5], dtype=torch.float64))
    process[0, 1] = process[1, 0] = 1e-4
    noise = torch.tensor([[0.02, 0.005], [0.005, 0.05]], dtype=torch.float64)
    return NonlinearModel(transition, observation, constant(process), constant(noise))


def measured_pendulum(steps=40, sequences=1):
    generator = torch.Generator().manual_seed(1)
    model = pendulum_with_radar()
    x = torch.tensor([0.6, 0.0, 0.3], dtype=torch.float64).expand(sequences, 3)
    inputs = torch.randn(sequences, steps, 1, generator=generator, dtype=torch.float64)
    ys = []
    for k in range(steps):
        ys.append(
            model.observation(x, inputs[:, k])
            + 0.15 * torch.randn(sequences, 2, generator=generator, dtype=torch.float64)
        )
        x = model.transition(x, inputs[:, k])
    first = Gaussian(
        torch.tensor([0.4, 0.1, 0.2], dtype=torch.float64),
        torch.diag(torch.tensor([0.1, 0.2, 0.05], dtype=torch.float64)),
    )
    return torch.stack(ys, 1), inputs, first


@pytest.mark.parametrize("name", [*RULES, "extended"])
@pytest.mark.parametrize("missing", [0.0, 0.4])
def test_on_a_linear_model_every_filter_is_the_kalman_filter(name, missing):
    model, measurements, initial = example(30, missing=missing)
    kalman = kalman_scan(model, measurements, initial)
    y = torch.from_numpy(measurements)
    inputs = torch.arange(30, dtype=torch.float64).unsqueeze(-1)
    nonlinear = linear_as_nonlinear(tensors(model))
    first = tensors(initial)
    ours = (
        extended_filter(nonlinear, y, inputs, first)
        if name == "extended"
        else unrepaired(nonlinear, y, inputs, first, RULES[name])
    )
    for part in ("predicted", "filtered"):
        for values, theirs in zip(arrays(getattr(ours, part)), getattr(kalman, part), strict=True):
            assert np.allclose(values, theirs, rtol=1e-9, atol=1e-9)
    for part in ("innovation", "innovation_covariance"):
        assert np.allclose(getattr(ours, part), getattr(kalman, part), atol=1e-9)


def unrepaired(*arguments):
    filtered = unscented_filter(*arguments)
    assert not filtered.repaired.any()
    return filtered.steps


@pytest.mark.parametrize(
    ("rule", "points"),
    [
        (symmetric_rule(3, 0.5), lambda: filterpy.JulierSigmaPoints(3, 0.5)),
        (symmetric_rule(3, 0.0), lambda: filterpy.JulierSigmaPoints(3, 0.0)),
        (scaled_rule(3, 0.3, 2.0, 0.0), lambda: filterpy.MerweScaledSigmaPoints(3, 0.3, 2.0, 0.0)),
    ],
    ids=["symmetric", "cubature", "scaled"],
)
def test_unscented_filter_is_that_of_an_independent_library(rule, points):
    """Theirs updates with the propagated points.

    Drawn again after each prediction, its equations are ours.
    """
    model = pendulum_with_radar()
    measurements, inputs, initial = measured_pendulum()
    ours = unscented_filter(model, measurements[0], inputs[0], initial, rule).steps

    def as_numpy(function):
        return lambda x, *arguments, u: function(
            torch.from_numpy(np.asarray(x)), torch.from_numpy(u)
        ).numpy()

    drawn = points()
    theirs = filterpy.UnscentedKalmanFilter(
        3, 2, STEP, as_numpy(model.observation), as_numpy(model.transition), drawn
    )
    theirs.x = initial.mean.numpy().copy()
    theirs.P = initial.covariance.numpy().copy()
    none = torch.zeros(3, dtype=torch.float64)
    theirs.Q = model.process_noise(none, none).numpy()
    theirs.R = model.observation_noise(none, none).numpy()
    for k, y in enumerate(measurements[0].numpy()):
        if k > 0:
            theirs.predict(u=inputs[0, k - 1].numpy())
        assert ours.predicted.mean[k].numpy() == pytest.approx(theirs.x, abs=1e-8)
        theirs.sigmas_f = drawn.sigma_points(theirs.x, theirs.P)
        theirs.update(y, u=inputs[0, k].numpy())
        assert ours.filtered.mean[k].numpy() == pytest.approx(theirs.x, abs=1e-8)
        assert ours.filtered.covariance[k].numpy() == pytest.approx(theirs.P, abs=1e-8)
        assert float(log_likelihood(ours)[k]) == pytest.approx(theirs.log_likelihood, abs=1e-6)
