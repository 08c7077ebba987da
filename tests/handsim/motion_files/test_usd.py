from __future__ import annotations

import builtins

import numpy as np
import pytest

from handsim.errors import HandSimError
from handsim.motion_files.motion import posed_bodies, posed_hands
from handsim.motion_files.usd import write_usd


@pytest.fixture(params=["usda", "usdc"])
def stage(request, motion, tmp_path):
    pxr = pytest.importorskip("pxr", reason="usd-core is not installed")
    assert pxr
    from pxr import Usd

    write_usd(tmp_path / f"hands.{request.param}", motion)
    return Usd.Stage.Open(str(tmp_path / f"hands.{request.param}"))


def test_usd_skins_the_hands_as_we_do(stage, motion):
    from pxr import Usd, UsdGeom, UsdSkel

    for hand in posed_hands(motion):
        cache = UsdSkel.Cache()
        cache.Populate(UsdSkel.Root(stage.GetPrimAtPath(f"/hands/{hand.side}")), Usd.PrimDefaultPredicate)
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/hands/{hand.side}/skin"))
        skinning = cache.GetSkinningQuery(mesh.GetPrim())
        skeleton = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath(f"/hands/{hand.side}/skeleton")))
        expected = hand.model.skin(hand.qpos)
        for frame in range(motion.num_frames):
            points = mesh.GetPointsAttr().Get()
            assert skinning.ComputeSkinnedPoints(skeleton.ComputeSkinningTransforms(frame), points, frame)
            np.testing.assert_allclose(np.array(points), expected[frame], atol=2e-6)
            shown = mesh.ComputeVisibility(frame) != UsdGeom.Tokens.invisible
            assert shown == hand.present[frame]


def test_things_units_and_axes(stage, motion):
    from pxr import UsdGeom

    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0 and UsdGeom.GetStageUpAxis(stage) == "Z"
    assert stage.GetTimeCodesPerSecond() == 60.0 and stage.GetEndTimeCode() == pytest.approx(12.0)
    for thing, name in zip(posed_bodies(motion), ("pen", "my_wand"), strict=True):
        prim = UsdGeom.Xformable(stage.GetPrimAtPath(f"/hands/things/{name}"))
        for frame in range(motion.num_frames):
            found = np.array(prim.ComputeLocalToWorldTransform(frame)).T
            np.testing.assert_allclose(found, thing.T_world_body[frame], atol=1e-6)
            assert (prim.ComputeVisibility(frame) != UsdGeom.Tokens.invisible) == thing.present[frame]
    assert stage.GetPrimAtPath("/hands/things/pen/mesh") and not stage.GetPrimAtPath(
        "/hands/things/my_wand/mesh"
    )


def test_without_usd_core_the_extra_is_named(motion, tmp_path, monkeypatch):
    real = builtins.__import__

    def missing(name, *args, **kwargs):
        if name == "pxr":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(HandSimError, match=r"\.usdc needs usd-core; run `pip install 'handsim\[usd\]'`"):
        write_usd(tmp_path / "hands.usdc", motion)
    assert list(tmp_path.iterdir()) == []
