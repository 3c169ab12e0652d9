"""Folder with a tiny SAM2 with random weights, in the format of real ones. The code is real, the masks are noise."""

from __future__ import annotations

from pathlib import Path

SIZE = 64  # of its images


def write_model(folder: Path, seed: int = 0) -> Path:
    """Save a model of 0.9 million random weights that real code loads; returns the folder."""
    import torch
    from transformers import Sam2VideoConfig, Sam2VideoModel

    torch.manual_seed(seed)
    model = Sam2VideoModel(Sam2VideoConfig(**_sizes()))
    with torch.no_grad():  # with these random weights, objects would be absent from most images
        model.mask_decoder.pred_obj_score_head.proj_out.bias.fill_(5.0)
    model.save_pretrained(folder)
    return folder


def _sizes() -> dict:
    wide = 128  # the memory's attention asks for a multiple of 64 larger than it, and for 64 channels of the memory
    return {
        "image_size": SIZE,
        "initializer_range": 0.2,  # ten times the usual value, so that the memory has an effect
        "vision_config": {
            "model_type": "sam2_vision_model",
            "backbone_config": {
                "model_type": "sam2_hiera_det_model",
                "hidden_size": 8,
                "image_size": [SIZE, SIZE],
                "blocks_per_stage": [1, 1, 2, 1],
                "embed_dim_per_stage": [8, 16, 32, 64],
                "num_attention_heads_per_stage": [1, 1, 2, 2],
                "window_size_per_stage": [4, 4, 4, 2],
                "global_attention_blocks": [3],  # none that opens a stage
                "window_positional_embedding_background_size": [4, 4],
            },
            "backbone_channel_list": [64, 32, 16, 8],
            "backbone_feature_sizes": [[SIZE // 4, SIZE // 4], [SIZE // 8, SIZE // 8], [SIZE // 16, SIZE // 16]],
            "fpn_hidden_size": wide,
        },
        "prompt_encoder_config": {"hidden_size": wide, "image_size": SIZE, "patch_size": 16, "mask_input_channels": 4},
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
        "memory_attention_rope_feat_sizes": [SIZE // 16, SIZE // 16],
        "memory_encoder_hidden_size": wide,
        "memory_encoder_output_channels": 64,
        "mask_downsampler_embed_dim": wide,
        "memory_fuser_embed_dim": wide,
        "memory_fuser_intermediate_dim": 32,
        "memory_fuser_num_layers": 1,
    }
