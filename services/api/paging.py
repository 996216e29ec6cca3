"""Opaque page tokens: a cursor and the list that it belongs to."""

from __future__ import annotations

import base64
import binascii
import json

from services.domain.errors import InvalidPageToken


def token(cursor: str | None, *, of: str) -> str | None:
    """The token of the page behind `cursor` in the list named `of`; None for no page."""
    if cursor is None:
        return None
    return base64.urlsafe_b64encode(json.dumps([of, cursor]).encode()).decode().rstrip("=")


def cursor(page_token: str | None, *, of: str) -> str | None:
    """The cursor in a token.

    Raises:
        InvalidPageToken: It was not given out for this list.
    """
    if page_token is None:
        return None
    try:
        padded = page_token + "=" * (-len(page_token) % 4)
        decoded = json.loads(base64.b64decode(padded, altchars=b"-_", validate=True))
    except (ValueError, binascii.Error):
        decoded = None
    match decoded:
        case [str(owner), str(position)] if owner == of and _storable(position):
            return position
    raise InvalidPageToken("this page_token was not given out for this list; start again without one")


def _storable(position: str) -> bool:
    """Whether a database can compare with it: JSON can spell NUL and halves of surrogate pairs, text columns cannot."""
    return "\x00" not in position and not any("\ud800" <= char <= "\udfff" for char in position)
