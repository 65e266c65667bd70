"""Facial actions in the exported asset: a head of the model's topology, through the stage's own run and check."""

import json
import struct

import numpy as np
import pytest
from model_export import write_model_work
from pxr import Usd, UsdGeom, UsdSkel
from toy_result import ToyJob, write_toy_work

from shared.actions.names import ARKIT_NAMES
from shared.io.arrays import read_json
from stages import export_usd


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """{actions on?: the job}, of the same head."""
    base = tmp_path_factory.mktemp("actions")
    work, _ = write_model_work(base / "work")
    jobs = {}
    for on in (True, False):
        jobs[on] = ToyJob(work, base / f"export_{on}", actions=on, views=False, plates=False)
        export_usd.run(jobs[on])
        export_usd.check(jobs[on])
    return jobs


def morph_names(path):
    data = path.read_bytes()
    content = json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])
    return content["meshes"][0].get("extras", {}).get("targetNames", [])


@pytest.mark.parametrize("file", ["head.usda", "head.usdz"])
def test_the_asset_has_arkits_names(exported, file):
    stage = Usd.Stage.Open(str(exported[True].out / file))
    head = stage.GetDefaultPrim().GetPrimAtPath("geo/head")
    names = list(UsdSkel.BindingAPI(head).GetBlendShapesAttr().Get())
    assert names == read_json(exported[True].out / "run.json")["actions"]["names"]
    assert len(names) == 33 and set(names) <= set(ARKIT_NAMES)
    assert morph_names(exported[True].out / "head.glb") == [*names, "eyeBlinkLeft_50", "eyeBlinkRight_50"]
    halves = [UsdSkel.BlendShape(head.GetChild(name)).GetInbetweens() for name in names]
    assert [name for name, found in zip(names, halves, strict=True) if found] == ["eyeBlinkLeft", "eyeBlinkRight"]


def test_without_them_the_files_have_none_and_the_head_is_the_same(exported):
    on, off = (Usd.Stage.Open(str(exported[each].out / "head.usda")) for each in (True, False))
    points = [UsdGeom.Mesh(each.GetDefaultPrim().GetPrimAtPath("geo/head")).GetPointsAttr().Get() for each in (on, off)]
    assert points[0] == points[1]
    assert not any(prim.IsA(UsdSkel.BlendShape) or prim.IsA(UsdSkel.Root) for prim in off.Traverse())
    assert morph_names(exported[False].out / "head.glb") == []
    assert "actions" not in read_json(exported[False].out / "run.json")
    for name in ("mesh.obj", "poses.npz", "envmap.exr"):
        assert (exported[True].out / name).read_bytes() == (exported[False].out / name).read_bytes()


def test_run_record_says_which_there_are(exported):
    said = read_json(exported[True].out / "run.json")["actions"]
    assert sorted([*said["names"], *said["lacking"]]) == sorted(ARKIT_NAMES) and said["note"] == ""


def test_the_page_plays_some_of_them(exported):
    pages = {on: (job.out / "report.html").read_text(encoding="utf-8") for on, job in exported.items()}
    assert "<option>jawOpen</option>" in pages[True] and 'id="viewer-weight"' in pages[True]
    assert 'id="viewer-weight"' not in pages[False]


def test_a_mesh_from_elsewhere_has_none_and_it_is_said(tmp_path):
    job = ToyJob(write_toy_work(tmp_path / "work", eyes=True), tmp_path / "export", views=False, plates=False)
    export_usd.run(job)
    said = read_json(job.out / "run.json")["actions"]
    assert said["names"] == [] and len(said["lacking"]) == 52 and "not the head model's" in said["note"]
    assert np.size(morph_names(job.out / "head.glb")) == 0


def test_reduced_heads_play_the_same_actions(exported):
    """The model, 35,744 triangles, at both levels: as many as the name says, all actions, no fault (see the stage's
    check); without actions the same triangles."""
    counts, said = {}, read_json(exported[True].out / "run.json")["actions"]
    for on in (True, False):
        for detail, most in (("20k", 20000), ("5k", 5000)):
            stage = Usd.Stage.Open(str(exported[on].out / "head.usdz"))
            root = stage.GetDefaultPrim()
            stage.SetEditTarget(stage.GetSessionLayer())
            root.GetVariantSet("detail").SetVariantSelection(detail)
            meshes = [UsdGeom.Mesh(prim) for prim in root.GetPrimAtPath("geo").GetChildren() if prim.IsA(UsdGeom.Mesh)]
            counts[on, detail] = [len(mesh.GetFaceVertexCountsAttr().Get()) for mesh in meshes]
            assert len(meshes) == 3 and most - 2 < sum(counts[on, detail]) <= most
            names = UsdSkel.BindingAPI(root.GetPrimAtPath("geo/head")).GetBlendShapesAttr().Get()
            assert (list(names) if names else []) == (said["names"] if on else [])
    assert counts[True, "20k"] == counts[False, "20k"] and counts[True, "5k"] == counts[False, "5k"]
