"""What docs/architecture.md says of the house's size holds."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
LONGEST = 100  # lines of a function, signature and docstring included


def test_no_function_has_a_hundred_lines():
    found = {}
    for file in sorted((ROOT / "src").rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                found[f"{file.relative_to(ROOT)}: {node.name}"] = (node.end_lineno or node.lineno) - node.lineno + 1
    assert len(found) > 3000
    assert {name: lines for name, lines in found.items() if lines >= LONGEST} == {}


def test_the_rooms_are_about_as_large_as_they_are_said_to_be():
    """Within a tenth: who adds more says so in the table."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    told = {room: int(lines.replace(",", "")) for room, lines in re.findall(r"^\| `(\w+)/` \|.*\| ([\d,]+) \|$", text, re.MULTILINE)}
    lines = {
        room: sum(len(file.read_text(encoding="utf-8").splitlines()) for file in (ROOT / "src" / "vehest" / room).rglob("*.py"))
        for room in told
    }
    assert len(told) == 15
    assert {room: (own, lines[room]) for room, own in told.items() if abs(own - lines[room]) > 0.1 * lines[room]} == {}
