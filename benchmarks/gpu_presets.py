"""Presets on a GPU against themselves on the CPU: `python -m benchmarks.gpu_presets [CASE ...]`.

Where there is no GPU, one is claimed (`claimed_gpu`). Tiny clips through the whole engine, dense depth included:
`vipe_fast` with a bent lens; `vipe`, the paper's, where stand-ins with the signatures of nvidia-vipe take the place of
its networks, and GroundingDINO and SAM 2 are of the real architecture with a few layers; the classical preset for a
camera, for a panorama and for a rig, whose bundle adjustment alone is on a GPU. Weights are random. A mixture of
devices ends a case with the line that made it; poses and depths must be those of the CPU but for rounding, which
decides little in so short a clip. Exit status 1 if not.
"""

from __future__ import annotations

import argparse
import importlib
import math
import os
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.claimed_gpu import claimed_gpu
from vipe_core.annotation import Annotation
from vipe_core.cameras import Camera
from vipe_core.cameras.calibration import Calibration
from vipe_core.cameras.rig import Rig, RigView
from vipe_core.evaluation.synthetic.clip import SyntheticClip, render_rig, tiny_clip
from vipe_core.evaluation.synthetic.paths import look_at, through
from vipe_core.evaluation.synthetic.scenes import room_scene
from vipe_core.pipeline import annotator, providers
from vipe_core.pipeline.annotator import Annotator
from vipe_core.pipeline.presets import VIDEO_DEPTH, Preset, resolve
from vipe_core.pipeline.rig_annotator import RigAnnotator
from vipe_core.priors.droid import DroidNetwork
from vipe_core.priors.instance_settings import InstanceSettings
from vipe_core.priors.instances import FollowedInstances
from vipe_core.priors.protocols import DepthFamily, InstanceMasks, MetricDepth
from vipe_core.priors.rectified import Rectified

_TESTS = Path(__file__).parents[1] / "tests" / "priors"
_WIDTH, _HEIGHT, _FRAMES = 96, 64, 7
# Entries of poses, share of a depth, share of pixels. Networks round to half precision there.
_MOST_APART = {"classical": 1e-3, "networks": 0.05}


class _GeoCalib(nn.Module):
    """Sixty degrees."""

    def calibrate(self, img: Tensor, **_: Any) -> dict[str, Any]:
        focal_px = torch.full((len(img), 2), img.shape[-2] / (2 * math.tan(math.radians(30))), device=img.device)
        camera = SimpleNamespace(vfov=torch.full((1,), math.radians(60), device=img.device), f=focal_px)
        return {"camera": camera, "focal_uncertainty": 0.05 * focal_px[:, 1]}


class _Metric3d:
    """Darker is farther."""

    def inference(self, data: dict[str, Tensor]) -> tuple[Tensor, Tensor, dict[str, Any]]:
        depth = 5 - data["input"].mean(dim=1, keepdim=True)
        return depth, torch.ones_like(depth), {}


class _VideoDepth:
    """Brighter is nearer."""

    def __call__(self, pictures: Tensor) -> Tensor:
        return pictures.mean(dim=2) + 3


class _PriorDa:
    """The mean of what is known."""

    def infer_one_sample(self, image: Tensor, prior: Tensor) -> Tensor:
        known = prior > 0
        return torch.where(known, prior, prior.sum() / known.sum())


def _video_depth(device: torch.device) -> DepthFamily:
    from vipe_core.priors.nvidia_vipe.completion import PriorDa
    from vipe_core.priors.nvidia_vipe.video_depth import VideoDepthAnything

    video = VideoDepthAnything(_VideoDepth(), device, shortest=56)
    return DepthFamily(video=video, completion=PriorDa(_PriorDa(), device))


def _metric_depth(device: torch.device) -> MetricDepth:
    from vipe_core.priors.nvidia_vipe.metric_depth import Metric3d

    return Rectified(Metric3d(_Metric3d(), device, size=(112, 84)))


def _masks(settings: InstanceSettings, device: torch.device) -> InstanceMasks:
    from vipe_core.priors.hf.grounding_dino import GroundingDino
    from vipe_core.priors.hf.sam2_video import Sam2Video

    tiny: Any = importlib.import_module("tiny_networks")
    with tempfile.TemporaryDirectory() as folder:
        tiny.write_words(Path(folder))
        words = importlib.import_module("transformers").AutoTokenizer.from_pretrained(folder)
    detector = GroundingDino(tiny.grounding_dino().to(device), words, device, 64, 96)
    # Every box is taken: the network means nothing.
    settings = replace(settings, phrases=("person", "car"), min_score=0.0)
    return FollowedInstances(detector, Sam2Video(tiny.sam2_video().to(device), device), settings, (96, 64))


@contextmanager
def _stand_ins() -> Iterator[None]:
    """In the places of the networks of `vipe`."""
    from vipe_core.priors.nvidia_vipe import geocalib

    load = geocalib.GeoCalibInit

    def calibrated(path: Path, camera: str, device: torch.device) -> geocalib.GeoCalibInit:
        return load(_GeoCalib().to(device), camera, device)

    with ExitStack() as stack:
        stack.enter_context(patch.object(sys, "path", [*sys.path, str(_TESTS)]))
        stack.enter_context(patch.object(annotator, "require_libraries"))
        stack.enter_context(patch.object(annotator, "require_all", lambda names: dict.fromkeys(names, "")))
        stack.enter_context(patch.object(geocalib.GeoCalibInit, "load", calibrated))
        stack.enter_context(patch.dict(providers._DEPTH, {VIDEO_DEPTH: _video_depth}))
        stack.enter_context(patch.dict(providers._METRIC, {resolve("vipe").metric: _metric_depth}))
        stack.enter_context(patch.dict(providers._MASKS, {resolve("vipe").masks: _masks}))
        yield


