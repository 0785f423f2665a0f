"""From columns to channels: the three that turning ties together first, then what agrees with them, then what names alone tell."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from vehest.alignment.proposals import names as roles
from vehest.alignment.proposals.agreement import (
    HAND_WHEEL,
    ROAD_WHEEL,
    Agreement,
    Known,
    angles,
    lateral,
    longitudinal,
    slope_of_steering,
    steering,
)
from vehest.alignment.proposals.by_name import TOLD, named_channels
from vehest.alignment.proposals.columns import Candidate, candidates, correlation, slow_of
from vehest.alignment.proposals.poses import find_pose, named_pose
from vehest.alignment.proposals.proposal import LATERAL, Proposal, Proposals
from vehest.alignment.proposals.turning import CLOSE, FAR, RARE, UNITS, Turning, find_turning, turning_by_names
from vehest.alignment.proposals.wheels import Wheels, find_wheels, wheel_proposals, with_wheels_for_speed
from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.units import factor_to_si

SAME = {"vx": 0.97, "yaw_rate": 0.97}  # correlation of one quantity measured twice
SAME_NAMED = {"vx": 0.7, "yaw_rate": 0.9}  # of columns that are named alike; wheels slip
SAME_SCALE = 0.35  # logarithm
SAME_ANGLE = 0.9  # correlation of a sideslip angle with atan2(vy, vx)
STANDING = 0.5  # m/s; the car did not move
CLEAR = 0.6  # correlation that decides where nothing else comes near
CLEAR_LATERAL = 0.45  # of what hangs on derivatives of noisy channels
LEAST = 0.3
NEAR = 2.0  # score within which another column comes near
RATES = (5.0, 10.0, 20.0, 25.0, 40.0, 50.0, 60.0, 100.0, 125.0, 200.0, 250.0, 400.0, 500.0, 1000.0, 2000.0)
NOMINAL_RATE = 50.0  # Hz, where there are no times
CENTRED = 0.1  # of a command's range, by which straight ahead may lie beside nil
FEWEST = 50  # samples of a course
MOST_BEYOND = 0.002  # share of samples that may lie beyond what a vehicle can do, as spikes
ACCELERATIONS, ANGLES = ("m/s²", "g"), ("rad", "deg")


@dataclass(frozen=True, eq=False)
class Search:
    """Columns, and what has been found among them.

    Args:
        columns: that change.
        turning: speed, yaw rate and lateral acceleration; None where no three agree.
        known: the motion by these, ay = +vx·yaw_rate; None without.
        taken: indices of columns that have been given a channel, or repeat one.
    """

    columns: Sequence[Candidate]
    turning: Turning | None
    known: Known | None
    taken: set[int] = field(default_factory=set)

    def free(self) -> list[int]:
        """Columns that are left."""
        return [k for k in range(len(self.columns)) if k not in self.taken]


def propose(
    columns: Sequence[tuple[str, str, FloatArray]], rate_hz: float | None, *, compass: str = "", west_positive: bool = False
) -> Proposals:
    """What the columns of a log are.

    Args:
        columns: name, unit as vehest spells it (empty where the file does not say), values on an even clock, (T,) each.
        rate_hz: of that clock; None where nothing is known of it.
        compass: column that counts the heading clockwise by its file's format; empty where there is none.
        west_positive: whether longitudes count to the west.
    """
    rate = rate_hz or NOMINAL_RATE
    found = candidates(columns, rate)
    wheels = find_wheels(found)
    with_wheels = with_wheels_for_speed(found, wheels, rate)
    turning = find_turning(with_wheels)
    if turning and rate_hz is None:
        guessed = _rate_by_ax(with_wheels, turning[0], rate)
        if guessed is not None:
            found_again = propose(columns, guessed, compass=compass, west_positive=west_positive)
            return replace(found_again, rate_hz=guessed)
    search = _best(with_wheels, turning, rate)
    proposals = _assigned(search, wheels, rate)
    if not {"vy_ref", "sideslip_ref"} & set(proposals.by_channel):
        proposals = replace(proposals, pose=find_pose(search.columns, search.known))
        named = [one.name for one in named_pose(search.columns) if one is not None]
        if len(named) == 3 and not proposals.pose:
            text = f"no reference is made of '{', '.join(named)}'".replace(", ", "', '")
            proposals = replace(proposals, notes=(*proposals.notes, f"{text}: their derivatives are not the speed and the yaw rate"))
    if _stands(search.columns):
        proposals = replace(proposals, notes=(*proposals.notes, "the car stands all the time, by its speed; names alone tell its columns"))
    proposals = _left_and_right(proposals, search, wheels, _compasses(search, compass, west_positive))
    proposals = possible(proposals, {column.name: column.values for column in search.columns})
    used = {one.column for one in proposals.channels} | {column for _, column, _ in proposals.pose}
    unused = tuple(name for name, _, _ in columns if name not in used)
    return replace(proposals, unused=unused, rate_hz=NOMINAL_RATE if rate_hz is None else None)


def _best(columns: Sequence[Candidate], turning: Sequence[Turning], rate_hz: float) -> Search:
    """The triple that leaves most for the others to agree with."""

    def support(one: Turning) -> float:
        search = _search(columns, one, rate_hz)
        free = [k for k in search.free() if _may_be_ax(columns[k])]
        best = max((longitudinal(search.known, columns[k], ["m/s²"])[0].strength for k in free[:40]), default=0.0) if search.known else 0.0
        return one.score + 4.0 * best

    if _stands(columns):
        return Search(columns, None, None)
    if not turning:
        named = turning_by_names(columns)
        return Search(columns, None, None) if named is None else _search(columns, _speed_by_ax(columns, named, rate_hz), rate_hz)
    near = [one for one in turning if one.score > turning[0].score - 4.0]
    return _search(columns, max(near, key=support) if len(near) > 1 else near[0], rate_hz)


def _speed_by_ax(columns: Sequence[Candidate], named: Turning, rate_hz: float) -> Turning:
    """The same with the speed's unit by d(vx)/dt, where a column that is named as longitudinal acceleration tells it."""
    if columns[named.speed].unit:
        return named
    told: list[tuple[float, str]] = []
    for unit in UNITS[roles.SPEED]:
        search = _search(columns, replace(named, units=replace(named.units, speed=unit)), rate_hz)
        assert search.known is not None
        for column in (columns[k] for k in search.free() if roles.AX in columns[k].hints and _may_be_ax(columns[k])):
            found = longitudinal(search.known, column, [column.unit] if column.unit else ACCELERATIONS)
            told += [(one.mismatch + RARE.get(unit, 0.0), unit) for one in found if one.strength >= CLEAR]
    best = min(told, default=(math.inf, ""))
    return replace(named, units=replace(named.units, speed=best[1])) if best[0] < CLOSE else named


