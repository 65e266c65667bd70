"""What of a head its hair may hide, and materials as a map."""

import numpy as np
import pytest

from shared.geometry.surface import Surface
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.material_labels import CLOTH, HAIR, LABELS, SKIN, UNKNOWN
from shared.inverse.material_map import hidden_places, material_image, matt_share
from shared.tracking.models import load_head_model


def head():
    model = load_head_model()
    surface = model.surface(model.template)
    return surface, SurfaceViewer.of(surface.mesh)


def all_of(surface, **shares):
    found = np.zeros((len(surface.mesh.vertices), len(LABELS)))
    for name, share in shares.items():
        found[:, LABELS.index(name)] = share
    return found


@pytest.mark.parametrize("beard", [True, False])
def test_hair_hangs_before_ears_and_neck_but_where_a_beard_grows(beard):
    surface, viewer = head()
    materials = all_of(surface, hair=0.6, unknown=0.4)
    if not beard:
        materials[surface.vertices_of(("chin",))] = np.eye(len(LABELS))[SKIN]
    hidden = hidden_places(viewer, surface, materials)
    ears, inside = surface.vertices_of(("ears",)), surface.vertices_of(("neck",))
    neck = inside & ~ears & ~surface.vertices_of(("chin",))
    front, back = (neck & (sign * viewer.normals[:, 2] > 0.6) for sign in (1.0, -1.0))
    assert front.sum() > 30 and back.sum() > 30 and ears.sum() > 100
    assert np.allclose(hidden[front], 0.0 if beard else 1.0)
    assert np.allclose(hidden[back], 1.0) and np.allclose(hidden[ears], 1.0)
    assert not hidden[~(ears | inside)].any()


def test_hollows_of_a_bare_ear_are_not_hidden():
    surface, viewer = head()
    ears, left = surface.vertices_of(("ears",)), surface.mesh.vertices[:, 0] > 0.0
    materials = all_of(surface, skin=1.0)
    materials[ears & ~left] = np.eye(len(LABELS))[HAIR]
    hollow = ears & left & (np.arange(len(ears)) % 2 == 0)
    materials[hollow] = np.eye(len(LABELS))[HAIR]
    hidden = hidden_places(viewer, surface, materials)
    assert np.allclose(hidden[ears & ~left], 1.0) and not hidden[left].any()


def test_cloth_is_a_collar_where_there_is_much_of_it():
    surface, viewer = head()
    neck = surface.vertices_of(("neck",)) & ~surface.vertices_of(("ears", "jaw"))
    height = surface.mesh.vertices[:, 1]
    for share, expected in ((0.04, 1.0), (0.5, 0.0)):
        materials = all_of(surface, skin=1.0)
        cloth = neck & (height < np.quantile(height[neck], share))
        materials[cloth] = np.eye(len(LABELS))[CLOTH]
        assert np.allclose(hidden_places(viewer, surface, materials)[cloth], expected)


def test_nothing_is_hidden_where_skin_shows():
    surface, viewer = head()
    assert hidden_places(viewer, surface, all_of(surface, skin=0.7, unknown=0.3)).max() == 0.0


def test_a_mesh_with_other_segments_hides_nothing():
    surface, viewer = head()
    other = Surface(surface.mesh, np.zeros(len(surface.mesh.faces), np.uint8), ("all",))
    assert not hidden_places(viewer, other, all_of(surface, hair=1.0)).any()


def test_hair_that_grows_is_matt_and_what_no_frame_shows_of_the_scalp_like_the_rest():
    surface, viewer = head()
    scalp, ears, neck = (surface.vertices_of((name,)) for name in ("scalp", "ears", "neck"))
    materials = all_of(surface, unknown=1.0)
    front = viewer.normals[:, 2] > 0.0
    for inside, label in ((front, SKIN), (scalp & front, HAIR), (neck, HAIR), (ears, HAIR)):
        materials[inside] = np.eye(len(LABELS))[label]
    matt = matt_share(viewer, surface, materials, neck.astype(float), scalp)
    border = np.unique(surface.mesh.faces[(scalp[surface.mesh.faces].any(1)) & (~scalp[surface.mesh.faces]).any(1)])
    inner = np.setdiff1d(np.nonzero(scalp & ~ears & ~neck)[0], border)
    assert (~front[inner]).sum() > 50 and matt[inner].min() > 0.9
    face = surface.vertices_of(("nose", "cheek_left")) & ~(scalp | ears | neck)
    assert not matt[neck | ears].any() and matt[face].max() < 0.01


def test_the_inside_of_an_open_mouth_has_no_highlights_and_that_of_a_shut_one_is_left_alone():
    model = load_head_model()
    for down, open_mouth in ((1.0, True), (0.0, False)):
        expression = np.zeros(len(model.expression_names))
        expression[list(model.expression_names).index("jaw_open")] = down
        surface = model.surface(model.shape(np.zeros(len(model.identity_basis)), expression))
        viewer, nothing = SurfaceViewer.of(surface.mesh), np.zeros(len(surface.mesh.vertices))
        scalp = surface.vertices_of(("scalp",))
        matt = matt_share(viewer, surface, all_of(surface, skin=1.0), nothing, scalp)
        inside = surface.vertices_of(("inner_mouth",))
        assert np.all(matt[inside] == 1.0) if open_mouth else matt[inside].max() < 0.01
        assert matt[~inside].max() < 0.01


def test_materials_as_a_map_sum_to_one():
    surface, viewer = head()
    materials = all_of(surface)
    left = surface.mesh.vertices[:, 0] > 0
    materials[left, SKIN], materials[~left, HAIR] = 1.0, 1.0
    image = material_image(viewer.mesh, materials, 64)
    assert image.shape == (64, 64, len(LABELS)) and np.allclose(image.sum(2), 1.0, atol=1e-5)
    assert (image[..., SKIN] > 0.99).any() and (image[..., HAIR] > 0.99).any() and image[..., UNKNOWN].max() == 0.0
