"""What became of an input: one word, the gravest that applies."""

import os
import re
import stat
from dataclasses import dataclass
from pathlib import Path

from fuzz.case import CANARY
from vehest.data.files import ASIDE_PREFIX

MEMORY_MB = 2048.0
VERDICTS = {
    "ok": "it was done, or refused with one line and its exit code",
    "executed": "code or a program ran that the input asked for, or a module was imported for it",
    "outside": "something was written outside of the output root and the named targets",
    "slow": "over 20 s, not counting those spent waiting for a core",
    "memory": "over 2 GB above what the imports take, with the reading process that it starts",
    "crash": "ended by a signal",
    "traceback": "a traceback was printed",
    "exit1": "exit code 1, or another that is not documented",
    "refused": "an honest input was not done",
    "silent": "not done, and nothing on standard error",
    "several lines": "not done, and more or other than one line that begins with 'error: '",
    "escapes": "control characters on standard output or error",
    "leftovers": "half-written or temporary files stayed",
}
EXIT_CODES = frozenset({0, 2, 3, 4, 5, 130, 141, 143})
PROGRESS = ("done ", "reused ", "running ", "would ", "once ", "failed ", "stopped ", "warning")
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f\x80-\x9f]")


@dataclass(frozen=True)
class Outcome:
    """How a child ended."""

    exit_code: int  # negative for a signal
    seconds: float  # of wall clock, less those spent waiting for a core
    stopped: bool  # because its time was up
    cpu_seconds: float
    peak_mb: float  # most memory above that of the imports
    stdout: str
    stderr: str
    events: tuple[tuple[str, str], ...]  # of the audit hook: verdict and what happened
    changed: tuple[str, ...]  # paths in the case's folder that are new, gone or different
    stack: str  # where it was when its time was up


def judge(case, command, outcome):
    """Verdict, and what it is about."""
    for verdict, detail in _findings(case, command, outcome):
        return verdict, detail
    return "ok", ""


def _findings(case, command, outcome):
    """Verdicts on one command, each with its reason."""
    canaries = [path for path in outcome.changed if Path(path).name == CANARY]
    yield from (("executed", f"made {path}") for path in canaries)
    for verdict in ("executed", "outside"):
        yield from (event for event in outcome.events if event[0] == verdict)
    yield from (
        ("outside", path) for path in outcome.changed if not _is_allowed(path, case, command)
    )
    if outcome.peak_mb > MEMORY_MB:
        yield "memory", f"{outcome.peak_mb:.0f} MB"
    if outcome.stopped or outcome.seconds > case.seconds:
        yield (
            "slow",
            f"{outcome.seconds:.0f} s, {outcome.cpu_seconds:.0f} s of them computing; "
            f"{outcome.stack}",
        )
    if outcome.exit_code < 0:
        yield "crash", f"signal {-outcome.exit_code}"
    if "Traceback (most recent call last)" in outcome.stderr + outcome.stdout:
        yield "traceback", last_line(outcome.stderr)
    if outcome.exit_code not in EXIT_CODES:
        yield "exit1", f"exit code {outcome.exit_code}"
    if "this is a defect of vehest" in outcome.stderr + outcome.stdout:
        yield "exit1", "it calls itself a defect"
    yield from _about_lines(case, command, outcome)
    control = _CONTROL.search(outcome.stdout) or _CONTROL.search(outcome.stderr)
    if control:
        yield "escapes", repr(control.string[max(0, control.start() - 20) : control.end() + 20])
    yield from (
        ("leftovers", path)
        for path in outcome.changed
        if ASIDE_PREFIX in path or path.startswith("tmp/")
    )


def _about_lines(case, command, outcome):
    """Verdicts on the lines that a command that failed has written."""
    if outcome.exit_code == 0:
        return
    if case.honest:
        yield "refused", f"exit code {outcome.exit_code}: {last_line(outcome.stderr)}"
    lines = refusal_lines(outcome.stderr)
    words = [
        os.fsdecode(word) for word in command.argv[:2]
    ]  # these say on standard output what is wrong, and leave with a code by it
    if not lines and not (
        (words[:1] == ["doctor"] or words == ["data", "check"]) and outcome.stdout.strip()
    ):
        yield "silent", f"exit code {outcome.exit_code}"
    if len(lines) > 1 or any(not line.startswith("error: ") for line in lines):
        yield "several lines", f"{len(lines)} lines, first {lines[0][:120]!r}"


def refusal_lines(stderr):
    """Lines on standard error that are no progress and no warning."""
    return [line for line in stderr.split("\n") if line.strip() and not line.startswith(PROGRESS)]


def last_line(text):
    """The last line that is not blank."""
    lines = [line for line in text.split("\n") if line.strip()]
    return lines[-1] if lines else ""


def _is_allowed(path, case, command):
    """Whether a command may write to a path."""
    place = case.place.relative_to(case.folder).as_posix()
    roots = [f"{place}/{name}" for name in ("outputs", *command.targets)] + ["tmp"]
    folder, _, name = path.rpartition("/")  # a target is first written beside it
    is_aside = name.startswith(ASIDE_PREFIX) and any(
        root.rpartition("/")[0] == folder for root in roots
    )
    return is_aside or any(path == root or path.startswith(f"{root}/") for root in roots)


def snapshot(folder):
    """Everything below a folder, with what would change if it were written to.

    Logs are left out, links not followed.
    """
    states = {}
    pending = [str(folder)]
    while pending:
        inside = pending.pop()
        try:
            entries = list(os.scandir(inside))
        except OSError:
            continue
        for entry in entries:
            path = os.path.relpath(entry.path, folder)
            if path == "log":
                continue
            about = entry.stat(follow_symlinks=False)
            is_folder = stat.S_ISDIR(about.st_mode)
            states[path] = (
                about.st_mode,
                None if is_folder else (about.st_size, about.st_mtime_ns, about.st_ino),
            )
            if is_folder:
                pending.append(entry.path)
    return states


def differences(before, after):
    """Paths that are new, gone or different, sorted."""
    return tuple(
        sorted(path for path in before.keys() | after.keys() if before.get(path) != after.get(path))
    )
