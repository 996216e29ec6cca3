"""A finished job in a directory and in S3."""

from __future__ import annotations

import json
import shutil
import uuid
from collections.abc import Callable
from pathlib import Path

import boto3
import pytest
from shard_factory import ATTRIBUTES, JOB, commit_shard, failure, make_lease, success, write_artifacts

from services.commit import publish_plan
from services.dataset import finalise
from services.domain.models import JobSpec, PlannedShard
from services.storage import DirectoryStore, ObjectStore, S3Store

FRAMES = {"cat-1": 3, "ant-2": 2, "dog-3": 4}
SHARDS = [["cat-1", "bad-1", "ant-2"], ["bad-2", "poison-3"], ["dog-3"]]
SPEC = JobSpec(inputs=("/in",), output="/out", attributes=ATTRIBUTES, name='Three "animals"')


@pytest.fixture(scope="session")
def engine_output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("engine")
    for key, count in FRAMES.items():
        write_artifacts(root, key, count, info=True)
    return root


def commit_all(store: ObjectStore, engine_output: Path, tmp_path: Path) -> None:
    """Three shards: one mixed, one without any success, one with a single video."""
    begin(store)
    artifacts = shutil.copytree(engine_output, tmp_path / "artifacts")
    for ordinal, keys in enumerate(SHARDS):
        results = [
            success(k, FRAMES[k]) if k in FRAMES else failure(k, quarantined=k.startswith("poison")) for k in keys
        ]
        commit_shard(make_lease(keys, ordinal=ordinal), results, artifacts, tmp_path / "s", store, lambda: True)


def begin(store: ObjectStore) -> None:
    """What the planner leaves in an output."""
    leases = [make_lease(keys, ordinal=ordinal) for ordinal, keys in enumerate(SHARDS)]
    planned = [PlannedShard(x.ordinal, x.plan_hash, tuple(v.key for v in x.videos)) for x in leases]
    store.create("_job.json", json.dumps({"schema_version": 1, "job_id": JOB}).encode())
    publish_plan(store, JOB, SPEC.config_hash, lambda first: planned[first:], len(planned))


@pytest.fixture
def committed(engine_output: Path, tmp_path: Path) -> DirectoryStore:
    store = DirectoryStore(tmp_path / "out")
    commit_all(store, engine_output, tmp_path)
    return store


@pytest.fixture
def finished(committed: DirectoryStore) -> DirectoryStore:
    finalise(committed, JOB, SPEC, num_shards=3, num_videos=6)
    return committed


@pytest.fixture(params=["directory", "s3"])
def any_finished(
    request: pytest.FixtureRequest, engine_output: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> ObjectStore:
    store: ObjectStore
    if request.param == "directory":
        store = DirectoryStore(tmp_path / "out")
    else:
        for name, value in {
            "AWS_ACCESS_KEY_ID": "t",
            "AWS_SECRET_ACCESS_KEY": "t",
            "AWS_DEFAULT_REGION": "us-east-1",
        }.items():
            monkeypatch.setenv(name, value)
        endpoint = request.getfixturevalue("s3_endpoint")
        bucket = f"d-{uuid.uuid4().hex[:12]}"
        boto3.client("s3", endpoint_url=endpoint).create_bucket(Bucket=bucket)
        store = S3Store(bucket, "data/set", endpoint_url=endpoint)
    commit_all(store, engine_output, tmp_path)
    finalise(store, JOB, SPEC, num_shards=3, num_videos=6)
    return store


@pytest.fixture
def rewrite(finished: DirectoryStore) -> Callable[[str, Callable[[bytes], bytes]], None]:
    """Damage an object in place."""

    def change(key: str, how: Callable[[bytes], bytes]) -> None:
        finished.put_bytes(key, how(finished.get_bytes(key)))

    return change
