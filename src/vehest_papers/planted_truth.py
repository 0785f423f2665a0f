"""How often the engine's verdicts are right: studies of which the truth is known, made of real
errors (`make planted_truth`).

The material is `results/scorecard/error_traces.csv`: squared errors of the lateral velocity over
each second of a real drive, of 30 networks of two kinds, autocorrelated and heavy-tailed. A
simulated study compares two candidates. Its drive is put together from stretches of the real one;
in each of them a coin decides which candidate takes the errors of recurrent networks and which
those of KS-NN, all of different trainings. By this symmetry neither candidate is better; the first
one's errors are then multiplied by the ratio that is planted.
"""

from __future__ import annotations

import argparse
import csv
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import MissingError
from vehest.data.text_files import number_in, read_rows
from vehest.evaluation.blocks import COLUMNS, Segments, block_labels, block_sums, read_segments
from vehest_papers.kit.block_errors import BlockErrors, Key
from vehest_papers.kit.claim_files import Claim, Paper
from vehest_papers.kit.verdicts import judge_paper

SEED = 52
N_STUDIES = 1000
PAPER_RATIO = 0.8  # of the two candidates' RMSE, in the paper that is simulated
KINDS = (("gru", "lstm"), ("ksnn",))  # families of which the two kinds of networks are
TEST_SETS = ("validation", "test")
DRIVE_SECONDS = 300
STRETCH_SECONDS = 20  # mean length, several times that over which errors are correlated
MANOEUVRE_SECONDS = 10
TRUTHS = {
    "no effect": 1.0,
    "the paper's effect": PAPER_RATIO,
    "half of it": math.sqrt(PAPER_RATIO),
}


@dataclass(frozen=True, eq=False)
class Traces:
    """Squared errors of trained networks on the same seconds of real drives."""

    kinds: tuple[FloatArray, FloatArray]  # (networks, seconds) of recurrent networks, of KS-NN
    run: NDArray[np.int64]  # uninterrupted range that each second belongs to


@dataclass(frozen=True)
class Design:
    """How many blocks a simulated study has, and what they are."""

    name: str
    draw: Callable[[NDArray[np.int64], np.random.Generator], tuple[NDArray[np.int64], FloatArray]]
    has_pieces: bool  # whether each stretch is a manoeuvre of its own, and so a block


def draw_drive(
    run: NDArray[np.int64], rng: np.random.Generator
) -> tuple[NDArray[np.int64], FloatArray]:
    """Seconds of a drive of `DRIVE_SECONDS` in segments of random length, and their segments."""
    seconds: list[int] = []
    stretches: list[float] = []
    while len(seconds) < DRIVE_SECONDS:
        stretch = _stretch(run, int(rng.geometric(1.0 / STRETCH_SECONDS)), rng)
        stretches += [float(stretches[-1] + 1.0 if stretches else 0.0)] * len(stretch)
        seconds += stretch
    return np.array(seconds[:DRIVE_SECONDS]), np.array(stretches[:DRIVE_SECONDS])


def draw_manoeuvres(
    number: int,
) -> Callable[[NDArray[np.int64], np.random.Generator], tuple[NDArray[np.int64], FloatArray]]:
    """Draws ``number`` manoeuvres of `MANOEUVRE_SECONDS`."""

    def draw(
        run: NDArray[np.int64], rng: np.random.Generator
    ) -> tuple[NDArray[np.int64], FloatArray]:
        seconds = [_stretch(run, MANOEUVRE_SECONDS, rng) for _ in range(number)]
        return np.concatenate(seconds), np.repeat(np.arange(number), MANOEUVRE_SECONDS).astype(
            float
        )

    return draw


DESIGNS = (
    Design("one drive of 300 s", draw_drive, False),
    Design("8 manoeuvres of 10 s", draw_manoeuvres(8), True),
    Design("24 manoeuvres of 10 s", draw_manoeuvres(24), True),
)


def _stretch(run: NDArray[np.int64], length: int, rng: np.random.Generator) -> list[int]:
    """Consecutive seconds of one run, at most as many as it has."""
    begin = int(rng.integers(len(run)))
    of_run = np.flatnonzero(run == run[begin])
    length = min(length, len(of_run))
    begin = min(begin, int(of_run[-1]) + 1 - length)
    return list(range(begin, begin + length))


def simulate_study(
    traces: Traces, design: Design, n_seeds: int, ratio: float, rng: np.random.Generator
) -> tuple[dict[Key, BlockErrors], int]:
    """Errors by block of one study in which the first candidate has ``ratio`` times the RMSE of the
    second.

    Returns
    -------
    errors : dict
    n_blocks : int
    """
    seconds, stretch = design.draw(traces.run, rng)
    drawn = [kind[rng.permutation(len(kind))[: 2 * n_seeds]][:, seconds] for kind in traces.kinds]
    is_swapped = (rng.random(int(stretch[-1]) + 1) < 0.5)[stretch.astype(int)]
    first = np.where(is_swapped, drawn[0][:n_seeds], drawn[1][:n_seeds]) * ratio**2
    second = np.where(is_swapped, drawn[1][n_seeds:], drawn[0][n_seeds:])
    columns = {name: np.zeros(len(seconds)) for name in COLUMNS}
    columns["piece"] = stretch if design.has_pieces else np.zeros(len(seconds))
    segments = Segments(**columns)
    labels = block_labels(segments, np.stack([first.mean(axis=0), second.mean(axis=0)]))
    sizes = block_sums(np.ones(len(seconds)), labels)
    names = tuple(str(number) for number in range(len(sizes)))
    seeds = tuple(str(seed) for seed in range(n_seeds))
    return {
        Key("real", name, "test", "rmse_vy"): BlockErrors(
            seeds, names, block_sums(losses, labels), sizes
        )
        for name, losses in (("first", first), ("second", second))
    }, len(sizes)


