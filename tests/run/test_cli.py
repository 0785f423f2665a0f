"""The command line from end to end, on a small data set of its own: what runs, what is skipped,
what is refused.
"""

import importlib.util
import json
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

import processes
import vehest
from conftest import planar_drive
from place import DATASET, PIPELINE, write_csv
from processes import HANGS, Striking, is_alive, start, wait_for
from vehest.artefacts.artefact import read_artefact
from vehest.data.files import ASIDE_PREFIX
from vehest.data.store import read_estimate, read_recording
from vehest.run import ingest, inspect_data, runner
from vehest.run.comparison import NO_TIME
from vehest.run.signals import TimeLimit
from vehest.training import supervised
from vehest.trust.health import reason_in_words


def _statuses(err):
    return [
        tuple(line.split()[:2])
        for line in err.splitlines()
        if line.split()[:1] and line.split()[0] in ("done", "reused", "would")
    ]


def test_pipeline_reuses_artefacts_and_reruns_only_changed_stages(place):
    out, err = place.once("run", "small", "tracking=none")
    assert "KS-NN linear no bias, P = 2" in out
    assert [stage for status, stage in _statuses(err) if status == "done"].count("train") == 4
    (report,) = (place.folder / "outputs").glob("report/*/report.md")
    text = report.read_text()
    assert "**Simulated data:** every number here comes from simulated recordings" in text
    assert not any(words in text.lower() for words in ("real data", "| real |"))
    metrics = pd.read_csv(report.with_name("metrics.csv"))
    columns = ["study", "estimator", "variant", "trained_on", "dataset", "kind"]
    assert list(metrics.columns[:6]) == columns
    assert set(metrics["kind"]) == {"simulated"}
    assert {"rmse_sideslip", "rmse_vy", "fvu", "n_parameters", "epochs"} <= set(metrics["metric"])
    files = place.files()

    again, err = place.done("run", "small", "tracking=none")
    assert ({status for status, _ in _statuses(err)}, again, place.files()) == (
        {"reused"},
        out,
        files,
    )

    (place.folder / "README.md").write_text("changed")
    place.change("conf/dataset/mine.yaml", citation="somebody else", licence="another")
    _, _, err = place("run", "small", "tracking=none", "--dry-run")
    assert {status for status, _ in _statuses(err)} == {"reused"}

    _, _, err = place("run", "small", "tracking=none", "training.learning_rate=0.002")
    done = [line for line in err.splitlines() if line.startswith("done")]
    assert not any("luenberger" in line for line in done), "its training has no learning rate"
    assert sum(" train " in line for line in done) == 3
    assert not any(" ingest " in line or " downsample " in line for line in done)


@pytest.mark.apart
def test_two_processes_give_the_same_numbers_and_a_dry_run_writes_nothing(place):
    place.change("pipelines/small.yaml", sweeps=PIPELINE["sweeps"][1:])
    assert ("would", "ingest") in _statuses(place.done("run", "small", "--dry-run")[1])
    assert place.files() == set()
    place("run", "small", "tracking=none", "output=one")
    place.done("run", "small", "--jobs", "2", "tracking=none", "output=two")
    for model in (place.folder / "one" / "train").iterdir():
        parallel = place.folder / "two" / "train" / model.name
        assert (model / "model.safetensors").read_bytes() == (
            parallel / "model.safetensors"
        ).read_bytes()


def test_failed_jobs_are_reported_and_other_results_remain(place):
    sweeps = [
        PIPELINE["sweeps"][0],
        [
            "estimator=ksnn",
            "estimator.n_hidden=0",
            "estimator.bias=true",
            "training.learning_rate=1e6",
        ],
    ]
    place.change("pipelines/small.yaml", sweeps=sweeps)
    code, out, err = place("run", "small", "tracking=none")
    assert code == 5
    assert (
        "1 of 2 jobs failed, the others are kept; ksnn-linear_bias_p2 seed 0: training: the "
        "validation loss" in err
    )
    assert "Traceback" not in err
    remaining = {
        folder.name.split("-seed")[0] for folder in (place.folder / "outputs" / "train").iterdir()
    }
    assert remaining == {"luenberger-luenberger"}
    assert all(
        words in out
        for words in (
            "Luenberger",
            "left out: ksnn-linear_bias_p2 seed 0: training: the validation loss",
        )
    )
    (report,) = (place.folder / "outputs").glob("report/*/report.md")
    assert (
        "`ksnn-linear_bias_p2 seed 0` is left out: training: the validation loss"
        in report.read_text()
    )
    assert not (place.folder / "results").exists()


