"""Two Ray nodes against the local launcher: the same bits, whatever dies on the way.

Nothing that finished is made again.
"""

import importlib.util
import os
import signal
from pathlib import Path

import pytest
from two_nodes import (
    Driver,
    TwoNodes,
    manifests,
    metrics,
    sweep_of,
    under_way,
    weights,
    with_recordings,
)

from place import Place
from processes import HANGS

pytestmark = [
    pytest.mark.cluster,
    pytest.mark.skipif(
        importlib.util.find_spec("ray") is None,
        reason="Ray is not installed: pip install 'vehest[ray]'",
    ),
]

SMALL = ("split=mine", "estimator=ksnn", "training.batch_size=256", "tracking=none")
FORTY = (
    *SMALL,
    "estimator.n_local=2,3,4,5",
    "estimator.n_hidden=0,1",
    "seed=range(5)",
    "training.max_epochs=2",
)
LONGER = (
    *SMALL,
    "estimator.n_local=2,3",
    "estimator.n_hidden=0,1",
    "seed=range(2)",
    "training.patience=1000",
)
LONGER = (*LONGER, "training.max_epochs=150", "training.checkpoint_seconds=0.01")


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """A working folder with a data set of three short drives."""
    folder = tmp_path_factory.mktemp("cluster")
    former = os.environ.copy()
    os.environ["VEHEST_DATA"] = str(folder / "raw")
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    Place(folder, None)
    yield folder
    os.environ.clear()
    os.environ.update(former)


class Alone(dict[str, Path]):
    """Output roots of the same sweeps by the local launcher, each made when it is first
    asked for.
    """

    def __init__(self, folder):
        super().__init__()
        self._folder = folder

    def __missing__(self, name):
        words = {"forty": FORTY, "longer": LONGER}[name]
        self[name] = (
            Driver(self._folder, self._folder / f"alone-{name}", "sweep", *words, "--jobs", "2")
            .ends()
            .output
        )
        return self[name]


@pytest.fixture(scope="session")
def alone(folder):
    return Alone(folder)


@pytest.fixture(scope="session")
def cluster(folder):
    """One that outlives a test, since nothing happens to its nodes."""
    yield from _nodes()


def _nodes():
    nodes = TwoNodes()
    yield nodes
    nodes.shut_down()


@pytest.fixture
def mortal():
    """One of which a node will be lost."""
    yield from _nodes()


def swept(cluster, folder, output, *words, alone=False):
    return Driver(
        folder,
        output,
        "sweep",
        *words,
        "--launcher",
        "ray",
        "--address",
        cluster.address,
        alone=alone,
    )


def test_a_sweep_of_forty_trainings_has_the_bits_of_the_local_launcher(
    cluster, folder, alone, tmp_path
):
    output = with_recordings(alone["forty"], tmp_path / "out")
    driver = swept(cluster, folder, output, *FORTY).ends()
    assert "2 machines, 2 cores" in driver.said
    assert (len(metrics(output)), metrics(output), weights(output)) == (
        40,
        metrics(alone["forty"]),
        weights(alone["forty"]),
    )
    assert sweep_of(output).equals(sweep_of(alone["forty"]))
    before = manifests(output)
    assert len(before) == 40
    swept(cluster, folder, output, *FORTY, "--name", "again").ends()
    assert manifests(output) == before, "nothing was trained again"


def test_the_quickstart_has_the_bits_of_the_local_launcher(cluster, tmp_path):
    words = ("run", "quickstart", "training.max_epochs=2", "tracking=none")
    alone = Driver(tmp_path, tmp_path / "alone", *words, "--jobs", "2").ends()
    output = with_recordings(alone.output, tmp_path / "out")
    Driver(tmp_path, output, *words, "--launcher", "ray", "--address", cluster.address).ends()
    assert (len(metrics(output)), metrics(output), weights(output)) == (
        13,
        metrics(alone.output),
        weights(alone.output),
    )
    (page,), (page_alone,) = (
        list(root.glob("report/*/metrics.csv")) for root in (output, alone.output)
    )
    assert page.read_bytes() == page_alone.read_bytes()


