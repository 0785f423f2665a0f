"""Settings as commented lines of YAML: key, value, text, unit, values and bounds, as the classes
declare them.

dataclass of settings -> `described` -> lines of a file of conf/, or of `vehest config` with the
values of a configuration
"""

from __future__ import annotations

import ast
import inspect
import io
import re
import textwrap
import tokenize
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import Field, dataclass, fields, is_dataclass
from typing import Any

import yaml

from vehest.configuration.composition import Config, as_yaml
from vehest.data.errors import VehestError
from vehest.declared import Declaration, declaration
from vehest.estimators.registry import estimator_class

COMMENT_COLUMN = 45  # column, from 0, at which the comment of a line of YAML begins


@dataclass(frozen=True)
class SettingLine:
    """A setting or a group of settings: its value, its comment, and the settings of a group."""

    value: Any  # value of the setting
    comment: str  # text, unit and bounds
    # name -> line of the settings in a group; None: a single setting
    group: Mapping[str, SettingLine] | None = None


def setting_lines(settings: Any, skipped: Collection[str] = ()) -> dict[str, SettingLine]:
    """Name -> line with the value of each field of a dataclass of settings, but of ``skipped``
    names; groups come last.

    Numbers that a fit determines are listed inside groups alone.
    """
    lines = {}
    groups = {}
    for field in fields(settings):
        declared = declaration(field) or Declaration("")
        value = getattr(settings, field.name)
        if field.name in skipped:
            continue
        if is_dataclass(value):
            groups[field.name] = SettingLine(value, declared.doc, setting_lines(value))
        elif not declared.is_fitted or settings.__class__.__name__ != "settings_type":
            text = declared.doc or _comment_of(type(settings), field.name)
            comment = "; ".join(filter(None, [text + _unit(declared), *_values(field)]))
            lines[field.name] = SettingLine(value, comment)
    return lines | groups


def as_commented_yaml(lines: Mapping[str, SettingLine], indent: str = "") -> Iterator[str]:
    """Lines of YAML for a file of conf/, with ``indent`` before each."""
    for name, line in lines.items():
        if line.group is None:
            yield _line(f"{indent}{name}: {value_as_yaml(line.value)}", line.comment)
        else:
            yield _line(f"{indent}{name}:", line.comment)
            yield from as_commented_yaml(line.group, f"{indent}  ")


def config_as_commented_yaml(config: Config) -> str:
    """YAML of a configuration, in which the settings of estimator and training have the comments of
    conf/.
    """
    comments = {}
    with suppress(VehestError, KeyError):  # no estimator, or a name without a class
        kind = estimator_class(str(config["estimator"]["name"]))
        comments["estimator"] = SettingLine(None, "", setting_lines(kind.settings_type()))
        comments["training"] = SettingLine(None, "", setting_lines(kind.training_type()))
    return "".join(_config_lines(config, comments, ""))


def _config_lines(
    config: Config, comments: Mapping[str, SettingLine], indent: str
) -> Iterator[str]:
    """Lines of a configuration, with comments where a key is a declared setting."""
    for key, value in config.items():
        line = comments.get(key)
        if line is not None and line.group is not None and isinstance(value, dict) and value:
            yield _line(f"{indent}{key}:", line.comment)
            yield from _config_lines(value, line.group, f"{indent}  ")
            continue
        text = textwrap.indent(as_yaml({key: value}), indent)
        if line is not None and isinstance(value, list):
            text = f"{indent}{key}: {value_as_yaml(tuple(value))}\n"
        is_single_line = text.count("\n") == 1
        yield (
            _line(text.rstrip("\n"), line.comment) if line is not None and is_single_line else text
        )


def _line(key: str, comment: str) -> str:
    """A line of YAML with its comment from COMMENT_COLUMN on."""
    return f"{key:<{COMMENT_COLUMN - 1}} # {comment}\n" if comment else f"{key}\n"


def field_comments(described: type) -> dict[str, str]:
    """Comments of the fields of a dataclass: name -> text.

    A field's comment is above its statement, or within the statement or behind it.
    """
    source = textwrap.dedent(inspect.getsource(described))
    comments: dict[int, str] = {}  # by line
    above: dict[int, str] = {}  # the same of those that have their line to themselves
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            line = token.start[0]
            comments[line] = token.string.lstrip("# ")
            if token.line.lstrip().startswith("#"):
                above[line] = (
                    f"{above[line - 1]} {comments[line]}" if line - 1 in above else comments[line]
                )
    lines = source.splitlines()
    (kind,) = ast.parse(source).body
    assert isinstance(kind, ast.ClassDef)
    of_fields = {}
    for node in kind.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            end = node.end_lineno or node.lineno
            is_closed = not lines[end : end + 1] or not lines[end].startswith("    )")
            within = range(node.lineno, end + (1 if is_closed else 2))
            texts = [comments[line] for line in within if line in comments]
            texts = texts or [above[line] for line in [node.lineno - 1] if line in above]
            if texts:
                of_fields[node.target.id] = texts[-1]
    return of_fields


def _comment_of(described: type, name: str) -> str:
    """The comment behind a field of a dataclass that declares no settings, such as the parameters
    of a car.
    """
    for kind in described.__mro__[:-1]:
        if comment := field_comments(kind).get(name):
            return comment
    return ""


def _unit(declared: Declaration) -> str:
    """A unit in brackets, after a blank; empty without one."""
    return f" [{declared.unit}]" if declared.unit else ""


def _values(field: Field[Any]) -> Iterator[str]:
    """Texts of the values or bounds that a setting may have."""
    declared = declaration(field)
    if declared is None:
        return
    choices = (
        re.findall(r"['\"](\w+)['\"]", str(field.type)) if "Literal" in str(field.type) else []
    )
    if choices and not all(choice in declared.doc for choice in choices):
        yield " | ".join(choices)
    bounds = (
        ("at least", declared.least),
        ("more than", 0.0 if declared.positive else declared.above),
        ("at most", declared.most),
        ("less than", declared.below),
    )
    words = [f"{word} {bound:g}" for word, bound in bounds if bound is not None]
    if words:
        yield ", ".join(words)


def value_as_yaml(value: Any) -> str:
    """Text of a value in YAML; whole numbers have no decimal point."""
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
        return str(int(value))
    if isinstance(value, float):
        text = repr(value)
        return text if "e" not in text or "." in text else text.replace("e", ".0e")
    if isinstance(value, tuple):
        return f"[{', '.join(map(value_as_yaml, value))}]"
    text = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True)
    return text.removesuffix("...\n").strip()
