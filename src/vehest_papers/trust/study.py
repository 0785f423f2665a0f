"""The study of trust: coverage of bands, on cars learnt on and on others, and which faults of sensors are flagged in time.

A part of the pipeline is a comparison on one car, or a lap of it. Test sets of cars and tyres that bands were calibrated on stand apart
from those of others. Faults are tried on each part's test ranges at the evaluation rate, with health learnt on its training and
validation ranges.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from vehest.data.store import read_recording
from vehest.estimators.registry import estimator_class
from vehest.evaluation.under_fault import FAULTED
from vehest.report.document import (
    PATENT_NOTE,
    REPORT,
    Block,
    Column,
    Document,
    Figure,
    Table,
    as_text,
)
from vehest.report.figures import Reliability, reliability_figure
from vehest.report.style import lines_of, listed
from vehest.studies.artefacts import PartArtefacts, StudyArtefacts
from vehest.studies.drive import appendix_of
from vehest.studies.kit.drives import COVERAGES
from vehest.studies.kit.runs import by_name
from vehest.trust.bands import LEVELS, OTHER_VEHICLE
from vehest_papers.kit.reading import sideslip_error
from vehest_papers.trust.faults import FaultTrials, health_of, other_vehicle, trials_of
from vehest_papers.trust.integrity import Integrity, false_alarms_per_hour, integrity_of
from vehest_papers.trust.integrity_figures import stanford_figure
from vehest_papers.trust.shuffled import (
    LEARNT,
    if_shuffled,
    in_words,
    over_parts,
    scores_learnt,
    shuffled_in_words,
)

TAKES = "parts"
SHOWS_FAILED = True

OTHER = "another"
FIGURES = (
    "coverage_90_p10",
    "coverage_90_p90",
    "width_90",
    "interval_score",
    "error_icc",
    "band_blocks",
    "rmse_sideslip",
)
SHOWN = ("ksnn", "gru", "kalman", "rational_ekf", "static_map")  # families of the figures


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report: bands on cars learnt on, bands on other vehicles, faults against what could be seen, integrity, then how it was made."""
    parts = artefacts.parts
    board = coverage_board(parts)
    scores = scores_learnt(parts, board)
    board["if_shuffled"] = if_shuffled(parts, board, scores)
    trials = [trials_of(name, part) for name, part in parts.items() if _tries_faults(part)]
    blocks: list[Block] = [artefacts.about] if artefacts.about.strip() else []
    blocks.append(
        f"{_bands_in_words(board)}\n\n{shuffled_in_words(board)}\n\n{_faults_in_words(trials)}"
    )
    blocks += [
        "## Bands on cars and tyres that were learnt on",
        *_bands(board[board["car"] == LEARNT], "learnt"),
        *over_parts(board, scores),
    ]
    blocks += [_reliability(board), _by_acceleration(parts, board)]
    blocks += [
        "## Bands on another car or tyre",
        _widening_in_words(board),
        *_bands(board[board["car"] == OTHER], "elsewhere"),
    ]
    blocks += ["## Faults", *_faults(trials), *_bands_under_faults(parts, trials)]
    stanford = _stanford(parts)
    blocks += ["## Integrity", stanford] if stanford is not None else []
    blocks += [block for name, part in parts.items() for block in appendix_of(name, part)]
    if (board["estimator"] == "ksnn").any():
        blocks.append(PATENT_NOTE)
    return {REPORT: Document(artefacts.title, blocks, {"faults": _cases(trials)})}


