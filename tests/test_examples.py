"""The worked examples of docs/adding_an_estimator.md: found through entry points, trained, run
online, saved, compared.
"""

import ast
import re
from importlib import import_module
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from compare_examples import EXAMPLES
from refusals import refusal

import vehest
from conftest import planar_drive
from example_package import NAMES, forget_examples, install_examples, write_laps
from single_track_drive import linear_drive, with_gaps
from vehest.artefacts.artefact import read_artefact
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import Recording
from vehest.estimators.base import FitData
from vehest.estimators.registry import estimator_class, estimator_names
from vehest.training.context import NoTraining

pytestmark = pytest.mark.apart

PAGE = EXAMPLES.parent / "adding_an_estimator.md"
SPLITS = {"sliding_mode": "mine", "window_transformer": "mine", "saturating_ekf": "steered"}
QUICK = {
    "sliding_mode": ["training.grid=2", "training.max_evaluations=20"],
    "window_transformer": ["training.max_epochs=3", "training.dtype=float64"],
    "saturating_ekf": [],
}


@pytest.fixture
def examples(place, tmp_path_factory, monkeypatch):
    """A place to work in where the examples are installed."""
    install_examples(tmp_path_factory.mktemp("examples") / "site", monkeypatch)
    place.add_steered()
    parts = {"train": [{"recording": "first"}], "validation": [{"recording": "second", "stop": 12}]}
    tests = {"test": [{"recording": "second", "start": 14, "stop": 20}]}
    place.change("conf/split/steered.yaml", name="steered", dataset="steered", **parts, tests=tests)
    yield place
    forget_examples()


def test_each_example_is_a_module_and_a_configuration_of_few_lines_on_the_page():
    lines = {
        file.name: len(file.read_text(encoding="utf-8").splitlines())
        for file in EXAMPLES.iterdir()
        if file.suffix in (".py", ".yaml", ".j2")
    }
    assert set(lines) == {f"{name}.{end}" for name in NAMES for end in ("py", "yaml")} | {
        "sliding_mode.c.j2"
    }
    assert lines["sliding_mode.c.j2"] <= 40
    page = PAGE.read_text(encoding="utf-8")
    for name, max_lines in {
        "window_transformer": 90,
        "sliding_mode": 70,
        "saturating_ekf": 135,
    }.items():
        assert lines[f"{name}.py"] + lines[f"{name}.yaml"] <= max_lines
        assert all(f"(examples/{name}.{end})" in page for end in ("py", "yaml"))


def test_entry_points_of_another_package_are_used_while_it_is_installed(examples, monkeypatch):
    assert set(NAMES) <= set(estimator_names())
    assert [estimator_class(name).__module__ for name in NAMES] == list(NAMES)
    monkeypatch.undo()
    forget_examples()
    assert "estimator 'sliding_mode' is not one of" in refusal(
        lambda: estimator_class("sliding_mode"), ConfigurationError
    )


@pytest.mark.parametrize("name", NAMES)
def test_example_is_trained_evaluated_read_back_and_runs_online_as_in_batch(name, examples):
    split = [f"split={SPLITS[name]}", f"estimator={name}", *QUICK[name], "tracking=none"]
    examples.done("train", *split)
    examples.done("eval", *split)
    (evaluation,) = (examples.folder / "outputs" / "evaluate").iterdir()
    table = pd.read_csv(evaluation / "metrics.csv")
    scored = table[
        (table["test_set"] == "test") & (table["subset"] == "all") & (table["metric"] == "rmse_vy")
    ]
    assert np.isfinite(scored["value"]).all()
    assert len(scored) == 1
    (folder,) = (examples.folder / "outputs" / "train").iterdir()
    assert read_artefact(folder).status == "complete"
    (trust,) = (examples.folder / "outputs" / "calibrate").glob("*/trust.yaml")
    assert {"bands", "guard", "health"} <= {
        key for key, value in yaml.safe_load(trust.read_text()).items() if value
    }
    model = vehest.load_model(folder)
    again = vehest.load_model(folder)
    drive = (
        linear_drive(8.0, seed=7)[0]
        if "steer" in model.channels
        else planar_drive(8.0, 100.0, seed=7, noise=0.02)
    )
    drive = drive.without_references()
    assert np.array_equal(
        vehest.estimate(drive, model)["vy"], vehest.estimate(drive, again)["vy"], equal_nan=True
    )
    at_rate = (
        drive
        if model.settings.rate_hz == drive.rate_hz
        else planar_drive(8.0, model.settings.rate_hz, seed=7)
    )
    (batch,) = model.estimate([at_rate.without_references()])
    stepper = model.online()
    ahead = stepper.horizon_steps
    steps = [
        stepper.step({channel: at_rate[channel][k] for channel in model.channels})["vy"]
        for k in range(len(at_rate))
    ]
    online = np.concatenate([np.full(ahead, np.nan), steps])[: len(at_rate)]
    assert np.array_equal(np.isnan(online), np.isnan(batch["vy"]))
    assert np.isfinite(online).sum() > 100
    assert np.nanmax(np.abs(online - batch["vy"])) <= 1e-9


