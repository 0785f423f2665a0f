"""The recursion behind `vehest.trust.health`, compiled: statistics of each row against their limits, status and reason.

With φ(x) features of yaw rate and speed, channels x become y = x - W φ(x), of which an autoregression predicts the next sample; ε is what
it errs by, in units of the noise at that speed, and S its covariance. A fault that adds b to channel i moves y by J b, J = ∂y/∂xᵢ, and the
innovations by h b; one that multiplies it by s moves them by (s - 1)/s of what the channel, as it is measured, puts into them; one that
makes it late moves them by what a low-pass would:

    offset   h = J - Σ_l A_l J           scale   h_k = J x_k - Σ_l A_l J x_{k-l}           delay   the same of x̄ - x, x̄ low-passed

x_k being taken as predicted, which keeps the noise in ε out of h. Each form is looked for by its likelihood ratio over exponentially
forgotten samples, z = Σ λʲ hᵀS⁻¹ε / √(Σ λ²ʲ hᵀS⁻¹h), which is N(0, 1) while all is well (Willsky & Jones, A generalized likelihood ratio
approach to the detection and estimation of jumps in linear systems, IEEE Trans. Automatic Control 21 (1), 1976; windows replaced by
forgetting). Innovations count with at most `CLIP` deviations in it, and no sample with more than its share, so that a kerb is no offset.

The other statistics: jumps, absolute and against the energy of the last half second; a step that began p samples ago (the same likelihood
ratio, its onset included); energy of the innovations, and its inverse; runs of equal samples and their share; the range; slip of a wheel;
relations that hold on average.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from vehest.estimators.kernels.compiling import entry, part

BELIEVED = 1000.0  # times the largest size in training, beyond which a value is none
CLIP = 4.0  # standard deviations
STEP_CLIP = 8.0  # the same for steps
CALM = 0.3  # of the mean energy, that a calm stretch counts as at least
CAP = 2.0  # times its limit, beyond which a statistic remembers no more, so that it is down again soon after a fault
INVALID = 1.5  # times its limit, from which on an estimate is invalid and not only degraded
CLEAR = 0.95  # times its limit, below which a statistic has to stay
BRAKING = 2.0  # m/s², beyond which a wheel that stands still is locked rather than lost
SLIPPING = 0.3  # share by which a second wheel is slow, which makes both locked
LOST = 0.5  # share by which a wheel is slow that is locked or lost
REVERSED, HOLDS = -0.5, 0.7  # correlations below which a relation is one of the wrong sign, above which it holds
LARGER = 2.5  # factor, either way, that makes a relation one of the wrong unit

INSTANT_FEATURES = 6  # that relations which hold for each sample may use
N_FEATURES = 12
N_LEVELS = 5  # speeds at which the noise is known
N_FORMS = 3  # offset, scale, delay

FREE, MISSING, FROZEN, HELD, JUMP, NOISE, SMOOTH, OFFSET, SCALE, SIGN, UNIT, CONTRADICTION, OUTSIDE, SPIN, LOCKED, DROPOUT, LATE = range(17)
"""Kinds of reasons."""


class Layout(NamedTuple):
    """Whole numbers that ``sizes`` begins with: how many there are of what, columns (-1: none), and rows that times come to."""

    channels: int
    order: int
    relations: int
    energies: int
    ratios: int
    averages: int
    yaw_rate: int
    speed: int
    ay: int
    ax: int
    hold: int
    bridged: int
    spinning: int
    settling: int

    @property
    def n_statistics(self) -> int:
        """How many statistics there are."""
        return self.channels * (8 + self.energies + N_FORMS * self.ratios) + self.relations * self.averages


N_CHANNELS, N_LAGS, N_RELATIONS, N_ENERGIES, N_RATIOS, N_AVERAGES, COLUMN_R, COLUMN_U, COLUMN_AY, COLUMN_AX = range(10)
ROWS_HOLD, ROWS_BRIDGED, ROWS_SPIN, ROWS_SETTLE, N_STATISTICS = range(10, 15)
"""Where ``sizes`` holds what `Layout` lists, and the number of statistics."""

PLACES = 15
"""Where ``sizes`` begins to say at which place each table and each part of the state begins."""

(
    AT_CONSTANT,
    AT_LAGS,
    AT_PRECISION,
    AT_DEVIATION,
    AT_INSTANT,
    AT_AVERAGE,
    AT_RATE_GAIN,
    AT_USUAL,
    AT_LARGEST,
    AT_SPEEDS,
    AT_LEVELS,
    AT_SETTLED_GAIN,
    AT_STEPS,
    AT_STEP_POWER,
    AT_HEALTHY,
    AT_HEAVIEST,
    AT_FORGET_ENERGY,
    AT_FORGET_RATIO,
    AT_FORGET_AVERAGE,
    AT_LIMITS,
    AT_INVERSE,
    AT_PRIORITY,
    AT_SETTINGS,
    AT_STOPS,
) = range(PLACES + 0, PLACES + 24)
"""Tables in ``numbers``, with C channels, p lags, R relations, F features, K statistics and L speeds: c (C), A of channel m on q (p, m, q),
S⁻¹ (C, C), deviation (C), W (C, F), average relations (R, F), their gain of du/dt (R), usual and largest value (C), speeds (L), noise at
them (L, C), 1 - Σ A_l of m on q (m, q), weight of an innovation some samples ago on a step in m (p, m, q) and their power (C, C), what the
likelihood ratios find while all is well and what one sample may weigh in them (form, C), forgetting of energy, ratios and relations,
limits, one over them, which of several says what is wrong (K), settings: speed, yaw rate and ay of standstill, step, yaw rate and u r of a
spin, forgetting of the share of equal samples, of ax, and of the low-pass that stands for a delay; lower and upper stop, between which
alone a channel is expected to move (2, C)."""

(AT_MODELLED, AT_RESTS, AT_GAP_LIMIT, AT_WHEEL, AT_CODE, AT_TARGET, AT_KIND, AT_ACCUSED, AT_PARTNER, AT_INVOLVED, AT_VERSUS) = range(
    PLACES + 24, PLACES + 35
)
"""Tables in ``sizes`` itself: of channels whether they are modelled, may rest, longest gap, whether a wheel, number in a code; column of a
relation's target; of statistics kind of reason, column that it accuses, column of the partner (-1: none); of relations whether they
involve a channel (R, C; 2: by a small term, which breaks them where it is wrong by far and is not proven right where they hold)."""

(
    AT_FLAGS,
    AT_LAST,
    AT_GAP,
    AT_RUN,
    AT_SHARE,
    AT_LOW_PASSED,
    AT_PAST,
    AT_RESIDUALS,
    AT_INNOVATIONS,
    AT_ENERGY,
    AT_RATIOS,
    AT_AVERAGES,
    AT_MEAN_SPEED,
    AT_LEFT,
    AT_SMOOTH,
    AT_GAINS,
    AT_X,
    AT_Y,
    AT_ERROR,
    AT_SCALED,
    AT_CLIPPED,
    AT_SCORE,
    AT_CLIPPED_SCORE,
    AT_STEPPED,
    AT_LATE,
    AT_LEVEL,
    AT_FEATURES,
    AT_SLOPE,
    AT_EFFECT,
    AT_STATISTICS,
) = range(PLACES + 35, PLACES + 65)
"""Parts of ``state``. What lasts: flags (rows seen, rows until cleared, last reason, last status, rows of spin, rows since the yaw rate
jumped, mean ax, unused), last value, rows without a sample (below zero while predictions settle again), run and share of equal samples,
low-passed value (C each), x and its low-pass less x (2, p, C), y and innovations (p, C), energies (C, E), sums of the likelihood ratios
(C, G, 6: Σ hᵀS⁻¹ε and Σ hᵀS⁻¹h of each form), means of relations (R, A), mean speed (A), short means of what relations leave and of
their targets (R), means of the products of these with what is expected of them and of both squares (R, 3). What is used within
a row: x, y, ε, ε over its level, the same clipped, S⁻¹ε, the same of clipped ones, sum over a step, low-pass less x, level (C each),
features with their derivatives by r and by u (3, F), J, h (C), statistics (K)."""


def table_sizes(layout: Layout) -> list[int]:
    """How many numbers each table in ``numbers`` has."""
    C, p, R, K = layout.channels, layout.order, layout.relations, layout.n_statistics
    forms = [N_FORMS * C, N_FORMS * C, layout.energies, layout.ratios, layout.averages]
    described = [C, p * C * C, C * C, C, C * N_FEATURES, R * N_FEATURES, R, C, C, N_LEVELS, N_LEVELS * C, C * C, p * C * C, C * C]
    return [*described, *forms, K, K, K, 9, 2 * C]


def index_sizes(layout: Layout) -> list[int]:
    """How many numbers each table in ``sizes`` has."""
    return [*([layout.channels] * 5), layout.relations, *([layout.n_statistics] * 3), layout.relations * layout.channels, layout.relations]


def memory_sizes(layout: Layout) -> list[int]:
    """How many numbers each part of the state has."""
    C, p = layout.channels, layout.order
    lasting = [8, *([C] * 5), 2 * p * C, p * C, p * C, C * layout.energies, C * layout.ratios * 2 * N_FORMS]
    relations = [layout.relations * layout.averages, layout.averages, layout.relations, layout.relations, 3 * layout.relations]
    return [*lasting, *relations, *([C] * 10), 3 * N_FEATURES, C, C, layout.n_statistics]


def places(layout: Layout) -> list[int]:
    """Where each table and each part of the state begins."""

    def begins(sizes: list[int], first: int = 0) -> list[int]:
        return [first + sum(sizes[:at]) for at in range(len(sizes))]

    tables, indices, memory = table_sizes(layout), index_sizes(layout), memory_sizes(layout)
    return [*begins(tables), *begins(indices, PLACES + len(tables) + len(indices) + len(memory)), *begins(memory)]


@entry(nogil=True)
def health_kernel(rows, measured, numbers, sizes, state, out, statistics):  # type: ignore[no-untyped-def]
    """Judge row after row.

    Args:
        rows: (T, C), as received.
        measured: what of them is believed, (T, C).
        numbers, sizes: of `HealthModel.packed`.
        state: of `HealthModel.start`, changed in place.
        out: output, (3, T): status, code of the reason, largest statistic over its limit.
        statistics: output, (T, K), or (0, K) where they are not wanted.
    """
    for k in range(rows.shape[0]):
        absent = _receive(k, rows, measured, sizes, numbers, state)
        still = _describe(sizes, numbers, state)
        _predict(sizes, numbers, state)
        at = _look_at_innovations(sizes, numbers, state)
        at = _look_for_forms(at, sizes, numbers, state)
        slow, at = _look_at_values(at, still, sizes, numbers, state)
        _look_at_relations(at, still, sizes, numbers, state)
        _decide(k, out, absent, slow, sizes, numbers, state)
        if statistics.shape[0] > 0:
            for m in range(sizes[N_STATISTICS]):
                statistics[k, m] = state[sizes[AT_STATISTICS] + m]
        _remember(sizes, state)


@part()
def _receive(k, rows, measured, sizes, numbers, state):  # type: ignore[no-untyped-def]
    """Take a row; returns the channel that has been missing for longest beyond its limit, -1 if none has.

    The last value stands for one that was not measured. A channel that is back has p rows to settle in.
    """
    C, p = sizes[N_CHANNELS], sizes[N_LAGS]
    at_flags, at_last, at_usual, at_low_passed = sizes[AT_FLAGS], sizes[AT_LAST], sizes[AT_USUAL], sizes[AT_LOW_PASSED]
    at_run, at_share, at_settings, at_gap = sizes[AT_RUN], sizes[AT_SHARE], sizes[AT_SETTINGS], sizes[AT_GAP]
    at_gap_limit, at_x, at_largest, at_stops = sizes[AT_GAP_LIMIT], sizes[AT_X], sizes[AT_LARGEST], sizes[AT_STOPS]
    first, longest, absent = state[at_flags] == 0.0, 0.0, -1
    for i in range(C):
        value = rows[k, i]
        known = measured[k, i] and abs(value) <= BELIEVED * numbers[at_largest + i]  # false for NaN
        if first:
            state[at_last + i] = value if known else numbers[at_usual + i]
            state[at_low_passed + i] = state[at_last + i]
        if known:
            free = numbers[at_stops + i] < value < numbers[at_stops + C + i]
            same = free and value == state[at_last + i] and not first
            state[at_run + i] = state[at_run + i] + 1.0 if same else 0.0
            state[at_share + i] += numbers[at_settings + 6] * ((1.0 if same else 0.0) - state[at_share + i])
            state[at_last + i] = value
            state[at_gap + i] = -float(p) if state[at_gap + i] > 0.0 else min(state[at_gap + i] + 1.0, 0.0)
        else:
            state[at_gap + i] = max(state[at_gap + i], 0.0) + 1.0
            beyond = state[at_gap + i] - sizes[at_gap_limit + i]
            if beyond > longest:
                longest, absent = beyond, i
        state[at_x + i] = state[at_last + i]
    return absent


@part()
def _value(state, sizes, column):  # type: ignore[no-untyped-def]
    at_x = sizes[AT_X]
    return state[at_x + column] if column >= 0 else 0.0


@part()
def _describe(sizes, numbers, state):  # type: ignore[no-untyped-def]
    """Features with their derivatives, y = x - W φ(x) and the noise at this speed; returns whether the car stands."""
    C, to_r, to_u, to_ay, to_ax = sizes[N_CHANNELS], sizes[COLUMN_R], sizes[COLUMN_U], sizes[COLUMN_AY], sizes[COLUMN_AX]
    at_settings, at_features, at_speeds, at_level = sizes[AT_SETTINGS], sizes[AT_FEATURES], sizes[AT_SPEEDS], sizes[AT_LEVEL]
    at_levels, at_x, at_instant, at_y = sizes[AT_LEVELS], sizes[AT_X], sizes[AT_INSTANT], sizes[AT_Y]
    r, u, ay, ax = _value(state, sizes, to_r), _value(state, sizes, to_u), _value(state, sizes, to_ay), _value(state, sizes, to_ax)
    least = numbers[at_settings]
    w, turning = max(abs(u), least), u * r
    values = (1.0, r, u, turning, 0.01 * turning * turning * turning, r / w)
    for f in range(INSTANT_FEATURES):
        state[at_features + f] = values[f]
    others = (ay, ay / (w * w), 0.01 * ay * ay * ay, r * r, u * u, ax)
    for f in range(N_FEATURES - INSTANT_FEATURES):
        state[at_features + INSTANT_FEATURES + f] = others[f]
    bent = 0.03 * turning * turning
    by_r, by_u = (0.0, 1.0, 0.0, u, bent * u, 1.0 / w), (0.0, 0.0, 1.0, r, bent * r, -r / (u * abs(u)) if abs(u) > least else 0.0)
    for f in range(INSTANT_FEATURES):
        state[at_features + N_FEATURES + f], state[at_features + 2 * N_FEATURES + f] = by_r[f], by_u[f]
    at, share = 0, 0.0
    while at < N_LEVELS - 2 and abs(u) > numbers[at_speeds + at + 1]:
        at += 1
    if numbers[at_speeds + at + 1] > numbers[at_speeds + at]:
        share = min(max((abs(u) - numbers[at_speeds + at]) / (numbers[at_speeds + at + 1] - numbers[at_speeds + at]), 0.0), 1.0)
    for i in range(C):
        state[at_level + i] = (1.0 - share) * numbers[at_levels + at * C + i] + share * numbers[at_levels + (at + 1) * C + i]
        total = state[at_x + i]
        for f in range(INSTANT_FEATURES):
            total -= numbers[at_instant + i * N_FEATURES + f] * state[at_features + f]
        state[at_y + i] = total
    return abs(u) < least and abs(r) < numbers[at_settings + 1] and abs(ay) < numbers[at_settings + 2]


@part()
def _usable(i, sizes, numbers, state):  # type: ignore[no-untyped-def]
    """Whether channel i was measured, and so was what its relation is made of, for long enough to be predicted."""
    to_r, to_u = sizes[COLUMN_R], sizes[COLUMN_U]
    at_flags, at_modelled, at_gap, at_instant = sizes[AT_FLAGS], sizes[AT_MODELLED], sizes[AT_GAP], sizes[AT_INSTANT]
    at_features = sizes[AT_FEATURES]
    if state[at_flags] < sizes[ROWS_SETTLE] or sizes[at_modelled + i] == 0 or state[at_gap + i] != 0.0:
        return False
    for f in range(1, INSTANT_FEATURES):
        if numbers[at_instant + i * N_FEATURES + f] != 0.0:
            if to_r >= 0 and state[at_features + N_FEATURES + f] != 0.0 and state[at_gap + to_r] != 0.0:
                return False
            if to_u >= 0 and state[at_features + 2 * N_FEATURES + f] != 0.0 and state[at_gap + to_u] != 0.0:
                return False
    return True


@part()
def _predict(sizes, numbers, state):  # type: ignore[no-untyped-def]
    """Innovations, scaled and clipped, and their scores S⁻¹ε; zero where nothing can be said."""
    C, p = sizes[N_CHANNELS], sizes[N_LAGS]
    at_error, at_constant, at_lags, at_residuals = sizes[AT_ERROR], sizes[AT_CONSTANT], sizes[AT_LAGS], sizes[AT_RESIDUALS]
    at_innovations, at_y, at_gap, at_flags = sizes[AT_INNOVATIONS], sizes[AT_Y], sizes[AT_GAP], sizes[AT_FLAGS]
    at_level, at_deviation, at_scaled, at_clipped = sizes[AT_LEVEL], sizes[AT_DEVIATION], sizes[AT_SCALED], sizes[AT_CLIPPED]
    at_late, at_low_passed, at_x, at_settings = sizes[AT_LATE], sizes[AT_LOW_PASSED], sizes[AT_X], sizes[AT_SETTINGS]
    at_precision, at_steps, at_score, at_clipped_score = sizes[AT_PRECISION], sizes[AT_STEPS], sizes[AT_SCORE], sizes[AT_CLIPPED_SCORE]
    at_stepped = sizes[AT_STEPPED]
    for i in range(C):
        state[at_error + i] = numbers[at_constant + i]
    for lag in range(p):
        for m in range(C):
            for i in range(C):
                state[at_error + i] += numbers[at_lags + (lag * C + m) * C + i] * state[at_residuals + lag * C + m]
    for lag in range(p - 1, 0, -1):
        for i in range(C):
            state[at_innovations + lag * C + i] = state[at_innovations + (lag - 1) * C + i]
    for i in range(C):
        if _usable(i, sizes, numbers, state):
            state[at_error + i] = state[at_y + i] - state[at_error + i]
        else:
            if state[at_gap + i] > 0.0 and state[at_flags] >= p:
                state[at_y + i] = state[at_error + i]
            state[at_error + i] = 0.0
        own, deviation = state[at_error + i] / state[at_level + i], numbers[at_deviation + i]
        state[at_scaled + i] = own
        state[at_clipped + i] = min(max(own, -CLIP * deviation), CLIP * deviation)
        state[at_innovations + 0 * C + i] = min(max(own, -STEP_CLIP * deviation), STEP_CLIP * deviation)
        state[at_late + i] = state[at_low_passed + i] - (state[at_x + i] - state[at_error + i])
        state[at_low_passed + i] += numbers[at_settings + 8] * (state[at_x + i] - state[at_low_passed + i])
    for i in range(C):
        score, clipped, stepped = 0.0, 0.0, 0.0
        for j in range(C):
            score += numbers[at_precision + i * C + j] * state[at_scaled + j]
            clipped += numbers[at_precision + i * C + j] * state[at_clipped + j]
        for lag in range(p):
            for j in range(C):
                stepped += numbers[at_steps + (lag * C + i) * C + j] * state[at_innovations + lag * C + j]
        state[at_score + i], state[at_clipped_score + i], state[at_stepped + i] = score, clipped, stepped


@part()
def _look_at_innovations(sizes, numbers, state):  # type: ignore[no-untyped-def]
    """Jumps, jumps out of calm, and energy, high and low; returns the next statistic."""
    C, E, to_r = sizes[N_CHANNELS], sizes[N_ENERGIES], sizes[COLUMN_R]
    at_score, at_precision, at_modelled, at_statistics = sizes[AT_SCORE], sizes[AT_PRECISION], sizes[AT_MODELLED], sizes[AT_STATISTICS]
    at_energy, at_flags, at_limits, at_scaled = sizes[AT_ENERGY], sizes[AT_FLAGS], sizes[AT_LIMITS], sizes[AT_SCALED]
    at_deviation, at_forget_energy = sizes[AT_DEVIATION], sizes[AT_FORGET_ENERGY]
    for i in range(C):
        z = abs(state[at_score + i]) / math.sqrt(numbers[at_precision + i * C + i]) if sizes[at_modelled + i] == 1 else 0.0
        state[at_statistics + i] = z
        state[at_statistics + C + i] = z / math.sqrt(CALM + state[at_energy + i * E + 1])
        if i == to_r:
            state[at_flags + 5] = 0.0 if z > numbers[at_limits + i] else state[at_flags + 5] + 1.0
        normed = state[at_scaled + i] / numbers[at_deviation + i]
        for e in range(E):
            at = 2 * C + i * E + e
            roof = CAP * numbers[at_limits + at]
            own = state[at_energy + i * E + e] + numbers[at_forget_energy + e] * (normed * normed - state[at_energy + i * E + e])
            own = min(own, roof * roof)
            state[at_energy + i * E + e] = own
            state[at_statistics + at] = math.sqrt(own)
        slowest = state[at_energy + i * E + E - 1]
        state[at_statistics + 2 * C + C * E + i] = 1.0 / math.sqrt(slowest + 1e-12) if sizes[at_modelled + i] == 1 else 0.0
    return C * (3 + E)


@part()
def _slope(i, sizes, numbers, state):  # type: ignore[no-untyped-def]
    """J = ∂y/∂xᵢ."""
    C, to_r, to_u = sizes[N_CHANNELS], sizes[COLUMN_R], sizes[COLUMN_U]
    at_instant, at_features, at_slope = sizes[AT_INSTANT], sizes[AT_FEATURES], sizes[AT_SLOPE]
    row = 1 if i == to_r else 2
    for m in range(C):
        total = 1.0 if m == i else 0.0
        if i in (to_r, to_u):
            for f in range(1, INSTANT_FEATURES):
                total -= numbers[at_instant + m * N_FEATURES + f] * state[at_features + row * N_FEATURES + f]
        state[at_slope + m] = total


@part()
def _effect(i, form, sizes, numbers, state):  # type: ignore[no-untyped-def]
    """h: what one unit of a form of fault in channel i does to the scaled innovations."""
    C, p = sizes[N_CHANNELS], sizes[N_LAGS]
    at_effect, at_x, at_error, at_late = sizes[AT_EFFECT], sizes[AT_X], sizes[AT_ERROR], sizes[AT_LATE]
    at_slope, at_settled_gain, at_past, at_lags = sizes[AT_SLOPE], sizes[AT_SETTLED_GAIN], sizes[AT_PAST], sizes[AT_LAGS]
    at_level = sizes[AT_LEVEL]
    for j in range(C):
        state[at_effect + j] = 0.0
    now = state[at_x + i] - state[at_error + i] if form == 1 else state[at_late + i]
    for m in range(C):
        if state[at_slope + m] == 0.0:
            continue
        if form == 0 or m != i:  # what reaches other channels by relations is taken as steady
            steady = state[at_slope + m] if form == 0 else state[at_slope + m] * now
            for j in range(C):
                state[at_effect + j] += numbers[at_settled_gain + m * C + j] * steady
        else:
            state[at_effect + m] += state[at_slope + m] * now
            for lag in range(p):
                past = state[at_slope + m] * state[at_past + ((form - 1) * p + lag) * C + i]
                for j in range(C):
                    state[at_effect + j] -= numbers[at_lags + (lag * C + m) * C + j] * past
    for j in range(C):
        state[at_effect + j] /= state[at_level + j]


@part()
def _look_for_forms(at, sizes, numbers, state):  # type: ignore[no-untyped-def]
    """Steps, offsets, scales and delays of each channel; returns the next statistic."""
    C, G = sizes[N_CHANNELS], sizes[N_RATIOS]
    at_flags, at_modelled, at_gap, at_slope = sizes[AT_FLAGS], sizes[AT_MODELLED], sizes[AT_GAP], sizes[AT_SLOPE]
    at_level, at_stepped, at_step_power, at_statistics = sizes[AT_LEVEL], sizes[AT_STEPPED], sizes[AT_STEP_POWER], sizes[AT_STATISTICS]
    at_effect, at_clipped_score, at_precision = sizes[AT_EFFECT], sizes[AT_CLIPPED_SCORE], sizes[AT_PRECISION]
    at_heaviest, at_healthy, at_forget_ratio, at_inverse = sizes[AT_HEAVIEST], sizes[AT_HEALTHY], sizes[AT_FORGET_RATIO], sizes[AT_INVERSE]
    at_ratios = sizes[AT_RATIOS]
    for i in range(C):
        _slope(i, sizes, numbers, state)
        counts = state[at_flags] >= sizes[ROWS_SETTLE] and sizes[at_modelled + i] == 1 and state[at_gap + i] == 0.0
        step, power = 0.0, 0.0
        for m in range(C):
            if state[at_slope + m] != 0.0:
                own = state[at_slope + m] / state[at_level + m]
                step += own * state[at_stepped + m]
                for j in range(C):
                    power += own * numbers[at_step_power + m * C + j] * state[at_slope + j] / state[at_level + j]
        state[at_statistics + at + i] = abs(step) / math.sqrt(power) if counts and power > 0.0 else 0.0
        for form in range(N_FORMS):
            _effect(i, form, sizes, numbers, state)
            top, weight = 0.0, 0.0
            for m in range(C):
                top += state[at_effect + m] * state[at_clipped_score + m]
                inner = 0.0
                for j in range(C):
                    inner += numbers[at_precision + m * C + j] * state[at_effect + j]
                weight += state[at_effect + m] * inner
            share = min(numbers[at_heaviest + form * C + i] / weight, 1.0) if counts and weight > 0.0 else 0.0
            top, weight = share * top, share * weight
            top -= numbers[at_healthy + form * C + i] * weight
            for g in range(G):
                place = at + C + (form * C + i) * G + g
                keep = 1.0 - numbers[at_forget_ratio + g]
                above = keep * state[at_ratios + (i * G + g) * 2 * N_FORMS + 2 * form] + top
                below = keep * keep * state[at_ratios + (i * G + g) * 2 * N_FORMS + 2 * form + 1] + weight
                z = abs(above) / math.sqrt(below) if below > 0.0 else 0.0
                state[at_ratios + (i * G + g) * 2 * N_FORMS + 2 * form], state[at_ratios + (i * G + g) * 2 * N_FORMS + 2 * form + 1] = (
                    above,
                    below,
                )
                state[at_statistics + place] = z
    for g in range(G):
        highest = 0.0
        for n in range(N_FORMS * C):
            place = at + C + n * G + g
            highest = max(highest, state[at_statistics + place] * numbers[at_inverse + place])
        if highest > CAP:  # all alike, so that they still compare with each other
            for n in range(N_FORMS * C):
                form, i = n // C, n % C
                state[at_statistics + at + C + n * G + g] *= CAP / highest
                state[at_ratios + (i * G + g) * 2 * N_FORMS + 2 * form] *= CAP / highest
    return at + C * (1 + N_FORMS * G)


@part()
def _look_at_values(at, still, sizes, numbers, state):  # type: ignore[no-untyped-def]
    """Runs and shares of equal samples, range, slip; returns how many wheels are slow, and the next statistic."""
    C, to_u = sizes[N_CHANNELS], sizes[COLUMN_U]
    at_settings, at_rests, at_statistics, at_run = sizes[AT_SETTINGS], sizes[AT_RESTS], sizes[AT_STATISTICS], sizes[AT_RUN]
    at_share, at_x, at_largest, at_y = sizes[AT_SHARE], sizes[AT_X], sizes[AT_LARGEST], sizes[AT_Y]
    at_wheel, at_gap = sizes[AT_WHEEL], sizes[AT_GAP]
    slow = 0
    fast = abs(_value(state, sizes, to_u)) > numbers[at_settings]
    for i in range(C):
        quiet = still or sizes[at_rests + i] == 1
        state[at_statistics + at + i] = 0.0 if quiet else state[at_run + i]
        state[at_statistics + at + C + i] = 0.0 if quiet else state[at_share + i]
        state[at_statistics + at + 2 * C + i] = abs(state[at_x + i]) / numbers[at_largest + i]
        state[at_statistics + at + 3 * C + i] = 0.0
        expected = state[at_x + i] - state[at_y + i]
        if sizes[at_wheel + i] == 1 and state[at_gap + i] <= 0.0 and fast and expected != 0.0:
            slip = 1.0 - state[at_x + i] / expected
            state[at_statistics + at + 3 * C + i] = abs(slip)
            slow += 1 if slip > SLIPPING else 0
    return slow, at + 4 * C


@part()
def _look_at_relations(at, still, sizes, numbers, state):  # type: ignore[no-untyped-def]
    """Means of what relations leave; that of du/dt is (u - ū) f/((1 - f) τ), with ū of the same forgetting f."""
    C, R, A, to_u, to_ax = sizes[N_CHANNELS], sizes[N_RELATIONS], sizes[N_AVERAGES], sizes[COLUMN_U], sizes[COLUMN_AX]
    at_settings, at_flags, at_gap, at_mean_speed = sizes[AT_SETTINGS], sizes[AT_FLAGS], sizes[AT_GAP], sizes[AT_MEAN_SPEED]
    at_forget_average, at_x, at_target, at_average = sizes[AT_FORGET_AVERAGE], sizes[AT_X], sizes[AT_TARGET], sizes[AT_AVERAGE]
    at_features, at_rate_gain, at_averages, at_limits = sizes[AT_FEATURES], sizes[AT_RATE_GAIN], sizes[AT_AVERAGES], sizes[AT_LIMITS]
    at_statistics = sizes[AT_STATISTICS]
    at_left, at_smooth, at_gains = sizes[AT_LEFT], sizes[AT_SMOOTH], sizes[AT_GAINS]
    u, step = _value(state, sizes, to_u), numbers[at_settings + 3]
    short, longer = numbers[at_forget_average], numbers[at_forget_average + min(1, A - 1)]
    state[at_flags + 6] += numbers[at_settings + 7] * (_value(state, sizes, to_ax) - state[at_flags + 6])
    complete = True
    for i in range(C):
        complete = complete and state[at_gap + i] <= 0.0
    for t in range(A):
        if state[at_flags] == 0.0:
            state[at_mean_speed + t] = u
        state[at_mean_speed + t] += numbers[at_forget_average + t] * (u - state[at_mean_speed + t])
    for j in range(R):
        left = state[at_x + sizes[at_target + j]]
        for f in range(N_FEATURES):
            left -= numbers[at_average + j * N_FEATURES + f] * state[at_features + f]
        if still:
            left = 0.0
        gain = 0.0 if still else numbers[at_rate_gain + j]
        if complete:
            state[at_left + j] += short * (left - state[at_left + j])
            state[at_smooth + j] += short * (state[at_x + sizes[at_target + j]] - state[at_smooth + j])
        shown = state[at_smooth + j]
        expected = shown - state[at_left + j] + gain * (u - state[at_mean_speed]) * short / ((1.0 - short) * step)
        state[at_gains + 3 * j] += longer * (shown * expected - state[at_gains + 3 * j])
        state[at_gains + 3 * j + 1] += longer * (expected * expected - state[at_gains + 3 * j + 1])
        state[at_gains + 3 * j + 2] += longer * (shown * shown - state[at_gains + 3 * j + 2])
        for t in range(A):
            place, forget = at + j * A + t, numbers[at_forget_average + t]
            if complete:
                state[at_averages + j * A + t] += forget * (left - state[at_averages + j * A + t])
            change = gain * (u - state[at_mean_speed + t]) * forget / ((1.0 - forget) * step)
            size, roof = abs(state[at_averages + j * A + t] - change), CAP * numbers[at_limits + place]
            if size > roof:
                state[at_averages + j * A + t] = change + (state[at_averages + j * A + t] - change) * roof / size
                size = roof
            state[at_statistics + place] = size


@part()
def _decide(k, out, absent, slow, sizes, numbers, state):  # type: ignore[no-untyped-def]
    """Status and reason of row k from all statistics."""
    to_r, to_u, hold, bridged, spinning = sizes[COLUMN_R], sizes[COLUMN_U], sizes[ROWS_HOLD], sizes[ROWS_BRIDGED], sizes[ROWS_SPIN]
    at_statistics, at_inverse, at_kind, at_priority = sizes[AT_STATISTICS], sizes[AT_INVERSE], sizes[AT_KIND], sizes[AT_PRIORITY]
    at_accused, at_partner, at_settings, at_flags = sizes[AT_ACCUSED], sizes[AT_PARTNER], sizes[AT_SETTINGS], sizes[AT_FLAGS]
    at_gap, at_gap_limit, at_code = sizes[AT_GAP], sizes[AT_GAP_LIMIT], sizes[AT_CODE]
    highest, weightiest, best = 0.0, -1.0, -1
    for m in range(sizes[N_STATISTICS]):
        over = state[at_statistics + m] * numbers[at_inverse + m]
        highest = max(highest, over)
        if over >= 1.0:
            form = sizes[at_kind + m] == OFFSET or sizes[at_kind + m] == SCALE or sizes[at_kind + m] == LATE
            size = state[at_statistics + m] if form else over  # likelihood ratios compare with each other as they are
            weight = numbers[at_priority + m] + 0.5 * size / (1.0 + size)
            if weight > weightiest:
                weightiest, best = weight, m
    level, kind, channel, other = 0.0, FREE, 0, -1
    if best >= 0:
        if sizes[at_kind + best] in (OFFSET, SCALE, LATE):
            best = _likeliest(best, sizes, state)
        kind, channel, other = sizes[at_kind + best], sizes[at_accused + best], sizes[at_partner + best]
        if kind == LOCKED:
            kind = _wheel(channel, slow, sizes, state)
        elif kind in (OFFSET, SCALE, LATE, CONTRADICTION):
            turned, culprit, against = _contradiction(sizes, numbers, state)
            if turned != FREE:
                kind, channel, other = turned, culprit, against
        certain = kind in (FROZEN, HELD, SIGN, UNIT, DROPOUT)
        level = 2.0 if certain or (highest >= INVALID and kind != OUTSIDE) else 1.0
    r = _value(state, sizes, to_r)
    spins = abs(r) > numbers[at_settings + 4] and abs(r * _value(state, sizes, to_u)) > numbers[at_settings + 5]
    state[at_flags + 4] = state[at_flags + 4] + 1.0 if spins and state[at_flags + 5] > 5.0 * spinning else 0.0
    if state[at_flags + 4] > spinning:
        level, kind, channel, other = 2.0, SPIN, to_r, -1
    if absent >= 0:
        level = 2.0 if state[at_gap + absent] - sizes[at_gap_limit + absent] > bridged else max(level, 1.0)
        kind, channel, other = MISSING, absent, -1
    found = 0.0
    if level > 0.0:
        found = kind * 10000.0 + sizes[at_code + channel] * 100.0 + (sizes[at_code + other] if other >= 0 else 0)
        state[at_flags + 1], state[at_flags + 2], state[at_flags + 3] = float(hold), found, level
    elif state[at_flags + 1] > 0.0:
        state[at_flags + 1] = state[at_flags + 1] - 1.0 if highest < CLEAR else float(hold)
        level, found = state[at_flags + 3], state[at_flags + 2]
    out[0, k], out[1, k], out[2, k] = level, found, highest


@part()
def _likeliest(best, sizes, state):  # type: ignore[no-untyped-def]
    """The form and channel with the largest likelihood ratio over the time of one that was exceeded."""
    C, G, E, at_statistics = sizes[N_CHANNELS], sizes[N_RATIOS], sizes[N_ENERGIES], sizes[AT_STATISTICS]
    first = C * (4 + E)
    found = best
    for n in range(N_FORMS * C):
        m = first + n * G + (best - first) % G
        if state[at_statistics + m] > state[at_statistics + found]:
            found = m
    return found


@part()
def _wheel(channel, slow, sizes, state):  # type: ignore[no-untyped-def]
    """Whether a wheel that slips is locked, lost or neither."""
    at_x, at_y, at_flags = sizes[AT_X], sizes[AT_Y], sizes[AT_FLAGS]
    if state[at_x + channel] >= (1.0 - LOST) * (state[at_x + channel] - state[at_y + channel]):
        return CONTRADICTION
    return LOCKED if state[at_flags + 6] < -BRAKING or slow > 1 else DROPOUT


@part()
def _judged(j, sizes, numbers, state):  # type: ignore[no-untyped-def]
    """What a relation says of the last second: `FREE` if it holds, `SIGN` or `UNIT` if not by far, -1 if too little happens."""
    A, at_gains, at_limits = sizes[N_AVERAGES], sizes[AT_GAINS] + 3 * j, sizes[AT_LIMITS]
    first = sizes[N_STATISTICS] - sizes[N_RELATIONS] * A
    product, expected, shown = state[at_gains], state[at_gains + 1], state[at_gains + 2]
    roof = numbers[at_limits + first + j * A]
    if max(expected, shown) < roof * roof:
        return -1
    if expected > LARGER * LARGER * shown or shown > LARGER * LARGER * expected:
        return UNIT
    if product < REVERSED * math.sqrt(expected * shown):
        return SIGN
    return FREE if product > HOLDS * math.sqrt(expected * shown) else -1


@part()
def _contradiction(sizes, numbers, state):  # type: ignore[no-untyped-def]
    """Kind, channel and partner of what makes relations fail by far: the one channel that is in all that fail and in none that holds.

    Channels that only ever stand together in what fails contradict each other; which of them is wrong nobody can tell.
    """
    C, R = sizes[N_CHANNELS], sizes[N_RELATIONS]
    at_involved, at_target, at_versus = sizes[AT_INVOLVED], sizes[AT_TARGET], sizes[AT_VERSUS]
    suspects, culprit, kind, failed = 0, -1, FREE, -1
    for j in range(R):
        judged = _judged(j, sizes, numbers, state)
        if judged > FREE:
            failed = j if failed < 0 else failed
            kind = judged if kind in (FREE, judged) else UNIT
    if failed < 0:
        return FREE, 0, -1
    for i in range(C):
        explains = True
        for j in range(R):
            judged, involved = _judged(j, sizes, numbers, state), sizes[at_involved + j * C + i]
            if (judged > FREE and involved == 0) or (judged == FREE and involved == 1):
                explains = False
        if explains:
            suspects, culprit = suspects + 1, i
    if suspects == 1:
        return kind, culprit, -1
    return CONTRADICTION, sizes[at_target + failed], sizes[at_versus + failed]


@part()
def _remember(sizes, state):  # type: ignore[no-untyped-def]
    """Shift what the next row is predicted from."""
    C, p = sizes[N_CHANNELS], sizes[N_LAGS]
    at_residuals, at_past, at_y, at_x = sizes[AT_RESIDUALS], sizes[AT_PAST], sizes[AT_Y], sizes[AT_X]
    at_late, at_flags = sizes[AT_LATE], sizes[AT_FLAGS]
    for lag in range(p - 1, 0, -1):
        for i in range(C):
            state[at_residuals + lag * C + i] = state[at_residuals + (lag - 1) * C + i]
            state[at_past + (0 * p + lag) * C + i] = state[at_past + (0 * p + (lag - 1)) * C + i]
            state[at_past + (1 * p + lag) * C + i] = state[at_past + (1 * p + (lag - 1)) * C + i]
    for i in range(C):
        state[at_residuals + 0 * C + i], state[at_past + (0 * p + 0) * C + i], state[at_past + (1 * p + 0) * C + i] = (
            state[at_y + i],
            state[at_x + i],
            state[at_late + i],
        )
    state[at_flags] += 1.0
