"""Tasks in processes of this machine: one that is killed fails its own task, and Ctrl-C ends all
while they start.
"""

import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from processes import end_all, is_alive, start, wait_for
from vehest.run.failures import Failure
from vehest.run.launchers.local import launch
from vehest.run.signals import StopSignals

DRIVER = """
import sys
from vehest.run.launchers.local import launch
from vehest.run.signals import Stopped, StopSignals


def task(should_stop, on_progress):
    return "done"


if __name__ == "__main__":
    stop = StopSignals()
    try:
        with stop.installed():
            print("installed", flush=True)
            outcomes = [done.outcome for done in launch([task] * 8, 2, stop, lambda *_: None)]
            stop.raise_if_requested()
    except Stopped as stopped:
        sys.exit(stopped.exit_code)
"""

SLOW_IMPORTS = """
import signal, time

signal.signal(signal.SIGINT, signal.default_int_handler)
if __name__ == "__mp_main__":
    print("imports", flush=True)
    try:
        signal.pause()
    except KeyboardInterrupt:
        time.sleep(1.0)
        raise
"""
ENDS = 60.0  # s within which an interrupted run has to end


def killed(should_stop, on_progress, others_run):
    """Kill this process once another task runs."""
    wait_for(others_run.exists)
    os.kill(os.getpid(), signal.SIGKILL)


def outlives(should_stop, on_progress, others_run, other_failed):
    """Run until the other task has failed."""
    others_run.touch()
    wait_for(other_failed.exists)
    return "outlived"


def quick(should_stop, on_progress):
    return "quick"


def until_stopped(should_stop, on_progress):
    wait_for(should_stop)
    return "best so far"


def test_killed_workers_fail_only_their_task(tmp_path):
    others_run = tmp_path / "others_run"
    other_failed = tmp_path / "other_failed"
    tasks = [
        partial(killed, others_run=others_run),
        partial(outlives, others_run=others_run, other_failed=other_failed),
        *[quick] * 4,
    ]
    outcomes = {}
    for done in launch(tasks, 2, StopSignals(), lambda *_: None):
        outcomes[done.position] = done.outcome
        if isinstance(done.outcome, Failure):
            other_failed.touch()
    failure = outcomes.pop(0)
    assert outcomes == {1: "outlived", 2: "quick", 3: "quick", 4: "quick", 5: "quick"}
    assert failure.message == (
        "a worker process was ended by SIGKILL; if memory ran out, --jobs 1 needs less; "
        "the same command goes on"
    )


def test_workers_that_all_die_fail_every_task_once():
    outcomes = [
        done.outcome
        for done in launch([partial(killed, others_run=Path("/"))] * 3, 2, StopSignals(), _ignore)
    ]
    assert [type(outcome) for outcome in outcomes] == [Failure] * 3


def _ignore(*_):
    pass


def test_a_stop_ends_running_tasks_with_their_outcome_and_begins_no_other():
    stop = StopSignals()
    begun = []

    def report(position, progress):
        begun.append(position)
        if len(begun) == 2:
            stop.number = signal.SIGTERM

    done = list(launch([until_stopped] * 5, 2, stop, report))
    assert sorted(begun) == [0, 1]
    assert {entry.position: entry.outcome for entry in done} == dict.fromkeys((0, 1), "best so far")


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_ctrl_c_while_workers_start_ends_them_all(tmp_path):
    """The terminal sends it to every process: here six times, as soon as one or two workers can be
    seen.
    """
    script = tmp_path / "driver.py"
    script.write_text(DRIVER, encoding="utf-8")
    try:
        for number in range(6):
            log = tmp_path / f"{number}.log"
            with open(log, "wb") as stream:
                process = start([sys.executable, script], stdout=stream, stderr=subprocess.STDOUT)
            wait_for(lambda log=log: "installed" in log.read_text(), process, log.read_text)
            workers = wait_for(
                lambda process=process, number=number: _workers(process.pid, 1 + number % 2),
                process,
                log.read_text,
            )
            os.killpg(process.pid, signal.SIGINT)
            wait_for(lambda process=process: process.poll() is not None)
            assert process.returncode == 130
            assert log.read_text() == "installed\n", "no worker prints a traceback"
            wait_for(lambda workers=workers: not any(map(is_alive, workers)))
    finally:
        end_all()


def test_ctrl_c_while_workers_import_ends_them_all(tmp_path):
    """Workers that Ctrl-C reached and that took a moment to end left tasks behind that nobody
    ended.
    """
    script = tmp_path / "driver.py"
    script.write_text(SLOW_IMPORTS + DRIVER, encoding="utf-8")
    log = tmp_path / "log"
    try:
        with open(log, "wb") as stream:
            process = start([sys.executable, script], stdout=stream, stderr=subprocess.STDOUT)
        wait_for(lambda: log.read_text().count("imports\n") == 2, process, log.read_text)
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(ENDS) == 130
        assert log.read_text() == "installed\nimports\nimports\n", "no worker prints a traceback"
    finally:
        end_all()


def _workers(parent, number):
    """Worker processes of a parent once there are as many."""
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text(encoding="utf-8").split()
    workers = [
        child for child in children if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()
    ]
    return workers if len(workers) >= number else []
