"""The compiled recursion behind `vehest.trust.health`.

rows -> x, y -> innovations ε -> statistics against their limits -> status, reason

The model and the state are named tuples of arrays. With φ(x) features of yaw rate and speed,
channels x become y = x - W φ(x), of which an autoregression predicts the next sample; ε is its
error, in units of the noise at that speed, and S its covariance. A fault that adds b to channel i
moves y by J b, J = ∂y/∂xᵢ, and the innovations by h b, h = J - Σ_l A_l J once it lasts. An offset
is detected by its likelihood ratio over exponentially forgotten samples,

    z = Σ λʲ hᵀS⁻¹ε / √(Σ λ²ʲ hᵀS⁻¹h),

which is N(0, 1) without a fault. Innovations count with at most `CLIP` deviations in it, and no
sample with more than its share, so that a kerb is no offset.

A row passes, in this order: `_receive` (gaps, repeated samples), `_describe` (features, y, noise
level), `_predict` (ε), `_look_at_innovations`, `_look_for_offsets`, `_look_at_values`,
`_look_at_relations` (statistics), `_decide` (status, reason), `_remember`. Sums run over channels,
lags and features in order of their index, so that rows one at a time, a recording at once and the
export in C give the same. There is no gradient.

Source: Willsky & Jones, A generalized likelihood ratio approach to the detection and estimation of
jumps in linear systems, IEEE Trans. Automatic Control 21 (1), 1976; windows replaced by forgetting.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.estimators.kernels import compiling
from vehest.trust.named_arrays import open_views

IntArray = NDArray[np.int64]  # array of integers
# arrays are views without references, so none are counted: two thirds of the time to compile
part = partial(compiling.part, _nrt=False)

# times the largest size in training, beyond which a value counts as not measured
PLAUSIBLE = 1000.0
CLIP = 4.0  # standard deviations to which innovations are clipped for offsets
STEP_CLIP = 8.0  # standard deviations to which they are clipped for steps and for the energy
CALM = 0.3  # added to the energy, which is 1 on average, so that a calm segment makes no jump
# times its limit: a statistic remembers no more, so that it is down again soon after a fault
CAP = 2.0
INVALID = 1.5  # times its limit, from which on an estimate is invalid and not only degraded
CLEAR = 0.95  # times its limit, below which a statistic has to stay
BRAKING = 2.0  # m/s², beyond which a wheel that stands still is locked rather than lost
SLIPPING = 0.3  # share by which a second wheel is slow, which makes both locked
LOST = 0.5  # share by which a wheel is slow that is locked or lost
REVERSED = -0.5  # correlation below which a relation has the wrong sign
HOLDS = 0.7  # correlation above which a relation holds
SLIDE_SECONDS = 4.0  # s for which a change of the lateral velocity is remembered
LARGER = 2.5  # factor, either way, that makes a relation one of the wrong unit

INSTANT_FEATURES = 6  # number of first features that relations which hold for each sample may use
# index of the first small feature: those of drag, which say nothing of signs and units
FIRST_SMALL = 9
N_FEATURES = 13  # number of features; this and the next two stand as digits in the shapes below
N_LEVELS = 5  # speeds at which the noise is known

(
    FREE,
    MISSING,
    FROZEN,
    HELD,
    JUMP,
    NOISE,
    SMOOTH,
    OFFSET,
    SCALE,
    SIGN,
    UNIT,
    CONTRADICTION,
    OUTSIDE,
    SPIN,
    LOCKED,
    DROPOUT,
    LATE,
) = range(17)
"""Kinds of reasons, whose texts are `vehest.trust.health.REASONS`; `FREE`: no reason."""


class Layout(NamedTuple):
    """Sizes of the kernel's arrays, columns of channels (-1: there is none), and times in rows."""

    channels: int  # C
    order: int  # p of the autoregression
    relations: int  # R
    yaw_rate: int  # column
    speed: int  # column of the channel that serves as u
    ay: int  # column
    ax: int  # column
    hold: int  # rows for which a flag is held
    bridged: int  # rows that a channel may be missing beyond its gap limit until it is invalid
    spinning: int  # rows beyond the spin's limits until the car counts as spinning
    settling: int  # rows after the start before predictions count
    statistics: int  # K


