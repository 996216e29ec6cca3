"""Functions of torch that would look for a GPU before any tensor of it is asked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.claimed_gpu.tensor import ClaimedTensor

if TYPE_CHECKING:
    from benchmarks.claimed_gpu.machine import ClaimedGpu

# What Python's own types of numbers stand for.
_NUMBERS = {float: torch.float64, int: torch.int64, bool: torch.bool}

_PINNED = "claimed_pinned"

Special = Callable[["ClaimedGpu", Any, Sequence[Any], dict[str, Any]], Any]


def claims(device: Any) -> bool:
    """Whether a device is the claimed one."""
    return device is not None and (isinstance(device, int) or torch.device(device).type == "cuda")


def stripped(kwargs: dict[str, Any]) -> dict[str, Any]:
    """Without the claimed device."""
    return {name: value for name, value in kwargs.items() if name != "device" or not claims(value)}


def _to(gpu: ClaimedGpu, func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    tensor, named = args[0], dict(kwargs)
    device, dtype, other = (named.pop(name, None) for name in ("device", "dtype", "other"))
    flags = []
    for given in args[1:]:
        if isinstance(given, Tensor):
            other = given
        elif isinstance(given, torch.dtype):
            dtype = given
        elif given in _NUMBERS:
            dtype = _NUMBERS[given]
        elif isinstance(given, bool):
            flags.append(given)
        elif given is not None:
            device = given
    named.update(zip(("non_blocking", "copy"), flags, strict=False))
    if other is not None:
        device, dtype = other.device, other.dtype
    upwards = claims(tensor.device if device is None else device)
    if upwards == isinstance(tensor, ClaimedTensor):
        named.update({} if dtype is None else {"dtype": dtype})
        return func(tensor, **named) if named.keys() - {"non_blocking"} else tensor
    if not upwards:
        return gpu.down(tensor, dtype)
    moved = gpu.up(tensor, dtype, non_blocking=named.get("non_blocking", False))
    layout = named.get("memory_format")
    return moved if layout is None else torch.ops.aten.contiguous.default(moved, memory_format=layout)


def _cpu(gpu: ClaimedGpu, func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    return gpu.down(args[0]) if isinstance(args[0], ClaimedTensor) else func(*args, **kwargs)


def _cuda(gpu: ClaimedGpu, func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    if isinstance(args[0], ClaimedTensor):
        return args[0]
    return gpu.up(args[0], non_blocking=kwargs.get("non_blocking", False))


def is_pinned(tensor: Tensor) -> bool:
    """Whether a tensor of the host was pinned here."""
    return getattr(tensor, _PINNED, False)


def _pin_memory(gpu: ClaimedGpu, func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    if isinstance(args[0], ClaimedTensor):
        raise RuntimeError("cannot pin memory that is not on the host")
    pinned = args[0].clone()
    setattr(pinned, _PINNED, True)
    return pinned


def _is_pinned(gpu: ClaimedGpu, func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> bool:
    return is_pinned(args[0])


def _tensor(gpu: ClaimedGpu, func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    if not claims(kwargs.get("device")):
        return func(*args, **kwargs)
    if isinstance(args[0], ClaimedTensor):
        return func(*args, **stripped(kwargs))
    return gpu.up(func(*args, **{**kwargs, "device": "cpu"}))


def _new_tensor(gpu: ClaimedGpu, func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    if not isinstance(args[0], ClaimedTensor):
        return func(*args, **kwargs)
    return gpu.up(torch.tensor(args[1], dtype=kwargs.get("dtype", args[0].dtype)))


def _tolist(gpu: ClaimedGpu, func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    return gpu.down(args[0]).tolist() if isinstance(args[0], ClaimedTensor) else func(*args)


def _number(kind: Callable[[Any], Any]) -> Special:
    """`item`, and what Python asks it for."""

    def read(gpu: ClaimedGpu, func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
        if not isinstance(args[0], ClaimedTensor):
            return func(*args)
        return kind(torch.ops.aten._local_scalar_dense(args[0].reshape(())))

    return read


def _operator(operator: Any) -> Special:
    """A method that asks for a guard of the device before it calls the operator of its name."""

    def call(gpu: ClaimedGpu, func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
        return (operator if _of_device(*args) else func)(*args, **kwargs)

    return call


def _data_ptr(gpu: ClaimedGpu, func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    return func(args[0].numbers if isinstance(args[0], ClaimedTensor) else args[0])


def _nonzero(gpu: ClaimedGpu, func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    if not _of_device(args[0]):
        return func(*args, **kwargs)
    return (torch.ops.aten.nonzero_numpy if kwargs.get("as_tuple") else torch.ops.aten.nonzero)(args[0])


def _get_data(gpu: ClaimedGpu, func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    return ClaimedTensor(args[0].numbers) if isinstance(args[0], ClaimedTensor) else func(*args)


def _set_data(gpu: ClaimedGpu, func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> None:
    if isinstance(args[0], ClaimedTensor) != isinstance(args[1], ClaimedTensor):
        raise RuntimeError("a tensor cannot take the data of one on another device")
    func(*args)
    if isinstance(args[0], ClaimedTensor):
        args[0].numbers, args[0].block = args[1].numbers, args[1].block


def _get(gpu: ClaimedGpu, func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    if not _of_device(*args):
        return func(*args)
    view, indices = _basic(gpu, args[0], args[1])
    return view if not indices else torch.ops.aten.index.Tensor(view, indices)


def _set(gpu: ClaimedGpu, func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    if not _of_device(*args):
        return func(*args)
    view, indices = _basic(gpu, args[0], args[1])
    value = args[2] if isinstance(args[2], Tensor) else torch.tensor(args[2], dtype=args[0].dtype)
    if indices:
        torch.ops.aten.index_put_.default(view, indices, value)
    elif value.dim() or isinstance(value, ClaimedTensor):
        torch.ops.aten.copy_.default(view, value)
    else:
        torch.ops.aten.fill_.Tensor(view, value)
    return None


def _of_device(tensor: Any, index: Any = None, value: Any = None) -> bool:
    parts = index if isinstance(index, tuple) else (index,)
    return any(isinstance(one, ClaimedTensor) for one in (tensor, value, *parts))


def _basic(gpu: ClaimedGpu, tensor: Tensor, index: Any) -> tuple[Tensor, list[Tensor | None]]:
    """What numbers, slices and None make of a tensor, and the tensors that index the dimensions of that.

    Torch's own way there asks for a guard of the device.
    """
    parts = list(index) if isinstance(index, tuple) else [index]
    # A list or an array becomes a tensor of the host.
    for k, one in enumerate(parts):
        if isinstance(one, (list, tuple, np.ndarray)):
            parts[k] = torch.as_tensor(one, dtype=None if len(one) else torch.int64)
    taken = sum(_dimensions(one) for one in parts)
    gap = next((k for k, one in enumerate(parts) if one is Ellipsis), len(parts))
    parts[gap : gap + 1] = [slice(None)] * (tensor.dim() - taken)
    view, at = tensor, 0
    indices: list[Tensor | None] = []
    for one in parts:
        if isinstance(one, Tensor) and one.dim():
            indices.append(one)
            at += _dimensions(one)
        elif one is None or isinstance(one, slice):
            if one is None:
                view = view.unsqueeze(at)
            elif one != slice(None):
                start, stop, step = one.indices(view.shape[at])
                view = torch.ops.aten.slice.Tensor(view, at, start, max(start, stop), step)
            indices.append(None)
            at += 1
        else:
            number = torch.ops.aten._local_scalar_dense(one) if isinstance(one, ClaimedTensor) else int(one)
            view = view.select(at, number)
    return view, indices if any(one is not None for one in indices) else []


def _dimensions(part: Any) -> int:
    if part is None or part is Ellipsis:
        return 0
    return part.dim() if isinstance(part, Tensor) and part.dtype in (torch.bool, torch.uint8) else 1


_data: Any = torch.Tensor.data

SPECIAL: dict[Any, Special] = {
    torch.Tensor.to: _to,
    torch.Tensor.cpu: _cpu,
    torch.Tensor.cuda: _cuda,
    torch.Tensor.pin_memory: _pin_memory,
    torch.Tensor.is_pinned: _is_pinned,
    torch.tensor: _tensor,
    torch.as_tensor: _tensor,
    torch.asarray: _tensor,
    torch.Tensor.new_tensor: _new_tensor,
    torch.Tensor.tolist: _tolist,
    torch.Tensor.item: _number(lambda value: value),
    torch.Tensor.__bool__: _number(bool),
    torch.Tensor.__int__: _number(int),
    torch.Tensor.__index__: _number(int),
    torch.Tensor.__float__: _number(float),
    torch.Tensor.contiguous: _operator(torch.ops.aten.contiguous.default),
    torch.Tensor.copy_: _operator(torch.ops.aten.copy_.default),
    torch.Tensor.__invert__: _operator(torch.ops.aten.bitwise_not.default),
    torch.Tensor.nonzero: _nonzero,
    torch.nonzero: _nonzero,
    torch.Tensor.data_ptr: _data_ptr,
    _data.__get__: _get_data,
    _data.__set__: _set_data,
    torch.Tensor.__getitem__: _get,
    torch.Tensor.__setitem__: _set,
}
