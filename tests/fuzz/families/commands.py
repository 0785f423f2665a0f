"""Words after commands: overrides in Hydra's grammar and out of it, options of every command in any combination, completion."""

from __future__ import annotations

import random
from typing import Any

import click
import typer

from fuzz.case import CANARY, Case, Command, generator
from fuzz.honest import KALMAN, KSNN, LUENBERGER
from fuzz.mutations import NAMES
from vehest.cli import app

KEYS = (
    "seed", "output", "root", "estimator", "estimator.name", "estimator.rate_hz", "estimator.window", "estimator.n_local",
    "estimator.n_hidden", "estimator.bias", "split", "split.name", "split.train", "split.tests", "split.tests.test", "training",
    "training.max_epochs", "training.batch_size", "training.learning_rate", "training.patience", "training.dtype",
    "training.checkpoint_seconds", "training.compiled", "tracking", "tracking.uri", "downsample.method", "downsample.transforms",
    "limits.samples", "limits.jobs", "limits.text_bytes", "limits.memory", "limits.columns", "nothing.there", "evaluation.rate_hz",
    "evaluation.warm_up_seconds", "evaluation.skip_seconds", "evaluation.sequence_seconds", "evaluation.initial_state",
)  # fmt: skip
VALUES = (
    "", "null", "true", "0", "-1", "1", "1.5", "1e400", "-1e400", "nan", "inf", "-inf", "1e-300", "1e18", "9" * 400,
    "99999999999999999999", "a", "'a'", '"a"', "'", '"', "[", "]", "[]", "[1,2]", "[[[[1]]]]", "{}", "{a:1}", "{", "{a:{b:{c:1}}}", "(1)",
    "1,2,3", "range(3)", "range(0,10,0)", "range(5,1)", "range(100000000)", "range(1e18)", "range(0.1,0.2,1e-12)", "choice(1,2)",
    "choice(range(9),1)", "glob(*)", "interval(0,1)", "shuffle(range(10))", "sort(3,1)", "tag(a,1)", "int(1e400)", "float(a)", "str([1])",
    "bool(2)", "json_str({})", "cast(1)", "extend_list(1)", "${seed}", "${nothing}", "${oc.env:HOME}", "${oc.env:NONE}", "${oc.decode:1}",
    "${oc.create:[1]}", "${oc.deprecated:seed}", "${..}", "${", "$", "???", "\\", "\\,", "a b", "a\tb", "a\nb", "\x1b[2J", "\u202e", "😀",
    "ä", "[" * 500, "{a:" * 200, "-" * 1000, "x" * 100_000, "1_000", "0x10", "0b1", "1e5", ".5", "5.", "1e", "None", "~", "!", "*", "?",
    f"__import__('os').system('touch {CANARY}')", f"$(touch {CANARY})", "../../../evil", "/dev/full", "/", ".", "..",
)  # fmt: skip
FORMS = (
    "{key}={value}", "+{key}={value}", "++{key}={value}", "~{key}", "~{key}={value}", "{key}", "={value}", "{key}==", "{key}.={value}",
    ".{key}={value}", "{key}..a={value}", "{key}@a={value}", "{key}@a:b={value}", "+{key}@_global_={value}", "{key} = {value}",
    "{key}[0]={value}", "{key}.0={value}", "+{key}.a.b.c={value}", "hydra.run.dir={value}", "+hydra.searchpath=[{value}]",
    "_target_={value}", "+{key}._target_=os.system",
)  # fmt: skip


def _override(rng: random.Random) -> str:
    form = "{key}={value}" if rng.random() < 0.6 else rng.choice(FORMS)
    return form.format(key=rng.choice(KEYS), value=rng.choice(VALUES)).replace("\0", "")


BASES: tuple[tuple[str, ...], ...] = (
    ("train", *KSNN, "--dry-run"),
    ("train", *LUENBERGER, "--dry-run"),
    ("train", *KALMAN, "--dry-run"),
    ("eval", *KSNN, "--dry-run"),
    ("sweep", *KSNN, "--dry-run"),
    ("config", "train"),
    ("config", "eval"),
    ("ingest", "mine"),
    ("downsample", "mine", "rate_hz=20"),
    ("estimate", "lap.csv", "-o", "out.csv"),
    ("run", "small", "--dry-run", "tracking=none"),
    ("data", "show", "mine"),
    ("data", "check", "lap.csv"),
)


