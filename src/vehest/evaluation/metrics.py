"""Scored samples, and metrics: errors of lateral velocity, sideslip angle and further states,
consistency of filters.

    spans --sequences, pieces_of--> ranges or sequences --score--> `Scored` --accuracy--> metric ->
    value
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehest.alignment.motion import rms
from vehest.constants import FloatArray
from vehest.data.derived import VelocityFromSideslip
from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.resampling import resampled
from vehest.data.splits import Span

BoolArray = NDArray[np.bool_]  # array of truth values

# m/s², from which tyres are taken to be in their nonlinear range (Bertipaglia et al. 2024, Section
# V)
NONLINEAR_AY = 4.0

MIN_SIDESLIP_SPEED = 1.0  # m/s, of a car with the wheelbase below or an unknown one
REFERENCE_WHEELBASE = 2.7  # m, wheelbase of the car for which `MIN_SIDESLIP_SPEED` holds

REFERENCES = {
    "vx": "vx_ref",
    "vy": "vy_ref",
    "yaw_rate": "yaw_rate_ref",
}  # quantity of an estimate -> channel that it is measured against

COVERAGE = {
    1: 0.6827,
    2: 0.9545,
}  # number of standard deviations -> fraction of Gaussian errors within them

POLYPHASE: Mapping[str, Any] = {"method": "polyphase", "transforms": []}
"""Preparation by which recordings are resampled unless a model was trained with another one."""

WEIGHTS = {"vx": 0.2225, "vy": 0.5064, "yaw_rate": 0.1566}
"""Weights of squared and absolute errors in SI units (Węgrzynowski et al. 2024, the authors' public
code).
"""

# unit -> names of metrics in it
_METRICS = {
    "1": (
        *(
            "fvu",
            "r2",
            "mse_weighted",
            "mae_weighted",
            "ae99_weighted",
            "nees",
            "nis",
            "coverage_1sigma",
            "coverage_2sigma",
            "share",
            "share_below_min_speed",
        ),
        *("n_sequences", "n_parameters", "epochs"),
    ),
    "deg": (
        "rmse_sideslip",
        "max_error_sideslip",
        "max_error_sideslip_nonlinear",
        "p99_sideslip",
        "floor_reference",
        "floor_cramer_rao",
    ),
    "deg²": ("mse_sideslip", "mse_sideslip_nonlinear"),
    "m/s": ("rmse_vy", "rmse_vx", "floor_reference_vy", "floor_cramer_rao_vy"),
    "rad/s": ("rmse_yaw_rate",),
    "m": ("lever_arm",),
    "s": ("train_seconds", "step_seconds"),
}
# unit, with a place for that of the quantity -> names of metrics of bands
_BAND_METRICS = {
    "1": (
        "coverage_50",
        "coverage_68",
        "coverage_90",
        "coverage_95",
        "coverage_90_p10",
        "coverage_90_p90",
        "error_icc",
        "band_blocks",
    ),
    "{}": ("width_90", "interval_score", "crps"),  # in the unit of the quantity
}
# name of a metric -> its unit
UNITS: dict[str, str] = {name: unit for unit, names in _METRICS.items() for name in names}
UNITS |= {
    f"{name}{suffix}": unit.format(of)
    for suffix, of in (("", "deg"), ("_vy", "m/s"))
    for unit, names in _BAND_METRICS.items()
    for name in names
}


@dataclass(frozen=True)
class Protocol:
    """Rules of an evaluation: which samples are scored, and where estimates start."""

    # rate of the times at which errors are taken [Hz]; an estimate is held, never interpolated
    rate_hz: float = 20.0
    # time before a range, or before each sequence, at which an estimator starts at the earliest [s]
    warm_up_seconds: float = 10.0
    # time from the start of each range, or of each sequence, that is not scored [s]
    skip_seconds: float = 1.5
    # ranges are cut, from their starts, into sequences of this length without overlap, in each of
    # which an estimate starts anew; a
    # remainder is left out [s]; None leaves ranges whole
    sequence_seconds: float | None = None
    # whether estimates start at the reference state of the first sample
    initial_state: bool = False
    # test sets, with commas between them, of another car or tyre than the training's that the
    # recordings do not distinguish by their
    # vehicle: bands are wider there by their rule
    elsewhere: str | None = None
    # speed of the car by its reference, from which on sideslip is scored [m/s]: on every data set,
    # or by data set; None, and data sets
    # without one, by the wheelbase (`with_wheelbases`)
    min_sideslip_speed: float | dict[str, float] | None = None

    def with_wheelbases(self, wheelbases: Mapping[str, float | None]) -> Protocol:
        """The protocol with a `min_sideslip_speed` for every data set, by its car's wheelbase.

        The function `min_sideslip_speed` gives the speed [m/s] from which on sideslip is scored.
        ``wheelbases`` is data set -> wheelbase [m], None where it is not known, for which the speed
        of a full-size car holds. Speeds that are set stay.
        """
        declared_speed = self.min_sideslip_speed
        if not (declared_speed is None or isinstance(declared_speed, dict)):
            return self
        speeds = {name: min_sideslip_speed(wheelbases[name]) for name in sorted(wheelbases)}
        return replace(self, min_sideslip_speed=speeds | (declared_speed or {}))

    def min_sideslip_speed_on(self, dataset: str) -> float:
        """Speed from which on sideslip is scored on a data set [m/s]."""
        speed = self.min_sideslip_speed
        if isinstance(speed, dict):
            return speed.get(dataset, MIN_SIDESLIP_SPEED)
        return MIN_SIDESLIP_SPEED if speed is None else speed

    def describe_min_sideslip_speed(self, datasets: Iterable[str]) -> str:
        """Text of the speed from which on sideslip is scored on these data sets: ``1 m/s``, or
        ``1 m/s (mine), 0.35 m/s (f1)``.
        """
        speeds: dict[str, list[str]] = {}
        for dataset in dict.fromkeys(datasets):
            speed = f"{self.min_sideslip_speed_on(dataset):.3g} m/s"
            speeds.setdefault(speed, []).append(dataset)
        if len(speeds) == 1:
            return next(iter(speeds))
        return ", ".join(f"{speed} ({', '.join(names)})" for speed, names in speeds.items())

    def describe_sideslip(self, datasets: Iterable[str]) -> str:
        """A sentence, after a space, on the samples of these data sets at which sideslip is
        scored.
        """
        return (
            " Sideslip is scored where the car moves at "
            f"{self.describe_min_sideslip_speed(datasets)} or more by its reference, "
            "lateral velocity at all samples."
        )

    @property
    def sets_elsewhere(self) -> frozenset[str]:
        """Names of the test sets in ``elsewhere``."""
        return frozenset(name.strip() for name in (self.elsewhere or "").split(",")) - {""}

    @property
    def piece(self) -> str:
        """Word for what is estimated in one go: ``range`` or ``sequence``."""
        return "range" if self.sequence_seconds is None else "sequence"

    @property
    def start_description(self) -> str:
        """Sentences on sequences and initial states, each after a space; empty for whole ranges
        that start from nothing.
        """
        words = ""
        if self.sequence_seconds is not None:
            words += (
                f" Ranges are cut from their starts into sequences of {self.sequence_seconds:g} s "
                "without overlap, in each of which every "
                f"estimate starts anew; a remainder is left out."
            )
        if self.initial_state:
            words += (
                " Estimates start at the reference state (forward and lateral velocity, yaw rate) "
                f"of the first sample of each {self.piece}, as far as the method has these states."
            )
        return words


def min_sideslip_speed(wheelbase: float | None) -> float:
    """Speed from which on sideslip is scored [m/s]: 1 m/s · sqrt(wheelbase / 2.7 m), 1 m/s where
    the wheelbase [m] is None.

    At standstill the direction of travel is noise. Cars of different size move alike at speeds that
    are as the roots of their lengths (equal Froude numbers).
    """
    scale = 1.0 if wheelbase is None else math.sqrt(wheelbase / REFERENCE_WHEELBASE)
    return MIN_SIDESLIP_SPEED * scale


@dataclass(frozen=True, eq=False)
class Scored:
    """Estimate and reference at the scored times; every array has shape (K,)."""

    time: FloatArray  # [s]
    vy: FloatArray  # estimated lateral velocity [m/s]
    vy_ref: FloatArray  # reference lateral velocity [m/s]
    sideslip: FloatArray  # estimated sideslip angle, atan2(vy, vx) with the measured vx [rad]
    sideslip_ref: FloatArray  # reference sideslip angle, atan2(vy_ref, vx) [rad]
    ay: FloatArray  # measured lateral acceleration [m/s²]; NaN where the recording has none
    is_sideslip_scored: BoolArray  # whether the car is fast enough (`Protocol.min_sideslip_speed`)
    # ``vx`` [m/s] and ``yaw_rate`` [rad/s] -> estimate and reference, where both are there
    other_states: Mapping[str, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    # covariance of the errors in ``covariance_of``, shape (K, n, n), where the method gives one
    covariance: FloatArray | None = None
    covariance_of: tuple[str, ...] = ()  # those quantities among `errors` that the covariance is of
    # normalised innovation squared of the filter's update, where the method gives it
    nis: FloatArray | None = None
    nis_dof: FloatArray | None = None  # numbers measured at each update
    # ``vy`` [m/s] and ``sideslip`` [rad] -> half width of the calibrated 90 % band, where there is
    # one
    bands: Mapping[str, FloatArray] = field(default_factory=dict)

    @property
    def errors(self) -> dict[str, FloatArray]:
        """Estimate - reference of ``vx``, ``vy`` [m/s] and ``yaw_rate`` [rad/s], of those that are
        there.
        """
        pairs = {**self.other_states, "vy": (self.vy, self.vy_ref)}
        return {name: pairs[name][0] - pairs[name][1] for name in REFERENCES if name in pairs}

    @property
    def sideslip_error(self) -> FloatArray:
        """Estimate - reference of β within a half turn, (K,) [rad]; at all samples."""
        return _unwrap_once(self.sideslip - self.sideslip_ref)

    @property
    def is_sideslip_drawn(self) -> BoolArray:
        """Whether β is drawn, (K,): where it is scored and the car moves forward.

        In reverse β jumps between -180° and 180°, which would set the axis; it is scored there.
        """
        return self.is_sideslip_scored & (np.abs(self.sideslip_ref) <= 0.5 * np.pi)

    def at(self, chosen: BoolArray | slice) -> Scored:
        """Lateral velocity and sideslip (`SCORED_ARRAYS`) at the chosen samples; without other
        states, covariances, innovations and bands.
        """
        arrays: dict[str, Any] = {name: getattr(self, name)[chosen] for name in SCORED_ARRAYS}
        return Scored(**arrays)

    @classmethod
    def joined(cls, parts: Sequence[Scored]) -> Scored:
        """Lateral velocity and sideslip at the samples of all parts, as `at` has them."""
        arrays: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts]) for name in SCORED_ARRAYS
        }
        return cls(**arrays)


SCORED_ARRAYS = ("time", "vy", "vy_ref", "sideslip", "sideslip_ref", "ay", "is_sideslip_scored")
"""Arrays that every `Scored` has."""


def sequences(
    spans: Sequence[Span], recording_of: Callable[[Span], Recording], protocol: Protocol
) -> list[Span]:
    """The segments of recordings that are estimated in one go: the ranges, or the sequences that
    they are cut into.

    Parameters
    ----------
    spans : sequence of Span
        Ranges of a test set.
    recording_of : callable
        Range -> the recording that it lies in, at ``protocol.rate_hz``; not called where the
        protocol has no sequences.
    protocol : Protocol
        With the length of a sequence.

    Returns
    -------
    list of Span
        In the order of the ranges; a rest that is shorter than a sequence is left out.

    Raises
    ------
    DataError
        All ranges are shorter than a sequence.
    """
    if protocol.sequence_seconds is None:
        return list(spans)
    steps = round(protocol.sequence_seconds * protocol.rate_hz)
    pieces = []
    for span in spans:
        recording = recording_of(span)
        first, end = recording.index_range(span.start, span.stop)
        for begin in range(first, end - steps + 1, steps):
            start, stop = (
                recording.start_time + index / recording.rate_hz for index in (begin, begin + steps)
            )
            pieces.append(Span(span.dataset, span.recording, start, stop))
    if not pieces:
        raise DataError(
            f"none of {', '.join(span.describe() for span in spans)} lasts as long as a sequence "
            f"of {protocol.sequence_seconds:g} s; set evaluation.sequence_seconds lower"
        )
    return pieces


def reference_state(reference: Recording, span: Span) -> dict[str, float]:
    """Reference state at the first sample of a range, from which estimates start where the protocol
    says so (`Protocol.initial_state`).

    Returns
    -------
    dict
        ``vx``, ``vy`` [m/s] and ``yaw_rate`` [rad/s], ISO 8855.

    Raises
    ------
    DataError
        The reference lacks one of them, or has a gap there.
    """
    first = reference.index_range(span.start, span.stop)[0]
    state = {}
    for name, channel in REFERENCES.items():
        if channel not in reference or np.isnan(reference[channel][first]):
            raise DataError(
                f"recording '{reference.id}' has no '{channel}' at {reference.time[first]:.12g} s "
                "to start estimates from; set evaluation.initial_state=false"
            )
        state[name] = float(reference[channel][first])
    return state


def score_all(
    estimate_of: Callable[[int], Estimate],
    spans: Sequence[Span],
    recording_of: Callable[[Span], Recording],
    protocol: Protocol,
) -> list[Scored]:
    """Score a test set's estimates: a `Scored` for each range or sequence, in the order of
    `sequences`.

    Parameters
    ----------
    estimate_of : callable
        Index in the test set's `sequences` -> its estimate.
    spans : sequence of Span
        Ranges of the test set.
    recording_of : callable
        Range -> the recording that it lies in, at ``protocol.rate_hz``.
    protocol : Protocol
        What is scored.

    Raises
    ------
    DataError
        All ranges are shorter than a sequence, or an estimate or reference is missing.
    """
    return [
        score(estimate_of(position), reference, piece, protocol)
        for position, (reference, piece) in enumerate(pieces_of(spans, recording_of, protocol))
    ]


def pieces_of(
    spans: Sequence[Span], recording_of: Callable[[Span], Recording], protocol: Protocol
) -> Iterator[tuple[Recording, Span]]:
    """Each range or sequence of a test set with the whole recording that it lies in, one in memory
    at a time.

    Yields
    ------
    reference : Recording
        At the rate of the protocol, made again only where the recording changes.
    piece : Span
        The range or sequence.

    Raises
    ------
    DataError
        As `sequences` does.
    """
    read = lru_cache(maxsize=1)(
        lambda dataset, recording: recording_of(Span(dataset, recording))
    )  # a range's sequences stand together

    def cached(span: Span) -> Recording:
        return read(span.dataset, span.recording)

    for piece in sequences(spans, cached, protocol):
        yield cached(piece), piece


def scored_range(reference: Recording, span: Span, protocol: Protocol) -> tuple[int, int]:
    """First index and end index of the samples of a recording that are scored in a range.

    Parameters
    ----------
    reference : Recording
        The recording, at any rate.
    span : Span
        The range; samples of its first ``protocol.skip_seconds`` [s] are left out.
    protocol : Protocol
        What is scored.
    """
    return reference.index_range(
        max(span.start, reference.start_time) + protocol.skip_seconds, span.stop
    )


def score(estimate: Estimate, reference: Recording, span: Span, protocol: Protocol) -> Scored:
    """Bring an estimate and its reference onto the evaluation grid.

    Parameters
    ----------
    estimate : Estimate
        At any rate; a value made for time t is scored at t.
    reference : Recording
        The recording at ``protocol.rate_hz``, with vx and vy_ref; with ay, if errors are to be
        split by it.
    span : Span
        The range that is scored, after ``protocol.skip_seconds``.

    Raises
    ------
    DataError
        The range is too short, or the estimate does not cover it.
    """
    start = max(span.start, reference.start_time) + protocol.skip_seconds
    scored = reference.cut(start, span.stop)
    for name in ("vx", "vy_ref", *(["ay"] if "ay" in scored else [])):
        if np.isnan(scored[name]).any():
            raise DataError(
                f"recording '{reference.id}': channel '{name}' has gaps within {span.describe()}; "
                "test on a range without"
            )

    def estimate_at(name: str) -> FloatArray:
        values = estimate.held_at(scored.time, name)
        _require_all(
            values,
            f"estimator '{estimate.estimator}' has no "
            f"estimate{'' if name == 'vy' else f' of {name}'}",
            span,
        )
        return values

    vy = estimate_at("vy")
    measured = {
        name: scored[channel]
        for name, channel in REFERENCES.items()
        if channel in scored and name in estimate.channels and name != "vy"
    }
    other_states = {
        name: (estimate_at(name), values)
        for name, values in measured.items()
        if not np.isnan(values).any()
    }
    covariance_of = tuple(
        name
        for name in REFERENCES
        if name in estimate.covariance_of and (name == "vy" or name in other_states)
    )
    covariance = estimate.covariance_at(scored.time, covariance_of) if covariance_of else None
    if covariance is not None:
        _require_all(
            covariance.sum(axis=(1, 2)), f"estimator '{estimate.estimator}' has no covariance", span
        )
    bands = {
        name: estimate_at(f"band_{name}")
        for name in ("vy", "sideslip")
        if f"band_{name}" in estimate.channels
    }
    innovations = "nis" in estimate.channels and "nis_dof" in estimate.channels
    return Scored(
        time=scored.time,
        vy=vy,
        vy_ref=scored["vy_ref"],
        sideslip=np.arctan2(vy, scored["vx"]),
        sideslip_ref=np.arctan2(scored["vy_ref"], scored["vx"]),
        ay=scored["ay"] if "ay" in scored else np.full(len(scored), np.nan),
        is_sideslip_scored=is_fast_enough(
            scored["vx"], scored["vy_ref"], protocol.min_sideslip_speed_on(span.dataset)
        ),
        other_states=other_states,
        covariance=covariance,
        covariance_of=covariance_of,
        nis=estimate_at("nis") if innovations else None,
        nis_dof=estimate_at("nis_dof") if innovations else None,
        bands=bands,
    )


def score_whole(
    estimate: Estimate, recording: Recording, preparation: Mapping[str, Any] = POLYPHASE
) -> Scored:
    """Score an estimate where it has values, after the first `Protocol.skip_seconds` of its
    recording.

    Parameters
    ----------
    estimate : Estimate
        Of the recording.
    recording : Recording
        With ``vx`` and ``vy_ref`` or ``sideslip_ref``; brought to `Protocol.rate_hz` if it has
        more. Sideslip counts from the speed that follows from its car's wheelbase
        (`min_sideslip_speed`).
    preparation : mapping
        By which the recording is brought to that rate.

    Raises
    ------
    DataError
        There is no reference or no estimate, they have gaps, or less than two samples in common.
    """
    recording = with_vy_ref(recording)
    times = estimate.time[np.isfinite(estimate["vy"])]
    if not len(times):
        raise DataError(f"estimator '{estimate.estimator}' has no estimate of '{recording.id}'")
    protocol = Protocol(min_sideslip_speed=min_sideslip_speed(recording.car.wheelbase))
    protocol = replace(protocol, rate_hz=min(protocol.rate_hz, recording.rate_hz))
    names = [
        "vx",
        "vy_ref",
        *(name for name in ("ay", "vx_ref", "yaw_rate_ref") if name in recording),
    ]
    drive = recording if preparation["transforms"] else recording.select(names)
    reference = resampled(drive, protocol.rate_hz, preparation)
    start = float(times[0]) - protocol.skip_seconds
    span = Span("", recording.id, start, float(times[-1]) + 1.0 / estimate.rate_hz)
    return score(estimate, reference, span, protocol)


def with_vy_ref(recording: Recording) -> Recording:
    """The recording, with ``vy_ref`` computed from ``vx`` and ``sideslip_ref`` where it has only
    these.
    """
    channels = recording.channels.keys()
    if "vy_ref" in channels or not {"vx", "sideslip_ref"} <= channels:
        return recording
    return VelocityFromSideslip()(recording)


def is_fast_enough(vx: FloatArray, vy_ref: FloatArray, min_speed: float) -> BoolArray:
    """Whether sideslip is scored, (K,): where the measured u and the reference v make ``min_speed``
    or more, all in m/s.
    """
    return np.asarray(np.hypot(vx, vy_ref) >= min_speed)


def moves_forward(vy: FloatArray, sideslip: FloatArray, min_speed: float) -> BoolArray:
    """Whether an estimated sideslip is stated and drawn: u is ``min_speed`` or more.

    Since β = atan2(v, u), the measured u is v/tan β: an estimate needs no further channel. A β of
    0 with v other than 0 is standstill (`STANDSTILL_SPEED`); both are 0 at any speed, and pass.

    Parameters
    ----------
    vy, sideslip : FloatArray
        Estimates of v [m/s] and β [rad], (K,).
    min_speed : float
        Speed from which on sideslip is scored [m/s] (`min_sideslip_speed`).

    Returns
    -------
    BoolArray
        Shape (K,); False in reverse, where β jumps between -180° and 180°, and where v is NaN.
    """
    is_standing = (sideslip == 0.0) & (vy != 0.0)
    is_fast = np.abs(vy) * np.cos(sideslip) >= min_speed * np.abs(np.sin(sideslip))
    return np.asarray(is_fast & ~is_standing)


def _require_all(values: FloatArray, problem: str, span: Span) -> None:
    """Raise `DataError` if a value is NaN; the message begins with ``problem`` and names the
    range.
    """
    missing = int(np.isnan(values).sum())
    if missing:
        raise DataError(
            f"{problem} for {missing} of {len(values)} scored samples of {span.describe()}; "
            f"give it a longer warm-up or check that it does not diverge"
        )


def accuracy(parts: Sequence[Scored]) -> dict[str, float]:
    """Metrics of the errors over all parts (ranges or sequences of a test set) together.

    Definitions: RMSE = sqrt(E[e²]); FVU = var(v - v̂)/var(v) and R² = 1 - FVU (Da Lio et al. 2023,
    Section VIII); ``…_nonlinear`` counts samples with |a_y| ≥ 4 m/s² only (Bertipaglia et al. 2024)
    and is NaN where there are none, or no a_y. ``…_weighted`` are the mean of squared
    `weighted_errors`, the mean and the 99th percentile of absolute ones. ``rmse_sideslip``,
    ``max_error_sideslip`` and ``p99_sideslip`` are of the samples at which sideslip is scored, NaN
    where there are none; ``share_below_min_speed`` is the share of the others. Metrics of a paper
    are of all samples, as it has them.

    Returns
    -------
    dict[str, float]
        Metric name -> value; sideslip in deg or deg². Metrics of other states, of covariances and
        of innovations are there only if all parts have what they need.
    """
    whole = Scored.joined(parts)
    error = np.degrees(whole.sideslip_error)

    def errors_at(is_counted: BoolArray) -> FloatArray:
        return error[is_counted] if is_counted.any() else np.full(1, np.nan)

    nonlinear = errors_at(np.abs(whole.ay) >= NONLINEAR_AY)
    scored = errors_at(whole.is_sideslip_scored)
    variance = float(np.var(whole.vy_ref))
    fvu = float(np.var(whole.vy_ref - whole.vy)) / variance if variance > 0 else math.nan
    return {
        "rmse_vy": rms(whole.vy - whole.vy_ref),
        "fvu": fvu,
        "r2": 1.0 - fvu,
        "rmse_sideslip": rms(scored),
        "mse_sideslip": float(np.mean(np.square(error))),
        "mse_sideslip_nonlinear": float(np.mean(np.square(nonlinear))),
        "max_error_sideslip": float(np.abs(scored).max()),
        "max_error_sideslip_nonlinear": float(np.abs(nonlinear).max()),
        "p99_sideslip": float(np.quantile(np.abs(scored), 0.99)),
        "share_below_min_speed": float(1.0 - whole.is_sideslip_scored.mean()),
        **_state_accuracy(parts),
        **_consistency(parts),
    }


def weighted_errors(part: Scored, size: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Sum over vx, vy and yaw rate of `WEIGHTS` times the size of the error, for each sample.

    Parameters
    ----------
    part : Scored
        Errors in SI units, shape (K,) each.
    size : callable
        Size of errors, element by element, such as `np.square`.

    Returns
    -------
    FloatArray
        Weighted sums, (K,).

    Raises
    ------
    DataError
        An estimate or a reference is missing.
    """
    errors = part.errors
    missing = [name for name in WEIGHTS if name not in errors]
    if missing:
        raise DataError(
            f"weighted errors need estimate and reference of {', '.join(WEIGHTS)}; there is none "
            f"of {', '.join(missing)}"
        )
    total: FloatArray = np.sum(
        [weight * size(errors[name]) for name, weight in WEIGHTS.items()], axis=0
    )
    return total


