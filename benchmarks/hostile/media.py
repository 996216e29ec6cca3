"""Media files that point elsewhere, and media files that claim or hold far more than their size suggests."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np

_CONTAINERS = {b"moov", b"trak", b"mdia", b"minf", b"dinf", b"stbl", b"edts"}


RED, GREEN = (255, 0, 0), (0, 255, 0)


def clip(
    num_frames: int = 8, size: tuple[int, int] = (96, 64), fmt: str = "mp4", colour: tuple[int, int, int] = RED
) -> bytes:
    """A small honest clip of one colour."""
    buffer = io.BytesIO()
    with av.open(buffer, "w", format=fmt) as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        picture = np.full((size[1], size[0], 3), colour, np.uint8)
        for index in range(num_frames):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts = index
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return buffer.getvalue()


def playlists(target: str) -> dict[str, bytes]:
    """Lists of every kind that name `target` (a path or a URL), by file name."""
    segment = f"#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:1,\n{target}\n#EXT-X-ENDLIST\n"
    return {
        "list.m3u8": segment.encode(),
        "list.mp4": segment.encode(),
        "list.ts": segment.encode(),
        "list.avi": b"\xef\xbb\xbf" + segment.encode(),
        "spaced.m3u8": b"\n \n" + segment.encode(),
        "master.m3u8": f"#EXTM3U\n#EXT-X-STREAM-INF:BANDWIDTH=1\n{target}\n".encode(),
        "map.m3u8": segment.replace("#EXTINF", f'#EXT-X-MAP:URI="{target}"\n#EXTINF').encode(),
        "key.m3u8": segment.replace("#EXTINF", f'#EXT-X-KEY:METHOD=AES-128,URI="{target}"\n#EXTINF').encode(),
        "chain.m3u8": segment.replace(target, f"concat:{target}|{target}").encode(),
        "sub.m3u8": segment.replace(target, f"subfile,,start,0,end,64,,:{target}").encode(),
        "list.ffconcat": f"ffconcat version 1.0\nfile '{target}'\n".encode(),
        "concat.mkv": f"ffconcat version 1.0\nfile '{target}'\n".encode(),
        "list.mpd": (
            '<?xml version="1.0"?><MPD xmlns="urn:mpeg:dash:schema:mpd:2011" type="static" profiles="x"><Period>'
            f'<AdaptationSet mimeType="video/mp4"><Representation id="1"><BaseURL>{target}</BaseURL></Representation>'
            "</AdaptationSet></Period></MPD>"
        ).encode(),
        "list.sdp": b"v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 5004 RTP/AVP 96\n",
        "list.asx": f'[Reference]\r\nRef1={target}\r\n'.encode(),
        "list.pls": f"[playlist]\nFile1={target}\nNumberOfEntries=1\n".encode(),
        "list.imf": (
            '<?xml version="1.0"?><AssetMap xmlns="http://www.smpte-ra.org/schemas/429-9/2007/AM"><AssetList><Asset>'
            f"<Id>urn:uuid:1</Id><ChunkList><Chunk><Path>{target}</Path></Chunk></ChunkList></Asset></AssetList></AssetMap>"
        ).encode(),
        "subtitle.avi": avi_with_text(segment.encode()),
    }  # fmt: skip


def external_reference(target: str, kind: str) -> bytes:
    """A green QuickTime file which says that its samples lie in another one.

    Args:
        kind: How the other one is named: `url ` or `alis`.
    """
    if kind == "url ":
        entry = _atom(b"url ", b"\0\0\0\0" + target.encode() + b"\0")
    else:
        name = Path(target).name.encode()[:63]
        path = target.encode()
        alias = (
            bytes(10) + b"\x01" + b"x".ljust(27, b"\0") + bytes(12) + bytes([len(name)]) + name.ljust(63, b"\0")
            + bytes(16) + struct.pack(">hh", 1, 1) + bytes(16)
            + struct.pack(">hh", 2, len(path)) + path + b"\0" * (len(path) % 2) + struct.pack(">hh", -1, 0)
        )  # fmt: skip
        entry = _atom(b"alis", b"\0\0\0\0" + alias)
    table = b"\0\0\0\0" + struct.pack(">I", 1) + entry
    return edited(clip(fmt="mov", colour=GREEN), b"dref", lambda _: table)


def edited(data: bytes, kind: bytes, change: Callable[[bytes], bytes]) -> bytes:
    """An MP4 with the contents of every atom of a kind changed, and the sizes of those around them."""
    out = b""
    position = 0
    while position + 8 <= len(data):
        size, name = struct.unpack_from(">I4s", data, position)
        header = 8
        if size == 1:
            size, header = struct.unpack_from(">Q", data, position + 8)[0], 16
        body = data[position + header : position + size]
        if name == kind:
            body = change(body)
        elif name in _CONTAINERS:
            body = edited(body, kind, change)
        out += _atom(name, body)
        position += size
    return out


def avi_with_text(subtitle: bytes) -> bytes:
    """An AVI with a subtitle stream of the kind that is opened as a file of its own."""
    text = b"GAB2\0" + struct.pack("<HI", 2, 2) + b"a\0" + struct.pack("<HI", 4, len(subtitle)) + subtitle
    video_format = struct.pack("<IiiHH4sIiiII", 40, 96, 64, 1, 24, b"MJPG", 96 * 64 * 3, 0, 0, 0, 0)
    streams = b""
    for kind, handler, fmt in ((b"vids", b"MJPG", video_format), (b"txts", b"\0\0\0\0", b"")):
        header = struct.pack("<4s4sIHHIIIIIIIIhhhh", kind, handler, 0, 0, 0, 0, 1, 25, 0, 1, 0, 0, 0, 0, 0, 96, 64)
        streams += _riff_list(b"strl", _chunk(b"strh", header) + _chunk(b"strf", fmt))
    main = struct.pack("<14I", 40000, 0, 0, 0x10, 1, 0, 2, 0, 96, 64, 0, 0, 0, 0)
    movie = _riff_list(b"movi", _chunk(b"01tx", text) + _chunk(b"00dc", b"\xff\xd8\xff\xd9"))
    return _chunk(b"RIFF", b"AVI " + _riff_list(b"hdrl", _chunk(b"avih", main) + streams) + movie)


def endless_index(num_samples: int) -> bytes:
    """An MP4 of a few hundred bytes whose index claims any number of frames."""

    def sizes(_: bytes) -> bytes:
        return struct.pack(">III", 0, 1, num_samples)

    def times(_: bytes) -> bytes:
        return struct.pack(">IIII", 0, 1, num_samples, 1)

    def chunks(_: bytes) -> bytes:
        return struct.pack(">IIIII", 0, 1, 1, num_samples, 1)

    data = clip(1)
    for kind, change in ((b"stsz", sizes), (b"stts", times), (b"stsc", chunks)):
        data = edited(data, kind, change)
    return data


def png(width: int, height: int, rows: int | None = None) -> bytes:
    """A grey PNG, one bit per pixel; complete, or with as many rows as given."""
    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    packer = zlib.compressobj(9)
    row = bytes(1 + (width + 7) // 8)
    pixels = b"".join(packer.compress(row) for _ in range(height if rows is None else rows)) + packer.flush()
    chunks = ((b"IHDR", header), (b"IDAT", pixels), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body)) for name, body in chunks
    )


def jpeg_header(width: int, height: int) -> bytes:
    """The beginning of a JPEG of any size, with nothing behind it."""
    frame = struct.pack(">BHHB", 8, height, width, 3) + b"\x01\x11\0\x02\x11\0\x03\x11\0"
    tables = b"\xff\xdb" + struct.pack(">HB", 67, 0) + bytes([1] * 64)
    return b"\xff\xd8" + tables + b"\xff\xc0" + struct.pack(">H", len(frame) + 2) + frame + b"\xff\xd9"


def bmp_header(width: int, height: int) -> bytes:
    return b"BM" + struct.pack("<IIIIiiHHIIiiII", 54, 0, 54, 40, width, height, 1, 24, 0, 0, 0, 0, 0, 0)


def tiff_header(width: int, height: int) -> bytes:
    tags = [
        (256, width),
        (257, height),
        (258, 8),
        (259, 1),
        (262, 1),
        (273, 8),
        (277, 1),
        (278, height),
        (279, 1 << 30),
    ]
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    return b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", len(tags)) + entries + b"\0\0\0\0"


def gif(width: int, height: int, num_frames: int = 1) -> bytes:
    """A GIF with any screen and many frames of one pixel."""
    picture = b"\x21\xf9\x04\0\x01\0\0\0" + b"\x2c" + struct.pack("<HHHHB", 0, 0, 1, 1, 0) + b"\x02\x02\x44\x01\0"
    return (
        b"GIF89a"
        + struct.pack("<HHBBB", width, height, 0x80, 0, 0)
        + b"\0\0\0\xff\xff\xff"
        + picture * num_frames
        + b";"
    )


def cover_only(cover: bytes) -> bytes:
    """A sound file whose only picture is its cover."""
    body = b"\0image/png\0\x03\0" + cover
    frame = b"APIC" + struct.pack(">I", len(body)) + b"\0\0" + body
    size = len(frame)
    synchsafe = bytes((size >> shift) & 0x7F for shift in (21, 14, 7, 0))
    return b"ID3\x03\0\0" + synchsafe + frame + (b"\xff\xfb\x90\x64" + bytes(413)) * 40


def many_streams(count: int) -> bytes:
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="matroska") as container:
        streams = [container.add_stream("mpeg4", rate=25) for _ in range(count)]
        for stream in streams:
            stream.width, stream.height, stream.pix_fmt = 16, 16, "yuv420p"
        frame = av.VideoFrame.from_ndarray(np.zeros((16, 16, 3), np.uint8), format="rgb24")
        frame.pts = 0
        for stream in streams:
            container.mux(stream.encode(frame))
    return buffer.getvalue()


def odd_times(pts_ms: list[int]) -> bytes:
    """A Matroska file with pictures at these times."""
    from fractions import Fraction

    buffer = io.BytesIO()
    with av.open(buffer, "w", format="matroska") as container:
        stream = container.add_stream("mjpeg", rate=25)
        stream.width, stream.height, stream.pix_fmt = 32, 32, "yuvj420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        for pts in pts_ms:
            frame = av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8), format="rgb24")
            frame.pts, frame.time_base = pts, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return buffer.getvalue()


def _atom(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body) + 8) + name + body


def _chunk(name: bytes, body: bytes) -> bytes:
    return name + struct.pack("<I", len(body)) + body + b"\0" * (len(body) % 2)


def _riff_list(name: bytes, body: bytes) -> bytes:
    return _chunk(b"LIST", name + body)
