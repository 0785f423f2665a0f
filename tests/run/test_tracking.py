"""Runs in MLflow: in the local store, on a server of its own, and what happens when that server is
away.
"""

import json
import os
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import urllib.request
from contextlib import suppress
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import ClassVar

import pytest

from processes import start, wait_for
from vehest.artefacts.artefact import MANIFEST, Artefact, read_artefact
from vehest.run.tracking import Tracker

pytestmark = pytest.mark.apart


def test_runs_are_tracked_with_parameters_metrics_and_model(
    place,
):
    place.done("run", "small")
    client = _client(place)
    runs = {run.info.run_name: run for run in _runs(client)}
    assert len(runs) == 13, "12 of stages, and one above them"
    parent = runs.pop("small")
    assert {run.data.tags["mlflow.parentRunId"] for run in runs.values()} == {parent.info.run_id}
    trained = runs["ksnn-linear_no_bias_p2-seed0"]
    assert trained.data.tags["mlflow.source.name"].startswith("vehest run small")
    assert (
        trained.data.params["estimator.n_local"],
        trained.data.params["training.learning_rate"],
    ) == ("2", "0.001")
    assert _is_complete(client, trained)
    evaluated = runs["ksnn-linear_no_bias_p2-seed0-on-mine"]
    assert evaluated.data.metrics["rmse_sideslip.test"] > 0
    done = _in_process(
        "import vehest.cli, atexit; atexit.register(lambda: print('mlflow' in sys.modules)); "
        "vehest.cli.main()",
        "run",
        "small",
    )
    assert (done.returncode, done.stdout.splitlines()[-1]) == (0, "False"), done.stderr


TRAIN = ("train", "split=mine", "training.max_epochs=2")


def _client(place, name="outputs/mlflow.db"):
    from mlflow import MlflowClient

    return MlflowClient(f"sqlite:///{place.folder / name}")


def _runs(client, name="vehest"):
    experiment = client.get_experiment_by_name(name)
    return client.search_runs([experiment.experiment_id]) if experiment else []


def _local(place, stage=""):
    """Runs in the local store, of one stage or of all."""
    runs = [(run, run.data.tags["vehest.stage"]) for run in _runs(_client(place))]
    return [
        run
        for run, stage_of_run in runs
        if stage_of_run == stage or (not stage and stage_of_run != "study")
    ]


def _is_complete(client, run):
    """Whether a training's run has its losses and its files."""
    paths = {entry.path for entry in client.list_artifacts(run.info.run_id)}
    losses = [point.step for point in client.get_metric_history(run.info.run_id, "validation_loss")]
    return (
        run.info.status == "FINISHED"
        and losses == [1, 2]
        and {"model.safetensors", "model.yaml", "manifest.json"} <= paths
    )


def test_runs_missed_by_an_absent_server_are_logged_by_the_next_run(place, monkeypatch):
    with monkeypatch.context() as away:
        away.setattr(Tracker, "_log", _raising(ConnectionError("no answer")))
        _, err = place.done("run", "small")
        assert err.count("logging to MLflow") == 1
    assert not (place.folder / "outputs" / "finished").exists()
    _, err = place.done("run", "small")
    assert "done" not in err, "nothing is made again for it"
    assert sorted(run.info.status for run in _local(place)) == ["FINISHED"] * 12


@pytest.mark.parametrize("step", ["log_batch", "log_artifact", "set_terminated"])
def test_a_run_that_was_half_logged_is_completed(place, monkeypatch, step):
    from mlflow import MlflowClient
    from mlflow.store.artifact.local_artifact_repo import LocalArtifactRepository

    owner = LocalArtifactRepository if step == "log_artifact" else MlflowClient
    with monkeypatch.context() as killed:
        killed.setattr(owner, step, _raising(KeyboardInterrupt()))
        assert place(*TRAIN)[0] == 130
    assert ([run.info.status for run in _local(place, "train")], place(*TRAIN)[0]) == (
        ["RUNNING"],
        0,
    )
    [run] = _local(place, "train")
    assert _is_complete(_client(place), run)


