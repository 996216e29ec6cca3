"""The CUDA kernels of bundle adjustment under the sanitizers of a C++ compiler: `python -m benchmarks.ba_sanitize`.

The emulator of `tests/ba` runs the kernels' own source on a CPU. Built with the address and the undefined-behaviour
sanitizer, it stops where a kernel reads or writes beyond a tensor, shared memory or an array of its own, where an
address is not aligned, where a whole number overflows. As near as a machine without a GPU comes to compute-sanitizer's
memcheck; for races there is the test that runs blocks and threads in other orders and wants the same bits. Needs g++
and minutes. Further arguments are pytest's.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence

_TESTS = "tests/ba/test_cuda_kernels.py"


def main(argv: Sequence[str] | None = None) -> int:
    # The interpreter is not built with them, so what watches memory has to be there first.
    libraries = (
        subprocess.run(["g++", f"-print-file-name={name}"], capture_output=True, text=True, check=True).stdout.strip()
        for name in ("libasan.so", "libstdc++.so")
    )
    watched = {
        "LD_PRELOAD": os.pathsep.join(libraries),
        # The interpreter frees nothing at its end; threads of the emulator have stacks of their own.
        "ASAN_OPTIONS": "detect_leaks=0:detect_stack_use_after_return=0",
        "VIPE_EMULATOR_SANITIZERS": "address,undefined",
    }
    arguments = sys.argv[1:] if argv is None else argv
    # Not captured: what is found is said while the process ends.
    command = [sys.executable, "-m", "pytest", "-q", "-s", "-p", "no:xdist", _TESTS, *arguments]
    return subprocess.run(command, env=os.environ | watched, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
