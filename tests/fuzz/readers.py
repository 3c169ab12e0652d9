"""All readers of files, with the creation of their inputs and the use of accepted ones."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import struct
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import torch

from r5dgs_core import errors
from r5dgs_core.config import config
from r5dgs_core.data import dataset, images, mask_notes, masks
from r5dgs_core.data.layouts import colmap
from r5dgs_core.formats import fourdgs_file, fourdgs_reader, glb, glb_reader, ply, registry
from r5dgs_core.importing import importer, weights
from r5dgs_core.language.encoders import encoder_base
from r5dgs_core.playback import scene_info, scene_player
from r5dgs_core.raster import rasterize
from r5dgs_core.render import scene_renderer
from r5dgs_core.scene import cameras, quality, scene_file, stored_embeddings
from r5dgs_core.scene.lookup_table import EmbeddingSource, EncoderCard, LookupTable
from r5dgs_core.scene.scene import Scene
from r5dgs_core.search import embedding_search, object_search
from r5dgs_core.train import checkpoint, run_folder
from tests.fuzz import calibration_readers, mutations
from tests.fuzz.campaign import Files, Reader
from tests.support import arms, colmap_files, foreign_runs, scenes

SIDE = 8  # pixels of the pictures that accepted scenes are drawn in
COUNT = 30


def files_in(folder: Path) -> Files:
    """All files below a folder."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def made_in(write: Callable[[Path], Any]) -> Files:
    """Files that a function writes into a folder."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder))
        return files_in(Path(folder))


def one_changed(files: Files, random: Random, weights: dict[str, int] | None = None) -> Files:
    """The files, one of them changed (now and then two, or one missing)."""
    result, names = dict(files), list(files)
    for _ in range(random.choice((1, 1, 1, 1, 2))):
        name = random.choices(names, [(weights or {}).get(name, 1) for name in names])[0]
        result[name] = mutations.by_name(name)(random, files[name])
    if random.random() < 0.02:
        del result[random.choice(names)]
    return result


# Scenes.


def rich_scene(seed: int = 0, **changes: Any) -> Scene:
    """A small scene with every member that a file can have."""
    rng = np.random.default_rng(seed)
    plain = scenes.make_scene(n=COUNT, objects=2, seed=seed, sh_degree=1)
    rows, knots, count = 4, len(plain.tracks.times), len(plain.objects)
    offsets = rng.normal(scale=0.05, size=(rows, knots, 3)).astype(np.float32)
    growths = rng.normal(scale=0.05, size=(rows, knots, 3)).astype(np.float32)
    offsets[:, -1], growths[:, -1] = 0, 0
    turns = np.tile(np.array([1, 0, 0, 0], np.float32), (rows, knots, 1))

    def units(*shape: int) -> np.ndarray:
        vectors = rng.normal(size=shape)
        return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)

    table = LookupTable(
        EncoderCard("clip", "tiny", "0" * 64, 4, ("{}", "a {}")),
        ("thing", "stuff"),
        tuple(
            (EmbeddingSource("orbit", 0.2, 0.5, (0.0, 0.0, 9.0, 9.0)), EmbeddingSource("a word", 0.2))
            for _ in range(count)
        ),
        tuple(0.2 for _ in range(count)),
        0.05,
        "max",
    )
    return dataclasses.replace(
        plain.with_arrays(
            residual_rows=np.arange(6, 6 + rows, dtype=np.int32),
            residual_offsets=offsets,
            residual_quats=turns,
            residual_log_scales=growths,
            dynamics=rng.normal(scale=0.1, size=(COUNT, 12)).astype(np.float32),
            canonical_means=plain.gaussians.means + np.float32(0.1),
            shading_rest=np.ones(COUNT, np.float32),
            classifier_weight=rng.normal(size=(count - 1, 16)).astype(np.float32),
            classifier_bias=np.zeros(count - 1, np.float32),
            embeddings=units(count, 4),
            vocabulary_embeddings=units(2, 4),
            canonical_embeddings=units(2, 4),
            view_embeddings=units(count, 2, 4),
            **changes,
        ),
        vocabulary=("mug", "fruit"),
        lookup=table,
    )


def scene_reader() -> Reader:
    """Scene files; accepted ones are played, drawn, searched and written again."""
    bases = []
    with tempfile.TemporaryDirectory() as folder:
        plain = scenes.make_scene(n=COUNT, objects=2, shadows=False)
        far = {"origin": np.array([5e6, 0.0, 1.0])} if hasattr(plain, "origin") else {}
        scenes_of = {"compact": rich_scene(), "exact": rich_scene(1, **far), "quantised": rich_scene(2)}
        for precision, scene in (*scenes_of.items(), ("compact", plain)):
            path = scene_file.write(scene, Path(folder, "scene.r5dgs"), precision=precision)
            with zipfile.ZipFile(path) as file:
                bases.append((path.read_bytes(), {name: file.read(name) for name in file.namelist()}))

    def make(random: Random) -> Files:
        whole, members = random.choice(bases)
        if random.random() < 0.1:
            return {"scene.r5dgs": mutations.data(random, whole)}
        return {"scene.r5dgs": mutations.archive(random, members, text_member="scene.json")}

    def read(folder: Path) -> None:
        path = folder / "scene.r5dgs"
        for part in (scene_file.read_embeddings, scene_file.precision_of):
            with contextlib.suppress(errors.R5dgsError):
                part(path)
        use_scene(scene_file.read(path), folder / "again.r5dgs")

    return Reader("scene", make, read)


def use_scene(scene: Scene, path: Path) -> None:
    """Play, draw, search and write a scene. Any exception is a defect of the check that accepted it."""
    with as_defects():
        first, last = float(scene.tracks.times[0]), scene.t_max
        later = last + max(0.3 * (last - first), 1 / scene.frames_per_unit)
        frames = []
        for mode in ("rigid", *scene_player.modes(scene)[-1:]):
            player = scene_player.Player(scene, mode)
            frames += [player.frame(t) for t in (first - 1, 0.7 * first + 0.3 * last, last, later)]
        for frame in frames:
            for name in ("means", "quats", "log_scales", "group_quats", "group_displacements"):
                assert np.isfinite(getattr(frame, name)).all(), f"{name} at {frame.t} is not finite"
        for frame, camera in zip((frames[1], frames[-1]), (*scene.cameras[:2], None, None), strict=False):
            if camera is not None and len(scene.gaussians.means):
                small = cameras.crop(camera, (camera.width - SIDE) // 2, (camera.height - SIDE) // 2, SIDE, SIDE)
                output = scene_renderer.render_frame(scene, frame, small, backend="reference")
                assert np.isfinite(output.color).all() and np.isfinite(output.alpha).all(), "picture is not finite"
        stored = stored_embeddings.StoredEmbeddings.of(scene)
        if stored is not None:
            embedding_search.ask(stored, stored.vocabulary_embeddings[0] if len(stored.vocabulary) else np.zeros(0))
        object_search.search(scene, "mug")
        json.dumps(scene_info.info(scene), allow_nan=False).encode()
        again = scene_file.read(scene_file.write(scene, path))
        assert len(again.gaussians.means) == len(scene.gaussians.means) and again.objects == scene.objects


@contextlib.contextmanager
def as_defects():
    """Turn a refusal into a defect, because accepted input must work."""
    try:
        yield
    except errors.R5dgsError as error:
        raise AssertionError(f"accepted, then refused: {error}") from error


def ply_reader() -> Reader:
    """PLY files, binary and text."""
    cloud = foreign_runs.cloud(identities=True)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.ply")
        foreign_runs.write_cloud(path, cloud)
        binary, splats = path.read_bytes(), ply.read(path)
        ids = np.zeros(len(splats.means), np.int32)
        marked = ply.write(dataclasses.replace(splats, object_ids=ids), path).read_bytes()
    head, _, body = binary.partition(b"end_header\n")
    rows = np.frombuffer(body, "<f4").reshape(foreign_runs.COUNT, -1)
    ascii_body = "\n".join(" ".join(f"{value:.4g}" for value in row) for row in rows) + "\n"
    ascii_head = head.replace(b"binary_little_endian", b"ascii")
    bases = [(head, body), tuple(marked.partition(b"end_header\n")[::2]), (ascii_head, ascii_body.encode())]

    def make(random: Random) -> Files:
        head, body = random.choice(bases)
        if random.random() < 0.6:
            head = mutations.text(random, head)
        else:
            body = (mutations.text if head == ascii_head else mutations.data)(random, body)
        return {"a.ply": head + b"end_header\n" + body}

    def read(folder: Path) -> None:
        splats = ply.read(folder / "a.ply")
        with as_defects():
            for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
                assert np.isfinite(getattr(splats, name)).all(), f"{name} is not finite"
            again = ply.read(ply.write(splats, folder / "again.ply"))
            np.testing.assert_array_equal(again.means, splats.means)
            camera = dataclasses.replace(foreign_runs.view(), width=SIDE, height=SIDE)
            tensors = {
                n: torch.from_numpy(getattr(splats, n)[:COUNT])
                for n in ("means", "quats", "log_scales", "opacity_logits", "sh")
            }
            rasterize(type("Gaussians", (), tensors)(), camera, backend="reference")

    return Reader("ply", make, read)


# Data sets.


def write_pictures(folder: Path, names: list[str]) -> None:
    """Small pictures, and masks of all kinds for some of them."""
    rng = np.random.default_rng(0)
    for name in names:
        images.write_png(folder / f"{name}.png", rng.integers(0, 255, (6, 8, 4), np.uint8))


def write_flat(folder: Path, nested: bool = False) -> None:
    """Write a data set in D-NeRF's or NVFi's layout."""
    names = [f"train/r_{i}" for i in range(3)]
    write_pictures(folder, [*names, "val/r_0"])
    pose = cameras.cam_world_to_opengl(scenes.orbit_camera(0.3).T_cam_world).tolist()
    frames = [
        {"file_path": f"./{name}", "time": 0.3 * i, "transform_matrix": pose, "frame": i}
        for i, name in enumerate(names)
    ]
    top: dict[str, Any] = {
        "camera_angle_x": 0.7,
        "fps": 24,
        "duration": 1.0,
        "world_convention": "blender",
        "w": 8,
        "h": 6,
    }
    if nested:
        part = {"transform_matrix": pose, "frames": [{k: f[k] for k in ("file_path", "time")} for f in frames]}
        content = {**top, "data": {"cam0": part}}
    else:
        content = {**top, "frames": frames}
    (folder / "transforms_train.json").write_text(json.dumps(content))
    val = {**top, "frames": [{"file_path": "val/r_0", "time": 0.1, "transform_matrix": pose}]}
    (folder / "transforms_val.json").write_text(json.dumps(val))
    ids = np.zeros((6, 8), np.uint16)
    ids[2:, 3:] = 1
    for name in names:
        masks.write(folder / "object_mask" / f"{name}.png", ids)
    video = {"cam0": mask_notes.Video(tuple(names), (1,))}
    mask_notes.write(mask_notes.MaskNotes("sam2", videos=video, made_with={"a": 1}), folder / "object_mask")
    (folder / "objects.json").write_text(json.dumps({"1": "mug", "2": {"name": "ball", "aliases": ["toy"]}}))
    truth = {
        "t_max": 0.6,
        "times": [0.0, 0.5],
        "objects": [{"id": 1, "name": "mug", "matrices": [np.eye(4).tolist()] * 2}],
    }
    (folder / "ground_truth.json").write_text(json.dumps(truth))


def use_dataset(folder: Path) -> None:
    """Read a data set and the files of its views."""
    found = dataset.read(folder)
    for view in (*found.train[:2], *found.val[:1]):
        with as_defects():
            if hasattr(cameras, "check"):
                cameras.check(view.camera)
            assert np.isfinite(view.t)
        dataset.load_image(view)
        dataset.load_mask(view)
    found.require_one_numbering()


def dataset_reader() -> Reader:
    """Folders in D-NeRF's and NVFi's layout with names, masks and true poses."""
    bases = [made_in(write_flat), made_in(lambda folder: write_flat(folder, nested=True))]
    often = {name: 6 for name in bases[0] if name.endswith(".json")}
    return Reader("dataset", lambda random: one_changed(random.choice(bases), random, often), use_dataset)


def colmap_reader() -> Reader:
    """COLMAP's reconstructions, binary and text, with times or with numbered frames."""

    def write(folder: Path, text: bool, times: bool) -> None:
        names = [f"cam{k}/{i:03}.png" for k in range(2) for i in range(2)]
        write_pictures(folder / "images", [name.removesuffix(".png") for name in names])
        views = {f"cam{k}/000.png": scenes.orbit_camera(0.5 * k, 8, 6) for k in range(2)}
        colmap_files.write(folder / "sparse" / "0", views, np.random.default_rng(0).normal(size=(5, 3)), text=text)
        if times:
            content = {"times": {name: 0.1 * i for i, name in enumerate(names)}, "t_max": 0.2, "frames_per_unit": 10}
            (folder / "times.json").write_text(json.dumps(content))

    bases = [made_in(lambda folder, a=a, b=b: write(folder, a, b)) for a in (False, True) for b in (False, True)]
    often = {name: 8 for base in bases for name in base if not name.endswith(".png")}

    def read(folder: Path) -> None:
        found = colmap.read(folder)
        if found.points is not None:
            assert np.isfinite(found.points).all()
        use_dataset(folder)

    return Reader("colmap", lambda random: one_changed(random.choice(bases), random, often), read)


