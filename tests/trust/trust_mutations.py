"""Deterministic mutations of a valid trust.yaml, for every kind of damage that a file can have."""

import copy
import os

import numpy as np
import yaml

VALUES = {
    "null": None,
    "text": "soon",
    "true": True,
    "empty list": [],
    "empty mapping": {},
    "zero": 0.0,
    "negative": -1.0,
    "whole number": 3,
    "tiny": 1e-300,
    "huge": 1e300,
    "minus huge": -1e300,
    "very long": 10**290,
    "nan": float("nan"),
    "inf": float("inf"),
    "foreign name": "wheel_speed_rr",
    "unknown name": "speed_of_light",
}


def paths(content, path=(), depth=6):
    """Paths of all values in nested mappings and lists; of a list the first two and the last."""
    if path:
        yield path
    if depth == 0:
        return
    if isinstance(content, dict):
        for key, inner in content.items():
            yield from paths(inner, (*path, key), depth - 1)
    elif isinstance(content, list):
        for position in sorted({0, 1, len(content) - 1} & set(range(len(content)))):
            yield from paths(content[position], (*path, position), depth - 1)


def at(content, path):
    """The value at a path."""
    for part in path:
        content = content[part]
    return content


def changed(content, path, way):
    """A copy with one value dropped, lengthened, shortened, reversed or replaced."""
    content = copy.deepcopy(content)
    holder = at(content, path[:-1])
    value = holder[path[-1]]
    if way == "drop":
        del holder[path[-1]]
    elif way == "duplicate" and isinstance(value, list):
        holder[path[-1]] = value + value
    elif way == "60 more" and isinstance(value, list):
        holder[path[-1]] = value + [value[-1] if value else "vx"] * 60
    elif way == "one less" and isinstance(value, list):
        holder[path[-1]] = value[:-1]
    elif way == "reverse" and isinstance(value, list):
        holder[path[-1]] = value[::-1]
    elif way == "further key" and isinstance(value, dict):
        value["ay" if "vx" in value else "further"] = 1.0
    elif way in VALUES:
        holder[path[-1]] = copy.deepcopy(VALUES[way])
    else:
        return None
    return content


def mutations(text, number):
    """``number`` mutations of a file's text, name -> text."""
    content = yaml.safe_load(text)
    ways = ["drop", "duplicate", "60 more", "one less", "reverse", "further key", *VALUES]
    value_paths = list(paths(content))
    generator = np.random.default_rng(0)
    lengthened = [("bands", "channels"), ("health", "channels"), ("health", "limits")]
    drawn = [(path, way) for path in lengthened for way in ways[:5]]
    drawn += [(("guard", "largest_tan_sideslip"), way) for way in ("huge", "minus huge", "zero")]
    drawn += [(("guard", "top_speed"), way) for way in ("huge", "minus huge", "zero")]
    drawn = [(path, way) for path, way in drawn if path in value_paths]
    texts = {}
    while len(texts) < number:
        path, way = (
            drawn.pop()
            if drawn
            else (
                value_paths[generator.integers(len(value_paths))],
                ways[generator.integers(len(ways))],
            )
        )
        mutated = changed(content, path, way)
        if mutated is not None and mutated != content:
            name = f"{'.'.join(map(str, path))}: {way}"
            texts[name] = yaml.safe_dump(mutated, sort_keys=False)
    for share in (0.0, 0.1, 0.3, 0.5, 0.9, 0.999):
        texts[f"cut at {share:g}"] = text[: int(share * len(text))]
    texts |= {
        "format 0": text.replace("format: 1", "format: 0", 1),
        "format 2": text.replace("format: 1", "format: 2", 1),
        "a list": "- 1\n",
        "text": "trust me",
        "aliases": "a: &a [1]\nb: *a\n",
        "tabs": "format:\t1\n\tabout: {}\n",
        "other estimator": text.replace("estimator: ksnn", "estimator: gru", 1),
    }
    return texts


PLACED = ("pipe", "folder", "link to nothing", "link to a device", "link to the file", "binary")


def place(kind, path, text):
    """Put something else than a text file at a path."""
    match kind:
        case "pipe":
            os.mkfifo(path)
        case "folder":
            path.mkdir()
        case "link to nothing":
            path.symlink_to(path.with_name("nothing.yaml"))
        case "link to a device":
            path.symlink_to("/dev/zero")
        case "link to the file":
            aside = path.with_name("elsewhere.yaml")
            aside.write_text(text, encoding="utf-8")
            path.symlink_to(aside)
        case "binary":
            path.write_bytes(bytes(range(256)))
