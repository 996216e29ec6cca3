"""Claims a GPU as the interpreter starts: for commands, and for the processes that these start.

    PYTHONPATH=benchmarks/claimed_gpu/everywhere:. python -m benchmarks.gpu_pipeline --videos 1

Kernels are those of the tests' emulators, where there is a C++ compiler for them.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

from benchmarks.claimed_gpu import claimed_gpu

_TESTS = Path(__file__).parents[3] / "tests"
sys.path += [str(_TESTS / "ba"), str(_TESTS / "priors")]
_emulator: Any = importlib.import_module("cuda_emulator")
_lookups: Any = importlib.import_module("lookup_emulator")
_there = _emulator.COMPILER is not None
# Kept, and never given back: the process ends with it.
_claim = claimed_gpu(
    (lambda kind: _emulator.EmulatedLauncher(kind, [kind])) if _there else None,
    (lambda _: _lookups.EmulatedLookups()) if _there else None,
)
_claim.__enter__()
