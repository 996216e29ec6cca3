"""Deliveries to webhooks: written with their event, sent at least once, by one sender at a time; on every database."""

from __future__ import annotations

import json

import pytest
from store_helpers import planned_job, spec

from services.domain.control import JobControl
from services.domain.errors import JobNotCancellable
from services.store.sql import SqlStore

HOOK = JobControl(webhook_url="https://example.org/hook", webhook_secret="ours")


def told(store: SqlStore, *, ttl_s: float = 60) -> list[str]:
    taken = store.take_deliveries(limit=100, ttl_s=ttl_s)
    for delivery in taken:
        store.settle_delivery(delivery, error=None, retry_in_s=None)
    return [json.loads(d.body)["kind"] for d in taken]


def test_every_event_of_the_job_itself_is_told_once(store: SqlStore) -> None:
    job, _ = store.create_job(spec(), control=HOOK)
    planned_job(store, output="/without")
    assert store.begin_planning(job.id, "a", ttl_s=60) is not None
    store.request_pause(job.id)
    store.change_job(job.id, {"priority": 3})
    store.resume(job.id)
    store.fail_job(job.id, "storage_refused", "no")
    kinds = [e.kind for e in store.events(job.id)]
    assert kinds[0] == "job.queued"
    assert told(store) == kinds
    assert told(store) == []
    assert store.undelivered() == 0


def test_what_is_sent_is_the_event(store: SqlStore) -> None:
    job, _ = store.create_job(spec(name="näme"), tenant="t", control=HOOK)
    (event,) = store.events(job.id)
    (delivery,) = store.take_deliveries(limit=1, ttl_s=60)
    assert (delivery.url, delivery.secret, delivery.tenant, delivery.attempt) == (HOOK.webhook_url, "ours", "t", 1)
    assert delivery.event_id == f"evt_{event.seq}"
    assert json.loads(delivery.body) == {
        "id": delivery.event_id,
        "seq": event.seq,
        "job_id": job.id,
        "tenant": "t",
        "at": event.at.isoformat(),
        "kind": "job.queued",
        "data": {"name": "näme"},
    }


def test_a_transition_that_is_refused_tells_nobody(store: SqlStore) -> None:
    job, _ = store.create_job(spec(), control=HOOK)
    store.request_cancel(job.id)
    assert told(store) == ["job.queued", "job.cancelling", "job.cancelled"]
    with pytest.raises(JobNotCancellable):
        store.request_cancel(job.id)
    assert store.undelivered() == 0


def test_one_sender_has_it_until_its_time_is_over(store: SqlStore) -> None:
    store.create_job(spec(), control=HOOK)
    (first,) = store.take_deliveries(limit=9, ttl_s=600)
    assert store.take_deliveries(limit=9, ttl_s=600) == []
    store.settle_delivery(first, error="status 500", retry_in_s=0)
    (second,) = store.take_deliveries(limit=9, ttl_s=0)
    assert (second.attempt, second.body, second.event_id) == (2, first.body, first.event_id)
    (third,) = store.take_deliveries(limit=9, ttl_s=600)
    store.settle_delivery(second, error="late", retry_in_s=0)
    assert store.take_deliveries(limit=9, ttl_s=60) == [], "who came too late changes nothing"
    store.settle_delivery(third, error=None, retry_in_s=None)
    assert store.undelivered() == 0


def test_giving_up_is_an_event(store: SqlStore) -> None:
    job, _ = store.create_job(spec(), control=HOOK)
    (delivery,) = store.take_deliveries(limit=9, ttl_s=60)
    for _ in range(2):
        store.settle_delivery(delivery, error="status 404", retry_in_s=None)
    last = [e for e in store.events(job.id) if e.kind == "webhook.abandoned"]
    assert [e.data for e in last] == [{"event_id": delivery.event_id, "attempts": 1, "error": "status 404"}]
    assert store.undelivered() == 0


def test_a_webhook_that_was_taken_away_hears_nothing_more(store: SqlStore) -> None:
    job, _ = store.create_job(spec(), control=HOOK)
    store.change_job(job.id, {"webhook_url": None, "webhook_secret": None})
    assert told(store) == []
    assert store.undelivered() == 0
