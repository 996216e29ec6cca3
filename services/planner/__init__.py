"""From inputs to videos to shards, in bounded memory, with the same result after a crash."""

from __future__ import annotations

from services.planner.planning import Turn, plan, plan_next

__all__ = ["Turn", "plan", "plan_next"]
