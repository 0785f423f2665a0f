"""Calibrated half widths of v and β at stated levels, for any family of estimators.

    training ranges -> scale s, domain; validation ranges -> factors q
    Bands (trust.yaml) -> band_rows -> half widths

    half width at level p = q_p · s(x) · w(x)

s is a local scale that training ranges give: s² is a combination, with weights that are not
negative, of the estimator's inputs at the instant and of its estimate; of a filter s² = a (P +
floor²) with its own variance P, and what `vehest.trust.tyre_check` finds is added. q_p is the
level's quantile of |error|/(s w) on validation ranges, each turn or manoeuvre counting once (split
conformal, blocked). w ≥ 1 widens outside the training's domain.

The rule of w was fixed before any of its effects was looked at: with m the 99.9th percentile of |f|
in training, w is the largest of 1 + max(0, |f| - m)/m over the features f, times 2 on a car or tyre
other than those calibrated on.

Order of sums in `band_rows`: over `TERMS` in order. A row needs no other one, so that online and
batch agree to the bit.

Source: Dunn, Wasserman & Ramdas, Distribution-free prediction sets for two-layer hierarchical
models, JASA 118 (544), 2023 (pooling CDFs); Lee, Barber & Willett, Distribution-free inference with
hierarchical data, arXiv:2306.06342, 2023 (mass at infinity); Lei et al., Distribution-free
predictive inference for regression, JASA 113 (523), 2018, Section 5.2 (local scale).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.car import UNKNOWN_CAR, CarValues
from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import UNNAMED_VEHICLE, Recording
from vehest.estimators.kernels.compiling import entry
from vehest.trust.checks import check_channels, check_number, check_numbers
from vehest.trust.guard import columns_of
from vehest.trust.tyre_check import TyreCheck

LEVELS = (0.5, 0.68, 0.9, 0.95)  # coverages, for each of which a band has a factor
CHANNEL_LEVEL = 0.9  # coverage of the channels band_vy and band_sideslip

MIN_RANGES = 10  # validation ranges, from which on each is a block; with fewer, each turn is one
TURN_YAW_RATE = 0.05  # rad/s, at which a turn, and with it a new block, begins
MIN_BLOCK_SECONDS = 2.0  # s; a turn that starts sooner after the last one belongs to the same block

DOMAIN_QUANTILE = 0.999  # quantile of a term's size in training, beyond which bands widen
OTHER_VEHICLE = 2.0  # factor by which a band is wider on another car or tyre
LOWEST_SPEED = 1.0  # m/s, below which β is not resolved
MIN_RELATIVE_SCALE = 0.1  # smallest scale over the root mean square error in training
N_FITS = 20  # iterations of the scale's reweighted least squares, at most

COLUMNS = ("vx", "ax", "ay", "yaw_rate", "steer")  # input channels of which terms are formed
TERMS = ("variance", "one", "vx", "ax", "ay", "yaw_rate_vx", "steer_vx", "vy")
"""Terms of s²: P, 1, vx², ax², ay², (r vx)², (δ vx)², v̂², of those that are there; for β each over
vx². ``variance`` is P.
"""

MAX_FACTOR = 1e6  # largest factor and floor; beyond it a band says nothing
MIN_TERM = 1e-30  # smallest size of a term in training that is not 0, in a file
MAX_TERM = 1e12  # largest size or weight of a term, in a file
FIRST_FEATURE = TERMS.index("vx")  # index of the first term that has a domain
HEAD_LENGTH = 7  # numbers before the weights in a `PackedBands`

# kind of blocks of dependent scores: ranges, or segments from turn to turn
Blocks = Literal["range", "turn"]


@dataclass(frozen=True)
class Quantity:
    """Calibration of the band of one quantity, v or β: scale s and factors q."""

    # term -> weight in s² [m²/s² for v and rad² m²/s² for β, per square of the term's unit]
    weights: dict[str, float]
    floor: float  # smallest s [m/s, or rad]
    factors: tuple[float, ...]  # q of each level, in the order of `LEVELS`
    beyond: tuple[bool, ...]  # whether there are too few blocks for each level (`pooled_quantile`)
    effective_blocks: float  # Kish's effective number of blocks, by the squared scores

    def __post_init__(self) -> None:
        """Raise `DataError` for terms, factors or floors that no calibration leaves."""
        _check_terms("weights", self.weights, 0.0)
        if len(self.factors) != len(LEVELS) or len(self.beyond) != len(LEVELS):
            raise DataError(
                f"factors and beyond must have {len(LEVELS)} values, one a level "
                f"({', '.join(map(str, LEVELS))})"
            )
        check_numbers("factors", self.factors, 0.0, MAX_FACTOR)
        check_number("floor", self.floor, math.ulp(0.0), MAX_FACTOR)
        check_number("effective_blocks", self.effective_blocks, 0.0)

    def ratios_to(self, level: float) -> FloatArray:
        """Half widths of all `LEVELS` divided by that of one level, (L,), which turns a band of
        that level into bands of the others.

        They are ones where the factor of that level is 0. Raises `ValueError`: the level is none of
        `LEVELS`.
        """
        factors = np.array(self.factors)
        level_factor = factors[LEVELS.index(level)]
        return factors / level_factor if level_factor > 0 else np.ones_like(factors)


@dataclass(frozen=True)
class Bands:
    """Calibrated bands of v and β of one model, and the data that they were calibrated on."""

    # names of the vehicles that were driven where it was calibrated; none: a new car for each
    # drive, as any car is to the model
    vehicles: tuple[str, ...]
    datasets: tuple[str, ...]  # data sets of the recordings that gave the factors
    scaled_on: tuple[str, ...]  # names of the ranges that gave scale and domain
    calibrated_on: tuple[str, ...]  # names of the ranges that gave the factors
    blocks: Blocks  # kind of the blocks: a ``range``, or a segment from ``turn`` to turn
    n_blocks: int  # number of blocks of the validation
    seconds: float  # duration of the samples that gave the factors [s]
    channels: tuple[str, ...]  # channels that the model reads, in the order of its rows' columns
    horizon_steps: int  # sampling intervals that its estimate lies ahead of the sample
    # term -> the 99.9th percentile of its size in training, in the term's unit, not squared
    largest: dict[str, float]
    vy: Quantity  # band of v
    sideslip: Quantity  # band of β
    cars: tuple[CarValues, ...] = ()  # values of the vehicles, as far as their data sets have any
    # tyre check of the estimator's tyre model; None: it has none
    tyre_check: TyreCheck | None = None

    def __post_init__(self) -> None:
        """Raise `DataError` for unknown channels or numbers out of range."""
        check_channels("bands.channels", self.channels)
        _check_terms("largest", self.largest, MIN_TERM)
        check_number("bands.n_blocks", self.n_blocks, 0)
        check_number("bands.seconds", self.seconds, 0.0)
        check_number("bands.horizon_steps", self.horizon_steps, 0)

    def are_of(self, vehicle: str, car: CarValues = UNKNOWN_CAR) -> bool:
        """Whether the bands apply to a vehicle without the factor `OTHER_VEHICLE`, by its name and
        values.

        They do if they are for any car. They do not where `difference_to` finds a difference.
        Otherwise names decide. Where a side has no name, they apply if they were calibrated on one
        car, and not if on several.
        """
        if not self.vehicles:
            return True
        if self.difference_to(car):
            return False
        if vehicle in self.vehicles:
            return True
        return len(self.vehicles) == 1 and UNNAMED_VEHICLE in (vehicle, *self.vehicles)

    def difference_to(self, car: CarValues) -> str:
        """Text of the first value in which a car differs where it differs from every car that the
        bands were calibrated on; empty if it agrees with one, or none has values.
        """
        differences = [car.difference_to(calibrated_car) for calibrated_car in self.cars]
        return differences[0] if differences and all(differences) else ""

    def packed(self, *, elsewhere: bool = False) -> PackedBands:
        """The last two inputs of `band_rows`, for `CHANNEL_LEVEL`.

        With ``elsewhere``, the car or its tyres are others than those calibrated on, and
        `OTHER_VEHICLE` multiplies both factors of the level; floors and weights stay.
        """
        level_place = LEVELS.index(CHANNEL_LEVEL)
        wider = OTHER_VEHICLE if elsewhere else 1.0
        quantities = (self.vy, self.sideslip)
        numbers = [quantity.factors[level_place] * wider for quantity in quantities]
        numbers += [quantity.floor**2 for quantity in quantities]
        numbers += [LOWEST_SPEED, *(self.tyre_check.weights if self.tyre_check else (0.0, 0.0))]
        for by_term in (*(quantity.weights for quantity in quantities), self.largest):
            numbers += [by_term.get(name, 0.0) for name in TERMS]
        return PackedBands(np.array(columns_of(COLUMNS, self.channels)), np.array(numbers))

    def half_widths(
        self,
        rows: FloatArray,
        vy: FloatArray,
        variance: FloatArray,
        tyre_error: FloatArray | None = None,
        *,
        elsewhere: bool = False,
    ) -> FloatArray:
        """Half widths at `CHANNEL_LEVEL`, (T, 2): v [m/s] and β [rad].

        NaN where there is no estimate. Arguments as of `band_rows`; no ``tyre_error``: 0.

        Parameters
        ----------
        rows : array
            Inputs of the model, (T, C), in the order of ``channels``.
        vy, variance : array
            Estimate [m/s] and variance of its error [m²/s²], (T,).
        tyre_error : array or None
            Mean squared errors of the tyre check, (T,) [m²/s²].
        elsewhere : bool
            Whether the car or its tyres are others than those calibrated on.
        """
        bands = np.empty((len(vy), 2))
        added = np.zeros(len(vy)) if tyre_error is None else tyre_error
        band_rows(rows, vy, variance, added, *self.packed(elsewhere=elsewhere), bands)
        return bands


def _check_terms(name_of_terms: str, numbers: Mapping[str, float], smallest: float) -> None:
    """Raise `DataError` unless all terms are known and their numbers 0 or within ``smallest``
    and `MAX_TERM`.
    """
    if not numbers.keys() <= set(TERMS):
        raise DataError(f"{name_of_terms} must be numbers from 0 on, of: {', '.join(TERMS)}")
    for name, number in numbers.items():
        if number != 0.0:
            check_number(f"{name_of_terms}.{name}", number, smallest, MAX_TERM)


class PackedBands(NamedTuple):
    """The bands of v and β at one level, as arrays for `band_rows`."""

    # index of each of `COLUMNS` among the model's channels, -1 where it does not read it, (5,)
    columns: NDArray[np.int64]
    # factors, squared floors of v and β, lowest speed, weights of the tyre check for v and β,
    # weights of `TERMS` for v and β, their largest sizes, (31,)
    numbers: FloatArray


@entry(nogil=True)
def band_rows(  # type: ignore[no-untyped-def]
    rows, vy, variance, tyre_error, columns, numbers, bands
):
    """Write the half widths of one level.

        half width of v = q_v w √max(Σ_j c_j f_j² + b_v x, floor_v²)
        half width of β = min(q_β w √max((Σ_j d_j f_j² + b_β x)/max(|u|, 1 m/s)², floor_β²), π)

    with the terms f_j (`TERMS`) and the mean squared error x of the tyre check. Beyond the range of
    the training w = max(1, |f_j|/m_j) over the features from vx on widens both; m_j is the largest
    |f_j| of the training (its 99.9th percentile).

    Parameters
    ----------
    rows : array
        Inputs of the model, (T, C); NaN was not measured and counts as the training's largest
        value.
    vy : array
        Estimates, (T,) [m/s]; where one is not finite, so is the band.
    variance : array
        Of their errors, (T,) [m²/s²]; NaN without one.
    tyre_error : array
        x, (T,) [m²/s²], 0 without a check.
    columns, numbers : array
        See `PackedBands`.
    bands : array
        Output, (T, 2): v [m/s] and β [rad]. β is π where the speed was not measured.
    """
    n_terms = (len(numbers) - HEAD_LENGTH) // 3
    terms = np.empty(n_terms)
    for k in range(len(vy)):
        if not math.isfinite(vy[k]):
            bands[k, 0] = bands[k, 1] = math.nan
            continue
        vx = rows[k, columns[0]] if columns[0] >= 0 else math.nan
        terms[0] = math.sqrt(variance[k]) if variance[k] >= 0.0 else math.nan
        terms[1] = 1.0
        terms[2] = vx
        terms[3] = rows[k, columns[1]] if columns[1] >= 0 else math.nan
        terms[4] = rows[k, columns[2]] if columns[2] >= 0 else math.nan
        terms[5] = rows[k, columns[3]] * vx if columns[3] >= 0 else math.nan
        terms[6] = rows[k, columns[4]] * vx if columns[4] >= 0 else math.nan
        terms[7] = vy[k]
        squared_vy = numbers[5] * tyre_error[k]
        squared_sideslip = numbers[6] * tyre_error[k]
        wider = 1.0
        for j in range(n_terms):
            largest = numbers[HEAD_LENGTH + 2 * n_terms + j]
            size = abs(terms[j])
            if not math.isfinite(size):
                size = largest
            if j >= FIRST_FEATURE and largest > 0.0 and size / largest > wider:
                wider = size / largest
            squared_vy += numbers[HEAD_LENGTH + j] * size * size
            squared_sideslip += numbers[HEAD_LENGTH + n_terms + j] * size * size
        bands[k, 0] = numbers[0] * wider * math.sqrt(max(squared_vy, numbers[2]))
        bands[k, 1] = math.pi
        if math.isfinite(vx):
            speed = max(abs(vx), numbers[4])
            bands[k, 1] = min(
                numbers[1] * wider * math.sqrt(max(squared_sideslip / (speed * speed), numbers[3])),
                math.pi,
            )


def with_bands(
    estimate: Estimate, measured: Recording, bands: Bands, *, elsewhere: bool = False
) -> Estimate:
    """Add 90 % half widths ``band_vy`` [m/s] and ``band_sideslip`` [rad] to an estimate.

    Parameters
    ----------
    estimate : Estimate
        Of the recording, with ``vx`` and ``friction`` where the bands have a tyre check.
    measured : Recording
        With the channels that the model reads.
    bands : Bands
        Calibrated with the model.
    elsewhere : bool
        Whether the car or its tyres are others than those calibrated on.
    """
    rows, vy, variance = band_inputs(estimate, measured, bands.channels, bands.horizon_steps)
    error = tyre_error_of(bands.tyre_check, estimate)
    half = bands.half_widths(rows, vy, variance, error, elsewhere=elsewhere)
    return replace(
        estimate,
        channels={
            **estimate.channels,
            "band_vy": half[:, 0].copy(),
            "band_sideslip": half[:, 1].copy(),
        },
    )


def band_inputs(
    estimate: Estimate, measured: Recording, channels: Sequence[str], horizon_steps: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Inputs of `band_rows` for each estimate: rows (T, C), v (T,) [m/s] and its variance (T,)
    [m²/s²], NaN where the method has none.

    A row is the last sample that the estimate uses, ``horizon_steps`` before it, so that bands are
    the same online. Raises `DataError` where the recording lacks a channel.
    """
    if len(estimate) != len(measured):
        raise DataError(
            f"the estimate of '{estimate.recording_id}' has {len(estimate)} samples, the "
            f"recording {len(measured)}"
        )
    rows = measured.stack(channels)
    rows = np.ascontiguousarray(rows[np.maximum(np.arange(len(rows)) - horizon_steps, 0)])
    variance = np.full(len(estimate), np.nan)
    if estimate.covariance is not None and "vy" in estimate.covariance_of:
        at = estimate.covariance_of.index("vy")
        variance = np.ascontiguousarray(estimate.covariance[:, at, at], dtype=np.float64)
    return rows, np.ascontiguousarray(estimate["vy"], dtype=np.float64), variance


