"""Hostile values, names and texts, and ways to spoil bytes and trees of plain values."""

import copy
import json
import math
from datetime import date

import yaml

from fuzz.case import CANARY

CALL = f"__import__('os').system('touch {CANARY}')"
NAMES = (
    "../../../evil", "../../../../../../evil", "a/b/c", "..", ".", "", " ", "-rf", "--help",
    ".hidden", "a\x1b[2Jb", "a\nerror: b", "\u202eevil", "ä ö ü 😀", "x" * 300, "x" * 5000, "con",
    "a*b?[c]", "~root", f"$(touch {CANARY})", f"; touch {CANARY}", "<script>alert(1)</script>",
    "[red]x[/red]", "[/]", "%s%n%x", "{0}", "${root}", "a=b", "a,b", "a\tb",
    ".writing-1-aaaaaaaa-x", "a\x00b", "\ud8ff",
)  # fmt: skip
"""Names that no file system, terminal, shell or page should take as they are.

The last two not even Python's own functions.
"""
WRITABLE_NAMES = NAMES[:-2]
SCALARS = (
    None, True, False, 0, 1, -1, 2**31, 2**63, 10**400, -(10**18), 0.5, -0.0, 1e-320, 1e300,
    math.inf, -math.inf, math.nan, "", "null", "1e400", "7", "x" * 100_000, "${nothing.there}",
    "${oc.env:HOME}", "${.}", "???", CALL, "os.system", [], {}, [[]], [None], {"": None},
    {"a": {"b": {"c": [1, {"d": 2}]}}}, [1, "a", None, 2.5], {1: 2, None: 3, False: 4},
    date(2020, 1, 1), b"\xff\xfe", *NAMES,
)  # fmt: skip
"""Values that belong nowhere in particular."""


class Raw(str):
    """Text that goes into a YAML file as it is."""


RAW = (
    f"!!python/object/apply:os.system ['touch {CANARY}']",
    f"!!python/object/new:os.system ['touch {CANARY}']", "!!python/name:os.system",
    "!!python/module:antigravity", "!!python/tuple [1, 2]", "!unknown {a: 1}", "!!binary '%%%'",
    "!!set {a, b}", "!!omap [a: 1]", "!!timestamp not-a-time", "!!int x", "!!float x",
    "&self [*self]", "&map {a: *map}", "*nowhere", "1e400", "0o777", "1_000", "12:30:45",
    "2020-13-45", "{<<: 3}", "{<<: [*x, 4]}", "{a: 1, a: 2}", "{? [a, b] : c}", "'unfinished",
    "[1, 2", "|\n  a\n b", "\t- a", "@at", "%percent", "[" * 100 + "]" * 100,
    "[" * 5000 + "]" * 5000, "{a: " * 70 + "1" + "}" * 70, "9" * 5000, "0." + "1" * 100_000,
)  # fmt: skip
"""Pieces of YAML that a reader may stumble over."""
JSON = (
    "[" * 100_000,
    '{"a": ' * 90 + "1" + "}" * 90,
    "1" * 5000,
    "NaN",
    "1e999",
    '"\\ud800"',
    "null",
    "3",
    "[]",
    '"a"',
)


def spoil_bytes(content, rng):
    """Flip, cut, repeat, overwrite or insert, once or a few times: anywhere, near the head or near
    the end.
    """
    data = bytearray(content)
    region = rng.choice(["anywhere", "anywhere", "head", "end"])
    for _ in range(rng.choice([1, 1, 1, 2, 3, 8])):
        size = len(data)
        if not size:
            break
        near = size if region == "anywhere" else min(size, 500)
        at = (size - near if region == "end" else 0) + rng.randrange(near)
        length = rng.choice([1, 2, 4, 8, 16, 100, 1000])
        kind = rng.randrange(7)
        if kind == 0:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del data[at:]
        elif kind == 2:
            del data[at : at + length]
        elif kind == 3:
            data[at:at] = rng.randbytes(length)
        elif kind == 4:
            data[at : at + length] = rng.choice([b"\0", b"\xff"]) * min(length, size - at)
        elif kind == 5:
            data[at:at] = data[at : at + length] * rng.choice([1, 2, 50])
        else:
            number = rng.choice([0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1])
            width = rng.choice([2, 4, 8])
            data[at : at + width] = (number % 2 ** (8 * width)).to_bytes(
                width, rng.choice(["little", "big"])
            )
    return bytes(data)


def hostile(rng, yaml_text=False):
    """A value that belongs nowhere."""
    return (
        Raw(rng.choice(RAW))
        if yaml_text and rng.random() < 0.3
        else copy.deepcopy(rng.choice(SCALARS))
    )


