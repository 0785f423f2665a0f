"""Write results/unseen_car: the self-calibrating filter on cars on which nothing was trained, beside the model that comes with vehest.

Run by ``make unseen_car``. It refuses choices that are not committed, and appends to openings.csv which cars were scored.
"""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.io
import yaml
from numpy.typing import NDArray

from vehest.configuration.composition import compose_config
from vehest.constants import FloatArray
from vehest.data.errors import DataError, MissingError
from vehest.data.recording import Recording
from vehest.data.resampling import resampled
from vehest.data.store import read_recording
from vehest.estimators.base import Estimator
from vehest.estimators.data_sheet import DataSheet
from vehest.estimators.filtering.self_calibrating_settings import TYPICAL_REAR, TYPICAL_WHEELBASE
from vehest.estimators.prior_map import PriorMap
from vehest.estimators.self_calibrating import SelfCalibrating
from vehest.inference.car_values import LIMITS, calibrated, with_settings
from vehest.inference.estimation import estimate_recording
from vehest.inference.models import SELF_CALIBRATING, open_model
from vehest.report.style import fixed
from vehest.run.console import Messages
from vehest.run.identify import Normal, posterior_of, record_of
from vehest.run.runner import Runner
from vehest.run.signals import StopSignals
from vehest.run.table_records import record_tables
from vehest.sources.base import open_source
from vehest.trust.bands import pooled_quantile
from vehest.trust.record import Trust

VERSION = "2"
"""Raised when the numbers of its tables move."""
ROOT = Path(__file__).resolve().parents[1]
CHOICES = "conf/estimator/self_calibrating.yaml"
CODE_OF_CHOICES = ("src/vehest/estimators", "src/vehest/inference", "src/vehest/run")
TARGET = ROOT / "results" / "unseen_car"
RATE = 20.0
BLOCK = round(10.0 * RATE)  # samples of a block of the bootstrap
TURN_YAW_RATE = 0.1  # rad/s
WARM_UP = 30  # samples until the shipped network estimates; scored for no method
PLAIN = {"method": "polyphase", "transforms": []}
ABLATIONS: dict[str, dict[str, Any]] = {
    "cold": {},
    "car not given": {"wheelbase": TYPICAL_WHEELBASE, "cg_to_rear_axle": None},
    "centre of gravity not given": {"cg_to_rear_axle": None},
    "bank alone": {"network_odds": 1e-9, "steady_odds": 1e-9},
    "no saturation": {"grips": [1000.0]},
    "no longitudinal equation": {"measured_ax": False},
    "fixed rear axle": {"grips": [14.0], "compliance_deviation": 1e-3},
    "no roll leakage": {"leakage": 0.0, "leakage_deviation": 1e-4},
}


PLACE_GIVEN = "place of the unit given"
VARIANTS = ("cold", PLACE_GIVEN, *list(ABLATIONS)[1:])
"""Columns of the table without the filter's parts."""


class Car(NamedTuple):
    """A car with its drives."""

    title: str
    origin: str  # real | simulated
    development: bool  # whether choices were made on it
    wheelbase: float
    cg_to_rear_axle: float | None
    dataset: str
    drives: str = "*"
    overrides: tuple[str, ...] = ()
    slowest: float = 5.0  # m/s, below which nothing is scored
    unit_at_cg: bool = False  # whether its signals are known to belong to the centre of gravity
    unlabelled: tuple[str, ...] = ()  # overrides of ingest for its drives without a reference


