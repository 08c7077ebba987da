"""Backgrounds: plain, gradient, room or photograph; none of them looks like a hand.

A background is a few plain values and a seed, so that drawing it again gives the same picture. Several
cameras see a background that has a position in the world: a room with furniture, or a box with a picture on
each wall.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal, get_args

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int8, UInt8
from numpy.typing import NDArray

from handsim._checks import check_choice
from handsim.errors import FileError, HandSimError, HandSimWarning, choices
from handsim.kernels import kernel
from handsim.settings import Spelled
from handsim.space.camera import Camera, camera_matrix
from render.color_sensor import GAMMA
from render.frames import Bytes, Doubles, Flags, Floats, Geometry, at_rest, triple
from render.photographs import PHOTO_SUFFIXES, check_photograph, is_map, read_map, read_photograph
from render.scenery.rooms import RoomLight, cast_room, draw_room, paint_tints, smooth_edges

BackgroundKind = Literal["plain", "gradient", "room", "photo"]
KINDS: Final[tuple[BackgroundKind, ...]] = get_args(BackgroundKind)
LUMINANCE: Final = np.array([0.2126, 0.7152, 0.0722])
_MAP_LIGHT: Final = 0.5  # mean luminance of a map, 1 for a white surface in full light
_MAX_UNREADABLE: Final = 50  # unreadable files after which a folder counts as one without photographs
SHARE: Final = 0.6
"""Share of the plain backgrounds that catch shadows; the others are too far away."""
_GAP_RANGE: Final = (0.02, 0.35)  # range of a backdrop's distance from the hands [m]
_FAR_RATIO: Final = 8.0  # distance of a backdrop without shadows over that of one with them
_MAX_SLOPE: Final = 0.35  # largest slope of a backdrop against the picture's plane
_SOFTNESS_RANGE: Final = (0.03, 0.25)  # range of shadows' softness, from that of a bare bulb to a window's
_USUAL_SHARES: Final = {"plain": 0.25, "gradient": 0.25, "room": 0.5}
_CLOSE_KINDS: Final = ("plain", "gradient")  # kinds that may be as near as a wall or a table
_COARSE_KINDS: Final = ("gradient", "room")  # kinds that are out of focus, drawn at half the resolution
_WALL_DISTANCE: Final = (0.8, 2.2)  # range of the distance of a wall from the outermost camera or hand [m]
_FURNITURE_DISTANCE: Final = 0.5  # distance of furniture from the box around hands and cameras [m]
_WALL_SIZE: Final = 512  # width and height of a wall's picture [px]
_LAMP_SHARE: Final = 0.95  # distance of a room's lamp from the middle over that of the wall
_REMAP_ROWS: Final = 2**14  # pixels that one call of `remap` fills; it takes at most 32767 rows
_LEAST_BLUR: Final = 0.3  # least blur that is drawn [px]
_SAME_SURFACE: Final = 0.03  # share by which 1 / depth may differ inside a pixel of a coarse picture
_LEAST_COMPONENT: Final = 1e-6  # least component of a ray, so that it meets a wall along each axis


@functools.lru_cache(maxsize=2)
def photo_files(folder: Path) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Photographs in a folder and its subfolders, and a sentence on each file that does not begin as one."""
    if not folder.is_dir():
        what = "a file, expected a" if folder.exists() else "no such"
        raise HandSimError(f"{folder}: {what} folder of photographs")
    good, broken = list[Path](), list[str]()
    for file in sorted(file for file in folder.rglob("*") if file.suffix.lower() in PHOTO_SUFFIXES):
        try:
            check_photograph(file)
            good.append(file)
        except FileError as error:
            broken.append(str(error))
    if not good:
        raise _no_photo_error(folder, broken)
    return tuple(good), tuple(broken)


def pick_photo(folder: Path, rng: np.random.Generator) -> Path:
    """Pick a random photograph that can be read whole."""
    files, broken = photo_files(folder)
    chosen = (files[index] for index in rng.permutation(len(files))[:_MAX_UNREADABLE])
    found: Path | None = next(filter(_can_be_read, chosen), None)
    if found is None:
        raise _no_photo_error(folder, broken)
    return found


