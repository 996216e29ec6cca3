"""How straight a scene's straight lines are, in the pictures as they are and as a pinhole sees them.

    python -m benchmarks.straightness VIDEO [--camera NAME | --calibration FILE] [--lines FILE] [--frames N]
                                            [--picture FILE.png] [--json FILE]

VIDEO is a video, a folder of images, or a folder of the shared data. The camera is what the engine finds (poses only).

What the lines are, no camera of ours decides. Where a scene is full of them, they are found: long edges of some frames
are followed, and those are lines that the plumb line makes straight, the one radial distortion (division model,
Fitzgibbon, CVPR 2001) under which most of them are. Elsewhere `--lines` names them, a JSON list of

    {"frame": 0, "through": [[x, y], [x, y], [x, y]]}

with three places along each line in pixels of the picture, near which the strongest edge is taken. The figures are RMS
distances from the line that fits best, for the extent that the line has in a picture 1280 pixels wide: in the picture,
rectified, and by the plumb line. Where the second is as small as the third, the lens is right as far as lines can tell.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.processes import cpu_s
from benchmarks.sequences import DATA
from vipe_core.cameras import Camera
from vipe_core.cameras.calibration_files import read_calibration
from vipe_core.cameras.pixel_map import PixelMap
from vipe_core.formats.rectified import pinhole_for
from vipe_core.pipeline.annotator import Annotator
from vipe_core.pipeline.presets import CAMERAS
from vipe_core.video import open_source

Array = NDArray[Any]
Chain = NDArray[np.float64]
"""(n, 2) index coordinates along an edge."""

# Edges are looked for at this width, and followed over gaps and bends of this size.
_WIDTH = 1280
_MIN_SEGMENT_PX, _MAX_GAP_PX, _MAX_BEND_DEG = 12.0, 12.0, 10.0
# Least length of an edge that is looked at, and of one that is judged, as a share of the width.
_MIN_LENGTH = 0.1
_SAMPLE_PX = 4.0
_SEARCH_PX = 3
# An edge is a line of the scene if the plumb line leaves it this, pixels; more than this counts as much as this.
_STRAIGHT_PX, _BENT_PX = 0.4, 1.5
# How far from the places that were given an edge is looked for, and from its own curve a point of it may lie.
_GIVEN_SEARCH_PX, _OWN_PX = 8, 1.0
# Distortions that are tried: corners of the picture are moved away from the centre by 1 / (1 - k).
_TRIED = np.linspace(-0.1, 1.2, 131)


@dataclass(frozen=True, slots=True)
class Straightness:
    """Medians over the lines of the scene.

    Attributes:
        edges: Long edges that were found, or lines that were named.
        lines: Those that are lines of the scene.
        before_px, after_px, plumb_px: Distance from a line in the picture, rectified, and by the plumb line.
        worst_before_px, worst_after_px: What nine tenths of the lines stay below.
        cpu_s: CPU-seconds of finding the camera; 0 for one that was given.
    """

    name: str
    model: str
    params: tuple[float, ...]
    fov_x_deg: float
    edges: int
    lines: int
    before_px: float
    after_px: float
    plumb_px: float
    worst_before_px: float
    worst_after_px: float
    cpu_s: float


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("video", help="a video, a folder of images, or the name of a folder of the shared data")
    parser.add_argument("--camera", default="auto", choices=[name for name in CAMERAS if name != "equirect"])
    parser.add_argument("--calibration", type=Path, help="the camera, in place of what the engine finds")
    parser.add_argument("--lines", type=Path, help="JSON of places along lines of the scene, in place of long edges")
    parser.add_argument("--frames", type=int, default=6, help="number of frames whose long edges are followed")
    parser.add_argument("--picture", type=Path, help="write the frame with most lines, before and after, as a PNG")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    arguments = parser.parse_args(argv)
    path = _find(arguments.video)
    camera, count, spent_s = _camera(path, arguments.camera, arguments.calibration)
    if arguments.lines is None:
        chosen = np.linspace(0, count - 1, min(arguments.frames, count)).round().astype(int).tolist()
        pictures = dict(_pictures(path, chosen))
        found = {index: _long_edges(rgb) for index, rgb in pictures.items()}
    else:
        named = json.loads(arguments.lines.read_text())
        pictures = dict(_pictures(path, [one["frame"] for one in named]))
        found = {index: [] for index in pictures}
        for one in named:
            found[one["frame"]].append(_near(pictures[one["frame"]], np.array(one["through"], np.float64)))
    result, lines = judge(path.stem, camera, found, spent_s, given=arguments.lines is not None)
    print(
        f"{result.name}: {result.model} {', '.join(f'{value:.4g}' for value in result.params)}, "
        f"{result.fov_x_deg:.1f} degrees wide, {result.cpu_s:.0f} CPU-s\n"
        f"{result.lines} lines of {result.edges} edges in {len(pictures)} frames; from a line, in px of 1280:\n"
        f"  in the picture {result.before_px:.2f} (90 % below {result.worst_before_px:.2f}), "
        f"rectified {result.after_px:.2f} (90 % below {result.worst_after_px:.2f}), "
        f"by the plumb line {result.plumb_px:.2f}"
    )
    if arguments.picture:
        most = max(lines, key=lambda index: len(lines[index]))
        cv2.imwrite(str(arguments.picture), _drawn(pictures[most], lines[most], camera))
    if arguments.json:
        data = {name: getattr(result, name) for name in Straightness.__slots__}
        arguments.json.write_text(json.dumps(data, indent=1) + "\n")
    return 0


def judge(
    name: str, camera: Camera, found: Mapping[int, Sequence[Chain]], spent_s: float, *, given: bool
) -> tuple[Straightness, dict[int, list[Chain]]]:
    """Figures of the edges of some frames, and those that are lines.

    Args:
        camera: Of the pictures.
        found: Edges by frame, in index coordinates of the pictures.
        given: Whether all are lines, as somebody says.
    """
    size = camera.width, camera.height
    edges = [(index, chain) for index, chains in found.items() for chain in chains]
    if not edges:
        raise SystemExit(f"{name}: no long edges in these frames")
    extent = np.array([_extent_px(chain) * _WIDTH / camera.width for _, chain in edges])

    def off_px(changed: Callable[[Chain], Chain]) -> Array:
        return np.asarray([bow(changed(chain)) for _, chain in edges] * extent)

    by_plumb = np.array([off_px(partial(undistorted, size=size, k=k)) for k in _TRIED])
    best = int(np.argmin(np.minimum(by_plumb, _BENT_PX).sum(axis=1)))
    line = np.ones(len(edges), np.bool_) if given else by_plumb[best] < _STRAIGHT_PX
    if not line.any():
        raise SystemExit(f"{name}: no edge of these frames is a line of the scene; name some with --lines")
    pinhole = pinhole_for(camera)
    before = off_px(lambda chain: chain)[line]
    after = off_px(lambda chain: rectified_px(chain, camera, pinhole))[line]
    result = Straightness(
        name=name,
        model=camera.model,
        params=camera.params,
        fov_x_deg=camera.fov_x_deg,
        edges=len(edges),
        lines=int(line.sum()),
        before_px=float(np.median(before)),
        after_px=float(np.nanmedian(after)),
        plumb_px=float(np.median(by_plumb[best][line])),
        worst_before_px=float(np.quantile(before, 0.9)),
        worst_after_px=float(np.nanquantile(after, 0.9)),
        cpu_s=spent_s,
    )
    lines: dict[int, list[Chain]] = {index: [] for index in found}
    for (index, chain), straight in zip(edges, line, strict=True):
        if straight:
            lines[index].append(chain)
    return result, lines


def bow(chain: Chain) -> float:
    """RMS distance of points from their line as a share of their extent; NaN for fewer than three."""
    points = chain[np.isfinite(chain).all(axis=1)]
    if len(points) < 3:
        return float("nan")
    centred = points - points.mean(axis=0)
    along, across = np.linalg.svd(centred, full_matrices=False)[2]
    return float(np.sqrt(np.square(centred @ across).mean()) / max(np.ptp(centred @ along), 1e-9))


def _extent_px(chain: Chain) -> float:
    return float(np.linalg.norm(chain[-1] - chain[0]))


def undistorted(chain: Chain, size: tuple[int, int], k: float) -> Chain:
    """By the division model about the middle of the picture; `k` is 0 for none."""
    middle = (np.array(size) - 1) / 2
    away = chain - middle
    square = np.square(away).sum(axis=1, keepdims=True) / np.square(middle).sum()
    return np.asarray(middle + away / (1 - k * square))


def rectified_px(chain: Chain, camera: Camera, pinhole: Camera) -> Chain:
    """Where a pinhole sees the points of a picture; NaN where it does not."""
    px, seen = pinhole.project(camera.unproject(chain))
    return np.asarray(np.where((seen & camera.has_ray(chain))[:, None], px, np.nan))


def _find(name: str) -> Path:
    if Path(name).exists():
        return Path(name)
    for folder in (DATA / "real" / name, DATA / "synthetic" / name):
        choices = [
            folder / "video.mp4",
            *(folder / part for part in ("rgb", "images", "image_l")),
            *folder.glob("*.mp4"),
        ]
        for choice in choices:
            if choice.exists():
                return choice
    raise SystemExit(f"{name}: neither a video nor a folder of the shared data")


def _camera(path: Path, asked: str, calibration: Path | None) -> tuple[Camera, int, float]:
    """The camera of a video, its number of frames, and CPU-seconds that were spent to find them."""
    if calibration is None:
        started_s = cpu_s()
        annotation = Annotator(camera=asked, threads=1).annotate(path)
        return annotation.camera, annotation.num_frames, cpu_s() - started_s
    info = open_source(path).info
    known = read_calibration(calibration).for_size(info.width, info.height, info.name)
    return known.camera, info.num_frames_hint or 1, 0.0


def _pictures(path: Path, chosen: Sequence[int]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    with closing(open_source(path).frames(stop=max(chosen) + 1)) as frames:
        yield from ((frame.index, frame.rgb) for frame in frames if frame.index in chosen)


def _small(rgb: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], float]:
    """The picture in gray, 1280 pixels wide at most, and by how much it is smaller."""
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    scale = min(1.0, _WIDTH / rgb.shape[1])
    small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else gray
    return np.asarray(small, np.uint8), scale


def _near(rgb: NDArray[np.uint8], through: Array) -> Chain:
    """The strongest edge near a curve through three places, in index coordinates of the picture.

    Its points lie on a curve of the third order, which the image of a line is to a small part of a pixel.
    """
    small, scale = _small(rgb)
    smooth = cv2.GaussianBlur(small, (0, 0), 1.0).astype(np.float32)
    places = through * scale
    origin, direction = places[0], places[-1] - places[0]
    length = float(np.linalg.norm(direction))
    direction = direction / length
    side = np.array([-direction[1], direction[0]])
    at = (places - origin) @ direction
    curve = np.polyfit(at, (places - origin) @ side, 2)
    reach = np.arange(-_GIVEN_SEARCH_PX - 1, _GIVEN_SEARCH_PX + 2)
    along = np.arange(0, length, _SAMPLE_PX / 2)
    points = origin + along[:, None] * direction + np.polyval(curve, along)[:, None] * side
    change, offset = max(_edges_across(smooth, points, side, reach), key=lambda one: float(one[0].sum()))
    kept = np.isfinite(offset)
    value = np.polyval(curve, along) + offset
    # From all that is strong towards what agrees.
    for limit in (4.0, 2.0, _OWN_PX):
        fitted = np.polyfit(along[kept], value[kept], 3, w=np.sqrt(change[kept]))
        kept = np.isfinite(offset) & (np.abs(np.polyval(fitted, along) - value) < limit)
    chain = origin + along[kept, None] * direction + value[kept, None] * side
    return np.asarray((chain + 0.5) / scale - 0.5)


def _edges_across(smooth: Array, points: Array, side: Array, reach: Array) -> list[tuple[Array, Array]]:
    """For edges from dark to bright and from bright to dark: how strong the strongest is at each of some points, and
    how far to the side it lies, NaN where none is."""
    across = (points[:, None] + reach[None, :, None] * side).astype(np.float32)
    profile = cv2.remap(smooth, across[..., 0], across[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    found = []
    for sign in (1, -1):
        change = sign * (profile[:, 2:] - profile[:, :-2])
        peak = np.clip(np.argmax(change, axis=1), 1, change.shape[1] - 2)
        left, here, right = (change[np.arange(len(points)), peak + step] for step in (-1, 0, 1))
        bend = left - 2 * here + right
        inside = (bend < 0) & (here > 0) & (here >= left) & (here >= right)
        offset = reach[1:-1][peak] + 0.5 * (left - right) / np.where(inside, bend, 1)
        found.append((np.where(inside, here, 0), np.where(inside, offset, np.nan)))
    return found


def _long_edges(rgb: NDArray[np.uint8]) -> list[Chain]:
    """Long edges that bend little and to one side, in index coordinates of the picture."""
    small, scale = _small(rgb)
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(small)[0]
    if found is None:
        return []
    segments = np.asarray(found, np.float64).reshape(-1, 2, 2)
    segments = segments[np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1) >= _MIN_SEGMENT_PX]
    smooth = cv2.GaussianBlur(small, (0, 0), 1.0).astype(np.float32)
    chains = []
    for row in _linked(segments):
        chain = _refined(smooth, segments[row])
        if len(chain) > 8 and _extent_px(chain) > _MIN_LENGTH * small.shape[1]:
            chains.append((chain + 0.5) / scale - 0.5)
    return chains


def _linked(segments: Array) -> list[list[int]]:
    """Segments that go on in each other, each in one chain. They all have their brighter side on the same hand."""
    starts, ends = segments[:, 0], segments[:, 1]
    heading = np.arctan2(*(ends - starts).T[::-1])
    after: dict[int, int] = {}
    taken: set[int] = set()
    pairs = []
    for i in range(len(segments)):
        gap = np.linalg.norm(starts - ends[i], axis=1)
        bend = np.degrees(np.abs(np.angle(np.exp(1j * (heading - heading[i])))))
        side = np.stack((-np.sin(heading[i]), np.cos(heading[i])))
        aside = np.abs((starts - ends[i]) @ side)
        near = (gap < _MAX_GAP_PX) & (bend < _MAX_BEND_DEG) & (aside < 2.5)
        near[i] = False
        pairs += [(float(gap[j] + bend[j]), i, int(j)) for j in np.flatnonzero(near)]
    for _, i, j in sorted(pairs):
        if i not in after and j not in taken:
            after[i] = j
            taken.add(j)
    chains = []
    for first in range(len(segments)):
        if first in taken:
            continue
        row = [first]
        while row[-1] in after:
            row.append(after[row[-1]])
        chains += _one_way(row, heading)
    return chains


def _one_way(row: list[int], heading: Array) -> list[list[int]]:
    """Parts of a chain that bend to one side: the image of a line does."""
    parts, hand = [[row[0]]], 0.0
    for before, now in pairwise(row):
        turn = float(np.degrees(np.angle(np.exp(1j * (heading[now] - heading[before])))))
        turn = turn if abs(turn) > 1.0 else 0.0
        if turn * hand < 0:
            parts.append([before])
            hand = 0.0
        parts[-1].append(now)
        hand = turn or hand
    return parts


def _refined(smooth: NDArray[np.float32], segments: Array) -> Chain:
    """Points along segments, moved across them to where the picture changes most."""
    points = []
    for start, end in segments:
        length = float(np.linalg.norm(end - start))
        direction = (end - start) / length
        side = np.array([-direction[1], direction[0]])
        along = start + np.arange(0, length, _SAMPLE_PX)[:, None] * direction
        reach = np.arange(-_SEARCH_PX - 1, _SEARCH_PX + 2)
        _, offset = max(_edges_across(smooth, along, side, reach), key=lambda one: float(one[0].sum()))
        points.append((along + offset[:, None] * side)[np.isfinite(offset)])
    return np.concatenate(points)


def _drawn(rgb: NDArray[np.uint8], lines: Sequence[Chain], camera: Camera) -> NDArray[np.uint8]:
    """The picture and its rectified one side by side: lines in green, the straight ones through their ends in red."""
    pinhole = pinhole_for(camera)
    flat = PixelMap(camera, pinhole).colours(rgb)
    panels = []
    for picture, chains in ((rgb, lines), (flat, [rectified_px(line, camera, pinhole) for line in lines])):
        scale = 960 / picture.shape[1]
        panel = cv2.resize(picture[..., ::-1], None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        for chain in chains:
            points = chain[np.isfinite(chain).all(axis=1)]
            if len(points) < 3:
                continue
            at = np.rint(16 * ((points + 0.5) * scale - 0.5)).astype(np.int32)
            cv2.line(panel, at[0].tolist(), at[-1].tolist(), (60, 60, 255), 1, cv2.LINE_AA, 4)
            cv2.polylines(panel, [at], False, (80, 255, 80), 1, cv2.LINE_AA, 4)
        panels.append(panel)
    height = max(panel.shape[0] for panel in panels)
    padded = [cv2.copyMakeBorder(panel, 0, height - panel.shape[0], 0, 0, cv2.BORDER_CONSTANT) for panel in panels]
    return np.asarray(np.hstack(padded), np.uint8)


if __name__ == "__main__":
    sys.exit(main())
