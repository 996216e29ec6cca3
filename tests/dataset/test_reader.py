"""Reading samples back, in order and by name, from either store."""

from __future__ import annotations

import io
import re
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from shard_factory import HEIGHT, WIDTH, depth_of, poses_of, write_artifacts

from services.commit.layout import sample_files
from services.commit.tar_writer import write_tar
from services.dataset import DatasetIndex, Sample, iterate, read_one, unpack
from services.domain.errors import IntegrityError, ObjectMissing
from services.storage import DirectoryStore, ObjectStore
from vipe_core.errors import FormatError

FRAMES = {"ant-2": 2, "cat-1": 3, "dog-3": 4}


def _check(sample: Sample, count: int) -> None:
    assert sample.num_frames == count
    np.testing.assert_array_equal(sample.world_from_cam, poses_of(count))
    assert (sample.camera.model, sample.camera.params) == ("pinhole", (10.0, 10.0, WIDTH / 2, HEIGHT / 2))
    assert (sample.camera.width, sample.camera.height, sample.depth_kind) == (WIDTH, HEIGHT, "z")
    maps = list(sample.depth())
    assert len(maps) == count
    for i, depth in enumerate(maps):
        np.testing.assert_array_equal(depth, depth_of(i).astype(np.float32))
    assert sample.rgb_mp4 is not None
    with av.open(io.BytesIO(sample.rgb_mp4)) as video:
        assert sum(1 for _ in video.decode(video=0)) == count


def test_all_samples_in_the_order_of_the_tars(any_finished: ObjectStore) -> None:
    samples = list(iterate(any_finished))
    assert [s.key for s in samples] == ["ant-2", "cat-1", "dog-3"]
    for sample in samples:
        _check(sample, FRAMES[sample.key])
        assert sample.row["sequence"] == sample.key
        assert sample.timestamps_s is not None
        np.testing.assert_allclose(sample.timestamps_s, np.arange(FRAMES[sample.key]) / 10)


def test_one_sample_by_name(any_finished: ObjectStore) -> None:
    for key, count in FRAMES.items():
        _check(read_one(any_finished, key), count)
    with pytest.raises(ObjectMissing, match="bad-1"):
        read_one(any_finished, "bad-1")


