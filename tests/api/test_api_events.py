"""Following a job over real HTTP."""

from __future__ import annotations

import json
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
from api_helpers import assert_problem, body, finish, plan, submit
from api_service import Service, running
from sqlalchemy import create_engine, update

from services.client import Client
from services.client.sse import parse_events
from services.store.schema import events
from services.store.sql import SqlStore

STREAM = {"Accept": "text/event-stream"}


def stream(http: httpx.Client, job_id: str, **headers: str) -> Iterator[tuple[str, str | None, dict[str, Any]]]:
    with http.stream("GET", f"/v1/jobs/{job_id}/events", headers={**STREAM, **headers}) as response:
        assert response.status_code == 200
        assert response.headers["content-type"].startswith("text/event-stream")
        for event in parse_events(response.iter_lines()):
            yield event.name, event.id, json.loads(event.data)


def test_the_stream_follows_a_job_to_its_end(http: httpx.Client, store: SqlStore) -> None:
    job_id = submit(http)
    seen: list[tuple[str, str | None, dict[str, Any]]] = []
    for event in stream(http, job_id):
        seen.append(event)
        if event[0] == "job.queued":
            plan(store, job_id, shards=1)
        if event[0] == "progress" and event[2]["state"] == "running":
            finish(store, job_id)
    names = [name for name, _, _ in seen if name != "progress"]
    assert names == [
        "job.queued",
        "job.running",
        "shards.planned",
        "planning.finished",
        "shard.leased",
        "shard.committed",
        "job.finalizing",
        "job.succeeded",
    ]
    numbers = [int(number) for name, number, _ in seen if name != "progress" and number is not None]
    assert len(numbers) == len(names)
    assert numbers == sorted(set(numbers))
    progress = [data for name, _, data in seen if name == "progress"]
    assert progress[0]["progress"]["videos_total"] == 2
    assert all(number is None for name, number, _ in seen if name == "progress"), "a resume must not count these"


def test_it_resumes_behind_any_event(http: httpx.Client, store: SqlStore) -> None:
    job_id = submit(http)
    plan(store, job_id)
    finish(store, job_id)
    everything = list(stream(http, job_id))
    assert everything[-1][0] == "job.succeeded"
    for position, (_, number, _) in enumerate(everything):
        if position + 1 < len(everything):
            assert list(stream(http, job_id, **{"Last-Event-ID": str(number)})) == everything[position + 1 :]
    last = {"Last-Event-ID": str(everything[-1][1])}
    over = http.get(f"/v1/jobs/{job_id}/events", headers={**STREAM, **last})
    assert (over.status_code, over.content) == (204, b""), (
        "an EventSource comes back for ever, unless the answer is 204"
    )
    for bad in ("x", "-1", "1" * 30):
        answer = http.get(f"/v1/jobs/{job_id}/events", headers={**STREAM, "Last-Event-ID": bad})
        assert_problem(answer, 422, "invalid_request")


def test_an_event_of_a_newer_release_passes_through(http: httpx.Client, store: SqlStore, service: Service) -> None:
    job_id = submit(http)
    plan(store, job_id)
    engine = create_engine(service.database_url)
    with engine.begin() as connection:  # as an agent of the next release would write it
        named = update(events).where(events.c.job_id == job_id, events.c.kind == "shards.planned")
        assert connection.execute(named.values(kind="shards.counted")).rowcount == 1
    engine.dispose()
    finish(store, job_id)
    names = [name for name, _, _ in stream(http, job_id)]
    assert "shards.counted" in names
    assert names[-1] == "job.succeeded"
    with Client(str(http.base_url)) as client:
        assert [event["kind"] for event in client.events(job_id)] == names


def test_as_pages(http: httpx.Client, store: SqlStore) -> None:
    job_id = submit(http)
    plan(store, job_id)
    finish(store, job_id)
    seen: list[dict[str, Any]] = []
    params: dict[str, Any] = {"limit": 3}
    while True:
        answer = http.get(f"/v1/jobs/{job_id}/events", params=params, headers={"Accept": "application/json"})
        assert answer.headers["content-type"] == "application/json"
        seen += answer.json()["items"]
        params["page_token"] = answer.json()["next_page_token"]
        if params["page_token"] is None:
            break
    assert seen == [data for _, _, data in stream(http, job_id)]
    assert seen[2]["data"] == {"shards": 2, "videos": 4}


def test_many_streams_do_not_hold_up_requests(http: httpx.Client, store: SqlStore) -> None:
    """More followers than the thread pool has threads: they wait in the event loop, so others get their answers."""
    job_id = submit(http)
    limits = httpx.Limits(max_connections=100)
    with httpx.Client(base_url=http.base_url, timeout=60, limits=limits) as many:
        opened = [
            many.send(many.build_request("GET", f"/v1/jobs/{job_id}/events", headers=STREAM), stream=True)
            for _ in range(60)
        ]
        assert {r.status_code for r in opened} == {200}
        assert http.get(f"/v1/jobs/{job_id}").json()["state"] == "queued"
        http.post(f"/v1/jobs/{job_id}/cancel")
        for response in opened:
            *_, last = parse_events(response.iter_lines())
            assert last.name == "job.cancelled"
            response.close()


def test_shutting_down_ends_streams(tmp_path: Path) -> None:
    with running(f"sqlite:///{tmp_path}/store.db") as service, httpx.Client(base_url=service.url, timeout=60) as http:
        job_id = http.post("/v1/jobs", json=body()).json()["id"]
        first_event = threading.Event()
        names: list[str] = []

        def follow() -> None:
            for name, _, _ in stream(http, job_id):
                names.append(name)
                first_event.set()

        follower = threading.Thread(target=follow)
        follower.start()
        assert first_event.wait(30)
        service.process.send_signal(signal.SIGTERM)
        assert service.process.wait(timeout=60) in (0, -signal.SIGTERM), "uvicorn raises the signal again at its end"
        follower.join(timeout=30)
        assert not follower.is_alive(), "the stream was closed in order, not cut"
        assert names == ["job.queued"]
