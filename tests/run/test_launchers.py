"""What launchers share: packing by recorded times, what a study would cost, artefacts in a store, paths of another machine."""

from __future__ import annotations

import importlib.util
import json
import os
import time
from collections import deque
from dataclasses import replace
from pathlib import Path

import pytest

from vehest.data import files
from vehest.data.errors import ConfigurationError, MissingError
from vehest.data.files import ASIDE_PREFIX, aside_of, remove_leftovers
from vehest.run import console
from vehest.run.artefacts import MANIFEST, Artefact, StagePlan, find, make
from vehest.run.console import Messages
from vehest.run.failures import Failure
from vehest.run.group import Group
from vehest.run.launchers.base import LocalLauncher, chosen_launcher
from vehest.run.launchers.on_slurm import slurm_parameters
from vehest.run.launchers.options import LauncherOptions
from vehest.run.launchers.progress import LaunchProgress
from vehest.run.launchers.store import Store
from vehest.run.launchers.times import Times, next_lot
from vehest.run.launchers.worker import World, moved
from vehest.run.signals import StopSignals
from vehest.run.train import TrainJob
from vehest.training.checkpoints import Checkpoint, load_checkpoint, save_checkpoint

FINE = Messages(silent=True)


def job(output: Path, seed: int = 0, *, variant: str = "small", epochs: int = 10, **training: object) -> TrainJob:
    config = {
        "estimator": {"name": "net", "kind": variant},
        "training": {"max_epochs": epochs},
        "seed": seed,
        "train": [],
        "validation": [],
    }
    plan = StagePlan("train", f"net-{variant}-seed{seed}", config, {}, "code", output)
    return TrainJob(plan, config["estimator"], {**config["training"], **training}, None, seed, {})  # type: ignore[arg-type]


def trained(own: TrainJob, seconds: float, text: str = "weights") -> Artefact:
    def write(folder: Path) -> None:
        (folder / "model.safetensors").write_text(text)
        (folder / "fit.csv").write_text("metric,value\nepochs,3\n")
        (folder / "timings.csv").write_text(f"metric,value\ntrain_seconds,{seconds}\n")

    return make(own.plan, write)


# Packing


def test_lots_keep_the_order_and_last_as_long_as_they_should():
    seconds = [4.0, 4.0, 4.0, 25.0, 1.0, 1.0]
    waiting, lots = deque(range(6)), []
    while waiting:
        lots.append(next_lot(waiting, seconds.__getitem__, 10.0))
    assert lots == [[0, 1, 2], [3], [4, 5]]


def test_a_training_takes_what_its_own_kind_took_then_its_variant_then_its_family_and_is_else_a_guess(tmp_path):
    trained(job(tmp_path, 0, epochs=10), 3.0)
    trained(job(tmp_path, 1, epochs=10), 5.0)
    trained(job(tmp_path, 0, epochs=99), 40.0)
    times = Times(tmp_path)
    assert (times.cost_of(job(tmp_path, 7, epochs=10)).seconds, times.cost_of(job(tmp_path, 7, epochs=10)).basis) == (4.0, "same")
    assert (times.cost_of(job(tmp_path, 7, epochs=50)).seconds, times.cost_of(job(tmp_path, 7, epochs=50)).basis) == (5.0, "variant")
    assert times.cost_of(job(tmp_path, variant="large")).basis == "estimator"
    assert Times(tmp_path / "fresh").cost_of(job(tmp_path)).basis == "guess"


def test_a_guess_gives_way_to_what_the_first_groups_took(tmp_path):
    times = Times(tmp_path)
    first = Group([job(tmp_path, 0), job(tmp_path, 1)])
    other = Group([job(tmp_path, 0, variant="large")])
    assert times.seconds_of(first) == 2 * times.seconds_of(other) == 20.0
    times.learn(first, 3.0)
    assert times.seconds_of(other) == 1.5


# What a study would cost


# How far a launch is


def test_standing_counts_and_estimates_the_end():
    now = iter([0.0])
    standing = LaunchProgress(10, clock=lambda: next(now, 5.0))
    standing.runs(0)
    standing.runs(1)
    assert (standing.running, standing.waiting, standing.seconds_left(2)) == (2, 8, None)
    standing.ended(0, 10.0, failed=False)
    standing.ended(1, 20.0, failed=True)
    assert (standing.done, standing.failed, standing.waiting) == (1, 1, 8)
    assert standing.seconds_left(4) == 8 * 15.0 / 4
    assert standing.row(4)["core hours"] == "0.008"
    assert LaunchProgress(1).row(4) == {}