def tyre_error_of(check: TyreCheck | None, estimate: Estimate) -> FloatArray:
    """Mean squared errors of the tyre check over an estimate, (T,) [m²/s²]; 0 without a check."""
    if check is None:
        return np.zeros(len(estimate))
    return check.squared_errors(estimate["vx"], estimate["friction"])


# Calibration


@dataclass(frozen=True, eq=False)
class Piece:
    """A range with its estimate, as bands are calibrated on it; arrays of T samples."""

    rows: FloatArray  # inputs of the model, (T, C)
    vy: FloatArray  # estimate, (T,) [m/s]
    variance: FloatArray  # variance of the estimate's error, (T,) [m²/s²], NaN where there is none
    # v̂ - v [m/s] and β̂ - β [rad], (T, 2); NaN where either is not known, which leaves the sample
    # out of the calibration
    errors: FloatArray
    yaw_rate: FloatArray | None  # measured, (T,) [rad/s]; None if it was not
    rate_hz: float  # sampling rate [Hz]
    # squared error by the tyre check, (T,) [m²/s²]; None without one
    tyre_error: FloatArray | None = None

    @property
    def has_error(self) -> NDArray[np.bool_]:
        """Samples whose errors are known, (T,)."""
        return np.asarray(np.isfinite(self.errors).all(axis=1))


