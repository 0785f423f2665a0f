"""Write the made parts of the pages in docs/, from the code and from published results.

A part stands between ``<!-- made by docs/make_reference.py: NAME WORDS -->`` and ``<!-- end -->``; NAME is one of `PARTS`, which takes the
words. Run by ``make docs``; tests/test_docs.py checks that the pages are up to date.
"""

from __future__ import annotations

import csv
import inspect
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import typer

from vehest.run.setting_lines import field_comments

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "results"
PART = re.compile(
    r"(?<=<!-- made by docs/make_reference.py: )(\w+)(.*?) -->\n.*?(?=\n<!-- end -->)", re.DOTALL
)

HEADINGS = {
    "v = 0": "zero",
    "map with reference": "static map, fitted to the drive",
    "shipped": "shipped network",
    "band holds": "coverage",
    "choices": "role",
    "worse than v = 0": "worse than zero",
    "paper": "published",
    "real_drive": "550 to 700 s",
    "real_whole": "whole drive",
    "rmse_sideslip_offline_deg": "RMSE(β) offline [deg]",
    "rmse_sideslip_online_deg": "online [deg]",
    "ratio_sideslip": "ratio",
    "title": "estimator",
    "rmse_sideslip": "RMSE(β) [deg]",
    "interval": "95 % interval",
    "n_seeds": "seeds",
    "beats_zero": "better than zero",
    "beats_static_map": "better than static_map",
    "share": "share of faults that are flagged",
    "per_hour": "alarms an hour",
    "low": "from (95 %)",
    "high": "to",
    "of_a_sensor": "alarms that accuse a sensor",
    "than 1.1 times shipped": "worse than 1.1 times the shipped network",
}
"""Headings of reports' tables -> those of pages."""
CELLS = {
    "v = 0": "zero",
    "not told apart": "no significant difference",
    "Zero (v = 0)": "Zero",
    "made on it": "development",
    "not": "test",
}
"""Cells of reports' tables -> those of pages."""

BASELINES = ("zero", "static_map")
OVERVIEWS = {
    "rational_ekf": (
        "heavy_ekf",
        "RMSE(β) [deg], the truck **simulated**",
        {
            "test": "test",
            **{key: key for key in ("LINT", "RATT", "RATTE", "zero", "static map")},
        },
    ),
    "cnn_ukf": (
        "cnn_ukf",
        "Squared errors of β [deg²] with 95 % intervals over 1,000 manoeuvres: over all samples, over "
        "those from 4 m/s² on, and until |β| first exceeds 12°; **simulated** cars",
        {
            "candidate": "method",
            "mse": "MSE",
            "mse_nl": "MSE_nl",
            "within": "MSE up to 12°",
            "n_seeds": "seeds",
        },
    ),
    "learned_ukf": (
        "learned_ukf",
        "Weighted squared error of the states, **real** recordings, means over seeds; no training uses tyre D",
        {
            "candidate": "method",
            "ours_tyre_a": "tyre A",
            "ours_tyre_d": "tyre D",
            "n_seeds": "seeds",
        },
    ),
}
"""Estimator -> study that re-creates its paper, caption of its overview, columns with their headings."""

VERDICTS = {"lowest": "best", "not told apart": "not significant", "": "–"}
"""Verdict in a published leaderboard -> how the page says it."""

COMMON = 4  # commands from which on an option is listed once for all
TYPER_OWN = {"install_completion", "show_completion", "help"}


def pages() -> dict[Path, str]:
    """Every page with made parts, by its path: what it should hold."""
    found = {
        file: file.read_text(encoding="utf-8") for file in sorted((ROOT / "docs").rglob("*.md"))
    }
    return {
        file: PART.sub(generated_part, text) for file, text in found.items() if PART.search(text)
    }


def generated_part(part: re.Match[str]) -> str:
    """A part anew; as it is where the results that it shows are not here."""
    paragraphs = list(PARTS[part[1]](*part[2].split()))
    return f"{part[1]}{part[2]} -->\n" + "\n\n".join(paragraphs) if paragraphs else part[0]


def main() -> None:
    """Write the pages that have changed and name them."""
    for path, text in pages().items():
        if path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
            print(path.relative_to(ROOT))


# Commands and configuration files


