"""Plan a job: take its output, list its inputs, write its shards.

One planner at a time: the store gives it a fence and refuses whoever holds an older one. Shards are written in their
order, a batch per transaction, and each batch renews the planner's time. Planning that was cut off goes on behind the
last shard that is there and leaves out every video that has a place already: unchanged inputs then give the plan that
an undisturbed run gives, and inputs that changed meanwhile lose no video and double none.
"""

from __future__ import annotations

import itertools
import json
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from services.domain.errors import (
    JobNotFound,
    ObjectMissing,
    OutputInUse,
    ServiceError,
    StorageRefused,
    StoreUnavailable,
    code_and_message,
)
from services.domain.models import Job, PlannedShard, ShardPlan
from services.domain.states import JobState
from services.inputs.rules import InputRules, check_bucket
from services.planner.listing import Found, expand
from services.planner.packing import SeenVideos, new_videos, pack
from services.storage.base import ObjectStore
from services.storage.open import open_store, supports_create_once
from services.storage.roots import lies_within
from services.store.base import Store, VideoRow

CLAIM_KEY = "_job.json"  # as in `services.commit.layout`, behind whose package heavy libraries stand

_log = logging.getLogger(__name__)
_BATCH_SHARDS = 64
_PAGE = 1000
_T = TypeVar("_T")


def plan_next(
    store: Store,
    holder: str,
    *,
    ttl_s: float = 60.0,
    rules: InputRules | None = None,
    output_roots: Sequence[Path] = (),
    s3_endpoint_url: str | None = None,
    give_up_after_s: float = 120.0,
    backoff_base_s: float = 1.0,
    backoff_max_s: float = 60.0,
) -> bool:
    """Plan the oldest job that needs it. A job that cannot be planned fails with the reason.

    Args:
        store: Where the jobs are.
        holder: Who plans: a name that no other planner ever has.
        ttl_s: Another planner takes over what nothing was heard of for so long.
        rules: What inputs may name.
        output_roots: Where local outputs must lie; empty: anywhere.
        s3_endpoint_url: S3 service other than AWS.
        give_up_after_s: For how long a job is tried again whose planning fails for reasons that can pass, storage that
            does not answer or a defect. It waits meanwhile, and other jobs have their turn.
        backoff_base_s, backoff_max_s: Its first wait, which doubles, and the longest one.

    Returns:
        Whether there was one.

    Raises:
        StoreUnavailable: The database does not answer: call again later.
    """
    job = store.next_unplanned(holder)
    if job is None:
        return False
    fence = store.begin_planning(job.id, holder, ttl_s=ttl_s)
    if fence is None:
        return True
    turn = Turn(store, job.id, fence, ttl_s)
    try:
        plan(turn, rules=rules, output_roots=output_roots, s3_endpoint_url=s3_endpoint_url)
    except StoreUnavailable:
        raise
    except Exception as error:
        foreseen = isinstance(error, ServiceError)
        if not isinstance(error, ServiceError) or error.retryable:
            deferral = store.defer_job(job.id, base_s=backoff_base_s, max_s=backoff_max_s, planning_fence=fence)
            if deferral.failing_s < give_up_after_s:
                _log.warning(
                    "planning of job %s failed, next try in %.1f s: %s",
                    job.id,
                    deferral.wait_s,
                    error,
                    exc_info=not foreseen,
                )
                return True
        _log.error("job %s cannot be planned: %s", job.id, error, exc_info=not foreseen)
        store.fail_job(job.id, *code_and_message(error), planning_fence=fence)
    return True


@dataclass(slots=True)
class Turn:
    """A planner's right to plan one job, as `Store.begin_planning` gave it.

    Attributes:
        clock: Monotonic seconds.
    """

    store: Store
    job_id: str
    fence: int
    ttl_s: float
    clock: Callable[[], float] = time.monotonic
    _heard_s: float = field(init=False)

    def __post_init__(self) -> None:
        self._heard_s = self.clock()

    def keep(self, items: Iterable[_T]) -> Iterator[_T]:
        """Pass items through and renew on the way: a listing may need longer for one batch than the time that is given.

        Ends early where the turn is lost.
        """
        for item in items:
            if self.clock() - self._heard_s > self.ttl_s / 3:
                self._heard_s = self.clock()
                if not self.store.renew_planning(self.job_id, self.fence, ttl_s=self.ttl_s):
                    return
            yield item

    def add(self, batch: list[ShardPlan]) -> bool:
        self._heard_s = self.clock()
        return self.store.add_shards(self.job_id, self.fence, batch, ttl_s=self.ttl_s)

    def finish(self) -> bool:
        return self.store.finish_planning(self.job_id, self.fence)


