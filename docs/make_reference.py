"""Write docs/reference.md, docs/channels.md and docs/manoeuvres.md from the code, and from published results two tables of
docs/results.md and the figures of each family in docs/estimators/.

Run by ``make docs``; tests/test_docs.py checks that the pages are up to date.
"""

from __future__ import annotations

import csv
import inspect
import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import typer

ROOT = Path(__file__).resolve().parents[1]
MADE = "<!-- Made by docs/make_reference.py (make docs); changes belong in the code. -->"
BOARD_START = "<!-- leaderboard: made by docs/make_reference.py from results/ferrari_drive -->"
BOARD_END = "<!-- end of leaderboard -->"
BOARD_SOURCE = "results/ferrari_drive/tables/leaderboard_test.csv"
ACROSS_START = "<!-- across vehicles: made by docs/make_reference.py from results/ksnn -->"
ACROSS_END = "<!-- end of across vehicles -->"
ACROSS_SOURCE = "results/ksnn/tables/overview.csv"

FIGURES_START = re.compile(r"<!-- figures of (\w+)/(\w+): made by docs/make_reference.py from results -->")  # study and figure
FIGURES_END = "<!-- end of figures -->"
SETTINGS_START = "<!-- settings: made by docs/make_reference.py from what the families declare -->"
SETTINGS_END = "<!-- end of settings -->"
BASELINES = ("zero", "static_map")

GROUPS = ("estimator", "training", "dataset", "split", "vehicle", "fault", "tracking")
COMMON = 4  # commands from which on an option is listed once for all
TYPER_OWN = {"install_completion", "show_completion", "help"}


def pages(root: Path = ROOT) -> dict[Path, str]:
    """Every page that is made here, by its path: what it should hold."""
    results = root / "docs" / "results.md"
    return {
        root / "docs" / "reference.md": reference_page(root),
        root / "docs" / "channels.md": channels_page(),
        root / "docs" / "manoeuvres.md": manoeuvres_page(root),
        results: with_overview(with_leaderboard(results.read_text(encoding="utf-8"), root / BOARD_SOURCE), root / ACROSS_SOURCE),
        **{path: family_page(path, root) for path in _family_pages(root)},
    }


def reference_page(root: Path) -> str:
    """Commands, configuration files and pipelines."""
    parts = [
        "# Reference",
        MADE,
        "Every option of a command and every configuration file. How they belong together: [cli.md](cli.md).",
        "## Commands",
        *_commands(),
        "## Configuration",
        "Options of a command are set as `key=value` after it; each file says in comments what its keys mean. "
        "`vehest config COMMAND` prints all of them, resolved.",
        "### `conf/`",
        _files(root, [root / "conf"]),
    ]
    for group in GROUPS:
        folders = [root / "conf" / group, root / "src" / "vehest_papers" / "conf" / group]
        parts += [f"### `conf/{group}/`", f"Choices of `{group}=NAME`:", _files(root, folders)]
    parts += ["## Pipelines", "Studies that `vehest run` and `vehest report` take:", _files(root, [root / "pipelines"])]
    return "\n\n".join(parts) + "\n"


def channels_page() -> str:
    """Channels, units, and the errors of simulated sensors."""
    from vehest.data import units
    from vehest.data.channels import CHANNELS

    channels = [
        (f"`{c.name}`", c.unit, c.meaning, f"{c.low:g} … {c.high:g}" if abs(c.low) != 3.141592653589793 else "-π … π")
        for c in CHANNELS.values()
    ]
    conversions: dict[str, list[str]] = {}
    for unit, (si, factor) in units._UNITS.items():
        conversions.setdefault(si, []).append(f"`{unit}`" + (f" × {factor:.10g}" if factor != 1.0 else ""))
    parts = [
        "# Channels, units and simulated sensors",
        MADE,
        "Look up a channel's name, sign and possible range, what `unit:` may say in a data set, and how simulated sensors err.",
        "## Channels",
        "Units are SI, angles are radians. Axes are those of ISO 8855: x forward, y left, z up, counter-clockwise positive; a left turn "
        "has positive `steer`, `yaw_rate` and `ay`. Channels that end in `_ref` come from a reference sensor; estimators never see them. "
        "A value outside the range is reported by `vehest data check` and stops an ingest.",
        _table(("channel", "unit", "meaning", "possible range"), channels),
        "## Units",
        "What `unit:` may say in conf/dataset, with the factor by which values are multiplied.",
        _table(("unit of channels", "may be given as"), [(si, ", ".join(dict.fromkeys(given))) for si, given in conversions.items()]),
        *_simulated_sensors(),
    ]
    return "\n\n".join(parts) + "\n"


