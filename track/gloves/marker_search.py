"""A search for the places of unknown markers: which bone carries each column of a recording.

The points of a column belong to one marker throughout. A hand of mean proportions is laid into a few frames
in many orientations and gestures. Two steps alternate until no place changes: each column takes the place on
the skin that is nearest to its points over all these frames, and poses are solved for these places. A column
that is near no place does not belong to the hand. Because a hand may slide along its own fingers, and fingers
are alike, the best hands are tried again slid, in other sizes, and with their fingers exchanged.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.fit import Attachment, GloveFit, carried
from gloves.layout import MIN_MARKERS, MarkerLayout, MarkerPlace
from gloves.takes.points import far_apart, spread_out
from handsim.arrays import Doubles, Integers
from handsim.callbacks import OnStep, no_step
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import BONE_NAMES, DIGIT_OF_BONE, DIGITS, PALM, SIDES, SIZES, Side
from handsim.hand.skin import vertex_normals
from handsim.space.transforms import MIRROR, rotation_quaternions
from poses.shapes import sample_poses
from track.gloves.fit import FLESH, fit_places, shown_flesh
from track.kinematics.pose_solver import RESTING, PoseSolver
from track.kinematics.pose_spread import resting_prior

_FRAMES, _FIRST_FRAMES = 12, 6  # frames in which hands are compared, and those of the first poses
_POOL_FRAMES: Final = 600  # number of frames from which these are chosen
_NUM_PLACES: Final = 500  # places on the skin, 6 mm apart
_BONE_SPREAD: Final = 0.003  # [m] standard deviation of a marker against its bone
_PLACE_SPREAD: Final = 0.005  # [m] standard deviation of its distance from the nearest place
_PLACE_WEIGHT: Final = 0.6  # A marker lies at this share of the way from the nearest place to its mean point.
_LEFT_OUT_COST: Final = 25.0  # cost of a column that does not belong to the hand
_MOST_DISTANCE: Final = 0.02  # [m] Larger distances cost no more.
_CONVERGED: Final = 0.1  # smallest gain in energy of a round
_PALMAR_COST: Final = 2.0  # cost of a place on a bone's side; places on the palm's side cost twice as much
_WRIST_END: Final = -0.1  # [palm lengths] Places behind the wrist's joint belong to the arm.
_ROTATIONS, _GESTURES = 120, 10  # numbers of orientations and gestures of the hand that is laid into a frame
_DRAWN_POSES: Final = 400  # poses from which these gestures are chosen
_REFERENCE_FRAMES: Final = 3  # number of frames into which it is laid
_RIGID_ROUNDS: Final = (4, 8)  # rounds of alignment of all such hands, and of the better quarter
_RIGID_SCALE: Final = 0.015  # [m] robust scale of their alignment
# largest numbers of solutions with joint angles, and of new ones in each step
_MOST_ARTICULATED, _MOST_TRIED = 150, 8
# Numbers of fitted hands, more for few columns because more hands fit these; and of hands that are fitted
# again.
_STARTS, _FEWEST_STARTS, _MOST_REFITTED = 560, 14, 8
# A search ends when moving three hands gained nothing, or when it has fitted a hundred moved hands.
_PATIENCE, _MOST_FITS = 3, 100
_OUTLIER_SCALE: Final = 0.03  # [m] robust scale of poses
_POSE_STEPS: Final = 5  # steps of a pose at each robust scale
_ASIDE_ANGLE: Final = 0.1  # [rad] Markers farther around a finger may belong to the next one.
_GAIN_RATIO: Final = 0.98  # Another hand must cost less by this factor.
_SLIDES: Final = (
    *((0.01, 0.0), (-0.01, 0.0), (0.02, 0.0), (-0.02, 0.0), (0.03, 0.0), (-0.03, 0.0)),
    *((0.0, 0.02), (0.0, -0.02)),
)
"""Slides of markers along and across the hand [m]: of all markers, or of those of a digit or the palm."""
_NORMAL_SCALE: Final = 0.01  # [m] distance that counts like a difference of one between unit normals
_USUAL_SIZE: Final = list(SIZES).index("M")


class Solution(NamedTuple):
    """Places of N columns on a hand, and the poses that go with them."""

    energy: float
    """Squared distances in variances, plus the costs of unlikely places and poses."""
    side: Side
    size: int
    """Number of the hand's size, XS to XL."""
    places: Int[np.ndarray, "N"]
    """Rows of the table of places."""
    on_hand: Bool[np.ndarray, "N"]
    """Whether each column belongs to the hand."""
    qpos: Float[np.ndarray, "F 27"]
    """Poses of a right hand; the points of a left one are mirrored."""


