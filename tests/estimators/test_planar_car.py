"""Compiled planar cars are the readable ones, in values and in the gradients of everything that is
learnt.
"""

import numpy as np
import pytest
import torch

from point_models import called
from vehest.estimators.kernels.planar_car import CompiledPlanarCar, is_compilable
from vehest.filters.gaussian import Gaussian
from vehest.filters.sigma_points import symmetric_rule
from vehest.filters.unscented_scan import TorchModel, moved, unscented_scan
from vehest.vehicle.dynamics import NeuralCar, PacejkaCar, ResidualCar, TyreNetworkCar

STEP = 0.01
LOWER = [-1e9, -1e9, -1e9, -1e9, 0.05]
SIZES = [3.0, 0.3, 1.0, 3.0, 0.6, 0.2, 0.3, 0.3, 0.3, 2.0]
CARS = {
    "NNTF": lambda: scaled(TyreNetworkCar(hidden=(12, 7))),
    "NNTF in SI units": lambda: TyreNetworkCar(hidden=(12, 7)),
    "NNT": lambda: scaled(TyreNetworkCar(friction_scaled=False, hidden=(12, 7))),
    "PC": PacejkaCar,
    "PCR": lambda: ResidualCar(hidden=(12, 7)),
    "NN": lambda: NeuralCar(hidden=(12, 7)),
}


def scaled(car):
    car.network.input_scale.copy_(torch.tensor(SIZES)[: len(car.network.input_scale)])
    car.network.output_scale.fill_(25.0)
    return car


def a_car(kind="NNTF", dtype=torch.float64):
    car = CARS[kind]()
    car.reset(torch.Generator().manual_seed(0))
    return car.to(dtype)


def readable(car):
    return TorchModel(
        lambda x, u: car.transition(x, u, STEP), car.observation, list(car.parameters()), LOWER
    )


def drawn(*shape, seed=1):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def driven(count):
    """States from slow to fast and sliding, and inputs."""
    states = torch.tensor([2.5, 0.0, 0.0, 2.5, 0.6], dtype=torch.float64) + drawn(
        count, 5
    ) * torch.tensor([0.6, 0.5, 1.5, 0.8, 0.1])
    return states, drawn(count, 2, seed=2) * torch.tensor([0.25, 6.0])


def through_the_filter(car, compiled, dtype):
    """Means of 25 sequences, more than a block of points holds, and the gradients of a random sum
    of them.
    """
    sequences = 25
    steps = 12
    _, inputs = driven(sequences * steps)
    measurements = drawn(sequences, steps, 4) + torch.tensor([0.0, 0.0, 1.0, 3.0])
    measurements[1, 4, 0] = torch.nan
    initial = Gaussian(
        torch.tensor([3.0, 0.2, 1.0, 3.0, 0.6]), torch.tensor([1e-3, 1e-3, 1e-3, 1e-3, 1e-4]).diag()
    )
    noises = [
        torch.tensor(noise).to(dtype).diag()
        for noise in ([1e-3, 1e-3, 1e-2, 1e-2, 1e-4], [50.0, 50.0, 0.1, 0.1])
    ]
    model = CompiledPlanarCar(car, STEP, LOWER, dtype) if compiled else readable(car)
    y = measurements.to(dtype)
    u = inputs.reshape(sequences, steps, 2).to(dtype)
    outcome = unscented_scan(
        model,
        y,
        u,
        Gaussian(*(part.to(dtype) for part in initial)),
        *noises,
        symmetric_rule(5, -2.0),
    )
    car.zero_grad()
    (outcome.steps.filtered.mean * drawn(sequences, steps, 5, seed=3).to(dtype)).sum().backward()
    gradients = {
        name: torch.zeros_like(p) if p.grad is None else p.grad.clone()
        for name, p in car.named_parameters()
    }
    return outcome.steps.filtered.mean.detach(), gradients


@pytest.mark.parametrize("kind", CARS)
def test_compiled_filter_has_values_and_gradients_of_the_readable_filter(kind):
    car = a_car(kind)
    (readable_mean, gradients), (mean, compiled_gradients) = (
        through_the_filter(car, compiled, torch.float64) for compiled in (False, True)
    )
    assert torch.allclose(mean, readable_mean, rtol=0, atol=1e-10)
    assert gradients.keys() == compiled_gradients.keys()
    for name, gradient in gradients.items():
        assert torch.allclose(
            compiled_gradients[name],
            gradient,
            rtol=0,
            atol=1e-8 * float(gradient.abs().max()) + 1e-14,
        ), name
        assert float(gradient.abs().max()) > 0, name


@pytest.mark.apart  # compiles the filter and its adjoint for a minute
def test_in_single_precision_values_agree_and_gradients_survive_a_crawl():
    car = a_car(dtype=torch.float32)
    mean, single_gradients = through_the_filter(car, True, torch.float32)
    double_mean, gradients = through_the_filter(car.double(), False, torch.float64)
    assert mean.double() == pytest.approx(double_mean, abs=1e-4)
    for name, gradient in gradients.items():
        assert (
            float((single_gradients[name].double() - gradient).norm() / gradient.norm()) < 1e-3
        ), name
    # At 5 cm/s and sliding: squashed values have reached their ends, and what rounding leaves of
    # their slopes must not count.
    car = a_car("NNTF in SI units")
    states = torch.tensor([0.05, 1.5, -2.5, 3.0, 0.4], dtype=torch.float64) + drawn(
        200, 5
    ) * torch.tensor([0.004, 1.0, 0.5, 0.3, 0.05])
    inputs = drawn(200, 2, seed=2) * torch.tensor([0.25, 6.0])
    slopes = []
    for dtype in (torch.float64, torch.float32):
        model = CompiledPlanarCar(car.to(dtype), STEP, LOWER, dtype)
        points, single_gradients = (
            part.to(dtype).reshape(20, 10, -1).contiguous().numpy() for part in (states, inputs)
        )
        gradients = [np.zeros(parameter.shape, points.dtype) for parameter in model.parameters]
        slopes.append(
            called(
                model,
                3,
                points,
                np.ascontiguousarray(single_gradients[:, 0]),
                5,
                np.ones((20, 10, 4), points.dtype),
                gradients,
            )
        )
    assert np.abs(slopes[1] - slopes[0]).max() < 1e-3 * np.abs(slopes[0]).max()


def test_cars_with_nothing_to_learn_have_no_gradients_and_other_cars_no_code():
    car = a_car()
    states, inputs = driven(5)
    learning = moved(CompiledPlanarCar(car, STEP, LOWER, torch.float64), states, inputs)
    frozen = CompiledPlanarCar(car.requires_grad_(False), STEP, LOWER, torch.float64)
    assert learning.requires_grad
    assert not list(frozen.parameters)
    assert torch.equal(moved(frozen, states, inputs), learning.detach())
    for car in (
        TyreNetworkCar(hidden=(4, 4, 4)),
        NeuralCar(hidden=(4,)),
        PacejkaCar(with_curvature=True),
    ):
        assert not is_compilable(car)
