"""Makes a data set of proposals and reads it once: Examined -> configuration -> recordings, checks,
delays, steering ratio -> Draft.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter1d

from vehest.alignment.align import align
from vehest.alignment.bandwidth import (
    MIN_REPORTED_DELAY_SECONDS,
    coarse_cutoff_hz,
    coarse_steps,
    held_channels,
)
from vehest.alignment.checks import checks_of_recording
from vehest.alignment.computed import computed_in
from vehest.alignment.delays import Late, late_channels
from vehest.alignment.motion import rms
from vehest.alignment.proposals.proposal import Proposal
from vehest.alignment.settings import AlignmentSettings
from vehest.alignment.standstill import standstill
from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.derivable_channels import derivation_of
from vehest.data.derived import AX_OF_SPEED, speed_of_reference
from vehest.data.errors import ConfigurationError, DataError, VehestError, counted
from vehest.data.recording import UNNAMED_VEHICLE, Recording
from vehest.data.recording_summary import RecordingSummary, common_channels, summary_of
from vehest.data.runs import true_runs
from vehest.data.transforms import MOST_BRIDGED
from vehest.data.units import factor_to_si
from vehest.run.own_car.inspect import EVIDENCE_HZ, MAX_BRIDGED_SECONDS, TABLES, Examined, rate_of
from vehest.sources.base import open_source
from vehest.sources.clocks import INTERPOLATED_TOLERANCE, plain_rate
from vehest.sources.pose import POSE_CHANNELS
from vehest.sources.surveys import Log, RawColumn
from vehest.sources.surveys.clocks import FEWEST_STEPS, MAX_GAP
from vehest.sources.unit_spellings import plain_unit

POLICIES = {
    "vbo": ("strict", "interpolate"),
    **dict.fromkeys(TABLES, ("strict", "interpolate", "uniform")),
}
"""Source -> settings ``clock`` that its data sets may have, the strictest first; other sources make
their own clock.
"""
BAG_HZ = 100.0  # Hz, highest rate that is proposed for the recordings of a bag
MIN_GAP_SECONDS = 0.05  # s, smallest max_gap of a topic; the widest gap makes it larger
# reason that a log without times cannot have gaps, for messages
GAPS = (
    "it has missing samples, which are interpolated, or cut out beyond one second, only in a log "
    "with times"
)
CRAWL_SPEED = 1.0  # m/s; a car that is slower crawls
CRAWL_SHARE = 0.05  # share of the top speed below which a car crawls, for model cars
MAX_CRAWL_SIDESLIP = 1.0  # rad, beyond which an angle at crawl is noise
POSE_SECONDS = 0.15  # s, window of the filter that differentiates poses
# names of the checks whose findings contradict a proposal
CONTRADICTIONS = ("sign", "unit", "impossible", "kinematics")
# names of the checks whose findings are listed as remarks
REMARKS = (
    *CONTRADICTIONS,
    "dropout",
    "stuck",
    "held",
    "bandwidth",
    "coarse",
    "computed",
    "reverse",
    "offset",
    "rotation",
    "spike",
    "full_turn",
)
# largest standard uncertainty of an estimated steering ratio over the ratio, for it to be used
MAX_RATIO_UNCERTAINTY = 0.1
# smallest factor between the gains of two files for a remark, where each half of one is beyond the
# other file's
MIN_GAIN_FACTOR = 1.15
MIN_TURN_YAW_RATE = 0.05  # rad/s, above which a car turns
# s of turning in each half of a file; with less, its gain is not compared
MIN_TURNING_SECONDS = 5.0
# m/s², of vx·yaw_rate: in sharper turns a car may slide, and its gains differ
MAX_TURN_ACCELERATION = 4.0
TURN_MEAN_SECONDS = 0.5  # s over which the yaw rate is averaged, so that its noise is no turn


@dataclass(frozen=True, eq=False)
class Draft:
    """A drafted data set, with the results of reading it once."""

    examined: Examined  # the logs, delays among their proposals
    dataset: Mapping[str, Any]  # content of its file in conf/dataset
    late: Mapping[str, Late]  # channel -> its delay in the longest recording
    contents: list[RecordingSummary]  # summaries of the recordings
    remarks: list[str]  # findings of the checks that concern the proposals
    ratio: (
        tuple[float, float] | None
    )  # estimated steering ratio and its uncertainty; None where it is given or not needed
    notes: list[str]  # further remarks
    durations: dict[str, float]  # recording -> its length [s]

    @property
    def seconds(self) -> float:
        """Duration of all recordings together [s]."""
        return sum(self.durations.values())

    @property
    def lowest_rate_hz(self) -> float:
        """Lowest sampling rate of the recordings [Hz]."""
        return min(content.rate_hz for content in self.contents)

    @property
    def channels(self) -> frozenset[str]:
        """Channels that all recordings have."""
        return common_channels(self.contents)

    @property
    def has_measured_ax(self) -> bool:
        """Whether all recordings have an ax that is not made of the speed."""
        transforms = self.dataset.get("transforms") or ()
        return "ax" in self.channels and all(entry["name"] != AX_OF_SPEED for entry in transforms)


def draft(examined: Examined) -> Draft:
    """Make a data set of the proposals, and read it as an ingest does.

    Raises
    ------
    VehestError
        It cannot be read.
    """
    complete = [
        proposal
        for proposal in examined.proposals.channels
        if not any(_has_gaps(examined, recording, proposal.column) for recording in examined.logs)
    ]
    left_out = [
        f"'{proposal.column}' ({proposal.channel}) is left out: {GAPS}"
        for proposal in examined.proposals.channels
        if proposal not in complete
    ]
    examined = replace(examined, proposals=examined.proposals.keeping(complete, left_out))
    proposals = examined.proposals
    vehicle = examined.vehicle
    if not proposals.channels:
        raise ConfigurationError("no column with complete samples remains for a channel")
    dataset = _dataset(examined)
    speed: list[dict[str, Any]] = (
        [{"name": "speed_from_wheels", "wheel_radius": proposals.wheel_radius}]
        if proposals.wheel_radius is not None
        else []
    )
    dataset, recordings = _read_strictest(dataset | {"transforms": speed})
    if "ax" in proposals.by_channel and "ax" in computed_in(_longest(recordings)):
        measured = [proposal for proposal in proposals.channels if proposal.channel != "ax"]
        note = (
            f"'{proposals.by_channel['ax'].column}' (ax) is left out: it is d(vx)/dt, computed by "
            "the logger and not measured, and says that the car does not slip"
        )
        proposals = proposals.keeping(measured, [note])
        examined = replace(examined, proposals=proposals)
        dataset, recordings = _read_strictest(_dataset(examined) | {"transforms": speed})
    bridging = _bridging(examined, recordings)
    notes = [*proposals.notes]
    if bridging:
        recordings = _recordings(dataset := dataset | {"transforms": [*bridging, *speed]})
        notes.append(
            "a few samples outside the possible range are interpolated (bridge_impossible)"
        )
    held = _held_with_speed(_longest(recordings)) if dataset["source"] in TABLES else []
    if held:
        recordings = _recordings(dataset := dataset | {"held": {"channels": held}})
        notes.append(
            f"{', '.join(held)}: rows repeat the values of a slower sensor; they are read as lines "
            "between its samples (held), which a model in the car does not have"
        )
    steps = _coarse(recordings)
    if steps:
        rate_hz = min(recording.rate_hz for recording in recordings)
        by_cutoff: dict[float, list[str]] = {}
        for name, step in steps.items():
            by_cutoff.setdefault(coarse_cutoff_hz(rate_hz, name, step), []).append(name)
        speed += [
            {"name": "low_pass", "cutoff_hz": cutoff, "channels": names}
            for cutoff, names in by_cutoff.items()
        ]
        recordings = _recordings(dataset := dataset | {"transforms": [*bridging, *speed]})
        sizes = [f"{name} {step:.3g} {CHANNELS[name].unit}" for name, step in steps.items()]
        notes.append(
            f"coarse steps ({', '.join(sizes)}) are removed by the transform low_pass at "
            f"{' and '.join(f'{cutoff:g}' for cutoff in by_cutoff)} Hz, which uses samples of some "
            "periods of the cut-off later"
        )
    longest = _longest(recordings)
    late = late_channels(longest)
    ratio = None
    for stem, rows in dataset.get("drop_rows", {}).items():
        notes.append(
            f"data rows of '{stem}' left out by drop_rows (duplicates, text, or no sample for "
            f"{MAX_BRIDGED_SECONDS:g} s or more): {counted([str(row) for row in rows])}"
        )
    needs_ratio = "handwheel" in longest and "steer" not in longest
    if vehicle["wheelbase"] and vehicle["steering_ratio"] is None and needs_ratio:
        try:
            estimate = align(
                longest, AlignmentSettings(("steering_ratio",), wheelbase=vehicle["wheelbase"])
            )["steering_ratio"]
            ratio = (estimate.value, estimate.uncertainty)
        except VehestError as error:
            notes.append(f"the steering ratio could not be estimated: {error}")
    notes += _cuts(dataset, recordings)
    used_ratio = vehicle["steering_ratio"] or (ratio[0] if ratio and is_certain(*ratio) else None)
    if ratio and used_ratio is None:
        handwheel = proposals.by_channel["handwheel"]
        reason = (
            f"less certain than {100 * MAX_RATIO_UNCERTAINTY:g} %; state your car's by "
            "--steering-ratio to add it"
        )
        if ratio[0] < 0.0:
            reason = (
                f"negative: 'sign: {handwheel.sign}' of '{handwheel.column}' is wrong, or the car "
                "reverses with a speed without sign; reverse the sign, or leave out the reverse"
            )
        notes.append(
            "'steer' is left out: the steering ratio estimated from slow corners is "
            f"{ratio[0]:.3g} ± {ratio[1]:.2g}, {reason}"
        )
    crawl_speed = max(map(_crawl_speed, recordings))
    if crawl_speed:
        notes.append(
            f"the sideslip angle is set to 0 below {crawl_speed:g} m/s, where it exceeds "
            f"{np.degrees(MAX_CRAWL_SIDESLIP):.0f}° and has no meaning"
        )
    transforms = _transforms(examined, longest, late, speed, used_ratio, crawl_speed)
    dataset |= {"transforms": [*bridging, *transforms]}
    recordings = _recordings(dataset)
    delayed = {
        name: replace(proposal, delay=late[name].delay).with_evidence(late[name].evidence)
        for name, proposal in proposals.by_channel.items()
        if name in late
    }
    return Draft(
        replace(examined, proposals=proposals.changed(delayed)),
        dataset,
        late,
        [summary_of(recording) for recording in recordings],
        _remarks(longest, recordings),
        ratio,
        notes,
        {recording.id: recording.duration for recording in recordings},
    )


def is_certain(ratio: float, uncertainty: float) -> bool:
    """Whether an estimated steering ratio is certain enough to be used, and positive."""
    return uncertainty <= MAX_RATIO_UNCERTAINTY * ratio


def _read_strictest(dataset: dict[str, Any]) -> tuple[dict[str, Any], list[Recording]]:
    """The data set with the strictest clock that all files keep and that has a plain rate, as a
    downsampling needs; and its recordings.
    """
    for policy in POLICIES.get(dataset["source"], ()):
        with suppress(DataError):
            with_clock = dataset | {"clock": policy}
            recordings = _recordings(with_clock)
            if all(
                math.isclose(
                    recording.rate_hz, plain_rate(recording.rate_hz, INTERPOLATED_TOLERANCE)
                )
                for recording in recordings
            ):
                return with_clock, recordings
    return dataset, _recordings(dataset)


def _recordings(dataset: Mapping[str, Any]) -> list[Recording]:
    """Read all recordings of a data set."""
    return list(open_source(dataset).recordings())


def _longest(recordings: Sequence[Recording]) -> Recording:
    """The recording with the longest duration."""
    return max(recordings, key=lambda recording: recording.duration)


def _held_with_speed(recording: Recording) -> list[str]:
    """Channels that are held at the same rate as the speed, and the speed, where rows repeat its
    samples; else empty.
    """
    for rate, names in held_channels(recording, ~standstill(recording)).items():
        if "vx" in names and 0.5 / float(rate) > MIN_REPORTED_DELAY_SECONDS:
            return names
    return []


def _coarse(recordings: Sequence[Recording]) -> dict[str, float]:
    """Channels of any recording with coarse quantisation -> their steps [SI]."""
    steps: dict[str, float] = {}
    for recording in recordings:
        steps = coarse_steps(recording, ~standstill(recording)) | steps
    return steps


def _crawl_speed(recording: Recording) -> float:
    """Speed below which a sideslip angle has no meaning [m/s]; 0 where it has one throughout or no
    speed is known.
    """
    name = speed_of_reference(recording)
    if not {"sideslip_ref", name} <= set(recording.channels):
        return 0.0
    speed = np.abs(recording[name])
    crawl = float(f"{min(CRAWL_SPEED, CRAWL_SHARE * float(np.nanmax(speed))):.2g}")
    angles = np.abs(recording["sideslip_ref"][speed < crawl])
    return crawl if (angles > MAX_CRAWL_SIDESLIP).any() else 0.0


def _cuts(dataset: Mapping[str, Any], recordings: Sequence[Recording]) -> Iterator[str]:
    """Sentences on files that are cut into several recordings, and why."""
    pause = dataset.get("max_gap")
    causes = [f"pauses of more than {pause:g} s"] if pause else []
    causes += ["times that go back"] if dataset.get("time_restarts") else []
    causes += [f"each value of '{dataset['runs']}'"] if dataset.get("runs") else []
    if not causes:
        return
    durations: dict[str, list[float]] = {}
    for recording in recordings:
        durations.setdefault(str(recording.provenance.get("file")), []).append(recording.duration)
    for file, seconds in durations.items():
        if len(seconds) > 1:
            yield (
                f"'{file}' is split into {len(seconds)} recordings at {' and '.join(causes)}; "
                f"a command on a single recording uses the longest, {max(seconds):.0f} of "
                f"{sum(seconds):.0f} s"
            )


def _remarks(longest: Recording, recordings: Sequence[Recording]) -> list[str]:
    """Texts of the findings in the longest recording, and of contradictions in the longest one of
    each other file.
    """
    findings = [
        ("", finding) for finding in checks_of_recording(longest) if finding.check in REMARKS
    ]
    by_file = {
        recording.provenance.get("file"): recording
        for recording in sorted(recordings, key=lambda recording: recording.duration)
    }
    by_file.pop(longest.provenance.get("file"), None)
    unlike = []
    gains = _gains(longest)
    for recording in by_file.values():
        findings += [
            (f"in '{recording.id}', ", finding)
            for finding in checks_of_recording(recording)
            if finding.check in CONTRADICTIONS
        ]
        for name, (low, high) in _gains(recording).items():
            low_of_longest, high_of_longest = gains.get(name, (low, high))
            if low > MIN_GAIN_FACTOR * high_of_longest or low_of_longest > MIN_GAIN_FACTOR * high:
                factor = math.sqrt(low * high / (low_of_longest * high_of_longest))
                unlike.append(
                    f"{name}: in '{recording.id}' its gain in turns is {factor:.2g} times that in "
                    f"'{longest.id}'; if it is another car, create a data set for each"
                )
    worded = [
        f"{finding.channel}: {place}{finding.message}"
        if finding.channel
        else place + finding.message
        for place, finding in findings
        if finding.level != "note"
    ]
    return worded + unlike


def _gains(recording: Recording) -> dict[str, tuple[float, float]]:
    """Channel -> the smaller and the larger of two halves' gain: ay over vx·yaw_rate, steering over
    yaw_rate/vx beside understeer.

    Turns at which a car may slide do not count; without enough others there are no gains.
    """
    gains: dict[str, list[float]] = {}
    if not {"vx", "yaw_rate"} <= set(recording.channels):
        return {}
    size = max(round(TURN_MEAN_SECONDS * recording.rate_hz), 1)
    means = {
        name: uniform_filter1d(recording[name], size)
        for name in ("vx", "yaw_rate", "ay", "handwheel", "steer")
        if name in recording
    }
    for half in (slice(0, len(recording) // 2), slice(len(recording) // 2, None)):
        speed = means["vx"][half]
        rate = means["yaw_rate"][half]
        is_turning = (
            (speed > 0.2 * float(np.quantile(speed, 0.99)))
            & (np.abs(rate) > MIN_TURN_YAW_RATE)
            & (np.abs(speed * rate) < MAX_TURN_ACCELERATION)
            & (speed > 0.0)
        )
        if np.count_nonzero(is_turning) < MIN_TURNING_SECONDS * recording.rate_hz:
            return {}
        speed = speed[is_turning]
        rate = rate[is_turning]
        turn = np.stack([rate / speed, speed * rate, np.ones(len(speed))], axis=1)
        if "ay" in means:
            gains.setdefault("ay", []).append(rms(means["ay"][half][is_turning]) / rms(turn[:, 1]))
        for name in ("handwheel", "steer"):
            if name in means:
                steering = means[name][half][is_turning]
                by_turn = np.linalg.lstsq(turn, steering, rcond=None)[0]
                gains.setdefault(name, []).append(abs(float(by_turn[0])))
    return {name: (min(halves), max(halves)) for name, halves in gains.items() if min(halves) > 0.0}


def _dataset(examined: Examined) -> dict[str, Any]:
    """Content of the data set's file in conf/dataset: source, files, clock and an entry for each
    proposed channel.
    """
    log = examined.log
    name = examined.name
    proposals = examined.proposals
    dataset: dict[str, Any] = {
        "name": name,
        "title": f"Recordings of {name}",
        "kind": examined.kind,
        "vehicle": UNNAMED_VEHICLE,
    }
    if car := {key: value for key, value in examined.vehicle.items() if value is not None}:
        dataset["car"] = car
    dataset |= {"licence": "yours", "citation": "none", "source": log.source, **examined.place}
    columns = log.by_name
    if log.source == "rosbag":
        return dataset | _bag_options(examined)
    if log.source in ("mdf", "can"):
        return dataset | dict(log.options) | _signal_options(examined)
    dataset |= log.options
    clock = log.clock
    if log.source != "vbo":
        if clock is None:
            dataset |= {"time": None, "rate_hz": examined.rate_hz}
        else:
            dataset["time"] = {"column": clock.column, "unit": clock.unit, **clock.repair}
    dataset["clock"] = "strict"
    if log.source == "vbo" and any(
        np.isnan(columns[proposal.column].values).any() for proposal in proposals.channels
    ):
        dataset.setdefault("max_gap", MAX_GAP)
    if log.source in TABLES:
        longest_bridge = 0.0
        has_holes = False
        dropped: dict[str, list[int | str]] = {}
        for surveyed in examined.logs:
            gaps = np.array(
                [_gaps(examined, surveyed, proposal.column) for proposal in proposals.channels]
            )
            short = gaps[gaps <= MAX_BRIDGED_SECONDS]
            longest_bridge = max(longest_bridge, float(short.max(initial=0.0)))
            if surveyed.seconds is None:
                continue
            holes = true_runs(gaps.max(axis=0) > MAX_BRIDGED_SECONDS)
            has_holes |= len(holes) > 0
            samples = (column.values for column in surveyed.columns)
            steps = np.diff(np.nan_to_num([surveyed.seconds, *samples]), prepend=np.nan)
            written_twice = np.flatnonzero((steps == 0.0).all(axis=0)).tolist()
            rows: list[int | str] = [
                *surveyed.repeated_names,
                *(f"{surveyed.file_row(a)}-{surveyed.file_row(b - 1)}" for a, b in holes),
                *map(surveyed.file_row, written_twice),
            ]
            dropped |= {surveyed.file.stem: rows} if rows else {}
        if longest_bridge:
            bridge = math.ceil(100.0 * longest_bridge * 1.05) / 100.0
            dataset |= {"source": "text_log", "bridge": bridge}
        if dropped:
            dataset["drop_rows"] = dropped
        if has_holes and "runs" not in log.options:
            dataset["max_gap"] = log.options.get("max_gap", MAX_GAP)
    dataset["channels"] = {
        proposal.channel: _entry(
            proposal,
            columns[proposal.column].place,
            columns[proposal.column].unit if log.source == "vbo" else "",
        )
        for proposal in proposals.channels
    }
    if proposals.pose:
        rate = examined.rate_hz or EVIDENCE_HZ if log.seconds is None else rate_of(log.seconds)
        dataset["pose"] = {
            **examined.pose_columns,
            "window": max(2 * round(POSE_SECONDS * rate / 2.0) + 1, 5),
            "order": 2,
            "channels": [name for name in POSE_CHANNELS if name not in dataset["channels"]],
        }
    return dataset


def _entry(proposal: Proposal, place: Mapping[str, Any], header: str = "") -> dict[str, Any]:
    """A channel's entry in a data set, with a factor where its unit is another one than that in the
    header, which its source compares with the entry.
    """
    unit = proposal.unit
    factor = proposal.factor
    if factor == 1.0 and (header_unit := plain_unit(header)) and header_unit != unit:
        si = CHANNELS[proposal.channel].unit
        factor = float(f"{factor_to_si(unit, si) / factor_to_si(header_unit, si):.7g}")
        unit = header_unit
    entry = {**place, "unit": unit}
    if proposal.sign != 1:
        entry["sign"] = proposal.sign
    if factor != 1.0:
        entry["factor"] = factor
    return entry


def _has_gaps(examined: Examined, log: Log, column: str) -> bool:
    """Whether a column lacks samples that neither lines bridge nor pauses cut out; a recording with
    such gaps cannot be resampled.
    """
    signal = log.by_name[column]
    measured_rows = np.flatnonzero(np.isfinite(signal.values))
    if not len(measured_rows):
        return True
    if log.source in TABLES:
        return log.clock is None and bool(_gaps(examined, log, column).max() > MAX_BRIDGED_SECONDS)
    if log.source != "rosbag" or signal.stamps is None:
        return False
    measured = signal.stamps[measured_rows]
    ends = signal.stamps[[0, -1]] == measured[[0, -1]]
    return not ends.all() or bool(
        (np.diff(measured)[np.diff(measured_rows) > 1] > MAX_BRIDGED_SECONDS).any()
    )


def _gaps(examined: Examined, log: Log, column: str) -> FloatArray:
    """Length of the gap that each row lies in [s], (N,): 0 in a row with a sample, infinite in a
    run without any.
    """
    values = log.by_name[column].values
    seconds = (
        log.seconds
        if log.seconds is not None
        else np.arange(len(values)) / (examined.rate_hz or EVIDENCE_HZ)
    )
    gap_seconds = np.zeros(len(values))
    for run in log.runs:
        times = seconds[run]
        is_measured = np.isfinite(values[run])
        edges = np.concatenate([times[:1], times[is_measured], times[-1:]])
        lengths = np.diff(edges) if is_measured.any() else np.array([math.inf])
        gap_seconds[run] = np.where(
            is_measured,
            0.0,
            lengths[np.clip(np.searchsorted(edges, times) - 1, 0, len(lengths) - 1)],
        )
    return gap_seconds


def _signal_options(examined: Examined) -> dict[str, Any]:
    """Options of a data set whose signals have times of their own: channels, rate and gaps."""
    channels = {}
    rates = []
    paused = False
    for proposal in examined.proposals.channels:
        column = examined.log.by_name[proposal.column]
        rate, gap = _rate_and_gap(column, MAX_BRIDGED_SECONDS)
        rates.append(rate)
        paused |= gap < _rate_and_gap(column)[1]
        entry = channels[proposal.channel] = _entry(proposal, column.place, column.unit)
        if 3.0 / rate < gap:
            entry["max_gap"] = math.ceil(100.0 * gap) / 100.0
    pause = {"max_gap": float(f"{max(MAX_GAP, FEWEST_STEPS / min(rates)):.3g}")} if paused else {}
    return {
        "rate_hz": plain_rate(max(rates), INTERPOLATED_TOLERANCE),
        **pause,
        "channels": channels,
    }


def _bag_options(examined: Examined) -> dict[str, Any]:
    """Options of a data set of ROS bags: topics with their channels and gaps, poses, and rate."""
    topics: dict[str, dict[str, Any]] = {}
    channels: dict[str, dict[str, Any]] = {}
    rates = []
    for proposal in examined.proposals.channels:
        column = examined.log.by_name[proposal.column]
        place = column.place
        short = str(place["topic"]).strip("/").replace("/", "_")
        rate, gap = _rate_and_gap(column)
        rates.append(rate)
        topic = topics.setdefault(
            short,
            {key: place[key] for key in ("topic", "type", "stamps")} | {"max_gap": MIN_GAP_SECONDS},
        )
        topic["max_gap"] = max(topic["max_gap"], math.ceil(150.0 * gap) / 100.0)
        stamps = column.stamps
        if stamps is not None and (np.diff(stamps) == 0.0).any():  # delivered in batches
            mean_rate = (len(stamps) - 1) / float(stamps[-1] - stamps[0])
            topic |= {"clock": "uniform", "rate_hz": plain_rate(mean_rate, INTERPOLATED_TOLERANCE)}
        entry = _entry(proposal, {"topic": short, "field": place["field"]})
        if proposal.offset:
            entry["offset"] = float(f"{proposal.offset:.5g}")
        channels[proposal.channel] = entry
    return {
        "rate_hz": plain_rate(min(max(rates), BAG_HZ), INTERPOLATED_TOLERANCE),
        "topics": topics,
        "channels": channels,
    }


def _rate_and_gap(column: RawColumn, shorter: float = math.inf) -> tuple[float, float]:
    """Median rate [Hz] and longest gap [s], of those up to ``shorter``, of the valid samples of a
    column with times of its own.
    """
    assert column.stamps is not None
    stamps = column.stamps[np.isfinite(column.values)]
    gaps = np.diff(stamps)
    return rate_of(stamps), float(gaps[gaps <= shorter].max(initial=0.0))


def _bridging(examined: Examined, recordings: Sequence[Recording]) -> list[dict[str, Any]]:
    """The transform that bridges impossible samples, as far to either side as the slowest signal
    was interpolated; empty if there are none.
    """
    channels = [
        (CHANNELS[name], samples)
        for recording in recordings
        for name, samples in recording.channels.items()
    ]
    if not any(
        0.0 < ((samples < limits.low) | (samples > limits.high)).mean() <= MOST_BRIDGED
        for limits, samples in channels
    ):
        return []
    columns = [examined.log.by_name[proposal.column] for proposal in examined.proposals.channels]
    rates = [rate_of(column.stamps) for column in columns if column.stamps is not None]
    beside = {"beside": math.ceil(1e3 / min(rates)) / 1e3} if rates else {}
    return [{"name": "bridge_impossible", **beside}]


def _transforms(
    examined: Examined,
    longest: Recording,
    late: Mapping[str, Late],
    speed: Sequence[dict[str, Any]],
    ratio: float | None,
    crawl_speed: float,
) -> list[dict[str, Any]]:
    """Transforms of the data set that derive the channels that estimators need.

    A reference that is late is shifted to the others' clock; a measured channel is not, since an
    estimator in the car would receive it late, too.
    """
    transforms: list[dict[str, Any]] = [
        {"name": "delay_correction", "delay": lateness.delay, "channels": [name]}
        for name, lateness in late.items()
        if CHANNELS[name].is_reference
    ]
    offsets = {
        proposal.channel: float(f"{proposal.factor * proposal.sign * proposal.offset:.5g}")
        for proposal in examined.proposals.channels
        if proposal.offset
    }
    if offsets and examined.log.source != "rosbag":  # whose channels have an offset of their own
        transforms.append({"name": "offset_correction", "offsets": offsets})
    transforms += speed
    for name in ("vy_ref", "ax"):
        if name in longest:
            continue
        supply = derivation_of(name, longest.channels, (), longest.rate_hz)
        if supply and not supply.meanings:  # no value is unknown
            transforms += map(dict, supply.transforms)
    for entry in transforms:
        if entry["name"] == "velocity_from_sideslip" and crawl_speed:
            entry["min_speed"] = crawl_speed
    if "handwheel" in longest and "steer" not in longest and ratio:
        transforms.append({"name": "steering_ratio", "ratio": float(f"{ratio:.4g}")})
    return transforms
