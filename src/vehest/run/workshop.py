"""Where stages are run: what is there is skipped, what is missing is made, and every step is said."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vehest.data.contents import Contents, stored_contents
from vehest.data.split_files import Catalogue, Reader, dataset_names, split_from_config
from vehest.data.splits import TRAINING, VALIDATION, Split
from vehest.data.store import read_recording
from vehest.estimators.model_files import read_description
from vehest.run.artefacts import Artefact, StagePlan, Status, ensured, find
from vehest.run.calibrate import calibration_figures, calibration_of, plan_calibrate, write_calibration
from vehest.run.compiling import has_to_compile
from vehest.run.config import Config, compose_config, missing_keys
from vehest.run.console import Messages
from vehest.run.downsample import plan_downsample, write_downsample
from vehest.run.evaluate import read_metrics, read_scored
from vehest.run.failures import Failure
from vehest.run.finished import Outcome, RawFolder
from vehest.run.group import Evaluation, Group, Member, drop_finished_checkpoint, existing, is_calibrated, is_finished
from vehest.run.ingest import drop_parts, plan_ingest, write_ingest
from vehest.run.launchers.base import Launcher, LocalLauncher
from vehest.run.launchers.standing import Standing
from vehest.run.locks import Waiting
from vehest.run.publishing import Publication
from vehest.run.rates import Note
from vehest.run.shown import Shown
from vehest.run.signals import StopSignals, TimeLimit
from vehest.run.tracking import Tracker
from vehest.run.train import HISTORY, learnt_spans, read_fit_metrics
from vehest.sources.base import kind_of, open_source
from vehest.studies.artefacts import read_frame
from vehest.training.context import Progress
from vehest.trust.record import read_trust


class NotThereYet(Exception):
    """A dry run met a stage that waits for one that has not run."""


@dataclass
class Workshop:
    """Runs stages into one output root.

    Args:
        output: the output root.
        messages: where to say what happens.
        stop: signals.
        jobs: processes.
        force: stages to run although their artefacts are there.
        dry_run: say what would run, run nothing.
        tracker: where runs are logged; none for no tracking.
        tags: what runs are tagged with.
        launcher: runs groups; none for this machine's cores.
        until: reading of ``time.monotonic`` from which on no training is begun, and those that run are stopped; none for no limit.
        artefacts: what was found or made so far, by folder.
    """

    output: Path
    messages: Messages
    stop: StopSignals
    jobs: int = 1
    force: frozenset[str] = frozenset()
    dry_run: bool = False
    tracker: Tracker | None = None
    tags: Mapping[str, str] = field(default_factory=dict)
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
            NotThereYet: in a dry run, if they would have to be made.
        """
        plan = plan_ingest(config)
        with self.messages.bars() as bars:

            def report(done: int, total: int, name: str) -> None:
                bars.step(f"ingest {plan.label}", done, total, name)

            made = self._ensure(plan, lambda folder: write_ingest(config, plan, folder, self.jobs, self.stop, report))
        drop_parts(plan)
        return made

    def downsample(self, ingested: Artefact, rate_hz: float, options: Mapping[str, Any]) -> Artefact:
        """The recordings of a data set at another rate."""
        plan = plan_downsample(ingested, rate_hz, options, self.output)
        return self._ensure(plan, lambda folder: write_downsample(ingested, plan.config, folder))

    def split(self, config: Config) -> Split:
        """The split of a configuration; where it names or cuts recordings by rules, its data sets are ingested for it.

        Raises:
            NotThereYet: in a dry run, if they would have to be made.
        """
        key = json.dumps(config["split"], sort_keys=True)
        if key not in self._splits:
            self._splits[key] = split = split_from_config(config["split"], self._catalogue(config))
            for role, kept in split.kept.items():
                self.messages.line("done", "split", f"{split.name}, {role}", f"keeps {kept.describe()}")
        return self._splits[key]

    def contents(self, config: Config) -> dict[str, tuple[Contents, ...]]:
        """What the recordings have of every data set that a configuration's split draws on, which are ingested for it; no samples are read.

        Raises:
            NotThereYet: in a dry run, if they would have to be made.
        """
        names = dataset_names(config["split"])
        for name in names:
            if name not in self._contents:
                ingested = self.ingest(self.dataset_config(name, config))
                self._contents[name] = tuple(stored_contents(ingested.folder / file) for file in ingested.outputs)
        return {name: self._contents[name] for name in names}

    def note(self, note: Note) -> None:
        """Say of a rate that it was lowered, once."""
        if note not in self._noted:
            self._noted.add(note)
            self.messages.line("note", "rate", note.what, f"{note.told}; {note.advice}")

    def look_for_files(self, config: Config) -> None:
        """Make sure that the raw files of every data set that a split draws on are here; read nothing.

        Raises:
            MissingError: some are not.
        """
        for name in dataset_names(config["split"]):
            dataset = self.dataset_config(name, config)["dataset"]
            if not missing_keys(dict(dataset)):  # which its ingest tells of
                open_source(dataset).inputs()

    def _catalogue(self, config: Config) -> Catalogue:
        def recordings_of(name: str) -> Mapping[str, Reader]:
            ingested = self.ingest(self.dataset_config(name, config))
            return {file.removesuffix(".parquet"): partial(read_recording, ingested.folder / file) for file in ingested.outputs}

        return recordings_of

    def data_for(self, split: Split, rate_hz: float, config: Config) -> dict[str, Artefact]:
        """Every data set of a split at a rate."""
        return {name: self._data_at(name, rate_hz, config) for name in split.datasets}

    def _data_at(self, name: str, rate_hz: float, config: Config) -> Artefact:
        wanted = (name, rate_hz, json.dumps(config["downsample"], sort_keys=True))
        if wanted not in self._data:
            self._data[wanted] = self.downsample(self.ingest(self.dataset_config(name, config)), rate_hz, config["downsample"])
        return self._data[wanted]

    def dataset_config(self, name: str, config: Config) -> Config:
        """The configuration of a data set's ingest, with the root and output of another command's."""
        if name not in self._datasets:
            overrides = [f"dataset={name}", f"output={_quoted(config['output'])}"]
            if config.get("root") is not None:
                overrides.append(f"root={_quoted(config['root'])}")
            self._datasets[name] = compose_config("ingest", overrides)
        return self._datasets[name]

    def datasets_of(self, config: Config) -> dict[str, Config]:
        """The configuration of every data set that the split of another command's configuration draws on, by its name."""
        return {name: self.dataset_config(name, config)["dataset"] for name in dataset_names(config["split"])}

    def outcome(
        self,
        report: Artefact,
        shown: Shown,
        publication: Publication | None,
        tracking: Mapping[str, Any],
        raw: Mapping[str, RawFolder] | None,
    ) -> Outcome:
        """What was done here, to be remembered."""
        made = list(self.artefacts.values())
        return Outcome(self.output, report, made, list(self.messages.said), shown, publication, tracking, raw)

    def rehearsed(self, whole_way: Callable[[Workshop], Outcome]) -> Callable[[], Outcome | None]:
        """What the next run into the same output root will say and find, without making or saying anything."""

        def again() -> Outcome | None:
            try:
                return whole_way(Workshop(self.output, Messages(silent=True), self.stop, dry_run=True))
            except NotThereYet:
                return None

        return again

    def kinds_of(self, split: Split, config: Config) -> dict[str, str]:
        """Data set -> ``real`` or ``simulated``."""
        return {name: kind_of(self.dataset_config(name, config)["dataset"]) for name in split.datasets}

    def calibration(self, model: Artefact, split: Split, data: Mapping[str, Artefact]) -> Artefact | None:
        """The calibration of a model that is to be evaluated on a split: made on that split if it learnt there, else looked for.

        Args:
            model: what the train stage made.
            split: that it is evaluated on.
            data: data set -> recordings at the model's rate.

        Raises:
            NotThereYet: in a dry run, if it would have to be made.
        """
        learnt, found = learnt_spans(model), None
        if model.status == "complete" and (not learnt or set(learnt) == {*split.train, *split.validation}):
            job = plan_calibrate(model, split, data, self.output)
            if job is not None:
                found = self._ensure(job.plan, partial(write_calibration, job))
                self.log_calibration(found)
        elif learnt:  # one of a model that learns nothing may have seen these tests
            found = calibration_of(model.folder, self.output)
        if found is None:
            self.messages.line("note", "calibrate", model.label, "has no calibration, so its estimates have no bands")
        return found

    def run_groups(self, groups: Sequence[Group]) -> tuple[list[Member], list[tuple[str, Failure]]]:
        """Train and evaluate groups, side by side where there are cores; returns members and failures.

        Where the time is up, members lack what was not made; those that were not begun are not among them.

        Raises:
            Stopped: a signal came; what was finished stays.
            NotThereYet: in a dry run, if anything would have to be made.
        """
        members: list[Member] = []
        waiting: list[Group] = []
        for group in groups:
            found = existing(group)
            for member in found:
                if is_finished(group, member):
                    members.append(member)
                    self._say_skipped(member)
                    if not self.dry_run:
                        drop_finished_checkpoint(member.job)
                        self._track(member, group.evaluation)
            missing = [member.job for member in found if not is_finished(group, member)]
            if missing:
                waiting.append(replace(group, jobs=missing))
        if self.dry_run and waiting:
            for group in waiting:
                for job in group.jobs:
                    then = [stage for stage, wanted in (("calibrate", is_calibrated(group)), ("evaluate", group.evaluation)) if wanted]
                    self.messages.line("plan", "train", job.plan.label, f"then {' and '.join(then)}" if then else "")
            raise NotThereYet
        for name in dict.fromkeys(str(group.jobs[0].estimator["name"]) for group in waiting):
            if has_to_compile(name):
                self.messages.line("once", "compile", name, "tens of seconds before its first training; later ones load it")
        for split in dict.fromkeys(group.split_of_bands.name for group in waiting if group.split_of_bands and not is_calibrated(group)):
            self.messages.line("note", "calibrate", split, "has no validation range: no bands")
        failures: list[tuple[str, Failure]] = []
        launcher = self.launcher or LocalLauncher(self.jobs)
        standing = Standing(len(waiting))
        with self.messages.bars() as bars:

            def report(at: int, progress: Progress | Waiting | None) -> None:
                if isinstance(progress, Waiting):
                    self._say_waiting(progress)
                else:
                    standing.runs(at)
                    bars.fit(waiting[at].name, progress)
                    bars.count(standing.row(launcher.cores))

            for done in launcher.launch(waiting, TimeLimit(self.stop, self.until), report):
                group, outcome = waiting[done.position], done.outcome
                standing.ended(done.position, done.seconds, failed=isinstance(outcome, Failure))
                bars.close(group.name)
                bars.count(standing.row(launcher.cores))
                if isinstance(outcome, Failure):
                    failures.append((group.name, outcome))
                    self.messages.line("fail", "train", group.name, outcome.message)
                    continue
                planned = {job.plan.key: job for job in group.jobs}
                for made_elsewhere in outcome:
                    member = replace(made_elsewhere, job=planned[made_elsewhere.job.plan.key])  # not one more copy of its job
                    members.append(member)
                    self._say_made(member)
                    if member.evaluation is not None:
                        bars.stands(member.job.plan.label, _shown_errors(member.evaluation))
                    self._track(member, group.evaluation)
        self.stop.raise_if_requested()
        for made in (artefact for member in members for artefact in (member.model, member.calibration, member.evaluation)):
            if made is not None:
                self.artefacts[made.folder] = made
        return members, failures

    def ensure(self, plan: StagePlan, write: Callable[[Path], Status | None]) -> Artefact:
        """Make an artefact unless it is there."""
        return self._ensure(plan, write)

    def _ensure(self, plan: StagePlan, write: Callable[[Path], Status | None]) -> Artefact:
        if plan.key in self._made:
            return self._made[plan.key]
        found = None if plan.stage in self.force else find(plan)
        if found is not None:
            self.messages.line("skip", plan.stage, plan.label, "up to date")
        elif self.dry_run:
            self.messages.line("plan", plan.stage, plan.label)
            raise NotThereYet
        else:
            found = ensured(plan, write, plan.stage in self.force, self.stop.requested, self._say_waiting)
            self.stop.raise_if_requested()
            assert found is not None
            if found.skipped:
                self.messages.line("skip", plan.stage, plan.label, "up to date")
            else:
                self.messages.line("done", plan.stage, plan.label, f"{found.provenance['seconds']:.1f} s, {found.folder}")
        self._made[plan.key] = found
        self.artefacts[found.folder] = found
        return found

    def _say_waiting(self, waiting: Waiting) -> None:
        self.messages.line("wait", waiting.stage, waiting.label, f"for {waiting.holder}, which makes it")

    def _say_skipped(self, member: Member) -> None:
        self.messages.line("skip", "train", member.job.plan.label, "up to date")
        if member.calibration is not None:
            self.messages.line("skip", "calibrate", member.calibration.label, "up to date")
        if member.evaluation is not None:
            self.messages.line("skip", "evaluate", member.evaluation.label, "up to date")

    def _say_made(self, member: Member) -> None:
        if member.model is None:
            self.messages.line("stop", "train", member.job.plan.label, "before its first epoch was over; the next run goes on")
            return
        if member.model.skipped:
            self.messages.line("skip", "train", member.model.label, "up to date")
        elif member.model.status == "interrupted":
            detail = f"the best so far is kept in {member.model.folder}; the next run goes on"
            self.messages.line("stop", "train", member.model.label, detail)
        else:
            fit = read_fit_metrics(member.model.folder)
            epochs = f"{fit['epochs']:.0f} epochs, " if fit.get("epochs") else ""
            loss = fit.get("best_validation_loss")
            outcome = f"{fit['n_parameters']:.0f} parameters" if loss is None else f"validation loss {loss:.4g}"
            self.messages.line("done", "train", member.model.label, f"{epochs}{outcome}")
        if member.calibration is not None:
            self.say_calibrated(member.calibration)
        if member.evaluation is None:
            return
        if member.evaluation.skipped:
            self.messages.line("skip", "evaluate", member.evaluation.label, "up to date")
        else:
            shown = ", ".join(f"{name} {value:.3f}°" for name, value in _shown_errors(member.evaluation).items())
            self.messages.line("done", "evaluate", member.evaluation.label, shown)

    def say_calibrated(self, calibration: Artefact) -> None:
        """Say of a calibration on what it stands, or why there are no bands."""
        if calibration.skipped:
            self.messages.line("skip", "calibrate", calibration.label, "up to date")
            return
        trust = read_trust(calibration.folder)
        if trust.bands is None:
            self.messages.line("note", "calibrate", calibration.label, f"no bands: {trust.about.note}")
        else:
            what = "ranges" if trust.bands.blocks == "range" else "stretches from turn to turn"
            self.messages.line("done", "calibrate", calibration.label, f"bands by {trust.bands.n_blocks} {what}")

    def _track(self, member: Member, how: Evaluation | None) -> None:
        if member.model is not None:
            self.log_fit(member.model)
            if member.calibration is not None:
                self.log_calibration(member.calibration)
            if member.evaluation is not None and how is not None:
                self.log_evaluation(member.evaluation, member.model, how)

    def log_fit(self, model: Artefact) -> None:
        """Track a training, unless it is tracked: figures, figures over epochs, learning curve."""
        if self.tracker is not None and not self.tracker.is_tracked(model):
            drawn = {"learning.png": partial(_learning_figure, model)}
            self.tracker.log(model, self.tags, read_fit_metrics(model.folder), model.folder / HISTORY, drawn)

    def log_calibration(self, calibration: Artefact) -> None:
        """Track a calibration, unless it is tracked: what it stands on, and the file itself."""
        if self.tracker is not None and not self.tracker.is_tracked(calibration):
            self.tracker.log(calibration, self.tags, calibration_figures(calibration.folder))

    def log_evaluation(self, evaluation: Artefact, model: Artefact, how: Evaluation) -> None:
        """Track an evaluation, unless it is tracked: figures, and traces over each test set."""
        if self.tracker is not None and not self.tracker.is_tracked(evaluation):
            drawn = {f"traces_{name}.png": partial(_trace_figure, evaluation, model, how, name) for name in how.split.tests}
            self.tracker.log(evaluation, self.tags, test_figures(evaluation), None, drawn)


def _shown_errors(evaluation: Artefact) -> dict[str, float]:
    return {name: value for name, value in test_figures(evaluation).items() if name.startswith("rmse_sideslip")}


def test_figures(evaluation: Artefact) -> dict[str, float]:
    """Figures of an evaluation over all samples, ``<metric>.<test set>`` -> value."""
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


def _quoted(text: Any) -> str:
    """A value as Hydra's grammar reads it back: only quotes, and backslashes before them, are escaped."""
    escaped = re.sub(r"(\\*)('|$)", lambda found: found[1] * 2 + ("\\'" if found[2] else ""), str(text))
    return f"'{escaped}'"
