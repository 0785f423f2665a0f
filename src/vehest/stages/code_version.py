"""A version of the code that a stage runs: it changes with that code and with nothing else."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
from collections.abc import Iterable
from functools import cache
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]


def code_version(modules: Iterable[str], *, own: Iterable[str] = (), files: Iterable[str] = ()) -> str:
    """Hash of modules and of every module of vehest (or of their own package) that they import, directly or not.

    Comments, docstrings and layout do not count: only what is executed does.

    Args:
        modules: module names, followed through their imports (also those inside functions).
        own: module names that count themselves, without what they import.
        files: folders in the package whose files count too, such as templates.
    """
    found: dict[str, str] = {name: _module(name)[0] for name in own}
    waiting = list(modules)
    while waiting:
        name = waiting.pop()
        if name not in found or name in own:
            digest, imported = _module(name)
            found[name] = digest
            waiting.extend(other for other in imported if other not in found)
    for folder in files:
        for file in sorted((_ROOT / folder).iterdir()):
            found[f"{folder}/{file.name}"] = hashlib.sha256(file.read_bytes()).hexdigest()
    text = "\n".join(f"{name} {digest}" for name, digest in sorted(found.items()))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@cache
def _module(name: str) -> tuple[str, tuple[str, ...]]:
    """Digest of a module's code, and the vehest modules it imports."""
    path = _file_of(name)
    if path is None:
        return "absent", ()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    imported = _imports(tree, name)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and ast.get_docstring(node) is not None:
            node.body = node.body[1:]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest(), imported


def _imports(tree: ast.AST, name: str) -> tuple[str, ...]:
    """Modules of vehest, and of the package that the module itself belongs to."""
    followed = {"vehest", name.split(".")[0]}
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = (
                ".".join([*name.split(".")[: -node.level or None], *([node.module] if node.module else [])])
                if node.level
                else str(node.module)
            )
            for alias in node.names:
                inner = f"{base}.{alias.name}"
                names.add(inner if base.split(".")[0] in followed and _file_of(inner) else base)
    return tuple(sorted(found for found in names if found.split(".")[0] in followed and found != "vehest"))


@cache
def _file_of(name: str) -> Path | None:
    parts = name.split(".")
    if parts[0] != "vehest":  # an estimator from another package
        try:
            spec = importlib.util.find_spec(name)
        except (ImportError, AttributeError, ValueError):  # not a module but a name in one
            return None
        return Path(spec.origin) if spec and spec.origin and spec.origin.endswith(".py") else None
    base = _ROOT.joinpath(*parts[1:])
    for path in (base.with_suffix(".py"), base / "__init__.py"):
        if path.is_file():
            return path
    return None
