"""Output roots: manifests, missing and truncated files, links, checkpoints of unfinished trainings."""

from __future__ import annotations

import json
import os
import struct
from pathlib import Path

from fuzz.case import Case, Command, generator, template
from fuzz.honest import KSNN, drives, run
from fuzz.mutations import NAMES, spoil_bytes, spoil_json, spoil_text

STAGES = ("ingest", "downsample", "train", "calibrate", "evaluate", "report")


def _commands(case: Case) -> Command:
    how = case.rng.random()
    if how < 0.1:  # these draw the report anew, which takes seconds
        return Command(("run", "small", "tracking=none", "--jobs", "1") if how < 0.05 else ("report", "small", "tracking=none"))
    if how < 0.5:
        return Command(("run", "small", "tracking=none", "--dry-run"))
    return Command(("eval", *KSNN))


def _folder(case: Case) -> Path:
    case.copy("study")
    folders = [folder for stage in STAGES for folder in sorted((case.place / "outputs" / stage).glob("*"))]
    return case.rng.choice(folders)


@generator("study", weight=3)
def manifests(case: Case) -> Command:
    folder = _folder(case)
    file = folder / "manifest.json"
    if not case.honest:
        file.write_bytes(spoil_json(json.loads(file.read_text()), case.rng))
    return _commands(case)


@generator("study", weight=2)
def names_in_manifests(case: Case) -> Command:
    folder = _folder(case)
    file = folder / "manifest.json"
    if not case.honest:
        content = json.loads(file.read_text())
        name = case.rng.choice([*NAMES, str(case.folder / "evil"), "../../../../evil"])
        content[case.rng.choice(["label", "stage"])] = name
        if case.rng.random() < 0.3:
            content["outputs"] = {name: next(iter(content["outputs"].values()))}
        file.write_text(json.dumps(content))
    return _commands(case)


@generator("study", weight=3)
def files(case: Case) -> Command:
    """A file of an artefact is spoilt while the manifest still agrees with its size."""
    folder = _folder(case)
    file = case.rng.choice([one for one in sorted(folder.rglob("*")) if one.is_file() and one.name != "manifest.json"])
    if not case.honest:
        content = file.read_bytes()
        spoilt = (
            spoil_text(content.decode(), case.rng) if file.suffix in (".csv", ".json", ".yaml", ".md") else spoil_bytes(content, case.rng)
        )
        file.write_bytes(spoilt)
        manifest = json.loads((folder / "manifest.json").read_text())
        manifest["outputs"][file.relative_to(folder).as_posix()]["bytes"] = len(spoilt)
        (folder / "manifest.json").write_text(json.dumps(manifest))
    return Command(("report", "small", "tracking=none", "--force")) if case.rng.random() < 0.2 else _commands(case)


@generator("study", weight=2)
def links_and_leftovers(case: Case) -> Command:
    folder = _folder(case)
    manifest, outputs, elsewhere = folder / "manifest.json", case.place / "outputs", case.folder / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "kept.txt").write_text("kept")
    if not case.honest:
        how = case.visit % 10
        if how == 0:
            manifest.unlink()
        elif how == 1:
            manifest.unlink()
            os.mkfifo(manifest)
        elif how == 2:
            manifest.unlink()
            manifest.symlink_to("/dev/zero")
        elif how == 3:
            manifest.unlink()
            manifest.symlink_to("manifest.json")
        elif how == 4:
            (folder.parent / ".writing-1-aaaaaaaa-x").symlink_to(elsewhere)
        elif how == 5:
            (folder.parent / ".writing-999999-aaaaaaaa-x").symlink_to(elsewhere)
        elif how == 6:
            (folder.parent / ".writing-99999999999999999999-a-x").mkdir()
        elif how == 7:
            (outputs / "train" / "not a model").write_text("a file")
        elif how == 8:
            folder.rename(folder.with_name("moved"))
            folder.write_text("a file where a folder belongs")
        else:
            (outputs / "train" / "\udcff\udcfe").mkdir()
    return _commands(case)


@generator("drives", weight=2)
def output_roots(case: Case) -> Command:
    """What may stand where the output root belongs."""
    case.copy("drives")
    if case.honest:
        return Command(("ingest", "mine", "output=outputs/deeper"))
    place, how = case.place, case.visit % 12
    if how == 0:
        (place / "outputs").write_text("a file")
    elif how == 1:
        (place / "outputs").symlink_to("outputs")
    elif how == 2:
        (place / "outputs").symlink_to("/dev/null")
    elif how == 3:
        os.mkfifo(place / "outputs")
    elif how == 4:
        (place / "outputs").mkdir()
        (place / "outputs" / "ingest").write_text("a file")
    if how <= 4:
        return Command(("ingest", "mine"))
    written = ["/dev/null", "/dev/full/x", "outputs/" + "x" * 300, "''", "null", "[1]", "outputs/\x01", "3", "/proc/x", "/dev/stdin"]
    return Command(("ingest", "mine", f"output={case.rng.choice(written)}"))


@generator("drives")
def no_rights(case: Case) -> Command:
    """Folders and files that may not be read or written."""
    case.copy("drives")
    (case.place / "outputs").mkdir()
    if not case.honest:
        what = case.place / str(case.idea("outputs", "raw/one.csv", "raw", "conf", "conf/dataset/mine.yaml", "conf/dataset", "pipelines"))
        os.chmod(what, 0o000 if case.rng.random() < 0.7 else 0o444)
    command = case.rng.choice(
        [("ingest", "mine"), ("data", "check", "mine"), ("data", "show", "mine"), ("run", "small", "--dry-run", "tracking=none")]
    )
    return Command(command, unprivileged=True)


@template
def unfinished(folder: Path) -> None:
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
    for trained in (folder / "outputs" / "train").iterdir():
        for file in trained.iterdir():
            file.unlink()
        trained.rmdir()


@generator("unfinished", weight=3)
def checkpoints(case: Case) -> Command:
    case.copy("unfinished")
    files = sorted((case.place / "outputs" / "checkpoints").rglob("*.safetensors"))
    if not case.honest and files:
        (file,) = files[:1]
        content = file.read_bytes()
        (length,) = struct.unpack("<Q", content[:8])
        header = json.loads(content[8 : 8 + length])
        how = case.rng.randrange(3)
        if how == 0:
            file.write_bytes(spoil_bytes(content, case.rng))
        else:
            if how == 1:
                values = spoil_json(json.loads(header["__metadata__"]["values"]), case.rng)
                header["__metadata__"]["values"] = values.decode("utf-8", "replace")
                spoilt = json.dumps(header).encode()
            else:
                spoilt = spoil_json(header, case.rng)
            spoilt += b" " * (-len(spoilt) % 8)
            file.write_bytes(struct.pack("<Q", len(spoilt)) + spoilt + content[8 + length :])
    return Command(("train", *KSNN))
