"""The command line: one thin function a command; what is heavy is imported inside it."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vehest.data.errors import ConfigurationError, VehestError
from vehest.stages.completion import complete_override
from vehest.stages.config_files import choices, is_simulated, pipeline_names, summary
from vehest.version import __version__

if TYPE_CHECKING:
    from vehest.stages.config import Config
    from vehest.stages.sweep import SweepOutcome
    from vehest.stages.workshop import Workshop

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

COMMANDS = ("ingest", "downsample", "train", "eval", "estimate")


def _offered(*groups: str) -> str:
    """Epilog that lists the choices of groups."""
    return "\n\n".join(f"**{group}**: {', '.join(choices(group))}" for group in groups)


def _completing(command: str) -> Callable[[typer.Context, str], list[tuple[str, str]]]:
    """Completion of a command's overrides."""

    def complete(context: typer.Context, incomplete: str) -> list[tuple[str, str]]:
        given = [str(word) for word in context.params.get("overrides") or []]
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
AsJson = Annotated[bool, typer.Option("--json", help="Print the outcome as one JSON object on standard output.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but warnings and the outcome.")]
Jobs = Annotated[int | None, typer.Option("--jobs", "-j", min=1, help="Processes that run side by side; by default one a core.")]
Dataset = Annotated[str, typer.Argument(help="Name of a file in conf/dataset.", autocompletion=_complete_dataset)]


def _overrides(command: str) -> Any:
    return typer.Argument(help="key=value …, in Hydra's grammar.", autocompletion=_completing(command), show_default=False)


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="Print the version and leave.", is_eager=True)] = False) -> None:
    if version:
        typer.echo(f"vehest {__version__}")
        raise typer.Exit


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
    config = _compose("ingest", [f"dataset={dataset}", *(overrides or [])])
    with _workshop(config, force={"ingest"} if force else set(), dry_run=dry_run, quiet=quiet, jobs=jobs) as workshop:
        if download:
            from vehest.stages.download import download_files

            download_files(config, workshop)
        artefact = workshop.ingest(config)
    _say(
        as_json, {"folder": str(artefact.folder), "recordings": sorted(Path(n).stem for n in artefact.outputs), "skipped": artefact.skipped}
    )


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
    from vehest.stages.simulate import outcome_of, simulation_config

    config = simulation_config(dataset, overrides or [])
    with _workshop(config, force={"ingest"} if force else set(), dry_run=dry_run, quiet=quiet, jobs=jobs) as workshop:
        artefact = workshop.ingest(config)
    outcome = outcome_of(artefact).as_plain()
    if not as_json:
        outcome |= {name: _counted(drives) for name, drives in outcome.items() if isinstance(drives, list)}
    _say(as_json, {"folder": str(artefact.folder), **outcome, "skipped": artefact.skipped})


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
    config = _compose("downsample", [f"dataset={dataset}", *(overrides or [])])
    rate = _positive(config["rate_hz"], "rate_hz")
    with _workshop(config, force={"downsample"} if force else set(), dry_run=dry_run, quiet=quiet) as workshop:
        artefact = workshop.downsample(workshop.ingest(config), rate, config["downsample"])
    _say(as_json, {"folder": str(artefact.folder), "rate_hz": rate, "skipped": artefact.skipped})


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
    from vehest.stages.group import Group

    config = _compose("train", overrides or [])
    with _workshop(config, force={"train"} if force else set(), dry_run=dry_run, quiet=quiet, track=True) as workshop:
        job = _train_job(config, workshop)
        members, failures = workshop.run_groups([Group([job], None, workshop.force)])
        _raise_failure(failures)
    from vehest.stages.train import read_fit_metrics

    model = members[0].model
    if model is not None:
        _say(as_json, {"model": str(model.folder), "status": model.status, "skipped": model.skipped, **read_fit_metrics(model.folder)})


