"""LPIPS against the package lpips, with seeded random weights."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from r5dgs_core import errors
from r5dgs_core.evaluation import evaluate, lpips
from tests.support import lpips_weights, pictures

EXPECTED = Path(__file__).resolve().parents[3] / "benchmarks" / "results" / "lpips.json"
ALEX = lpips_weights.tensors("alex")


def package_names(tensors):
    """The tensors with the names of the package lpips."""
    slices = {0: 1, 3: 2, 6: 3, 8: 4, 10: 5}
    found = {}
    for name, value in tensors.items():
        part, number, *rest = name.split(".")
        if part == "features":
            found[f"net.slice{slices[int(number)]}.{number}.{rest[0]}"] = value
        else:
            found[f"{part}.model.1.weight"] = found[f"lins.{part[3]}.model.1.weight"] = value
    return found


def written(folder, tensors, name="weights.pth"):
    torch.save(tensors, folder / name)
    return folder / name


@pytest.mark.parametrize("name", ["alex", "vgg"])
def test_distances_are_those_of_the_package(name):
    network = lpips.Lpips(lpips.NETWORKS[name], lpips_weights.tensors(name))
    expected = {row["pair"]: row["lpips"] for row in json.loads(EXPECTED.read_text()) if row["network"] == name}
    pairs = lpips_weights.pairs()
    assert expected.keys() == pairs.keys()
    for key, (image, truth) in pairs.items():
        assert network.distance(image, truth) == pytest.approx(expected[key], abs=1e-5)
        assert network.distance(truth, truth) == 0


def test_weights_are_read_from_one_or_several_files_in_either_form(tmp_path):
    from safetensors.torch import save_file

    image, truth = lpips_weights.pairs()["odd, noise"]
    expected = lpips.Lpips(lpips.NETWORKS["alex"], ALEX).distance(image, truth)
    named = package_names(ALEX)
    heads = {name: value for name, value in named.items() if name.startswith("lin")}
    features = {name: value for name, value in ALEX.items() if name.startswith("features")}
    save_file(features, tmp_path / "features.safetensors")
    several = [tmp_path / "features.safetensors", written(tmp_path, heads, "heads.pth")]
    for paths in ([written(tmp_path, named)], several):
        found = lpips.load(paths)
        assert found.name == "alex" and found.distance(image, truth) == expected


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"lin2.weight": None}, "expected 'lin2.weight' of shape (1, 384, 1, 1), found nothing"),
        ({"features.3.bias": torch.zeros(7)}, "found shape (7,)"),
        ({"features.0.weight": torch.zeros(8, 3, 3, 3)}, "'features.0.weight' of shape (8, 3, 3, 3)"),
        ({"features.0.weight": None}, "no 'features.0.weight'"),
        ({"lin0.weight": torch.full((1, 64, 1, 1), float("nan"))}, "NaN"),
        ({"lin0.weight": 3}, "expected tensors by name"),
    ],
)
def test_missing_and_wrong_weights_are_named(tmp_path, changes, said):
    tensors = {name: value for name, value in {**ALEX, **changes}.items() if value is not None}
    path = written(tmp_path, tensors)
    with pytest.raises(errors.BackendError) as failed:
        lpips.load([path])
    assert said in str(failed.value) and str(path) in str(failed.value)


@pytest.mark.parametrize("name", ["a.pth", "a.safetensors"])
def test_damaged_files_are_named(tmp_path, name):
    (tmp_path / name).write_bytes(b"nothing")
    with pytest.raises(errors.BackendError, match=rf"{name}: cannot be read"):
        lpips.load([tmp_path / name])


def test_pictures_of_different_sizes_are_refused():
    network = lpips.Lpips(lpips.NETWORKS["alex"], ALEX)
    with pytest.raises(ValueError, match="of one size"):
        network.distance(np.zeros((40, 40, 3)), np.zeros((40, 41, 3)))


def test_an_evaluation_has_the_mean_over_its_images(scene, data):
    network = lpips.Lpips(lpips.NETWORKS["alex"], ALEX)
    found = evaluate.evaluate(scene, data, backend=pictures.BACKEND, splits=("val",), perceptual=network)
    assert found["splits"]["val"]["rigid"]["lpips"] == pytest.approx(0, abs=1e-3)  # its own pictures
    assert found["lpips_network"] == "alex"
