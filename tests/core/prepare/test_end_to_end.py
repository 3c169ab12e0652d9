"""From videos to a trained scene by the commands: prepare, check, train, bake."""

import json

import numpy as np
import pytest

from r5dgs_core.cli import main
from r5dgs_core.data import dataset, images
from r5dgs_core.playback import scene_player
from r5dgs_core.render import scene_renderer
from r5dgs_core.scene import scene_file
from tests.support import recordings, tiny_datasets

pytestmark = pytest.mark.heavy

COEFFICIENTS = (-0.12, 0.03, 0.002, -0.001, 0.0)
WIDTH, HEIGHT, COUNT = 96, 72, 10
OPTIONS = [text for override in tiny_datasets.SETTINGS for text in ("--set", override)]


@pytest.mark.slow
def test_videos_become_a_scene_that_plays_at_their_rate(tmp_path, capsys):
    rig = recordings.make_rig(4, WIDTH, HEIGHT, COEFFICIENTS)
    times = [tiny_datasets.T_MAX * np.arange(COUNT) / (COUNT - 1)] * 4
    videos = recordings.record(tmp_path / "videos", rig, times, recordings.draw_tiny)
    data, run, scene = (tmp_path / name for name in ("data", "run", "tiny.r5dgs"))
    quiet = ["--progress", "none"]
    assert main.main(["train", str(videos), "--out", str(run)]) == 3
    assert f"r5dgs prepare {videos} --out" in capsys.readouterr().err
    assert main.main(["prepare", str(videos), "--out", str(data), "--hold-out-every", "4", *quiet]) == 0
    capsys.readouterr()
    assert main.main(["check", str(data), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["errors"] == 0 and not {"D67", "D65", "D60"} & {finding["code"] for finding in report["findings"]}
    short = ["--iterations", "300", "--masks", "none"]
    assert main.main(["train", str(data), "--out", str(run), *short, *quiet, *OPTIONS]) == 0
    assert main.main(["bake", str(run), "--out", str(scene)]) == 0

    baked, found = scene_file.read(scene), dataset.read(data)
    assert baked.units == found.units and baked.units.seconds_per_unit is not None
    assert baked.frames_per_unit / baked.units.seconds_per_unit == pytest.approx((COUNT - 1) / tiny_datasets.T_MAX)
    player = scene_player.Player(baked)
    for view in found.val[:2]:
        drawn = scene_renderer.render_frame(baked, player.frame(view.t), view.camera, background="scene").color
        off = np.square(drawn - images.read(view.image_path)).mean()
        assert -10 * np.log10(off) > 18
