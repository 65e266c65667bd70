"""Hair over the scalp, a beard and a collar, as geometry that stands off the skin, shades it and hides it.

Cropped hair and a beard are the skin itself, moved outwards in tufts (wear). Longer hair is a shell with an outer and
an inner side: strands run from the crown down over an envelope of the head, ears included, end at the hairline over the
forehead, and beside and behind it hang to a ragged hem. The collar is a closed band about the neck. Both turn with the
head, and are textured in a part of the atlas that the head leaves free once its own layout is narrower.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d, maximum_filter

from shared.compute.smooth_step import smooth_step
from shared.geometry.mesh import Mesh
from shared.geometry.raycast import RayScene
from shared.imaging.material_labels import CLOTH, HAIR
from tools.synthesis.bust import quads
from tools.synthesis.head import Head
from tools.synthesis.skin import CLOTH_ALBEDO, COLLAR_SLOPE, COLLAR_Y_MM
from tools.synthesis.surface import Materials
from tools.synthesis.wear import thickened, with_beard

NO_HAIR, CROPPED, OVER_EARS, BELOW_JAW = "", "cropped", "ears", "jaw"
HAIRCUTS = (CROPPED, OVER_EARS, BELOW_JAW)
HEAD_U = 0.70
"""Share of the atlas, from the left, into which the head's own layout shrinks."""
HAIR_UV, COLLAR_UV = (0.72, 0.98, 0.32, 0.98), (0.72, 0.98, 0.03, 0.28)
"""Rectangles of the atlas: least and largest u, least and largest v."""
CROPPED_MM, CROPPED_WAVELENGTH_MM = 7.0, 4.0
CENTRE_MM = np.array([0.0, 25.0, -20.0])
"""Within the skull: hair runs along rays from here down to the ears, and hangs below."""
FAR_MM = 450.0
COLUMNS, ROWS, INNER_ROWS = 240, 72, 20
SHELL_MM = {OVER_EARS: 10.0, BELOW_JAW: 12.0}
HEM_Y_MM = {OVER_EARS: -32.0, BELOW_JAW: -125.0}
THINNEST_MM, WALL_MM, RELIEF_MM, RAGGED_MM = 1.5, 4.0, 1.0, 5.0
EQUATOR_DEG, STEP_DEG, STEP_MM = 95.0, 2.5, 4.0
HAIRLINE_DEG = ((0.0, 37.0, 50.0), (60.0, 67.0, 80.0))
"""Azimuth from the front, and the angle from the crown at which hair ends there."""
CURTAIN_DEG = (52.0, 66.0)
"""Azimuths between which the hairline turns down into hair that hangs."""
TAPER_DEG, INWARDS = 16.0, 0.12
SPINE_Z_MM, COLLAR_MM, COLLAR_GAP_MM, COLLAR_WALL_MM = -38.0, 24.0, 5.0, 3.0
STRAND_CONTRAST, SHINE = 0.35, {"specular": 0.45, "roughness": 0.42}
WOVEN = {"specular": 0.2, "roughness": 0.65}
COLLAR_BRIGHTNESS, FLARE = 1.6, 0.12
"""Of the collar beside the shirt; how fast it widens downwards."""


@dataclass(frozen=True)
class Growth:
    """haircut: one of HAIRCUTS or NO_HAIR; beard_mm: its thickness, 0: none; collar: whether there is one."""

    haircut: str = NO_HAIR
    beard_mm: float = 0.0
    collar: bool = False

    def __bool__(self) -> bool:
        return bool(self.haircut or self.beard_mm or self.collar)


def grown(head: Head, growth: Growth, seed: int) -> Head:
    """The head with what growth says, its layout in the left HEAD_U of the atlas."""
    mesh = head.mesh
    bare = RayScene(mesh.vertices, mesh.faces)
    head = replace(head, mesh=mesh.replace(uvs=mesh.uvs * [HEAD_U, 1.0]))
    if growth.beard_mm:
        head = with_beard(head, growth.beard_mm, seed)
    if growth.haircut == CROPPED:
        head = thickened(head, ("scalp",), ("ears", "neck"), CROPPED_MM, CROPPED_WAVELENGTH_MM,
                         np.random.default_rng([seed, 21]))
    elif growth.haircut:
        head = _with_grid(head, _hair_shell(bare, growth.haircut, seed), HAIR_UV, "scalp")
    return _with_grid(head, _collar(bare), COLLAR_UV, "neck") if growth.collar else head


