"""The KS-NN in C; the method is patented by its authors (PCT/IT2023/050058)."""

from __future__ import annotations

import numpy as np

from vehest.estimators.ksnn import Ksnn
from vehest.export.method import MethodTemplate
from vehest.export.rendering import Precision

PATENT = (
    "The KS-NN is patented by its authors (PCT/IT2023/050058). Using it in a product may need their licence;",
    "the licence of this software grants none.",
)


def ksnn(estimator: Ksnn, precision: Precision) -> MethodTemplate:
    """Its local models and their neurons."""
    s, w = estimator.settings, {name: values.astype(np.float64) for name, values in estimator.weights().items()}
    parts = [w["gamma"], w["beta"], w["linear_weight"]]
    if s.bias:
        parts.append(w["linear_bias"] + (w["output_bias"] if s.n_hidden else 0.0))
    neurons = [w["hidden_weight"], w["output_weight"], *([w["hidden_bias"]] if s.bias else [])] if s.n_hidden else []
    values = {
        "window": s.window,
        "local": s.n_local,
        "active": min(s.n_local, 2),
        "hidden": s.n_hidden,
        "bias": s.bias,
        "step": 1.0 / s.rate_hz,
        "per_width": (s.n_local - 1) / float(w["yaw_rate_max"]),
        "linear": np.concatenate(parts, axis=1),
        "neurons": np.stack(neurons, axis=-1) if neurons else None,
    }
    return MethodTemplate("ksnn", values, notes=PATENT)
