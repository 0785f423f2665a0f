"""Exports of every family: fitted for a moment, with limits, health and bands, written, built and
run.
"""

import shutil
import subprocess
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from conftest import planar_drive
from every_estimator import fitted
from single_track_drive import linear_drive
from small_car_drive import small_car_drive
from vehest.export.program import exportable, program_files
from vehest.export.vectors import COLUMNS, drive_for, replayed, table_text
from vehest.trust.bands import Bands, Quantity
from vehest.trust.contract import GuardedStepper
from vehest.trust.faults import KINDS, SEVERITIES, Fault, applies, inject
from vehest.trust.guard import learn_limits
from vehest.trust.health import learn_health
from vehest.trust.record import About, Trust
from vehest.trust.tyre_check import tyre_check_of

FAMILIES = exportable()
STRICT = [
    "-std=c99",
    "-Wall",
    "-Wextra",
    "-Werror",
    "-pedantic",
    "-Wconversion",
    "-ffp-contract=off",
]
WEIGHTS = {"variance": 1.2, "one": 0.01, "vx": 1e-5, "ay": 0.001, "vy": 0.02, "yaw_rate_vx": 0.001}
LARGEST = {"vx": 20.0, "ax": 3.0, "ay": 5.0, "yaw_rate_vx": 5.0, "steer_vx": 1.0, "vy": 0.5}
SECONDS = 120.0  # after which a program is taken to hang


def tool(name):
    """A compiler or an emulator; the test is skipped without it."""
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not installed")
    return path


WELL_CONDITIONED = {"learned_ukf": {"dynamics": "pacejka", "noise": "constant"}}
"""Variants that do not amplify rounding: two seconds of training leave the learnt noise
ill-conditioned, so that a last digit grows.
"""


@cache
def model(name):
    """Fitted estimator of a family, well conditioned for comparisons in single precision."""
    return fitted(name, **WELL_CONDITIONED.get(name, {}))


def drive(estimator, seed, seconds=40.0):
    """A drive with the channels of an estimator, at its rate."""
    rate = estimator.settings.rate_hz
    if "motor_current" in estimator.channels:
        return small_car_drive(seconds, seed)
    if "steer" in estimator.channels:
        recording = linear_drive(
            seconds, rate, seed, {"yaw_rate": 0.005, "ay": 0.2, "steer": 0.0005}
        )[0]
    else:
        recording = planar_drive(seconds, rate, seed=seed, noise=0.02)
    generator = np.random.default_rng(seed)
    return replace(
        recording,
        channels={
            name: values + 1e-3 * generator.standard_normal(len(recording))
            for name, values in recording.channels.items()
        },
    )


@cache
def trust(name):
    """Limits and health learnt on two drives, bands set by hand."""
    estimator = model(name)
    drives = [drive(estimator, seed) for seed in (1, 2)]
    rate = estimator.settings.rate_hz
    band = Quantity(WEIGHTS, 0.02, (0.5, 1.0, 1.8, 2.5), (False,) * 4, 10.0)
    check = tyre_check_of(estimator)
    about = (("car",), ("set",), ("a",), ("b",), "range", 10, 100.0)
    bands = Bands(
        *about,
        estimator.channels,
        estimator.horizon_steps,
        LARGEST,
        band,
        replace(band, floor=0.001),
        tyre_check=check and check.scaled_by((1.8, 1.8)),
    )
    health = learn_health(drives[:1], drives[1:], estimator.channels, rate)
    return Trust(About(name), bands, learn_limits(drives, estimator.channels, rate), health)


def faulted(estimator, rate_hz, seconds=30.0, seed=0):
    """A drive with a fault of any kind in any channel every few seconds, at a rate."""
    plain = drive(estimator, seed + 3, seconds)
    generator = np.random.default_rng(seed)
    times = np.arange(0.0, seconds - 0.1, 1.0 / rate_hz)
    samples = {
        name: np.interp(times, np.arange(len(plain)) / plain.rate_hz, plain[name])
        for name in estimator.channels
    }
    at = 2.0
    number = 0
    while at < seconds - 2.0:
        channel = str(generator.choice(estimator.channels))
        kind = str(generator.choice([kind for kind in KINDS if applies(kind, channel)]))
        fault = Fault(
            kind,
            channel,
            SEVERITIES[generator.integers(3)],
            at,
            generator.uniform(0.2, 1.5),
            number,
        )
        samples = inject(samples, rate_hz, fault)
        at = at + generator.uniform(0.8, 3.0)
        number = number + 1
    return samples


@dataclass(frozen=True)
class Export:
    """A model's sources in a folder, with stepper that says what they should."""

    name: str
    precision: str
    folder: Path
    bus_rate_hz: float | None = None
    trusted: bool = True

    def stepper(self):
        """Python model that the exported program must agree with."""
        return GuardedStepper(
            model(self.name), trust(self.name) if self.trusted else None, self.bus_rate_hz
        )

    def write(self):
        """Write the files of the program into its folder."""
        self.folder.mkdir(parents=True, exist_ok=True)
        for name, text in program_files(self.stepper(), self.precision, self.name).items():
            (self.folder / name).write_text(text)
        return self

    def vectors(self, *, faults=False):
        """Write in.csv and expected.csv: the vectors of every export, or a drive with faults."""
        stepper = self.stepper()
        if faults:
            samples = faulted(stepper.estimator, stepper.input_rate_hz)
            times = np.full(len(next(iter(samples.values()))), np.nan)
        else:
            times, samples = drive_for(stepper)
        (self.folder / "in.csv").write_text(
            table_text(("time", *samples), np.column_stack([times, *samples.values()]))
        )
        (self.folder / "expected.csv").write_text(
            table_text(COLUMNS, replayed(stepper, times, samples))
        )

    @property
    def sources(self):
        """C files of the program."""
        return sorted(path.name for path in self.folder.glob("vehest_*.c"))

    def build(self, compiler, *options, main="main.c", out="main"):
        """Compile the program with a compiler and options."""
        flags = [*STRICT, *(["-Wdouble-promotion"] if self.precision == "float" else [])]
        command(
            [tool(compiler), *flags, *options, main, *self.sources, "-lm", "-o", out], self.folder
        )
        return self.folder / out

    def agreement(self, *, faults=False):
        """Write, build and run; see `compared`."""
        self.write().build("gcc", "-O2")
        self.vectors(faults=faults)
        return self.differences(["./main"])

    def differences(self, program):
        """Run the vectors; see `compared`."""
        command([*program, "in.csv", "out.csv"], self.folder)
        return self.compared()

    def compared(self):
        """The largest difference of vy, sideslip and both bands, and how many rows have another
        health or, in double, reason.
        """
        computed, expected = (
            np.genfromtxt(self.folder / name, delimiter=",", skip_header=1)
            for name in ("out.csv", "expected.csv")
        )
        # an offset and a scale of one lone channel are the same to the last digits
        judged = slice(4, None if self.precision == "double" else 5)
        is_equal = (computed[:, judged] == expected[:, judged]).all(1)
        assert (np.isnan(computed[is_equal]) == np.isnan(expected[is_equal])).all()
        return np.nanmax(np.abs(computed - expected)[is_equal][:, :4], axis=0, initial=0.0), int(
            (~is_equal).sum()
        )


def command(words, folder, seconds=SECONDS):
    """Run a program that has to succeed; what it said."""
    done = subprocess.run(
        words, cwd=folder, capture_output=True, text=True, timeout=seconds, check=False
    )
    assert done.returncode == 0, f"{' '.join(words)}\n{done.stdout}{done.stderr}"
    return done.stdout + done.stderr
