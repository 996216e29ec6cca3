"""Data sets: index and describe what a job committed, check it, read it, unpack it."""

from __future__ import annotations

from services.dataset.finalise import Totals, finalise
from services.dataset.index import DatasetIndex
from services.dataset.reader import Sample, iterate, read_one
from services.dataset.unpack import Unpacked, unpack
from services.dataset.verify import Report, verify

__all__ = [
    "DatasetIndex",
    "Report",
    "Sample",
    "Totals",
    "Unpacked",
    "finalise",
    "iterate",
    "read_one",
    "unpack",
    "verify",
]
