"""The method of a fitted estimator as C99: a header with its state and a source with its step, by the family's template."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, NamedTuple

from vehest.data.channels import channel
from vehest.data.errors import ConfigurationError
from vehest.estimators.base import Estimator
from vehest.estimators.registry import estimator_class, estimator_names
from vehest.export.rendering import Precision, ascii_only, render, render_block


class MethodSource(NamedTuple):
    """``vehest_method.h`` and ``vehest_method.c``."""

    header: str
    source: str


def method_source(estimator: Estimator, precision: Precision) -> MethodSource:
    """Header and source of a fitted estimator's method.

    Raises `ConfigurationError`: the family has no C, or the estimator is not causal or not fitted.
    """
    if not estimator.template:
        raise ConfigurationError(f"estimator '{estimator.name}' cannot be exported to C; these can: {', '.join(exportable())}")
    estimator.online()  # raises where it is not causal, or not fitted
    path = f"methods/{estimator.template}.c.j2"
    beside = Path(str(sys.modules[type(estimator).__module__].__file__)).parent
    refuses = {
        "refuses_nan": [name for name in estimator.channels if "NaN" in estimator.refuses and name not in estimator.skippable],
        "refuses_infinite": estimator.channels if "infinite" in estimator.refuses else (),
        "notes": estimator.notice,
    }
    values = {**_common(estimator), **estimator.c_values(), **refuses}
    state = render_block(path, "state", precision, beside, **values).rstrip()
    header = render("method.h.j2", precision, **values, state=state)
    return MethodSource(header, render(path, precision, beside, **values))


def exportable() -> tuple[str, ...]:
    """Names of families that have C."""
    return tuple(name for name in estimator_names() if estimator_class(name).template)


def _common(estimator: Estimator) -> dict[str, Any]:
    return {
        "title": ascii_only(estimator.full_title),
        "family": estimator.name,
        "variant": estimator.variant,
        "rate_hz": estimator.settings.rate_hz,
        "horizon_steps": estimator.horizon_steps,
        "skippable": estimator.skippable,
        "channels": [(name, ascii_only(channel(name).meaning)) for name in estimator.channels],
    }
