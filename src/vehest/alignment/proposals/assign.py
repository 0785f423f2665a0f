"""Proposes a channel, unit and sign for each column of a log.

columns -> candidates
        -> speed, yaw rate and lateral acceleration, by ay ≈ vx·yaw_rate (`turning`)
        -> columns related to these three: ax, steering, lateral velocity, sideslip (`fitting`)
        -> other columns, by name and unit alone
        -> what is wrong where ay is not vx·yaw_rate in size (`scales`)
        -> questions: single evidence, world axes, wrong speed, left and right
        -> Proposals
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from vehest.alignment.motion import Motion
from vehest.alignment.proposals.columns import (
    RARE_UNITS,
    UNITS,
    Candidate,
    candidates,
    correlation,
    largest,
    magnitudes_beside_signs,
    si_factor,
    slow_of,
    unchanging,
    without_axes,
)
from vehest.alignment.proposals.fitting import (
    CLEAR_CORRELATION,
    REFERENCES,
    Agreement,
    fitting_channels,
    longitudinal,
    may_be_ax,
)
from vehest.alignment.proposals.names import STRONG, WEAK, is_filtered, is_pair
from vehest.alignment.proposals.poses import find_pose, named_pose, turning_of
from vehest.alignment.proposals.proposal import LATERAL, Proposal, Proposals
from vehest.alignment.proposals.scales import find_wrong_scale, is_scale_wrong
from vehest.alignment.proposals.turning import (
    CLOSE_MISMATCH,
    FAR_MISMATCH,
    RANGES,
    RARITY,
    UNIT_PENALTIES,
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
from vehest.constants import GRAVITY, FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.errors import abbreviated

MAX_STANDSTILL_SPEED = 0.5  # m/s, top speed of a log in which the car did not move
# largest difference of a triple's score from the best one within which agreement with ax decides
SCORE_MARGIN = 4.0
AX_WEIGHT = 4.0  # weight of the correlation of d(vx)/dt with ax in a triple's score
MAX_AX_CANDIDATES = 40  # largest number of columns that are compared with d(vx)/dt, the first ones
# smallest correlation of the gravity in an acceleration with that by an angle
MIN_GRAVITY_CORRELATION = 0.7
GRAVITY_WEIGHT = 4.0  # weight of the correlation of a roll angle with ay beyond vx·yaw_rate
MAX_LISTED = 8  # largest number of columns that a note names; further ones are counted
# range of ay over d(vy)/dt + vx·yaw_rate outside which the speed is questioned
SPEED_GAIN_RANGE = (0.97, 1.08)
# range of ay over vx·yaw_rate outside which the speed is questioned, where d(vy)/dt is not known
SPEED_GAIN_RANGE_WITHOUT_VY = (0.92, 1.08)
# range of the same outside which a unit may be wrong instead (`scales`)
MISREAD_SPEED_GAIN_RANGE = (0.74, 1.35)
# largest difference between the gains by wheel speeds and by ay/yaw_rate with which the speed is
# corrected
MAX_WHEEL_GAIN_DIFFERENCE = 0.02
# smallest correlation of a column along an axis of the world with a derivative of a position
MIN_WORLD_CORRELATION = 0.98
# smallest spread of the steps along one coordinate over that along the other; with less the path is
# straight
MIN_WORLD_CROSSING = 0.05
# smallest correlation of wheels or a course with the yaw rate by which they decide left and right
MIN_SIDE_CORRELATION = 0.5
# Hz, rates of which the nearest is proposed
PLAIN_RATES_HZ = (5, 10, 20, 25, 40, 50, 60, 100, 125, 200, 250, 400, 500, 1000, 2000)
NOMINAL_RATE_HZ = 50.0  # Hz, assumed for a log without times
# largest distance of log10(ax over d(vx)/dt) from a whole number with which a rate is off by
# decades
MAX_DECADE_ERROR = 0.1
MIN_COURSE_SAMPLES = 50  # number of samples of a course that it must exceed to decide a side
# lowest speed at which a course counts, over the top speed; the course of a slower car is noise
MIN_COURSE_SPEED_SHARE = 0.2
MAX_COURSE_STEP = 1.0  # rad, largest change of a course from sample to sample that counts
SIDESLIP_RANGE = (0.01, 1.0)  # rad, smallest and largest width of 96 % of a sideslip angle's values
# largest share of samples outside the possible range that may be spikes
MAX_IMPOSSIBLE_SHARE = 0.002
# channel -> range of its 99th percentile in cars, SI units
USUAL_MAGNITUDES = {
    "vx": (1.0, 90.0),
    "yaw_rate": (0.03, 3.0),
    "ay": (0.5, 25.0),
    "ax": (0.3, 25.0),
    "handwheel": (0.2, 14.0),
    "steer": (0.01, 0.7),
    "vy_ref": (0.02, 8.0),
    "sideslip_ref": (0.002, 0.8),
}
UNCONFIRMED = "no other column confirms it"  # end of a question on a channel without relations
# question on a channel with one piece of evidence
SINGLE_EVIDENCE = (
    "only one piece of evidence, two are needed (relation to other columns, unit, name)"
)
CONFIRMING_CHANNELS = {
    "vx": {"ax"},
    "yaw_rate": {"steer", "handwheel", *REFERENCES},
    "ay": {*REFERENCES},
}
"""Channel that needs two pieces of evidence -> channels whose relation to it is one."""
BY_NAME_ALONE = (
    "motor_current",
    "brake_pressure_front",
    "brake_pressure_rear",
    "roll",
    "pitch",
    "roll_rate",
    "pitch_rate",
)
"""Channels without a known relation to others."""


def propose(
    columns: Sequence[tuple[str, str, FloatArray, str]],
    rate_hz: float | None,
    *,
    is_vbo: bool = False,
    is_rate_sure: bool = True,
) -> Proposals:
    """Propose channels for the columns of a log.

    Parameters
    ----------
    columns : sequence of (name, unit, values, device)
        Unit as vehest spells it, empty where the file has none; values (T,) on an even clock;
        ``car`` or ``reference`` where the file states which of them measured it, else empty.
    rate_hz : float or None
        Sampling rate; None where it is unknown, and then estimated from d(vx)/dt and ax.
    is_vbo : bool
        Whether ``heading`` is clockwise and longitudes count to the west, as in a VBOX log.
    is_rate_sure : bool
        Whether the rate is not to be corrected by a power of ten, as d(vx)/dt and ax indicate it.

    Returns
    -------
    Proposals
        At most one proposal for a channel and for a column, with evidence and open questions;
        ``rate_hz`` where the rate was unknown or is corrected.
    """
    clock_hz = rate_hz or NOMINAL_RATE_HZ
    magnitudes = magnitudes_beside_signs(columns)
    magnitudes_and_signs = {*magnitudes, *magnitudes.values()}
    signed_columns = [column for column in columns if column[0] not in magnitudes_and_signs]
    usable = candidates(signed_columns, clock_hz)
    wheels, wheel_notes = find_wheels(usable)
    usable = [column for column in usable if not column.is_wheel]
    usable += speed_of_wheels(usable, wheels, clock_hz)
    is_standing = _is_standing(usable)
    in_world = _along_world_axes(usable)
    of_car = [column for column in usable if column.name not in in_world]
    is_car_measured = bool(in_world and find_turning(of_car))
    usable = of_car if is_car_measured else usable
    usable, turnings = (usable, []) if is_standing else _turnings_of_any_axes(usable)
    if turnings and (rate_hz is None or not is_rate_sure):
        best = _search_around(turnings[0], usable, clock_hz)
        true_hz = _rate_by_ax(best) if rate_hz is None else _rate_by_decades(best)
        if true_hz is not None:
            return replace(propose(columns, true_hz, is_vbo=is_vbo), rate_hz=true_hz)
    search = None if is_standing else _best_search(usable, turnings, clock_hz)
    motion = search.motion if search else None
    proposals = _assign(usable, search, wheels)
    proposals = _with_pose(proposals.with_notes(*wheel_notes), usable, motion)
    if is_standing:
        proposals = proposals.with_notes(
            f"the car stands still throughout (speed below {MAX_STANDSTILL_SPEED:g} m/s); channels "
            "are proposed by name only"
        )
    if is_car_measured:
        left_out = [f"'{name}'" for name, *_ in columns if name in in_world]
        proposals = proposals.with_notes(
            "left out as derivatives of a position along axes of the world: "
            f"{abbreviated(left_out, MAX_LISTED)}"
        )
    proposals = _ask_about_world_axes(proposals, in_world)
    if search is not None:
        proposals = _ask_about_speed(proposals, search, wheels, usable)
        if search.turning.is_reversing:
            name = search.turning.columns["vx"].name
            proposals = proposals.with_notes(
                f"'{name}' is negative most of the time, as of a car that reverses; if the car "
                "drove ahead, set 'sign: -1' of vx and reverse those of ax and ay, too"
            )
        if search.turning.may_be_unsigned and not _is_driven_ahead(search):
            speed, rate, ay = (search.turning.columns[name].name for name in RANGES)
            proposals = proposals.with_notes(
                f"'{ay}' counts against '{rate}', or '{speed}' has no sign and the car drove in "
                "reverse for the most part; if it did, set 'sign: -1' of vx, reverse that of ay, "
                "and remove a 'sign: -1' of ax"
            )
    clues = () if motion is None else _left_right_clues(usable, wheels, motion, is_vbo)
    proposals = _with_left_right(proposals, usable, motion, clues)
    proposals = possible(
        _with_signs_of_majority(proposals),
        {column.name: column.values for column in (*usable, *wheels.values())},
    )
    if constant := unchanging(columns):
        proposals = proposals.with_notes(
            f"constant, or of few values, and left out: {abbreviated(constant, MAX_LISTED)}; "
            "check these sensors"
        )
    proposals = proposals.with_notes(
        *(
            f"'{name}' is left out: it is never negative and '{sign}' holds its sign; write the "
            "signed value to one column"
            for name, sign in magnitudes.items()
        )
    )
    assigned = {proposal.column for proposal in proposals.channels}
    assigned |= {column for _, column, _ in proposals.pose}
    unused = tuple(name for name, *_ in columns if name not in assigned)
    return replace(proposals, unused=unused, rate_hz=NOMINAL_RATE_HZ if rate_hz is None else None)


def possible(proposals: Proposals, columns: Mapping[str, FloatArray]) -> Proposals:
    """Proposals without, or with questions on, channels whose values no vehicle can have.

    Parameters
    ----------
    proposals : Proposals
        Of any log of the car.
    columns : mapping of str to (T,)
        Values of the columns of a log, in the units of the file.

    Returns
    -------
    Proposals
        Without such channels of `BY_NAME_ALONE`, each with a note; other such channels with a
        question.
    """
    channels = []
    notes = []
    for proposal in proposals.channels:
        values = columns[proposal.column]
        is_beyond = proposal.is_impossible(values)
        share = float(is_beyond.mean())
        if share <= MAX_IMPOSSIBLE_SHARE:
            channels.append(proposal)
        elif proposal.channel in BY_NAME_ALONE:
            limits = CHANNELS[proposal.channel]
            value = f"{float(values[int(np.argmax(is_beyond))]):.3g} {proposal.unit}"
            notes.append(
                f"'{proposal.column}' is left out: it is named like {proposal.channel}, but its "
                f"value {value} is outside the possible range "
                f"({limits.low:.3g} to {limits.high:.3g} {limits.unit})"
            )
        else:
            question = (
                f"{100.0 * share:.2g} % of its samples are outside the possible range of "
                f"{proposal.channel} if its unit is {proposal.unit}"
            )
            channels.append(proposal.questioned(question))
    return replace(proposals, channels=tuple(channels)).with_notes(*notes)


# --- the motion ------------------------------------------------------------------------------


def _is_standing(columns: Sequence[Candidate]) -> bool:
    """Whether columns are named as speeds with units, and none of them ever exceeds
    MAX_STANDSTILL_SPEED.
    """
    speeds = [
        column.size * si_factor(column.unit, "vx")
        for column in columns
        if "vx" in column.hints and column.unit and column.measures("vx")
    ]
    return bool(speeds) and max(speeds) < MAX_STANDSTILL_SPEED


def _turnings_of_any_axes(
    columns: Sequence[Candidate],
) -> tuple[list[Candidate], list[Turning]]:
    """Columns that are used, and triples, best first, with x, y and z as named or, where it
    explains more, along any axes.
    """
    choices = [list(columns)]
    any_axes = without_axes(columns)
    if any_axes != choices[0]:
        choices.append(any_axes)
    triples = [(choice, find_turning(choice)) for choice in choices]
    return max(triples, key=lambda triple: triple[1][0].score if triple[1] else 0.0)


def _search_around(turning: Turning, columns: Sequence[Candidate], rate_hz: float) -> Search:
    """A search of the remaining columns, given speed, yaw rate and lateral acceleration."""
    chosen = turning.columns.values()
    free = [column for column in columns if column not in chosen and not column.is_wheel_mean]
    return Search(turning, turning.motion(rate_hz), free)


def _best_search(
    columns: Sequence[Candidate], turnings: Sequence[Turning], rate_hz: float
) -> Search | None:
    """The search around that one of the best triples that agrees best with an ax; of its
    accelerations, the one that agrees with a roll angle too. Without triples, around names.
    """
    if not turnings:
        turning = turning_by_names(columns)
        if turning is None:
            return None
        return _search_around(_with_speed_by_ax(turning, columns, rate_hz), columns, rate_hz)

    def score(search: Search) -> float:
        strengths = [agreement.strength for agreement, _ in _agreements_with_ax(search)]
        return search.turning.score + AX_WEIGHT * max(strengths, default=0.0)

    searches = [
        _search_around(turning, columns, rate_hz)
        for turning in turnings
        if turning.score > turnings[0].score - SCORE_MARGIN
    ]
    scores = {search: score(search) for search in searches}
    best = max(searches, key=lambda search: scores[search]).turning.columns
    other_accelerations = [
        search
        for search in searches
        if all(search.turning.columns[name] is best[name] for name in ("vx", "yaw_rate"))
    ]
    return max(
        other_accelerations,
        key=lambda search: scores[search] + GRAVITY_WEIGHT * _gravity(search),
    )


def _gravity(search: Search) -> float:
    """Correlation of ay with a roll angle, both beyond vx·yaw_rate.

    Of two accelerations, a sensor's contains gravity; a level-frame one does not.
    """
    turning = slow_of(search.motion.turning, search.motion.rate_hz)
    excess = _beyond(turning, slow_of(search.motion["ay"], search.motion.rate_hz))
    rolls = [column.slow for column in search.free if column.hints.get("roll") == STRONG]
    return max((abs(correlation(excess, _beyond(turning, roll))) for roll in rolls), default=0.0)


def _beyond(explaining: FloatArray, samples: FloatArray) -> FloatArray:
    """Residual of a signal's (S,) linear regression on another, (S,).

    So neither a scale nor a body that rolls in proportion to ay matters.
    """
    rows = np.stack([explaining, np.ones(len(explaining))], axis=1)
    return np.asarray(samples - rows @ np.linalg.lstsq(rows, samples, rcond=None)[0])


def _agreements_with_ax(search: Search, unit: str = "") -> list[tuple[Agreement, Candidate]]:
    """Agreements of d(vx)/dt with columns that may be ax.

    A column without a unit is taken in ``unit``; if that is empty, in the unit that fits best.
    """
    columns = [column for column in search.free if may_be_ax(column)][:MAX_AX_CANDIDATES]
    return [
        (longitudinal(search.motion, column, [column.unit or unit] if unit else ()), column)
        for column in columns
    ]


def _is_driven_ahead(search: Search) -> bool:
    """Whether an acceleration of the sensor of ay, that counts as ay's axes do in a car that drives
    ahead, agrees with d(vx)/dt.
    """
    return any(
        agreement.strength >= CLEAR_CORRELATION and agreement.sign > 0
        for agreement, _ in _agreements_with_ax(search)
    )


def _with_speed_by_ax(named: Turning, columns: Sequence[Candidate], rate_hz: float) -> Turning:
    """The triple with the unit of speed in which d(vx)/dt agrees best with an ax, where one decides
    it.
    """
    ranked = [(CLOSE_MISMATCH, named)]
    for unit in named.columns["vx"].units("vx"):
        turning = replace(named, units={**named.units, "vx": unit})
        ranked += [
            (
                agreement.mismatch
                + UNIT_PENALTIES.get(unit, 0.0)
                + RARITY * (agreement.unit in RARE_UNITS["ax"]),
                turning,
            )
            for agreement, _ in _agreements_with_ax(_search_around(turning, columns, rate_hz))
            if agreement.strength >= CLEAR_CORRELATION
        ]
    return min(ranked, key=lambda entry: entry[0])[1]


def _rate_by_ax(search: Search) -> float | None:
    """The plain rate at which a column, in the unit of ay, is d(vx)/dt - vy·yaw_rate; None where
    none is.

    Of a single track in steady turns, vy·yaw_rate is a sum of yaw_rate² and ay².
    """
    agreements = _agreements_with_ax(search, search.turning.units["ay"])
    clear = [entry for entry in agreements if entry[0].strength >= CLEAR_CORRELATION]
    if not clear:
        return None
    best, column = max(clear, key=lambda entry: entry[0].strength)
    motion = search.motion
    signals = (motion.derivative(motion.vx), motion["yaw_rate"] ** 2, motion["ay"] ** 2)
    regressors = [slow_of(samples, motion.rate_hz) for samples in signals]
    regressors.append(np.ones(len(column.slow)))
    scale = np.linalg.lstsq(np.stack(regressors, axis=1), column.slow, rcond=None)[0][0]
    rate_hz = motion.rate_hz * abs(scale) * si_factor(best.unit, "ax")
    return float(min(PLAIN_RATES_HZ, key=lambda plain: abs(math.log(plain / rate_hz))))


def _rate_by_decades(search: Search) -> float | None:
    """The rate times a power of ten, where an acceleration is d(vx)/dt at that rate only; else
    None.
    """
    ay = search.turning.columns["ay"]
    motion = search.motion
    change = slow_of(motion.derivative(motion.vx), motion.rate_hz)
    for column in search.free:
        is_of_same_sensor = is_pair(column.name, ay.name)
        agreement = correlation(column.slow, change)
        if may_be_ax(column) and is_of_same_sensor and abs(agreement) >= CLEAR_CORRELATION:
            size = si_factor(column.unit or search.turning.units["ay"], "ax")
            decades = math.log10(size * float(np.std(column.slow) / np.std(change)))
            is_whole = abs(decades - round(decades)) < MAX_DECADE_ERROR
            return motion.rate_hz * 10.0 ** round(decades) if is_whole and round(decades) else None
    return None


# --- channels --------------------------------------------------------------------------------


def _assign(columns: Sequence[Candidate], search: Search | None, wheels: Wheels) -> Proposals:
    """Proposals whose signs are right if that of the yaw rate's column is.

    Parameters
    ----------
    columns : sequence of Candidate
        All columns, the mean of the wheels among them.
    search : Search or None
        With the motion; None where no speed and yaw rate were found, so that only names decide.
    wheels : Wheels
        Columns that are named for a wheel.
    """
    channels: dict[str, Proposal] = {}
    radius: float | None = None
    notes: tuple[str, ...] = ()
    free = [column for column in columns if not column.is_wheel_mean]
    if search is not None:
        channels, notes, free = _channels_of_motion(search)
        wrong = find_wrong_scale(search, channels, columns, wheels)
        if wrong is not None:
            search = wrong.corrected(search)
            channels, notes, free = _channels_of_motion(search)
            channels = {name: wrong.questioned(channel) for name, channel in channels.items()}
        channels = reference_speed(channels) if wheels else channels
        channels = _ask_for_second_evidence(search.turning, channels)
    if wheels:
        wheel_channels, radius = wheel_proposals(
            wheels,
            search.motion if search else None,
            has_speed="vx" in channels,
            is_wheel_mean=any(column.is_wheel_mean for column in columns),
        )
        channels |= {proposal.channel: proposal for proposal in wheel_channels}
    channels |= _channels_by_name(free, channels, is_moving=search is not None)
    proposals = Proposals(tuple(channels.values()), wheel_radius=radius, notes=notes)
    proposals = proposals.with_tilt_signs()
    return _with_signs_of_gravity(proposals, search.motion, columns) if search else proposals


def _with_signs_of_gravity(
    proposals: Proposals, motion: Motion, columns: Sequence[Candidate]
) -> Proposals:
    """The proposals with the opposite sign, and a question, of a roll or pitch that gravity
    contradicts.

    A sensor measures ay = d(vy)/dt + vx·yaw_rate + g·sin(roll) and ax = d(vx)/dt - vy·yaw_rate -
    g·sin(pitch).
    """
    by_channel = proposals.by_channel
    slow = {
        proposal.channel: proposal.si(column.slow)
        for column in columns
        for proposal in proposals.channels
        if proposal.column == column.name
    }
    changes = {}
    for name, acceleration, kinematic in (
        ("roll", "ay", motion.turning),
        ("pitch", "ax", motion.derivative(motion.vx)),
    ):
        if not {name, acceleration} <= set(slow):
            continue
        gravity = np.sin(slow[name]) * (GRAVITY if name == "roll" else -GRAVITY)
        expected = slow_of(kinematic, motion.rate_hz)
        excess, gravity = (_beyond(expected, each) for each in (slow[acceleration], gravity))
        agreement = correlation(excess, gravity)
        gain = float(np.std(excess)) / max(float(np.std(gravity)), 1e-9)
        if agreement < -MIN_GRAVITY_CORRELATION and abs(math.log(gain)) < FAR_MISMATCH:
            question = f"sign: gravity in {acceleration} contradicts the axes of ax, ay, yaw_rate"
            reversed_proposal = replace(by_channel[name], sign=-by_channel[name].sign)
            changes[name] = reversed_proposal.questioned(question)
    return proposals.changed(changes)


def _channels_of_motion(
    search: Search,
) -> tuple[dict[str, Proposal], tuple[str, ...], list[Candidate]]:
    """Channels of the motion and those that agree with it, notes, and the columns without one."""
    rest = replace(search, free=list(search.free))
    channels: dict[str, Proposal] = {}
    for proposal in (*_turning_proposals(rest.turning), *repeated(rest)):
        channels[proposal.channel] = proposal.merged_with(channels.get(proposal.channel))
    fitting, notes = fitting_channels(rest)
    return channels | fitting, notes, rest.free


def _turning_proposals(turning: Turning) -> Iterator[Proposal]:
    """Proposals of speed, yaw rate and lateral acceleration, without a speed that was made of
    wheels.
    """
    question = ""
    if "ay" in turning.columns:
        figures = f"correlation {turning.correlation:.2f}, gain {turning.scale:.3g}"
        evidence = f"ay vs. vx·yaw_rate: {figures} in these units"
        if not turning.decided:
            question = "other units explain the gain equally well"
    else:
        evidence = "name and unit" if turning.decided else "name and magnitude"
        if not turning.decided:
            question = "unit: without a lateral acceleration, speed and yaw rate cannot be compared"
    for channel, column in turning.columns.items():
        if column.is_wheel_mean:
            continue
        unit = turning.units[channel]
        has_sure_unit = bool(column.unit) and "ay" in turning.columns
        doubts = ["" if has_sure_unit else question]
        if channel == "ay" and not is_evident(column, turning.scale):
            doubts.append(
                f"its gain to vx·yaw_rate is {turning.scale:.2g}, and it has no unit or clear "
                "name: it may be a velocity"
            )
        if column.hint(channel) <= -STRONG:
            doubts.append("its values contradict its name")
        yield Proposal(
            column.name,
            channel,
            unit,
            turning.signs[channel],
            (evidence,),
            next(filter(None, doubts), ""),
        )


def _ask_for_second_evidence(
    turning: Turning, channels: Mapping[str, Proposal]
) -> dict[str, Proposal]:
    """Channels, by name, with a question on speed, yaw rate and lateral acceleration if they have a
    single piece of evidence.

    Pieces are the relation ay ≈ vx·yaw_rate, a relation to another channel, a second measurement,
    the unit of the header and the name. yaw_rate ≈ steer·vx/wheelbase and a lateral velocity
    follow a turn alike. Where speed or yaw rate is left out, so is what was compared with them, if
    it has a question, and a unit that their gain decides.
    """
    is_related = "ay" in turning.columns and not is_scale_wrong(turning)
    sure = {name for name, proposal in channels.items() if not proposal.question}
    columns = {column.name: (role, column) for role, column in turning.columns.items()}
    checked = dict(channels)
    for name, proposal in channels.items():
        if proposal.column not in columns:
            continue
        role, column = columns[proposal.column]
        confirming = CONFIRMING_CHANNELS[role]
        confirming = confirming | CONFIRMING_CHANNELS["vx"] if is_related else confirming
        evidence = [is_related, bool(sure & confirming), proposal.is_repeated]
        evidence += [bool(column.unit), role in column.hints]
        if sum(evidence) < 2:
            checked[name] = replace(proposal.questioned(SINGLE_EVIDENCE), is_weak=True)
    confirmed = {
        name
        for name, proposal in channels.items()
        if proposal.column in columns and (turning.decided or columns[proposal.column][1].unit)
    }
    if any(checked[name].is_weak for name in ("vx", "yaw_rate") if name in checked):
        checked = {
            name: replace(
                proposal,
                is_weak=proposal.is_weak or (bool(proposal.question) and name not in confirmed),
            )
            for name, proposal in checked.items()
        }
    return checked


def _channels_by_name(
    columns: Sequence[Candidate], assigned: Collection[str], *, is_moving: bool
) -> dict[str, Proposal]:
    """Channels that only names suggest, of columns that remain.

    Channels of the motion are questioned: had they agreed with the others, they would not remain.
    `BY_NAME_ALONE` are accepted where the header gives their unit, or where only one is known.
    """
    channels: dict[str, Proposal] = {}
    has_wheels = any(name.startswith("wheel_speed") for name in assigned)
    min_hint = STRONG if is_moving else WEAK
    for channel in USUAL_MAGNITUDES:
        named = [
            column
            for column in columns
            if column.hints.get(channel, 0.0) >= min_hint and column.measures(channel)
        ]
        is_second_angle = channel == "steer" and "handwheel" in {*assigned, *channels}
        is_second_speed = channel == "vx" and has_wheels and is_moving
        if not named or channel in assigned or is_second_angle or is_second_speed:
            continue
        best = max(
            named,
            key=lambda column: (
                column.hints[channel],
                not is_filtered(column.name),
                not column.is_reference,
            ),
        )
        if best.name not in {proposal.column for proposal in channels.values()}:
            channels[channel] = _proposal_by_name(best, channel)
    for column in columns:
        for channel in BY_NAME_ALONE:
            is_sure = (column.unit or channel == "motor_current") and column.measures(channel)
            if is_sure and channel in column.hints and channel not in {*assigned, *channels}:
                evidence = "name and unit" if column.unit else "name"
                unit = column.unit or CHANNELS[channel].unit
                channels[channel] = Proposal(column.name, channel, unit, 1, (evidence,))
    return channels


def _proposal_by_name(column: Candidate, channel: str) -> Proposal:
    """A proposal in the header's unit, or the first in which the column's magnitude is usual, or at
    least possible.
    """
    unit = column.unit
    evidence = "name and unit"
    if not unit:
        size = largest(column.values)
        low, high = USUAL_MAGNITUDES[channel]
        sizes = {unit: size * si_factor(unit, channel) for unit in UNITS[channel]}
        usual = [unit for unit, si_size in sizes.items() if low <= si_size <= high]
        allowed = [unit for unit, si_size in sizes.items() if si_size <= CHANNELS[channel].high]
        unit = (*usual, *allowed, *sizes)[0]
        evidence = f"name, and magnitude {size:.3g} (99th percentile)"
    return Proposal(
        column.name,
        channel,
        unit,
        1,
        (evidence,),
        f"{'sign' if column.unit else 'unit and sign'}: {UNCONFIRMED}",
        alternatives=UNITS[channel],
        is_weak=not column.unit and channel in CONFIRMING_CHANNELS,
        is_by_name=True,
    )


# --- pose and further notes ------------------------------------------------------------------


def _with_pose(
    proposals: Proposals, columns: Sequence[Candidate], motion: Motion | None
) -> Proposals:
    """The proposals with a pose that supplies a missing reference, or notes of what could supply
    one.
    """
    if set(REFERENCES) & set(proposals.by_channel):
        return proposals
    proposals = replace(proposals, pose=find_pose(columns, motion))
    notes = []
    named = [f"'{column.name}'" for column in named_pose(columns)]
    if len(named) == 3 and not proposals.pose:
        notes.append(
            f"no reference is derived from {', '.join(named)}: "
            "their derivatives do not match speed and yaw rate"
        )
    if motion is not None and not proposals.pose:
        notes += _possible_sideslip_angles(columns, motion)
    return proposals.with_notes(*notes)


def _possible_sideslip_angles(columns: Sequence[Candidate], motion: Motion) -> Iterator[str]:
    """Notes of two angles, such as course and heading, whose difference may be the sideslip."""
    angles = [column for column in columns if "heading" in column.hints]
    for first, second in combinations(angles, 2):
        difference = first.values - second.values
        if np.ptp(first.values) > 2.1 * math.pi:
            difference = np.radians(difference)
        wrapped = np.angle(np.exp(1j * difference))[motion.moving]
        low, high = np.quantile(wrapped, [0.02, 0.98]) if len(wrapped) else (0.0, 0.0)
        if SIDESLIP_RANGE[0] < high - low < SIDESLIP_RANGE[1]:
            yield (
                f"the difference '{first.name}' - '{second.name}' may be the missing reference "
                "of the sideslip angle; if so, save it as a column"
            )


# --- doubts ----------------------------------------------------------------------------------


def _along_world_axes(columns: Sequence[Candidate]) -> set[str]:
    """Columns that are first or second derivatives of a coordinate of a position.

    A column that agrees better with the speed or the acceleration along the path, or with that
    across it, is the car's own. None is found where the path is straight.
    """
    steps = [np.gradient(coordinate) for coordinate in _places(columns)]
    if not steps:
        return set()
    along, across = (float(np.std(each)) for each in steps)
    if across <= MIN_WORLD_CROSSING * along:
        return set()
    changes = [np.gradient(each) for each in steps]
    path = np.hypot(*steps)
    normal = (steps[0] * changes[1] - steps[1] * changes[0]) / np.maximum(path, 1e-9)
    of_world = (*steps, *changes)
    of_car = (path, np.gradient(path), normal)

    def agreement(column: Candidate, signals: Iterable[FloatArray]) -> float:
        return max(abs(correlation(column.slow, samples)) for samples in signals)

    return {
        column.name
        for column in columns
        if agreement(column, of_world) > max(MIN_WORLD_CORRELATION, agreement(column, of_car))
    }


def _places(columns: Sequence[Candidate]) -> list[FloatArray]:
    """Coordinates of a position, or longitude and latitude in one scale; empty without either."""
    x, y, longitude, latitude = (
        _first_named(columns, role)
        for role in ("position_x", "position_y", "longitude", "latitude")
    )
    if x is not None and y is not None:
        return [x.slow, y.slow]
    if longitude is not None and latitude is not None:
        return [longitude.slow * _cosine(latitude), latitude.slow]
    return []


def _ask_about_world_axes(proposals: Proposals, in_world: Collection[str]) -> Proposals:
    """The proposals with questions where the speed is one along an axis of the world: on it, the
    lateral velocity, and accelerations along such an axis.
    """
    speed = proposals.by_channel.get("vx")
    if speed is None or speed.column not in in_world:
        return proposals
    question = (
        "it is the derivative of a position: is it along an axis of the world, not of the car?"
    )
    return proposals.changed(
        {
            proposal.channel: replace(proposal, question=question, is_weak=True)
            for proposal in proposals.channels
            if proposal.channel in ("vx", "vy_ref")
            or (proposal.channel in ("ax", "ay") and proposal.column in in_world)
        }
    )


def _ask_about_speed(
    proposals: Proposals, search: Search, wheels: Wheels, columns: Sequence[Candidate]
) -> Proposals:
    """The proposals with a question on the speed where ay/yaw_rate and the wheels agree on another;
    with a note by ay alone.

    ay is compared with d(vy)/dt + vx·yaw_rate where a reference gives vy. Without one, d(vy)/dt
    makes up some per cent, so that only more than these count.
    """
    speed = proposals.by_channel.get("vx")
    turning = search.turning
    if "ay" not in turning.columns or speed is None:
        return proposals
    expected_ay, (low, high) = _expected_ay(proposals, search.motion, columns)
    ay = slow_of(search.motion["ay"], search.motion.rate_hz)
    gain = float(np.std(ay) / np.std(expected_ay))
    is_misread = MISREAD_SPEED_GAIN_RANGE[0] < gain < MISREAD_SPEED_GAIN_RANGE[1]
    if not is_misread or low <= gain <= high:
        return proposals
    speed_si = turning.columns["vx"].slow * si_factor(speed.unit, "vx")
    wheel_gain = wheels_over_speed(wheels, proposals, speed_si)
    if wheel_gain is not None and abs(wheel_gain - turning.scale) <= MAX_WHEEL_GAIN_DIFFERENCE:
        corrected = f"vx {speed.unit} {speed.sign:+d} {speed.factor * wheel_gain:.3f}"
        question = (
            f"it is {_excess(wheel_gain)} compared with the wheel speeds and with ay/yaw_rate, "
            f"as usual for a speedometer; the answer '{corrected}' corrects it"
        )
        questioned = speed.questioned(question)
        alternatives = (*speed.alternatives, corrected)
        return proposals.changed({"vx": replace(questioned, alternatives=alternatives)})
    agreement = abs(correlation(ay, expected_ay))
    bounds = (gain / agreement, gain * agreement)  # by regression either way
    if any(low <= bound <= high for bound in bounds):
        return proposals
    cause = "low" if gain < 1.0 else "high, for example by body roll"
    return proposals.with_notes(
        f"'{speed.column}' is {_excess(*bounds)} compared with ay/yaw_rate, or ay is too {cause}; "
        "if the speed is wrong, set its factor in the data set"
    )


def _expected_ay(
    proposals: Proposals, motion: Motion, columns: Sequence[Candidate]
) -> tuple[FloatArray, tuple[float, float]]:
    """ay by the motion, (S,) [m/s²], and the range of ay over it with a right speed."""
    for name in REFERENCES:
        reference = proposals.by_channel.get(name)
        if reference is None or reference.is_weak:
            continue
        column = next(column for column in columns if column.name == reference.column)
        samples = np.where(motion.moving, reference.si(column.values), 0.0)
        channels = {**motion.channels, name: samples}
        motion = replace(motion, channels=channels, velocity=name)
        return slow_of(motion.turning + motion.sliding, motion.rate_hz), SPEED_GAIN_RANGE
    return slow_of(motion.turning, motion.rate_hz), SPEED_GAIN_RANGE_WITHOUT_VY


def _excess(*gains: float) -> str:
    """Text such as ``2 to 6 % too high``, on a speed by which ay is these times as large."""
    percents = [f"{abs(100.0 * (1.0 / gain - 1.0)):.0f}" for gain in gains]
    return f"{' to '.join(dict.fromkeys(percents))} % too {'high' if gains[0] < 1.0 else 'low'}"


# --- left and right --------------------------------------------------------------------------


def _with_left_right(
    proposals: Proposals,
    columns: Sequence[Candidate],
    motion: Motion | None,
    clues: Iterable[tuple[str, float]],
) -> Proposals:
    """The proposals with signs by the first clue that decides, else by a pose, else by a heading
    that may be a compass's, else by gravity along a z axis that points down, else as most columns
    count.
    """
    for text, agreement in clues:
        if abs(agreement) > MIN_SIDE_CORRELATION:
            sign = "+1" if agreement > 0.0 else "-1"
            evidence = f"{text.format(sign)} (correlation {abs(agreement):.2f})"
            proposals = proposals if agreement > 0.0 else proposals.mirrored()
            return replace(proposals, left_right=evidence)
    if proposals.pose and motion is not None:
        _, name, unit = proposals.pose[-1]
        yaw = next(column for column in columns if column.name == name)
        is_mirrored = turning_of(yaw, unit, motion) < 0.0
    elif compass := _compass(columns, motion):
        name, agreement = compass
        is_mirrored = agreement > 0.0
        proposals = proposals.with_notes(
            f"left and right are proposed as by '{name}', if it is clockwise as that of a compass"
        )
    elif name := _downward(columns, proposals):
        is_mirrored = True
        proposals = proposals.with_notes(
            f"left and right are proposed as of sensors whose z axis points down: gravity in "
            f"'{name}' is negative"
        )
    else:
        signs = [proposal.sign for proposal in proposals.channels if proposal.channel in LATERAL]
        is_mirrored = sum(signs) < 0
    return proposals.mirrored() if is_mirrored else proposals


def _downward(columns: Sequence[Candidate], proposals: Proposals) -> str:
    """Name of an acceleration along an axis that points down; empty where none does.

    At rest an accelerometer shows +g along an axis that points up. Telephones that show -g reverse
    all three axes, and their ay counts against the yaw rate.
    """
    signs = {proposal.channel: proposal.sign for proposal in proposals.channels}
    if (signs.get("yaw_rate"), signs.get("ay"), signs.get("ax", 1)) != (1, 1, 1):
        return ""
    for column in columns:
        if "az" in column.hints and column.measures("ay"):
            mean = float(column.slow.mean())
            sizes = [GRAVITY / si_factor(unit, "ay") for unit in column.units("ay")]
            if any(abs(mean / size + 1.0) < 0.1 for size in sizes):
                return column.name
    return ""


def _compass(columns: Sequence[Candidate], motion: Motion | None) -> tuple[str, float] | None:
    """Name of the first heading from 0 to 360 degrees that turns as the yaw rate does, and their
    correlation; None where none does.
    """
    if motion is None:
        return None
    for column in columns:
        is_yaw = re.search("yaw|psi", column.name.lower())  # which may count the other way round
        is_angle = column.hints.get("heading") == STRONG and column.unit in ("", "deg")
        low, high = float(column.values.min()), float(column.values.max())
        if is_angle and not is_yaw and 0.0 <= low < 180.0 < high <= 360.0:
            agreement = turning_of(column, "deg", motion)
            if abs(agreement) > MIN_SIDE_CORRELATION:
                return column.name, agreement
    return None


def _with_signs_of_majority(proposals: Proposals) -> Proposals:
    """The proposals with signs that nothing but a name suggests set to that of most lateral
    channels.
    """
    lateral = [proposal for proposal in proposals.channels if proposal.channel in LATERAL]
    by_name = [
        proposal
        for proposal in lateral
        if proposal.is_by_name and proposal.channel not in ("yaw_rate", "ay")
    ]
    signs = [proposal.sign for proposal in lateral if proposal not in by_name]
    if not signs:
        return proposals
    sign = 1 if sum(signs) >= 0 else -1
    return proposals.changed(
        {proposal.channel: replace(proposal, sign=sign) for proposal in by_name}
    )


def _left_right_clues(
    columns: Sequence[Candidate], wheels: Wheels, motion: Motion, is_vbo: bool
) -> Iterator[tuple[str, float]]:
    """Texts with a place for the sign of the yaw rate by which a turn to the left is positive.

    Each with the correlation of its evidence: negative where that sign is -1.
    """
    yield (
        "the right wheels are faster than the left ones when yaw_rate with sign {} is positive",
        turning_left(wheels, motion),
    )
    for column in columns:
        if is_vbo and column.name == "heading":
            yield (
                "'heading', clockwise by its format, decreases when yaw_rate with sign {} is "
                "positive",
                -turning_of(column, "deg", motion),
            )
    latitude = _first_named(columns, "latitude")
    longitude = _first_named(columns, "longitude")
    if latitude is None or longitude is None:
        return
    east = longitude.slow * (-1.0 if is_vbo else 1.0) * _cosine(latitude)
    yaw_rate = slow_of(motion["yaw_rate"], motion.rate_hz)
    speed = slow_of(np.abs(motion.vx), motion.rate_hz)
    steps = np.gradient(east), np.gradient(latitude.slow)
    course = np.unwrap(np.arctan2(*steps))  # clockwise from north
    turned = np.angle(np.exp(-1j * np.gradient(course)))
    is_moving = speed > MIN_COURSE_SPEED_SHARE * float(speed.max())
    is_sound = is_moving & (np.abs(turned) < MAX_COURSE_STEP) & (np.hypot(*steps) > 0.0)
    if is_sound.sum() > MIN_COURSE_SAMPLES:
        yield (
            "the course over latitude and longitude turns left when yaw_rate with sign {} is "
            "positive",
            correlation(turned[is_sound], yaw_rate[is_sound]),
        )


def _cosine(latitude: Candidate) -> float:
    """Cosine of a log's mean latitude: a degree of longitude over one of latitude."""
    return math.cos(math.radians(min(abs(float(latitude.slow.mean())), 89.0)))


def _first_named(columns: Sequence[Candidate], role: str) -> Candidate | None:
    """The first column whose name suggests a role; None where none does."""
    return next((column for column in columns if role in column.hints), None)
