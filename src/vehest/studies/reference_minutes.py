"""The study of how many minutes with a reference an estimator needs, over several cars: its error
over the minutes, a learning curve.

Parts of one study with equal test ranges make a curve: they differ in ``split.minutes`` and
``split.minutes_at``, and in whether trainings start from another model (``training.start_from``).
Minutes count training and validation together, since both need the sensor.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import pandas as pd

from vehest.data.splits import Span
from vehest.evaluation.blocks import Segments
from vehest.evaluation.ranking import BASELINES, Name, Ranking, rank
from vehest.report.document import (
    PATENT_NOTE,
    REPORT,
    Block,
    Column,
    Document,
    Figure,
    Table,
    as_code,
    as_text,
)
from vehest.report.style import DOUBLE_COLUMN, MatplotlibFigure, fixed, line_of, listed, new_figure
from vehest.report.template import fill_template
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts, StudyArtefacts
from vehest.studies.drive import data_of_parts
from vehest.studies.kit.standing import NOT_SIGNIFICANT

TAKES = "parts"  # data that pipelines of this study name (`vehest.studies.registry`)
VERSION = "2"  # raised where tables or figures change
TEMPLATE = Path(__file__).with_name("reference_minutes.md.j2")  # file of the report's template
METRICS = ("rmse_sideslip", "rmse_vy", "fvu", "n_parameters", "epochs")  # those of metrics.csv
SCRATCH = "from scratch"  # start of a training that starts from no model
COLUMNS = {
    "title": Column("estimator"),
    "start": Column("training"),
    "minutes": Column("reference [min]", decimals=2),
    "rmse_sideslip": Column("RMSE(β) [deg]", decimals=3),
    "interval": Column("95 % interval [deg]"),
    "n_trainings": Column("trainings", decimals=0),
    "against_scratch": Column("compared with scratch"),
}
"""Key of `rows_of_curve` -> column of the table in the report."""
COMMON_MINUTES = (0.25, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 30.0, 60.0)
"""Amounts of reference that get a column in the overview where they occur [min].

The error with the most minutes, and their number, follow.
"""
# caption of a figure, with places
FIGURE_CAPTION = "{title}, test set `{test_set}`: RMSE(β) over the minutes of reference."
FIGURE_NOTE = (
    "Minutes are those of recording with a reference for training and validation; bars are 95 % "
    "intervals over blocks of the test and trainings. Dashed: zero-sideslip baseline."
)
"""Note below every figure of a curve."""
# caption of the overview
OVERVIEW_CAPTION = (
    "RMSE(β) [deg] by minutes of reference for training and validation together, over all "
    "trainings with as many minutes."
)
# largest deviation of the recorded minutes from those asked for, over the latter, by which ends of
# a few seconds may shorten them
MAX_MINUTES_DEVIATION = 0.15


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report: errors with each amount of reference as one table, and a figure for each curve.

    Parameters
    ----------
    artefacts : StudyArtefacts
        Parts that differ in ``split.minutes`` and in what trainings start from.

    Returns
    -------
    dict
        One document, named REPORT, with its points as data.
    """
    parts = list(artefacts.parts.values())
    curves = curves_of(parts)
    points = pd.DataFrame(
        [
            {"curve": f"{curve.title}, {curve.test_set}", **row}
            for curve in curves
            for row in rows_of_curve(curve)
        ]
    )
    placed: list[Block] = [overview_table(points)]
    figures = []
    for number, curve in enumerate(curves, start=1):
        caption = FIGURE_CAPTION.format(title=curve.title, test_set=curve.test_set)
        figures.append(f"reference_minutes_{number}")
        placed.append(Figure(figures[-1], caption, _figure(curve)))
    values = {
        "about": artefacts.about.strip(),
        "curves": [summary_of_curve(rows) for _, rows in points.groupby("curve", sort=False)],
        "figures": figures,
        "figure_note": FIGURE_NOTE,
        "n_models": sum(len(part.models) for part in parts),
        "data": list(
            dict.fromkeys(
                f"{as_text(part.data_titles.get(name, name))} ({part.kinds[name]})"
                for part in parts
                for name in part.split.datasets
            )
        ),
        "command": as_code(artefacts.command),
    }
    blocks = [*fill_template(TEMPLATE, values, placed), PATENT_NOTE]
    data = {"points": points, **data_of_parts(artefacts.parts)}
    return {REPORT: Document(artefacts.title, blocks, data)}