def calibrated(
    training: Sequence[Piece], validation: Sequence[Piece], channels: tuple[str, ...], **origin: Any
) -> Bands:
    """Calibrate the bands of a model.

    Training ranges give scale and domain; validation ranges, which the model was not trained on,
    give the factors. Raises `DataError` where one of the two has no sample whose error is known.

    Steps: terms of all training samples; their 99.9th percentiles (domain); scales by
    `fitted_scale`; blocks of the validation; factors by `pooled_quantile` of |error|/(s w). With a
    tyre check the scores are computed twice: factors without it give its weights, then factors with
    it.

    Parameters
    ----------
    training, validation : sequence of Piece
        Ranges with estimates; samples without an error are left out.
    channels : tuple of str
        Channels of the rows, in the order of their columns.
    **origin : any
        Fields of `Bands` that describe model and recordings.
    """
    for pieces, role in ((training, "training"), (validation, "validation")):
        if not any(piece.has_error.any() for piece in pieces):
            raise DataError(
                f"no sample of the {role} ranges has both an estimate and a reference to "
                "calibrate bands by"
            )
    columns = np.array(columns_of(COLUMNS, channels))
    terms = np.concatenate(
        [
            terms_of(piece.rows, piece.vy, piece.variance, columns)[piece.has_error]
            for piece in training
        ]
    )
    largest = np.array(
        [
            np.quantile(sizes[np.isfinite(sizes)], DOMAIN_QUANTILE)
            if np.isfinite(sizes).any()
            else 0.0
            for sizes in np.abs(terms).T
        ]
    )
    vx = np.abs(terms[:, TERMS.index("vx")])
    speed = np.maximum(np.where(np.isfinite(vx), vx, LOWEST_SPEED), LOWEST_SPEED)
    usable = np.isfinite(terms).any(axis=0)
    if usable[TERMS.index("variance")]:  # a filter: of its variance and a constant alone
        usable[FIRST_FEATURE:] = False
    names = [name for name, chosen in zip(TERMS, usable, strict=True) if chosen]
    filled = np.where(np.isfinite(terms), terms, largest)[:, usable]
    errors = np.concatenate([piece.errors[piece.has_error] for piece in training])
    scales = []
    for features, error in zip((filled, filled / speed[:, None]), errors.T, strict=True):
        weights, floor = fitted_scale(features, error)
        nonzero_weights = {
            name: float(weight) for name, weight in zip(names, weights, strict=True) if weight > 0
        }
        scales.append(
            Quantity(nonzero_weights, floor, (1.0,) * len(LEVELS), (False,) * len(LEVELS), 1.0)
        )
    labels, kind = block_labels(
        [piece.yaw_rate for piece in validation],
        [len(piece.vy) for piece in validation],
        validation[0].rate_hz,
    )
    blocks = np.concatenate(labels)[np.concatenate([piece.has_error for piece in validation])]
    bands = Bands(
        **origin,
        channels=channels,
        blocks=kind,
        n_blocks=len(np.unique(blocks)),
        seconds=len(blocks) / validation[0].rate_hz,
        largest={
            name: float(size)
            for name, size in zip(TERMS, largest, strict=True)
            if size > 0 and name != "one"
        },
        vy=scales[0],
        sideslip=scales[1],
    )
    scores = _scores(bands, validation)
    if bands.tyre_check is not None:
        factors = [pooled_quantile(score, blocks, CHANNEL_LEVEL)[0] for score in scores.T]
        bands = replace(bands, tyre_check=bands.tyre_check.scaled_by(factors))
        scores = _scores(bands, validation)
    vy, sideslip = (
        _with_factors(scale, score, blocks) for scale, score in zip(scales, scores.T, strict=True)
    )
    return replace(bands, vy=vy, sideslip=sideslip)


