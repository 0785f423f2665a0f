"""Proposes channels: columns -> speed, yaw rate and ay -> columns that agree with them -> columns by name -> Proposals."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from vehest.alignment.motion import Motion
from vehest.alignment.proposals.columns import (
    UNITS,
    Candidate,
    candidates,
    correlation,
    largest,
    si_factor,
    slow_of,
    without_axes,
)
from vehest.alignment.proposals.fitting import (
    CLEAR,
    REFERENCES,
    Agreement,
    fitting_channels,
    longitudinal,
    may_be_ax,
)
from vehest.alignment.proposals.names import STRONG, WEAK, is_filtered
from vehest.alignment.proposals.poses import find_pose, named_pose, turning_of
from vehest.alignment.proposals.proposal import LATERAL, Proposal, Proposals
from vehest.alignment.proposals.turning import (
    CLOSE,
    FAR,
    RARE,
    Search,
    Turning,
    find_turning,
    is_evident,
    reference_speed,
    repeated,
    turning_by_names,
)
from vehest.alignment.proposals.wheels import (
    Wheels,
    find_wheels,
    speed_of_wheels,
    turning_left,
    wheel_proposals,
    wheels_over_speed,
)
from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS

STANDING = 0.5  # m/s; the car did not move
NEAR_SCORE = 4.0  # of the best triple, within which others are compared with it
MOST_COMPARED = 40  # columns
FITTING_SPEED = (0.97, 1.08)
FITTING_SPEED_ALONE = (0.92, 1.08)  # where d(vy)/dt is not known
MISREAD = (
    0.9,
    1.35,
)  # of ay over vx·yaw_rate: where a speed is right, and where it is not, but in its unit
WHEELS_AGREE = 0.02
WORLD_AGREEING = 0.98  # correlation of a velocity with the derivative of a position
WORLD_CROSSING = 0.05  # of the position's other axis over it, so that the car turned
DECIDING = 0.5  # correlation by which wheels or a compass decide which way is left
RATES = (
    5.0,
    10.0,
    20.0,
    25.0,
    40.0,
    50.0,
    60.0,
    100.0,
    125.0,
    200.0,
    250.0,
    400.0,
    500.0,
    1000.0,
    2000.0,
)
NOMINAL_RATE = 50.0  # Hz, where there are no times
FEWEST = 50  # samples of a course
COURSE_SPEED = 0.2  # of the top speed, below which a course over positions is noise
SIDESLIP = (0.01, 1.0)  # rad, nearly the whole range of a sideslip angle
MOST_BEYOND = 0.002  # share of samples that may lie beyond what a vehicle can do, as spikes
USUAL = {  # 99th percentile of the motion's channels, SI
    "vx": (1.0, 90.0),
    "yaw_rate": (0.03, 3.0),
    "ay": (0.5, 25.0),
    "ax": (0.3, 25.0),
    "handwheel": (0.2, 14.0),
    "steer": (0.01, 0.7),
    "vy_ref": (0.02, 8.0),
    "sideslip_ref": (0.002, 0.8),
}
UNCONFIRMED = "no other column agrees with it"
SINGLE_EVIDENCE = (
    "one piece of evidence is not enough: neither unit, name nor another column agrees"
)
AGREEING = {
    "vx": {"ax"},
    "yaw_rate": {"steer", "handwheel", *REFERENCES},
    "ay": {*REFERENCES},
}
"""Channel -> those whose relation confirms it."""
NEEDS_EVIDENCE = ("vx", "yaw_rate", "ay")  # channels of two pieces of evidence, or none
BY_NAME_ALONE = (
    "motor_current",
    "brake_pressure_front",
    "brake_pressure_rear",
    "roll",
    "pitch",
    "roll_rate",
    "pitch_rate",
)
"""Channels that no relation is known of."""


def propose(
    columns: Sequence[tuple[str, str, FloatArray, str]],
    rate_hz: float | None,
    *,
    is_vbo: bool = False,
) -> Proposals:
    """Propose channels for the columns of a log.

    Args:
        columns: name, unit as vehest spells it (empty where the file has none), values on an even clock, (T,) each, and ``car`` or
            ``reference`` where the file says which of them measured it, else nothing.
        rate_hz: of that clock; None where it is unknown.
        is_vbo: whether the column ``heading`` counts clockwise and longitudes to the west, as in a VBOX's log.
    """
    rate = rate_hz or NOMINAL_RATE
    found = candidates(columns, rate)
    wheels = find_wheels(found)
    found = [one for one in found if not any(role.startswith("wheel_speed") for role in one.hints)]
    found += speed_of_wheels(found, wheels, rate)
    speeds = [one for one in found if "vx" in one.hints and one.unit and one.measures("vx")]
    stands = bool(speeds) and all(one.size * si_factor(one.unit, "vx") < STANDING for one in speeds)
    turning = [] if stands else find_turning(found)
    if not (turning or stands):
        by_motion = without_axes(found)
        turning = find_turning(by_motion)
        found = by_motion if turning else found
    guessed = _rate_by_ax(_of(found, turning[0], rate)) if turning and rate_hz is None else None
    if guessed is not None:
        return replace(propose(columns, guessed, is_vbo=is_vbo), rate_hz=guessed)
    search = None if stands else _search(found, turning, rate)
    proposals = _assigned(found, search, wheels)
    notes = [*proposals.notes]
    known = search.known if search else None
    if not set(REFERENCES) & set(proposals.by_channel):
        proposals = replace(proposals, pose=find_pose(found, known))
        named = [f"'{one.name}'" for one in named_pose(found)]
        if len(named) == 3 and not proposals.pose:
            notes.append(
                f"no reference is made of {', '.join(named)}: their derivatives are not the speed and the yaw rate"
            )
        notes += [] if known is None or proposals.pose else _sideslip_to_save(found, known)
    if stands:
        notes.append("the car stands all the time, by its speed; names alone suggest channels")
    proposals = _world_axis_asked(proposals, found, rate)
    if search is not None:
        proposals, more = _speedometer(proposals, search, wheels, found)
        notes += more
    clues = () if known is None else _clues(found, wheels, known, is_vbo)
    proposals = _as_most_count(
        _left_and_right(replace(proposals, notes=tuple(notes)), found, known, clues)
    )
    proposals = possible(
        proposals, {column.name: column.values for column in (*found, *wheels.values())}
    )
    used = {one.column for one in proposals.channels} | {column for _, column, _ in proposals.pose}
    unused = tuple(name for name, *_ in columns if name not in used)
    return replace(proposals, unused=unused, rate_hz=NOMINAL_RATE if rate_hz is None else None)


def possible(proposals: Proposals, columns: Mapping[str, FloatArray]) -> Proposals:
    """Without channels by name alone whose values no vehicle can have, in columns (T,) of any log of the car; others are asked there."""
    kept = []
    notes = list(proposals.notes)
    for one in proposals.channels:
        beyond = one.beyond(columns[one.column])
        share = float(beyond.mean())
        if share > MOST_BEYOND and one.channel in BY_NAME_ALONE:
            limits = CHANNELS[one.channel]
            shown = f"{float(columns[one.column][int(np.argmax(beyond))]):.3g} {one.unit}"
            text = f"'{one.column}' is named as {one.channel}, but shows {shown} (possible: {limits.low:.3g} to {limits.high:.3g}"
            notes.append(f"{text} {limits.unit}); it is left out")
        elif share > MOST_BEYOND and not one.asked:
            kept.append(
                replace(
                    one,
                    asked=f"{100.0 * share:.2g} % of its samples are beyond what a vehicle can do in {one.unit}",
                )
            )
        else:
            kept.append(one)
    return replace(proposals, channels=tuple(kept), notes=tuple(notes))


def _world_axis_asked(
    proposals: Proposals, columns: Sequence[Candidate], rate_hz: float
) -> Proposals:
    """The velocities asked where one is the derivative of a position along an axis of the world."""
    speed = proposals.by_channel.get("vx")
    positions = [
        next(one.slow for one in columns if role in one.hints)
        for role in ("position_x", "position_y")
        if any(role in one.hints for one in columns)
    ]
    if speed is None or speed.asked or len(positions) < 2:
        return proposals
    along, across = (np.gradient(samples) for samples in positions)
    by_name = {one.name: one for one in columns}
    slow = by_name[speed.column].slow if speed.column in by_name else along
    crossing = float(np.std(across)) > WORLD_CROSSING * float(np.std(along))
    of_axis = max(abs(correlation(slow, steps)) for steps in (along, across))
    of_path = abs(correlation(slow, np.hypot(along, across)))
    if not (crossing and of_axis > WORLD_AGREEING and of_axis > of_path):
        return proposals
    doubt = "it is the derivative of a position: of an axis of the world, not of the car?"
    return replace(
        proposals,
        channels=tuple(
            replace(one, asked=one.asked or doubt, is_weak=True)
            if one.channel in ("vx", "vy_ref")
            else one
            for one in proposals.channels
        ),
    )


def _speedometer(
    proposals: Proposals, search: Search, wheels: Wheels, columns: Sequence[Candidate]
) -> tuple[Proposals, list[str]]:
    """The speed asked where ay over the yaw rate and the wheels agree that it misreads.

    A note where ay alone says so: by d(vy)/dt + vx·yaw_rate where a reference gives vy. Without
    one, d(vy)/dt makes up some per cent, so that only more than these count.
    """
    own = proposals.by_channel.get("vx")
    turning = search.turning
    if "ay" not in turning.columns or own is None:
        return proposals, []
    expected, usual = _expected_ay(proposals, search.known, columns)
    ay = slow_of(search.known["ay"], search.known.rate_hz)
    scale = float(np.std(ay) / np.std(expected))
    agreeing = abs(correlation(ay, expected))
    if not MISREAD[0] < scale < MISREAD[1] or usual[0] <= scale <= usual[1]:
        return proposals, []
    by_wheels = wheels_over_speed(
        wheels, proposals, turning.columns["vx"].slow * si_factor(own.unit, "vx")
    )
    if by_wheels is None or abs(by_wheels - turning.scale) > WHEELS_AGREE:
        bounds = scale / agreeing, scale * agreeing  # by regression either way
        if any(usual[0] <= bound <= usual[1] for bound in bounds):
            return proposals, []
        other = "little" if scale < 1.0 else "much, as in a body that rolls"
        return proposals, [
            f"'{own.column}' reads {_excess(*bounds)} by ay over yaw_rate, or ay too {other}; a factor in the data set corrects it"
        ]
    scaled = f"vx {own.unit} {own.sign:+d} {own.factor * by_wheels:.3f}"
    doubt = (
        own.asked
        or f"it reads {_excess(by_wheels)} by the wheels and by ay over yaw_rate, as speedometers do; '{scaled}' corrects it"
    )
    changed = replace(own, asked=doubt, others=(*own.others, scaled))
    return replace(
        proposals, channels=tuple(changed if one is own else one for one in proposals.channels)
    ), []


def _expected_ay(
    proposals: Proposals, known: Motion, columns: Sequence[Candidate]
) -> tuple[FloatArray, tuple[float, float]]:
    """ay by the motion, (S,), and the range of ay over it by which the speed is right."""
    for name in REFERENCES:
        reference = proposals.by_channel.get(name)
        if reference is None:
            continue
        samples = next(one.values for one in columns if one.name == reference.column)
        factor = reference.sign * si_factor(reference.unit, name)
        channels = {**known.channels, name: np.where(known.moving, samples * factor, 0.0)}
        motion = replace(known, channels=channels, velocity=name)
        return slow_of(motion.turning + motion.sliding, known.rate_hz), FITTING_SPEED
    return slow_of(known.turning, known.rate_hz), FITTING_SPEED_ALONE


def _excess(*scales: float) -> str:
    size = " to ".join(dict.fromkeys(f"{abs(100.0 * (1.0 / scale - 1.0)):.0f}" for scale in scales))
    return f"{size} % too {'much' if scales[0] < 1.0 else 'little'}"


def _search(
    columns: Sequence[Candidate], turning: Sequence[Turning], rate_hz: float
) -> Search | None:
    """The triple that agrees best with a longitudinal acceleration among the best ones; speed and yaw rate by name where there is none."""
    if not turning:
        named = turning_by_names(columns)
        return (
            None if named is None else _of(columns, _speed_by_ax(columns, named, rate_hz), rate_hz)
        )
    near = [
        _of(columns, one, rate_hz) for one in turning if one.score > turning[0].score - NEAR_SCORE
    ]
    return max(
        near,
        key=lambda one: (
            one.turning.score + 4.0 * max((by_ax.strength for by_ax in _by_ax(one)), default=0.0)
        ),
    )


def _of(columns: Sequence[Candidate], turning: Turning, rate_hz: float) -> Search:
    used = turning.columns.values()
    return Search(
        turning,
        turning.motion(rate_hz),
        [one for one in columns if one not in used and not one.is_made],
    )


def _by_ax(search: Search, unit: str = "") -> list[Agreement]:
    """Agreements of d(vx)/dt with columns that may be a longitudinal acceleration, in a unit where the header is silent, or the best."""
    columns = [one for one in search.free if may_be_ax(one)][:MOST_COMPARED]
    return [longitudinal(search.known, one, [one.unit or unit] if unit else ()) for one in columns]


def _speed_by_ax(columns: Sequence[Candidate], named: Turning, rate_hz: float) -> Turning:
    """The same with the speed's unit by d(vx)/dt, where a column that may be a longitudinal acceleration decides it."""
    found = [(CLOSE, named)]
    for unit in named.columns["vx"].units("vx"):
        turning = replace(named, units={**named.units, "vx": unit})
        agreeing = [
            one.mismatch for one in _by_ax(_of(columns, turning, rate_hz)) if one.strength >= CLEAR
        ]
        found += [(mismatch + RARE.get(unit, 0.0), turning) for mismatch in agreeing]
    return min(found, key=lambda one: one[0])[1]


