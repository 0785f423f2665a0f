"""Runs every study on small budgets and keeps the tables of its report, which say whether a change
moved numbers; README.md says more.

pipelines/STUDY.yaml -> reduced pipeline -> `vehest run` -> report's metrics.csv and tables/*.csv ->
rounded, in OUT/STUDY/ -> `compare`
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from functools import cache, partial
from pathlib import Path

import numpy as np
import pandas as pd
import yaml

from vehest.configuration.composition import compose_config, expand, key_of

ROOT = Path(__file__).resolve().parents[2]
WITHOUT_PILOT = {"ksnn_revs"}  # needs the official files of the Revs database
BUDGETS = {
    "max_epochs": 2,
    "max_evaluations": 6,
    "grid": 1,
    "trials": 4,
    "scaling_trials": 3,
    "generations": 5,
    "restarts": 1,
}
MOST_DRIVES = 3
MOST_SECONDS = 100  # of each kind in a simulated data set; of a drive
DIGITS = 6
MAX_DIFFERENCES = 5
_texts = partial(pd.read_csv, dtype=str, keep_default_na=False)


def reduced(pipeline):
    """A pipeline with all parts and candidates, but one seed and at most the `BUDGETS` for each
    training.
    """
    parts = {
        name: {**part, "sweeps": _reduced_sweeps(part["sweeps"])}
        for name, part in pipeline.get("parts", {}).items()
    }
    changed = (
        {"parts": parts}
        if parts
        else {"sweeps": _reduced_sweeps(pipeline["sweeps"])}
        if "sweeps" in pipeline
        else {}
    )
    return {**pipeline, **changed, "publish": False}


def _reduced_sweeps(sweeps):
    """Every candidate as a sweep of its own, with the first seed of its sweep."""
    candidates = []
    for sweep in sweeps:
        seeds = [override for override in sweep if key_of(override) == "seed"]
        for candidate in expand([override for override in sweep if override not in seeds]):
            chosen = tuple(
                override
                for override in candidate
                if key_of(override).startswith(("estimator", "training"))
            )
            candidates.append([*candidate, *_budgets_of(chosen), *expand(seeds)[0]])
    return candidates


@cache
def _budgets_of(overrides):
    """Overrides for what is above its budget in a training's configuration, or in a phase of it."""
    training = compose_config("train", overrides)["training"]
    phases = {"training": training} | {
        f"training.{name}": value for name, value in training.items() if isinstance(value, Mapping)
    }
    return [
        f"{phase}.{name}={budget}"
        for phase, values in phases.items()
        for name, budget in BUDGETS.items()
        if values.get(name, budget) > budget
    ]


def write_data_sets(folder):
    """Configurations of simulated data sets with fewer and shorter drives."""
    folder.mkdir(parents=True, exist_ok=True)
    for file in (ROOT / "conf" / "dataset").glob("*.yaml"):
        dataset = yaml.safe_load(file.read_text(encoding="utf-8"))
        for drive in dataset.get("drives", []):
            if "count" in drive:
                drive["count"] = min(drive["count"], MOST_DRIVES)
            if isinstance(drive["manoeuvre"].get("duration"), int):
                drive["manoeuvre"]["duration"] = min(drive["manoeuvre"]["duration"], MOST_SECONDS)
        if "drives" in dataset:
            (folder / file.name).write_text(
                yaml.safe_dump(dataset, allow_unicode=True), encoding="utf-8"
            )


def run(study, out, output, jobs):
    """Run the pilot of a study and keep its tables; returns whether all of it succeeded."""
    begun = time.monotonic()
    computed = sum(os.times()[2:4])  # the latter of processes that ended
    pipeline = yaml.safe_load((ROOT / "pipelines" / f"{study}.yaml").read_text(encoding="utf-8"))
    (output / f"{study}.yaml").write_text(
        yaml.safe_dump(reduced(pipeline), allow_unicode=True, sort_keys=False), encoding="utf-8"
    )
    words = [
        "vehest",
        "run",
        f"{study}.yaml",
        f"output={output}",
        "tracking=none",
        f"--jobs={jobs}",
        "--json",
    ]
    ran = subprocess.run(
        [sys.executable, "-m", *words], cwd=output, stdout=subprocess.PIPE, text=True, check=False
    )
    if ran.stdout:
        collect(Path(json.loads(ran.stdout)["report"]).parent, out / study)
    seconds = (
        f"{time.monotonic() - begun:.0f} s, {sum(os.times()[2:4]) - computed:.0f} s of processors"
    )
    print(f"{study}: exit code {ran.returncode}, {seconds}", flush=True)
    return ran.returncode == 0


