"""Plain values, as files hold them, to the dataclasses that say what they may be: the one validator of everything that is read.

A schema is a dataclass. Types are meant strictly: a number is not taken from text, nor a truth value from a number; only a whole
number may be written with a point. Keys that the dataclass does not have are refused; one that takes further keys says so with
``__pydantic_config__ = FURTHER_KEYS``. What a message says is wanted follows from the type; ``Annotated[float, "a number up to 5"]``
says more.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cache
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from vehest.data.errors import ConfigurationError, DataError, VehestError
from vehest.data.limits import current_limits

Schema = TypeVar("Schema")

KNOWN_KEYS = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, arbitrary_types_allowed=True)
FURTHER_KEYS = ConfigDict(extra="ignore", strict=True, allow_inf_nan=False, arbitrary_types_allowed=True)

GROUP = "a group of options"


def validated(kind: type[Schema], content: Any, where: str, *, error: type[VehestError] = DataError, group: str = "") -> Schema:
    """Build a dataclass from plain values.

    Args:
        kind: dataclass, which may hold others; its ``__post_init__`` may raise a `VehestError` or ``ValueError``.
        content: what a file held: mappings, lists, text, numbers, truth values, nothing.
        where: what is named first in a message, ``"'model.yaml'"``; may be empty.
        error: what to raise.
        group: what the keys belong to, ``training`` for ``training.patience``; may be empty.

    Raises:
        DataError: a key is missing, unknown or of the wrong type, or a value makes no sense (or ``error``).
    """
    start = f"{where}: " if where else ""
    odd = _not_plain(content, [group] if group else [])
    if odd is not None:
        raise error(f"{start}{odd}")
    try:
        return cast(Schema, _validated(_adapter(cast(Any, kind)), _with_text_keys(content)))
    except ValidationError as problem:
        first = problem.errors(include_url=False)[0]
        path = [str(part) for part in first["loc"] if not _is_tag(part)]
        raise error(f"{start}{_in_words(first, path, kind, group)}") from None


def settings_from_config(kind: type[Schema], config: Any, group: str) -> Schema:
    """Settings of an estimator or a training from plain values; ``name``, which says whose they are, is left aside, also in groups in them.

    Raises:
        ConfigurationError: an unknown key, a value of the wrong type, or one that makes no sense.
    """
    if not isinstance(config, dict):
        config = dict(config) if hasattr(config, "keys") else config
    content = {key: value for key, value in config.items() if key != "name"} if isinstance(config, dict) else config
    return validated(kind, _without_names(content, kind), "", error=ConfigurationError, group=group)


def _without_names(content: Any, kind: Any) -> Any:
    """Plain values without the ``name`` of a group, as a choice of conf/training has it, where its dataclass knows none."""
    plain = _plain(kind)
    if not (isinstance(content, dict) and is_dataclass(plain)):
        return content
    hints = get_type_hints(plain, include_extras=True)
    return {key: _without_names(inner, hints.get(str(key))) for key, inner in content.items() if key != "name" or "name" in hints}


def check_format(found: Any, newest: int, where: str, *, oldest: int = 1) -> int:
    """See that a file's layout is one that is known.

    Args:
        found: the version that the file states.
        newest: the version that is written now.
        where: the file, for messages.
        oldest: the oldest one that can still be read.

    Returns:
        The version.

    Raises:
        DataError: it is no version, a newer one, or one that is no longer read.
    """
    if isinstance(found, bool) or not isinstance(found, int) or found < 0:
        raise DataError(f"{where}: format must be a whole number, not {str(found)[:40]!r}")
    if found > newest:
        raise DataError(f"{where} was written by a newer vehest (format {str(found)[:20]}, this one knows {newest}); update vehest")
    if found < oldest:
        raise DataError(f"{where} was written by an older vehest (format {found}, this one reads {oldest} to {newest}); make it again")
    return found


@cache
def _adapter(kind: type[Any]) -> TypeAdapter[Any]:
    for own in _dataclasses_in(kind):
        if "__pydantic_config__" not in vars(own):
            inherited = getattr(own, "__pydantic_config__", KNOWN_KEYS)
            own.__pydantic_config__ = inherited
    return TypeAdapter(kind)


def _dataclasses_in(kind: Any) -> list[type[Any]]:
    """A dataclass and those that its fields are of."""
    if get_origin(kind) is not None or get_args(kind):
        return [found for inner in get_args(kind) for found in _dataclasses_in(inner)]
    if not (isinstance(kind, type) and is_dataclass(kind)):
        return []
    hints = get_type_hints(kind)
    return [kind, *(found for field in fields(kind) for found in _dataclasses_in(hints[field.name]))]


def _validated(adapter: TypeAdapter[Any], content: Any) -> Any:
    """Validate; whole numbers that are written with a point are taken for what they are where whole numbers belong, and nowhere else."""
    text = json.dumps(content)
    if "\\ud" in text and _SURROGATES.search(json.dumps(content, ensure_ascii=False)):
        return _with_strings(_validated(adapter, _with_strings(content, _stand_in)), _stood_for)
    try:
        return adapter.validate_json(text)
    except ValidationError as problem:
        whole = [
            found["loc"]
            for found in problem.errors(include_url=False)
            if found["type"] in {"int_type", "int_from_float", "literal_error"} and _is_whole(found.get("input"))
        ]
        if not whole:
            raise
    for path in whole:
        content = _with_whole_number(content, [part for part in path if not _is_tag(part)])
    return adapter.validate_json(json.dumps(content))


# Bytes of file names that are not UTF-8 stand as lone surrogates in text (PEP 383), which no JSON holds: characters of plane 16,
# which is for private use, stand in for them while content is validated.
_SURROGATES = re.compile("[\ud800-\udfff]")
_STAND_INS = re.compile("[\U0010d800-\U0010dfff]")


def _stand_in(text: str) -> str:
    return _SURROGATES.sub(lambda found: chr(ord(found[0]) + 0x100000), text)


def _stood_for(text: str) -> str:
    return _STAND_INS.sub(lambda found: chr(ord(found[0]) - 0x100000), text)


def _with_strings(value: Any, change: Callable[[str], str]) -> Any:
    """The same value with every text in it changed: those of keys, lists and dataclasses too."""
    if isinstance(value, str):
        return change(value)
    if isinstance(value, dict):
        return {_with_strings(key, change): _with_strings(inner, change) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_with_strings(inner, change) for inner in value)
    if is_dataclass(value) and not isinstance(value, type):
        for own in fields(value):
            object.__setattr__(value, own.name, _with_strings(getattr(value, own.name), change))
    return value


def _is_whole(value: Any) -> bool:
    return isinstance(value, float) and value.is_integer() and abs(value) < 2**53


def _with_whole_number(content: Any, path: list[Any]) -> Any:
    """The same content with a whole number at a place."""
    if not path:
        return int(content) if _is_whole(content) else content
    if isinstance(content, dict) and path[0] in content:
        return {**content, path[0]: _with_whole_number(content[path[0]], path[1:])}
    if isinstance(content, list) and isinstance(path[0], int) and path[0] < len(content):
        return [*content[: path[0]], _with_whole_number(content[path[0]], path[1:]), *content[path[0] + 1 :]]
    return content


def _not_plain(value: Any, path: list[str]) -> str | None:
    """What in a file's content is no plain value, such as a date, as a sentence; nothing if all of it is."""
    if len(path) > current_limits().depth:
        return f"{path[0]} nests deeper than {current_limits().depth} levels"
    if isinstance(value, dict | list | tuple):
        entries = value.items() if isinstance(value, dict) else enumerate(value)
        return next((odd for key, inner in entries if (odd := _not_plain(inner, [*path, str(key)])) is not None), None)
    if value is None or isinstance(value, str | bool | float) or (isinstance(value, int) and abs(value) < _MOST):
        return None
    name, kind = ".".join(path) or "it", type(value).__name__
    shown = "is a whole number of more than 300 digits" if isinstance(value, int) else f"is no plain value but a {kind}, {str(value)[:60]}"
    return f"{name} {shown}; put it in quotes if it is text"


