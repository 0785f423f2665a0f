"""The documentation says what the code does: generated pages, links, commands, examples,
constants.
"""

import re
import shlex
from collections import namedtuple
from dataclasses import fields
from pathlib import Path

import make_configuration
import make_reference
import numpy as np
import pytest
import typer
import yaml
from scipy import signal

import vehest
from example_package import forget_examples, install_examples, write_laps
from vehest.alignment import checks
from vehest.cli import app
from vehest.configuration.composition import compose_config, expand
from vehest.configuration.files import GROUPS, choices
from vehest.data.errors import ConfigurationError, DataError, JobsFailedError, MissingError
from vehest.data.recording import Recording
from vehest.data.split_files import split_from_config
from vehest.data.transforms import TRANSFORMS, Resample
from vehest.estimators.registry import estimator_class, estimator_names
from vehest.evaluation.metrics import UNITS
from vehest.run.study import Part, PipelineFile, jobs_of, read_study
from vehest.sources.base import COMMON_KEYS, open_source, source_class, source_names
from vehest.studies.artefacts import METRIC_COLUMNS

pytestmark = pytest.mark.apart

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CHANGELOG.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "estimators").glob("*.md")),
]
PLACEHOLDER = re.compile(r"\b[A-Z]{3,}\b|…")
STUDY = ROOT / "results" / "ferrari_drive"


def page(name):
    return (ROOT / name).read_text(encoding="utf-8")


def fences(text, language):
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def without_fences(text):
    return re.sub(r"^\s*```.*?^\s*```$", "", text, flags=re.MULTILINE | re.DOTALL)


def of_pages(find):
    """Parameters from all pages, each named by its page."""
    return [
        pytest.param(file, item, id=f"{file.name}: {item}") for file in PAGES for item in find(file)
    ]


def test_generated_pages_are_up_to_date():
    for path, text in make_reference.pages().items():
        assert path.read_text(encoding="utf-8") == text, (
            f"{path.name} is not what the code says; run 'make docs'"
        )


def test_leaderboard_on_the_page_of_results_follows_them(tmp_path):
    source = tmp_path / "leaderboard.csv"
    columns = (
        "title,n_parameters,rmse_sideslip,interval,against_best,beats_zero,beats_static_map,fvu"
    )
    rows = (
        '"KS-NN, small",12,0.12345,0.100 … 0.200,best,yes,no,0.0123\n'
        "Other,2,0.5,0.400 … 0.600,not significant,,,0.2\n"
    )
    source.write_text(f"{columns}\n{rows}", encoding="utf-8")
    (leaderboard,) = make_reference.leaderboard(str(source))
    first = "| KS-NN, small | 12 | 0.123 | 0.100 … 0.200 | best | yes | no | 0.012 |"
    second = "| Other | 2 | 0.500 | 0.400 … 0.600 | not significant | – | – | 0.200 |"
    assert leaderboard.endswith(f"{first}\n{second}")


def test_a_part_without_results_stays_as_it_is(tmp_path, monkeypatch):
    monkeypatch.setattr(make_reference, "RESULTS", tmp_path)
    assert make_reference.PART.sub(make_reference.generated_part, page("docs/results.md")) == page(
        "docs/results.md"
    )


def links(file):
    text = without_fences(file.read_text(encoding="utf-8"))
    targets = re.findall(r"!?\[[^\]]*\]\(([^)\s]+)\)", text)
    return [
        target
        for target in dict.fromkeys(targets)
        if not target.startswith(("https://", "http://"))
    ]


