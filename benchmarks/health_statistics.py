"""Alarms of health in driving without a fault against faults found, as its limits rise, and what each of its statistics earns.

    PYTHONPATH=src VEHEST_DATA=FOLDER python benchmarks/health_statistics.py [--rule NAME | --opened OUTPUT]     # 15 minutes on one core

Real: the Ferrari's laps 1 to 3, each tried after learning on the other two; its drives without a reference likewise, but the one that
holds the same laps; two drives of an Audi TTS; quarters of two drives of the AV-21. Simulated: eight cars of `sim_fleet_real` for half
an hour each, health learnt on the first five minutes. Every kind of fault in every channel at three severities, once a drive, at a third
of it or of its first 150 s, for 10 s; each counts three times, as one to be found within 1, 3 and 10 s. What is learnt stays; limits and
statistics are changed afterwards. Rows of a rule replace those of the same name in results/benchmarks/health_trade.csv, of which the
figure is drawn. ``--opened``: tests that chose nothing, by the splits of results/trust, printed only.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import scipy.io
from numpy.typing import NDArray
from scipy.stats import chi2

from vehest.configuration.composition import compose_config
from vehest.constants import FloatArray
from vehest.data.laps import laps_of
from vehest.data.recording import Recording
from vehest.data.splits import Span
from vehest.data.store import read_recording
from vehest.data.transforms import Resample
from vehest.run.console import Messages
from vehest.run.runner import Runner
from vehest.run.signals import StopSignals
from vehest.run.train import stored_recording
from vehest.sources.base import Source, open_source
from vehest.trust import health_kernel as kernel
from vehest.trust.faults import KINDS, SEVERITIES, Fault, applies, inject, window
from vehest.trust.guard import Guard, GuardLimits, learn_limits
from vehest.trust.health import HealthModel, learn_health

RESULT = Path(__file__).parents[1] / "results" / "benchmarks" / "health_trade.csv"
RATE = 20.0
WHEELS = tuple(f"wheel_speed_{place}" for place in ("fl", "fr", "rl", "rr"))
PLAIN = ("yaw_rate", "vx", "ay", "ax", "steer", "handwheel", "motor_speed", "motor_current")
WATCHED = (*PLAIN, *WHEELS)
LASTS = 10.0
LEARNT = 300.0
TRIED = 150.0  # s: of a fault; of a simulated drive; of a drive that faults are tried in
LEAST = 25.0
MOST = 6  # s of drives that faults are tried on, and how many of them after the same learning
HORIZONS = (1.0, 3.0, 10.0)  # s after its onset, within which a fault has to be found
GUARDED = ("nan", "inf", "huge")  # faults that the guard finds, whatever health does
FERRARI = "20140222_01_01_03_250lm"
FACTORS = (0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.5, 1.75)

Drives = Iterator[
    tuple[list[Recording], list[Recording], list[Recording]]
]  # training, validation, and what is tried


class Trial(NamedTuple):
    """What a drive shows: the largest value of each group of statistics over its limit."""

    groups: list[str]
    nominal: FloatArray  # without a fault, (T, G)
    faulty: list[
        tuple[int, FloatArray]
    ]  # first row, and the rows from there on while a fault lasts, (K, G)
    rate_hz: float


def source(name: str, *overrides: str) -> Source:
    """A data set."""
    return open_source(compose_config("ingest", [f"dataset={name}", *overrides])["dataset"])


def others(drives: Sequence[Recording]) -> Drives:
    """Each drive, and those that it is tried after."""
    for drive in drives:
        learnt = [own for own in drives if own is not drive]
        yield learnt[:-1], learnt[-1:], [drive]


def parts(drive: Recording, count: int) -> list[Recording]:
    """Equal parts."""
    ends = np.linspace(drive.start_time, drive.end_time, count + 1)
    return [drive.cut(*own) for own in pairwise(ends)]


def ferrari() -> Drives:
    """Laps 1 to 3."""
    recording = source("ferrari_250lm").read(FERRARI)
    yield from others([Resample(RATE)(recording.cut(*lap)) for lap in laps_of(recording)[:3]])


def unlabelled() -> Drives:
    """The Ferrari's drives without a reference."""
    own = source("ferrari_250lm_unlabelled")
    yield from others([own.read(name) for name in own.ids() if name != "telemetry_train_1"])


