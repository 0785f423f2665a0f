"""Faults as conditions of an evaluation: their rows, their keys, one training for all of them, and
errors in one line.
"""

import csv
import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from refusals import refusal

from vehest.configuration.composition import compose_config
from vehest.configuration.files import choices, packaged
from vehest.data.errors import ConfigurationError
from vehest.data.store import read_recording
from vehest.run.evaluate_faults import FaultSettings, faults_of, union_of_faults
from vehest.run.study import jobs_of, read_study
from vehest.run.versions import code_of
from vehest.trust.faults import KINDS, is_fault

pytestmark = pytest.mark.apart

TRAINED = ("split=mine", "estimator=kinematic", "tracking=none")
FROZEN = (
    "fault=frozen",
    "fault.channel=yaw_rate",
    "fault.severity=severe",
    "fault.start=8",
    "fault.duration=6",
)
CONDITION = "frozen:yaw_rate:severe"


def evaluated(place, *overrides):
    """Folder and figures of an evaluation."""
    figures = place.told("eval", *TRAINED, *overrides)
    return Path(figures["folder"]), figures


@pytest.fixture
def trained(place):
    """A place with a model."""
    place.once("train", *TRAINED)
    return place


@pytest.mark.parametrize("kind", KINDS)
def test_every_file_is_a_fault_with_every_key_and_a_word_on_each(kind):
    text = (packaged("conf") / "fault" / f"{kind}.yaml").read_text()
    assert set(yaml.safe_load(text)) == {field.name for field in fields(FaultSettings)}
    assert all("#" in line for line in text.splitlines() if not line.startswith("name"))
    (fault,) = faults_of(compose_config("eval", [f"fault={kind}"]))
    assert (fault.name, fault.condition.partition(":")[0]) == (kind, kind)
    assert (set(choices("fault")), compose_config("eval")["fault"]) == (
        {*KINDS, "none"},
        {"name": "none"},
    )


def test_list_of_faults_uses_defaults_of_its_kinds_and_precedes_the_choice():
    listed = (
        "faults=[{kind:drift,channel:ay,severity:mild},{kind:bias,channel:ax,size:0.4,start:3}]"
    )
    drift, bias, frozen = faults_of(compose_config("eval", [listed, "fault=frozen"]))
    assert (drift.condition, drift.duration, frozen.name) == ("drift:ay:mild", 20.0, "frozen")
    assert (bias.condition, bias.start, bias.duration) == ("bias:ax:0.4", 3.0, 10.0)
    assert faults_of(compose_config("eval")) == ()
    fault = FaultSettings("bias", "ay", "mild")
    assert union_of_faults([[fault], [fault]]) == (fault,)
    assert "two faults are both called bias:ay:mild" in refusal(
        lambda: union_of_faults([[fault], [replace(fault, start=4.0)]]), ConfigurationError
    )
    assert len(union_of_faults([[fault], [replace(fault, start=4.0, seed=1)]])) == 2


def test_fault_start_is_drawn_between_20_and_40_percent_of_each_range():
    fault = FaultSettings("bias", "ay", "mild", duration=5.0)
    onsets = np.array([fault.within(10.0, 100.0, position).onset for position in range(50)])
    assert 30.0 <= onsets.min() < 32.0
    assert 48.0 < onsets.max() <= 50.0
    assert (len(set(onsets)), fault.within(10.0, 100.0, 3)) == (50, fault.within(10.0, 100.0, 3))
    assert FaultSettings("bias", "ay", "mild", start=4.0).within(10.0, 100.0, 7).onset == 14.0


def test_invalid_faults_are_refused_in_a_single_line(trained):
    for overrides, says in (
        (("fault=frozn",), "fault=frozn is not there; did you mean frozen?"),
        (
            ("fault=frozen", "fault.channel=yawrate"),
            "fault.channel 'yawrate' is not there; did you mean yaw_rate?",
        ),
        (("fault.channel=ay",), "unknown option 'fault.channel'"),
        (("faults=[{channel:ay}]",), "faults must be a list of faults, each with its kind"),
        (
            ("fault=bias", "fault.channel=steer"),
            "recording 'two' of data set 'mine' has no channel 'steer' (it has ax, ay, vx, "
            "yaw_rate)",
        ),
    ):
        trained.refused("eval", *TRAINED, *overrides, code=2, says=says)
    for faults, says in (
        (
            [{"kind": "bias", "channel": "nowhere", "severity": "mild"}],
            "fault.channel 'nowhere' is not there",
        ),
        ("bias", "faults must be a list of faults, each with its kind"),
    ):
        pipeline_with(trained, [["estimator=zero"]], evaluation={"faults": faults})
        trained.refused("run", "faulted", "tracking=none", code=2, says=says)


