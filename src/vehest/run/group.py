"""The work of one process: members of a group are trained together, then each is calibrated and evaluated.

Group -> existing artefacts -> locks -> fit -> model -> calibration -> evaluation -> Member
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from vehest.data.splits import Split
from vehest.estimators.kernels.blas import one_blas_thread
from vehest.run.artefacts import Artefact, StagePlan, Status, ensured, find, make
from vehest.run.calibrate import CalibrateJob, plan_calibrate, write_calibration
from vehest.run.evaluate import Evaluation, write_evaluation
from vehest.run.locks import Waiting, held, held_at_once
from vehest.run.train import STAGE, TrainJob, fit_jobs, write_model
from vehest.training.checkpoints import drop_checkpoint, resume_epoch
from vehest.training.context import FitContext, Progress


@dataclass(frozen=True)
class Group:
    """Members that fit one batch, and what is to be done with them.

    Args:
        jobs: in the order of the pipeline.
        evaluation: none if they are trained only.
        force: stages to run although their artefacts are there.
        label: what its members have in common, for people; the estimator and its variant if empty.
        split: that members are calibrated on where they are trained only; none if they are not.
    """

    jobs: Sequence[TrainJob]
    evaluation: Evaluation | None = None
    force: frozenset[str] = frozenset()
    label: str = ""
    split: Split | None = None

    @property
    def name(self) -> str:
        """For people."""
        seeds = [str(job.seed) for job in self.jobs]
        label = self.label or self.jobs[0].plan.label.rsplit("-seed", 1)[0]
        return f"{label} seed {seeds[0]}" if len(seeds) == 1 else f"{label} seeds {', '.join(seeds)}"

    @property
    def split_of_bands(self) -> Split | None:
        """Whose validation range members are calibrated on."""
        return self.split if self.evaluation is None else self.evaluation.split

    def run(self, should_stop: Callable[[], bool], on_progress: Callable[[Progress | Waiting], None]) -> list[Member]:
        """Train, calibrate and evaluate what is missing; a stopped training leaves its best so far, marked as interrupted.

        An artefact that another process is making is taken from it once it is done; those that no process makes come first.

        On one thread, that of matrix products included: recursions over small states gain nothing from more, and groups run side by side.
        """
        torch.set_num_threads(1)
        with one_blas_thread():
            models = {member.job.plan.key: member.model for member in existing(self)}
            waiting = [job for job in self.jobs if models[job.plan.key] is None]
            while waiting and not should_stop():
                with _held(waiting, should_stop, on_progress) as jobs:
                    for job in jobs:
                        if STAGE in self.force:
                            drop_checkpoint(job.plan.checkpoint_folder)
                        else:
                            models[job.plan.key] = find(job.plan)  # whoever held the lock may have made it
                    for together in _together([job for job in jobs if models[job.plan.key] is None]):
                        if should_stop():
                            break
                        models |= {artefact.key: artefact for artefact in _train(together, should_stop, on_progress)}
                waiting = [job for job in waiting if job not in jobs]
            return [_followed_up(self, job, models[job.plan.key], should_stop, on_progress) for job in self.jobs]


@dataclass(frozen=True)
class Member:
    """What became of one member: its model, its calibration and its evaluation, where they are there."""

    job: TrainJob
    model: Artefact | None = None
    evaluation: Artefact | None = None
    calibration: Artefact | None = None


def existing(group: Group) -> list[Member]:
    """The artefacts of a group that are there already."""
    members = []
    for job in group.jobs:
        model, calibration, evaluation = _found(group, job.plan), None, None
        if model is not None:
            calibrating = calibration_job(group, job, model)
            calibration = None if calibrating is None else _found(group, calibrating.plan)
            if group.evaluation is not None and (calibrating is None or calibration is not None):
                evaluation = _found(group, group.evaluation.of(model, calibration).plan)
        members.append(Member(job, model, evaluation, calibration))
    return members


def _found(group: Group, plan: StagePlan) -> Artefact | None:
    return None if plan.stage in group.force else find(plan)


def is_finished(group: Group, member: Member) -> bool:
    """Whether nothing is left to do for a member."""
    if member.model is None or (group.evaluation is not None and member.evaluation is None):
        return False
    return member.calibration is not None or calibration_job(group, member.job, member.model) is None


def is_calibrated(group: Group) -> bool:
    """Whether there is anything to calibrate the members of a group by."""
    return group.split_of_bands is not None and bool(group.split_of_bands.validation)


def drop_finished_checkpoint(job: TrainJob) -> None:
    """Remove the checkpoint of a model that is there, which a killed process left; not while somebody trains it."""
    if job.plan.checkpoint_folder.exists():
        with held_at_once(job.plan.lock) as free:
            if free:
                drop_checkpoint(job.plan.checkpoint_folder)


@contextmanager
def _held(jobs: Sequence[TrainJob], should_stop: Callable[[], bool], say: Callable[[Waiting], None]) -> Iterator[list[TrainJob]]:
    """Hold the locks of those trainings that nobody is at; where somebody is at all of them, wait for the first.

    Whoever waits holds no other training, so that two processes never wait for each other.
    """
    with ExitStack() as stack:
        free = [job for job in jobs if stack.enter_context(held_at_once(job.plan.lock))]
        if not free and stack.enter_context(held(jobs[0].plan.lock, should_stop, say)):
            free = [jobs[0]]
        yield free


def _together(jobs: Sequence[TrainJob]) -> list[list[TrainJob]]:
    """Jobs that can go on together: those whose checkpoints, if any, stand at the same epoch."""
    batches: dict[int, list[TrainJob]] = {}
    for job in jobs:
        batches.setdefault(resume_epoch(job.plan.checkpoint_folder), []).append(job)
    return list(batches.values())


def _train(jobs: Sequence[TrainJob], should_stop: Callable[[], bool], on_progress: Callable[[Progress | Waiting], None]) -> list[Artefact]:
    folders = [job.plan.checkpoint_folder for job in jobs]
    context = FitContext(checkpoint_folders=folders, should_stop=should_stop, on_progress=on_progress)
    artefacts = []
    for job, (estimator, record) in zip(jobs, fit_jobs(jobs, context), strict=True):
        if record.interrupted and not record.metrics.get("best_epoch", 1):
            continue  # nothing learnt yet; the checkpoint knows where to go on

        def write(folder: Path, job: TrainJob = job, estimator=estimator, record=record) -> Status:  # type: ignore[no-untyped-def]
            write_model(job, estimator, record, folder)
            return "interrupted" if record.interrupted else "complete"

        artefacts.append(make(job.plan, write))
        if not record.interrupted:
            drop_checkpoint(job.plan.checkpoint_folder)
    return artefacts


def calibration_job(group: Group, job: TrainJob, model: Artefact) -> CalibrateJob | None:
    """How a model is calibrated; none where it is not, or its split has no validation range."""
    split = group.split_of_bands
    return None if split is None else plan_calibrate(model, split, job.data, job.plan.output)


def _followed_up(
    group: Group, job: TrainJob, model: Artefact | None, should_stop: Callable[[], bool], say: Callable[[Waiting], None]
) -> Member:
    """The member of a model, calibrated and evaluated unless the training or the waiting for another process was stopped."""

    def made(plan: StagePlan, write: Callable[[Path], None]) -> Artefact | None:
        return _found(group, plan) or ensured(plan, write, plan.stage in group.force, should_stop, say)

    calibration = evaluation = None
    if model is not None and model.status == "complete" and not should_stop():
        calibrating = calibration_job(group, job, model)
        if calibrating is not None:
            calibration = made(calibrating.plan, partial(write_calibration, calibrating))
        if group.evaluation is not None and (calibrating is None or calibration is not None) and not should_stop():
            scoring = group.evaluation.of(model, calibration)
            evaluation = made(scoring.plan, partial(write_evaluation, scoring))
    return Member(job, model, evaluation, calibration)
