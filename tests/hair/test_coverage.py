"""What of a shell about a ball is hair, by pictures in which an upper part shows hair and the rest skin."""

import numpy as np
import pytest
from shapes import nods, sphere

from shared.geometry.raycast import RayScene, camera_hits, pixel_directions
from shared.hair.coverage import alpha_of, at_hairline, covered, look_for_hair
from shared.hair.shell_grid import ShellGrid
from shared.imaging.texels import TexelSurface
from shared.imaging.views import Views

LENS = np.array([[500.0, 0, 80], [0, 500.0, 80], [0, 0, 1]])
SIZE = (160, 160)
SHELL_MM = 88.0
HAIRLINE_MM = 20.0


@pytest.fixture(scope="module")
def shell():
    head = sphere(80.0, 4)
    grid = ShellGrid.about(RayScene(head.vertices, head.faces), np.zeros(len(head.faces), bool), np.zeros(3), -60.0)
    return grid, TexelSurface(grid.mesh(np.full(grid.base.shape, SHELL_MM)), 128)


def kinds_of(views, shown):
    """{frame: [H, W, 3]}: what shown(places [N, 3]) says of the shell's places, 0 to 2; 0 of all beside it."""
    ball = sphere(SHELL_MM, 5)
    scene, found = RayScene(ball.vertices, ball.faces), {}
    for f, pose in enumerate(views.camera_from_head):
        face, _, depth = camera_hits(scene, pose, LENS, *SIZE)
        picture, hit = np.zeros((*face.shape, 3), np.float32), face >= 0
        places = (pixel_directions(LENS, *SIZE)[hit] * depth[hit][:, None] - pose[:3, 3]) @ pose[:3, :3]
        picture[hit] = np.eye(3, dtype=np.float32)[shown(places)]
        found[f] = picture
    return found


@pytest.fixture(scope="module")
def views():
    return Views.in_one_light(nods(np.linspace(-40.0, 40.0, 5)), LENS, SIZE, "head", None, None)


def test_looks_go_past_what_is_not_hair(shell, views):
    """A ridge before the face hides its own flank from the frames at its other side, unless it is not there."""
    grid, _ = shell
    azimuth = 2.0 * np.pi * np.arange(grid.columns) / grid.columns
    ridge = SHELL_MM + 30.0 * np.exp(-np.minimum(azimuth, 2.0 * np.pi - azimuth) ** 2 / 0.02)
    texels = TexelSurface(grid.mesh(np.broadcast_to(ridge, grid.base.shape)), 128)
    kinds = kinds_of(views, lambda places: np.zeros(len(places), int))
    there = look_for_hair(grid, texels, kinds, views).looks
    past = look_for_hair(grid, texels, kinds, views, np.zeros(len(texels.mesh.vertices))).looks
    assert (past >= there - 1e-6).all() and (past > there + 0.1).sum() > 50


def test_one_side_that_shows_skin_rules_hair_out(shell, views):
    """Frames from one side show hair at a place, those from the other skin: that is no hair, whatever the mean says."""
    grid, texels = shell
    hair, skin = (kinds_of(views, lambda places, kind=kind: np.full(len(places), kind)) for kind in (0, 1))
    mixed = {f: skin[f] if f == 2 else hair[f] for f in hair}
    seen = look_for_hair(grid, texels, mixed, views)
    front = (texels.interpolate(texels.mesh.vertices)[:, 2] > 75.0) & (seen.looks > 0.5)
    assert front.any() and np.exp(seen.log_hair[front]).max() < 0.55


def look(shell, views, shown):
    grid, texels = shell
    seen = look_for_hair(grid, texels, kinds_of(views, shown), views)
    return seen, covered(grid, texels, seen)


def test_hair_is_where_frames_show_it(shell, views):
    seen, share = look(shell, views, lambda places: (places[:, 1] < HAIRLINE_MM).astype(int))
    grid, texels = shell
    vertices, alpha = texels.mesh.vertices, alpha_of(texels, seen, share)
    front = vertices[:, 2] > 40.0
    assert share[front & (vertices[:, 1] > HAIRLINE_MM + 6.0)].min() > 0.9
    assert share[front & (vertices[:, 1] < HAIRLINE_MM - 6.0)].max() < 0.1
    height = texels.interpolate(vertices)[:, 1]
    facing = texels.interpolate(vertices)[:, 2] > 40.0
    assert alpha[facing & (height > HAIRLINE_MM + 4.0)].min() > 0.95
    assert alpha[facing & (height < HAIRLINE_MM - 4.0)].max() < 0.05


def test_unseen_it_ends_where_it_does_beside(shell, views):
    """The back, which no frame shows, has its border as high as the sides."""
    _, share = look(shell, views, lambda places: (places[:, 1] < HAIRLINE_MM).astype(int))
    vertices = shell[1].mesh.vertices
    back = vertices[:, 2] < -75.0
    assert share[back & (vertices[:, 1] > HAIRLINE_MM + 12.0)].min() > 0.6
    assert share[back & (vertices[:, 1] < HAIRLINE_MM - 16.0)].max() < 0.4


def test_what_hangs_on_nothing_is_no_hair(shell, views):
    """A dark patch on the chin, apart from the hair of the scalp."""
    def shown(places):
        patch = np.linalg.norm(places - [0.0, -25.0, 84.0], axis=1) < 15.0
        return np.where((places[:, 1] > HAIRLINE_MM) | patch, 0, 1)

    seen, share = look(shell, views, shown)
    vertices = shell[1].mesh.vertices
    patch = np.linalg.norm(vertices - [0.0, -25.0, 84.0], axis=1) < 10.0
    assert seen.log_hair.max() > -0.1 and share[patch].max() == 0.0


def test_background_counts_only_where_it_is_faced(shell, views):
    """Pictures of a smaller head: the rim of the shell shows background, its front does not."""
    kinds = {f: picture * (np.hypot(*(np.indices(picture.shape[:2]) - 79.5)) < 36.0)[..., None]
             for f, picture in kinds_of(views, lambda places: np.zeros(len(places), int)).items()}
    grid, texels = shell
    share = covered(grid, texels, look_for_hair(grid, texels, kinds, views))
    assert share[texels.mesh.vertices[:, 1] > 40.0].min() > 0.9


@pytest.mark.parametrize(("thickness_mm", "least"), [(3.0, 0.0), (8.0, 2.0 / 3.0), (15.0, 1.0)])
def test_hair_that_lies_on_the_skull_thins_out_at_its_edge(shell, thickness_mm, least):
    """To nothing at the hairline and beyond, all of it from three edges within; what stands off hides the skin."""
    grid, texels = shell
    height = texels.mesh.vertices[:, 1]
    share = (height > HAIRLINE_MM).astype(float)
    thins = at_hairline(grid, texels.mesh, share, grid.base + thickness_mm)
    skull = grid.of_vertices(np.repeat((np.arange(len(grid.base)) < grid.domed)[:, None], grid.columns, 1)) > 0
    edge_mm = SHELL_MM * np.radians(2.5)
    beyond, within = skull & (height < HAIRLINE_MM), height > HAIRLINE_MM + 3.0 * edge_mm
    assert thins[beyond] == pytest.approx(least, abs=0.02)
    assert thins[within] == pytest.approx(1.0, abs=0.02) and (thins[~skull] == 1.0).all()
    border = skull & (height > HAIRLINE_MM) & (height < HAIRLINE_MM + 2.0 * edge_mm)
    assert least == 1.0 or least < thins[border].mean() < 0.95