def _short(preset: Preset) -> Preset:
    """With a schedule of few updates, for small pictures."""
    schedule = replace(
        preset.slam.refinement, first_updates=2, updates=1, more_updates=1, global_updates=(1, 1, 2), fill_updates=2
    )
    slam = replace(preset.slam, working_area_px=_WIDTH * _HEIGHT, refinement=schedule, backend_at=())
    return replace(preset, slam=slam)


def _written(clip: SyntheticClip, folder: Path) -> Path:
    folder.mkdir()
    for index, rgb in enumerate(clip.rgb):
        cv2.imwrite(str(folder / f"{index:04d}.png"), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    return folder


def _single(preset: str, camera: str | None, device: str, folder: Path) -> list[Annotation]:
    clip = folder / "clip"
    if not clip.is_dir():
        model: Any = "equirect" if preset == "panorama" else "pinhole"
        size = (2 * _HEIGHT, _HEIGHT) if model == "equirect" else (_WIDTH, _HEIGHT)
        _written(tiny_clip("sideways", _FRAMES, *size, model=model), clip)
    return [Annotator(_short(resolve(preset, camera)), device=device).annotate(clip)]


def _rig(device: str, folder: Path) -> list[Annotation]:
    camera = Camera.pinhole_from_fov(70.0, _WIDTH, _HEIGHT)
    right = np.eye(4)
    right[0, 3] = 0.15
    mounts = [np.eye(4), right]
    poses = look_at(through([(4.4, 1.0, 1.35), (3.75, 1.3, 1.3)], _FRAMES), np.array([3.0, 2.5, 0.8]))
    clips = render_rig(room_scene(), [camera, camera], mounts, poses)
    videos: list[str | Path | Any] = []
    for number, clip in enumerate(clips):
        place = folder / str(number)
        videos.append(place if place.is_dir() else _written(clip, place))
    views = tuple(RigView(str(k), mount, Calibration(camera)) for k, mount in enumerate(mounts))
    return list(RigAnnotator(device=device).annotate_rig(Rig(views, metric=True), videos).views)


CASES: dict[str, Callable[[str, Path], list[Annotation]]] = {
    "vipe_fast": lambda device, folder: _single("vipe_fast", "mei", device, folder),
    "vipe": lambda device, folder: _single("vipe", None, device, folder),
    "classical": lambda device, folder: _single("classical_fast", None, device, folder),
    "panorama": lambda device, folder: _single("panorama", None, device, folder),
    "rig": _rig,
}


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"of {', '.join(CASES)}; all if none is given")
    arguments = parser.parse_args(argv)
    unknown = set(arguments.cases) - set(CASES)
    if unknown:
        parser.error(f"no such case: {', '.join(sorted(unknown))}; there are {', '.join(CASES)}")
    failed = False
    with tempfile.TemporaryDirectory(prefix="vipe-presets-") as weights, _stand_ins():
        torch.save(DroidNetwork.random(1).state_dict(), Path(weights) / "droid.pth")
        os.environ["VIPE_WEIGHTS"] = weights
        for name in arguments.cases or CASES:
            start_s = time.process_time()
            try:
                said, agreed = _compared(name)
            except Exception:
                said, agreed = f"failed\n{traceback.format_exc()}", False
            failed |= not agreed
            print(f"{name}: {said} ({time.process_time() - start_s:.0f} CPU-s)", flush=True)
    return int(failed)


def _compared(name: str) -> tuple[str, bool]:
    """What a case gave, and whether it is what the CPU gives."""
    most = _MOST_APART["networks" if name.startswith("vipe") else "classical"]
    with tempfile.TemporaryDirectory(prefix="vipe-preset-") as folder:
        expected = _annotated(name, "cpu", Path(folder))
        with nullcontext() if torch.cuda.is_available() else claimed_gpu() as gpu:
            found = _annotated(name, "cuda", Path(folder))
    apart = {"poses": 0.0, "depth": 0.0, "masks": 0.0}
    for (here, depths, masks), (there, other_depths, other_masks) in zip(expected, found, strict=True):
        # What random networks see is mostly a turn on the spot.
        moved = np.abs(here.world_from_cam - there.world_from_cam)
        moved[:, :3, 3] /= max(1.0, float(np.ptp(here.world_from_cam[:, :3, 3], axis=0).max()))
        both = (depths > 0) & (other_depths > 0)
        ratio = np.abs(np.log(depths[both] / other_depths[both])) if both.any() else np.zeros(1)
        apart["poses"] = max(apart["poses"], float(moved.max()))
        apart["depth"] = max(apart["depth"], float(np.median(ratio)))
        apart["masks"] = max(apart["masks"], float((masks != other_masks).mean()))
    same = all(np.array_equal(a[0].keyframes, b[0].keyframes) for a, b in zip(expected, found, strict=True))
    said = ", ".join(f"{what} {value:.1e} apart" for what, value in apart.items())
    kinds = f"{expected[0][0].scale}, {len(np.unique(expected[0][2]))} ids"
    if gpu is not None:
        waits = sum(count for place, count in gpu.waits.items() if not place.function.startswith("vipe_core.ba."))
        kinds += f", {waits} waits"
    return f"{said}, same keyframes: {same}; {kinds}", same and max(apart.values()) <= most


def _annotated(name: str, device: str, folder: Path) -> list[tuple[Annotation, Any, Any]]:
    """Annotations with their depths and masks, which come while the device is there."""
    found = []
    for annotation in CASES[name](device, folder):
        frames = list(annotation.dense())
        found.append((annotation, np.stack([f.depth for f in frames]), np.stack([f.mask for f in frames])))
    return found


if __name__ == "__main__":
    sys.exit(main())
