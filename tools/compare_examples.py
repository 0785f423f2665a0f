"""Train and compare the worked examples of docs/adding_an_estimator.md on the quickstart's drives, beside the baselines.

The examples are installed into a scratch folder as a package of their own, found by their entry points. Writes
results/examples/leaderboard.csv. SIMULATED data; three seeds of the Transformer, the others have nothing random.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pandas as pd
import yaml

from vehest.run.table_records import record_tables

VERSION = "2"
"""Raised when the numbers of its tables move."""
EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"
RESULT = Path(__file__).parents[1] / "results" / "examples" / "leaderboard.csv"
CLASSES = {
    "saturating_ekf": "SaturatingEkf",
    "sliding_mode": "SlidingMode",
    "window_transformer": "WindowTransformer",
}
CAR = {  # of conf/dataset/sim_quickstart.yaml; stiffness of an axle: |p_ky1| times its load at rest
    "mass": 982.0,
    "yaw_inertia": 1605.4,
    "cg_to_front_axle": 1.33,
    "cg_to_rear_axle": 1.07,
    "cornering_stiffness_front": 70000.0,
    "cornering_stiffness_rear": 104100.0,
}
PIPELINE = {
    "study": "examples",
    "title": "Three estimators of another package on simulated drives",
    "about": "The worked examples of the documentation beside the baselines. They show how an estimator is added, not which to trust.",
    "report": "drive",
    "split": "quickstart",
    "sweeps": [
        ["estimator=zero,static_map,kinematic"],
        ["estimator=data_sheet", "estimator.wheelbase=2.4", "estimator.cg_to_rear_axle=1.07"],
        ["estimator=sliding_mode"],
        ["estimator=window_transformer", "seed=range(3)"],
        [
            "estimator=saturating_ekf",
            *(f"+estimator.car.{name}={value}" for name, value in CAR.items()),
        ],
    ],
    "evaluation": {"rate_hz": 20},
}
SHOWN = [
    "title",
    "rmse_sideslip",
    "rmse_sideslip_low",
    "rmse_sideslip_high",
    "beats_zero",
    "beats_static_map",
    "fvu",
    "n_seeds",
]


def install(site: Path, place: Path) -> None:
    """Modules, templates and entry points into a new folder, as pip would install them, and the configuration into ``place``/conf."""
    about = site / "vehest_examples-1.0.dist-info"
    configuration = place / "conf" / "estimator"
    about.mkdir(parents=True)
    configuration.mkdir(parents=True, exist_ok=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: vehest-examples\nVersion: 1.0\n")
    points = "\n".join(f"{name} = {name}:{kind}" for name, kind in CLASSES.items())
    (about / "entry_points.txt").write_text(f"[vehest.estimators]\n{points}\n")
    for name in CLASSES:
        for file in EXAMPLES.glob(f"{name}.*"):
            shutil.copy(file, configuration if file.suffix == ".yaml" else site)


def main() -> None:
    """Run the comparison, print the leaderboard and write it."""
    with tempfile.TemporaryDirectory(prefix="examples-") as scratch:
        site = Path(scratch) / "site"
        place = Path(scratch) / "place"
        install(site, place)
        (place / "pipelines").mkdir()
        (place / "pipelines" / "examples.yaml").write_text(yaml.safe_dump(PIPELINE))
        command = (
            sys.executable,
            "-c",
            "from vehest.cli import main; main()",
            "run",
            "examples",
            "tracking=none",
        )
        subprocess.run(
            command,
            cwd=place,
            env={**os.environ, "PYTHONPATH": str(site), "VEHEST_OUTPUT": "outputs"},
            check=True,
        )
        (table,) = place.glob("outputs/report/examples-*/tables/leaderboard_test.csv")
        board = pd.read_csv(table)
        RESULT.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(table, RESULT)
    baselines = ("zero", "static_map", "kinematic", "data_sheet")
    record_tables(
        [RESULT],
        "make examples",
        [
            "script tools/compare_examples.py",
            "data sim_quickstart",
            *(f"evaluate {name}" for name in baselines),
        ],
    )
    print(board[[name for name in SHOWN if name in board]].to_string(index=False))


if __name__ == "__main__":
    main()
