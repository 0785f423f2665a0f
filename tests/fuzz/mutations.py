"""Hostile values, names and texts, and ways to spoil bytes and trees of plain values."""

from __future__ import annotations

import copy
import json
import math
import random
from collections.abc import Mapping
from datetime import date
from typing import Any

import yaml

from fuzz.case import CANARY

CALL = f"__import__('os').system('touch {CANARY}')"
SHELL = f"$(touch {CANARY})"

NAMES = (
    "../../../evil",
    "../evil",
    "../../../../../../evil",
    "a/b/c",
    "..",
    ".",
    "",
    " ",
    "-rf",
    "--help",
    ".hidden",
    "a\x1b[2Jb",
    "a\nerror: b",
    "a\x00b",
    "\u202eevil",
    "\ud8ff",
    "ä ö ü 😀",
    "x" * 300,
    "x" * 5000,
    "con",
    "a*b?[c]",
    "**/*",
    "~root",
    SHELL,
    "`touch EXECUTED`",
    "; touch EXECUTED",
    "<script>alert(1)</script>",
    "[red]x[/red]",
    "[/]",
    "%s%n%x",
    "{0}",
    "${root}",
    "a=b",
    "a,b",
    "a\tb",
    "\u0000",
    ".writing-1-aaaaaaaa-x",
)
"""Names that no file system, terminal, shell or page should take as they are."""

SCALARS: tuple[Any, ...] = (
    None,
    True,
    False,
    0,
    1,
    -1,
    3,
    2**31,
    2**63,
    10**30,
    10**400,
    -(10**18),
    0.5,
    -0.0,
    1e-320,
    1e300,
    -1e18,
    math.inf,
    -math.inf,
    math.nan,
    "",
    "null",
    "nan",
    "1e400",
    "True",
    "7",
    "x" * 100_000,
    "${nothing.there}",
    "${oc.env:HOME}",
    "${oc.env:NOT_THERE}",
    "${.}",
    "???",
    CALL,
    "os.system",
    [],
    {},
    [[]],
    [None],
    {"": None},
    {"a": {"b": {"c": [1, {"d": 2}]}}},
    [1, "a", None, 2.5],
    {1: 2, None: 3, False: 4},
    date(2020, 1, 1),
    b"\xff\xfe",
    *NAMES[:24],
)
"""Values that belong nowhere in particular."""


class Raw(str):
    """Text that goes into a YAML file as it is."""


RAW = (
    f"!!python/object/apply:os.system ['touch {CANARY}']",
    f"!!python/object/new:os.system ['touch {CANARY}']",
    "!!python/name:os.system",
    "!!python/module:antigravity",
    "!!python/tuple [1, 2]",
    "!unknown {a: 1}",
    "!!binary aGVsbG8=",
    "!!binary '%%%'",
    "!!set {a, b}",
    "!!omap [a: 1]",
    "!!timestamp not-a-time",
    "!!int x",
    "!!float x",
    "&self [*self]",
    "&map {a: *map}",
    "*nowhere",
    "1e400",
    "-.inf",
    ".nan",
    "0o777",
    "0x1F",
    "1_000",
    "12:30:45",
    "2020-13-45",
    "2001-12-14t21:59:43.10-05:00",
    "{<<: 3}",
    "{<<: [*x, 4]}",
    "{a: 1, a: 2}",
    "{? [a, b] : c}",
    "'unfinished",
    "[1, 2",
    "{a: b",
    "|\n  a\n b",
    "\t- a",
    "@at",
    "%percent",
    "[" * 100 + "]" * 100,
    "[" * 5000 + "]" * 5000,
    "{a: " * 70 + "1" + "}" * 70,
    "9" * 5000,
    "0." + "1" * 100_000,
)
"""Pieces of YAML that a reader may stumble over."""


def alias_bomb(rng: random.Random) -> str:
    """A few hundred bytes of YAML that would unfold to 10¹² values, or some such number."""
    width, depth = rng.choice([(10, 12), (2, 40), (100, 6), (9, 9)])
    lines = [f"b0: &b0 [{', '.join(['x'] * width)}]"]
    lines += [f"b{k}: &b{k} [{', '.join([f'*b{k - 1}'] * width)}]" for k in range(1, depth)]
    return "\n".join(lines) + "\n"


