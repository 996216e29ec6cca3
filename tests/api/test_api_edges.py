"""What surrounds the jobs: errors, ids, authentication, health, metrics, the OpenAPI document."""

from __future__ import annotations

import asyncio
import contextlib
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from api_helpers import assert_problem, submit
from api_service import ROOT, Service, running
from fastapi import FastAPI
from openapi_spec_validator import validate
from pydantic import SecretStr
from starlette.types import Message, Receive, Scope, Send

from services.api import create_app, create_server, problems
from services.api.middleware import RequestContext
from services.domain import errors
from services.observability.metrics import Metrics
from services.settings import Settings
from services.store.sql import SqlStore


def test_unknown_paths_and_methods(http: httpx.Client) -> None:
    for path in ("/", "/v1", "/v1/nope", "/v2/jobs"):
        assert_problem(http.get(path), 404, "not_found")
    answer = http.delete("/v1/jobs")
    assert_problem(answer, 405, "method_not_allowed")
    assert answer.headers["allow"]
    assert_problem(http.put("/healthz"), 405, "method_not_allowed")


def test_request_ids(http: httpx.Client) -> None:
    assert http.get("/healthz", headers={"X-Request-ID": "my-id.1"}).headers["x-request-id"] == "my-id.1"
    made = http.get("/healthz", headers={"X-Request-ID": "bad id"}).headers["x-request-id"]
    assert len(made) == 32
    assert http.get("/healthz").headers["x-request-id"] != made
    problem = assert_problem(http.get("/nope", headers={"X-Request-ID": "mine"}), 404, "not_found")
    assert problem["request_id"] == "mine"


def test_health(http: httpx.Client) -> None:
    assert http.get("/healthz").json() == {"status": "ok"}
    assert http.get("/readyz").json() == {"status": "ok"}


def test_metrics(http: httpx.Client) -> None:
    job_id = submit(http)
    http.get(f"/v1/jobs/{job_id}")
    http.get("/nothing/here")
    answer = http.get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain")
    text = answer.text
    assert 'vipe_jobs{state="queued"}' in text
    assert 'vipe_shards{state="leased"}' in text
    count = "vipe_api_request_duration_seconds_count"
    assert f'{count}{{method="GET",route="/v1/jobs/{{job_id}}",status="200"}}' in text
    assert f'{count}{{method="POST",route="/v1/jobs",status="202"}}' in text
    assert f'{count}{{method="GET",route="unmatched",status="404"}}' in text
    assert job_id not in text


def test_the_openapi_document(http: httpx.Client) -> None:
    document = http.get("/openapi.json").json()
    validate(document)
    assert "HTTPValidationError" not in document["components"]["schemas"]
    checked = 0
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            for status, response in operation["responses"].items():
                if not status.startswith("2"):
                    assert list(response["content"]) == ["application/problem+json"], (path, method, status)
                    checked += 1
            if path.startswith("/v1/jobs/{job_id}"):
                assert {"401", "404", "422"} <= set(operation["responses"])
                assert operation["security"]
    assert checked > 20
    assert document["paths"]["/v1/jobs"]["post"]["responses"]["202"]["headers"]["Location"]


def test_with_a_key(tmp_path: Path) -> None:
    with running(f"sqlite:///{tmp_path}/store.db", "api_key=secret") as service:
        for headers in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": "Basic c2VjcmV0"}):
            answer = httpx.get(f"{service.url}/v1/jobs", headers=headers)
            assert_problem(answer, 401, "unauthorized")
            assert answer.headers["www-authenticate"] == "Bearer"
            assert_problem(httpx.post(f"{service.url}/v1/jobs", headers=headers, json={}), 401, "unauthorized")
        right = {"Authorization": "Bearer secret"}
        assert httpx.get(f"{service.url}/v1/jobs", headers=right).json() == {"items": [], "next_page_token": None}
        assert httpx.get(f"{service.url}/healthz").status_code == 200


def test_a_public_address_needs_a_key(tmp_path: Path) -> None:
    store = SqlStore(f"sqlite:///{tmp_path}/store.db")
    for host in ("0.0.0.0", "::", "10.1.2.3", "gpu-box"):
        public = Settings(host=host, port=0)
        with pytest.raises(errors.InvalidRequest, match=f"{host}.*VIPE_API_KEY.*VIPE_ALLOW_ANONYMOUS"):
            create_server(create_app(store, public), public)
    with pytest.raises(errors.InvalidRequest, match="vipectl keys create"):
        create_server(create_app(store, strict := Settings(allow_anonymous=False)), strict)
    for allowed in (
        Settings(host="0.0.0.0", api_key=SecretStr("secret")),
        Settings(host="0.0.0.0", allow_anonymous=True),
        Settings(host="::1"),
        Settings(host="localhost"),
    ):
        create_server(create_app(store, allowed), allowed)
    store.create_key("somebody")
    create_server(create_app(store, public), public)
    store.close()


def test_other_names_for_this_machine_are_refused(http: httpx.Client, service: Service, tmp_path: Path) -> None:
    port = service.url.rsplit(":", 1)[1]
    for host in ("localhost", f"LocalHost:{port}", f"127.0.0.1:{port}", "127.0.0.1", f"[::1]:{port}"):
        assert http.get("/v1/jobs", headers={"Host": host}).status_code == 200, host
    for host in ("evil.example", f"evil.example:{port}", "localhost.evil.example", "127.0.0.1.evil.example", ""):
        for path in ("/v1/jobs", "/metrics", "/healthz"):
            assert_problem(http.get(path, headers={"Host": host}), 400, "unknown_host")
    with running(f"sqlite:///{tmp_path}/store.db", "api_key=secret") as guarded:  # as behind a proxy of this machine
        headers = {"Host": "vipe.example", "Authorization": "Bearer secret"}
        assert httpx.get(f"{guarded.url}/v1/jobs", headers=headers).status_code == 200