def _hair_shell(scene: RayScene, haircut: str, seed: int) -> np.ndarray:
    """[R, COLUMNS, 3] mm: outer side from the crown to the end, then the inner side some way back up."""
    rng = np.random.default_rng([seed, 22])
    azimuth = 2 * np.pi * np.arange(COLUMNS) / COLUMNS
    off_front = np.degrees(np.abs((azimuth + np.pi) % (2 * np.pi) - np.pi))
    ends = np.interp(off_front, *HAIRLINE_DEG)
    polar = np.arange(0.0, EQUATOR_DEG + 1e-6, STEP_DEG)
    taper = np.clip((ends - polar[:, None]) / TAPER_DEG, 0.0, 1.0)
    taper = np.where(off_front >= CURTAIN_DEG[0], 1.0, taper)
    thickness = THINNEST_MM + SHELL_MM[haircut] * gaussian_filter1d(taper, 3.0, axis=1, mode="wrap")
    upper = _dome(scene, azimuth, np.radians(polar), thickness)
    down = np.arange(upper[-1, :, 1].mean() - STEP_MM, HEM_Y_MM[haircut] - 2 * RAGGED_MM, -STEP_MM)
    profile = np.concatenate([upper, _curtain(scene, azimuth, upper[-1], down, SHELL_MM[haircut])])
    ragged = gaussian_filter1d(rng.normal(size=COLUMNS), 1.2, mode="wrap") * 2.0
    hem = len(polar) + (upper[-1, :, 1].mean() - HEM_Y_MM[haircut] + RAGGED_MM * np.clip(ragged, -1, 1)) / STEP_MM - 1
    turn = smooth_step((off_front - CURTAIN_DEG[0]) / (CURTAIN_DEG[1] - CURTAIN_DEG[0]))
    last = ends / STEP_DEG + (hem - ends / STEP_DEG) * turn
    outer = _along_columns(profile, np.linspace(0.0, 1.0, ROWS)[:, None] * np.minimum(last, len(profile) - 1.001))
    strands = gaussian_filter(rng.normal(size=(ROWS, COLUMNS)), (9.0, 0.8), mode=("nearest", "wrap"))
    lift = np.clip(np.arange(ROWS) / 12.0, 0.0, 1.0)[:, None, None]
    outwards = _horizontal(azimuth)
    outer = outer + lift * (RELIEF_MM * strands / strands.std())[..., None] * outwards
    inner = outer[:-INNER_ROWS - 1:-1] - WALL_MM * outwards
    return np.concatenate([outer, inner])


def _dome(scene: RayScene, azimuth: np.ndarray, polar: np.ndarray, thickness: np.ndarray) -> np.ndarray:
    """[P, C, 3]: a smooth envelope of the head over rays from CENTRE_MM, `thickness` [P, C] outside it."""
    around = _horizontal(azimuth)
    rays = np.sin(polar)[:, None, None] * around + np.cos(polar)[:, None, None] * [0.0, 1.0, 0.0]
    radius = _outermost(scene, np.broadcast_to(CENTRE_MM, rays.shape), rays)
    radius = gaussian_filter(maximum_filter(radius, (5, 7), mode=("nearest", "wrap")), (2.0, 3.0),
                             mode=("nearest", "wrap"))
    return CENTRE_MM + (radius + thickness)[..., None] * rays


def _curtain(scene: RayScene, azimuth: np.ndarray, start: np.ndarray, heights: np.ndarray, gap_mm: float) -> np.ndarray:
    """[Y, C, 3]: hair that hangs from start [C, 3], a little inwards, at least gap_mm off the head."""
    around = _horizontal(azimuth)
    radius, rows = ((start - CENTRE_MM) * around).sum(1), []
    for height in heights:
        axis = np.broadcast_to([0.0, height, CENTRE_MM[2]], around.shape)
        head = gaussian_filter1d(maximum_filter(_outermost(scene, axis, around), 7, mode="wrap"), 3.0, mode="wrap")
        radius = np.maximum(radius - INWARDS * STEP_MM, head + gap_mm)
        rows.append(axis + radius[:, None] * around)
    return np.stack(rows)


