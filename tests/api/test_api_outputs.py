"""Where a job may write is checked when it is sent, and again when it is planned."""

from __future__ import annotations

from pathlib import Path

import httpx
from api_helpers import assert_problem
from api_service import running


def test_outputs_outside_of_the_roots_are_refused_at_once(tmp_path: Path) -> None:
    allowed = tmp_path / "allowed"
    with (
        running(f"sqlite:///{tmp_path}/store.db", f'output_roots=["{allowed}"]') as service,
        httpx.Client(base_url=service.url, timeout=60) as http,
    ):
        for output in (str(tmp_path / "elsewhere"), str(tmp_path / "allowed-not")):
            problem = assert_problem(
                http.post("/v1/jobs", json={"inputs": ["/videos"], "output": output}), 422, "invalid_request"
            )
            assert "outside" in problem["detail"]
        for output in (str(allowed / "new"), "s3://bucket/out"):
            assert http.post("/v1/jobs", json={"inputs": ["/videos"], "output": output}).status_code == 202
