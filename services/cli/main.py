"""The command-line program. Each command imports what it needs when it runs, so that `--help` is instant."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from typing import Annotated, ParamSpec, TypeVar

import typer

from services.cli import annotate, data, demo, evaluate, export, gallery, jobs, keys, models, serve, tenants, warmup

P = ParamSpec("P")
R = TypeVar("R")

app = typer.Typer(
    name="vipectl",
    help="Camera poses, intrinsics and dense depth from any raw video: on this machine, or on a Ray cluster.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _version(show: bool) -> None:
    if show:
        from importlib.metadata import version

        typer.echo(f"vipectl {version('vipe-cluster')}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Camera poses, intrinsics and dense depth from any raw video."""


def _typed_errors(command: Callable[P, R]) -> Callable[P, R]:
    """The project's own errors become one line on stderr and exit code 1; others show their trace."""

    @wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        from services.client import ApiError
        from services.domain.errors import ServiceError
        from vipe_core.errors import VipeError

        try:
            return command(*args, **kwargs)
        except (VipeError, ServiceError, ApiError) as error:
            typer.echo(f"vipectl: {error} [{error.code}]", err=True)
            raise typer.Exit(1) from None
        except KeyboardInterrupt:
            raise typer.Exit(130) from None

    return run


_COMMANDS: dict[str, Callable[..., None]] = {
    "annotate": annotate.annotate,
    "demo": demo.demo,
    "eval": evaluate.evaluate,
    "up": serve.up,
    "api": serve.api,
    "agent": serve.agent,
    "submit": jobs.submit,
    "jobs": jobs.list_jobs,
    "status": jobs.status,
    "watch": jobs.watch,
    "videos": jobs.videos,
    "set": jobs.change,
    "pause": jobs.pause,
    "resume": jobs.resume,
    "cancel": jobs.cancel,
    "retry": jobs.retry,
    "tenants": tenants.tenants,
    "limit": tenants.limit,
    "verify": data.verify,
    "unpack": data.unpack,
    "export": export.export,
    "gallery": gallery.gallery,
    "warmup": warmup.warmup,
}
for _name, _command in _COMMANDS.items():
    app.command(_name)(_typed_errors(_command))

_keys = typer.Typer(help="API keys: create, list, revoke.", no_args_is_help=True, rich_markup_mode=None)
_KEY_COMMANDS: dict[str, Callable[..., None]] = {
    "create": keys.create,
    "list": keys.list_keys,
    "revoke": keys.revoke,
}
for _name, _command in _KEY_COMMANDS.items():
    _keys.command(_name)(_typed_errors(_command))
app.add_typer(_keys, name="keys")

_models = typer.Typer(help="Network weights: list, pull, verify, mirror.", no_args_is_help=True, rich_markup_mode=None)
_MODEL_COMMANDS: dict[str, Callable[..., None]] = {
    "list": models.list_models,
    "pull": models.pull,
    "verify": models.verify,
    "mirror": models.mirror,
}
for _name, _command in _MODEL_COMMANDS.items():
    _models.command(_name)(_typed_errors(_command))
app.add_typer(_models, name="models")

if __name__ == "__main__":
    sys.exit(app())