def _manoeuvre(name: str, made: type[Any]) -> list[str]:
    """Heading, meaning and parameters of one manoeuvre."""
    described = _sections(made)
    rows = [(f"`{field.name}`", f"`{_as_yaml(field.default)}`", described.get(field.name, "")) for field in fields(made)]
    return [f"### `{name}`", described[""], _table(("parameter", "default", "meaning"), rows)]


def manoeuvres_page(root: Path) -> str:
    """Manoeuvres of the proving ground with their parameters, and its courses."""
    from vehest.simulation.driving.manoeuvres import MANOEUVRES
    from vehest.simulation.planar_drive import PLANAR_MANOEUVRES
    from vehest.simulation.road import tracks
    from vehest.simulation.road.course import course_by_name

    parts = [
        "# Manoeuvres and courses of the proving ground",
        MADE,
        "Look up what a simulated drive can do and on which course; how a data set names them: "
        "[sources/simulated.md](sources/simulated.md).",
        "## Manoeuvres",
        "A parameter with a pair as its default is a range: give a number, or a pair from which every drive draws, uniformly. `severity` "
        "is the share of the grip that the driver means to use, on the surface of the drive.",
    ]
    for name, made in sorted(MANOEUVRES.items()):
        parts += _manoeuvre(name, made)
    parts.append("## Manoeuvres of the planar plant's cars")
    for name, free in sorted(PLANAR_MANOEUVRES.items()):
        parts += _manoeuvre(name, free)
    courses = [(name, course_by_name(name)) for name in tracks.LAYOUTS]
    parts += [
        "## Courses",
        _table(
            ("course", "length [m]", "smallest radius [m]", "bank up to [deg]"),
            [
                (f"`{name}`", f"{c.length:.0f}", f"{1.0 / abs(c.curvature).max():.0f}", f"{math.degrees(abs(c.bank).max()):.1f}")
                for name, c in courses
            ],
            right=3,
        ),
        "Where their layouts come from: `vehest.simulation.road.tracks`.",
        "Vehicles, with the source of every value: [reference.md](reference.md#confvehicle).",
    ]
    return "\n\n".join(parts) + "\n"


def _as_yaml(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_as_yaml(entry) for entry in value)}]"
    if isinstance(value, float):
        return f"{value:.6g}"
    return {None: "null", True: "true", False: "false"}.get(value, str(value)) if value is None or isinstance(value, bool) else str(value)


def _sections(described: type) -> dict[str, str]:
    """A docstring's first paragraph, under the empty name, and its arguments by name."""
    text = inspect.getdoc(described) or ""
    sections = {"": " ".join(text.split("\n\n")[0].split())}
    if "Args:" in text:
        for entry in re.split(r"\n    (?=\w)", text.split("Args:")[1].split("\n\n")[0]):
            names, _, meaning = " ".join(entry.split()).replace("``", "`").partition(": ")
            if names:
                sections |= dict.fromkeys(names.split(", "), meaning)
    return sections


