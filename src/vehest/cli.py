"""The command line: one thin function a command; what is heavy is imported inside it."""

from __future__ import annotations

import io
import json
import math
import os
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from vehest.data.errors import ConfigurationError, DataError, MissingError, is_printable, printable
from vehest.run.config_files import GROUPS, choices, is_simulated, pipeline_names, summary
from vehest.run.launchers.options import LAUNCHERS, LauncherOptions
from vehest.version import __version__

if TYPE_CHECKING:
    from vehest.run.config import Config
    from vehest.run.run_cache import Ran

app = typer.Typer(
    name="vehest",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Train, run and compare published estimators of a car's lateral velocity and sideslip angle.\n\n"
    "Options of a command are set by overrides after it: `vehest train estimator=ksnn estimator.n_local=3 seed=7`.",
    epilog="Exit codes: 0 done, 1 defect of vehest, 2 wrong usage or configuration, 3 unusable data, 4 something is missing, "
    "5 some jobs failed, 130 or 143 stopped by a signal.",
)
data_app = typer.Typer(no_args_is_help=True, help="Look at data sets, recordings and channels.")
app.add_typer(data_app, name="data")

ROOT_KEYS = ("root", "output", "seed", "rate_hz")
EARLIEST_UNIX, LATEST_UNIX = 6e8, 4e9  # s, 1989 to 2096: time stamps of recordings in between count from 1970
LONGEST_LINE = 4_000
MOST_ATTEMPTS = 5  # at an answer
MOST_COLUMNS = 40  # of a table that are listed
COMMANDS = ("ingest", "downsample", "train", "eval", "estimate")


def _offered(*groups: str) -> str:
    """Epilog that lists the choices of groups."""
    return "\n\n".join(f"**{group}**: {', '.join(choices(group))}" for group in groups)


def _completing(command: str) -> Callable[[typer.Context, str], list[tuple[str, str]]]:
    """Completion of a command's overrides."""

    def complete(context: typer.Context, incomplete: str) -> list[tuple[str, str]]:
        from vehest.run.completion import complete_override

        given = [str(word) for word in context.params.get("overrides") or []]
        if context.params.get("check"):
            return [(name, "") for name in _complete_pipeline(incomplete)]
        own = str(context.params.get("command") or command)
        dataset = context.params.get("dataset")
        chosen = [f"dataset={dataset}"] if dataset else []
        if own == "simulate":
            short = [("seed=0", "short for dataset.seed")] if "seed=0".startswith(incomplete) else []
            return short + complete_override("ingest", chosen + given, incomplete)
        return complete_override(own, chosen + given, incomplete)

    return complete


def _complete_dataset(incomplete: str) -> list[tuple[str, str]]:
    return [(name, summary("dataset", name)) for name in choices("dataset") if name.startswith(incomplete)]


def _complete_simulated(incomplete: str) -> list[tuple[str, str]]:
    return [(name, note) for name, note in _complete_dataset(incomplete) if is_simulated(name)]


def _complete_pipeline(incomplete: str) -> list[str]:
    return [name for name in pipeline_names() if name.startswith(incomplete)]


def _complete_command(incomplete: str) -> list[str]:
    return [name for name in COMMANDS if name.startswith(incomplete)]


def _complete_model(incomplete: str) -> list[str]:
    output = Path(os.environ.get("VEHEST_OUTPUT", "outputs"))
    return [folder.name for folder in sorted((output / "train").glob(f"{Path(incomplete).name}*")) if not folder.name.startswith(".")]


def _complete_model_or_file(incomplete: str) -> list[str]:
    before = incomplete[: incomplete.rfind("/") + 1]
    files = [f"{before}{file.name}" for file in sorted(Path(before).glob("*")) if file.suffix.lower() in (".csv", ".parquet")]
    return _complete_model(incomplete) + [file for file in files if file.startswith(incomplete)]


DryRun = Annotated[bool, typer.Option("--dry-run", help="Say what would run and what would be skipped; run nothing.")]
Force = Annotated[bool, typer.Option("--force", help="Run although the outcome is there already.")]
DatasetOrFile = Annotated[
    str,
    typer.Argument(help="A data set, or a file: a table, or with dataset=NAME what that one reads.", autocompletion=_complete_dataset),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the outcome as one JSON object on standard output.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but warnings and the outcome.")]
Jobs = Annotated[int | None, typer.Option("--jobs", "-j", min=1, help="Processes that run side by side; by default one a core.")]
LauncherName = Annotated[
    str,
    typer.Option(
        "--launcher",
        help="Where trainings run: local, on this machine's cores; ray, on a Ray cluster; slurm, as SLURM jobs (docs/many_machines.md).",
        autocompletion=lambda incomplete: [name for name in LAUNCHERS if name.startswith(incomplete)],
    ),
]
Address = Annotated[
    str | None,
    typer.Option(
        "--address",
        help="With --launcher ray: HOST:PORT of the cluster, or auto for the one this machine is part of. "
        "By default RAY_ADDRESS, else a Ray of its own on this machine. With --launcher slurm: local, to try it here.",
        show_default=False,
    ),
]
Slurm = Annotated[
    list[str] | None,
    typer.Option(
        "--slurm",
        help="With --launcher slurm, NAME=VALUE of what a job asks for: partition, account, qos, constraint, minutes (60), memory_gb (2). "
        "Repeatable.",
        show_default=False,
    ),
]
Dataset = Annotated[str, typer.Argument(help="Name of a file in conf/dataset.", autocompletion=_complete_dataset)]


def _overrides(command: str) -> Any:
    return typer.Argument(help="key=value …, in Hydra's grammar.", autocompletion=_completing(command), show_default=False)


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="Print the version and leave.", is_eager=True)] = False) -> None:
    if version:
        _echo(f"vehest {__version__}")
        raise typer.Exit


