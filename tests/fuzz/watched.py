"""The forked child: limits, an audit hook, and the command line run as the terminal would run it.

The reading processes that it starts.
"""

import faulthandler
import json
import os
import resource
import signal
import sys
import tempfile
import traceback
import types
from pathlib import Path

import vehest
from processes import die_with_parent, status_kb

ADDRESS_SPACE = 4 * 2**30
FILE_SIZE = 2**30
STACK_SIGNAL = signal.SIGUSR1
"""Signal at which the child writes its stack to the case's log."""

# What runs, and what asks for code to be run. Each is noted; a program that would start is stopped.
PROGRAMS = {
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.spawn",
    "os.startfile",
    "os.fork",
    "os.forkpty",
    "pty.spawn",
    "subprocess.Popen",
}
CODE = frozenset(
    {"exec", "compile", "import", "ctypes.dlopen", "pickle.find_class", "marshal.loads"}
)
# Position of the path that each of these writes to.
WRITES = {
    f"os.{name}": (0,)
    for name in ("mkdir", "remove", "rmdir", "truncate", "chmod", "chown", "utime", "mkfifo")
}
WRITES |= {"shutil.rmtree": (0,), "os.rename": (0, 1), "os.link": (1,), "os.symlink": (1,)}
DEVICES = ("/dev/null", "/dev/full", "/dev/zero", "/dev/tty", "/dev/shm/")
NO_PLACES = (
    "/dev/null/",
    "/dev/full/",
    "/proc/",
)  # where nothing can be made, though a user may ask for it

# Modules whose own work makes code: fields of dataclasses and named tuples, compiled kernels,
# syntax trees; annotations of the commands' own functions, which inspect and typing evaluate for
# Typer; SQLAlchemy, which makes constructors of its own classes where MLflow migrates a store; and
# rosbags, which makes dataclasses and readers of message layouts whose names its grammar has let
# through. Whatever a payload would do is noticed as well: the file that it makes, or the program.
MAKERS = ("dataclasses", "collections", "inspect", "typing", "numba.", "llvmlite.", "ast")
MAKERS += ("rosbags.typesys.store", "rosbags.serde.", "sqlalchemy.util.langhelpers")
PAGES = str(Path(vehest.__file__).parent / "report" / "templates")
READER = "vehest.sources.limited"
"""The module that a command may run in a process of its own, to read one file."""
IMPORTERS = (
    "importlib._bootstrap",
    "importlib._bootstrap_external",
    "_frozen_importlib",
    "_frozen_importlib_external",
)


class Watch:
    """Notes, a line of JSON each, what a command does that no input should make it do: it may write
    inside the case's folder alone.

    A reading process imports what it needs and runs nothing but code of installed files.
    """

    def __init__(self, inside, report, *, reads=False):
        self._inside = os.path.realpath(inside)
        self._report = report
        self._reads = reads
        self._armed = False
        self._noted = 0

    def arm(self):
        """Begin; there is no end but that of the process."""
        sys.addaudithook(self._hook)
        self._armed = True

    def _hook(self, event, arguments):
        """Audit hook: called at each event that Python audits."""
        if not self._armed:
            return
        if event == "open":
            self._opened(*arguments)
        elif event in CODE:
            self._code(event, arguments)
        elif event in WRITES:
            for position in WRITES[event]:
                self._written(event, arguments[position])
        elif event in PROGRAMS:
            self._program(event, arguments)
        elif event in ("socket.connect", "socket.sendto"):
            self._armed = False
            family = getattr(arguments[0], "family", None)
            self._armed = True
            if family is not None and int(family) != 1:
                raise OSError(101, "the network is out of reach here")

    def _code(self, event, arguments):
        """Note that code of a file would be executed."""
        try:
            caller = sys._getframe(2)
        except ValueError:  # the interpreter itself, at its start
            return
        module = str(caller.f_globals.get("__name__", "?"))
        if event == "import":
            if not self._reads:
                self._imported(str(arguments[0]))
            return
        if self._reads and (event == "ctypes.dlopen" or _called_from(caller, IMPORTERS)):
            return
        if event in ("exec", "marshal.loads", "compile") and (
            module in IMPORTERS or module.startswith(MAKERS)
        ):
            return
        if event == "pickle.find_class" and _called_from(
            caller, ("multiprocessing.", "concurrent.futures.")
        ):
            return
        subject = arguments[1] if event == "compile" else arguments[0]
        code = getattr(subject, "co_filename", None) or subject
        if (
            self._reads
            and event == "exec"
            and os.path.isabs(str(code))
            and not str(code).startswith(self._inside + os.sep)
        ):
            return
        if module == "jinja2.environment" and str(code).startswith(PAGES):
            return
        self._note("executed", f"{event} of {str(code)[:80]!r} by {module}:{caller.f_lineno}")

    def _imported(self, name):
        """Note an import that no command needs."""
        if name not in sys.modules and not name.startswith(HARMLESS_IMPORTS):
            self._note("executed", f"import of {name[:80]!r}")

    def _program(self, event, arguments):
        """Note that a program would be started."""
        if event == "os.fork" or _called_from(sys._getframe(2), ("multiprocessing.",)):
            return
        if event == "subprocess.Popen" and [*arguments[1]][:1] + [*arguments[1]][-2:] == [
            sys.executable,
            "-m",
            READER,
        ]:
            return
        self._note("executed", f"{event} {str(arguments)[:120]}")
        raise PermissionError(1, "no program is started here")

    def _opened(self, path, mode, flags):
        """Note that a file is opened for writing."""
        writes = isinstance(flags, int) and flags & (
            os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
        )
        if writes or (isinstance(mode, str) and set(mode) & set("wax+")):
            self._written("open", path)

    def _written(self, event, path):
        """Note a path that is written to outside the allowed folders."""
        if not isinstance(path, str | bytes):
            return
        self._armed = False
        try:
            real = os.path.realpath(os.fsdecode(path))
        except (OSError, ValueError):
            return
        finally:
            self._armed = True
        kernels = real.endswith((".nbi", ".nbc")) or "__pycache__" in real
        device = (event == "open" and real.startswith(DEVICES)) or f"{real}/".startswith(NO_PLACES)
        if not (
            real == self._inside or real.startswith(self._inside + os.sep) or device or kernels
        ):
            self._note("outside", f"{event} {real[:160]}")
            raise PermissionError(1, "this is outside of the sandbox", real)

    def _note(self, verdict, subject):
        """Report a verdict, at most twenty."""
        if self._noted < 20:
            self._noted += 1
            os.write(self._report, (json.dumps([verdict, subject]) + "\n").encode())