HELD_BACK = "telemetry_train_1"  # the Ferrari's unlabelled drive that is the labelled one
ROBUSTNESS = (
    "dataset=roboracer",
    "dataset.files=robustness/*.csv",
    "~dataset.drop_rows",
    "~dataset.pose",
    "~dataset.reference_point",
)
FIRST = tuple(f"dataset.drives.{at}.count=1" for at in range(5))
CARS = (
    Car(
        "Ferrari 250 LM",
        "real",
        True,
        2.4,
        1.07,
        "ferrari_250lm",
        unit_at_cg=True,
        unlabelled=("dataset=ferrari_250lm_unlabelled",),
    ),
    Car("Volvo S90", "real", True, 2.941, 1.291, "s90"),
    Car("Audi TTS, no ax", "real", True, 2.468, 1.45, "stanford_tts", unit_at_cg=True),
    Car("DevBot, by TUM", "simulated", True, 3.0, None, "tum"),
    Car(
        "Corvette Grand Sport",
        "simulated",
        True,
        2.49,
        1.19,
        "sim_race_cars",
        "c*",
        FIRST,
        unit_at_cg=True,
    ),
    Car(
        "Ferrari 250 LM-like",
        "simulated",
        True,
        2.4,
        1.07,
        "sim_race_cars",
        "f*",
        FIRST,
        unit_at_cg=True,
    ),
    Car("Jaguar E-type-like", "simulated", True, 2.44, None, "sim_race_cars", "j*", FIRST),
    Car("Volvo V40", "real", True, 2.55, 1.505, "kth_v40", slowest=3.0),
    Car("VW Golf, no ax, poor reference", "real", True, 2.578, 1.547, "liu_golf", slowest=3.0),
    Car("BMW 545i", "simulated", False, 2.88, 1.41, "sim_bmw_unseen", "unseen_*", unit_at_cg=True),
    Car("F1TENTH, 1:8", "real", False, 0.33, 0.115, "f1tenth", slowest=1.0),
    Car("DART, 1:10", "real", False, 0.175, 0.094, "dart", slowest=0.5),
    Car(
        "RoboRacer, 1:10",
        "real",
        False,
        0.33,
        None,
        "roboracer",
        slowest=0.5,
        unlabelled=ROBUSTNESS,
    ),
    Car("AutoRally, 1:5, smoothed signals", "real", False, 0.57, None, "autorally", slowest=1.0),
)
FILES = {
    "stanford_tts": "stanford_tts/*.mat",
    "autorally": "autorally/mppi_*.mat",
    "kth_v40": "kth_v40/*.VBO",
    "liu_golf": "liu_golf/dlc*.csv",
}
"""Raw files of cars that no data set in conf/dataset reads."""
SHIPS_ON = ("Ferrari 250 LM", "DevBot, by TUM", "Corvette Grand Sport", "BMW 545i")
LARGEST_RATIO = 1.1
STANDSTILL = "Stand_Still_no2"
V40 = {
    "name": "kth_v40",
    "vehicle": "volvo_v40",
    "source": "vbo",
    "files": "*.VBO",
    "channels": {
        "vx": {"column": "Lng._Vel.", "unit": "km/h"},
        "yaw_rate": {"column": "YawRate", "unit": "deg/s", "sign": -1},
        "ax": {"column": "X_Accel", "unit": "g"},
        "ay": {"column": "Y_Accel", "unit": "g"},
        "vy_ref": {"column": "Lat._Vel.", "unit": "km/h"},
        "vx_ref": {"column": "Lng._Vel.", "unit": "km/h"},
    },
    "reference_point": {"x": -0.7, "y": 0.0},  # of the antenna, by the logger's own offsets
    "imu_point": "unknown",
    "clock": "interpolate",
}
"""How the files of the Volvo V40 are read."""
METHODS = (
    "v = 0",
    "prior map",
    "data sheet",
    "shipped",
    "self-calibrating",
    "carried over",
    "smoothed, offline",
    "map with reference",
)
LEVEL = 0.9  # of the bands
STRAIGHT_AY = 1.0  # m/s², largest lateral acceleration on a straight
MARGIN = 0.1  # deg, by which a drive may be worse than v = 0
BAND_HEADS = (
    "car",
    "factor",
    "coverage",
    "while turning",
    "while turning, worst drive",
    "width [deg]",
    "interval score [deg]",
    "valid",
    "valid and outside the band",
    "valid and beyond twice the band",
    "of these, on straights",
)
DRIVE_BAND_HEADS = (*BAND_HEADS[2:4], *BAND_HEADS[5:])
OF_A_DRIVE = {"v = 0": "v = 0", "prior map": "prior map", "cold": "self-calibrating"}
"""Methods of the table of drives, with their titles."""
WORSE = ("drives", "worse than v = 0", "than 1.1 times shipped")
HEADS = ("car", "choices", *METHODS, "over shipped", "FVU, median (worst)", "coverage", *WORSE)
PAGE = """# A car that nobody has trained on

Self-calibrating filter with the choices of [one file](../../{choices}), started cold on every drive. It {verdict}
the rule for `vehest estimate`: without wheelbase, the upper 95 % limit of its RMSE(β) over the shipped model's is at most
{largest} on each of {limits}.
With wheelbase it is better than v = 0 on {below} of {drives} drives. Figures are RMSE(β) [deg] where
the car moves; intervals are a bootstrap over blocks of 10 s; the map v = r(b - k u²) was fitted to the reference of the same
drive. Cars on which choices were made are development cars: their figures are no evidence for another car. The others were
[opened](openings.csv) more than once, with the settings chosen in between that stand there. The network inside, also
the shipped model, learnt on a simulated fleet of variants of the BMW; no real car of full size has judged the filter so far.
The prior map is v = r(b - C u²) with the priors of the filter. Coverage is that of the 90 % band of β of the next table.
Carried over: started as by `vehest estimate --car` from a record of the car's other drives, of the Ferrari from three
without reference; – where there are none, or `vehest identify` refuses numbers that are not of a car.

{errors}

## Bands and health

The 90 % band of β that `vehest estimate` writes, and its health. Of a development car the factor of the band comes from the
other development cars, of a test car from all of them. The weights in the filter's variance and all other settings were chosen
by hand on all development cars together: no development car has settings that were chosen without it. Turning: |yaw rate|
above {turning} rad/s. The interval score is the mean width plus 20 times the mean excess of the errors over the band (Gneiting &
Raftery 2007), a mean over drives. The last three columns are shares of the valid samples. Straights: yaw rate at most
{turning} rad/s, |ay| below {straight} m/s²; tyres hardly slip there, and a sideslip of half a degree is that of the road or an error
of the reference. Health is that of all four channels together: a drive without ax has none and counts as valid.

{bands}

## Each drive of a development car

{drives_table}

## Over the drive

{by_time}

## Without its parts

{ablated}

The place of the unit is given where the signals are known to belong to the centre of gravity; else it is identified.
Where the centre of gravity is not given, v belongs to the inertial unit, and is scored against the reference as it is: of the
Volvo V40, whose unit is elsewhere, with the distance between both.
{places}
Small cars are seen at their wheelbase: times and speeds scale with its root, tyres slip more, the network does not count,
and steady cornering counts the more the smaller they are.

## Drives that are worse than the shipped model

By more than a tenth: {behind} drives; v = 0 errs there by {least_zero} to {most_zero}°,
the shipped model by at most {most_shipped}°, the filter by at most {most_own}°.
The largest FVU, {largest_fvu}, is of {of_drive}, RMSE(β) {its_own}°, of v = 0 {its_zero}°.

{worse}

{changed}"""


