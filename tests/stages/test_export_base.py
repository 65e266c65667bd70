"""The displaced base in the exported asset: a head of the model's topology, put together again from the files alone."""

import re

import numpy as np
import pytest
from model_export import HIDDEN, write_model_work
from pxr import Usd, UsdGeom, UsdShade, UsdSkel
from toy_result import ToyJob

from shared.geometry.mesh import vertex_normals
from shared.geometry.quads import LimitSurface, QuadMesh
from shared.geometry.raycast import RayScene
from shared.imaging.texture import sample_bilinear
from shared.io.exr_header import read_parts
from shared.io.images import read_exr
from shared.io.meshes import read_obj
from shared.tracking.models import load_head_model
from stages import export_usd
from tools.documents.readme import DOCS

TOLERANCE_MM = 0.02


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The job, of the mean head with waves on its skin that no quad can follow."""
    base = tmp_path_factory.mktemp("base")
    work, _ = write_model_work(base / "work", waves_mm=0.4)
    job = ToyJob(work, base / "export", glb=False, views=False, plates=False, report_frames=1)
    export_usd.run(job)
    export_usd.check(job)
    return job


def opened(job, detail, file="head.usda"):
    stage = Usd.Stage.Open(str(job.out / file))
    stage.SetEditTarget(stage.GetSessionLayer())
    assert stage.GetDefaultPrim().GetVariantSet("detail").SetVariantSelection(detail)
    return stage


def mesh_at(stage, name):
    return UsdGeom.Mesh(stage.GetDefaultPrim().GetPrimAtPath(f"geo/{name}"))


def material(stage):
    prim = mesh_at(stage, "head").GetPrim()
    return UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]


def cage_of(stage):
    prim = mesh_at(stage, "head")
    assert set(prim.GetFaceVertexCountsAttr().Get()) == {4}
    coordinates = UsdGeom.PrimvarsAPI(prim).GetPrimvar("st")
    quads, quad_uvs = (np.array(each).reshape(-1, 4) for each in (prim.GetFaceVertexIndicesAttr().Get(),
                                                                  coordinates.GetIndices()))
    return QuadMesh(np.array(prim.GetPointsAttr().Get(), float), quads, np.array(coordinates.Get(), float), quad_uvs)


def node_before(port):
    return UsdShade.Shader(port.GetConnectedSources()[0][0].source.GetPrim())


def preview_heights(stage, folder):
    """UsdPreviewSurface: what the texture's r is after scale and bias, in units of the stage, at [N, 2] UVs."""
    surface = node_before(material(stage).GetDisplacementOutput())
    texture = node_before(surface.GetInput("displacement"))
    assert surface.GetShaderId() == "UsdPreviewSurface" and texture.GetShaderId() == "UsdUVTexture"
    assert texture.GetInput("sourceColorSpace").Get() == "raw"
    assert not texture.GetInput("scale") and not texture.GetInput("bias")  # 1 and 0 by the specification
    return read_exr(folder / texture.GetInput("file").Get().path)


def materialx_heights(stage, folder):
    """MaterialX: displacement times scale, in units of the scene."""
    node = node_before(material(stage).GetDisplacementOutput("mtlx"))
    image = node_before(node.GetInput("displacement"))
    assert (node.GetShaderId(), image.GetShaderId()) == ("ND_displacement_float", "ND_image_float")
    return read_exr(folder / image.GetInput("file").Get().path) * node.GetInput("scale").Get()


@pytest.mark.parametrize("heights_of", [preview_heights, materialx_heights])
def test_base_and_displacement_are_the_full_head(exported, heights_of):
    """As both models displace, P' = P + h N; measured along the normal, on what can be seen of the skin."""
    stage, full = opened(exported, "base"), read_obj(exported.out / "mesh.obj")
    cage = cage_of(stage)
    surface = LimitSurface.of(cage, 3)
    places = surface.matrix @ cage.vertices
    normals, uvs = vertex_normals(places, surface.faces), np.zeros((len(places), 2))
    uvs[surface.faces] = surface.uvs[surface.face_uvs]
    raised = places + sample_bilinear(heights_of(stage, exported.out), uvs)[:, None] * normals
    model = load_head_model().subdivided()
    skin = ~np.isin(np.array(model.segment_names)[model.face_segment], HIDDEN)
    scene, off = RayScene(full.vertices, full.faces), {}
    for name, points in (("base", places), ("displaced", raised)):
        found, hidden = np.full(len(points), np.inf), np.zeros(len(points), bool)
        for side in (1.0, -1.0):
            face, _, distance = scene.intersect(points + side * normals, -side * normals)
            height = np.where(face >= 0, np.abs(distance - 1.0), np.inf)
            nearer = height < found
            found[nearer], hidden[nearer] = height[nearer], ~skin[face[nearer]]
        assert (found < 1.0).mean() > 0.98
        off[name] = found[~hidden & (found < 1.0)]
    assert np.percentile(off["base"], 95) > 5.0 * TOLERANCE_MM
    assert np.percentile(off["displaced"], 95) < TOLERANCE_MM


