"""Runs in MLflow: in the local store, on a server of its own, and what happens when that server is away."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from place import Place
from vehest.stages.artefacts import MANIFEST, Artefact
from vehest.stages.tracking import Tracker

STARTUP_SECONDS = 120.0  # of a server on a busy machine


def test_runs_are_tracked_with_parameters_metrics_model_and_figures(place):
    code, _, err = place("run", "small", "--jobs", "1")
    assert code == 0, err
    from mlflow import MlflowClient

    client = MlflowClient(f"sqlite:///{place.folder / 'outputs' / 'mlflow.db'}")
    experiment = client.get_experiment_by_name("vehest")
    runs = {run.info.run_name: run for run in client.search_runs([experiment.experiment_id])}
    assert len(runs) == 8
    trained = runs["ksnn-linear_no_bias_p2-seed0"]
    assert trained.data.params["estimator.n_local"] == "2"
    assert trained.data.params["training.learning_rate"] == "0.001"
    assert len(client.get_metric_history(trained.info.run_id, "validation_loss")) == 2
    kept = {entry.path for entry in client.list_artifacts(trained.info.run_id)}
    assert {"model.safetensors", "model.yaml", "manifest.json", "figures"} <= kept
    evaluated = runs["ksnn-linear_no_bias_p2-seed0-on-mine"]
    assert evaluated.data.metrics["rmse_sideslip.test"] > 0
    assert [entry.path for entry in client.list_artifacts(evaluated.info.run_id, "figures")] == ["figures/traces_test.png"]


def test_training_goes_on_when_the_tracking_server_is_away(place):
    code, _, err = place("train", "split=mine", "training.max_epochs=1", "tracking.uri=http://127.0.0.1:9")
    assert code == 0
    assert err.count("does not answer") == 1
    assert "going on without tracking" in err


@contextmanager
def mlflow_server(folder: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """A real MLflow server on loopback, ready to answer: its address and its process."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    folder.mkdir()
    command = [sys.executable, "-m", "mlflow", "server", "--host", "127.0.0.1", "--port", str(port), "--workers", "1"]
    command += ["--backend-store-uri", f"sqlite:///{folder / 'server.db'}", "--artifacts-destination", str(folder / "artifacts")]
    with open(folder / "log", "wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, cwd=folder, start_new_session=True)
    try:
        _await_answer(f"http://127.0.0.1:{port}", process, folder / "log")
        yield f"http://127.0.0.1:{port}", process
    finally:
        _kill(process)


def _await_answer(address: str, process: subprocess.Popen[bytes], log: Path) -> None:
    ends = time.monotonic() + STARTUP_SECONDS
    while time.monotonic() < ends:
        assert process.poll() is None, log.read_text()
        try:
            with urllib.request.urlopen(f"{address}/health", timeout=5):
                return
        except OSError:
            time.sleep(0.1)
    raise AssertionError(f"the server did not start:\n{log.read_text()}")


def _kill(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _runs(client, name: str = "vehest") -> dict:
    experiment = client.get_experiment_by_name(name)
    return {run.info.run_name: run for run in client.search_runs([experiment.experiment_id])} if experiment else {}


def test_a_server_receives_every_run_of_a_study_and_its_loss_half_way_stops_nothing(place: Place):
    from mlflow import MlflowClient

    with mlflow_server(place.folder / "server") as (address, process):
        client = MlflowClient(address)
        code, _, err = place("run", "small", "--jobs", "1", f"tracking.uri={address}")
        assert code == 0, err
        assert "does not answer" not in err
        runs = _runs(client)
        assert len(runs) == 8
        trained = runs["ksnn-linear_no_bias_p2-seed1"]
        assert trained.info.status == "FINISHED"
        assert len(client.get_metric_history(trained.info.run_id, "validation_loss")) == 2
        kept = {entry.path for entry in client.list_artifacts(trained.info.run_id)}
        assert {"model.safetensors", "model.yaml", "manifest.json", "figures"} <= kept
        assert not (place.folder / "outputs" / "mlflow.db").exists()

        def fell_over() -> None:
            while len(_runs(client, "second")) < 1:
                time.sleep(0.05)
            _kill(process)

        watcher = threading.Thread(target=fell_over)
        watcher.start()
        again = ("run", "small", "--jobs", "1", "--force", "output=again", f"tracking.uri={address}", "tracking.experiment=second")
        code, out, err = place(*again)
        watcher.join()
    assert code == 0, err
    assert err.count("does not answer") == 1
    assert "going on without tracking" in err
    assert "KS-NN linear no bias, P = 2" in out
    assert len(list((place.folder / "again" / "train").iterdir())) == 4


def test_a_server_that_hears_and_never_answers_is_given_up(place: Place, monkeypatch):
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "1")
    with socket.socket() as deaf:
        deaf.bind(("127.0.0.1", 0))
        deaf.listen()
        uri = f"http://127.0.0.1:{deaf.getsockname()[1]}"
        code, _, err = place("train", "split=mine", "training.max_epochs=1", f"tracking.uri={uri}")
    assert code == 0
    assert err.count("does not answer") == 1


def test_every_parameter_is_tracked_however_many_there_are(tmp_path: Path):
    from mlflow import MlflowClient

    config = {"group": {f"value_{position}": position for position in range(250)}}
    (tmp_path / MANIFEST).write_text("{}")
    artefact = Artefact(tmp_path, "train", "model", "abc", "complete", {}, config, {})
    said: list[str] = []
    Tracker({"name": "mlflow"}, tmp_path / "outputs", said.append).log(artefact, {}, {})
    assert not said
    [run] = _runs(MlflowClient(f"sqlite:///{tmp_path / 'outputs' / 'mlflow.db'}")).values()
    assert {key: int(value) for key, value in run.data.params.items()} == {f"group.{key}": v for key, v in config["group"].items()}
