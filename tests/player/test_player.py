"""The player in a browser, from a file and from `r5dgs view`."""

import dataclasses
import threading

import numpy as np
import pytest

from r5dgs_core.cli import page_server
from r5dgs_core.formats import html, image_files, registry
from r5dgs_core.scene.scene import Scene, Shading
from tests.support import arms, player_checks, scenes
from tests.support.player import Browser

pytestmark = [pytest.mark.browser, pytest.mark.heavy]

END = 1.3
SIDE = 192
OPTIONS = registry.Options((0.0,), until=END, still=image_files.png(np.full((30, 40, 3), 200, np.uint8)))


@pytest.fixture(scope="module")
def browser():
    found = Browser()
    yield found
    found.close()


def rich_scene() -> Scene:
    """Bodies, a shadow, harmonics, shading with factors, a sky of degree 1 and stored words."""
    scene = scenes.make_scene(n=1500, objects=4, sh_degree=2, seed=5)
    random = np.random.default_rng(2)
    log_scales = scene.gaussians.log_scales + np.float32(0.8)
    sh = scene.gaussians.sh * np.float32([1] + 8 * [0.4])[:, None]
    vectors = np.eye(4, dtype=np.float32)
    sky = np.concatenate([scene.background_sh, 0.2 * random.normal(size=(3, 3)).astype(np.float32)])
    scene = scene.with_arrays(
        log_scales=log_scales,
        sh=sh,
        background_sh=sky,
        embeddings=vectors[[3, 3, 0, 1, 0, 3]],
        vocabulary_embeddings=vectors[[0, 1, 2]],
    )
    rest = random.uniform(0.6, 1.2, 1500).astype(np.float32)
    shading = Shading(scene.shading.vectors, scene.shading.light, rest)
    return dataclasses.replace(scene, shading=shading, vocabulary=("vessel", "fruit", "sofa"))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return rich_scene()


def page_of(scene, folder):
    (path,) = html.export(scene, folder / "scene.html", OPTIONS)
    return path.as_uri()


@pytest.fixture(scope="module")
def url(scene, tmp_path_factory):
    return page_of(scene, tmp_path_factory.mktemp("page"))


def assert_quiet(browser, url):
    """Check that the page had no errors and made no request but that for itself."""
    seen = browser.send(log=True)
    assert seen["log"] == [] and [request.partition("?")[0] for request in seen["requests"]] == [url]


@pytest.mark.slow
@pytest.mark.default_cases("parts")
@pytest.mark.parametrize("made", [rich_scene, arms.make_arm], ids=["bodies", "parts"])
def test_pictures_are_those_of_the_rasterizer(made, browser, tmp_path):
    scene = made()
    url = page_of(scene, tmp_path)
    found = player_checks.compare(browser, scene, url, SIDE, END, tmp_path)
    assert len(found) == 5 * len(scene.cameras)
    assert min(one.psnr for one in found) > 43 and max(one.median for one in found) <= 1
    assert max(one.shift for one in found) < 0.5
    assert_quiet(browser, url)


def test_picking_finds_the_object_of_each_pixel(browser, scene, url):
    found = player_checks.picks(browser, scene, url, SIDE)
    assert len(found) >= 3 and all(right == tried for right, tried in found.values())


@pytest.mark.slow
def test_all_pixels_of_a_fine_screen_are_drawn_and_picked(browser, scene, url, tmp_path):
    seen = dataclasses.replace(scene, cameras=scene.cameras[:1])
    found = player_checks.compare(browser, seen, url, SIDE, END, tmp_path, ratio=2)
    assert min(one.psnr for one in found) > 43 and max(one.shift for one in found) < 0.5
    assert browser.eval("[view.width / view.clientWidth, overlay.width / view.width]") == [2, 1]
    picked = player_checks.picks(browser, seen, url, SIDE, ratio=2)
    assert len(picked) >= 2 and all(right == tried for right, tried in picked.values())