@generator("drives", "steered", weight=10)
def overrides(case: Case) -> Command:
    case.copy("drives")
    case.copy("steered")
    base = case.rng.choice(BASES if not case.honest else [one for one in BASES if one[0] != "eval"])
    more = () if case.honest else tuple(_override(case.rng) for _ in range(case.rng.choice([1, 1, 1, 2, 3])))
    return Command((*base, *more), targets=("out.csv",))


@generator("drives", "steered", weight=3)
def settings_of_trainings(case: Case) -> Command:
    """A value far outside of what makes sense reaches a training that really runs, as small as it can be."""
    case.copy("drives")
    case.copy("steered")
    base = case.rng.choice([KSNN, LUENBERGER, KALMAN])
    keys = [
        key
        for key in KEYS
        if key.startswith(("estimator.", "seed", "split.", "downsample", "training.b", "training.l", "training.p", "training.d", "limits"))
    ]
    more = () if case.honest else (f"{case.rng.choice(keys)}={case.rng.choice(VALUES[:30])}",)
    return Command(("train", *base, *more))


@generator("study", weight=3)
def settings_of_evaluations(case: Case) -> Command:
    case.copy("study")
    keys = [key for key in KEYS if key.startswith(("evaluation", "downsample"))]
    more = () if case.honest else (f"{case.rng.choice(keys)}={case.rng.choice(VALUES[:30])}",)
    return Command(("eval", *KSNN, *more))


SWEEPS = (
    ("seed=range(100000000)",),
    ("seed=range(1000)", "estimator.n_local=range(1000)"),
    ("seed=" + ",".join(map(str, range(20_000))),),
    ("seed=0,1", "estimator.n_local=range(2,4)", "estimator.bias=true,false"),
    ("seed=range(0,1,1e-9)",),
    ("seed=range(1000000)", "seed=range(1000000)"),
    ("seed=choice(1,2)", "limits.jobs=1"),
    ("limits.jobs=1,2",),
    ("estimator=ksnn,gru,nothing",),
    ("estimator=glob(*)",),
    ("split=mine,mine",),
    ("seed=0,0,0",),
    ("output=a,b",),
    ("seed=",),
    ("seed=range()",),
    ("+a=1,2",),
    ("seed=nan,inf",),
    ("seed=range(-5,5)",),
    ("seed=1e400,2",),
)


@generator("drives", weight=3)
def sweeps(case: Case) -> Command:
    case.copy("drives")
    words = ("seed=0,1",) if case.honest else SWEEPS[case.visit % len(SWEEPS)]
    name = () if case.honest or case.rng.random() < 0.5 else ("--name", case.rng.choice(NAMES).replace("\0", ""))
    return Command(("sweep", *KSNN, *words, *name, "--dry-run"))


def _commands() -> dict[tuple[str, ...], click.Command]:
    """Every command of the application by its words."""
    root = typer.main.get_command(app)
    found: dict[tuple[str, ...], click.Command] = {}
    pending: list[tuple[tuple[str, ...], Any]] = [((), root)]
    while pending:
        words, command = pending.pop()
        if hasattr(command, "commands"):
            pending += [((*words, name), inner) for name, inner in command.commands.items()]
        else:
            found[words] = command
    return dict(sorted(found.items()))


HONEST: dict[tuple[str, ...], tuple[str, ...]] = {
    ("ingest",): ("mine", "--quiet"),
    ("simulate",): ("sim_small", "--dry-run"),
    ("downsample",): ("mine", "rate_hz=20", "--json"),
    ("train",): (*KSNN, "--dry-run"),
    ("eval",): (*KSNN, "--json"),
    ("estimate",): ("lap.csv", "-o", "out.csv"),
    ("run",): ("small", "tracking=none", "--dry-run"),
    ("report",): ("small", "tracking=none"),
    ("sweep",): (*KSNN, "--dry-run"),
    ("config",): ("train", "--json"),
    ("doctor",): ("--json",),
    ("data", "list"): (),
    ("data", "channels"): ("--json",),
    ("data", "show"): ("mine", "--json"),
    ("data", "check"): ("lap.csv", "--json"),
    ("data", "align"): ("lap.csv", "-e", "offsets,delay"),
}


