"""What reading and writing plain artifacts costs to import: workers start with it."""

from __future__ import annotations

import subprocess
import sys


def test_plain_artifacts_need_neither_torch_nor_a_compiler() -> None:
    code = "import sys, vipe_core.formats; print(sorted({'torch', 'numba'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
