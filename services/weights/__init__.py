"""Getting network weights: from the public, from a mirror, and into one."""

from __future__ import annotations

from services.weights.fetching import Pulled, pull
from services.weights.mirroring import mirror

__all__ = ["Pulled", "mirror", "pull"]
