"""Logs trainings, calibrations and evaluations to MLflow, one run an artefact, found again by its
tags.

One process writes. When the store does not answer, work goes on without it, and the next run logs
the missing artefacts.
"""

from __future__ import annotations

import logging
import os
import sqlite3
import sys
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from vehest.artefacts.artefact import MANIFEST, Artefact
from vehest.artefacts.locks import Lock, held
from vehest.configuration.composition import dotted
from vehest.data.errors import MissingError, printable
from vehest.data.files import regular_file, remove_leftovers, written_aside
from vehest.run.calibrate import calibration_figures
from vehest.run.evaluate import test_figures
from vehest.run.train import HISTORY, read_fit_metrics
from vehest.studies.artefacts import read_frame

STORE = "mlflow.db"  # name of MLflow's local store in the output root
REMOTE_ARTIFACTS = frozenset(
    ["mlflow-artifacts", "http", "https", "s3", "gs", "wasbs", "abfss", "ftp", "sftp", "hdfs"]
)  # schemes of addresses at which MLflow writes to another machine
LOCAL_STORES = frozenset(["sqlite", "file", ""])  # schemes of stores that no server answers for
VALUES_A_REQUEST = 100  # largest number of parameters that a server takes in one request
VALUE_LENGTH = 500  # characters of a value in MLflow; longer ones are cut off
KEY_TAG = "vehest.key"  # MLflow tag of a run: key of its artefact
STAGE_TAG = "vehest.stage"  # MLflow tag of a run: stage
DIGEST_TAG = "vehest.digest"  # MLflow tag of a run: digest of its artefact
OUTPUT_TAG = "vehest.output"  # MLflow tag of a run: output root
STUDY_TAG = "vehest.study"  # MLflow tag of a run: study
# stage -> function that reads the metrics of an artefact's folder
METRICS: Mapping[str, Callable[[Path], Mapping[str, float]]] = {
    "train": read_fit_metrics,
    "calibrate": calibration_figures,
    "evaluate": test_figures,
}


