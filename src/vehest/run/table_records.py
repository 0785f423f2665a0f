"""Records of tables in results/ that a command outside pipelines made, and their comparison with
today's code and raw files.

command -> `record_tables` -> ``tables`` and ``keys`` in provenance.json of the folder ->
`changes_of_tables` -> `vehest report --check`

A key is named ``TABLE: WHAT``. WHAT is ``content`` (the table as it was written), ``script FILE``
(the line ``VERSION = "…"`` of the script that made it), ``data DATASET`` (its ingest and raw
files), ``files PATTERN`` (raw files below VEHEST_DATA that belong to no data set) or a stage with a
name, ``train ksnn``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from vehest.artefacts.artefact import CHECKOUT, provenance
from vehest.artefacts.keys import hash_of
from vehest.configuration.composition import compose_config
from vehest.data.errors import ConfigurationError, MissingError
from vehest.data.files import sha256_of, written_aside
from vehest.data.text_files import read_json, write_json
from vehest.run.ingest import plan_ingest
from vehest.run.publishing import PROVENANCE, RESULTS, TableRecord
from vehest.run.versions import code_of

# matches the version that a script states
VERSION_LINE = re.compile(r'^VERSION = "(.+?)"', re.MULTILINE)


class RowKeys(NamedTuple):
    """Keys of a table's groups of rows, where a command may make some groups alone, as ``--only
    gru``.

    Attributes
    ----------
    remade : mapping
        Group that was made anew -> what its numbers follow from, ``{"gru": "train gru"}``.
    former : mapping
        The same of groups with rows of an earlier run, whose keys stay as they were recorded.
    """

    remade: Mapping[str, str]
    former: Mapping[str, str]


def record_tables(
    tables: Sequence[Path],
    command: str,
    determined_by: Sequence[str],
    without_keys: str = "",
    rows: RowKeys | None = None,
) -> None:
    """Record in provenance.json, beside tables, how these were made; records of other tables stay.

    Tables outside results/, such as those of a trial, are not recorded.

    Parameters
    ----------
    tables : Sequence[Path]
        Files just written, all in one folder; files that are not there are left out.
    command : str
        What makes them again.
    determined_by : Sequence[str]
        What else all numbers follow from, as in the names of keys. While rows of an earlier run
        stay, a recorded key of it stays too: the table is stale until all rows are made with
        today's.
    without_keys : str
        What of them was made before keys were recorded.
    rows : RowKeys or None
        Further keys, each of some rows; groups without a recorded key are named as
        ``without_keys``.

    Raises
    ------
    MissingError
        Raw files that the numbers follow from are not here, as where a record is written after the
        tables; without their digest the tables would be stale wherever the files are.
    """
    file = tables[0].parent / PROVENANCE
    if file.parent.parent.name != RESULTS.name:
        return
    recorded = read_json(file) if file.is_file() else {}
    names = [table.name for table in tables if table.is_file()]
    about = provenance()
    record = {"command": command, "created": about["created"], "commit": about["commit"]}
    keys = {
        origin: key
        for origin, key in recorded.get("keys", {}).items()
        if origin.partition(": ")[0] not in names
    }
    remade, former = rows or RowKeys({}, {})
    records = dict(recorded.get("tables", {}))
    for name in names:
        before = {
            origin: key
            for origin, key in recorded.get("keys", {}).items()
            if origin.startswith(f"{name}: ")
        }
        keys[f"{name}: content"] = today_of(f"{name}: content", file.parent)
        for origin in (*determined_by, *former.values(), *remade.values()):
            key = f"{name}: {origin}"
            if former and key in before and origin not in remade.values():
                keys[key] = before[key]
            elif origin not in former.values():
                keys[key] = today_of(key, file.parent)
            else:
                continue
            if origin.startswith(("data ", "files ")) and "data" not in keys[key]:
                raise MissingError(
                    f"'{file}' cannot record '{name}': raw files of {origin} are not here"
                )
        groups = [group for group, origin in former.items() if f"{name}: {origin}" not in before]
        remark = f"rows of {', '.join(groups)}" if groups else without_keys
        records[name] = record | ({"without_keys": remark} if remark else {})
    with written_aside(file) as aside:
        write_json(aside, {"tables": records, "keys": keys})


def today_of(key: str, folder: Path, overrides: Sequence[str] = ()) -> dict[str, str]:
    """Present value of a key of a table in ``folder``; without ``data`` where raw files are not
    available.

    Parameters
    ----------
    key : str
        ``TABLE: WHAT``.
    folder : Path
        Of the table, in results/.
    overrides : sequence of str
        Of where raw files come from.

    Returns
    -------
    dict
        ``code`` or ``data``, or both.

    Raises
    ------
    ConfigurationError
        The name is unknown.
    """
    table, _, origin = key.partition(": ")
    kind, _, name = origin.partition(" ")
    if origin == "content":
        file = folder / table
        return {"data": sha256_of(file)[:16] if file.is_file() else "removed"}
    if kind == "script":
        script = CHECKOUT / name
        version = VERSION_LINE.search(script.read_text("utf-8")) if script.is_file() else None
        return {"code": f"{name}={version[1] if version else 'none'}"}
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
    overrides: Sequence[str],
) -> tuple[list[tuple[str, str]], str]:
    """Differences from when tables were made, as pairs with their cause, and a note on what was not
    compared.

    Parameters
    ----------
    records : mapping
        Table -> its record.
    keys : mapping
        Key -> what it was.
    folder : Path
        Of the tables.
    overrides : sequence of str
        Of where raw files come from.
    """
    changes = []
    missing = []
    for key, then in keys.items():
        try:
            today = today_of(key, folder, overrides)
        except ConfigurationError:
            changes.append((f"{key} removed", "configuration"))
            continue
        changes += [(key, cause) for cause in today if today[cause] != then.get(cause)]
        if "data" in then and "data" not in today:
            missing.append(key.partition(": ")[2].partition(" ")[2])
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
