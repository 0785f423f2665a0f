"""Tables and heat maps of a sweep: every combination of settings, over its seeds.

`SweepArtefacts.table` has a row a combination, `build` makes the report. The mean over seeds comes
with a 95 % confidence interval from Student's t distribution. The combination is chosen on the
validation range; tests choose nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.data.errors import number_of
from vehest.data.splits import VALIDATION
from vehest.report.document import PATENT_NOTE, Block, Column, Document, Figure, Table
from vehest.report.style import (
    DOUBLE_COLUMN,
    SINGLE_COLUMN,
    MatplotlibFigure,
    decimals_for,
    fixed,
    new_figure,
)
from vehest.studies.artefacts import PartArtefacts
from vehest.studies.drive import data_sentence, how_it_was_made

CONFIDENCE = 0.95  # level of the interval of a mean over seeds
METRIC = "rmse_sideslip"  # metric by which the combination is chosen
DONE = "done"  # status of a job
FAILED = "failed"  # status of a job
MIN_RATIO_FOR_LOG = 20.0  # highest over lowest value, above which colours are logarithmic
MAX_COLUMNS_SIDE_BY_SIDE = 6  # columns of a heat map; those with more are drawn below one another
CELL_HEIGHT = 0.42  # inches, height of a cell of a heat map
NO_VALUE_COLOUR = "#ececec"  # colour of a cell without a value
LUMINANCE = (0.2126, 0.7152, 0.0722)  # weights of red, green and blue in the relative luminance
Value = bool | int | float | str  # value of a setting
Panel = tuple[str, FloatArray, FloatArray, list[list[int]]]
"""Panel of a heat map: title, mean and half interval of each cell, (R, C), NaN for none, and row
and column of the cells with a frame.
"""


@dataclass(frozen=True)
class SweepArtefacts:
    """Everything that tables and figures of a sweep are made from."""

    part: PartArtefacts  # the comparison of all combinations
    # settings that take several values, without the seed, in the order of the command
    keys: Sequence[str]
    # a row a job: ``combination`` (counted from 0), ``title``, the keys, ``seed``, ``status``
    # (``done`` or ``failed``), ``error``,
    # ``n_parameters``, ``epochs``, and ``rmse_sideslip.SET``, ``rmse_vy.SET`` and ``fvu.SET`` for
    # each set of `sets`; those of a
    # combination with a fault count the samples while it lasts
    jobs: pd.DataFrame

    @property
    def sets(self) -> list[str]:
        """Names of what is scored: the validation range, where there is one, and each test set."""
        return [*([VALIDATION] if self.part.split.validation else []), *self.part.split.tests]

    @cached_property
    def table(self) -> pd.DataFrame:
        """One row a combination, in the order of the jobs: its number, title, keys, parameters,
        seeds that are done and failed.

        For each set ``rmse_sideslip.SET``, the mean over seeds, and ``rmse_sideslip_half.SET``,
        half its 95 % interval (NaN for one seed) [deg]. ``chosen`` is the lowest mean on the
        validation range among those of which no seed failed; none where nothing was validated, or
        where combinations differ in faults, the mildest of which would win.
        """
        rows = []
        for number, jobs in self.jobs.groupby("combination", sort=False):
            done = jobs[jobs["status"] == DONE]
            row: dict[str, object] = {
                "combination": number,
                **{name: jobs.iloc[0][name] for name in ("title", *self.keys)},
                "n_parameters": done["n_parameters"].iloc[0] if len(done) else math.nan,
                "n_seeds": len(done),
                "n_failed": len(jobs) - len(done),
            }
            for name in self.sets:
                row[f"{METRIC}.{name}"], row[f"{METRIC}_half.{name}"] = interval(
                    done[f"{METRIC}.{name}"].to_numpy(dtype=float)
                )
            rows.append(row)
        table = pd.DataFrame(rows)
        table["chosen"] = False
        if VALIDATION in self.sets and not any(key.split(".")[0] == "fault" for key in self.keys):
            mean = (
                table[f"{METRIC}.{VALIDATION}"].where(table["n_failed"] == 0).to_numpy(dtype=float)
            )
            if np.isfinite(mean).any():
                table.loc[int(np.argmin(np.where(np.isfinite(mean), mean, np.inf))), "chosen"] = (
                    True
                )
        return table


def build(artefacts: SweepArtefacts) -> Document:
    """The report of a sweep, titled after the study: what was chosen, all combinations, what
    failed, heat maps, how it was made.
    """
    part = artefacts.part
    blocks: list[Block] = [
        data_sentence(part),
        _chosen_sentence(artefacts),
        "## Combinations",
        _table(artefacts),
    ]
    if part.failed:
        listed = "\n".join(f"- {name}: {reason}" for name, reason in part.failed.items())
        blocks.append(f"## What failed\n\n{listed}")
    maps = heat_maps(artefacts)
    if maps:
        blocks += ["## Heat maps", *maps]
    blocks += how_it_was_made(part, (_budget(artefacts.jobs), *INTERVAL_AND_CHOICE))
    if any(model.estimator == "ksnn" for model in part.models):
        blocks.append(PATENT_NOTE)
    return Document(f"Sweep {part.study}", blocks)


def interval(values: FloatArray) -> tuple[float, float]:
    """Mean, and half the two-sided 95 % confidence interval of the mean, from Student's t
    distribution with n - 1 degrees of freedom.

    Parameters
    ----------
    values : FloatArray
        (n,), one a seed; a single value that is not finite makes both results NaN.

    Returns
    -------
    tuple[float, float]
        Mean and half interval; NaN where there are no values, half NaN for one value.
    """
    from scipy.stats import t

    n = len(values)
    if n == 0 or not np.isfinite(values).all():
        return math.nan, math.nan
    mean = float(np.mean(values))
    if n == 1:
        return mean, math.nan
    return mean, float(t.ppf(0.5 + CONFIDENCE / 2, n - 1) * np.std(values, ddof=1) / math.sqrt(n))


def table_of(artefacts: SweepArtefacts) -> tuple[list[str], list[list[str]]]:
    """A summary as a terminal shows it: headers, and rows of cells.

    The chosen combination has a star.

    Returns
    -------
    tuple
        Headers, and rows of as many cells as text.
    """
    names = short_names(artefacts.keys)
    table = artefacts.table
    header = ["", *(names.values() or ["estimator"]), "parameters", "seeds", *artefacts.sets]
    decimals = {name: decimals_for(table[f"{METRIC}.{name}"].tolist()) for name in artefacts.sets}
    rows = []
    for row in table.to_dict("records"):
        seeds = (
            f"{row['n_seeds']} ({row['n_failed']} failed)"
            if row["n_failed"]
            else str(row["n_seeds"])
        )
        settings = [override_text(row[key]) for key in artefacts.keys] or [str(row["title"])]
        scores = [
            mean_and_half(row[f"{METRIC}.{name}"], row[f"{METRIC}_half.{name}"], decimals[name])
            for name in artefacts.sets
        ]
        rows.append(
            ["*" if row["chosen"] else "", *settings, fixed(row["n_parameters"], 0), seeds, *scores]
        )
    return header, rows


def heat_maps(artefacts: SweepArtefacts) -> list[Figure]:
    """A heat map for each set, where two numeric keys vary and any others are booleans; else none.

    Parameters
    ----------
    artefacts : SweepArtefacts
        Keys with a single value do not count.

    Returns
    -------
    list of Figure
        ``heat_map_SET``: the first key across, the second up, a panel for each setting of the
        booleans.
    """
    table = artefacts.table
    varied = [key for key in artefacts.keys if table[key].nunique() > 1]
    switches = [
        key for key in varied if all(isinstance(value, bool | np.bool_) for value in table[key])
    ]
    numeric = [
        key
        for key in varied
        if key not in switches and all(_is_number(value) for value in table[key])
    ]
    if len(numeric) != 2 or len(numeric) + len(switches) != len(varied):
        return []
    cells = [sorted(table[key].unique()) for key in numeric]
    names = short_names(artefacts.keys)
    across, up = (names[key] for key in numeric)
    maps = []
    for name in artefacts.sets:
        panels = []
        for key, rows in table.groupby(switches, sort=False) if switches else [((), table)]:
            title = ", ".join(
                f"{names[switch]} = {override_text(value)}"
                for switch, value in zip(switches, key, strict=True)
            )
            panels.append(_panel(rows, title, name, numeric, cells))
        set_text = _describe_set(name)
        caption = (
            f"RMSE(β) on {set_text} over {across} and {up} ({_kinds(artefacts, name)}). In each "
            "cell the mean over seeds and, "
            "below it, half its 95 % confidence interval. The frame marks the combination chosen "
            "on the validation range."
        )
        ticks = [[str(value) for value in values] for values in cells]
        figure = heat_map(panels, ticks[0], ticks[1], across, up, f"RMSE(β), {name} [deg]")
        maps.append(Figure(f"heat_map_{name.lower()}", caption, figure))
    return maps


def short_names(keys: Sequence[str]) -> dict[str, str]:
    """Key -> its last part, or all of it where two keys share that."""
    last = [key.rsplit(".", 1)[-1] for key in keys]
    return {
        key: name if last.count(name) == 1 else key for key, name in zip(keys, last, strict=True)
    }


def override_text(value: object) -> str:
    """A value as it is typed in an override."""
    return str(value).lower() if isinstance(value, bool | np.bool_) else str(value)


def _is_number(value: object) -> bool:
    """Whether a value is a number, and no truth value."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(
        value, bool | np.bool_
    )


