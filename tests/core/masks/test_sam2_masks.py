"""SAM2's real code on a tiny random model: prompted objects are tracked both ways, and new ones are added."""

import json
import sys

import numpy as np
import pytest
import torch

from r5dgs_core import errors
from r5dgs_core.cli.commands import masks as cli_masks
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import mask_notes, masks
from r5dgs_core.masks import make_masks, sam2_masks, sam2_model, sam2_segments, sam2_tracking, videos
from tests.support import sam2 as tiny_sam2
from tests.support import tiny_datasets

pytestmark = pytest.mark.heavy

# The network is random: it predicts a quality of about a half, and its masks are noise.
EVERYTHING = sam2_segments.SegmentSettings(points=3, score=0.0, stability=0.0, max_area=1.0)
FEW = sam2_masks.TrackSettings(objects=5, together=2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tiny_sam2.write_model(tmp_path_factory.mktemp("models") / "tiny_sam2")


@pytest.fixture(scope="module")
def model(folder):
    return sam2_model.Sam2(folder)


@pytest.fixture(scope="module")
def video(tiny):
    return videos.of(datasets.read(tiny.root).train)[0]


def test_both_networks_load_the_weights_of_a_folder(model, folder):
    from safetensors.torch import load_file

    stored = load_file(folder / "model.safetensors")
    for network in (model.image, model.video):
        loaded = network.state_dict()
        assert not network.training
        for name, tensor in loaded.items():
            assert name not in stored or torch.equal(tensor, stored[name]), name
    assert model.name == "tiny_sam2" and model.size == tiny_sam2.SIZE and len(model.digest) == 64


def test_images_are_preprocessed_as_in_the_training_of_sam2(model):
    image = np.zeros((36, 48, 3), np.uint8)
    image[..., 0] = 255
    pixels = model.pixels(image)
    assert pixels.shape == (1, 3, tiny_sam2.SIZE, tiny_sam2.SIZE)
    expected = (np.array([1.0, 0, 0]) - model.MEAN) / model.DEVIATION
    np.testing.assert_allclose(pixels[0].mean((1, 2)), expected, atol=1e-5)


def test_the_segments_of_an_image_are_good_distinct_and_in_order(model, video):
    found = sam2_segments.find(model, video.image(0), EVERYTHING)
    assert len(found) > 3
    assert [s.score for s in found] == sorted((s.score for s in found), reverse=True)
    overlaps = [sam2_segments.iou(a.mask, b.mask) for i, a in enumerate(found) for b in found[:i]]
    assert max(overlaps) <= sam2_segments.SAME
    middle = float(np.median([s.score for s in found]))
    strict = sam2_segments.SegmentSettings(points=3, score=middle, stability=0.0, max_area=0.6, min_area=0.2)
    fewer = sam2_segments.find(model, video.image(0), strict)
    assert 0 < len(fewer) < len(found)
    assert all(s.score >= middle and 0.2 <= s.mask.mean() <= 0.6 for s in fewer)
    assert (
        sam2_segments.find(model, video.image(0), sam2_segments.SegmentSettings(points=3, stability=1.0, score=0.0))
        == []
    )


def test_segments_that_overlap_known_ones_are_not_new():
    def segment(left, right):
        logits = torch.full((8, 8), -1.0)
        logits[:, left:right] = 1.0
        return sam2_segments.Segment(logits, 0.9)

    known = [segment(0, 4).mask]
    wide, half, other = segment(0, 5), segment(0, 2), segment(4, 8)
    assert sam2_segments.iou(wide.mask, known[0]) == 0.8 and sam2_segments.iou(half.mask, known[0]) == 0.5
    assert sam2_segments.new_ones([wide, half, other], known, 0.5) == [other]
    assert sam2_segments.new_ones([wide, half, other], known, 0.6) == [half, other]
    assert sam2_segments.new_ones([wide], [], 0.5) == [wide]


def marked_in(model, video, key, count=2):
    return torch.stack([s.logits for s in sam2_segments.find(model, video.image(key), EVERYTHING)[:count]])


def test_objects_are_tracked_to_both_ends_and_each_image_is_processed_once(model, video):
    frames = sam2_tracking.Frames(model, video)
    marked = marked_in(model, video, 2)
    found = dict(sam2_tracking.follow(model, frames, 2, marked))
    assert list(found) == [2, 3, 4, 5, 1, 0]
    side = tiny_sam2.SIZE // 4
    assert all(logits.shape == (2, side, side) and logits.isfinite().all() for logits in found.values())
    assert any((logits > 0).any() and (logits <= 0).any() for index, logits in found.items() if index != 2)
    kept = sam2_segments.full_size(found[2], (64, 64)) > 0  # where it is marked it is as it was marked
    given = sam2_segments.full_size(marked, (64, 64)) > 0
    assert sam2_segments.iou(kept.numpy(), given.numpy()) > 0.75


def test_tracking_agrees_with_the_librarys_own_loop(model, video):
    """The reference keeps the whole video in memory and tracks forwards from the first image."""
    from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession

    frames = sam2_tracking.Frames(model, video)
    marked = marked_in(model, video, 0)
    state = Sam2VideoInferenceSession(video=torch.stack([frames[k] for k in frames]), dtype=torch.float32)
    for k, logits in enumerate(marked):
        mask = sam2_segments.full_size(logits[None], (model.size, model.size)) > 0
        state.add_mask_inputs(state.obj_id_to_idx(k), 0, mask[None].float())
    state.obj_with_new_inputs = [0, 1]
    model.video(inference_session=state, frame_idx=0)
    expected = {o.frame_idx: o.pred_masks[:, 0] for o in model.video.propagate_in_video_iterator(state)}
    for index, logits in sam2_tracking.follow(model, frames, 0, marked):
        torch.testing.assert_close(logits, expected[index], rtol=1e-4, atol=1e-4)


def test_memory_does_not_grow_with_the_video(model, video, monkeypatch):
    """The tracker keeps no more memory after forty images than after twenty."""
    long = videos.Video("long", video.views * 7)
    sizes = []
    forget = sam2_tracking._forget

    def counted(outputs, index, step, *args):
        forget(outputs, index, step, *args)
        sizes.append(sum(t.numel() for out in outputs.values() for t in out.values() if isinstance(t, torch.Tensor)))

    monkeypatch.setattr(sam2_tracking, "_forget", counted)
    for _ in sam2_tracking.follow(model, sam2_tracking.Frames(model, long), 0, marked_in(model, video, 0, 1)):
        pass
    assert len(sizes) == 41
    assert sizes[20] == sizes[40] > 0


def test_a_pixel_belongs_to_the_object_with_the_highest_logit(tmp_path):
    canvas = sam2_tracking.Canvas(2, 1, 4, tmp_path)
    canvas.paint(1, [7, 300], np.array([[[1.0, 2, -1, -1]], [[1.0, 3, 5, -2]]]))
    assert canvas.ids[1].tolist() == [[7, 300, 300, 0]]  # the first of equals; nobody below 0
    canvas.paint(1, [9], np.array([[[0.5, 4, 5, 0.1]]]))
    assert canvas.ids[1].tolist() == [[7, 9, 300, 9]]
    assert not canvas.ids[0].any()
    canvas.close()
    assert list(tmp_path.iterdir()) == []


def test_gaps_of_a_lost_object_are_unknown(tmp_path):
    def painted(rows, gap):
        canvas = sam2_tracking.Canvas(len(rows), 1, 4, tmp_path)
        for index, row in enumerate(rows):
            for object_id in sorted(set(row) - {0}):
                canvas.paint(index, [object_id], np.where(np.array(row) == object_id, 1.0, -1.0)[None, None])
        canvas.mark_gaps(gap)
        found = canvas.ids[:, 0].tolist()
        canvas.close()
        return found

    u = masks.UNKNOWN
    lost = [[0, 0, 0, 0], [1, 0, 0, 0], [0, 0, 2, 0], [0, 0, 0, 0], [0, 1, 1, 0], [0, 0, 0, 0]]
    known = [[0, 0, 0, 0], [1, 0, 0, 0], [u, u, 2, 0], [u, u, u, 0], [0, 1, 1, 0], [0, 0, 0, 0]]
    assert painted(lost, 2) == known  # neither before it came nor after it went; what others hold stays theirs
    assert painted(lost, 1) == lost


def test_key_frames_are_spread_over_a_video():
    assert sam2_masks.key_frames(9, 1) == [4]
    assert sam2_masks.key_frames(9, 3) == [0, 4, 8]
    assert sam2_masks.key_frames(2, 5) == [0, 1]
    assert sam2_masks.key_frames(1, 3) == [0]


def test_the_masks_of_a_video_follow_the_prompted_objects(model, video, tmp_path):
    """Each image holds what the objects' own tracks hold there, and key frames later on add objects."""
    backend = sam2_masks.Sam2Masks(model, EVERYTHING, sam2_masks.TrackSettings(key_frames=2, objects=40, together=3))
    shares = []
    images = list(backend.label(video, tmp_path, shares.append))
    assert len(images) == 6 and all(ids.shape == (36, 48) and ids.dtype == np.int32 for ids in images)
    assert shares == sorted(shares) and shares[-1] == 1.0
    first = sam2_segments.find(model, video.image(0), EVERYTHING)
    assert set(np.unique(images[0])) - {0} <= set(range(1, 41))
    followed = {}
    for start in range(0, len(first), 3):
        some = torch.stack([s.logits for s in first[start : start + 3]])
        for index, logits in sam2_tracking.follow(model, sam2_tracking.Frames(model, video), 0, some):
            followed.setdefault(index, []).append(logits)
    there = [logits.gt(0).numpy() for part in followed[5] for logits in part]
    later = sam2_segments.new_ones(sam2_segments.find(model, video.image(5), EVERYTHING), there, FEW.overlap)
    assert len(later) > 0
    added = {int(i) for ids in images for i in np.unique(ids)} - set(range(len(first) + 1)) - {masks.UNKNOWN}
    assert added and added <= set(range(len(first) + 1, len(first) + 1 + len(later)))
    at_end = np.concatenate([sam2_segments.full_size(part, (36, 48)).numpy() for part in followed[5]])
    old = images[5] <= len(first)  # no gap ends after the last image, so nothing is unknown there
    expected = np.where(at_end.max(0) > 0, at_end.argmax(0) + 1, 0)
    assert (images[5] == expected)[old & (images[5] > 0)].mean() > 0.99  # half floats make ties of near equals


def test_perfect_networks_give_the_true_masks_of_all_objects(model, tmp_path, monkeypatch):
    """With the answers of the networks replaced by true masks, every image gets these, under numbers of its video."""
    late = tiny_datasets.make_dataset(tmp_path / "late", ball_from=0.4)
    views = datasets.read(late.root).train
    truth = {view.name: datasets.load_mask(view) for view in views}
    by_image = {videos.Video("", (view,)).image(0).tobytes(): truth[view.name] for view in views}
    now = []

    def logits(ids, wanted):
        return torch.from_numpy(np.where(ids == wanted, 9.0, -9.0).astype(np.float32))

    def find(model, image, settings):
        ids = by_image[image.tobytes()]
        return [sam2_segments.Segment(logits(ids, k), 0.9) for k in np.unique(ids[ids > 0]).tolist()]

    def follow(model, frames, key, marked):
        names = [view.name for view in frames._video.views]
        true = truth[names[key]]
        wanted = [int(np.bincount(true[mask > 0]).argmax()) for mask in marked.numpy()]
        now.append((key, wanted))
        for index in [*range(key, len(names)), *reversed(range(key))]:
            yield index, torch.stack([logits(truth[names[index]], k) for k in wanted])

    monkeypatch.setattr(sam2_segments, "find", find)
    monkeypatch.setattr(sam2_tracking, "follow", follow)
    make_masks.make(views, sam2_masks.Sam2Masks(model), tmp_path / "m")
    assert {key for key, wanted in now if tiny_datasets.BALL in wanted} == {5}  # of 0, 2 and 5; it comes at 3
    for name, video in mask_notes.read(tmp_path / "m").videos.items():
        pairs = set()
        for image in video.images:
            ids = masks.read(tmp_path / "m" / f"{image}.png")
            pairs |= set(zip(ids.ravel().tolist(), truth[image].ravel().tolist(), strict=True))
        assert {a for a, _ in pairs} == {0, *video.ids} and len(pairs) == len(video.ids) + 1, name
    assert any(len(video.ids) == 2 for video in mask_notes.read(tmp_path / "m").videos.values())


def test_a_video_of_one_image_gets_its_segments(model, video, tmp_path):
    alone = videos.Video("alone", video.views[:1])
    (ids,) = sam2_masks.Sam2Masks(model, EVERYTHING, FEW).label(alone, tmp_path, lambda share: None)
    assert 1 < len(np.unique(ids)) <= 6


@pytest.mark.slow
def test_the_command_resumes_and_prints_the_next_step(tiny, folder, tmp_path, capsys, monkeypatch):
    options = {"backend": "sam2", "model": folder, "out": tmp_path / "m", "points": 2, "key_frames": 1}
    options |= {"score": 0.0, "stability": 0.0, "max_area": 1.0}
    label = sam2_masks.Sam2Masks.label
    seen = []

    def stopped(self, video, room, report):
        if len(seen) == 2:
            raise KeyboardInterrupt
        seen.append(video.name)
        return label(self, video, room, report)

    monkeypatch.setattr(sam2_masks.Sam2Masks, "label", stopped)
    with pytest.raises(errors.Interrupted, match="finished videos are kept"):
        cli_masks.run_masks(tiny.root, **options)
    first = {path: path.stat().st_mtime_ns for path in (tmp_path / "m").rglob("*.png")}
    assert len(first) == 12
    monkeypatch.setattr(sam2_masks.Sam2Masks, "label", label)
    made = cli_masks.run_masks(tiny.root, **options)
    assert (made.kept, made.images, made.numbering) == (2, 36, "video") and made.objects > 6
    assert {path: path.stat().st_mtime_ns for path in first} == first
    told = capsys.readouterr().out
    assert "2 of 6 videos were done before" in told and "--masks none" in told and "r5dgs associate RUN" in told
    dataset = datasets.read(tiny.root, str(tmp_path / "m"))
    assert all(datasets.load_mask(view).max() > 0 for view in dataset.train)
    with pytest.raises(errors.DatasetError, match="are valid per video only"):
        dataset.require_one_numbering()
    with pytest.raises(errors.DatasetError, match=r"other settings \(points\)"):
        cli_masks.run_masks(tiny.root, **options | {"points": 3})


def test_the_same_model_and_images_give_the_same_masks(model, video, tmp_path):
    views = video.views
    for name in ("a", "b"):
        make_masks.make(views, sam2_masks.Sam2Masks(model, EVERYTHING, FEW), tmp_path / name)
    for view in views:
        one, other = (masks.read(tmp_path / name / f"{view.name}.png") for name in ("a", "b"))
        np.testing.assert_array_equal(one, other)
    assert mask_notes.read(tmp_path / "a") == mask_notes.read(tmp_path / "b")


def broken(folder, tmp_path, change):
    """A copy of the model's folder with something wrong."""
    copy = tmp_path / "broken"
    copy.mkdir()
    for path in folder.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    change(copy)
    return copy


def cut_weights(folder):
    path = folder / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-1000])


