"""One step of the unscented filter over many sequences, compiled, and its adjoint.

Arrays lie sequence by sequence: means (B, n), covariances (B, n, n), sigma points (B, 2n + 1, n), what is expected at them (B, 2n + 1, m).
Every adjoint takes what its step was given, and adds to (``_bar``) gradients unless it says otherwise. A rule is the row
[spread, centre_mean, centre_covariance, other] of a `SigmaRule`; ``lower`` holds the smallest possible value of each state.
"""

from __future__ import annotations

import numba
import numpy as np

from vehest.filters.gating import refuses

compiled = numba.njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)


@compiled
def points_of(mean, covariance, rule, lower, margin, repair, factor, points, repaired):  # type: ignore[no-untyped-def]
    """Sigma points and the factors they are drawn with; repairs what is not positive definite, in ``covariance`` too."""
    sequences, n = mean.shape
    spread = rule[0]
    for b in range(sequences):
        repaired[b] = False
        if not _cholesky(covariance[b], factor[b]):
            repaired[b] = _all_finite(covariance[b])
            if not (repair and repaired[b] and _lifted(covariance[b], factor[b], margin)):
                factor[b] = np.nan
                covariance[b] = np.nan
        for i in range(n):
            centre = mean[b, i]
            points[b, 0, i] = max(centre, lower[i]) if centre == centre else centre
            for j in range(n):
                offset = spread * factor[b, i, j] if j <= i else factor[b, i, j] * 0
                points[b, 1 + j, i] = max(centre + offset, lower[i])
                points[b, 1 + n + j, i] = max(centre - offset, lower[i])
            if not np.isfinite(factor[b, 0, 0]):
                points[b, :, i] = np.nan


@compiled
def points_adjoint(mean, factor, rule, lower, points_bar, mean_bar, covariance_bar):  # type: ignore[no-untyped-def]
    """Adjoint of `points_of`; what a repair added counts as constant."""
    sequences, n = mean.shape
    spread = rule[0]
    below = np.empty((n, n), mean.dtype)
    for b in range(sequences):
        L = factor[b]
        below[:] = 0
        for i in range(n):
            if mean[b, i] >= lower[i]:
                mean_bar[b, i] += points_bar[b, 0, i]
            for j in range(n):
                offset = spread * L[i, j] if j <= i else L[i, j] * 0
                up = points_bar[b, 1 + j, i] if mean[b, i] + offset >= lower[i] else L[i, j] * 0
                down = points_bar[b, 1 + n + j, i] if mean[b, i] - offset >= lower[i] else L[i, j] * 0
                mean_bar[b, i] += up + down
                if j <= i:
                    below[i, j] = spread * (up - down)
        _cholesky_adjoint(L, below, covariance_bar[b])


@compiled
def moments_of(values, noise, rule, lower, mean, covariance):  # type: ignore[no-untyped-def]
    """Weighted mean and covariance of what became of the points, plus noise."""
    sequences, count, n = values.shape
    _, centre_mean, centre_covariance, other = rule
    deviation = np.empty((count, n), values.dtype)
    for b in range(sequences):
        for i in range(n):
            total = values[b, 0, i] * 0
            for s in range(1, count):
                total += values[b, s, i]
            centre = centre_mean * values[b, 0, i] + other * total
            for s in range(count):
                deviation[s, i] = values[b, s, i] - centre
            mean[b, i] = max(centre, lower[i]) if centre == centre else centre
        for i in range(n):
            for j in range(i + 1):
                total = values[b, 0, 0] * 0
                for s in range(1, count):
                    total += deviation[s, i] * deviation[s, j]
                total = other * total + centre_covariance * deviation[0, i] * deviation[0, j]
                total += rule.dtype.type(0.5) * (noise[b, i, j] + noise[b, j, i])
                covariance[b, i, j] = total
                covariance[b, j, i] = total


@compiled
def moments_adjoint(values, rule, lower, mean_bar, covariance_bar, values_bar, noise_bar):  # type: ignore[no-untyped-def]
    """Adjoint of `moments_of`; writes ``values_bar`` and ``noise_bar``."""
    sequences, count, n = values.shape
    _, centre_mean, centre_covariance, other = rule
    half = rule.dtype.type(0.5)
    two = rule.dtype.type(2.0)
    deviation = np.empty((count, n), values.dtype)
    whole = np.empty((n, n), values.dtype)
    through = np.empty(n, values.dtype)
    for b in range(sequences):
        for i in range(n):
            total = values[b, 0, i] * 0
            for s in range(1, count):
                total += values[b, s, i]
            centre = centre_mean * values[b, 0, i] + other * total
            through[i] = mean_bar[b, i] if centre >= lower[i] else total * 0
            for s in range(count):
                deviation[s, i] = values[b, s, i] - centre
            for j in range(n):
                whole[i, j] = half * (covariance_bar[b, i, j] + covariance_bar[b, j, i])
                noise_bar[b, i, j] = whole[i, j]
        for s in range(count):
            weight = centre_covariance if s == 0 else other
            for i in range(n):
                total = values[b, 0, 0] * 0
                for j in range(n):
                    total += whole[i, j] * deviation[s, j]
                values_bar[b, s, i] = two * weight * total
        for i in range(n):
            total = through[i]
            for s in range(count):
                total -= values_bar[b, s, i]
            values_bar[b, 0, i] += centre_mean * total
            for s in range(1, count):
                values_bar[b, s, i] += other * total


