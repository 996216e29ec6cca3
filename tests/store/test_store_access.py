"""API keys, the audit trail and repeated requests, on every database."""

from __future__ import annotations

import threading
import time
from datetime import timedelta

import pytest
from sqlalchemy import inspect, text, update
from store_helpers import spec

from services.domain.access import ALL_SCOPES, AuditEntry, Scope
from services.domain.errors import IdempotencyConflict, IdempotencyInFlight, InvalidPageToken, KeyNotFound
from services.domain.keys import hash_key, key_id_of, matches, new_key
from services.domain.states import JobState
from services.store import idempotency
from services.store.database import Database, Tx
from services.store.schema import idempotency_keys
from services.store.sql import SqlStore


def test_keys_and_their_hashes() -> None:
    (first_id, first), (other_id, other) = new_key(), new_key()
    assert key_id_of(first) == first_id != other_id
    kept = hash_key(first)
    assert first.rsplit("_", 1)[1] not in kept
    assert kept != hash_key(first), "salted"
    assert matches(first, kept)
    assert not matches(other, kept)
    for text_ in ("", "vipe", "vipe__", first[:-1], first + "a", first.upper(), f" {first}"):
        assert key_id_of(text_) is None


def test_the_life_of_a_key(store: SqlStore) -> None:
    made, key = store.create_key("laptop", tenant="a", scopes=frozenset({Scope.JOBS_READ}))
    assert (made.tenant, made.name, made.scopes) == ("a", "laptop", {Scope.JOBS_READ})
    assert store.find_key("nope") is None
    found = store.find_key(made.id)
    assert found is not None
    assert (found[0], matches(key, found[1]), found[2]) == (made, True, True)
    store.touch_key(made.id)
    used = store.list_keys()[0][0].last_used_at
    assert used is not None
    store.touch_key(made.id)
    assert store.list_keys()[0][0].last_used_at == used, "to the minute"
    with pytest.raises(KeyNotFound):
        store.revoke_key(made.id, tenant="b")
    revoked = store.revoke_key(made.id, tenant="a")
    assert revoked.revoked_at is not None
    assert store.revoke_key(made.id) == revoked
    found = store.find_key(made.id)
    assert found is not None
    assert not found[2]


def test_a_key_expires_by_the_databases_clock(store: SqlStore) -> None:
    made, _ = store.create_key("short", expires_in_s=0.2)
    assert made.expires_at is not None
    assert made.scopes == ALL_SCOPES
    while (found := store.find_key(made.id)) is not None and found[2]:
        time.sleep(0.05)
    assert found is not None


def test_keys_are_listed_by_tenant_in_pages(store: SqlStore) -> None:
    mine = sorted(store.create_key("x", tenant="a")[0].id for _ in range(3))
    store.create_key("x", tenant="b")
    page, cursor = store.list_keys(tenant="a", limit=2)
    rest, end = store.list_keys(tenant="a", limit=2, after=cursor)
    assert [key.id for key in page + rest] == mine
    assert end is None
    assert len(store.list_keys()[0]) == 4


def test_the_key_itself_is_nowhere_in_the_database(store: SqlStore, store_url: str) -> None:
    _, key = store.create_key("x")
    database = Database(store_url)
    with database.engine.connect() as conn:
        for table in inspect(conn).get_table_names():
            for row in conn.execute(text(f"SELECT * FROM {table}")):
                assert key not in str(row)
                assert key.rsplit("_", 1)[1] not in str(row)
    database.close()


def test_the_audit_trail(store: SqlStore) -> None:
    done = AuditEntry("a", "id", "10.0.0.1", "req", "POST /v1/jobs", "/v1/jobs/job_1", 202)
    refused = AuditEntry(None, None, "10.0.0.2", "req", "authenticate", "/v1/jobs", 401, "unauthorized", 7)
    store.record_audit([done])
    store.record_audit([refused, done])
    events, cursor = store.audit("a", limit=1)
    assert [event.entry for event in events] == [done]
    older, end = store.audit("a", limit=1, after=cursor)
    assert (older[0].seq < events[0].seq, end) == (True, None)
    assert store.audit("b") == ([], None)
    assert [event.entry for event in store.audit("default")[0]] == [refused], "what belongs to nobody"
    with pytest.raises(InvalidPageToken):
        store.audit("a", after="x")


class TestRepeatedRequests:
    def test_the_first_answer_is_given_again(self, store: SqlStore) -> None:
        first, created = store.create_job(spec(name="näme"), idempotency_key="k", request_hash="r")
        store.request_cancel(first.id)
        again, created_again = store.create_job(spec("/other"), idempotency_key="k", request_hash="r")
        assert (created, created_again) == (True, False)
        assert again == first
        assert store.get_job(first.id).state is JobState.CANCELLED
        with pytest.raises(IdempotencyConflict):
            store.create_job(spec(), idempotency_key="k", request_hash="other")

    def test_what_was_refused_uses_no_key(self, store: SqlStore) -> None:
        store.create_job(spec("/taken"))
        with pytest.raises(Exception, match="belongs to"):
            store.create_job(spec("/taken"), idempotency_key="k", request_hash="r")
        assert store.create_job(spec("/free"), idempotency_key="k", request_hash="other")[1]

    def test_after_a_week_a_key_is_new(self, store: SqlStore, store_url: str) -> None:
        first, _ = store.create_job(spec("/one"), idempotency_key="k", request_hash="r")
        database = Database(store_url)

        def age(tx: Tx) -> None:
            tx.run(update(idempotency_keys).values(created_at=tx.now - idempotency.KEPT - timedelta(seconds=1)))

        database.write(age)
        second, created = store.create_job(spec("/two"), idempotency_key="other", request_hash="r")
        assert created
        assert database.read(lambda tx: [row.key for row in tx.rows(idempotency_keys.select())]) == ["other"], "tidied"
        third, created = store.create_job(spec("/three"), idempotency_key="k", request_hash="r")
        assert created
        assert len({first.id, second.id, third.id}) == 3
        database.close()

    def test_one_that_is_being_worked_on_elsewhere(self, store: SqlStore, store_url: str) -> None:
        database = Database(store_url)
        if database.dialect == "sqlite":
            database.close()
            pytest.skip("one transaction writes at a time: the second waits and gets the first one's answer")
        held, done = threading.Event(), threading.Event()

        def work(tx: Tx) -> None:
            idempotency.hold(tx, "default", "k")
            held.set()
            assert done.wait(60)

        other = threading.Thread(target=database.write, args=(work,))
        other.start()
        assert held.wait(60)
        with pytest.raises(IdempotencyInFlight):
            store.create_job(spec(), idempotency_key="k")
        store.create_job(spec("/elsewhere"), tenant="other", idempotency_key="k")
        done.set()
        other.join()
        assert store.create_job(spec(), idempotency_key="k")[1]
        database.close()
