import base64
import math
import os
import re
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure as MatplotlibFigure

from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.splits import Span, Split
from vehest.data.store import write_estimate, write_recording
from vehest.evaluation.blocks import read_segments, segments_of, write_segments
from vehest.evaluation.metrics import UNITS, Protocol, accuracy, score
from vehest.report.document import Column, Document, Figure, Table, formatted, write_document
from vehest.report.figures import decimated
from vehest.report.style import (
    MISSING,
    decimals_for,
    fixed,
    line_of,
    lines_of,
    on_dark,
    significant,
)
from vehest.studies.artefacts import METRIC_COLUMNS, EvaluatedModel, PartArtefacts
from vehest.studies.drive import comparison, leaderboard
from vehest.studies.kit.timings import timings_of_study
from vehest.studies.kit.warnings import warnings_of

RATE = 20.0
PROTOCOL = Protocol(rate_hz=RATE, warm_up_seconds=2.0, skip_seconds=1.5)

# (estimator, variant, title) -> for each seed, the size of its error on the validation and on the
# test range
FAMILIES = {
    ("luenberger", "luenberger", "Luenberger"): [(0.30, 0.30)],
    ("ksnn", "linear_bias_p2", "KS-NN linear + bias, P = 2"): [
        (0.12, 0.05),
        (0.08, 0.15),
        (0.10, 0.11),
    ],
    ("gru", "states_5", "GRU | 5 <states>"): [(0.20, 0.20), (0.20, 0.22)],
    ("zero", "zero", "Zero (v = 0)"): [(1.50, 1.50)],
    ("static_map", "static_map", "Static map"): [(0.70, 0.70)],
}
LEARNT_IN_EPOCHS = ("ksnn", "gru")


def drive(seconds=90.0):
    time = np.arange(int(seconds * RATE)) / RATE
    yaw_rate = 0.4 * np.sin(0.5 * time)
    vx = 30.0 + 4.0 * np.sin(0.1 * time)
    vy = 0.8 * np.sin(0.5 * time + 0.3) * (1.0 + 0.5 * np.sin(0.07 * time))
    channels = {
        "vx": vx,
        "yaw_rate": yaw_rate,
        "ax": 0.4 * np.cos(0.1 * time),
        "ay": vx * yaw_rate,
        "vy_ref": vy,
    }
    return Recording("lap", "car", RATE, 0.0, channels, kind="simulated")


def estimate_of(recording, span, size, phase):
    part = recording.cut(span.start - PROTOCOL.warm_up_seconds, span.stop)
    vy = part["vy_ref"] + size * np.sin(3.0 * part.time + phase)
    return Estimate(
        "lap", "any", RATE, part.start_time, {"vy": vy, "sideslip": np.arctan2(vy, part["vx"])}
    )


def study(folder, tests=None):
    recording = drive()
    write_recording(recording, folder / "lap.parquet")
    tests = tests or {"test": (Span("toy", "lap", 60.0, 85.0),)}
    split = Split("toy", (Span("toy", "lap", 2.0, 40.0),), (Span("toy", "lap", 42.0, 58.0),), tests)
    models = []
    rows = []
    for number, ((estimator, variant, title), sizes) in enumerate(FAMILIES.items()):
        for seed, (on_validation, on_test) in enumerate(sizes):
            home = folder / f"{estimator}-{seed}"
            model = EvaluatedModel(
                estimator, variant, title, seed, home / "model", home / "evaluation"
            )
            models.append(model)
            for test_set, spans in {"validation": split.validation, **tests}.items():
                size = on_validation if test_set == "validation" else on_test
                parts = []
                for position, span in enumerate(spans):
                    estimate = estimate_of(recording, span, size, number + 0.1 * seed)
                    write_estimate(
                        estimate, model.evaluation_folder / test_set / f"{position}.parquet"
                    )
                    parts.append(score(estimate, recording, span, PROTOCOL))
                segments = segments_of(parts, RATE)
                blocks = {
                    **(
                        read_segments(model.evaluation_folder / "blocks.csv")
                        if test_set != "validation"
                        else {}
                    ),
                    test_set: segments,
                }
                write_segments(model.evaluation_folder / "blocks.csv", blocks)
                rows += metric_rows(model, test_set, accuracy(parts))
            epochs = 10 + seed if estimator in LEARNT_IN_EPOCHS else 0
            rows += metric_rows(model, "", {"n_parameters": 10.0 * (number + 1), "epochs": epochs})
            model.model_folder.mkdir(parents=True)
            history(epochs).to_csv(model.model_folder / "history.csv", index=False)
    return PartArtefacts(
        study="toy",
        title="A toy study",
        about="What a *paragraph* says.",
        command="vehest run pipelines/toy.yaml",
        split=split,
        protocol=PROTOCOL,
        kinds={"toy": "simulated"},
        data_titles={"toy": "A toy track"},
        metrics=pd.DataFrame(rows, columns=list(METRIC_COLUMNS)),
        models=models,
        references={("toy", "lap"): folder / "lap.parquet"},
        facts=["Training: by hand."],
    )