def merge_bomb(rng: random.Random) -> str:
    """Mappings merged into mappings."""
    lines = ["m0: &m0 {a: 1, b: 2}"]
    lines += [f"m{k}: &m{k} {{<<: [{', '.join([f'*m{k - 1}'] * 8)}], k{k}: *m{k - 1}}}" for k in range(1, rng.choice([6, 12, 25]))]
    return "\n".join(lines) + "\n"


def spoil_bytes(content: bytes, rng: random.Random, hurts: int | None = None) -> bytes:
    """Flip, cut, repeat, overwrite or insert somewhere, once or a few times."""
    data = bytearray(content)
    for _ in range(hurts or rng.choice([1, 1, 1, 2, 3, 8])):
        size = len(data)
        if not size:
            return bytes(data)
        at, length = rng.randrange(size), rng.choice([1, 2, 4, 8, 16, 100, 1000])
        how = rng.randrange(9)
        if how == 0:
            data[at] = rng.randrange(256)
        elif how == 1:
            data[at] ^= 1 << rng.randrange(8)
        elif how == 2:
            del data[at:]
        elif how == 3:
            del data[at : at + length]
        elif how == 4:
            data[at:at] = rng.randbytes(length)
        elif how == 5:
            data[at : at + length] = bytes(min(length, size - at))
        elif how == 6:
            data[at : at + length] = b"\xff" * min(length, size - at)
        elif how == 7:
            data[at:at] = data[at : at + length] * rng.choice([1, 2, 50])
        else:
            number = rng.choice([0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1])
            width = rng.choice([2, 4, 8])
            data[at : at + width] = (number % 2 ** (8 * width)).to_bytes(width, rng.choice(["little", "big"]))
    return bytes(data)


def hostile(rng: random.Random, yaml_text: bool = False) -> Any:
    """A value that belongs nowhere."""
    if yaml_text and rng.random() < 0.3:
        return Raw(rng.choice(RAW))
    if rng.random() < 0.15:
        return rng.choice(NAMES)
    return copy.deepcopy(rng.choice(SCALARS))


def nested(rng: random.Random, depth: int) -> Any:
    """Lists or mappings in one another."""
    value: Any = 1
    for _ in range(depth):
        value = [value] if rng.random() < 0.5 else {"a": value}
    return value


def spoil_key(tree: Mapping[str, Any], key: str, rng: random.Random) -> Any:
    """What becomes of one value of a tree, hurt as `spoil_tree` does, name included; none where it is gone."""
    spoilt = spoil_tree({key: tree[key]}, rng)
    return spoilt.get(key) if isinstance(spoilt, dict) else spoilt


def spoil_items(tree: Mapping[str, Any], rng: random.Random) -> dict[Any, Any]:
    """What becomes of a tree besides its defaults; nothing where it is a tree no more."""
    spoilt = spoil_tree({key: value for key, value in tree.items() if key != "defaults"}, rng)
    return spoilt if isinstance(spoilt, dict) else {}


def spoil_tree(tree: Any, rng: random.Random, hurts: int | None = None, yaml_text: bool = False) -> Any:
    """Replace, remove, rename, wrap or repeat values anywhere in a tree of plain values, once or a few times."""
    tree = copy.deepcopy(tree)
    for _ in range(hurts or rng.choice([1, 1, 1, 2, 4])):
        holders = [holder for holder in _holders(tree) if holder]
        if not holders:
            return hostile(rng, yaml_text)
        holder = rng.choice(holders)
        key = rng.choice(list(holder)) if isinstance(holder, dict) else rng.randrange(len(holder))
        how = rng.randrange(12)
        if how <= 4:
            holder[key] = hostile(rng, yaml_text)
        elif how == 5:
            del holder[key]
        elif how == 6 and isinstance(holder, dict):
            holder[rng.choice([hostile_key(rng), f"{key}x", str(key).upper()])] = holder.pop(key)
        elif how == 7 and isinstance(holder, dict):
            holder[hostile_key(rng)] = hostile(rng, yaml_text)
        elif how == 8:
            holder[key] = [holder[key]] if rng.random() < 0.5 else {"a": holder[key]}
        elif how == 9:
            holder[key] = nested(rng, rng.choice([10, 70, 150]))
        elif how == 10 and isinstance(holder, list):
            holder.extend(copy.deepcopy(holder[key]) for _ in range(rng.choice([1, 100, 5000])))
        elif isinstance(holder[key], int | float) and not isinstance(holder[key], bool):
            holder[key] = rng.choice([-1, 0, 1e-9, 1e9, 1e18, 2, 10]) * holder[key]
        else:
            holder[key] = str(holder[key])
    return tree


