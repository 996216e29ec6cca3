"""The HTTP API: validates, asks the store, answers. No work is done in this process's event loop."""

from __future__ import annotations

from services.api.app import create_app
from services.api.server import ApiServer, create_server

__all__ = ["ApiServer", "create_app", "create_server"]
