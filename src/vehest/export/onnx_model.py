"""Networks as ONNX by torch.onnx.

One step of the estimator, its state going in and coming out, units and channels in the metadata.
"""

from __future__ import annotations

import copy
import json
import logging
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from vehest.data.channels import channel
from vehest.data.errors import ConfigurationError, MissingError
from vehest.estimators.base import Estimator
from vehest.estimators.networks.ksnn import KinematicsStructuredNetwork
from vehest.estimators.networks.sample_network import MAX_SIDESLIP
from vehest.estimators.networks.velocity_recurrent import RecurrentVelocityEstimator
from vehest.estimators.networks.windowed import WindowedEstimator
from vehest.estimators.sideslip_ffnn import SideslipFfnn
from vehest.estimators.velocity_gru import VelocityGru
from vehest.estimators.velocity_lstm import VelocityLstm
from vehest.training.members import prepare

OPSET = 18
"""Version of the ai.onnx operators."""

_UNITS = {"vy": "m/s", "vx": "m/s", "yaw_rate": "rad/s", "sideslip": "rad"}  # output -> unit


def write_onnx(estimator: Estimator, path: str | Path) -> None:
    """Write one step of a network.

    Inputs are ``sample``, (C,) in the order of the estimator's channels [SI], and the state;
    outputs are the quantities of an estimate, () each, ``vy`` [m/s] among them, and the state after
    the sample as ``next_`` and its name. ``start_`` and its name in the metadata says what a state
    begins with, as JSON. Windowed networks give NaN until their window is full, as in Python.
    Numbers have the precision of the training. ``state_started`` of the velocity LSTM is 0 before
    the first sample, whose measured velocities it starts from.

    Raises
    ------
    ConfigurationError
        The estimator is no network.
    MissingError
        The package onnx or onnxscript is not installed.
    """
    if estimator.name not in NETWORKS:
        raise ConfigurationError(
            f"estimator '{estimator.name}' is no network that ONNX could hold; these are: "
            f"{', '.join(NETWORKS)}"
        )
    try:
        import onnx
        from onnxscript import ir
    except ImportError:
        raise MissingError(
            "ONNX files need onnx and onnxscript: pip install 'vehest[export]'"
        ) from None
    step = _STEPS[estimator.name](estimator)
    sample = torch.zeros(len(estimator.channels), dtype=next(step.parameters()).dtype)
    states = {name: start.to(sample.dtype) for name, start in step.starts.items()}
    with warnings.catch_warnings(action="ignore"):
        logging.disable(logging.WARNING)  # torch names packages that it does without
        try:
            program = torch.onnx.export(
                step.eval(),
                (sample, *states.values()),
                input_names=["sample", *(f"state_{name}" for name in states)],
                output_names=[*step.outputs, *(f"next_{name}" for name in states)],
                opset_version=OPSET,
                dynamo=True,
                verbose=False,
            )
        finally:
            logging.disable(logging.NOTSET)
    assert program is not None
    # where in the sources each node comes from
    ir.passes.common.ClearMetadataAndDocStringPass()(program.model)
    about = {
        "estimator": estimator.name,
        "variant": estimator.variant,
        "rate_hz": repr(estimator.settings.rate_hz),
        "horizon_steps": str(estimator.horizon_steps),
        "channels": json.dumps(
            {name: channel(name).unit for name in estimator.channels}, ensure_ascii=False
        ),
        "outputs": json.dumps({name: _UNITS[name] for name in step.outputs}),
        **{f"start_{name}": json.dumps(start.tolist()) for name, start in states.items()},
        **({"licence": " ".join(estimator.notice)} if estimator.notice else {}),
    }
    program.model.metadata_props.update(about)
    onnx.checker.check_model(program.model_proto, full_check=True)
    program.save(str(path))


class _Step(nn.Module):
    """One step, from a sample (C,) and states to quantities () and states.

    Parameters
    ----------
    network
        Of the estimator.
    outputs
        Names of the quantities.
    starts
        States before the first sample, by name.
    """

    def __init__(
        self, network: nn.Module, outputs: tuple[str, ...], starts: dict[str, Tensor]
    ) -> None:
        super().__init__()
        self.network: Any = network
        self.outputs = outputs
        self.starts = starts


class _WindowStep(_Step):
    """Step of a windowed network: the window moves by one row, and the network runs over it.

    The window starts with NaN, and its sum, times 0, is added to the result, so that the estimate
    is NaN until every row has been measured.
    """

    def __init__(self, estimator: WindowedEstimator) -> None:
        network = copy.deepcopy(estimator.network)
        if isinstance(network, KinematicsStructuredNetwork):
            # a plain number would be rounded to float
            exact_step = torch.tensor(network.step, dtype=network.gamma.dtype)
            network.step = exact_step  # type: ignore[assignment]
        super().__init__(
            network,
            ("vy",),
            {"window": torch.full((estimator.settings.window, len(estimator.channels)), torch.nan)},
        )

    def forward(self, sample: Tensor, window: Tensor) -> tuple[Tensor, ...]:
        """Map sample (C,) and window (N, C) to vy () and the next window."""
        window = torch.cat([window[1:], sample.unsqueeze(0)])
        return self.network(prepare(self.network, window)) + 0.0 * window.sum(), window


