"""What tools/relight/command.py reads: a result or any mesh, a light, and the lens and poses of the clip."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenImageIO

from shared.contract.manifest import read_record
from shared.errors import InputError
from shared.geometry.blend_shapes import LID_ACTIONS, LidActions
from shared.geometry.eyeballs import fit_eyeball, pitch_from_rest
from shared.geometry.mesh import Mesh, midpoint_subdivision
from shared.geometry.parts import EYES, head_parts
from shared.geometry.transforms import WORLD_FROM_CAMERA, rotation_from_vector
from shared.hair.hair_files import read_hair
from shared.hair.joined import joined_maps, joined_mesh
from shared.imaging.turning_eyes import TurningEyes
from shared.io.arrays import load_arrays
from shared.io.export_maps import map_path
from shared.io.exr_picture import read_rec709
from shared.io.meshes import load_mesh, read_obj, read_obj_groups
from shared.io.usd_actions import read_actions
from shared.rendering.near_lamp import NearLamp
from shared.rendering.studio_lights import STUDIO_LIGHTS, studio_light

MAPS = ("diffuse_albedo", "specular_intensity", "roughness")
OWN_LIGHT = "clip"
MESH_HEIGHT_MM, LEAST_VERTICES = 260.0, 10_000
"""Meshes of unknown unit are scaled to this height; sparse ones are split, since light is computed at the vertices."""
_LARGEST_LIGHT = 8192


@dataclass(frozen=True)
class Asset:
    """What is to be lit: mesh (mm, y up, facing +z) and maps by name, of the head and of hair that has a surface of its
    own, whose vertices and faces then come last; of a result also its light, poses [F, 4, 4] with
    frame_index [F], intrinsics [3, 3] of the source frame, what moved in the clip, its light's lamp where that stands
    near; of an export with a gaze, the eyes, and how they turn in each frame, eye_turn [F, 2, 2] radians; of one whose
    lids move, the actions that move them, how far its eyes are shut, shut [F, 2], and how far they look up from where
    they do with lids at rest, pitch [F, 2] radians. head_faces: how many of the mesh's faces are the head's where hair
    has some of its own; None: all."""

    mesh: Mesh
    maps: dict[str, np.ndarray]
    envmap: np.ndarray | None = None
    poses: np.ndarray | None = None
    frame_index: np.ndarray | None = None
    intrinsics: np.ndarray | None = None
    moves: str = "head"
    lamp: NearLamp | None = None
    eyes: TurningEyes | None = None
    eye_turn: np.ndarray | None = None
    lids: LidActions | None = None
    shut: np.ndarray | None = None
    pitch: np.ndarray | None = None
    head_faces: int | None = None


def open_asset(path: Path, albedo: tuple[float, ...], specular: float, roughness: float) -> Asset:
    """A result's folder (export/, work/inverse_render/, or what holds one of them), or a mesh file, which gets the
    material given. InputError where it is neither."""
    if path.is_dir():
        return _open_result(path)
    if not path.is_file():
        raise InputError("no such folder or file", where=str(path), expected="a result's folder or a mesh")
    return Asset(_fitted(_read_mesh(path)), even_maps(albedo, specular, roughness))


def even_maps(albedo: tuple[float, ...], specular: float, roughness: float) -> dict[str, np.ndarray]:
    """Maps of one material all over."""
    values = (
        np.broadcast_to(np.float32(albedo), (2, 2, 3)).copy(),
        np.full((2, 2), specular, np.float32),
        np.full((2, 2), roughness, np.float32),
    )
    return dict(zip(MAPS, values, strict=True))


def _open_result(path: Path) -> Asset:
    places = (path, path / "export", path / "work" / "inverse_render", path / "inverse_render")
    folder = next((place for place in places if (place / "maps").is_dir() and (place / "poses.npz").is_file()), None)
    if folder is None:
        raise InputError(
            "no result in this folder",
            where=str(path),
            expected="maps/ and poses.npz",
            hint="name an export/ folder, or run limn first",
        )
    mesh = load_mesh(folder / "mesh.npz") if (folder / "mesh.npz").is_file() else read_obj(folder / "mesh.obj")
    arrays = load_arrays(folder / "poses.npz")
    for name in ("camera_from_head", "frame_index", "intrinsics"):
        if name not in arrays:
            raise InputError(f"no {name}", where=str(folder / "poses.npz"), got=", ".join(sorted(arrays)))
    count = arrays["frame_index"].size
    for name, shape in (("camera_from_head", (count, 4, 4)), ("frame_index", (count,)), ("intrinsics", (3, 3))):
        if arrays[name].dtype.kind not in "fiu" or arrays[name].shape != shape:
            raise InputError(f"{name} is damaged", where=str(folder / "poses.npz"), got=arrays[name].shape,
                             expected=shape)
    maps = {name: _read_map(folder, name) for name in MAPS}
    head = mesh
    if (hair := read_hair(folder)) is not None:
        mesh, maps = joined_mesh(mesh, hair.mesh), joined_maps(maps, hair)
    return Asset(
        mesh,
        maps,
        read_rec709(folder / "envmap.exr"),
        arrays["camera_from_head"].astype(np.float64),
        arrays["frame_index"],
        arrays["intrinsics"].astype(np.float64),
        *_light_of_clip(folder),
        **_eyes_of_clip(folder, head, mesh, arrays),
        head_faces=None if hair is None else len(head.faces),
    )


def _read_map(folder: Path, name: str) -> np.ndarray:
    path = folder / map_path(folder, name)
    if not path.is_file():
        raise InputError("a map is missing", where=str(path))
    return read_rec709(path)


def _light_of_clip(folder: Path) -> tuple[str, NearLamp | None]:
    """What moved against the light, and the light's lamp where that stands near."""
    for name in ("run.json", "solve.json"):
        if (folder / name).is_file():
            record = read_record(folder / name)
            if record is None:
                raise InputError("not a record of a run", where=str(folder / name))
            model, lamp = record.get("model", {}), record.get("lamp") or {}
            moves = "camera" if isinstance(model, dict) and model.get("moves") == "camera" else "head"
            return moves, NearLamp.of_record(lamp)
    raise InputError("neither run.json nor solve.json", where=str(folder), hint="name a complete result")


