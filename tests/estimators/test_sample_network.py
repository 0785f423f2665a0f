"""Networks over single samples: compiled layers, masks of dropout, members that do not touch each
other, and the feed-forward network.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dugoff_drive import dugoff_drive
from vehest.data.errors import DataError
from vehest.estimators.base import FitData
from vehest.estimators.kernels.sample_network import (
    LEVELS,
    _activate,
    gaussian_likelihood,
    losses_of,
    outputs_of,
    squared_error,
)
from vehest.estimators.networks.sample_network import INPUTS, SampleNetwork
from vehest.estimators.registry import estimator_class
from vehest.training.samples import SampleSettings
from vehest.training.sequences import PhaseSettings

QUICK = SampleSettings(PhaseSettings(learning_rate=5e-3, max_epochs=4), batch_size=128)
LONGER = SampleSettings(PhaseSettings(learning_rate=5e-3, max_epochs=25), batch_size=128)
SEEDS = torch.tensor([7, 8, 9])


def loaded_drive(seconds=8.0, seed=0, name="drive"):
    """A drive on Dugoff's tyres with the forces that it lacks: shared out evenly, or at rest."""
    drive = dugoff_drive(seconds, seed, name=name)
    forces = {}
    for corner in ("fl", "fr", "rl", "rr"):
        forces[f"fx_{corner}"] = 492.5 * drive["ax"]
        forces[f"fz_{corner}"] = np.full(len(drive), 4831.0)
    return drive.with_channels(forces)


DATA = FitData([loaded_drive(seed=1), loaded_drive(4.0, seed=2)], [loaded_drive(4.0, seed=3)])


def network(outputs, members=3):
    sample_network = SampleNetwork(5, (11, 6), outputs, members).double()
    sample_network.reset([torch.Generator().manual_seed(member) for member in range(members)])
    with torch.no_grad():
        for name, parameter in sample_network.named_parameters():
            if name.startswith("bias"):
                parameter.copy_(
                    0.1
                    * torch.randn(
                        parameter.shape,
                        generator=torch.Generator().manual_seed(4),
                        dtype=torch.float64,
                    )
                )
    return sample_network


def active_mask(seed, layer, shape, dropout):
    """Which values of a hidden layer (0 or 1) a member's mask leaves, (B, H)."""
    ones = np.ones(shape, np.float32)
    _activate(ones, np.zeros(shape[1], np.float32), seed, layer, round(LEVELS * dropout))
    return ones > 0


def readable(inputs, parameters, member, dropout):
    """One member's outputs in torch, with the masks that its seed stands for."""
    hidden = inputs
    scale = 256.0 / (256.0 - round(256 * dropout))
    for layer in (0, 1):
        hidden = torch.relu(
            hidden @ parameters[2 * layer][member] + parameters[2 * layer + 1][member]
        )
        mask = active_mask(int(SEEDS[member]), layer, (len(hidden), hidden.shape[1]), dropout)
        hidden = hidden * torch.as_tensor(mask) * scale
    return hidden @ parameters[4][member] + parameters[5][member]


def samples(count=40):
    """Inputs, targets, and rows that three members see."""
    generator = torch.Generator().manual_seed(3)
    table, targets = (
        torch.randn(shape, generator=generator, dtype=torch.float64)
        for shape in ((count, 5), (count,))
    )
    return (
        table,
        targets,
        torch.stack([torch.randperm(count, generator=generator)[:20] for _ in range(3)]),
    )


