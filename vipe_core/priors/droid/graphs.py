"""CUDA graphs of a function of tensors whose shapes repeat: one launch for all of its kernels."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Callable

import torch
from torch import Tensor

logger = logging.getLogger(__name__)

_MOST_GRAPHS = 16

Key = tuple[tuple[torch.Size, tuple[int, ...], torch.dtype], ...]


class _Captured:
    """A function captured for inputs of one kind, and the memory that it reads and writes."""

    def __init__(self, run: Callable[..., tuple[Tensor, ...]], inputs: tuple[Tensor, ...]) -> None:
        self._inputs = tuple(given.clone(memory_format=torch.preserve_format) for given in inputs)
        run(*self._inputs)  # whatever libraries allocate at first must not be allocated by the graph
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._outputs = run(*self._inputs)

    def __call__(self, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        for mine, given in zip(self._inputs, inputs, strict=True):
            mine.copy_(given)
        self._graph.replay()
        return tuple(output.clone(memory_format=torch.preserve_format) for output in self._outputs)


class GraphCache:
    """Runs a function, as a graph from the second time that inputs of a kind come.

    The least recently used graph goes when there are too many. Where capture fails, which is logged once, the function
    is simply called.

    Args:
        run: Launches kernels on the current stream and does nothing else; its arguments and answers are tensors on a
            GPU.
    """

    def __init__(self, run: Callable[..., tuple[Tensor, ...]]) -> None:
        self._run = run
        self._seen: OrderedDict[Key, _Captured | None] = OrderedDict()
        self._works = True

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
                captured = self._seen[key] = _Captured(self._run, inputs)
            except RuntimeError:
                logger.warning("CUDA graphs cannot be captured; the network runs without", exc_info=True)
                self._works = False
                self._seen.clear()
                return self._run(*inputs)
        return captured(inputs)
