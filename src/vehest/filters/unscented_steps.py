"""One step of the unscented filter over many sequences, compiled, and its adjoint.

Sequences lie side by side: means (n, B), covariances (n, n, B), sigma points (2n + 1, n, B), what is expected at them (2n + 1, m, B). A
step works on those from ``first`` to ``end``, as many at once as fill a vector of `vehest.lanes`; vectors are read beyond ``end``, so that
arrays are followed by room for one (`room`), and never written there. Every adjoint takes what its step was given, and adds to (``_bar``)
gradients unless it says otherwise. ``rules`` are the row [spread, centre_mean, centre_covariance, other] of a `SigmaRule`, the smallest
possible value of each state, the margin of a repair and whether there are repairs; ``drawn`` are sigma points, the factors and the
covariances that they come from. Sums are rounded as those of single numbers, so that a sequence has the same digits beside any other.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
from numba import types

from vehest.filters.gating import refuses
from vehest.lanes import BYTES, choose, load_unfused, most, root, store, store_some, width

compiled = numba.njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
ARGUMENTS: dict[str, Any] = {
    "rules": (1, 1, 0, types.boolean),
    "drawn": (3, 3, 3),
    "post": (2, 3),
    "kept": (2, 3, 3, 1),
    "post_bars": (2, 3),
    "prior_bars": (2, 3),
    "other_bars": (3, 3, 3, 2),
    "repaired": types.boolean[::1],
    "gone": types.boolean[:, ::1],
    "refused": types.int64[:, ::1],
    **dict.fromkeys(("mean", "mean_bar", "y"), 2),
    **dict.fromkeys(("first", "end", "patience"), types.intp),
    "limit": 0,
}
"""Dimensions of arrays, 0 of a number, or the type, of what steps are called with; others have three dimensions."""
piece = numba.njit(
    forceinline=True,
    no_cpython_wrapper=True,
    no_cfunc_wrapper=True,
    error_model="numpy",
    boundscheck=False,
)


def room(shape: tuple[int, ...], dtype: Any, make: Any = np.empty) -> Any:
    """An array that vectors may be read beyond, not filled or as ``make`` fills it."""
    count = math.prod(shape)
    size = np.dtype(dtype).itemsize
    return make(count + BYTES // size, dtype)[:count].reshape(shape)


def types_of(step: Any, dtype: Any) -> tuple[Any, ...]:
    """Types of a step's arguments for arrays of a precision, by their names in `ARGUMENTS`."""
    number = numba.from_dtype(np.dtype(dtype))

    def kind(of: Any) -> Any:
        if isinstance(of, tuple):
            return types.BaseTuple.from_types(tuple(map(kind, of)))
        return (types.Array(number, of, "C") if of else number) if isinstance(of, int) else of

    names = step.py_func.__code__.co_varnames[: step.py_func.__code__.co_argcount]
    return tuple(kind(ARGUMENTS.get(name, 3)) for name in names)


@piece
def at_row(values, row, b):  # type: ignore[no-untyped-def]
    """Vector of a row (the indices before the last one, as one) from sequence b on."""
    return load_unfused(values, row * values.shape[values.ndim - 1] + b)


@piece
def _own(rows, row):  # type: ignore[no-untyped-def]
    """Vector of a row of scratch, (R, W)."""
    return load_unfused(rows, row * rows.shape[1])


@piece
def _put(rows, row, vector):  # type: ignore[no-untyped-def]
    store(rows, row * rows.shape[1], vector)


@piece
def _rows(count, like):  # type: ignore[no-untyped-def]
    return np.empty((count, width(like)), like.dtype)


@piece
def _read(values, rows, b):  # type: ignore[no-untyped-def]
    """Sequences from b on to scratch."""
    for row in range(rows.shape[0]):
        _put(rows, row, at_row(values, row, b))