def test_by_address(any_finished: ObjectStore, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if any_finished.uri.startswith("s3://"):
        monkeypatch.setenv("VIPE_S3_ENDPOINT_URL", request.getfixturevalue("s3_endpoint"))
    assert [sample.key for sample in iterate(any_finished.uri)] == ["ant-2", "cat-1", "dog-3"]
    _check(read_one(any_finished.uri, "cat-1"), 3)


def test_the_snippet_of_the_readme_runs(finished: DirectoryStore, capsys: pytest.CaptureFixture[str]) -> None:
    readme = (Path(__file__).resolve().parents[2] / "README.md").read_text()
    (snippet,) = (code for code in re.findall(r"```python\n(.*?)```", readme, re.S) if "services.dataset" in code)
    for written in re.findall(r'"(/data/[^"]+|s3://[^"]+)"', snippet):
        snippet = snippet.replace(f'"{written}"', repr(finished.uri.removeprefix("file://")))
    snippet, replaced = re.subn(r'(read_one\([^,]+, )"[^"]+"', r'\1"dog-3"', snippet)
    assert replaced == 1
    variables: dict[str, Any] = {}
    exec(compile(snippet, "README.md", "exec"), variables)
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["ant-2", "cat-1", "dog-3"]
    _check(variables["sample"], 4)


def test_attributes_can_be_left_out(finished: DirectoryStore) -> None:
    for sample in (*iterate(finished, ["rgb"]), read_one(finished, "cat-1", [])):
        assert sample.rgb_mp4 is None or sample.key
        assert "depth" not in sample.files
        with pytest.raises(FormatError, match="ask for"):
            next(sample.depth())


def test_the_index_knows_its_rows(finished: DirectoryStore) -> None:
    with DatasetIndex(finished) as index:
        assert len(index) == 3
        assert index.row("dog-3") == list(index.rows())[2]
        assert index.row("nobody") is None
        assert [sorted(rows) for _, rows in index.shards()] == [["ant-2", "cat-1"], ["dog-3"]]


def _published(root: Path, artifacts: Path) -> DirectoryStore:
    """A data set as NVIDIA publishes it: three columns, no camera files, rows in no order."""
    keys = {"wsdg-0000000a": ["s1", "s3"], "wsdg-0000000b": ["s2"]}
    for tar_name, names in keys.items():
        (root / "payload" / tar_name).mkdir(parents=True)
        for name in names:
            write_artifacts(artifacts, name)
            (artifacts / "intrinsics" / f"{name}_camera.txt").unlink()
        for attribute in ("pose", "depth", "rgb"):
            write_tar(
                root / "payload" / tar_name / f"{attribute}.tar", [sample_files(artifacts, attribute, n) for n in names]
            )
        write_tar(
            root / "payload" / tar_name / "intrinsics.tar",
            [[(f"{n}.npz", artifacts / "intrinsics" / f"{n}.npz")] for n in names],
        )
    rows = {
        "sequence": ["s1", "s2", "s3"],
        "num_frames": [3, 3, 3],
        "tar_name": ["wsdg-0000000a", "wsdg-0000000b", "wsdg-0000000a"],
    }
    pq.write_table(pa.table(rows), root / "meta.parquet")
    return DirectoryStore(root)


def test_a_published_data_set_reads_the_same(tmp_path: Path) -> None:
    store = _published(tmp_path / "hub", tmp_path / "artifacts")
    assert [s.key for s in iterate(store)] == ["s1", "s3", "s2"]
    sample = read_one(store, "s3")
    _check(sample, 3)
    assert (sample.timestamps_s, sample.info) == (None, {})
    unpacked = unpack(store, tmp_path / "u", ["s3"])
    assert unpacked.names == {"s3": "s3"}
    assert sorted(str(p.relative_to(tmp_path / "u")) for p in (tmp_path / "u").rglob("*.*")) == [
        "depth/s3.zip",
        "intrinsics/s3.npz",
        "pose/s3.npz",
        "rgb/s3.mp4",
    ]


def _retar(change: Callable[[list[tuple[str, bytes]]], list[tuple[str, bytes]]]) -> Callable[[bytes], bytes]:
    def edit(data: bytes) -> bytes:
        with tarfile.open(fileobj=io.BytesIO(data)) as tar:
            members = [(m.name, tar.extractfile(m).read()) for m in tar]
        out = io.BytesIO()
        with tarfile.open(fileobj=out, mode="w") as tar:
            for name, content in change(members):
                info = tarfile.TarInfo(name)
                info.size = len(content)
                tar.addfile(info, io.BytesIO(content))
        return out.getvalue()

    return edit


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda m: m[::-1], "out of step"),
        (lambda m: m[:1], "same number"),
        (lambda m: [*m, ("extra.zip", b"")], "same number"),
    ],
)
def test_tars_that_do_not_match_are_refused(
    finished: DirectoryStore, rewrite: Callable, change: Callable, expected: str
) -> None:
    depth = read_one(finished, "cat-1").row["tar_name"]
    rewrite(f"payload/{depth}/depth.tar", _retar(change))
    with pytest.raises(IntegrityError, match=expected):
        list(iterate(finished))


def test_a_damaged_depth_archive_is_typed(finished: DirectoryStore, rewrite: Callable) -> None:
    name = read_one(finished, "dog-3").row["tar_name"]
    rewrite(f"payload/{name}/depth.tar", _retar(lambda m: [(m[0][0], m[0][1][:-30])]))
    sample = next(s for s in iterate(finished) if s.key == "dog-3")
    with pytest.raises(FormatError, match=r"dog-3\.zip"):
        list(sample.depth())