def _stands(columns: Sequence[Candidate]) -> bool:
    """Whether every column that is named as a speed, in a unit that the header gives, says that the car stands."""
    told = [one for one in columns if roles.SPEED in one.hints and one.unit and one.measures("m/s")]
    return bool(told) and all(np.quantile(np.abs(one.slow), 0.99) * factor_to_si(one.unit, "m/s") < STANDING for one in told)


def _may_be_ax(column: Candidate) -> bool:
    return column.measures("m/s²") and column.hint(roles.AX) >= 0.0


def _search(columns: Sequence[Candidate], turning: Turning, rate_hz: float) -> Search:
    units, backwards = turning.units, _backwards(columns[turning.speed])
    sign = math.copysign(1.0, turning.correlation) * backwards
    known = Known(
        rate_hz,
        columns[turning.speed].values * backwards * factor_to_si(units.speed, "m/s"),
        columns[turning.yaw_rate].values * factor_to_si(units.yaw_rate, "rad/s"),
        np.empty(0) if turning.ay < 0 else sign * columns[turning.ay].values * factor_to_si(units.ay, "m/s²"),
    )
    return Search(columns, turning, known, {turning.speed, turning.yaw_rate, turning.ay} - {-1})


def _backwards(speed: Candidate) -> int:
    """-1 where a speed counts down as the car drives ahead."""
    return -1 if float(np.median(speed.slow)) < 0.0 else 1


def _rate_by_ax(columns: Sequence[Candidate], turning: Turning, rate_hz: float) -> float | None:
    """The plain rate at which some column, in the unit of ay, is d(vx)/dt; None where none is."""
    search = _search(columns, turning, rate_hz)
    assert search.known is not None
    unit = turning.units.ay
    found = [longitudinal(search.known, columns[k], [columns[k].unit or unit])[0] for k in search.free() if _may_be_ax(columns[k])]
    best = max(found, key=lambda one: one.strength, default=None)
    if best is None or best.relation is None or best.strength < CLEAR:
        return None
    told = rate_hz * abs(best.relation.scale)
    return min(RATES, key=lambda plain: abs(math.log(plain / told)))


