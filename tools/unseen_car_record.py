"""Write results/unseen_car/record.md: what `vehest identify` finds, on drives of one car and on cars whose numbers are known.

Run by ``make unseen_car_record``, on development cars and simulated ones alone: what is carried over, and the widening, were chosen there.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from unseen_car import (
    CARS,
    HELD_BACK,
    PLAIN,
    RATE,
    TARGET,
    WARM_UP,
    drives_of,
    filter_of,
    identified_on,
    ingested,
    raw_files_of,
    table,
)

from vehest.alignment.lateral import lateral_lateness
from vehest.alignment.motion import motion_of
from vehest.alignment.standstill import standstill
from vehest.constants import GRAVITY, FloatArray
from vehest.data.recording import Recording
from vehest.data.resampling import resampled
from vehest.estimators.base import Estimator
from vehest.estimators.kernels import self_calibrating as kernel
from vehest.estimators.self_calibrating import SelfCalibrating
from vehest.inference.car_values import (
    DEVIATION_FACTOR,
    LIMITS,
    CarRecord,
    calibrated,
    with_settings,
)
from vehest.inference.estimation import estimate_recording
from vehest.inference.models import SELF_CALIBRATING, open_model
from vehest.report.style import fixed
from vehest.run.console import Messages
from vehest.run.identify import (
    YAW_RATE_LATENESS_SECONDS,
    posterior_of,
    prior_of,
    record_of,
    without_prior,
)
from vehest.run.runner import Runner
from vehest.run.signals import StopSignals
from vehest.run.table_records import record_tables
from vehest.simulation.plant.planar import VX, VY, YAW_RATE, Inputs, PlanarPlant
from vehest.simulation.plant.planar_car import PlanarCar
from vehest.simulation.sensors.levels import Mounting, Reference, SensorLevel, SensorLevels, Tilt
from vehest.simulation.sensors.recording import measure
from vehest.trust.health import reason_in_words

ORDER = ("leakage", "rear_axle", "grip", "compliance")
SETS = {"κ": ORDER[:1], "κ, b": ORDER[:2], "κ, b, a_max": ORDER[:3], "κ, b, a_max, C": ORDER}
SHIFTS = np.arange(-0.12, 0.121, 0.03)  # s, of yaw rate
SETTLED = 2.0
STEP = 0.01  # s before the first sample, and between commands
SHAPE = 1.4
VERSION = "2"
"""Raised when the numbers of its tables move."""
EXPONENT = 0.25
COMPARED = 0.8  # of the tyres' curve, of the filter's; share of the tyres' limit where they have the same slip
PAGE = """# A car's record

What `vehest identify` finds on drives of one car and on cars whose numbers are known, and what `vehest estimate --car` makes of it. What is
carried over, and the widening, were chosen on these development cars: no figure here is evidence for another car.

## Drives of one car

Four drives of a real Ferrari 250 LM without reference ([CSV](agreement.csv)): z-scores between what two drives add, without the
filter's prior. `train_1` is the drive that has a reference elsewhere, and is in no record that is tested on it. {agreeing}

{agreement}

## Carried over

RMSE(β) of a held-out drive that starts from the record of the car's other drives, over that of a cold start ([CSV](carry_over.csv)):
geometric means over a car's drives, and over cars. `vehest estimate --car` starts from κ and b with deviations times {widening}: better
than cold on {better} of {drives} drives, {real} real and {simulated} simulated.
C differs between calm driving and the limit: with it too, the worst drive has {worst} times the RMSE(β) of a cold start.

{ratios}

## Planted numbers

{cars} **simulated** cars on the planar plant, drawn with tyres, masses, sensors and drives of 60 to 120 s at 20 to 100 Hz
([CSV](planted.csv)); wheelbase and centre of gravity are given, every second yaw rate is late. Cells: mean ± deviation of
z-scores, share of cars within 90 %.

{planted}

