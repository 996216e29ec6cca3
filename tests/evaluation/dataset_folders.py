"""Tiny folders in exactly the published layouts of the datasets, with a trajectory that is known."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

SIZE = (64, 48)


def trajectory(count: int) -> NDArray[np.float64]:
    rng = np.random.default_rng(7)
    poses = np.repeat(np.eye(4)[None], count, axis=0)
    poses[:, :3, 3] = rng.normal(size=(count, 3)).cumsum(axis=0)
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(count, 3)).cumsum(axis=0) * 0.1).as_matrix()
    return poses


def picture(k: int, size: tuple[int, int] = SIZE) -> NDArray[np.uint8]:
    """A flat picture whose brightness is the frame's number, ten times."""
    return np.full((size[1], size[0], 3), 10 * k, np.uint8)


def depth_map(k: int, size: tuple[int, int] = SIZE) -> NDArray[np.float64]:
    """Metres: k + 1 on the left, missing on the right."""
    depth = np.zeros((size[1], size[0]))
    depth[:, : size[0] // 2] = k + 1
    return depth


def write_png(path: Path, image: NDArray[np.generic]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def write_rgbd(folder: Path, count: int, *, calibration: bool, size: tuple[int, int] = SIZE) -> NDArray[np.float64]:
    """TUM RGB-D; with `calibration` ETH3D SLAM. The truth runs at four times the rate, 3 ms off, and starts late."""
    poses = trajectory(4 * count)
    start = 1305031102.175304
    rgb, depth = ["# color images", "# file: 'x.bag'", "# timestamp filename"], ["# depth maps", "#", "#"]
    for k in range(count):
        stamp = f"{start + k / 30:.6f}"
        write_png(folder / "rgb" / f"{stamp}.png", picture(k, size))
        rgb.append(f"{stamp} rgb/{stamp}.png")
        if k != 2:  # one depth picture was lost
            write_png(folder / "depth" / f"{stamp}.png", np.rint(depth_map(k, size) * 5000).astype(np.uint16))
            depth.append(f"{float(stamp) + 0.011:.6f} depth/{stamp}.png")
    (folder / "rgb.txt").write_text("\n".join(rgb) + "\n")
    (folder / "depth.txt").write_text("\n".join(depth) + "\n")
    lines = ["# ground truth trajectory", "# timestamp tx ty tz qx qy qz qw"]
    for k in range(4, 4 * count):  # the first frame has no truth
        values = [*poses[k, :3, 3], *Rotation.from_matrix(poses[k, :3, :3]).as_quat()]
        lines.append(f"{start + k / 120 + 0.003:.4f} " + " ".join(f"{value:.7f}" for value in values))
    (folder / "groundtruth.txt").write_text("\n".join(lines) + "\n")
    if calibration:
        (folder / "calibration.txt").write_text("60.5 61.5 31.5 23.5\n")
    return poses[4::4]


def write_kitti(root: Path, number: str, count: int, size: tuple[int, int] = (640, 376)) -> NDArray[np.float64]:
    """KITTI odometry with both cameras; colour stands 6 cm to the right of grey."""
    poses = trajectory(count)
    folder = root / "sequences" / number
    for k in range(count):
        for camera in (0, 2):
            write_png(folder / f"image_{camera}" / f"{k:06d}.png", picture(k, size))
    focal, cx, cy = 700.0, 322.0, 186.0
    rows = []
    for name, offset in (("P0", 0.0), ("P1", -0.54), ("P2", -0.06), ("P3", -0.6), ("Tr", 0.0)):
        projection = np.array([[focal, 0, cx, focal * offset], [0, focal, cy, 0], [0, 0, 1, 0]])
        rows.append(f"{name}: " + " ".join(f"{value:.12e}" for value in projection.ravel()))
    (folder / "calib.txt").write_text("\n".join(rows) + "\n")
    (folder / "times.txt").write_text("".join(f"{0.1037 * k:.6e}\n" for k in range(count)))
    (root / "poses").mkdir(exist_ok=True)
    lines = (" ".join(f"{value:.9e}" for value in pose[:3].ravel()) for pose in poses)
    (root / "poses" / f"{number}.txt").write_text("\n".join(lines) + "\n")
    right = np.eye(4)
    right[0, 3] = 0.06
    return poses @ right


def write_sintel(root: Path, name: str, count: int) -> NDArray[np.float64]:
    poses = trajectory(count)
    training = root / "training"
    for k in range(count):
        stem = f"frame_{k + 1:04d}"
        write_png(training / "final" / name / f"{stem}.png", picture(k))
        write_png(training / "clean" / name / f"{stem}.png", picture(k))
        matrix = np.array([[70.0 + 0.1 * k, 0, 32], [0, 71.0, 24], [0, 0, 1]])
        camera = training / "camdata_left" / name / f"{stem}.cam"
        camera.parent.mkdir(parents=True, exist_ok=True)
        extrinsics = np.linalg.inv(poses[k])[:3]
        camera.write_bytes(
            struct.pack("<f", 202021.25) + matrix.astype("<f8").tobytes() + extrinsics.astype("<f8").tobytes()
        )
        depth = training / "depth" / name / f"{stem}.dpt"
        depth.parent.mkdir(parents=True, exist_ok=True)
        values = depth_map(k).astype("<f4")
        depth.write_bytes(struct.pack("<fii", 202021.25, values.shape[1], values.shape[0]) + values.tobytes())
    return poses


def write_seven_scenes(folder: Path, count: int) -> NDArray[np.float64]:
    poses = trajectory(count)
    for k in range(count):
        stem = folder / f"frame-{k:06d}"
        write_png(Path(f"{stem}.color.png"), picture(k))
        millimetres = np.rint(depth_map(k) * 1000).astype(np.uint16)
        write_png(Path(f"{stem}.depth.png"), np.where(millimetres == 0, 65535, millimetres).astype(np.uint16))
        text = "\n".join("\t ".join(f"{value: .7e}" for value in row) + "\t " for row in poses[k])
        Path(f"{stem}.pose.txt").write_text(text + "\n")
    return poses


EUROC_SENSOR = """#Default MH_01 sensor
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, -0.02,
         1.0, 0.0, 0.0, -0.06,
         0.0, 0.0, 1.0, 0.01,
         0.0, 0.0, 0.0, 1.0]

# Camera specific definitions.
rate_hz: 20
resolution: [64, 48]
camera_model: pinhole
intrinsics: [45.8, 45.7, 31.7, 24.8] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""


def write_euroc(folder: Path, count: int) -> NDArray[np.float64]:
    """Truth at 200 Hz that starts with the second picture; the rotation is stored w first."""
    bodies = trajectory(10 * count)
    cam, truth = folder / "mav0" / "cam0", folder / "mav0" / "state_groundtruth_estimate0"
    start = 1403636579763555584
    listed = ["#timestamp [ns],filename"]
    for k in range(count):
        stamp = start + 50_000_000 * k
        write_png(cam / "data" / f"{stamp}.png", picture(k)[..., 0])
        listed.append(f"{stamp},{stamp}.png")
    (cam / "data.csv").write_text("\r\n".join(listed) + "\r\n")
    (cam / "sensor.yaml").write_text(EUROC_SENSOR)
    names = "p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1]"
    lines = [f"#timestamp, {names}"]
    for k in range(10, 10 * count):
        x, y, z, w = Rotation.from_matrix(bodies[k, :3, :3]).as_quat()
        values = ",".join(f"{value:.9f}" for value in (*bodies[k, :3, 3], w, x, y, z, 0.1))
        lines.append(f"{start + 5_000_000 * k},{values}")
    truth.mkdir(parents=True)
    (truth / "data.csv").write_text("\n".join(lines) + "\n")
    body_from_cam = np.array([[0, -1, 0, -0.02], [1, 0, 0, -0.06], [0, 0, 1, 0.01], [0, 0, 0, 1]])
    return bodies[10::10] @ body_from_cam
