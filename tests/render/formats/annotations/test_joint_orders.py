from __future__ import annotations

import numpy as np
import pytest

from handsim.errors import ArgumentError
from handsim.hand.model import KEYPOINT_NAMES
from render.formats.annotations.joint_orders import ABSENT, JOINT_ORDERS, joint_order, to_order

# Names as the formats' own documents list them, in our words.
THUMB = ("thumb_CMC", "thumb_MCP", "thumb_IP", "thumb_tip")


def finger(name: str) -> tuple[str, ...]:
    return tuple(f"{name}_{part}" for part in ("MCP", "PIP", "DIP", "tip"))


INDEX, MIDDLE, RING, LITTLE = (finger(name) for name in ("index", "middle", "ring", "little"))
PUBLISHED = {
    "freihand": ("wrist", *THUMB, *INDEX, *MIDDLE, *RING, *LITTLE),
    "mano": (
        "wrist",
        *INDEX[:3],
        *MIDDLE[:3],
        *LITTLE[:3],
        *RING[:3],
        *THUMB[:3],
        *(THUMB[3], INDEX[3], MIDDLE[3], RING[3], LITTLE[3]),
    ),
    "interhand": (*THUMB[::-1], *INDEX[::-1], *MIDDLE[::-1], *RING[::-1], *LITTLE[::-1], "wrist"),
    "hands17": (
        *("wrist", THUMB[0], INDEX[0], MIDDLE[0], RING[0], LITTLE[0]),
        *(*THUMB[1:], *INDEX[1:], *MIDDLE[1:], *RING[1:], *LITTLE[1:]),
    ),
    "openxr": (None, "wrist", *THUMB, None, *INDEX, None, *MIDDLE, None, *RING, None, *LITTLE),
    "webxr": ("wrist", *THUMB, None, *INDEX, None, *MIDDLE, None, *RING, None, *LITTLE),
    "umetrack": (
        *(THUMB[3], INDEX[3], MIDDLE[3], RING[3], LITTLE[3], "wrist", *THUMB[1:3]),
        *(*INDEX[:3], *MIDDLE[:3], *RING[:3], *LITTLE[:3]),
    ),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_orders_are_the_published_ones(name: str) -> None:
    names = [None if place == ABSENT else KEYPOINT_NAMES[place] for place in joint_order(name)]
    assert names == list(PUBLISHED[name])


def test_mano_undoes_the_table_of_ho3d() -> None:
    """HO-3D publishes the places in MANO's order of joints in the plain one."""
    table = [0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20]
    points = np.arange(21.0)[:, None]
    np.testing.assert_array_equal(to_order(points, "mano")[table], points)


@pytest.mark.parametrize(
    ("name", "count"), [("openxr", 26), ("webxr", 25), ("hot3d", 20), ("umetrack21", 21)]
)
def test_counts(name: str, count: int) -> None:
    assert to_order(np.zeros((21, 3)), name).shape == (count, 3)


@pytest.mark.parametrize("name", JOINT_ORDERS)
def test_points_go_where_the_order_says(name: str, rng: np.random.Generator) -> None:
    points, order = rng.standard_normal((2, 21, 3)).astype(np.float32), np.array(joint_order(name))
    ordered = to_order(points, name)
    assert ordered.dtype == np.float32
    np.testing.assert_array_equal(ordered[:, order != ABSENT], points[:, order[order != ABSENT]])
    assert np.isnan(ordered[:, order == ABSENT]).all()


def test_every_order_has_each_joint_at_most_once() -> None:
    for order in JOINT_ORDERS.values():
        known = [place for place in order if place != ABSENT]
        assert len(set(known)) == len(known)


def test_mistakes_are_told() -> None:
    with pytest.raises(ArgumentError, match=r"unknown joint order 'open_xr' \(did you mean 'openxr'"):
        to_order(np.zeros((21, 3)), "open_xr")
    with pytest.raises(ArgumentError, match=r"expected \(\.\.\., 21, k\)"):
        to_order(np.zeros((20, 3)), "mano")