def overview_table(points: pd.DataFrame) -> Table:
    """Table of RMSE(β) by minutes of reference (columns), for each estimator, start and test set
    (rows).

    Parameters
    ----------
    points : pd.DataFrame
        Rows of `rows_of_curve` of all curves, with a column ``curve``.

    Returns
    -------
    Table
        ``overview``: a column for each of COMMON_MINUTES that occurs, and the error with the most
        minutes [deg].
    """
    rows = []
    keys = ["curve", "title", "start"]
    amounts: list[float] = sorted(set(points["minutes"]) & set(COMMON_MINUTES))
    for key, group in points.groupby(keys, sort=False):
        by_minutes = group.set_index("minutes")["rmse_sideslip"]
        longest = float(by_minutes.index.max())
        row: dict[str, object] = dict(zip(keys, key, strict=True))
        row |= {f"minutes_{amount:g}": by_minutes.get(amount, math.nan) for amount in amounts}
        row |= {"longest": longest, "longest_rmse": by_minutes[longest]}
        rows.append(row)
    columns = {
        "curve": Column("test set"),
        "title": Column("estimator"),
        "start": Column("training"),
        **{f"minutes_{amount:g}": Column(f"{amount:g} min", decimals=2) for amount in amounts},
        "longest_rmse": Column("all", decimals=2),
        "longest": Column("all [min]", decimals=1),
    }
    return Table("overview", OVERVIEW_CAPTION, pd.DataFrame(rows), columns)


def summary_of_curve(points: pd.DataFrame) -> dict[str, object]:
    """Values for the template of the report: estimators with the lowest error at the fewest and the
    most minutes [deg], and the minutes at which starting from another model makes a significant
    difference.

    ``points`` are rows of `rows_of_curve`, with a column ``curve``.

    Returns
    -------
    dict
        ``title``; ``ends``, the best at the fewest and the most minutes; ``lower`` and ``higher``,
        minutes with a significant difference, as text.
    """
    ends = []
    for minutes in (points["minutes"].min(), points["minutes"].max()):
        of_end = points[points["minutes"] == minutes]
        best = of_end.loc[of_end["rmse_sideslip"].idxmin()]
        ends.append(
            {
                "minutes": f"{minutes:g}",
                "title": best["title"],
                "start": best["start"],
                "rmse": fixed(float(best["rmse_sideslip"]), 2),
            }
        )
    verdicts = {
        verdict: [f"{minutes:g}" for minutes in group["minutes"]]
        for verdict, group in points.groupby("against_scratch")
    }
    return {
        "title": points["curve"].iloc[0],
        "ends": ends,
        "lower": verdicts.get("lower", []),
        "higher": verdicts.get("higher", []),
    }


@dataclass(frozen=True)
class Point:
    """A point of a learning curve: an estimator trained with an amount of reference."""

    estimator: str  # name in the registry
    variant: str  # identifier of its configuration
    title: str  # name in tables and figures
    start: str  # start of its training; `SCRATCH` for nothing
    minutes: float  # recording time with reference for training and validation [min]
    n_trainings: int  # number of trainings: segments of the drive times seeds

    @property
    def name(self) -> Name:
        """Name under which the point is ranked, with start and minutes in place of the variant."""
        return (
            self.estimator,
            ""
            if self.estimator in BASELINES[:1]
            else f"{self.variant}|{self.start}|{self.minutes:g}",
        )


@dataclass(frozen=True)
class Curve:
    """Learning curves on one test set."""

    title: str  # title of the first of its parts
    test_set: str  # name of the test set
    points: Sequence[Point]  # sorted by estimator, start and minutes
    # ranking of all points, without intervals where the test is too short for them
    ranking: Ranking


def curves_of(parts: Sequence[PartArtefacts]) -> list[Curve]:
    """A curve for every test set of parts that share it.

    Test sets with a single amount of reference make none.

    Parameters
    ----------
    parts : sequence of PartArtefacts
        Parts with the same name and ranges of a test set make one curve.

    Returns
    -------
    list of Curve
        In the order in which their test sets first occur.

    Raises
    ------
    DataError
        Stored errors by segment are damaged.
    """
    groups: dict[tuple[str, tuple[Span, ...]], list[PartArtefacts]] = {}
    for part in parts:
        for test_set, spans in part.split.tests.items():
            groups.setdefault((test_set, tuple(spans)), []).append(part)
    curves = [_curve(test_set, parts_of_test) for (test_set, _), parts_of_test in groups.items()]
    return [curve for curve in curves if len({point.minutes for point in curve.points}) > 1]


