"""A small Transformer over windows in plain PyTorch: a network with nothing of vehest's but its standardisation.

Embedding and learnt positions, encoder layers of torch's own, and a read-out of the last sample's encoding (Vaswani et al., NeurIPS 2017).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from vehest.data.errors import ConfigurationError
from vehest.estimators.networks.windowed import StandardisedNetwork, WindowedEstimator, WindowedSettings


@dataclass(frozen=True)
class TransformerSettings(WindowedSettings):
    """Sizes, and how much training drops out."""

    width: int = 16
    heads: int = 2
    layers: int = 1
    dropout: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(self.width, self.heads, self.layers) < 1 or self.width % self.heads:
            raise ConfigurationError("estimator.width, heads and layers must be at least 1, and width a multiple of heads")
        if not 0.0 <= self.dropout < 1.0:
            raise ConfigurationError(f"estimator.dropout must lie between 0 and 1, not at {self.dropout}")


class TransformerNetwork(StandardisedNetwork):
    """Standardised windows (B, N, C) to the lateral velocity one step after them, (B,) [m/s]."""

    def __init__(self, settings: TransformerSettings, n_channels: int) -> None:
        super().__init__(n_channels)
        width, heads, dropout = settings.width, settings.heads, settings.dropout
        self.embed = nn.Linear(n_channels, width)
        self.position = nn.Parameter(0.02 * torch.randn(settings.window, width))
        self.encoder = nn.Sequential(
            *(nn.TransformerEncoderLayer(width, heads, 2 * width, dropout, batch_first=True) for _ in range(settings.layers))
        )
        self.output = nn.Linear(width, 1)

    def forward(self, windows: Tensor) -> Tensor:
        """Read the lateral velocity off the last sample's encoding."""
        encoded = self.encoder(self.embed(windows) + self.position)
        return self.output(encoded[:, -1]).squeeze(-1) * self.output_scale + self.output_mean


class WindowTransformer(WindowedEstimator):
    """The network as an estimator; training, members, estimating, running online and saving come with `WindowedEstimator`."""

    name, title = "window_transformer", "Transformer"
    settings_type = TransformerSettings
    settings: TransformerSettings

    def empty_network(self) -> TransformerNetwork:
        """A network as it is built."""
        return TransformerNetwork(self.settings, len(self.channels))
