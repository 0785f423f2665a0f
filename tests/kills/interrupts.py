"""Press Ctrl-C at random moments of a study's first seconds, while its workers start, and see that every run ends: `make interrupts`.

The signal goes to the whole process group, as that of a terminal does. All runs share an output root, so that each goes on from what
the one before has finished; once a run ends before its signal, its trainings and what follows are removed. The last run is not
interrupted.
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
from pathlib import Path

from kills import STUDY, broken, locks_held, strays
from processes import end_all, start

SECONDS = 5.0  # after the start of a run, up to which it is interrupted
HANGS = 120.0  # s after its signal from which a run counts as hanging
LAST_LINES = (
    "error: stopped by SIGINT; finished artefacts are kept, the same command goes on",
    "error: stopped",
)
INTERRUPTED = 130
DEFAULT_ACTION = -signal.SIGINT  # before Python runs the first line of vehest
REMADE = ("train", "calibrate", "evaluate", "report", "checkpoints", "finished")


def interrupted(output, delay):
    """Interrupt a run after ``delay`` seconds: its exit code, and what was wrong; the code is None where it hung."""
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
        code = process.wait(HANGS)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        return None, [f"hangs, see '{log}'"]
    faults = strays(process.pid) + locks_held(output) + broken(output)
    said = log.read_text(encoding="utf-8").splitlines()
    if code == INTERRUPTED and said[-1] not in LAST_LINES:
        faults.append(f"it says '{said[-1]}'")
    if code == INTERRUPTED and any(line.startswith("Traceback") for line in said):
        faults.append("it prints a traceback")
    if code not in (0, INTERRUPTED, DEFAULT_ACTION):
        faults.append(f"exit code {code}: {said[-1:]}")
    print(f"{delay:.3f} s: exit code {code} after {time.monotonic() - begun:.2f} s", flush=True)
    return code, faults


def main():
    """Exit code 1 if any run hangs or leaves something behind."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--interrupts", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="within which they lie")
    parser.add_argument("--output", type=Path, help="an output root to copy, with its recordings")
    asked = parser.parse_args()
    os.environ |= {"MLFLOW_DISABLE_TELEMETRY": "true", "DO_NOT_TRACK": "true", "MPLBACKEND": "agg"}
    signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # which a shell's background job ignores
    draw = random.Random(asked.seed)
    codes = Counter()
    faults = []
    with tempfile.TemporaryDirectory(prefix="interrupts-") as scratch:
        source = asked.output and asked.output.resolve()
        os.chdir(scratch)
        output = Path(scratch) / "root"
        if source:
            shutil.copytree(source, output)
        output.mkdir(exist_ok=True)
        try:
            while codes.total() < asked.interrupts:
                code, wrong = interrupted(output, draw.uniform(0.0, asked.seconds))
                faults += wrong
                if code == 0:
                    for folder in REMADE:
                        shutil.rmtree(output / folder, ignore_errors=True)
                else:
                    codes[code] += 1
            last, wrong = interrupted(output, 1800.0)
            faults += wrong + ([] if last == 0 else [f"the last run left with {last}"])
        finally:
            end_all()
    print(f"{codes.total()} interrupts, exit codes {dict(codes)}; {len(faults)} faults")
    print("\n".join(faults))
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