@app.command("eval", epilog=_offered("split", "estimator"))
def evaluate(
    overrides: Annotated[list[str] | None, _overrides("eval")] = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            "-m",
            help="A model's folder, or the start of its name; without it, the model that the overrides train.",
            autocompletion=_complete_model,
        ),
    ] = None,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Score a fitted estimator on the test ranges of a split: `vehest eval estimator=ksnn seed=7`, with the overrides of its training.

    Or name the model: `vehest eval --model ksnn-linear_bias_p2-seed2 split=ferrari_drive`.
    """
    from vehest.stages.artefacts import find, read_artefact
    from vehest.stages.comparison import plain_resampling
    from vehest.stages.estimate import find_model, preparation_of
    from vehest.stages.evaluate import plan_evaluate, protocol_from_config, write_evaluation
    from vehest.stages.group import Evaluation
    from vehest.stages.workshop import test_figures

    config = _compose("eval", overrides or [])
    with _workshop(config, force={"evaluate"} if force else set(), dry_run=dry_run, quiet=quiet, track=True) as workshop:
        split, protocol = workshop.split(config), protocol_from_config(config["evaluation"])
        if model is not None:
            trained = read_artefact(find_model(model, workshop.output))
            if trained.stage != "train":
                raise ConfigurationError(f"'{trained.folder}' holds no model but what the stage '{trained.stage}' made")
            rate = float(trained.config["estimator"]["rate_hz"])
            if not _names("downsample", overrides):
                config["downsample"] = preparation_of(trained.folder)
        else:
            plan = _train_job(config, workshop).plan
            found, rate = find(plan), float(config["estimator"]["rate_hz"])
            if found is None:
                from vehest.data.errors import MissingError

                raise MissingError(f"{plan.label} has not been trained; run 'vehest train {' '.join(overrides or [])}' first")
            trained = found
        data, references = workshop.data_for(split, rate, config), workshop.data_for(split, protocol.rate_hz, plain_resampling(config))
        job = plan_evaluate(trained, split, data, references, workshop.kinds_of(split, config), protocol, workshop.output)
        artefact = workshop.ensure(job.plan, lambda folder: write_evaluation(job, folder))
        figures = test_figures(artefact)
        if not artefact.skipped:
            how = Evaluation(split, data, references, job.kinds, protocol, workshop.output)
            workshop.log_evaluation(artefact, trained, how, figures)
    _say(as_json, {"folder": str(artefact.folder), "skipped": artefact.skipped, **figures})


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
            help="The recording after a model: a CSV or Parquet file, which needs no reference channels.",
            show_default=False,
        ),
    ] = None,
    overrides: Annotated[list[str] | None, _overrides("estimate")] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Where to write the estimate: .parquet or .csv.")] = Path("estimate.parquet"),
    as_json: AsJson = False,
) -> None:
    """Run a trained model on a new recording: `vehest estimate MODEL lap.csv -o out.parquet`.

    For a car that nobody has trained on, leave the model out: `vehest estimate lap.csv` takes the one that comes with vehest and says so.

    Columns named like channels, in SI units, need no more; for others, describe them in conf/dataset/NAME.yaml and add `dataset=NAME`.
    """
    from vehest.estimators.model_files import load_model
    from vehest.stages.estimate import (
        PRETRAINED,
        SUFFIXES,
        estimate_recording,
        find_model,
        preparation_of,
        pretrained_note,
        read_table,
        summary_of,
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
    folder = find_model(name, Path(config["output"]))
    fitted = load_model(folder)
    downsample = config["downsample"] if _names("downsample", overrides) else preparation_of(folder)
    if out.is_dir():
        raise ConfigurationError(f"'{out}' is a folder; name a file")
    if out.exists() and file.exists() and out.samefile(file):
        raise ConfigurationError(f"'{out}' is the recording itself; name another file")
    result = estimate_recording(fitted, read_table(file, overrides), downsample)
    write_estimate_table(result, out)
    note = {"note": pretrained_note()} if name == PRETRAINED else {}
    _say(as_json, {"out": str(out), "model": str(folder) if not note else PRETRAINED, **summary_of(result), **note})


def _is_file_name(word: str) -> bool:
    """Whether a word is no override; a file that is there may have an ``=`` in its name."""
    return ("=" not in word and not word.startswith("~")) or Path(word).is_file()


@app.command()
def run(
    pipeline: Annotated[str, typer.Argument(help="A file in pipelines/, or its name.", autocompletion=_complete_pipeline)],
    overrides: Annotated[list[str] | None, _overrides("eval")] = None,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    jobs: Jobs = None,
) -> None:
    """Run a whole study: ingest, downsample, train, evaluate, report: `vehest run pipelines/quickstart.yaml`.

    What is there is skipped. Overrides apply to every sweep that has their key.
    """
    _run_pipeline(pipeline, overrides or [], dry_run=dry_run, force=force, as_json=as_json, quiet=quiet, jobs=jobs, only_report=False)


@app.command()
def report(
    pipeline: Annotated[str, typer.Argument(help="A file in pipelines/, or its name.", autocompletion=_complete_pipeline)],
    overrides: Annotated[list[str] | None, _overrides("eval")] = None,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Draw a study's tables, figures and page from what `vehest run` has made; trains nothing."""
    _run_pipeline(pipeline, overrides or [], dry_run=dry_run, force=force, as_json=as_json, quiet=quiet, jobs=1, only_report=True)


