"""What the tests of the program share."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

VIPECTL = Path(sys.executable).parent / "vipectl"
Run = Callable[..., subprocess.CompletedProcess[str]]
