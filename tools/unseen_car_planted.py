"""Write results/unseen_car/drawn_cars.md: the self-calibrating filter on 200 drawn cars in town and 100 at the limit, all simulated.

Run by ``make unseen_car_planted``. The filter is given the wheelbase; sideslip is scored at the inertial unit.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import beta
from unseen_car import MARGIN, PLAIN, RATE, TARGET, TURN_YAW_RATE, WARM_UP, table
from unseen_car_record import PRODUCTION, Profile, a_car, angle_of, driven, root

from vehest.constants import GRAVITY, FloatArray
from vehest.data.recording import Recording
from vehest.data.resampling import resampled
from vehest.estimators.base import Estimator
from vehest.estimators.self_calibrating import SelfCalibrating
from vehest.inference.car_values import with_settings
from vehest.inference.estimation import estimate_recording
from vehest.inference.models import SELF_CALIBRATING, open_model
from vehest.report.style import fixed
from vehest.run.table_records import record_tables
from vehest.simulation.plant.planar_car import PlanarCar
from vehest.simulation.sensors.levels import SensorLevels
from vehest.trust.record import Trust

VERSION = "2"
"""Raised when the numbers of its tables move."""
CITY_DRIVES = 200
LIMIT_DRIVES = 100
CITY_CROSSFALL = 1.5  # deg, standard deviation: a crossfall of 2.5 % either way is 1.4°
LIMIT_CROSSFALLS = (1.5, 3.0)  # deg, standard deviation; 3°: banked bends, a track on a slope
MIN_SPEED = 3.0  # m/s, below which nothing is scored
MIN_TURNING = 10  # samples of a drive whose coverage while turning counts
MAX_SIDESLIP = math.radians(
    25.0
)  # of a drive at the limit; drawn anew beyond it, where the car spins
ROUNDS = 4000  # of the bootstrap over drives
PAGE = """# Drawn cars in town and at the limit

{city} cars in town and {limit} at the limit, all **simulated** on the planar plant ([CSV](drawn_cars.csv)), with sensors of production quality.
Wheelbase, tyres, masses, the place of the inertial unit and the drive are drawn. The filter is given the wheelbase alone, or the
place of the unit too; sideslip is scored at the unit, above {speed:g} m/s. Bands are those of `vehest estimate`. The same cars and
wanted motions are driven on level roads and on roads whose crossfall is drawn.

- In town |ay| is below 3 m/s², with turns, stops, bends, lane changes and roundabouts, and the unit is between 0.5 m behind the rear
  axle and the front axle.
- At the limit bends demand up to the whole grip of the tyres, and the unit is between the rear axle and three quarters of the wheelbase.
- Crossfall changes linearly between values that are drawn every 4 to 12 s, normally distributed with the standard deviation of the
  table. Gravity pulls the car and its accelerometer sideways with it, as on a real road. Crossfall was added after the results on
  level roads were known, as an explanation of their coverage; no setting of the filter was changed for it.
- The prior map, v = r(b - C u²) with the prior of C, is given the place b of the unit.

{summary}

