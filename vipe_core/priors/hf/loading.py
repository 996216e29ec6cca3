"""Opening networks of `transformers` from a folder, completely or not at all."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError

from vipe_core.errors import LibraryMissing, WeightsInvalid, WeightsMissing

EXTRA = "pip install 'vipe-cluster[hf]'"


def transformers(*names: str) -> tuple[Any, ...]:
    """What the library has under these names.

    Raises:
        LibraryMissing: It is not installed, or too old to have them; the message says what installs it.
    """
    try:
        library = importlib.import_module("transformers")
        return tuple(getattr(library, name) for name in names)
    except (ImportError, AttributeError) as error:
        raise LibraryMissing(
            f"{', '.join(names)} of the library transformers is needed; install it: {EXTRA}"
        ) from error


def network(kind: Any, folder: Path, device: torch.device, dtype: torch.dtype) -> Any:
    """A network of a class of the library with all of its weights, ready for inference.

    Raises:
        WeightsMissing: No such folder, or no weights in it.
        WeightsInvalid: They are not of this network, or not all of them are there.
    """
    if not (folder / "config.json").is_file() or not any(folder.glob("*.safetensors")):
        raise WeightsMissing(f"{folder} holds no config.json with safetensors; get them with `vipectl models pull`")
    (utilities,) = transformers("utils")
    utilities.logging.disable_progress_bar()
    told = utilities.logging.get_verbosity()
    utilities.logging.set_verbosity_error()
    try:
        model, report = kind.from_pretrained(
            folder, local_files_only=True, use_safetensors=True, output_loading_info=True, dtype=dtype
        )
    except (OSError, ValueError, RuntimeError, KeyError, SafetensorError) as error:
        first_line = (str(error) or "no message").splitlines()[0][:200]
        raise WeightsInvalid(f"{folder.name} cannot be read as weights of {kind.__name__}: {first_line}") from error
    finally:
        utilities.logging.set_verbosity(told)
    # The library would make up what is missing.
    missing = sorted(report["missing_keys"])
    if missing:
        raise WeightsInvalid(
            f"{folder.name} lacks {len(missing)} tensors of {kind.__name__}, such as {missing[0]}; get it again with"
            " `vipectl models pull`"
        )
    return model.to(device).eval().requires_grad_(False)


def tokenizer(folder: Path) -> Any:
    """The tokenizer that came with a network.

    Raises:
        WeightsMissing: None did.
    """
    (kind,) = transformers("AutoTokenizer")
    if not any((folder / name).is_file() for name in ("tokenizer.json", "vocab.txt")):
        raise WeightsMissing(f"{folder} holds no tokenizer.json; get it with `vipectl models pull`")
    return kind.from_pretrained(folder, local_files_only=True)
