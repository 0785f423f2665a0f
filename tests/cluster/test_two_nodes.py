"""Two Ray nodes against the local launcher: the same bits, whatever dies on the way; nothing that finished is made again."""

from __future__ import annotations

import importlib.util
import os
import random
import signal
import socket
import sys
from collections import Counter
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


class Alone(dict[str, Path]):
    """Output roots of the same sweeps by the local launcher, each made when it is first asked for."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder

    def __missing__(self, name: str) -> Path:
        words = {"forty": FORTY, "longer": LONGER}[name]
        driver = Driver(self._folder, self._folder / f"alone-{name}", "sweep", *words, "--jobs", "2")
        assert driver.ended() == 0, driver.said
        self[name] = driver.output
        return driver.output


@pytest.fixture(scope="session")
def alone(folder: Path) -> Alone:
    return Alone(folder)


@pytest.fixture(scope="session")
def cluster(folder: Path) -> Iterator[TwoNodes]:
    """One that outlives a test, since nothing happens to its nodes."""
    nodes = TwoNodes(folder / "cluster")
    yield nodes
    nodes.shut_down()


@pytest.fixture
def mortal(folder: Path, tmp_path: Path) -> Iterator[TwoNodes]:
    """One of which a node will be lost."""
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


def test_a_lost_node_takes_nothing_that_was_finished(mortal, folder, alone, tmp_path):
    output = with_recordings(alone["longer"], tmp_path / "out")
    driver = swept(mortal, folder, output, *LONGER)

    def on_second_node() -> dict | None:
        entry = training_with_a_checkpoint(output)
        return entry if entry and entry["node"] == mortal.nodes[1].node_id else None

    lost = driver.sees(on_second_node)
    before = trained(output)
    mortal.lose(mortal.nodes[1])
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


def test_nodes_without_a_common_folder_share_a_store_and_go_on_with_each_others_checkpoints(mortal, folder, alone, tmp_path):
    output = with_recordings(alone["longer"], tmp_path / "out")
    driver = swept(mortal, folder, output, *LONGER, "--store", f"file://{tmp_path / 'store'}")
    scratches: list[Path] = []

    def kept() -> dict | None:
        scratches[:] = [own for name in ("head", "second") for own in (tmp_path / f"scratch-{name}").glob("*/outputs")]
        names = {file.name.rpartition("-")[2] for file in (tmp_path / "store" / "checkpoints").glob("*")}
        on_second = [entry for entry in under_way(*scratches) if entry["node"] == mortal.nodes[1].node_id]
        return next((entry for entry in on_second if {key[:12] for key in entry["keys"]} <= names), None)

    lost = driver.sees(kept)
    mortal.lose(mortal.nodes[1])
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


def test_a_node_that_cannot_keep_copies_is_left_out_and_the_other_does_its_work(folder, alone, tmp_path):
    nodes = TwoNodes(tmp_path, scratch_of_second="/proc/none")
    try:
        output = with_recordings(alone["longer"], tmp_path / "out")
        driver = swept(nodes, folder, output, *LONGER, "--store", f"file://{tmp_path / 'store'}")
        assert driver.ended() == 0, driver.said
    finally:
        nodes.shut_down()
    assert driver.said.count("is left out: cannot keep copies in '/proc/none/") == 1
    assert metrics(output) == metrics(alone["longer"])


def test_a_group_that_ends_every_worker_fails_alone_and_the_others_are_kept(cluster, folder, alone, tmp_path):
    output = with_recordings(alone["longer"], tmp_path / "out")
    one_seed = (*(word for word in LONGER if not word.startswith("seed=")), "seed=0")
    driver = swept(cluster, folder, output, *one_seed)
    poisoned = driver.sees(lambda: under_way(output))[0]
    killed: set[int] = set()
    for _ in range(3):
        entry = driver.sees(lambda: next((e for e in under_way(output) if e["keys"] == poisoned["keys"] and e["pid"] not in killed), None))
        killed.add(entry["pid"])
        os.kill(entry["pid"], signal.SIGKILL)
    assert driver.ended() == 5, driver.said
    assert driver.said.count("its worker died, the 3rd time") >= 1
    assert len(metrics(output)) == 3
    again = swept(cluster, folder, output, *one_seed)
    assert again.ended() == 0, again.said
    assert len(metrics(output)) == 4
    assert metrics(output).items() <= metrics(alone["longer"]).items()


def test_the_head_lost_loses_nothing_that_was_finished(mortal, folder, alone, tmp_path):
    output = with_recordings(alone["longer"], tmp_path / "out")
    driver = swept(mortal, folder, output, *LONGER)
    driver.sees(lambda: training_with_a_checkpoint(output))
    mortal.lose(mortal.nodes[0])
    assert driver.ended() != 0
    before = trained(output)
    again = Driver(folder, output, "sweep", *LONGER, "--jobs", "2")
    assert again.ended() == 0, again.said
    assert metrics(output) == metrics(alone["longer"])
    assert set(before.values()) <= {1}


@pytest.mark.slow
def test_two_hundred_trainings_survive_twenty_kills_at_random_moments(cluster, folder, tmp_path):
    words = (*SMALL, "estimator.n_local=2,3,4,5,6", "estimator.n_hidden=0,1,2,3", "seed=range(10)", "training.patience=1000")
    words = (*words, "training.max_epochs=30", "training.checkpoint_seconds=0.01")
    alone = Driver(folder, tmp_path / "alone", "sweep", *words, "--jobs", "2")
    assert alone.ended() == 0, alone.said
    output = with_recordings(alone.output, tmp_path / "out")
    driver = swept(cluster, folder, output, *words)
    draw = random.Random(0)
    killed: set[int] = set()
    for moment in sorted(draw.randrange(20) for _ in range(20)):  # groups that have ended by then
        entry = driver.sees(lambda moment=moment: victim(output, moment, killed, draw))
        killed.add(entry["pid"])
        os.kill(entry["pid"], signal.SIGKILL)
    assert driver.ended() == 0, driver.said
    assert metrics(output) == metrics(alone.output)
    assert weights(output) == weights(alone.output)
    assert set(trained(output).values()) == {1}


def victim(output: Path, moment: int, killed: set[int], draw: random.Random) -> dict | None:
    """A worker to kill, once so many groups have ended; one group is not killed twice more than it may die."""
    if sum(entry["event"] == "ended" for entry in journal(output)) < moment:
        return None
    deaths = Counter(entry["group"] for entry in journal(output) if entry["event"] == "begun" and entry["pid"] in killed)
    open_ones = [entry for entry in under_way(output) if entry["pid"] not in killed and deaths[entry["group"]] < 2]
    return draw.choice(open_ones) if open_ones else None
