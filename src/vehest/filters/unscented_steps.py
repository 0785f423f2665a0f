"""One step of the unscented filter over many sequences, compiled, and its adjoint.

Flow of one sample k (forward), with the function that computes each arrow:

    x, P of sample k - 1 --points_of--> points --model--> moved --moments_of--> x, P before y[k]
    x, P before y[k] --points_of--> points --model--> expected
                     --gate_of, update_of--> x, P after y[k]

With sigma points X_s, weights w_s (means) and v_s (covariances), and L Lᵀ = P:

    points_of    X_0 = x,  X_{1+j} = x + γ L_j,  X_{1+n+j} = x - γ L_j
    moments_of   x = Σ w_s f(X_s),  P = Σ v_s (f(X_s) - x)(f(X_s) - x)ᵀ + Q
    update_of    ŷ = Σ w_s h(X_s),  S = Σ v_s e_s e_sᵀ + R,  C = Σ v_s d_s e_sᵀ,  K = C S⁻¹,
                 x⁺ = x + K (y - ŷ),  P⁺ = P - K Cᵀ,  with e_s = h(X_s) - ŷ and d_s = X_s - x

The adjoint of each function is beside it (``_bar``: gradient of the loss with respect to a value).
It receives the values that its function received and adds to gradients unless it says otherwise.

Layout: sequences are the last dimension, so that one vector instruction works on several of them:
means (n, B), covariances (n, n, B), sigma points (2n + 1, n, B), expected measurements
(2n + 1, m, B). A function works on the sequences from ``first`` to ``end``, as many at once as a
vector of `vehest.lanes` has elements. Vectors are read beyond ``end`` and never written there,
hence arrays are followed by room for one vector (`room`).

Common arguments: ``rules`` = (row [spread γ, centre_mean, centre_covariance, outer_weight] of a
`SigmaRule`, smallest possible value of each state, margin of a repair, whether covariances are
repaired); ``drawn`` = (sigma points, Cholesky factors, the covariances that were factored).

Order of sums: over sigma points 1 … 2n in order, then the mean point; over states and measurements
in order of their index, as for single numbers. Hence a sequence has the same digits whichever
others are computed beside it.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
from numba import types

from vehest.filters.gating import refuses
from vehest.lanes import VECTOR_BYTES, choose, load_unfused, most, root, store, store_some, width

# decorator of functions that Python calls
compiled = numba.njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
ARGUMENTS: dict[str, Any] = {
    "rules": (1, 1, 0, types.boolean),
    "drawn": (3, 3, 3),
    "post": (2, 3),
    "update_results": (2, 3, 3, 1),
    "post_bars": (2, 3),
    "prior_bars": (2, 3),
    "other_bars": (3, 3, 3, 2),
    "repaired": types.boolean[::1],
    "is_gated_out": types.boolean[:, ::1],
    "refused": types.int64[:, ::1],
    **dict.fromkeys(("mean", "mean_bar", "y"), 2),
    **dict.fromkeys(("first", "end", "patience"), types.intp),
    "limit": 0,
}
"""Dimensions of arrays, 0 of a number, or the type, of what steps are called with; others have
three dimensions.
"""
# decorator of functions that only compiled ones call, inlined there
piece = numba.njit(
    forceinline=True,
    no_cpython_wrapper=True,
    no_cfunc_wrapper=True,
    error_model="numpy",
    boundscheck=False,
)


def room(shape: tuple[int, ...], dtype: Any, make: Any = np.empty) -> Any:
    """Allocate an array followed by room for one vector, which may be read beyond its end.

    Parameters
    ----------
    shape : tuple[int, ...]
        Shape of the array, in C order.
    dtype : Any
        Element type.
    make : Any, default np.empty
        Function of a length and a type that allocates, such as ``np.zeros``.
    """
    count = math.prod(shape)
    size = np.dtype(dtype).itemsize
    return make(count + VECTOR_BYTES // size, dtype)[:count].reshape(shape)


def types_of(step: Any, dtype: Any) -> tuple[Any, ...]:
    """numba types of a step's arguments for arrays of a precision.

    Parameters
    ----------
    step : Any
        Compiled function; its argument names are looked up in `ARGUMENTS`, and those that are not
        listed have three dimensions.
    dtype : Any
        ``np.float32`` or ``np.float64``.
    """
    number = numba.from_dtype(np.dtype(dtype))

    def kind(of: Any) -> Any:
        if isinstance(of, tuple):
            return types.BaseTuple.from_types(tuple(map(kind, of)))
        return (types.Array(number, of, "C") if of else number) if isinstance(of, int) else of

    names = step.py_func.__code__.co_varnames[: step.py_func.__code__.co_argcount]
    return tuple(kind(ARGUMENTS.get(name, 3)) for name in names)


@piece
def at_row(values, row, b):
    """Vector of a row (the indices before the last one, as one) from sequence b on."""
    return load_unfused(values, row * values.shape[values.ndim - 1] + b)


@piece
def _scratch_row(rows, row):
    """Vector of one row of scratch memory, (R, W)."""
    return load_unfused(rows, row * rows.shape[1])


@piece
def _set_scratch_row(rows, row, vector):
    """Write a vector into one row of scratch memory, (R, W)."""
    store(rows, row * rows.shape[1], vector)


@piece
def _rows(count, like):
    """Scratch memory of ``count`` vectors of the type of ``like``, (count, W)."""
    return np.empty((count, width(like)), like.dtype)


@piece
def _read(values, rows, b):
    """Copy all rows of the sequences from b on into scratch memory."""
    for row in range(rows.shape[0]):
        _set_scratch_row(rows, row, at_row(values, row, b))


@piece
def _write(rows, out, b, end):
    """Copy scratch memory to the sequences from b to ``end``, at most one vector of them."""
    stride = out.shape[out.ndim - 1]
    for row in range(rows.shape[0]):
        store_some(out, row * stride + b, _scratch_row(rows, row), end - b)


@piece
def _is_any_positive(condition, b, end, scratch):
    """Whether a vector is positive for a sequence from b to ``end``; ``scratch`` (1, W) becomes the
    vector.
    """
    store(scratch, 0, condition)
    is_any_positive = False
    for lane in range(min(end - b, scratch.shape[1])):
        is_any_positive |= scratch[0, lane] > 0
    return is_any_positive


@compiled
def points_of(mean, state_covariance, rules, drawn, repaired, first, end):
    """Draw sigma points X_s = x ± γ L_j and write ``drawn``: points, factors L, covariances.

    A covariance that is not positive definite is repaired first (`_repaired`); ``repaired`` (B,)
    says where.

    For each sequence L Lᵀ = P, and X_0 = x, X_{1+j} = x + γ L_j, X_{1+n+j} = x - γ L_j, each
    component at least the smallest possible value of its state. A sequence without a factor gets
    NaN points.

    Parameters
    ----------
    mean : array
        x, (n, B).
    state_covariance : array
        P, (n, n, B).
    rules, drawn
        See the module.
    repaired : array
        Flags (B,), written from ``first`` to ``end``.
    """
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
        _read(state_covariance, A, b)
        lost = 1 - _cholesky(A, L, n)
        for lane in range(min(lanes, end - b)):
            repaired[b + lane] = False
        if _is_any_positive(lost, b, end, flags):
            for lane in range(min(lanes, end - b)):
                if flags[0, lane] > 0:
                    repaired[b + lane] = _repaired(A, L, lane, n, margin, repair)
        nothing = _scratch_row(L, 0) - _scratch_row(L, 0)  # NaN where a sequence is lost
        for i in range(n):
            c = at_row(mean, i, b)
            _set_scratch_row(P, i, choose(nothing == 0, most(c, lower[i]), nothing))
            for j in range(n):
                offset = rule[0] * _scratch_row(L, i * n + j) if j <= i else nothing
                _set_scratch_row(
                    P, (1 + j) * n + i, choose(nothing == 0, most(c + offset, lower[i]), nothing)
                )
                _set_scratch_row(
                    P,
                    (1 + n + j) * n + i,
                    choose(nothing == 0, most(c - offset, lower[i]), nothing),
                )
        _write(A, covariance, b, end)
        _write(L, factor, b, end)
        _write(P, points, b, end)


@compiled
def points_adjoint(mean, factor, rules, points_bar, mean_bar, covariance_bar, first, end):
    """Adjoint of `points_of`; what a repair added counts as constant.

    x̄ += Σ X̄_s,  L̄_j = γ (X̄_{1+j} - X̄_{1+n+j}),  P̄ += adjoint of the Cholesky factor
    (`_cholesky_adjoint`). A state at its lower bound passes no gradient.

    Parameters
    ----------
    mean, factor : array
        x (n, B) and L (n, n, B) that `points_of` received and wrote.
    points_bar : array
        X̄, (2n + 1, n, B).
    mean_bar, covariance_bar : array
        x̄ (n, B) and P̄ (n, n, B), to which is added.
    rules, first, end
        See the module.
    """
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
        nothing = _scratch_row(L, 0) * 0
        for i in range(n):
            c = at_row(mean, i, b)
            bar = at_row(mean_bar, i, b)
            bar = choose(c >= lower[i], bar + at_row(points_bar, i, b), bar)
            for j in range(n):
                offset = rule[0] * _scratch_row(L, i * n + j) if j <= i else nothing
                up = choose(c + offset >= lower[i], at_row(points_bar, (1 + j) * n + i, b), nothing)
                down = choose(
                    c - offset >= lower[i], at_row(points_bar, (1 + n + j) * n + i, b), nothing
                )
                bar += up + down
                _set_scratch_row(below, i * n + j, rule[0] * (up - down) if j <= i else nothing)
            _set_scratch_row(x_bar, i, bar)
        _cholesky_adjoint(L, below, inner, A_bar, n)
        _write(x_bar, mean_bar, b, end)
        _write(A_bar, covariance_bar, b, end)


@piece
def _deviations(values, b, m, rule, deviation, i):
    """Write deviations of values from their weighted mean, and return the mean.

    Parameters
    ----------
    values : array
        (S, m, B); component i of all S points is used, for the sequences from b on.
    deviation : array
        Scratch (S · m, W), of which the rows of component i are written.
    i : int
        Component.

    Returns
    -------
    vector
        Σ w_s V_s,i. The outer points are summed in order first; the mean point is added last.
    """
    count = values.shape[0]
    around = at_row(values, 0, b) * 0
    for s in range(1, count):
        around += at_row(values, s * m + i, b)
    centre = rule[1] * at_row(values, i, b) + rule[3] * around
    for s in range(count):
        _set_scratch_row(deviation, s * m + i, at_row(values, s * m + i, b) - centre)
    return centre


@piece
def _weighted(first_deviation, i, n, second_deviation, j, m, rule, centre):
    """Weighted product of deviations, i of (S · n, W) with j of (S · m, W); the mean point has the
    weight ``centre``.
    """
    result = _scratch_row(first_deviation, 0) * 0
    for s in range(1, first_deviation.shape[0] // n):
        result += _scratch_row(first_deviation, s * n + i) * _scratch_row(
            second_deviation, s * m + j
        )
    return rule[3] * result + centre * _scratch_row(first_deviation, i) * _scratch_row(
        second_deviation, j
    )


@compiled
def moments_of(values, noise, rules, mean, covariance, first, end):
    """Weighted mean x = Σ w_s V_s and covariance P = Σ v_s (V_s - x)(V_s - x)ᵀ + (Q + Qᵀ)/2.

    Each component of the mean is at least the smallest possible value of its state; deviations are
    from the mean before that bound.

    Parameters
    ----------
    values : array
        V, moved points, (2n + 1, n, B).
    noise : array
        Q, (n, n, B); only its symmetric part counts.
    mean, covariance : array
        (n, B) and (n, n, B), which are written.
    """
    (count, n) = values.shape[:2]
    (rule, lower, _, _) = rules
    half = rule.dtype.type(0.5)
    deviation = _rows(count * n, values)
    x = _rows(n, values)
    A = _rows(n * n, values)
    for b in range(first, end, width(values)):
        for i in range(n):
            _set_scratch_row(x, i, most(_deviations(values, b, n, rule, deviation, i), lower[i]))
        for i in range(n):
            for j in range(i + 1):
                spread = _weighted(deviation, i, n, deviation, j, n, rule, rule[2])
                spread += half * (at_row(noise, i * n + j, b) + at_row(noise, j * n + i, b))
                _set_scratch_row(A, i * n + j, spread)
                _set_scratch_row(A, j * n + i, spread)
        _write(x, mean, b, end)
        _write(A, covariance, b, end)


@compiled
def moments_adjoint(values, rules, mean_bar, covariance_bar, values_bar, noise_bar, first, end):
    """Adjoint of `moments_of`; writes ``values_bar`` and ``noise_bar``.

    Q̄ = (P̄ + P̄ᵀ)/2,  D̄_s = 2 v_s Q̄ D_s with D_s = V_s - x,  V̄_s = D̄_s + w_s (x̄ - Σ_r D̄_r).

    A mean at its lower bound passes no gradient. Sums over r run over all points in order.

    Parameters
    ----------
    values : array
        V, (2n + 1, n, B), as `moments_of` received them.
    mean_bar, covariance_bar : array
        x̄ (n, B) and P̄ (n, n, B).
    values_bar, noise_bar : array
        V̄ (2n + 1, n, B) and Q̄ (n, n, B), which are written.
    """
    (count, n) = values.shape[:2]
    (rule, lower, _, _) = rules
    half = rule.dtype.type(0.5)
    two = rule.dtype.type(2.0)
    deviation = _rows(count * n, values)
    V_bar = _rows(count * n, values)
    through = _rows(n, values)
    symmetric_bar = _rows(n * n, values)
    for b in range(first, end, width(values)):
        for i in range(n):
            centre = _deviations(values, b, n, rule, deviation, i)
            _set_scratch_row(
                through, i, choose(centre >= lower[i], at_row(mean_bar, i, b), centre * 0)
            )
            for j in range(n):
                _set_scratch_row(
                    symmetric_bar,
                    i * n + j,
                    half
                    * (at_row(covariance_bar, i * n + j, b) + at_row(covariance_bar, j * n + i, b)),
                )
        for s in range(count):
            weight = two * (rule[2] if s == 0 else rule[3])
            for i in range(n):
                bar = _scratch_row(through, 0) * 0
                for j in range(n):
                    bar += _scratch_row(symmetric_bar, i * n + j) * _scratch_row(
                        deviation, s * n + j
                    )
                _set_scratch_row(V_bar, s * n + i, weight * bar)
        for i in range(n):
            mean_gradient = _scratch_row(through, i)
            for s in range(count):
                mean_gradient -= _scratch_row(V_bar, s * n + i)
            for s in range(count):
                _set_scratch_row(
                    V_bar,
                    s * n + i,
                    _scratch_row(V_bar, s * n + i)
                    + (rule[1] if s == 0 else rule[3]) * mean_gradient,
                )
        _write(V_bar, values_bar, b, end)
        _write(symmetric_bar, noise_bar, b, end)


@compiled
def gate_of(expected, noise, rules, limit, patience, y, refused, is_gated_out, first, end):
    """Mark measurements that the gate refuses: NaN in ``y``, true in ``is_gated_out``, (m, B) each.

    ``refused`` (B, m) counts how long each has been refused; see `Gate`.

    A negative weight of the mean point cannot make a variance smaller than that of the noise.

    Parameters
    ----------
    expected : array
        Measurements at the points, (2n + 1, m, B).
    noise : array
        R, (m, m, B), of which the diagonal counts.
    limit, patience
        See `refuses`.
    """
    count, m = expected.shape[:2]
    _, centre_mean, centre_covariance, outer_weight = rules[0]
    for b in range(first, end):
        for i in range(m):
            is_gated_out[i, b] = False
            if y[i, b] != y[i, b]:
                continue
            total = expected[0, i, b] * 0
            for s in range(1, count):
                total += expected[s, i, b]
            centre = centre_mean * expected[0, i, b] + outer_weight * total
            total = centre * 0
            for s in range(1, count):
                total += (expected[s, i, b] - centre) * (expected[s, i, b] - centre)
            total = outer_weight * total + centre_covariance * (expected[0, i, b] - centre) * (
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
                is_gated_out[i, b] = True


@compiled
def update_of(mean, drawn, expected, y, noise, rules, post, update_results, repaired, first, end):
    """Update the state with a measurement; an element of ``y`` that is NaN was not measured.

    K = C S⁻¹,  x⁺ = x + K (y - ŷ),  P⁺ = P - K Cᵀ (see the module).

    Written are ``post`` (mean, covariance) and ``update_results``: innovation (m, B), its
    covariance S (m, m, B), gain K (n, m, B), and the weight of the mean point in covariances (B,),
    which is 0 where a negative weight took the definiteness of P⁺. ``repaired`` is set where S is
    repaired.

    At most three attempts are made for a vector of sequences: with the rule's weights; with a
    weight of 0 for the mean point in those sequences in which a negative one took the definiteness
    of P⁺; with S lifted to be positive definite (`_repaired`).

    Parameters
    ----------
    mean : array
        x, (n, B), before the measurement.
    drawn : tuple
        Points (2n + 1, n, B), factors, and P (n, n, B), as `points_of` wrote them.
    expected : array
        h(X_s), (2n + 1, m, B).
    y : array
        Measurements, (m, B).
    noise : array
        R, (m, m, B); only its symmetric part counts.
    """
    (rule, lower, margin, repair) = rules
    (points, _, covariance) = drawn
    (post_mean, post_covariance) = post
    (innovation, innovation_covariance, gain, centre) = update_results
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
                if _is_any_positive(lost, b, end, flags):
                    nothing = lost * 0
                    for row in range(m * m):
                        nothing += _scratch_row(S, row) * 0
                    for row in range(n * n):
                        nothing += at_row(covariance, row, b) * 0
                    lost = choose(nothing == 0, lost, 0.0)
                    if _is_any_positive(lost, b, end, flags):
                        for lane in range(min(lanes, end - b)):
                            repaired[b + lane] |= flags[0, lane] > 0
                        around = choose(lost > 0, around * 0, around)
                        continue
            if lifted or not _is_any_positive(1 - definite, b, end, flags):
                break
            lifted = True
            for lane in range(min(lanes, end - b)):
                if flags[0, lane] > 0:
                    repaired[b + lane] |= _repaired(S, factor, lane, m, margin, repair)
        _set_scratch_row(weight, 0, around)
        for i in range(n):
            _set_scratch_row(x, i, most(_moved(mean, K, error, i, m, b), lower[i]))
        _write(x, post_mean, b, end)
        _write(A, post_covariance, b, end)
        _write(error, innovation, b, end)
        _write(S, innovation_covariance, b, end)
        _write(K, gain, b, end)
        _write(weight, centre, b, end)


@piece
def _moved(mean, K, error, i, m, b):
    """State i after the update, before its lower bound: x_i + Σ_c K_ic e_c."""
    state = at_row(mean, i, b)
    for c in range(m):
        state += _scratch_row(K, i * m + c) * _scratch_row(error, c)
    return state


@piece
def _spread(expected, points, mean, y, b, rule, error, spread, deviation):
    """Write innovation, deviations e_s of expected measurements and d_s of points; 0 where not
    measured.
    """
    count, m = expected.shape[:2]
    n = mean.shape[0]
    for i in range(m):
        z = at_row(y, i, b)
        centre = _deviations(expected, b, m, rule, spread, i)
        _set_scratch_row(error, i, choose(z == z, z - centre, 0.0))
        for s in range(count):
            _set_scratch_row(
                spread, s * m + i, choose(z == z, _scratch_row(spread, s * m + i), 0.0)
            )
    for s in range(count):
        for i in range(n):
            _set_scratch_row(
                deviation, s * n + i, at_row(points, s * n + i, b) - at_row(mean, i, b)
            )


@piece
def _joint(spread, deviation, centre, rule, y, noise, b, n, cross, innovation_covariance, factor):
    """Write C = Σ v_s d_s e_sᵀ, S = Σ v_s e_s e_sᵀ + R and the factor of S.

    Returns 1 in lanes in which S is positive definite, else 0.

    Rows and columns of S that belong to a measurement that is NaN are those of the identity, and
    its columns of C are 0, so that it changes nothing.
    """
    m = y.shape[0]
    half = rule.dtype.type(0.5)
    for i in range(n):
        for j in range(m):
            _set_scratch_row(
                cross, i * m + j, _weighted(deviation, i, n, spread, j, m, rule, centre)
            )
    for i in range(m):
        for j in range(i + 1):
            y_i = at_row(y, i, b)
            y_j = at_row(y, j, b)
            bare = _weighted(spread, i, m, spread, j, m, rule, centre)
            noisy = bare + half * (at_row(noise, i * m + j, b) + at_row(noise, j * m + i, b))
            alone = bare + 1 if i == j else bare
            value = choose(y_i == y_i, choose(y_j == y_j, noisy, alone), alone)
            _set_scratch_row(innovation_covariance, i * m + j, value)
            _set_scratch_row(innovation_covariance, j * m + i, value)
    return _cholesky(innovation_covariance, factor, m)


@piece
def _posterior(covariance, b, cross, factor, gain, post_covariance):
    """Write the gain K = C S⁻¹, by the factor of S, and P⁺ = P - (K Cᵀ + C Kᵀ)/2."""
    n = covariance.shape[0]
    m = cross.shape[0] // n
    half = cross.dtype.type(0.5)
    for i in range(n):
        _solve(factor, cross, i * m, m, gain)
    for i in range(n):
        for j in range(i + 1):
            posterior = half * (at_row(covariance, i * n + j, b) + at_row(covariance, j * n + i, b))
            for c in range(m):
                reduction = _scratch_row(gain, i * m + c) * _scratch_row(
                    cross, j * m + c
                ) + _scratch_row(gain, j * m + c) * _scratch_row(cross, i * m + c)
                posterior -= half * reduction
            _set_scratch_row(post_covariance, i * n + j, posterior)
            _set_scratch_row(post_covariance, j * n + i, posterior)


@piece
def _solve(factor, right_sides, at, m, solved):
    """Solve S x = b by the factor of S, for b the m rows of ``right_sides`` from ``at`` on.

    Forward substitution with L, then backward substitution with Lᵀ; columns in order of their
    index.
    """
    for j in range(m):
        remainder = _scratch_row(right_sides, at + j)
        for c in range(j):
            remainder -= _scratch_row(factor, j * m + c) * _scratch_row(solved, at + c)
        _set_scratch_row(solved, at + j, remainder / _scratch_row(factor, j * m + j))
    for j in range(m - 1, -1, -1):
        remainder = _scratch_row(solved, at + j)
        for c in range(j + 1, m):
            remainder -= _scratch_row(factor, c * m + j) * _scratch_row(solved, at + c)
        _set_scratch_row(solved, at + j, remainder / _scratch_row(factor, j * m + j))


@compiled
def update_adjoint(
    mean, points, expected, y, rules, update_results, post_bars, prior_bars, other_bars, first, end
):
    """Adjoint of `update_of`; writes gradients of x, P, points, expected measurements, R and y.

    With M = (P̄⁺ + P̄⁺ᵀ)/2, e = y - ŷ, s = S⁻¹ e and p = Kᵀ x̄⁺:

        ē = ȳ = p,  C̄ = x̄⁺ sᵀ - 2 M K,  S̄ = R̄ = -(p sᵀ + s pᵀ)/2 + Kᵀ M K,  P̄ = M
        d̄_s = v_s C̄ e_s,  ē_s = v_s (C̄ᵀ d_s + 2 S̄ e_s)

    Both d̄_s and ē_s pass to X_s, x and h(X_s) through their means.
    """
    (rule, lower, _, _) = rules
    (innovation, innovation_covariance, gain, centre) = update_results
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
    S_bar = _rows(m * m, mean)
    R_bar = _rows(m * m, mean)
    x_bar = _rows(n, mean)
    z_bar = _rows(m, mean)
    V_bar = _rows(count * n, mean)
    E_bar = _rows(count * m, mean)
    for b in range(first, end, width(mean)):
        _spread(expected, points, mean, y, b, rule, off, spread, deviation)
        _read(innovation, error, b)
        _read(innovation_covariance, S, b)
        _read(gain, K, b)
        around = at_row(centre, 0, b)
        for i in range(n):
            state = _moved(mean, K, error, i, m, b)
            _set_scratch_row(
                through, i, choose(state >= lower[i], at_row(post_mean_bar, i, b), state * 0)
            )
            for j in range(n):
                _set_scratch_row(
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
            pull = _scratch_row(through, 0) * 0
            measurement = at_row(y, c, b)
            for i in range(n):
                pull += _scratch_row(K, i * m + c) * _scratch_row(through, i)
            _set_scratch_row(pulled, c, pull)
            _set_scratch_row(z_bar, c, choose(measurement == measurement, pull, pull * 0))
        for i in range(n):
            for c in range(m):
                bar = _scratch_row(through, i) * _scratch_row(solved, c)
                for j in range(n):
                    bar -= two * _scratch_row(P, i * n + j) * _scratch_row(K, j * m + c)
                _set_scratch_row(cross_bar, i * m + c, bar)
        for c in range(m):
            for d in range(m):
                bar = -half * (
                    _scratch_row(pulled, c) * _scratch_row(solved, d)
                    + _scratch_row(pulled, d) * _scratch_row(solved, c)
                )
                for i in range(n):
                    for j in range(n):
                        bar += (
                            _scratch_row(K, i * m + c)
                            * _scratch_row(P, i * n + j)
                            * _scratch_row(K, j * m + d)
                        )
                _set_scratch_row(S_bar, c * m + d, bar)
                y_c = at_row(y, c, b)
                y_d = at_row(y, d, b)
                _set_scratch_row(
                    R_bar,
                    c * m + d,
                    choose(y_c == y_c, choose(y_d == y_d, bar, bar * 0), bar * 0),
                )
        for i in range(n):
            remainder = _scratch_row(through, i)
            for s in range(count):
                bar = _scratch_row(through, i) * 0
                for c in range(m):
                    bar += _scratch_row(cross_bar, i * m + c) * _scratch_row(spread, s * m + c)
                bar = around * bar if s == 0 else rule[3] * bar
                _set_scratch_row(V_bar, s * n + i, bar)
                remainder -= bar
            _set_scratch_row(x_bar, i, remainder)
        for c in range(m):
            measurement = at_row(y, c, b)
            remainder = choose(
                measurement == measurement, -_scratch_row(pulled, c), _scratch_row(pulled, c) * 0
            )
            for s in range(count):
                bar = _scratch_row(pulled, c) * 0
                for i in range(n):
                    bar += _scratch_row(cross_bar, i * m + c) * _scratch_row(deviation, s * n + i)
                for d in range(m):
                    bar += two * _scratch_row(S_bar, c * m + d) * _scratch_row(spread, s * m + d)
                bar = choose(
                    measurement == measurement, around * bar if s == 0 else rule[3] * bar, 0.0
                )
                _set_scratch_row(E_bar, s * m + c, bar)
                remainder -= bar
            for s in range(count):
                _set_scratch_row(
                    E_bar,
                    s * m + c,
                    _scratch_row(E_bar, s * m + c) + (rule[1] if s == 0 else rule[3]) * remainder,
                )
        _write(x_bar, mean_bar, b, end)
        _write(P, covariance_bar, b, end)
        _write(V_bar, points_bar, b, end)
        _write(E_bar, expected_bar, b, end)
        _write(R_bar, noise_bar, b, end)
        _write(z_bar, y_bar, b, end)


@piece
def _cholesky(A, L, n):
    """Write lower factors L of matrices A = L Lᵀ, (n · n, W).

    Returns 1 in lanes in which the matrix is positive definite, else 0.

    Column by column, with sums over earlier columns in order. Where a matrix is not positive
    definite, its factor is incomplete and usually NaN; the upper triangle becomes 0, or NaN.
    """
    nothing = _scratch_row(A, 0) * 0
    definite = choose(nothing == 0, nothing + 1, 0.0)
    nothing = definite * 0
    for j in range(n):
        remainder = _scratch_row(A, j * n + j)
        for k in range(j):
            remainder -= _scratch_row(L, j * n + k) * _scratch_row(L, j * n + k)
        definite = choose(remainder > 0, definite, 0.0)
        pivot = root(remainder)
        nothing += pivot * 0
        _set_scratch_row(L, j * n + j, pivot)
        for i in range(j):
            _set_scratch_row(L, i * n + j, nothing * 0)
        for i in range(j + 1, n):
            remainder = _scratch_row(A, i * n + j)
            for k in range(j):
                remainder -= _scratch_row(L, i * n + k) * _scratch_row(L, j * n + k)
            remainder = remainder / pivot
            nothing += remainder * 0
            _set_scratch_row(L, i * n + j, remainder)
    return choose(nothing == 0, definite, 0.0)


@compiled
def _repaired(A, L, lane, n, margin, repair):
    """Add a multiple of the identity to one lane's matrix (n · n, W) and write its factor.

    The smallest eigenvalue becomes ``margin`` times the largest. Where that fails, or there are no
    repairs, both become NaN. Returns whether the matrix was finite.
    """
    matrix = np.empty((n, n), A.dtype)
    factor = np.zeros((n, n), A.dtype)
    for i in range(n):
        for j in range(n):
            matrix[i, j] = A[i * n + j, lane]
    finite = np.isfinite(matrix).all()
    sound = repair and finite
    if sound:
        eigenvalues = np.linalg.eigvalsh(matrix)
        lift = margin * np.abs(eigenvalues).max() - eigenvalues[0]
        for i in range(n):
            matrix[i, i] += lift
        sound = _cholesky_single(matrix, factor)
    for i in range(n):
        for j in range(n):
            A[i * n + j, lane] = matrix[i, j] if sound else np.nan
            L[i * n + j, lane] = factor[i, j] if sound else np.nan
    return finite


@compiled
def _cholesky_single(A, L):
    """Write the lower factor of one matrix.

    Parameters
    ----------
    A : array
        (n, n), of which the lower triangle is read.
    L : array
        (n, n), zero on entry.

    Returns
    -------
    bool
        Whether A is positive definite and its factor finite; L is incomplete otherwise.
    """
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
def _cholesky_adjoint(L, L_bar, inner, A_bar, n):
    """A_bar += sym(L⁻ᵀ Φ(Lᵀ L_bar) L⁻¹), Φ the lower triangle with half the diagonal (Murray 2016,
    Eq. 10).

    Parameters
    ----------
    L, L_bar : array
        Scratch (n · n, W); only the lower triangle of ``L_bar`` counts.
    inner : array
        Scratch of the same size, which is overwritten.
    A_bar : array
        (n · n, W), symmetric, to which is added.
    """
    half = L.dtype.type(0.5)
    for i in range(n):
        for j in range(n):
            bar = _scratch_row(L, 0) * 0
            if j <= i:
                for k in range(i, n):
                    bar += _scratch_row(L, k * n + i) * _scratch_row(L_bar, k * n + j)
            _set_scratch_row(inner, i * n + j, bar * half if i == j else bar)
    for j in range(n):  # Lᵀ X = Φ
        for i in range(n - 1, -1, -1):
            bar = _scratch_row(inner, i * n + j)
            for k in range(i + 1, n):
                bar -= _scratch_row(L, k * n + i) * _scratch_row(inner, k * n + j)
            _set_scratch_row(inner, i * n + j, bar / _scratch_row(L, i * n + i))
    for i in range(n):  # Y L = X
        for j in range(n - 1, -1, -1):
            bar = _scratch_row(inner, i * n + j)
            for k in range(j + 1, n):
                bar -= _scratch_row(inner, i * n + k) * _scratch_row(L, k * n + j)
            _set_scratch_row(inner, i * n + j, bar / _scratch_row(L, j * n + j))
    for i in range(n):
        for j in range(n):
            _set_scratch_row(
                A_bar,
                i * n + j,
                _scratch_row(A_bar, i * n + j)
                + half * (_scratch_row(inner, i * n + j) + _scratch_row(inner, j * n + i)),
            )
