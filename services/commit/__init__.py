"""Shard tars and the commit protocol: exactly one whole result per shard, whatever crashes."""

from __future__ import annotations

from services.commit.gc import GcReport, collect_garbage
from services.commit.layout import ATTRIBUTES, attributes_of, commit_key, payload_key
from services.commit.plan import PlanHead, publish_plan, read_plan
from services.commit.protocol import (
    CommitOutcome,
    PreparedPayload,
    prepare_payload,
    tar_names,
    write_decided,
    write_record,
)
from services.commit.reconcile import committed_record, committed_records, stored_records

__all__ = [
    "ATTRIBUTES",
    "CommitOutcome",
    "GcReport",
    "PlanHead",
    "PreparedPayload",
    "attributes_of",
    "collect_garbage",
    "commit_key",
    "committed_record",
    "committed_records",
    "payload_key",
    "prepare_payload",
    "publish_plan",
    "read_plan",
    "stored_records",
    "tar_names",
    "write_decided",
    "write_record",
]