def tts() -> Drives:
    """Two drivers, each tried after learning on the other."""
    drives = []
    for file in sorted((Path(os.environ["VEHEST_DATA"]) / "stanford_tts").glob("*.mat")):
        held = {
            name: np.ravel(values).astype(float)
            for name, values in scipy.io.loadmat(file).items()
            if not name.startswith("_")
        }
        columns = {
            "yaw_rate": "YawRate_radps",
            "vx": "Speed_mps",
            "ay": "LateralAcceleration_mps2",
            "steer": "deltaRoadwheels_rad",
        }
        channels = {name: held[column] for name, column in columns.items()}
        drives.append(Resample(RATE)(Recording(file.stem, "audi_tts", 200.0, 0.0, channels)))
    for drive, other in (drives, drives[::-1]):
        yield *([half] for half in parts(other, 2)), [drive]


def av21() -> Drives:
    """Quarters of each drive, standstill included."""
    own = source("av21")
    for name in own.ids():
        yield from others(parts(own.read(name), 4))


def fleet() -> Drives:
    """Two cars of the first four kinds and courses."""
    counts = [f"dataset.drives.{k}.count={2 * (k < 4)}" for k in range(6)]
    own = source(
        "sim_fleet_real",
        *counts,
        *(f"dataset.drives.{k}.manoeuvre.duration=1800" for k in range(6)),
    )
    for name in own.ids():
        drive = Resample(RATE)(plain(own.read(name)))
        split = drive.start_time + LEARNT
        yield (
            *([half] for half in parts(drive.cut(drive.start_time, split), 2)),
            [drive.cut(split, drive.end_time)],
        )


def plain(drive: Recording) -> Recording:
    """Without wheels, and what is not watched."""
    return drive.select([name for name in PLAIN if name in drive])


def of_split(output: Path, *words: str) -> Drives:
    """A split of results/trust; test sets of other tyres are left out."""
    config = compose_config("eval", [*words, "estimator=zero", f"output={output}", "tracking=none"])
    runner = Runner(output, Messages(), StopSignals())
    split = runner.split(config)
    data = runner.data_for(split, RATE, config)

    def read(spans: Sequence[Span]) -> list[Recording]:
        return [
            plain(read_recording(stored_recording(data, own)).cut(own.start, own.stop))
            for own in spans
        ]

    tests = [span for name, spans in split.tests.items() if name != "tyre_d" for span in spans]
    yield read(split.train), read(split.validation), read(tests)


SETS: dict[str, Callable[[], Drives]] = {
    "Ferrari, laps 1 to 3": ferrari,
    "Ferrari, other drives": unlabelled,
    "Audi TTS": tts,
    "AV-21": av21,
    "Simulated fleet": fleet,
}


OPENED = {
    "Ferrari, lap 5": ("split=ferrari_laps", "split.fold=4"),
    "F1TENTH, tyre A": ("split=f1tenth_tyres",),
    "Simulated BMW": ("split=sim_bmw",),
}


