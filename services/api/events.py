"""A job's history as a stream of server-sent events, and as pages."""

from __future__ import annotations

import logging
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

import anyio
from anyio.to_thread import run_sync
from sse_starlette import EventSourceResponse, ServerSentEvent
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from services.api import paging, problems
from services.api.authentication import REVOCATION_S
from services.api.limits import StreamLimit
from services.api.problems import TooManyStreams
from services.api.schemas import EventPage, EventView, JobView
from services.domain.errors import InvalidPageToken, StoreUnavailable
from services.domain.events import ends_history
from services.domain.models import Event, Job
from services.domain.states import JobState
from services.store.base import Store

LAST_EVENT_ID = r"^[0-9]{1,18}$"
_POLL_S = 0.5
_POLLS_PER_PROGRESS = 2
_POLLS_PER_WELCOME = round(REVOCATION_S / _POLL_S)
_SEND_S = 30.0  # a reader that takes nothing for so long is gone
_BATCH = 500
_GRACE_S = 5.0
_log = logging.getLogger(__name__)


def wants_stream(accept: str) -> bool:
    """Whether the caller takes a stream; one that asks for JSON and does not mention streams gets a page."""
    return "text/event-stream" in accept or "application/json" not in accept


def event_page(store: Store, job_id: str, *, tenant: str, limit: int, page_token: str | None) -> EventPage:
    """One page of the history, oldest first."""
    name = f"events of {job_id}"
    after = paging.cursor(page_token, of=name) or "0"
    if not after.isascii() or not after.isdigit() or len(after) > 18:
        raise InvalidPageToken("this page_token was not given out for this list; start again without one")
    events = store.events(job_id, tenant=tenant, after_seq=int(after), limit=limit + 1)
    more = len(events) > limit
    events = events[:limit]
    following = paging.token(str(events[-1].seq), of=name) if more else None
    return EventPage(items=[EventView.of(event) for event in events], next_page_token=following)


def event_stream(
    store: Store,
    job_id: str,
    *,
    tenant: str,
    after_seq: int,
    draining: threading.Event,
    reader: str,
    limit: StreamLimit,
    welcome: Callable[[], bool],
) -> Response:
    """The history behind `after_seq` and everything that follows until the job has ended or the server drains.

    A reader who knows the last event already gets 204, which tells an `EventSource` not to come back.

    Args:
        store: Where the job is.
        job_id: Which.
        tenant: Whose.
        after_seq: The last event that the reader knows.
        draining: Set when the server stops.
        reader: Under whose name the stream counts.
        limit: Counts streams.
        welcome: Whether the reader's key still holds; asked now and then.

    Raises:
        JobNotFound: There is no such job (before the stream begins).
    """
    job = store.get_job(job_id, tenant=tenant)
    first = store.events(job_id, tenant=tenant, after_seq=after_seq, limit=_BATCH)
    if job.state.terminal and not first:  # The job was read first, so its last event would be there.
        return Response(status_code=204)
    return _LimitedStream(
        _follow(store, job, after_seq, first, draining, welcome), partial(limit.hold, reader), send_timeout_s=_SEND_S
    )


class _LimitedStream(EventSourceResponse):
    """Counts as open from its first byte to its last, however it ends."""

    def __init__(
        self,
        events: AsyncIterator[ServerSentEvent],
        hold: Callable[[], AbstractContextManager[None]],
        *,
        send_timeout_s: float,
    ) -> None:
        # Without an event of its own and some grace, the library cuts streams off when the server stops.
        super().__init__(
            events,
            sep="\n",
            ping=15,
            send_timeout=send_timeout_s,
            shutdown_event=anyio.Event(),
            shutdown_grace_period=_GRACE_S,
        )
        self._hold = hold

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            with self._hold():
                await super().__call__(scope, receive, send)
        except TooManyStreams as error:
            await problems.of(scope, error)(scope, receive, send)


async def _follow(
    store: Store,
    job: Job,
    seq: int,
    events: list[Event],
    draining: threading.Event,
    welcome: Callable[[], bool],
) -> AsyncIterator[ServerSentEvent]:
    """The store is asked from the thread pool; the event loop only sleeps and sends.

    The job is always read before its events: what its state says has happened is then among the events.
    """
    polls = 0
    while True:
        for event in events:
            seq = event.seq
            yield _sse(event)
        # In the middle of the history of a job that was retried, such an event ends nothing.
        if events and ends_history(events[-1].kind) and len(events) < _BATCH:
            return
        # The reader knows the job's last event already.
        if job.state.terminal and not events:
            return
        if draining.is_set():
            return
        if len(events) < _BATCH:
            if polls % _POLLS_PER_PROGRESS == 0 and job.state is not JobState.QUEUED and not job.state.terminal:
                yield ServerSentEvent(event="progress", data=JobView.of(job).model_dump_json(), sep="\n")
            await anyio.sleep(_POLL_S)
        polls += 1
        try:
            if polls % _POLLS_PER_WELCOME == 0 and not await run_sync(welcome):
                return
            job = await run_sync(partial(store.get_job, job.id, tenant=job.tenant))
            events = await run_sync(partial(store.events, job.id, tenant=job.tenant, after_seq=seq, limit=_BATCH))
        except StoreUnavailable as error:
            _log.warning("event stream of %s ends: %s", job.id, error)
            return


def _sse(event: Event) -> ServerSentEvent:
    data: Any = EventView.of(event).model_dump_json()
    return ServerSentEvent(id=str(event.seq), event=event.kind, data=data, sep="\n")
