"""The sequences that claims are made about: where their pictures and their truth are, and what is asked of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from vipe_core.errors import MediaNotFound
from vipe_core.evaluation.samples import SAMPLE_NAMES, sample_path

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
"""Public and synthetic sequences beside the checkout."""

_PICTURES = ("rgb", "images", "image_l")


@dataclass(frozen=True, slots=True)
class Limit:
    """What is asked of a sequence; None is not asked.

    Attributes:
        ate_percent: Largest ATE in percent of the path.
        fov_deg: Largest error of the horizontal field of view.
        rotation_deg: Largest RMS rotation error.
        drift_percent: Largest distance between two positions of a camera that stands still, in percent of the median
            depth.
        reason: A reason that the verdict has to name.
        peer: COLMAP's better mapper is shown beside it.
        peer_ate: The ATE must not exceed that of this mapper on the same frames.
        peer_fov: Nor the error of the field of view.
    """

    ate_percent: float | None = None
    fov_deg: float | None = None
    rotation_deg: float | None = None
    drift_percent: float | None = None
    reason: str | None = None
    peer: bool = False
    peer_ate: bool = False
    peer_fov: bool = False


@dataclass(frozen=True, slots=True)
class BenchSequence:
    """A sequence with a truth.

    Attributes:
        pictures: Video file or image folder; None where only the truth is there.
        truth: Its gt.npz.
    """

    name: str
    pictures: Path | None
    truth: Path
    limit: Limit

    @property
    def video(self) -> Path:
        """The pictures.

        Raises:
            MediaNotFound: There are none.
        """
        if self.pictures is None:
            raise MediaNotFound(f"{self.name}: no video.mp4 and no folder of images beside {self.truth}")
        return self.pictures


_STILL = Limit(ate_percent=0.05, fov_deg=0.5)
_STREET = Limit(ate_percent=0.05, fov_deg=1.5)
_MOVING = Limit(ate_percent=0.5, fov_deg=2.0)
_LIMITS = {
    "room_orbit": _STILL,
    "room_handheld": _STILL,
    "street_drive": _STREET,
    "street_narrow_fov": _STREET,
    "long_loop": _STILL,
    "dynamic_people": _MOVING,
    **{name: _MOVING for name in SAMPLE_NAMES if name.startswith("crowd_")},
    "low_texture": Limit(ate_percent=1.0),
    "pure_rotation": Limit(rotation_deg=0.2, reason="pure_rotation"),
    "static_camera": Limit(drift_percent=0.5, reason="static_camera"),
    "zoom_free_short": Limit(ate_percent=1.0),
    # The true field of view of sevenscenes is only known to 2 degrees, and the truth of fox is COLMAP's own.
    "sevenscenes": Limit(peer=True, peer_ate=True),
    "hololens": Limit(peer=True, peer_ate=True, peer_fov=True),
    "kitti_seq2": Limit(peer=True, peer_ate=True, peer_fov=True),
    "fox": Limit(ate_percent=0.3, fov_deg=1.0, peer=True),
}
SUITE: tuple[str, ...] = tuple(_LIMITS)
"""Every sequence that something is asked of, in the order of the table."""


def find_sequence(name: str, data: Path = DATA) -> BenchSequence:
    """A sequence by the name of a sample, by its name below `data`, or by its folder.

    Raises:
        MediaNotFound: There is no such sequence, or its folder lacks gt.npz.
    """
    if name in SAMPLE_NAMES:
        paths = sample_path(name)
        return BenchSequence(name, paths.video, paths.truth, _LIMITS.get(name, Limit()))
    for folder in (data / "synthetic" / name, data / "real" / name, Path(name).resolve()):
        if (folder / "gt.npz").is_file():
            choices = [folder / "video.mp4", *(folder / sub for sub in _PICTURES), *sorted(folder.glob("*.mp4"))]
            pictures = next((path for path in choices if path.exists()), None)
            return BenchSequence(folder.name, pictures, folder / "gt.npz", _LIMITS.get(folder.name, Limit()))
    raise MediaNotFound(f"{name}: neither a sample nor a folder with a gt.npz, here or in {data}")
