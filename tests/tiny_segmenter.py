"""A tiny SAM 2 with random weights: the real network, code and files, of 0.9 million weights."""

from __future__ import annotations

from pathlib import Path

SIDE = 64
"""Of the pictures that the network sees [pixels]; 1024 in the published models."""


def write_weights(folder: Path, seed: int = 0) -> Path:
    """Save a network as ``save_pretrained`` does. Its logits are of the order of one, and it always sees the object."""
    import torch
    from transformers import Sam2HieraDetConfig, Sam2VideoConfig, Sam2VideoModel, Sam2VisionConfig
    from transformers.models.sam2_video.configuration_sam2_video import (
        Sam2VideoMaskDecoderConfig,
        Sam2VideoPromptEncoderConfig,
    )
    from transformers.utils import logging

    width, levels = 128, [8, 16, 32, 64]
    backbone = Sam2HieraDetConfig(
        hidden_size=levels[0],
        image_size=[SIDE, SIDE],
        embed_dim_per_stage=levels,
        num_attention_heads_per_stage=[1, 1, 2, 2],
        blocks_per_stage=[1, 1, 2, 1],
        global_attention_blocks=[3],
        window_size_per_stage=[4, 4, 4, 4],
        window_positional_embedding_background_size=[4, 4],
    )
    vision = Sam2VisionConfig(
        backbone_config=backbone,
        backbone_channel_list=levels[::-1],
        fpn_hidden_size=width,
        backbone_feature_sizes=[[SIDE // 4] * 2, [SIDE // 8] * 2, [SIDE // 16] * 2],
    )
    config = Sam2VideoConfig(
        vision_config=vision,
        prompt_encoder_config=Sam2VideoPromptEncoderConfig(hidden_size=width, image_size=SIDE, mask_input_channels=4),
        mask_decoder_config=Sam2VideoMaskDecoderConfig(
            hidden_size=width, mlp_dim=32, num_attention_heads=2, iou_head_hidden_dim=16
        ),
        image_size=SIDE,
        memory_attention_hidden_size=width,
        memory_attention_num_layers=1,
        memory_attention_feed_forward_hidden_size=32,
        memory_attention_rope_feat_sizes=[SIDE // 16] * 2,
        memory_encoder_hidden_size=width,
        memory_encoder_output_channels=64,
        mask_downsampler_embed_dim=width,
        memory_fuser_embed_dim=width,
        memory_fuser_intermediate_dim=32,
        memory_fuser_num_layers=1,
        initializer_range=0.2,
    )
    logging.disable_progress_bar()
    torch.manual_seed(seed)
    model = Sam2VideoModel(config)
    with torch.no_grad():
        model.mask_decoder.pred_obj_score_head.proj_out.bias.fill_(100.0)
    model.save_pretrained(folder)
    return folder