class Settings(NamedTuple):
    """Limits of standstill and spin, sampling interval, and forgetting factors.

    A forgetting factor is the weight 1 - exp(-step/τ) of the present row in a mean.
    """

    least_speed: float  # speed below which the car may stand, and that divides at least
    still_yaw_rate: float  # yaw rate below which it may stand [rad/s]
    still_ay: float  # ay below which it may stand [m/s²]
    step: float  # sampling interval [s]
    spin_yaw_rate: float  # yaw rate beyond which the car may spin [rad/s]
    spin_turning: float  # yaw rate times speed beyond which it may spin
    forget_share: float  # forgetting factor of the share of equal samples
    forget_ax: float  # forgetting factor of the mean of ax
    forget_energy: float  # forgetting factor of the innovations' energy
    # forgetting factor of the likelihood ratio of an offset; 0: it does not forget
    forget_offset: float
    forget_short: float  # forgetting factor of the sides of relations, for signs and units
    forget_relation: float  # forgetting factor of the residuals of relations


class Statistics(NamedTuple):
    """A value of each statistic, in the order of `HealthModel.statistics`.

    ``all_values`` is all of them in one array.
    """

    all_values: Annotated[FloatArray, "statistics"]
    jump: Annotated[FloatArray, "channels"]  # innovation against its energy in the last half second
    step: Annotated[FloatArray, "channels"]  # likelihood ratio of a step that began p samples ago
    offset: Annotated[FloatArray, "channels"]  # likelihood ratio
    run: Annotated[FloatArray, "channels"]  # equal samples in a row
    share: Annotated[FloatArray, "channels"]  # share of equal samples
    domain: Annotated[FloatArray, "channels"]  # size over the largest in training
    slip: Annotated[FloatArray, "channels"]  # |slip| of a wheel; 0 for other channels
    relation: Annotated[FloatArray, "relations"]  # |mean residual| of a relation


class Model(NamedTuple):
    """Constants of the recursion, by the names that the C source gives them.

    [m, q] is of channel m on channel q.
    """

    layout: Layout  # sizes and columns
    settings: Settings  # limits and forgetting factors
    constant: Annotated[FloatArray, "channels"]  # c of the autoregression
    # coefficients of the autoregression, A [lag, m, q]: of channel m at a lag in channel q
    lags: Annotated[FloatArray, "order channels channels"]
    precision: Annotated[FloatArray, "channels channels"]  # S⁻¹
    deviation: Annotated[FloatArray, "channels"]  # standard deviation of the innovations
    instant: Annotated[FloatArray, "channels 13"]  # W
    average: Annotated[FloatArray, "relations 13"]  # coefficients of relations
    rate_gain: Annotated[FloatArray, "relations"]  # gain of du/dt in each relation
    usual: Annotated[FloatArray, "channels"]  # medians
    largest: Annotated[FloatArray, "channels"]  # largest absolute value in training
    speeds: Annotated[FloatArray, "5"]  # speeds at which noise levels are given, ascending
    levels: Annotated[FloatArray, "5 channels"]  # noise at these speeds
    settled_gain: Annotated[FloatArray, "channels channels"]  # 1 - Σ A_l [m, q]
    # weight of a former innovation in q on a step in m [lag, m, q]
    steps: Annotated[FloatArray, "order channels channels"]
    step_power: Annotated[FloatArray, "channels channels"]  # variance of the weighted sum
    healthy: Annotated[FloatArray, "channels"]  # offsets of healthy drives
    heaviest: Annotated[FloatArray, "channels"]  # largest weight of one sample in an offset
    # lower and upper, between which alone a channel is expected to move
    stops: Annotated[FloatArray, "2 channels"]
    priority: Annotated[FloatArray, "statistics"]  # priority of the reason of each
    limits: Statistics  # limit of each statistic
    inverse: Statistics  # 1 over the limit
    modelled: Annotated[IntArray, "channels"]  # whether the autoregression holds the channel
    rests: Annotated[IntArray, "channels"]  # whether a channel may stand still while the car moves
    gap_limit: Annotated[IntArray, "channels"]  # longest gap in training [rows]
    wheel: Annotated[IntArray, "channels"]  # whether a channel is a wheel's speed
    code: Annotated[IntArray, "channels"]  # number of the channel in a reason's code
    target: Annotated[IntArray, "relations"]  # column that a relation explains
    versus: Annotated[IntArray, "relations"]  # column that it is held against
    # 1 if a relation uses a channel, 2 if only in a small term
    involved: Annotated[IntArray, "relations channels"]
    kind: Annotated[IntArray, "statistics"]  # kind of the reason that it leads to
    accused: Annotated[IntArray, "statistics"]  # column of the channel that is accused
    partner: Annotated[IntArray, "statistics"]  # column of the other channel; -1: none


