"""A video and the same video backwards give the same path and camera, within twice the error that is asked of either.

    python -m benchmarks.reversal [SEQUENCE ...]

The two paths are compared after the least-squares Sim(3), in percent of the forward path, and the two fields of view
with each other. A sequence that no error is asked of has no limit.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import cv2
from rich.console import Console
from rich.table import Table

from benchmarks.sequences import DATA, BenchSequence, find_sequence
from vipe_core.errors import VipeError
from vipe_core.evaluation.metrics import camera_errors, trajectory_errors
from vipe_core.pipeline.annotator import Annotator
from vipe_core.video import open_source

_DEFAULT = ("room_handheld", "street_drive", "zoom_free_short")


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("sequences", nargs="*", default=_DEFAULT, metavar="SEQUENCE")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the shared data")
    arguments = parser.parse_args(argv)
    table = Table(title="Backwards against forwards")
    for heading in ("sequence", "frames", "ATE %", "rot deg", "FOV", "backwards", "apart", "asked: at most", "met"):
        table.add_column(heading, justify="left" if heading == "sequence" else "right")
    failed = 0
    for name in arguments.sequences:
        try:
            cells, met = _compare(find_sequence(name, arguments.data))
        except VipeError as error:
            failed += 1
            print(f"{name}: {error}", file=sys.stderr)
            continue
        failed += not met
        table.add_row(Path(name).name, *cells)
    Console(width=120).print(table)
    return 1 if failed else 0


def _compare(sequence: BenchSequence) -> tuple[list[str], bool]:
    """The row of a sequence, and whether it is within its limits."""
    annotator = Annotator(threads=1)
    forward = annotator.annotate(sequence.video)
    with tempfile.TemporaryDirectory(prefix="vipe-backwards-") as folder:
        _write_backwards(sequence.video, Path(folder))
        backward = annotator.annotate(folder, name="backwards")
    path = trajectory_errors(backward.world_from_cam[::-1], forward.world_from_cam)
    lens = camera_errors(backward.camera, forward.camera)
    apart_deg = None if lens is None else lens.fov_x_deg
    asked = [
        ("ATE {:.3g}%", path.ate_percent, sequence.limit.ate_percent),
        ("FOV {:.3g}", apart_deg, sequence.limit.fov_deg),
    ]
    limits = [(text.format(2 * most), value, 2 * most) for text, value, most in asked if most is not None]
    met = all(value is not None and value <= most for _, value, most in limits)
    cells = [
        str(forward.num_frames),
        "-" if path.ate_percent is None else f"{path.ate_percent:.3f}",
        f"{path.rotation_rmse_deg:.3f}",
        f"{forward.camera.fov_x_deg:.2f}",
        f"{backward.camera.fov_x_deg:.2f}",
        "-" if apart_deg is None else f"{apart_deg:.2f}",
        ", ".join(text for text, _, _ in limits),
        "" if not limits else "yes" if met else "no",
    ]
    return cells, met


def _write_backwards(video: Path, folder: Path) -> None:
    """The frames as images whose names sort them backwards, without loss."""
    with closing(open_source(video).frames()) as frames:
        for frame in frames:
            path = folder / f"{999_999 - frame.index:06d}.png"
            cv2.imwrite(str(path), cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    raise SystemExit(main())