def _scores(bands: Bands, pieces: Sequence[Piece]) -> FloatArray:
    """Errors of v and β over half widths whose factors are 1, (N, 2)."""
    half = [
        bands.half_widths(piece.rows, piece.vy, piece.variance, piece.tyre_error)[piece.has_error]
        for piece in pieces
    ]
    errors = [piece.errors[piece.has_error] for piece in pieces]
    return np.abs(np.concatenate(errors)) / np.concatenate(half)


def terms_of(
    rows: FloatArray, vy: FloatArray, variance: FloatArray, columns: NDArray[np.int64]
) -> FloatArray:
    """`TERMS` of each sample without their squares, (T, 8).

    NaN where a channel is not read or was not measured.
    """
    vx, ax, ay, yaw_rate, steer = (
        rows[:, column] if column >= 0 else np.full(len(rows), np.nan) for column in columns
    )
    deviation = np.sqrt(np.where(variance >= 0.0, variance, np.nan))
    return np.stack(
        [deviation, np.ones(len(rows)), vx, ax, ay, yaw_rate * vx, steer * vx, vy], axis=1
    )


def _with_factors(scale: Quantity, scores: FloatArray, blocks: NDArray[np.int64]) -> Quantity:
    """A scale with the factors of all `LEVELS` from scores (N,) in blocks (N,)."""
    factors, is_beyond = zip(
        *(pooled_quantile(scores, blocks, level) for level in LEVELS), strict=True
    )
    places = np.unique(blocks, return_inverse=True)[1]
    squared = np.bincount(places, weights=np.square(scores)).astype(np.float64)
    return replace(
        scale, factors=factors, beyond=is_beyond, effective_blocks=effective_blocks(squared)
    )


