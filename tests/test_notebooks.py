"""From Python: notebooks and the page's lines run as shown, the interface is typed, complete and
quick to import.
"""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from run_notebooks import code_cells, notebooks, pictures_of, read_notebook, run_cells, texts_of

import vehest
from place import run_vehest
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.store import read_estimate

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "from_python.md"
LOG = ROOT / "docs" / "examples" / "lap.csv"
COLUMNS = {"time": "Timestamp:s", "vx": "Speed:km/h", "yaw_rate": "GyroZ:deg/s"}
COLUMNS |= {"ax": "AccX:m/s²", "ay": "-AccY:m/s²"}


def block(language, number=0):
    text = PAGE.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)[number]


@pytest.mark.apart
@pytest.mark.parametrize("path", notebooks(), ids=lambda path: path.stem)
def test_notebook_stores_the_current_output_of_its_cells(path):
    notebook = read_notebook(path)
    stored = [cell["outputs"] for cell in code_cells(notebook)]
    results = run_cells(notebook)
    assert [texts_of(outputs) for outputs in results] == [texts_of(outputs) for outputs in stored]
    assert len(pictures_of(results)) == len(pictures_of(stored)) > 0


@pytest.mark.apart
def test_lines_of_the_page_run_and_print_the_stated_output(tmp_path, monkeypatch, capsys):
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    monkeypatch.chdir(tmp_path)
    lines = block("python")
    assert len(lines.splitlines()) <= 15
    exec(compile(lines, "from_python", "exec", dont_inherit=True), {"__name__": "from_python"})
    assert capsys.readouterr().out == block("output")
    assert Path("lap.png").is_file()
    assert read_estimate(Path("estimate.parquet")).estimator == "self_calibrating"
    exec(compile(block("python", 1), "online", "exec", dont_inherit=True), {"__name__": "online"})
    assert capsys.readouterr().out == block("output", 1)


@pytest.mark.apart
def test_mypy_infers_the_types_of_the_pages_lines(tmp_path):
    revealed = "\n".join(
        f"reveal_type({name})"
        for name in ("vehest.estimate", "recording", "estimate", "estimate.plot", "vehest.online")
    )
    file = tmp_path / "lines.py"
    file.write_text(f"{block('python')}\n{revealed}\n", encoding="utf-8")
    words = ["mypy", "--strict", "--cache-dir", str(tmp_path / "cache"), str(file)]
    done = subprocess.run(
        [sys.executable, "-m", *words], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 0, done.stdout
    types = re.findall(r'Revealed type is "(.*)"', done.stdout)
    assert len(types) == 5
    assert types[0].endswith("-> vehest.api.Estimate")
    assert types[1:3] == ["vehest.api.Recording", "vehest.api.Estimate"]
    assert types[3].endswith("-> matplotlib.figure.Figure")
    assert types[4].endswith("-> vehest.api.OnlineEstimator")
    file.write_text("import vehest\nvehest.estimat\n", encoding="utf-8")
    assert subprocess.run(
        [sys.executable, "-m", *words], capture_output=True, cwd=tmp_path
    ).returncode


def test_import_completes_and_loads_no_library():
    code = "import sys, vehest; print(*dir(vehest)); "
    code += "print({'numpy', 'torch', 'pandas', 'matplotlib'} & set(sys.modules))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout
    names, libraries = out.splitlines()
    assert set(names.split()) == set(vehest.__all__)
    assert libraries == "set()"


def test_a_dataframe_and_its_file_give_the_numbers_of_the_command(tmp_path, monkeypatch, capsys):
    log = pd.read_csv(LOG).iloc[:1200]
    monkeypatch.chdir(tmp_path)
    recording = vehest.read_recording(log, columns=COLUMNS)
    recording.to_pandas().to_csv("lap.csv")
    words = ["estimate", "lap.csv", "estimator.wheelbase=2.4", "-o", "out.parquet"]
    code, _, err = run_vehest(capsys, *words)
    assert code == 0, err
    of_command = read_estimate(Path("out.parquet"))
    from_python = vehest.estimate(vehest.read_recording("lap.csv"), wheelbase=2.4)
    assert from_python.channels.keys() == of_command.channels.keys()
    for name, values in vehest.estimate(recording, wheelbase=2.4).channels.items():
        np.testing.assert_array_equal(values, of_command[name], err_msg=name)
        np.testing.assert_array_equal(values, from_python[name], err_msg=name)


def test_default_model_is_that_of_the_command_and_the_earlier_order_still_works():
    recording = vehest.read_recording(pd.read_csv(LOG).iloc[:600], columns=COLUMNS)
    model = vehest.load_model()
    assert model.name == "self_calibrating"
    with pytest.warns(DeprecationWarning, match=r"vehest\.estimate\(recording, model\)"):
        earlier = vehest.estimate(model, recording, wheelbase=2.4)
    now = vehest.estimate(recording, model, wheelbase=2.4)
    np.testing.assert_array_equal(earlier["vy"], now["vy"])


def test_steps_by_keyword_equal_the_batch_estimate():
    recording = vehest.read_recording(pd.read_csv(LOG).iloc[:400], columns=COLUMNS)
    batch = vehest.estimate(recording, wheelbase=2.4)
    stepper = vehest.online(wheelbase=2.4)
    for k in range(len(recording)):
        step = stepper.step(**{name: values[k] for name, values in recording.channels.items()})
    last = {name: batch[name][-1] for name in step._fields}
    assert step._asdict() == pytest.approx(last, abs=1e-9)


def test_missing_speed_is_a_clear_error():
    log = pd.read_csv(LOG).iloc[:100]
    columns = {name: text for name, text in COLUMNS.items() if name != "vx"}
    recording = vehest.read_recording(log, columns=columns)
    with pytest.raises(DataError, match="no channel 'vx'"):
        vehest.estimate(recording, wheelbase=2.4)


def test_a_dataframe_that_was_not_read_is_refused_with_the_remedy():
    with pytest.raises(ConfigurationError, match=r"as vehest\.read_recording"):
        vehest.estimate(pd.read_csv(LOG))


def test_score_of_an_estimate_is_that_of_its_model():
    log = pd.read_csv(LOG).iloc[:1200]
    recording = vehest.read_recording(log, columns={**COLUMNS, "sideslip_ref": "SlipAngle:deg"})
    zero = vehest.train("zero", [], [], ["estimator.rate_hz=20"])
    of_model = vehest.score(zero, recording)
    of_estimate = vehest.score(vehest.estimate(recording, zero), recording)
    assert of_estimate["rmse_sideslip"] == of_model["rmse_sideslip"]
    scored = recording.time >= 1.5
    expected = np.sqrt(np.mean(np.square(np.degrees(recording["sideslip_ref"][scored]))))
    assert of_model["rmse_sideslip"] == pytest.approx(expected, rel=1e-9)
