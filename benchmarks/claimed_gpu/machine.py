"""The rules of a claimed GPU: which tensors may meet, what makes the host wait, what may be captured."""

from __future__ import annotations

import ctypes
import linecache
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from benchmarks.claimed_gpu.functions import SPECIAL, claims, is_pinned, stripped
from benchmarks.claimed_gpu.runtime import stand_ins
from benchmarks.claimed_gpu.tensor import ClaimedTensor, dispatched_by
from vipe_core import transfer
from vipe_core.ba import cuda, operator
from vipe_core.ba.cuda.compiler import Specialisation
from vipe_core.ba.cuda.launcher import Launch, Launcher
from vipe_core.priors.droid import kernels
from vipe_core.priors.droid.kernels import LookupKernels

_ENGINE = str(Path(operator.__file__).parents[1])
_BETWEEN = (str(Path(__file__).parent), str(Path(torch.__file__).parent))

# Pageable memory that is copied to where it can be sent from before a call returns.
_STAGED_BYTES = 64 << 10
_COPIES = ("copy_", "_to_copy")
_INDEXED = ("index", "index_put", "index_put_", "_unsafe_index", "_unsafe_index_put", "_index_put_impl_")
# Whose shapes or errors depend on values: the host reads a number before it goes on.
_READING = {
    "_local_scalar_dense": "read",
    "equal": "read",
    "nonzero": "shape",
    "masked_select": "shape",
    "_unique2": "shape",
    "unique_dim": "shape",
    "unique_consecutive": "shape",
    "repeat_interleave": "shape",
    "bincount": "shape",
    "_linalg_check_errors": "check",
    "_linalg_eigh": "check",
    "_linalg_svd": "check",
    "linalg_eig": "check",
    "linalg_lstsq": "check",
}
# A 0-dim tensor of the host is a number to these, as it is to all that works value by value.
_TAKE_NUMBERS = ("where", "masked_fill", "masked_fill_", "fill", "fill_")
# Computed in single precision and rounded, as tensor cores do; a CPU has slow loops for halves, or none.
_ACCUMULATED = ("convolution", "mm", "bmm", "addmm", "baddbmm")
_COMPOSITE = torch._C.DispatchKey.CompositeImplicitAutograd
_HALVES = (torch.float16, torch.bfloat16)


class Place(NamedTuple):
    """Where the host waits.

    Attributes:
        kind: `read` (device to host), `upload` (host to device, blocking), `shape`, `check` or `synchronise`.
        function: Ours that caused it, with its module.
        line: Its text.
    """

    kind: str
    function: str
    line: str


