"""What `torch.cuda` says and does while a GPU is claimed."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import torch

from benchmarks.claimed_gpu.tensor import MEMORY

if TYPE_CHECKING:
    from benchmarks.claimed_gpu.machine import ClaimedGpu

_MEMORY_BYTES = 80 << 30
_CAPABILITY = (9, 0)
_NAME = "claimed GPU"


@contextmanager
def stand_ins(gpu: ClaimedGpu) -> Iterator[None]:
    """`torch.cuda` with one device, on which everything is done at once."""

    class Stream:
        cuda_stream = 0

        def __init__(self, *_: Any, **__: Any) -> None:
            pass

        def synchronize(self) -> None:
            gpu.wait("synchronise")

        def wait_stream(self, stream: Any) -> None:
            pass

        def wait_event(self, event: Any) -> None:
            pass

        def record_event(self, event: Any = None) -> Any:
            return event or Event()

        def query(self) -> bool:
            return True

    class Event:
        def __init__(self, *_: Any, **__: Any) -> None:
            self.at_s = 0.0

        def record(self, stream: Any = None) -> None:
            self.at_s = time.perf_counter()

        def wait(self, stream: Any = None) -> None:
            pass

        def synchronize(self) -> None:
            gpu.wait("synchronise")

        def query(self) -> bool:
            return True

        def elapsed_time(self, other: Any) -> float:
            return float(1000 * (other.at_s - self.at_s))

    class Graph:
        steps: tuple[Callable[[], None], ...] = ()

        def replay(self) -> None:
            gpu.replays += 1
            for step in self.steps:
                step()

        def reset(self) -> None:
            self.steps = ()

        def pool(self) -> tuple[int, int]:
            return (0, 1)

    @contextmanager
    def captured(graph: Graph, pool: Any = None, stream: Any = None, **_: Any) -> Iterator[None]:
        if gpu.recording is not None:
            raise RuntimeError("a graph is being captured already")
        gpu.recording = []
        try:
            with MEMORY.captured():
                yield
            graph.steps = tuple(gpu.recording)
        finally:
            gpu.recording = None

    @contextmanager
    def chosen(_: Any = None) -> Iterator[None]:
        yield

    def synchronize(_: Any = None) -> None:
        gpu.wait("synchronise")

    def forbid(mode: int | str) -> None:
        gpu.forbidden = mode in (2, "error")

    def bound(fraction: float, device: Any = None) -> None:
        # As torch does: a device without a number is refused.
        if device is not None and not isinstance(device, int) and torch.device(device).index is None:
            raise ValueError(f"Expected a torch.device with a specified index or an integer, but got:{device}")
        if not isinstance(fraction, float) or not 0 <= fraction <= 1:
            raise ValueError(f"Invalid fraction value: {fraction}. Allowed range: 0~1")

    only = Stream()
    properties = SimpleNamespace(
        name=_NAME, total_memory=_MEMORY_BYTES, major=_CAPABILITY[0], minor=_CAPABILITY[1], multi_processor_count=132
    )
    answers = {
        "is_available": True,
        "is_initialized": True,
        "is_bf16_supported": True,
        "device_count": 1,
        "current_device": 0,
        "get_device_name": _NAME,
        "get_device_capability": _CAPABILITY,
        "get_device_properties": properties,
        "mem_get_info": (_MEMORY_BYTES, _MEMORY_BYTES),
        "memory_reserved": 0,
        "max_memory_reserved": 0,
        "current_stream": only,
        "default_stream": only,
        "graph_pool_handle": (0, 1),
        "is_current_stream_capturing": False,
        "get_rng_state": torch.get_rng_state(),
    }
    quiet = (
        "init",
        "_lazy_init",
        "empty_cache",
        "set_device",
        "manual_seed_all",
        "set_rng_state",
    )
    replaced: dict[str, Any] = {
        "Stream": Stream,
        "Event": Event,
        "CUDAGraph": Graph,
        "graph": captured,
        "stream": chosen,
        "device": chosen,
        "device_of": chosen,
        "synchronize": synchronize,
        "set_sync_debug_mode": forbid,
        "set_per_process_memory_fraction": bound,
        "memory_allocated": lambda _=None: MEMORY.held_bytes,
        "max_memory_allocated": lambda _=None: MEMORY.peak_bytes,
        "reset_peak_memory_stats": lambda _=None: MEMORY.set_back(),
        **{name: _answering(answer) for name, answer in answers.items()},
        **{name: _answering(None) for name in quiet},
    }
    MEMORY.begin()
    with ExitStack() as stack:
        for name, value in replaced.items():
            stack.enter_context(patch.object(torch.cuda, name, value))
        # A module that moves there gets new parameters: old ones cannot become another kind of tensor.
        overwritten = torch.__future__.get_overwrite_module_params_on_conversion()
        stack.callback(torch.__future__.set_overwrite_module_params_on_conversion, overwritten)
        torch.__future__.set_overwrite_module_params_on_conversion(True)
        _allocate(gpu, stack)
        yield


def _allocate(gpu: ClaimedGpu, stack: ExitStack) -> None:
    """Memory that torch's own operators ask the device for."""
    library: Any = torch.library
    own = library.Library("aten", "IMPL", "CUDA")
    stack.callback(own._destroy)

    def empty(size: Any, *, device: Any = None, **how: Any) -> Any:
        return gpu.made(torch.empty(size, device="cpu", **how))

    def empty_strided(size: Any, stride: Any, *, device: Any = None, **how: Any) -> Any:
        return gpu.made(torch.empty_strided(size, stride, device="cpu", **how))

    own.impl("empty.memory_format", empty)
    own.impl("empty_strided", empty_strided)


def _answering(value: Any) -> Callable[..., Any]:
    return lambda *_, **__: value