def test_the_base_is_the_models_quads_under_subdivision(exported):
    stage = opened(exported, "base")
    head = mesh_at(stage, "head")
    assert head.GetSubdivisionSchemeAttr().Get() == UsdGeom.Tokens.catmullClark
    assert head.GetInterpolateBoundaryAttr().Get() == UsdGeom.Tokens.edgeOnly
    assert head.GetFaceVaryingLinearInterpolationAttr().Get() == UsdGeom.Tokens.all
    model = load_head_model()
    of_eyes = model.segment("eyes").sum()
    assert len(head.GetFaceVertexCountsAttr().Get()) == (len(model.faces) - of_eyes) // 2
    for name in ("eye_right", "eye_left"):
        full = opened(exported, "full")
        assert mesh_at(stage, name).GetPointsAttr().Get() == mesh_at(full, name).GetPointsAttr().Get()


def test_it_has_the_actions(exported):
    """The jaw opens by as much as the full head's."""
    found = {}
    for detail in ("full", "base"):
        stage = opened(exported, detail)
        head = mesh_at(stage, "head").GetPrim()
        names = list(UsdSkel.BindingAPI(head).GetBlendShapesAttr().Get())
        offsets = np.array(UsdSkel.BlendShape(head.GetChild("jawOpen")).GetOffsetsAttr().Get())
        found[detail] = names, np.linalg.norm(offsets, axis=1).max()
        assert UsdSkel.BlendShape(head.GetChild("eyeBlinkLeft")).GetInbetweens()
    assert found["base"][0] == found["full"][0] and len(found["full"][0]) == 33
    assert found["base"][1] == pytest.approx(found["full"][1], rel=0.03)


@pytest.mark.parametrize("detail", ["full", "20k", "5k"])
def test_nothing_else_is_displaced(exported, detail):
    stage = opened(exported, detail)
    own = material(stage)
    assert not own.GetDisplacementOutput().HasConnectedSource() and not own.GetDisplacementOutput("mtlx")


def test_a_package_for_viewers_is_without_it(exported):
    stage = opened(exported, "20k", "head.usdz")
    variants = stage.GetDefaultPrim().GetVariantSet("detail")
    assert set(variants.GetVariantNames()) == {"20k", "5k"}


def test_the_map_says_what_it_is(exported):
    (part,) = read_parts(exported.out / "maps" / "displacement.exr")
    assert [(channel.name, channel.kind) for channel in part.channels] == [("Y", 2)]  # 2: 32-bit floats
    assert part.values["limn:unit"].startswith("mm along the normal")
    assert (part.values["limn:scale"], part.values["limn:midpoint"]) == (1.0, 0.0)


def test_the_page_names_its_shaders(exported):
    page = (DOCS / "asset.md").read_text(encoding="utf-8").partition("\n## Displacement\n")[2].partition("\n## ")[0]
    named = dict(re.findall(r"^\| `(\w+)` \| (\w+) \|", page, re.MULTILINE))
    shaders = []
    for stage in (opened(exported, "base"), opened(exported, "full")):
        prims = material(stage).GetPrim().GetChildren()
        shaders.append({prim.GetName(): UsdShade.Shader(prim).GetShaderId() for prim in prims})
    assert named and named == {name: kind for name, kind in shaders[0].items() if name not in shaders[1]}


def test_without_levels_there_is_none(tmp_path, exported):
    job = ToyJob(exported.input("x").parent, tmp_path / "export", detail=False, actions=False, usdz=False, glb=False,
                 views=False, plates=False, report_frames=1)
    export_usd.run(job)
    assert not (job.out / "maps" / "displacement.exr").exists()
    export_usd.check(job)