def _panel(
    table: pd.DataFrame, title: str, name: str, numeric: Sequence[str], cells: list[list[float]]
) -> Panel:
    """Panel of a heat map from the combinations in a table: the values of the first numeric key
    across, those of the second up.
    """
    across, up = numeric
    mean, half, chosen = (
        table.pivot(index=up, columns=across, values=column)
        .reindex(index=cells[1], columns=cells[0])
        .to_numpy(dtype=float)
        for column in (f"{METRIC}.{name}", f"{METRIC}_half.{name}", "chosen")
    )
    return title, mean, half, np.argwhere(chosen == 1.0).tolist()


def heat_map(
    panels: Sequence[Panel],
    columns: Sequence[str],
    rows: Sequence[str],
    column_label: str,
    row_label: str,
    quantity: str,
) -> MatplotlibFigure:
    """Draw panels, (R, C) each, on one scale of colours, the darker the larger.

    Logarithmic where the largest value is 20 times the smallest.

    Parameters
    ----------
    panels : sequence of Panel
        Title, means, half intervals and framed cells of each.
    columns, rows : sequence of str
        Labels of the C columns and R rows, the first row at the bottom.
    column_label, row_label : str
        Labels of the axes.
    quantity : str
        Label of the colour bar, with its unit.
    """
    import matplotlib
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, LogNorm, Normalize

    values = np.concatenate([mean.ravel() for _, mean, *_ in panels])
    finite = values[np.isfinite(values)] if np.isfinite(values).any() else np.zeros(1)
    low = float(finite.min())
    high = float(finite.max())
    scale = (
        LogNorm(low, high)
        if low > 0 and high / low > MIN_RATIO_FOR_LOG
        else Normalize(low, high if high > low else low + 1.0)
    )
    across = 1 if len(columns) > MAX_COLUMNS_SIDE_BY_SIDE else min(len(panels), 2)
    down = math.ceil(len(panels) / across)
    width = (
        SINGLE_COLUMN if across == 1 and len(columns) <= MAX_COLUMNS_SIDE_BY_SIDE else DOUBLE_COLUMN
    )
    with new_figure(width, down * (0.75 + CELL_HEIGHT * len(rows))) as figure:
        grid = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False)
        shades = LinearSegmentedColormap.from_list(
            "shades", matplotlib.colormaps["Blues"](np.linspace(0.1, 0.95, 64))
        )
        colours = ScalarMappable(scale, shades)
        for axes, panel in zip(grid.flat, panels, strict=False):
            _draw(axes, panel, colours, decimals_for(finite.tolist()))
            axes.set_title(panel[0], loc="left")
            axes.set_xticks(range(len(columns)), columns)
            axes.set_yticks(range(len(rows)), rows)
        for axes in list(grid.flat)[len(panels) :]:
            axes.set_visible(False)
        for axes in grid[-1]:
            axes.set_xlabel(column_label)
        for axes in grid[:, 0]:
            axes.set_ylabel(row_label)
        figure.colorbar(
            colours, ax=list(grid.flat), label=quantity, pad=0.02, aspect=25
        ).outline.set_visible(False)
    return figure


