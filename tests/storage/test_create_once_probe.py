"""Whether a bucket can decide a commit: a real S3 process behind a proxy that takes the condition away."""

from __future__ import annotations

import uuid
from collections.abc import Iterator

import boto3
import pytest

from benchmarks.chaos.s3_proxy import S3Proxy
from services.domain.errors import ConditionUnsupported, StorageError
from services.storage import S3Store, supports_create_once


@pytest.fixture
def proxy(s3_endpoint: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[S3Proxy]:
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "test")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    started = S3Proxy(s3_endpoint).start()
    yield started
    started.stop()


@pytest.fixture
def store(proxy: S3Proxy) -> S3Store:
    bucket = f"p-{uuid.uuid4().hex[:12]}"
    boto3.client("s3", endpoint_url=proxy.url).create_bucket(Bucket=bucket)
    return S3Store(bucket, endpoint_url=proxy.url, max_attempts=2)


@pytest.mark.parametrize("mode", ["strip", "not-implemented", "bad-request", "races"])
def test_a_bucket_that_cannot_decide_is_found_out(proxy: S3Proxy, store: S3Store, mode: str) -> None:
    proxy.modes[mode] = 1.0
    assert not supports_create_once(store)
    assert proxy.befallen > 0
    assert list(store.list()) == []


def test_a_bucket_that_can_decide_passes(store: S3Store) -> None:
    assert supports_create_once(store)
    assert list(store.list()) == []


@pytest.mark.parametrize("mode", ["not-implemented", "bad-request"])
def test_a_refused_condition_is_typed(proxy: S3Proxy, store: S3Store, mode: str) -> None:
    proxy.modes[mode] = 1.0
    with pytest.raises(ConditionUnsupported, match="If-None-Match"):
        store.create("k", b"x")


@pytest.mark.parametrize("mode", ["down", "refused"])
def test_a_bucket_that_does_not_answer_is_no_answer(proxy: S3Proxy, store: S3Store, mode: str) -> None:
    proxy.modes[mode] = 1.0
    with pytest.raises(StorageError) as caught:
        supports_create_once(store)
    assert caught.value.retryable
