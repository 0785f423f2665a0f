"""Two Ray nodes as two processes of this machine, the command line beside them, and what they leave behind."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pandas as pd

MOMENT = 0.02  # between two looks for an event
PATIENCE = 900.0  # s, after which an event that never came is a failure of the test


class TwoNodes:
    """A cluster of a head and a further node, a core each, on loopback."""

    def __init__(self, folder: Path, scratch_of_second: str = "") -> None:
        from ray.cluster_utils import Cluster

        self._cluster = Cluster()
        second = scratch_of_second or str(folder / "scratch-second")
        self.nodes = [self._add(str(folder / "scratch-head"), include_dashboard=False), self._add(second)]
        self._cluster.wait_for_nodes()

    def _add(self, scratch: str, **options: Any) -> Any:
        """A node, which keeps its copies in a folder of its own, as another machine would."""
        own = {"VEHEST_SCRATCH": scratch, "RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
        return self._cluster.add_node(num_cpus=1, env_vars=own, **options)

    @property
    def address(self) -> str:
        return str(self._cluster.address)

    def lose(self, node: Any) -> None:
        """End a node's daemons by SIGKILL, as a power cut does; its workers end when they notice."""
        for pid in _children(_raylet(node)):
            _kill(pid)
        self._cluster.remove_node(node, allow_graceful=False)

    def shut_down(self) -> None:
        self._cluster.shutdown()


def _raylet(node: Any) -> int:
    return int(node.all_processes["raylet"][0].process.pid)


def _children(pid: int) -> list[int]:
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:
                continue
            if parent == pid:
                found.append(int(folder.name))
    return found


def _kill(pid: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


class Driver:
    """``vehest`` in a process of its own."""

    def __init__(self, folder: Path, output: Path, *words: str, **environment: str) -> None:
        self.output = output
        self._log = output.with_suffix(".log")
        command = [sys.executable, "-c", "from vehest.cli import main; main()", *words]
        with open(self._log, "ab") as log:
            own = {**os.environ, **environment, "VEHEST_OUTPUT": str(output)}
            self.process = subprocess.Popen(command, cwd=folder, stdout=log, stderr=log, env=own, start_new_session=True)

    def ended(self) -> int:
        """Exit code, once it has one."""
        return self.process.wait(PATIENCE)

    def sees(self, event: Callable[[], Any]) -> Any:
        """Wait for an event; a command that ends before it fails the test."""
        limit = time.monotonic() + PATIENCE
        while time.monotonic() < limit:
            found = event()
            if found:
                return found
            assert self.process.poll() is None, f"it ended before the event:\n{self.said}"
            time.sleep(MOMENT)
        raise AssertionError(f"the event did not come:\n{self.said}")

    @property
    def said(self) -> str:
        return self._log.read_text(encoding="utf-8")


def journal(*roots: Path) -> list[dict[str, Any]]:
    """What workers have written down of their groups, each entry with its process and the parent's run."""
    entries = []
    for root in roots:
        for file in sorted(root.glob("journal/*/*.jsonl")):
            pid = int(file.stem.rpartition("-")[2])
            lines = [line for line in file.read_text(encoding="utf-8").splitlines() if line.endswith("}")]
            entries += [{**json.loads(line), "pid": pid, "run": file.parent.name} for line in lines]
    return entries


def under_way(*roots: Path) -> list[dict[str, Any]]:
    """Groups that were begun and have not ended."""
    entries = journal(*roots)
    over = {(entry["pid"], *entry["keys"]) for entry in entries if entry["event"] == "ended"}
    return [entry for entry in entries if entry["event"] == "begun" and (entry["pid"], *entry["keys"]) not in over]


def trained(*roots: Path) -> Counter[str]:
    """Key -> how often a training was brought to its end."""
    return Counter(key for entry in journal(*roots) for key in entry.get("made", ()))


def begun(*roots: Path) -> Counter[str]:
    """Key -> how often a worker set about it."""
    return Counter(key for entry in journal(*roots) if entry["event"] == "begun" for key in entry["keys"])


def metrics(output: Path) -> dict[str, str]:
    """Evaluation -> its figures as they are written, to the last digit."""
    return {folder.name: (folder / "metrics.csv").read_text() for folder in sorted((output / "evaluate").iterdir()) if folder.is_dir()}


def weights(output: Path) -> dict[str, bytes]:
    """Model -> its weights."""
    return {file.parent.name: file.read_bytes() for file in sorted((output / "train").glob("*/model.safetensors"))}


def sweep_of(output: Path) -> pd.DataFrame:
    """The table of the only sweep."""
    (folder,) = (output / "sweep").iterdir()
    return pd.read_csv(folder / "sweep.csv")


def with_recordings(source: Path, output: Path) -> Path:
    """An output root that has what another one has of recordings."""
    for stage in ("ingest", "downsample"):
        shutil.copytree(source / stage, output / stage)
    return output


@contextmanager
def server(command: Sequence[str], answers: Callable[[], bool]) -> Iterator[None]:
    """A process that serves until the end, from when it answers on."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    limit = time.monotonic() + PATIENCE
    try:
        while not answers():
            assert process.poll() is None
            assert time.monotonic() < limit
            time.sleep(MOMENT)
        yield
    finally:
        process.terminate()
        process.wait()