def _curve(test_set: str, parts: Sequence[PartArtefacts]) -> Curve:
    """The curve of parts that share a test set.

    Minutes are those asked for (``split.minutes``, which ends the split's name), or those recorded
    where these differ by more than MAX_MINUTES_DEVIATION. Seeds and segments of the drive with
    equal minutes are trainings of one point; an estimator with a single point is left out,
    baselines aside.
    """
    models: dict[tuple[str, str, str, float], list[EvaluatedModel]] = {}
    for part in parts:
        named = re.search(r"_([\d.]+)min(_at_[\d.]+)?$", part.split.name)
        recorded = minutes_of(part)
        requested = (
            float(named[1]) if named is not None else math.nan
        )  # by split.minutes, which the split's name then ends in
        minutes = (
            requested
            if abs(recorded - requested) <= MAX_MINUTES_DEVIATION * requested
            else round(recorded, 2)
        )
        for model in part.models:
            models.setdefault((*model.name, start_of(model.training), minutes), []).append(model)
    counts = Counter((estimator, variant) for estimator, variant, _, _ in models)
    points = {
        Point(
            estimator,
            variant,
            as_text(trained[0].title.removesuffix(describe_start(trained[0].training))),
            start,
            minutes,
            len(trained),
        ): trained
        for (estimator, variant, start, minutes), trained in models.items()
        if counts[estimator, variant] > 1 or estimator in BASELINES
    }
    segments: dict[Name, list[Segments]] = {}
    for point, trained in points.items():
        segments.setdefault(point.name, []).extend(model.segments(test_set) for model in trained)
    finite = {
        name: trained
        for name, trained in segments.items()
        if all(part.is_finite for part in trained)
    }
    ordered = sorted(
        (point for point in points if point.name in finite),
        key=lambda p: (p.estimator, p.variant, p.start, p.minutes),
    )
    claimed_pairs = [
        (tuned.name, plain.name)
        for plain in ordered
        for tuned in ordered
        if _differ_in_start(plain, tuned)
    ]
    return Curve(
        as_text(parts[0].title),
        test_set,
        ordered,
        rank(finite, parts[0].protocol.rate_hz, claimed_pairs=claimed_pairs),
    )


def _differ_in_start(plain: Point, tuned: Point) -> bool:
    """Whether two points differ in what their trainings start from alone."""
    have_equal_training = (plain.estimator, plain.variant, plain.minutes) == (
        tuned.estimator,
        tuned.variant,
        tuned.minutes,
    )
    return have_equal_training and plain.start == SCRATCH != tuned.start


def start_of(training: Mapping[str, object]) -> str:
    """Text of what a training started from: `SCRATCH` or ``from MODEL``."""
    start = training.get("start_from")
    return SCRATCH if start is None else f"from {Path(str(start)).name}"


def describe_start(training: Mapping[str, object]) -> str:
    """Suffix of a title: ``, starting from MODEL``; empty where a training starts from scratch."""
    return "" if training.get("start_from") is None else f", starting {start_of(training)}"


def minutes_of(part: PartArtefacts) -> float:
    """Minutes of training and validation ranges together.

    An end that is open is taken from the recording, which is read for it.
    """
    seconds = 0.0
    for span in (*part.split.train, *part.split.validation):
        start = span.start
        stop = span.stop
        if not (math.isfinite(start) and math.isfinite(stop)):
            recording = part.reference(span, ["vx"])
            start = max(start, recording.start_time)
            stop = min(stop, recording.end_time)
        seconds += stop - start
    return seconds / 60.0


def blocks_of_curve(curve: Curve, name: str) -> list[Block]:
    """Sentences, figure and table of the learning curves on one test set; ``name`` ends the files'
    names.
    """
    caption = FIGURE_CAPTION.format(title=curve.title, test_set=curve.test_set)
    return [
        _describe_curve(curve),
        Figure(f"reference_minutes_{name}", f"{caption} {FIGURE_NOTE}", _figure(curve)),
        Table(
            f"reference_minutes_{name}",
            f"{curve.title}: RMSE(β) by minutes of reference. Trainings: segments of the drive "
            "times seeds. The last column: compared with "
            f"the same estimator from scratch on as many minutes, corrected by Holm.",
            pd.DataFrame(rows_of_curve(curve)),
            COLUMNS,
        ),
    ]


def rows_of_curve(curve: Curve) -> list[dict[str, object]]:
    """Rows of the table of a curve, one for each point: title, start, minutes, RMSE(β) [deg], its
    interval as text, number of trainings, and the comparison with training from scratch.

    Returns
    -------
    list of dict
        Without the zero-sideslip baseline; ``against_scratch`` is ``lower``, ``higher``, not
        significant, or a dash where there is nothing to compare with.
    """
    rows: list[dict[str, object]] = []
    for point in curve.points:
        if point.estimator != BASELINES[0]:
            low, high = curve.ranking.intervals.get(point.name, (math.nan, math.nan))
            row = {
                "title": point.title,
                "start": point.start,
                "minutes": point.minutes,
                "rmse_sideslip": curve.ranking.rmse[point.name],
                "interval": f"{fixed(low, 3)} … {fixed(high, 3)}" if math.isfinite(low) else "–",
                "n_trainings": point.n_trainings,
                "against_scratch": _against_scratch(curve, point) or "–",
            }
            rows.append(row)
    return rows


