"""The command line: one thin function a command; heavy modules are imported inside it."""

from __future__ import annotations

import gc
import json
import os
import re
import sys
from collections.abc import Callable, Iterable
from dataclasses import asdict
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from vehest.configuration.files import GROUPS, choices, files_and_overrides, pipeline_names
from vehest.data.errors import ConfigurationError, VehestError, counted, printable
from vehest.run.launchers.base import LAUNCHERS, RunOptions
from vehest.run.named_files import require_dataset_or_file, require_paths, require_pipeline
from vehest.run.printing import (
    OutputClosed,
    TerminalTable,
    as_json_text,
    complain,
    echo,
    emit,
    note,
    open_streams,
    silence,
)
from vehest.version import __version__

if TYPE_CHECKING:
    from vehest.configuration.composition import Config
# the command line
app = typer.Typer(
    name="vehest",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Train, run and compare published estimators of a car's lateral velocity and "
    "sideslip angle.\n\nOptions of a command are set by overrides after it: `vehest train "
    "estimator=ksnn estimator.n_local=3 seed=7`.",
    epilog="Exit codes: 0 done, 1 defect of vehest, 2 wrong usage or configuration, 3 unusable "
    "data, 4 something is missing, 5 some jobs failed, 130 or 143 stopped by a signal.",
)
# commands of ``vehest data``
data_app = typer.Typer(no_args_is_help=True, help="Inspect data sets, recordings and channels.")
app.add_typer(data_app, name="data")

ROOT_KEYS = ("root", "output", "seed", "rate_hz")  # keys of the configuration outside groups
# largest number of characters of an error message; the rest is cut off
MAX_ERROR_CHARACTERS = 4_000
# message of Typer that is replaced
NOT_A_NUMBER = "Input should be a valid number, unable to parse string as a number"
STAGES = "Single stages, all of which `run` includes"  # title of a panel of the help
CLUSTER = "On a cluster"  # title of a panel of the help
# commands whose configuration can be shown
COMMANDS = ("ingest", "downsample", "train", "eval", "estimate")
OUTPUT = os.environ.get("VEHEST_OUTPUT", "outputs")  # default output root


def _offered(*groups: str) -> str:
    """Epilog that lists the choices of groups."""
    return "\n\n".join(f"**{group}**: {', '.join(choices(group))}" for group in groups)