def groups_of(model: HealthModel) -> list[str]:
    """A name for each statistic: its kind, and its time constant where there are several."""
    kinds = {
        value: name.lower()
        for name, value in vars(kernel).items()
        if name.isupper() and isinstance(value, int)
    }
    names = []
    jumps = ("jump", "step")
    for position, one in enumerate(model.statistics):
        name = (
            jumps[position // len(model.channels)] if one.kind == kernel.JUMP else kinds[one.kind]
        )
        names.append(f"{name} {one.seconds:g} s" if one.seconds else name)
    return names


def ratios_of(model: HealthModel, limits: GuardLimits, rows: FloatArray) -> FloatArray:
    """The largest statistic of each group over its limit, (T, G)."""
    received = np.ascontiguousarray(rows)
    labels = np.array(groups_of(model))
    statistics = np.empty((len(rows), len(labels)))
    measured = Guard(model.channels, (), limits, model.rate_hz)(received).measured
    kernel.health_kernel(
        received, measured, model.packed(), model.start(), np.empty((3, len(rows))), statistics
    )
    over = statistics / np.array(model.limits)
    return np.stack(
        [over[:, labels == group].max(axis=1) for group in dict.fromkeys(labels)], axis=1
    )


def faults_of(
    test: Recording, channels: Sequence[str], ratios: Callable[[FloatArray], FloatArray]
) -> list[tuple[int, FloatArray]]:
    """First row of each fault, and what it shows from there on while it lasts."""
    part = test.cut(test.start_time, test.start_time + TRIED)
    found = []
    clean = {name: part[name] for name in channels}
    for kind in (kind for kind in KINDS if kind not in GUARDED):
        for channel in (
            channel for channel in channels if applies(kind, channel) and channel not in WHEELS[1:]
        ):
            for severity in SEVERITIES:
                fault = Fault(kind, channel, severity, round(part.duration / 3.0, 2), LASTS)
                first, end = window(fault, len(part), test.rate_hz)
                rows = np.stack(
                    [inject(clean, test.rate_hz, fault)[name] for name in channels], axis=1
                )[:end]
                found.append((first, ratios(rows)[first:]))
    return found


def tried(drives: Drives) -> list[Trial]:
    """Statistics of each drive with and without faults."""
    found = []
    for train, validation, tests in drives:
        everything = [*train, *validation, *tests]
        rate = tests[0].rate_hz
        channels = tuple(name for name in WATCHED if all(name in own for own in everything))
        model = learn_health(train, validation, channels, rate)
        limits = learn_limits([*train, *validation], channels, rate)
        ratios = partial(ratios_of, model, limits)
        long = [test for test in tests if test.duration >= LEAST]
        for test in tests:
            faulty = (
                faults_of(test, channels, ratios) if any(test is own for own in long[:MOST]) else []
            )
            found.append(
                Trial(
                    list(dict.fromkeys(groups_of(model))),
                    ratios(test.stack(channels)),
                    faulty,
                    rate,
                )
            )
    return found


def flags_of(
    ratios: FloatArray, groups: Sequence[str], left_out: Sequence[str], factor: float
) -> NDArray[np.bool_]:
    """Rows beyond limits that are so many times as high; those of values and of their range stay as they are."""
    of_values = np.array([name.startswith(("frozen", "held", "outside")) for name in groups])
    kept = np.array([name not in left_out for name in groups])
    return np.asarray((ratios >= np.where(of_values, 1.0, factor))[:, kept].any(axis=1))


def outcome(
    trials: Sequence[Trial], left_out: Sequence[str] = (), factor: float = 1.0
) -> dict[str, Any]:
    """Faults found and alarms, which have a second without any between two, with the exact 95 % Poisson interval an hour."""
    found = 0
    tried_faults = 0
    counts = [0, 0]
    hours = 0.0
    for trial in trials:
        hours += len(trial.nominal) / trial.rate_hz / 3600.0
        for position, more in enumerate(([], ["outside"])):
            flags = flags_of(trial.nominal, trial.groups, [*left_out, *more], factor)
            times = np.flatnonzero(flags)
            counts[position] += int((np.diff(times, prepend=-1e9) > trial.rate_hz).sum())
        nominal = flags_of(trial.nominal, trial.groups, left_out, factor)
        for first, ratios in trial.faulty:
            flags = (
                flags_of(ratios, trial.groups, left_out, factor)
                & ~nominal[first : first + len(ratios)]
            )
            found += sum(
                bool(flags[: round(horizon * trial.rate_hz)].any()) for horizon in HORIZONS
            )
            tried_faults += len(HORIZONS)
    low = chi2.ppf(0.025, 2 * counts[0]) / 2.0 if counts[0] else 0.0
    high = chi2.ppf(0.975, 2 * counts[0] + 2) / 2.0
    rate = {
        "hours": hours,
        "alarms": counts[0],
        "per_hour": counts[0] / hours,
        "low": low / hours,
        "high": high / hours,
    }
    return {
        "faults": tried_faults,
        "found": found,
        "share": found / tried_faults,
        **rate,
        "of_a_sensor": counts[1],
    }


def figure(table: pd.DataFrame) -> None:
    """Share of faults found over alarms an hour, a line a rule, a panel a set; bars are 95 % intervals at the limits that hold."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    names = list(dict.fromkeys(table["drives"]))
    drawn, axes = pyplot.subplots(
        1,
        len(names),
        figsize=(3.0 * len(names), 3.2),
        sharex=True,
        sharey=True,
        layout="constrained",
    )
    for axis, name in zip(axes, names, strict=True):
        for rule, own in table[table["drives"] == name].groupby("rule", sort=False):
            line = axis.plot(own["per_hour"], 100.0 * own["share"], ".-", label=rule)[0]
            at = own[own["limits_times"] == 1.0].iloc[0]
            spread = [[at["per_hour"] - at["low"]], [at["high"] - at["per_hour"]]]
            axis.errorbar(
                at["per_hour"],
                100.0 * at["share"],
                xerr=spread,
                fmt="o",
                color=line.get_color(),
                capsize=3,
            )
        axis.axvline(10.0, color="0.7", linewidth=1, zorder=0)
        axis.set(
            title=name if "imulated" in name else f"{name} (real)",
            xlabel="alarms an hour",
            xscale="symlog",
            xlim=(0.0, 1.2 * table["high"].max()),
        )
        axis.set_xticks([0, 1, 10, 100], ["0", "1", "10", "100"])
    axes[0].set_ylabel("faults found [%]")
    axes[0].legend()
    drawn.savefig(RESULT.with_suffix(".png"), metadata={"Software": None})


def main() -> None:
    """Print and write the trade, and print what each group of statistics earns."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rule", default="present", help="name of the rows")
    parser.add_argument(
        "--opened",
        type=Path,
        metavar="OUTPUT",
        help="only the tests that chose nothing, with data in an output root",
    )
    given = parser.parse_args()
    for name, words in OPENED.items() if given.opened else ():
        own = outcome(tried(of_split(given.opened, *words)))
        print(name, {key: float(f"{value:.4g}") for key, value in own.items()}, flush=True)
    if given.opened:
        return
    rows = []
    everything = []
    for name, drives in SETS.items():
        trials = tried(drives())
        everything += trials
        for factor in FACTORS:
            rows.append(
                {
                    "rule": given.rule,
                    "drives": name,
                    "limits_times": factor,
                    **outcome(trials, factor=factor),
                }
            )
        print(
            pd.DataFrame(rows).query("drives == @name").to_string(index=False, float_format="%.4g"),
            flush=True,
        )
        whole = outcome(trials)
        for group in dict.fromkeys(group for trial in trials for group in trial.groups):
            own = outcome(trials, [group])
            print(
                f"  without {group:<16} {own['found'] - whole['found']:+5d} found {own['alarms'] - whole['alarms']:+4d} alarms"
            )
    for factor in FACTORS:
        rows.append(
            {
                "rule": given.rule,
                "drives": "all",
                "limits_times": factor,
                **outcome(everything, factor=factor),
            }
        )
    before = [pd.read_csv(RESULT).query("rule != @given.rule")] if RESULT.exists() else []
    table = pd.concat([*before, pd.DataFrame(rows)], ignore_index=True)
    table.to_csv(RESULT, index=False, float_format="%.6g", lineterminator="\n")
    figure(table[table["drives"] != "all"])


if __name__ == "__main__":
    main()
