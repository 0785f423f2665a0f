"""The compiled scan is the readable unscented filter, in values and gradients.

That one is filterpy's to 1e-8 (test_filters_nonlinear).
"""

import dataclasses
from collections import namedtuple

import pytest
import torch
from readable_filters import NonlinearModel, unscented_filter
from test_filters_nonlinear import RULES, STEP, constant, measured_pendulum, pendulum_with_radar

from point_models import noise_by
from vehest.filters.gaussian import Gaussian
from vehest.filters.sigma_points import symmetric_rule
from vehest.filters.unscented_scan import TorchModel, UnscentedStepper, moved, unscented_scan

FREE = [-1e9, -1e9, -1e9]
ANY = {"measurements": torch.zeros(2, 5, 2), "inputs": torch.zeros(2, 5, 1)}
Learnt = namedtuple(
    "Learnt", "process observation mean covariance gravity"
)  # what gradients are wanted for


def learnt(first):
    model = pendulum_with_radar()
    nothing = torch.zeros(3, dtype=torch.float64)
    parts = (
        model.process_noise(nothing, nothing),
        model.observation_noise(nothing, nothing),
        *first,
    )
    return Learnt(
        *(
            part.clone().requires_grad_()
            for part in (*parts, torch.tensor(9.81, dtype=torch.float64))
        )
    )


def both_ways(rule, measurements, inputs, first, lower=FREE, share=None):
    """The pendulum by the readable filter and by the scan: what they return, and gradients of a
    random sum of means and covariances.

    Those of the measurements come last.
    """
    generator = torch.Generator().manual_seed(5)
    sequences, steps = measurements.shape[:2]
    weights = [
        torch.randn(sequences, steps, *size, generator=generator, dtype=torch.float64)
        for size in ((3,), (3, 3))
    ]
    lower_bound = torch.tensor(lower, dtype=torch.float64)
    pairs = []
    for way in (by_the_filter, by_the_scan):
        parameters = learnt(first)
        measurements = measurements.detach().requires_grad_()
        filtered = way(parameters, rule, measurements, inputs, lower_bound, share)
        state = filtered.steps.filtered
        loss = (state.mean * weights[0]).sum() + (state.covariance * weights[1]).sum()
        pairs.append((filtered, torch.autograd.grad(loss, (*parameters, measurements))))
    return pairs


def by_the_filter(p, rule, measurements, inputs, lower_bound, _):
    model = dataclasses.replace(
        pendulum_with_radar(p.gravity),
        process_noise=constant(p.process),
        observation_noise=constant(p.observation),
        constrain=lambda x: torch.where(x >= lower_bound, x, lower_bound),
    )
    return unscented_filter(model, measurements, inputs, Gaussian(p.mean, p.covariance), rule)


def by_the_scan(p, rule, measurements, inputs, lower_bound, share):
    pendulum = pendulum_with_radar(p.gravity)
    model = TorchModel(pendulum.transition, pendulum.observation, [p.gravity], lower_bound.tolist())
    return unscented_scan(
        model,
        measurements,
        inputs,
        Gaussian(p.mean, p.covariance),
        p.process,
        p.observation,
        rule,
        share=share,
    )


def assert_equal(first, second):
    for name in ("filtered", "predicted"):
        for a, b in zip(getattr(first.steps, name), getattr(second.steps, name), strict=True):
            assert torch.allclose(a, b, rtol=0, atol=1e-11, equal_nan=True), name
    for name in ("innovation", "innovation_covariance"):
        assert torch.allclose(
            getattr(first.steps, name),
            getattr(second.steps, name),
            rtol=0,
            atol=1e-11,
            equal_nan=True,
        ), name
    assert torch.equal(first.steps.measured, second.steps.measured)
    assert torch.equal(first.repaired, second.repaired)


def assert_gradients_equal(expected, actual):
    """Finite and equal to 1e-10 of the largest element, for each field of `Learnt` and the rest."""
    for field, a, b in zip((*Learnt._fields, "measurements"), expected, actual, strict=True):
        assert torch.isfinite(b).all(), field
        assert torch.allclose(a, b, rtol=0, atol=1e-10 * float(a.abs().max())), field


@pytest.mark.parametrize("name", RULES)
def test_scan_is_the_unscented_filter_in_values_and_gradients(name):
    (filtered, gradients), (scanned, scan_gradients) = both_ways(
        RULES[name], *measured_pendulum(30, 4)
    )
    assert_equal(filtered, scanned)
    assert_gradients_equal(gradients, scan_gradients)
    assert all(gradient.abs().sum() > 0 for gradient in gradients)


