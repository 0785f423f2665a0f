"""README and the guides show commands on docs/examples/lap.csv with their output.

Here they run in an empty folder as printed.
"""

import re
import shlex
import shutil
from pathlib import Path

import pytest
import yaml

from place import run_vehest

pytestmark = pytest.mark.apart

ROOT = Path(__file__).resolve().parents[1]
LOG = ROOT / "docs" / "examples" / "lap.csv"
SHOWN = re.compile(
    r"^```sh\n(?P<commands>.*?)^```$(?:\n\n[^`#|]*?)?\n\n?```(?:text|output)\n(?P<output>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
NEEDS = "vehest new my_car lap.csv --yes --wheelbase 2.4"
"""Writes the data set that the other commands name."""

CASES = [
    ("README.md", ".venv/bin/vehest new"),
    ("README.md", ".venv/bin/vehest estimate"),
    ("docs/own_car.md", "vehest new"),
    ("docs/own_car.md", "vehest data check my_car"),
    ("docs/own_recording.md", "vehest data check lap.csv"),
    ("docs/own_recording.md", "vehest estimate lap.csv"),
    ("docs/estimators/self_calibrating.md", "vehest estimate"),
    ("docs/estimators/self_calibrating.md", "vehest identify"),
]


def example(page, start):
    """The command of a page that begins so, and the lines of its output."""
    for match in SHOWN.finditer((ROOT / page).read_text(encoding="utf-8")):
        command = match["commands"].splitlines()[-1]
        if command.startswith(start):
            return command, match["output"].splitlines()
    raise AssertionError(f"{page} shows no command that begins with '{start}' with its output")


@pytest.fixture
def folder(elsewhere):
    """An empty folder with the example log."""
    (elsewhere / "docs" / "examples").mkdir(parents=True)
    shutil.copy(LOG, elsewhere / "docs" / "examples")
    shutil.copy(LOG, elsewhere)
    return elsewhere


def run(command, capsys):
    words = shlex.split(command.removeprefix(".venv/bin/"))
    code, out, err = run_vehest(capsys, *words[1:])
    assert code == 0, err
    lines = [line.rstrip() for line in (err + out).splitlines()]
    return [line for line in lines if "compiling once" not in line]  # on a first run alone


@pytest.mark.parametrize(("page", "start"), CASES)
def test_stated_output_is_printed_by_the_command(page, start, folder, capsys):
    command, lines = example(page, start)
    if "vehest new" not in command:
        run(NEEDS, capsys)
    printed = run(command, capsys)
    missing = [line for line in lines if line.strip() != "…" and line.rstrip() not in printed]
    assert not missing, "\n".join(printed)
    if not any(line.strip() == "…" for line in lines):
        assert len(lines) == len(printed)


def test_python_lines_of_the_readme_run(folder, capsys):
    run(NEEDS, capsys)
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    exec(compile(block, "README.md", "exec", dont_inherit=True), {"__name__": "readme"})
    assert (folder / "lap.png").read_bytes().startswith(b"\x89PNG")


def test_bibtex_of_the_readme_is_the_citation_file():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    fields = dict(re.findall(r"^  (\w+) += \{+(.*?)\}+,?$", text, re.MULTILINE))
    assert fields == {
        "author": citation["authors"][0]["name"],
        "title": citation["title"],
        "version": citation["version"],
        "license": citation["license"],
    }


def test_readme_names_every_family_and_the_format_of_every_source():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    formats = text.split("## Formats")[1].split("\n## ")[0]
    for source in re.findall(r"\(docs/sources/(\w+)\.md\)", formats):
        tests = [*ROOT.glob(f"tests/sources/test_sources_{source}*.py")]
        assert tests or source == "text_log"  # tests/proposals/test_proposals.py reads these
    names = {file.stem for file in (ROOT / "conf" / "estimator").glob("*.yaml")}
    estimators = text.split("## Estimators")[1].split("\n## ")[0]
    assert names == set(re.findall(r"`(\w+)`", estimators))
    assert f"up to {len(names)} estimators" in text


TRAININGS = {
    "quickstart": (
        "baselines",
        "dugoff_ukf",
        "ksnn",
        "luenberger",
        "networks_and_ukf",
        "recurrent",
        "training",
    ),
    "sim_tyre_sets": ("learned_ukf", "velocity_networks"),
    "ferrari": ("rational_ekf", "single_track"),
}
"""Recordings -> pages of estimators that show a training, and mostly its evaluation."""
VARIABLE = {
    r"-[0-9a-f]{12}\b": "-KEY",
    r"\d+\.\d s,": "SECONDS s,",
    r"(\w*seconds: ).*": r"\1SECONDS",
}
"""What differs between machines: keys, which contain those of the raw files, and times."""


def without_variables(line):
    for pattern, placeholder in VARIABLE.items():
        line = re.sub(pattern, placeholder, line)
    return line.rstrip()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("recordings", "page"), [(name, page) for name, pages in TRAININGS.items() for page in pages]
)
def test_shown_training_prints_what_the_page_says(
    recordings, page, elsewhere, capsys, monkeypatch, request
):
    if recordings == "ferrari":
        monkeypatch.setenv("VEHEST_DATA", str(request.getfixturevalue("data_root")))
    text = (ROOT / "docs" / "estimators" / f"{page}.md").read_text(encoding="utf-8")
    blocks = [match for match in SHOWN.finditer(text) if "vehest train" in match["commands"]]
    assert blocks
    for block in blocks:
        printed = []
        for command in block["commands"].splitlines():
            printed += run(f"{command} tracking=none", capsys)
        printed = [without_variables(line) for line in printed]
        expected = [
            without_variables(line) for line in block["output"].splitlines() if line.strip() != "…"
        ]
        assert [line for line in expected if line not in printed] == [], "\n".join(printed)