class State(NamedTuple):
    """Variables, by the names of the C struct; those from ``x`` on are used within a row only."""

    rows: Annotated[FloatArray, "1"]  # number of rows so far
    hold: Annotated[FloatArray, "1"]  # rows until a flag is cleared
    reason: Annotated[FloatArray, "1"]  # the last one
    status: Annotated[FloatArray, "1"]  # the last one
    spinning: Annotated[FloatArray, "1"]  # rows for which the spin's limits have been exceeded
    since_jump: Annotated[FloatArray, "1"]  # rows since the yaw rate jumped
    mean_ax: Annotated[FloatArray, "1"]  # mean of ax over `BRAKING_SECONDS` of health [m/s²]
    # change of the lateral velocity within about `SLIDE_SECONDS`
    drift: Annotated[FloatArray, "1"]
    last: Annotated[FloatArray, "channels"]  # last measured value
    # rows without a sample; below zero while predictions settle again
    gap: Annotated[FloatArray, "channels"]
    run: Annotated[FloatArray, "channels"]  # equal samples in a row
    share: Annotated[FloatArray, "channels"]  # share of equal samples
    past_y: Annotated[FloatArray, "order channels"]  # y of the last p rows, the latest first
    innovation: Annotated[FloatArray, "order channels"]  # clipped ε of the last p rows
    energy: Annotated[FloatArray, "channels"]  # mean square of the innovations over deviation²
    ratio_sum: Annotated[FloatArray, "channels"]  # Σ hᵀS⁻¹ε
    ratio_weight: Annotated[FloatArray, "channels"]  # Σ hᵀS⁻¹h
    average: Annotated[FloatArray, "relations"]  # means of the residuals of relations
    mean_speed: Annotated[FloatArray, "2"]  # means of u: short and long
    left: Annotated[FloatArray, "relations"]  # short mean of the residual without small terms
    smooth: Annotated[FloatArray, "relations"]  # short mean of the target
    # long means of observed target times expected target, and of the squares of both
    product: Annotated[FloatArray, "relations"]
    expected_power: Annotated[FloatArray, "relations"]  # mean square of the expected side
    observed_power: Annotated[FloatArray, "relations"]  # mean square of the observed side
    x: Annotated[FloatArray, "channels"]  # present values, of which the last replaces a missing one
    y: Annotated[FloatArray, "channels"]  # x - W φ(x)
    error: Annotated[FloatArray, "channels"]  # ε
    scaled: Annotated[FloatArray, "channels"]  # ε over its level at this speed
    clipped: Annotated[FloatArray, "channels"]  # ε over its level, within `CLIP` deviations
    ratio: Annotated[FloatArray, "channels"]  # likelihood ratio of a jump
    score: Annotated[FloatArray, "channels"]  # S⁻¹ε
    clipped_score: Annotated[FloatArray, "channels"]  # S⁻¹ times the clipped ε
    stepped: Annotated[FloatArray, "channels"]  # weighted sum of the last p innovations for a step
    level: Annotated[FloatArray, "channels"]  # noise at this speed over that at all speeds
    feature: Annotated[FloatArray, "13"]  # φ(x)
    by_yaw_rate: Annotated[FloatArray, "13"]  # derivatives of the features by the yaw rate
    by_speed: Annotated[FloatArray, "13"]  # derivatives of the features by the speed
    slope: Annotated[FloatArray, "channels"]  # J
    effect: Annotated[FloatArray, "channels"]  # h
    statistics: Statistics  # values of this row


