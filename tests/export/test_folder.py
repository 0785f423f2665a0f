"""Exports on disk and from the command line."""

import os
import subprocess
import sys
from dataclasses import replace

import pytest
from exports import command, model, tool, trust
from refusals import refusal

from every_estimator import fitted
from vehest.data.errors import ConfigurationError
from vehest.estimators.model_files import model_digest, save_model
from vehest.export.folder import FILES, export_model
from vehest.trust.record import write_trust

pytestmark = pytest.mark.export


def test_export_builds_and_passes_its_test_vectors(tmp_path):
    tool("make")
    tool("gcc")
    export_model(model("dugoff_ukf"), trust("dugoff_ukf"), tmp_path / "c", "float", 200.0)
    assert "bytes of state: " in command(["make", "-s", "check"], tmp_path / "c")
    sizes = command(["make", "-s", "sizes"], tmp_path / "c")
    assert all(words in sizes for words in ("vehest_health.o", "vehest_step\t"))
    assert {path.name for path in (tmp_path / "c").iterdir()} <= FILES
    readme = (tmp_path / "c" / "README.md").read_text()
    assert "200.0 times a second" in readme
    assert "| 2 | CHANNEL is frozen |" in readme


def test_export_replaces_only_an_earlier_export(tmp_path):
    out = tmp_path / "c"
    export_model(model("zero"), trust("zero"), out)
    assert (out / "vehest_health.c").exists()
    export_model(model("zero"), None, out)
    assert not (out / "vehest_health.c").exists()
    (out / "mine.c").write_text("")
    assert "holds 'mine.c', which is no part of an export" in refusal(
        lambda: export_model(model("zero"), None, out), ConfigurationError
    )
    foreign = tmp_path / "project"
    foreign.mkdir()
    (foreign / "main.c").write_text("int main(void) { return 0; }")
    assert "holds 'main.c'" in refusal(
        lambda: export_model(model("zero"), None, foreign), ConfigurationError
    )
    assert [path.name for path in foreign.iterdir()] == ["main.c"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"precision": "half"}, "double or float"),
        ({"bus_rate_hz": 10.0}, "too slow"),
        ({"bus_rate_hz": float("nan")}, "too slow"),
    ],
)
def test_refused_exports_leave_nothing(tmp_path, options, words):
    with pytest.raises(ConfigurationError, match=words):
        export_model(model("zero"), None, tmp_path / "c", **options)
    assert not list(tmp_path.iterdir())


def test_families_and_channels_that_c_cannot_have_are_refused_and_leave_nothing(tmp_path):
    kalman_trust = trust("kalman")
    health = replace(kalman_trust.health, deviation=(*kalman_trust.health.deviation[:-1], 1e-9))
    with pytest.raises(
        ConfigurationError, match=r"'steer' follows the others to .* which float cannot resolve"
    ):
        export_model(model("kalman"), replace(kalman_trust, health=health), tmp_path / "c", "float")
    assert not list(tmp_path.iterdir())
    assert "cannot be exported" in refusal(
        lambda: export_model(fitted("factor_graph"), None, tmp_path / "c"), ConfigurationError
    )


def test_export_command_accepts_a_model_folder_and_states_its_inputs(tmp_path):
    folder = tmp_path / "model"
    folder.mkdir()
    save_model(model("kinematic"), folder)
    write_trust(trust("kinematic"), folder, model_digest(folder))
    words = [
        sys.executable,
        "-m",
        "vehest",
        "export",
        str(folder),
        "-o",
        str(tmp_path / "c"),
        "--precision",
        "float",
        "--bus-rate",
        "500",
    ]
    done = subprocess.run(
        words,
        capture_output=True,
        text=True,
        env={**os.environ, "VEHEST_OUTPUT": str(tmp_path)},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert f"out: {tmp_path / 'c'}" in done.stdout
    again = subprocess.run([*words[:-1], "1"], capture_output=True, text=True, check=False)
    assert again.returncode == 2
    assert (
        again.stderr
        == "error: samples at 1 Hz are too slow for an estimator that works at 100 Hz\n"
    )


def test_every_file_of_the_patented_method_says_so(tmp_path):
    export_model(model("ksnn"), trust("ksnn"), tmp_path / "c")
    for path in (tmp_path / "c").iterdir():
        assert path.suffix == ".csv" or "patent" in path.read_text().lower(), path.name
