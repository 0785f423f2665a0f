"""Sample efficiency: the error on both cars by the minutes of recordings that were learnt and stopped on."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from vehest.evaluation.blocks import Segments
from vehest.report.document import Column, Figure, Table
from vehest.report.style import DOUBLE_COLUMN, Line, line_of, new_figure
from vehest.studies.reference_minutes import minutes_of
from vehest_papers.kit.legends import legend_above
from vehest_papers.ksnn import paper
from vehest_papers.ksnn.candidates import category_of
from vehest_papers.ksnn.comparing import SegmentErrors
from vehest_papers.ksnn.schemes import Scheme, segments_on

NAMED = re.compile(r"minutes_([\d.]+)(?:_[a-z])?")
MAP_LINE = Line("#222222", "dotted", "")
TESTS = {"own": "own car", "other": "other car"}


@dataclass(frozen=True, eq=False)
class Curve:
    """Errors by category and amount."""

    errors: Mapping[
        str, SegmentErrors
    ]  # ``own`` or ``other`` -> errors of candidates called ``CATEGORY@MINUTES``
    minutes: Sequence[str]  # amounts, from the least, as they are written in names
    lines: Mapping[str, tuple[str, str]]  # category -> estimator and variant


def curve_of(whole: Scheme, shorter: Mapping[str, Scheme]) -> Curve | None:
    """The curve of parts called ``minutes_2.5_a`` and so on, and of the scheme that has all minutes; none where there are no such parts."""
    found = [
        (match[1], scheme) for name, scheme in shorter.items() if (match := NAMED.fullmatch(name))
    ]
    if not found:
        return None
    amounts = sorted({minutes for minutes, _ in found}, key=float)
    structures = {
        (model.estimator, model.variant) for _, scheme in found for model in scheme.part.models
    }
    everything = f"{minutes_of(whole.part):.3g}"
    sources = [*found, (everything, whole)]
    segments: dict[str, dict[str, list[Segments]]] = {word: {} for word in TESTS}
    for minutes, scheme in sources:
        for model in scheme.part.models:
            if (model.estimator, model.variant) in structures:
                key = f"{category_of(model.estimator, model.variant)}@{minutes}"
                for word in TESTS:
                    segments[word].setdefault(key, []).append(
                        segments_on(model, getattr(scheme, word))
                    )
    lines = {category_of(*name): name for name in sorted(structures)}
    errors = {
        word: SegmentErrors(own, whole.labels.get(getattr(whole, word)))
        for word, own in segments.items()
    }
    return Curve(errors, [*amounts, everything], lines)


def curve_table(curve: Curve) -> Table:
    """Table ``minutes``: FVU with intervals, both cars."""
    rows = []
    for word, title in TESTS.items():
        errors = curve.errors[word]
        for category in curve.lines:
            row: dict[str, object] = {"test": title, "model": category}
            rows.append(
                row
                | {
                    minutes: errors.in_words(f"{category}@{minutes}", "fvu")
                    for minutes in curve.minutes
                }
            )
    columns = {"test": Column("test"), "model": Column("model")} | {
        minutes: Column(f"{minutes} min") for minutes in curve.minutes
    }
    caption = (
        "FVU by the minutes learnt and stopped on together, scheme 2, with 95 % intervals over blocks, seeds and two places of the drives. "
        "Structures as in the paper's Table V."
    )
    return Table("minutes", caption, pd.DataFrame(rows), columns)


def curve_figure(curve: Curve) -> Figure:
    """Figure ``minutes``: FVU over minutes, a panel a car; of the baselines the static map, as a level that has no colour of its own."""
    with new_figure(DOUBLE_COLUMN, 2.6) as figure:
        panels = figure.subplots(1, 2, sharey=True)
        for axes, (word, title) in zip(panels, TESTS.items(), strict=True):
            errors = curve.errors[word]
            for category, name in curve.lines.items():
                points = [
                    (float(minutes), own)
                    for minutes in curve.minutes
                    if math.isfinite((own := errors.figure(f"{category}@{minutes}", "fvu")).value)
                ]
                if not points or category in (paper.ZERO, paper.KINEMATIC):
                    continue
                line = line_of(*name) if category != paper.STATIC_MAP else MAP_LINE
                values = [own.value for _, own in points]
                ends = [(own.low, own.high) for _, own in points]
                bars = np.abs(np.array(ends) - np.array(values)[:, None]).T
                looks: dict[str, Any] = {
                    "color": line.colour,
                    "linestyle": line.dash,
                    "marker": line.marker,
                    "elinewidth": 0.6,
                }
                axes.errorbar(
                    [minutes for minutes, _ in points], values, yerr=bars, label=category, **looks
                )
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_title(title, loc="left")
            axes.set_xlabel("minutes learnt and stopped on")
            ticks = [float(minutes) for minutes in curve.minutes]
            axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
            axes.minorticks_off()
        panels[0].set_ylabel("FVU")
        legend_above(figure, panels[0], columns=4)
    caption = "FVU by the minutes of recordings learnt and stopped on, scheme 2, with 95 % intervals; v = 0 leaves 1. Logarithmic axes."
    return Figure("minutes", caption, figure)
