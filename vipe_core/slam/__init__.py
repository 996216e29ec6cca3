"""From frames to poses: keyframes, tracking, global adjustment, infill (paper section 3.1)."""

from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.system import Slam, SlamResult

__all__ = ["Slam", "SlamResult", "SlamSettings"]
