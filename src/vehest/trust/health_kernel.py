"""The recursion behind `vehest.trust.health`, compiled: statistics of each row against their limits, status and reason.

With φ(x) features of yaw rate, speed and accelerations, channels x become y = x - W φ(x), of which an autoregression predicts the next
sample; ε is what it errs by, S its covariance. A fault that adds b to channel i moves y by J b, J = ∂y/∂xᵢ, and the innovations by
h b with h = (1 - Σ A_l) J; one that multiplies it by s moves them by (s - 1)/s of what the channel as it is measured puts into them:

    offset:  h = J - Σ_l A_l J              scale:  h_k = J x_k - Σ_l A_l J x_{k-l}

Each is looked for by its likelihood ratio over exponentially forgotten samples, z = Σ λʲ hᵀS⁻¹ε / √(Σ λ²ʲ hᵀS⁻¹h), which is N(0, 1)
while all is well (Willsky & Jones, A generalized likelihood ratio approach to the detection and estimation of jumps in linear systems,
IEEE Trans. Automatic Control 21 (1), 1976; windows replaced by forgetting). Innovations count with at most `CLIP` deviations in it, so
that a kerb is no offset. The other statistics stand at their place.
"""

from __future__ import annotations

import math

import numpy as np

from vehest.estimators.kernels.compiling import entry

CLIP = 4.0  # standard deviations
STEP_CLIP = 8.0  # the same for steps
CALM = 0.3  # of the mean energy, that a calm stretch counts as at least
N_LEVELS = 5  # speeds at which the noise is known
CAP = 2.0  # times its limit, beyond which a statistic remembers no more, so that it is down again soon after a fault
INVALID = 1.5  # times its limit, from which on an estimate is invalid and not only degraded
CLEAR = 0.85  # times its limit, below which a statistic has to stay
BRAKING = 2.0  # m/s², beyond which a wheel that stands still is locked rather than lost
SLIPPING = 0.3  # share by which a second wheel is slow, which makes both locked
LOST = 0.5  # share by which a wheel is slow that is locked or lost

N_FEATURES = 12
FREE, MISSING, FROZEN, HELD, JUMP, NOISE, SMOOTH, OFFSET, SCALE, SIGN, UNIT, CONTRADICTION, OUTSIDE, SPIN, LOCKED, DROPOUT, DELAY = range(17)
"""Kinds of reasons."""

SIZES = 13
"""How many whole numbers stand before the tables: C, p, P, memories of energy, likelihood ratios and relations, columns of yaw rate,
speed, ay, ax, rows until a flag is cleared, rows that are bridged, rows of a spin."""
SETTINGS = 9
"""Numbers after all else: least speed, yaw rate and ay of standstill, step, yaw rate and centripetal acceleration of a spin, forgetting of
the share of equal samples, forgetting of ax."""
MEMORY = 8
"""Numbers before the tables of the state: rows seen, rows until cleared, last reason, last status, rows of spin, rows since the yaw rate
jumped, filtered ax, unused."""


def n_statistics(n_channels: int, n_relations: int, energies: int, ratios: int, relations: int) -> int:
    """How many statistics there are."""
    return n_channels * (7 + 2 * energies + 3 * ratios) + n_relations * relations


def n_state(n_channels: int, order: int, n_relations: int, energies: int, ratios: int, relations: int) -> int:
    """How many numbers the state has."""
    return MEMORY + 5 * n_channels + 4 * order * n_channels + n_channels * (energies + 8 * ratios) + n_relations * relations + relations


