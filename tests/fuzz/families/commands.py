"""Words after commands: overrides in Hydra's grammar and out of it."""

from fuzz.case import CANARY, Command, generator
from fuzz.honest import KALMAN, KSNN, LUENBERGER
from fuzz.mutations import CALL

KEYS = (
    "seed", "output", "root", "estimator", "estimator.name", "estimator.rate_hz",
    "estimator.window", "estimator.n_local", "estimator.n_hidden", "estimator.bias", "split",
    "split.name", "split.train", "split.tests", "split.tests.test", "training",
    "training.max_epochs", "training.batch_size", "training.learning_rate", "training.patience",
    "training.dtype", "training.checkpoint_seconds", "training.compiled", "tracking",
    "tracking.uri", "downsample.method", "downsample.transforms", "limits.samples", "limits.jobs",
    "limits.text_bytes", "limits.memory", "limits.columns", "nothing.there", "evaluation.rate_hz",
    "evaluation.warm_up_seconds", "evaluation.skip_seconds", "evaluation.sequence_seconds",
    "evaluation.initial_state",
)  # fmt: skip
VALUES = (
    "", "null", "true", "0", "-1", "1", "1.5", "1e400", "-1e400", "nan", "inf", "-inf", "1e-300",
    "1e18", "9" * 400, "99999999999999999999", "a", "'a'", '"a"', "'", '"', "[", "]", "[]", "[1,2]",
    "[[[[1]]]]", "{}", "{a:1}", "{", "{a:{b:{c:1}}}", "(1)", "1,2,3", "range(3)", "range(0,10,0)",
    "range(5,1)", "range(100000000)", "range(1e18)", "range(0.1,0.2,1e-12)", "choice(1,2)",
    "choice(range(9),1)", "glob(*)", "interval(0,1)", "shuffle(range(10))", "sort(3,1)", "tag(a,1)",
    "int(1e400)", "float(a)", "str([1])", "bool(2)", "json_str({})", "cast(1)", "extend_list(1)",
    "${seed}", "${nothing}", "${oc.env:HOME}", "${oc.env:NONE}", "${oc.decode:1}",
    "${oc.create:[1]}", "${oc.deprecated:seed}", "${..}", "${", "$", "???", "\\", "\\,", "a b",
    "a\tb", "a\nb", "\x1b[2J", "\u202e", "😀", "ä", "[" * 500, "{a:" * 200, "-" * 1000,
    "x" * 100_000, "1_000", "0x10", "0b1", "1e5", ".5", "5.", "1e", "None", "~", "!", "*", "?",
    CALL, f"$(touch {CANARY})", "../../../evil", "/dev/full", "/", ".", "..",
)  # fmt: skip
FORMS = (
    "{key}={value}", "+{key}={value}", "++{key}={value}", "~{key}", "~{key}={value}", "{key}",
    "={value}", "{key}==", "{key}.={value}", ".{key}={value}", "{key}..a={value}",
    "{key}@a={value}", "{key}@a:b={value}", "+{key}@_global_={value}", "{key} = {value}",
    "{key}[0]={value}", "{key}.0={value}", "+{key}.a.b.c={value}", "hydra.run.dir={value}",
    "+hydra.searchpath=[{value}]", "_target_={value}", "+{key}._target_=os.system",
)  # fmt: skip


def _override(rng):
    """A random override of an option."""
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


@generator("drives", "steered", weight=10)
def overrides(case):
    """A command with up to three random overrides."""
    case.copy("drives")
    case.copy("steered")
    more = (
        ()
        if case.honest
        else (_override(case.rng) for _ in range(case.rng.choice([1, 1, 1, 2, 3])))
    )
    return Command((*case.rng.choice(BASES), *more))
