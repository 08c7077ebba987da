"""`write_scene`: what one picture shows as OpenUSD, for path tracers such as Blender's Cycles.

`/scene` holds an Xform for each hand and object with its surfaces, `camera`, `lamp_0` to the last, `sky` for
the ambient light, and `behind`, a plane that fills the camera's view with the picture behind the hands.
The world has z up, in meters. Textures are beside the file, in a folder of its name.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from gloves.layout import MarkerLayout
from gloves.takes.take import Take
from handsim._plugins import import_extra
from handsim.errors import ArgumentError
from handsim.files.outputs import atomic_write, check_ending
from handsim.motion_files.motion import Material
from handsim.motion_files.scenes import add_mesh, save_stage
from handsim.space.camera import Camera
from handsim.space.transforms import frame_with_z, rigid
from render.config import Cameras, RenderConfig, resolve
from render.drawing import Scene, requested_pictures
from render.frames import Doubles
from render.painting.figures import Drawn
from render.painting.opengl import OPENGL_FROM_OPENCV
from render.studio import picture_behind
from render.subject import Model, subject_of

ENDINGS: Final = (".usdc", ".usda")
_FILM: Final = 0.36  # width of the film [tenths of a meter, USD's unit], that of most cameras in programs
_BEYOND: Final = 0.1  # distance of the plane behind everything else [m]
_INDEX: Final = 1.4  # index of refraction of skin (Jensen et al. 2001)

_INPUTS: Final = {
    "color": ("diffuseColor", "rgb", "sRGB"),
    "light": ("emissiveColor", "rgb", "sRGB"),
    "rough": ("roughness", "r", "raw"),
    "relief": ("normal", "rgb", "raw"),
}
"""Input of the shader, channels and color space of each kind of texture."""


def write_scene(
    path: str | Path,
    source: Take | str | Path | ArrayLike,
    *,
    frame: int | None = None,
    model: Model | tuple[Model, Model] | None = None,
    glove: MarkerLayout | str | None = None,
    camera: Cameras | None = None,
    record: Mapping[str, Any] | None = None,
    config: RenderConfig | None = None,
    **settings: Any,
) -> None:
    """Write what `draw` shows in one picture as an OpenUSD scene: skin, lamps, camera and background.

    The scene is that of the world, with z up; its lengths are in [m].

    Args:
        path: The file, .usdc or .usda; textures are written into the folder beside it that has its name.
        source: What `draw` takes.
        frame: Number of the frame, which the first camera sees.
        model: As in `draw`, as are glove, camera, config and settings.
        glove: Marker layout on the hands of your poses.
        camera: Camera of your own.
        record: A picture's record in files instead of the frame, with the rendering's configuration.
        config: What `draw` draws.
        settings: Settings of `RenderConfig` that differ from it.

    Raises:
        ArgumentError: The file's name ends otherwise, the package usd-core is missing, or the camera has a
            lens that USD cannot express.
        HandSimError: The source or the settings cannot be drawn.
    """
    path, frames = Path(path), None if frame is None else [frame]
    check_ending(path, *ENDINGS, option="path")
    config = resolve(config, settings, camera)
    subject = subject_of(source, model=model, glove=glove, seed=config.seed)
    requested = requested_pictures(subject, config, frames, record)
    name = None if record is None else record.get("camera")
    shown = requested.drawing.scenes(requested.shard, requested.numbered)
    scene = next(one for one in shown if name in (None, one.camera.name))
    if scene.camera.lens.kind != "pinhole":
        raise ArgumentError(
            f"camera '{scene.camera.name}' has a {scene.camera.lens.kind} lens, expected pinhole"
        )
    _write(path, scene)


def _write(path: Path, scene: Scene) -> None:
    Usd, UsdGeom = (import_extra(f"pxr.{one}", path.suffix, "usd") for one in ("Usd", "UsdGeom"))
    from pxr import Vt

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/scene").GetPrim())
    surfaces, moment = scene.studio.surfaces(scene.moment), scene.moment
    sides = [moment.take.hands[number].side for number in moment.hands()]
    owners = ["person", *sides, *(moment.take.bodies[number].name for number in moment.bodies())]
    for number, one in enumerate(surfaces):
        _add_surface(stage, path, owners[int(one.triangles.instances[0])], number, one)
    for side, keypoints in zip(sides, scene.studio.keypoints(moment), strict=True):
        points = UsdGeom.Points.Define(stage, f"/scene/{side}/keypoints")
        points.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(keypoints.astype(np.float32)))
        points.CreatePurposeAttr(UsdGeom.Tokens.guide)  # they are not drawn
    _add_camera(stage, scene.camera)
    _add_light(stage, scene)
    _add_behind(stage, path, scene, surfaces)
    save_stage(stage, path)


def _add_surface(stage: Any, path: Path, owner: str, number: int, one: Drawn) -> None:
    """Add a surface with its textures, or the mean color of its vertices."""
    from pxr import Sdf, Tf, UsdGeom, Vt

    triangles, material = one.triangles, one.material()
    owner = Tf.MakeValidIdentifier(owner)
    UsdGeom.Xform.Define(stage, f"/scene/{owner}")
    textured = material.texels is not None
    color = material.color * (1.0 if textured else one.colors[:, :3].mean(axis=0))
    plain = Material(f"material_{number}", tuple(color.tolist()), material.roughness)
    mesh = add_mesh(stage, f"/scene/{owner}/{owner}_{number}", triangles.vertices, triangles.faces, plain)
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(triangles.normals.astype(np.float32)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    shader = f"/scene/{owner}/{plain.name}/surface"
    if material.texels is None or one.uv is None:
        if np.ptp(one.colors, axis=0).any():
            _add_colors(stage, mesh, shader, one.colors[:, :3])
        return
    _shader(stage, shader).CreateInput("ior", Sdf.ValueTypeNames.Float).Set(_INDEX)
    _set_uv(mesh, one.uv)
    corners = one.uv[triangles.faces].astype(np.float64)
    relief = material.texels[..., 4:7].copy()
    if np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() < 0.0:  # mirrored: v points against normal x u
        relief[..., 1] = 255 - relief[..., 1]
    for name, picture in (
        ("color", material.texels[..., :3]),
        ("rough", material.texels[..., 3]),
        ("relief", relief),
    ):
        _add_texture(stage, path, shader, name, picture, f"{owner}_{name}")


def _add_colors(stage: Any, mesh: Any, surface: str, colors: NDArray[Any]) -> None:
    """Give vertices colors (V, 3), and connect them to the surface's shader."""
    from pxr import Sdf, UsdGeom, Vt

    kinds, reader = Sdf.ValueTypeNames, _shader(stage, f"{surface}/colors")
    UsdGeom.Mesh(mesh).CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(Vt.Vec3fArray.FromNumpy(colors))
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    reader.CreateInput("varname", kinds.String).Set("displayColor")
    color = _shader(stage, surface).CreateInput("diffuseColor", kinds.Color3f)
    color.ConnectToSource(reader.CreateOutput("result", kinds.Float3))


