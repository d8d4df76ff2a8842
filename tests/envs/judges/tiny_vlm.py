"""A vision-language model of a few thousand random weights on disk, as `transformers` saves one.

It says yes or no in one token, because all others are suppressed.
"""

from __future__ import annotations

from pathlib import Path

import torch

_WORDS = ["<pad>", "<s>", "</s>", "<unk>", *(chr(code) for code in range(32, 127))]
_ADDED = ["<image>", "Answer: Yes", "Answer: No"]
_TEMPLATE = (
    "{% for message in messages %}{% for part in message['content'] %}{% if part['type'] == 'image' %}<image>"
    "{% else %}{{ part['text'] }}{% endif %}{% endfor %}{% endfor %}>"
)


def save_tiny_vlm(folder: Path, seed: int = 9) -> Path:
    """Write the model, its processor and its chat template."""
    from tokenizers import Tokenizer, models
    from transformers import (
        CLIPImageProcessor,
        CLIPVisionConfig,
        LlamaConfig,
        LlavaConfig,
        LlavaForConditionalGeneration,
        LlavaProcessor,
        PreTrainedTokenizerFast,
    )

    vocabulary = {word: number for number, word in enumerate(_WORDS)}
    names = {"pad_token": "<pad>", "bos_token": "<s>", "eos_token": "</s>", "unk_token": "<unk>"}
    bare = Tokenizer(models.BPE(vocab=vocabulary, merges=[], unk_token="<unk>"))
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=bare, **names)
    tokenizer.add_tokens(_ADDED)
    image, yes, no = tokenizer.convert_tokens_to_ids(_ADDED)
    small = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    torch.manual_seed(seed)
    model = LlavaForConditionalGeneration(
        LlavaConfig(
            vision_config=CLIPVisionConfig(**small, image_size=28, patch_size=14, projection_dim=16),
            text_config=LlamaConfig(**small, vocab_size=len(tokenizer), max_position_embeddings=4096),
            image_token_index=image,
            vision_feature_layer=-1,
        )
    )
    with torch.no_grad():
        # An eye for contrast alone, or noise would look the same as other noise.
        eye = model.model.vision_tower.embeddings
        eye.patch_embedding.weight.sub_(eye.patch_embedding.weight.mean((1, 2, 3), keepdim=True))
        eye.position_embedding.weight.zero_()
        for name, weight in model.model.named_parameters():
            if "norm" not in name:
                weight.mul_(10.0)
        head = model.lm_head.weight
        head[yes] = 0.15 * torch.randn(head.shape[1])
        head[no] = -head[yes]
    model.generation_config.suppress_tokens = [k for k in range(len(tokenizer)) if k not in (yes, no)]
    processor = LlavaProcessor(
        image_processor=CLIPImageProcessor(size={"height": 28, "width": 28}, do_center_crop=False),
        tokenizer=tokenizer,
        patch_size=14,
        vision_feature_select_strategy="default",
        num_additional_image_tokens=1,
        image_token="<image>",
        chat_template=_TEMPLATE,
    )
    model.save_pretrained(folder)
    processor.save_pretrained(folder)
    return folder
