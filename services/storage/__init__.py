"""Object stores: one interface for a directory and for S3."""

from __future__ import annotations

from services.storage.base import ObjectInfo, ObjectStore
from services.storage.directory import DirectoryStore
from services.storage.object_file import open_object
from services.storage.observer import StorageObserver
from services.storage.open import open_store, supports_create_once
from services.storage.s3 import S3Store

__all__ = [
    "DirectoryStore",
    "ObjectInfo",
    "ObjectStore",
    "S3Store",
    "StorageObserver",
    "open_object",
    "open_store",
    "supports_create_once",
]