def _set_uv(mesh: Any, uv: NDArray[Any]) -> None:
    from pxr import Sdf, UsdGeom, Vt

    kind = Sdf.ValueTypeNames.TexCoord2fArray
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", kind, UsdGeom.Tokens.vertex)
    st.Set(Vt.Vec2fArray.FromNumpy(uv.astype(np.float32)))


def _shader(stage: Any, path: str) -> Any:
    from pxr import UsdShade

    return UsdShade.Shader.Define(stage, path)


def _add_texture(stage: Any, path: Path, surface: str, kind: str, picture: NDArray[Any], name: str) -> None:
    """Write a texture, and connect it to an input of a surface's shader."""
    from pxr import Gf, Sdf

    file = path.with_suffix("") / f"{name}.png"
    with atomic_write(file) as temporary:
        shown = picture if picture.ndim == 2 else picture[..., ::-1]  # OpenCV has blue first
        temporary.write_bytes(cv2.imencode(".png", np.ascontiguousarray(shown))[1].tobytes())
    target, channels, space = _INPUTS[kind]
    kinds, vector = Sdf.ValueTypeNames, channels == "rgb"
    reader, texture = _shader(stage, f"{surface}/st"), _shader(stage, f"{surface}/{kind}")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", kinds.String).Set("st")
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", kinds.Asset).Set(f"./{file.parent.name}/{file.name}")
    texture.CreateInput("sourceColorSpace", kinds.Token).Set(space)
    texture.CreateInput("st", kinds.Float2).ConnectToSource(reader.CreateOutput("result", kinds.Float2))
    if kind == "relief":
        texture.CreateInput("scale", kinds.Float4).Set(Gf.Vec4f(2.0, 2.0, 2.0, 1.0))
        texture.CreateInput("bias", kinds.Float4).Set(Gf.Vec4f(-1.0, -1.0, -1.0, 0.0))
    wanted = kinds.Normal3f if kind == "relief" else kinds.Color3f if vector else kinds.Float
    output = texture.CreateOutput(channels, kinds.Float3 if vector else kinds.Float)
    _shader(stage, surface).CreateInput(target, wanted).ConnectToSource(output)


