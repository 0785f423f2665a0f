"""The process that imports once, and the workers that build inputs and fork a child for each."""

import contextlib
import gc
import io
import json
import multiprocessing
import os
import random
import select
import shlex
import shutil
import signal
import sys
import time
import traceback
from collections import Counter, namedtuple
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import pandas as pd

from fuzz.case import GENERATORS, PLANTED, TEMPLATES, Case, is_honest, load_families, schedule
from fuzz.verdicts import Outcome, differences, judge, last_line, refusal_lines, snapshot
from fuzz.watched import READER, STACK_SIGNAL, become
from processes import die_with_parent, status_kb
from vehest.data.errors import printable

MOST_WALL_SECONDS = 180.0
POLL_SECONDS = 0.02
STACK_SECONDS = 5.0  # a busy machine lets a command wait for a core, which then writes its stack
Row = namedtuple(
    "Row",
    "index family generator honest command exit_code seconds cpu_seconds peak_mb error verdict "
    "detail",
)
"""One input and what became of it: a line of the CSV file."""


class Fuzzer:
    """Everything that is imported and made once.

    All families but the planted ones, if none is named.
    """

    def __init__(self, folder, seed, families=(), *, keep=False, seconds=20.0):
        self.folder = folder.resolve()
        self.seed = seed
        self.keep = keep
        self.seconds = seconds
        load_families()
        chosen = [
            generator
            for generator in GENERATORS
            if (generator.family in families if families else generator.family != PLANTED)
        ]
        if not chosen:
            raise SystemExit("no family has such a name")
        self.turns = schedule(chosen)

    def prepare(self):
        """Import what commands import, and make the templates that generators copy from."""
        if all(generator.family == PLANTED for generator in self.turns):
            return
        from fuzz import honest

        honest.import_everything()
        template_names = sorted({name for generator in self.turns for name in generator.needs})
        for name, make in {
            "first": honest.warm_up,
            **{name: TEMPLATES[name] for name in template_names},
        }.items():
            folder = self.folder / "templates" / name
            folder.mkdir(parents=True)
            with _quiet(folder):
                make(folder)

    def generator_of(self, index):
        """Generator of an input, how often it has had its turn before, and whether the input is to
        be honest.
        """
        position = index % len(self.turns)
        visit = index // len(self.turns)
        generator = self.turns[position]
        turns_before = self.turns[:position].count(generator)
        return (
            generator,
            visit * generator.weight + turns_before,
            is_honest(generator, position, visit),
        )

    def run(self, indices, jobs, report):
        """Try inputs in ``jobs`` workers, and report each as it ends."""
        gc.collect()
        gc.freeze()  # what is here stays; children need not copy it to look through it
        sys.stdout.flush()
        with ProcessPoolExecutor(
            jobs, multiprocessing.get_context("fork"), die_with_parent
        ) as workers:
            for ended in as_completed([workers.submit(self.try_input, index) for index in indices]):
                report(ended.result())

    def try_input(self, index):
        """Make one input, run its command in a forked child, and judge."""
        generator, visit, honest = self.generator_of(index)
        case = self.case_of(index, visit, honest)
        try:
            command = generator.build(case)
        except Exception:
            detail = printable(" | ".join(traceback.format_exc().splitlines()[-4:]))
            return Row(
                index,
                generator.family,
                generator.name,
                honest,
                "",
                0,
                0.0,
                0.0,
                0.0,
                "",
                "generator failed",
                detail,
            )
        outcome = _watch(case, command)
        verdict, detail = judge(case, command, outcome)
        if not self.keep:
            _remove(case.folder)
        error = last_line("\n".join(refusal_lines(outcome.stderr)))
        command_text = _command_text(command, case)
        took = (outcome.exit_code, outcome.seconds, outcome.cpu_seconds, outcome.peak_mb)
        texts = (
            printable(text.replace(str(case.folder), "…"))[:200]
            for text in (error, verdict, detail)
        )
        return Row(
            index,
            generator.family,
            generator.name,
            honest,
            command_text,
            *(round(number, 3) for number in took),
            *texts,
        )

    def case_of(self, index, visit, honest):
        """An empty folder for an input; what is drawn depends on seed and index alone."""
        folder = self.folder / f"{index:06d}"
        _remove(folder)
        case = Case(
            folder,
            self.folder / "templates",
            random.Random(f"{self.seed}-{index}"),
            honest,
            visit,
            self.seconds,
        )
        for subfolder in (case.place, folder / "tmp", folder / "home", folder / "log"):
            subfolder.mkdir(parents=True)
        return case


