"""The texture pass: normal equations against direct least squares, then a bumpy-lit plate with known maps."""

import numpy as np
import pytest
from shapes import grid_plane

from shared.gather import SurfaceViewer, prepare_picture
from shared.geometry import rigid, rotation_from_vector
from shared.mesh import interpolate
from shared.raycast import RayScene, camera_hits
from shared.solve.maps import make_maps
from shared.solve.texture import (
    LEAST_BORDER_MM,
    PRIOR_SPREAD,
    BorderSums,
    Noise,
    NormalEquations,
    pooled_specular,
    robust_weight,
)
from shared.solve.texture_pass import Clip, TexturePass
from shared.texels import TexelSamples, TexelSurface, smooth_field
from shared.texture import sample_bilinear

NOISE = Noise(0.01, 0.02)
NEVER_WRONG = np.zeros((10, 3))


class FewTexels:
    """A surface of n texels side by side, enough for pooling."""

    def __init__(self, size):
        self.size, self.pixel = size, np.arange(size * size)

    def __len__(self):
        return len(self.pixel)

    def to_image(self, values):
        return values.reshape(self.size, self.size)


def random_frames(texels, frames=7, seed=0):
    """E, S, I [F, T, 3], weight [F, T]; each frame shows most texels."""
    rng = np.random.default_rng(seed)
    irradiance, reflection = rng.uniform(0.2, 1.0, (frames, texels, 3)), rng.uniform(0.0, 0.3, (frames, texels, 3))
    colours = rng.uniform(0.1, 0.9, (frames, texels, 1)) * irradiance + 0.5 * reflection
    colours += 0.02 * rng.normal(size=colours.shape)
    weight = rng.uniform(0.1, 1.0, (frames, texels)) * (rng.random((frames, texels)) < 0.8)
    return irradiance, reflection, colours, weight


def accumulated(irradiance, reflection, colours, weight, limits=None):
    equations = NormalEquations(irradiance.shape[1], NOISE)
    limits = np.zeros(colours.shape, np.int8) if limits is None else limits
    for f in range(len(irradiance)):
        rows = np.nonzero(weight[f] > 0)[0]
        samples = TexelSamples(rows, colours[f, rows], weight[f, rows], limits[f, rows])
        equations.add(samples, irradiance[f, rows], reflection[f, rows], np.ones((len(rows), 3)))
    return equations


def test_albedo_is_weighted_least_squares():
    frames = random_frames(12)
    irradiance, reflection, colours, weight = frames
    specular = np.linspace(0.0, 1.0, 12)
    found = accumulated(*frames).solve_albedo(specular, np.zeros((12, 3)), 1e-6)
    for t in range(12):
        for c in range(3):
            root = np.sqrt(weight[:, t] * NOISE.precision(colours[:, t, c]))
            right = colours[:, t, c] - specular[t] * reflection[:, t, c]
            expected = np.linalg.lstsq((root * irradiance[:, t, c])[:, None], root * right, rcond=None)[0][0]
            assert found[t, c] == pytest.approx(np.clip(expected, 0.002, 1.0), abs=1e-4)


def test_intensity_is_joint_least_squares_with_albedo():
    """Four unknowns per texel at once give what the equations with the albedo eliminated give."""
    frames = random_frames(16, frames=9, seed=1)
    irradiance, reflection, colours, weight = frames
    found = pooled_specular(FewTexels(4), accumulated(*frames), 1e-3, 0.5, 1e4)
    for t in range(16):
        root = np.sqrt(weight[:, t, None] * NOISE.precision(colours[:, t]))
        design = np.zeros((9, 3, 4))
        design[:, [0, 1, 2], [0, 1, 2]] = root * irradiance[:, t]
        design[:, :, 3] = root * reflection[:, t]
        solution = np.linalg.lstsq(design.reshape(27, 4), (root * colours[:, t]).ravel(), rcond=None)[0]
        assert found[t] == pytest.approx(np.clip(solution[3], 0.0, 2.0), abs=2e-3)