def _assigned(search: Search, wheels: Wheels, rate_hz: float) -> Proposals:
    """Signs as they are where the yaw rate counts as it does in the file."""
    found: dict[str, Proposal] = {}
    radius: float | None = None
    notes: tuple[str, ...] = ()
    if search.turning is not None and search.known is not None:
        for own in (*_turning_proposals(search, wheels), *_repeated(search, wheels)):
            before = found.get(own.channel)
            found[own.channel] = own if before is None or before.column != own.column else before.with_evidence(*own.evidence)
            found[own.channel] = replace(found[own.channel], asked=own.asked or found[own.channel].asked, others=own.others)
        fitting, notes = _one_sideslip(search, found, _fitting(search))
        found |= {one.channel: one for one in fitting}
        found = _unconfirmed(search, _paired(search, found, wheels))
    if wheels:
        made, radius = wheel_proposals(search.columns, wheels, search.known, made_speed="vx" not in found)
        found |= {one.channel: one for one in made}
        search.taken.update(wheels.columns.values())
    for own in named_channels(search.columns, search.free(), found, search.known):
        found[own.channel] = own
    gappy = {column.name for column in search.columns if column.missing > 0.0}
    channels = tuple(replace(one, gappy=one.column in gappy) for one in found.values())
    return Proposals(channels, wheel_radius=radius, notes=notes)


def _unconfirmed(search: Search, found: dict[str, Proposal]) -> dict[str, Proposal]:
    """The three of turning asked where no name or unit speaks for two of them, and nothing else agrees with them.

    yaw_rate ≈ steer·vx / wheelbase looks like ay ≈ vx·yaw_rate in other units.
    """
    turning = search.turning
    assert turning is not None
    if turning.ay < 0:
        return found
    lateral = {roles.YAW_RATE: search.columns[turning.yaw_rate], roles.AY: search.columns[turning.ay]}
    if any(column.unit or role in column.hints for role, column in lateral.items()):
        return found
    if any(name in found and not found[name].asked for name in ("ax", "vy_ref", "sideslip_ref")):
        return found
    doubt = "no name and no other column speaks for it: yaw rate and acceleration could be steering and yaw rate"
    three = {search.columns[k].name for k in (turning.speed, turning.yaw_rate, turning.ay)}
    return {name: replace(one, asked=one.asked or doubt) if one.column in three else one for name, one in found.items()}


def possible(proposals: Proposals, columns: Mapping[str, FloatArray]) -> Proposals:
    """Without what names alone tell and no vehicle can do; what the motion tells is asked there.

    Args:
        proposals: for a log.
        columns: of that log, or of another one of the same car: name -> values, (T,).
    """
    kept, notes = [], list(proposals.notes)
    for one in proposals.channels:
        told, beyond = CHANNELS[one.channel], one.beyond(columns[one.column])
        share = float(beyond.mean())
        if share > MOST_BEYOND and one.channel in TOLD:
            shown = f"{float(columns[one.column][int(np.argmax(beyond))]):.3g} {one.unit}"
            text = f"'{one.column}' is named as {one.channel}, but shows {shown} (possible: {told.low:.3g} to {told.high:.3g} {told.unit})"
            notes.append(f"{text}; it is left out")
            continue
        doubt = one.asked or f"{100.0 * share:.2g} % of its samples are beyond what a vehicle can do in {one.unit}"
        kept.append(replace(one, asked=doubt) if share > MOST_BEYOND else one)
    return replace(proposals, channels=tuple(kept), notes=tuple(notes))


