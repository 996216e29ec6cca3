"""How well points are followed: their distance from the truth, beside dense flow between the same two frames.

    python -m benchmarks.tracks [SEQUENCE ...]

Per sequence with true depth and gaps of 5, 10 and 20 frames: how many points of a frame are still followed after the
gap, and the median and 90th percentile of their distance from where the truth puts them, in working pixels; of points
of the static scene that the truth does not hide. The baseline is DIS flow from the one frame to the other, looked up at
the same points, without a starting point. Its percentiles are of the same points.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.sequences import find_sequence
from vipe_core.cameras import Camera
from vipe_core.priors.classical.features import sample_px
from vipe_core.priors.classical.flow import DisFlowMatcher
from vipe_core.priors.classical.following import CornerFollower
from vipe_core.slam.working import working_frame, working_size
from vipe_core.video import open_source

_GAPS = (5, 10, 20)
_EVERY = 10


def truth(path: Path) -> dict[str, Any]:
    with np.load(path, allow_pickle=False) as found:
        return {name: found[name] for name in found.files}


def true_motion(
    gt: dict[str, Any], camera: Camera, source: int, target: int, px: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(n, 2) where points of a frame are in another one, and whether they are static, on a surface and in sight."""
    scale = gt["depth"].shape[2] / camera.width
    depth = gt["depth"].astype(np.float64)

    def nearest(field: NDArray[Any], points: NDArray[Any]) -> NDArray[Any]:
        column, row = np.floor((points + 0.5) * scale).astype(int).T
        height, width = field.shape
        found: NDArray[Any] = field[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
        return found

    # A plane's inverse depth is linear in the picture; of edges, a quarter of the resolution tells nothing.
    inverse = np.where(depth[source] > 0, 1 / np.maximum(depth[source], 1e-6), 0).astype(np.float32)
    z = 1 / np.maximum(sample_px(inverse, ((px + 0.5) * scale - 0.5).astype(np.float32)).astype(np.float64), 1e-6)
    steps = ((4, 0), (-4, 0), (0, 4), (0, -4))
    around = [nearest(inverse, px + np.array(step)) for step in steps]
    known = np.ptp(np.stack(around), axis=0) < 0.05 / z
    known &= ~np.stack([nearest(gt["dynamic"][source], px + np.array(step)) for step in ((0, 0), *steps)]).any(axis=0)
    fx, fy, cx, cy = camera.index_params()[:4]
    rays = np.stack(((px[:, 0] - cx) / fx, (px[:, 1] - cy) / fy, np.ones(len(px))), axis=1)
    world = gt["cam_to_world"]
    moved = np.linalg.inv(world[target]) @ world[source]
    points = (rays * z[:, None]) @ moved[:3, :3].T + moved[:3, 3]
    ahead = np.maximum(points[:, 2], 1e-6)
    there = np.stack((points[:, 0] / ahead * fx + cx, points[:, 1] / ahead * fy + cy), axis=1)
    inside = ((there >= 0) & (there <= (camera.width - 1, camera.height - 1))).all(axis=1) & (points[:, 2] > 0)
    in_sight = np.abs(nearest(depth[target], np.where(inside[:, None], there, 0)) - ahead) < 0.05 * ahead
    return there, known & inside & in_sight


def measure(name: str) -> None:
    sequence = find_sequence(name)
    gt = truth(sequence.truth)
    source = open_source(sequence.video)
    info = source.info
    size = working_size(info.width, info.height, 640 * 480)
    fx, fy, cx, cy = gt["intrinsics"][:4]
    camera = Camera("pinhole", (fx, fy, cx, cy), info.width, info.height).resized(size.width, size.height)
    matcher = DisFlowMatcher()
    features = [matcher.encode(working_frame(frame)) for frame in source.frames(size.size)]
    follower = CornerFollower()
    given = follower.input_size(info.width, info.height)
    began = time.process_time()
    tracks = list(follower.follow(source.frames(given), camera.resized(*given)))
    spent = (time.process_time() - began) / len(tracks)
    scale = np.array(size.size) / np.array(given)
    print(f"{name}: {len(tracks)} frames, {np.mean([len(one.ids) for one in tracks]):.0f} points a frame, ", end="")
    print(f"{1e3 * spent:.1f} CPU-ms a frame with decoding")
    print(f"  {'gap':>4} {'followed':>9} {'compared':>9} {'tracks: median':>15} {'90 %':>6}", end="")
    print(f" {'flow: median':>13} {'90 %':>6}")
    grid = size.grid
    centres = grid.sample_px().numpy()
    for gap in _GAPS:
        errors: list[NDArray[np.float64]] = []
        of_flow: list[NDArray[np.float64]] = []
        shares: list[float] = []
        for first in range(0, len(tracks) - gap, _EVERY):
            one, other = tracks[first], tracks[first + gap]
            _, here, there = np.intersect1d(one.ids, other.ids, return_indices=True)
            shares.append(len(here) / max(1, len(one.ids)))
            begin, end = ((each + 0.5) * scale - 0.5 for each in (one.px[here], other.px[there]))
            expected, seen = true_motion(gt, camera, first, first + gap, begin.astype(np.float32))
            match, _ = matcher.match(features[first], features[first + gap])
            flow = (match.target_px - centres).astype(np.float32).reshape(grid.height, grid.width, 2)
            flowed = begin + sample_px(flow, ((begin - grid.offset) / grid.stride).astype(np.float32))
            errors.append(np.linalg.norm(end - expected, axis=1)[seen])
            of_flow.append(np.linalg.norm(flowed - expected, axis=1)[seen])
        ours, theirs = np.concatenate(errors), np.concatenate(of_flow)
        if not len(ours):
            print(f"  {gap:4d} {np.mean(shares):9.0%} {0:9d}")
            continue
        of_tracks, of_dense = np.percentile(ours, (50, 90)), np.percentile(theirs, (50, 90))
        print(f"  {gap:4d} {np.mean(shares):9.0%} {len(ours):9d} {of_tracks[0]:15.3f} {of_tracks[1]:6.2f}", end="")
        print(f" {of_dense[0]:13.3f} {of_dense[1]:6.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="*", default=["room_handheld", "street_drive", "dynamic_people"])
    for name in parser.parse_args().sequences:
        measure(name)


if __name__ == "__main__":
    main()
