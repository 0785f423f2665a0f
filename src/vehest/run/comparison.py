"""A comparison of estimators on one split, from its jobs to what a report draws.

jobs -> `plan` (rates, required channels, trainings in groups that fit one batch) -> `Runner.run` ->
`collect`
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from vehest.artefacts.artefact import Artefact
from vehest.configuration.composition import OVERRIDDEN_RATES_KEY, Config
from vehest.data.car import CarValues
from vehest.data.errors import ConfigurationError, DataError, VehestError
from vehest.data.recording_summary import RecordingSummary
from vehest.data.splits import Split
from vehest.estimators.registry import new_estimator
from vehest.inference.car_values import with_car_values
from vehest.inference.models import find_model
from vehest.run.evaluate import Evaluation, protocol_from_config
from vehest.run.evaluate_faults import check_channels, faults_of, union_of_faults
from vehest.run.failures import Failure, failure_of
from vehest.run.group import Group, Member
from vehest.run.next_commands import command_line, location_of_config
from vehest.run.runner import Runner
from vehest.run.signals import DryRunStop
from vehest.run.study import Job, failure_messages
from vehest.run.train import TrainJob, estimator_rate, model_artefact, plan_train
from vehest.run.training_differences import Differences, difference_text, differences_of
from vehest.run.usable import lack
from vehest.studies.reference_minutes import describe_start

# reason for a training that is missing since it was stopped or out of time
NO_TIME = "not done yet: its training was stopped or out of time; vehest run goes on with it"
NOT_TRAINED = "not trained yet"  # reason for a training that is missing since it was not begun
RATE_TOLERANCE = 1e-9  # relative difference up to which two rates are equal

Note = tuple[str, str]
"""A lowered rate: the estimator, or ``evaluation``, and the rest of the sentence that is printed on
it.
"""


@dataclass
class Comparison:
    """A comparison: jobs on one split, their planned trainings and, in the end, their trained and
    evaluated members.

    Labelled jobs of a sweep are each evaluated under their own faults and may fail alone; those of
    a study are all evaluated under the faults of all.
    """

    jobs: Sequence[Job]  # trainings with their evaluations, as configured
    groups: Sequence[Group] = ()  # trainings that fit one batch
    facts: Sequence[str] = ()  # budgets of trainings, preparation of recordings, lowered rates
    evaluation: Evaluation = field(init=False)  # split, references and protocol of all jobs
    data_titles: Mapping[str, str] = field(default_factory=dict)  # data set -> title in the report
    cars: Mapping[str, CarValues] = field(default_factory=dict)  # data set -> values of its car
    # key of a training -> its trained and evaluated member
    finished: Mapping[str, Member] = field(default_factory=dict)
    # key of a training -> options in which it differs from others of its variant and seed
    differences: Mapping[str, Differences] = field(default_factory=dict)
    reason_unfinished: str = NO_TIME  # reason that is stated for trainings without a member

    @property
    def usable(self) -> list[Job]:
        """Jobs that have not failed."""
        return [job for job in self.jobs if job.failure is None]

    @property
    def members(self) -> list[Member]:
        """Trained and evaluated members in the order of the jobs."""
        keys = dict.fromkeys(job.training.plan.key for job in self.jobs if job.training is not None)
        return [self.finished[key] for key in keys if key in self.finished]

    @property
    def unfinished(self) -> list[str]:
        """Names of the trainings that have no member yet, for lack of time."""
        trainings = [job.training for job in self.usable if job.training is not None]
        remaining = [training for training in trainings if training.plan.key not in self.finished]
        return list(
            dict.fromkeys(
                label_of(training) + difference_text(self.differences.get(training.plan.key, {}))
                for training in remaining
            )
        )

    @property
    def failed(self) -> dict[str, str]:
        """Name of each training that is left out -> the reason."""
        return {
            name: failure.message for name, failure in named_failures(self.jobs)
        } | dict.fromkeys(self.unfinished, self.reason_unfinished)

    def plan(self, runner: Runner) -> Sequence[Group]:
        """Fit jobs to the recordings of their split, find those that lack something, and plan
        groups of trainings; makes data on the way.

        Parameters
        ----------
        runner : Runner
            Makes recordings at the rates that are needed, and prints.

        Returns
        -------
        sequence of Group
            As `Runner.run` takes them; jobs that cannot be done have their ``failure`` set.

        Raises
        ------
        ConfigurationError
            A wrong setting.
        DataError
            No job can be done.
        DryRunStop
            A dry run would make data.
        """
        usable = self.usable
        labels = dict[Any, str]()
        self._print_failures(self.jobs, runner)
        evaluated = "evaluation" in usable[0].config
        try:
            split = runner.split(usable[0].config)
            contents = runner.contents(usable[0].config)
            runner.warn_of_references(split, usable[0].config)
            self.cars = runner.cars(usable[0].config, split.datasets)
            for job in usable:
                job.config = with_car_values(job.config, self.cars.values())
            notes = dict.fromkeys(
                note for job in usable for note in _fit_to_recordings(job, split, contents)
            )
            print_notes(notes, runner)
            self._print_failures(usable, runner)
            checked = self.usable
            for job in checked:
                try:
                    data = runner.data_for(split, estimator_rate(job.config), job.config)
                    training = plan_training(job.config, split, data)
                    check_channels(faults_of(job.config), split, data)
                    _check_label(job, training, labels)
                    job.training = training
                except VehestError as error:
                    if not job.label and not isinstance(error, DataError):
                        raise
                    job.failure = failure_of(error)
            self.differences = differences_of(
                job.training for job in checked if job.training is not None and not job.label
            )
            if evaluated and checked:
                self.evaluation = runner.evaluation(usable[0].config, {})
        except DryRunStop:
            for name in _names(self.usable):
                runner.messages.line("plan", "train", name)
            raise
        if not self.usable:
            location = location_of_config(usable[0].config)
            commands = ", ".join(
                f"'{command_line('data usable', [name, *location])}'" for name in split.datasets
            )
            raise DataError(
                "none of these estimators can be used with the recordings of split "
                f"'{split.name}'; {failure_messages(usable)}; "
                f"{commands} shows what each estimator needs"
            )
        self._print_failures(checked, runner)
        self.groups = self._groups(split, runner.force, evaluated=evaluated)
        if evaluated:
            configs = [job.config for job in checked]
            self.facts = [
                *training_facts(configs),
                resampling_fact(configs),
                *(f"{subject} {text}" for subject, text in notes),
            ]
            datasets = {
                name: runner.dataset_config(name, usable[0].config)["dataset"]
                for name in split.datasets
            }
            self.data_titles = {
                name: str(dataset.get("title", name)) for name, dataset in datasets.items()
            }
        return self.groups

    def _groups(self, split: Split, force: frozenset[str], *, evaluated: bool) -> list[Group]:
        """Groups of trainings that fit one batch; combinations of a sweep that differ only in their
        fault share a training.
        """
        of_training: dict[str, tuple[TrainJob, list[Job]]] = {}
        for job in self.usable:
            if job.training is not None:
                of_training.setdefault(job.training.plan.key, (job.training, []))[1].append(job)
        groups: dict[Any, list[TrainJob]] = {}
        for training, jobs in of_training.values():
            faults = union_of_faults(
                faults_of(job.config) for job in (jobs if jobs[0].label else self.usable)
            )
            groups.setdefault((training.group, faults, jobs[0].label), []).append(training)
        return [
            Group(
                trainings,
                split,
                replace(self.evaluation, data=trainings[0].data, faults=faults)
                if evaluated
                else None,
                force,
                label,
                self.cars,
            )
            for (_, faults, label), trainings in groups.items()
        ]

    def collect(self, members: Mapping[str, Member], failed: Mapping[str, Failure]) -> None:
        """Take the results of the trainings into ``finished`` and the jobs' failures.

        Parameters
        ----------
        members : mapping
            Key of a training -> its member; those without an evaluation count as unfinished.
        failed : mapping
            Key of a training -> why it failed.
        """
        self.finished = {
            key: member for key, member in members.items() if member.evaluation is not None
        }
        for job in self.usable:
            if job.training is not None:
                job.failure = failed.get(job.training.plan.key)

    def _print_failures(self, jobs: Sequence[Job], runner: Runner) -> None:
        """Print a line for each failure, unless the comparison has a single job, whose error is
        raised.
        """
        for name, failure in named_failures(jobs) if len(self.jobs) > 1 else ():
            runner.messages.line("fail", "train", name, failure.message)


def _fit_to_recordings(
    job: Job, split: Split, contents: Mapping[str, Sequence[RecordingSummary]]
) -> list[Note]:
    """Lower the rates of a job to those of recordings and return notes on it; the job fails where
    these lack something.
    """
    job.config, notes = lower_rate(job.config, "evaluation", slowest(contents))
    try:
        job.config, more = lower_rate(job.config, "estimator", slowest(contents))
        reason = lack(job.config, split, contents)
        if reason:
            raise DataError(reason)
        return [*notes, *more]
    except DataError as error:
        job.failure = failure_of(error)
        return []


def slowest(contents: Mapping[str, Sequence[RecordingSummary]]) -> RecordingSummary:
    """Summary of the recording with the lowest rate among all data sets.

    Parameters
    ----------
    contents : mapping
        Data set -> its recordings.
    """
    return min(
        (recording for recordings in contents.values() for recording in recordings),
        key=lambda recording: recording.rate_hz,
    )


def lower_rate(config: Config, group: str, limit: RecordingSummary) -> tuple[Config, list[Note]]:
    """Configuration with ``GROUP.rate_hz`` no higher than a recording's, and a note if it was.

    Parameters
    ----------
    config : Config
        Of a job; it stays unchanged.
    group : str
        ``estimator`` or ``evaluation``; a configuration without it is returned as it is.
    limit : RecordingSummary
        The recording with the lowest rate.

    Returns
    -------
    tuple
        Configuration and notes, for people. A note on an estimator names settings in samples whose
        duration changes.

    Raises
    ------
    DataError
        The rate was given by an override, or the estimator cannot run at the lower one.
    ConfigurationError
        A setting of the group is wrong.
    """
    if group not in config:
        return config, []
    is_estimator = group == "estimator"
    rate = estimator_rate(config) if is_estimator else protocol_from_config(config[group]).rate_hz
    key = f"{group}.rate_hz"
    lowest = limit.rate_hz
    if not rate > lowest * (1.0 + RATE_TOLERANCE):
        return config, []
    sampled = f"recording '{limit.id}' is sampled at {lowest:g} Hz"
    if key in config.get(OVERRIDDEN_RATES_KEY, ()):
        raise DataError(
            f"{key} asks for {rate:g} Hz, and {sampled}; give {key}={lowest:g} or less, or leave "
            "it out for that"
        )
    lowered = {**config, group: {**config[group], "rate_hz": lowest}}
    if group == "evaluation":
        return lowered, [
            (group, f"reads estimates at {lowest:g} Hz instead of {rate:g} Hz, since {sampled}")
        ]
    name = new_estimator(config["estimator"]).name
    try:
        settings = new_estimator(lowered["estimator"]).settings
    except ConfigurationError as error:
        raise DataError(
            f"estimator '{name}' cannot run at {lowest:g} Hz, and {sampled}: {error}"
        ) from None
    samples = {"estimator.window": getattr(settings, "window", None)}  # a float counts seconds
    samples |= {
        f"training.{key}": value
        for key, value in config["training"].items()
        if key == "steps" or key.endswith("_steps")
    }
    lengths = [
        f"; {key} of {number} samples lasts {number / lowest:.3g} s instead of {number / rate:.3g} "
        f"s ({key}={max(1, round(number * lowest / rate))} keeps that)"
        for key, number in samples.items()
        if isinstance(number, int) and number > 0
    ]
    return lowered, [
        (
            name,
            f"runs at {lowest:g} Hz instead of its {rate:g} Hz, since {sampled}{''.join(lengths)}",
        )
    ]


def print_notes(notes: Iterable[Note], runner: Runner) -> None:
    """Print notes on lowered rates, each once."""
    for subject, text in notes:
        key = "evaluation.rate_hz" if subject == "evaluation" else "estimator.rate_hz"
        line = ("note", "rate", subject, f"{text}; {key}=… chooses a lower rate")
        if line not in runner.messages.printed:
            runner.messages.line(*line)


def plan_training(
    config: Mapping[str, Any], split: Split, data: Mapping[str, Artefact]
) -> TrainJob:
    """Plan a training from scratch, or from another model's weights, whose digest is then one of
    its inputs; see `plan_train`.

    Raises as `plan_train` does, and `MissingError` where the model to start from is not there.

    Parameters
    ----------
    config : mapping
        As composed for ``train``; ``training.start_from`` is a model or None.
    split : Split
        Ranges of training and validation.
    data : mapping
        Data set -> recordings at the estimator's rate.
    """
    job = plan_train(config, split, data)
    start = config["training"].get("start_from")
    if start is None:
        return job
    folder = find_model(str(start), job.plan.output, lambda _: None)
    plan = replace(
        job.plan, inputs={**job.plan.inputs, f"start from {start}": model_artefact(folder).digest}
    )
    return replace(job, plan=plan, training={**job.training, "start_from": str(folder.resolve())})


def _check_label(job: Job, training: TrainJob, labels: dict[Any, str]) -> None:
    """Raise `ConfigurationError` for a combination of a sweep that is the same training as another
    one.
    """
    if job.label:
        twin = labels.setdefault((training.plan.key, faults_of(job.config)), job.label)
        if twin != job.label:
            raise ConfigurationError(f"it is the same training as {twin}")


def name_in_part(part: str, name: str, parts: Collection[str]) -> str:
    """Name of a training in messages on a study: parts of one study often train the same estimator
    and seed.
    """
    return f"{name} in part '{part}'" if len(parts) > 1 else name


def label_of(training: TrainJob) -> str:
    """Name of a training in messages, with the model that it starts from, which its folder's name
    does not contain.
    """
    return training.plan.label + describe_start(training.training)


def named_failures(jobs: Sequence[Job]) -> list[tuple[str, Failure]]:
    """Failures of one comparison as (name, failure); jobs that differ only in their seed and failed
    alike have one name.
    """
    jobs_of_failure: dict[Failure, list[Job]] = {}
    for job in jobs:
        if job.failure is not None:
            jobs_of_failure.setdefault(job.failure, []).append(job)
    return [
        (name, failure) for failure, failed in jobs_of_failure.items() for name in _names(failed)
    ]


def _names(jobs: Iterable[Job]) -> list[str]:
    """Names of jobs; those that differ only in their seed have one."""
    seeds: dict[str, list[str]] = {}
    for job in jobs:
        stem = job.label
        if not stem:
            estimator = new_estimator(job.config["estimator"])
            stem = f"{estimator.name}-{estimator.variant}"
        seeds.setdefault(stem, []).append(str(job.config["seed"]))
    return [
        f"{stem} seed{'s' if len(numbers) > 1 else ''} {', '.join(numbers)}"
        for stem, numbers in seeds.items()
    ]


def resampling_fact(configs: Sequence[Config]) -> str:
    """A sentence on how recordings were brought to the rates that estimators work at.

    Parameters
    ----------
    configs : sequence of Config
        Of all jobs; they share the options of ``downsample``.
    """
    rates = sorted(
        {estimator_rate(config) for config in configs}
        | {protocol_from_config(configs[0]["evaluation"]).rate_hz}
    )
    options = configs[0]["downsample"]
    method = {
        "polyphase": (
            "anti-aliased by a zero-phase polyphase filter (offline: it looks ahead; the "
            "estimators themselves are causal)"
        ),
        "decimate": "by plain decimation",
    }[options["method"]]
    first = (
        f", after {len(options['transforms'])} further transforms" if options["transforms"] else ""
    )
    return (
        f"Recordings at {' and '.join(f'{rate:g}' for rate in rates)} Hz are made from the "
        f"native rate {method}{first}"
    )


def training_facts(configs: Sequence[Config]) -> list[str]:
    """Lines on the budget of each training scheme.

    Options that move no number are left out; estimators with equal options share a line.
    """
    schemes: dict[str, set[str]] = {}
    for config in configs:
        schemes.setdefault(json.dumps(config["training"], default=str), set()).add(
            config["estimator"]["name"]
        )
    facts = []
    for text, names in schemes.items():
        training = json.loads(text)
        options = ", ".join(
            f"{key} {value}"
            for key, value in training.items()
            if key not in {"name", "checkpoint_seconds", "compiled"}
        )
        facts.append(
            f"{', '.join(sorted(names))}: "
            + (f"{training['name']} ({options})" if options else "nothing is trained")
        )
    return list(dict.fromkeys(facts))
