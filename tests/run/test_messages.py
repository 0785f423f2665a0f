"""Messages to users: usage errors, hostile names, full disks, broken streams.

One line each, without control of the terminal.
"""

import errno
import io
import json
import os
import resource
import shutil
import sqlite3
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import pandas as pd
import pytest
import yaml
from safetensors import SafetensorError

from conftest import planar_drive
from vehest.configuration.composition import as_yaml, compose_config, count, expand, limits_of
from vehest.data.errors import ConfigurationError, MissingError, is_printable, printable
from vehest.data.files import no_room, written_aside
from vehest.data.limits import Limits, use_limits
from vehest.run import console
from vehest.run.console import Messages
from vehest.run.failures import failure_of
from vehest.run.printing import TerminalTable, emit
from vehest.run.runner import Runner

HOSTILE = "a\x1b]0;owned\x07\x9b31m\u202e[bold]b[/] :car:"


def _shows_only_text(text):
    return all(character == "\n" or is_printable(character) for character in text)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ("trian",),
            "no such command 'trian'; did you mean 'train'? 'vehest --help' lists commands and "
            "options",
        ),
        (("train", "--nope"), "'vehest train --help' lists commands and options"),
        (("estimate",), "missing argument 'MODEL|FILE'; 'vehest estimate --help'"),
        (("run", "small", "--jobs", "0"), "invalid value for '--jobs'"),
        (("train", "--seed", "3"), "written without dashes: seed=…"),
        (("train", "jobs=3"), "an option is written --jobs"),
        (("run", "small", "dry_run=true"), "an option is written --dry-run"),
        (("config", "estimate", "model=mine"), "vehest estimate takes the model before the file"),
        (("train", "ksnn"), "write key=value"),
        (("config", "trian"), "is not one of: ingest, downsample, train, eval, estimate"),
        (("data", "show", "no\x1b[31m\u202efile"), r"no\x1b[31m\u202efile"),
        (("sweep", "split=mine", "limits=5", "--dry-run"), ""),
        (("sweep", "split=mine", "limits.jobs=1,2", "--dry-run"), ""),
        (("sweep", "split=mine", "seed=range(6)", "limits.jobs=5", "--dry-run"), ""),
        (
            (
                "sweep",
                "split=mine",
                "seed=range(200)",
                "training.patience=range(1,100)",
                "--dry-run",
            ),
            ("19800 jobs", "limits.jobs=NUMBER"),
        ),
        (("new", "car", "raw/one.csv", "--weelbase", "2"), "--weelbase; did you mean --wheelbase?"),
        (("run", "small", "--minute", "5"), "no such option: --minute; did you mean --minutes?"),
        (("new", "car", "raw/one.csv", "--wheelbase", "2,4"), "with a decimal point (2.4)"),
        *(
            (("sweep", "split=mine", f"seed={value}", "--dry-run"), words)
            for value, words in (
                ("range(100000000)", "for at least 10001 jobs, more than the limit of 10000"),
                ("range(0,1e300,1e-300)", "more than the limit"),
                ("range(0,5,0)", "cannot be read"),
                ("range(1,inf)", "more than the limit"),
                ("range(0)", "stands for no value"),
                ("interval(0,1)", "cannot be read"),
                ("glob(*)", "stands for no value"),
                ("9" * 5000, "cannot be read"),
            )
        ),
    ],
    ids=lambda case: str(case)[:50],
)
def test_wrong_usage_is_a_single_line_with_the_next_step(place, arguments, words):
    assert _shows_only_text(place.refused(*arguments, code=2, says=words)[1])


@pytest.mark.parametrize("command", [("new", "car"), ("estimate",)])
def test_mistyped_name_of_a_file_is_answered_with_the_close_one(place, command):
    place.refused(*command, "raw/one.cvs", code=4, says="did you mean 'raw/one.csv'?")


