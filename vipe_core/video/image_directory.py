"""Frames of a directory of images, in plain order of their names."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vipe_core.errors import EmptyMedia, MediaNotFound
from vipe_core.video.limits import Limits, default_limits
from vipe_core.video.naming import sanitise_name
from vipe_core.video.probe import is_directory
from vipe_core.video.process import DecoderProcess, report_protections
from vipe_core.video.source import Frame, FrameStream, VideoInfo
from vipe_core.video.video_file import STALL_S, check_range
from vipe_core.video.wire import Request

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"})
IMAGE_FPS = 30.0
# The request is one argument of a process, which Linux limits to 128 KiB; a name has up to 255 bytes.
_IMAGES_PER_CHILD = 128


class ImageDirectorySource:
    """`FrameSource` over the images of one directory (not of its sub-directories).

    Order is the plain lexicographic order of file names, so that "10.jpg" comes before "9.jpg": number with leading
    zeros. Hidden files and links out of the directory are skipped. Images are decoded in a killable child, like videos.

    Args:
        path: Directory.
        limits: Bounds on picture size and number of images.
        name: Name of the sequence; the sanitised directory name if None.
        fps: Frame rate that gives the images their timestamps.
        stall_s: Seconds for one image after which the child is killed (DecodeTimeout).
        files: Names of the images to take, in this order, where the directory holds others too; all in order of names
            if None.

    Raises:
        MediaNotFound: No such directory, or one of `files` is not in it.
        EmptyMedia: No image in it.
        CorruptMedia, MediaTooLarge: The first image; names it.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        limits: Limits | None = None,
        name: str | None = None,
        fps: float = IMAGE_FPS,
        stall_s: float = STALL_S,
        files: Sequence[str] | None = None,
    ) -> None:
        if not fps > 0:
            raise ValueError(f"fps must be positive, got {fps}")
        self._limits = limits or default_limits()
        self._stall_s = stall_s
        self._root = Path(path).absolute()
        listed = _list_images(self._root)
        self._files = listed if files is None else _choose(self._root, listed, files)
        self._limits.check_length(self._root.name, len(self._files), None)
        with DecoderProcess(
            self._request("probe", self._files[:1], fps, None, 0, None), self._root.name, stall_s, stall_s
        ) as child:
            document = child.document()
        report_protections(document)
        size = document["info"]
        try:
            size_bytes = sum(file.stat().st_size for file in self._files)
        except OSError as error:
            raise MediaNotFound(f"{self._root.name}: the images changed while they were read; try again") from error
        first = self._files[0]
        self._info = VideoInfo(
            name=name or sanitise_name(self._root.name),
            path=str(path),
            width=size["width"],
            height=size["height"],
            fps=fps,
            num_frames_hint=len(self._files),
            duration_s=len(self._files) / fps,
            rotation_deg=0,
            codec=first.suffix.lower().lstrip("."),
            pixel_format="rgb24",
            size_bytes=size_bytes,
            frame_names=tuple(file.stem for file in self._files),
        )

    @property
    def info(self) -> VideoInfo:
        return self._info

    @property
    def damage(self) -> str | None:
        """Always None: a broken image is an error that names it, since leaving it out would shift every later index."""
        return None

    def frames(self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None) -> FrameStream:
        """See `FrameSource.frames`."""
        check_range(size, start, stop)
        end = len(self._files) if stop is None else min(stop, len(self._files))
        for begin in range(start, end, _IMAGES_PER_CHILD):
            # The first image goes along as the measure of size.
            chunk = [self._files[0], *self._files[begin : min(end, begin + _IMAGES_PER_CHILD)]]
            request = self._request("decode", chunk, self._info.fps, size, 1, None)
            with DecoderProcess(request, self._root.name, self._stall_s) as child:
                for item in child.frames():
                    if isinstance(item, Frame):
                        index = begin + item.index - 1
                        yield Frame(index, index / self._info.fps, item.rgb)

    def _request(
        self, task: str, files: list[Path], fps: float, size: tuple[int, int] | None, start: int, stop: int | None
    ) -> Request:
        return Request(
            task=task,
            root=str(self._root),
            files=tuple(file.name for file in files),
            images=True,
            limits=self._limits,
            size=size,
            start=start,
            stop=stop,
            fps=fps,
            threads=1,
            stall_s=self._stall_s,
        )


def _list_images(root: Path) -> list[Path]:
    if not is_directory(root):
        raise MediaNotFound(f"{root.name}: no such directory; check the path")
    try:
        entries = [file for file in root.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES and file.is_file()]
    except OSError as error:
        raise MediaNotFound(f"{root.name}: {error.strerror or 'cannot be listed'}; check the path") from error
    files = sorted((file for file in entries if not file.name.startswith(".")), key=lambda file: file.name)
    # A link out of the directory would show what its owner may read and the caller may not.
    inside = root.resolve()
    files = [file for file in files if not file.is_symlink() or file.resolve().is_relative_to(inside)]
    if not files:
        kinds = " ".join(sorted(IMAGE_SUFFIXES))
        raise EmptyMedia(f"{root.name}: the directory holds no image; supported are {kinds}")
    return files


def _choose(root: Path, listed: list[Path], names: Sequence[str]) -> list[Path]:
    by_name = {file.name: file for file in listed}
    missing = next((name for name in names if name not in by_name), None)
    if missing is not None:
        raise MediaNotFound(f"{root.name}/{missing}: no such image; was the download cut short?")
    if not names:
        raise EmptyMedia(f"{root.name}: none of its images was chosen")
    return [by_name[name] for name in names]
