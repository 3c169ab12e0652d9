import dataclasses
import json
import os
import re

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.cli import main
from r5dgs_core.cli.commands import lookup
from r5dgs_core.cli.exit_status import ExitStatus
from r5dgs_core.language import best_views, build_table, calibration, common_nouns, query
from r5dgs_core.language.encoders import encoder_base, registry
from r5dgs_core.scene import cameras, scene_file, stored_embeddings
from r5dgs_core.scene.lookup_table import EncoderCard
from r5dgs_core.search import embedding_search, object_search
from tests.support import encoder_folders
from tests.support.scenes import make_scene

pytestmark = pytest.mark.heavy

WORDS = common_nouns.words()
PER_GAUSSIAN = (
    *("means", "quats", "log_scales", "opacity_logits", "sh", "object_ids", "motion_ids"),
    *("identities", "shading"),
)


class Plain:
    """Encoder with known embeddings: a word has a vector of its own plus a part of those of its broader terms."""

    def __init__(self, kind="text", digest="ab" * 32, seed=0):
        rng = np.random.default_rng(seed)
        self._axes = {word: encoder_base.unit(rng.normal(size=64)) for word in WORDS}
        self._rng = rng
        self.card = EncoderCard(kind, "plain", digest, 64, ("{}",))
        self.seen = []

    def embed_texts(self, texts):
        return np.stack([self._embed(text) for text in texts])

    def embed_images(self, images):
        self.seen += list(images)
        colors = [np.concatenate([image.mean((0, 1)), np.zeros(61)]) for image in images]
        return encoder_base.unit(np.stack(colors))

    def _embed(self, text):
        noun = common_nouns.known(text)
        if noun is None:
            return self._axes.setdefault(text, encoder_base.unit(np.random.default_rng(len(text)).normal(size=64)))
        kinds = [self._axes[kind] for kind in sorted(common_nouns.broader()[noun])]
        return encoder_base.unit(self._axes[noun] + 0.8 * np.sum(kinds, axis=0) if kinds else self._axes[noun])


def named(*names, captions=None, **options):
    """A scene of bodies with these names; the first is object 1."""
    scene = make_scene(n=80 + 60 * len(names), objects=len(names), shadows=False, **options)
    fresh = {k + 1: name for k, name in enumerate(names)}
    captions = captions or {}
    return dataclasses.replace(
        scene,
        objects=tuple(
            dataclasses.replace(o, name=fresh.get(o.id, o.name), aliases=(), caption=captions.get(o.id, ""))
            for o in scene.objects
        ),
    )


def related(one, other):
    return common_nouns.relations()[WORDS.index(one), WORDS.index(other)]


def test_nouns_have_their_kinds():
    assert {"citrus", "fruit", "food"} <= common_nouns.broader()["lemon"]
    assert related("lemon", "fruit") and related("lemon", "apple")
    assert not related("lemon", "hammer") and related("hammer", "hammer")
    assert common_nouns.known("the blue crates") == "crate" and common_nouns.known("press ram") is None
    assert len(WORDS) > 500 and list(WORDS) == sorted(set(WORDS))
    assert set(common_nouns.things()) < set(WORDS) and "fruit" not in common_nouns.things()
    assert all(len(object_search.phrases_of(word)) == 1 for word in WORDS)


def test_thresholds_let_so_many_false_nouns_pass_as_is_allowed():
    nouns = Plain().embed_texts(WORDS)
    places = [WORDS.index(thing) for thing in common_nouns.things()]
    rows = nouns[places]
    found = calibration.for_words(rows, nouns, 10)
    false = ~common_nouns.relations()[places]
    passed = (rows @ nouns.T >= found.thresholds[:, None])[false].mean()
    assert passed == pytest.approx(calibration.FALSE_ALARMS / 10, rel=0.05)
    stricter = calibration.for_words(rows, nouns, 40)
    assert stricter.limit > found.limit and (stricter.thresholds > found.thresholds).all()


def test_a_calibration_ignores_an_offset_shared_by_all_cosines():
    plain = Plain().embed_texts(WORDS)
    common = np.concatenate([np.sqrt(0.5) * plain, np.full((len(plain), 1), np.sqrt(0.5))], axis=1)
    one, other = (calibration.for_words(each[:20], each, 5) for each in (plain, common))
    assert other.limit == pytest.approx(one.limit, abs=1e-4) and other.margin == pytest.approx(one.margin / 2, rel=1e-3)
    np.testing.assert_allclose(other.thresholds, 0.5 + 0.5 * one.thresholds, atol=1e-5)


