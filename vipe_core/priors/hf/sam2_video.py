"""Masks from boxes, and their propagation through a video, by SAM 2 (Ravi et al., 2024) as `transformers` has it.

The network remembers of each thing the frame that it was found in and a few of the frames before the present one. That
is all that is kept here, whatever the length of the video. The library's session, which would keep all frames, is made
anew when things come and go, and what it knows of those that stay is handed over.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vipe_core.errors import EngineError
from vipe_core.priors.hf.images import normalised
from vipe_core.priors.hf.loading import network, transformers
from vipe_core.transfer import uploaded

Array = NDArray[Any]

# Labels of the corners of a box, as the network knows points.
_TOP_LEFT, _BOTTOM_RIGHT = 2, 3
# What the library keeps of a frame for a later correction, which there is none of; 4 MiB each.
_UNUSED = "high_res_masks"


class Sam2Video:
    """`Propagator` by SAM 2.

    Args:
        model: `Sam2VideoModel`.
    """

    def __init__(self, model: Any, device: torch.device, dtype: torch.dtype = torch.float32) -> None:
        (self._session_kind,) = transformers("Sam2VideoInferenceSession")
        self._model = model
        self._device = device
        self._dtype = dtype

    @classmethod
    def load(cls, folder: Path, device: torch.device) -> Sam2Video:
        """The network in a folder; in bfloat16 on a GPU, as it was trained.

        Raises:
            LibraryMissing, WeightsMissing, WeightsInvalid: See `loading`.
        """
        (kind,) = transformers("Sam2VideoModel")
        dtype = torch.bfloat16 if device.type == "cuda" else torch.float32
        return cls(network(kind, folder, device, dtype), device, dtype)

    def begin(self) -> Sam2Propagation:
        """A video in which nothing is followed yet."""
        return Sam2Propagation(self._model, self._session_kind, self._device, self._dtype)


class Sam2Propagation:
    """`Propagation` by SAM 2."""

    def __init__(self, model: Any, session_kind: Any, device: torch.device, dtype: torch.dtype) -> None:
        self._model = model
        self._session_kind = session_kind
        self._device = device
        self._dtype = dtype
        config = model.config
        self._side = int(config.image_size)
        self._reach = max(int(config.num_maskmem), int(config.max_object_pointers_in_encoder))
        self._index = -1
        self._size = (0, 0)
        self._picture = torch.zeros(0)
        self._session = self._new_session({})
        self._outlined: Any = None

    @property
    def ids(self) -> tuple[int, ...]:
        return tuple(self._session.obj_ids)

    def advance(self, rgb: NDArray[np.uint8]) -> Tensor:
        """See `Propagation.advance`."""
        self._index += 1
        self._size = (rgb.shape[1], rgb.shape[0])
        self._picture = normalised(rgb, (self._side, self._side), self._device).to(self._dtype)
        self._outlined = None
        if not self._session.obj_ids:
            return torch.zeros((0, 1, 1), device=self._device)
        return self._run(self._session)

    def outline(self, boxes_px: Array) -> Tensor:
        """See `Propagation.outline`."""
        session = self._new_session({})
        # The picture is encoded once for both.
        session.cache = self._session.cache
        scale = np.array([self._side / self._size[0], self._side / self._size[1]] * 2)
        corners = torch.from_numpy(np.asarray(boxes_px * scale, np.float32)).view(-1, 1, 1, 2, 2)
        labels = uploaded(torch.tensor([[[_TOP_LEFT, _BOTTOM_RIGHT]]], dtype=torch.int32), self._device)
        for row, box in enumerate(uploaded(corners, self._device)):
            points = {"point_coords": box, "point_labels": labels}
            session.add_point_inputs(session.obj_id_to_idx(row), self._index, points)
            session.obj_with_new_inputs.append(row)
        self._outlined = session
        return self._run(session)

    def add(self, rows: Mapping[int, int]) -> None:
        """See `Propagation.add`.

        Raises:
            EngineError: Nothing was outlined in this frame.
        """
        if not rows:
            return
        if self._outlined is None:
            raise EngineError("only what was outlined in this frame can be followed from it on")
        known = self._outlined.output_dict_per_obj
        self._session = self._new_session({**self._memories(), **{number: known[row] for number, row in rows.items()}})

    def forget(self, ids: Iterable[int]) -> None:
        """See `Propagation.forget`."""
        gone = set(ids)
        if gone:
            self._session = self._new_session(
                {number: kept for number, kept in self._memories().items() if number not in gone}
            )

    def _memories(self) -> dict[int, Any]:
        """What is known of each thing that is followed, by its id."""
        return {
            number: self._session.output_dict_per_obj[self._session.obj_id_to_idx(number)]
            for number in self._session.obj_ids
        }

    def _new_session(self, memories: Mapping[int, Any]) -> Any:
        session = self._session_kind(
            inference_device=self._device,
            inference_state_device=self._device,
            video_storage_device=self._device,
            dtype=self._dtype,
        )
        for number, known in memories.items():
            session.output_dict_per_obj[session.obj_id_to_idx(number)] = known
        if memories:
            session.cache = self._session.cache
        return session

    def _run(self, session: Any) -> Tensor:
        """(n, a, b) logits of the things of a session in this frame, and no more kept of it than is needed."""
        with torch.inference_mode():
            found = self._model(inference_session=session, frame_idx=self._index, frame=self._picture)
        session.processed_frames.clear()
        for index, outputs in session.output_dict_per_obj.items():
            recent = outputs["non_cond_frame_outputs"]
            for old in [frame for frame in recent if frame <= self._index - self._reach]:
                del recent[old]
            for kept in (*recent.values(), *outputs["cond_frame_outputs"].values()):
                kept.pop(_UNUSED, None)
            session.frames_tracked_per_obj[index].clear()
            session.point_inputs_per_obj[index].clear()
        logits: Tensor = found.pred_masks
        return logits.flatten(0, 1)
