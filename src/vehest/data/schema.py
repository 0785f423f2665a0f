"""Validates plain values, as files hold them, against the dataclasses that describe them.

Types are strict: a number is not taken from text, nor a truth value from a number, nor a whole
number from one with a point. Keys that the dataclass does not have are refused; one that takes
further keys has ``__pydantic_config__ = FURTHER_KEYS``. In ``Annotated[float, "a number up to 5"]``
the text replaces what messages say of the type.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from vehest.data.errors import ConfigurationError, DataError, VehestError, suggestion

Schema = TypeVar("Schema")  # dataclass that is built

# configuration of pydantic for dataclasses that take further keys
FURTHER_KEYS = ConfigDict(
    extra="ignore", strict=True, allow_inf_nan=False, arbitrary_types_allowed=True
)
MAX_DEPTH = 60  # levels that plain values may nest
MAX_INTEGER = 10**300  # largest magnitude of a whole number


def validated(
    kind: type[Schema],
    content: Any,
    subject: str,
    *,
    error: type[VehestError] = DataError,
    group: str = "",
) -> Schema:
    """Build a dataclass from plain values: mappings, lists, text, numbers, truth values, nothing.

    Parameters
    ----------
    kind : type[Schema]
        Dataclass, which may hold others; its ``__post_init__`` may raise a `VehestError` or
        ``ValueError``.
    subject : str
        First words of a message, ``"'model.yaml'"``; may be empty.
    group : str
        That the keys belong to, ``training`` for ``training.patience``; may be empty.

    Raises
    ------
    DataError
        Or ``error``: a key is missing, unknown or of the wrong type, or a value makes no sense.
    """
    above = [group] if group else []
    try:
        content = _plain(content, above)
        return cast(Schema, _validated(kind, content))
    except ValidationError as problem:
        message = _in_words(problem, kind, content, above)
    except ValueError as problem:  # of content that is not plain
        message = str(problem)
    raise error(f"{subject}: {message}" if subject else message)


def settings_from_config(kind: type[Schema], config: Any, group: str) -> Schema:
    """Settings from plain values, without the ``name`` that a choice of conf/ has, also in groups
    in them.

    Parameters
    ----------
    kind : type
        Dataclass of the settings.
    config : mapping
        Values by field.
    group : str
        Group of the configuration, for messages that say how a value is set.

    Raises
    ------
    ConfigurationError
        A value is missing, unknown or wrong.
    """
    return validated(kind, _without_names(config, kind), "", error=ConfigurationError, group=group)


def _without_names(content: Any, kind: Any) -> Any:
    """Content without the key ``name``, at any depth, where the dataclass that it becomes has no
    such field.
    """
    kind, _ = _bare(kind)
    if not (isinstance(content, dict) and isinstance(kind, type) and is_dataclass(kind)):
        return content
    hints = _field_types(kind)
    return {
        key: _without_names(inner, hints.get(str(key)))
        for key, inner in content.items()
        if key != "name" or "name" in hints
    }


def check_format(version: Any, newest: int, subject: str, *, oldest: int = 1) -> int:
    """The version of a file's layout, as the file states it.

    Parameters
    ----------
    version : object
        What the file states, of any type.
    newest : int
        Newest version that this code reads.
    subject : str
        The file, for messages.
    oldest : int
        Oldest one.

    Raises
    ------
    DataError
        It is no whole number, or none between ``oldest`` and ``newest``.
    """
    if isinstance(version, bool) or not isinstance(version, int) or version < 0:
        raise DataError(f"{subject}: format must be a whole number, not {str(version)[:40]!r}")
    if version > newest:
        raise DataError(
            f"{subject} was written by a newer vehest (format {str(version)[:20]}, this one knows "
            f"{newest}); update vehest"
        )
    if version < oldest:
        raise DataError(
            f"{subject} was written by an older vehest (format {version}, this one reads {oldest} "
            f"to {newest}); make it again"
        )
    return version


@cache
def _field_types(kind: type) -> dict[str, Any]:
    """Fields of a dataclass -> their types."""
    return get_type_hints(kind)


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    """Validator of pydantic for lists of a dataclass; a list, since pydantic takes a configuration
    for what holds a dataclass, not for the dataclass itself.
    """
    return TypeAdapter(list[kind], config={**FURTHER_KEYS, "extra": "forbid"})


def _plain(value: Any, path: list[str]) -> Any:
    """Content with text as keys and lists for tuples.

    A ValueError where a value is not plain, such as a date, or it nests too deep.
    """
    if len(path) > MAX_DEPTH:
        raise ValueError(f"{path[0]} nests deeper than {MAX_DEPTH} levels")
    if isinstance(value, dict):
        return {str(key): _plain(inner, [*path, str(key)]) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner, [*path, str(position)]) for position, inner in enumerate(value)]
    if (
        value is None
        or isinstance(value, str | bool | float)
        or (isinstance(value, int) and abs(value) < MAX_INTEGER)
    ):
        return value
    problem = (
        "a whole number of more than 300 digits"
        if isinstance(value, int)
        else f"no plain value but a {type(value).__name__}"
    )
    raise ValueError(
        f"{'.'.join(path) or 'it'} is {problem}, {_shortened(value)}; put it in quotes if it is "
        "text"
    )


# Bytes of file names that are not UTF-8 are lone surrogates in text (PEP 383), which JSON cannot
# hold: characters of plane 16,
# which is for private use, replace them while content is validated.
_SURROGATE = re.compile("[\ud800-\udfff]")
# code of a lone surrogate -> code that replaces it during validation
_REPLACED = {code: code + 0x100000 for code in range(0xD800, 0xE000)}
_RESTORED = {new: old for old, new in _REPLACED.items()}  # the inverse of `_REPLACED`


def _validated(kind: Any, content: Any) -> Any:
    """An instance of ``kind`` by pydantic, from JSON.

    Lone surrogates, which JSON cannot hold, are replaced meanwhile.
    """
    text = json.dumps([content], ensure_ascii=False)
    replaced = text.translate(_REPLACED) if _SURROGATE.search(text) else text
    (instance,) = _adapter(kind).validate_json(replaced)
    return instance if replaced is text else _with_surrogates(instance)


def _with_surrogates(value: Any) -> Any:
    """The same value with its surrogates restored, in keys, lists and dataclasses too."""
    if isinstance(value, str):
        return value.translate(_RESTORED)
    if isinstance(value, dict):
        return {_with_surrogates(key): _with_surrogates(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_with_surrogates(inner) for inner in value)
    if is_dataclass(value):
        for attribute in fields(value):
            object.__setattr__(
                value, attribute.name, _with_surrogates(getattr(value, attribute.name))
            )
    return value


# type of an error of pydantic -> what a message says was expected
_TYPE_WORDS = {
    "int_type": "a whole number",
    "float_type": "a number",
    "finite_number": "a number",
    "bool_type": "true or false",
    "string_type": "text",
    "list_type": "a list",
    "tuple_type": "a list",
    "frozen_set_type": "a list",
    "dict_type": "a mapping",
    "dataclass_type": "a group of options",
}


def _in_words(problem: ValidationError, kind: type[Any], content: Any, group: list[str]) -> str:
    """One line on the first error of pydantic, with the other choices of its union."""
    errors = problem.errors(include_url=False)
    error = errors[0]
    loc = errors[0]["loc"]
    value = _shortened(errors[0]["input"])
    path = [*_path(loc, [content])[1:], *(loc[-1:] if error["type"] == "missing" else ())]
    name = ".".join(str(part) for part in [*group, *path]) or "it"
    match error["type"]:
        case "missing":
            return f"{name} is missing"
        case "unexpected_keyword_argument":
            beside = name.rpartition(".")[0]
            option_names = _keys_of(_type_at(kind, path[:-1]))
            *_, key = name.split(".")
            meant = suggestion(key, option_names.split(", "), f"{beside}." if beside else "")
            if beside:
                return f"{name} is not an option of {beside}{meant or ';'} options: {option_names}"
            return f"unknown key '{name}'{meant or ';'} there are: {option_names}"
        case "literal_error":
            choices = error["ctx"]["expected"].replace("'", "").replace(" or ", ", ")
            return f"{name} '{error['input']}' is not one of: {choices}"
        case "value_error":
            return f"{name}: {error['ctx']['error']}"
        case other if other not in _TYPE_WORDS:
            return f"{name}: {error['msg'][:1].lower()}{error['msg'][1:]}, not {value}"
    annotated = _type_at(kind, path)
    is_choice = len(loc) > len(path) + 1
    kinds = (
        [entry["type"] for entry in errors if entry["loc"][:-1] == loc[:-1]]
        if is_choice
        else [error["type"]]
    )
    expected = _bare(annotated)[1] or " or ".join(
        dict.fromkeys(_TYPE_WORDS[entry] for entry in kinds if entry in _TYPE_WORDS)
    )
    options = f"; options: {keys}" if (keys := _keys_of(annotated)) else ""
    return f"{name} must be {expected}, not {value}{options}"


def _shortened(value: Any) -> str:
    """Text of a value for a message, cut off after 80 characters."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:80]} …"


