"""Errors on the other car where one difference between the cars is taken away at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pandas as pd

from vehest.report.document import Column, Table
from vehest.report.style import fixed
from vehest_papers.ksnn import paper
from vehest_papers.ksnn.schemes import Scheme

CAUSES = {
    "same_sensors": "the same sensors",
    "same_tyres": "the same tyres",
    "same_driving": "the same driving",
}
"""Start of a part's name -> what its two cars have in common."""


def causes_table(schemes: Sequence[Scheme], ablations: Mapping[str, Sequence[Scheme]]) -> Table:
    """FVU on the other car with one difference taken away at a time, a row a category."""
    columns = {f"S{scheme.name[-1]} as it is": scheme for scheme in schemes}
    for cause, own in ablations.items():
        columns |= {
            f"S{scheme.name[-1]} {CAUSES[cause].removeprefix('the ')}": scheme for scheme in own
        }
    ordered = {title: columns[title] for title in sorted(columns, key=lambda title: title[:2])}
    categories = dict.fromkeys(
        category
        for scheme in ordered.values()
        for category in scheme.chosen
        if category != paper.KINEMATIC
    )
    rows: list[dict[str, str]] = []
    for category in categories:
        row = {"model": category}
        for title, scheme in ordered.items():
            errors = scheme.errors(scheme.other)
            name = scheme.name_of(category)
            row |= {
                title: fixed(errors.value(name, "fvu"), 3),
                f"{title}, interval": errors.in_words(name, "fvu"),
            }
        rows.append(row)
    caption = (
        "FVU on the other car where the two cars have one thing more in common than in the schemes; of each family the structure that "
        "validation chooses, three seeds in the ablations. All intervals are in the CSV."
    )
    return Table(
        "causes",
        caption,
        pd.DataFrame(rows),
        {"model": Column("model"), **{title: Column(title) for title in ordered}},
    )