def test_example_that_was_trained_is_not_trained_again_unless_a_setting_changes(examples):
    words = [
        "train",
        "split=mine",
        "estimator=sliding_mode",
        *QUICK["sliding_mode"],
        "tracking=none",
    ]
    assert [
        examples.told(*words, *more)["skipped"] for more in ((), (), ("estimator.injection=6.0",))
    ] == [False, True, False]
    assert len(list((examples.folder / "outputs" / "train").iterdir())) == 2


def test_saturating_axles_are_linearised_by_their_slope(examples):
    example = import_module("saturating_ekf")
    car = (1500.0, 2500.0, 1.2, 1.4, 9e4, 1.1e5, 0.9, 0.02)
    inputs = np.array([20.0, 0.1])
    state = np.array([-0.8, 0.4])
    step = 1e-5
    value, slope = example.linearised(state, inputs, car)
    around = [
        [example.model(state + side * step * axis, inputs, car) for side in (1, -1)]
        for axis in np.eye(2)
    ]
    np.testing.assert_array_equal(value, example.model(state, inputs, car))
    np.testing.assert_allclose(
        slope, np.stack([(after - before) / (2 * step) for after, before in around], 1), atol=1e-6
    )


def block_with(words):
    """The Python block of the page that has these words."""
    blocks = re.findall(
        r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )
    (matching_block,) = (block for block in blocks if words in block)
    return matching_block


def test_smallest_estimator_on_the_page_integrates_and_runs_online():
    namespace = {"__name__": "smallest"}
    exec(compile(block_with("class Leaky"), "smallest", "exec", dont_inherit=True), namespace)
    model = namespace["Leaky"].from_config({"rate_hz": 20.0, "decay": 0.9})
    drive = planar_drive(5.0)
    expected = 0.0
    stepper = model.online()
    (batch,) = model.estimate([drive.without_references()])
    for k in range(len(drive)):
        expected = 0.9 * expected + (drive["ay"][k] - drive["vx"][k] * drive["yaw_rate"][k]) / 20.0
        assert batch["vy"][k] == pytest.approx(expected, abs=1e-12)
        assert stepper.step({name: drive[name][k] for name in model.channels})[
            "vy"
        ] == pytest.approx(expected, abs=1e-12)
    (started,) = model.estimate([drive.without_references()], {"vy": 2.0})
    assert started["vy"][0] - batch["vy"][0] == pytest.approx(0.9 * 2.0)


def test_ten_statements_of_python_train_and_compare(examples, capsys):
    block = block_with("vehest.score")
    statements = [node for node in ast.walk(ast.parse(block)) if isinstance(node, ast.stmt)]
    assert len(statements) <= 10
    write_laps()
    exec(compile(block, "ten lines", "exec", dont_inherit=True), {"__name__": "ten_lines"})
    rows = capsys.readouterr().out.splitlines()
    assert [row.split("  ")[0] for row in rows] == [
        "Static map",
        "Sliding-mode observer",
        "Transformer",
    ]
    lap = vehest.read_recording("lap3.csv")
    for name, row in zip(("static_map", "sliding_mode", "window_transformer"), rows, strict=True):
        model = vehest.load_model(Path("models") / name)
        assert f"{vehest.score(model, [lap])['fvu']:.3f}" in row


