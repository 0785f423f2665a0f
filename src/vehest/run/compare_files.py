"""Scores estimates of any tool, and of vehest's models, beside each other on one recording with a
reference.

tables, models -> `Estimate` each -> scored where all of them have values, beside v = 0 and a static
map -> ranking and verdict
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from vehest.alignment.checks import refuse_errors
from vehest.configuration.estimate_options import estimate_options
from vehest.configuration.files import files_and_overrides
from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError, counted, listed, printable, suggestion
from vehest.data.estimate import Estimate
from vehest.data.limits import use_limits
from vehest.data.recording import Recording
from vehest.data.resampling import resampled
from vehest.data.splits import Span
from vehest.estimators.static_map import StaticMap
from vehest.evaluation.blocks import segments_of
from vehest.evaluation.metrics import Protocol, accuracy, min_sideslip_speed, score
from vehest.evaluation.ranking import rank
from vehest.inference.car_values import adapted, stated_wheelbase
from vehest.inference.estimation import estimate_recording
from vehest.inference.models import is_training_recording, open_model
from vehest.report.style import MISSING
from vehest.run.estimate_tables import (
    names_of_table,
    parse_columns,
    parse_shift,
    read_estimate_table,
)
from vehest.run.printing import (
    SCORE_HEADER,
    TerminalTable,
    complain,
    describe_finding,
    note,
    score_cells,
)
from vehest.sources.base import read_single
from vehest.sources.named_columns import NamedColumn
from vehest.studies.kit.standing import standing_columns, verdict_sentences

MIN_COMMON_SECONDS = 5.0  # s that reference and all estimates must have in common; less is refused
MIN_RATE_HZ = 1.0  # Hz; a reference that is sampled more slowly is refused
BASELINES = ("zero", "static_map")  # rows of every comparison
RATE_HZ = 20.0  # Hz, rate at which estimates are scored, unless that of the recording is lower


def compare_files(
    recording: Path,
    words: Sequence[str],
    models: Sequence[str],
    columns: Sequence[str] = (),
    shift: str = "0",
) -> tuple[dict[str, Any], list[str | TerminalTable]]:
    """Score estimates of other tools, and models, on one recording: for JSON and for a terminal.

    Parameters
    ----------
    recording : Path
        With its reference.
    words : sequence of str
        Files of estimates, then overrides of conf/estimate.yaml.
    models : sequence of str
        Models to run on the recording.
    columns, shift : sequence of str, str
        Of the tables of other tools, as `parse_columns` and `parse_shift` read them.

    Returns
    -------
    tuple
        Figures as `compare_estimates` returns them, with ``findings`` of the recording; and lines
        and tables.

    Raises
    ------
    VehestError
        A file or model cannot be used.
    """
    named_columns = parse_columns(columns)
    seconds = parse_shift(shift)
    file_words, overrides = files_and_overrides(words)
    files = [Path(word) for word in file_words]
    options = estimate_options(overrides)
    settings = options.settings
    notes: list[str] = []
    trained_here: list[str] = []
    with use_limits(options.limits):
        drive = read_single(options.dataset, recording)
        findings = [
            describe_finding(finding)
            for finding in refuse_errors(
                drive, options.dataset.get("accept") or (), f"'{recording}'"
            )
            if finding.level != "note"
        ]
        for finding in findings:
            complain(f"warning: '{recording}': {finding}")
        _check_rows([*(file.stem for file in files), *models])
        _check_columns(named_columns, files)
        tables = {
            file.stem: read_estimate_table(file, drive, named_columns, seconds) for file in files
        }
        estimates = named_by_estimator(tables, models)
        for name in models:
            folder, model, trust = open_model(name, options.output, note)
            model, trust, remarks = adapted(model, trust, drive.car, settings)
            notes += [f"'{name}': {remark}" for remark in remarks]
            if is_training_recording(folder, drive.id):
                trained_here.append(name)
                complain(f"warning: '{name}' was trained on this recording: its row is no test")
            estimates[name] = estimate_recording(
                model, drive.without_references(), trust, options.same_vehicle
            )
        wheelbase = stated_wheelbase(drive.car, settings)
        comparison = compare_estimates(drive, estimates, wheelbase, trained_here)
    for text in notes:
        note(text)
    cells = [
        (row["estimate"], *score_cells(row), f"{row['rmse_vy']:.3f}", f"{row['fvu']:.3f}")
        for row in comparison["rows"]
    ]
    scored = (
        f"scored from {comparison['start']:.6g} to {comparison['stop']:.6g} s at "
        f"{comparison['rate_hz']:g} Hz"
    )
    of_wheelbase = "wheelbase not known" if wheelbase is None else f"wheelbase {wheelbase:g} m"
    scored += (
        f", sideslip from {comparison['min_sideslip_speed']:.3g} m/s on ({of_wheelbase}): the car "
        f"is slower at {100 * comparison['share_below_min_speed']:.1f} % of the samples"
    )
    return comparison | {"findings": findings}, [
        TerminalTable(("estimate", *SCORE_HEADER, "RMSE(v) [m/s]", "FVU"), cells),
        scored,
        comparison["verdict"],
    ]


def _check_rows(names: Sequence[str]) -> None:
    """Raise `ConfigurationError` where two estimates have the same name."""
    for name, count in Counter(names).items():
        if count > 1:
            raise ConfigurationError(
                f"{count} estimates are called '{name}'; rename a file or leave one out, since the "
                "name stands for the row"
            )


def named_by_estimator(
    tables: Mapping[str, Estimate], models: Sequence[str]
) -> dict[str, Estimate]:
    """Estimates by the estimator that their tables record; by the file's name where that is the
    name of another row.
    """
    names = Counter([*(estimate.estimator for estimate in tables.values()), *models, *BASELINES])
    names.update(stem for stem, estimate in tables.items() if stem != estimate.estimator)
    return {
        estimate.estimator if names[estimate.estimator] == 1 else stem: estimate
        for stem, estimate in tables.items()
    }


def _check_columns(columns: Sequence[NamedColumn], files: Sequence[Path]) -> None:
    """Raise `ConfigurationError` for a column of ``--column`` that no file has."""
    if not columns:
        return
    names = list(dict.fromkeys(chain.from_iterable(names_of_table(file) for file in files)))
    for column in columns:
        if column.find(names) is None:
            meant = suggestion(column.text, names) or ";"
            raise ConfigurationError(
                f"--column: no estimate has a column '{printable(column.text)}'{meant} "
                f"there are {printable(counted(names))}"
            )


def compare_estimates(
    drive: Recording,
    estimates: Mapping[str, Estimate],
    wheelbase: float | None = None,
    trained_here: Collection[str] = (),
) -> dict[str, Any]:
    """Score estimates on the clock of ``drive`` where all of them have values, beside v = 0 and a
    static map.

    Sideslip is scored from a speed on that follows from the car's ``wheelbase`` [m]
    (`min_sideslip_speed`). The map is fitted on one half of the scored range and scored on the
    other, and vice versa, so that its samples are held out. Estimates of ``trained_here``, by
    models that were trained on this recording, have rows, the last ones, and are left out of the
    verdict. Returns ``rows``, one an estimate, the lowest RMSE(β) first, the ``verdict``, ``start``
    and ``stop`` [s] and ``rate_hz`` of what is scored, ``min_sideslip_speed`` [m/s] and
    ``share_below_min_speed``. Where the car is slower throughout, RMSE(v) gives the order.

    Parameters
    ----------
    drive : Recording
        With ``vx`` and ``vy_ref``; it is resampled to RATE_HZ at most.
    estimates : mapping
        Name of a row -> its estimate, on the clock of ``drive``.
    wheelbase : float or None
        Of the car [m]; None: not known.
    trained_here : collection of str
        Rows of models that were trained on this recording.

    Raises
    ------
    DataError
        There is no reference, or too little in common, or gaps.
    ConfigurationError
        There is no estimate, or one has the name of a baseline.
    """
    if not estimates:
        raise ConfigurationError("name at least one estimate to compare")
    if reserved := set(BASELINES) & set(estimates):
        raise ConfigurationError(
            f"an estimate cannot be called '{min(reserved)}', which is a baseline; rename its file"
        )
    optional = [name for name in ("ay", "yaw_rate") if name in drive]
    reference = resampled(
        drive.select(["vx", "vy_ref", *optional]),
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
        {
            name: [segments_of([part], reference.rate_hz)]
            for name, part in scored.items()
            if name[0] not in trained_here
        },
        reference.rate_hz,
    )
    titles = {
        name: {"zero": "Zero-sideslip baseline", "static_map": "Static map"}.get(name[0], name[0])
        for name in ranking.order
    }
    errors = {name: accuracy([part]) for name, part in scored.items()}
    verdict = (
        verdict_sentences(ranking, titles, "this recording")
        if ranking.order
        else f"Sideslip is not scored: the car is slower than {min_speed:.3g} m/s throughout."
    )
    for words in ("**", " over all seeds", " and over seeds"):
        verdict = verdict.replace(words, "")
    if trained_here:
        verdict = _with_exclusions(
            verdict, trained_here, has_others=len(estimates) > len(trained_here)
        )
    rows = []
    by_error = sorted(errors, key=lambda name: errors[name]["rmse_vy"])
    excluded = [name for name in by_error if name[0] in trained_here]
    order = ranking.order or [name for name in by_error if name not in excluded]
    for name in (*order, *excluded):
        figures = {
            key: errors[name][key]
            for key in ("rmse_sideslip", "rmse_vy", "fvu", "max_error_sideslip")
        }
        columns = standing_columns(ranking, name)
        if name in excluded:
            columns |= dict.fromkeys(("beats_zero", "beats_static_map"), MISSING)
            columns["against_best"] = "trained on it"
        rows.append({"estimate": name[0], **figures, **columns})
    return {
        "rows": rows,
        "verdict": verdict,
        "start": start,
        "stop": stop,
        "rate_hz": reference.rate_hz,
        "min_sideslip_speed": min_speed,
        "share_below_min_speed": next(iter(errors.values()))["share_below_min_speed"],
    }


def _with_exclusions(verdict: str, trained_here: Collection[str], *, has_others: bool) -> str:
    """The verdict, preceded by a sentence on the models that it leaves out; without others than
    baselines, no verdict.
    """
    names = listed([f"'{name}'" for name in trained_here])
    were = "was" if len(trained_here) == 1 else "were"
    if not has_others:
        return f"No verdict: {names} {were} trained on this recording. Compare on another one."
    return f"{names} {were} trained on this recording and left out of the verdict. {verdict}"


def _in_common(reference: Recording, estimates: Mapping[str, Estimate]) -> tuple[float, float]:
    """Start and end [s] of the part in which every estimate and the reference have values."""
    finite = np.isfinite(reference["vy_ref"]) & np.isfinite(reference["vx"])
    times = {"the reference": reference.time[finite]}
    times |= {
        f"'{name}'": estimate.time[np.isfinite(estimate["vy"])]
        for name, estimate in estimates.items()
    }
    if empty := [name for name, clock in times.items() if not len(clock)]:
        raise DataError(f"{empty[0]} has no value at all")
    start = max(float(clock[0]) for clock in times.values())
    stop = min(float(clock[-1]) for clock in times.values())
    if stop - start < MIN_COMMON_SECONDS:
        ranges = ", ".join(
            f"{name} goes from {clock[0]:.6g} to {clock[-1]:.6g} s" for name, clock in times.items()
        )
        raise DataError(
            f"{ranges}: less than {MIN_COMMON_SECONDS:g} s in common; are the clocks the same? "
            "(--shift SECONDS or auto moves tables of other tools)"
        )
    if reference.rate_hz < MIN_RATE_HZ:
        raise DataError(
            f"'{reference.id}' is sampled at {reference.rate_hz:.3g} Hz; scores need "
            f"{MIN_RATE_HZ:g} Hz or more"
        )
    return start, stop


def _baselines(reference: Recording, start: float, stop: float) -> dict[str, Estimate]:
    """Estimates of the baselines: v = 0, and the static map where the car turns enough to fit
    one.
    """
    velocities = {"zero": np.zeros(len(reference))}
    if "yaw_rate" in reference:
        with suppress(DataError):
            velocities["static_map"] = _cross_validated_map(reference, start, stop)
    clock = (reference.rate_hz, reference.start_time)
    return {
        name: Estimate(reference.id, name, *clock, {"vy": vy, "sideslip": np.zeros_like(vy)})
        for name, vy in velocities.items()
    }


def _cross_validated_map(reference: Recording, start: float, stop: float) -> FloatArray:
    """Lateral velocity of a static map of the other half of the range [m/s].

    Returns
    -------
    FloatArray
        (T,); each half of the range is estimated by a map that was fitted to the other half.

    Raises
    ------
    DataError
        The car turns too little.
    """
    middle = 0.5 * (start + stop)
    vy = np.zeros(len(reference))
    for fitted, is_tested in (
        ((start, middle), reference.time >= middle),
        ((middle, stop), reference.time < middle),
    ):
        part = reference.cut(*fitted).select(["yaw_rate", "vx", "vy_ref"])
        clean = np.isfinite(np.stack(list(part.channels.values()))).all(axis=0)
        channels = {name: values[clean] for name, values in part.channels.items()}
        model = StaticMap(StaticMap.settings_type(reference.rate_hz))
        model.values = model.closed_form(
            [Recording(part.id, part.vehicle, part.rate_hz, 0.0, channels)]
        )
        vy[is_tested] = model.run(reference.stack(model.channels)[is_tested], None)[0]["vy"]
    return vy