def _state_accuracy(parts: Sequence[Scored]) -> dict[str, float]:
    """Metrics of the states other than the lateral velocity that all parts have estimates of: name
    -> value.

    The weighted metrics are there only where all states of `WEIGHTS` are.
    """
    common = set.intersection(*(set(part.errors) for part in parts))
    figures = {
        f"rmse_{name}": rms(np.concatenate([part.errors[name] for part in parts]))
        for name in REFERENCES
        if name in common and name != "vy"
    }
    if common >= set(WEIGHTS):
        squared = np.concatenate([weighted_errors(part, np.square) for part in parts])
        absolute = np.concatenate([weighted_errors(part, np.abs) for part in parts])
        figures |= {
            "mse_weighted": float(squared.mean()),
            "mae_weighted": float(absolute.mean()),
            "ae99_weighted": float(np.quantile(absolute, 0.99)),
        }
    return figures


def _consistency(parts: Sequence[Scored]) -> dict[str, float]:
    """Metrics of the consistency of estimated covariances and innovations, name -> value; each only
    where all parts have them.

    ``nees`` is over all states whose covariance is estimated, the coverages are of the lateral
    velocity.
    """
    figures = {}
    kinds = {part.covariance_of for part in parts}
    if len(kinds) == 1 and "vy" in (names := kinds.pop()):
        errors = np.concatenate(
            [np.stack([part.errors[name] for name in names], axis=1) for part in parts]
        )
        covariance = np.concatenate(
            [part.covariance for part in parts if part.covariance is not None]
        )
        row = names.index("vy")
        figures["nees"] = float(np.mean(normalised_error_squared(errors, covariance)))
        for n_sigma in (1, 2):
            figures[f"coverage_{n_sigma}sigma"] = coverage(
                errors[:, row], covariance[:, row, row], n_sigma
            )
    innovations = [
        (part.nis, part.nis_dof)
        for part in parts
        if part.nis is not None and part.nis_dof is not None
    ]
    if len(innovations) == len(parts):
        nis, dof = (np.concatenate(columns) for columns in zip(*innovations, strict=True))
        figures["nis"] = normalised_innovation_squared(nis, dof)
    return figures


