"""The method of a fitted estimator as C99: a header with its state and a source with its step, one template a family."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from vehest.data.channels import channel
from vehest.data.errors import ConfigurationError
from vehest.estimators.base import Estimator
from vehest.export.rendering import Precision, ascii_only, render, render_block

FAMILIES = {
    "zero": "baselines",
    "static_map": "baselines",
    "kinematic": "baselines",
    "data_sheet": "baselines",
    "luenberger": "luenberger",
    "kalman": "kalman",
    "ksnn": "ksnn",
    "gru": "recurrent",
    "lstm": "recurrent",
    "velocity_gru": "recurrent",
    "velocity_lstm": "recurrent",
    "sideslip_ffnn": "sample_networks",
    "rational_ekf": "rational_ekf",
    "learned_ukf": "learned_ukf",
    "dugoff_ukf": "track_ukf",
    "ensemble_ukf": "track_ukf",
    "cnn_ukf": "track_ukf",
}
"""Module of `vehest.export.methods` that exports a family, by the family's name in the registry; its function has that name."""


@dataclass(frozen=True)
class MethodSource:
    """A method in C.

    Args:
        header: vehest_method.h.
        source: vehest_method.c.
        notes: lines for whoever uses it: licences, and where a precision does not suffice.
    """

    header: str
    source: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class MethodTemplate:
    """What a family's module in `vehest.export.methods` returns.

    Args:
        name: template in ``templates/methods``, without ending.
        values: what it needs of the fitted estimator.
        refuses_nan: channels whose absence ends in an error in Python's stepper.
        refuses_infinite: channels whose infinite value does.
        notes: see `MethodSource`; they also stand at the top of the source.
    """

    name: str
    values: Mapping[str, Any]
    refuses_nan: tuple[str, ...] = ()
    refuses_infinite: tuple[str, ...] = ()
    notes: tuple[str, ...] = field(default=())


def method_source(estimator: Estimator, precision: Precision) -> MethodSource:
    """Header and source of a fitted estimator's method.

    Raises:
        ConfigurationError: the family has no C, or the estimator is not causal or not fitted.
    """
    template = _template(estimator, precision)
    path = f"methods/{template.name}.c.j2"
    values = {**_common(estimator), **template.values}
    values |= {
        "refuses_nan": template.refuses_nan,
        "refuses_infinite": template.refuses_infinite,
        "notes": template.notes,
    }
    state = render_block(path, "state", precision, **values).rstrip()
    header = render("method.h.j2", precision, **values, state=state)
    return MethodSource(header, render(path, precision, **values), template.notes)


def types_header(estimator: Estimator, precision: Precision) -> str:
    """vehest_types.h: the type of numbers, and the channels with their units."""
    return render("types.h.j2", precision, **_common(estimator))


def exportable() -> tuple[str, ...]:
    """Names of families that have C."""
    return tuple(FAMILIES)


def _template(estimator: Estimator, precision: Precision) -> MethodTemplate:
    if estimator.name not in FAMILIES:
        raise ConfigurationError(f"estimator '{estimator.name}' cannot be exported to C; these can: {', '.join(FAMILIES)}")
    estimator.online()  # raises where it is not causal, or not fitted
    module = importlib.import_module(f"vehest.export.methods.{FAMILIES[estimator.name]}")
    made: MethodTemplate = getattr(module, estimator.name)(estimator, precision)
    return made


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
