"""The factorial experiment on the twin: every filter in every cell of slip, stiffness, payload, friction and crossfall, 20 seeds a cell."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.estimators.filtering.tyre_fit import axle_motion, fit_motion
from vehest.evaluation.significance import (
    CONFIDENCE,
    Interval,
    difference_of_blocks,
    holm,
    root_interval,
)
from vehest.vehicle.parameters import SingleTrackParameters
from vehest_papers.heavy_ekf import paper
from vehest_papers.heavy_ekf.candidates import (
    FILTERS,
    ORACLE,
    SKIP,
    WITH_STATE,
    Levels,
    Tuned,
    baselines,
    mistaken,
    sideslip_of,
    states_of,
    tuned,
    tuning_drives,
)
from vehest_papers.heavy_ekf.twin import CURVES, TRUCK, Conditions, Drive, drive

SLIPS = (2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0)  # deg
MISMATCHES = (-0.4, -0.3, -0.2, -0.1, 0.0, 0.1, 0.2)
SEEDS = 20
PLANTS = tuple(
    (payload, wet, crossfall)
    for payload in (False, True)
    for wet in (False, True)
    for crossfall in (False, True)
)
"""Payload, wet patches, crossfall: each without and with."""
PLAIN = PLANTS[0]
ONCE = "all roads and loads"
PLAIN_ONLY = "dry, flat, without payload"  # what the levels of noise were tuned on
PAIRS = ((paper.RATTE, paper.RATT), (paper.RATTE, paper.LINT), (paper.RATT, paper.LINT))
LOST_DEGREES = 20.0  # an error of β by which a filter counts as lost
ABSORBED_SLIP = 5.0


@dataclass(frozen=True, eq=False)
class Cell:
    """Errors of all candidates in a cell, seed by seed."""

    tuned_on: str  # what the levels were tuned on
    conditions: Conditions  # of the plant; its slip is what the driver was asked for
    mismatch: float  # of the filters' stiffnesses
    squared: Mapping[
        str, FloatArray
    ]  # candidate -> mean squared error of β of each seed [rad²], (S,)
    lost: Mapping[
        str, float
    ]  # candidate -> share of seeds with an error above `LOST_DEGREES` at some time
    reached: tuple[
        float, float, float
    ]  # largest rear slip [deg] and largest |a_y| [m/s²], means over seeds, and the largest |a_y| of all

    def rmse(self, name: str) -> float:
        """RMSE(β) over all seeds [deg]."""
        return math.degrees(math.sqrt(float(self.squared[name].mean())))


@dataclass(frozen=True)
class Change:
    """By how much the first filter's RMSE(β) lies above the second's in a cell."""

    percent: float  # 100 (first/second - 1)
    low: float  # its lower end, corrected by Holm over the table, from the interval of the difference
    high: float  # its upper end
    told_apart: bool  # whether the corrected interval leaves 0 out


@dataclass(frozen=True, eq=False)
class Factorial:
    """All that the twin is asked."""

    tuned: Mapping[
        str, Mapping[str, Tuned]
    ]  # what the levels were tuned on -> filter -> what was tuned
    cells: Sequence[
        Cell
    ]  # all cells, those of `ONCE` over all plants, those of `PLAIN_ONLY` on the plain one

    def grid(
        self, plant: tuple[bool, bool, bool] = PLAIN, tuned_on: str = ONCE
    ) -> list[list[Cell]]:
        """Cells of one plant, a row a mismatch, a column a slip."""
        found = {
            (cell.mismatch, cell.conditions.slip): cell
            for cell in self.cells
            if cell.tuned_on == tuned_on and plant_of(cell.conditions) == plant
        }
        return [[found[mismatch, slip] for slip in SLIPS] for mismatch in MISMATCHES]


@cache
def factorial() -> Factorial:
    """Tune, drive and filter everything; minutes, once a process."""
    drives = {words: tuning_drives(plain=words == PLAIN_ONLY) for words in (ONCE, PLAIN_ONLY)}
    found = {
        words: {name: tuned(name, own) for name in (*FILTERS, ORACLE)}
        for words, own in drives.items()
    }
    cells = [
        cell
        for plant in PLANTS
        for slip in SLIPS
        for cell in _cells(found, Conditions(slip, *plant))
    ]
    return Factorial(found, cells)


def plant_of(conditions: Conditions) -> tuple[bool, bool, bool]:
    """Payload, wet patches, crossfall."""
    return conditions.payload, conditions.wet_patches, conditions.crossfall


def _cells(found: Mapping[str, Mapping[str, Tuned]], conditions: Conditions) -> list[Cell]:
    """Cells of one plant and slip, all mismatches, for each tuning that is asked for there."""
    drives = [drive(conditions, seed) for seed in range(SEEDS)]
    fixed = {name: [of(own) for own in drives] for name, of in _baselines().items()}
    lateral = [float(np.abs(own.lateral).max()) for own in drives]
    slip = float(np.degrees(np.mean([np.abs(own.rear_slip).max() for own in drives])))
    cells = []
    for tuned_on in (ONCE, PLAIN_ONLY) if plant_of(conditions) == PLAIN else (ONCE,):
        levels = {name: own.levels for name, own in found[tuned_on].items()}
        same = fixed | {
            ORACLE: [sideslip_of(ORACLE, levels[ORACLE], own, CURVES) for own in drives]
        }
        for mismatch in MISMATCHES:
            curves = mistaken(mismatch)
            estimates = same | {
                name: [sideslip_of(name, levels[name], own, curves) for own in drives]
                for name in FILTERS
            }
            errors = {
                name: np.stack(
                    [(own - each.sideslip)[SKIP:] for own, each in zip(of, drives, strict=True)]
                )
                for name, of in estimates.items()
            }
            squared = {name: np.mean(np.square(own), axis=1) for name, own in errors.items()}
            lost = {
                name: float(np.mean(np.degrees(np.abs(own)).max(axis=1) > LOST_DEGREES))
                for name, own in errors.items()
            }
            cells.append(
                Cell(
                    tuned_on,
                    conditions,
                    mismatch,
                    squared,
                    lost,
                    (slip, float(np.mean(lateral)), max(lateral)),
                )
            )
    return cells


@cache
def _baselines():  # type: ignore[no-untyped-def]
    return baselines([own for _, own in tuning_drives()])


def changes(
    cells: Sequence[Cell], pairs: Sequence[tuple[str, str]]
) -> dict[tuple[int, tuple[str, str]], Change]:
    """(position of the cell, pair) -> change of RMSE(β), paired over seeds; all corrected together by Holm, as one table."""
    asked = [(at, pair) for at in range(len(cells)) for pair in pairs]
    size = np.ones(SEEDS)
    differences = [
        difference_of_blocks(
            cells[at].squared[first][None], cells[at].squared[second][None], size, n_resamples=2000
        ).root
        for at, (first, second) in asked
    ]
    found = {}
    for key, (own, told_apart) in zip(asked, _corrected(differences), strict=True):
        other = math.sqrt(float(cells[key[0]].squared[key[1][1]].mean()))
        found[key] = Change(
            100.0 * own.value / other,
            max(100.0 * own.low / other, -100.0),
            100.0 * own.high / other,
            told_apart,
        )
    return found


def _corrected(differences: Sequence[Interval]) -> list[tuple[Interval, bool]]:
    """Differences of one table with intervals at the level that Holm asks of each, and whether that excludes zero."""
    found = []
    for own, p_value in zip(differences, holm([own.p_value for own in differences]), strict=True):
        factor = max(p_value / own.p_value, 1.0) if own.p_value > 0 else float(len(differences))
        low, high = own.at(1.0 - (1.0 - CONFIDENCE) / factor)
        found.append((replace(own, low=low, high=high), p_value < 1.0 - CONFIDENCE))
    return found


def interval(cell: Cell, name: str) -> tuple[float, float]:
    """95 % interval of a candidate's RMSE(β) over seeds [deg]."""
    own = root_interval(cell.squared[name][None], np.ones(SEEDS))
    return math.degrees(own.low), math.degrees(own.high)


