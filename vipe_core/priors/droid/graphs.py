"""CUDA graphs of a function of tensors whose shapes repeat: one launch for all of its kernels."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

logger = logging.getLogger(__name__)

_MOST_GRAPHS = 16

Key = tuple[tuple[torch.Size, tuple[int, ...], torch.dtype], ...]


class _Captured:
    """A function captured for inputs of one kind, and the memory that it reads and writes."""

    def __init__(self, run: Callable[..., tuple[Tensor, ...]], inputs: tuple[Tensor, ...], pool: Any) -> None:
        self._inputs = inputs
        run(*self._inputs)  # whatever libraries allocate at first must not be allocated by the graph
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph, pool=pool):
            self._outputs = run(*self._inputs)

    def __call__(self, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        for mine, given in zip(self._inputs, inputs, strict=True):
            mine.copy_(given)
        self._graph.replay()
        return tuple(output.clone(memory_format=torch.preserve_format) for output in self._outputs)


class GraphCache:
    """Runs a function, as a graph from the second time that inputs of a kind come.

    The least recently used graph goes when there are too many. Where capture fails, which is logged once, the function
    is simply called. All graphs read the same inputs and work in the same memory, so that many take little more than
    the largest: they run one after the other, and what one answers is copied before the next one runs.

    Args:
        run: Launches kernels on the current stream and does nothing else; its arguments and answers are tensors on a
            GPU.
    """

    def __init__(self, run: Callable[..., tuple[Tensor, ...]]) -> None:
        self._run = run
        self._seen: OrderedDict[Key, _Captured | None] = OrderedDict()
        self._works = True
        self._inputs: list[Tensor] = []
        self._pool: Any = None

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        if not self._works:
            return self._run(*inputs)
        key: Key = tuple((given.shape, given.stride(), given.dtype) for given in inputs)
        if key not in self._seen:
            self._seen[key] = None
            if len(self._seen) > _MOST_GRAPHS:
                self._seen.popitem(last=False)
            return self._run(*inputs)
        captured = self._seen[key]
        self._seen.move_to_end(key)
        if captured is None:
            try:
                if self._pool is None:
                    self._pool = torch.cuda.graph_pool_handle()
                own = self._own(inputs)
                for mine, given in zip(own, inputs, strict=True):
                    mine.copy_(given)
                captured = self._seen[key] = _Captured(self._run, own, self._pool)
            except RuntimeError:
                logger.warning("CUDA graphs cannot be captured; the network runs without", exc_info=True)
                self._works = False
                self._seen.clear()
                self._inputs.clear()
                return self._run(*inputs)
        return captured(inputs)

    def _own(self, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """Tensors laid out like these in the memory that graphs read; where that grows, graphs are captured anew."""
        for position, given in enumerate(inputs):
            if position == len(self._inputs):
                self._inputs.append(given.new_empty(0))
            if self._inputs[position].numel() < given.numel():
                self._inputs[position] = given.new_empty(given.numel())
                self._seen.update(dict.fromkeys(self._seen))
        return tuple(
            memory.as_strided(given.shape, given.stride()) for memory, given in zip(self._inputs, inputs, strict=True)
        )