class Errors(NamedTuple):
    """Of one drive: squared errors of β and v by method, the 90 % band of β, health, and the reference, each (T,)."""

    sideslip: Mapping[str, FloatArray]
    vy: Mapping[str, FloatArray]
    half_width: FloatArray  # of the 90 % band of β that `vehest estimate` writes [deg]
    valid: NDArray[np.bool_]  # by health
    turning: NDArray[np.bool_]  # |yaw rate| above TURN_YAW_RATE
    straight: NDArray[np.bool_]  # not turning, |ay| below STRAIGHT_AY
    reference: FloatArray
    time: FloatArray
    title: str
    speed: float  # median [m/s]


def raw_files_of(cars: Iterable[Car]) -> list[str]:
    """Names of the keys of everything that is read of cars (`vehest.run.table_records`)."""
    names = set()
    for car in cars:
        name = car.dataset
        names.add(f"files {FILES[name]}" if name in FILES else f"data {name}")
        if car.unlabelled == ROBUSTNESS:
            names.add("files roboracer/robustness/*.csv")
        elif car.unlabelled:
            names.add("data ferrari_250lm_unlabelled")
    return sorted(names)


def drives_of(car: Car, runner: Runner, root: str) -> Iterator[Recording]:
    """Its recordings at the filter's rate, with the reference."""
    if car.dataset == "stanford_tts":
        for file in sorted((Path(root) / "stanford_tts").glob("*.mat")):
            held = {
                name: np.ravel(values).astype(float)
                for name, values in scipy.io.loadmat(file).items()
                if not name.startswith("_")
            }
            speed = held["Speed_mps"]
            yaw_rate = held["YawRate_radps"]
            ay = held["LateralAcceleration_mps2"] + 1.43 * np.gradient(
                yaw_rate, 0.005
            )  # from behind to the point of the sideslip
            channels = {
                "yaw_rate": yaw_rate,
                "vx": speed,
                "ay": ay,
                "vy_ref": speed * np.tan(held["Sideslip_rad"]),
            }
            yield resampled(Recording(file.stem, "audi_tts", 200.0, 0.0, channels), RATE, PLAIN)
        return
    if car.dataset == "autorally":
        for file in sorted((Path(root) / "autorally").glob("mppi_states_controls*.mat")):
            states = scipy.io.loadmat(file)["states"]
            accelerations = scipy.io.loadmat(str(file).replace("states_controls", "accels"))["a"]
            found = {
                "yaw_rate": states[2],
                "vx": states[0],
                "ay": -accelerations[1],
                "ax": accelerations[0],
                "vy_ref": states[1],
            }
            # poses, from which the states were made, blow up at both ends
            channels = {
                name: np.ascontiguousarray(values[2000:-2000], dtype=float)
                for name, values in found.items()
            }
            yield resampled(Recording(file.stem, "autorally", 1000.0, 0.0, channels), RATE, PLAIN)
        return
    if car.dataset == "liu_golf":
        for file in sorted((Path(root) / "liu_golf").glob("dlc*.csv")):
            table = np.genfromtxt(file, delimiter=",", names=True)
            columns = {"yaw_rate": "Omegaz", "vx": "vx", "ay": "ay", "vy_ref": "vy"}
            channels = {name: table[column].copy() for name, column in columns.items()}
            yield resampled(Recording(file.stem, "vw_golf", 250.0, 0.0, channels), RATE, PLAIN)
        return
    if car.dataset == "kth_v40":
        source = open_source(V40 | {"path": str(Path(root) / "kth_v40")})
        for recording in source.recordings():
            if recording.id != STANDSTILL:
                yield resampled(recording, RATE, PLAIN)
        return
    for recording in ingested(runner, root, f"dataset={car.dataset}", *car.overrides):
        read = {"yaw_rate", "vx", "ay", "vy_ref"} <= set(recording.channels)
        if fnmatchcase(recording.id, car.drives) and read and recording.duration > 5.0:
            yield resampled(recording, min(RATE, recording.rate_hz), PLAIN)


