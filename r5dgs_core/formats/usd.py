"""Scenes as OpenUSD files: ParticleField3DGaussianSplat prims under animated Xforms (docs/reference/usd.md).

The tree is that of `glb`: one Xform per motion group at its anchor, parts below their parents, and below each group a
prim with the Gaussians of each object in it. A time code is a frame of Blender. USD interpolates linearly, so each
group has as many time samples as `linear_times` needs.

The schema is part of OpenUSD since 26.03. Its attributes are written by name, so that older versions, such as those
in Blender, write it as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .. import atomic_files, extras
from ..color import tints
from ..motion import cubic_curves, rotations
from ..playback import group_curves
from ..playback.scene_player import Player, available
from ..scene import cameras, presence
from ..scene.scene import MotionGroup, Scene
from ..scene.splats import to_opacities
from . import glb_motion, linear_times, registry, scene_nodes

EXTRA, PACKAGE = "usd", "pxr"
SCHEMA, _HARMONICS = "ParticleField3DGaussianSplat", "radiance:sphericalHarmonics"
COLOR_SPACE = "srgb_rec709_scene"
_SIGMAS = 3.0  # extent of a Gaussian
_FILM = 36.0  # width of a camera's film; only its ratio to the focal length matters
_XYZW = [1, 2, 3, 0]  # order of a Gf quaternion in memory


def export(scene: Scene, path: Path, options: registry.Options) -> Iterator[Path]:
    """Write a scene with its motion. Implements `registry.Format.write`."""
    pxr = _pxr()
    stage = build(scene, options)
    with registry.writing(path, (pxr.Tf.ErrorException,)), atomic_files.replacing_by_name(path) as temporary:
        if not stage.GetRootLayer().Export(str(temporary)):
            raise OSError("OpenUSD failed")
    yield path


def build(scene: Scene, options: registry.Options) -> Any:
    """Content of a file, as a ``Usd.Stage``. Raises ConfigError if no Gaussian is selected."""
    pxr = _pxr()
    pieces = scene_nodes.pieces(scene, options.object_ids)
    end = scene_nodes.end(scene, options)
    stage = pxr.Usd.Stage.CreateInMemory(f"{scene.name}.usda")
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.z)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, scene.units.meters_per_unit or 1.0)
    rate = scene.frames_per_unit / glb_motion.seconds_per_unit(scene.units)
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(code(scene, float(scene.tracks.times[0])))
    stage.SetEndTimeCode(code(scene, end))
    tree = _Tree(scene, stage, end)
    notes = {"t_max": float(scene.t_max), "t_max_time_code": code(scene, scene.t_max)}
    notes |= {"metersKnown": scene.units.meters_per_unit is not None, "origin": str(scene.origin.tolist())}
    stage.GetRootLayer().customLayerData = {"r5dgs": notes}
    factors = Player(scene).frame(scene.t_max).shading_factor
    for piece in pieces:
        tree.add_gaussians(piece, factors)
    for number, camera in enumerate(scene.cameras):
        tree.add_camera(camera, camera.name or str(number))
    return stage


def _pxr() -> Any:
    """Package of OpenUSD with the modules that are used here."""
    with extras.required("USD files", EXTRA):
        import pxr
        from pxr import Gf, Sdf, Tf, Usd, UsdGeom, Vt  # noqa: F401
    return pxr


def code(scene: Scene, t: float) -> float:
    """Time code of a scene time: the frame of Blender."""
    return float(t * scene.frames_per_unit + 1)


class _Tree:
    """Prims of a stage in the making.

    Args:
        scene: The scene.
        stage: An empty ``Usd.Stage``.
        end: Last scene time.
    """

    def __init__(self, scene: Scene, stage: Any, end: float):
        pxr = _pxr()
        self._scene, self._stage, self._end = scene, stage, end
        self._names, self._reaches = scene_nodes.group_names(scene), group_curves.reaches(scene)
        self._used: set[str] = set()
        self._groups: dict[int, str] = {}
        self._root = self._place("", scene.name)
        root = pxr.UsdGeom.Xform.Define(stage, self._root)
        turn = rotations.rotmats_to_quats(cameras.WORLD_TO_BLENDER[scene.world_convention])
        root.AddOrientOp(pxr.UsdGeom.XformOp.PrecisionDouble).Set(pxr.Gf.Quatd(*turn.tolist()))
        root.GetPrim().SetDisplayName(scene.name)
        stage.SetDefaultPrim(root.GetPrim())

    def _place(self, parent: str, name: str) -> str:
        """Unused path of a prim below another one."""
        pxr = _pxr()
        first = pxr.Tf.MakeValidIdentifier(name) if name else "_"
        path, count = f"{parent}/{first}", 1
        while path in self._used:
            count += 1
            path = f"{parent}/{first}_{count}"
        self._used.add(path)
        return path

    def _group(self, group: MotionGroup) -> str:
        """Path of a group's Xform, made with its parents and keys if it is new."""
        pxr = _pxr()
        if group.id not in self._groups:
            above = self._root if group.parent is None else self._group(self._scene.groups[group.parent])
            path = self._groups[group.id] = self._place(above, self._names[group.id])
            form = pxr.UsdGeom.Xform.Define(self._stage, path)
            prim = form.GetPrim()
            prim.SetDisplayName(self._names[group.id])
            prim.SetCustomDataByKey("r5dgs:group", group.id)
            prim.SetCustomDataByKey("r5dgs:role", group.role)
            self._add_keys(form, group)
            self._add_band(prim, group)
        return self._groups[group.id]

    def _add_keys(self, form: Any, group: MotionGroup) -> None:
        pxr = _pxr()
        scene, home = self._scene, glb_motion.home(self._scene.groups, group)
        place = form.AddTranslateOp(pxr.UsdGeom.XformOp.PrecisionDouble)
        turn = form.AddOrientOp(pxr.UsdGeom.XformOp.PrecisionDouble)
        place.Set(pxr.Gf.Vec3d(*home.tolist()))
        turn.Set(pxr.Gf.Quatd(1))
        if group.id == 0:
            return
        reach = float(self._reaches[group.id])
        curves = group_curves.curves(scene, group.id, self._end, reach)

        def sample(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            quats = cubic_curves.evaluate(curves.rotation, times, unit=True)
            return quats, cubic_curves.evaluate(curves.location, times) + home

        first = np.union1d(curves.location.times, curves.rotation.times)
        times = linear_times.refine(sample, first, linear_times.TOLERANCE * scene.extent, reach)
        quats, places = sample(times)
        if not (np.ptp(quats, axis=0).any() or np.ptp(places, axis=0).any()):
            return
        for t, q, p in zip(times.tolist(), quats.tolist(), places.tolist(), strict=True):
            place.Set(pxr.Gf.Vec3d(*p), code(scene, t))
            turn.Set(pxr.Gf.Quatd(*q), code(scene, t))

    def _add_band(self, prim: Any, group: MotionGroup) -> None:
        pxr = _pxr()
        band = group.history.band
        if band is None:
            return
        prim.SetCustomDataByKey("r5dgs:bandLevel", band.level)
        for name, values in (("bandHalfWidth", band.half_width), ("bandHalfAngle", band.half_angle)):
            attribute = prim.CreateAttribute(f"r5dgs:{name}", pxr.Sdf.ValueTypeNames.Double)
            for t, value in zip(band.times, values, strict=True):
                attribute.Set(float(value), code(self._scene, t))

    def add_gaussians(self, piece: scene_nodes.NodePiece, factors: np.ndarray | None) -> None:
        """Add the Gaussians of a piece; those that bend are a prim of their own, with time samples.

        Args:
            piece: The piece.
            factors: Factor on the colour of each Gaussian of the scene at t_max, or None. [N]
        """
        scene = self._scene
        item, above = scene.object(piece.object_id), self._group(scene.groups[piece.group])
        rows = np.arange(piece.rows.start, piece.rows.stop)
        bending = np.isin(rows, () if scene.residuals is None else scene.residuals.rows)
        for chosen, name in ((rows[~bending], f"{item.name} Gaussians"), (rows[bending], f"{item.name} bending")):
            if len(chosen):
                prim = self._define(self._place(above, name), chosen, scene.groups[piece.group].home, factors)
                prim.SetDisplayName(name)
                prim.SetCustomDataByKey("r5dgs:object", item.id)
                prim.SetCustomDataByKey("r5dgs:name", item.name)
                prim.SetCustomDataByKey("r5dgs:aliases", ", ".join(item.aliases))
                self._add_absence(prim, scene.groups[piece.group])

    def _add_absence(self, prim: Any, group: MotionGroup) -> None:
        """Make the Gaussians of a group invisible while it is absent; its parts stay visible."""
        pxr, start = _pxr(), float(self._scene.tracks.times[0])
        if group.absent:
            shown = prim.CreateAttribute("visibility", pxr.Sdf.ValueTypeNames.Token, False)
            for t in (start, *(t for interval in group.absent for t in interval if start < t < self._end)):
                shown.Set("invisible" if presence.is_absent(group.absent, t) else "inherited", code(self._scene, t))

    def _define(self, path: str, rows: np.ndarray, home: np.ndarray, factors: np.ndarray | None) -> Any:
        pxr = _pxr()
        gaussians, sh = self._scene.gaussians, self._scene.gaussians.sh[rows]
        if factors is not None:
            sh = tints.tint_sh(sh, factors[rows, None])
        prim, types = self._stage.DefinePrim(path, SCHEMA), pxr.Sdf.ValueTypeNames
        opacities = pxr.Vt.FloatArray.FromNumpy(_floats(to_opacities(gaussians.opacity_logits[rows])))
        prim.CreateAttribute("opacities", types.FloatArray, False).Set(opacities)
        coefficients = prim.CreateAttribute(f"{_HARMONICS}Coefficients", types.Float3Array, False)
        coefficients.Set(pxr.Vt.Vec3fArray.FromNumpy(_floats(sh.reshape(-1, 3))))
        coefficients.SetColorSpace(COLOR_SPACE)
        uniform = pxr.Sdf.VariabilityUniform
        degree = int(np.sqrt(sh.shape[1])) - 1
        prim.CreateAttribute(f"{_HARMONICS}Degree", types.Int, False, uniform).Set(degree)
        prim.CreateAttribute("projectionModeHint", types.Token, False, uniform).Set("perspective")
        prim.CreateAttribute("sortingModeHint", types.Token, False, uniform).Set("zDepth")
        means, quats = (values[rows].astype(np.float64) for values in (gaussians.means, gaussians.quats))
        _set_shape(prim, means - home, quats, gaussians.log_scales[rows].astype(np.float64), None)
        residuals = self._scene.residuals
        if residuals is not None and len(found := np.flatnonzero(np.isin(residuals.rows, rows))):
            for k, t in enumerate(self._scene.tracks.times.tolist()):
                moved = means - home + residuals.offsets[found, k]
                turned = rotations.multiply(residuals.quats[found, k].astype(np.float64), quats)
                log_scales = gaussians.log_scales[rows] + residuals.log_scales[found, k]
                _set_shape(prim, moved, turned, log_scales, code(self._scene, t))
        return prim

    def add_camera(self, camera: cameras.Camera, name: str) -> None:
        """Add a captured camera with its lens and principal point."""
        pxr = _pxr()
        made = pxr.UsdGeom.Camera.Define(self._stage, self._place(self._root, f"camera {name}"))
        made.GetPrim().SetDisplayName(f"camera {name}")
        pose = cameras.cam_world_to_opengl(camera.T_cam_world)
        made.AddTransformOp().Set(pxr.Gf.Matrix4d(pose.T.tolist()))  # of row vectors
        fx, fy, cx, cy = (float(camera.intrinsics[k]) for k in ((0, 0), (1, 1), (0, 2), (1, 2)))
        film = _FILM / camera.width  # length of a pixel's width
        made.CreateFocalLengthAttr(fx * film)
        made.CreateHorizontalApertureAttr(_FILM)
        made.CreateVerticalApertureAttr(camera.height * film * fx / fy)
        made.CreateHorizontalApertureOffsetAttr((camera.width / 2 - cx) * film)
        made.CreateVerticalApertureOffsetAttr((cy - camera.height / 2) * film * fx / fy)
        near = float(self._scene.near_plane)
        made.CreateClippingRangeAttr(pxr.Gf.Vec2f(near, max(1e6 * near, 100 * self._scene.extent)))


def _set_shape(prim: Any, means: np.ndarray, quats: np.ndarray, log_scales: np.ndarray, time: float | None) -> None:
    """Set positions, rotations, sizes and extent at a time code, or their default."""
    pxr = _pxr()
    scales, when = np.exp(log_scales), pxr.Usd.TimeCode.Default() if time is None else pxr.Usd.TimeCode(time)
    turns = _floats(rotations.normalize(quats)[:, _XYZW])
    border = _SIGMAS * scales.max(-1, keepdims=True)
    corners = np.stack([(means - border).min(0), (means + border).max(0)])
    types, vectors = pxr.Sdf.ValueTypeNames, pxr.Vt.Vec3fArray
    for name, kind, values in (
        ("positions", types.Point3fArray, vectors.FromNumpy(_floats(means))),
        ("orientations", types.QuatfArray, pxr.Vt.QuatfArray.FromNumpy(turns)),
        ("scales", types.Float3Array, vectors.FromNumpy(_floats(scales))),
        ("extent", types.Float3Array, vectors.FromNumpy(_floats(corners))),
    ):
        prim.CreateAttribute(name, kind, False).Set(values, when)


def _floats(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float32)


def losses(scene: Scene, options: registry.Options) -> list[str]:
    """Parts of this scene that a file does not hold, as sentences."""
    found = []
    if available(scene, "standard"):
        found.append("motion of single Gaussians past t_max (modes standard and hybrid)")
    if scene.shading is not None:
        found.append("colours other than those of t_max")
    if len(scene.background_sh) > 1 or scene.background_sh.any():
        found.append("the sky")
    if scene.gaussians.identities is not None:
        found.append("identity encodings and their classifier")
    if scene.embeddings is not None:
        found.append("embeddings and stored words")
    return found


FORMAT = registry.Format(
    name="usd",
    label="OpenUSD",
    suffix=".usd",
    keeps="objects and parts as animated Xforms, Gaussians with harmonics and bending, cameras, names, bands",
    loses="changing shading, sky, modes other than rigid, motion models, encodings, embeddings, provenance",
    write=export,
    has_motion=True,
    losses=losses,
    extra=EXTRA,
    packages=(PACKAGE,),
)