@generator("study", weight=8)
def options(case: Case) -> Command:
    """Options of a command, in any combination and with any value; arguments that are missing, wrong or too many."""
    case.copy("study")
    words, command = case.rng.choice([one for one in _commands().items() if one[0] != ("data", "list") or case.rng.random() < 0.1])
    if case.honest:
        return Command((*words, *HONEST.get(words, ("--help",))), targets=("out.csv",))
    chosen: list[str] = []
    for parameter in command.params:
        if isinstance(parameter, click.Option):
            if case.rng.random() < 0.35:
                chosen += _option(parameter, case.rng)
        elif case.rng.random() < 0.85:
            chosen += _argument(parameter, words, case.rng)
    if case.rng.random() < 0.25:
        case.rng.shuffle(chosen)
    if case.rng.random() < 0.15:
        chosen.append(
            case.rng.choice(
                ["--nothing", "-z", "--", "-", "--json=1", "--jobs", "-h", "--help", "--version", "--install-completion-x", "-j-1"]
            )
        )
    safe = [word for word in chosen if word not in ("--install-completion", "--show-completion", "--download")]
    dry = ["--dry-run"] if words[0] in ("train", "sweep", "run", "simulate") and "--dry-run" not in safe else []
    return Command((*words, *(word.replace("\0", "") for word in safe[:1] + dry + safe[1:])), targets=("out.csv", "out.parquet", "out"))


def _option(option: click.Option, rng: random.Random) -> list[str]:
    name = rng.choice([*option.opts, *option.secondary_opts])
    if option.is_flag:
        return [name]
    if "out" in (option.name or ""):
        return [
            name,
            rng.choice(
                ["out.csv", "out.parquet", "out", "out.csv/x", "/dev/full", "/dev/null", "", "lap.csv", "raw", "OUT.CSV", "outputs/x.csv"]
            ),
        ]
    value = rng.choice([*VALUES, *NAMES, "0", "1", "2", "100", "0.5", "offsets", "lever_arm,mounting,delay,offsets,steering_ratio", "one"])
    return rng.choice([[name, value], [f"{name}={value}"], [name]])


def _argument(argument: click.Parameter, words: tuple[str, ...], rng: random.Random) -> list[str]:
    sound = {"dataset": "mine", "source": "lap.csv", "pipeline": "small", "command": "train", "model": "lap.csv"}
    if argument.name == "overrides":
        return [_override(rng) for _ in range(rng.randrange(3))]
    if rng.random() < 0.75 and argument.name in sound:
        return [sound[argument.name]]
    return [rng.choice([*NAMES, "mine", "sim_small", "tabular", "lap.parquet", "raw", "conf", "quickstart", "one"])]


@generator("study", weight=2)
def alignments(case: Case) -> Command:
    """Options of data align are numbers that reach a solver."""
    case.copy("study")
    if case.honest:
        return Command(("data", "align", "lap.csv", "-e", "offsets", "-o", "out"), targets=("out",))
    chosen = [
        word
        for name in case.rng.sample(["--wheelbase", "--cutoff", "--max-delay", "--tilt", "--max-ay", "--min-speed"], 2)
        for word in (name, case.rng.choice(["0", "-1", "nan", "inf", "1e400", "1e18", "1e-300", "1e9", "24.999", "a", ""]))
    ]
    what = case.rng.choice(
        [
            "offsets",
            "delay",
            "lever_arm",
            "mounting",
            "steering_ratio",
            "delay,offsets",
            "lever_arm,mounting,delay,offsets",
            "",
            ",",
            "all",
            "delay,delay",
        ]
    )
    where = case.rng.choice(
        [(), ("-o", "out"), ("-o", "lap.csv"), ("-o", "raw"), ("-o", "/dev/null"), ("-r", "nothing"), ("--steering-channel", "vx")]
    )
    return Command(("data", "align", "lap.csv", "-e", what, *chosen, *where), targets=("out",))


@generator("study", weight=2)
def completion(case: Case) -> Command:
    """What a shell asks for while somebody types."""
    case.copy("study")
    words = [
        "vehest",
        *case.rng.choice(
            [("train", "estimator=k"), ("ingest", ""), ("estimate", ""), ("run", ""), ("sweep", "estimator.n_l"), ("eval", "--model", "")]
        ),
    ]
    if not case.honest:
        words.append(case.rng.choice([*(value for value in VALUES if "\0" not in value), _override(case.rng)]))
        if case.visit % 4 == 0:
            case.write(f"conf/dataset/{case.rng.choice(['odd', 'a b'])}.yaml", b"\xff\xfe: [")
    shell = case.rng.choice(["bash", "zsh", "fish"])
    environment = {
        "_VEHEST_COMPLETE": f"complete_{shell}",
        "COMP_WORDS": " ".join(words).replace("\0", ""),
        "COMP_CWORD": str(len(words) - 1),
    }
    environment |= {
        "_TYPER_COMPLETE_ARGS": environment["COMP_WORDS"],
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
        "_TYPER_COMPLETE_WORD_TO_COMPLETE": words[-1].replace("\0", ""),
    }
    return Command((), environment=environment)
