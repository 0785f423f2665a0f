"""Kill a study again and again, at moments drawn from a seed, and see that every run after it ends
in the same numbers: `make kills`.

A round is one output root. The study is started in it and killed in its ingest, started again and
killed in its downsampling, and so on through training, evaluation and report; the last run is left
to end. So the kills of a round pile up, which is harder than one kill a root, and what is checked
at the end of a round is said of each of its kills. Signals are SIGKILL, SIGTERM and SIGINT in turn.
A moment is an event that can be seen from outside (an artefact is locked, begun or made, a
checkpoint is there, a run of MLflow is begun or marked) and a delay of up to 60 ms from there; how
far a run has come by then is the machine's own, and is not the same twice. A run that ends before
its moment comes is no kill: another round makes up for it. In every fourth round jobs run side by
side.
"""

import argparse
import csv
import fcntl
import json
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter, namedtuple
from contextlib import suppress
from glob import glob
from pathlib import Path

from processes import end_all, is_alive, start
from vehest.artefacts.artefact import read_artefact
from vehest.data.errors import VehestError
from vehest.run.evaluate import TIMES
from vehest.run.table_records import record_tables

VERSION = "1"
"""Raised when the numbers of its tables move."""
EXIT_CODES = {signal.SIGKILL: -9, signal.SIGTERM: 143, signal.SIGINT: 130}
SIGNALS = tuple(EXIT_CODES)
STUDY = ("run", "quickstart", "training.max_epochs=3", "training.checkpoint_seconds=0")
MOMENTS = {
    "ingest": ("begun", "part", "made"),
    "downsample": ("begun", "made"),
    "train": ("locked", "checkpoint", "made", "store", "tracking"),
    "evaluate": ("locked", "begun", "made", "tracking"),
    "report": ("begun", "file", "made"),
}
STAGES = tuple(MOMENTS)
EVENTS = {  # what there is once more when it happens
    "begun": "{stage}/.writing-*",
    "part": "{stage}/.parts-*/*",
    "file": "{stage}/.writing-*/*",
    "made": "{stage}/*",
    "locked": "locks/{stage}-*",
    "checkpoint": "checkpoints/*/*",
    "store": ".*mlflow.db",
    "tracking": "mlartifacts/*",
}
MAX_DELAY = 0.06  # s
COUNTS = 3  # a moment is one of the first so many of its kind
RUN_SECONDS = 1800.0
LOOK_SECONDS = 0.002  # after the first a run hangs
HEADER = (
    "number",
    "round",
    "jobs",
    "signal",
    "stage",
    "moment",
    "exit_code",
    "resumed_runs",
    "metrics_equal",
    "tracking_complete",
)
HEADER += ("leftovers", "outcome")
Kill = namedtuple("Kill", "stage number moment exit_code at_once")
"""When a run was killed, by what, how it ended, and what was wrong at once."""


def started(output, jobs):
    """Start the study in ``output``, in a process that leads a session of its own and says what it
    says in a log beside.
    """
    with open(output.with_suffix(".log"), "ab") as log:
        words = ["-m", "vehest", *STUDY, f"output={output}", "--jobs", jobs]
        return start([sys.executable, *words], stdin=subprocess.DEVNULL, stdout=log, stderr=log)


def session(leader):
    """Living processes that a run started, itself included."""
    alive = []
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            alive += (
                [int(entry.name)]
                if os.getsid(int(entry.name)) == leader and is_alive(entry.name)
                else []
            )
    return alive


def strays(leader, patience=20.0):
    """Processes of a run that outlive it for more than ``patience`` seconds.

    They are ended here.
    """
    end = time.monotonic() + patience
    while (processes := session(leader)) and time.monotonic() < end:
        time.sleep(LOOK_SECONDS)
    for process in processes:
        os.kill(process, signal.SIGKILL)
    return [f"process {process}" for process in processes]


