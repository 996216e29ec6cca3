"""The supervisor's decisions, with the real store, output and worker code, and deaths made to order."""

from __future__ import annotations

from pathlib import Path

import pytest
from agent_rig import Rig

from services.agent.leases import StopReason
from services.agent.messages import AnnotateVideo, PackShard, SlotProgress
from services.domain.errors import CommitConflict, IntegrityError, ServiceError, StorageError, StorageRefused
from services.domain.models import Death, Lease
from services.domain.states import JobState, ShardState, VideoStatus
from services.storage import open_store


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return Rig.make(tmp_path)


def _shard_state(rig: Rig, job_id: str) -> ShardState:
    (shard,), _ = rig.store.list_shards(job_id)
    return shard.state


def test_good_and_bad_inputs_become_one_committed_shard(rig: Rig) -> None:
    job_id = rig.job({"good": "frames=5", "corrupt": "error", "defect": "bug"})
    live = rig.lease()
    assert rig.supervisor.work(live).kind == "committed"
    rows = rig.rows(live)
    assert (rows["good"].status, rows["good"].num_frames) == (VideoStatus.SUCCEEDED, 5)
    assert (rows["corrupt"].status, rows["corrupt"].error_code) == (VideoStatus.FAILED, "media_corrupt")
    assert rows["defect"].error_code == "engine_failed"
    assert "a defect" in str(rows["defect"].error_message)
    assert "\n" not in str(rows["defect"].error_message)
    assert _shard_state(rig, job_id) is ShardState.COMMITTED
    assert rig.metric("vipe_frames_total") == 5
    assert rig.metric("vipe_videos_total", outcome="failed", error_class="media_corrupt") == 1
    assert rig.slot.starts == 1
    assert not any(rig.config.scratch_dir.iterdir())


def test_a_death_costs_one_try_and_no_finished_video(rig: Rig, tmp_path: Path) -> None:
    count = tmp_path / "count"
    rig.job({"a": f"frames=3 count={count}", "b": f"die-once={tmp_path / 'died'} count={count}", "c": f"count={count}"})
    live = rig.lease()
    assert rig.supervisor.work(live).kind == "committed"
    assert {row.status for row in rig.rows(live).values()} == {VideoStatus.SUCCEEDED}
    tried = [line.rsplit("-", 1)[0] for line in count.read_text().split()]
    assert sorted(tried) == ["a", "b", "b", "c"]
    assert rig.slot.starts == 2
    assert rig.metric("vipe_actor_restarts_total", reason="died") == 1


def test_a_video_that_always_kills_is_tried_last_and_quarantined(rig: Rig) -> None:
    rig.job({"a-poison": "die", "b": "frames=3", "c": "frames=3"})
    live = rig.lease()
    assert rig.supervisor.work(live).kind == "committed"
    rows = rig.rows(live)
    assert rows["a-poison"].status is VideoStatus.QUARANTINED
    assert rows["a-poison"].error_code == "worker_died"
    assert "a-poison.mp4" in str(rows["a-poison"].error_message)
    assert rows["b"].status is rows["c"].status is VideoStatus.SUCCEEDED
    assert rig.slot.annotated() == ["a-poison", "b", "c", "a-poison", "a-poison"]
    assert rig.metric("vipe_videos_total", outcome="quarantined", error_class="worker_died") == 1


def test_deaths_of_an_earlier_lease_are_remembered(rig: Rig) -> None:
    rig.job({"poison": "die", "b": "frames=3"})
    first = rig.lease()
    for _ in range(2):
        rig.store.blame(first.lease.shard_id, first.lease.fence, first.lease.videos[0].key, Death("before"))
    rig.store.release(first.lease.shard_id, first.lease.fence, "restart")
    live = rig.lease()
    assert {key: len(deaths) for key, deaths in live.lease.spent.items()} == {first.lease.videos[0].key: 2}
    rig.supervisor.work(live)
    assert rig.rows(live)["poison"].status is VideoStatus.QUARANTINED
    assert rig.slot.annotated() == ["b", "poison"]


def test_a_slot_on_which_everything_dies_is_fenced_and_blames_nobody_for_good(rig: Rig) -> None:
    job_id = rig.job(dict.fromkeys("abcd", "die"))
    live = rig.lease()
    outcome = rig.supervisor.work(live)
    assert (outcome.kind, outcome.fenced) == ("given_back", True)
    assert rig.slot.annotated() == ["a", "b", "c"]
    assert _shard_state(rig, job_id) is ShardState.PENDING
    assert rig.record(live) is None


