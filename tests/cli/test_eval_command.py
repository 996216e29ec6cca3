"""`vipectl eval`: a report of videos without truth, what is asked wrongly, and the ablation."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from cli_helpers import Run


@pytest.mark.slow
def test_a_folder_of_videos_becomes_a_report(vipectl: Run, clip: Path, tmp_path: Path) -> None:
    videos = tmp_path / "videos"
    videos.mkdir()
    shutil.copy(clip, videos / "walk.mp4")
    (videos / "broken.mp4").write_text("not a video")
    command = ("eval", "--videos", videos, "--max-frames", 5, "--matcher", "sift", "-o", "report")

    done = vipectl(*command)

    assert done.returncode == 1, "one video is broken"
    document = json.loads((tmp_path / "report" / "report.json").read_text())
    broken, walk = document["rows"]
    assert broken["error"]["code"] == "media_corrupt"
    assert walk["frames"] == 5
    assert walk["figures"]["s_ate"] < 0.1
    assert walk["figures"]["sampson_px"] > 0
    assert document["facts"]["preset"] == "classical"
    text = (tmp_path / "report" / "report.md").read_text()
    assert "![walk.mp4](figures/walk.png)" in text
    assert (tmp_path / "report" / "figures" / "walk.png").stat().st_size > 5000
    assert "walk.mp4" in done.stdout
    assert "Sampson [px]" in done.stdout
    assert "SIFT" in text

    before = (tmp_path / "report" / "report.json").read_bytes()
    again = vipectl(*command)
    assert "walk.mp4: done before" in again.stderr
    assert (tmp_path / "report" / "report.json").read_bytes() == before


@pytest.mark.long
def test_the_ablation_is_one_table(vipectl: Run, clip: Path, tmp_path: Path) -> None:
    done = vipectl("eval", "--videos", clip, "--max-frames", 4, "--ablate", "--no-plots", "-o", "report", timeout_s=600)
    assert done.returncode == 0, done.stderr
    document = json.loads((tmp_path / "report" / "report.json").read_text())
    assert list(document["variants"]) == ["dense", "dense-depth", "dense-sparse-depth", "dense-depth-masks", "all"]
    hashes = {
        json.loads((tmp_path / "report" / name / "report.json").read_text())["facts"]["configuration"]
        for name in document["variants"]
    }
    assert len(hashes) == 5
    errors = {variant["mean"]["s_ate"] for variant in document["variants"].values()}
    assert len(errors) > 1, "terms were switched and nothing changed"
    assert "| dense | sparse | depth | masks |" in (tmp_path / "report" / "report.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "give one of"),
        (("--dataset", "tum"), "give one of"),
        (("--root", "."), "give one of"),
        (("--artifacts", "."), "give one of"),
        (("--videos", ".", "--dataset", "tum", "--root", "."), "give one of"),
        (("--artifacts", ".", "--truth", ".", "--ablate"), "can only be scored"),
        (("--dataset", "tum", "--root", "."), "no TUM RGB-D sequence"),
        (("--dataset", "euroc", "--root", ".", "--protocol", "paper"), "no protocol for 'euroc'"),
        (("--videos", ".", "--depth-alignment", "best"), "unknown depth alignment"),
        (("--videos", ".", "--preset", "magic"), "unknown preset"),
        (("--videos", "nowhere"), "no video"),
    ],
)
def test_what_is_asked_wrongly(
    arguments: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from typer.testing import CliRunner

    from services.cli.main import app

    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["eval", *arguments, "-o", "report"])
    assert done.exit_code == 1
    assert said in done.stderr
    assert not (tmp_path / "report").exists()
