"""Two Ray nodes as two processes of this machine, the command line beside them, and what they leave
behind.
"""

import os
import shutil
import signal
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path

import pandas as pd

from processes import HANGS, start, wait_for


class TwoNodes:
    """A cluster of a head and a further node, a core each, on loopback."""

    def __init__(self):
        from ray.cluster_utils import Cluster

        self._cluster = Cluster()
        self.nodes = [self._add(include_dashboard=False), self._add()]
        self._cluster.wait_for_nodes()

    def _add(self, **options):
        return self._cluster.add_node(
            num_cpus=1,
            env_vars={"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"},
            **options,
        )

    @property
    def address(self):
        """Address at which drivers join the cluster."""
        return str(self._cluster.address)

    def holds(self, node, pid):
        """Whether a worker is one of a node's."""
        return pid in _children(_raylet(node))

    def lose(self, node):
        """End a node's daemons by SIGKILL, as a power cut does.

        Its workers end when they notice.
        """
        for pid in _children(_raylet(node)):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self._cluster.remove_node(node, allow_graceful=False)

    def shut_down(self):
        """End all nodes."""
        self._cluster.shutdown()


def _raylet(node):
    """Process of the daemon of a node."""
    return int(node.all_processes["raylet"][0].process.pid)


def _children(parent):
    """Processes that a process has started."""
    children = []
    for file in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            if int(file.read_text().rpartition(")")[2].split()[1]) == parent:
                children.append(int(file.parent.name))
    return children


class Driver:
    """``vehest`` in a process of its own."""

    def __init__(self, folder, output, *words, alone=False, **environment):
        """Start it.

        ``alone``: in an output root that no other process sees, and which is copied to ``output``
        at the end.
        """
        self.output = output
        self._log = output.with_suffix(".log")
        command = [sys.executable, "-c", "from vehest.cli import main; main()", *words]
        if alone:
            hidden = output.with_name("hidden")
            hidden.mkdir()
            environment["VEHEST_OUTPUT"] = str(hidden)
            script = 'hidden=$0; seen=$1; shift; mount -t tmpfs none "$hidden" '
            script += '&& cp -r "$seen/." "$hidden" && "$@"; '
            script += 'code=$?; cp -r "$hidden/." "$seen"; exit $code'
            command = ["unshare", "--mount", "sh", "-c", script, str(hidden), str(output), *command]
        with open(self._log, "ab") as log:
            driver_environment = {**os.environ, "VEHEST_OUTPUT": str(output), **environment}
            self.process = start(
                command, cwd=folder, stdout=log, stderr=log, env=driver_environment
            )

    def ends(self, code=0):
        """Wait for the end; another exit code fails the test."""
        assert self.process.wait(HANGS) == code, self.output_text
        return self

    def sees(self, event):
        """Wait for an event; a command that ends before it fails the test."""
        return wait_for(event, self.process, lambda: self.output_text)

    @property
    def output_text(self):
        """Output and errors of the process so far."""
        return self._log.read_text(encoding="utf-8")


def under_way(output):
    """Trainings that a process holds the lock of, with its process and the epoch of their
    checkpoints.
    """
    trainings = []
    for file in sorted((output / "locks").glob("train-*.lock")):
        name = file.name.removeprefix("train-").removesuffix(".lock")
        words = file.read_text(encoding="utf-8").split()
        alive = len(words) > 1 and Path(f"/proc/{words[1]}").exists()
        if (
            alive
            and not (output / "train" / name).exists()
            and (output / "checkpoints" / name / "checkpoint.safetensors").exists()
        ):
            trainings.append({"name": name, "pid": int(words[1])})
    return trainings


def files(pattern, output):
    """Artefact -> its file of a pattern."""
    return {file.parent.name: file.read_bytes() for file in sorted(output.glob(pattern))}


manifests = partial(files, "train/[!.]*/manifest.json")  # with the time at which a model was made
metrics = partial(files, "evaluate/*/metrics.csv")
weights = partial(files, "train/*/model.safetensors")


def sweep_of(output):
    """The table of the only sweep."""
    (folder,) = (output / "sweep").iterdir()
    return pd.read_csv(folder / "sweep.csv")


def with_recordings(source, output):
    """An output root that has what another one has of recordings."""
    for stage in ("ingest", "downsample"):
        shutil.copytree(source / stage, output / stage)
    return output