def test_without_pooling_every_texel_has_the_mean_intensity():
    equations = accumulated(*random_frames(16))
    assert np.array_equal(pooled_specular(FewTexels(4), equations, np.inf, 0.4, 0.25), np.full(16, 0.4, np.float32))
    tight = pooled_specular(FewTexels(4), equations, 1.0, 0.4, 1e-6)
    assert np.allclose(tight, 0.4, atol=1e-4)


def test_information_grows_with_frames():
    frames = random_frames(10, frames=8)
    frames[3][:] = 1.0
    some = accumulated(*(x[:4] for x in frames)).information(np.full(3, 0.9), NEVER_WRONG)
    every = accumulated(*frames).information(np.full(3, 0.9), NEVER_WRONG)
    assert (every > some).all()
    double = accumulated(*(np.concatenate([x, x]) for x in frames)).information(np.full(3, 0.9), NEVER_WRONG)
    assert np.allclose(double, 2.0 * every, rtol=1e-5)
    # Errors that all frames share cannot be averaged away.
    shared = accumulated(*frames).information(np.full(3, 0.9), NEVER_WRONG + 0.04)
    assert (shared < 25.0).all() and np.allclose(1.0 / shared, 1.0 / every + 0.04)


def test_what_is_left_of_a_mostly_clipped_texel_says_little():
    """The few samples of red that are not clipped are its darkest: worth less than the same few seen alone."""
    frames = random_frames(10, frames=8)
    frames[3][:] = 1.0
    limits = np.zeros(frames[2].shape, np.int8)
    limits[:6, :, 0] = 1
    found = accumulated(*frames, limits).information(np.full(3, 0.9), NEVER_WRONG)
    alone = accumulated(*(x[6:] for x in frames)).information(np.full(3, 0.9), NEVER_WRONG)
    whole = accumulated(*frames).information(np.full(3, 0.9), NEVER_WRONG)
    assert (found[:, 0] < 0.5 * alone[:, 0]).all()
    assert np.allclose(found[:, 1:], whole[:, 1:])


def test_what_is_only_seen_near_the_heads_border_says_little():
    """However many frames show it; one good view among many poor ones is enough."""
    sure, unsure = BorderSums(3, 0.0), BorderSums(3, 2.0)
    for row in np.array([[0.22, 0.9, 0.22]] * 40 + [[0.22, 0.9, 0.95]] * 20):
        for sums in (sure, unsure):
            sums.add(TexelSamples(np.arange(3), np.full((3, 3), 0.3), row**2, np.zeros((3, 3), np.int8)))
    share = PRIOR_SPREAD**2 / (PRIOR_SPREAD**2 + sure.variance())
    assert share[0] < 0.6 and share[1] > 0.99 and share[2] > 0.97
    assert np.allclose(unsure.variance(), (2.0 / LEAST_BORDER_MM) ** 2 * sure.variance())


def test_robust_weights():
    colours = np.full((4, 3), 0.5, np.float32)
    model = colours + np.array([[0.0], [0.02 * 2.5], [5.0], [-0.2]], np.float32)
    limits = np.zeros((4, 3), np.int8)
    samples = TexelSamples(np.arange(4), colours, np.ones(4), limits)
    known = np.full(4, 1e9)
    weight = robust_weight(model, samples, NOISE, known)
    assert np.allclose(weight[0], 1.0) and np.allclose(weight[1], 0.5) and (weight[2] < 1e-4).all()
    limits[2], limits[3] = 1, 1
    weight = robust_weight(model, samples, NOISE, known)
    assert (weight[2] == 0).all(), "a clipped sample is satisfied by any brighter model"
    assert (weight[3] > 0).all(), "and still pulls a darker one up"
    limits[3] = -1
    assert (robust_weight(model, samples, NOISE, known)[3] == 0).all()
    limits[:] = 0
    guessed = robust_weight(model, samples, NOISE, np.zeros(4))
    told = robust_weight(model, samples, NOISE, known)
    assert (guessed[3] > 3.0 * told[3]).all(), "a model that knows nothing does not overrule a sample"