@entry(nogil=True)
def health_kernel(rows, measured, numbers, sizes, state, status, reason, ratio, statistics):  # type: ignore[no-untyped-def]
    """Judge row after row.

    Args:
        rows: (T, C), as received.
        measured: what of them is believed, (T, C).
        numbers, sizes: of `HealthModel.packed`.
        state: of `HealthModel.start`, changed in place.
        status: output, 0, 1 or 2, (T,).
        reason: output, code, (T,).
        ratio: output, largest statistic over its limit, (T,).
        statistics: output, (T, K), or (0, K) where they are not wanted.
    """
    C, p, P = sizes[0], sizes[1], sizes[2]
    nE, nG, nP = sizes[3], sizes[4], sizes[5]
    at_r, at_u, at_ay, at_ax = sizes[6], sizes[7], sizes[8], sizes[9]
    hold, bridged, spinning = sizes[10], sizes[11], sizes[12]
    at = SIZES
    modelled, rests, gap_limit, wheel, code = sizes[at : at + C], sizes[at + C : at + 2 * C], sizes[at + 2 * C : at + 3 * C], sizes[at + 3 * C : at + 4 * C], sizes[at + 4 * C : at + 5 * C]
    at += 5 * C
    target, partner = sizes[at : at + P], sizes[at + P : at + 2 * P]

    K = C * (7 + 2 * nE + 3 * nG) + P * nP
    F = N_FEATURES
    o = 0
    constant = numbers[o : o + C]
    o += C
    A = numbers[o : o + p * C * C].reshape(p, C, C)  # A[l, m, q]: of channel m, l + 1 samples ago, on channel q
    o += p * C * C
    precision = numbers[o : o + C * C].reshape(C, C)
    o += C * C
    deviation = numbers[o : o + C]
    o += C
    W = numbers[o : o + C * F].reshape(C, F)
    o += C * F
    V = numbers[o : o + P * F].reshape(P, F)
    o += P * F
    rate_gain = numbers[o : o + P]
    o += P
    usual = numbers[o : o + C]
    o += C
    span = numbers[o : o + 2 * C].reshape(2, C)
    o += 2 * C
    speeds = numbers[o : o + N_LEVELS]
    o += N_LEVELS
    levels = numbers[o : o + N_LEVELS * C].reshape(N_LEVELS, C)  # noise at these speeds, in deviations
    o += N_LEVELS * C
    gain_one = numbers[o : o + C * C].reshape(C, C)  # 1 - Σ A_l, [m, q]
    o += C * C
    steps = numbers[o : o + p * C * C].reshape(p, C, C)  # [age, m, q]: weight of an innovation on a step in m that many samples ago
    o += p * C * C
    step_power = numbers[o : o + C * C].reshape(C, C)
    o += C * C
    healthy = numbers[o : o + 3 * C].reshape(3, C)  # what the likelihood ratios find while all is well
    o += 3 * C
    heaviest = numbers[o : o + 3 * C].reshape(3, C)  # that one sample may weigh in them
    o += 3 * C
    forget_e = numbers[o : o + nE]
    o += nE
    forget_g = numbers[o : o + nG]
    o += nG
    forget_p = numbers[o : o + nP]
    o += nP
    limits = numbers[o : o + K]
    o += K
    least_speed, still_r, still_ay, step, spin_r, spin_a, forget_s, forget_x, forget_d = numbers[o], numbers[o + 1], numbers[o + 2], numbers[o + 3], numbers[o + 4], numbers[o + 5], numbers[o + 6], numbers[o + 7], numbers[o + 8]

    o = MEMORY
    last = state[o : o + C]
    o += C
    gap = state[o : o + C]
    o += C
    run = state[o : o + C]
    o += C
    share = state[o : o + C]
    o += C
    xs = state[o : o + p * C].reshape(p, C)
    o += p * C
    ys = state[o : o + p * C].reshape(p, C)
    o += p * C
    ds = state[o : o + p * C].reshape(p, C)
    o += p * C
    es = state[o : o + p * C].reshape(p, C)
    o += p * C
    late = state[o : o + C]
    o += C
    energy = state[o : o + C * nE].reshape(C, nE)
    o += C * nE
    sums = state[o : o + C * nG * 8].reshape(C, nG, 8)  # offset, scale, delay: Σ hq, Σ hSh each; scale, not clipped: Σ hq, Σ hSh
    o += C * nG * 8
    relation = state[o : o + P * nP].reshape(P, nP)
    o += P * nP
    mean_speed = state[o : o + nP]

    x, y, eps, clipped, q, qc, stepped, d, level_now, scaled = np.empty(C), np.empty(C), np.empty(C), np.empty(C), np.empty(C), np.empty(C), np.empty(C), np.empty(C), np.empty(C), np.empty(C)
    phi, by_r, by_u = np.zeros(F), np.zeros(F), np.zeros(F)
    J, h = np.empty(C), np.empty(C)
    s = np.zeros(K)
    known = np.empty(C, np.bool_)
    for k in range(rows.shape[0]):
        # What was measured; the last value stands for what was not.
        first = state[0] == 0.0
        longest, absent = 0.0, -1
        for i in range(C):
            value = rows[k, i]
            known[i] = measured[k, i] and math.isfinite(value)
            if first:
                last[i] = usual[i]
                late[i] = rows[k, i] if measured[k, i] and math.isfinite(rows[k, i]) else usual[i]
            if known[i]:
                same = value == last[i] and not first
                run[i] = run[i] + 1.0 if same else 0.0
                share[i] += forget_s * ((1.0 if same else 0.0) - share[i])
                x[i], last[i] = value, value
                gap[i] = -float(p) if gap[i] > 0.0 else min(gap[i] + 1.0, 0.0)  # negative: predictions settle again
            else:
                x[i] = last[i]
                gap[i] = max(gap[i], 0.0) + 1.0
                if gap[i] > gap_limit[i] and gap[i] - gap_limit[i] > longest:
                    longest, absent = gap[i] - gap_limit[i], i
        r, u = (x[at_r] if at_r >= 0 else 0.0), (x[at_u] if at_u >= 0 else 0.0)
        ay, ax = (x[at_ay] if at_ay >= 0 else 0.0), (x[at_ax] if at_ax >= 0 else 0.0)
        w = max(abs(u), least_speed)
        turning = u * r
        phi[0], phi[1], phi[2], phi[3], phi[4], phi[5] = 1.0, r, u, turning, 0.01 * turning**3, r / w
        phi[6], phi[7], phi[8], phi[9], phi[10], phi[11] = ay, ay / (w * w), 0.01 * ay**3, r * r, u * u, ax
        by_r[1], by_r[3], by_r[4], by_r[5] = 1.0, u, 0.03 * turning * turning * u, 1.0 / w
        by_u[2], by_u[3], by_u[4], by_u[5] = 1.0, r, 0.03 * turning * turning * r, (-r / (w * w) if abs(u) > least_speed else 0.0)
        still = abs(u) < least_speed and abs(r) < still_r and abs(ay) < still_ay
        all_known = True
        for i in range(C):
            all_known = all_known and known[i]
            y[i] = x[i]
            for f in range(6):
                y[i] -= W[i, f] * phi[f]

        place, part = 0, 0.0
        while place < N_LEVELS - 2 and abs(u) > speeds[place + 1]:
            place += 1
        if speeds[place + 1] > speeds[place]:
            part = min(max((abs(u) - speeds[place]) / (speeds[place + 1] - speeds[place]), 0.0), 1.0)
        for i in range(C):
            level_now[i] = (1.0 - part) * levels[place, i] + part * levels[place + 1, i]

        # Innovations; a channel that is back, and what was made with it, starts with an innovation of zero.
        settled = state[0] >= p
        for i in range(C):
            predicted = constant[i]
            eps[i] = predicted
        for lag in range(p):
            for m in range(C):
                past = ys[lag, m]
                for i in range(C):
                    eps[i] += A[lag, m, i] * past
        for i in range(C):
            usable = settled and modelled[i] == 1 and gap[i] == 0.0
            if usable:
                for f in range(6):
                    if W[i, f] != 0.0 and f > 0:
                        if at_r >= 0 and by_r[f] != 0.0 and gap[at_r] != 0.0:
                            usable = False
                        if at_u >= 0 and by_u[f] != 0.0 and gap[at_u] != 0.0:
                            usable = False
            if usable:
                eps[i] = y[i] - eps[i]
            else:
                if settled and gap[i] > 0.0:
                    y[i] = eps[i]
                eps[i] = 0.0
            scaled[i] = eps[i] / level_now[i]
            clipped[i] = min(max(scaled[i], -CLIP * deviation[i]), CLIP * deviation[i])
        for i in range(C):
            a, b = 0.0, 0.0
            for j in range(C):
                a += precision[i, j] * scaled[j]
                b += precision[i, j] * clipped[j]
            q[i], qc[i] = a, b

        for lag in range(p - 1, 0, -1):
            for i in range(C):
                es[lag, i] = es[lag - 1, i]
        for i in range(C):
            es[0, i] = min(max(scaled[i], -STEP_CLIP * deviation[i]), STEP_CLIP * deviation[i])
            d[i] = late[i] - (x[i] - eps[i])
            late[i] += forget_d * (x[i] - late[i])
        for m in range(C):
            total = 0.0
            for lag in range(p):
                for j in range(C):
                    total += steps[lag, m, j] * es[lag, j]
            stepped[m] = total

        best, best_ratio, best_kind, best_channel, best_partner = 0.0, 0.0, FREE, 0, -1
        n = 0
        # Jumps, energy
        for i in range(C):
            for m in range(C):
                J[m] = 0.0
            J[i] = 1.0
            if i == at_r or i == at_u:
                for m in range(C):
                    for f in range(1, 6):
                        J[m] -= W[m, f] * (by_r[f] if i == at_r else by_u[f])
            stair, power = 0.0, 0.0
            for m in range(C):
                if J[m] != 0.0:
                    own = J[m] / level_now[m]
                    stair += own * stepped[m]
                    for j in range(C):
                        power += own * step_power[m, j] * J[j] / level_now[j]
            s[K - P * nP - C + i] = abs(stair) / math.sqrt(power) if power > 0.0 and settled else 0.0
            z = q[i] / math.sqrt(precision[i, i]) if modelled[i] == 1 else 0.0
            s[i] = abs(z)
            s[K - P * nP - 2 * C + i] = abs(z) / math.sqrt(CALM + energy[i, 1])
            if i == at_r:
                state[5] = 0.0 if abs(z) > limits[i] else state[5] + 1.0
            normed = scaled[i] / deviation[i]
            for e in range(nE):
                energy[i, e] += forget_e[e] * (normed * normed - energy[i, e])
                roof = limits[C + i * nE + e]
                energy[i, e] = min(energy[i, e], (CAP * roof) ** 2)
                s[C + i * nE + e] = math.sqrt(energy[i, e])
                s[C + C * nE + i * nE + e] = 1.0 / math.sqrt(energy[i, e] + 1e-12) if modelled[i] == 1 else 0.0
            # Likelihood ratios of an offset and of a scale
            for form in range(3):
                for m in range(C):
                    h[m] = 0.0
                if form == 0:
                    for m in range(C):
                        if J[m] != 0.0:
                            for j in range(C):
                                h[j] += gain_one[m, j] * J[m]
                else:
                    now = x[i] - eps[i] if form == 1 else d[i]  # as predicted: free of the noise in ε
                    history = xs if form == 1 else ds
                    for m in range(C):
                        if J[m] != 0.0:
                            h[m] += J[m] * now
                            for lag in range(p):
                                past = J[m] * history[lag, i]
                                for j in range(C):
                                    h[j] -= A[lag, m, j] * past
                for m in range(C):
                    h[m] /= level_now[m]
                top, raw, weight = 0.0, 0.0, 0.0
                for m in range(C):
                    top += h[m] * qc[m]
                    raw += h[m] * q[m]
                    inner = 0.0
                    for j in range(C):
                        inner += precision[m, j] * h[j]
                    weight += h[m] * inner
                if weight > heaviest[form, i]:
                    part = heaviest[form, i] / weight
                    top, raw, weight = part * top, part * raw, part * weight
                top -= healthy[form, i] * weight
                raw -= healthy[form, i] * weight
                if not settled or modelled[i] == 0 or gap[i] != 0.0:
                    top, raw, weight = 0.0, 0.0, 0.0
                base = C * (1 + 2 * nE) + form * C * nG + i * nG
                for g in range(nG):
                    keep = 1.0 - forget_g[g]
                    own = sums[i, g]
                    own[2 * form] = keep * own[2 * form] + top
                    own[2 * form + 1] = keep * keep * own[2 * form + 1] + weight
                    z = abs(own[2 * form]) / math.sqrt(own[2 * form + 1]) if own[2 * form + 1] > 0.0 else 0.0
                    if z > CAP * limits[base + g]:
                        own[2 * form] *= CAP * limits[base + g] / z
                        z = CAP * limits[base + g]
                    s[base + g] = z
                    if form == 1:
                        own[6] = keep * own[6] + raw
                        own[7] = keep * own[7] + weight
        n = C * (1 + 2 * nE + 3 * nG)
        # Runs of equal samples, their share, the range, slow wheels
        slow = 0
        for i in range(C):
            quiet = still or rests[i] == 1
            s[n + i] = 0.0 if quiet else run[i]
            s[n + C + i] = 0.0 if quiet else share[i]
            s[n + 2 * C + i] = max(x[i] / span[1, i], x[i] / span[0, i])
            s[n + 3 * C + i] = 0.0
            if wheel[i] == 1 and known[i]:
                expected = x[i] - y[i] if gap[i] == 0.0 else 0.0
                if abs(expected) > 0.0 and abs(u) > least_speed:
                    slip = 1.0 - x[i] / expected
                    s[n + 3 * C + i] = abs(slip)
                    slow += 1 if slip > SLIPPING else 0
        n += 6 * C
        # Relations between channels
        state[6] += forget_x * (ax - state[6])
        for t in range(nP):
            if first:
                mean_speed[t] = u
            mean_speed[t] += forget_p[t] * (u - mean_speed[t])
        for j in range(P):
            e = x[target[j]]
            for f in range(F):
                e -= V[j, f] * phi[f]
            if still:
                e = 0.0
            for t in range(nP):
                own = relation[j, t]
                if all_known:
                    own += forget_p[t] * (e - own)
                less = 0.0
                if rate_gain[j] != 0.0 and not still:
                    less = rate_gain[j] * (u - mean_speed[t]) * forget_p[t] / ((1.0 - forget_p[t]) * step)
                size = abs(own - less)
                roof = CAP * limits[n + j * nP + t]
                if size > roof and rate_gain[j] == 0.0:
                    own *= roof / size
                    size = roof
                relation[j, t] = own
                s[n + j * nP + t] = size

        # What exceeds its limit, and what that says
        highest, found, weightiest = 0.0, 0.0, -1.0
        for m in range(K):
            over = s[m] / limits[m]
            highest = max(highest, over)
            if over < 1.0:
                continue
            kind, channel, other, weightier = FREE, 0, -1, 0.0
            v = m
            if v < C:
                kind, channel, weightier = JUMP, v, 2.0
            elif v < C + C * nE:
                kind, channel, weightier = NOISE, (v - C) // nE, 2.5
            elif v < C + 2 * C * nE:
                kind, channel, weightier = SMOOTH, (v - C - C * nE) // nE, 1.5
            elif v < C * (1 + 2 * nE + nG):
                kind, channel, weightier = OFFSET, (v - C * (1 + 2 * nE)) // nG, 4.0
            elif v < C * (1 + 2 * nE + 2 * nG):
                v -= C * (1 + 2 * nE + nG)
                kind, channel, weightier = SCALE, v // nG, 4.0
            elif v < C * (1 + 2 * nE + 3 * nG):
                kind, channel, weightier = DELAY, (v - C * (1 + 2 * nE + 2 * nG)) // nG, 4.0
            elif v < C * (7 + 2 * nE + 3 * nG):
                v -= C * (1 + 2 * nE + 3 * nG)
                channel = v % C
                if v < C:
                    kind, weightier = FROZEN, 8.0
                elif v < 2 * C:
                    kind, weightier = HELD, 7.0
                elif v < 3 * C:
                    kind, weightier = OUTSIDE, 1.0
                elif v < 4 * C:
                    kind, weightier = CONTRADICTION, 3.5
                    if x[channel] < (1.0 - LOST) * (x[channel] - y[channel]):
                        braking = state[6] < -BRAKING or slow > 1
                        kind, weightier = (LOCKED if braking else DROPOUT), 9.0
                else:
                    kind, weightier = JUMP, 2.0
            else:
                v = (v - C * (7 + 2 * nE + 3 * nG)) // nP
                kind, channel, other, weightier = CONTRADICTION, target[v], partner[v], 3.0
            if kind == OFFSET or kind == SCALE or kind == DELAY:
                weightier += 0.5 * (1.0 - 1.0 / (1.0 + s[m]))
            else:
                weightier += 0.5 * (1.0 - 1.0 / (1.0 + over))
            if weightier > weightiest:
                weightiest, best_kind, best_channel, best_partner = weightier, kind, channel, other
                best_ratio = over
        if best_kind == SCALE:
            own = sums[best_channel, min(2, nG - 1)]
            part = own[6] / own[7] if own[7] > 0.0 else 0.0
            factor = 1.0 / (1.0 - part) if abs(1.0 - part) > 1e-3 else 1e3
            if factor < -0.3:
                best_kind = SIGN
            elif abs(factor) > 2.5 or abs(factor) < 0.4:
                best_kind = UNIT
        # A spin: turns faster than ever, for a while, without the yaw rate having jumped there
        fast = at_r >= 0 and abs(r) > spin_r and abs(turning) > spin_a and state[5] > 5.0 * spinning
        state[4] = state[4] + 1.0 if fast else 0.0
        level = 0.0
        if highest >= 1.0:
            level = 2.0 if highest >= INVALID and best_kind != OUTSIDE else 1.0
            if best_kind == FROZEN or best_kind == HELD or best_kind == SIGN or best_kind == UNIT:
                level = 2.0
        if state[4] > spinning:
            level, best_kind, best_channel, best_partner = 2.0, SPIN, at_r, -1
        if absent >= 0:
            level = max(level, 2.0 if longest > bridged else 1.0)
            best_kind, best_channel, best_partner = MISSING, absent, -1
        if level > 0.0:
            found = best_kind * 10000.0 + code[best_channel] * 100.0 + (code[best_partner] if best_partner >= 0 else 0)
            state[1], state[2], state[3] = float(hold), found, level
        elif state[1] > 0.0:
            state[1] = state[1] - 1.0 if highest < CLEAR else float(hold)
            level, found = state[3], state[2]
        status[k] = level
        reason[k] = found
        ratio[k] = highest
        if statistics.shape[0] > 0:
            for m in range(K):
                statistics[k, m] = s[m]
        # History
        for lag in range(p - 1, 0, -1):
            for i in range(C):
                xs[lag, i], ys[lag, i], ds[lag, i] = xs[lag - 1, i], ys[lag - 1, i], ds[lag - 1, i]
        for i in range(C):
            xs[0, i], ys[0, i], ds[0, i] = x[i], y[i], d[i]
        state[0] += 1.0
