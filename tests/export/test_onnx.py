"""A network in ONNX says, step by step, what Python's stepper says."""

import json

import numpy as np
import pytest
from test_methods import stepped, widened

from every_estimator import drive_for, fitted
from vehest.data.errors import ConfigurationError
from vehest.estimators.registry import estimator_class
from vehest.export.onnx_model import NETWORKS, OPSET, write_onnx

pytestmark = pytest.mark.export

onnx = pytest.importorskip("onnx", reason="ONNX files need onnx: pip install 'vehest[export]'")
pytest.importorskip("onnxscript", reason="ONNX files need onnxscript: pip install 'vehest[export]'")
onnxruntime = pytest.importorskip(
    "onnxruntime", reason="ONNX files are run in onnxruntime: pip install 'vehest[export]'"
)

VARIANTS = [
    *((name, {"window": 8} if name in ("ksnn", "gru", "lstm") else {}) for name in NETWORKS),
    ("ksnn", {"n_hidden": 0, "n_local": 1, "bias": True, "window": 8}),
    ("ksnn", {"n_hidden": 3, "n_local": 4, "bias": True}),
    ("velocity_gru", {"inputs": ["yaw_rate", "ay"], "outputs": ["vy"]}),
    ("velocity_lstm", {"inputs": ["ay", "yaw_rate"], "outputs": ["vy", "vx"]}),
]


class OnnxStepper:
    """A file in onnxruntime, with the states that it says that it begins with."""

    def __init__(self, path):
        self.session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        self.about = self.session.get_modelmeta().custom_metadata_map
        self.dtype = (
            np.float64 if self.session.get_inputs()[0].type == "tensor(double)" else np.float32
        )
        starts = {
            name.removeprefix("start_"): json.loads(text)
            for name, text in self.about.items()
            if name.startswith("start_")
        }
        self.state = {
            f"state_{name}": np.array(values, self.dtype) for name, values in starts.items()
        }
        self.names = [output.name for output in self.session.get_outputs()]

    def step(self, row):
        outputs = dict(
            zip(
                self.names,
                self.session.run(None, {"sample": row.astype(self.dtype), **self.state}),
                strict=True,
            )
        )
        self.state = {
            name.replace("next_", "state_"): values
            for name, values in outputs.items()
            if name.startswith("next_")
        }
        return {
            name: float(values) for name, values in outputs.items() if not name.startswith("next_")
        }


@pytest.mark.parametrize(("name", "config"), VARIANTS, ids=lambda estimate: str(estimate))
@pytest.mark.parametrize(("dtype", "largest"), [("float64", 1e-9), ("float32", 1e-4)])
def test_a_network_runs_in_onnxruntime_as_in_python(name, config, dtype, largest, tmp_path):
    estimator = fitted(name, "float32", **config)
    estimator = widened(estimator) if dtype == "float64" else estimator
    write_onnx(estimator, tmp_path / "model.onnx")
    stepper = OnnxStepper(tmp_path / "model.onnx")
    rows = drive_for(estimator).stack(estimator.channels)[:200]
    estimates = [stepper.step(row) for row in rows]
    expected = stepped(estimator, rows)[0]
    for column, quantity in ((0, "vy"), (1, "vx")):
        if quantity in estimates[0]:
            np.testing.assert_allclose(
                [estimate[quantity] for estimate in estimates],
                expected[:, column],
                rtol=0.0,
                atol=largest,
            )
    assert np.isnan([estimate["vy"] for estimate in estimates]).sum() == estimator.warm_up_steps


def test_onnx_file_describes_itself(tmp_path):
    estimator = fitted("ksnn", "float32", window=8)
    write_onnx(estimator, tmp_path / "model.onnx")
    model = onnx.load(tmp_path / "model.onnx")
    about = {entry.key: entry.value for entry in model.metadata_props}
    assert [opset.version for opset in model.opset_import] == [OPSET]
    assert json.loads(about["channels"]) == {
        "yaw_rate": "rad/s",
        "vx": "m/s",
        "ay": "m/s²",
        "ax": "m/s²",
    }
    assert json.loads(about["outputs"]) == {"vy": "m/s"}
    assert (about["rate_hz"], about["horizon_steps"]) == ("20.0", "1")
    assert "PCT/IT2023/050058" in about["licence"]
    assert b"onnx_model.py" not in (tmp_path / "model.onnx").read_bytes(), (
        "no paths of the machine that wrote it"
    )


def test_estimators_without_a_network_are_refused(tmp_path):
    with pytest.raises(
        ConfigurationError,
        match="estimator 'kalman' is no network that ONNX could hold; these are: ksnn, gru",
    ):
        write_onnx(
            estimator_class("kalman").from_config(
                {"noise": {"yaw_rate": 1e-3, "ay": 0.1, "steer": 1e-3}}
            ),
            tmp_path / "model.onnx",
        )
