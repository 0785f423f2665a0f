"""What stands in an output root and beside it: manifests, models, checkpoints, files, links, the MLflow store, checksums."""

import hashlib
import json
import math
import os
import sqlite3
import struct

import numpy as np
import yaml
from safetensors.numpy import load_file, save_file

from fuzz.case import Command, generator, template
from fuzz.honest import KSNN, drives, run, write_yaml
from fuzz.mutations import NAMES, WRITABLE_NAMES, spoil_bytes, spoil_json, spoil_text, spoil_yaml
from place import DATASET

STAGES = ("ingest", "downsample", "train", "calibrate", "evaluate", "report")
TRACKED = tuple(word for word in KSNN if not word.startswith("tracking"))
STATEMENTS = ("DELETE FROM experiments", "DROP TABLE runs", "UPDATE alembic_version SET version_num = 'x'", "DROP TABLE alembic_version")
URLS = ("file:///etc", "ftp://x", "", "http://", "https://[", "x" * 9999, "https://\x1b[2J")
SETTINGS = (0, -1, 1, 10**9, 10**18, 1e-12, math.nan, math.inf, "a", None, [], True, 2.5)


def _mend(folder):
    """Let the manifest name the files as they are now, so that they are read."""
    file = folder / "manifest.json"
    content = json.loads(file.read_text())
    for name, entry in content["outputs"].items():
        if (folder / name).is_file():
            entry["bytes"] = (folder / name).stat().st_size
    file.write_text(json.dumps(content))


def _put(file, how):
    """Something else in the place of a file: nothing, a folder, a pipe, a link."""
    file.unlink()
    makers = [lambda: None, file.mkdir, lambda: os.mkfifo(file), file.touch]
    [*makers, lambda: file.symlink_to("/dev/zero"), lambda: file.symlink_to(file.name)][how % 6]()


def _rename(content, case):
    """Labels and file names in a manifest that lead elsewhere."""
    tree = json.loads(content)
    name = case.rng.choice([*NAMES, str(case.folder / "evil"), "../../../../evil", str(case.place / "raw" / "evil")])
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
    """Manifests and files of every stage; a file is spoilt while the manifest still agrees with its size."""
    case.copy("study")
    folder = case.rng.choice([folder for stage in STAGES for folder in sorted((case.place / "outputs" / stage).glob("*"))])
    file, how = folder / "manifest.json", case.idea(4)
    if how == 0:
        case.spoil(file, lambda content, rng: _rename(content, case))
    elif how == 1:
        file = case.rng.choice([one for one in sorted(folder.rglob("*")) if one.is_file() and one != file])
        text = file.suffix in (".csv", ".json", ".yaml", ".md")
        case.spoil(file, lambda content, rng: spoil_text(content.decode(), rng) if text else spoil_bytes(content, rng))
        _mend(folder)
    elif how == 2:
        _put(file, case.visit // 4)
    else:
        case.spoil(file, spoil_json)
    likely = [("run", "small", "tracking=none", "--dry-run"), ("eval", *KSNN)] * 5  # the others draw the report anew, which takes seconds
    force = [] if case.honest else [("report", "small", "tracking=none", "--force")]
    return Command(case.rng.choice([*likely, ("run", "small", "tracking=none", "--jobs", "1"), *force]))


@generator("study", weight=2)
def leftovers(case):
    """Links, half-written folders and files among the artefacts; what stands where the output root belongs."""
    case.copy("study")
    outputs, elsewhere = case.place / "outputs", case.folder / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "kept.txt").write_text("kept")
    train, before, how = outputs / "train", case.place / "raw" / "before", case.idea(8)
    if how in (0, 1):
        (train / (".writing-1-aaaaaaaa-x", ".writing-999999-aaaaaaaa-x")[how]).symlink_to(elsewhere)
    elif how == 2:
        (train / ".writing-99999999999999999999-a-x").mkdir()
        (train / "\udcff\udcfe").mkdir()
    elif how >= 3:
        place = train if how == 3 else outputs
        place.rename(before)
        makers = [lambda: place.write_text("a file"), lambda: place.symlink_to(place.name), lambda: place.symlink_to("/dev/null")]
        [makers[0], *makers, lambda: os.mkfifo(place)][how - 3]()
    return Command(("ingest", "mine") if how >= 4 else ("eval", *KSNN))


