"""The report: which recordings can rank estimators, what is in each, what the checks find, and how well they find planted faults."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from vehest.alignment.checks import checks_of_recording
from vehest.data.recording import Recording
from vehest.report.document import REPORT, Block, Column, Document, Figure, Table, as_code
from vehest.report.style import MISSING, fixed, listed
from vehest.studies.artefacts import StoredDataset, StudyArtefacts
from vehest_papers.real_cars.figure import distributions
from vehest_papers.real_cars.planted import detections
from vehest_papers.real_cars.statistics import (
    DRIVEN,
    LEAST_OVER_NOISE,
    LEAST_SECONDS,
    LEAST_SIDESLIP,
    RATE,
    Statistics,
    statistics_of,
)

PLANTED_IN = "ferrari_250lm"
RANGES = {
    "150 to 450 s": (150.0, 450.0),
    "450 to 550 s": (450.0, 550.0),
    "550 to 700 s": (550.0, 700.0),
}  # of the Ferrari's drive


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report of all data sets, real ones and those that their publishers simulated.

    Raises:
        DataError: a recording's file is damaged.
    """
    own: dict[str, dict[str, Statistics]] = {}
    together: dict[str, Statistics] = {}
    findings = []
    planted: list[pd.DataFrame] = []
    for dataset in artefacts.datasets:
        recordings = list(dataset.recordings())
        own[dataset.name] = {recording.id: statistics_of([recording]) for recording in recordings}
        together[dataset.name] = statistics_of(recordings)
        findings += [row for recording in recordings for row in _findings(dataset, recording)]
        if dataset.name == PLANTED_IN:
            planted = [
                detections(recordings[0].cut(*bounds)).assign(range=name)
                for name, bounds in RANGES.items()
            ]
    blocks: list[Block] = [
        *_headline(artefacts, together),
        _overview(artefacts.datasets, together),
        _rules(),
        Figure(
            "distributions",
            "Sizes of the reference's sideslip angle and of the lateral acceleration while driving: 50, 90 and 99 % of the samples lie "
            "below the three marks of a row. Open markers: simulated by its publishers.",
            distributions(
                [
                    (dataset.name, dataset.kind, together[dataset.name])
                    for dataset in artefacts.datasets
                ]
            ),
        ),
        "## Every recording",
        _recordings(own),
        "## What the checks find",
        _findings_table(findings),
    ]
    if planted:
        blocks += [
            "## Faults planted into real data",
            *_planted(pd.concat(planted, ignore_index=True)),
        ]
    blocks += ["## Licences and citations", _licences(artefacts.datasets), _how(artefacts)]
    return {REPORT: Document(artefacts.title, blocks)}


def _headline(artefacts: StudyArtefacts, together: Mapping[str, Statistics]) -> list[Block]:
    kinds = {dataset.name: dataset.kind for dataset in artefacts.datasets}
    able = [name for name, found in together.items() if not found.reasons]
    unable = [
        f"{as_code(name)} ({'; '.join(found.reasons)})"
        for name, found in together.items()
        if found.reasons
    ]
    hidden = [
        name
        for name, found in together.items()
        if not found.reasons and ("not known" in found.point or found.point == "not said")
    ]
    text = (
        f"**Of {len(together)} data sets {len(able)} can rank estimators** by the rules below: "
        f"{listed([f'{as_code(name)} ({kinds[name]})' for name in able])}."
    )
    if unable:
        text += f"\n\nNot: {listed(unable)}."
    if hidden:
        text += (
            f"\n\nWhere the reference of {listed([as_code(name) for name in hidden])} was measured is not known: a comparison there "
            f"ranks lever arms too, and errors are to be read with the best lever arm."
        )
    absent = [f"{as_code(missing.name)}" for missing in artefacts.absent_datasets]
    if absent:
        text += f"\n\nMissing when this was made: {listed(absent)}."
    return [block for block in (artefacts.about, text) if block.strip()]


def _overview(datasets: Sequence[StoredDataset], together: Mapping[str, Statistics]) -> Table:
    rows = [
        {
            "dataset": dataset.name,
            "kind": dataset.kind,
            "recordings": len(dataset.files),
            "minutes": together[dataset.name].driven / 60.0,
            **_figures_of(together[dataset.name]),
            "point": together[dataset.name].point,
            "ranks": "yes" if not together[dataset.name].reasons else "no",
        }
        for dataset in datasets
    ]
    return Table(
        "overview",
        f"Data sets, all recordings together, while driving (faster than {100 * DRIVEN:.0f} % of the recording's highest speed), at "
        f"{RATE:g} Hz. β 99 %: of the samples lie below. v = 0 and static map: RMSE(β) of knowing nothing, and of v = r·(b − k·u²) fitted "
        f"on these very samples. Noise: white noise of the reference, a lower bound. Bound: posterior Cramér-Rao bound from all "
        f"inputs, axles known but for 23 % of the tyres' stiffness; its levels of noise are those of all recordings together, too high for "
        f"the quiet ones. All in deg. Correlation: of v with the yaw rate.",
        pd.DataFrame(rows),
        {
            "dataset": Column("data set"),
            "kind": Column("kind"),
            "recordings": Column("recordings"),
            "minutes": Column("driven [min]", decimals=1),
            **_COLUMNS,
            "point": Column("reference point"),
            "ranks": Column("can rank"),
        },
    )


