"""Before anything is trained: rates are fitted to the recordings of a split, and what jobs lack is found, of all jobs at once."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field

from vehest.data.errors import DataError
from vehest.data.split_files import dataset_names
from vehest.run.config import Config
from vehest.run.failures import Failure, failure_of
from vehest.run.rates import Note, at_estimator_rate, at_evaluation_rate, slowest
from vehest.run.usable import lack
from vehest.run.workshop import Workshop


@dataclass(frozen=True)
class Fitted:
    """Jobs as they can be run.

    Args:
        configs: of the jobs, at rates that the recordings have.
        failures: position of a job that cannot be done -> why.
        notes: rates that were lowered, each once.
    """

    configs: Sequence[Config]
    failures: dict[int, Failure] = field(default_factory=dict)
    notes: Sequence[Note] = ()

    @property
    def facts(self) -> list[str]:
        """What a report says of rates that were lowered, a line each."""
        return [f"{note.what} {note.told}" for note in self.notes]


def fitted(configs: Sequence[Config], workshop: Workshop) -> Fitted:
    """Fit jobs to the recordings of their split, which are ingested for it; only the descriptions of their files are read.

    Args:
        configs: as composed for ``train`` or ``eval``, of one split.
        workshop: where rates that are lowered are said.

    Raises:
        ConfigurationError: a setting makes no sense.
        DataError: the evaluation is to read estimates more often than recordings are sampled.
        NotThereYet: in a dry run, if recordings would have to be made.
    """
    split, contents = workshop.split(configs[0]), workshop.contents(configs[0])
    limit = slowest(contents)
    made, failures, notes = [], {}, dict[Note, None]()
    reasons: dict[str, Failure | None] = {}
    for position, given in enumerate(configs):
        config, told = at_evaluation_rate(given, limit)
        try:
            config, more = at_estimator_rate(config, limit)
            same = json.dumps([config["estimator"], config["training"]], sort_keys=True, default=str)
            if same not in reasons:
                reason = lack(config, split, contents)
                reasons[same] = Failure(reason, exit_code=DataError.exit_code) if reason else None
            failure, told = reasons[same], (*told, *more)
        except DataError as error:
            failure = failure_of(error)
        if failure is None:
            notes |= dict.fromkeys(told)
        else:
            failures[position] = failure
        made.append(config)
    for note in notes:
        workshop.note(note)
    return Fitted(made, failures, tuple(notes))


def fitted_job(config: Config, workshop: Workshop) -> Config:
    """Fit one job.

    Raises:
        DataError: recordings lack what its estimator needs, or an override asks for more than their rate.
        NotThereYet: in a dry run, if recordings would have to be made.
    """
    found = fitted([config], workshop)
    for failure in found.failures.values():
        names = ", ".join(f"'vehest data usable {name}'" for name in dataset_names(config["split"]))
        raise DataError(f"{failure.message}; {names} says what each estimator needs")
    return found.configs[0]


def fitted_evaluation(config: Config, workshop: Workshop) -> Config:
    """Fit the evaluation alone, of a model that has its rate.

    Raises:
        DataError: an override asks for more than the rate of the recordings.
        NotThereYet: in a dry run, if recordings would have to be made.
    """
    config, notes = at_evaluation_rate(config, slowest(workshop.contents(config)))
    for note in notes:
        workshop.note(note)
    return config
