"""Model folders: model.yaml, model.safetensors, manifest.json."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from safetensors.numpy import load_file, save_file

from fuzz.case import Case, Command, generator
from fuzz.honest import KSNN, models_in
from fuzz.mutations import NAMES, spoil_bytes, spoil_json, spoil_yaml


def _uses(case: Case, model: Path) -> Command:
    """A command that reads a model folder."""
    how = case.rng.randrange(12)
    name = str(model.relative_to(case.place)) if case.rng.random() < 0.5 else model.name
    if how <= 6:
        return Command(("estimate", name, "lap.csv", "-o", "out.csv"), targets=("out.csv",))
    if how <= 10:
        return Command(("eval", "--model", name, "split=mine", "tracking=none", "--force"))
    return Command(("run", "small", "tracking=none", "--jobs", "1", "--quiet"))


def _model(case: Case) -> Path:
    case.copy("study")
    return case.rng.choice(models_in(case))


@generator("study", weight=4)
def model_yaml(case: Case) -> Command:
    model = _model(case)
    file = model / "model.yaml"
    if not case.honest:
        file.write_bytes(spoil_yaml(yaml.safe_load(file.read_text()), case.rng))
        _mend(model)
    return _uses(case, model)


@generator("study", weight=2)
def settings_in_model_yaml(case: Case) -> Command:
    """One setting of the model far outside of what makes sense."""
    model = _model(case)
    file = model / "model.yaml"
    if not case.honest:
        content = yaml.safe_load(file.read_text())
        key = case.rng.choice(list(content["settings"]))
        content["settings"][key] = case.rng.choice([0, -1, 1, 10**9, 10**18, 1e-12, math.nan, math.inf, "a", None, [], True, 2.5])
        if case.rng.random() < 0.2:
            content["estimator"] = case.rng.choice([*NAMES, "gru", "kalman", "os.system", "vehest.cli:main", 3, None])
        file.write_text(yaml.safe_dump(content))
        _mend(model)
    return _uses(case, model)


@generator("study", weight=2)
def bytes_of_weights(case: Case) -> Command:
    model = _model(case)
    file = model / "model.safetensors"
    if not case.honest:
        file.write_bytes(spoil_bytes(file.read_bytes(), case.rng))
        _mend(model)
    return _uses(case, model)


@generator("study", weight=3)
def weights(case: Case) -> Command:
    model = _model(case)
    file = model / "model.safetensors"
    if not case.honest:
        held = load_file(file)
        name, rng = case.rng.choice(list(held)), case.rng
        changes: list[Any] = [
            lambda: held | {name: np.full_like(held[name], math.nan)},
            lambda: held | {name: np.full_like(held[name], rng.choice([1e30, -1e30, math.inf]))},
            lambda: held | {name: held[name].ravel()[:1].copy()},
            lambda: held | {name: np.zeros((3, 0, 2))},
            lambda: held | {name: held[name].astype(rng.choice(["f2", "i8", "u1", "?"]))},
            lambda: held | {name: np.zeros((*held[name].shape, 2))},
            lambda: {key: value for key, value in held.items() if key != name},
            lambda: {},
            lambda: held | {rng.choice(NAMES[:20]).replace("\ud8ff", ""): np.zeros(2)},
            lambda: held | {name: np.zeros(20_000_000)},
            lambda: {key: np.zeros(1) for key in held},
        ]
        save_file(changes[case.visit % len(changes)](), file)
        _mend(model)
    return _uses(case, model)


@generator("study", weight=2)
def header_of_weights(case: Case) -> Command:
    """The JSON at the head of a safetensors file."""
    model = _model(case)
    file = model / "model.safetensors"
    if not case.honest:
        content = file.read_bytes()
        (length,) = struct.unpack("<Q", content[:8])
        header = spoil_json(json.loads(content[8 : 8 + length]), case.rng)
        said = case.rng.choice([len(header), len(header), len(header), 0, 2**63, 2**64 - 1, len(content) * 2])
        file.write_bytes(struct.pack("<Q", said) + header + content[8 + length :])
        _mend(model)
    return _uses(case, model)


@generator("study", weight=4)
def manifest_of_a_model(case: Case) -> Command:
    model = _model(case)
    file = model / "manifest.json"
    if not case.honest:
        file.write_bytes(spoil_json(json.loads(file.read_text()), case.rng))
    return _uses(case, model)


@generator("study", weight=2)
def names_in_a_manifest(case: Case) -> Command:
    """Labels and file names that lead elsewhere."""
    model = _model(case)
    file = model / "manifest.json"
    if not case.honest:
        content = json.loads(file.read_text())
        name = case.rng.choice([*NAMES, str(case.folder / "evil"), "../../../../evil", str(case.place / "raw" / "evil")])
        if case.rng.random() < 0.7:
            content[case.rng.choice(["label", "label", "stage", "key"])] = name
        else:
            content["outputs"][name] = {"sha256": "0" * 64, "bytes": 0}
        file.write_text(json.dumps(content))
    return Command(("eval", "--model", str(model.relative_to(case.place)), "split=mine", "tracking=none"))


@generator("study")
def folders_that_are_no_models(case: Case) -> Command:
    model = _model(case)
    if case.honest:
        return _uses(case, model)
    how = case.visit % 8
    if how == 0:
        (model / "model.yaml").unlink()
    elif how == 1:
        (model / "model.safetensors").unlink()
    elif how == 2:
        (model / "manifest.json").unlink()
    elif how == 3:
        (model / "model.yaml").unlink()
        (model / "model.yaml").mkdir()
    elif how == 4:
        (model / "model.safetensors").unlink()
        (model / "model.safetensors").symlink_to("/dev/zero")
    elif how == 5:
        (model / "model.yaml").unlink()
        (model / "model.yaml").symlink_to("/dev/zero")
    elif how == 6:
        (model / "model.safetensors").unlink()
        (model / "model.safetensors").symlink_to("model.safetensors")
    else:
        (model / "model.safetensors").write_bytes(b"")
    return Command(("estimate", str(model.relative_to(case.place)), "lap.csv", "-o", "out.csv"), targets=("out.csv",))


@generator("study")
def names_of_models(case: Case) -> Command:
    """What a model may be called on the command line."""
    model = _model(case)
    name = (
        model.name if case.honest else case.rng.choice(["", ".", "..", "/", "*", "[", "k", "../train", "outputs", "raw", "**", *NAMES[:22]])
    )
    if "\x00" in name or "\ud8ff" in name:
        name = "none"
    if case.visit % 2:
        return Command(("eval", "--model", name, *KSNN[2:3], "tracking=none"))
    return Command(("estimate", name, "lap.csv", "-o", "out.csv"), targets=("out.csv",))


def _mend(model: Path) -> None:
    """Let the manifest name the files as they are now, so that they are read."""
    file = model / "manifest.json"
    content = json.loads(file.read_text())
    for name, entry in content["outputs"].items():
        if (model / name).is_file():
            entry["bytes"] = (model / name).stat().st_size
    file.write_text(json.dumps(content))
