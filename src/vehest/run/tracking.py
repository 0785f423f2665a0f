"""Logs trainings, calibrations and evaluations to MLflow, one run an artefact, found again by its tags.

Member -> `log_member` -> artefacts without a run -> `Tracker.log` -> MLflow's store

One process writes. When the store does not answer, work goes on without it, and the next run logs the missing artefacts.
"""

from __future__ import annotations

import logging
import os
import sqlite3
import sys
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from vehest.data.files import regular_file, remove_leftovers, written_aside
from vehest.data.splits import TRAINING, VALIDATION
from vehest.estimators.model_files import read_description
from vehest.run.artefacts import MANIFEST, Artefact
from vehest.run.calibrate import calibration_figures
from vehest.run.evaluate import Evaluation, read_metrics, read_scored
from vehest.run.group import Member
from vehest.run.locks import Lock, held
from vehest.run.train import HISTORY, read_fit_metrics
from vehest.studies.artefacts import read_frame

STORE = "mlflow.db"
VALUES_A_REQUEST = 100  # a server takes no more parameters at a time
VALUE_LENGTH = 500
KEY_TAG, STAGE_TAG, DIGEST_TAG, OUTPUT_TAG, STUDY_TAG = "vehest.key", "vehest.stage", "vehest.digest", "vehest.output", "vehest.study"
Metrics = Callable[[], Mapping[str, float]]
Figures = Mapping[str, Callable[[], Any]]  # file name -> function that draws a matplotlib figure, or gives none


@dataclass(eq=False)
class Tracker:
    """Logs artefacts as MLflow runs, each once."""

    config: Mapping[str, Any]  # ``tracking`` of the configuration
    output: Path  # the output root, with the local store
    warn: Callable[[str], None]  # called with one line when tracking is given up
    should_stop: Callable[[], bool] = lambda: False  # asked while another process logs
    study: str = ""  # name of the study or sweep above the runs
    complete: bool = field(default=True, init=False)  # whether every artefact was logged; without MLflow too

    @property
    def store(self) -> str:
        """Name of the local store in the output root; empty where nothing is tracked, or a server has the runs."""
        return STORE if self.config.get("name") == "mlflow" and not self.config.get("uri") else ""

    def log(self, artefact: Artefact, metrics: Metrics, figures: Figures) -> None:
        """Log an artefact as a run while no other process logs, unless it is logged."""
        if self.config.get("name") != "mlflow" or not self.complete:
            return
        self.complete = False
        try:
            with held(Lock(self.output, "tracking", "mlflow"), self.should_stop) as mine:
                if mine:
                    self._log(artefact, metrics, figures)
                    self.complete = True
        except Exception as error:  # results matter more than any failure of a tracking server
            why = next(iter(str(error).strip().splitlines()), type(error).__name__)[:160]
            self.warn(f"logging to MLflow at {self._address} failed ({why}); going on without tracking, the next run makes up for it")

    def _log(self, artefact: Artefact, metrics: Metrics, figures: Figures) -> None:
        from mlflow.entities import Metric, Param

        client, run = self._client, self._run_of(artefact)
        if run is not None and run.info.status != "RUNNING":
            return
        run = run or client.create_run(self._experiment_id, tags=self._tags_of(artefact))
        run_id, begun = str(run.info.run_id), run.info.start_time  # metrics with the same time are kept once
        parameters = [Param(key, value) for key, value in _flattened(artefact.config).items()]
        points = [Metric(key, value, begun, 0) for key, value in metrics().items()]
        if (artefact.folder / HISTORY).is_file():
            history = read_frame(artefact.folder / HISTORY)
            rows = history.melt("epoch").itertuples(index=False) if "epoch" in history else ()
            points += [Metric(key, float(value), begun, int(epoch)) for epoch, key, value in rows]
        for start in range(0, max(len(points), len(parameters)), VALUES_A_REQUEST):
            batch = slice(start, start + VALUES_A_REQUEST)
            client.log_batch(run_id, points[batch], parameters[batch])
        for file in [*artefact.outputs, MANIFEST]:
            folder = Path(file).parent.as_posix()
            if not file.endswith(".parquet"):
                client.log_artifact(run_id, str(artefact.folder / file), None if folder == "." else folder)
        for name, draw in figures.items():
            drawing = draw()
            if drawing is not None:
                client.log_figure(run_id, drawing, f"figures/{name}")
        client.set_terminated(run_id, "FINISHED" if artefact.status == "complete" else "KILLED")

    def _runs(self, tags: Mapping[str, str]) -> tuple[list[Any], list[Any]]:
        """Runs with these tags: of any output root, and of this one."""
        wanted = " and ".join(f"tags.`{name}` = '{value}'" for name, value in tags.items())  # hashes and names of files: without quotes
        runs = list(self._client.search_runs([self._experiment_id], wanted))
        return runs, [run for run in runs if run.data.tags.get(OUTPUT_TAG) == str(self.output.resolve())]

    def _run_of(self, artefact: Artefact) -> Any:
        """The finished run of an artefact, or the one that a killed process began from this output root; none without either."""
        runs, own = self._runs({KEY_TAG: artefact.key, STAGE_TAG: artefact.stage, DIGEST_TAG: artefact.digest})
        return next(iter([*(run for run in runs if run.info.status != "RUNNING"), *own]), None)

    def _tags_of(self, artefact: Artefact) -> dict[str, str]:
        """Tags of a run, by which it is found again and lies below that of its study."""
        tags = {
            "mlflow.runName": artefact.label,
            "mlflow.source.name": " ".join(["vehest", *sys.argv[1:]])[:VALUE_LENGTH],
            "mlflow.source.git.commit": str(artefact.provenance.get("commit", "")),
            STAGE_TAG: artefact.stage,
            KEY_TAG: artefact.key,
            DIGEST_TAG: artefact.digest,
            OUTPUT_TAG: str(self.output.resolve()),
        }
        return tags | ({STUDY_TAG: self.study, "mlflow.parentRunId": self._parent()} if self.study else {})

    def _parent(self) -> str:
        tags = {STUDY_TAG: self.study, STAGE_TAG: "study"}
        own = self._runs(tags)[1]
        if not own:
            named = {**tags, "mlflow.runName": self.study, OUTPUT_TAG: str(self.output.resolve())}
            own = [self._client.create_run(self._experiment_id, tags=named)]
            self._client.set_terminated(own[0].info.run_id, "FINISHED")
        return str(own[0].info.run_id)

    @cached_property
    def _client(self) -> Any:
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")
        from mlflow import MlflowClient

        for noisy in ("mlflow", "alembic"):
            logging.getLogger(noisy).setLevel(logging.ERROR)
        logging.getLogger("mlflow.store.db.utils").setLevel(logging.CRITICAL)  # its errors are raised too
        if self.store:
            store = self.output / STORE
            remove_leftovers(self.output)
            if not store.exists():
                with written_aside(store) as aside:  # a process that is killed here leaves no store with half of its tables
                    MlflowClient(_sqlite(aside)).search_experiments(max_results=1)
            address = f"{regular_file(store).resolve().as_uri()}?mode=rw"
            with closing(sqlite3.connect(address, uri=True)) as connection:  # MLflow retries a damaged store for hours
                connection.execute("select name from sqlite_master").fetchall()
        return MlflowClient(self._address)

    @cached_property
    def _experiment_id(self) -> str:
        name = str(self.config.get("experiment", "vehest"))
        location = (self.output / "mlartifacts").resolve().as_uri() if self.store else None
        found = self._client.get_experiment_by_name(name)
        return str(found.experiment_id if found else self._client.create_experiment(name, location))

    @property
    def _address(self) -> str:
        return str(self.config.get("uri") or _sqlite(self.output / STORE))


