"""Logs trainings, calibrations and evaluations to MLflow, one run an artefact, found again by its tags.

Member -> `log_member` -> artefacts without a run -> `Tracker.log` -> MLflow's store

One process writes. When the store does not answer, work goes on without it, and the next run logs what is missing.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
import sqlite3
import sys
from collections.abc import Callable, Mapping
from contextlib import closing
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from vehest.data.files import regular_file, remove_leftovers, written_aside
from vehest.data.splits import TRAINING, VALIDATION
from vehest.data.text_files import number_in, read_rows
from vehest.estimators.model_files import read_description
from vehest.run.artefacts import MANIFEST, Artefact
from vehest.run.calibrate import calibration_figures
from vehest.run.evaluate import Evaluation, read_metrics, read_scored
from vehest.run.group import Member
from vehest.run.locks import Lock, held
from vehest.run.train import HISTORY, STAGE, read_fit_metrics
from vehest.studies.artefacts import read_frame

STORE = "mlflow.db"
METRICS_A_REQUEST, PARAMETERS_A_REQUEST = 1000, 100  # limits of a server
VALUE_LENGTH, SOURCE_LENGTH = 500, 5000
KEY_TAG, STAGE_TAG, DIGEST_TAG, OUTPUT_TAG, STUDY_TAG = "vehest.key", "vehest.stage", "vehest.digest", "vehest.output", "vehest.study"
UNFINISHED = "RUNNING"  # status of a run in MLflow


class Tracker:
    """Logs artefacts as MLflow runs, each once.

    Args:
        config: ``tracking`` of the configuration.
        output: the output root, where the local store lies.
        warn: called with one line when tracking is given up.
        should_stop: asked while another process logs.
        study: name of the study or sweep above the runs; may be empty.

    Attributes:
        complete: whether every artefact was logged; without MLflow too.
    """

    def __init__(
        self,
        config: Mapping[str, Any],
        output: Path,
        warn: Callable[[str], None],
        should_stop: Callable[[], bool] = lambda: False,
        study: str = "",
    ) -> None:
        self.complete = True
        self._wanted = config.get("name") == "mlflow"
        self._uri = config.get("uri")
        self._experiment = str(config.get("experiment", "vehest"))
        self._output, self._root = output, str(output.resolve())
        self._warn, self._should_stop = warn, should_stop
        self._study = study

    @property
    def store(self) -> str:
        """Name of the local store in the output root; empty where nothing is tracked, or a server has the runs."""
        return STORE if self._wanted and not self._uri else ""

    def log(
        self,
        artefact: Artefact,
        metrics: Callable[[], Mapping[str, float]],
        history: Path | None = None,
        figures: Mapping[str, Callable[[], Any]] | None = None,
    ) -> None:
        """Log an artefact as a run, unless it is.

        Args:
            artefact: its label is the run's name.
            metrics: reads the final ones.
            history: CSV with a column ``epoch`` and metrics over it.
            figures: file name -> what draws it (a matplotlib figure, or none if there is nothing to draw).
        """
        if self._asked(lambda: not _is_finished(self._run_of(artefact))):
            values, drawings = metrics(), {name: draw() for name, draw in (figures or {}).items()}
            self._asked(lambda: self._log(artefact, values, history, drawings))

    def _asked(self, action: Callable[[], bool]) -> bool:
        """Use the store while no other process does; False once tracking is given up."""
        if not (self._wanted and self.complete):
            return False
        try:
            with held(Lock(self._output, "tracking", "mlflow"), self._should_stop) as mine:
                if mine:
                    return action()
        except Exception as error:  # results matter more than any failure of a tracking server
            why = next(iter(str(error).strip().splitlines()), type(error).__name__)[:160]
            self._warn(f"MLflow at {self._address} does not answer ({why}); going on without tracking, the next run makes up for it")
        self.complete = False
        return False

    def _runs(self, tags: Mapping[str, str]) -> list[Any]:
        wanted = " and ".join(f"tags.`{name}` = '{value}'" for name, value in tags.items())  # hashes and names of files: without quotes
        return list(self._client.search_runs([self._experiment_id], wanted))

    def _run_of(self, artefact: Artefact) -> Any:
        """The finished run of an artefact, or the one that a killed process began from this output root; none without either."""
        runs = self._runs({KEY_TAG: artefact.key, STAGE_TAG: artefact.stage, DIGEST_TAG: artefact.digest})
        begun = [run for run in runs if run.data.tags.get(OUTPUT_TAG) == self._root]
        return next((run for run in [*filter(_is_finished, runs), *begun]), None)

    def _log(self, artefact: Artefact, metrics: Mapping[str, float], history: Path | None, drawings: Mapping[str, Any]) -> bool:
        from mlflow.entities import Metric, Param

        client, run = self._client, self._run_of(artefact)
        if _is_finished(run):
            return True  # by another process
        run = run or client.create_run(self._experiment_id, tags=self._tags_of(artefact))
        run_id, begun = str(run.info.run_id), run.info.start_time  # metrics with the same time are kept once
        client.log_inputs(run_id, datasets=_datasets(artefact))
        parameters = [Param(key, value) for key, value in _flattened(artefact.config).items()]
        for start in range(0, len(parameters), PARAMETERS_A_REQUEST):
            client.log_batch(run_id, params=parameters[start : start + PARAMETERS_A_REQUEST])
        points = [Metric(key, value, begun, 0) for key, value in metrics.items()]
        points += [Metric(key, value, begun, epoch) for key, value, epoch in _over_epochs(history)]
        for start in range(0, len(points), METRICS_A_REQUEST):
            client.log_batch(run_id, metrics=points[start : start + METRICS_A_REQUEST])
        for file in [*artefact.outputs, MANIFEST]:
            folder = Path(file).parent.as_posix()
            if not file.endswith(".parquet"):
                client.log_artifact(run_id, str(artefact.folder / file), None if folder == "." else folder)
        for name, drawing in drawings.items():
            if drawing is not None:
                client.log_figure(run_id, drawing, f"figures/{name}")
        if artefact.status == "complete" and artefact.outputs:
            self._link_model(artefact, run_id)
        client.set_terminated(run_id, "FINISHED" if artefact.status == "complete" else "KILLED")
        return True

    def _tags_of(self, artefact: Artefact) -> dict[str, str]:
        """Tags of a run: by them it is found again, and put below that of its study, which is created with the first of them."""
        tags = {f"vehest.{name}": str(value) for name, value in artefact.provenance.items() if not isinstance(value, dict)}
        tags |= {
            "mlflow.runName": artefact.label,
            STAGE_TAG: artefact.stage,
            KEY_TAG: artefact.key,
            DIGEST_TAG: artefact.digest,
            OUTPUT_TAG: self._root,
            "vehest.status": artefact.status,
            "mlflow.source.name": " ".join(["vehest", *sys.argv[1:]])[:VALUE_LENGTH],
            "mlflow.source.type": "LOCAL",
        }
        if artefact.provenance.get("commit"):
            tags["mlflow.source.git.commit"] = str(artefact.provenance["commit"])
        if self._study:
            tags |= {STUDY_TAG: self._study, "mlflow.parentRunId": self._parent()}
        return tags

    def _parent(self) -> str:
        tags = {STUDY_TAG: self._study, STAGE_TAG: "study"}
        for run in self._runs(tags):
            if run.data.tags.get(OUTPUT_TAG) == self._root:
                return str(run.info.run_id)
        run = self._client.create_run(self._experiment_id, tags={**tags, "mlflow.runName": self._study, OUTPUT_TAG: self._root})
        self._client.set_terminated(run.info.run_id, "FINISHED")
        return str(run.info.run_id)

    def _link_model(self, artefact: Artefact, run_id: str) -> None:
        """Show a training's model as an entity of its own, and link evaluations and calibrations to it."""
        from mlflow.entities import LoggedModelInput, LoggedModelOutput

        client, trained = self._client, artefact.stage == STAGE
        digest = artefact.digest if trained else artefact.inputs.get("model", "")
        models = list(client.search_logged_models([self._experiment_id], filter_string=f"tags.`{DIGEST_TAG}` = '{digest}'"))
        if trained and not models:
            name, config = re.sub(r"[/:.%'\"]", "_", artefact.label), _flattened(artefact.config)
            parameters = dict(list(config.items())[:PARAMETERS_A_REQUEST])
            kind = config.get("estimator.name", "")
            models = [client.create_logged_model(self._experiment_id, name, run_id, {DIGEST_TAG: digest}, parameters, kind)]
            client.log_model_artifacts(models[0].model_id, str(artefact.folder))
            client.finalize_logged_model(models[0].model_id, "READY")
        if trained:
            client.log_outputs(run_id, [LoggedModelOutput(models[0].model_id, 0)])
        elif models:
            client.log_inputs(run_id, models=[LoggedModelInput(models[0].model_id)])

    @cached_property
    def _client(self) -> Any:
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")
        from mlflow import MlflowClient

        for noisy in ("mlflow", "alembic"):
            logging.getLogger(noisy).setLevel(logging.ERROR)
        logging.getLogger("mlflow.store.db.utils").setLevel(logging.CRITICAL)  # its errors are raised too

        if not self._uri:
            store = self._output / STORE
            remove_leftovers(self._output)
            if not store.exists():
                with written_aside(store) as aside:  # a process that is killed here leaves no store with half of its tables
                    MlflowClient(_sqlite(aside)).search_experiments(max_results=1)
            _check_store(store)
        return MlflowClient(self._address)

    @cached_property
    def _experiment_id(self) -> str:
        found = self._client.get_experiment_by_name(self._experiment)
        location = None if self._uri else (self._output / "mlartifacts").resolve().as_uri()
        return str(found.experiment_id if found else self._client.create_experiment(self._experiment, location))

    @property
    def _address(self) -> str:
        return str(self._uri or _sqlite(self._output / STORE))


