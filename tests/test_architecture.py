"""Functions stay short."""

import ast
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
