"""The same input, configuration and device give the same bytes in every process."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from vipe_core.evaluation.synthetic import tiny_clip

_REPOSITORY = Path(__file__).resolve().parents[2]
_ANNOTATE = """
import sys
from vipe_core.formats import write_artifacts
from vipe_core.pipeline.annotator import Annotator

video, *before, out = sys.argv[1:]
annotator = Annotator(threads=1)
for path in before:
    annotator.annotate(path)
write_artifacts(annotator.annotate(video), out)
"""


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """An orbit with things that move in it, long enough for keyframes, infill and motion masks; and another clip."""
    folder = tmp_path_factory.mktemp("clips")
    return {
        "orbit": tiny_clip("dynamic", 12, 160, 120, noise=1.0).write_video(folder / "orbit.mp4"),
        "other": tiny_clip("forward", 3, 128, 96, noise=1.0).write_video(folder / "other.mp4"),
    }


def payload(folder: Path, video: Path, *before: Path, hash_seed: str, cores: set[int] | None = None) -> dict[str, str]:
    """File -> digest of everything that a new process writes for `video`, run inside of `folder`."""
    folder.mkdir()
    environment = {**os.environ, "PYTHONHASHSEED": hash_seed, "PYTHONPATH": str(_REPOSITORY)}
    subprocess.run(
        [sys.executable, "-c", _ANNOTATE, str(video), *map(str, before), "out"],
        cwd=folder,
        env=environment,
        check=True,
        preexec_fn=None if cores is None else lambda: os.sched_setaffinity(0, cores),
    )
    files = sorted(path for path in (folder / "out").rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_every_process_writes_the_same_bytes(clips: dict[str, Path], tmp_path: Path) -> None:
    first = payload(tmp_path / "first", clips["orbit"], hash_seed="0")
    assert {Path(name).parent.name for name in first} >= {"pose", "intrinsics", "depth", "rgb"}
    # Another order of hashes, another working directory, one core instead of all, and a process that is warm from
    # another video of another size.
    core = {min(os.sched_getaffinity(0))}
    second = payload(tmp_path / "second", clips["orbit"], clips["other"], hash_seed="4242", cores=core)
    assert second == first
