"""Masks take the whole way: from artifacts through shards, and back out of them."""

from __future__ import annotations

import dataclasses
import tarfile
from pathlib import Path

import numpy as np
import pytest
from shard_factory import HEIGHT, JOB, WIDTH, commit_shard, make_lease, success, write_artifacts

from services.dataset import finalise, unpack, verify
from services.domain.models import JobSpec
from services.storage import DirectoryStore
from vipe_core.formats import export_npz, read_artifacts
from vipe_core.formats.png_zip import MaskZipWriter

FRAMES = {"cat-1": 3, "ant-2": 2}
SPEC = JobSpec(inputs=("/in",), output="/out", attributes=("pose", "intrinsics", "depth", "rgb", "mask"))


def mask_of(index: int) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[: index + 2, 3:7] = 1
    return mask


@pytest.fixture
def store(tmp_path: Path) -> DirectoryStore:
    root = tmp_path / "artifacts"
    for key, count in FRAMES.items():
        write_artifacts(root, key, count, info=True)
        (root / "mask").mkdir(exist_ok=True)
        with MaskZipWriter(root / "mask" / f"{key}.zip") as writer:
            for index in range(count):
                writer.append(mask_of(index))
        (root / "mask" / f"{key}.txt").write_text("0: background\n1: moving\n")
    store = DirectoryStore(tmp_path / "out")
    lease = dataclasses.replace(make_lease(list(FRAMES)), spec=SPEC)
    results = [success(key, count) for key, count in FRAMES.items()]
    commit_shard(lease, results, root, tmp_path / "scratch", store, lambda: True)
    finalise(store, JOB, SPEC, num_shards=1, num_videos=2)
    return store


def test_masks_are_members_of_their_tar(store: DirectoryStore, tmp_path: Path) -> None:
    (path,) = (tmp_path / "out").rglob("mask.tar")
    with tarfile.open(path) as tar:
        assert tar.getnames() == ["ant-2.txt", "ant-2.zip", "cat-1.txt", "cat-1.zip"]
    assert verify(store, deep=True).problems == []


def test_masks_come_back_as_they_were(store: DirectoryStore, tmp_path: Path) -> None:
    unpack(store, tmp_path / "u")
    for key, count in FRAMES.items():
        for suffix in ("zip", "txt"):
            name = f"mask/{key}.{suffix}"
            assert (tmp_path / "u" / name).read_bytes() == (tmp_path / "artifacts" / name).read_bytes()
        with read_artifacts(tmp_path / "u", key).open_mask() as masks:
            assert len(masks) == count
            for index, mask in enumerate(masks):
                np.testing.assert_array_equal(mask, mask_of(index))
        exported = export_npz(read_artifacts(tmp_path / "u", key), tmp_path / f"{key}.npz")
        with np.load(exported) as arrays:
            assert len(arrays["depth"]) == count
    unpack(store, tmp_path / "m", attributes=["mask"])
    written = sorted(path.name for path in (tmp_path / "m").rglob("*.*"))
    assert written == [
        "ant-2.txt",
        "ant-2.zip",
        "cat-1.txt",
        "cat-1.zip",
    ]


def test_a_damaged_mask_tar_is_found(store: DirectoryStore, tmp_path: Path) -> None:
    (path,) = (tmp_path / "out").rglob("mask.tar")
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 1
    path.write_bytes(bytes(data))
    assert any("mask.tar" in str(problem) for problem in verify(store, deep=True).problems)
