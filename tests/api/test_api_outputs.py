"""Where a job may write is checked when it is sent, and again when it is planned."""

from __future__ import annotations

from pathlib import Path

import pytest
from starlette.requests import Request
from starlette.responses import Response

from services.api import create_app
from services.api.routes import create_job
from services.api.schemas import JobRequest
from services.domain.access import ALL_SCOPES, DEFAULT_TENANT, Caller
from services.domain.errors import InvalidRequest
from services.settings import Settings
from services.store.sql import SqlStore

CALLER = Caller(DEFAULT_TENANT, None, ALL_SCOPES)


def test_outputs_outside_of_the_roots_are_refused_at_once(tmp_path: Path) -> None:
    store = SqlStore(f"sqlite:///{tmp_path}/store.db")
    app = create_app(store, Settings(output_roots=(tmp_path / "allowed",)))
    request = Request({"type": "http", "app": app})

    def post(output: str) -> str:
        return create_job(JobRequest(inputs=["/videos"], output=output), CALLER, store, request, Response()).id

    for output in (str(tmp_path / "elsewhere"), str(tmp_path / "allowed-not")):
        with pytest.raises(InvalidRequest, match="outside"):
            post(output)
    assert {post(str(tmp_path / "allowed" / "new")), post("s3://bucket/out")} == {
        job.id for job in store.list_jobs()[0]
    }
    store.close()