@app.command("new")
def new_car(
    name: Annotated[str, typer.Argument(help="Name of the data set to be, such as my_car.", show_default=False)],
    files: Annotated[list[Path], typer.Argument(help="Logs of one car with the same columns, a recording each.", show_default=False)],
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Take what is proposed, ask nothing, and list what was left open.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Write files anew that are there already.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be written; write nothing.")] = False,
    answer: Annotated[
        list[str] | None,
        typer.Option("--answer", "-a", help="KEY=ANSWER beforehand, as --json names what is open; repeatable."),
    ] = None,
    wheelbase: Annotated[float | None, typer.Option("--wheelbase", min=0.0, help="Of the car [m].")] = None,
    mass: Annotated[float | None, typer.Option("--mass", min=0.0, help="Of the car [kg].")] = None,
    steering_ratio: Annotated[float | None, typer.Option("--steering-ratio", help="Steering wheel's angle to the road wheels'.")] = None,
    as_json: AsJson = False,
) -> None:
    """Begin with logs of your own car: `vehest new my_car lap*.csv`.

    Proposes for every column channel, unit, sign and delay, with what speaks for it, asks what the logs do not decide, and writes
    conf/dataset, conf/split and pipelines/my_car.yaml. Reads tables, Parquet, MDF, VBO and ROS 2 bags. With --json nothing is asked.
    """
    from vehest.run.new_car import Vehicle
    from vehest.run.new_car_outcome import begin, conclude, in_words, settle

    given = dict(_key_and_answer(text) for text in answer or [])
    examined = begin(name, files, force=force)
    if not as_json:
        for file in files:
            _echo(f"read {file}")
        for proposal in examined.proposals.channels:
            _echo(f"{'?' if proposal.asked else ' '} {proposal.in_words}")
        if examined.proposals.left_right:
            _echo(f"  left and right: {examined.proposals.left_right}")
        if examined.proposals.unused:
            _echo(f"  no channel: {_counted(list(examined.proposals.unused))}")
    draft, left = settle(examined, Vehicle(wheelbase, mass, steering_ratio), None if yes or as_json else _asked, given)
    outcome = conclude(draft, left, force=force, dry_run=dry_run)
    if as_json:
        _echo(_json({**outcome.as_plain(), "dry_run": dry_run}), keep="\n")
        return
    for line in in_words(outcome):
        _echo(line)
    for written in outcome.files:
        _echo(f"{'would write' if dry_run else 'wrote'} {written.file}: {written.purpose}")
    _echo("next:")
    for command in outcome.next_commands():
        _echo(f"  {command}")


def _key_and_answer(text: str) -> tuple[str, str]:
    key, equals, answer = text.rpartition("=")
    if not equals or not key:
        raise ConfigurationError(f"--answer '{text}' must be KEY=ANSWER, for example --answer left_right=no")
    return key, answer


def _asked(question: Any) -> str:
    """An answer from the terminal; Enter takes what is proposed, and what is no answer is asked again."""
    from vehest.run.new_car_questions import check_answer

    for line in question.evidence:
        _echo(f"    {line}")
    if question.candidates:
        _echo(f"    other answers: {', '.join(question.candidates)}")
    text = printable(f"? {question.text} ({question.hint})" if question.hint else f"? {question.text}")
    for _attempt in range(MOST_ATTEMPTS):
        try:
            answer = str(typer.prompt(text, default=question.proposed, show_default=bool(question.proposed))).strip()
        except typer.Abort:
            if sys.stdin is not None and sys.stdin.isatty():
                raise
            raise ConfigurationError("nobody answers here; add --yes to take what is proposed, or --answer KEY=ANSWER") from None
        try:
            check_answer(question, answer)
            return answer
        except ConfigurationError as error:
            _echo(f"    {error}")
    raise ConfigurationError(f"'{question.key}' got no answer")


@app.command(epilog=_offered("dataset"))
def ingest(
    dataset: Dataset,
    overrides: Annotated[list[str] | None, _overrides("ingest")] = None,
    download: Annotated[
        bool, typer.Option("--download", help="First fetch files that are missing, and compare checksums; goes on where a break left it.")
    ] = False,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    jobs: Jobs = None,
) -> None:
    """Bring raw files, or a simulation, into the store: `vehest ingest ferrari_250lm root=FOLDER`."""
    from vehest.run.download import download_files
    from vehest.run.run_cache import RunOptions
    from vehest.run.study_run import open_runner

    config = _compose("ingest", [f"dataset={dataset}", *(overrides or [])])
    with open_runner(config, RunOptions(force, dry_run, quiet, jobs), frozenset({"ingest"})) as runner:
        if download:
            download_files(config, runner)
        made = runner.ingest(config)
    _emit(as_json, {"folder": str(made.folder), "recordings": sorted(Path(n).stem for n in made.outputs), "skipped": made.skipped})


@app.command()
def simulate(
    dataset: Annotated[str, typer.Argument(help="Name of a simulated data set in conf/dataset.", autocompletion=_complete_simulated)],
    overrides: Annotated[list[str] | None, _overrides("simulate")] = None,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    jobs: Jobs = None,
) -> None:
    """Simulate a data set into the store: `vehest simulate sim_bmw seed=1`.

    The same seed gives the same samples. Drives are made side by side; a run that is stopped goes on with those that are missing. Drives
    that spin or leave the road are kept, flagged in their provenance, and counted.
    """
    from vehest.run.run_cache import RunOptions
    from vehest.run.simulate import outcome_of, simulation_config
    from vehest.run.study_run import open_runner

    config = simulation_config(dataset, overrides or [])
    with open_runner(config, RunOptions(force, dry_run, quiet, jobs), frozenset({"ingest"})) as runner:
        artefact = runner.ingest(config)
    outcome = outcome_of(artefact).as_plain()
    if not as_json:
        outcome |= {name: _counted(drives) for name, drives in outcome.items() if isinstance(drives, list)}
    _emit(as_json, {"folder": str(artefact.folder), **outcome, "skipped": artefact.skipped})


