"""A queue that answers to SLURM's commands and runs two jobs at a time on this machine: enough of
them for submitit.

Jobs stand in a folder as files: ``ID_INDEX.json`` with state and process. `install` writes the
commands, which call this file.
"""

import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

COMMANDS = ("sbatch", "srun", "sacct", "scancel", "scontrol")
AT_A_TIME = 2
MOMENT = 0.05


def install(folder):
    """Write the commands; returns the environment in which they are found."""
    commands = folder / "bin"
    commands.mkdir(parents=True)
    for name in COMMANDS:
        file = commands / name
        file.write_text(
            f'#!/bin/sh\nexec "{sys.executable}" "{Path(__file__).resolve()}" '
            f'"{folder}" {name} "$@"\n'
        )
        file.chmod(0o755)
    return {"PATH": f"{commands}{os.pathsep}{os.environ['PATH']}"}


def _file(folder, job):
    """File of a job in the queue."""
    return folder / f"{job}.json"


def _set(folder, job, **values):
    """Change entries of a job, in one step for whoever reads it."""
    file = _file(folder, job)
    former = json.loads(file.read_text()) if file.is_file() else {}
    aside = file.with_suffix(f".{os.getpid()}")
    aside.write_text(json.dumps({**former, **values}))
    aside.replace(file)


def states(folder):
    """Job -> state."""
    return {file.stem: json.loads(file.read_text())["state"] for file in folder.glob("*.json")}


def sbatch(folder, script):
    """Queue the jobs of an array, each with a process that waits for its turn."""
    array_range = re.search(r"^#SBATCH --array=0-(\d+)", Path(script).read_text(), re.MULTILINE)
    job = str(1 + max((int(name.partition("_")[0]) for name in states(folder)), default=0))
    for job_id in (
        [f"{job}_{index}" for index in range(int(array_range[1]) + 1)] if array_range else [job]
    ):
        _set(folder, job_id, state="PENDING")
        words = [sys.executable, __file__, str(folder), "turn", script, job_id]
        subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    print(f"Submitted batch job {job}")


def turn(folder, script, job_id):
    """Run one job when there is room, and again whenever it is put back."""
    job, _, index = job_id.partition("_")
    variables = {"JOB_ID": job_id, "PROCID": "0", "LOCALID": "0", "NTASKS": "1", "NODEID": "0"}
    variables |= {"ARRAY_JOB_ID": job, "ARRAY_TASK_ID": index} if index else {}
    environment = {
        **os.environ,
        **{f"SLURM_{name}": value for name, value in variables.items()},
        "SLURM_JOB_NUM_NODES": "1",
    }
    while True:
        while sum(state == "RUNNING" for state in states(folder).values()) >= AT_A_TIME:
            time.sleep(MOMENT)
        if states(folder)[job_id] == "CANCELLED":
            return
        _set(folder, job_id, state="RUNNING")
        process = subprocess.Popen(["bash", script], env=environment, start_new_session=True)
        _set(folder, job_id, process=process.pid)
        code = process.wait()
        if states(folder)[job_id] != "REQUEUED":
            break
    if states(folder)[job_id] != "CANCELLED":
        _set(folder, job_id, state="COMPLETED" if code == 0 else "FAILED")


def srun(folder, *words):
    """Become the command behind the options."""
    command = list(words)
    while command[0].startswith("--"):
        takes_value = command.pop(0) in ("--output", "--error")
        if takes_value:
            command.pop(0)
    os.execvp(command[0], command)


def sacct(folder, *_):
    """List all jobs."""
    print("JobID|State|NodeList")
    for job, state in states(folder).items():
        print(f"{job}|{state}|here")


def scancel(folder, *words):
    """End a job."""
    job = words[-1]
    _set(folder, job, state="CANCELLED")
    with suppress(KeyError, ProcessLookupError):
        os.killpg(json.loads(_file(folder, job).read_text())["process"], signal.SIGKILL)


def scontrol(folder, verb, job):
    """Put a job back into the queue."""
    assert verb == "requeue"
    _set(folder, job, state="REQUEUED")


if __name__ == "__main__":
    globals()[sys.argv[2]](Path(sys.argv[1]), *sys.argv[3:])
