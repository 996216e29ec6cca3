"""What a key may look like, the same for every store: a key that works in a directory works in S3 and the reverse."""

from __future__ import annotations

from services.domain.errors import StorageRefused

TEMPORARY_PREFIX = ".vipe-tmp-"
_MAX_KEY_BYTES = 1024  # the limit of S3
_MAX_SEGMENT_BYTES = 255  # the limit of common file systems


def check_key(key: str) -> str:
    """Return `key` if it is a relative `/`-separated path that stays below the root.

    Raises:
        StorageRefused: Empty, absolute, too long, with an empty, `.` or `..` segment, a backslash, a control character,
            or a segment that is reserved for temporary files.
    """
    if not key or len(key.encode("utf-8", "surrogatepass")) > _MAX_KEY_BYTES:
        raise StorageRefused(f"object key {key[:80]!r} must have 1 to {_MAX_KEY_BYTES} bytes")
    if "\\" in key or any(ord(c) < 32 or ord(c) == 127 or 0xD800 <= ord(c) <= 0xDFFF for c in key):
        raise StorageRefused(f"object key {key!r} holds a backslash, a control character or a lone surrogate")
    for segment in key.split("/"):
        if segment in ("", ".", ".."):
            raise StorageRefused(f"object key {key!r} is not a plain relative path")
        if segment.startswith(TEMPORARY_PREFIX) or len(segment.encode()) > _MAX_SEGMENT_BYTES:
            raise StorageRefused(f"object key {key!r} has a segment that is reserved or too long")
    return key
