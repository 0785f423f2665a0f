"""Members on several threads.

Compiled loops that release Python's lock, each thread on its own members.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache

# pieces of work for each thread, so that a delayed thread leaves its share to the others
PIECES = 4
_allowed = ContextVar("_allowed", default=0)  # threads for members; 0: as many as torch's


@contextmanager
def threads_for_members() -> Iterator[None]:
    """Context in which `over_members` uses the threads that torch was allowed, and torch one.

    Its small operations would wait for threads held up.
    """
    import torch

    token = _allowed.set(torch.get_num_threads())
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(_allowed.get())
        _allowed.reset(token)


def over_members(work: Callable[[int, int], None], members: int, pieces: int = PIECES) -> None:
    """Call ``work(first, end)`` on ranges of the members (or whatever else can be worked on one
    by one), ``pieces`` for each thread.

    They run side by side on as many threads as torch is allowed; what is computed does not depend
    on the number.

    Parameters
    ----------
    work : callable
        Works on the members from ``first`` to ``end``; it must release Python's lock to gain from
        threads.
    members : int
        How many there are; one alone is worked on by the calling thread.
    pieces : int
        Ranges for each thread.
    """
    threads = 1
    if members > 1:
        from torch import get_num_threads

        threads = min(_allowed.get() or get_num_threads(), members)
    if threads == 1:
        work(0, members)
        return
    pieces = min(pieces * threads, members)
    ranges = iter(
        [(members * piece // pieces, members * (piece + 1) // pieces) for piece in range(pieces)]
    )

    def take() -> None:
        for first, end in ranges:  # whoever is free takes the next
            work(first, end)

    tasks = [_pool(threads - 1).submit(take) for _ in range(threads - 1)]
    take()
    for task in tasks:
        if not task.cancel():
            task.result()


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """A pool of threads, kept for later calls."""
    return ThreadPoolExecutor(threads, thread_name_prefix="vehest-members")


# a forked process does not inherit the threads; Windows forks none
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)
