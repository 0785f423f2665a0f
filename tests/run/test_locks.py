"""Two runs in one output root: each artefact and each MLflow run once, the same numbers as alone,
nobody waits for ever.
"""

import os
import signal
import subprocess
import sys
from contextlib import contextmanager

import pytest

from processes import start
from vehest.artefacts.artefact import StagePlan, read_artefact
from vehest.artefacts.locks import Lock, held
from vehest.run import group
from vehest.run.group import locked_jobs
from vehest.run.train import TrainJob

pytestmark = pytest.mark.apart

HOLDER = """
import sys
from pathlib import Path
from vehest.artefacts.locks import Lock
lock = Lock(Path(sys.argv[1]), sys.argv[2], sys.argv[3])
print(lock.take(), flush=True)
sys.stdin.read()
"""


@contextmanager
def locked_by_process(output, stage, name):
    """A process of its own that holds a lock until it is ended."""
    command = [sys.executable, "-c", HOLDER, str(output), stage, name]
    process = start(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "True\n"
        yield process
    finally:
        process.kill()
        process.communicate()


def test_lock_ends_with_its_process_and_waiting_names_the_holder_once(
    tmp_path,
):
    lock = Lock(tmp_path, "train", "a model")
    messages = []
    answers = iter([False, False, True])
    with locked_by_process(tmp_path, "train", "a model") as holder:
        assert not lock.take()
        assert lock.holder.startswith(f"process {holder.pid} on ")
        with held(
            Lock(tmp_path, "train", "a model"), lambda: next(answers), messages.append
        ) as mine:
            assert not mine
        assert [
            (waiting.stage, waiting.label, str(holder.pid) in waiting.holder)
            for waiting in messages
        ] == [("train", "a model", True)]
        os.kill(holder.pid, signal.SIGKILL)
        holder.wait()
        assert lock.take()
    lock.release()


def test_a_single_process_compiles_for_calibration_and_others_wait(tmp_path, monkeypatch):
    monkeypatch.setattr(group, "has_to_compile", lambda kernel: kernel == group.FLOOR_KERNEL)
    answers = iter([False, False, True])
    with (
        locked_by_process(tmp_path, "compile", "health"),
        group.compile_lock(tmp_path, lambda: next(answers)),
    ):
        assert next(answers, "all") == "all"
    monkeypatch.setattr(group, "has_to_compile", lambda kernel: False)
    with (
        locked_by_process(tmp_path, "compile", "health"),
        group.compile_lock(tmp_path, pytest.fail),
    ):
        pass


def test_names_invalid_for_files_are_separate_locks(tmp_path):
    first = Lock(tmp_path, "train", "../a/b")
    second = Lock(tmp_path, "train", ".._a_b")
    assert first.take()
    assert second.take()
    assert not Lock(tmp_path, "train", "../a/b").take()
    assert {file.parent for file in tmp_path.rglob("*.lock")} == {tmp_path / "locks"}
    first.release()
    second.release()


def test_group_trains_free_jobs_first_and_waits_without_locks(tmp_path):
    plans = [
        StagePlan("train", f"model-seed{seed}", {"seed": seed}, {}, "code", tmp_path)
        for seed in range(3)
    ]
    jobs = [TrainJob(plan, {}, {}, None, seed, {}) for seed, plan in enumerate(plans)]
    first = jobs[0].plan.lock
    second = jobs[1].plan.lock
    assert first.take()
    with locked_jobs(jobs, lambda: False, pytest.fail) as free:
        assert [job.seed for job in free] == [1, 2]
        assert not second.take()
    assert second.take(), "a group that is done with its members holds none"

    messages = []

    def others_end(waiting):
        messages.append(waiting)
        first.release()

    with locked_jobs(jobs[:2], lambda: False, others_end) as free:
        assert [job.seed for job in free] == [0]
    assert [waiting.label for waiting in messages] == [jobs[0].plan.folder.name]
    with locked_jobs(jobs[1:2], lambda: True, messages.append) as free:
        assert free == [], "who is asked to stop waits no longer"
    second.release()


COMMAND = [sys.executable, "-m", "vehest"]


def test_runs_wait_for_artefacts_of_another_run_and_continue(place):
    assert place("ingest", "mine")[0] == 0
    [folder] = (place.folder / "outputs" / "ingest").iterdir()
    with locked_by_process(place.folder / "outputs", "ingest", folder.name) as holder:
        waiting = start(
            [*COMMAND, "ingest", "mine", "--force"],
            stderr=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        line = waiting.stderr.readline()
        assert line.split()[:3] == ["waiting", "ingest", folder.name]
        assert f"process {holder.pid} on " in line
        os.kill(holder.pid, signal.SIGKILL)
        assert waiting.communicate()[1].startswith("done")
    assert waiting.returncode == 0


@pytest.mark.parametrize(
    ("stage", "number", "code"), [("ingest", signal.SIGINT, 130), ("train", signal.SIGTERM, 143)]
)
def test_a_run_that_waits_stops_at_once_and_leaves_nothing(place, stage, number, code):
    command = (
        ["ingest", "mine"]
        if stage == "ingest"
        else ["train", "split=mine", "training.max_epochs=1", "tracking=none"]
    )
    assert place(*command)[0] == 0
    before = place.files()
    [folder] = (place.folder / "outputs" / stage).iterdir()
    with locked_by_process(place.folder / "outputs", stage, folder.name):
        waiting = start(
            [*COMMAND, *command, "--force"],
            stderr=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        while "waiting" not in (line := waiting.stderr.readline()):
            assert line, "it ended without waiting"
        waiting.send_signal(number)
        waiting.communicate()
        assert waiting.returncode == code
    assert place.files() - before == set()


SIDE_BY_SIDE = """
import os, sys
from vehest.cli import main
import vehest.run.study_run, vehest.studies.drive, vehest.report.document, mlflow

def run(output, said, gate):
    os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT), 2)
    os.dup2(2, 1)
    os.read(gate, 1)
    sys.argv = ["vehest", "run", "small", "--jobs", "1", f"output={output}"]
    try:
        main()
    except SystemExit as leave:
        os._exit(int(leave.code or 0))
    except BaseException:
        os._exit(99)
    os._exit(0)

def at_once(count, output):
    gate, opens = os.pipe()
    runs = []
    for number in range(count):
        process = os.fork()
        if not process:
            os.close(opens)
            run(output, f"said-{output}-{number}", gate)
        runs.append(process)
    os.write(opens, b"x" * count)
    return [os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) for process in runs]

print(at_once(1, "alone"), at_once(3, "together"))
"""


def test_three_runs_at_once_make_each_artefact_and_mlflow_run_once(
    place,
):
    from mlflow import MlflowClient

    done = subprocess.run(
        [sys.executable, "-c", SIDE_BY_SIDE], capture_output=True, text=True, check=False
    )
    outputs = {file.name: file.read_text() for file in place.folder.glob("said-*")}
    assert done.stdout == "[0] [0, 0, 0]\n", (done.stderr, outputs)
    alone = place.folder / "alone"
    together = place.folder / "together"
    assert _contents(together) == _contents(alone)
    lines = [
        line.split()
        for text in outputs.values()
        for line in text.splitlines()
        if line.startswith("done")
    ]
    computed = [tuple(words[1:3]) for words in lines]
    assert len(computed) == 2 * len(set(computed)), (
        "each is computed once alone and once by one of the three"
    )
    client = MlflowClient(f"sqlite:///{together / 'mlflow.db'}")
    all_runs = client.search_runs([client.get_experiment_by_name("vehest").experiment_id])
    runs = [run for run in all_runs if run.data.tags["vehest.stage"] != "study"]
    assert len(all_runs) == len(runs) + 1, "and one above them"
    tracked = _artefacts(together, ("train", "calibrate", "evaluate"))
    assert sorted(run.data.tags["vehest.key"] for run in runs) == sorted(
        artefact.key for artefact in tracked
    )
    assert {run.info.status for run in runs} == {"FINISHED"}
    assert not list((together / "checkpoints").rglob("*"))


def test_recomputed_trainings_leave_their_evaluation_up_to_date(place):
    arguments = ("split=mine", "training.max_epochs=1", "tracking=none")
    place.told("train", *arguments)
    assert [
        place.told(*words)["skipped"]
        for words in (("eval", *arguments), ("train", *arguments, "--force"))
    ] == [False, False]
    evaluated = place.told("eval", *arguments)
    assert evaluated["skipped"] is True
    assert min(evaluated["train_seconds.test"], evaluated["step_seconds.test"]) > 0


def _artefacts(output, stages):
    return [
        read_artefact(folder) for stage in stages for folder in sorted((output / stage).iterdir())
    ]


def _contents(output):
    return {
        artefact.folder.name: artefact.digest
        for artefact in _artefacts(
            output, ("ingest", "downsample", "train", "calibrate", "evaluate")
        )
    }
