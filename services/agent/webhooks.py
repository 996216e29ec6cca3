"""Sends the events of jobs to their webhooks: signed, at least once, to public addresses only.

Agents send, because they run all the time and hold nothing that a request could reach. Several may do it side by side:
each event is with one of them at a time (see `services.store.outbox`).
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor

from pydantic import SecretStr

from services.agent.backoff import Backoff, exponential_s
from services.domain.control import Delivery
from services.domain.errors import ServiceError
from services.domain.signatures import EVENT_ID_HEADER, SIGNATURE_HEADER, sign
from services.network import GuardedHttp, NetworkPolicy
from services.observability.metrics import Metrics
from services.store.base import Store

logger = logging.getLogger(__name__)

_AT_ONCE = 4
_BATCH = 16
_TIMEOUT_S = 10.0
_TTL_S = 2 * _TIMEOUT_S * _BATCH / _AT_ONCE
_BASE_S = 5.0
_MAX_S = 3600.0
_MAX_ATTEMPTS = 60  # Over a day or so.


class WebhookSender:
    """Takes what is due and sends it.

    Args:
        secrets: `tenant/name` -> secret.
        policy: Where messages may go.
    """

    def __init__(self, store: Store, secrets: Mapping[str, SecretStr], policy: NetworkPolicy, metrics: Metrics) -> None:
        self._store = store
        self._secrets = secrets
        self._metrics = metrics
        self._http = GuardedHttp(policy, connect_timeout_s=_TIMEOUT_S / 2, read_timeout_s=_TIMEOUT_S / 2)

    def run(self, stopping: threading.Event, poll_s: float) -> None:
        """Send until told to stop. Never raises."""
        trouble = Backoff(1.0, 60.0)
        with self._http, ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="agent-webhook") as threads:
            while not stopping.is_set():
                try:
                    sent = self.send_due(threads)
                except Exception as error:
                    logger.warning("could not send webhooks: %s", error)
                    stopping.wait(trouble.failed())
                    continue
                trouble.succeeded()
                if not sent:
                    stopping.wait(poll_s)

    def send_due(self, threads: ThreadPoolExecutor) -> int:
        """Send one batch; how many were due."""
        due = self._store.take_deliveries(limit=_BATCH, ttl_s=_TTL_S)
        list(threads.map(self._send, due))
        return len(due)

    def _send(self, delivery: Delivery) -> None:
        error = self._error(delivery)
        retry_in_s: float | None = None
        if error is None:
            result = "delivered"
        elif delivery.attempt >= _MAX_ATTEMPTS:
            result = "abandoned"
            logger.error("gave up sending %s of %s: %s", delivery.event_id, delivery.job_id, error)
        else:
            result = "failed"
            retry_in_s = _jittered_s(delivery.attempt)
            logger.warning(
                "%s of %s was not taken, next try in %.0f s: %s",
                delivery.event_id,
                delivery.job_id,
                retry_in_s,
                error,
            )
        self._metrics.webhook_deliveries.labels(result=result).inc()
        self._store.settle_delivery(delivery, error=error, retry_in_s=retry_in_s)

    def _error(self, delivery: Delivery) -> str | None:
        """Send one event; None if it was taken."""
        secret = self._secrets.get(f"{delivery.tenant}/{delivery.secret}")
        if secret is None:
            return f"the settings hold no webhook secret {delivery.secret!r} of tenant {delivery.tenant!r}"
        headers = {
            "Content-Type": "application/json",
            EVENT_ID_HEADER: delivery.event_id,
            SIGNATURE_HEADER: sign(delivery.body, secret.get_secret_value(), int(time.time())),
        }
        try:
            with self._http.open("POST", delivery.url, headers=headers, content=delivery.body) as answer:
                if 200 <= answer.status < 300:
                    return None
                return f"it answered with status {answer.status}"
        except ServiceError as error:
            return f"{error} [{error.code}]"


def _jittered_s(failures: int) -> float:
    """Full jitter, so that what a receiver missed while it was down does not come back all at once."""
    return Backoff(exponential_s(failures - 1, _BASE_S, _MAX_S), _MAX_S).failed()