def _watch(case, command):
    """Run a command in a forked child and see what it does."""
    pipe = case.folder / "log" / "reader"
    os.mkfifo(pipe)
    before = snapshot(case.folder)
    started = time.monotonic()
    child = os.fork()
    if child == 0:
        become(case, command)
    process = os.pidfd_open(child)
    events = os.open(pipe, os.O_RDWR | os.O_NONBLOCK)
    readers = _Readers(child)

    def is_late():
        readers.look()
        return time.monotonic() - started > min(case.seconds + readers.waited, MOST_WALL_SECONDS)

    stopped = False
    while not (stopped or select.select([process], [], [], POLL_SECONDS)[0]):
        if is_late():
            # the kernel counts a wait for a core when it ends: once the stack is written, all of it
            _ask_for_stack(child, case.folder / "log" / "stack")
            stopped = is_late()
    if stopped:
        os.killpg(child, signal.SIGKILL)
    os.close(process)
    readers.look()
    seconds = max(0.0, time.monotonic() - started - readers.waited)
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(
            child, signal.SIGKILL
        )  # whatever it has started; its number is its own until it is waited for
    _, status, resources = os.wait4(child, 0)
    logs = case.folder / "log"
    noted = [json.loads(line) for line in _text(logs / "events").splitlines()]
    with contextlib.suppress(BlockingIOError):
        noted += [json.loads(line) for line in os.read(events, 2**16).splitlines()]
    os.close(events)
    imports_kb = next((value for key, value in noted if key == "rss"), resources.ru_maxrss)
    most_kb = (
        readers.command_kb if readers.peaks_kb else resources.ru_maxrss
    )  # which counts ended children too
    return Outcome(
        exit_code=os.waitstatus_to_exitcode(status),
        seconds=seconds,
        stopped=stopped,
        cpu_seconds=resources.ru_utime + resources.ru_stime,
        peak_mb=(max(0, most_kb - imports_kb) + max(readers.peaks_kb.values(), default=0)) / 1024,
        stdout=_text(logs / "stdout"),
        stderr=_text(logs / "stderr"),
        events=tuple((key, str(value)) for key, value in noted if key != "rss"),
        changed=differences(before, snapshot(case.folder)),
        stack=" < ".join(
            line.strip() for line in _text(logs / "stack").splitlines() if line.startswith("  File")
        )[:1500],
    )


def _ask_for_stack(child, file):
    """Let a command write where it is, and wait until it has, or for `STACK_SECONDS`."""
    before = _text(file)
    with contextlib.suppress(ProcessLookupError):
        os.kill(child, STACK_SIGNAL)
    asked = time.monotonic()
    while _text(file) == before and time.monotonic() - asked < STACK_SECONDS:
        time.sleep(POLL_SECONDS)


class _Readers:
    """What a command and the reading processes that it starts take, as far as repeated looks at
    them tell.
    """

    def __init__(self, command):
        self._command = command
        self.command_kb = 0  # most memory of the command
        self.peaks_kb = {}  # of each reading process
        self._waits = {}

    @property
    def waited(self):
        """Seconds that all of them waited for a core."""
        return sum(self._waits.values())

    def look(self):
        """Note memory and waiting of those that run."""
        with contextlib.suppress(OSError, IndexError, StopIteration):
            self._waits[self._command] = _waited(self._command)
            self.command_kb = max(self.command_kb, status_kb("VmHWM", self._command))
            for task in Path(f"/proc/{self._command}/task").iterdir():
                for reader in (task / "children").read_text().split():
                    if READER.encode() in Path(f"/proc/{reader}/cmdline").read_bytes():
                        self.peaks_kb[reader] = status_kb("VmHWM", reader)
                        self._waits[reader] = _waited(reader)


def _waited(process):
    """Seconds that a process has waited for a core on a machine that has others to serve."""
    return int(Path(f"/proc/{process}/schedstat").read_text().split()[1]) / 1e9


def _remove(folder):
    """Remove a folder, also where its permissions were changed."""
    if folder.exists():
        for inside, _, _ in os.walk(folder):
            with contextlib.suppress(OSError):
                os.chmod(inside, 0o700)
        shutil.rmtree(folder, ignore_errors=True)


def _text(path):
    """A log as text, the first megabytes of it."""
    try:
        with open(path, "rb") as stream:
            return stream.read(4_000_000).decode("utf-8", "backslashreplace")
    except OSError:
        return ""


def _command_text(command, case):
    """Words of a command, long ones cut."""
    words = [os.fsdecode(word).replace(str(case.place), ".") for word in command.argv]
    cut = [word if len(word) <= 160 else f"{word[:150]}…({len(word)} characters)" for word in words]
    return printable(" ".join(shlex.quote(word) for word in cut))[:600]


@contextlib.contextmanager
def _quiet(folder):
    """Work in a folder, with what is printed kept back."""
    printed = io.StringIO()
    try:
        with (
            contextlib.chdir(folder),
            contextlib.redirect_stdout(printed),
            contextlib.redirect_stderr(printed),
        ):
            yield
    except BaseException:
        sys.stdout.write(printed.getvalue())
        raise


def write_rows(rows, path):
    """Rows as CSV, in the order of their index."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(sorted(rows, key=lambda row: row.index)).to_csv(path, index=False)


def described(row):
    """A row for people, on two lines."""
    kind = " (honest)" if row.honest else ""
    took = f"{row.seconds:.1f} s ({row.cpu_seconds:.1f} s computing)"
    return (
        f"{row.verdict:<13} {row.index:>5} {row.family}/{row.generator}{kind}: vehest "
        f"{row.command}\n"
        f"{'':13} exit {row.exit_code}, {took}, {row.peak_mb:.0f} MB: {row.error or '-'} "
        f"{row.detail}"
    )


def summary(rows):
    """A line a family: how many inputs, how many honest ones, and how they ended."""
    lines = []
    for family in [*sorted({row.family for row in rows}), "all"]:
        family_rows = [row for row in rows if family in (row.family, "all")]
        ended = ", ".join(
            f"{number} {verdict}"
            for verdict, number in Counter(row.verdict for row in family_rows).most_common()
        )
        honest = sum(row.honest for row in family_rows)
        done = sum(row.exit_code == 0 for row in family_rows)
        lines.append(
            f"{family:<14} {len(family_rows):>5} inputs, {honest:>4} honest, {done:>4} done: "
            f"{ended}"
        )
    return "\n".join(lines)
