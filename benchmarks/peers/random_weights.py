"""Files of weights as `vipectl models pull` leaves them, of the real architectures, with random numbers in them.

What the networks say with them means nothing; that they are loaded, run and answer in the right shapes does. Sizes of
layers are those that their authors publish. The seed is fixed.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import torch

from vipe_core.priors.hf.loading import transformers
from vipe_core.priors.nvidia_vipe.loading import part
from vipe_core.priors.weights import folder_of, path_of

Size = Literal["small", "production"]
"""The smallest that there is of a network, or the one that is pulled."""

_WORDS = ("[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", ".", "person", "car", "sky")


def write(weights: str, size: Size) -> tuple[str, int]:
    """Write the files of a network into the folder of weights.

    Args:
        weights: As in `vipectl models pull`.

    Returns:
        What the architecture is called, and its number of parameters.

    Raises:
        LibraryMissing: Of the library that has the network.
    """
    torch.manual_seed(0)
    folder = path_of(weights).parent if weights in _FILES else folder_of(weights)
    folder.mkdir(parents=True, exist_ok=True)
    return (_FILES | _FOLDERS)[weights](weights, size)


def _count(network: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in network.parameters())


def _dino_sizes(size: Size) -> tuple[str, int, list[int]]:
    """Name, width of the decoder, layers that are read, of the ViT that UniDepth and UniK3D stand on."""
    return ("vits14", 256, [3, 6, 9, 12]) if size == "small" else ("vitl14", 512, [6, 12, 18, 24])


def _universal(kind: Any, folder: Path, size: Size, **differences: Any) -> tuple[str, int]:
    """UniDepthV2 or UniK3D: what their configurations have that matters without training."""
    name, width, layers = _dino_sizes(size)
    shape = {"ratio_bounds": [0.5, 2.5], "pixels_max": 600000, "pixels_min": 200000, "shape_mult": 14}
    encoder: dict[str, Any] = {
        "name": f"dinov2_{name}",
        "use_norm": True,
        "num_register_tokens": 0,
        "output_idx": layers,
    }
    decoder: dict[str, Any] = {"hidden_dim": width, "out_dim": width // 8, "depths": [2, 2, 2]}
    decoder |= {"dropout": 0.0, "kernel_size": 3}
    config: dict[str, dict[str, Any]] = {
        "data": {"shape_constraints": shape, "augmentations": {"shape_constraints": shape}, "image_shape": [518, 518]},
        "training": {"drop_path": 0.0},
        "model": {
            "num_heads": 8,
            "expansion": 4,
            "layer_scale": 1.0,
            "pixel_decoder": decoder,
            "pixel_encoder": encoder | {"pretrained": None, "stacking_fn": "last"},
        },
    }
    config["model"] |= {key: value for key, value in differences.items() if key != "pixel_decoder"}
    decoder |= differences.get("pixel_decoder", {})
    network = kind(config)
    network.save_pretrained(folder)
    return f"{kind.__name__} {name}", _count(network)


def _unidepth(weights: str, size: Size) -> tuple[str, int]:
    (kind,) = part("depth.unidepth.models.unidepthv2.unidepthv2", "UniDepthV2")
    return _universal(kind, folder_of(weights), size)


def _unik3d(weights: str, size: Size) -> tuple[str, int]:
    (kind,) = part("depth.unik3d.unik3d", "UniK3D")
    own = {"detach": 0.1, "num_prompt_blocks": 1, "use_norm": False}
    camera = {"augment": True, "weak_ratio": 0.9, "tau": 50000}
    differences = {"pixel_decoder": own, "camera": camera, "num_steps": 100000, "layer_scale": 1e-4}
    return _universal(kind, folder_of(weights), size, **differences)


def _metric3d(weights: str, size: Size) -> tuple[str, int]:
    which = weights.partition("_")[2]
    (build,) = part("depth.metric3d.model_fn", f"metric3d_vit_{which}")
    network = build(pretrain=False)
    # Some of its layers leave in memory what they find there.
    for name, parameter in network.named_parameters():
        if parameter.ndim > 1:
            torch.nn.init.trunc_normal_(parameter, std=0.02)
        elif name.endswith("bias"):
            torch.nn.init.zeros_(parameter)
    torch.save({"model_state_dict": network.state_dict()}, path_of(weights))
    return f"Metric3Dv2 ViT-{which}", _count(network)


def _geocalib(weights: str, size: Size) -> tuple[str, int]:
    (kind,) = part("geocalib.geocalib", "GeoCalib")
    network = kind()
    torch.save({"model": network.state_dict()}, path_of(weights))
    return "GeoCalib", _count(network)


def _video_depth_anything(weights: str, size: Size) -> tuple[str, int]:
    from vipe_core.priors.nvidia_vipe.video_depth import HEADS

    (kind,) = part("depth.videodepthanything.video_depth", "VideoDepthAnything")
    network = kind(encoder="vits", **HEADS["vits"])
    torch.save(network.state_dict(), path_of(weights))
    return "Video Depth Anything vits", _count(network)


def _priorda(weights: str, size: Size) -> tuple[str, int]:
    from vipe_core.priors.nvidia_vipe.completion import CONDITIONED, FROZEN

    kind, sizes = part("depth.priorda.dav2", "DepthAnythingV2", "model_configs")
    frozen, conditioned = kind(**sizes["vitb"]), kind(**sizes["vitb"], encoder_cond_dim=3)
    torch.save(frozen.state_dict(), folder_of(weights) / FROZEN)
    conditioned.init_state_dict(conditioned.state_dict())
    torch.save({"model": conditioned.state_dict()}, folder_of(weights) / CONDITIONED)
    return "PriorDA, two vitb", _count(frozen) + _count(conditioned)


def _saved(network: Any, weights: str, name: str) -> tuple[str, int]:
    (utilities,) = transformers("utils")
    utilities.logging.disable_progress_bar()
    network.save_pretrained(folder_of(weights))
    return name, _count(network)


def _vit(hidden: int, layers: int, heads: int, **rest: Any) -> dict[str, Any]:
    return {
        "model_type": "dinov2",
        "hidden_size": hidden,
        "num_hidden_layers": layers,
        "num_attention_heads": heads,
        **rest,
    }


def _depth_anything(weights: str, size: Size) -> tuple[str, int]:
    config, kind = transformers("DepthAnythingConfig", "DepthAnythingForDepthEstimation")
    stages = {"out_indices": [3, 6, 9, 12], "reshape_hidden_states": False}
    metric = config(
        backbone_config=_vit(384, 12, 6, image_size=518, patch_size=14, **stages),
        reassemble_hidden_size=384,
        neck_hidden_sizes=[48, 96, 192, 384],
        fusion_hidden_size=64,
        head_hidden_size=32,
        depth_estimation_type="metric",
        max_depth=20 if weights.endswith("indoor") else 80,
    )
    return _saved(kind(metric), weights, "Depth Anything V2 vits, metric")


def _depth_pro(weights: str, size: Size) -> tuple[str, int]:
    config, kind = transformers("DepthProConfig", "DepthProForDepthEstimation")
    vit = _vit(1024, 24, 16, image_size=384, patch_size=16)
    whole = config(image_model_config=vit, patch_model_config=vit, fov_model_config=vit, use_fov_model=True)
    return _saved(kind(whole), weights, "Depth Pro, three vitl")


def _grounding_dino(weights: str, size: Size) -> tuple[str, int]:
    config, kind = transformers("GroundingDinoConfig", "GroundingDinoForObjectDetection")
    _write_words(folder_of(weights))
    return _saved(kind(config()), weights, "GroundingDINO, Swin-tiny")


def _write_words(folder: Path) -> None:
    """A tokenizer of a few words, as the hub keeps one."""
    from tokenizers import Tokenizer, models, normalizers, pre_tokenizers, processors

    (fast,) = transformers("PreTrainedTokenizerFast")
    words = Tokenizer(models.WordPiece({word: number for number, word in enumerate(_WORDS)}, unk_token="[UNK]"))
    words.normalizer = normalizers.BertNormalizer()
    words.pre_tokenizer = pre_tokenizers.BertPreTokenizer()
    ends = [(word, _WORDS.index(word)) for word in ("[CLS]", "[SEP]")]
    words.post_processor = processors.TemplateProcessing(single="[CLS] $A [SEP]", special_tokens=ends)
    special = {"unk_token": "[UNK]", "pad_token": "[PAD]", "cls_token": "[CLS]", "sep_token": "[SEP]"}
    fast(tokenizer_object=words, **special).save_pretrained(folder)


def _sam2(weights: str, size: Size) -> tuple[str, int]:
    config, vision, kind = transformers("Sam2VideoConfig", "Sam2VisionConfig", "Sam2VideoModel")
    if size == "small":
        return _saved(_seen(kind(config())), weights, "SAM 2.1, Hiera tiny")
    hiera = {
        "model_type": "sam2_hiera_det_model",
        "hidden_size": 112,
        "num_attention_heads": 2,
        "blocks_per_stage": [2, 3, 16, 3],
        "embed_dim_per_stage": [112, 224, 448, 896],
        "num_attention_heads_per_stage": [2, 4, 8, 16],
        "window_positional_embedding_background_size": [14, 14],
        "global_attention_blocks": [12, 16, 20],
    }
    encoder = vision(backbone_config=hiera, backbone_channel_list=[896, 448, 224, 112])
    return _saved(_seen(kind(config(vision_config=encoder.to_dict()))), weights, "SAM 2.1, Hiera base+")


def _seen(network: Any) -> Any:
    """SAM 2 that is sure that what it follows is in sight: else its masks are empty whatever the other layers say."""
    torch.nn.init.constant_(network.mask_decoder.pred_obj_score_head.proj_out.bias, 10.0)
    return network


_Writer = Callable[[str, Size], tuple[str, int]]
_FILES: dict[str, _Writer] = {
    **{f"metric3d_{which}": _metric3d for which in ("small", "large", "giant2")},
    "geocalib_pinhole": _geocalib,
    "geocalib_distorted": _geocalib,
    "video_depth_anything": _video_depth_anything,
}
_FOLDERS: dict[str, _Writer] = {
    "grounding_dino": _grounding_dino,
    "sam2_video": _sam2,
    "depth_anything_indoor": _depth_anything,
    "depth_anything_outdoor": _depth_anything,
    "depth_pro": _depth_pro,
    "unidepth": _unidepth,
    "unik3d": _unik3d,
    "priorda": _priorda,
}
