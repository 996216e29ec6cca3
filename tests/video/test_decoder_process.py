"""The decoder child hangs, dies, is left behind, or loses its parent: nothing survives and every case is typed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from video_clips import number_of, write_clip

from vipe_core.errors import DecodeCrashed, DecodeTimeout
from vipe_core.video import VideoFileSource

pytestmark = pytest.mark.skipif(not Path("/proc").is_dir(), reason="finds child processes through /proc")


def decoder_children(parent: int) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            stat = (entry / "stat").read_text()
            command = (entry / "cmdline").read_bytes()
        except OSError:
            continue
        state, parent_pid = stat.rpartition(")")[2].split()[:2]
        if int(parent_pid) == parent and state != "Z" and b"decoder_child" in command:
            found.append(int(entry.name))
    return found


def eventually(condition: Callable[[], bool]) -> bool:
    """Wait until `condition` holds; the limit only bounds a failing test."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.02)
    return condition()


def is_gone(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """Pictures of 2 MB, so that the child cannot be ahead by more than one or two of them."""
    return write_clip(tmp_path / "clip.mp4", 30, (1024, 704), options={"preset": "ultrafast"})


def test_a_hanging_decoder_is_killed_and_reported(clip: Path) -> None:
    source = VideoFileSource(clip, stall_s=1.5)
    frames = source.frames()
    next(frames)
    (child,) = decoder_children(os.getpid())
    os.kill(child, signal.SIGSTOP)
    with pytest.raises(DecodeTimeout, match=r"clip\.mp4") as caught:
        list(frames)
    assert caught.value.retryable
    assert decoder_children(os.getpid()) == []


def test_a_slow_consumer_is_not_a_hang(clip: Path) -> None:
    frames = VideoFileSource(clip, stall_s=1.5).frames()
    numbers = [number_of(next(frames).rgb)]
    time.sleep(2.5)
    numbers += [number_of(frame.rgb) for frame in frames]
    assert numbers == list(range(30))


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV])
def test_a_dying_decoder_is_reported(clip: Path, number: signal.Signals) -> None:
    frames = VideoFileSource(clip).frames()
    next(frames)
    (child,) = decoder_children(os.getpid())
    os.kill(child, number)
    with pytest.raises(DecodeCrashed, match=number.name) as caught:
        list(frames)
    assert caught.value.retryable
    assert decoder_children(os.getpid()) == []


def test_closing_or_exhausting_an_iterator_leaves_no_process_and_no_descriptor(clip: Path) -> None:
    source = VideoFileSource(clip)
    list(source.frames((64, 48)))
    open_before = len(list(Path("/proc/self/fd").iterdir()))
    frames = source.frames()
    next(frames)
    assert len(decoder_children(os.getpid())) == 1
    frames.close()
    assert decoder_children(os.getpid()) == []
    for _ in source.frames((64, 48)):
        break
    assert len(list(source.frames((64, 48)))) == 30
    assert decoder_children(os.getpid()) == []
    assert len(list(Path("/proc/self/fd").iterdir())) == open_before


def test_the_child_dies_with_its_parent(clip: Path) -> None:
    script = (
        "import sys, time; from vipe_core.video import VideoFileSource\n"
        "frames = VideoFileSource(sys.argv[1]).frames(); next(frames); print('ready', flush=True); time.sleep(600)\n"
    )
    root = Path(__file__).resolve().parents[2]
    parent = subprocess.Popen(
        [sys.executable, "-c", script, str(clip)], stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": str(root)}
    )
    try:
        assert parent.stdout is not None
        assert parent.stdout.readline() == b"ready\n"
        (child,) = decoder_children(parent.pid)
    finally:
        parent.kill()
        parent.communicate()
    assert eventually(lambda: is_gone(child))


def test_the_child_outlives_the_thread_that_started_it(clip: Path) -> None:
    """A prefetching thread may start an iterator that another thread finishes."""
    frames = VideoFileSource(clip).frames((64, 48))
    started: list[int] = []
    thread = threading.Thread(target=lambda: started.append(next(frames).index))
    thread.start()
    thread.join()
    assert [*started, *(frame.index for frame in frames)] == list(range(30))


def test_modules_in_the_working_directory_are_not_imported(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "av.py").write_text("raise SystemExit('imported from the working directory')\n")
    monkeypatch.chdir(tmp_path)
    assert len(list(VideoFileSource(clip).frames((32, 32), stop=2))) == 2


def test_the_child_imports_no_heavy_library() -> None:
    script = (
        "import sys, vipe_core.video.decoder_child, vipe_core.video.av_decode\n"
        "print('torch' in sys.modules, 'cv2' in sys.modules)\n"
    )
    root = Path(__file__).resolve().parents[2]
    output = subprocess.check_output([sys.executable, "-c", script], env={**os.environ, "PYTHONPATH": str(root)})
    assert output.split() == [b"False", b"False"]
