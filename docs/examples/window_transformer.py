"""A small Transformer over windows in plain PyTorch: a network with nothing of vehest's but its standardisation.

Embedding and trained positions, encoder layers of torch's own, and a read-out of the last sample's encoding (Vaswani et al., NeurIPS 2017).
"""

import torch
from torch import Tensor, nn

from vehest.data.errors import ConfigurationError
from vehest.declared import setting
from vehest.estimators.networks.standardised import StandardisedNetwork
from vehest.estimators.networks.windowed import WindowedEstimator


class TransformerNetwork(StandardisedNetwork):
    """Standardised windows (B, N, C) to the lateral velocity one step after them, (B,) [m/s]."""

    def __init__(self, settings, n_channels: int) -> None:
        super().__init__(n_channels)
        width = settings.width
        heads = settings.heads
        dropout = settings.dropout
        self.embed = nn.Linear(n_channels, width)
        self.position = nn.Parameter(0.02 * torch.randn(settings.window, width))
        self.encoder = nn.Sequential(
            *(
                nn.TransformerEncoderLayer(width, heads, 2 * width, dropout, batch_first=True)
                for _ in range(settings.layers)
            )
        )
        self.output = nn.Linear(width, 1)

    def forward(self, windows: Tensor) -> Tensor:
        """Read the lateral velocity off the last sample's encoding."""
        encoded = self.encoder(self.embed(windows) + self.position)
        return self.output(encoded[:, -1]).squeeze(-1) * self.output_scale + self.output_mean


class WindowTransformer(WindowedEstimator):
    """The network as an estimator; training, batched trainings, estimating, running online and saving come with `WindowedEstimator`."""

    name = "window_transformer"
    title = "Transformer"
    width: int = setting(16, "of the encoding of a sample", least=1)
    heads: int = setting(2, "of the attention; width is a multiple of it", least=1)
    layers: int = setting(1, "encoder layers", least=1)
    dropout: float = setting(0.0, "share of activations that training drops", least=0.0, below=1.0)

    def check(self) -> None:
        """All heads have the same width."""
        if self.width % self.heads:
            raise ConfigurationError("estimator.width must be a multiple of estimator.heads")

    def new_network(self) -> TransformerNetwork:
        """A network as it is built."""
        return TransformerNetwork(self.settings, len(self.channels))
