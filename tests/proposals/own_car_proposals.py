"""`vehest new` on twelve logs in different dress, held against what was written down before:
results/own_car/proposals.csv, a row a column.

``answers.yaml`` was committed before anything that proposes existed, and has not been changed
since; the method was developed with these logs at hand, and revised after their outcome was seen.
How it does on logs that it was not developed with, they do not tell.
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
    columns = {channel["column"]: channel for channel in proposed["channels"]}
    questions = {question["key"]: question for question in proposed["open"]}
    mirror = _mirror(answers, columns) if "left_right" in answers["asked"] else 1
    rows = [
        _row(log, name, answer, columns.get(name), questions, mirror, name in answers["asked"])
        for name, answer in answers["columns"].items()
    ]
    for name in (*columns, *proposed["unused"]):
        if name not in answers["columns"]:
            proposed_channel = columns.get(name)
            proposal, evidence = (
                (
                    f"{proposed_channel['channel']}, {proposed_channel['unit']}",
                    proposed_channel["evidence"],
                )
                if proposed_channel
                else ("no channel", [])
            )
            rows.append(
                _line(
                    log,
                    name,
                    "no channel",
                    proposal,
                    evidence,
                    name in questions,
                    proposed_channel is None and name not in questions,
                )
            )
    if "time" in answers:
        rows.append(_clock(log, answers["time"], proposed))
    for key in WHOLE:
        should_ask = key in answers["asked"]
        does_ask = key in questions
        if should_ask or does_ask or key == "left_right":
            evidence = questions[key]["evidence"] if does_ask else [proposed["left_right"] or ""]
            proposal = str(questions[key]["proposed"]) if does_ask else "decided"
            rows.append(
                _line(
                    log,
                    f"({key})",
                    "asked" if should_ask else "decided",
                    proposal,
                    evidence,
                    does_ask,
                    should_ask == does_ask,
                )
            )
    return rows


def _mirror(answers, columns):
    """1, or -1 where all signs are reversed, by the yaw rate's column."""
    name, answer = next(
        item for item in answers["columns"].items() if item[1]["channel"] == "yaw_rate"
    )
    return int(answer["sign"] * columns[name]["sign"]) if name in columns else 1


def _row(log, name, answer, channel, questions, mirror, undecidable):
    right = f"{answer['channel']}, {answer['unit']}, sign {answer['sign']:+d}" + (
        f", {answer['delay']} ms late" if "delay" in answer else ""
    )
    if channel is None:
        return _line(log, name, right, "no channel", [], False, False)
    delay = 1000.0 * channel["delay"]
    proposal = f"{channel['channel']}, {channel['unit']}, sign {channel['sign']:+d}" + (
        f", {delay:.0f} ms late" if delay else ""
    )
    turned = mirror if channel["channel"] in LATERAL else 1
    agrees = (
        answer["channel"] in ("asked", channel["channel"])
        and answer["unit"] in ("asked", channel["unit"])
        and answer["sign"] == channel["sign"] * turned
        and channel["factor"] == 1.0
        and (
            abs(delay - answer["delay"]) <= TOLERANCE
            if "delay" in answer
            else delay < LONGEST_UNPLANTED
        )
    )
    return _line(
        log,
        name,
        right,
        proposal,
        channel["evidence"],
        name in questions,
        agrees and (name in questions) == undecidable,
    )


def _clock(log, answer, proposed):
    """The column of times and the rate that it makes."""
    clock = proposed["time"]
    proposal = (
        "none"
        if clock is None
        else f"{clock['column']}, {clock['unit']}, {proposed['rate_hz']:g} Hz"
    )
    right = (
        "none"
        if answer is None
        else f"{answer['column']}, {answer['unit']}, {answer['rate_hz']} Hz"
    )
    is_question = any(question["key"] == "time" for question in proposed["open"])
    return _line(
        log,
        "(time)",
        right,
        proposal,
        [] if clock is None else [clock["evidence"]],
        is_question,
        proposal == right and not is_question,
    )


def _line(log, column, right, proposal, evidence, is_question, correct):
    cells = (
        log,
        column,
        right,
        proposal,
        "; ".join(filter(None, evidence)),
        "asked" if is_question else "decided",
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
            f"wrong: {row['log']}: {row['column']}: {row['proposed']} ({row['decided/asked']}), "
            f"not {row['right answer']}"
        )
    decided = sum(row["decided/asked"] == "decided" for row in rows)
    print(
        f"{len(LOGS)} logs, {len(rows)} rows: {decided} decided, {len(rows) - decided} asked, "
        f"{len(wrong)} wrong; written: {out}"
    )


if __name__ == "__main__":
    main()