- `leakage` κ = k/(1 + k): k is gravity times the roll gradient times the share of roll that the sensors see.
- `rear_axle` b is the distance of the inertial unit from the rear axle. Tyres that relax over 0.35 m make it seem short.
- `compliance` C is the slope of the rear slip angle over lateral acceleration at small slip, 1/(g μ B C), tyres at their static load.
- `grip` a_max is that of the filter's curve whose slip at 0.8 of the tyres' limit is theirs: 1.3 times that limit.
- Offsets are means over the drive, with deviations of a moment: far too large for a mean.
- Deviations hold a lateness of the yaw rate of {late} ms, one standard deviation, chosen on other cars, drawn with seeds 1000 to 1099.

## Lateness of yaw rate

Where yaw rate is late behind ay, b and C take it up. The filter cannot find the lateness ([CSV](lateness.csv)): the shift at which its bank
explains dv/dt best errs by {of_planted} ms (mean ± deviation) on the planted cars, whose tyres are of the filter's
kind, and by up to {furthest} ms on development drives, where the axle's equation errs by more than such a shift. The reference tells it
by dv/dt. Once advanced by the filter's shift, {worse} of {late_drives} drives get worse, so none is. Bands hold {now} in the mean of
drives as recorded, {then} where the yaw rate is 40 ms later.

{lateness}

## Scenes, simulated

`vehest estimate` without a record ([CSV](scenes.csv)): one car that differs from the filter's priors, sensors of production cars, errors in
degrees above 3 m/s and in m/s everywhere. {verdict}

{scenes}

The trailer's pull moves the mean of yaw rate by {pull_yaw_rate} rad/s, of ax by {pull_ax} m/s² and of ay, by roll, by {pull_ay} m/s²,
against an offset of ay with a deviation of {offset_ay} m/s²: the inputs hold nothing that could tell it. The bank shows in that offset,
{banked} deviations in the median of the banked curve, at most {development} in the median of a development drive, and in health.
"""
ACCELEROMETER = SensorLevel(noise=0.02, drift=0.02, drift_time=20.0)
Profile = Callable[[float], float]  # by the time [s]


def started(
    model: Estimator, record: CarRecord, names: Sequence[str], widening: float
) -> Estimator:
    """The filter that starts from some numbers of a record, compliance and grip included, no surer than the filter's own priors."""
    own = {
        name: getattr(record, name)
        if name in names
        else replace(getattr(record, name), identified_on=())
        for name in LIMITS
    }
    new = calibrated(model, replace(record, **own), widening)
    changed: dict[str, float] = {}
    for name in ("compliance", "grip"):
        if own[name].identified_on:
            deviation = min(
                widening * own[name].deviation / own[name].value, getattr(new, f"{name}_deviation")
            )
            scale = getattr(new.numbers(), name) / getattr(new, name)  # by the wheelbase
            changed |= {name: own[name].value / scale, f"{name}_deviation": deviation}
    return with_settings(new, changed)


def judged(model: Estimator, drive: Recording, slowest: float) -> tuple[float, float]:
    """RMSE(β) where the car moves [deg], and the share of v within its band of 90 %."""
    speed = drive["vx"]
    truth = drive["vy_ref"]
    estimate = model.estimate([drive.select(model.channels)])[0]
    moving = (speed > slowest) & np.isfinite(truth) & (np.arange(len(speed)) >= WARM_UP)
    angle = np.degrees(np.arctan2(estimate["vy"], speed) - np.arctan2(truth, speed))[moving]
    deviation = np.sqrt(
        np.ravel(np.zeros(len(speed)) if estimate.covariance is None else estimate.covariance)
    )
    return root(angle), float(np.mean((np.abs(estimate["vy"] - truth) < 1.645 * deviation)[moving]))


def advanced(drive: Recording, by: float) -> Recording:
    """With its yaw rate that many seconds earlier."""
    return drive.with_channels(
        {"yaw_rate": np.interp(drive.time + by, drive.time, drive["yaw_rate"])}
    )