@app.command(epilog=_offered("split", "estimator", "training", "tracking"))
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
) -> None:
    """Train and score all combinations of several values: `vehest sweep estimator=ksnn estimator.n_local=2,3 seed='range(5)'`.

    Prints the mean RMSE(β) of each combination over its seeds with a 95 % confidence interval (Student's t), and marks the one that is best
    on the validation range. What is there is skipped, a failed job stops no other, the same command finishes what is missing.
    """
    from vehest.stages.sweep import plan_sweep, run_sweep

    planned = plan_sweep(overrides or [], name)
    forced = {"train", "evaluate", "sweep"} if force else set()
    with _workshop(planned.first, force=forced, dry_run=dry_run, quiet=quiet, jobs=jobs, track=True) as workshop:
        outcome = run_sweep(planned, workshop)
    table = json.loads(outcome.summary.to_json(orient="records"))
    if as_json:
        chosen = next((row for row in table if row["chosen"]), None)
        failed = [{"jobs": what, "message": reason} for what, reason in outcome.failures.items()]
        shown = {
            "folder": str(outcome.folder.folder),
            "skipped": outcome.folder.skipped,
            "chosen": chosen,
            "summary": table,
            "failed": failed,
        }
        typer.echo(_json(shown))
    else:
        _print_sweep(outcome)
    if not dry_run:
        outcome.raise_failures()


@app.command("config")
def show_config(
    command: Annotated[str, typer.Argument(help="ingest, downsample, train, eval or estimate.", autocompletion=_complete_command)],
    overrides: Annotated[list[str] | None, _overrides("train")] = None,
    as_json: AsJson = False,
) -> None:
    """Print the resolved configuration of a command: `vehest config train estimator=gru`."""
    if command not in COMMANDS:
        raise ConfigurationError(f"'{command}' is not one of: {', '.join(COMMANDS)}")
    from vehest.stages.config import as_yaml

    config = _compose(command, overrides or [])
    typer.echo(_json(config) if as_json else as_yaml(config).rstrip())


@app.command()
def doctor(as_json: AsJson = False) -> None:
    """Say what works on this machine and what is missing."""
    from vehest.stages.doctor import examine

    items = examine()
    if as_json:
        typer.echo(_json([item.__dict__ for item in items]))
    else:
        for item in items:
            mark = {"ok": "ok     ", "warning": "warning", "error": "error  "}[item.level]
            typer.echo(f"{mark} {item.name}: {item.message}")
    if any(item.level == "error" for item in items):
        raise typer.Exit(4)


