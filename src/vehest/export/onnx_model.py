"""Networks as ONNX: one step of the estimator, its state going in and coming out, units and channels in the metadata.

Built node by node with `onnx.helper`, not traced: what is exported is what the C says, and its nodes carry names that can be read.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vehest.data.channels import channel
from vehest.data.errors import ConfigurationError, MissingError
from vehest.estimators.base import Estimator
from vehest.estimators.ksnn import Ksnn
from vehest.estimators.networks.recurrent import RecurrentEstimator
from vehest.estimators.networks.sample_network import STEEPEST
from vehest.estimators.networks.velocity_recurrent import RecurrentVelocityEstimator
from vehest.estimators.networks.windowed import WindowedEstimator
from vehest.estimators.sideslip_ffnn import SideslipFfnn
from vehest.estimators.velocity_gru import VelocityGru

OPSET, IR_VERSION = 18, 9
"""Of the ai.onnx operators and of the file: both are read by onnxruntime from 1.15 on."""

_UNITS = {"vy": "m/s", "vx": "m/s", "yaw_rate": "rad/s", "sideslip": "rad"}

NETWORKS = ("ksnn", "gru", "lstm", "velocity_gru", "velocity_lstm", "sideslip_ffnn")


def write_onnx(estimator: Estimator, path: str | Path) -> None:
    """Write one step of a network.

    Inputs are ``sample``, (C,) in the order of the estimator's channels [SI], and the state; outputs are the quantities of an estimate, ()
    each, ``vy`` [m/s] among them, and the state after the sample as ``next_`` and its name. ``start_`` and its name in the metadata says
    what a state begins with, as JSON. Windowed networks give NaN until their window is full, as in Python. Numbers have the precision of
    the training. ``state_started`` of the velocity LSTM is 0 before the first sample, whose measured velocities it starts from.

    Raises:
        ConfigurationError: the estimator is no network.
        MissingError: onnx is not installed.
    """
    try:
        import onnx
    except ImportError:
        raise MissingError("ONNX files need onnx: pip install 'vehest[export]'") from None
    if isinstance(estimator, Ksnn):
        graph = _ksnn(estimator)
    elif isinstance(estimator, RecurrentEstimator):
        graph = _windowed_recurrent(estimator)
    elif isinstance(estimator, RecurrentVelocityEstimator):
        graph = _velocities(estimator)
    elif isinstance(estimator, SideslipFfnn):
        graph = _samples(estimator)
    else:
        raise ConfigurationError(f"estimator '{estimator.name}' is no network that ONNX could hold; these are: {', '.join(NETWORKS)}")
    onnx.save_model(graph.model(estimator), str(path))


class Graph:
    """A graph that grows node by node.

    Args:
        weights: of the network, whose precision is that of all numbers.
        n_channels: of a sample.
    """

    def __init__(self, weights: dict[str, np.ndarray[Any, Any]], n_channels: int) -> None:
        from onnx import helper

        self._helper = helper
        self.dtype = next(iter(weights.values())).dtype
        self.type = helper.np_dtype_to_tensor_dtype(self.dtype)
        self.nodes: list[Any] = []
        self.constants: dict[str, Any] = {}
        self.inputs = {"sample": (n_channels,)}
        self.outputs: dict[str, tuple[int, ...]] = {}
        self.starts: dict[str, list[Any]] = {}

    def constant(self, name: str, values: Any, *, integer: bool = False) -> str:
        """A number or table that is part of the file."""
        from onnx import numpy_helper

        self.constants[name] = numpy_helper.from_array(np.asarray(values, np.int64 if integer else self.dtype), name)
        return name

    def add(self, kind: str, inputs: Sequence[str], name: str, **attributes: Any) -> str:
        """A node with one output, which gives it its name."""
        self.nodes.append(self._helper.make_node(kind, list(inputs), [name], name=name, **attributes))
        return name

    def scalar(self, value: float) -> str:
        """A constant ()."""
        return self.constant(f"number_{value!r}", value)

    def number(self, value: int) -> str:
        """A constant of integers, (1,)."""
        return self.constant(f"index_{value}", [value], integer=True)

    def at(self, table: str, row: int, name: str) -> str:
        """One row of a table, or one number of a row."""
        return self.add("Gather", [table, self.constant(f"place_{row}", row, integer=True)], name, axis=0)

    def state(self, name: str, start: np.ndarray[Any, Any]) -> str:
        """A state that goes in; see `keep`."""
        self.inputs[f"state_{name}"] = start.shape
        self.starts[f"start_{name}"] = start.tolist()
        return f"state_{name}"

    def keep(self, name: str, value: str) -> None:
        """The state after the sample."""
        self.add("Identity", [value], f"next_{name}")
        self.outputs[f"next_{name}"] = self.inputs[f"state_{name}"]

    def give(self, name: str, value: str) -> None:
        """A quantity of the estimate, ()."""
        self.add("Reshape", [value, self.constant("no_dimension", np.zeros(0), integer=True)], name)
        self.outputs[name] = ()

    def affine(self, weight: str, values: str, offset: str, name: str) -> str:
        """W x + b."""
        return self.add("Add", [self.add("MatMul", [weight, values], f"{name}_product"), offset], name)

    def window(self, rows: str, n_window: int, start: np.ndarray[Any, Any]) -> str:
        """The last N rows, (N, …), the newest last; ``rows`` is the new one, (1, …)."""
        before = self.state("window", start)
        starts = [self.number(1), self.number(n_window), self.number(0)]
        older = self.add("Slice", [before, *starts], "older_rows")
        whole = self.add("Concat", [older, rows], "window", axis=0)
        self.keep("window", whole)
        return whole

    def model(self, estimator: Estimator) -> Any:
        """The file: inputs, outputs, opset, and what everything is."""
        helper = self._helper
        values = {
            part: [helper.make_tensor_value_info(name, self.type, shape) for name, shape in shapes.items()]
            for part, shapes in (("inputs", self.inputs), ("outputs", self.outputs))
        }
        graph = helper.make_graph(self.nodes, f"{estimator.name} step", values["inputs"], values["outputs"], list(self.constants.values()))
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="vehest", ir_version=IR_VERSION)
        quantities = {name: _UNITS[name] for name, shape in self.outputs.items() if not shape}
        helper.set_model_props(
            model,
            {
                "estimator": estimator.name,
                "variant": estimator.variant,
                "rate_hz": repr(estimator.settings.rate_hz),
                "horizon_steps": str(estimator.horizon_steps),
                "channels": json.dumps({name: channel(name).unit for name in estimator.channels}, ensure_ascii=False),
                "outputs": json.dumps(quantities),
                **{name: json.dumps(start) for name, start in self.starts.items()},
                **({"licence": " ".join(estimator.notice)} if estimator.notice else {}),
            },
        )
        _check(model)
        return model


def _check(model: Any) -> None:
    import onnx

    onnx.checker.check_model(model, full_check=True)


def _graph(estimator: WindowedEstimator | RecurrentVelocityEstimator | SideslipFfnn) -> tuple[Graph, dict[str, np.ndarray[Any, Any]]]:
    weights = estimator.weights()
    return Graph(weights, len(estimator.channels)), weights


def _filled(g: Graph, whole: str, vy: str) -> str:
    """NaN while rows of the window are NaN: those that it started with."""
    return g.add("Add", [vy, g.add("Mul", [g.add("ReduceSum", [whole], "all_rows", keepdims=0), g.scalar(0.0)], "nothing")], "filled")


def _ksnn(estimator: Ksnn) -> Graph:
    """Da Lio et al. 2023, Eqs. 7 to 9, unrolled over the window; patented (PCT/IT2023/050058)."""
    s, (g, w) = estimator.settings, _graph(estimator)
    row = g.add("Unsqueeze", ["sample", g.number(0)], "row")
    whole = g.window(row, s.window, np.full((s.window, 4), np.nan))
    turned = g.add("Transpose", [whole], "columns", perm=[1, 0])
    columns = [g.at(turned, k, f"all_{name}") for k, name in enumerate(estimator.channels)]
    omega, speed, ay, ax = columns
    for name in ("gamma", "beta", "linear_weight", "linear_bias", "output_bias"):
        if name in w:
            for k in (0, 1):
                g.constant(f"{name}_{k}", w[name][:, k])
    per_width = (s.n_local - 1) / w["yaw_rate_max"]
    position = g.add("Mul", [g.add("Abs", [omega], "turning"), g.constant("per_width", per_width)], "free_position")
    position = g.add("Min", [position, g.scalar(float(s.n_local - 1))], "position")
    away = g.add(
        "Sub", [g.add("Unsqueeze", [position, g.number(1)], "position_column"), g.constant("centres", np.arange(s.n_local))], "away"
    )
    away = g.add("Abs", [away], "distance")
    phi_all = g.add("Max", [g.add("Sub", [g.scalar(1.0), away], "share"), g.scalar(0.0)], "phi")
    tau = g.constant("tau", 1.0 / s.rate_hz)
    forced_all = g.add("Mul", [g.add("Sub", [ay, g.add("Mul", [speed, omega], "centripetal")], "rate"), tau], "slip")
    v, u = g.scalar(0.0), g.at(speed, 0, "u_start")
    for k in range(s.window):
        turn, um, phi, slip, along = (
            g.at(values, k, f"{name}_{k}")
            for values, name in ((omega, "omega"), (speed, "speed"), (phi_all, "phi"), (forced_all, "slip"), (ax, "ax"))
        )
        error = g.add("Sub", [u, um], f"error_{k}")
        f1, f2 = (_feedback(g, estimator, w, error, i, k) for i in (0, 1))
        thrust = g.add("Mul", [tau, g.add("Add", [along, g.add("Mul", [v, turn], f"coriolis_{k}")], f"push_{k}")], f"thrust_{k}")
        local_v = g.add(
            "Add", [g.add("Mul", ["gamma_0", v], f"kept_v_{k}"), g.add("Mul", ["beta_0", slip], f"forced_v_{k}")], f"free_v_{k}"
        )
        local_v = g.add("Sub", [local_v, g.add("Mul", [turn, f1], f"back_v_{k}")], f"local_v_{k}")
        local_u = g.add(
            "Add", [g.add("Mul", ["gamma_1", u], f"kept_u_{k}"), g.add("Mul", ["beta_1", thrust], f"forced_u_{k}")], f"free_u_{k}"
        )
        local_u = g.add("Sub", [local_u, f2], f"local_u_{k}")
        v = g.add("ReduceSum", [g.add("Mul", [phi, local_v], f"share_v_{k}")], f"v_{k}", keepdims=0)
        u = g.add("ReduceSum", [g.add("Mul", [phi, local_u], f"share_u_{k}")], f"u_{k}", keepdims=0)
    g.give("vy", _filled(g, whole, v))
    return g


def _feedback(g: Graph, estimator: Ksnn, w: dict[str, np.ndarray[Any, Any]], error: str, i: int, k: int) -> str:
    """f₁ or f₂ of every local model, (P,) (Eq. 8)."""
    at = f"{i}_{k}"
    value = g.add("Mul", [f"linear_weight_{i}", error], f"linear_{at}")
    if "linear_bias" in w:
        value = g.add("Add", [value, f"linear_bias_{i}"], f"offset_{at}")
    if not estimator.settings.n_hidden:
        return value
    inner = g.add("Mul", [g.constant(f"hidden_weight_{i}", w["hidden_weight"][:, i]), error], f"inner_{at}")
    if "hidden_bias" in w:
        inner = g.add("Add", [inner, g.constant(f"hidden_bias_{i}", w["hidden_bias"][:, i])], f"inner_offset_{at}")
    bent = g.add("Mul", [g.constant(f"output_weight_{i}", w["output_weight"][:, i]), g.add("Tanh", [inner], f"tanh_{at}")], f"bent_{at}")
    value = g.add("Add", [value, g.add("ReduceSum", [bent, g.number(1)], f"neurons_{at}", keepdims=0)], f"feedback_{at}")
    return g.add("Add", [value, f"output_bias_{i}"], f"feedback_offset_{at}") if "output_bias" in w else value


def _standardised(g: Graph, values: str, w: dict[str, np.ndarray[Any, Any]]) -> str:
    centred = g.add("Sub", [values, g.constant("input_mean", w["input_mean"])], "centred")
    return g.add("Div", [centred, g.constant("input_scale", w["input_scale"])], "standardised")


def _gate(g: Graph, values: str, kind: str, first: int, size: int, name: str) -> str:
    """A piece of a row of gates, squashed by Sigmoid or Tanh."""
    piece = g.add("Slice", [values, g.number(first), g.number(first + size), g.number(0)], f"{name}_argument")
    return g.add(kind, [piece], name)


def _gru_step(g: Graph, driven: str, recurrent: str, h: str, size: int, at: str) -> str:
    """h⁺ = n + z ∘ (h - n) of rows of gates r, z, n, (3H,) each."""
    total = g.add("Add", [driven, recurrent], f"total{at}")
    reset = _gate(g, total, "Sigmoid", 0, size, f"reset{at}")
    update = _gate(g, total, "Sigmoid", size, size, f"update{at}")
    own, through = (_gate(g, part, "Identity", 2 * size, size, f"{name}{at}") for part, name in ((driven, "offer"), (recurrent, "memory")))
    candidate = g.add("Tanh", [g.add("Add", [own, g.add("Mul", [reset, through], f"through{at}")], f"open{at}")], f"candidate{at}")
    kept = g.add("Mul", [update, g.add("Sub", [h, candidate], f"change{at}")], f"kept{at}")
    return g.add("Add", [candidate, kept], f"h{at}")


def _lstm_step(g: Graph, total: str, c: str, size: int, order: str, at: str) -> tuple[str, str]:
    """h⁺ and c⁺ of a row of gates, (4H,), in an order of i, f, g, o."""
    kinds = {"i": "Sigmoid", "f": "Sigmoid", "g": "Tanh", "o": "Sigmoid"}
    gates = {letter: _gate(g, total, kinds[letter], place * size, size, f"gate_{letter}{at}") for place, letter in enumerate(order)}
    cell = g.add("Add", [g.add("Mul", [gates["f"], c], f"kept{at}"), g.add("Mul", [gates["i"], gates["g"]], f"admitted{at}")], f"c{at}")
    return g.add("Mul", [gates["o"], g.add("Tanh", [cell], f"shown{at}")], f"h{at}"), cell


def _windowed_recurrent(estimator: RecurrentEstimator) -> Graph:
    """`GruNetwork` or `LstmNetwork`, unrolled over the window; W x + b of a sample is computed once."""
    s, (g, w) = estimator.settings, _graph(estimator)
    gates, size, _ = w["input_weight"].shape
    weight = g.constant("W", w["input_weight"].reshape(gates * size, -1))
    driven = g.affine(weight, _standardised(g, "sample", w), g.constant("b", w["gate_bias"].ravel()), "driven")
    row = g.add("Unsqueeze", [driven, g.number(0)], "row")
    whole = g.window(row, s.window, np.full((s.window, gates * size), np.nan))
    memory = g.constant("U", w["state_weight"].reshape(gates * size, size))
    h = c = g.constant("zero_state", np.zeros(size))
    for k in range(s.window):
        driven, recurrent = g.at(whole, k, f"driven_{k}"), g.add("MatMul", [memory, h], f"recurrent_{k}")
        if estimator.name == "gru":
            h = _gru_step(g, driven, recurrent, h, size, f"_{k}")
        else:
            h, c = _lstm_step(g, g.add("Add", [driven, recurrent], f"total_{k}"), c, size, "ifog", f"_{k}")
    read = g.add("ReduceSum", [g.add("Mul", [h, g.constant("output_weight", w["output_weight"])], "weighted")], "read", keepdims=0)
    read = g.add("Add", [read, g.constant("output_bias", w["output_bias"])], "read_out")
    scaled = g.add("Mul", [read, g.constant("output_scale", w["output_scale"])], "scaled")
    g.give("vy", _filled(g, whole, g.add("Add", [scaled, g.constant("output_mean", w["output_mean"])], "velocity")))
    return g


def _velocities(estimator: RecurrentVelocityEstimator) -> Graph:
    """`VelocityGruNetwork` or `VelocityLstmNetwork`, one sample."""
    s, (g, w) = estimator.settings, _graph(estimator)
    places = g.constant("seen", [estimator.channels.index(name) for name in s.inputs], integer=True)
    x = _standardised(g, g.add("Gather", ["sample", places], "measured", axis=0), w)
    h = g.state("h", np.zeros(s.n_states))
    driven, recurrent = (
        g.affine(
            g.constant(f"weight_{part}", w[f"recurrent.weight_{part}_l0"]),
            of,
            g.constant(f"bias_{part}", w[f"recurrent.bias_{part}_l0"]),
            name,
        )
        for part, of, name in (("ih", x, "driven"), ("hh", h, "recurrent"))
    )
    read_out = [g.constant("read_out_weight", w["read_out.weight"]), g.constant("read_out_bias", w["read_out.bias"])]
    if isinstance(estimator, VelocityGru):
        h = _gru_step(g, driven, recurrent, h, s.n_states, "_new")
        slope = g.scalar(estimator.settings.negative_slope)  # PRelu: the slope of LeakyRelu is an attribute, and so a float
        y = g.add("PRelu", [g.affine(read_out[0], h, read_out[1], "read_out"), slope], "standardised_velocities")
    else:
        h, c = _lstm_step(g, g.add("Add", [driven, recurrent], "total"), g.state("c", np.zeros(s.n_states)), s.n_states, "ifgo", "_new")
        g.keep("c", c)
        joined = g.add("Concat", [h, _fed_back(g, estimator, w)], "joined", axis=0)
        dense = g.affine(g.constant("dense_weight", w["dense.weight"]), joined, g.constant("dense_bias", w["dense.bias"]), "dense")
        y = g.affine(read_out[0], g.add("Relu", [dense], "hidden"), read_out[1], "standardised_velocities")
        g.keep("y", y)
        g.keep("started", g.constant("begun", np.ones(1)))
    g.keep("h", h)
    scaled = g.add("Mul", [y, g.constant("output_scale", w["output_scale"])], "scaled")
    velocities = g.add("Add", [scaled, g.constant("output_mean", w["output_mean"])], "velocities")
    for place, name in enumerate(s.outputs):
        g.give(name, g.at(velocities, place, f"velocity_{name}"))
    return g


def _fed_back(g: Graph, estimator: RecurrentVelocityEstimator, w: dict[str, np.ndarray[Any, Any]]) -> str:
    """The estimate before; before the first sample what is measured, 0 for the lateral velocity."""
    s = estimator.settings
    y, started = g.state("y", np.zeros(len(s.outputs))), g.state("started", np.zeros(1))
    known = [name in estimator.channels and name != "vy" for name in s.outputs]
    places = [estimator.channels.index(name) if own else 0 for name, own in zip(s.outputs, known, strict=True)]
    measured = g.add("Gather", ["sample", g.constant("start_places", places, integer=True)], "start_samples", axis=0)
    measured = g.add("Mul", [measured, g.constant("start_known", known)], "start_velocities")
    centred = g.add("Sub", [measured, g.constant("start_mean", w["output_mean"])], "start_centred")
    first = g.add("Div", [centred, g.constant("start_scale", w["output_scale"])], "start_standardised")
    return g.add("Where", [g.add("Greater", [started, g.scalar(0.0)], "has_started"), y, first], "before")


def _samples(estimator: SideslipFfnn) -> Graph:
    """`SampleNetwork` and v = u tan β."""
    g, w = _graph(estimator)
    scaled = g.add("Sub", ["sample", g.constant("input_low", w["input_low"])], "from_low")
    values = g.add("Div", [scaled, g.constant("input_span", w["input_span"])], "scaled")
    for layer in (1, 2, 3):
        weight, offset = g.constant(f"weight_{layer}", w[f"weight_{layer}"][0].T), g.constant(f"bias_{layer}", w[f"bias_{layer}"][0])
        values = g.affine(weight, values, offset, f"layer_{layer}")
        values = values if layer == 3 else g.add("Relu", [values], f"hidden_{layer}")
    angle = g.add("Mul", [values, g.constant("unit", w["unit"])], "angle")
    beta = g.add("Clip", [angle, g.scalar(-STEEPEST), g.scalar(STEEPEST)], "believed")
    speed = g.at("sample", estimator.channels.index("vx"), "speed")
    tangent = g.add("Div", [g.add("Sin", [beta], "sine"), g.add("Cos", [beta], "cosine")], "tangent")  # onnxruntime has no Tan of double
    g.give("vy", g.add("Mul", [speed, tangent], "velocity"))
    g.give("sideslip", beta)
    return g
