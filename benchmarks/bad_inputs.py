"""Bad inputs of all kinds and the answer each one gets: `python -m benchmarks.bad_inputs` writes docs/bad-inputs.md."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import io
import ipaddress
import json
import os
import re
import struct
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any, ParamSpec

import cv2
import numpy as np

from benchmarks.hostile import media
from services.domain.errors import ServiceError
from vipe_core.errors import VipeError

_LENS = {"version": 1, "model": "pinhole", "width": 96, "height": 64, "fx": 90, "fy": 90, "cx": 48, "cy": 32}
PAGE = Path(__file__).resolve().parents[1] / "docs" / "bad-inputs.md"

P = ParamSpec("P")


@dataclass(frozen=True, slots=True)
class Answer:
    """What one bad input got.

    Attributes:
        expected: The code that it must get.
        code: The code that it got; the name of the exception where it was no typed error, `accepted` where it was none.
    """

    kind: str
    what: str
    expected: str
    code: str
    message: str


@dataclass(slots=True)
class _Bench:
    """A folder to make inputs in, and what was found out."""

    folder: Path
    answers: list[Answer] = field(default_factory=list)

    def file(self, name: str, content: bytes | str = b"") -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    def tried(
        self, kind: str, what: str, expected: str, attempt: Callable[P, object], *arguments: P.args, **options: P.kwargs
    ) -> None:
        try:
            attempt(*arguments, **options)
            code, message = "accepted", ""
        except (VipeError, ServiceError) as error:
            code, message = error.code, str(error)
        except Exception as error:
            code, message = type(error).__name__, str(error)
        self.noted(kind, what, expected, code, message)

    def noted(self, kind: str, what: str, expected: str, code: str, message: str) -> None:
        shown = message.replace(str(self.folder), "/data")
        shown = re.sub(r"127\.0\.0\.1:\d+", "127.0.0.1:8000", shown)
        self.answers.append(Answer(kind, what, expected, code, shown))


def try_all() -> list[Answer]:
    """Try everything, in the order of the table."""
    with tempfile.TemporaryDirectory(prefix="bad-inputs-") as name:
        bench = _Bench(Path(os.path.realpath(name)))
        for part in (_media, _images, _options, _cameras, _lists, _addresses, _downloads, _requests, _archives):
            part(bench)
        return bench.answers


def _media(bench: _Bench) -> None:
    from vipe_core.video import Limits, open_source

    clip = media.clip(12)
    other = bench.file("other.ts", media.clip(fmt="mpegts"))
    playlists = media.playlists(str(other))
    cases: list[tuple[str, bytes, str, str, dict[str, Any]]] = [
        ("zero.mp4", b"", "an empty file", "media_empty", {}),
        ("text.mp4", b"this is not a video\n" * 50, "a text file", "media_corrupt", {}),
        ("page.mp4", b"<html><body>404</body></html>", "a web page in place of the video", "media_corrupt", {}),
        ("cut.mp4", clip[: len(clip) // 2], "an MP4 cut off before its index", "media_corrupt", {}),
        ("photo.mp4", media.png(64, 64), "a single image", "media_unsupported", {}),
        ("sound.mp3", media.cover_only(media.png(64, 64)), "a song with a cover picture", "no_video_stream", {}),
        ("list.m3u8", playlists["list.m3u8"], "a playlist that names a local file", "media_unsupported", {}),
        ("list.mp4", playlists["list.mp4"], "the same, called mp4", "media_unsupported", {}),
        ("key.m3u8", playlists["key.m3u8"], "a playlist that names a key file", "media_unsupported", {}),
        ("concat.mkv", playlists["concat.mkv"], "a concat list that names a local file", "media_unsupported", {}),
        ("list.mpd", playlists["list.mpd"], "a DASH manifest", "media_unsupported", {}),
        ("list.sdp", playlists["list.sdp"], "a session description", "media_unsupported", {}),
        ("alias.mov", media.external_reference(str(other), "alis"), "QuickTime whose samples lie in another file",
         "media_corrupt", {}),
        ("subtitle.avi", playlists["subtitle.avi"], "an AVI with a playlist as subtitles", "media_corrupt", {}),
        ("index.mp4", media.endless_index(2**32 - 1), "an index of 4 billion frames in 1 KB", "media_too_large", {}),
        ("screen.gif", media.gif(65535, 65535), "a GIF of 65535x65535", "media_corrupt", {}),
        ("streams.mkv", media.many_streams(80), "80 streams", "media_too_large", {}),
        ("leap.mkv", media.odd_times([0, 40, 2**40]), "a frame 34,000 years later", "media_too_large", {}),
        ("wide.mp4", clip, "a picture above the limit of pixels", "media_too_large", {"max_pixels": 1000}),
        ("long.mp4", clip, "more frames than the limit", "media_too_large", {"max_frames": 5}),
        ("slow.mp4", clip, "longer than the limit", "media_too_large", {"max_duration_s": 0.1}),
        ("bytes.mp4", clip, "more decoded bytes than the limit", "media_too_large", {"max_decoded_bytes": 9999}),
        ("heavy.mp4", clip, "a larger file than the limit", "media_too_large", {"max_file_bytes": 100}),
        ("memory.mp4", media.clip(2, (4096, 4096)), "more memory than the limit", "media_too_large",
         {"max_memory_bytes": 32 << 20}),
    ]  # fmt: skip
    for name, content, what, code, limits in cases:
        path = bench.file(name, content)
        bench.tried(
            "media",
            what,
            code,
            lambda at, within: list(open_source(at, limits=within).frames()),
            path,
            Limits(**limits),
        )
    bench.tried("media", "a file that is not there", "media_not_found", lambda: open_source(bench.folder / "none.mp4"))
    os.mkfifo(bench.folder / "pipe.mp4")
    bench.tried("media", "a named pipe", "media_unsupported", lambda: open_source(bench.folder / "pipe.mp4"))
    bench.tried("media", "a device", "media_unsupported", lambda: open_source("/dev/zero"))


def _images(bench: _Bench) -> None:
    from vipe_core.video import MaskedView, open_source

    cases = [
        ("empty", {}, "a directory without images", "media_empty"),
        ("broken", {"0.png": b"no image"}, "an image that is none", "media_corrupt"),
        ("sizes", {"0.png": media.png(64, 64), "1.png": media.png(32, 64)}, "images of two sizes", "media_corrupt"),
        ("bomb", {"0.png": media.png(60_000, 60_000)}, "a PNG of 3.6 gigapixels in 0.5 MB", "media_too_large"),
        (
            "claim",
            {"0.bmp": media.bmp_header(200_000, 200_000)},
            "a BMP of 40 gigapixels in 54 bytes",
            "media_too_large",
        ),
        ("tiff", {"0.tiff": media.tiff_header(200_000, 200_000)}, "a TIFF of 40 gigapixels", "media_too_large"),
    ]
    for folder, files, what, code in cases:
        (bench.folder / folder).mkdir()
        for name, content in files.items():
            bench.file(f"{folder}/{name}", content)
        path = bench.folder / folder
        bench.tried("images", what, code, lambda at: list(open_source(at).frames()), path)
    linked = bench.folder / "linked"
    linked.mkdir()
    (linked / "0.png").symlink_to(bench.file("outside.png", media.png(64, 64)))
    bench.tried("images", "a link that leaves the directory", "media_empty", lambda: open_source(linked))
    masks = bench.file("masks/0.png", media.png(32, 32)).parent
    picture = bench.file("pictures/0.png", media.png(64, 64)).parent
    bench.tried("images", "masks of another size", "mask_mismatch", lambda: MaskedView(open_source(picture), masks))


def _options(bench: _Bench) -> None:
    from vipe_core.cameras import Camera
    from vipe_core.depth.known import KnownLength
    from vipe_core.pipeline.annotator import Annotator
    from vipe_core.video import Limits

    for text in ("height", "height=-1", "height=tall", "depth=3", "depth=3@1,2", "width=2", "path=inf"):
        bench.tried("options", f"`--scale-from {text}`", "invalid_config", KnownLength.parse, text)
    bench.tried("options", "a preset that is not there", "invalid_config", lambda: Annotator(preset="magic"))
    bench.tried("options", "a camera that is not there", "invalid_config", lambda: Annotator(camera="periscope"))
    bench.tried("options", "a device that is not there", "invalid_config", lambda: Annotator(device="abacus"))
    bench.tried(
        "options", "a focal length of 0", "invalid_config", lambda: Camera("pinhole", (0.0, 0.0, 1.0, 1.0), 4, 4)
    )
    bench.tried("options", "a limit of 0", "invalid_config", lambda: Limits(max_frames=0))


def _cameras(bench: _Bench) -> None:
    from vipe_core.cameras.calibration import Calibration
    from vipe_core.cameras.calibration_files import read_calibration
    from vipe_core.pipeline.annotator import Annotator

    lens = _LENS
    bent = {**lens, "model": "opencv", "distortion": [-0.9, 0, 0, 0]}
    fisheye = {**lens, "model": "opencv_fisheye", "distortion": [-2, 0, 0, 0]}
    row = "1 PINHOLE 96 64 90 90 48 32\n"
    files: list[tuple[str, str, str]] = [
        ("a calibration without a focal length", "camera.json", json.dumps({k: lens[k] for k in lens if k != "fx"})),
        ("one of version 2", "camera.json", json.dumps({**lens, "version": 2})),
        ("a key that is not there", "camera.json", json.dumps({**lens, "focal": 90})),
        ("a focal length that is not a number", "camera.json", json.dumps({**lens, "fx": float("nan")})),
        ("a negative focal length", "camera.json", json.dumps({**lens, "fx": -90})),
        ("a focal length in millimetres", "camera.json", json.dumps({**lens, "fx": 3.6, "fy": 3.6})),
        ("a principal point outside of the picture", "camera.json", json.dumps({**lens, "cx": 300})),
        ("distortion without a model of it", "camera.json", json.dumps({**lens, "distortion": [0.1, 0, 0, 0]})),
        ("distortion that folds the picture", "camera.json", json.dumps(bent)),
        ("a fisheye that folds the picture", "camera.json", json.dumps(fisheye)),
        ("JSON a hundred thousand deep", "camera.json", '{"a":' * 100_000),
        ("a list of two cameras", "cameras.txt", row + row),
        ("a camera of COLMAP that we do not know", "cameras.txt", row.replace("PINHOLE", "THIN_PRISM_FISHEYE")),
        ("OpenCV's YAML without a matrix", "lens.yml", "%YAML:1.0\n---\nimage_width: 96\nimage_height: 64\n"),
        ("nerfstudio's file with a camera per frame", "transforms.json", '{"frames": [{"fl_x": 90}]}'),
        ("prose in place of a calibration", "lens.txt", "about ninety pixels\n"),
    ]
    for what, name, content in files:
        path = bench.file(f"lenses/{name}", content)
        bench.tried("cameras", what, "invalid_config", read_calibration, path)
    clip = bench.file("lenses/clip.mp4", media.clip(3))
    square = Calibration.from_json({**lens, "height": 96})
    speckles = np.random.default_rng(0).integers(0, 255, (8, 12, 3), dtype=np.uint8)
    picture = cv2.imencode(".png", cv2.resize(speckles, (96, 64), interpolation=cv2.INTER_NEAREST))[1].tobytes()
    room = bench.file("lenses/room/0.png", picture).parent
    panoramas, others = Annotator("panorama"), Annotator()
    bench.tried("cameras", "a calibration of another aspect", "calibration_mismatch",
                lambda: others.annotate(clip, calibration=square))  # fmt: skip
    bench.tried("cameras", "a calibration of a panorama", "invalid_config",
                lambda: panoramas.annotate(clip, calibration=square))  # fmt: skip
    bench.tried("cameras", "an ordinary video as a panorama", "media_unsupported",
                lambda: panoramas.annotate(room))  # fmt: skip


def _lists(bench: _Bench) -> None:
    from services.inputs.rules import InputRules
    from services.network import NetworkPolicy
    from services.planner.listing import expand

    rules = InputRules(
        roots=(bench.folder,), buckets=("videos",), network=NetworkPolicy(("media.example",)), max_rows=3
    )
    cases: list[tuple[str, bytes | str, str, str]] = [
        ("empty.csv", "", "an empty CSV", "invalid_manifest"),
        ("column.csv", "url\ns3://videos/a.mp4\n", "no column `uri`", "invalid_manifest"),
        ("short.csv", "uri,key\ns3://videos/a.mp4\n", "a row with a value missing", "invalid_manifest"),
        ("latin.csv", b"uri\n/caf\xe9.mp4\n", "text that is not UTF-8", "invalid_manifest"),
        ("quote.csv", 'uri\n"s3://videos/a.mp4\n', "a quote that never ends", "invalid_manifest"),
        ("line.csv", "uri\n" + "a" * (2 << 20), "a line of 2 MB", "input_too_large"),
        ("rows.csv", "uri\n" + "s3://videos/a.mp4\n" * 4, "more rows than allowed", "input_too_large"),
        ("prose.jsonl", "all the videos\n", "JSON lines that are prose", "invalid_manifest"),
        ("number.jsonl", '{"uri": 7}\n', "a number in place of a `uri`", "invalid_manifest"),
        ("key.jsonl", '{"uri": "s3://videos/a.mp4", "key": "../a"}\n', "a key with a path", "invalid_manifest"),
        ("control.jsonl", '{"uri": "s3://videos/a\\u0000.mp4"}\n', "a NUL in an address", "invalid_manifest"),
        (
            "turned.jsonl",
            '{"uri": "s3://videos/\\u202egpj.mp4"}\n',
            "a character that turns the text",
            "invalid_manifest",
        ),
        ("relative.jsonl", '{"uri": "clips/a.mp4"}\n', "a relative path", "invalid_manifest"),
        ("secret.jsonl", '{"uri": "/etc/passwd"}\n', "a row outside of the roots", "invalid_manifest"),
        (
            "host.jsonl",
            '{"uri": "http://169.254.169.254/latest/"}\n',
            "a row on a host that is not allowed",
            "invalid_manifest",
        ),
        ("bucket.jsonl", '{"uri": "s3://other/a.mp4"}\n', "a row in a bucket that is not allowed", "invalid_manifest"),
        ("cut.parquet", b"PAR1 and nothing else", "a parquet file that is none", "invalid_manifest"),
    ]
    for name, content, what, code in cases:
        path = bench.file(f"lists/{name}", content)
        bench.tried("lists", what, code, lambda at: list(expand(at, rules)), str(path))


def _addresses(bench: _Bench) -> None:
    from services.inputs.rules import InputRules
    from services.network import GuardedHttp, NetworkPolicy
    from services.planner.listing import expand

    root = bench.folder / "root"
    root.mkdir()
    (root / "link.mp4").symlink_to(bench.file("secret.mp4", b"secret"))
    os.mkfifo(root / "pipe.mp4")
    rules = InputRules(roots=(root,), buckets=("videos",), network=NetworkPolicy(("media.example", "127.0.0.1:*")))
    for uri, what, code in (
        ("/etc/passwd", "a path outside of the roots", "input_unavailable"),
        (f"{root}/../secret.mp4", "a path that climbs out of the roots", "input_unavailable"),
        (f"{root}/link.mp4", "a link out of the roots", "input_unavailable"),
        (f"{root}/pipe.mp4", "a named pipe", "input_unavailable"),
        (f"{root}/none.mp4", "a path that is not there", "input_unavailable"),
        (str(root), "a directory without videos", "input_unavailable"),
        ("/proc/self/environ", "the environment of the process", "input_unavailable"),
        ("file:///etc/passwd", "a `file:` address", "invalid_request"),
        ("ftp://media.example/a.mp4", "a scheme that is not known", "invalid_request"),
        ("-i", "an option in place of an address", "invalid_request"),
        ("s3://other/a.mp4", "a bucket that is not allowed", "address_refused"),
        ("http://other.example/a.mp4", "a host that is not allowed", "address_refused"),
        ("http://media.example:22/", "a port that is not allowed", "address_refused"),
        ("http://user:hush@media.example/a.mp4", "credentials in a URL", "address_refused"),
        ("http://media.example/a.mp4?X-Amz-Signature=hush", "a signed URL", "address_refused"),
        ("http://media.example\\@other.example/", "a URL that two parsers read differently", "address_refused"),
        ("http://127.0.0.1:8080/v1/jobs", "the service's own address", "address_refused"),
    ):
        bench.tried("addresses", what, code, lambda at: list(expand(at, rules)), uri)
    everywhere = NetworkPolicy(("*:*",))

    def get(url: str) -> None:
        with GuardedHttp(everywhere) as http, http.open("GET", url, follow_redirects=True) as answer:
            b"".join(answer.body)

    for url, what in (
        ("http://169.254.169.254/latest/meta-data/", "the metadata address of a cloud"),
        ("http://[::ffff:169.254.169.254]/", "the same as an IPv6 address"),
        ("http://2130706433/", "loopback as one number"),
        ("http://[::1]/", "IPv6 loopback"),
        ("http://10.0.0.1/", "a private address"),
        ("http://100.64.0.1/", "an address shared by carriers"),
        ("http://[64:ff9b::7f00:1]/", "loopback behind a translator"),
    ):
        bench.tried("addresses", what, "address_refused", get, url)


@contextlib.contextmanager
def _server(pages: dict[str, tuple[int, dict[str, str], bytes]]) -> Iterator[str]:
    class Requests(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            status, headers, body = pages.get(self.path, (404, {}, b""))
            self.send_response(status)
            for name, value in {"Content-Length": str(len(body)), **headers}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            return

    server = ThreadingHTTPServer(("127.0.0.1", 0), Requests)
    Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()


def _downloads(bench: _Bench) -> None:
    from services.inputs.download import download
    from services.network import GuardedHttp, NetworkPolicy

    pages = {
        "/forbidden.mp4": (403, {}, b""),
        "/broken.mp4": (500, {}, b""),
        "/short.mp4": (200, {"Content-Length": "1000"}, b"short"),
        "/large.mp4": (200, {}, bytes(5000)),
        "/zipped.mp4": (200, {"Content-Encoding": "gzip"}, b"\x1f\x8b"),
        "/changed.mp4": (200, {"ETag": '"new"'}, b"video"),
        "/inside.mp4": (302, {"Location": "http://127.0.0.2/secret"}, b""),
        "/again.mp4": (302, {"Location": "/again.mp4"}, b""),
    }
    policy = NetworkPolicy(("127.0.0.1:*", "127.0.0.2"), (ipaddress.ip_network("127.0.0.1/32"),))
    with _server(pages) as url, GuardedHttp(policy, read_timeout_s=5) as http:
        for path, what, code in (
            ("/none.mp4", "a file that the server does not have", "input_unavailable"),
            ("/forbidden.mp4", "a file that needs credentials", "input_unavailable"),
            ("/broken.mp4", "a server in trouble", "http_failed"),
            ("/short.mp4", "a server that breaks off", "http_failed"),
            ("/large.mp4", "more bytes than allowed", "input_too_large"),
            ("/zipped.mp4", "a compressed answer", "input_unavailable"),
            ("/changed.mp4", "a file that changed since it was planned", "input_unavailable"),
            ("/inside.mp4", "a redirect to a private address", "address_refused"),
            ("/again.mp4", "a redirect to itself", "address_refused"),
        ):
            etag = '"old"' if path == "/changed.mp4" else None
            bench.tried(
                "downloads",
                what,
                code,
                download,
                http,
                url + path,
                bench.folder / "got",
                max_bytes=1000,
                etag=etag,
                sleep=lambda _: None,
            )


def _requests(bench: _Bench) -> None:
    import httpx

    from services.api.app import create_app
    from services.settings import Settings
    from services.store.sql import SqlStore

    good = {"inputs": ["/data/videos"], "output": "/data/out"}
    store = SqlStore(f"sqlite:///{bench.folder}/store.db")
    settings = Settings(data_dir=bench.folder, output_roots=(Path("/data"),))
    app = create_app(store, settings)

    async def ask(content: Any, headers: dict[str, str]) -> httpx.Response:
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            return await client.post("/v1/jobs", content=content, headers=headers)

    def post(what: str, code: str, content: Any = None, headers: dict[str, str] | None = None, **changes: Any) -> None:
        body = content if content is not None else json.dumps({**good, **changes})
        answer = asyncio.run(ask(body, {"Content-Type": "application/json", **(headers or {})}))
        problem = answer.json()
        first = next(iter(problem.get("errors") or ()), None)
        message = f"{first['field']}: {first['message']}" if first else str(problem.get("detail"))
        bench.noted("requests", what, code, str(problem.get("code", answer.status_code)), message)

    with contextlib.closing(store):
        post("no inputs", "invalid_request", inputs=[])
        post("a relative input", "invalid_request", inputs=["videos"])
        post("an input that climbs", "invalid_request", inputs=["/data/../etc/passwd"])
        post("an input with a line break", "invalid_request", inputs=["/data/a\nb"])
        post("the name of a bucket that is none", "invalid_request", inputs=["s3://Bucket/a.mp4"])
        post("an input on a host that is not allowed", "address_refused", inputs=["https://host/a.mp4"])
        post("a `file:` input", "invalid_request", inputs=["file:///etc/passwd"])
        post("1001 inputs", "invalid_request", inputs=["/data/a"] * 1001)
        post("the output among the inputs", "invalid_request", output="/data/videos/")
        post("an output outside of the roots", "invalid_request", output="/etc/out")
        post("a web address as output", "invalid_request", output="https://host/out")
        post("a preset that is not there", "invalid_request", preset="magic")
        post("a camera that is not there", "invalid_request", camera="periscope")
        post("an attribute that is not there", "invalid_request", attributes=["pose", "sound"])
        post("shards of no videos", "invalid_request", shard_max_videos=0)
        post("text in place of a number", "invalid_request", shard_max_videos="3")
        post("a calibration of a panorama", "invalid_request", preset="panorama", calibration=_LENS)
        post("a calibration with a camera", "invalid_request", camera="mei", calibration=_LENS)
        post("a known length that is none", "invalid_request", scale_from="height=-1")
        post("a field that is not there", "invalid_request", unknown=1)
        post("a body that is no JSON", "invalid_json", content="{")
        post("a body of 2 MB", "body_too_large", content="x" * (2 << 20))
        post("a body of another type", "unsupported_media_type", headers={"Content-Type": "text/plain"})


def _archives(bench: _Bench) -> None:
    from services.commit.tar_reader import read_members
    from vipe_core.formats import DepthZipReader
    from vipe_core.formats.exr import decode_depth, encode_depth
    from vipe_core.formats.reading import read_npz

    def tar(name: str, kind: bytes = tarfile.REGTYPE, size: int = 0, pax: dict[str, str] | None = None) -> bytes:
        buffer = io.BytesIO()
        info = tarfile.TarInfo(name)
        info.type, info.size, info.linkname, info.pax_headers = kind, size, "/etc/passwd", pax or {}
        with tarfile.open(fileobj=buffer, mode="w", format=tarfile.PAX_FORMAT) as archive:
            archive.addfile(info, io.BytesIO(bytes(size)) if kind == tarfile.REGTYPE else None)
        return buffer.getvalue()

    holes = tar("a.npz", size=1024, pax={"GNU.sparse.size": str(1 << 40), "GNU.sparse.map": "0,512"})
    for data, what in (
        (tar("../evil.npz"), "a member that climbs"),
        (tar("/etc/evil.npz"), "a member with an absolute path"),
        (tar("a.npz", tarfile.SYMTYPE), "a symbolic link"),
        (tar("a.npz", tarfile.LNKTYPE), "a hard link"),
        (tar("a.npz", tarfile.CHRTYPE), "a device"),
        (holes, "a file with holes that claims a terabyte"),
        (tar("a.npz", size=5000)[:2000], "a tar that is cut short"),
        (b"no tar at all" * 100, "bytes that are no tar"),
    ):
        bench.tried(
            "archives",
            what,
            "integrity_error",
            lambda tar: [f.read() for *_, f in read_members(io.BytesIO(tar), "depth.tar")],
            data,
        )

    def zipped(name: str, content: bytes, claimed: int | None = None) -> io.BytesIO:
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(name, content)
        if claimed is not None:
            raw = bytearray(buffer.getvalue())
            at = raw.index(b"PK\x01\x02") + 24
            raw[at : at + 4] = struct.pack("<I", claimed)
            buffer = io.BytesIO(bytes(raw))
        return buffer

    depth = encode_depth(np.ones((4, 6), np.float32))

    def open_zip(source: io.BytesIO) -> None:
        with DepthZipReader(source, label="depth.zip") as reader:
            reader.read(0)

    for source, what in (
        (zipped("../00000.exr", depth), "a zip member that climbs"),
        (zipped("00000.exr", b"", 1 << 31), "a zip member that unpacks to 2 GB"),
        (zipped("00001.exr", depth), "a zip that begins with the second picture"),
        (zipped("00000.exr", b"no picture"), "a picture that is none"),
        (io.BytesIO(b"no zip"), "bytes that are no zip"),
    ):
        bench.tried("archives", what, "format_error", open_zip, source)
    claimed = bytearray(depth)
    at = depth.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    claimed[at : at + 16] = struct.pack("<4i", 0, 0, 99_999, 99_999)
    big = bytes(claimed)
    bench.tried("archives", "an EXR that claims 10 gigapixels", "format_error", lambda: decode_depth(big, "00000.exr"))
    header = b"{'descr': '|O', 'fortran_order': False, 'shape': (1,)}\n"
    array = b"\x93NUMPY\x01\0" + struct.pack("<H", len(header)) + header + b"\x80\x04K\x01."
    path = bench.file("pose/pickled.npz", zipped("data.npy", array).getvalue())
    bench.tried("archives", "an array of pickled objects", "format_error", lambda: read_npz(path))


def page(answers: list[Answer]) -> str:
    """The table as Markdown."""
    lines = [
        "# Bad inputs and their answers",
        "",
        f"What {len(answers)} bad inputs get, written by `python -m benchmarks.bad_inputs`. Codes never change their "
        "meaning; messages",
        "name the input and say what is wrong or what to do. The folder of the files is shown as `/data`.",
        "",
        "| kind | input | code | message |",
        "|---|---|---|---|",
    ]
    for answer in answers:
        message = answer.message.replace("|", "\\|")
        lines.append(f"| {answer.kind} | {answer.what} | `{answer.code}` | {message} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=PAGE)
    args = parser.parse_args()
    answers = try_all()
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_text(page(answers))
    wrong = [answer for answer in answers if answer.code != answer.expected]
    for answer in wrong:
        print(f"{answer.kind}, {answer.what}: {answer.code} instead of {answer.expected}: {answer.message}")
    print(f"{len(answers)} bad inputs, {len(wrong)} with another answer than they should get; see {args.output}")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