def _draw(axes: Any, panel: Panel, colours: Any, decimals: int) -> None:
    """Draw one panel: coloured cells with mean and half interval as text, white on dark colours,
    and frames.
    """
    from matplotlib.patches import Rectangle

    _, means, halves, marked = panel
    edges = [np.arange(number + 1) - 0.5 for number in means.T.shape]
    axes.pcolormesh(
        *edges, means, cmap=colours.cmap, norm=colours.norm, edgecolors="white", linewidth=0.8
    )
    axes.set_facecolor(NO_VALUE_COLOUR)
    for row, column in np.ndindex(means.shape):
        mean = float(means[row, column])
        half = float(halves[row, column])
        words = fixed(mean, decimals) + (
            f"\n±{fixed(half, decimals)}" if math.isfinite(half) else ""
        )
        ink = (
            "white"
            if math.isfinite(mean) and float(np.dot(LUMINANCE, colours.to_rgba(mean)[:3])) < 0.45
            else "#111111"
        )
        axes.text(
            column, row, words, ha="center", va="center", fontsize=6.5, color=ink, linespacing=1.1
        )
    for row, column in marked:
        axes.add_patch(
            Rectangle(
                (column - 0.46, row - 0.46),
                0.92,
                0.92,
                fill=False,
                edgecolor="#d6336c",
                linewidth=1.8,
            )
        )
    axes.grid(visible=False)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)