@app.command(epilog=_offered("dataset"))
def downsample(
    dataset: Dataset,
    overrides: Annotated[list[str] | None, _overrides("downsample")] = None,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Bring a data set to another rate, anti-aliased: `vehest downsample ferrari_250lm rate_hz=20`."""
    from vehest.run.config import positive_rate
    from vehest.run.run_cache import RunOptions
    from vehest.run.study_run import open_runner

    config = _compose("downsample", [f"dataset={dataset}", *(overrides or [])])
    rate = positive_rate(config["rate_hz"], "rate_hz")
    with open_runner(config, RunOptions(force, dry_run, quiet), frozenset({"downsample"})) as runner:
        artefact = runner.downsample(runner.ingest(config), rate, config["downsample"])
    _emit(as_json, {"folder": str(artefact.folder), "rate_hz": rate, "skipped": artefact.skipped})


@app.command(epilog=_offered("split", "estimator", "training", "tracking"))
def train(
    overrides: Annotated[list[str] | None, _overrides("train")] = None,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Fit one estimator: `vehest train estimator=ksnn estimator.n_local=3 split=ferrari_drive seed=7`.

    Ctrl-C keeps the best so far; the same command goes on from there.
    """
    from vehest.run.run_cache import RunOptions
    from vehest.run.single import train_one

    _emit(as_json, train_one(overrides or [], RunOptions(force, dry_run, quiet, track=True)))


@app.command("eval", epilog=_offered("split", "estimator", "fault"))
def evaluate(
    overrides: Annotated[list[str] | None, _overrides("eval")] = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            "-m",
            help="A model's folder, or the start of its name, or `pretrained`; without it, the model that the overrides train.",
            autocompletion=_complete_model,
        ),
    ] = None,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Score a fitted estimator on the test ranges of a split: `vehest eval estimator=ksnn seed=7`, with the overrides of its training.

    Or name the model: `vehest eval --model ksnn-linear_bias_p2-seed2 split=ferrari_drive`. With a sensor's fault as a further condition:
    `vehest eval estimator=ksnn fault=frozen fault.channel=yaw_rate fault.severity=severe`.
    """
    from vehest.run.run_cache import RunOptions
    from vehest.run.single import evaluate_one

    _emit(as_json, evaluate_one(overrides or [], model, RunOptions(force, dry_run, quiet, track=True), _note))


@app.command()
def estimate(
    model: Annotated[
        str,
        typer.Argument(
            metavar="MODEL|FILE",
            help="A model's folder, or the start of its name; or the recording at once, for the pre-trained model.",
            autocompletion=_complete_model_or_file,
        ),
    ],
    recording: Annotated[
        str | None,
        typer.Argument(
            metavar="FILE",
            help="The recording after a model: a table, or with dataset=NAME what that one reads; it needs no reference channels.",
            show_default=False,
        ),
    ] = None,
    overrides: Annotated[list[str] | None, _overrides("estimate")] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Where to write the estimate: .parquet or .csv.")] = Path("estimate.parquet"),
    strict: Annotated[
        bool,
        typer.Option(
            "--strict", help="End with exit code 3, and write nothing, where a check finds something in the channels that are read."
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Run a trained model on a new recording: `vehest estimate MODEL lap.csv -o out.parquet`.

    Beside v and β stand half widths of their calibrated 90 % bands, and the health of each sample: 0 valid, 1 degraded, 2 invalid.

    For a car that nobody has trained on, leave the model out: `vehest estimate lap.csv` takes the one that comes with vehest and says so.

    Columns named like channels, in SI units, need no more; for others, describe them in conf/dataset/NAME.yaml and add `dataset=NAME`.
    """
    from vehest.data.limits import limits_from_config, use_limits
    from vehest.estimators.model_files import load_model
    from vehest.run.calibrate import trust_of
    from vehest.run.estimate import (
        PRETRAINED,
        SUFFIXES,
        estimate_recording,
        find_model,
        finding_in_words,
        findings_for,
        preparation_of,
        pretrained_note,
        read_table,
        summary_of,
        verdict_of,
        write_estimate_table,
    )

    words = [word for word in (model, recording, *(overrides or [])) if word is not None]
    n_names = 2 if len(words) > 1 and _is_file_name(words[1]) else 1
    name, file, overrides = (words[0] if n_names == 2 else PRETRAINED), Path(words[n_names - 1]), words[n_names:]
    if n_names == 1 and file.is_dir():
        raise ConfigurationError(f"'{file}' is a folder; a recording is a file, and comes after the model: vehest estimate MODEL lap.csv")
    if out.suffix.lower() not in SUFFIXES:
        raise ConfigurationError(f"'{out}' must end in {' or '.join(SUFFIXES)}")
    config = _compose("estimate", overrides)
    folder = find_model(name, Path(config["output"]), _note)
    fitted = load_model(folder)
    downsample = config["downsample"] if _names("downsample", overrides) else preparation_of(folder)
    if out.is_dir():
        raise ConfigurationError(f"'{out}' is a folder; name a file")
    if out.exists() and file.exists() and out.samefile(file):
        raise ConfigurationError(f"'{out}' is the recording itself; name another file")
    trust = trust_of(folder, Path(config["output"]))
    with use_limits(limits_from_config(config["limits"])):
        drive = read_table(file, overrides)
        findings = findings_for(drive, fitted, config["dataset"].get("accept") or ())
        if strict and findings:
            raise DataError(f"'{file}': {finding_in_words(findings[0])}")
        result = estimate_recording(fitted, drive, downsample, trust)
    for finding in findings:
        typer.echo(f"warning: {finding_in_words(finding)}", err=True)
    write_estimate_table(result, out)
    note = {"note": pretrained_note()} if name == PRETRAINED else {}
    said = {"verdict": verdict_of(result, drive, trust), "findings": [finding_in_words(finding) for finding in findings]}
    _emit(as_json, {"out": str(out), "model": str(folder) if not note else PRETRAINED, **summary_of(result), **said, **note})


def _note(text: str) -> None:
    typer.echo(f"note: {text}", err=True)