def _is_finished(run: Any) -> bool:
    return run is not None and run.info.status != UNFINISHED


def _check_store(store: Path) -> None:
    """Read the names of a local store's tables, since MLflow retries a damaged one for hours.

    Raises:
        DataError: it is no file.
        sqlite3.DatabaseError: it is no store, or a damaged one.
    """
    with closing(sqlite3.connect(f"{regular_file(store).resolve().as_uri()}?mode=rw", uri=True)) as connection:
        connection.execute("select name from sqlite_master").fetchall()


def _sqlite(file: Path) -> str:
    return f"sqlite:///{file.resolve()}"


def _datasets(artefact: Artefact) -> list[Any]:
    """Recordings that an artefact was made from, together one MLflow data set a data set."""
    from mlflow.entities import Dataset, DatasetInput, InputTag

    digests: dict[str, dict[str, str]] = {}
    for name, digest in artefact.inputs.items():
        dataset, slash, recording = name.rpartition("/")
        if slash and not name.startswith("reference of "):
            digests.setdefault(dataset, {})[recording] = digest
    context = InputTag("mlflow.data.context", "training" if artefact.stage == STAGE else artefact.stage)
    found = []
    for dataset, recordings in digests.items():
        digest = hashlib.sha256(json.dumps(recordings, sort_keys=True).encode()).hexdigest()[:16]
        source = json.dumps({"dataset": dataset, "recordings": sorted(recordings)})[:SOURCE_LENGTH]
        found.append(DatasetInput(Dataset(dataset[:255], digest, "vehest", source), [context]))
    return found


