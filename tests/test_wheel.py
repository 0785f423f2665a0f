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
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    result = subprocess.run(build, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    (wheel,) = folder.glob("vehest-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


def _vehest(installed, cwd, *arguments):
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    environment.pop("VEHEST_OUTPUT", None)
    return subprocess.run([sys.executable, "-m", "vehest", *arguments], cwd=cwd, env=environment, capture_output=True, text=True)


def test_wheel_holds_configuration_pipelines_and_templates(installed):
    names = {file.relative_to(installed / "vehest").as_posix() for file in (installed / "vehest").rglob("*") if file.is_file()}
    shipped = {
        f"{folder}/{file.relative_to(ROOT / folder).as_posix()}"
        for folder in ("conf", "pipelines")
        for file in (ROOT / folder).rglob("*.yaml")
    }
    assert shipped <= names
    assert {
        "report/templates/page.css",
        "py.typed",
        "pretrained/model.safetensors",
        "pretrained/model.yaml",
        "pretrained/trust.yaml",
        "pretrained_filter/model.safetensors",
        "pretrained_filter/model.yaml",
        "pretrained_filter/trust.yaml",
    } <= names
    splits = {file.name for file in (ROOT / "src" / "vehest_papers" / "conf" / "split").glob("*.yaml")}
    assert len(splits) > 20
    assert splits == {file.name for file in (installed / "vehest_papers" / "conf" / "split").glob("*.yaml")}
    assert not any("tests" in name or name.endswith(".parquet") for name in names)


def test_installed_wheel_runs_a_pipeline_from_an_empty_folder(installed, tmp_path):
    assert "ksnn" in _vehest(installed, tmp_path, "train", "--help").stdout
    assert "name: leave_av21" in _vehest(installed, tmp_path, "config", "train", "split=leave_av21").stdout
    result = _vehest(installed, tmp_path, "config", "train", "--json")
    assert json.loads(result.stdout)["estimator"]["name"] == "ksnn"
    lap = "manoeuvre: {name: laps, course: handling, duration: "
    drives = f"drives=[{{id: drive_1, {lap}20}}}}, {{id: drive_2, {lap}10}}}}, {{id: drive_3, {lap}10}}}}]"
    result = _vehest(installed, tmp_path, "ingest", "sim_quickstart", f"dataset.{drives}", "--json")
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["recordings"] == ["drive_1", "drive_2", "drive_3"]
    result = _vehest(installed, tmp_path, "run", "quickstart", "--dry-run")
    assert result.returncode == 0, result.stderr
    assert "would" in result.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"outputs"}
    (recording,) = (tmp_path / "outputs" / "ingest").glob("*/drive_3.parquet")
    result = _vehest(installed, tmp_path, "estimate", str(recording), "--json")
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["model"] == "self_calibrating"
    code = "import vehest, pathlib; print(pathlib.Path(vehest.__file__).parent)"
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    where = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert where.stdout.strip() == str(installed / "vehest"), "the wheel was tested, not the checkout"
