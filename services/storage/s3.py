"""An object store in an S3 bucket, or in any service that speaks its protocol."""

from __future__ import annotations

import contextlib
import os
import random
import secrets
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import boto3
from boto3.exceptions import Boto3Error
from boto3.s3.transfer import TransferConfig
from botocore.config import Config
from botocore.exceptions import BotoCoreError, ClientError, NoCredentialsError, PartialCredentialsError
from botocore.exceptions import HTTPClientError as TransportError

from services.domain.errors import ConditionUnsupported, ObjectMissing, StorageError, StorageRefused
from services.storage.base import ObjectInfo
from services.storage.keys import TEMPORARY_PREFIX, check_key
from services.storage.observer import SilentObserver, StorageObserver

if TYPE_CHECKING:
    from mypy_boto3_s3 import S3Client

_PART_BYTES = 32 << 20
_BODY_TRIES = 4  # the client library retries requests, but not a body that breaks off
_CONFLICT_TRIES = 8
# How services answer that do not know `If-None-Match` on a write.
_NO_CONDITIONS = {400, 405, 501}
_ABSENT = {"404", "NoSuchKey", "NotFound"}
_DENIED = {"403", "AccessDenied", "AllAccessDisabled", "InvalidAccessKeyId", "SignatureDoesNotMatch"}
_OPERATIONS = {
    "PutObject": "put",
    "CreateMultipartUpload": "put",
    "UploadPart": "put",
    "CompleteMultipartUpload": "put",
    "AbortMultipartUpload": "put",
    "GetObject": "get",
    "HeadObject": "head",
    "ListObjectsV2": "list",
    "DeleteObject": "delete",
}