class _VelocityStep(_Step):
    """Base of the steps of velocity networks: by the cells of the recurrent layers, since
    onnxruntime has layers in float only.
    """

    def __init__(self, estimator: RecurrentVelocityEstimator, **starts: int) -> None:
        s = estimator.settings
        super().__init__(
            estimator.network, s.outputs, {name: torch.zeros(size) for name, size in starts.items()}
        )
        self.input_columns = [estimator.channels.index(name) for name in s.inputs]

    def _driven(self, sample: Tensor) -> tuple[Tensor, ...]:
        """Arguments of a cell besides its state: the standardised sample, and weights."""
        return ((sample[self.input_columns] - self.network.input_mean) / self.network.input_scale)[
            None
        ], *self.network.recurrent.parameters()

    def _velocities(self, standardised: Tensor) -> tuple[Tensor, ...]:
        """Velocities in SI units from standardised ones (outputs,), one tensor each."""
        return (standardised * self.network.output_scale + self.network.output_mean).unbind()


class _GruStep(_VelocityStep):
    """Step of `VelocityGruNetwork`, with the hidden state ``h`` (H,)."""

    slope: Tensor  # slope of the velocities' activation (PReLU) below zero, (1,)

    def __init__(self, estimator: VelocityGru) -> None:
        super().__init__(estimator, h=estimator.settings.n_states)
        self.register_buffer(
            "slope", self.network.output_mean.new_tensor([estimator.settings.negative_slope])
        )

    def forward(self, sample: Tensor, h: Tensor) -> tuple[Tensor, ...]:
        """Map sample (C,) and hidden state to velocities () and the next hidden state."""
        x, *weights = self._driven(sample)
        h = torch.gru_cell(x, h[None], *weights)[0]
        return *self._velocities(nn.functional.prelu(self.network.read_out(h), self.slope)), h


class _LstmStep(_VelocityStep):
    """Step of `VelocityLstmNetwork`.

    States are ``h`` and ``c`` (H,), ``y``, the last standardised velocities (outputs,), and
    ``started`` (1,), 0 before the first sample. The first step begins with the velocities that are
    measured, 0 for the lateral one.
    """

    is_measured: Tensor  # 1 for each output that is a measured channel, else 0

    def __init__(self, estimator: VelocityLstm) -> None:
        s = estimator.settings
        super().__init__(estimator, h=s.n_states, c=s.n_states, y=len(s.outputs), started=1)
        measured = {name for name in estimator.channels if name != "vy"}
        self.measured = [
            estimator.channels.index(name) if name in measured else 0 for name in s.outputs
        ]
        is_measured = [name in measured for name in s.outputs]
        self.register_buffer("is_measured", self.network.output_mean.new_tensor(is_measured))

    def forward(
        self, sample: Tensor, h: Tensor, c: Tensor, y: Tensor, started: Tensor
    ) -> tuple[Tensor, ...]:
        """Map sample (C,) and states to velocities () and the next states."""
        first = (
            sample[self.measured] * self.is_measured - self.network.output_mean
        ) / self.network.output_scale
        x, *weights = self._driven(sample)
        h, c = (batch[0] for batch in torch.lstm_cell(x, (h[None], c[None]), *weights))
        hidden = torch.relu(
            self.network.dense(torch.cat([h, torch.where(started > 0.0, y, first)]))
        )
        y = self.network.read_out(hidden)
        return *self._velocities(y), h, c, y, torch.ones_like(started)


class _SampleStep(_Step):
    """Step of `SampleNetwork`, layer by layer, and v = u tan β."""

    def __init__(self, estimator: SideslipFfnn) -> None:
        super().__init__(estimator.network, ("vy", "sideslip"), {})
        self.speed = estimator.channels.index("vx")

    def forward(self, sample: Tensor) -> tuple[Tensor, ...]:
        """Map sample (C,) to vy () [m/s] and sideslip () [rad]; there is no state."""
        w1, b1, w2, b2, w3, b3 = (parameter[0] for parameter in self.network.parameters())
        hidden = torch.relu(torch.relu(self.network.scaled(sample) @ w1 + b1) @ w2 + b2)
        sideslip = ((hidden @ w3 + b3)[0] * self.network.unit).clamp(-MAX_SIDESLIP, MAX_SIDESLIP)
        # onnxruntime has no Tan of double
        return sample[self.speed] * torch.sin(sideslip) / torch.cos(sideslip), sideslip


# family -> class of its step
_STEPS: dict[str, Any] = {
    "ksnn": _WindowStep,
    "gru": _WindowStep,
    "lstm": _WindowStep,
    "velocity_gru": _GruStep,
    "velocity_lstm": _LstmStep,
    "sideslip_ffnn": _SampleStep,
}
NETWORKS = tuple(_STEPS)  # families that can be written as ONNX
