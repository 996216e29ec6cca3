"""Choosing where to compute, and how many threads to take."""

from __future__ import annotations

import cv2
import torch

from vipe_core.errors import ConfigError


def resolve_device(name: str) -> torch.device:
    """The torch device called `name`: `cpu`, `cuda` or `cuda:N`.

    Raises:
        ConfigError: There is no such device here.
    """
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ConfigError(f"unknown device {name!r}; use cpu, cuda or cuda:N") from error
    if device.type == "cpu":
        return device
    if device.type != "cuda":
        raise ConfigError(f"device {name!r} is not supported; use cpu, cuda or cuda:N")
    if not torch.cuda.is_available():
        raise ConfigError(
            f"device {name!r}: torch {torch.__version__} finds no CUDA GPU; install a CUDA build of torch on a machine"
            " with an NVIDIA driver, or use cpu"
        )
    if device.index is not None and device.index >= torch.cuda.device_count():
        raise ConfigError(f"device {name!r}: this machine has {torch.cuda.device_count()} GPU(s), counted from 0")
    return device


def describe_device(device: torch.device, threads: int) -> str:
    """What results are reproducible on: `cpu` or the GPU's name, and the thread count where it is not one.

    Optical flow is computed in one stripe per thread, and a stripe does not see its neighbour.
    """
    name = "cpu" if device.type == "cpu" else f"cuda ({torch.cuda.get_device_name(device)})"
    return name if threads == 1 else f"{name}, {threads} threads"


def set_threads(threads: int) -> None:
    """Bound the threads of torch and OpenCV in this process.

    Raises:
        ConfigError: `threads` is not positive.
    """
    if threads < 1:
        raise ConfigError(f"threads must be at least 1, got {threads}")
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
