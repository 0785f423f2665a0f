"""Every family online, under every fault of every channel it reads, sample by sample: `make
online_faults`.

A row a case in results/reliability/online_faults.csv. Each drive is 16 s of a range that the
estimator has not learnt from: 4 s to settle, 4 s of fault, 8 s to come back. It is stepped through
`vehest.trust.contract.GuardedStepper` once as it is and once a case, from the estimator's first
sample on. What is asked of a case:

- `finite`: no value that is not finite once the window is full (with the fault's first sample
  within it or not);
- `exceptions`: what reached the caller;
- `recovered`: the error of the sideslip angle, from 3 s after the fault's end (or the family's
  window, if that is longer) to the end, is at most twice its usual size: that of the whole drive
  without the fault, or of the same seconds without it, whichever is larger;
- `within_speed`: the lateral velocity never exceeded what the last believed speed allows.
"""

import argparse
import math
import os
import time
import warnings
from collections import namedtuple
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from itertools import product
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd
import torch

import vehest
from vehest.configuration.composition import compose_config
from vehest.data.resampling import transforms_of
from vehest.run.table_records import RowKeys, record_tables
from vehest.sources.base import open_source
from vehest.trust.faults import KINDS, SEVERITIES, Fault, applies, inject
from vehest.trust.guard import learn_limits
from vehest.trust.watch import STARTED

VERSION = "1"
"""Raised when the numbers of its tables move."""
SETTLE = 4.0
LASTS = 4.0
COMES_BACK = 8.0
RECOVERS = 3.0  # s
TIMES_USUAL = 2.0

HEADER = [
    "data",
    "kind",
    "estimator",
    "rate_hz",
    "fault",
    "channel",
    "severity",
    "finite",
    "exceptions",
    "within_speed",
    "starts",
]
HEADER += ["usual_error_deg", "error_while_faulted_deg", "error_after_deg", "recovered"]

CAR = (
    "estimator.car={mass: 982, yaw_inertia: 1605.4145, cg_to_front_axle: 1.33, "
    "cg_to_rear_axle: 1.07, cg_height: 0.45}"
)
SHORT = ("tyres_from='*'", "method=data", "restarts=1", "generations=40")
IDENTIFIED = ("estimator.inputs=imu", CAR, *(f"training.identification.{word}" for word in SHORT))
FERRARI = {
    "zero": (),
    "static_map": (),
    "kinematic": (),
    "data_sheet": ("estimator.wheelbase=2.4", "estimator.cg_to_rear_axle=1.07"),
    "self_calibrating": ("estimator.wheelbase=2.4", "estimator.cg_to_rear_axle=1.07"),
    "luenberger": (),
    "kalman": (),
    "factor_graph": ("estimator.window=0.5",),
    "rational_ekf": ("estimator.tyres=rational_adaptive",),
    "ksnn": ("estimator.n_local=2", "estimator.n_hidden=2", "training.max_epochs=30"),
    "gru": ("estimator.n_states=5", "training.max_epochs=30"),
    "lstm": ("estimator.n_states=5", "training.max_epochs=30"),
    "velocity_gru": (
        "estimator.inputs=[vx,yaw_rate,ay,ax]",
        "estimator.outputs=[vx,vy]",
        "training.phase.max_epochs=20",
    ),
    "velocity_lstm": (
        "estimator.inputs=[vx,yaw_rate,ay,ax]",
        "estimator.outputs=[vx,vy]",
        "training.phase.max_epochs=20",
    ),
    "dugoff_ukf": ("estimator.inputs=imu", CAR, *(f"training.{word}" for word in SHORT)),
    "sideslip_ffnn": ("estimator.inputs=imu", "training.phase.max_epochs=20"),
    "cnn_ukf": (
        *IDENTIFIED,
        "training.pre_training.max_epochs=10",
        "training.end_to_end.max_epochs=1",
    ),
    "ensemble_ukf": (
        *IDENTIFIED,
        "training.scaling_trials=5",
        "estimator.members=3",
        "training.phase.max_epochs=10",
    ),
}
SMALL_CAR = {
    "self_calibrating": ("estimator.wheelbase=0.33",),
    "learned_ukf": (
        "estimator.dynamics=pacejka",
        "training.one_step.max_epochs=60",
        "training.noise.max_epochs=3",
    ),
}
SLOW = ("learned_ukf", "kalman", "dugoff_ukf", "factor_graph", "cnn_ukf", "ensemble_ukf")
Ground = namedtuple("Ground", "data kind train validation trial families")
"""Ranges of a data set to learn from and to be tried on, in seconds after the first sample."""


