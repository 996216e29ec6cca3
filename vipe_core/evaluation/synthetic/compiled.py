"""How the kernels of the renderer are compiled.

Numba's on-disk cache notices a change of the file that holds a function, not of files it calls into. So a kernel and
everything it calls live in one file.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from numba import njit

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """`numba.njit` without parallelism or reordered arithmetic: the same bytes on every run."""
    result: F = njit(cache=True, error_model="numpy", fastmath=False)(function)
    return result
