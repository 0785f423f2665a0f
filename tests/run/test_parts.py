"""A study of several comparisons, each on a split of its own, run from the command line on a small
data set.
"""

import dataclasses
import json
import re
import shutil

import ksnn_tables
import pandas as pd
import pytest

from place import DATASET, write_drives
from vehest.estimators.registry import new_estimator
from vehest.report.document import Document
from vehest.run import runner
from vehest.run.study import jobs_of, read_study
from vehest.studies.artefacts import METRIC_COLUMNS
from vehest_papers.ksnn import paper
from vehest_papers.ksnn.candidates import category_of

pytestmark = pytest.mark.apart

PIPELINE_OF_BOTH = "pipelines/both.yaml"
CANDIDATES = [
    ["estimator=luenberger", "training.grid=1", "training.max_evaluations=20"],
    ["estimator=ksnn", "estimator.n_hidden=0,2", "seed=0,1", "training.max_epochs=2"],
    ["estimator=lstm", "estimator.n_states=2", "training.max_epochs=2"],
]


@pytest.fixture
def parts_place(place):
    """A place whose data set serves two schemes, and a part whose raw files are elsewhere."""
    write_drives(place.folder, 80.0)
    split = place.change("conf/split/mine.yaml")
    tests = {
        "c2": [{"recording": "three", "stop": 40}],
        "f2": [{"recording": "three", "start": 40}],
    }
    for name, train, validation in (("forth", "one", "two"), ("back", "two", "one")):
        settings = {
            "name": name,
            "train": [{"recording": train}],
            "validation": [{"recording": validation}],
            "tests": tests,
        }
        place.change(f"conf/split/{name}.yaml", **split | settings)
    place.change("conf/dataset/other.yaml", **DATASET | {"name": "other", "path": "${root}/other"})
    place.change("conf/split/other.yaml", **split | {"name": "other", "dataset": "other"})
    parts = {
        "scheme_1": {"title": "There", "split": "forth", "sweeps": CANDIDATES},
        "scheme_2": {"title": "Back", "split": "back", "sweeps": CANDIDATES},
        "ferrari_drive": {
            "title": "Elsewhere",
            "split": "other",
            "sweeps": CANDIDATES,
            "optional": True,
        },
    }
    place.change(
        "pipelines/both.yaml",
        study="both",
        title="Both ways",
        report="ksnn",
        publish=True,
        parts=parts,
    )
    place.change(
        "pipelines/turned.yaml",
        based_on="both",
        study="turned",
        publish=False,
        parts={"scheme_1": {"split": "back"}},
    )
    return place


def change_parts(place, change):
    """Write the pipeline anew with what ``change`` makes of its parts."""
    parts = place.change(PIPELINE_OF_BOTH)["parts"]
    place.change(PIPELINE_OF_BOTH, parts=change(parts) or parts)


def test_parts_run_as_a_single_study_and_the_next_run_skips_all(parts_place):
    place = parts_place
    out, err = place.done("run", "both", "--json", "tracking=none")
    assert "goes on without part 'ferrari_drive'" in " ".join(err.split())
    overview = pd.DataFrame(json.loads(out)["overview"])
    assert list(overview["candidate"]) == [
        paper.LUENBERGER,
        paper.LSTM,
        paper.LINEAR,
        paper.NONLINEAR,
    ]
    results = place.folder / "results" / "both"
    metrics = pd.read_csv(results / "metrics.csv")
    assert (set(metrics["trained_on"]), list(metrics.columns)) == (
        {"mine/scheme_1", "mine/scheme_2"},
        list(METRIC_COLUMNS),
    )
    about = json.loads((results / "provenance.json").read_text())
    assert (about["parts"], about["absent"]) == (["scheme_1", "scheme_2"], ["ferrari_drive"])
    report = (results / "report.md").read_text(encoding="utf-8")
    assert report.startswith("# Both ways\n\n**Question.**")
    assert "**Evidence.** SIMULATED data." in report
    assert "Not in this report, since the recordings are missing: Elsewhere" in report
    for target in re.findall(r"\]\((?!\.\.)([^)]+)\)", report):
        assert (results / target).is_file(), target

    assert place("report", "both", "tracking=none")[0] == 0
    files = place.files()
    again, err = place.done("run", "both", "--json", "tracking=none")
    assert json.loads(again)["overview"] == json.loads(out)["overview"]
    warning, line = err.splitlines()
    assert warning.startswith("warning data set 'other'")
    assert line.startswith("reused  ")
    assert {"train", "evaluate", "report"} <= set(line.replace(",", "").split())
    assert place.files() == files

    assert place("report", "--check")[:2] == (0, "both: up to date\n")
    shutil.copytree(place.folder / "raw", place.folder / "raw" / "other")
    assert place("report", "--check")[:2] == (
        3,
        "both: stale: data (ferrari_drive, which was not here)\n",
    )
    shutil.rmtree(place.folder / "raw" / "other")
    sweeps = [*CANDIDATES[:2], ["estimator=lstm", "estimator.n_states=3", "training.max_epochs=2"]]
    change_parts(place, lambda parts: parts["scheme_2"].update(sweeps=sweeps))
    assert place("report", "--check")[:2] == (
        3,
        "both: stale: configuration (scheme_2: train lstm)\n",
    )


