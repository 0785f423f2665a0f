"""Press Ctrl-C at random moments of a study's first seconds, while its workers start, and see that
every run ends: `make interrupts`.

The signal goes to the whole process group, as that of a terminal does, and in every other run a
second time while the run ends. All runs share an output root, so that each goes on from what the
one before has finished; once a run ends before its signal, its trainings and what follows are
removed. The last run is not interrupted, and its artefacts must have the digests of a run in an
output root of its own.
"""

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

from kills import STUDY, broken, busy_locks, content, strays
from processes import end_all, start

SECONDS = 5.0  # after the start of a run, up to which it is interrupted
HANGS = 120.0  # s after its signal from which a run counts as hanging
MAX_SECOND_DELAY = 0.5  # s between two signals
LAST_LINE = "error: stopped by SIGINT; finished artefacts are kept, the same command goes on"
INTERRUPTED = 130
UNTIL_VEHEST = 0.3  # s within which Python may not yet run the first line of vehest
REMADE = ("train", "calibrate", "evaluate", "report", "checkpoints", "finished")


def interrupted(output, delay, second_delay=None):
    """Interrupt a run after ``delay`` seconds, and again after ``second_delay``: its exit code, and
    what was wrong.

    The code is None where it hung.
    """
    log = output.with_suffix(".log")
    with open(log, "wb") as stream:
        process = start(
            [sys.executable, "-m", "vehest", *STUDY, f"output={output}", "--jobs", 2],
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=stream,
        )
    try:
        return process.wait(delay), []
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGINT)
    begun = time.monotonic()
    try:
        if second_delay is not None:
            with suppress(subprocess.TimeoutExpired):
                process.wait(second_delay)
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGINT)
        code = process.wait(HANGS)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        return None, [f"hangs, see '{log}'"]
    faults = strays(process.pid) + busy_locks(output) + broken(output)
    output_lines = log.read_text(encoding="utf-8").splitlines()
    has_begun = delay > UNTIL_VEHEST or any("vehest" in line for line in output_lines)
    if has_begun and code not in (0, INTERRUPTED):
        faults.append(f"exit code {code}: {output_lines[-1:]}")
    if has_begun and any(
        line.startswith(("Traceback", "Exception ignored")) for line in output_lines
    ):
        faults.append("it prints a traceback")
    errors = [line for line in output_lines if line.startswith("error: ")]
    if errors not in ([], [LAST_LINE]):
        faults.append(f"it says {errors}")
    again = "" if second_delay is None else f" and {second_delay:.3f} s"
    moment = f"{delay:.3f} s{again}"
    seconds = time.monotonic() - begun
    print(f"{moment}: exit code {code} after {seconds:.2f} s, says {output_lines[-1:]}", flush=True)
    return code, [f"{moment}: {fault}" for fault in faults]


def main():
    """Exit code 1 if any run hangs or leaves something behind."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--interrupts", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="within which they lie")
    parser.add_argument("--output", type=Path, help="an output root to copy, with its recordings")
    options = parser.parse_args()
    os.environ |= {"MLFLOW_DISABLE_TELEMETRY": "true", "DO_NOT_TRACK": "true", "MPLBACKEND": "agg"}
    signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # which a shell's background job ignores
    draw = random.Random(options.seed)
    codes = Counter()
    faults = []
    with tempfile.TemporaryDirectory(prefix="interrupts-") as scratch:
        source = options.output and options.output.resolve()
        os.chdir(scratch)
        output = Path(scratch) / "root"
        if source:
            shutil.copytree(source, output)
        output.mkdir(exist_ok=True)
        try:
            while codes.total() < options.interrupts:
                second = draw.uniform(0.0, MAX_SECOND_DELAY) if codes.total() % 2 else None
                code, wrong = interrupted(output, draw.uniform(0.0, options.seconds), second)
                faults += wrong
                if code == 0:
                    for folder in REMADE:
                        shutil.rmtree(output / folder, ignore_errors=True)
                else:
                    codes[code] += 1
            last, wrong = interrupted(output, 1800.0)
            faults += wrong + ([] if last == 0 else [f"the last run left with {last}"])
            digests = content(output)
            reference = Path(scratch) / "reference"
            interrupted(reference, 1800.0)
            equal = digests == content(reference)
            faults += [] if equal else ["the last run has other digests than one by itself"]
            print(f"last run: exit code {last}, {len(digests)} digests, equal: {equal}")
        finally:
            end_all()
    print(f"{codes.total()} interrupts, exit codes {dict(codes)}; {len(faults)} faults")
    print("\n".join(faults))
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
