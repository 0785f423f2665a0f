"""`vehest new --yes`, then `vehest run --minutes 5`, on the ten logs of front_door_logs.py, held
against front_door.yaml, a line each.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import yaml
from dressed_logs import write_log
from front_door_logs import LOGS

EXPECTED = Path(__file__).parent / "front_door.yaml"


def vehest(folder, *words):
    """Exit code, standard output and error of a command in a folder."""
    ran = subprocess.run(
        [sys.executable, "-m", "vehest", *words],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    return ran.returncode, ran.stdout, ran.stderr


def differences(expected, code, plain, words):
    """What `vehest new` did otherwise than expected."""
    if code:
        return (
            [] if expected["end"] == "stop" else [f"exit {code}: {words.strip().splitlines()[-1]}"]
        )
    proposed_columns = {channel["channel"]: channel["column"] for channel in plain["channels"]}
    wrong = [
        f"{channel} is {proposed_columns.get(channel)}, not {column}"
        for channel, column in expected["channels"].items()
        if proposed_columns.get(channel) != column
    ]
    wrong += [
        f"nothing is asked about {question_key}"
        for question_key in expected.get("asked", ())
        if question_key not in {question["key"] for question in plain["open"]}
    ]
    evidence = [text for channel in plain["channels"] for text in channel["evidence"]]
    messages = " ".join([words, *plain["notes"], *plain["limits"], *plain["findings"], *evidence])
    return wrong + (
        [f"'{expected['note']}' is not said"] if expected.get("note", "") not in messages else []
    )


def tried(name, data, folder, minutes):
    """Differences from what is expected, and how the way ended."""
    expected = yaml.safe_load(EXPECTED.read_text(encoding="utf-8"))[name]
    files = [str(file) for file in write_log(name, data, folder, LOGS)]
    code, out, err = vehest(folder, "new", name, *files, "--yes", "--json")
    plain = json.loads(out) if out.strip().startswith("{") else {}
    wrong = differences(expected, code, plain, err)
    if code or not plain.get("estimators"):
        end = err.strip().splitlines()[-1] if code else "; ".join(plain["limits"])
        return wrong + ([f"ended with: {end}"] if expected["end"] == "verdict" else []), end
    if not minutes:
        return wrong, "not run"
    code, out, err = vehest(
        folder, "run", name, "--minutes", f"{minutes:g}", "tracking=none", "--quiet"
    )
    lines = [line for line in out.splitlines() if line.strip()]
    end = " ".join(lines[-6:]) if code == 0 else (err.strip().splitlines() or ["nothing"])[-1]
    return wrong + ([f"exit {code}"] if (code != 0) == (expected["end"] == "verdict") else []), end


def main(words=None):
    """Try the logs that are named, or all; 1 where one came out otherwise than expected."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(LOGS))
    parser.add_argument("--minutes", type=float, default=5.0, help="of vehest run; 0: not run")
    parser.add_argument("--data", type=Path, default=os.environ.get("VEHEST_DATA"))
    options = parser.parse_args(words)
    failed = 0
    for name in options.names:
        with tempfile.TemporaryDirectory() as folder:
            wrong, end = tried(name, options.data, Path(folder), options.minutes)
        failed += bool(wrong)
        print(f"{name}: {'; '.join(wrong) or 'as expected'}\n    {end[:600]}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
