"""The four papers on one page: what each claims and tabulates, beside ours (`make scorecard`).

Made of claims.yaml, results/STUDY/tables/blocks.csv and training.csv alone: no model and no
recording is needed.
"""

from __future__ import annotations

import argparse
import csv
import io
import math
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vehest.data.errors import DataError, VehestError
from vehest.data.text_files import read_rows
from vehest.report.style import MISSING, significant
from vehest_papers.kit.block_errors import (
    TRAINING_STATES,
    BlockErrors,
    Key,
    Training,
    read_blocks,
    read_training,
)
from vehest_papers.kit.claim_files import (
    CLAIMS_FOLDER,
    Claim,
    Paper,
    Row,
    Table,
    read_paper,
)
from vehest_papers.kit.verdict_table import (
    epochs_in_words,
    figure_in_words,
    figures_in_words,
    published_in_words,
    unit_of,
    without_line_breaks,
)
from vehest_papers.kit.verdicts import (
    NOT_PUBLISHED,
    VERDICTS,
    Figure,
    Judgement,
    judge_paper,
    judge_row,
    least_training,
)

DATA_KINDS = ("real", "simulated", "computed")
PAPERS = ("ksnn", "learned_ukf", "heavy_ekf", "cnn_ukf")
TITLES = {
    "ksnn": "KS-NN",
    "learned_ukf": "Learned UKF",
    "heavy_ekf": "Heavy-vehicle EKF",
    "cnn_ukf": "CNN-UKF",
}
CSV_COLUMNS = (
    "paper",
    "row",
    "id",
    "text",
    "source",
    "data",
    "part",
    "test_set",
    "metric",
    "published",
    "ours",
    "published_ratio",
    "size",
    "size_low",
    "size_high",
    "order",
    "order_low",
    "order_high",
    "p_value",
    "blocks",
    "seeds",
    "diverged",
    "power",
    "blocks_needed",
    "training",
    "epochs",
    "epochs_paper",
    "verdict",
    "reason",
)
LEGEND = (
    (
        "NNTF_UH, RATTE, …",
        "the papers' names of their methods, described at the beginning of each paper's section",
    ),
    ("published", "value of the paper"),
    (
        "ours",
        "the same error of our run with its 95 % interval; the data are marked as real or "
        "simulated",
    ),
    (
        "metric",
        "`fvu`: share of the variance of v that is not explained; `rmse_vy` [m/s], "
        "`rmse_sideslip` [deg] and the others: [metrics](../docs/evaluation.md#metrics)",
    ),
    (
        "mean of blocks' ratios",
        "error of the first candidate of a claim over that of the second within each manoeuvre, "
        "lap or segment (a block), averaged with the same weight for each; below 1 the first one "
        "is better. It decides whether a difference is significant",
    ),
    (
        "ratio",
        "the same for all samples together; it is compared with the size that the paper states",
    ),
    ("epochs", "of our training, of the paper's, and whether ours has been shown to be sufficient"),
    (
        "verdict",
        "from the errors by block and seed ([definitions, and how often they are "
        "right](../docs/scorecard.md)); in *italics* where the training has not been shown to be "
        "sufficient",
    ),
    (
        "verdict on a value of a table",
        "agrees: the 90 % interval of ours lies within ±10 % of the published value; lower, "
        "higher: it lies outside; else inconclusive. Where ours are other data than the paper's, "
        "a difference says nothing against the method",
    ),
)
"""Columns of the page's tables and what they hold."""