@compiled
def gate_of(expected, noise, rule, limit, patience, y, refused, gone):  # type: ignore[no-untyped-def]
    """What the gate refuses becomes NaN in ``y`` and true in ``gone``, (B, m); counts in ``refused``, (B, m); see `Gate`.

    A negative weight of the mean point cannot make a variance smaller than that of the noise.
    """
    sequences, count, m = expected.shape
    _, centre_mean, centre_covariance, other = rule
    for b in range(sequences):
        for i in range(m):
            if y[b, i] != y[b, i]:
                continue
            total = expected[b, 0, i] * 0
            for s in range(1, count):
                total += expected[b, s, i]
            centre = centre_mean * expected[b, 0, i] + other * total
            total = centre * 0
            for s in range(1, count):
                total += (expected[b, s, i] - centre) * (expected[b, s, i] - centre)
            total = other * total + centre_covariance * (expected[b, 0, i] - centre) * (expected[b, 0, i] - centre)
            if refuses(y[b, i] - centre, max(total, centre * 0) + noise[b, i, i], limit, patience, refused[b], i):
                y[b, i] = np.nan
                gone[b, i] = True


@compiled
def update_of(  # type: ignore[no-untyped-def]
    mean,
    covariance,
    points,
    expected,
    y,
    noise,
    rule,
    lower,
    margin,
    repair,
    post_mean,
    post_covariance,
    innovation,
    own,
    gain,
    likelihood,
    repaired,
    centre,
):
    """The state given a measurement; what is NaN was not measured. ``repaired`` keeps what it was where nothing is repaired.

    ``centre`` becomes the weight that the mean point had in covariances, (B,): 0 where a negative one took their definiteness.
    """
    sequences, count, m = expected.shape
    n = mean.shape[1]
    _, _, centre_covariance, other = rule
    half = rule.dtype.type(0.5)
    log_two_pi = rule.dtype.type(np.log(2.0 * np.pi))
    spread, deviation = np.empty((count, m), mean.dtype), np.empty((count, n), mean.dtype)
    cross, factor, whitened = np.empty((n, m), mean.dtype), np.empty((m, m), mean.dtype), np.empty(m, mean.dtype)
    tried = np.empty((n, n), mean.dtype)
    for b in range(sequences):
        _spread(expected[b], points[b], mean[b], y[b], rule, innovation[b], spread, deviation)
        centre[b] = centre_covariance
        definite = _joint(spread, deviation, centre_covariance, other, y[b], noise[b], cross, own[b], factor)
        if definite:
            _posterior(covariance[b], cross, factor, gain[b], post_covariance[b])
        lost = repair and centre_covariance < 0 and not (definite and _cholesky(post_covariance[b], tried))
        if lost and _all_finite(own[b]) and _all_finite(covariance[b]):
            repaired[b] = True
            centre[b] = 0
            definite = _joint(spread, deviation, centre[b], other, y[b], noise[b], cross, own[b], factor)
            if definite:
                _posterior(covariance[b], cross, factor, gain[b], post_covariance[b])
        if not definite:
            lost = _all_finite(own[b])
            repaired[b] = repaired[b] or lost
            if not (repair and lost and _lifted(own[b], factor, margin)):
                factor[:] = np.nan
                own[b] = np.nan
            _posterior(covariance[b], cross, factor, gain[b], post_covariance[b])
        log_determinant = mean[b, 0] * 0
        squared = mean[b, 0] * 0
        measured = 0
        for i in range(m):
            measured += y[b, i] == y[b, i]
            total = innovation[b, i]
            for c in range(i):
                total -= factor[i, c] * whitened[c]
            whitened[i] = total / factor[i, i]
            squared += whitened[i] * whitened[i]
            log_determinant += np.log(factor[i, i])
        likelihood[b] = -half * (squared + 2 * log_determinant + measured * log_two_pi)
        for i in range(n):
            total = mean[b, i]
            for c in range(m):
                total += gain[b, i, c] * innovation[b, c]
            post_mean[b, i] = max(total, lower[i]) if total == total else total


