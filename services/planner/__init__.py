"""From inputs to videos to shards, in bounded memory, with the same result after a crash."""

from __future__ import annotations

from services.planner.planning import CLAIM_KEY, Turn, plan, plan_next, write_plan

__all__ = ["CLAIM_KEY", "Turn", "plan", "plan_next", "write_plan"]