def test_an_evaluation_has_rows_of_its_fault_and_keeps_all_others(trained):
    plain, nominal = evaluated(trained)
    folder, figures = evaluated(trained, *FROZEN)
    assert folder != plain
    before, after = (
        path.joinpath("metrics.csv").read_text().splitlines() for path in (plain, folder)
    )
    assert after[: len(before)] == before, (
        "what is said without the fault is the same, and stands first"
    )
    columns = {name for name in figures if not is_fault(name)}
    assert columns == set(nominal)
    assert all(
        figures[name] == nominal[name]
        for name in columns - {"folder", "step_seconds.test", "train_seconds.test"}
    )
    added = pd.DataFrame(csv.DictReader([before[0], *after[len(before) :]]))
    assert (set(added["condition"]), set(added["subset"])) == ({CONDITION}, {"faulted", "after"})
    assert set(added["test_set"]) == {"validation", "test"}
    metrics = {
        f"{name}{nominal}"
        for name in ("rmse_sideslip", "rmse_vy", "max_error_sideslip")
        for nominal in ("", "_nominal")
    }
    flags = {
        "coverage_90",
        "coverage_90_unflagged",
        "detection_delay",
        "missed_detections",
        "max_error_sideslip_undetected",
    }
    assert metrics <= set(added["metric"]) <= metrics | flags
    assert set(added.loc[added["metric"].isin(flags), "subset"]) <= {"faulted"}
    faulted, unharmed = (
        figures[f"{name}.test.{CONDITION}.faulted"]
        for name in ("rmse_sideslip", "rmse_sideslip_nominal")
    )
    assert faulted > unharmed, "what stands still is passed over, and the estimate fades"


def test_errors_under_a_fault_equal_those_of_a_direct_estimate(place):
    """v = 0 has the error v; what it is while the fault lasts follows from the reference alone."""
    overrides = ("split=mine", "estimator=zero", "tracking=none")
    place.done("train", *overrides)
    figures = place.told("eval", *overrides, *FROZEN)
    recording = read_recording(
        next((place.folder / "outputs" / "downsample").glob("mine-20hz-*")) / "three.parquet"
    )
    time = recording.time - recording.start_time
    for subset, inside in (("faulted", (time > 7.99) & (time < 13.99)), ("after", time > 16.99)):
        expected = np.sqrt(np.mean(recording["vy_ref"][inside] ** 2))
        for name in ("rmse_vy", "rmse_vy_nominal"):
            assert figures[f"{name}.test.{CONDITION}.{subset}"] == pytest.approx(
                expected, rel=1e-12
            )


def test_values_that_are_not_finite_leave_finite_errors(trained):
    listed = ",".join(
        f"{{kind:{kind},channel:vx,severity:severe}}" for kind in ("nan", "inf", "huge", "dropout")
    )
    figures = evaluated(trained, f"faults=[{listed}]")[1]
    values = [
        value
        for name, value in figures.items()
        if is_fault(name) and name.startswith(("rmse_", "max_")) and "undetected" not in name
    ]
    assert len(values) == 4 * 2 * 6, (
        "four faults, two subsets, six metrics; the validation range is not shown"
    )
    assert None not in values, "JSON has null for what is not finite"


def test_key_of_an_evaluation_contains_its_faults_alone(
    trained,
):
    first = evaluated(trained, "fault=noise")
    again = evaluated(trained, "fault=noise")
    assert again == (first[0], {**first[1], "skipped": True})
    assert evaluated(trained, "fault=noise", "fault.seed=1")[0] != first[0]
    manifest = json.loads((evaluated(trained)[0] / "manifest.json").read_text())
    assert set(manifest["config"]) == {"sets", "protocol", "kinds", "split"}
    assert manifest["code"] == code_of("evaluate", "kinematic"), (
        "and the code of faults does not count"
    )
    assert (
        json.loads((first[0] / "manifest.json").read_text())["code"]
        == f"{manifest['code']} faults=3"
    )
    assert set(manifest["outputs"]) == {
        "metrics.csv",
        "timings.csv",
        "blocks.csv",
        "validation/0.parquet",
        "test/0.parquet",
    }


