"""Runs stages into one output root: what is there is skipped, what is missing is made, every step is printed.

Jobs -> split, recordings at their rates (`Runner.split`, `data_for`) -> groups -> launcher -> members -> tracking
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from vehest.data.contents import Contents, stored_contents
from vehest.data.errors import DataError
from vehest.data.split_files import Catalogue, Reader, dataset_names, split_from_config
from vehest.data.splits import Split
from vehest.data.store import read_recording
from vehest.run.artefacts import Artefact, StagePlan, Status, ensured, find
from vehest.run.calibrate import calibration_of, plan_calibrate, write_calibration
from vehest.run.compiling import has_to_compile
from vehest.run.config import Config, compose_config, missing_keys
from vehest.run.console import Bars, Messages
from vehest.run.downsample import plan_downsample, write_downsample
from vehest.run.failures import Failure
from vehest.run.group import Group, Member, drop_finished_checkpoint, existing, is_calibrated, is_finished
from vehest.run.ingest import drop_parts, plan_ingest, write_ingest
from vehest.run.launchers.base import Launcher
from vehest.run.launchers.local import LocalLauncher
from vehest.run.launchers.progress import LaunchProgress
from vehest.run.locks import Waiting
from vehest.run.rates import Note
from vehest.run.signals import DryRunStop, StopSignals, TimeLimit
from vehest.run.tracking import Tracker, log_member, rmse_of_tests
from vehest.run.train import learnt_spans, read_fit_metrics
from vehest.sources.base import kind_of, open_source
from vehest.training.context import Progress
from vehest.trust.record import read_trust


@dataclass
class Runner:
    """Runs stages into one output root.

    Args:
        output: the output root.
        messages: prints what happens.
        stop: signals.
        jobs: processes.
        force: stages to run although their artefacts are there.
        dry_run: print what would run, run nothing.
        tracker: logs runs; none for no tracking.
        launcher: runs groups; none for this machine's cores.
        until: reading of ``time.monotonic`` from which on no training is begun and running ones are stopped; none for no limit.
        artefacts: those found or made so far, by folder.
    """

    output: Path
    messages: Messages
    stop: StopSignals
    jobs: int = 1
    force: frozenset[str] = frozenset()
    dry_run: bool = False
    tracker: Tracker | None = None
    until: float | None = None
    launcher: Launcher | None = None
    artefacts: dict[Path, Artefact] = field(default_factory=dict)
    _made: dict[str, Artefact] = field(default_factory=dict)
    _datasets: dict[str, Config] = field(default_factory=dict)
    _data: dict[tuple[str, float, str], Artefact] = field(default_factory=dict)
    _splits: dict[str, Split] = field(default_factory=dict)
    _contents: dict[str, tuple[Contents, ...]] = field(default_factory=dict)
    _noted: set[Note] = field(default_factory=set)

    def ingest(self, config: Config) -> Artefact:
        """The recordings of a data set at their native rate.

        Raises:
            DryRunStop: in a dry run, if they would have to be made.
        """
        plan = plan_ingest(config)
        with self.messages.bars() as bars:

            def report(done: int, total: int, name: str) -> None:
                bars.step(f"ingest {plan.label}", done, total, name)

            made = self.ensure(plan, lambda folder: write_ingest(config, plan, folder, self.jobs, self.stop, report))
        drop_parts(plan)
        return made

    def downsample(self, ingested: Artefact, rate_hz: float, options: Mapping[str, Any]) -> Artefact:
        """The recordings of a data set at another rate."""
        plan = plan_downsample(ingested, rate_hz, options, self.output)
        return self.ensure(plan, lambda folder: write_downsample(ingested, plan.config, folder))

    def split(self, config: Config) -> Split:
        """The split of a configuration; where it names or cuts recordings by rules, its data sets are ingested for it.

        Raises:
            DryRunStop: in a dry run, if they would have to be made.
        """
        key = json.dumps(config["split"], sort_keys=True)
        if key not in self._splits:
            self._splits[key] = split = split_from_config(config["split"], self._catalogue(config))
            for role, kept in split.kept.items():
                self.messages.line("done", "split", f"{split.name}, {role}", f"keeps {kept.describe()}")
        return self._splits[key]

    def contents(self, config: Config) -> dict[str, tuple[Contents, ...]]:
        """Channels and rates of the recordings of every data set of a split, which are ingested for it; no samples are read.

        Raises:
            DryRunStop: in a dry run, if they would have to be made.
        """
        names = dataset_names(config["split"])
        for name in names:
            if name not in self._contents:
                ingested = self.ingest(self.dataset_config(name, config))
                self._contents[name] = tuple(stored_contents(ingested.folder / file) for file in ingested.outputs)
        return {name: self._contents[name] for name in names}

    def look_for_files(self, config: Config) -> None:
        """Make sure that the raw files of every data set of a split are here; read nothing.

        Raises:
            MissingError: some are not.
        """
        for dataset in self.datasets_of(config).values():
            if not missing_keys(dict(dataset)):  # which its ingest reports
                open_source(dataset).inputs()

    def _catalogue(self, config: Config) -> Catalogue:
        def recordings_of(name: str) -> Mapping[str, Reader]:
            ingested = self.ingest(self.dataset_config(name, config))
            return {file.removesuffix(".parquet"): partial(read_recording, ingested.folder / file) for file in ingested.outputs}

        return recordings_of

    def data_for(self, split: Split, rate_hz: float, config: Config) -> dict[str, Artefact]:
        """Every data set of a split at a rate."""
        return {name: self._data_at(name, rate_hz, config) for name in split.datasets}

    def references_for(self, split: Split, rate_hz: float, config: Config) -> dict[str, Artefact]:
        """Every data set of a split at the evaluation's rate: resampled like everything, but never filtered further."""
        return self.data_for(split, rate_hz, {**config, "downsample": {**config["downsample"], "transforms": []}})

    def _data_at(self, name: str, rate_hz: float, config: Config) -> Artefact:
        wanted = (name, rate_hz, json.dumps(config["downsample"], sort_keys=True))
        if wanted not in self._data:
            self._data[wanted] = self.downsample(self.ingest(self.dataset_config(name, config)), rate_hz, config["downsample"])
        return self._data[wanted]

    def dataset_config(self, name: str, config: Config) -> Config:
        """The configuration of a data set's ingest, with the root and output of another command's."""
        if name not in self._datasets:
            root = [] if config.get("root") is None else [f"root={_quoted(config['root'])}"]
            self._datasets[name] = {**compose_config("ingest", [f"dataset={name}", *root]), "output": config["output"]}
        return self._datasets[name]

    def datasets_of(self, config: Config) -> dict[str, Config]:
        """The configuration of every data set of a split, by its name."""
        return {name: self.dataset_config(name, config)["dataset"] for name in dataset_names(config["split"])}

    def kinds_of(self, split: Split, config: Config) -> dict[str, str]:
        """Data set -> ``real`` or ``simulated``."""
        return {name: kind_of(self.dataset_config(name, config)["dataset"]) for name in split.datasets}

    def calibration(self, model: Artefact, split: Split, data: Mapping[str, Artefact]) -> Artefact | None:
        """The calibration of a model that is to be evaluated on a split: made on that split if it was trained there, else looked for.

        Args:
            model: of the train stage.
            split: that it is evaluated on.
            data: data set -> recordings at the model's rate.

        Raises:
            DryRunStop: in a dry run, if it would have to be made.
        """
        learnt, found = learnt_spans(model), None
        if model.status == "complete" and (not learnt or set(learnt) == {*split.train, *split.validation}):
            job = plan_calibrate(model, split, data, self.output)
            if job is not None:
                found = self.ensure(job.plan, partial(write_calibration, job))
        elif learnt:  # one of a model that learns nothing may have seen these tests
            found = calibration_of(model.folder, self.output)
        if found is None:
            self.messages.line("note", "calibrate", model.label, "has no calibration, so its estimates have no bands")
        return found

    def run(self, groups: Sequence[Group]) -> tuple[dict[str, Member], dict[str, Failure]]:
        """Train and evaluate groups, side by side where there are cores; where members of a group fail by their data, each is tried alone.

        Returns:
            Key of a training -> its member, and key of a training -> why it failed. Where the time is up, members lack what was not
            made, and trainings that were not begun are in neither.

        Raises:
            Stopped: a signal came; finished artefacts stay.
            DryRunStop: in a dry run, if anything would have to be made.
        """
        members: dict[str, Member] = {}
        failures: dict[str, Failure] = {}
        waiting = self._missing(groups, members)
        launcher = self.launcher or LocalLauncher(self.jobs)
        while waiting:
            progress, alone = LaunchProgress(len(waiting)), []
            with self.messages.bars() as bars:
                report = partial(self._report, waiting, progress, bars, launcher.cores)
                for done in launcher.launch(waiting, TimeLimit(self.stop, self.until), report):
                    group, outcome = waiting[done.position], done.outcome
                    progress.ended(done.position, done.seconds, failed=isinstance(outcome, Failure))
                    bars.close(group.name)
                    bars.count(progress.row(launcher.cores))
                    if not isinstance(outcome, Failure):
                        members |= self._received(group, outcome)
                        for member in outcome:
                            if member.evaluation is not None:
                                bars.stands(member.job.plan.label, rmse_of_tests(member.evaluation))
                    elif outcome.exit_code != DataError.exit_code or len(group.jobs) == 1:
                        failures |= {job.plan.key: outcome for job in group.jobs}
                        self.messages.line("fail", "train", group.name, outcome.message)
                    else:
                        alone += [replace(group, jobs=[job]) for job in group.jobs]
            self.stop.raise_if_requested()
            waiting = alone
        return members, failures

    def _missing(self, groups: Sequence[Group], members: dict[str, Member]) -> list[Group]:
        """What is left of groups; members that are there join ``members``.

        Raises:
            DryRunStop: in a dry run, if anything is left.
        """
        waiting: list[Group] = []
        for group in groups:
            found = existing(group)
            missing = [member.job for member in found if not is_finished(group, member)]
            for member in found:
                if is_finished(group, member):
                    members |= self._received(group, [member])
                    if not self.dry_run:
                        drop_finished_checkpoint(member.job)
            if missing:
                waiting.append(replace(group, jobs=missing))
        if self.dry_run and waiting:
            for group in waiting:
                then = [stage for stage, wanted in (("calibrate", is_calibrated(group)), ("evaluate", group.evaluation)) if wanted]
                self.print_trainings([job.plan.label for job in group.jobs], then)
            to_do = sum(len(group.jobs) for group in waiting)
            self.messages.line("plan", "train", f"{to_do} in all", f"{len(members)} more are there")
            raise DryRunStop
        for name in dict.fromkeys(str(group.jobs[0].estimator["name"]) for group in waiting):
            if has_to_compile(name):
                self.messages.line("once", "compile", name, "tens of seconds before its first training; later ones load it")
        for split in dict.fromkeys(group.split_of_bands.name for group in waiting if group.split_of_bands and not is_calibrated(group)):
            self.messages.line("note", "calibrate", split, "has no validation range: no bands")
        return waiting

    def _report(
        self, groups: Sequence[Group], of_all: LaunchProgress, bars: Bars, cores: int, at: int, progress: Progress | Waiting | None
    ) -> None:
        """Draw the progress of a group, or print for whom it waits."""
        if isinstance(progress, Waiting):
            self._print_waiting(progress)
        else:
            of_all.runs(at)
            bars.fit(groups[at].name, progress)
            bars.count(of_all.row(cores))

    def print_trainings(self, labels: Sequence[str], then: Sequence[str]) -> None:
        """What a dry run would train."""
        for label in labels:
            self.messages.line("plan", "train", label, f"then {' and '.join(then)}" if then else "")

    def _received(self, group: Group, outcome: Sequence[Member]) -> dict[str, Member]:
        """Members as they are kept: printed, tracked, with this process's own copy of their jobs."""
        planned = {job.plan.key: job for job in group.jobs}
        received = {}
        for elsewhere in outcome:
            key = elsewhere.job.plan.key
            received[key] = member = replace(elsewhere, job=planned[key])
            self._print_member(member)
            for made in (member.model, member.calibration, member.evaluation):
                if made is not None:
                    self.artefacts[made.folder] = made
            if self.tracker is not None:
                log_member(self.tracker, member, group.evaluation)
        return received

    def ensure(self, plan: StagePlan, write: Callable[[Path], Status | None]) -> Artefact:
        """Make an artefact unless it is there.

        Raises:
            DryRunStop: in a dry run, if it would have to be made.
        """
        if plan.key in self._made:
            return self._made[plan.key]
        found = None if plan.stage in self.force else find(plan)
        if found is None and self.dry_run:
            self.messages.line("plan", plan.stage, plan.label)
            raise DryRunStop
        if found is None:
            found = ensured(plan, write, plan.stage in self.force, self.stop.requested, self._print_waiting)
            self.stop.raise_if_requested()
            assert found is not None
        detail = "up to date" if found.skipped else f"{found.provenance['seconds']:.1f} s, {found.folder}"
        self.messages.line("skip" if found.skipped else "done", plan.stage, plan.label, detail)
        self._made[plan.key] = found
        self.artefacts[found.folder] = found
        return found

    def print_note(self, note: Note) -> None:
        """Print of a rate that it was lowered, once."""
        if note not in self._noted:
            self._noted.add(note)
            self.messages.line("note", "rate", note.what, f"{note.text}; {note.advice}")

    def _print_waiting(self, waiting: Waiting) -> None:
        self.messages.line("wait", waiting.stage, waiting.label, f"for {waiting.holder}, which makes it")

    def _print_member(self, member: Member) -> None:
        model = member.model
        if model is None:
            self.messages.line("stop", "train", member.job.plan.label, "before its first epoch was over; the next run goes on")
            return
        for made in (model, member.calibration, member.evaluation):
            if made is not None and made.skipped:
                self.messages.line("skip", made.stage, made.label, "up to date")
            elif made is model and model.status == "interrupted":
                self.messages.line("stop", "train", model.label, f"the best so far is kept in {model.folder}; the next run goes on")
            elif made is model:
                self.messages.line("done", "train", model.label, _fit_in_words(model))
            elif made is not None and made is member.calibration:
                self._print_calibration(made)
            elif made is not None:
                shown = ", ".join(f"{name} {value:.3f}°" for name, value in rmse_of_tests(made).items())
                self.messages.line("done", "evaluate", made.label, shown)

    def _print_calibration(self, calibration: Artefact) -> None:
        trust = read_trust(calibration.folder)
        if trust.bands is None:
            self.messages.line("note", "calibrate", calibration.label, f"no bands: {trust.about.note}")
        else:
            what = "ranges" if trust.bands.blocks == "range" else "stretches from turn to turn"
            self.messages.line("done", "calibrate", calibration.label, f"bands by {trust.bands.n_blocks} {what}")


def _fit_in_words(model: Artefact) -> str:
    fit = read_fit_metrics(model.folder)
    epochs = f"{fit['epochs']:.0f} epochs, " if fit.get("epochs") else ""
    loss = fit.get("best_validation_loss")
    return epochs + (f"{fit['n_parameters']:.0f} parameters" if loss is None else f"validation loss {loss:.4g}")


def _quoted(text: Any) -> str:
    """A value as Hydra's grammar reads it back: only quotes, and backslashes before them, are escaped."""
    escaped = re.sub(r"(\\*)('|$)", lambda found: found[1] * 2 + ("\\'" if found[2] else ""), str(text))
    return f"'{escaped}'"
