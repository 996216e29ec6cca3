"""One picture of a result: frames, their depth, and the map with the camera path seen from above.

Drawn with OpenCV alone, at twice the size and then reduced, which smooths lines and letters alike.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import DepthKind
from vipe_core.cameras import Camera
from vipe_core.errors import ConfigError
from vipe_core.evaluation.synthetic.rays import unit_rays
from vipe_core.geometry import umeyama

Canvas = NDArray[np.uint8]
Colour = tuple[int, int, int]

_SCALE = 2  # the sheet is drawn this much larger than it is saved
_BACKGROUND: Colour = (22, 25, 31)
_PANEL: Colour = (31, 35, 43)
_TEXT: Colour = (226, 230, 236)
_FAINT: Colour = (138, 146, 158)
_TRUTH: Colour = (235, 238, 242)
_START: Colour = (255, 176, 46)
_COLUMNS = 4
_TILE_WIDTH = 300
_MARGIN = 22
_GAP = 8
_HEADER = 58
_PITCH_DEG = 52.0  # the map is seen from this angle above the horizon


@dataclass(frozen=True, slots=True)
class _View:
    """An orthographic view of the world onto the map panel: pixel = centre + zoom * (axes @ (point - middle))."""

    axes: NDArray[np.float64]
    middle: NDArray[np.float64]
    zoom: float
    centre: tuple[float, float]

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(..., 3) world -> (..., 3): x, y in pixels of the panel, and nearness (greater is nearer)."""
        local = (points - self.middle) @ self.axes.T
        offset = np.array([self.centre[0], self.centre[1], 0.0])
        projected: NDArray[np.float64] = local * np.array([self.zoom, self.zoom, 1.0]) + offset
        return projected


def contact_sheet(
    rgb_frames: Sequence[NDArray[np.uint8]],
    depth_frames: Sequence[NDArray[np.float32]],
    world_from_cam: NDArray[np.float64],
    out_png: str | Path,
    *,
    gt_world_from_cam: NDArray[np.float64] | None = None,
    title: str = "",
    subtitle: str = "",
    camera: Camera | None = None,
    depth_kind: DepthKind = "z",
    frame_index: Sequence[int] | None = None,
) -> Path:
    """Writes one PNG: up to four frames, their depth, and the camera path from above over the points of all frames.

    Args:
        rgb_frames: K pictures (H, W, 3) uint8 of one size.
        depth_frames: K depth maps (h, w), any resolution; values <= 0 or not finite are missing.
        world_from_cam: (N, 4, 4) poses of the whole video, OpenCV axes.
        gt_world_from_cam: (N, 4, 4) true poses; the estimate is then aligned to them by the least-squares Sim(3).
        camera: Given, the frames are also drawn as a coloured point cloud; it belongs to the size of `rgb_frames`.
        frame_index: Which of the N poses belong to the K frames; default: spread evenly over the video.

    Returns:
        The path of the picture.

    Raises:
        ConfigError: No frames, or counts that do not fit together.
    """
    count = len(rgb_frames)
    if count == 0 or len(depth_frames) != count or len(world_from_cam) == 0:
        raise ConfigError(f"a contact sheet needs as many depth maps as frames, got {len(depth_frames)} and {count}")
    if frame_index is None:
        numbers = np.linspace(0, len(world_from_cam) - 1, count).round().astype(np.int64)
    else:
        numbers = np.asarray(frame_index, dtype=np.int64)
    if len(numbers) != count or numbers.min() < 0 or numbers.max() >= len(world_from_cam):
        raise ConfigError(f"frame_index must name {count} of the {len(world_from_cam)} poses")
    poses, scale = _aligned(np.asarray(world_from_cam, dtype=np.float64), gt_world_from_cam)

    shown = np.unique(np.linspace(0, count - 1, min(count, _COLUMNS)).round().astype(np.int64))
    height, width = rgb_frames[0].shape[:2]
    tile_w, tile_h = _TILE_WIDTH * _SCALE, round(_TILE_WIDTH * _SCALE * height / width)
    gap, margin, header = _GAP * _SCALE, _MARGIN * _SCALE, _HEADER * _SCALE
    map_size = max(2 * tile_h + gap, 300 * _SCALE)
    strip = len(shown) * tile_w + (len(shown) - 1) * gap
    canvas = np.empty((header + map_size + margin, margin + strip + gap + map_size + margin, 3), np.uint8)
    canvas[:] = _BACKGROUND

    low, high = _inverse_depth_range([depth_frames[k] for k in shown])
    for column, k in enumerate(shown):
        x = margin + column * (tile_w + gap)
        picture = cv2.resize(rgb_frames[k], (tile_w, tile_h), interpolation=cv2.INTER_CUBIC)
        depth = cv2.resize(_colourised(depth_frames[k], low, high), (tile_w, tile_h), interpolation=cv2.INTER_LINEAR)
        canvas[header : header + tile_h, x : x + tile_w] = picture
        canvas[header + tile_h + gap : header + 2 * tile_h + gap, x : x + tile_w] = depth
        _label(canvas, f"frame {numbers[k]}", (x + 8 * _SCALE, header + tile_h - 9 * _SCALE))
    cloud = None
    if camera is not None:
        cloud = _cloud(rgb_frames, depth_frames, poses[numbers], camera, depth_kind, scale)
    truth = None if gt_world_from_cam is None else np.asarray(gt_world_from_cam, dtype=np.float64)
    left = margin + strip + gap
    canvas[header : header + map_size, left : left + map_size] = _map_panel(map_size, poses, truth, cloud)

    _text(canvas, title, (margin, header - 24 * _SCALE), 0.66, _TEXT, bold=True)
    title_width = cv2.getTextSize(title, cv2.FONT_HERSHEY_SIMPLEX, 0.66 * _SCALE, 2 * _SCALE)[0][0] if title else 0
    _text(canvas, subtitle, (margin + title_width + 14 * _SCALE * bool(title), header - 24 * _SCALE), 0.46, _FAINT)

    small = cv2.resize(canvas, None, fx=1 / _SCALE, fy=1 / _SCALE, interpolation=cv2.INTER_AREA)
    out = Path(out_png)
    out.parent.mkdir(parents=True, exist_ok=True)
    encoded, data = cv2.imencode(".png", np.ascontiguousarray(small[..., ::-1]))
    if not encoded:
        raise ConfigError(f"{out.name}: the picture cannot be encoded as PNG")
    out.write_bytes(data.tobytes())
    return out


