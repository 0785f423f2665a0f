"""A comparison across vehicles: what learns on one car, stops on another and is tested on both, with all errors of its candidates."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path

import pandas as pd

from vehest.evaluation.blocks import Segments, read_segments
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest.studies.kit.runs import by_name
from vehest_papers.kit.reading import words_of_kinds
from vehest_papers.kit.statements import Change, Measured
from vehest_papers.ksnn import paper
from vehest_papers.ksnn.candidates import chosen_by_category, runs_of
from vehest_papers.ksnn.comparing import SegmentErrors
from vehest_papers.ksnn.paper import Published

THIRD = "j1"  # test set of a car that no network learns or stops on, where there is one
SET_TITLES = {"c2": "C-2", "f2": "F-2", THIRD: "third car"}


@lru_cache(maxsize=600)
def _read(path: Path) -> dict[str, Segments]:
    return read_segments(path)


def segments_on(model: EvaluatedModel, test: str) -> Segments:
    """Errors of a model by segments of a test set, its file read once for all tests."""
    found = _read(model.evaluation_folder / "blocks.csv")
    return found[test] if test in found else model.segments(test)


@dataclass(frozen=True, eq=False)
class Scheme:
    """One part, and which of its test sets is of which car."""

    name: str  # of the part
    title: str  # for people
    part: PartArtefacts  # what was compared
    own: str  # test set of the car that is learnt on
    other: str  # test set of the car that is stopped on
    published: Mapping[str, Published] = field(
        default_factory=dict
    )  # the paper's table of this scheme; empty where it has none

    @cached_property
    def runs(self) -> pd.DataFrame:
        """`candidates.runs_of` the part."""
        return runs_of(self.part)

    @cached_property
    def chosen(self) -> dict[str, pd.Series]:
        """Category -> the run that validation chooses."""
        return chosen_by_category(self.runs)

    @cached_property
    def kind(self) -> str:
        """``real``, ``simulated`` or both."""
        return words_of_kinds(self.part)

    def models(self, category: str) -> list[EvaluatedModel]:
        """All seeds of the structure that validation chooses of a category; none where it is not there."""
        run = self.chosen.get(category)
        if run is None:
            return []
        return [
            model
            for model in self.part.models
            if (model.estimator, model.variant) == (run["estimator"], run["variant"])
        ]

    def model(self, category: str) -> EvaluatedModel | None:
        """The model of the run that validation chooses."""
        run = self.chosen.get(category)
        return next(
            (
                model
                for model in self.models(category)
                if run is not None and model.seed == run["seed"]
            ),
            None,
        )

    @cached_property
    def _errors(self) -> dict[str, SegmentErrors]:
        return {}

    def errors(self, test: str) -> SegmentErrors:
        """Of all structures on a test set, named as `name_of` names them."""
        if test not in self._errors:
            groups = by_name(self.part.models)
            segments = {
                "/".join(name): [segments_on(model, test) for model in models]
                for name, models in groups.items()
            }
            self._errors[test] = SegmentErrors(segments, test)
        return self._errors[test]

    def name_of(self, category: str) -> str:
        """Name in `errors` of the structure that validation chooses of a category."""
        run = self.chosen.get(category)
        return "" if run is None else f"{run['estimator']}/{run['variant']}"

    def measured(self, category: str, test: str, metric: str) -> Measured | None:
        """A figure over all seeds of the structure that validation chooses."""
        return self.errors(test).get(self.name_of(category), metric)

    def change(self, first: str, second: str, test: str, metric: str) -> Change | None:
        """From one category to another on a test set."""
        return self.errors(test).change(self.name_of(first), self.name_of(second), metric)

    def other_over_own(self, name: str) -> Change | None:
        """How many times a structure's FVU on the own car is left on the other one."""
        other, own = (self.errors(test).get(name, "fvu") for test in (self.other, self.own))
        return Change.of(other, own) if other is not None and own is not None else None

    def structures(self, categories: Iterable[str] = (*paper.CATEGORIES,)) -> dict[str, str]:
        """Name in `errors` -> category, of all structures of these categories."""
        wanted = set(categories)
        rows = self.runs[self.runs["category"].isin(wanted)].drop_duplicates(
            ["estimator", "variant"]
        )
        return {
            f"{row['estimator']}/{row['variant']}": str(row["category"])
            for row in rows.to_dict("records")
        }