@dataclass(frozen=True)
class Study:
    """A paper with its judged claims and table rows."""

    paper: Paper
    training: Mapping[str, Training]
    claims: Mapping[str, Judgement]  # id -> judgement
    rows: Sequence[tuple[Table, Row, Judgement]]
    is_published: bool  # whether there are errors by block

    @property
    def claims_of_paper(self) -> list[Claim]:
        """Claims without the comparisons that we added."""
        return [claim for claim in self.paper.claims if not claim.is_added]

    def counts(self) -> Counter[str]:
        """Verdict -> number of the paper's claims."""
        return Counter(self.claims[claim.id].verdict for claim in self.claims_of_paper)

    def provisional_counts(self) -> Counter[str]:
        """Verdict -> number of the paper's claims whose training was not shown to suffice."""
        return Counter(
            self.claims[claim.id].verdict
            for claim in self.claims_of_paper
            if _is_provisional(self.claims[claim.id], least_training(claim, self.training)[1])
        )

    def counts_of_data(self) -> Counter[str]:
        """Data -> number of the paper's claims that errors by block on these data decide."""
        return Counter(
            self.paper.parts[claim.part]
            for claim in self.claims_of_paper
            if self.claims[claim.id].n_blocks
        )

    def counts_of_training(self) -> Counter[str]:
        """Training -> number of the paper's claims that errors by block decide."""
        return Counter(
            state.state if state is not None else "not applicable"
            for claim in self.claims_of_paper
            if self.claims[claim.id].n_blocks
            for _, state in [least_training(claim, self.training)]
        )


def read_study(name: str, results: Path, claims_folder: Path = CLAIMS_FOLDER) -> Study:
    """Read a paper's claims and the errors by block of its study, and judge them."""
    paper = read_paper(claims_folder / name / "claims.yaml")
    tables = results / paper.study / "tables"
    blocks: dict[Key, BlockErrors] | None = None
    if (tables / "blocks.csv").exists():
        blocks = read_blocks(tables / "blocks.csv")
    training: dict[str, Training] = {}
    if (tables / "training.csv").exists():
        training = read_training(tables / "training.csv")
    rows = [
        (table, row, judge_row(row, table, blocks, training))
        for table in paper.tables
        for row in table.rows
    ]
    return Study(paper, training, judge_paper(paper, blocks, training), rows, blocks is not None)