def test_no_more_bars_are_drawn_than_fit_a_terminal(monkeypatch):
    with FINE.bars() as bars:
        for number in range(console.MOST_BARS + 5):
            bars.fit(f"training {number}", None)
        assert len(bars._tasks) == console.MOST_BARS


# The store


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(f"file://{tmp_path / 'store'}")


def test_an_artefact_comes_back_from_the_store_with_its_digest(store, tmp_path):
    made = trained(job(tmp_path / "here"), 1.0)
    store.push(made)
    plan = replace(job(tmp_path / "there").plan, output=tmp_path / "there")
    found = store.fetch("train", plan.folder)
    assert found is not None
    assert (found.digest, found.key) == (made.digest, plan.key)
    assert find(plan) is not None
    assert store.fetch("train", tmp_path / "there" / "train" / "other-000000000000") is None


def test_files_of_equal_content_are_kept_once(store, tmp_path):
    for seed in range(3):
        store.push(trained(job(tmp_path / "here", seed), 1.0))
    assert len(list((tmp_path / "store" / "objects").rglob("*/*"))) == 3
    assert len(list((tmp_path / "store" / "artefacts" / "train").iterdir())) == 3


def test_what_was_damaged_in_the_store_counts_as_not_there_and_is_put_there_anew(store, tmp_path):
    made = trained(job(tmp_path / "here"), 1.0)
    store.push(made)
    digest = made.outputs["model.safetensors"]
    kept = tmp_path / "store" / "objects" / digest[:2] / digest
    kept.write_text("weightz")
    target = tmp_path / "there" / "train" / made.folder.name
    assert store.fetch("train", target) is None
    assert not target.exists()
    store.push(made)
    assert store.fetch("train", target) is not None


def test_a_manifest_that_names_files_outside_of_its_folder_brings_nothing(store, tmp_path):
    made = trained(job(tmp_path / "here"), 1.0)
    manifest = json.loads((made.folder / MANIFEST).read_text())
    manifest["outputs"]["../../escaped"] = manifest["outputs"].pop("model.safetensors")
    store.push(made)
    (tmp_path / "store" / "artefacts" / "train" / f"{made.folder.name}.json").write_text(json.dumps(manifest))
    assert store.fetch("train", tmp_path / "there" / "train" / made.folder.name) is None
    assert not list(tmp_path.rglob("escaped"))


def test_a_digest_that_is_a_path_removes_nothing(store, tmp_path):
    precious = tmp_path / "home" / "precious.txt"
    precious.parent.mkdir()
    precious.write_text("precious")
    made = trained(job(tmp_path / "here"), 1.0)
    store.push(made)
    (tmp_path / "store" / "objects" / "..").mkdir(parents=True, exist_ok=True)
    manifest = json.loads((made.folder / MANIFEST).read_text())
    for up in range(1, 6):
        manifest["outputs"]["model.safetensors"]["sha256"] = "../" * up + "home/precious.txt"
        (tmp_path / "store" / "artefacts" / "train" / f"{made.folder.name}.json").write_text(json.dumps(manifest))
        assert store.fetch("train", tmp_path / "there" / "train" / made.folder.name) is None
    assert precious.read_text() == "precious"
    (made.folder / MANIFEST).write_text(json.dumps(manifest))
    assert find(job(tmp_path / "here").plan) is None


def test_the_checkpoint_that_is_further_on_counts(store, tmp_path):
    import torch

    def at(epoch: int) -> Checkpoint:
        return Checkpoint({"w": torch.zeros(2)}, {"epoch": epoch})

    here, there = tmp_path / "a" / "model", tmp_path / "b" / "model"
    save_checkpoint(here, at(5))
    store.push_checkpoint(here)
    store.fetch_checkpoint(there)
    assert load_checkpoint(there).values["epoch"] == 5  # type: ignore[union-attr]
    save_checkpoint(there, at(9))
    store.fetch_checkpoint(there)
    assert load_checkpoint(there).values["epoch"] == 9  # type: ignore[union-attr]
    store.drop_checkpoint(here)
    store.fetch_checkpoint(tmp_path / "c" / "model")
    assert not (tmp_path / "c" / "model").exists()


