"""Choosing where to compute, and how many threads to take."""

from __future__ import annotations

import cv2
import torch

from vipe_core.errors import ConfigError

# What the driver and its libraries take of a GPU for a process, whatever it does.
_CONTEXT_BYTES = 500 << 20
# How CUDA, its libraries and our kernels' launcher say it.
_OUT_OF_MEMORY = ("CUDA out of memory", "out of memory", "OUT_OF_MEMORY", "ALLOC_FAILED")


def resolve_device(name: str) -> torch.device:
    """The torch device called `name`: `cpu`, `cuda` (the one that is current) or `cuda:N`.

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
    # Tensors name their GPU by its number, and some of torch's functions want it.
    return device if device.index is not None else torch.device("cuda", torch.cuda.current_device())


def device_memory_bytes(device: torch.device) -> int | None:
    """All memory of a GPU; None for a CPU."""
    if device.type == "cpu":
        return None
    return int(torch.cuda.get_device_properties(device).total_memory)


def limit_memory(device: torch.device, size_bytes: int) -> None:
    """Bound what this process takes of a GPU from now on: what shares the GPU with it keeps its own part.

    The driver's and the libraries' part is not torch's to bound; it is taken off.
    """
    total_bytes = device_memory_bytes(device)
    if total_bytes is not None:
        share = max(size_bytes - _CONTEXT_BYTES, 0) / total_bytes
        torch.cuda.set_per_process_memory_fraction(min(share, 1.0), device)


def release_memory(device: torch.device) -> None:
    """Give back what torch keeps for later, so that others on the GPU may take it."""
    if device.type == "cuda":
        torch.cuda.empty_cache()


def ran_out_of_memory(error: BaseException) -> bool:
    """Whether a library failed because the GPU's memory is taken."""
    if isinstance(error, torch.OutOfMemoryError):
        return True
    return isinstance(error, RuntimeError) and any(sign in str(error) for sign in _OUT_OF_MEMORY)


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
