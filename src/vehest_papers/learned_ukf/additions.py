"""Comparisons that were added after the tests had been seen for the other methods; their rules stand in docs/learned_ukf.md.

- **A difference** is that of mean weighted MSE over seeds and sequences, by the paired block bootstrap of `errors`. Where seeds of one
  number share initial weights and pre-training they are compared seed by seed. All differences of a test are corrected together by Holm.
- **A claim** on several tests is reproduced if each corrected interval lies below zero, not reproduced if one lies above, else undecided.
- **Local minima**: of trainings from scratch those count whose validation loss is kept above that of every pre-trained seed, and those
  that gave up; reproduced if at least half do, not reproduced if none does, else undecided.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import stats

from vehest.constants import FloatArray
from vehest.data.splits import VALIDATION
from vehest.evaluation.significance import CONFIDENCE, Interval
from vehest.report.document import Column, Table
from vehest.report.style import fixed
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest_papers.kit import statements
from vehest_papers.kit.claims import Claim, Verdict, verdict_below, verdict_of_all
from vehest_papers.kit.reading import lengths_of, median_and_range, metric_values, with_interval
from vehest_papers.learned_ukf.candidates import SETS, losses, models_by_candidate
from vehest_papers.learned_ukf.errors import Losses


@dataclass(frozen=True, eq=False)
class Subject:
    """One candidate of one part."""

    title: str  # in the report
    part: PartArtefacts  # it belongs to
    models: Sequence[EvaluatedModel]  # its seeds, in order
    errors: Mapping[str, Losses]  # test set -> losses of the part
    candidate: str  # what the part calls it

    @classmethod
    def of(
        cls,
        part: PartArtefacts,
        candidate: str,
        title: str = "",
        errors: Mapping[str, Losses] | None = None,
    ) -> Subject:
        """A candidate of a part, whose losses are read unless they are given."""
        found = errors or {test: losses(part, test) for test in SETS}
        return cls(title or candidate, part, models_by_candidate(part)[candidate], found, candidate)

    @property
    def seeds(self) -> list[int]:
        """Of its trainings."""
        return [model.seed for model in self.models]

    def squared(self, test: str, seeds: Sequence[int] | None = None) -> FloatArray:
        """Weighted squared errors of all seeds, or of some, at every scored sample, (S, K)."""
        own = self.errors[test].squared[self.candidate]
        return own if seeds is None else own[[self.seeds.index(seed) for seed in seeds]]

    def validation(self) -> FloatArray:
        """Weighted MSE on the validation range, one a seed."""
        known = metric_values(self.part)
        return np.array(
            [
                known[(own.estimator, own.variant, own.seed, VALIDATION, "mse_weighted")]
                for own in self.models
            ]
        )


@dataclass(frozen=True)
class Comparison:
    """One candidate against another."""

    lower: Subject  # the one that is claimed to have the lower error
    higher: Subject  # the other one
    claim: str = (
        ""  # in a few words; empty where the paper claims nothing, and only the difference is shown
    )
    paper: str = ""  # its words or figures
    tests: Sequence[str] = tuple(SETS)  # on which
    shared: bool = True  # whether seeds of one number share initial weights and pre-training, so that they are compared seed by seed

    def difference(self, test: str) -> Interval:
        """Of the weighted MSE on a test."""
        errors = self.lower.errors[test]
        if not self.shared:
            return errors.difference(self.lower.squared(test), self.higher.squared(test))
        seeds = self.common
        return errors.mean(self.lower.squared(test, seeds) - self.higher.squared(test, seeds))

    @property
    def common(self) -> list[int]:
        """Seeds that both have."""
        return [seed for seed in self.lower.seeds if seed in self.higher.seeds]

    def means(self, test: str) -> tuple[float, float]:
        """Weighted MSE of both over the seeds that are compared."""
        seeds = self.common if self.shared else None
        return float(self.lower.squared(test, seeds).mean()), float(
            self.higher.squared(test, seeds).mean()
        )


Corrected = dict[tuple[int, str], tuple[float, float, float]]
"""(place of a comparison, test set) -> difference and the ends of its interval after Holm's correction."""


def corrected(comparisons: Sequence[Comparison]) -> Corrected:
    """Differences of all comparisons, corrected by Holm within each test."""
    found: Corrected = {}
    for test in SETS:
        places = [place for place, own in enumerate(comparisons) if test in own.tests]
        intervals = statements.corrected([comparisons[place].difference(test) for place in places])
        found |= {
            (place, test): (own.value, own.low, own.high)
            for place, (own, _) in zip(places, intervals, strict=True)
        }
    return found


def comparison_claims(
    comparisons: Sequence[Comparison], found: Corrected, data: str
) -> list[Claim]:
    """A claim each, but for those that only show a difference."""
    claims = []
    for place, own in enumerate(comparisons):
        if not own.claim:
            continue
        words = []
        verdicts = []
        for test in own.tests:
            value, low, high = found[place, test]
            verdicts.append(verdict_below(low, high))
            tyre = f"{SETS[test]}: " if len(own.tests) > 1 else ""
            words.append(
                f"{tyre}{' and '.join(fixed(mean, 4) for mean in own.means(test))}, {with_interval(value, low, high, 4)}"
            )
        verdict = verdict_of_all(verdicts)
        why = {
            "reproduced": "below zero",
            "not reproduced": "above zero",
            "undecided": "holds zero",
        }[verdict]
        where = f"{data}, {SETS[own.tests[0]]}" if len(own.tests) == 1 else data
        claims.append(Claim(own.claim, own.paper, "; ".join(words), where, verdict, why))
    return claims


