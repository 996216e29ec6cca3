"""API keys as text, and the hash that is kept of them.

A key is `vipe_<id>_<secret>`: the id is public and finds the key's row, the secret is 256 random bits that are shown
once. What is kept is its scrypt hash (RFC 7914) as `scrypt$<log2 n>$<r>$<p>$<salt>$<hash>`, so that the cost can be
raised later without making old keys invalid.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import re
import secrets

_LOG2_N, _R, _P = 14, 8, 1  # 16 MiB and some tens of milliseconds
_KEY = re.compile(r"vipe_([a-z2-7]{12})_([a-z2-7]{52})")


def new_key() -> tuple[str, str]:
    """A key's public id, and the key itself."""
    key_id = _base32(secrets.token_bytes(8))[:12]
    return key_id, f"vipe_{key_id}_{_base32(secrets.token_bytes(32))}"


def key_id_of(key: str) -> str | None:
    """The public id in a key; None for what cannot be a key."""
    found = _KEY.fullmatch(key)
    return None if found is None else found[1]


def hash_key(key: str) -> str:
    """What is kept of a key."""
    salt = secrets.token_bytes(16)
    return f"scrypt${_LOG2_N}${_R}${_P}${salt.hex()}${_scrypt(key, salt, _LOG2_N, _R, _P).hex()}"


def matches(key: str, kept: str) -> bool:
    """Whether `kept` is the hash of this key, in constant time."""
    _, log2_n, r, p, salt, digest = kept.split("$")
    return hmac.compare_digest(_scrypt(key, bytes.fromhex(salt), int(log2_n), int(r), int(p)), bytes.fromhex(digest))


def _scrypt(key: str, salt: bytes, log2_n: int, r: int, p: int) -> bytes:
    n = 1 << log2_n
    return hashlib.scrypt(key.encode(), salt=salt, n=n, r=r, p=p, maxmem=256 * n * r, dklen=32)


def _base32(data: bytes) -> str:
    return base64.b32encode(data).decode().rstrip("=").lower()
