"""Commands that misbehave on purpose, one for each verdict: they show that the harness notices.

No part of a normal run.
"""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from fuzz.case import CANARY, Command, generator
from vehest.data.errors import DataError
from vehest.data.limits import Limits, use_limits
from vehest.sources.limited import read_limited

MUCH = 2400 * 2**20  # bytes


@generator()
def planted(case):
    """A misdeed that must be detected."""
    name = list(MISDEEDS)[case.visit % len(MISDEEDS)]
    case.write("raw/given.csv", "time\n0\n")
    case.write("sly.py", "pass\n")
    return Command((f"PLANTED:{name}",))


def _finish():
    """End as a command does that succeeds."""
    Path("outputs").mkdir()
    Path("outputs/model.txt").write_text("made")
    Path("out.csv").write_text("made")
    print("done")


def _leave(code, error_text=""):
    """End with an exit code and errors."""
    sys.stderr.write(error_text)
    sys.exit(code)


def _import_a_module():
    """Import a module of the current folder."""
    sys.path.insert(0, os.getcwd())
    __import__("sly")


def _raise():
    """Raise an exception that nobody catches."""
    raise ValueError("not caught")


def _leave_half_a_file():
    """Leave an artefact unfinished."""
    Path("outputs").mkdir()
    Path("outputs/.writing-1-aaaaaaaa-model").write_text("")


def _compute():
    """Call functions without an end."""
    while True:
        sum(map(abs, range(100)))


def _read_by(reader):
    """Read a file by one of the readers below, in a limited process."""
    with suppress(DataError), use_limits(Limits(memory=3_500_000_000)):
        read_limited(f"{__name__}:{reader}", Path("raw/given.csv"))


def answer(*_, **__):
    return {"x": np.ones(3)}, {}


def formula(file):
    return {"x": np.full(3, eval(file.read_text().splitlines()[1]))}, {}


def write(_):
    os.mkdir("beside")
    return {}, {}


def much(_):
    return {"x": np.ones(len(bytearray(b"x") * MUCH) // 2**30)}, {}


MISDEEDS = {
    "finishes": ("ok", _finish),
    "refuses_in_one_line": (
        "ok",
        lambda: _leave(3, "warning something else\nerror: 'raw/given.csv' holds nothing\n"),
    ),
    "evaluates": ("executed", lambda: eval("1 + 1")),
    "starts_a_program": ("executed", lambda: subprocess.run(["true"], check=True)),
    "imports_a_module": ("executed", _import_a_module),
    "makes_the_canary": ("executed", lambda: Path(CANARY).write_text("")),
    "writes_beside_the_output_root": ("outside", lambda: Path("evil").write_text("")),
    "writes_far_away": ("outside", lambda: Path("/tmp/vehest-fuzz-far-away").write_text("")),
    "changes_an_input": ("outside", lambda: Path("raw/given.csv").write_text("time\n1\n")),
    "sleeps": ("slow", lambda: time.sleep(60)),
    "computes": ("slow", _compute),
    "allocates": ("memory", lambda: len(bytearray(b"x") * MUCH)),
    "dies": ("crash", lambda: os.kill(os.getpid(), signal.SIGSEGV)),
    "raises": ("traceback", _raise),
    "calls_itself_a_defect": (
        "exit1",
        lambda: _leave(1, "error: this is a defect of vehest (KeyError: 'a')\n"),
    ),
    "says_nothing": ("silent", lambda: _leave(2)),
    "says_too_much": (
        "several lines",
        lambda: _leave(2, "Usage: vehest\n\nerror: no such command\n"),
    ),
    "colours_the_terminal": ("escapes", lambda: _leave(3, "error: no column '\x1b[31mvx'\n")),
    "leaves_half_a_file": ("leftovers", _leave_half_a_file),
    "reads_in_a_process": ("ok", lambda: _read_by("answer")),
    "evaluates_while_reading": ("executed", lambda: _read_by("formula")),
    "writes_while_reading": ("outside", lambda: _read_by("write")),
    "allocates_while_reading": ("memory", lambda: _read_by("much")),
}