def grounds():
    """A simulated drive always, the real ones where the recordings are."""
    bmw = {
        **FERRARI,
        "data_sheet": ("estimator.wheelbase=2.579", "estimator.cg_to_rear_axle=1.423"),
        "self_calibrating": ("estimator.wheelbase=2.579", "estimator.cg_to_rear_axle=1.423"),
    }
    bmw_car = (
        "estimator.car={mass: 1093, yaw_inertia: 1791, cg_to_front_axle: 1.156, "
        "cg_to_rear_axle: 1.423, cg_height: 0.42}"
    )
    bmw = {
        name: tuple(bmw_car if word == CAR else word for word in words)
        for name, words in bmw.items()
    }
    yield Ground(
        "sim_quickstart",
        "simulated",
        ("drive_1", 0, 150),
        ("drive_2", 0, 90),
        ("drive_3", 40.0),
        bmw,
    )
    if os.environ.get("VEHEST_DATA"):
        day = "20140222_01_01_03_250lm"
        hoons = "iros_hoons_1_with_friction_run_"
        yield Ground("ferrari_250lm", "real", (day, 0, 300), (day, 300, 400), (day, 450.0), FERRARI)
        yield Ground(
            "f1tenth",
            "real",
            (f"{hoons}1", 0, 60),
            (f"{hoons}0", 0, 40),
            ("hoons_all_test_run_4", 10.0),
            SMALL_CAR,
        )


@cache
def recording(data, name):
    """A recording at its native rate."""
    return open_source(compose_config("ingest", [f"dataset={data}"])["dataset"]).read(name)


def stretch(recording, start, stop):
    """From so many seconds after a recording's first sample to so many."""
    return recording.cut(recording.start_time + start, recording.start_time + stop)


def at_rate(recording, estimator):
    """A recording as the estimator takes it."""
    for transform in transforms_of(
        {"rate_hz": estimator.settings.rate_hz, **estimator.preparation}
    ):
        recording = transform(recording)
    return recording


def sideslip(vy, vx):
    """Sideslip angle [deg]."""
    return np.degrees(np.arctan2(vy, vx))


def walk(estimator, limits, samples):
    """v after each sample, held for the time that it is made for, with exceptions, starts, and
    whether the speed bounds it.
    """
    stepper = vehest.online(estimator).stepper
    rows = [
        dict(zip(samples, row, strict=True))
        for row in zip(*(values.tolist() for values in samples.values()), strict=True)
    ]
    estimates = np.full(len(rows), np.nan)
    exceptions = 0
    starts = 0
    fastest = 1.0
    bounded = True
    for k, row in enumerate(rows):
        try:
            estimates[k] = stepper.step(row)["vy"]
        except Exception:  # whatever reaches the caller is what is counted
            exceptions += 1
        starts += bool(stepper.marks & STARTED)
        speed = abs(row.get("vx", math.nan))
        if speed < 140.0:
            fastest = max(fastest, speed)
        bounded &= not abs(estimates[k]) > limits.largest_tan_sideslip * min(
            fastest, limits.top_speed
        ) * (1 + 1e-9) or math.isinf(estimates[k])
    return (
        np.concatenate([np.full(estimator.horizon_steps, np.nan), estimates])[: len(rows)],
        exceptions,
        starts,
        bounded,
    )