def coverage_board(parts: Mapping[str, PartArtefacts]) -> pd.DataFrame:
    """One row an estimator, part and test set: what its 90 % band of β holds, with the 95 % interval over blocks, and how wide it is."""
    rows = []
    for key, part in parts.items():
        metrics = part.metrics
        metrics = metrics[(metrics["subset"] == "all") & (metrics["condition"] == "nominal")]
        for name, models in by_name(part.models).items():
            for test_set in part.split.tests:
                own = metrics[
                    (metrics["estimator"] == name[0]) & (metrics["variant"].fillna("") == name[1])
                ]
                own = own[own["test_set"] == test_set].set_index("metric")
                if "coverage_90" not in own.index:
                    continue
                row: dict[str, Any] = {
                    "part": key,
                    "title": as_text(part.title),
                    "test_set": test_set,
                    "estimator": name[0],
                }
                row |= {"variant": name[1], "estimator_title": as_text(models[0].title)}
                row |= {"car": OTHER if other_vehicle(part, test_set) else LEARNT}
                row |= {
                    figure: float(own["value"][figure])
                    for figure in (*COVERAGES, *FIGURES)
                    if figure in own.index
                }
                row |= {end: float(own[end]["coverage_90"]) for end in ("low", "high")}
                row |= {"inside": in_words(row["low"], row["high"])}
                row |= {
                    "without_widening": _without_widening(part, models[0], test_set)
                    if row["car"] == OTHER
                    else math.nan
                }
                rows.append(row)
    return pd.DataFrame(rows)


def _without_widening(part: PartArtefacts, model: Any, test_set: str) -> float:
    """Coverage if the band were not widened for another car."""
    inside = []
    for position, scored in enumerate(part.scored(model, test_set)):
        band = (
            model.estimate(test_set, position).held_at(scored.time, "band_sideslip") / OTHER_VEHICLE
        )
        inside.append(np.abs(sideslip_error(scored)) <= np.degrees(band))
    return float(np.concatenate(inside).mean())


def _bands_in_words(board: pd.DataFrame) -> str:
    learnt = board[(board["car"] == LEARNT) & (board["inside"] != "no interval")]
    sentences = []
    for label, own in (("All", learnt), *learnt.groupby("title", sort=False)):
        counts = own["inside"].value_counts()
        wide, narrow = (int(counts.get(word, 0)) for word in ("too wide", "too narrow"))
        words = f"{int(counts.get('yes', 0))} of {len(own)} (too wide {wide}, too narrow {narrow})"
        sentences.append(f"**{label}: {words}**" if label == "All" else f"{label}: {words}")
    return (
        "On how many test sets does 0.90 lie inside the 95 % interval of what a 90 % band of β holds, test sets counted once an estimator, "
        f"on cars and tyres that were learnt on? {'; '.join(sentences)}. A wide band earns nothing in the interval score, which stands "
        "beside."
    )


def _widening_in_words(board: pd.DataFrame) -> str:
    own = board[board["car"] == OTHER]
    if own.empty:
        return "There is no such test set."
    with_it = own["coverage_90"].median()
    without = own["without_widening"].median()
    return (
        f"Bands are {OTHER_VEHICLE:g} times as wide there, by a rule that was fixed before. Over estimators and test sets they hold "
        f"{100 * with_it:.0f} % of the errors (median, lowest {100 * own['coverage_90'].min():.0f} %); without the widening "
        f"{100 * without:.0f} % (lowest {100 * own['without_widening'].min():.0f} %)."
    )


def _bands(board: pd.DataFrame, name: str) -> list[Block]:
    if board.empty:
        return []
    shown = board.assign(
        interval=[
            f"{100 * low:.0f} … {100 * high:.0f}"
            for low, high in zip(board["low"], board["high"], strict=True)
        ],
        where=board["title"] + ", " + board["test_set"],
        **{
            column: 100 * board[column]
            for column in ("coverage_90", "coverage_90_p10", "coverage_90_p90", "without_widening")
        },
    )
    columns = {
        "where": Column("test set"),
        "estimator_title": Column("estimator"),
        "rmse_sideslip": Column("RMSE(β) [deg]"),
        "coverage_90": Column("inside [%]", decimals=1),
        "interval": Column("95 % interval [%]"),
        "inside": Column("0.90 in it"),
        "coverage_90_p10": Column("of manoeuvres, 10 % [%]", decimals=0),
        "coverage_90_p90": Column("90 % [%]", decimals=0),
        "width_90": Column("width [deg]"),
        "interval_score": Column("interval score [deg]"),
        "error_icc": Column("correlation", decimals=2),
        "band_blocks": Column("manoeuvres", decimals=1),
    }
    if name == "learnt":
        columns = {**columns, "if_shuffled": Column("0.90 in it if shuffled [%]", decimals=0)}
    if name == "elsewhere":
        columns = {
            **columns,
            "without_widening": Column("inside without the factor [%]", decimals=1),
        }
    caption = (
        "90 % bands of β: errors inside, with the 95 % interval over blocks of the drive and the 10 and 90 % quantiles over manoeuvres; "
        "mean full width; interval score; intraclass correlation of squared errors, 1 where an error lasts for a whole manoeuvre; and how "
        "many equal manoeuvres the errors are spread over."
    )
    if name == "learnt":
        caption += " If shuffled: share of draws with 0.90 in the interval, manoeuvres of calibration and test shuffled."
    return [Table("overview" if name == "learnt" else f"bands_{name}", caption, shown, columns)]