def encoded(pixels: np.ndarray, suffix: str) -> bytes:
    """An image file of some kind."""
    import OpenImageIO as oiio

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"a{suffix}")
        kind = {np.dtype(np.uint8): oiio.UINT8, np.dtype(np.uint16): oiio.UINT16}.get(pixels.dtype, oiio.FLOAT)
        target = oiio.ImageOutput.create(str(path))
        target.open(str(path), oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind))
        target.write_image(np.ascontiguousarray(pixels))
        target.close()
        return path.read_bytes()


def image_reader() -> Reader:
    """Pictures: PNG of 8 and 16 bits, JPEG, EXR, TIFF."""
    rng = np.random.default_rng(0)
    byte = rng.integers(0, 255, (9, 7, 4), np.uint8)
    bases = {
        "a.png": encoded(byte, ".png"),
        "b.png": encoded(byte.astype(np.uint16) * 257, ".png"),
        "a.jpg": encoded(byte[..., :3], ".jpg"),
        "a.exr": encoded(rng.random((9, 7, 4), np.float32), ".exr"),
        "a.tif": encoded(byte, ".tif"),
    }

    def make(random: Random) -> Files:
        name = random.choice(list(bases))
        return {name: mutations.by_name(name)(random, bases[name])}

    def read(folder: Path) -> None:
        path = next(folder.iterdir())
        width, height, _ = images.size(path)
        pixels = images.to_rgba(images.read(path))
        assert pixels.shape == (height, width, 4) and np.isfinite(pixels).all()

    return Reader("image", make, read)


