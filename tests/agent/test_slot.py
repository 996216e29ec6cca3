"""The inside of a worker: fetching, answers, scratch, and what is taken over from an attempt that died."""

from __future__ import annotations

import os
import threading
import time
from dataclasses import replace
from pathlib import Path

import boto3
import pytest
from agent_rig import Rig

from services.agent.messages import (
    Annotated,
    AnnotateVideo,
    Cancelled,
    DiscardShard,
    Failed,
    Opened,
    OpenShard,
    Packed,
    PackShard,
    Reply,
)
from services.agent.scratch import ShardScratch, sweep
from services.agent.slot import Slot, SlotConfig
from services.domain.models import Lease, VideoRef, video_key
from services.inputs.rules import InputRules


def _config(root: Path, endpoint: str | None = None, engine: str = "agent_engines:open_in_memory") -> SlotConfig:
    return SlotConfig(root / "scratch", "cpu", engine, endpoint, 1e9)


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return Rig.make(tmp_path)


@pytest.fixture
def bucket(s3_endpoint: str, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> str:
    for name, value in (("ACCESS_KEY_ID", "t"), ("SECRET_ACCESS_KEY", "t"), ("DEFAULT_REGION", "us-east-1")):
        monkeypatch.setenv(f"AWS_{name}", value)
    name = f"agent-{abs(hash(request.node.name)) % 10**8}"
    boto3.client("s3", endpoint_url=s3_endpoint).create_bucket(Bucket=name)
    return name


def _run(slot: Slot, lease: Lease) -> list[Reply]:
    """Open, annotate everything, pack."""
    replies = [slot.run(OpenShard(lease))]
    replies += [slot.run(AnnotateVideo(lease, video)) for video in lease.videos]
    results = tuple(reply.answer.result for reply in replies[1:] if isinstance(reply.answer, Annotated))
    return [*replies, slot.run(PackShard(lease, results))]


def test_an_input_that_became_a_link_out_of_its_roots_is_not_read(rig: Rig, tmp_path: Path) -> None:
    rig.job({"a": "frames=3"})
    lease = rig.lease().lease
    secret = tmp_path / "secret.mp4"
    secret.write_text("frames=3")
    path = Path(lease.videos[0].uri)
    slot = Slot(replace(_config(tmp_path), inputs=InputRules(roots=(path.parent,))))
    assert isinstance(slot.run(OpenShard(lease)).answer, Opened)
    path.unlink()
    path.symlink_to(secret)
    answer = slot.run(AnnotateVideo(lease, lease.videos[0])).answer
    assert isinstance(answer, Failed)
    assert (answer.code, answer.retryable, answer.scope) == ("input_unavailable", False, "video")


def test_s3_to_s3_and_the_traffic_is_reported(rig: Rig, bucket: str, s3_endpoint: str) -> None:
    client = boto3.client("s3", endpoint_url=s3_endpoint)
    client.put_object(Bucket=bucket, Key="in/a clip.mp4", Body=b"frames=3")
    rig.job({"local": "frames=2"})
    local = rig.lease().lease
    uri = f"s3://{bucket}/in/a clip.mp4"
    video = VideoRef(video_key(uri), uri, 8)
    lease = replace(local, videos=(video,), spec=replace(local.spec, output=f"s3://{bucket}/out"))
    _, annotated, packed = _run(Slot(_config(rig.root, s3_endpoint)), lease)

    assert isinstance(annotated.answer, Annotated)
    result = annotated.answer.result
    assert (result.uri, result.num_frames, result.attempt) == (uri, 3, lease.attempt)
    assert result.timings_s is not None
    assert result.timings_s["fetch"] > 0
    assert annotated.traffic.transferred_bytes == {"get": 8}
    assert not any((rig.config.scratch_dir / f"{lease.shard_id}.{lease.fence:08d}" / "input").iterdir())

    assert isinstance(packed.answer, Packed)
    stored = {o["Key"] for o in client.list_objects_v2(Bucket=bucket, Prefix="out/payload/")["Contents"]}
    assert stored == {f"out/{o.key}" for o in packed.answer.payload.record.objects}
    assert packed.traffic.transferred_bytes["put"] == packed.answer.payload.size_bytes


def test_an_object_that_vanished_is_that_videos_failure(rig: Rig, bucket: str, s3_endpoint: str) -> None:
    rig.job({"a": ""})
    lease = rig.lease().lease
    video = VideoRef("gone-00000000", f"s3://{bucket}/gone.mp4", 1)
    answer = Slot(_config(rig.root, s3_endpoint)).run(AnnotateVideo(lease, video)).answer
    assert isinstance(answer, Failed)
    assert (answer.code, answer.scope, answer.retryable) == ("input_unavailable", "video", False)


def test_storage_that_does_not_answer_is_nobodys_failure(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "t")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "t")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    rig.job({"a": ""})
    lease = rig.lease().lease
    video = VideoRef("a-00000000", "s3://no-such-bucket/a.mp4", 1)
    answer = Slot(_config(rig.root, "http://127.0.0.1:1")).run(AnnotateVideo(lease, video)).answer
    assert isinstance(answer, Failed)
    assert (answer.scope, answer.retryable) == ("storage", True)


