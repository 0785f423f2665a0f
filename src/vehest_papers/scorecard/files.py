"""All files of the scorecard, and the command that writes or checks them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from vehest.data.errors import DataError, VehestError
from vehest_papers.kit.claim_files import CLAIMS_FOLDER
from vehest_papers.scorecard.csv_files import changed_verdicts, rows_of_all
from vehest_papers.scorecard.front_page import front_page
from vehest_papers.scorecard.judged import PAPERS, read_study
from vehest_papers.scorecard.paper_pages import paper_page


def scorecard_files(results: Path) -> dict[str, str]:
    """File below ``results`` -> its content: the pages and CSV files of the scorecard."""
    studies = [read_study(name, results) for name in PAPERS]
    return {
        "scorecard.md": front_page(studies, results),
        **{study.page: paper_page(study, results) for study in studies},
        "scorecard.csv": rows_of_all(studies),
        "scorecard/changed_verdicts.csv": changed_verdicts(
            studies, CLAIMS_FOLDER / "claims_before.csv"
        ),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the scorecard; with ``--check`` exit with 3 where it is not what the committed inputs
    give.
    """
    parser = argparse.ArgumentParser(description="Write the scorecard of four papers.")
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument("--check", action="store_true", help="write nothing, compare")
    options = parser.parse_args(arguments)
    try:
        files = scorecard_files(options.results)
    except VehestError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    if options.check:
        _check(files, options.results)
        return
    for name, text in files.items():
        (options.results / name).parent.mkdir(parents=True, exist_ok=True)
        (options.results / name).write_text(text, encoding="utf-8")


def _check(files: Mapping[str, str], results: Path) -> None:
    for name, text in files.items():
        path = results / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            print(f"error: '{path}' is not what its inputs give; run make scorecard")
            sys.exit(DataError.exit_code)