@compiling.entry(nogil=True, _nrt=False)
def health_kernel(rows, measured, tables, memory, out, statistics):
    """Judge rows, as received, one after another.

    Parameters
    ----------
    rows : array
        (T, C) [SI].
    measured : array
        Which of their values count as measured, bool (T, C).
    tables : array
        Flat array of a `Model`, as of `HealthModel.packed`.
    memory : array
        Flat array of a `State`, as of `HealthModel.start`; changed in place.
    out : array
        Output, (3, T): status, code of the reason, largest statistic over its limit.
    statistics : array
        Output, (T, K), or (0, K) where they are not wanted.
    """
    model = open_views(Model, tables, open_views(Layout, tables, ()))
    state = open_views(State, memory, model.layout)
    for k in range(rows.shape[0]):
        missing_channel = _receive(k, rows, measured, model, state)
        is_standing = _describe(model, state)
        _predict(model, state)
        _look_at_innovations(model, state)
        _look_for_offsets(model, state)
        slow = _look_at_values(is_standing, model, state)
        _look_at_relations(is_standing, model, state)
        out[0, k], out[1, k], out[2, k] = _decide(missing_channel, slow, model, state)
        # a slice would compile for seconds
        for j in range(statistics.shape[1] if statistics.shape[0] > 0 else 0):
            statistics[k, j] = state.statistics.all_values[j]
        _remember(model, state)


@part()
def _receive(k, rows, measured, model, state):
    """Take row k into the state: values, gaps, and counts of equal samples.

    Returns the channel that has been missing for longest beyond its limit, -1 if none has.

    The last value replaces one that was not measured. A channel that is back has p rows to settle
    in.
    """
    first = state.rows[0] == 0.0
    longest = 0.0
    missing_channel = -1
    for i in range(model.layout.channels):
        value = rows[k, i]
        is_usable = measured[k, i] and abs(value) <= PLAUSIBLE * model.largest[i]  # false for NaN
        if first:
            state.last[i] = value if is_usable else model.usual[i]
        if is_usable:
            is_frozen = (
                model.stops[0, i] < value < model.stops[1, i]
                and value == state.last[i]
                and not first
            )
            state.run[i] = state.run[i] + 1.0 if is_frozen else 0.0
            state.share[i] += model.settings.forget_share * (
                (1.0 if is_frozen else 0.0) - state.share[i]
            )
            state.last[i] = value
            state.gap[i] = (
                -float(model.layout.order) if state.gap[i] > 0.0 else min(state.gap[i] + 1.0, 0.0)
            )
        else:
            state.gap[i] = max(state.gap[i], 0.0) + 1.0
            excess = state.gap[i] - model.gap_limit[i]
            if excess > longest:
                longest = excess
                missing_channel = i
        state.x[i] = state.last[i]
    return missing_channel


@part()
def _value(state, column):
    """Present value of a column, 0 where there is none (-1)."""
    return state.x[column] if column >= 0 else 0.0


@part()
def _describe(model, state):
    """Compute the features with their derivatives, y = x - W φ(x) and the noise at this speed.

    Returns whether the car stands.

    Features are 1, r, u, u r, (u r)³/100, r/w, ay, ay/w², ay³/100, r², u², ax and v r, with w =
    max(|u|, least speed). The drift v' = y_ay - v/`SLIDE_SECONDS`, at most |u| in size, replaces
    the unknown v. The noise level is interpolated between the speeds of training, and constant
    beyond them.
    """
    columns = model.layout
    settings = model.settings
    speeds = model.speeds
    r = _value(state, columns.yaw_rate)
    u = _value(state, columns.speed)
    ay = _value(state, columns.ay)
    ax = _value(state, columns.ax)
    speed = abs(u)
    turning = u * r
    w = max(speed, settings.least_speed)
    bent = 0.03 * turning * turning
    values = (
        1.0,
        r,
        u,
        turning,
        0.01 * turning * turning * turning,
        r / w,
        ay,
        ay / (w * w),
        0.01 * ay * ay * ay,
        r * r,
        u * u,
        ax,
    )
    for f in range(N_FEATURES - 1):
        state.feature[f] = values[f]
    by_yaw_rate = (0.0, 1.0, 0.0, u, bent * u, 1.0 / w)
    by_speed = (
        0.0,
        0.0,
        1.0,
        r,
        bent * r,
        -r / (u * speed) if speed > settings.least_speed else 0.0,
    )
    for f in range(INSTANT_FEATURES):
        state.by_yaw_rate[f] = by_yaw_rate[f]
        state.by_speed[f] = by_speed[f]
    at = 0
    share = 0.0
    while at < N_LEVELS - 2 and speed > speeds[at + 1]:
        at += 1
    if speeds[at + 1] > speeds[at]:
        share = min(max((speed - speeds[at]) / (speeds[at + 1] - speeds[at]), 0.0), 1.0)
    for i in range(model.layout.channels):
        state.level[i] = (1.0 - share) * model.levels[at, i] + share * model.levels[at + 1, i]
        total = state.x[i]
        for f in range(INSTANT_FEATURES):
            total -= model.instant[i, f] * state.feature[f]
        state.y[i] = total
    if columns.ay >= 0:  # less u r it is the change of v
        drift = state.drift[0] + settings.step * (
            state.y[columns.ay] - state.drift[0] / SLIDE_SECONDS
        )
        state.drift[0] = min(max(drift, -speed), speed)
    state.feature[N_FEATURES - 1] = state.drift[0] * r
    return (
        speed < settings.least_speed
        and abs(r) < settings.still_yaw_rate
        and abs(ay) < settings.still_ay
    )