def test_more_than_two_pixels_per_css_pixel_are_not_drawn(browser, url):
    browser.open(f"{url}?t=0", ratio=3)
    assert browser.eval("[view.width / view.clientWidth, overlay.width / view.clientWidth]") == [2, 3]


def test_search_ranks_as_query_does(browser, scene, url):
    texts = player_checks.prompts(scene)
    browser.open(url + "?t=0")
    found = player_checks.rankings_of_page(browser, texts)
    answered = 0
    for text, matches in zip(texts, found, strict=True):
        wanted = player_checks.ranking(scene, text)
        assert [one[0] for one in matches] == [one[0] for one in wanted], text
        assert [one[1] for one in matches] == pytest.approx([one[1] for one in wanted], abs=1e-6), text
        answered += bool(wanted)
    assert len(texts) == 200 and 60 < answered < 200
    assert "nothing matches" in browser.eval("r5dgs.controls.search.find('zebra').note")


def test_the_address_chooses_time_object_and_camera(browser, scene, url):
    camera = scene.cameras[1].name
    browser.open(f"{url}?t=0.9&object=vehicle&camera={camera}")
    assert browser.eval("[r5dgs.t, r5dgs.playing, r5dgs.chosen]") == [0.9, False, 3]
    assert browser.eval("r5dgs.views.captured.name") == camera
    assert browser.eval("document.getElementById('now').textContent") == "0.90 predicted"
    assert "Motion: " in browser.eval("document.getElementById('info').textContent")
    browser.open(f"{url}?t=99&object=zebra&camera=fly")
    assert browser.eval("[r5dgs.t, r5dgs.chosen, r5dgs.views.flying]") == [END, None, True]
    said = browser.eval("document.getElementById('message').textContent")
    assert "zebra" in said and "t=99 is outside this scene, which lasts from 0 to 1.3" in said
    browser.open(f"{url}?t=soon")
    assert "t=soon is not a time" in browser.eval("document.getElementById('message').textContent")


def test_a_name_of_a_camera_wins_over_a_number(browser, scene, tmp_path):
    names = [dataclasses.replace(camera, name=str((k + 1) % 2)) for k, camera in enumerate(scene.cameras[:2])]
    browser.open(page_of(dataclasses.replace(scene, cameras=tuple(names)), tmp_path) + "?t=0&camera=1")
    assert browser.eval("r5dgs.model.cameras.indexOf(r5dgs.views.captured)") == 0


@pytest.mark.slow
def test_vr_starts_at_the_camera_and_gives_it_back(browser, url):
    browser.open(f"{url}?t=0&camera=0")
    before = browser.eval("r5dgs.engine.picture()")
    browser.eval("""(xr = r5dgs.engine.app.xr, eye = r5dgs.engine.eye, place = () => eye.getPosition().toArray(),
        xr.start = (camera, type, space, options) => options.callback(new Error('denied')), vr.click())""")
    assert browser.eval("message.textContent") == "denied"
    assert browser.eval("r5dgs.engine.picture()") == before
    browser.eval("""void (fire = (name) => {
        xr._session = Object.assign(new EventTarget(), { enabledFeatures: [], inputSources: [] });
        xr.fire(name); xr._session = null; })""")
    browser.eval("(fire('start'), eye.setLocalPosition(0, 0, 0), eye.setLocalEulerAngles(0, 0, 0))")
    assert browser.eval("place()") == pytest.approx(browser.eval("r5dgs.views.eye().place"), abs=1e-5)
    ahead, wanted = browser.eval("[eye.forward.toArray(), r5dgs.views.eye().turn]")
    x, y, z, w = wanted
    forward = np.array([-2 * (x * z + w * y), 0, -1 + 2 * (x * x + y * y)])
    assert ahead == pytest.approx(forward / np.linalg.norm(forward), abs=1e-5)
    browser.eval("(eye.setLocalPosition(0.3, 0, 0), fire('end'))")
    assert browser.eval("r5dgs.engine.picture()") == before


