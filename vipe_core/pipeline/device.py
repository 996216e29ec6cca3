"""Choosing where to compute, and how many threads to take."""

from __future__ import annotations

import os

import cv2
import torch

from vipe_core.errors import ConfigError

_MAX_DEFAULT_THREADS = 4


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


def describe_device(device: torch.device) -> str:
    """`cpu`, or the name of the GPU: results are reproducible on one and the same kind of device."""
    return "cpu" if device.type == "cpu" else f"cuda ({torch.cuda.get_device_name(device)})"


def set_threads(threads: int | None) -> int:
    """Bound the threads of torch and OpenCV in this process.

    Args:
        threads: None takes what `OMP_NUM_THREADS` says, or else the available cores up to a few: more gain nothing on
            working images of this size.

    Raises:
        ConfigError: `threads` is not positive.
    """
    if threads is None:
        stated = os.environ.get("OMP_NUM_THREADS", "")
        available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        threads = int(stated) if stated.isdigit() and int(stated) > 0 else min(available, _MAX_DEFAULT_THREADS)
    if threads < 1:
        raise ConfigError(f"threads must be at least 1, got {threads}")
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    return threads