def test_field_continues_what_is_known_and_sinks_to_the_mean():
    """A linear ramp known on the rim of a square goes on inside; a loose part of which nothing is known is the mean."""
    plate = grid_plane(17, 1.0)
    x, y = plate.uvs.T
    values = np.stack([x + 2 * y, 3 - x], axis=1)
    rim = np.repeat((np.abs(plate.uvs - 0.5).max(1) > 0.49)[:, None], 2, axis=1)
    mean = np.array([0.3, -0.2])
    found = smooth_field(plate, np.where(rim, values, 0.0), 1e6 * rim, mean, 0.05, 100.0)
    assert np.allclose(found, values, atol=0.03)
    loose = plate.replace(
        vertices=np.concatenate([plate.vertices, plate.vertices + 5.0]),
        faces=np.concatenate([plate.faces, plate.faces + len(x)]),
    )
    known = np.repeat([[1.0, 1.0], [0.0, 0.0]], len(x), axis=0)
    both = smooth_field(loose, np.tile(values, (2, 1)), known, mean, 0.05, 1.0)
    assert np.allclose(both[len(x) :], mean, atol=1e-6)


def test_field_stops_where_another_region_begins():
    plate = grid_plane(9, 1.0)
    region = plate.uvs[:, 0] > 0.45
    known = np.where(region, 0.0, 1e6)[:, None]
    found = smooth_field(plate, np.full((len(region), 1), 2.0), known, np.zeros(1), 0.05, 1.0, region)[:, 0]
    assert np.allclose(found[~region], 2.0, atol=1e-3) and np.allclose(found[region], 0.0, atol=1e-9)


def test_field_weighs_values_by_their_precision():
    """One vertex against the mean: the posterior mean of two normal distributions."""
    plate = grid_plane(2, 1.0)
    found = smooth_field(plate, np.full((4, 1), 2.0), np.full((4, 1), 3.0), np.array([0.0]), 0.05, 0.5)
    assert np.allclose(found, 2.0 * 3.0 / (3.0 + 4.0), atol=1e-9)


# ---------------------------------------------------------------------- the whole pass

SIZE, LENS = (96, 96), np.array([[400.0, 0, 48], [0, 400.0, 48], [0, 0, 1]])
FRAMES, SPECULAR, MAP = 10, 0.6, 48


class PlateShading:
    """E and S of a plate's vertices in each frame: a light that wanders, and a highlight that wanders faster."""

    def __init__(self, mesh):
        self.uvs = mesh.uvs

    def irradiance(self, frame):
        angle = 0.6 * frame
        tilt = self.uvs @ [np.cos(angle), np.sin(angle)]
        return ((0.7 + 0.25 * tilt + 0.2 * np.sin(1.7 * frame))[:, None] * [1.0, 0.95, 0.9]).astype(np.float32)

    def mean_irradiance(self, frames):
        return np.mean([self.irradiance(frame) for frame in frames], axis=0)

    def mean_slope(self, frames):
        return np.zeros((len(self.uvs), 3))

    def shadow_doubt(self, frame):
        return np.zeros((len(self.uvs), 3), np.float32)

    def reflection(self, frame):
        centre = 0.5 + 0.4 * np.array([np.cos(1.1 * frame), np.sin(1.1 * frame)])
        spot = 0.3 * np.exp(-((self.uvs - centre) ** 2).sum(1) / 0.08)
        return np.repeat(spot[:, None], 3, axis=1).astype(np.float32)


