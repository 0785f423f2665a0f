"""Writes an export: sources, vectors and README, completely or not at all.

    estimator, calibration --`GuardedStepper`--> sources (program.py), README
    test drive --`replayed` in float64--> test_vectors.csv, expected.csv

The C program reads the vectors and compares its outputs with the expected ones (`TOLERANCES`), so
that every export can be checked on its own target.
"""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np

from vehest.data.channels import CHANNELS
from vehest.data.errors import ConfigurationError, printable
from vehest.data.files import written_aside
from vehest.data.recording import Recording
from vehest.estimators.base import Estimator
from vehest.export.program import TOLERANCES, context_of, program_files
from vehest.export.rendering import Precision, render
from vehest.export.vectors import (
    COLUMNS,
    DRIVE_SECONDS,
    drive_for,
    in_float64,
    replayed,
    table_text,
)
from vehest.trust import health
from vehest.trust.contract import GuardedStepper
from vehest.trust.record import Trust
from vehest.version import __version__

PRECISIONS = get_args(Precision)  # number types in C
# smallest standard deviation of a channel's innovations, in roundings of a float of its size
MIN_ROUNDINGS = 8.0
EXPORT_MARKER = "vehest_estimator.h"
"""File by which a folder is recognised as an export."""
FILES = frozenset(
    {
        f"vehest_{part}.{ending}"
        for part in ("types", "method", "health", "estimator")
        for ending in ("h", "c")
    }
    | {
        "main.c",
        "Makefile",
        "test_vectors.csv",
        "expected.csv",
        "README.md",
        "main",
        "outcome.csv",
        "sizes",
    }
)
"""Names of all files that an export and its Makefile write."""


def export_model(
    estimator: Estimator,
    trust: Trust | None,
    out: Path,
    precision: str = "double",
    bus_rate_hz: float | None = None,
    *,
    elsewhere: bool = False,
    drive: Recording | None = None,
) -> None:
    """Write a fitted estimator as C99 into a folder of its own.

    An earlier export there is replaced.

    Parameters
    ----------
    estimator : Estimator
        A fitted, causal estimator.
    trust : Trust or None
        Its calibration; without it limits are those of any car, and there is neither band nor
        health of channels.
    out : Path
        The folder.
    precision : str
        Of all numbers in C, ``double`` or ``float``.
    bus_rate_hz : float or None
        Rate at which samples come, if it is not the estimator's [Hz]; a causal low-pass leads
        down to that.
    elsewhere : bool
        Whether the car or its tyres are others than those that were calibrated on; bands are
        twice as wide then.
    drive : Recording or None
        Recorded, at the rate at which samples come, for the test vectors; else they are
        `DRIVE_SECONDS` of a drive with every fault.

    Raises
    ------
    ConfigurationError
        The estimator cannot be written in C, the bus is slower than it, float cannot resolve a
        channel, or the folder holds something else.
    MissingError
        The folder cannot be written.
    """
    if precision not in PRECISIONS:
        raise ConfigurationError(f"precision must be {' or '.join(PRECISIONS)}, not '{precision}'")
    kind: Precision = precision  # type: ignore[assignment]
    _refuse_foreign(out)
    stepper = GuardedStepper(estimator, trust, bus_rate_hz, elsewhere=elsewhere)
    if precision == "float":
        refuse_unresolved(trust)
    files = program_files(stepper, kind, estimator.full_title)
    files["README.md"] = readme(
        stepper, kind, drive, has_trust=trust is not None, elsewhere=elsewhere
    )
    exact = GuardedStepper(in_float64(estimator), trust, bus_rate_hz, elsewhere=elsewhere)
    times, samples = (
        drive_for(exact)
        if drive is None
        else (drive.time, {name: drive[name] for name in exact.channels})
    )
    files["test_vectors.csv"] = table_text(
        ("time", *samples), np.column_stack([times, *samples.values()])
    )
    files["expected.csv"] = table_text(COLUMNS, replayed(exact, times, samples))
    with written_aside(out, replace_folder=True) as aside:
        aside.mkdir()
        for name, text in files.items():
            (aside / name).write_text(text, encoding="utf-8")


def readme(
    stepper: GuardedStepper,
    precision: Precision,
    drive: Recording | None = None,
    *,
    has_trust: bool,
    elsewhere: bool,
) -> str:
    """README of an export: how it is called, units, and the notes of the method (licence).

    Parameters
    ----------
    stepper : GuardedStepper
        Of the exported estimator.
    precision : str
        ``double`` or ``float``.
    drive : Recording or None
        Recording of the test vectors; None: they are a simulated drive with every fault.
    has_trust : bool
        Whether the model was calibrated, so that it has bands and health.
    elsewhere : bool
        Whether the car or its tyres are others than those that it was calibrated on.
    """
    context = context_of(stepper, precision, stepper.estimator.full_title)
    reasons = {
        kind: text
        for kind, (text, _) in health.REASONS.items()
        if kind and kind not in health.RETIRED
    }
    context |= {
        "channels": [(name, CHANNELS[name].meaning) for name in stepper.estimator.channels],
        "units": {name: CHANNELS[name].unit for name in stepper.estimator.channels},
        "reasons": sorted(
            (kind, text.format(channel="CHANNEL", partner="PARTNER"))
            for kind, text in reasons.items()
        ),
        "trust": has_trust,
        "elsewhere": elsewhere,
        "version": __version__,
        "vectors": f"{DRIVE_SECONDS:g} s of a drive with faults of every kind"
        if drive is None
        else f"{drive.duration:g} s of a recorded drive",
        "tolerance": f"{TOLERANCES[precision]:.0e}",
        "kind": precision,
    }
    return render("readme.md.j2", "double", **context)


def refuse_unresolved(trust: Trust | None) -> None:
    """Refuse float for health of a channel that follows the others to the last digits.

    A channel that was computed from the others does.

    Parameters
    ----------
    trust : Trust or None
        Calibration; without health nothing is refused.

    Raises
    ------
    ConfigurationError
        There is such a channel.
    """
    if trust is None or trust.health is None:
        return
    health_model = trust.health
    for name, deviation, largest, weights in zip(
        health_model.channels,
        health_model.deviation,
        health_model.largest,
        health_model.precision,
        strict=True,
    ):
        if (
            max(weights) > 0.0
            and deviation < MIN_ROUNDINGS * float(np.finfo(np.float32).eps) * largest
        ):
            raise ConfigurationError(
                f"channel '{name}' follows the others to {deviation / largest:.1g} of its size in "
                "the training, which float cannot "
                f"resolve; export with --precision double"
            )


def _refuse_foreign(out: Path) -> None:
    """Raise `ConfigurationError` where a folder holds anything that is no part of an export.

    Only an earlier export is replaced: a real folder that is empty, or
    whose files are all in `FILES`, `EXPORT_MARKER` among them.
    """
    if not out.exists() and not out.is_symlink():
        return
    if out.is_symlink() or not out.is_dir():
        raise ConfigurationError(f"'{printable(str(out))}' is no folder; name another")
    names = sorted(entry.name for entry in out.iterdir())
    foreign = [name for name in names if name not in FILES or not (out / EXPORT_MARKER).is_file()]
    if foreign:
        raise ConfigurationError(
            f"'{printable(str(out))}' holds '{printable(foreign[0])}', which is no part of an "
            "export; name another folder"
        )