def test_hostile_names_reach_the_terminal_as_text(place):
    place.change(
        "conf/dataset/mine.yaml",
        **dict.fromkeys(("title", "licence", "citation", "vehicle"), HOSTILE),
    )
    (place.folder / "raw" / "one.csv").rename(
        place.folder / "raw" / f"{HOSTILE.replace('/', '')}.csv"
    )
    table = pd.read_csv(place.folder / "raw" / "two.csv").rename(columns={"Yaw": HOSTILE})
    table.to_csv(place.folder / "raw" / "two.csv", index=False)
    good = "dataset.files='[!t]*.csv'"
    for arguments in (
        ("data", "show", "mine", good),
        ("data", "check", "mine"),
        ("config", "ingest", "dataset=mine"),
        ("ingest", "mine"),
    ):
        code, out, err = place(*arguments)
        assert "defect" not in err
        assert _shows_only_text(out + err), arguments
        assert arguments[0] == "config" or r"a\x1b]0;owned\x07\x9b31m\u202e[bold]b[" in out + err
    assert code == 3, "no column 'Yaw'"


def test_json_yaml_and_tables_show_only_text_and_help_and_version_answer_as_before(place, capsys):
    hostile = HOSTILE + "\x7f\u2028\U000e0041β"
    override = f"output='{hostile}'"
    for arguments, read in ((("--json",), json.loads), ((), yaml.safe_load)):
        out, _ = place.done("config", "train", override, *arguments)
        assert _shows_only_text(out)
        assert read(out)["output"] == hostile
    assert "β" in as_yaml({"name": "β"})
    emit(
        False,
        None,
        [TerminalTable(["[bold]name[/]", HOSTILE], [["[/]", ":car:"], ["x\\", HOSTILE]])],
    )
    out = capsys.readouterr().out
    assert _shows_only_text(out)
    assert "[bold]name[/]" in out
    assert printable(HOSTILE) in out
    assert ":car:" in out
    assert "Usage" in place("train", "--help")[1]
    assert place("--version")[:2] == (0, "vehest 0.1.0\n")
    code, out, err = place("data")
    assert (code, err, "channels" in out) == (2, "", True)


@pytest.mark.parametrize("terminal", [False, True])
def test_lines_and_bars_of_progress_read_no_markup_and_no_escapes(terminal):
    messages = Messages()
    stream = io.StringIO()
    messages.console = type(messages.console)(
        file=stream,
        force_terminal=terminal,
        color_system=None,
        soft_wrap=True,
        width=200,
        highlight=False,
    )
    messages.line("done", "train", HOSTILE + "\\", HOSTILE)
    messages.warn(f"first\n{HOSTILE}")
    with messages.bars() as bars:
        bars.step(HOSTILE, 1, 2, HOSTILE)
    text = stream.getvalue()
    hostile = printable(HOSTILE)
    assert text.startswith(f"done    train      {hostile}\\ {hostile}")
    assert f"warning first\n{hostile}" in text
    assert not {"\x07", "\x9b", "\u202e"} & set(text)
    assert "\x1b]" not in text
    assert terminal == (f"{hostile} " in text.split("warning", 1)[1].split(hostile, 1)[1])


def running_timers():
    return [thread for thread in threading.enumerate() if isinstance(thread, threading.Timer)]


def test_a_stage_gets_a_line_once_it_has_been_silent_for_long(monkeypatch):
    monkeypatch.setattr(console, "MAX_SILENT_SECONDS", 0.0)
    messages = Messages()
    stream = io.StringIO()
    messages.console = type(messages.console)(file=stream, soft_wrap=True, width=200)
    messages.begin("ingest", "long")
    for timer in running_timers():
        timer.join()
    monkeypatch.setattr(console, "MAX_SILENT_SECONDS", 600.0)
    messages.begin("train", "short")
    messages.begin("report", "stopped")
    timers = running_timers()
    assert len(timers) == 2
    messages.end("train", "short")
    messages.close()
    for timer in timers:
        timer.join(60.0)  # ends at once, as it was cancelled
        assert not timer.is_alive()
    assert stream.getvalue() == "running ingest     long\n"
    assert messages.printed == []


