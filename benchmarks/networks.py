"""Every adapter of a public network, run with its real architecture and random weights.

    python -m benchmarks.networks [NAME ...] [--vipe FOLDER] [--size production] [--device cuda]

Files of random weights are written as `vipectl models pull` would leave them, and each adapter opens and runs them as
the pipeline does, on small pictures of noise, which it enlarges as it does with any. The table has what came out, the
time of one call (CPU-seconds, on a GPU seconds), and why something was not run. What the answers say means nothing.

`--vipe` is an unpacked source distribution of nvidia-vipe for a machine where the package cannot be installed; what its
networks import must be (`pip install -e ".[hf,nvidia-vipe]"`). On a CPU, what is written there for CUDA alone is led to
the CPU, which only this command does. `--size production` takes the sizes that are pulled instead of the smallest, some
GB on disk and in memory. Networks of which no library is here are listed and left out. The exit status is 1 where an
adapter failed.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks.peers import vipe_networks
from benchmarks.peers.random_weights import Size, write
from vipe_core.ba.problem import Grid
from vipe_core.cameras import Camera
from vipe_core.errors import LibraryMissing
from vipe_core.pipeline.presets import GEOCALIB, NONE
from vipe_core.pipeline.providers import open_depth, open_priors
from vipe_core.priors.protocols import WorkingFrame
from vipe_core.priors.weights import folder_of, path_of

_WIDTH, _HEIGHT = 128, 96
_PHRASES = ("person", "car")


@dataclass(frozen=True, slots=True)
class Answer:
    """What an adapter made of its input.

    Attributes:
        given: What it was given.
        said: What it answered.
        seconds: Of the call.
    """

    given: str
    said: str
    seconds: float


class WrongAnswer(Exception):
    """The answer is not what the protocol promises."""


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(ADAPTERS)}; all if none is given")
    parser.add_argument("--vipe", type=Path, metavar="FOLDER")
    parser.add_argument("--size", choices=("small", "production"), default="small")
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args(argv)
    unknown = set(arguments.names) - set(ADAPTERS)
    if unknown:
        parser.error(f"no such network: {', '.join(sorted(unknown))}; there are {', '.join(ADAPTERS)}")
    if arguments.vipe is not None:
        vipe_networks.load(arguments.vipe)
    table = Table(show_edge=False, pad_edge=False, header_style="bold")
    for title in ("adapter", "architecture", "M parameters", "given", "answered", "s"):
        table.add_column(title, overflow="fold")
    failed = False
    for name in arguments.names or ADAPTERS:
        try:
            rows = run(name, arguments.size, torch.device(arguments.device))
        except LibraryMissing as error:
            rows = [(name, "not run", "", "", str(error), "")]
        except Exception as error:
            failed = True
            rows = [(name, "failed", "", "", f"{type(error).__name__}: {error}"[:300], "")]
        for row in rows:
            table.add_row(*row)
            print(*row, sep=" | ", file=sys.stderr, flush=True)
    Console(width=None if sys.stdout.isatty() else 200).print(table)
    return int(failed)


def run(name: str, size: Size, device: torch.device) -> list[tuple[str, str, str, str, str, str]]:
    """Rows of the table for an adapter.

    Raises:
        LibraryMissing: What it needs is not installed.
        WrongAnswer: It answers what it must not.
    """
    before = os.environ.get("VIPE_WEIGHTS")
    with tempfile.TemporaryDirectory(prefix="networks-") as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        os.environ["VIPE_WEIGHTS"] = folder
        try:
            with vipe_networks.led_to(device):
                architecture, parameters = write(name, size)
                answers = ADAPTERS[name](name, device)
        finally:
            if before is None:
                del os.environ["VIPE_WEIGHTS"]
            else:
                os.environ["VIPE_WEIGHTS"] = before
    millions = f"{parameters / 1e6:.1f}"
    return [(name, architecture, millions, one.given, one.said, f"{one.seconds:.1f}") for one in answers]


def _picture(seed: int = 0) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 255, (_HEIGHT, _WIDTH, 3), dtype=np.uint8)


def _timed(device: torch.device, call: Callable[[], Any]) -> tuple[Any, float]:
    """What a call gives, which lies on the host, and its seconds."""
    clock = time.perf_counter if device.type == "cuda" else time.process_time
    start = clock()
    found = call()
    return found, clock() - start


def _range(values: NDArray[Any], shape: tuple[int, ...], least: float) -> str:
    """How an answer is described.

    Raises:
        WrongAnswer: It has another shape, or numbers that cannot be.
    """
    if values.shape != shape or values.dtype != np.float32:
        raise WrongAnswer(f"{values.shape} of {values.dtype} instead of {shape} of float32")
    if not np.isfinite(values).all() or float(values.min()) < least:
        raise WrongAnswer(f"numbers that cannot be: {np.isfinite(values).mean():.1%} finite, least {values.min():.3g}")
    return f"{' x '.join(map(str, shape))}, {values.min():.4g} to {values.max():.4g}"


def _metric(name: str, device: torch.device) -> list[Answer]:
    provider = f"hf.{name}" if name.startswith("depth_") else f"nvidia_vipe.{name}"
    network = open_depth(NONE, provider, device).metric
    assert network is not None
    bent = 0.8 * _WIDTH
    cameras = {
        "pinhole": Camera.pinhole_from_fov(60, _WIDTH, _HEIGHT),
        "mei": Camera("mei", (bent, bent, _WIDTH / 2, _HEIGHT / 2, 0.5), _WIDTH, _HEIGHT),
    }
    if network.depth_kind == "ray":
        cameras["equirect"] = Camera("equirect", (), _WIDTH, _WIDTH // 2)
    answers = []
    for model, camera in cameras.items():
        rgb = np.ascontiguousarray(_picture()[: camera.height])
        found, seconds = _timed(device, partial(network.estimate, rgb, camera))
        said = _range(found.depth_m, (camera.height, camera.width), 0.0)
        if not found.confidence.any():
            raise WrongAnswer("no depth at all, as where a network says nothing that is a number")
        answers.append(Answer(f"{model} {_WIDTH} x {camera.height}", f"{said} m ({network.depth_kind})", seconds))
    return answers


def _geocalib(name: str, device: torch.device) -> list[Answer]:
    model = {provider.partition(".")[2]: camera for camera, provider in GEOCALIB.items()}[name]
    initial = open_priors("classical.dis_flow", "none", f"nvidia_vipe.{name}", model, device)().intrinsics
    frames = [WorkingFrame(k, _picture(k)[..., 0], _picture(k)) for k in range(5)]
    found, seconds = _timed(device, lambda: initial.estimate(frames, Grid(_HEIGHT // 8, _WIDTH // 8)))
    if found.camera.model != model or not np.isfinite(found.camera.params).all():
        raise WrongAnswer(f"{found.camera}")
    numbers = ", ".join(f"{value:.4g}" for value in found.camera.params)
    said = f"{model} ({numbers}), sigma of log f {found.log_focal_sigma:.3g}, {found.num_pairs} pictures"
    return [Answer(f"5 x {_WIDTH} x {_HEIGHT}", said, seconds)]


def _video_depth(name: str, device: torch.device) -> list[Answer]:
    from vipe_core.priors.nvidia_vipe.video_depth import VideoDepthAnything

    network = VideoDepthAnything.load(path_of(name), "vits", device)
    frames = [_picture(k) for k in range(3)]
    found, seconds = _timed(device, lambda: network.predict(frames))
    given = f"3 x {_WIDTH} x {_HEIGHT}, of {network.window_frames}"
    return [Answer(given, f"{_range(found, (3, _HEIGHT, _WIDTH), 0.0)} (inverse)", seconds)]


def _completion(name: str, device: torch.device) -> list[Answer]:
    from vipe_core.priors.nvidia_vipe.completion import PriorDa

    network = PriorDa.load(folder_of(name), device)
    rng = np.random.default_rng(0)
    depth = np.where(rng.random((_HEIGHT, _WIDTH)) < 0.05, rng.uniform(1, 5, (_HEIGHT, _WIDTH)), 0).astype(np.float32)
    camera = Camera.pinhole_from_fov(60, _WIDTH, _HEIGHT)
    found, seconds = _timed(device, lambda: network.complete(_picture(), depth, camera))
    if found.min() <= 0:
        raise WrongAnswer("depth that is not positive")
    given = f"{_WIDTH} x {_HEIGHT}, depth of {np.count_nonzero(depth)} pixels"
    return [Answer(given, _range(found, (_HEIGHT, _WIDTH), 0.0), seconds)]


def _detector(name: str, device: torch.device) -> list[Answer]:
    from vipe_core.priors.hf.grounding_dino import GroundingDino

    network = GroundingDino.load(folder_of(name), device)
    found, seconds = _timed(device, lambda: network.detect(_picture(), _PHRASES, 0.0))
    if not found or not all(0 <= one.score <= 1 and one.phrase in _PHRASES for one in found):
        raise WrongAnswer(f"{len(found)} boxes")
    best = max(one.score for one in found)
    return [Answer(f"{_WIDTH} x {_HEIGHT}, {len(_PHRASES)} phrases", f"{len(found)} boxes, score {best:.3g}", seconds)]


def _propagator(name: str, device: torch.device) -> list[Answer]:
    from vipe_core.priors.hf.sam2_video import Sam2Video

    propagation = Sam2Video.load(folder_of(name), device).begin()

    def follow() -> Any:
        propagation.advance(_picture(0))
        propagation.outline(np.array([[5.0, 5.0, 60.0, 60.0], [40.0, 20.0, 120.0, 90.0]]))
        propagation.add({2: 0, 5: 1})
        return [propagation.advance(_picture(k)).float().cpu().numpy() for k in (1, 2)][-1]

    found, seconds = _timed(device, follow)
    if propagation.ids != (2, 5):
        raise WrongAnswer(f"the ids {propagation.ids}")
    return [Answer(f"3 x {_WIDTH} x {_HEIGHT}, 2 boxes", f"{_range(found, (2, 256, 256), -np.inf)} (logits)", seconds)]


ADAPTERS: dict[str, Callable[[str, torch.device], list[Answer]]] = {
    "grounding_dino": _detector,
    "sam2_video": _propagator,
    "depth_anything_indoor": _metric,
    "depth_pro": _metric,
    "metric3d_small": _metric,
    "unidepth": _metric,
    "unik3d": _metric,
    "geocalib_pinhole": _geocalib,
    "geocalib_distorted": _geocalib,
    "video_depth_anything": _video_depth,
    "priorda": _completion,
}
"""Weights -> what opens and runs their adapter."""


if __name__ == "__main__":
    sys.exit(main())
