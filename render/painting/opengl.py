"""Paints colors with OpenGL through pyrender and EGL, with one off-screen renderer per process."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from jaxtyping import UInt8

from handsim._plugins import EGL_PACKAGES
from handsim.errors import HandSimError
from handsim.space.transforms import frame_with_z

if TYPE_CHECKING:
    from handsim.space.camera import Camera
    from render.painting.figures import Drawn, Material
    from render.scenery.lights import Lighting

_BROKEN_PYRENDER: Final = "0.1.45"  # version that cannot draw beside NumPy 2 on Python 3.12 and later
_DEVICE_FILES: Final = ("dri/renderD*", "nvidia[0-9]*", "dxg")  # files of Mesa's, NVIDIA's and WSL's devices
_SOFTWARE_RENDERERS: Final = ("llvmpipe", "softpipe", "swrast", "software", "swiftshader")
_RENDERER_PROGRAM: Final = (
    "from render.painting.opengl import offscreen_renderer\n"
    "offscreen_renderer(16, 16)\n"
    "from OpenGL.GL import GL_RENDERER, glGetString\n"
    "print('GL_RENDERER', glGetString(GL_RENDERER).decode())\n"
)
OPENGL_FROM_OPENCV: Final = np.diag([1.0, -1.0, -1.0, 1.0])
"""Turns a camera's axes: OpenCV's x right, y down, z ahead into OpenGL's x right, y up, z back."""
_NEAR, _FAR = 0.01, 30.0  # least and largest depth that is drawn [m]
_GL_LINEAR: Final = 0x2601
_LAMP_DISTANCE: Final = 300.0  # distance at which a lamp's rays are nearly parallel [m]
_SHADOW_DEPTH: Final = 60.0  # depth of the camera that sees the shadows [scene diagonals]


def load_pyrender() -> Any:
    """The pyrender module, which draws without a screen unless PYOPENGL_PLATFORM asks for something else."""
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    try:
        import pyrender
    except ModuleNotFoundError as error:
        raise HandSimError(
            f"drawing needs pyrender, and {error}; run `pip install pyrender-maintained`"
        ) from error
    except Exception as error:  # PyOpenGL raises errors of many types
        raise _driver_error(error) from error
    if pyrender.__version__ == _BROKEN_PYRENDER:
        raise HandSimError(
            f"pyrender {_BROKEN_PYRENDER} cannot draw beside today's NumPy; run "
            "`pip uninstall pyrender pyrender-maintained`, then `pip install pyrender-maintained`"
        )
    return pyrender


def offscreen_renderer(width: int, height: int) -> Any:
    """The renderer of this process, set to a picture's size [px].

    There is one, kept until the process ends, because EGL contexts that are made again and again fail.
    """
    if not (1 <= width <= 8192 and 1 <= height <= 8192):
        raise HandSimError(f"picture size is {width} x {height}, expected 1 to 8192 pixels each way")
    renderer = _renderer_of_process(os.getpid())  # a context does not survive a fork
    renderer.viewport_width, renderer.viewport_height = width, height
    return renderer


@functools.cache
def _renderer_of_process(_process: int) -> Any:
    pyrender = load_pyrender()
    try:
        return pyrender.OffscreenRenderer(64, 64)
    except Exception as error:  # PyOpenGL raises errors of many types
        raise _driver_error(error) from error


def _driver_error(error: Exception) -> HandSimError:
    reason = " ".join(str(error).split())[:120] or type(error).__name__
    platform = os.environ["PYOPENGL_PLATFORM"]
    return HandSimError(
        f"drawing without a screen failed ({platform}: {reason}); run `apt-get install {EGL_PACKAGES}` as "
        "root or install your system's counterparts"
    )


@functools.cache
def opengl_has_hardware() -> bool:
    """Whether `render.painting.opengl` would draw on hardware; False where anything fails.

    Where there is a graphics device, another process starts OpenGL and reports its renderer, so that a broken
    driver cannot end this process.
    """
    try:
        return _some_hardware_device() and is_hardware(_renderer_name())
    except Exception:  # drivers fail in many ways; our own painter always works
        return False


def is_hardware(renderer: str) -> bool:
    """Whether a string of `GL_RENDERER` names hardware; an empty one does not."""
    name = renderer.lower()
    return bool(name) and not any(software in name for software in _SOFTWARE_RENDERERS)


def _some_hardware_device() -> bool:
    """Whether Linux lists a graphics device, or the user asks for another platform than EGL."""
    other_platform = os.environ.get("PYOPENGL_PLATFORM", "egl") != "egl"
    return other_platform or any(path for pattern in _DEVICE_FILES for path in Path("/dev").glob(pattern))


