"""docs/many_machines.md quotes results/benchmarks/launchers.json."""

import json
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_figures_are_those_that_were_measured():
    measured = json.loads(
        (ROOT / "results" / "benchmarks" / "launchers.json").read_text(encoding="utf-8")
    )
    text = " ".join((ROOT / "docs" / "many_machines.md").read_text(encoding="utf-8").split())
    local, ray = (measured["launchers"][name] for name in ("local", "ray"))
    plain, tracked = (measured["sweep"][name] for name in ("none", "mlflow"))
    million = measured["million_trainings_on_1000_cores"]
    pays = measured["second_node_pays_from_s"]
    per_second = measured["scheduler"]["empty_tasks_a_second"]
    combination = measured["planning"]["seconds_a_combination"]
    quoted = (
        f"| until the first group begins | {local['start_s']:.1f} s | {ray['start_s']:.1f} s |",
        f"| added to a task beside the group's own time | {1000 * local['added_s']:.0f} ms | {1000 * ray['added_s']:.0f} ms |",
        f"is {pays['20 tasks']:.2f} s for 20 tasks, {pays['200 tasks']:.2f} s for 200 and {pays['2000 tasks']:.2f} s for 2,000",
        f"| {per_second:,} empty tasks a second | {million['scheduling, one process']:.2f} h |",
        f"| {1000 * plain['parent_cpu_s_a_training']:.0f} ms of processor a training "
        f"| {million['the rest of the parent, one process']:.1f} h |",
        f"| {1000 * tracked['mlflow_s_a_training']:.0f} ms of processor a training | {million['MLflow, one process']:.0f} h |",
        f"| {1000 * combination:.0f} ms of processor a combination | {million['planning, one process']:.1f} h with a seed each",
        f"for 100,000 entries | {million['looking for leftovers, all cores']:.2f} h of all cores |",
        f"| {plain['bytes_a_training'] / 1000:.0f} kB, {plain['files_a_training']:.0f} files a training "
        f"| {million['artefacts [GB]']:.0f} GB, {million['files [millions]']:.0f} million files |",
        f"| {tracked['mlflow_rows_a_training']:.0f} rows, {tracked['mlflow_bytes_a_training'] / 1000:.0f} kB a training "
        f"| {million['MLflow rows [millions]']:.0f} million rows, {million['MLflow [GB]']:.0f} GB |",
        f"| {plain['parent_mb']} MB at most over 2,000 trainings, growing by {plain['parent_mb_a_1000_trainings']:.0f} MB for each 1,000 "
        f"(with MLflow {tracked['parent_mb']} MB, {tracked['parent_mb_a_1000_trainings']:.0f} MB)",
        "6,000 of 6,000 artefacts",
    )
    assert [words for words in quoted if words not in text] == []
    assert tracked["trainings"] == plain["trainings"] == 2000
    assert tracked["mlflow_artefacts_with_a_run"] == tracked["mlflow_artefacts_expected"] == 6000
