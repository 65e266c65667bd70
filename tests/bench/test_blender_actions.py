"""Facial actions as Blender sees them: shape keys by name.

Skipped unless LIMN_BLENDER_PYTHON names a Python with the bpy wheel (see tools/bench/peers/blender.py).
"""

import json
import os
import subprocess

import numpy as np
import pytest
from toy_result import ToyJob, write_toy_work

from shared.actions.facial import facial_actions
from shared.geometry.mesh import Mesh
from shared.io.arrays import read_json, write_json
from shared.io.meshes import save_mesh
from shared.tracking.fit_eyeballs import set_eyeballs
from shared.tracking.models import load_head_model
from stages import export_usd
from tools.bench.peers.blender import VARIABLE, blender_python

pytestmark = pytest.mark.skipif(not os.environ.get(VARIABLE), reason=f"needs Blender: set {VARIABLE} to its Python")

READ = """
import bpy, json, sys
import numpy as np
bpy.ops.wm.read_factory_settings(use_empty=True)
path = sys.argv[-1]
(bpy.ops.import_scene.gltf if path.endswith("glb") else bpy.ops.wm.usd_import)(filepath=path)
keys = next(item for item in bpy.data.objects if item.name == "head").data.shape_keys.key_blocks
def places(key):
    values = np.empty(3 * len(key.data))
    key.data.foreach_get("co", values)
    return values.reshape(-1, 3)
rest = places(keys[0])
moved = {key.name: float(np.linalg.norm(places(key) - rest, axis=1).max()) for key in keys[1:]}
print("FOUND" + json.dumps({"moved": moved, "values": [key.value for key in keys[1:]]}))
"""


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """(the blend shapes, the export's folder) of the model's mean head."""
    base = tmp_path_factory.mktemp("blender_actions")
    work = write_toy_work(base / "work", eyes=True)
    coarse = load_head_model()
    model = coarse.subdivided()
    mesh = Mesh(set_eyeballs(model, model.template), model.faces, model.uvs, model.face_uvs)
    save_mesh(work / "inverse_render" / "mesh.npz", mesh, face_segment=model.face_segment)
    tracking = read_json(work / "track_landmarks" / "tracking.json")
    write_json(work / "track_landmarks" / "tracking.json", tracking | {"segments": model.segment_names})
    job = ToyJob(work, base / "export", views=False, plates=False)
    export_usd.run(job)
    return facial_actions(coarse, mesh.vertices, mesh.faces), job.out


@pytest.mark.parametrize("file", ["head.usda", "head.usdz", "head.glb"])
def test_actions_arrive_as_shape_keys(exported, file):
    shapes, folder = exported
    command = [blender_python(), "-c", READ, str(folder / file)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout.partition("FOUND")[2].splitlines()[0])
    names, unit = [shape.name for shape in shapes], 0.001 if file == "head.glb" else 1.0
    assert list(found["moved"])[: len(names)] == names and not any(found["values"])
    halves = ["eyeBlinkLeft_50", "eyeBlinkRight_50"] if file == "head.glb" else []
    assert list(found["moved"])[len(names):] == halves
    for shape in shapes:
        largest = np.linalg.norm(shape.offsets, axis=1).max()
        assert found["moved"][shape.name] == pytest.approx(unit * largest, rel=1e-3), shape.name
