"""Trains the members of a group together, then calibrates and evaluates each, in one process.

Group -> existing artefacts -> locks -> fit -> model -> calibration -> evaluation -> Member
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import torch

from vehest.artefacts.artefact import Artefact, StagePlan, Status, Write, ensured, find, make
from vehest.artefacts.locks import Lock, Waiting, held
from vehest.data.car import CarValues
from vehest.data.splits import Split
from vehest.estimators.base import Estimator, FitRecord
from vehest.estimators.kernels.blas import single_blas_thread
from vehest.estimators.kernels.compiling import has_to_compile
from vehest.run.calibrate import plan_calibrate
from vehest.run.evaluate import Evaluation
from vehest.run.train import STAGE, TrainJob, fit_jobs, write_model
from vehest.training.checkpoints import drop_checkpoint, resume_epoch
from vehest.training.context import FitContext, Progress
from vehest.trust.health import SLOW_KERNEL

# entry that an evaluation compiles for noise floors
FLOOR_KERNEL = "vehest.filters.kalman_scan:_scan"
# takes the progress of a training, or what a group waits for
Report = Callable[[Progress | Waiting], None]


@dataclass(frozen=True)
class Member:
    """A training with its model, calibration and evaluation, as far as they exist."""

    job: TrainJob  # the training
    model: Artefact | None = None  # trained model; None: not trained yet
    evaluation: Artefact | None = None  # evaluation of the model; None: not evaluated yet
    # calibration of the model; None: not calibrated, or without a validation range
    calibration: Artefact | None = None
    # whether training, calibration and evaluation are done, as far as they are planned
    finished: bool = False

    @property
    def made(self) -> list[Artefact]:
        """The artefacts of the member that exist, in the order in which they are made."""
        return [
            artefact
            for artefact in (self.model, self.calibration, self.evaluation)
            if artefact is not None
        ]


@dataclass(frozen=True)
class Group:
    """Trainings that fit one batch, with the calibration and evaluation of their models."""

    jobs: Sequence[TrainJob]  # the trainings
    split: Split  # split on whose validation range the models are calibrated
    evaluation: Evaluation | None = None  # evaluation of the models; None: they are only trained
    force: frozenset[str] = frozenset()  # stages that are run although their artefacts exist
    label: str = ""  # name in messages; if empty, the estimator and its variant
    cars: Mapping[str, CarValues] = field(default_factory=dict)  # data set -> values of its car

    @property
    def name(self) -> str:
        """Name of the group in messages."""
        seeds = [str(job.seed) for job in self.jobs]
        label = self.label or self.jobs[0].plan.label.rsplit("-seed", 1)[0]
        return f"{label} seed{'s' if len(seeds) > 1 else ''} {', '.join(seeds)}"

    def run(self, should_stop: Callable[[], bool], on_progress: Report) -> list[Member]:
        """Train, calibrate and evaluate what is missing; a stopped training leaves its best so far,
        marked as interrupted.

        An artefact that another process is making is taken from it once it is done; those that no
        process makes come first.

        On one thread, that of matrix products included: recursions over small states gain nothing
        from more, and groups run side by side.

        Parameters
        ----------
        should_stop : callable
            Asked between batches and stages.
        on_progress : callable
            Takes the progress of trainings, and what the group waits for.

        Returns
        -------
        list of Member
            One a job, in their order; a member that was stopped lacks what was not made.
        """

        def artefact_of(plan: StagePlan, write: Write) -> Artefact | None:
            if should_stop():
                return None
            return self.existing(plan) or ensured(
                plan, write, plan.stage in self.force, should_stop, on_progress
            )

        torch.set_num_threads(1)
        with single_blas_thread():
            models = {job.plan.key: self.existing(job.plan) for job in self.jobs}
            waiting = [job for job in self.jobs if models[job.plan.key] is None]
            while waiting and not should_stop():
                with locked_jobs(waiting, should_stop, on_progress) as jobs:
                    for job in jobs:
                        if STAGE in self.force:
                            drop_checkpoint(job.plan.checkpoint_folder)
                        else:
                            models[job.plan.key] = find(
                                job.plan
                            )  # another process may have made it meanwhile
                    for together in _together(
                        [job for job in jobs if models[job.plan.key] is None]
                    ):
                        if should_stop():
                            break
                        models |= {
                            artefact.key: artefact
                            for artefact in _train(together, should_stop, on_progress)
                        }
                waiting = [job for job in waiting if job not in jobs]
            members = []
            for job in self.jobs:
                with compile_lock(job.plan.output, should_stop):
                    members.append(_member(self, job, models[job.plan.key], artefact_of))
            return members

    def existing(
        self, plan: StagePlan, warn: Callable[[str], None] = lambda text: None
    ) -> Artefact | None:
        """The artefact of a plan, if it is there and not to be made anew.

        ``warn`` receives a line about a damaged one.
        """
        return None if plan.stage in self.force else find(plan, warn)


def existing(group: Group, warn: Callable[[str], None] = lambda text: None) -> list[Member]:
    """The members of a group with the artefacts that are there already.

    Parameters
    ----------
    group : Group
        Jobs, and what is to be done with them.
    warn : callable
        Takes one line on a damaged artefact.
    """
    return [
        _member(
            group, job, group.existing(job.plan, warn), lambda plan, _: group.existing(plan, warn)
        )
        for job in group.jobs
    ]


def _member(
    group: Group,
    job: TrainJob,
    model: Artefact | None,
    artefact_of: Callable[[StagePlan, Write], Artefact | None],
) -> Member:
    """A member whose model is calibrated, then evaluated, as far as ``artefact_of`` gives
    artefacts.
    """
    if model is None or model.status != "complete":
        return Member(job, model)
    calibration = evaluation = None
    calibrating = plan_calibrate(model, group.split, job.data, job.plan.output, group.cars)
    if calibrating is not None:
        calibration = artefact_of(*calibrating)
        if calibration is None:
            return Member(job, model)
    if group.evaluation is not None:
        evaluation = artefact_of(*group.evaluation.of(model, calibration))
    return Member(
        job,
        model,
        evaluation,
        calibration,
        finished=group.evaluation is None or evaluation is not None,
    )


def compile_lock(output: Path, should_stop: Callable[[], bool]) -> AbstractContextManager[object]:
    """Lock under which one process compiles the kernels of calibration and evaluation while others
    wait; without effect once they are in the compile cache.

    The lock lies in the output root; ``should_stop`` is called while waiting.
    """
    missing = any(map(has_to_compile, (SLOW_KERNEL, FLOOR_KERNEL)))
    return held(Lock(output, "compile", "health"), should_stop) if missing else nullcontext()


@contextmanager
def locked_jobs(
    jobs: Sequence[TrainJob], should_stop: Callable[[], bool], on_waiting: Callable[[Waiting], None]
) -> Iterator[list[TrainJob]]:
    """Hold the locks of those trainings that are free; where none is, wait for the first.

    A process that waits holds no other training, so that two never wait for each other.
    """
    with ExitStack() as stack:
        free = [job for job in jobs if stack.enter_context(held(job.plan.lock))]
        if not free and stack.enter_context(held(jobs[0].plan.lock, should_stop, on_waiting)):
            free = [jobs[0]]
        yield free


def _together(jobs: Sequence[TrainJob]) -> list[list[TrainJob]]:
    """Group jobs that can continue together: those whose checkpoints, if any, are of the same
    epoch.
    """
    batches: dict[int, list[TrainJob]] = {}
    for job in jobs:
        batches.setdefault(resume_epoch(job.plan.checkpoint_folder), []).append(job)
    return list(batches.values())


def _train(
    jobs: Sequence[TrainJob], should_stop: Callable[[], bool], on_progress: Report
) -> list[Artefact]:
    """Train jobs together and write a model for each; those without a finished epoch are left out,
    and their checkpoints stay.
    """
    folders = [job.plan.checkpoint_folder for job in jobs]
    context = FitContext(
        checkpoint_folders=folders, should_stop=should_stop, on_progress=on_progress
    )
    artefacts = []
    for job, (estimator, record) in zip(jobs, fit_jobs(jobs, context), strict=True):
        if record.interrupted and not record.metrics.get("best_epoch", 1):
            continue  # nothing trained yet; the checkpoint states where to go on

        def write(
            folder: Path,
            job: TrainJob = job,
            estimator: Estimator = estimator,
            record: FitRecord = record,
        ) -> Status:
            write_model(job, estimator, record, folder)
            return "interrupted" if record.interrupted else "complete"

        artefacts.append(make(job.plan, write))
        if not record.interrupted:
            drop_checkpoint(job.plan.checkpoint_folder)
    return artefacts
