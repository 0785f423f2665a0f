"""Networks over windows in plain PyTorch: trained, estimated, run online and trained as members
without a hook of their own.
"""

from functools import cache

import numpy as np
import pytest
import torch
from torch import nn

from conftest import flat_weights, planar_drive, stop_after
from every_estimator import online_rows
from vehest.data.errors import ConfigurationError
from vehest.estimators.base import FitData
from vehest.estimators.networks.standardised import StandardisedNetwork
from vehest.estimators.networks.windowed import WindowedEstimator
from vehest.training.context import FitContext
from vehest.training.members import _UNBATCHABLE
from vehest.training.supervised import SupervisedSettings

WINDOW = 8
DATA = FitData([planar_drive(20.0, seed=1, noise=0.05)], [planar_drive(10.0, seed=2, noise=0.05)])


class Perceptron(nn.Module):
    """Sees the window as it was measured, in SI units."""

    def __init__(self, dropout=0.0):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Flatten(), nn.Linear(4 * WINDOW, 6), nn.Dropout(dropout), nn.Tanh(), nn.Linear(6, 1)
        )

    def forward(self, windows):
        assert windows.shape[-2:] == (WINDOW, 4)
        return self.layers(windows)


class Recurrent(StandardisedNetwork):
    """Torch's own recurrent layer, which `torch.func.vmap` cannot batch."""

    def __init__(self, layer):
        super().__init__(4)
        self.layer = layer(4, 3, batch_first=True)
        self.output = nn.Linear(3, 1)

    def forward(self, windows):
        states, _ = self.layer(windows)
        return self.output(states[:, -1]).squeeze(-1) * self.output_scale + self.output_mean


class Attention(StandardisedNetwork):
    """Torch's own encoder layer, which takes another way where no gradient is wanted."""

    def __init__(self, dropout=0.0):
        super().__init__(4)
        self.embed = nn.Linear(4, 4)
        self.encoder = nn.TransformerEncoderLayer(4, 2, 8, dropout, batch_first=True)
        self.output = nn.Linear(4, 1)

    def forward(self, windows):
        return (
            self.output(self.encoder(self.embed(windows)).mean(1)).squeeze(-1) * self.output_scale
            + self.output_mean
        )


class Convolution(nn.Module):
    def __init__(self):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv1d(4, 3, 3), nn.Tanh(), nn.AdaptiveAvgPool1d(1), nn.Flatten(), nn.Linear(3, 1)
        )

    def forward(self, windows):
        return self.layers(windows.transpose(1, 2))


NETWORKS = {
    "perceptron": Perceptron,
    "convolution": Convolution,
    "attention": Attention,
    "gru": lambda: Recurrent(nn.GRU),
    "lstm": lambda: Recurrent(nn.LSTM),
    "dropout": lambda: Perceptron(0.2),
    "attention with dropout": lambda: Attention(0.1),
}


def estimator_of(network, seed=0):
    class Plain(WindowedEstimator):
        name = "plain"
        title = "Plain"

        def new_network(self):
            return network()

    estimator = Plain.from_config({"window": WINDOW})
    estimator.seed(seed)
    return estimator


def fit(network, seeds, context=None, **training):
    members = [estimator_of(network, seed) for seed in seeds]
    settings = SupervisedSettings(
        **{"dtype": "float64", "max_epochs": 4, "learning_rate": 1e-2} | training
    )
    return members, type(members[0]).fit_members(members, DATA, settings, context or FitContext())


@pytest.mark.parametrize("name", NETWORKS)
def test_members_equal_training_each_alone(name):
    together, records = fit(NETWORKS[name], [0, 1, 2], max_epochs=12, patience=2)
    for seed, member, record in zip(range(3), together, records, strict=True):
        (alone,), (alone_record,) = fit(NETWORKS[name], [seed], max_epochs=12, patience=2)
        assert alone_record.metrics["epochs"] == record.metrics["epochs"]
        assert np.allclose(flat_weights(alone), flat_weights(member), rtol=0, atol=1e-8)
    assert not np.allclose(flat_weights(together[0]), flat_weights(together[1]), atol=1e-2)


@pytest.mark.parametrize(
    ("name", "is_sequential"),
    [("perceptron", False), ("convolution", False), ("attention", False), ("gru", True)],
)
def test_members_are_batched_where_torch_can_batch_every_layer(name, is_sequential):
    members, _ = fit(NETWORKS[name], [0, 1])
    assert (members[0].network in _UNBATCHABLE) is is_sequential


@cache
def network_type(name, dtype="float64"):
    """One trained for a moment; tests leave it as it is."""
    return fit(NETWORKS[name], [0], dtype=dtype)[0][0]


