"""How kernels whose sums may be reordered are compiled.

With the same digits on the first run as on every later one.

A compiled function that calls another has a copy of it in its own object, optimised once more for
where it stands. The process that compiles runs the callee's first version, one that reads the cache
runs the copy; where sums may be reordered, their last digits differ. So a callee is made part of
its callers, and exists nowhere else.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba


def entry(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator that compiles a function which Python calls, and keeps it in the compile cache.

    ``options`` are those of ``numba.njit``.
    """
    return numba.njit(cache=True, error_model="numpy", **options)  # type: ignore[no-any-return]


def part(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator that compiles a function which only compiled functions call, as a part of these.

    ``options`` are those of ``numba.njit``.

    With ``_nrt=False`` it counts no references of arrays, which compiles sooner; it may then
    neither make nor return one.
    """
    return numba.njit(  # type: ignore[no-any-return]
        forceinline=True,
        no_cpython_wrapper=True,
        no_cfunc_wrapper=True,
        error_model="numpy",
        **options,
    )


def has_to_compile(location: str) -> bool:
    """Whether an entry, ``module:function``, compiles on this machine before it first runs.

    Later runs load the result.

    A cache file counts if it is not older than the source. It is False where numba does not compile
    at all, or has no folder for its cache.
    """
    name, _, entry_name = location.partition(":")
    if not name:
        return False
    module = importlib.import_module(name)
    function = getattr(module, entry_name)
    if not hasattr(function, "stats"):  # NUMBA_DISABLE_JIT
        return False
    folder = function.stats.cache_path
    source = Path(str(module.__file__))
    index_files = [] if folder is None else Path(folder).glob(f"{source.stem}.{entry_name}-*.nbi")
    return folder is not None and not any(
        index.stat().st_mtime >= source.stat().st_mtime for index in index_files
    )
