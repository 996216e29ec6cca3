"""Which directories of this machine the service may touch."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path


def lies_within(path: str | Path, roots: Sequence[Path]) -> bool:
    """Whether a path, existing or not, lies in or below one of the directories, symbolic links resolved.

    Without any directory everything is allowed.
    """
    real = Path(os.path.realpath(path))
    return not roots or any(real.is_relative_to(os.path.realpath(root)) for root in roots)
