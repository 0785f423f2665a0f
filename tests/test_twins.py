"""Every filter and network that has a readable and a compiled form gives the same in both, through missing measurements, limits and gates.

Each pair is tried on one stretch with gaps of one sensor, of all sensors, and of all for long. Gradients are compared where each form is
tested by itself (`test_planar_car`, `test_dugoff`, `test_filters_unscented_scan`, `test_kernels`).
"""

import pytest
import torch
from readable_filters import NonlinearModel, extended_filter, gated, rational_model, unscented_filter
from test_estimators_rational import rational
from test_filters_extended_scan import compiled_pendulum
from test_filters_kalman import example, tensors
from test_filters_nonlinear import linear_as_nonlinear, measured_pendulum, pendulum_with_radar
from test_kernels import STRUCTURES, _problem
from test_planar_car import CARS, LOWER, a_car, driven
from test_planar_car import STEP as CAR_STEP
from torch import Tensor

from dugoff_drive import dugoff_track
from rational_drive import rational_drive
from vehest.estimators.kernels.dugoff_track import CompiledDugoffTrack
from vehest.estimators.kernels.planar_car import CompiledPlanarCar
from vehest.estimators.rational_ekf import KINDS
from vehest.filters.extended_scan import extended_scan
from vehest.filters.gating import Gate
from vehest.filters.gaussian import Gaussian
from vehest.filters.kalman_scan import kalman_scan
from vehest.filters.sigma_points import symmetric_rule
from vehest.filters.unscented_scan import unscented_scan

STEPS = 60
GATE = Gate(4.0, 5)
Forms = tuple[list[Tensor], list[Tensor]]
"""What the readable form gives, and what the compiled one does."""


def with_gaps(measurements):
    y = measurements.clone()
    y[..., 5:9, 0] = torch.nan
    y[..., 12:15, :] = torch.nan
    y[..., 20:40, :] = torch.nan
    return y


def with_outliers(measurements, size=1000.0):
    """Gaps, one outlier, and at the end more of them than a gate is patient."""
    y = with_gaps(measurements)
    y[..., 10, 1] += size
    y[..., 45:, 0] -= size
    return y


def of_the_same_numbers(values):
    return [torch.as_tensor(value) for value in values]


def behind(gate, run, y):
    return run(y) if gate is None else gated(run, y, gate)


def kalman(gate=None):
    def forms():
        model, measurements, initial = example(STEPS, seed=1)
        y = (with_gaps if gate is None else with_outliers)(torch.from_numpy(measurements))
        readable, number = linear_as_nonlinear(tensors(model)), torch.arange(STEPS, dtype=torch.float64).unsqueeze(-1)
        theirs = behind(gate, lambda y: extended_filter(readable, y, number, tensors(initial)), y)
        return list(theirs.filtered), of_the_same_numbers(kalman_scan(model, y.numpy(), initial, gate).filtered)

    return forms


def extended():
    measurements, inputs, initial = measured_pendulum(STEPS)
    y = with_gaps(measurements[0])
    readable = extended_filter(pendulum_with_radar(), y, inputs[0], initial)
    compiled = extended_scan(compiled_pendulum(), y.numpy(), inputs[0].numpy(), Gaussian(*(part.numpy() for part in initial)))
    return list(readable.filtered), of_the_same_numbers(compiled.filtered)


def rational_with(gate=None, **config):
    def forms():
        estimator = rational(**config)
        spoilt = with_gaps if gate is None else with_outliers
        samples = rational_drive(STEPS / 20.0, seed=1).stack(estimator.channels)
        samples[:, [0, 2]] = spoilt(torch.as_tensor(samples[:, [0, 2]])).numpy()
        first = Gaussian(*map(torch.as_tensor, estimator.first_gaussian(samples[0], {})))
        y, u = torch.as_tensor(samples[:, [0, 2]]), torch.as_tensor(samples[:, [1, 3]])
        readable = behind(gate, lambda y: extended_filter(rational_model(estimator), y, u, first), y).filtered
        compiled = estimator.filter_samples(samples, gate=gate)
        variances = readable.covariance.diagonal(dim1=-2, dim2=-1)
        return [readable.mean, variances.clamp(min=0.0).sqrt()], of_the_same_numbers([compiled.mean, compiled.deviation])

    return forms


