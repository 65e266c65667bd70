"""The peer of the chart: Mitsuba's gradient descent on a small clip. Skipped without mitsuba and its LLVM variant."""

import os

import numpy as np
import pytest
from toy_clip import MAP, toy_clip, true_light, true_maps

from shared.inverse.published_clip import Start
from shared.io.arrays import load_arrays
from shared.io.images import read_exr
from shared.rendering.envmap import latlong_from_cube
from tools.bench.peers import mitsuba

pytest.importorskip("mitsuba", reason="needs Mitsuba 3: pip install mitsuba (BSD 3-clause)")


@pytest.fixture(scope="module")
def peer():
    """The module, with the variant that has gradients."""
    from tools.bench.peers import inverse

    if os.environ.setdefault(mitsuba.VARIABLE, inverse.VARIANT) == "scalar_rgb":
        pytest.skip("scalar_rgb has no gradients")
    for made in (mitsuba.mitsuba, mitsuba._skin_bsdf, mitsuba._mapped_skin_bsdf):
        made.cache_clear()  # tests before this one may have chosen another variant
    try:
        import drjit

        mitsuba.mitsuba()
        drjit.eval(drjit.llvm.Float(1.0) + 1.0)
    except Exception as error:
        pytest.skip(f"no LLVM for Mitsuba: {error}")
    return inverse


@pytest.fixture(scope="module")
def clip():
    return toy_clip()


def solver_of(peer, clip, maps, samples):
    start = Start(np.array([0.6, 0.6, 0.6]), maps["diffuse_albedo"], maps["specular_intensity"])
    return peer.PeerSolver(clip, start, samples, 1.0, mitsuba.ONE_BOUNCE)


def test_it_renders_what_our_renderer_renders(peer, clip):
    """With the true maps and the true light: conventions of lens, pose, texture and light in all frames."""
    maps = true_maps()
    solver = solver_of(peer, clip, maps, 256)
    light = latlong_from_cube(true_light(), peer.LIGHT_HEIGHT)
    solver.set_light(light)
    for name, value in (("specular_intensity", 0.5), ("roughness", 0.45)):
        solver.optimiser[name] = type(solver.optimiser[name])(np.full(solver.optimiser[name].shape, value, np.float32))
    for f in (0, 4, 8):
        colours, weight, _ = (np.array(part) for part in solver.picture(f))
        inside = weight[..., 0] > 0.0
        found = np.array(solver.render(f, f))[inside]
        assert inside.sum() > 300
        assert np.abs(found.mean(0) / colours[inside].mean(0) - 1.0).max() < 0.02
        assert np.corrcoef(found.ravel(), colours[inside].ravel())[0, 1] > 0.99
    np.testing.assert_allclose(solver.light(), light, rtol=0.1, atol=0.02)


def test_it_descends_and_writes_a_result(peer, clip, tmp_path):
    """From an even albedo towards the truth; what it writes can be read."""
    even = {"diffuse_albedo": np.full((MAP, MAP, 3), 0.4, np.float32), "specular_intensity": np.zeros((MAP, MAP))}
    solver = solver_of(peer, clip, even, 8)
    front = np.s_[MAP // 4 : 3 * MAP // 4, 3 * MAP // 8 : 5 * MAP // 8]

    def error():
        ratio = solver.maps()["diffuse_albedo"][front] / true_maps()["diffuse_albedo"][front]
        return np.median(np.abs(ratio / np.median(ratio, axis=(0, 1)) - 1.0))

    before = error()
    for _ in range(60):
        solver.step()
    assert error() < 0.5 * before
    peer.write_result(tmp_path / "60", solver, np.arange(9), clip.lens)
    albedo = read_exr(tmp_path / "60" / "maps" / "diffuse_albedo.exr")
    assert albedo.shape == (MAP, MAP, 3) and albedo.std() > 0.02
    assert load_arrays(tmp_path / "60" / "poses.npz")["camera_from_head"].shape == (9, 4, 4)
