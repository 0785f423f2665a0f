"""Every family online, under every fault of every channel it reads, sample by sample: `make online_faults`.

A row a case in results/reliability/online_faults.csv. Each drive is 16 s of a range that the estimator has not learnt from: 4 s to settle,
4 s of fault, 8 s to come back. It is stepped through `vehest.trust.contract.GuardedStepper` once as it is and once a case, from the
estimator's first sample on. What is asked of a case:

- `finite`: no value that is not finite once the window is full (with the fault's first sample within it or not);
- `exceptions`: what reached the caller;
- `recovered`: the error of the sideslip angle, from 3 s after the fault's end (or the family's window, if that is longer) to the end, is at
  most twice its usual size: that of the whole drive without the fault, or of the same seconds without it, whichever is larger;
- `within_speed`: the lateral velocity never exceeded what the last believed speed allows.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import subprocess
import sys
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch

import vehest
from vehest.data.files import written_aside
from vehest.data.store import read_recording
from vehest.run.downsample import transforms_of
from vehest.trust.faults import KINDS, SEVERITIES, Fault, applies, inject
from vehest.trust.guard import learn_limits
from vehest.trust.watch import STARTED

SETTLE, LASTS, COMES_BACK, RECOVERS = 4.0, 4.0, 8.0, 3.0  # s
TIMES_USUAL = 2.0

HEADER = ["data", "kind", "estimator", "rate_hz", "fault", "channel", "severity", "finite", "exceptions", "within_speed", "starts"]
HEADER += ["usual_error_deg", "error_while_faulted_deg", "error_after_deg", "recovered"]

CAR = "estimator.car={mass: 982, yaw_inertia: 1605.4145, cg_to_front_axle: 1.33, cg_to_rear_axle: 1.07, cg_height: 0.45}"
SHORT = ("training.method=data", "training.restarts=1", "training.generations=40")
FERRARI = {
    "zero": (),
    "static_map": (),
    "kinematic": (),
    "data_sheet": ("estimator.wheelbase=2.4", "estimator.cg_to_rear_axle=1.07"),
    "luenberger": (),
    "kalman": (),
    "factor_graph": ("estimator.window=0.5",),
    "rational_ekf": ("estimator.tyres=rational_adaptive",),
    "ksnn": ("estimator.n_local=2", "estimator.n_hidden=2", "training.max_epochs=30"),
    "gru": ("estimator.n_states=5", "training.max_epochs=30"),
    "lstm": ("estimator.n_states=5", "training.max_epochs=30"),
    "velocity_gru": ("estimator.inputs=[vx,yaw_rate,ay,ax]", "estimator.outputs=[vx,vy]", "training.phase.max_epochs=20"),
    "velocity_lstm": ("estimator.inputs=[vx,yaw_rate,ay,ax]", "estimator.outputs=[vx,vy]", "training.phase.max_epochs=20"),
    "dugoff_ukf": ("estimator.inputs=imu", CAR, "training.tyres_from='*'", *SHORT),
    "sideslip_ffnn": ("estimator.inputs=imu", "training.phase.max_epochs=20"),
    "cnn_ukf": (
        "estimator.inputs=imu",
        CAR,
        "training.identification.tyres_from='*'",
        *(f"training.identification.{word.removeprefix('training.')}" for word in SHORT),
        "training.pre_training.max_epochs=10",
        "training.end_to_end.max_epochs=1",
    ),
    "ensemble_ukf": (
        "estimator.inputs=imu",
        CAR,
        "training.identification.tyres_from='*'",
        *(f"training.identification.{word.removeprefix('training.')}" for word in SHORT),
        "training.scaling_trials=5",
        "estimator.members=3",
        "training.phase.max_epochs=10",
    ),
}
SMALL_CAR = {"learned_ukf": ("estimator.dynamics=pacejka", "training.one_step.max_epochs=60", "training.noise.max_epochs=3")}


@dataclass(frozen=True)
class Ground:
    """Where a family is tried: a data set, ranges to learn from and to be tried on, in seconds after the first sample."""

    name: str
    dataset: str
    kind: str
    train: tuple[str, float, float]
    validation: tuple[str, float, float]
    trial: tuple[str, float]
    families: dict[str, tuple[str, ...]]
    overrides: tuple[str, ...] = ()


def grounds(data_root):
    """A simulated drive always, the real ones where the recordings are."""
    bmw = {**FERRARI, "data_sheet": ("estimator.wheelbase=2.579", "estimator.cg_to_rear_axle=1.423")}
    own = "estimator.car={mass: 1093, yaw_inertia: 1791, cg_to_front_axle: 1.156, cg_to_rear_axle: 1.423, cg_height: 0.42}"
    bmw = {name: tuple(own if word == CAR else word for word in words) for name, words in bmw.items()}
    found = [Ground("sim_quickstart", "sim_quickstart", "simulated", ("drive_1", 0, 150), ("drive_2", 0, 90), ("drive_3", 40.0), bmw)]
    if data_root:
        ferrari = "20140222_01_01_03_250lm"
        found.append(Ground("ferrari_250lm", "ferrari_250lm", "real", (ferrari, 0, 300), (ferrari, 300, 400), (ferrari, 450.0), FERRARI))
        hoons = "iros_hoons_1_with_friction_run_"
        found.append(
            Ground("f1tenth", "f1tenth", "real", (f"{hoons}1", 0, 60), (f"{hoons}0", 0, 40), ("hoons_all_test_run_4", 10.0), SMALL_CAR)
        )
    return found


def recordings(ground, output):
    """Id -> recording at its native rate, of those that the ground needs."""
    asked = [sys.executable, "-m", "vehest", "ingest", ground.dataset, f"output={output}", "--json", "--quiet"]
    folder = Path(json.loads(subprocess.run(asked, check=True, capture_output=True, text=True).stdout)["folder"])
    wanted = {ground.train[0], ground.validation[0], ground.trial[0]}
    return {path.stem: read_recording(path) for path in sorted(folder.glob("*.parquet")) if path.stem in wanted}


def stretch(recording, start, stop):
    """From so many seconds after a recording's first sample to so many."""
    return recording.cut(recording.start_time + start, recording.start_time + stop)


