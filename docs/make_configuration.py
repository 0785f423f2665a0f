"""Write the settings in conf/estimator and conf/training as the classes declare them: key, default, text, unit, values and bounds.

The head of a file, up to and including the line of its name, is written by hand: what it is, and what Hydra composes it of. Run by
``make reference``; tests/test_docs.py checks that the files are up to date.
"""

from __future__ import annotations

import ast
import inspect
import io
import re
import textwrap
import tokenize
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import yaml

CONF = Path(__file__).resolve().parents[1] / "conf"
NAME = re.compile(r"^ *name: .*\n", re.MULTILINE)
TRAINING = re.compile(r"override /training: (\w+)")
COMPOSED = re.compile(r"^  - \w+@(\w+)", re.MULTILINE)
DEFAULT_TRAINING = "supervised"
COMMENT_COLUMN = 45
NOT_USED = {"identification": {"curves_from"}}
"""Training -> settings that it inherits and that its estimators do not read."""


def files() -> dict[Path, str]:
    """Every file of conf/estimator and conf/training with settings of a class, by its path: what it should hold."""
    from vehest.estimators.registry import estimator_class

    contents = {}
    for file in sorted((CONF / "estimator").glob("*.yaml")):
        head = _head(file)
        kind = estimator_class(file.stem)
        indent = "  " if "\nestimator:\n" in head else ""
        contents[file] = head + "".join(_lines(kind.settings_type(), indent, set()))
        named = TRAINING.search(head)
        training = CONF / "training" / f"{named[1] if named else DEFAULT_TRAINING}.yaml"
        contents[training] = _training(training, kind.training_type())
    composed = CONF / "training" / "identification.yaml"
    from vehest.training.noise_tuning import IdentificationSettings

    contents[composed] = _training(composed, IdentificationSettings())
    return contents


def _training(file: Path, settings: Any) -> str:
    head = _head(file)
    skipped = {*COMPOSED.findall(head), *NOT_USED.get(file.stem, ())}
    return head + "".join(_lines(settings, "", skipped))


def _head(file: Path) -> str:
    """What is written by hand."""
    text = file.read_text(encoding="utf-8")
    name = NAME.search(text)
    assert name is not None, f"'{file}' has no name"
    return text[: name.end()]


def _lines(settings: Any, indent: str, skipped: set[str]) -> Iterator[str]:
    """A line a setting; numbers that a fit determines are listed inside groups alone. Groups come last."""
    from vehest.declared import Declaration, declaration

    groups = []
    for field in fields(settings):
        declared = declaration(field) or Declaration("")
        value = getattr(settings, field.name)
        if field.name in skipped:
            continue
        if is_dataclass(value):
            groups.append((field.name, declared.doc, value))
        elif not declared.is_fitted or settings.__class__.__name__ != "settings_type":
            text = declared.doc or _comment_of(type(settings), field.name)
            comment = "; ".join(filter(None, [text + _unit(declared), *_values(field)]))
            yield _line(f"{indent}{field.name}: {_as_yaml(value)}", comment)
    for name, doc, group in groups:
        yield _line(f"{indent}{name}:", doc)
        yield from _lines(group, f"{indent}  ", set())


def _line(key: str, comment: str) -> str:
    return f"{key:<{COMMENT_COLUMN - 1}} # {comment}\n" if comment else f"{key}\n"


def field_comments(described: type) -> dict[str, str]:
    """Comments of the fields of a dataclass, within the statement of each or behind it: name -> text."""
    source = textwrap.dedent(inspect.getsource(described))
    comments = {
        token.start[0]: token.string.lstrip("# ")
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    lines = source.splitlines()
    (kind,) = ast.parse(source).body
    assert isinstance(kind, ast.ClassDef)
    of_fields = {}
    for node in kind.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            end = node.end_lineno or node.lineno
            is_closed = not lines[end : end + 1] or not lines[end].startswith("    )")
            for line in range(node.lineno, end + (1 if is_closed else 2)):
                if line in comments:
                    of_fields[node.target.id] = comments[line]
    return of_fields


def _comment_of(described: type, name: str) -> str:
    """The comment behind a field of a dataclass that declares no settings, such as the parameters of a car."""
    for kind in described.__mro__[:-1]:
        if comment := field_comments(kind).get(name):
            return comment
    return ""


def _unit(declared: Any) -> str:
    return f" [{declared.unit}]" if declared.unit else ""


def _values(field: Any) -> Iterator[str]:
    """Values or bounds that a setting may have."""
    from vehest.declared import declaration

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


def _as_yaml(value: Any) -> str:
    """A value as YAML reads it back: whole numbers without a point, so that they are spelled as people do."""
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
        return str(int(value))
    if isinstance(value, float):
        text = repr(value)
        return text if "e" not in text or "." in text else text.replace("e", ".0e")
    if isinstance(value, tuple):
        return f"[{', '.join(map(_as_yaml, value))}]"
    text = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True)
    return text.removesuffix("...\n").strip()


def main() -> None:
    """Write the files that have changed and name them."""
    for path, text in files().items():
        if path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
            print(path.relative_to(CONF.parent))


if __name__ == "__main__":
    main()
