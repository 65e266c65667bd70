"""Our shading against Mitsuba 3, a path tracer that is not ours. Skipped where it is missing (pip install mitsuba)."""

import importlib.util

import numpy as np
import pytest
from shapes import sphere

from shared.errors import InputError
from shared.geometry.mesh import face_normals
from shared.rendering.brdf import directional_albedo
from shared.rendering.precomputed_transfer import Sizes
from shared.rendering.studio_lights import studio_light
from tools.bench.peers.mitsuba import ALL_BOUNCES, DIRECT, ONE_BOUNCE, Coat, path_trace
from tools.bench.shading import SKIN, TracedView, compare, head
from tools.bench.statue import statue

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("mitsuba") is None, reason="needs Mitsuba 3: pip install mitsuba (BSD 3-clause)"
)
PIXELS, SAMPLES = 48, 96


@pytest.fixture(scope="module", params=["head", "statue"])
def stage(request):
    """A mesh before a camera under a window's light."""
    try:
        mesh = head() if request.param == "head" else statue(5)
    except InputError as error:
        pytest.skip(str(error))
    return TracedView.of(mesh, studio_light("window"), PIXELS, Sizes(directions=768, nodes=600))


def test_both_renderers_agree_on_conventions():
    """A ball under even light and a lamp on one side: place, sides and the BSDF's energy."""
    ball = sphere(80.0, 4)
    stage = TracedView.of(ball, studio_light("low_sun"), 32, Sizes(directions=768, nodes=50))
    theirs = stage.truth(Coat(SKIN), DIRECT, 512)
    found = compare(stage.diffuse(SKIN, 0), theirs, stage.filled())
    assert abs(found["mean"]) < 0.01 and found["rms"] < 0.03
    even = np.ones((512, 1024, 3))
    picture = path_trace(ball, even, stage.camera, Coat((0.0, 0.0, 0.0), 1.0, 0.4), DIRECT, 256)
    expected = directional_albedo(np.ones(1), 0.4)[0]
    assert picture[14:18, 14:18].mean() == pytest.approx(expected, rel=0.02)


def test_diffuse_light_is_theirs(stage):
    """Direct light to 1 %, one bounce and all of them to 2 %, in the mean over the picture."""
    for bounces, depth, limit in ((0, DIRECT, 0.01), (1, ONE_BOUNCE, 0.02), (2, ALL_BOUNCES, 0.02)):
        found = compare(stage.diffuse(SKIN, bounces), stage.truth(Coat(SKIN), depth, SAMPLES), stage.filled())
        assert found["noise"] < 0.003
        assert abs(found["mean"]) < limit, (bounces, found)
        assert found["rms"] < 0.06, (bounces, found)


def test_the_reference_renderer_is_theirs(stage):
    """The published shading: diffuse light to 1 % of the path tracer and of the transfer solver."""
    published = [stage.published(Coat(SKIN), 256, seed) for seed in (1, 2)]
    for theirs in (stage.truth(Coat(SKIN), DIRECT, SAMPLES), (stage.diffuse(SKIN, 0),) * 2):
        found = compare(published[0], theirs, stage.filled())
        assert abs(found["mean"]) < 0.01, found


def test_highlights_are_theirs(stage):
    """Wide lobes by the sum over directions, narrow ones by the split sum, each to what the benchmark charts."""
    for roughness, limits in ((0.2, {"split": 0.03, "published": 0.05}), (0.45, {"sum": 0.02})):
        coat = Coat((0.0, 0.0, 0.0), 1.0, roughness)
        theirs, found = stage.truth(coat, DIRECT, 128), {}  # 32 leave 1 % of noise in the mean
        for way, limit in limits.items():
            ours = stage.published(coat, 1) if way == "published" else stage.specular(roughness, way == "split")
            found[way] = compare(ours, theirs, stage.filled())["mean"]
            assert abs(found[way]) < limit, (roughness, found)


def test_the_statue_is_closed_and_faces_outwards():
    mesh = statue(4)
    volume = (mesh.vertices[mesh.faces[:, 0]] * face_normals(mesh.vertices, mesh.faces)).sum(1) / 6.0
    ring = (mesh.faces >= 4**5 + 2).all(1)
    assert volume[~ring].sum() > 1e6 and volume[ring].sum() > 1e5
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