def effective_blocks(sums: FloatArray) -> float:
    """Kish's effective number of blocks, (Σ s)²/Σ s², of the sums s of squared scores of B blocks.

    It is B where all sums are equal, and 1 where a single block has all of the loss.

    Source: Kish, Survey Sampling, 1965, Section 11.7, for weights.
    """
    total = float(np.sum(np.square(sums)))
    return float(np.sum(sums)) ** 2 / total if total > 0 else float(len(sums))


def fitted_scale(terms: FloatArray, errors: FloatArray) -> tuple[FloatArray, float]:
    """Fit the scale s² = Σ c_j f_j², with c_j ≥ 0, to squared errors.

    Iterated least squares, each sample weighted by 1/s⁴ of the last fit: the quasi-likelihood of
    squares whose standard deviation is proportional to their mean, as that of Gaussian errors is
    (McCullagh & Nelder 1989, Section 9.2).

    Parameters
    ----------
    terms : array
        f, (N, J), not squared.
    errors : array
        Errors of v [m/s] or β [rad], (N,).

    Returns
    -------
    tuple
        Weights c, (J,), and the smallest value of s, in the unit of the errors.
    """
    squares = np.square(terms)
    targets = np.square(errors)
    mean = float(targets.mean())
    floor = max(MIN_RELATIVE_SCALE * math.sqrt(mean), 1e-9)
    columns = np.sqrt(np.mean(np.square(squares), axis=0))
    columns[columns == 0] = 1.0
    predicted = np.full(len(targets), max(mean, floor**2))
    weights = np.zeros(terms.shape[1])
    for _ in range(N_FITS):
        whitened = squares / columns / predicted[:, None]
        # few rows
        triangle: FloatArray = np.asarray(
            np.linalg.qr(np.column_stack([whitened, targets / predicted]), mode="r")
        )
        weights = scipy.optimize.nnls(triangle[:, :-1], triangle[:, -1])[0] / columns
        former = predicted
        predicted = np.maximum(squares @ weights, floor**2)
        if np.allclose(predicted, former, rtol=1e-6):
            break
    return np.asarray(weights), floor