def test_train_eval_estimate_and_report_run_as_separate_commands(place):
    arguments = ("estimator=ksnn", "split=mine", "training.max_epochs=2", "seed=3", "tracking=none")
    trained = place.told("train", *arguments)
    assert (
        trained["status"],
        trained["n_parameters"],
        place.told("train", *arguments)["skipped"],
    ) == ("complete", 28, True)
    assert place.told("train", *arguments, "--force")["skipped"] is False

    by_overrides = place.told("eval", *arguments)
    name = Path(trained["model"]).name
    by_name = place.told("eval", "--model", name, "split=mine", "tracking=none")
    assert by_name["rmse_sideslip.test"] == by_overrides["rmse_sideslip.test"]
    write_csv(place.folder / "lap.csv", 9).drop(columns="Vy").to_csv("lap.csv", index=False)
    channels = {name: entry for name, entry in DATASET["channels"].items() if name != "vy_ref"}
    place.change("conf/dataset/lap.yaml", **DATASET | {"name": "lap", "channels": channels})
    for out in ("out.parquet", "out.csv"):
        assert (
            place.told("estimate", name, "lap.csv", "dataset=lap", "-o", out)["estimated"]
            == 600 - 30
        )
    frame = pq.read_table("out.parquet").to_pandas()
    text = pd.read_csv("out.csv")
    for column in ("vy", "sideslip", "band_vy", "band_sideslip", "health", "sideslip_deg"):
        # half a unit of the sixth digit
        assert np.allclose(frame[column], text[column], rtol=5e-6, atol=0.0, equal_nan=True), column
    assert np.allclose(frame["time"], text["time"], rtol=0.0, atol=5.1e-7)
    for angle in ("sideslip", "band_sideslip"):
        assert np.allclose(frame[f"{angle}_deg"], np.degrees(frame[angle]), equal_nan=True)
    units = {
        field.name: field.metadata[b"unit"].decode()
        for field in pq.ParquetFile("out.parquet").schema_arrow
    }
    expected_units = {
        "time": "s",
        "vy": "m/s",
        "sideslip": "rad",
        "band_vy": "m/s",
        "band_sideslip": "rad",
        "health": "1",
        "health_reason": "1",
        "sideslip_deg": "deg",
        "band_sideslip_deg": "deg",
    }
    assert units == expected_units
    assert list(text.columns) == list(frame.columns) == list(expected_units)
    assert "sideslip_deg" not in read_estimate(Path("out.parquet")).channels
    assert [reason_in_words(code) for code in frame["health_reason"]] == text[
        "health_reason"
    ].fillna("").tolist()

    model = vehest.load_model(trained["model"])
    estimate = vehest.estimate(vehest.read_recording("lap.csv", ["dataset=lap"]), model)
    vehest.write_estimate(estimate, "api.parquet")
    assert np.array_equal(estimate["vy"], frame["vy"], equal_nan=True)


def test_ingest_keeps_units_and_signs_and_downsample_the_rate(place):
    recording = read_recording(Path(place.told("ingest", "mine")["folder"]) / "one.parquet")
    truth = planar_drive(30.0, 100.0, seed=1, noise=0.02)
    for name in ("vx", "yaw_rate", "ay", "ax", "vy_ref"):
        assert np.allclose(recording[name], truth[name], rtol=0, atol=1e-9), name
    assert (
        read_recording(
            Path(place.told("downsample", "mine", "rate_hz=20")["folder"]) / "one.parquet"
        ).rate_hz
        == 20.0
    )


