"""Claims a GPU as the interpreter starts: for commands, and for the processes that these start.

    PYTHONPATH=benchmarks/claimed_gpu/everywhere:. python -m benchmarks.gpu_pipeline --videos 1

Kernels are those of the tests' emulators, where there is a C++ compiler for them.
"""

from __future__ import annotations

from benchmarks.claimed_gpu import claimed_gpu
from benchmarks.claimed_gpu.emulated import emulators

# Kept, and never given back: the process ends with it.
_claim = claimed_gpu(*emulators())
_claim.__enter__()
