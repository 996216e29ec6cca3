"""What reads bytes from outside, each as one function of bytes, with examples to start from.

A target returns, or raises a typed error of the engine or the service. Anything else is a finding.
"""

from __future__ import annotations

import io
import json
import tarfile
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.hostile import media


@dataclass(frozen=True, slots=True)
class Target:
    """One reader.

    Attributes:
        seeds: Makes examples that the reader understands, and some that it refuses.
        read: Reads bytes to the end.
        crashes_are_contained: Whether the product runs it in a process of its own, so that a crash costs one video.
    """

    seeds: Callable[[], list[bytes]]
    read: Callable[[bytes], object]
    crashes_are_contained: bool = False


def _media_seeds() -> list[bytes]:
    clips = [
        media.clip(4, (64, 48), fmt) for fmt in ("mp4", "mov", "matroska", "avi", "mpegts", "ogg", "nut", "flv")[:5]
    ]
    lists = list(media.playlists("/etc/passwd").values())[:3]
    odd = [media.gif(64, 48, 5), media.endless_index(1000), media.cover_only(media.png(8, 8)), media.many_streams(4)]
    return [*clips, *odd, *lists, media.avi_with_text(b"#EXTM3U"), media.external_reference("/etc/passwd", "alis")]


def _read_media(data: bytes) -> object:
    from vipe_core.video.av_decode import Damage, PictureConverter, decode, describe
    from vipe_core.video.limits import Limits
    from vipe_core.video.opened import OpenedMedia

    limits = Limits(max_pixels=1 << 20, max_frames=500, max_decoded_bytes=1 << 28)
    file = io.BytesIO(data)
    file.name = "clip"
    opened = OpenedMedia(file, "clip")
    described = describe(opened, limits)
    converter = PictureConverter("clip", (32, 24), limits)
    for _, _, frame in decode(opened, limits, 1, Damage(), lambda: None):
        converter.convert(frame)
    return described


def _image_seeds() -> list[bytes]:
    import cv2

    picture = np.random.default_rng(1).integers(0, 255, (24, 32, 3), dtype=np.uint8)
    encoded = [cv2.imencode(suffix, picture)[1].tobytes() for suffix in (".png", ".jpg", ".bmp", ".tiff", ".webp")]
    return [*encoded, media.png(64, 64), media.jpeg_header(64, 64), media.tiff_header(64, 64), media.bmp_header(64, 64)]


def _read_image(data: bytes) -> object:
    from vipe_core.video.image_decode import read_image
    from vipe_core.video.limits import Limits
    from vipe_core.video.opened import OpenedMedia

    return read_image(OpenedMedia(io.BytesIO(data), "image"), Limits(max_pixels=1 << 20)).shape


_ROWS = [{"uri": f"s3://bucket/clip {n}.mp4", "key": f"clip-{n}", "size_bytes": n, "etag": f'"{n}"'} for n in range(20)]


def _csv_seeds() -> list[bytes]:
    plain = "uri,key,size_bytes,etag\n" + "".join(f"{r['uri']},{r['key']},{r['size_bytes']},x\n" for r in _ROWS)
    return [plain.encode(), '\ufeffcaption,uri\r\n"a ""b""\nc",/v/ü.mp4\r\n'.encode()]


def _json_seeds() -> list[bytes]:
    return ["".join(json.dumps(row) + "\n" for row in _ROWS).encode(), '{"uri":"/v/ü.mp4","x":[{"y":1e9}]}\n'.encode()]


def _parquet_seeds() -> list[bytes]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    seeds = []
    for options in (
        {"compression": "snappy"},
        {"compression": "none", "use_dictionary": False},
        {"compression": "zstd"},
    ):
        buffer = io.BytesIO()
        pq.write_table(pa.Table.from_pylist(_ROWS), buffer, **options)
        seeds.append(buffer.getvalue())
    return seeds


def _manifest_reader(name: str) -> Callable[[bytes], object]:
    def read(data: bytes) -> object:
        from services.planner.manifest import read_manifest

        with tempfile.TemporaryFile() as file:
            file.write(data)
            file.seek(0)
            return sum(1 for _ in read_manifest(file, name, max_rows=1000))

    return read


def _tar_seeds() -> list[bytes]:
    seeds = []
    for kind in (tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT, tarfile.PAX_FORMAT):
        buffer = io.BytesIO()
        with tarfile.open(fileobj=buffer, mode="w", format=kind) as tar:
            for number in range(3):
                for extension in ("npz", "json"):
                    info = tarfile.TarInfo(
                        f"sample-{number}" + "x" * 120 * (kind != tarfile.USTAR_FORMAT) + f".{extension}"
                    )
                    info.size = 600
                    info.mtime = 1.5 if kind == tarfile.PAX_FORMAT else 0
                    tar.addfile(info, io.BytesIO(bytes(600)))
        seeds.append(buffer.getvalue())
    return seeds


def _read_tar(data: bytes) -> object:
    from services.commit.tar_reader import read_members

    return sum(len(contents.read()) for _, _, _, contents in read_members(io.BytesIO(data), "shard.tar"))


def _exr_seeds() -> list[bytes]:
    from vipe_core.formats.exr import encode_depth

    depth = np.random.default_rng(2).random((24, 32), dtype=np.float32)
    return [encode_depth(depth), encode_depth(np.ones((3, 200), np.float32))]


def _read_exr(data: bytes) -> object:
    from vipe_core.formats.exr import decode_depth

    return decode_depth(data).shape


def _zip_seeds() -> list[bytes]:
    from vipe_core.formats.depth_zip import DepthZipWriter

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "depth.zip")
        with DepthZipWriter(path) as writer:
            for scale in (1, 2):
                writer.append(np.full((12, 16), scale, np.float32))
        return [path.read_bytes()]


def _read_zip(data: bytes) -> object:
    from vipe_core.formats.depth_zip import DepthZipReader

    with DepthZipReader(io.BytesIO(data), label="depth.zip") as reader:
        return [reader.read(index).shape for index in range(len(reader))]


def _npz_seeds() -> list[bytes]:
    seeds = []
    for save in (np.savez, np.savez_compressed):
        buffer = io.BytesIO()
        save(buffer, data=np.tile(np.eye(4, dtype=np.float32), (5, 1, 1)), inds=np.arange(5))
        seeds.append(buffer.getvalue())
    return seeds


def _read_npz(data: bytes) -> object:
    from vipe_core.formats.reading import read_npz

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "pose.npz")
        path.write_bytes(data)
        return read_npz(path)[0].shape


TARGETS: dict[str, Target] = {
    "media": Target(_media_seeds, _read_media, crashes_are_contained=True),
    "image": Target(_image_seeds, _read_image, crashes_are_contained=True),
    "csv": Target(_csv_seeds, _manifest_reader("list.csv")),
    "jsonl": Target(_json_seeds, _manifest_reader("list.jsonl")),
    "parquet": Target(_parquet_seeds, _manifest_reader("list.parquet")),
    "tar": Target(_tar_seeds, _read_tar),
    "exr": Target(_exr_seeds, _read_exr),
    "zip": Target(_zip_seeds, _read_zip),
    "npz": Target(_npz_seeds, _read_npz),
}