@generator("study", weight=10)
def model(case):
    """model.yaml, model.safetensors with its header, manifest.json; names of models and folders that are none."""
    case.copy("study")
    folder, rng, how = case.rng.choice(sorted((case.place / "outputs" / "train").iterdir())), case.rng, case.idea(7)
    name = rng.choice([str(folder.relative_to(case.place)), folder.name])
    if how == 0:
        case.spoil(folder / "model.yaml", lambda content, rng: spoil_yaml(yaml.safe_load(content), rng))
    elif how == 1:
        case.spoil(folder / "model.yaml", _other_setting)
    elif how == 2:
        case.spoil(folder / "model.safetensors", spoil_bytes)
    elif how == 3:
        case.spoil(folder / "model.safetensors", lambda content, rng: _with_header(content, lambda head: spoil_json(head, rng), rng))
    elif how == 4:
        _other_weights(folder / "model.safetensors", case)
    elif how == 5:
        case.spoil(
            folder / "manifest.json", lambda content, rng: _rename(content, case) if rng.random() < 0.5 else spoil_json(content, rng)
        )
    elif case.visit // 7 % 2:
        _put(folder / rng.choice(["model.yaml", "model.safetensors", "manifest.json"]), case.visit // 14)
    elif not case.honest:
        name = rng.choice(["", ".", "..", "/", "*", "[", "k", "../train", "outputs", "raw", "**", *WRITABLE_NAMES])
    if how < 5 and not case.honest:
        _mend(folder)
    used = [("estimate", name, "lap.csv", "-o", "out.csv"), ("eval", "--model", name, "split=mine", "tracking=none", "--force")]
    return Command(rng.choice(used))


def _other_setting(content, rng):
    """One setting of the model far outside of what makes sense, or another estimator."""
    tree = yaml.safe_load(content)
    tree["settings"][rng.choice(list(tree["settings"]))] = rng.choice(SETTINGS)
    if rng.random() < 0.2:
        tree["estimator"] = rng.choice([*WRITABLE_NAMES, "gru", "kalman", "os.system", "vehest.cli:main", 3, None])
    return yaml.safe_dump(tree).encode()


def _other_weights(file, case):
    held, rng = load_file(file), case.rng
    name = rng.choice(list(held))
    changes = [
        {name: np.full_like(held[name], rng.choice([math.nan, 1e30, -1e30, math.inf]))},
        {name: held[name].ravel()[:1].copy()},
        {name: np.zeros((3, 0, 2))},
        {name: held[name].astype(rng.choice(["f2", "i8", "u1", "?"]))},
        {name: np.zeros((*held[name].shape, 2))},
        {rng.choice(WRITABLE_NAMES): np.zeros(2)},
        {name: np.zeros(20_000_000)},
        {key: np.zeros(1) for key in held},
    ]
    kept = {key: value for key, value in held.items() if key != name or rng.random() < 0.8}
    save_file(kept | rng.choice([*changes, {}]), file)


@template
def unfinished(folder):
    """An output root with the checkpoint of a training that was killed."""
    from vehest.run import group

    drives(folder)
    kept = group.drop_checkpoint
    group.drop_checkpoint = lambda path: None
    try:
        run("train", *KSNN, "training.checkpoint_seconds=1e-9", "--quiet")
    finally:
        group.drop_checkpoint = kept
    if not list((folder / "outputs" / "checkpoints").rglob("*.safetensors")):
        raise RuntimeError("no checkpoint was left")
    for file in (folder / "outputs" / "train").glob("*/*"):
        file.unlink()


def _other_values(header, rng):
    tree = json.loads(header)
    tree["__metadata__"]["values"] = spoil_json(tree["__metadata__"]["values"].encode(), rng).decode("utf-8", "replace")
    return json.dumps(tree).encode()


@generator("unfinished", weight=3)
def checkpoint(case):
    case.copy("unfinished")
    file, change = sorted((case.place / "outputs" / "checkpoints").rglob("*.safetensors"))[0], case.rng.choice([_other_values, spoil_json])
    if case.rng.random() < 0.3:
        case.spoil(file, spoil_bytes)
    else:
        case.spoil(file, lambda content, rng: _with_header(content, lambda header: change(header, rng), rng))
    return Command(("train", *KSNN))


@template
def tracked(folder):
    """A training and its evaluation, logged in a local store."""
    drives(folder)
    run("train", *TRACKED, "--quiet")
    run("eval", *TRACKED, "--quiet")


@generator("tracked", weight=2)
def tracking_store(case):
    """The store is damaged, or something else stands in its place: work goes on without it and says so."""
    case.copy("tracked")
    store, how = case.place / "outputs" / "mlflow.db", case.idea(4)
    if how == 0:
        _put(store, case.visit // 4)
    elif how == 1:
        connection = sqlite3.connect(store)
        connection.executescript(case.rng.choice(STATEMENTS))
        connection.close()
    else:
        case.spoil(store, lambda content, rng: spoil_bytes(content[: rng.choice([100, 5000, len(content)])], rng))
    return Command(("eval", *TRACKED, "--force"))


@generator("drives", weight=2)
def downloads(case):
    """All files are there already; the record of their checksums, or what is declared, is spoilt. Nothing is fetched."""
    raw = case.copy("drives") / "raw"
    sums = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in sorted(raw.iterdir())}
    record = case.write("raw/checksums.txt", "".join(f"{name} {digest}\n" for name, digest in sums.items()))
    declared = {"url": "https://example.org/folder", "files": list(sums), "sha256": dict(sums)}
    if case.idea(2) == 0:
        case.spoil(record, lambda content, rng: spoil_text(content.decode(), rng))
    elif not case.honest:
        declared |= {"url": case.rng.choice(URLS)} if case.rng.random() < 0.5 else {"files": [case.rng.choice(WRITABLE_NAMES)]}
    write_yaml(case.place / "conf" / "dataset" / "mine.yaml", DATASET | {"download": declared})
    return Command(("ingest", "mine", "--download"), targets=("raw/checksums.txt", "raw/.download"))