def commands() -> Iterable[str]:
    """Every command with its options; those that several have come first."""
    from vehest.cli import app

    root: Any = typer.main.get_command(app)
    leaves = list(_leaves(root, ("vehest",)))
    counts = Counter(row for _, command in leaves for row in _parameters(command))
    common = [row for row, count in counts.items() if count >= COMMON]
    yield f"{_paragraphs(root.help)} `-h` and `--help` explain every command."
    yield "### Common options"
    yield _list([*_parameters(root), *common])
    for words, command in leaves:
        rows = _parameters(command)
        yield f"### `{' '.join(words)}`"
        own = [row for row in rows if row not in common]
        yield f"{_paragraphs(command.help)} Takes {', '.join(row[0] for row in rows if row in common)}{' and:' if own else '.'}"
        if own:
            yield _list(own)


def _leaves(group: Any, words: tuple[str, ...]) -> Iterable[tuple[tuple[str, ...], Any]]:
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from _leaves(command, (*words, name))
        else:
            yield (*words, name), command


def _argument(parameter: Any) -> str:
    name = parameter.name.upper()
    return f"[{name}]..." if parameter.nargs == -1 else name


def _parameters(command: Any) -> list[tuple[str, str]]:
    """Arguments and options of a command, with their meaning."""
    rows = []
    for parameter in command.params:
        if parameter.name in TYPER_OWN:
            continue
        if parameter.param_type_name == "argument":
            name = f"`{_argument(parameter)}`"
        else:
            value = "" if parameter.is_flag else f" {parameter.name.upper()}"
            name = ", ".join(f"`{option}{value}`" for option in parameter.opts)
        default = parameter.default
        shown = (
            f" Default: `{default}`."
            if not (default is None or isinstance(default, bool) or callable(default))
            else ""
        )
        rows.append((name, f"{parameter.help}{shown}"))
    return rows


def files(*folders: str) -> Iterable[str]:
    """A row for each YAML file of some folders: a link, and the first sentence of its comment."""
    found = sorted(
        (file for folder in folders for file in (ROOT / folder).glob("*.yaml")),
        key=lambda file: file.name,
    )
    rows = [
        (f"[`{file.stem}`](../{file.relative_to(ROOT).as_posix()})", _first_sentence(file))
        for file in found
    ]
    yield _table(("file", "content"), rows)


def _first_sentence(file: Path) -> str:
    """Of the comment at the top of a file."""
    comment = re.match(r"(?:#.*\n)+", file.read_text(encoding="utf-8"))
    lines = (
        [line.lstrip("# ").rstrip() for line in comment[0].splitlines() if "@package" not in line]
        if comment
        else []
    )
    return re.split(r"(?<=\.)\s+(?=[A-Z])", " ".join(lines), maxsplit=1)[0]


# Channels


def channels() -> Iterable[str]:
    """Names, units, meanings and possible ranges."""
    from vehest.data.channels import CHANNELS

    rows: dict[tuple[str, str, str], list[str]] = {}
    for c in CHANNELS.values():
        of_all = re.sub(r"(the )?(front|rear) (left|right)( wheel)?", "each wheel", c.meaning)
        possible = f"{c.low:g} … {c.high:g}" if abs(c.low) != math.pi else "-π … π"
        rows.setdefault((c.unit, of_all, possible), []).append(f"`{c.name}`")
    yield _table(
        ("channel", "unit", "meaning", "possible range"),
        [(", ".join(names), *row) for row, names in rows.items()],
    )


def units() -> Iterable[str]:
    """What a unit may be given as, with factors."""
    from vehest.data.units import _UNITS

    conversions: dict[str, list[str]] = {}
    for unit, (si, factor) in _UNITS.items():
        conversions.setdefault(si, []).append(
            f"`{unit}`" + (f" × {factor:.10g}" if factor != 1.0 else "")
        )
    yield _table(
        ("unit of channels", "may be given as"),
        [(si, ", ".join(dict.fromkeys(given))) for si, given in conversions.items()],
    )


# Manoeuvres and courses


def manoeuvres(plant: str) -> Iterable[str]:
    """Manoeuvres of the cars of a plant, multi-body or planar, with their parameters."""
    from vehest.simulation.driving.manoeuvres import MANOEUVRES
    from vehest.simulation.planar_drive import PLANAR_MANOEUVRES

    known: dict[str, Any] = {**(PLANAR_MANOEUVRES if plant == "planar" else MANOEUVRES)}
    rows = []
    for name, made in sorted(known.items()):
        described = _sections(made)
        rows.append((f"**`{name}`**", "", described[""]))
        rows += [
            (f"`{field.name}`", f"`{_as_yaml(field.default)}`", described.get(field.name, ""))
            for field in fields(made)
        ]
    yield _table(("manoeuvre, parameters", "default", "meaning"), rows)


