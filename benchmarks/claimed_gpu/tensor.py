"""A tensor that says that it is on a GPU, with its numbers on the CPU."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from weakref import WeakValueDictionary

import torch
from torch import Tensor

Dispatch = Callable[[Any, Sequence[Any], dict[str, Any]], Any]

DEVICE = torch.device("cuda", 0)

_dispatch: list[Dispatch] = []
# What CUDA's allocator rounds up to.
_BLOCK_BYTES = 512


class Memory:
    """Bytes that tensors of the device hold, counted once for all that share them.

    Attributes:
        held_bytes: Now, with what captured graphs keep for themselves.
        peak_bytes: At most, since that was last set back.
    """

    def __init__(self) -> None:
        self.held_bytes = self.peak_bytes = 0
        self._graph_bytes = 0
        self._blocks: WeakValueDictionary[int, _Block] = WeakValueDictionary()

    def block_of(self, numbers: Tensor) -> _Block:
        """The block that a tensor lies in; it is given back when nobody has it any more."""
        storage = numbers.untyped_storage()
        block = self._blocks.get(storage._cdata)
        if block is None:
            block = self._blocks[storage._cdata] = _Block(self, -(-storage.nbytes() // _BLOCK_BYTES) * _BLOCK_BYTES)
        return block

    def take(self, size_bytes: int) -> None:
        self.held_bytes += size_bytes
        self.peak_bytes = max(self.peak_bytes, self.held_bytes)

    def begin(self) -> None:
        """Of a claim: there is no graph yet."""
        self.held_bytes -= self._graph_bytes
        self._graph_bytes = 0
        self.set_back()

    def set_back(self) -> None:
        """Begin to look for the peak anew."""
        self.peak_bytes = self.held_bytes

    @contextmanager
    def captured(self) -> Iterator[None]:
        """What is taken at most meanwhile stays with the graph; all graphs share the largest of their parts."""
        before_bytes, peak_bytes = self.held_bytes, self.peak_bytes
        self.set_back()
        yield
        graph_bytes = self.peak_bytes - before_bytes
        self.peak_bytes = max(self.peak_bytes, peak_bytes)
        self.take(max(graph_bytes - self._graph_bytes, 0))
        self._graph_bytes = max(graph_bytes, self._graph_bytes)


class _Block:
    def __init__(self, memory: Memory, size_bytes: int) -> None:
        self._memory, self._size_bytes = memory, size_bytes
        memory.take(size_bytes)

    def __del__(self) -> None:
        self._memory.held_bytes -= self._size_bytes


MEMORY = Memory()
"""Of the device, whoever claims it."""


@contextmanager
def dispatched_by(dispatch: Dispatch) -> Iterator[None]:
    """Every operator with such a tensor among its arguments is answered by this."""
    _dispatch.append(dispatch)
    try:
        yield
    finally:
        _dispatch.pop()


def _dispatched(cls: type, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
    if not _dispatch:
        raise RuntimeError("a tensor of a claimed GPU was used after its end")
    return _dispatch[-1](func, args, kwargs or {})


def _shown(self: ClaimedTensor, **_: Any) -> str:
    return f"claimed({self.numbers!r})"


class ClaimedTensor(Tensor):
    """See the module.

    Attributes:
        numbers: What it holds: a tensor of the host of the same shape, strides and type.
    """

    numbers: Tensor
    block: _Block

    # What torch's own stubs say of these is not what they are.
    __torch_function__: Any = torch._C._disabled_torch_function_impl
    __torch_dispatch__: Any = classmethod(_dispatched)
    __repr__: Any = _shown

    @staticmethod
    def __new__(cls, numbers: Tensor) -> ClaimedTensor:
        make: Any = torch.Tensor._make_wrapper_subclass
        claimed: ClaimedTensor = make(
            cls,
            numbers.size(),
            strides=numbers.stride(),
            storage_offset=numbers.storage_offset(),
            dtype=numbers.dtype,
            layout=numbers.layout,
            device=DEVICE,
            requires_grad=False,
        )
        claimed.numbers = numbers
        claimed.block = MEMORY.block_of(numbers)
        return claimed

    def __init__(self, numbers: Tensor) -> None:
        """`numbers` must not be claimed itself."""
