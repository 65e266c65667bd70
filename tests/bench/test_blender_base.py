"""The displaced base as Blender sees it: quads under subdivision, displaced to the full head.

Skipped unless LIMN_BLENDER_PYTHON names a Python with the bpy wheel (see tools/bench/peers/blender.py).
"""

import json
import os
import subprocess

import numpy as np
import pytest
from toy_result import ToyJob, write_toy_work

from shared.geometry.mesh import Mesh, vertex_normals
from shared.geometry.raycast import RayScene
from shared.io.arrays import read_json, write_json
from shared.io.meshes import read_obj, save_mesh
from shared.tracking.fit_eyeballs import set_eyeballs
from shared.tracking.models import load_head_model
from stages import export_usd
from tools.bench.peers.blender import VARIABLE, blender_python

pytestmark = pytest.mark.skipif(not os.environ.get(VARIABLE), reason=f"needs Blender: set {VARIABLE} to its Python")

SCENE = """#usda 1.0
(defaultPrim = "head" metersPerUnit = 0.001 upAxis = "Y")
def "head" (references = @./head.usda@ variants = {string detail = "base"}) {}
"""
RAISE = """
import bpy, json, sys
import numpy as np
from pathlib import Path
folder = Path(sys.argv[-1])
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.usd_import(filepath=str(folder / "base.usda"), import_subdivision=True)
head = next(item for item in bpy.data.objects if item.type == "MESH" and item.data.shape_keys)
smooth = next(own for own in head.modifiers if own.type == "SUBSURF")
smooth.levels = 4
nodes = head.data.materials[0].node_tree.nodes
raised = next(node for node in nodes if node.type == "DISPLACEMENT")
image = next(node.image for node in nodes if node.type == "TEX_IMAGE" and "displacement" in node.image.filepath)
texture = bpy.data.textures.new("heights", "IMAGE")
texture.image, texture.filter_size, texture.extension = image, 0.1, "EXTEND"
own = head.modifiers.new("raised", "DISPLACE")
own.texture, own.texture_coords, own.direction = texture, "UV", "NORMAL"
own.mid_level, own.strength = raised.inputs["Midlevel"].default_value, raised.inputs["Scale"].default_value
mesh = head.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
places, normals = (np.empty(3 * len(mesh.vertices), np.float32) for _ in range(2))
mesh.vertices.foreach_get("co", places)
mesh.vertices.foreach_get("normal", normals)
np.savez(folder / "raised.npz", places=places.reshape(-1, 3), normals=normals.reshape(-1, 3))
print("FOUND" + json.dumps({
    "uv_smooth": smooth.uv_smooth, "boundary": smooth.boundary_smooth, "limit": smooth.use_limit_surface,
    "kind": smooth.subdivision_type, "linked": raised.inputs["Height"].is_linked, "space": raised.space,
    "middle": raised.inputs["Midlevel"].default_value, "scale": raised.inputs["Scale"].default_value,
    "quads": sorted({len(face.vertices) for face in head.data.polygons}),
    "keys": [key.name for key in head.data.shape_keys.key_blocks[1:]]}))
"""


@pytest.fixture(scope="module")
def raised(tmp_path_factory):
    """(what Blender says, the export's folder) of the mean head with waves on its skin."""
    base = tmp_path_factory.mktemp("blender_base")
    work = write_toy_work(base / "work", eyes=True)
    model = load_head_model().subdivided()
    vertices = set_eyeballs(model, model.template)
    waves = 0.4 * np.sin(0.5 * vertices).prod(1) * ~model.surface(vertices).vertices_of(("eyes", "inner_mouth"))
    vertices = vertices + waves[:, None] * vertex_normals(vertices, model.faces)
    mesh = Mesh(vertices, model.faces, model.uvs, model.face_uvs)
    save_mesh(work / "inverse_render" / "mesh.npz", mesh, face_segment=model.face_segment)
    tracking = read_json(work / "track_landmarks" / "tracking.json")
    write_json(work / "track_landmarks" / "tracking.json", tracking | {"segments": model.segment_names})
    job = ToyJob(work, base / "export", usdz=False, glb=False, views=False, plates=False, report_frames=1)
    export_usd.run(job)
    (job.out / "base.usda").write_text(SCENE, encoding="utf-8")
    command = [blender_python(), "-c", RAISE, str(job.out)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.partition("FOUND")[2].splitlines()[0]), job.out


def test_subdivision_and_displacement_arrive_as_stated(raised):
    found, folder = raised
    names = read_json(folder / "run.json")["actions"]["names"]
    assert found.pop("keys")[: len(names)] == names
    assert found == {"uv_smooth": "NONE", "boundary": "ALL", "limit": True, "kind": "CATMULL_CLARK", "linked": True,
                     "space": "OBJECT", "middle": 0.0, "scale": 1.0, "quads": [4]}


def test_blender_raises_it_to_the_full_head(raised):
    """Along its own normals, of all that faces outward within 1 mm: 0.02 mm for nine tenths, sockets and mouth too."""
    arrays, full = np.load(raised[1] / "raised.npz"), read_obj(raised[1] / "mesh.obj")
    scene, nearest = RayScene(full.vertices, full.faces), np.full(len(arrays["places"]), np.inf)
    for side in (1.0, -1.0):
        origins = arrays["places"] + side * arrays["normals"]
        face, _, distance = scene.intersect(origins, -side * arrays["normals"])
        nearest = np.minimum(nearest, np.where(face >= 0, np.abs(distance - 1.0), np.inf))
    assert np.percentile(nearest, 90) < 0.02
