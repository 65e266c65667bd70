"""The head as binary glTF: mesh, textures, lens, motion and gaze for web viewers and game engines.

glTF counts metres and seconds, its cameras look along -z with y up as USD's do, its v runs downwards. Roughness is
the same (alpha = roughness^2), F0 is 0.04 without an index of refraction, and KHR_materials_specular scales it. What
the format cannot say: a shifted principal point and an environment light; both are in head.usda.

Eyeballs that are known are nodes of their own below the head's: their centre is the node's place, the gaze its
rotation, and without the animation they look straight ahead.

Hair that stands off the head is a node of its own below the head's, the same mesh in all sizes of the head. Its alpha
is cut at a half: viewers draw that without faults, while blended they would have to sort its faces from the back.

Facial actions are morph targets of places and normals, sparse, named in the mesh's extras as exporters agreed on. glTF
goes straight from 0 to 1: an in-between is a target of its own after all others, the difference from that straight way.
`eyeBlinkLeft_50` belongs to `eyeBlinkLeft`: with weight 1 - |2 w - 1| where that one has w. The animation has the
clip's blinks.

References: glTF 2.0 specification (GLB container, accessors, animations); KHR_materials_specular (F0 = min(0.04 *
specularColor, 1) * specular); KHR_materials_ior.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from shared.geometry.blend_shapes import BLINKS, BlendShape
from shared.geometry.eyeballs import EYE_ROUGHNESS, TEAR_FILM_IOR
from shared.geometry.mesh import Mesh, tangent_frames, unique_pairs, uv_tangents
from shared.geometry.parts import HAIR, HEAD, RigidPart, hair_part
from shared.io.export_maps import HAIR_MAPS, integer_codes
from shared.io.images import texture_png
from shared.io.usd_capture import UsdCapture, eye_turns, world_from_head_rigid, world_from_usd_camera

METRES_PER_MM = 0.001
_FLOAT, _UINT, _USHORT = 5126, 5125, 5123
_ARRAY, _INDEX = 34962, 34963
_LINEAR, _MIPMAPS, _CLAMP = 9729, 9987, 33071
_FIRST_EYE = 2
_SKIN, _EYE = 0, 1
_HAIR_TEXTURE = 4
_EYE_MATERIAL = {
    "name": "eye",
    "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": EYE_ROUGHNESS},
    "extensions": {"KHR_materials_ior": {"ior": TEAR_FILM_IOR}},
}
_HAIR_MATERIAL = {
    "name": "hair",
    "pbrMetallicRoughness": {"baseColorTexture": {"index": _HAIR_TEXTURE}, "metallicFactor": 0.0,
                             "roughnessFactor": 0.5},
    "alphaMode": "MASK",
    "alphaCutoff": 0.5,
    "doubleSided": True,
    "extensions": {"KHR_materials_specular": {"specularFactor": 0.0}},
}
_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


class _Buffer:
    """The binary chunk as it grows, with the views and accessors into it."""

    def __init__(self):
        self.data, self.views, self.accessors = bytearray(), [], []

    def add(self, content: bytes, target: int | None = None) -> int:
        """-> index of the view."""
        self.data += bytes(-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
        self.views.append(view if target is None else view | {"target": target})
        self.data += content
        return len(self.views) - 1

    def array(self, values: np.ndarray, target: int | None = None, bounds: bool = False) -> int:
        """[N] or [N, C] floats or unsigned integers -> index of the accessor."""
        is_index = values.dtype.kind == "u"
        values = np.ascontiguousarray(values, "<u4" if is_index else "<f4")
        columns = values.reshape(len(values), -1)
        accessor = {
            "bufferView": self.add(values.tobytes(), target),
            "componentType": _UINT if is_index else _FLOAT,
            "count": len(values),
            "type": _KINDS[columns.shape[1]],
        }
        if bounds:
            accessor |= {"min": columns.min(0).tolist(), "max": columns.max(0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def sparse(self, count: int, index: np.ndarray, *each: np.ndarray) -> list[int]:
        """For each of the values [n, 3], count vectors of 0 but those at index [n], in order, which are these
        -> indices of the accessors."""
        short = index.max(initial=0) < 2**16
        indices = {"bufferView": self.add(index.astype("<u2" if short else "<u4").tobytes()),
                   "componentType": _USHORT if short else _UINT}
        for values in each:
            values = np.ascontiguousarray(values, "<f4")
            self.accessors.append({
                "componentType": _FLOAT,
                "count": count,
                "type": _KINDS[3],
                "min": np.minimum(values.min(0), 0.0).tolist(),
                "max": np.maximum(values.max(0), 0.0).tolist(),
                "sparse": {"count": len(index), "indices": indices,
                           "values": {"bufferView": self.add(values.tobytes())}},
            })
        return list(range(len(self.accessors) - len(each), len(self.accessors)))


def write_glb(
    path: Path | str,
    name: str,
    parts: Sequence[RigidPart],
    maps: Mapping[str, np.ndarray],
    capture: UsdCapture,
    actions: Sequence[BlendShape] = (),
    hair: Mesh | None = None,
) -> None:
    """One file with all inside. parts: the head, then the eyeballs that are to be nodes of their own, as head_parts has
    them; maps: diffuse_albedo, specular_intensity, roughness and normal, as exported, with hair hair_albedo and
    hair_alpha, too; actions: blend shapes of the whole mesh, which move no eyeball; hair: what stands off the head."""
    buffer = _Buffer()
    textures, skin = _material(buffer, maps)
    width, height = capture.width, capture.height
    head, *turning = parts
    nodes = [{"name": HEAD, "mesh": 0}, {"name": "camera", "camera": 0}]
    if turning:
        nodes[0]["children"] = [_FIRST_EYE + k for k in range(len(turning))]
        nodes += [{"name": eye.name, "mesh": 1 + k, "translation": (eye.pivot * METRES_PER_MM).tolist()}
                  for k, eye in enumerate(turning)]
    targets = list(_morph_targets([shape.of_part(head.vertices) for shape in actions]))
    meshes = [{"name": HEAD, "primitives": [_primitive(buffer, head, _SKIN, targets)]}]
    if targets:
        meshes[0] |= {"weights": [0.0] * len(targets), "extras": {"targetNames": [shape.name for shape in targets]}}
    meshes += [{"name": eye.name, "primitives": [_primitive(buffer, eye, _EYE)]} for eye in turning]
    materials = [skin, _EYE_MATERIAL] if turning else [skin]
    if hair is not None:
        nodes[0].setdefault("children", []).append(len(nodes))
        nodes.append({"name": HAIR, "mesh": len(meshes)})
        meshes.append({"name": HAIR, "primitives": [_primitive(buffer, hair_part(hair), len(materials))]})
        materials.append(_HAIR_MATERIAL)
        textures.append(_hair_picture(buffer, maps))
    content = {
        "asset": {"version": "2.0", "generator": "Limn"},
        "scene": 0,
        "scenes": [{"name": name, "nodes": [0, 1]}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": materials,
        "extensionsUsed": ["KHR_materials_ior", "KHR_materials_specular"] if turning else ["KHR_materials_specular"],
        "samplers": [{"magFilter": _LINEAR, "minFilter": _MIPMAPS, "wrapS": _CLAMP, "wrapT": _CLAMP}],
        "images": [{"bufferView": view, "mimeType": "image/png"} for view in textures],
        "textures": [{"sampler": 0, "source": k} for k in range(len(textures))],
        "cameras": [{
            "name": "camera",
            "type": "perspective",
            "perspective": {
                "yfov": float(2.0 * np.arctan(0.5 * height / capture.intrinsics[1, 1])),
                "aspectRatio": float(width * capture.intrinsics[1, 1] / (height * capture.intrinsics[0, 0])),
                "znear": 0.01,
            },
        }],
        "animations": [_animation(buffer, capture, len(turning), [target.name for target in targets])],
    }
    content |= {
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    _write_container(Path(path), content, bytes(buffer.data))


def _morph_targets(shapes: Sequence[BlendShape]) -> Iterator[BlendShape]:
    """The shapes, each straight from 0 to 1, then what their in-betweens add to that way."""
    for shape in shapes:
        yield BlendShape(shape.name, shape.vertices, shape.offsets,
                         normals=None if shape.normals is None else shape.normals[:1])
    for shape in shapes:
        for k, (weight, offsets) in enumerate(shape.between, 1):
            normals = None if shape.normals is None else shape.normals[k] - weight * shape.normals[0]
            yield BlendShape(f"{shape.name}_{round(100 * weight)}", shape.vertices, offsets - weight * shape.offsets,
                             normals=None if normals is None else normals[None])


def _primitive(buffer: _Buffer, part: RigidPart, material: int, targets: Sequence[BlendShape] = ()) -> dict:
    """glTF knows one index per corner: vertices are doubled along texture seams. The skin, which has a normal map, also
    gets tangents. targets: see _morph_targets; what they move comes first, so that two bytes are enough for its
    indices."""
    mesh = part.mesh
    corners, index, _ = unique_pairs(np.column_stack([mesh.faces.ravel(), mesh.face_uvs.ravel()]))
    moving = np.zeros(len(mesh.vertices), bool)
    for target in targets:
        moving[target.vertices] = True
    order = np.argsort(~moving[corners[:, 0]], kind="stable")
    vertex, coordinate = corners[order].T
    index = np.argsort(order)[index]
    attributes = {
        "POSITION": buffer.array(mesh.vertices[vertex] * METRES_PER_MM, _ARRAY, bounds=True),
        "NORMAL": buffer.array(part.normals[vertex], _ARRAY),
        "TEXCOORD_0": buffer.array(mesh.uvs[coordinate] * [1.0, -1.0] + [0.0, 1.0], _ARRAY),
    }
    primitive = {"attributes": attributes, "indices": buffer.array(index.astype(np.uint32), _INDEX),
                 "material": material}
    if material == _SKIN:
        tangents = np.empty((len(corners), 4))
        tangents[index] = _tangents(part)
        attributes["TANGENT"] = buffer.array(tangents, _ARRAY)
    if targets:
        primitive["targets"] = [_morph_target(buffer, vertex, target) for target in targets]
    return primitive


def _tangents(part: RigidPart) -> np.ndarray:
    """[3 F, 4] of the faces' corners: unit direction of growing u, and 1 where normal x tangent is that of growing v as
    maps have it, upwards, else -1; any tangent where the UVs say none."""
    mesh = part.mesh
    normals, bary = part.normals[mesh.faces.ravel()], np.tile(np.eye(3), (len(mesh.faces), 1))
    along, across = np.moveaxis(uv_tangents(mesh, normals, np.repeat(np.arange(len(mesh.faces)), 3), bary), 1, 0)
    lost = np.linalg.norm(along, axis=1) < 0.5
    along[lost] = tangent_frames(normals[lost])[:, 0]
    return np.column_stack([along, np.where((np.cross(normals, along) * across).sum(1) < 0.0, -1.0, 1.0)])


def _morph_target(buffer: _Buffer, vertex: np.ndarray, shape: BlendShape) -> dict[str, int]:
    """Accessors for corners that are each a vertex [n] of the mesh."""
    row = np.full(int(vertex.max()) + 1, -1)
    row[shape.vertices] = np.arange(len(shape.vertices))
    index = np.nonzero(row[vertex] >= 0)[0]
    moved = row[vertex[index]]
    values = [shape.offsets[moved] * METRES_PER_MM]
    if shape.normals is not None:
        values.append(shape.normals[0, moved])
    return dict(zip(("POSITION", "NORMAL"), buffer.sparse(len(vertex), index, *values), strict=False))


def _material(buffer: _Buffer, maps: Mapping[str, np.ndarray]) -> tuple[list[int], dict]:
    """Views of the four pictures, and the material that reads them."""
    roughness = integer_codes("roughness", maps["roughness"], 8)
    nothing = np.zeros_like(roughness)
    strongest = max(1.0, float(maps["specular_intensity"].max()))
    share = np.clip(maps["specular_intensity"] / strongest, 0.0, 1.0)
    weight = (share * 255.0 + 0.5).astype(np.uint8)
    white = np.full_like(weight, 255)
    pictures = (
        integer_codes("diffuse_albedo", maps["diffuse_albedo"], 8),
        np.stack([nothing, roughness, nothing], axis=-1),
        integer_codes("normal", maps["normal"], 8),
        np.stack([white, white, white, weight], axis=-1),
    )
    specular = {"specularTexture": {"index": 3}, "specularColorFactor": [strongest] * 3}
    material = {
        "name": "skin",
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0},
            "metallicRoughnessTexture": {"index": 1},
            "metallicFactor": 0.0,
            "roughnessFactor": 1.0,
        },
        "normalTexture": {"index": 2},
        "extensions": {"KHR_materials_specular": specular},
    }
    return [buffer.add(texture_png(picture)) for picture in pictures], material


def _hair_picture(buffer: _Buffer, maps: Mapping[str, np.ndarray]) -> int:
    """View of the picture with hair's colour and alpha."""
    colour, alpha = (integer_codes(name, maps[name], 8) for name in HAIR_MAPS)
    return buffer.add(texture_png(np.dstack([colour, alpha])))


