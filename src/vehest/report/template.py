"""Reports from hand-written Markdown templates, with numbers, tables and figures filled in."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from vehest.report.document import Block, Figure, Table

_MARK = "\0"  # before and after the place of a table or figure


def fill_template(path: Path, values: Mapping[str, Any], blocks: Iterable[Block]) -> list[Block]:
    """Fill in a template: values, loops over rows, places of tables and figures.

    Places are ``{{ table("name") }}`` and ``{{ figure("name") }}``.

    Parameters
    ----------
    path
        Markdown with Jinja's placeholders.
    values
        Name -> number or text; a name that the template has and they lack is an error.
    blocks
        Tables and figures by their names; one that is not there leaves its place empty.

    Returns
    -------
    list of str, Table and Figure
        Blocks of a `Document`.
    """
    from jinja2 import Environment, StrictUndefined

    placed: dict[str, Block] = {}
    for block in blocks:
        if not isinstance(block, str):
            placed[f"{type(block).__name__} {block.name}"] = block

    def place(kind: type[Table] | type[Figure]) -> Any:
        return lambda name: f"{_MARK}{kind.__name__} {name}{_MARK}"

    environment = Environment(
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    template = environment.from_string(path.read_text(encoding="utf-8"))
    rendered = template.render(values, table=place(Table), figure=place(Figure))
    filled: list[Block] = []
    for position, piece in enumerate(rendered.split(_MARK)):
        if position % 2 == 0:
            filled += [piece.strip()] if piece.strip() else []
        elif piece in placed:
            filled.append(placed[piece])
    return filled