@pytest.mark.parametrize(
    ("name", "dtype", "tolerance"),
    [*((name, "float64", 1e-9) for name in NETWORKS), ("attention", "float32", 1e-4)],
)
def test_online_agrees_with_batch(name, dtype, tolerance):
    member = network_type(name, dtype)
    drive = planar_drive(10.0, seed=3).without_references()
    batch = member.estimate([drive])[0]["vy"]
    online = [row["vy"] for row in online_rows(member, drive, drive.channels)]
    assert np.isnan(batch[:WINDOW]).all()
    assert np.abs(np.array(online)[WINDOW - 1 : -1] - batch[WINDOW:]).max() <= tolerance


@pytest.mark.parametrize("name", NETWORKS)
def test_estimates_are_those_of_the_network_called_by_hand_on_each_window(name):
    member = network_type(name)
    drive = planar_drive(90.0, seed=3)  # more windows than are evaluated at once
    series = torch.as_tensor(drive.stack(member.channels))
    network = member.network.eval()
    if isinstance(network, StandardisedNetwork):
        series = (series - network.input_mean) / network.input_scale
    with torch.no_grad():
        by_hand = network(
            torch.stack([series[k : k + WINDOW] for k in range(len(drive) - WINDOW)])
        ).reshape(-1)
    assert np.allclose(
        member.estimate([drive.without_references()])[0]["vy"][WINDOW:],
        by_hand.numpy(),
        rtol=0,
        atol=1e-12,
    )


def test_initial_weights_are_those_that_torch_draws_from_the_seed():
    (member,), _ = fit(Perceptron, [5], learning_rate=1e-12, max_epochs=1)
    with torch.random.fork_rng():
        torch.manual_seed(5)
        expected = Perceptron().double()
    for parameter, drawn in zip(member.network.parameters(), expected.parameters(), strict=True):
        assert torch.allclose(parameter, drawn, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["perceptron", "dropout"])
def test_global_random_state_neither_matters_nor_changes(name):
    torch.manual_seed(0)
    before = torch.random.get_rng_state()
    first, _ = fit(NETWORKS[name], [0, 1])
    assert torch.equal(before, torch.random.get_rng_state())
    torch.manual_seed(1)
    again, _ = fit(NETWORKS[name], [0, 1])
    for first_run, second_run in zip(first, again, strict=True):
        assert np.array_equal(flat_weights(first_run), flat_weights(second_run))


@pytest.mark.parametrize("name", ["perceptron", "dropout", "lstm"])
def test_interrupted_training_goes_on_to_the_same_result(tmp_path, name):
    uninterrupted, _ = fit(NETWORKS[name], [0, 1])
    folders = [tmp_path / str(seed) for seed in range(2)]
    _, records = fit(NETWORKS[name], [0, 1], FitContext(folders, should_stop=stop_after(15)))
    assert all(record.interrupted and record.metrics["epochs"] > 0 for record in records)
    resumed, _ = fit(NETWORKS[name], [0, 1], FitContext(folders))
    for expected, actual in zip(uninterrupted, resumed, strict=True):
        assert np.array_equal(flat_weights(expected), flat_weights(actual))


class Frozen(Perceptron):
    """A random projection that is not trained, and a buffer that each member draws for itself."""

    def __init__(self):
        super().__init__()
        self.layers[1].requires_grad_(False)
        self.register_buffer("offset", torch.randn(()))

    def forward(self, windows):
        return super().forward(windows) + self.offset


def test_frozen_parameters_and_buffers_stay_per_member():
    together, _ = fit(Frozen, [0, 1], learning_rate=1e-2)
    for seed, member in enumerate(together):
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            start = Frozen().double()
        assert torch.equal(member.network.layers[1].weight, start.layers[1].weight)
        assert torch.equal(member.network.offset, start.offset)
        assert not torch.allclose(member.network.layers[4].weight, start.layers[4].weight)
        (alone,), _ = fit(Frozen, [seed], learning_rate=1e-2)
        assert np.allclose(flat_weights(alone), flat_weights(member), rtol=0, atol=1e-8)
    assert together[0].n_parameters == 6 + 1


def masked():
    network = nn.Linear(4, 1)
    network.register_buffer("mask", torch.ones(4, dtype=torch.bool))
    return network


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (
            lambda: nn.Sequential(nn.BatchNorm1d(4), nn.Linear(4, 1)),
            r"layer '0' \(BatchNorm1d\) keeps running statistics",
        ),
        (
            masked,
            "buffer 'mask' is torch.bool, no floating point; register it with persistent=False",
        ),
        (nn.Identity, "Identity has no parameters to train"),
        (
            lambda: nn.Sequential(nn.Linear(4, 1), nn.Flatten()),
            r"Sequential maps windows of shape \(64, 8, 4\) to \(64, 8\); it must return one "
            r"lateral velocity a window, \(64,\)",
        ),
    ],
)
@pytest.mark.parametrize("seeds", [[0], [0, 1]])
def test_networks_that_cannot_be_trained_so_are_refused(network, message, seeds):
    with pytest.raises(ConfigurationError, match=message):
        fit(network, seeds)