def _eyes_of_clip(folder: Path, head: Mesh, mesh: Mesh, poses: dict[str, np.ndarray]) -> dict:
    """The fields of Asset for the eyes and lids of an export; none where the gaze is not known. mesh: the head's,
    perhaps with more after it."""
    if "eye_turn" not in poses or not (folder / "mesh.obj").is_file():
        return {}
    groups = read_obj_groups(folder / "mesh.obj")
    if missing := [name for name in EYES if name not in groups]:
        raise InputError("no group of an eye", where=str(folder / "mesh.obj"), expected=", ".join(missing))
    balls = tuple(fit_eyeball(head, groups[name]) for name in EYES)
    found = {"eyes": TurningEyes(mesh, balls), "eye_turn": poses["eye_turn"]}
    lids = None
    if {"lids", "gaze"} <= poses.keys() and (folder / "head.usda").is_file():
        lids = LidActions.of(read_actions(folder / "head.usda", head_parts(head, balls)[0].vertices, LID_ACTIONS))
    if lids is not None:
        found |= {"lids": lids, "shut": poses["lids"], "pitch": pitch_from_rest(poses["gaze"])}
    return found


def _read_mesh(path: Path) -> Mesh:
    """.obj and .npz by our own readers; what else there is by trimesh, an optional dependency."""
    if path.suffix.lower() == ".npz":
        return load_mesh(path)
    if path.suffix.lower() == ".obj":
        return read_obj(path)
    try:
        import trimesh
    except ImportError as error:
        raise InputError("this kind of mesh needs trimesh", where=str(path), hint="pip install trimesh") from error
    try:
        found = trimesh.load(path, force="mesh")
        found.merge_vertices(merge_tex=True, merge_norm=True)
        vertices, faces = np.asarray(found.vertices, np.float64), np.asarray(found.faces, np.int32)
    except Exception as error:  # trimesh raises whatever its many readers raise
        raise InputError(
            "not a readable mesh", where=str(path), got=error, expected=".obj, .npz, .glb, .ply, .stl"
        ) from error
    if len(faces) == 0 or not np.isfinite(vertices).all():
        raise InputError("no faces, or vertices that are not finite", where=str(path))
    return Mesh(vertices, faces, np.zeros((1, 2)), np.zeros_like(faces))