@piece
def _write(rows, out, b, end):  # type: ignore[no-untyped-def]
    """Scratch to the sequences from b to ``end``, as many as there are."""
    stride = out.shape[out.ndim - 1]
    for row in range(rows.shape[0]):
        store_some(out, row * stride + b, _own(rows, row), end - b)


@piece
def _any(condition, b, end, scratch):  # type: ignore[no-untyped-def]
    """Whether a vector is positive for a sequence from b to ``end``; ``scratch`` (1, W) becomes the vector."""
    store(scratch, 0, condition)
    found = False
    for lane in range(min(end - b, scratch.shape[1])):
        found |= scratch[0, lane] > 0
    return found


@compiled
def points_of(mean, given, rules, drawn, repaired, first, end):  # type: ignore[no-untyped-def]
    """Sigma points of ``given`` covariances, factors, and the covariances where what is not positive definite is repaired."""
    (rule, lower, margin, repair) = rules
    (points, factor, covariance) = drawn
    n = mean.shape[0]
    count = points.shape[0]
    lanes = width(mean)
    A = _rows(n * n, mean)
    L = _rows(n * n, mean)
    P = _rows(count * n, mean)
    flags = _rows(1, mean)
    for b in range(first, end, lanes):
        _read(given, A, b)
        lost = 1 - _cholesky(A, L, n)
        for lane in range(min(lanes, end - b)):
            repaired[b + lane] = False
        if _any(lost, b, end, flags):
            for lane in range(min(lanes, end - b)):
                if flags[0, lane] > 0:
                    repaired[b + lane] = _repaired(A, L, lane, n, margin, repair)
        nothing = _own(L, 0) - _own(L, 0)  # NaN where a sequence is lost
        for i in range(n):
            c = at_row(mean, i, b)
            _put(P, i, choose(nothing == 0, most(c, lower[i]), nothing))
            for j in range(n):
                offset = rule[0] * _own(L, i * n + j) if j <= i else nothing
                _put(P, (1 + j) * n + i, choose(nothing == 0, most(c + offset, lower[i]), nothing))
                _put(
                    P,
                    (1 + n + j) * n + i,
                    choose(nothing == 0, most(c - offset, lower[i]), nothing),
                )
        _write(A, covariance, b, end)
        _write(L, factor, b, end)
        _write(P, points, b, end)


@compiled
def points_adjoint(mean, factor, rules, points_bar, mean_bar, covariance_bar, first, end):  # type: ignore[no-untyped-def]
    """Adjoint of `points_of`; what a repair added counts as constant."""
    n = mean.shape[0]
    (rule, lower, _, _) = rules
    L = _rows(n * n, mean)
    below = _rows(n * n, mean)
    inner = _rows(n * n, mean)
    x_bar = _rows(n, mean)
    A_bar = _rows(n * n, mean)
    for b in range(first, end, width(mean)):
        _read(factor, L, b)
        _read(covariance_bar, A_bar, b)
        nothing = _own(L, 0) * 0
        for i in range(n):
            c = at_row(mean, i, b)
            bar = at_row(mean_bar, i, b)
            bar = choose(c >= lower[i], bar + at_row(points_bar, i, b), bar)
            for j in range(n):
                offset = rule[0] * _own(L, i * n + j) if j <= i else nothing
                up = choose(c + offset >= lower[i], at_row(points_bar, (1 + j) * n + i, b), nothing)
                down = choose(
                    c - offset >= lower[i], at_row(points_bar, (1 + n + j) * n + i, b), nothing
                )
                bar += up + down
                _put(below, i * n + j, rule[0] * (up - down) if j <= i else nothing)
            _put(x_bar, i, bar)
        _cholesky_adjoint(L, below, inner, A_bar, n)
        _write(x_bar, mean_bar, b, end)
        _write(A_bar, covariance_bar, b, end)


@piece
def _deviations(values, b, m, rule, deviation, i):  # type: ignore[no-untyped-def]
    """Write how far values (S, m, B) lie from their weighted mean in i, which is returned, into scratch (S · m, W)."""
    count = values.shape[0]
    around = at_row(values, 0, b) * 0
    for s in range(1, count):
        around += at_row(values, s * m + i, b)
    centre = rule[1] * at_row(values, i, b) + rule[3] * around
    for s in range(count):
        _put(deviation, s * m + i, at_row(values, s * m + i, b) - centre)
    return centre


