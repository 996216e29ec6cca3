"""The embedded family: no weights, CPU only, deterministic for a given number of OpenCV threads."""

from __future__ import annotations

from vipe_core.priors.classical.claims import CombinedFocalInit, FocalClaim
from vipe_core.priors.classical.features import FlowFeatures
from vipe_core.priors.classical.flow import DisFlowMatcher
from vipe_core.priors.classical.focal import FocalVote, TwoViewFocal
from vipe_core.priors.classical.patches import PatchAligner
from vipe_core.priors.classical.sift import SiftMatcher
from vipe_core.priors.classical.tracks import LkTracker
from vipe_core.priors.classical.unified import UnifiedInit
from vipe_core.priors.classical.vanishing import VanishingFocal
from vipe_core.priors.protocols import IntrinsicsInit, PriorFamily

__all__ = [
    "CombinedFocalInit",
    "DisFlowMatcher",
    "FlowFeatures",
    "FocalClaim",
    "FocalVote",
    "LkTracker",
    "PatchAligner",
    "SiftMatcher",
    "TwoViewFocal",
    "UnifiedInit",
    "VanishingFocal",
    "classical_priors",
]


def classical_priors(camera: str = "pinhole") -> PriorFamily:
    """DIS flow, Lucas-Kanade tracks and patches, SIFT correspondences, focal length from pairs and from lines.

    Make one per thread. The number of OpenCV threads is the caller's choice.

    Args:
        camera: `pinhole`, `mei`, or `auto` for what the video says; `equirect` for the faces of panoramas, which are
            pinholes.
    """
    initialisers: dict[str, IntrinsicsInit] = {"pinhole": CombinedFocalInit((TwoViewFocal(), VanishingFocal()))}
    initialisers["mei"], initialisers["auto"] = UnifiedInit(), UnifiedInit(initialisers["pinhole"])
    initialisers["equirect"] = initialisers["pinhole"]
    return PriorFamily(
        matcher=DisFlowMatcher(),
        tracker=LkTracker(),
        points=SiftMatcher(),
        intrinsics=initialisers[camera],
        aligner=PatchAligner(),
    )
