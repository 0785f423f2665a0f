"""Commands that misbehave on purpose, one for each verdict: they show that the harness notices. No part of a normal run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from fuzz.case import CANARY, Case, Command, generator
from vehest.data.errors import DataError
from vehest.data.limits import Limits, use_limits
from vehest.sources.limited import read_limited

MISDEEDS: dict[str, tuple[str, Callable[[], None]]] = {}


def _misdeed(verdict: str) -> Callable[[Callable[[], None]], Callable[[], None]]:
    def register(act: Callable[[], None]) -> Callable[[], None]:
        MISDEEDS[act.__name__] = (verdict, act)
        return act

    return register


@generator()
def planted(case: Case) -> Command:
    name = list(MISDEEDS)[case.visit % len(MISDEEDS)]
    (case.place / "raw").mkdir()
    (case.place / "raw" / "given.csv").write_text("time\n0\n")
    (case.place / "sly.py").write_text("pass\n")
    return Command((f"PLANTED:{name}",), targets=("out.csv",))


@_misdeed("ok")
def finishes() -> None:
    Path("outputs").mkdir()
    Path("outputs/model.txt").write_text("made")
    Path("out.csv").write_text("made")
    print("done")


@_misdeed("ok")
def refuses_in_one_line() -> None:
    sys.stderr.write("warning something else\nerror: 'raw/given.csv' holds nothing\n")
    sys.exit(3)


@_misdeed("executed")
def evaluates() -> None:
    eval("1 + 1")


@_misdeed("executed")
def runs_a_shell() -> None:
    os.system("true")


@_misdeed("executed")
def starts_a_program() -> None:
    subprocess.run(["true"], check=True)


@_misdeed("executed")
def imports_a_module() -> None:
    sys.path.insert(0, os.getcwd())
    __import__("sly")


@_misdeed("executed")
def makes_the_canary() -> None:
    Path(CANARY).write_text("")


@_misdeed("outside")
def writes_beside_the_output_root() -> None:
    Path("evil").write_text("")


@_misdeed("outside")
def writes_above_the_place() -> None:
    Path("../../evil").write_text("")


@_misdeed("outside")
def writes_far_away() -> None:
    Path("/tmp/vehest-fuzz-far-away").write_text("")


@_misdeed("outside")
def changes_an_input() -> None:
    Path("raw/given.csv").write_text("time\n1\n")


@_misdeed("slow")
def sleeps() -> None:
    time.sleep(60)


@_misdeed("memory")
def allocates() -> None:
    bytearray(b"x") * (2400 * 2**20)


@_misdeed("crash")
def dies() -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


@_misdeed("traceback")
def raises() -> None:
    raise ValueError("nobody caught this")


@_misdeed("exit1")
def calls_itself_a_defect() -> None:
    sys.stderr.write("error: this is a defect of vehest (KeyError: 'a')\n")
    sys.exit(1)


@_misdeed("silent")
def says_nothing() -> None:
    sys.exit(2)


@_misdeed("several lines")
def says_too_much() -> None:
    sys.stderr.write("Usage: vehest\n\nerror: no such command\n")
    sys.exit(2)


@_misdeed("several lines")
def says_it_otherwise() -> None:
    sys.stderr.write("no such command\n")
    sys.exit(2)


@_misdeed("escapes")
def colours_the_terminal() -> None:
    sys.stderr.write("error: no column '\x1b[31mvx'\n")
    sys.exit(3)


@_misdeed("leftovers")
def leaves_half_a_file() -> None:
    Path("outputs").mkdir()
    Path("outputs/.writing-1-aaaaaaaa-model").write_text("")


def _reads_by(reader: str) -> None:
    read_limited(f"{__name__}:{reader}", Path("raw/given.csv"))


def _reader(*_: object, **__: object) -> tuple[dict[str, object], dict[str, object]]:
    return {"x": np.ones(3)}, {}


@_misdeed("ok")
def reads_in_a_process() -> None:
    _reads_by("_reader")


def _formula(file: Path) -> tuple[dict[str, object], dict[str, object]]:
    return {"x": np.full(3, eval(file.read_text().splitlines()[1]))}, {}


@_misdeed("executed")
def evaluates_while_reading() -> None:
    _reads_by("_formula")


def _shell(_: Path) -> tuple[dict[str, object], dict[str, object]]:
    os.system("true")
    return {}, {}


@_misdeed("executed")
def runs_a_shell_while_reading() -> None:
    with suppress(DataError):
        _reads_by("_shell")


def _write(_: Path) -> tuple[dict[str, object], dict[str, object]]:
    os.mkdir("beside")
    return {}, {}


@_misdeed("outside")
def writes_while_reading() -> None:
    with suppress(DataError):
        _reads_by("_write")


def _much(_: Path) -> tuple[dict[str, object], dict[str, object]]:
    much = bytearray(b"x") * (2400 * 2**20)
    return {"x": np.ones(len(much) // 2**30)}, {}


@_misdeed("memory")
def allocates_while_reading() -> None:
    with use_limits(Limits(memory=3_500_000_000)):
        _reads_by("_much")
