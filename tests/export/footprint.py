"""What an export takes: bytes of state, code and tables, and the worst case of its stack, as
compilers that are there say it.
"""

import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

STRICT = ("-std=c99", "-ffp-contract=off")
ENTRIES = ("vehest_start", "vehest_step", "vehest_missing", "vehest_step_at")
SECONDS = 120.0  # after which a compiler is given up

_NODE = re.compile(r'node: \{ title: "([^"]+)" label: "([^"]*)"')
_EDGE = re.compile(r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"')
_STACK = re.compile(r"(\d+) bytes \((\w+)")


@dataclass(frozen=True)
class Target:
    """A compiler and what it compiles for."""

    title: str  # for people
    prefix: str = ""  # of its tools' names
    options: tuple[str, ...] = ("-O2",)  # beside those of all

    @property
    def compiler(self) -> str | None:
        """Where its gcc is; None if it is not there."""
        return shutil.which(f"{self.prefix}gcc")


HOST = Target("this machine")
CORTEX_M4F = Target(
    "Cortex-M4F",
    "arm-none-eabi-",
    ("-O2", "-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard"),
)
TARGETS = (HOST, CORTEX_M4F)


@dataclass(frozen=True)
class Footprint:
    """What an export takes on a target."""

    target: str  # title of the target
    compiler: str  # first line of what it says of itself
    state: int  # bytes of ``vehest_state``
    code: int  # bytes of instructions
    tables: int  # bytes of constants
    data: int  # bytes of variables, which an export has none of
    stack: int  # bytes of the deepest chain of calls, without what the C library takes
    library: tuple[str, ...]  # functions of the C library that are called


def footprint(files: Mapping[str, str], target: Target) -> Footprint | None:
    """What files, name -> text, take on a target, main.c aside.

    None where there is no compiler for it, or it cannot say.
    """
    if target.compiler is None:
        return None
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        sources = [name for name in files if name.endswith(".c") and name != "main.c"]
        for name in (*sources, *(name for name in files if name.endswith(".h"))):
            (folder / name).write_text(files[name], encoding="utf-8")
        (folder / "probe.c").write_text(
            '#include "vehest_estimator.h"\nchar probe[sizeof(vehest_state)];\n', encoding="utf-8"
        )
        try:
            options = [*STRICT, *target.options, "-fcallgraph-info=su"]
            _run([target.compiler, *options, "-c", *sources, "probe.c"], folder)
            objects = [Path(name).with_suffix(".o").name for name in sources]
            sections = _sections(_run([f"{target.prefix}size", "-A", *objects], folder))
            version = _run([target.compiler, "--version"], folder).partition("\n")[0]
            symbols = _run([f"{target.prefix}nm", "-S", "probe.o"], folder)
        except (OSError, subprocess.SubprocessError):
            return None
        graphs = [
            (folder / name).with_suffix(".ci").read_text(encoding="utf-8") for name in sources
        ]
    stack, library = worst_stack(graphs, ENTRIES)
    state = int(
        next(line.split()[1] for line in symbols.splitlines() if line.endswith("probe")), 16
    )
    return Footprint(target.title, version, state, *sections, stack, library)


def _run(command: list[str], folder: Path) -> str:
    """Output of a command that must succeed."""
    return subprocess.run(
        command, cwd=folder, check=True, capture_output=True, text=True, timeout=SECONDS
    ).stdout


def _sections(text: str) -> tuple[int, int, int]:
    """Bytes of code, constants and variables, from what ``size -A`` says of objects."""
    code = tables = data = 0
    for words in (line.split() for line in text.splitlines()):
        if len(words) < 3 or not words[1].isdigit():
            continue
        name = words[0]
        size = int(words[1])
        if name.startswith(".text"):
            code += size
        elif name.startswith((".rodata", ".data.rel.ro")):
            tables += size
        elif name.startswith((".data", ".bss")):
            data += size
    return code, tables, data


def worst_stack(graphs: Iterable[str], entries: Iterable[str]) -> tuple[int, tuple[str, ...]]:
    """Bytes of the deepest chain of calls from entries in ``gcc -fcallgraph-info=su``.

    Functions that are called and absent.
    """
    stack_of = {}
    calls = {}
    functions = set()
    for graph in graphs:
        for title, label in _NODE.findall(graph):
            functions.add(title)
            if match := _STACK.search(label):
                stack_of[title] = int(match[1])
        for source, target in _EDGE.findall(graph):
            calls.setdefault(source, set()).add(target)

    def deepest(function: str, above: tuple[str, ...]) -> int:
        """Deepest stack of a function and of those that it calls [bytes]."""
        if function in above:
            raise RecursionError(f"{function} calls itself")
        below = (deepest(inner, (*above, function)) for inner in calls.get(function, ()))
        return stack_of.get(function, 0) + max(below, default=0)

    stack = max(deepest(entry, ()) for entry in entries)
    return stack, tuple(
        sorted(name for name in functions - stack_of.keys() if not name.startswith("__indirect"))
    )
