"""The plan of a job, written into its output: what must be there, before any of it is.

    _plan/000000.json, _plan/000001.json, ...

Pages of shards in their order, each with the sha256 of the page before it. They are only ever added to: a chain that
ends in a page with `last` names every shard that the job has. What a forger writes into the output must agree with it;
who can write the whole output can write another chain, too, and only the database knows better.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

from services.domain.errors import IntegrityError, ObjectMissing
from services.domain.models import PlannedShard
from services.storage.base import ObjectStore

PLAN_PREFIX = "_plan/"
PAGE_SHARDS = 2048


@dataclass(frozen=True, slots=True)
class PlanHead:
    """How far the chain goes.

    Attributes:
        digests: sha256 of each page; the last one stands for all of them.
        complete: Whether the last page says that it is the last one.
    """

    shards: int = 0
    digests: tuple[str, ...] = ()
    complete: bool = False

    @property
    def pages(self) -> int:
        return len(self.digests)

    @property
    def sha256(self) -> str | None:
        return self.digests[-1] if self.digests else None

    def to_json(self) -> dict[str, Any]:
        return {"pages": self.pages, "shards": self.shards, "sha256": self.sha256, "complete": self.complete}


def page_key(number: int) -> str:
    return f"{PLAN_PREFIX}{number:06d}.json"


def publish_plan(
    store: ObjectStore,
    job_id: str,
    config_hash: str,
    shards_from: Callable[[int], Iterable[PlannedShard]],
    total: int,
    *,
    create_once: bool = True,
) -> PlanHead:
    """Add what is missing in the output's plan, so that it names the first `total` shards. Safe to repeat and to race.

    Args:
        shards_from: The shards from an ordinal on, in their order.
        create_once: See `services.storage.supports_create_once`.

    Raises:
        IntegrityError: The chain that is there is damaged, or names other shards.
        StorageError: The store refused.
    """
    head = read_plan(store, job_id, lambda shard: None)
    while head.shards < total or not head.complete:
        remaining = itertools.takewhile(lambda shard: shard.ordinal < total, shards_from(head.shards))
        shards = list(itertools.islice(remaining, PAGE_SHARDS))
        end = head.shards + len(shards)
        if [shard.ordinal for shard in shards] != list(range(head.shards, end)) or (not shards and end < total):
            raise IntegrityError(f"the plan of {job_id} has no shard {end}")
        page = {
            "schema_version": 1,
            "job_id": job_id,
            "config_hash": config_hash,
            "number": head.pages,
            "previous": head.sha256,
            "last": end == total,
            "shards": [asdict(shard) for shard in shards],
        }
        data = (json.dumps(page, sort_keys=True) + "\n").encode()
        if create_once:
            store.create(page_key(head.pages), data)
        else:
            store.put_bytes(page_key(head.pages), data)
        after = read_plan(store, job_id, lambda shard: None)  # Somebody else's page may be there, with the same shards.
        if after.pages == head.pages:
            raise IntegrityError(f"{store.uri}/{page_key(head.pages)} was written and is not there")
        head = after
    return head


def read_plan(store: ObjectStore, job_id: str, shard: Callable[[PlannedShard], object]) -> PlanHead:
    """Read the chain from its beginning and hand over each shard.

    Raises:
        IntegrityError: A page is damaged, belongs to another job, does not follow from the one before it, or leaves
            out shards.
    """
    head = PlanHead()
    for data in _pages(store):
        where = f"{store.uri}/{page_key(head.pages)}"
        try:
            page = json.loads(data)
            shards = [PlannedShard(**{**raw, "videos": tuple(raw["videos"])}) for raw in page["shards"]]
            follows = (page["job_id"], page["number"], page["previous"]) == (job_id, head.pages, head.sha256)
        except (ValueError, KeyError, TypeError) as error:
            raise IntegrityError(f"the page {where} of the plan is damaged: {type(error).__name__}") from error
        if not follows or [s.ordinal for s in shards] != list(range(head.shards, head.shards + len(shards))):
            raise IntegrityError(f"the page {where} of the plan does not follow from the one before it")
        for each in shards:
            shard(each)
        digests = (*head.digests, hashlib.sha256(data).hexdigest())
        head = PlanHead(head.shards + len(shards), digests, bool(page.get("last")))
    return head


def _pages(store: ObjectStore) -> Iterator[bytes]:
    for number in itertools.count():
        try:
            yield store.get_bytes(page_key(number))
        except ObjectMissing:
            return
