"""Kernels for a claimed GPU: those of the tests' emulators."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from vipe_core.ba.cuda.compiler import Specialisation
from vipe_core.ba.cuda.launcher import Launcher
from vipe_core.priors.droid.kernels import LookupKernels

_TESTS = Path(__file__).parents[2] / "tests"


def emulators() -> tuple[Callable[[Specialisation], Launcher] | None, Callable[[torch.dtype], LookupKernels] | None]:
    """What `claimed_gpu` takes, to adjust and to look up correlations; nothing without a compiler."""
    sys.path += [str(_TESTS / "ba"), str(_TESTS / "priors")]
    adjustment: Any = importlib.import_module("cuda_emulator")
    correlation: Any = importlib.import_module("lookup_emulator")
    if adjustment.COMPILER is None:
        return None, None
    return lambda kind: adjustment.EmulatedLauncher(kind, [kind]), lambda _: correlation.EmulatedLookups()
