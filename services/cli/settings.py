"""Settings for commands that run parts of the service themselves: from the environment, overridden by options."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from services.settings import Settings

Database = Annotated[str | None, typer.Option("--database-url", help="sqlite:///... or postgresql+psycopg://...")]


def settings_from(**overrides: Any) -> Settings:
    """Settings from the environment (`VIPE_*`), overridden by what the command line names; logging as they say."""
    from services.observability.logging import configure_logging

    settings = read_settings(**overrides)
    configure_logging(settings.log_level, settings.log_format)
    return settings


def read_settings(**overrides: Any) -> Settings:
    """The same, and logging stays as it is."""
    from pydantic import ValidationError

    from services.settings import Settings

    try:
        return Settings(**{name: value for name, value in overrides.items() if value is not None})
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(map(str, first["loc"]))
        where = f"{name} (VIPE_{name.upper()}): " if name else ""
        raise typer.BadParameter(f"{where}{first['msg']}") from None