class ClaimedGpu(TorchFunctionMode):
    """The device, while it is claimed.

    Attributes:
        waits: How often the host waited, by place.
        copies: Uploads that the host does not wait for.
        operations: Operations on tensors of it.
        replays: Of captured graphs.
        forbidden: Whether a wait is an error, as `torch.cuda.set_sync_debug_mode("error")` makes it.
        recording: What a graph that is being captured is to do, else None.
        operators: Operators that are not torch's own -> what their kernel for CUDA is.
    """

    def __init__(self, operators: dict[Any, Callable[..., Any]] | None = None) -> None:
        super().__init__()
        self.waits: Counter[Place] = Counter()
        self.copies = 0
        self.operations = 0
        self.replays = 0
        self.forbidden = False
        self.recording: list[Callable[[], None]] | None = None
        self.operators = operators or {}

    def wait(self, kind: str) -> None:
        """Count a wait of the host.

        Raises:
            RuntimeError: A graph is being captured, or waits are forbidden.
        """
        self._refuse_in_capture(kind)
        if self.forbidden:
            raise RuntimeError(f"called a synchronizing CUDA operation ({kind})")
        self.waits[_place(kind)] += 1

    def up(self, tensor: Tensor, dtype: torch.dtype | None = None, *, non_blocking: bool = False) -> ClaimedTensor:
        """A copy on the device of a tensor of the host."""
        self._uploaded(tensor, blocking=not non_blocking)
        return ClaimedTensor(tensor.to(dtype or tensor.dtype, copy=True))

    def down(self, tensor: ClaimedTensor, dtype: torch.dtype | None = None) -> Tensor:
        """A copy on the host of a tensor of the device."""
        self.wait("read")
        return tensor.numbers.to(dtype or tensor.dtype, copy=True)

    def made(self, tensor: Tensor) -> ClaimedTensor:
        """What a kernel makes from nothing."""
        self.operations += 1
        return ClaimedTensor(tensor)

    def _refuse_in_capture(self, what: str) -> None:
        if self.recording is not None:
            raise RuntimeError(f"CUDA error: operation not permitted when stream is capturing ({what})")

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        special = SPECIAL.get(func)
        if special is not None:
            return special(self, func, args, kwargs)
        if func in self.operators and any(isinstance(one, ClaimedTensor) for one in args):
            with self:
                return self.operators[func](*args, **kwargs)
        if not claims(kwargs.get("device")):
            return func(*args, **kwargs)
        if args and isinstance(args[0], ClaimedTensor):
            return func(*args, **stripped(kwargs))
        return self.made(func(*args, **{**kwargs, "device": "cpu"}))

    def dispatch(self, func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
        """An operator with tensors of the device among its arguments."""
        name = func.overloadpacket.__name__
        if _composite(func):
            # Those that are written in Python call functions of torch again.
            with self if _COMPOSITE in func.py_kernels else nullcontext():
                return func.decompose(*args, **kwargs)
        of_host = [one for one in _tensors((args, kwargs)) if not isinstance(one, ClaimedTensor)]
        if name == "_to_copy":
            target = kwargs.get("device")
            if target is not None and not claims(target):
                return self.down(args[0], kwargs.get("dtype"))
        elif name == "copy_":
            if of_host:
                blocking = not (args[2] if len(args) > 2 else kwargs.get("non_blocking", False))
                if isinstance(args[0], ClaimedTensor):
                    self._uploaded(args[1], blocking=blocking)
                else:
                    self.wait("read")
        elif name in _INDEXED:
            self._require_indices(func, args)
        elif of_host:
            self._require_numbers(func, name, args, of_host)
        if name in _READING:
            self.wait(_READING[name])
        return self._run(func, name, args, stripped(kwargs))

    def _uploaded(self, tensor: Tensor, *, blocking: bool) -> None:
        """What is not pinned and larger than the driver's own buffer is copied piece by piece, behind all else."""
        if blocking or not (is_pinned(tensor) or tensor.nbytes <= _STAGED_BYTES):
            self.wait("upload")
        else:
            self._refuse_in_capture("upload")
            self.copies += 1

    def _require_indices(self, func: Any, args: Sequence[Any]) -> None:
        """Indices may be on the host: they are copied. A mask is counted first, unless one number is put into it."""
        indices = [one for one in args[1] if one is not None]
        value = args[2] if len(args) > 2 else None
        if not isinstance(args[0], ClaimedTensor):
            raise RuntimeError("indices should be either on cpu or on the same device as the indexed tensor (cpu)")
        masks = [one for one in indices if one.dtype in (torch.bool, torch.uint8)]
        number = value is not None and value.dim() == 0 and not isinstance(value, ClaimedTensor)
        if value is not None and not isinstance(value, ClaimedTensor) and not number:
            raise _mixed(func)
        for one in indices:
            if not isinstance(one, ClaimedTensor):
                self.wait("upload")
        if masks and not number:
            self.wait("shape")
        elif number and not masks:
            self.wait("upload")

    def _require_numbers(self, func: Any, name: str, args: Sequence[Any], of_host: Sequence[Tensor]) -> None:
        """Tensors of the host among those of the device: numbers, where numbers are taken, and nothing else."""
        taken = name in _TAKE_NUMBERS or torch.Tag.pointwise in func.tags
        written = [
            value
            for argument, value in zip(func._schema.arguments, args, strict=False)
            if argument.alias_info is not None and argument.alias_info.is_write
        ]
        if not taken or any(one.dim() for one in of_host) or any(one is given for one in of_host for given in written):
            raise _mixed(func)

    def _run(self, func: Any, name: str, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
        self.operations += 1
        owners: dict[int, Tensor] = {}

        def bare(value: Any) -> Any:
            if not isinstance(value, ClaimedTensor):
                return value
            owners[id(value.numbers)] = value
            return value.numbers

        bare_args, bare_kwargs = _mapped(bare, tuple(args)), _mapped(bare, kwargs)

        def compute() -> Any:
            return _computed(func, name, bare_args, bare_kwargs)

        found = compute()
        if self.recording is not None:
            answers = _tensors(found)
            self.recording.append(lambda: _overwrite(answers, compute()))

        def claimed(value: Any) -> Any:
            if not isinstance(value, Tensor):
                return value
            # What an operation in place answers is what it was given.
            if id(value) in owners:
                return owners[id(value)]
            if not func.is_view or not torch.is_inference_mode_enabled():
                return _given(value, args)
            # A view of a tensor from outside of inference is one from there, too.
            with torch.inference_mode(all(one.is_inference() for one in owners.values())):
                return _given(value, args)

        return _mapped(claimed, found)


def _given(value: Tensor, args: Sequence[Any]) -> Tensor:
    """A tensor of the host that is written to stays there."""
    return value if any(value is one for one in args) else ClaimedTensor(value)


def _overwrite(answers: Sequence[Tensor], found: Any) -> None:
    for old, new in zip(answers, _tensors(found), strict=True):
        if old is not new:
            old.copy_(new)


def _computed(func: Any, name: str, args: Any, kwargs: Any) -> Any:
    if name not in _ACCUMULATED:
        return func(*args, **kwargs)
    half = next((one.dtype for one in _tensors((args, kwargs)) if one.dtype in _HALVES), None)
    if half is None:
        return func(*args, **kwargs)
    return func(*_mapped(_widened, args), **_mapped(_widened, kwargs)).to(half)


@cache
def _composite(func: Any) -> bool:
    """Whether an operator is made of others."""
    return bool(torch._C._dispatch_has_kernel_for_dispatch_key(func.name(), "CompositeImplicitAutograd"))


def _mapped(change: Callable[[Any], Any], value: Any) -> Any:
    """Arguments or answers of an operator with each changed."""
    if isinstance(value, (list, tuple)):
        return type(value)([_mapped(change, one) for one in value])
    if isinstance(value, dict):
        return {name: _mapped(change, one) for name, one in value.items()}
    return change(value)


def _tensors(value: Any) -> list[Tensor]:
    if isinstance(value, Tensor):
        return [value]
    if isinstance(value, dict):
        value = value.values()
    elif not isinstance(value, (list, tuple)):
        return []
    return [found for one in value for found in _tensors(one)]


def _widened(value: Any) -> Any:
    return value.float() if isinstance(value, Tensor) and value.dtype in _HALVES else value


def _mixed(func: Any) -> RuntimeError:
    return RuntimeError(
        f"Expected all tensors to be on the same device, but found at least two devices, cuda:0 and cpu! ({func})"
    )


def _place(kind: str) -> Place:
    """The innermost line of the engine that the host is in; outside of it, of whoever calls torch."""
    frame: Any = sys._getframe(2)
    caller = None
    # What only carries is asked by somebody else.
    while frame is not None and (
        not (name := frame.f_code.co_filename).startswith(_ENGINE) or name == transfer.__file__
    ):
        if caller is None and not frame.f_code.co_filename.startswith(_BETWEEN):
            caller = frame
        frame = frame.f_back
    found: Any = frame or caller
    code = found.f_code
    line = linecache.getline(code.co_filename, found.f_lineno).strip()
    return Place(kind, f"{found.f_globals.get('__name__', '')}.{code.co_qualname}", line)


class _Recorded:
    """A launcher whose launches belong to the graph that is being captured."""

    def __init__(self, gpu: ClaimedGpu, launcher: Launcher) -> None:
        self._gpu, self._launcher = gpu, launcher

    def on_current_stream(self) -> Launch:
        launch = self._launcher.on_current_stream()

        def recorded(kernel: str, blocks: int, threads: int, shared_bytes: int, parameters: int) -> None:
            launch(kernel, blocks, threads, shared_bytes, parameters)
            if self._gpu.recording is None:
                return
            # As a graph has them: the numbers as they are now, whatever is written in their place afterwards.
            context, *numbers = (ctypes.c_void_p * 3).from_address(parameters)
            kept = [ctypes.c_int.from_address(number or 0).value for number in numbers]

            def again() -> None:
                values = (ctypes.c_int * 2)(*kept)
                at = ctypes.addressof(values)
                addresses = (ctypes.c_void_p * 3)(context, at, at + ctypes.sizeof(ctypes.c_int))
                launch(kernel, blocks, threads, shared_bytes, ctypes.addressof(addresses))

            self._gpu.recording.append(again)

        return recorded


@contextmanager
def claimed_gpu(
    launcher: Callable[[Specialisation], Launcher] | None = None,
    lookups: Callable[[torch.dtype], LookupKernels] | None = None,
) -> Iterator[ClaimedGpu]:
    """One GPU, `cuda:0`, for this thread and as long as it lasts.

    Args:
        launcher: Runs the kernels of bundle adjustment; without one they cannot be had, and torch solves.
        lookups: Kernels for correlations, likewise.
    """
    gpu = ClaimedGpu({torch.ops.vipe_core.bundle_adjustment.default: operator._on_gpu})
    with (
        patch.object(
            cuda, "device_launcher", lambda _, kind: None if launcher is None else _Recorded(gpu, launcher(kind))
        ),
        patch.object(kernels, "_opened", lambda _, dtype: None if lookups is None else lookups(dtype)),
        stand_ins(gpu),
        dispatched_by(gpu.dispatch),
        gpu,
    ):
        yield gpu