@app.command()
def replay(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Frames of a bus: .asc, .blf, or .log of candump.")],
    overrides: Annotated[list[str] | None, _overrides("estimate")] = None,
    model: Annotated[
        str,
        typer.Option(
            "--model",
            "-m",
            help="A model's folder, or the start of its name; by default the pre-trained one.",
            autocompletion=_complete_model,
        ),
    ] = "pretrained",
    dbc: Annotated[Path | None, typer.Option("--dbc", help="What describes the bus; by default the data set's.")] = None,
    dataset: Annotated[
        str | None,
        typer.Option("--dataset", help="A data set of the source can, which says what is which channel.", autocompletion=_complete_dataset),
    ] = None,
    signals: Annotated[
        str,
        typer.Option(
            "--signals",
            help="CHANNEL=MESSAGE.SIGNAL, separated by commas, for signals that are not called like channels; a minus before the signal "
            "where it counts the other way than ISO 8855, :UNIT behind it where the DBC says none.",
        ),
    ] = "",
    speed: Annotated[str, typer.Option("--speed", help="Times real time, or max: as fast as it goes.")] = "1",
    bus_rate: Annotated[
        float | None, typer.Option("--bus-rate", help="Samples a second [Hz]; by default as many as the fastest message has frames.")
    ] = None,
    interface: Annotated[str, typer.Option("--interface", help="Of python-can: virtual, socketcan, …")] = "virtual",
    channel: Annotated[str, typer.Option("--channel", help="Of the interface, for example vcan0.")] = "vehest",
    identifier: Annotated[
        str, typer.Option("--id", help="Identifier of the estimates' frames; that of their bands is the next one.")
    ] = "0x6F0",
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Where estimates go: .csv, or .asc for their frames, with the DBC that describes them beside it."),
    ] = None,
    write_dbc: Annotated[Path | None, typer.Option("--write-dbc", help="Write the DBC of the estimates' frames here.")] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Put a log's frames on a bus and let a model estimate online from what it takes off: `vehest replay drive.asc --dbc car.dbc -m MODEL`.

    Estimates go onto the bus as frames, at --out into a file, and to the terminal. Frames that are lost or late are missing samples.
    Ctrl-C ends it; what was written is kept.
    """
    from vehest.run.replay import ReplayWords, replay_log
    from vehest.run.signals import StopSignals

    words = ReplayWords(log, model, dbc, dataset, signals, speed, bus_rate, interface, channel, identifier, out, write_dbc, quiet)
    stop = StopSignals()
    with stop.installed(), stop.deferred():
        outcome = replay_log(words, overrides or [], stop.requested, _note)
    _emit(as_json, outcome)
    if stop.number is not None:
        raise typer.Exit(128 + stop.number)


@app.command()
def export(
    model: Annotated[
        str,
        typer.Argument(
            help="A model's folder, or the start of its name; or pretrained.", autocompletion=_complete_model, show_default=False
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder to write; an earlier export there is replaced.")] = Path("export"),
    precision: Annotated[str, typer.Option("--precision", help="Of all numbers: double or float.")] = "double",
    bus_rate: Annotated[
        float | None,
        typer.Option("--bus-rate", metavar="HZ", help="Rate at which samples come, if it is above the model's [Hz].", show_default=False),
    ] = None,
    elsewhere: Annotated[
        bool, typer.Option("--elsewhere", help="For a car or tyres that the model was not calibrated on: bands twice as wide.")
    ] = False,
    onnx: Annotated[
        bool,
        typer.Option("--onnx", help="Write a network as one step in ONNX instead, with its state going in and out; -o names the file."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Write a model as C99 for a control unit: `vehest export MODEL -o c --precision float`.

    One step with explicit state: the method with the checks of its samples, band and health; a Makefile, a program that runs a drive from a
    file, test vectors, and a README with units and the bytes that it takes.
    """
    from vehest.estimators.model_files import load_model
    from vehest.export.folder import export_model
    from vehest.run.calibrate import trust_of
    from vehest.run.estimate import find_model

    config = _compose("estimate", [])
    output = Path(config["output"])
    folder = find_model(model, output, _note)
    fitted = load_model(folder)
    if onnx:
        from vehest.export.onnx_model import write_onnx

        write_onnx(fitted, out)
        _emit(as_json, {"out": str(out), "model": str(folder)})
        return
    found = export_model(fitted, trust_of(folder, output), out, precision, bus_rate, elsewhere=elsewhere)
    _emit(as_json, {"out": str(out), "model": str(folder), **{name: value for own in found for name, value in own.figures().items()}})


def _is_file_name(word: str) -> bool:
    """Whether a word is no override; a file that is there may have an ``=`` in its name."""
    return ("=" not in word and not word.startswith("~")) or Path(word).is_file()


