"""The wheel carries its configuration and works from an empty folder elsewhere."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.apart

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder into which a freshly built wheel was installed."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [
        sys.executable,
        "-m",
        "build",
        "--wheel",
        "--no-isolation",
        "--outdir",
        str(folder),
        str(ROOT),
    ]
    result = subprocess.run(build, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    (wheel,) = folder.glob("vehest-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


def _python(installed, cwd, *words):
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    environment.pop("VEHEST_OUTPUT", None)
    result = subprocess.run(
        [sys.executable, *words], cwd=cwd, env=environment, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
    return result


def test_wheel_holds_configuration_pipelines_and_templates(installed):
    names = {
        file.relative_to(installed / "vehest").as_posix()
        for file in (installed / "vehest").rglob("*")
        if file.is_file()
    }
    shipped = {
        file.relative_to(ROOT).as_posix()
        for folder in ("conf", "pipelines")
        for file in (ROOT / folder).rglob("*.yaml")
    }
    assert shipped <= names
    models = {
        f"{folder}/{name}"
        for folder in ("pretrained", "pretrained_filter")
        for name in ("model.safetensors", "model.yaml", "trust.yaml")
    }
    assert {"report/templates/page.css", "py.typed"} | models <= names
    splits = {
        file.name for file in (ROOT / "src" / "vehest_papers" / "conf" / "split").glob("*.yaml")
    }
    assert len(splits) > 20
    assert splits == {
        file.name for file in (installed / "vehest_papers" / "conf" / "split").glob("*.yaml")
    }
    assert not any("tests" in name or name.endswith(".parquet") for name in names)


def test_installed_wheel_runs_a_pipeline_from_an_empty_folder(installed, tmp_path):
    def vehest(*words):
        return _python(installed, tmp_path, "-m", "vehest", *words)

    assert "ksnn" in vehest("train", "--help").stdout
    assert "name: leave_av21" in vehest("config", "train", "split=leave_av21").stdout
    assert json.loads(vehest("config", "train", "--json").stdout)["estimator"]["name"] == "ksnn"
    lap = "manoeuvre: {name: laps, course: handling, duration: "
    seconds = {"drive_1": 20, "drive_2": 10, "drive_3": 10}
    entries = (f"{{id: {name}, {lap}{duration}}}}}" for name, duration in seconds.items())
    drives = f"drives=[{', '.join(entries)}]"
    ingested = json.loads(vehest("ingest", "sim_quickstart", f"dataset.{drives}", "--json").stdout)
    assert ingested["recordings"] == ["drive_1", "drive_2", "drive_3"]
    assert "would" in vehest("run", "quickstart", "--dry-run").stderr
    assert {path.name for path in tmp_path.iterdir()} == {"outputs"}
    (recording,) = (tmp_path / "outputs" / "ingest").glob("*/drive_3.parquet")
    assert (
        json.loads(vehest("estimate", str(recording), "--json").stdout)["model"]
        == "self_calibrating"
    )
    location = _python(
        installed,
        tmp_path,
        "-c",
        "import vehest, pathlib; print(pathlib.Path(vehest.__file__).parent)",
    )
    assert location.stdout.strip() == str(installed / "vehest"), (
        "the wheel was tested, not the checkout"
    )