@pytest.fixture
def events(monkeypatch):
    """Which stages were announced and ended."""
    announced = []
    for name in ("begin", "end"):
        monkeypatch.setattr(
            Messages, name, lambda _, *stage, name=name: announced.append((name, *stage))
        )
    return announced


def test_planning_of_a_study_is_announced_and_ends_before_its_trainings(place, monkeypatch, events):
    monkeypatch.setattr(Runner, "run", lambda *_: events.append(("trainings",)) or ({}, {}))
    place("run", "small", "tracking=none")
    assert events[0] == ("begin", "plan", "small")
    assert events.index(("end", "plan", "small")) < events.index(("trainings",))


def test_reading_of_logs_is_announced(place, events):
    place("new", "other", "raw/one.csv", "raw/two.csv", "--yes")
    stage = ("inspect", "one.csv, two.csv")
    assert events == [("begin", *stage), ("end", *stage)]


def test_every_stage_of_a_training_is_announced_and_ended(place, events):
    place("train", "estimator=luenberger", "split=mine", "training.grid=1", "tracking=none")
    begun = [stage for kind, *stage in events if kind == "begin"]
    assert [stage for stage, _ in begun] == ["ingest", "downsample", "train"]
    assert begun[-1] == ["train", "luenberger-luenberger seed 0"]
    assert all(["end", *stage] in map(list, events) for stage in begun)


def test_files_whose_names_are_not_utf_8_are_read_and_written(place):
    drive = planar_drive(20.0, 100.0).without_references()
    drive.to_pandas().to_csv("lap.csv")
    lap = os.fsdecode(b"lap\xff.csv")
    Path("lap.csv").rename(lap)
    assert place("data", "check", lap)[:2] == (0, "no findings\n")
    code, out, err = place("data", "show", lap, "--json")
    assert code == 0, err
    out.encode("utf-8")
    assert json.loads(out)["recordings"][0]["id"] == os.fsdecode(b"lap\xff")
    assert r"lap\udcff: real" in place("data", "show", lap)[1]
    assert (
        place(
            "train",
            "estimator=luenberger",
            "split=mine",
            "training.grid=1",
            "training.max_evaluations=5",
            "tracking=none",
        )[0]
        == 0
    )
    for name in (b"out\xfe.parquet", b"out\xfe.csv"):
        assert place.told("estimate", "luenberger", lap, "-o", os.fsdecode(name))[
            "out"
        ] == os.fsdecode(name)
        assert name in os.listdir(b".")
    code, line = place.refused("data", "show", os.fsdecode(b"other\xff.csv"))
    assert (code, r"there is no file 'other\udcff.csv'" in line) == (4, True)


def test_recordings_with_names_that_are_not_utf_8_complete_a_study(place):
    name = os.fsdecode(b"one\xff")
    (place.folder / "raw" / "one.csv").rename(place.folder / "raw" / f"{name}.csv")
    place.change(
        "conf/split/mine.yaml",
        train=[{"recording": "three"}],
        tests={"test": [{"recording": name}]},
    )
    sweeps = [["estimator=luenberger", "training.grid=1", "training.max_evaluations=5"]]
    hostile = {
        "title": "T <script>alert(1)</script>",
        "about": "<img src=x onerror=alert(1)> [x](javascript:alert(1))",
    }
    place.change("pipelines/small.yaml", sweeps=sweeps, **hostile)
    report = Path(place.told("run", "small", "tracking=none")["report"])
    assert r"recording one\\udcff" in report.with_suffix(".md").read_text(encoding="utf-8")
    for text in (
        report.read_text(encoding="utf-8"),
        report.with_suffix(".md").read_text(encoding="utf-8"),
    ):
        assert "T &lt;script" in text
        assert not any(
            words in text for words in ("<script>alert", "<img src=x", 'href="javascript')
        )
    assert "[x](javascript" not in report.with_suffix(".md").read_text(encoding="utf-8")
    assert r"one\udcff" in (report.parent / "tables" / "ranges.csv").read_text(encoding="utf-8")


