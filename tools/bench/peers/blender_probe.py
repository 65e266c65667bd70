"""Runs inside Blender's Python (the bpy wheel, an environment of its own): opens an asset and says what arrived.

    BPY_PYTHON tools/bench/peers/blender_probe.py ASSET OUT_FOLDER [--frames N ...] [--size W H] [--samples N]

Writes OUT_FOLDER/probe.json and mesh.npz, and with --samples a Cycles render OUT_FOLDER/%04d.exr of each frame through
the asset's camera. Nothing of this project is imported here; tools/bench/peers/blender.py starts it and judges.
"""

import argparse
import json
from pathlib import Path

import bpy
import numpy as np

PRINCIPLED = {"Base Color": "diffuse_albedo", "IOR": "specular_ior", "Roughness": "roughness", "Normal": "normal"}


def open_asset(path):
    """An empty scene but for the asset. The world has to exist before, or the dome light is lost."""
    bpy.ops.wm.read_factory_settings(use_empty=False)
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    if path.suffix == ".glb":
        bpy.ops.import_scene.gltf(filepath=str(path))
    else:
        bpy.ops.wm.usd_import(filepath=str(path), import_textures_mode="IMPORT_PACK")


def only(kind):
    """The objects of this kind."""
    return [thing for thing in bpy.data.objects if thing.type == kind]


def image_behind(socket):
    """File, colour space and border of the image that drives a socket; None when none does."""
    while socket.is_linked:
        node = socket.links[0].from_node
        if node.type in ("TEX_IMAGE", "TEX_ENVIRONMENT"):
            image = node.image
            pixels = bool(image.size[0] and image.size[1])
            found = {"file": Path(image.filepath).name, "colour_space": image.colorspace_settings.name,
                     "loaded": pixels, "size": list(image.size)}
            return found | ({"extension": node.extension} if node.type == "TEX_IMAGE" else {})
        named = [i for i in node.inputs if i.name in ("Color", "Image", "Vector") and i.is_linked]
        if not named:
            return None
        socket = named[0]
    return None


def mesh_arrays(thing):
    """Positions, corners, UVs and normals as Blender holds them."""
    mesh = thing.data
    vertices = np.empty(3 * len(mesh.vertices), np.float32)
    corners, uvs = np.empty(len(mesh.loops), np.int32), np.empty(2 * len(mesh.loops), np.float32)
    normals = np.empty(3 * len(mesh.loops), np.float32)
    mesh.vertices.foreach_get("co", vertices)
    mesh.loops.foreach_get("vertex_index", corners)
    mesh.uv_layers[0].uv.foreach_get("vector", uvs)
    mesh.corner_normals.foreach_get("vector", normals)
    return {"vertices": vertices.reshape(-1, 3), "corners": corners, "uvs": uvs.reshape(-1, 2),
            "normals": normals.reshape(-1, 3)}


def materials(thing):
    """{map: image} of a mesh's material, the names of its shading nodes, and its values where no image drives them."""
    tree = thing.data.materials[0].node_tree
    shader = next(node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
    found = {name: image_behind(shader.inputs[socket]) for socket, name in PRINCIPLED.items()}
    values = {PRINCIPLED[socket]: shader.inputs[socket].default_value for socket in ("IOR", "Roughness")}
    return {"maps": found, "nodes": sorted(node.type for node in tree.nodes), "values": values}


def camera_facts(camera):
    """Lens and film back, millimetres; shifts in widths of the picture."""
    lens = camera.data
    return {"lens": lens.lens, "sensor_width": lens.sensor_width, "sensor_height": lens.sensor_height,
            "sensor_fit": lens.sensor_fit, "shift": [lens.shift_x, lens.shift_y]}


def light_facts():
    """The world's picture and strength."""
    nodes = bpy.context.scene.world.node_tree.nodes
    background = next((node for node in nodes if node.type == "BACKGROUND"), None)
    if background is None:
        return None
    strength = background.inputs["Strength"].default_value
    return {"image": image_behind(background.inputs["Color"]), "strength": strength}


def relative_pose(thing, other):
    """4x4: the other's axes (a camera's: y up, looking along -z) from the thing's local ones, in the asset's unit."""
    graph = bpy.context.evaluated_depsgraph_get()
    matrices = [np.array(each.evaluated_get(graph).matrix_world) for each in (other, thing)]
    return (np.linalg.inv(matrices[0]) @ matrices[1]).tolist()


def render(scene, camera, size, samples, path):
    """Cycles on the processor, linear, transparent where there is no head."""
    settings = scene.render
    scene.camera, settings.engine, scene.cycles.device = camera, "CYCLES", "CPU"
    scene.cycles.samples, scene.cycles.use_denoising = samples, False
    settings.resolution_x, settings.resolution_y, settings.resolution_percentage = *size, 100
    settings.film_transparent, settings.filepath = True, str(path)
    image = settings.image_settings
    image.file_format, image.color_depth, image.color_mode = "OPEN_EXR", "32", "RGBA"
    bpy.ops.render.render(write_still=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("asset", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, nargs="*", default=[])
    parser.add_argument("--size", type=int, nargs=2, default=[320, 320])
    parser.add_argument("--samples", type=int, default=0)
    options = parser.parse_args()
    open_asset(options.asset.resolve())
    scene, meshes, camera = bpy.context.scene, only("MESH"), only("CAMERA")[0]
    facts = {
        "version": bpy.app.version_string,
        "meshes": sorted(thing.name for thing in meshes),
        "camera": camera_facts(camera),
        "light": light_facts(),
        "frames": [scene.frame_start, scene.frame_end],
        "fps": scene.render.fps / scene.render.fps_base,
        "properties": sorted(key for thing in bpy.data.objects for key in thing.keys()),
        "poses": {},
        "eyes": {},
    }
    head = max(meshes, key=lambda thing: len(thing.data.vertices))
    eyes = [thing for thing in meshes if thing.name.startswith("eye_")]
    facts["material"] = materials(head)
    facts["eye_materials"] = {eye.name: materials(eye) for eye in eyes}
    np.savez(options.out / "mesh.npz", **mesh_arrays(head))
    for frame in options.frames:
        scene.frame_set(frame)
        facts["poses"][str(frame)] = relative_pose(head, camera)
        facts["eyes"][str(frame)] = {eye.name: relative_pose(eye, head) for eye in eyes}
        if options.samples:
            render(scene, camera, options.size, options.samples, options.out / f"{frame:04d}.exr")
    (options.out / "probe.json").write_text(json.dumps(facts, indent=2, sort_keys=True))


if __name__ == "__main__":
    main()