@dataclass(eq=False)
class Tracker:
    """Logs artefacts as MLflow runs, each once."""

    config: Mapping[str, Any]  # ``tracking`` of the configuration
    output: Path  # the output root, with the local store
    warn: Callable[[str], None]  # called with one line when tracking is given up
    should_stop: Callable[[], bool] = lambda: False  # asked while another process logs
    study: str = ""  # name of the study or sweep above the runs
    # whether every artefact was logged; without MLflow too
    complete: bool = field(default=True, init=False)

    @property
    def store(self) -> str:
        """Name of the local store in the output root.

        Empty where nothing is tracked, or a server has the runs.
        """
        return STORE if self.config.get("name") == "mlflow" and not self.config.get("uri") else ""

    def log(self, *artefacts: Artefact | None) -> None:
        """Log models, calibrations and evaluations as runs while no other process logs, each unless
        it is logged; None is skipped.

        A failure is printed as a warning once and ends tracking for this run; no error is raised.
        """
        if self.config.get("name") != "mlflow" or not self.complete:
            return
        self.complete = False
        try:
            with held(Lock(self.output, "tracking", "mlflow"), self.should_stop) as mine:
                for artefact in artefacts if mine else ():
                    if artefact is not None:
                        self._log(artefact)
                self.complete = mine
        except Exception as error:  # results matter more than any failure of a tracking server
            why = next(iter(str(error).strip().splitlines()), type(error).__name__)[:160]
            self.warn(
                f"logging to MLflow at {printable(self._address)} failed ({why}); going on without "
                "tracking, the next run makes up for it"
            )

    def _log(self, artefact: Artefact) -> None:
        """Log one artefact: parameters, figures, history and files but recordings; a run that a
        killed process began is continued.
        """
        from mlflow.entities import Metric, Param

        client = self._client
        tags = {KEY_TAG: artefact.key, STAGE_TAG: artefact.stage, DIGEST_TAG: artefact.digest}
        runs = self._runs(tags)
        if any(run.info.status != "RUNNING" for run in runs):
            return
        begun = [
            run for run in runs if run.data.tags.get(OUTPUT_TAG) == self._root
        ]  # by a process that was killed
        run = (
            begun[0]
            if begun
            else self._new_run(
                artefact.label,
                tags | ({"mlflow.parentRunId": self._parent()} if self.study else {}),
            )
        )
        run_id = str(run.info.run_id)
        time = run.info.start_time  # metrics with the same time are kept once
        parameters = [
            Param(key, str(value)[:VALUE_LENGTH]) for key, value in dotted(artefact.config)
        ]
        points = [
            Metric(key, value, time, 0)
            for key, value in METRICS[artefact.stage](artefact.folder).items()
        ]
        if (artefact.folder / HISTORY).is_file():
            history = read_frame(artefact.folder / HISTORY)
            rows = history.melt("epoch").itertuples(index=False) if "epoch" in history else ()
            points += [Metric(key, float(value), time, int(epoch)) for epoch, key, value in rows]
        for start in range(0, max(len(points), len(parameters)), VALUES_A_REQUEST):
            batch = slice(start, start + VALUES_A_REQUEST)
            client.log_batch(run_id, points[batch], parameters[batch])
        repository = self._artifact_repository(str(run.info.artifact_uri))
        for file in [*artefact.outputs, MANIFEST]:
            if not file.endswith(".parquet"):
                repository.log_artifact(str(artefact.folder / file), os.path.dirname(file) or None)
        client.set_terminated(run_id, "FINISHED" if artefact.status == "complete" else "KILLED")

    def _artifact_repository(self, address: str) -> Any:
        """Return MLflow's repository at the address of a run's artefacts, which its store names.

        No server may choose a folder of this machine. `MlflowClient.log_artifact` would ask the
        server for the address again and may be answered differently.
        """
        by_server = urlsplit(self._address).scheme not in LOCAL_STORES
        if by_server and urlsplit(address).scheme not in REMOTE_ARTIFACTS:
            raise MissingError(
                f"it names '{printable(address[:80])}' for artefacts, which is no server; start it "
                "with --serve-artifacts and without --default-artifact-root"
            )
        from mlflow.store.artifact.artifact_repository_registry import get_artifact_repository

        return get_artifact_repository(address, tracking_uri=self._address)

    def _runs(self, tags: Mapping[str, str]) -> list[Any]:
        """Runs of the experiment that have these tags."""
        condition = " and ".join(
            f"tags.`{name}` = '{value}'" for name, value in tags.items()
        )  # hashes and names of files: without quotes
        return list(self._client.search_runs([self._experiment_id], condition))

    def _new_run(self, name: str, tags: Mapping[str, str]) -> Any:
        """Begin a run with a name, the command and tags."""
        source = " ".join(["vehest", *sys.argv[1:]])[:VALUE_LENGTH]
        about = {"mlflow.runName": name, "mlflow.source.name": source, OUTPUT_TAG: self._root}
        return self._client.create_run(self._experiment_id, tags={**about, **tags})

    def _parent(self) -> str:
        """Id of the study's run, above those of its artefacts."""
        tags = {STUDY_TAG: self.study, STAGE_TAG: "study"}
        runs = [run for run in self._runs(tags) if run.data.tags.get(OUTPUT_TAG) == self._root]
        run_id = str((runs[0] if runs else self._new_run(self.study, tags)).info.run_id)
        if not runs:
            self._client.set_terminated(run_id, "FINISHED")
        return run_id

    @cached_property
    def _client(self) -> Any:
        """MLflow's client, connected once; the local store is made in one step where it is
        missing.
        """
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")
        from mlflow import MlflowClient

        for noisy in ("mlflow", "alembic"):
            logging.getLogger(noisy).setLevel(logging.ERROR)
        logging.getLogger("mlflow.store.db.utils").setLevel(
            logging.CRITICAL
        )  # its errors are raised too
        if self.store:
            store = self.output / STORE
            _require_sqlite_path(store.resolve())
            remove_leftovers(self.output)
            if not store.exists():
                with written_aside(
                    store
                ) as aside:  # a process that is killed here leaves no store with half of its tables
                    MlflowClient(f"sqlite:///{aside.resolve()}").search_experiments(max_results=1)
            address = f"{regular_file(store).resolve().as_uri()}?mode=rw"
            with closing(
                sqlite3.connect(address, uri=True)
            ) as connection:  # MLflow retries a damaged store for hours
                connection.execute("select name from sqlite_master").fetchall()
        return MlflowClient(self._address)

    @cached_property
    def _experiment_id(self) -> str:
        """Id of the experiment that the configuration names, which is created where it is
        missing.
        """
        name = str(self.config.get("experiment", "vehest"))
        location = (self.output / "mlartifacts").resolve().as_uri() if self.store else None
        experiment = self._client.get_experiment_by_name(name)
        return str(
            experiment.experiment_id
            if experiment
            else self._client.create_experiment(name, location)
        )

    @property
    def _root(self) -> str:
        """The output root as an absolute path, which distinguishes runs of several roots."""
        return str(self.output.resolve())

    @property
    def _address(self) -> str:
        """Address of the store: that of the configuration, else the local one."""
        return str(self.config.get("uri") or f"sqlite:///{(self.output / STORE).absolute()}")


def _require_sqlite_path(store: Path) -> None:
    """Raise an error for a path that MLflow would read as another one or cannot use.

    SQLAlchemy takes what follows ``?`` for options and ``%20`` for a blank. Quoted it reads the
    path, but MLflow creates the folder of the quoted path, too.
    """
    from sqlalchemy import make_url

    is_text = all(not "\ud800" <= letter <= "\udfff" for letter in str(store))
    if not is_text or make_url(f"sqlite:///{store}").database != str(store):
        raise MissingError(
            "MLflow opens no store at a path with '?', '%' before two hexadecimal digits or bytes "
            "that are not UTF-8; give another output=FOLDER, or tracking=none"
        )