def test_limit_of_jobs_counts_expanded_ranges(place):
    for text in (
        "range(7)",
        "range(2,9,3)",
        "range(9,2,-3)",
        "range(0,1,0.1)",
        "range(5,1,-0.25)",
        "1,2,3",
        "choice(a,b)",
        "glob(k*)",
    ):
        key = "estimator" if "glob" in text else "seed"
        assert (
            count([f"{key}={text}", "training.patience=1,2"])
            == len(expand([f"{key}={text}", "training.patience=1,2"]))
            > 0
        )
    assert place("sweep", "split=mine", "seed=range(6)", "limits.jobs=6", "--dry-run")[0] == 0
    assert limits_of(["limits.jobs=12345", "seed=3"]).jobs == 12345
    place.refused(
        "run",
        "small",
        "limits.jobs=3",
        "--dry-run",
        code=2,
        says="small.yaml' stand for at least 4 jobs",
    )
    assert place("run", "small", "limits.jobs=4", "--dry-run")[0] == 0
    with (
        use_limits(Limits(jobs=3)),
        pytest.raises(ConfigurationError, match="stand for at least 4 jobs"),
    ):
        expand(["seed=range(4)"])


def test_unreadable_overrides_are_a_single_line_and_long_valid_ones_are_read():
    for override, words in (
        ("training.x=" + "[" * 2_000 + "]" * 2_000, "cannot be read"),
        ("output='a\0b'", "output must name a folder"),
        ("~limits", "only keys inside a group"),
        ("seed=range(0,1,0)", "names several values"),
    ):
        with pytest.raises(ConfigurationError, match=words):
            compose_config("train", [override])
    ranges = ", ".join(f"{{recording: one, start: {k}.5, stop: {k + 1}}}" for k in range(100))
    assert len(compose_config("train", [f"split.train=[{ranges}]"])["split"]["train"]) == 100
    assert compose_config("train", ["output='[((a, {b'"])["output"] == "[((a, {b"


@contextmanager
def _small_disk(size):
    """Files of this process may not grow beyond a size [bytes]: every larger write fails as on a
    full disk.
    """
    former = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, former[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, former)


@pytest.mark.apart
def test_a_full_disk_names_its_target_in_every_stage_and_leaves_nothing(place):
    trained = (
        "estimator=luenberger",
        "split=mine",
        "training.grid=1",
        "training.max_evaluations=5",
        "tracking=none",
    )
    place.change("pipelines/small.yaml", sweeps=[[trained[0], *trained[2:4]]])
    drive = planar_drive(30.0, 100.0)
    drive.to_pandas().to_csv("lap.csv")
    stages = (
        (10_000, "ingest", ("ingest", "mine")),
        *((10_000, "downsample", ("downsample", "mine", f"rate_hz={rate}")) for rate in (100, 20)),
        (400, "train", ("train", *trained)),
        (3_000, "evaluate", ("eval", *trained)),
        (3_000, "out.parquet", ("estimate", "luenberger", "lap.csv", "-o", "out.parquet")),
        (3_000, "out.csv", ("estimate", "luenberger", "lap.csv", "-o", "out.csv")),
        (1_000, "aligned", ("data", "align", "lap.csv", "-e", "offsets", "-o", "aligned")),
        (30_000, "outputs/report/small", ("run", "small", "tracking=none")),
    )
    for _, _, command in stages:  # what is compiled is cached in files, too
        assert place(*command)[0] == 0
    for folder in ("outputs", "aligned"):
        shutil.rmtree(folder)
    for folder in ("out.parquet", "out.csv"):
        Path(folder).unlink()
    for size, target, command in stages:
        before = place.files() | set(os.listdir())
        with _small_disk(size):
            code, _, err = place(*command)
        line = err.splitlines()[-1]
        assert code == 4, line
        assert line.startswith("error: no room left to write '"), line
        assert target in line
        assert (place.files() | set(os.listdir()), place(*command)[0]) == (before | {"outputs"}, 0)