def ingested(runner: Runner, root: str, *overrides: str) -> Iterator[Recording]:
    """Recordings of a data set as they are."""
    made = runner.ingest(
        compose_config("ingest", [f"root={root}", f"output={runner.output}", *overrides])
    )
    return (read_recording(made.folder / name) for name in made.outputs)


def unlabelled_of(car: Car, runner: Runner, root: str) -> list[Recording]:
    """Its drives without a reference."""
    return (
        [one for one in ingested(runner, root, *car.unlabelled) if one.id != HELD_BACK]
        if car.unlabelled
        else []
    )


def filter_of(car: Car, rate_hz: float, **changed: Any) -> SelfCalibrating:
    """The filter with the car's sheet."""
    own = {"wheelbase": car.wheelbase, "cg_to_rear_axle": car.cg_to_rear_axle, "rate_hz": rate_hz}
    model = with_settings(SelfCalibrating.from_config({}), own | changed)
    model.preparation = PLAIN
    return model


def identified_on(car: Car, drives: Sequence[Recording]) -> dict[str, dict[str, Normal]]:
    """What `vehest identify` finds on each drive."""
    return {
        drive.id: posterior_of(
            filter_of(car, min(RATE, drive.rate_hz), measured_ax="ax" in drive), drive
        )
        for drive in drives
    }


def models_of(car: Car, rate_hz: float, has_ax: bool) -> dict[str, Estimator]:
    """The methods that are compared, by title."""
    sheet = {
        "wheelbase": car.wheelbase,
        "cg_to_rear_axle": car.cg_to_rear_axle or TYPICAL_REAR * car.wheelbase,
        "rate_hz": rate_hz,
    }
    prior = {**sheet, "cg_to_rear_axle": car.cg_to_rear_axle}
    variants = ABLATIONS | {"smoothed": {"smoothed": True}}
    if car.unit_at_cg:
        variants[PLACE_GIVEN] = {"imu_to_rear_axle": car.cg_to_rear_axle}
    filters = {
        name: filter_of(car, rate_hz, **({"measured_ax": has_ax} | changed))
        for name, changed in variants.items()
    }
    return {
        "data sheet": DataSheet.from_config(sheet),
        "prior map": PriorMap.from_config(prior),
        **filters,
    }


