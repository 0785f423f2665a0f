"""Makes a data set of proposals and reads it once: Examined -> configuration -> recordings, checks, delays, steering ratio -> Draft."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vehest.alignment.align import align
from vehest.alignment.checks import checks_of_recording
from vehest.alignment.delays import Late, late_channels
from vehest.alignment.motion import rms
from vehest.alignment.proposals.proposal import Proposal
from vehest.alignment.settings import AlignmentSettings
from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.derivable_channels import derivation_of
from vehest.data.derived import speed_of_reference
from vehest.data.errors import ConfigurationError, DataError, VehestError
from vehest.data.recording import UNNAMED_VEHICLE, Recording
from vehest.data.recording_summary import RecordingSummary, common_channels, summary_of
from vehest.data.runs import true_runs
from vehest.data.transforms import MOST_BRIDGED
from vehest.data.units import factor_to_si
from vehest.run.own_car.inspect import BRIDGED, EVIDENCE_HZ, TABLES, Examined, rate_of
from vehest.run.printing import counted
from vehest.sources.base import open_source
from vehest.sources.clocks import INTERPOLATED_TOLERANCE, plain_rate
from vehest.sources.surveys import Log, RawColumn
from vehest.sources.surveys.clocks import FEWEST_STEPS, MAX_GAP
from vehest.sources.unit_spellings import plain_unit

POLICIES = {
    "vbo": ("strict", "interpolate"),
    **dict.fromkeys(TABLES, ("strict", "interpolate", "uniform")),
}
"""Source -> clocks of its data sets, the strictest first; other sources make their own."""
BAG_HZ = 100.0
LEAST_GAP = 0.05  # s
GAPS = "samples are missing; only a table with a column of times may lack some, which are bridged, or cut out beyond one second"
CRAWL_SPEED = 1.0  # m/s; a car that is slower crawls
CRAWL_SHARE = 0.05  # of the top speed, likewise of a model car
MAX_CRAWL_SIDESLIP = 1.0  # rad, beyond which an angle at crawl is noise
POSE_SECONDS = 0.15  # of the filter that differentiates poses
CONTRADICTIONS = ("sign", "unit", "impossible", "kinematics")  # checks that contradict a proposal
REMARKS = (*CONTRADICTIONS, "dropout", "stuck", "held", "reverse", "offset", "spike")
MAX_RATIO_UNCERTAINTY = 0.1  # standard uncertainty of an estimated steering ratio, as a share of it
GAIN_APART = (
    1.15  # factor between the gains of two files, of which each half is beyond the other file's
)
LEAST_TURN = 0.05
TURNING_SECONDS = 5.0  # rad/s, and how long a half of a file turns as fast [s]


@dataclass(frozen=True, eq=False)
class Draft:
    """A data set with what its recordings, of ``durations`` [s], show."""

    examined: Examined  # the logs, delays among their proposals
    dataset: Mapping[str, Any]  # for conf/dataset
    late: Mapping[str, Late]  # channel -> its delay in the longest recording
    contents: list[RecordingSummary]  # of the recordings
    remarks: list[str]  # findings of the checks that concern the proposals
    ratio: (
        tuple[float, float] | None
    )  # estimated steering ratio and its uncertainty; None where it is given or not needed
    notes: list[str]  # further remarks
    durations: dict[str, float]  # recording -> its length [s]

    @property
    def seconds(self) -> float:
        """Of all recordings."""
        return sum(self.durations.values())

    @property
    def channels(self) -> frozenset[str]:
        """Channels that all recordings have."""
        return common_channels(self.contents)


def draft(examined: Examined) -> Draft:
    """A data set by the proposals, read as an ingest reads it; raises `VehestError` where it cannot be read."""
    whole = [
        one
        for one in examined.proposals.channels
        if not any(_has_gaps(examined, own, one.column) for own in examined.logs)
    ]
    gaps = [
        f"'{one.column}' ({one.channel}) is left out: {GAPS}"
        for one in examined.proposals.channels
        if one not in whole
    ]
    examined = replace(examined, proposals=examined.proposals.keeping(whole, gaps))
    proposals = examined.proposals
    vehicle = examined.vehicle
    if not proposals.channels:
        raise ConfigurationError("no column is left that would be a channel")
    dataset = _dataset(examined)
    speed = (
        [{"name": "speed_from_wheels", "wheel_radius": proposals.wheel_radius}]
        if proposals.wheel_radius is not None
        else []
    )
    dataset, recordings = _read_strictest(dataset | {"transforms": speed})
    bridging = _bridging(examined, recordings)
    notes = [*proposals.notes]
    if bridging:
        recordings = _recordings(dataset := dataset | {"transforms": [*bridging, *speed]})
        notes.append(
            "a few samples beyond what a vehicle can do are bridged by lines (bridge_impossible)"
        )
    longest = max(recordings, key=lambda own: own.duration)
    late = late_channels(longest)
    ratio = None
    for stem, rows in dataset.get("drop_rows", {}).items():
        why = f"written twice, names repeated, or {BRIDGED:g} s and more without a sample"
        notes.append(
            f"left out of '{stem}' by drop_rows, {why}: data rows: {counted([str(row) for row in rows])}"
        )
    if vehicle["wheelbase"] and vehicle["steering_ratio"] is None and "handwheel" in longest:
        try:
            found = align(
                longest, AlignmentSettings(("steering_ratio",), wheelbase=vehicle["wheelbase"])
            )["steering_ratio"]
            ratio = (found.value, found.uncertainty)
        except VehestError as error:
            notes.append(f"the steering ratio could not be estimated: {error}")
    notes += _cuts(dataset, recordings)
    used_ratio = vehicle["steering_ratio"] or (
        ratio[0] if ratio and ratio[1] <= MAX_RATIO_UNCERTAINTY * abs(ratio[0]) else None
    )
    if ratio and used_ratio is None:
        notes.append(
            f"'steer' is left out: the steering ratio by slow corners is {ratio[0]:.3g} ± {ratio[1]:.2g}, "
            f"less certain than {MAX_RATIO_UNCERTAINTY:.0%}; --steering-ratio with your car's adds it"
        )
    crawl_speed = max(map(_crawl_speed, recordings))
    if crawl_speed:
        notes.append(
            f"sideslip has no meaning below {crawl_speed:g} m/s, where it is beyond "
            f"{np.degrees(MAX_CRAWL_SIDESLIP):.0f}°, and is taken as 0 there"
        )
    made = _transforms(examined, longest, late, speed, used_ratio, crawl_speed)
    dataset |= {"transforms": [*bridging, *made]}
    recordings = _recordings(dataset)
    channels = tuple(
        replace(one, delay=late[one.channel].delay).with_evidence(late[one.channel].evidence)
        if one.channel in late
        else one
        for one in proposals.channels
    )
    return Draft(
        replace(examined, proposals=replace(proposals, channels=channels)),
        dataset,
        late,
        [summary_of(own) for own in recordings],
        _remarks(longest, recordings),
        ratio,
        notes,
        {own.id: own.duration for own in recordings},
    )


def _read_strictest(dataset: dict[str, Any]) -> tuple[dict[str, Any], list[Recording]]:
    """The data set with the strictest clock that all files keep and that has a plain rate, as a downsampling needs; its recordings."""
    for policy in POLICIES.get(dataset["source"], ()):
        with suppress(DataError):
            own = dataset | {"clock": policy}
            recordings = _recordings(own)
            if all(
                math.isclose(one.rate_hz, plain_rate(one.rate_hz, INTERPOLATED_TOLERANCE))
                for one in recordings
            ):
                return own, recordings
    return dataset, _recordings(dataset)


def _recordings(dataset: Mapping[str, Any]) -> list[Recording]:
    source = open_source(dataset)
    return [source.read(name) for name in source.ids()]


def _crawl_speed(recording: Recording) -> float:
    """Speed below which a sideslip angle has no meaning [m/s]; 0 where it has one throughout or no speed is known."""
    name = speed_of_reference(recording)
    if not {"sideslip_ref", name} <= set(recording.channels):
        return 0.0
    speed = np.abs(recording[name])
    crawl = float(f"{min(CRAWL_SPEED, CRAWL_SHARE * float(np.nanmax(speed))):.2g}")
    angles = np.abs(recording["sideslip_ref"][speed < crawl])
    return crawl if (angles > MAX_CRAWL_SIDESLIP).any() else 0.0


def _cuts(dataset: Mapping[str, Any], recordings: Sequence[Recording]) -> Iterator[str]:
    """Notes of files that are cut into several recordings, and why."""
    pause = dataset.get("max_gap")
    causes = [f"pauses for more than {pause:g} s"] if pause else []
    causes += ["has times that go back"] if dataset.get("time_restarts") else []
    if not causes:
        return
    durations: dict[str, list[float]] = {}
    for recording in recordings:
        durations.setdefault(str(recording.provenance.get("file")), []).append(recording.duration)
    for file, seconds in durations.items():
        if len(seconds) > 1:
            yield (
                f"'{file}' {' and '.join(causes)} and makes {len(seconds)} recordings; "
                f"a command on one recording takes the longest, {max(seconds):.0f} of {sum(seconds):.0f} s"
            )


def _remarks(longest: Recording, recordings: Sequence[Recording]) -> list[str]:
    """Findings of the longest recording, and contradictions in the longest one of each other file."""
    found = [("", one) for one in checks_of_recording(longest) if one.check in REMARKS]
    by_file = {
        own.provenance.get("file"): own for own in sorted(recordings, key=lambda own: own.duration)
    }
    by_file.pop(longest.provenance.get("file"), None)
    unlike = []
    gains = _gains(longest)
    for own in by_file.values():
        found += [
            (f"in '{own.id}', ", one)
            for one in checks_of_recording(own)
            if one.check in CONTRADICTIONS
        ]
        for name, (low, high) in _gains(own).items():
            least, most = gains.get(name, (low, high))
            if low > GAIN_APART * most or least > GAIN_APART * high:
                what = f"{math.sqrt(low * high / (least * most)):.2g} times as large in the same turn as in '{longest.id}'"
                unlike.append(
                    f"{name}: in '{own.id}', {what}; is it of another car? Then make a data set of each"
                )
    worded = [
        f"{one.channel}: {where}{one.message}" if one.channel else where + one.message
        for where, one in found
        if one.level != "note"
    ]
    return worded + unlike


def _gains(recording: Recording) -> dict[str, tuple[float, float]]:
    """Channel -> the smaller and the larger of two halves' gain: ay over vx·yaw_rate, steering over yaw_rate/vx beside understeer."""
    found: dict[str, list[float]] = {}
    if not {"vx", "yaw_rate"} <= set(recording.channels):
        return {}
    for half in (slice(0, len(recording) // 2), slice(len(recording) // 2, None)):
        speed = recording["vx"][half]
        rate = recording["yaw_rate"][half]
        used = (
            (speed > 0.2 * float(np.quantile(speed, 0.99)))
            & (np.abs(rate) > LEAST_TURN)
            & (speed > 0.0)
        )
        if np.count_nonzero(used) < TURNING_SECONDS * recording.rate_hz:
            return {}
        speed = speed[used]
        rate = rate[used]
        turn = np.stack([rate / speed, speed * rate, np.ones(len(speed))], axis=1)
        if "ay" in recording:
            found.setdefault("ay", []).append(rms(recording["ay"][half][used]) / rms(turn[:, 1]))
        for name in {"handwheel", "steer"} & set(recording.channels):
            found.setdefault(name, []).append(
                abs(float(np.linalg.lstsq(turn, recording[name][half][used], rcond=None)[0][0]))
            )
    return {name: (min(own), max(own)) for name, own in found.items() if min(own) > 0.0}


def _dataset(examined: Examined) -> dict[str, Any]:
    log = examined.log
    name = examined.name
    proposals = examined.proposals
    dataset: dict[str, Any] = {
        "name": name,
        "title": f"Recordings of {name}",
        "kind": "real",
        "vehicle": UNNAMED_VEHICLE,
    }
    if car := {key: value for key, value in examined.vehicle.items() if value is not None}:
        dataset["car"] = car
    dataset |= {"licence": "yours", "citation": "none", "source": log.source, **examined.place}
    columns = {column.name: column for column in log.columns}
    if log.source == "rosbag":
        return dataset | _bag_options(columns, proposals.channels)
    if log.source == "mdf":
        return dataset | _mdf_options(columns, proposals.channels)
    dataset |= log.options
    if log.source != "vbo":
        dataset["time"] = (
            None
            if log.clock is None
            else {"column": log.clock.column, "unit": log.clock.unit, **log.clock.repair}
        )
        dataset |= {"rate_hz": examined.rate_hz} if log.clock is None else {}
    dataset["clock"] = "strict"
    if log.source in TABLES:
        gaps = {
            own.file.stem: np.array(
                [_gaps(examined, own, one.column) for one in proposals.channels]
            )
            for own in examined.logs
        }
        short = max(float(own[own <= BRIDGED].max(initial=0.0)) for own in gaps.values())
        dataset |= (
            {"source": "text_log", "bridge": math.ceil(100.0 * short * 1.05) / 100.0}
            if short
            else {}
        )
        if log.clock is not None:
            holes = {
                own.file.stem: [
                    f"{own.file_row(first)}-{own.file_row(last - 1)}"
                    for first, last in true_runs(gaps[own.file.stem].max(axis=0) > BRIDGED)
                ]
                for own in examined.logs
            }
            dropped = {
                own.file.stem: [
                    *own.repeated_names,
                    *holes[own.file.stem],
                    *map(own.file_row, _rows_written_twice(own)),
                ]
                for own in examined.logs
            }
            dataset |= (
                {"drop_rows": named}
                if (named := {stem: rows for stem, rows in dropped.items() if rows})
                else {}
            )
            if any(holes.values()) and "runs" not in log.options:
                dataset["max_gap"] = log.options.get("max_gap", MAX_GAP)
    units = {name: own.unit if log.source == "vbo" else "" for name, own in columns.items()}
    dataset["channels"] = {
        one.channel: _entry(one, columns[one.column].place, units[one.column])
        for one in proposals.channels
    }
    if proposals.pose:
        rate = (
            rate_of(log.seconds)
            if log.seconds is not None
            else float(examined.rate_hz or EVIDENCE_HZ)
        )
        parts = {part: {"column": column, "unit": unit} for part, column, unit in proposals.pose}
        made = [
            name
            for name in ("vx_ref", "vy_ref", "yaw_rate_ref", "sideslip_ref")
            if name not in dataset["channels"]
        ]
        dataset["pose"] = {
            **parts,
            "window": max(2 * round(POSE_SECONDS * rate / 2.0) + 1, 5),
            "order": 2,
            "channels": made,
        }
    return dataset


def _entry(one: Proposal, place: Mapping[str, Any], header: str = "") -> dict[str, Any]:
    """A channel's entry; with a factor where it is in another unit than by the header, which its source holds against the entry."""
    unit = one.unit
    factor = one.factor
    si = CHANNELS[one.channel].unit
    if factor == 1.0 and (own := plain_unit(header)) and own != unit:
        unit, factor = own, float(f"{factor_to_si(unit, si) / factor_to_si(own, si):.7g}")
    sign = {"sign": one.sign} if one.sign != 1 else {}
    return {**place, "unit": unit} | sign | ({"factor": factor} if factor != 1.0 else {})


def _rows_written_twice(log: Log) -> list[int]:
    """Places in the columns, from 0."""
    rows = np.nan_to_num(
        [
            *([] if log.seconds is None else [log.seconds]),
            *(column.values for column in log.columns),
        ]
    )
    return (np.flatnonzero((np.diff(rows, prepend=np.nan) == 0.0).all(axis=0))).tolist()


def _has_gaps(examined: Examined, log: Log, column: str) -> bool:
    """Whether a column lacks samples that neither lines bridge nor pauses cut out; a recording with such gaps cannot be resampled."""
    own = next(own for own in log.columns if own.name == column)
    known = np.flatnonzero(np.isfinite(own.values))
    if log.source in TABLES:
        return not len(known) or (
            log.clock is None and bool(_gaps(examined, log, column).max() > BRIDGED)
        )
    if log.source != "rosbag" or own.stamps is None or not len(known):
        return not len(known) or (log.source != "mdf" and len(known) < len(own.values))
    measured = own.stamps[known]
    ends = own.stamps[[0, -1]] == measured[[0, -1]]
    return not ends.all() or bool((np.diff(measured)[np.diff(known) > 1] > BRIDGED).any())


def _gaps(examined: Examined, log: Log, column: str) -> FloatArray:
    """How long the time is that a row without a sample lies in [s], (N,): infinite in a run without any, 0 in a row with one."""
    values = next(own.values for own in log.columns if own.name == column)
    seconds = (
        log.seconds
        if log.seconds is not None
        else np.arange(len(values)) / float(examined.rate_hz or EVIDENCE_HZ)
    )
    found = np.zeros(len(values))
    for run in log.runs:
        times = seconds[run]
        known = np.isfinite(values[run])
        edges = np.concatenate([times[:1], times[known], times[-1:]])
        lengths = np.diff(edges) if known.any() else np.array([math.inf])
        found[run] = np.where(
            known, 0.0, lengths[np.clip(np.searchsorted(edges, times) - 1, 0, len(lengths) - 1)]
        )
    return found


def _mdf_options(columns: Mapping[str, RawColumn], proposals: Sequence[Proposal]) -> dict[str, Any]:
    channels = {}
    rates = []
    paused = False
    for one in proposals:
        rate, gap = _rate_and_gap(columns[one.column], BRIDGED)
        rates.append(rate)
        paused |= gap < _rate_and_gap(columns[one.column])[1]
        channels[one.channel] = _entry(one, columns[one.column].place, columns[one.column].unit)
        if 3.0 / rate < gap:
            channels[one.channel]["max_gap"] = math.ceil(100.0 * gap) / 100.0
    pause = {"max_gap": float(f"{max(MAX_GAP, FEWEST_STEPS / min(rates)):.3g}")} if paused else {}
    return {
        "rate_hz": plain_rate(max(rates), INTERPOLATED_TOLERANCE),
        **pause,
        "channels": channels,
    }


def _bag_options(columns: Mapping[str, RawColumn], proposals: Sequence[Proposal]) -> dict[str, Any]:
    topics: dict[str, dict[str, Any]] = {}
    channels: dict[str, dict[str, Any]] = {}
    rates = []
    for one in proposals:
        place = columns[one.column].place
        short = str(place["topic"]).strip("/").replace("/", "_")
        rate, gap = _rate_and_gap(columns[one.column])
        rates.append(rate)
        topic = topics.setdefault(
            short, {key: place[key] for key in ("topic", "type", "stamps")} | {"max_gap": LEAST_GAP}
        )
        topic["max_gap"] = max(topic["max_gap"], math.ceil(150.0 * gap) / 100.0)
        stamps = columns[one.column].stamps
        if stamps is not None and (np.diff(stamps) == 0.0).any():  # delivered in batches
            mean_rate = (len(stamps) - 1) / float(stamps[-1] - stamps[0])
            topic |= {"clock": "uniform", "rate_hz": plain_rate(mean_rate, INTERPOLATED_TOLERANCE)}
        entry = _entry(one, {"topic": short, "field": place["field"]})
        channels[one.channel] = entry | (
            {"offset": float(f"{one.offset:.5g}")} if one.offset else {}
        )
    return {
        "rate_hz": plain_rate(min(max(rates), BAG_HZ), INTERPOLATED_TOLERANCE),
        "topics": topics,
        "channels": channels,
    }


def _rate_and_gap(column: RawColumn, shorter: float = math.inf) -> tuple[float, float]:
    """Median rate [Hz] and longest gap [s], of those up to ``shorter``, of the valid samples of a column with times of its own."""
    assert column.stamps is not None
    stamps = column.stamps[np.isfinite(column.values)]
    gaps = np.diff(stamps)
    return rate_of(stamps), float(gaps[gaps <= shorter].max(initial=0.0))


def _bridging(examined: Examined, recordings: Sequence[Recording]) -> list[dict[str, Any]]:
    """The transform that bridges impossible samples, as far to either side as the slowest signal was interpolated, if there are any."""
    channels = [
        (CHANNELS[name], samples) for own in recordings for name, samples in own.channels.items()
    ]
    if not any(
        0.0 < ((samples < own.low) | (samples > own.high)).mean() <= MOST_BRIDGED
        for own, samples in channels
    ):
        return []
    used = {one.column for one in examined.proposals.channels}
    rates = [
        rate_of(own.stamps)
        for own in examined.log.columns
        if own.stamps is not None and own.name in used
    ]
    return [
        {
            "name": "bridge_impossible",
            **({"beside": math.ceil(1e3 / min(rates)) / 1e3} if rates else {}),
        }
    ]


def _transforms(
    examined: Examined,
    longest: Recording,
    late: Mapping[str, Late],
    speed: Sequence[dict[str, Any]],
    ratio: float | None,
    crawl_speed: float,
) -> list[dict[str, Any]]:
    """Transforms that make the channels that estimators want.

    A reference that is late is put on the others' clock; a measured channel is not, since an estimator in the car would get it late, too.
    """
    references = {name: own.delay for name, own in late.items() if CHANNELS[name].is_reference}
    made: list[dict[str, Any]] = [
        {"name": "delay_correction", "delay": own, "channels": [name]}
        for name, own in references.items()
    ]
    offsets = {
        one.channel: float(f"{one.factor * one.sign * one.offset:.5g}")
        for one in examined.proposals.channels
        if one.offset
    }
    if offsets and examined.log.source != "rosbag":  # whose channels have an offset of their own
        made.append({"name": "offset_correction", "offsets": offsets})
    made += speed
    for name in ("vy_ref", "ax"):
        supply = (
            derivation_of(name, longest.channels, (), longest.rate_hz)
            if name not in longest
            else None
        )
        if supply is not None and not supply.meanings:  # no value is unknown
            made += map(dict, supply.transforms)
    for entry in made:
        if entry["name"] == "velocity_from_sideslip" and crawl_speed:
            entry["min_speed"] = crawl_speed
    if "handwheel" in longest and "steer" not in longest and ratio:
        made.append({"name": "steering_ratio", "ratio": float(f"{ratio:.4g}")})
    return made
