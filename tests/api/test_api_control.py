"""Job control over HTTP."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
import pytest
from api_helpers import assert_problem, body, claim, finish, plan, submit
from api_service import Service, running

from services.client import Client
from services.store.sql import SqlStore


def soon() -> str:
    return (datetime.now(UTC) + timedelta(hours=1)).strftime("%Y-%m-%dT%H:%M:%SZ")


def test_a_job_says_how_it_is_run(http: httpx.Client) -> None:
    job = http.post("/v1/jobs", json=body()).json()
    assert job["control"] == {
        "priority": 0,
        "deadline": None,
        "max_slot_hours": None,
        "max_failure_ratio": 0.5,
        "failure_window": 200,
        "webhook_url": None,
        "webhook_secret": None,
    }
    assert (job["pause_reason"], job["slot_seconds"], job["retries"]) == (None, 0.0, 0)
    wanted = {"priority": -3, "deadline": soon(), "max_slot_hours": 2, "max_failure_ratio": None, "failure_window": 5}
    job = http.post("/v1/jobs", json=body(**wanted)).json()
    assert {name: job["control"][name] for name in wanted} == wanted


@pytest.mark.parametrize(
    "wrong",
    [
        {"priority": 1001},
        {"priority": "high"},
        {"priority": 1.5},
        {"deadline": "2030-01-01T00:00:00"},
        {"deadline": 1893456000},
        {"deadline": "9999-12-31T23:59:59-23:59"},
        {"deadline": "2001-01-01T00:00:00Z"},
        {"deadline": "soon"},
        {"max_slot_hours": 0},
        {"max_slot_hours": 1e300},
        {"max_failure_ratio": 1.0},
        {"max_failure_ratio": -0.1},
        {"failure_window": 0},
        {"webhook": "https://example.org"},
        {"webhook": {"url": "https://example.org"}},
        {"webhook": {"url": "https://example.org", "secret": "nobody-knows"}},
        {"webhook": {"url": "https://example.org", "secret": "../default/x"}},
    ],
    ids=str,
)
def test_what_is_refused(http: httpx.Client, wrong: dict[str, Any]) -> None:
    assert_problem(http.post("/v1/jobs", json=body(**wrong)), 422, "invalid_request")
    job_id = submit(http)
    assert_problem(http.patch(f"/v1/jobs/{job_id}", json=wrong), 422, "invalid_request")


def test_change(http: httpx.Client) -> None:
    job_id = submit(http, priority=1)
    job = http.patch(f"/v1/jobs/{job_id}", json={"max_slot_hours": 3.5, "deadline": soon()}).json()
    assert (job["control"]["priority"], job["control"]["max_slot_hours"]) == (1, 3.5)
    job = http.patch(f"/v1/jobs/{job_id}", json={"max_slot_hours": None, "deadline": None}).json()
    assert (job["control"]["max_slot_hours"], job["control"]["deadline"]) == (None, None)
    assert http.patch(f"/v1/jobs/{job_id}", json={}).json()["updated_at"] == job["updated_at"]
    http.post(f"/v1/jobs/{job_id}/cancel")
    assert_problem(http.patch(f"/v1/jobs/{job_id}", json={"priority": 2}), 409, "job_ended")
    assert_problem(http.patch("/v1/jobs/job_x", json={"priority": 2}), 404, "job_not_found")


def test_pause_and_resume(service: Service, store: SqlStore, http: httpx.Client) -> None:
    job_id = submit(http)
    plan(store, job_id)
    with Client(service.url) as client:
        job = client.pause(job_id)
        assert (job["state"], job["pause_reason"]) == ("paused", "requested")
        assert claim(store, job_id) == []
        assert [j["id"] for j in client.jobs(state="paused")] == [job_id]
        assert client.change(job_id, priority=4)["control"]["priority"] == 4
        assert client.resume(job_id)["state"] == "running"
        finish(store, job_id)
    for action, code in (("pause", "job_not_pausable"), ("resume", "job_not_resumable")):
        assert_problem(http.post(f"/v1/jobs/{job_id}/{action}"), 409, code)
        assert_problem(http.post(f"/v1/jobs/job_x/{action}"), 404, "job_not_found")


def test_retry(service: Service, store: SqlStore, http: httpx.Client) -> None:
    job_id = submit(http)
    plan(store, job_id)
    assert_problem(http.post(f"/v1/jobs/{job_id}/retry", json={}), 409, "job_not_retryable")
    finish(store, job_id, "s0v1")
    with Client(service.url) as client:
        history = list(client.events(job_id))
        assert history[-1]["kind"] == "job.succeeded_with_errors"
        assert_problem(http.post(f"/v1/jobs/{job_id}/retry", json={}), 409, "nothing_to_retry")
        job = client.retry(job_id, error_codes=["media_corrupt"])
        assert (job["state"], job["retries"], job["progress"]["videos_failed"]) == ("running", 1, 0)
        finish(store, job_id)
        assert client.job(job_id)["state"] == "succeeded"
        kinds = [e["kind"] for e in client.events(job_id) if e["kind"] != "progress"]
        assert kinds[-1] == "job.succeeded", "an end that was not the last does not end the stream"
        assert kinds.count("job.succeeded_with_errors") == 1
        assert len(kinds) == len(store.events(job_id))


@pytest.mark.parametrize(
    "wrong",
    [
        {"error_codes": ["x"], "select": "retryable"},
        {"select": "everything"},
        {"error_codes": ["no spaces"]},
        {"error_codes": ["x"] * 51},
        {"codes": []},
        [],
    ],
    ids=str,
)
def test_retries_that_are_not_understood(http: httpx.Client, wrong: object) -> None:
    assert_problem(http.post(f"/v1/jobs/{submit(http)}/retry", json=wrong), 422, "invalid_request")


@pytest.fixture(scope="module")
def with_secrets(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    url = f"sqlite:///{tmp_path_factory.mktemp('hooks')}/store.db"
    secrets = '{"default/ours": "0123456789abcdef0123", "other/theirs": "0123456789abcdef0123"}'
    with running(url, VIPE_WEBHOOK_SECRETS=secrets) as started:
        yield started


@pytest.mark.parametrize(
    ("url", "secret", "code"),
    [
        ("https://example.org/hook", "ours", None),
        ("https://example.org/hook", "theirs", "invalid_request"),
        ("http://example.org/hook", "ours", "address_refused"),
        ("https://127.0.0.1/hook", "ours", "address_refused"),
        ("https://169.254.169.254/latest", "ours", "address_refused"),
        ("https://[::1]/hook", "ours", "address_refused"),
        ("https://10.0.0.1/hook", "ours", "address_refused"),
        ("https://user:word@example.org/hook", "ours", "address_refused"),
        ("https://example.org:22/", "ours", "address_refused"),
        ("file:///etc/passwd", "ours", "address_refused"),
        ("https://", "ours", "address_refused"),
    ],
)
def test_webhooks_go_to_public_addresses_and_are_signed(
    with_secrets: Service, url: str, secret: str, code: str | None
) -> None:
    with httpx.Client(base_url=with_secrets.url) as http:
        hook = {"webhook": {"url": url, "secret": secret}}
        job_id = submit(http)
        for answer in (http.post("/v1/jobs", json=body(**hook)), http.patch(f"/v1/jobs/{job_id}", json=hook)):
            if code is None:
                assert answer.json()["control"]["webhook_url"] == url
                assert "0123456789abcdef" not in answer.text
            else:
                assert_problem(answer, 422, code)