def _aligned(poses: NDArray[np.float64], truth: NDArray[np.float64] | None) -> tuple[NDArray[np.float64], float]:
    """The poses in the truth's world and the scale that brought them there; unchanged where that is undefined."""
    if truth is None or len(truth) != len(poses):
        return poses, 1.0
    try:
        alignment = umeyama(poses[:, :3, 3], np.asarray(truth, dtype=np.float64)[:, :3, 3])
    except ValueError:
        return poses, 1.0
    return alignment.apply_to_poses(poses), alignment.scale


def _inverse_depth_range(depths: Sequence[NDArray[np.float32]]) -> tuple[float, float]:
    known = [1.0 / depth[np.isfinite(depth) & (depth > 0)] for depth in depths]
    values = np.concatenate(known)
    if len(values) == 0:
        return 0.0, 1.0
    low, high = np.percentile(values, [1.0, 99.0])
    return float(low), float(max(high, low * 1.001))


def _colourised(depth: NDArray[np.float32], low: float, high: float) -> Canvas:
    """Inverse depth as colour, near is bright; the square root shows far structure too. Missing is the panel's grey."""
    known = np.isfinite(depth) & (depth > 0)
    inverse = np.where(known, 1.0 / np.where(known, depth, 1.0), low)
    level = 0.1 + 0.9 * np.sqrt(np.clip((inverse - low) / (high - low), 0.0, 1.0))
    coloured: Canvas = cv2.applyColorMap(np.rint(255 * level).astype(np.uint8), cv2.COLORMAP_INFERNO)[..., ::-1].copy()
    coloured[~known] = _PANEL
    return coloured


def _cloud(
    rgb_frames: Sequence[NDArray[np.uint8]],
    depth_frames: Sequence[NDArray[np.float32]],
    poses: NDArray[np.float64],
    camera: Camera,
    depth_kind: DepthKind,
    scale: float,
) -> tuple[NDArray[np.float64], Canvas]:
    """World points (P, 3) and colours (P, 3) of all frames, without depth edges (they smear) and far outliers."""
    points, colours = [], []
    for rgb, depth, pose in zip(rgb_frames, depth_frames, poses, strict=True):
        rows, columns = depth.shape
        u, v = np.meshgrid(
            (np.arange(columns) + 0.5) * camera.width / columns, (np.arange(rows) + 0.5) * camera.height / rows
        )
        rays = unit_rays(camera, u, v)
        if depth_kind == "z":
            rays = rays / np.maximum(rays[..., 2:], 1e-6)
        safe = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
        smooth = cv2.dilate(safe, np.ones((3, 3))) < 1.12 * cv2.erode(safe, np.ones((3, 3)))
        keep = (safe > 0) & smooth
        if not keep.any():
            continue
        keep &= safe < 4.0 * float(np.median(safe[keep]))
        local = scale * safe[keep][:, None] * rays[keep]
        points.append(local @ pose[:3, :3].T + pose[:3, 3])
        small = cv2.resize(rgb, (columns, rows), interpolation=cv2.INTER_AREA)
        colours.append(small[keep])
    if not points:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    return np.concatenate(points), np.concatenate(colours)