def test_planning_opens_each_data_set_once_for_all_parts(parts_place, monkeypatch):
    opened = []

    def counted(dataset):
        opened.append(dataset["name"])
        return open_source(dataset)

    open_source = runner.open_source
    monkeypatch.setattr(runner, "open_source", counted)
    monkeypatch.setattr(runner, "car_of", lambda dataset: counted(dataset).car_after_transforms)
    monkeypatch.setattr(runner.Runner, "run", lambda *_: ({}, {}))
    parts_place("run", "both", "tracking=none")
    # of the files and of the car; the files of the other one are not there
    assert sorted(opened) == ["mine", "mine", "other"]


def test_study_modules_without_an_overview_are_refused(parts_place, monkeypatch):
    monkeypatch.setattr(
        "vehest_papers.ksnn.documents",
        lambda artefacts: {"report": Document(artefacts.title, ["no tables"])},
    )
    parts_place.change(
        PIPELINE_OF_BOTH, parts={"scheme_1": {"split": "forth", "sweeps": CANDIDATES[:1]}}
    )
    code, _, err = parts_place("run", "both", "tracking=none")
    assert (code, "gives no table 'overview'" in " ".join(err.split())) == (2, True)
    assert not list((parts_place.folder / "outputs" / "report").glob("both-*"))


def test_a_run_without_a_part_does_not_replace_a_published_study_that_shows_it(parts_place):
    place = parts_place
    change_parts(
        place,
        lambda parts: [part.update(sweeps=CANDIDATES[::2]) for part in parts.values()] and None,
    )
    shutil.copytree(place.folder / "raw", place.folder / "raw" / "other")
    place.done("run", "both", "tracking=none")
    published = (place.folder / "results" / "both" / "report.md").read_bytes()
    shutil.rmtree(place.folder / "raw" / "other")
    _, out, err = place("run", "both", "--json", "tracking=none")
    assert "not published: 'results/both' shows part 'ferrari_drive'" in " ".join(err.split())
    assert json.loads(out)["published"] is None
    assert (place.folder / "results" / "both" / "report.md").read_bytes() == published
    assert place("report", "--check")[:2] == (
        0,
        "both: up to date: data not checked, raw files not here: other\n",
    )
    change_parts(place, lambda parts: parts["ferrari_drive"].pop("optional") and None)
    place.refused("run", "both", "tracking=none", code=4, says="other")


def test_a_study_of_real_cars_is_nowhere_called_simulated(parts_place):
    for name in ("mine", "other"):
        parts_place.change(f"conf/dataset/{name}.yaml", kind="real")
    quick = [CANDIDATES[0], [*CANDIDATES[1][:2], "training.max_epochs=1"], CANDIDATES[2]]
    additions = {
        name: {"split": "back", "sweeps": CANDIDATES[::2]}
        for name in ("devbot_ferrari", "minutes_5_a")
    }
    change_parts(
        parts_place,
        lambda parts: {name: part | {"sweeps": quick} for name, part in parts.items()} | additions,
    )
    parts_place.done("run", "both", "tracking=none")
    report = (parts_place.folder / "results" / "both" / "report.md").read_text(encoding="utf-8")
    assessed = "\n".join(line for line in report.splitlines() if "| not assessed |" not in line)
    remainder = assessed.replace("pairs of simulated cars", "")  # of the recommendation
    assert "simulated" not in remainder.lower()