def _holders(tree: Any) -> list[Any]:
    """Every mapping and list of a tree."""
    if isinstance(tree, dict):
        return [tree, *(holder for value in tree.values() for holder in _holders(value))]
    return [tree, *(holder for value in tree for holder in _holders(value))] if isinstance(tree, list) else []


def hostile_key(rng: random.Random) -> Any:
    """A key that belongs nowhere."""
    return rng.choice([*NAMES, 1, None, True, 2.5, "name", "defaults", "_target_", "_self_", "__class__"])


def yaml_of(tree: Any) -> str:
    """A tree as YAML; `Raw` values stand in it as they are."""
    pieces: list[str] = []

    def plain(value: Any) -> Any:
        if isinstance(value, Raw):
            pieces.append(str(value))
            return f"RAW{len(pieces) - 1}RAW"
        if isinstance(value, dict):
            return {plain(key): plain(inner) for key, inner in value.items()}
        if isinstance(value, list | tuple):
            return [plain(inner) for inner in value]
        return value

    text = yaml.safe_dump(plain(tree), allow_unicode=True, sort_keys=False, width=10**9)
    for number, piece in enumerate(pieces):
        text = text.replace(f"RAW{number}RAW", piece, 1)
    return text


def json_of(tree: Any) -> str:
    """A tree as JSON; what JSON cannot hold becomes text."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {str(key): plain(inner) for key, inner in value.items()}
        return [plain(inner) for inner in value] if isinstance(value, list | tuple) else value

    return json.dumps(plain(tree), default=str, indent=1)


def spoil_text(text: str, rng: random.Random) -> bytes:
    """A text that is cut, spoilt in its bytes, encoded otherwise, or made large."""
    raw = text.encode("utf-8", "surrogatepass")
    how = rng.randrange(12)
    if how == 0:
        return raw[: rng.randrange(len(raw) + 1)]
    if how == 1:
        return text.encode("utf-16", "surrogatepass")
    if how == 2:
        return b"\xef\xbb\xbf" + raw
    if how == 3:
        return raw.replace(b"e", b"\xe4", 1)
    if how == 4:
        return b"\x00" + raw
    if how == 5:
        return b""
    if how == 6:
        return raw + b"\n" + rng.randbytes(50)
    if how == 7:
        return raw.replace(b":", b":\t", 1)
    if how == 8:
        return raw + b"\n# " + b"x" * 17_000_000
    if how == 9:
        return raw * 2
    return spoil_bytes(raw, rng)


def spoil_yaml(tree: Any, rng: random.Random, *, bombs: bool = True) -> bytes:
    """A YAML file with a spoilt tree, spoilt text, or, if ``bombs``, something that explodes in it."""
    how = rng.random()
    if how < 0.62:
        return yaml_of(spoil_tree(tree, rng, yaml_text=True)).encode("utf-8", "surrogatepass")
    if bombs and how < 0.72 and isinstance(tree, dict):
        bomb, text = rng.choice([alias_bomb, merge_bomb])(rng), yaml_of(tree)
        return (bomb + text if rng.random() < 0.5 else text + bomb).encode()
    if how < 0.78:
        return yaml_of(hostile(rng, True)).encode("utf-8", "surrogatepass")
    return spoil_text(yaml_of(tree), rng)


def spoil_json(tree: Any, rng: random.Random) -> bytes:
    """A JSON file with a spoilt tree, spoilt text, or something too deep in it."""
    how = rng.random()
    if how < 0.6:
        return json_of(spoil_tree(tree, rng)).encode("utf-8", "surrogatepass")
    if how < 0.7:
        piece = rng.choice(
            ["[" * 100_000, '{"a": ' * 90 + "1" + "}" * 90, "1" * 5000, "NaN", "1e999", '"\\ud800"', "null", "3", "[]", '"a"']
        )
        return piece.encode()
    return spoil_text(json_of(tree), rng)