def _map_panel(
    size: int,
    poses: NDArray[np.float64],
    truth: NDArray[np.float64] | None,
    cloud: tuple[NDArray[np.float64], Canvas] | None,
) -> Canvas:
    panel = np.empty((size, size, 3), np.uint8)
    panel[:] = _PANEL
    up = -poses[:, :3, 1].mean(axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-12)
    centres = poses[:, :3, 3]
    framed = [centres] if truth is None else [centres, truth[:, :3, 3]]
    if cloud is not None and len(cloud[0]):
        # Looking into a room from above means leaving its ceiling out.
        rise = (cloud[0] - centres.mean(axis=0)) @ up
        below = rise < 0.35 * float(np.percentile(np.abs(rise), 90)) + float(np.ptp(centres @ up))
        cloud = (cloud[0][below], cloud[1][below])
        framed.append(cloud[0])
    view = _fit_view(poses, up, framed, size)
    if cloud is not None:
        _splat(panel, view, *cloud)
    extent = size / view.zoom
    path = view.project(centres)
    _frusta(panel, view, poses, 0.035 * extent, path)
    below_path = path if truth is None else view.project(truth[:, :3, 3])
    _polyline(panel, below_path, (0, 0, 0), 6)
    if truth is not None:
        _polyline(panel, below_path, _TRUTH, 5)
    _polyline(panel, path, None, 2)
    start = (round(path[0, 0]), round(path[0, 1]))
    cv2.circle(panel, start, 6 * _SCALE, (0, 0, 0), -1, cv2.LINE_AA)
    cv2.circle(panel, start, 5 * _SCALE, _START, -1, cv2.LINE_AA)
    _legend(panel, truth is not None)
    _scale_bar(panel, view.zoom, "m" if truth is not None else "units")
    return panel


def _fit_view(
    poses: NDArray[np.float64], up: NDArray[np.float64], framed: Sequence[NDArray[np.float64]], size: int
) -> _View:
    """Looks down at the scene from behind the mean viewing direction; fits all points with a margin."""
    forward = poses[:, :3, 2].mean(axis=0)
    forward -= (forward @ up) * up
    if np.linalg.norm(forward) < 1e-6:
        forward = np.cross(up, np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0]))
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    pitch = math.radians(_PITCH_DEG)
    screen_down = -(math.sin(pitch) * forward + math.cos(pitch) * up)
    nearer = math.sin(pitch) * up - math.cos(pitch) * forward
    axes = np.stack([right, screen_down, nearer])
    spans = [np.percentile(points @ axes.T, [0.5, 99.5], axis=0) for points in framed if len(points)]
    low = np.min([span[0] for span in spans], axis=0)
    high = np.max([span[1] for span in spans], axis=0)
    room_px = size - 36 * _SCALE
    zoom = min(room_px / max(high[0] - low[0], 1e-6), (room_px - 40 * _SCALE) / max(high[1] - low[1], 1e-6))
    middle = axes.T @ ((low + high) / 2)
    return _View(axes, middle, float(zoom), (size / 2, size / 2))


def _splat(panel: Canvas, view: _View, points: NDArray[np.float64], colours: Canvas) -> None:
    """Draws points far to near, so that the nearest wins; small gaps between them are closed."""
    size = panel.shape[0]
    projected = view.project(points)
    order = np.argsort(projected[:, 2], kind="stable")
    x = np.floor(projected[order, 0] / _SCALE).astype(np.int64)
    y = np.floor(projected[order, 1] / _SCALE).astype(np.int64)
    cells = size // _SCALE
    inside = (x >= 0) & (x < cells) & (y >= 0) & (y < cells)
    image = np.zeros((cells, cells, 3), np.uint8)
    hit = np.zeros((cells, cells), np.uint8)
    image[y[inside], x[inside]] = colours[order][inside]
    hit[y[inside], x[inside]] = 255
    closed = cv2.medianBlur(image, 3)
    support = cv2.boxFilter((hit > 0).astype(np.float32), -1, (3, 3))
    fill = (hit == 0) & (support > 0.5)
    image[fill] = closed[fill]
    drawn = (hit > 0) | fill
    large = cv2.resize(image, (size, size), interpolation=cv2.INTER_NEAREST)
    mask = cv2.resize(drawn.astype(np.uint8), (size, size), interpolation=cv2.INTER_NEAREST) > 0
    # Dimmed a little, so that the path stands out.
    panel[mask] = (0.82 * large[mask] + 0.18 * np.array(_PANEL)).astype(np.uint8)