def at_rate(recording, estimator):
    """A recording as the estimator takes it."""
    for transform in transforms_of({"rate_hz": estimator.settings.rate_hz, **estimator.preparation}):
        recording = transform(recording)
    return recording


def sideslip(vy, vx):
    return np.degrees(np.arctan2(vy, vx))


def walk(estimator, limits, samples):
    """v after each sample, held for the time that it is made for, with exceptions, starts, and whether the speed bounds it."""
    stepper = vehest.online(estimator)
    names, steps = list(samples), len(next(iter(samples.values())))
    said, exceptions, starts = np.full(steps, np.nan), 0, 0
    rows = np.stack([samples[name] for name in names], 1).tolist()
    fastest, bounded = 1.0, True
    at = names.index("vx") if "vx" in names else -1
    for k, row in enumerate(rows):
        try:
            said[k] = stepper.step(dict(zip(names, row, strict=True)))["vy"]
        except Exception:  # whatever reaches the caller is what is counted
            exceptions += 1
        starts += bool(stepper.marks & STARTED)
        if at >= 0 and math.isfinite(row[at]) and abs(row[at]) < 140.0:
            fastest = max(fastest, abs(row[at]))
        if math.isfinite(said[k]) and abs(said[k]) > limits.largest_tan_sideslip * min(fastest, limits.top_speed) * (1 + 1e-9):
            bounded = False
    shift = estimator.horizon_steps
    return np.concatenate([np.full(shift, np.nan), said])[:steps], exceptions, starts, bounded