def test_where_only_one_video_died_another_slot_is_asked(rig: Rig) -> None:
    """It may be the slot: before its last try the video goes to whoever claims the shard next."""
    rig.job({"lonely": "die"})
    live = rig.lease()
    outcome = rig.supervisor.work(live)
    assert (outcome.kind, outcome.reason, outcome.fenced) == ("given_back", "worker_died", False)
    assert rig.slot.annotated() == ["lonely", "lonely"]
    live = rig.lease()
    assert rig.supervisor.work(live).fenced, "asked again, the slot itself is the suspect"
    rig.slot.where = "elsewhere/slot-0"
    rig.supervisor.pardon()  # The supervisor of another slot has seen nothing of this.
    live = rig.lease()
    assert rig.supervisor.work(live).kind == "committed"
    assert rig.rows(live)["lonely"].status is VideoStatus.QUARANTINED
    assert rig.slot.annotated() == ["lonely"] * 4


def test_a_bad_slot_is_fenced_before_it_condemns_one_of_two(rig: Rig) -> None:
    rig.job(dict.fromkeys("ab", "die"))
    live = rig.lease()
    assert rig.supervisor.work(live).fenced
    assert rig.slot.annotated() == ["a", "b", "a"]
    assert rig.record(live) is None


def test_a_fenced_slot_that_is_pardoned_ends_the_job_after_all(rig: Rig) -> None:
    rig.job(dict.fromkeys("abcd", "die"))
    for _ in range(20):
        live = rig.lease()
        outcome = rig.supervisor.work(live)
        if outcome.kind == "committed":
            break
        assert outcome.fenced
        rig.supervisor.pardon()
    assert {row.status for row in rig.rows(live).values()} == {VideoStatus.QUARANTINED}


def test_a_pardoned_slot_tries_a_video_before_it_condemns_it(rig: Rig) -> None:
    """Its deaths, however many, were all on a slot that did nothing else meanwhile: it may have been the slot."""
    rig.job({"innocent": "die"})
    assert rig.supervisor.work(rig.lease()).kind == "given_back"
    assert rig.supervisor.work(rig.lease()).fenced
    (rig.root / "inputs" / "innocent.mp4").write_text("frames=3")  # What was wrong with the slot is over.
    rig.supervisor.pardon()
    live = rig.lease()
    assert rig.supervisor.work(live).kind == "committed"
    assert rig.rows(live)["innocent"].status is VideoStatus.SUCCEEDED


def test_a_lone_poison_on_a_lone_slot_is_quarantined_after_the_pardon(rig: Rig) -> None:
    rig.job({"poison": "die"})
    assert rig.supervisor.work(rig.lease()).kind == "given_back"
    assert rig.supervisor.work(rig.lease()).fenced
    rig.supervisor.pardon()
    live = rig.lease()
    assert rig.supervisor.work(live).kind == "committed"
    assert rig.rows(live)["poison"].status is VideoStatus.QUARANTINED
    assert rig.slot.annotated() == ["poison"] * 4


def test_a_process_that_died_while_idle_is_nobodys_fault(rig: Rig) -> None:
    rig.job({"a": "frames=3"})
    assert rig.supervisor.start()
    rig.slot.dies_idle = True
    live = rig.lease()
    assert rig.supervisor.work(live).kind == "committed"
    assert rig.slot.annotated() == ["a"]
    assert rig.slot.starts == 2


def test_a_hanging_video_is_killed_after_its_budget(rig: Rig) -> None:
    rig.job({"a": "hang", "b": "frames=3"})
    live = rig.lease()
    assert rig.supervisor.work(live).kind == "committed"
    rows = rig.rows(live)
    assert rows["a"].error_code == "video_timeout"
    assert rows["b"].status is VideoStatus.SUCCEEDED
    assert rig.slot.annotated() == ["a", "b", "a"], "once more, after the others"
    assert 2 * rig.config.video_budget_base_s < rig.clock.now_s < 2 * rig.config.video_budget_base_s + 3
    assert rig.metric("vipe_actor_restarts_total", reason="video_timeout") == 2


def test_a_video_that_hung_for_the_machines_sake_succeeds_after_all(rig: Rig, tmp_path: Path) -> None:
    rig.job({"a": f"hang-once={tmp_path / 'hung'}", "b": "frames=3"})
    live = rig.lease()
    assert rig.supervisor.work(live).kind == "committed"
    assert {row.status for row in rig.rows(live).values()} == {VideoStatus.SUCCEEDED}


def test_a_full_disk_is_no_fault_of_the_video(rig: Rig, tmp_path: Path) -> None:
    """A limit on the size of files stands for the full disk: `write` fails and names no file in both cases."""
    rig.job({"a": f"disk-full-once={tmp_path / 'full'}", "b": "frames=3"})
    live = rig.lease()
    assert rig.supervisor.work(live).kind == "committed"
    assert {row.status for row in rig.rows(live).values()} == {VideoStatus.SUCCEEDED}
    assert rig.slot.annotated() == ["a", "a", "b"]


