"""./conf, which Hydra alone reads: files of every group, spoilt.

Tags, interpolations, other encodings. ./pipelines, bombs of aliases.
"""

import yaml

from fuzz.case import Command, generator
from fuzz.honest import KSNN, LUENBERGER, PIPELINE, SPLIT, write_yaml
from fuzz.mutations import NAMES, WRITABLE_NAMES, hostile, spoil_items, spoil_yaml, yaml_of
from place import DATASET
from vehest.configuration.files import packaged

HEAD = "# @package _global_\n"
ESTIMATORS = [
    "ksnn",
    "gru",
    "luenberger",
    "kalman",
    "learned_ukf",
    "rational_ekf",
    "dugoff_ukf",
    "cnn_ukf",
    "factor_graph",
    "ensemble_ukf",
]
DATASETS = [
    "tum",
    "f1tenth",
    "f1tenth_bag",
    "ferrari_250lm",
    "revs_targa_2014",
    "mdf",
    "sim_quickstart",
    "sim_fleet",
    "sim_heavy",
]
CARS = {
    "bmw_320i_low": "sim_small",
    "ferrari_250_lm": "sim_quickstart",
    "f1tenth": "sim_tyre_sets",
    "heavy_truck": "sim_heavy",
    "bmw_545i": "sim_bmw",
}
# file of the packaged configuration -> commands that read it, of which the first succeeds
PACKAGED = {
    "training/supervised": [("train", *KSNN, "--dry-run")],
    "training/nelder_mead": [("train", *LUENBERGER, "--dry-run")],
    "common": [("ingest", "mine")],
    "train": [("train", *KSNN, "--dry-run")],
    "eval": [("config", "eval"), ("eval", *KSNN, "--dry-run")],
    "downsample": [("downsample", "mine", "rate_hz=20")],
    "estimate": [("estimate", "lap.csv", "-o", "out.csv")],
}
DRY = ("split=steered", "tracking=none", "--dry-run")
PACKAGED |= {
    f"estimator/{entry_name}": [
        ("config", "train", f"estimator={entry_name}"),
        ("train", f"estimator={entry_name}", *DRY),
    ]
    for entry_name in ESTIMATORS
}
PACKAGED |= {
    f"dataset/{entry_name}": [
        ("config", "ingest", f"dataset={entry_name}"),
        ("ingest", entry_name, "--dry-run", "--download"),
    ]
    for entry_name in DATASETS
}
PACKAGED |= {
    f"vehicle/{entry_name}": [("simulate", dataset, "--dry-run")]
    for entry_name, dataset in CARS.items()
}
DERIVED = DATASET | {
    "transforms": [
        {"name": "acceleration_from_speed", "cutoff_hz": 5.0},
        {"name": "sideslip_from_velocity"},
    ],
    "reference_point": {"x": 0.4, "y": -0.1},
    "imu_point": "unknown",
    "drop_rows": {"one": ["1490-"]},
    "time_restarts": True,
}
POSITION = {
    "x": {"column": "Speed", "unit": "m"},
    "y": {"column": "Vy", "unit": "m"},
    "yaw": {"column": "Yaw", "unit": "deg"},
}
MORE_DERIVED = (
    {},
    {"held": {"channels": ["ay", "ax"], "updated": "Time", "delay": 0.01}},
    {"pose": {**POSITION, "window": 9, "order": 2, "channels": ["vx_ref", "yaw_rate_ref"]}},
    {"exclude": ["t*", "nobody*"]},
    {"transforms": [{"name": "scale_to_wheelbase", "wheelbase": 2.5, "to": 2.5}]},
)
SPLITS = (
    SPLIT,
    SPLIT
    | {
        "train": [
            {
                "recordings": "o*",
                "keep": {"magnitude": {"vx": {"at_least": 1.0}}, "at_least_seconds": 2.0},
            }
        ]
    },
    {
        "name": "mine",
        "dataset": "mine",
        "train": "60 %",
        "validation": "20%",
        "tests": {"test": "20 %"},
    },
    {"name": "mine", "dataset": "mine", "folds": {"number": 3, "of": "recordings"}, "fold": 1},
    {
        "name": "mine",
        "dataset": "mine",
        "folds": {"number": 4, "of": "seconds", "block_seconds": 5.0, "gap_seconds": 0.5},
    },
    {
        "name": "mine",
        "dataset": "mine",
        "train": "50 %",
        "validation": [{"recording": "one", "laps": "2 to 3"}],
    },
)
PORTIONS = (
    "101 %",
    "-5 %",
    "1e999 %",
    "last 0 laps",
    "first " + "9" * 20,
    "0",
    "9 to 3",
    "last\nlap",
    "%",
    "NaN %",
)
PARTS = {
    "parts": {
        part: {"split": "mine", "title": part, "sweeps": PIPELINE["sweeps"][:1]} for part in "ab"
    }
}
PIPELINES = (
    PIPELINE,
    {key: value for key, value in PIPELINE.items() if key not in ("split", "sweeps")} | PARTS,
    PIPELINE | {"about": "what", "publish": False, "based_on": "quickstart"},
    {
        "study": "small",
        "title": "S",
        "report": "proving_ground",
        "datasets": ["mine"],
        "optional_datasets": ["sim_small"],
    },
)


