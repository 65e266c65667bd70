"""Where the 468 landmarks lie on the head model: render it, run the networks, cast the answers back onto the
mesh.

The networks answer a little differently for each view, light and face, so the place of a landmark is the
median over many renderings, and its spread there decides the landmark's weight.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from shared.capture.landmarks import LANDMARK_COUNT, OVAL, FaceNetworks
from shared.compute.robust import ROBUST_SCALE, cauchy_weight
from shared.geometry.mesh import interpolate, normalised, vertex_normals
from shared.geometry.raycast import RayScene, camera_hits
from shared.geometry.transforms import rigid, rotation_from_vector
from shared.tracking.head_model import HeadModel, parent_location
from tools.setup.head_model.topology import EYE_LEFT, EYE_RIGHT, LIP_RINGS, MOUTH, SKIN, HeadTopology, rings_around

RENDER_SIZE = 320
FOCAL_LENGTH_PX = 900.0
DISTANCE_MM = 1000.0
SKIN_RGB = (0.62, 0.42, 0.33)
LIP_RGB = (0.52, 0.24, 0.22)
EYE_WHITE_RGB = (0.75, 0.72, 0.7)
IRIS_RGB = (0.08, 0.05, 0.03)
IRIS_COSINE = 0.87
YAWS_DEG = (-16, -5, 5, 16)
PITCHES_DEG = (-8, 6)
LIGHTS = ((0.35, 0.45, 0.8), (-0.35, 0.45, 0.8))
IDENTITY_DEVIATION = 0.7
SPREAD_MM = 3.0
"""Spread at which a landmark's weight has fallen to one half."""
SAME_PLACE_MM = 1e-6
"""Places on two faces this near to each other are one on their common edge, as the landmarks of the midline are."""
MAX_SPREAD_MM = 8.0
SEED = 468


@dataclass(frozen=True)
class Embedding:
    """face [468], bary [468, 3], weight [468] as in HeadModel."""

    face: np.ndarray
    bary: np.ndarray
    weight: np.ndarray


def embed_landmarks(model: HeadModel, topology: HeadTopology, networks: FaceNetworks) -> Embedding:
    """Places on the skin of `model` (level 0)."""
    fine = model.subdivided().subdivided()
    colour = _colours(fine, topology, model.template)
    rng = np.random.default_rng(SEED)
    places = []
    for yaw, pitch in product(YAWS_DEG, PITCHES_DEG):
        for light in LIGHTS:
            vertices = fine.shape(rng.normal(0, IDENTITY_DEVIATION, len(fine.identity_basis)))
            places.append(_landmarks_on_surface(fine, vertices, colour, networks, np.radians([pitch, yaw]), light))
    places = np.stack(places)
    middle = np.nanmedian(places, axis=0)
    spread = ROBUST_SCALE * np.nanmedian(np.linalg.norm(places - middle, axis=2), axis=0)
    middle = _symmetric(middle)
    face, bary = _closest(fine, np.repeat(topology.part == SKIN, 16), middle)
    for _ in range(2):
        face, bary = parent_location(face, bary)
    weight = cauchy_weight(spread, SPREAD_MM)
    weight[list(OVAL)] = 0
    weight[spread > MAX_SPREAD_MM] = 0
    return Embedding(face, bary, weight)