@compiled
def _joint(spread, deviation, centre, other, y, noise, cross, own, factor):  # type: ignore[no-untyped-def]
    """Covariance of states with what is expected, and of that with noise, with its factor; whether it is positive definite."""
    count, m = spread.shape
    half = own.dtype.type(0.5)
    for i in range(deviation.shape[1]):
        for j in range(m):
            total = spread[0, 0] * 0
            for s in range(1, count):
                total += deviation[s, i] * spread[s, j]
            cross[i, j] = other * total + centre * deviation[0, i] * spread[0, j]
    for i in range(m):
        for j in range(i + 1):
            total = spread[0, 0] * 0
            for s in range(1, count):
                total += spread[s, i] * spread[s, j]
            total = other * total + centre * spread[0, i] * spread[0, j]
            if y[i] == y[i] and y[j] == y[j]:
                total += half * (noise[i, j] + noise[j, i])
            elif i == j:
                total += 1.0
            own[i, j] = total
            own[j, i] = total
    return _cholesky(own, factor)


@compiled
def _posterior(covariance, cross, factor, gain, post_covariance):  # type: ignore[no-untyped-def]
    """Gain cross S⁻¹, by the factor of S, and the covariance that is left."""
    n, m = cross.shape
    half = cross.dtype.type(0.5)
    whitened = np.empty(m, cross.dtype)
    for i in range(n):
        for j in range(m):
            total = cross[i, j]
            for c in range(j):
                total -= factor[j, c] * whitened[c]
            whitened[j] = total / factor[j, j]
        for j in range(m - 1, -1, -1):
            total = whitened[j]
            for c in range(j + 1, m):
                total -= factor[c, j] * gain[i, c]
            gain[i, j] = total / factor[j, j]
    for i in range(n):
        for j in range(i + 1):
            total = half * (covariance[i, j] + covariance[j, i])
            for c in range(m):
                total -= half * (gain[i, c] * cross[j, c] + gain[j, c] * cross[i, c])
            post_covariance[i, j] = total
            post_covariance[j, i] = total


@compiled
def update_adjoint(  # type: ignore[no-untyped-def]
    mean,
    points,
    expected,
    y,
    rule,
    lower,
    innovation,
    own,
    gain,
    centre,
    post_mean_bar,
    post_covariance_bar,
    mean_bar,
    covariance_bar,
    points_bar,
    expected_bar,
    noise_bar,
    y_bar,
):
    """Adjoint of `update_of`; writes ``mean_bar``, ``covariance_bar``, ``points_bar``, ``expected_bar``, ``noise_bar`` and ``y_bar``."""
    sequences, count, m = expected.shape
    n = mean.shape[1]
    _, centre_mean, _, other = rule
    half, two = rule.dtype.type(0.5), rule.dtype.type(2.0)
    spread, deviation = np.empty((count, m), mean.dtype), np.empty((count, n), mean.dtype)
    P, K = np.empty((n, n), mean.dtype), np.empty((n, m), mean.dtype)
    factor, solved, pulled = np.empty((m, m), mean.dtype), np.empty(m, mean.dtype), np.empty(m, mean.dtype)
    through, cross_bar, own_bar = np.empty(n, mean.dtype), np.empty((n, m), mean.dtype), np.empty((m, m), mean.dtype)
    off = np.empty(m, mean.dtype)
    for b in range(sequences):
        _spread(expected[b], points[b], mean[b], y[b], rule, off, spread, deviation)
        for i in range(n):
            total = mean[b, i]
            for c in range(m):
                K[i, c] = gain[b, i, c]
                total += K[i, c] * innovation[b, c]
            through[i] = post_mean_bar[b, i] if total >= lower[i] else total * 0
            for j in range(n):
                P[i, j] = half * (post_covariance_bar[b, i, j] + post_covariance_bar[b, j, i])
                covariance_bar[b, i, j] = P[i, j]
        _cholesky(own[b], factor)
        for i in range(m):  # solved = S⁻¹ e
            total = innovation[b, i]
            for c in range(i):
                total -= factor[i, c] * solved[c]
            solved[i] = total / factor[i, i]
        for i in range(m - 1, -1, -1):
            total = solved[i]
            for c in range(i + 1, m):
                total -= factor[c, i] * solved[c]
            solved[i] = total / factor[i, i]
        for c in range(m):  # pulled = Kᵀ m̄, the gradient of the innovation
            total = through[0] * 0
            for i in range(n):
                total += K[i, c] * through[i]
            pulled[c] = total
            y_bar[b, c] = total if y[b, c] == y[b, c] else total * 0
        for i in range(n):
            for c in range(m):
                total = through[i] * solved[c]
                for j in range(n):
                    total -= two * P[i, j] * K[j, c]
                cross_bar[i, c] = total
        for c in range(m):
            for d in range(m):
                total = -half * (pulled[c] * solved[d] + pulled[d] * solved[c])
                for i in range(n):
                    for j in range(n):
                        total += K[i, c] * P[i, j] * K[j, d]
                own_bar[c, d] = total
                noise_bar[b, c, d] = total if y[b, c] == y[b, c] and y[b, d] == y[b, d] else total * 0
        for i in range(n):
            total = through[i]
            for s in range(count):
                weight = centre[b] if s == 0 else other
                part = total * 0
                for c in range(m):
                    part += cross_bar[i, c] * spread[s, c]
                points_bar[b, s, i] = weight * part
                total -= weight * part
            mean_bar[b, i] = total
        for c in range(m):
            known = y[b, c] == y[b, c]
            total = -pulled[c] if known else pulled[c] * 0
            for s in range(count):
                weight = centre[b] if s == 0 else other
                part = total * 0
                for i in range(n):
                    part += cross_bar[i, c] * deviation[s, i]
                for d in range(m):
                    part += two * own_bar[c, d] * spread[s, d]
                expected_bar[b, s, c] = weight * part if known else 0.0
                total -= expected_bar[b, s, c]
            expected_bar[b, 0, c] += centre_mean * total
            for s in range(1, count):
                expected_bar[b, s, c] += other * total