def pooled_quantile(
    scores: FloatArray, blocks: NDArray[np.int64], level: float
) -> tuple[float, bool]:
    """The level's quantile of scores pooled over K blocks of equal weight.

    It turns scores |error|/(s w) of the validation into the factor q of a level. 1/(n + 1) of the
    weight is at infinity.

    n is how many independent scores there are as to the level: N/(1 + (m - 1) ρ) of N scores in
    blocks of m on average, ρ the intraclass correlation of "below the quantile". If scores of a
    block agree (ρ = 1) n is K, and a further block, exchangeable with these, has on average at
    least the level of its scores below (Lee, Barber & Willett 2023). If they are independent n is
    N, as in split conformal prediction. In between the level is met on average, nearly: the rest of
    the guarantee would make bands of few blocks far too wide.

    Returns
    -------
    tuple
        The quantile of scores (N,), none negative, in blocks whose labels are (N,); and whether n
        is too small for the level, in which case the first is the largest score times 1 + 1/n.

    Source: Dunn, Wasserman & Ramdas 2023 (pooling); Kish, Survey Sampling, 1965, Section 5.4
    (design effect).
    """
    _, label, counts = np.unique(blocks, return_inverse=True, return_counts=True)
    n_blocks = len(counts)
    order = np.argsort(scores, kind="stable")
    below = np.cumsum(1.0 / (n_blocks * counts[label[order]]))

    def quantile(share: float) -> float:
        return float(scores[order][min(int(np.searchsorted(below, share - 1e-9)), len(scores) - 1)])

    correlation = intraclass_correlation((scores <= quantile(level)).astype(np.float64), label)
    correlation = 1.0 if math.isnan(correlation) else min(max(correlation, 0.0), 1.0)
    independent = len(scores) / (1.0 + (len(scores) / n_blocks - 1.0) * correlation)
    if level > independent / (independent + 1.0) + 1e-12:
        return float(scores.max()) * (1.0 + 1.0 / independent), True
    return quantile(level * (1.0 + 1.0 / independent)), False


