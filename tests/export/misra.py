"""Rules of MISRA C:2012 that cppcheck finds broken in the C of all families with weights set by
hand, counted.

`python tests/export/misra.py` prints the counts of docs/export.md.
"""

import re
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parents[1] / part) for part in (".", "estimators", "export")]

from c_build import write
from exports import FAMILIES

from golden import contract, methods

VERSION = "Cppcheck 2.10"
"""Whose counts are documented; others know more rules or fewer."""

_ROW = re.compile(r"^\| (\d+\.\d+) \| (\d+) \|", re.MULTILINE)


def version():
    """Version of the installed cppcheck."""
    return subprocess.run(
        ["cppcheck", "--version"], capture_output=True, text=True, check=True
    ).stdout.strip()


def cppcheck_findings(home):
    """How often each rule is broken, and what cppcheck finds beside, a line each.

    The C is written into ``home``.
    """
    write(methods(FAMILIES) | contract(), home)
    rules = Counter()
    further_findings = []
    for folder in sorted(home.iterdir()):
        words = [
            "cppcheck",
            "--std=c99",
            "--enable=warning,portability",
            "--addon=misra",
            "--quiet",
        ]
        words += ["--template={id} {file}:{line} {message}"]
        words += [
            "--suppress=missingIncludeSystem",
            f"-I{home / 'kinematic'}",
            *(str(path) for path in sorted(folder.glob("vehest_*.c"))),
        ]
        report = subprocess.run(
            words, capture_output=True, text=True, check=True, timeout=600.0
        ).stderr
        for line in report.splitlines():
            kind, _, message = line.partition(" ")
            if kind.startswith("misra-c2012-"):
                rules[kind.removeprefix("misra-c2012-")] += 1
            else:
                further_findings.append(f"{kind} {message}")
    return rules, further_findings


def documented(text):
    """Counts in the table of docs/export.md."""
    return {rule: int(count) for rule, count in _ROW.findall(text)}


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as home:
        rules, further_findings = cppcheck_findings(Path(home))
    for rule, count in sorted(
        rules.items(), key=lambda rule_count: [int(part) for part in rule_count[0].split(".")]
    ):
        print(f"| {rule} | {count} |")
    for line in further_findings:
        print(line, file=sys.stderr)
