"""Connections to addresses that users name: only where the operator lets them go."""

from __future__ import annotations

from services.network.addresses import Endpoint, NetworkPolicy, refusal_of
from services.network.http import Answer, GuardedHttp

__all__ = ["Answer", "Endpoint", "GuardedHttp", "NetworkPolicy", "refusal_of"]
