"""Whether a job may have the webhook that it asks for."""

from __future__ import annotations

import ipaddress

from services.domain.control import JobControl
from services.domain.errors import AddressRefused, InvalidRequest
from services.settings import Settings


def check_webhook(control: JobControl, tenant: str, settings: Settings) -> None:
    """Refuse at once what would be refused when the first event is sent.

    Raises:
        AddressRefused: The URL must not be contacted.
        InvalidRequest: There is no such secret.
    """
    if control.webhook_url is None:
        return
    policy = settings.webhook_policy()
    endpoint = policy.endpoint(control.webhook_url)
    try:
        reason = policy.refusal(ipaddress.ip_address(endpoint.host))
    except ValueError:
        reason = None  # A name: its addresses are checked whenever something is sent there.
    if reason is not None:
        raise AddressRefused(f"the webhook's address {endpoint.host} is {reason}; it is not allowed")
    if f"{tenant}/{control.webhook_secret}" not in settings.webhook_secrets:
        raise InvalidRequest(f"the settings hold no webhook secret {control.webhook_secret!r} of this tenant")