def render_head(
    vertices: np.ndarray,
    faces: np.ndarray,
    colour: np.ndarray,
    rotation: np.ndarray,
    light: tuple[float, float, float],
    size: int = RENDER_SIZE,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A plain picture of a head: uint8 [size, size, 3] RGB, and what each pixel shows: face [H, W], bary [H,
    W, 3].

    colour [V, 3] linear; rotation [3, 3] turns the head before a camera on the z axis; light: direction in
    camera axes with y up, z towards the camera.
    """
    scale = size / RENDER_SIZE
    intrinsics = np.array([[FOCAL_LENGTH_PX * scale, 0, size / 2], [0, FOCAL_LENGTH_PX * scale, size / 2], [0, 0, 1]])
    flip = np.diag([1.0, -1.0, -1.0])
    camera_from_head = rigid(flip @ rotation, np.array([0, 0, DISTANCE_MM]))
    face, bary, _ = camera_hits(RayScene(vertices, faces), camera_from_head, intrinsics, size, size)
    seen = face >= 0
    normals = normalised(interpolate(vertex_normals(vertices, faces), faces, face[seen], bary[seen]))
    direction = normalised(np.array(light)) @ rotation
    irradiance = 0.35 + 0.65 * np.clip(normals @ direction, 0, 1)
    linear = np.full((size, size, 3), 0.2)
    linear[seen] = interpolate(colour, faces, face[seen], bary[seen]) * irradiance[:, None]
    return np.uint8(255 * np.clip(linear, 0, 1) ** (1 / 2.2)), face, bary


def _colours(fine: HeadModel, topology: HeadTopology, template: np.ndarray) -> np.ndarray:
    """[V, 3] skin, lips, white eyeballs with dark irises looking ahead, so that the networks see a face."""
    colour = np.tile(np.array(SKIN_RGB), (len(fine.template), 1))
    lips = rings_around(topology, (MOUTH,), LIP_RINGS) >= 0
    colour[fine.faces[np.repeat(lips, 16)]] = LIP_RGB
    for part in (EYE_LEFT, EYE_RIGHT):
        members = np.unique(fine.faces[np.repeat(topology.part == part, 16)])
        outward = normalised(fine.template[members] - template[topology.vertices_of(part)].mean(0))
        colour[members] = np.where(outward[:, 2:] > IRIS_COSINE, IRIS_RGB, EYE_WHITE_RGB)
    return colour


def _landmarks_on_surface(
    fine: HeadModel,
    vertices: np.ndarray,
    colour: np.ndarray,
    networks: FaceNetworks,
    pitch_yaw: np.ndarray,
    light: tuple[float, float, float],
) -> np.ndarray:
    """Where one rendering's landmarks fall: places [468, 3] on the template (NaN: beside the head)."""
    rotation = rotation_from_vector(np.array([pitch_yaw[0], 0, 0])) @ rotation_from_vector(
        np.array([0, pitch_yaw[1], 0])
    )
    picture, face, bary = render_head(vertices, fine.faces, colour, rotation, light)
    found = networks.detect(picture)
    if not found:
        return np.full((LANDMARK_COUNT, 3), np.nan)
    _, points = networks.landmarks(picture, found[0])
    column, row = np.clip(np.floor(points[:, :2]).astype(int), 0, RENDER_SIZE - 1).T
    face, bary = face[row, column], bary[row, column]
    place = interpolate(fine.template, fine.faces, face, bary)
    place[face < 0] = np.nan
    return place


def mirror_partners(places: np.ndarray) -> np.ndarray:
    """[N] the landmark on the other side of the face, for places [N, 3] on a symmetric head; -1 where none is."""
    mirrored = places * (-1, 1, 1)
    partner = cKDTree(mirrored).query(places)[1]
    return np.where(partner[partner] == np.arange(len(places)), partner, -1)


def _symmetric(places: np.ndarray) -> np.ndarray:
    """Mean of each landmark and its mirrored partner."""
    partner = mirror_partners(places)
    return np.where(partner[:, None] >= 0, (places + places[partner] * (-1, 1, 1)) / 2, places)


def _closest(fine: HeadModel, allowed: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Closest place to each point on the allowed faces: face [N], bary [N, 3]; of faces that share it the first."""
    index = np.nonzero(allowed)[0]
    corners = fine.template[fine.faces[index]]
    near = cKDTree(corners.mean(1)).query(points, k=12)[1]
    a, b, c = (corners[near, k] for k in range(3))
    bary = _clamped_bary(points[:, None], a, b, c)
    found = (bary[..., None] * corners[near]).sum(2)
    away = np.linalg.norm(found - points[:, None], axis=2)
    shares = away <= away.min(axis=1, keepdims=True) + SAME_PLACE_MM
    best = np.argmin(np.where(shares, near, len(index)), axis=1)
    rows = np.arange(len(points))
    return index[near[rows, best]].astype(np.int32), bary[rows, best]


def _clamped_bary(p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Barycentric coordinates [..., 3] of p's foot on the triangle a b c, pushed inside where it falls
    outside.
    """
    u, v, w = b - a, c - a, p - a
    uu, uv, vv = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    wu, wv = (w * u).sum(-1), (w * v).sum(-1)
    area = np.maximum(uu * vv - uv * uv, 1e-12)
    second, third = (vv * wu - uv * wv) / area, (uu * wv - uv * wu) / area
    bary = np.clip(np.stack([1 - second - third, second, third], axis=-1), 0, None)
    return bary / bary.sum(-1, keepdims=True)