def _add_camera(stage: Any, camera: Camera) -> None:
    """Add the camera with its projection: principal points off the middle are offsets of the film."""
    from pxr import Gf, UsdGeom

    (width, height), K = camera.size, camera.K
    unit, made = _FILM / width, UsdGeom.Camera.Define(stage, "/scene/camera")
    tall = unit * K[0, 0] / K[1, 1]  # height of a pixel on the film
    made.CreateFocalLengthAttr(float(unit * K[0, 0]))
    made.CreateHorizontalApertureAttr(float(unit * width))
    made.CreateVerticalApertureAttr(float(tall * height))
    made.CreateHorizontalApertureOffsetAttr(float(unit * (0.5 * width - K[0, 2])))
    made.CreateVerticalApertureOffsetAttr(float(tall * (K[1, 2] - 0.5 * height)))
    made.CreateClippingRangeAttr(Gf.Vec2f(0.01, 100.0))
    _set_pose(made, camera.T_world_camera @ OPENGL_FROM_OPENCV)


def _set_pose(prim: Any, pose: Doubles) -> None:
    from pxr import Gf

    prim.AddTransformOp().Set(Gf.Matrix4d(pose.T.tolist()))


def _add_light(stage: Any, scene: Scene) -> None:
    """Add far lamps, the first of which casts shadows, and even ambient light."""
    from pxr import Gf, UsdLux

    lighting = scene.conditions.lighting
    for number, lamp in enumerate(lighting.lamps):
        made = UsdLux.DistantLight.Define(stage, f"/scene/lamp_{number}")
        made.CreateAngleAttr(0.0)
        made.CreateIntensityAttr(float(np.pi * lamp.strength))
        made.CreateColorAttr(Gf.Vec3f(*lamp.color))
        UsdLux.ShadowAPI.Apply(made.GetPrim()).CreateShadowEnableAttr(number == 0)
        _set_pose(made, rigid(frame_with_z(np.array(lamp.direction)), np.zeros(3)))
    sky = UsdLux.DomeLight.Define(stage, "/scene/sky")
    sky.CreateIntensityAttr(1.0)
    sky.CreateColorAttr(Gf.Vec3f(*lighting.ambient))


def _add_behind(stage: Any, path: Path, scene: Scene, surfaces: list[Drawn]) -> None:
    """Add a plane that fills the camera's view and glows with the picture behind the hands."""
    from pxr import Sdf

    camera = scene.camera
    depth = max(float(camera.local(one.triangles.vertices)[:, 2].max()) for one in surfaces) + _BEYOND
    sides = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]]) * camera.size  # from the lower left on
    rays = np.column_stack([sides, np.ones(4)]) @ np.linalg.inv(camera.K).T
    corners = depth * rays @ camera.T_world_camera[:3, :3].T + camera.T_world_camera[:3, 3]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    mesh = add_mesh(stage, "/scene/behind", corners, faces, Material("behind_material", (0.0, 0.0, 0.0), 1.0))
    _set_uv(mesh, np.array([[0, 0], [1, 0], [1, 1], [0, 1]]))
    surface = "/scene/behind_material/surface"
    _shader(stage, surface).CreateInput("ior", Sdf.ValueTypeNames.Float).Set(1.0)  # it reflects nothing
    picture = np.rint(np.clip(picture_behind(camera, scene.conditions), 0.0, 255.0)).astype(np.uint8)
    _add_texture(stage, path, surface, "light", picture, "behind")
