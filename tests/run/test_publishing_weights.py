"""Weights are published training by training: a study that was stopped goes on elsewhere, and
trains only what is missing.
"""

import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from place import write_drives
from vehest.artefacts.artefact import read_artefact
from vehest.data.files import ASIDE_PREFIX
from vehest.data.text_files import read_json
from vehest.run import downsample, runner, weights
from vehest.run.weights import PublishedWeights, WeightsTooLargeError

pytestmark = pytest.mark.apart

GRU = ["estimator=gru", "estimator.n_states=2", "seed=0,1", "training.max_epochs=2"]
LUENBERGER = ["estimator=luenberger", "training.grid=1", "training.max_evaluations=5"]
RUN = ("run", "pair", "tracking=none", "--publish-weights", "--jobs", "1")
FILE = "results/pair/weights.safetensors"


@pytest.fixture
def pair(place):
    """A place with a study of two parts, each of a training and a group of two seeds."""
    write_drives(place.folder, 60.0)
    for name, train, test in (("forth", "one", "three"), ("back", "three", "one")):
        place.change(
            f"conf/split/{name}.yaml",
            name=name,
            dataset="mine",
            train=[{"recording": train}],
            validation=[{"recording": "two"}],
            tests={"unseen": [{"recording": test}]},
        )
    parts = {
        name: {"title": name, "split": name, "sweeps": [LUENBERGER, GRU]}
        for name in ("forth", "back")
    }
    place.change("pipelines/pair.yaml", study="pair", report="transfer", publish=True, parts=parts)
    return place


def digests(output):
    """Folder of a training -> digest of its weights."""
    return {
        folder.name: read_artefact(folder).outputs["model.safetensors"]
        for folder in (output / "train").iterdir()
    }


def models_published(pair):
    """Models in the file of published weights."""
    return PublishedWeights(pair.folder / FILE).models


def stop_once_published(patch, n_models):
    """Send Ctrl-C after so many models have been published."""

    def publish_weights(published, *arguments):
        has_room = publish(published, *arguments)
        if len(published.models) >= n_models:
            os.kill(os.getpid(), signal.SIGINT)
        return has_room

    publish = runner.publish_weights
    patch.setattr(runner, "publish_weights", publish_weights)


def test_stopped_study_continues_with_missing_trainings(pair, monkeypatch):
    with monkeypatch.context() as patch:
        stop_once_published(patch, 4)
        code, _, _ = pair(*RUN)
    assert code == 128 + signal.SIGINT
    assert sorted(os.listdir("results/pair")) == ["weights.safetensors"]
    assert len(models_published(pair)) == 4
    assert len(digests(pair.folder / "outputs")) == 4
    shutil.rmtree("outputs")
    _, err = pair.done(*RUN)
    message = " ".join(err.split())
    assert "3 of 3 taken from results/pair/weights.safetensors" in message
    assert "1 of 3 taken from results/pair/weights.safetensors" in message
    assert err.count("epochs,") == 2
    resumed = pair.folder / "outputs"
    published = {
        file.name: file.read_bytes()
        for file in (pair.folder / "results/pair").iterdir()
        if file.is_file()
    }
    shutil.rmtree("results")
    pair.done(*RUN[:3], "output=uninterrupted")
    assert digests(resumed) == digests(pair.folder / "uninterrupted")
    assert len(digests(resumed)) == 6
    for name in set(published) - {"provenance.json"}:
        assert (pair.folder / "results/pair" / name).read_bytes() == published[name], name


def test_models_are_taken_where_another_processor_rounds_recordings_otherwise(pair, monkeypatch):
    pair.done(*RUN)
    published = models_published(pair)
    shutil.rmtree("outputs")

    def resampled_elsewhere(recording, rate_hz, options):
        result = resampled(recording, rate_hz, options)
        channels = {name: np.nextafter(values, np.inf) for name, values in result.channels.items()}
        return replace(result, channels=channels)

    resampled = downsample.resampled
    monkeypatch.setattr(downsample, "resampled", resampled_elsewhere)
    _, err = pair.done(*RUN[:3])
    message = " ".join(err.split())
    assert "epochs," not in err
    assert message.count("3 of 3 taken from results/pair/weights.safetensors (3 of them were") == 2
    republished = models_published(pair)
    assert not set(republished) & set(published)
    assert sorted(record.digest for record in republished.values()) == sorted(
        record.digest for record in published.values()
    )
    assert {record.origin for record in republished.values()} == {
        record.origin for record in published.values()
    }
    shutil.rmtree("outputs")
    _, err = pair.done(*RUN)
    assert "added to" not in err
    assert models_published(pair).keys() == republished.keys()


