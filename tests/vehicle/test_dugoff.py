"""Dugoff's tyres and the single track on them: readable, compiled and through the filter the same,
gradients finite at a slip of zero.
"""

import numpy as np
import pytest
import torch

from dugoff_drive import FRONT, dugoff_track
from point_models import called
from vehest.estimators.filtering.track_filter import TrackFilter
from vehest.estimators.kernels.dugoff_track import CompiledDugoffTrack
from vehest.filters.unscented_scan import TorchModel
from vehest.vehicle.dugoff import LoadedCar

BOTH_CURVES = pytest.mark.parametrize("tyres", ["plain", "smooth"])
LOAD = torch.tensor(9000.0, dtype=torch.float64)
SPEED = torch.tensor(25.0, dtype=torch.float64)


def drawn(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def driven(count):
    """Points from straight ahead to a spin, and inputs from a standstill to fast."""
    points = drawn(count, 5, 2) * torch.tensor([3.0, 1.0])
    inputs = torch.stack(
        [
            40.0 * torch.rand(count, dtype=torch.float64),
            0.2 * drawn(count, seed=1),
            4.0 * drawn(count, seed=2),
        ],
        -1,
    )
    points[0] = 0.0
    inputs[0, 1] = 0.0
    return points, inputs


def force(tangent, tyres):
    return FRONT.force(tangent, LOAD, SPEED, tyres)


def test_tyres_are_those_of_the_paper():
    """Eqs. 9 and 10 at κ = 0, digit by digit."""
    for tangent in (0.02, 0.05, 0.2, -0.1):
        friction = FRONT.friction * (1.0 - FRONT.reduction * 25.0 * abs(tangent))
        ratio = friction * 9000.0 / (2.0 * FRONT.cornering_stiffness * abs(tangent))
        plain = ratio * (2.0 - ratio) if ratio <= 1.0 else 1.0
        smooth = 2.0 / (np.exp(-4.0 * ratio) + 1.0) - 1.0
        for tyres, force_share in (("plain", plain), ("smooth", smooth)):
            expected = FRONT.cornering_stiffness * tangent * force_share
            assert float(force(torch.tensor(tangent, dtype=torch.float64), tyres)) == pytest.approx(
                expected, rel=1e-12
            )


@BOTH_CURVES
def test_gradients_of_tyres_are_finite_differences_and_the_stiffness_at_zero(tyres):
    slip = torch.tensor([0.0, 1e-12, -1e-12, 1e-4], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(force(slip, tyres).sum(), slip)
    torch.testing.assert_close(slope, torch.full_like(slope, FRONT.cornering_stiffness))
    slip = torch.linspace(-0.3, 0.3, 61, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(force(slip, tyres).sum(), slip)
    with torch.no_grad():
        differences = (force(slip + 1e-6, tyres) - force(slip - 1e-6, tyres)) / 2e-6
    torch.testing.assert_close(slope, differences, rtol=1e-6, atol=1.0)


def test_braking_loads_the_front_axle():
    front, rear = LoadedCar().loads(torch.tensor([0.0, -5.0]))
    assert torch.allclose(front + rear, torch.tensor(1970.0 * 9.81))
    assert front[1] - front[0] == pytest.approx(1970.0 * 5.0 * 0.52 / 2.88, rel=1e-5)


@BOTH_CURVES
def test_compiled_track_matches_the_readable_track(tyres):
    track = dugoff_track(tyres)
    readable = TorchModel(track.transition, track.observation)
    compiled = CompiledDugoffTrack(track)
    points, inputs = (part.numpy() for part in driven(300))
    for entry, size in enumerate((2, 5)):
        expected, actual = (
            called(model, entry, points, inputs, size) for model in (readable, compiled)
        )
        np.testing.assert_allclose(actual, expected, rtol=1e-12, atol=1e-9)
        upstream = drawn(300, 5, size, seed=3).numpy()
        expected, actual = (
            called(model, 2 + entry, points, inputs, 2, upstream, [])
            for model in (readable, compiled)
        )
        assert np.isfinite(actual).all()
        np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-9)


def test_gradients_through_the_filter_reach_measurements_and_both_noises():
    """Of compiled code, and of automatic differentiation through readable code."""
    track = dugoff_track("smooth")
    inputs = torch.stack(
        [
            torch.tensor([[20.0], [2.0], [28.0]]).expand(3, 8),
            0.05 * torch.ones(3, 8),
            torch.zeros(3, 8),
        ],
        -1,
    ).double()
    inputs[1, 4:, 0] = 8.0  # rolls, then drives
    sizes = torch.tensor([0.3, 0.02, 300.0, 300.0, 0.02])
    differentiable = [
        (torch.tensor([3.0, 0.2, 3000.0, 3000.0, -0.01]) + drawn(3, 8, 5) * sizes),
        (torch.tensor([0.05, 0.02]) * (1.0 + 0.3 * drawn(3, 8, 2, seed=4).abs())),
        (sizes * (1.0 + 0.3 * drawn(3, 8, 5, seed=5).abs())),
    ]
    differentiable[0][0, 3, 2] = torch.nan
    weights = drawn(3, 8, 2, seed=6)

    def outcome(parts, *, compiled=True):
        measurements, process, sensors = parts
        noises = (torch.diag_embed(part.square()) for part in (process, sensors))
        track_filter = TrackFilter(track)
        if not compiled:
            track_filter.model = TorchModel(track.transition, track.observation)
        filtered = track_filter.filtered(measurements, inputs, *noises)
        return (filtered.steps.filtered.mean * weights).sum()

    def gradients(*, compiled):
        leaves = [part.clone().requires_grad_() for part in differentiable]
        return list(torch.autograd.grad(outcome(leaves, compiled=compiled), leaves))

    for gradient, expected, size in zip(
        gradients(compiled=True), gradients(compiled=False), (sizes, 0.1, sizes), strict=True
    ):
        assert torch.isfinite(gradient).all()
        scale = float((expected * size).abs().max())
        torch.testing.assert_close(gradient * size, expected * size, rtol=0.0, atol=1e-8 * scale)


def test_a_sequence_has_the_same_digits_alone_as_beside_others():
    """Eleven sequences fill one vector of eight and a part of another.

    One of them is repaired, one not measured.
    """
    track = dugoff_track("smooth")
    count = 11
    inputs = torch.tensor([20.0, 0.05, 0.0]) + drawn(count, 6, 3) * torch.tensor([2.0, 0.03, 0.5])
    sizes = torch.tensor([0.3, 0.02, 300.0, 300.0, 0.02])
    measurements = (
        torch.tensor([3.0, 0.2, 3000.0, 3000.0, -0.01]) + drawn(count, 6, 5, seed=3) * sizes
    )
    measurements[2, 3] = torch.nan
    process = torch.diag_embed(
        (torch.tensor([0.05, 0.02]) * (1.0 + drawn(count, 6, 2, seed=4).abs())).square()
    )
    process[9, 2] *= -100.0

    def outcome(rows):
        leaves = [part[rows].clone().requires_grad_() for part in (measurements, process)]
        filtered = TrackFilter(track).filtered(
            leaves[0], inputs[rows], leaves[1], sizes.double().square().diag()
        )
        states = filtered.steps.filtered
        (states.mean.square().sum() + states.covariance.sum()).backward()
        return [
            states.mean.detach(),
            states.covariance.detach(),
            filtered.repaired,
            *(leaf.grad for leaf in leaves),
        ]

    together = outcome(slice(None))
    assert together[2].any()
    for row in range(count):
        for alone, beside in zip(outcome(slice(row, row + 1)), together, strict=True):
            assert torch.equal(alone[0].nan_to_num(), beside[row].nan_to_num()), row