def test_score_is_the_error_at_the_times_that_the_protocol_scores(examples):
    write_laps()
    lap = vehest.read_recording("lap3.csv")
    model = vehest.train("zero", [], [], ["estimator.rate_hz=100"])
    scored = lap["vy_ref"][150::5]  # 20 Hz, from 1.5 s on
    assert vehest.score(model, [lap])["rmse_vy"] == pytest.approx(
        np.sqrt(np.mean(scored**2)), rel=1e-3
    )
    bare = lap.without_references()
    for act, error, message in (
        (lambda: vehest.score(model, [bare]), DataError, "has no channel 'vy_ref'"),
        (
            lambda: vehest.train("static_map", [bare], [lap]),
            DataError,
            "no channel 'vy_ref', on which estimator 'static_map' is trained",
        ),
        (
            lambda: vehest.train("ksnn", [lap], [lap], ["estimator.n_hiden=2"]),
            ConfigurationError,
            "n_hiden",
        ),
    ):
        with pytest.raises(error, match=message):
            act()
    file = examples.folder / "raw" / "one.csv"
    assert [
        "vy_ref" in vehest.read_recording(file, ["dataset=mine"], references=references)
        for references in (False, True)
    ] == [False, True]


def test_python_and_the_command_train_equal_models(examples):
    words = ["split=mine", "estimator=ksnn", "training.max_epochs=2", "seed=3"]
    assert examples("train", *words, "tracking=none")[0] == 0
    (folder,) = (examples.folder / "outputs" / "train").iterdir()
    laps = [
        vehest.read_recording(
            examples.folder / "raw" / f"{name}.csv", ["dataset=mine"], references=True
        )
        for name in ("one", "two")
    ]
    trained = vehest.train("ksnn", laps[:1], laps[1:], ["training.max_epochs=2"], seed=3)
    for name, values in vehest.load_model(folder).weights().items():
        assert np.array_equal(values, trained.weights()[name])


def test_sliding_mode_decays_as_its_gain_says(examples):
    """d(v - v̂)/dt = -λ|ω|(v - v̂) in a steady turn, once û slides."""
    model = estimator_class("sliding_mode").from_config({"rate_hz": 2000.0, "layer": 0.02})
    model.values = {"gain": 4.0, "threshold": 0.0}
    time = np.arange(4000) / 2000.0
    steady = {"yaw_rate": 0.25, "vx": 20.0, "ay": 5.0, "ax": -0.25 * 1.5}  # v = 1.5 m/s, u = 20 m/s
    drive = Recording(
        "turn",
        "car",
        2000.0,
        0.0,
        {name: np.full(len(time), value) for name, value in steady.items()},
        "simulated",
    )
    error = 1.5 - model.estimate([drive])[0]["vy"]
    assert np.polyfit(time[1000:], np.log(error[1000:]), 1)[0] == pytest.approx(
        -4.0 * 0.25, rel=0.02
    )


def test_ekf_finds_the_motion_of_a_car_on_linear_tyres(examples):
    drive = linear_drive(12.0, seed=3, noise={"yaw_rate": 0.002, "ay": 0.05, "steer": 0.0})[0]
    model = estimator_class("saturating_ekf").from_config(
        {"friction": 100.0, "deviations": [0.05, 0.002]}
    )
    model.fit(FitData([drive], [drive]), NoTraining())
    assert vehest.score(model, [drive])["fvu"] < 0.02


def test_ekf_goes_on_where_nothing_was_measured(examples):
    drive = with_gaps(
        linear_drive(4.0, seed=3)[0], {"ay": slice(150, 250), "yaw_rate": slice(200, 300)}
    )
    model = estimator_class("saturating_ekf").from_config({})
    model.values = {"variance_vy": 1e-4, "variance_yaw_rate": 1e-5}
    (batch,) = model.estimate([drive.without_references()])
    stepper = model.online()
    steps = [
        stepper.step({channel: drive[channel][k] for channel in model.channels})["vy"]
        for k in range(len(drive))
    ]
    assert np.isfinite(batch["vy"]).all()
    assert np.abs(np.array(steps) - batch["vy"]).max() <= 1e-9
    with pytest.raises(
        DataError, match="'steer' is nan, which estimator 'saturating_ekf' cannot take"
    ):
        stepper.step({"vx": 20.0, "steer": np.nan, "ay": 0.0, "yaw_rate": 0.0})