def test_a_sweep_over_faults_trains_each_model_once(place):
    quick = (
        "split=mine",
        "estimator=gru",
        "estimator.n_states=2",
        "training.max_epochs=1",
        "tracking=none",
    )
    out, err = place.done(
        "sweep", *quick, "fault=frozen,bias", "fault.channel=yaw_rate,ay", "seed=0,1", "--json"
    )
    assert sum(line.startswith("done") and " train " in line for line in err.splitlines()) == 2
    assert sum(line.startswith("done") and " evaluate " in line for line in err.splitlines()) == 2
    outcome = json.loads(out)
    assert outcome["chosen"] is None, "faults are not chosen between"
    folder = Path(outcome["folder"])
    jobs = pd.read_csv(folder / "sweep.csv")
    assert (len(jobs), set(jobs["status"])) == (8, {"done"})
    for job in jobs.to_dict("records"):
        metrics = pd.read_csv(
            next((place.folder / "outputs" / "evaluate").glob(f"gru-*-seed{job['seed']}-*"))
            / "metrics.csv"
        )
        condition = f"{job['fault']}:{job['fault.channel']}:medium"
        fault_rows = metrics[
            (metrics["condition"] == condition)
            & (metrics["subset"] == "faulted")
            & (metrics["test_set"] == "test")
        ]
        assert job["rmse_sideslip.test"] == fault_rows.set_index("metric")["value"]["rmse_sideslip"]
    report = (folder / "report.md").read_text()
    assert "faults, which are conditions of the evaluation" in report
    assert (
        "Faults: frozen:yaw_rate:medium, frozen:ay:medium, bias:yaw_rate:medium, bias:ay:medium"
        in report
    )


def test_fault_without_its_channel_is_named_and_other_jobs_continue(
    place,
):
    quick = ("sweep", "split=mine", "tracking=none")
    code, out, err = place(
        *quick, "estimator=kinematic", "fault=sign,bias", "fault.channel=vx,ay", "--json"
    )
    assert code == 5
    assert (
        "fault=sign, channel=vx seed 0: a fault 'sign' makes no sense for channel 'vx'"
        in err.splitlines()[-1]
    )
    assert [row["n_seeds"] for row in json.loads(out)["summary"]] == [0, 1, 1, 1]
    outcome = place.told(*quick, "estimator=kinematic,zero", *FROZEN)
    best = min(row["rmse_sideslip.validation"] for row in outcome["summary"])
    assert outcome["chosen"]["rmse_sideslip.validation"] == best
    configs = jobs_of(read_study("small"), ["fault=held", "fault.channel=vx"])
    assert {fault.condition for job in configs[""] for fault in faults_of(job.config)} == {
        "held:vx:medium"
    }


def pipeline_with(place, sweeps, **keys):
    return place.change(
        "pipelines/faulted.yaml",
        study="faulted",
        report="drive",
        split="mine",
        sweeps=sweeps,
        **keys,
    )["study"]


def test_faults_of_a_pipeline_and_of_its_sweeps_are_those_of_all_evaluations(place):
    name = pipeline_with(
        place,
        [["estimator=kinematic", "fault=frozen,bias"], ["estimator=zero"]],
        evaluation={
            "faults": [{"kind": "nan", "channel": "ay", "severity": "mild"}],
            "skip_seconds": 1,
        },
    )
    out, err = place.done("run", name, "tracking=none", "--json")
    assert sum(line.startswith("done") and " train " in line for line in err.splitlines()) == 2
    files = list((place.folder / "outputs" / "evaluate").glob("*/metrics.csv"))
    assert len(files) == 2
    for file in files:
        assert {name for name in pd.read_csv(file)["condition"] if is_fault(name)} == {
            "nan:ay:mild",
            "frozen:yaw_rate:medium",
            "bias:yaw_rate:medium",
        }
    assert len(json.loads(out)["leaderboard"]) == 2, "the leaderboard is that without faults"
