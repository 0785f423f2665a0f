"""Small recordings that are quick to learn from, and where the real ones are."""

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # the other core has tests of its own

import gc
import pickle
from functools import cache
from hashlib import sha256
from pathlib import Path

import numpy as np
import omegaconf
import pytest
import torch
import typer

import processes
from vehest.alignment import delays
from vehest.data.recording import Recording

torch.set_num_threads(1)
gc.set_threshold(10_000)  # as in every command: compilers make many objects


PAPERS = Path(__file__).with_name("papers")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Tests of the papers' studies are apart, as all of `vehest_papers` is apart from the library.

    Tests of the unscented filters' families come first and thereby on one worker, since each worker
    that needs their kernels while another compiles them compiles them too, for a minute.
    """
    for item in items:
        if PAPERS in item.path.parents:
            item.add_marker("apart")
    items.sort(key=lambda item: not item.name.endswith(("[learned_ukf]", "[cnn_ukf]")))


@pytest.fixture(scope="session", autouse=True)
def _single_core():
    """Commands that name no number of jobs run them in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "sched_getaffinity", lambda _: {0})
        yield


@pytest.fixture(scope="session", autouse=True)
def _no_lines_by_the_clock():
    """No stage of this process is named because the machine is slow."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("vehest.run.console.MAX_SILENT_SECONDS", 3600.0)
        yield


@pytest.fixture(scope="session", autouse=True)
def _composed_once():
    """Hydra composes the same overrides over the same files of ./conf once, which takes it 0.1 s.

    A file of ./conf alone that no override and no defaults list can name does not count.
    """
    from vehest.configuration import composition as config

    compose = config.compose
    composed = {}

    def compose_once(command, overrides):
        *local, packaged, _ = config.conf_folders()
        contents = {
            file: file.read_bytes()
            for folder in local
            for file in sorted(folder.rglob("*.yaml"))
            if file.is_file()
        }
        all_count = any(b"defaults" in text for text in contents.values())
        words = " ".join(overrides)
        counts = [
            file
            for file in contents
            if all_count or file.stem in words or (packaged / file.relative_to("conf")).exists()
        ]
        key = (command, *overrides, *((str(file), contents[file]) for file in counts))
        if key not in composed:
            composed[key] = compose(command, overrides=overrides)
        return composed[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(config, "compose", compose_once)
        yield


@pytest.fixture(scope="session", autouse=True)
def _commands_built_once():
    """Typer builds its commands from the functions of the command line once, which takes it 30 ms,
    and OmegaConf parses the same text once.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(typer.main, "get_command", cache(typer.main.get_command))
        for module in (omegaconf.base, omegaconf.grammar_parser):
            patch.setattr(module, "parse", cache(omegaconf.grammar_parser.parse))
        yield


@pytest.fixture(scope="session", autouse=True)
def _drives_aligned_once():
    """The clocks of the same drive are compared once: most tests of commands read the same few
    drives, whose delays take 50 ms each to estimate.
    """
    estimate = delays.lateral_lateness
    estimated = {}

    def estimate_once(motion):
        key = sha256(pickle.dumps(motion)).digest()
        if key not in estimated:
            estimated[key] = estimate(motion)
        return estimated[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(delays, "lateral_lateness", estimate_once)
        yield


@pytest.fixture(scope="session", autouse=True)
def _readers_forked():
    """Files of others are read in a process that has imported what it reads with, which takes a new
    one 1 to 2 s.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("vehest.sources.limited.subprocess", processes.READING)
        yield


@pytest.fixture(autouse=True)
def _processes_end_with_their_test():
    """End the processes that a test started and left running."""
    yield
    processes.end_all()


@pytest.fixture(scope="session")
def data_root():
    """Folder of the real recordings; tests that need it are skipped where it is not set."""
    root = os.environ.get("VEHEST_DATA")
    if not root:
        pytest.skip("VEHEST_DATA is not set: the real recordings are not here")
    return Path(root)


def planar_drive(seconds=60.0, rate_hz=20.0, seed=0, noise=0.0, name="drive"):
    """A drive that obeys planar kinematics exactly (up to noise): smooth vx, yaw rate and vy,
    accelerations derived from them.
    """
    generator = np.random.default_rng(seed)
    time = np.arange(round(seconds * rate_hz)) / rate_hz
    phases = generator.uniform(0, 2 * np.pi, 6)
    yaw_rate = 0.35 * np.sin(0.5 * time + phases[0]) + 0.15 * np.sin(1.3 * time + phases[1])
    yaw_rate_dot = 0.35 * 0.5 * np.cos(0.5 * time + phases[0]) + 0.15 * 1.3 * np.cos(
        1.3 * time + phases[1]
    )
    vx = 25.0 + 4.0 * np.sin(0.2 * time + phases[2])
    vx_dot = 0.8 * np.cos(0.2 * time + phases[2])
    vy = -2.2 * yaw_rate + 0.3 * np.sin(0.7 * time + phases[3])
    vy_dot = -2.2 * yaw_rate_dot + 0.21 * np.cos(0.7 * time + phases[3])
    ay = vy_dot + vx * yaw_rate
    ax = vx_dot - vy * yaw_rate
    measured = {"vx": vx, "yaw_rate": yaw_rate, "ay": ay, "ax": ax}
    noisy = {
        key: values + noise * generator.standard_normal(len(time))
        for key, values in measured.items()
    }
    references = {"vx_ref": vx, "vy_ref": vy, "sideslip_ref": np.arctan2(vy, vx)}
    return Recording(name, "test car", rate_hz, 0.0, {**noisy, **references}, "simulated")


def flat_weights(estimator):
    """All weights of an estimator, one after the other."""
    return np.concatenate([values.ravel() for values in estimator.weights().values()])


def stop_after(questions):
    """Asks a training to stop after so many questions."""
    left = iter(range(questions))
    return lambda: next(left, None) is None


def die_after(reports):
    """Ends a training at the last of so many reports of its progress, as a kill does."""
    left = iter(range(reports - 1))

    def die(progress):
        """Interrupt once the calls are used up."""
        if next(left, None) is None:
            raise KeyboardInterrupt

    return die


@pytest.fixture
def drive():
    """One minute at 20 Hz without noise."""
    return planar_drive()


@pytest.fixture
def drawn():
    """Figures of a `place` are drawn as users see them."""


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """An empty working folder, without a data root, an output root or a tracking server from
    outside.
    """
    monkeypatch.chdir(tmp_path)
    for name in ("VEHEST_DATA", "VEHEST_OUTPUT", "MLFLOW_TRACKING_URI"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


@pytest.fixture
def place(request, elsewhere, monkeypatch, capsys):
    """A fresh place to work in; figures are drawn for tests that use `drawn`."""
    from place import Place, undrawn

    if "drawn" not in request.fixturenames:
        undrawn(monkeypatch)
    monkeypatch.setenv("VEHEST_DATA", str(elsewhere / "raw"))
    return Place(elsewhere, capsys)