def test_a_retryable_error_gets_a_second_try(rig: Rig, tmp_path: Path) -> None:
    rig.job({"a": f"flaky={tmp_path / 'flaked'}"})
    live = rig.lease()
    assert rig.supervisor.work(live).kind == "committed"
    assert rig.rows(live)["a"].status is VideoStatus.SUCCEEDED
    assert rig.slot.annotated() == ["a", "a"]


def test_a_cancelled_job_stops_within_seconds_and_commits_nothing(rig: Rig) -> None:
    job_id = rig.job({"a": "hang", "b": "frames=3"})
    live = rig.lease()
    rig.store.request_cancel(job_id)
    rig.slot.before_poll = [None, rig.book.renew]
    outcome = rig.supervisor.work(live)
    assert (outcome.kind, outcome.reason) == ("stopped", StopReason.CANCELLED)
    assert rig.clock.now_s < 5
    assert rig.record(live) is None
    assert rig.store.get_job(job_id).state is JobState.CANCELLED


def test_a_worker_that_does_not_obey_is_killed(rig: Rig) -> None:
    rig.job({"a": "hang"})
    live = rig.lease()
    rig.slot.obeys_cancel = False
    rig.slot.before_poll = [None, lambda: live.stop(StopReason.DRAINED)]
    assert rig.supervisor.work(live).reason == StopReason.DRAINED
    assert rig.config.cancel_grace_s < rig.clock.now_s < rig.config.cancel_grace_s + 2
    assert rig.supervisor.start()
    assert rig.slot.starts == 2


def test_a_drained_shard_goes_on_where_it_was(rig: Rig, tmp_path: Path) -> None:
    count = tmp_path / "count"
    rig.job({"a": f"frames=3 count={count}", "b": f"frames=3 count={count}"})
    live = rig.lease()
    # open, a, b: stop while b runs, before its reply is read.
    rig.slot.before_poll = [None, None, lambda: (live.stop(StopReason.DRAINED), setattr(rig.slot, "_outcome", None))]
    assert rig.supervisor.work(live).reason == StopReason.DRAINED
    again = rig.lease()
    assert again.lease.attempt == 2
    assert rig.supervisor.work(again).kind == "committed"
    assert len(rig.rows(again)) == 2
    assert [line.rsplit("-", 1)[0] for line in count.read_text().split()] == ["a", "b"]


def test_a_lost_lease_is_not_committed(rig: Rig) -> None:
    job_id = rig.job({"a": "frames=3"})
    live = rig.lease()

    def steal() -> None:
        rig.store.release(live.lease.shard_id, live.lease.fence, "stolen")
        rig.lease()

    rig.slot.before_poll = [None, None, steal]  # While the tars are uploaded.
    outcome = rig.supervisor.work(live)
    assert (outcome.kind, outcome.reason) == ("stopped", StopReason.LOST)
    assert rig.record(live) is None
    assert _shard_state(rig, job_id) is ShardState.LEASED
    assert rig.metric("vipe_commit_conflicts_total", result="lost_lease") == 1


