"""Times of trainings and online steps, for the HTML page alone: since a time is never the same
twice, no published file contains one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pandas as pd

from vehest.report.document import Column, Table

NAME = ("estimator", "variant")  # columns that identify a candidate
# caption of the table of times
CAPTION = (
    "Medians over seeds, wall time on the machine that `provenance.json` names, where others may "
    "have worked at the same time; an online "
    "step is one sample through `step()`. Every figure is in `timings.csv` beside this page, in "
    "seconds."
)


def timings_of_study(
    parts: Sequence[tuple[str, pd.DataFrame, Mapping[tuple[str, str], str]]],
) -> list[str | Table]:
    """Heading and table of the times that each estimator took; empty where none are known.


    Parameters
    ----------
    parts : sequence of tuple
        Of each part its title, its times, and (estimator, variant) -> title. The table of times is
        long: estimator, variant, seed, metric (a time's name), value [s].

    Returns
    -------
    list
        A heading and the table ``timings``: medians over seeds; online steps are in ms there.
    """
    rows = [row for part in parts for row in _rows(*part)]
    if not rows:
        return []
    frame = pd.DataFrame(rows)
    columns_by_name = {
        "part": Column("part"),
        "title": Column("estimator"),
        "fits": Column("fits", decimals=0),
        "train_seconds": Column("training of a seed [s]", digits=2),
        "all_seconds": Column("of all seeds [s]", decimals=0),
        "step_seconds": Column("online step [ms]", digits=2),
    }
    phases = [str(name) for name in frame if name not in columns_by_name]
    columns = {name: column for name, column in columns_by_name.items() if name in frame}
    columns |= {
        name: Column(
            f"of a training: {name.removesuffix('_seconds').replace('_', ' ')} [s]", digits=2
        )
        for name in phases
    }
    if not any(title for title, *_ in parts):
        del columns["part"]
    return ["## Times", Table("timings", CAPTION, frame, columns)]


def _rows(
    part: str, table: pd.DataFrame, titles: Mapping[tuple[str, str], str]
) -> list[dict[str, object]]:
    """Rows of the table, one for each estimator of a part: number of fits, and medians over seeds
    of every time.
    """
    seeds = table.drop_duplicates(
        subset=[*NAME, "seed", "metric"]
    )  # a time of the fit is noted under every test set
    rows = []
    for name, title in titles.items():
        times = seeds[(seeds["estimator"] == name[0]) & (seeds["variant"].fillna("") == name[1])]
        if times.empty:
            continue
        medians = {
            str(metric): float(value)
            for metric, value in times.groupby("metric")["value"].median().items()
        }
        row: dict[str, object] = {
            "part": part,
            "title": title,
            "fits": times["seed"].nunique(),
            "train_seconds": medians.pop("train_seconds", float("nan")),
            "all_seconds": float(times.loc[times["metric"] == "train_seconds", "value"].sum()),
            "step_seconds": 1e3 * medians.pop("step_seconds", float("nan")),
        }
        rows.append(row | medians)
    return rows