def carried_over(runner: Runner, root: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Pairs of the Ferrari's drives, and errors of held-out drives that start from the record of the car's other drives."""
    pairs: list[dict[str, Any]] = []
    rows: list[dict[str, Any]] = []
    for car in (car for car in CARS if car.development):
        drives = list(drives_of(car, runner, root))
        apart = list(ingested(runner, root, *car.unlabelled)) if car.unlabelled else []
        model = filter_of(car, RATE, measured_ax=all("ax" in one for one in drives))
        found = identified_on(car, apart or drives)
        for name, (one, other) in product(LIMITS if apart else (), combinations(found, 2)):
            (a, of_a), (b, of_b) = (
                without_prior(prior_of(model)[name], found[drive][name]) for drive in (one, other)
            )
            pair = {
                "number": f"log {name}" if name == "grip" else name,
                "first": one,
                "second": other,
                "value": a,
                "deviation": of_a,
            }
            pairs.append(
                pair
                | {
                    "value_second": b,
                    "deviation_second": of_b,
                    "z": (a - b) / math.hypot(of_a, of_b),
                }
            )
        for drive in drives:
            others = {name: own for name, own in found.items() if name not in (drive.id, HELD_BACK)}
            if others:
                record = record_of(model, others)
                errors = {"cold": judged(model, drive, car.slowest)[0]}
                for title, by in product(SETS, (1.0, DEVIATION_FACTOR, 3.0)):
                    errors[f"{title}; {by:g}"] = judged(
                        started(model, record, SETS[title], by), drive, car.slowest
                    )[0]
                rows.append({"car": car.title, "drive": drive.id, **errors})
    return pd.DataFrame(pairs), pd.DataFrame(rows)


def lateness_of(model: SelfCalibrating, drive: Recording) -> float:
    """By how much yaw rate would be late behind ay if the bank's v explained dv/dt = (1 - κ) ay - ω u best once it is advanced [s]."""
    left = []
    for shift in SHIFTS:
        samples = np.column_stack([advanced(drive, shift)[name] for name in model.channels])
        last = model.trace(samples, model.first_state(samples[0], {}))[2]
        own = last.candidates[kernel.BANK]
        left.append(
            math.log(own[kernel.SQUARE_Y] - own[kernel.CROSS_Y] ** 2 / last.lags[kernel.POWER])
        )
    at = min(max(int(np.argmin(left)), 1), len(SHIFTS) - 2)
    curve, slope, _ = np.polyfit(SHIFTS[at - 1 : at + 2], left[at - 1 : at + 2], 2)
    return (
        float(np.clip(-slope / (2.0 * curve), SHIFTS[0], SHIFTS[-1]))
        if curve > 0.0
        else float(SHIFTS[np.argmin(left)])
    )


def lateness(runner: Runner, root: str) -> pd.DataFrame:
    """Of yaw rate on development drives: by the reference, by the filter, and errors as recorded and with a yaw rate that is shifted."""
    rows: list[dict[str, Any]] = []
    for car in (car for car in CARS if car.development):
        for drive in drives_of(car, runner, root):
            model = filter_of(car, RATE, measured_ax="ax" in drive)
            found = lateness_of(model, drive)
            known = lateral_lateness(motion_of(drive, ~standstill(drive)))
            row: dict[str, Any] = {
                "drive": f"{car.title}, {drive.id}",
                "by the filter": 1e3 * found,
            }
            row |= (
                {"by the reference": 1e3 * known[0].value, "±": 1e3 * known[0].half_width}
                if known
                else {}
            )
            row["deviations of ay's offset"] = offset_of(model, drive)
            row |= dict(
                zip(("error", "band holds"), judged(model, drive, car.slowest), strict=True)
            )
            row["once advanced by it"] = judged(model, advanced(drive, found), car.slowest)[0]
            row |= dict(
                zip(
                    ("40 ms later", "band holds then"),
                    judged(model, advanced(drive, -0.04), car.slowest),
                    strict=True,
                )
            )
            rows.append(row)
    return pd.DataFrame(rows)


def limit_of(car: PlanarCar) -> float:
    """Lateral acceleration at the friction limit of the rear axle at its static load [m/s²]."""
    return (
        GRAVITY
        * car.friction
        * (1.0 - car.load_sensitivity * (2.0 * car.cg_to_front_axle / car.wheelbase - 1.0))
    )


def planted(car: PlanarCar, levels: SensorLevels) -> dict[str, float]:
    """What the numbers mean on the plant, as the report defines them."""
    roll = GRAVITY * car.roll_gradient * levels.tilt.roll_share
    share = np.linspace(0.01, 0.98, 1000)  # of the limit of the filter's curve
    slip = (1.0 - (1.0 - share) ** EXPONENT) / EXPONENT / share  # over that of a linear axle
    of_tyres = math.tan(math.asin(COMPARED) / SHAPE) * SHAPE / COMPARED
    own = {"leakage": roll / (1.0 + roll), "rear_axle": car.cg_to_rear_axle + levels.imu.lever_x}
    own |= {"compliance": 1.0 / (limit_of(car) * car.stiffness_factor_rear * SHAPE)}
    own |= {"grip": limit_of(car) * COMPARED / float(np.interp(of_tyres, slip, share))}
    return own | {"offset_ay": levels.ay.bias / (1.0 + roll), "offset_ax": levels.ax.bias}


def a_car(
    length: float = 2.7,
    rear: float = 0.5,
    compliance: float = 0.0051,
    front: float = 0.75,
    **changed: float,
) -> PlanarCar:
    """A car of full size; ``rear``: centre of gravity over the wheelbase, ``front``: stiffness of front tyres over that of rear ones."""
    given = {
        "mass": 1500.0,
        "cg_to_front_axle": (1.0 - rear) * length,
        "cg_to_rear_axle": rear * length,
        "track": 1.55,
        "cg_height": 0.5,
    }
    given |= {
        "wheel_radius": 0.31,
        "wheel_inertia": 1.3,
        "motor_inertia": 2.0,
        "torque_constant": 10.0,
        "coulomb_torque": 30.0,
    }
    given |= {
        "viscous_torque": 0.5,
        "axle_lock": 0.0,
        "centre_lock": 0.0,
        "air_drag": 0.4,
        "friction": 1.0,
        "load_sensitivity": 0.1,
    }
    given |= {
        "shape_factor": SHAPE,
        "relaxation_length": 0.35,
        "carcass_damping": 0.1,
        "roll_share_front": 0.55,
        "load_time": 0.15,
    }
    given |= {
        "roll_gradient": 0.007,
        "pitch_gradient": 0.004,
        "largest_steer": 0.6,
        "steering_rate": 1.0,
        "steering_time": 0.05,
    }
    given |= {"current_time": 0.1, "largest_current": 500.0, "yaw_inertia": 1.0}
    car = PlanarCar(
        name="car", stiffness_factor_front=1.0, stiffness_factor_rear=1.0, **(given | changed)
    )
    car = replace(
        car, yaw_inertia=car.yaw_inertia * car.mass * car.cg_to_front_axle * car.cg_to_rear_axle
    )
    stiffness = 1.0 / (limit_of(car) * SHAPE * compliance)
    return replace(car, stiffness_factor_rear=stiffness, stiffness_factor_front=front * stiffness)


def driven(
    car: PlanarCar,
    levels: SensorLevels,
    speed: Profile,
    lateral: Profile = lambda time: 0.0,
    steer: Profile | None = None,
    *,
    bank: Profile = lambda time: 0.0,
    pull: float = 0.0,
    seconds: float = 60.0,
    rate_hz: float = 100.0,
    seed: int = 0,
) -> Recording:
    """A drive at wanted speeds and lateral accelerations, or steering angles, as sensors record it, with true velocities as references.

    ``bank`` is positive with the road's left side higher; ``pull`` is of a trailer 1.2 m behind the rear axle, over the car's mass [m/s²].
    """
    plant = PlanarPlant(car)
    times = np.arange(-SETTLED, seconds, STEP)
    understeer = (1.0 / car.stiffness_factor_front - 1.0 / car.stiffness_factor_rear) / (
        GRAVITY * car.friction * SHAPE
    )
    across = np.array([pull - GRAVITY * math.sin(bank(time)) for time in times])
    state = plant.initial_state(speed(-SETTLED))
    error = 0.0
    kept = []
    acting = []
    for time, push in zip(times, across, strict=True):
        u = max(float(state[VX]), 3.0)
        wanted = lateral(time)
        error += STEP * (wanted / u - float(state[YAW_RATE]))
        angle = (
            steer(time)
            if steer
            else car.wheelbase * wanted / u**2 + understeer * (wanted - push) + 0.3 * error
        )
        force = (
            min(max(speed(time) - float(state[VX]), -3.0), 2.5) * car.mass + car.air_drag * u**2
        ) * (speed(time) > 0.0)
        kept.append(state)
        acting.append(Inputs(angle, force * car.wheel_radius / car.torque_constant))
        state = plant.advance(state, acting[-1], round(STEP / plant.step))
        state[VY] += push * STEP * (state[VX] > 0.5)
        state[YAW_RATE] -= (
            pull
            * (car.cg_to_rear_axle + 1.2)
            * car.mass
            / car.yaw_inertia
            * STEP
            * (state[VX] > 0.5)
        )
    shown = slice(round(SETTLED / STEP), None, round(1.0 / STEP / rate_hz))
    motion = plant.motion(kept[shown], acting[shown], rate_hz)
    motion = replace(
        motion,
        ay=motion.ay + (motion.vx > 0.5) * across[shown],
        bank=np.array([bank(time) for time in times])[shown],
    )
    measured = measure(motion, levels, seed)
    channels = {name: measured[name] for name in ("yaw_rate", "vx", "ay", "ax")} | {
        "vy_ref": motion.vy,
        "vx_ref": motion.vx,
    }
    return Recording(f"drive_{seed:03d}", car.name, rate_hz, 0.0, channels, kind="simulated")


def angle_of(drive: Recording) -> FloatArray:
    """True sideslip angle [rad]."""
    return np.arctan2(drive["vy_ref"], drive["vx_ref"])


def drawn(rng: np.random.Generator, seed: int) -> tuple[PlanarCar, SensorLevels, Recording]:
    """A drawn car in a drawn drive: straights, bends up to 0.75 of the grip and a sine at 10 to 33 m/s."""
    axles = (
        rng.uniform(2.3, 3.1),
        rng.uniform(0.42, 0.58),
        0.0051 * math.exp(rng.uniform(-0.5, 0.5)),
        rng.uniform(0.6, 0.95),
    )
    ranges = {
        "mass": (900, 2300),
        "friction": (0.8, 1.15),
        "load_sensitivity": (0, 0.15),
        "roll_gradient": (0.005, 0.011),
    }
    car = a_car(
        *axles,
        **{
            name: rng.uniform(*own)
            for name, own in (ranges | {"yaw_inertia": (0.85, 1.15)}).items()
        },
    )
    levels = SensorLevels(
        vx=SensorLevel(noise=0.0071),
        yaw_rate=SensorLevel(noise=2.5e-4, drift=5e-4, delay=rng.uniform(0.0, 0.06) * (seed % 2)),
        ax=replace(ACCELEROMETER, bias=rng.normal(0.0, 0.1)),
        ay=replace(ACCELEROMETER, bias=rng.normal(0.0, 0.3)),
        imu=Mounting(lever_x=rng.uniform(-0.2, 0.2)),
        tilt=Tilt(roll_share=rng.uniform(-0.5, 1.0)),
        reference=Reference(),
    )
    speeds = rng.uniform(10.0, 33.0, 14)
    knots = np.repeat(np.cumsum(rng.uniform(2.5, 6.0, 50)), 2) + np.tile([0.0, 0.5], 50)
    bends = np.repeat(
        rng.uniform(-0.75, 0.75, 51) * (rng.random(51) > 0.25) * car.friction * GRAVITY, 2
    )[1:-1]
    size = rng.uniform(0.0, 2.0)
    rate = math.tau * rng.uniform(0.2, 0.8)
    rate_hz = float(rng.choice([20, 25, 50, 100]))

    def lateral(time: float) -> float:
        return (float(np.interp(time, knots, bends)) + size * math.sin(rate * time)) * (time > 0.0)

    def speed(time: float) -> float:
        return float(np.interp(time, 10.0 * np.arange(14), speeds))

    return (
        car,
        levels,
        driven(
            car,
            levels,
            speed,
            lateral,
            seconds=rng.uniform(60.0, 120.0),
            rate_hz=rate_hz,
            seed=seed,
        ),
    )


def mixed(seed: int) -> tuple[PlanarCar, SensorLevels, Recording]:
    """A drawn car with its drive; drawn anew where it slides."""
    rng = np.random.default_rng(seed)
    while True:
        car, levels, drive = drawn(rng, seed)
        if np.abs(angle_of(drive)).max() < math.radians(25.0):
            return car, levels, drive


def identified(shipped: Estimator, seed: int) -> dict[str, Any]:
    """What was planted in a car and what `vehest identify` finds, with wheelbase and centre of gravity given."""
    car, levels, drive = mixed(seed)
    model = with_settings(
        shipped, {"wheelbase": car.wheelbase, "cg_to_rear_axle": car.cg_to_rear_axle}
    )
    record = record_of(model, {drive.id: posterior_of(model, drive)})
    found = {name: getattr(record, name) for name in LIMITS} | {
        f"offset_{name}": one for name, one in record.offsets[drive.id].items()
    }
    row: dict[str, Any] = {
        "car": seed,
        "seconds": drive.duration,
        "rate_hz": drive.rate_hz,
        "delay": levels.yaw_rate.delay,
    }
    row["delay_found"] = lateness_of(model, resampled(drive, RATE, PLAIN))
    for name, truth in planted(car, levels).items():
        row |= {
            f"{name}_planted": truth,
            name: found[name].value,
            f"{name}_deviation": found[name].deviation,
        }
        row[f"{name}_identified"] = int(bool(found[name].identified_on))
    return row


def weave(time: float) -> float:
    """Lateral accelerations on a motorway [m/s²]."""
    return 0.15 * math.sin(0.5 * time) + 0.1 * math.sin(1.3 * time)


SALOON = a_car(rear=0.54, compliance=0.0036)
PRODUCTION = replace(SensorLevels(), reference=Reference())


def scenes() -> dict[str, Recording]:
    """Drives with little excitation, or that the filter is not made for, with the sensors of production cars."""
    loose = a_car(rear=0.42, front=1.4, load_sensitivity=0.3, roll_share_front=0.1)

    def ramp(begin: float, seconds: float, size: float) -> Profile:
        return lambda time: size * min(max((time - begin) / seconds, 0.0), 1.0)

    def sweep(size: float) -> Recording:
        return driven(
            SALOON,
            PRODUCTION,
            lambda t: 20.0,
            lambda t: size * math.sin(math.tau * (0.1 + 0.016 * t) * t) * (t > 0.0),
        )

    return {
        "sweep, β up to 0.5°": sweep(math.radians(0.5) / float(np.abs(angle_of(sweep(1.0))).max())),
        "straight motorway": driven(SALOON, PRODUCTION, lambda t: 35.0, weave),
        "standstill": driven(SALOON, PRODUCTION, lambda t: 0.0),
        "spin": driven(loose, PRODUCTION, lambda t: 28.0, steer=ramp(4.0, 0.5, 0.06), seconds=12.0),
        "banked curve, 10°": driven(
            SALOON,
            PRODUCTION,
            lambda t: 30.0,
            ramp(5.0, 5.0, 4.0),
            bank=ramp(5.0, 5.0, -math.radians(10.0)),
        ),
        "trailer's pull": driven(SALOON, PRODUCTION, lambda t: 25.0, weave, pull=0.5),
    }


def pulled() -> dict[str, float]:
    """By how much the trailer's pull moves the means of the inputs."""
    free, held = (
        driven(SALOON, PRODUCTION, lambda t: 25.0, weave, pull=pull) for pull in (0.0, 0.5)
    )
    return {
        f"pull_{name}": float(np.mean(held[name] - free[name])) for name in ("yaw_rate", "ax", "ay")
    }


def offset_of(model: SelfCalibrating, drive: Recording) -> float:
    """Median size of the offset of ay that the filter finds, over its prior deviation."""
    samples = np.column_stack([drive[name] for name in model.channels])
    _, states, _ = model.trace(samples, model.first_state(samples[0], {}))
    return float(np.median(np.abs(states[:, kernel.OFFSET_Y]))) / model.offset_ay


def admitted(name: str, drive: Recording, shipped: Estimator, trust: Any) -> dict[str, Any]:
    """Errors, bands and health of `vehest estimate` in a scene; β counts above 3 m/s, v everywhere."""
    estimate = estimate_recording(shipped, drive.select(shipped.channels), trust)
    truth = resampled(drive, shipped.rate_hz, PLAIN)
    n = min(len(truth), len(estimate))
    own = {name: values[:n] for name, values in estimate.channels.items()}
    angle = angle_of(truth)[:n]
    vy = truth["vy_ref"][:n]
    moving = truth["vx_ref"][:n] > 3.0
    bad = own["health"] > 0
    reasons, counts = np.unique(own["health_reason"][bad], return_counts=True)
    band = np.degrees(own["band_sideslip"])
    return {
        "scene": name,
        "RMSE(β)": root(np.degrees(own["sideslip"] - angle)[moving]),
        "RMSE(β), v = 0": root(np.degrees(angle)[moving]),
        "RMSE(v)": root(own["vy"] - vy),
        "RMSE(v), v = 0": root(vy),
        "band of v holds": float(np.mean(np.abs(own["vy"] - vy) <= own["band_vy"])),
        "band of β, median": float(np.median(band)),
        "largest": float(band.max()),
        "not valid": float(bad.mean()),
        "invalid": float(np.mean(own["health"] == 2)),
        "most frequent reason": reason_in_words(float(reasons[counts.argmax()]))
        if len(reasons)
        else "",
    }


def root(errors: FloatArray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else math.nan


def markdown(frame: pd.DataFrame, whole: int = 0) -> str:
    """A table of a frame with its index; the first columns may be whole numbers."""

    def cell(at: int, one: Any) -> str:
        return (
            "–"
            if one != one
            else fixed(one, 2 * (at >= whole))
            if isinstance(one, float)
            else str(one)
        )

    rows = [
        [str(name), *map(cell, range(len(row)), row)]
        for name, row in zip(frame.index, frame.values.tolist(), strict=True)
    ]
    return "\n".join(table([str(frame.index.name), *map(str, frame.columns)], rows))


def report(
    pairs: pd.DataFrame,
    rows: pd.DataFrame,
    cars: pd.DataFrame,
    shifts: pd.DataFrame,
    seen: pd.DataFrame,
    banked: float,
) -> str:
    """The page."""
    named = pairs.assign(
        drives=(pairs["first"] + ", " + pairs["second"]).str.replace("telemetry_", "")
    )
    ratios = rows.iloc[:, 3:].div(rows["cold"], axis=0)
    by_car = ratios.apply(np.log).groupby(rows["car"], sort=False).mean()
    starts = (
        by_car.apply(np.exp)
        .T.assign(mean=np.exp(by_car.mean()), worst=ratios.max())
        .rename_axis("starts from; widening")
    )
    late = pd.cut(
        cars["delay"],
        [-1.0, 0.0, 0.02, 0.04, 0.06],
        labels=["no delay", "to 20 ms", "20 to 40 ms", "40 to 60 ms"],
    )
    cells: dict[str, dict[str, str]] = {}
    for number in (*LIMITS, "offset_ay", "offset_ax"):
        error = cars[number] - cars[f"{number}_planted"]
        used = cars[f"{number}_identified"] > 0
        sure = (error.abs() < 1.645 * cars[f"{number}_deviation"])[used & (cars["delay"] == 0.0)]
        cells[number] = {
            "identified": f"{used.sum()}",
            "of these without delay within 90 %": f"{fixed(sure.mean(), 2)} of {len(sure)}",
        }
        for title, own in (error / cars[f"{number}_deviation"]).groupby(late, observed=True):
            within = fixed((own.abs() < 1.645).mean(), 2)
            cells[number][f"{title} ({len(own)})"] = (
                f"{fixed(own.mean(), 2)} ± {fixed(own.std(), 2)}, {within}"
            )
    origins = rows["car"].map({car.title: car.origin for car in CARS})
    apart = pairs[pairs["z"].abs() > 1.645]["number"]
    excess = seen["RMSE(β)"] - seen["RMSE(β), v = 0"]
    beyond = seen[excess > seen["band of β, median"]]["scene"]
    worse = seen[excess > 0.0]["scene"]
    missed = 1e3 * (cars["delay_found"] - cars["delay"])
    return PAGE.format(
        late=round(1e3 * YAW_RATE_LATENESS_SECONDS),
        of_planted=f"{fixed(missed.mean(), 0)} ± {fixed(missed.std(), 0)}",
        worse=int((shifts["once advanced by it"] > shifts["error"]).sum()),
        now=fixed(shifts["band holds"].mean(), 2),
        then=fixed(shifts["band holds then"].mean(), 2),
        **{name: f"{value:.1g}" for name, value in pulled().items()},
        offset_ay=fixed(filter_of(CARS[0], RATE).offset_ay, 2),
        banked=fixed(banked, 1),
        development=fixed(shifts["deviations of ay's offset"].max(), 1),
        late_drives=len(shifts),
        furthest=fixed(
            float((shifts["by the filter"] - shifts["by the reference"]).abs().max()), 0
        ),
        lateness=markdown(
            shifts.set_index("drive").rename_axis("drive; lateness [ms], RMSE(β) [deg]"), whole=3
        ),
        agreeing=f"{len(pairs) - len(apart)} of {len(pairs)} agree within 90 % bands; apart: {', '.join(sorted(set(apart))) or 'none'}.",
        agreement=markdown(named.pivot(index="number", columns="drives", values="z")),
        ratios=markdown(starts),
        planted=markdown(pd.DataFrame(cells).T.rename_axis("number")),
        scenes=markdown(seen.set_index("scene")),
        verdict=f"Worse than v = 0: {', '.join(worse) or 'none'}; by more than the median band: {', '.join(beyond) or 'none'}.",
        worst=fixed(ratios[f"κ, b, a_max, C; {DEVIATION_FACTOR:g}"].max(), 2),
        better=int((ratios[f"κ, b; {DEVIATION_FACTOR:g}"] < 1.0).sum()),
        drives=len(rows),
        real=int((origins == "real").sum()),
        simulated=int((origins == "simulated").sum()),
        widening=DEVIATION_FACTOR,
        cars=len(cars),
    )


def main() -> None:
    """Command line."""
    output = Path(os.environ.get("VEHEST_OUTPUT", "outputs"))
    root_folder = os.environ["VEHEST_DATA"]
    _, shipped, trust = open_model(SELF_CALIBRATING, output, print)
    runner = Runner(output, Messages(), StopSignals())
    pairs, rows = carried_over(runner, root_folder)
    cars = pd.DataFrame([identified(shipped, seed) for seed in range(200)])
    shifts = lateness(runner, root_folder)
    drives = scenes()
    seen = pd.DataFrame([admitted(name, drive, shipped, trust) for name, drive in drives.items()])
    banked = offset_of(
        with_settings(shipped, {}), resampled(drives["banked curve, 10°"], RATE, PLAIN)
    )
    for name, frame in {
        "agreement": pairs,
        "carry_over": rows,
        "planted": cars,
        "lateness": shifts,
        "scenes": seen,
    }.items():
        frame.to_csv(TARGET / f"{name}.csv", index=False, float_format="%.4g", lineterminator="\n")
    (TARGET / "record.md").write_text(
        report(pairs, rows, cars, shifts, seen, banked), encoding="utf-8"
    )
    names = ("agreement.csv", "carry_over.csv", "planted.csv", "lateness.csv", "scenes.csv")
    record_tables(
        [TARGET / name for name in (*names, "record.md")],
        "make unseen_car_record",
        [
            "script tools/unseen_car_record.py",
            "evaluate self_calibrating",
            *raw_files_of(car for car in CARS if car.development),
        ],
    )


if __name__ == "__main__":
    main()