def errors_of(
    car: Car,
    recording: Recording,
    shipped: Estimator,
    trust: Trust,
    others: Mapping[str, Mapping[str, Normal]],
) -> Errors:
    """Squared errors of every method where the car moves; the map is v = r (b - k u²), fitted to this drive's own reference.

    ``others`` are the numbers found on the car's other drives, from which "carried over" starts; NaN without any.
    """
    speed = recording["vx"]
    truth = recording["vy_ref"]
    has_ax = "ax" in recording
    ax = recording["ax"] if has_ax else np.gradient(speed, 1.0 / recording.rate_hz)
    inputs = {"yaw_rate": recording["yaw_rate"], "vx": speed, "ay": recording["ay"], "ax": ax}
    plain = Recording(recording.id, recording.vehicle, recording.rate_hz, 0.0, inputs)
    moving = (speed > car.slowest) & np.isfinite(truth) & (np.arange(len(speed)) >= WARM_UP)
    columns = np.column_stack([inputs["yaw_rate"], -inputs["yaw_rate"] * speed**2])
    found = {
        "v = 0": np.zeros(len(speed)),
        "map": columns @ np.linalg.lstsq(columns[moving], truth[moving], rcond=None)[0],
    }
    found["shipped"] = (
        np.nan_to_num(shipped.estimate([plain])[0]["vy"])
        if abs(plain.rate_hz - RATE) < 1e-9
        else found["v = 0"] * np.nan
    )
    models = models_of(car, plain.rate_hz, has_ax)
    found["carried over"] = found["v = 0"] * np.nan
    if others:
        with suppress(DataError):  # numbers that are not of a car
            models["carried over"] = calibrated(
                models["cold"], record_of(with_settings(models["cold"], {}), others)
            )
    for name, model in models.items():
        estimate = model.estimate([plain.select(model.channels)])[0]
        found[name] = estimate["vy"]
    angle = {
        name: np.degrees(np.arctan2(vy, speed) - np.arctan2(truth, speed))[moving] ** 2
        for name, vy in found.items()
    }
    model = models["cold"]
    judged = estimate_recording(model, plain.select(model.channels), trust.for_settings(model))
    half_width = np.degrees(judged["band_sideslip"])[moving]
    valid = (judged["health"] == 0)[moving]
    turning = (np.abs(inputs["yaw_rate"]) > TURN_YAW_RATE)[moving]
    straight = ~turning & (np.abs(inputs["ay"]) < STRAIGHT_AY)[moving]
    time = np.arange(len(speed))[moving] / plain.rate_hz
    return Errors(
        angle,
        {name: (vy - truth)[moving] ** 2 for name, vy in found.items()},
        half_width,
        valid,
        turning,
        straight,
        truth[moving],
        time,
        recording.id,
        float(np.median(speed[moving])),
    )


def scored(car: Car, runner: Runner, root: str, shipped: Estimator, trust: Trust) -> list[Errors]:
    """Of its drives, each also from a record of the others."""
    drives = list(drives_of(car, runner, root))
    own = identified_on(car, drives) | identified_on(
        car, unlabelled_of(car, runner, root) if car.development else []
    )
    return [
        errors_of(
            car,
            drive,
            shipped,
            trust,
            {name: one for name, one in own.items() if name != drive.id},
        )
        for drive in drives
    ]


def under_change(car: Car, runner: Runner, root: str) -> list[str]:
    """Lines on drives without a reference: numbers that are found from the priors, the median band and the share that is not valid."""
    _, shipped, trust = open_model(SELF_CALIBRATING, runner.output, print)
    model = with_settings(
        shipped, {"wheelbase": car.wheelbase, "cg_to_rear_axle": car.cg_to_rear_axle}
    )
    rows = []
    labelled = {"its labelled drives": list(drives_of(car, runner, root))}
    for title, drives in (
        labelled | {drive.id: [drive] for drive in unlabelled_of(car, runner, root)}
    ).items():
        record = record_of(model, identified_on(car, drives))
        estimates = [estimate_recording(model, drive, trust) for drive in drives]
        band, health = (
            np.concatenate([estimate[name] for estimate in estimates])
            for name in ("band_sideslip", "health")
        )
        found = [getattr(record, name) for name in LIMITS]
        numbers = [
            f"{one.value:.3g} ± {one.deviation:.2g}" if one.identified_on else "–" for one in found
        ]
        rows.append(
            [
                title,
                *numbers,
                fixed(float(np.degrees(np.nanmedian(band))), 2),
                fixed(float(np.mean(health > 0)), 2),
            ]
        )
    about = "what `vehest identify` finds from the filter's priors (leakage [1], rear axle [m], compliance [rad s²/m], grip [m/s²])"
    shown = table(["drive", *LIMITS, "band of β, median [deg]", "not valid"], rows)
    heading = f"## {car.title} ({car.origin}) under other masses and tyres"
    return [
        heading,
        "",
        f"No reference: {about}, – not identified; bands and health.",
        "",
        *shown,
        "",
    ]