def _can_be_read(file: Path) -> bool:
    """Whether a photograph can be read whole; a warning tells why one cannot."""
    try:
        (environment_map if is_map(file) else read_photograph)(file)
    except FileError as error:
        warnings.warn(f"left out: {error}", HandSimWarning, stacklevel=2)
        return False
    return True


@functools.lru_cache(maxsize=4)
def environment_map(file: Path) -> Float32[np.ndarray, "H W 3"]:
    """Linear light of an environment map, its mean luminance `_MAP_LIGHT`."""
    light = read_map(file)
    share = np.sin(np.pi * (np.arange(len(light)) + 0.5) / len(light))
    mean = np.average(light.mean(axis=1), axis=0, weights=share) @ LUMINANCE
    return np.asarray(light * np.float32(_MAP_LIGHT / mean))


def _cast_in_map(background: Background, rays: Floats, *, coarse: bool = False) -> RoomLight:
    """Light of an environment map, or of a `coarse` copy of it, along rays (N, 3); a map has no depth."""
    whole = environment_map(Path(str(background.photo)))
    if coarse:  # few rays would miss small lamps
        whole = cv2.resize(whole, (64, 32), interpolation=cv2.INTER_AREA)
    x, y, z = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).T
    azimuth = np.random.default_rng(background.seed).random()
    across = (azimuth - np.arctan2(y, x) / (2.0 * np.pi)) % 1.0
    places = np.stack([across, np.arccos(np.clip(z, -1.0, 1.0)) / np.pi], axis=1)
    light = _sample_wrapped(whole, places * whole.shape[1::-1] - 0.5)
    nothing = np.zeros(len(rays), np.float32)
    return RoomLight(light, nothing, nothing.astype(np.int8))


def _sample_wrapped(picture: NDArray[Any], places: NDArray[Any]) -> NDArray[Any]:
    """Colors (N, C) at columns and rows (N, 2) [px] of a picture, which wraps around at its borders."""
    parts = np.array_split(places.astype(np.float32)[:, None], range(_REMAP_ROWS, len(places), _REMAP_ROWS))
    return np.concatenate(
        [cv2.remap(picture, part, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)[:, 0] for part in parts]
    )


def photos_beside(file: Path, count: int) -> list[Path]:
    """A photograph and others of its folder, `count` in all; they are repeated if there are too few."""
    files, _ = photo_files(file.parent)
    start = files.index(file) + 1 if file in files else 0
    others = (one for one in (*files[start:], *files[:start]) if one != file and _can_be_read(one))
    chosen = [file, *itertools.islice(others, count - 1)]
    return list(itertools.islice(itertools.cycle(chosen), count))


def _no_photo_error(folder: Path, broken: Sequence[str]) -> HandSimError:
    endings = ", ".join(PHOTO_SUFFIXES)
    first = f" ({broken[0]})" if broken else ""
    return HandSimError(
        f"{folder}: no photograph that can be read{first}; expected files that end in {endings}"
    )


def draw_photo(file: Path, size: tuple[int, int], rng: np.random.Generator) -> Floats:
    """A random part of a photograph, at least half as large as the largest, scaled to a picture's size."""
    photo = read_photograph(file)
    height, width = photo.shape[:2]
    scale = min(width / size[0], height / size[1]) * rng.uniform(0.5, 1.0)
    part = np.maximum(np.array(size) * scale, 1.0).astype(int)
    left, top = (int(rng.integers(0, room + 1)) for room in np.array([width, height]) - part)
    cut = photo[top : top + part[1], left : left + part[0]]
    method = cv2.INTER_AREA if part[0] > size[0] else cv2.INTER_LINEAR
    scaled = cv2.resize(np.ascontiguousarray(cut), size, interpolation=method)
    return np.asarray((scaled.astype(np.float32) / 255.0) ** GAMMA)