def collect(report, folder):
    """Copy a report's tables, numbers rounded."""
    shutil.rmtree(folder, ignore_errors=True)
    for file in [*report.glob("metrics.csv"), *(report / "tables").glob("*.csv")]:
        target = folder / file.relative_to(report)
        target.parent.mkdir(parents=True, exist_ok=True)
        _texts(file).map(_rounded).to_csv(target, index=False)


def _rounded(cell):
    """A number at the digits that are compared; text as it is."""
    try:
        return f"{float(cell):.{DIGITS}g}"
    except ValueError:
        return cell


def differences(first, second):
    """Files that two folders do not share, tables of another shape, and cells with other values."""
    for name in sorted(
        {
            file.relative_to(side).as_posix()
            for side in (first, second)
            for file in side.rglob("*.csv")
        }
    ):
        without_file = [side for side in (first, second) if not (side / name).is_file()]
        if without_file:
            yield f"{name}: not in {without_file[0]}"
            continue
        table = _texts(first / name)
        other_table = _texts(second / name)
        if list(table) != list(other_table) or len(table) != len(other_table):
            shapes = (f"{len(rows)} rows of {','.join(rows)}" for rows in (table, other_table))
            yield f"{name}: {' | '.join(shapes)}"
            continue
        for row, column in np.argwhere((table != other_table).to_numpy()):
            cells = f"{table.iat[row, column]} | {other_table.iat[row, column]}"
            yield f"{name}, row {row + 1}, {table.columns[column]}: {cells}"


def compare(first, second):
    """Print of every study whether its tables are equal, else the first differences and their
    number; returns how many studies differ.
    """
    differing = 0
    for study in sorted(
        {folder.name for side in (first, second) for folder in side.iterdir() if folder.is_dir()}
    ):
        alone = [side for side in (first, second) if not (side / study).is_dir()]
        study_differences = (
            [f"not in {alone[0]}"] if alone else list(differences(first / study, second / study))
        )
        print(
            f"{study}: {f'{len(study_differences)} differences' if study_differences else 'equal'}",
            *study_differences[:MAX_DIFFERENCES],
            sep="\n  ",
        )
        differing += bool(study_differences)
    return differing


def main():
    """Run or compare; the exit code is 1 where a pilot failed, or folders differ."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("studies", nargs="*", help="names of pipelines; all by default")
    parser.add_argument(
        "--out", type=Path, default=Path("build/pilots"), help="folder for the tables"
    )
    parser.add_argument("--jobs", type=int, default=1, help="processes side by side")
    parser.add_argument(
        "--compare", nargs=2, type=Path, metavar="OUT", help="compare two folders of tables instead"
    )
    options = parser.parse_args()
    if options.compare:
        missing_folders = [str(folder) for folder in options.compare if not folder.is_dir()]
        sys.exit(
            f"there is no folder {' or '.join(missing_folders)}"
            if missing_folders
            else compare(*options.compare) > 0
        )
    studies_with_pilot = {file.stem for file in (ROOT / "pipelines").glob("*.yaml")} - WITHOUT_PILOT
    unknown_studies = sorted(set(options.studies) - studies_with_pilot)
    if unknown_studies:
        available = ", ".join(sorted(studies_with_pilot))
        sys.exit(f"no pilot of {', '.join(unknown_studies)}; there are: {available}")
    studies = options.studies or sorted(studies_with_pilot)
    with tempfile.TemporaryDirectory(
        prefix="pilots-"
    ) as output:  # a new one: keys say nothing of code whose versions stayed
        write_data_sets(Path(output) / "conf" / "dataset")
        succeeded = [
            run(study, options.out.resolve(), Path(output), options.jobs) for study in studies
        ]
    sys.exit(not all(succeeded))


if __name__ == "__main__":
    main()