def test_models_of_a_killed_run_are_published_by_the_next(pair, monkeypatch):
    pair.done(*RUN[:3])
    former = models_published(pair)
    report = (pair.folder / "results/pair/report.md").read_bytes()
    pipeline = pair.change("pipelines/pair.yaml")
    pipeline["parts"]["back"]["sweeps"] = [[*GRU[:2], "seed=2", GRU[3]]]
    pair.change("pipelines/pair.yaml", parts=pipeline["parts"])
    with monkeypatch.context() as patch:
        stop_once_published(patch, 7)
        assert pair(*RUN)[0] == 128 + signal.SIGINT
    assert models_published(pair).items() > former.items()
    assert (pair.folder / "results/pair/report.md").read_bytes() == report
    (pair.folder / FILE).unlink()
    _, err = pair.done(*RUN)
    assert "epochs," not in err
    assert "3 models added to results/pair/weights.safetensors" in " ".join(err.split())
    assert len(models_published(pair)) == 4  # the report is published anew


def test_the_best_so_far_of_an_interrupted_training_is_not_published(pair, monkeypatch):
    def report(self, groups, bars, at, news):
        if getattr(news, "epoch", 0) == 1 and groups[at].name.startswith("gru"):
            os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(runner.Runner, "_report", report)
        code, _, err = pair(*RUN)
    assert (code, "the best so far is kept" in " ".join(err.split())) == (130, True)
    labels = [model.label for model in models_published(pair).values()]
    assert labels == ["luenberger-luenberger-seed0"]


def test_weights_above_the_limit_are_refused_and_the_file_stays(pair, monkeypatch):
    first, second, *remaining = trained(pair)
    file = pair.folder / "some" / "weights.safetensors"
    published = PublishedWeights(file)
    assert published.add([first]) == 1
    before = file.read_bytes()
    monkeypatch.setattr(weights, "MAX_MEGABYTES", len(before) / 1e6)
    assert published.add([first]) == 0
    with pytest.raises(WeightsTooLargeError, match=r"MB of weights are more than the 0\.0"):
        published.add([second, *remaining])
    assert (os.listdir(file.parent), file.read_bytes()) == ([file.name], before)
    assert list(published.models) == [first.key]
    _, err = pair.done(*RUN)
    message = " ".join(err.split())
    assert message.count("no more weights are published") == 1
    assert "the report is published without weights" in message
    assert not (pair.folder / FILE).exists()
    assert (pair.folder / "results/pair/report.md").is_file()


def test_contents_are_compressed_and_earlier_plain_ones_are_read(monkeypatch):
    content = ("epoch,train_loss\n" + 500 * "1,0.25\n").encode()
    text = weights.compressed(content)
    assert len(text) < len(content) / 10
    assert weights.uncompressed(text) == weights.uncompressed(content.decode()) == content
    monkeypatch.setattr(weights, "MAX_FILE_BYTES", len(content) - 1)
    for damaged in (text, text[:-8], weights.COMPRESSED + "bm90IHpsaWI=", "zlib,*"):
        with pytest.raises(ValueError, match="compressed file"):
            weights.uncompressed(damaged)


def trained(pair):
    """The models of the study, which was run without being published."""
    pair.change("pipelines/pair.yaml", publish=False)
    pair.once(*RUN[:3])
    pair.change("pipelines/pair.yaml", publish=True)
    return [read_artefact(folder) for folder in sorted((pair.folder / "outputs/train").iterdir())]


KILLED = """
import os, signal, sys
from pathlib import Path
from vehest.data import files
from vehest.artefacts.artefact import read_artefact
from vehest.run.weights import PublishedWeights
weights = PublishedWeights(Path(sys.argv[1]))
when, replace = sys.argv[3], os.replace
def killed(*paths):
    if when == "after":
        replace(*paths)
    os.kill(os.getpid(), signal.SIGKILL)
os.replace = killed
weights.add([read_artefact(Path(sys.argv[2]))])
"""


