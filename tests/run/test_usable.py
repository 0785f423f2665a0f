"""What estimators lack is said before anything is trained, what is promised to supply it does, and
rates fit the recordings.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from conftest import planar_drive
from place import DATASET
from single_track_drive import with_gaps
from vehest.configuration.composition import compose_config
from vehest.data.derivable_channels import MAKES, derivation_of
from vehest.data.derived import WHEELS
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.data.recording_summary import (
    RecordingSummary,
    common_channels,
    stored_summary,
    summary_of,
)
from vehest.data.schema import settings_from_config
from vehest.data.store import write_recording
from vehest.data.transforms import TRANSFORMS, transform_from_config
from vehest.estimators import registry
from vehest.estimators.base import FitData
from vehest.estimators.registry import estimator_class, estimator_names, new_estimator
from vehest.export.program import exportable
from vehest.run.comparison import lower_rate
from vehest.run.usable import all_usabilities, lacking_to_train, usability
from vehest.studies.registry import study_names
from vehest.training.context import FitContext

RADIUS = 0.32
RATIO = 16.0
VALUES = {"wheel_radius": RADIUS, "ratio": RATIO}
"""What only the user knows of the car below."""

FULL = {"vx", "yaw_rate", "ay", "ax", "steer", "vy_ref"}
UNITS = {
    "vx": "m/s",
    "yaw_rate": "rad/s",
    "ay": "m/s²",
    "ax": "m/s²",
    "steer": "rad",
    "handwheel": "rad",
}
UNITS |= {"vx_ref": "m/s", "vy_ref": "m/s", "sideslip_ref": "rad"} | {
    f"wheel_speed_{wheel}": "rad/s" for wheel in WHEELS
}


def log(channels, rate_hz=50.0, seed=1, seconds=30.0, name="lap"):
    """A drive of which only these channels were logged."""
    drive = planar_drive(seconds, rate_hz, seed=seed, noise=0.02, name=name)
    steer = 2.5 * drive["yaw_rate"] / drive["vx"]
    available = {**drive.channels, "steer": steer, "handwheel": RATIO * steer}
    available |= {f"wheel_speed_{wheel}": drive["vx"] / RADIUS for wheel in WHEELS}
    return replace(drive, channels={channel: available[channel] for channel in sorted(channels)})


def rows(recording):
    return {row.estimator: row.as_plain() for row in all_usabilities([summary_of(recording)])}


def with_values(entries):
    return [
        {key: VALUES[key] if value is None else value for key, value in entry.items()}
        for entry in entries
    ]


def add_logged(place, channels, rate_hz=50.0, **options):
    """A data set ``logged`` of three laps with these channels, and a split ``logged`` on it."""
    (place.folder / "raw" / "logged").mkdir()
    for seed in (1, 2, 3):
        lap = log(channels, rate_hz, seed)
        lap.to_pandas().to_csv(place.folder / "raw" / "logged" / f"lap{seed}.csv", index_label="t")
    declared = {name: {"column": name, "unit": UNITS[name]} for name in sorted(channels)}
    entry = {
        "name": "logged",
        "path": "${root}/logged",
        "time": {"column": "t", "unit": "s"},
        "channels": declared,
    }
    place.change("conf/dataset/logged.yaml", **DATASET | entry | options)
    train, validation, test = ([{"recording": f"lap{number}"}] for number in (1, 2, 3))
    place.change(
        "conf/split/logged.yaml",
        name="logged",
        dataset="logged",
        train=train,
        validation=validation,
        tests={"test": test},
    )


def add_study(place, *sweeps, **options):
    place.change(
        "pipelines/logged.yaml",
        study="logged",
        report="drive",
        split="logged",
        sweeps=list(sweeps),
        **options,
    )


def models(place):
    return {
        folder.name.split("-")[0] for folder in (place.folder / "outputs" / "train").glob("[!.]*")
    }


IDENTIFIED = [
    f"training.identification.{setting}"
    for setting in ("method=data", "restarts=1", "generations=1")
]
QUICK = {"cnn_ukf": IDENTIFIED, "ensemble_ukf": IDENTIFIED}


@pytest.mark.parametrize("name", [name for name in estimator_names() if name != "data_sheet"])
def test_fit_fails_without_each_required_channel(name):
    config = compose_config("train", [f"estimator={name}", *QUICK.get(name, ())])
    estimator = new_estimator(config["estimator"])
    training = settings_from_config(estimator.training_type, config["training"], "training")
    required = lacking_to_train(estimator, training, ())
    unread = (
        {"vx"} if name in ("learned_ukf", "kalman") else set()
    )  # their estimates read it, their fits do not
    assert bool(required) == estimator.learns
    generator = np.random.default_rng(0)
    channels = {channel: 10.0 + generator.normal(size=400) for channel in required}
    # at once where a fit would go on; of these the filter is identified whole before the network is
    # trained
    stops = name not in QUICK
    for channel in set(required) - unread:
        remaining = {second: samples for second, samples in channels.items() if second != channel}
        lap = Recording("skidpad", "car", estimator.settings.rate_hz, 0.0, remaining, "simulated")
        with pytest.raises(DataError, match=f"'{channel}'|no {channel} "):
            new_estimator(config["estimator"]).fit(
                FitData([lap], [lap]), training, FitContext(should_stop=lambda: stops)
            )


def test_channels_of_a_settings_choice_and_references_of_outputs_count():
    def requirements(*overrides):
        config = compose_config("train", list(overrides))
        estimator = new_estimator(config["estimator"])
        return set(
            lacking_to_train(
                estimator,
                settings_from_config(estimator.training_type, config["training"], "training"),
                (),
            )
        )

    assert requirements("estimator=sideslip_ffnn", "estimator.inputs=imu") == FULL
    assert requirements(
        "estimator=velocity_gru", "estimator.inputs=[ay]", "estimator.outputs=[vy]"
    ) == {"vx", "ay", "vy_ref"}
    references = {"vx_ref", "vy_ref", "yaw_rate_ref"}
    assert requirements("estimator=velocity_gru", "estimator.inputs=[ay]") == {
        "vx",
        "ay",
        *references,
    }
    assert requirements("estimator=kalman") == {"vx", "yaw_rate", "ay", "steer"}, (
        "noise levels are read off measured channels"
    )
    assert requirements("estimator=zero") == set()


def test_estimators_of_other_packages_state_their_needs():
    kind = estimator_class("static_map")
    plugin = type("Other", (kind,), {"learns_from": ("vx_ref", "vy_ref")})(kind.settings_type())
    assert set(lacking_to_train(plugin, None, ())) == {"vx", "yaw_rate", "vx_ref", "vy_ref"}
    row = usability(
        "luenberger", {"estimator": {"name": "luenberger"}, "training": {}}, [summary_of(log(FULL))]
    )
    assert (row.usable, row.rate_hz, row.configured_rate_hz) == ("yes", 50.0, 100.0)


LOGS = {
    "speed and accelerations": {"vx", "yaw_rate", "ay", "sideslip_ref"},
    "wheels": {"wheel_speed_rl", "wheel_speed_rr", "yaw_rate", "ay", "sideslip_ref"},
    "handwheel": {"vx", "yaw_rate", "ay", "ax", "handwheel", "vy_ref"},
    "all derived": {"wheel_speed_fl", "yaw_rate", "ay", "handwheel", "sideslip_ref"},
    "reference speed": {"vx", "vx_ref", "yaw_rate", "ay", "ax", "steer", "sideslip_ref"},
}


@pytest.mark.parametrize("rate_hz", [10.0, 50.0])
@pytest.mark.parametrize("channels", LOGS.values(), ids=list(LOGS))
def test_every_transform_that_is_promised_makes_its_channel(channels, rate_hz):
    recording = log(channels, rate_hz)
    promised = {
        channel: entries
        for row in rows(recording).values()
        for channel, entries in row["supplies"].items()
    }
    assert promised
    for channel, entries in promised.items():
        derived = recording
        for entry in with_values(entries):
            derived = transform_from_config(entry)(derived)
        assert channel in derived
        assert np.isfinite(derived[channel]).all()


@pytest.mark.parametrize("channels", LOGS.values(), ids=list(LOGS))
def test_supplying_all_missing_channels_makes_estimators_usable(channels):
    recording = log(channels)
    before = rows(recording)
    entries = {
        json.dumps(entry): entry
        for row in before.values()
        for transform in row["supplies"].values()
        for entry in with_values(transform)
    }
    for entry in sorted(
        entries.values(), key=lambda entry: entry["name"] != "speed_from_wheels"
    ):  # others may need vx
        recording = transform_from_config(entry)(recording)
    after = rows(recording)
    for name in ("ksnn", "gru", "lstm", "luenberger", "static_map", "kinematic", "zero"):
        assert after[name]["usable"] == "yes", name
    for name in before:
        unsupplied = {
            *before[name]["missing_to_estimate"],
            *before[name]["missing_to_train"],
        } - {*before[name]["supplies"], *estimator_class(name).measured_only}
        assert {*after[name]["missing_to_estimate"], *after[name]["missing_to_train"]} == unsupplied


NAMES = (
    "dugoff_ukf",
    "sideslip_ffnn",
    "cnn_ukf",
    "ensemble_ukf",
    "velocity_gru",
    "velocity_lstm",
    "data_sheet",
)


@pytest.mark.parametrize("name", NAMES)
def test_supplying_all_missing_settings_makes_estimators_usable(name):
    contents = [summary_of(log(FULL))]
    plain = usability(name, compose_config("train", [f"estimator={name}"]), contents)
    expected = "no" if name == "data_sheet" else "with settings"
    assert plain.usable == expected
    assert ("estimator.wheelbase=" in plain.to_give) == (name == "data_sheet")
    settings = ["estimator.wheelbase=2.4"] if name == "data_sheet" else plain.as_plain()["settings"]
    after = usability(name, compose_config("train", [f"estimator={name}", *settings]), contents)
    assert after.missing.to_estimate == after.missing.to_train == []
    assert after.patterns == ()
    assert after.usable == ("with settings" if after.of_car else "yes")


@pytest.mark.parametrize("wheelbase", [2.4, 2.7])  # the latter is the default of both
def test_a_wheelbase_of_the_data_set_needs_no_setting(wheelbase):
    dataset = DATASET | {"name": "one", "car": {"wheelbase": wheelbase}}
    for declared, expected in ((dataset, "yes"), (None, "with settings")):
        table = {
            row.estimator: row.usable for row in all_usabilities([summary_of(log(FULL))], declared)
        }
        assert (table["self_calibrating"], table["prior_map"]) == (expected, expected)


def test_missing_references_gaps_and_channels_are_named_by_estimator():
    table = rows(log(FULL - {"vy_ref"}))
    assert (table["ksnn"]["usable"], table["ksnn"]["missing_to_train"]) == (
        "not to train",
        ["vy_ref"],
    )
    assert (table["zero"]["usable"], table["kalman"]["usable"]) == ("yes", "with settings"), (
        "they learn nothing of a reference"
    )
    drive = log(FULL)
    table = rows(with_gaps(drive, {"ay": 10}))
    assert (table["ksnn"]["gaps"], table["kalman"]["gaps"]) == (["ay"], []), (
        "the filter skips a sample of ay"
    )
    complete = summary_of(drive)
    incomplete = summary_of(log(FULL - {"ax"}, name="other"))
    assert common_channels([complete, incomplete]) == FULL - {"ax"}
    assert (
        usability(
            "ksnn", compose_config("train", ["estimator=ksnn"]), [complete, incomplete]
        ).usable
        == "no"
    )
    for channel, channels, gappy in (
        ("ax", {"vx"}, {"vx"}),
        ("steer", {"vx", "yaw_rate"}, ()),
        ("vy_ref", {"sideslip_ref"}, ()),
        ("motor_current", set(UNITS), ()),
    ):
        assert derivation_of(channel, channels, gappy, 50.0) is None


def test_every_transform_that_makes_a_channel_is_listed(tmp_path):
    assert set(MAKES) <= set(TRANSFORMS)
    recording = log(set(UNITS))
    for name, channel in MAKES.items():
        options = {
            "speed_from_wheels": {"wheel_radius": RADIUS},
            "steering_ratio": {"ratio": RATIO},
        }.get(name, {})
        reduced = recording.select(
            [candidate for candidate in recording.channels if candidate != channel]
        )
        assert channel in transform_from_config({"name": name, **options})(reduced)
    vx = np.where(np.arange(40) == 3, np.nan, 1.0)
    recording = Recording(
        "gap", "car", 40.0, 0.0, {"vx": vx, "ay": np.ones(40)}, gappy=frozenset({"vx"})
    )
    write_recording(recording, tmp_path / "gap.parquet")
    summary = RecordingSummary("gap", 40.0, frozenset({"vx", "ay"}), frozenset({"vx"}))
    assert stored_summary(tmp_path / "gap.parquet") == summary_of(recording) == summary


def test_table_names_all_estimators_and_json_says_the_same(place):
    add_logged(place, LOGS["wheels"])
    place("ingest", "logged")
    result = place.told("data", "usable", "logged")
    assert ({row["estimator"] for row in result["estimators"]}, result["rate_hz"]) == (
        set(estimator_names()),
        50.0,
    )
    assert result["missing_to_score"] == ["vx", "vy_ref"]
    ksnn = next(row for row in result["estimators"] if row["estimator"] == "ksnn")
    assert (ksnn["missing_to_estimate"], ksnn["missing_to_train"]) == (
        ["vx", "ax"],
        ["vx", "ax", "vy_ref"],
    )
    assert ksnn["supplies"]["ax"] == [
        {"name": "speed_from_wheels", "wheel_radius": None},
        {"name": "acceleration_from_speed"},
    ]
    out, _ = place.done("data", "usable", "logged")
    words = " ".join(out.split())
    assert "luenberger no 50 Hz, not 100" in words
    assert (
        "ax: transforms: [{name: speed_from_wheels, wheel_radius: …}, {name: "
        "acceleration_from_speed}]" in words
    )


def test_the_self_calibrating_filter_is_offered_without_ax_not_with_one_of_the_speed():
    row = rows(log(FULL - {"ax"}))["self_calibrating"]
    assert (row["usable"], row["supplies"]) == ("with settings", {})
    assert row["settings"] == ["estimator.measured_ax=false"]


def test_bare_files_are_assessed_by_their_columns(place):
    table = log({"vx", "yaw_rate", "ay"}).to_pandas()
    table.assign(AccX=0.0, Steering=0.0).to_csv("lap.csv")
    assert place.told("data", "usable", "lap.csv")["unused_columns"] == ["AccX", "Steering"]
    assert "columns without a channel: AccX, Steering" in place("data", "usable", "lap.csv")[1]
    assert place("data", "usable", "nowhere.csv")[0] == 4


def test_training_without_a_channel_is_refused_with_a_working_remedy(place):
    add_logged(place, LOGS["speed and accelerations"])
    place.refused(
        "train",
        "estimator=luenberger",
        "split=logged",
        "tracking=none",
        code=3,
        says=(
            "recording 'lap1' and 1 more lack channels that estimator 'luenberger' requires: "
            "ax (transforms: [{name: acceleration_from_speed}] of vx)",
            "vy_ref (transforms: [{name: velocity_from_sideslip}] of sideslip_ref and vx)",
            "'vehest data usable logged'",
        ),
    )
    assert not list((place.folder / "outputs").glob("downsample/*")), (
        "it is said before recordings are resampled"
    )
    place.change(
        "conf/dataset/logged.yaml",
        transforms=[{"name": "acceleration_from_speed"}, {"name": "velocity_from_sideslip"}],
    )
    fast_settings = ("training.grid=1", "training.max_evaluations=10")
    place.done("train", "estimator=luenberger", "split=logged", "tracking=none", *fast_settings)


def test_unusable_candidates_are_listed_at_once_and_others_are_evaluated(place):
    add_logged(place, FULL - {"ax", "steer"})
    add_study(
        place,
        ["estimator=zero"],
        ["estimator=static_map"],
        ["estimator=ksnn", "seed=0,1"],
        ["estimator=kalman"],
    )
    code, out, err = place("run", "logged", "--json", "tracking=none")
    assert code == 5
    result = json.loads(out)
    assert {row["estimator"] for row in result["leaderboard"]} == {"zero", "static_map"}
    reasons = {name.split("-")[0]: reason for name, reason in result["failed"].items()}
    assert set(reasons) == {"ksnn", "kalman"}
    assert (
        "lack channels that estimator 'ksnn' requires: ax (transforms: [{name: "
        "acceleration_from_speed}] of vx)" in reasons["ksnn"]
    )
    assert "steer (not in the log)" in reasons["kalman"]
    assert models(place) == {"zero", "static_map"}
    lines = [line.split() for line in err.splitlines()]
    failures = [position for position, line in enumerate(lines) if line[0] == "failed"]
    completions = [
        position
        for position, line in enumerate(lines)
        if line[:2] in (["done", "train"], ["done", "downsample"])
    ]
    assert len(failures) == 2
    assert max(failures) < min(completions)
    assert "seeds 0, 1" in " ".join(lines[failures[0]])
    code, again, _ = place("report", "logged", "--json", "tracking=none")
    assert (code, json.loads(again)["failed"].keys()) == (5, result["failed"].keys())


@pytest.mark.parametrize(
    ("channels", "sweeps", "says"),
    [
        (
            {"vx", "yaw_rate", "vy_ref"},
            ("ksnn", "kalman"),
            "none of these estimators can be used with the recordings of split 'logged'",
        ),
        (FULL - {"vy_ref"}, ("zero", "kalman"), "vy_ref (not in the log)"),
    ],
)
def test_study_none_of_whose_candidates_will_do_or_can_be_scored_trains_nothing(
    place, channels, sweeps, says
):
    add_logged(place, channels)
    add_study(place, *([f"estimator={name}"] for name in sweeps))
    code, _, err = place("run", "logged", "tracking=none")
    assert (code, says in err.splitlines()[-1], models(place)) == (3, True, set())


def test_sweep_names_combinations_that_lack_something_and_finishes_the_others(place):
    add_logged(place, (FULL - {"steer"}) | {"handwheel"})
    code, out, err = place(
        "sweep", "estimator=kalman,static_map", "split=logged", "--json", "tracking=none"
    )
    result = json.loads(out)
    assert (code, models(place)) == (5, {"static_map"})
    assert [
        row["estimator"] for row in result["summary"] if row["rmse_sideslip.test"] is not None
    ] == ["static_map"]
    assert "steer (transforms: [{name: steering_ratio" in result["failed"][0]["message"]
    assert err.index("steer (") < err.index("static_map")
    add_study(
        place,
        ["estimator=kalman", f"downsample.transforms=[{{name: steering_ratio, ratio: {RATIO}}}]"],
    )
    first, second = (place.done("run", "logged", "tracking=none") for _ in range(2))
    assert first[0] == second[0], "what the downsampling makes is not missing"
    assert list((place.folder / "outputs" / "finished").iterdir())
    assert "kalman runs at 50 Hz instead of its 100 Hz" in " ".join(second[1].split())


def test_estimator_of_100_hz_runs_at_50_on_a_log_of_50_and_says_so(place):
    add_logged(place, FULL)
    fast_settings = (
        "estimator=luenberger",
        "split=logged",
        "tracking=none",
        "training.grid=1",
        "training.max_evaluations=10",
    )
    out, err = place.done("train", *fast_settings, "--json")
    message = (
        "luenberger runs at 50 Hz instead of its 100 Hz, since recording 'lap1' is sampled at 50 Hz"
    )
    assert " ".join(err.split()).count(message) == 1
    folder = Path(json.loads(out)["model"])
    assert yaml.safe_load((folder / "model.yaml").read_text())["settings"]["rate_hz"] == 50.0
    assert (
        json.loads((folder / "manifest.json").read_text())["config"]["estimator"]["rate_hz"] == 50.0
    )
    assert place("eval", *fast_settings, "--json")[0] == 0, (
        "it finds the model by the same overrides"
    )
    assert place("eval", "--model", str(folder), "split=logged", "tracking=none")[0] == 0
    same_model = place.told("train", *fast_settings, "estimator.rate_hz=50.0")
    assert (same_model["model"], same_model["skipped"]) == (str(folder), True), (
        "the same training as if the rate had been given"
    )
    message = (
        "estimator.rate_hz asks for 100 Hz, and recording 'lap1' is sampled at 50 Hz; give "
        "estimator.rate_hz=50 or less"
    )
    place.refused(
        "train",
        "estimator=luenberger",
        "estimator.rate_hz=100",
        "split=logged",
        "tracking=none",
        code=3,
        says=message,
    )


def test_lowest_rate_of_all_data_sets_counts_and_unavailable_rates_hide_no_candidate(place):
    add_logged(place, FULL)
    tests = {
        "test": [{"recording": "lap3"}],
        "other": [{"dataset": "mine", "recording": "three"}],
    }  # the latter sampled at 100 Hz
    place.change("conf/split/logged.yaml", tests=tests)
    add_study(
        place,
        ["estimator=zero"],
        ["estimator=luenberger", "training.grid=1", "training.max_evaluations=10"],
        ["estimator=static_map", "estimator.rate_hz=100"],
    )
    code, out, err = place("run", "logged", "--json", "tracking=none")
    assert code == 5
    result = json.loads(out)
    assert {(row["estimator"], row["test_set"]) for row in result["leaderboard"]} == {
        (name, test) for name in ("zero", "luenberger") for test in tests
    }
    assert [name.split("-")[0] for name in result["failed"]] == ["static_map"]
    message = "luenberger runs at 50 Hz instead of its 100 Hz"
    assert message in " ".join(err.split())
    report = (Path(result["report"]).parent / "report.md").read_text(encoding="utf-8")
    assert all(words in report for words in (message, "Recordings at 20 and 50 Hz"))


def test_evaluation_grid_is_no_finer_than_a_log_of_10_hz(place):
    add_logged(place, FULL, rate_hz=10.0)
    add_study(
        place,
        ["estimator=static_map"],
        ["estimator=ksnn", "estimator.window=10", "training.max_epochs=2"],
    )
    out, err = place.done("run", "logged", "--json", "tracking=none")
    words = " ".join(err.split())
    assert words.count("evaluation reads estimates at 10 Hz instead of 20 Hz") == 1
    assert "ksnn runs at 10 Hz instead of its 20 Hz" in words
    assert (
        "estimator.window of 10 samples lasts 1 s instead of 0.5 s (estimator.window=5 keeps that)"
        in words
    )
    metrics = pd.read_csv(Path(json.loads(out)["report"]).parent / "metrics.csv")
    assert set(metrics["rate_hz"]) == {10.0}
    code, _, err = place("run", "logged", "evaluation.rate_hz=20", "tracking=none")
    assert code == 3
    assert (
        "evaluation.rate_hz asks for 20 Hz, and recording 'lap1' is sampled at 10 Hz"
        in err.splitlines()[-1]
    )


def test_available_rates_remain_and_lowered_rates_are_explained():
    def at(rate_hz):
        return RecordingSummary("lap", rate_hz, frozenset())

    config = compose_config("eval", ["estimator=luenberger"])
    for group in ("estimator", "evaluation"):
        assert lower_rate(config, group, at(100.0)) == (config, [])
    config = compose_config("eval", ["estimator=factor_graph", "estimator.window=0.01"])
    with pytest.raises(
        DataError,
        match=r"'factor_graph' cannot run at 20 Hz, and recording 'lap' is sampled at 20 Hz: "
        r"estimator.window",
    ):
        lower_rate(config, "estimator", at(20.0))
    _, ((_, text),) = lower_rate(
        compose_config("eval", ["estimator=velocity_gru"]), "estimator", at(50.0)
    )
    assert "training.sequence_steps of 300 samples lasts 6 s instead of 3 s" in text


PLUGINS = {
    "broken_import": ("raise RuntimeError('no such GPU')", "loaded (RuntimeError: no such GPU)"),
    "broken_class": ("Plugin = 3", "loaded (TypeError: 3 is no class derived from Estimator)"),
    "broken_constructor": (
        "class Plugin(Zero):\n"
        "    def __init__(self, *arguments, **options): raise RuntimeError('no licence')",
        "made (RuntimeError: no licence)",
    ),
    "broken_property": (
        "class Plugin(Zero):\n"
        "    @property\n"
        "    def channels(self): raise RuntimeError('no channels')",
        "used (RuntimeError: no channels)",
    ),
}


@pytest.fixture
def plugins(tmp_path, monkeypatch):
    """An installed package whose estimators and whose study fail in one way each, but for the
    estimator `sound`.
    """
    info = tmp_path / "plugins" / "broken-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1\n")
    modules = {name: code for name, (code, _) in PLUGINS.items()} | {
        "sound": "class Plugin(Zero): name = 'sound'"
    }
    points = "\n".join(f"{name} = {name}:Plugin" for name in modules)
    (info / "entry_points.txt").write_text(
        f"[vehest.estimators]\n{points}\n[vehest.studies]\nbroken_study = broken_import\n"
    )
    for name, code in modules.items():
        code = f"from vehest.estimators.zero import ESTIMATOR as Zero\n{code}\n"
        (info.parent / f"{name}.py").write_text(code)
    monkeypatch.syspath_prepend(str(info.parent))
    caches = (registry.estimator_names, registry.estimator_class, study_names)
    for function in caches:
        function.cache_clear()
    yield
    for function in caches:
        function.cache_clear()


@pytest.mark.usefixtures("plugins")
def test_plugins_that_fail_are_named_and_the_others_are_listed():
    table = rows(log(FULL))
    for name, (_, failure) in PLUGINS.items():
        assert table[name]["usable"] == "no"
        assert f"'{name}' of another package cannot be {failure}" in table[name]["to_give"]
    assert table["zero"]["usable"] == "yes"
    loadable = {"zero", "ksnn", "broken_constructor", "broken_property"}
    assert loadable <= set(registry.estimator_classes())
    assert {"broken_import", "broken_class"}.isdisjoint(registry.estimator_classes())
    assert "ksnn" in exportable()


@pytest.mark.usefixtures("plugins")
def test_new_car_lists_requirements_of_plugins_without_a_settings_file(place):
    place.add_steered()
    logs = [f"raw/steered/{name}.csv" for name in ("first", "second")]
    output, _ = place.done("new", "my_car", *logs, "--yes")
    requirements = {}
    for line in output.splitlines():
        if line.startswith("not compared: "):
            names, reason = line.removeprefix("not compared: ").split(": ", 1)
            requirements |= dict.fromkeys(names.split(", "), reason)
    assert "is not there" not in output
    assert requirements["sound"].startswith("there is no conf/estimator/sound.yaml; write one with")
    for name in ("broken_constructor", "broken_property"):
        assert f"of another package cannot be {PLUGINS[name][1]}" in requirements[name]


@pytest.mark.apart
@pytest.mark.usefixtures("plugins")
@pytest.mark.parametrize("name", PLUGINS)
def test_studies_naming_a_broken_plugin_are_a_single_line_and_train_nothing(place, name):
    add_logged(place, FULL)
    place.done("ingest", "logged")
    place.change(f"conf/estimator/{name}.yaml", name=name)
    add_study(place, ["estimator=zero"], [f"estimator={name}", "training=none"])
    message = f"estimator '{name}' of another package cannot be {PLUGINS[name][1]}"
    place.refused("run", "logged", "tracking=none", code=2, says=message)


@pytest.mark.apart
@pytest.mark.usefixtures("plugins")
def test_broken_study_modules_are_a_single_line(place):
    place.change(
        "pipelines/odd.yaml",
        study="odd",
        report="broken_study",
        split="mine",
        sweeps=[["estimator=zero"]],
    )
    message = (
        "study module 'broken_study' of another package cannot be loaded (RuntimeError: no such"
    )
    for command in ("run", "report"):
        place.refused(command, "odd", "tracking=none", code=2, says=message)
    place.done("data", "list")


BAD_ESTIMATORS = {
    "aliases": "a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
    + "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 7)),
    "nameless": "rate_hz: 20\n",
    "no_yaml": "{{: [",
    "round": "defaults: [roundabout, _self_]\nname: zero\n",
    "roundabout": "defaults: [round, _self_]\nname: zero\n",
}


def test_a_file_of_an_estimator_that_cannot_be_read_is_a_row_with_the_reason(tmp_path, monkeypatch):
    folder = tmp_path / "conf" / "estimator"
    folder.mkdir(parents=True)
    for name, text in BAD_ESTIMATORS.items():
        (folder / f"{name}.yaml").write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("vehest.run.usable.choices", lambda group: [*BAD_ESTIMATORS, "zero"])
    monkeypatch.setattr("vehest.run.usable.estimator_names", lambda: ["zero"])
    rows = all_usabilities([summary_of(planar_drive(20.0, 50.0))])
    reasons = {row.estimator: row.to_give for row in rows if row.usable == "no"}
    assert [row.estimator for row in rows] == [*BAD_ESTIMATORS, "zero"]
    assert "zero" not in reasons
    assert "aliases.yaml' nests deeper than 60 levels or holds more than" in reasons["aliases"]
    assert reasons["nameless"] == "estimator.name is missing"
    assert "no_yaml.yaml' cannot be read as YAML" in reasons["no_yaml"]
    assert reasons["round"].startswith("the defaults of 'conf/estimator/round.yaml' and ")
    assert "'conf/estimator/roundabout.yaml' lead back to themselves" in reasons["round"]
