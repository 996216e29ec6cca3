"""A GPU that is not there: tensors that claim to be on one and compute on the CPU, to find what one would refuse.

    with claimed_gpu() as gpu:
        Annotator("vipe_fast", device="cuda").annotate(clip)
    print(gpu.waits)

Inside, `torch.device("cuda")` works: tensors there refuse to be mixed with others, to be read by numpy and to be
uploaded, read or counted while a graph is captured, as CUDA's do; half precision is rounded; what makes the host wait
for the GPU is counted with the line of ours that asked for it. Graphs are recorded and really replayed. What is not
there: asynchrony (a race between streams cannot show), speed, and limits of memory, which is only counted.
"""

from __future__ import annotations

from benchmarks.claimed_gpu.machine import ClaimedGpu, Place, claimed_gpu
from benchmarks.claimed_gpu.tensor import ClaimedTensor

__all__ = ["ClaimedGpu", "ClaimedTensor", "Place", "claimed_gpu"]
