"""Runs in MLflow: every training and every evaluation, from one writer; when the server is away, work goes on and says so."""

from __future__ import annotations

import csv
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from vehest.stages.artefacts import MANIFEST, Artefact

BATCH = 1000  # figures a request, which is what a server takes
PARAMETERS = 100
SQLITE = "mlflow.db"
ARTIFACTS = "mlartifacts"


class Tracker:
    """Logs artefacts as MLflow runs.

    Args:
        config: ``tracking`` of the configuration.
        output: the output root, where the local store lies.
        warn: called with one line when tracking has to be given up.
    """

    def __init__(self, config: Mapping[str, Any], output: Path, warn: Callable[[str], None]) -> None:
        self._wanted = config.get("name") == "mlflow"
        self._uri = config.get("uri")
        self._experiment = str(config.get("experiment", "vehest"))
        self._output = output
        self._warn = warn
        self._client: Any = None
        self._experiment_id = ""

    @property
    def uri(self) -> str:
        """Where runs go."""
        return str(self._uri) if self._uri else f"sqlite:///{(self._output / SQLITE).resolve()}"

    def log(
        self,
        artefact: Artefact,
        tags: Mapping[str, str],
        metrics: Mapping[str, float],
        history: Path | None = None,
        figures: Mapping[str, Callable[[], Any]] | None = None,
    ) -> None:
        """Log one artefact as a run: its configuration, figures, figures over epochs, files, manifest and drawings.

        Args:
            artefact: what a stage made; its label is the run's name.
            tags: study, data set and the like.
            metrics: final figures.
            history: CSV with a column ``epoch`` and figures over it.
            figures: file name -> what draws it (a matplotlib figure, or none if there is nothing to draw).
        """
        if not self._wanted:
            return
        drawings = {name: draw() for name, draw in (figures or {}).items()}
        try:
            self._log(artefact, tags, metrics, history, drawings)
        except Exception as error:  # whatever a tracking server does, results matter more
            self._wanted = False
            self._warn(f"MLflow at {self.uri} does not answer ({_first_line(error)}); going on without tracking")

    def _log(
        self, artefact: Artefact, tags: Mapping[str, str], metrics: Mapping[str, float], history: Path | None, drawings: Mapping[str, Any]
    ) -> None:
        client = self._connected()
        from mlflow.entities import Metric, Param, RunTag

        all_tags = {
            "mlflow.runName": artefact.label,
            "vehest.stage": artefact.stage,
            "vehest.key": artefact.key,
            "vehest.status": artefact.status,
        }
        run = client.create_run(self._experiment_id, tags={**all_tags, **tags})
        stamp = run.info.start_time
        points = [Metric(key, value, stamp, 0) for key, value in metrics.items()]
        points += [Metric(key, value, stamp, step) for key, value, step in _over_epochs(history)]
        parameters = [Param(key, str(value)[:500]) for key, value in _flattened(artefact.config).items()]
        run_tags = [RunTag(f"vehest.{key}", str(value)) for key, value in artefact.provenance.items() if not isinstance(value, dict)]
        client.log_batch(run.info.run_id, tags=run_tags)
        for start in range(0, len(parameters), PARAMETERS):
            client.log_batch(run.info.run_id, params=parameters[start : start + PARAMETERS])
        for start in range(0, len(points), BATCH):
            client.log_batch(run.info.run_id, metrics=points[start : start + BATCH])
        for file in [*artefact.outputs, MANIFEST]:
            folder = Path(file).parent.as_posix()
            if not file.endswith(".parquet"):
                client.log_artifact(run.info.run_id, str(artefact.folder / file), None if folder == "." else folder)
        for name, drawing in drawings.items():
            if drawing is not None:
                client.log_figure(run.info.run_id, drawing, f"figures/{name}")
        client.set_terminated(run.info.run_id, "FINISHED" if artefact.status == "complete" else "KILLED")

    def _connected(self) -> Any:
        if self._client is None:
            os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
            os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")
            from mlflow import MlflowClient

            for noisy in ("mlflow", "mlflow.store.db.utils", "alembic"):
                logging.getLogger(noisy).setLevel(logging.ERROR)

            self._output.mkdir(parents=True, exist_ok=True)
            client = MlflowClient(self.uri)
            found = client.get_experiment_by_name(self._experiment)
            location = None if self._uri else (self._output / ARTIFACTS).resolve().as_uri()
            self._experiment_id = found.experiment_id if found else client.create_experiment(self._experiment, location)
            self._client = client
        return self._client


def _over_epochs(history: Path | None) -> list[tuple[str, float, int]]:
    if history is None or not history.is_file():
        return []
    with open(history, newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    if not rows or "epoch" not in rows[0]:
        return []
    return [(key, float(value), int(row["epoch"])) for row in rows for key, value in row.items() if key != "epoch"]


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