class ShadedPlate(PlateShading):
    """The plate with a shadow that wanders over it, its border off by shift; doubt: whether that is known."""

    def __init__(self, mesh, shift=0.0, doubt=False):
        super().__init__(mesh)
        self.shift, self.doubt = shift, doubt

    def open_share(self, frame, shift):
        border = 0.15 + 0.02 * frame + shift
        return (0.05 + 0.95 * np.clip((self.uvs[:, :1] - border) / 0.06 + 0.5, 0.0, 1.0)).astype(np.float32)

    def irradiance(self, frame):
        return super().irradiance(frame) * self.open_share(frame, self.shift)

    def shadow_doubt(self, frame):
        spread = self.open_share(frame, self.shift + 0.05) - self.open_share(frame, self.shift - 0.05)
        return self.doubt * np.abs(spread) * super().irradiance(frame)


def true_albedo(uv):
    x, y = np.moveaxis(uv, -1, 0)
    return np.stack([0.5 + 0.2 * np.sin(6 * x), 0.35 + 0.15 * y, 0.25 + 0.1 * np.cos(5 * (x + y))], axis=-1)


def plate_clip(mesh, shading, clip_at=np.inf):
    """Pictures of the plate swinging +-12 degrees; its right fifth is behind the mask's border in all frames."""
    scene = RayScene(mesh.vertices, mesh.faces)
    swing = np.radians(12.0) * np.sin(np.arange(FRAMES))
    rotation = np.diag([1.0, -1, -1]) @ rotation_from_vector(swing[:, None] * [0.4, 0.9, 0.0])
    poses = rigid(rotation, np.tile([0.0, 0, 500.0], (FRAMES, 1)))
    pictures = []
    for f in range(FRAMES):
        face, bary, _ = camera_hits(scene, poses[f], LENS, *SIZE)
        hit = face >= 0
        uv = interpolate(mesh.uvs, mesh.faces, face[hit], bary[hit])
        lit = shading.irradiance(f), shading.reflection(f)
        irradiance, reflection = (interpolate(values, mesh.faces, face[hit], bary[hit]) for values in lit)
        linear = np.zeros(SIZE + (3,), np.float32)
        linear[hit] = true_albedo(uv) * irradiance + SPECULAR * reflection
        codes = np.where(linear >= clip_at, 255, 128).astype(np.uint8)
        mask = np.zeros(SIZE, np.uint8)
        mask[hit] = np.where(uv[:, 0] < 0.8, 255, 0)
        pictures.append(prepare_picture(codes, np.minimum(linear, clip_at), mask))
    fitted = np.arange(FRAMES) % 5 != 2
    return Clip(pictures.__getitem__, poses, LENS, fitted)


def run_pass(clip_at=np.inf, specular=SPECULAR, widths=(np.inf,)):
    mesh = grid_plane(33, 80.0)
    shading = PlateShading(mesh)
    surface, viewer = TexelSurface(mesh, MAP), SurfaceViewer.of(mesh)
    clip = plate_clip(mesh, shading, clip_at)
    texture = TexturePass(surface, viewer, shading, clip, specular, np.array([0.5, 0.4, 0.25]))
    material, record = texture.run(widths)
    return surface, material, record, make_maps(surface, material, 0.4)


@pytest.fixture(scope="module")
def plate():
    return run_pass()


def texel_uv(surface):
    row, column = np.divmod(surface.pixel, surface.size)
    return np.stack([(column + 0.5) / surface.size, 1.0 - (row + 0.5) / surface.size], axis=1)


def test_albedo_is_found_where_the_clip_shows_it(plate):
    surface, material, _, maps = plate
    uv = texel_uv(surface)
    seen = uv[:, 0] < 0.7
    error = np.abs(material.albedo - true_albedo(uv))[seen]
    assert np.median(error) < 0.004 and np.quantile(error, 0.99) < 0.03
    assert np.allclose(sample_bilinear(maps["diffuse_albedo"], uv), material.albedo, atol=1e-6)
    assert (maps["roughness"] == np.float32(0.4)).all()
    assert np.allclose(maps["normal"], [0.5, 0.5, 1.0])


