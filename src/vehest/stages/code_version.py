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
    """Hash of modules and of every vehest module that they import, directly or not.

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
    imported = _imports(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and ast.get_docstring(node) is not None:
            node.body = node.body[1:]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest(), imported


def _imports(tree: ast.AST) -> tuple[str, ...]:
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names if alias.name.startswith("vehest."))
        elif isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "vehest":
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                names.add(inner if _file_of(inner) else node.module)
    return tuple(sorted(names - {"vehest"}))


@cache
def _file_of(name: str) -> Path | None:
    parts = name.split(".")
    if parts[0] != "vehest":  # an estimator from another package
        spec = importlib.util.find_spec(name)
        return Path(spec.origin) if spec and spec.origin else None
    base = _ROOT.joinpath(*parts[1:])
    for path in (base.with_suffix(".py"), base / "__init__.py"):
        if path.is_file():
            return path
    return None
