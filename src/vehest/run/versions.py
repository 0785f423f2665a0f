"""Versions of what a stage runs, as a text in its key: ``train=1 ksnn=1 training=1``.

Every stage, source, estimator, training and study has a version of its own, raised by hand when its numbers move: ``VERSION`` of a module,
``version`` of a class. Where code stands and what it is called does not matter. The golden tests (tests/golden) fail when numbers move and
name the version to raise.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vehest.estimators.registry import estimator_class
from vehest.sources.base import source_class
from vehest.studies.registry import study_module


def version_of_source(dataset: Mapping[str, Any]) -> str:
    """Name and version of a data set's source.

    Raises:
        ConfigurationError: there is no such source.
    """
    return f"{dataset['source']}={source_class(dataset).version}"


def version_of_estimator(name: str) -> str:
    """Name and version of an estimator.

    Raises:
        ConfigurationError: the name is unknown.
    """
    return f"{name}={estimator_class(name).version}"


def version_of_training(name: str) -> str:
    """Version of how an estimator is trained: of its ``training_type``; 1 where another package's has none.

    Raises:
        ConfigurationError: the name is unknown.
    """
    return f"training={getattr(estimator_class(name).training_type, 'version', '1')}"


def version_of_study(name: str) -> str:
    """Name and version of a study: ``VERSION`` of its module; 1 where it has none.

    Raises:
        ConfigurationError: the name is unknown.
    """
    return f"{name}={getattr(study_module(name), 'VERSION', '1')}"