def _rate_by_ax(search: Search) -> float | None:
    """The plain rate at which some column, in the unit of ay, is d(vx)/dt; None where none is."""
    best = max(
        _by_ax(search, search.turning.units["ay"]), key=lambda one: one.strength, default=None
    )
    if best is None or best.strength < CLEAR:
        return None
    exact = search.known.rate_hz * best.scale
    return min(RATES, key=lambda plain: abs(math.log(plain / exact)))


def _assigned(columns: Sequence[Candidate], search: Search | None, wheels: Wheels) -> Proposals:
    """Proposals with signs that hold where the yaw rate counts as it does in the file."""
    found: dict[str, Proposal] = {}
    radius: float | None = None
    notes: tuple[str, ...] = ()
    free = [one for one in columns if not one.is_made]
    if search is not None:
        for own in (*_turning_proposals(search.turning), *repeated(search)):
            before = found.get(own.channel)
            if before is not None and before.column == own.column:
                evidence = (*before.evidence, *own.evidence)
                asked = own.asked or before.asked
                others = own.others or before.others
                own = replace(own, evidence=evidence, asked=asked, others=others)
            found[own.channel] = own
        fitting, notes = fitting_channels(search)
        found |= fitting
        found = _unconfirmed(search.turning, reference_speed(found) if wheels else found)
        free = search.free
    if wheels:
        is_made = any(one.is_made for one in columns)
        made, radius = wheel_proposals(
            wheels, search.known if search else None, has_speed="vx" in found, is_made=is_made
        )
        found |= {one.channel: one for one in made}
    found |= {one.channel: one for one in _named_channels(free, found, moves=search is not None)}
    proposals = Proposals(tuple(found.values()), wheel_radius=radius, notes=notes)
    return proposals.with_tilt_signs()