@pytest.mark.parametrize("address", ["ftp://host/folder", "folder", "file://", "s3:///"])
def test_an_address_that_is_none_is_refused(address):
    with pytest.raises(ConfigurationError, match="--store must be"):
        Store(address)


def test_a_store_that_cannot_be_written_to_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(MissingError, match="write") as error:
        Store(f"file://{tmp_path / 'file' / 'store'}").push(trained(job(tmp_path / "here"), 1.0))
    assert "\n" not in str(error.value)


# Paths, machines and choices


def test_a_group_moves_to_another_root_and_back_with_the_same_keys(tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    group = Group([job(here, start_from=str(here / "train" / "model"))])
    gone = moved(group, here, there)
    assert gone.jobs[0].plan.folder.is_relative_to(there)
    assert gone.jobs[0].training["start_from"] == str(there / "train" / "model")
    assert gone.jobs[0].plan.key == group.jobs[0].plan.key
    assert moved(gone, there, here) == group


def test_what_another_host_writes_is_left_alone_for_a_day(tmp_path, monkeypatch):
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


def test_other_code_or_libraries_are_named():
    here = World("a", {"torch": "2", "python": "3.11"}, "zen")
    assert here.differs(World("a", {"torch": "2", "python": "3.11"}, "skylake")) == ""
    assert "other code of vehest" in here.differs(World("b", here.libraries, "zen"))
    assert "torch 1 instead of 2" in here.differs(World("a", {"torch": "1", "python": "3.11"}, "zen"))


def test_options_of_a_cluster_are_refused_elsewhere(place):
    code, line = place.refused("run", "small", "--slurm", "minutes=5")
    assert code == 2
    assert "--slurm is for --launcher slurm, not for local" in line
    assert "--launcher must be one of local, ray, slurm" in place.refused("sweep", "split=mine", "--launcher", "dask")[1]


def test_without_ray_one_line_says_how_to_get_it(place, monkeypatch):
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "ray" else real(name, *rest))
    code, line = place.refused("run", "small", "--launcher", "ray")
    assert code == 4
    assert "pip install 'vehest[ray]'" in line


def test_the_local_launcher_hands_back_failures_as_values(tmp_path):
    launcher = chosen_launcher(LauncherOptions(), 1, tmp_path, FINE)
    assert isinstance(launcher, LocalLauncher)
    group = Group([job(tmp_path)])
    (done,) = launcher.launch([group], StopSignals(), lambda *_: None)
    assert isinstance(done.outcome, Failure)


# Options of launchers


@pytest.mark.parametrize(
    ("where", "says"),
    [
        (LauncherOptions("cloud"), "--launcher must be one of local, ray, slurm, not 'cloud'"),
        (LauncherOptions("local", address="auto"), "--address is for --launcher ray and slurm, not for local"),
        (LauncherOptions("slurm", store="file:///x"), "--store is for --launcher ray, not for slurm"),
        (LauncherOptions("ray", slurm=("minutes=5",)), "--slurm is for --launcher slurm, not for ray"),
        (LauncherOptions("slurm", address="host:6379"), "must be left out for --launcher slurm, or be 'local'"),
        (LauncherOptions("slurm", "local", slurm=("minutes=soon",)), "--slurm minutes must be a positive number, not 'soon'"),
        (LauncherOptions("slurm", "local", slurm=("nodes=4",)), "--slurm 'nodes=4' must be NAME=VALUE with one of the names account"),
    ],
)
def test_options_that_a_launcher_does_not_take_are_refused(where, says, tmp_path):
    with pytest.raises(ConfigurationError) as told:
        chosen_launcher(where, None, tmp_path, FINE)
    assert says in str(told.value)
    assert not list(tmp_path.iterdir())


def test_what_jobs_ask_of_slurm_has_the_names_of_submitit():
    asked = slurm_parameters(["partition=long", "minutes=90.4", "memory_gb=1.5"])
    assert asked == {"slurm_partition": "long", "timeout_min": 90, "mem_gb": 1.5, "cpus_per_task": 1, "name": "vehest"}


def test_without_slurm_a_line_says_where_to_run(tmp_path, monkeypatch):
    pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(MissingError, match="there is no SLURM here"):
        chosen_launcher(LauncherOptions("slurm"), None, tmp_path, FINE)
