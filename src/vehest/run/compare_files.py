"""Scores estimates of any tool, and of vehest's models, beside each other on one recording with a reference.

tables, models -> `Estimate` each -> scored where all of them have values, beside v = 0 and a static map -> ranking and verdict
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vehest.alignment.checks import checks_of_recording, merged_findings, refuse_errors
from vehest.constants import FloatArray
from vehest.data.car import CarValues
from vehest.data.errors import ConfigurationError, DataError, listed, printable
from vehest.data.estimate import Estimate
from vehest.data.limits import limits_from_config, use_limits
from vehest.data.recording import Recording
from vehest.data.schema import validated
from vehest.data.splits import Span
from vehest.data.store import is_stored_estimate, read_estimate
from vehest.estimators.static_map import StaticMap
from vehest.evaluation.blocks import segments_of
from vehest.evaluation.metrics import Protocol, accuracy, min_sideslip_speed, score
from vehest.evaluation.ranking import rank
from vehest.run.car_record import adapted
from vehest.run.config import compose_config
from vehest.run.config_files import is_file_name
from vehest.run.downsample import resampled
from vehest.run.estimate import (
    estimate_recording,
    finding_in_words,
    is_training_recording,
    open_model,
    same_vehicle_from_config,
    split_settings,
)
from vehest.run.printing import SCORE_HEADER, TerminalTable, complain, counted, note, score_cells
from vehest.run.reference_checks import CHECKS_OF_SIGNS_AND_UNITS
from vehest.sources.base import read_single
from vehest.sources.tables import column_names
from vehest.sources.unit_spellings import plain_unit
from vehest.studies.kit.standing import standing_columns, verdict_sentences

SPELLINGS = {
    "time": {"time", "t", "timestamp", "zeit"},
    "vy_ref": {"vy", "v", "vlat", "lateralvelocity", "vyest", "vyhat"},
    "sideslip_ref": {
        "sideslip",
        "beta",
        "β",
        "slip",
        "slipangle",
        "sideslipangle",
        "betaest",
        "betahat",
    },
}
"""Time, or channel that a quantity is read as -> how a table may call it, spaces and underscores aside."""
OF_VEHEST = frozenset({"band_vy", "band_sideslip", "health_reason"})
"""Columns that estimates of vehest have, and those of other tools do not."""
USUAL_UNITS = {"time": "s", "vy_ref": "m/s", "sideslip_ref": "rad"}
TIME_UNITS = {"s": "s", "sec": "s", "ms": "ms", "us": "us", "µs": "us", "ns": "ns"}
LEAST_SECONDS = 5.0
LOWEST_RATE = 1.0  # Hz
RATE_HZ = 20.0  # at which estimates are scored, unless the recording has less


def compare_files(
    recording: Path, words: Sequence[str], models: Sequence[str]
) -> tuple[dict[str, Any], list[str | TerminalTable]]:
    """Score estimates of other tools, and models, on one recording: for JSON and for a terminal.

    Raises `VehestError` where a file or model cannot be used.
    """
    files = [Path(word) for word in words if is_file_name(word)]
    settings, overrides = split_settings([word for word in words if not is_file_name(word)])
    config = compose_config("estimate", overrides)
    notes: list[str] = []
    trained_here: list[str] = []
    with use_limits(limits_from_config(config["limits"])):
        drive = read_single(config["dataset"], recording)
        findings = [
            finding_in_words(finding)
            for finding in refuse_errors(
                drive, config["dataset"].get("accept") or (), f"'{recording}'"
            )
            if finding.level != "note"
        ]
        for finding in findings:
            complain(f"warning: '{recording}': {finding}")
        estimates = {file.stem: read_estimate_table(file, drive) for file in files}
        if len(estimates) < len(files):
            raise ConfigurationError(
                "two estimates have the same file name; rename one, since it names the row"
            )
        for name in models:
            folder, model, trust = open_model(name, Path(config["output"]), note)
            model, trust, remarks = adapted(model, trust, drive.car, settings)
            notes += [f"'{name}': {remark}" for remark in remarks]
            if is_training_recording(folder, drive.id):
                trained_here.append(f"'{name}'")
                complain(f"warning: '{name}' was trained on this recording: its row is no test")
            estimates[name] = estimate_recording(
                model, drive.without_references(), trust, same_vehicle_from_config(config)
            )
        wheelbase = drive.car.wheelbase
        if "wheelbase" in settings:
            of_command = {"wheelbase": settings["wheelbase"]}
            wheelbase = validated(
                CarValues, of_command, "", error=ConfigurationError, group="estimator"
            ).wheelbase
        found = compare_estimates(drive, estimates, wheelbase)
    if trained_here:
        found["verdict"] = (
            f"No estimator can be called best: {listed(trained_here)} "
            f"{'was' if len(trained_here) == 1 else 'were'} trained on this recording. "
            "Compare on another one."
        )
    for text in notes:
        note(text)
    cells = [
        (row["estimate"], *score_cells(row), f"{row['rmse_vy']:.3f}", f"{row['fvu']:.3f}")
        for row in found["rows"]
    ]
    scored = f"scored from {found['start']:.6g} to {found['stop']:.6g} s at {found['rate_hz']:g} Hz"
    of_wheelbase = "wheelbase not known" if wheelbase is None else f"wheelbase {wheelbase:g} m"
    scored += (
        f", sideslip from {found['min_sideslip_speed']:.3g} m/s on ({of_wheelbase}): the car is slower at "
        f"{100 * found['share_below_min_speed']:.1f} % of the samples"
    )
    return found | {"findings": findings}, [
        TerminalTable("", ("estimate", *SCORE_HEADER, "RMSE(v) [m/s]", "FVU"), cells),
        scored,
        found["verdict"],
    ]


def read_estimate_table(file: Path, vx: Recording) -> Estimate:
    """Read v or β from a table of any tool, or of ``vehest estimate``; raises `DataError` where it has neither, or no time.

    Columns are found by name, whatever their case; units in brackets behind a name count, else v is in m/s and β in rad; an unknown one
    is a `DataError`. Where only β is there, v = u tan β with the recording's u. Prints a warning where unit or sign contradict the
    recording.
    """
    if file.suffix == ".parquet" and is_stored_estimate(file):
        return read_estimate(file)
    names = column_names(file)
    if file.suffix == ".parquet" and OF_VEHEST.intersection(names):
        complain(
            f"warning: '{file}' has columns of 'vehest estimate' ({counted(sorted(OF_VEHEST.intersection(names)))}), but not its "
            "description: another program has written it anew; it is read like another tool's table"
        )
    found: dict[str, dict[str, str]] = {}
    for quantity, spellings in SPELLINGS.items():
        for name in names:
            if re.sub(r"[\[(].*?[\])]|[\s_]", "", name).lower() in spellings:
                unit = _unit_of(quantity, name, file)
                found.setdefault(quantity, {"column": name, "unit": unit})
    time = found.pop("time", None)
    channel = next(iter(found), None)
    if time is None or channel is None:
        wanted = "time [s]" if time is None else "vy [m/s] or sideslip [rad]"
        raise DataError(f"'{file}' has no column {wanted} (it has {counted(names)})")
    options = {
        "name": file.stem,
        "source": "tabular",
        "vehicle": "unknown",
        "clock": "interpolate",
        "gappy": [channel],
    }
    table = read_single({**options, "time": time, "channels": {channel: found[channel]}}, file)
    _warn_of_estimate(file, found[channel]["column"], table, vx)
    values = table[channel]
    if channel == "sideslip_ref":
        values = np.tan(values) * np.interp(table.time, vx.time, vx["vx"])
    return Estimate(
        vx.id,
        file.stem,
        table.rate_hz,
        table.start_time,
        {"vy": values, "sideslip": np.zeros_like(values)},
    )


def _unit_of(quantity: str, name: str, file: Path) -> str:
    """The unit in brackets in a column's name, or the usual one where there are no brackets; raises `DataError` for an unknown one."""
    written = re.search(r"[\[(](.*?)[\])]", name)
    if written is None:
        return USUAL_UNITS[quantity]
    unit = TIME_UNITS.get(written[1]) if quantity == "time" else plain_unit(written[1])
    if unit is None:
        known = ", ".join(TIME_UNITS) if quantity == "time" else "m/s, km/h, rad, deg and others"
        raise DataError(
            f"'{file}': column '{printable(name)}' has the unknown unit '{printable(written[1])}' (known are {known}); "
            "convert it, or rename the column"
        )
    return unit


