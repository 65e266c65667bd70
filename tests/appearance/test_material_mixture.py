"""What tells skin from hair and cloth: features beside typical skin, and the mixture that sorts places by them."""

from dataclasses import replace

import numpy as np
import pytest

from shared.appearance.material_features import SurfaceFeatures, texture_strength
from shared.appearance.material_mixture import Mixture, material_probabilities
from shared.geometry.surface import Surface
from shared.imaging.image_sampling import prepare_picture
from shared.imaging.material_labels import BROW, CLOTH, EYE, HAIR, LABELS, LIPS, SKIN, UNKNOWN
from shared.tracking.models import load_head_model


@pytest.fixture(scope="module")
def surface():
    model = load_head_model()
    mesh = model.mesh(np.zeros(len(model.identity_basis)), np.zeros(len(model.expression_basis)))
    return Surface(mesh, model.face_segment, tuple(model.segment_names))


def looks(surface, **regions):
    """Features of a head whose regions {name: (which vertices, brightness, red over green, texture, chi_square)} differ
    from skin, with noise, seen from all sides."""
    rng, count = np.random.default_rng(0), len(surface.mesh.vertices)
    colour, texture, chi_square = rng.normal(0, 0.1, (count, 1)) + rng.normal(0, 0.02, (count, 3)), np.full(
        count, -3.0), np.full(count, -1.0)
    for inside, brightness, redder, more_texture, more_chi_square in regions.values():
        colour[inside] += brightness + np.array([0.5, -0.5, -0.5]) * redder
        texture[inside] += more_texture
        chi_square[inside] += more_chi_square
    noise = rng.normal(0, 0.25, (2, count))
    return SurfaceFeatures(colour, texture + noise[0], chi_square + noise[1], np.full(count, 20.0))


def union_share(found, truth):
    return (found & truth).sum() / (found | truth).sum()


def places(surface):
    """Scalp, beard, brows and collar of the head, each [V] bool."""
    y = surface.mesh.vertices[:, 1]
    return (surface.vertices_of(("scalp",)), surface.vertices_of(("chin", "jaw", "upper_lip_skin")),
            surface.vertices_of(("brows",)) & ~surface.vertices_of(("forehead", "lids")), y < y.min() + 25.0)


@pytest.mark.parametrize("brightness", [-1.5, 0.5])
def test_dark_and_bright_hair_a_beard_brows_and_a_collar_are_found(surface, brightness):
    scalp, beard, brows, collar = places(surface)
    hairy = (scalp | beard) & ~collar
    found = material_probabilities(surface, looks(
        surface, hair=(hairy | brows, brightness, -0.4, 1.0, 1.5), cloth=(collar, 0.2, -1.5, 0.2, 2.0)))
    assert np.allclose(found.sum(1), 1.0) and found.min() >= 0.0
    label = found.argmax(1)
    open_skin = surface.vertices_of(("nose", "cheek_left", "cheek_right", "forehead")) & ~hairy & ~brows
    assert union_share(label == HAIR, hairy & ~brows) > 0.85
    assert (label[open_skin] == SKIN).mean() > 0.97
    assert (label[brows] == BROW).mean() > 0.8 and (label[collar] == CLOTH).mean() > 0.8


def test_a_bald_head_without_a_collar_is_skin_lips_and_eyes(surface):
    label = material_probabilities(surface, looks(surface, lips=(surface.vertices_of(("lips",)), -0.3, 0.4, 0.0, 0.0)))
    label = label.argmax(1)
    assert (label[surface.vertices_of(("scalp", "neck", "jaw", "cheek_left"))] == SKIN).mean() > 0.97
    inner_lips = surface.vertices_of(("lips",)) & ~surface.vertices_of(("upper_lip_skin", "chin", "inner_mouth"))
    assert (label[inner_lips] == LIPS).mean() > 0.9
    assert (label[surface.vertices_of(("eyes",))] == EYE).all()


def test_skin_in_a_shadow_that_the_mesh_does_not_know_of_is_no_hair(surface):
    shaded = surface.vertices_of(("neck",)) & (surface.mesh.vertices[:, 0] > 20.0)
    scalp = surface.vertices_of(("scalp",))
    found = material_probabilities(surface, looks(
        surface, hair=(scalp, -1.5, -0.5, 1.2, 1.5), shadow=(shaded & ~scalp, -1.8, 0.0, 0.3, 0.5))).argmax(1)
    assert (found[shaded & ~scalp] == SKIN).mean() > 0.8


def test_what_few_frames_show_is_unknown(surface):
    features = looks(surface)
    left = surface.mesh.vertices[:, 0] > 10.0
    found = material_probabilities(surface, replace(features, weight=np.where(left, 0.0, features.weight)))
    seen = ~left & ~surface.vertices_of(("inner_mouth", "eye_sockets"))
    assert (found[left, UNKNOWN] == 1.0).all() and (found[seen].argmax(1) != UNKNOWN).all()
    hardly = material_probabilities(surface, replace(features, weight=np.full(len(left), 0.1)))
    assert (hardly[:, UNKNOWN] > 0.7).all()
    for nothing in (material_probabilities(Surface(surface.mesh), features),
                    material_probabilities(surface, replace(features, weight=np.zeros(len(left))))):
        assert (nothing[:, UNKNOWN] == 1.0).all() and nothing.shape == (len(left), len(LABELS))


def test_the_same_features_give_the_same_bytes(surface):
    features = looks(surface, hair=(surface.vertices_of(("scalp",)), -1.0, -0.3, 1.0, 1.0))
    assert np.array_equal(material_probabilities(surface, features), material_probabilities(surface, features))


def test_a_mixture_climbs_in_likelihood_and_is_a_density():
    rng = np.random.default_rng(3)
    values = np.concatenate([rng.normal(-2, 0.5, (400, 5)), rng.normal(1, 1.0, (600, 5))])
    start = Mixture(np.array([0.5, 0.5]), np.array([[-1.0] * 5, [0.5] * 5]), np.stack([2.0 * np.eye(5)] * 2))
    mixture, before = start, start.log_density(values).mean()
    for _ in range(8):
        mixture = mixture.fitted(values, np.ones(len(values)), start, strength=1.0)
    assert mixture.log_density(values).mean() > before + 0.5
    assert mixture.share == pytest.approx([0.4, 0.6], abs=0.02) and np.abs(mixture.mean[0] + 2).max() < 0.15
    one = Mixture(np.ones(1), np.zeros((1, 5)), np.eye(5)[None])
    assert one.log_density(np.zeros((1, 5)))[0] == pytest.approx(-2.5 * np.log(2 * np.pi))


def test_texture_is_strands_and_not_shade():
    x = np.arange(200)
    strands = np.where(x // 2 % 2, 0.2, 0.3)
    linear = np.float32(np.tile(np.where(x < 100, strands, np.linspace(0.1, 0.4, 200)), (200, 1)))
    linear = np.repeat(linear[..., None], 3, 2)
    picture = prepare_picture(np.uint8(255 * linear), linear, np.full((200, 200), 255, np.uint8))
    strength = texture_strength(picture, 2.0)
    mask = np.full((200, 200), 255, np.uint8)
    brighter = texture_strength(prepare_picture(np.uint8(500 * linear), 2 * linear, mask), 2.0)
    assert strength[100, 50] > strength[100, 150] + 2.0
    assert brighter[100, 50] == pytest.approx(strength[100, 50], abs=0.05)
