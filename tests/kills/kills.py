"""Kill a study again and again, at moments drawn from a seed, and see that every run after it ends in the same numbers: `make kills`.

A round is one output root. The study is started in it and killed in its ingest, started again and killed in its downsampling, and so on
through training, evaluation and report; the last run is left to end. So the kills of a round pile up, which is harder than one kill a
root, and what is checked at the end of a round is said of each of its kills. Signals are SIGKILL, SIGTERM and SIGINT in turn. A moment
is an event that can be seen from outside (an artefact is locked, begun or made, a checkpoint is there, a run of MLflow is begun or
marked) and a delay of up to 60 ms from there; how far a run has come by then is the machine's own, and is not the same twice. A run that
ends before its moment comes is no kill: another round makes up for it.

This process imports everything once, and every run is a fork of it that calls the command line, so that a hundred runs do not spend
their time on imports. In every fourth round jobs run side by side, in processes that a run starts itself.
"""

import argparse
import csv
import ctypes
import fcntl
import gc
import importlib
import json
import os
import random
import shutil
import signal
import sqlite3
import sys
import tempfile
import time
import traceback
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

STAGES = ("ingest", "downsample", "train", "evaluate", "report")
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
PR_SET_PDEATHSIG = 1  # of Linux's prctl: a run ends with this process
MAX_DELAY = 0.06  # s
COUNTS = 3  # a moment is one of the first so many of its kind
RUN_SECONDS, LOOK_SECONDS = 1800.0, 0.002  # after the first a run hangs
HEADER = ("number", "round", "jobs", "signal", "stage", "moment", "exit_code", "resumed_runs", "metrics_equal", "tracking_complete")
HEADER += ("leftovers", "outcome")
HEAVY = ("mlflow", "matplotlib.pyplot", "vehest.run.study_run", "vehest.studies.drive", "vehest.report.document")
HEAVY += ("vehest.report.figures",)


@dataclass(frozen=True)
class Kill:
    """When a run was killed, by what, how it ended, and what was wrong at once."""

    stage: str
    number: signal.Signals
    moment: str
    exit_code: int
    at_once: tuple[str, ...]


@dataclass
class Round:
    """One output root with the kills in it and what was found at its end."""

    position: int
    kills: list[Kill] = field(default_factory=list)
    metrics: list[str] = field(default_factory=list)
    tracking: list[str] = field(default_factory=list)
    leftovers: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)

    @property
    def jobs(self):
        return 2 if self.position % 4 == 3 else 1


def started(output, jobs, log):
    """Fork a run of the study into ``output``; returns its process, which leads a session of its own."""
    sys.stdout.flush()
    process = os.fork()
    if process:
        return process
    code = 1
    try:
        os.setsid()
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        for number, stream in ((out, 1), (out, 2), (os.open(os.devnull, os.O_RDONLY), 0)):
            os.dup2(number, stream)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.argv = ["vehest", *STUDY, f"output={output}", "--jobs", str(jobs)]
        importlib.import_module("vehest.cli").main()
        code = 0
    except SystemExit as leave:
        code = int(leave.code or 0)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def ended(process, *, at_once=False):
    """Exit code of a run, negative where a signal ended it; none if it goes on and is not waited for."""
    end = time.monotonic() + RUN_SECONDS
    while True:
        found, status = os.waitpid(process, os.WNOHANG)
        if found or at_once:
            return os.waitstatus_to_exitcode(status) if found else None
        if time.monotonic() > end:
            os.killpg(process, signal.SIGKILL)
            raise SystemExit(f"a run hangs: process {process}")
        time.sleep(LOOK_SECONDS)


def session(leader):
    """Living processes that a run started, itself included."""
    alive = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == leader and fields[0] not in "ZX":
            alive.append(int(entry.parent.name))
    return alive


def strays(leader, patience=20.0):
    """Processes of a run that outlive it for more than ``patience`` seconds; they are ended here."""
    end = time.monotonic() + patience
    while (found := session(leader)) and time.monotonic() < end:
        time.sleep(LOOK_SECONDS)
    for process in found:
        os.kill(process, signal.SIGKILL)
    return [f"process {process}" for process in found]


def names(folder, start="", hidden=True):
    """Names in a folder that begin so; none where it is not there."""
    try:
        return {name for name in os.listdir(folder) if name.startswith(start) and (hidden or not name.startswith("."))}
    except OSError:
        return set()


