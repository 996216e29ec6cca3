"""The shots of a panoramic video: where they begin, and what was found of them as one result.

Keyframes are chosen on the six faces of a panorama; its cuts are found before that, on small pictures of all of it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from contextlib import closing
from itertools import pairwise

import numpy as np

from vipe_core.errors import EmptyMedia
from vipe_core.priors.protocols import DenseMatcher
from vipe_core.slam.diagnostics import combine
from vipe_core.slam.infill import Trajectory
from vipe_core.slam.selection import Report
from vipe_core.slam.shots import Picture, ShotSplitter
from vipe_core.slam.system import SlamResult
from vipe_core.slam.working import working_frame
from vipe_core.video.source import FrameSource

# Panoramas are compared at this size: as many cells as a small ordinary picture has.
_SIZE = (320, 160)


def find_shots(source: FrameSource, matcher: DenseMatcher, report: Report) -> list[tuple[int, int]]:
    """First frame of each shot and the one behind its last; together they are the whole video.

    Args:
        matcher: One of its own: it is not to be used with pictures of another size afterwards.

    Raises:
        EmptyMedia: The video holds no frame.
        InputError, DecodeError: From the source.
    """
    splitter = ShotSplitter(matcher)
    starts, count = [0], 0
    with closing(source.frames(_SIZE)) as frames:
        for frame in frames:
            work = working_frame(frame)
            features = matcher.encode(work)
            if not matcher.is_blank(features):
                starts += [one.picture.index for one in splitter.add(Picture.of(work, features)) if one.cut]
            count += 1
            report("scan", count, source.info.num_frames_hint)
    if not count:
        raise EmptyMedia(f"{source.info.name}: the video holds no frame; check the recording")
    starts += [one.picture.index for one in splitter.finish() if one.cut]
    return list(pairwise((*starts, count)))


def report_of_shot(report: Report, shots: Sequence[tuple[int, int]], number: int) -> Report:
    """What one shot reports, as part of the whole: stages come one after the other, though every shot has all.

    Args:
        shots: As `find_shots` gives them.
    """
    (start, _), (_, total), last = shots[number], shots[-1], number == len(shots) - 1
    tracked = start

    def told(stage: str, done: int, of: int | None) -> None:
        nonlocal tracked
        if stage == "track":
            tracked = max(tracked, start + done)
        if last and stage == "infill":
            report(stage, start + done, total)
        elif last and stage not in ("scan", "track"):
            report(stage, done, of)
        else:
            # Whoever listens may end the run, and waits for a sign of life.
            report("track", tracked, total)

    return told


def one_after_the_other(results: Sequence[SlamResult]) -> SlamResult:
    """The results of shots as that of the video, in the world of its first frame.

    Each shot goes on where the one before it ended. What is of the main shot alone is of that with most keyframes.
    """
    lengths = [len(result.timestamps_s) for result in results]
    starts = np.cumsum([0, *lengths[:-1]])
    poses, anchor = [], np.eye(4)
    for result in results:
        poses.append(anchor @ result.world_from_cam)
        anchor = poses[-1][-1]
    main = max(results, key=lambda result: len(result.keyframes))
    timings_s: dict[str, float] = {}
    peak_bytes: dict[str, int] = {}
    for result in results:
        for stage, seconds in result.timings_s.items():
            timings_s[stage] = timings_s.get(stage, 0.0) + seconds
        for stage, taken in result.peak_bytes.items():
            peak_bytes[stage] = max(peak_bytes.get(stage, 0), taken)
    names = [field.name for field in dataclasses.fields(Trajectory)]
    trajectories = [result.trajectory for result in results]
    return dataclasses.replace(
        main,
        world_from_cam=np.concatenate(poses),
        trajectory=Trajectory(*(np.concatenate([getattr(one, name) for one in trajectories]) for name in names)),
        timestamps_s=np.concatenate([result.timestamps_s for result in results]),
        cuts=tuple(int(start) for start in starts[1:]),
        keyframes=np.concatenate([result.keyframes + start for result, start in zip(results, starts, strict=True)]),
        inverse_depth=np.concatenate([result.inverse_depth for result in results]),
        static=np.concatenate([result.static for result in results]),
        map=combine([result.map for result in results]),
        timings_s=timings_s,
        peak_bytes=peak_bytes,
    )