def drop_weight(folder):
    from safetensors.torch import load_file, save_file

    weights = load_file(folder / "model.safetensors")
    weights.pop("memory_attention.layer_norm.weight")
    save_file(weights, folder / "model.safetensors", metadata={"format": "pt"})


def set_kind(kind):
    def change(folder):
        config = json.loads((folder / "config.json").read_text()) | {"model_type": kind}
        (folder / "config.json").write_text(json.dumps(config))

    return change


def widen(folder):
    config = json.loads((folder / "config.json").read_text())
    config["mask_decoder_config"]["iou_head_hidden_dim"] = 48
    (folder / "config.json").write_text(json.dumps(config))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (cut_weights, r"broken/model\.safetensors: expected safetensors, found a damaged or cut file"),
        (drop_weight, r"broken: 1 of the model's weights are missing \(memory_attention\.layer_norm\.weight"),
        (widen, "broken: the model cannot be loaded"),
        (set_kind("clip"), r"config\.json: expected a model of type 'sam2_video', found 'clip'"),
        (set_kind("sam2"), "found 'sam2'; a folder of the image model alone cannot follow objects"),
        (lambda folder: (folder / "config.json").write_text("{"), r"config\.json: damaged, not valid JSON"),
        (lambda folder: (folder / "config.json").unlink(), r"config\.json: expected in the folder of SAM2, found"),
        (lambda folder: (folder / "model.safetensors").unlink(), r"model\.safetensors: expected the weights, found"),
    ],
)
def test_folders_without_a_complete_sam2_are_one_clear_error(folder, tmp_path, change, message):
    with pytest.raises(errors.BackendError, match=message):
        sam2_model.Sam2(broken(folder, tmp_path, change))


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(errors.BackendError, match="expected a folder of SAM2.*found nothing"):
        sam2_model.Sam2(tmp_path / "gone")


@pytest.mark.parametrize("package", ["transformers", "safetensors"])
def test_without_transformers_the_error_names_the_package_to_install(folder, package, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(errors.BackendError, match=r"pip install 'r5dgs\[encoders\]'"):
        sam2_model.Sam2(folder)


@pytest.mark.parametrize("device", ["tpu", "meta", "cuda:99" if not torch.cuda.is_available() else "mps"])
def test_missing_devices_are_named(folder, device):
    with pytest.raises(errors.BackendError, match=f"--device {device}: "):
        sam2_model.Sam2(folder, device)
