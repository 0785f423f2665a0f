"""Tables of the injected faults: what the likelihood-ratio test detects, what health flags in time,
and what bands cover meanwhile.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence

import pandas as pd

from vehest.evaluation.under_fault import FAULTED
from vehest.report.document import Column, Table, as_text
from vehest.report.style import fixed
from vehest.studies.artefacts import PartArtefacts
from vehest_papers.trust.faults import FaultTrials
from vehest_papers.trust.integrity import false_alarms_per_hour

DATA_CAPTION = (
    "Injected faults, those that the likelihood-ratio test detects, and of these the ones that "
    "health flags in time; median delays. False alarms: of health without faults, with the 95 % "
    "interval; samples outside the range of the training count."
)
UNDER_FAULTS_CAPTION = (
    "Coverage of the 90 % band of β during a fault of 10 s{parts}, with the factor of health; "
    "medians over the estimators whose error the fault changes."
)


def all_cases(trials: Sequence[FaultTrials]) -> pd.DataFrame:
    """Every fault of every part."""
    tables = [trial.table.assign(part=trial.part, data=trial.data) for trial in trials]
    return pd.concat(tables, ignore_index=True)


def summary(cases: pd.DataFrame, *columns: str) -> pd.DataFrame:
    """Counts and delays of the cases, a row a combination of values of columns."""
    rows = []
    for values, group in cases.groupby(list(columns), sort=False):
        detectable = group[group["detectable"]]
        row = {
            **dict(zip(columns, values, strict=True)),
            "cases": len(group),
            "detectable": len(detectable),
            "in_time": int(detectable["in_time"].sum()),
            "in_time_percent": 100 * float(detectable["in_time"].mean())
            if len(detectable)
            else math.nan,
            "test_delay": detectable["test_delay"].median(),
            "health_delay": detectable.loc[detectable["flagged"], "delay"].median(),
            "flagged_not_detectable": int(group.loc[~group["detectable"], "flagged"].sum()),
        }
        rows.append(row)
    return pd.DataFrame(rows)


def by_data(counted: pd.DataFrame, trials: Sequence[FaultTrials]) -> Table:
    """`summary` by data, with the false alarms of health."""
    rows = []
    for row in counted.to_dict("records"):
        of_data = [trial for trial in trials if trial.data == row["data"]]
        drives = [drive for trial in of_data for drive in trial.nominal]
        rate = false_alarms_per_hour(drives, of_data[0].rate_hz)
        alarms: dict[Hashable, object] = {
            "data": as_text(row["data"]),
            "hours": rate.hours,
            "alarms": rate.alarms,
            "interval": f"{fixed(rate.low, 1)} … {fixed(rate.high, 1)}",
        }
        rows.append({**row, **alarms})
    columns = {
        "data": Column("data"),
        "cases": Column("faults", decimals=0),
        "detectable": Column("detectable", decimals=0),
        "in_time": Column("in time", decimals=0),
        "in_time_percent": Column("in time [%]", decimals=1),
        "test_delay": Column("delay of the test [s]", decimals=2),
        "health_delay": Column("delay of health [s]", decimals=2),
        "flagged_not_detectable": Column("flagged, not detectable", decimals=0),
        "hours": Column("without faults [h]", decimals=2),
        "alarms": Column("false alarms", decimals=0),
        "interval": Column("an hour"),
    }
    return Table("faults_by_data", DATA_CAPTION, pd.DataFrame(rows), columns)


def bands_under_faults(parts: Mapping[str, PartArtefacts], cases: pd.DataFrame) -> pd.DataFrame:
    """Coverage of the bands of β during faults.

    Returns
    -------
    DataFrame
        A row a part and fault, over the estimators whose error it changes; ``lowest`` is that of
        the worst of them, ``unflagged`` is over samples that are not flagged.
    """
    rows = []
    for key, part in parts.items():
        metrics = part.metrics
        metrics = metrics[
            (metrics["subset"] == FAULTED) & metrics["test_set"].isin(part.split.tests)
        ]
        wide = metrics.assign(variant=metrics["variant"].fillna("")).pivot_table(
            index=["condition", "estimator", "variant", "test_set"],
            columns="metric",
            values="value",
            sort=False,
        )
        if "coverage_90" not in wide:
            continue
        wide = wide[wide["rmse_sideslip"] != wide["rmse_sideslip_nominal"]]
        of_part = cases[cases["part"] == key]
        for condition, group in wide.groupby("condition", sort=False):
            kind, channel, severity = str(condition).split(":")[:3]
            tried = of_part[
                (of_part["fault"] == kind)
                & (of_part["channel"] == channel)
                & (of_part["severity"] == severity)
            ]
            row = {
                "part": as_text(part.title),
                "fault": kind,
                "channel": channel,
                "severity": severity,
                "detectable": "yes" if tried["detectable"].any() else "no",
                "estimators": len(group),
                "nominal": float(group["rmse_sideslip_nominal"].median()),
                "faulted": float(group["rmse_sideslip"].median()),
                "median": 100.0 * float(group["coverage_90"].median()),
                "lowest": 100.0 * float(group["coverage_90"].min()),
                "unflagged": 100.0 * float(group["coverage_90_unflagged"].median())
                if "coverage_90_unflagged" in group
                else math.nan,
            }
            rows.append(row)
    return pd.DataFrame(rows)


def bands_under_faults_table(frame: pd.DataFrame) -> Table:
    """The table of `bands_under_faults`."""
    parts = list(frame["part"].unique())
    columns = {
        **({"part": Column("part")} if len(parts) > 1 else {}),
        "fault": Column("fault"),
        "channel": Column("channel"),
        "severity": Column("severity"),
        "detectable": Column("detectable"),
        "estimators": Column("estimators", decimals=0),
        "nominal": Column("RMSE(β) without [deg]", decimals=2),
        "faulted": Column("with [deg]", decimals=2),
        "median": Column("coverage, median [%]", decimals=0),
        "lowest": Column("lowest [%]", decimals=0),
        "unflagged": Column("while not flagged [%]", decimals=0),
    }
    caption = UNDER_FAULTS_CAPTION.format(parts="" if len(parts) > 1 else f" ({parts[0]})")
    return Table("bands_under_faults", caption, frame, columns)
