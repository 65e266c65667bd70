"""The displaced base as Blender sees it: quads under subdivision, displaced to the full head.

Skipped unless LIMN_BLENDER_PYTHON names a Python with the bpy wheel (see tools/bench/peers/blender.py).
"""

import json
import os
import subprocess

import numpy as np
import pytest
from model_export import FROM_THE_FRONT, read_rgba, variant_scene, write_model_work
from scipy.spatial import cKDTree
from toy_result import ToyJob
from trimesh.triangles import closest_point

from shared.io.arrays import read_json
from shared.io.meshes import read_obj
from stages import export_usd
from tools.bench.peers.blender import VARIABLE, blender_python

pytestmark = pytest.mark.skipif(not os.environ.get(VARIABLE), reason=f"needs Blender: set {VARIABLE} to its Python")

RAISE = """
import bpy, json, sys
import numpy as np
from mathutils import Matrix
from pathlib import Path
folder = Path(sys.argv[-1])
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.usd_import(filepath=str(folder / "base.usda"), import_subdivision=True)
head = next(item for item in bpy.data.objects if item.type == "MESH" and item.data.shape_keys)
smooth = next(own for own in head.modifiers if own.type == "SUBSURF")
smooth.render_levels = 4
tree = head.data.materials[0].node_tree
raised = next(node for node in tree.nodes if node.type == "DISPLACEMENT")
show, light = tree.nodes.new("ShaderNodeNewGeometry"), tree.nodes.new("ShaderNodeEmission")
output = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
tree.links.new(show.outputs["Position"], light.inputs["Color"])
tree.links.new(light.outputs[0], output.inputs["Surface"])
head.data.materials[0].displacement_method = "DISPLACEMENT"
for other in bpy.data.objects:
    other.hide_render = other.type == "MESH" and other is not head
scene = bpy.context.scene
scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 1, False
scene.render.resolution_x = scene.render.resolution_y = 400
""" + FROM_THE_FRONT + """
scene.render.filepath = str(folder / "places.exr")
bpy.ops.render.render(write_still=True)
print("FOUND" + json.dumps({
    "uv_smooth": smooth.uv_smooth, "boundary": smooth.boundary_smooth, "limit": smooth.use_limit_surface,
    "kind": smooth.subdivision_type, "linked": raised.inputs["Height"].is_linked, "space": raised.space,
    "middle": raised.inputs["Midlevel"].default_value, "scale": raised.inputs["Scale"].default_value,
    "head": np.array(head.matrix_world).tolist(), "quads": sorted({len(face.vertices) for face in head.data.polygons}),
    "keys": [key.name for key in head.data.shape_keys.key_blocks[1:]]}))
"""


@pytest.fixture(scope="module")
def raised(tmp_path_factory):
    """(what Blender says, the export's folder) of the mean head with waves on its skin."""
    base = tmp_path_factory.mktemp("blender_base")
    work, _ = write_model_work(base / "work", waves_mm=0.4)
    job = ToyJob(work, base / "export", usdz=False, glb=False, views=False, plates=False, report_frames=1)
    export_usd.run(job)
    (job.out / "base.usda").write_text(variant_scene(detail="base"), encoding="utf-8")
    command = [blender_python(), "-c", RAISE, str(job.out)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.partition("FOUND")[2].splitlines()[0]), job.out


def test_subdivision_and_displacement_arrive_as_stated(raised):
    found, folder = raised
    names = read_json(folder / "run.json")["actions"]["names"]
    assert found["keys"][: len(names)] == names
    stated = {"uv_smooth": "NONE", "boundary": "ALL", "limit": True, "kind": "CATMULL_CLARK", "linked": True,
              "space": "OBJECT", "middle": 0.0, "scale": 1.0, "quads": [4]}
    assert {name: found[name] for name in stated} == stated


def test_cycles_shows_the_full_head(raised):
    """Where the pixels of a render from the front lie in space, against the mesh: nearest places."""
    found, folder = raised
    pixels = read_rgba(folder / "places.exr").reshape(-1, 4)
    places = pixels[pixels[:, 3] > 0.99, :3]
    assert len(places) > 20_000
    places = np.linalg.solve(np.array(found["head"]), np.column_stack([places, np.ones(len(places))]).T).T[::5, :3]
    full, off = read_obj(folder / "mesh.obj"), np.full(len(places), np.inf)
    corners = full.vertices[full.faces]
    for near in cKDTree(corners.mean(1)).query(places, k=12)[1].T:
        off = np.minimum(off, np.linalg.norm(closest_point(corners[near], places) - places, axis=1))
    assert np.percentile(off, 95) < 0.02
