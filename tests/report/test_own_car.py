"""The verdict on a user's car: what is recommended, with which error, and what more recordings
would bring.
"""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from test_report import drive, study

from vehest.data.store import read_recording, write_recording
from vehest.run.comparison import NO_TIME
from vehest.studies import drive as drive_study
from vehest.studies.artefacts import StudyArtefacts
from vehest.studies.own_car import documents, not_compared, verdict, verdict_of


@pytest.fixture(scope="module")
def part(tmp_path_factory):
    return study(tmp_path_factory.mktemp("study"))


def without(part, *names):
    return replace(part, models=[model for model in part.models if model.estimator not in names])


def verdict_text(part):
    return " ".join(verdict_of(part, "test")[0])


def test_best_estimator_is_recommended_with_interval_and_chosen_seed(
    part,
):
    verdict = verdict_of(without(part, "luenberger", "gru"), "test")
    words = " ".join(verdict[0])
    assert words.startswith("**Best: KS-NN linear + bias, P = 2, ")
    assert "**Recommended: KS-NN linear + bias, P = 2**, expected RMSE(β) " in words
    assert "it is significantly better than every other estimator" in words
    low, high = (float(text) for text in words.split("[", 2)[2].split("]")[0].split(", "))
    assert 0.0 < low < high
    assert (verdict[1].estimator, verdict[1].seed) == ("ksnn", 1)


def test_of_two_equal_estimators_neither_is_significantly_worse(part):
    twins = [
        replace(model, variant="twin", title="Its twin")
        for model in part.models
        if model.estimator == "gru"
    ]
    rows = part.metrics[part.metrics["estimator"] == "gru"].assign(variant="twin")
    pair = without(part, "ksnn", "luenberger")
    words = verdict_text(
        replace(
            pair,
            models=[*pair.models, *twins],
            metrics=pd.concat([part.metrics, rows], ignore_index=True),
        )
    )
    assert words.startswith("**Best: ")
    assert " is not significantly worse. **Recommended: " in words
    assert "every other estimator" not in words
    bare = verdict_text(without(part, "zero", "static_map", "luenberger", "gru"))
    assert "**No estimator is recommended**: none was compared with" in bare


def test_commands_use_the_recommended_model(part):
    """Luenberger comes first in the list, and GRU, alike on the test, has the lowest error on
    validation.
    """
    metrics = part.metrics.copy()
    metrics.loc[
        (metrics["estimator"] == "gru")
        & (metrics["test_set"] == "validation")
        & (metrics["metric"] == "rmse_vy"),
        "value",
    ] = 0.01
    gru = next(model for model in part.models if model.estimator == "gru")
    duplicates = [
        replace(model, evaluation_folder=gru.evaluation_folder)
        for model in part.models
        if model.estimator == "luenberger"
    ]
    tied_part = replace(without(part, "ksnn", "luenberger"), metrics=metrics)
    verdict = verdict_of(replace(tied_part, models=[*tied_part.models, *duplicates]), "test")
    assert verdict[1] is not None
    assert verdict[1].estimator == "gru"
    assert verdict[0][0].startswith("**Best: Luenberger, ")
    assert "GRU | 5 &lt;states> is not significantly worse." in verdict[0][0]
    assert verdict[0][1].startswith("**Recommended: GRU")


def test_share_that_is_scored_and_sideslip_hidden_in_the_start_of_a_range(part, tmp_path):
    """25 s of which 1.5 s are left out: 94 %.

    A slide at the start of the range, a stop at its end.
    """
    recording = drive()
    vx = recording["vx"].copy()
    vy = recording["vy_ref"].copy()
    vy[round(60.5 * 20)] = 10.0
    vx[round(84.0 * 20) : round(84.5 * 20)] = 0.0003
    vy[round(84.0 * 20) : round(84.5 * 20)] = 0.02
    file = tmp_path / "lap.parquet"
    write_recording(recording.with_channels({"vx": vx, "vy_ref": vy}), file)
    words = verdict_text(
        replace(
            part,
            references={("toy", "lap"): file},
        )
    )
    assert (
        "94 % of the test is scored, without the first 1.5 s of its 1 range, **which contain the "
        "largest sideslip** (" in words
    )
    assert "; in 2.1 % of that the car is slower than 1 m/s, and only v is scored." in words
    assert "largest sideslip" not in verdict_text(part)


def test_nothing_is_recommended_that_does_not_beat_the_static_map(part):
    verdict = verdict_of(without(part, "luenberger", "gru", "ksnn"), "test")
    assert verdict[0][0].startswith("**Best: Static map, ")
    assert verdict[0][1].startswith(
        "**No estimator is recommended**: none of these is significantly better than"
    )
    assert verdict[1] is None