@app.command()
def compare(
    recording: Annotated[Path, typer.Argument(metavar="FILE", help="A recording with its reference: a table, or with dataset=NAME any.")],
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ESTIMATE]... [OVERRIDES]...",
            help="Tables with time and v [m/s] or β [rad], made by any tool, or by `vehest estimate`; then key=value …",
            show_default=False,
        ),
    ] = None,
    models: Annotated[
        list[str] | None,
        typer.Option(
            "--model", "-m", help="A model to run on the recording and compare too; may be repeated.", autocompletion=_complete_model
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Score estimates made elsewhere on one recording: `vehest compare lap.csv mine.csv theirs.csv`.

    v = 0 and a static map, fitted on the other half of the drive, stand beside them. Where all estimates are there they are scored, with
    95 % intervals over blocks of the drive; nothing is called best that is not below all others by more than chance.
    """
    from vehest.data.limits import limits_from_config, use_limits
    from vehest.estimators.model_files import load_model, read_description
    from vehest.run.calibrate import trust_of
    from vehest.run.compare_files import compare_estimates, read_estimate_table
    from vehest.run.estimate import estimate_recording, find_model, preparation_of, read_table

    files = [Path(word) for word in words or [] if _is_file_name(word)]
    overrides = [word for word in words or [] if not _is_file_name(word)]
    config = _compose("estimate", overrides)
    with use_limits(limits_from_config(config["limits"])):
        drive = read_table(recording, overrides, references=True)
        estimates = {file.stem: read_estimate_table(file, drive) for file in files}
        if len(estimates) < len(files):
            raise ConfigurationError("two estimates have the same file name; rename one, since it names the row")
        for name in models or []:
            folder = find_model(name, Path(config["output"]), _note)
            fitted, trust = load_model(folder), trust_of(folder, Path(config["output"]))
            about = read_description(folder).about
            if any(span.startswith((f"{drive.id} [", f"{drive.id} (")) for span in (*about.trained_on, *about.validated_on)):
                typer.echo(f"warning: '{name}' learnt on this recording: its row is no test", err=True)
            estimates[name] = estimate_recording(fitted, drive.without_references(), preparation_of(folder), trust)
        found = compare_estimates(drive, estimates)
    if as_json:
        _echo(
            _json({"start": found.start, "stop": found.stop, "rate_hz": found.rate_hz, "rows": found.rows, "verdict": found.verdict}),
            keep="\n",
        )
        return
    header = ("estimate", "RMSE(β) [deg]", "95 % interval [deg]", "to the lowest [deg]", "beats v = 0, static map", "RMSE(v) [m/s]", "FVU")
    _table([*header], [_compared_row(row) for row in found.rows])
    _echo(f"scored from {found.start:.6g} to {found.stop:.6g} s at {found.rate_hz:g} Hz")
    _echo(found.verdict)


def _compared_row(row: Mapping[str, Any]) -> list[str]:
    low, high = row["rmse_sideslip_low"], row["rmse_sideslip_high"]
    return [
        str(row["estimate"]),
        f"{row['rmse_sideslip']:.3f}",
        f"{low:.3f} … {high:.3f}" if math.isfinite(low) else "–",
        str(row["against_best"]),
        f"{row['beats_zero']}, {row['beats_static_map']}",
        f"{row['rmse_vy']:.3f}",
        f"{row['fvu']:.3f}",
    ]


@app.command()
def run(
    pipeline: Annotated[str, typer.Argument(help="A file in pipelines/, or its name.", autocompletion=_complete_pipeline)],
    overrides: Annotated[list[str] | None, _overrides("eval")] = None,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    jobs: Jobs = None,
    minutes: Annotated[
        float | None,
        typer.Option(help="Be done in this time, report included; what did not fit is named, and the same command goes on with it."),
    ] = None,
    launcher: LauncherName = "local",
    address: Address = None,
    slurm: Slurm = None,
) -> None:
    """Run a whole study: ingest, downsample, train, evaluate, report: `vehest run pipelines/quickstart.yaml`.

    What is there is skipped. Overrides apply to every sweep that has their key. Sweeps are worked off in the order of the file.
    """
    from vehest.run.run_cache import RunCache, RunOptions

    words = overrides or []
    options = RunOptions(force, dry_run, quiet, jobs, minutes=minutes, launcher=LauncherOptions(launcher, address, tuple(slurm or ())))
    cache = RunCache(("run", pipeline, *words), words, pipeline)
    ran = cache.repeat(options)
    if ran is None:
        from vehest.run.study_run import run_study

        ran = run_study(pipeline, words, options, cache)
    _print_ran(ran, as_json)


@app.command()
def report(
    pipeline: Annotated[
        str | None,
        typer.Argument(
            help="A file in pipelines/, or its name; with --check studies or pipelines, or none for all.",
            autocompletion=_complete_pipeline,
            show_default=False,
        ),
    ] = None,
    overrides: Annotated[list[str] | None, _overrides("eval")] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Draw nothing; say which results published in ./results, of all studies or of those named, are not those of today's code, "
            "configuration and data.",
        ),
    ] = False,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Draw a study's tables, figures and page from what `vehest run` has made; trains nothing.

    `vehest report --check` needs neither models nor an output root. A line a study: up to date; stale, and what has changed; or not known.
    Exit code 3 unless all are up to date.
    """
    if check:
        _check_published([word for word in (pipeline, *(overrides or [])) if word is not None], as_json)
        return
    if pipeline is None:
        raise ConfigurationError(f"say which pipeline, of: {', '.join(pipeline_names())}; or --check")
    from vehest.run.run_cache import RunCache, RunOptions

    words, options = overrides or [], RunOptions(force, dry_run, quiet, 1)
    cache = RunCache(("run", pipeline, *words), words, pipeline)
    ran = cache.repeat(options)
    if ran is None:
        from vehest.run.study_run import run_study

        ran = run_study(pipeline, words, options, cache, only_report=True)
    _print_ran(ran, as_json)


def _check_published(words: list[str], as_json: bool) -> None:
    """Say of published studies whether they are those of today; exit code 3 unless all are."""
    from vehest.run.published import check_published

    verdicts = check_published([word for word in words if _is_file_name(word)], [word for word in words if not _is_file_name(word)])
    if as_json:
        _echo(_json([asdict(verdict) for verdict in verdicts]), keep="\n")
    else:
        for verdict in verdicts:
            _echo(verdict.in_words())
    if any(verdict.state != "up to date" for verdict in verdicts):
        raise typer.Exit(3)


@app.command(epilog=_offered("split", "estimator", "training", "fault", "tracking"))
def sweep(
    overrides: Annotated[list[str] | None, _overrides("eval")] = None,
    name: Annotated[
        str | None, typer.Option("--name", help="Start of the folder's name; by default the estimators and the split.", show_default=False)
    ] = None,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    jobs: Jobs = None,
    launcher: LauncherName = "local",
    address: Address = None,
    slurm: Slurm = None,
) -> None:
    """Train and score all combinations of several values: `vehest sweep estimator=ksnn estimator.n_local=2,3 seed='range(5)'`.

    Prints the mean RMSE(β) of each combination over its seeds with a 95 % confidence interval (Student's t), and marks the one that is best
    on the validation range. What is there is skipped, a failed job stops no other, the same command finishes what is missing.
    """
    from vehest.run.run_cache import RunCache, RunOptions

    words = overrides or []
    options = RunOptions(force, dry_run, quiet, jobs, launcher=LauncherOptions(launcher, address, tuple(slurm or ())))
    cache = RunCache(("sweep", name or "", *words), words)
    ran = cache.repeat(options)
    if ran is None:
        from vehest.run.study_run import run_sweep

        ran = run_sweep(words, name, options, cache)
    _print_ran(ran, as_json, sweep=True)


@app.command("config")
def show_config(
    command: Annotated[str, typer.Argument(help="ingest, downsample, train, eval or estimate.", autocompletion=_complete_command)],
    overrides: Annotated[list[str] | None, _overrides("train")] = None,
    as_json: AsJson = False,
) -> None:
    """Print the resolved configuration of a command: `vehest config train estimator=gru`."""
    if command not in COMMANDS:
        raise ConfigurationError(f"'{command}' is not one of: {', '.join(COMMANDS)}")
    from vehest.run.config import GIVEN, as_yaml

    config = {key: value for key, value in _compose(command, overrides or []).items() if key != GIVEN}
    _echo(_json(config) if as_json else as_yaml(config).rstrip(), keep="\n")


@app.command()
def prune(
    overrides: Annotated[list[str] | None, _overrides("estimate")] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Remove without asking.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be removed; remove nothing.")] = False,
    as_json: AsJson = False,
) -> None:
    """List what no present key names in the output root, ask, and remove it: `vehest prune output=FOLDER`.

    That is what other code has made than today's, what is damaged or half-written, and what was made from something that is gone. Models
    and recordings of today's code stay, whatever their settings, and so does everything that vehest has not made.
    """
    from vehest.run.prune import remove_found, unnamed

    config = _compose("estimate", overrides or [])
    if as_json and not (yes or dry_run):
        raise ConfigurationError("with --json nothing is asked; add --yes to remove, or --dry-run")
    found = unnamed(Path(str(config["output"])))
    total = sum(one.size for one in found)
    if not as_json:
        if found:
            rows = [[str(one.path), _size(one.size), _age(one.age), one.reason] for one in found]
            _table(["no present key names", "size", "age", "since"], rows)
        _echo(f"{len(found)} to remove, {_size(total)}" if found else "nothing to remove")
    removed: list[str] = []
    if found and not dry_run:
        if not yes and not sys.stdin.isatty():
            raise ConfigurationError("there is no terminal to ask at; add --yes to remove, or --dry-run")
        if yes or typer.confirm("Remove them?"):
            remove_found(found, lambda one: removed.append(str(one.path)))
    if as_json:
        listed = [{"path": str(one.path), "reason": one.reason, "bytes": one.size, "seconds": round(one.age)} for one in found]
        _echo(_json({"found": listed, "bytes": total, "removed": removed}), keep="\n")
    elif removed:
        _echo(f"{len(removed)} removed")


def _size(size: int) -> str:
    """Bytes as people read them."""
    return f"{size / 1e6:.1f} MB" if size >= 1e5 else f"{size / 1e3:.1f} kB"


def _age(seconds: float) -> str:
    """A time span as people read it."""
    for length, unit in ((86400.0, "d"), (3600.0, "h"), (60.0, "min")):
        if seconds >= length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} s"


@app.command()
def doctor(as_json: AsJson = False) -> None:
    """Say what works on this machine and what is missing."""
    from vehest.run.doctor import examine

    items = examine()
    if as_json:
        _echo(_json([item.__dict__ for item in items]), keep="\n")
    else:
        for item in items:
            mark = {"ok": "ok     ", "warning": "warning", "error": "error  "}[item.level]
            _echo(f"{mark} {item.name}: {item.message}")
    if any(item.level == "error" for item in items):
        raise typer.Exit(4)


@data_app.command("list")
def data_list(as_json: AsJson = False) -> None:
    """List the data sets that conf/dataset offers, with their licences and what to cite."""
    from vehest.run.inspect_data import dataset_rows

    rows = dataset_rows()
    if as_json:
        _echo(_json(rows), keep="\n")
    else:
        shown = ("dataset", "kind", "source", "here", "title")
        _table(["data set", *shown[1:]], [[row[key] for key in shown] for row in rows])
        _echo("")
        _echo("licences and citations")
        for row in rows:
            _echo(f"{row['dataset']}: {row['licence']}")
            _echo(f"  cite: {row['citation']}")


@data_app.command("channels")
def data_channels(as_json: AsJson = False) -> None:
    """List the channels that vehest knows, with units and signs."""
    from vehest.data.channels import CHANNELS

    if as_json:
        _echo(_json({name: {"unit": c.unit, "meaning": c.meaning} for name, c in CHANNELS.items()}), keep="\n")
    else:
        _table(["channel", "unit", "meaning"], [[c.name, c.unit, c.meaning] for c in CHANNELS.values()])


@data_app.command("show")
def data_show(
    source: Annotated[str, typer.Argument(help="A data set, or a CSV or Parquet file.", autocompletion=_complete_dataset)],
    overrides: Annotated[list[str] | None, _overrides("ingest")] = None,
    as_json: AsJson = False,
) -> None:
    """Show recordings: channels, rate, duration, ranges."""
    from vehest.run.inspect_data import describe

    shown = describe(source, overrides or [])
    if as_json:
        _echo(_json(shown), keep="\n")
        return
    for recording in shown["recordings"]:
        _echo(
            f"{recording['id']}: {recording['kind']}, {recording['vehicle']}, {recording['rate_hz']:g} Hz, "
            f"{_stretch(recording['start'], recording['end'])}, {recording['samples']} samples"
        )
        for line in recording["origin"]:
            _echo(f"  {line}")
        rows = [[c["name"], c["unit"], *(f"{c[key]:.4g}" for key in ("min", "mean", "max", "std"))] for c in recording["channels"]]
        _table(["channel", "unit", "min", "mean", "max", "std"], rows)


def _stretch(start: float, end: float) -> str:
    """When a recording begins and ends [s]; of unix time the date, and seconds from it on."""
    if not EARLIEST_UNIX < start < LATEST_UNIX:
        return f"{start:.6g} s to {end:.6g} s"
    return f"0 s to {end - start:.6g} s from {datetime.fromtimestamp(start, UTC):%Y-%m-%d %H:%M:%S} UTC on"


@data_app.command("check")
def data_check(
    source: DatasetOrFile,
    overrides: Annotated[list[str] | None, _overrides("ingest")] = None,
    as_json: AsJson = False,
) -> None:
    """Look for gaps, bad clocks, NaN, stuck and saturated channels, impossible values, wrong units and signs; exit code 3 on errors."""
    from vehest.run.inspect_data import check

    findings = check(source, overrides or [])
    if as_json:
        _echo(_json(findings), keep="\n")
    else:
        for row in findings:
            channel = f" {row['channel']}:" if row["channel"] else ""
            _echo(f"{row['level']:<7} {row['recording']}:{channel} {row['message']}")
        if not findings:
            _echo("nothing found")
    if any(row["level"] == "error" for row in findings):
        raise typer.Exit(3)


@data_app.command("usable")
def data_usable(
    source: DatasetOrFile,
    overrides: Annotated[list[str] | None, _overrides("ingest")] = None,
    as_json: AsJson = False,
) -> None:
    """Say of every estimator whether these recordings will do, which channels are missing, and what could supply them."""
    from vehest.run.inspect_data import examine_usability
    from vehest.run.usable import HEADER, borrowed_cars, remedies, table_row

    found = examine_usability(source, overrides or [])
    if as_json:
        _echo(_json(found.as_plain()), keep="\n")
        return
    _table([*HEADER], [table_row(row) for row in found.rows])
    _echo("")
    for line in remedies(found.rows):
        _echo(line)
    if found.unscored:
        _echo(f"every estimate is scored by {' and '.join(missing.channel for missing in found.unscored)}")
    if found.columns:
        names = ", ".join(found.columns[:MOST_COLUMNS]) + (", …" if len(found.columns) > MOST_COLUMNS else "")
        _echo(f"columns that no channel uses: {names}; what is not in the log may be one of them, to be declared in conf/dataset")
    if cars := borrowed_cars(found.rows):
        _echo(cars)


@data_app.command("align")
def data_align(
    source: Annotated[str, typer.Argument(help="A data set, or a CSV or Parquet file.", autocompletion=_complete_dataset)],
    overrides: Annotated[list[str] | None, _overrides("ingest")] = None,
    estimate: Annotated[
        str,
        typer.Option(
            "--estimate", "-e", help="What to estimate, separated by commas: lever_arm, mounting, delay, offsets, steering_ratio."
        ),
    ] = "",
    recording: Annotated[str | None, typer.Option("--recording", "-r", help="Which recording of the data set.")] = None,
    wheelbase: Annotated[float | None, typer.Option("--wheelbase", help="For the steering ratio [m].")] = None,
    steering_channel: Annotated[
        str | None, typer.Option("--steering-channel", help="What to find the steering ratio of; by default handwheel, or else steer.")
    ] = None,
    cutoff: Annotated[float, typer.Option("--cutoff", help="Low-pass that both sides go through [Hz].")] = 2.0,
    max_delay: Annotated[float, typer.Option("--max-delay", help="Largest delay to look for, either way [s].")] = 0.5,
    tilt: Annotated[
        float, typer.Option("--tilt", help="Roll and pitch of the body beyond what follows the accelerations [rad]; 0: free of gravity.")
    ] = 0.001,
    max_ay: Annotated[
        float, typer.Option("--max-ay", help="For the steering ratio: lateral acceleration up to which it is used [m/s²].")
    ] = 3.0,
    min_speed: Annotated[float, typer.Option("--min-speed", help="For the steering ratio: speed from which it is used [m/s].")] = 5.0,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for report, table, transforms and figure.")] = None,
    as_json: AsJson = False,
) -> None:
    """Estimate lever arm, rotation, delay and offsets of the sensors, and the steering ratio: `vehest data align lap.csv -e delay,offsets`.

    Prints what was found with its uncertainty, and the transforms that would correct it. Applies nothing.
    """
    from vehest.alignment.settings import AlignmentSettings
    from vehest.run.align import (
        PARAMETER_HEADER,
        RESIDUAL_HEADER,
        align_recording,
        as_plain,
        override_of,
        parameter_rows,
        refuse_other_files,
        residual_rows,
        write_alignment,
    )

    asked = tuple(dict.fromkeys(name.strip() for name in estimate.split(",") if name.strip()))
    settings = AlignmentSettings(asked, cutoff, max_delay, tilt, wheelbase, steering_channel, max_ay, min_speed)
    if out is not None:
        refuse_other_files(out)
    found = align_recording(source, overrides or [], recording, settings)
    if out is not None:
        write_alignment(found, out)
    if as_json:
        _echo(_json({**as_plain(found), "out": None if out is None else str(out)}), keep="\n")
        return
    _echo(f"{found.recording_id}: {found.kind}, {found.duration:.6g} s at {found.rate_hz:g} Hz; nothing is applied")
    _table([*PARAMETER_HEADER], parameter_rows(found))
    if found.residuals:
        _echo("")
        _table([*RESIDUAL_HEADER], residual_rows(found))
    for note in found.notes:
        _echo(f"note: {note}")
    _echo(f"to correct it: '{override_of(found)}'")
    if out is not None:
        _echo(f"written: {out}")


def main() -> None:
    """Entry point: every expected failure is one line and an exit code."""
    from vehest.run.signals import DryRunStop, Stopped

    _open_streams()
    try:
        code = app(prog_name="vehest", standalone_mode=False)
    except _USAGE_ERROR as error:
        _fail_usage(error)
    except DryRunStop:
        code = 0
    except (_OutputClosed, BrokenPipeError):
        _silence(sys.stdout)
        sys.exit(141)
    except Stopped as stopped:
        _fail(f"stopped by {stopped}; what was finished is kept, the same command goes on", stopped.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        _fail("stopped", 130)
    except Exception as error:
        _fail_with(error)
    if code == 130:
        _fail("stopped", 130)
    sys.exit(code if isinstance(code, int) else 0)


_USAGE_ERROR: Any = typer.BadParameter.__mro__[1]
"""What Typer raises for options, arguments and commands that it does not know; newer ones carry their own copy of Click."""


class _OutputClosed(Exception):
    """Nobody reads standard output any more."""


def _open_streams() -> None:
    """Give streams that were closed at the start a null device, and let every stream show any character, as an escape if need be."""
    for name in ("stdin", "stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w", encoding="utf-8"))  # noqa: SIM115 (as long as the process lives)
        elif name != "stdin" and isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _silence(stream: Any) -> None:
    """Let what a broken stream still holds go nowhere, so that leaving does not complain about it."""
    with suppress(OSError, ValueError), open(os.devnull, "w", encoding="utf-8") as nowhere:
        os.dup2(nowhere.fileno(), stream.fileno())


def _fail_usage(error: Any) -> None:
    context = error.ctx
    if type(error).__name__ == "NoArgsIsHelpError":  # the help stands on the screen
        sys.exit(error.exit_code)
    words = error.format_message().strip().rstrip(".").replace(". Did you mean", "; did you mean")
    key = str(getattr(error, "option_name", "")).lstrip("-").partition("=")[0]
    if key in GROUPS or key in ROOT_KEYS or "." in key:
        hint = f"what belongs to the configuration is written without dashes: {key}=…"
    else:
        hint = f"'{context.command_path if context else 'vehest'} --help' says what there is"
    _fail(f"{words[:1].lower()}{words[1:]}{'' if words.endswith('?') else ';'} {hint}", error.exit_code)


def _fail_with(error: Exception) -> None:
    from vehest.run.failures import failure_of

    failure = failure_of(error)
    if failure.exit_code != 1:
        _fail(failure.message, failure.exit_code)
    if os.environ.get("VEHEST_DEBUG"):
        raise error
    _fail(f"this is a defect of vehest ({failure.message}); VEHEST_DEBUG=1 shows where", 1)


def _fail(message: str, exit_code: int) -> NoReturn:
    line = printable(" ".join(message.split()))
    try:
        sys.stdout.flush()
    except (OSError, ValueError):
        _silence(sys.stdout)
    _complain(f"error: {line if len(line) <= LONGEST_LINE else line[:LONGEST_LINE] + '…'}")
    sys.exit(exit_code)


def _complain(text: str) -> None:
    """Print on standard error, if anybody reads it."""
    try:
        typer.echo(text, err=True)
    except OSError:
        _silence(sys.stderr)


def _echo(text: str, keep: str = "") -> None:
    """Print a line on standard output, control characters as escapes except for those to ``keep``; the one way there.

    Raises:
        MissingError: its disk is full.
        _OutputClosed: nobody reads it any more.
    """
    try:
        typer.echo(printable(text, keep))
    except BrokenPipeError:
        raise _OutputClosed from None
    except OSError as error:
        _silence(sys.stdout)
        raise MissingError(f"cannot write to standard output ({error.strerror})") from error


def _print_ran(ran: Ran, as_json: bool, *, sweep: bool = False) -> None:
    """Print a study's tables and the path of its report, or all as one JSON object.

    Raises:
        JobsFailedError: some jobs failed.
    """
    page, summary = ran.folder / ran.summary.page, ran.summary
    if as_json:
        own: dict[str, Any] = {"folder": str(ran.folder), "skipped": ran.skipped}
        if not sweep:
            own = {"report": str(page), "published": str(ran.published) if ran.published else None}
        _echo(_json({**own, **json.loads(summary.figures)}), keep="\n")
    else:
        for table in summary.tables:
            if table.title:
                _echo("")
                _echo(table.title)
            _table([*table.header], [[*row] for row in table.rows])
        if summary.note:
            _echo(summary.note, keep="\n")
        _echo(f"report: {page}")
        if ran.published:
            _echo(f"published: {ran.published}")
    if ran.failed is not None:
        raise ran.failed


def _compose(command: str, overrides: list[str]) -> Config:
    from vehest.run.config import compose_config

    return compose_config(command, overrides)


def _names(group: str, overrides: list[str] | None) -> bool:
    """Whether any override is about a group."""
    return any(override.lstrip("+~").startswith((f"{group}.", f"{group}=")) for override in overrides or [])


def _emit(as_json: bool, outcome: dict[str, Any]) -> None:
    """Print an outcome: one JSON object, or a line a figure."""
    if as_json:
        _echo(_json(outcome), keep="\n")
        return
    for key, value in outcome.items():
        _echo(f"{key}: {value if not isinstance(value, float) else f'{value:.6g}'}")


def _counted(names: list[str]) -> str:
    """How many there are, and the first of them."""
    some = ", ".join(names[:6]) + (", …" if len(names) > 6 else "")
    return f"{len(names)} ({some})" if names else "0"


def _json(outcome: Any) -> str:
    """An outcome as JSON; what is not a finite number becomes null, a character that is not to be shown its escape in JSON."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(inner) for key, inner in value.items()}
        if isinstance(value, list | tuple):
            return [plain(inner) for inner in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    encoding = (sys.stdout.encoding or "utf-8").lower().replace("-", "")
    text = json.dumps(plain(outcome), indent=1, ensure_ascii=encoding != "utf8", allow_nan=False)
    return "".join(c if c == "\n" or is_printable(c) else json.dumps(c)[1:-1] if c != "\x7f" else "\\u007f" for c in text)


def _table(header: list[str], rows: list[list[str]]) -> None:
    """Print a table on standard output, as wide as it needs to be where there is no terminal."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(width=None if sys.stdout.isatty() else 160, highlight=False)
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in header:
        table.add_column(Text(printable(name)))
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    with console.capture() as captured:
        console.print(table)
    _echo(captured.get().removesuffix("\n"), keep="\n\x1b")  # cells hold no escapes any more, styles do


if __name__ == "__main__":
    main()