Square brackets are 95 % intervals: Clopper-Pearson for the share of drives, a bootstrap over drives for means. Turning: |yaw rate| above
{turning} rad/s.
"""


class Drawn(NamedTuple):
    """A drawn car with its drive."""

    car: PlanarCar
    imu_to_rear_axle: float  # m
    drive: Recording


def draw_car(rng: np.random.Generator) -> PlanarCar:
    """A car of full size: wheelbase, centre of gravity, tyres, mass, roll and inertia are drawn."""
    axles = (
        rng.uniform(2.3, 3.1),
        rng.uniform(0.42, 0.60),
        0.0045 * math.exp(rng.uniform(-0.5, 0.5)),
        rng.uniform(0.6, 0.95),
    )
    ranges = {
        "mass": (900, 2300),
        "friction": (0.8, 1.1),
        "load_sensitivity": (0, 0.15),
        "roll_gradient": (0.005, 0.011),
        "yaw_inertia": (0.85, 1.15),
    }
    return a_car(*axles, **{name: rng.uniform(*limits) for name, limits in ranges.items()})


class CityPlan:
    """Knots of speed [m/s] and lateral acceleration [m/s²] over time [s], manoeuvre after manoeuvre."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.time = 0.0
        self.speed = 10.0
        self.speeds = [(0.0, 10.0)]
        self.lateral = [(0.0, 0.0)]

    def change_speed(self, speed: float, acceleration: float) -> None:
        """Reach a speed at a constant acceleration."""
        self.time += max(abs(speed - self.speed) / acceleration, 0.3)
        self.speed = speed
        self.speeds.append((self.time, speed))

    def advance(self, seconds: float) -> None:
        """Keep the speed for a while."""
        self.time += seconds
        self.speeds.append((self.time, self.speed))

    def bend(self, *knots: tuple[float, float]) -> None:
        """Lateral accelerations at times after now, up to the last of which the speed is kept."""
        self.lateral += [(self.time + after, value) for after, value in knots]
        self.advance(knots[-1][0])

    def add_manoeuvre(self) -> None:
        """A straight, a turn at a crossing, a stop, a bend, a roundabout or a lane change."""
        rng = self.rng
        kinds = ["straight", "turn", "stop", "bend", "roundabout", "lane"]
        kind = rng.choice(kinds, p=[0.2, 0.3, 0.1, 0.2, 0.1, 0.1])
        cruise = rng.uniform(7, 15)
        if kind == "straight":
            self.change_speed(cruise, 1.2)
            self.advance(rng.uniform(3, 10))
        elif kind == "turn":
            slow = rng.uniform(4, 7.5)
            self.change_speed(slow, 1.8)
            size = min(rng.uniform(1.0, 2.8), slow**2 / 6.0)
            side = rng.choice([-1, 1])
            seconds = rng.uniform(0.8, 1.6) * slow / size  # a heading of 45° to 90°
            ramp = rng.uniform(0.8, 1.5)
            end = ramp + seconds
            self.bend(
                (0.0, 0.0), (ramp, side * size), (end - 0.5, side * size), (end + ramp / 2.0, 0.0)
            )
            self.change_speed(cruise, 1.5)
        elif kind == "stop":
            self.change_speed(0.0, 1.8)
            self.advance(rng.uniform(2, 6))
            self.change_speed(cruise, 1.5)
        elif kind == "bend":
            self.change_speed(cruise, 1.2)
            size = rng.uniform(0.5, 2.5) * rng.choice([-1, 1])
            ramp = rng.uniform(1, 2.5)
            end = ramp + rng.uniform(2, 6)
            self.bend((0.0, 0.0), (ramp, size), (end, size), (end + ramp, 0.0))
        elif kind == "roundabout":
            slow = rng.uniform(5, 7.5)
            self.change_speed(slow, 1.8)
            size = min(rng.uniform(1.5, 2.8), slow**2 / 7.0)
            end = 3.0 + rng.uniform(2, 7)
            entry = ((0.0, 0.0), (0.8, -0.7 * size), (1.6, -0.7 * size), (3.0, size))
            self.bend(*entry, (end, size), (end + 1.2, -0.6 * size), (end + 2.2, 0.0))
            self.change_speed(cruise, 1.5)
        else:
            self.change_speed(cruise, 1.2)
            size = rng.uniform(0.5, 1.8) * rng.choice([-1, 1])
            width = rng.uniform(1.2, 2.2)
            self.bend((0.0, 0.0), (width / 2.0, size), (1.5 * width, -size), (2.0 * width, 0.0))


def interpolated(knots: NDArray[np.float64]) -> Profile:
    """Linear between (time, value), constant beyond."""
    times = knots[:, 0].copy()
    values = knots[:, 1].copy()
    return lambda time: float(np.interp(time, times, values))


def draw_crossfall(seed: int, deviation: float) -> Profile:
    """Road angle [rad] over time [s], linear between values drawn every 4 to 12 s; ``deviation``: of these [deg]."""
    rng = np.random.default_rng(110_000 + seed)
    times = np.cumsum(rng.uniform(4.0, 12.0, 60)) - 30.0
    return interpolated(np.column_stack([times, np.radians(rng.normal(0.0, deviation, 60))]))


def in_town(seed: int, crossfall: float) -> Drawn:
    """A drawn car in city traffic for 90 to 150 s; ``crossfall``: its standard deviation [deg]."""
    rng = np.random.default_rng(70_000 + seed)
    car = draw_car(rng)
    place = rng.uniform(-0.5, car.wheelbase)
    plan = CityPlan(rng)
    seconds = rng.uniform(90, 150)
    while plan.time < seconds + 20.0:
        plan.add_manoeuvre()
    bends = interpolated(np.array(plan.lateral))
    phase = rng.uniform(0, math.tau)
    rate = rng.uniform(0.3, 0.9)

    def lateral(time: float) -> float:
        return (bends(time) + 0.08 * math.sin(rate * time + phase)) * (time >= 0.0)

    levels = mounted(place - car.cg_to_rear_axle)
    speed = interpolated(np.array(plan.speeds))
    bank = draw_crossfall(seed, crossfall)
    drive = driven(car, levels, speed, lateral, bank=bank, seconds=seconds, seed=seed)
    return Drawn(car, place, drive)


