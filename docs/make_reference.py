"""Write the pages that are made from the code: docs/reference.md, docs/channels.md, and the leaderboard in README.md.

Run by ``make docs``; tests/test_docs.py sees that the pages are up to date.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import typer

ROOT = Path(__file__).resolve().parents[1]
MADE = "<!-- Made by docs/make_reference.py (make docs); changes belong in the code. -->"
BOARD_START = "<!-- leaderboard: made by docs/make_reference.py from results/ferrari_drive -->"
BOARD_END = "<!-- end of leaderboard -->"
BOARD_SOURCE = "results/ferrari_drive/tables/leaderboard_test.csv"

ROOT_FILES = ("common", "ingest", "downsample", "train", "eval", "estimate")
TABLED = ("estimator", "training", "tracking")
VERBATIM = ("dataset", "split", "vehicle")
TYPER_OWN = {"install_completion", "show_completion", "help"}


def pages(root: Path = ROOT) -> dict[Path, str]:
    """Every page that is made here, by its path: what it should hold."""
    readme = root / "README.md"
    return {
        root / "docs" / "reference.md": reference_page(root),
        root / "docs" / "channels.md": channels_page(),
        readme: with_leaderboard(readme.read_text(encoding="utf-8"), root / BOARD_SOURCE),
    }


def reference_page(root: Path) -> str:
    """Commands, configuration files and pipelines."""
    parts = [
        "# Reference",
        MADE,
        "Every command with its options, every configuration file with its values, every pipeline. What they are for: [cli.md](cli.md).",
        "## Commands",
        *_commands(),
        "## Configuration",
        "Options of a command are set as `key=value` after it. `vehest config COMMAND` prints all of them, resolved.",
        *_roots(root),
        *_groups(root),
        "## Pipelines",
        "What `vehest run` and `vehest report` take.",
    ]
    for file in sorted((root / "pipelines").glob("*.yaml")):
        parts += [f"### `pipelines/{file.name}`", _fenced(file)]
    return "\n\n".join(parts) + "\n"


def channels_page() -> str:
    """Channels, units, the errors of simulated sensors, and metrics."""
    from vehest.data import units
    from vehest.data.channels import CHANNELS
    from vehest.evaluation.metrics import UNITS
    from vehest.simulation.sensors import SensorLevel, SensorLevels

    channels = [
        (f"`{c.name}`", c.unit, c.meaning, f"{c.low:g} … {c.high:g}" if abs(c.low) != 3.141592653589793 else "-π … π")
        for c in CHANNELS.values()
    ]
    conversions = [(f"`{unit}`", si, f"{factor:.10g}") for unit, (si, factor) in units._UNITS.items()]
    levels = [(field.name, getattr(SensorLevels(), field.name)) for field in fields(SensorLevels)]
    sensors = [(f"`{name}`", f"{level.noise:g}", f"{level.offset:g}") for name, level in levels if isinstance(level, SensorLevel)]
    parts = [
        "# Channels, units and metrics",
        MADE,
        "## Channels",
        "Units are SI, angles are radians. Axes are those of ISO 8855: x forward, y left, z up, counter-clockwise positive; a left turn "
        "has positive `steer`, `yaw_rate` and `ay`. Channels that end in `_ref` come from a reference sensor; estimators never see them. "
        "A value outside the range is reported by `vehest data check` and stops an ingest.",
        _table(("channel", "unit", "meaning", "possible range"), channels),
        "## Units",
        "What `unit:` may say in conf/dataset; values are multiplied by the factor.",
        _table(("unit", "becomes", "factor"), conversions),
        "## Simulated sensors",
        "Standard deviations of the white noise of each sample and of the constant offset that a drive's sensor has, with "
        "`sensors: default`, in the channel's unit. `wheel_speed` stands for all four wheels. With `sensors: ideal` all are zero.",
        _table(("sensor", "noise", "offset"), sensors),
        "## Metrics",
        "Names and units in `metrics.csv`; definitions: [estimators.md](estimators.md#metrics).",
        _table(("metric", "unit"), [(f"`{name}`", unit) for name, unit in UNITS.items()]),
    ]
    return "\n\n".join(parts) + "\n"


def with_leaderboard(readme: str, source: Path) -> str:
    """The README with the leaderboard that is in results/; as it is where there are no results."""
    if not source.is_file():
        return readme
    with open(source, newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    lines = [
        (
            row["title"],
            f"{float(row['n_parameters']):.0f}",
            f"{float(row['rmse_sideslip']):.3f}",
            f"{float(row['rmse_sideslip_min']):.3f} … {float(row['rmse_sideslip_max']):.3f}" if int(row["n_seeds"]) > 1 else "–",
            f"{float(row['rmse_vy']):.3f}",
            f"{float(row['fvu']):.3f}",
        )
        for row in rows
    ]
    table = _table(("estimator", "parameters", "RMSE(β) [deg]", "over seeds [deg]", "RMSE(v) [m/s]", "FVU"), lines, right=5)
    before, rest = readme.split(BOARD_START)
    after = rest.split(BOARD_END)[1]
    return f"{before}{BOARD_START}\n{table}\n{BOARD_END}{after}"


def _commands() -> Iterable[str]:
    from vehest.cli import app

    root: Any = typer.main.get_command(app)
    yield _paragraphs(root.help)
    yield _parameters(root)
    yield f"{root.epilog} `-h` and `--help` explain every command; `--install-completion` sets up tab completion."
    for words, command in _leaves(root, ("vehest",)):
        arguments = [_argument(p) for p in command.params if p.param_type_name == "argument"]
        usage = " ".join([*words, *arguments, "[OPTIONS]"])
        yield f"### `{' '.join(words)}`"
        yield f"```text\n{usage}\n```"
        yield _paragraphs(command.help)
        yield _parameters(command)


def _leaves(group: Any, words: tuple[str, ...]) -> Iterable[tuple[tuple[str, ...], Any]]:
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from _leaves(command, (*words, name))
        else:
            yield (*words, name), command


def _argument(parameter: Any) -> str:
    name = parameter.name.upper()
    return f"[{name}]..." if parameter.nargs == -1 else name


def _parameters(command: Any) -> str:
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
        shown = f" Default: `{default}`." if not (default is None or isinstance(default, bool) or callable(default)) else ""
        rows.append((name, f"{parameter.help}{shown}"))
    return _table(("argument or option", "meaning"), rows)


def _roots(root: Path) -> Iterable[str]:
    for name in ROOT_FILES:
        file = root / "conf" / f"{name}.yaml"
        yield f"### `conf/{name}.yaml`"
        yield _first_comment(file)
        groups = _default_groups(file)
        if groups:
            yield "Starts from " + ", ".join(groups) + "."
        rows = list(_options(file))
        if rows:
            yield _table(("option", "default", "meaning"), rows)


def _groups(root: Path) -> Iterable[str]:
    for group in (*TABLED, *VERBATIM):
        yield f"### `conf/{group}/`"
        for file in sorted((root / "conf" / group).glob("*.yaml")):
            yield f"#### `conf/{group}/{file.name}`" if group == "vehicle" else f"#### `{group}={file.stem}`"
            if group in VERBATIM:
                yield _fenced(file)
                continue
            yield _first_comment(file)
            forced = re.search(r"override /(\w+): (\w+)", file.read_text(encoding="utf-8"))
            if forced:
                yield f"Chooses `{forced[1]}={forced[2]}`."
            rows = [row for row in _options(file, group) if not row[0].endswith(".name`")]
            if rows:
                yield _table(("option", "default", "meaning"), rows)


def _options(file: Path, prefix: str = "") -> Iterable[tuple[str, str, str]]:
    """Scalar options of a file with their dotted keys, defaults and comments."""
    lines = file.read_text(encoding="utf-8").splitlines()
    if any("@package _global_" in line for line in lines):
        prefix = ""
    above: list[tuple[int, str]] = []  # indentation and name of the groups that a line stands in
    skipping = False
    for line in lines:
        found = re.match(r"^(\s*)(\w+):\s*(.*?)\s*(?:(?<=\s)#\s*(.*))?$", line)
        if not found:
            continue
        indent, key, value, comment = found.groups()
        if not indent:
            skipping = key == "defaults"
        if skipping:
            continue
        above = [(depth, group) for depth, group in above if depth < len(indent)]
        if value:
            dotted = ".".join(filter(None, [prefix, *(group for _, group in above), key]))
            yield f"`{dotted}`", f"`{value}`", comment or ""
        else:
            above.append((len(indent), key))


def _default_groups(file: Path) -> list[str]:
    text = file.read_text(encoding="utf-8")
    block = re.search(r"^defaults:\n((?:  .*\n)+)", text, re.MULTILINE)
    entries = re.findall(r"^  - ([\w/@]+)(?:: (\S+))?", block[1], re.MULTILINE) if block else []
    return [f"`{key}={value}`" if value else f"`conf/{key}.yaml`" for key, value in entries if key != "_self_"]


def _first_comment(file: Path) -> str:
    comments = []
    for line in file.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        if "@package" not in line:
            comments.append(line.lstrip("# ").rstrip())
    return " ".join(comments)


def _fenced(file: Path) -> str:
    return f"```yaml\n{file.read_text(encoding='utf-8').rstrip()}\n```"


def _paragraphs(text: str | None) -> str:
    return "\n\n".join(" ".join(part.split()) for part in (text or "").split("\n\n"))


def _table(header: Sequence[str], rows: Iterable[Sequence[str]], right: int = 0) -> str:
    """A Markdown table; the last ``right`` columns are aligned to the right."""
    rules = [":--"] * (len(header) - right) + ["--:"] * right
    lines = [header, rules, *([cell.replace("|", "\\|") for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    """Write the pages that have changed and name them."""
    for path, text in pages().items():
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
            print(path.relative_to(ROOT))


if __name__ == "__main__":
    main()