def _simulated_sensors() -> Iterable[str]:
    from vehest.simulation.sensors.levels import PRESETS, REFERENCES, SensorLevels

    header = ("sensor", "noise [/√Hz]", "offset", "drift (time)", "step", "delay [ms]", "scale [%]")
    references = (REFERENCES["gnss"], REFERENCES["optical"], REFERENCES["motion_capture"])
    levers = ("lever_x", "lever_y", "lever_z", "lever_error")
    yield "## Simulated sensors"
    yield (
        "`shown = quantise((1 + gain)(1 + scale) true(t - delay) + bias + offset + drift(t) + noise(t))`, in the channel's unit. "
        "`gain` and `bias` belong to the car, the same in each of its drives. Noise is a density: at a rate of f Hz it is the √(f/2)-fold "
        "as standard deviation of a sample, 7.07 times at 100 Hz. Offset and scale are drawn for each drive, with these standard "
        "deviations; drift is a first-order Gauss-Markov process of this standard deviation and correlation time. Each error of each "
        "sensor has a random stream of its own: what one level is changes no other sample."
    )
    yield (
        "`imu` is where the gyros and accelerometers sit (`lever_x`, `lever_y`, `lever_z` from the centre of gravity [m]) and how they are "
        "turned (`roll`, `pitch`, `yaw`, and a `misalignment` drawn for each of the three [rad]). `tilt` says which of `roll` and `pitch` "
        "of the body, `bank` and `grade` of the road let gravity into the accelerometers. Roll and pitch themselves are not measured."
    )
    yield (
        "A data set says `sensors: default`, `race`, `small_car` or `ideal` (no errors, the road's axes), or changes a preset. `off` "
        "takes a whole sensor's errors away, `switched_off` names single ones; `*` stands for all sensors but the reference:"
    )
    yield (
        "```yaml\nsensors:\n  preset: race\n  reference: optical\n  ay: {noise: 0, offset: 0.05}\n  steer: off\n  tilt: {bank: off}\n"
        '  imu: {lever_x: 0.3}\n  switched_off: [vx.delay, "*.drift"]\n```'
    )
    yield "### `sensors: default`"
    yield f"Production sensors. {_mounting(PRESETS['default'].imu)}"
    yield _table(header, _sensor_rows(PRESETS["default"]))
    yield "Where the numbers come from:"
    yield "\n".join(f"- {line}" for line in _arguments(SensorLevels))
    yield "### `sensors: race`"
    yield f"A race car of the sixties with good instruments, as in the Ferrari recording. {_mounting(PRESETS['race'].imu)}"
    yield _table(header, _sensor_rows(PRESETS["race"], PRESETS["default"]))
    yield (
        "Read off the recording by `read_off` of `vehest_papers.proving_ground.noise_reading`: the noise of `vx`, `yaw_rate`, `ax`, `ay` "
        "and `steer` (median spectral density above 10 Hz; the body's shaking is part of it), the step of `steer`, the delay of "
        "`yaw_rate`, `ax` and `ay` against the reference's velocities, and of `ax` and `ay` the offset and the drift (mean, and what is "
        "left below 0.5 Hz, of the reference's accelerations less theirs when delays, white noise, roll and pitch are taken out; a "
        "banked road is part of it). How `imu` is turned is part of the offsets. All else is assumed; sensors that are not listed are "
        "those of `default`."
    )
    yield "### `sensors: small_car`"
    vibration = PRESETS["small_car"].vibration
    shaken = ", ".join(f"`{field.name}` {getattr(vibration, field.name):g}" for field in fields(vibration))
    yield f"A model race car of 5 kg, as in the F1TENTH recordings. {_mounting(PRESETS['small_car'].imu)}"
    yield _table(header, _sensor_rows(PRESETS["small_car"], PRESETS["default"]))
    yield (
        f"Its inertial unit shakes with the wheels: `vibration` adds white noise whose standard deviation is, per rad/s of the wheels' "
        f"mean speed, {shaken}. These and what the comments in `vehest.simulation.sensors.levels` name are read off the recording that the "
        "learned-dynamics UKF trains on; the rest is assumed, and what is not listed is that of `default`."
    )
    yield "### `reference: gnss`, `reference: optical` and `reference: motion_capture`"
    yield (
        "Where `vx_ref`, `vy_ref`, `yaw_rate_ref` and `sideslip_ref` come from; `gnss` belongs to `default` and `race`, `motion_capture` "
        "to `small_car`. The sensor measures velocity where it sits, in axes turned by the error `heading` [rad], and moves it to the "
        "centre of gravity with its own yaw rate and a lever known to `lever_error`. The sources stand beside the numbers in "
        "`vehest.simulation.sensors.levels`."
    )
    yield _table(("reference", *header), [(f"`{r.kind}`", *row) for r in references for row in _sensor_rows(r)])
    rows = [(f"`{r.kind}`", *(f"{getattr(r, lever):g}" for lever in levers)) for r in references]
    yield _table(("reference", *(f"`{lever}` [m]" for lever in levers)), rows)