def _warn_of_estimate(file: Path, column: str, table: Recording, drive: Recording) -> None:
    """Print a warning where an estimate has another unit or sign than its column says, by the channels of the recording."""
    (channel,) = table.channels
    measured = drive.without_references()
    values = np.interp(measured.time, table.time, table[channel], left=np.nan, right=np.nan)
    beside = replace(
        measured,
        channels={**measured.channels, channel: values},
        gappy=measured.gappy | {channel},
    )
    for finding in merged_findings([checks_of_recording(table), checks_of_recording(beside)]):
        concerns = finding.channel == channel or (
            not finding.channel and channel in finding.message
        )
        if concerns and finding.check in CHECKS_OF_SIGNS_AND_UNITS:
            complain(
                f"warning: '{file}': column '{printable(column)}', read as {channel}: {finding.message}"
            )


def compare_estimates(
    drive: Recording, estimates: Mapping[str, Estimate], wheelbase: float | None = None
) -> dict[str, Any]:
    """Score estimates on the clock of ``drive`` where all of them have values, beside v = 0 and a static map.

    Sideslip is scored from a speed on that follows from the car's ``wheelbase`` [m] (`min_sideslip_speed`). The map is fitted on one half
    of the scored range and scored on the other, and vice versa, so that its samples are held out.
    Returns ``rows``, one an estimate, the lowest RMSE(β) first, the ``verdict``, ``start`` and ``stop`` [s] and ``rate_hz`` of what is
    scored, ``min_sideslip_speed`` [m/s] and ``share_below_min_speed``. Where the car is slower throughout, RMSE(v) gives the order.
    Raises `DataError` without a reference, or with too little or gaps in common, `ConfigurationError` for none or a baseline's name.
    """
    if not estimates:
        raise ConfigurationError("name at least one estimate to compare")
    if taken := {"zero", "static_map"} & set(estimates):
        raise ConfigurationError(
            f"an estimate cannot be called '{min(taken)}', which is a baseline; rename its file"
        )
    further = [name for name in ("ay", "yaw_rate") if name in drive]
    reference = resampled(
        drive.select(["vx", "vy_ref", *further]),
        min(RATE_HZ, drive.rate_hz),
        {"method": "polyphase", "transforms": []},
    )
    start, stop = _in_common(reference, estimates)
    span = Span("", drive.id, start, stop)
    min_speed = min_sideslip_speed(wheelbase)
    protocol = Protocol(
        rate_hz=reference.rate_hz,
        warm_up_seconds=0.0,
        skip_seconds=0.0,
        min_sideslip_speed=min_speed,
    )
    candidates = {**estimates, **_baselines(reference, start, stop)}
    scored = {
        (name, ""): score(estimate, reference, span, protocol)
        for name, estimate in candidates.items()
    }
    ranking = rank(
        {name: [segments_of([own], reference.rate_hz)] for name, own in scored.items()},
        reference.rate_hz,
    )
    titles = {
        name: {"zero": "v = 0", "static_map": "the static map"}.get(name[0], name[0])
        for name in ranking.order
    }
    errors = {name: accuracy([own]) for name, own in scored.items()}
    verdict = (
        verdict_sentences(ranking, titles, "this recording")
        if ranking.order
        else f"Sideslip is not scored: the car is slower than {min_speed:.3g} m/s throughout."
    )
    for words in ("**", " over its seeds", " and over seeds"):
        verdict = verdict.replace(words, "")
    rows = []
    for ranked in ranking.order or sorted(errors, key=lambda name: errors[name]["rmse_vy"]):
        figures = {
            key: errors[ranked][key]
            for key in ("rmse_sideslip", "rmse_vy", "fvu", "max_error_sideslip")
        }
        rows.append({"estimate": ranked[0], **figures, **standing_columns(ranking, ranked)})
    return {
        "rows": rows,
        "verdict": verdict,
        "start": start,
        "stop": stop,
        "rate_hz": reference.rate_hz,
        "min_sideslip_speed": min_speed,
        "share_below_min_speed": next(iter(errors.values()))["share_below_min_speed"],
    }


