"""Runs in MLflow: every training and every evaluation, from one writer; when the server is away, work goes on and says so."""

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
from pathlib import Path
from typing import Any

from vehest.data.errors import VehestError
from vehest.data.files import regular_file, remove_leftovers, written_aside
from vehest.data.text_files import number_in, read_json, read_rows
from vehest.run.artefacts import MANIFEST, Artefact
from vehest.run.locks import Lock, held

BATCH = 1000  # figures a request, which is what a server takes
PARAMETERS = 100
SQLITE = "mlflow.db"
ARTIFACTS = "mlartifacts"
TRACKED = "tracked"  # folder of the markers
TRACKED_STAGES = ("train", "calibrate", "evaluate")
KEY_TAG, STAGE_TAG, DIGEST_TAG, OUTPUT_TAG = "vehest.key", "vehest.stage", "vehest.digest", "vehest.output"
STUDY_TAG, PARENT_TAG, PARENT = "vehest.study", "mlflow.parentRunId", "study"
SOURCE_LENGTH = 5000
UNFINISHED, KILLED = "RUNNING", "KILLED"  # what MLflow calls a run's status


class Tracker:
    """Logs artefacts as MLflow runs, each once.

    An artefact that was logged gets a marker in the output root; one that has none is looked for among the runs by its key, and logged if
    it is not there. Whatever was lost on the way, by a kill, a full disk or a server that was away, is logged by the next run.

    Args:
        config: ``tracking`` of the configuration.
        output: the output root, where the local store and the markers lie.
        warn: called with one line when tracking has to be given up.
        should_stop: asked while another process logs; what is left then is logged by the next run.
        study: name of the study or sweep, a tag of all its runs.
    """

    def __init__(
        self,
        config: Mapping[str, Any],
        output: Path,
        warn: Callable[[str], None],
        should_stop: Callable[[], bool] = lambda: False,
        study: str = "",
    ) -> None:
        self._wanted = config.get("name") == "mlflow"
        self._uri = config.get("uri")
        self._experiment = str(config.get("experiment", "vehest"))
        self._output = output
        self._warn = warn
        self._should_stop = should_stop
        self._study = study
        self._client: Any = None
        self._experiment_id = ""

    @property
    def uri(self) -> str:
        """Where runs go."""
        return str(self._uri) if self._uri else _sqlite(self._output / SQLITE)

    def is_tracked(self, artefact: Artefact) -> bool:
        """Whether nothing is left to log of an artefact, as its marker says; without MLflow, and True where nothing is tracked."""
        if not self._wanted:
            return True
        if not self._uri and not (self._output / SQLITE).is_file():
            return False
        try:
            return bool(read_json(self._marker(artefact))["digest"] == artefact.digest)
        except (VehestError, KeyError, TypeError):
            return False

    def log(
        self,
        artefact: Artefact,
        metrics: Mapping[str, float],
        history: Path | None = None,
        figures: Mapping[str, Callable[[], Any]] | None = None,
    ) -> None:
        """Log one artefact as a run, unless it is: its configuration, figures, figures over epochs, files, manifest and drawings.

        Args:
            artefact: of a stage; its label is the run's name.
            metrics: final figures.
            history: CSV with a column ``epoch`` and figures over it.
            figures: file name -> what draws it (a matplotlib figure, or none if there is nothing to draw).
        """
        if self.is_tracked(artefact):
            return
        drawings = {name: draw() for name, draw in (figures or {}).items()}
        try:
            with held(Lock(self._output, "tracking", self._address), self._should_stop) as mine:
                if mine and not self.is_tracked(artefact):
                    self._mark(artefact, self._logged(artefact) or self._log(artefact, metrics, history, drawings))
        except Exception as error:  # whatever a tracking server does, results matter more
            self._wanted = False
            self._warn(
                f"MLflow at {self.uri} does not answer ({_first_line(error)}); going on without tracking, the next run makes up for it"
            )

    @property
    def _address(self) -> str:
        """Hash of where runs go; a local store goes where its output root goes."""
        return hashlib.sha256(json.dumps([self._uri, self._experiment]).encode()).hexdigest()[:16]

    def _marker(self, artefact: Artefact) -> Path:
        return self._output / TRACKED / self._address / f"{artefact.stage}-{artefact.key}"

    def _mark(self, artefact: Artefact, run: str) -> None:
        marker = self._marker(artefact)
        remove_leftovers(marker.parent)
        with written_aside(marker) as aside:
            aside.write_text(json.dumps({"digest": artefact.digest, "run": run}), encoding="utf-8")

    def _logged(self, artefact: Artefact) -> str | None:
        """The run of an artefact that was logged and not marked, as when a kill came in between."""
        ended = [run for run in self._runs_of(artefact) if run.info.status != UNFINISHED]
        return next((run.info.run_id for run in ended if run.data.tags.get(DIGEST_TAG) == artefact.digest), None)

    def _runs_of(self, artefact: Artefact) -> list[Any]:
        wanted = f"tags.`{KEY_TAG}` = '{artefact.key}' and tags.`{STAGE_TAG}` = '{artefact.stage}'"
        return list(self._connected().search_runs([self._experiment_id], wanted))

    def _log(self, artefact: Artefact, metrics: Mapping[str, float], history: Path | None, drawings: Mapping[str, Any]) -> str:
        client = self._connected()
        from mlflow.entities import Metric, Param, RunTag

        run = self._begun(artefact) or client.create_run(self._experiment_id, tags={**self._identity(artefact), **self._parent()})
        run_id, stamp = str(run.info.run_id), run.info.start_time
        client.log_inputs(run_id, datasets=_datasets(artefact))
        points = [Metric(key, value, stamp, 0) for key, value in metrics.items()]
        points += [Metric(key, value, stamp, step) for key, value, step in _over_epochs(history)]
        parameters = [Param(key, str(value)[:500]) for key, value in _flattened(artefact.config).items()]
        run_tags = [RunTag(f"vehest.{key}", str(value)) for key, value in artefact.provenance.items() if not isinstance(value, dict)]
        client.log_batch(run_id, tags=run_tags)
        for start in range(0, len(parameters), PARAMETERS):
            client.log_batch(run_id, params=parameters[start : start + PARAMETERS])
        for start in range(0, len(points), BATCH):
            client.log_batch(run_id, metrics=points[start : start + BATCH])
        for file in [*artefact.outputs, MANIFEST]:
            folder = Path(file).parent.as_posix()
            if not file.endswith(".parquet"):
                client.log_artifact(run_id, str(artefact.folder / file), None if folder == "." else folder)
        for name, drawing in drawings.items():
            if drawing is not None:
                client.log_figure(run_id, drawing, f"figures/{name}")
        if artefact.stage == "train" and artefact.status == "complete" and artefact.outputs:
            self._log_model(artefact, run_id)
        elif artefact.inputs.get("model"):
            self._link_model(artefact, run_id)
        client.set_terminated(run_id, "FINISHED" if artefact.status == "complete" else KILLED)
        return run_id

    def _parent(self) -> dict[str, str]:
        """The tags that put a run below that of its study or sweep, which is made with the first of them."""
        study = self._study
        if not study:
            return {}
        client, root = self._connected(), str(self._output.resolve())
        quoted = study.replace("'", "''")
        wanted = f"tags.`{STUDY_TAG}` = '{quoted}' and tags.`{STAGE_TAG}` = '{PARENT}'"
        found = [run for run in client.search_runs([self._experiment_id], wanted) if run.data.tags.get(OUTPUT_TAG) == root]
        if found:
            return {STUDY_TAG: study, PARENT_TAG: found[0].info.run_id}
        own = {"mlflow.runName": study, STUDY_TAG: study, STAGE_TAG: PARENT, OUTPUT_TAG: root}
        made = client.create_run(self._experiment_id, tags=own)
        client.set_terminated(made.info.run_id, "FINISHED")
        return {STUDY_TAG: study, PARENT_TAG: made.info.run_id}

    def _log_model(self, artefact: Artefact, run_id: str) -> None:
        """The model as an entity of its own, once, that evaluations are linked to."""
        from mlflow.entities import LoggedModelOutput

        client = self._connected()
        made = self._models_of(artefact.digest)
        if not made:
            name = re.sub(r"[/:.%'\"]", "_", artefact.label)
            kind = str(_flattened(artefact.config).get("estimator.name", ""))
            parameters = {key: str(value)[:500] for key, value in list(_flattened(artefact.config).items())[:PARAMETERS]}
            made = [client.create_logged_model(self._experiment_id, name, run_id, {DIGEST_TAG: artefact.digest}, parameters, kind)]
            client.log_model_artifacts(made[0].model_id, str(artefact.folder))
            client.finalize_logged_model(made[0].model_id, "READY")
        outputs = client.get_run(run_id).outputs
        if outputs is None or not outputs.model_outputs:
            client.log_outputs(run_id, [LoggedModelOutput(made[0].model_id, 0)])

    def _link_model(self, artefact: Artefact, run_id: str) -> None:
        from mlflow.entities import LoggedModelInput

        made = self._models_of(str(artefact.inputs["model"]))
        inputs = self._connected().get_run(run_id).inputs
        if made and (inputs is None or not inputs.model_inputs):
            self._connected().log_inputs(run_id, models=[LoggedModelInput(made[0].model_id)])

    def _models_of(self, digest: str) -> list[Any]:
        return list(self._connected().search_logged_models([self._experiment_id], filter_string=f"tags.`{DIGEST_TAG}` = '{digest}'"))

    def _identity(self, artefact: Artefact) -> dict[str, str]:
        """Tags that say whose run it is, and by them is found again."""
        return {
            "mlflow.runName": artefact.label,
            STAGE_TAG: artefact.stage,
            KEY_TAG: artefact.key,
            DIGEST_TAG: artefact.digest,
            "vehest.status": artefact.status,
            "mlflow.source.name": " ".join(["vehest", *sys.argv[1:]])[:500],
            "mlflow.source.type": "LOCAL",
            **({"mlflow.source.git.commit": str(artefact.provenance["commit"])} if artefact.provenance.get("commit") else {}),
            OUTPUT_TAG: str(self._output.resolve()),
        }

    def _begun(self, artefact: Artefact) -> Any:
        """The run of an artefact that a killed process began to log from this output root, to be completed.

        Such a run of a former content of the artefact, as of a training that was interrupted, ends as killed.
        """
        unfinished = [run for run in self._runs_of(artefact) if run.info.status == UNFINISHED]
        own = [run for run in unfinished if run.data.tags.get(OUTPUT_TAG) == str(self._output.resolve())]
        same = [run for run in own if run.data.tags.get(DIGEST_TAG) == artefact.digest]
        for run in own:
            if run not in same[:1]:
                self._connected().set_terminated(run.info.run_id, KILLED)
        return same[0] if same else None

    def _connected(self) -> Any:
        if self._client is None:
            os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
            os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")
            from mlflow import MlflowClient

            for noisy in ("mlflow", "alembic"):
                logging.getLogger(noisy).setLevel(logging.ERROR)
            logging.getLogger("mlflow.store.db.utils").setLevel(logging.CRITICAL)  # its errors are raised too, and said in our words

            if not self._uri:
                self._make_store()
                _look_into(self._output / SQLITE)
            client = MlflowClient(self.uri)
            found = client.get_experiment_by_name(self._experiment)
            location = None if self._uri else (self._output / ARTIFACTS).resolve().as_uri()
            self._experiment_id = found.experiment_id if found else client.create_experiment(self._experiment, location)
            self._client = client
        return self._client

    def _make_store(self) -> None:
        """The local store with its tables, made aside: a process that is killed at it leaves no half of them."""
        remove_leftovers(self._output)
        if not (self._output / SQLITE).exists():
            from mlflow import MlflowClient

            with written_aside(self._output / SQLITE) as aside:
                MlflowClient(_sqlite(aside)).search_experiments(max_results=1)