def _sensor_rows(levels: Any, listed: Any = None) -> Iterable[tuple[str, ...]]:
    """A row for the sensors of equal levels among the fields of a dataclass, less those that another one lists."""
    from vehest.simulation.sensors.levels import SensorLevel

    rows: dict[tuple[str, ...], list[str]] = {}
    for field in fields(levels):
        level = getattr(levels, field.name)
        if isinstance(level, SensorLevel) and level != getattr(listed, field.name, None):
            drift = f"{level.drift:g} ({level.drift_time:g} s)" if level.drift else "0"
            rest = (f"{level.quantisation:g}", f"{1e3 * level.delay:g}", f"{1e2 * level.scale:g}")
            rows.setdefault((f"{level.noise:g}", f"{level.offset:g}", drift, *rest), []).append(f"`{field.name}`")
    for values, names in rows.items():
        yield ", ".join(names), *values


def _mounting(imu: Any) -> str:
    place = ", ".join(f"`{field.name}` {getattr(imu, field.name):g}" for field in fields(imu) if getattr(imu, field.name))
    return f"`imu`: {place}; the rest is zero." if place else "`imu`: all zero."


def _arguments(described: type) -> Iterable[str]:
    """What a dataclass's docstring says about its sensors, a line each."""
    text = inspect.getdoc(described) or ""
    for entry in re.split(r"\n    (?=\w)", text.split("Args:")[1].split("\nRaises:")[0]):
        names, _, meaning = " ".join(entry.split()).partition(": ")
        if names.split(", ")[0] in {field.name for field in fields(described)}:
            yield f"{', '.join(f'`{name}`' for name in names.split(', '))}: {meaning}"


def _family_pages(root: Path) -> list[Path]:
    """Pages of families that show a figure of a study."""
    return [page for page in sorted((root / "docs" / "estimators").glob("*.md")) if SETTINGS_START in page.read_text(encoding="utf-8")]


def family_page(path: Path, root: Path) -> str:
    """The page of the families that its title names, with what published studies say of them."""
    text = path.read_text(encoding="utf-8")
    estimators = re.findall(r"`(\w+)`", text.partition("\n")[0])
    tables = list(_settings(estimators))
    text = _between(text, SETTINGS_START, SETTINGS_END, "\n" + "\n\n".join(tables) + "\n")
    start = FIGURES_START.search(text)
    if start is None:
        return text
    study, figure = start.groups()
    parts = [*_on_test_sets(estimators, root), *_in_study(study, root), *_shown(study, figure, root)]
    return _between(text, start.group(), FIGURES_END, "\n" + "\n\n".join(parts) + "\n")


def _settings(estimators: Sequence[str]) -> Iterable[str]:
    """Settings and fitted numbers of families, as their classes declare them; many that an earlier one has too are only named."""
    from vehest.estimators.registry import estimator_class

    listed: set[tuple[str, ...]] = set()
    for name in estimators:
        rows = list(_declared(estimator_class(name).settings_type(), ""))
        same = [row[0] for row in rows if row in listed]
        if len(same) > 3:
            yield f"`{name}`, besides {', '.join(same)} as above:"
            rows = [row for row in rows if row not in listed]
        elif len(estimators) > 1:
            yield f"`{name}`:"
        listed.update(rows)
        yield _table(("`estimator.`", "default", "unit", "meaning"), rows)