def intraclass_correlation(values: FloatArray, labels: NDArray[np.int64]) -> float:
    """Intraclass correlation of values (N,) with group labels (N,), by one-way analysis of
    variance.

    1 where a group's values are equal.

    NaN where there are fewer than two groups, or no group has two.

    Source: Donner, A review of inference procedures for the intraclass correlation coefficient in
    the one-way random effects model, International Statistical Review 54 (1), 1986, for groups of
    unlike sizes.
    """
    _, group_of_value, sizes = np.unique(labels, return_inverse=True, return_counts=True)
    groups = len(sizes)
    n = len(values)
    if groups < 2 or n <= groups:
        return float("nan")
    means = np.bincount(group_of_value, weights=values) / sizes
    between = float(sizes @ np.square(means - values.mean())) / (groups - 1)
    within = float(np.sum(np.square(values - means[group_of_value]))) / (n - groups)
    typical = (n - float(np.sum(np.square(sizes))) / n) / (groups - 1)
    total = between + (typical - 1.0) * within
    return (between - within) / total if total > 0 else float("nan")


def block_labels(
    yaw_rates: Sequence[FloatArray | None], lengths: Sequence[int], rate_hz: float
) -> tuple[list[NDArray[np.int64]], Blocks]:
    """Label the samples of ranges with the block that they belong to.

    From `MIN_RANGES` ranges on each range is a block, else each segment from turn to turn; then a
    range without yaw rate is one block.

    Parameters
    ----------
    yaw_rates : sequence of array or None
        Yaw rate of each range, (T,) [rad/s].
    lengths : sequence of int
        Number of samples of each range.
    rate_hz : float
        Sampling rate [Hz].

    Returns
    -------
    tuple
        Labels of each range's samples, (T,), counted on from range to range; and what a block is.
    """
    labels = []
    count = 0
    kind: Blocks = "range" if len(lengths) >= MIN_RANGES else "turn"
    for yaw_rate, length in zip(yaw_rates, lengths, strict=True):
        spans_range = kind == "range" or yaw_rate is None
        turns = (
            np.zeros(length, dtype=np.int64)
            if yaw_rate is None or spans_range
            else turns_of(yaw_rate, rate_hz)
        )
        labels.append(turns + count)
        count += int(turns[-1]) + 1 if length else 0
    return labels, kind


def turns_of(yaw_rate: FloatArray, rate_hz: float) -> NDArray[np.int64]:
    """Number of the turn that each sample belongs to, (T,).

    A turn starts where |yaw rate| rises over 0.05 rad/s, at the earliest 2 s after the one before;
    what is left at the end and shorter than that belongs to the last.
    """
    turning = np.abs(np.nan_to_num(yaw_rate)) >= TURN_YAW_RATE
    min_samples = max(math.ceil(MIN_BLOCK_SECONDS * rate_hz), 1)
    starts = [0]
    for start in np.flatnonzero(turning[1:] & ~turning[:-1]) + 1:
        if start - starts[-1] >= min_samples:
            starts.append(int(start))
    if len(starts) > 1 and len(turning) - starts[-1] < min_samples:
        starts.pop()
    labels = np.zeros(len(turning), dtype=np.int64)
    labels[starts[1:]] = 1
    return np.cumsum(labels)