def every_cell(own: Factorial) -> pd.DataFrame:
    """A row a cell: what it is, RMSE(β) of every candidate [deg], share of seeds on which filters were lost."""
    rows = []
    for cell in own.cells:
        row: dict[str, object] = {
            "tuned_on": cell.tuned_on,
            "payload": cell.conditions.payload,
            "wet_patches": cell.conditions.wet_patches,
            "crossfall": cell.conditions.crossfall,
            "slip_asked_deg": cell.conditions.slip,
            "slip_reached_deg": cell.reached[0],
            "largest_ay": cell.reached[2],
            "mismatch_percent": 100.0 * cell.mismatch,
        }
        row |= {f"rmse_{column(name)}": cell.rmse(name) for name in cell.squared}
        rows.append(row | {f"lost_{column(name)}": cell.lost[name] for name in FILTERS})
    return pd.DataFrame(rows)


def column(name: str) -> str:
    """A candidate's name as part of a column's."""
    return name.lower().replace(WITH_STATE, "_crossfall_state").replace(" ", "_")


@dataclass(frozen=True)
class Mistake:
    """What is wrong in a filter, or in its reference, while its tyres are those of the plant."""

    name: str  # in words
    forward: float = 0.0  # by how much the filter's centre of gravity lies too far forward [m]
    steering: float = 1.0  # factor on the steering angle that it is given
    lever_arm: float = 0.0  # by how far ahead of the centre of gravity the reference measures, which the tyres are fitted by [m]
    ay: float = 0.0  # offset of the accelerometer [m/s²]
    yaw_rate: float = 0.0  # offset of the gyroscope [rad/s]
    crossfall: bool = False  # whether the road has one

    def car(self) -> SingleTrackParameters:
        """The car that the filter takes it for."""
        front = float(TRUCK.cg_to_front_axle)
        rear = float(TRUCK.cg_to_rear_axle)
        return replace(
            TRUCK, cg_to_front_axle=front - self.forward, cg_to_rear_axle=rear + self.forward
        )

    def measured(self, own: Drive) -> Drive:
        """The drive as the sensors tell of it, its reference included."""
        samples = own.samples + np.array([self.yaw_rate, 0.0, self.ay, 0.0])
        samples[:, 3] *= self.steering
        return replace(
            own,
            samples=samples,
            sideslip=own.sideslip + self.lever_arm * own.yaw_rate / own.samples[:, 1],
        )


