"""Names of the modules that draw studies.

A study called ``name`` is the module ``vehest.studies.name``, or an entry point of another package
in the group ``vehest.studies``; those that re-create papers come so, from ``vehest_papers``. Such a
module has

- ``TAKES``: what its pipelines name, ``split``, ``parts`` or ``datasets``, or ``folds`` for a split
  that is cross-validated;
- ``documents(artefacts: StudyArtefacts) -> {name: Document}``, of which one starts with ``report``;
- ``SHOWS_FAILED = True``, if its report can leave out what failed and say so;
- ``METRICS``, if its metrics.csv is to hold these alone, over all samples;
- ``VERSION``, if its tables or figures changed since it was first published: raised each time they
  do;
- ``verdict(artefacts: StudyArtefacts) -> list[str]``, if it says in words at the end what came of
  it;
- ``leaderboard(artefacts: PartArtefacts) -> DataFrame``, if it takes a split, or a table
  ``overview`` in its report, for the terminal.
"""

from __future__ import annotations

import importlib
from functools import cache
from importlib.metadata import entry_points
from types import ModuleType

from vehest.data.errors import ConfigurationError, printable
from vehest.data.text_files import first_line

ENTRY_POINTS = "vehest.studies"  # group of entry points of other packages' studies
# names of the studies that are modules of this package
BUILT_IN = ("drive", "folds", "own_car", "reference_minutes", "sweep", "transfer")


@cache
def study_names() -> list[str]:
    """Every known name: vehest's own, then those that other packages installed."""
    return [
        *BUILT_IN,
        *sorted({point.name for point in entry_points(group=ENTRY_POINTS)} - set(BUILT_IN)),
    ]


def study_module(name: str) -> ModuleType:
    """The module behind a name.

    Raises
    ------
    ConfigurationError
        None is or it cannot be loaded.
    """
    if name in BUILT_IN:
        return importlib.import_module(f"{ENTRY_POINTS}.{name}")
    point = next((point for point in entry_points(group=ENTRY_POINTS) if point.name == name), None)
    if point is None:
        raise ConfigurationError(
            f"there is no study module '{name}'; there are: {', '.join(study_names())}"
        )
    try:
        return importlib.import_module(point.module)
    except Exception as error:  # a package may raise anything when it is imported
        reason = f"{type(error).__name__}: {printable(first_line(error))}"
        raise ConfigurationError(
            f"study module '{name}' of another package cannot be loaded ({reason}); repair or "
            "remove it"
        ) from error