@part()
def _predictable(i, model, state):
    """Whether channel i is modelled, and it and the channels of its relation have been measured for
    long enough that its prediction counts.
    """
    r = model.layout.yaw_rate
    u = model.layout.speed
    if state.rows[0] < model.layout.settling or model.modelled[i] == 0 or state.gap[i] != 0.0:
        return False
    for f in range(1, INSTANT_FEATURES):
        if model.instant[i, f] != 0.0:
            if r >= 0 and state.by_yaw_rate[f] != 0.0 and state.gap[r] != 0.0:
                return False
            if u >= 0 and state.by_speed[f] != 0.0 and state.gap[u] != 0.0:
                return False
    return True


@part()
def _predict(model, state):
    """Compute the innovations, scaled and clipped, and their scores S⁻¹ε; zero where nothing can be
    predicted.

    ε = y - c - Σ_l A_l y_{k-l}, over the noise level; clipped to `CLIP` deviations for offsets and
    to `STEP_CLIP` for steps. A channel that is missing takes its prediction as y, so that the
    others' next predictions stay possible.
    """
    C = model.layout.channels
    p = model.layout.order
    for i in range(C):
        state.error[i] = model.constant[i]
    for lag in range(p):
        for m in range(C):
            for i in range(C):
                state.error[i] += model.lags[lag, m, i] * state.past_y[lag, m]
    for lag in range(p - 1, 0, -1):
        for i in range(C):
            state.innovation[lag, i] = state.innovation[lag - 1, i]
    for i in range(C):
        if _predictable(i, model, state):
            state.error[i] = state.y[i] - state.error[i]
        else:
            if state.gap[i] > 0.0 and state.rows[0] >= p:
                state.y[i] = state.error[i]
            state.error[i] = 0.0
        scaled_error = state.error[i] / state.level[i]
        deviation = model.deviation[i]
        state.scaled[i] = scaled_error
        state.clipped[i] = min(max(scaled_error, -CLIP * deviation), CLIP * deviation)
        state.innovation[0, i] = min(
            max(scaled_error, -STEP_CLIP * deviation), STEP_CLIP * deviation
        )
    for i in range(C):
        score = 0.0
        clipped = 0.0
        stepped = 0.0
        for j in range(C):
            score += model.precision[i, j] * state.scaled[j]
            clipped += model.precision[i, j] * state.clipped[j]
        for lag in range(p):
            for j in range(C):
                stepped += model.steps[lag, i, j] * state.innovation[lag, j]
        state.score[i] = score
        state.clipped_score[i] = clipped
        state.stepped[i] = stepped


@part()
def _look_at_innovations(model, state):
    """Compute the statistic of a jump of each channel: its innovation over those of the last half
    second.

    It is z = |(S⁻¹ε)_i|/√(S⁻¹)_ii over √(`CALM` + energy), with the mean square of the channel's
    former innovations as energy, which is updated afterwards.
    """
    statistics = state.statistics
    for i in range(model.layout.channels):
        z = (
            abs(state.score[i]) / math.sqrt(model.precision[i, i])
            if model.modelled[i] == 1
            else 0.0
        )
        state.ratio[i], statistics.jump[i] = z, z / math.sqrt(CALM + state.energy[i])
        if i == model.layout.yaw_rate:
            state.since_jump[0] = (
                0.0 if statistics.jump[i] > model.limits.jump[i] else state.since_jump[0] + 1.0
            )
        normed = state.innovation[0, i] / model.deviation[i]
        state.energy[i] += model.settings.forget_energy * (normed * normed - state.energy[i])


