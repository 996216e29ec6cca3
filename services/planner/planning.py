"""Plan a job: take its output, list its inputs, write its shards.

Shards are written in their order, a batch per transaction. Planning that was cut off goes on behind the last shard that
is there and leaves out every video that has a place already: unchanged inputs then give the plan that an undisturbed
run gives, and inputs that changed meanwhile lose no video and double none.
"""

from __future__ import annotations

import itertools
import json
import logging
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path

from services.domain.errors import OutputInUse, OutputUnsupported, ServiceError
from services.domain.models import Job, ShardPlan
from services.domain.states import JobState
from services.planner.listing import Found, expand
from services.planner.packing import SeenVideos, new_videos, pack
from services.storage.base import ObjectStore
from services.storage.open import open_store, supports_create_once
from services.store.base import Store

CLAIM_KEY = "_job.json"

_log = logging.getLogger(__name__)
_BATCH_SHARDS = 64
_PAGE = 1000


def plan_next(
    store: Store,
    *,
    input_roots: Sequence[Path] = (),
    s3_endpoint_url: str | None = None,
    give_up_after_s: float = 120.0,
) -> bool:
    """Plan the oldest job that needs it. A job that cannot be planned fails with the reason.

    Args:
        store: Where the jobs are.
        input_roots: Where local inputs must lie; empty: anywhere.
        s3_endpoint_url: S3 service other than AWS.
        give_up_after_s: For how long storage that does not answer is asked again.

    Returns:
        Whether there was one.

    Raises:
        ServiceError: Something that can pass: call again later.
    """
    job = store.next_unplanned()
    if job is None:
        return False
    if not store.begin_planning(job.id):
        return True
    try:
        plan(store.get_job(job.id), store, input_roots=input_roots, s3_endpoint_url=s3_endpoint_url)
    except ServiceError as error:
        since = (datetime.now(UTC) - (job.started_at or datetime.now(UTC))).total_seconds()
        if error.retryable and since < give_up_after_s:
            raise
        _log.warning("job %s cannot be planned: %s", job.id, error)
        store.fail_job(job.id, error.code, str(error))
    return True


def plan(job: Job, store: Store, *, input_roots: Sequence[Path] = (), s3_endpoint_url: str | None = None) -> None:
    """Write the shards of a job for which `Store.begin_planning` said True. Stops if the job is cancelled meanwhile.

    Raises:
        InputUnavailable: An input does not exist or holds no video.
        OutputInUse: The output belongs to another job.
        OutputUnsupported: The output's storage cannot decide between two writers.
        StorageError: Storage does not answer.
    """
    with SeenVideos() as seen:
        _remember_planned(job, store, seen)
        found = _expand_all(job.spec.inputs, input_roots, s3_endpoint_url)
        shards = pack(
            new_videos(found, seen),
            max_videos=job.spec.shard_max_videos,
            max_input_bytes=job.spec.shard_max_input_bytes,
            first_ordinal=job.progress.shards_total,
        )
        for number, batch in enumerate(_batches(shards)):
            if number == 0:
                # Not before the first shard: a job whose inputs are wrong leaves no trace in its output.
                claim_output(open_store(job.spec.output, endpoint_url=s3_endpoint_url), job.id)
            store.add_shards(job.id, batch)
            if store.get_job(job.id).state is not JobState.RUNNING:
                return
        store.finish_planning(job.id)


def claim_output(output: ObjectStore, job_id: str) -> None:
    """Write a job's name into its output, once. Idempotent for the same job.

    Raises:
        OutputInUse: Another job's name is there.
        OutputUnsupported: The storage lets a second writer replace what the first one created.
        StorageError: The output cannot be written.
    """
    if output.head(CLAIM_KEY) is None and not supports_create_once(output):
        raise OutputUnsupported(
            f"the storage of {output.uri} ignores create-once writes (If-None-Match); use another output"
        )
    document = json.dumps({"schema_version": 1, "job_id": job_id}, sort_keys=True) + "\n"
    if output.create(CLAIM_KEY, document.encode()):
        return
    try:
        owner = json.loads(output.get_bytes(CLAIM_KEY))["job_id"]
    except (ValueError, KeyError, TypeError):
        owner = None
    if owner != job_id:
        name = f"job {owner}" if owner else "something else"
        raise OutputInUse(f"output {output.uri} belongs to {name} ({CLAIM_KEY}); choose another output")


def _expand_all(inputs: Sequence[str], roots: Sequence[Path], s3_endpoint_url: str | None) -> Iterator[Found]:
    for uri in inputs:
        yield from expand(uri, input_roots=roots, s3_endpoint_url=s3_endpoint_url)


def _batches(shards: Iterator[ShardPlan]) -> Iterator[list[ShardPlan]]:
    while batch := list(itertools.islice(shards, _BATCH_SHARDS)):
        yield batch


def _remember_planned(job: Job, store: Store, seen: SeenVideos) -> None:
    if job.progress.shards_total == 0:
        return
    after: str | None = None
    while True:
        rows, after = store.list_videos(job.id, limit=_PAGE, after=after)
        for row in rows:
            seen.add(row.ref.key, row.ref.uri)
        if after is None:
            return
