"""What launchers share: progress, artefacts that travel, options."""

import importlib.util
import json
import os
import time
from dataclasses import replace

import pytest
from refusals import refusal

from vehest.artefacts.artefact import MANIFEST, StagePlan, find, make, read_artefact
from vehest.data import files
from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.files import ASIDE_PREFIX, aside_of, remove_leftovers
from vehest.data.splits import Span, Split
from vehest.run import console
from vehest.run.console import Messages
from vehest.run.failures import Failure
from vehest.run.group import Group
from vehest.run.launchers.base import RunOptions, chosen_launcher
from vehest.run.launchers.clusters import (
    NotShared,
    pack,
    run_task,
    slurm_parameters,
    task_of,
    unpack,
    versions_here,
)
from vehest.run.launchers.local import LocalLauncher
from vehest.run.signals import StopSignals
from vehest.run.train import TrainJob

FINE = Messages(quiet=True)
SPLIT = Split("any", (), (), {"test": (Span("any", "one", 0.0, 1.0),)})


def job(output, seed=0):
    training = {"max_epochs": 10}
    config = {
        "estimator": {"name": "net", "kind": "small"},
        "training": training,
        "seed": seed,
        "train": [],
        "validation": [],
    }
    return TrainJob(
        StagePlan("train", f"net-seed{seed}", config, {}, "code", output),
        config["estimator"],
        training,
        SPLIT,
        seed,
        {},
    )


def artefact_in(output):
    return make(
        job(output).plan,
        lambda folder: (folder / "model.safetensors").write_text("weights") and None,
    )


def test_progress_has_no_more_bars_than_fit_a_terminal():
    with FINE.bars() as bars:
        for number in range(console.MAX_BARS + 5):
            bars.step(f"training {number}", 0, 1, "starting")
        assert len(bars.tasks) == console.MAX_BARS


def test_artefacts_transfer_with_their_digest_and_damaged_ones_are_refused(tmp_path):
    artefact = artefact_in(tmp_path / "here")
    target = tmp_path / "there" / "train" / artefact.folder.name
    files = pack({artefact.folder})[artefact.folder]
    unpack({target: files})
    assert read_artefact(target).digest == artefact.digest
    with pytest.raises(DataError, match="gone or truncated"):
        unpack(
            {
                tmp_path / "other" / "train" / artefact.folder.name: {
                    **files,
                    "model.safetensors": b"weigh",
                }
            }
        )
    assert not list((tmp_path / "other" / "train").iterdir())


def test_a_digest_that_is_a_path_removes_nothing(tmp_path):
    precious = tmp_path / "home" / "precious.txt"
    precious.parent.mkdir()
    precious.write_text("precious")
    artefact = artefact_in(tmp_path / "here")
    manifest = json.loads((artefact.folder / MANIFEST).read_text())
    manifest["outputs"]["model.safetensors"]["sha256"] = "../home/precious.txt"
    (artefact.folder / MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(DataError, match=r"outputs\.model\.safetensors\.sha256"):
        unpack(
            {
                tmp_path / "there" / "train" / artefact.folder.name: pack({artefact.folder})[
                    artefact.folder
                ]
            }
        )
    assert (find(job(tmp_path / "here").plan), precious.read_text()) == (None, "precious")


def test_a_machine_with_other_versions_or_without_the_output_root_does_nothing(tmp_path):
    spec = replace(
        task_of(0, Group([job(tmp_path)], SPLIT), tmp_path, tmp_path),
        versions={**versions_here(), "torch": "1.0"},
    )
    with pytest.raises(MissingError, match=r"torch .* instead of 1\.0; install the same versions"):
        run_task(spec, {}, lambda: False)
    spec = task_of(
        0,
        Group([job(tmp_path / "out")], SPLIT),
        tmp_path / "out",
        tmp_path / "out" / "clusters" / "run-0",
    )
    with pytest.raises(NotShared):
        run_task(spec, None, lambda: False)
    assert not list(tmp_path.iterdir())


def test_files_of_another_host_are_ignored_for_a_day(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "_host", lambda: "0" * 8)
    growing = aside_of(tmp_path / "model")
    growing.write_text("half")
    old = aside_of(tmp_path / "other")
    old.write_text("half")
    os.utime(old, (time.time() - 2 * files.FOREIGN_SECONDS,) * 2)
    monkeypatch.undo()
    assert growing.name.startswith(f"{ASIDE_PREFIX}{os.getpid()}-00000000")
    assert remove_leftovers(tmp_path) == 1
    assert growing.exists()
    assert not old.exists()


def test_without_ray_a_single_line_names_the_extra_to_install(place, monkeypatch):
    place.refused(
        "sweep",
        "split=mine",
        "--launcher",
        "dask",
        says="--launcher must be one of local, ray, slurm",
    )
    launcher = chosen_launcher(RunOptions(jobs=1), place.folder, FINE)
    assert isinstance(launcher, LocalLauncher)
    (done,) = launcher.launch([Group([job(place.folder)], SPLIT)], StopSignals(), lambda *_: None)
    assert isinstance(done.outcome, Failure)
    real = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name, *arguments: None if name == "ray" else real(name, *arguments),
    )
    place.refused("run", "small", "--launcher", "ray", code=4, says="pip install 'vehest[ray]'")


@pytest.mark.parametrize(
    ("option", "says"),
    [
        (RunOptions(address="auto"), "--address is for --launcher ray and slurm, not for local"),
        (
            RunOptions(launcher="ray", slurm=("minutes=5",)),
            "--slurm is for --launcher slurm, not for ray",
        ),
        (
            RunOptions(launcher="slurm", address="host:6379"),
            "must be left out for --launcher slurm, or be 'local'",
        ),
        (
            RunOptions(launcher="slurm", address="local", slurm=("minutes=soon",)),
            "--slurm minutes must be a positive number, not 'soon'",
        ),
        (
            RunOptions(launcher="slurm", address="local", slurm=("nodes=4",)),
            "--slurm 'nodes=4' must be NAME=VALUE with one of the names account",
        ),
    ],
)
def test_options_that_a_launcher_does_not_take_are_refused(option, says, tmp_path):
    with pytest.raises(ConfigurationError) as error:
        chosen_launcher(option, tmp_path, FINE)
    assert says in str(error.value)
    assert not list(tmp_path.iterdir())


def test_slurm_options_have_the_names_of_submitit(tmp_path, monkeypatch):
    parameters = slurm_parameters(["partition=long", "minutes=90.4", "memory_gb=1.5"])
    assert parameters == {
        "slurm_partition": "long",
        "timeout_min": 90,
        "mem_gb": 1.5,
        "cpus_per_task": 1,
        "name": "vehest",
    }
    pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "there is no SLURM here" in refusal(
        lambda: chosen_launcher(RunOptions(launcher="slurm"), tmp_path, FINE), MissingError
    )