def _turning_proposals(search: Search, wheels: Wheels) -> list[Proposal]:
    """Speed, yaw rate and lateral acceleration; a speed that is the mean of wheels is none of the file's."""
    turning, columns = search.turning, search.columns
    assert turning is not None
    speed, yaw_rate = columns[turning.speed], columns[turning.yaw_rate]
    units, backwards = turning.units, _backwards(speed)
    sign = -backwards if turning.correlation < 0.0 else backwards
    if turning.ay < 0:
        asked = "" if units.decided else "unit: no lateral acceleration ties speed and yaw rate together"
        text = "its name and unit" if units.decided else "its name and size"
        found = [Proposal(yaw_rate.name, "yaw_rate", units.yaw_rate, 1, (text,), asked)]
        return found if turning.speed in wheels.stand_in else [Proposal(speed.name, "vx", units.speed, backwards, (text,), asked), *found]
    size = math.exp(_signed(turning))
    text = f"ay and vx·yaw_rate agree {turning.correlation:.2f}, ay {size:.3g} times as large in these units"
    asked = "" if units.decided else "other units explain the scale as well"
    if units.mismatch >= FAR:
        asked = f"ay is {size:.2g} times as large as vx·yaw_rate: one of the three is in another unit"

    def own(column: Candidate, role: str, channel: str, unit: str, sign: int) -> Proposal:
        doubt = "" if column.unit and units.mismatch < FAR else asked
        if column.hint(role) <= -roles.STRONG:
            doubt = doubt or "the motion says so, its name says otherwise"
        return Proposal(column.name, channel, unit, sign, (text,), doubt)

    ay = columns[turning.ay]
    found = [own(yaw_rate, roles.YAW_RATE, "yaw_rate", units.yaw_rate, 1), own(ay, roles.AY, "ay", units.ay, sign)]
    return found if turning.speed in wheels.stand_in else [own(speed, roles.SPEED, "vx", units.speed, backwards), *found]


def _signed(turning: Turning) -> float:
    units = turning.units
    expected = factor_to_si(units.speed, "m/s") * factor_to_si(units.yaw_rate, "rad/s") / factor_to_si(units.ay, "m/s²")
    return math.log(turning.scale / expected)


def _repeated(search: Search, wheels: Wheels) -> list[Proposal]:
    """Columns that repeat the speed or the yaw rate: measured and reference told apart by names, or asked; it corrects the first ones."""
    turning = search.turning
    assert turning is not None
    found: list[Proposal] = []
    for place, role, channel, si, unit in (
        (turning.speed, roles.SPEED, "vx", "m/s", turning.units.speed),
        (turning.yaw_rate, roles.YAW_RATE, "yaw_rate", "rad/s", turning.units.yaw_rate),
    ):
        first = search.columns[place]
        ahead = _backwards(first) if channel == "vx" else 1
        units = {k: _same_unit(search.columns[k], first, unit, si, role, channel) for k in search.free()}
        same = [(search.columns[k], own, ahead * _sign(search.columns[k], first)) for k, own in units.items() if own]
        search.taken.update(k for k, own in units.items() if own)
        scaled = [k for k in search.free() if channel == "vx" and _is_scaled(search.columns[k], first)]
        if scaled and not same and place not in wheels.stand_in:
            search.taken.add(scaled[0])
            found += _scaled_speed(search.columns[scaled[0]], first, unit)
        if same:
            found += _told_apart([*(() if place in wheels.stand_in else [(first, unit, ahead)]), *same], channel)
    if turning.ay >= 0:
        first = search.columns[turning.ay]
        search.taken.update(
            k
            for k in search.free()
            if abs(correlation(search.columns[k].slow, first.slow)) > 0.99 and search.columns[k].hint(roles.AY) >= 0.0
        )
    return found


def _is_scaled(column: Candidate, first: Candidate) -> bool:
    """Whether a column that is named as a speed, without a unit, is one but for its scale, as a motor's speed is."""
    return (
        column.hints.get(roles.SPEED) == roles.STRONG and not column.unit and abs(correlation(column.slow, first.slow)) > SAME_NAMED["vx"]
    )


def _scaled_speed(column: Candidate, first: Candidate, unit: str) -> list[Proposal]:
    """The car's own speed in counts, and the reference's by which it is scaled."""
    ahead = _backwards(first)
    speed = first.slow * ahead * factor_to_si(unit, "m/s")
    factor = float(column.slow @ speed) / float(column.slow @ column.slow)
    asked = f"the car's own speed, {abs(factor):.5g} m/s for a unit of it, or another quantity; '{first.name}' is then the reference's"
    text = f"follows '{first.name}' ({correlation(column.slow, first.slow):.2f}), no unit of speed explains its scale"
    return [
        Proposal(column.name, "vx", "m/s", -1 if factor < 0.0 else 1, (text,), asked, factor=float(f"{abs(factor):.5g}")),
        Proposal(
            first.name,
            "vx_ref",
            unit,
            ahead,
            (f"'{column.name}' follows it",),
            f"the reference's speed, or the car's own ('{column.name}' in counts)",
        ),
    ]


def _sign(column: Candidate, first: Candidate) -> int:
    return -1 if correlation(column.slow, first.slow) < 0.0 else 1