def test_a_killed_worker_is_replaced_and_the_bits_are_the_same(cluster, folder, alone, tmp_path):
    output = with_recordings(alone["longer"], tmp_path / "out")
    driver = swept(cluster, folder, output, *LONGER)
    lost = driver.sees(lambda: under_way(output))[0]
    before = manifests(output)
    os.kill(lost["pid"], signal.SIGKILL)
    driver.ends()
    assert (metrics(output), weights(output)) == (
        metrics(alone["longer"]),
        weights(alone["longer"]),
    )
    assert "again   ray        A worker died" in driver.said
    assert before.items() <= manifests(output).items(), (
        "nothing that had finished was trained again"
    )
    assert not list(output.glob("checkpoints/*"))


def test_a_lost_node_takes_nothing_that_was_finished(mortal, folder, alone, tmp_path):
    output = with_recordings(alone["longer"], tmp_path / "out")
    driver = swept(mortal, folder, output, *LONGER)
    driver.sees(
        lambda: [
            entry for entry in under_way(output) if mortal.holds(mortal.nodes[1], entry["pid"])
        ]
    )
    before = manifests(output)
    mortal.lose(mortal.nodes[1])
    driver.ends()
    assert (metrics(output), weights(output)) == (
        metrics(alone["longer"]),
        weights(alone["longer"]),
    )
    assert before.items() <= manifests(output).items()


def test_ctrl_c_loses_nothing_and_the_next_call_goes_on(cluster, folder, alone, tmp_path):
    output = with_recordings(alone["longer"], tmp_path / "out")
    driver = swept(cluster, folder, output, *LONGER)
    driver.sees(lambda: under_way(output))
    driver.process.send_signal(signal.SIGINT)
    driver.ends(130)
    assert not list(output.glob("sweep/*"))
    assert list(output.glob("checkpoints/*")), "what was under way is kept"
    before = {
        name: text for name, text in manifests(output).items() if b'"status": "complete"' in text
    }
    swept(cluster, folder, output, *LONGER).ends()
    assert (metrics(output), weights(output)) == (
        metrics(alone["longer"]),
        weights(alone["longer"]),
    )
    assert before.items() <= manifests(output).items()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can hide a folder from other processes")
def test_nodes_that_do_not_share_the_output_root_get_copies_and_send_artefacts_back(
    mortal, folder, alone, tmp_path
):
    output = with_recordings(alone["longer"], tmp_path / "out")
    driver = swept(mortal, folder, output, *LONGER, alone=True)
    driver.sees(
        lambda: list((tmp_path / "hidden" / "checkpoints").glob("*/checkpoint.safetensors"))
    )
    mortal.lose(mortal.nodes[1])
    driver.ends()
    assert "does not share the output root" in driver.said
    assert (metrics(output), weights(output)) == (
        metrics(alone["longer"]),
        weights(alone["longer"]),
    )


def test_a_group_that_ends_every_worker_fails_alone(cluster, folder, alone, tmp_path):
    output = with_recordings(alone["longer"], tmp_path / "out")
    single_seed = (*(word for word in LONGER if not word.startswith("seed=")), "seed=0")
    driver = swept(cluster, folder, output, *single_seed)
    poisoned = driver.sees(lambda: under_way(output))[0]["name"]
    killed = set()
    for _ in range(3):
        entry = driver.sees(
            lambda: next(
                (e for e in under_way(output) if e["name"] == poisoned and e["pid"] not in killed),
                None,
            )
        )
        killed.add(entry["pid"])
        os.kill(entry["pid"], signal.SIGKILL)
    driver.ends(5)
    assert "3 times; --launcher local shows what ends it" in driver.said
    assert len(metrics(output)) == 3
    swept(cluster, folder, output, *single_seed).ends()
    assert len(metrics(output)) == 4
    assert metrics(output).items() <= metrics(alone["longer"]).items()


def test_the_head_lost_loses_nothing_that_was_finished(mortal, folder, alone, tmp_path):
    output = with_recordings(alone["longer"], tmp_path / "out")
    driver = swept(mortal, folder, output, *LONGER)
    driver.sees(lambda: under_way(output))
    mortal.lose(mortal.nodes[0])
    assert driver.process.wait(HANGS) != 0
    before = manifests(output)
    Driver(folder, output, "sweep", *LONGER, "--jobs", "2").ends()
    assert metrics(output) == metrics(alone["longer"])
    assert before.items() <= manifests(output).items()