@part()
def _slope(i, model, state):
    """Write J = ∂y/∂xᵢ of channel i into the state, (C,)."""
    r = model.layout.yaw_rate
    u = model.layout.speed
    for m in range(model.layout.channels):
        total = 1.0 if m == i else 0.0
        if i in (r, u):
            for f in range(1, INSTANT_FEATURES):
                total -= model.instant[m, f] * (
                    state.by_yaw_rate[f] if i == r else state.by_speed[f]
                )
        state.slope[m] = total


@part()
def _look_for_step(i, counts, model, state):
    """Compute the statistic of a step in channel i that began p samples ago; 0 unless ``counts``.

    z = |Σ_m J_m/level_m · stepped_m|/√(JᵀP J), with both J over the noise level and P the step's
    power.
    """
    C = model.layout.channels
    step = 0.0
    power = 0.0
    for m in range(C):
        if state.slope[m] != 0.0:
            slope = state.slope[m] / state.level[m]
            step += slope * state.stepped[m]
            for j in range(C):
                power += slope * model.step_power[m, j] * state.slope[j] / state.level[j]
    state.statistics.step[i] = abs(step) / math.sqrt(power) if counts and power > 0.0 else 0.0


@part()
def _look_for_offset(i, counts, model, state):
    """Compute the likelihood ratio of an offset in channel i; h is the offset's effect on the
    scaled innovations. Unless ``counts``, the row adds nothing.

    Numerator and denominator of z (module) are forgotten by λ and λ². From the numerator the offset
    of healthy drives times the weight is subtracted; a sample counts with at most ``heaviest``.
    """
    C = model.layout.channels
    top = 0.0
    weight = 0.0
    for j in range(C):
        effect = 0.0
        for m in range(C):
            effect += model.settled_gain[m, j] * state.slope[m]
        state.effect[j] = effect / state.level[j]
    for m in range(C):
        top += state.effect[m] * state.clipped_score[m]
        inner = 0.0
        for j in range(C):
            inner += model.precision[m, j] * state.effect[j]
        weight += state.effect[m] * inner
    share = min(model.heaviest[i] / weight, 1.0) if counts and weight > 0.0 else 0.0
    top = share * top
    weight = share * weight
    keep = 1.0 - model.settings.forget_offset
    above = keep * state.ratio_sum[i] + top - model.healthy[i] * weight
    below = keep * keep * state.ratio_weight[i] + weight
    state.ratio_sum[i] = above
    state.ratio_weight[i] = below
    state.statistics.offset[i] = abs(above) / math.sqrt(below) if below > 0.0 else 0.0


@part()
def _look_for_offsets(model, state):
    """Compute the statistics of steps and offsets of each channel.

    The largest offset statistic is limited to `CAP` times its limit by scaling the numerators of
    all channels.
    """
    C = model.layout.channels
    offset_statistics = state.statistics.offset
    highest = 0.0
    for i in range(C):
        _slope(i, model, state)
        counts = (
            state.rows[0] >= model.layout.settling
            and model.modelled[i] == 1
            and state.gap[i] == 0.0
        )
        _look_for_step(i, counts, model, state)
        _look_for_offset(i, counts, model, state)
        highest = max(highest, offset_statistics[i] * model.inverse.offset[i])
    if highest > CAP:  # all alike, so that they still compare with each other
        for i in range(C):
            offset_statistics[i] *= CAP / highest
            state.ratio_sum[i] *= CAP / highest


@part()
def _look_at_values(is_standing, model, state):
    """Compute the statistics of runs and shares of equal samples, range and slip; returns the
    number of wheels that are slower than expected by more than `SLIPPING`.

    Nothing is frozen where the car stands or a channel may rest. The slip of a wheel is 1 - x/x̂,
    with x̂ the speed that its relation expects.
    """
    slow = 0
    statistics = state.statistics
    fast = abs(_value(state, model.layout.speed)) > model.settings.least_speed
    for i in range(model.layout.channels):
        quiet = is_standing or model.rests[i] == 1
        statistics.run[i] = 0.0 if quiet else state.run[i]
        statistics.share[i] = 0.0 if quiet else state.share[i]
        statistics.domain[i] = abs(state.x[i]) / model.largest[i]
        statistics.slip[i] = 0.0
        expected = state.x[i] - state.y[i]
        if model.wheel[i] == 1 and state.gap[i] <= 0.0 and fast and expected != 0.0:
            slip = 1.0 - state.x[i] / expected
            statistics.slip[i] = abs(slip)
            slow += 1 if slip > SLIPPING else 0
    return slow