class FittedHand(NamedTuple):
    """A right hand in a glove of some of N columns."""

    cost: float
    """Energy of its calibration, with a cost for each column that is left out."""
    side: Side
    """Side of the hand that was recorded; the hand is its mirror image if this is left."""
    hand: GloveFit
    columns: Int[np.ndarray, "M"]
    """The columns of its markers."""
    residuals: Float[np.ndarray, "M"]
    """Root mean square distance of each marker from its place [m]."""
    solution: Solution


class PlaceTable:
    """P places for markers, even on the skin of a right hand of some size; the same on hands of all sizes."""

    def __init__(self, size: str, radius: float) -> None:
        self.model = HandModel.named(size)
        surface = self.model.surface
        normals, rows = vertex_normals(surface.vertices, surface.faces), _spread_vertices()
        self.radius, self.normals = radius, normals[rows]
        self.points = surface.vertices[rows] + radius * self.normals
        self.bone_indices, self.bone_weights = surface.bone_indices[rows], surface.bone_weights[rows]
        self.bones: Integers = self.bone_indices[np.arange(len(rows)), self.bone_weights.argmax(1)]
        rest = self.model.rest_transforms[self.bones]
        local = np.einsum("pji,pj->pi", rest[:, :3, :3], self.points - rest[:, :3, 3])
        outward = np.einsum("pji,pj->pi", rest[:, :3, :3], self.normals)
        self.along = local[:, 0] / self.model.skeleton.lengths[self.bones]
        self.around = np.arctan2(outward[:, 1], outward[:, 2])
        self.cost: Float[np.ndarray, "P"] = _PALMAR_COST * (1.0 - np.cos(self.around))
        """Cost of each place: markers are seldom on the palm's side."""

    def centers(self, qpos: Float[np.ndarray, "F 27"]) -> Float[np.ndarray, "F P 3"]:
        """Marker centers [m] at all places."""
        bones = self.model.forward_kinematics(qpos)
        return carried(self.model, bones, self.points, self.bone_indices, self.bone_weights)

    def glove(
        self, places: Int[np.ndarray, "N"], names: Iterable[str], at: Float[np.ndarray, "N 3"] | None = None
    ) -> GloveFit:
        """A hand with markers at some places, or carried like these and `at` other points [m]."""
        pairs = zip(names, places, strict=True)
        markers = tuple(MarkerPlace(name, BONE_NAMES[self.bones[place]], 0.5, 0.0) for name, place in pairs)
        layout = MarkerLayout("learned", markers, self.radius)
        parts = (self.normals, self.bone_indices, self.bone_weights)
        points = self.points[places] if at is None else at
        return GloveFit(self.model, Attachment(layout, points, *(part[places] for part in parts)))

    def nearest(
        self, points: Float[np.ndarray, "F N 3"], T_world_bone: Float[np.ndarray, "F L 4 4"]
    ) -> tuple[Integers, Doubles, Doubles]:
        """The likeliest place of each column: row, a point [m] between it and the column's mean, and cost."""
        turned = T_world_bone[:, None, :, :3, :3].swapaxes(-1, -2)
        local = (turned @ (points[:, :, None] - T_world_bone[:, None, :, :3, 3])[..., None])[..., 0]
        seen = np.isfinite(points[:, :, :1])
        count = np.maximum(seen.sum(axis=0), 1)
        mean = np.where(seen[..., None], local, 0.0).sum(axis=0) / count[..., None]
        square = np.minimum(((local - mean) ** 2).sum(axis=-1), _MOST_DISTANCE**2)
        varied = np.where(seen, square, 0.0).sum(axis=0) / count
        rest = self.model.rest_transforms
        mean = (rest[:, :3, :3] @ mean[..., None])[..., 0] + rest[:, :3, 3]
        off = mean[:, self.bones] - self.points
        costs = varied[:, self.bones] / _BONE_SPREAD**2 + (off**2).sum(axis=-1) / _PLACE_SPREAD**2 + self.cost
        rows, columns = costs.argmin(axis=1), np.arange(len(costs))
        at = self.points[rows] + _PLACE_WEIGHT * off[columns, rows]
        return rows, at, np.minimum(costs[columns, rows], _LEFT_OUT_COST)

    def slid(self, places: Int[np.ndarray, "N"], along: float, across: float) -> Int[np.ndarray, "N"]:
        """The places nearest to some places after a slide [m] toward the fingertips and toward the thumb."""
        ahead = self.model.rest_transforms[self.bones[places], :3, :2] @ np.array([along, across])
        off = ((self.points[places] + ahead)[:, None] - self.points) ** 2
        turned = ((self.normals[places][:, None] - self.normals) ** 2).sum(axis=2)
        return np.asarray((off.sum(axis=2) + _NORMAL_SCALE**2 * turned).argmin(axis=1))

    def like(self, place: int, bone: int) -> int:
        """The place on another bone that is most like a place."""
        there = np.flatnonzero(self.bones == bone)
        turn = np.abs(np.angle(np.exp(1j * (self.around[there] - self.around[place]))))
        return int(there[(np.abs(self.along[there] - self.along[place]) + 0.3 * turn).argmin()])