def test_data_commands_list_show_and_check(place, monkeypatch):
    monkeypatch.setattr(
        inspect_data, "choices", lambda _: ["ferrari_250lm", "mine", "sim_quickstart"]
    )
    rows = place.told("data", "list")
    assert [row["dataset"] for row in rows] == ["ferrari_250lm", "mine", "sim_quickstart"]
    assert next(row for row in rows if row["dataset"] == "mine")["here"] == "yes"
    assert "ferrari_250lm: Revs Vehicle Dynamics Database" in place("data", "list")[1]
    description = place.told("data", "show", "mine")
    assert [recording["id"] for recording in description["recordings"]] == ["one", "three", "two"]
    assert description["recordings"][0]["rate_hz"] == 100.0
    out, _ = place.done("data", "check", "mine")
    assert "d(vy_ref)/dt vs. ay - vx·yaw_rate: correlation" in out
    assert "yaw_rate" in place("data", "channels")[1]
    assert "one: simulated" in place("data", "show", "mine")[1]
    frame = pd.DataFrame(
        {"time": 1672875115.4 + np.arange(100) / 100.0, "vx": np.linspace(20.0, 21.0, 100)}
    )
    frame.to_csv(place.folder / "unix.csv", index=False)
    assert (
        "100 Hz, 0 s to 1 s from 2023-01-04 23:31:55 UTC on, 100 samples"
        in place("data", "show", "unix.csv")[1]
    )


def test_doctor_names_the_purpose_of_an_absent_extra(place, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name, *options: None if name == "optuna" else find(name, *options) or find("vehest"),
    )
    checks = {item["name"]: item for item in place.told("doctor")}
    assert (checks["compiled recursions"]["level"], checks["extras"]["level"]) == ("ok", "warning")
    assert "Optuna need 'vehest[tuning]': pip install" in checks["extras"]["message"]


def test_help_shows_choices_and_answers_quickly(place):
    _, out, _ = place("train", "--help")
    assert all(words in out for words in ("luenberger", "ferrari_drive"))
    code = (
        "import sys; sys.argv = ['vehest', '--help']; import vehest.cli as c\ntry: c.main()\n"
        "except SystemExit: pass\n"
    )
    code += (
        "print(sorted({m.split('.')[0] for m in sys.modules} & {'torch', 'mlflow', 'hydra', "
        "'pandas', 'numba', 'matplotlib'}))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.splitlines()[-1] == "[]", "--help must import nothing heavy"


def test_missing_file_is_reported_before_heavy_libraries_are_imported(place):
    (place.folder / "lap.csv").write_text("time,vx\n")
    commands = {
        "estimate none.csv": "none.csv",
        "estimate self_calibrating none.csv dataset=mine": "none.csv",
        "estimate lap.csv --car none.yaml": "none.yaml",
        "new my_car none.csv --yes": "none.csv",
        "new my_car lap.csv none.csv": "none.csv",
        "data show none.csv": "none.csv",
        "data check none.csv": "none.csv",
        "data usable folder/none": "folder/none",
        "data align none.csv -e delay": "none.csv",
        "compare none.csv lap.csv": "none.csv",
        "compare lap.csv none.parquet dataset=mine": "none.parquet",
        "plot none.csv": "none.csv",
        "plot lap.csv none.parquet start=1": "none.parquet",
        "identify lap.csv none.csv estimator.wheelbase=2.7": "none.csv",
        "replay none.asc --dbc lap.csv": "none.asc",
        "replay lap.csv --dbc none.dbc": "none.dbc",
        "export pretrained --vectors none.csv": "none.csv",
        "run none.yaml": "none.yaml",
        "report none.yaml": "none.yaml",
    }
    program = (
        "import sys\nfrom vehest.cli import main\nfor line in sys.stdin:\n"
        "    sys.argv = ['vehest', *line.split()]\n"
        "    try: main()\n"
        "    except SystemExit as end: code = end.code\n"
        "    heavy = {'torch', 'numba', 'hydra', 'pandas', 'scipy', 'matplotlib', 'mlflow'}\n"
        "    print(code, sorted(heavy & set(sys.modules)), file=sys.stderr)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", program],
        input="\n".join(commands),
        capture_output=True,
        text=True,
        check=True,
    )
    lines = result.stderr.splitlines()
    assert len(lines) == 2 * len(commands), result.stderr
    for command, error, after in zip(commands, lines[::2], lines[1::2], strict=True):
        assert f"'{commands[command]}'" in error, (command, error)
        assert after == "4 []", (command, after)