def at_the_limit(seed: int, crossfall: float) -> Drawn:
    """A drawn car at 10 to 33 m/s through bends up to the whole grip, for 40 to 90 s; drawn anew where it spins.

    ``crossfall``: its standard deviation [deg].
    """
    rng = np.random.default_rng(90_000 + seed)
    while True:
        car = draw_car(rng)
        place = rng.uniform(0.0, 0.75 * car.wheelbase)
        speeds = rng.uniform(10.0, 33.0, 14)
        times = np.repeat(np.cumsum(rng.uniform(2.5, 6.0, 50)), 2) + np.tile([0.0, 0.5], 50)
        share = rng.uniform(0.8, 1.0) * rng.uniform(-1.0, 1.0, 51) * (rng.random(51) > 0.25)
        sizes = np.repeat(share * car.friction * GRAVITY, 2)[1:-1]
        bends = interpolated(np.column_stack([times, sizes]))
        size = rng.uniform(0.0, 2.0)
        rate = math.tau * rng.uniform(0.2, 0.8)
        drive = driven(
            car,
            mounted(place - car.cg_to_rear_axle),
            interpolated(np.column_stack([10.0 * np.arange(14), speeds])),
            with_sine(bends, size, rate),
            bank=draw_crossfall(seed, crossfall),
            seconds=rng.uniform(40.0, 90.0),
            seed=seed,
        )
        if np.abs(angle_of(drive)).max() < MAX_SIDESLIP:
            return Drawn(car, place, drive)


def with_sine(bends: Profile, size: float, rate: float) -> Profile:
    """Lateral accelerations of bends and a sine from the time 0 on."""
    return lambda time: (bends(time) + size * math.sin(rate * time)) * (time > 0.0)


def mounted(lever: float) -> SensorLevels:
    """Sensors of production quality with the inertial unit ``lever`` metres ahead of the centre of gravity."""
    return replace(PRODUCTION, imu=replace(PRODUCTION.imu, lever_x=lever))


def judged(drawn: Drawn, shipped: Estimator, trust: Trust) -> dict[str, float]:
    """Errors [deg], bands and health of a drive, with the unit's place not given and given."""
    car, place, fine = drawn
    drive = resampled(fine, RATE, PLAIN)
    speed = drive["vx"]
    yaw_rate = drive["yaw_rate"]
    truth = drive["vy_ref"] + (place - car.cg_to_rear_axle) * yaw_rate
    scored = (speed > MIN_SPEED) & (np.arange(len(speed)) >= WARM_UP)
    turning = (np.abs(yaw_rate) > TURN_YAW_RATE)[scored]
    angle = np.degrees(np.arctan2(truth, speed))[scored]

    def errors(vy: FloatArray) -> FloatArray:
        return np.asarray(np.degrees(np.arctan2(vy, speed))[scored] - angle)

    row = {
        "wheelbase": car.wheelbase,
        "imu_to_rear_axle": place,
        "seconds": drive.duration,
        "largest_ay": float(np.quantile(np.abs(drive["ay"]), 0.99)),
        "zero": root(angle),
    }
    for title, given in (("", {}), ("_place_given", {"imu_to_rear_axle": place})):
        model: SelfCalibrating = with_settings(shipped, {"wheelbase": car.wheelbase} | given)
        estimate = estimate_recording(
            model, drive.select(model.channels), trust.for_settings(model)
        )
        error = errors(estimate["vy"])
        half_width = np.degrees(estimate["band_sideslip"])[scored]
        beyond = np.abs(error) - half_width
        valid = (estimate["health"] == 0)[scored]
        compliance = model.numbers().compliance
        row["prior_map"] = root(errors(yaw_rate * (place - compliance * speed**2)))
        figures = {
            "rmse": root(error),
            "coverage": float(np.mean(beyond <= 0.0)),
            "coverage_turning": float(np.mean(beyond[turning] <= 0.0))
            if turning.sum() >= MIN_TURNING
            else math.nan,
            "width": float(np.mean(2.0 * half_width)),
            "interval_score": float(np.mean(2.0 * half_width + 20.0 * np.maximum(beyond, 0.0))),
            "valid": float(np.mean(valid)),
            "valid_beyond_twice": float(np.mean((beyond > half_width)[valid]))
            if valid.any()
            else math.nan,
        }
        row |= {f"{name}{title}": figure for name, figure in figures.items()}
    return row


