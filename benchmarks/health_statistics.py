"""What each statistic of health earns: faults that it alone finds, and alarms in driving without a fault that it alone raises.

    PYTHONPATH=src VEHEST_DATA=FOLDER python benchmarks/health_statistics.py [--drives 6]

Simulated: cars of `sim_fleet`, 120 s each, health learnt on two thirds and tried on the last. Real: laps 1 to 3 of the Ferrari, each tried
after learning on the other two. Every kind of fault in every channel at three severities, once a drive, at a third of it, for 10 s; each
counts three times, as one to be found within 1, 3 and 10 s. Statistics and limits are those of one pass; leaving a statistic out is taken
off their ratios, so that nothing is learnt anew.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from vehest.constants import FloatArray
from vehest.data.laps import laps_of
from vehest.data.recording import Recording
from vehest.data.transforms import Resample
from vehest.run.config import compose_config
from vehest.sources.base import open_source
from vehest.trust import health_kernel as kernel
from vehest.trust.faults import KINDS, SEVERITIES, Fault, applies, inject, window
from vehest.trust.guard import Guard, learn_limits
from vehest.trust.health import HealthModel, learn_health

RATE = 20.0
WATCHED = ("yaw_rate", "vx", "ay", "ax", "steer")
LASTS = 10.0  # s
HORIZONS = (1.0, 3.0, 10.0)  # s after its onset, within which a fault has to be found
GUARDED = ("nan", "inf", "huge")  # faults that the guard finds, whatever health does
FERRARI = "20140222_01_01_03_250lm"


@dataclass(frozen=True)
class Trial:
    """A fault, and the largest value of each group of statistics over its limit within the horizon, (G,)."""

    title: str
    found: FloatArray


def groups_of(model: HealthModel) -> list[str]:
    """A name for each statistic: its family, and its time constant."""
    titles = {kernel.NOISE: "noise", kernel.SMOOTH: "smooth", kernel.OFFSET: "offset", kernel.SCALE: "scale", kernel.LATE: "late"}
    titles |= {kernel.FROZEN: "frozen", kernel.HELD: "held", kernel.OUTSIDE: "outside", kernel.LOCKED: "slip"}
    names = []
    for position, one in enumerate(model.statistics):
        jump = ("jump", "jump out of calm", "step")[min(position // len(model.channels), 2)]
        title = jump if one.kind == kernel.JUMP else titles.get(one.kind, f"relation of {one.channel}")
        names.append(f"{title} {one.seconds:g} s" if one.seconds else title)
    return names


def ratios_of(model: HealthModel, guard: Guard, rows: FloatArray) -> FloatArray:
    """Statistics over their limits, (T, K)."""
    received = np.ascontiguousarray(rows)
    statistics = np.empty((len(received), len(model.statistics)))
    kernel.health_kernel(received, guard(received).measured, model.packed(), model.start(), np.empty((3, len(received))), statistics)
    return statistics / np.array(model.limits)


def grouped(ratios: FloatArray, names: list[str], groups: list[str]) -> FloatArray:
    """The largest of each group, (T, G)."""
    labels = np.array(names)
    return np.stack([ratios[:, labels == group].max(axis=1, initial=0.0) for group in groups], axis=1)


def ferrari() -> Iterator[tuple[list[Recording], Recording]]:
    """Each of laps 1 to 3, and the two others."""
    recording = open_source(compose_config("ingest", ["dataset=ferrari_250lm"])["dataset"]).read(FERRARI)
    laps = [Resample(RATE)(recording.cut(*lap)) for lap in laps_of(recording)[:3]]
    for lap in laps:
        yield [other for other in laps if other is not lap], lap


def fleet(count: int) -> Iterator[tuple[list[Recording], Recording]]:
    """Laps of ``count`` simulated cars, cut into thirds."""
    source = open_source(compose_config("ingest", ["dataset=sim_fleet"])["dataset"])
    for name in [own for own in source.ids() if own.startswith("lap")][:count]:
        drive = Resample(RATE)(source.read(name))
        length = drive.duration / 3.0
        parts = [drive.cut(drive.start_time + k * length, drive.start_time + (k + 1) * length) for k in range(3)]
        yield parts[:2], parts[2]


def tried(drives: Iterator[tuple[list[Recording], Recording]]) -> tuple[list[str], list[Trial], list[FloatArray]]:
    """Groups, a trial a fault, and ratios (T, G) of drives without one."""
    groups: list[str] = []
    trials, nominal = [], []
    for learnt, test in drives:
        channels = tuple(name for name in WATCHED if all(name in own for own in (*learnt, test)))
        model = learn_health(learnt[:1], learnt[1:], channels, RATE)
        limits, names = learn_limits(learnt, channels, RATE), groups_of(model)
        groups = groups or list(dict.fromkeys(names))
        clean = {name: test[name] for name in channels}
        healthy = grouped(ratios_of(model, Guard(channels, (), limits, RATE), test.stack(channels)), names, groups)
        nominal.append(healthy)
        for kind in (kind for kind in KINDS if kind not in GUARDED):
            for channel in (channel for channel in channels if applies(kind, channel)):
                for severity in SEVERITIES:
                    fault = Fault(kind, channel, severity, round(test.duration / 3.0, 2), LASTS)
                    faulty, first = inject(clean, RATE, fault), window(fault, len(test), RATE)[0]
                    rows = np.stack([faulty[name] for name in channels], axis=1)
                    own = grouped(ratios_of(model, Guard(channels, (), limits, RATE), rows), names, groups)
                    for horizon in HORIZONS:
                        within = slice(first, min(first + round(horizon * RATE), len(test)))
                        largest = np.where(healthy[within] < 1.0, own[within], 0.0).max(axis=0)
                        trials.append(Trial(f"{fault.kind}:{channel}:{severity} within {horizon:g} s", largest))
    return groups, trials, nominal


def alarms(nominal: list[FloatArray], kept: FloatArray, factor: float = 1.0) -> int:
    """Alarms of drives without a fault: a second without any between two."""
    count = 0
    for ratios in nominal:
        flags = (ratios[:, kept] >= factor).any(axis=1)
        times = np.flatnonzero(flags)
        count += int(len(times) > 0) + int((np.diff(times) > RATE).sum()) if len(times) else 0
    return count


def interval(count: int, hours: float) -> str:
    """An hourly rate with its exact 95 % Poisson interval."""
    low = chi2.ppf(0.025, 2 * count) / 2.0 if count else 0.0
    return f"{count / hours:.1f} ({low / hours:.1f} to {chi2.ppf(0.975, 2 * count + 2) / 2.0 / hours:.1f})"


def table(title: str, groups: list[str], trials: list[Trial], nominal: list[FloatArray]) -> None:
    """Print what each group earns, and the trade of detection against alarms as limits are raised."""
    found, hours = np.stack([trial.found for trial in trials]), sum(len(own) for own in nominal) / RATE / 3600.0
    everything = np.ones(len(groups), bool)
    all_found, all_alarms = int((found >= 1.0).any(axis=1).sum()), alarms(nominal, everything)
    print(f"\n{title}: {len(trials)} faults, {all_found} found")
    print(f"{hours:.2f} h without a fault: {all_alarms} alarms, {interval(all_alarms, hours)} an hour")
    print(f"{'statistic':<20}{'finds':>8}{'alone':>8}{'alarms':>8}{'alone':>8}")
    for position, group in enumerate(groups):
        others = everything.copy()
        others[position] = False
        lost = all_found - int((found[:, others] >= 1.0).any(axis=1).sum())
        own = np.zeros(len(groups), bool)
        own[position] = True
        finds, without = int((found[:, position] >= 1.0).sum()), all_alarms - alarms(nominal, others)
        print(f"{group:<20}{finds:>8}{lost:>8}{alarms(nominal, own):>8}{without:>8}")
    print("limits times   found   alarms an hour (95 % Poisson)")
    for factor in (1.0, 1.1, 1.2, 1.3, 1.5, 1.75, 2.0):
        count = alarms(nominal, everything, factor)
        print(f"{factor:<14g}{(found >= factor).any(axis=1).mean():>7.1%}   {interval(count, hours)}")


def greedy(groups: list[str], sets: list[tuple[list[Trial], list[FloatArray]]], most: float = 0.005) -> None:
    """Print which groups can go, one after another, the cheapest first, until more than a share of what is found would be lost."""
    found = np.concatenate([np.stack([trial.found for trial in trials]) for trials, _ in sets]) >= 1.0
    kept, everything = np.ones(len(groups), bool), int(found.any(axis=1).sum())
    while True:
        left = []
        for position in np.flatnonzero(kept):
            others = kept.copy()
            others[position] = False
            left.append((int(found[:, others].any(axis=1).sum()), position))
        most_left, position = max(left)
        if everything - most_left > most * everything:
            break
        kept[position] = False
        count = sum(alarms(nominal, kept) for _, nominal in sets)
        print(f"without {groups[position]:<20} {most_left} of {everything} found, {count} alarms")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--drives", type=int, default=6)
    given = parser.parse_args()
    real, simulated = tried(ferrari()), tried(fleet(given.drives))
    table("Real Ferrari, laps 1 to 3", *real)
    table(f"Simulated fleet, {given.drives} cars", *simulated)
    greedy(real[0], [real[1:], simulated[1:]])


if __name__ == "__main__":
    main()