_MOST = 10**300


def _with_text_keys(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _with_text_keys(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_with_text_keys(inner) for inner in value]
    return value


def _is_tag(part: Any) -> bool:
    """Whether a part of a location names one choice of a union rather than a key."""
    return isinstance(part, str) and part in {"float", "int", "str", "bool", "none", "nullable"}


_KINDS = {
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "int_parsing_size": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "finite_number": "a number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "string_type": "text",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "a mapping",
    "dataclass_type": GROUP,
    "dataclass_exact_type": GROUP,
}


def _in_words(problem: Any, path: list[str], kind: type[Any], group: str) -> str:
    keys, value = [*([group] if group else []), *path], problem.get("input")
    name = ".".join(keys) or "it"
    if problem["type"] == "missing":
        return f"{name} is missing"
    if problem["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
        beside, known = ".".join(keys[:-1]), _keys_of(_type_at(kind, path[:-1])) or "none"
        return f"{name} is not an option of {beside}; options: {known}" if beside else f"unknown key '{name}'; there are: {known}"
    shown = repr(value) if not isinstance(value, dict | list) or len(repr(value)) < 80 else f"{repr(value)[:80]} …"
    if problem["type"] == "literal_error":
        choices = problem["ctx"]["expected"].replace("'", "").replace(" or ", ", ")
        return f"{name} '{value}' is not one of: {choices}"
    if problem["type"] in _KINDS:
        wanted = _type_at(kind, path)
        options = f"; options: {keys_of}" if (keys_of := _keys_of(wanted)) else ""
        return f"{name} must be {_wanted(wanted) or _KINDS[problem['type']]}, not {shown}{options}"
    if problem["type"] in ("value_error", "assertion_error"):
        return f"{name}: {problem['ctx']['error']}"
    return f"{name}: {problem['msg'][:1].lower()}{problem['msg'][1:]}, not {shown}"


def _keys_of(kind: Any) -> str:
    plain = _plain(kind)
    return ", ".join(field.name for field in fields(plain) if field.init) if is_dataclass(plain) else ""


def _type_at(kind: Any, path: list[str]) -> Any:
    """Type of what stands at a path inside a value of some type; None where that cannot be told."""
    for part in path:
        plain = _plain(kind)
        held = get_args(plain) if get_origin(plain) in (tuple, list, dict, frozenset) else ()
        if is_dataclass(plain):
            kind = get_type_hints(plain, include_extras=True).get(part)
        elif get_origin(plain) is tuple and Ellipsis not in held:
            kind = held[int(part)] if part.isdecimal() and int(part) < len(held) else None
        else:
            kind = next((inner for inner in reversed(held) if inner is not Ellipsis), None)
    return kind


def _plain(kind: Any) -> Any:
    """A type without what is said about it, and the other type of an optional one."""
    if get_origin(kind) is Annotated:
        return _plain(get_args(kind)[0])
    others = _others(kind)
    return _plain(others[0]) if len(others) == 1 else kind


def _others(kind: Any) -> list[Any]:
    """Types of a union other than None; nothing where it is none."""
    return [inner for inner in get_args(kind) if inner is not type(None)] if get_origin(kind) in (Union, UnionType) else []


_NAMES = {str: ("text", "text"), int: ("a whole number", "whole numbers"), float: ("a number", "numbers"), bool: ("true or false", "")}


def _wanted(kind: Any, *, many: bool = False) -> str:
    """What a type takes, one value of it or many, in words; nothing where there are none."""
    origin, inner, others = get_origin(kind), get_args(kind), _others(kind)
    if origin is Annotated:
        said = next((own for own in inner[1:] if isinstance(own, str) and not many), None)
        return said or _wanted(inner[0], many=many)
    if len(others) == 1:
        return _wanted(others[0], many=many)
    if others:
        words = [_wanted(other) for other in others if other is not int or float not in others]
        return "" if many else " or ".join(word for word in words if word)
    if is_dataclass(kind):
        return "mappings" if many else GROUP
    if origin in (tuple, list, frozenset):
        held = _wanted(inner[0], many=True) if inner else ""
        return ("lists" if many else "a list") + (f" of {held}" if held else "")
    if origin is dict:
        return "mappings" if many else "a mapping"
    return _NAMES.get(kind, ("", ""))[many]
