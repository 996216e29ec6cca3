"""Text without credentials, for everything that is written down or sent out: logs, errors, the database."""

from __future__ import annotations

import re

_SECRETS = (
    # user:password@ in an address
    (re.compile(r"(?P<keep>[a-z][a-z0-9+.-]*://[^\s/:@]+:)[^\s/@]+(?=@)", re.IGNORECASE), r"\g<keep>***"),
    # name=value, name: value, "name": "value"
    (
        re.compile(
            r"(?P<keep>(?:password|passwd|secret|secret_access_key|token|api[_-]?key|signature|\bsig"
            r"|x-(?:amz|goog)-credential|awsaccesskeyid|key-pair-id)[\"']?\s*[=:]\s*[\"']?)[^\s\"'&,;]+",
            re.IGNORECASE,
        ),
        r"\g<keep>***",
    ),
    (
        re.compile(r"(?P<keep>authorization[\"']?\s*[=:]\s*[\"']?(?:bearer\s+|basic\s+)?)[^\s\"',;]+", re.IGNORECASE),
        r"\g<keep>***",
    ),
    (re.compile(r"(?P<keep>bearer\s+)[a-z0-9._~+/=-]{8,}", re.IGNORECASE), r"\g<keep>***"),
    # our own keys, of which the id may be told
    (re.compile(r"(?P<keep>vipe_[a-z2-7]{12}_)[a-z2-7]+"), r"\g<keep>***"),
    # access key ids
    (re.compile(r"\b(?:AKIA|ASIA)[A-Z0-9]{16}\b"), "***"),
)


def redact(text: str) -> str:
    """The text without passwords, tokens, signatures and access keys."""
    for pattern, replacement in _SECRETS:
        text = pattern.sub(replacement, text)
    return text
