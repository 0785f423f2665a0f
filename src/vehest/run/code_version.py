"""A version of the code that a stage runs: it changes with what that code does, not with where it stands or how it is written down.

A module counts by a hash of its syntax tree without docstrings, comments, layout and import statements, and without
``if TYPE_CHECKING:``, which is never executed. The version is the hash of the hashes of all modules that are reached through imports,
in no particular order and without their names. Therefore nothing changes when a module is renamed or moved to another package, when
imports are moved, sorted or made local, or when modules import each other along another way.

What imports bind still counts, since ``from a import f`` and ``from b import f`` are two different programs with the same body: each name
that is imported counts by the content of the module it comes from, its name there and the name it is bound to; names from other
packages (but ``typing``) count by where they are imported from. Annotations count as they are written, since dataclasses read them;
what they name need not be imported when the program runs, and an import that moves under ``if TYPE_CHECKING:`` no longer counts.

Not seen: two modules of the same content that exchange their names; which of several ``import``s of one name is the last; what packages'
own ``__init__`` do unless something is imported from them; other packages' code. Seen although nothing changes: the order of definitions,
a split module, and a renamed module that its importers call by its own name (``from vehest.filters import nonlinear``).

Whole modules count rather than the functions that are called: what is called is found by name at run time (the registry, entry points,
compiled kernels, ``importlib``), where following calls in the source would miss it.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]

UNCOUNTED = (
    "vehest.data.errors",
    "vehest.data.files",
    "vehest.data.limits",
    "vehest.data.schema",
    "vehest.data.text_files",
    "vehest.estimators.registry",
    "vehest.version",
)
"""Modules that word messages, refuse what is wrong, read and write text, and find by name what counts itself: they change no number."""


@dataclass(frozen=True)
class Imported:
    """A name that a module imports.

    Args:
        module: it comes from; empty where that is one of `UNCOUNTED`.
        name: its name there; empty where the module itself is imported.
        bound: its name here.
        followed: whether that module's code counts: it is of vehest or of the importer's own package.
    """

    module: str
    name: str
    bound: str
    followed: bool


@dataclass(frozen=True)
class Module:
    """What counts of a module.

    Args:
        content: hash of its code without imports; empty where it does nothing.
        imports: what it imports.
    """

    content: str
    imports: tuple[Imported, ...] = ()

    @property
    def followed(self) -> list[str]:
        """Modules whose code counts because this one imports them."""
        return sorted({imported.module for imported in self.imports if imported.followed})

    def digest(self, *, alone: bool) -> str:
        """Hash of its content and of what its imports bind; ``alone``: without the content of modules that names come from."""
        bindings = set()
        for imported in self.imports:
            if not imported.followed:
                bindings.add(("", imported.module, imported.name, imported.bound))
            elif not alone:
                bindings.add((module_of(imported.module).content, "", imported.name, imported.bound))
            elif imported.name and imported.name != imported.bound:
                bindings.add(("", "", imported.name, imported.bound))
        return hashlib.sha256(repr((self.content, sorted(bindings))).encode()).hexdigest()


def code_version(modules: Iterable[str], *, own: Iterable[str] = (), files: Iterable[str] = ()) -> str:
    """Hash of modules and of every module of vehest (or of their own package) that they import, directly or not.

    Args:
        modules: module names, followed through their imports (also those inside functions).
        own: module names that count themselves, without what they import.
        files: folders in the package whose files count too, such as templates.
    """
    reached = modules_reached(modules)
    digests = [module_of(name).digest(alone=False) for name in reached]
    digests += [module_of(name).digest(alone=True) for name in own if name not in reached]
    for folder in files:
        for file in sorted((_ROOT / folder).iterdir()):
            digests.append(f"{file.name} {hashlib.sha256(file.read_bytes()).hexdigest()}")
    return hashlib.sha256("\n".join(sorted(digests)).encode()).hexdigest()[:16]


def modules_reached(modules: Iterable[str]) -> list[str]:
    """Names of modules and of those that they import, directly or not, as far as their code counts and does anything."""
    found: set[str] = set()
    waiting = [name for name in modules if name not in UNCOUNTED]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting.extend(other for other in module_of(name).followed if other not in found)
    return sorted(name for name in found if module_of(name) != Module(""))


def files_read() -> dict[str, Path]:
    """Modules outside of vehest that versions were made from so far -> their files."""
    return {name: path for name, path in _files.items() if name.split(".")[0] != "vehest"}


def forget() -> None:
    """Read modules again when they are next asked for."""
    module_of.cache_clear()
    file_of.cache_clear()
    _files.clear()


_files: dict[str, Path] = {}


@cache
def module_of(name: str) -> Module:
    """What counts of a module, by its name."""
    path = file_of(name)
    if path is None:
        return Module("absent")
    _files[name] = path
    content, statements = _parsed(path.read_text(encoding="utf-8"))
    return Module(content, tuple(_imports(statements, name)))


@cache
def _parsed(text: str) -> tuple[str, tuple[ast.Import | ast.ImportFrom, ...]]:
    """Hash of a module's code without imports, empty where nothing is left; and its import statements, wherever in it."""
    tree = ast.parse(text)
    written = "".join(_written(tree))
    imports = tuple(node for node in _executed(tree) if isinstance(node, ast.Import | ast.ImportFrom))
    return hashlib.sha256(written.encode()).hexdigest() if written != _NOTHING else "", imports


