"""Facial actions as Blender sees them: shape keys by name.

Skipped unless LIMN_BLENDER_PYTHON names a Python with the bpy wheel (see tools/bench/peers/blender.py).
"""

import json
import os
import subprocess

import numpy as np
import pytest
from model_export import write_model_work
from toy_result import ToyJob

from shared.actions.facial import facial_actions
from shared.geometry.blend_shapes import LID_ACTIONS
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
    work, mesh = write_model_work(base / "work")
    job = ToyJob(work, base / "export", views=False, plates=False, viewer_detail="full")
    export_usd.run(job)
    return facial_actions(load_head_model(), mesh.vertices, mesh.faces), job.out


@pytest.mark.parametrize("file", ["head.usda", "head.usdz", "head.glb"])
def test_actions_arrive_as_shape_keys(exported, file):
    shapes, folder = exported
    command = [blender_python(), "-c", READ, str(folder / file)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout.partition("FOUND")[2].splitlines()[0])
    names, unit = [shape.name for shape in shapes], 0.001 if file == "head.glb" else 1.0
    assert list(found["moved"])[: len(names)] == names
    halves = ["eyeBlinkLeft_50", "eyeBlinkRight_50"] if file == "head.glb" else []
    assert list(found["moved"])[len(names):] == halves
    # Blender shows the clip's first frame of a head.glb, whose lids follow the gaze.
    lids = {*LID_ACTIONS, *halves} if file == "head.glb" else set()
    assert not any(value for name, value in zip(found["moved"], found["values"], strict=True) if name not in lids)
    for shape in shapes:
        largest = np.linalg.norm(shape.offsets, axis=1).max()
        assert found["moved"][shape.name] == pytest.approx(unit * largest, rel=1e-3), shape.name
