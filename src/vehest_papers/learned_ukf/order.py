"""Whether methods trained anew have the order of the published first table (`make
learned_ukf_quick`).

``vehest run learned_ukf_quick --json`` -> weighted MSE of each method
-> results/learned_ukf/tables/overview.csv -> a line a tyre
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

from vehest.data.errors import VehestError
from vehest.data.text_files import number_in, read_rows
from vehest_papers.learned_ukf.candidates import SETS

PUBLISHED = Path("results/learned_ukf/tables/overview.csv")


def order_lines(trained: Sequence[Mapping[str, object]], published: Path) -> list[str]:
    """A line for each test set: the order of the methods now, and where it differs from the
    published one.

    Parameters
    ----------
    trained
        Rows of the table ``overview``: ``candidate`` and ``ours_TEST``, the weighted MSE on each
        test set.
    published
        CSV file of the published table ``overview``.

    Raises
    ------
    VehestError
        The published table is missing or damaged.
    """
    rows = {row["candidate"]: row for row in read_rows(published, ("candidate",))}
    lines = []
    for test, tyre in SETS.items():
        column = f"ours_{test}"
        now = {str(row["candidate"]): float(str(row[column])) for row in trained}
        before = {
            name: number_in(row, column, published) for name, row in rows.items() if name in now
        }
        ranked = " < ".join(f"{name} {now[name]:.4f}" for name in sorted(now, key=now.__getitem__))
        not_published = sorted(now.keys() - before.keys())
        swapped = [
            f"{first} and {second}"
            for first, second in combinations(sorted(before), 2)
            if (now[first] < now[second]) is not (before[first] < before[second])
        ]
        verdict = f"another order of {', '.join(swapped)}" if swapped else "same order"
        missing = f"; not published: {', '.join(not_published)}" if not_published else ""
        lines.append(f"{tyre}: {ranked}; {verdict} as in {published}{missing}")
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the outcome of a run from standard input, print a line a tyre."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--published", type=Path, default=PUBLISHED)
    options = parser.parse_args(arguments)
    try:
        trained = json.load(sys.stdin)["overview"]
    except (ValueError, KeyError):
        sys.exit("error: standard input is not what 'vehest run learned_ukf_quick --json' prints")
    try:
        print(*order_lines(trained, options.published), sep="\n")
    except VehestError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
