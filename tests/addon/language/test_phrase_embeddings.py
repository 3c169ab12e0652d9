"""Words that no scene stores are embedded by the worker with the encoder of the preferences."""

import sys

import pytest

from r5dgs_core.scene import scene_file
from tests.support import encoder_folders, motions, patience, scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")
pytest.importorskip("torch", reason="torch is not installed in this Python, which runs the worker here")
pytest.importorskip("transformers", reason="transformers is not installed in this Python, which runs the worker here")


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Two encoders, and a scene file with the table of the first one, whose object 2 means zorb."""
    from r5dgs_core.language import build_table
    from r5dgs_core.language.encoders import encoder_base, registry

    folder = tmp_path_factory.mktemp("phrases")
    own = encoder_folders.sentences(folder / "own")
    other = encoder_folders.sentences(folder / "other", seed=1)
    scene = scenes.make_scene(n=200, objects=3)
    encoder = registry.open_encoder(own)
    made = build_table.make(scene, encoder).scene
    row = [item.id for item in made.objects].index(2)
    made.view_embeddings[row, 0] = encoder_base.embed_phrases(encoder, ["zorb"])[0]
    return own, other, scene_file.write(made, folder / "words.r5dgs")


@pytest.fixture
def loaded(blender, folders, monkeypatch):
    monkeypatch.setenv("R5DGS_PYTHON", sys.executable)
    monkeypatch.setenv("R5DGS_TEXT_ENCODER", str(folders[0]))
    motions.addon("language.phrase_embeddings").forget()
    motions.load_again(blender, folders[2])
    return blender


def wait_for_the_answer():
    """Run the timer until the response has been received."""
    patience.wait_until(lambda: motions.addon("language.phrase_embeddings").poll() is None)


def ask(bpy, text):
    return bpy.ops.r5dgs.select_by_prompt(text=text, mode="SET")


def notes(bpy):
    return [note.name for note in bpy.context.window_manager.r5dgs_words.notes]


@pytest.mark.slow
def test_the_encoder_of_the_preferences_matches_words_not_stored_in_the_scene(loaded):
    assert ask(loaded, "zorb") == {"FINISHED"}
    (match,) = [m for m in loaded.context.window_manager.r5dgs_words.matches if m.object_id == 2]
    assert "meaning of 'zorb'" in match.why and match.score >= 0.5 and notes(loaded) == []


def test_a_phrase_is_embedded_once_and_names_need_no_encoder(loaded, monkeypatch):
    worker = motions.addon("worker.jobs")
    asked, run = [], worker.run
    monkeypatch.setattr(worker, "run", lambda steps: asked.append(steps[0][2]["texts"]) or run(steps))
    ask(loaded, "zorb")
    ask(loaded, "zorb and mug")
    ask(loaded, "mug")
    ask(loaded, "fruit")
    assert asked == [["zorb"]]


def test_without_an_encoder_other_words_find_nothing(loaded, monkeypatch):
    monkeypatch.delenv("R5DGS_TEXT_ENCODER")
    assert ask(loaded, "zorb") == {"CANCELLED"}
    assert notes(loaded) == ["'zorb': no stored word; name the scene's encoder under Text Encoder in the preferences"]
    assert ask(loaded, "mug and zorb") == {"FINISHED"} and notes(loaded) == ["Nothing matches 'zorb'"]


def test_another_encoder_is_named_with_the_remedy(loaded, folders, monkeypatch):
    monkeypatch.setenv("R5DGS_TEXT_ENCODER", str(folders[1]))
    assert ask(loaded, "zorb") == {"CANCELLED"}
    assert "made by the encoder 'own', but the preferences name 'other'" in notes(loaded)[0]


def test_a_damaged_encoder_is_reported_and_names_are_still_searched(loaded, tmp_path, monkeypatch):
    monkeypatch.setenv("R5DGS_TEXT_ENCODER", str(tmp_path))
    assert ask(loaded, "mug and zorb") == {"FINISHED"}
    assert f"Text encoder: {tmp_path}/config.json: expected in the folder of an encoder" in notes(loaded)[0]


def test_with_a_window_the_answer_arrives_later(loaded, monkeypatch):
    phrases, told = motions.addon("language.phrase_embeddings"), []
    phrases.start(["zorb", "glorp"], told.append)
    assert phrases.missing(["zorb", "glorp"]) == ["zorb", "glorp"]
    wait_for_the_answer()
    assert told == [""] and phrases.missing(["zorb", "glorp", "other"]) == ["other"]
    monkeypatch.setenv("R5DGS_TEXT_ENCODER", "/nowhere")
    phrases.start(["zorb"], told.append)
    wait_for_the_answer()
    assert "expected the folder of an encoder, found nothing" in told[1]


@pytest.fixture
def windowed(loaded, monkeypatch):
    """`loaded` with a simulated window, which must not be blocked."""
    monkeypatch.setattr(motions.addon("language.prompt"), "_has_window", lambda: True)
    return loaded


def test_a_window_shows_known_matches_at_once_and_the_others_later(windowed):
    session = windowed.context.window_manager.r5dgs_words
    assert ask(windowed, "mug and zorb") == {"FINISHED"}
    assert [match.object_id for match in session.matches] == [1]
    assert notes(windowed) == ["Running the text encoder for 'zorb'"]
    wait_for_the_answer()
    assert {1, 2} <= {match.object_id for match in session.matches} and notes(windowed) == []


def test_a_late_answer_is_not_shown_for_another_prompt(windowed):
    session = windowed.context.window_manager.r5dgs_words
    ask(windowed, "zorb")
    ask(windowed, "mug")
    wait_for_the_answer()
    assert motions.addon("language.phrase_embeddings").missing(["zorb"]) == []
    assert session.asked == "mug" and [match.object_id for match in session.matches] == [1]


def test_late_encoder_errors_are_shown_beside_the_known_matches(windowed, monkeypatch):
    monkeypatch.setenv("R5DGS_TEXT_ENCODER", "/nowhere")
    ask(windowed, "mug and zorb")
    wait_for_the_answer()
    assert [match.object_id for match in windowed.context.window_manager.r5dgs_words.matches] == [1]
    assert "Text encoder: /nowhere: expected the folder of an encoder" in notes(windowed)[-1]


def test_opening_another_file_drops_pending_phrase_embeddings(loaded):
    phrases, told = motions.addon("language.phrase_embeddings"), []
    phrases.start(["zorb"], told.append)
    loaded.ops.wm.read_homefile(app_template="")
    assert not loaded.app.timers.is_registered(phrases.poll) and told == []