def test_a_warning_is_shown_once(browser, scene, url):
    browser.open(f"{url}?t=0&object=mug")
    browser.eval("""(item = r5dgs.model.object(r5dgs.chosen), item.prediction.warning = 'not predictable past 1.2',
        item.motion = 'spin; hit at 0.5, not predictable past 1.2', r5dgs.controls.marks())""")
    shown = browser.eval("[...document.querySelectorAll('#info p')].map((line) => line.textContent)")
    assert "Motion: spin; hit at 0.5" in shown and shown.count("not predictable past 1.2") == 1
    assert sum("not predictable" in line for line in shown) == 1


def test_it_plays_and_loops_unless_motion_is_reduced(browser, url):
    browser.open(url)
    assert browser.eval("r5dgs.playing")
    looped = """(r5dgs.go(1.29), new Promise((done) => { let left = 5000;
        const look = () => (r5dgs.t < 1.2 || !left-- ? done(left > 0) : requestAnimationFrame(look)); look(); }))"""
    assert browser.eval(looped) and browser.eval("r5dgs.playing")
    browser.open(url, still=True)
    assert not browser.eval("r5dgs.playing") and browser.eval("r5dgs.t") == 0


def test_keys_and_clicks_control_it(browser, scene, url):
    camera = scene.cameras[0]
    browser.open(f"{url}?t=0&camera=0", 960, 720)
    browser.send(key="End")
    assert browser.eval("r5dgs.t") == END and browser.eval("document.body.classList.contains('future')")
    browser.send(key="ArrowLeft")
    assert browser.eval("r5dgs.t") == pytest.approx(END - 1 / scene.frames_per_unit)
    browser.send(key="/")
    browser.send(type="cup")
    browser.send(key="Enter")
    assert browser.eval("r5dgs.chosen") == 1
    browser.send(key="Escape")
    browser.eval("document.getElementById('view').focus()")
    browser.send(key="i")
    assert browser.eval("[r5dgs.isolated, r5dgs.visible(1), r5dgs.visible(2)]") == [1, True, False]
    browser.send(key="Escape")
    assert browser.eval("[r5dgs.isolated, r5dgs.chosen]") == [None, None]
    browser.send(key="Home")
    x, y = browser.eval("""(() => { for (let y = 100; y < 560; y += 4) for (let x = 20; x < 660; x += 4)
        if (r5dgs.pick(x, y) === 2) return [x, y]; })()""")
    browser.send(click=[x, y])
    assert browser.eval("r5dgs.chosen") == 2 and camera.width > 0
    before = browser.eval("r5dgs.views.eye().place")
    browser.send(key="f")
    browser.eval("r5dgs.views.fly(0.1, 0, 0)")
    assert browser.eval("r5dgs.views.flying") and browser.eval("r5dgs.views.eye().place") != before


def test_hiding_an_object_hides_its_shadow(browser, scene, url):
    browser.open(f"{url}?t=0")
    name = next(item.name for item in scene.objects if item.id == 1)
    browser.eval(f"document.querySelector('[aria-label=\"Hide {name}\"]').click()")
    hidden = "[...r5dgs.hiddenPieces].map((piece) => [piece.object, piece.group.role])"
    assert sorted(browser.eval(hidden)) == [[0, "shadow"], [1, "body"]]


def boxes_of(*selectors):
    """Script whose value is left, top, right and bottom of elements, in CSS pixels."""
    return f"""{list(selectors)}.map((one) => document.querySelector(one).getBoundingClientRect())
        .map((b) => [b.left, b.top, b.right, b.bottom])"""