def plan(
    turn: Turn,
    *,
    rules: InputRules | None = None,
    output_roots: Sequence[Path] = (),
    s3_endpoint_url: str | None = None,
) -> None:
    """Write the shards of a job. Stops if it is cancelled meanwhile, or another planner's turn.

    Raises:
        InputUnavailable: An input does not exist or holds no video.
        OutputInUse: The output belongs to another job, or holds files that the job would replace.
        StorageRefused: The output lies outside of the directories that the service may write.
        StorageError: Storage does not answer.
    """
    job = turn.store.get_job(turn.job_id)  # Not before the turn began: from now on nobody else adds shards.
    rules = rules or InputRules()
    check_output_place(job.spec.output, output_roots, rules.buckets)
    with SeenVideos() as seen:
        for row in turn.keep(_planned(job, turn.store)):
            seen.add(row.ref.key, row.ref.uri)
        found = turn.keep(_expand_all(job.spec.inputs, rules, s3_endpoint_url))
        shards = pack(
            new_videos(found, seen),
            max_videos=job.spec.shard_max_videos,
            max_input_bytes=job.spec.shard_max_input_bytes,
            first_ordinal=job.progress.shards_total,
        )
        output = open_store(job.spec.output, endpoint_url=s3_endpoint_url)
        for number, batch in enumerate(_batches(shards)):
            # Not before the first shard: a job whose inputs are wrong leaves no trace in its output.
            if number == 0 and not _take_output(turn, output):
                return
            if not turn.add(batch):
                return
        write_plan(output, turn.store, job.id, job.spec.config_hash, keep=turn.keep)
        turn.finish()


def write_plan(
    output: ObjectStore,
    store: Store,
    job_id: str,
    config_hash: str,
    *,
    keep: Callable[[Iterable[PlannedShard]], Iterable[PlannedShard]] = iter,
) -> None:
    """Let the output say which shards there must be; adds what it does not say yet.

    Args:
        keep: Passes the shards through, and may do something on the way.

    Raises:
        IntegrityError: The output has a plan that is damaged or another one.
        StorageError: Storage does not answer.
    """
    from services.commit.plan import publish_plan  # Heavy packages stand behind its package.

    def shards_from(ordinal: int) -> Iterator[PlannedShard]:
        while page := store.planned_shards(job_id, first_ordinal=ordinal, limit=_PAGE):
            yield from keep(page)
            ordinal = page[-1].ordinal + 1

    total = store.get_job(job_id).progress.shards_total
    if total:
        create_once = store.commit_point(job_id) is not False
        publish_plan(output, job_id, config_hash, shards_from, total, create_once=create_once)


def check_output_place(output: str, roots: Sequence[Path], buckets: tuple[str, ...] = ()) -> None:
    """Raises StorageRefused if a local output lies outside of `roots`, AddressRefused if its bucket is not allowed."""
    if output.startswith("s3://"):
        check_bucket(output, buckets)
    if output.startswith("/") and not lies_within(output, roots):
        raise StorageRefused(f"output {output} lies outside of the directories that this service may write")


def _take_output(turn: Turn, output: ObjectStore) -> bool:
    """Make the output this job's, and settle who decides its commits. False if the turn is lost."""
    known = turn.store.commit_point(turn.job_id)
    _remove_abandoned_claim(turn, output)
    check_output_is_free(output, turn.job_id)
    create_once = supports_create_once(output) if known is None else known
    settled = turn.store.settle_commit_point(turn.job_id, turn.fence, create_once)
    if settled is None:
        return False
    if known is None and not settled:
        _log.warning(
            "%s does not enforce create-once writes (If-None-Match): the database decides the commits of %s",
            output.uri,
            turn.job_id,
        )
    try:
        claim_output(output, turn.job_id, create_once=settled)
    except OutputInUse:
        # The planner of a job that was cancelled a moment ago may have written its claim only now.
        if not _remove_abandoned_claim(turn, output):
            raise
        claim_output(output, turn.job_id, create_once=settled)
    return True


