"""Pruning lists artefacts that no current configuration can reuse, and nothing else."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from place import run_vehest
from vehest.artefacts.artefact import StagePlan, make
from vehest.data.files import ASIDE_PREFIX
from vehest.run.ingest import PARTS_PREFIX
from vehest.run.prune import DAMAGED, LEFT_OVER, ORPHANED, OUTDATED, SUPERFLUOUS, unused_artefacts
from vehest.run.versions import code_of


class Root:
    """An output root with artefacts that hold next to nothing."""

    def __init__(self, output):
        self.output = output
        dataset = {"source": "tabular"}
        self.ingested = self.add(
            "ingest", "drives", dataset, {"lap.csv": "raw"}, code_of("ingest", "tabular")
        )
        self.rated = self.add(
            "downsample", "drives-20hz", {}, dict(self.ingested.outputs), code_of("downsample")
        )
        name = "luenberger"
        self.model = self.add(
            "train",
            "one",
            {"estimator": {"name": name}},
            {"drives/lap": "gone"},
            code_of("train", name),
        )
        of_model = {"model": self.model.digest}
        self.trusted = self.add("calibrate", "one-trust", {}, of_model, code_of("calibrate", name))
        of_both = of_model | {"calibration": self.trusted.digest}
        self.scored = self.add("evaluate", "one-on-mine", {}, of_both, code_of("evaluate", name))

    def add(self, stage, label, config, inputs, code):
        """Make an artefact with one file, whose content is its label."""
        plan = StagePlan(stage, label, config, inputs, code, self.output)
        return make(plan, lambda folder: (folder / "content").write_text(label) and None)

    def listed(self):
        """Path in the root."""
        return {
            Path(listed["path"]).relative_to(self.output).as_posix(): listed["reason"]
            for listed in unused_artefacts(self.output)
        }


@pytest.fixture
def root(tmp_path):
    return Root(tmp_path / "outputs")


def name_of(artefact):
    return f"{artefact.stage}/{artefact.folder.name}"


def test_artefacts_of_present_versions_stay(root):
    assert root.listed() == {}
    inputs = {
        artefact.folder.name: artefact.digest
        for artefact in (root.model, root.trusted, root.scored)
    }
    root.add("report", "mine", {"module": "drive"}, inputs, code_of("report", "drive"))
    root.add("evaluate", "faulted", {"faults": []}, {}, f"{root.scored.code} faults=3")
    root.add(
        "train",
        "theirs",
        {"estimator": {"name": "somebody_elses"}},
        {},
        "train=1 somebody_elses=1 training=1",
    )
    assert root.listed() == {}


def test_artefacts_of_other_code_are_listed(root):
    old = root.add(
        "train", "one", {"estimator": {"name": "luenberger"}}, {"drives/lap": "gone"}, "0" * 16
    )
    older = root.add("ingest", "drives", {"source": "tabular"}, {}, "ingest=0 tabular=1")
    assert root.listed() == {name_of(older): OUTDATED, name_of(old): OUTDATED}


def test_artefacts_without_their_model_or_calibration_are_unused(
    root,
):
    shutil.rmtree(root.trusted.folder)
    assert root.listed() == {name_of(root.scored): ORPHANED}
    root.trusted = root.add(
        "calibrate", "one-trust", {}, {"model": root.model.digest}, root.trusted.code
    )
    shutil.rmtree(root.model.folder)
    assert root.listed() == {name_of(root.trusted): ORPHANED, name_of(root.scored): ORPHANED}


def test_damaged_recordings_are_unused_and_outdated_ones_keep_their_artefacts(root):
    manifest = root.ingested.folder / "manifest.json"
    manifest.write_text(manifest.read_text().replace(root.ingested.code, "0" * 16))
    assert root.listed() == {name_of(root.ingested): OUTDATED}
    (root.rated.folder / "content").unlink()
    assert root.listed() == {name_of(root.ingested): OUTDATED, name_of(root.rated): DAMAGED}


def test_only_checkpoints_of_finished_models_are_listed(root):
    for name in (root.model.folder.name, "another-seed0-0123456789ab"):
        (root.output / "checkpoints" / name).mkdir(parents=True)
        (root.output / "checkpoints" / name / "checkpoint.safetensors").write_text("state")
    assert root.listed() == {f"checkpoints/{root.model.folder.name}": SUPERFLUOUS}


def test_files_of_killed_processes_are_listed_and_of_living_ones_are_not(root):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    dead = root.output / "train" / f"{ASIDE_PREFIX}{ended.pid}-1-one"
    living = root.output / "train" / f"{ASIDE_PREFIX}{os.getpid()}-1-one"
    for folder in (dead, living):
        folder.mkdir()
    parts = root.ingested.folder.with_name(f"{PARTS_PREFIX}{root.ingested.folder.name}")
    unfinished = parts.with_name(f"{PARTS_PREFIX}other-0123456789ab")
    for folder in (parts, unfinished):
        folder.mkdir()
    assert root.listed() == {f"train/{dead.name}": LEFT_OVER, f"ingest/{parts.name}": LEFT_OVER}


def test_links_and_foreign_files_stay(root, tmp_path):
    elsewhere = Root(tmp_path / "elsewhere")
    old = elsewhere.add("train", "old", {"estimator": {"name": "luenberger"}}, {}, "0" * 16)
    (root.output / "train" / old.folder.name).symlink_to(old.folder)
    (root.output / "report").symlink_to(elsewhere.output / "train")
    mine = root.output / "train" / "notes-0123456789ab"
    mine.mkdir()
    (mine / "manifest.json").write_text("mine")
    renamed = root.output / "train" / "my_favourite-0123456789ab"
    os.rename(
        root.add("train", "renamed", {"estimator": {"name": "luenberger"}}, {}, "0" * 16).folder,
        renamed,
    )
    assert root.listed() == {}


def test_yes_removes_the_listed_artefacts_and_a_dry_run_nothing(elsewhere, root, capsys):
    outdated = root.add("train", "one", {"estimator": {"name": "luenberger"}}, {}, "0" * 16).folder
    code, out, err = run_vehest(capsys, "prune", "--dry-run")
    assert (code, OUTDATED in out, "1 to remove" in out) == (0, True, True), err
    for options in ((), ("--json",)):
        code, _, err = run_vehest(capsys, "prune", *options)
        assert (code, "--yes" in err, outdated.is_dir()) == (2, True, True)
    code, out, err = run_vehest(capsys, "prune", "--yes", "--json")
    assert code == 0, err
    outcome = json.loads(out)
    assert outcome["removed"] == [row["path"] for row in outcome["found"]]
    assert outcome["bytes"] > 0
    assert {path.name for path in outdated.parent.iterdir()} == {root.model.folder.name}
    assert run_vehest(capsys, "prune")[1] == "nothing to remove\n"
