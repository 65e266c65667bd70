"""Work folders of a head that has the head model's topology, and with it facial actions and quads; how Blender's tests
open and see its export."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
from toy_result import write_toy_work

from shared.geometry.mesh import Mesh, vertex_normals
from shared.io.arrays import read_json, write_json
from shared.io.meshes import save_mesh
from shared.tracking.fit_eyeballs import set_eyeballs
from shared.tracking.models import load_head_model

FROM_THE_FRONT = """
scene.render.film_transparent = True
scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
scene.render.image_settings.color_mode = "RGBA"
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
camera.data.type, camera.data.ortho_scale = "ORTHO", 0.24
camera.matrix_world = head.matrix_world.normalized() @ Matrix.Translation((0.0, 0.0, 1.0))
scene.collection.objects.link(camera)
scene.camera = camera
"""
"""Of a script for Blender that has a scene and a head: a camera 240 mm wide before it, and pictures for read_rgba."""
HIDDEN = ("eyes", "eye_sockets", "inner_mouth")


def write_model_work(work: Path, waves_mm: float = 0.0) -> tuple[Path, Mesh]:
    """Writes work/<stage>/ as write_toy_work does, of the model's mean head -> work and the mesh. waves_mm: of waves on
    its skin that no quad can follow."""
    write_toy_work(work, eyes=True)
    model = load_head_model().subdivided()
    vertices = set_eyeballs(model, model.template)
    waves = waves_mm * np.sin(0.5 * vertices).prod(1) * ~model.surface(vertices).vertices_of(HIDDEN)
    vertices = vertices + waves[:, None] * vertex_normals(vertices, model.faces)
    mesh = Mesh(vertices, model.faces, model.uvs, model.face_uvs)
    save_mesh(work / "inverse_render" / "mesh.npz", mesh, face_segment=model.face_segment)
    tracking = read_json(work / "track_landmarks" / "tracking.json")
    write_json(work / "track_landmarks" / "tracking.json", tracking | {"segments": model.segment_names})
    return work, mesh


def variant_scene(**variants: str) -> str:
    """A scene in USD, beside head.usda, that chooses these variants of it, {set: variant}."""
    chosen = "\n".join(f'        string {name} = "{variant}"' for name, variant in variants.items())
    return f"""#usda 1.0
(
    defaultPrim = "head"
    metersPerUnit = 0.001
    upAxis = "Y"
)
def "head" (
    references = @./head.usda@
    variants = {{
{chosen}
    }}
) {{}}
"""


def read_rgba(path: Path) -> np.ndarray:
    """[H, W, 4] float64: a picture that Blender rendered with alpha."""
    with OpenEXR.File(str(path)) as file:
        return file.channels()["RGBA"].pixels.astype(np.float64)
