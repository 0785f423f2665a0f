"""The compiled car whose tyres are a network is the readable one, in values and in the gradients of everything that is learnt."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from vehest.estimators.kernels.tyre_network import CompiledTyreNetwork
from vehest.filters.gaussian import Gaussian
from vehest.filters.sigma_points import symmetric_rule
from vehest.filters.unscented_scan import TorchModel, moved, unscented_scan
from vehest.vehicle.dynamics import TyreNetworkCar

STEP = 0.01
LOWER = [-1e9, -1e9, -1e9, -1e9, 0.05]
SIZES = [3.0, 0.3, 1.0, 3.0, 0.6, 0.2, 0.3, 0.3, 0.3, 2.0]
KINDS = pytest.mark.parametrize(
    ("friction_scaled", "scaled"), [(True, True), (True, False), (False, True)], ids=["NNTF", "NNTF in SI units", "NNT"]
)


def network_car(friction_scaled: bool, scaled: bool, dtype: torch.dtype) -> TyreNetworkCar:
    sizes = SIZES[: 9 if friction_scaled else 10] if scaled else None
    car = TyreNetworkCar(friction_scaled=friction_scaled, hidden=(12, 7), input_scale=sizes, force_scale=25.0 if scaled else 1.0)
    car.reset(torch.Generator().manual_seed(0))
    return car.to(dtype)


def readable(car: TyreNetworkCar) -> TorchModel:
    return TorchModel(lambda x, u: car.transition(x, u, STEP), car.observation, list(car.parameters()), LOWER)


def drawn(*shape: int, seed: int = 1) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def driven(count: int) -> tuple[Tensor, Tensor]:
    """States from slow to fast and sliding, and inputs."""
    states = torch.tensor([2.5, 0.0, 0.0, 2.5, 0.6], dtype=torch.float64) + drawn(count, 5) * torch.tensor([0.6, 0.5, 1.5, 0.8, 0.1])
    return states, drawn(count, 2, seed=2) * torch.tensor([0.25, 6.0])


def through_the_filter(car: TyreNetworkCar, compiled: bool, dtype: torch.dtype) -> tuple[Tensor, dict[str, Tensor]]:
    """Means of 25 sequences, more than a block of points holds, and the gradients of a random sum of them."""
    sequences, steps = 25, 12
    _, inputs = driven(sequences * steps)
    measurements = drawn(sequences, steps, 4) + torch.tensor([0.0, 0.0, 1.0, 3.0])
    measurements[1, 4, 0] = torch.nan
    initial = Gaussian(torch.tensor([3.0, 0.2, 1.0, 3.0, 0.6]), torch.tensor([1e-3, 1e-3, 1e-3, 1e-3, 1e-4]).diag())
    noises = [torch.tensor(noise).to(dtype).diag() for noise in ([1e-3, 1e-3, 1e-2, 1e-2, 1e-4], [50.0, 50.0, 0.1, 0.1])]
    model = CompiledTyreNetwork(car, STEP, LOWER, dtype) if compiled else readable(car)
    y, u = measurements.to(dtype), inputs.reshape(sequences, steps, 2).to(dtype)
    outcome = unscented_scan(model, y, u, Gaussian(*(part.to(dtype) for part in initial)), *noises, symmetric_rule(5, -2.0))
    car.zero_grad()
    (outcome.steps.filtered.mean * drawn(sequences, steps, 5, seed=3).to(dtype)).sum().backward()
    gradients = {name: torch.zeros_like(p) if p.grad is None else p.grad.clone() for name, p in car.named_parameters()}
    return outcome.steps.filtered.mean.detach(), gradients


@KINDS
def test_compiled_points_move_and_are_observed_as_the_readable_ones(friction_scaled: bool, scaled: bool) -> None:
    car = network_car(friction_scaled, scaled, torch.float64)
    points, inputs = driven(7 * 11)
    points, inputs = points.reshape(7, 11, 5).numpy(), inputs[:7].contiguous().numpy()
    compiled, known = CompiledTyreNetwork(car, STEP, LOWER, torch.float64), readable(car)
    assert compiled.transition(points, inputs) == pytest.approx(known.transition(points, inputs), rel=1e-11, abs=1e-12)
    assert compiled.observation(points, inputs) == pytest.approx(known.observation(points, inputs), rel=1e-11, abs=1e-12)


@KINDS
def test_compiled_filter_has_the_values_and_all_gradients_of_the_readable_one(friction_scaled: bool, scaled: bool) -> None:
    car = network_car(friction_scaled, scaled, torch.float64)
    (known, gradients), (mean, own) = (through_the_filter(car, compiled, torch.float64) for compiled in (False, True))
    assert torch.allclose(mean, known, rtol=0, atol=1e-10)
    assert gradients.keys() == own.keys()
    for name, gradient in gradients.items():
        assert torch.allclose(own[name], gradient, rtol=0, atol=1e-8 * float(gradient.abs().max()) + 1e-14), name
        assert float(gradient.abs().max()) > 0, name


def test_in_single_precision_it_agrees_to_a_ten_thousandth() -> None:
    car = network_car(True, True, torch.float32)
    mean, own = through_the_filter(car, True, torch.float32)
    known, gradients = through_the_filter(car.double(), False, torch.float64)
    assert mean.double() == pytest.approx(known, abs=1e-4)
    for name, gradient in gradients.items():
        assert float((own[name].double() - gradient).norm() / gradient.norm()) < 1e-3, name


def test_gradients_are_those_of_finite_differences_along_a_direction() -> None:
    """Of a step of the car alone, in all parameters at once."""
    car = network_car(True, True, torch.float64)
    states, inputs = driven(30)
    ways = [0.1 * drawn(*p.shape, seed=k) for k, p in enumerate(car.parameters())]

    def value(shift: float) -> Tensor:
        with torch.no_grad():
            for parameter, way in zip(car.parameters(), ways, strict=True):
                parameter += shift * way
        total = moved(CompiledTyreNetwork(car, STEP, LOWER, torch.float64), states, inputs).square().sum()
        with torch.no_grad():
            for parameter, way in zip(car.parameters(), ways, strict=True):
                parameter -= shift * way
        return total

    value(0.0).backward()
    slope = sum(float((p.grad * way).sum()) for p, way in zip(car.parameters(), ways, strict=True) if p.grad is not None)
    assert slope == pytest.approx(float((value(1e-5) - value(-1e-5)).detach()) / 2e-5, rel=1e-6)


def test_a_car_with_nothing_to_learn_has_no_gradients_and_the_same_values() -> None:
    car = network_car(True, True, torch.float64)
    states, inputs = driven(5)
    learning = moved(CompiledTyreNetwork(car, STEP, LOWER, torch.float64), states, inputs)
    frozen = CompiledTyreNetwork(car.requires_grad_(False), STEP, LOWER, torch.float64)
    assert learning.requires_grad
    assert not list(frozen.parameters)
    assert torch.equal(moved(frozen, states, inputs), learning.detach())


def test_other_depths_are_refused() -> None:
    car = TyreNetworkCar(hidden=(4, 4, 4))
    assert not car.is_compilable
    with pytest.raises(ValueError, match="two hidden layers, not 3"):
        CompiledTyreNetwork(car, STEP, None, torch.float32)
