"""Names of estimators; a name, never an import path, is what files may hold.

An estimator called ``name`` is the module ``vehest.estimators.name`` with its class as
``ESTIMATOR``, or an entry point of another package in the group ``vehest.estimators``.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields
from functools import cache
from importlib.metadata import entry_points
from typing import Any

import vehest.estimators as package
from vehest.data.errors import ConfigurationError, VehestError, printable
from vehest.data.text_files import first_line
from vehest.estimators.base import Estimator

ENTRY_POINTS = "vehest.estimators"  # group of entry points of other packages' estimators


@cache
def estimator_names() -> list[str]:
    """Every known name: vehest's own, then those that other packages installed."""
    module_names = [
        module.name
        for module in pkgutil.iter_modules(package.__path__)
        if _class_of_module(module.name) is not None
    ]
    return [
        *sorted(module_names),
        *sorted(
            point.name
            for point in entry_points(group=ENTRY_POINTS)
            if point.name not in module_names
        ),
    ]


@cache
def estimator_class(name: str) -> type[Estimator]:
    """The class behind a name.

    Raises `ConfigurationError` where the name is unknown, or an estimator of another package cannot
    be loaded.
    """
    module_class = _class_of_module(name)
    if module_class is not None:
        return module_class
    points = entry_points(group=ENTRY_POINTS, name=name)
    if points:
        try:
            loaded = next(iter(points)).load()
            if not (isinstance(loaded, type) and issubclass(loaded, Estimator)):
                raise TypeError(f"{loaded!r} is no class derived from Estimator")
        except Exception as error:  # a package may raise anything when it is imported
            raise plugin_failure(name, "loaded", error) from error
        return loaded
    raise ConfigurationError(f"estimator '{name}' is not one of: {', '.join(estimator_names())}")


def estimator_classes() -> dict[str, type[Estimator]]:
    """Name -> class of all estimators but those of other packages that cannot be loaded."""
    classes = {}
    for name in estimator_names():
        with suppress(ConfigurationError):
            classes[name] = estimator_class(name)
    return classes


def new_estimator(config: Mapping[str, Any]) -> Estimator:
    """An estimator before its fit; raises `ConfigurationError` for an unknown name or setting."""
    name = str(config["name"])
    try:
        return estimator_class(name).from_config(config)
    except VehestError:
        raise
    except Exception as error:
        if is_plugin(name):
            raise plugin_failure(name, "made", error) from error
        raise


def option_names() -> dict[str, list[str]]:
    """Estimator -> names of its settings, as options without ``estimator.``."""
    return {
        name: [entry.name for entry in fields(estimator.settings_type)]
        for name, estimator in estimator_classes().items()
    }


def is_plugin(name: str) -> bool:
    """Whether an estimator comes from another package, which may raise anything."""
    return _class_of_module(name) is None


def plugin_failure(name: str, failed: str, error: Exception) -> ConfigurationError:
    """The error to raise where an estimator of another package fails; ``failed`` is the participle
    of what cannot be done, such as "loaded".
    """
    reason = f"{type(error).__name__}: {printable(first_line(error))}"
    return ConfigurationError(
        f"estimator '{name}' of another package cannot be {failed} ({reason}); repair or remove it"
    )


def _class_of_module(name: str) -> type[Estimator] | None:
    """The class of a module of this package, or None where there is no such module or it has no
    ``ESTIMATOR``.
    """
    if name not in {module.name for module in pkgutil.iter_modules(package.__path__)}:
        return None
    loaded_class: type[Estimator] | None = getattr(
        importlib.import_module(f"{package.__name__}.{name}"), "ESTIMATOR", None
    )
    return loaded_class