def _same_unit(column: Candidate, first: Candidate, unit: str, si: str, role: str, channel: str) -> str:
    """The unit in which a column is another one measured again; empty where it is not."""
    agreeing = correlation(column.slow, first.slow)
    least = (SAME_NAMED if role in column.hints else SAME)[channel]
    if abs(agreeing) < least or column.hint(role) < 0.0 or any(one.startswith("wheel") for one in column.hints) or not column.measures(si):
        return ""
    size = [float(np.sqrt(np.mean(np.square(one.slow)))) for one in (column, first)]
    offered = (column.unit,) if column.unit else (("m/s", "km/h") if si == "m/s" else ("rad/s", "deg/s"))
    ranked = sorted((abs(math.log(size[0] * factor_to_si(own, si) / (size[1] * factor_to_si(unit, si)))), own) for own in offered)
    return ranked[0][1] if ranked[0][0] < SAME_SCALE else ""


def _told_apart(family: Sequence[tuple[Candidate, str, int]], channel: str) -> list[Proposal]:
    """The car's own and the reference's of columns that measure the same; more than these two are left out."""
    plain = [one for one in family if not one[0].is_filtered] or list(family)
    own = [one for one in plain if not one[0].is_reference]
    references = [one for one in plain if one[0].is_reference]
    text = f"agrees {min(abs(correlation(one[0].slow, family[0][0].slow)) for one in plain):.2f} with the other {channel}"
    if not own or not references:
        if len(plain) < 2:
            return [Proposal(one.name, channel, unit, sign) for one, unit, sign in plain]
        asked = f"which is the car's own {channel}, and which the reference's: no name tells"
        first, second = sorted(plain, key=lambda one: _roughness(one[0]), reverse=True)[:2]
        return [
            Proposal(first[0].name, channel, first[1], first[2], (text, "the rougher of the two"), asked, others=(f"{channel}_ref",)),
            Proposal(second[0].name, f"{channel}_ref", second[1], second[2], (text, "the smoother"), asked, others=(channel,)),
        ]
    own.sort(key=lambda one: -max(one[0].hints.values(), default=0.0))
    several = f"{len(own)} columns could be the car's own {channel}" if len(own) > 1 else ""
    first, reference = own[0], references[0]
    return [
        Proposal(first[0].name, channel, first[1], first[2], (text,), several, others=tuple(one[0].name for one in own[1:])),
        Proposal(reference[0].name, f"{channel}_ref", reference[1], reference[2], (text, "named as a reference")),
    ]


def _roughness(column: Candidate) -> float:
    """Size of the second difference."""
    return float(np.std(np.diff(column.values, 2))) / max(float(np.std(column.values)), 1e-12)


def _paired(search: Search, found: dict[str, Proposal], wheels: Wheels) -> dict[str, Proposal]:
    """The speed that is named like the lateral velocity is the reference's, where another speed or wheels can be the car's own."""
    lateral, asked = found.get("vy_ref"), {name for name in ("vx", "vx_ref") if name in found and found[name].asked}
    if lateral is None or "vx" not in found:
        return found
    speeds = {name: found[name] for name in ("vx", "vx_ref") if name in found}
    named = [name for name, one in speeds.items() if roles.pair_of(one.column, lateral.column)]
    if named == ["vx"] and asked == {"vx", "vx_ref"}:
        text = f"named like '{lateral.column}'"
        own, reference = replace(found["vx_ref"], channel="vx"), replace(found["vx"], channel="vx_ref")
        evidence = tuple(one for one in reference.evidence if not one.startswith("the rougher"))
        own = replace(own, evidence=tuple(one for one in own.evidence if not one.startswith("the smoother")))
        return {**found, "vx": own, "vx_ref": replace(reference, evidence=(*evidence, text))}
    if wheels and "vx_ref" not in found and (named == ["vx"] or roles.is_reference(found["vx"].column)):
        told = roles.is_reference(found["vx"].column)
        reference = replace(found["vx"], channel="vx_ref", others=("vx",)).with_evidence(
            "named as a reference" if told else f"named like '{lateral.column}', and wheels are there for vx"
        )
        reference = replace(reference, asked=reference.asked or ("" if told else "whether it is the car's own speed or the reference's"))
        return {name: one for name, one in found.items() if name != "vx"} | {"vx_ref": reference}
    return found