def share_interval(count: int, drives: int) -> tuple[float, float]:
    """95 % interval of a share (Clopper & Pearson 1934)."""
    low = float(beta.ppf(0.025, count, drives - count + 1)) if count else 0.0
    high = float(beta.ppf(0.975, count + 1, drives - count)) if count < drives else 1.0
    return low, high


def mean_interval(values: FloatArray) -> tuple[float, float]:
    """95 % interval of a mean, by a bootstrap."""
    drawn = np.random.default_rng(0).integers(0, len(values), (ROUNDS, len(values)))
    low, high = np.quantile(values[drawn].mean(axis=1), [0.025, 0.975])
    return float(low), float(high)


def summary(rows: pd.DataFrame) -> list[str]:
    """A row for each kind of drive, with the unit's place not given and given."""
    lines = []
    for ((kind, crossfall), frame), title in (
        (group, title)
        for group in rows.groupby(["kind", "crossfall"], sort=False)
        for title in ("", "_place_given")
    ):
        worse = int((frame[f"rmse{title}"] - frame["zero"] > MARGIN).sum())
        low, high = share_interval(worse, len(frame))
        turning = frame[f"coverage_turning{title}"].dropna().to_numpy()
        of_mean = mean_interval(turning)
        lines.append(
            [
                f"{kind}, place {'given' if title else 'not given'}",
                f"{crossfall:g}",
                str(len(frame)),
                *(fixed(frame[name].mean(), 2) for name in ("zero", "prior_map", f"rmse{title}")),
                f"{worse} [{fixed(100.0 * low, 1)} %, {fixed(100.0 * high, 1)} %]",
                fixed(float((frame[f"rmse{title}"] - frame["zero"]).max()), 2),
                f"{fixed(turning.mean(), 3)} [{fixed(of_mean[0], 3)}, {fixed(of_mean[1], 3)}]",
                fixed(turning.min(), 2),
                fixed(frame[f"width{title}"].mean(), 2),
                fixed(frame[f"interval_score{title}"].mean(), 2),
                fixed(frame[f"valid{title}"].mean(), 3),
                fixed(frame[f"valid_beyond_twice{title}"].mean(), 4),
            ]
        )
    heads = (
        "drives",
        "crossfall, standard deviation [deg]",
        "number",
        "v = 0 [deg]",
        "prior map [deg]",
        "self-calibrating [deg]",
        f"worse than v = 0 by {MARGIN}°",
        "largest excess [deg]",
        "coverage while turning",
        "worst drive",
        "width [deg]",
        "interval score [deg]",
        "valid",
        "of these beyond twice the band",
    )
    return table(heads, lines)


def rows_of(
    kind: str,
    draw: Callable[[int, float], Drawn],
    count: int,
    crossfalls: Sequence[float],
    shipped: Estimator,
    trust: Trust,
) -> list[dict[str, Any]]:
    """A row for each drive, the same cars for each standard deviation of the crossfall [deg]."""
    return [
        {"kind": kind, "crossfall": crossfall, "seed": seed}
        | judged(draw(seed, crossfall), shipped, trust)
        for crossfall in crossfalls
        for seed in range(count)
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--drives", type=int, help="that many of each kind, printed and not published"
    )
    trial = parser.parse_args(arguments).drives
    _, shipped, trust = open_model(SELF_CALIBRATING, TARGET, print)
    if trust is None:
        raise SystemExit(f"'{SELF_CALIBRATING}' has no calibrated bands")
    rows = pd.DataFrame(
        rows_of("in town", in_town, trial or CITY_DRIVES, (0.0, CITY_CROSSFALL), shipped, trust)
        + rows_of(
            "at the limit",
            at_the_limit,
            trial or LIMIT_DRIVES,
            (0.0, *LIMIT_CROSSFALLS),
            shipped,
            trust,
        )
    )
    if trial:
        print("\n".join(summary(rows)))
        return
    rows.to_csv(TARGET / "drawn_cars.csv", index=False, float_format="%.4g", lineterminator="\n")
    page = PAGE.format(
        city=CITY_DRIVES,
        limit=LIMIT_DRIVES,
        speed=MIN_SPEED,
        turning=TURN_YAW_RATE,
        summary="\n".join(summary(rows)),
    )
    (TARGET / "drawn_cars.md").write_text(page, encoding="utf-8")
    record_tables(
        [TARGET / "drawn_cars.csv", TARGET / "drawn_cars.md"],
        "make unseen_car_planted",
        ["script tools/unseen_car_planted.py", "evaluate self_calibrating"],
    )


if __name__ == "__main__":
    main()