@part()
def _look_at_relations(is_standing, model, state):
    """Compute the statistics of relations, the means of their residuals.

    The mean of du/dt is (u - ū) f/((1 - f) τ), with ū of the same forgetting f.

    The short means of both sides give sign and unit (`_relation_kind`); the long mean of the
    residual is the statistic, at most `CAP` times its limit. While any channel is missing, the
    means of targets and residuals stay.
    """
    u = _value(state, model.layout.speed)
    step = model.settings.step
    short = model.settings.forget_short
    longer = model.settings.forget_relation
    state.mean_ax[0] += model.settings.forget_ax * (
        _value(state, model.layout.ax) - state.mean_ax[0]
    )
    complete = True
    for i in range(model.layout.channels):
        complete = complete and state.gap[i] <= 0.0
    for t, forget in enumerate((short, longer)):
        if state.rows[0] == 0.0:
            state.mean_speed[t] = u
        state.mean_speed[t] += forget * (u - state.mean_speed[t])
    for j in range(model.layout.relations):
        target = state.x[model.target[j]]
        left = target
        small = 0.0
        for f in range(N_FEATURES):
            term = model.average[j, f] * state.feature[f]
            left -= term
            small += term if f >= FIRST_SMALL else 0.0
        if is_standing:
            left = 0.0
            small = 0.0
        gain = 0.0 if is_standing else model.rate_gain[j]
        if complete:
            # a fault of r or ay is no sign or unit of ax
            state.left[j] += short * (left + small - state.left[j])
            state.smooth[j] += short * (target - state.smooth[j])
        observed = state.smooth[j]
        expected = (
            observed
            - state.left[j]
            + gain * (u - state.mean_speed[0]) * short / ((1.0 - short) * step)
        )
        state.product[j] += longer * (observed * expected - state.product[j])
        state.expected_power[j] += longer * (expected * expected - state.expected_power[j])
        state.observed_power[j] += longer * (observed * observed - state.observed_power[j])
        if complete:
            state.average[j] += longer * (left - state.average[j])
        change = gain * (u - state.mean_speed[1]) * longer / ((1.0 - longer) * step)
        size = abs(state.average[j] - change)
        roof = CAP * model.limits.relation[j]
        if size > roof:
            state.average[j] = change + (state.average[j] - change) * roof / size
            size = roof
        state.statistics.relation[j] = size


