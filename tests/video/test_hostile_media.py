"""Files that point elsewhere are not followed, and files that claim or hold too much end as typed errors, cheaply."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import av
import pytest

from benchmarks.hostile import media
from vipe_core.errors import InputError, MediaNotFound, MediaTooLarge, NoVideoStream, VipeError
from vipe_core.video import Limits, open_source
from vipe_core.video.av_decode import Damage, decode
from vipe_core.video.opened import open_media

# What a decoder that trusts its input would be opened with.
_NAIVE = {
    "protocol_whitelist": "file,http,tcp,crypto,data",
    "safe": "0",
    "enable_drefs": "1",
    "use_absolute_path": "1",
    "allowed_extensions": "ALL",
    "extension_picky": "0",
}


@contextmanager
def serving(body: bytes) -> Iterator[tuple[str, list[str]]]:
    """A web server that answers every request with `body`, and the list of what it was asked for."""
    asked: list[str] = []

    class Requests(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_response(200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            return

    server = ThreadingHTTPServer(("127.0.0.1", 0), Requests)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", asked
    finally:
        server.shutdown()
        server.server_close()


def is_red(path: Path, options: dict[str, str]) -> bool:
    """Whether FFmpeg, opened like that, shows the secret."""
    with av.open(str(path), options=options, timeout=5) as container:
        rgb = next(container.decode(video=0)).to_ndarray(format="rgb24")
    return bool(rgb[..., 0].mean() > 200)


def shown(path: Path) -> str:
    """What our decoder makes of a file, here and not in its child: an error's code, or the colour of its pictures."""
    try:
        opened = open_media(str(path), Limits())
        pictures = [frame for _, _, frame in decode(opened, Limits(), 1, Damage(), lambda: None)]
    except VipeError as error:
        return error.code
    red = any(frame.to_ndarray(format="rgb24")[..., 0].mean() > 100 for frame in pictures)
    return "red" if red else "other"


@pytest.fixture(scope="module")
def secrets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("secrets")
    (folder / "secret.ts").write_bytes(media.clip(fmt="mpegts"))
    (folder / "secret.mov").write_bytes(media.clip(fmt="mov"))
    return folder


def test_nothing_that_a_file_names_is_opened(secrets: Path) -> None:
    """By FFmpeg's own rules, without the help of the sandbox. It follows only some of these today."""
    with serving((secrets / "secret.ts").read_bytes()) as (server, asked):
        for target in (str(secrets / "secret.ts"), "secret.ts", f"{server}/secret.ts"):
            hostile = media.playlists(target)
            for kind in ("url ", "alis"):
                hostile[f"{kind.strip()}.mov"] = media.external_reference(
                    target.replace("secret.ts", "secret.mov"), kind
                )
            for name, content in hostile.items():
                (secrets / name).write_bytes(content)
                assert shown(secrets / name) in {"media_unsupported", "media_corrupt", "other"}, f"{name} -> {target}"
        assert asked == []


@pytest.mark.parametrize("name", ["list.m3u8", "list.ffconcat", "alis.mov"])
def test_the_attacks_are_real(secrets: Path, name: str) -> None:
    """Without our options FFmpeg shows what these point to; otherwise the test above proves nothing."""
    target = secrets / "secret.ts"
    alias = media.external_reference(str(secrets / "secret.mov"), "alis")
    (secrets / name).write_bytes({**media.playlists(str(target)), "alis.mov": alias}[name])
    assert is_red(secrets / name, _NAIVE)
    with pytest.raises(InputError, match=name):
        open_source(secrets / name)


def test_a_url_in_a_playlist_would_be_fetched(secrets: Path) -> None:
    with serving((secrets / "secret.ts").read_bytes()) as (server, asked):
        path = secrets / "remote.m3u8"
        path.write_bytes(media.playlists(f"{server}/secret.ts")["list.m3u8"])
        assert is_red(path, _NAIVE)
        assert asked


BOMBS: dict[str, tuple[bytes, dict[str, Any], str]] = {
    "screen.gif": (media.gif(65535, 65535), {}, "media_corrupt"),
    "frames.gif": (media.gif(64, 64, 2000), {"max_frames": 1000}, "media_too_large"),
    "index.mp4": (media.endless_index(100_000_000), {}, "media_too_large"),
    "largest.mp4": (media.endless_index(2**32 - 1), {}, "media_too_large"),
    "cover.mp3": (media.cover_only(media.png(30_000, 30_000)), {}, "no_video_stream"),
    "streams.mkv": (media.many_streams(80), {}, "media_too_large"),
    "leap.mkv": (media.odd_times([0, 40, 2**40]), {}, "media_too_large"),
    "decoded.mp4": (media.clip(30), {"max_decoded_bytes": 100_000}, "media_too_large"),
    "file.mp4": (media.clip(), {"max_file_bytes": 100}, "media_too_large"),
    "memory.mp4": (media.clip(2, (4096, 4096)), {"max_memory_bytes": 32 << 20}, "media_too_large"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_bombs(tmp_path: Path, name: str) -> None:
    content, limits, code = BOMBS[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name) as caught:
        list(open_source(tmp_path / name, limits=Limits(**limits)).frames())
    assert caught.value.code == code


IMAGES = {
    "claimed.png": media.png(100_000, 100_000, 10),
    "whole.png": media.png(60_000, 60_000),
    "frame.jpg": media.jpeg_header(65_500, 65_500),
    "side.bmp": media.bmp_header(2**31 - 1, 2**31 - 1),
    "area.bmp": media.bmp_header(200_000, 200_000),
    "area.tiff": media.tiff_header(200_000, 200_000),
    "side.tif": media.tiff_header(2**32 - 1, 2**32 - 1),
}


@pytest.mark.parametrize("name", IMAGES)
def test_images_that_would_fill_the_memory(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(IMAGES[name])
    with pytest.raises(InputError, match=name) as caught:
        open_source(tmp_path)
    assert caught.value.code in {"media_too_large", "media_corrupt"}


def test_frames_that_are_late_end_the_clip_with_an_error(tmp_path: Path) -> None:
    """The container may say nothing, or something else, about how long it takes."""
    (tmp_path / "late.mkv").write_bytes(media.odd_times([0, 40, 50_000]))
    source = open_source(tmp_path / "late.mkv", limits=Limits(max_duration_s=60))
    assert len(list(source.frames())) == 3
    with pytest.raises(MediaTooLarge, match=r"late\.mkv"):
        open_source(tmp_path / "late.mkv", limits=Limits(max_duration_s=49))


def test_a_cover_is_no_video(tmp_path: Path) -> None:
    (tmp_path / "song.mp3").write_bytes(media.cover_only(media.png(64, 64)))
    with pytest.raises(NoVideoStream):
        open_source(tmp_path / "song.mp3")


def test_an_image_that_becomes_a_link_out_of_its_directory(tmp_path: Path) -> None:
    """Between listing and reading; what was opened is judged, not its name."""
    folder = tmp_path / "images"
    folder.mkdir()
    for index in range(2):
        (folder / f"{index}.png").write_bytes(media.png(64, 64))
    (tmp_path / "secret.png").write_bytes(media.png(64, 64))
    source = open_source(folder)
    (folder / "1.png").unlink()
    (folder / "1.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(MediaNotFound, match=r"1\.png.*leads out"):
        list(source.frames())