def metric_rows(model, test_set, metrics):
    head = (
        "toy",
        model.estimator,
        model.variant,
        "toy",
        "toy",
        "simulated",
        test_set,
        "all",
        "nominal",
        RATE,
        "causal",
        model.seed,
    )
    return [
        (*head, name, value, UNITS.get(name, "1"), math.nan, math.nan)
        for name, value in metrics.items()
    ]


def history(epochs):
    if not epochs:
        return pd.DataFrame({"start_gain": [0.5], "start_threshold": [0.1], "train_loss": [0.2]})
    epoch = np.arange(1, epochs + 1)
    return pd.DataFrame({"epoch": epoch, "train_loss": 1.0 / epoch, "validation_loss": 1.5 / epoch})


def with_value(artefacts, value, **conditions):
    metrics = artefacts.metrics.copy()
    hit = (metrics[list(conditions)] == pd.Series(conditions)).all(axis=1)
    assert hit.any()
    metrics.loc[hit, "value"] = value
    return replace(artefacts, metrics=metrics)


def row_of(board, estimator, test_set="test"):
    rows = board[(board["estimator"] == estimator) & (board["test_set"] == test_set)]
    assert len(rows) == 1
    return rows.iloc[0]


@pytest.fixture(scope="module")
def artefacts(tmp_path_factory):
    return study(tmp_path_factory.mktemp("study"))


@pytest.fixture(scope="module")
def document(artefacts):
    return comparison(artefacts)


