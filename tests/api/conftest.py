"""A real uvicorn process over a SQLite file, and the same file opened beside it to play the agent."""

from __future__ import annotations

from collections.abc import Iterator

import httpx
import pytest
from api_service import Service, running

from services.store.sql import SqlStore


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with running(f"sqlite:///{tmp_path_factory.mktemp('api')}/store.db") as started:
        yield started


@pytest.fixture(scope="module")
def store(service: Service) -> Iterator[SqlStore]:
    opened = SqlStore(service.database_url)
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def http(service: Service) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=service.url, timeout=60) as client:
        yield client
