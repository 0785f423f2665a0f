"""./conf, which Hydra alone reads: files of every group, spoilt; tags, interpolations, other encodings. ./pipelines, bombs of aliases."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import yaml

from fuzz.case import Case, Command, generator, template
from fuzz.honest import KALMAN, KSNN, LUENBERGER, PIPELINE, SPLIT, run, write_yaml
from fuzz.mutations import NAMES, hostile, spoil_items, spoil_key, spoil_tree, spoil_yaml
from place import DATASET
from vehest.run.config_files import packaged_conf, packaged_pipelines

HEAD = "# @package _global_\n"
ESTIMATORS = (
    "ksnn",
    "gru",
    "lstm",
    "luenberger",
    "kalman",
    "learned_ukf",
    "rational_ekf",
    "dugoff_ukf",
    "cnn_ukf",
    "factor_graph",
    "ensemble_ukf",
)


def _spoilt_file(case: Case, name: str, tree: Any, head: str = "") -> None:
    """Write a configuration file, spoilt unless the case is honest."""
    if case.honest:
        case.write(name, head + yaml.safe_dump(tree, allow_unicode=True, sort_keys=False))
    else:
        case.write(name, head.encode() + spoil_yaml(tree, case.rng, bombs=name.startswith("pipelines/")))


def _packaged(group: str, name: str) -> tuple[dict[str, Any], str]:
    """A packaged file as a tree, and the line that it must begin with."""
    text = (packaged_conf() / group / f"{name}.yaml").read_text(encoding="utf-8")
    return yaml.safe_load(text), HEAD if text.startswith(HEAD) else ""


@generator("drives", weight=5)
def datasets(case: Case) -> Command:
    case.copy("drives")
    _spoilt_file(case, "conf/dataset/mine.yaml", DATASET)
    commands = [("ingest", "mine"), ("data", "check", "mine"), ("data", "show", "mine"), ("config", "ingest", "dataset=mine")]
    commands += [
        ("downsample", "mine", "rate_hz=20"),
        ("estimate", "lap.csv", "-o", "out.csv") if case.honest else ("estimate", "lap.csv", "dataset=mine", "-o", "out.csv"),
    ]
    return Command(case.rng.choice(commands), targets=("out.csv",))


@generator("drives", weight=3)
def channels_of_a_data_set(case: Case) -> Command:
    case.copy("drives")
    tree = DATASET | {"channels": DATASET["channels"] if case.honest else spoil_tree(DATASET["channels"], case.rng)}
    if not case.honest and case.rng.random() < 0.3:
        tree |= {"time": spoil_key(DATASET, "time", case.rng)}
    (case.place / "conf/dataset/mine.yaml").write_bytes(yaml.safe_dump(tree, allow_unicode=True).encode("utf-8", "replace"))
    return Command(case.rng.choice([("ingest", "mine"), ("data", "check", "mine")]))


@generator(weight=4)
def packaged_data_sets(case: Case) -> Command:
    """The data sets that come with vehest, spoilt; their files are not here."""
    name = case.rng.choice(
        ["tum", "f1tenth", "f1tenth_bag", "ferrari_250lm", "revs_targa_2014", "mdf", "sim_quickstart", "sim_small", "sim_fleet"]
    )
    tree, head = _packaged("dataset", name)
    if "defaults" in tree and case.rng.random() < 0.7:
        spoilt = tree | spoil_items(tree, case.rng)
        case.write(
            f"conf/dataset/{name}.yaml",
            head + yaml.safe_dump(tree if case.honest else spoilt, allow_unicode=True).encode("utf-8", "replace").decode(),
        )
    else:
        _spoilt_file(case, f"conf/dataset/{name}.yaml", tree, head)
    (case.place / "raw").mkdir()
    if case.honest:
        return Command(("config", "ingest", f"dataset={name}"))
    return Command(
        case.rng.choice(
            [("config", "ingest", f"dataset={name}"), ("ingest", name, "--dry-run"), ("ingest", name, "--dry-run", "--download")]
        )
    )


@generator(weight=4)
def simulations(case: Case) -> Command:
    """Declarations of simulated drives: manoeuvres, sensors, surfaces, variations, and the vehicles themselves."""
    name = case.rng.choice(["sim_small", "sim_fleet", "sim_bmw", "sim_two_cars", "sim_heavy", "sim_fleet_real"])
    tree, head = _packaged("dataset", name)
    if case.rng.random() < 0.4:
        vehicle = case.rng.choice(["bmw_320i_low", "f1tenth", "ferrari_250_lm", "heavy_truck", "bmw_545i"])
        content, own = _packaged("vehicle", vehicle)
        _spoilt_file(case, f"conf/vehicle/{vehicle}.yaml", content, own)
    else:
        key = case.rng.choice([one for one in tree if one not in ("defaults", "name", "title", "licence", "citation")])
        spoilt = tree if case.honest else tree | {key: spoil_key(tree, key, case.rng)}
        case.write(f"conf/dataset/{name}.yaml", head + yaml.safe_dump(spoilt, allow_unicode=True).encode("utf-8", "replace").decode())
    return Command(("simulate", name, "--dry-run") if case.rng.random() < 0.8 else ("config", "ingest", f"dataset={name}"))


@template
def simulated(folder: Path) -> None:
    """One short drive, after which the plant's kernels are loaded."""
    write_yaml(folder / "conf" / "dataset" / "short.yaml", SHORT | {"drives": [LANE_CHANGE]})
    run("simulate", "short", "--jobs", "1", "--quiet")


LANE_CHANGE = {"id": "d", "manoeuvre": {"name": "double_lane_change", "severity": 0.5}}
SHORT: dict[str, Any] = {
    "defaults": [{"/vehicle@vehicle": "bmw_320i_low"}],
    "name": "short",
    "kind": "simulated",
    "licence": "none",
    "citation": "none",
    "source": "simulated",
    "seed": 0,
    "rate_hz": 100,
    "sensors": "default",
    "surface": "dry",
    "stability_control": False,
}


@generator("simulated")
def a_simulated_drive(case: Case) -> Command:
    """A short drive that is simulated, with numbers far outside of what a car does."""
    drive: dict[str, Any] = dict(LANE_CHANGE)
    tree = SHORT | {"drives": [drive]}
    if not case.honest:
        how, rng = case.visit % 6, case.rng
        if how == 0:
            drive["id"] = rng.choice(NAMES).replace("\ud8ff", "")
        elif how == 1:
            drive["manoeuvre"] = {
                "name": "double_lane_change",
                rng.choice(["severity", "duration", "speed"]): rng.choice([-1, 0, 1e9, "a", None]),
            }
        elif how == 2:
            drive["manoeuvre"] = {"name": "random_steer", "duration": rng.choice([1e9, 1e18, -1, 0, 1e-9])}
        elif how == 3:
            drive["manoeuvre"] = {"name": "laps", "course": rng.choice(["handling", *NAMES[:8]]), "duration": rng.choice([1e9, 0.001])}
        elif how == 4:
            drive |= {"count": rng.choice([10**9, -1, 0, "a", 1.5])}
        else:
            tree["rate_hz"] = rng.choice([1000, 1, 0.5, 1e9, "a"])
    write_yaml(case.place / "conf" / "dataset" / "short.yaml", tree)
    return Command(("simulate", "short", "--jobs", "1"))


@generator("drives", weight=4)
def splits(case: Case) -> Command:
    case.copy("drives")
    kept = SPLIT | {"train": [{"recordings": "o*", "keep": {"magnitude": {"vx": {"at_least": 1.0}}, "at_least_seconds": 2.0}}]}
    kept["tests"] = {"test": [{"recording": "three", "start": 1.0, "stop": 29.0}]}
    _spoilt_file(case, "conf/split/mine.yaml", case.rng.choice([SPLIT, kept]))
    return Command(("train", *KSNN, "--dry-run") if case.rng.random() < 0.6 and not case.honest else ("eval", *KSNN, "--dry-run"))


@generator("drives", weight=3)
def splits_in_portions(case: Case) -> Command:
    """Percentages, laps and folds; honest drives of half a minute have no laps."""
    case.copy("drives")
    honest = [
        {"name": "mine", "dataset": "mine", "train": "60 %", "validation": "20%", "tests": {"test": "20 %"}},
        {"name": "mine", "dataset": "mine", "folds": {"number": 3, "of": "recordings"}, "fold": 1},
        {"name": "mine", "dataset": "mine", "folds": {"number": 4, "of": "seconds", "block_seconds": 5.0, "gap_seconds": 0.5}},
    ]
    laps = {"name": "mine", "dataset": "mine", "train": "50 %", "validation": [{"recording": "one", "laps": "2 to 3"}]}
    tree = case.rng.choice(honest if case.honest else [*honest, laps])
    if not case.honest and case.rng.random() < 0.3:
        words = ["101 %", "-5 %", "1e999 %", "last 0 laps", "first 99999999999999999999", "0", "9 to 3", "last\nlap", "%", "NaN %"]
        tree |= {"train": [{"recordings": "*", case.rng.choice(["start", "stop", "laps"]): case.rng.choice(words)}]}
    _spoilt_file(case, "conf/split/mine.yaml", tree)
    return Command(("eval", *KSNN, "--dry-run"))


@generator("drives", weight=3)
def derived_channels(case: Case) -> Command:
    """Transforms of a data set, points, poses, held channels, rows that are dropped, time that restarts."""
    case.copy("drives")
    derived: dict[str, Any] = {
        "transforms": [
            {"name": "acceleration_from_speed", "cutoff_hz": 5.0},
            {"name": "sideslip_from_velocity"},
            {"name": "velocity_from_sideslip"},
        ],
        "reference_point": {"x": 0.4, "y": -0.1},
        "imu_point": "unknown",
        "drop_rows": {"one": ["1490-"]},
        "time_restarts": True,
    }
    held = {"held": {"channels": ["ay", "ax"], "updated": "Time", "delay": 0.01}}
    position = {"x": {"column": "Speed", "unit": "m"}, "y": {"column": "Vy", "unit": "m"}, "yaw": {"column": "Yaw", "unit": "deg"}}
    pose = {"pose": {**position, "window": 9, "order": 2, "channels": ["vx_ref", "yaw_rate_ref"]}}
    scaled = {"transforms": [{"name": "scale_to_wheelbase", "wheelbase": 2.5, "to": 2.5}]}
    tree = DATASET | derived
    if not case.honest:
        tree |= case.rng.choice([{}, held, pose, held | pose, {"exclude": ["t*", "nobody*"]}, scaled])
        tree = DATASET | {key: spoil_tree(value, case.rng) if case.rng.random() < 0.3 else value for key, value in tree.items()}
    (case.place / "conf/dataset/mine.yaml").write_bytes(yaml.safe_dump(tree, allow_unicode=True).encode("utf-8", "replace"))
    return Command(case.rng.choice([("ingest", "mine"), ("data", "check", "mine"), ("data", "usable", "mine"), ("data", "show", "mine")]))


@generator("drives", "steered", weight=5)
def estimators(case: Case) -> Command:
    """conf/estimator and conf/training of every method."""
    case.copy("drives")
    case.copy("steered")
    name = case.rng.choice(ESTIMATORS)
    tree, head = _packaged("estimator", name)
    if "defaults" in tree or case.rng.random() < 0.6:
        spoilt = tree if case.honest else tree | spoil_items(tree, case.rng)
        case.write(f"conf/estimator/{name}.yaml", head + yaml.safe_dump(spoilt, allow_unicode=True).encode("utf-8", "replace").decode())
    else:
        _spoilt_file(case, f"conf/estimator/{name}.yaml", tree, head)
    if case.honest:
        return Command(("config", "train", f"estimator={name}"))
    split = "steered" if name not in ("ksnn", "gru", "lstm", "luenberger") else "mine"
    words = ("train", f"estimator={name}", f"split={split}", "tracking=none")
    return Command(
        (*words, "--dry-run") if name not in ("kalman", "ksnn") else (*words, "training.max_epochs=1") if name == "ksnn" else words
    )


@generator("drives", weight=3)
def trainings(case: Case) -> Command:
    case.copy("drives")
    name, base = case.rng.choice([("supervised", KSNN), ("nelder_mead", LUENBERGER)])
    tree, head = _packaged("training", name)
    tree |= {"max_epochs": 1} if name == "supervised" else {"grid": 1, "max_evaluations": 3}
    _spoilt_file(case, f"conf/training/{name}.yaml", tree, head)
    return Command(
        (
            "train",
            *(word for word in base if case.honest or not word.startswith("training.")),
            *(() if case.honest else ("--dry-run",) * case.rng.randrange(2)),
        )
    )


@generator("drives", weight=2)
def tracking(case: Case) -> Command:
    case.copy("drives")
    tree = {"name": "none"} if case.honest else {"name": "mlflow", "uri": None, "experiment": "vehest"}
    _spoilt_file(case, "conf/tracking/mine.yaml", tree)
    words = [word for word in KSNN if not word.startswith("tracking")]
    return Command(("train", *words, "tracking=mine", *(() if case.honest else ("--dry-run",))))


@generator("drives", weight=3)
def root_files(case: Case) -> Command:
    """./conf/common.yaml, train.yaml and the like stand before the packaged ones."""
    case.copy("drives")
    name = case.rng.choice(["common", "ingest", "train", "eval", "estimate", "downsample"])
    tree = yaml.safe_load((packaged_conf() / f"{name}.yaml").read_text(encoding="utf-8"))
    _spoilt_file(case, f"conf/{name}.yaml", tree)
    commands = {"common": ("ingest", "mine"), "ingest": ("ingest", "mine"), "estimate": ("estimate", "lap.csv", "-o", "out.csv")}
    commands |= {
        "downsample": ("downsample", "mine", "rate_hz=20"),
        "train": ("train", *KSNN, "--dry-run"),
        "eval": ("eval", *KSNN, "--dry-run"),
    }
    if case.honest and name == "eval":
        return Command(("config", "eval"))
    return Command(commands[name], targets=("out.csv",))


@generator("drives", weight=2)
def odd_files_in_conf(case: Case) -> Command:
    """Names, links, pipes and sizes of files in ./conf."""
    case.copy("drives")
    folder, rng = case.place / "conf" / "dataset", case.rng
    if not case.honest:
        ideas = [
            lambda: os.mkfifo(folder / "pipe.yaml"),
            lambda: (folder / "zero.yaml").symlink_to("/dev/zero"),
            lambda: (folder / "loop.yaml").symlink_to("loop.yaml"),
            lambda: (folder / "folder.yaml").mkdir(),
            lambda: (folder / "deeper").symlink_to(".."),
            lambda: _touch(folder, b"\xff\xfe.yaml"),
            lambda: _touch(folder, b"a\nb.yaml"),
            lambda: _touch(folder, b"\x1b[2J.yaml"),
            lambda: _touch(folder, b"a=b,c.yaml"),
            lambda: _touch(folder, b"-x.yaml"),
            lambda: (folder / "empty.yaml").write_bytes(b""),
            lambda: (folder / "big.yaml").write_bytes(b"# " + b"x" * 30_000_000),
            lambda: [_touch(folder, b"n%d.yaml" % k) for k in range(3000)],
            lambda: ((folder / "mine.yaml").unlink(), (folder / "mine.yaml").mkdir()),
        ]
        ideas[case.visit % len(ideas)]()
    if case.visit % 14 == 13:
        return Command(rng.choice([("ingest", "mine"), ("data", "check", "mine"), ("config", "ingest", "dataset=mine")]))
    return Command(
        rng.choice([("ingest", "--help"), ("ingest", "nothing"), ("data", "show", "mine")]) if not case.honest else ("data", "show", "mine")
    )


def _touch(folder: Path, name: bytes) -> None:
    with open(os.fsencode(folder) + b"/" + name, "wb") as stream:
        stream.write(b"name: x\nsource: tabular\n")


@generator("drives", weight=6)
def pipelines(case: Case) -> Command:
    case.copy("drives")
    tree = case.rng.choice(
        [
            PIPELINE,
            {key: value for key, value in PIPELINE.items() if key not in ("split", "sweeps")}
            | {
                "parts": {
                    "a": {"split": "mine", "title": "A", "sweeps": PIPELINE["sweeps"]},
                    "b": {"split": "mine", "sweeps": PIPELINE["sweeps"][:1]},
                }
            }
            | ({} if not case.honest else {"report": "ksnn"}),
            PIPELINE | {"about": "what", "publish": False, "based_on": "quickstart"},
            {"study": "small", "title": "S", "report": "proving_ground", "datasets": ["mine"], "optional_datasets": ["sim_small"]},
        ][: 1 if case.honest else 4]
    )
    _spoilt_file(case, "pipelines/small.yaml", tree)
    return Command(
        ("run", "small", "--dry-run", "tracking=none") if case.honest or case.rng.random() < 0.7 else ("report", "small", "tracking=none")
    )


@generator("drives", weight=2)
def packaged_pipelines_spoilt(case: Case) -> Command:
    case.copy("drives")
    file = case.rng.choice(sorted(packaged_pipelines().glob("*.yaml")))
    _spoilt_file(case, f"pipelines/{file.name}", yaml.safe_load(file.read_text(encoding="utf-8")))
    if case.honest:
        case.write("pipelines/small.yaml", yaml.safe_dump(PIPELINE))
        return Command(("run", "small", "--dry-run", "tracking=none"))
    return Command(("run", file.stem, "--dry-run", "tracking=none"))


@generator("study")
def words_in_a_study(case: Case) -> Command:
    """Titles and texts that end up in tables, figures and pages."""
    case.copy("study")
    word = str(case.rng.choice([*NAMES, "$x^{", "\\frac", "$", "_" * 50, "|a|b|", "&lt;", "</script>"]))
    tree = PIPELINE | ({} if case.honest else {case.rng.choice(["title", "about", "study"]): word.replace("\ud8ff", "").replace("\0", "")})
    write_yaml(case.place / "pipelines" / "small.yaml", tree)
    return Command(("report", "small", "tracking=none"))


@generator("steered", weight=2)
def cars_of_a_filter(case: Case) -> Command:
    """Parameters of the car that a Kalman filter is told; it is fitted and written."""
    case.copy("steered")
    keys = ("mass", "yaw_inertia", "cg_to_front_axle", "cg_to_rear_axle", "cornering_stiffness_front", "cornering_stiffness_rear")
    values = ("0", "-1", "1e-300", "1e300", "nan", "inf", "1e400", "null", "a", "true", "[1]", "{a: 1}", "1e18")
    more = [f"estimator.car.{case.rng.choice(keys)}={case.rng.choice(values)}"]
    others = ("rate_hz", "minimum_speed", "initial_deviation", "noise.cutoff", "noise.ay")
    more += [f"estimator.{case.rng.choice(others)}={case.rng.choice(values)}"]
    return Command(("train", *KALMAN, *([] if case.honest else case.rng.choice([more[:1], more[1:], more]))))


@generator("drives")
def strange_trees(case: Case) -> Command:
    """A file of ./conf that holds any value at all."""
    case.copy("drives")
    group = case.rng.choice(["dataset", "split", "estimator", "training", "tracking"])
    if case.honest:
        return Command(("config", "train", "split=mine"))
    tree = {"name": "odd", case.rng.choice(["a", *NAMES[:10]]): hostile(case.rng), "defaults": hostile(case.rng)}
    case.write(f"conf/{group}/odd.yaml", yaml.safe_dump(tree, allow_unicode=True).encode("utf-8", "replace"))
    return Command(("config", "train", f"{group}=odd") if group != "dataset" else ("config", "ingest", "dataset=odd"))
