"""Which estimator of a comparison is recommended: one rule for the page, the Markdown report and
the terminal.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from vehest.data.splits import VALIDATION
from vehest.evaluation.blocks import MIN_BLOCKS
from vehest.evaluation.ranking import BASELINES, Name, Ranking
from vehest.report.style import listed
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest.studies.kit.runs import by_name, chosen_seed, runs_of, titles_of, value_of_run
from vehest.studies.kit.standing import BASELINE_TITLES, best_sentence, figure_of, ranking_of
from vehest.studies.kit.warnings import cannot_rank


@dataclass(frozen=True)
class Recommendation:
    """Estimator that a comparison recommends by one test set, with the ranking it rests on.

    Parameters
    ----------
    ranking : Ranking
        Candidates by RMSE(β).
    titles : Mapping[Name, str]
        (estimator, variant) -> title, as Markdown.
    obstacles : Sequence[str]
        Why the test cannot rank estimators, in clauses; empty if it can.
    model : EvaluatedModel or None
        The recommended model; None where no estimator is recommended.
    """

    ranking: Ranking
    titles: Mapping[Name, str]
    obstacles: Sequence[str]
    model: EvaluatedModel | None

    def describe(self, condition: str = "") -> list[str]:
        """The verdict in Markdown: the best and its equals, then what is recommended.

        Parameters
        ----------
        condition : str
            Driving for which the error is to be expected, such as "|ay| up to 8 m/s²".
        """
        ranking = self.ranking
        if not ranking.order:
            return ["No estimator has a finite sideslip error on this test set."]
        if self.obstacles:
            return [
                f"**These recordings cannot rank estimators**, because {listed(self.obstacles)}."
            ]
        return [best_sentence(ranking, self.titles), self._describe_choice(condition)]

    def _describe_choice(self, condition: str) -> str:
        """A paragraph on what is recommended and why, with the expected error; or why nothing
        is.
        """
        ranking = self.ranking
        baselines = " and ".join(BASELINE_TITLES[baseline] for baseline in BASELINES)
        if self.model is None:
            missing = [BASELINE_TITLES[baseline] for baseline in ranking.missing_baselines]
            if missing:
                return f"**No estimator is recommended**: none was compared with {listed(missing)}."
            return (
                "**No estimator is recommended**: none of these is significantly better than "
                f"{baselines}."
            )
        title = self.titles[self.model.name]
        expected = (
            "RMSE(β) "
            f"{figure_of(ranking, self.model.name)}{f' for {condition}' if condition else ''}"
        )
        if ranking.winner is not None:
            return (
                f"**Recommended: {title}**, expected {expected}: it is significantly better than "
                "every "
                f"other estimator, {baselines}."
            )
        if len(ranking.recommendable) == 1:
            return (
                f"**Recommended: {title}**, expected {expected}: of these it alone is "
                f"significantly better than {baselines}."
            )
        return (
            f"**Recommended: {title}**, expected {expected}: of the {len(ranking.recommendable)} "
            "estimators among these that are "
            f"significantly better than {baselines}, it has the lowest RMSE(v) on validation."
        )


def recommendation_of(part: PartArtefacts, test_set: str) -> Recommendation:
    """Recommendation of an estimator, decided by one test set.

    Recommended is the estimator that is significantly better than all others (`Ranking.winner`);
    without one, of those in `Ranking.recommendable`, the one with the lowest RMSE(v) on validation.
    None is recommended where none is significantly better than the zero-sideslip baseline and the
    static map, or where the test cannot rank estimators.

    Returns
    -------
    Recommendation
        Its model is the seed chosen on validation.

    Raises
    ------
    DataError
        Metrics are missing or ambiguous.
    """
    ranking = ranking_of(part, test_set)
    titles = titles_of(part.models)
    obstacles = _obstacles(part, test_set, ranking) if ranking.order else []
    names = [] if obstacles else ranking.recommendable
    if ranking.winner is not None:
        names = names[:1]
    model = _lowest_on_validation(part, names) if names else None
    return Recommendation(ranking, titles, obstacles, model)


def plain_text(markdown: str) -> str:
    """A verdict without the marks of Markdown, for the terminal."""
    return markdown.replace("**", "").replace("`", "")


def _obstacles(part: PartArtefacts, test_set: str, ranking: Ranking) -> list[str]:
    """Clauses on why a test cannot rank estimators: too few independent segments, and those of
    `cannot_rank`.
    """
    too_few = (
        f"the test ranges contain {ranking.n_blocks} independent segments of driving, and at "
        f"least {MIN_BLOCKS} are needed"
    )
    return [*([too_few] if ranking.n_blocks < MIN_BLOCKS else []), *cannot_rank(part, test_set)]


def _lowest_on_validation(part: PartArtefacts, names: Sequence[Name]) -> EvaluatedModel:
    """The model with the lowest RMSE(v) on validation among the chosen seeds of some estimators;
    one without such a metric counts as infinite.
    """
    runs = runs_of(part)
    groups = by_name(part.models)
    errors = list[tuple[float, EvaluatedModel]]()
    for name in names:
        seed = chosen_seed(sorted(model.seed for model in groups[name]), name, runs)
        error = value_of_run(runs, name, seed, VALIDATION, "rmse_vy")
        model = next(model for model in groups[name] if model.seed == seed)
        errors.append((error if math.isfinite(error) else math.inf, model))
    return min(errors, key=lambda pair: pair[0])[1]