def palette_png(depth: int, kind: int, filtering: int) -> bytes:
    """A PNG of stored numbers, 8 x 6."""
    stride = depth  # 8 pixels
    lines = b"".join(bytes([filtering]) + bytes((7 * y + x) % 5 for x in range(stride)) for y in range(6))
    import struct
    import zlib

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", 8, 6, depth, kind, 0, 0, 0))
    colors = chunk(b"PLTE", bytes(range(256)) * 3) if kind == 3 else b""
    return b"\x89PNG\r\n\x1a\n" + head + colors + chunk(b"IDAT", zlib.compress(lines)) + chunk(b"IEND", b"")


def mask_reader() -> Reader:
    """Masks: palettes, few bits, 8 and 16 bits, colours."""
    rng = np.random.default_rng(0)
    colors = np.array([[0, 0, 0], [255, 0, 0], [0, 90, 255]], np.uint8)[
        np.repeat(np.repeat([[0, 1], [2, 1]], 4, 0), 4, 1)
    ]
    bases = [
        *(palette_png(depth, 3, filtering) for depth, filtering in ((8, 0), (8, 3), (8, 4), (4, 1), (1, 2))),
        palette_png(2, 0, 0),
        encoded(rng.integers(0, 5, (8, 8, 1)).astype(np.uint16), ".png"),
        encoded(colors, ".png"),
    ]

    def make(random: Random) -> Files:
        return {"a.png": mutations.png(random, random.choice(bases)), "b.png": random.choice(bases)}

    def read(folder: Path) -> None:
        paths = [folder / "a.png", folder / "b.png"]
        table = masks.color_table(paths)
        ids = masks.read(paths[0], table or None)
        assert ids.dtype == np.int32 and ids.ndim == 2
        masks.resize(ids, 16, 12, "a.png")

    return Reader("mask", make, read)