def courses() -> Iterable[str]:
    """Length, smallest radius and bank of every course."""
    from vehest.simulation.road import tracks
    from vehest.simulation.road.course import course_by_name

    known = [(name, course_by_name(name)) for name in tracks.LAYOUTS]
    rows = [
        (
            f"`{name}`",
            f"{c.length:.0f}",
            f"{1.0 / abs(c.curvature).max():.0f}",
            f"{math.degrees(abs(c.bank).max()):.1f}",
        )
        for name, c in known
    ]
    yield _table(("course", "length [m]", "smallest radius [m]", "bank up to [deg]"), rows, right=3)


def _as_yaml(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_as_yaml(entry) for entry in value)}]"
    if isinstance(value, float):
        return f"{value:.6g}"
    return (
        {None: "null", True: "true", False: "false"}.get(value, str(value))
        if value is None or isinstance(value, bool)
        else str(value)
    )


def _sections(described: type) -> dict[str, str]:
    """A docstring's first paragraph, under the empty name, and the comments of fields by name."""
    text = inspect.getdoc(described) or ""
    sections = {"": " ".join(text.split("\n\n")[0].split())}
    for name, meaning in field_comments(described).items():
        sections.setdefault(name, f"{meaning.removesuffix('.')}.".replace("``", "`"))
    return sections


# Families of estimators


def settings(*estimators: str) -> Iterable[str]:
    """Settings and fitted numbers of families, as their classes declare them; those that an earlier one has too are only named."""
    from vehest.estimators.registry import estimator_class

    listed: set[tuple[str, ...]] = set()
    for name in estimators:
        rows = list(_declared(estimator_class(name).settings_type(), ""))
        same = [row[0] for row in rows if row in listed]
        own = [row for row in rows if row not in listed]
        if len(estimators) > 1:
            yield f"`{name}`" + (
                f", besides {', '.join(same)} as above:"
                if same and own
                else ":"
                if own
                else ": as above."
            )
        if own:
            yield _table(("`estimator.`", "default", "unit", "meaning"), own)
        listed.update(own)


def _declared(settings: Any, above: str) -> Iterable[tuple[str, str, str, str]]:
    from vehest.declared import Group, declaration

    for field in fields(settings):
        value = getattr(settings, field.name)
        declared = declaration(field)
        if isinstance(value, Group):
            yield from _declared(value, f"{above}{field.name}.")
        elif declared is not None:
            default = (
                "fitted"
                if declared.is_fitted
                else "[…]"
                if is_dataclass(value)
                else f"`{_as_yaml(value)}`"
            )
            yield f"`{above}{field.name}`", default, declared.unit, declared.doc


def figures(shown: str, *estimators: str) -> Iterable[str]:
    """What published studies report of families, and a figure, named as STUDY/FIGURE, with its caption."""
    yield from _on_the_same_drive(estimators)
    for study, caption, columns in (OVERVIEWS[name] for name in estimators if name in OVERVIEWS):
        rows = [
            tuple(CELLS.get(row[key], _rounded(row[key])) for key in columns)
            for row in _rows(RESULTS / study / "tables" / "overview.csv")
        ]
        if rows:
            yield f"{caption} ([{study}](../../results/{study}/report.md)):"
            yield _table(tuple(columns.values()), rows)
    study, _, figure = shown.partition("/")
    report = RESULTS / study / "report.md"
    found = (
        re.search(rf"!\[([^\]]*)\]\(figures/{figure}\.png\)", report.read_text(encoding="utf-8"))
        if report.is_file()
        else None
    )
    if found:
        yield f"![{found[1]}](../../results/{study}/figures/{figure}.png)"
        yield f"{found[1]} From [results/{study}](../../results/{study}/report.md)."


def _on_the_same_drive(estimators: Sequence[str]) -> Iterable[str]:
    """RMSE(β) with its interval on the test of `ferrari_drive`, a column a variant, baselines last."""
    rows = _rows(RESULTS / "ferrari_drive" / "tables" / "leaderboard_test.csv")
    wanted = [*estimators, *(name for name in BASELINES if name not in estimators)]
    shown = [row for name in wanted for row in rows if row["estimator"] == name]
    if any(row["estimator"] in estimators for row in shown):
        yield "RMSE(β) [deg] with its 95 % interval, trained on the same drive ([ferrari_drive](../../results/ferrari_drive/report.md)):"
        cells = ("Ferrari 250 LM (real), 550 to 700 s", *(_with_interval(row) for row in shown))
        yield _table(("test", *(row["title"] for row in shown)), [cells], right=len(shown))