def _named_channels(
    columns: Sequence[Candidate], held: Collection[str], *, moves: bool
) -> list[Proposal]:
    """Channels that only names suggest, of columns that are left beside the channels that are held; ``moves``: the motion is known.

    Channels of the motion are asked: had they agreed with the others, they would not be left. `BY_NAME_ALONE` are taken where
    the header gives their unit, or where only one is known.
    """
    found: dict[str, Proposal] = {}
    has_wheels = any(name.startswith("wheel_speed") for name in held)
    for channel in USUAL:
        least = STRONG if moves else WEAK
        named = [
            one for one in columns if one.hints.get(channel, 0.0) >= least and one.measures(channel)
        ]
        needless = (channel == "steer" and "handwheel" in {*held, *found}) or (
            channel == "vx" and has_wheels and moves
        )
        if not named or channel in held or needless:
            continue
        best = max(
            named,
            key=lambda one: (one.hints[channel], not is_filtered(one.name), not one.is_reference),
        )
        if best.name not in {one.column for one in found.values()}:
            found[channel] = _by_name(best, channel)
    for column in columns:
        for channel in BY_NAME_ALONE:
            is_sure = (column.unit or channel == "motor_current") and column.measures(channel)
            if is_sure and channel in column.hints and channel not in {*held, *found}:
                evidence = "its name and unit" if column.unit else "its name"
                found[channel] = Proposal(
                    column.name, channel, column.unit or CHANNELS[channel].unit, 1, (evidence,)
                )
    return list(found.values())


