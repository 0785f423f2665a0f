"""A changed generator shows as a changed golden file, and counts of the rules of MISRA as other
counts.
"""

from pathlib import Path

import pytest
from exports import tool
from misra import VERSION, cppcheck_findings, documented, version

from golden import FOLDER, differences, sources

pytestmark = pytest.mark.export


def test_the_c_of_models_set_by_hand_is_that_of_the_golden_files():
    files = sources()
    for name, text in files.items():
        changed = differences(text, (FOLDER / name).read_text(encoding="utf-8"))
        assert not changed, (
            f"{name}: {changed[0]}; if that is wanted, run python tests/export/golden.py and look "
            f"at what git shows"
        )
    stored = {str(path.relative_to(FOLDER)) for path in FOLDER.rglob("*") if path.is_file()}
    assert stored == set(files)


def test_a_digit_beyond_the_ninth_is_no_change_and_any_other_is():
    assert not differences("x = 0.30000000000000004;", "x = 0.3;")
    assert differences("x = 0.31;", "x = 0.3;")
    assert differences("y = 0.3;", "x = 0.3;")
    assert differences("x = 0.3;\n", "x = 0.3;\n\n")


def test_each_broken_rule_is_explained_with_its_count(tmp_path):
    tool("cppcheck")
    if version() != VERSION:
        pytest.skip(f"{version()} counts otherwise than {VERSION}, whose counts are documented")
    rules, further_findings = cppcheck_findings(tmp_path)
    if "-" in rules or not rules:
        pytest.skip("cppcheck has no MISRA addon")
    assert dict(rules) == documented(
        (Path(__file__).parents[2] / "docs" / "export.md").read_text(encoding="utf-8")
    )
    assert not [
        line for line in further_findings if "whitened" not in line
    ]  # a triangle that is written before it is read, row by row