def test_missing_measurements_and_bounds_of_states_are_as_by_the_filter():
    measurements, inputs, first = measured_pendulum(30, 3)
    measurements[0, 3, 0] = measurements[1, 5] = measurements[2, 10:20, 1] = torch.nan
    (filtered, gradients), (scanned, scan_gradients) = both_ways(
        RULES["symmetric"], measurements, inputs, first
    )
    assert_equal(filtered, scanned)
    assert_gradients_equal(gradients, scan_gradients)
    lower = [-1e9, 0.05, 0.25]
    (filtered, gradients), (scanned, scan_gradients) = both_ways(
        RULES["scaled"], *measured_pendulum(30, 4), lower=lower
    )
    assert (scanned.steps.filtered.mean[..., 2] == 0.25).any(), "the bound is met"
    assert (scanned.steps.predicted.mean[..., 1] == 0.05).any(), (
        "and that of the rate when it falls"
    )
    assert (scanned.steps.filtered.mean[..., 2] >= 0.25).all()
    assert_equal(filtered, scanned)
    assert_gradients_equal(gradients, scan_gradients)


VARIANCES = torch.tensor(
    [[20.0, 20, 20], [1, 20, 20], [2.9, 20, 20], [-2, 20, 20], [20, 0.5, 20], [20, 20, 20]],
    dtype=torch.float64,
)
"""Of squares at three samples, by which the negative weight of the mean point costs nothing, the
definiteness of the innovation, that of the state after it, the innovation's even without that
weight, and that of the innovation at the second sample. The last sequence begins with a
covariance that is not positive definite.
"""


def squares(way, repair=True):
    """Sequences with these variances by the readable filter or the scan, and gradients of means in
    the first mean and covariance.
    """
    eye = torch.eye(3, dtype=torch.float64)
    lone = torch.tensor([1.0, -0.1, 1.0], dtype=torch.float64).diag()
    mean = torch.tensor(
        [[0.5, 0.0, 0.1]] * 3 + [[0.0, 0.0, 0.0]] + [[0.5, 0.0, 0.1]] * 2, dtype=torch.float64
    )
    first = Gaussian(
        mean.requires_grad_(), torch.cat([eye.expand(5, 3, 3), lone[None]]).requires_grad_()
    )
    y = torch.full((6, 3, 2), 0.1, dtype=torch.float64)
    u = VARIANCES[..., None]
    rule = symmetric_rule(3, -1.0)
    model = NonlinearModel(
        lambda x, _: 0.9 * x,
        lambda x, _: torch.stack([x.square().sum(-1), x[..., 0]], -1),
        constant(1e-4 * eye),
        lambda _, variance: torch.diag_embed(torch.cat([variance, 0.0 * variance + 2.0], -1)),
    )
    if way == "filter":
        filtered = unscented_filter(model, y, u, first, rule)
    else:
        noises = 1e-4 * eye, model.observation_noise(None, u)
        filtered = unscented_scan(
            TorchModel(model.transition, model.observation),
            y,
            u,
            first,
            *noises,
            rule,
            repair=repair,
        )
    return filtered, torch.autograd.grad(
        filtered.steps.filtered.mean[: 6 if repair else 1].square().sum(), first
    )


def test_lost_definiteness_is_repaired_and_counted_as_by_the_filter():
    (filtered, slopes) = squares("filter")
    (scanned, scan_gradients) = squares("scan")
    assert_equal(filtered, scanned)
    ways = [
        [False] * 3,
        [True, False, False],
        [True, False, False],
        [True, False, False],
        [False, True, False],
        [True, False, False],
    ]
    assert scanned.repaired.tolist() == ways
    for a, b in zip(slopes, scan_gradients, strict=True):
        assert torch.allclose(
            a, b, rtol=1e-9, atol=1e-10
        )  # the fourth is conditioned like the margin of a repair, 1e6


def test_without_repair_a_sequence_is_lost_and_leaves_the_others_alone():
    (left, slopes) = squares("scan", repair=False)
    (tame, _) = squares("scan")
    for sequence, first in enumerate((3, 0, 1, 0, 1, 0)):
        mean = left.steps.filtered.mean[sequence]
        assert torch.isfinite(mean[:first]).all(), sequence
        assert torch.isnan(mean[first:]).all(), sequence
    assert torch.equal(left.steps.filtered.mean[0], tame.steps.filtered.mean[0])
    assert torch.equal(left.steps.innovation_covariance[0], tame.steps.innovation_covariance[0])
    assert torch.isfinite(slopes[0][0]).all()