@dataclass(frozen=True, slots=True)
class Backdrop:
    """A plane behind the hands: a wall or a table."""

    gap: float  # distance from the nearest point of the hands [m]
    recedes: tuple[float, float] = (0.0, 0.0)  # slopes to the right and downwards
    softness: float = 0.1  # tangent of half the angle under which the plane sees the lamp
    level: float | None = None
    """Position along its normal in the camera's axes [m]; None: the gap is from the hands of each picture."""
    shadows: bool = True  # whether it catches the hands' shadows, or is too far away for them
    arms: float | None = None
    """Level behind the arms of all frames [m]; depth shows the backdrop at the lower of both levels."""

    def behind(self, nearest: float) -> float:
        """Level of the backdrop [m]; `nearest` is the hands' least position along its normal [m]."""
        return nearest - self.gap if self.level is None else self.level

    @property
    def normal(self) -> Float[np.ndarray, "3"]:
        """Unit normal in the camera's axes, towards the camera."""
        return np.asarray(np.array([*self.recedes, -1.0]) / np.linalg.norm([*self.recedes, 1.0]))


_DISTANT_WALL: Final = Backdrop(0.4, shadows=False)


def sample_backdrop(*, rng: np.random.Generator) -> Backdrop:
    """Draw a random backdrop."""
    gap = float(np.exp(rng.uniform(*np.log(_GAP_RANGE))))
    right, down = rng.uniform(-_MAX_SLOPE, _MAX_SLOPE, 2)
    softness = float(np.exp(rng.uniform(*np.log(_SOFTNESS_RANGE))))
    shadows = bool(rng.random() < SHARE)
    gap *= 1.0 if shadows else _FAR_RATIO
    return Backdrop(gap, (float(right), float(down)), softness, shadows=shadows)


@dataclass(frozen=True, slots=True)
class Backgrounds:
    """Which kinds of background are drawn, and how often each.

    Raises:
        HandSimError: A kind is unknown, a share is negative, none is positive, or photographs are asked for
            without a folder.
    """

    shares: Annotated[Mapping[str, float], Spelled(tuple[BackgroundKind, ...], (), "background")] = field(
        default_factory=lambda: dict(_USUAL_SHARES), hash=False
    )
    """Kinds of background: plain, gradient, room, photo. Names have equal shares; a mapping has the share of
    each, of any sum, and beside them maybe `photos`; a kind that is not named has none. When none is given, a
    mixture of the first three, or photographs alone where there is a folder of them."""
    photos: Annotated[str | None, Spelled(Path | None)] = None
    """Folder of photographs, its subfolders included."""

    def __post_init__(self) -> None:
        given = (self.shares,) if isinstance(self.shares, str) else self.shares
        shares: dict[str, Any] = dict(given) if isinstance(given, Mapping) else dict.fromkeys(given, 1.0)
        object.__setattr__(self, "photos", shares.pop("photos", self.photos))
        shares = shares.get("shares", shares)  # as records have them
        if not shares:
            shares = dict(_USUAL_SHARES) if self.photos is None else {"photo": 1.0}
        for kind in shares:
            check_choice(kind, KINDS, noun="background")
        every = {kind: float(shares.get(kind, 0.0)) for kind in KINDS}
        if min(every.values()) < 0.0 or not sum(every.values()) > 0.0:
            raise HandSimError(f"shares of backgrounds are {shares}, expected none negative and one positive")
        if every["photo"] > 0.0 and self.photos is None:
            raise HandSimError("backgrounds of photographs need `photos`, the folder they lie in (--photos)")
        if every["photo"] == 0.0 and self.photos is not None:
            raise HandSimError(f"photos is {self.photos}, expected the background photo (--background photo)")
        object.__setattr__(self, "shares", every)
        object.__setattr__(self, "photos", None if self.photos is None else str(self.photos))


@dataclass(frozen=True, slots=True)
class Background:
    """One background in plain values."""

    kind: BackgroundKind
    colors: tuple[tuple[float, float, float], tuple[float, float, float]]
    """Linear colors; not used by rooms and photographs."""
    seed: int
    blur: float = 0.0  # standard deviation of its blur, in picture heights
    photo: str | None = None  # the photograph's file
    backdrop: Backdrop = _DISTANT_WALL
    """Plane behind the hands of one camera; nothing in a room is nearer than it."""

    @property
    def is_map(self) -> bool:
        """Whether it is an environment map, which lights the hands, too."""
        return self.photo is not None and is_map(Path(self.photo))