def _against_scratch(curve: Curve, point: Point) -> str:
    """Verdict of a point against the same estimator trained from scratch with as many minutes;
    empty where these were not compared.
    """
    plain = next(
        (candidate for candidate in curve.points if _differ_in_start(candidate, point)), None
    )
    pair = curve.ranking.pairs.get((point.name, plain.name)) if plain is not None else None
    if pair is None:
        return ""
    return pair.verdict if pair.verdict in ("lower", "higher") else NOT_SIGNIFICANT


def _lines(curve: Curve) -> list[list[Point]]:
    """Points of each line of the figure, one for each estimator and start, by rising minutes,
    without the zero-sideslip baseline.
    """
    groups = groupby(curve.points, key=lambda point: (point.estimator, point.variant, point.start))
    return [list(points) for key, points in groups if key[0] != BASELINES[0]]


def _describe_curve(curve: Curve) -> str:
    """Sentences on the errors with the fewest and the most minutes of reference, and on significant
    effects of starting from another model.
    """
    sentences = []
    for first, *_, last in (points for points in _lines(curve) if len(points) > 1):
        origin = "" if first.start == SCRATCH else f" ({first.start})"
        sentences.append(
            f"{first.title}{origin}: {fixed(curve.ranking.rmse[first.name], 2)}° after "
            f"{first.minutes:g} min of reference, "
            f"{fixed(curve.ranking.rmse[last.name], 2)}° after {last.minutes:g} min."
        )
    better = [
        f"{point.minutes:g}" for point in curve.points if _against_scratch(curve, point) == "lower"
    ]
    worse = [
        f"{point.minutes:g}" for point in curve.points if _against_scratch(curve, point) == "higher"
    ]
    if any(_against_scratch(curve, point) for point in curve.points):
        effects = [f"significantly lower with {listed(better)} min"] if better else []
        effects += [f"significantly higher with {listed(worse)} min"] if worse else []
        sentences.append(
            f"Starting from another model, the error is {' and '.join(effects)}."
            if effects
            else (
                "Starting from another model makes no significant difference to starting from "
                "scratch with any amount."
            )
        )
    return f"**{curve.title}.** " + " ".join(sentences)


def _figure(curve: Curve) -> MatplotlibFigure:
    """Draw RMSE(β) over the minutes, both logarithmic, with a line for each estimator and start;
    lines are shifted by 3 % of a value each, so that their intervals do not cover one another.
    """
    from matplotlib.ticker import FuncFormatter, NullFormatter

    ranking = curve.ranking
    with new_figure(DOUBLE_COLUMN, 3.2) as figure:
        axes = figure.subplots()
        drawn = _lines(curve)
        for shift, points in enumerate(drawn):
            line = line_of(points[0].estimator, points[0].variant)
            start = points[0].start
            factor = 1.03 ** (shift - len(drawn) / 2)
            minutes = [point.minutes * factor for point in points]
            errors = [ranking.rmse[point.name] for point in points]
            dash = "solid" if start == SCRATCH else "dashed"
            label = points[0].title + ("" if start == SCRATCH else f", {start}")
            axes.plot(
                minutes,
                errors,
                color=line.colour,
                linestyle=dash,
                marker=line.marker,
                markersize=3.5,
                linewidth=1.1,
                label=label,
            )
            for at, point in zip(minutes, points, strict=True):
                low, high = curve.ranking.intervals.get(point.name, (math.nan, math.nan))
                if math.isfinite(low):
                    axes.plot([at, at], [low, high], color=line.colour, linewidth=0.8)
        nothing = next(
            (ranking.rmse[name] for name in ranking.order if name[0] == BASELINES[0]), math.nan
        )
        if math.isfinite(nothing):
            axes.axhline(
                nothing,
                color="black",
                linewidth=0.7,
                linestyle=(0, (4, 3)),
                label="zero-sideslip baseline",
            )
        axes.set_xscale("log")
        axes.set_yscale("log")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(NullFormatter())
        axes.set_xticks(sorted({round(point.minutes, 1) for point in curve.points}))
        low, high = axes.get_ylim()
        axes.set_yticks(
            [
                tick
                for tick in (
                    0.1,
                    0.2,
                    0.3,
                    0.5,
                    0.7,
                    1.0,
                    1.5,
                    2.0,
                    3.0,
                    5.0,
                    7.0,
                    10.0,
                    15.0,
                    20.0,
                )
                if low <= tick <= high
            ]
        )
        axes.set_xlabel("recording with a reference [min]")
        axes.set_ylabel("RMSE(β) [deg]")
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=6.5, frameon=False)
    return figure
