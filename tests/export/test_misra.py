"""What MISRA C:2012 has against exports, rule by rule, as docs/export.md explains it."""

from pathlib import Path

import pytest
from exports import tool
from misra import VERSION, documented, found, version

pytestmark = pytest.mark.export

DOCUMENT = Path(__file__).parents[2] / "docs" / "export.md"


def test_each_broken_rule_is_explained_with_its_count(tmp_path):
    tool("cppcheck")
    if version() != VERSION:
        pytest.skip(f"{version()} counts otherwise than {VERSION}, whose counts are documented")
    rules, others = found(tmp_path)
    if "-" in rules or not rules:
        pytest.skip("cppcheck has no MISRA addon")
    assert dict(rules) == documented(DOCUMENT.read_text(encoding="utf-8"))
    assert not [line for line in others if "whitened" not in line]  # a triangle that is written before it is read, row by row
