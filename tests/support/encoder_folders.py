"""Folders of tiny encoders with random weights, as transformers saves them: the real code reads them, and what they
say means nothing."""

from __future__ import annotations

import json
from pathlib import Path

IMAGE = 30  # pixels of what they look at
_MEAN = [0.48145466, 0.4578275, 0.40821073]
_STD = [0.26862954, 0.26130258, 0.27577711]


def clip(folder: Path, seed: int = 0) -> Path:
    """A CLIP with a tokenizer of single bytes."""
    import torch
    from transformers import CLIPConfig, CLIPModel

    torch.manual_seed(seed)
    text = {"vocab_size": 514, "hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2}
    text |= {"num_attention_heads": 4, "max_position_embeddings": 24, "eos_token_id": 513, "bos_token_id": 512}
    vision = {"hidden_size": 24, "intermediate_size": 32, "num_hidden_layers": 2, "num_attention_heads": 4}
    vision |= {"image_size": IMAGE, "patch_size": 10}
    CLIPModel(CLIPConfig(text_config=text, vision_config=vision, projection_dim=20)).save_pretrained(folder)
    symbols = [chr(c) for c in _byte_symbols()]
    vocabulary = [*symbols, *(symbol + "</w>" for symbol in symbols), "<|startoftext|>", "<|endoftext|>"]
    _write(folder / "vocab.json", {token: number for number, token in enumerate(vocabulary)})
    (folder / "merges.txt").write_text("#version: 0.2\n")
    names = {"bos_token": "<|startoftext|>", "eos_token": "<|endoftext|>", "pad_token": "<|endoftext|>"}
    _write(
        folder / "tokenizer_config.json", {"tokenizer_class": "CLIPTokenizer", "unk_token": "<|endoftext|>", **names}
    )
    size = {"size": {"shortest_edge": IMAGE}, "crop_size": {"height": IMAGE, "width": IMAGE}}
    _write(folder / "preprocessor_config.json", {**_pixels("CLIPImageProcessor"), **size, "do_center_crop": True})
    return folder


def siglip(folder: Path, seed: int = 0) -> Path:
    """A SigLIP with a tokenizer of single characters."""
    import torch
    from transformers import SiglipConfig, SiglipModel

    torch.manual_seed(seed)
    text = {"vocab_size": 32, "hidden_size": 24, "intermediate_size": 32, "num_hidden_layers": 2}
    text |= {"num_attention_heads": 4, "max_position_embeddings": 16, "projection_size": 24}
    vision = {"hidden_size": 24, "intermediate_size": 32, "num_hidden_layers": 2, "num_attention_heads": 4}
    vision |= {"image_size": IMAGE, "patch_size": 10}
    SiglipModel(SiglipConfig(text_config=text, vision_config=vision)).save_pretrained(folder)
    _characters(folder, special={"pad_token": "[PAD]", "unk_token": "[UNK]"})
    size = {"size": {"height": IMAGE, "width": IMAGE}}
    _write(folder / "preprocessor_config.json", {**_pixels("SiglipImageProcessor"), **size})
    return folder


def sentences(folder: Path, seed: int = 0, pooling: str | None = None) -> Path:
    """A BERT with a tokenizer of single characters; ``pooling`` is what its folder says, such as "cls_token"."""
    import torch
    from transformers import BertConfig, BertModel

    torch.manual_seed(seed)
    sizes = {"vocab_size": 32, "hidden_size": 24, "intermediate_size": 32, "num_hidden_layers": 2}
    BertModel(BertConfig(**sizes, num_attention_heads=4, max_position_embeddings=64)).save_pretrained(folder)
    _characters(folder, special={"pad_token": "[PAD]", "unk_token": "[UNK]"})
    if pooling is not None:
        (folder / "1_Pooling").mkdir()
        _write(folder / "1_Pooling" / "config.json", {"word_embedding_dimension": 24, f"pooling_mode_{pooling}": True})
    return folder


def _characters(folder: Path, special: dict[str, str]) -> None:
    from tokenizers import Regex, Tokenizer, models, normalizers, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    vocabulary = {token: number for number, token in enumerate(["[PAD]", "[UNK]", *"abcdefghijklmnopqrstuvwxyz"])}
    tokenizer = Tokenizer(models.WordLevel(vocabulary, unk_token="[UNK]"))
    tokenizer.normalizer = normalizers.Lowercase()
    tokenizer.pre_tokenizer = pre_tokenizers.Split(Regex("."), "isolated")
    PreTrainedTokenizerFast(tokenizer_object=tokenizer, **special).save_pretrained(folder)


def _pixels(processor: str) -> dict[str, object]:
    """Settings that all image processors share."""
    steps = {"do_resize": True, "do_rescale": True, "do_normalize": True, "rescale_factor": 1 / 255, "resample": 3}
    return {"image_processor_type": processor, "image_mean": _MEAN, "image_std": _STD, **steps}


def _byte_symbols() -> list[int]:
    """The characters that byte-level tokenizers write for bytes, in their order."""
    printable = [*range(33, 127), *range(161, 173), *range(174, 256)]
    return printable + [256 + k for k in range(256 - len(printable))]


def _write(path: Path, tree: dict[str, object]) -> None:
    path.write_text(json.dumps(tree))