def unscented(readable, compiled, y, u, first, noises, gate=None):
    n = first.mean.shape[-1]
    rule = symmetric_rule(n, 3.0 - n)
    with torch.no_grad():
        theirs = behind(gate, lambda y: unscented_filter(readable, y, u[0], first, rule).steps, y[0]).filtered
        ours = unscented_scan(compiled, y, u, first, *noises, rule, gate=gate).steps.filtered
    return list(theirs), list(ours)


def constant(matrix):
    return lambda states, inputs: matrix.expand(*states.shape[:-1], *matrix.shape)


def diagonal(*deviations):
    return torch.tensor(deviations, dtype=torch.float64).square().diag()


def planar(kind, gate=None):
    def forms():
        car, lower = a_car(kind), torch.tensor(LOWER, dtype=torch.float64)
        noises = [diagonal(0.03, 0.03, 0.1, 0.1, 0.01), diagonal(7.0, 7.0, 0.3, 0.3)]
        limited = lambda states: torch.maximum(states, lower)  # noqa: E731
        model = NonlinearModel(lambda x, u: car.transition(x, u, CAR_STEP), car.observation, *map(constant, noises), limited)
        generator = torch.Generator().manual_seed(1)
        y = torch.randn(1, STEPS, 4, generator=generator, dtype=torch.float64) + torch.tensor([0.0, 0.0, 1.0, 3.0])
        first = Gaussian(torch.tensor([3.0, 0.2, 1.0, 3.0, 0.6]).double(), diagonal(0.03, 0.03, 0.03, 0.03, 0.01))
        y = with_gaps(y) if gate is None else with_outliers(y)
        return unscented(model, CompiledPlanarCar(car, CAR_STEP, LOWER, torch.float64), y, driven(STEPS)[1][None], first, noises, gate)

    return forms


def dugoff(tyres, gate=None):
    def forms():
        track = dugoff_track(tyres, sees_sideslip=True)
        sizes = torch.tensor([0.3, 0.02, 300.0, 300.0, 0.02])
        noises = [diagonal(0.05, 0.02), diagonal(*sizes.tolist())]
        model = NonlinearModel(track.transition, track.observation, *map(constant, noises))
        generator = torch.Generator().manual_seed(2)
        y = torch.tensor([3.0, 0.2, 3000.0, 3000.0, -0.01]) + sizes * torch.randn(1, STEPS, 5, generator=generator, dtype=torch.float64)
        u = torch.tensor([20.0, 0.05, 0.0], dtype=torch.float64).expand(1, STEPS, 3).contiguous()
        first = Gaussian(torch.tensor([0.0, 0.1], dtype=torch.float64), diagonal(0.3, 0.1))
        y = with_gaps(y) if gate is None else with_outliers(y, 10.0)
        return unscented(model, CompiledDugoffTrack(track), y, u, first, noises, gate)

    return forms


def network(estimator):
    def forms():
        value_and_gradient = _problem(estimator, torch.float64)
        return list(value_and_gradient(compiled=False)), list(value_and_gradient(compiled=True))

    return forms


PAIRS = {
    "Kalman": kalman(),
    "extended": extended,
    **{f"rational_ekf {tyres}": rational_with(tyres=tyres) for tyres in KINDS},
    "rational_ekf held straight ahead": rational_with(adapt_above=2.0),
    **{f"learned_ukf {kind}": planar(kind) for kind in CARS},
    **{f"dugoff_ukf {tyres}": dugoff(tyres) for tyres in ("plain", "smooth")},
    "Kalman gated": kalman(GATE),
    "rational_ekf gated": rational_with(GATE, tyres="rational_adaptive"),
    "learned_ukf gated": planar("PC", GATE),
    "dugoff_ukf gated": dugoff("plain", GATE),
    **{f"{estimator.name} {estimator.variant}": network(estimator) for estimator in STRUCTURES},
}


@pytest.mark.parametrize("pair", PAIRS)
def test_readable_and_compiled_form_agree_through_gaps_limits_and_gates(pair):
    readable, compiled = PAIRS[pair]()
    for expected, found in zip(readable, compiled, strict=True):
        assert torch.isfinite(found).all()
        assert float((found.squeeze() - expected.squeeze()).abs().max()) < 1e-9 * max(1.0, float(expected.abs().max()))
