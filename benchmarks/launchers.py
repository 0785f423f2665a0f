"""What a task costs the local launcher and Ray, from which length on a second node pays, and what a million trainings would come to.

Writes results/benchmarks/launchers.json. Tasks are groups of one member that learns nothing (estimator zero) on the quickstart's simulated
drives: evaluations of a tenth of a second, so that what launchers add is seen. What a launcher adds to a task is the time of all its cores
from the first group's begin to the last one's end, less what groups took, over their number. Trainings with their memory and their
rows in MLflow are sweeps of a KS-NN by the command line in a process of its own.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vehest.configuration.composition import compose_config
from vehest.data.files import remove_leftovers
from vehest.run.comparison import plan_training
from vehest.run.console import Messages
from vehest.run.failures import Failure
from vehest.run.group import Group
from vehest.run.launchers.clusters import RayLauncher
from vehest.run.launchers.local import LocalLauncher
from vehest.run.runner import Runner
from vehest.run.signals import StopSignals
from vehest.run.study import sweep_of

RESULT = Path(__file__).parents[1] / "results" / "benchmarks" / "launchers.json"
CORES = 2
QUIET = Messages(quiet=True)
STUDIES = (20, 200, 2000)  # tasks of a study, for which the break-even is computed


def groups_of(output: Path, number: int) -> list[Group]:
    """Groups of one member each, which differ in their seed."""
    config = compose_config(
        "eval", ["split=quickstart", "estimator=zero", f"output={output}", "tracking=none"]
    )
    runner = Runner(output, QUIET, StopSignals())
    split = runner.split(config)
    data = runner.data_for(split, float(config["estimator"]["rate_hz"]), config)
    evaluation = runner.evaluation(config, data)
    return [
        Group([plan_training({**config, "seed": seed}, split, data)], split, evaluation)
        for seed in range(number)
    ]


def timed(launcher: LocalLauncher | RayLauncher, groups: Sequence[Group]) -> dict[str, float]:
    """What launching costs [s]: until the first group begins, and what is added to a task of a group."""
    asked = time.perf_counter()
    begun: list[float] = []
    seconds = []
    ended = asked
    for done in launcher.launch(
        groups, StopSignals(), lambda *_: begun.append(time.perf_counter())
    ):
        if isinstance(done.outcome, Failure):
            raise SystemExit(done.outcome.message)
        seconds.append(
            sum(made.provenance["seconds"] for member in done.outcome for made in member.made)
        )
        ended = time.perf_counter()
    launcher.close()
    added = (CORES * (ended - begun[0]) - sum(seconds)) / len(groups)
    return {
        "start_s": begun[0] - asked,
        "added_s": added,
        "task_s": float(np.median(seconds)),
        "tasks": len(groups),
    }


def launchers(scratch: Path, number: int, repeats: int) -> dict[str, Any]:
    """Both launchers on the same groups, each into a fresh output root; the median of the repeats."""
    recordings = scratch / "recordings"
    found: dict[str, list[dict[str, float]]] = {"local": [], "ray": []}
    for repeat in range(repeats):
        for name, own in found.items():
            output = scratch / f"{name}-{repeat}"
            shutil.copytree(recordings, output)
            launcher = (
                LocalLauncher(CORES)
                if name == "local"
                else RayLauncher("local", CORES, output, QUIET)
            )
            own.append(timed(launcher, groups_of(output, number)))
    return {
        name: {key: round(float(np.median([one[key] for one in own])), 5) for key in own[0]}
        for name, own in found.items()
    }


def scheduler(number: int) -> dict[str, float]:
    """Tasks that do nothing, a second, from one process [1/s]."""
    import ray

    ray.init(
        address="local",
        num_cpus=CORES,
        include_dashboard=False,
        log_to_driver=False,
        logging_level=50,
    )
    nothing = ray.remote(num_cpus=1)(_nothing)
    ray.get([nothing.remote() for _ in range(200)])
    begun = time.perf_counter()
    ray.get([nothing.remote() for _ in range(number)])
    tasks = number / (time.perf_counter() - begun)
    ray.shutdown()
    return {"empty_tasks_a_second": round(tasks)}


def _nothing() -> None:
    return None


def sweep(scratch: Path, combinations: int, seeds: int, tracking: str) -> dict[str, float]:
    """A sweep of KS-NN trainings of one epoch on Ray: time, the parent's memory over trainings, MLflow's rows, files and bytes."""
    output = scratch / f"sweep-{tracking}"
    shutil.copytree(scratch / "recordings", output)
    rates = ",".join(f"{1e-3 + 1e-6 * k:g}" for k in range(combinations))
    words = [
        "split=quickstart",
        "estimator=ksnn",
        "estimator.n_hidden=0",
        "training.max_epochs=1",
        f"training.learning_rate={rates}",
    ]
    words += [
        f"seed=range({seeds})",
        f"tracking={tracking}",
        "--launcher",
        "ray",
        "-j",
        str(CORES),
        "-q",
    ]
    command = [sys.executable, "-c", "from vehest.cli import main; main()", "sweep", *words]
    environment = {**os.environ, "VEHEST_OUTPUT": str(output)}
    begun = time.perf_counter()
    with open(scratch / f"{tracking}.log", "wb") as log:
        process = subprocess.Popen(command, cwd=scratch, env=environment, stdout=log, stderr=log)
    samples = []
    while process.poll() is None:
        samples.append(
            (_done(output, tracking), _resident_mb(process.pid), _cpu_seconds(process.pid))
        )
        time.sleep(1.0)
    if process.returncode:
        raise SystemExit((scratch / f"{tracking}.log").read_text())
    seconds = time.perf_counter() - begun
    number = combinations * seeds
    busy = np.array([own for own in samples if 0.2 * number < own[0] < number and own[1] > 0])
    made = {"trainings": number, "seconds": round(seconds, 1)}
    if len(busy) > 5:
        memory, cpu = (float(np.polyfit(busy[:, 0], busy[:, column], 1)[0]) for column in (1, 2))
        made |= {
            "parent_mb": round(busy[:, 1].max()),
            "parent_mb_a_1000_trainings": round(1000 * memory, 1),
        }
        made |= {"parent_cpu_s_a_training": round(cpu, 4)}
    stages = [
        output / stage
        for stage in ("train", "calibrate", "evaluate", "locks", "tracked", "journal")
    ]
    files = [file for stage in stages for file in stage.rglob("*") if file.is_file()]
    made |= {
        "files_a_training": len(files) / number,
        "bytes_a_training": round(sum(file.stat().st_size for file in files) / number),
    }
    return made | (_rows(output, number) if tracking != "none" else {})


def _done(output: Path, tracking: str) -> int:
    """Trainings that the parent is done with."""
    folder = (
        output / "evaluate"
        if tracking == "none"
        else next(iter((output / "tracked").glob("*")), output / "tracked")
    )
    return (
        sum(name.startswith("evaluate-") or tracking == "none" for name in os.listdir(folder))
        if folder.is_dir()
        else 0
    )


def _cpu_seconds(process: int) -> float:
    """Of a process, without its children."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _resident_mb(process: int) -> float:
    try:
        status = Path(f"/proc/{process}/status").read_text()
    except OSError:
        return 0.0
    return next(
        (int(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith("VmRSS")),
        0.0,
    )


def _rows(output: Path, number: int) -> dict[str, float]:
    """Rows of MLflow's store a training, and how many artefacts have a run that is finished."""
    with sqlite3.connect(f"file:{output / 'mlflow.db'}?mode=ro", uri=True) as store:
        tables = (
            "runs",
            "metrics",
            "latest_metrics",
            "params",
            "tags",
            "inputs",
            "input_tags",
            "datasets",
            "logged_models",
        )
        rows = {
            table: store.execute(f"select count(*) from {table}").fetchone()[0] for table in tables
        }
        finished = store.execute(
            "select count(distinct value) from tags join runs using (run_uuid) where key = 'vehest.key' and status = 'FINISHED'"
        ).fetchone()[0]
    size = (output / "mlflow.db").stat().st_size + sum(
        file.stat().st_size for file in (output / "mlartifacts").rglob("*") if file.is_file()
    )
    return {
        "mlflow_artefacts_with_a_run": finished,
        "mlflow_artefacts_expected": 3 * number,
        "mlflow_rows_a_training": round(sum(rows.values()) / number, 1),
        "mlflow_bytes_a_training": round(size / number),
    }


def folder_listing(scratch: Path, number: int) -> dict[str, float]:
    """What looking for leftovers takes in a folder of many artefacts, which every stage does that makes one [s]."""
    folder = scratch / "many"
    folder.mkdir()
    for k in range(number):
        (folder / f"ksnn-linear_no_bias_p2-seed{k}-{k:012x}").mkdir()
    begun = time.perf_counter()
    remove_leftovers(folder)
    return {"folders": number, "seconds": round(time.perf_counter() - begun, 4)}


def planning(number: int) -> dict[str, float]:
    """What planning a sweep takes before anything is trained, a combination, of processor time [s]."""
    rates = ",".join(f"{1e-3 + 1e-6 * k:g}" for k in range(number))
    begun = time.process_time()
    sweep_of(
        ["split=quickstart", "estimator=ksnn", f"training.learning_rate={rates}", "tracking=none"]
    )
    return {
        "combinations": number,
        "seconds_a_combination": round((time.process_time() - begun) / number, 5),
    }


def break_even(local: Mapping[str, float], cluster: Mapping[str, float]) -> dict[str, float]:
    """Task length [s] from which two nodes by Ray are quicker than one by the local launcher, a study of so many tasks.

    One node: S_l + n (t + h_l) / c; two nodes: S_r + n (t + h_r) / 2c; so t > 2c (S_r - S_l) / n + h_r - 2 h_l.
    """
    gained = cluster["added_s"] - 2 * local["added_s"]
    late = cluster["start_s"] - local["start_s"]
    return {f"{n} tasks": round(max(0.0, 2 * CORES * late / n + gained), 4) for n in STUDIES}


def million(
    measured: Mapping[str, Any], seconds: float = 10.0, trainings: float = 1e6, cores: float = 1e3
) -> dict[str, float]:
    """10⁶ trainings of 10 s on 1,000 cores, each part by itself, from what was measured here [h, unless it says otherwise]."""
    plain = measured["sweep"]["none"]
    tracked = measured["sweep"]["mlflow"]
    wanted = trainings / (trainings * seconds / cores)
    listing = measured["listing"]
    quick = {
        "all cores busy": trainings * seconds / cores,
        "added by Ray": trainings * measured["launchers"]["ray"]["added_s"] / cores,
        "scheduling, one process": trainings / measured["scheduler"]["empty_tasks_a_second"],
        "the rest of the parent, one process": trainings * plain["parent_cpu_s_a_training"],
        "MLflow, one process": trainings * tracked["mlflow_s_a_training"],
        "planning, one process": trainings * measured["planning"]["seconds_a_combination"],
        "looking for leftovers, all cores": 3
        * trainings
        * (trainings / 2)
        * listing["seconds"]
        / listing["folders"]
        / cores,
    }
    return {
        **{name: round(value / 3600, 2) for name, value in quick.items()},
        "trainings a second that keep all cores busy": wanted,
        "artefacts [GB]": round(trainings * plain["bytes_a_training"] / 1e9, 1),
        "files [millions]": round(trainings * plain["files_a_training"] / 1e6, 1),
        "MLflow rows [millions]": round(trainings * tracked["mlflow_rows_a_training"] / 1e6),
        "MLflow [GB]": round(trainings * tracked["mlflow_bytes_a_training"] / 1e9),
    }


def parts(scratch: Path, given: argparse.Namespace) -> dict[str, Callable[[], Any]]:
    """What is measured, by name."""
    return {
        "launchers": lambda: launchers(scratch, given.tasks, given.repeats),
        "scheduler": lambda: scheduler(5000),
        "planning": lambda: planning(100),
        "listing": lambda: folder_listing(scratch, 100_000),
        "sweep": lambda: {
            name: sweep(scratch, given.combinations, given.seeds, name)
            for name in ("none", "mlflow")
        },
    }


def computed(result: dict[str, Any]) -> None:
    """Add what follows from what was measured."""
    if "launchers" in result:
        result["second_node_pays_from_s"] = break_even(
            result["launchers"]["local"], result["launchers"]["ray"]
        )
    if "sweep" in result:
        plain = result["sweep"]["none"]
        tracked = result["sweep"]["mlflow"]
        if "parent_cpu_s_a_training" in plain and "parent_cpu_s_a_training" in tracked:
            tracked["mlflow_s_a_training"] = round(
                tracked["parent_cpu_s_a_training"] - plain["parent_cpu_s_a_training"], 4
            )
    if {"launchers", "scheduler", "planning", "listing"} <= set(
        result
    ) and "mlflow_s_a_training" in result.get("sweep", {}).get("mlflow", {}):
        result["million_trainings_on_1000_cores"] = million(result)


def main() -> None:
    """Measure every part, or those that are named; write each as soon as it is measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--tasks", type=int, default=100, help="groups of the comparison of launchers"
    )
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--combinations", type=int, default=200, help="of the sweeps of trainings")
    parser.add_argument("--seeds", type=int, default=10, help="of each combination")
    parser.add_argument(
        "--parts",
        nargs="*",
        help="of: launchers scheduler planning listing sweep; what others measured before stays",
    )
    given = parser.parse_args()
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    result: dict[str, Any] = (
        json.loads(RESULT.read_text(encoding="utf-8")) if given.parts and RESULT.is_file() else {}
    )
    result["machine"] = (
        f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    )
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="launchers-") as folder:
        scratch = Path(folder)
        os.chdir(scratch)
        groups_of(scratch / "recordings", 1)
        for name, measure in parts(scratch, given).items():
            if given.parts and name not in given.parts:
                continue
            before = os.getloadavg()[0]
            result[name] = measure()
            load = {"before": round(before, 1), "after": round(os.getloadavg()[0], 1)}
            result["load"] = {**result.get("load", {}), name: load}  # what else ran on the machine
            computed(result)
            RESULT.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
            print(f"{name}: {json.dumps(result[name])}", flush=True)


if __name__ == "__main__":
    main()