def test_an_unfinished_run_of_another_output_root_is_left_alone(place, monkeypatch):
    from mlflow.store.artifact.local_artifact_repo import LocalArtifactRepository

    shared = f"tracking.uri=sqlite:///{place.folder / 'outputs' / 'mlflow.db'}"
    (place.folder / "outputs").mkdir()
    with monkeypatch.context() as killed:
        killed.setattr(LocalArtifactRepository, "log_artifact", _raising(KeyboardInterrupt()))
        assert place(*TRAIN, shared, "output=there")[0] == 130
    assert place(*TRAIN, shared, "output=here")[0] == 0
    assert sorted(run.info.status for run in _local(place, "train")) == ["FINISHED", "RUNNING"]


def test_repeated_trainings_are_the_same_run_unless_the_outcome_differs(place):
    assert (place(*TRAIN)[0], place(*TRAIN, "--force")[0]) == (0, 0)
    [run] = _local(place, "train")
    tracker = Tracker({"name": "mlflow"}, place.folder / "outputs", pytest.fail)
    [folder] = (place.folder / "outputs" / "train").iterdir()
    artefact = read_artefact(folder)
    assert run.data.tags["vehest.key"] == artefact.key
    tracker.log(artefact)
    tracker.log(replace(artefact, outputs={**artefact.outputs, "fit.csv": "0" * 64}))
    assert [run.info.status for run in _local(place, "train")] == ["FINISHED"] * 2


def test_a_store_that_is_gone_is_filled_again(place):
    assert place(*TRAIN)[0] == 0
    (place.folder / "outputs" / "mlflow.db").unlink()
    assert (place(*TRAIN)[0], len(_local(place, "train"))) == (0, 1)


FULL = (
    "import resource, vehest.cli; resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000)); "
    "vehest.cli.main()"
)


def test_runs_untracked_because_of_a_full_disk_are_logged_by_the_next_run(place):
    assert place(*TRAIN, "tracking=none")[0] == 0
    full = _in_process(FULL, *TRAIN)
    assert full.returncode == 0, full.stderr
    assert full.stderr.count("going on without tracking") == 1
    assert not list((place.folder / "outputs").glob("*mlflow.db*")), "no half of a store stays"
    place.done(*TRAIN)
    assert [run.info.status for run in _local(place, "train")] == ["FINISHED"]


def test_a_disk_that_fills_up_while_runs_are_logged_loses_none(place):
    assert place(*TRAIN)[0] == 0
    store = place.folder / "outputs" / "mlflow.db"
    with sqlite3.connect(
        store
    ) as padded:  # larger than any other file, so that it alone reaches the limit
        padded.execute("create table padding as select zeroblob(20000000) as zeros")
    padded.close()
    size = store.stat().st_size
    full = _in_process(FULL.replace("200_000", str(size)), "run", "small", "--jobs", "1")
    assert full.returncode == 0, full.stderr
    assert full.stderr.count("going on without tracking") == 1
    place.done("run", "small")
    assert [run.info.status for run in _local(place)] == ["FINISHED"] * 14


def _raising(error):
    def raises(*arguments, **options):
        raise error

    return raises