def test_unseen_texels_are_filled_and_not_trusted(plate):
    surface, material, _, maps = plate
    unseen = texel_uv(surface)[:, 0] > 0.85
    confidence = maps["confidence"].ravel()[surface.pixel]
    assert (confidence >= 0).all() and (confidence <= 1).all()
    assert confidence[unseen].max() < 1e-6
    inner = (np.abs(texel_uv(surface) - [0.4, 0.5]) < [0.3, 0.4]).all(1)
    assert confidence[inner].min() > 0.8
    assert all(np.isfinite(image).all() for image in maps.values())
    # The fill continues what the rim of the seen part shows.
    assert np.abs(np.log(material.albedo[unseen] / np.array([0.4, 0.42, 0.28]))).max() < 0.7


def test_more_frames_mean_more_confidence():
    mesh = grid_plane(17, 80.0)
    shading, surface = PlateShading(mesh), TexelSurface(mesh, 24)
    viewer, found = SurfaceViewer.of(mesh), []
    clip = plate_clip(mesh, shading)
    for fitted in (np.arange(FRAMES) == 0, clip.fitted):
        few = Clip(clip.picture, clip.camera_from_head, LENS, fitted)
        material, _ = TexturePass(surface, viewer, shading, few, SPECULAR, np.full(3, 0.4)).run((np.inf,))
        found.append(make_maps(surface, material, 0.4)["confidence"].ravel()[surface.pixel])
    seen = texel_uv(surface)[:, 0] < 0.7
    assert (found[1][seen] > found[0][seen]).all()


def test_borders_of_shadows_that_lie_elsewhere_spoil_little():
    """Samples near a border that may lie elsewhere count less, and texels that have no others are trusted less."""
    mesh, found = grid_plane(33, 80.0), []
    surface, viewer, clip = TexelSurface(mesh, MAP), SurfaceViewer.of(mesh), plate_clip(mesh, ShadedPlate(mesh))
    for doubt in (False, True):
        shading = ShadedPlate(mesh, 0.04, doubt)
        material, _ = TexturePass(surface, viewer, shading, clip, SPECULAR, np.array([0.5, 0.4, 0.25])).run((np.inf,))
        confidence = make_maps(surface, material, 0.4)["confidence"].ravel()[surface.pixel]
        found.append((np.abs(np.log(material.albedo / true_albedo(texel_uv(surface)))).max(1), confidence))
    (plain, sure), (doubted, less_sure) = found
    u = texel_uv(surface)[:, 0]
    crossed, never = (u > 0.12) & (u < 0.4), (u > 0.5) & (u < 0.7)
    assert np.mean(doubted[crossed] ** 2) < 0.6 * np.mean(plain[crossed] ** 2)
    trusted = [np.sqrt(np.mean(error[crossed & (conf > 0.5)] ** 2)) for error, conf in found]
    assert trusted[1] < 0.3 * trusted[0], "what is still trusted is right"
    for with_doubt, without in ((doubted, plain), (less_sure, sure)):
        assert np.allclose(with_doubt[never], without[never], atol=0.01)


def test_clipped_frames_do_not_darken_the_albedo():
    """Bright frames are cut off at 0.5; taken at face value they would darken the texels by 4 % in the median."""
    surface, material, _, _ = run_pass(clip_at=0.5)
    uv = texel_uv(surface)
    seen = (uv[:, 0] > 0.05) & (uv[:, 0] < 0.7)
    ratio = material.albedo[seen, 0] / true_albedo(uv[seen])[:, 0]
    assert abs(np.median(ratio) - 1.0) < 0.01
    assert np.quantile(np.abs(ratio - 1.0), 0.9) < 0.05


def test_held_out_frames_choose_the_pooling():
    """With a wrong clip-wide intensity, pooled estimates explain the held-out frames better than one value."""
    surface, material, record, _ = run_pass(specular=0.2, widths=(np.inf, 6.0))
    assert record["chosen"] == "6 texels"
    assert record["held_out"]["6 texels"] < record["held_out"]["one value"]
    seen = texel_uv(surface)[:, 0] < 0.7
    assert abs(np.median(material.specular[seen]) - SPECULAR) < abs(0.2 - SPECULAR)
