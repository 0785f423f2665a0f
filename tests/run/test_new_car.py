"""`vehest new` on the command line: what is asked, answered, written and refused, and that `vehest run` takes it."""

import io
import json
from pathlib import Path

import pytest
import yaml
from planted_logs import drive, usual, write
from typer.testing import CliRunner

from example_package import forget_examples, install_examples
from place import run_vehest
from vehest.cli import app
from vehest.data.files import ASIDE_PREFIX

FILES = ("conf/dataset/my_car.yaml", "conf/split/my_car.yaml", "pipelines/my_car.yaml")


@pytest.fixture
def log(tmp_path, monkeypatch):
    """A working folder with nothing but a log in it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("VEHEST_OUTPUT", str(tmp_path / "outputs"))
    monkeypatch.delenv("VEHEST_DATA", raising=False)
    return write(tmp_path / "lap.csv", usual(drive()))


def test_enter_takes_what_is_proposed_and_what_is_known_of_the_car_is_used(log):
    result = CliRunner().invoke(app, ["new", "my_car", "lap.csv"], input="\n2.7\n1500\n\n")
    assert result.exit_code == 0, result.output
    assert "yaw_rate: column Gyro, deg/s: ay and vx·yaw_rate agree" in result.output
    assert all(words in result.output for words in ("in a left turn, does column 'Gyro' count up?", "vehest run my_car"))
    dataset = yaml.safe_load(Path(FILES[0]).read_text(encoding="utf-8"))
    assert dataset["channels"]["ay"] == {"column": "LatAcc", "unit": "g"}
    assert [entry["name"] for entry in dataset["transforms"]] == ["velocity_from_sideslip", "steering_ratio"]
    pipeline = yaml.safe_load(Path(FILES[2]).read_text(encoding="utf-8"))
    sweeps = [" ".join(sweep) for sweep in pipeline["parts"]["all"]["sweeps"]]
    assert (sweeps[0], sweeps[1]) == ("estimator=zero,static_map,kinematic", "estimator=data_sheet estimator.wheelbase=2.7")
    assert any("estimator=kalman" in sweep and "estimator.car.mass=1500" in sweep for sweep in sweeps)


def test_an_answer_that_is_none_is_asked_again(log):
    result = CliRunner().invoke(app, ["new", "my_car", "lap.csv"], input="perhaps\nno\n-3\n\n\n\n")
    assert result.exit_code == 0, result.output
    assert "'perhaps' is neither yes nor no" in result.output
    assert "wheelbase must be a positive number, not '-3'" in result.output
    channels = yaml.safe_load(Path(FILES[0]).read_text(encoding="utf-8"))["channels"]
    assert {name: entry.get("sign", 1) for name, entry in channels.items()} == {
        "vx": 1,
        "yaw_rate": -1,
        "ay": -1,
        "ax": 1,
        "handwheel": -1,
        "sideslip_ref": -1,
    }


def test_a_column_can_be_declared_otherwise_or_left_out(tmp_path, log):
    d = drive()
    write(tmp_path / "two.csv", usual(d).assign(Speed2=3.6 * d["vx"] + 0.01))
    result = CliRunner().invoke(app, ["new", "my_car", "two.csv"], input="vx_ref km/h\n\n\n\n\n\n")
    assert result.exit_code == 0, result.output
    first = yaml.safe_load(Path(FILES[0]).read_text(encoding="utf-8"))["channels"]
    assert {first["vx"]["column"], first["vx_ref"]["column"]} == {"Speed", "Speed2"}
    result = CliRunner().invoke(app, ["new", "my_car", "two.csv", "--force"], input="-\n\n\n\n\n\n")
    assert result.exit_code == 0, result.output
    assert len(yaml.safe_load(Path(FILES[0]).read_text(encoding="utf-8"))["channels"]) == len(first) - 1


def test_yes_asks_nothing_and_lists_what_it_left_open(capsys, log):
    code, out, err = run_vehest(capsys, "new", "my_car", "lap.csv", "--yes")
    assert (code, err) == (0, "")
    assert "open, taken as proposed:\n  left_right: yes (in a left turn" in out
    assert all(f"wrote {file}: " in out for file in FILES)
    assert "Open, not decided by the log: in a left turn" in Path(FILES[0]).read_text(encoding="utf-8")


def test_json_says_all_of_it_to_a_script(capsys, log):
    code, out, err = run_vehest(capsys, "new", "my_car", "lap.csv", "--json", "--dry-run")
    assert (code, err) == (0, "")
    said = json.loads(out)
    assert {one["channel"]: one["column"] for one in said["channels"]}["ay"] == "LatAcc"
    assert said["time"] == {"column": "Time [s]", "unit": "s", "evidence": "unit in the header, 50 Hz", "asked": False}
    assert [question["key"] for question in said["open"]] == ["left_right"]
    assert said["has_reference"]
    assert said["lacking"]["data_sheet"] == "the car's wheelbase"
    assert not any(Path(file).exists() for file in FILES)
    code, out, _ = run_vehest(capsys, "new", "my_car", "lap.csv", "--json", "--answer", "left_right=no")
    assert json.loads(out)["open"] == []
    assert all(Path(file).exists() for file in FILES)


def test_run_takes_what_was_written(capsys, log):
    assert run_vehest(capsys, "new", "my_car", "lap.csv", "--yes", "--wheelbase", "2.7", "--mass", "1500")[0] == 0
    code, _, err = run_vehest(capsys, "run", "my_car", "--dry-run", "tracking=none")
    assert code == 0, err
    planned = [line.split()[2] for line in err.splitlines() if line.startswith("would   train")]
    assert planned[0].startswith("zero-")
    assert {name.split("-")[0] for name in planned} >= {
        "static_map",
        "data_sheet",
        "ksnn",
        "luenberger",
        "kalman",
        "gru",
        "sideslip_ffnn",
        "cnn_ukf",
    }
    code, out, _ = run_vehest(capsys, "data", "check", "my_car")
    assert code == 0, out


def test_nothing_is_overwritten_without_force(capsys, log):
    Path("conf/split").mkdir(parents=True)
    Path(FILES[1]).write_text("mine")
    code, out, err = run_vehest(capsys, "new", "my_car", "lap.csv", "--yes")
    assert (code, out) == (2, "")
    assert err == f"error: '{FILES[1]}' is there already; take another name, or --force to write it anew\n"
    assert Path(FILES[1]).read_text() == "mine"
    assert not Path(FILES[0]).exists()
    assert run_vehest(capsys, "new", "my_car", "lap.csv", "--yes", "--force")[0] == 0
    assert "dataset: my_car" in Path(FILES[1]).read_text()


def test_nothing_half_written_stays(capsys, log):
    Path("pipelines").write_text("a file where a folder is wanted")
    code, _, err = run_vehest(capsys, "new", "my_car", "lap.csv", "--yes")
    assert code in (2, 4)
    assert err.count("\n") == 1
    assert not any(path.is_file() for path in Path("conf").rglob("*"))
    assert not list(Path().rglob(f"{ASIDE_PREFIX}*"))


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("new", "my_car", "nowhere.csv", "--yes"), 4, "there is no file 'nowhere.csv'"),
        (("new", "my car", "lap.csv", "--yes"), 2, "'my car' must be made of letters"),
        (("new", "f1tenth", "lap.csv", "--yes"), 2, "is a data set that comes with vehest"),
        (("new", "my_car", "lap.csv", "--yes", "--answer", "left"), 2, "must be KEY=ANSWER"),
        (("new", "my_car", "lap.csv", "--yes", "--answer", "gear=3"), 2, "no question has the key 'gear'"),
        (("new", "my_car", "lap.csv"), 2, "no terminal for questions; add --yes"),
    ],
)
def test_what_cannot_be_done_is_one_line(capsys, log, monkeypatch, words, code, said):
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    found, _, err = run_vehest(capsys, *words)
    assert found == code
    assert said in err
    assert err.count("error:") == 1


def test_files_beside_those_that_are_named_stay_out_of_the_data_set(tmp_path, capsys, log):
    for number in (1, 2):
        write(tmp_path / f"run_{number}.csv", usual(drive(seed=number)))
    write(tmp_path / "run_other.csv", usual(drive(seed=3)))
    assert run_vehest(capsys, "new", "my_car", "run_1.csv", "run_2.csv", "--yes")[0] == 0
    code, out, _ = run_vehest(capsys, "data", "show", "my_car", "--json")
    assert (code, [one["id"] for one in json.loads(out)["recordings"]]) == (0, ["run_1", "run_2"])


def test_without_a_speed_no_pipeline_is_written_that_could_not_run(tmp_path, capsys, log):
    write(tmp_path / "slow.csv", usual(drive()).drop(columns="Speed"))
    code, out, _ = run_vehest(capsys, "new", "my_car", "slow.csv", "--yes")
    assert code == 0
    assert "vx is missing" in out
    assert "vehest run" not in out
    assert not Path(FILES[2]).exists()
    assert run_vehest(capsys, "data", "check", "my_car")[0] == 0


def test_without_speed_and_accelerations_the_yaw_rate_alone_is_written(tmp_path, capsys, log):
    write(tmp_path / "gyro.csv", usual(drive())[["Time [s]", "Gyro"]].assign(Voltage=12.0))
    code, out, err = run_vehest(capsys, "new", "my_car", "gyro.csv", "--yes")
    assert (code, err) == (0, "")
    assert "it lacks vx, ax, ay" in out


def test_short_recordings_stay_whole_and_too_little_stops_with_what_to_record(tmp_path, capsys, log):
    for number in range(10):
        part = usual(drive(seed=number)).iloc[:400]
        write(tmp_path / f"turn_{number}.csv", part)
    files = [f"turn_{number}.csv" for number in range(10)]
    code, out, _ = run_vehest(capsys, "new", "my_car", *files, "--yes")
    assert code == 0
    assert "whole recordings (10, 80 s in all)" in out
    split = yaml.safe_load(Path(FILES[1]).read_text(encoding="utf-8"))
    parts = {"train": split["train"], "validation": split["validation"], "test": split["tests"]["test"]}
    assert {name: len(own) for name, own in parts.items()} == {"train": 5, "validation": 2, "test": 3}
    assert sorted(one["recording"] for own in parts.values() for one in own) == [f"turn_{number}" for number in range(10)]
    code, out, _ = run_vehest(capsys, "new", "my_car", *files[:2], "--yes", "--force")
    assert code == 0
    assert "16 s in 2 recordings are too short to train, stop and test on: record two minutes or more" in out
    assert "vehest run" not in out


def test_force_takes_away_split_and_pipeline_that_the_new_logs_do_not_allow(tmp_path, capsys, log):
    assert run_vehest(capsys, "new", "my_car", "lap.csv", "--yes")[0] == 0
    write(tmp_path / "bare.csv", usual(drive()).drop(columns="Beta"))
    assert run_vehest(capsys, "new", "my_car", "bare.csv", "--yes", "--force")[0] == 0
    assert [Path(file).exists() for file in FILES] == [True, False, False]


def test_a_stop_gives_in_json_what_was_found_and_a_dry_run_needs_no_force(capsys, log):
    assert run_vehest(capsys, "new", "my_car", "lap.csv", "--yes")[0] == 0
    before = [Path(file).read_text() for file in FILES]
    code, out, err = run_vehest(capsys, "new", "my_car", "lap.csv", "--json", "--dry-run", "--answer", "gear=3")
    found = json.loads(out)
    assert (code, err) == (2, f"error: {found['stopped']}\n")
    assert "vx" in [one["channel"] for one in found["channels"]]
    code, out, _ = run_vehest(capsys, "new", "my_car", "lap.csv", "--json", "--dry-run")
    assert ((code, json.loads(out)["dry_run"]), [Path(file).read_text() for file in FILES]) == ((0, True), before)


def test_an_estimator_of_ones_own_is_compared_too(tmp_path, capsys, log, monkeypatch):
    code, _, err = run_vehest(capsys, "new", "my_car", "lap.csv", "--yes", "--with", "sliding_mode:SlidingMode")
    assert code == 2
    assert '[project.entry-points."vehest.estimators"], NAME = "sliding_mode:SlidingMode"; then install it with pip' in err
    install_examples(tmp_path / "installed", monkeypatch)
    try:
        code, _, err = run_vehest(capsys, "new", "my_car", "lap.csv", "--yes", "--with", "sliding_mode:SlidingMode")
        assert code == 0, err
        sweeps = yaml.safe_load(Path(FILES[2]).read_text(encoding="utf-8"))["parts"]["all"]["sweeps"]
        assert ["estimator=sliding_mode"] in sweeps
    finally:
        forget_examples()