def sample_background(config: Backgrounds, *, rng: np.random.Generator) -> Background:
    """Draw a random background."""
    shares = np.array(list(config.shares.values()))
    kind = KINDS[int(rng.choice(len(KINDS), p=shares / shares.sum()))]
    first, second = _color(rng), _color(rng)
    blur = float(rng.uniform(0.0, 0.01)) if kind in ("room", "photo") else 0.0
    photo = str(pick_photo(Path(str(config.photos)), rng)) if kind == "photo" else None
    backdrop = sample_backdrop(rng=rng) if kind in _CLOSE_KINDS else _DISTANT_WALL
    return Background(kind, (first, second), int(rng.integers(2**31)), blur, photo, backdrop)


def draw_background(background: Background, size: tuple[int, int]) -> Float32[np.ndarray, "H W 3"]:
    """Draw the picture (H, W, 3) in linear light, 1 for full white."""
    return enlarged(_paint_coarse(background, size), size)


def enlarged(picture: Float32[np.ndarray, "h w 3"], size: tuple[int, int]) -> Float32[np.ndarray, "H W 3"]:
    """A picture of `kept_background`, or of its display values, at the whole size."""
    if picture.shape[1::-1] == size:
        return picture
    whole: Floats = cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC)
    return np.clip(whole, 0.0, picture.max(), out=whole)


@functools.lru_cache(maxsize=2)  # each is used twice: for its light, and behind the hands
def kept_background(background: Background, size: tuple[int, int]) -> Float32[np.ndarray, "h w 3"]:
    """The picture of `draw_background` before it is `enlarged`, read-only."""
    picture = _paint_coarse(background, size)
    picture.setflags(write=False)
    return picture


