"""Key performance indicators of a set of manoeuvres: squared errors over all of them, and each
one's largest error on average.

Source: Bertipaglia et al. 2024, Section IV-B. Means of the largest errors rather than the largest
of all: its Tables II and III.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.splits import Span
from vehest.evaluation.metrics import NONLINEAR_AY, Scored
from vehest_papers.kit.reading import sideslip_error

GROUPS = {
    "braking": "braking in the turn",
    "skidpad": "skidpad",
    "j_turn": "J-turn",
    "slalom": "slalom",
    "lane_change": "lane change",
    "random_steer": "random steer",
    "spiral": "spiral",
    "lap": "lap",
}
"""Part of a recording's name -> the group of manoeuvres of the recording."""

CARS = {"standard": "as in training", "laden": "laden", "soft": "softer tyres"}
"""Start of a recording's name -> which car is driven; others are as in training."""

BIN = 0.25  # deg, of Figs. 5 and 11


@dataclass(frozen=True)
class Kpis:
    """Errors of the sideslip angle; those of the nonlinear range are NaN where no sample lies in
    it, or ay was not measured.
    """

    mse: float  # mean squared error over all samples [deg²]
    mse_nonlinear: float  # the same of samples with |ay| ≥ 4 m/s² [deg²]
    max_error: float  # mean over manoeuvres of the largest absolute error [deg]
    # the same of samples with |ay| ≥ 4 m/s², over manoeuvres that have some [deg]
    max_error_nonlinear: float
    manoeuvres: int  # how many there are


@dataclass(frozen=True, eq=False)
class ErrorDistribution:
    """How often the sideslip angle was how wrong."""

    edges: FloatArray  # of the bins, (K + 1,) [deg]; multiples of the width
    counts: NDArray[np.int64]  # samples in each, (K,)
    mean: float  # of the errors [deg]
    deviation: float  # their standard deviation [deg]


def manoeuvres_of(spans: Sequence[Span], parts: Sequence[Scored]) -> dict[str, list[Scored]]:
    """What was scored of each recording, which is one manoeuvre, in the order of a test set's
    ranges; raises `DataError`.
    """
    if len(spans) != len(parts):
        raise DataError(
            f"{len(parts)} scored parts do not belong to {len(spans)} ranges; leave "
            "evaluation.sequence_seconds empty"
        )
    manoeuvres: dict[str, list[Scored]] = {}
    for span, part in zip(spans, parts, strict=True):
        manoeuvres.setdefault(span.recording, []).append(part)
    return manoeuvres


def group_of(recording: str) -> str:
    """The group of manoeuvres that a recording's name states; ``other`` if it states none."""
    return next((group for part, group in GROUPS.items() if part in recording), "other")


def car_of(recording: str) -> str:
    """The car that a recording's name begins with."""
    return CARS.get(recording.partition("_")[0], CARS["standard"])


def kpis(manoeuvres: Mapping[str, Sequence[Scored]]) -> Kpis:
    """Indicators of a set of manoeuvres.

    Parameters
    ----------
    manoeuvres
        Name of a manoeuvre -> what was scored of it. Samples of all manoeuvres are pooled for
        squared errors; largest errors are averaged over manoeuvres.

    Raises
    ------
    DataError
        The set is empty.
    """
    if not manoeuvres:
        raise DataError("there are no manoeuvres to take errors of")
    errors = [
        np.concatenate([sideslip_error(part) for part in parts]) for parts in manoeuvres.values()
    ]
    masks = [
        np.concatenate([is_nonlinear(part) for part in parts]) for parts in manoeuvres.values()
    ]
    nonlinear = [error[chosen] for error, chosen in zip(errors, masks, strict=True) if chosen.any()]
    return Kpis(
        mse=float(np.mean(np.square(np.concatenate(errors)))),
        mse_nonlinear=float(np.mean(np.square(np.concatenate(nonlinear))))
        if nonlinear
        else float("nan"),
        max_error=float(np.mean([np.abs(error).max() for error in errors])),
        max_error_nonlinear=float(np.mean([np.abs(error).max() for error in nonlinear]))
        if nonlinear
        else float("nan"),
        manoeuvres=len(errors),
    )


def kpis_by_group(manoeuvres: Mapping[str, Sequence[Scored]]) -> dict[str, Kpis]:
    """Indicators of each group of manoeuvres that occurs, in the order of `GROUPS`."""
    groups: dict[str, dict[str, Sequence[Scored]]] = {}
    for name, parts in manoeuvres.items():
        groups.setdefault(group_of(name), {})[name] = parts
    return {group: kpis(groups[group]) for group in (*GROUPS.values(), "other") if group in groups}


def error_distribution(parts: Sequence[Scored], nonlinear_only: bool = True) -> ErrorDistribution:
    """Distribution of the error of the sideslip angle (Figures 5 and 11), in bins of `BIN`.

    Parameters
    ----------
    parts
        Scored ranges, taken together.
    nonlinear_only
        Whether samples with |ay| ≥ 4 m/s² alone count.

    Raises
    ------
    DataError
        No sample counts.
    """
    errors = np.concatenate(
        [
            sideslip_error(part)[is_nonlinear(part)] if nonlinear_only else sideslip_error(part)
            for part in parts
        ]
    )
    if not len(errors):
        raise DataError(
            f"no sample has a lateral acceleration of {NONLINEAR_AY:g} m/s² or more; count all "
            "with nonlinear_only=False"
        )
    first = np.floor(errors.min() / BIN)
    last = np.floor(errors.max() / BIN) + 1
    edges = BIN * np.arange(first, last + 1)
    counts = np.bincount(
        (np.floor(errors / BIN) - first).astype(np.int64), minlength=len(edges) - 1
    )
    return ErrorDistribution(edges, counts, float(errors.mean()), float(errors.std()))


def is_nonlinear(part: Scored) -> NDArray[np.bool_]:
    """Which samples have |ay| ≥ 4 m/s², (K,); none where ay was not measured."""
    return np.abs(part.ay) >= NONLINEAR_AY
