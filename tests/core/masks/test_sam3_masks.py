"""SAM3's real code on a tiny random model: phrases name objects, whose ids are the same in all videos."""

import json
import sys

import numpy as np
import pytest
import torch

from r5dgs_core import errors
from r5dgs_core.cli.commands import masks as cli_masks
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import mask_notes, masks
from r5dgs_core.masks import make_masks, sam3_masks, sam3_model, videos
from tests.support import sam2 as tiny_sam2
from tests.support import sam3 as tiny_sam3

pytestmark = pytest.mark.heavy


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tiny_sam3.write_model(tmp_path_factory.mktemp("models") / "tiny_sam3")


@pytest.fixture(scope="module")
def model(folder):
    return sam3_model.Sam3(folder)


@pytest.fixture(scope="module")
def video(tiny):
    return videos.of(datasets.read(tiny.root).train)[0]


def test_the_weights_of_the_folder_are_used(folder, model, tmp_path):
    from safetensors.torch import load_file

    stored, loaded = load_file(folder / "model.safetensors"), model.video.state_dict()
    shared = stored.keys() & loaded.keys()  # the library renames some
    assert len(shared) > 200 and all(torch.equal(loaded[name], stored[name]) for name in shared)
    assert model.size == tiny_sam3.SIZE and model.name == "tiny_sam3" and len(model.digest) == 64
    (tmp_path / "config.json").write_bytes((folder / "config.json").read_bytes())
    with pytest.raises(errors.BackendError, match="weights|safetensors"):
        sam3_model.Sam3(tmp_path)


def test_torchvision_is_not_needed(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "torchvision", None)
    assert sam3_model.Sam3(folder).size == tiny_sam3.SIZE


def test_nothing_is_downloaded_even_if_the_package_for_kernels_is_installed(model):
    from transformers.models.sam3_video import modeling_sam3_video

    assert modeling_sam3_video.cv_utils_kernel is False


def test_phrases_have_their_ids_and_names_in_all_videos(model, tiny, tmp_path):
    views = datasets.read(tiny.root).train
    backend = sam3_masks.Sam3Masks(model, ["mug", "red apple"])
    made = make_masks.make(views, backend, tmp_path / "masks")
    assert made.numbering == mask_notes.SCENE and made.images == len(views)
    named = json.loads((tmp_path / "masks" / "objects.json").read_text())
    assert set(named) <= {"1", "2"} and set(named.values()) <= {"mug", "red apple"} and named
    found = datasets.read(tiny.root, str(tmp_path / "masks"))
    found.require_one_numbering()
    assert found.object_names == {int(key): name for key, name in named.items()}
    present = {value for view in found.train for value in np.unique(datasets.load_mask(view)).tolist()}
    assert present <= {0, 1, 2, masks.UNKNOWN}


def test_masks_are_those_of_the_library(model, video, tmp_path):
    """With one phrase, the most certain track is drawn where its logits are above zero."""
    backend = sam3_masks.Sam3Masks(model, ["ball"])
    drawn = list(backend.label(video, tmp_path, lambda share: None))
    weights = {}
    followed = list(sam3_masks._follow(model, video, ["ball"]))
    camera = video.views[0].camera
    for _, words, logits, scores in followed:
        for track in words:
            full = torch.nn.functional.interpolate(
                logits[track][None, None], (camera.height, camera.width), mode="bilinear"
            )
            weights[track] = weights.get(track, 0.0) + scores[track] * bool((full > 0).any())
    assert len(drawn) == len(video.views) == len(followed) and len(weights) > 1
    best = max(weights, key=weights.__getitem__)
    size = (camera.height, camera.width)
    compared = 0
    for ids, (_, _, logits, _) in zip(drawn, followed, strict=True):
        tracks = list(logits)
        full = torch.nn.functional.interpolate(torch.stack([*logits.values()])[:, None], size, mode="bilinear")[:, 0]
        first, second = torch.cat([full, torch.zeros(1, *size)]).topk(2, dim=0).values
        clear = (first - second > 0.02 * first.abs() + 1e-3).numpy()  # the canvas has half precision
        wanted = np.array([1 if track == best else masks.UNKNOWN for track in tracks])[full.argmax(0).numpy()]
        wanted[(full.max(0).values <= 0).numpy()] = 0
        np.testing.assert_array_equal(ids[clear], wanted[clear])
        compared += int(clear.sum())
    assert compared > 100


def test_several_things_of_one_phrase_are_named_in_a_warning(model, video, tmp_path, caplog):
    list(sam3_masks.Sam3Masks(model, ["ball"]).label(video, tmp_path, lambda share: None))
    assert "things fit 'ball'" in caplog.text


def test_without_a_detection_everything_is_background(video, tmp_path):
    strict = sam3_model.Sam3(tiny_sam3.write_model(tmp_path / "strict", threshold=0.99999))
    backend = sam3_masks.Sam3Masks(strict, ["mug"])
    assert all((ids == 0).all() for ids in backend.label(video, tmp_path, lambda share: None))


def test_the_command_writes_named_masks(copied, folder, capsys):
    made = cli_masks.run_masks(copied, backend="sam3", model=folder, words="mug,  red   apple", overwrite=True)
    assert made.images and "training images" in capsys.readouterr().out
    notes = mask_notes.read(copied / "object_mask")
    assert notes.backend == "sam3" and notes.made_with["words"] == ["mug", "red apple"]
    again = cli_masks.run_masks(copied, backend="sam3", model=folder, words="mug, red apple")
    assert again.kept == again.videos


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"words": "mug"}, "--backend sam3: name the folder of the model"),
        ({"model": "x"}, "name the objects with --words"),
        ({"model": "x", "words": " , "}, "name the objects with --words"),
        ({"model": "x", "words": "mug, mug"}, "'mug' occurs twice"),
        ({"model": "x", "words": "mug", "points": 3}, "--points: does not apply to --backend sam3"),
    ],
)
def test_wrong_options_are_refused(tiny, fields, message):
    with pytest.raises(errors.UsageError, match=message):
        cli_masks.run_masks(tiny.root, backend="sam3", **fields)


def test_folders_of_other_models_or_without_a_tokenizer_are_refused(folder, tmp_path):
    with pytest.raises(errors.BackendError, match="expected a folder of SAM3.*found nothing"):
        sam3_model.Sam3(tmp_path / "nowhere")
    with pytest.raises(errors.BackendError, match="found 'sam2_video'; use it with --backend sam2"):
        sam3_model.Sam3(tiny_sam2.write_model(tmp_path / "sam2"))
    tiny_sam3.write_model(tmp_path / "mute")
    for name in ("tokenizer.json", "tokenizer_config.json"):
        (tmp_path / "mute" / name).unlink()
    with pytest.raises(errors.BackendError, match="tokenizer"):
        sam3_model.Sam3(tmp_path / "mute")


def test_the_missing_package_is_named(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(errors.BackendError, match=r"SAM3.*pip install 'r5dgs\[encoders\]'"):
        sam3_model.Sam3(folder)