def _one_sideslip(search: Search, found: dict[str, Proposal], fitting: list[Proposal]) -> tuple[list[Proposal], tuple[str, ...]]:
    """Without a sideslip angle that is another one than atan2(vy, vx)."""
    own = {one.channel: one for one in fitting}
    if not {"vy_ref", "sideslip_ref"} <= set(own) or "vx" not in found:
        return fitting, ()
    by_name = {column.name: column for column in search.columns}
    speed = found.get("vx_ref", found["vx"])
    velocity, forward = (one.sign * by_name[one.column].slow * factor_to_si(one.unit, "m/s") for one in (own["vy_ref"], speed))
    moving = forward > 0.2 * forward.max()
    agreeing = correlation(np.arctan2(velocity, forward)[moving], by_name[own["sideslip_ref"].column].slow[moving])
    if abs(agreeing) >= SAME_ANGLE:
        return fitting, ()
    left = own["sideslip_ref"].column
    note = (
        f"'{left}' is not atan2({own['vy_ref'].column}, {speed.column}) (correlation {agreeing:.2f}), so no sideslip angle; it is left out"
    )
    return [one for one in fitting if one.channel != "sideslip_ref"], (note,)


# --- what agrees with the motion ----------------------------------------------------------------------------------------------------


def _fitting(search: Search) -> list[Proposal]:
    """Longitudinal acceleration, steering, lateral velocity and sideslip angle: the assignment with most evidence in all."""
    known, columns = search.known, search.columns
    assert known is not None
    free = [k for k in search.free() if roles.OTHER not in columns[k].hints and not any(r.startswith("wheel") for r in columns[k].hints)]
    offered: dict[tuple[str, int], tuple[float, Proposal]] = {}
    for k in free:
        for channel, offer in (("ax", _as_ax), ("steering", _as_steering), ("lateral", _as_lateral)):
            proposal = offer(search, columns[k])
            if proposal is not None:
                offered[channel, k] = proposal
    wanted = ["ax", "steering", "lateral"]
    scores = np.array([[offered[channel, k][0] if (channel, k) in offered else 0.0 for k in free] for channel in wanted])
    found: list[Proposal] = []
    chosen: dict[str, int] = {}
    if len(free):
        for row, place in zip(*linear_sum_assignment(scores, maximize=True), strict=True):
            key = (wanted[row], free[place])
            if key in offered and offered[key][0] > 0.0:
                chosen[wanted[row]] = free[place]
    search.taken.update(chosen.values())
    for channel, k in chosen.items():
        rivals = [offered[channel, other] for other in free if other not in search.taken and (channel, other) in offered]
        found.append(_with_rivals(offered[channel, k], rivals))
    return found + _second_lateral(search, found, offered, free)


def _with_rivals(chosen: tuple[float, Proposal], rivals: Iterable[tuple[float, Proposal]]) -> Proposal:
    score, proposal = chosen
    named = _is_named(proposal)
    near = [
        one.column
        for other, one in rivals
        if one.channel == proposal.channel and (other > score - NEAR or (other > 0.0 and _is_named(one) and not named))
    ]
    return replace(proposal, asked=f"{', '.join(near)} would do as well", others=tuple(near)) if near and not proposal.asked else proposal


def _is_named(proposal: Proposal) -> bool:
    return any(text.startswith("its name") for text in proposal.evidence)


def _second_lateral(
    search: Search, found: Sequence[Proposal], offered: dict[tuple[str, int], tuple[float, Proposal]], free: Sequence[int]
) -> list[Proposal]:
    """A sideslip angle beside a lateral velocity, or the other way round."""
    held = {one.channel for one in found} & {"vy_ref", "sideslip_ref"}
    more = [
        (offered["lateral", k], k)
        for k in free
        if k not in search.taken and ("lateral", k) in offered and offered["lateral", k][1].channel not in held and held
    ]
    if not more:
        return []
    (score, proposal), k = max(more, key=lambda one: one[0][0])
    if score < 3.0 + roles.STRONG:
        return []
    search.taken.add(k)
    return [proposal]


def _as_ax(search: Search, column: Candidate) -> tuple[float, Proposal] | None:
    assert search.known is not None
    assert search.turning is not None
    hint = column.hint(roles.AX)
    if not column.measures("m/s²") or hint < 0.0:
        return None
    found = longitudinal(search.known, column, [column.unit] if column.unit else ACCELERATIONS)
    best = found[0]
    unit = best.unit if best.strength else column.unit or search.turning.units.ay
    score = 8.0 * (best.strength - CLEAR) / (1.0 - CLEAR) + hint if best.strength else hint - 1.0
    text = best.in_words or "its name alone"
    clear = best.strength >= CLEAR and (best.mismatch < 1.1 or bool(column.unit))
    asked = "" if clear or (hint == roles.STRONG and column.unit) else "the motion hardly says"
    return score, Proposal(column.name, "ax", unit, best.sign, (text, *_name_text(column, roles.AX)), asked)