def seen(output, stage, moment):
    """What there is of a kind of event; one more of them is the event."""
    own = output / stage
    found = {
        "begun": lambda: names(own, ".writing-"),
        "made": lambda: names(own, hidden=False),
        "part": lambda: {file for folder in names(own, ".parts-") for file in names(own / folder, hidden=False)},
        "file": lambda: {file for folder in names(own, ".writing-") for file in names(own / folder)},
        "locked": lambda: names(output / "locks", f"{stage}-"),
        "checkpoint": lambda: {name for name in names(output / "checkpoints") if names(output / "checkpoints" / name)},
        "store": lambda: {name for name in names(output) if name.endswith("mlflow.db")},
        "tracking": lambda: names(output / "mlartifacts"),
    }
    return found[moment]()


def killed(output, stage, number, jobs, draw, log):
    """Start a run, kill it at a moment of a stage; none if it ended before."""
    moment, count, delay = draw.choice(MOMENTS[stage]), draw.randint(1, COUNTS), draw.uniform(0.0, MAX_DELAY)
    count = 1 if (stage in {"ingest", "report"} and moment != "file") or moment == "store" else count
    count = min(count, 2) if stage == "downsample" else count
    before, met = seen(output, stage, moment), set[str]()
    process = started(output, jobs, log)
    while len(met) < count:
        met |= seen(output, stage, moment) - before
        code = ended(process, at_once=True)
        if code is not None:
            strays(process)
            if code != 0:
                raise SystemExit(f"a run failed by itself with exit code {code}, see '{log}'")
            return None
        time.sleep(LOOK_SECONDS)
    time.sleep(delay)
    os.kill(process, number)
    code, left = ended(process), strays(process)
    if code == 0:
        return None
    left += locks_held(output) + broken(output)
    left += [f"exit code {code} instead of {EXIT_CODES[number]}"] if code != EXIT_CODES[number] else []
    return Kill(stage, number, f"{moment} {count} + {delay * 1e3:.0f} ms", code, tuple(left))


def artefacts(output):
    """Folders of all stages."""
    return [output / stage / name for stage in STAGES for name in sorted(names(output / stage, hidden=False))]


def broken(output):
    """Folders that are not whole."""
    from vehest.data.errors import VehestError
    from vehest.run.artefacts import read_artefact

    found = []
    for folder in artefacts(output):
        try:
            read_artefact(folder)
        except VehestError:
            found.append(f"half of {folder.name}")
    return found


def locks_held(output):
    """Locks that somebody holds."""
    held = []
    for file in (output / "locks").glob("*.lock"):
        with open(file, "rb") as stream:
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                held.append(f"lock {file.name}")
    return held


def content(output):
    """Artefact -> what it holds, times aside: the digest of its files, of a report the metrics that it publishes."""
    from vehest.run.artefacts import read_artefact
    from vehest.run.evaluate import TIMES

    found = {}
    for folder in artefacts(output):
        artefact = read_artefact(folder)
        own = f"{artefact.stage}/{folder.name} {artefact.status}"
        found[own] = artefact.digest
        if artefact.stage == "report":
            with open(folder / "metrics.csv", newline="", encoding="utf-8") as stream:
                found[own] = json.dumps([row for row in csv.DictReader(stream) if row["metric"] not in TIMES])
    return found


def differences(found, wanted):
    """What one has and the other has not, or has otherwise."""
    return [name for name in sorted({*found, *wanted}) if found.get(name) != wanted.get(name)]


def tracked(output):
    """Finished run -> its artefact and what was logged of it, times aside; runs that are neither finished nor killed by that name."""
    found = {}
    with sqlite3.connect(f"file:{output / 'mlflow.db'}?mode=ro", uri=True) as store:
        for run, name, status in store.execute("select run_uuid, name, status from runs where lifecycle_stage = 'active'").fetchall():
            if status == "KILLED":  # of an interrupted training, by which it is told from the finished one
                continue
            keys, points, parameters = (
                store.execute(f"select {what} where run_uuid = ? {rest}", [run]).fetchall()
                for what, rest in (
                    ("value from tags", "and key = 'vehest.key'"),
                    ("key, step, value from metrics", "order by key, step, value"),
                    ("key, value from params", "order by key"),
                )
            )
            files = sorted(str(file.relative_to(output / "mlartifacts" / run)) for file in (output / "mlartifacts" / run).rglob("*.*"))
            own = f"{name} {status} {keys[0][0] if keys else ''}"
            logged = [[point for point in points if "_seconds" not in point[0]], parameters, files]
            found[own + (f" again {run}" if own in found else "")] = json.dumps(logged)
    return found