def _look_into(store: Path) -> None:
    """Ask a local store for its tables, since MLflow asks a damaged one again and again for hours.

    Raises:
        DataError: it is no file.
        sqlite3.DatabaseError: it is no store, or a damaged one.
    """
    with closing(sqlite3.connect(f"{regular_file(store).resolve().as_uri()}?mode=rw", uri=True)) as connection:
        connection.execute("select name from sqlite_master").fetchall()


def _datasets(artefact: Artefact) -> list[Any]:
    """Data sets behind an artefact, as MLflow shows them: recordings that it was made from, together one a data set."""
    from mlflow.entities import Dataset, DatasetInput, InputTag

    digests: dict[str, dict[str, str]] = {}
    for name, digest in artefact.inputs.items():
        dataset, slash, recording = name.rpartition("/")
        if slash and not name.startswith("reference of "):
            digests.setdefault(dataset, {})[recording] = digest
    context = InputTag("mlflow.data.context", "training" if artefact.stage == "train" else artefact.stage)
    found = []
    for dataset, recordings in digests.items():
        digest = hashlib.sha256(json.dumps(recordings, sort_keys=True).encode()).hexdigest()[:16]
        source = json.dumps({"dataset": dataset, "recordings": sorted(recordings)})[:SOURCE_LENGTH]
        found.append(DatasetInput(Dataset(dataset[:255], digest, "vehest", source), [context]))
    return found


def _sqlite(file: Path) -> str:
    return f"sqlite:///{file.resolve()}"


def _over_epochs(history: Path | None) -> list[tuple[str, float, int]]:
    if history is None or not history.is_file():
        return []
    rows = read_rows(history)
    if not rows or "epoch" not in rows[0]:
        return []
    return [
        (key, number_in(row, key, history), int(number_in(row, "epoch", history, finite=True)))
        for row in rows
        for key in row
        if key != "epoch"
    ]


def _flattened(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, Mapping):
            flat |= _flattened(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def _first_line(error: Exception) -> str:
    text = str(error).strip()
    return text.splitlines()[0][:160] if text else type(error).__name__