@piece
def _weighted(one, i, n, other, j, m, rule, centre):  # type: ignore[no-untyped-def]
    """Weighted product of deviations, i of (S · n, W) with j of (S · m, W); the mean point has the weight ``centre``."""
    result = _own(one, 0) * 0
    for s in range(1, one.shape[0] // n):
        result += _own(one, s * n + i) * _own(other, s * m + j)
    return rule[3] * result + centre * _own(one, i) * _own(other, j)


@compiled
def moments_of(values, noise, rules, mean, covariance, first, end):  # type: ignore[no-untyped-def]
    """Weighted mean and covariance of what became of the points, plus noise."""
    (count, n) = values.shape[:2]
    (rule, lower, _, _) = rules
    half = rule.dtype.type(0.5)
    deviation = _rows(count * n, values)
    x = _rows(n, values)
    A = _rows(n * n, values)
    for b in range(first, end, width(values)):
        for i in range(n):
            _put(x, i, most(_deviations(values, b, n, rule, deviation, i), lower[i]))
        for i in range(n):
            for j in range(i + 1):
                spread = _weighted(deviation, i, n, deviation, j, n, rule, rule[2])
                spread += half * (at_row(noise, i * n + j, b) + at_row(noise, j * n + i, b))
                _put(A, i * n + j, spread)
                _put(A, j * n + i, spread)
        _write(x, mean, b, end)
        _write(A, covariance, b, end)


@compiled
def moments_adjoint(values, rules, mean_bar, covariance_bar, values_bar, noise_bar, first, end):  # type: ignore[no-untyped-def]
    """Adjoint of `moments_of`; writes ``values_bar`` and ``noise_bar``."""
    (count, n) = values.shape[:2]
    (rule, lower, _, _) = rules
    half = rule.dtype.type(0.5)
    two = rule.dtype.type(2.0)
    deviation = _rows(count * n, values)
    V_bar = _rows(count * n, values)
    through = _rows(n, values)
    whole = _rows(n * n, values)
    for b in range(first, end, width(values)):
        for i in range(n):
            centre = _deviations(values, b, n, rule, deviation, i)
            _put(through, i, choose(centre >= lower[i], at_row(mean_bar, i, b), centre * 0))
            for j in range(n):
                _put(
                    whole,
                    i * n + j,
                    half
                    * (at_row(covariance_bar, i * n + j, b) + at_row(covariance_bar, j * n + i, b)),
                )
        for s in range(count):
            weight = two * (rule[2] if s == 0 else rule[3])
            for i in range(n):
                bar = _own(through, 0) * 0
                for j in range(n):
                    bar += _own(whole, i * n + j) * _own(deviation, s * n + j)
                _put(V_bar, s * n + i, weight * bar)
        for i in range(n):
            left = _own(through, i)
            for s in range(count):
                left -= _own(V_bar, s * n + i)
            for s in range(count):
                _put(
                    V_bar,
                    s * n + i,
                    _own(V_bar, s * n + i) + (rule[1] if s == 0 else rule[3]) * left,
                )
        _write(V_bar, values_bar, b, end)
        _write(whole, noise_bar, b, end)


@compiled
def gate_of(expected, noise, rules, limit, patience, y, refused, gone, first, end):  # type: ignore[no-untyped-def]
    """What the gate refuses becomes NaN in ``y`` and true in ``gone``, (m, B); counts in ``refused``, (B, m); see `Gate`.

    A negative weight of the mean point cannot make a variance smaller than that of the noise.
    """
    count, m = expected.shape[:2]
    _, centre_mean, centre_covariance, other = rules[0]
    for b in range(first, end):
        for i in range(m):
            gone[i, b] = False
            if y[i, b] != y[i, b]:
                continue
            total = expected[0, i, b] * 0
            for s in range(1, count):
                total += expected[s, i, b]
            centre = centre_mean * expected[0, i, b] + other * total
            total = centre * 0
            for s in range(1, count):
                total += (expected[s, i, b] - centre) * (expected[s, i, b] - centre)
            total = other * total + centre_covariance * (expected[0, i, b] - centre) * (
                expected[0, i, b] - centre
            )
            if refuses(
                y[i, b] - centre,
                max(total, centre * 0) + noise[i, i, b],
                limit,
                patience,
                refused[b],
                i,
            ):
                y[i, b] = np.nan
                gone[i, b] = True


@compiled
def update_of(mean, drawn, expected, y, noise, rules, post, kept, repaired, first, end):  # type: ignore[no-untyped-def]
    """The state given a measurement; what is NaN was not measured. ``repaired`` keeps what it was where nothing is repaired.

    Written are mean and covariance, ``post``, and ``kept``: innovation, its covariance, gain, and the weight of the mean point in
    covariances, (B,), 0 where a negative one took their definiteness.
    """
    (rule, lower, margin, repair) = rules
    (points, _, covariance) = drawn
    (post_mean, post_covariance) = post
    (innovation, own, gain, centre) = kept
    count, m = expected.shape[:2]
    n = mean.shape[0]
    lanes = width(mean)
    error = _rows(m, mean)
    spread = _rows(count * m, mean)
    deviation = _rows(count * n, mean)
    cross = _rows(n * m, mean)
    factor = _rows(m * m, mean)
    K = _rows(n * m, mean)
    S = _rows(m * m, mean)
    flags = _rows(1, mean)
    x = _rows(n, mean)
    A = _rows(n * n, mean)
    tried = _rows(n * n, mean)
    weight = _rows(1, mean)
    for b in range(first, end, lanes):
        _spread(expected, points, mean, y, b, rule, error, spread, deviation)
        around = at_row(mean, 0, b) * 0 + rule[2]
        definite = at_row(mean, 0, b) * 0
        lifted = False
        for attempt in range(3):  # as it is, without a negative weight, lifted
            if not lifted:
                definite = _joint(spread, deviation, around, rule, y, noise, b, n, cross, S, factor)
            _posterior(covariance, b, cross, factor, K, A)
            if attempt == 0 and repair and rule[2] < 0:
                lost = 1 - definite * _cholesky(A, tried, n)
                if _any(lost, b, end, flags):
                    nothing = lost * 0
                    for row in range(m * m):
                        nothing += _own(S, row) * 0
                    for row in range(n * n):
                        nothing += at_row(covariance, row, b) * 0
                    lost = choose(nothing == 0, lost, 0.0)
                    if _any(lost, b, end, flags):
                        for lane in range(min(lanes, end - b)):
                            repaired[b + lane] |= flags[0, lane] > 0
                        around = choose(lost > 0, around * 0, around)
                        continue
            if lifted or not _any(1 - definite, b, end, flags):
                break
            lifted = True
            for lane in range(min(lanes, end - b)):
                if flags[0, lane] > 0:
                    repaired[b + lane] |= _repaired(S, factor, lane, m, margin, repair)
        _put(weight, 0, around)
        for i in range(n):
            _put(x, i, most(_moved(mean, K, error, i, m, b), lower[i]))
        _write(x, post_mean, b, end)
        _write(A, post_covariance, b, end)
        _write(error, innovation, b, end)
        _write(S, own, b, end)
        _write(K, gain, b, end)
        _write(weight, centre, b, end)


@piece
def _moved(mean, K, error, i, m, b):  # type: ignore[no-untyped-def]
    state = at_row(mean, i, b)
    for c in range(m):
        state += _own(K, i * m + c) * _own(error, c)
    return state


@piece
def _spread(expected, points, mean, y, b, rule, error, spread, deviation):  # type: ignore[no-untyped-def]
    """Innovation, and how far points lie from the mean and what is expected at them from its own; 0 where not measured."""
    count, m = expected.shape[:2]
    n = mean.shape[0]
    for i in range(m):
        z = at_row(y, i, b)
        centre = _deviations(expected, b, m, rule, spread, i)
        _put(error, i, choose(z == z, z - centre, 0.0))
        for s in range(count):
            _put(spread, s * m + i, choose(z == z, _own(spread, s * m + i), 0.0))
    for s in range(count):
        for i in range(n):
            _put(deviation, s * n + i, at_row(points, s * n + i, b) - at_row(mean, i, b))


@piece
def _joint(spread, deviation, centre, rule, y, noise, b, n, cross, own, factor):  # type: ignore[no-untyped-def]
    """Covariance of states with what is expected, and of that with noise, with its factor; 1 where it is positive definite, else 0."""
    m = y.shape[0]
    half = rule.dtype.type(0.5)
    for i in range(n):
        for j in range(m):
            _put(cross, i * m + j, _weighted(deviation, i, n, spread, j, m, rule, centre))
    for i in range(m):
        for j in range(i + 1):
            one = at_row(y, i, b)
            other = at_row(y, j, b)
            bare = _weighted(spread, i, m, spread, j, m, rule, centre)
            noisy = bare + half * (at_row(noise, i * m + j, b) + at_row(noise, j * m + i, b))
            alone = bare + 1 if i == j else bare
            value = choose(one == one, choose(other == other, noisy, alone), alone)
            _put(own, i * m + j, value)
            _put(own, j * m + i, value)
    return _cholesky(own, factor, m)


@piece
def _posterior(covariance, b, cross, factor, gain, post_covariance):  # type: ignore[no-untyped-def]
    """Gain cross S⁻¹, by the factor of S, and the covariance that is left."""
    n = covariance.shape[0]
    m = cross.shape[0] // n
    half = cross.dtype.type(0.5)
    for i in range(n):
        _solve(factor, cross, i * m, m, gain)
    for i in range(n):
        for j in range(i + 1):
            left = half * (at_row(covariance, i * n + j, b) + at_row(covariance, j * n + i, b))
            for c in range(m):
                taken = _own(gain, i * m + c) * _own(cross, j * m + c) + _own(
                    gain, j * m + c
                ) * _own(cross, i * m + c)
                left -= half * taken
            _put(post_covariance, i * n + j, left)
            _put(post_covariance, j * n + i, left)


@piece
def _solve(factor, given, at, m, solved):  # type: ignore[no-untyped-def]
    """S⁻¹ times the m rows of ``given`` from ``at`` on, by the factor of S, into those of ``solved``."""
    for j in range(m):
        left = _own(given, at + j)
        for c in range(j):
            left -= _own(factor, j * m + c) * _own(solved, at + c)
        _put(solved, at + j, left / _own(factor, j * m + j))
    for j in range(m - 1, -1, -1):
        left = _own(solved, at + j)
        for c in range(j + 1, m):
            left -= _own(factor, c * m + j) * _own(solved, at + c)
        _put(solved, at + j, left / _own(factor, j * m + j))


@compiled
def update_adjoint(  # type: ignore[no-untyped-def]
    mean, points, expected, y, rules, kept, post_bars, prior_bars, other_bars, first, end
):
    """Adjoint of `update_of`; writes gradients of mean and covariance before, and of points, what is expected, noise and measurements."""
    (rule, lower, _, _) = rules
    (innovation, own, gain, centre) = kept
    (post_mean_bar, post_covariance_bar) = post_bars
    (mean_bar, covariance_bar) = prior_bars
    (points_bar, expected_bar, noise_bar, y_bar) = other_bars
    count, m = expected.shape[:2]
    n = mean.shape[0]
    half = rule.dtype.type(0.5)
    two = rule.dtype.type(2.0)
    off = _rows(m, mean)
    spread = _rows(count * m, mean)
    deviation = _rows(count * n, mean)
    error = _rows(m, mean)
    P = _rows(n * n, mean)
    S = _rows(m * m, mean)
    K = _rows(n * m, mean)
    factor = _rows(m * m, mean)
    solved = _rows(m, mean)
    pulled = _rows(m, mean)
    through = _rows(n, mean)
    cross_bar = _rows(n * m, mean)
    own_bar = _rows(m * m, mean)
    R_bar = _rows(m * m, mean)
    x_bar = _rows(n, mean)
    z_bar = _rows(m, mean)
    V_bar = _rows(count * n, mean)
    E_bar = _rows(count * m, mean)
    for b in range(first, end, width(mean)):
        _spread(expected, points, mean, y, b, rule, off, spread, deviation)
        _read(innovation, error, b)
        _read(own, S, b)
        _read(gain, K, b)
        around = at_row(centre, 0, b)
        for i in range(n):
            state = _moved(mean, K, error, i, m, b)
            _put(through, i, choose(state >= lower[i], at_row(post_mean_bar, i, b), state * 0))
            for j in range(n):
                _put(
                    P,
                    i * n + j,
                    half
                    * (
                        at_row(post_covariance_bar, i * n + j, b)
                        + at_row(post_covariance_bar, j * n + i, b)
                    ),
                )
        _cholesky(S, factor, m)
        _solve(factor, error, 0, m, solved)
        for c in range(m):  # pulled = Kᵀ m̄, the gradient of the innovation
            pull = _own(through, 0) * 0
            known = at_row(y, c, b)
            for i in range(n):
                pull += _own(K, i * m + c) * _own(through, i)
            _put(pulled, c, pull)
            _put(z_bar, c, choose(known == known, pull, pull * 0))
        for i in range(n):
            for c in range(m):
                bar = _own(through, i) * _own(solved, c)
                for j in range(n):
                    bar -= two * _own(P, i * n + j) * _own(K, j * m + c)
                _put(cross_bar, i * m + c, bar)
        for c in range(m):
            for d in range(m):
                bar = -half * (
                    _own(pulled, c) * _own(solved, d) + _own(pulled, d) * _own(solved, c)
                )
                for i in range(n):
                    for j in range(n):
                        bar += _own(K, i * m + c) * _own(P, i * n + j) * _own(K, j * m + d)
                _put(own_bar, c * m + d, bar)
                one = at_row(y, c, b)
                other = at_row(y, d, b)
                _put(
                    R_bar,
                    c * m + d,
                    choose(one == one, choose(other == other, bar, bar * 0), bar * 0),
                )
        for i in range(n):
            left = _own(through, i)
            for s in range(count):
                bar = _own(through, i) * 0
                for c in range(m):
                    bar += _own(cross_bar, i * m + c) * _own(spread, s * m + c)
                bar = around * bar if s == 0 else rule[3] * bar
                _put(V_bar, s * n + i, bar)
                left -= bar
            _put(x_bar, i, left)
        for c in range(m):
            known = at_row(y, c, b)
            left = choose(known == known, -_own(pulled, c), _own(pulled, c) * 0)
            for s in range(count):
                bar = _own(pulled, c) * 0
                for i in range(n):
                    bar += _own(cross_bar, i * m + c) * _own(deviation, s * n + i)
                for d in range(m):
                    bar += two * _own(own_bar, c * m + d) * _own(spread, s * m + d)
                bar = choose(known == known, around * bar if s == 0 else rule[3] * bar, 0.0)
                _put(E_bar, s * m + c, bar)
                left -= bar
            for s in range(count):
                _put(
                    E_bar,
                    s * m + c,
                    _own(E_bar, s * m + c) + (rule[1] if s == 0 else rule[3]) * left,
                )
        _write(x_bar, mean_bar, b, end)
        _write(P, covariance_bar, b, end)
        _write(V_bar, points_bar, b, end)
        _write(E_bar, expected_bar, b, end)
        _write(R_bar, noise_bar, b, end)
        _write(z_bar, y_bar, b, end)


@piece
def _cholesky(A, L, n):  # type: ignore[no-untyped-def]
    """Lower factors of matrices (n · n, W) into L; 1 in lanes where one is positive definite, else 0."""
    nothing = _own(A, 0) * 0
    definite = choose(nothing == 0, nothing + 1, 0.0)
    nothing = definite * 0
    for j in range(n):
        left = _own(A, j * n + j)
        for k in range(j):
            left -= _own(L, j * n + k) * _own(L, j * n + k)
        definite = choose(left > 0, definite, 0.0)
        pivot = root(left)
        nothing += pivot * 0
        _put(L, j * n + j, pivot)
        for i in range(j):
            _put(L, i * n + j, nothing * 0)
        for i in range(j + 1, n):
            left = _own(A, i * n + j)
            for k in range(j):
                left -= _own(L, i * n + k) * _own(L, j * n + k)
            left = left / pivot
            nothing += left * 0
            _put(L, i * n + j, left)
    return choose(nothing == 0, definite, 0.0)


@compiled
def _repaired(A, L, lane, n, margin, repair):  # type: ignore[no-untyped-def]
    """Lift the matrix (n · n, W) of a lane and write its factor, or NaN where that fails; whether its values were finite."""
    own = np.empty((n, n), A.dtype)
    factor = np.zeros((n, n), A.dtype)
    for i in range(n):
        for j in range(n):
            own[i, j] = A[i * n + j, lane]
    finite = np.isfinite(own).all()
    sound = repair and finite
    if sound:
        eigenvalues = np.linalg.eigvalsh(own)
        lift = margin * np.abs(eigenvalues).max() - eigenvalues[0]
        for i in range(n):
            own[i, i] += lift
        sound = _cholesky_of_one(own, factor)
    for i in range(n):
        for j in range(n):
            A[i * n + j, lane] = own[i, j] if sound else np.nan
            L[i * n + j, lane] = factor[i, j] if sound else np.nan
    return finite


@compiled
def _cholesky_of_one(A, L):  # type: ignore[no-untyped-def]
    """Lower factor of a matrix into L, zeros at first; whether it is positive definite."""
    n = A.shape[0]
    for j in range(n):
        total = A[j, j]
        for k in range(j):
            total -= L[j, k] * L[j, k]
        if not total > 0:
            return False
        pivot = np.sqrt(total)
        L[j, j] = pivot
        for i in range(j + 1, n):
            total = A[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = total / pivot
    return np.isfinite(L).all()


@piece
def _cholesky_adjoint(L, L_bar, inner, A_bar, n):  # type: ignore[no-untyped-def]
    """A_bar += sym(L⁻ᵀ Φ(Lᵀ L_bar) L⁻¹), Φ the lower triangle with half the diagonal (Murray 2016, Eq. 10)."""
    half = L.dtype.type(0.5)
    for i in range(n):
        for j in range(n):
            bar = _own(L, 0) * 0
            if j <= i:
                for k in range(i, n):
                    bar += _own(L, k * n + i) * _own(L_bar, k * n + j)
            _put(inner, i * n + j, bar * half if i == j else bar)
    for j in range(n):  # Lᵀ X = Φ
        for i in range(n - 1, -1, -1):
            bar = _own(inner, i * n + j)
            for k in range(i + 1, n):
                bar -= _own(L, k * n + i) * _own(inner, k * n + j)
            _put(inner, i * n + j, bar / _own(L, i * n + i))
    for i in range(n):  # Y L = X
        for j in range(n - 1, -1, -1):
            bar = _own(inner, i * n + j)
            for k in range(j + 1, n):
                bar -= _own(inner, i * n + k) * _own(L, k * n + j)
            _put(inner, i * n + j, bar / _own(L, j * n + j))
    for i in range(n):
        for j in range(n):
            _put(
                A_bar,
                i * n + j,
                _own(A_bar, i * n + j) + half * (_own(inner, i * n + j) + _own(inner, j * n + i)),
            )