def test_pipelines_based_on_another_state_only_changes(parts_place):
    pipeline = read_study("both")
    turned = read_study("turned")
    assert [part.split for part in pipeline.parts.values()] == ["forth", "back", "other"]
    assert [part.split for part in turned.parts.values()] == ["back", "back", "other"]
    assert [part.sweeps for part in turned.parts.values()] == [
        part.sweeps for part in pipeline.parts.values()
    ]
    assert (turned.study, turned.title, turned.publish) == ("turned", "Both ways", False)


def test_the_study_on_the_papers_recordings_trains_as_that_on_simulated_cars():
    simulated = read_study("ksnn").parts
    official = read_study("ksnn_revs").parts
    assert {part.split for part in official.values()} == {
        "cross_vehicle_1",
        "cross_vehicle_2",
        "one_vehicle",
    }
    for name, part in official.items():
        options = [
            {
                option
                for sweep in jobs.sweeps
                for option in sweep
                if option.startswith(("training.", "estimator.window"))
            }
            for jobs in (part, simulated[name])
        ]
        assert options[0] == options[1], name


def test_both_schemes_have_the_39_candidates_of_table_3_ours_and_two_baselines():
    study = read_study("ksnn")
    schemes = ("scheme_1", "scheme_2")
    jobs = jobs_of(
        dataclasses.replace(study, parts={name: study.parts[name] for name in schemes}), []
    )
    configs = {part: [job.config for job in part_jobs] for part, part_jobs in jobs.items()}
    baselines = ("zero", "static_map")
    for scheme in schemes:
        names = [
            (new_estimator(config["estimator"]).name, new_estimator(config["estimator"]).variant)
            for config in configs[scheme]
        ]
        candidates = [
            name
            for name in dict.fromkeys(names)
            if name[0] not in baselines and category_of(*name) != paper.KINEMATIC_GAIN
        ]
        assert (
            {name[0] for name in names} - {name[0] for name in candidates},
            len(candidates),
        ) == (set(baselines), 39)
        assert paper.KINEMATIC_GAIN in {category_of(*name) for name in names}
        categories = [category_of(*name) for name in candidates]
        assert {name: categories.count(name) for name in categories} == {
            name: row.variants for name, row in ksnn_tables.TABLE_III.items()
        }
        assert all(
            names.count(name) == (1 if name[0] == "luenberger" else 3) for name in candidates
        )


@pytest.mark.parametrize(
    ("file", "content", "says"),
    [
        (
            PIPELINE_OF_BOTH,
            {"split": "forth", "sweeps": CANDIDATES},
            "it needs study, report and one of",
        ),
        (PIPELINE_OF_BOTH, {"parts": {}}, "it needs study, report and one of"),
        (
            PIPELINE_OF_BOTH,
            {"parts": {"one": {"split": "forth"}}},
            "part 'one' needs split and sweeps",
        ),
        (PIPELINE_OF_BOTH, {"parts": {"../one": {"split": "forth", "sweeps": CANDIDATES}}}, "part"),
        (
            PIPELINE_OF_BOTH,
            {"report": "drive"},
            "the study module 'drive' draws its report from split and sweeps",
        ),
        (
            "pipelines/x.yaml",
            {"based_on": "turned", "study": "x"},
            "is based on another pipeline itself",
        ),
        (
            "pipelines/x.yaml",
            {"based_on": "no_such", "study": "x"},
            "there is no pipeline 'no_such'",
        ),
        (
            "pipelines/x.yaml",
            {"based_on": "mine", "study": "x"},
            "'mine', only a data set: 'vehest data usable mine' says",
        ),
        (
            "pipelines/x.yaml",
            {"based_on": "both", "study": "x", "parts": {"scheme_3": {"split": "back"}}},
            "part 'scheme_3' needs split and",
        ),
    ],
)
def test_parts_and_bases_that_make_no_sense_are_refused(parts_place, file, content, says):
    parts_place.change(file, **content)
    code, _, err = parts_place("run", file, "tracking=none", "--quiet")
    assert code != 0
    assert says in " ".join(err.split())
    assert "Traceback" not in err