def test_an_estimator_that_only_equals_a_baseline_is_not_recommended(part):
    """A static map that is as good as KS-NN: the best and its equals all lack a significant
    difference to it.
    """
    ksnn = next(model for model in part.models if model.estimator == "ksnn" and model.seed == 1)
    tied = [
        replace(model, evaluation_folder=ksnn.evaluation_folder)
        if model.estimator == "static_map"
        else model
        for model in part.models
    ]
    verdict = verdict_of(replace(part, models=tied), "test")
    assert verdict[0][0].startswith("**Best: ")
    assert "not significantly worse" in verdict[0][0]
    assert verdict[0][1].startswith("**No estimator is recommended**")
    assert verdict[1] is None
    report = documents(
        StudyArtefacts(
            "toy", "A toy study", "", "vehest run toy", {"": ""}, {"": replace(part, models=tied)}
        )
    )["report"]
    assert "**Recommended" not in "\n".join(
        block for block in report.blocks if isinstance(block, str)
    )
    assert "vehest export" not in "\n".join(
        block for block in report.blocks if isinstance(block, str)
    )


def test_the_comparison_of_a_drive_recommends_by_the_same_rule(part):
    """The page of any comparison and its printed verdict; the static map is as good as the best."""
    artefacts = StudyArtefacts("toy", "A toy study", "", "vehest run toy", {"": ""}, {"": part})
    best, recommended = drive_study.verdict(artefacts)
    opening = str(drive_study.comparison(part).blocks[0]).replace("**", "").replace("`", "")
    assert best.startswith("Best: ")
    assert recommended.startswith("Recommended: KS-NN")
    assert f"{best} {recommended}" in opening
    baselines = replace(artefacts, parts={"": without(part, "luenberger", "gru", "ksnn")})
    assert not any("Recommended" in line for line in drive_study.verdict(baselines))


def test_recordings_without_sideslip_cannot_rank(part, tmp_path):
    standstill = drive()
    file = tmp_path / "lap.parquet"
    write_recording(
        standstill.with_channels({"vy_ref": 0.01 * standstill["vy_ref"]}),
        file,
    )
    verdict = verdict_of(replace(part, references={("toy", "lap"): file}), "test")
    assert verdict[0][0].startswith(
        "**These recordings cannot rank estimators**, because they hardly excite sideslip ("
    )
    assert verdict[1] is None


def test_a_bound_that_an_estimator_goes_below_does_not_make_a_drive_silent(part):
    rows = part.metrics[
        (part.metrics["metric"] == "rmse_sideslip") & (part.metrics["test_set"] == "test")
    ]
    bounded = pd.concat(
        [part.metrics, rows.assign(metric="floor_cramer_rao", value=90.0)], ignore_index=True
    )
    assert "cannot rank" not in verdict_text(replace(part, metrics=bounded))
    changed = bounded.assign(
        value=bounded["value"].where(bounded["metric"] != "rmse_sideslip", 95.0)
    )
    assert "the Cramér-Rao bound of the measured channels is 90°" in verdict_text(
        replace(part, metrics=changed)
    )


def test_three_times_as_much_hard_driving_again_would_halve_the_interval(part):
    recording = read_recording(part.references["toy", "lap"])
    minutes = 0.0
    for start, stop in ((2.0, 40.0), (42.0, 58.0), (60.0, 85.0)):
        minutes += float((np.abs(recording.cut(start, stop)["ay"]) > 4.0).sum()) / 20.0 / 60.0
    assert (
        f"Your recordings contain {minutes:.1f} min with |ay| above 4 m/s²: {3 * minutes:.0f} min "
        f"more would halve the interval." in verdict_text(part)
    )


def test_families_that_lack_channels_are_named_with_them(part):
    lines = not_compared(
        replace(
            part,
            failed={"lstm-states_5-seed0": NO_TIME},
        )
    )
    assert lines[0].startswith("lstm-states_5-seed0: not done yet")
    assert any(line.startswith("learned_ukf: lacks ") and "motor_speed" in line for line in lines)
    assert not any(line.startswith(("lstm:", "ksnn:", "zero:")) for line in lines)


def test_terminal_and_report_state_the_same(part):
    artefacts = StudyArtefacts(
        "toy",
        "A toy study",
        "",
        "vehest run toy",
        {"": ""},
        {"": part},
        report_command="vehest report toy output=there training.patience=5",
        location="output=there",
    )
    lines = verdict(artefacts)
    estimate, export, report = lines[lines.index("next:") + 1 :]
    assert " output=there -o beta.csv" in estimate
    assert " output=there -o on_the_car" in export
    assert "vehest report toy output=there training.patience=5 " in report
    opening = str(documents(artefacts)["report"].blocks[0]).replace("*", "").replace("`", "")
    sentences = lines[: lines.index("next:")]
    assert sentences[1].startswith("Recommended: ")
    assert " ".join(sentences) in opening
    model = estimate.split()[2]
    assert any(model == model_entry.model_folder.name for model_entry in part.models)