# Configurations, weights and runs.


def config_reader() -> Reader:
    """Configurations: TOML and ``--set``."""
    sections = config.Config().to_dict()
    lines = [
        f"[{name}]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in keys.items())
        for name, keys in sections.items()
    ]
    names = [f"{name}.{key}={json.dumps(value)}" for name, keys in sections.items() for key, value in keys.items()]

    def make(random: Random) -> Files:
        part = "\n".join(random.sample(lines, random.choice((1, 2, 5)))).encode()
        some = "\n".join(random.sample(names, 3)).encode()
        return {
            "a.toml": mutations.text(random, part) if random.random() < 0.6 else part,
            "set.txt": mutations.text(random, some) if random.random() < 0.6 else some,
        }

    def read(folder: Path) -> None:
        overrides = (folder / "set.txt").read_bytes().decode("utf-8", "surrogateescape").split("\n")
        made = config.load(folder / "a.toml", overrides)
        with as_defects():
            assert config.from_dict(json.loads(json.dumps(made.to_dict(), allow_nan=False))) == made
            json.dumps(made.to_dict(), ensure_ascii=False).encode()

    return Reader("config", make, read)


def odd_tensors(random: Random, tensors: dict[str, Any]) -> dict[str, Any]:
    """Dictionary of tensors, one of which is replaced by another kind or shape."""
    result = dict(tensors)
    name = random.choice([name for name, value in result.items() if isinstance(value, torch.Tensor)])
    value = result[name].float()
    spiked = value.clone().reshape(-1)
    if len(spiked):
        spiked[random.randrange(len(spiked))] = random.choice((float("nan"), float("inf"), 3e38, 1e19, -1e30, 1e4))
    made: list[Callable[[], Any]] = [
        lambda: value.to_sparse(),
        lambda: value.reshape(len(value), -1).to_sparse_csr() if value.ndim else value,
        lambda: torch.quantize_per_tensor(value, 0.1, 0, torch.qint8),
        lambda: value.to("meta"),
        lambda: torch.zeros(1).expand(1 << 40),
        lambda: torch.zeros(1).expand(*(value.shape or (1,))),
        lambda: torch.zeros(1).as_strided((1 << 20, 1 << 20), (0, 0)),
        lambda: value.to(torch.complex64),
        lambda: torch.nested.nested_tensor([value.reshape(-1), value.reshape(-1)]),
        lambda: torch.nn.Parameter(value),
        lambda: value.to(torch.bfloat16),
        lambda: value.to(torch.bool),
        lambda: value.double() * 1e300,
        lambda: value[:0] if value.ndim else value,
        lambda: value[None],
        lambda: value.reshape(-1)[0] if value.numel() else value,
        lambda: value.T if value.ndim == 2 else value,
        lambda: torch.cat([value, value]) if value.ndim else value,
        lambda: value[:-1] if value.ndim else value,
        lambda: value.reshape(-1),
        lambda: spiked.reshape(value.shape),
        lambda: spiked.reshape(value.shape),
        lambda: value * random.choice((0, -1, 1e10, 1e30)),
        lambda: random.choice((None, "text", 3, [1, 2], {"a": value}, 10**400)),
    ]  # fmt: skip
    kind = random.randrange(len(made) + 3)
    if kind < len(made):
        result[name] = made[kind]()
    elif kind == len(made):
        del result[name]
    elif kind == len(made) + 1:
        result[random.choice((name + ".x", "linear.99.weight", "", 5))] = value
    else:
        other = random.choice(list(result))
        result[name], result[other] = result[other], result[name]
    return result


