"""`vehest new` on twelve logs in different dress, held against what was written down before: results/own_car/proposals.csv, a row a column.

``answers.yaml`` was committed before anything that proposes existed, and has not been changed since; the method was developed with these
logs at hand, and revised after their outcome was seen. How it does on logs that it was not developed with, they do not tell.
"""

import argparse
import os
import tempfile
from pathlib import Path

import pandas as pd
import yaml
from dressed_logs import LOGS, write_log

from vehest.alignment.proposals.proposal import LATERAL
from vehest.data.files import written_aside
from vehest.run.own_car.inspect import inspect
from vehest.run.own_car.questions import questions_of
from vehest.run.own_car.write import write
from vehest.run.table_records import record_tables

VERSION = "1"
"""Raised when the numbers of its tables move."""
ANSWERS = Path(__file__).parent / "answers.yaml"
COLUMNS = ("log", "column", "right answer", "proposed", "evidence", "decided/asked", "correct")
WHOLE = ("left_right", "rate", "radius")
"""What is asked of a log as a whole."""
TOLERANCE = 30.0  # ms, of a delay that was planted
LONGEST_UNPLANTED = 60.0  # ms that a channel may be late by itself


def outcome_of(files):
    """What `vehest new --json --dry-run` says of files."""
    examined = inspect("my_car", files)
    return write(examined, tuple(questions_of(examined)), dry_run=True)[0]


def rows_of(log, answers, proposed):
    """A row a column, and one for each question about the log as a whole."""
    columns = {one["column"]: one for one in proposed["channels"]}
    asked = {question["key"]: question for question in proposed["open"]}
    mirror = _mirror(answers, columns) if "left_right" in answers["asked"] else 1
    rows = [
        _row(log, name, told, columns.get(name), asked, mirror, name in answers["asked"])
        for name, told in answers["columns"].items()
    ]
    for name in (*columns, *proposed["unused"]):
        if name not in answers["columns"]:
            one = columns.get(name)
            shown, evidence = (
                (f"{one['channel']}, {one['unit']}", one["evidence"]) if one else ("no channel", [])
            )
            rows.append(
                _line(
                    log,
                    name,
                    "no channel",
                    shown,
                    evidence,
                    name in asked,
                    one is None and name not in asked,
                )
            )
    if "time" in answers:
        rows.append(_clock(log, answers["time"], proposed))
    for key in WHOLE:
        wanted = key in answers["asked"]
        told = key in asked
        if wanted or told or key == "left_right":
            evidence = asked[key]["evidence"] if told else [proposed["left_right"] or ""]
            shown = str(asked[key]["proposed"]) if told else "decided"
            rows.append(
                _line(
                    log,
                    f"({key})",
                    "asked" if wanted else "decided",
                    shown,
                    evidence,
                    told,
                    wanted == told,
                )
            )
    return rows


def _mirror(answers, columns):
    """1, or -1 where all signs are reversed, by the yaw rate's column."""
    name, told = next(
        (name, told) for name, told in answers["columns"].items() if told["channel"] == "yaw_rate"
    )
    return int(told["sign"] * columns[name]["sign"]) if name in columns else 1


def _row(log, name, told, one, asked, mirror, undecidable):
    right = f"{told['channel']}, {told['unit']}, sign {told['sign']:+d}" + (
        f", {told['delay']} ms late" if "delay" in told else ""
    )
    if one is None:
        return _line(log, name, right, "no channel", [], False, False)
    delay = 1000.0 * one["delay"]
    shown = f"{one['channel']}, {one['unit']}, sign {one['sign']:+d}" + (
        f", {delay:.0f} ms late" if delay else ""
    )
    turned = mirror if one["channel"] in LATERAL else 1
    agrees = (
        told["channel"] in ("asked", one["channel"])
        and told["unit"] in ("asked", one["unit"])
        and told["sign"] == one["sign"] * turned
        and one["factor"] == 1.0
        and (
            abs(delay - told["delay"]) <= TOLERANCE
            if "delay" in told
            else delay < LONGEST_UNPLANTED
        )
    )
    return _line(
        log,
        name,
        right,
        shown,
        one["evidence"],
        name in asked,
        agrees and (name in asked) == undecidable,
    )


def _clock(log, told, proposed):
    """The column of times and the rate that it makes."""
    clock = proposed["time"]
    shown = (
        "none"
        if clock is None
        else f"{clock['column']}, {clock['unit']}, {proposed['rate_hz']:g} Hz"
    )
    right = "none" if told is None else f"{told['column']}, {told['unit']}, {told['rate_hz']} Hz"
    asked = any(question["key"] == "time" for question in proposed["open"])
    return _line(
        log,
        "(time)",
        right,
        shown,
        [] if clock is None else [clock["evidence"]],
        asked,
        shown == right and not asked,
    )


def _line(log, column, right, shown, evidence, asked, correct):
    cells = (
        log,
        column,
        right,
        shown,
        "; ".join(filter(None, evidence)),
        "asked" if asked else "decided",
        "yes" if correct else "no",
    )
    return dict(zip(COLUMNS, cells, strict=True))


def main():
    """Write the logs into a temporary folder, and the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("results/own_car/proposals.csv"))
    out = parser.parse_args().out
    data = os.environ.get("VEHEST_DATA")
    if not data:
        raise SystemExit("VEHEST_DATA is not set: the logs are made of the real recordings")
    answers = yaml.safe_load(ANSWERS.read_text(encoding="utf-8"))
    rows = []
    with tempfile.TemporaryDirectory(prefix="vehest-") as folder:
        for log in LOGS:
            rows += rows_of(log, answers[log], outcome_of(write_log(log, Path(data), Path(folder))))
    with written_aside(out) as aside:
        pd.DataFrame(rows, columns=COLUMNS).to_csv(aside, index=False)
    record_tables(
        [out],
        "make own_car_proposals",
        ["script tests/proposals/own_car_proposals.py", "data ferrari_250lm"],
    )
    wrong = [row for row in rows if row["correct"] == "no"]
    for row in wrong:
        print(
            f"wrong: {row['log']}: {row['column']}: {row['proposed']} ({row['decided/asked']}), not {row['right answer']}"
        )
    decided = sum(row["decided/asked"] == "decided" for row in rows)
    print(
        f"{len(LOGS)} logs, {len(rows)} rows: {decided} decided, {len(rows) - decided} asked, {len(wrong)} wrong; written: {out}"
    )


if __name__ == "__main__":
    main()
