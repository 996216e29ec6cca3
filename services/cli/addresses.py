"""Addresses as a user types them."""

from __future__ import annotations

from pathlib import Path


def absolute(text: str) -> str:
    """Local paths become absolute, so that the service reads the same file; addresses with a scheme stay."""
    return text if "://" in text else str(Path(text).expanduser().resolve())