_COLUMNS = {
    "sideslip_99": Column("β 99 %", decimals=2),
    "rms": Column("v = 0", decimals=2),
    "static_map": Column("static map", decimals=2),
    "noise": Column("noise", decimals=3),
    "bound": Column("bound", decimals=2),
    "correlation": Column("correlation", decimals=2),
}


def _figures_of(found: Statistics) -> dict[str, float]:
    names = ("rms", "static_map", "noise", "bound", "correlation")
    return {
        "sideslip_99": found.sideslip[-1],
        **{name: float(getattr(found, name)) for name in names},
    }


def _rules() -> str:
    return (
        f"**Rules**, set before this table was first drawn. A recording can rank estimators if it has a reference of v, "
        f"{LEAST_SECONDS:g} s of driving, a sideslip of {LEAST_SIDESLIP:g}° (rms) or more, and if a static map fitted on it leaves more "
        f"than {LEAST_OVER_NOISE:g} times the reference's noise: else there is nothing to be told apart, or no way to tell. The noise is a "
        f"lower bound: what is slow or smoothed in a reference is not seen, so 'yes' means that nothing speaks against it."
    )


def _recordings(own: Mapping[str, Mapping[str, Statistics]]) -> Table:
    rows = [
        {
            "dataset": dataset,
            "recording": name,
            "seconds": found.driven,
            "rate": found.native_rate,
            "speed": f"{fixed(found.speed[0], 1)} … {fixed(found.speed[1], 1)}"
            if math.isfinite(found.speed[0])
            else MISSING,
            "ay_99": found.ay[-1],
            **_figures_of(found),
            "kinematic_bound": found.kinematic_bound,
            "why": "; ".join(found.reasons) or "yes",
        }
        for dataset, recordings in own.items()
        for name, found in recordings.items()
    ]
    return Table(
        "recordings",
        "The same for each recording; speed at 1 and 99 % of the time. Kinematic bound: from u, ω, a_y and a_x alone, nothing known of the "
        "car.",
        pd.DataFrame(rows),
        {
            "dataset": Column("data set"),
            "recording": Column("recording"),
            "seconds": Column("driven [s]", decimals=0),
            "rate": Column("rate [Hz]", decimals=0),
            "speed": Column("u [m/s]"),
            "ay_99": Column("|a_y| 99 % [m/s²]", decimals=1),
            **_COLUMNS,
            "kinematic_bound": Column("kinematic bound", decimals=2),
            "why": Column("can rank, or why not"),
        },
    )


def _findings(dataset: StoredDataset, recording: Recording) -> list[dict[str, str]]:
    return [
        {
            "dataset": dataset.name,
            "recording": recording.id,
            "level": found.level,
            "check": found.check,
            "channel": found.channel or MISSING,
            "message": found.message,
        }
        for found in checks_of_recording(recording)
    ]


def _findings_table(findings: Sequence[Mapping[str, str]]) -> Table:
    frame = pd.DataFrame(
        findings, columns=["dataset", "recording", "level", "check", "channel", "message"]
    )
    columns = {name: Column(name) for name in frame.columns} | {
        "dataset": Column("data set"),
        "message": Column("finding"),
    }
    return Table(
        "findings",
        "Everything that `vehest data check` says of these recordings: delays, held and slow channels among it.",
        frame,
        columns,
    )


def _planted(found: pd.DataFrame) -> list[Block]:
    """Detections and false alarms, in sentences and as a table, a row a fault and range."""
    decidable = found[found["decidable"]]
    alarms = found[found["false_alarms"] != ""]
    missed = decidable[~decidable["found"]]
    text = (
        f"Into three ranges of the real Ferrari drive {len(found)} faults were planted. Of {len(decidable)} that the channels can "
        f"show **{int(decidable['found'].sum())} were found**, and in **{len(alarms)}** of all {len(found)} cases an untouched "
        f"channel was accused. Thresholds come from the first range, but the method was revised after all three had been seen: none of "
        f"them is an untouched test."
    )
    if len(missed):
        text += f" Missed: {listed([_case(row) for row in missed.to_dict('records')])}."
    shown = found.assign(
        found=np.where(
            found["decidable"], np.where(found["found"], "yes", "**no**"), "cannot be told"
        ),
        false_alarms=found["false_alarms"].replace("", MISSING),
        reported=found["reported"].replace("", MISSING),
    )
    caption = "Faults planted into real data, what the checks find, and false alarms: findings on untouched channels."
    columns = {
        "range": Column("range"),
        "fault": Column("fault"),
        "channel": Column("channel"),
        "size": Column("size"),
        "found": Column("found"),
        "reported": Column("named"),
        "false_alarms": Column("false alarms"),
    }
    return [text, Table("planted", caption, shown, columns)]


def _case(row: Mapping[object, object]) -> str:
    return f"{row['channel']} {row['fault']} ({row['size']}) in {row['range']}"


def _licences(datasets: Sequence[StoredDataset]) -> Table:
    rows = [
        {"dataset": own.name, "title": own.title, "licence": own.licence, "citation": own.citation}
        for own in datasets
    ]
    columns = {
        "dataset": Column("data set"),
        "title": Column("what"),
        "licence": Column("licence"),
        "citation": Column("cite"),
    }
    return Table(
        "licences",
        "Whose recordings they are. None of them comes with vehest.",
        pd.DataFrame(rows),
        columns,
    )


def _how(artefacts: StudyArtefacts) -> str:
    return f"## Appendix: how it was made\n\n- Command: {as_code(artefacts.command)}\n- No estimator is trained, no figure depends on a seed."