def _by_name(column: Candidate, channel: str) -> Proposal:
    """With the header's unit, or the first in which the column is of a usual size, or at least of a possible one."""
    if column.unit:
        return Proposal(
            column.name,
            channel,
            column.unit,
            1,
            ("its name and unit",),
            f"sign: {UNCONFIRMED}",
            others=UNITS[channel],
        )
    size = largest(column.values)
    (low, high) = USUAL[channel]
    sizes = {unit: size * si_factor(unit, channel) for unit in UNITS[channel]}
    fitting = [unit for unit, own in sizes.items() if low <= own <= high]
    fitting += [unit for unit, own in sizes.items() if own <= CHANNELS[channel].high]
    evidence = f"its name, and {size:.3g} for its 99th percentile"
    return Proposal(
        column.name,
        channel,
        (*fitting, *sizes)[0],
        1,
        (evidence,),
        f"unit and sign: {UNCONFIRMED}",
        others=UNITS[channel],
        is_weak=channel in NEEDS_EVIDENCE,
    )


def _turning_proposals(turning: Turning) -> Iterator[Proposal]:
    """Speed, yaw rate and lateral acceleration, without a speed that was made of wheels."""
    is_close = abs(math.log(turning.scale)) < FAR
    if "ay" in turning.columns:
        evidence = f"ay and vx·yaw_rate agree {turning.correlation:.2f}, ay {turning.scale:.3g} times as large in these units"
        asked = "" if turning.decided else "other units explain the scale as well"
        if not is_close:
            asked = f"ay is {turning.scale:.2g} times as large as vx·yaw_rate: one of the three is in another unit"
    else:
        evidence = "its name and unit" if turning.decided else "its name and size"
        asked = (
            ""
            if turning.decided
            else "unit: no lateral acceleration ties speed and yaw rate together"
        )
    for channel, column in turning.columns.items():
        if not column.is_made:
            doubt = "" if column.unit and "ay" in turning.columns and is_close else asked
            if channel == "ay" and not is_evident(column, turning.scale):
                doubt = (
                    doubt
                    or f"it is {turning.scale:.2g} times vx·yaw_rate without a unit or clear name: it may be a velocity"
                )
            if column.hint(channel) <= -STRONG:
                doubt = doubt or "the motion contradicts its name"
            unit = turning.units[channel]
            if column.unit not in ("", unit):
                doubt = f"by ay over vx·yaw_rate it is in {unit}, by its header in {column.unit}"
            others = (f"{channel} {column.unit}",) if column.unit not in ("", unit) else ()
            yield Proposal(
                column.name,
                channel,
                unit,
                turning.signs[channel],
                (evidence,),
                doubt,
                others=others,
            )