@pytest.mark.parametrize("when", ["before", "after"])
def test_a_kill_while_writing_leaves_the_file_of_before_or_after(pair, when):
    first, second, *_ = trained(pair)
    file = pair.folder / "some" / "weights.safetensors"
    PublishedWeights(file).add([first])
    before = file.read_bytes()
    words = [sys.executable, "-c", KILLED, str(file), str(second.folder), when]
    assert subprocess.run(words, check=False).returncode == -signal.SIGKILL
    published = PublishedWeights(file)
    if when == "before":
        assert file.read_bytes() == before
        assert any(name.startswith(ASIDE_PREFIX) for name in os.listdir(file.parent))
        assert published.add([second]) == 1
    assert published.add([first, second]) == 0
    assert os.listdir(file.parent) == [file.name]


def test_publishing_changed_results_or_to_another_place_is_refused(pair):
    pair.refused(*RUN, "training.max_epochs=1", code=2, says="leave out 'training.max_epochs=1'")
    pair.change("pipelines/pair.yaml", publish=False)
    pair.refused(*RUN, code=2, says="it needs publish: true")
    pair.change("pipelines/pair.yaml", publish=True)
    foreign = pair.folder / "results" / "pair" / "notes.txt"
    foreign.parent.mkdir(parents=True)
    foreign.write_text("mine", encoding="utf-8")
    pair.refused(*RUN, code=2, says="holds files that vehest did not publish")


PUBLISH = (*RUN[:3], "--no-train-missing", "--jobs", "1")


def published_files(pair):
    folder = pair.folder / "results/pair"
    return {
        file.relative_to(folder).as_posix(): file.read_bytes()
        for file in folder.rglob("*")
        if file.is_file() and file.name != "provenance.json"
    }


def report_message(pair):
    return (pair.folder / "results/pair/report.md").read_text()


def test_a_study_is_published_with_its_trainings_and_names_the_missing_ones(pair, monkeypatch):
    with monkeypatch.context() as patch:
        stop_once_published(patch, 3)
        pair(*RUN)
    assert len(models_published(pair)) == 3
    shutil.rmtree("outputs")
    pair.change("results/stale.yaml", pair="its second part is not trained")
    _, err = pair.done(*PUBLISH)
    assert "epochs," not in err, "nothing is trained"
    message = " ".join(err.split())
    assert "3 of 6 not done" in message
    assert "vehest run pair tracking=none --train-missing" in message
    assert "nothing could be trained or scored: back" in report_message(pair)
    assert read_json(pair.folder / "results/pair/provenance.json")["n_not_trained"] == 3
    incomplete = published_files(pair)

    code, out, _ = pair("report", "--check")
    assert (code, "pair: up to date: published without 3 trainings" in out) == (0, True)
    pipeline = pair.change("pipelines/pair.yaml")
    changed = [LUENBERGER, [*GRU[:3], "training.max_epochs=3"]]
    parts = pipeline["parts"] | {"back": pipeline["parts"]["back"] | {"sweeps": changed}}
    pair.change("pipelines/pair.yaml", parts=parts)
    stale = "pair: stale: configuration (back: train gru); published without 3"
    assert stale in pair("report", "--check")[1]
    pair.change("pipelines/pair.yaml", **pipeline)
    (pair.folder / "results/stale.yaml").unlink()
    code, out, _ = pair("report", "--check")
    assert code == 3, "an incomplete study has to be listed with its reason"

    shutil.rmtree("outputs")
    _, err = pair.done(*RUN[:3])
    assert "epochs," not in err, "a fresh clone repeats what is published"
    assert published_files(pair) == incomplete

    _, err = pair.done(*RUN[:3], "--train-missing")
    announced = "note train 3 of 6 are neither here nor published, and are trained"
    assert announced in " ".join(err.split())
    assert err.count("epochs,") == 2, "two seeds of the second part"
    assert "n_not_trained" not in read_json(pair.folder / "results/pair/provenance.json")
    assert pair("report", "--check")[:2] == (0, "pair: up to date\n")
    complete = published_files(pair)
    shutil.rmtree("outputs")
    (pair.folder / FILE).write_bytes(incomplete["weights.safetensors"])
    _, err = pair.done(*PUBLISH)
    refusal = "not published: 'results/pair' shows 3 trainings that this run lacks"
    assert refusal in " ".join(err.split())
    assert report_message(pair).encode() == complete["report.md"]