def normalised_error_squared(errors: FloatArray, covariance: FloatArray) -> FloatArray:
    """Normalised estimation error squared of each sample over its dimension, eᵀP⁻¹e / n.

    Its mean is 1 for a consistent filter, above 1 for one that is too sure of itself. Infinite
    where P is not positive definite.

    Parameters
    ----------
    errors : FloatArray
        Estimate - reference, shape (K, n).
    covariance : FloatArray
        Shape (K, n, n).

    Returns
    -------
    FloatArray
        Shape (K,).

    Source: Bar-Shalom, Li & Kirubarajan, Estimation with Applications to Tracking and Navigation,
    2001, Section 5.4.2.
    """
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    proper = np.all(variances > 0, axis=1)
    deviations = np.sqrt(np.where(proper[:, None], variances, 1.0))
    correlation = covariance / (deviations[:, :, None] * deviations[:, None, :])
    eigenvalues, vectors = np.linalg.eigh(
        np.where(proper[:, None, None], correlation, np.eye(errors.shape[1]))
    )
    definite = proper & np.all(eigenvalues > 0, axis=1)
    whitened = np.einsum("kij,ki->kj", vectors, errors / deviations)
    squared = np.sum(np.square(whitened) / np.where(definite[:, None], eigenvalues, 1.0), axis=1)
    return np.where(definite, squared / errors.shape[1], np.inf)


