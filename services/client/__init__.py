"""A thin client of the HTTP API."""

from __future__ import annotations

from services.client.client import ApiError, Client, Json

__all__ = ["ApiError", "Client", "Json"]