@pytest.mark.parametrize("dropout", [0.0, 0.4])
def test_compiled_layers_are_the_readable_ones_with_their_gradients(dropout):
    table, _, rows = samples()
    parameters = list(network(2).parameters())
    weights = torch.randn(3, 20, 2, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    outputs = outputs_of(table[rows], parameters, SEEDS, dropout)
    expected = torch.stack(
        [readable(table[rows[member]], parameters, member, dropout) for member in range(3)]
    )
    torch.testing.assert_close(outputs, expected, rtol=1e-12, atol=1e-12)
    gradients = [
        torch.autograd.grad((outcome * weights).sum(), parameters)
        for outcome in (outputs, expected)
    ]
    for compiled_gradient, readable_gradient in zip(*gradients, strict=True):
        torch.testing.assert_close(compiled_gradient, readable_gradient, rtol=1e-10, atol=1e-12)


def test_losses_and_their_gradients_are_those_of_the_formulas():
    table, targets, rows = samples()
    for outputs, criterion in ((1, squared_error), (2, gaussian_likelihood)):
        parameters = list(network(outputs).parameters())
        expected = []
        for member in range(3):
            readable_outputs = readable(table[rows[member]], parameters, member, 0.2)
            member_targets = targets[rows[member]]
            if outputs == 1:
                expected.append((readable_outputs[:, 0] - member_targets).square().mean())
            else:
                variance = torch.nn.functional.softplus(readable_outputs[:, 1]) + 1e-6
                expected.append(
                    torch.nn.functional.gaussian_nll_loss(
                        readable_outputs[:, 0], member_targets, variance, eps=1e-12
                    )
                )
        compiled_losses = losses_of(table, targets, rows, parameters, SEEDS, 0.2, criterion)
        torch.testing.assert_close(compiled_losses, torch.stack(expected), rtol=1e-10, atol=1e-12)
        scale = torch.tensor([1.0, 2.0, -1.0], dtype=torch.float64)
        gradients = [
            torch.autograd.grad((losses * scale).sum(), parameters)
            for losses in (compiled_losses, torch.stack(expected))
        ]
        for compiled_gradient, readable_gradient in zip(*gradients, strict=True):
            torch.testing.assert_close(compiled_gradient, readable_gradient, rtol=1e-9, atol=1e-12)


def test_a_member_learns_the_same_alone():
    table, targets, rows = samples()
    together = list(network(1).parameters())
    alone = [parameter[1:2].detach().clone().requires_grad_() for parameter in together]
    losses_of(table, targets, rows, together, SEEDS, 0.2, squared_error).sum().backward()
    losses_of(table, targets, rows[1:2], alone, SEEDS[1:2], 0.2, squared_error).sum().backward()
    for joint, single in zip(together, alone, strict=True):
        assert torch.equal(joint.grad[1:2], single.grad)


def test_masks_hide_their_share_by_the_seed_and_missing_samples_are_marked():
    mask = active_mask(1, 0, (400, 250), 0.2)
    assert abs(mask.mean() - 205 / 256) < 3 * np.sqrt(0.2 * 0.8 / mask.size)
    assert np.array_equal(mask, active_mask(1, 0, (400, 250), 0.2))
    for changed_mask in (
        active_mask(2, 0, (400, 250), 0.2),
        active_mask(1, 1, (400, 250), 0.2),
    ):  # as often alike as masks that know nothing of each other
        assert (mask == changed_mask).mean() == pytest.approx(0.8**2 + 0.2**2, abs=0.01)
    drive = dugoff_drive(2.0)
    with pytest.raises(
        DataError,
        match=r"'fx_fl', on which estimator 'sideslip_ffnn' is trained; set estimator.inputs=imu",
    ):
        estimator_class("sideslip_ffnn").from_config({}).fit(FitData([drive], [drive]), QUICK)


def fitted(training=QUICK, **config):
    estimator = estimator_class("sideslip_ffnn").from_config(
        {"hidden": [24, 12], "dropout": 0.05} | config
    )
    estimator.seed(1)
    return estimator, estimator.fit(DATA, training)


@pytest.mark.parametrize("inputs", ["full", "imu"])
def test_the_feed_forward_network_learns_and_reports_its_error(inputs):
    estimator, record = fitted(LONGER, inputs=inputs)
    assert estimator.channels == INPUTS[inputs]
    assert len(INPUTS["full"]) == 17
    drive = DATA.validation[0]
    assert record.metrics["best_validation_loss"] < 0.3 * np.mean(np.square(drive["sideslip_ref"]))
    estimate = estimator.estimate([drive.without_references()])[0]
    error = np.mean(np.square(estimate["sideslip"] - drive["sideslip_ref"]))
    assert error == pytest.approx(record.metrics["best_validation_loss"], rel=1e-4)


def test_inputs_are_scaled_by_their_range_or_to_z_scores():
    inputs = np.column_stack([np.linspace(-3.0, 5.0, 50), np.full(50, 7.0)])
    network = SampleNetwork(2, (4, 3), 1).double()
    network.scale(inputs, np.ones(50))
    scaled = network.scaled(torch.as_tensor(inputs)).numpy()
    np.testing.assert_allclose(
        [scaled[:, 0].min(), scaled[:, 0].max(), *scaled[:, 1]],
        [0.0, 1.0, *np.zeros(50)],
        atol=1e-12,
    )
    network.scale(inputs, np.ones(50), "standard")
    scaled = network.scaled(torch.as_tensor(inputs)).numpy()
    np.testing.assert_allclose(
        [scaled[:, 0].mean(), scaled[:, 0].std(), *scaled[:, 1]],
        [0.0, 1.0, *np.zeros(50)],
        atol=1e-12,
    )
    network.scale(np.array([[-2.0, 5.0], [6.0, 5.0]]), np.array([0.3, -0.4]))
    assert float(network.unit) == pytest.approx(np.sqrt(0.125))
    assert (
        estimator_class("sideslip_ffnn").from_config({"normalisation": "standard"}).variant
        == "full_standard"
    )


def test_a_network_reports_its_limited_squares():
    limit = 0.5  # deg
    estimator, record = fitted(replace(QUICK, loss_limit=limit))
    drive = DATA.validation[0]
    estimate = estimator.estimate([drive.without_references()])[0]
    error = np.abs(np.degrees(estimate["sideslip"] - drive["sideslip_ref"]))
    assert error.max() > limit
    squares = np.where(error <= limit, np.square(error), limit * (2.0 * error - limit))
    assert np.degrees(np.degrees(record.metrics["best_validation_loss"])) == pytest.approx(
        squares.mean(), rel=1e-3
    )
