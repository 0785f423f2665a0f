"""SLURM jobs against the local launcher: by processes that submitit starts itself, and by a queue
that answers to SLURM's commands.
"""

import importlib.util
import os
import signal

import pytest
from pretended_slurm import install, scancel, states
from test_two_nodes import FORTY, LONGER, Alone, alone, folder  # noqa: F401
from two_nodes import Driver, metrics, under_way, weights, with_recordings

pytestmark = [
    pytest.mark.cluster,
    pytest.mark.skipif(
        importlib.util.find_spec("submitit") is None,
        reason="submitit is not installed: pip install 'vehest[slurm]'",
    ),
]


@pytest.fixture
def queue(tmp_path):
    """A folder for a queue; the jobs in it end with the test."""
    yield tmp_path / "queue"
    for job in states(tmp_path / "queue"):
        scancel(tmp_path / "queue", job)


def with_a_checkpoint(output, but=None):
    """A training under way, of another process than that of an entry."""
    return next(
        (entry for entry in under_way(output) if but is None or entry["pid"] != but["pid"]), None
    )


def test_processes_of_this_machine_equal_the_local_launcher(folder, alone, tmp_path):  # noqa: F811
    output = with_recordings(alone["forty"], tmp_path / "out")
    Driver(
        folder, output, "sweep", *FORTY, "--launcher", "slurm", "--address", "local", "-j", "2"
    ).ends()
    assert metrics(output) == metrics(alone["forty"])
    assert weights(output) == weights(alone["forty"])
    assert not list(output.glob("clusters/*")), "what was handed over is forgotten"


def test_a_queue_gives_the_same_although_a_job_dies_and_another_is_put_back(
    folder,  # noqa: F811
    alone,  # noqa: F811
    queue,
    tmp_path,
):
    output = with_recordings(alone["longer"], tmp_path / "out")
    environment = install(queue)
    driver = Driver(
        folder,
        output,
        "sweep",
        *LONGER,
        "--launcher",
        "slurm",
        "--slurm",
        "minutes=10",
        **environment,
    )
    lost = driver.sees(lambda: with_a_checkpoint(output))
    os.kill(lost["pid"], signal.SIGKILL)
    put_back = driver.sees(lambda: with_a_checkpoint(output, but=lost))
    os.kill(put_back["pid"], signal.SIGUSR2)
    driver.ends()
    assert metrics(output) == metrics(alone["longer"])
    assert weights(output) == weights(alone["longer"])
    assert "its job ended without an outcome" in driver.said
    assert set(states(queue).values()) <= {"COMPLETED", "FAILED"}


def test_ctrl_c_takes_jobs_back_until_the_next_call(folder, alone, queue, tmp_path):  # noqa: F811
    output = with_recordings(alone["longer"], tmp_path / "out")
    environment = install(queue)
    driver = Driver(folder, output, "sweep", *LONGER, "--launcher", "slurm", **environment)
    driver.sees(lambda: with_a_checkpoint(output))
    driver.process.send_signal(signal.SIGINT)
    driver.ends(130)
    Driver(folder, output, "sweep", *LONGER, "--launcher", "slurm", **environment).ends()
    assert metrics(output) == metrics(alone["longer"])


def test_a_queue_that_takes_no_more_jobs_ends_the_command_and_the_next_call_goes_on(
    folder,  # noqa: F811
    alone,  # noqa: F811
    queue,
    tmp_path,
):
    output = with_recordings(alone["longer"], tmp_path / "out")
    environment = install(queue)
    sbatch = queue / "bin" / "sbatch"
    takes_jobs = sbatch.read_text()
    driver = Driver(folder, output, "sweep", *LONGER, "--launcher", "slurm", **environment)
    lost = driver.sees(lambda: with_a_checkpoint(output))
    sbatch.write_text("#!/bin/sh\necho 'sbatch: error: the account is out of hours' >&2\nexit 1\n")
    os.kill(lost["pid"], signal.SIGKILL)
    driver.ends(4)
    assert "error: SLURM takes no jobs" in driver.said.rstrip().splitlines()[-1]
    assert "out of hours" in driver.said
    assert "Traceback" not in driver.said
    sbatch.write_text(takes_jobs)
    Driver(folder, output, "sweep", *LONGER, "--launcher", "slurm", **environment).ends()
    assert metrics(output) == metrics(alone["longer"])