def test_a_defect_is_a_problem_too(tmp_path: Path) -> None:
    class BrokenStore(SqlStore):
        def counts(self) -> dict[str, dict[str, int]]:
            raise ZeroDivisionError("secret detail")

        def ping(self) -> None:
            raise errors.StoreUnavailable("the database does not answer; try again")

    store = BrokenStore(f"sqlite:///{tmp_path}/store.db")
    with serving(create_app(store, Settings(port=0))) as url:
        problem = assert_problem(httpx.get(f"{url}/metrics"), 500, "internal_error")
        assert "secret" not in problem["detail"]
        answer = httpx.get(f"{url}/readyz")
        assert_problem(answer, 503, "store_unavailable")
        assert answer.headers["retry-after"]
    store.close()


def test_metrics_without_a_store(tmp_path: Path) -> None:
    class UnreachableStore(SqlStore):
        def counts(self) -> dict[str, dict[str, int]]:
            raise errors.StoreUnavailable("the database does not answer; try again")

    store = UnreachableStore(f"sqlite:///{tmp_path}/store.db")
    with serving(create_app(store, Settings(port=0))) as url:
        assert httpx.get(f"{url}/healthz").status_code == 200
        answer = httpx.get(f"{url}/metrics")
    store.close()
    assert answer.status_code == 200
    assert "vipe_store_up 0.0" in answer.text
    assert 'route="/healthz"' in answer.text
    assert "vipe_jobs{" not in answer.text


@pytest.mark.parametrize(
    ("content_type", "seconds"), [("text/event-stream; charset=utf-8", 2.0), ("text/plain", 3602.0)]
)
def test_the_duration_of_a_stream_is_the_time_to_its_start(
    content_type: str, seconds: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 100.0
    monkeypatch.setattr("services.api.middleware.time.perf_counter", lambda: now_s)

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        nonlocal now_s
        now_s += 2.0
        headers = [(b"content-type", content_type.encode())]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        now_s += 3600.0
        await send({"type": "http.response.body", "body": b""})

    async def receive() -> Message:
        return {"type": "http.disconnect"}

    async def send(message: Message) -> None:
        pass

    metrics = Metrics()
    scope = {"type": "http", "method": "GET", "path": "/x", "headers": []}
    asyncio.run(RequestContext(app, metrics=metrics)(scope, receive, send))
    labels = {"route": "unmatched", "method": "GET", "status": "200"}
    assert metrics.registry.get_sample_value("vipe_api_request_duration_seconds_sum", labels) == seconds


@contextlib.contextmanager
def serving(app: FastAPI) -> Iterator[str]:
    """The application in this process, where a test needs a part that cannot be named on a command line."""
    server = create_server(app, app.state.settings)
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    try:
        yield server.url
    finally:
        server.should_exit = True
        thread.join(timeout=30)
        assert not thread.is_alive()


def test_an_agent_that_has_no_worker_is_shown(tmp_path: Path) -> None:
    """With Ray down the API goes on taking jobs; why they stay queued must be visible."""
    ready = threading.Event()
    store = SqlStore(f"sqlite:///{tmp_path}/store.db")
    with serving(create_app(store, Settings(port=0), agent_ready=ready.is_set)) as url:
        starting = httpx.get(f"{url}/readyz")
        assert (starting.status_code, starting.json()) == (200, {"status": "ok", "agent": "starting"})
        ready.set()
        assert httpx.get(f"{url}/readyz").json() == {"status": "ok", "agent": "ready"}
    store.close()


def test_the_api_does_not_load_the_engine() -> None:
    """What the engine computes with takes seconds to import; the first request must not pay for it."""
    program = """
import sys
from services.api import create_app, create_server, offer
from services.api.schemas import JobRequest
offered = {"preset": offer.presets()[0], "camera": offer.cameras()[0]}
JobRequest.model_validate({"inputs": ["/a"], "output": "/b", **offered})
print(sorted({"torch", "numba", "cv2", "ray"} & set(sys.modules)))
"""
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.stdout.strip() == "[]", done.stderr


def test_every_error_of_the_service_has_its_own_code() -> None:
    found: list[type[errors.ServiceError]] = [errors.ServiceError]
    for kind in found:
        found += kind.__subclasses__()
    ours = [e for e in found if e.__module__ in (errors.__name__, problems.__name__)]
    assert len({e.code for e in ours}) == len(ours)
    assert all(400 <= e.status < 600 for e in ours)


def test_settings_come_from_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("VIPE_DATA_DIR", str(tmp_path))
    monkeypatch.setenv("VIPE_INPUT_ROOTS", '["/data", "/more"]')
    monkeypatch.setenv("VIPE_API_KEY", "hidden")
    settings = Settings()
    assert settings.database_url == f"sqlite:///{tmp_path}/vipe.db"
    assert settings.scratch_dir == tmp_path / "scratch"
    assert settings.input_roots == (Path("/data"), Path("/more"))
    assert "hidden" not in repr(settings)
    assert all(field.description for field in Settings.model_fields.values())