def test_pictures_are_calibrated_by_nouns_that_do_not_name_them():
    nouns = Plain().embed_texts(WORDS)
    rows = nouns[[WORDS.index("lemon"), WORDS.index("hammer")]]
    told = calibration.for_pictures(rows, nouns, [("lemon",), ("hammer",)])
    blind = calibration.for_pictures(rows, nouns, [("thing 1",), ("thing 2",)])
    wrong = calibration.for_pictures(rows, nouns, [("hammer",), ("lemon",)])
    assert told.limit <= blind.limit + 1.0 < wrong.limit
    assert (rows @ nouns[WORDS.index("fruit")])[0] > told.thresholds[0] > (rows @ nouns[WORDS.index("axe")])[0]
    assert len(calibration.for_pictures(np.zeros((0, 64)), nouns, []).thresholds) == 0


def test_words_find_objects_of_their_kind_and_nothing_else():
    made = build_table.make(named("lemon", "apple", "donut", "hammer"), Plain())
    find = lambda text: [m.object_id for m in object_search.search(made.scene, text)]  # noqa: E731
    assert sorted(find("fruit")) == [1, 2] and find("pastry") == [3] and find("tools") == [4]
    assert find("elephant") == [] and find("lemon") == [1] and made.notes == ()
    assert sorted(find("fruit and a tool")) == [1, 2, 4]
    for match in object_search.search(made.scene, "fruit"):
        assert (
            match.relevancy is not None
            and match.cosine > made.scene.lookup.thresholds[_row(made.scene, match.object_id)]
        )
    low = object_search.search(made.scene, "elephant", threshold=0.0)
    assert {match.object_id for match in low} == {1, 2, 3, 4} and max(match.score for match in low) < 0.5


def test_the_table_holds_names_extra_words_and_common_nouns_once():
    scene = named("lemon", "press ram")
    made = build_table.make(scene, Plain(), ["zeppelins", "Lemons", "salt and pepper", "  "]).scene
    assert made.vocabulary[:3] == ("lemon", "press ram", "zeppelins") and "salt and pepper" not in made.vocabulary
    said = [tuple(object_search.phrases_of(word)[0]) for word in made.vocabulary]
    assert len(set(said)) == len(said) and {tuple(object_search.phrases_of(word)[0]) for word in WORDS} <= set(said)
    np.testing.assert_allclose(np.linalg.norm(made.vocabulary_embeddings, axis=1), 1, atol=1e-3)
    assert made.lookup.pooling == "max" and made.lookup.canonical == encoder_base.CANONICAL


def test_a_caption_replaces_a_generic_name():
    scene = named("object 1", "hammer", "Object_3", captions={1: "a lemon"})
    made = build_table.make(scene, Plain())
    assert [view.source for view in made.scene.lookup.views[_row(scene, 1)]] == ["a lemon"]
    assert [m.object_id for m in object_search.search(made.scene, "fruit")] == [1]
    assert made.scene.lookup.thresholds[_row(scene, 3)] is None
    assert not made.scene.embeddings[_row(scene, 3)].any() and "Object_3" in made.notes[0]
    with pytest.raises(errors.BackendError, match="no object has anything to embed; without a name, alias or caption"):
        build_table.make(named("object 1", "2"), Plain())
    with pytest.raises(errors.BackendError, match="the scene has no objects"):
        build_table.make(make_scene(n=30, objects=0), Plain())


@pytest.mark.parametrize("kind", ["text", "clip"])
def test_an_object_without_gaussians_gets_a_warning_and_no_embedding(kind):
    scene = ring(named("lemon", "hammer"))
    keep = scene.gaussians.object_ids != 2
    bare = dataclasses.replace(
        scene.with_arrays(**{name: scene.arrays()[name][keep] for name in PER_GAUSSIAN}),
        objects=tuple(dataclasses.replace(item, count=0 if item.id == 2 else item.count) for item in scene.objects),
        groups=tuple(dataclasses.replace(g, anchor_index=-1) for g in scene.groups),
    )
    told = []
    made = build_table.make(bare, Plain(kind), progress=lambda what, done, total: told.append((what, done == total)))
    assert made.scene.lookup.thresholds[_row(bare, 2)] is None and not made.scene.embeddings[_row(bare, 2)].any()
    assert made.scene.lookup.thresholds[_row(bare, 1)] is not None
    assert "without Gaussians, and so without an embedding: hammer" in made.notes
    assert told[-1] == ("objects", True) and (("views", True) in told) == (kind == "clip")


