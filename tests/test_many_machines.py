"""docs/many_machines.md quotes results/benchmarks/launchers.json."""

import json
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MEASURED = json.loads((ROOT / "results" / "benchmarks" / "launchers.json").read_text(encoding="utf-8"))
TEXT = " ".join((ROOT / "docs" / "many_machines.md").read_text(encoding="utf-8").split())


def quoted():
    """What is measured or follows from it -> how the documentation says it."""
    own, pays = MEASURED["launchers"], MEASURED["second_node_pays_from_s"]
    plain, tracked = MEASURED["sweep"]["none"], MEASURED["sweep"]["mlflow"]
    million, per_second = MEASURED["million_trainings_on_1000_cores"], MEASURED["scheduler"]
    local, ray = own["local"], own["ray"]
    combination = MEASURED["planning"]["seconds_a_combination"]
    return {
        "start": f"| until the first group begins | {local['start_s']:.1f} s | {ray['start_s']:.1f} s |",
        "added": f"| added to a task beside the group's own time | {1000 * local['added_s']:.0f} ms | {1000 * ray['added_s']:.0f} ms |",
        "pays": f"is {pays['20 tasks']:.2f} s for 20 tasks, {pays['200 tasks']:.2f} s for 200 and {pays['2000 tasks']:.2f} s for 2,000",
        "scheduler": f"| {per_second['empty_tasks_a_second']:,} empty tasks a second | {million['scheduling, one process']:.2f} h |",
        "parent": f"| {1000 * plain['parent_cpu_s_a_training']:.0f} ms of processor a training "
        f"| {million['the rest of the parent, one process']:.1f} h |",
        "mlflow": f"| {1000 * tracked['mlflow_s_a_training']:.0f} ms of processor a training | {million['MLflow, one process']:.0f} h |",
        "planning": f"| {1000 * combination:.0f} ms of processor a combination | {million['planning, one process']:.1f} h with a seed each",
        "leftovers": f"for 100,000 entries | {million['looking for leftovers, all cores']:.2f} h of all cores |",
        "artefacts": f"| {plain['bytes_a_training'] / 1000:.0f} kB, {plain['files_a_training']:.0f} files a training "
        f"| {million['artefacts [GB]']:.0f} GB, {million['files [millions]']:.0f} million files |",
        "rows": f"| {tracked['mlflow_rows_a_training']:.0f} rows, {tracked['mlflow_bytes_a_training'] / 1000:.0f} kB a training "
        f"| {million['MLflow rows [millions]']:.0f} million rows, {million['MLflow [GB]']:.0f} GB |",
        "memory": f"| {plain['parent_mb']} MB at most over {plain['trainings']:,} trainings, "
        f"growing by {plain['parent_mb_a_1000_trainings']:.0f} MB for each 1,000 "
        f"(with MLflow {tracked['parent_mb']} MB, {tracked['parent_mb_a_1000_trainings']:.0f} MB)",
        "complete": f"{tracked['mlflow_artefacts_with_a_run']:,} of {tracked['mlflow_artefacts_expected']:,} artefacts",
    }


@pytest.mark.parametrize("name", quoted())
def test_figures_are_those_that_were_measured(name):
    assert quoted()[name] in TEXT


def test_two_thousand_trainings_were_tracked_without_a_gap():
    tracked = MEASURED["sweep"]["mlflow"]
    assert tracked["trainings"] == MEASURED["sweep"]["none"]["trainings"] == 2000
    assert tracked["mlflow_artefacts_with_a_run"] == tracked["mlflow_artefacts_expected"] == 6000
