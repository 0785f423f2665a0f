"""Matrix products within compiled code."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache

import scipy.linalg.cython_blas  # noqa: F401 - loads the library that compiled code calls
from threadpoolctl import ThreadpoolController

_controller = cache(ThreadpoolController)  # controller of the numbers of threads, made once


def single_blas_thread() -> AbstractContextManager[object]:
    """Context in which each matrix product of BLAS uses only the thread that calls it.

    Those of small blocks gain nothing from more, and several threads call them.
    """
    limited: AbstractContextManager[object] = _controller().limit(limits=1, user_api="blas")
    return limited