def killed(output, stage, number, jobs, draw):
    """Start a run, kill it at a moment of a stage; none if it ended before."""
    moment = draw.choice(MOMENTS[stage])
    count = draw.randint(1, COUNTS)
    delay = draw.uniform(0.0, MAX_DELAY)
    count = (
        1 if (stage in {"ingest", "report"} and moment != "file") or moment == "store" else count
    )
    count = min(count, 2) if stage == "downsample" else count
    event = EVENTS[moment].format(stage=stage)
    before = set(glob(event, root_dir=output))
    met = set[str]()
    process = started(output, jobs)
    while len(met) < count:
        met |= set(glob(event, root_dir=output)) - before
        if process.poll() is not None:
            strays(process.pid)
            if process.returncode != 0:
                raise SystemExit(
                    f"a run failed by itself with exit code {process.returncode}, "
                    f"see '{output.with_suffix('.log')}'"
                )
            return None
        time.sleep(LOOK_SECONDS)
    time.sleep(delay)
    process.send_signal(number)
    code = process.wait(RUN_SECONDS)
    left = strays(process.pid)
    if code == 0:
        return None
    left += busy_locks(output) + broken(output)
    left += (
        [f"exit code {code} instead of {EXIT_CODES[number]}"] if code != EXIT_CODES[number] else []
    )
    return Kill(stage, number, f"{moment} {count} + {delay * 1e3:.0f} ms", code, tuple(left))


def artefacts(output):
    """Folders of all stages."""
    return [folder for stage in STAGES for folder in sorted((output / stage).glob("[!.]*"))]


def broken(output):
    """Folders that are not whole."""
    complaints = []
    for folder in artefacts(output):
        try:
            read_artefact(folder)
        except VehestError:
            complaints.append(f"half of {folder.name}")
    return complaints


def busy_locks(output):
    """Locks that somebody holds."""
    locks = []
    for file in (output / "locks").glob("*.lock"):
        with open(file, "rb") as stream:
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                locks.append(f"lock {file.name}")
    return locks


def content(output):
    """Artefact -> what it holds, times aside: the digest of its files, of a report the metrics that
    it publishes.
    """
    contents = {}
    for folder in artefacts(output):
        artefact = read_artefact(folder)
        artefact_name = f"{artefact.stage}/{folder.name} {artefact.status}"
        contents[artefact_name] = artefact.digest
        if artefact.stage == "report":
            with open(folder / "metrics.csv", newline="", encoding="utf-8") as stream:
                contents[artefact_name] = json.dumps(
                    [row for row in csv.DictReader(stream) if row["metric"] not in TIMES]
                )
    return contents


def tracked(output):
    """Finished run -> its artefact and what was logged of it, times aside.

    Runs that are neither finished nor killed by that name.
    """
    runs = {}
    with sqlite3.connect(f"file:{output / 'mlflow.db'}?mode=ro", uri=True) as store:
        for run, name, status in store.execute(
            "select run_uuid, name, status from runs where lifecycle_stage = 'active'"
        ).fetchall():
            if (
                status == "KILLED"
            ):  # of an interrupted training, by which it is told from the finished one
                continue
            keys, points, parameters = (
                store.execute(f"select {columns} where run_uuid = ? {condition}", [run]).fetchall()
                for columns, condition in (
                    ("value from tags", "and key = 'vehest.key'"),
                    ("key, step, value from metrics", "order by key, step, value"),
                    ("key, value from params", "order by key"),
                )
            )
            files = sorted(
                str(file.relative_to(output / "mlartifacts" / run))
                for file in (output / "mlartifacts" / run).rglob("*.*")
            )
            run_name = f"{name} {status} {keys[0][0] if keys else ''}"
            logged = [[point for point in points if "_seconds" not in point[0]], parameters, files]
            runs[run_name + (f" again {run}" if run_name in runs else "")] = json.dumps(logged)
    return runs


def leftovers(output):
    """What killed runs left and nobody needs: half-written things, parts, checkpoints, locks."""
    paths = [
        str(path.relative_to(output))
        for path in output.rglob(".*")
        if path.name.startswith((".writing-", ".parts-"))
    ]
    return [*paths, *glob("checkpoints/*", root_dir=output), *busy_locks(output)]


