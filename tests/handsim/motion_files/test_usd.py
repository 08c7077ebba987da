from __future__ import annotations

import builtins

import numpy as np
import pytest

from handsim.errors import HandSimError
from handsim.motion_files.motion import posed_bodies, posed_hands
from handsim.motion_files.scenes import write_usd


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
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/hands/{hand.side}/{hand.side}_hand"))
        skinning = cache.GetSkinningQuery(mesh.GetPrim())
        prim = stage.GetPrimAtPath(f"/hands/{hand.side}/{hand.side}_skeleton")
        skeleton = cache.GetSkelQuery(UsdSkel.Skeleton(prim))
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
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == 60.0
    assert stage.GetStartTimeCode() == 0.0 and stage.GetEndTimeCode() == pytest.approx(12.0)
    for thing, name in zip(posed_bodies(motion), ("pen", "my_wand"), strict=True):
        prim = UsdGeom.Xformable(stage.GetPrimAtPath(f"/hands/things/{name}"))
        for frame in range(motion.num_frames):
            found = np.array(prim.ComputeLocalToWorldTransform(frame)).T
            np.testing.assert_allclose(found, thing.T_world_body[frame], atol=1e-6)
            assert (prim.ComputeVisibility(frame) != UsdGeom.Tokens.invisible) == thing.present[frame]
    assert stage.GetPrimAtPath("/hands/things/pen/mesh") and not stage.GetPrimAtPath(
        "/hands/things/my_wand/mesh"
    )


def test_meshes_have_materials_and_skeletons_the_names_of_their_hands(stage, motion):
    from pxr import UsdGeom, UsdShade, UsdSkel

    prims = list(stage.Traverse())
    for prim in (prim for prim in prims if prim.IsA(UsdGeom.Mesh)):
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        shader, _, _ = material.ComputeSurfaceSource()
        assert shader.GetIdAttr().Get() == "UsdPreviewSurface"
        color = UsdGeom.Mesh(prim).GetDisplayColorAttr().Get()[0]
        assert shader.GetInput("diffuseColor").Get() == color
    skeletons = {prim.GetName(): UsdSkel.Skeleton(prim) for prim in prims if prim.IsA(UsdSkel.Skeleton)}
    assert set(skeletons) == {"right_skeleton", "left_skeleton"}
    for name, skeleton in skeletons.items():
        side = name.partition("_")[0]
        for path in skeleton.GetJointsAttr().Get():
            assert all(part.startswith(f"{side}_") for part in path.split("/"))
    for hand in posed_hands(motion):
        kinds = {str(prim.GetName()) for prim in stage.GetPrimAtPath(f"/hands/{hand.side}").GetChildren()}
        assert kinds == {f"{hand.side}_{kind}" for kind in ("hand", "skeleton", "motion")} | {"skin"}


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