def _offer(names: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Completion of a word by names that begin with it."""
    return lambda incomplete: [name for name in names() if name.startswith(incomplete)]


DATASETS = _offer(lambda: choices("dataset"))  # completion by names of data sets
# completion by names of models
MODELS = _offer(
    lambda: [
        "pretrained",
        "self_calibrating",
        *(model_folder.name for model_folder in Path(OUTPUT, "train").glob("[!.]*")),
    ]
)
# completion by choices of groups
OVERRIDES = _offer(lambda: [f"{group}={choice}" for group in GROUPS for choice in choices(group)])
PIPELINES = _offer(pipeline_names)  # completion by names of pipelines


# type of the option ``--dry-run``
DryRun = Annotated[
    bool,
    typer.Option("--dry-run", help="List the stages that would run or be reused; run nothing."),
]
# type of the option ``--force``
Force = Annotated[bool, typer.Option("--force", help="Run again although the result exists.")]
# type of an argument that is a data set or a file
DatasetOrFile = Annotated[
    str,
    typer.Argument(
        help="A data set, or a file: a table, or with dataset=NAME one of its format.",
        autocompletion=DATASETS,
    ),
]
# type of the option ``--json``
AsJson = Annotated[
    bool, typer.Option("--json", help="Print the outcome as one JSON object on standard output.")
]
# type of the option ``--quiet``
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print only warnings and the outcome.")]
# type of the option ``--jobs``
Jobs = Annotated[
    int | None,
    typer.Option(
        "--jobs", "-j", min=1, help="Number of parallel processes; by default one per core."
    ),
]
# type of the option ``--launcher``
LauncherName = Annotated[
    str,
    typer.Option(
        "--launcher",
        help=(
            "Where trainings run: local, on this machine's cores; ray, on a Ray cluster; slurm, "
            "as SLURM jobs (docs/many_machines.md)."
        ),
        autocompletion=_offer(lambda: LAUNCHERS),
        rich_help_panel=CLUSTER,
    ),
]
# type of the option ``--address``
Address = Annotated[
    str | None,
    typer.Option(
        "--address",
        help="With --launcher ray: HOST:PORT of the cluster, or auto for the one this machine "
        "is part of. By default RAY_ADDRESS, else a Ray of its own on this machine. With "
        "--launcher slurm: local, to try it here.",
        show_default=False,
        rich_help_panel=CLUSTER,
    ),
]
# type of the option ``--slurm``
Slurm = Annotated[
    list[str] | None,
    typer.Option(
        "--slurm",
        help="With --launcher slurm, NAME=VALUE of what a job asks for: partition, account, qos, "
        "constraint, minutes (60), memory_gb (2). Repeatable.",
        show_default=False,
        rich_help_panel=CLUSTER,
    ),
]
# type of an argument that is a data set
Dataset = Annotated[
    str, typer.Argument(help="Name of a file in conf/dataset.", autocompletion=DATASETS)
]


# type of the arguments that are overrides
Overrides = Annotated[
    list[str] | None,
    typer.Argument(
        help="key=value …, in Hydra's grammar.", autocompletion=OVERRIDES, show_default=False
    ),
]


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", is_eager=True)
    ] = False,
) -> None:
    if version:
        echo(f"vehest {__version__}")
        raise typer.Exit


@app.command("new")
def new_car(
    name: Annotated[
        str, typer.Argument(help="Name of the new data set, such as my_car.", show_default=False)
    ],
    files: Annotated[
        list[Path],
        typer.Argument(
            help="Logs of one car with the same columns, a recording each.", show_default=False
        ),
    ],
    yes: Annotated[
        bool,
        typer.Option(
            "--yes", "-y", help="Accept all proposals, ask nothing, and list open questions."
        ),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite existing files.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="List the files that would be written; write nothing.")
    ] = False,
    answer: Annotated[
        list[str] | None,
        typer.Option(
            "--answer",
            "-a",
            help="KEY=ANSWER beforehand, with a KEY that --json lists as open, or any column: "
            "COLUMN=CHANNEL UNIT; repeatable.",
        ),
    ] = None,
    wheelbase: Annotated[
        float | None, typer.Option("--wheelbase", min=0.0, help="Of the car [m].")
    ] = None,
    mass: Annotated[float | None, typer.Option("--mass", min=0.0, help="Of the car [kg].")] = None,
    steering_ratio: Annotated[
        float | None,
        typer.Option("--steering-ratio", help="Overall steering ratio."),
    ] = None,
    with_estimators: Annotated[
        list[str] | None,
        typer.Option(
            "--with",
            metavar="NAME|PACKAGE.MODULE:CLASS",
            help="Compare also this estimator: a built-in family "
            f"({', '.join(choices('estimator'))}) or an installed class of your own; repeatable.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Start with logs of your own car: `vehest new my_car lap*.csv`.

    Proposes for every column channel, unit, sign and delay, with its evidence, asks where the logs
    do not decide, and writes conf/dataset, conf/split and pipelines/my_car.yaml; where the logs
    have no reference, conf/dataset alone, and the command that estimates without one. Reads tables,
    Parquet, MAT-files, MDF, VBO, ROS 2 bags, and logs of a CAN bus with their DBC: `vehest new
    my_car drive.blf car.dbc`. With --json nothing is asked.
    """
    require_paths(files)
    from vehest.run.console import Messages

    vehicle = {"wheelbase": wheelbase, "mass": mass, "steering_ratio": steering_ratio}
    with Messages().running("inspect", ", ".join(file.name for file in files)):
        from vehest.run.own_car.inspect import inspect

        examined = inspect(name, files, vehicle, force=force or dry_run)
    emit(False, None, [] if as_json else examined.in_words())
    from vehest.run.own_car.questions import ask
    from vehest.run.own_car.write import (
        found_in,
        registered,
        write,
    )  # with torch: a file that is refused is so without it

    try:
        extra_estimators = [registered(word) for word in with_estimators or []]
        examined, left = ask(examined, answer or [], interactive=not (yes or as_json))
        outcome = write(examined, left, extra_estimators, dry_run=dry_run)
    except VehestError as error:
        emit(as_json, {**found_in(examined), "stopped": str(error)}, [])
        raise
    emit(as_json, *outcome)


@app.command(epilog=_offered("dataset"), rich_help_panel=STAGES)
def ingest(
    dataset: Dataset,
    overrides: Overrides = None,
    download: Annotated[
        bool,
        typer.Option(
            "--download",
            help="First fetch missing files, and compare checksums.",
        ),
    ] = False,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    jobs: Jobs = None,
) -> None:
    """Read raw files, or simulate, into the store: `vehest ingest ferrari_250lm root=FOLDER`."""
    from vehest.run.ingest import download_files
    from vehest.run.study_run import open_runner

    config = _compose("ingest", [f"dataset={dataset}", *(overrides or [])])
    with open_runner(config, RunOptions(force, dry_run, quiet, jobs), ("ingest",)) as runner:
        if download:
            download_files(config, runner.messages, dry_run=dry_run)
        artefact = runner.ingest(config)
    emit(
        as_json,
        {
            "folder": str(artefact.folder),
            "recordings": sorted(Path(n).stem for n in artefact.outputs),
            "skipped": artefact.skipped,
        },
    )


@app.command(rich_help_panel=STAGES)
def simulate(
    dataset: Annotated[
        str,
        typer.Argument(
            help="Name of a simulated data set in conf/dataset.", autocompletion=DATASETS
        ),
    ],
    overrides: Overrides = None,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    jobs: Jobs = None,
) -> None:
    """Simulate a data set into the store: `vehest simulate sim_bmw seed=1`.

    The same seed gives the same samples. Drives are made in parallel; a run that was stopped
    continues with the missing ones. Drives that spin or leave the road are kept, flagged in their
    provenance, and counted.
    """
    from vehest.run.ingest import outcome_of, simulation_config
    from vehest.run.study_run import open_runner

    config = simulation_config(dataset, overrides or [])
    with open_runner(config, RunOptions(force, dry_run, quiet, jobs), ("ingest",)) as runner:
        artefact = runner.ingest(config)
    outcome = outcome_of(artefact)
    if not as_json:
        outcome |= {
            name: counted(drives) for name, drives in outcome.items() if isinstance(drives, list)
        }
    emit(as_json, {"folder": str(artefact.folder), **outcome, "skipped": artefact.skipped})


@app.command(epilog=_offered("dataset"), rich_help_panel=STAGES)
def downsample(
    dataset: Dataset,
    overrides: Overrides = None,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Resample a data set, anti-aliased: `vehest downsample ferrari_250lm rate_hz=20`."""
    from vehest.configuration.composition import positive_rate
    from vehest.run.study_run import open_runner

    config = _compose("downsample", [f"dataset={dataset}", *(overrides or [])])
    rate = positive_rate(config["rate_hz"], "rate_hz")
    with open_runner(config, RunOptions(force, dry_run, quiet), ("downsample",)) as runner:
        artefact = runner.downsample(runner.ingest(config), rate, config["downsample"])
    emit(as_json, {"folder": str(artefact.folder), "rate_hz": rate, "skipped": artefact.skipped})


@app.command(epilog=_offered("split", "estimator", "training", "tracking"), rich_help_panel=STAGES)
def train(
    overrides: Overrides = None,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Fit one estimator: `vehest train estimator=ksnn estimator.n_local=3 split=ferrari_drive
    seed=7`.

    Ctrl-C keeps the best weights so far; the same command continues from there.
    """
    from vehest.run.study_run import train_estimator

    emit(as_json, train_estimator(overrides or [], RunOptions(force, dry_run, quiet, track=True)))


@app.command("eval", epilog=_offered("split", "estimator", "fault"), rich_help_panel=STAGES)
def evaluate(
    overrides: Overrides = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            "-m",
            help=(
                "A model's folder, or the start of its name, `pretrained` or `self_calibrating`; "
                "by default what the overrides train."
            ),
            autocompletion=MODELS,
        ),
    ] = None,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Score a fitted estimator on the test ranges of a split: `vehest eval estimator=ksnn seed=7`,
    with the overrides of its training.

    Or name the model: `vehest eval --model ksnn-linear_bias_p2-seed2 split=ferrari_drive`. With a
    sensor's fault as a further condition: `vehest eval estimator=ksnn fault=frozen
    fault.channel=yaw_rate fault.severity=severe`.
    """
    from vehest.run.study_run import evaluate_model

    emit(
        as_json,
        evaluate_model(overrides or [], model, RunOptions(force, dry_run, quiet, track=True), note),
    )


@app.command()
def estimate(
    model: Annotated[
        str,
        typer.Argument(
            metavar="MODEL|FILE",
            help=(
                "A model's folder, or the start of its name; or the recording at once, for the "
                "filter that comes with vehest."
            ),
            autocompletion=MODELS,
        ),
    ],
    recording: Annotated[
        str | None,
        typer.Argument(
            metavar="FILE",
            help=(
                "The recording after a model: a table, or with dataset=NAME one of its format; "
                "it needs no reference channels."
            ),
            show_default=False,
        ),
    ] = None,
    overrides: Overrides = None,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            help="Where to write the estimate: .parquet, .csv, or the log with it: .mf4, .mat.",
        ),
    ] = Path("estimate.parquet"),
    car: Annotated[
        Path | None,
        typer.Option(
            "--car",
            help="A car's record by `vehest identify`, which the filter starts from.",
            show_default=False,
        ),
    ] = None,
    strict: Annotated[
        bool,
        typer.Option(
            "--strict",
            help="Exit code 3 and no file where a check finds something in the channels read.",
        ),
    ] = False,
    plot: Annotated[
        Path | None,
        typer.Option(
            "--plot",
            help="Draw recording and estimate, as `vehest plot` does: .png, .pdf, .svg, .html.",
            show_default=False,
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Run a trained model on a new recording: `vehest estimate MODEL lap.csv -o out.parquet`.

    The table contains v [m/s], β [rad and deg], half widths of their calibrated 90 % bands, and the
    health of each sample: 0 valid, 1 degraded, 2 invalid. An .mf4 is the log, MDF 4, with these as
    channels of their own, a .mat the log's channels and these.

    For a car without a model of its own, leave the model out: `vehest estimate lap.csv
    estimator.wheelbase=2.7` uses the self-calibrating filter, with a note; estimator.smoothed=true
    smooths over the whole drive (offline).

    Columns named like channels, in SI units, are read as they are; others are described once by
    `vehest new NAME lap.csv`, then add `dataset=NAME`.
    """
    words = [word for word in (model, recording, *(overrides or [])) if word is not None]
    logs, _ = files_and_overrides(words[:2])  # the recording comes last, after a model, if any
    require_paths([*logs[-1:], car])
    from vehest.run.estimate import estimate_file
    from vehest.run.estimate_summary import summary_lines

    if plot is not None:
        from vehest.run.plot import check_plot_of_estimate, plot_estimate

        check_plot_of_estimate(out, plot)
    outcome = estimate_file(words, out, strict=strict, car=car)
    if plot is not None:
        plot_estimate(words, out, plot)
        outcome["plot"] = str(plot)
    emit(as_json, outcome, summary_lines(outcome))


@app.command("plot")
def plot_drive(
    recording: Annotated[
        str,
        typer.Argument(
            metavar="FILE", help="The recording: a table, or with dataset=NAME one of its format."
        ),
    ],
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ESTIMATE]... [OVERRIDES]...",
            help=(
                "Tables of estimates, of `vehest estimate` or another tool; key=value …, as of "
                "`vehest estimate`."
            ),
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Picture to write: .png, .pdf, .svg, or .html, a page."),
    ] = Path("drive.png"),
    start: Annotated[
        float | None, typer.Option("--start", help="Start of the drawn range [s].")
    ] = None,
    stop: Annotated[
        float | None, typer.Option("--stop", help="End of the drawn range [s].")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Draw a recording and estimates of it: `vehest plot lap.csv estimate.parquet -o drive.pdf`.

    β with the 90 % band and the health of the first estimate, v, the measured channels, the course
    in colours of β; with a reference also estimate over reference. The course is integrated from
    u, v and the yaw rate, and drifts over minutes.
    """
    all_words = [recording, *(words or [])]
    require_paths(files_and_overrides(all_words)[0])
    from vehest.run.plot import plot_files

    emit(as_json, plot_files(all_words, out, start, stop))


@app.command()
def identify(
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE... [OVERRIDES]...",
            help="Drives of a car; then estimator.wheelbase=2.7 and the like.",
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="The car's record to write, .yaml.")
    ] = Path("my_car.yaml"),
    as_json: AsJson = False,
) -> None:
    """Identify a car's parameters on its drives, without a reference: `vehest identify lap*.csv
    estimator.wheelbase=2.7 -o my_car.yaml`.

    Roll leakage, rear axle, its compliance and grip limit, each with its deviation. `vehest
    estimate lap.csv --car my_car.yaml` starts from wheelbase, leakage and rear axle.
    """
    require_paths(files_and_overrides(words)[0])
    from vehest.run.identify import identify_files, record_table

    record = identify_files(words, out)
    emit(as_json, {"out": str(out), **asdict(record)}, [record_table(record), f"out: {out}"])


@app.command()
def replay(
    log: Annotated[
        Path, typer.Argument(metavar="LOG", help="Frames of a bus: .asc, .blf, or .log of candump.")
    ],
    overrides: Overrides = None,
    model: Annotated[
        str,
        typer.Option(
            "--model",
            "-m",
            help=(
                "A model's folder, or the start of its name, `self_calibrating`; by default the "
                "pre-trained one."
            ),
            autocompletion=MODELS,
        ),
    ] = "pretrained",
    dbc: Annotated[
        Path | None,
        typer.Option("--dbc", help="DBC file of the bus; by default that of the data set."),
    ] = None,
    dataset: Annotated[
        str | None,
        typer.Option(
            "--dataset",
            help="A data set of the source can, which maps signals to channels.",
            autocompletion=DATASETS,
        ),
    ] = None,
    signals: Annotated[
        str,
        typer.Option(
            "--signals",
            help="CHANNEL=MESSAGE.SIGNAL, separated by commas, for signals that are not called "
            "like channels; a minus before the signal "
            "where it counts the other way than ISO 8855, :UNIT behind it where the DBC says none.",
        ),
    ] = "",
    speed: Annotated[
        str, typer.Option("--speed", help="Multiple of real time, or max: as fast as possible.")
    ] = "1",
    bus_rate: Annotated[
        float | None,
        typer.Option(
            "--bus-rate",
            help="Samples a second [Hz]; by default as many as the fastest message has frames.",
        ),
    ] = None,
    interface: Annotated[
        str, typer.Option("--interface", help="Of python-can: virtual, socketcan, …")
    ] = "virtual",
    channel: Annotated[
        str, typer.Option("--channel", help="Of the interface, for example vcan0.")
    ] = "vehest",
    identifier: Annotated[
        str,
        typer.Option(
            "--id", help="Identifier of the estimates' frames; that of their bands is the next one."
        ),
    ] = "0x6F0",
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help=(
                "Where estimates go: .csv, or .asc for their frames, with the DBC that describes "
                "them beside it."
            ),
        ),
    ] = None,
    write_dbc: Annotated[
        Path | None,
        typer.Option("--write-dbc", help="Write the DBC of the estimates' frames here."),
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Replay a log's frames on a bus and let a model estimate online from them: `vehest replay
    drive.asc --dbc car.dbc -m MODEL`.

    Estimates go onto the bus as frames, at --out into a file, and to the terminal. Frames that are
    lost or late are missing samples. Ctrl-C ends it; written files stay.
    """
    options: dict[str, Any] = {
        name: value
        for name, value in locals().items()
        if name not in ("log", "overrides", "as_json")
    }
    require_paths([log, dbc])
    from vehest.run.replay import replay_log
    from vehest.run.signals import StopSignals

    stop = StopSignals()
    with stop.installed(), stop.deferred():
        outcome = replay_log(log, overrides or [], stop.requested, note, **options)
    emit(as_json, outcome)
    if stop.number is not None:
        raise typer.Exit(128 + stop.number)


@app.command()
def export(
    model: Annotated[
        str,
        typer.Argument(
            help="A model's folder, or the start of its name; or pretrained, or self_calibrating.",
            autocompletion=MODELS,
            show_default=False,
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", help="The folder to write; an earlier export there is replaced."
        ),
    ] = Path("export"),
    precision: Annotated[
        str, typer.Option("--precision", help="Of all numbers: double or float.")
    ] = "double",
    bus_rate: Annotated[
        float | None,
        typer.Option(
            "--bus-rate",
            metavar="HZ",
            help="Rate at which samples come, if it is above the model's [Hz].",
            show_default=False,
        ),
    ] = None,
    elsewhere: Annotated[
        bool,
        typer.Option(
            "--elsewhere",
            help="For a car or tyres that the model was not calibrated on: bands twice as wide. "
            "With dataset=NAME the data set's car decides, too.",
        ),
    ] = False,
    vectors: Annotated[
        Path | None,
        typer.Option(
            "--vectors",
            metavar="LOG",
            help="Recording for the test vectors, read as by `vehest estimate`.",
            show_default=False,
        ),
    ] = None,
    overrides: Overrides = None,
    onnx: Annotated[
        bool,
        typer.Option(
            "--onnx",
            help=(
                "Write a network as one step in ONNX instead, with its state going in and out; "
                "-o names the file."
            ),
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Write a model as C99 for a control unit: `vehest export MODEL -o c --precision float`.

    One step with explicit state: the method with the checks of its samples, band and health; a
    Makefile, a program that runs a drive from a file, test vectors, and a README with units.

    dataset=NAME gives the values of the car, as for `vehest estimate`, and so does
    dataset.car.wheelbase=2.7 without one.
    """
    require_paths([vectors])
    from vehest.api import read_recording
    from vehest.configuration.estimate_options import estimate_options
    from vehest.export.folder import export_model
    from vehest.inference.estimation import prepared_recording
    from vehest.run.estimate import model_for_car

    options = estimate_options(overrides or [])
    folder, fitted, trust, is_other = model_for_car(model, options, note)
    if onnx and vectors is not None:
        raise ConfigurationError("--vectors are of C, --onnx writes none; leave one out")
    drive = (
        None
        if vectors is None
        else prepared_recording(fitted, read_recording(vectors, overrides or []), bus_rate)
    )
    if onnx:
        from vehest.export.onnx_model import write_onnx

        write_onnx(fitted, out)
    else:
        elsewhere = elsewhere or is_other
        export_model(fitted, trust, out, precision, bus_rate, elsewhere=elsewhere, drive=drive)
    emit(as_json, {"out": str(out), "model": str(folder)})


@app.command()
def compare(
    recording: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A recording with its reference: a table, or with dataset=NAME any.",
        ),
    ],
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ESTIMATE]... [OVERRIDES]...",
            help=(
                "Tables with time and v [m/s] or β [rad or deg], made by any tool, or by `vehest "
                "estimate`; then key=value …"
            ),
            show_default=False,
        ),
    ] = None,
    models: Annotated[
        list[str] | None,
        typer.Option(
            "--model",
            "-m",
            help="A model to run on the recording and compare too; repeatable.",
            autocompletion=MODELS,
        ),
    ] = None,
    columns: Annotated[
        list[str] | None,
        typer.Option(
            "--column",
            metavar="QUANTITY=COLUMN",
            help="Column of time, vy or sideslip in a table of another tool, such as "
            "sideslip=Beta_CarMaker or sideslip=-Beta:deg: a minus where it counts the other "
            "way than ISO 8855, :UNIT where the name has none; repeatable.",
            show_default=False,
        ),
    ] = None,
    shift: Annotated[
        str,
        typer.Option(
            "--shift",
            metavar="SECONDS|auto",
            help=(
                "Added to the times of other tools' tables; auto: by correlation with the "
                "reference."
            ),
        ),
    ] = "0",
    as_json: AsJson = False,
) -> None:
    """Score estimates of any tool on one recording: `vehest compare lap.csv mine.csv theirs.csv`.

    The zero-sideslip baseline and a static map, fitted on the other half of the drive, are scored
    too. Scores cover the part that all estimates have, with 95 % intervals over blocks of the
    drive; an estimate is called best only if it is significantly below all others. A model that was
    trained on the recording is listed and left out of the verdict.
    """
    require_paths([recording, *files_and_overrides(words or [])[0]])
    from vehest.run.compare_files import compare_files

    emit(as_json, *compare_files(recording, words or [], models or [], columns or [], shift))


