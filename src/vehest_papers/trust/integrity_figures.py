"""The Stanford diagram, error over protection level, and the share of samples in each region."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from vehest.data.store import read_recording
from vehest.report.document import Column, Figure, Table, as_text
from vehest.report.style import (
    DOUBLE_COLUMN,
    LINEAR_BLUES,
    NONLINEAR_ORANGES,
    REFERENCE,
    MatplotlibFigure,
    new_figure,
)
from vehest.studies.artefacts import PartArtefacts
from vehest.studies.kit.runs import by_name
from vehest_papers.kit.reading import sideslip_error
from vehest_papers.trust.faults import health_of, tests_trained_car
from vehest_papers.trust.integrity import (
    ALERT_LIMIT,
    HAZARDOUS,
    MISLEADING,
    NOMINAL,
    UNAVAILABLE,
    Integrity,
    integrity_of,
    joined,
)

BINS = 60
COLUMNS = 3
AXIS_END = 2.0 * ALERT_LIMIT
"""End of both axes [deg]."""
_TEXT_BOX = {"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.0}
LABELS = {
    NOMINAL: (0.25, 0.75),
    MISLEADING: (0.72, 0.42),
    HAZARDOUS: (1.5, 0.5),
    UNAVAILABLE: (1.0, 1.8),
}
"""Region -> place of its share, in alert limits."""
FAMILIES = ("ksnn", "rational_ekf", "static_map")
INVALID = 2
"""Status of health."""
INTEGRITY_CAPTION = (
    "Share of samples in each region [%], real cars of the training, without faults, all test "
    "ranges."
)
STANFORD_CAPTION = (
    "Stanford diagrams of β, real cars of the training, without faults. Size of the error over "
    "the protection level."
)


def integrity_by_estimator(parts: Mapping[str, PartArtefacts]) -> dict[str, Integrity]:
    """Title -> errors and levels on real cars of the training, of estimators of `FAMILIES`."""
    drives: dict[str, list[Integrity]] = {}
    for part in parts.values():
        recording = read_recording(next(iter(part.references.values())))
        is_real = "real" in set(part.kinds.values())
        if not is_real or not tests_trained_car(part) or "vx" not in recording.channels:
            continue
        status = health_of(part)
        for (estimator, _), models in by_name(part.models).items():
            if estimator not in FAMILIES:
                continue
            of_estimator = drives.setdefault(as_text(models[0].title), [])
            for test_set in part.split.tests:
                for position, scored in enumerate(part.scored(models[0], test_set)):
                    estimate = models[0].estimate(test_set, position)
                    band = np.degrees(estimate.held_at(scored.time, "band_sideslip"))
                    is_invalid = status[test_set, position][-len(scored.time) :] == INVALID
                    of_estimator.append(integrity_of(sideslip_error(scored), band, is_invalid))
    return {title: joined(of_estimator) for title, of_estimator in drives.items()}


def integrity_table(families: Mapping[str, Integrity]) -> Table:
    """Share of samples in each region [%], a row an estimator."""
    rows = [
        {"estimator": title, **{region: 100 * share for region, share in family.shares().items()}}
        for title, family in families.items()
    ]
    columns = {"estimator": Column("estimator")}
    columns |= {
        region: Column(region, digits=2, each=True)
        for region in (NOMINAL, MISLEADING, HAZARDOUS, UNAVAILABLE)
    }
    return Table("integrity", INTEGRITY_CAPTION, pd.DataFrame(rows), columns)


def stanford(families: Mapping[str, Integrity]) -> Figure:
    """The Stanford diagrams with their caption."""
    return Figure("stanford", STANFORD_CAPTION, stanford_figure(families))


def stanford_figure(families: Mapping[str, Integrity]) -> MatplotlibFigure:
    """A panel an estimator: samples by error and protection level, on a logarithmic grey scale.

    Samples beyond the axes are drawn at their ends. Where an estimate was flagged as invalid its
    level counts as beyond the axes.
    """
    from matplotlib.colors import LogNorm

    columns = min(len(families), COLUMNS)
    rows = -(-len(families) // columns)
    with new_figure(DOUBLE_COLUMN * columns / COLUMNS, 0.35 + 2.3 * rows) as figure:
        panels = np.atleast_1d(
            figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        ).ravel()
        for axes, (title, family) in zip(panels, families.items(), strict=False):
            level = np.where(family.flagged | ~np.isfinite(family.level), np.inf, family.level)
            edges = np.linspace(0.0, AXIS_END, BINS + 1)
            across, up = (
                np.clip(values, 0.0, AXIS_END * (1.0 - 1e-9)) for values in (family.error, level)
            )
            counts = np.histogram2d(across, up, bins=[edges, edges])[0]
            filled_bins = np.ma.masked_equal(counts.T, 0)
            axes.pcolormesh(
                edges,
                edges,
                filled_bins,
                cmap="Greys",
                norm=LogNorm(1, max(counts.max(), 2.0)),
                rasterized=True,
            )
            _draw_regions(axes, family)
            axes.set_title(title)
            axes.set_aspect("equal")
        for axes in panels[len(families) :]:
            axes.set_visible(False)
        for axes in panels[-columns:]:
            axes.set_xlabel("error of sideslip [deg]")
        for axes in panels[::columns]:
            axes.set_ylabel("protection level [deg]")
    return figure


def _draw_regions(axes: Any, family: Integrity) -> None:
    """Limits between regions, and the share of the samples in each."""
    limit = ALERT_LIMIT
    end = AXIS_END
    axes.fill(
        [0.0, limit, limit], [0.0, 0.0, limit], color=NONLINEAR_ORANGES[0], alpha=0.15, linewidth=0
    )
    axes.fill(
        [limit, end, end, limit],
        [0.0, 0.0, limit, limit],
        color=NONLINEAR_ORANGES[1],
        alpha=0.25,
        linewidth=0,
    )
    axes.fill(
        [0.0, end, end, 0.0],
        [limit, limit, end, end],
        color=LINEAR_BLUES[0],
        alpha=0.12,
        linewidth=0,
    )
    axes.plot([0.0, end], [0.0, end], color=REFERENCE.colour, linewidth=0.7)
    axes.plot([0.0, end], [limit, limit], color=REFERENCE.colour, linewidth=0.7, linestyle="dashed")
    axes.plot(
        [limit, limit], [0.0, limit], color=REFERENCE.colour, linewidth=0.7, linestyle="dashed"
    )
    shares = family.shares()
    for region, (across, up) in LABELS.items():
        words = f"{region.replace(' ', chr(10))}\n{100.0 * shares[region]:.3g} %"
        axes.text(
            across * limit,
            up * limit,
            words,
            ha="center",
            va="center",
            fontsize=5.5,
            bbox=_TEXT_BOX,
        )
    axes.set_xlim(0.0, end)
    axes.set_ylim(0.0, end)