MISTAKES = (
    Mistake("nothing"),
    Mistake("centre of gravity 0.2 m too far forward", forward=0.2),
    Mistake("centre of gravity 0.2 m too far back", forward=-0.2),
    Mistake("steering ratio: angles 5 % too large", steering=1.05),
    Mistake("steering ratio: angles 5 % too small", steering=0.95),
    Mistake("reference 0.3 m ahead of the centre of gravity", lever_arm=0.3),
    Mistake("reference 0.3 m behind it", lever_arm=-0.3),
    Mistake("offset of the accelerometer, 0.1 m/s²", ay=0.1),
    Mistake("offset of the gyroscope, 0.2°/s", yaw_rate=math.radians(0.2)),
    Mistake("crossfall of 1°", crossfall=True),
)
_FITTED_SEEDS = range(2000, 2004)


def absorbed(levels: Mapping[str, Levels]) -> pd.DataFrame:
    """What each mistake does to the three filters: RMSE(β) against the truth, RATTE's change against RATT, and where its tyres end.

    Tyres are those that a fit to four further drives gives under the mistake, so that RATT is as good as its maker can have it.
    """
    rows = []
    cells = []
    ends = []
    for mistake in MISTAKES:
        conditions = Conditions(ABSORBED_SLIP, crossfall=mistake.crossfall)
        drives = [mistake.measured(drive(conditions, seed)).recording for seed in _FITTED_SEEDS]
        fit = fit_motion(axle_motion(drives, mistake.car(), minimum_speed=2.0))
        curves = np.concatenate([fit.front, fit.rear])
        squared: dict[str, list[float]] = {
            name: [] for name in (paper.LINT, paper.RATT, paper.RATTE)
        }
        last = []
        for seed in range(SEEDS):
            truth = drive(conditions, seed)
            given = mistake.measured(truth)
            for name in squared:
                states = states_of(name, levels[name], given, curves, mistake.car())
                squared[name].append(
                    float(np.mean(np.square(states[:, 0] - truth.sideslip)[SKIP:]))
                )
                if name == paper.RATTE:
                    last.append(np.log(curves) + states[-400:, 4:].mean(axis=0) - np.log(CURVES))
        cells.append(
            Cell(
                ONCE,
                conditions,
                0.0,
                {name: np.array(own) for name, own in squared.items()},
                {},
                (0.0, 0.0, 0.0),
            )
        )
        ends.append((100.0 * (curves / CURVES - 1.0), 100.0 * np.expm1(np.mean(last, axis=0))))
    found = changes(cells, [(paper.RATTE, paper.RATT)])
    for at, (mistake, cell, (start, end)) in enumerate(zip(MISTAKES, cells, ends, strict=True)):
        change = found[at, (paper.RATTE, paper.RATT)]
        row: dict[str, object] = {"mistake": mistake.name} | {
            name: cell.rmse(name) for name in cell.squared
        }
        row |= {"change": change.percent, "low": change.low, "high": change.high}
        row |= {
            "fit_front": start[1],
            "fit_rear": start[3],
            "end_front": end[1],
            "end_rear": end[3],
        }
        rows.append(row)
    return pd.DataFrame(rows)
