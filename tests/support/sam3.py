"""Folder with a tiny SAM3 with random weights, in the format of real ones. The code is real, the masks are noise."""

from __future__ import annotations

from pathlib import Path

SIZE = 56  # of its images
WORDS = ("mug", "red", "apple", "ball", "brick")


def write_model(folder: Path, seed: int = 0, threshold: float = 0.0) -> Path:
    """Save a model of random weights that real code loads; returns the folder.

    Args:
        folder: Where to.
        seed: Of the weights.
        threshold: Score above which a detection is an object.
    """
    import torch
    from transformers import Sam3VideoConfig, Sam3VideoModel

    torch.manual_seed(seed)
    model = Sam3VideoModel(Sam3VideoConfig(**_sizes(threshold)))
    model.save_pretrained(folder)
    _write_tokenizer(folder)
    return folder


def _write_tokenizer(folder: Path) -> None:
    """Write a tokenizer that knows `WORDS`."""
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    words = {word: k for k, word in enumerate(("<pad>", "<end>", "<unknown>", *WORDS))}
    tokenizer = Tokenizer(models.WordLevel(words, unk_token="<unknown>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    fast = PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="<pad>", eos_token="<end>", unk_token="<unknown>"
    )
    fast.save_pretrained(folder)


def _sizes(threshold: float) -> dict:
    wide = 128  # the memory's attention asks for a multiple of 64 larger than it
    patch, grid = 14, SIZE // 14
    vision = {
        "backbone_config": {
            "model_type": "sam3_vit_model",
            "hidden_size": 32,
            "intermediate_size": 32,
            "num_hidden_layers": 2,
            "num_attention_heads": 2,
            "image_size": SIZE,
            "pretrain_image_size": SIZE,
            "patch_size": patch,
            "window_size": 2,
            "global_attn_indexes": [1],
        },
        "fpn_hidden_size": wide,
        "backbone_feature_sizes": [[4 * grid, 4 * grid], [2 * grid, 2 * grid], [grid, grid]],
    }
    small = {"hidden_size": wide, "num_attention_heads": 2}
    return {
        "initializer_range": 0.2,
        "low_res_mask_size": 4 * grid,
        "score_threshold_detection": threshold,
        "new_det_thresh": threshold,
        "hotstart_delay": 0,
        "max_num_objects": 3,
        "recondition_every_nth_frame": 0,
        "detector_config": {
            "model_type": "sam3",
            "vision_config": vision,
            "text_config": {
                "vocab_size": 3 + len(WORDS),
                "hidden_size": 32,
                "intermediate_size": 32,
                "projection_dim": 32,
                "num_hidden_layers": 1,
                "num_attention_heads": 2,
                "max_position_embeddings": 32,
                "eos_token_id": 1,
                "bos_token_id": 1,
                "pad_token_id": 0,
            },
            "geometry_encoder_config": {**small, "num_layers": 1, "intermediate_size": 32},
            "detr_encoder_config": {**small, "num_layers": 1, "intermediate_size": 32},
            "detr_decoder_config": {**small, "num_layers": 1, "intermediate_size": 32, "num_queries": 4},
            "mask_decoder_config": {**small},
            "initializer_range": 0.2,
        },
        "tracker_config": {
            "model_type": "sam3_tracker_video",
            "image_size": SIZE,
            "vision_config": {**vision, "model_type": "sam3_vision_model"},
            "prompt_encoder_config": {"hidden_size": wide, "image_size": SIZE, "patch_size": patch},
            "mask_decoder_config": {
                "hidden_size": wide,
                "mlp_dim": 32,
                "num_hidden_layers": 1,
                "num_attention_heads": 2,
                "iou_head_hidden_dim": 32,
            },
            "memory_attention_hidden_size": wide,
            "memory_attention_num_layers": 1,
            "memory_attention_feed_forward_hidden_size": 32,
            "memory_attention_rope_feat_sizes": [grid, grid],
            "memory_encoder_hidden_size": wide,
            "memory_encoder_output_channels": 64,
            "mask_downsampler_embed_dim": wide,
            "memory_fuser_embed_dim": wide,
            "memory_fuser_intermediate_dim": 32,
            "memory_fuser_num_layers": 1,
            "initializer_range": 0.2,
        },
    }
