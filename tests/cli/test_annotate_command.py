"""`vipectl annotate`: a video, a directory of images, and inputs that cannot be annotated."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from cli_helpers import Run
from typer.testing import CliRunner

from services.cli.main import app
from vipe_core.formats import read_artifacts
from vipe_core.video import open_source

pytestmark = pytest.mark.slow


def test_videos_and_images_become_artifacts(vipectl: Run, clip: Path, tmp_path: Path) -> None:
    images = tmp_path / "walk" / "sideways"
    images.mkdir(parents=True)
    for frame in open_source(clip).frames(stop=10):
        cv2.imwrite(str(images / f"{frame.index:03d}.png"), cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR))
    broken = tmp_path / "broken.mp4"
    broken.write_text("not a video")

    done = vipectl("annotate", clip, broken, images, "-o", "out", "--scale-from", "path=2.5", "--json")

    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 1, "one input failed"
    assert [row.get("name") for row in rows] == ["sideways", None, "sideways-2"]
    assert rows[1]["error"]["code"] == "media_corrupt"
    assert "broken.mp4" in rows[1]["error"]["message"]
    for row, frames in ((rows[0], 12), (rows[2], 10)):
        artifacts = read_artifacts(tmp_path / "out", row["name"])
        assert artifacts.num_frames == row["num_frames"] == frames
        assert (row["scale"], row["scale_source"]) == ("metric", "path=2.5")
        assert row["trajectory_length"] == pytest.approx(2.5)
        assert np.isfinite(artifacts.world_from_cam).all()
        assert artifacts.camera.params == pytest.approx(row["camera_params"], rel=1e-6)
        with artifacts.open_depth() as depth:
            first = depth.read(0)
        assert first.shape == (96, 128)
        assert np.isfinite(first).all()
        assert (first > 0).mean() > 0.99
    sources = json.loads((tmp_path / "out/sequences.json").read_text())
    assert sources == {"broken": str(broken), "sideways": str(clip), "sideways-2": str(images)}


def test_masks_of_ones_own_and_the_table_for_people(vipectl: Run, clip: Path, tmp_path: Path) -> None:
    shutil.copyfile(clip, tmp_path / "my clip.mp4")
    masks = tmp_path / "masks"
    masks.mkdir()
    for frame in open_source(clip).frames():
        mask = np.zeros(frame.rgb.shape[:2], np.uint8)
        mask[20:40, 30:60] = 1
        cv2.imwrite(str(masks / f"{frame.index}.png"), mask)

    done = vipectl("annotate", "my clip.mp4", "-o", "out", "--masks", masks)

    assert done.returncode == 0, done.stderr
    assert "my-clip" in done.stdout
    assert "128x96" in done.stdout
    with read_artifacts(tmp_path / "out", "my-clip").open_mask() as found:
        assert all((mask[20:40, 30:60] == 1).all() for mask in found)
    assert vipectl("annotate", clip, clip, "-o", "out", "--masks", masks).returncode == 2
    assert vipectl("annotate", clip, "-o", "out", "--scale-from", "tall").returncode == 2
    (masks / "0.png").unlink()
    done = vipectl("annotate", clip, "-o", "out", "--masks", masks, "--json")
    assert done.returncode == 1
    assert json.loads(done.stdout)["error"]["code"] == "mask_mismatch"


@pytest.mark.parametrize(
    ("arguments", "code", "hint"),
    [
        (("--preset", "vipe9000"), "invalid_config", "classical"),
        (("--camera", "fisheye"), "invalid_config", "pinhole"),
        (("--device", "tpu"), "invalid_config", "cpu"),
    ],
)
def test_what_is_not_offered_is_refused_with_what_is(
    clip: Path, tmp_path: Path, arguments: tuple[str, ...], code: str, hint: str
) -> None:
    done = CliRunner().invoke(app, ["annotate", str(clip), "-o", str(tmp_path / "out"), *arguments])
    assert done.exit_code == 1
    assert f"[{code}]" in done.stderr
    assert hint in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_after_a_warmup_nothing_is_left_to_compile(
    vipectl: Run, clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = tmp_path / "cache"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cache))

    def compiled() -> list[str]:
        return sorted(path.name for path in cache.rglob("*.nbc"))

    done = vipectl("warmup", timeout_s=600)
    assert done.returncode == 0, done.stderr
    assert "ready: classical on cpu" in done.stdout
    after = compiled()
    assert len(after) > 20
    assert vipectl("annotate", clip, "-o", "out").returncode == 0
    for preset in ("wide_angle", "panorama"):
        done = vipectl("warmup", "--preset", preset, timeout_s=600)
        assert done.returncode == 0, done.stderr
        assert f"ready: {preset} on cpu" in done.stdout
    assert compiled() == after
