"""Data and methods in the reports of papers: kinds of data, missing parts, warnings, scoring, and
the ranges that were used.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import pandas as pd

from vehest.studies.artefacts import PartArtefacts, StudyArtefacts
from vehest_papers.kit.reading import spans_in_words, words_of_kinds


def absent_parts(artefacts: StudyArtefacts) -> str:
    """A sentence after a space on the parts whose recordings are missing; empty where none is."""
    titles = "; ".join(artefacts.titles[name] for name in artefacts.absent)
    return f" Not in this report, since the recordings are missing: {titles}." if titles else ""


def scoring(part: PartArtefacts) -> str:
    """How estimates of a part are scored."""
    protocol = part.protocol
    return (
        f"Evaluation: every estimate is read at {protocol.rate_hz:g} Hz; the first "
        f"{protocol.skip_seconds:g} s of each {protocol.piece} are not "
        f"scored.{protocol.start_description}{protocol.describe_sideslip(part.split.datasets)}"
    )


def facts_of(parts: Iterable[PartArtefacts]) -> list[str]:
    """Budgets, versions and machine of all parts, each line once."""
    return list(dict.fromkeys(fact for part in parts for fact in part.facts))


def bullets(heading: str, lines: Iterable[str]) -> str:
    """A section of lines; empty ones are left out."""
    return f"{heading}\n\n" + "\n".join(f"- {line}" for line in lines if line)


def provenance(lines: Sequence[str]) -> str:
    """The appendix of that name."""
    return bullets("## Appendix: how it was made", lines)


def ranges(artefacts: StudyArtefacts) -> pd.DataFrame:
    """Ranges of training, validation and tests, a row for each part."""
    return pd.DataFrame(
        [
            {
                "part": artefacts.titles[key],
                "kind": words_of_kinds(part),
                "train": spans_in_words(part.split.train),
                "validation": spans_in_words(part.split.validation),
                "tests": "; ".join(
                    f"{test}: {spans_in_words(spans)}" for test, spans in part.split.tests.items()
                ),
            }
            for key, part in artefacts.parts.items()
        ]
    )