def test_an_absent_object_is_neither_drawn_nor_picked(browser, scene, tmp_path):
    made = scenes.with_absence(dataclasses.replace(scene, cameras=scene.cameras[:1]), (-np.inf, 0.3), (0.75, np.inf))
    url = page_of(made, tmp_path)
    found = player_checks.compare(browser, made, url, SIDE, END, tmp_path)
    assert len(found) == 5 and min(one.psnr for one in found) > 43
    browser.open(f"{url}?t=0&object=mug")
    drawn = "r5dgs.engine.drawn.filter((one) => one.entity.enabled).map((one) => one.piece.group.id)"
    inked = "r5dgs.overlay.context.getImageData(0, 0, overlay.width, overlay.height).data.some((value) => value > 0)"
    for t, there in ((0, False), (0.35, True), (0.74, True), (0.75, False), (1.3, False)):
        browser.eval(f"r5dgs.go({t})")
        assert ({1, 5} <= set(browser.eval(drawn))) == there and {2, 3} <= set(browser.eval(drawn))
        browser.eval("r5dgs.isolate(1)")
        assert set(browser.eval(drawn)) == ({1} if there else set())
        browser.eval("r5dgs.isolate(null)")
    assert browser.eval(inked)
    lost = dataclasses.replace(made, groups=tuple(dataclasses.replace(one, absent=()) for one in made.groups))
    picked = player_checks.picks(browser, made, url, SIDE)
    assert 1 not in picked and 1 in player_checks.picks(browser, lost, page_of(lost, tmp_path), SIDE)
    assert all(right == tried for right, tried in picked.values())
    assert_quiet(browser, url)


def test_it_fits_a_phone(browser, url, tmp_path):
    browser.open(f"{url}?t=0.4&object=mug", 360, 640, touch=True)
    assert browser.eval("document.documentElement.scrollWidth") <= 360
    boxes = browser.eval("""[...document.querySelectorAll('button, select, input')].filter((e) => e.offsetParent)
        .map((e) => { const b = e.getBoundingClientRect(); return [b.left, b.top, b.right, b.bottom]; })""")
    assert len(boxes) > 5 and np.min(boxes) >= 0 and (np.max(boxes, axis=0)[2:] <= [360, 640]).all()
    unnamed = browser.eval("""[...document.querySelectorAll('button, select, input, canvas:not([aria-hidden])')]
        .filter((e) => !(e.getAttribute('aria-label') || e.textContent.trim() || e.closest('label')))
        .map((e) => e.outerHTML)""")
    assert unnamed == []
    fold, info = browser.eval(boxes_of("aside", "#info"))
    assert fold[3] <= info[1]
    marks = browser.eval(boxes_of("#marks span:first-child", "#marks span:last-child", "#now"))
    assert marks[0][2] < marks[1][0] and marks[1][2] < marks[2][0]
    browser.eval("r5dgs.engine.settle()")
    browser.send(shot=str(tmp_path / "phone.png"))
    assert (tmp_path / "phone.png").stat().st_size > 5000


@pytest.mark.slow
def test_without_webgl_a_picture_and_a_message_are_shown(browser, url):
    browser.open(url, webgl=False)
    assert "WebGL 2 is missing" in browser.eval("document.getElementById('message').textContent")
    assert browser.eval("document.getElementById('still').naturalWidth") == 40
    assert browser.eval("getComputedStyle(document.getElementById('still')).display") != "none"
    still, message = browser.eval(boxes_of("#still", "#message"))
    assert still[3] - still[1] > 200 and still[3] <= message[1] and message[3] <= 400
    assert_quiet(browser, url)


@pytest.mark.slow
def test_view_serves_the_page(browser, scene):
    pages = {"/": page_server.Page(html.page(scene, OPTIONS))}
    with page_server.serving(pages.get) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            address = f"http://127.0.0.1:{server.server_port}/"
            browser.open(f"{address}?t=0.5&object=lemon")
            assert browser.eval("[r5dgs.t, r5dgs.chosen]") == [0.5, 4]
            assert_quiet(browser, address)
        finally:
            server.shutdown()
            thread.join()