def _row(scene, object_id):
    return [item.id for item in scene.objects].index(object_id)


def ring(scene, count=4, width=96):
    """Cameras around the scene, from slightly above."""
    made = []
    for k in range(count):
        angle = 2 * np.pi * k / count
        center = np.array([4.0 * np.cos(angle), 4.0 * np.sin(angle), 1.6])
        forward = np.array([0, 0, 0.3]) - center
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        T_cam_world = np.eye(4)
        T_cam_world[:3, :3], T_cam_world[:3, 3] = rotation, -rotation @ center
        intrinsics = np.array([[110.0, 0, width / 2], [0, 110.0, width / 2], [0, 0, 1]])
        made.append(cameras.Camera(width, width, intrinsics, T_cam_world, f"ring{k}"))
    return dataclasses.replace(scene, cameras=tuple(made))


@pytest.fixture(scope="module")
def seen():
    """A scene whose third object is hidden in the second, and whose fourth has no opacity."""
    scene = ring(named("mug", "globe", "pearl", "ghost"))
    logits = np.full(len(scene.gaussians.means), 4.0, np.float32)
    logits[scene.gaussians.object_ids == 4] = -12.0
    scales = np.full_like(scene.gaussians.log_scales, np.log(0.05))
    return scene.with_arrays(opacity_logits=logits, log_scales=scales)


def test_the_best_views_are_spread_over_cameras_and_times(seen):
    found = best_views.find(seen, [1, 2, 4])
    assert found[4] == []
    for object_id in (1, 2):
        own = found[object_id]
        assert 1 < len(own) <= best_views.VIEWS and own[0].worth > 0
        assert len({sighting.camera.name for sighting in own}) > 1 and len({sighting.t for sighting in own}) > 1
        for sighting in own:
            left, top, right, bottom = sighting.box
            assert right - left == pytest.approx(bottom - top) and seen.tracks.times[0] <= sighting.t <= seen.t_max


def test_crops_show_the_object_alone_on_gray_and_in_its_place(seen):
    sighting = best_views.find(seen, [1])[1][0]
    alone, context = best_views.crops(seen, 1, sighting, 64)
    assert alone.shape == context.shape == (64, 64, 3) and alone.min() >= 0 and context.max() <= 1
    np.testing.assert_allclose(alone[0, 0], 0.5, atol=0.02)
    assert (np.abs(alone - 0.5).max(-1) > 0.05).mean() > 0.1
    away = seen.gaussians.sh.copy()
    away[seen.gaussians.object_ids != 1] *= -1
    others = seen.with_arrays(sh=away)
    np.testing.assert_allclose(best_views.crops(others, 1, sighting, 64)[0], alone, atol=1e-6)
    assert np.abs(best_views.crops(others, 1, sighting, 64)[1] - context).max() > 0.05


def test_hidden_views_are_worth_less(seen):
    whole = best_views.find(seen, [1])[1]
    wall = seen.gaussians.means.copy()
    rows = np.flatnonzero(seen.gaussians.object_ids == 0)
    camera = next(camera for camera in seen.cameras if camera.name == whole[0].camera.name)
    middle = seen.gaussians.means[seen.gaussians.object_ids == 1].mean(0)
    toward = camera.center - middle
    side = np.cross(toward, [0, 0, 1.0]) / np.linalg.norm(np.cross(toward, [0, 0, 1.0]))
    spread = np.linspace(0, 0.5, len(rows))[:, None]
    wall[rows] = middle + 0.4 * toward + spread * side + np.random.default_rng(0).normal(size=(len(rows), 3)) * 0.15
    blocked = seen.with_arrays(means=wall.astype(np.float32))
    found = best_views.find(blocked, [1])[1]
    name = camera.name
    before = max(s.worth for s in whole if s.camera.name == name)
    assert max((s.worth for s in found if s.camera.name == name), default=0.0) < before


def test_pictures_make_the_table_of_an_image_encoder(seen):
    encoder = Plain("clip")
    made = build_table.make(seen, encoder)
    table = made.scene.lookup
    assert table.pooling == "mean" and "ghost" in made.notes[0] and table.thresholds[_row(seen, 4)] is None
    views = table.views[_row(seen, 1)]
    assert len(encoder.seen) == 2 * sum(len(own) for own in table.views) and all(
        image.min() >= 0 for image in encoder.seen
    )
    assert {view.source for view in views} <= {camera.name for camera in seen.cameras} and views[0].box is not None
    mean = encoder_base.unit(made.scene.view_embeddings[_row(seen, 1), : len(views)].mean(0))
    np.testing.assert_allclose(made.scene.embeddings[_row(seen, 1)], mean, atol=2e-3)
    back = [view for own in table.views for view in own if not np.isfinite(view.threshold)]
    assert back == []