def _animation(buffer: _Buffer, capture: UsdCapture, eye_count: int, targets: Sequence[str]) -> dict:
    """The motion of what moved, head (node 0) or camera (node 1), from 0 s at the first frame; how the eyes turn; and
    the weights of the head's morph targets, where the clip blinks."""
    node = 1 if capture.moves == "camera" else 0
    world_from_local = world_from_usd_camera(capture) if node else world_from_head_rigid(capture)
    time = buffer.array(_seconds(capture, capture.frame_index), bounds=True)
    tracks = [
        (node, "translation", time, buffer.array(world_from_local[:, :3, 3] * METRES_PER_MM)),
        (node, "rotation", time, buffer.array(_quaternions(world_from_local[:, :3, :3]))),
    ]
    for k in range(eye_count):
        frames, rotations = eye_turns(capture, k)
        if len(frames):
            open_eyes = buffer.array(_seconds(capture, frames), bounds=True)
            tracks.append((_FIRST_EYE + k, "rotation", open_eyes, buffer.array(_quaternions(rotations))))
    if targets and capture.moves_actions:
        tracks.append((0, "weights", time, buffer.array(_target_weights(targets, capture).ravel())))
    return {
        "name": "clip",
        "samplers": [{"input": times, "output": values, "interpolation": "LINEAR"} for _, _, times, values in tracks],
        "channels": [{"sampler": k, "target": {"node": moved, "path": kind}}
                     for k, (moved, kind, _, _) in enumerate(tracks)],
    }


def _target_weights(targets: Sequence[str], capture: UsdCapture) -> np.ndarray:
    """[F, len(targets)]: those of the clip's actions, and of the blinks' in-betweens."""
    weights = capture.weights_of(targets)
    for name in BLINKS:
        if f"{name}_50" in targets:
            weights[:, targets.index(f"{name}_50")] = 1.0 - np.abs(2.0 * weights[:, targets.index(name)] - 1.0)
    return weights


def _seconds(capture: UsdCapture, frames: np.ndarray) -> np.ndarray:
    return (frames - capture.frame_index[0]) / capture.fps


def _quaternions(rotations: np.ndarray) -> np.ndarray:
    """[F, 3, 3] -> [F, 4], x y z w, neighbours in one hemisphere."""
    quaternions = Rotation.from_matrix(rotations).as_quat()
    flips = np.cumprod(np.where((quaternions[1:] * quaternions[:-1]).sum(1) < 0.0, -1.0, 1.0))
    quaternions[1:] *= flips[:, None]
    return quaternions


def _write_container(path: Path, content: dict, binary: bytes) -> None:
    text = json.dumps(content, separators=(",", ":"), sort_keys=True, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    header = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    path.write_bytes(header + chunks)