def try_family(ground, name, output):
    """Fit a family and walk it through every case; a row each."""
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore")
    by_id = recordings(ground, output)
    train, validation = (stretch(by_id[part[0]], part[1], part[2]) for part in (ground.train, ground.validation))
    estimator = vehest.train(name, [train], [validation], [*ground.overrides, *ground.families[name]])
    rate = estimator.settings.rate_hz
    limits = learn_limits([at_rate(train, estimator)], estimator.channels, rate)
    drive = stretch(at_rate(by_id[ground.trial[0]], estimator), ground.trial[1], ground.trial[1] + SETTLE + LASTS + COMES_BACK)
    samples = {channel: drive[channel].copy() for channel in estimator.channels}
    speed = drive["vx_ref"] if "vx_ref" in drive else drive["vx"]
    reference = sideslip(drive["vy_ref"], speed)
    seconds = np.arange(len(drive)) / rate
    warm = estimator.warm_up_steps + estimator.horizon_steps
    back = SETTLE + LASTS + max(RECOVERS, estimator.warm_up_steps / rate)

    def error(vy, chosen):
        return float(np.sqrt(np.mean(np.square(sideslip(vy[chosen], speed[chosen]) - reference[chosen]))))

    nominal = walk(estimator, limits, samples)[0]
    settled = np.arange(len(drive)) >= max(warm, round(2.0 * rate))
    after, during = seconds >= back, (seconds >= SETTLE) & (seconds < SETTLE + LASTS)
    usual = max(error(nominal, settled), error(nominal, after))
    rows = []
    for channel in estimator.channels:
        if np.isnan(samples[channel]).all():
            continue
        for kind in KINDS:
            if not applies(kind, channel):
                continue
            for severity in SEVERITIES:
                fault = Fault(kind, channel, severity, SETTLE, LASTS)
                vy, exceptions, starts, bounded = walk(estimator, limits, inject(samples, rate, fault))
                finite = bool(np.isfinite(vy[warm:]).all())
                later = error(np.nan_to_num(vy, nan=1e9), after)
                row = (ground.name, ground.kind, name, f"{rate:g}", kind, channel, severity, finite, exceptions, bounded, starts)
                figures = (usual, error(np.nan_to_num(vy, nan=1e9), during), later)
                rows.append((*row, *(f"{figure:.4g}" for figure in figures), later <= TIMES_USUAL * usual))
    return rows


def cases(data_root):
    """What is tried, the slow families last."""
    slow = ("learned_ukf", "kalman", "dugoff_ukf", "factor_graph", "cnn_ukf", "ensemble_ukf")
    found = [(ground, name) for ground in grounds(data_root) for name in ground.families]
    return iter(sorted(found, key=lambda case: slow.index(case[1]) if case[1] in slow else -1))


def write_table(path, rows):
    """Write all rows at once, or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_aside(path) as aside, open(aside, "w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(HEADER)
        writer.writerows(rows)


def main(words=None):
    """Write the table; the last lines count what did not hold."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--output", type=Path, default=Path(os.environ.get("VEHEST_OUTPUT", "outputs")), help="output root of recordings")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", help="one estimator")
    parser.add_argument("--data", help="one data set")
    asked = parser.parse_args(words)
    chosen = (case for case in cases(os.environ.get("VEHEST_DATA")) if asked.only in (None, case[1]))
    wanted = [case for case in chosen if asked.data in (None, case[0].name)]
    for ground in {case[0].name: case[0] for case in wanted}.values():
        recordings(ground, asked.output)
    started, tables = time.monotonic(), {}
    with ProcessPoolExecutor(asked.jobs, mp_context=get_context("spawn")) as pool:
        futures = {(ground.name, name): pool.submit(try_family, ground, name, asked.output) for ground, name in wanted}
        for key, future in futures.items():
            tables[key] = future.result()
            bad = sum(not (row[7] and not row[8] and row[9] and row[14]) for row in tables[key])
            print(f"{key[0]:16s} {key[1]:14s} {len(tables[key]):4d} cases, {bad} not held, {time.monotonic() - started:.0f} s", flush=True)
            rows = [row for done in sorted(tables) for row in tables[done]]
            write_table(asked.out, rows)  # so that what is done stands there if the rest is not awaited
    counts = {
        "with a value that is not finite": sum(not row[7] for row in rows),
        "with an exception": sum(row[8] > 0 for row in rows),
        "beyond the speed": sum(not row[9] for row in rows),
        "not back within twice the usual error": sum(not row[14] for row in rows),
    }
    print(f"{len(rows)} cases: " + ", ".join(f"{count} {what}" for what, count in counts.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