HARMLESS_IMPORTS = ("pyspark",)
"""Starts of names of modules that honest commands look for anew each time, since they are not
installed.
"""


def _called_from(frame, modules):
    """Whether any caller, up to the command itself, belongs to these modules."""
    while frame is not None and frame.f_globals.get("__name__") != __name__:
        if str(frame.f_globals.get("__name__", "")).startswith(modules):
            return True
        frame = frame.f_back
    return False


def become(case, command):
    """Turn this forked process into the command; does not return."""
    code = 1
    try:
        os.setsid()
        die_with_parent()
        report = _prepare(case, command)
        main = _main_of(sys.argv[1:])
        watch = Watch(case.folder, report)
        watch.arm()
        code = _run(main)
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def watch_reader():
    """Watch this reading process as its command is watched.

    Events go through a pipe, since it may write to no file.
    """
    folder = Path(os.environ["FUZZ_CASE"])
    report = os.open(folder / "log" / "reader", os.O_WRONLY | os.O_NONBLOCK)
    Watch(folder, report, reads=True).arm()


def _main_of(words):
    """The command line; or a planted misdeed, which shows that it is noticed."""
    if words and words[0].startswith("PLANTED:"):
        from fuzz.families.planted import MISDEEDS

        return MISDEEDS[words[0].removeprefix("PLANTED:")][1]
    from vehest.cli import main

    return main


def _run(main):
    """Exit code of a main function, as the interpreter would make it."""
    code = 0
    try:
        main()
    except SystemExit as leave:
        if isinstance(leave.code, str):
            sys.stderr.write(leave.code + "\n")
            code = 1
        else:
            code = int(leave.code or 0)
    except BaseException:
        traceback.print_exc()
        code = 1
    try:
        sys.stdout.flush()
    except (OSError, ValueError) as error:
        os.write(2, f"Exception ignored in stdout: {error}\n".encode())
        code = code or 120
    sys.stderr.flush()
    return code & 0xFF


def _prepare(case, command):
    """Streams, folders, environment, limits; returns the descriptor of the report."""
    logs = case.folder / "log"
    report = os.open(logs / "events", os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    # open as long as the process lives, like the streams below; the thread that gets the signal
    # writes its own stack, since a watchdog that reads another thread's frames may crash
    stack = open(logs / "stack", "w")  # noqa: SIM115
    faulthandler.register(STACK_SIGNAL, file=stack, all_threads=False)
    _redirect(0, "/dev/null", os.O_RDONLY)
    _redirect(1, logs / "stdout", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    _redirect(2, logs / "stderr", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = open(  # noqa: SIM115
        2, "w", encoding="utf-8", errors="backslashreplace", closefd=False, buffering=1
    )
    os.chdir(case.place)
    _environment(case)
    tempfile.tempdir = str(case.folder / "tmp")
    sys.modules["__main__"] = types.ModuleType(
        "__main__"
    )  # the name of the program follows from it: vehest, not python -m fuzz
    sys.argv = ["vehest", *(os.fsdecode(word) for word in command.argv)]
    sys.path[:] = [
        str(Path(__file__).parent / "reader"),
        *(entry for entry in sys.path if entry not in ("", ".")),
    ]
    os.write(report, (json.dumps(["rss", status_kb("VmRSS")]) + "\n").encode())
    size = status_kb("VmSize") * 1024 + ADDRESS_SPACE
    for limit, value in {"AS": size, "CPU": 90, "FSIZE": FILE_SIZE, "CORE": 0}.items():
        resource.setrlimit(getattr(resource, f"RLIMIT_{limit}"), (value, value))
    return report


def _environment(case):
    """Set the environment of the command."""
    for name in [
        name for name in os.environ if name.startswith(("VEHEST_", "MLFLOW_", "_VEHEST", "COMP_"))
    ]:
        del os.environ[name]
    os.environ |= {"FUZZ_CASE": str(case.folder), "PYTHONDONTWRITEBYTECODE": "1"}
    os.environ |= {
        "VEHEST_DATA": str(case.place / "raw"),
        "HOME": str(case.folder / "home"),
        "TMPDIR": str(case.folder / "tmp"),
    }


def _redirect(descriptor, path, flags):
    """Replace an open file of the process by the file at a path."""
    opened = os.open(path, flags, 0o666)
    os.dup2(opened, descriptor)
    os.close(opened)