def _polyline(panel: Canvas, path: NDArray[np.float64], colour: Colour | None, width: int) -> None:
    """A line through the path; without a colour it runs through a colour map from start to end."""
    pixels = np.rint(path[:, :2]).astype(np.int32)
    if colour is not None:
        cv2.polylines(panel, [pixels], False, colour, width * _SCALE, cv2.LINE_AA)
        return
    for k in range(len(pixels) - 1):
        a, b = pixels[k], pixels[k + 1]
        shade = _path_colour(k / max(1, len(pixels) - 2))
        cv2.line(panel, (int(a[0]), int(a[1])), (int(b[0]), int(b[1])), shade, width * _SCALE, cv2.LINE_AA)


def _path_colour(share: float) -> Colour:
    """Amber to magenta to violet along the video."""
    stops = np.array([_START, (238, 70, 110), (150, 90, 255)], dtype=np.float64)
    position = min(max(share, 0.0), 1.0) * 2
    first = min(int(position), 1)
    mixed = stops[first] + (position - first) * (stops[first + 1] - stops[first])
    return int(mixed[0]), int(mixed[1]), int(mixed[2])


def _frusta(panel: Canvas, view: _View, poses: NDArray[np.float64], size: float, path: NDArray[np.float64]) -> None:
    """Camera symbols along the path, as many as do not crowd it."""
    length = float(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).sum())
    number = min(9, len(poses), 2 + int(length / (2.0 * size * view.zoom)))
    corners = size * np.array([[0, 0, 0], [-0.8, -0.6, 1.2], [0.8, -0.6, 1.2], [0.8, 0.6, 1.2], [-0.8, 0.6, 1.2]])
    for k in np.unique(np.linspace(0, len(poses) - 1, number).round().astype(np.int64)):
        world = corners @ poses[k, :3, :3].T + poses[k, :3, 3]
        at = [(round(x), round(y)) for x, y in view.project(world)[:, :2].tolist()]
        colour = _path_colour(k / max(1, len(poses) - 1))
        for a, b in ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)):
            cv2.line(panel, at[a], at[b], (0, 0, 0), 3 * _SCALE, cv2.LINE_AA)
        for a, b in ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)):
            cv2.line(panel, at[a], at[b], colour, round(1.5 * _SCALE), cv2.LINE_AA)


def _legend(panel: Canvas, with_truth: bool) -> None:
    y = 18 * _SCALE
    x = 14 * _SCALE
    for k in range(24):
        a, b = x + k * _SCALE, x + (k + 1) * _SCALE
        cv2.line(panel, (a, y), (b, y), _path_colour(k / 23), 3 * _SCALE)
    _label(panel, "camera path", (x + 32 * _SCALE, y + 4 * _SCALE))
    if with_truth:
        x += 132 * _SCALE
        cv2.line(panel, (x, y), (x + 24 * _SCALE, y), _TRUTH, 4 * _SCALE)
        _label(panel, "ground truth", (x + 32 * _SCALE, y + 4 * _SCALE))


def _scale_bar(panel: Canvas, zoom: float, unit: str) -> None:
    size = panel.shape[0]
    wanted = 0.22 * size / zoom
    magnitude = 10.0 ** math.floor(math.log10(wanted))
    length = max(step * magnitude for step in (1.0, 2.0, 5.0) if step * magnitude <= wanted)
    x, y = 14 * _SCALE, size - 16 * _SCALE
    end = x + round(length * zoom)
    cv2.line(panel, (x, y), (end, y), (0, 0, 0), 4 * _SCALE, cv2.LINE_AA)
    cv2.line(panel, (x, y), (end, y), _TEXT, 2 * _SCALE, cv2.LINE_AA)
    _label(panel, f"{length:g} {unit}", (end + 8 * _SCALE, y + 4 * _SCALE))


def _label(canvas: Canvas, text: str, at: tuple[int, int]) -> None:
    """Small text with a dark outline, readable on any picture."""
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42 * _SCALE, (0, 0, 0), 4 * _SCALE, cv2.LINE_AA)
    _text(canvas, text, at, 0.42, _TEXT)


def _text(canvas: Canvas, text: str, at: tuple[int, int], size: float, colour: Colour, bold: bool = False) -> None:
    thickness = 2 * _SCALE if bold else round(1.2 * _SCALE)
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, size * _SCALE, colour, thickness, cv2.LINE_AA)