def search_places(
    points: Float[np.ndarray, "T N 3"], names: Iterable[str], radius: float, *, on_step: OnStep = no_step
) -> list[FittedHand]:
    """Look for the places of 5 to 60 columns [m] of one hand, NaN where missing; likely hands, best first."""
    search, found = _Search(points, tuple(names), radius), list[Solution]()
    for side in SIDES:
        on_step(f"laying a {side} hand into the frames")
        found += search.first_solutions(side)
    on_step("fitting hands")
    starts = max(_FEWEST_STARTS, _STARTS // points.shape[1] - _FEWEST_STARTS)
    solved = [search.solved(one) for one in search.distinct(found)[:starts]]
    fitted = [search.fitted(one, FLESH) for one in search.distinct(solved)]
    on_step("sliding the hand and exchanging fingers")
    return search.improved(fitted)


def diverse_frames(points: Float[np.ndarray, "T N 3"], count: int) -> Integers:
    """Frames that show many columns [m], as different in their distances as possible; the widest first."""
    seen = np.isfinite(points[..., 0]).mean(axis=1)
    pool = spread_out(np.flatnonzero(seen >= min(0.9, np.quantile(seen, 0.7))), _POOL_FRAMES)
    first, second = np.triu_indices(points.shape[1], 1)
    apart = np.linalg.norm(points[pool][:, first] - points[pool][:, second], axis=2)
    usual = np.nan_to_num(np.nanmedian(apart, axis=0))
    apart = np.where(np.isfinite(apart), apart, usual)
    return np.asarray(pool[far_apart(apart, int(apart.sum(axis=1).argmax()), count)])


@functools.cache
def _spread_vertices() -> Integers:
    """Vertices of the skin that are as far apart as possible, without those in the palm or on the arm."""
    model = HandModel.named("M")
    surface, main = model.surface, model.surface.bone_indices[:, 0]
    normals = vertex_normals(surface.vertices, surface.faces)
    is_palm = main == PALM
    behind = surface.vertices[:, 0] < _WRIST_END * model.skeleton.lengths[PALM]
    kept = np.flatnonzero(~is_palm | ((normals[:, 2] > 0.0) & ~behind))
    return np.asarray(kept[far_apart(surface.vertices[kept], 0, _NUM_PLACES)])


class _Search:
    """Columns of a recording in a few frames, and the places that they may have."""

    def __init__(self, points: Doubles, names: tuple[str, ...], radius: float) -> None:
        self.tables, self._names = [PlaceTable(size, radius) for size in SIZES], names
        some = points[diverse_frames(points, _FRAMES)]
        self._fitted = set[tuple[object, ...]]()
        self._points: dict[Side, Doubles] = {"right": some, "left": some @ MIRROR}
        self._gestures = _gestures(self.tables[_USUAL_SIZE].model)

    def distinct(self, found: list[Solution]) -> list[Solution]:
        """The solutions with different bones, best first."""
        kept, bones = dict[tuple[object, ...], Solution](), self.tables[_USUAL_SIZE].bones
        for one in sorted(found, key=lambda solution: solution.energy):
            kept.setdefault((one.side, *bones[one.places].tolist()), one)
        return list(kept.values())

    def first_solutions(self, side: Side) -> list[Solution]:
        """Solutions in the first frames, each from a rigid hand in one of them."""
        points, found = self._points[side][:_FIRST_FRAMES], list[Solution]()
        for reference in range(min(_REFERENCE_FRAMES, len(points))):
            motions = _relative_motions(points, reference)
            tried = set[tuple[int, ...]]()
            for angles, rotation, position, places in self._rigid_hands(points[reference]):
                bones = tuple(self.tables[_USUAL_SIZE].bones[places].tolist())
                if bones in tried:
                    continue
                tried.add(bones)
                if len(tried) > _MOST_ARTICULATED // _REFERENCE_FRAMES // 2:
                    break
                turned, moved = (np.stack(part) for part in zip(*motions, strict=True))
                qpos = join_qpos(np.tile(angles, (len(points), 1)))
                qpos[:, :3] = turned @ position + moved
                qpos[:, 3:7] = rotation_quaternions(turned @ rotation)
                found.append(self._alternate(side, _USUAL_SIZE, points, qpos, 6))
        return found

    def solved(self, start: Solution) -> Solution:
        """Solve all frames, starting from a solution in the first frames."""
        points = self._points[start.side]
        qpos = self._poses(start.size, points, start.places, None)
        return self._alternate(start.side, start.size, points, qpos, 6)

    def fitted(self, solution: Solution, flesh: float) -> FittedHand:
        """A solution with the hand's shape and the places of markers fitted, see `fit_places`."""
        own = np.flatnonzero(solution.on_hand)
        glove = self.tables[solution.size].glove(solution.places[own], [self._names[row] for row in own])
        hand, cost, residuals = fit_places(self._points[solution.side][:, own], glove, flesh=flesh)
        cost += self.tables[solution.size].cost[solution.places[own]].sum()
        cost += _LEFT_OUT_COST * float((~solution.on_hand).sum())
        return FittedHand(cost, solution.side, hand, own, residuals, solution)

    def improved(self, fitted: list[FittedHand]) -> list[FittedHand]:
        """The best of these hands, and hands that slides, sizes and exchanges of fingers lead to; best first.

        Each step moves the best hand that was not moved before. All are fitted with the flesh that the first
        hands show, so that their costs compare.
        """
        ranked = sorted(fitted, key=lambda one: one.cost)
        fit = functools.partial(self.fitted, flesh=shown_flesh(ranked[0].residuals))
        waiting, done, failed = [fit(one.solution) for one in ranked[:_MOST_REFITTED]], list[FittedHand](), 0
        while waiting and failed < _PATIENCE and len(self._fitted) < _MOST_FITS:
            best = min(one.cost for one in (*done, *waiting))
            start = min(waiting, key=lambda one: one.cost)
            tried = [self._snapped(start), *self.distinct(self._moved(start.solution))]
            new = list(map(fit, itertools.islice(filter(self._is_new, tried), _MOST_TRIED)))
            waiting = [one for one in (*waiting, *new) if one is not start]
            done.append(start)
            failed = 0 if min((one.cost for one in new), default=np.inf) < _GAIN_RATIO * best else failed + 1
        return sorted((*done, *waiting), key=lambda one: one.cost)

    def _is_new(self, one: Solution) -> bool:
        """Whether no hand with these bones was fitted; it counts as fitted from now on."""
        key = (one.side, one.size, *self.tables[_USUAL_SIZE].bones[one.places].tolist())
        is_new = key not in self._fitted
        self._fitted.add(key)
        return is_new

    def _snapped(self, fitted: FittedHand) -> Solution:
        """The solution of a fitted hand with each marker at the place of the table that is nearest to it."""
        start, table = fitted.solution, self.tables[fitted.solution.size]
        points, bones = fitted.hand.attachment.points, fitted.hand.attachment.main_bones
        rest, usual = fitted.hand.model.rest_transforms[bones], table.model.rest_transforms[bones]
        longer = table.model.skeleton.lengths[bones] / fitted.hand.model.skeleton.lengths[bones]
        local = np.einsum("mji,mj->mi", rest[:, :3, :3], points - rest[:, :3, 3]) * longer[:, None]
        at = np.einsum("mij,mj->mi", usual[:, :3, :3], local) + usual[:, :3, 3]
        places = start.places.copy()
        places[fitted.columns] = ((at[:, None] - table.points) ** 2).sum(axis=2).argmin(axis=1)
        return start._replace(places=places)

    def _moved(self, start: Solution) -> list[Solution]:
        """Solutions near one: slid, with fingers exchanged, or of another size. Their poses begin relaxed."""
        points, found = self._points[start.side], list[Solution]()
        relaxed = start.qpos.copy()
        relaxed[:, 7:] = RESTING
        tried = [(start.size, places) for places in self._moved_places(start.places)]
        sizes = (start.size - 1, start.size + 1)
        tried += [(size, start.places) for size in sizes if 0 <= size < len(self.tables)]
        for size, places in tried:
            qpos = self._poses(size, points, places, relaxed)
            found.append(self._alternate(start.side, size, points, qpos, 3))
        return found

    def _alternate(self, side: Side, size: int, points: Doubles, qpos: Doubles, rounds: int) -> Solution:
        """Choose places and solve poses by turns."""
        table, energy = self.tables[size], np.inf
        for number in range(rounds + 1):
            places, at, costs = table.nearest(points, table.model.forward_kinematics(qpos))
            off = qpos[:, 7:] - resting_prior().angles
            pose = 0.25 * float(np.einsum("fi,ij,fj->f", off, resting_prior().precision, off).mean())
            before, energy = energy, float(costs.sum()) + pose
            on_hand = costs < _LEFT_OUT_COST
            on_hand[np.argsort(costs)[:MIN_MARKERS]] = True
            if number == rounds or energy > before - _CONVERGED:
                break
            shown = np.where(on_hand[:, None], points, np.nan)
            qpos = self._poses(size, shown, places, qpos, at)
        return Solution(energy, side, size, places, on_hand, qpos)

    def _poses(
        self, size: int, points: Doubles, places: Integers, starts: Doubles | None, at: Doubles | None = None
    ) -> Doubles:
        """Poses (F, 27) with markers at these places."""
        solver = PoseSolver(self.tables[size].glove(places, self._names, at), outlier_distance=_OUTLIER_SCALE)
        usual = np.tile(RESTING, (len(points), 1)), 0.5
        return solver.solve(points, starts, prior=usual, iterations=_POSE_STEPS).qpos

    def _rigid_hands(
        self, points: Float[np.ndarray, "N 3"]
    ) -> list[tuple[Doubles, Doubles, Doubles, Integers]]:
        """Joint angles, rotation, position and nearest places of hands laid into a frame, best first."""
        table, hands, seen = self.tables[_USUAL_SIZE], [], points[np.isfinite(points[:, 0])]
        shown, even = np.flatnonzero(np.isfinite(points[:, 0])), _even_rotations(_ROTATIONS)
        for angles, centers in zip(self._gestures, table.centers(join_qpos(self._gestures)), strict=True):
            rotations = even
            middle = centers[table.cost < _PALMAR_COST].mean(axis=0)
            positions = seen.mean(axis=0) - rotations @ middle
            for rounds in _RIGID_ROUNDS:
                fitted = self._aligned(seen, centers, rotations, positions, rounds)
                best = np.argsort(fitted[2], kind="stable")[: -(-len(rotations) // 4)]
                rotations, positions = fitted[0][best], fitted[1][best]
            for row in best:
                places = np.zeros(len(points), dtype=np.int64)
                places[shown] = fitted[3][row]
                hands.append((float(fitted[2][row]), angles, fitted[0][row], fitted[1][row], places))
        hands.sort(key=lambda one: one[0])
        return [one[1:] for one in hands]

    def _aligned(
        self,
        points: Float[np.ndarray, "S 3"],
        centers: Float[np.ndarray, "P 3"],
        rotations: Float[np.ndarray, "R 3 3"],
        positions: Float[np.ndarray, "R 3"],
        rounds: int,
    ) -> tuple[Doubles, Doubles, Doubles, Integers]:
        """Rotations, positions, energies (R,) and nearest places (R, S) of rigid hands, aligned by turns."""
        size = (centers**2).sum(axis=1)
        for number in range(rounds + 1):
            local = (points - positions[:, None]) @ rotations
            square = (local**2).sum(axis=2)[..., None] + size - 2.0 * local @ centers.T
            costs = np.minimum(square, _MOST_DISTANCE**2) / _PLACE_SPREAD**2 + self.tables[_USUAL_SIZE].cost
            places = costs.argmin(axis=2)
            if number == rounds:
                break
            off = np.take_along_axis(square, places[..., None], axis=2)[..., 0]
            rotations, positions = _robust_alignment(points, centers[places], off)
        return rotations, positions, costs.min(axis=2).sum(axis=1), places

    def _moved_places(self, places: Int[np.ndarray, "N"]) -> Iterator[Int[np.ndarray, "N"]]:
        """Places near these: markers slide, digits are exchanged or divided, or a digit moves by a bone."""
        table, count = self.tables[_USUAL_SIZE], len(DIGITS)
        digits = DIGIT_OF_BONE[table.bones[places]]
        orders = list[list[int]]()
        for one, other in itertools.combinations(range(count), 2):
            swapped = list(range(count))
            swapped[one], swapped[other] = other, one
            orders.append(swapped)
        for one, other in itertools.permutations(range(count), 2):
            if abs(one - other) > 1:
                inserted = [digit for digit in range(count) if digit != one]
                inserted.insert(other, one)
                orders.append(inserted)
        bones = table.bones[places]
        for along, across in _SLIDES:
            slid = table.slid(places, along, across)
            yield slid
            if across == 0.0:
                yield from (np.where(digits == digit, slid, places) for digit in np.unique(digits))
        shifts = [3 * (np.array(order)[digits] - digits) for order in orders]
        targets = [np.where(digits >= 0, bones + shift, PALM) for shift in shifts]
        for digit, sign in itertools.product(range(count), (1, -1)):
            own = digits == digit
            aside = own & (sign * table.around[places] > _ASIDE_ANGLE)
            if aside.any() and not aside[own].all():
                beside = [other for other in range(count) if 0 < abs(other - digit) <= 2]
                targets += [np.where(aside, bones + 3 * (other - digit), bones) for other in beside]
            parts = (bones - 1) % 3
            targets.append(np.where(own, bones + np.clip(parts + sign, 0, 2) - parts, bones))
        for target in targets:
            if (target != bones).any():
                triples = zip(places.tolist(), bones.tolist(), target.tolist(), strict=True)
                yield np.array([one if own == new else table.like(one, new) for one, own, new in triples])


def _gestures(model: HandModel) -> Float[np.ndarray, "K 20"]:
    """Joint angles [rad] of usual gestures: an almost flat and a relaxed hand, and others far from these."""
    drawn = sample_poses(model, _DRAWN_POSES, rng=np.random.default_rng(1))[:, 7:]
    chosen, far = [RESTING * 0.3, RESTING], np.full(len(drawn), np.inf)
    for _ in range(_GESTURES):
        far = np.minimum(far, ((drawn - chosen[-1]) ** 2).sum(axis=1))
        usual = np.where(far > np.quantile(far, 0.9), -1.0, far)  # the farthest are contorted
        chosen.append(drawn[usual.argmax()])
    return np.array(chosen)


def _even_rotations(count: int) -> Float[np.ndarray, "R 3 3"]:
    """Evenly distributed rotations: a super-Fibonacci spiral (Alexa 2022)."""
    from scipy.spatial.transform import Rotation

    steps = np.arange(count) + 0.5
    share, turn = steps / count, 2.0 * np.pi * steps
    first, second = turn / np.sqrt(2.0), turn / 1.533751168755204288118041
    low, high = np.sqrt(share), np.sqrt(1.0 - share)
    parts = (low * np.sin(first), low * np.cos(first), high * np.sin(second), high * np.cos(second))
    return np.asarray(Rotation.from_quat(np.stack(parts, axis=1)).as_matrix())


def _robust_alignment(
    points: Float[np.ndarray, "S 3"], targets: Float[np.ndarray, "R S 3"], off: Float[np.ndarray, "R S"]
) -> tuple[Doubles, Doubles]:
    """Rotations and positions of hands whose places `targets` are nearest to the points; `off` is squared."""
    weights = 1.0 / (1.0 + np.maximum(off, 0.0) / _RIGID_SCALE**2)
    weights /= weights.sum(axis=1, keepdims=True)
    middle, wanted = np.einsum("rs,rsi->ri", weights, targets), weights @ points
    across = np.einsum("rs,rsi,rsj->rij", weights, targets - middle[:, None], points - wanted[:, None])
    left, _, right = np.linalg.svd(across)
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    rotations = (left @ right).swapaxes(1, 2)
    return rotations, wanted - np.einsum("rij,rj->ri", rotations, middle)


def _relative_motions(points: Float[np.ndarray, "F N 3"], reference: int) -> list[tuple[Doubles, Doubles]]:
    """Rotation and translation of each frame from a reference, by the columns that move least."""
    motions = []
    for frame in points:
        both = np.isfinite(frame[:, 0]) & np.isfinite(points[reference, :, 0])
        here, there = points[reference, both], frame[both]
        off = np.zeros((1, len(here)))
        for _ in range(10):
            rotation, position = _robust_alignment(there, here[None], off)
            off = ((here @ rotation[0].T + position[0] - there) ** 2).sum(axis=1)[None]
        motions.append((rotation[0], position[0]))
    return motions
