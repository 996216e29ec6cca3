"""The stage that finds things by phrases, before any other looks at the video."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing

import torch

from vipe_core.annotation import MASK_PHRASES
from vipe_core.priors.instance_settings import STATIC_PHRASES
from vipe_core.priors.protocols import InstanceMasks
from vipe_core.video.instances import InstanceMaps
from vipe_core.video.source import FrameSource


def find_instances(
    source: FrameSource, masks: InstanceMasks, report: Callable[[str, int, int | None], None]
) -> InstanceMaps:
    """What there is in each frame, on disk.

    Raises:
        InputError, DecodeError: From the source.
    """
    size = masks.input_size(source.info.width, source.info.height)
    maps = InstanceMaps(STATIC_PHRASES)
    with closing(source.frames(size=size)) as frames, torch.inference_mode():
        for found in masks.follow(frames):
            maps.append(found.ids, {**MASK_PHRASES, **found.phrases})
            report("masks", len(maps), source.info.num_frames_hint)
    return maps