def _in_common(reference: Recording, estimates: Mapping[str, Estimate]) -> tuple[float, float]:
    """Start and end [s] of the part in which every estimate and the reference have values."""
    known = np.isfinite(reference["vy_ref"]) & np.isfinite(reference["vx"])
    times = {"the reference": reference.time[known]}
    times |= {
        f"'{name}'": estimate.time[np.isfinite(estimate["vy"])]
        for name, estimate in estimates.items()
    }
    if empty := [name for name, own in times.items() if not len(own)]:
        raise DataError(f"{empty[0]} has no value at all")
    start = max(float(own[0]) for own in times.values())
    stop = min(float(own[-1]) for own in times.values())
    if stop - start < LEAST_SECONDS:
        ranges = ", ".join(
            f"{name} goes from {own[0]:.6g} to {own[-1]:.6g} s" for name, own in times.items()
        )
        raise DataError(
            f"{ranges}: less than {LEAST_SECONDS:g} s in common; are the clocks the same?"
        )
    if reference.rate_hz < LOWEST_RATE:
        raise DataError(
            f"'{reference.id}' is sampled at {reference.rate_hz:.3g} Hz; scores need {LOWEST_RATE:g} Hz or more"
        )
    return start, stop


def _baselines(reference: Recording, start: float, stop: float) -> dict[str, Estimate]:
    """v = 0, and the static map where the car turns enough to fit one."""
    found = {"zero": np.zeros(len(reference))}
    if "yaw_rate" in reference:
        with suppress(DataError):
            found["static_map"] = _held_out_map(reference, start, stop)
    clock = (reference.rate_hz, reference.start_time)
    return {
        name: Estimate(reference.id, name, *clock, {"vy": vy, "sideslip": np.zeros_like(vy)})
        for name, vy in found.items()
    }


def _held_out_map(reference: Recording, start: float, stop: float) -> FloatArray:
    """Lateral velocity of a static map of the other half of the range [m/s]; raises `DataError` where the car turns too little."""
    middle = 0.5 * (start + stop)
    vy = np.zeros(len(reference))
    for fitted, held_out in (
        ((start, middle), reference.time >= middle),
        ((middle, stop), reference.time < middle),
    ):
        part = reference.cut(*fitted).select(["yaw_rate", "vx", "vy_ref"])
        clean = np.isfinite(np.stack(list(part.channels.values()))).all(axis=0)
        kept = {name: values[clean] for name, values in part.channels.items()}
        model = StaticMap(StaticMap.settings_type(reference.rate_hz))
        model.values = model.closed_form(
            [Recording(part.id, part.vehicle, part.rate_hz, 0.0, kept)]
        )
        vy[held_out] = model.run(reference.stack(model.channels)[held_out], None)[0]["vy"]
    return vy