def _with_interval(row: dict[str, str]) -> str:
    return f"{float(row['rmse_sideslip']):.3f} [{row['interval'].replace(' … ', ', ')}]"


# Excerpts


def excerpt(source: str, columns: str, rows: str = "") -> Iterable[str]:
    """Columns, numbered from 1, of a CSV file or of a Markdown table of a report.

    ``source`` is a file below results/, of a report with ``#2`` behind it for its second table. ``rows`` is a
    pattern that the cells of a row, joined by commas, begin with; ``_`` stands for a blank.
    """
    name, _, number = source.partition("#")
    path = RESULTS / name
    if not path.is_file():
        return
    lines = _csv_lines(path) if path.suffix == ".csv" else _table_lines(path, int(number or 1))
    indices = [int(column) - 1 for column in columns.split(",")]
    pattern = re.compile(rows.replace("_", " "))
    header = [HEADINGS.get(lines[0][index], lines[0][index]) for index in indices]
    matches = [line for line in lines[1:] if pattern.match(",".join(line))]
    cells = [[CELLS.get(line[index], line[index]) for index in indices] for line in matches]
    yield _table(header, cells, right=len(indices) - 1)


def _csv_lines(path: Path) -> list[list[str]]:
    with open(path, newline="", encoding="utf-8") as stream:
        return [[_rounded(cell) or "–" for cell in line] for line in csv.reader(stream)]


def _table_lines(path: Path, number: int) -> list[list[str]]:
    """Cells of a report's table, without the rule below its header."""
    tables = re.findall(r"^\|.*(?:\n\|.*)+", path.read_text(encoding="utf-8"), re.MULTILINE)
    header, _, *lines = tables[number - 1].splitlines()
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in (header, *lines)]


# Published results


def leaderboard(source: str = "ferrari_drive/tables/leaderboard_test.csv") -> Iterable[str]:
    """The leaderboard of the study on one real car."""
    lines = [
        (
            row["title"],
            f"{float(row['n_parameters']):.0f}",
            f"{float(row['rmse_sideslip']):.3f}",
            row["interval"],
            *(
                VERDICTS.get(row[column], row[column])
                for column in ("against_best", "beats_zero", "beats_static_map")
            ),
            f"{float(row['fvu']):.3f}",
        )
        for row in _rows(RESULTS / source)
    ]
    columns = (
        "parameters",
        "RMSE(β) [deg]",
        "95 % interval [deg]",
        "difference to best [deg]",
        "beats zero",
        "beats static map",
        "FVU",
    )
    if lines:
        yield _table(("estimator", *columns), lines, right=len(columns))


def wheelbase_of_small_cars() -> Iterable[str]:
    """RMSE(β) of the self-calibrating filter on small cars with and without their wheelbase."""
    tables = _tables_of_markdown(RESULTS / "unseen_car" / "report.md")
    zero = {
        row["car"]: row["v = 0"]
        for table in tables
        for row in table
        if {"car", "v = 0"} <= row.keys()
    }
    lines = [
        (row["car"].removesuffix(" (real)"), zero[row["car"]], row["cold"], row["car not given"])
        for table in tables
        for row in table
        if "car not given" in row and ", 1:" in row["car"]
    ]
    columns = ("`zero` [deg]", "with wheelbase [deg]", "without [deg]")
    if lines:
        yield _table(("car", *columns), lines, right=len(columns))


def _tables_of_markdown(path: Path) -> list[list[dict[str, str]]]:
    """Every table of a report, a dictionary a row."""
    if not path.is_file():
        return []
    tables = []
    for block in re.findall(r"(?:^\|.*\|$\n?)+", path.read_text(encoding="utf-8"), re.MULTILINE):
        header, _, *rows = (
            [cell.strip() for cell in line.strip("| ").split(" | ")] for line in block.splitlines()
        )
        tables.append([dict(zip(header, row, strict=True)) for row in rows])
    return tables


# Benchmarks


