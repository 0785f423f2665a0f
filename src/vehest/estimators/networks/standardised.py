"""Networks that receive standardised measurements and predict standardised velocities."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from vehest.data.recording import Recording


class StandardisedNetwork(nn.Module):
    """Base of networks that read standardised measurements and predict standardised velocities.

    Means and standard deviations are those of the training recordings; they are kept with the
    weights and are not parameters. `prepared` standardises the inputs of ``forward``; what it
    predicts goes back to SI units by ``output * self.output_scale + self.output_mean``. The shape
    of what is predicted of one instant is ``outputs``.
    """

    input_mean: Tensor  # mean of each channel in training, (C,) [SI]
    input_scale: Tensor  # standard deviation of each channel in training, (C,) [SI]
    output_mean: Tensor  # mean of each prediction in training, of the shape ``outputs`` [SI]
    output_scale: Tensor  # standard deviation of each prediction in training, likewise

    def __init__(self, n_channels: int, outputs: tuple[int, ...] = ()) -> None:
        super().__init__()
        for name, shape in (("input", (n_channels,)), ("output", outputs)):
            self.register_buffer(f"{name}_mean", torch.zeros(shape))
            self.register_buffer(f"{name}_scale", torch.ones(shape))

    def standardise(
        self,
        train: Sequence[Recording],
        channels: Sequence[str],
        references: Sequence[str] = ("vy_ref",),
    ) -> None:
        """Take means and standard deviations from recordings.

        Parameters
        ----------
        train : sequence of Recording
            Taken together, sample by sample.
        channels, references : sequence of str
            Inputs (C of them), and what is predicted. A deviation is at least 1e-6, in the
            channel's unit.
        """
        parts = (
            (self.input_mean, self.input_scale, channels),
            (self.output_mean, self.output_scale, references),
        )
        for mean, scale, names in parts:
            samples = np.concatenate([recording.stack(names) for recording in train])
            mean.copy_(torch.as_tensor(samples.mean(axis=0)).reshape(mean.shape))
            scale.copy_(torch.as_tensor(np.maximum(samples.std(axis=0), 1e-6)).reshape(scale.shape))

    def prepared(self, series: Tensor) -> Tensor:
        """Standardise measurements, (..., C), as ``forward`` takes them."""
        return (series - self.input_mean) / self.input_scale