def _in_process(code, *arguments):
    """A command in a process of its command, run by ``code``."""
    command = [
        sys.executable,
        "-c",
        f"import sys; sys.argv = ['vehest', *sys.argv[1:]]; {code}",
        *arguments,
    ]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def mlflow_server(folder):
    """A real MLflow server on loopback, ready to answer: its address and its process."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{free.getsockname()[1]}"
    folder.mkdir()
    command = [
        sys.executable,
        "-m",
        "mlflow",
        "server",
        "--host",
        "127.0.0.1",
        "--port",
        address.rpartition(":")[2],
        "--workers",
        "1",
    ]
    command += [
        "--backend-store-uri",
        f"sqlite:///{folder / 'server.db'}",
        "--artifacts-destination",
        folder / "artifacts",
    ]
    with open(folder / "log", "wb") as log:
        process = start(command, stdout=log, stderr=log, cwd=folder)

    def answers():
        with suppress(OSError), urllib.request.urlopen(f"{address}/health", timeout=5):
            return True
        return False

    wait_for(answers, process, (folder / "log").read_text)
    return address, process


def test_a_server_receives_every_run_of_a_study_and_its_loss_half_way_stops_nothing(place):
    from mlflow import MlflowClient

    address, process = mlflow_server(place.folder / "server")
    client = MlflowClient(address)
    _, err = place.done("run", "small", f"tracking.uri={address}")
    assert "logging to MLflow" not in err
    runs = {run.info.run_name: run for run in _runs(client)}
    assert len(runs) == 13
    assert _is_complete(client, runs["ksnn-linear_no_bias_p2-seed1"])
    assert not (place.folder / "outputs" / "mlflow.db").exists()

    def fell_over():
        wait_for(lambda: _runs(client, "second"), process)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    watcher = threading.Thread(target=fell_over)
    watcher.start()
    out, err = place.done(
        "run",
        "small",
        "--force",
        "output=again",
        f"tracking.uri={address}",
        "tracking.experiment=second",
    )
    watcher.join()
    assert (err.count("logging to MLflow"), "going on without tracking" in err) == (1, True)
    assert "KS-NN linear no bias, P = 2" in out
    assert len(list((place.folder / "again" / "train").iterdir())) == 4


def test_servers_that_never_answer_are_abandoned(place, monkeypatch):
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "1")
    with socket.socket() as deaf:
        deaf.bind(("127.0.0.1", 0))
        deaf.listen()
        uri = f"http://127.0.0.1:{deaf.getsockname()[1]}"
        _, err = place.done("train", "split=mine", "training.max_epochs=1", f"tracking.uri={uri}")
    assert err.count("logging to MLflow") == 1


def test_every_parameter_is_tracked_however_many_there_are(tmp_path):
    from mlflow import MlflowClient

    config = {"group": {f"value_{position}": position for position in range(250)}}
    artefact = replace(_small_artefact(tmp_path / "model"), config=config)
    messages = []
    Tracker({"name": "mlflow"}, tmp_path / "outputs", messages.append).log(artefact)
    assert not messages
    [run] = _runs(MlflowClient(f"sqlite:///{tmp_path / 'outputs' / 'mlflow.db'}"))
    assert {key: int(value) for key, value in run.data.params.items()} == {
        f"group.{key}": v for key, v in config["group"].items()
    }


def _small_artefact(folder):
    """A training of two tables, to be logged."""
    folder.mkdir()
    (folder / MANIFEST).write_text("{}")
    for file in ("fit.csv", "timings.csv"):
        (folder / file).write_text("metric,value\n")
    outputs = {"fit.csv": "0" * 64}
    return Artefact(folder, "train", "model", "abc", "complete", outputs, {}, {})


def _warnings_of_logging(tmp_path, output, **config):
    """What the tracking of a small training says."""
    warnings = []
    tracker = Tracker({"name": "mlflow", **config}, output, warnings.append)
    tracker.log(_small_artefact(tmp_path / "model"))
    return warnings


@pytest.mark.parametrize(
    "name",
    ["a'b", 'a"b', "a\nb", "a\rb", "a%b", "a%(x)sb", "a#b", "aöü漢b", " a  b ", "a;b&c=d", "a:b@c"],
)
def test_an_output_root_of_any_name_has_its_store(tmp_path, name):
    output = tmp_path / name / "outputs"
    assert _warnings_of_logging(tmp_path, output) == []
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("mlflow.db")] == [
        f"{name}/outputs/mlflow.db"
    ]
    copies = {path for path in tmp_path.rglob("fit.csv") if path.parent.name != "model"}
    assert [path.is_relative_to(output / "mlartifacts") for path in copies] == [True]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["model", name])


@pytest.mark.parametrize("name", ["a?b", "a%20b", "a\udcffb"])
def test_output_roots_invalid_for_mlflow_are_a_single_line(tmp_path, name):
    [warning] = _warnings_of_logging(tmp_path, tmp_path / name / "outputs")
    assert "MLflow opens no store at a path with '?'" in warning
    assert "\n" not in warning
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["model", name])
    assert not list(tmp_path.rglob("*.db*"))


def test_stores_that_link_to_themselves_are_a_single_warning(tmp_path):
    output = tmp_path / "outputs"
    output.mkdir()
    (output / "mlflow.db").symlink_to("mlflow.db")
    [warning] = _warnings_of_logging(tmp_path, output)
    assert "going on without tracking" in warning
    assert (output / "mlflow.db").is_symlink()


def test_the_output_root_of_the_environment_may_have_quotes_a_newline_and_a_hash(
    place, monkeypatch
):
    output = place.folder / "a'b\"c\nd#e%f ü"
    monkeypatch.setenv("VEHEST_OUTPUT", str(output))
    _, err = place.done(*TRAIN)
    assert "MLflow" not in err
    assert (output / "mlflow.db").is_file()
    assert list((output / "mlartifacts").rglob("model.safetensors"))


class RestServer(BaseHTTPRequestHandler):
    """The calls of MLflow's REST interface that log a run, with addresses of the test's choice."""

    addresses: ClassVar[list[str]] = []  # of the run's artefacts, an answer each; the last stays
    uploads: ClassVar[list[str]] = []

    def do_GET(self):
        if "experiments/get-by-name" in self.path:
            self.answer({"experiment": {"experiment_id": "1", "name": "vehest"}})
        elif "runs/get" in self.path:
            self.answer({"run": self.run()})
        else:
            self.answer({}, 404)

    def do_POST(self):
        self.rfile.read(int(self.headers["Content-Length"]))
        answers = {"runs/create": lambda: {"run": self.run()}, "runs/update": self.run}
        answer = next((make for call, make in answers.items() if call in self.path), dict)
        self.answer(answer())

    def do_PUT(self):
        self.rfile.read(int(self.headers["Content-Length"]))
        self.uploads.append(self.path)
        self.answer({})

    def run(self):
        address = self.addresses.pop(0) if len(self.addresses) > 1 else self.addresses[0]
        info = {"run_id": "a" * 32, "experiment_id": "1", "status": "RUNNING", "start_time": 1}
        return {"info": {**info, "artifact_uri": address}, "data": {}}

    def answer(self, content, status=200):
        body = json.dumps(content).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *arguments):
        pass


@pytest.fixture
def rest_server(monkeypatch):
    """Address of a server that names the addresses that a test puts into `RestServer.addresses`."""
    monkeypatch.setattr(RestServer, "uploads", [])
    with ThreadingHTTPServer(("127.0.0.1", 0), RestServer) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@pytest.mark.parametrize(
    "address",
    [
        "{outside}",
        "file://{outside}",
        "FILE:{outside}",
        " file:{outside}",
        "{output}/../outside",
        "{output}/train",
        "file:{output}/mlartifacts",
        "dbfs:/x",
        "c:/x",
        "",
    ],
)
def test_a_server_may_not_choose_a_folder_of_this_machine(
    tmp_path, rest_server, monkeypatch, address
):
    outside = tmp_path / "outside"
    output = tmp_path / "outputs"
    address = address.format(outside=outside, output=output)
    monkeypatch.setattr(RestServer, "addresses", [address])
    [warning] = _warnings_of_logging(tmp_path, output, uri=rest_server)
    assert "for artefacts, which is no server; start it with --serve-artifacts" in warning
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model", "outputs"]
    assert [path.name for path in output.iterdir()] == ["locks"]
    assert RestServer.uploads == []


def test_artefacts_go_to_the_first_address_of_a_server(tmp_path, rest_server, monkeypatch):
    outside = tmp_path / "outside"
    addresses = ["mlflow-artifacts:/1/run", str(outside)]
    monkeypatch.setattr(RestServer, "addresses", addresses)
    assert _warnings_of_logging(tmp_path, tmp_path / "outputs", uri=rest_server) == []
    assert not outside.exists()
    served = "/api/2.0/mlflow-artifacts/artifacts/1/run"
    assert RestServer.uploads == [f"{served}/fit.csv", f"{served}/{MANIFEST}"]


def test_a_store_of_this_machine_keeps_artefacts_where_its_owner_wants_them(tmp_path):
    from mlflow import MlflowClient

    uri = f"sqlite:///{tmp_path / 'mine.db'}"
    MlflowClient(uri).create_experiment("vehest", (tmp_path / "runs").as_uri())
    assert _warnings_of_logging(tmp_path, tmp_path / "outputs", uri=uri) == []
    assert [path.name for path in (tmp_path / "runs").rglob("*.csv")] == ["fit.csv"]