def spoil_tree(tree, rng, yaml_text=False):
    """Replace, remove, rename, wrap or repeat values anywhere in a tree of plain values, once or a
    few times.
    """
    tree = copy.deepcopy(tree)
    for _ in range(rng.choice([1, 1, 1, 2, 4])):
        holders = [holder for holder in _holders(tree) if holder]
        if not holders:
            return hostile(rng, yaml_text)
        holder = rng.choice(holders)
        key = rng.choice(list(holder)) if isinstance(holder, dict) else rng.randrange(len(holder))
        kind = rng.randrange(9)
        if kind == 0:
            del holder[key]
        elif kind == 1 and isinstance(holder, dict):
            holder[rng.choice([*NAMES, 1, None, True, f"{key}x", "defaults", "_target_"])] = (
                holder.pop(key)
            )
        elif kind == 1:
            holder.extend(copy.deepcopy(holder[key]) for _ in range(rng.choice([1, 100, 5000])))
        elif kind == 2:
            for _ in range(rng.choice([1, 1, 70, 150])):
                holder[key] = rng.choice([[holder[key]], {"a": holder[key]}])
        elif kind == 3 and isinstance(holder[key], int | float):
            holder[key] = rng.choice([-1, 0, 1e-9, 1e9, 1e18, 10]) * holder[key]
        elif kind == 4:
            holder[key] = str(holder[key])
        else:
            holder[key] = hostile(rng, yaml_text)
    return tree


def _holders(tree):
    """Every mapping and list of a tree."""
    inner = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ()
    return (
        [tree, *(holder for value in inner for holder in _holders(value))]
        if isinstance(tree, dict | list)
        else []
    )


def spoil_items(tree, rng):
    """A tree spoilt besides its defaults, which stay; of one key alone, or of all."""
    items = {key: value for key, value in tree.items() if key != "defaults"}
    key = rng.choice([*items, ""])
    spoilt = spoil_tree({key: items[key]} if key else items, rng)
    return {**tree, **spoilt} if isinstance(spoilt, dict) else dict(tree)


def yaml_of(tree):
    """A tree as YAML; `Raw` values stand in it as they are."""
    pieces = []

    def plain(value):
        if isinstance(value, Raw):
            pieces.append(str(value))
            return f"RAW{len(pieces) - 1}RAW"
        if isinstance(value, dict):
            return {plain(key): plain(inner) for key, inner in value.items()}
        return [plain(inner) for inner in value] if isinstance(value, list | tuple) else value

    text = yaml.safe_dump(plain(tree), allow_unicode=True, sort_keys=False, width=10**9)
    for number, piece in enumerate(pieces):
        text = text.replace(f"RAW{number}RAW", piece, 1)
    return text


def json_of(tree):
    """A tree as JSON; what JSON cannot hold becomes text."""

    def plain(value):
        if isinstance(value, dict):
            return {str(key): plain(inner) for key, inner in value.items()}
        return [plain(inner) for inner in value] if isinstance(value, list | tuple) else value

    return json.dumps(plain(tree), default=str, indent=1)


def spoil_text(text, rng):
    """A text that is cut, spoilt in its bytes, encoded otherwise, or made large."""
    raw = text.encode("utf-8", "surrogatepass")
    ways = [
        lambda: text.encode("utf-16", "surrogatepass"),
        lambda: b"\xef\xbb\xbf" + raw,
        lambda: raw.replace(b"e", b"\xe4", 1),
        lambda: b"\x00" + raw,
        lambda: b"",
        lambda: raw.replace(b":", b":\t", 1),
        lambda: raw + b"\n# " + b"x" * 17_000_000,
        lambda: raw * 2,
        *[lambda: spoil_bytes(raw, rng)] * 4,
    ]
    return rng.choice(ways)()


def _bomb(rng):
    """A few hundred bytes of YAML whose aliases or merged mappings would unfold to 10¹² values, or
    some such number.
    """
    if rng.random() < 0.5:
        lines = ["m0: &m0 {a: 1, b: 2}"]
        lines += [
            f"m{k}: &m{k} {{<<: [{', '.join([f'*m{k - 1}'] * 8)}], k{k}: *m{k - 1}}}"
            for k in range(1, rng.choice([6, 12, 25]))
        ]
    else:
        width, depth = rng.choice([(10, 12), (2, 40), (100, 6), (9, 9)])
        lines = [f"b0: &b0 [{', '.join(['x'] * width)}]"]
        lines += [f"b{k}: &b{k} [{', '.join([f'*b{k - 1}'] * width)}]" for k in range(1, depth)]
    return "\n".join(lines) + "\n"


def spoil_yaml(tree, rng, *, bombs=True):
    """A YAML file with a spoilt tree, spoilt text, or, if ``bombs``, a value that explodes."""
    draw = rng.random()
    if draw < 0.6:
        return yaml_of(spoil_tree(tree, rng, yaml_text=True)).encode("utf-8", "surrogatepass")
    if bombs and draw < 0.7 and isinstance(tree, dict):
        return "".join(rng.sample([_bomb(rng), yaml_of(tree)], 2)).encode()
    if draw < 0.77:
        return yaml_of(hostile(rng, True)).encode("utf-8", "surrogatepass")
    return spoil_text(yaml_of(tree), rng)


def spoil_json(content, rng):
    """A JSON file with a spoilt tree, spoilt text, or something too deep in it."""
    draw = rng.random()
    tree = json.loads(content)
    if draw < 0.6:
        return json_of(spoil_tree(tree, rng)).encode("utf-8", "surrogatepass")
    return rng.choice(JSON).encode() if draw < 0.7 else spoil_text(json_of(tree), rng)