@pytest.mark.parametrize(
    "error",
    [
        *(OSError(code, os.strerror(code)) for code in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)),
        SafetensorError(
            'Error while serializing: IoError(Os { code: 28, kind: StorageFull, message: "No '
            'space left on device" })'
        ),
        sqlite3.OperationalError("database or disk is full"),
        RuntimeError("wrapped: No space left on device (os error 28)"),
        ValueError("no space"),
    ],
)
def test_full_disks_are_identified_under_every_library_error(tmp_path, error):
    full = not isinstance(error, ValueError)
    message = f"no room left to write '{tmp_path / 'target'}'" if full else "no space"

    def break_off():
        with written_aside(tmp_path / "target") as aside:
            aside.write_text("half")
            raise error

    with pytest.raises(MissingError if full else ValueError, match=message):
        break_off()
    assert (
        list(tmp_path.iterdir()),
        failure_of(error).exit_code == 4,
        no_room(error) is not None,
    ) == ([], full, full)


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (MemoryError(), 4, "out of memory; close other programs, or ask for less at a time"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"), 4, "out of memory"),
        (
            RecursionError("maximum recursion depth exceeded"),
            1,
            "nests too deeply: make it flatter",
        ),
        (OSError(errno.ENOSPC, "No space left on device"), 4, "no room left"),
        (
            PermissionError(errno.EACCES, "Permission denied", "/some/file"),
            4,
            "'/some/file' cannot be used: Permission denied",
        ),
        (KeyError("x\x1b[31m"), 1, "this is a defect of vehest (KeyError: 'x"),
        (ValueError("x" * 100_000), 1, "…"),
    ],
)
def test_internal_errors_are_a_single_line(place, monkeypatch, error, code, words):
    def fail():
        raise error

    monkeypatch.setattr("vehest.run.doctor.examine", fail)
    line = place.refused("doctor", code=code, says=words)[1]
    assert _shows_only_text(line)
    assert len(line) < 5_000


def _shell(place, script, **environment):
    command = f"vehest() {{ '{sys.executable}' -m vehest \"$@\"; }}\n{script}"
    inherited = {
        name: value
        for name, value in os.environ.items()
        if name not in ("HOME", "LANG", "LC_ALL", "TERM", "PYTHONIOENCODING")
    }
    options = {
        "cwd": place.folder,
        "env": {**inherited, **environment},
        "stdin": subprocess.DEVNULL,
    }
    return subprocess.run(
        ["bash", "-c", command], capture_output=True, text=True, timeout=300, **options
    )


@pytest.mark.parametrize(
    ("script", "code", "out", "err"),
    [
        ("vehest data channels >&-", 0, "", ""),
        ("vehest data channels <&- >&- 2>&-", 0, "", ""),
        (
            "vehest data channels --json >/dev/full",
            4,
            "",
            "error: cannot write to standard output (No space left on device)\n",
        ),
        ("{ vehest data channels; echo $? >&2; } | true", 0, "", "141\n"),
        ("mkdir gone; cd gone; rmdir ../gone; vehest data channels >/dev/null", 0, "", ""),
        (
            "mkdir gone; cd gone; rmdir ../gone; vehest config train",
            4,
            "",
            "error: the working folder has been removed; change to another\n",
        ),
    ],
)
def test_broken_streams_and_odd_folders_end_in_words(place, script, code, out, err):
    result = _shell(place, script)
    assert (result.returncode, result.stdout, result.stderr) == (code, out, err)


def test_no_home_no_terminal_and_no_utf_8_still_show_everything(place):
    bare = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    plain, table = (
        _shell(place, f"vehest data channels {words}", **bare) for words in ("--json", "")
    )
    assert [(process.returncode, process.stderr) for process in (plain, table)] == [(0, "")] * 2
    assert plain.stdout.isascii()
    assert json.loads(plain.stdout) == place.told("data", "channels")
    assert "m/s²" in table.stdout
    place.refused(
        "ingest", "mine", "output=/proc/nothing", code=4, says="cannot write '/proc/nothing"
    )