def anchors(file):
    """Anchors of a page's headings, as they are made from their text."""
    headings = re.findall(
        r"^#+ (.*)$", without_fences(file.read_text(encoding="utf-8")), re.MULTILINE
    )
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize(("file", "target"), of_pages(links))
def test_relative_links_and_images_resolve(file, target):
    path, _, anchor = target.partition("#")
    linked = (file.parent / path).resolve() if path else file
    if not linked.exists() and linked.is_relative_to(STUDY) and not STUDY.exists():
        pytest.skip("results/ferrari_drive is not here: run 'make ferrari_drive'")
    assert linked.exists(), f"{file.name} links to {target}"
    if anchor:
        assert anchor in anchors(linked), f"{file.name} links to {target}"


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """An empty folder with the configuration files that the pages show, each under the name in its
    first line.
    """
    for file in PAGES:
        for block in fences(file.read_text(encoding="utf-8"), "yaml"):
            named = re.match(r"# ((?:conf|pipelines)/\S+?\.yaml)", block)
            if named:
                path = tmp_path / named[1]
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(block, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("VEHEST_DATA", str(tmp_path))
    return tmp_path


def test_example_files_are_valid(workplace):
    example_files = {file.relative_to(workplace).as_posix() for file in workplace.rglob("*.yaml")}
    assert {
        "conf/dataset/my_car.yaml",
        "conf/split/my_car.yaml",
        "pipelines/my_study.yaml",
    } <= example_files
    for file in sorted((workplace / "conf" / "dataset").glob("*.yaml")):
        open_source(compose_config("ingest", [f"dataset={file.stem}"])["dataset"])
    lap = Recording("lap", "car", 20.0, 0.0, {"vx": np.full(400, 20.0)})
    for file in sorted((workplace / "conf" / "split").glob("*.yaml")):
        split = split_from_config(
            compose_config("train", [f"split={file.stem}"])["split"],
            lambda _: {"lap": lambda _: lap},
        )
        assert set(split.datasets) <= set(choices("dataset"))
    for file in sorted((workplace / "pipelines").glob("*.yaml")):
        assert jobs_of(read_study(str(file)), [])


def test_python_examples_run(workplace, monkeypatch, request):
    request.addfinalizer(forget_examples)
    install_examples(workplace / "site", monkeypatch)
    write_laps()
    blocks = [
        block
        for file in PAGES
        if file.name not in ("README.md", "from_python.md")  # other tests run their lines as shown
        for block in fences(file.read_text(encoding="utf-8"), "python")
    ]
    assert len(blocks) >= 2
    for block in blocks:
        exec(compile(block, "example", "exec", dont_inherit=True), {"__name__": "example"})
    assert (workplace / "models" / "static_map").is_dir()


CommandLine = namedtuple(
    "CommandLine", "command arguments overrides"
)  # a command line, taken apart


def command_lines(file):
    """Every line of a shell block that calls vehest, and every such call in running text."""
    text = file.read_text(encoding="utf-8")
    lines = [
        line.strip().removeprefix(".venv/bin/")
        for block in fences(text, "sh")
        for line in block.splitlines()
        if line.strip().removeprefix(".venv/bin/").startswith("vehest ")
    ]
    lines += re.findall(r"`(vehest [^`\n]+)`", without_fences(text))
    return list(dict.fromkeys(lines))


def parsed(line):
    """Command, arguments and overrides.

    None where only a command is named. Unknown commands and options fail.
    """
    words = shlex.split(line, comments=True)[1:]
    command = typer.main.get_command(app)
    options = {
        option: parameter
        for parameter in command.params
        for option in (*parameter.opts, *parameter.secondary_opts)
    }
    if words[0].startswith("-"):
        assert words[0] in {*options, "-h", "--help"}, f"vehest has no option {words[0]}"
        return None
    path = []
    while hasattr(command, "commands"):
        if not words:
            return None
        assert words[0] in command.commands, f"vehest has no command {words[0]}"
        path.append(words[0])
        command = command.commands[path[-1]]
        words = words[1:]
    options = {
        option: parameter
        for parameter in command.params
        for option in (*parameter.opts, *parameter.secondary_opts)
        if parameter.param_type_name == "option"
    }
    fixed = [
        parameter
        for parameter in command.params
        if parameter.param_type_name == "argument" and parameter.nargs == 1
    ]
    positional = []
    waiting = iter(words)
    for word in waiting:
        if word.startswith("-") and word != "-":
            assert word in {*options, "-h", "--help"}, (
                f"vehest {' '.join(path)} has no option {word}"
            )
            if word in options and not options[word].is_flag:
                next(waiting, None)
        else:
            positional.append(word)
    if not positional:
        return None
    required = [parameter for parameter in fixed if parameter.required]
    assert len(positional) >= len(required), (
        f"vehest {' '.join(path)} needs {', '.join(parameter.name for parameter in required)}"
    )
    if len(positional) > len(required) and any(
        "=" in word for word in positional[len(required) : len(fixed)]
    ):
        fixed = required  # what may be left out is left out
    takes_overrides = any(
        parameter.name == "overrides" or parameter.nargs == -1 for parameter in command.params
    )
    assert takes_overrides or len(required) <= len(positional) <= len(fixed), (
        f"vehest {' '.join(path)} takes no overrides"
    )
    return CommandLine(tuple(path), positional[: len(fixed)], positional[len(fixed) :])


def overrides_of(command_line):
    """The root configuration and overrides that a command composes.

    Nothing where placeholders stand.
    """
    first = command_line.arguments[0] if command_line.arguments else ""
    match command_line.command:
        case ("ingest",) | ("downsample",):
            yield command_line.command[0], [f"dataset={first}", *command_line.overrides]
        case ("data", "show" | "check" | "usable"):
            if Path(first).suffix or PLACEHOLDER.search(first):
                yield "estimate", command_line.overrides
            else:
                yield "ingest", [f"dataset={first}", *command_line.overrides]
        case ("config",):
            yield first, command_line.overrides
        case ("sweep",):
            jobs = expand(command_line.overrides)
            yield from (("eval", job) for job in (jobs[0], jobs[-1]))
        case ("train",) | ("eval",) | ("estimate",):
            yield command_line.command[0], command_line.overrides


@pytest.mark.parametrize(("file", "line"), of_pages(command_lines))
def test_documented_command_line_is_valid(file, line, workplace):
    command_line = parsed(line)
    if command_line is None:
        return
    if command_line.command[0] == "report" and "--check" in line:
        for name in (*command_line.arguments, *command_line.overrides):
            assert PLACEHOLDER.search(name) or read_study(name).publish
    elif command_line.command[0] in {"run", "report"}:
        if not PLACEHOLDER.search(" ".join([*command_line.arguments, *command_line.overrides])):
            pipeline = read_study(
                command_line.arguments[0]
            )  # what composes without overrides is known from test_config
            assert not command_line.overrides or jobs_of(pipeline, command_line.overrides)
    else:
        for root, overrides in overrides_of(command_line):
            if not PLACEHOLDER.search(" ".join([root, *overrides])):
                config = compose_config(root, overrides)
                if root == "estimate":
                    estimator_class(config["estimator"]["name"]).from_config(config["estimator"])


def test_make_targets_exist():
    targets = {
        target
        for rule in re.findall(r"^([\w -]+):", page("Makefile"), re.MULTILINE)
        for target in rule.split()
    }
    named = {
        target
        for file in PAGES
        for target in re.findall(
            r"(?:`|^)make ([a-z0-9_-]+)", file.read_text(encoding="utf-8"), re.MULTILINE
        )
    }
    assert {"run", "test", "ui"} <= named <= targets


def test_command_lines_are_collected_and_wrong_ones_detected():
    assert len(of_pages(command_lines)) > 60
    for line in (
        "vehest trian",
        "vehest train --fast",
        "vehest doctor now",
        "vehest data look",
        "vehest --quick",
    ):
        with pytest.raises(AssertionError):
            parsed(line)


def test_readme_names_the_patent_and_the_licence_and_the_citation_seven_papers():
    assert all(
        "PCT/IT2023/050058" in page(name) for name in ("README.md", "docs/estimators/ksnn.md")
    )
    assert "(LICENSE)" in page("README.md")
    citation = yaml.safe_load(page("CITATION.cff"))
    assert (citation["cff-version"], citation["version"]) == ("1.2.0", vehest.__version__)
    papers = citation["references"]
    assert len({paper["title"] for paper in papers}) == 7
    assert all(paper["authors"] and paper["year"] for paper in papers)
    dois = {
        "10.1109/TITS.2023.3303776",
        "10.1109/ACCESS.2020.3012770",
        "10.1109/TVT.2024.3389493",
        "10.3390/s21165409",
        "10.48550/arXiv.2408.15610",
    }
    assert {paper["doi"] for paper in papers if "doi" in paper} == dois


def test_pages_know_every_name():
    data = page("docs/data.md")
    evaluation = page("docs/evaluation.md")
    cli = page("docs/cli.md")
    overview = page("docs/estimators.md")
    families = "".join(
        page(f"docs/estimators/{name}.md")
        for name in re.findall(r"\(estimators/(\w+)\.md\)", overview)
    )
    for source in source_names():
        source_page = page(f"docs/sources/{source}.md")
        assert f"(sources/{source}.md)" in data
        for option in fields(source_class({"source": source}).options_type):
            assert f"`{option.name}`" in source_page, (
                f"docs/sources/{source}.md does not explain {option.name}"
            )
    named_checks = {
        "read",
        "impossible",
        "unit",
        "sign",
        "kinematics",
        "nan",
        "stuck",
        "saturated",
        "offset",
        "dropout",
        "reverse",
    }
    for name in set(COMMON_KEYS) | set(TRANSFORMS) | named_checks:
        assert f"`{name}`" in data, f"docs/data.md does not explain {name}"
    for name in estimator_names():
        assert f"`{name}`" in overview, f"docs/estimators.md does not name {name}"
        assert f"`{name}`" in families, f"no page of docs/estimators explains {name}"
    for name in UNITS:
        assert f"`{name}`" in evaluation, f"docs/evaluation.md does not explain {name}"
    assert ", ".join(METRIC_COLUMNS).replace("kind,", "kind (`real` or `simulated`),") in " ".join(
        evaluation.split()
    )
    for name in {*(field.name for kind in (PipelineFile, Part) for field in fields(kind)), *GROUPS}:
        assert f"`{name}`" in cli, f"docs/cli.md does not explain {name}"


def test_pages_have_every_public_name_and_every_exit_code():
    documented = set(
        re.findall(
            r"^\.\. auto(?:function|class):: (\w+)$", page("docs/from_python.md"), re.MULTILINE
        )
    )
    assert documented == set(vehest.__all__) - {"__version__"}
    table = dict(re.findall(r"^\| (\d+) \| ([^|]+) \|", page("docs/cli.md"), re.MULTILINE))
    stated = {
        "configuration": ConfigurationError,
        "unusable data": DataError,
        "missing": MissingError,
        "some jobs": JobsFailedError,
    }
    for words, error in stated.items():
        assert words in table[str(error.exit_code)]


def test_stated_filter_is_the_resampling_filter():
    text = " ".join(page("docs/data.md").split())
    assert f"β = {Resample.kaiser_beta:g}, {Resample.zero_crossings} zero crossings" in text
    assert f"is at {Resample.cutoff:g} of the slower Nyquist frequency" in text
    frequencies, response = signal.freqz(Resample(20.0).taps(1, 5), worN=1 << 14, fs=100.0)
    decibels = 20.0 * np.log10(np.abs(response) + 1e-12)
    assert (
        "flat within 0.1 dB up to 7.5 Hz, -3 dB at 8.3 Hz, and at least 71 dB down from 10 Hz on"
        in text
    )
    assert np.abs(decibels[frequencies <= 7.5]).max() < 0.1
    assert round(float(frequencies[np.argmax(decibels < -3.0)]), 1) == 8.3
    assert decibels[frequencies >= 10.0].max() < -71.0


def test_stated_limits_of_checks_are_those_of_the_code():
    text = " ".join(page("docs/data.md").split())
    assert f"more than {100 * checks.SATURATED_FRACTION:g} % of the samples" in text
    assert f"exactly the same for {checks.STUCK_SECONDS:g} s or more" in text
    assert (
        f"lies below -{checks.REVERSE_SPEED:g} m/s for {checks.REVERSE_SECONDS:g} s or more" in text
    )
    low, high = checks.KINEMATIC_BAND_HZ
    assert (
        f"correlation below {checks.MIN_SIGN_CORRELATION:g} between {low:g} and {high:g} Hz" in text
    )


def test_stated_parameter_counts_of_recurrent_networks_and_the_ksnn():
    for name in ("gru", "lstm"):
        counts = [
            estimator_class(name).from_config({"n_states": states}).n_parameters
            for states in range(2, 7)
        ]
        row = re.search(
            rf"^\| {name.upper()} \| [^|]+ \|(.*)\|$",
            page("docs/estimators/recurrent.md"),
            re.MULTILINE,
        )
        assert [int(cell) for cell in row[1].split("|")] == counts
    rows = re.findall(
        r"^\| (?:non)?linear[^|]*\| `([^`]+)` \|[^|]+\| (\d+)",
        page("docs/estimators/ksnn.md"),
        re.MULTILINE,
    )
    assert len(rows) == 4
    for overrides, count in rows:
        (job,) = expand(["estimator=ksnn", *overrides.split()])
        assert estimator_class("ksnn").from_config(
            compose_config("train", job)["estimator"]
        ).n_parameters == int(count)


def test_configuration_files_have_the_settings_that_the_classes_declare():
    contents = make_configuration.files()
    no_settings = {"none.yaml"}
    folders = [ROOT / "conf" / "estimator", ROOT / "conf" / "training"]
    names = {file for folder in folders for file in folder.glob("*.yaml")}
    assert {file.name for file in names - set(contents)} <= no_settings
    for file, text in contents.items():
        assert file.read_text(encoding="utf-8") == text, f"run 'make reference': {file}"
    gru = contents[ROOT / "conf" / "estimator" / "gru.yaml"]
    assert "n_states: 5 " in gru
    assert "at least 1" in gru
