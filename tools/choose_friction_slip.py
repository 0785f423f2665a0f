"""Bands of the learned UKF on simulated tyres it was not trained on, by the constant that widens them.

    python tools/choose_friction_slip.py MODEL...

MODEL are folders of learned UKFs that were trained and calibrated on the split ``sim_tyre_sets``. Each estimates drives whose tyres are
drawn anew: of another friction and stiffness, and of another friction alone. For several values of `vehest.trust.tyre_check.FRICTION_SLIP`
the coverage and the interval score of the 90 % band of v are written to results/tyre_check/friction_slip.csv, and the smallest value that
covers 80 % of the samples on tyres of another friction and stiffness is printed. The drives of the split's tests have rows of their own and
choose nothing. SIMULATED data.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
import pandas as pd

from vehest.configuration.composition import compose_config
from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.evaluation.bands import interval_score
from vehest.inference.estimation import prepared_recording
from vehest.inference.models import open_model
from vehest.run.table_records import record_tables
from vehest.sources.base import open_source
from vehest.trust.bands import CHANNEL_LEVEL, band_inputs, tyre_error_of
from vehest.trust.tyre_check import FRICTION_SLIP

VERSION = "1"
"""Raised when the numbers of its table move."""
RESULT = Path(__file__).parents[1] / "results" / "tyre_check" / "friction_slip.csv"
FRICTION_SLIPS = (0.0, 0.02, 0.03, 0.04, 0.05, 0.06, 0.08, 0.1)  # rad
TARGET_COVERAGE = 0.8
SKIPPED_SECONDS = 2.0  # of a drive, while the filter settles
MIN_SPEED = 0.5  # m/s, as in the split
FRICTION = "{parameters: [friction], factor: [0.5, 1.2]}"
STIFFNESS = "{parameters: [stiffness_factor_front, stiffness_factor_rear], factor: [0.6, 1.5]}"
TYRES = {  # kind of tyres -> what each drive's car draws
    "friction and stiffness": f"[{FRICTION}, {STIFFNESS}]",
    "friction": f"[{FRICTION}]",
}
N_DRIVES = 14  # of each kind of tyres
SEED = 1000  # of the drives; those of the tests follow from 0
TESTS = {"test, tyre A": "test_a_*", "test, tyre D": "test_d_*"}  # name -> recordings


def drives_on(tyres: str) -> list[Recording]:
    """Drives of the small car on tyres of a kind, each drawn anew, or those of a test."""
    if tyres in TESTS:
        source = open_source(compose_config("ingest", ["dataset=sim_tyre_sets"])["dataset"])
        return [source.read(name) for name in source.ids() if fnmatchcase(name, TESTS[tyres])]
    drives = (
        f"[{{id: develop, count: {N_DRIVES}, vehicle: tyre_a, "
        "manoeuvre: {name: freestyle, duration: [25, 30], speed: [1.2, 3.4], current: [8, 34]}}]"
    )
    overrides = [
        "dataset=sim_tyre_sets",
        f"dataset.seed={SEED}",
        f"dataset.drives={drives}",
        f"+dataset.vary={TYRES[tyres]}",
    ]
    source = open_source(compose_config("ingest", overrides)["dataset"])
    return [source.read(name) for name in source.ids()]


def errors_and_bands(
    folder: str, drives: Sequence[Recording]
) -> Iterator[tuple[FloatArray, dict[float, FloatArray]]]:
    """Of each drive the errors of v, (T,) [m/s], and the half widths of its 90 % band by constant, (T,) [m/s]."""
    _, model, trust = open_model(folder, Path.cwd(), print)
    if trust is None or trust.bands is None or trust.bands.tyre_check is None:
        raise DataError(f"'{folder}' has no bands that the friction widens")
    for drive in drives:
        prepared = prepared_recording(model, drive)
        estimate = model.estimate([prepared])[0]
        reference = np.interp(estimate.time, drive.time, drive["vy_ref"])
        speed = np.interp(estimate.time, drive.time, drive["vx_ref"])
        is_scored = (estimate.time - drive.time[0] > SKIPPED_SECONDS) & (speed > MIN_SPEED)
        rows, vy, variance = band_inputs(
            estimate, prepared, trust.bands.channels, trust.bands.horizon_steps
        )
        squared = tyre_error_of(trust.bands.tyre_check, estimate)
        half = {
            slip: trust.bands.half_widths(
                rows, vy, variance, (slip / FRICTION_SLIP) ** 2 * squared
            )[is_scored, 0]
            for slip in FRICTION_SLIPS
        }
        yield (vy - reference)[is_scored], half


def table_of(folders: Sequence[str]) -> pd.DataFrame:
    """Coverage and interval score by tyres, constant and model."""
    rows = []
    for tyres in (*TYRES, *TESTS):
        drives = drives_on(tyres)
        for folder in folders:
            results = list(errors_and_bands(folder, drives))
            errors = np.concatenate([part for part, _ in results])
            for slip in FRICTION_SLIPS:
                half = np.concatenate([bands[slip] for _, bands in results])
                rows.append(
                    {
                        "tyres": tyres,
                        "friction_slip_rad": slip,
                        "model": Path(folder).name.rsplit("-", 1)[0],
                        "n_drives": len(drives),
                        "coverage_90": round(float((np.abs(errors) <= half).mean()), 3),
                        "interval_score": round(
                            float(interval_score(errors, half, CHANNEL_LEVEL).mean()), 3
                        ),
                    }
                )
    return pd.DataFrame(rows)


def main() -> None:
    """Write the table and print its means over the models."""
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    table = table_of(sys.argv[1:])
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    table.to_csv(RESULT, index=False)
    record_tables(
        [RESULT],
        "make friction_slip",
        (
            "script tools/choose_friction_slip.py",
            "data sim_tyre_sets",
            "train learned_ukf",
            "calibrate learned_ukf",
        ),
    )
    means = table.groupby(["tyres", "friction_slip_rad"], sort=False)[
        ["coverage_90", "interval_score"]
    ].mean()
    print(means.round(3).to_string())
    both = table[table["tyres"] == next(iter(TYRES))]
    covered = {
        slip: both.loc[both["friction_slip_rad"] == slip, "coverage_90"].mean()
        for slip in FRICTION_SLIPS
    }
    enough = [slip for slip, coverage in covered.items() if coverage >= TARGET_COVERAGE]
    smallest = f"{enough[0]:g} rad" if enough else "no constant"
    print(
        f"{smallest}: the smallest with {TARGET_COVERAGE:.0%} of the samples inside on tyres of another friction and stiffness"
    )


if __name__ == "__main__":
    main()