def claims_of_simulated_paper() -> Paper:
    """An order with its size, and an equality."""
    order = Claim(
        "order",
        "the first has the lower RMSE",
        "Table I",
        kind="order",
        candidate="first",
        other="second",
        direction="lower",
        part="real",
        test_set="test",
        metric="rmse_vy",
        ratio=PAPER_RATIO,
    )
    equal = replace(order, id="equal", kind="equal", direction=None, ratio=None)
    return Paper("", "", "", "", "", {}, {}, {}, [order, equal], [])


def rates(
    traces: Traces, design: Design, n_seeds: int, truth: str, n_studies: int
) -> dict[str, str]:
    """Verdicts on simulated studies: a row of the table, rates in per cent."""
    ratio = TRUTHS[truth]
    cell = [DESIGNS.index(design), n_seeds, list(TRUTHS).index(truth)]
    rng = np.random.default_rng([SEED, *cell])
    paper = claims_of_simulated_paper()
    verdicts = Counter[str]()
    equalities = Counter[str]()
    n_covered = 0
    n_blocks = []
    for _ in range(n_studies):
        blocks, number = simulate_study(traces, design, n_seeds, ratio, rng)
        n_blocks.append(number)
        judged = judge_paper(paper, blocks, {})
        verdicts[judged["order"].verdict] += 1
        equalities[judged["equal"].verdict] += 1
        size = judged["order"].size
        n_covered += size is not None and size.low <= ratio <= size.high
    wrong = ["contradicted"]
    if truth == "no effect":
        wrong += ["reproduced", "direction only"]
    wrong_equality = "contradicted" if ratio >= 1.0 - 0.1 else "reproduced"
    counts = {
        "wrong": sum(verdicts[name] for name in wrong),
        **{
            name: verdicts[name]
            for name in (
                "reproduced",
                "direction only",
                "contradicted",
                "no significant difference",
            )
        },
        "size_covered": n_covered,
        "wrong_equality": equalities[wrong_equality],
    }
    return {
        "design": design.name,
        "seeds": str(n_seeds),
        "truth": truth,
        "ratio": f"{ratio:.3f}",
        "studies": str(n_studies),
        "median_blocks": f"{np.median(n_blocks):.0f}",
        **{name: f"{100.0 * number / n_studies:.1f}" for name, number in counts.items()},
    }


def read_traces(path: Path) -> Traces:
    """Read what `write_traces` wrote."""
    rows = read_rows(path, ("test_set", "start"))
    networks = [name for name in rows[0] if name not in ("test_set", "start")]
    kinds = []
    for families in KINDS:
        columns = [name for name in networks if name.startswith(families)]
        kinds.append(np.array([[number_in(row, name, path) for row in rows] for name in columns]))
    run = np.array([TEST_SETS.index(row["test_set"]) for row in rows])
    return Traces((kinds[0], kinds[1]), run)


def write_traces(evaluations: Path, path: Path) -> None:
    """Mean squared error of the lateral velocity [m²/s²] over each second, from evaluations of the
    study ferrari_drive.

    All networks of one variant are multiplied by one factor, so that their mean over the drive is
    1.
    """
    folders = sorted(evaluations.glob("*-on-ferrari_drive-*"))
    families = tuple(f"{family}-" for kind in KINDS for family in kind)
    named = {
        folder.name.split("-on-")[0]: folder
        for folder in folders
        if folder.name.startswith(families)
    }
    if not named:
        raise MissingError(
            f"'{evaluations}' has no evaluations of ferrari_drive; run make ferrari_drive"
        )
    columns: dict[str, FloatArray] = {}
    labels: list[tuple[str, float]] = []
    for name, folder in named.items():
        segments = read_segments(folder / "blocks.csv")
        columns[name] = np.concatenate(
            [
                segments[test].squared_error_vy / np.maximum(segments[test].samples, 1.0)
                for test in TEST_SETS
            ]
        )
        labels = [(test, float(start)) for test in TEST_SETS for start in segments[test].start]
    for variant in dict.fromkeys(name.split("-seed")[0] for name in columns):
        of_variant = [name for name in columns if name.split("-seed")[0] == variant]
        level = float(np.mean([columns[name] for name in of_variant]))
        for name in of_variant:
            columns[name] = columns[name] / level
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["test_set", "start", *columns])
        for position, (test, start) in enumerate(labels):
            values = [f"{values[position]:.4g}" for values in columns.values()]
            writer.writerow([test, f"{start:g}", *values])


def main(arguments: Sequence[str] | None = None) -> None:
    """Write planted_truth.csv, or with ``--evaluations`` error_traces.csv."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path("results/scorecard"))
    parser.add_argument("--studies", type=int, default=N_STUDIES)
    parser.add_argument("--evaluations", type=Path, help="outputs/evaluate of make ferrari_drive")
    options = parser.parse_args(arguments)
    traces_file = options.folder / "error_traces.csv"
    if options.evaluations is not None:
        write_traces(options.evaluations, traces_file)
        return
    traces = read_traces(traces_file)
    rows = [
        rates(traces, design, n_seeds, truth, options.studies)
        for design in DESIGNS
        for n_seeds in (1, 3)
        for truth in TRUTHS
    ]
    with open(options.folder / "planted_truth.csv", "w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
