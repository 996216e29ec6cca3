"""What a job may take its videos from, and how a worker gets them."""

from __future__ import annotations
