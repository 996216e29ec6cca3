"""Options that several commands hand to the engine, said the same way in each."""

from __future__ import annotations

from typing import Annotated

import typer

PRESET_HELP = (
    "classical; classical_fast: coarser dense depth; wide_angle: a bent lens; panorama: 360 degrees; "
    "vipe_fast, pose_only: by the DROID network; vipe: all of the paper's networks (vipectl models)."
)
DEVICE_HELP = "cpu or cuda."

Preset = Annotated[str, typer.Option(help=PRESET_HELP)]
Device = Annotated[str, typer.Option(help=DEVICE_HELP)]
CameraModel = Annotated[
    str | None,
    typer.Option(help="pinhole, mei (wide angle), equirect (360 degrees), or auto. Default: the preset's own."),
]
DetectionInterval = Annotated[
    float | None, typer.Option(metavar="SECONDS", help="Time between looks for new things. Default: 2.")
]


def listed(text: str) -> list[str]:
    """The items of a list like `a,b`."""
    return [item.strip() for item in text.split(",") if item.strip()]