def _as_steering(search: Search, column: Candidate) -> tuple[float, Proposal] | None:
    """As an angle of the road wheels or of the steering wheel; where it can be neither, as a command that somebody has to scale."""
    known = search.known
    assert known is not None
    hint = max(column.hint(roles.STEER), column.hint(roles.HANDWHEEL))
    if hint < 0.0 or not column.measures("rad"):
        return None
    agreement = steering(known, column)
    score = 8.0 * (agreement.strength - CLEAR) / (1.0 - CLEAR) + hint if agreement.strength else hint - 1.0
    if score <= 0.0:
        return None
    slope, straight = slope_of_steering(known, column)
    sign = agreement.sign if agreement.strength else (-1 if slope < 0.0 else 1)
    text = (
        agreement.in_words or f"{column.name} follows yaw_rate/vx with sign {sign:+d}",
        *_name_text(column, roles.STEER, roles.HANDWHEEL),
    )
    found = angles(known, column, [column.unit] if column.unit else ANGLES)
    if roles.HANDWHEEL in column.hints:
        found = [one for one in found if one.channel == HAND_WHEEL] or found
    if not found:
        largest = "no angle of the road wheels or of a steering wheel by its range and slow corners; its scale is to be given"
        spread = float(np.quantile(np.abs(column.values - straight), 0.995))
        offset = straight if abs(straight) > CENTRED * spread else 0.0
        steered = [
            unit for unit in ([column.unit] if column.unit else ANGLES) if spread * factor_to_si(unit, "rad") <= CHANNELS[ROAD_WHEEL].high
        ]
        proposal = Proposal(column.name, ROAD_WHEEL, (steered or ["rad"])[0], sign, text, largest, offset=offset)
        return score, proposal
    best = min(found, key=lambda one: _oddness(one.length, one.channel))
    unclear = {(one.channel, one.unit) for one in found} - {(best.channel, best.unit)}
    asked = f"could be {' or '.join(f'{channel} in {unit}' for channel, unit in sorted(unclear))} as well" if unclear else ""
    asked = asked or ("" if agreement.strength >= CLEAR or hint == roles.STRONG else "the motion hardly says")
    others = tuple(f"{channel} {unit}" for channel, unit in sorted(unclear))
    return score, Proposal(column.name, best.channel, best.unit, sign, (*text, best.in_words), asked, others=others)


def _oddness(length: float, channel: str) -> float:
    return abs(math.log(length / (2.7 if channel == ROAD_WHEEL else 43.0)))


def _as_lateral(search: Search, column: Candidate) -> tuple[float, Proposal] | None:
    """As lateral velocity or sideslip angle of a reference."""
    assert search.known is not None
    kinds = []
    for role, channel, si, units in (
        (roles.LATERAL_VELOCITY, "vy_ref", "m/s", ("m/s", "km/h")),
        (roles.SIDESLIP, "sideslip_ref", "rad", ANGLES),
    ):
        told = {key for key, strength in column.hints.items() if strength == roles.STRONG}
        if column.measures(si) and column.hint(role) > -roles.STRONG and not (told and role not in told):
            kinds += [(role, channel, unit, si) for unit in ([column.unit] if column.unit else units)]
    if not kinds:
        return None
    found = [one for one in lateral(search.known, column, [kind[1:] for kind in kinds]) if _plausible(search.known, column, one)]
    hint_of = {channel: column.hints.get(role, 0.0) for role, channel, _, _ in kinds}
    if not found:
        return None
    best = max(found, key=lambda one: 4.0 * one.strength - 0.6 * min(one.mismatch, 5.0) + hint_of[one.channel])
    hint = hint_of[best.channel]
    score = 8.0 * (best.strength - LEAST) / (1.0 - LEAST) + hint if best.strength else hint - 1.0
    rivals = [one for one in found if one.channel != best.channel and one.strength > best.strength - 0.05 and not hint]
    clear = best.strength >= CLEAR_LATERAL or (best.strength >= LEAST and hint > 0.0) or (hint == roles.STRONG and column.unit)
    asked = f"could be {rivals[0].channel} in {rivals[0].unit} as well" if rivals else "" if clear else "the motion hardly says"
    text = (best.in_words or "its name alone", *_name_text(column, roles.LATERAL_VELOCITY, roles.SIDESLIP))
    if not best.strength and not column.unit:
        asked = "sign and unit: the motion hardly says"
    others = tuple(dict.fromkeys(f"{one.channel} {one.unit}" for one in found if one is not best)) if asked else ()
    return score, Proposal(column.name, best.channel, best.unit, best.sign, text, asked, others=others)