# The words


def _kinds(artefacts: SweepArtefacts, name: str) -> str:
    """Text on the kinds of the recordings of a test set, or of the validation range."""
    part = artefacts.part
    return part.kinds_of(part.split.validation if name == VALIDATION else part.split.tests[name])


def _chosen_sentence(artefacts: SweepArtefacts) -> str:
    """Sentences on which combination was chosen on validation, with its errors and the number of
    others within its interval; or on why none was chosen.
    """
    if any(key.split(".")[0] == "fault" for key in artefacts.keys):
        return (
            "No combination is chosen: the combinations differ in faults, which are conditions "
            "of the evaluation and no settings."
        )
    table = artefacts.table
    if not table["chosen"].any():
        return (
            "No combination is chosen: there is no finite error on a validation range, and tests "
            "choose nothing."
        )
    row = table[table["chosen"]].iloc[0]
    names = short_names(artefacts.keys)
    settings = ", ".join(f"{names[key]} = {override_text(row[key])}" for key in artefacts.keys)
    words = f"Chosen on the validation range: **{row['title']}**" + (
        f" ({settings})" if settings else ""
    )
    figures = [
        f"{_with_interval(row, name)} on {_describe_set(name)} ({_kinds(artefacts, name)})"
        for name in artefacts.sets
    ]
    seeds = int(row["n_seeds"])
    words += f", with RMSE(β) = {', '.join(figures)}; {number_of(seeds, 'seed')}."
    mean = float(row[f"{METRIC}.{VALIDATION}"])
    half = float(row[f"{METRIC}_half.{VALIDATION}"])
    if len(table) > 1 and math.isfinite(half):
        close = int((table[f"{METRIC}.{VALIDATION}"] <= mean + half).sum()) - 1
        words += (
            f" {close} of the other {len(table) - 1} combinations have a mean on the validation "
            "range within its interval."
        )
    return words


