"""Published results: a rerun leaves them as they are, and a check says whether they are those of
today.
"""

import json
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import yaml
from refusals import refusal
from safetensors import safe_open
from safetensors.numpy import load, load_file, save_file

from place import PIPELINE, Place, run_vehest, undrawn
from vehest.artefacts.artefact import TIMINGS, read_artefact
from vehest.run import published as study_keys
from vehest.run import report as report_stage
from vehest.run.publishing import PROVENANCE, published_content
from vehest.run.versions import VERSIONS, code_of
from vehest.run.weights import uncompressed

pytestmark = pytest.mark.apart

QUICK = PIPELINE | {
    "publish": True,
    "sweeps": [
        ["estimator=luenberger", "training.grid=1", "training.max_evaluations=5"],
        ["estimator=gru", "estimator.n_states=2", "seed=0,1", "training.max_epochs=2"],
    ],
}
RUN = ("run", "small", "tracking=none")
CHECK = ("report", "--check")
TIME_NAMES = ("seconds", "[ms]", "## Times")


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """A folder with a small study that was run and published."""
    folder = tmp_path_factory.mktemp("published")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("VEHEST_DATA", str(folder / "raw"))
        patch.delenv("VEHEST_OUTPUT", raising=False)
        undrawn(patch)
        place = Place(folder, SimpleNamespace(readouterr=lambda: ("", "")))
        place.change("pipelines/small.yaml", **QUICK)
        assert place(*RUN)[0] == 0
    return folder


@pytest.fixture
def checked(published, place):
    """The same study in a folder of its own, without the output root: what is checked needs no
    models.
    """
    for name in ("conf", "pipelines", "raw", "results"):
        shutil.rmtree(place.folder / name, ignore_errors=True)
        shutil.copytree(published / name, place.folder / name)
    return place


@pytest.fixture
def copied(published, place, monkeypatch):
    """The same study with its output root in a folder of its own."""
    shutil.rmtree(place.folder)
    shutil.copytree(published, place.folder)
    monkeypatch.chdir(place.folder)
    return place


