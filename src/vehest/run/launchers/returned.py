"""What a machine of a cluster reports of a task, in terms of the parent: outcomes under its own output root, and what is left to do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from vehest.run.console import Messages
from vehest.run.failures import Failure
from vehest.run.group import Group, Member
from vehest.run.launcher import Done
from vehest.run.launchers.times import Times
from vehest.run.launchers.worker import Report, moved, this_world

Outcome = list[Member] | Failure


class Returned:
    """Reads reports of tasks, learns from their times, and tells once of each machine with another processor.

    Args:
        output: the parent's output root.
        times: learns what groups took.
        messages: where other processors are told of.
        fetch: brings what members made into the output root, where machines do not write there themselves.
    """

    def __init__(self, output: Path, times: Times, messages: Messages, fetch: Callable[[list[Member]], Outcome] = lambda own: own) -> None:
        self._output, self._times, self._messages, self._fetch = output, times, messages, fetch
        self._told: set[str] = set()

    def read(self, told: Report, lot: Sequence[int], groups: Sequence[Group]) -> tuple[list[Done[list[Member]]], list[int]]:
        """What ended, and positions of which the report says nothing.

        Args:
            told: the report.
            lot: positions of the groups that were the task.
            groups: all of the launch.
        """
        self._compare_processors(told)
        done = []
        for ended in told.ended:
            if ended.outcome is None:
                continue
            outcome: Outcome = ended.outcome
            if not isinstance(outcome, Failure):
                outcome = self._fetch(moved(outcome, self._output.resolve(), self._output))
                self._times.learn(groups[ended.position], ended.seconds)
            done.append(Done(ended.position, outcome, ended.seconds))
        return done, sorted(set(lot) - {ended.position for ended in told.ended})

    def _compare_processors(self, told: Report) -> None:
        here = this_world().cpu
        if told.cpu != here and told.host not in self._told:
            self._told.add(told.host)
            detail = f"has another processor ({told.cpu}, here {here}): last digits may differ from those made here"
            self._messages.line("note", "cluster", told.host, detail)
