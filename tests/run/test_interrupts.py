"""Ctrl-C at any moment of a command: exit code 130, at most one line, no traceback."""

import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from processes import end_all, start

PYPROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"
STOPPED = "error: stopped by SIGINT; finished artefacts are kept, the same command goes on\n"
PROGRAM = """
import atexit, os, runpy, signal, sys

signal.signal(signal.SIGINT, signal.default_int_handler)


def press_ctrl_c(kill=os.kill, process=os.getpid()):
    kill(process, 2)


class Finaliser:
    def __del__(self, press_ctrl_c=press_ctrl_c):
        press_ctrl_c()


class Finder:
    module = MODULE

    @classmethod
    def find_spec(cls, name, *_):
        if name == cls.module:
            cls.module = ""
            ACTION


sys.meta_path.insert(0, Finder)
sys.argv = ["vehest", *WORDS]
runpy.run_module("vehest", run_name="__main__")
"""
IN_FINALISER = "Finaliser()"
CAUGHT = "try: press_ctrl_c()\n            except BaseException: pass"
TRANSLATED = (
    "try: press_ctrl_c()\n            except BaseException: raise ImportError('initialisation "
    "failed')"
)
AT_TEARDOWN = "sys.finaliser = Finaliser(); press_ctrl_c()"
AT_EXIT = "atexit.register(press_ctrl_c)"
TWICE = "atexit.register(press_ctrl_c); press_ctrl_c()"


@pytest.mark.parametrize(
    ("module", "action", "lines"),
    [
        ("vehest.cli", "press_ctrl_c()", ""),
        ("typer", "press_ctrl_c()", ""),
        ("typer", CAUGHT, ""),
        ("vehest.configuration.composition", "press_ctrl_c()", STOPPED),
        ("vehest.configuration.composition", CAUGHT, STOPPED),
        ("vehest.configuration.composition", TRANSLATED, STOPPED),
        ("vehest.configuration.composition", IN_FINALISER, ""),
        ("vehest.configuration.composition", TWICE, STOPPED),
        ("vehest.configuration.composition", AT_TEARDOWN, STOPPED),
        ("vehest.configuration.composition", AT_EXIT, ""),
    ],
)
def test_ctrl_c_ends_a_command_without_a_traceback(tmp_path, module, action, lines):
    program = PROGRAM.replace("MODULE", repr(module), 1).replace("ACTION", action)
    program = program.replace("WORDS", repr(["config", "train", "estimator=ksnn"]))
    try:
        process = start(
            [sys.executable, "-c", program],
            cwd=tmp_path,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert (process.communicate()[1], process.returncode) == (lines, 128 + signal.SIGINT)
    finally:
        end_all()


def test_the_console_script_starts_where_ctrl_c_has_a_handler():
    project = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))["project"]
    assert project["scripts"] == {"vehest": "vehest.__main__:main"}