def _paint_coarse(background: Background, size: tuple[int, int]) -> Floats:
    """Paint the picture of `draw_background`, at half its size for the kinds of `_COARSE_KINDS`."""
    rng = np.random.default_rng(background.seed)
    first, second = (np.array(color, dtype=np.float32) for color in background.colors)
    halved = (max(2, size[0] // 2), max(2, size[1] // 2))
    drawn_size = halved if background.kind in _COARSE_KINDS else size
    width, height = drawn_size
    if background.kind == "plain":
        picture = np.broadcast_to(first, (height, width, 3)).copy()
    elif background.kind == "gradient":
        picture = _gradient(first, second, drawn_size, rng)
    elif background.kind == "room":
        picture = draw_room(drawn_size, background.seed).light
    elif background.kind == "photo":
        picture = draw_photo(Path(str(background.photo)), size, rng)
    else:
        raise HandSimError(choices(background.kind, KINDS, noun="background"))
    if background.blur * height > _LEAST_BLUR:
        picture = cv2.GaussianBlur(picture, (0, 0), background.blur * height)
    return np.asarray(np.clip(picture, 0.0, 1.0, dtype=np.float32))


def _color(rng: np.random.Generator) -> tuple[float, float, float]:
    """Draw the linear color of a wall or a cloth, more often gray than strong."""
    gray = rng.uniform(0.12, 0.95) ** GAMMA
    return triple(np.clip(gray * np.exp(paint_tints(rng, 1)[0]), 0.003, 0.95))


def _gradient(first: Floats, second: Floats, size: tuple[int, int], rng: np.random.Generator) -> Floats:
    angle = rng.uniform(0.0, 2.0 * np.pi)
    x = np.linspace(-1.0, 1.0, size[0], dtype=np.float32) * np.float32(np.cos(angle))
    y = np.linspace(-1.0, 1.0, size[1], dtype=np.float32) * np.float32(np.sin(angle))
    share = (x[None, :] + y[:, None])[..., None]
    share = 0.5 + 0.5 * share / np.abs(share).max()
    return np.asarray(first + share * (second - first))


Corner = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Enclosure:
    """A box that holds everything, in the world's axes, z up."""

    low: Corner  # [m]
    high: Corner
    free: tuple[Corner, Corner]  # low and high corner of the inner box of hands and cameras [m]
    lamp: Corner  # position of a room's lamp, which is the first lamp of the hands [m]


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """The picture, depth and normals that one camera has behind hands and objects."""

    depth: Float32[np.ndarray, "H W"]  # along the camera's axis [m]; 0 for what is not ahead
    walls: Int8[np.ndarray, "H W"]  # number of each pixel's normal
    facing: Float32[np.ndarray, "N 3"]  # these unit normals in the camera's axes
    rgb: NDArray[Any] = field(default_factory=lambda: np.empty((0, 0, 3), np.uint8))
    """sRGB (H, W, 3) as bytes or, if bright, as levels that may exceed 255; 0 where the lens sees nothing."""

    def put_behind(self, pictures: Geometry) -> None:
        """Write depth and normals where pictures of hands and objects have none."""
        none = np.empty((*pictures.depth.shape, 0), np.float32)
        normals = none if pictures.normals is None else pictures.normals
        _put_behind(pictures.instances, self.depth, self.walls, self.facing, pictures.depth, normals)


def _both_normals(axes: NDArray[Any]) -> Floats:
    """Unit normals (6, 3) along and against each column of a matrix (3, 3)."""
    unit = (axes / np.linalg.norm(axes, axis=0)).T
    return np.stack([unit, -unit], axis=1).reshape(6, 3).astype(np.float32)


def surroundings_of_picture(background: Background, camera: Camera, level: float) -> Surroundings:
    """Depth and normals of the wall, or the room, that a background's picture shows to a pinhole camera.

    The wall has this level along the backdrop's normal [m]; nothing in a room is nearer. A room's picture has
    a camera of its own; for another camera the room is larger, and maybe sheared.
    """
    (width, height), normal = camera.size, background.backdrop.normal
    if background.kind != "room":
        way = (normal @ np.linalg.inv(camera.K)).astype(np.float32)
        across, down = (np.arange(side, dtype=np.float32) + np.float32(0.5) for side in camera.size)
        along = way[0] * across + (way[1] * down + way[2])[:, None]
        depth = np.divide(np.float32(level), along, out=np.zeros_like(along), where=along < 0.0)
        return Surroundings(depth, np.zeros(along.shape, np.int8), normal[None].astype(np.float32))
    room = draw_room((max(2, width // 2), max(2, height // 2)), background.seed)
    nearness = 1.0 / (max(1.0, -level / float(room.depth.min())) * room.depth)
    smooth = cv2.resize(nearness, camera.size, interpolation=cv2.INTER_LINEAR)  # exact for planes
    nearest = cv2.resize(nearness, camera.size, interpolation=cv2.INTER_NEAREST)
    walls = cv2.resize(room.walls, camera.size, interpolation=cv2.INTER_NEAREST)
    np.copyto(smooth, nearest, where=cv2.absdiff(smooth, nearest) > _SAME_SURFACE * nearest)
    depth = np.reciprocal(smooth, out=smooth)
    own = camera_matrix(room.focal * height, room.focal * height, 0.5 * width, 0.5 * height)
    return Surroundings(depth, walls, _both_normals(np.linalg.solve(own, camera.K).T @ room.rotation))


@kernel
def _put_behind(
    instances: Bytes, behind: Floats, walls: NDArray[np.int8], facing: Floats, depth: Floats, normals: Floats
) -> None:
    """Write depth (H, W) and normals (H, W, 3 or 0) of the walls where there is neither."""
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            if instances[row, column] == 0 and depth[row, column] == 0.0 and behind[row, column] > 0.0:
                depth[row, column] = behind[row, column]
                if normals.shape[2]:
                    for axis in range(3):
                        normals[row, column, axis] = facing[walls[row, column], axis]


def enclose(
    positions: Float[np.ndarray, "N 3"], seed: int, towards_lamp: Float[np.ndarray, "3"]
) -> Enclosure:
    """Draw a random box around cameras and hands, with its lamp in this direction from their middle."""
    below, above = np.random.default_rng([seed, 0]).uniform(*_WALL_DISTANCE, (2, 3))
    low, high = positions.min(axis=0), positions.max(axis=0)
    free = triple(low - _FURNITURE_DISTANCE), triple(high + _FURNITURE_DISTANCE)
    middle = 0.5 * (low + high)
    low, high, towards = low - below, high + above, _without_zeros(towards_lamp)
    way = (np.where(towards > 0.0, high - middle, low - middle) / towards).min()
    return Enclosure(triple(low), triple(high), free, triple(middle + _LAMP_SHARE * way * towards))


def _without_zeros(rays: NDArray[Any]) -> NDArray[Any]:
    """Replace zeros of rays (..., 3), so that each ray meets a wall along each axis."""
    return np.where(np.abs(rays) < _LEAST_COMPONENT, np.asarray(_LEAST_COMPONENT, rays.dtype), rays)


def light_in(
    background: Background, enclosure: Enclosure, directions: Float[np.ndarray, "D 3"]
) -> Float[np.ndarray, "D 3"]:
    """Linear light that reaches the middle of the inner box from these directions."""
    rays, eye = _without_zeros(directions.astype(np.float32)), np.mean(enclosure.free, axis=0)
    if background.is_map:
        return _cast_in_map(background, rays, coarse=True).light
    if background.kind == "room":
        return np.asarray(np.clip(_cast_in_room(background, enclosure, eye, rays).light, 0.0, 1.0))
    return (_cast_at_walls(background, enclosure, eye, rays)[0] / np.float32(255.0)) ** np.float32(GAMMA)


def _cast_in_room(background: Background, enclosure: Enclosure, eye: Doubles, rays: Floats) -> RoomLight:
    """Cast rays (N, 3) from an eye in the world [m] into a room with furniture."""
    low = np.array(enclosure.low)
    free, lamp = np.array(enclosure.free) - low, np.array(enclosure.lamp) - low
    rng = np.random.default_rng([background.seed, 1])
    return cast_room(rays, eye - low, np.array(enclosure.high) - low, free, lamp, rng=rng)


def _cast_at_walls(
    background: Background, enclosure: Enclosure, eye: Doubles, rays: Floats
) -> tuple[Bytes, Floats, NDArray[np.int8]]:
    """Colors (N, 3) in sRGB, distances (N,) [m] and walls (N,) that rays (N, 3) meet in an empty room."""
    distances, places = np.empty(len(rays), np.float32), np.empty((len(rays), 2), np.float32)
    walls, low = np.empty(len(rays), np.int8), np.array(enclosure.low)
    room = (np.array(enclosure.high) - low).astype(np.float32)
    _find_walls(rays, (eye - low).astype(np.float32), room, distances, walls, places)
    # The cached pictures depend on nothing else.
    paint = dataclasses.replace(background, blur=0.0, backdrop=_DISTANT_WALL)
    return _sample_wrapped(_wall_pictures(paint, triple(room)), places), distances, walls


def draw_surroundings(
    background: Background, enclosure: Enclosure, camera: Camera, *, bright: bool
) -> Surroundings:
    """Draw the box as a camera in it sees it, through any lens; cached for cameras that stand still."""
    pose = camera.T_world_camera.tobytes()
    return _cached_surroundings(background, enclosure, at_rest(camera), pose, bright)


@functools.lru_cache(maxsize=16)
def _cached_surroundings(
    background: Background, enclosure: Enclosure, camera: Camera, pose: bytes, bright: bool
) -> Surroundings:
    T_world_camera, (rays, known) = np.frombuffer(pose).reshape(4, 4), _rays(camera)
    eye, shape, turn = T_world_camera[:3, 3], camera.size[::-1], T_world_camera[:3, :3].T.astype(np.float32)
    world = _without_zeros(rays @ turn)
    sigma, most = background.blur * shape[0], np.inf if bright else 1.0
    if background.kind == "room" or background.is_map:
        is_map = background.is_map
        met = _cast_in_map(background, world) if is_map else _cast_in_room(background, enclosure, eye, world)
        light = np.clip(met.light, 0.0, most).reshape(*shape, 3)
        if not is_map:

            def look(places: Doubles) -> Floats:
                aside = _without_zeros(_known_rays(camera.unproject(places))[0] @ turn)
                return np.asarray(np.clip(_cast_in_room(background, enclosure, eye, aside).light, 0.0, most))

            smooth_edges(light, look)
        if sigma > _LEAST_BLUR:
            light = cv2.GaussianBlur(light, (0, 0), sigma)
        light = cv2.pow(light, 1.0 / GAMMA)
        rgb = np.multiply(light, np.float32(255.0), out=light)
        rgb = rgb if bright else np.rint(light, out=light).astype(np.uint8)
        distances, walls = met.distances, met.walls
    else:
        colors, distances, walls = _cast_at_walls(background, enclosure, eye, world)
        rgb = colors.reshape(*shape, 3)
        if sigma > _LEAST_BLUR:
            rgb = cv2.GaussianBlur(rgb, (0, 0), sigma)
    depth = np.maximum(distances * rays[:, 2], np.float32(0.0)).reshape(shape)
    if not known.all():
        rgb[~known], depth[~known] = 0, 0.0
    return Surroundings(depth, walls.reshape(shape), _both_normals(T_world_camera[:3, :3].T), rgb)


@functools.lru_cache(maxsize=8)
def _rays(camera: Camera) -> tuple[Floats, Flags]:
    """Rays (H W, 3) in a camera's axes, and where (H, W) the lens sees; elsewhere rays are arbitrary."""
    rays, known = _known_rays(camera.rays())
    return rays.reshape(-1, 3), known


def _known_rays(rays: Doubles) -> tuple[Floats, Flags]:
    """Rays (..., 3) with (1, 1, 1) in place of unknown ones, and which rays (...) are known."""
    known = np.asarray(np.isfinite(rays).all(axis=-1))
    return np.where(known[..., None], rays, 1.0).astype(np.float32), known


@functools.lru_cache(maxsize=2)
def _wall_pictures(background: Background, room: Corner) -> UInt8[np.ndarray, "R S 3"]:
    """Pictures of a room's six walls in sRGB, one below the other; photographs are of one folder."""
    walls = [dataclasses.replace(background, seed=(background.seed + wall) % 2**31) for wall in range(6)]
    pictures = []
    if background.photo is None:
        pictures = [draw_background(wall, (_WALL_SIZE, _WALL_SIZE)) for wall in walls]
    else:
        for number, (wall, photo) in enumerate(
            zip(walls, photos_beside(Path(background.photo), 6), strict=True)
        ):
            sides = np.delete(room, number // 2)  # the wall's width and height
            width, height = np.ceil(_WALL_SIZE * sides / sides.max()).astype(int).tolist()
            picture = draw_background(dataclasses.replace(wall, photo=str(photo)), (width, height))
            pictures.append(cv2.resize(picture, (_WALL_SIZE, _WALL_SIZE), interpolation=cv2.INTER_LINEAR))
    light = np.clip(np.concatenate(pictures), 0.0, 1.0) ** np.float32(1.0 / GAMMA)
    return np.asarray(np.rint(np.float32(255.0) * light).astype(np.uint8))


@kernel
def _find_walls(
    rays: Floats, eye: Floats, room: Floats, distances: Floats, walls: NDArray[np.int8], places: Floats
) -> None:
    """Write distance (N,) [m] and number (N,) of the wall of a room (3,) that each ray meets, and the place.

    Walls lie at x = 0, x = room, y = 0 and so on. A place (N, 2) is a column and a row of the six walls'
    pictures, one below the other [px].
    """
    inner, zero, one = np.float32(_WALL_SIZE - 1), np.float32(0.0), np.float32(1.0)
    for ray in range(len(rays)):
        distance, wall = np.float32(np.inf), 0
        for axis in range(3):
            far = rays[ray, axis] > zero
            way = ((room[axis] if far else zero) - eye[axis]) / rays[ray, axis]
            if way < distance:
                distance, wall = way, 2 * axis + int(far)
        wide, high = (1 if wall < 2 else 0), (1 if wall >= 4 else 2)
        across = (eye[wide] + distance * rays[ray, wide]) / room[wide]
        up = (eye[high] + distance * rays[ray, high]) / room[high]
        distances[ray], walls[ray] = distance, wall
        places[ray, 0] = inner * min(max(across, zero), one)
        places[ray, 1] = wall * _WALL_SIZE + inner * (one - min(max(up, zero), one))