def scorecard_files(results: Path, claims_folder: Path = CLAIMS_FOLDER) -> dict[str, str]:
    """Content of scorecard.md, scorecard.csv and scorecard/changed_verdicts.csv, as they belong
    into ``results``.
    """
    studies = [read_study(name, results, claims_folder) for name in PAPERS]
    before = claims_folder / "claims_before.csv"
    return {
        "scorecard.md": _page(studies, results),
        "scorecard.csv": _csv(CSV_COLUMNS, [row for study in studies for row in _csv_rows(study)]),
        "scorecard/changed_verdicts.csv": _csv(*_changes(studies, before)),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the scorecard; with ``--check`` exit with 1 where it is not what the committed inputs
    give.
    """
    parser = argparse.ArgumentParser(description=__doc__)
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


def _page(studies: Sequence[Study], results: Path) -> str:
    lines = [
        "# Scorecard: published and ours",
        "",
        "Four papers on the estimation of lateral velocity and sideslip angle, beside our runs "
        "of their methods in vehest:",
        "first whether to use each method, then how many claims of its paper were reproduced, "
        "then every table row and",
        "claim with the published value and ours.",
        "",
        "## Should I use this method?",
        "",
        *_table(
            ("paper", "answer"),
            [
                (_linked(study), without_line_breaks(study.paper.recommendation))
                for study in studies
            ],
        ),
        "",
        "## How to read the tables",
        "",
        *_table(("column or name", "meaning"), LEGEND, n_text=2),
        "",
        "## Verdicts on the papers' claims",
        "",
        *_table_of_counts(
            studies,
            "verdict",
            VERDICTS,
            [study.counts() for study in studies],
            [study.provisional_counts() for study in studies],
        ),
        "",
        "*Provisional*: the training of a candidate was not checked or is insufficient (see below).",
        f"*Not assessed*: {NOT_PUBLISHED}, or not of this candidate.",
        "",
        "Data that decided the claims; simulated drives stand in for recordings that are not "
        "public:",
        "",
        *_table_of_counts(
            studies, "data", DATA_KINDS, [study.counts_of_data() for study in studies]
        ),
        "",
        "Training of the least trained candidate of each claim that was assessed:",
        "",
        *_table_of_counts(
            studies,
            "training",
            [state for state in TRAINING_STATES[::-1] if state != "not trained"],
            [study.counts_of_training() for study in studies],
        ),
        "",
    ]
    for study in studies:
        lines += _section(study, results)
    return "\n".join([*lines, *_section_of_planted_truth(results)])


def _table_of_counts(
    studies: Sequence[Study],
    heading: str,
    words: Sequence[str],
    counts: Sequence[Counter[str]],
    provisional: Sequence[Counter[str]] | None = None,
) -> list[str]:
    """Number of claims of each paper, a row a word, with their sum; of these, provisional ones."""
    rows = [
        (
            word,
            *(
                _counted(n_claims[word], n_provisional[word])
                for n_claims, n_provisional in zip(
                    counts, provisional or [Counter()] * len(counts), strict=True
                )
            ),
        )
        for word in words
    ]
    rows.append(("all", *(str(number.total()) for number in counts)))
    return _table((heading, *(_linked(study) for study in studies)), rows, n_text=1)


def _counted(n_claims: int, n_provisional: int) -> str:
    if not n_claims:
        return MISSING
    return f"{n_claims} ({n_provisional} provisional)" if n_provisional else str(n_claims)


def _section(study: Study, results: Path) -> list[str]:
    paper = study.paper
    report = results / paper.study / "report.md"
    link = f" [Report of the study]({paper.study}/report.md)." if report.exists() else ""
    lines = [
        f"## {TITLES[paper.paper]}",
        "",
        f"{without_line_breaks(paper.reference)}. [doi:{paper.doi}](https://doi.org/{paper.doi}).{link}",
        "",
        f"**{without_line_breaks(paper.recommendation)}**",
        "",
    ]
    if not study.is_published:
        lines += [f"Not assessed yet: {NOT_PUBLISHED}.", ""]
    lines += [f"### Methods of {TITLES[paper.paper]}", ""]
    lines += _table(
        ("name", "method"),
        [
            (_text(name), _text(without_line_breaks(declared.description)))
            for name, declared in paper.candidates.items()
        ],
        n_text=2,
    )
    lines.append("")
    for table in paper.tables:
        lines += _section_of_table(study, table)
    lines += [f"### Claims of {TITLES[paper.paper]}", ""]
    lines += _table_of_claims(study, study.claims_of_paper)
    if added := [claim for claim in paper.claims if claim.is_added]:
        lines += [f"### Beside the paper: {TITLES[paper.paper]}", ""]
        lines += ["Comparisons that the paper does not make; they are in no count above.", ""]
        lines += _table_of_claims(study, added)
    return lines


def _section_of_table(study: Study, table: Table) -> list[str]:
    origin = study.paper.parts[table.part]
    cells = []
    for of, row, judgement in study.rows:
        if of is not table:
            continue
        state = study.training.get(row.candidate)
        structure = f" ({row.structure})" if row.structure else ""
        unit = "" if row.unit == "1" else f" {row.unit}"
        cells.append(
            (
                _text(row.candidate + structure),
                f"`{row.metric}`",
                f"{significant(row.published)}{unit}",
                figures_in_words(judgement, unit, _text),
                epochs_in_words(study.paper, row.candidate, state),
                _in_italics(_of_value(judgement, row.published), judgement, state),
            )
        )
    about = without_line_breaks(study.paper.test_sets[table.test_set])
    note = f" {without_line_breaks(table.note)}" if table.note else ""
    return [
        f"### {table.table}, {TITLES[study.paper.paper]}: {table.test_set} ({table.part})",
        "",
        f"Ours: {origin}. {_text(about)}.{note}",
        "",
        *_table(
            (
                "candidate",
                "metric",
                "published",
                "ours, 95 % interval",
                "epochs ours / paper",
                "verdict",
            ),
            cells,
        ),
        "",
    ]


def _section_of_planted_truth(results: Path) -> list[str]:
    """Rates of verdicts on simulated studies, as `vehest_papers.planted_truth` found them."""
    path = results / "scorecard" / "planted_truth.csv"
    headings = {
        "design": "blocks",
        "seeds": "seeds",
        "truth": "truth",
        "wrong": "wrong",
        "reproduced": "reproduced",
        "direction only": "direction only",
        "contradicted": "contradicted",
        "no significant difference": "no significant difference",
        "size_covered": "size in interval",
        "wrong_equality": "wrong of equality",
    }
    rows = read_rows(path, tuple(headings))
    cells = [[_text(row[name]) for name in headings] for row in rows]
    return [
        "## How often these verdicts are right",
        "",
        f"Per cent of {rows[0]['studies']} simulated studies each, made of real errors",
        "([how](../docs/scorecard.md#how-often-the-verdicts-are-right)). Wrong: any significant "
        "difference where there",
        "is no effect, else the wrong direction; of an equality within ±10 %, contradicted where "
        "it is true or",
        "reproduced where it is not. Nominal: at most 5 % wrong without effect, 95 % of sizes in "
        "their interval. The",
        "rows with one seed show why a candidate that was trained once gets no verdict. "
        "*Reproduced* excludes that there",
        "is no effect, not that the effect is half the paper's: the interval of the size shows "
        "what is excluded.",
        "",
        *_table(list(headings.values()), cells, n_text=3),
        "",
    ]


def _table_of_claims(study: Study, claims: Iterable[Claim]) -> list[str]:
    cells = []
    for claim in claims:
        judgement = study.claims[claim.id]
        name, state = least_training(claim, study.training)
        origin = study.paper.parts.get(claim.part, "") if claim.not_testable is None else ""
        reason = "" if judgement.reason == NOT_PUBLISHED else _text(judgement.reason)
        cells.append(
            (
                f"{_text(without_line_breaks(claim.claim))} ({_text(claim.source)})",
                published_in_words(claim, _text),
                figures_in_words(judgement, unit_of(claim), _text),
                f"{origin}, {claim.test_set}" if origin else MISSING,
                epochs_in_words(study.paper, name, state),
                _in_italics(judgement.verdict, judgement, state),
                reason or MISSING,
            )
        )
    headings = (
        "claim",
        "published",
        "ours, 95 % interval",
        "data",
        "epochs ours / paper",
        "verdict",
        "why",
    )
    return [*_table(headings, cells), ""]


def _in_italics(verdict: str, judgement: Judgement, training: Training | None) -> str:
    """The verdict, in italics where the training of a network was not shown to suffice."""
    return f"*{verdict}*" if _is_provisional(judgement, training) else verdict


def _is_provisional(judgement: Judgement, training: Training | None) -> bool:
    is_assessed = judgement.n_blocks > 0
    is_sufficient = training is None or training.state in ("sufficient", "not applicable")
    return is_assessed and not is_sufficient


def _of_value(judgement: Judgement, published: float) -> str:
    """The verdict on a table's value in words of its own: a difference on other data than the
    paper's contradicts no claim.
    """
    ours = next(iter(judgement.values.values()), None)
    if judgement.verdict == "reproduced":
        return "agrees"
    if judgement.verdict == "contradicted" and ours is not None:
        return "lower" if ours.value < published else "higher"
    return judgement.verdict


def _csv_rows(study: Study) -> list[dict[str, str]]:
    rows = []
    for table, row, judgement in study.rows:
        claim = Claim(
            "",
            f"{row.candidate} {row.structure}".strip(),
            table.table,
            candidate=row.candidate,
            part=table.part,
            test_set=table.test_set,
            metric=row.metric,
            published={row.candidate: row.published},
        )
        of_value = {"row": "table", "verdict": _of_value(judgement, row.published)}
        rows.append(_csv_row(study, claim, judgement) | of_value)
    for claim in study.paper.claims:
        rows.append(_csv_row(study, claim, study.claims[claim.id]))
    return rows


def _csv_row(study: Study, claim: Claim, judgement: Judgement) -> dict[str, str]:
    name, state = least_training(claim, study.training)
    declared = study.paper.candidates.get(name)
    of_paper = "" if declared is None or declared.epochs_paper is None else declared.epochs_paper
    return {
        "paper": study.paper.paper,
        "row": "added comparison" if claim.is_added else "claim",
        "id": claim.id,
        "text": without_line_breaks(claim.claim),
        "source": claim.source,
        "data": study.paper.parts.get(claim.part, ""),
        "part": claim.part,
        "test_set": claim.test_set,
        "metric": claim.metric,
        "published": "; ".join(f"{name} {value}" for name, value in claim.published.items()),
        "ours": "; ".join(
            f"{name} {figure_in_words(figure)}" for name, figure in judgement.values.items()
        ),
        "published_ratio": _number(claim.published_ratio),
        **_ends("size", judgement.size),
        **_ends("order", judgement.order),
        "p_value": _number(judgement.p_value),
        "blocks": str(judgement.n_blocks or ""),
        "seeds": " ".join(str(number) for number in (judgement.n_seeds or {}).values()),
        "diverged": " ".join(str(number) for number in (judgement.diverged or {}).values()),
        "power": _number(judgement.power),
        "blocks_needed": str(judgement.blocks_needed or ""),
        "training": state.state if state is not None else "not applicable",
        "epochs": state.epochs if state is not None else "",
        "epochs_paper": str(of_paper),
        "verdict": judgement.verdict,
        "reason": judgement.reason,
    }


def _ends(name: str, figure: Figure | None) -> dict[str, str]:
    values = (None, None, None) if figure is None else (figure.value, figure.low, figure.high)
    keys = (name, f"{name}_low", f"{name}_high")
    return {key: _number(value) for key, value in zip(keys, values, strict=True)}


def _number(value: float | None) -> str:
    return "" if value is None or not math.isfinite(value) else f"{value:.4g}"


def _changes(studies: Sequence[Study], before: Path) -> tuple[Sequence[str], list[dict[str, str]]]:
    """Claims as they were judged before this engine, with their verdicts now."""
    columns = ("paper", "old_claim", "data", "old_verdict", "id", "verdict", "reason", "mapping")
    judged = {
        (study.paper.paper, name): judgement
        for study in studies
        for name, judgement in study.claims.items()
    }
    rows = []
    for row in read_rows(before, ("paper", "old_claim", "data", "verdict", "id", "reason")):
        ids = [] if row["id"] == "removed" else row["id"].split()
        missing = [name for name in ids if (row["paper"], name) not in judged]
        if missing:
            raise DataError(
                f"'{before}': {row['paper']} has no claim {missing[0]!r}; write an id of claims.yaml"
            )
        now = [judged[row["paper"], name] for name in ids]
        rows.append(
            {
                "paper": row["paper"],
                "old_claim": row["old_claim"],
                "data": row["data"],
                "old_verdict": row["verdict"],
                "id": row["id"],
                "verdict": "; ".join(judgement.verdict for judgement in now) or "removed",
                "reason": "; ".join(dict.fromkeys(judgement.reason for judgement in now)),
                "mapping": row["reason"],
            }
        )
    return columns, rows


def _csv(columns: Sequence[str], rows: Sequence[Mapping[str, str]]) -> str:
    stream = io.StringIO(newline="")
    writer = csv.DictWriter(stream, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def _table(
    headings: Sequence[str], rows: Iterable[Sequence[str]], n_text: int | None = None
) -> list[str]:
    """A Markdown table; columns from ``n_text`` on are numbers, aligned to the right."""
    n_text = len(headings) if n_text is None else n_text
    rule = [":--"] * n_text + ["--:"] * (len(headings) - n_text)
    return [f"| {' | '.join(cells)} |" for cells in (headings, rule, *rows)]


def _linked(study: Study) -> str:
    title = TITLES[study.paper.paper]
    return f"[{title}](#{title.lower().replace(' ', '-')})"


def _text(text: str) -> str:
    """Text of a cell: characters that Markdown would take for markup are escaped."""
    for character in "\\|*_<[":
        text = text.replace(character, f"\\{character}")
    return text


if __name__ == "__main__":
    main()
