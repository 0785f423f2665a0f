"""The index of the study: what there is, how it was made, what went wrong by accident."""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd

from vehest.report.document import Block, Column, Document, Table, as_code, as_text
from vehest.studies.artefacts import StudyArtefacts
from vehest_papers.proving_ground import gates
from vehest_papers.proving_ground.papers import profile_of
from vehest_papers.proving_ground.tables import (
    COLUMNS,
    OVERVIEW,
    accidents,
    flagged_table,
    how_to_get,
    row_of,
)
from vehest_papers.proving_ground.tally import FINE, FLAGS, MOVING
from vehest_papers.proving_ground.vehicles import VehiclePage


def index_document(artefacts: StudyArtefacts, pages: Mapping[str, VehiclePage]) -> Document:
    """What is here, how it was made, and what went wrong; with the table ``statistics`` of everything."""
    simulated = sum(page.merged("simulated").drives for page in pages.values())
    flagged = [drive for page in pages.values() for drive in page.flagged]
    blocks: list[Block] = [
        f"**SIMULATED:** {simulated} of the drives here are simulated; simulated cars are easier than real ones. Whatever comes from a "
        f"real car is called real wherever it stands.",
        artefacts.about,
        "## How it was made\n\n" + "\n".join(f"- {line}" for line in _how(artefacts)),
        "## Vehicles",
        _overview(pages),
        "\n".join(
            f"- [{profile_of(name).title}]({name}.md): {_figures_in_words(name)}" for name in pages
        ),
        *gates.blocks(artefacts.datasets),
        accidents(flagged, simulated),
    ]
    if flagged:
        blocks.append(flagged_table("flagged", flagged))
    blocks.append(
        "Every statistic of every set of drives, a line each: [statistics.csv](tables/statistics.csv)."
    )
    return Document(
        artefacts.title, [block for block in blocks if block], {"statistics": _statistics(pages)}
    )


def _how(artefacts: StudyArtefacts) -> list[str]:
    lines = [f"Command: {as_code(artefacts.command)}"]
    for dataset in artefacts.datasets:
        seed = f", seed {dataset.config['seed']}" if "seed" in dataset.config else ""
        count = f"{len(dataset.files)} {'recordings' if len(dataset.files) != 1 else 'recording'}"
        lines.append(
            f"`{dataset.name}`: {as_text(dataset.title)} ({dataset.kind.upper()}{seed}), {count}"
        )
    lines += [
        f"`{own.name}`: {as_text(own.title)} (REAL): not here when this was made. {how_to_get(own)}"
        for own in artefacts.absent_datasets
    ]
    lines.append(
        f"Distributions and quantiles are those of samples above {MOVING:g} m/s, from sensors with their errors; β is the reference's. "
        f"Quantiles are exact to {FINE['ay'].width / 2:g} (m/s, m/s², deg)."
    )
    return lines


def _overview(pages: Mapping[str, VehiclePage]) -> Table:
    rows = []
    for page in pages.values():
        for own in (*page.simulated.values(), *page.real.values()):
            row: dict[str, object] = {
                "vehicle": page.name,
                "dataset": own.dataset.name,
                "kind": own.dataset.kind,
            }
            rows.append(row | row_of(own.all, with_flags=own.dataset.kind == "simulated"))
    return Table(
        "overview",
        "Vehicles and data sets. Spun and left the road: drives that did so by accident, and are kept. Stood: drives at whose end the car "
        "stands, on purpose or after an accident.",
        pd.DataFrame(rows, columns=["vehicle", "dataset", "kind", *OVERVIEW]),
        {
            "vehicle": Column("vehicle"),
            "dataset": Column("data set"),
            "kind": Column("kind"),
            **COLUMNS,
        },
    )


def _figures_in_words(name: str) -> str:
    beside = [profile_of(name).source] if profile_of(name).source else []
    beside += ["a real recording"] if profile_of(name).counterpart else []
    words = "traces, handling diagram, distributions of β and ay"
    return f"{words}; beside {' and '.join(beside)}" if beside else words


def _statistics(pages: Mapping[str, VehiclePage]) -> pd.DataFrame:
    rows = []
    for page in pages.values():
        for own in (*page.simulated.values(), *page.real.values()):
            for name, tally in own.tallies.items():
                for quantity, (value, unit) in tally.values().items():
                    if own.dataset.kind == "simulated" or quantity not in FLAGS:
                        about = {
                            "dataset": own.dataset.name,
                            "kind": own.dataset.kind,
                            "vehicle": page.name,
                            "set": name,
                        }
                        rows.append(
                            about
                            | {"quantity": quantity, "value": float(f"{value:.9g}"), "unit": unit}
                        )
    return pd.DataFrame(
        rows, columns=["dataset", "kind", "vehicle", "set", "quantity", "value", "unit"]
    )
