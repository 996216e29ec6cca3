"""Inputs become videos become shards, completely, once, and in the same order every time."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from pathlib import Path

import boto3
import pytest
from hypothesis import given
from hypothesis import strategies as st
from moto.server import ThreadedMotoServer

from services.domain.errors import InputUnavailable, StorageError
from services.domain.models import JobSpec, VideoRef, video_key
from services.domain.states import JobState
from services.inputs.rules import InputRules
from services.planner import Turn, plan_next
from services.planner.listing import Found, expand
from services.planner.packing import SeenVideos, new_videos, pack, shard_room
from services.planner.planning import CLAIM_KEY, claim_output
from services.storage import ObjectStore
from services.store.base import Store
from services.store.sql import SqlStore


def make(root: Path, *names: str, size: int = 4) -> None:
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x" * size)


def names(root: Path, found: Iterator[Found]) -> list[str]:
    return [str(Path(v.uri).relative_to(root)) for v in found]


@pytest.fixture
def videos(tmp_path: Path) -> Path:
    folder = tmp_path / "videos"
    folder.mkdir()
    return folder


@pytest.fixture
def store(tmp_path: Path) -> Iterator[SqlStore]:
    opened = SqlStore(f"sqlite:///{tmp_path}/store.db")
    yield opened
    opened.close()


def submit(store: Store, output: Path | str, *inputs: Path | str, **changes: int) -> str:
    return store.create_job(JobSpec(tuple(str(i) for i in inputs), str(output), **changes))[0].id


def planned(store: Store, job_id: str) -> list[tuple[int, list[str]]]:
    """(ordinal, addresses) of each shard."""
    rows, _ = store.list_videos(job_id, limit=10_000)
    shards, _ = store.list_shards(job_id, limit=10_000)
    return [(s.ordinal, sorted(r.ref.uri for r in rows if r.shard_id == s.id)) for s in shards]


class TestDirectories:
    def test_recursively_in_name_order(self, videos: Path) -> None:
        make(videos, "b.mp4", "a/z.MOV", "a/y.mkv", "c.txt", ".hidden.mp4", ".git/x.mp4", "a/b/c.webm", "noext")
        assert names(videos, expand(str(videos))) == ["a/b/c.webm", "a/y.mkv", "a/z.MOV", "b.mp4"]

    @pytest.mark.parametrize("name", ["v.mp4", "v.mov", "v.mkv", "v.webm", "v.avi", "v.m4v", "v.mpg", "v.ts", "v.gif"])
    def test_extensions(self, videos: Path, name: str) -> None:
        make(videos, name)
        assert names(videos, expand(str(videos))) == [name]

    def test_links_must_stay_inside(self, videos: Path, tmp_path: Path) -> None:
        make(tmp_path / "outside", "x.mp4")
        make(videos, "a.mp4")
        (videos / "in.mp4").symlink_to(videos / "a.mp4")
        (videos / "out.mp4").symlink_to(tmp_path / "outside" / "x.mp4")
        (videos / "loop").symlink_to(videos)
        (videos / "gone.mp4").symlink_to(videos / "nothing")
        assert names(videos, expand(str(videos))) == ["a.mp4", "in.mp4"]

    def test_only_links_that_leave(self, videos: Path, tmp_path: Path) -> None:
        make(tmp_path / "outside", "x.mp4")
        (videos / "out.mp4").symlink_to(tmp_path / "outside" / "x.mp4")
        with pytest.raises(InputUnavailable, match="1 links that leave it"):
            list(expand(str(videos)))

    def test_images_are_one_video(self, videos: Path) -> None:
        make(videos, "2.png", "1.jpg", "readme.txt", size=7)
        assert list(expand(f"{videos}/")) == [Found(str(videos), 14)]
        make(videos, "sub/clip.mp4")
        assert names(videos, expand(str(videos))) == ["sub/clip.mp4"], "where there are videos, images are not an input"

    def test_a_file_is_a_video_whatever_its_name(self, videos: Path) -> None:
        make(videos, "clip.bin")
        assert list(expand(f"{videos}/clip.bin")) == [Found(f"{videos}/clip.bin", 4)]

    def test_what_cannot_be_read(self, videos: Path) -> None:
        with pytest.raises(InputUnavailable, match=r"nowhere.*does not exist"):
            list(expand("/nowhere/at/all"))
        with pytest.raises(InputUnavailable, match=f"no videos found under {videos}"):
            list(expand(str(videos)))
        os.mkfifo(videos / "pipe.mp4")
        with pytest.raises(InputUnavailable, match="neither a file nor a directory"):
            list(expand(f"{videos}/pipe.mp4"))
        with pytest.raises(InputUnavailable, match="no videos"):
            list(expand(str(videos)))

    def test_a_name_that_is_no_text(self, videos: Path) -> None:
        (videos / os.fsdecode(b"bad\xff.mp4")).write_bytes(b"x")
        with pytest.raises(InputUnavailable, match="not valid UTF-8"):
            list(expand(str(videos)))

    def test_roots(self, videos: Path, tmp_path: Path) -> None:
        make(videos, "a.mp4")
        assert len(list(expand(str(videos), InputRules(roots=(tmp_path,))))) == 1
        other = tmp_path / "other"
        other.mkdir()
        (other / "way-out").symlink_to(videos)
        for uri in (videos, f"{videos}/a.mp4", f"{other}/../videos", other / "way-out"):
            with pytest.raises(InputUnavailable, match="outside"):
                list(expand(str(uri), InputRules(roots=(other,))))


class TestPacking:
    @given(
        sizes=st.lists(st.integers(0, 50), max_size=40),
        max_videos=st.integers(1, 7),
        max_bytes=st.integers(1, 60),
        first=st.integers(0, 60),
    )
    def test_every_video_once_in_order_within_the_limits(
        self, sizes: list[int], max_videos: int, max_bytes: int, first: int
    ) -> None:
        refs = [VideoRef(f"v{i}", f"/v{i}", size) for i, size in enumerate(sizes)]
        shards = list(pack(refs, max_videos=max_videos, max_input_bytes=max_bytes, first_ordinal=first))
        assert [v for s in shards for v in s.videos] == refs
        assert [s.ordinal for s in shards] == list(range(first, first + len(shards)))
        for shard, following in zip(shards, [*shards[1:], None], strict=False):
            total = sum(v.size_bytes for v in shard.videos)
            room = shard_room(shard.ordinal, max_videos)
            assert 1 <= len(shard.videos) <= room
            assert total <= max_bytes or len(shard.videos) == 1
            if following is not None:
                full = len(shard.videos) == room
                assert full or total + following.videos[0].size_bytes > max_bytes

    def test_small_jobs_spread_and_large_ones_reach_full_shards(self) -> None:
        refs = [VideoRef(f"v{i}", f"/v{i}", 1) for i in range(1000)]
        sizes = [len(s.videos) for s in pack(refs, max_videos=4, max_input_bytes=1 << 30)]
        assert sizes[:8] == [1] * 8
        assert sizes == sorted(sizes[:-1]) + sizes[-1:]
        assert set(sizes[24:-1]) == {4}

    def test_equal_addresses_are_one_video(self) -> None:
        with SeenVideos() as seen:
            refs = list(new_videos([Found("/a.mp4", 1), Found("/b/a.mp4", 1), Found("/a.mp4", 1)], seen))
        assert [r.uri for r in refs] == ["/a.mp4", "/b/a.mp4"]
        assert len({r.key for r in refs}) == 2

    def test_keys_that_collide_are_told_apart(self) -> None:
        """Two addresses with one stem whose sha256 begins with the same 8 digits."""
        first, second = _colliding_addresses()
        assert video_key(first) == video_key(second)
        with SeenVideos() as seen:
            refs = list(new_videos([Found(first, 1), Found(second, 1)], seen))
        assert refs[0].key == video_key(first)
        assert refs[1].key == video_key(second, hex_digits=16)


def _colliding_addresses() -> tuple[str, str]:
    seen: dict[bytes, str] = {}
    number = 0
    while True:
        uri = f"/{number}/clip.mp4"
        digest = hashlib.sha256(uri.encode()).digest()[:4]
        if digest in seen:
            return seen[digest], uri
        seen[digest] = uri
        number += 1


class TestJobs:
    def test_a_directory_becomes_shards(self, store: SqlStore, videos: Path, tmp_path: Path) -> None:
        make(videos, *(f"{i:02d}.mp4" for i in range(5)))
        job_id = submit(store, tmp_path / "out", videos, videos / "03.mp4", shard_max_videos=2)
        assert plan_next(store, "planner")
        assert not plan_next(store, "planner")
        uris = [f"{videos}/{i:02d}.mp4" for i in range(5)]
        assert planned(store, job_id) == [(number, [uri]) for number, uri in enumerate(uris)]
        job = store.get_job(job_id)
        assert job.planned
        claim = json.loads((tmp_path / "out" / CLAIM_KEY).read_text())
        assert claim == {"commit_point": "output", "job_id": job_id, "schema_version": 1}

    @pytest.mark.parametrize("batches", [0, 1, 2])
    def test_planning_that_was_cut_off_ends_the_same(
        self, store: SqlStore, videos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, batches: int
    ) -> None:
        monkeypatch.setattr("services.planner.planning._BATCH_SHARDS", 2)
        make(videos, *(f"{i:02d}.mp4" for i in range(14)))
        undisturbed = submit(store, tmp_path / "a", videos, shard_max_videos=2)
        assert plan_next(store, "planner")

        class Crash(BaseException):
            pass

        class DyingStore(SqlStore):
            left = batches

            def add_shards(self, job_id, fence, shards, *, ttl_s):
                if self.left == 0:
                    raise Crash
                self.left -= 1
                return super().add_shards(job_id, fence, shards, ttl_s=ttl_s)

        job_id = submit(store, tmp_path / "b", videos, shard_max_videos=2)
        dying = DyingStore(f"sqlite:///{tmp_path}/store.db")
        with pytest.raises(Crash):
            plan_next(dying, "dead planner", ttl_s=0)
        dying.close()
        assert len(planned(store, job_id)) == 2 * batches
        assert plan_next(store, "planner")
        assert planned(store, job_id) == planned(store, undisturbed)
        assert store.get_job(job_id).planned

    def test_two_agents_that_meet_in_one_job_lose_no_video(
        self, store: SqlStore, videos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The first sleeps through its time after its listing; the second has added half of the plan by then."""
        monkeypatch.setattr("services.planner.planning._BATCH_SHARDS", 2)
        make(videos, *(f"{i:02d}.mp4" for i in range(14)))
        job_id = submit(store, tmp_path / "out", videos, shard_max_videos=2)

        class Crash(BaseException):
            pass

        class SecondStore(SqlStore):
            left = 3

            def add_shards(self, job_id, fence, shards, *, ttl_s):
                if self.left == 0:
                    raise Crash
                self.left -= 1
                return super().add_shards(job_id, fence, shards, ttl_s=ttl_s)

        class SleepyStore(SqlStore):
            def add_shards(self, job_id, fence, shards, *, ttl_s):
                second = SecondStore(f"sqlite:///{tmp_path}/store.db")
                with pytest.raises(Crash):
                    plan_next(second, "second", ttl_s=60)
                second.close()
                (videos / "00a.mp4").write_bytes(b"xxxx")
                return super().add_shards(job_id, fence, shards, ttl_s=ttl_s)

        sleepy = SleepyStore(f"sqlite:///{tmp_path}/store.db")
        assert plan_next(sleepy, "sleepy", ttl_s=0)
        sleepy.close()
        assert not store.get_job(job_id).planned
        assert not plan_next(store, "third"), "the second one's time still runs"
        assert plan_next(store, "second")
        assert store.get_job(job_id).planned
        uris = sorted(uri for _, shard in planned(store, job_id) for uri in shard)
        assert uris == sorted(f"{videos}/{name}.mp4" for name in ["00a", *(f"{i:02d}" for i in range(14))])

    def test_a_long_listing_keeps_the_turn(self, store: SqlStore, videos: Path, tmp_path: Path) -> None:
        job_id = submit(store, tmp_path / "out", videos)
        fence = store.begin_planning(job_id, "slow", ttl_s=0.0)
        assert fence is not None
        seconds = iter([0.0, 1.0, 25.0, 25.0])
        turn = Turn(store, job_id, fence, ttl_s=60.0, clock=lambda: next(seconds))
        kept = turn.keep("abc")
        assert next(kept) == "a"
        assert store.begin_planning(job_id, "slow", ttl_s=0.0) is not None, "a newer fence"
        assert list(kept) == []

    def test_inputs_that_change_while_planning_is_down(
        self, store: SqlStore, videos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """A video that appears before the ones already planned is added behind them; none is lost or doubled."""
        make(videos, "b.mp4", "c.mp4", "d.mp4")
        job_id = submit(store, tmp_path / "out", videos, shard_max_videos=2)
        fence = store.begin_planning(job_id, "dead planner", ttl_s=0)
        assert fence is not None
        with SeenVideos() as seen:
            first = next(pack(new_videos(expand(str(videos)), seen), max_videos=2, max_input_bytes=100))
        store.add_shards(job_id, fence, [first], ttl_s=0)
        make(videos, "a.mp4")
        assert plan_next(store, "planner")
        assert planned(store, job_id) == [
            (0, [f"{videos}/b.mp4"]),
            (1, [f"{videos}/a.mp4"]),
            (2, [f"{videos}/c.mp4"]),
            (3, [f"{videos}/d.mp4"]),
        ]

    def test_a_missing_input_fails_the_job_and_leaves_the_output_alone(self, store: SqlStore, tmp_path: Path) -> None:
        job_id = submit(store, tmp_path / "out", "/nowhere/clip.mp4")
        assert plan_next(store, "planner")
        job = store.get_job(job_id)
        assert (job.state, job.error_code) == (JobState.FAILED, "input_unavailable")
        assert job.error_message is not None
        assert "/nowhere/clip.mp4" in job.error_message
        assert not (tmp_path / "out").exists()

    def test_an_output_with_another_jobs_name(self, store: SqlStore, videos: Path, tmp_path: Path) -> None:
        make(videos, "a.mp4")
        make(tmp_path / "out", CLAIM_KEY)
        job_id = submit(store, tmp_path / "out", videos)
        assert plan_next(store, "planner")
        job = store.get_job(job_id)
        assert (job.state, job.error_code) == (JobState.FAILED, "output_in_use")

    def test_an_output_that_cannot_be_written(self, store: SqlStore, videos: Path, tmp_path: Path) -> None:
        make(videos, "a.mp4")
        make(tmp_path, "file")
        job_id = submit(store, tmp_path / "file" / "out", videos)
        assert plan_next(store, "planner")
        job = store.get_job(job_id)
        assert (job.state, job.error_code) == (JobState.FAILED, "storage_refused")

    @pytest.mark.parametrize("name", ["README.md", "meta.parquet", "dataset.json", "payload/mine/notes.txt"])
    def test_files_of_the_user_are_not_replaced(self, store: SqlStore, videos: Path, tmp_path: Path, name: str) -> None:
        make(videos, "a.mp4")
        make(tmp_path / "out", "other.txt", name)
        job_id = submit(store, tmp_path / "out", videos)
        assert plan_next(store, "planner")
        job = store.get_job(job_id)
        assert (job.state, job.error_code) == (JobState.FAILED, "output_in_use")
        assert name in str(job.error_message)
        assert not (tmp_path / "out" / CLAIM_KEY).exists()
        (tmp_path / "out" / name).unlink()
        again = submit(store, tmp_path / "out", videos)
        assert plan_next(store, "planner")
        assert store.get_job(again).planned

    def test_outputs_lie_where_the_service_may_write(self, store: SqlStore, videos: Path, tmp_path: Path) -> None:
        make(videos, "a.mp4")
        allowed = tmp_path / "allowed"
        allowed.mkdir()
        (allowed / "link").symlink_to(tmp_path)
        inside, outside, through_a_link = (
            submit(store, output, videos) for output in (allowed / "new" / "out", tmp_path / "out", allowed / "link/x")
        )
        for _ in range(3):
            assert plan_next(store, "planner", output_roots=[allowed])
        assert store.get_job(inside).planned
        for job_id in (outside, through_a_link):
            assert store.get_job(job_id).error_code == "storage_refused"

    @pytest.mark.parametrize(
        ("error", "code"), [(StorageError("slow down"), "storage_error"), (ZeroDivisionError("oops"), "internal_error")]
    )
    def test_an_output_that_does_not_answer_holds_up_nobody_else(
        self,
        store: SqlStore,
        videos: Path,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        error: Exception,
        code: str,
    ) -> None:
        make(videos, "a.mp4")
        job_id, good = (submit(store, tmp_path / name, videos) for name in ("down", "good"))

        def claim(output: ObjectStore, job_id: str, *, create_once: bool) -> None:
            if output.uri.endswith("down"):
                raise error
            claim_output(output, job_id, create_once=create_once)

        monkeypatch.setattr("services.planner.planning.claim_output", claim)
        assert plan_next(store, "planner", backoff_base_s=600, backoff_max_s=600)
        assert plan_next(store, "planner")
        assert store.get_job(good).planned
        assert not plan_next(store, "planner"), "it waits for its turn"
        assert store.get_job(job_id).state is JobState.RUNNING

        late = submit(store, tmp_path / "late-down", videos)
        assert plan_next(store, "planner", backoff_base_s=0, give_up_after_s=600)
        assert plan_next(store, "planner", backoff_base_s=0, give_up_after_s=0)
        job = store.get_job(late)
        assert (job.state, job.error_code) == (JobState.FAILED, code)

    def test_a_job_cancelled_while_it_is_planned(self, store: SqlStore, videos: Path, tmp_path: Path) -> None:
        make(videos, "a.mp4")
        job_id = submit(store, tmp_path / "out", videos)

        class CancellingStore(SqlStore):
            def add_shards(self, job_id, fence, shards, *, ttl_s):
                self.request_cancel(job_id)
                return super().add_shards(job_id, fence, shards, ttl_s=ttl_s)

        cancelling = CancellingStore(f"sqlite:///{tmp_path}/store.db")
        assert plan_next(cancelling, "planner")
        cancelling.close()
        assert store.get_job(job_id).state is JobState.CANCELLED
        assert planned(store, job_id) == []
        next_id = submit(store, tmp_path / "out", videos)
        assert plan_next(store, "planner")
        assert store.get_job(next_id).planned, "a job that ended without shards leaves its output to the next"
        assert json.loads((tmp_path / "out" / CLAIM_KEY).read_text())["job_id"] == next_id

    def test_a_claim_that_is_written_after_its_job_was_cancelled(
        self, store: SqlStore, videos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        make(videos, "a.mp4")
        cancelled = submit(store, tmp_path / "out", videos)
        store.request_cancel(cancelled)
        job_id = submit(store, tmp_path / "out", videos)
        late = [cancelled]

        def claim(output: ObjectStore, job_id: str, *, create_once: bool) -> None:
            if late:
                claim_output(output, late.pop(), create_once=create_once)
            claim_output(output, job_id, create_once=create_once)

        monkeypatch.setattr("services.planner.planning.claim_output", claim)
        assert plan_next(store, "planner")
        assert store.get_job(job_id).planned


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


class TestS3:
    @pytest.fixture
    def bucket(self, endpoint: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
        monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
        monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
        monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        client = boto3.client("s3", endpoint_url=endpoint)
        client.create_bucket(Bucket="videos")
        for key in ("p/b.mp4", "p/a/c.mov", "p/readme.txt", "p/.x.mp4", "pq/other.mp4", "p/clip"):
            client.put_object(Bucket="videos", Key=key, Body=b"12345")
        yield "videos"
        for item in client.list_objects_v2(Bucket="videos").get("Contents", []):
            client.delete_object(Bucket="videos", Key=item["Key"])
        client.delete_bucket(Bucket="videos")

    def test_prefix_object_and_bucket(self, endpoint: str, bucket: str) -> None:
        found = list(expand(f"s3://{bucket}/p/", s3_endpoint_url=endpoint))
        assert [v.uri for v in found] == ["s3://videos/p/a/c.mov", "s3://videos/p/b.mp4"]
        assert {v.size_bytes for v in found} == {5}
        assert all(v.etag for v in found)
        (one,) = expand(f"s3://{bucket}/p/clip", s3_endpoint_url=endpoint)
        assert (one.uri, one.size_bytes) == ("s3://videos/p/clip", 5)
        assert len(list(expand(f"s3://{bucket}/", s3_endpoint_url=endpoint))) == 3

    @pytest.mark.parametrize("key", ["p", "p/none.mp4", "none/"])
    def test_nothing_there(self, endpoint: str, bucket: str, key: str) -> None:
        with pytest.raises(InputUnavailable, match=f"s3://{bucket}/{key}"):
            list(expand(f"s3://{bucket}/{key}", s3_endpoint_url=endpoint))

    def test_a_job_from_s3_to_s3(self, endpoint: str, bucket: str, store: SqlStore) -> None:
        job_id = submit(store, f"s3://{bucket}/out", f"s3://{bucket}/p/")
        assert plan_next(store, "planner", s3_endpoint_url=endpoint)
        assert [uris for _, uris in planned(store, job_id)] == [["s3://videos/p/a/c.mov"], ["s3://videos/p/b.mp4"]]
        claim = boto3.client("s3", endpoint_url=endpoint).get_object(Bucket=bucket, Key=f"out/{CLAIM_KEY}")
        assert job_id.encode() in claim["Body"].read()