def _path(loc: Sequence[str | int], content: Any) -> list[str | int]:
    """Keys and indices of one of pydantic's locations, which also name choices of unions, as far as
    the content has them.
    """
    path: list[str | int] = []
    for part in loc:
        is_item = isinstance(content, list) and isinstance(part, int) and part < len(content)
        if is_item or (isinstance(content, dict) and part in content):
            path.append(part)
            content = content[part]
    return path


def _keys_of(kind: Any) -> str:
    """Fields of a dataclass that may be given, for messages; empty for any other type."""
    bare, _ = _bare(kind)
    return (
        ", ".join(field.name for field in fields(bare) if field.init) if is_dataclass(bare) else ""
    )


def _type_at(kind: Any, path: Sequence[str | int]) -> Any:
    """Annotated type at a path inside a value of some type; None where it is not known."""
    for part in path:
        bare, _ = _bare(kind)
        if is_dataclass(bare):
            kind = get_type_hints(bare, include_extras=True).get(str(part))
        else:
            kind = next(
                (inner for inner in reversed(get_args(bare)) if inner is not Ellipsis), None
            )
    return kind


def _bare(kind: Any) -> tuple[Any, str]:
    """A type without annotations, of a union the first choice, and the text of the annotations."""
    text = next(
        (entry for entry in getattr(kind, "__metadata__", ()) if isinstance(entry, str)), ""
    )
    if get_origin(kind) not in (Annotated, Union, UnionType):
        return kind, ""
    bare, inner = _bare(get_args(kind)[0])
    return bare, text or inner
