"""Hair as Blender sees it: an object of its own that goes with the head, its alpha wired to the material.

Skipped unless LIMN_BLENDER_PYTHON names a Python with the bpy wheel (see tools/bench/peers/blender.py).
"""

import json
import os
import subprocess

import pytest
from toy_result import ToyJob, toy_hair, write_toy_work

from stages import export_usd
from tools.bench.peers.blender import VARIABLE, blender_python

pytestmark = pytest.mark.skipif(not os.environ.get(VARIABLE), reason=f"needs Blender: set {VARIABLE} to its Python")

LOOK = """
import bpy, json, sys
path = sys.argv[-1]
bpy.ops.wm.read_factory_settings(use_empty=True)
if path.endswith("glb"):
    bpy.ops.import_scene.gltf(filepath=path)
else:
    bpy.ops.wm.usd_import(filepath=path, import_textures_mode="IMPORT_PACK")
bpy.context.scene.frame_set(bpy.context.scene.frame_start + 2)
hair, head = (next(item for item in bpy.data.objects if item.name == name) for name in ("hair", "head"))
surface = next(node for node in hair.data.materials[0].node_tree.nodes if node.type == "BSDF_PRINCIPLED")
apart = hair.matrix_world - head.matrix_world
print("FOUND" + json.dumps({
    "faces": len(hair.data.polygons), "linked": [surface.inputs[name].is_linked for name in ("Base Color", "Alpha")],
    "apart": max(abs(value) for row in apart for value in row)}))
"""


@pytest.mark.parametrize("file", ["head.usda", "head.usdz", "head.glb"])
def test_it_goes_with_the_head_and_has_its_alpha(tmp_path, file):
    job = ToyJob(write_toy_work(tmp_path / "work", hair=True), tmp_path / "export", views=False, plates=False)
    export_usd.run(job)
    command = [blender_python(), "-c", LOOK, str(job.out / file)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout.partition("FOUND")[2].splitlines()[0])
    assert found == {"faces": len(toy_hair().mesh.faces), "linked": [True, True], "apart": pytest.approx(0.0, abs=1e-6)}