def _unconfirmed(turning: Turning, found: dict[str, Proposal]) -> dict[str, Proposal]:
    """Speed, yaw rate and lateral acceleration asked where one piece of evidence is all.

    Pieces are the relation ay ≈ vx·yaw_rate, another column that agrees, the unit of the header
    and the name. yaw_rate ≈ steer·vx / wheelbase and a lateral velocity follow a turn alike.
    """
    is_related = "ay" in turning.columns and abs(math.log(turning.scale)) < FAR
    sure = {name for name, one in found.items() if not one.asked}
    roles = {column.name: channel for channel, column in turning.columns.items()}
    changed = {}
    for name, one in found.items():
        channel = roles.get(one.column)
        if channel is None:
            continue
        column = turning.columns[channel]
        others = column.name != one.column or any("agrees" in text for text in one.evidence[1:])
        confirming = AGREEING[channel] | (AGREEING["vx"] if is_related else set())
        pieces = [is_related, bool(sure & confirming), others]
        pieces += [bool(column.unit), channel in column.hints]
        if sum(pieces) < 2:
            changed[name] = replace(one, asked=one.asked or SINGLE_EVIDENCE, is_weak=True)
    return {**found, **changed}


def _left_and_right(
    proposals: Proposals,
    columns: Sequence[Candidate],
    known: Motion | None,
    clues: Iterable[tuple[str, float]],
) -> Proposals:
    """Signs by the first clue that decides, else by a pose; else those of most columns, the yaw rate's own where they are even."""
    for text, agreeing in clues:
        if abs(agreeing) > DECIDING:
            turned = proposals if agreeing > 0.0 else proposals.mirrored()
            return replace(
                turned,
                left_right=f"{text.format('+1' if agreeing > 0.0 else '-1')} ({abs(agreeing):.2f})",
            )
    if proposals.pose and known is not None:
        _, name, unit = proposals.pose[-1]
        yaw = next(one for one in columns if one.name == name)
        return proposals if turning_of(yaw, unit, known) >= 0.0 else proposals.mirrored()
    counts = [one.sign for one in proposals.channels if one.channel in LATERAL]
    return proposals.mirrored() if sum(counts) < 0 else proposals


