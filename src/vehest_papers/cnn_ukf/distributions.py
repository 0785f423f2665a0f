"""Figures 4, 5, 6 and 11: what the drives are made of, and how errors are distributed, over sizes
and over groups of manoeuvres.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.report.document import Figure
from vehest.report.style import DOUBLE_COLUMN, new_figure
from vehest.studies.artefacts import PartArtefacts
from vehest_papers.cnn_ukf.manoeuvres import BIN, error_distribution, kpis_by_group
from vehest_papers.cnn_ukf.subjects import Prepared, Runs, chosen, line_of
from vehest_papers.kit.legends import legend_above
from vehest_papers.kit.reading import median_and_range

SETS_COLOURS = ("#9aa7b5", "#0b4f9c")


def figure_4(
    parts: Mapping[str, PartArtefacts],
    prepared: Mapping[str, Prepared],
    titles: Mapping[str, str],
    data: str,
) -> Figure:
    """How often which sideslip angle and lateral acceleration is driven: training, validation and
    test of each part together.
    """
    driven = {name: _driven(part, prepared[name]) for name, part in parts.items()}
    labels = ("sideslip angle [deg]", "lateral acceleration [m/s²]")
    with new_figure(DOUBLE_COLUMN, 2.6) as figure:
        panels = figure.subplots(1, 2)
        for (name, columns), colour in zip(driven.items(), SETS_COLOURS, strict=False):
            for axes, values, label in zip(panels, columns, labels, strict=True):
                edges = np.arange(np.floor(values.min()), np.ceil(values.max()) + 1.5)
                filled = (
                    {"alpha": 0.55, "histtype": "stepfilled"}
                    if name == next(iter(driven))
                    else {"histtype": "step", "linewidth": 1.3}
                )
                axes.hist(values, edges, color=colour, label=titles[name], **filled)
                axes.set_yscale("log")
                axes.set_xlabel(label)
        panels[0].set_ylabel("samples")
        legend_above(figure, panels[0], columns=2)
    caption = (
        "Sideslip angle and lateral acceleration of all samples (Figure 4 of the paper). Data: "
        f"{data}."
    )
    return Figure("figure_4", caption, figure)


def _driven(part: PartArtefacts, prepared: Prepared) -> tuple[FloatArray, FloatArray]:
    """Sideslip angle [deg] and lateral acceleration [m/s²] of all samples."""
    spans = [
        *part.split.train,
        *part.split.validation,
        *(span for test_spans in part.split.tests.values() for span in test_spans),
    ]
    pieces = [
        prepared.recording(span.dataset, span.recording).cut(span.start, span.stop)
        for span in spans
    ]
    sideslip = [np.degrees(np.arctan2(piece["vy_ref"], piece["vx"])) for piece in pieces]
    return np.concatenate(sideslip), np.concatenate([piece["ay"] for piece in pieces])


def errors_figure(runs: Runs, number: int, title: str, data: str) -> tuple[Figure, pd.DataFrame]:
    """Distribution of the error where |ay| ≥ 4 m/s², of the seed that validation chooses, with mean
    and standard deviation.

    Parameters
    ----------
    runs
        Candidate -> its seeds.
    number
        Of the paper's figure: 5, or 11 for the small training set.
    title, data
        Subject and data sets, for the caption.

    Returns
    -------
    tuple of Figure and DataFrame
        The frame has a row for each candidate and bin: its lower edge ``from_deg`` and ``samples``.
    """
    picked = {candidate: chosen(seeds) for candidate, seeds in runs.items()}
    by_candidate = {
        name: error_distribution([part for parts in run.test.values() for part in parts])
        for name, run in picked.items()
    }
    with new_figure(DOUBLE_COLUMN, 3.4) as figure:
        upper, axes = figure.subplots(
            2, 1, height_ratios=(1.2, 3.2)
        )  # errors reach ten times as far as deviations
        for place, (candidate, seeds) in enumerate(by_candidate.items()):
            line = line_of(candidate)
            axes.stairs(
                np.maximum(seeds.counts, 0.5),
                seeds.edges,
                color=line.colour,
                linestyle=line.dash,
                linewidth=1.2,
                label=candidate,
            )
            upper.errorbar(
                seeds.mean, -place, xerr=seeds.deviation, color=line.colour, fmt="x", capsize=3
            )
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.5)
        axes.set_ylabel("samples")
        axes.set_xlabel("error of the sideslip angle [deg]")
        upper.set_yticks([])
        upper.set_ylabel("mean, s.d.")
        upper.set_xlabel("[deg]")
        upper.margins(y=0.25)
        legend_above(figure, axes, columns=5)
    caption = (
        f"Distribution of errors where |ay| ≥ 4 m/s², {title}, bins of {BIN:g}°; above mean and "
        f"standard deviation (Figure {number} of the paper). Data: {data}."
    )
    rows = [
        {"candidate": candidate, "from_deg": low, "samples": count}
        for candidate, seeds in by_candidate.items()
        for low, count in zip(seeds.edges[:-1].tolist(), seeds.counts.tolist(), strict=True)
    ]
    return Figure(f"figure_{number}", caption, figure), pd.DataFrame(rows)


def groups(runs: Runs, data: str) -> tuple[Figure, pd.DataFrame]:
    """MSE_nl by group of manoeuvres, of all seeds (Figure 6).

    Returns
    -------
    tuple of Figure and DataFrame
        Bars are medians over seeds, with their range. The frame has a row a group: the number ``n``
        of its manoeuvres, and for each candidate the median with its range in words and, under
        ``CANDIDATE_median``, as a number [deg²].
    """
    of_run = {
        candidate: [kpis_by_group(run.test) for run in seeds] for candidate, seeds in runs.items()
    }
    names = list(next(iter(of_run.values()))[0])
    values = {
        (candidate, group): np.array([seed[group].mse_nonlinear for seed in seeds])
        for candidate, seeds in of_run.items()
        for group in names
    }
    counted = {group: next(iter(of_run.values()))[0][group].manoeuvres for group in names}
    with new_figure(DOUBLE_COLUMN, 2.9) as figure:
        axes = figure.subplots()
        width = 0.84 / len(of_run)
        for place, candidate in enumerate(of_run):
            middle = np.array([np.median(values[candidate, group]) for group in names])
            low, high = (
                np.array([limit(values[candidate, group]) for group in names])
                for limit in (np.min, np.max)
            )
            at = np.arange(len(names)) + (place - 0.5 * (len(of_run) - 1)) * width
            axes.bar(at, middle, width, color=line_of(candidate).colour, alpha=0.8, label=candidate)
            axes.errorbar(
                at,
                middle,
                yerr=[middle - low, high - middle],
                fmt="none",
                ecolor="#222222",
                elinewidth=0.8,
                capsize=1.5,
            )
        axes.set_xticks(
            range(len(names)),
            [
                f"{group.replace(' in the ', chr(10) + 'in the ')}\n({counted[group]})"
                for group in names
            ],
        )
        axes.set_ylabel("MSE$_{nl}$ [deg²]")
        axes.set_yscale("log")
        legend_above(figure, axes, columns=5)
    rows = [
        {"group": group, "n": counted[group]}
        | {candidate: median_and_range(values[candidate, group], 3) for candidate in of_run}
        | {
            f"{candidate}_median": float(np.median(values[candidate, group]))
            for candidate in of_run
        }
        for group in names
    ]
    caption = (
        "MSE_nl by group of manoeuvres, median and range of seeds (Figure 6 of the paper). Data: "
        f"{data}."
    )
    return Figure("figure_6", caption, figure), pd.DataFrame(rows)