@part()
def _find_reason(slow, model, state):
    """Find the statistic beyond its limit whose reason has the highest priority.

    Returns the kind of the reason (`FREE`: there is none), the column of the accused channel, that
    of its partner (-1: none), and the largest statistic over its limit.
    """
    values = state.statistics.all_values
    highest = 0.0
    weightiest = -1.0
    best = -1
    for m in range(len(values)):
        over = values[m] * model.inverse.all_values[m]
        highest = max(highest, over)
        if over >= 1.0:
            weight = model.priority[m] + 0.5 * over / (1.0 + over)
            if weight > weightiest:
                weightiest = weight
                best = m
    if best < 0:
        return FREE, 0, -1, highest
    kind = model.kind[best]
    channel = model.accused[best]
    partner = model.partner[best]
    # likelihood ratios of the same form compare with each other as they are
    if kind in (
        JUMP,
        OFFSET,
    ):
        C = model.layout.channels
        likeliest = -1.0
        for i in range(C):
            ratio = state.ratio[i] if best < C else values[best // C * C + i]
            if ratio > likeliest:
                likeliest = ratio
                channel = i
    if kind == LOCKED:
        kind = _wheel(channel, slow, state)
    elif kind in (OFFSET, CONTRADICTION):
        turned, culprit, against = _contradiction(model, state)
        if turned != FREE:
            kind = turned
            channel = culprit
            partner = against
    return kind, channel, partner, highest


@part()
def _decide(missing_channel, slow, model, state):
    """Status of the row, code of its reason, and the largest statistic over its limit.

    Invalid are frozen and repeated samples, wrong signs and units, lost wheels, spin, gaps beyond
    the bridged time, and any statistic but the range from `INVALID` times its limit on; other
    findings degrade. A missing channel overrides spin, and spin the statistics. A flag is held for
    ``hold`` rows in which all statistics stay below `CLEAR`.
    """
    layout = model.layout
    settings = model.settings
    kind, channel, partner, highest = _find_reason(slow, model, state)
    level = 0.0
    if kind != FREE:
        certain = kind in (FROZEN, HELD, SIGN, UNIT, DROPOUT)
        level = 2.0 if certain or (highest >= INVALID and kind != OUTSIDE) else 1.0
    r = _value(state, layout.yaw_rate)
    spins = (
        abs(r) > settings.spin_yaw_rate
        and abs(r * _value(state, layout.speed)) > settings.spin_turning
    )
    state.spinning[0] = (
        state.spinning[0] + 1.0 if spins and state.since_jump[0] > 5.0 * layout.spinning else 0.0
    )
    if state.spinning[0] > layout.spinning:
        level = 2.0
        kind = SPIN
        channel = layout.yaw_rate
        partner = -1
    if missing_channel >= 0:
        level = (
            2.0
            if state.gap[missing_channel] - model.gap_limit[missing_channel] > layout.bridged
            else max(level, 1.0)
        )
        kind = MISSING
        channel = missing_channel
        partner = -1
    reason = 0.0
    if level > 0.0:
        reason = (
            kind * 10000.0
            + model.code[channel] * 100.0
            + (model.code[partner] if partner >= 0 else 0)
        )
        state.hold[0] = float(layout.hold)
        state.reason[0] = reason
        state.status[0] = level
    elif state.hold[0] > 0.0:
        state.hold[0] = state.hold[0] - 1.0 if highest < CLEAR else float(layout.hold)
        level = state.status[0]
        reason = state.reason[0]
    return level, reason, highest


@part()
def _wheel(channel, slow, state):
    """Kind of the reason for a wheel whose slip is beyond its limit: `LOCKED`, `DROPOUT` (the
    signal is lost), or `CONTRADICTION` where the wheel is not that slow.
    """
    if state.x[channel] >= (1.0 - LOST) * (state.x[channel] - state.y[channel]):
        return CONTRADICTION
    return LOCKED if state.mean_ax[0] < -BRAKING or slow > 1 else DROPOUT


@part()
def _relation_kind(j, model, state):
    """State of relation j in the last second: `FREE` if it holds, `SIGN` or `UNIT` if it fails by
    far, -1 if the signals are too small or it is neither.
    """
    product = state.product[j]
    expected = state.expected_power[j]
    observed_power = state.observed_power[j]
    roof = model.limits.relation[j]
    if max(expected, observed_power) < roof * roof:
        return -1
    if expected > LARGER * LARGER * observed_power or observed_power > LARGER * LARGER * expected:
        return UNIT
    if product < REVERSED * math.sqrt(expected * observed_power):
        return SIGN
    return FREE if product > HOLDS * math.sqrt(expected * observed_power) else -1


@part()
def _contradiction(model, state):
    """Kind, channel and partner (columns; -1: none) of relations that fail by far; `FREE` where
    none does.

    The channel is the one that is in all relations that fail and in none that holds.

    Channels that only ever occur together in failing relations contradict each other; which of them
    is wrong cannot be decided.
    """
    suspects = 0
    culprit = -1
    kind = FREE
    failed = -1
    for j in range(model.layout.relations):
        relation_kind = _relation_kind(j, model, state)
        if relation_kind > FREE:
            failed = j if failed < 0 else failed
            kind = relation_kind if kind in (FREE, relation_kind) else UNIT
    if failed < 0:
        return FREE, 0, -1
    for i in range(model.layout.channels):
        explains = True
        for j in range(model.layout.relations):
            relation_kind = _relation_kind(j, model, state)
            involved = model.involved[j, i]
            if (relation_kind > FREE and involved == 0) or (
                relation_kind == FREE and involved == 1
            ):
                explains = False
        if explains:
            suspects = suspects + 1
            culprit = i
    if suspects == 1:
        return kind, culprit, -1
    return CONTRADICTION, model.target[failed], model.versus[failed]


@part()
def _remember(model, state):
    """Shift the samples that the next row is predicted from."""
    for i in range(model.layout.channels):
        for lag in range(model.layout.order - 1, 0, -1):
            state.past_y[lag, i] = state.past_y[lag - 1, i]
        state.past_y[0, i] = state.y[i]
    state.rows[0] += 1.0