def _sideslip_to_save(columns: Sequence[Candidate], known: Motion) -> Iterator[str]:
    """Notes of two angles, such as course and heading, whose difference may be a sideslip angle."""
    for one, other in combinations((column for column in columns if "heading" in column.hints), 2):
        apart = one.values - other.values
        apart = np.angle(
            np.exp(1j * (np.radians(apart) if np.ptp(one.values) > 2.1 * math.pi else apart))
        )[known.moving]
        low, high = np.quantile(apart, [0.02, 0.98]) if len(apart) else (0.0, 0.0)
        if SIDESLIP[0] < high - low < SIDESLIP[1]:
            yield f"'{one.name}' less '{other.name}' may be the sideslip angle that is missing as a reference; save it as a column"


def _as_most_count(proposals: Proposals) -> Proposals:
    """With channels whose sign nothing but a name suggests counting to the side to which most of the others do."""
    by_name = [
        one
        for one in proposals.channels
        if one.channel in LATERAL - {"yaw_rate", "ay"} and one.evidence[0].startswith("its name")
    ]
    others = [
        one.sign for one in proposals.channels if one.channel in LATERAL and one not in by_name
    ]
    changed = (
        {one.channel: replace(one, sign=1 if sum(others) >= 0 else -1) for one in by_name}
        if others
        else {}
    )
    return replace(
        proposals, channels=tuple(changed.get(one.channel, one) for one in proposals.channels)
    )


def _clues(
    columns: Sequence[Candidate], wheels: Wheels, known: Motion, is_vbo: bool
) -> Iterator[tuple[str, float]]:
    """Texts with a place for the sign of the yaw rate, and correlations with the sign by which it counts to the left."""
    yield "right wheels are faster where yaw_rate, sign {}, counts up", turning_left(wheels, known)
    for column in columns:
        if is_vbo and column.name == "heading":
            yield (
                "'heading', clockwise by its format, runs against yaw_rate, sign {}",
                -turning_of(column, "deg", known),
            )
    latitude, longitude = (
        next((one.slow for one in columns if role in one.hints), None)
        for role in ("latitude", "longitude")
    )
    if latitude is None or longitude is None:
        return
    east = (
        longitude
        * (-1.0 if is_vbo else 1.0)
        * math.cos(math.radians(min(abs(float(latitude.mean())), 89.0)))
    )
    rate = slow_of(known["yaw_rate"], known.rate_hz)
    speed = slow_of(np.abs(known.vx), known.rate_hz)
    steps = np.gradient(east), np.gradient(latitude)
    course = np.arctan2(*steps)
    turned = np.angle(np.exp(-1j * np.gradient(np.unwrap(course))))
    moving = speed > COURSE_SPEED * float(speed.max())  # noise of positions turns a slow course
    usual = moving & (np.abs(turned) < 1.0) & (np.hypot(*steps) > 0.0)
    if usual.sum() > FEWEST:
        yield (
            "the course over latitude and longitude runs against yaw_rate, sign {}",
            correlation(turned[usual], rate[usual]),
        )