def test_a_record_without_its_database_row_is_found_and_not_done_again(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = rig.job({"a": "frames=3"})
    first = rig.lease()
    with monkeypatch.context() as patch:
        patch.setattr(rig.committer, "record", lambda record: True)  # Dies between the record and the database.
        rig.supervisor.work(first)
    assert rig.record(first) is not None
    assert _shard_state(rig, job_id) is ShardState.LEASED
    rig.store.release(first.lease.shard_id, first.lease.fence, "expired")
    handed_over = len(rig.slot.tasks)
    again = rig.lease()
    assert rig.supervisor.work(again).kind == "committed"
    assert not any(isinstance(task, AnnotateVideo | PackShard) for task in rig.slot.tasks[handed_over:])
    assert _shard_state(rig, job_id) is ShardState.COMMITTED
    assert rig.metric("vipe_frames_total") == 3


def test_a_preset_that_cannot_work_fails_the_job_at_once(rig: Rig) -> None:
    job_id = rig.job({"a": "frames=3", "b": "frames=3"}, preset="absent")
    live = rig.lease()
    assert rig.supervisor.work(live).kind == "job_failed"
    job = rig.store.get_job(job_id)
    assert (job.state, job.error_code) == (JobState.FAILED, "invalid_config")
    assert "absent" in str(job.error_message)
    assert rig.slot.annotated() == ["a"]


def test_unreachable_output_gives_the_lease_back_and_then_goes_on(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    job_id = rig.job({"a": "frames=3"})
    live = rig.lease()

    def down(*_: object) -> None:
        raise StorageError("the bucket does not answer")

    with monkeypatch.context() as patch:
        patch.setattr(rig.committer, "write", down)
        outcome = rig.supervisor.work(live)
    assert (outcome.kind, outcome.reason) == ("given_back", "storage_error")
    assert _shard_state(rig, job_id) is ShardState.PENDING
    again = rig.lease()
    assert rig.supervisor.work(again).kind == "committed"
    assert rig.slot.annotated() == ["a"]  # The artifacts were still there.


@pytest.mark.parametrize("error", [StorageError, StorageRefused])
def test_an_input_that_can_never_be_fetched_becomes_a_row_in_the_end(
    tmp_path: Path, error: type[StorageError], monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreachable(uri: str, **options: object) -> object:
        if uri.startswith("s3://"):
            raise error(f"{uri} is out of reach")
        return open_store(uri, **options)

    monkeypatch.setattr("services.agent.slot.open_store", unreachable)
    rig = Rig.make(tmp_path, max_give_backs=2, storage_tries=2)
    rig.job({"a": "frames=3"})
    outcomes = []
    for _ in range(3):
        live = rig.lease()
        object.__setattr__(live.lease.videos[0], "uri", "s3://bucket/a.mp4")
        outcomes.append(rig.supervisor.work(live).kind)
    assert outcomes == ["given_back", "given_back", "committed"]
    (row,) = rig.rows(live).values()
    assert (row.status, row.error_code) == (VideoStatus.FAILED, "input_unavailable")


@pytest.mark.parametrize("error", [StorageRefused, IntegrityError, CommitConflict])
def test_an_output_that_refuses_a_second_attempt_fails_the_job(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, error: type[ServiceError]
) -> None:
    job_id = rig.job({"a": "frames=3"})
    first = rig.lease()
    rig.store.release(first.lease.shard_id, first.lease.fence, "restart")

    def gone(lease: Lease) -> bool:
        raise error("the bucket was deleted")

    monkeypatch.setattr(rig.committer, "settled", gone)
    assert rig.supervisor.work(rig.lease()).kind == "job_failed"
    job = rig.store.get_job(job_id)
    assert (job.state, job.error_code) == (JobState.FAILED, error.code)


def test_a_defect_of_the_service_does_not_give_a_shard_back_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Rig.make(tmp_path, max_give_backs=2)
    job_id = rig.job({"a": "frames=3"})

    def defect(*_: object) -> None:
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr(rig.slot, "poll", defect)
    monkeypatch.setattr(rig.slot, "submit", lambda task: None)
    assert [rig.supervisor.work(rig.lease()).kind for _ in range(3)] == ["given_back", "given_back", "job_failed"]
    assert rig.store.get_job(job_id).error_code == "internal_error"


def test_a_timeout_names_the_budget_that_was_spent(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """The frames that the budget counts are forgotten when the worker is killed."""
    rig.job({"a": "hang"})
    live = rig.lease()
    monkeypatch.setattr(
        rig.slot, "progress", lambda: SlotProgress(frames_expected=100 if rig.slot._slot is not None else None)
    )
    rig.supervisor.work(live)
    spent_s = rig.config.video_budget_base_s + 100 * rig.config.video_budget_per_frame_s
    assert f"within {spent_s:.0f} s" in str(rig.rows(live)["a"].error_message)


def test_an_output_that_refuses_fails_the_job_in_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refusing(uri: str, **options: object) -> object:
        raise StorageRefused(f"{uri} may not be written")

    monkeypatch.setattr("services.agent.slot.open_store", refusing)
    rig = Rig.make(tmp_path, max_give_backs=2)
    job_id = rig.job({"a": "frames=3"})
    assert [rig.supervisor.work(rig.lease()).kind for _ in range(3)] == ["given_back", "given_back", "job_failed"]
    job = rig.store.get_job(job_id)
    assert (job.state, job.error_code) == (JobState.FAILED, "storage_refused")
    assert rig.slot.annotated() == ["a"]


def test_without_a_worker_process_the_lease_is_given_back(rig: Rig) -> None:
    rig.job({"a": "frames=3"})
    live = rig.lease()
    rig.slot.start_failures = 3
    outcome = rig.supervisor.work(live)
    assert (outcome.kind, outcome.reason) == ("given_back", "no_worker")
    assert rig.metric("vipe_actor_restarts_total", reason="start_failed") == 3
    assert rig.supervisor.work(rig.lease()).kind == "committed"


def test_progress_counts_finished_videos_and_expects_the_rest_to_be_alike(rig: Rig) -> None:
    rig.job({"a": "frames=4", "b": "frames=8", "c": "frames=9"})
    live = rig.lease()
    reports = []

    def look() -> None:
        report = live.report()
        reports.append((report.videos_done, report.frames_done, report.frames_expected))

    rig.slot.before_poll = [look] * 5  # open, a, b, c, pack
    rig.supervisor.work(live)
    assert reports == [(0, 0, None), (0, 0, None), (1, 4, 12), (2, 12, 18), (3, 21, 21)]