def _renderer_name() -> str:
    """`GL_RENDERER` of a new process, empty where OpenGL does not start."""
    done = subprocess.run(
        [sys.executable, "-c", _RENDERER_PROGRAM],
        capture_output=True,
        text=True,
        # A first start of pyrender from a slow disk takes some seconds.
        timeout=60.0,
        check=False,
    )
    lines = [line for line in done.stdout.splitlines() if line.startswith("GL_RENDERER ")]
    return lines[-1].removeprefix("GL_RENDERER ") if done.returncode == 0 and lines else ""


def paint_opengl(camera: Camera, drawn: Sequence[Drawn], lighting: Lighting) -> UInt8[np.ndarray, "H W 4"]:
    """Paint surfaces as `render.painting.painter.paint` does."""
    pyrender = load_pyrender()
    renderer = offscreen_renderer(*camera.size)
    scene = pyrender.Scene(bg_color=[0.0, 0.0, 0.0, 0.0])
    for one in drawn:
        primitive = pyrender.Primitive(
            positions=one.triangles.vertices,
            normals=one.triangles.normals,
            indices=one.triangles.faces,
            texcoord_0=one.uv,
            color_0=one.colors,
            material=pyrender_material(one.material()),
        )
        scene.add(pyrender.Mesh([primitive]))
    lens = pyrender.IntrinsicsCamera(*camera.K[[0, 1, 0, 1], [0, 1, 2, 2]], znear=_NEAR, zfar=_FAR)
    scene.add(lens, pose=camera.T_world_camera @ OPENGL_FROM_OPENCV)
    add_lights(pyrender, scene, lighting)
    flags = pyrender.RenderFlags
    return np.asarray(renderer.render(scene, flags=flags.RGBA | flags.SHADOWS_DIRECTIONAL)[0])


@functools.lru_cache(maxsize=16)
def pyrender_material(material: Material) -> Any:
    """A material for pyrender; cached, so that textures are uploaded once."""
    pyrender, textures = load_pyrender(), {}
    if material.texels is not None:
        # No smaller copies of the texture: they would mix tiles that are no neighbors on the hand.
        sampler = pyrender.Sampler(magFilter=_GL_LINEAR, minFilter=_GL_LINEAR)
        rough = np.zeros((*material.texels.shape[:2], 3), dtype=np.uint8)
        rough[..., 0] = material.texels[..., 3]  # the shader reads roughness from red, metal from green
        sources = {
            "baseColorTexture": np.ascontiguousarray(material.texels[..., :3]),
            "normalTexture": np.ascontiguousarray(material.texels[..., 4:7]),
            "metallicRoughnessTexture": rough,
        }
        textures = {
            name: pyrender.Texture(source=source, source_channels="RGB", sampler=sampler)
            for name, source in sources.items()
        }
    return pyrender.MetallicRoughnessMaterial(
        baseColorFactor=[*material.color, 1.0],
        metallicFactor=0.0,
        roughnessFactor=material.roughness,
        emissiveFactor=np.sqrt(material.glow * material.color),  # pyrender's shader squares it
        **textures,
    )


def add_lights(pyrender: Any, scene: Any, lighting: Lighting) -> None:
    """Light a pyrender scene that holds its meshes already; its ambient light is replaced."""
    scene.ambient_light = np.array(lighting.ambient)
    for number, lamp in enumerate(lighting.lamps):
        towards = np.array(lamp.direction) / np.linalg.norm(lamp.direction)
        pose = np.eye(4)
        color, intensity = np.array(lamp.color), np.pi * lamp.strength
        if number == 0:
            pose[:3, :3] = frame_with_z(towards)
            light = pyrender.DirectionalLight(color=color, intensity=intensity)
            _cast_shadows(pyrender, light, float(scene.scale))
        else:
            pose[:3, 3] = scene.centroid + towards * _LAMP_DISTANCE
            light = pyrender.PointLight(color=color, intensity=intensity * _LAMP_DISTANCE**2)
        scene.add(light, pose=pose)


def _cast_shadows(pyrender: Any, light: Any, extent: float) -> None:
    # pyrender's shadow bias is a fixed share of this camera's depth: a large depth makes it enough for skin.
    # Its light stands one scene diagonal away from the middle, so half a diagonal takes in everything.
    diagonal = max(extent, 1e-3)  # an empty scene has none
    light._get_shadow_camera = lambda _: pyrender.OrthographicCamera(
        xmag=0.52 * diagonal, ymag=0.52 * diagonal, znear=0.3 * diagonal, zfar=_SHADOW_DEPTH * diagonal
    )