def _plausible(known: Known, column: Candidate, one: Agreement) -> bool:
    """Whether a car can slide like that, within a factor of what is rare."""
    si = "m/s" if one.channel == "vy_ref" else "rad"
    size = float(np.quantile(np.abs(column.values), 0.9)) * factor_to_si(one.unit, si)
    if one.channel == "vy_ref":
        return size < 1.5 * float(np.quantile(known.vx, 0.9))
    return 5e-4 < size < 1.6


def _name_text(column: Candidate, *wanted: str) -> tuple[str, ...]:
    return (
        (f"its name{' and unit' if column.unit else ''}",)
        if any(role in column.hints for role in wanted)
        else (("its unit",) if column.unit else ())
    )


# --- left and right ------------------------------------------------------------------------------------------------------------------


def _left_and_right(proposals: Proposals, search: Search, wheels: Wheels, compasses: Sequence[tuple[str, float]]) -> Proposals:
    """Signs as wheels or a compass tell; else as the most of the columns are, the yaw rate's own where they are even."""
    known = search.known
    if known is not None:
        told = wheels.turning_left(search.columns, known) if wheels else 0.0
        if abs(told) > 0.5:
            text = f"right wheels are faster where yaw_rate, sign {'+' if told > 0 else '-'}1, counts up ({abs(told):.2f})"
            return replace(proposals if told > 0.0 else proposals.mirrored(), left_right=text)
        for name, agreeing in compasses:
            if abs(agreeing) > 0.5:
                text = f"{name} runs against yaw_rate, sign {'+' if agreeing > 0 else '-'}1 ({abs(agreeing):.2f})"
                return replace(proposals if agreeing > 0.0 else proposals.mirrored(), left_right=text)
        if proposals.pose and _yaw_of_pose(search, proposals) < 0.0:
            return proposals.mirrored()
    counts = [one.sign for one in proposals.channels if one.channel in LATERAL]
    return proposals.mirrored() if sum(counts) < 0 and not proposals.pose else proposals


def _compasses(search: Search, compass: str, west_positive: bool) -> list[tuple[str, float]]:
    """What counts clockwise from north, with how much the yaw rate, counting to the left, runs against it."""
    known = search.known
    if known is None:
        return []
    found = []
    by_name = {one.name: one for one in search.columns}
    if compass in by_name:
        found.append((f"'{compass}', clockwise by its format,", correlation(*_turned(by_name[compass].values, known))))
    places = [next((one for one in search.columns if role in one.hints), None) for role in (roles.LATITUDE, roles.LONGITUDE)]
    if places[0] is not None and places[1] is not None:
        north, east = places[0].slow, places[1].slow * (-1.0 if west_positive else 1.0)
        east = east * math.cos(math.radians(min(abs(float(north.mean())), 89.0)))
        slow_rate = slow_of(known.yaw_rate, known.rate_hz)[: len(north)]
        course = np.unwrap(np.arctan2(np.gradient(east), np.gradient(north)))
        turned = -np.gradient(course)
        usual = (np.abs(turned) < 1.0) & (np.hypot(np.gradient(east), np.gradient(north)) > 0.0)
        if usual.sum() > FEWEST:
            found.append(("the course over latitude and longitude", correlation(turned[usual], slow_rate[usual])))
    return found


def _turned(degrees: FloatArray, known: Known) -> tuple[FloatArray, FloatArray]:
    """Yaw rate by a compass, and the one that is known, where both can be."""
    turned = -np.gradient(np.unwrap(np.radians(degrees))) * known.rate_hz
    usual = np.abs(turned) < 8.0
    return turned[usual], known.yaw_rate[usual]


def _yaw_of_pose(search: Search, proposals: Proposals) -> float:
    """Correlation of the yaw rate with the derivative of a pose's yaw, counter-clockwise."""
    name, unit = next((column, unit) for part, column, unit in proposals.pose if part == "yaw")
    column = next(one for one in search.columns if one.name == name)
    assert search.known is not None
    turned, rate = _turned(-np.degrees(column.values * factor_to_si(unit, "rad")), search.known)
    return correlation(turned, rate)
