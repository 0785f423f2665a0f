"""Members on several threads: compiled loops that let go of Python's lock, each thread on its own members."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import torch


def over_members(work: Callable[[int, int], None], members: int) -> None:
    """Call ``work(first, end)`` on stretches of the members, side by side on as many threads as torch is allowed.

    A worker of the launcher, which is allowed one, stays on its own thread. What is computed does not depend on the number.
    """
    threads = max(min(torch.get_num_threads(), members), 1)
    bounds = [members * part // threads for part in range(threads + 1)]
    others = [_pool(threads - 1).submit(work, *bounds[part : part + 2]) for part in range(1, threads)]
    work(*bounds[:2])
    for other in others:
        other.result()


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="vehest-members")


os.register_at_fork(after_in_child=_pool.cache_clear)  # a forked process does not inherit the threads