@app.command()
def run(
    pipeline: Annotated[
        str, typer.Argument(help="A file in pipelines/, or its name.", autocompletion=PIPELINES)
    ],
    overrides: Overrides = None,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    jobs: Jobs = None,
    minutes: Annotated[
        float | None,
        typer.Option(
            help=(
                "Stop after this time, report included; unfinished jobs are listed, and the same "
                "command continues with them."
            )
        ),
    ] = None,
    retrain: Annotated[
        bool, typer.Option("--retrain", help="Train also what is published with weights.")
    ] = False,
    train_missing: Annotated[
        bool | None,
        typer.Option(
            "--train-missing/--no-train-missing",
            help="Train what is neither here nor published, or leave it out and name it in the "
            "report. By default it is trained, unless "
            "results/STUDY is published without some trainings.",
            show_default=False,
        ),
    ] = None,
    publish_weights: Annotated[
        bool,
        typer.Option(
            "--publish-weights",
            help=(
                "Add the weights of each training to results/STUDY/weights.safetensors as it "
                "ends, instead of those of all with the report."
            ),
        ),
    ] = False,
    launcher: LauncherName = "local",
    address: Address = None,
    slurm: Slurm = None,
) -> None:
    """Run a whole study: ingest, downsample, train, evaluate, report: `vehest run
    pipelines/quickstart.yaml`.

    Existing artefacts are reused, and so are published weights of trainings with the same key.
    Overrides apply to every sweep that has their key. Sweeps run in the order of the file.
    """
    options = RunOptions(
        force,
        dry_run,
        quiet,
        jobs,
        minutes=minutes,
        retrain=retrain,
        train_missing=train_missing,
        publish_weights=publish_weights,
        launcher=launcher,
        address=address,
        slurm=slurm or (),
    )
    _run_study(pipeline, overrides or [], options, as_json)