def _imports(statements: Iterable[ast.Import | ast.ImportFrom], name: str) -> Iterator[Imported]:
    """What import statements of a module bind; ``name`` is the module's."""
    path = file_of(name)
    package = name.split(".") if path is not None and path.name == "__init__.py" else name.split(".")[:-1]
    for node in statements:
        if isinstance(node, ast.Import):
            for alias in node.names:
                followed = _is_followed(alias.name, name)
                bound = alias.asname or alias.name.split(".")[0]
                yield Imported(alias.name, "", bound, followed)
        elif node.module not in ("__future__", "typing"):
            start = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*start, *([node.module] if node.module else [])])
            for alias in node.names:
                inner, bound = f"{base}.{alias.name}", alias.asname or alias.name
                if _is_followed(inner, name) and file_of(inner) is not None:
                    yield Imported(inner, "", bound, True)
                else:
                    yield Imported("" if base in UNCOUNTED else base, alias.name, bound, _is_followed(base, name))


def _is_followed(module: str, importer: str) -> bool:
    """Whether a module's code counts: it is of vehest, or of the importer's own package."""
    return module.split(".")[0] in {"vehest", importer.split(".")[0]} and module != "vehest" and module not in UNCOUNTED


def _executed(node: ast.AST) -> Iterator[ast.AST]:
    """A node and all below it, without what only type checkers read."""
    yield node
    for child in ast.iter_child_nodes(node):
        if not _is_for_type_checkers(child):
            yield from _executed(child)


def _is_for_type_checkers(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING" and not node.orelse


_NOTHING = "(Module)"


def _written(node: ast.AST) -> Iterator[str]:
    """A syntax tree as text, the same in every version of Python: only fields that hold something, without what does not count."""
    yield f"({type(node).__name__}"
    for field, value in ast.iter_fields(node):
        if field in ("ctx", "kind", "type_comment", "type_ignores") or value is None or value == []:
            continue
        if isinstance(value, list) and isinstance(value[0], ast.stmt):
            value = [statement for statement in value if not _is_left_out(statement)]
            if not value:
                continue
        yield f" {field}="
        for part in value if isinstance(value, list) else [value]:
            if isinstance(part, ast.AST):
                yield from _written(part)
            else:
                yield f"{part!r},"
    yield ")"


def _is_left_out(statement: ast.stmt) -> bool:
    """Whether a statement is an import, a docstring, a place holder or for type checkers only."""
    if isinstance(statement, ast.Expr):
        return isinstance(statement.value, ast.Constant) and isinstance(statement.value.value, str)
    return isinstance(statement, ast.Import | ast.ImportFrom | ast.Pass) or _is_for_type_checkers(statement)


@cache
def file_of(name: str) -> Path | None:
    """The file of a module, found without importing anything; none where there is no such module."""
    first, *rest = name.split(".")
    if first == "vehest":
        bases = [_ROOT]
    else:  # an estimator from another package
        try:
            spec = importlib.util.find_spec(first)
        except (ImportError, AttributeError, ValueError):
            return None
        if spec is None:
            return None
        if not rest:
            return Path(spec.origin) if spec.origin and spec.origin.endswith(".py") else None
        bases = [Path(folder) for folder in spec.submodule_search_locations or ()]
    for base in bases:
        place = base.joinpath(*rest)
        for path in (place.with_name(f"{place.name}.py"), place / "__init__.py"):
            if path.is_file():
                return path
    return None
