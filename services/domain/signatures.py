"""The signature of what a webhook is sent: HMAC-SHA256 over the time of sending and the body.

    Vipe-Signature: t=<seconds since 1970>,v1=<hex>        hex = HMAC-SHA256(secret, "<t>." + body)

The time is signed too, so a message that somebody recorded is worth nothing once it is older than the receiver allows.
"""

from __future__ import annotations

import hashlib
import hmac

SIGNATURE_HEADER = "Vipe-Signature"
EVENT_ID_HEADER = "Vipe-Event-Id"


def sign(body: bytes, secret: str, at_s: int) -> str:
    """The value of `Vipe-Signature`."""
    return f"t={at_s},v1={_digest(body, secret, at_s)}"


def is_signed(body: bytes, header: str, secret: str, now_s: float, tolerance_s: float) -> bool:
    """Whether a body was signed with the secret, not longer ago (or ahead) than the tolerance."""
    parts = dict(part.strip().partition("=")[::2] for part in header.split(","))
    stamp, given = parts.get("t", ""), parts.get("v1", "")
    if not stamp.isascii() or not stamp.isdigit() or len(stamp) > 15 or not given.isascii():
        return False
    fresh = abs(now_s - int(stamp)) <= tolerance_s
    return hmac.compare_digest(given, _digest(body, secret, int(stamp))) and fresh


def _digest(body: bytes, secret: str, at_s: int) -> str:
    return hmac.new(secret.encode(), f"{at_s}.".encode() + body, hashlib.sha256).hexdigest()
