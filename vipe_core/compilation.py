"""How the engine's inner loops are compiled.

Numba's on-disk cache notices a change of the file that holds a function, not of files it calls into. So a kernel and
everything it calls live in one file.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from numba import njit

F = TypeVar("F", bound=Callable[..., object])

# Sums may be split over the lanes of a vector register and products fused into them: a fixed order for a given machine,
# so the same bytes on every run. Infinities and NaN keep their meaning.
_VECTOR_SUMS = {"reassoc", "contract", "nsz"}


def compiled(function: F) -> F:
    """`numba.njit` for arithmetic in source order; no parallelism, the GIL is released."""
    return _cached(function, fastmath=False)


def vectorised(function: F) -> F:
    """`numba.njit` whose floating-point sums run in vector lanes; no parallelism, the GIL is released."""
    return _cached(function, fastmath=_VECTOR_SUMS)


def _cached(function: F, fastmath: bool | set[str]) -> F:
    try:
        result: F = njit(cache=True, nogil=True, error_model="numpy", fastmath=fastmath)(function)
    except RuntimeError:  # neither the package's folder nor the user's cache folder can be written to
        result = njit(nogil=True, error_model="numpy", fastmath=fastmath)(function)
    return result