def _sqlite(file: Path) -> str:
    return f"sqlite:///{file.resolve()}"


def _flattened(config: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Dotted key -> start of the value's text."""
    flat: dict[str, str] = {}
    for key, value in config.items():
        flat |= _flattened(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": str(value)[:VALUE_LENGTH]}
    return flat


def log_member(tracker: Tracker, member: Member, how: Evaluation | None) -> None:
    """Log the training, calibration and evaluation of a member of a group, each unless it is logged."""
    model = member.model
    if model is None:
        return
    tracker.log(model, partial(read_fit_metrics, model.folder), {"learning.png": partial(_learning_figure, model)})
    log_scores(tracker, model, member.calibration, member.evaluation, how)


def log_scores(
    tracker: Tracker, model: Artefact, calibration: Artefact | None, evaluation: Artefact | None, how: Evaluation | None
) -> None:
    """Log a calibration with its figures, and an evaluation with its metrics and traces over each test set."""
    if calibration is not None:
        tracker.log(calibration, partial(calibration_figures, calibration.folder), {})
    if evaluation is not None and how is not None:
        drawn = {f"traces_{name}.png": partial(_trace_figure, evaluation, model, how, name) for name in how.split.tests}
        tracker.log(evaluation, partial(test_figures, evaluation), drawn)


def rmse_of_tests(evaluation: Artefact) -> dict[str, float]:
    """RMSE(β) of an evaluation on each test set [deg]."""
    return {name: value for name, value in test_figures(evaluation).items() if name.startswith("rmse_sideslip")}


def test_figures(evaluation: Artefact) -> dict[str, float]:
    """Metrics of an evaluation over all samples, ``<metric>.<test set>`` -> value."""
    table = read_metrics(evaluation.folder)
    tested = table[~table["test_set"].isin((VALIDATION, TRAINING)) & (table["subset"] == "all") & (table["condition"] == "nominal")]
    return {
        f"{metric}.{name}": float(value) for metric, name, value in zip(tested["metric"], tested["test_set"], tested["value"], strict=True)
    }


def _learning_figure(model: Artefact) -> Any:
    """Loss over the epochs; none where a fit has no epochs."""
    from vehest.report.figures import Learning, learning_curves
    from vehest.report.style import line_of

    about, history = read_description(model.folder), model.folder / HISTORY
    run = Learning.of(model.label, line_of(about.estimator, about.variant), read_frame(history) if history.is_file() else None)
    return None if run is None else learning_curves([run], "loss [m²/s²]")


def _trace_figure(evaluation: Artefact, model: Artefact, how: Evaluation, test_set: str) -> Any:
    """Measured and estimated lateral velocity and sideslip over the scored times of a test set."""
    from vehest.report.figures import Traces, traces_figure
    from vehest.report.style import REFERENCE, line_of

    about = read_description(model.folder)
    parts = read_scored(evaluation, how.split, how.references, how.protocol, test_set)
    series = [np.concatenate([getattr(part, name) for part in parts]) for name in ("vy_ref", "sideslip_ref", "vy", "sideslip")]
    time = parts[0].time[0] + np.arange(len(series[0])) / how.protocol.rate_hz  # several ranges stand end to end
    reference = Traces("measured", REFERENCE, series[0], np.degrees(series[1]))
    estimated = Traces(model.label, line_of(about.estimator, about.variant), series[2], np.degrees(series[3]))
    return traces_figure(time, reference, [estimated], "time [s]")