@data_app.command("list")
def data_list(as_json: AsJson = False) -> None:
    """List the data sets that conf/dataset offers, with their licences and what to cite."""
    from vehest.stages.inspect_data import dataset_rows

    rows = dataset_rows()
    if as_json:
        typer.echo(_json(rows))
    else:
        shown = ("dataset", "kind", "source", "here", "title")
        _table(["data set", *shown[1:]], [[row[key] for key in shown] for row in rows])
        typer.echo("\nlicences and citations")
        for row in rows:
            typer.echo(f"{row['dataset']}: {row['licence']}\n  cite: {row['citation']}")


@data_app.command("channels")
def data_channels(as_json: AsJson = False) -> None:
    """List the channels that vehest knows, with units and signs."""
    from vehest.data.channels import CHANNELS

    if as_json:
        typer.echo(_json({name: {"unit": c.unit, "meaning": c.meaning} for name, c in CHANNELS.items()}))
    else:
        _table(["channel", "unit", "meaning"], [[c.name, c.unit, c.meaning] for c in CHANNELS.values()])


@data_app.command("show")
def data_show(
    source: Annotated[str, typer.Argument(help="A data set, or a CSV or Parquet file.", autocompletion=_complete_dataset)],
    overrides: Annotated[list[str] | None, _overrides("ingest")] = None,
    as_json: AsJson = False,
) -> None:
    """Show recordings: channels, rate, duration, ranges."""
    from vehest.stages.inspect_data import describe

    shown = describe(source, overrides or [])
    if as_json:
        typer.echo(_json(shown))
        return
    for recording in shown["recordings"]:
        typer.echo(
            f"{recording['id']}: {recording['kind']}, {recording['vehicle']}, {recording['rate_hz']:g} Hz, "
            f"{recording['start']:.6g} s to {recording['end']:.6g} s, {recording['samples']} samples"
        )
        rows = [[c["name"], c["unit"], *(f"{c[key]:.4g}" for key in ("min", "mean", "max", "std"))] for c in recording["channels"]]
        _table(["channel", "unit", "min", "mean", "max", "std"], rows)


