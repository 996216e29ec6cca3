"""The Python client against a real service."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from api_helpers import body, finish, plan
from api_service import Service, running

from services.client import ApiError, Client
from services.domain.models import JobSpec
from services.store.sql import SqlStore


@pytest.fixture(scope="module")
def client(service: Service) -> Iterator[Client]:
    with Client(service.url) as opened:
        yield opened


def test_the_life_of_a_job(client: Client, store: SqlStore) -> None:
    assert client.ready()
    job = client.submit(body(name="x"))
    assert job["state"] == "queued"
    assert client.jobs(limit=1)[0]["id"] == job["id"]

    def agent() -> None:
        plan(store, job["id"], shards=3, videos_each=50)
        finish(store, job["id"], "s0v0")

    worker = threading.Thread(target=agent)
    worker.start()
    kinds = [event["kind"] for event in client.events(job["id"])]
    worker.join()
    assert kinds[0] == "job.queued"
    assert kinds[-1] == "job.succeeded_with_errors"
    states: list[str] = []
    done = client.wait(job["id"], lambda j: states.append(j["state"]))
    assert done["state"] == states[-1] == "succeeded_with_errors"
    assert len(list(client.videos(job["id"]))) == 150, "all pages"
    assert [v["key"] for v in client.videos(job["id"], status="failed")] == ["s0v0"]
    assert [s["ordinal"] for s in client.shards(job["id"])] == [0, 1, 2]


def test_events_end_also_for_a_reader_who_knows_them_all(client: Client, store: SqlStore) -> None:
    job = client.submit(body())
    client.cancel(job["id"])
    everything = list(client.events(job["id"]))
    assert list(client.events(job["id"], after_seq=everything[0]["seq"])) == everything[1:]
    assert list(client.events(job["id"], after_seq=everything[-1]["seq"])) == []


def test_a_spec_and_a_key(client: Client) -> None:
    spec = JobSpec(("/videos",), body()["output"])
    first = client.submit(spec, idempotency_key="client-1")
    assert client.submit(spec, idempotency_key="client-1")["id"] == first["id"]
    with pytest.raises(ApiError) as caught:
        client.submit(spec, idempotency_key="client-2")
    assert (caught.value.code, caught.value.status) == ("output_in_use", 409)
    assert client.cancel(first["id"])["state"] == "cancelled"
    assert client.cancel(first["id"])["state"] == "cancelled", "cancelling twice is no error"


def test_errors_name_the_field(client: Client) -> None:
    with pytest.raises(ApiError, match=r"body\.preset.*classical") as caught:
        client.submit(body(preset="magic"))
    assert caught.value.errors[0]["field"] == "body.preset"
    assert caught.value.request_id
    with pytest.raises(ApiError, match="job_x"):
        client.job("job_x")
    with pytest.raises(ApiError, match="job_x"):
        list(client.events("job_x"))


def test_nobody_there() -> None:
    with Client("http://127.0.0.1:9") as client:
        assert not client.ready()
        with pytest.raises(ApiError) as caught:
            client.job("x")
        assert caught.value.code == "unreachable"


def test_with_a_key(tmp_path: Path) -> None:
    with running(f"sqlite:///{tmp_path}/store.db", "api_key=secret") as service:
        with Client(service.url) as stranger, pytest.raises(ApiError) as caught:
            stranger.jobs()
        assert caught.value.code == "unauthorized"
        with Client(service.url, api_key="secret") as friend:
            assert friend.jobs() == []


def test_a_stream_goes_on_after_the_service_was_restarted(tmp_path: Path) -> None:
    """The service is stopped and started on the same port while somebody follows a job; no event is lost or doubled."""
    database = f"sqlite:///{tmp_path}/store.db"
    events: list[dict[str, Any]] = []
    first = threading.Event()
    store = SqlStore(database)
    job, _ = store.create_job(JobSpec(("/in",), "/out"))
    with running(database) as service:
        client = Client(service.url)

        def follow() -> None:
            for event in client.events(job.id):
                events.append(event)
                first.set()

        follower = threading.Thread(target=follow)
        follower.start()
        assert first.wait(30)
    port = service.url.rsplit(":", 1)[1]
    with running(database, f"port={port}"):
        plan(store, job.id)
        finish(store, job.id)
        follower.join(timeout=60)
        assert not follower.is_alive()
    client.close()
    history = [e.seq for e in store.events(job.id)]
    store.close()
    assert [e["seq"] for e in events if e["kind"] != "progress"] == history
