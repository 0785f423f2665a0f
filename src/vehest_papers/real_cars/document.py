"""The report on the real recordings, its tables and its values.

recordings -> statistics, findings of the checks, injected errors -> `report.md.j2`
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from vehest.alignment.checks import checks_of_recording
from vehest.data.recording import Recording
from vehest.report.document import REPORT, Column, Document, Figure, Table, as_code
from vehest.report.style import MISSING, fixed
from vehest.report.template import fill_template
from vehest.studies.artefacts import StoredDataset, StudyArtefacts
from vehest_papers.real_cars.figure import distributions
from vehest_papers.real_cars.planted import detections
from vehest_papers.real_cars.statistics import (
    DRIVEN_SHARE_OF_SPEED,
    MIN_DRIVEN_SECONDS,
    MIN_ERROR_OVER_NOISE,
    MIN_RMS_SIDESLIP,
    RATE_HZ,
    Statistics,
    statistics_of,
)

TEMPLATE = Path(__file__).with_name("report.md.j2")
INJECTED_INTO = "ferrari_250lm"
RANGES = {
    "150 to 450 s": (150.0, 450.0),
    "450 to 550 s": (450.0, 550.0),
    "550 to 700 s": (550.0, 700.0),
}
"""Ranges of the Ferrari's drive into which errors are injected [s]."""
UNDOCUMENTED_POINTS = ("at a point that is not known", "not said")
ERROR_COLUMNS = {
    "sideslip_99": Column("β 99 %", decimals=2),
    "rms": Column("zero", decimals=2),
    "static_map": Column("static map", decimals=2),
    "noise": Column("noise", decimals=3),
    "bound": Column("bound", decimals=2),
    "correlation": Column("correlation", decimals=2),
}
OVERVIEW_CAPTION = (
    "Data sets while driving; angles in deg. β 99 %: 99th percentile of |β|. zero: RMSE(β) of the "
    "zero-sideslip baseline. Static map: RMSE(β) of v = r·(b − k·u²), fitted to the same samples. "
    "Noise: white noise of the reference. Bound: posterior Cramér-Rao bound of all inputs, with "
    "known axles and 23 % uncertainty of the tyre stiffness. Correlation: of v and yaw rate."
)
DISTRIBUTIONS_CAPTION = (
    "Sideslip angle of the reference and lateral acceleration while driving: the marks are the "
    "50th, 90th and 99th percentiles. Open markers: simulated by the publishers."
)


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """Report of all data sets, real ones and those that their publishers simulated.

    Raises
    ------
    DataError
        The file of a recording is damaged.
    """
    by_recording: dict[str, dict[str, Statistics]] = {}
    by_dataset: dict[str, Statistics] = {}
    findings: list[dict[str, str]] = []
    injected = pd.DataFrame()
    for dataset in artefacts.datasets:
        recordings = list(dataset.recordings())
        by_recording[dataset.name] = {
            recording.id: statistics_of([recording]) for recording in recordings
        }
        by_dataset[dataset.name] = statistics_of(recordings)
        for recording in recordings:
            findings += _findings(dataset, recording)
        if dataset.name == INJECTED_INTO:
            injected = _injected(recordings[0])
    recordings_table = _recordings(by_recording)
    findings_table = pd.DataFrame(
        findings, columns=["dataset", "recording", "level", "check", "channel", "message"]
    )
    kinds = [
        (dataset.name, dataset.kind, by_dataset[dataset.name]) for dataset in artefacts.datasets
    ]
    blocks: list[Table | Figure] = [
        _overview(artefacts.datasets, by_dataset),
        Figure("distributions", DISTRIBUTIONS_CAPTION, distributions(kinds)),
        _findings_by_check(findings_table),
    ]
    data = {
        "recordings": recordings_table,
        "findings": findings_table,
        "licences": _licences(artefacts.datasets),
    }
    if len(injected):
        blocks.append(_injected_by_error(injected))
        data["injected"] = injected
    values = _values(artefacts, by_dataset, recordings_table, injected)
    return {REPORT: Document(artefacts.title, fill_template(TEMPLATE, values, blocks), data)}


def _values(
    artefacts: StudyArtefacts,
    by_dataset: Mapping[str, Statistics],
    recordings: pd.DataFrame,
    injected: pd.DataFrame,
) -> dict[str, object]:
    """Numbers and names that the template has places for."""
    kinds = {dataset.name: dataset.kind for dataset in artefacts.datasets}
    able = [name for name, statistics in by_dataset.items() if not statistics.reasons]
    detectable = injected[injected["detectable"]] if len(injected) else injected
    return {
        "able": [f"{as_code(name)} ({kinds[name]})" for name in able],
        "unable": [
            {"name": as_code(name), "reasons": "; ".join(statistics.reasons)}
            for name, statistics in by_dataset.items()
            if statistics.reasons
        ],
        "unknown_points": [
            as_code(name) for name in able if by_dataset[name].point in UNDOCUMENTED_POINTS
        ],
        "absent": [as_code(dataset.name) for dataset in artefacts.absent_datasets],
        "injected": {
            "n_cases": len(injected),
            "n_detectable": len(detectable),
            "n_detected": int(detectable["detected"].sum()),
            "n_false_alarms": int((injected["false_alarms"] != "").sum()),
        }
        if len(injected)
        else None,
        "n_datasets": len(by_dataset),
        "n_recordings": len(recordings),
        "n_able_recordings": int((recordings["reasons"] == "").sum()),
        "minutes": fixed(float(recordings["seconds"].sum()) / 60.0, 0),
        "rate": f"{RATE_HZ:g}",
        "driven_percent": f"{100 * DRIVEN_SHARE_OF_SPEED:.0f}",
        "min_seconds": f"{MIN_DRIVEN_SECONDS:g}",
        "min_sideslip": f"{MIN_RMS_SIDESLIP:g}",
        "min_over_noise": f"{MIN_ERROR_OVER_NOISE:g}",
        "command": as_code(artefacts.command),
    }


