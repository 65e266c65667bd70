"""Levels of detail and looks as Blender sees them: chosen in a scene, with texture and shape keys.

Skipped unless LIMN_BLENDER_PYTHON names a Python with the bpy wheel (see tools/bench/peers/blender.py).
"""

import json
import os
import subprocess

import numpy as np
import pytest
from model_export import FROM_THE_FRONT, read_rgba, variant_scene, write_model_work
from scipy.ndimage import binary_erosion
from toy_result import MAP_SIZE, ToyJob

from shared.io.arrays import read_json
from stages import export_usd
from tools.bench.peers.blender import VARIABLE, blender_python

pytestmark = pytest.mark.skipif(not os.environ.get(VARIABLE), reason=f"needs Blender: set {VARIABLE} to its Python")

LOOK = """
import bpy, json, sys
import numpy as np
from mathutils import Matrix
from pathlib import Path
folder, name = Path(sys.argv[-2]), sys.argv[-1]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.usd_import(filepath=str(folder / (name + ".usda")))
meshes = [item for item in bpy.data.objects if item.type == "MESH"]
head = next(item for item in meshes if item.data.shape_keys)
keys = head.data.shape_keys.key_blocks
scene, pictures = bpy.context.scene, {}
for item in meshes:
    tree = item.data.materials[0].node_tree
    surface = next(node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
    source = surface.inputs["Base Color"].links[0].from_socket
    pictures[item.name.partition(".")[0]] = [source.node.type, list(source.node.image.size)]
    light = tree.nodes.new("ShaderNodeEmission")
    tree.links.new(source, light.inputs["Color"])
    output = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
    tree.links.new(light.outputs[0], output.inputs["Surface"])
scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 16, False
scene.cycles.pixel_filter_type = "BOX"
scene.render.resolution_x = scene.render.resolution_y = 256
""" + FROM_THE_FRONT + """
for key in ("jawOpen", "mouthSmileLeft"):
    for weight in (0.0, 1.0):
        keys[key].value = weight
        scene.render.filepath = str(folder / f"{name}_{key}_{weight:.0f}.exr")
        bpy.ops.render.render(write_still=True)
    keys[key].value = 0.0
print("FOUND" + json.dumps({
    "faces": sum(len(item.data.polygons) for item in meshes), "pictures": pictures,
    "keys": [key.name for key in keys[1:]], "values": [key.value for key in keys[1:]]}))
"""
SCENES = {"full": {"detail": "full"}, "20k": {"detail": "20k"}, "5k": {"detail": "5k"}, "skin": {"look": "skin"}}


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """(what Blender says of each of SCENES, the folder with the export and the pictures). Still: keys that the clip's
    blinks animate cannot be set by hand."""
    base = tmp_path_factory.mktemp("blender_variants")
    work, _ = write_model_work(base / "work")
    job = ToyJob(work, base / "export", usdz=False, glb=False, views=False, plates=False, report_frames=1)
    export_usd.run(job)
    found = {}
    for name, variants in SCENES.items():
        (job.out / f"{name}.usda").write_text(variant_scene(capture="still", **variants), encoding="utf-8")
        command = [blender_python(), "-c", LOOK, str(job.out), name]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        found[name] = json.loads(done.stdout.partition("FOUND")[2].splitlines()[0])
    return found, job.out


def test_as_many_faces_as_the_name_says(seen):
    found, _ = seen
    assert found["full"]["faces"] == found["skin"]["faces"] > 30_000
    assert 19_998 <= found["20k"]["faces"] <= 20_000 and 4_998 <= found["5k"]["faces"] <= 5_000


@pytest.mark.parametrize("name", SCENES)
def test_shape_keys_and_textures_arrive(seen, name):
    found, folder = seen
    assert found[name]["keys"] == read_json(folder / "run.json")["actions"]["names"]
    assert not any(found[name]["values"])
    assert found[name]["pictures"] == {part: ["TEX_IMAGE", [MAP_SIZE, MAP_SIZE]]
                                       for part in ("head", "eye_right", "eye_left")}


@pytest.mark.parametrize(("name", "least_db"), [("20k", 50.0), ("5k", 38.0), ("skin", 60.0)])
@pytest.mark.parametrize("picture", ["jawOpen_0", "jawOpen_1", "mouthSmileLeft_1"])
def test_the_texture_stays_on_as_on_the_full_head(seen, name, least_db, picture):
    """The albedo alone, from the front, inside the outline."""
    _, folder = seen
    full, own = (read_rgba(folder / f"{which}_{picture}.exr") for which in ("full", name))
    inside = binary_erosion((full[..., 3] > 0.99) & (own[..., 3] > 0.99), iterations=2)
    assert inside.sum() > 8_000
    error = np.square(full[inside, :3] - own[inside, :3]).mean()
    assert -10.0 * np.log10(max(error, 1e-12)) > least_db


def test_actions_move_the_texture(seen):
    _, folder = seen
    rest, jaw = (read_rgba(folder / f"5k_jawOpen_{weight}.exr") for weight in (0, 1))
    assert np.abs(rest - jaw)[140:].mean() > 5.0 * np.abs(rest - jaw)[:100].mean()
