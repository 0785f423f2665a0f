"""Run the notebooks of examples/ and store what their cells print and draw (`make notebooks`).

Cells run in this process, in order, in one namespace, as a fresh kernel would run them.
"""

from __future__ import annotations

import ast
import base64
import io
import json
import sys
from contextlib import chdir, redirect_stdout
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parents[1] / "examples"
TEXT = "text/plain"
PNG = "image/png"
PICTURE = FOLDER.parent / "docs" / "images" / "lap.png"  # the last one of the first notebook


def notebooks() -> list[Path]:
    """All notebooks, in the order in which they are to be read."""
    return sorted(FOLDER.glob("*.ipynb"))


def read_notebook(path: Path) -> dict[str, Any]:
    """A notebook as its JSON."""
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return content


def code_cells(notebook: dict[str, Any]) -> list[dict[str, Any]]:
    """The cells of code of a notebook."""
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def run_cells(notebook: dict[str, Any]) -> list[list[dict[str, Any]]]:
    """Outputs of each cell of code, run in the notebooks' folder; raises what a cell raises."""
    namespace: dict[str, Any] = {"__name__": "__main__"}
    with chdir(FOLDER):
        return [_run("".join(cell["source"]), namespace) for cell in code_cells(notebook)]


def _run(source: str, namespace: dict[str, Any]) -> list[dict[str, Any]]:
    """Execute a cell; what it prints, and the value of its last expression as Jupyter shows it."""
    body = ast.parse(source).body
    last = body.pop() if isinstance(body[-1], ast.Expr) else None
    with redirect_stdout(io.StringIO()) as printed:
        exec(compile(ast.Module(body, []), "<cell>", "exec"), namespace)
        value = None
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "<cell>", "eval"), namespace)
    outputs: list[dict[str, Any]] = []
    if text := printed.getvalue():
        outputs.append({"output_type": "stream", "name": "stdout", "text": _lines(text)})
    if value is not None:
        outputs.append({"output_type": "display_data", "metadata": {}, "data": _shown(value)})
    return outputs


def _shown(value: object) -> dict[str, Any]:
    """A value as text, and as a picture or table where it has one."""
    data: dict[str, Any] = {TEXT: _lines(repr(value))}
    if hasattr(value, "_repr_png_"):
        data[PNG] = base64.b64encode(value._repr_png_()).decode()
    elif hasattr(value, "_repr_html_"):
        data["text/html"] = _lines(value._repr_html_())
    return data


def _lines(text: str) -> list[str]:
    return text.splitlines(keepends=True)


def texts_of(outputs: list[dict[str, Any]]) -> list[str]:
    """What outputs say, without pictures."""
    return [
        "".join(output["text"] if "text" in output else output["data"][TEXT]) for output in outputs
    ]


def pictures_of(results: list[list[dict[str, Any]]]) -> list[str]:
    """Pictures among the outputs of cells, in base64."""
    shown = [output.get("data", {}) for outputs in results for output in outputs]
    return [data[PNG] for data in shown if PNG in data]


def main() -> None:
    """Run the notebooks that are named, by default all, and write them with their outputs."""
    for path in [FOLDER / name for name in sys.argv[1:]] or notebooks():
        notebook = read_notebook(path)
        results = run_cells(notebook)
        for count, (cell, outputs) in enumerate(zip(code_cells(notebook), results, strict=True), 1):
            cell |= {"execution_count": count, "outputs": outputs}
        if path == notebooks()[0]:
            PICTURE.write_bytes(base64.b64decode(pictures_of(results)[-1]))
        text = json.dumps(notebook, indent=1, ensure_ascii=False)
        path.write_text(f"{text}\n", encoding="utf-8")
        print(path.name)


if __name__ == "__main__":
    main()
