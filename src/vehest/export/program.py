"""All files of an export, as text."""

from __future__ import annotations

from typing import Any

import numpy as np

from vehest.export.estimator_source import estimator_files
from vehest.export.method import method_source
from vehest.export.rendering import Precision, ascii_only, render
from vehest.export.vectors import COLUMNS, drive_for, replayed, table_text
from vehest.trust.contract import GuardedStepper

TOLERANCES = {"double": 1e-9, "float": 1e-3}
"""Precision -> by how much the outcome of the vectors may differ from that of Python [m/s, rad]."""


def program_files(stepper: GuardedStepper, precision: Precision, title: str) -> tuple[dict[str, str], tuple[str, ...]]:
    """Sources that build anywhere: the model, and `main` around it, name -> text; and the notes of the method.

    Raises:
        ConfigurationError: the estimator cannot be written in C.
    """
    method = method_source(stepper.estimator, precision)
    files = {"vehest_method.h": method.header, "vehest_method.c": method.source}
    files |= estimator_files(stepper, precision, title, method.notes)
    sources = sorted(name for name in files if name.endswith(".c"))
    exact, notes = precision == "double", [ascii_only(note) for note in method.notes]
    values = {
        "names": list(stepper.estimator.channels),
        "tolerance": TOLERANCES[precision],
        "exact": exact,
        "notes": notes,
        "sources": sources,
    }
    files |= {"main.c": render_text("main.c.j2", **values), "Makefile": render_text("makefile.j2", **values)}
    return files, method.notes


def render_text(template: str, **values: Any) -> str:
    """The text of a template that is no part of the model: files hold double, whatever the model computes in."""
    return render(template, "double", **values)


def vector_files(stepper: GuardedStepper) -> dict[str, str]:
    """Test vectors, and what Python says of them; name -> text. The stepper is in its initial state, and is used up."""
    times, samples = drive_for(stepper)
    rows = np.column_stack([times, *samples.values()])
    return {
        "test_vectors.csv": table_text(("time", *samples), rows),
        "expected.csv": table_text(COLUMNS, replayed(stepper, times, samples)),
    }