def _fitted(mesh: Mesh) -> Mesh:
    """Centred, MESH_HEIGHT_MM high along its longest edge of the box, and split to LEAST_VERTICES."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    if not (high - low).max() > 0.0:
        raise InputError("all vertices of the mesh lie in one place", got=f"{len(mesh.vertices)} vertices")
    mesh = mesh.replace(vertices=(mesh.vertices - 0.5 * (low + high)) * (MESH_HEIGHT_MM / float((high - low).max())))
    while len(mesh.vertices) < LEAST_VERTICES:
        geometry, faces = midpoint_subdivision(mesh.faces, len(mesh.vertices))
        texture, face_uvs = midpoint_subdivision(mesh.face_uvs, len(mesh.uvs))
        mesh = Mesh(geometry @ mesh.vertices, faces.astype(np.int32), texture @ mesh.uvs, face_uvs.astype(np.int32))
    return mesh


def read_light(name: str, asset: Asset) -> np.ndarray:
    """[H, 2 H, 3] float64: a studio light by name, the clip's own ("clip"), or a lat-long .hdr or .exr file."""
    if name in STUDIO_LIGHTS:
        return studio_light(name)
    if name == OWN_LIGHT:
        if asset.envmap is None:
            raise InputError("a mesh has no light of its own", where="--light", got=name)
        return asset.envmap.astype(np.float64)
    path = Path(name)
    if path.suffix.lower() not in (".hdr", ".exr") or not path.is_file():
        known = ", ".join([OWN_LIGHT, *STUDIO_LIGHTS])
        raise InputError("no such light", where="--light", got=name, expected=f"a .hdr or .exr file, or one of {known}")
    image = read_rec709(path) if path.suffix.lower() == ".exr" else _read_hdr(path)
    image = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image
    height, width = image.shape[:2]
    if width != 2 * height or height < 2 or height > _LARGEST_LIGHT:
        raise InputError(
            "not a lat-long map", where=str(path), got=f"{width} x {height}", expected="twice as wide as high"
        )
    if not np.isfinite(image).all() or image.max() <= 0.0:
        raise InputError("radiance is not finite, or nothing shines", where=str(path))
    return np.maximum(image, 0.0).astype(np.float64)


def _read_hdr(path: Path) -> np.ndarray:
    """Radiance RGBE -> [H, W, 3] float32."""
    source = OpenImageIO.ImageInput.open(str(path))
    pixels = source.read_image("float") if source else None
    if pixels is None or pixels.ndim != 3 or pixels.shape[2] < 3:
        raise InputError("not a readable .hdr image", where=str(path), got=OpenImageIO.geterror().split("\n")[0])
    return pixels[..., :3]


def turned_light(light: np.ndarray, yaw_deg: float) -> np.ndarray:
    """The light turned about the vertical: what stood in front stands yaw_deg further to the picture's right."""
    from shared.rendering.views import light_in_head_space

    return (
        light if yaw_deg == 0.0 else light_in_head_space(light, rotation_from_vector(np.radians([0.0, -yaw_deg, 0.0])))
    )


def turned_head(mesh: Mesh, camera_from_head: np.ndarray, yaw_deg: float, pitch_deg: float) -> np.ndarray:
    """The pose of a head that turns about its middle before a camera that stands still: yaw to the picture's right,
    then pitch upwards. camera_from_head [4, 4]: how it stands without."""
    middle = 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))
    pitch, yaw = (rotation_from_vector(np.radians(v)) for v in ([-pitch_deg, 0.0, 0.0], [0.0, yaw_deg, 0.0]))
    turn = WORLD_FROM_CAMERA.T @ pitch @ yaw @ WORLD_FROM_CAMERA
    pose = camera_from_head.copy()
    centre = camera_from_head[:3, :3] @ middle + camera_from_head[:3, 3]
    pose[:3, :3] = turn @ camera_from_head[:3, :3]
    pose[:3, 3] = centre - pose[:3, :3] @ middle
    return pose
