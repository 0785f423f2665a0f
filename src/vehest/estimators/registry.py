"""Names of estimators; a name, never an import path, is what files may hold.

An estimator called ``name`` is the module ``vehest.estimators.name`` with its class as ``ESTIMATOR``, or an entry point of
another package in the group ``vehest.estimators``.
"""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from importlib.metadata import entry_points

import vehest.estimators as package
from vehest.data.errors import ConfigurationError, printable
from vehest.data.text_files import first_line
from vehest.estimators.base import Estimator

ENTRY_POINTS = "vehest.estimators"


@cache
def estimator_names() -> list[str]:
    """Every known name: vehest's own, then those that other packages installed."""
    own = [
        module.name
        for module in pkgutil.iter_modules(package.__path__)
        if _own_class(module.name) is not None
    ]
    return [
        *sorted(own),
        *sorted(point.name for point in entry_points(group=ENTRY_POINTS) if point.name not in own),
    ]


@cache
def estimator_class(name: str) -> type[Estimator]:
    """The class behind a name; raises `ConfigurationError`: the name is unknown."""
    own = _own_class(name)
    if own is not None:
        return own
    points = entry_points(group=ENTRY_POINTS, name=name)
    if points:
        try:
            loaded: type[Estimator] = next(iter(points)).load()
        except Exception as error:  # a package may raise anything when it is imported
            what = f"{type(error).__name__}: {printable(first_line(error))}"
            raise ConfigurationError(
                f"estimator '{name}' of another package cannot be loaded ({what}); repair or remove it"
            ) from error
        return loaded
    raise ConfigurationError(f"estimator '{name}' is not one of: {', '.join(estimator_names())}")


def _own_class(name: str) -> type[Estimator] | None:
    if name not in {module.name for module in pkgutil.iter_modules(package.__path__)}:
        return None
    found: type[Estimator] | None = getattr(
        importlib.import_module(f"{package.__name__}.{name}"), "ESTIMATOR", None
    )
    return found
