"""Two Ray nodes against the local launcher: the same bits, whatever dies on the way; nothing that finished is made again."""

from __future__ import annotations

import importlib.util
import os
import signal
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from two_nodes import Driver, TwoNodes, begun, journal, metrics, server, sweep_of, trained, under_way, weights, with_recordings

from place import Place

pytestmark = [
    pytest.mark.cluster,
    pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed: pip install 'vehest[ray]'"),
]

SMALL = ("split=mine", "estimator=ksnn", "training.batch_size=256", "tracking=none")
FORTY = (*SMALL, "estimator.n_local=2,3,4,5", "estimator.n_hidden=0,1", "seed=range(5)", "training.max_epochs=2")
LONGER = (*SMALL, "estimator.n_local=2,3", "estimator.n_hidden=0,1", "seed=range(2)", "training.patience=1000")
LONGER = (*LONGER, "training.max_epochs=150", "training.checkpoint_seconds=0.01")


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working folder with a data set of three short drives."""
    folder = tmp_path_factory.mktemp("cluster")
    former = os.environ.copy()
    os.environ["VEHEST_DATA"] = str(folder / "raw")
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    Place(folder, None)  # type: ignore[arg-type]
    yield folder
    os.environ.clear()
    os.environ.update(former)


@pytest.fixture(scope="session")
def alone(folder: Path) -> dict[str, Path]:
    """Output roots of the same sweeps by the local launcher."""
    roots = {}
    for name, words in (("forty", FORTY), ("longer", LONGER)):
        roots[name] = output = folder / f"alone-{name}"
        driver = Driver(folder, output, "sweep", *words, "--jobs", "2")
        assert driver.ended() == 0, driver.said
    return roots


@pytest.fixture
def cluster(folder: Path, tmp_path: Path) -> Iterator[TwoNodes]:
    nodes = TwoNodes(tmp_path)
    yield nodes
    nodes.shut_down()


def swept(cluster: TwoNodes, folder: Path, output: Path, *words: str, **environment: str) -> Driver:
    return Driver(folder, output, "sweep", *words, "--launcher", "ray", "--address", cluster.address, **environment)


def test_a_sweep_of_forty_trainings_has_the_bits_of_the_local_launcher(cluster, folder, alone, tmp_path):
    output = with_recordings(alone["forty"], tmp_path / "out")
    driver = swept(cluster, folder, output, *FORTY)
    assert driver.ended() == 0, driver.said
    assert "2 machines, 2 cores" in driver.said
    assert len(metrics(output)) == 40
    assert metrics(output) == metrics(alone["forty"])
    assert weights(output) == weights(alone["forty"])
    assert sweep_of(output).equals(sweep_of(alone["forty"]))
    assert set(trained(output).values()) == {1}
    assert len(trained(output)) == 40
    assert {entry["node"] for entry in journal(output)} == {node.node_id for node in cluster.nodes}, "both had some"
    again = swept(cluster, folder, output, *FORTY)
    assert again.ended() == 0
    assert len(trained(output)) == 40


def test_the_quickstart_has_the_bits_of_the_local_launcher(cluster, tmp_path):
    words = ("run", "quickstart", "training.max_epochs=2", "tracking=none")
    alone = Driver(tmp_path, tmp_path / "alone", *words, "--jobs", "2")
    assert alone.ended() == 0, alone.said
    output = with_recordings(alone.output, tmp_path / "out")
    driver = Driver(tmp_path, output, *words, "--launcher", "ray", "--address", cluster.address)
    assert driver.ended() == 0, driver.said
    assert len(metrics(output)) == 13
    assert metrics(output) == metrics(alone.output)
    assert weights(output) == weights(alone.output)
    (page,), (page_alone,) = (list(root.glob("report/*/metrics.csv")) for root in (output, alone.output))
    assert page.read_bytes() == page_alone.read_bytes()


def training_with_a_checkpoint(*roots: Path) -> dict | None:
    """A group under way of which checkpoints of all members are kept."""
    for entry in under_way(*roots):
        kept = [file for root in roots for key in entry["keys"] for file in root.glob(f"checkpoints/*-{key[:12]}/checkpoint.safetensors")]
        if len(kept) == len(entry["keys"]):
            return entry
    return None


def begun_again(lost: dict, *roots: Path) -> dict:
    """How another worker set about what one had lost."""
    (entry,) = [e for e in journal(*roots) if (e["event"], e["keys"]) == ("begun", lost["keys"]) and e["pid"] != lost["pid"]]
    return entry


def test_a_killed_worker_costs_no_more_than_what_came_after_its_last_checkpoint(cluster, folder, alone, tmp_path):
    output = with_recordings(alone["longer"], tmp_path / "out")
    driver = swept(cluster, folder, output, *LONGER)
    lost = driver.sees(lambda: training_with_a_checkpoint(output))
    os.kill(lost["pid"], signal.SIGKILL)
    assert driver.ended() == 0, driver.said
    assert metrics(output) == metrics(alone["longer"])
    assert weights(output) == weights(alone["longer"])
    assert "its worker died; it goes on elsewhere from its last checkpoint" in driver.said
    assert set(trained(output).values()) == {1}
    assert min(begun_again(lost, output)["epochs"]) > 0, "it went on from its checkpoint"
    assert not list(output.glob("checkpoints/*"))


def test_a_lost_node_takes_nothing_that_was_finished(cluster, folder, alone, tmp_path):
    output = with_recordings(alone["longer"], tmp_path / "out")
    driver = swept(cluster, folder, output, *LONGER)

    def on_second_node() -> dict | None:
        entry = training_with_a_checkpoint(output)
        return entry if entry and entry["node"] == cluster.nodes[1].node_id else None

    lost = driver.sees(on_second_node)
    before = trained(output)
    cluster.lose(cluster.nodes[1])
    assert driver.ended() == 0, driver.said
    assert metrics(output) == metrics(alone["longer"])
    assert set(trained(output).values()) == {1}
    again = {key for key, times in begun(output).items() if times > 1}
    assert set(lost["keys"]) <= again
    assert not again & set(before), "what had been made was not begun again"
    assert "its machine was lost" in driver.said or "its worker died" in driver.said


def test_ctrl_c_loses_nothing_and_the_next_call_goes_on(cluster, folder, alone, tmp_path):
    output = with_recordings(alone["longer"], tmp_path / "out")
    driver = swept(cluster, folder, output, *LONGER)
    driver.sees(lambda: training_with_a_checkpoint(output))
    driver.process.send_signal(signal.SIGINT)
    assert driver.ended() == 130, driver.said
    assert not list(output.glob("sweep/*"))
    stopped = {entry["run"] for entry in journal(output)}
    before = trained(output)
    again = swept(cluster, folder, output, *LONGER)
    assert again.ended() == 0, again.said
    assert metrics(output) == metrics(alone["longer"])
    assert weights(output) == weights(alone["longer"])
    later = [entry for entry in journal(output) if entry["run"] not in stopped and entry["event"] == "begun"]
    assert any(max(entry["epochs"]) > 0 for entry in later), "from where they were stopped"
    assert not {key for entry in later for key in entry["keys"]} & set(before)
    assert set(trained(output).values()) == {1}


def test_nodes_without_a_common_folder_share_a_store_and_go_on_with_each_others_checkpoints(cluster, folder, alone, tmp_path):
    output = with_recordings(alone["longer"], tmp_path / "out")
    driver = swept(cluster, folder, output, *LONGER, "--store", f"file://{tmp_path / 'store'}")
    scratches = [next(iter((tmp_path / f"scratch-{name}").glob("*/outputs")), tmp_path / "none") for name in ("head", "second")]

    def kept() -> dict | None:
        scratches[:] = [own for name in ("head", "second") for own in (tmp_path / f"scratch-{name}").glob("*/outputs")]
        names = {file.name.rpartition("-")[2] for file in (tmp_path / "store" / "checkpoints").glob("*")}
        on_second = [entry for entry in under_way(*scratches) if entry["node"] == cluster.nodes[1].node_id]
        return next((entry for entry in on_second if {key[:12] for key in entry["keys"]} <= names), None)

    lost = driver.sees(kept)
    cluster.lose(cluster.nodes[1])
    assert driver.ended() == 0, driver.said
    assert metrics(output) == metrics(alone["longer"])
    assert weights(output) == weights(alone["longer"])
    assert set(trained(*scratches).values()) == {1}
    assert min(begun_again(lost, *scratches)["epochs"]) > 0, "from the checkpoint that the lost node had put into the store"
    assert not list((tmp_path / "store" / "checkpoints").glob("*"))


def test_an_object_store_serves_as_one(folder, alone, tmp_path, monkeypatch):
    for package in ("moto", "s3fs"):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed: pip install 'vehest[cluster-tests]'")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    access = {"AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b", "AWS_DEFAULT_REGION": "us-east-1"}
    for name, value in {**access, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}"}.items():
        monkeypatch.setenv(name, value)

    def answers() -> bool:
        with socket.socket() as caller:
            return caller.connect_ex(("127.0.0.1", port)) == 0

    with server([sys.executable, "-m", "moto.server", "-p", str(port)], answers):
        import fsspec

        fsspec.filesystem("s3").mkdir("s3://trainings")
        cluster = TwoNodes(tmp_path)
        try:
            output = with_recordings(alone["longer"], tmp_path / "out")
            driver = swept(cluster, folder, output, *LONGER, "--store", "s3://trainings/vehest")
            assert driver.ended() == 0, driver.said
        finally:
            cluster.shut_down()
        assert metrics(output) == metrics(alone["longer"])
        assert weights(output) == weights(alone["longer"])
        assert fsspec.filesystem("s3").ls("s3://trainings/vehest/objects")
