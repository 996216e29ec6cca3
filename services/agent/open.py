"""From settings to an agent that is ready to start."""

from __future__ import annotations

from typing import TYPE_CHECKING

from services.agent.agent import Agent
from services.agent.config import config_from_settings
from services.agent.ray_executor import RayExecutor
from services.observability.metrics import Metrics
from services.store.base import Store

if TYPE_CHECKING:
    from services.settings import Settings


def open_agent(store: Store, settings: Settings, metrics: Metrics) -> Agent:
    """An agent on Ray: a private one, or the cluster at `settings.ray_address`. Nothing is started yet.

    Args:
        store: Closed by the caller, after `Agent.stop`.
    """
    config = config_from_settings(settings)
    return Agent(store, config, RayExecutor(config), metrics)
