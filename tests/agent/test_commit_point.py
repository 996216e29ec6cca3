"""Jobs whose output cannot decide between two writers, and what is known of deaths."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import boto3
import pyarrow.parquet as pq
import pytest
from agent_rig import Rig

from benchmarks.chaos.s3_proxy import S3Proxy
from services.agent.jobs import JobKeeper
from services.commit import committed_record, prepare_payload, publish_plan, read_plan, tar_names, write_decided
from services.dataset import verify
from services.domain.models import Death, JobProgress, JobSpec, PlannedShard
from services.domain.states import JobState, VideoStatus
from services.planner import plan_next
from services.storage import open_store
from services.store.sql import SqlStore


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig.make(tmp_path)
    yield made
    made.store.close()


@pytest.fixture
def proxy(s3_endpoint: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[S3Proxy]:
    started = S3Proxy(s3_endpoint).start()
    for name, value in {
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
        "VIPE_S3_ENDPOINT_URL": started.url,
    }.items():
        monkeypatch.setenv(name, value)
    yield started
    started.stop()


@pytest.mark.parametrize("mode", ["strip", "not-implemented"])
def test_a_job_on_a_bucket_without_conditions(
    rig: Rig, proxy: S3Proxy, mode: str, caplog: pytest.LogCaptureFixture
) -> None:
    bucket = f"c-{uuid.uuid4().hex[:12]}"
    boto3.client("s3", endpoint_url=proxy.url).create_bucket(Bucket=bucket)
    proxy.modes[mode] = 1.0
    inputs = rig.root / "inputs"
    inputs.mkdir()
    for name in "abc":
        (inputs / f"{name}.mp4").write_text("frames=3")
    job, _ = rig.store.create_job(JobSpec((str(inputs),), f"s3://{bucket}/out", attributes=("pose", "intrinsics")))
    assert plan_next(rig.store, "planner")
    assert "the database decides the commits" in caplog.text
    probed = [e.data for e in rig.store.events(job.id) if e.kind == "output.probed"]
    assert probed == [{"create_once": False, "commit_point": "database"}]

    output = open_store(job.spec.output)
    for _ in range(3):
        live = rig.lease()
        assert rig.supervisor.work(live).kind == "committed"
        assert committed_record(output, job.id, live.lease.shard_id) is not None
    JobKeeper(rig.store, rig.committer, rig.config, rig.metrics).step()
    assert rig.store.get_job(job.id).state is JobState.SUCCEEDED
    report = verify(output, deep=True)
    assert report.problems == []
    assert report.totals.succeeded == 3


def test_what_was_decided_survives_whoever_decided_it(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """The agent dies between the database's word and the record: the next one puts the record there."""
    job_id = rig.job({"a": "frames=2", "b": "frames=3"}, create_once=False)
    first = rig.lease()
    assert not first.lease.create_once

    output = rig.committer.output(first.lease.spec.output)
    with monkeypatch.context() as patch:
        patch.setattr(type(output), "put_bytes", _dies_on_records(type(output).put_bytes))
        with pytest.raises(KeyboardInterrupt):
            rig.supervisor.work(first)
    (decided,) = rig.store.decided_commits(job_id)
    assert rig.record(first) is None
    rig.store.release(first.lease.shard_id, first.lease.fence, "dead")

    second = rig.lease()
    done = len(rig.slot.tasks)
    assert rig.supervisor.work(second).reason == "found in the output"
    assert len(rig.slot.tasks) == done + 1, "only the scratch is removed"
    record = rig.record(second)
    assert record is not None
    assert record.to_bytes() == decided
    assert rig.store.decided_commits(job_id) == []


def test_a_zombie_learns_what_counts_and_clears_up(rig: Rig) -> None:
    rig.job({"a": "frames=2"}, create_once=False)
    zombie = rig.lease()
    rig.supervisor._committer = _Late(rig.committer)
    outcome = rig.supervisor.work(zombie)
    assert (outcome.kind, outcome.reason) == ("committed", "adopted")
    record = rig.record(zombie)
    assert record is not None
    assert record.attempt == 2
    payload = {o.key for o in open_store(str(rig.root / "out")).list("payload/")}
    assert payload == {o.key for o in record.objects}


