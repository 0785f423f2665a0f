"""Covariances that can be learnt: definite, differentiable, with the entropy that is asked for.

Noise levels read off signals.
"""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from point_models import covariances
from vehest.filters.noise_levels import high_passed_level
from vehest.filters.noise_models import (
    COVARIANCE_FLOOR,
    DEVIATION,
    ConstantNoise,
    StateDependentNoise,
    compiled_noise,
    entropy,
    with_entropy,
)

STATE = torch.randn(7, 5, generator=torch.Generator().manual_seed(0))
INPUTS = torch.zeros(7, 2)
START = [1e-3, 1e-3, 1e-2, 1e-2, 1e-5]


def drawn(noise, deviation, seed):
    noise.reset(torch.Generator().manual_seed(seed))
    noise.weight.data.mul_(deviation / DEVIATION)
    return noise


@pytest.fixture(params=["constant", "state dependent"])
def noise(request):
    return {
        "constant": lambda: ConstantNoise(START),
        "state dependent": lambda: drawn(StateDependentNoise(START, 5), DEVIATION, 1),
    }[request.param]()


def test_noise_models_start_near_their_initial_variances(noise):
    covariance = noise(STATE, INPUTS)
    assert covariance.shape == (7, 5, 5)
    assert torch.allclose(covariance, torch.diag(torch.tensor(START)), atol=2e-6)


def test_learnt_noises_stay_definite_and_give_gradients_wherever_they_go():
    for noise in (ConstantNoise(START), StateDependentNoise(START, 5)):
        for parameter in noise.parameters():
            torch.nn.init.normal_(parameter, generator=torch.Generator().manual_seed(2))
        covariance = noise.double()(STATE.double(), INPUTS.double())
        assert (torch.linalg.eigvalsh(covariance) >= 0.99 * COVARIANCE_FLOOR).all()
        covariance.square().sum().backward()
        assert all(
            parameter.grad is not None and parameter.grad.abs().sum() > 0
            for parameter in noise.parameters()
        )


def test_noise_covariances_match_their_formula_and_floor():
    noise = drawn(StateDependentNoise([0.2, 0.3], 5), 0.5, 3)
    a, b, c = (noise.weight @ STATE[2]).tolist()
    lower = torch.tensor([[a, 0.0], [b, c]])
    assert torch.allclose(
        noise(STATE, INPUTS)[2],
        torch.diag(torch.tensor([0.2, 0.3])) + 0.01 * lower @ lower.mT,
        atol=1e-6,
    )
    noise = ConstantNoise([1.0, 1.0])
    torch.nn.init.zeros_(noise.factor)
    assert torch.equal(noise(STATE, INPUTS)[0], COVARIANCE_FLOOR * torch.eye(2))
    assert sum(parameter.numel() for parameter in ConstantNoise(START).parameters()) == 15
    assert (
        sum(parameter.numel() for parameter in StateDependentNoise(START, 5).parameters())
        == 15 + 15 * 6
    )


def test_entropy_is_that_of_a_library_and_is_raised_to_its_floor():
    root = torch.randn(4, 3, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    covariance = root @ root.mT + 0.1 * torch.eye(3, dtype=torch.float64)
    for matrix, value in zip(covariance, entropy(covariance), strict=True):
        assert float(value) == pytest.approx(multivariate_normal(cov=matrix.numpy()).entropy())
    small = 1e-4 * torch.eye(5, dtype=torch.float64)
    large = 10.0 * torch.eye(5, dtype=torch.float64)
    small[0, 1] = small[1, 0] = 5e-5
    raised = with_entropy(torch.stack([small, large]), -9.0)
    assert float(entropy(raised[0])) == pytest.approx(-9.0)
    assert torch.allclose(raised[0] / raised[0, 0, 0], small / small[0, 0]), (
        "only its size has changed"
    )
    assert torch.equal(raised[1], large)


@pytest.mark.parametrize("is_correlated", [True, False])
@pytest.mark.parametrize(
    ("dtype", "tolerance"),
    [(torch.float64, 1e-14), pytest.param(torch.float32, 1e-5, marks=pytest.mark.apart)],
)
def test_compiled_it_is_the_same_with_and_without_a_floor(dtype, tolerance, is_correlated):
    generator = torch.Generator().manual_seed(2)
    noise = drawn(StateDependentNoise(START, 3, is_correlated), 1.0, 1)
    noise.begin(torch.tensor([0.1, 0.2, 0.3, 0.1, 0.2]).diag(), 10.0, torch.tensor([2.0, 0.5, 1.0]))
    noise.to(dtype)
    states = torch.randn(7, 3, generator=generator).to(dtype)
    readable = noise(states, states).detach()
    floor = float(entropy(readable).median())
    for expected, compiled in (
        (readable, compiled_noise(noise)),
        (with_entropy(readable, floor), compiled_noise(noise, floor)),
    ):
        assert covariances(compiled, states.numpy(), states.numpy()) == pytest.approx(
            expected.numpy(), rel=tolerance, abs=tolerance
        )
    assert float((with_entropy(readable, floor) - readable).abs().max()) > 0.01, "the floor is met"


def test_high_passed_level_measures_white_noise_and_ignores_slow_signals():
    """A fraction 1 - c of white noise's power lies above c times the Nyquist frequency.

    2 % leaves room for the filter's slopes.
    """
    noise = 0.3 * np.random.default_rng(0).standard_normal(100_000)
    for cutoff in (0.1, 0.2):
        assert high_passed_level([noise], cutoff) == pytest.approx(
            0.3 * np.sqrt(1 - cutoff), rel=0.02
        )
    # 60 dB down below 0.75 times the cut-off.
    time = np.arange(20_000) / 100.0
    noise = 0.01 * np.random.default_rng(1).standard_normal(len(time))
    slow = 5.0 + 3.0 * np.sin(2 * np.pi * 0.5 * time) + np.sin(2 * np.pi * 7.0 * time)
    assert high_passed_level([slow], 0.2) < 1e-3
    assert high_passed_level([slow + noise], 0.2) == pytest.approx(
        high_passed_level([noise], 0.2), rel=0.02
    )
    noise = np.random.default_rng(2).standard_normal(2_000)
    offset = noise + 1e3
    offset[700] = np.nan
    without = high_passed_level([noise[:700], noise[701:]], 0.2)
    assert high_passed_level([offset], 0.2) == pytest.approx(without, rel=1e-6)
    with pytest.raises(ValueError, match="samples without a gap"):
        high_passed_level([np.zeros(50)], 0.2)