@pytest.fixture(scope="module")
def written(document, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    write_document(document, folder)
    return folder


def test_seed_is_chosen_on_validation_and_the_lower_seed_in_a_tie(
    artefacts,
):
    row = row_of(leaderboard(artefacts), "ksnn")
    assert row["seed"] == 1  # lowest on validation, highest on test
    assert (
        row["rmse_sideslip_chosen"]
        == row["rmse_sideslip_max"]
        > row["rmse_sideslip"]
        > row["rmse_sideslip_min"]
    )
    tied = with_value(artefacts, 0.05, estimator="ksnn", test_set="validation", metric="rmse_vy")
    for part in (tied, replace(tied, models=list(reversed(tied.models)))):
        assert row_of(leaderboard(part), "ksnn")["seed"] == 0
    single = row_of(leaderboard(artefacts), "luenberger")
    assert (
        math.isnan(single["epochs"]),
        math.isnan(single["rmse_sideslip_std"]),
        single["n_seeds"],
    ) == (True, True, 1)


def test_leaderboard_equals_errors_computed_from_the_stored_signals(artefacts):
    recording = drive()
    time = recording.time
    scored = (time >= 61.5 - 1e-9) & (time < 85.0 - 1e-9)
    vx = recording["vx"][scored]
    vy_ref = recording["vy_ref"][scored]
    rmse = []
    for seed, (_, size) in enumerate(
        FAMILIES["ksnn", "linear_bias_p2", "KS-NN linear + bias, P = 2"]
    ):
        vy = vy_ref + size * np.sin(3.0 * time[scored] + 1 + 0.1 * seed)
        error = np.degrees(np.arctan(vy / vx) - np.arctan(vy_ref / vx))
        rmse.append(math.sqrt(sum(error**2) / len(error)))
        if seed == 1:
            chosen_vy = vy
            chosen_error = error
    row = row_of(leaderboard(artefacts), "ksnn")
    assert row["rmse_sideslip_chosen"] == pytest.approx(rmse[1], rel=1e-12)
    assert row["rmse_sideslip"] == pytest.approx(math.sqrt(np.mean(np.square(rmse))), rel=1e-9)
    assert row["rmse_sideslip_median"] == pytest.approx(sorted(rmse)[1], rel=1e-12)
    assert (row["rmse_sideslip_min"], row["rmse_sideslip_max"]) == pytest.approx(
        (min(rmse), max(rmse)), rel=1e-12
    )
    mean = sum(rmse) / 3
    assert row["rmse_sideslip_std"] == pytest.approx(
        math.sqrt(sum((value - mean) ** 2 for value in rmse) / 2), rel=1e-9
    )
    assert row["rmse_vy"] == pytest.approx(math.sqrt(np.mean((chosen_vy - vy_ref) ** 2)), rel=1e-12)
    assert row["fvu"] == pytest.approx(np.var(chosen_vy - vy_ref) / np.var(vy_ref), rel=1e-9)
    assert row["max_error_sideslip"] == pytest.approx(max(abs(chosen_error)), rel=1e-12)
    assert row["p99_sideslip"] == pytest.approx(np.percentile(abs(chosen_error), 99), rel=1e-12)
    assert (row["n_seeds"], row["n_parameters"], row["epochs"]) == (3, 20, 11)


def test_leaderboard_is_sorted_by_sideslip_error_within_each_test_set(tmp_path):
    spans = {
        "late": (Span("toy", "lap", 60.0, 85.0),),
        "early": (Span("toy", "lap", 60.0, 66.0), Span("toy", "lap", 70.0, 80.0)),
    }
    artefacts = study(tmp_path, spans)
    board = leaderboard(artefacts)
    assert board["test_set"].tolist() == ["late"] * 5 + ["early"] * 5
    for _, part in board.groupby("test_set"):
        assert part["rmse_sideslip"].is_monotonic_increasing
    document = comparison(artefacts)
    names = [block.name for block in document.blocks if not isinstance(block, str)]
    assert {
        "leaderboard_late",
        "leaderboard_early",
        "traces_late",
        "traces_early",
        "forest_late",
        "forest_early",
        "zoom_early",
        "agreement_late",
    } <= set(names)


def test_subsets_and_other_conditions_do_not_enter_the_leaderboard(artefacts, tmp_path):
    with_conditions = artefacts.metrics.assign(value=99.0)
    metrics = pd.concat(
        [
            artefacts.metrics,
            with_conditions.assign(subset="nonlinear"),
            with_conditions.assign(condition="noisy"),
        ]
    )
    artefacts.metrics.to_csv(tmp_path / "metrics.csv", index=False)
    for table in (metrics, pd.read_csv(tmp_path / "metrics.csv")):
        pd.testing.assert_frame_equal(
            leaderboard(replace(artefacts, metrics=table)), leaderboard(artefacts)
        )


def test_diverged_estimator_comes_last_and_shows_dashes(artefacts):
    for metric in ("rmse_sideslip", "rmse_vy", "fvu", "p99_sideslip", "max_error_sideslip"):
        artefacts = with_value(artefacts, math.nan, estimator="gru", metric=metric)
    board = leaderboard(artefacts)
    assert board["estimator"].tolist()[-1] == "gru"
    document = comparison(artefacts)
    headers, rows, _ = formatted(table_of(document, "leaderboard_test"))
    cells = dict(zip(headers, rows[-1], strict=True))
    assert cells["estimator"].startswith("GRU")
    assert {
        cells[name]
        for name in headers
        if name.startswith(("RMSE", "FVU", "chosen", "median", "p99", "peak", "s.d."))
    } == {MISSING}
    assert re.search("No finite error.*GRU", text_of(document))


def test_ambiguous_runs_and_seeds_without_validation_are_refused(artefacts):
    twin = with_value(
        artefacts, 7.0, estimator="gru", seed=1, test_set="test", metric="rmse_vy"
    ).metrics
    with pytest.raises(DataError, match=r"rmse_vy of gru/states_5, seed 1, on 'test' is both"):
        leaderboard(replace(artefacts, metrics=pd.concat([artefacts.metrics, twin])))
    with pytest.raises(DataError, match="no metrics on the validation range"):
        leaderboard(
            replace(
                artefacts, metrics=artefacts.metrics[artefacts.metrics["test_set"] != "validation"]
            )
        )


def with_rows(artefacts, metrics, subset="all"):
    rows = [row for model in artefacts.models for row in metric_rows(model, "test", metrics)]
    added = pd.DataFrame(rows, columns=list(METRIC_COLUMNS)).assign(subset=subset)
    return replace(artefacts, metrics=pd.concat([artefacts.metrics, added], ignore_index=True))


def table_of(document, name):
    tables = {block.name: block for block in document.blocks if isinstance(block, Table)}
    return tables.get(name)


def test_bound_stands_beside_the_errors_and_floors_are_tabled_from_the_spread_down(
    artefacts, document
):
    bounded = comparison(with_rows(artefacts, {"floor_cramer_rao": 0.125}))
    headers, rows, _ = formatted(table_of(bounded, "leaderboard_test"))
    assert [row[headers.index("bound [deg]")] for row in rows] == ["0.125"] * 5
    assert "bound [deg]" not in formatted(table_of(document, "leaderboard_test"))[0]
    frame = table_of(document, "floors_test").frame
    assert frame["what"].tolist()[:2] == [
        "zero-sideslip baseline: the reference itself",
        "noise of the reference, at least",
    ]
    scored = drive().cut(61.5, 85.0)
    assert frame["vy"].iloc[0] == pytest.approx(np.sqrt(np.mean(scored["vy_ref"] ** 2)))
    assert (frame["vy"].iloc[1:] < frame["vy"].iloc[0]).all()
    assert "u, ω, a_y, a_x" in frame["inputs"].tolist()
    assert not any("δ" in inputs for inputs in frame["inputs"]), (
        "there is no steering angle in this drive"
    )


def test_errors_by_regime_are_those_of_the_chosen_seeds(artefacts, document):
    assert table_of(document, "regimes_test") is None
    table_of_regimes = with_rows(artefacts, {"rmse_sideslip": 0.25, "share": 0.375}, "turning")
    table_of_regimes = with_value(
        table_of_regimes, 0.5, estimator="ksnn", seed=1, subset="turning", metric="rmse_sideslip"
    )
    headers, rows, _ = formatted(table_of(comparison(table_of_regimes), "regimes_test"))
    assert headers == ["estimator", "turning (38 %)"]
    assert {row[0]: row[1] for row in rows}["KS-NN linear + bias, P = 2"] == "0.500"
    assert [row[1] for row in rows].count("0.250") == 4
    pd.testing.assert_frame_equal(leaderboard(table_of_regimes), leaderboard(artefacts))


def test_silent_drive_and_noisy_reference_are_warned_of(artefacts):
    def warned(**floors):
        return " ".join(warnings_of(with_rows(artefacts, floors)))

    assert not any(
        words in warned(floor_cramer_rao=0.1, floor_reference=0.01)
        for words in ("cannot rank", "close to the noise")
    )
    assert "cannot rank" not in warned(floor_cramer_rao=1.2)
    blind = with_value(with_rows(artefacts, {"floor_cramer_rao": 1.2}), 1.5, metric="rmse_sideslip")
    assert (
        "`test` cannot rank estimators: the Cramér-Rao bound of their inputs is 1.2°"
        in " ".join(warnings_of(blind))
    )
    assert "is close to the noise of the reference, at least 0.05°" in warned(floor_reference=0.05)


def test_basis_of_the_verdict_names_blocks_correction_and_where_they_are_explained(document):
    text = text_of(document)
    basis = re.search(
        r"paired bootstrap over (\d+) blocks of \S+ s and over seeds\. A difference of two "
        r"estimators is significant if its 95 % interval, after Holm's correction for the (\d+) "
        r"comparisons of this test, excludes zero\. Effective number of blocks: (\S+) of (\d+);",
        text,
    )
    assert basis is not None
    n_blocks, n_comparisons, effective, n_blocks_again = map(float, basis.groups())
    assert n_blocks == n_blocks_again >= effective >= 1.0
    n_candidates = len(FAMILIES) - 2  # the others are zero and static_map
    # the best with every other, and every candidate with both baselines, each pair once
    assert n_comparisons == (len(FAMILIES) - 1) + 2 * (n_candidates - 1)
    page = Path(__file__).parents[2] / "docs/evaluation.md"
    assert "docs/evaluation.md" in text
    assert "\n## Intervals and significance\n" in page.read_text(encoding="utf-8")


def test_reset_of_the_luenberger_observer_is_explained_below_its_traces(artefacts, document):
    assert zoom_of(document).caption.endswith(
        " Luenberger: v is set to 0 where the yaw rate is below a threshold (reset of the method)."
    )
    others = replace(
        artefacts, models=[model for model in artefacts.models if model.estimator != "luenberger"]
    )
    assert "Luenberger" not in zoom_of(comparison(others)).caption


def zoom_of(document):
    """The figure of the busiest 20 s."""
    figures = {block.name: block for block in document.blocks if isinstance(block, Figure)}
    return figures["zoom_test"]


def test_part_without_lateral_acceleration_is_warned_of_by_speed_and_sideslip_alone(
    artefacts, tmp_path
):
    recording = drive()
    write_recording(
        recording.select([name for name in recording.channels if name != "ay"]),
        tmp_path / "lap.parquet",
    )
    without = replace(artefacts, references={("toy", "lap"): tmp_path / "lap.parquet"})
    assert warnings_of(without) == [
        line for line in warnings_of(artefacts) if "lateral acceleration" not in line
    ]
    names = [block.name for block in comparison(without).blocks if isinstance(block, Figure)]
    assert "zoom_test" in names
    assert "over_ay_test" not in names
    assert "errors_over_ay_test" not in names


def text_of(document):
    return "\n\n".join(block for block in document.blocks if isinstance(block, str))


def test_verdict_names_the_best_and_recommends_only_above_both_baselines(artefacts, document):
    """KS-NN alone, then with a twin of itself, then without KS-NN."""
    text = text_of(document)
    best = leaderboard(artefacts).iloc[0]
    assert best["estimator"] == "ksnn"
    low, high = best["rmse_sideslip_low"], best["rmse_sideslip_high"]
    assert text.startswith(
        f"## Verdict\n\n**Best: {best['title']}, {best['rmse_sideslip']:.2f}° [{low:.2f}, "
        f"{high:.2f}].** "
        "Every other estimator is significantly worse. **Recommended: KS-NN linear + bias, P = "
        "2**, "
    )
    assert (
        "5 estimators were compared with 1 to 3 seeds each, 8 fits in all; training took 10 to 12 "
        "epochs a network" in text
    )
    twin = [
        replace(model, variant="twin", title="Twin")
        for model in artefacts.models
        if model.estimator == "ksnn"
    ]
    rows = artefacts.metrics[artefacts.metrics["estimator"] == "ksnn"].assign(variant="twin")
    twins = replace(
        artefacts, models=[*artefacts.models, *twin], metrics=pd.concat([artefacts.metrics, rows])
    )
    twins_text = text_of(comparison(twins))
    assert (
        "Twin and GRU | 5 &lt;states> are not significantly worse. **Recommended: KS-NN"
        in twins_text
    )
    assert (
        "of the 3 estimators among these that are significantly better than the zero-sideslip "
        "baseline" in twins_text
    )
    without = replace(
        artefacts, models=[model for model in artefacts.models if model.estimator != "ksnn"]
    )
    assert "PCT/IT2023/050058" in text
    assert "PCT/IT2023/050058" not in text_of(comparison(without))


def test_leaderboard_says_who_beats_the_baselines_and_how_far_each_is_from_the_first(artefacts):
    board = leaderboard(artefacts)
    assert row_of(board, "ksnn")["against_best"] == "best"
    assert row_of(board, "gru")["beats_zero"] == row_of(board, "gru")["beats_static_map"] == "yes"
    assert row_of(board, "zero")["beats_static_map"] == MISSING
    assert row_of(board, "static_map")["against_best"].startswith("+")
    for row in board.to_dict("records"):
        assert row["rmse_sideslip_low"] < row["rmse_sideslip_median"] < row["rmse_sideslip_high"]


def test_report_states_its_provenance_and_the_kind_of_data(artefacts, document, written):
    real = comparison(replace(artefacts, kinds={"toy": "real"}))
    for kind, of_kind in (("simulated", document), ("real", real)):
        words = f"**{kind.capitalize()} data:**"
        verdict, forest, _, busiest = of_kind.blocks[:4]
        assert f"on test set `test` ({kind})" in forest.caption
        assert (forest.name, busiest.name) == ("forest_test", "zoom_test")
        assert words in verdict
    text = (written / "report.md").read_text(encoding="utf-8")
    for words in (
        "`vehest run pipelines/toy.yaml`",
        "at 20 Hz",
        "up to 2 s before",
        "the first 1.5 s",
        "Training: by hand.",
        "60 to 85 s",
    ):
        assert words in text


def test_report_warns_of_tests_without_sideslip_and_of_trainings_cut_short(artefacts, document):
    assert not re.search("hardly excites sideslip|limit of", text_of(document))
    short = [replace(model, training={"max_epochs": 11}) for model in artefacts.models]
    assert (
        "Training ended at its limit, and longer training may lower the error: KS-NN linear + "
        "bias, P = 2 (11 epochs, 2 of 3 seeds)"
        in text_of(comparison(replace(artefacts, models=short)))
    )


def test_markdown_report_has_valid_links_even_tables_and_undated_figures(
    written,
):
    text = (written / "report.md").read_text(encoding="utf-8")
    targets = re.findall(r"\]\(([^)]+)\)", text)
    assert len(targets) == 5 + 2 * 8
    assert all((written / target).stat().st_size > 0 for target in targets)
    assert {path.relative_to(written).as_posix() for path in written.rglob("*.*")} == {
        *targets,
        "report.md",
        "report.html",
    }
    lines = text.splitlines()
    tables = [len(re.findall(r"(?<!\\)\|", line)) for line in lines if line.startswith("| ")]
    assert set(tables) == {
        5,
        6,
        7,
        12,
    }  # one bar more than columns, in a cell "\|" stands for a bar
    assert any(r"GRU \| 5 &lt;states>" in line for line in lines)
    for path in (written / "figures").iterdir():
        content = path.read_bytes()
        assert not any(
            word in content
            for word in (b"Software", b"Matplotlib v", b"dc:date", b"tIME", b"tEXt", b"dc:creator")
        ), path


def test_csv_tables_read_back_with_every_digit(artefacts, written):
    board = leaderboard(artefacts)
    table = pd.read_csv(written / "tables" / "leaderboard_test.csv", float_precision="round_trip")
    assert table.columns.tolist() == [*board.columns, "interval"]
    for column in ("title", "seed", "rmse_sideslip", "rmse_vy", "fvu", "rmse_vy_validation"):
        assert table[column].tolist() == board[column].tolist()
    assert table.loc[table["n_seeds"] == 1, "rmse_sideslip_median"].isna().all()


DRAWN_ELSEWHERE = """
import sys
from pathlib import Path
sys.path[:0] = sys.argv[3:]
from test_report import study
from vehest.report.document import write_document
from vehest.studies.drive import comparison
made, report = map(Path, sys.argv[1:3])
made.mkdir()
report.mkdir()
write_document(comparison(study(made)), report)
"""


@pytest.mark.apart
def test_two_processes_draw_the_same_bytes_whatever_the_order_of_their_sets(
    artefacts, written, tmp_path
):
    places = [str(Path(__file__).parent), str(Path(__file__).parents[1])]
    environment = {**os.environ, "PYTHONHASHSEED": "1"}  # that of this process is drawn
    folder = tmp_path / artefacts.references["toy", "lap"].parent.name
    report = tmp_path / written.name
    subprocess.run(
        [sys.executable, "-c", DRAWN_ELSEWHERE, str(folder), str(report), *places],
        env=environment,
        check=True,
    )
    files = [path.relative_to(written) for path in written.rglob("*.*")]
    assert (len(files), sum(file.suffix in (".png", ".svg") for file in files)) == (
        2 + 5 + 2 * 8,
        2 * 8,
    )
    for file in files:
        assert (report / file).read_bytes() == (written / file).read_bytes(), file


def test_content_of_the_page_is_in_no_other_file(tmp_path):
    frame = pd.DataFrame({"train_seconds": [1.5]})
    document = Document(
        "Words", ["Only words.", Table("first", "First.", pd.DataFrame({"a": [1]}))]
    )
    write_document(
        document, tmp_path, on_page=["## Times", Table("timings", "What it took.", frame)]
    )
    assert {path.name for path in tmp_path.rglob("*.*")} == {
        "report.md",
        "report.html",
        "first.csv",
    }
    assert "took" not in (tmp_path / "report.md").read_text(encoding="utf-8")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert Page(page).rows[-2:] == [["train_seconds"], ["1.50"]]
    assert "Table 2" in page
    with pytest.raises(ValueError, match="2 tables called 'first'"):
        write_document(document, tmp_path, on_page=[Table("first", "", frame)])


def test_times_are_medians_over_seeds_by_part_and_estimator():
    rows = [
        (part, "gru", "states_5", seed, test, metric, value)
        for part, slower in (("there", 1.0), ("back", 2.0))
        for seed in (0, 1, 2)
        for test in ("one", "two")
        for metric, value in (
            ("train_seconds", slower * (10.0 + seed**2)),
            ("step_seconds", 2e-4),
            ("search_seconds", 3.0 + seed),
        )
    ]
    table = pd.DataFrame(
        rows, columns=["part", "estimator", "variant", "seed", "test_set", "metric", "value"]
    )
    titles = {("gru", "states_5"): "GRU", ("zero", "zero"): "Zero"}
    heading, printed_rows = timings_of_study(
        [(part, part_table, titles) for part, part_table in table.groupby("part", sort=False)]
    )
    headers, cells, _ = formatted(printed_rows)
    assert (heading, headers[:2], headers[-1]) == (
        "## Times",
        ["part", "estimator"],
        "of a training: search [s]",
    )
    assert cells == [
        ["there", "GRU", "3", "11", "35", "0.20", "4.0"],
        ["back", "GRU", "3", "22", "70", "0.20", "4.0"],
    ]
    assert timings_of_study([("", table[:0], titles)]) == []


class Page(HTMLParser):
    """Tags, attributes and text of a page, everything in it that a browser would load, and the
    cells of its tables.
    """

    def __init__(self, text):
        super().__init__()
        self.tags = []
        self.attributes = []
        self.loads = []
        self.rows = []
        self.policy = self.text = ""
        self._cell = False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        values = {name: value or "" for name, value in attrs}
        self.tags.append(tag)
        self.attributes += attrs
        self.loads += [
            (tag, values[name])
            for name in ("src", "href", "srcset", "data", "poster", "action")
            if name in values
        ]
        if values.get("http-equiv") == "Content-Security-Policy":
            self.policy = values["content"]
        if tag == "tr":
            self.rows.append([])
        self._cell = tag in {"td", "th"} or (self._cell and tag == "button")
        if tag in {"td", "th"}:
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        self._cell = self._cell and tag not in {"td", "th"}

    def handle_data(self, data):
        self.text += data
        if self._cell:
            self.rows[-1][-1] += data


def test_page_loads_nothing_from_anywhere(written):
    text = (written / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert page.loads, "figures are embedded"
    models = {target for tag, target in page.loads if tag == "a" and not target.startswith("data:")}
    assert len(models) == len(FAMILIES)
    assert all(
        target.startswith("../../") and target.endswith("/model/") for target in models
    )  # as the folders of this test are called
    assert all(target.startswith("data:") for _, target in page.loads if target not in models)
    assert not {"link", "iframe", "object", "embed", "base"} & set(page.tags)
    assert page.policy.startswith("default-src 'none'")
    assert "http" not in page.policy
    style = re.search(r"<style>(.*?)</style>", text, re.DOTALL)
    assert not any(words in style[1] for words in ("url(", "@import"))
    assert "prefers-color-scheme: dark" in style[1]


def test_page_shows_the_numbers_of_the_leaderboard_and_the_static_figures(artefacts, written):
    page = Page((written / "report.html").read_text(encoding="utf-8"))
    best = leaderboard(artefacts).iloc[0]
    rows = [row for row in page.rows if row[0].splitlines()[0] == best["title"]]
    assert len(rows) == 2  # standing, with links to the model, and seeds
    assert fixed(best["rmse_sideslip"], 3) in rows[0]
    assert fixed(best["rmse_sideslip_median"], 3) in rows[1]
    assert any(row[0].splitlines()[0] == "GRU | 5 <states>" for row in page.rows)
    images = [
        base64.b64decode(target.split(",", 1)[1]) for tag, target in page.loads if tag == "img"
    ]
    assert len(images) == 8
    assert all(b"<svg" in image and b"prefers-color-scheme" in image for image in images)


def test_paths_of_figures_have_hundredths_of_a_point(
    tmp_path,
):
    static = MatplotlibFigure()
    static.add_subplot().plot(np.sin(np.arange(200.0)))
    document = Document("One", ["Only words.", Figure("line", "A line.", static)])
    write_document(document, tmp_path, page=False)
    paths = re.findall(
        r'\bd="([^"]*)"', (tmp_path / "figures" / "line.svg").read_text(encoding="utf-8")
    )
    assert max(len(path) for path in paths) > 1000
    assert not any(re.search(r"\.\d{3}", path) for path in paths)
    assert not (tmp_path / "report.html").exists()
    assert (tmp_path / "report.md").read_text(encoding="utf-8").startswith("# One\n\nOnly words.\n")
    write_document(document, tmp_path)
    assert (tmp_path / "report.html").stat().st_size < 60_000, (
        "without interactive figures the library is left out"
    )


@pytest.mark.parametrize("names", [["a", "a"], ["a/b"], [".."], ["A"]])
def test_document_refuses_names_that_cannot_name_its_files(names):
    with pytest.raises(ValueError, match=r"cannot name a file|2 tables called 'a'"):
        Document("Names", [Table(name, "", pd.DataFrame()) for name in names])


def test_table_columns_have_common_decimals_and_dashes_for_missing_values():
    frame = pd.DataFrame(
        {"error": [0.31234, 0.78, math.nan], "count": [12, 345678, 9], "name": ["a", None, "c"]}
    )
    _, rows, numeric = formatted(Table("t", "", frame, {name: Column(name) for name in frame}))
    assert numeric == [True, True, False]
    assert rows == [
        ["0.312", "12", "a"],
        ["0.780", "345\N{NARROW NO-BREAK SPACE}678", MISSING],
        [MISSING, "9", "c"],
    ]
    assert [significant(value) for value in (0.43512, 12.3456, 0.0, math.nan, -0.0261)] == [
        "0.435",
        "12.3",
        "0",
        MISSING,
        "−0.0261",
    ]
    assert (decimals_for([0.31, 0.44, 12.0]), decimals_for([math.nan])) == (3, 0)


def test_each_family_has_a_hue_with_contrast_on_dark_and_light_pages():
    assert line_of("ksnn", "linear_no_bias_p2").colour != line_of("ksnn", "linear_bias_p2").colour
    assert line_of("ksnn", "linear_bias_p2").colour == line_of("ksnn", "linear_bias_p3").colour
    names = [("ksnn", f"nonlinear_bias_p{p}_q{q}") for p in range(2, 5) for q in range(1, 5)] + [
        ("luenberger", ""),
        ("new", "x"),
    ]
    lines = lines_of(names)
    assert len(set(lines.values())) == len(names)

    def luminance(colour):
        parts = [int(colour[start : start + 2], 16) / 255 for start in (1, 3, 5)]
        linear = [
            part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts
        ]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    def contrast(first, second):
        high, low = sorted((luminance(first), luminance(second)), reverse=True)
        return (high + 0.05) / (low + 0.05)

    ksnn = [
        ("ksnn", f"{kind}_{bias}_p2")
        for kind in ("linear", "nonlinear")
        for bias in ("bias", "no_bias")
    ]
    for name in [("luenberger", ""), ("gru", ""), ("lstm", ""), ("heavy_ekf", ""), *ksnn]:
        assert contrast(line_of(*name).colour, "#ffffff") > 2.0, name
        assert contrast(on_dark(line_of(*name).colour), on_dark("#ffffff")) > 3.0, name
    assert contrast(on_dark("#000000"), on_dark("#ffffff")) > 10.0


def test_decimation_keeps_peaks_ends_and_gaps():
    time = np.arange(10_000) / 100.0
    values = np.sin(time)
    values[4321] = 7.0
    values[8000:8200] = np.nan
    at, values_drawn = decimated(time, values, 400)
    assert len(at) < 650
    assert (np.nanmax(values_drawn), (at[0], at[-1])) == (7.0, (time[0], time[-1]))
    assert np.isnan(values_drawn[(at > 80.0) & (at < 82.0)]).all()
    assert (np.diff(at) > 0).all()


def test_importing_the_report_package_loads_no_drawing_library():
    code = (
        "import sys, vehest.report.document, vehest.report.figures; print({'matplotlib', 'pandas', "
        "'jinja2'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