def rmse(drives: Sequence[Errors], name: str) -> float:
    """Of β over all samples of some drives [deg]."""
    return float(np.sqrt(np.mean(np.concatenate([drive.sideslip[name] for drive in drives]))))


def ratio_interval(
    drives: Sequence[Errors], name: str = "cold", rounds: int = 4000
) -> tuple[float, float]:
    """95 % interval of RMSE(β) over that of the shipped model, by a bootstrap over blocks of 10 s."""

    def sums(title: str) -> FloatArray:
        parts = [
            part
            for d in drives
            for part in np.array_split(d.sideslip[title], max(1, len(d.time) // BLOCK))
        ]
        return np.array([part.sum() for part in parts])

    own = sums(name)
    shipped = sums("shipped")
    drawn = np.random.default_rng(0).integers(0, len(own), (rounds, len(own)))
    low, high = np.quantile(np.sqrt(own[drawn].sum(1) / shipped[drawn].sum(1)), [0.025, 0.975])
    return float(low), float(high)


def fvu(drive: Errors, name: str) -> float:
    """Share of the variance of v that is left."""
    return float(np.mean(drive.vy[name]) / np.var(drive.reference))


def error_over_band(drive: Errors) -> FloatArray:
    """Error of β over the half width of its band, (T,)."""
    return np.asarray(np.sqrt(drive.sideslip["cold"]) / drive.half_width)


def factor_without(car: Car, found: Mapping[Car, Sequence[Errors]]) -> float:
    """Factor on the bands so that they cover 90 % of the errors on the development cars but this one, each drive of the same weight.

    1 for a test car: the factor of the bands comes from all development cars.
    """
    if not car.development:
        return 1.0
    drives = [
        drive
        for other, own in found.items()
        if other.development and other != car
        for drive in own
        if len(drive.time)
    ]
    if not drives:
        return 1.0
    ratios = [error_over_band(drive) for drive in drives]
    blocks = np.repeat(np.arange(len(ratios)), [len(part) for part in ratios])
    return pooled_quantile(np.concatenate(ratios), blocks, LEVEL)[0]


def band_figures(drives: Sequence[Errors], factor: float) -> list[str]:
    """Cells of some drives' bands and health, as in `BAND_HEADS` from ``factor`` on."""
    ratios = [error_over_band(drive) / factor for drive in drives]
    ratio = np.concatenate(ratios)
    turning = np.concatenate([drive.turning for drive in drives])
    straight = np.concatenate([drive.straight for drive in drives])
    valid = np.concatenate([drive.valid for drive in drives])
    by_drive = [
        float(np.mean(own[drive.turning] <= 1.0))
        for drive, own in zip(drives, ratios, strict=True)
        if drive.turning.sum() > BLOCK // 4
    ]
    width = [2.0 * factor * drive.half_width for drive in drives]
    score = [
        np.mean(own + 10.0 * own * np.maximum(beyond - 1.0, 0.0))
        for own, beyond in zip(width, ratios, strict=True)
    ]
    figures = [
        factor,
        np.mean(ratio <= 1.0),
        np.mean(ratio[turning] <= 1.0) if turning.any() else np.nan,
        min(by_drive, default=np.nan),
        np.mean([own.mean() for own in width]),
        np.mean(score),
        np.mean(valid),
        np.mean(ratio[valid] > 1.0) if valid.any() else np.nan,
        np.mean(ratio[valid] > 2.0) if valid.any() else np.nan,
        np.mean((straight & (ratio > 2.0))[valid]) if valid.any() else np.nan,
    ]
    digits = [2] * (len(figures) - 2) + [3, 3]
    return [
        fixed(float(figure), places) if np.isfinite(figure) else "–"
        for figure, places in zip(figures, digits, strict=True)
    ]


def drive_figures(drive: Errors, factor: float) -> list[str]:
    """The same of one drive, as in `DRIVE_BAND_HEADS`."""
    figures = band_figures([drive], factor)
    return [*figures[1:3], *figures[4:]]


def git(*words: str) -> str:
    """What git answers, without the last line break."""
    return subprocess.run(
        ["git", *words], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.strip()


def chosen_since(before: str, now: str) -> list[str]:
    """Settings of the filter that have other values in one commit than in an earlier one."""
    earlier, later = (
        yaml.safe_load(git("show", f"{commit}:{CHOICES}"))["estimator"] for commit in (before, now)
    )
    return sorted(name for name, value in later.items() if (name, value) not in earlier.items())


def open_cars(cars: Sequence[str], note: str) -> None:
    """Append what is scored to openings.csv, with a note; raises SystemExit where the choices are not committed."""
    if git("status", "--porcelain", "--", CHOICES, *CODE_OF_CHOICES):
        raise SystemExit(
            f"{CHOICES} or {', '.join(CODE_OF_CHOICES)} have changes that are not committed; commit them, then open the cars"
        )
    file = TARGET / "openings.csv"
    commit = git("rev-parse", "HEAD")
    rows = list(csv.DictReader(file.open(encoding="utf-8"))) if file.exists() else []
    names = chosen_since(rows[-1]["commit"], commit) if rows else []
    rows.append(
        {
            "commit": commit,
            "cars": "; ".join(cars),
            "chosen_since": " ".join([*names, note]).strip() if rows else "everything",
        }
    )
    with file.open("w", encoding="utf-8", newline="") as out:
        writer = csv.DictWriter(out, list(rows[-1]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A Markdown table."""
    return [
        f"| {' | '.join(row)} |" for row in (heads, [":--", *["--:"] * (len(heads) - 1)], *rows)
    ]


def worse_with_place(found: Mapping[Car, Sequence[Errors]]) -> str:
    """How many drives are worse than v = 0 by more than `MARGIN`, with the place of the unit given and not."""
    drives = [drive for car, own in found.items() if car.unit_at_cg for drive in own]
    counts = [
        sum(rmse([drive], name) > rmse([drive], "v = 0") + MARGIN for drive in drives)
        for name in (PLACE_GIVEN, "cold")
    ]
    return (
        f"Of the {len(drives)} drives of these cars {counts[0]} are worse than v = 0 by more than {MARGIN}° "
        f"with the place given, {counts[1]} without."
    )


def report(found: Mapping[Car, Sequence[Errors]], changed: Sequence[str]) -> str:
    """The page."""
    ratios = {
        car: ratio_interval(drives)
        for car, drives in found.items()
        if np.isfinite(rmse(drives, "shipped"))
    }
    limits = {
        car.title: ratio_interval(found[car], "car not given")[1]
        for car in ratios
        if car.title in SHIPS_ON
    }
    ships = len(limits) == len(SHIPS_ON) and max(limits.values()) <= LARGEST_RATIO
    rows = []
    drives_below = []
    bands = []
    by_drive = []
    by_time = []
    ablated = []
    worse: list[tuple[str, float, float, float, float]] = []
    for car, drives in found.items():
        title = f"{car.title} ({car.origin})"
        shares = [fvu(drive, "cold") for drive in drives]
        drives_below += [rmse([drive], "cold") < rmse([drive], "v = 0") for drive in drives]
        over = "–"
        errors = [
            rmse(drives, name)
            for name in (
                "v = 0",
                "prior map",
                "data sheet",
                "shipped",
                "cold",
                "carried over",
                "smoothed",
                "map",
            )
        ]
        if car in ratios:
            over = f"{fixed(errors[4] / errors[3], 2)} [{fixed(ratios[car][0], 2)}, {fixed(ratios[car][1], 2)}]"
        figures = [fixed(error, 2) if np.isfinite(error) else "–" for error in errors]
        factor = factor_without(car, found)
        bands.append([title, *band_figures(drives, factor)])
        coverage = bands[-1][2]
        if car.development:
            by_drive += [
                [
                    f"{title}, {drive.title}",
                    *(fixed(rmse([drive], name), 2) for name in OF_A_DRIVE),
                    fixed(fvu(drive, "cold"), 3),
                    *drive_figures(drive, factor),
                ]
                for drive in drives
            ]
        about = [title, "made on it" if car.development else "not", *figures, over]
        above = [
            sum(rmse([drive], "cold") > limit * rmse([drive], name) for drive in drives)
            for limit, name in ((1.0, "v = 0"), (1.1, "shipped"))
        ]
        for drive in drives if car in ratios else ():
            zero, shipped, own = (rmse([drive], name) for name in ("v = 0", "shipped", "cold"))
            if own > 1.1 * shipped:
                worse.append((f"{title}, {drive.title}", drive.speed, zero, shipped, own))
        counts = [str(len(drives)), str(above[0]), str(above[1]) if car in ratios else "–"]
        rows.append(
            [
                *about,
                f"{fixed(float(np.median(shares)), 3)} ({fixed(max(shares), 2)})",
                coverage,
                *counts,
            ]
        )
        early = ((0.0, 10.0), (10.0, 30.0), (30.0, 60.0), (60.0, 300.0), (300.0, 1e9))
        parts = [
            np.concatenate([d.sideslip["cold"][(d.time >= low) & (d.time < high)] for d in drives])
            for low, high in early
        ]
        by_time.append(
            [
                title,
                *[
                    fixed(float(np.sqrt(part.mean())), 2) if len(part) > BLOCK // 4 else "–"
                    for part in parts
                ],
            ]
        )
        ablated.append(
            [
                title,
                *[
                    fixed(rmse(drives, name), 2) if name in drives[0].sideslip else "–"
                    for name in VARIANTS
                ],
            ]
        )
    heads = ("drive", "median speed [m/s]", "v = 0", "shipped", "self-calibrating")
    of_drive = max(
        (drive for drives in found.values() for drive in drives),
        key=lambda drive: fvu(drive, "cold"),
    )
    return PAGE.format(
        choices=CHOICES,
        verdict="meets" if ships else "does not meet",
        largest=LARGEST_RATIO,
        limits=", ".join(f"{name} ({fixed(limit, 2)})" for name, limit in limits.items()),
        below=sum(drives_below),
        drives=len(drives_below),
        errors="\n".join(table(HEADS, rows)),
        places=worse_with_place(found),
        turning=TURN_YAW_RATE,
        straight=STRAIGHT_AY,
        bands="\n".join(table(BAND_HEADS, bands)),
        drives_table="\n".join(
            table(["drive", *OF_A_DRIVE.values(), "FVU", *DRIVE_BAND_HEADS], by_drive)
        ),
        by_time="\n".join(
            table(["car", "0 to 10 s", "10 to 30 s", "30 to 60 s", "60 to 300 s", "later"], by_time)
        ),
        ablated="\n".join(table(["car", *VARIANTS], ablated)),
        worse="\n".join(
            table(
                heads,
                [
                    [name, fixed(speed, 1), *(fixed(one, 2) for one in own)]
                    for name, speed, *own in worse
                ],
            )
        ),
        behind=len(worse),
        least_zero=fixed(min((row[2] for row in worse), default=0.0), 2),
        most_zero=fixed(max((row[2] for row in worse), default=0.0), 2),
        most_shipped=fixed(max((row[3] for row in worse), default=0.0), 2),
        most_own=fixed(max((row[4] for row in worse), default=0.0), 2),
        of_drive=of_drive.title,
        largest_fvu=fixed(fvu(of_drive, "cold"), 2),
        its_own=fixed(rmse([of_drive], "cold"), 2),
        its_zero=fixed(rmse([of_drive], "v = 0"), 2),
        changed="\n".join(changed),
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--output",
        type=Path,
        default=Path(os.environ.get("VEHEST_OUTPUT", "outputs")),
        help="output root, for ingested drives",
    )
    parser.add_argument(
        "--development",
        action="store_true",
        help="development cars alone, printed and not published",
    )
    parser.add_argument(
        "--note",
        default="",
        help="what else was chosen since the cars were last opened, and on what",
    )
    given = parser.parse_args()
    root = os.environ.get("VEHEST_DATA", "")
    if not root:
        raise SystemExit("set VEHEST_DATA to the folder of the recordings")
    cars = [car for car in CARS if car.development or not given.development]
    if not given.development:
        TARGET.mkdir(parents=True, exist_ok=True)
        open_cars([car.title for car in cars if not car.development], given.note)
    runner = Runner(given.output, Messages(), StopSignals())
    (_, shipped, _) = open_model("pretrained", given.output, print)
    (_, _, trust) = open_model(SELF_CALIBRATING, given.output, print)
    if trust is None:
        raise SystemExit(f"'{SELF_CALIBRATING}' has no calibrated bands")
    found: dict[Car, list[Errors]] = {}
    changed: list[str] = []
    for car in cars:
        try:
            found[car] = scored(car, runner, root, shipped, trust)
            if car.unlabelled and not car.development:
                changed += under_change(car, runner, root)
        except MissingError as error:
            print(f"left out: {car.title}: {error}")
    page = report(
        {
            car: [drive for drive in drives if len(drive.time)]
            for car, drives in found.items()
            if drives
        },
        changed,
    )
    if given.development:
        print(page)
    else:
        (TARGET / "report.md").write_text(page, encoding="utf-8")
        record_tables(
            [TARGET / "report.md", TARGET / "openings.csv"],
            "make unseen_car",
            [
                "script tools/unseen_car.py",
                "evaluate self_calibrating",
                *raw_files_of(found),
            ],
        )


if __name__ == "__main__":
    main()