@pytest.mark.default_cases("clip")
@pytest.mark.parametrize("kind", ["clip", "siglip", "sentences"])
def test_tiny_encoders_run_through_all_stages(kind, seen, tmp_path):
    folder = getattr(encoder_folders, kind)(tmp_path / kind)
    path = scene_file.write(seen, tmp_path / "seen.r5dgs")
    lookup.run_lookup(path, str(folder))
    stored = scene_file.read(path)
    assert stored.lookup.encoder.name == kind
    encoder = registry.open_encoder(folder)
    assert [m.object_id for m in query.find(stored, "mug", encoder)] == [1]
    fresh = encoder_base.embed_phrases(encoder, ["teapot"])[0]
    row = object_search.vocabulary_row(stored.vocabulary, ["teapot"])
    np.testing.assert_allclose(stored.vocabulary_embeddings[row], fresh, atol=2e-3)
    same = embedding_search.ask(stored_embeddings.StoredEmbeddings.of(stored), fresh)
    assert len(same) == (4 if kind == "sentences" else 3)


def test_another_encoder_is_refused_with_the_remedy(seen):
    made = build_table.make(seen, Plain()).scene
    assert query.find(made, "globes", Plain())[0].object_id == 2
    with pytest.raises(errors.BackendError, match=r"made by the text encoder 'plain' \(SHA-256 abab.*make the table"):
        query.find(made, "globe", Plain(digest="cd" * 32))
    with pytest.raises(errors.BackendError, match="has no lookup table for an encoder"):
        query.find(seen, "globe", Plain())


