"""The Luenberger observer in C."""

from __future__ import annotations

from vehest.estimators.luenberger import Luenberger
from vehest.export.method import MethodTemplate
from vehest.export.rendering import Precision


def luenberger(estimator: Luenberger, precision: Precision) -> MethodTemplate:
    """Its gain and threshold."""
    values = {"gain": estimator.gain, "threshold": estimator.threshold, "step": 1.0 / estimator.settings.rate_hz}
    return MethodTemplate("luenberger", values)
