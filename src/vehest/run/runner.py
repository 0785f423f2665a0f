"""Runs stages into one output root: existing artefacts are reused, missing ones are made, every
step is printed.

Jobs -> split, recordings at their rates (`Runner.split`, `data_for`) -> groups -> launcher ->
members -> tracking
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from vehest.artefacts.artefact import Artefact, StagePlan, Write, ensured, find
from vehest.artefacts.keys import hash_of
from vehest.artefacts.locks import Waiting
from vehest.configuration.composition import Config, compose_config, missing_keys, quoted
from vehest.data.car import CarValues
from vehest.data.errors import DataError
from vehest.data.recording_summary import RecordingSummary, stored_summary
from vehest.data.split_files import Reader, dataset_names, split_from_config
from vehest.data.splits import Split
from vehest.data.store import read_recording
from vehest.estimators.kernels.compiling import has_to_compile
from vehest.estimators.registry import estimator_class
from vehest.evaluation.metrics import Protocol
from vehest.run.console import REUSED, Bars, Messages
from vehest.run.downsample import plan_downsample, write_downsample
from vehest.run.evaluate import Evaluation, protocol_from_config, test_figures
from vehest.run.evaluate_faults import FaultSettings
from vehest.run.failures import Failure
from vehest.run.group import Group, Member, existing
from vehest.run.ingest import STAGE as INGEST
from vehest.run.ingest import parts_of, plan_ingest, recording_file, write_ingest
from vehest.run.launchers.local import LocalLauncher
from vehest.run.printing import describe_finding
from vehest.run.reference_checks import reference_findings
from vehest.run.signals import DryRunStop, StopSignals, TimeLimit
from vehest.run.tracking import Tracker
from vehest.run.train import DIVERGED, TrainJob, read_fit_metrics
from vehest.run.train import STAGE as TRAIN
from vehest.run.weights import PublishedWeights, publish_weights
from vehest.sources.base import SIMULATED, car_of, kind_of, open_source
from vehest.training.context import Progress
from vehest.trust.health import SLOW_KERNEL
from vehest.trust.record import read_trust

if TYPE_CHECKING:
    from vehest.run.launchers.base import Launcher

Value = TypeVar("Value")
ALL = "all groups"  # name of the progress bar above those of trainings


@dataclass(eq=False)
class Stages:
    """Runs single stages into one output root: recordings at each rate, split and protocol.

    In a dry run `DryRunStop` is raised where something would have to be made.
    """

    output: Path  # output root
    messages: Messages  # prints progress
    stop: StopSignals  # signals that ask to stop
    jobs: int = 1  # processes of an ingest
    force: frozenset[str] = frozenset()  # stages to run although their artefacts are there
    dry_run: bool = False  # whether stages are only listed
    # artefacts that were used so far, by folder
    artefacts: dict[Path, Artefact] = field(default_factory=dict)
    # results of `_once`, by kind and argument
    _results: dict[tuple[str, str], Any] = field(default_factory=dict)

    def _once(self, kind: str, of: Any, make: Callable[[], Value]) -> Value:
        """Return the result of ``make``, which is called only the first time for this kind and
        argument ``of``.
        """
        key = kind, json.dumps(of, sort_keys=True)
        if key not in self._results:
            self._results[key] = make()
        value: Value = self._results[key]
        return value

    def print_waiting(self, waiting: Waiting) -> None:
        """Print which process makes an artefact that this one waits for."""
        self.messages.line(
            "wait", waiting.stage, waiting.label, f"for {waiting.holder}, which makes it"
        )

    def ingest(self, config: Config) -> Artefact:
        """Make the recordings of a data set at their native rate.

        ``config`` is composed for ``ingest``. Raises as `ensure`, `plan_ingest` and `write_ingest`.
        """
        plan = plan_ingest(config)
        with self.messages.bars() as bars:
            report = partial(bars.step, f"ingest {plan.label}")
            artefact = self.ensure(
                plan,
                lambda folder: write_ingest(config, plan, folder, self.jobs, self.stop, report),
            )
        plan.drop(parts_of(plan))
        return artefact

    def downsample(
        self, ingested: Artefact, rate_hz: float, options: Mapping[str, Any]
    ) -> Artefact:
        """Make the recordings of a data set at another rate [Hz]; ``options`` are ``downsample`` of
        a configuration.
        """
        plan = plan_downsample(ingested, rate_hz, options, self.output)
        return self.ensure(plan, lambda folder: write_downsample(ingested, plan.config, folder))

    def dataset_config(self, name: str, config: Config) -> Config:
        """Compose the configuration of a data set's ingest, with the root and output of
        ``config``.
        """
        root = [] if config.get("root") is None else [f"root={quoted(config['root'])}"]
        return self._once(
            "dataset",
            name,
            lambda: {
                **compose_config("ingest", [f"dataset={name}", *root]),
                "output": config["output"],
            },
        )

    def datasets_of(self, config: Config) -> list[Config]:
        """The configuration of every data set of a split."""
        return [
            self.dataset_config(name, config)["dataset"] for name in dataset_names(config["split"])
        ]

    def look_for_files(self, config: Config) -> None:
        """Raise `MissingError` where raw files of a data set of a split are not here; nothing is
        read.
        """

        def look(name: str) -> None:
            dataset = self.dataset_config(name, config)["dataset"]
            if not missing_keys(dataset):  # which its ingest reports
                open_source(dataset).inputs()

        for name in dataset_names(config["split"]):
            self._once("files", name, partial(look, name))

    def _ingested(self, name: str, config: Config) -> Artefact:
        """The ingested recordings of a data set, made or found once a run."""
        return self._once("ingest", name, lambda: self.ingest(self.dataset_config(name, config)))

    def split(self, config: Config) -> Split:
        """The split of a configuration.

        Where its rules name or cut recordings, the data sets are ingested for it.
        """

        def recordings_of(name: str) -> Mapping[str, Reader]:
            ingested = self._ingested(name, config)
            return {
                file.removesuffix(".parquet"): partial(read_recording, ingested.folder / file)
                for file in ingested.outputs
            }

        return self._once(
            "split", config["split"], partial(split_from_config, config["split"], recordings_of)
        )

    def contents(self, config: Config) -> dict[str, tuple[RecordingSummary, ...]]:
        """Data set of a split -> channels and rates of its recordings, which are ingested for it;
        no samples are read.
        """

        def read(name: str) -> tuple[RecordingSummary, ...]:
            ingested = self._ingested(name, config)
            return tuple(stored_summary(ingested.folder / file) for file in ingested.outputs)

        return {
            name: self._once("contents", name, partial(read, name))
            for name in dataset_names(config["split"])
        }

    def warn_of_references(self, split: Split, config: Config) -> None:
        """Warn once of each recording of a split whose reference has another sign or unit, is stuck
        or impossible.

        The stored recordings are checked, so that a warning does not depend on which run has
        ingested them. References of a simulation are right.
        """
        spans = (*split.train, *split.validation, *split.test_spans)
        for dataset, recording in dict.fromkeys((span.dataset, span.recording) for span in spans):
            if self.dataset_config(dataset, config)["dataset"]["source"] != SIMULATED:
                self._once(
                    "references",
                    (dataset, recording),
                    partial(self._warn_of_reference, dataset, recording, config),
                )

    def _warn_of_reference(self, dataset: str, recording: str, config: Config) -> None:
        """Warn of findings in the references of one stored recording."""
        ingested = self._ingested(dataset, config)
        file = recording_file(recording)
        if file not in ingested.outputs:
            return  # which the plan of a training or an evaluation says
        for finding in reference_findings(read_recording(ingested.folder / file)):
            self.messages.warn(
                f"data set '{dataset}', recording '{recording}': {describe_finding(finding)}; "
                "every score against this reference is wrong if that is so"
            )

    def data_for(self, split: Split, rate_hz: float, config: Config) -> dict[str, Artefact]:
        """Data set of a split -> its recordings at a rate [Hz], by ``downsample`` of ``config``."""
        return {
            name: self.downsample(self._ingested(name, config), rate_hz, config["downsample"])
            for name in split.datasets
        }

    def cars(self, config: Config, datasets: Iterable[str]) -> dict[str, CarValues]:
        """Data set -> values of its car."""

        def car(name: str) -> CarValues:
            return car_of(self.dataset_config(name, config)["dataset"])

        return {name: self._once("car", name, partial(car, name)) for name in datasets}

    def protocol(self, config: Config, datasets: Iterable[str]) -> Protocol:
        """Rules of scoring, with the lowest speed at which sideslip is scored on each data set, by
        its car.
        """
        cars = self.cars(config, datasets)
        return protocol_from_config(config["evaluation"]).with_wheelbases(
            {name: car.wheelbase for name, car in cars.items()}
        )

    def evaluation(
        self, config: Config, data: Mapping[str, Artefact], faults: tuple[FaultSettings, ...] = ()
    ) -> Evaluation:
        """Settings of the evaluation of a configuration, also under ``faults``.

        References are resampled like all channels, but never filtered further. ``data`` are the
        recordings of each data set at the estimator's rate.
        """
        split = self.split(config)
        protocol = self.protocol(config, split.datasets)
        references = self.data_for(
            split,
            protocol.rate_hz,
            {**config, "downsample": {**config["downsample"], "transforms": []}},
        )
        kinds = {
            name: kind_of(self.dataset_config(name, config)["dataset"]) for name in split.datasets
        }
        return Evaluation(
            split,
            data,
            references,
            kinds,
            protocol,
            self.output,
            faults,
            self.cars(config, split.datasets),
        )

    def ensure(self, plan: StagePlan, write: Write) -> Artefact:
        """Make the artefact of a plan by ``write``, which receives a folder, unless it is there.

        Returns
        -------
        Artefact
            Found, made, or made by another process for which this one waited.

        Raises
        ------
        DryRunStop
            In a dry run, where it is not there.
        Stopped
            A signal came while it was made.
        """

        def print_waiting(waiting: Waiting) -> None:
            self.messages.end(plan.stage, plan.label)
            self.print_waiting(waiting)

        if plan.folder in self.artefacts:
            return self.artefacts[plan.folder]
        artefact = None if plan.stage in self.force else find(plan, self.messages.warn)
        if artefact is None and self.dry_run:
            self.messages.line("plan", plan.stage, plan.label)
            raise DryRunStop
        if artefact is None:
            self.messages.begin(plan.stage, plan.label)
            try:
                artefact = ensured(
                    plan, write, plan.stage in self.force, self.stop.requested, print_waiting
                )
            finally:
                self.messages.end(plan.stage, plan.label)
            self.stop.raise_if_requested()
            assert artefact is not None
        detail = (
            "up to date"
            if artefact.skipped
            else f"{artefact.provenance['seconds']:.1f} s, {artefact.folder}"
        )
        self.messages.line(REUSED if artefact.skipped else "done", plan.stage, plan.label, detail)
        self.artefacts[plan.folder] = artefact
        return artefact


@dataclass(eq=False)
class Runner(Stages):
    """Trains, calibrates and evaluates groups by a launcher, and tracks what was made."""

    tracker: Tracker = field(default_factory=lambda: Tracker({}, Path(), print))  # logs nothing
    launcher: Launcher = field(default_factory=LocalLauncher)  # launcher by which trainings run
    until: float | None = None  # reading of ``time.monotonic`` at which trainings have to end
    weights: PublishedWeights | None = None  # published weights that are used instead of training
    # published weights to which finished trainings are added
    publishes_to: PublishedWeights | None = None
    origins: dict[str, str] = field(default_factory=dict)  # key of a training -> its origin
    # command that has to be run first where a training is missing; empty: train here
    train_first: str = ""
    # whether, with ``train_first``, existing models are calibrated and evaluated
    evaluates_trained: bool = False

    def run(self, groups: Sequence[Group]) -> tuple[dict[str, Member], dict[str, Failure]]:
        """Train and evaluate groups, side by side where there are cores; where members of a group
        fail by their data, each is tried alone.

        Raises `Stopped` at a signal; finished artefacts stay. With ``train_first``, trainings that
        are missing raise nothing here; they are in neither mapping.

        Parameters
        ----------
        groups : sequence of Group
            As `Comparison.plan` makes them.

        Returns
        -------
        tuple[dict[str, Member], dict[str, Failure]]
            Key of a training -> its member, and key of a training -> why it failed. Where the time
            is up, members lack what was not made, and trainings that were not begun are in neither.
        """
        jobs = [job for group in groups for job in group.jobs]
        self.origins |= {job.plan.key: self.origin(job) for job in jobs}
        if self.weights is not None and TRAIN not in self.force:
            self._take_published([job.plan for job in jobs], self.weights)
        members: dict[str, Member] = {}
        waiting: list[Group] = []
        for group in groups:
            members_of_group = existing(group, self.messages.warn)
            members |= self._received([member for member in members_of_group if member.finished])
            missing = [member.job for member in members_of_group if not member.finished]
            waiting += [replace(group, jobs=missing)] if missing else []
        self._publish_weights(members.values())
        failures: dict[str, Failure] = {}
        if self.train_first:  # `Comparison.unfinished` has the others
            waiting = self._without_trainings(waiting) if self.evaluates_trained else []
        if waiting:
            self._announce(waiting, len(members))
        while waiting:
            alone: list[Group] = []
            with self.messages.bars() as bars:
                bars.step(ALL, 0, len(waiting))
                report = partial(self._report, waiting, bars)
                for ended, done in enumerate(
                    self.launcher.launch(waiting, TimeLimit(self.stop, self.until), report), start=1
                ):
                    group = waiting[done.position]
                    outcome = done.outcome
                    bars.close(group.name)
                    self.messages.end(TRAIN, group.name)
                    bars.step(ALL, ended, len(waiting))
                    if not isinstance(outcome, Failure):
                        members |= self._received(outcome)
                        self._publish_weights(outcome)
                    elif outcome.exit_code != DataError.exit_code or len(group.jobs) == 1:
                        failures |= {job.plan.key: outcome for job in group.jobs}
                        self.messages.line("fail", "train", group.name, outcome.message)
                    else:
                        alone += [replace(group, jobs=[job]) for job in group.jobs]
            self.stop.raise_if_requested()
            waiting = alone
        return members, failures

    def _without_trainings(self, groups: Sequence[Group]) -> list[Group]:
        """Groups with only those jobs that need no training: the model exists, or is fitted in
        closed form.
        """
        reduced = [
            replace(
                group,
                jobs=[
                    job for job in group.jobs if job.is_learnt_at_once or find(job.plan) is not None
                ],
            )
            for group in groups
        ]
        return [group for group in reduced if group.jobs]

    def _take_published(self, plans: Sequence[StagePlan], weights: PublishedWeights) -> None:
        """Write the missing models of trainings that are published under their key, or under their
        origin.
        """
        published = [
            (plan, key)
            for plan in plans
            if (key := weights.published_key(plan.key, self.origins[plan.key])) is not None
            and find(plan) is None
        ]
        for plan, key in published if not self.dry_run else ():
            ensured(
                plan, partial(weights.write, key), False, self.stop.requested, self.print_waiting
            )
            self.stop.raise_if_requested()
        if published:
            n_other = sum(key != plan.key for plan, key in published)
            other = (
                f" ({n_other} of them were trained on these recordings as another processor makes "
                "them: their last bits differ)"
                if n_other
                else ""
            )
            self.messages.line(
                "note",
                TRAIN,
                f"{len(published)} of {len(plans)}",
                f"taken from {weights.path}{other}; --retrain trains them",
            )

    def origin(self, job: TrainJob) -> str:
        """The key of a training with the origins of its recordings in place of their digests: the
        keys of their ingests, and how they were downsampled.
        """
        ingests = {
            artefact.label: artefact.key
            for artefact in self.artefacts.values()
            if artefact.stage == INGEST
        }
        origins = {
            name: [ingests[name], dict(data.config), data.code]
            for name, data in job.data.items()
            if name in ingests
        }
        inputs = {
            name: origins.get(name.partition("/")[0], digest)
            for name, digest in job.plan.inputs.items()
        }
        return hash_of({**job.plan.keyed_content, "inputs": inputs})

    def _announce(self, waiting: Sequence[Group], n_there: int) -> None:
        """Print which groups will be run; a dry run ends here."""
        if self.dry_run:
            labels = [job.plan.label for group in waiting for job in group.jobs]
            for label in labels:
                self.messages.line("plan", "train", label)
            self.messages.line("plan", "train", f"{len(labels)} in all; {n_there} others exist")
            raise DryRunStop
        for name in dict.fromkeys(str(group.jobs[0].estimator["name"]) for group in waiting):
            if has_to_compile(estimator_class(name).slow_kernel):
                self.messages.line(
                    "once",
                    "compile",
                    name,
                    "tens of seconds before its first training; later ones load it",
                )
        if any(group.split.validation for group in waiting) and has_to_compile(SLOW_KERNEL):
            self.messages.line(
                "once",
                "compile",
                "health",
                "about 20 s before the first calibration; later ones load it",
            )
        for split in dict.fromkeys(
            group.split.name for group in waiting if not group.split.validation
        ):
            self.messages.line("note", "calibrate", split, "has no validation range: no bands")

    def _received(self, outcome: Sequence[Member]) -> dict[str, Member]:
        """Print and track the members of a finished group; returns them by the keys of their
        trainings.
        """
        for member in outcome:
            if member.finished and not self.dry_run:
                member.job.plan.drop(member.job.plan.checkpoint_folder)
            if member.model is None:
                self.messages.line(
                    "stop",
                    "train",
                    member.job.plan.label,
                    "before its first epoch was over; the next run goes on",
                )
            for artefact in member.made:
                self.artefacts[artefact.folder] = artefact
                status, detail = _describe_outcome(artefact)
                self.messages.line(status, artefact.stage, artefact.label, detail)
                if artefact.stage == TRAIN and read_fit_metrics(artefact.folder).get(
                    "ended_by_divergence"
                ):
                    self.messages.warn(f"the training of {artefact.label} {DIVERGED}")
            self.tracker.log(*member.made)
        return {member.job.plan.key: member for member in outcome}

    def _publish_weights(self, members: Iterable[Member]) -> None:
        """Add the models of finished trainings to the published weights, if they are to be
        published, until there is no room.
        """
        models = [
            member.model
            for member in members
            if member.model is not None and member.model.status == "complete"
        ]
        if (
            self.publishes_to is not None
            and not self.dry_run
            and not publish_weights(
                self.publishes_to, models, self.origins, self.output, self.messages
            )
        ):
            self.publishes_to = None

    def _report(
        self, groups: Sequence[Group], bars: Bars, at: int, news: Progress | Waiting | None
    ) -> None:
        """Update the progress bar of the group with index ``at``, or print what it waits for."""
        name = groups[at].name
        if isinstance(news, Waiting):
            self.messages.end(TRAIN, name)
            self.print_waiting(news)
        elif news is None:
            bars.step(name, 0, 1, "starting")
            if not self.messages.console.is_terminal:  # which has the bar
                self.messages.begin(TRAIN, name)
        else:
            note = (
                f"{news.active}/{news.members} active, best validation loss "
                f"{news.best_validation_loss:.4g}"
            )
            bars.step(name, news.epoch, news.max_epochs, note)


def _describe_outcome(artefact: Artefact) -> tuple[str, str]:
    """Status and result of a finished model, calibration or evaluation, for its line on the
    console.
    """
    if artefact.skipped:
        return REUSED, "up to date"
    if artefact.status == "interrupted":
        return "stop", f"the best so far is kept in {artefact.folder}; the next run goes on"
    if artefact.stage == "train":
        fit = read_fit_metrics(artefact.folder)
        loss = fit.get("best_validation_loss")
        epochs = f"{fit['epochs']:.0f} epochs, " if fit.get("epochs") else ""
        if halvings := fit.get("step_size_halvings"):
            epochs += f"step size halved {'once' if halvings == 1 else f'{halvings:g} times'}, "
        return "done", epochs + (
            f"{fit['n_parameters']:.0f} parameters"
            if loss is None
            else f"validation loss {loss:.4g}"
        )
    if artefact.stage == "evaluate":
        errors = {
            name: error
            for name, error in test_figures(artefact.folder).items()
            if name.startswith("rmse_sideslip")
        }
        return "done", ", ".join(f"{name} {error:.3f}°" for name, error in errors.items())
    trust = read_trust(artefact.folder)
    if trust.bands is None:
        return "note", f"no bands: {trust.about.note}"
    return (
        "done",
        f"bands by {trust.bands.n_blocks} "
        f"{'ranges' if trust.bands.blocks == 'range' else 'segments from turn to turn'}",
    )