@compiled
def _spread(expected, points, mean, y, rule, innovation, spread, deviation):  # type: ignore[no-untyped-def]
    """Of one sequence: innovation, and how far points lie from the mean and what is expected at them from its own; 0 where not measured."""
    count, m = expected.shape
    _, centre_mean, _, other = rule
    for i in range(m):
        total = expected[0, i] * 0
        for s in range(1, count):
            total += expected[s, i]
        centre = centre_mean * expected[0, i] + other * total
        known = y[i] == y[i]
        innovation[i] = y[i] - centre if known else 0.0
        for s in range(count):
            spread[s, i] = expected[s, i] - centre if known else 0.0
    for i in range(mean.shape[0]):
        for s in range(count):
            deviation[s, i] = points[s, i] - mean[i]


@compiled
def _cholesky(A, L):  # type: ignore[no-untyped-def]
    """Lower factor of A into L; whether A is positive definite."""
    n = A.shape[0]
    for j in range(n):
        total = A[j, j]
        for k in range(j):
            total -= L[j, k] * L[j, k]
        if not total > 0:
            return False
        pivot = np.sqrt(total)
        if not np.isfinite(pivot):
            return False
        L[j, j] = pivot
        for i in range(j):
            L[i, j] = 0
        for i in range(j + 1, n):
            total = A[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = total / pivot
    return _all_finite(L)


@compiled
def _all_finite(A):  # type: ignore[no-untyped-def]
    for value in A.flat:  # noqa: SIM110 - compiled
        if not np.isfinite(value):
            return False
    return True


@compiled
def _lifted(A, L, margin):  # type: ignore[no-untyped-def]
    """Add to A's eigenvalues what a margin needs, and factorise."""
    eigenvalues = np.linalg.eigvalsh(A)
    lift = margin * np.abs(eigenvalues).max() - eigenvalues[0]
    for i in range(A.shape[0]):
        A[i, i] += lift
    return _cholesky(A, L)


@compiled
def _cholesky_adjoint(L, L_bar, A_bar):  # type: ignore[no-untyped-def]
    """A_bar += sym(L⁻ᵀ Φ(Lᵀ L_bar) L⁻¹), Φ the lower triangle with half the diagonal (Murray 2016, Eq. 10)."""
    n = L.shape[0]
    inner = np.zeros((n, n), L.dtype)
    half = L.dtype.type(0.5)
    for i in range(n):
        for j in range(i + 1):
            total = L[0, 0] * 0
            for k in range(i, n):
                total += L[k, i] * L_bar[k, j]
            inner[i, j] = total * half if i == j else total
    for j in range(n):  # Lᵀ X = Φ
        for i in range(n - 1, -1, -1):
            total = inner[i, j]
            for k in range(i + 1, n):
                total -= L[k, i] * inner[k, j]
            inner[i, j] = total / L[i, i]
    for i in range(n):  # Y L = X
        for j in range(n - 1, -1, -1):
            total = inner[i, j]
            for k in range(j + 1, n):
                total -= inner[i, k] * L[k, j]
            inner[i, j] = total / L[j, j]
    for i in range(n):
        for j in range(n):
            A_bar[i, j] += half * (inner[i, j] + inner[j, i])