class S3Store:
    """Objects below `prefix` of a bucket. Implements `ObjectStore`; thread-safe.

    Credentials and region come from the usual places (environment, profile, instance role). Requests are retried by
    the client library with back-off, uploads carry a checksum that the server verifies, and larger files travel in
    parts. `create` is one PUT with `If-None-Match: *`.

    Args:
        endpoint_url: Another service than AWS; addressed by path, since few of them serve a name per bucket.
        max_attempts: Attempts per request, the first included.
    """

    def __init__(
        self,
        bucket: str,
        prefix: str = "",
        *,
        endpoint_url: str | None = None,
        connect_timeout_s: float = 10.0,
        read_timeout_s: float = 60.0,
        max_attempts: int = 6,
        max_concurrency: int = 8,
        part_bytes: int = _PART_BYTES,
        observer: StorageObserver | None = None,
    ) -> None:
        self._bucket = bucket
        self._prefix = prefix.strip("/")
        if self._prefix:
            check_key(self._prefix)
        self._observer: StorageObserver = observer or SilentObserver()
        self._transfer = TransferConfig(
            multipart_threshold=2 * part_bytes, multipart_chunksize=part_bytes, max_concurrency=max_concurrency
        )
        config = Config(
            retries={"mode": "standard", "total_max_attempts": max_attempts},
            connect_timeout=connect_timeout_s,
            read_timeout=read_timeout_s,
            max_pool_connections=max(10, 2 * max_concurrency),
            s3={"addressing_style": "path"} if endpoint_url else None,
            user_agent_extra="vipe-cluster",
        )
        with self._mapped("open", ""):
            # A session of our own: the default session of boto3 is not safe to use from several threads.
            self._client: S3Client = boto3.session.Session().client("s3", endpoint_url=endpoint_url, config=config)
        self._client.meta.events.register("response-received.s3", self._count)

    @property
    def uri(self) -> str:
        return f"s3://{self._bucket}/{self._prefix}" if self._prefix else f"s3://{self._bucket}"

    def put_file(self, key: str, path: Path) -> ObjectInfo:
        name = self._name(key)
        size_bytes = path.stat().st_size
        with self._mapped("put", key):
            self._client.upload_file(str(path), self._bucket, name, Config=self._transfer)
        self._observer.transferred("put", size_bytes)
        info = self.head(key)
        if info is None or info.size_bytes != size_bytes:
            raise StorageError(f"{self.uri}/{key} does not have the {size_bytes} bytes that were uploaded")
        return info

    def put_bytes(self, key: str, data: bytes) -> ObjectInfo:
        name = self._name(key)
        with self._mapped("put", key):
            answer = self._client.put_object(Bucket=self._bucket, Key=name, Body=data)
        self._observer.transferred("put", len(data))
        return ObjectInfo(key, len(data), _etag(answer))

    def create(self, key: str, data: bytes) -> bool:
        """See `ObjectStore.create`.

        Where the answer to the PUT is lost, the client library sends it again and is told 412 about its own object:
        False then means "there is an object", and the caller looks whether it is the one it wrote.

        Raises:
            ConditionUnsupported: The service refuses the condition.
        """
        name = self._name(key)
        for attempt in range(_CONFLICT_TRIES):
            try:
                with self._mapped("create", key):
                    self._client.put_object(Bucket=self._bucket, Key=name, Body=data, IfNoneMatch="*")
            except StorageError as error:
                status = _status(error.__cause__)
                if status == 412:
                    return False
                if status in _NO_CONDITIONS:
                    raise ConditionUnsupported(
                        f"create of {self.uri}/{key} was refused: the service does not know If-None-Match"
                    ) from error
                # 409: another conditional write of this key is under way. Only asking again tells who won.
                if status != 409 or attempt == _CONFLICT_TRIES - 1:
                    raise
                time.sleep(random.uniform(0, min(2.0, 0.05 * 2**attempt)))
            else:
                self._observer.transferred("create", len(data))
                return True
        raise StorageError(f"{self.uri}/{key} stayed contended; try again")

    def get_bytes(self, key: str, start: int = 0, length: int | None = None) -> bytes:
        if start < 0 or (length is not None and length < 0):
            raise ValueError(f"a range starts at 0 or later and is not negative, got {start}, {length}")
        if length == 0:  # HTTP has no empty range
            if self.head(key) is None:
                raise ObjectMissing(f"{self.uri}/{key} does not exist")
            return b""
        request: dict[str, Any] = {"Bucket": self._bucket, "Key": self._name(key)}
        if start or length is not None:
            request["Range"] = f"bytes={start}-" if length is None else f"bytes={start}-{start + length - 1}"
        for attempt in range(_BODY_TRIES):
            try:
                with self._mapped("get", key):
                    data = self._client.get_object(**request)["Body"].read()
            except StorageError as error:
                if _status(error.__cause__) == 416:  # the range begins behind the end
                    return b""
                if not isinstance(error.__cause__, (TransportError, OSError)) or attempt == _BODY_TRIES - 1:
                    raise
            else:
                self._observer.transferred("get", len(data))
                return data
        raise StorageError(f"{self.uri}/{key} could not be read")

    def download(self, key: str, path: Path) -> None:
        name = self._name(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.parent / f"{TEMPORARY_PREFIX}{os.getpid()}-{secrets.token_hex(8)}"
        try:
            with self._mapped("get", key):
                self._client.download_file(self._bucket, name, str(temporary), Config=self._transfer)
            with temporary.open("rb") as file:
                os.fsync(file.fileno())
            size_bytes = temporary.stat().st_size
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
        self._observer.transferred("get", size_bytes)

    def head(self, key: str) -> ObjectInfo | None:
        try:
            with self._mapped("head", key):
                answer = self._client.head_object(Bucket=self._bucket, Key=self._name(key))
        except ObjectMissing:
            return None
        return ObjectInfo(key, answer["ContentLength"], _etag(answer))

    def list(self, prefix: str = "") -> Iterator[ObjectInfo]:
        start = f"{self._prefix}/" if self._prefix else ""
        with self._mapped("list", prefix):
            pages = self._client.get_paginator("list_objects_v2").paginate(Bucket=self._bucket, Prefix=start + prefix)
            for page in pages:
                for entry in page.get("Contents", ()):
                    key = entry["Key"][len(start) :]
                    if key and not key.endswith("/"):  # a "folder" object that a console made
                        yield ObjectInfo(key, entry["Size"], entry["ETag"].strip('"'))

    def delete(self, key: str) -> None:
        with contextlib.suppress(ObjectMissing), self._mapped("delete", key):
            self._client.delete_object(Bucket=self._bucket, Key=self._name(key))

    def _name(self, key: str) -> str:
        check_key(key)
        return f"{self._prefix}/{key}" if self._prefix else key

    def _count(self, **event: Any) -> None:
        """Called by the client library for every answer, retries included."""
        operation = str(event.get("event_name", "")).rsplit(".", 1)[-1]
        answer = event.get("response_dict")
        status = str(answer["status_code"]) if answer else "error"
        self._observer.request(_OPERATIONS.get(operation, "other"), status)

    @contextlib.contextmanager
    def _mapped(self, op: str, key: str) -> Iterator[None]:
        """Turn the library's errors into ours. Messages name the object and the server's code, never a credential."""
        where = f"{self.uri}/{key}" if key else self.uri
        try:
            yield
        except ClientError as error:
            raise _refused(op, where, error) from error
        except (NoCredentialsError, PartialCredentialsError) as error:
            raise StorageRefused(f"no credentials for {where}; set AWS_ACCESS_KEY_ID or a profile or a role") from error
        except (BotoCoreError, Boto3Error) as error:
            # The transfer manager wraps the client's error; the reason is in the chain.
            if isinstance(error.__context__, ClientError):
                raise _refused(op, where, error.__context__) from error
            raise StorageError(f"{op} of {where} failed: {type(error).__name__}; is the endpoint reachable?") from error
        except OSError as error:
            raise StorageError(f"{op} of {where} failed: {os.strerror(error.errno or 0)}") from error
        except ValueError as error:
            raise StorageError(f"{op} of {where} failed: the address or the endpoint is not valid") from error


def _refused(op: str, where: str, error: ClientError) -> StorageError:
    code = str(error.response.get("Error", {}).get("Code", "unknown"))
    if code in _ABSENT:
        return ObjectMissing(f"{where} does not exist")
    if code == "NoSuchBucket":
        return StorageRefused(f"the bucket of {where} does not exist; create it or correct the address")
    if code in _DENIED:
        return StorageRefused(f"{op} of {where} is not allowed ({code}); check the credentials and their permissions")
    return StorageError(f"{op} of {where} was refused: {code}")


def _status(error: BaseException | None) -> int | None:
    if isinstance(error, ClientError):
        return error.response.get("ResponseMetadata", {}).get("HTTPStatusCode")
    return None


def _etag(answer: Any) -> str | None:
    tag = answer.get("ETag")
    return tag.strip('"') if tag else None