def contents(folder):
    return {
        file.relative_to(folder).as_posix(): file.read_bytes()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


def verdict(place, *words):
    """Exit code and outcome of a check of one study; it needs no output root and makes none."""
    code, out, err = place(*CHECK, *words)
    assert not (place.folder / "outputs").exists()
    assert err == ""
    return code, out.strip()


def test_numbers_are_published_with_six_digits_and_everything_else_as_it_is(tmp_path, published):
    file = tmp_path / "table.csv"
    cells = [
        "0.7459900813211685",
        "-1.2345678e-07",
        "1234567.0",
        "7",
        "0.10",
        "",
        '"0.0123456789, 2"',
        "nan",
        "1e-05",
    ]
    file.write_text("a,b,c,d,e,f,g,h,i\n" + ",".join(cells) + "\n", encoding="utf-8")
    expected = ["0.74599", "-1.23457e-07", *cells[2:]]
    assert published_content(file).decode() == "a,b,c,d,e,f,g,h,i\n" + ",".join(expected) + "\n"
    (report,) = (published / "outputs" / "report").iterdir()
    published_here, published_there = (
        pd.read_csv(folder / "metrics.csv")["value"]
        for folder in (report, published / "results" / "small")
    )
    np.testing.assert_allclose(published_there, published_here, rtol=5e-6)
    assert (published_there != published_here).any()


def test_times_are_in_no_published_file_but_beside_the_page_and_on_it(published):
    (report,) = (published / "outputs" / "report").iterdir()
    timings = pd.read_csv(report / TIMINGS)
    metrics = pd.read_csv(published / "results" / "small" / "metrics.csv")
    assert set(timings["metric"]) >= {"train_seconds", "step_seconds"}
    assert (timings["value"] > 0).all()
    assert list(timings.columns) == list(metrics.columns)
    assert (
        len(timings[(timings["estimator"] == "gru") & (timings["metric"] == "train_seconds")]) == 2
    )
    page = (report / "report.html").read_text(encoding="utf-8")
    assert all(words in page for words in ("<h2>Times</h2>", "online step [ms]"))
    texts = {
        name: content.decode(errors="replace")
        for name, content in contents(published / "results" / "small").items()
        if not name.endswith(".png")
    }
    assert TIMINGS not in texts
    for name, text in texts.items():
        words = [word for word in TIME_NAMES if word in text]
        assert not words or (name, words) == ("tables/ranges.csv", ["seconds"]), (
            name
        )  # how long the ranges of the drive are


def test_a_rerun_leaves_the_work_tree_clean(published, monkeypatch, capsys):
    undrawn(monkeypatch)
    monkeypatch.chdir(published)
    monkeypatch.setenv("VEHEST_DATA", str(published / "raw"))
    monkeypatch.delenv("VEHEST_OUTPUT", raising=False)
    before = contents(published / "results")
    assert {
        "small/report.md",
        "small/metrics.csv",
        f"small/{PROVENANCE}",
        "small/figures/learning.svg",
    } <= set(before)
    for command in (
        ["init", "--quiet"],
        ["add", "results"],
        ["-c", "user.name=a", "-c", "user.email=a", "commit", "--quiet", "-m", "a"],
    ):
        subprocess.run(["git", *command], check=True)
    (report,) = (published / "outputs" / "report").iterdir()
    timings = (report / TIMINGS).read_bytes()
    code, _, err = run_vehest(capsys, *RUN, "--force")
    assert code == 0, err
    assert (report / TIMINGS).read_bytes() != timings, "it was trained again"
    assert contents(published / "results") == before
    status = subprocess.run(
        ["git", "status", "--short", "--", "results"], capture_output=True, text=True, check=True
    )
    assert (status.stdout, run_vehest(capsys, *CHECK)[:2]) == ("", (0, "small: up to date\n"))
    shutil.rmtree(published / ".git")  # which other tests copy


def other_code_of(changed):
    return lambda stage, name="", **options: (
        "other" if stage == changed else code_of(stage, name, **options)
    )


def test_equal_results_of_other_code_are_recorded_as_of_that_code(copied, monkeypatch):
    place = copied
    shutil.rmtree(place.folder / "outputs" / "finished")
    monkeypatch.setattr(study_keys, "code_of", other_code_of("ingest"))
    before = contents(place.folder / "results" / "small")
    assert (place(*CHECK)[:2], place(*RUN)[0]) == ((3, "small: stale: code (ingest mine)\n"), 0)
    after = contents(place.folder / "results" / "small")
    assert [name for name in before if after[name] != before[name]] == [PROVENANCE]
    assert place(*CHECK)[:2] == (0, "small: up to date\n")


def test_published_results_are_up_to_date_by_study_and_by_file(
    checked,
):
    for words in (
        [],
        ["small"],
        ["pipelines/small.yaml"],
        ["small", f"root={checked.folder / 'raw'}"],
    ):
        assert verdict(checked, *words) == (0, "small: up to date")
    checked.change(
        "pipelines/small.yaml",
        sweeps=[QUICK["sweeps"][0], [*QUICK["sweeps"][1], "training.checkpoint_seconds=1"]],
    )
    checked.change("conf/dataset/mine.yaml", citation="somebody else")
    assert verdict(checked) == (0, "small: up to date")
    checked.change("conf/split/mine.yaml", tests={"test": [{"recording": "three", "stop": 20}]})
    checked.change("conf/dataset/mine.yaml", title="Another title")
    assert verdict(checked) == (3, "small: stale: configuration (split)")


def test_changed_code_and_changed_data_are_distinguished(checked, monkeypatch):
    with open(checked.folder / "raw" / "two.csv", "a") as stream:
        stream.write("\n")
    assert verdict(checked) == (3, "small: stale: data (ingest mine)")
    with monkeypatch.context() as patch:
        patch.setattr(study_keys, "code_of", other_code_of("report"))
        assert verdict(checked) == (3, "small: stale: code (report), data (ingest mine)")
    shutil.rmtree(checked.folder / "raw")
    assert verdict(checked) == (0, "small: up to date: data not checked, raw files not here: mine")
    checked.change("conf/dataset/mine.yaml", vehicle="another car")
    assert verdict(checked) == (
        3,
        "small: stale: configuration (ingest mine); data not checked, raw files not here: mine",
    )


def test_state_is_undetermined_without_keys_pipeline_or_results(checked):
    file = checked.folder / "results" / "small" / PROVENANCE
    about = json.loads(file.read_text())
    file.write_text(json.dumps({name: value for name, value in about.items() if name != "keys"}))
    assert verdict(checked) == (
        3,
        "small: not known: published before keys were recorded; run it again",
    )
    file.write_text(json.dumps(about))
    (checked.folder / "pipelines" / "small.yaml").rename(
        checked.folder / "pipelines" / "renamed.yaml"
    )
    assert verdict(checked) == (0, "small: up to date"), "a file's name determines no number"
    (checked.folder / "pipelines" / "renamed.yaml").unlink()
    assert verdict(checked) == (3, "small: not known: there is no pipeline that publishes 'small'")
    assert (
        verdict(checked, "quickstart")[1]
        == "quickstart: not known: there is nothing in 'results/quickstart' that vehest published"
    )


def test_pipeline_that_cannot_be_run_is_stale(
    checked,
):
    for words, code, says in (
        (("report",), 2, "no pipeline is named; there are:"),
        ((*CHECK, "smal"), 4, "there is no pipeline 'smal'; did you mean pipelines/small.yaml?"),
        ((*CHECK, "small", "seed=7"), 2, "'seed=7' changes the results"),
    ):
        checked.refused(*words, code=code, says=says)
    checked.change("pipelines/small.yaml", sweeps=[["estimator=luenberger", "training.nothing=1"]])
    code, line = verdict(checked)
    message = (
        "small: stale: configuration (pipeline); today it cannot be run (unknown option "
        "'training.nothing'"
    )
    assert (code, line.startswith(message)) == (3, True)
    shutil.rmtree(checked.folder / "results")
    checked.refused(*CHECK, code=4, says="no study is published in 'results'")


def models(folder):
    """Files of every model in an output root, but those with times."""
    weights = {
        model.name: contents(model)
        for model in (folder / "outputs" / "train").iterdir()
        if not model.name.startswith(".")
    }
    return {
        name: {
            file: content
            for file, content in files.items()
            if file not in (TIMINGS, "manifest.json")
        }
        for name, files in weights.items()
    }


def test_a_run_elsewhere_takes_the_published_weights_and_comes_to_the_same_results(
    published, checked
):
    before = contents(checked.folder / "results")
    _, output = checked.once(*RUN)
    assert "3 of 3 taken from results/small/weights.safetensors" in " ".join(output.split())
    assert models(checked.folder) == models(published)
    assert contents(checked.folder / "results") == before


def test_published_weights_are_used_for_their_key_alone(
    checked,
):
    pipeline = checked.change("pipelines/small.yaml")
    checked.change(
        "pipelines/small.yaml",
        sweeps=[QUICK["sweeps"][0], [*QUICK["sweeps"][1][:-1], "training.max_epochs=1"]],
    )
    _, output = checked.done(*RUN)
    assert ("1 of 3 taken from" in " ".join(output.split()), output.count("1 epochs")) == (True, 2)
    checked.change("pipelines/small.yaml", **pipeline)
    _, output = checked.done(*RUN, "--retrain", "output=again")
    assert ("taken from" in output, output.count("2 epochs")) == (False, 2)
    file = checked.folder / "results" / "small" / "weights.safetensors"
    file.write_bytes(file.read_bytes()[:100])
    code, _, err = checked(*RUN, "output=damaged")
    assert (
        code,
        "weights.safetensors' is damaged" in " ".join(err.split()),
        "--retrain" in err,
    ) == (3, True, True)


def test_weights_that_were_changed_after_they_were_published_are_refused_by_name(checked):
    file = checked.folder / "results" / "small" / "weights.safetensors"
    before = contents(checked.folder / "results")
    with safe_open(file, framework="np") as opened:
        metadata = opened.metadata()
    larger = {n: np.asarray(1.2 * v, v.dtype) for n, v in load_file(file).items()}
    save_file(larger, file, metadata=metadata)
    code, _, err = checked(*RUN)
    message = " ".join(err.split())
    assert code == 3
    assert "weights.safetensors' was changed after it was published: luenberger" in message
    assert "git checkout results/small" in message
    assert not list((checked.folder / "outputs").glob("train/*"))
    models = json.loads(metadata["models"])
    for model in models.values():
        plain = uncompressed(model["files"]["history.csv"]).decode()
        assert "train_loss" in plain
        model["files"]["history.csv"] = plain.replace("train_loss", "loss")
    texts = {"models": json.dumps(models)}
    save_file(load(before["small/weights.safetensors"]), file, metadata=texts)
    code, _, err = checked(*RUN)
    assert (code, "was changed after it was published" in " ".join(err.split())) == (3, True)


def test_changed_files_of_an_output_root_are_named_and_recomputed(checked):
    checked.once(*RUN)
    output = checked.folder / "outputs"
    before = {}
    for manifest in sorted(output.glob("*/[!.]*/manifest.json")):
        for name in json.loads(manifest.read_text())["outputs"]:
            file = manifest.parent / name
            data = file.read_bytes()
            spoilt = data[:-2] + bytes([data[-2] ^ 1]) + data[-1:]
            file.write_bytes(spoilt)
            message = refusal(lambda manifest=manifest: read_artefact(manifest.parent))
            assert f"'{file}' was changed after it was made" in message
            file.write_bytes(data)
            before[file] = data
    stages = {file.relative_to(output).parts[0] for file in before}
    assert {"ingest", "downsample", "train", "evaluate", "report"} <= stages
    spoilt = {}
    for file, data in before.items():
        stage, artefact, *_ = file.relative_to(output).parts
        if stage != "report" and (stage, artefact) not in spoilt:
            spoilt[stage, artefact] = file
            file.write_bytes(data[:-2] + bytes([data[-2] ^ 1]) + data[-1:])
    pipeline = checked.folder / "pipelines" / "small.yaml"
    pipeline.write_text(pipeline.read_text() + "# so that the run looks at everything\n")
    _, message = checked.done(*RUN)
    assert "damaged, and not used" in " ".join(message.split())
    for file in spoilt.values():
        assert read_artefact(output / Path(*file.relative_to(output).parts[:2]))
        if file.suffix in (".safetensors", ".yaml", ".parquet") or file.name == "metrics.csv":
            assert file.read_bytes() == before[file], file


def listed(place, **reasons):
    """Exit code and outcome of a check beside a list of studies that may be stale."""
    place.change("results/stale.yaml", **reasons)
    return verdict(place)


def test_a_stale_study_passes_only_while_it_is_listed(checked):
    assert listed(checked, small="it is run again") == (
        3,
        "small: up to date: may be until it is run again; it is up to date; "
        "remove it from 'results/stale.yaml'",
    )
    checked.change(
        "pipelines/small.yaml",
        sweeps=[QUICK["sweeps"][0], [*QUICK["sweeps"][1], "training.learning_rate=0.002"]],
    )
    code, line = verdict(checked)
    assert (code, "stale: configuration (train gru); may be until it is run again" in line) == (
        0,
        True,
    )
    (checked.folder / "results" / "stale.yaml").unlink()
    assert verdict(checked) == (3, "small: stale: configuration (train gru)")
    code, out = verdict(checked, "--json")
    study = {
        "study": "small",
        "state": "stale",
        "changes": [{"what": "train gru", "cause": "configuration"}],
        "note": "",
        "n_not_trained": 0,
        "failure": "it is not in 'results/stale.yaml'",
        "may_be_stale": "",
    }
    assert (code, json.loads(out)) == (3, [study])


def test_a_listed_study_of_other_stages_is_not_composed(checked, monkeypatch):
    monkeypatch.setitem(VERSIONS, "calibrate", "another")
    monkeypatch.delattr(study_keys, "jobs_of")
    code, line = listed(checked, small="bands are calibrated again")
    assert code == 0
    assert line.startswith("small: stale: code (calibrate luenberger, calibrate gru); may be until")


def test_a_deleted_study_does_not_end_its_entry(checked):
    code, out = listed(checked, removed="it is run again")
    assert code == 3
    assert "removed: not known: nothing is published, which does not end its entry" in out
    checked.change("results/stale.yaml", removed=None)
    checked.refused(*CHECK, code=2, says="'results/stale.yaml' must give a reason for each study")


def test_results_of_a_work_tree_with_changes_are_not_published(copied):
    place = copied
    author = ("-c", "user.name=a", "-c", "user.email=a")
    for command in (["init", "-q"], ["add", "conf", "pipelines"], [*author, "commit", "-qm", "a"]):
        subprocess.run(["git", *command], check=True)
    metrics = place.folder / "results" / "small" / "metrics.csv"
    metrics.write_text("changed\n")
    pipeline = place.folder / "pipelines" / "small.yaml"
    pipeline.write_text(pipeline.read_text() + "# a change\n")
    code, _, err = place(*RUN)
    assert code == 0, err
    assert "not published: the work tree has changes that are not committed" in err
    assert "(pipelines/small.yaml); commit them and run it again" in err
    assert metrics.read_text() == "changed\n"
    code, _, err = place(*RUN, "--force", "--publish-weights")
    assert code == 2
    assert "error: --publish-weights: the work tree has changes" in err
    subprocess.run(["git", *author, "commit", "-qam", "b"], check=True)
    place.done(*RUN)
    assert metrics.read_text() != "changed\n"


def test_an_edited_template_draws_the_report_again_and_makes_nothing_stale(
    copied, monkeypatch, tmp_path
):
    """The report of the old text was published again, as no key had the template in it."""
    place = copied
    shutil.rmtree(place.folder / "outputs" / "finished")
    module_folder = tmp_path / "study"
    module_folder.mkdir()
    template = module_folder / "report.md.j2"
    digests = []
    for text in ("**Question.** Which?", "**Question.** Which estimator?"):
        template.write_text(text, encoding="utf-8")
        with monkeypatch.context() as patch:
            study = SimpleNamespace(__file__=str(module_folder / "document.py"))
            patch.setattr(report_stage, "study_module", {"small": study}.get)
            digests.append(report_stage.template_digests("small"))
    assert [list(digest) for digest in digests] == [["report.md.j2"]] * 2
    assert digests[0] != digests[1]
    folder = place.folder / "outputs" / "report"
    assert len(list(folder.iterdir())) == 1
    monkeypatch.setattr(report_stage, "template_digests", lambda name: digests[1])
    place.done(*RUN)
    assert len(list(folder.iterdir())) == 2
    assert place(*CHECK)[:2] == (0, "small: up to date\n")


def test_the_list_of_stale_studies_only_shrinks():
    may_be_listed = {
        "cnn_ukf",
        "heavy_ekf",
        "ksnn",
        "learned_ukf",
        "leave_one_out",
        "reference_minutes",
        "sim_to_real",
        "trust",
    }
    results = Path(__file__).parents[2] / "results"
    entries = yaml.safe_load((results / "stale.yaml").read_text(encoding="utf-8"))
    # Tables of other commands were not compared at all before they had records (`table_records`).
    may_be_listed |= {"examples", "export", "own_car", "reliability", "unseen_car"}
    # learned_ukf_sim ended with its pipeline: untrained, and learned_ukf is the same on real tyre
    # sets.
    assert not (results / "learned_ukf_sim").exists()
    assert set(entries) <= may_be_listed
    assert [name for name in may_be_listed if not (results / name / PROVENANCE).is_file()] == [], (
        "deleting a study does not end its entry"
    )