def test_messages_name_the_users_address_and_not_our_copy(rig: Rig) -> None:
    rig.job({"bad": "error"})
    lease = rig.lease().lease
    slot = Slot(_config(rig.root))
    slot.run(OpenShard(lease))
    answer = slot.run(AnnotateVideo(lease, lease.videos[0])).answer
    assert isinstance(answer, Failed)
    assert answer.message == f"{lease.videos[0].uri}: not a video"


@pytest.mark.parametrize("engine", ["no_such_module:f", "agent_engines:no_such_name", "nonsense"])
def test_an_engine_that_cannot_be_opened_concerns_the_whole_job(rig: Rig, engine: str) -> None:
    rig.job({"a": ""})
    lease = rig.lease().lease
    answer = Slot(_config(rig.root, engine=engine)).run(AnnotateVideo(lease, lease.videos[0])).answer
    assert isinstance(answer, Failed)
    assert (answer.scope, answer.code) == ("job", "invalid_config")


def test_a_running_task_can_be_seen_and_interrupted(rig: Rig) -> None:
    rig.job({"slow": "slow=60 frames=100"})
    lease = rig.lease().lease
    slot = Slot(_config(rig.root))
    slot.run(OpenShard(lease))
    replies: list[Reply] = []
    thread = threading.Thread(target=lambda: replies.append(slot.run(AnnotateVideo(lease, lease.videos[0]))))
    thread.start()
    deadline = time.monotonic() + 30
    while slot.progress().frames_expected is None and time.monotonic() < deadline:
        time.sleep(0.01)
    assert slot.progress().video_key == lease.videos[0].key
    slot.cancel()
    thread.join(30)
    assert [reply.answer for reply in replies] == [Cancelled()]
    assert slot.progress().video_key is None


def _again(rig: Rig, lease: Lease) -> Lease:
    rig.store.release(lease.shard_id, lease.fence, "test")
    return rig.lease().lease


def test_finished_videos_are_taken_over_by_the_next_attempt(rig: Rig) -> None:
    rig.job({"a": "frames=3", "b": "error"})
    lease = rig.lease().lease
    slot = Slot(_config(rig.root))
    slot.run(OpenShard(lease))
    first = slot.run(AnnotateVideo(lease, lease.videos[0])).answer
    slot.run(AnnotateVideo(lease, lease.videos[1]))
    assert isinstance(first, Annotated)

    again = _again(rig, lease)
    opened = Slot(_config(rig.root)).run(OpenShard(again)).answer
    assert opened == Opened((first.result,))  # The failed one is tried again.
    assert [folder.name for folder in rig.config.scratch_dir.iterdir()] == [f"{again.shard_id}.{again.fence:08d}"]
    packed = slot.run(PackShard(replace(again, videos=again.videos[:1]), (first.result,))).answer
    assert isinstance(packed, Packed)


@pytest.mark.parametrize("damage", ["artifact", "record", "plan", "version"])
def test_what_is_incomplete_or_made_from_something_else_is_done_again(
    rig: Rig, damage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.job({"a": "frames=3"})
    lease = rig.lease().lease
    slot = Slot(_config(rig.root))
    slot.run(OpenShard(lease))
    slot.run(AnnotateVideo(lease, lease.videos[0]))
    scratch, key = ShardScratch(rig.config.scratch_dir, lease), lease.videos[0].key
    again = _again(rig, lease)
    match damage:
        case "artifact":
            (scratch.artifacts / "depth" / f"{key}.zip").unlink()
        case "record":
            (scratch.path / "results" / f"{key}.json").write_text('{"result"')
        case "plan":
            again = replace(again, plan_hash="0" * 64)
        case "version":
            monkeypatch.setattr("services.agent.scratch.package_version", lambda: "another")
    assert slot.run(OpenShard(again)).answer == Opened(())


def test_discarding_removes_all_attempts_of_this_shard_and_nothing_else(rig: Rig) -> None:
    rig.job({"a": "frames=3"})
    lease = rig.lease().lease
    slot = Slot(_config(rig.root))
    slot.run(OpenShard(lease))
    newer = replace(lease, fence=lease.fence + 1)
    other = replace(lease, shard_id="job_other-000000")
    for kept in (other, newer):
        ShardScratch(rig.config.scratch_dir, kept).path.mkdir(parents=True)
    slot.run(DiscardShard(lease))
    names = {folder.name for folder in rig.config.scratch_dir.iterdir()}
    assert names == {ShardScratch(rig.config.scratch_dir, kept).path.name for kept in (other, newer)}


def test_the_sweep_removes_what_nobody_came_back_for(rig: Rig) -> None:
    rig.job({"a": "frames=3"})
    lease = rig.lease().lease
    old, fresh = (
        ShardScratch(rig.config.scratch_dir, replace(lease, shard_id=name)) for name in ("job_old-0", "job_new-0")
    )
    for scratch in (old, fresh):
        scratch.open()
    long_ago = time.time() - 1000
    for folder in (old.path, *old.path.iterdir()):
        os.utime(folder, (long_ago, long_ago))
    sweep(rig.config.scratch_dir, 500)
    assert not old.path.exists()
    assert fresh.path.exists()
