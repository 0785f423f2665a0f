"""Words after commands: overrides in Hydra's grammar and out of it, options of every command in any combination, completion."""

import click
import typer

from fuzz.case import CANARY, Command, generator
from fuzz.honest import KALMAN, KSNN, LUENBERGER
from fuzz.mutations import CALL, WRITABLE_NAMES
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
    CALL, f"$(touch {CANARY})", "../../../evil", "/dev/full", "/", ".", "..",
)  # fmt: skip
FORMS = (
    "{key}={value}", "+{key}={value}", "++{key}={value}", "~{key}", "~{key}={value}", "{key}", "={value}", "{key}==", "{key}.={value}",
    ".{key}={value}", "{key}..a={value}", "{key}@a={value}", "{key}@a:b={value}", "+{key}@_global_={value}", "{key} = {value}",
    "{key}[0]={value}", "{key}.0={value}", "+{key}.a.b.c={value}", "hydra.run.dir={value}", "+hydra.searchpath=[{value}]",
    "_target_={value}", "+{key}._target_=os.system",
)  # fmt: skip


def _override(rng):
    form = "{key}={value}" if rng.random() < 0.6 else rng.choice(FORMS)
    return form.format(key=rng.choice(KEYS), value=rng.choice(VALUES))


BASES = (
    ("train", *KSNN, "--dry-run"),
    ("train", *LUENBERGER, "--dry-run"),
    ("train", *KALMAN, "--dry-run"),
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
OUTS = ("out.csv", "out.parquet", "out", "out.csv/x", "/dev/full", "/dev/null", "", "lap.csv", "raw", "OUT.CSV", "outputs/x.csv")


@generator("drives", "steered", weight=10)
def overrides(case):
    case.copy("drives")
    case.copy("steered")
    more = () if case.honest else (_override(case.rng) for _ in range(case.rng.choice([1, 1, 1, 2, 3])))
    return Command((*case.rng.choice(BASES), *more))


@generator("study", "steered", weight=5)
def settings(case):
    """A value far outside of what makes sense reaches a training or an evaluation that really runs, as small as it can be."""
    case.copy("study")
    case.copy("steered")
    starts = ("estimator.", "seed", "split.", "downsample", "training.b", "training.l", "training.p", "training.d", "limits")
    base = case.rng.choice([("train", *KSNN), ("train", *LUENBERGER), ("train", *KALMAN), ("eval", *KSNN)])
    keys = [key for key in KEYS if key.startswith(("evaluation", "downsample") if base[0] == "eval" else starts)]
    return Command((*base, *(() if case.honest else (f"{case.rng.choice(keys)}={case.rng.choice(VALUES[:30])}",))))


def _commands():
    """Every command of the application by its words."""
    root = typer.main.get_command(app)
    found = {}
    pending = [((), root)]
    while pending:
        words, command = pending.pop()
        if hasattr(command, "commands"):
            pending += [((*words, name), inner) for name, inner in command.commands.items()]
        else:
            found[words] = command
    return dict(sorted(found.items()))


HONEST = {
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
def options(case):
    """Options of a command, in any combination and with any value; arguments that are missing, wrong or too many."""
    case.copy("study")
    words, command = case.rng.choice([one for one in _commands().items() if one[0] != ("data", "list") or case.rng.random() < 0.1])
    if case.honest:
        return Command((*words, *HONEST.get(words, ("--help",))))
    chosen = []
    for parameter in command.params:
        if isinstance(parameter, click.Option):
            if case.rng.random() < 0.35:
                chosen += _option(parameter, case.rng)
        elif case.rng.random() < 0.85:
            chosen += _argument(parameter, words, case.rng)
    if case.rng.random() < 0.25:
        case.rng.shuffle(chosen)
    if case.rng.random() < 0.15:
        chosen.append(case.rng.choice(["--nothing", "-z", "--", "-", "--json=1", "--jobs", "-h", "--help", "--version", "-j-1"]))
    safe = [word for word in chosen if word not in ("--install-completion", "--show-completion", "--download")]
    dry = ["--dry-run"] if words[0] in ("train", "sweep", "run", "simulate") and "--dry-run" not in safe else []
    return Command((*words, *safe[:1], *dry, *safe[1:]), targets=("out.csv", "out.parquet", "out"))


def _option(option, rng):
    name = rng.choice([*option.opts, *option.secondary_opts])
    if option.is_flag:
        return [name]
    if "out" in (option.name or ""):
        return [name, rng.choice(OUTS)]
    value = rng.choice(
        [*VALUES, *WRITABLE_NAMES, "0", "1", "2", "100", "0.5", "offsets", "lever_arm,mounting,delay,offsets,steering_ratio", "one"]
    )
    return rng.choice([[name, value], [f"{name}={value}"], [name]])


def _argument(argument, words, rng):
    sound = {"dataset": "mine", "source": "lap.csv", "pipeline": "small", "command": "train", "model": "lap.csv"}
    if argument.name == "overrides":
        return [_override(rng) for _ in range(rng.randrange(3))]
    if rng.random() < 0.75 and argument.name in sound:
        return [sound[argument.name]]
    return [rng.choice([*WRITABLE_NAMES, "mine", "sim_small", "tabular", "lap.parquet", "raw", "conf", "quickstart", "one"])]