def _remove_abandoned_claim(turn: Turn, output: ObjectStore) -> bool:
    """Remove the claim of a job that ended between its claim and its first shard; whether there was one.

    The database has given such a job's output to this one; nothing else of it can be there, and nothing can come.
    """
    owner = _owner(output)
    if owner is None or owner == turn.job_id:
        return False
    try:
        job = turn.store.get_job(owner)
    except JobNotFound:
        return False  # of another database
    if job.state not in (JobState.FAILED, JobState.CANCELLED) or job.progress.shards_total > 0:
        return False
    _log.info("%s was claimed by %s, which ended before it had shards", output.uri, owner)
    output.delete(CLAIM_KEY)
    return True


def _owner(output: ObjectStore) -> str | None:
    """The job whose claim lies in the output; empty if it is something else, None if there is none."""
    try:
        document = json.loads(output.get_bytes(CLAIM_KEY))
        return str(document["job_id"])
    except ObjectMissing:
        return None
    except (ValueError, KeyError, TypeError):
        return ""


def check_output_is_free(output: ObjectStore, job_id: str) -> None:
    """Raises OutputInUse if another job's name is in the output; or no job's, but files that a job would replace."""
    owner = _owner(output)
    if owner is None:
        if (taken := _taken_key(output)) is not None:
            raise OutputInUse(f"output {output.uri} holds {taken} already, which is not ours; choose another folder")
        return
    if owner != job_id:
        name = f"job {owner}" if owner else "something else"
        raise OutputInUse(f"output {output.uri} belongs to {name} ({CLAIM_KEY}); choose another output")


def claim_output(output: ObjectStore, job_id: str, *, create_once: bool = True) -> None:
    """Write a job's name into its output, once. Idempotent for the same job.

    Args:
        create_once: Whether the output decides between two writers. Where not, the database alone keeps two of its
            jobs apart, and what another database writes to the same place at the same moment is not noticed.

    Raises:
        OutputInUse: Another job's name is there; or no job's, but files that this job would replace or mix with.
        StorageError: The output cannot be written.
    """
    check_output_is_free(output, job_id)
    point = "output" if create_once else "database"
    description = {"schema_version": 1, "job_id": job_id, "commit_point": point}
    document = (json.dumps(description, sort_keys=True) + "\n").encode()
    if not create_once:
        output.put_bytes(CLAIM_KEY, document)
    elif not output.create(CLAIM_KEY, document):
        check_output_is_free(output, job_id)


def _taken_key(output: ObjectStore) -> str | None:
    """A key of the kind that a job writes and that lies in the output already: a README.md of the user's own, say."""
    from services.commit.layout import FOLDERS  # Heavy packages stand behind these two.
    from services.dataset.schema import CARD_KEY, DATASET_KEY, FAILURES_KEY, META_KEY

    for key in (META_KEY, FAILURES_KEY, DATASET_KEY, CARD_KEY):
        if output.head(key) is not None:
            return key
    return next((info.key for folder in FOLDERS for info in output.list(folder)), None)


def _expand_all(inputs: Sequence[str], rules: InputRules, s3_endpoint_url: str | None) -> Iterator[Found]:
    for uri in inputs:
        yield from expand(uri, rules, s3_endpoint_url=s3_endpoint_url)


def _batches(shards: Iterator[ShardPlan]) -> Iterator[list[ShardPlan]]:
    while batch := list(itertools.islice(shards, _BATCH_SHARDS)):
        yield batch


def _planned(job: Job, store: Store) -> Iterator[VideoRow]:
    """The videos that have a place already."""
    after: str | None = None
    while True:
        rows, after = store.list_videos(job.id, limit=_PAGE, after=after)
        yield from rows
        if after is None:
            return
