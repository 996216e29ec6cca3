"""The datasets on offer, and the way in: a dataset's name, a folder and a protocol become sequences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from vipe_core.errors import ConfigError, FormatError
from vipe_core.evaluation.datasets.euroc import is_euroc_folder, read_euroc
from vipe_core.evaluation.datasets.gt_npz import is_gt_npz_folder, read_gt_npz
from vipe_core.evaluation.datasets.kitti import find_kitti, read_kitti
from vipe_core.evaluation.datasets.protocols import Protocol, protocol_of, shortened
from vipe_core.evaluation.datasets.sequence import GroundTruthSequence
from vipe_core.evaluation.datasets.seven_scenes import is_seven_scenes_folder, read_seven_scenes
from vipe_core.evaluation.datasets.sintel import find_sintel, read_sintel
from vipe_core.evaluation.datasets.tum import is_rgbd_folder, read_eth3d, read_tum


@dataclass(frozen=True, slots=True)
class Dataset:
    """How a dataset is found and read.

    Attributes:
        title: Its name in tables.
        layout: What a folder of it holds, for the message when it does not.
        find: Sequences below a root: name -> folder, in order of names.
        read: One of them.
    """

    title: str
    layout: str
    find: Callable[[Path], dict[str, Path]]
    read: Callable[[Path, str], GroundTruthSequence]


def _folders(is_sequence: Callable[[Path], bool], levels: int = 1) -> Callable[[Path], dict[str, Path]]:
    """Finds sequences that are folders: the root itself, or those at most `levels` below it."""

    def find(root: Path) -> dict[str, Path]:
        if is_sequence(root):
            return {root.resolve().name: root}
        below = [root.glob("/".join("*" * depth)) for depth in range(1, levels + 1)]
        folders = [folder for level in below for folder in level if folder.is_dir() and is_sequence(folder)]
        return {folder.relative_to(root).as_posix(): folder for folder in sorted(folders)}

    return find


DATASETS: dict[str, Dataset] = {
    "tum": Dataset("TUM RGB-D", "folders with rgb.txt and groundtruth.txt", _folders(is_rgbd_folder), read_tum),
    "eth3d": Dataset(
        "ETH3D SLAM",
        "folders with rgb.txt, groundtruth.txt and calibration.txt",
        _folders(is_rgbd_folder, 2),
        read_eth3d,
    ),
    "kitti": Dataset("KITTI odometry", "sequences/NN and poses/NN.txt", find_kitti, read_kitti),
    "sintel": Dataset("MPI Sintel", "training/final, training/camdata_left, training/depth", find_sintel, read_sintel),
    "7scenes": Dataset(
        "7-Scenes", "SCENE/seq-NN with frame-000000.color.png", _folders(is_seven_scenes_folder, 2), read_seven_scenes
    ),
    "euroc": Dataset("EuRoC MAV", "SEQUENCE/mav0/cam0", _folders(is_euroc_folder, 2), read_euroc),
    "gt": Dataset("sequences with gt.npz", "folders with gt.npz", _folders(is_gt_npz_folder, 2), read_gt_npz),
}


@dataclass(frozen=True, slots=True)
class SequenceRef:
    """A sequence that was found but not read yet; small, so that it can be handed to another process.

    Attributes:
        dataset: Key of `DATASETS`.
        protocol: Name of the protocol.
        name: Its name in the dataset.
        folder: Where it lies.
        max_frames: Fewer frames than the protocol has, for a quick look.
    """

    dataset: str
    protocol: str
    name: str
    folder: Path
    max_frames: int | None = None

    @property
    def group(self) -> str:
        return protocol_of(self.dataset, self.protocol).group(self.name)

    def load(self) -> GroundTruthSequence:
        """Reads the truth and applies the protocol.

        Raises:
            FormatError: The folder is not of the dataset's layout; names the file.
        """
        sequence = DATASETS[self.dataset].read(self.folder, self.name)
        return shortened(protocol_of(self.dataset, self.protocol).apply(sequence), self.max_frames)


@dataclass(frozen=True, slots=True)
class FoundDataset:
    """What `find_sequences` found.

    Attributes:
        sequences: Those that the protocol judges.
        missing: Names that the protocol has and the folder has not.
    """

    dataset: str
    protocol: Protocol
    sequences: list[SequenceRef]
    missing: list[str]


def find_sequences(
    dataset: str, root: str | Path, protocol: str = "all", max_frames: int | None = None
) -> FoundDataset:
    """The sequences of a dataset below `root`. Reads no truth.

    Raises:
        ConfigError: No such dataset or protocol.
        FormatError: Nothing of the dataset's layout lies there, or nothing that the protocol judges.
    """
    if dataset not in DATASETS:
        raise ConfigError(f"unknown dataset {dataset!r}; on offer: {', '.join(DATASETS)}")
    chosen = protocol_of(dataset, protocol)
    kind = DATASETS[dataset]
    root = Path(root)
    found = kind.find(root)
    if not found:
        raise FormatError(f"{root}: no {kind.title} sequence; {kind.layout} are needed")
    names, missing = chosen.choose(list(found))
    if not names:
        raise FormatError(
            f"{root}: none of its sequences ({', '.join(list(found)[:5])} ...) is in the paper's protocol"
        )
    refs = [SequenceRef(dataset, protocol, name, found[name], max_frames) for name in names]
    return FoundDataset(dataset, chosen, refs, missing)
