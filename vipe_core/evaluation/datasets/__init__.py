"""Public datasets with ground truth in their published layouts, and the protocols that they are judged by."""

from vipe_core.evaluation.datasets.protocols import PROTOCOLS, Protocol, protocol_of
from vipe_core.evaluation.datasets.registry import DATASETS, FoundDataset, SequenceRef, find_sequences
from vipe_core.evaluation.datasets.sequence import GroundTruthSequence, LazyDepth, Pictures

__all__ = [
    "DATASETS",
    "PROTOCOLS",
    "FoundDataset",
    "GroundTruthSequence",
    "LazyDepth",
    "Pictures",
    "Protocol",
    "SequenceRef",
    "find_sequences",
    "protocol_of",
]