def saved(content: Any) -> bytes:
    """The bytes of ``torch.save``."""
    stream = io.BytesIO()
    torch.save(content, stream)
    return stream.getvalue()


def changed_weights(random: Random, tensors: dict[str, Any]) -> bytes:
    """Saved tensors, changed as tensors, as a zip or as bytes."""
    if random.random() < 0.75:
        with contextlib.suppress(
            RuntimeError, NotImplementedError, TypeError
        ):  # tensors that cannot be created or saved
            return saved(odd_tensors(random, tensors))
    content = saved(tensors)
    if random.random() < 0.3:
        source, stream = zipfile.ZipFile(io.BytesIO(content)), io.BytesIO()
        with zipfile.ZipFile(stream, "w", random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as target:
            for name in source.namelist():
                data = source.read(name)
                target.writestr(name, mutations.data(random, data) if random.random() < 0.2 else data)
        return stream.getvalue()
    return (mutations.sizes if random.random() < 0.3 else mutations.data)(random, content)


def weights_reader() -> Reader:
    """State dictionaries of others."""
    tensors = foreign_runs.velocity_weights(0, 1, 4, 1, 6, 2) | {"a.weight": torch.ones(2, 3), "a.bias": torch.ones(2)}

    def read(folder: Path) -> None:
        loaded = weights.load(folder / "a.pth")
        for tensor in loaded.tensors.values():
            assert tensor.dtype == torch.float32 and torch.isfinite(tensor).all()
            tensor.contiguous().numpy()

    return Reader("weights", lambda random: {"a.pth": changed_weights(random, tensors)}, read)


def import_reader() -> Reader:
    """Run folders of others, with small networks; accepted ones are used as scenes."""
    runs: list[tuple[Files, dict[str, dict[str, Any]]]] = []

    def add(config_text: str, networks: dict[str, dict[str, Any]], identities: bool = False) -> None:
        cloud = foreign_runs.cloud(identities=identities)
        runs.append((made_in(lambda folder: foreign_runs.write_common(folder, cloud, 7, config_text)), networks))

    deform = "deform/iteration_7/deform.pth"
    velocity, code = deform.replace("deform.pth", "vel.pth"), deform.replace("deform.pth", "code_field.pth")
    small = {name: value.float() for name, value in foreign_runs.deform_weights(0, 8, 3, 63 + 30).items()}
    add("white_background=True", {})
    classifier = {"weight": torch.randn(3, 16, 1, 1), "bias": torch.zeros(3)}
    add("a=1", {"point_cloud/iteration_7/classifier.pth": classifier}, identities=True)
    add("is_blender=True", {deform: small})
    rates = {name: value.float() for name, value in foreign_runs.velocity_weights(1, 4, 8, 1, 12, 2).items()}
    add("max_time=0.7", {deform: small, velocity: rates})
    codes = {name: value.float() for name, value in foreign_runs.code_weights(2, 3).items()}
    with_codes = {name: value.float() for name, value in foreign_runs.deform_weights(3, 8, 3, 63 + 30 + 3).items()}
    bank = {name: value.float() for name, value in foreign_runs.velocity_weights(4, 1, 8, 1, 18, 2).items()}
    bank["vel_net.a_weight_bank"] = torch.zeros(3, 6)
    add("max_time=0.7", {deform: with_codes, velocity: bank, code: codes})

    def make(random: Random) -> Files:
        files, networks = random.choice(runs)
        result = {**files, **{name: saved(tensors) for name, tensors in networks.items()}}
        name = random.choice([*networks, *networks, *files])
        if name in networks:
            result[name] = changed_weights(random, networks[name])
        elif name.endswith(".ply"):
            result[name] = (mutations.text if random.random() < 0.3 else mutations.data)(random, files[name])
        else:
            result[name] = mutations.by_name(name)(random, files[name])
        return result

    def read(folder: Path) -> None:
        scene = importer.import_run(folder, importer.Options(knots=3))
        use_scene(scene, folder / "imported.r5dgs")

    return Reader("import", make, read)


def knots_reader() -> Reader:
    """``cfg_args`` of other projects, whose times determine the number of samples of a deformation."""
    files = made_in(
        lambda folder: foreign_runs.write_common(folder, foreign_runs.cloud(), 7, "max_time=0.7, is_blender=True")
    )
    networks = {
        "deform.pth": saved({n: v.float() for n, v in foreign_runs.deform_weights(0, 8, 3, 63 + 30).items()}),
        "vel.pth": saved({n: v.float() for n, v in foreign_runs.velocity_weights(1, 4, 8, 1, 12, 2).items()}),
    }
    base = {**files, **{f"deform/iteration_7/{name}": content for name, content in networks.items()}}

    def make(random: Random) -> Files:
        return base | {"cfg_args": mutations.text(random, files["cfg_args"])}

    return Reader("cfg_args", make, lambda folder: use_scene(importer.import_run(folder), folder / "imported.r5dgs"))


def checkpoint_reader() -> Reader:
    """Run folders of ours: ``run.json`` and the checkpoint, with a digest of its bytes or without."""
    from tests.core.train.test_checkpoint import STATE
    from tests.core.train.test_run_folder import dataset as owner

    with tempfile.TemporaryDirectory() as folder:
        run_folder.create_run(Path(folder), owner(), config.Config())
        checkpoint.save(Path(folder), STATE)
        files = files_in(Path(folder))
    content = torch.load(io.BytesIO(files[checkpoint.CHECKPOINT_FILE]), weights_only=True)

    def make(random: Random) -> Files:
        kind = random.randrange(4)
        if kind == 0:
            return files | {run_folder.RUN_FILE: mutations.tree(random, files[run_folder.RUN_FILE])}
        if kind == 1:
            return files | {checkpoint.CHECKPOINT_FILE: mutations.data(random, files[checkpoint.CHECKPOINT_FILE])}
        if kind == 2:
            return files | {checkpoint.CHECKPOINT_FILE: changed_weights(random, content["tensors"])}
        with contextlib.suppress(RuntimeError, NotImplementedError, TypeError):
            changed = content | {"tensors": odd_tensors(random, content["tensors"])}
            if random.random() < 0.3:
                changed[random.choice(list(content))] = random.choice(
                    (None, -1, 1e308, float("nan"), "x", [1, 2], 10**400, torch.zeros(2))
                )
            return files | {checkpoint.CHECKPOINT_FILE: saved(changed)}
        return files

    def read(folder: Path) -> None:
        run_folder.open_run(folder)
        state = checkpoint.load(folder)
        with as_defects():
            checkpoint.save(folder, state)

    return Reader("checkpoint", make, read)


def glb_reader_of_scenes() -> Reader:
    """Binary glTF files of scenes."""
    with tempfile.TemporaryDirectory() as folder:
        made = [scenes.make_scene(n=COUNT, objects=2, sh_degree=1), arms.make_arm("hinge", n=COUNT * 2)]
        paths = [Path(folder, f"{number}.glb") for number in range(len(made))]
        for scene, path in zip(made, paths, strict=True):
            list(glb.export(scene, path, registry.Options((0.0,))))
        bases = [path.read_bytes() for path in paths]

    def make(random: Random) -> Files:
        data = random.choice(bases)
        length = struct.unpack_from("<I", data, 12)[0]
        tree, rest = data[20 : 20 + length], data[20 + length :]
        if random.random() < 0.7:
            tree = mutations.tree(random, tree.rstrip())
            tree += b" " * (-len(tree) % 4)
        else:
            rest = rest[:8] + mutations.data(random, rest[8:])
        size = 20 + len(tree) + len(rest)
        return {"a.glb": data[:8] + struct.pack("<II", size % 2**32, len(tree)) + data[16:20] + tree + rest}

    def read(folder: Path) -> None:
        use_scene(glb_reader.read(folder / "a.glb"), folder / "again.r5dgs")

    return Reader("glb", make, read)


def fourdgs_reader_of_scenes() -> Reader:
    """4dgs files of scenes."""
    with tempfile.TemporaryDirectory() as folder:
        (path,) = fourdgs_file.export(rich_scene(), Path(folder, "a.4dgs"), registry.Options((0.0,)))
        base = path.read_bytes()

    def read(folder: Path) -> None:
        use_scene(fourdgs_reader.read(folder / "a.4dgs"), folder / "again.r5dgs")

    return Reader("4dgs", lambda random: {"a.4dgs": mutations.data(random, base)}, read)


def notes_reader() -> Reader:
    """JSON beside other files: configurations of encoders, and the evaluation of a scene."""
    scene = scenes.make_scene(n=COUNT)
    result = {"scene": scene.name, "splits": {"val": {"rigid": {"psnr": 31.5}}}, "train": {"gaussians": COUNT}}
    base = {
        "config.json": json.dumps({"model_type": "clip", "a": [1, 2]}).encode(),
        "evaluation.json": json.dumps(result).encode(),
    }

    def read(folder: Path) -> None:
        (folder / "scene.r5dgs").touch()
        (folder / "evaluation.json").touch()
        assert quality.measure(scene, folder / "scene.r5dgs").text()
        encoder_base.read_json(folder / "config.json")

    return Reader(
        "notes", lambda random: {name: mutations.tree(random, content) for name, content in base.items()}, read
    )


READERS: dict[str, Callable[[], Reader]] = {
    "scene": scene_reader,
    "ply": ply_reader,
    "glb": glb_reader_of_scenes,
    "4dgs": fourdgs_reader_of_scenes,
    "dataset": dataset_reader,
    "colmap": colmap_reader,
    "image": image_reader,
    "mask": mask_reader,
    "config": config_reader,
    "weights": weights_reader,
    "import": import_reader,
    "cfg_args": knots_reader,
    "checkpoint": checkpoint_reader,
    "notes": notes_reader,
    "calibration": lambda: calibration_readers.calibration_reader(made_in),
    "capture": calibration_readers.capture_reader,
}
# Share of the inputs of each reader.
SHARES = {
    "scene": 32,
    "ply": 8,
    "glb": 8,
    "4dgs": 1,
    "dataset": 8,
    "colmap": 8,
    "image": 5,
    "mask": 5,
    "config": 8,
    "weights": 5,
    "import": 4,
    "cfg_args": 2,
    "checkpoint": 4,
    "notes": 3,
    "calibration": 12,
    "capture": 2,
}