def normalised_innovation_squared(nis: FloatArray, dof: FloatArray) -> float:
    """Mean of a filter's normalised innovation squared over the numbers that were measured; 1 for a
    consistent filter.

    Parameters
    ----------
    nis : FloatArray
        eᵀS⁻¹e of each update, shape (K,).
    dof : FloatArray
        Numbers measured at each, shape (K,); samples with none do not count.

    Returns
    -------
    float
        NaN if nothing was measured at any sample.

    Source: Bar-Shalom, Li & Kirubarajan 2001, Section 5.4.2.
    """
    measured = dof > 0
    return float(np.mean(nis[measured] / dof[measured])) if measured.any() else float("nan")


def coverage(errors: FloatArray, variance: FloatArray, n_sigma: float) -> float:
    """Fraction of errors, (K,) like ``variance``, within ``n_sigma`` standard deviations;
    `COVERAGE` says what is expected of Gaussians.
    """
    return float(np.mean(np.square(errors) <= n_sigma**2 * variance))


def _unwrap_once(angle: FloatArray) -> FloatArray:
    """Differences of angles [rad] with those beyond ±π brought within: an estimate near 180° is not
    a full turn off a reference near -180°.
    """
    return np.where(np.abs(angle) > np.pi, wrap_to_half_turn(angle), angle)


def wrap_to_half_turn(angle: FloatArray) -> FloatArray:
    """Angle within [-π, π), equal to the given one but for whole turns [rad]."""
    return np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi
