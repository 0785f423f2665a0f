"""What stands in an output root: manifests, models, checkpoints, the MLflow store."""

import json
import os
import sqlite3
import struct
from unittest.mock import patch

import yaml

from fuzz.case import Command, generator, template
from fuzz.honest import KSNN, drives, run
from fuzz.mutations import NAMES, WRITABLE_NAMES, spoil_bytes, spoil_json, spoil_text, spoil_yaml

STAGES = ("ingest", "downsample", "train", "calibrate", "evaluate", "report")
TRACKED = tuple(word for word in KSNN if not word.startswith("tracking"))
STATEMENTS = (
    "DELETE FROM experiments",
    "DROP TABLE runs",
    "UPDATE alembic_version SET version_num = 'x'",
    "DROP TABLE alembic_version",
)


def _mend(folder):
    """Let the manifest name the files as they are now, so that they are read."""
    file = folder / "manifest.json"
    content = json.loads(file.read_text())
    for name, entry in content["outputs"].items():
        if (folder / name).is_file():
            entry["bytes"] = (folder / name).stat().st_size
    file.write_text(json.dumps(content))


def _replace_by_special_file(file, kind):
    """Something else in the place of a file: nothing, a folder, a pipe, a link."""
    file.unlink()
    makers = [lambda: None, file.mkdir, lambda: os.mkfifo(file), file.touch]
    [*makers, lambda: file.symlink_to("/dev/zero"), lambda: file.symlink_to(file.name)][kind % 6]()


def _rename(content, case):
    """Labels and file names in a manifest that lead elsewhere."""
    tree = json.loads(content)
    name = case.rng.choice(
        [*NAMES, str(case.folder / "evil"), "../../../../evil", str(case.place / "raw" / "evil")]
    )
    if case.rng.random() < 0.7:
        tree[case.rng.choice(["label", "stage", "key"])] = name
    else:
        tree["outputs"][name] = {"sha256": "0" * 64, "bytes": 0}
    return json.dumps(tree).encode()


def _with_header(content, change, rng):
    """A safetensors file whose JSON at the head, or its length, is another."""
    (length,) = struct.unpack("<Q", content[:8])
    header = change(content[8 : 8 + length])
    header += b" " * (-len(header) % 8)
    stated = rng.choice([len(header)] * 6 + [0, 2**63, 2**64 - 1, len(content) * 2])
    return struct.pack("<Q", stated) + header + content[8 + length :]


@generator("study", weight=8)
def manifest(case):
    """Manifests and files of every stage.

    A file is spoilt while the manifest still agrees with its size.
    """
    case.copy("study")
    folder = case.rng.choice(
        [
            folder
            for stage in STAGES
            for folder in sorted((case.place / "outputs" / stage).glob("*"))
        ]
    )
    file = folder / "manifest.json"
    kind = case.idea(4)
    if kind == 0:
        case.spoil(file, lambda content, rng: _rename(content, case))
    elif kind == 1:
        file = case.rng.choice(
            [path for path in sorted(folder.rglob("*")) if path.is_file() and path != file]
        )
        text = file.suffix in (".csv", ".json", ".yaml", ".md")
        case.spoil(
            file,
            lambda content, rng: (
                spoil_text(content.decode(), rng) if text else spoil_bytes(content, rng)
            ),
        )
        _mend(folder)
    elif kind == 2:
        _replace_by_special_file(file, case.visit // 4)
    else:
        case.spoil(file, spoil_json)
    likely = [
        ("run", "small", "tracking=none", "--dry-run"),
        ("eval", *KSNN),
    ] * 5  # the others draw the report anew, which takes seconds
    force = [] if case.honest else [("report", "small", "tracking=none", "--force")]
    return Command(
        case.rng.choice([*likely, ("run", "small", "tracking=none", "--jobs", "1"), *force])
    )


@generator("study", weight=10)
def model(case):
    """model.yaml, model.safetensors with its header, manifest.json.

    Names of models and folders that are none.
    """
    case.copy("study")
    folder = case.rng.choice(sorted((case.place / "outputs" / "train").iterdir()))
    rng = case.rng
    kind = case.idea(5)
    name = rng.choice([str(folder.relative_to(case.place)), folder.name])
    if kind == 0:
        case.spoil(
            folder / "model.yaml", lambda content, rng: spoil_yaml(yaml.safe_load(content), rng)
        )
    elif kind == 1:
        case.spoil(folder / "model.safetensors", spoil_bytes)
    elif kind == 2:
        case.spoil(
            folder / "model.safetensors",
            lambda content, rng: _with_header(content, lambda head: spoil_json(head, rng), rng),
        )
    elif kind == 3:
        _replace_by_special_file(
            folder / rng.choice(["model.yaml", "model.safetensors", "manifest.json"]),
            case.visit // 5,
        )
    elif not case.honest:
        name = rng.choice(
            ["", ".", "..", "/", "*", "[", "k", "../train", "outputs", "raw", "**", *WRITABLE_NAMES]
        )
    if kind < 3 and not case.honest:
        _mend(folder)
    entries = [
        ("estimate", name, "lap.csv", "-o", "out.csv"),
        ("eval", "--model", name, "split=mine", "tracking=none", "--force"),
    ]
    return Command(rng.choice(entries))


@template
def unfinished(folder):
    """An output root with the checkpoint of a training that was killed."""
    from vehest.artefacts.artefact import StagePlan
    from vehest.run import group

    drives(folder)
    with patch.object(group, "drop_checkpoint"), patch.object(StagePlan, "drop"):
        run("train", *KSNN, "training.checkpoint_seconds=1e-9", "--quiet")
    if not list((folder / "outputs" / "checkpoints").rglob("*.safetensors")):
        raise RuntimeError("no checkpoint was left")
    for file in (folder / "outputs" / "train").glob("*/*"):
        file.unlink()


@generator("unfinished", weight=3)
def checkpoint(case):
    """A damaged checkpoint of a training that goes on."""
    case.copy("unfinished")
    file = sorted((case.place / "outputs" / "checkpoints").rglob("*.safetensors"))[0]
    if case.rng.random() < 0.3:
        case.spoil(file, spoil_bytes)
    else:
        case.spoil(
            file,
            lambda content, rng: _with_header(content, lambda header: spoil_json(header, rng), rng),
        )
    return Command(("train", *KSNN))


@template
def tracked(folder):
    """A training and its evaluation, logged in a local store."""
    drives(folder)
    run("train", *TRACKED, "--quiet")
    run("eval", *TRACKED, "--quiet")


@generator("tracked", weight=2)
def tracking_store(case):
    """The store is damaged, or something else stands in its place: work goes on without it and says
    so.
    """
    case.copy("tracked")
    store = case.place / "outputs" / "mlflow.db"
    kind = case.idea(4)
    if kind == 0:
        _replace_by_special_file(store, case.visit // 4)
    elif kind == 1:
        connection = sqlite3.connect(store)
        connection.executescript(case.rng.choice(STATEMENTS))
        connection.close()
    else:
        case.spoil(
            store,
            lambda content, rng: spoil_bytes(content[: rng.choice([100, 5000, len(content)])], rng),
        )
    return Command(("eval", *TRACKED, "--force"))
