"""Coverage of the calibrated bands of β: a row an estimator and test set, and summaries."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pandas as pd

from vehest.estimators.registry import estimator_class
from vehest.report.document import Column, Figure, Table, as_text
from vehest.report.figures import Reliability, reliability_figure
from vehest.report.style import fixed, lines_of
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts, nominal_rows
from vehest.studies.kit.drives import COVERAGES
from vehest.studies.kit.runs import by_name
from vehest.trust.bands import LEVELS, OTHER_VEHICLE
from vehest_papers.kit.reading import sideslip_error
from vehest_papers.trust.faults import is_other_vehicle

TRAINED = "trained on"
OTHER_CAR = "another"
"""Values of column ``car``: whether a test is of a car and tyre that bands were calibrated on."""
METRICS = (
    "coverage_90_p10",
    "coverage_90_p90",
    "width_90",
    "interval_score",
    "error_icc",
    "band_blocks",
    "rmse_sideslip",
)
DRAWN_FAMILIES = ("ksnn", "gru", "kalman", "rational_ekf", "static_map")
OVERVIEW_CAPTION = (
    "90 % bands of β on cars and tyres of the training, by part. Contained: tests of which the "
    "95 % interval of the coverage over blocks of the drive contains 0.90. If shuffled: the share "
    "with manoeuvres of calibration and test shuffled. Coverage, full width and interval score: "
    "medians over estimators."
)
RELIABILITY_CAPTION = (
    "Coverage of the bands of β over the nominal level, on cars of the training. Mean over test "
    "sets and variants of a family; bars from the 10 to the 90 % quantile over them."
)
ACCELERATION_CAPTION = (
    "Coverage of the 90 % band of β by size of the lateral acceleration, on cars of the training, "
    "median over estimators."
)
OTHER_CAPTION = (
    f"90 % bands of β on another car or tyre, {OTHER_VEHICLE:g} times as wide: coverage over "
    "estimators, and without the factor."
)


def coverage_board(parts: Mapping[str, PartArtefacts]) -> pd.DataFrame:
    """Coverage of the 90 % band of β with its 95 % interval over blocks, its width and score.

    Returns
    -------
    DataFrame
        A row an estimator, part and test set; ``contained`` says whether 0.90 is in the interval,
        ``without_widening`` is NaN on cars of the training.
    """
    rows = []
    for key, part in parts.items():
        metrics = nominal_rows(part.metrics).fillna({"variant": ""})
        for (estimator, variant), models in by_name(part.models).items():
            of_estimator = metrics[
                (metrics["estimator"] == estimator) & (metrics["variant"] == variant)
            ]
            for test_set in part.split.tests:
                values = of_estimator[of_estimator["test_set"] == test_set].set_index("metric")
                if "coverage_90" not in values.index:
                    continue
                is_other = is_other_vehicle(part, test_set)
                low, high = (float(values[end]["coverage_90"]) for end in ("low", "high"))
                row: dict[str, object] = {
                    "part": key,
                    "title": as_text(part.title),
                    "test_set": test_set,
                    "estimator": estimator,
                    "variant": variant,
                    "estimator_title": as_text(models[0].title),
                    "car": OTHER_CAR if is_other else TRAINED,
                    **{
                        metric: float(values["value"][metric])
                        for metric in (*COVERAGES, *METRICS)
                        if metric in values.index
                    },
                    "low": low,
                    "high": high,
                    "contained": contains_level(low, high),
                    "without_widening": _coverage_without_widening(part, models[0], test_set)
                    if is_other
                    else math.nan,
                }
                rows.append(row)
    return pd.DataFrame(rows)


def contains_level(low: float, high: float) -> str:
    """Whether 0.90 is in an interval of the coverage: ``yes``, ``too wide``, ``too narrow``."""
    if math.isnan(low):
        return "no interval"
    if low > 0.9:
        return "too wide"
    return "yes" if high >= 0.9 else "too narrow"


def _coverage_without_widening(part: PartArtefacts, model: EvaluatedModel, test_set: str) -> float:
    """Coverage if the band were not widened for another car."""
    is_inside = []
    for position, scored in enumerate(part.scored(model, test_set)):
        estimate = model.estimate(test_set, position)
        band = np.degrees(estimate.held_at(scored.time, "band_sideslip") / OTHER_VEHICLE)
        is_inside.append(np.abs(sideslip_error(scored)) <= band)
    return float(np.concatenate(is_inside).mean())


def counts(board: pd.DataFrame) -> dict[str, object]:
    """How many tests have 0.90 in their interval, and how many would if shuffled [%]."""
    board = board[board["contained"] != "no interval"]
    return {
        "tests": len(board),
        "contained": int((board["contained"] == "yes").sum()),
        "contained_percent": fixed(100 * float((board["contained"] == "yes").mean()), 0),
        "too_wide": int((board["contained"] == "too wide").sum()),
        "too_narrow": int((board["contained"] == "too narrow").sum()),
        "if_shuffled": fixed(float(board["if_shuffled"].mean()), 0),
    }


def overview(board: pd.DataFrame) -> Table:
    """A row a part, and one of all."""
    groups = [*board.groupby("title", sort=False), ("all", board)]
    rows = []
    for title, group in groups:
        numbers = counts(group)
        row = {
            "part": title,
            **{name: numbers[name] for name in ("tests", "contained", "too_wide", "too_narrow")},
            "if_shuffled": group.loc[group["contained"] != "no interval", "if_shuffled"].mean(),
            "coverage_90": 100 * group["coverage_90"].median(),
            "width_90": group["width_90"].median(),
            "interval_score": group["interval_score"].median(),
        }
        rows.append(row)
    columns = {
        "part": Column("part"),
        "tests": Column("tests", decimals=0),
        "contained": Column("contained", decimals=0),
        "too_wide": Column("too wide", decimals=0),
        "too_narrow": Column("too narrow", decimals=0),
        "if_shuffled": Column("if shuffled [%]", decimals=0),
        "coverage_90": Column("coverage [%]", decimals=1),
        "width_90": Column("width [deg]", decimals=2),
        "interval_score": Column("interval score [deg]", decimals=2),
    }
    return Table("overview", OVERVIEW_CAPTION, pd.DataFrame(rows), columns)


def reliability(board: pd.DataFrame) -> Figure:
    """Coverage over level, a line a family."""
    families = [name for name in DRAWN_FAMILIES if name in set(board["estimator"])]
    lines = lines_of([(name, "") for name in families])
    rows = []
    for family in families:
        values = board.loc[board["estimator"] == family, list(COVERAGES)].to_numpy(dtype=float)
        low, high = (np.quantile(values, share, axis=0) for share in (0.1, 0.9))
        title = estimator_class(family).title
        rows.append(Reliability(title, lines[family, ""], values.mean(axis=0), low, high))
    return Figure("reliability", RELIABILITY_CAPTION, reliability_figure(LEVELS, rows))


def by_acceleration(parts: Mapping[str, PartArtefacts], board: pd.DataFrame) -> Table:
    """Coverage by lateral acceleration, a row a part."""
    rows = []
    for (key, title), group in board.groupby(["part", "title"], sort=False):
        metrics = parts[str(key)].metrics
        metrics = metrics[
            metrics["test_set"].isin(set(group["test_set"]))
            & (metrics["metric"] == "coverage_90")
            & metrics["subset"].str.startswith("ay_")
        ]
        medians = 100 * metrics.groupby("subset")["value"].median()
        rows.append({"title": title, **{str(regime): value for regime, value in medians.items()}})
    frame = pd.DataFrame(rows)
    regimes = sorted(str(name) for name in frame if name != "title")
    columns = {"title": Column("part")}
    columns |= {name: Column(_describe_regime(name), decimals=0) for name in regimes}
    return Table("bands_by_acceleration", ACCELERATION_CAPTION, frame, columns)


def _describe_regime(regime: str) -> str:
    low, high = regime.removeprefix("ay_").split("_")
    return f"{low} to {high} m/s² [%]" if high else f"from {low} m/s² [%]"


def by_other_test(board: pd.DataFrame) -> Table:
    """Coverage on other cars and tyres, a row a test."""
    rows = [
        {
            "test": f"{title}, {test_set}",
            "estimators": len(group),
            "coverage": 100 * group["coverage_90"].median(),
            "lowest": 100 * group["coverage_90"].min(),
            "without": 100 * group["without_widening"].median(),
            "lowest_without": 100 * group["without_widening"].min(),
        }
        for (title, test_set), group in board.groupby(["title", "test_set"], sort=False)
    ]
    columns = {
        "test": Column("test"),
        "estimators": Column("estimators", decimals=0),
        "coverage": Column("coverage, median [%]", decimals=0),
        "lowest": Column("lowest [%]", decimals=0),
        "without": Column("without the factor, median [%]", decimals=0),
        "lowest_without": Column("lowest [%]", decimals=0),
    }
    return Table("bands_by_other_test", OTHER_CAPTION, pd.DataFrame(rows), columns)
