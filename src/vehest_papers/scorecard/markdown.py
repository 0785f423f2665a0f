"""Tables and sentences that both kinds of page show."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from vehest.report.style import significant
from vehest.report.template import fill_template
from vehest_papers.kit.block_rows import TrainingState
from vehest_papers.kit.claim_files import Claim
from vehest_papers.kit.verdict_table import (
    figure_in_words,
    figures_in_words,
    published_in_words,
    unit_of,
    without_line_breaks,
)
from vehest_papers.kit.verdicts import Judgement
from vehest_papers.scorecard.judged import Study

_OPEN_STATES: dict[TrainingState, str] = {
    "insufficient": "Still improved by twice the epochs",
    "not checked": "Not trained with twice the epochs yet",
}


def filled(template: Path, values: dict[str, object]) -> str:
    """A page of a template that has neither tables nor figures of a `Document`."""
    [text] = fill_template(template, values, [])
    assert isinstance(text, str)
    return f"{text}\n"


def table(headings: Sequence[str], rows: Iterable[Sequence[str]], n_text: int | None = None) -> str:
    """A Markdown table; columns from ``n_text`` on are numbers, aligned to the right."""
    n_text = len(headings) if n_text is None else n_text
    rule = [":--"] * n_text + ["--:"] * (len(headings) - n_text)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (headings, rule, *rows))


def escaped(text: str) -> str:
    """Text whose characters that Markdown would take for markup are escaped."""
    for character in "\\|*_<[":
        text = text.replace(character, f"\\{character}")
    return text


def sentence_of(claim: Claim) -> str:
    """A claim's sentence without line breaks."""
    return escaped(without_line_breaks(claim.claim))


def in_italics(text: str, is_provisional: bool) -> str:
    """Text in italics where a verdict is provisional."""
    return f"*{text}*" if is_provisional else text


def recommendation(study: Study) -> str:
    """Whether to use the method, with a note where verdicts that this rests on have changed."""
    text = escaped(without_line_breaks(study.paper.recommendation))
    changed = [
        f'"{sentence_of(claim)}" is *{study.claims[claim.id].verdict}* now'
        for claim in study.paper.claims
        if (verdicts := study.paper.rests_on.get(claim.id))
        and study.claims[claim.id].verdict not in verdicts
    ]
    if changed:
        return f"**This advice has to be revised:** {'; '.join(changed)}. It was: {text}"
    return text


def report_link(study: Study, results: Path, root: str) -> str:
    """Link to the report of the study after a separator; empty where it is not published."""
    report = Path(study.paper.study) / "report.md"
    if not (results / report).exists():
        return ""
    return f" · [report of the study]({root}{report.as_posix()})"


def evidence(study: Study, n_claims: int | None = None) -> str:
    """Table of the (first) claims that the recommendation rests on."""
    claims = {claim.id: claim for claim in study.paper.claims}
    n_seeds = study.n_seeds()
    rows = []
    for name in list(study.paper.rests_on)[:n_claims]:
        claim = claims[name]
        judgement = study.claims[name]
        verdict = in_italics(judgement.verdict, study.is_provisional(claim))
        if any(n_seeds.get(candidate) == 1 for candidate in claim.names):
            verdict += ", one seed"
        rows.append(
            (
                verdict,
                sentence_of(claim),
                ratio_published(claim),
                ratio_ours(claim, judgement),
                study.paper.parts[claim.part],
            )
        )
    return table(("verdict", "claim", "paper", "ours, 95 % interval", "data"), rows)


def open_questions(study: Study, names_in_words: Callable[[Sequence[str]], str]) -> str:
    """Which trainings make verdicts provisional or are missing; empty where none does."""
    sentences = []
    if provisional := study.provisional_claims:
        sentences.append(
            f"{len(provisional)} of {len(study.assessed_claims)} verdicts are provisional."
        )
        for state, words in _OPEN_STATES.items():
            if names := study.candidates(provisional, state):
                sentences.append(f"{words}: {names_in_words(names)}.")
    if single := [name for name, number in study.n_seeds().items() if number == 1]:
        sentences.append(
            f"Trained once, so that no claim on them is decided: {names_in_words(single)}."
        )
    not_assessed = [
        claim for claim in study.claims_of_paper if study.claims[claim.id].verdict == "not assessed"
    ]
    if not_assessed:
        sentences.append(f"{len(not_assessed)} claims are not assessed.")
        if names := study.candidates(not_assessed, "not trained"):
            sentences.append(f"Not trained yet: {names_in_words(names)}.")
    return " ".join(sentences)


def ratio_published(claim: Claim) -> str:
    """The paper's ratio of two errors; where it has none, what else it states."""
    ratio = claim.published_ratio
    return published_in_words(claim, escaped) if ratio is None else significant(ratio)


def ratio_ours(claim: Claim, judgement: Judgement) -> str:
    """Our ratio of two pooled errors, and of an order the mean of its blocks' ratios; of a claim
    about a value that value.
    """
    if judgement.size is None:
        return figures_in_words(judgement, unit_of(claim), escaped)
    words = figure_in_words(judgement.size)
    if judgement.order is not None:
        words += f"<br>by block {figure_in_words(judgement.order)}"
    return words