def by_name(where):
    """In place of `registry.open_encoder`: a folder's name decides the digest."""
    return Plain(digest=str(where).ljust(64, "0"))


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    """A scene file with a table by the encoder "plain"."""
    path = tmp_path_factory.mktemp("words") / "named.r5dgs"
    before = scene_file.read(scene_file.write(named("lemon", "apple", "donut", "hammer"), path, precision="exact"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "open_encoder", by_name)
        lookup.run_lookup(path, "plain")
    after = scene_file.read(path)
    for field in ("means", "quats", "log_scales", "opacity_logits", "sh", "track_poses"):
        np.testing.assert_array_equal(after.arrays()[field], before.arrays()[field])
    return path.read_bytes()


@pytest.fixture
def file(content, tmp_path, monkeypatch):
    """That file, and its encoder behind its name."""
    monkeypatch.setattr(registry, "open_encoder", by_name)
    path = tmp_path / "named.r5dgs"
    path.write_bytes(content)
    return path


def test_the_commands_find_by_meaning_without_an_encoder(file, capsys):
    assert main.main(["query", str(file), "fruit", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert {row["name"] for row in said["matches"]} == {"lemon", "apple"} and said["note"] == ""
    assert all(row["relevancy"] > 0.5 and row["score"] >= said["threshold"] for row in said["matches"])
    assert main.main(["query", str(file), "elephant"]) == 1
    assert "nothing matches 'elephant'; the scene has: lemon, apple, donut, hammer" in capsys.readouterr().out
    assert main.main(["query", str(file), "glorp"]) == 1
    assert "not among the stored words: 'glorp'; give the table's encoder" in capsys.readouterr().out
    assert main.main(["query", str(file), "donut and a lemon"]) == 0
    assert "name 'donut'" in capsys.readouterr().out
    assert main.main(["name", str(file), "donut", "donut [/left]"]) == main.main(["query", str(file), "donut"]) == 0
    assert "donut [/left] │" in capsys.readouterr().out  # no markup


def test_the_encoder_of_the_table_embeds_other_words(file, capsys):
    assert main.main(["query", str(file), "rusty hammers", "--encoder", "plain"]) == 0
    assert "hammer" in capsys.readouterr().out
    assert main.main(["query", str(file), "glorp and rusty hammers and lemon", "--encoder", "plain"]) == 0
    said = capsys.readouterr().out
    assert "nothing matches 'glorp'" in said and "matches 'rusty" not in said  # that even the encoder does not know
    assert main.main(["query", str(file), "elephant, lemon", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["note"] == "nothing matches 'elephant'"
    assert main.main(["query", str(file), "lemon", "--encoder", "other"]) == 3
    assert "cannot be used with" in capsys.readouterr().err


def test_naming_an_object_changes_only_its_name(file, capsys):
    before = scene_file.read(file)
    arguments = ["name", str(file), "3", "glazed donut", "--alias", "snack", "--alias", "bun", "--caption", "a sweet"]
    assert main.main(arguments) == 0
    said = capsys.readouterr().out
    assert "object 3 is 'glazed donut', also snack, bun" in said and "rebuild it: r5dgs lookup" in said
    after = scene_file.read(file)
    assert after.object(3) == dataclasses.replace(
        before.object(3), name="glazed donut", aliases=("snack", "bun"), caption="a sweet"
    )
    np.testing.assert_array_equal(after.gaussians.means, before.gaussians.means)
    assert after.lookup == before.lookup
    assert [m.object_id for m in object_search.search(after, "snack")] == [3]
    assert main.main(["name", str(file), "glazed donut", "--alias", "bun"]) == 0
    assert scene_file.read(file).object(3).aliases == ("snack", "bun")


def test_an_id_is_not_taken_as_the_name_of_another_object(file):
    assert main.main(["name", str(file), "1", "3"]) == 0  # object 1 is called "3" now
    assert main.main(["name", str(file), "3", "donut"]) == 0
    after = scene_file.read(file)
    assert (after.object(1).name, after.object(3).name) == ("3", "donut")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["name", "FILE", "3"], "expected a new name, --alias WORD or --caption TEXT"),
        (["name", "FILE", "9", "x"], "expected an object of the scene, found '9'; there are .*1 'lemon'"),
        (["name", "FILE", "3", "lemon"], "the name 'lemon' is taken by object 1.*alias"),
        (["name", "FILE", "3", " "], "object 3: expected a name, found an empty one"),
        (["query", "FILE", " ,"], "expected words for the objects"),
        (["query", "FILE", "mug", "--threshold", "2"], "--threshold 2.0: expected a number from 0 to 1"),
        (["lookup", "FILE", "--encoder", "plain", "--captions", "no.json"], "no.json: the file is missing"),
        (["lookup", "FILE", "--encoder", "plain", "--out", "no.zip"], "expected a name that ends in .r5dgs"),
        (["lookup", "FILE", "--encoder", "plain", "--words", "no.txt"], "--words no.txt: cannot be read as text"),
    ],
)
def test_mistakes_are_errors_of_one_line_and_keep_the_file(file, capsys, arguments, message):
    content = file.read_bytes()
    status = main.main([str(file) if a == "FILE" else a for a in arguments])
    assert status in (ExitStatus.USAGE, ExitStatus.ERROR)
    assert file.read_bytes() == content
    assert re.search(message, capsys.readouterr().err)


def test_captions_come_from_a_file(file, tmp_path, capsys):
    captions = tmp_path / "captions.json"
    captions.write_text(json.dumps({"1": "a sour citrus", "hammer": {"aliases": ["mallet"], "name": "tool 1"}}))
    out = tmp_path / "out.r5dgs"
    content = file.read_bytes()
    asked = ["lookup", str(file), "--encoder", "plain", "--captions", str(captions)]
    assert main.main([*asked, "--out", str(out), "--progress", "json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["path"] == str(out) and file.read_bytes() == content
    scene = scene_file.read(out)
    assert scene.object(1).caption == "a sour citrus" and scene.object(4).aliases == ("mallet",)
    assert scene.object(4).name == "tool 1" and "mallet" in scene.vocabulary
    for wrong in ("[]", "{", '{"1": 3}', '{"1": {"color": "red"}}', '{"1": {"aliases": "red"}}', '{"1": {"name": 1}}'):
        captions.write_text(wrong)
        assert main.main(asked) == 3
        assert str(captions) in capsys.readouterr().err


@pytest.mark.skipif(not os.environ.get("R5DGS_TEXT_ENCODER"), reason="R5DGS_TEXT_ENCODER names no sentence model")
def test_a_real_sentence_model_finds_by_meaning_or_nothing():
    encoder = registry.open_encoder(os.environ["R5DGS_TEXT_ENCODER"])
    made = build_table.make(named("mug", "lemon", "apple", "donut", "cutting board", "bowl"), encoder).scene
    found = {
        text: {m.object_id for m in object_search.search(made, text)} for text in ("fruit", "pastry", "cup", "elephant")
    }
    assert found == {"fruit": {2, 3}, "pastry": {4}, "cup": {1}, "elephant": set()}
    assert [m.object_id for m in query.find(made, "something to drink from", encoder)] == [1]
