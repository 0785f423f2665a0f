"""Names of estimators; a name, never an import path, is what files may hold."""

from __future__ import annotations

import importlib
from functools import cache
from importlib.metadata import entry_points

from vehest.data.errors import ConfigurationError
from vehest.estimators.base import Estimator

ENTRY_POINTS = "vehest.estimators"

BUILT_IN: dict[str, tuple[str, str]] = {
    "luenberger": ("vehest.estimators.luenberger", "Luenberger"),
    "ksnn": ("vehest.estimators.ksnn", "Ksnn"),
    "gru": ("vehest.estimators.gru", "Gru"),
    "lstm": ("vehest.estimators.lstm", "Lstm"),
}


def estimator_names() -> list[str]:
    """Every known name, built in or installed by other packages."""
    return [*BUILT_IN, *sorted(point.name for point in entry_points(group=ENTRY_POINTS) if point.name not in BUILT_IN)]


def estimator_module(name: str) -> str:
    """Name of the module that holds an estimator, without importing it.

    Raises:
        ConfigurationError: the name is unknown.
    """
    if name in BUILT_IN:
        return BUILT_IN[name][0]
    for point in entry_points(group=ENTRY_POINTS):
        if point.name == name:
            return point.module
    raise ConfigurationError(f"estimator '{name}' is not one of: {', '.join(estimator_names())}")


@cache
def estimator_class(name: str) -> type[Estimator]:
    """The class behind a name.

    Raises:
        ConfigurationError: the name is unknown.
    """
    if name in BUILT_IN:
        module, attribute = BUILT_IN[name]
        found: type[Estimator] = getattr(importlib.import_module(module), attribute)
        return found
    for point in entry_points(group=ENTRY_POINTS):
        if point.name == name:
            loaded: type[Estimator] = point.load()
            return loaded
    raise ConfigurationError(f"estimator '{name}' is not one of: {', '.join(estimator_names())}")