class _Late:
    """A committer whose agent slept through its lease just before the commit: somebody else was there."""

    def __init__(self, committer: object) -> None:
        self._committer = committer

    def __getattr__(self, name: str) -> object:
        return getattr(self._committer, name)

    def write(self, lease, payload):
        store, output = self._committer._store, self._committer.output(lease.spec.output)
        store.release(lease.shard_id, lease.fence, "expired")
        (taken,) = store.claim("other", limit=1, ttl_s=60)
        name = store.take_tar_name(taken.shard_id, taken.fence, tar_names(taken))
        scratch = next(Path(str(output.uri)).parent.glob("scratch/job_*"))
        results = [replace(v, attempt=2) for v in payload.record.videos]
        theirs = prepare_payload(taken, results, scratch / "artifacts", scratch / "other", output, tar_name=name)
        assert write_decided(output, theirs, store.decide_commit).kind == "committed"
        return self._committer.write(lease, payload)


def _dies_on_records(put_bytes):
    def put(self, key, data):
        if key.startswith("_commits/"):
            raise KeyboardInterrupt
        return put_bytes(self, key, data)

    return put


def test_a_shard_that_joins_a_complete_plan_is_expected_before_its_record(rig: Rig) -> None:
    """As a retry adds it. Until the index is made anew the job counts as running, and nothing as forged."""
    job_id = rig.job({"a": "frames=2"})
    live = rig.lease()
    output = open_store(str(rig.root / "out"))
    output.create("_job.json", f'{{"job_id": "{job_id}"}}'.encode())
    ghost = PlannedShard(0, "0" * 64, ("gone",))
    publish_plan(output, job_id, live.lease.spec.config_hash, lambda first: [ghost][first:], 1)
    joined = replace(live.lease, ordinal=1)
    rig.committer._store.planned_shards = lambda job, first_ordinal, limit: [PlannedShard(1, joined.plan_hash, ("a",))][
        first_ordinal - 1 :
    ]
    rig.committer._store.get_job = lambda job: replace(
        SqlStore.get_job(rig.store, job), progress=JobProgress(shards_total=2)
    )
    rig.committer._extend_plan(output, joined)
    head = read_plan(output, job_id, lambda shard: None)
    assert (head.pages, head.shards, head.complete) == (2, 2, True)


def test_two_deaths_in_two_places_are_the_videos_fault(rig: Rig) -> None:
    rig.job({"poison": "die", "b": "frames=3"})
    first = rig.lease()
    key = first.lease.videos[0].key
    rig.store.blame(first.lease.shard_id, first.lease.fence, key, Death("SIGSEGV", "there/slot-0", "agent-0", 1))
    rig.store.release(first.lease.shard_id, first.lease.fence, "restart")
    live = rig.lease()
    assert rig.supervisor.work(live).kind == "committed"
    row = rig.rows(live)["poison"]
    assert row.status is VideoStatus.QUARANTINED
    assert row.deaths is not None
    assert [(d.reason, d.place, d.attempt) for d in row.deaths] == [
        ("SIGSEGV", "there/slot-0", 1),
        ("segmentation fault", "here/slot-0", 2),
    ]
    assert all(death.at and death.holder for death in row.deaths)
    assert "segmentation fault" in str(row.error_message)

    JobKeeper(rig.store, rig.committer, rig.config, rig.metrics).step()
    (failure,) = pq.read_table(rig.root / "out" / "failures.parquet").to_pylist()
    assert "there/slot-0" in failure["deaths_json"]


@pytest.mark.parametrize(
    ("settings", "starts"), [({"recycle_videos": 2}, 2), ({"recycle_age_s": 1.0}, 1), ({"recycle_growth_bytes": 1}, 3)]
)
def test_a_worker_that_has_done_enough_is_replaced(tmp_path: Path, settings: dict, starts: int) -> None:
    """After two videos; never by a clock that stands still; and one that leaks, after the second video each time."""
    rig = Rig.make(tmp_path, **settings)
    leak = "leak=16" if "recycle_growth_bytes" in settings else ""
    rig.job(dict.fromkeys(("a", "b", "c", "d"), f"frames=2 {leak}"))
    live = rig.lease()
    assert rig.supervisor.work(live).kind == "committed"
    assert [row.status for row in rig.rows(live).values()] == [VideoStatus.SUCCEEDED] * 4
    assert rig.metric("vipe_actor_restarts_total", reason="recycled") == rig.slot.starts - 1
    assert rig.slot.starts == starts if not leak else rig.slot.starts >= 2
    assert sorted(rig.slot.annotated()) == ["a", "b", "c", "d"], "and nothing is done twice"
    rig.store.close()
