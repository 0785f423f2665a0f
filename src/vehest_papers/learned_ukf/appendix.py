"""The appendices: errors by state, consistency, slip angles, budgets, trials, settings, and the
ranges of the recordings.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import pandas as pd

from vehest.data.splits import Span
from vehest.report.document import Block, as_code
from vehest.report.style import fixed
from vehest.studies.artefacts import PartArtefacts, StudyArtefacts
from vehest_papers.kit import methods
from vehest_papers.kit.block_rows import TRAINING
from vehest_papers.kit.reading import lengths_of, recordings_of, spans_in_words, words_of_kinds
from vehest_papers.learned_ukf import slips, tables
from vehest_papers.learned_ukf.candidates import SETS, models_by_candidate
from vehest_papers.learned_ukf.filtering import loaded
from vehest_papers.learned_ukf.trials import trials_table


def appendix_of_part(
    name: str,
    part: PartArtefacts,
    runs: pd.DataFrame,
    data: dict[str, pd.DataFrame],
) -> list[Block]:
    """Consistency of the filters and slip angles; errors by state and budgets of the main part as
    files.
    """
    kind = words_of_kinds(part).upper()
    consistent = (
        "Consistency of the filters: normalised estimation errors squared over vx, vy and yaw "
        "rate (NEES) and normalised innovations squared (NIS), 1 for a consistent filter and "
        "above 1 for one too sure of itself; share of vy's errors within one and two of the "
        f"filter's own standard deviations. Data: {kind}."
    )
    data[f"by_state_{name}"] = tables.by_state(runs, list(SETS))
    data[f"budget_{name}"] = tables.budget(part, runs)
    return [
        "## Appendix: consistency of the filters",
        tables.consistency(runs, list(SETS), f"consistency_{name}", consistent),
        *_slips(part, name, kind, data),
    ]


def provenance(
    artefacts: StudyArtefacts,
    main: Mapping[str, PartArtefacts],
    data: dict[str, pd.DataFrame],
) -> list[Block]:
    """Trials, the protocol, and the ranges of the recordings with their minutes."""
    first = next(iter(main.values()))
    trained = {model.estimator for part in artefacts.parts.values() for model in part.models}
    data["training_settings"] = settings_table(main)
    lines = [
        f"Command: {as_code(artefacts.command)}",
        methods.scoring(first),
        "Metrics: squared and absolute errors of vx, vy [m/s] and yaw rate [rad/s], weighted "
        "0.2225, 0.5064 and 0.1566 and summed at each sample; their means are MSE (weighted) and "
        "MAE, the 99th percentile of the absolute ones is 99%-AE. Units are mixed, as in the "
        "paper. NEES and NIS are divided by their dimension; coverage is that of the bands of vy.",
        "Figures that show one seed show the one with the lowest MSE (weighted) on the "
        "validation range. Test data choose nothing.",
        *(fact for fact in methods.facts_of(main.values()) if not fact.startswith(tuple(trained))),
    ]
    lines += [f"{line[0].upper()}{line[1:]}." for line in artefacts.search_remarks]
    if artefacts.trials:
        lines.append(
            "Step sizes and batches that were tried, on one seed that is not in the tables and on "
            "validation alone (tyre A, run 0): [CSV](tables/trials.csv)"
        )
        data["trials"] = trials_table(artefacts.trials)
    data["data"] = _ranges(artefacts, main)
    names = sorted({*data, TRAINING})
    files = ", ".join(f"[{name}](tables/{name}.csv)" for name in names)
    return [methods.provenance(lines), f"Further tables: {files}."]


def settings_table(parts: Mapping[str, PartArtefacts]) -> pd.DataFrame:
    """One row a part, candidate and setting of its training."""
    rows = [
        {"part": name, "candidate": candidate, "setting": key, "value": value}
        for name, part in parts.items()
        for candidate, models in models_by_candidate(part).items()
        for key, value in _flat(models[0].training)
    ]
    return pd.DataFrame(rows, columns=["part", "candidate", "setting", "value"])


def _flat(settings: Mapping[str, Any], head: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{head}{key}.")
        else:
            yield f"{head}{key}", value


def _ranges(artefacts: StudyArtefacts, main: Mapping[str, PartArtefacts]) -> pd.DataFrame:
    """Ranges of each part with their minutes and sequences."""
    rows: list[dict[str, object]] = []
    for name, part in main.items():
        row: dict[str, object] = {
            "part": artefacts.titles[name],
            "kind": words_of_kinds(part).upper(),
        }
        for label, spans in (
            ("train", part.split.train),
            ("validation", part.split.validation),
            *part.split.tests.items(),
        ):
            row[label] = (
                f"{spans_in_words(spans)}; {fixed(minutes(part, spans), 1)} "
                f"min{_sequences(part, label)}"
            )
        rows.append(row)
    return pd.DataFrame(rows)


def minutes(part: PartArtefacts, spans: Sequence[Span]) -> float:
    """Of driving in ranges."""
    return sum(lengths_of(part, spans)) / part.protocol.rate_hz / 60.0


def _sequences(part: PartArtefacts, test: str) -> str:
    counted = part.metrics[
        (part.metrics["test_set"] == test) & (part.metrics["metric"] == "n_sequences")
    ]["value"]
    return (
        f"; {int(counted.iloc[0])} sequences"
        if len(counted) and math.isfinite(counted.iloc[0])
        else ""
    )


def _slips(part: PartArtefacts, name: str, kind: str, data: dict[str, pd.DataFrame]) -> list[Block]:
    filters = [model for model in part.models if model.estimator == "learned_ukf"]
    if not filters:
        return []
    distance = loaded(filters[0]).settings.car.cg_to_rear_axle
    sets = {
        "training": part.split.train,
        **{f"test, {tyre}": part.split.tests[test] for test, tyre in SETS.items()},
    }
    angles = {
        label: slips.rear_slip(recordings_of(part, spans), distance)
        for label, spans in sets.items()
    }
    note = (
        f"The rear axle lies {distance:g} m behind the centre of gravity, where learning starts "
        "from."
    )
    figure, percentiles, drawn = slips.distribution(angles, name, kind, note)
    data |= {f"slip_density_{name}": drawn, f"slip_percentiles_{name}": percentiles}
    return ["## Appendix: slip angles", figure]
