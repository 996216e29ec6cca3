"""A tensor that says that it is on a GPU, with its numbers on the CPU."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

Dispatch = Callable[[Any, Sequence[Any], dict[str, Any]], Any]

DEVICE = torch.device("cuda", 0)

_dispatch: list[Dispatch] = []


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
        return claimed

    def __init__(self, numbers: Tensor) -> None:
        """`numbers` must not be claimed itself."""
