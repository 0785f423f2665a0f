"""Columns that agree with a known motion: longitudinal acceleration, steering, lateral velocity and
sideslip angle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from vehest.alignment.motion import Motion
from vehest.alignment.proposals.columns import (
    HINT_OF_LETTER,
    RARE_UNITS,
    Candidate,
    correlation,
    largest,
    si_factor,
    slow_of,
)
from vehest.alignment.proposals.names import STRONG, is_estimate, is_pair
from vehest.alignment.proposals.proposal import Proposal
from vehest.alignment.proposals.turning import CLOSE_MISMATCH, FAR_MISMATCH, Search
from vehest.alignment.signs import MIN_SCALE_CORRELATION, relations_of
from vehest.alignment.standstill import BoolArray
from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS

CLEAR_CORRELATION = 0.6  # smallest correlation that decides where nothing else comes near
# smallest correlation that decides, of relations with derivatives of noisy channels
CLEAR_LATERAL_CORRELATION = 0.45
# smallest correlation of a lateral velocity that decides where its name agrees, and where its score
# starts
MIN_STRENGTH = 0.3
RIVAL_MARGIN = 2.0  # largest difference of the score of a rival from that of the chosen column
# largest |logarithm| of the gain of an acceleration to d(vx)/dt that pitch, grade and slip explain
MAX_AX_MISMATCH = 1.1
# penalty on the score of a reference's column as a channel that the car measures itself
REFERENCE_PENALTY = 2.5
# penalty on that score where the car's bus has a column of that name
REFERENCE_PENALTY_WITH_BUS = 8.0
MIN_SECOND_SCORE = 3.0 + STRONG  # smallest score of a sideslip angle besides a lateral velocity
MAX_CENTRE_SHARE = 0.1  # largest distance of straight ahead from zero, over a command's range
CRAWL_SHARE = 0.05  # speed over the top speed below which a sideslip angle has no meaning
# text on a column that the motion does not clearly confirm
UNCLEAR = "the motion does not clearly confirm it"
MIN_SIDESLIP_CORRELATION = 0.9  # smallest correlation of a sideslip angle with atan2(vy, vx)
REFERENCES = ("vy_ref", "sideslip_ref")  # channels of a reference that are sought
NAMED_LIKE = {
    "ax": ("ax",),
    **dict.fromkeys(("steer", "handwheel"), ("steer", "handwheel")),
    **dict.fromkeys(REFERENCES, REFERENCES),
}
"""Channel -> roles of which the name of its column suggests one."""
# rad, largest angle of the road wheels and of the steering wheel
MAX_ANGLES = {"steer": 0.8, "handwheel": 16.0}
MAX_STRAIGHT_ANGLE = 0.1  # rad, largest angle of a road wheel straight ahead
# wheelbase, and wheelbase times steering ratio, of cars [m]
POSSIBLE_LENGTHS = {
    "steer": (1.2, 7.0),
    "handwheel": (12.0, 130.0),
}
# wheelbase, and wheelbase times steering ratio, of usual cars [m]; others hint at a wrong unit
USUAL_LENGTHS = {
    "steer": (1.8, 5.0),
    "handwheel": (25.0, 80.0),
}
# wheelbase, and wheelbase times steering ratio, of a typical car [m]
TYPICAL_LENGTHS = {"steer": 2.7, "handwheel": 43.0}
MIN_MODEL_WHEELBASE = 0.08  # m, wheelbase of the smallest model
MAX_MODEL_SPEED = 20.0  # m/s, top speed of a model car
# smallest number of samples in slow corners; with fewer all of the drive are used
MIN_CALM_SAMPLES = 100
# largest relative difference of a length by half of the slow corners from that by all; a lane
# change at one speed has more
MAX_HALF_DIFFERENCE = 0.2


class Offer(NamedTuple):
    """A column as a channel, with the score of its evidence."""

    score: float  # score of its evidence
    column: Candidate  # the column
    proposal: Proposal  # the proposal of this channel


class Agreement(NamedTuple):
    """Agreement of a column, as a channel in some unit, with a motion."""

    channel: str  # channel that the column would be
    unit: str  # unit of the column
    strength: float = 0.0  # absolute correlation; 0 where both have hardly anything in common
    sign: int = 1  # sign of the correlation
    scale: float = math.inf  # gain, which should be 1
    text: str = ""  # text for people

    @property
    def mismatch(self) -> float:
        """Magnitude of the logarithm of the scale."""
        return abs(math.log(self.scale))


class Angle(NamedTuple):
    """An angle of steering that a column may be."""

    oddness: float  # logarithm of the length over that of a usual car
    channel: str  # ``steer`` or ``handwheel``
    unit: str  # unit of the column
    length: float  # wheelbase, or that times the steering ratio, by slow cornering [m]
    largest: float  # largest angle, less that of straight ahead [rad]
    is_repeatable: bool  # whether both halves of the slow corners give nearly this length


def fitting_channels(search: Search) -> tuple[dict[str, Proposal], tuple[str, ...]]:
    """Assign ax, a steering angle, and a lateral velocity or sideslip angle.

    Parameters
    ----------
    search : Search
        Columns that get a channel are removed from ``search.free``.

    Returns
    -------
    channels : dict of str to Proposal
        The assignment of columns to channels with most evidence in all.
    notes : tuple of str
        Columns that are left out, with the reason.
    """
    columns = list(search.free)
    offers = [
        [offer(search, column) for column in columns]
        for offer in (_as_ax, _as_steering, _as_lateral)
    ]
    scores = np.array([[offer.score if offer else 0.0 for offer in row] for row in offers])
    pairs = zip(*linear_sum_assignment(scores, maximize=True), strict=True) if columns else ()
    chosen = {
        row: offer for row, place in pairs if (offer := offers[row][place]) and offer.score > 0.0
    }
    for offer in chosen.values():
        search.free.remove(offer.column)
    rivals = [[offer for offer in row if offer and offer.column in search.free] for row in offers]
    proposals = {
        offer.proposal.channel: _with_rivals(offer, rivals[row]) for row, offer in chosen.items()
    }
    second_offers = [
        offer
        for offer in rivals[2]
        if 2 in chosen
        and offer.proposal.channel not in proposals
        and offer.score >= MIN_SECOND_SCORE
    ]
    if not second_offers:
        return proposals, ()
    second = max(second_offers, key=lambda offer: offer.score)
    search.free.remove(second.column)
    columns_of = {offer.proposal.channel: offer.column for offer in (chosen[2], second)}
    velocity, angle = (columns_of[channel] for channel in REFERENCES)
    proposals[second.proposal.channel] = second.proposal
    forward = slow_of(search.motion.vx, search.motion.rate_hz)
    moving = forward > 0.2 * forward.max()
    lateral_speed = proposals["vy_ref"].si(velocity.slow)
    correlation_with_atan = correlation(
        np.arctan2(lateral_speed, forward)[moving], angle.slow[moving]
    )
    if abs(correlation_with_atan) >= MIN_SIDESLIP_CORRELATION:
        return proposals, ()
    del proposals["sideslip_ref"]
    expected = f"atan2({velocity.name}, {search.turning.columns['vx'].name})"
    return proposals, (
        f"'{angle.name}' is left out: its correlation with {expected} is "
        f"{correlation_with_atan:.2f}, so that it is not the sideslip angle",
    )


def _with_rivals(chosen: Offer, rivals: Sequence[Offer]) -> Proposal:
    """The chosen proposal, with a question where another column comes near, or has the name that
    the chosen one lacks.
    """

    def is_named(offer: Offer) -> bool:
        return not offer.column.hints.keys().isdisjoint(NAMED_LIKE[offer.proposal.channel])

    near = tuple(
        rival.column.name
        for rival in rivals
        if rival.proposal.channel == chosen.proposal.channel
        and (
            rival.score > chosen.score - RIVAL_MARGIN
            or (rival.score > 0.0 and is_named(rival) and not is_named(chosen))
        )
    )
    proposal = chosen.proposal
    if proposal.question or not near:
        return proposal
    question = f"{' and '.join(near)} would fit equally well"
    return replace(proposal, question=question, alternatives=near)


def may_be_ax(column: Candidate) -> bool:
    """Whether unit and name allow a longitudinal acceleration."""
    return column.measures("ax") and column.hint("ax") >= 0.0


def _as_ax(search: Search, column: Candidate) -> Offer | None:
    """A column as longitudinal acceleration, by its agreement with d(vx)/dt and its name; None
    where neither supports it.
    """
    if not may_be_ax(column):
        return None
    best = longitudinal(search.motion, column)
    ay = search.turning.columns.get("ay")
    is_of_ay_sensor = ay is not None and is_pair(column.name, ay.name)
    unit = best.unit if best.strength else column.unit or search.turning.units.get("ay", "m/s²")
    fits = best.mismatch < MAX_AX_MISMATCH or bool(column.unit)
    if not fits and "ax" not in column.hints:  # a torque follows d(vx)/dt as well
        return None
    is_clear = best.strength >= CLEAR_CORRELATION and fits
    # where the drive does not show it, the axes of the other channels are those of ax, unless ay
    # counts against the yaw rate: then the sensor's y axis alone points right, or all axes of it
    signs = search.turning.signs
    sign = best.sign if best.strength else signs["vx"]
    is_sign_known = bool(best.strength) or -1 not in signs.values()
    is_named = column.hint("ax") == STRONG and column.unit and is_sign_known
    question = "" if is_clear or is_named else UNCLEAR
    evidence = (best.text or "name only", *_name_evidence(column, "ax"))
    measured = any(bus_column.is_of_bus and "ax" in bus_column.hints for bus_column in search.free)
    score = (
        _score(best.strength, CLEAR_CORRELATION, column.hint("ax"))
        - (REFERENCE_PENALTY_WITH_BUS if measured else REFERENCE_PENALTY) * column.is_reference
    )
    is_weak = bool(question) and not (column.unit or is_of_ay_sensor)
    proposal = Proposal(column.name, "ax", unit, sign, evidence, question, is_weak=is_weak)
    return Offer(score, column, proposal)


def _as_steering(search: Search, column: Candidate) -> Offer | None:
    """Offer a column as an angle of the road wheels or of the steering wheel; where it can be
    neither, as a command of unknown scale. None if it is no steering.
    """
    hint = max(column.hint("steer"), column.hint("handwheel"))
    if hint < 0.0 or not column.measures("steer"):
        return None
    best = agreement(
        search.motion, column, "steer", "rad", "steer", offset=float(np.median(column.values))
    )
    score = _score(best.strength, CLEAR_CORRELATION, hint)
    if score <= 0.0:
        return None
    slope, straight = _regressed(search.motion, column, np.flatnonzero(_driven(search.motion)))
    sign = best.sign if best.strength else (-1 if slope < 0.0 else 1)
    text = best.text or f"{column.name} vs. yaw_rate/vx: sign {sign:+d}"
    evidence = (text, *_name_evidence(column, "steer", "handwheel"))
    question = (
        "" if best.strength >= CLEAR_CORRELATION or (best.strength and hint == STRONG) else UNCLEAR
    )
    possible = angles(search.motion, column)
    if "handwheel" in column.hints:
        possible = [angle for angle in possible if angle.channel == "handwheel"] or possible
    spread = float(np.quantile(np.abs(column.values - straight), 0.995))
    if not possible and column.unit:
        size = spread * si_factor(column.unit, "handwheel")
        has_range = MAX_ANGLES["steer"] < size <= MAX_ANGLES["handwheel"]  # of no road wheel
        if has_range or column.hints.get("handwheel") == STRONG:
            proposal = Proposal(column.name, "handwheel", column.unit, sign, evidence, question)
            return Offer(score, column, proposal)
    if not possible:
        unit = next(
            (
                unit
                for unit in column.units("steer")
                if spread * si_factor(unit, "steer") <= CHANNELS["steer"].high
            ),
            "rad",
        )
        offset = straight if abs(straight) > MAX_CENTRE_SHARE * spread else 0.0
        question = (
            "its range and the slow corners match neither a road-wheel nor a steering-wheel angle: "
            "if it is a command, state its scale"
        )
        is_weak = not hint or "handwheel" in column.hints
        proposal = Proposal(
            column.name, "steer", unit, sign, evidence, question, offset=offset, is_weak=is_weak
        )
        return Offer(score, column, proposal)
    _, channel, unit, length, largest_angle, is_repeatable = min(possible)
    rival_angles = sorted({(angle.channel, angle.unit) for angle in possible} - {(channel, unit)})
    alternatives = tuple(" ".join(pair) for pair in rival_angles)
    if alternatives:
        question = (
            f"{' or '.join(' in '.join(pair) for pair in rival_angles)} would fit equally well"
        )
    text = f"up to {math.degrees(largest_angle):.3g}°"
    if is_repeatable and (
        USUAL_LENGTHS[channel][0] <= length <= USUAL_LENGTHS[channel][1]
        or float(np.quantile(search.motion.vx, 0.99)) < MAX_MODEL_SPEED
    ):
        text += (
            f", {'wheelbase' if channel == 'steer' else 'wheelbase × steering ratio'} {length:.3g} "
            "m from slow corners"
        )
    ay = _lateral_acceleration(search.motion)
    ay_correlation = abs(correlation(column.slow, slow_of(ay, search.motion.rate_hz)))
    is_weak = not (hint or column.unit) and ay_correlation >= best.strength
    if is_weak:
        question = (
            "neither name nor unit says so, and its correlation with ay is as high "
            f"({ay_correlation:.2f})"
        )
    if channel == "steer" and column.hints.get("handwheel") == STRONG:
        question = "its name suggests a steering wheel, its range and slow corners a road wheel"
        is_weak = True
    proposal = Proposal(
        column.name,
        channel,
        unit,
        sign,
        (*evidence, text),
        question,
        alternatives=alternatives,
        is_weak=is_weak,
    )
    return Offer(score, column, proposal)


def _as_lateral(search: Search, column: Candidate) -> Offer | None:
    """A column as lateral velocity or sideslip angle, in the unit in which its derivative agrees
    best with ay - vx·yaw_rate; None where no car could slide like that.
    """
    motion = search.motion
    is_of_other_axes = HINT_OF_LETTER in column.hints.values() and not set(REFERENCES) & set(
        column.hints
    )
    is_named_otherwise = is_of_other_axes or STRONG in column.hints.values()
    agreements = [
        agreement(motion, column, channel, unit, f"d({channel})/dt")
        for channel in REFERENCES
        if column.measures(channel)
        and (column.hints.get(channel) == STRONG or not is_named_otherwise)
        for unit in column.units(channel)
    ]
    agreements = sorted(
        (fit for fit in agreements if _is_plausible(motion, column, fit)),
        key=lambda fit: 0.3 * fit.mismatch - 2.0 * fit.strength,
    )
    if not agreements:
        return None
    hints = {channel: column.hints.get(channel, 0.0) for channel in REFERENCES}
    best = max(
        agreements,
        key=lambda fit: 4.0 * fit.strength - 0.6 * min(fit.mismatch, 5.0) + hints[fit.channel],
    )
    hint = hints[best.channel]
    rivals = [
        fit
        for fit in agreements
        if fit.channel != best.channel and fit.strength > best.strength - 0.05 and not hint
    ]
    is_clear = best.strength >= CLEAR_LATERAL_CORRELATION or (
        best.strength >= MIN_STRENGTH and hint > 0.0
    )
    question = (
        f"{rivals[0].channel} in {rivals[0].unit} would fit equally well"
        if rivals
        else ""
        if is_clear
        else UNCLEAR
    )
    if not rivals and not is_clear and hint == STRONG:
        question = f"sign: {UNCLEAR}" if column.unit else f"sign and unit: {UNCLEAR}"
    if not question and column.hint(best.channel) < 0.0:
        question = "its values contradict its name"
    if not question and is_estimate(column.name):
        question = "it is named as an estimate: a reference has to be measured"
    is_wrong_scale = best.strength >= MIN_SCALE_CORRELATION and best.mismatch > FAR_MISMATCH
    if is_wrong_scale:
        question = f"{best.text} instead of 1: another unit or factor"
    evidence = (best.text or "name only", *_name_evidence(column, *REFERENCES))
    alternatives = (
        tuple(dict.fromkeys(f"{fit.channel} {fit.unit}" for fit in agreements if fit is not best))
        if question
        else ()
    )
    is_pair_of_speed = is_pair(search.turning.columns["vx"].name, column.name)
    is_confirmed = is_clear or bool(column.unit) or is_pair_of_speed
    is_weak = is_wrong_scale or (best.channel == "vy_ref" and not is_confirmed)
    proposal = Proposal(
        column.name,
        best.channel,
        best.unit,
        best.sign,
        evidence,
        question,
        alternatives=alternatives,
        is_weak=is_weak,
        is_by_name=not best.text,
    )
    return Offer(_score(best.strength, MIN_STRENGTH, hint), column, proposal)


def _score(strength: float, min_strength: float, hint: float) -> float:
    """Score of an offer: up to 8 for the correlation beyond the least one, plus the hint of the
    name; without a relation, the hint less one.
    """
    return 8.0 * (strength - min_strength) / (1.0 - min_strength) + hint if strength else hint - 1.0


def _is_plausible(motion: Motion, column: Candidate, fit: Agreement) -> bool:
    """Whether a car can slide like that, within a factor of what is rare."""
    size = float(np.quantile(np.abs(column.values), 0.9)) * si_factor(fit.unit, fit.channel)
    return (
        size < 1.5 * float(np.quantile(motion.vx, 0.9))
        if fit.channel == "vy_ref"
        else 5e-4 < size < 1.6
    )


def _name_evidence(column: Candidate, *roles: str) -> Sequence[str]:
    """``name``, ``unit`` or both as evidence, in a list; empty where neither speaks for a role."""
    parts = ["name"] if set(roles) & set(column.hints) else []
    parts += ["unit"] if column.unit else []
    return [" and ".join(parts)] if parts else []


def longitudinal(motion: Motion, column: Candidate, units: Sequence[str] = ()) -> Agreement:
    """Agreement of a column with d(vx)/dt, in the unit with a gain near 1.

    Parameters
    ----------
    motion : Motion
        Speed and yaw rate.
    column : Candidate
        Column that may be ax.
    units : sequence of str
        To try instead of those of the column.

    Returns
    -------
    Agreement
        Rare units are tried where the others are far off, if the name suggests ax.
    """
    tried = list(units or column.units("ax"))
    rare = RARE_UNITS["ax"] if "ax" in column.hints and not (units or column.unit) else ()
    fits = [agreement(motion, column, "ax", unit, "ax") for unit in tried]
    if min(fit.mismatch for fit in fits) >= FAR_MISMATCH:
        rare_fits = [agreement(motion, column, "ax", unit, "ax") for unit in rare]
        fits += [fit for fit in rare_fits if fit.mismatch < CLOSE_MISMATCH]
    return min(fits, key=lambda fit: fit.mismatch)


def agreement(
    motion: Motion, column: Candidate, channel: str, unit: str, left: str, *, offset: float = 0.0
) -> Agreement:
    """Compare a column, as a channel, with a motion.

    Parameters
    ----------
    motion : Motion
        Speed, yaw rate and, where known, lateral acceleration.
    column : Candidate
        With values (T,).
    channel, unit : str
        What the column is assumed to be.
    left : str
        Left side of the relation that is evaluated (`vehest.alignment.signs.relations_of`).
    offset : float
        Value of the column at zero, in ``unit``.

    Returns
    -------
    Agreement
        With strength 0 where the drive does not show the relation.
    """
    samples = (column.values - offset) * si_factor(unit, channel)
    if channel == "sideslip_ref":
        samples = np.where(np.abs(motion.vx) < CRAWL_SHARE * largest(motion.vx), 0.0, samples)
    velocity = channel if channel in REFERENCES else ""
    with np.errstate(all="ignore"):
        relations = relations_of(
            replace(motion, channels={**motion.channels, channel: samples}, velocity=velocity)
        )
    for relation in relations:
        if relation.left == left:
            gain = f", gain {abs(relation.scale):.3g}" if math.isfinite(relation.tolerance) else ""
            text = f"{relation.text}: correlation {relation.correlation:.2f}{gain}"
            return Agreement(
                channel,
                unit,
                abs(relation.correlation),
                -1 if relation.correlation < 0.0 else 1,
                abs(relation.scale),
                text,
            )
    return Agreement(channel, unit)


def angles(motion: Motion, column: Candidate) -> list[Angle]:
    """Road-wheel or steering-wheel angles, in each unit that range and slow corners allow.

    The length in angle = length·yaw_rate/vx + K·ay + offset is the wheelbase, or that times the
    steering ratio.

    Parameters
    ----------
    motion : Motion
        Speed, yaw rate and, where it is known, lateral acceleration.
    column : Candidate
        Column that may be an angle of steering.

    Returns
    -------
    list of Angle
        Empty where no unit gives a possible length and range.
    """
    ay = _lateral_acceleration(motion)
    rows = _calm(motion)
    slope, offset = _regressed(motion, column, rows, ay)
    of_halves = [_regressed(motion, column, half, ay)[0] for half in np.array_split(rows, 2)]
    is_repeatable = max(abs(half / slope - 1.0) for half in of_halves) <= MAX_HALF_DIFFERENCE
    largest_angle = float(np.quantile(np.abs(column.values - offset), 0.995))
    is_model = float(np.quantile(motion.vx, 0.99)) < MAX_MODEL_SPEED
    possible = []
    for channel, (low, high) in POSSIBLE_LENGTHS.items():
        for unit in column.units("steer"):
            factor = si_factor(unit, channel)
            length = abs(slope) * factor
            largest_si = largest_angle * factor
            shortest = MIN_MODEL_WHEELBASE if is_model and channel == "steer" else low
            if (
                shortest <= length <= high
                and largest_si <= MAX_ANGLES[channel]
                and (channel == "handwheel" or abs(offset) * factor < MAX_STRAIGHT_ANGLE)
            ):
                oddness = abs(math.log(length / TYPICAL_LENGTHS[channel]))
                possible.append(Angle(oddness, channel, unit, length, largest_si, is_repeatable))
    return possible


def cornering_length(motion: Motion, column: Candidate) -> float:
    """Change of an angle of steering by yaw_rate/vx in slow corners [its unit · m]."""
    ay = _lateral_acceleration(motion)
    return abs(_regressed(motion, column, _calm(motion), ay)[0])


def _lateral_acceleration(motion: Motion) -> FloatArray:
    """ay where it is known, else vx·yaw_rate [m/s²], (T,)."""
    return motion.channels.get("ay", motion.turning)


def _calm(motion: Motion) -> NDArray[np.int64]:
    """Samples of slow corners, if there are enough, else of the drive."""
    ay = _lateral_acceleration(motion)
    driven = _driven(motion)
    calm = driven & (np.abs(ay) <= 0.5 * float(np.quantile(np.abs(ay), 0.95)) + 1e-9)
    return np.flatnonzero(calm if calm.sum() >= MIN_CALM_SAMPLES else driven)


def _driven(motion: Motion) -> BoolArray:
    """Samples at which the car moves at more than a fifth of its top speed, (T,)."""
    return motion.moving & (motion.vx > 0.2 * float(np.quantile(motion.vx, 0.99)))


def _regressed(
    motion: Motion, column: Candidate, selected: NDArray[np.int64], *regressors: FloatArray
) -> tuple[float, float]:
    """Change of a column by yaw_rate/vx [its unit · m], and its value straight ahead.

    Further ``regressors`` (T,) are fitted together with them.
    """
    rows = [
        motion["yaw_rate"][selected] / motion.vx[selected],
        *(samples[selected] for samples in regressors),
        np.ones(len(selected)),
    ]
    slope, *_, offset = np.linalg.lstsq(
        np.stack(rows, axis=1), column.values[selected], rcond=None
    )[0].tolist()
    return slope, offset