def minima_claim(scratch: Subject, trained: Subject, data: str, share: float) -> Claim:
    """That trainings from scratch end in local minima, by their validation losses."""
    limit = float(trained.validation().max())
    k = int((scratch.validation() > limit).sum())
    n = len(scratch.seeds)
    ends = stats.binomtest(k, n).proportion_ci(CONFIDENCE)
    verdict: Verdict = (
        "not reproduced" if not k else "reproduced" if 2 * k >= n and share >= 1.0 else "undecided"
    )
    ours = f"{k} of {n} seeds, {100 * k / n:.0f} % [{100 * ends.low:.0f}, {100 * ends.high:.0f}]"
    why = f"validation MSE above {fixed(limit, 4)}, the worst of {len(trained.seeds)} pre-trained"
    why += f"; {100 * share:.0f} % of their samples" if share < 1.0 else ""
    return Claim(
        "from scratch is prone to local minima",
        "Section III-B",
        ours,
        f"{data}, validation",
        verdict,
        why,
    )


def differences_table(
    comparisons: Sequence[Comparison], found: Corrected, name: str, data: str
) -> Table:
    """Every comparison on every test, with the means that it compares."""
    rows: list[dict[str, object]] = []
    for place, own in enumerate(comparisons):
        for test in own.tests:
            value, low, high = found[place, test]
            one, other = own.means(test)
            row: dict[str, object] = {
                "lower": own.lower.title,
                "higher": own.higher.title,
                "tyre": SETS[test],
            }
            row |= {
                "mse_lower": one,
                "mse_higher": other,
                "difference": value,
                "low": low,
                "high": high,
            }
            row["words"] = with_interval(value, low, high, 4)
            row["change"] = 100.0 * value / other
            row["seeds"] = (
                f"{len(own.common)}, paired"
                if own.shared
                else f"{len(own.lower.seeds)} and {len(own.higher.seeds)}"
            )
            rows.append(row)
    columns = {
        "lower": Column("first"),
        "higher": Column("second"),
        "tyre": Column("tyre"),
        "mse_lower": Column("MSE, first", decimals=4),
        "mse_higher": Column("MSE, second", decimals=4),
        "words": Column("difference [95 % interval]"),
        "change": Column("of the second [%]", decimals=0),
        "seeds": Column("seeds"),
    }
    caption = (
        f"Comparisons that were added after the tests had been seen for the other methods: weighted MSE, intervals of the differences "
        f"corrected by Holm within each tyre. Paired: seeds share initial weights and pre-training. Data: {data}."
    )
    return Table(f"additions_{name}", caption, pd.DataFrame(rows), columns)


def budgets_table(subjects: Sequence[Subject], name: str, data: str) -> Table:
    """What each of the subjects learnt from, and how far it came on the validation range."""
    rows: list[dict[str, object]] = []
    for own in subjects:
        training = own.models[0].training
        through = training["through" if own.models[0].variant.find("_u") >= 0 else "noise"][
            "max_epochs"
        ]
        losses_of = own.validation()
        row: dict[str, object] = {"title": own.title, "seeds": len(own.seeds)}
        row |= {"one_step": int(training["one_step"]["max_epochs"]), "through": int(through)}
        row |= {"steps": int(training["steps"]), "batch": int(training["batch_size"])}
        row["step_size"] = float(training["through"]["learning_rate"])
        row["samples"] = samples_seen(own)
        row["validation"] = median_and_range(losses_of, 4)
        row |= {
            f"validation_seed_{seed}": float(loss)
            for seed, loss in zip(own.seeds, losses_of, strict=True)
        }
        rows.append(row)
    columns = {
        "title": Column("candidate"),
        "seeds": Column("seeds", decimals=0),
        "one_step": Column("epochs, one-step", decimals=0),
        "through": Column("epochs, through the filter", decimals=0),
        "steps": Column("samples of a sequence", decimals=0),
        "batch": Column("sequences in a batch", decimals=0),
        "step_size": Column("step size through the filter", digits=1, each=True),
        "samples": Column("samples learnt from in all", decimals=0),
        "validation": Column("MSE, validation"),
    }
    caption = (
        f"What the candidates of these comparisons learnt from: samples count each time one is seen, one-step and through the filter. "
        f"Validation: weighted MSE on tyre A, run 0, median and range of seeds. Data: {data}."
    )
    return Table(f"additions_budget_{name}", caption, pd.DataFrame(rows), columns)


def samples_seen(own: Subject) -> int:
    """Samples that a seed learns from, each counted as often as it is seen: pairs one-step, sequences through the filter."""
    training = own.models[0].training
    drives = lengths_of(own.part, own.part.split.train)
    through = training["through" if own.models[0].variant.find("_u") >= 0 else "noise"]
    steps = int(training["steps"])
    pairs = sum(length - 1 for length in drives)
    samples = sum(length // steps * steps for length in drives)
    return int(training["one_step"]["max_epochs"]) * pairs + int(through["max_epochs"]) * samples