def try_family(ground, name):
    """Fit a family and walk it through every case; a row each."""
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore")
    train, validation = (
        stretch(recording(ground.data, segment), start, stop)
        for segment, start, stop in (ground.train, ground.validation)
    )
    estimator = vehest.train(name, [train], [validation], ground.families[name])
    rate = estimator.settings.rate_hz
    limits = learn_limits([at_rate(train, estimator)], estimator.channels, rate)
    drive = at_rate(recording(ground.data, ground.trial[0]), estimator)
    start = ground.trial[1]
    drive = stretch(drive, start, start + SETTLE + LASTS + COMES_BACK)
    samples = {channel: drive[channel].copy() for channel in estimator.channels}
    speed = drive["vx_ref"] if "vx_ref" in drive else drive["vx"]
    reference = sideslip(drive["vy_ref"], speed)
    seconds = np.arange(len(drive)) / rate
    warm = estimator.warm_up_steps + estimator.horizon_steps
    back = SETTLE + LASTS + max(RECOVERS, estimator.warm_up_steps / rate)

    def error(vy, chosen):
        """Root mean square of the error of the sideslip angle over chosen samples [deg]."""
        return float(
            np.sqrt(np.mean(np.square(sideslip(vy[chosen], speed[chosen]) - reference[chosen])))
        )

    nominal = walk(estimator, limits, samples)[0]
    settled = np.arange(len(drive)) >= max(warm, round(2.0 * rate))
    after = seconds >= back
    during = (seconds >= SETTLE) & (seconds < SETTLE + LASTS)
    usual = max(error(nominal, settled), error(nominal, after))
    measured = [channel for channel, values in samples.items() if not np.isnan(values).all()]
    rows = []
    for channel, kind, severity in product(measured, KINDS, SEVERITIES):
        if not applies(kind, channel):
            continue
        vy, exceptions, starts, bounded = walk(
            estimator, limits, inject(samples, rate, Fault(kind, channel, severity, SETTLE, LASTS))
        )
        finite = bool(np.isfinite(vy[warm:]).all())
        vy = np.nan_to_num(vy, nan=1e9)
        row = (
            ground.data,
            ground.kind,
            name,
            f"{rate:g}",
            kind,
            channel,
            severity,
            finite,
            exceptions,
            bounded,
            starts,
        )
        figures = (f"{figure:.4g}" for figure in (usual, error(vy, during), error(vy, after)))
        rows.append((*row, *figures, error(vy, after) <= TIMES_USUAL * usual))
    return rows


def main():
    """Write the table; the last line counts what did not hold."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", help="one estimator; all other rows stay as they are in --out")
    parser.add_argument("--data", help="one data set; all other rows stay")
    options = parser.parse_args()
    cases = [
        (ground, name)
        for ground in grounds()
        if options.data in (None, ground.data)
        for name in ground.families
    ]
    cases = [case for case in cases if options.only in (None, case[1])]
    cases.sort(key=lambda case: SLOW.index(case[1]) if case[1] in SLOW else -1)
    started = time.monotonic()
    former = pd.DataFrame(columns=HEADER)
    if (options.only or options.data) and options.out.is_file():
        former = pd.read_csv(options.out, dtype=str, keep_default_na=False)
        remade = former["estimator"].isin([options.only] if options.only else former["estimator"])
        remade &= former["data"].isin([options.data] if options.data else former["data"])
        former = former[~remade]
    tables = {}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        for (ground, name), rows in zip(
            cases, pool.map(try_family, *zip(*cases, strict=True)), strict=True
        ):
            tables[ground.data, name] = rows
            table = pd.DataFrame([row for rows in tables.values() for row in rows], columns=HEADER)
            pd.concat([former, table]).sort_values(["data", "estimator"], kind="stable").to_csv(
                options.out, index=False
            )  # so that what is done stands there if the rest is not awaited
            print(
                f"{ground.data:16s} {name:14s} {len(rows):4d} cases, "
                f"{time.monotonic() - started:.0f} s",
                flush=True,
            )
    estimators = sorted(set(former["estimator"]))
    record_tables(
        [options.out],
        "make online_faults",
        [
            "script tests/faults/online_faults.py",
            *(f"data {data}" for data in sorted({*table["data"], *former["data"]})),
        ],
        rows=RowKeys(
            {name: f"train {name}" for name in sorted({*table["estimator"]} - {*estimators})},
            {name: f"train {name}" for name in estimators},
        ),
    )
    criteria = {
        "finite": table["finite"],
        "without an exception": table["exceptions"] == 0,
        "within the speed": table["within_speed"],
    }
    criteria["back within twice the usual error"] = table["recovered"]
    print(
        f"{len(table)} cases: "
        + ", ".join(
            f"{(~is_met.astype(bool)).sum()} not {criterion}"
            for criterion, is_met in criteria.items()
        )
    )


if __name__ == "__main__":
    main()