def benchmarks(*names: str) -> Iterable[str]:
    """Time and memory of the plain way and of vehest, a row a case of the benchmarks named."""
    lines = [
        (
            case["case"].replace(" members, ", " trainings, "),
            _seconds(case["baseline_seconds"]),
            _seconds(case["ours_seconds"]),
            _two_digits(case["baseline_seconds"] / case["ours_seconds"]),
            name,
        )
        for name in names
        for case in _json(f"benchmarks/{name}.json").get("cases", [])
        if {"baseline_seconds", "ours_seconds"} <= case.keys()
    ]
    if lines:
        yield _table(("case", "plain", "vehest", "ratio", "file"), lines, right=4)


def workflow() -> Iterable[str]:
    """Time and memory of whole commands."""
    titles = {
        "help": "`vehest --help`",
        "run_finished": "`vehest run` of a finished study",
        "estimate_minute": "`vehest estimate`, one minute",
        "estimate_15_h": "`vehest estimate`, 15 hours at 100 Hz",
    }
    measured = _json("benchmarks/workflow.json").get("now", {})
    lines = [
        (titles[name], f"{value['seconds']:.2f} s", f"{value['peak_mb']:.0f} MB")
        for name, value in measured.items()
    ]
    if lines:
        yield _table(("command", "time", "memory"), lines, right=2)


def launchers() -> Iterable[str]:
    """Time that the launchers add to a task, and what one parent process sustains."""
    measured = _json("benchmarks/launchers.json")
    if not measured:
        return
    local, ray = measured["launchers"]["local"], measured["launchers"]["ray"]
    yield _table(
        ("two cores", "local", "Ray"),
        [
            ("until the first group begins", _seconds(local["start_s"]), _seconds(ray["start_s"])),
            ("added to a task", _seconds(local["added_s"]), _seconds(ray["added_s"])),
        ],
        right=2,
    )
    untracked, tracked = measured["sweep"]["none"], measured["sweep"]["mlflow"]
    yield _table(
        ("part of one parent process", "measured"),
        [
            (
                "Ray's scheduler",
                f"{measured['scheduler']['empty_tasks_a_second']:.0f} empty tasks a second",
            ),
            (
                "work for a training, without tracking",
                _seconds(untracked["parent_cpu_s_a_training"]),
            ),
            (
                "work for a training in MLflow's local store",
                _seconds(tracked["mlflow_s_a_training"]),
            ),
            (
                "planning of a combination of a sweep",
                _seconds(measured["planning"]["seconds_a_combination"]),
            ),
            (
                "artefacts of a training",
                f"{untracked['bytes_a_training'] / 1e3:.0f} kB, {untracked['files_a_training']:.0f} files",
            ),
            ("memory over 2,000 trainings", f"{untracked['parent_mb']:.0f} MB"),
        ],
        right=1,
    )


def _json(source: str) -> dict[str, Any]:
    path = RESULTS / source
    return dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else {}


def _two_digits(ratio: float) -> str:
    return f"{float(f'{ratio:.2g}'):g}"


def _seconds(value: float) -> str:
    """Three digits, in s, ms or µs."""
    factor, unit = (1.0, "s") if value >= 1.0 else (1e3, "ms") if value >= 1e-3 else (1e6, "µs")
    return f"{value * factor:.3g} {unit}" if value < 1000.0 else f"{value:.0f} s"


def _rows(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with open(path, newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def _rounded(cell: str) -> str:
    return f"{float(cell):.3f}" if re.fullmatch(r"-?\d+\.\d+", cell) else cell


def _paragraphs(text: str | None) -> str:
    return " ".join((text or "").split())


def _list(rows: Iterable[tuple[str, str]]) -> str:
    return "\n".join(f"- {name}: {meaning}" for name, meaning in rows)


def _table(header: Sequence[str], rows: Iterable[Sequence[str]], right: int = 0) -> str:
    """A Markdown table; the last ``right`` columns are aligned to the right."""
    rules = [":--"] * (len(header) - right) + ["--:"] * right
    lines = [header, rules, *([cell.replace("|", "\\|") for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


_PARTS = (
    commands,
    files,
    channels,
    units,
    manoeuvres,
    courses,
    settings,
    figures,
    excerpt,
    leaderboard,
    wheelbase_of_small_cars,
    benchmarks,
    workflow,
    launchers,
)
PARTS: dict[str, Callable[..., Iterable[str]]] = {part.__name__: part for part in _PARTS}

if __name__ == "__main__":
    main()