def leftovers(output):
    """What killed runs left and nobody needs: half-written things, parts, checkpoints, locks."""
    found = [str(path.relative_to(output)) for path in output.rglob(".*") if path.name.startswith((".writing-", ".parts-"))]
    return [*found, *(f"checkpoints/{name}" for name in names(output / "checkpoints")), *locks_held(output)]


def one_round(position, wanted, output, reference, draw):
    """Kill runs in one output root, let the last one end, and look at what there is."""
    own, log = Round(position), output.with_suffix(".log")
    made = (killed(output, stage, number, own.jobs, draw, log) for stage, number in wanted)
    own.kills = [kill for kill in made if kill is not None]
    last = started(output, own.jobs, log)
    code, own.leftovers = ended(last), strays(last)
    if code != 0:
        own.failed = [f"the last run left with {code}, see '{log}'"]
        return own
    own.metrics = differences(content(output), content(reference))
    own.tracking = differences(tracked(output), tracked(reference))
    own.leftovers += leftovers(output)
    return own


def rows_of(own, first):
    """A row a kill."""
    for position, kill in enumerate(own.kills):
        equal, complete = ("yes" if not (own.failed or found) else "no" for found in (own.metrics, own.tracking))
        left = "; ".join([*own.leftovers, *kill.at_once])
        faults = "; ".join([*own.failed, *own.metrics, *own.tracking]) or left
        head = [first + position, own.position, own.jobs, kill.number.name, kill.stage, kill.moment, kill.exit_code]
        yield [*head, len(own.kills) - position, equal, complete, left or "none", f"bad: {faults}" if faults else "good"]


def still_wanted(missing):
    """For the next round: of each stage a kill that is missing most."""
    chosen = [(stage, max(SIGNALS, key=lambda one, stage=stage: (missing[stage, one], -SIGNALS.index(one)))) for stage in STAGES]
    return [wanted for wanted in chosen if missing[wanted] > 0]


def rounds(missing, draw, scratch, out):
    """Run rounds until every kill was made; how many were bad."""
    os.chdir(scratch)  # runs find the configuration that came with the package
    begun, reference = time.monotonic(), scratch / "reference"
    if ended(started(reference, 1, reference.with_suffix(".log"))) != 0:
        raise SystemExit(f"the study does not run by itself:\n{reference.with_suffix('.log').read_text()}")
    print(f"reference: {time.monotonic() - begun:.0f} s", flush=True)
    position, bad, number, limit = 0, 0, 1, 3 * missing.total()
    with open(out, "w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(HEADER)
        while missing.total() > 0:
            if position > limit:
                raise SystemExit("moments are missed again and again")
            own = one_round(position, still_wanted(missing), scratch / f"round{position}", reference, draw)
            missing -= Counter((kill.stage, kill.number) for kill in own.kills)
            rows = list(rows_of(own, number))
            writer.writerows(rows)
            stream.flush()
            worse = sum(row[-1] != "good" for row in rows)
            bad, number = bad + worse, number + len(rows)
            print(f"round {position}: {len(rows)} kills, {bad} bad so far, {time.monotonic() - begun:.0f} s", flush=True)
            if not worse:
                shutil.rmtree(scratch / f"round{position}")
            position += 1
    return bad


def main():
    """Exit code 1 if any row is bad."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100, help="how many, spread evenly over five stages and three signals")
    parser.add_argument("--seed", type=int, default=0, help="of signals, moments and delays")
    parser.add_argument("--out", type=Path, default=Path("results/reliability/kills.csv"), help="table, a row a kill")
    given = parser.parse_args()
    os.environ |= {"MLFLOW_DISABLE_TELEMETRY": "true", "DO_NOT_TRACK": "true", "MPLBACKEND": "agg"}
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    for module in HEAVY:
        importlib.import_module(module)
    gc.freeze()
    out = given.out.resolve()
    out.parent.mkdir(parents=True, exist_ok=True)
    missing = Counter((STAGES[k % len(STAGES)], SIGNALS[k // len(STAGES) % len(SIGNALS)]) for k in range(given.kills))
    with tempfile.TemporaryDirectory(prefix="kills-") as scratch:
        bad = rounds(missing, random.Random(given.seed), Path(scratch), out)
    print(f"{given.kills} kills, {bad} of them bad: {out}")
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