def kill_round(position, planned_kills, output, reference, draw):
    """Kill runs in one output root, let the last one end, and look at what there is: kills, and a
    row of the table for each, unnumbered.
    """
    jobs = 2 if position % 4 == 3 else 1
    kills = [
        kill
        for kill in (
            killed(output, *stage_and_signal, jobs, draw) for stage_and_signal in planned_kills
        )
        if kill is not None
    ]
    last = started(output, jobs)
    code = last.wait(RUN_SECONDS)
    left = strays(last.pid)
    failed = (
        [f"the last run left with {code}, see '{output.with_suffix('.log')}'"] if code != 0 else []
    )
    metrics = []
    tracking = []
    for of, differing in () if failed else ((content, metrics), (tracked, tracking)):
        actual = of(output)
        expected = of(reference)
        differing += [
            name for name in sorted({*actual, *expected}) if actual.get(name) != expected.get(name)
        ]
    left += [] if failed else leftovers(output)
    equal, complete = (
        "no" if failed or differences else "yes" for differences in (metrics, tracking)
    )
    rows = []
    for place, kill in enumerate(kills):
        remains = "; ".join([*left, *kill.at_once])
        faults = "; ".join([*failed, *metrics, *tracking]) or remains
        head = [
            position,
            jobs,
            kill.number.name,
            kill.stage,
            kill.moment,
            kill.exit_code,
            len(kills) - place,
        ]
        rows.append(
            [*head, equal, complete, remains or "none", f"bad: {faults}" if faults else "good"]
        )
    return kills, rows


def rounds(missing, draw, scratch, out):
    """Run rounds until every kill was made; how many were bad."""
    os.chdir(scratch)  # runs find the configuration that came with the package
    begun = time.monotonic()
    reference = scratch / "reference"
    if started(reference, 1).wait(RUN_SECONDS) != 0:
        raise SystemExit(
            f"the study does not run by itself:\n{reference.with_suffix('.log').read_text()}"
        )
    print(f"reference: {time.monotonic() - begun:.0f} s", flush=True)
    position = 0
    bad = 0
    number = 1
    limit = 3 * missing.total()
    with open(out, "w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(HEADER)
        while missing.total() > 0:
            if position > limit:
                raise SystemExit("moments are missed again and again")
            planned_kills = [
                (
                    stage,
                    max(
                        SIGNALS,
                        key=lambda signal_name, stage=stage: (
                            missing[stage, signal_name],
                            -SIGNALS.index(signal_name),
                        ),
                    ),
                )
                for stage in STAGES
            ]
            planned_kills = [
                kill for kill in planned_kills if missing[kill] > 0
            ]  # of each stage one that is missing most
            kills, rows = kill_round(
                position, planned_kills, scratch / f"round{position}", reference, draw
            )
            missing -= Counter((kill.stage, kill.number) for kill in kills)
            writer.writerows([number + place, *row] for place, row in enumerate(rows))
            stream.flush()
            worse = sum(row[-1] != "good" for row in rows)
            bad = bad + worse
            number = number + len(rows)
            print(
                f"round {position}: {len(rows)} kills, {bad} bad so far, "
                f"{time.monotonic() - begun:.0f} s",
                flush=True,
            )
            if not worse:
                shutil.rmtree(scratch / f"round{position}")
            position += 1
    return bad


def main():
    """Exit code 1 if any row is bad."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--kills",
        type=int,
        default=100,
        help="how many, spread evenly over five stages and three signals",
    )
    parser.add_argument("--seed", type=int, default=0, help="of signals, moments and delays")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("results/reliability/kills.csv"),
        help="table, a row a kill",
    )
    options = parser.parse_args()
    os.environ |= {"MLFLOW_DISABLE_TELEMETRY": "true", "DO_NOT_TRACK": "true", "MPLBACKEND": "agg"}
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    out = options.out.resolve()
    out.parent.mkdir(parents=True, exist_ok=True)
    missing = Counter(
        (STAGES[k % len(STAGES)], SIGNALS[k // len(STAGES) % len(SIGNALS)])
        for k in range(options.kills)
    )
    with tempfile.TemporaryDirectory(prefix="kills-") as scratch:
        try:
            bad = rounds(missing, random.Random(options.seed), Path(scratch), out)
        finally:
            end_all()
    record_tables([out], "make kills", ["script tests/kills/kills.py"])
    print(f"{options.kills} kills, {bad} of them bad: {out}")
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