@data_app.command("check")
def data_check(
    source: Annotated[str, typer.Argument(help="A data set, or a CSV or Parquet file.", autocompletion=_complete_dataset)],
    overrides: Annotated[list[str] | None, _overrides("ingest")] = None,
    as_json: AsJson = False,
) -> None:
    """Look for gaps, bad clocks, NaN, stuck and saturated channels, impossible values, wrong units and signs; exit code 3 on errors."""
    from vehest.stages.inspect_data import check

    findings = check(source, overrides or [])
    if as_json:
        typer.echo(_json(findings))
    else:
        for row in findings:
            channel = f" {row['channel']}:" if row["channel"] else ""
            typer.echo(f"{row['level']:<7} {row['recording']}:{channel} {row['message']}")
        if not findings:
            typer.echo("nothing found")
    if any(row["level"] == "error" for row in findings):
        raise typer.Exit(3)


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
    from vehest.data.alignment import AlignmentSettings
    from vehest.stages.align import (
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
        typer.echo(_json({**as_plain(found), "out": None if out is None else str(out)}))
        return
    typer.echo(f"{found.recording_id}: {found.kind}, {found.duration:.6g} s at {found.rate_hz:g} Hz; nothing is applied")
    _table([*PARAMETER_HEADER], parameter_rows(found))
    if found.residuals:
        typer.echo("")
        _table([*RESIDUAL_HEADER], residual_rows(found))
    for note in found.notes:
        typer.echo(f"note: {note}")
    typer.echo(f"to correct it: '{override_of(found)}'")
    if out is not None:
        typer.echo(f"written: {out}")


def main() -> None:
    """Entry point: every expected failure is one line and an exit code."""
    from vehest.stages.signals import Stopped

    try:
        app()
    except VehestError as error:
        _fail(str(error), error.exit_code)
    except Stopped as stopped:
        _fail(f"stopped by {stopped}; what was finished is kept, the same command goes on", stopped.exit_code)
    except KeyboardInterrupt:
        _fail("stopped", 130)
    except BrokenPipeError:
        sys.stderr.close()
        sys.exit(141)
    except OSError as error:
        from vehest.data.files import writing_error

        if error.filename is None:
            raise
        wrapped = writing_error(Path(error.filename), error)
        _fail(str(wrapped), wrapped.exit_code)
    except Exception as error:
        if os.environ.get("VEHEST_DEBUG"):
            raise
        _fail(f"this is a defect of vehest ({type(error).__name__}: {error}); VEHEST_DEBUG=1 shows where", 1)


def _fail(message: str, exit_code: int) -> None:
    typer.echo(f"error: {' '.join(message.split())}", err=True)
    sys.exit(exit_code)


def _run_pipeline(
    name: str, overrides: list[str], *, dry_run: bool, force: bool, as_json: bool, quiet: bool, jobs: int | None, only_report: bool
) -> None:
    from vehest.stages.pipeline import content_overrides, pipeline_configs, read_pipeline, run_pipeline

    pipeline = read_pipeline(name)
    configs = pipeline_configs(pipeline, overrides)
    forced = {"report"} if only_report else {"ingest", "downsample", "train", "evaluate", "report"}
    with _workshop(next(iter(configs.values()))[0], force=forced if force else set(), dry_run=dry_run, quiet=quiet, jobs=jobs) as workshop:
        outcome = run_pipeline(pipeline, configs, content_overrides(overrides), workshop, only_report=only_report)
    page = outcome.report.folder / "report.html"
    if as_json:
        shown = ("leaderboard", outcome.leaderboard) if outcome.overview is None else ("overview", outcome.overview)
        published = str(outcome.published) if outcome.published else None
        typer.echo(_json({"report": str(page), "published": published, shown[0]: json.loads(shown[1].to_json(orient="records"))}))
        return
    if outcome.overview is not None:
        _table([*outcome.overview.columns], [[_cell(value) for value in row] for row in outcome.overview.itertuples(index=False)])
        typer.echo(f"report: {page}")
        if outcome.published is not None:
            typer.echo(f"published: {outcome.published}")
        return
    for test_set, rows in outcome.leaderboard.groupby("test_set", sort=False):
        given = " (estimates start at the reference state)" if (rows["start"] == "reference").any() else ""
        typer.echo(f"\n{pipeline.title}: test set '{test_set}'{given}")
        _table(
            ["estimator", "parameters", "seeds", "seed", "RMSE(β) [deg]", "over seeds [deg]", "RMSE(v) [m/s]", "FVU"],
            [
                [
                    str(row["title"]),
                    f"{row['n_parameters']:.0f}",
                    str(row["n_seeds"]),
                    str(row["seed"]),
                    f"{row['rmse_sideslip']:.3f}",
                    f"{row['rmse_sideslip_min']:.3f} … {row['rmse_sideslip_max']:.3f}" if row["n_seeds"] > 1 else "–",
                    f"{row['rmse_vy']:.3f}",
                    f"{row['fvu']:.3f}",
                ]
                for row in rows.to_dict("records")
            ],
        )
    typer.echo(f"report: {page}")
    if outcome.published is not None:
        typer.echo(f"published: {outcome.published}")


def _print_sweep(outcome: SweepOutcome) -> None:
    """One row a combination: settings, seeds, mean and half interval on validation and tests."""
    from vehest.studies.sweep import table_of

    header, rows = table_of(outcome.artefacts, outcome.summary)
    kinds = " and ".join(kind.upper() if kind == "simulated" else kind for kind in dict.fromkeys(outcome.artefacts.kinds.values()))
    typer.echo(f"\n{outcome.artefacts.name}: RMSE(β) [deg], mean over seeds ± half its 95 % interval (Student's t); {kinds} data")
    _table(header, rows)
    if outcome.summary["chosen"].any():
        typer.echo("* lowest mean on the validation range; tests choose nothing")
    typer.echo(f"report: {outcome.folder.folder / 'report.md'}")


def _compose(command: str, overrides: list[str]) -> Config:
    from vehest.stages.config import compose_config

    return compose_config(command, overrides)


def _names(group: str, overrides: list[str] | None) -> bool:
    """Whether any override is about a group."""
    return any(override.lstrip("+~").startswith((f"{group}.", f"{group}=")) for override in overrides or [])


def _train_job(config: Config, workshop: Workshop) -> Any:
    from vehest.stages.train import plan_train

    split = workshop.split(config)
    return plan_train(config, split, workshop.data_for(split, _positive(config["estimator"].get("rate_hz"), "estimator.rate_hz"), config))


@contextmanager
def _workshop(
    config: Config, *, force: set[str], dry_run: bool, quiet: bool, jobs: int | None = None, track: bool = False
) -> Iterator[Workshop]:
    """A workshop that listens to signals; a dry run ends where it meets something that is not there yet."""
    from vehest.stages.console import Messages
    from vehest.stages.launcher import default_jobs
    from vehest.stages.signals import StopSignals
    from vehest.stages.tracking import Tracker
    from vehest.stages.workshop import NotThereYet, Workshop

    if not isinstance(config["output"], str) or not config["output"]:
        raise ConfigurationError(f"output must name a folder, not {config['output']!r}")
    messages, stop, output = Messages(quiet=quiet), StopSignals(), Path(config["output"])
    tracker = Tracker(config["tracking"], output, messages.warn) if track else None
    workshop = Workshop(output, messages, stop, jobs or default_jobs(), frozenset(force), dry_run, tracker)
    with stop.installed():
        try:
            yield workshop
        except NotThereYet:
            raise typer.Exit from None


def _raise_failure(failures: list[tuple[str, Any]]) -> None:
    for _, failure in failures:
        if failure.detail:
            typer.echo(failure.detail, err=True)
        error = VehestError(failure.message)
        error.exit_code = failure.exit_code
        raise error


def _positive(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or value <= 0:
        raise ConfigurationError(f"{name} must be a positive number [Hz], not {value!r}; for example {name}=20")
    return float(value)


def _say(as_json: bool, outcome: dict[str, Any]) -> None:
    """Print an outcome: one JSON object, or a line a figure."""
    if as_json:
        typer.echo(_json(outcome))
        return
    for key, value in outcome.items():
        typer.echo(f"{key}: {value if not isinstance(value, float) else f'{value:.6g}'}")


def _counted(names: list[str]) -> str:
    """How many there are, and the first of them."""
    some = ", ".join(names[:6]) + (", …" if len(names) > 6 else "")
    return f"{len(names)} ({some})" if names else "0"


def _json(outcome: Any) -> str:
    """An outcome as JSON; what is not a finite number becomes null."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(inner) for key, inner in value.items()}
        if isinstance(value, list | tuple):
            return [plain(inner) for inner in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(plain(outcome), indent=1, ensure_ascii=False, allow_nan=False)


def _cell(value: Any) -> str:
    """A value of a table, numbers with four significant digits."""
    if isinstance(value, float):
        return f"{value:.4g}" if math.isfinite(value) else "–"
    return str(value)


def _table(header: list[str], rows: list[list[str]]) -> None:
    """Print a table on standard output, as wide as it needs to be where there is no terminal."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(width=None if sys.stdout.isatty() else 160, highlight=False)
    table = Table(*(escape(name) for name in header), box=None, header_style="bold", pad_edge=False)
    for row in rows:
        table.add_row(*(escape(cell) for cell in row))
    console.print(table)


if __name__ == "__main__":
    main()
