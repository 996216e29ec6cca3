"""For the receiver of a job's events: is this message from the service, and was it seen before?

The service sends every event at least once; a repetition has the same `id`. Answer with a 2xx status once the event is
kept, within ten seconds; anything else, and it is sent again.
"""

from __future__ import annotations

import json
import time
from typing import Any

from services.domain.signatures import EVENT_ID_HEADER, SIGNATURE_HEADER, is_signed

__all__ = ["EVENT_ID_HEADER", "SIGNATURE_HEADER", "ForgedWebhook", "verify_webhook"]


class ForgedWebhook(Exception):
    """The message does not come from the service, or is too old."""


def verify_webhook(
    body: bytes, signature: str, secret: str, *, tolerance_s: float = 300.0, now_s: float | None = None
) -> dict[str, Any]:
    """Check a message and read it.

    Args:
        body: The request's body as it came, not parsed and written again.
        signature: The request's `Vipe-Signature` header.
        secret: The secret that the job names.
        tolerance_s: Oldest message that is believed.
        now_s: Seconds since 1970; default: now.

    Returns:
        `{"id", "seq", "job_id", "tenant", "at", "kind", "data"}`; keep the ids, to leave out what comes twice.

    Raises:
        ForgedWebhook: The signature is wrong or too old.
    """
    if not is_signed(body, signature, secret, time.time() if now_s is None else now_s, tolerance_s):
        raise ForgedWebhook("the webhook's signature is wrong or too old")
    message: dict[str, Any] = json.loads(body)
    return message