def _collar(scene: RayScene) -> np.ndarray:
    """[R, COLUMNS, 3] mm: a band that stands on the shirt about the neck, inner side upwards, outer one down."""
    azimuth = 2 * np.pi * np.arange(COLUMNS) / COLUMNS
    around, neck_mm = _horizontal(azimuth), 65.0
    foot = COLLAR_Y_MM + COLLAR_SLOPE * (SPINE_Z_MM + neck_mm * around[:, 2])
    axis = np.stack([0 * foot, foot + COLLAR_MM, 0 * foot + SPINE_Z_MM], 1)
    neck = gaussian_filter1d(_outermost(scene, axis, around), 6.0, mode="wrap") + COLLAR_GAP_MM
    rise = np.linspace(-10.0, COLLAR_MM, 12)
    sides = []
    for wall, heights in ((COLLAR_WALL_MM, rise[::-1]), (0.0, rise)):
        radius = neck + wall + FLARE * (COLLAR_MM - heights)[:, None]
        height = np.broadcast_to(foot + heights[:, None], radius.shape)
        sides.append(np.stack([radius * around[:, 0], height, SPINE_Z_MM + radius * around[:, 2]], -1))
    inner_up, outer_down = sides[1], sides[0]
    return np.concatenate([inner_up, outer_down])


def _horizontal(azimuth: np.ndarray) -> np.ndarray:
    """[C, 3] unit, from the front towards +x."""
    return np.stack([np.sin(azimuth), 0 * azimuth, np.cos(azimuth)], -1)


def _outermost(scene: RayScene, centres: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """[...] mm from the centres [..., 3] to the outermost surface along the rays [..., 3]."""
    origins = (centres + FAR_MM * rays).reshape(-1, 3).astype(np.float32)
    distance = scene.intersect(origins, -rays.reshape(-1, 3).astype(np.float32))[2]
    return (FAR_MM - distance).reshape(rays.shape[:-1])


def _along_columns(profile: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """profile [P, C, 3] at fractional rows [R, C] -> [R, C, 3]."""
    low = np.minimum(rows.astype(int), len(profile) - 2)
    column = np.arange(profile.shape[1])
    share = (rows - low)[..., None]
    return (1 - share) * profile[low, column] + share * profile[low + 1, column]


def _with_grid(head: Head, grid: np.ndarray, rectangle: tuple[float, float, float, float], segment: str) -> Head:
    """The head with a closed band [R, C, 3] after its own vertices, its rows down a rectangle of the atlas."""
    mesh, (rows, columns) = head.mesh, grid.shape[:2]
    row, column = np.meshgrid(np.arange(rows), np.arange(columns + 1), indexing="ij")
    faces = quads(row * columns + column % columns)
    u_low, u_high, v_low, v_high = rectangle
    u = u_low + (u_high - u_low) * column / columns
    v = v_high - (v_high - v_low) * row / (rows - 1)
    joined = Mesh(
        np.concatenate([mesh.vertices, grid.reshape(-1, 3)]),
        np.concatenate([mesh.faces, faces + len(mesh.vertices)]).astype(np.int32),
        np.concatenate([mesh.uvs, np.stack([u, v], -1).reshape(-1, 2)]),
        np.concatenate([mesh.face_uvs, quads(row * (columns + 1) + column) + len(mesh.uvs)]).astype(np.int32))
    number = head.segment_names.index(segment)
    segments = np.concatenate([head.face_segment, np.full(len(faces), number, head.face_segment.dtype)])
    return replace(head, mesh=joined, face_segment=segments)


def coloured(materials: Materials, growth: Growth, hair_colour: tuple[float, float, float], seed: int) -> Materials:
    """The textures with hair and collar painted where grown has put them; neither counts as face skin."""
    size, rng = len(materials.mask), np.random.default_rng([seed, 23])
    values = {name: np.array(getattr(materials, name)) for name in ("albedo", "specular", "roughness", "mask", "label")}
    strands = gaussian_filter(rng.normal(size=(size, size)), (size / 12, 0.7))
    weave = rng.normal(size=(size, size))
    parts = []
    if growth.haircut and growth.haircut != CROPPED:
        parts.append((HAIR_UV, hair_colour, np.exp(STRAND_CONTRAST * strands / strands.std()), SHINE, HAIR))
    if growth.collar:
        cloth = tuple(COLLAR_BRIGHTNESS * np.array(CLOTH_ALBEDO))
        parts.append((COLLAR_UV, cloth, 1 + 0.1 * weave, WOVEN, CLOTH))
    for (u_low, u_high, v_low, v_high), colour, pattern, look, label in parts:
        margin = 0.008
        area = (slice(round((1 - v_high - margin) * size), round((1 - v_low + margin) * size)),
                slice(round((u_low - margin) * size), round((u_high + margin) * size)))
        values["albedo"][area] = np.clip(pattern[area][..., None] * colour, 0.01, 0.9)
        for name, value in {**look, "mask": 0.0, "label": label}.items():
            values[name][area] = value
    return Materials(**values)
