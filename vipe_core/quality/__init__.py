"""What the engine thinks of its own result."""

from vipe_core.quality.verdict import assess

__all__ = ["assess"]