@app.command()
def report(
    pipeline: Annotated[
        str | None,
        typer.Argument(
            help=(
                "A file in pipelines/, or its name; with --check studies or pipelines, or none "
                "for all."
            ),
            autocompletion=PIPELINES,
            show_default=False,
        ),
    ] = None,
    overrides: Overrides = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Draw nothing; list published results in ./results, of all or the named studies, "
            "that differ from today's code, configuration and data.",
        ),
    ] = False,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Draw a study's tables, figures and page from existing artefacts; trains nothing.

    `vehest report --check` needs neither models nor an output root. A line a study: up to date;
    stale, and what has changed; or not known. Exit code 3 unless all are up to date; without names,
    those that results/stale.yaml lists may be stale.
    """
    if check:
        from vehest.run.console import Messages

        messages = Messages(quiet=quiet)
        with messages.running("import", "vehest"):
            from vehest.run.published import check_listed, check_published, describe_verdict

        words = [word for word in (pipeline, *(overrides or [])) if word is not None]
        names, overrides_of_check = files_and_overrides(words)
        verdicts = (
            check_published(names, overrides_of_check, messages)
            if names
            else check_listed(overrides_of_check, messages)
        )
        emit(as_json, verdicts, map(describe_verdict, verdicts))
        failed = any(
            verdict["failure"] if "failure" in verdict else verdict["state"] != "up to date"
            for verdict in verdicts
        )
        raise typer.Exit(3 if failed else 0)
    if pipeline is None:
        raise ConfigurationError(
            f"no pipeline is named; there are: {', '.join(pipeline_names())}; or use --check"
        )
    _run_study(
        pipeline, overrides or [], RunOptions(force, dry_run, quiet, 1), as_json, only_report=True
    )


@app.command(epilog=_offered("split", "estimator", "training", "fault", "tracking"))
def sweep(
    overrides: Overrides = None,
    name: Annotated[
        str | None,
        typer.Option(
            "--name",
            help="Start of the folder's name; by default the estimators and the split.",
            show_default=False,
        ),
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
    """Train and score all combinations of several values: `vehest sweep estimator=ksnn
    estimator.n_local=2,3 seed='range(5)'`.

    Prints the mean RMSE(β) of each combination over its seeds with a 95 % confidence interval
    (Student's t), and marks the one that is best on the validation range. Existing artefacts are
    reused, the other jobs continue where one fails, and the same command completes what is missing.
    """
    options = RunOptions(
        force, dry_run, quiet, jobs, launcher=launcher, address=address, slurm=slurm or ()
    )
    _run_study(name, overrides or [], options, as_json, sweep=True)


@app.command("config", rich_help_panel=STAGES)
def show_config(
    command: Annotated[
        str,
        typer.Argument(
            help="ingest, downsample, train, eval or estimate.",
            autocompletion=_offer(lambda: COMMANDS),
        ),
    ],
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Print the resolved configuration of a command: `vehest config train estimator=gru`."""
    if command not in COMMANDS:
        raise ConfigurationError(f"'{command}' is not one of: {', '.join(COMMANDS)}")
    from vehest.configuration.composition import OVERRIDDEN_RATES_KEY
    from vehest.run.setting_lines import config_as_commented_yaml

    config = {
        key: value
        for key, value in _compose(command, overrides or []).items()
        if key != OVERRIDDEN_RATES_KEY
    }
    text = as_json_text(config) if as_json else config_as_commented_yaml(config).rstrip()
    echo(text, keep="\n")


@app.command(rich_help_panel=STAGES)
def prune(
    overrides: Overrides = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Remove without asking.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="List what would be removed; remove nothing.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """List artefacts that no current configuration can reuse, ask, and remove them: `vehest prune
    output=FOLDER`.

    These are artefacts of other versions, damaged or half-written ones, and those whose inputs are
    gone. Models and recordings of current versions stay with any settings, and so do files that
    vehest has not made.
    """
    from vehest.run.prune import remove_unused, unused_artefacts

    config = _compose("estimate", overrides or [])
    if as_json and not (yes or dry_run):
        raise ConfigurationError("with --json nothing is asked; add --yes to remove, or --dry-run")
    unused = unused_artefacts(Path(str(config["output"])))
    total = sum(entry["bytes"] for entry in unused)
    rows = [
        [
            entry["path"],
            f"{entry['bytes'] / 1e6:.3f} MB",
            str(timedelta(seconds=entry["seconds"])),
            entry["reason"],
        ]
        for entry in unused
    ]
    tables = [TerminalTable(("cannot be reused", "size", "age", "since"), rows)] if unused else []
    emit(
        False,
        None,
        []
        if as_json
        else [
            *tables,
            f"{len(unused)} to remove, {total / 1e6:.3f} MB" if unused else "nothing to remove",
        ],
    )
    removed: list[str] = []
    if unused and not dry_run:
        if not yes and not sys.stdin.isatty():
            raise ConfigurationError("no terminal for questions; use --yes to remove, or --dry-run")
        if yes or typer.confirm("Remove them?"):
            remove_unused(
                [Path(entry["path"]) for entry in unused], lambda path: removed.append(str(path))
            )
    emit(
        as_json,
        {"found": unused, "bytes": total, "removed": removed},
        [f"{len(removed)} removed"] if removed else [],
    )


@app.command()
def doctor(as_json: AsJson = False) -> None:
    """Check the environment: working and missing parts on this machine."""
    from vehest.run.doctor import examine

    items = list(examine())
    emit(
        as_json,
        [asdict(item) for item in items],
        [f"{item.level:<7} {item.name}: {item.message}" for item in items],
    )
    if any(item.level == "error" for item in items):
        raise typer.Exit(4)


@data_app.command("list")
def data_list(as_json: AsJson = False) -> None:
    """List the data sets that conf/dataset offers, with their licences and what to cite.

    Exit code 2 after the list if some file there cannot be read, which the error names.
    """
    from vehest.run.inspect_data import list_datasets

    rows, lines, errors = list_datasets()
    emit(as_json, rows, lines)
    if errors:
        raise ConfigurationError("; ".join(errors))


@data_app.command("channels")
def data_channels(as_json: AsJson = False) -> None:
    """List all channels with units and signs."""
    from vehest.data.channels import CHANNELS

    table = TerminalTable(
        ("channel", "unit", "meaning"), [[c.name, c.unit, c.meaning] for c in CHANNELS.values()]
    )
    emit(
        as_json,
        {name: {"unit": c.unit, "meaning": c.meaning} for name, c in CHANNELS.items()},
        [table],
    )


@data_app.command("show")
def data_show(
    source: Annotated[
        str,
        typer.Argument(
            help="A data set, or a table (CSV, Parquet, .mat).", autocompletion=DATASETS
        ),
    ],
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Show recordings: channels, rate, duration, ranges."""
    require_dataset_or_file(source)
    from vehest.run.inspect_data import describe

    emit(as_json, *describe(source, overrides or []))


@data_app.command("check")
def data_check(
    source: DatasetOrFile,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Look for gaps, bad clocks, NaN, stuck and saturated channels, impossible values, wrong units
    and signs; exit code 3 on errors.
    """
    require_dataset_or_file(source)
    from vehest.run.inspect_data import check

    findings, lines = check(source, overrides or [])
    emit(as_json, findings, lines)
    if any(row["level"] == "error" for row in findings):
        raise typer.Exit(3)


@data_app.command("usable")
def data_usable(
    source: DatasetOrFile,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """List for every estimator whether these recordings suffice, which channels are missing, and
    how to supply them.
    """
    require_dataset_or_file(source)
    from vehest.run.inspect_data import examine_usability

    emit(as_json, *examine_usability(source, overrides or []))


@data_app.command("align")
def data_align(
    source: Annotated[
        str,
        typer.Argument(
            help="A data set, or a table (CSV, Parquet, .mat).", autocompletion=DATASETS
        ),
    ],
    overrides: Overrides = None,
    estimate: Annotated[
        str,
        typer.Option(
            "--estimate",
            "-e",
            help=(
                "What to estimate, separated by commas: lever_arm, mounting, delay, offsets, "
                "steering_ratio."
            ),
        ),
    ] = "",
    recording: Annotated[
        str | None, typer.Option("--recording", "-r", help="Which recording of the data set.")
    ] = None,
    wheelbase: Annotated[
        float | None, typer.Option("--wheelbase", help="For the steering ratio [m].")
    ] = None,
    steering_channel: Annotated[
        str | None,
        typer.Option(
            "--steering-channel",
            help="Channel whose steering ratio is estimated; by default handwheel, else steer.",
        ),
    ] = None,
    cutoff: Annotated[
        float | None,
        typer.Option(
            "--cutoff",
            help="Cut-off of the low-pass on both sides [Hz]; by default 2, or less below 23 Hz.",
        ),
    ] = None,
    max_delay: Annotated[
        float, typer.Option("--max-delay", help="Largest delay to look for, either way [s].")
    ] = 0.5,
    tilt: Annotated[
        float,
        typer.Option(
            "--tilt",
            help=(
                "Roll and pitch of the body beyond what follows the accelerations [rad]; 0: free "
                "of gravity."
            ),
        ),
    ] = 0.001,
    max_ay: Annotated[
        float,
        typer.Option(
            "--max-ay",
            help="For the steering ratio: lateral acceleration up to which it is used [m/s²].",
        ),
    ] = 3.0,
    min_speed: Annotated[
        float,
        typer.Option(
            "--min-speed", help="For the steering ratio: speed from which it is used [m/s]."
        ),
    ] = 5.0,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for report, table and transforms.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Estimate lever arm, rotation, delay and offsets of the sensors, and the steering ratio:
    `vehest data align lap.csv -e delay,offsets`.

    Prints the estimates with their uncertainty, and the transforms that would correct it. Applies
    nothing.
    """
    require_dataset_or_file(source)
    from vehest.alignment.settings import AlignmentSettings
    from vehest.run.align import align_recording, alignment_lines, as_plain, write_alignment

    quantities = tuple(dict.fromkeys(name.strip() for name in estimate.split(",") if name.strip()))
    settings = AlignmentSettings(
        quantities, cutoff, max_delay, tilt, wheelbase, steering_channel, max_ay, min_speed
    )
    alignment = align_recording(source, overrides or [], recording, settings)
    if out is not None:
        write_alignment(alignment, out)
    emit(
        as_json,
        {**as_plain(alignment), "out": None if out is None else str(out)},
        alignment_lines(alignment, out),
    )


def main() -> None:
    """Entry point: every expected failure is one line and an exit code."""
    from vehest.run.signals import DryRunStop, Stopped, StopSignals

    # New objects, after which cycles are looked for: at 700, libraries and compilers spend 8 % of a
    # run on it.
    gc.set_threshold(10_000)
    open_streams()
    stop = StopSignals()
    try:
        with stop.installed():
            code = app(prog_name="vehest", standalone_mode=False)
            stop.raise_if_requested()
    except _USAGE_ERROR as error:
        _fail_usage(error)
    except DryRunStop:
        code = 0
    except (OutputClosed, BrokenPipeError):
        silence(sys.stdout)
        sys.exit(141)
    except Stopped as stopped:
        _fail(
            f"stopped by {stopped}; finished artefacts are kept, the same command goes on",
            stopped.exit_code,
        )
    except typer.Abort:
        _fail("stopped", 130)
    except Exception as error:
        from vehest.run.failures import failure_of

        failure = failure_of(error)
        if failure.exit_code != 1:
            _fail(failure.message, failure.exit_code)
        if os.environ.get("VEHEST_DEBUG"):
            raise
        _fail(f"this is a defect of vehest ({failure.message}); VEHEST_DEBUG=1 shows where", 1)
    if code == 130:
        _fail("stopped", 130)
    sys.exit(code if isinstance(code, int) else 0)


_USAGE_ERROR: Any = typer.BadParameter.__mro__[1]
"""Base of the exceptions of Typer for options, arguments and commands that it does not know; newer
ones carry their own copy of Click.
"""


def _fail_usage(error: Any) -> None:
    """End with exit code 2 and one line on a wrong usage."""
    context = error.ctx
    if type(error).__name__ == "NoArgsIsHelpError":  # the help is on the screen
        sys.exit(error.exit_code)
    words = error.format_message().strip().rstrip(".").replace(". Did you mean", "; did you mean")
    words = re.sub(r" \(Possible options: (.*)\)$", r"; did you mean \1?", words)
    words = words.replace(NOT_A_NUMBER, "a number is required, with a decimal point (2.4)")
    key = str(getattr(error, "option_name", "")).lstrip("-").partition("=")[0]
    if key in GROUPS or key in ROOT_KEYS or "." in key:
        hint = f"keys of the configuration are written without dashes: {key}=…"
    else:
        hint = (
            f"'{context.command_path if context else 'vehest'} --help' lists commands and options"
        )
    _fail(
        f"{words[:1].lower()}{words[1:]}{'' if words.endswith('?') else ';'} {hint}",
        error.exit_code,
    )


def _fail(message: str, exit_code: int) -> NoReturn:
    """End with a message of one line and an exit code."""
    line = printable(" ".join(message.split()))
    try:
        sys.stdout.flush()
    except (OSError, ValueError):
        silence(sys.stdout)
    complain(
        f"error: {line if len(line) <= MAX_ERROR_CHARACTERS else line[:MAX_ERROR_CHARACTERS] + '…'}"
    )
    sys.exit(exit_code)


def _run_study(
    name: str | None,
    overrides: list[str],
    options: RunOptions,
    as_json: bool,
    *,
    sweep: bool = False,
    only_report: bool = False,
) -> None:
    """Run a study or sweep, or repeat its record; prints tables and the report's path; raises
    `JobsFailedError` where some jobs failed.
    """
    if name is not None and not sweep:
        require_pipeline(name, overrides)
    from vehest.run.console import PLAN, Messages
    from vehest.run.run_cache import RunCache

    cache = RunCache("sweep" if sweep else "run", name or "", overrides)
    ran = cache.repeat(options)
    if ran is None:
        messages = Messages(quiet=options.quiet)
        with messages.running(PLAN, name or "sweep"):
            from vehest.run.study_run import run_study

            ran = run_study(
                name, overrides, options, cache, messages, sweep=sweep, only_report=only_report
            )
    page = ran.folder / ran.summary.page
    summary = ran.summary
    outcome: dict[str, Any] = {"folder": str(ran.folder), "skipped": ran.skipped}
    if not sweep:
        outcome = {"report": str(page), "published": str(ran.published) if ran.published else None}
    lines: list[str | TerminalTable] = [
        *summary.tables,
        *(summary.note.split("\n") if summary.note else []),
        f"report: {page}",
    ]
    emit(
        as_json,
        {**outcome, **json.loads(summary.figures)},
        [*lines, *([f"published: {ran.published}"] if ran.published else [])],
    )
    if ran.failed is not None:
        raise ran.failed


def _compose(command: str, overrides: list[str]) -> Config:
    """The resolved configuration of a command."""
    from vehest.configuration.composition import compose_config

    return compose_config(command, overrides)


if __name__ == "__main__":
    main()
