"""What a video is, before it is decoded: `probe` opens it in a killable child and decodes one picture."""

from __future__ import annotations

import stat
from pathlib import Path

from vipe_core.errors import EmptyMedia, UnsupportedMedia
from vipe_core.video.limits import Limits, default_limits
from vipe_core.video.naming import sanitise_name
from vipe_core.video.opened import not_found
from vipe_core.video.process import DecoderProcess, report_protections
from vipe_core.video.source import VideoInfo
from vipe_core.video.wire import Request

PROBE_BUDGET_S = 60.0


def is_directory(path: Path) -> bool:
    """`Path.is_dir`, with a typed error for what cannot be looked at.

    Raises:
        MediaNotFound: No permission to look, or a name that no file can have.
    """
    try:
        return stat.S_ISDIR(path.stat().st_mode)
    except FileNotFoundError:
        return False
    except (OSError, ValueError) as error:
        raise not_found(path.name, error) from error


def file_size_bytes(path: Path) -> int:
    """Size of a regular, non-empty, readable file.

    Raises:
        MediaNotFound: No such file, or no permission to read it.
        UnsupportedMedia: A pipe, a device or a socket.
        EmptyMedia: Zero bytes.
    """
    try:
        status = path.stat()
        if stat.S_ISREG(status.st_mode):
            path.open("rb").close()
    except (OSError, ValueError) as error:
        raise not_found(path.name, error) from error
    if not stat.S_ISREG(status.st_mode):
        raise UnsupportedMedia(f"{path.name}: not a regular file; provide a video file or a directory of images")
    if status.st_size == 0:
        raise EmptyMedia(f"{path.name}: the file has zero bytes; check that the upload is complete")
    return status.st_size


def probe(
    path: str | Path, *, limits: Limits | None = None, name: str | None = None, budget_s: float = PROBE_BUDGET_S
) -> VideoInfo:
    """Describe a video file.

    Args:
        path: A regular file. Only self-contained containers are opened, and nothing that they refer to.
        limits: Bounds on picture size and length; the defaults of `Limits` if None.
        name: Name of the sequence; the sanitised stem if None.
        budget_s: Wall seconds after which the child is killed.

    Raises:
        InputError: MediaNotFound, EmptyMedia, CorruptMedia, NoVideoStream, UnsupportedMedia or MediaTooLarge.
        DecodeTimeout, DecodeCrashed: The child hangs or died.
    """
    path = Path(path)
    size_bytes = file_size_bytes(path)
    request = Request(
        task="probe",
        root=str(path.absolute().parent),
        files=(path.name,),
        images=False,
        limits=limits or default_limits(),
        size=None,
        start=0,
        stop=None,
        fps=0.0,
        threads=1,
        stall_s=budget_s,
    )
    with DecoderProcess(request, path.name, stall_s=budget_s, wall_s=budget_s) as child:
        document = child.document()
    report_protections(document)
    return VideoInfo(name=name or sanitise_name(path.stem), path=str(path), size_bytes=size_bytes, **document["info"])