def _write(case, name, tree, head=""):
    """Write a configuration file, spoilt unless the case is honest.

    Of one that builds on others, the rest.
    """
    if case.honest:
        case.write(name, head + yaml_of(tree))
    elif "defaults" in tree or case.rng.random() < 0.3:
        case.write(name, head + yaml_of(spoil_items(tree, case.rng)))
    else:
        case.write(
            name, head.encode() + spoil_yaml(tree, case.rng, bombs=name.startswith("pipelines/"))
        )


@generator("drives", weight=8)
def dataset(case):
    """A table's channels, transforms, points, poses, held channels, rows that are dropped, time
    that restarts.
    """
    case.copy("drives")
    _write(
        case,
        "conf/dataset/mine.yaml",
        case.rng.choice(
            [DATASET, DERIVED]
            if case.honest
            else [DATASET, *(DERIVED | more for more in MORE_DERIVED)]
        ),
    )
    commands = [
        ("ingest", "mine"),
        ("data", "check", "mine"),
        ("data", "show", "mine"),
        ("data", "usable", "mine"),
    ]
    commands += [("downsample", "mine", "rate_hz=20"), ("config", "ingest", "dataset=mine")]
    return Command(
        case.rng.choice(
            [
                *commands,
                *(
                    []
                    if case.honest
                    else [("estimate", "lap.csv", "dataset=mine", "-o", "out.csv")]
                ),
            ]
        )
    )


@generator("drives", weight=6)
def split(case):
    """Recordings, percentages, laps and folds; honest drives of half a minute have no laps."""
    case.copy("drives")
    tree = case.rng.choice(SPLITS[:1] + SPLITS[2:5] if case.honest else SPLITS)
    if not case.honest and case.rng.random() < 0.2:
        tree = tree | {
            "train": [
                {
                    "recordings": "*",
                    case.rng.choice(["start", "stop", "laps"]): case.rng.choice(PORTIONS),
                }
            ]
        }
    _write(case, "conf/split/mine.yaml", tree)
    return Command(
        (case.rng.choice(["eval"] if case.honest else ["train", "eval"]), *KSNN, "--dry-run")
    )


@generator("drives", "steered", weight=20)
def packaged_file(case):
    """A file that comes with vehest, of any group or at the root, stands spoilt in ./conf.

    Or one that holds any value at all.
    """
    case.copy("drives")
    case.copy("steered")
    if not case.honest and case.rng.random() < 0.1:
        group = case.rng.choice(["split", "estimator", "training", "tracking"])
        tree = {
            "name": "odd",
            case.rng.choice(["a", *NAMES[:10]]): hostile(case.rng),
            "defaults": hostile(case.rng),
        }
        case.write(f"conf/{group}/odd.yaml", yaml_of(tree).encode("utf-8", "replace"))
        return Command(("config", "train", f"{group}=odd"))
    name = case.rng.choice(list(PACKAGED))
    text = (packaged("conf") / f"{name}.yaml").read_text(encoding="utf-8")
    _write(case, f"conf/{name}.yaml", yaml.safe_load(text), HEAD if text.startswith(HEAD) else "")
    return Command(PACKAGED[name][0] if case.honest else case.rng.choice(PACKAGED[name]))


@generator("drives", "study", weight=8)
def pipeline(case):
    """Studies of one's own and packaged ones.

    Titles and texts that end up in tables, figures and pages.
    """
    kind = case.idea(8)
    case.copy("study" if kind == 0 else "drives")
    if kind == 0:
        word = case.rng.choice(
            [*WRITABLE_NAMES, "$x^{", "\\frac", "$", "_" * 50, "|a|b|", "&lt;", "</script>"]
        )
        write_yaml(
            case.place / "pipelines" / "small.yaml",
            PIPELINE | {case.rng.choice(["title", "about", "study"]): word},
        )
        return Command(("report", "small", "tracking=none"))
    name = "small"
    if kind in (1, 2):
        file = case.rng.choice(sorted(packaged("pipelines").glob("*.yaml")))
        name = file.stem
        tree = yaml.safe_load(file.read_text(encoding="utf-8"))
    else:
        tree = PIPELINE if case.honest else case.rng.choice(PIPELINES)
    _write(case, f"pipelines/{name}.yaml", tree)
    return Command(("run", name, "--dry-run", "tracking=none"))