def _describe_set(name: str) -> str:
    """Text that names a test set."""
    return "the validation range" if name == VALIDATION else f"test set `{name}`"


def _with_interval(row: pd.Series, name: str) -> str:
    """Text of mean and half interval of a combination's RMSE(β) on a set, with the degree sign."""
    mean = float(row[f"{METRIC}.{name}"])
    half = float(row[f"{METRIC}_half.{name}"])
    return mean_and_half(mean, half, decimals_for([mean])) + "°"


def mean_and_half(mean: float, half: float, decimals: int) -> str:
    """``0.312 ± 0.021``; the mean alone where there is no interval."""
    return (
        f"{fixed(mean, decimals)} ± {fixed(half, decimals)}"
        if math.isfinite(half)
        else fixed(mean, decimals)
    )


def _budget(jobs: pd.DataFrame) -> str:
    """Numbers of combinations, seeds and jobs, and the range of epochs, as a sentence."""
    done = jobs[jobs["status"] == DONE]
    seeds = sorted({int(seed) for seed in jobs["seed"]})
    epochs = done["epochs"][done["epochs"] > 0]
    lowest, highest = (f"{epochs.min():.0f}", f"{epochs.max():.0f}") if len(epochs) else ("", "")
    took = (
        f"; training took {lowest if lowest == highest else f'{lowest} to {highest}'} epochs"
        if len(epochs)
        else ""
    )
    counts = (
        f"{jobs['combination'].nunique()} combinations, seeds {', '.join(map(str, seeds))}: "
        f"{len(done)} of {len(jobs)} jobs done"
    )
    return f"Budget: {counts}{took}"


# statements of the report on intervals and on the choice
INTERVAL_AND_CHOICE = (
    "Interval: mean ± half the two-sided 95 % confidence interval of the mean over seeds, t₀.₉₇₅ "
    "s/√n, from Student's t distribution "
    "with n − 1 degrees of freedom; one seed has none. It covers what the seed changes, not what "
    "another drive or car would",
    "Choice: the lowest mean RMSE(β) on the validation range, of the combinations without a "
    "failed seed. Test data choose nothing",
    "Every job: [sweep.csv](sweep.csv). Every combination: [summary.csv](summary.csv)",
)


def _table(artefacts: SweepArtefacts) -> Table:
    """The table ``combinations`` of the report."""
    names = short_names(artefacts.keys)
    table = artefacts.table
    columns = {"title": Column("estimator"), **{key: Column(names[key]) for key in artefacts.keys}}
    columns |= {
        "n_parameters": Column("params", decimals=0),
        "n_seeds": Column("seeds"),
        "n_failed": Column("failed"),
    }
    for name in artefacts.sets:
        decimals = decimals_for(table[f"{METRIC}.{name}"].tolist())
        columns[f"{METRIC}.{name}"] = Column(f"RMSE(β), {name} [deg]", decimals=decimals)
        columns[f"{METRIC}_half.{name}"] = Column("± [deg]", decimals=decimals)
    frame = table.assign(chosen=["chosen" if chosen else "" for chosen in table["chosen"]])
    for key in artefacts.keys:
        if not all(_is_number(value) for value in frame[key]):
            frame[key] = [override_text(value) for value in frame[key]]
        else:
            columns[key] = Column(names[key], each=True)
    caption = (
        "All combinations in the order of the command: mean RMSE(β) over seeds, and half its 95 "
        "% confidence interval."
    )
    return Table("combinations", caption, frame, {**columns, "chosen": Column("on validation")})