def _over_epochs(history: Path | None) -> list[tuple[str, float, int]]:
    """Metric, value and epoch."""
    if history is None or not history.is_file():
        return []
    return [
        (key, number_in(row, key, history), int(number_in(row, "epoch", history, finite=True)))
        for row in read_rows(history)
        for key in row
        if key != "epoch" and "epoch" in row
    ]


def _flattened(config: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Dotted key -> start of the value's text."""
    flat: dict[str, str] = {}
    for key, value in config.items():
        flat |= _flattened(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": str(value)[:VALUE_LENGTH]}
    return flat


def log_member(tracker: Tracker, member: Member, how: Evaluation | None) -> None:
    """Log the training, calibration and evaluation of a member of a group, each unless it is.

    Args:
        tracker: of the command.
        member: of a group.
        how: it was evaluated; none if it was trained only.
    """
    model = member.model
    if model is None:
        return
    tracker.log(model, partial(read_fit_metrics, model.folder), model.folder / HISTORY, {"learning.png": partial(_learning_figure, model)})
    if member.calibration is not None:
        log_calibration(tracker, member.calibration)
    if member.evaluation is not None and how is not None:
        log_evaluation(tracker, member.evaluation, model, how)


def log_calibration(tracker: Tracker, calibration: Artefact) -> None:
    """Log a calibration unless it is: blocks and seconds behind its bands."""
    tracker.log(calibration, partial(calibration_figures, calibration.folder))


def log_evaluation(tracker: Tracker, evaluation: Artefact, model: Artefact, how: Evaluation) -> None:
    """Log an evaluation unless it is: metrics, and traces over each test set."""
    drawn = {f"traces_{name}.png": partial(_trace_figure, evaluation, model, how, name) for name in how.split.tests}
    tracker.log(evaluation, partial(test_figures, evaluation), None, drawn)


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
    from vehest.report.run_figures import fit_figure

    if not (model.folder / HISTORY).is_file():
        return None
    about = read_description(model.folder)
    return fit_figure(model.label, about.estimator, about.variant, read_frame(model.folder / HISTORY))


def _trace_figure(evaluation: Artefact, model: Artefact, how: Evaluation, test_set: str) -> Any:
    from vehest.report.run_figures import trace_figure

    about = read_description(model.folder)
    parts = read_scored(evaluation, how.split, how.references, how.protocol, test_set)
    series = [np.concatenate([getattr(part, name) for part in parts]) for name in ("vy_ref", "sideslip_ref", "vy", "sideslip")]
    time = parts[0].time[0] + np.arange(len(series[0])) / how.protocol.rate_hz  # several ranges stand end to end
    return trace_figure(model.label, about.estimator, about.variant, time, (series[0], series[1]), (series[2], series[3]))