def test_sequences_filtered_in_shares_equal_those_filtered_together():
    """Each in two pieces, one after the other."""

    def halves(work, sequences):
        for first, end in ((0, sequences // 2), (sequences // 2, sequences)):
            work(first, end)

    problem = measured_pendulum(20, 5)
    together = both_ways(RULES["cubature"], *problem)[1]
    shared = both_ways(RULES["cubature"], *problem, share=halves)[1]
    assert torch.equal(together[0].steps.filtered.mean, shared[0].steps.filtered.mean)
    assert torch.equal(
        together[0].steps.innovation_covariance, shared[0].steps.innovation_covariance
    )
    for a, b in zip(together[1], shared[1], strict=True):
        assert torch.allclose(a, b, rtol=1e-13, atol=0)


def test_scan_with_noise_functions_matches_the_filter_and_has_no_gradients():
    measurements, inputs, first = measured_pendulum(20, 2)

    def noise(base):
        return lambda x, u: base * (1.0 + x[..., :1, None] ** 2)

    model = pendulum_with_radar()
    p = learnt(first)
    process = noise(p.process.detach())
    observation = noise(p.observation.detach())
    readable = dataclasses.replace(model, process_noise=process, observation_noise=observation)
    filtered = unscented_filter(readable, measurements, inputs, first, RULES["symmetric"])
    start = Gaussian(first.mean.clone().requires_grad_(), first.covariance)
    noises = [noise_by(noise(base.detach().numpy())) for base in (p.process, p.observation)]
    scanned = unscented_scan(
        TorchModel(model.transition, model.observation),
        measurements,
        inputs,
        start,
        *noises,
        RULES["symmetric"],
    )
    assert torch.allclose(
        filtered.steps.filtered.mean, scanned.steps.filtered.mean, rtol=0, atol=1e-11
    )
    with pytest.raises(RuntimeError, match="has no gradients; give it as a tensor"):
        scanned.steps.filtered.mean.sum().backward()


def test_stepper_matches_the_scan():
    measurements, inputs, first = measured_pendulum(20, 1)
    measurements[0, 4, 0] = measurements[0, 9] = torch.nan
    model = pendulum_with_radar()
    p = learnt(first)
    points = TorchModel(model.transition, model.observation)
    noises = [part.detach() for part in (p.process, p.observation)]
    state = unscented_scan(
        points, measurements, inputs, first, *noises, RULES["symmetric"]
    ).steps.filtered
    stepper = UnscentedStepper(
        points, first.mean.numpy(), first.covariance.numpy(), 2, RULES["symmetric"]
    )
    process, observation = (noise[None].numpy() for noise in noises)
    for k in range(20):
        mean = stepper.step(
            measurements[0, k].numpy(),
            inputs[0, k].numpy(),
            process,
            noise_by(lambda x, u: observation),
        )
        assert mean == pytest.approx(state.mean[0, k].numpy(), abs=1e-12), k
        assert stepper.state.covariance == pytest.approx(
            state.covariance[0, k].numpy(), abs=1e-12
        ), k


def test_moved_is_the_transition_with_its_gradient():
    gravity = torch.tensor(9.81, dtype=torch.float64, requires_grad=True)
    pendulum = pendulum_with_radar(gravity)
    model = TorchModel(pendulum.transition, pendulum.observation, [gravity])
    states, inputs = (
        torch.randn(6, n, generator=torch.Generator().manual_seed(n), dtype=torch.float64)
        for n in (3, 1)
    )
    after = moved(model, states, inputs)
    assert torch.equal(after, pendulum.transition(states, inputs))
    (slope,) = torch.autograd.grad(after[:, 1].sum(), gravity)
    assert slope == pytest.approx(float(-STEP * torch.sin(states[:, 0]).sum()))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"measurements": torch.zeros(5, 2)}, r"of shape \(B, T, m\) with T > 0, not \(5, 2\)"),
        ({"measurements": torch.zeros(2, 0, 2), "inputs": torch.zeros(2, 0, 1)}, r"T > 0"),
        ({"inputs": torch.zeros(2, 4, 1)}, "do not fit measurements"),
        ({"initial": Gaussian(torch.zeros(3, 3), torch.eye(3))}, "does not fit 2 sequences"),
    ],
)
def test_shapes_that_do_not_fit_are_refused(wrong, message):
    model = pendulum_with_radar()
    arguments = ANY | {"initial": Gaussian(torch.zeros(3), torch.eye(3))} | wrong
    points = TorchModel(model.transition, model.observation)
    with pytest.raises(ValueError, match=message):
        unscented_scan(
            points,
            **arguments,
            process_noise=torch.eye(3),
            observation_noise=torch.eye(2),
            rule=RULES["cubature"],
        )
