"""A ball of a head with hair that stands off it, in drawn pictures: what of them is hair is known."""

import numpy as np
from shapes import nods, sphere

from shared.geometry.raycast import RayScene, camera_hits, pixel_directions
from shared.geometry.surface import Surface
from shared.imaging.image_sampling import prepare_picture
from shared.imaging.material_labels import HAIR, LABELS, SKIN
from shared.imaging.views import Views

HEAD_MM, HAIR_MM, HAIRLINE_MM = 80.0, 96.0, 25.0
LENS = np.array([[600.0, 0, 100], [0, 600.0, 100], [0, 0, 1]])
SIZE = (200, 200)
HAIR_CODE, SKIN_CODE, WALL_CODE, SHIRT_CODE = (60, 35, 20), (200, 150, 120), (90, 130, 160), (40, 45, 70)
SHIRT_ROW = 165
SEGMENTS = ("scalp", "forehead", "ears", "chin", "neck", "nose")


def toy_surface():
    """A ball: scalp on top and behind, ears as bumps at its sides, chin and neck below, the rest a face."""
    ball = sphere(HEAD_MM, 5)
    x, y, z = ball.vertices.T
    bump = 9.0 * np.exp(-((np.abs(x) - HEAD_MM) ** 2 + (y + 20.0) ** 2 + z**2) / 200.0)
    mesh = ball.replace(vertices=ball.vertices * (1.0 + bump / HEAD_MM)[:, None])
    cx, cy, cz = ball.vertices[ball.faces].mean(1).T
    kind = np.select(
        [(np.abs(cx) > 70.0) & (np.abs(cy + 20.0) < 20.0), (cy > 40.0) | (cz < 0.0) & (cy > -40.0), cy > 25.0,
         cy < -60.0, cy < -45.0], [2, 0, 1, 4, 3], 5)
    return Surface(mesh, kind, SEGMENTS)


def is_hair(places):
    """[N] bool: what of a ball about the head is hair: above the forehead, and everything at the sides and behind."""
    return (places[:, 1] > HAIRLINE_MM) | (places[:, 2] < 30.0)


def drawn(surface, pose, haired, bearded):
    """Codes [H, W, 3], mask [H, W] and which pixels are hair [H, W] of a frame: a shirt and a neck below, the ball
    before them."""
    codes, mask = np.full((*SIZE[::-1], 3), WALL_CODE, np.uint8), np.zeros(SIZE[::-1], np.uint8)
    codes[140:, 86:114], mask[140:, 86:114] = SKIN_CODE, 128
    codes[SHIRT_ROW:], mask[SHIRT_ROW:] = SHIRT_CODE, 128
    hair = np.zeros(SIZE[::-1], bool)
    rays, balls = pixel_directions(LENS, *SIZE), sphere(HAIR_MM, 5)
    for mesh, code in ((surface.mesh, SKIN_CODE), (balls, HAIR_CODE)):
        face, _, depth = camera_hits(RayScene(mesh.vertices, mesh.faces), pose, LENS, *SIZE)
        hit = face >= 0
        if code == HAIR_CODE:
            if not haired:
                continue
            hit[hit] = is_hair((rays[hit] * depth[hit][:, None] - pose[:3, 3]) @ pose[:3, :3])
        codes[hit], mask[hit] = code, 128
        if code == SKIN_CODE and bearded:
            codes[hit & np.isin(face, np.nonzero(surface.faces_of(("chin",)))[0])] = HAIR_CODE
        hair[hit] = code == HAIR_CODE
    return codes, mask, hair


def hairy_ball(haired, bearded=False):
    """Its Surface, Views, the materials of its vertices [V, len(LABELS)], and which pixels are hair [F, H, W]."""
    surface = toy_surface()
    poses = nods(np.linspace(-50.0, 50.0, 9))
    frames = [drawn(surface, pose, haired, bearded) for pose in poses]

    def read_picture(f):
        codes, mask, _ = frames[f]
        return prepare_picture(codes, (codes / 255.0).astype(np.float32) ** 2.2, mask)

    views = Views.in_one_light(poses, LENS, SIZE, "head", read_picture, lambda f: frames[f][1])
    materials = np.zeros((len(surface.mesh.vertices), len(LABELS)))
    scalp = surface.vertices_of(("scalp",))
    materials[scalp, HAIR if haired else SKIN] = 1.0
    materials[~scalp, SKIN] = 1.0
    if bearded:
        chin = surface.vertices_of(("chin",))
        materials[chin] = np.eye(len(LABELS))[HAIR]
    return surface, views, materials, np.stack([frame[2] for frame in frames])