def _reliability(board: pd.DataFrame) -> Figure:
    """Coverage over level, test sets of cars learnt on together, a line a family."""
    learnt = board[board["car"] == LEARNT]
    families = [name for name in SHOWN if name in set(learnt["estimator"])]
    lines = lines_of([(name, "") for name in families])
    rows = []
    for family in families:
        own = learnt[learnt["estimator"] == family]
        values = own[list(COVERAGES)].to_numpy(dtype=float)
        low, high = (np.quantile(values, share, axis=0) for share in (0.1, 0.9))
        rows.append(
            Reliability(
                estimator_class(family).title, lines[family, ""], values.mean(axis=0), low, high
            )
        )
    caption = (
        "Reliability of the bands of β on cars learnt on: errors inside over the nominal level, mean over test sets and variants of a "
        "family, bars from the 10 to the 90 % quantile over them. On the diagonal the coverage is the nominal one."
    )
    return Figure("reliability", caption, reliability_figure(LEVELS, rows))


def _by_acceleration(parts: Mapping[str, PartArtefacts], board: pd.DataFrame) -> Table:
    """Coverage by lateral acceleration, test sets of cars learnt on, mean over estimators."""
    rows = []
    for title, own in board[board["car"] == LEARNT].groupby("title", sort=False):
        part = next(part for part in parts.values() if as_text(part.title) == title)
        tests = set(own["test_set"])
        metrics = part.metrics[
            part.metrics["test_set"].isin(tests) & (part.metrics["metric"] == "coverage_90")
        ]
        by_regime = metrics[metrics["subset"].str.startswith("ay_")].groupby("subset")["value"]
        rows.append(
            {
                "title": title,
                **{str(regime): 100 * float(values.median()) for regime, values in by_regime},
            }
        )
    frame = pd.DataFrame(rows)
    regimes = sorted(str(name) for name in frame if name != "title")
    columns = {
        "title": Column("part"),
        **{name: Column(_range_in_words(name), decimals=0) for name in regimes},
    }
    caption = "Errors inside the 90 % band of β by size of the lateral acceleration, median over estimators."
    return Table("bands_by_acceleration", caption, frame, columns)


def _range_in_words(regime: str) -> str:
    low, high = regime.removeprefix("ay_").split("_")
    return f"{low} to {high} m/s² [%]" if high else f"from {low} m/s² [%]"


# Faults


def _tries_faults(part: PartArtefacts) -> bool:
    """Whether a part's tests are of the car that was learnt on, so that its channels can be held against what is normal for it."""
    return any(not other_vehicle(part, test_set) for test_set in part.split.tests)


def _faults_in_words(trials: Sequence[FaultTrials]) -> str:
    sentences = []
    for data in dict.fromkeys(own.data for own in trials):
        table = pd.concat([own.table for own in trials if own.data == data])
        seen = table[table["visible"]]
        unseen = table[~table["visible"]]
        rate = _alarms_in_words([own for own in trials if own.data == data])
        sentences.append(
            f"{as_text(data)}: of {len(table)} faults in channels a likelihood-ratio test that knows fault, size and onset sees "
            f"{len(seen)} within 10 s. Of these health flags **{int(seen['in_time'].sum())} ({100 * seen['in_time'].mean():.1f} %)** "
            f"within twice its time plus 0.5 s, and {int(seen['flagged'].sum())} while they last; of the {len(unseen)} others "
            f"{int(unseen['flagged'].sum())}. {rate}"
        )
    return "\n\n".join(sentences)


def _alarms_in_words(trials: Sequence[FaultTrials]) -> str:
    rate = false_alarms_per_hour(
        [drive for own in trials for drive in own.nominal], trials[0].rate_hz
    )
    return (
        f"Without faults {rate.alarms} alarms in {rate.hours:.2f} h: {rate.per_hour:.1f} an hour, 95 % interval {rate.low:.1f} to "
        f"{rate.high:.1f}; samples outside what the model learnt count as alarms."
    )


def _cases(trials: Sequence[FaultTrials]) -> pd.DataFrame:
    return pd.concat(
        [own.table.assign(part=own.part, data=own.data) for own in trials], ignore_index=True
    )


def _faults(trials: Sequence[FaultTrials]) -> list[Block]:
    table = _cases(trials)
    blocks: list[Block] = []
    for column, caption in (
        ("part", "By part of the study"),
        ("fault", "By kind of fault"),
        ("channel", "By channel"),
        ("severity", "By severity"),
    ):
        rows = []
        for (data, value), own in table.groupby(["data", column], sort=False):
            seen = own[own["visible"]]
            rows.append(
                {
                    "data": data,
                    "value": value,
                    "cases": len(own),
                    "visible": len(seen),
                    "in_time": int(seen["in_time"].sum()),
                    "share": 100 * float(seen["in_time"].mean()) if len(seen) else math.nan,
                    "oracle": float(seen["oracle_delay"].median()) if len(seen) else math.nan,
                    "delay": float(seen.loc[seen["flagged"], "delay"].median())
                    if seen["flagged"].any()
                    else math.nan,
                    "unseen_flagged": int(own.loc[~own["visible"], "flagged"].sum()),
                }
            )
        columns = {
            "data": Column("data"),
            "value": Column(column),
            "cases": Column("cases", decimals=0),
            "visible": Column("can be seen", decimals=0),
            "in_time": Column("of these in time", decimals=0),
            "share": Column("in time [%]", decimals=1),
            "oracle": Column("oracle's delay, median [s]", decimals=2),
            "delay": Column("delay of health, median [s]", decimals=2),
            "unseen_flagged": Column("flagged though not seen", decimals=0),
        }
        caption = f"{caption}: what can be seen within 10 s, and what health flags in time."
        blocks.append(Table(f"faults_by_{column}", caption, pd.DataFrame(rows), columns))
    blocks.append("Every case stands in [`tables/faults.csv`](tables/faults.csv).")
    return blocks


def bands_under_faults(
    parts: Mapping[str, PartArtefacts], trials: Sequence[FaultTrials]
) -> pd.DataFrame:
    """One row a part and fault: whether the oracle sees such a fault there, and what bands of β hold while it lasts.

    Estimators count whose error it changes; ``lowest`` is that of the worst of them, ``unflagged`` is over samples that are not flagged.
    """
    rows = []
    for key, part in parts.items():
        own = part.metrics[
            (part.metrics["subset"] == FAULTED) & part.metrics["test_set"].isin(part.split.tests)
        ]
        wide = own.assign(variant=own["variant"].fillna("")).pivot_table(
            index=["condition", "estimator", "variant", "test_set"],
            columns="metric",
            values="value",
            sort=False,
        )
        if "coverage_90" not in wide:
            continue
        wide = wide[wide["rmse_sideslip"] != wide["rmse_sideslip_nominal"]]
        table = pd.concat([other.table for other in trials if other.part == key])
        for condition, found in wide.groupby("condition", sort=False):
            kind, channel, severity = str(condition).split(":")[:3]
            tried = table[
                (table["fault"] == kind)
                & (table["channel"] == channel)
                & (table["severity"] == severity)
            ]
            unflagged = (
                found["coverage_90_unflagged"].dropna()
                if "coverage_90_unflagged" in found
                else pd.Series(dtype=float)
            )
            rows.append(
                {
                    "part": as_text(part.title),
                    "fault": kind,
                    "channel": channel,
                    "severity": severity,
                    "visible": "yes" if tried["visible"].any() else "no",
                    "estimators": len(found),
                    "nominal": float(found["rmse_sideslip_nominal"].median()),
                    "faulted": float(found["rmse_sideslip"].median()),
                    "median": 100.0 * float(found["coverage_90"].median()),
                    "lowest": 100.0 * float(found["coverage_90"].min()),
                    "unflagged": 100.0 * float(unflagged.median()) if len(unflagged) else math.nan,
                }
            )
    return pd.DataFrame(rows)


def _bands_under_faults(
    parts: Mapping[str, PartArtefacts], trials: Sequence[FaultTrials]
) -> list[Block]:
    frame = bands_under_faults(parts, trials)
    if frame.empty:
        return []
    unseen = frame[frame["visible"] == "no"]
    words = ""
    if len(unseen):
        held = int((unseen["median"] >= 90.0).sum())
        words = (
            f"Of the {len(unseen)} faults of this table that the likelihood-ratio test does not see, bands of the median estimator hold "
            f"90 % or more under {held}; the lowest such share is {unseen['median'].min():.0f} %, that of the worst estimator "
            f"{unseen['lowest'].min():.0f} %."
        )
    columns = {
        "part": Column("part"),
        "fault": Column("fault"),
        "channel": Column("channel"),
        "severity": Column("severity"),
        "visible": Column("can be seen"),
        "estimators": Column("estimators", decimals=0),
        "nominal": Column("RMSE(β) without [deg]", decimals=2),
        "faulted": Column("with it [deg]", decimals=2),
        "median": Column("inside, median [%]", decimals=0),
        "lowest": Column("lowest [%]", decimals=0),
        "unflagged": Column("while nothing is flagged [%]", decimals=0),
    }
    caption = (
        "Bands of β at 90 % while a fault of 10 s lasts, under the contract and with the factor of health; medians over the estimators "
        "whose error the fault changes."
    )
    return [*([words] if words else []), Table("bands_under_faults", caption, frame, columns)]


def _stanford(parts: Mapping[str, PartArtefacts]) -> Figure | None:
    """Errors over protection levels, real laps of cars learnt on together."""
    found: dict[str, list[Integrity]] = {}
    for part in parts.values():
        if (
            "real" not in set(part.kinds.values())
            or not _tries_faults(part)
            or "vx" not in _channels_of(part)
        ):
            continue
        status = health_of(part)
        for name, models in by_name(part.models).items():
            if name[0] not in ("ksnn", "rational_ekf", "static_map"):
                continue
            for test_set in part.split.tests:
                for position, scored in enumerate(part.scored(models[0], test_set)):
                    band = (
                        models[0].estimate(test_set, position).held_at(scored.time, "band_sideslip")
                    )
                    invalid = status[test_set, position][-len(scored.time) :] == 2
                    own = integrity_of(sideslip_error(scored), np.degrees(band), invalid)
                    found.setdefault(as_text(models[0].title), []).append(own)
    if not found:
        return None
    joined = {
        title: Integrity(
            np.concatenate([own.error for own in laps]),
            np.concatenate([own.level for own in laps]),
            np.concatenate([own.flagged for own in laps]),
        )
        for title, laps in found.items()
    }
    shares = []
    for title, own in joined.items():
        shares.append(
            f"{title}: "
            + listed([f"{100 * share:.2g} % {region}" for region, share in own.shares().items()])
        )
    caption = (
        "Stanford diagrams of β on the real Ferrari, all laps, without faults: size of the error over the protection level, which is the "
        "90 % band; alert limit 2°. Misleading: the error exceeds the level and nothing is flagged. "
        + "; ".join(shares)
        + "."
    )
    return Figure("stanford", caption, stanford_figure(joined))


def _channels_of(part: PartArtefacts) -> set[str]:
    return set(read_recording(next(iter(part.references.values()))).channels)
