"""Records of tables in results/ that a command outside pipelines made, and their comparison with today's code and raw files.

command -> `record_tables` -> ``tables`` and ``keys`` in provenance.json of the folder -> `changes_of_tables` -> `vehest report --check`

A key is named ``TABLE: WHAT``. WHAT is ``content`` (the table as it was written), ``script FILE`` (the line ``VERSION = "…"`` of the
script that made it), ``data DATASET`` (its ingest and raw files), ``files PATTERN`` (raw files below VEHEST_DATA that belong to no data
set) or a stage with a name, ``train ksnn``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from vehest.data.errors import ConfigurationError, MissingError
from vehest.data.files import sha256_of, written_aside
from vehest.data.text_files import read_json
from vehest.run.artefacts import CHECKOUT, provenance
from vehest.run.config import compose_config
from vehest.run.ingest import plan_ingest
from vehest.run.keys import hash_of
from vehest.run.publishing import PROVENANCE, RESULTS, TableRecord
from vehest.run.versions import code_of

VERSION_LINE = re.compile(r'^VERSION = "(.+?)"', re.MULTILINE)


def record_tables(
    tables: Sequence[Path], command: str, determined_by: Sequence[str], without_keys: str = ""
) -> None:
    """Write to provenance.json beside tables how they were made; other tables' records stay.

    Tables outside results/, of a trial, are not recorded.

    Args:
        tables: files just written, all in one folder; files that are not there are left out.
        command: what makes them again.
        determined_by: what else their numbers follow from, as in the names of keys.
        without_keys: what of them was made before keys were recorded.

    Raises:
        MissingError: raw files that the numbers follow from are not here, as where a record is written
            after the tables; without their digest the tables would be stale wherever the files are.
    """
    file = tables[0].parent / PROVENANCE
    if file.parent.parent.name != RESULTS.name:
        return
    former = read_json(file) if file.is_file() else {}
    names = [table.name for table in tables if table.is_file()]
    about = provenance()
    record = {"command": command, "created": about["created"], "commit": about["commit"]}
    if without_keys:
        record["without_keys"] = without_keys
    keys = {
        what: key
        for what, key in former.get("keys", {}).items()
        if what.partition(": ")[0] not in names
    }
    for name in names:
        for what in ("content", *determined_by):
            keys[f"{name}: {what}"] = key = today_of(f"{name}: {what}", file.parent)
            if what.startswith(("data ", "files ")) and "data" not in key:
                raise MissingError(
                    f"'{file}' cannot record '{name}': raw files of {what} are not here"
                )
    records = former.get("tables", {}) | dict.fromkeys(names, record)
    with written_aside(file) as aside:
        aside.write_text(
            json.dumps({"tables": records, "keys": keys}, indent=1, ensure_ascii=False) + "\n",
            encoding="utf-8",
        )


def today_of(key: str, folder: Path, overrides: Sequence[str] = ()) -> dict[str, str]:
    """What a key of a table in ``folder`` is today; without ``data`` where raw files are not here.

    Raises:
        ConfigurationError: the name is unknown.
    """
    table, _, what = key.partition(": ")
    kind, _, name = what.partition(" ")
    if what == "content":
        file = folder / table
        return {"data": sha256_of(file)[:16] if file.is_file() else "removed"}
    if kind == "script":
        script = CHECKOUT / name
        found = VERSION_LINE.search(script.read_text("utf-8")) if script.is_file() else None
        return {"code": f"{name}={found[1] if found else 'none'}"}
    if kind == "data":
        config = compose_config("ingest", [f"dataset={name}", *overrides])
        entry = {"code": code_of("ingest", str(config["dataset"]["source"]))}
        with suppress(MissingError):
            entry["data"] = hash_of(plan_ingest(config).inputs)[:16]
        return entry
    if kind == "files":
        root = Path(str(compose_config("ingest", ["dataset=tabular", *overrides])["root"]))
        files = {str(file.relative_to(root)): sha256_of(file) for file in sorted(root.glob(name))}
        return {"data": hash_of(files)[:16]} if files else {}
    return {"code": code_of(kind, name)}


def changes_of_tables(
    records: Mapping[str, TableRecord],
    keys: Mapping[str, Mapping[str, str]],
    folder: Path,
    overrides: Sequence[str] = (),
) -> tuple[list[tuple[str, str]], str]:
    """Pairs of what differs from when tables were made and its cause; a note on what was not compared."""
    changes = []
    missing = []
    for what, then in keys.items():
        try:
            today = today_of(what, folder, overrides)
        except ConfigurationError:
            changes.append((f"{what} removed", "configuration"))
            continue
        changes += [(what, cause) for cause in today if today[cause] != then.get(cause)]
        if "data" in then and "data" not in today:
            missing.append(what.partition(": ")[2].partition(" ")[2])
    files = {file.name for file in folder.iterdir()} - {PROVENANCE}
    changes += [(f"{name} without a record", "data") for name in sorted(files - records.keys())]
    notes = [
        f"{name}: {record.without_keys} without keys ({record.command})"
        for name, record in records.items()
        if record.without_keys
    ]
    if missing:
        notes.append(f"data not checked, raw files not here: {', '.join(dict.fromkeys(missing))}")
    return changes, "; ".join(notes)