def _overview(datasets: Sequence[StoredDataset], by_dataset: Mapping[str, Statistics]) -> Table:
    rows = []
    for dataset in datasets:
        statistics = by_dataset[dataset.name]
        row = {
            "dataset": dataset.name,
            "kind": dataset.kind,
            "recordings": len(dataset.files),
            "minutes": statistics.driven / 60.0,
            **_errors_of(statistics),
            "point": statistics.point,
            "ranks": "no" if statistics.reasons else "yes",
        }
        rows.append(row)
    columns = {
        "dataset": Column("data set"),
        "kind": Column("kind"),
        "recordings": Column("recordings"),
        "minutes": Column("driven [min]", decimals=1),
        **ERROR_COLUMNS,
        "point": Column("reference point"),
        "ranks": Column("can rank"),
    }
    return Table("overview", OVERVIEW_CAPTION, pd.DataFrame(rows), columns)


def _errors_of(statistics: Statistics) -> dict[str, float]:
    """Columns of `ERROR_COLUMNS`."""
    return {
        "sideslip_99": statistics.sideslip[-1],
        "rms": statistics.rms,
        "static_map": statistics.static_map,
        "noise": statistics.noise,
        "bound": statistics.bound,
        "correlation": statistics.correlation,
    }


def _recordings(by_recording: Mapping[str, Mapping[str, Statistics]]) -> pd.DataFrame:
    """A row a recording; ``reasons`` is empty where it can rank estimators."""
    return pd.DataFrame(
        [
            {
                "dataset": dataset,
                "recording": name,
                "seconds": statistics.driven,
                "rate_hz": statistics.native_rate,
                "speed_1": statistics.speed[0],
                "speed_99": statistics.speed[1],
                "ay_99": statistics.ay[-1],
                **_errors_of(statistics),
                "kinematic_bound": statistics.kinematic_bound,
                "reasons": "; ".join(statistics.reasons),
            }
            for dataset, recordings in by_recording.items()
            for name, statistics in recordings.items()
        ]
    )


def _findings(dataset: StoredDataset, recording: Recording) -> list[dict[str, str]]:
    return [
        {
            "dataset": dataset.name,
            "recording": recording.id,
            "level": finding.level,
            "check": finding.check,
            "channel": finding.channel or MISSING,
            "message": finding.message,
        }
        for finding in checks_of_recording(recording)
    ]


def _findings_by_check(findings: pd.DataFrame) -> Table:
    """How many findings each check has, in how many recordings and in which data sets."""
    rows = [
        {
            "check": check,
            "level": level,
            "findings": len(group),
            "recordings": len(group[["dataset", "recording"]].drop_duplicates()),
            "datasets": ", ".join(dict.fromkeys(group["dataset"])),
        }
        for (level, check), group in findings.groupby(["level", "check"])
    ]
    columns = {
        "check": Column("check"),
        "level": Column("level"),
        "findings": Column("findings", decimals=0),
        "recordings": Column("recordings", decimals=0),
        "datasets": Column("data sets"),
    }
    frame = pd.DataFrame(rows, columns=list(columns))
    return Table("findings_by_check", "Findings of `vehest data check`.", frame, columns)


def _injected(recording: Recording) -> pd.DataFrame:
    """Detections in each range of the Ferrari's drive."""
    return pd.concat(
        [detections(recording.cut(*bounds)).assign(range=name) for name, bounds in RANGES.items()],
        ignore_index=True,
    )


def _injected_by_error(injected: pd.DataFrame) -> Table:
    """Cases, detections and false alarms of each kind of error, and the cases that were missed."""
    rows = []
    for name, group in injected.groupby("fault", sort=False):
        detectable = group[group["detectable"]]
        missed = detectable[~detectable["detected"]]
        row = {
            "fault": name,
            "cases": len(group),
            "detectable": len(detectable),
            "detected": int(detectable["detected"].sum()),
            "false_alarms": int((group["false_alarms"] != "").sum()),
            "missed": "; ".join(
                f"{case['channel']} ({case['size']}), {case['range']}"
                for case in missed.to_dict("records")
            )
            or MISSING,
        }
        rows.append(row)
    columns = {
        "fault": Column("error"),
        "cases": Column("cases", decimals=0),
        "detectable": Column("detectable", decimals=0),
        "detected": Column("detected", decimals=0),
        "false_alarms": Column("false alarms", decimals=0),
        "missed": Column("not detected"),
    }
    caption = (
        "Errors injected into the real Ferrari drive. Detectable: the other channels contain the "
        "information. False alarms: cases in which an unchanged channel is named."
    )
    return Table("injected_by_error", caption, pd.DataFrame(rows), columns)


def _licences(datasets: Sequence[StoredDataset]) -> pd.DataFrame:
    return pd.DataFrame(
        [
            {
                "dataset": dataset.name,
                "title": dataset.title,
                "licence": dataset.licence,
                "citation": dataset.citation,
            }
            for dataset in datasets
        ]
    )
