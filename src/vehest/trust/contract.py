"""The contract of every estimator, online (`GuardedStepper`) and for a recording (`GuardedRun`).

Both use the same compiled recursions.

    received rows -> guard -> health -> estimator -> watch -> verdict, bands -> estimate

1. Values that are not finite, beyond physics, jumping or standing still count as not measured, and
   so do samples that are missing.
2. Gaps up to 0.5 s are bridged; after longer ones the estimator starts anew.
3. After the warm-up of its window the estimate is finite. Where there is none, v fades from the
   last one to 0.
4. A channel that health accuses counts as not measured where the method can do without it; an
   estimator that remembers starts anew once the fault is over (`vehest.trust.verdict`).
5. The estimate stays within what the last accepted speed allows. One that does not for 0.3 s, or is
   not finite, starts anew, with adapting states, such as tyres, at their fitted values. Slower than
   0.1 m/s, at standstill, the car has no sideslip: 0.

An estimator that breaks down numerically returns NaN. An exception that it raises is a defect and
is passed on.

`GuardedRun` runs each step over all rows of a piece up to the next wait, restart or loss;
`GuardedStepper` runs all steps for one row. Rows pass the same compiled functions with the same
state, so that both return the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from numbers import Real
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.derived import STANDSTILL_SPEED
from vehest.data.errors import DataError
from vehest.data.estimate import Estimate, Mode
from vehest.data.recording import Recording
from vehest.estimators.base import Estimator, Stepper
from vehest.trust.bands import tyre_error_of
from vehest.trust.clock import REPEATED, STOPPED, SampleClock
from vehest.trust.front_end import FrontEnd
from vehest.trust.guard import (
    RESTART,
    USE,
    WAIT,
    Cleaned,
    Guard,
    GuardLimits,
    columns_of,
    usual_limits,
)
from vehest.trust.health import INVALID, Health
from vehest.trust.record import Trust
from vehest.trust.verdict import Monitor, starts_anew
from vehest.trust.watch import Watch, Watched

# exceptions of float() for a channel that is missing from a sample or is no number
NUMBER_ERRORS = (KeyError, TypeError, ValueError, OverflowError)
MOTION_CHANNELS = ("vx", "yaw_rate", "ay")  # columns of the motion that `Watch` receives


def limits_for(estimator: Estimator, trust: Trust | None) -> GuardLimits:
    """The guard's limits that were calibrated with an estimator, or else those of any car.

    Raises `DataError` where ``trust`` was calibrated with another estimator.
    """
    if trust is not None:
        trust.check_fit(estimator)
        if trust.guard is not None:
            return trust.guard
    return usual_limits(estimator.channels, estimator.settings.rate_hz)


class GuardedRun:
    """An estimator under the contract on a recording, or on its parts one after another with
    bitwise the same result.

    ``trust`` is the calibration of the fitted estimator; without it, limits are those of any car,
    and there is neither band nor health of channels. ``initial_state`` is the state at the first
    sample that a protocol prescribes, quantity -> value [SI]. ``elsewhere``: the car or its tyres
    are others than those calibrated on.

    Attributes
    ----------
    takes_parts : bool
        Whether the estimator continues where it stopped; else the recording must come whole.
    """

    def __init__(
        self,
        estimator: Estimator,
        trust: Trust | None = None,
        initial_state: Mapping[str, float] | None = None,
        *,
        elsewhere: bool = False,
    ) -> None:
        limits = limits_for(estimator, trust)
        rate = estimator.settings.rate_hz
        self.estimator = estimator
        self.initial_state = initial_state
        self.guard = Guard(
            estimator.channels, estimator.skippable, limits, rate, remembers=starts_anew(estimator)
        )
        self.monitor = Monitor(estimator, trust, elsewhere=elsewhere)
        self.watch = Watch(limits, estimator.warm_up_steps, rate)
        self.takes_parts = estimator.continues or estimator.warm_up_steps > 0
        self._begun = False
        self._speed = np.full(1, np.nan)
        self._state: Any = None  # of the estimator after the last row
        # rows that it still sees, where it has no state
        self._window = np.empty((0, len(estimator.channels)))
        self._late: dict[str, FloatArray] = {}  # values of the last ``horizon_steps`` rows
        self.extra_quantities: dict[str, FloatArray] = {}
        self.covariance: FloatArray | None = None
        self.covariance_of: tuple[str, ...] = ()

    def __call__(self, samples: Mapping[str, FloatArray], recording: Recording) -> Estimate:
        """The estimate of a part.

        Parameters
        ----------
        samples : mapping
            Channels that the estimator reads, (T,) each, as received: they may hold NaN,
            infinite or senseless values.
        recording : Recording
            Its clock, name and vehicle are used, its samples are not.

        Returns
        -------
        Estimate
            ``vy``, ``sideslip``, ``health``, ``health_reason`` and, with calibrated bands,
            ``band_vy`` and ``band_sideslip``.

        Raises
        ------
        DataError
            A channel is missing.
        """
        rows = _rows_read(samples, self.estimator, recording.id)
        self.recording, self.cleaned, steps = recording, self.guard(rows), len(rows)
        verdict = self.monitor.before(rows, self.cleaned)
        self.motion = motion_of(self.estimator.channels, self.cleaned)
        self.out = np.full(steps, np.nan)
        self.marks = np.zeros(steps, np.int8)
        self.vx = np.full(steps, np.nan)
        self.variance = np.full(steps, np.nan)
        self.tyre_error = np.zeros(steps)
        self.extra_quantities = {name: np.full(steps, np.nan) for name in self.extra_quantities}
        if self.covariance is not None:
            self.covariance = np.full((steps, *self.covariance.shape[1:]), np.nan)
        at = 0
        while at < steps:
            at = self._piece(at)
        self._begun = True
        return self._estimate(verdict)

    def _piece(self, start: int) -> int:
        """Estimate the rows from ``start`` up to the next wait or restart, or until the estimator
        is lost (`Watch`); returns the row to continue with.

        After a loss the next attempt is short at first, so that an estimator that is lost again and
        again takes no quadratic time.
        """
        flow = self.cleaned.flow
        lost = self.watch.state[5] > 0
        ends = np.flatnonzero(flow[start + 1 :] != (flow[start] if flow[start] == WAIT else USE))
        end = start + 1 + int(ends[0]) if len(ends) else len(flow)
        if flow[start] == WAIT:
            return self._watched(start, end, np.full(end - start, np.nan))[0]
        goes_on = self._begun and start == 0 and flow[0] == USE and not lost
        state, window = (self._state, self._window) if goes_on else (None, self._window[:0])
        first_reach = self.estimator.warm_up_steps + math.ceil(
            2.0 * self.estimator.settings.rate_hz
        )
        reach = min(start + first_reach, end) if lost else end
        while True:
            before = self.watch.state.copy()
            at, lost = self._watched(start, reach, self._raw(start, reach, state, window))
            if lost or reach == end:
                return at
            self.watch.state[:] = before
            reach = min(start + 2 * (reach - start), end)

    def _watched(self, start: int, end: int, raw: FloatArray) -> tuple[int, bool]:
        """Judge raw estimates of the rows ``start`` to ``end`` by the watch and keep what it
        leaves; returns the end of the rows that were judged, and whether the estimator was lost
        there.
        """
        motion = self.motion[start:end].copy()
        is_unknown = np.isnan(motion[:, 0])
        motion[is_unknown, 0] = self.vx[start:end][is_unknown]
        watched = self.watch(raw, motion, self.cleaned.flow[start:end])
        done = start + len(watched.vy)
        self.out[start:done] = watched.vy
        self.marks[start:done] = watched.marks
        return done, watched.lost

    def _raw(self, start: int, end: int, state: Any, window: FloatArray) -> FloatArray:
        """The estimator's v after each of the rows ``start`` to ``end``, before the watch, (T,)
        [m/s].

        It continues from ``state`` or from the rows before the piece, ``window``, or begins anew.
        """
        # rows after the last, whose values no estimate at their time depends on
        extra = self.estimator.horizon_steps
        rows = np.concatenate([window, self.cleaned.rows[start:end]])
        self._window = rows[max(len(rows) - self.estimator.warm_up_steps, 0) :]
        columns = np.concatenate([rows, np.repeat(rows[-1:], extra, axis=0)]).T
        r = self.recording
        piece = Recording(
            r.id,
            r.vehicle,
            self.estimator.settings.rate_hz,
            r.start_time,
            dict(zip(self.estimator.channels, columns, strict=True)),
            r.kind,
            frozenset(self.estimator.skippable),
        )
        estimate = self._estimated(
            piece, state, None if self._begun or start else self.initial_state
        )
        shift = slice(len(window) + extra, len(window) + extra + end - start)
        if "vx" in estimate.channels:
            self.vx[start:end] = estimate["vx"][shift]
        if "vy" in estimate.covariance_of and estimate.covariance is not None:
            row = estimate.covariance_of.index("vy")
            self.variance[start:end] = estimate.covariance[shift, row, row]
            if self.covariance is None:
                self.covariance = np.full((len(self.out), *estimate.covariance.shape[1:]), np.nan)
                self.covariance_of = estimate.covariance_of
            self.covariance[start:end] = estimate.covariance[shift]
        self.tyre_error[start:end] = tyre_error_of(self.monitor.tyre_check, estimate)[shift]
        for name, values in estimate.channels.items():
            if name not in ("vy", "sideslip"):
                self.extra_quantities.setdefault(name, np.full(len(self.out), np.nan))[
                    start:end
                ] = values[shift]
        return np.asarray(estimate["vy"][shift])

    def _estimated(
        self, piece: Recording, state: Any, initial_state: Mapping[str, float] | None
    ) -> Estimate:
        """The estimator's result on a piece; an estimator that can continue keeps its last state.

        Where ``state`` is None, it starts from the initial state of a protocol, if there is one.
        """
        estimator = self.estimator
        if not estimator.continues:
            return estimator.estimate([piece], initial_state)[0]
        if state is None:
            sample = np.array([piece[name][0] for name in estimator.channels])
            is_used = initial_state is not None and not estimator.ignores_initial_state
            state = estimator.first_state(sample, dict(initial_state or {}) if is_used else {})
        estimate, self._state = estimator.continue_from(piece, state)
        return estimate

    def _estimate(self, verdict: Health) -> Estimate:
        """The outputs of all rows as an estimate with the recording's times.

        The estimate after row k is for ``horizon_steps`` samples later, its health for row k.
        """
        r = self.recording
        horizon = self.estimator.horizon_steps
        monitor = self.monitor
        vx = np.concatenate(
            [self._speed, np.where(np.isnan(self.motion[:, 0]), self.vx, self.motion[:, 0])]
        )
        vx = vx[np.maximum.accumulate(np.where(np.isnan(vx), 0, np.arange(len(vx))))][1:]
        self._speed = vx[-1:]
        bands = monitor.after(
            verdict,
            Watched(self.out, self.marks, lost=False),
            self.cleaned,
            vx,
            self.variance,
            self.tyre_error,
        )

        def later(name: str, values: FloatArray) -> FloatArray:
            delayed = np.concatenate([self._late.get(name, np.full(horizon, np.nan)), values])
            self._late[name] = delayed[len(values) :]
            return delayed[: len(values)]

        vy = later("vy", self.out)
        channels = {
            "vy": vy,
            "sideslip": np.where(np.hypot(vx, vy) < STANDSTILL_SPEED, 0.0, np.arctan2(vy, vx)),
        }
        further = dict(self.extra_quantities)
        if monitor.has_bands:
            further |= {"band_vy": bands[:, 0], "band_sideslip": bands[:, 1]}
        channels |= {name: later(name, values) for name, values in further.items()}
        channels |= {"health": verdict.status, "health_reason": verdict.reason}
        mode: Mode = "causal" if self.estimator.causal else "offline"
        has_covariance = self.covariance is not None and horizon == 0
        covariance = (self.covariance, self.covariance_of) if has_covariance else (None, ())
        return Estimate(
            r.id,
            self.estimator.name,
            self.estimator.settings.rate_hz,
            r.start_time,
            channels,
            mode,
            *covariance,
        )


def _rows_read(
    samples: Mapping[str, FloatArray], estimator: Estimator, recording_id: str
) -> FloatArray:
    """Samples of the C channels that an estimator reads, in its order, (T, C); raises `DataError`
    where one is missing.
    """
    missing = [name for name in estimator.channels if name not in samples]
    if missing:
        raise DataError(
            f"recording '{recording_id}' has no channel '{missing[0]}', which estimator "
            f"'{estimator.name}' needs"
        )
    columns = [np.asarray(samples[name], np.float64) for name in estimator.channels]
    return np.ascontiguousarray(np.stack(columns, axis=1))


def motion_of(channels: Sequence[str], cleaned: Cleaned) -> FloatArray:
    """Accepted vx, yaw rate and ay of T rows after the guard, whose columns are ``channels``.

    Returns
    -------
    array
        (T, 3) [m/s, rad/s, m/s²], bridged values included; NaN where a channel is not read, or was
        not measured while the estimator waits.
    """
    motion = np.full((len(cleaned.rows), len(MOTION_CHANNELS)), np.nan)
    for column, at in enumerate(columns_of(MOTION_CHANNELS, channels)):
        if at >= 0:
            motion[:, column] = np.where(
                cleaned.measured[:, at] | (cleaned.flow != WAIT), cleaned.rows[:, at], np.nan
            )
    return motion


class GuardedStepper(Stepper):
    """Any fitted, causal estimator online, under the contract.

    ``trust`` and ``elsewhere`` are as of `GuardedRun`.

    Samples at ``bus_rate_hz``, if that is above the estimator's rate, go through a causal
    anti-aliasing filter first. A ``clock`` that is passed judges other time stamps than those of
    `step`, such as those of bus frames, and the caller passes these to it.

    Attributes
    ----------
    last : dict
        Result of the last step.
    marks : int
        Marks of `vehest.trust.watch` for it.

    Raises
    ------
    ConfigurationError
        The estimator is not causal, or the bus is slower than it.
    """

    def __init__(
        self,
        estimator: Estimator,
        trust: Trust | None = None,
        bus_rate_hz: float | None = None,
        *,
        elsewhere: bool = False,
        clock: SampleClock | None = None,
    ) -> None:
        self.estimator = estimator
        self.channels = tuple(estimator.channels)
        self._stepper = estimator.online()
        self._fresh = True
        self.horizon_steps = estimator.horizon_steps
        rate = estimator.settings.rate_hz
        limits = limits_for(estimator, trust)
        self.front_end = (
            FrontEnd(estimator.channels, estimator.skippable, limits, bus_rate_hz, rate)
            if bus_rate_hz is not None
            else None
        )
        self.input_rate_hz = rate if bus_rate_hz is None else bus_rate_hz
        self.guard = Guard(
            estimator.channels, estimator.skippable, limits, rate, remembers=starts_anew(estimator)
        )
        self.watch = Watch(limits, estimator.warm_up_steps, rate)
        filtered = bus_rate_hz is not None and bus_rate_hz > rate * (1 + 1e-6)
        self.monitor = Monitor(estimator, trust, elsewhere=elsewhere, behind_front_end=filtered)
        self._row = np.empty((1, len(estimator.channels)))
        self._motion = np.full((1, 3), np.nan)
        self._raw = np.empty(1)
        self._vx = np.full(1, np.nan)
        self._variance = np.full(1, np.nan)
        self._tyre_error = np.zeros(1)
        self._places = columns_of(MOTION_CHANNELS, estimator.channels)
        self.clock = SampleClock(self.input_rate_hz) if clock is None else clock
        self._judges_samples = clock is None
        self._extra_quantities: dict[str, float] = {}
        self.last: dict[str, float] = {"vy": math.nan, "sideslip": math.nan}
        self.marks = 0

    @property
    def delay(self) -> float:
        """Delay of slow signals through the filter from the bus's rate [s]; 0 without one."""
        return self.front_end.delay if self.front_end is not None else 0.0

    def step(self, sample: Mapping[str, Any] | None, time: float | None = None) -> dict[str, float]:
        """Take the sample received at one instant.

        Parameters
        ----------
        sample : mapping or None
            Channel -> value [SI]; a channel that is missing, None or no number counts as not
            measured; None: all.
        time : float or None
            Of the sample [s], if known: repeated samples are skipped, missing ones bridged.
            While stamps stand still, go back, jump or are uneven, the estimate is invalid
            (docs/online_contract.md). None, or no number: the sample is the next one at the
            rate.

        Returns
        -------
        dict
            ``vy`` [m/s] and ``sideslip`` [rad], NaN only before the first estimate; ``health``
            (0 valid, 1 degraded, 2 invalid) and ``health_reason`` of the sample; with
            calibrated bands their half widths at 90 %, ``band_vy`` and ``band_sideslip``.
        """
        if not isinstance(time, Real):
            if self._judges_samples:
                self.clock.unstamped()
            return self._received(sample)
        try:
            missing = self.clock.missing_before(float(time))
        except OverflowError:  # a whole number beyond every float
            missing = self.clock.missing_before(math.inf)
        if missing == STOPPED:
            self._received(None)
        elif missing != REPEATED:
            for _ in range(missing):
                self._received(None)
            self._received(sample)
        reason = 10_000.0 * self.clock.fault
        if reason and self.last.get("health_reason") != reason:  # between two estimates
            self.last = {**self.last, "health": float(INVALID), "health_reason": reason}
        return self.last

    def _received(self, sample: Mapping[str, Any] | None) -> dict[str, float]:
        """Pass a sample (None: nothing measured) on as one row at the bus's rate, and step if the
        front end returns a row for the estimator; returns the quantities of the last step.

        Channels without a number become NaN one by one, so that one of them does not cost the
        others.
        """
        row: FloatArray | None = self._row
        self._row[0] = math.nan
        if sample is not None:
            try:
                self._row[0] = [sample[name] for name in self.channels]
            except NUMBER_ERRORS:
                for column, name in enumerate(self.channels):
                    with suppress(*NUMBER_ERRORS):
                        self._row[0, column] = sample[name]
        if self.front_end is not None:
            row = self.front_end(self._row)
        if row is not None:
            self.last = self._stepped(row)
        return self.last

    def _stepped(self, row: FloatArray) -> dict[str, float]:
        """Process one row (1, C) at the estimator's rate by guard, health, estimator, watch,
        verdict and bands; returns the quantities as `step` does.

        While the clock is not trusted, the row is invalid by the clock's reason from the start.
        """
        cleaned = self.guard(row)
        verdict = self.monitor.before(row, cleaned)
        if self.clock.fault:
            verdict.status[0] = INVALID
            verdict.reason[0] = self.clock.fault * 10_000
        self._raw[0], vx, self._variance[0] = self._estimated(cleaned)
        motion = self._motion
        flow = cleaned.flow[0]
        for column, at in enumerate(self._places):
            is_measured = at >= 0 and (flow != WAIT or cleaned.measured[0, at])
            motion[0, column] = cleaned.rows[0, at] if is_measured else math.nan
        if math.isnan(motion[0, 0]):
            motion[0, 0] = vx
        watched = self.watch(self._raw, motion, cleaned.flow)
        if watched.lost:
            self._stepper = self.estimator.online()
            self._fresh = True
        self.marks = int(watched.marks[0])
        vy = float(watched.vy[0])
        if not math.isnan(motion[0, 0]):
            self._vx[0] = motion[0, 0]
        bands = self.monitor.after(
            verdict, watched, cleaned, self._vx, self._variance, self._tyre_error
        )
        vx = float(self._vx[0])
        quantities = {
            **self._extra_quantities,
            "vy": vy,
            "sideslip": 0.0 if math.hypot(vx, vy) < STANDSTILL_SPEED else math.atan2(vy, vx),
        }
        if self.monitor.has_bands:
            quantities["band_vy"] = float(bands[0, 0])
            quantities["band_sideslip"] = float(bands[0, 1])
        quantities["health"] = float(verdict.status[0])
        quantities["health_reason"] = float(verdict.reason[0])
        return quantities

    def _estimated(self, cleaned: Cleaned) -> tuple[float, float, float]:
        """Results of the estimator for a row: v [m/s], its estimate of vx [m/s] and the variance of
        v's error [m²/s²], NaN where it has none.

        All are NaN while the guard waits; the estimator starts anew where the guard says so.
        """
        flow = cleaned.flow[0]
        self._extra_quantities = {}
        self._tyre_error = np.zeros(1)
        if flow == WAIT:
            return math.nan, math.nan, math.nan
        if flow == RESTART and not self._fresh:
            self._stepper = self.estimator.online()
        self._fresh = False
        quantities = self._stepper.step(
            dict(zip(self.channels, cleaned.rows[0].tolist(), strict=True))
        )
        self._extra_quantities = {
            name: value for name, value in quantities.items() if name not in ("vy", "vy_variance")
        }
        check = self.monitor.tyre_check
        if check is not None:
            vx, friction = (np.array([quantities[name]]) for name in ("vx", "friction"))
            self._tyre_error = check.squared_errors(vx, friction)
        return (
            quantities["vy"],
            quantities.get("vx", math.nan),
            quantities.get("vy_variance", math.nan),
        )
