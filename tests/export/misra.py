"""Rules of MISRA C:2012 that cppcheck finds broken in the golden files, counted.

`python tests/export/misra.py` prints the counts of docs/export.md.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

GOLDEN = Path(__file__).parent / "golden"
VERSION = "Cppcheck 2.10"
"""Whose counts are documented; others know more rules or fewer."""

_ROW = re.compile(r"^\| (\d+\.\d+) \| (\d+) \|", re.MULTILINE)


def version() -> str:
    return subprocess.run(["cppcheck", "--version"], capture_output=True, text=True, check=True).stdout.strip()


def found() -> tuple[Counter[str], list[str]]:
    """How often each rule is broken, and what cppcheck finds beside, a line each."""
    rules: Counter[str] = Counter()
    others = []
    for folder in sorted(path for path in GOLDEN.iterdir() if path.is_dir()):
        words = [
            "cppcheck",
            "--std=c99",
            "--enable=warning,portability",
            "--addon=misra",
            "--quiet",
            "--template={id} {file}:{line} {message}",
        ]
        words += [
            "--suppress=missingIncludeSystem",
            f"-I{GOLDEN / 'kinematic'}",
            *(str(path) for path in sorted(folder.glob("vehest_*.c"))),
        ]
        said = subprocess.run(words, capture_output=True, text=True, check=True, timeout=600.0).stderr
        for line in said.splitlines():
            kind, _, rest = line.partition(" ")
            if kind.startswith("misra-c2012-"):
                rules[kind.removeprefix("misra-c2012-")] += 1
            else:
                others.append(f"{kind} {rest}")
    return rules, others


def documented(text: str) -> dict[str, int]:
    """Counts in the table of docs/export.md."""
    return {rule: int(count) for rule, count in _ROW.findall(text)}


def main() -> None:
    """Print the counts, a row a rule."""
    rules, others = found()
    for rule, count in sorted(rules.items(), key=lambda own: [int(part) for part in own[0].split(".")]):
        print(f"| {rule} | {count} |")
    for line in others:
        print(line, file=sys.stderr)


if __name__ == "__main__":
    main()