def test_closest_data_set_is_named_for_a_word_that_is_no_file(place):
    code, _, err = place("data", "check", "mien")
    assert (code, "'mien' is neither a data set nor a file; did you mean 'mine'?" in err) == (
        2,
        True,
    ), err


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda table: table.drop(columns="Yaw"), "has no column 'Yaw' (it has Time, Speed"),
        (
            lambda table: table.drop(index=range(100, 200)),
            ("one.csv': 1 gap, the longest of 1.01 s after 0.99 s", "dataset.clock=interpolate"),
        ),
        (
            lambda table: table.assign(LatAcc=table["LatAcc"].where(table.index != 500)),
            ("one.csv", "'ay' holds 1 NaN between 5 s and 5 s"),
        ),
    ],
)
def test_bad_tables_are_a_single_clear_line_with_every_command(place, change, says):
    path = place.folder / "raw" / "one.csv"
    change(pd.read_csv(path)).to_csv(path, index=False)
    for command in (
        ("ingest", "mine"),
        ("train", "split=mine", "tracking=none"),
        ("run", "small", "tracking=none"),
    ):
        assert place.refused(*command, says=says)[0] in (3, 4)
    assert place.files() == set()


def test_empty_and_truncated_files_and_wrong_units_are_a_single_clear_line(place):
    path = place.folder / "raw" / "one.csv"
    channels = DATASET["channels"] | {"yaw_rate": {"column": "Yaw", "unit": "rad/s"}}
    place.change("conf/dataset/mine.yaml", channels=channels)
    place.refused("ingest", "mine", code=3, says=("recording 'one': channel 'yaw_rate'", "degrees"))
    code, out, _ = place("data", "check", "mine")
    assert (code, "degrees" in out, place.files()) == (3, True, set())
    pd.read_csv(path).to_parquet(place.folder / "raw" / "one.parquet")
    path.write_text("")
    place.refused("ingest", "mine", says="one.csv' is empty")
    content = (place.folder / "raw" / "one.parquet").read_bytes()
    (place.folder / "raw" / "one.parquet").write_bytes(content[: len(content) // 2])
    place.refused(
        "ingest",
        "mine",
        "dataset.files=one.parquet",
        code=3,
        says=("one.parquet' is truncated or damaged", "truncated"),
    )


TRAIN = ("train", "split=mine", "tracking=none")
RUN = ("run", "small", "tracking=none")
TESTED = [{"recording": "three"}]


@pytest.mark.parametrize(
    ("changes", "command", "code", "says"),
    [
        (
            {},
            ("ingest", "mine", "root=/no/such/folder"),
            4,
            "there is no folder '/no/such/folder'; give root=FOLDER or set VEHEST_DATA",
        ),
        ({}, ("estimate", "nothing", "lap.csv"), 4, ""),
        ({}, (*TRAIN, "split.train=[{recording: four}]"), None, "has no recording 'four'"),
        (
            {},
            (*TRAIN, "split.tests.test=[{recording: one, start: 5, stop: 10}]"),
            None,
            "share samples of recording 'one'",
        ),
        *(
            ({}, (*TRAIN, words), None, "")
            for words in ("seed=-1", "training.max_epochs=.inf", "downsample.transforms=[1]")
        ),
        ({}, ("run", "small", "split=quickstart"), None, ""),
        ({}, ("downsample", "mine"), None, ""),
        (
            {},
            (*RUN, "--minutes", "0.000001"),
            3,
            ("no estimator was done in this time", "goes on with: luenberger-luenberger-seed0"),
        ),
        ({}, (*RUN, "--minutes", "0"), 2, "--minutes must be positive, not 0"),
        ({"study": ""}, RUN, 2, "is not a pipeline"),
        (
            {"sweeps": [["estimator=gru"], ["estimator=lstm", "evaluation.rate_hz=10"]]},
            RUN,
            2,
            "must agree in 'evaluation'",
        ),
        ({"tests": {"validation": TESTED}}, TRAIN, 2, "a test set cannot be called 'validation'"),
        ({"tests": {"../x": TESTED}}, TRAIN, 2, "becomes part of file names"),
        ({"tests": {"t": []}}, TRAIN, 2, "test set 't' is empty"),
    ],
)
def test_invalid_input_is_refused_in_a_single_line(place, changes, command, code, says):
    if changes:
        place.change(
            "conf/split/mine.yaml" if "tests" in changes else "pipelines/small.yaml", **changes
        )
    assert place.refused(*command, code=code, says=says)[0] in (2, 3, 4)
    assert {path.name for path in place.folder.iterdir()} <= {"raw", "conf", "pipelines", "outputs"}


def test_estimate_and_evaluation_refuse_unsuitable_recordings_and_replace_nothing(
    place, monkeypatch
):
    place.once(
        "train",
        "estimator=luenberger",
        "split=mine",
        "training.grid=1",
        "training.max_evaluations=5",
        "tracking=none",
    )
    drive = planar_drive(10.0, 20.0).without_references()
    slow = drive.to_pandas().reset_index()
    for name, table in (
        ("slow", slow.iloc[::5]),
        ("less", slow.drop(columns="ax")),
        ("lap", slow.assign(time=slow["time"] / 5.0)),
    ):
        table.to_csv(f"{name}.csv", index=False)
    Path("parts.parquet").mkdir()
    for name, out, says in (
        ("slow.csv", "out.parquet", "below the 100 Hz needed; record or export it at 5 Hz or"),
        ("less.csv", "out.parquet", "no channel 'ax'"),
        ("slow.csv", "out.xlsx", "must end in .parquet, .csv or"),
        ("lap.csv", "parts.parquet", "is a folder"),
        ("lap.csv", "lap.csv", "is the recording itself"),
    ):
        place.refused("estimate", "luenberger", name, "-o", out, says=says)
        assert not Path("out.parquet").exists()
    slow.to_csv("twenty.csv", index=False)
    _, output = place.done("estimate", "luenberger", "twenty.csv", "-o", "out.csv")
    assert "sampled at 20 Hz and brought to the 100 Hz of 'luenberger'" in output
    swapped = (
        "split.train=[{recording: three}]",
        "split.tests.test=[{recording: one, start: 5, stop: 20}]",
    )
    place.refused(
        "eval",
        "--model",
        "luenberger",
        "split=mine",
        *swapped,
        "tracking=none",
        code=2,
        says="shares samples with the ranges",
    )
    monkeypatch.delenv("VEHEST_DATA")
    place.refused("ingest", "mine", code=4, says="no data root is set")


@pytest.mark.apart
def test_unfinished_jobs_of_a_time_limit_are_named_and_continued(place, monkeypatch):
    outputs = place.folder / "outputs"

    class SingleEvaluation(TimeLimit):
        """A time that is up once one evaluation is there."""

        def requested(self):
            return any((outputs / "evaluate").glob("*/manifest.json"))

    with monkeypatch.context() as patched:
        patched.setattr(runner, "TimeLimit", SingleEvaluation)
        code, out, err = place("run", "small", "tracking=none", "--minutes", "10")
    assert code == 0, err
    assert "Luenberger" in out
    assert f"left out: gru-states_2-seed0: {NO_TIME}" in out
    output, err = place.done("report", "small", "tracking=none")
    assert output == out, "the same report"
    drawn = place.told("report", "small", "tracking=none")
    assert {row["estimator"] for row in drawn["leaderboard"]} == {"luenberger"}
    assert drawn["failed"]["gru-states_2-seed0"] == NO_TIME
    assert "gru-states_2-seed0; 'vehest run small tracking=none' goes on with them" in err
    out, _ = place.done("run", "small", "tracking=none", "--minutes", "10")
    assert "not done yet" not in out
    assert "GRU" in out


@pytest.mark.apart
def test_the_next_command_that_is_printed_finds_data_and_results_elsewhere(place, monkeypatch):
    folder = place.folder / "my results"
    monkeypatch.setenv("VEHEST_DATA", str(place.folder))
    words = ["small", f"root='{place.folder}/raw'", f"output='{folder}'", "tracking=none"]

    def printed_command(err):
        (line,) = (line for line in err.splitlines() if "'vehest " in line)
        command = line[line.index("vehest ") :]
        for ending in ("' goes on with them", "' first"):
            command = command.split(ending)[0]
        return shlex.split(command)[1:]

    code, _, err = place("report", *words)
    assert code == 4
    again = printed_command(err)
    assert again == ["run", *words]
    place.done(*again)
    shutil.rmtree(next((folder / "train").glob("gru-*")))
    _, err = place.done("report", *words)
    assert printed_command(err) == ["run", *words]
    place.done(*printed_command(err))
    assert [file.name for file in folder.glob("train/gru-*")]
    assert not (place.folder / "outputs").exists()


def test_the_training_that_an_evaluation_asks_for_can_be_pasted(place):
    words = ["estimator=luenberger", "split=mine", "training.grid=1", "training.max_evaluations=20"]
    words += ["output=my results", "tracking=none"]
    overrides = ["evaluation.rate_hz=10", "fault=frozen", "fault.channel=yaw_rate"]
    _, line = place.refused("eval", *words, *overrides, code=4)
    command = shlex.split(line[line.index("vehest ") : line.index("' first")])
    assert command == ["vehest", "train", *words]
    place.done(*command[1:])
    place.done("eval", *words)


@pytest.mark.apart
def test_only_the_study_as_it_is_written_is_published(place):
    place.change("pipelines/small.yaml", publish=True, sweeps=PIPELINE["sweeps"][:1])
    results = place.folder / "results" / "small"
    assert place("run", "small", "tracking=none", "training.max_evaluations=5")[0] == 0
    assert not results.exists(), "overrides changed the outcome"
    assert place("run", "small", "tracking=none")[0] == 0
    assert (results / "metrics.csv").is_file()
    assert not (results / "report.html").exists()
    text = (results / "report.md").read_text()
    assert "`vehest run pipelines/small.yaml`" in text
    assert str(place.folder) not in text + (results / "provenance.json").read_text()


def test_a_model_remembers_how_its_recordings_were_prepared(place):
    arguments = ("split=mine", "training.max_epochs=1", "tracking=none")
    filtered = (*arguments, "downsample.transforms=[{name: low_pass, cutoff_hz: 0.3}]")
    model = place.told("train", *filtered)["model"]
    by_overrides = place.told("eval", *filtered)
    by_name = place.told("eval", "--model", model, *arguments)
    assert by_name["folder"] == by_overrides["folder"]
    unfiltered = place.told("eval", "--model", model, *arguments, "downsample.transforms=[]")
    assert unfiltered["rmse_sideslip.test"] != by_name["rmse_sideslip.test"]
    references = {
        json.dumps(read_artefact(Path(outcome["folder"])).inputs["reference of mine/three"])
        for outcome in (by_name, unfiltered)
    }
    assert len(references) == 1, "what is scored against is never filtered"


BUDGET = (
    "split=mine",
    "training.max_epochs=8",
    "training.patience=8",
    "training.checkpoint_seconds=0",
    "tracking=none",
    "--json",
)
SAVES = (supervised, "save_checkpoint")  # once an epoch


def _killed(place, module, name, call, *arguments):
    """Run a command in a process that is killed once a function of a module is through for the n-th
    time.
    """
    program = (
        f"import sys; sys.path.insert(0, {str(Path(processes.__file__).parent)!r}); sys.argv = "
        f"{['vehest', *arguments]!r}\n"
    )
    program += (
        f"import {module.__name__} as module; from processes import Striking; from vehest.cli "
        f"import main\n"
    )
    program += f"module.{name} = Striking(module.{name}, {call}, {int(signal.SIGKILL)}); main()"
    assert start([sys.executable, "-c", program], cwd=place.folder).wait(HANGS) == -signal.SIGKILL


def _epochs(place, monkeypatch, *arguments):
    """Run a training: epochs of its checkpoints, and what it says."""
    with monkeypatch.context() as patch:
        save = Striking(supervised.save_checkpoint)
        patch.setattr(*SAVES, save)
        code, out, err = place("train", *BUDGET, *arguments)
    assert code == 0, err
    return [checkpoint.values["epoch"] for _, checkpoint in save.calls], json.loads(out)


@pytest.mark.apart
@pytest.mark.parametrize(
    ("number", "code", "options", "first"),
    [
        (signal.SIGINT, 130, (), 4),
        (signal.SIGTERM, 143, (), 4),
        (signal.SIGTERM, 143, ("--force",), 1),
    ],
)
def test_a_signal_in_training_keeps_the_best_so_far_and_the_next_run_goes_on(
    place, monkeypatch, number, code, options, first
):
    with monkeypatch.context() as patch:
        patch.setattr(*SAVES, Striking(supervised.save_checkpoint, 3, number))
        ended, _, err = place("train", *BUDGET)
    assert ended == code, err
    assert "the best so far is kept in" in err
    (model,) = (place.folder / "outputs" / "train").iterdir()
    assert read_artefact(model).status == "interrupted"
    assert not any(ASIDE_PREFIX in name for name in place.files())
    assert _epochs(place, monkeypatch, *options)[0][0] == first, (
        "from the checkpoint, with --force from the start"
    )


@pytest.mark.apart
def test_kill_9_in_training_goes_on_to_the_result_of_an_undisturbed_run(place, monkeypatch):
    _killed(place, *SAVES, 3, "train", *BUDGET)
    assert not list((place.folder / "outputs").glob("train/[!.]*"))
    epochs, resumed = _epochs(place, monkeypatch)
    assert epochs[0] == 4
    _, uninterrupted = _epochs(place, monkeypatch, "output=undisturbed")
    assert resumed["epochs"] == uninterrupted["epochs"] == 8
    weights = [
        (Path(model) / "model.safetensors").read_bytes()
        for model in (resumed["model"], uninterrupted["model"])
    ]
    assert weights[0] == weights[1]
    assert not any("checkpoint" in name for name in place.files())


@pytest.mark.apart
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_signal_or_kill_in_ingest_leaves_nothing_that_looks_finished(place, monkeypatch, number):
    if number == signal.SIGTERM:
        with monkeypatch.context() as patch:
            patch.setattr(ingest, "write_recording", Striking(ingest.write_recording, 2, number))
            assert place("ingest", "mine")[0] == 143
        assert not any(ASIDE_PREFIX in name for name in place.files())
    else:
        _killed(place, ingest, "write_recording", 2, "ingest", "mine")
        assert sum(name.endswith(".parquet") for name in place.files()) == 2, "it was in the middle"
    assert not list((place.folder / "outputs" / "ingest").glob("mine-*"))
    assert len(place.told("ingest", "mine")["recordings"]) == 3
    assert not any(ASIDE_PREFIX in name for name in place.files()), (
        "what the killed run left is cleared away"
    )


@pytest.mark.apart
def test_killed_pipeline_leaves_no_processes_and_the_next_run_finishes(place):
    place.change("pipelines/small.yaml", sweeps=PIPELINE["sweeps"][:2])
    endless = (
        "training.max_epochs=100000",
        "training.patience=100000",
        "training.checkpoint_seconds=0",
        "tracking=none",
    )
    process = start(
        [sys.executable, "-m", "vehest", "run", "small", "--jobs", "2", *endless], cwd=place.folder
    )
    wait_for(lambda: list((place.folder / "outputs" / "checkpoints").glob("*/*")), process)
    children = [
        int(pid)
        for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    ]
    assert children
    process.kill()
    wait_for(lambda: not any(map(is_alive, children)))
    place.done("run", "small", "tracking=none")
