"""What inputs may name, as the operator's settings say."""

from __future__ import annotations

import os
import stat
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path

from services.domain.errors import AddressRefused, InputUnavailable, InvalidRequest
from services.domain.redaction import redact
from services.network.addresses import NetworkPolicy, shown_url
from services.storage.roots import lies_within
from vipe_core.video.opened import opened_path

WEB_SCHEMES = ("http://", "https://")


@dataclass(frozen=True, slots=True)
class InputRules:
    """Where inputs may lie and how large they may be.

    Attributes:
        roots: Local inputs lie in or below one of these directories, links resolved; empty: anywhere.
        buckets: S3 buckets, `*` for any part of a name; empty: all.
        network: Hosts of `http(s)` inputs; without any there are no such inputs.
        max_file_bytes: Of one video, and of one manifest.
        max_rows: Of one manifest.
    """

    roots: tuple[Path, ...] = ()
    buckets: tuple[str, ...] = ()
    network: NetworkPolicy = field(default_factory=NetworkPolicy)
    max_file_bytes: int = 1 << 38
    max_rows: int = 10_000_000

    def check(self, uri: str) -> None:
        """Refuse what no listing or download could make right. Touches neither the network nor an object store.

        Raises:
            AddressRefused: A bucket, host or port that is not allowed, or a URL with credentials.
            InputUnavailable: A local path outside of the roots.
            InvalidRequest: No address at all.
        """
        if not uri.isprintable():
            raise InvalidRequest(f"the input {uri[:200]!a} holds characters that no address has")
        if uri.startswith("s3://"):
            check_bucket(uri, self.buckets)
        elif uri.startswith(WEB_SCHEMES):
            self.network.endpoint(uri)
            if redact(uri) != uri:
                raise AddressRefused(f"the URL {shown_url(uri)} holds credentials, and the address of an input is kept")
        elif not uri.startswith("/"):
            raise InvalidRequest(
                f"the input {uri[:200]!r} must be an absolute path, s3://bucket/key or http(s)://host/..."
            )
        elif not lies_within(uri, self.roots):
            raise InputUnavailable(f"input {uri} lies outside of the directories that this service may read")

    def open_local(self, path: str) -> int:
        """Open a regular file or a directory, judge where it lies, and give the descriptor.

        What was opened is judged, not its name: whoever puts a link in its place meanwhile gains nothing.

        Raises:
            InputUnavailable: It does not exist, cannot be read, lies outside of the roots, or is a pipe or a device.
        """
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else "no file has such a name"
            raise InputUnavailable(f"cannot read input {path}: {reason}") from error
        try:
            mode = os.fstat(descriptor).st_mode
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise InputUnavailable(f"input {path} is neither a file nor a directory")
            if not lies_within(opened_path(path, descriptor), self.roots):
                raise InputUnavailable(f"input {path} lies outside of the directories that this service may read")
        except BaseException:
            os.close(descriptor)
            raise
        return descriptor


def check_bucket(uri: str, allowed: tuple[str, ...]) -> None:
    """Raises AddressRefused if an `s3://` address names a bucket that is not allowed; none named: all are."""
    bucket = uri.removeprefix("s3://").partition("/")[0]
    if allowed and not any(fnmatchcase(bucket, pattern) for pattern in allowed):
        raise AddressRefused(f"the bucket {bucket!r} is not one of those that this service may use")
