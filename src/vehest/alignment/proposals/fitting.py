"""Columns that agree with a known motion: longitudinal acceleration, steering, lateral velocity and sideslip angle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from vehest.alignment.motion import Motion
from vehest.alignment.proposals.columns import Candidate, correlation, largest, si_factor, slow_of
from vehest.alignment.proposals.names import STRONG
from vehest.alignment.proposals.proposal import Proposal
from vehest.alignment.proposals.turning import Search
from vehest.alignment.signs import relations_of
from vehest.alignment.standstill import BoolArray
from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS

CLEAR = 0.6  # correlation that decides where nothing else comes near
CLEAR_LATERAL = 0.45  # of relations with derivatives of noisy channels
LEAST = 0.3
NEAR = 2.0  # score within which another column comes near
FITTING = 1.1  # logarithm of the scale of an acceleration over d(vx)/dt, within which pitch, grade and slip explain it
OF_REFERENCE = 2.5
BESIDE_BUS = 8.0  # of score, for what the car is to measure itself; where its bus has a column of that name, more
SECOND = 3.0 + STRONG  # score of a sideslip angle beside a lateral velocity
CENTRED = 0.1  # of a command's range, by which straight ahead may lie beside nil
CRAWL_SHARE = 0.05  # of the top speed, below which a sideslip angle has no meaning
HARDLY = "the motion hardly decides it"
SAME_ANGLE = 0.9  # correlation of a sideslip angle with atan2(vy, vx)
REFERENCES = ("vy_ref", "sideslip_ref")
LARGEST = {"steer": 0.8, "handwheel": 16.0}  # rad
STRAIGHT_AHEAD = 0.1  # rad that a road wheel may show there, of an angle
LENGTHS = {
    "steer": (1.2, 7.0),
    "handwheel": (12.0, 130.0),
}  # m, wheelbase, and that times the ratio, of cars
SHOWN = {
    "steer": (1.8, 5.0),
    "handwheel": (25.0, 80.0),
}  # m, of cars; others are an error of the estimate
USUAL_LENGTH = {"steer": 2.7, "handwheel": 43.0}  # m
SMALL = 0.08  # m, wheelbase of the smallest model
FASTEST_MODEL = 20.0  # m/s
FEWEST_CALM = 100  # samples


class Offer(NamedTuple):
    """A column as a channel, with the score of its evidence."""

    score: float
    column: Candidate
    proposal: Proposal


class Agreement(NamedTuple):
    """How a column in some unit agrees with a motion."""

    channel: str  # that it would be
    unit: str  # of the column
    strength: float = 0.0  # absolute correlation; 0 where hardly anything is common
    sign: int = 1  # of the correlation
    scale: float = math.inf  # that should be 1
    in_words: str = ""  # for people

    @property
    def mismatch(self) -> float:
        """Logarithm of the scale."""
        return abs(math.log(self.scale))


class Angle(NamedTuple):
    """Possible angle of steering."""

    oddness: float  # logarithm of the length over that of a usual car
    channel: str  # ``steer`` or ``handwheel``
    unit: str  # of the column
    length: float  # wheelbase, or that times the steering ratio, by slow cornering [m]
    largest: float  # angle, straight ahead taken off [rad]


def fitting_channels(search: Search) -> tuple[dict[str, Proposal], tuple[str, ...]]:
    """The assignment with most evidence in all, and notes of columns that are left out."""
    columns = list(search.free)
    offers = [
        [offer(search, one) for one in columns] for offer in (_as_ax, _as_steering, _as_lateral)
    ]
    scores = np.array([[offer.score if offer else 0.0 for offer in row] for row in offers])
    pairs = zip(*linear_sum_assignment(scores, maximize=True), strict=True) if columns else ()
    chosen = {
        row: offer for row, place in pairs if (offer := offers[row][place]) and offer.score > 0.0
    }
    for offer in chosen.values():
        search.free.remove(offer.column)
    left = [[offer for offer in row if offer and offer.column in search.free] for row in offers]
    proposals = {
        offer.proposal.channel: _with_rivals(offer, left[row]) for row, offer in chosen.items()
    }
    held = set(REFERENCES) & set(proposals)
    others = [offer for offer in left[2] if held and offer.proposal.channel not in held]
    second = max(others, key=lambda one: one.score, default=None)
    if second is None or second.score < SECOND:
        return proposals, ()
    search.free.remove(second.column)
    columns_of = {offer.proposal.channel: offer.column for offer in (chosen[2], second)}
    velocity, angle = (columns_of[channel] for channel in REFERENCES)
    proposals[second.proposal.channel] = second.proposal
    forward = slow_of(search.known.vx, search.known.rate_hz)
    moving = forward > 0.2 * forward.max()
    aside = velocity.slow * proposals["vy_ref"].sign * si_factor(proposals["vy_ref"].unit, "vy_ref")
    agreeing = correlation(np.arctan2(aside, forward)[moving], angle.slow[moving])
    if abs(agreeing) >= SAME_ANGLE:
        return proposals, ()
    del proposals["sideslip_ref"]
    expected = f"atan2({velocity.name}, {search.turning.columns['vx'].name})"
    return proposals, (
        f"'{angle.name}' is not {expected} (correlation {agreeing:.2f}), so no sideslip angle; it is left out",
    )


def _with_rivals(chosen: Offer, rivals: Sequence[Offer]) -> Proposal:
    """Asked where another column comes near, or has the name that the chosen one lacks."""

    def is_named(offer: Offer) -> bool:
        return any(text.startswith("its name") for text in offer.proposal.evidence)

    near = tuple(
        one.column.name
        for one in rivals
        if one.proposal.channel == chosen.proposal.channel
        and (
            one.score > chosen.score - NEAR
            or (one.score > 0.0 and is_named(one) and not is_named(chosen))
        )
    )
    proposal = chosen.proposal
    return (
        replace(proposal, asked=f"{', '.join(near)} would do as well", others=near)
        if near and not proposal.asked
        else proposal
    )


def may_be_ax(column: Candidate) -> bool:
    """Whether unit and name allow a longitudinal acceleration."""
    return column.measures("ax") and column.hint("ax") >= 0.0


def _as_ax(search: Search, column: Candidate) -> Offer | None:
    if not may_be_ax(column):
        return None
    best = longitudinal(search.known, column)
    unit = best.unit if best.strength else column.unit or search.turning.units.get("ay", "m/s²")
    fits = best.mismatch < FITTING or bool(column.unit)
    if not fits and "ax" not in column.hints:  # a torque follows d(vx)/dt as well
        return None
    is_clear = best.strength >= CLEAR and fits
    asked = "" if is_clear or (column.hint("ax") == STRONG and column.unit) else HARDLY
    evidence = (best.in_words or "its name alone", *_name_evidence(column, "ax"))
    measured = any(one.is_of_bus and "ax" in one.hints for one in search.free)
    score = (
        _score(best.strength, CLEAR, column.hint("ax"))
        - (BESIDE_BUS if measured else OF_REFERENCE) * column.is_reference
    )
    return Offer(score, column, Proposal(column.name, "ax", unit, best.sign, evidence, asked))


def _as_steering(search: Search, column: Candidate) -> Offer | None:
    """As an angle of the road wheels or of the steering wheel; where it can be neither, as a command whose scale is asked."""
    hint = max(column.hint("steer"), column.hint("handwheel"))
    if hint < 0.0 or not column.measures("steer"):
        return None
    best = agreement(
        search.known, column, "steer", "rad", "steer", offset=float(np.median(column.values))
    )
    score = _score(best.strength, CLEAR, hint)
    if score <= 0.0:
        return None
    slope, straight = _regressed(search.known, column, _driven(search.known))
    sign = best.sign if best.strength else (-1 if slope < 0.0 else 1)
    text = best.in_words or f"{column.name} follows yaw_rate/vx with sign {sign:+d}"
    evidence = (text, *_name_evidence(column, "steer", "handwheel"))
    asked = "" if best.strength >= CLEAR or (best.strength and hint == STRONG) else HARDLY
    found = angles(search.known, column)
    if "handwheel" in column.hints:
        found = [one for one in found if one.channel == "handwheel"] or found
    if not found and column.hints.get("handwheel") == STRONG and column.unit:
        return Offer(
            score, column, Proposal(column.name, "handwheel", column.unit, sign, evidence, asked)
        )
    if not found:
        spread = float(np.quantile(np.abs(column.values - straight), 0.995))
        unit = next(
            (
                unit
                for unit in column.units("steer")
                if spread * si_factor(unit, "steer") <= CHANNELS["steer"].high
            ),
            "rad",
        )
        offset = straight if abs(straight) > CENTRED * spread else 0.0
        asked = "no angle of the road wheels or of a steering wheel by its range and slow corners; its scale is to be given"
        return Offer(
            score,
            column,
            Proposal(column.name, "steer", unit, sign, evidence, asked, offset=offset),
        )
    _, channel, unit, length, reach = min(found)
    others = sorted({(one.channel, one.unit) for one in found} - {(channel, unit)})
    if others:
        asked = f"could be {' or '.join(f'{other} in {of_other}' for other, of_other in others)} as well"
    text = f"up to {math.degrees(reach):.3g}°"
    if (
        SHOWN[channel][0] <= length <= SHOWN[channel][1]
        or float(np.quantile(search.known.vx, 0.99)) < FASTEST_MODEL
    ):
        text += f", and {'a wheelbase' if channel == 'steer' else 'wheelbase times ratio'} of {length:.3g} m by slow corners"
    alternatives = tuple(" ".join(other) for other in others)
    ay = search.known.channels.get("ay", search.known.turning)
    of_ay = abs(correlation(column.slow, slow_of(ay, search.known.rate_hz)))
    is_weak = not (hint or column.unit) and of_ay >= best.strength
    if is_weak:
        asked = f"no name or unit says so, and it follows ay ({of_ay:.2f}) as well"
    evidence = (*evidence, text)
    proposal = Proposal(
        column.name, channel, unit, sign, evidence, asked, others=alternatives, is_weak=is_weak
    )
    return Offer(score, column, proposal)


def _as_lateral(search: Search, column: Candidate) -> Offer | None:
    known = search.known
    is_named_otherwise = STRONG in column.hints.values()
    found = [
        agreement(known, column, channel, unit, f"d({channel})/dt")
        for channel in REFERENCES
        if column.measures(channel)
        and (column.hints.get(channel) == STRONG or not is_named_otherwise)
        for unit in column.units(channel)
    ]
    found = sorted(
        (one for one in found if _is_plausible(known, column, one)),
        key=lambda one: 0.3 * one.mismatch - 2.0 * one.strength,
    )
    if not found:
        return None
    hints = {channel: column.hints.get(channel, 0.0) for channel in REFERENCES}
    best = max(
        found,
        key=lambda one: 4.0 * one.strength - 0.6 * min(one.mismatch, 5.0) + hints[one.channel],
    )
    hint = hints[best.channel]
    rivals = [
        one
        for one in found
        if one.channel != best.channel and one.strength > best.strength - 0.05 and not hint
    ]
    is_clear = best.strength >= CLEAR_LATERAL or (best.strength >= LEAST and hint > 0.0)
    asked = (
        f"could be {rivals[0].channel} in {rivals[0].unit} as well"
        if rivals
        else ""
        if is_clear
        else HARDLY
    )
    if not rivals and not is_clear and hint == STRONG:
        asked = f"sign: {HARDLY}" if column.unit else f"sign and unit: {HARDLY}"
    if not asked and column.hint(best.channel) < 0.0:
        asked = "the motion contradicts its name"
    evidence = (best.in_words or "its name alone", *_name_evidence(column, *REFERENCES))
    others = (
        tuple(dict.fromkeys(f"{one.channel} {one.unit}" for one in found if one is not best))
        if asked
        else ()
    )
    proposal = Proposal(
        column.name, best.channel, best.unit, best.sign, evidence, asked, others=others
    )
    return Offer(_score(best.strength, LEAST, hint), column, proposal)


def _score(strength: float, least: float, hint: float) -> float:
    return 8.0 * (strength - least) / (1.0 - least) + hint if strength else hint - 1.0


def _is_plausible(known: Motion, column: Candidate, one: Agreement) -> bool:
    """Whether a car can slide like that, within a factor of what is rare."""
    size = float(np.quantile(np.abs(column.values), 0.9)) * si_factor(one.unit, one.channel)
    return (
        size < 1.5 * float(np.quantile(known.vx, 0.9))
        if one.channel == "vy_ref"
        else 5e-4 < size < 1.6
    )


def _name_evidence(column: Candidate, *wanted: str) -> Sequence[str]:
    parts = [
        *(["name"] if any(role in column.hints for role in wanted) else []),
        *(["unit"] if column.unit else []),
    ]
    return [f"its {' and '.join(parts)}"] if parts else []


def longitudinal(known: Motion, column: Candidate, units: Sequence[str] = ()) -> Agreement:
    """A column as ``ax`` in the unit whose scale agrees best, of those given or all."""
    found = (agreement(known, column, "ax", unit, "ax") for unit in units or column.units("ax"))
    return min(found, key=lambda one: one.mismatch)


def agreement(
    known: Motion, column: Candidate, channel: str, unit: str, left: str, *, offset: float = 0.0
) -> Agreement:
    """Agreement with a motion of a column, less an offset in its unit, as a channel, by the relation with that left side."""
    samples = (column.values - offset) * si_factor(unit, channel)
    if channel == "sideslip_ref":
        samples = np.where(np.abs(known.vx) < CRAWL_SHARE * largest(known.vx), 0.0, samples)
    velocity = channel if channel in REFERENCES else ""
    with np.errstate(all="ignore"):
        relations = relations_of(
            replace(known, channels={**known.channels, channel: samples}, velocity=velocity)
        )
    for one in relations:
        if one.left == left:
            scale = f", {abs(one.scale):.3g} times as large" if math.isfinite(one.tolerance) else ""
            text = f"{one.text} agree {one.correlation:.2f}{scale}"
            return Agreement(
                channel,
                unit,
                abs(one.correlation),
                -1 if one.correlation < 0.0 else 1,
                abs(one.scale),
                text,
            )
    return Agreement(channel, unit)


def angles(known: Motion, column: Candidate) -> list[Angle]:
    """Road wheel or steering wheel in each unit that range and slow corners allow, by angle = length·yaw_rate/vx + K·ay + offset."""
    ay = known.channels.get("ay", known.turning)
    driven = _driven(known)
    calm = driven & (np.abs(ay) <= 0.5 * float(np.quantile(np.abs(ay), 0.95)) + 1e-9)
    slope, offset = _regressed(known, column, calm if calm.sum() >= FEWEST_CALM else driven, ay)
    reach = float(np.quantile(np.abs(column.values - offset), 0.995))
    is_model = float(np.quantile(known.vx, 0.99)) < FASTEST_MODEL
    found = []
    for channel, (low, high) in LENGTHS.items():
        for unit in column.units("steer"):
            factor = si_factor(unit, channel)
            length = abs(slope) * factor
            shortest = SMALL if is_model and channel == "steer" else low
            straight = channel == "handwheel" or abs(offset) * factor < STRAIGHT_AHEAD
            if shortest <= length <= high and reach * factor <= LARGEST[channel] and straight:
                found.append(
                    Angle(
                        abs(math.log(length / USUAL_LENGTH[channel])),
                        channel,
                        unit,
                        length,
                        reach * factor,
                    )
                )
    return found


def _driven(known: Motion) -> BoolArray:
    return known.moving & (known.vx > 0.2 * float(np.quantile(known.vx, 0.99)))


def _regressed(
    known: Motion, column: Candidate, used: BoolArray, *more: FloatArray
) -> tuple[float, float]:
    """Change of a column by yaw_rate/vx [its unit · m], and its value straight ahead; further regressors are fitted beside them."""
    rows = [
        known["yaw_rate"][used] / known.vx[used],
        *(samples[used] for samples in more),
        np.ones(int(used.sum())),
    ]
    slope, *_, offset = np.linalg.lstsq(np.stack(rows, axis=1), column.values[used], rcond=None)[
        0
    ].tolist()
    return slope, offset