def _declared(settings: Any, above: str) -> Iterable[tuple[str, str, str, str]]:
    from vehest.declared import Group, declaration

    for field in fields(settings):
        value, declared = getattr(settings, field.name), declaration(field)
        if isinstance(value, Group):
            yield from _declared(value, f"{above}{field.name}.")
        elif declared is not None:
            default = "fitted" if declared.is_fitted else "[…]" if is_dataclass(value) else f"`{_as_yaml(value)}`"
            yield f"`{above}{field.name}`", default, declared.unit, declared.doc


def _rows(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with open(path, newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def _on_test_sets(estimators: Sequence[str], root: Path) -> list[str]:
    """RMSE(β) with its interval on every test set of `ferrari_drive` and `leave_one_out`, a column a variant, baselines last."""
    parts = []
    for study, said in {"ferrari_drive": "learnt on the same drive", "leave_one_out": "learnt on other vehicles only"}.items():
        files = sorted((root / "results" / study / "tables").glob("leaderboard_*.csv"))
        own = [row for file in files if not file.stem.endswith("_seeds") for row in _rows(file) if row["rmse_sideslip"]]
        titles: dict[str, str] = {}
        for wanted in (*estimators, *(name for name in BASELINES if name not in estimators)):
            titles |= {_title(row): wanted for row in own if row["estimator"] == wanted}
        if not any(wanted in estimators for wanted in titles.values()):
            continue
        tests: dict[str, dict[str, str]] = {}
        for row in own:
            where = f"{row['title']}, {row['test_set']}" if "estimator_title" in row else "Ferrari 250 LM (real), 550 to 700 s"
            tests.setdefault(where, {})[_title(row)] = f"{float(row['rmse_sideslip']):.3f} [{row['interval'].replace(' … ', ', ')}]"
        shown = {where: cells for where, cells in tests.items() if any(titles.get(title) in estimators for title in cells)}
        parts.append(f"RMSE(β) [deg] with its 95 % interval, {said} ([{study}](../../results/{study}/report.md)):")
        parts.append(
            _table(
                ("test", *titles),
                [(where, *(cells.get(title, "–") for title in titles)) for where, cells in shown.items()],
                right=len(titles),
            )
        )
    return parts


def _title(row: dict[str, str]) -> str:
    return row.get("estimator_title") or row["title"]


def _in_study(study: str, root: Path) -> list[str]:
    """The overview of the study that re-creates a family's paper, as far as it has one of its own."""
    headers = {
        "heavy_ekf": (
            "RMSE(β) [deg], the truck **simulated**",
            {"test": "test", **{key: key for key in ("LINT", "RATT", "RATTE", "RATT with friction", "zero", "static map")}},
        ),
        "cnn_ukf": (
            "Squared errors of β [deg²] over all samples and over those from 4 m/s² on, **simulated** cars, medians of seeds",
            {"part": "learnt on", "candidate": "method", "ours_mse": "MSE", "ours_mse_nonlinear": "MSE_nl", "n_seeds": "seeds"},
        ),
        "learned_ukf": (
            "Weighted squared error of the states, **real** recordings, means over seeds; D is a tyre that none has seen",
            {"candidate": "method", "ours_tyre_a": "tyre A", "ours_tyre_d": "tyre D", "n_seeds": "seeds"},
        ),
    }
    rows = _rows(root / "results" / study / "tables" / "overview.csv")
    if study not in headers or not rows:
        return []
    said, columns = headers[study]
    text = [tuple(_rounded(row[key]) for key in columns) for row in rows]
    return [f"{said} ([{study}](../../results/{study}/report.md)):", _table(tuple(columns.values()), text)]


def _rounded(cell: str) -> str:
    return f"{float(cell):.3f}" if re.fullmatch(r"-?\d+\.\d+", cell) else cell


def _shown(study: str, figure: str, root: Path) -> list[str]:
    """A published figure with what its report says of it."""
    report = root / "results" / study / "report.md"
    found = re.search(rf"!\[([^\]]*)\]\(figures/{figure}\.png\)", report.read_text(encoding="utf-8")) if report.is_file() else None
    if not found:
        return []
    return [
        f"![{found[1]}](../../results/{study}/figures/{figure}.png)",
        f"{found[1]} From [results/{study}](../../results/{study}/report.md).",
    ]


def with_leaderboard(page: str, source: Path) -> str:
    """A page with the leaderboard that is in results/; as it is where there are no results."""
    rows = _rows(source)
    if not rows:
        return page
    lines = [
        (
            row["title"],
            f"{float(row['n_parameters']):.0f}",
            f"{float(row['rmse_sideslip']):.3f}",
            row["interval"],
            row["against_best"],
            row["beats_zero"] or "–",
            row["beats_static_map"] or "–",
            f"{float(row['fvu']):.3f}",
        )
        for row in rows
    ]
    header = (
        "estimator",
        "parameters",
        "RMSE(β) [deg]",
        "95 % interval [deg]",
        "to the lowest [deg]",
        "beats v = 0",
        "beats static map",
        "FVU",
    )
    table = _table(header, lines, right=7)
    return _between(page, BOARD_START, BOARD_END, table)


def with_overview(page: str, source: Path) -> str:
    """A page with what the study across vehicles came to; as it is where there are no results."""
    rows = _rows(source)
    if not rows:
        return page
    lines = []
    for model in dict.fromkeys(row["model"] for row in rows):
        own = [row for row in rows if row["model"] == model]
        lines.append((model, *(f"{float(row[key]):.3f}" if row[key] else "–" for row in own for key in ("paper_fvu_other", "fvu_other"))))
    header = (
        "estimator",
        *(f"{scheme.lower()}, {who}" for scheme in dict.fromkeys(row["scheme"] for row in rows) for who in ("paper", "ours")),
    )
    return _between(page, ACROSS_START, ACROSS_END, _table(header, lines, right=len(header) - 1))


def _between(text: str, start: str, end: str, content: str) -> str:
    before, rest = text.split(start)
    return f"{before}{start}\n{content}\n{end}{rest.split(end)[1]}"


def _commands() -> Iterable[str]:
    from vehest.cli import app

    root: Any = typer.main.get_command(app)
    leaves = list(_leaves(root, ("vehest",)))
    counts = Counter(row for _, command in leaves for row in _parameters(command))
    common = {row for row, count in counts.items() if count >= COMMON}
    header = ("argument or option", "meaning")
    yield _paragraphs(root.help)
    yield f"{root.epilog} `-h` and `--help` explain every command; `--install-completion` sets up tab completion."
    yield "### Common options"
    yield _table(header, [*_parameters(root), *(row for row in counts if row in common)])
    for words, command in leaves:
        arguments = [_argument(p) for p in command.params if p.param_type_name == "argument"]
        rows = _parameters(command)
        yield f"### `{' '.join(words)}`"
        yield f"```text\n{' '.join([*words, *arguments, '[OPTIONS]'])}\n```"
        yield _paragraphs(command.help)
        own = [row for row in rows if row not in common]
        if own:
            yield _table(header, own)
        if len(own) < len(rows):
            yield f"{'Also' if own else 'Takes'} {', '.join(row[0] for row in rows if row in common)}."


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
        shown = f" Default: `{default}`." if not (default is None or isinstance(default, bool) or callable(default)) else ""
        rows.append((name, f"{parameter.help}{shown}"))
    return rows


def _files(root: Path, folders: Sequence[Path]) -> str:
    """A row for each YAML file of some folders: a link, and the first sentence of its comment."""
    files = sorted((file for folder in folders for file in folder.glob("*.yaml")), key=lambda file: file.name)
    rows = [(f"[`{file.stem}`](../{file.relative_to(root).as_posix()})", _first_sentence(_first_comment(file))) for file in files]
    return _table(("file", "content"), rows)


def _first_sentence(text: str) -> str:
    return re.split(r"(?<=\.)\s+(?=[A-Z])", text, maxsplit=1)[0]


def _first_comment(file: Path) -> str:
    comments = []
    for line in file.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        if "@package" not in line:
            comments.append(line.lstrip("# ").rstrip())
    return " ".join(comments)


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
