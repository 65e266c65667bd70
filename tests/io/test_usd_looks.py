"""The look `skin`: what a path tracer makes of it, beside the Lambertian look that was measured."""

import colour
import numpy as np
import pytest
from pxr import Usd, UsdShade
from toy_result import FRAMES, INTRINSICS, SOURCE_SIZE, toy_mesh, toy_poses

from shared.io.usd import HeadAsset, write_head_usda, write_single_layer
from shared.io.usd_capture import UsdCapture
from shared.io.usd_material import LOOK_SET, MEASURED, SHADER_INPUTS, SKIN_LOOK, TextureFile
from shared.io.usd_validate import usd_errors

MAPS = {name: TextureFile(f"./maps/{name}.exr") for name in SHADER_INPUTS}
FROM_THE_FRONT = 0.8
SKINS = np.array([[0.64, 0.38, 0.31], [0.45, 0.27, 0.19], [0.16, 0.085, 0.06], [0.72, 0.5, 0.42]])
"""Albedos from light to dark."""


@pytest.fixture(scope="module", params=["layers", "one"])
def path(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("looks")
    capture = UsdCapture(toy_poses(), FRAMES, 25.0, INTRINSICS, *SOURCE_SIZE, "head")
    asset = HeadAsset("toy", toy_mesh(), MAPS, TextureFile("./envmap.exr"), capture)
    if request.param == "layers":
        write_head_usda(folder, asset)
    else:
        write_single_layer(folder / "head.usda", asset)
    return folder / "head.usda"


def opened(path, look=None):
    stage = Usd.Stage.Open(str(path))
    stage.SetEditTarget(stage.GetSessionLayer())
    if look:
        assert stage.GetDefaultPrim().GetVariantSet(LOOK_SET).SetVariantSelection(look)
    return stage


def shader(stage, name):
    return UsdShade.Shader(stage.GetDefaultPrim().GetPrimAtPath(f"mtl/skin/{name}"))


def subsurface_colour(stage, albedo):
    """The nodes' arithmetic, from the surface back to the albedo's map."""
    port, steps = shader(stage, "openpbr_surface").GetInput("subsurface_color"), []
    while True:
        node = UsdShade.Shader(port.GetConnectedSources()[0][0].source.GetPrim())
        if node.GetShaderId() == "ND_image_color3":
            break
        steps.append((node.GetShaderId(), node.GetInput("in2").Get()))
        port = node.GetInput("in1")
    kinds = {"multiply": np.multiply, "add": np.add, "power": np.power, "subtract": np.subtract}
    for kind, number in reversed(steps):
        albedo = kinds[kind.split("_")[1]](albedo, number)
    assert node.GetPrim().GetName() == "openpbr_diffuse_albedo" and len(steps) == 4
    return albedo


def single_scattering(seen):
    """OpenPBR's alpha of its subsurface colour without anisotropy (specification, Subsurface)."""
    s = 4.09712 + 4.20863 * seen - np.sqrt(9.59217 + 41.6808 * seen + 17.7126 * seen**2)
    return 1.0 - s**2


def scattered_back(alpha, cosine, walkers=100_000):
    """The share of light from one direction that a thick medium scatters back, by random walks: as much as it shows
    towards that direction under light from everywhere."""
    random = np.random.default_rng(3)
    along, depth, weight, back = np.full(walkers, cosine), np.zeros(walkers), np.ones(walkers), 0.0
    while len(along):
        depth = depth - np.log1p(-random.random(len(along))) * along
        out = depth < 0.0
        back += weight[out].sum()
        depth, weight = depth[~out], weight[~out] * alpha
        depth, weight = depth[weight > 1e-4], weight[weight > 1e-4]
        along = 2.0 * random.random(len(depth)) - 1.0
    return back / walkers


def lab(rgb):
    white = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"]
    return colour.XYZ_to_Lab(colour.RGB_to_XYZ(rgb, "sRGB"), white)


@pytest.mark.parametrize("albedo", SKINS, ids=["light", "brown", "dark", "pale"])
def test_flat_skin_looks_the_same_from_the_front(path, albedo):
    """And does not without the inversion."""
    stage, found = opened(path, SKIN_LOOK), {}
    for name, own in (("inverted", subsurface_colour(stage, albedo)), ("as it is", albedo)):
        seen = np.array([scattered_back(single_scattering(channel), FROM_THE_FRONT) for channel in own])
        found[name] = float(colour.delta_E(lab(seen), lab(albedo), method="CIE 2000"))
    assert found["inverted"] < 0.5 < found["as it is"]


def test_the_measured_look_is_the_one_that_opens(path):
    stage = opened(path)
    variants = stage.GetDefaultPrim().GetVariantSet(LOOK_SET)
    assert set(variants.GetVariantNames()) == {MEASURED, SKIN_LOOK} and variants.GetVariantSelection() == MEASURED
    for look, weight in ((None, None), (MEASURED, None), (SKIN_LOOK, 1.0)):
        stage = opened(path, look)
        port = shader(stage, "openpbr_surface").GetInput("subsurface_weight")
        assert (port.Get() if port else None) == weight


def test_light_goes_as_far_as_in_skin(path):
    """Mean free paths of skin1 [Jensen2001], per mm 0.74 + 0.032, 0.88 + 0.17 and 1.01 + 0.48."""
    stage = opened(path, SKIN_LOOK)
    surface = shader(stage, "openpbr_surface")
    paths = np.array(surface.GetInput("subsurface_radius_scale").Get()) * surface.GetInput("subsurface_radius").Get()
    np.testing.assert_allclose(paths, 1.0 / np.array([0.772, 1.05, 1.49]), atol=1e-3)


def test_nothing_else_changes(path):
    """Highlights, normals and what UsdPreviewSurface shows."""
    stages = opened(path, MEASURED), opened(path, SKIN_LOOK)
    for name in ("preview_surface", "openpbr_surface"):
        ports = [{str(port.GetAttr().GetName()): port.GetAttr().Get() or port.GetAttr().GetConnections()
                  for port in shader(stage, name).GetInputs() if "subsurface" not in port.GetBaseName()}
                 for stage in stages]
        assert ports[0] == ports[1] and len(ports[0]) > 3


def test_it_is_sound(path):
    assert [error for error in usd_errors(path) if "envmap" not in error and "/maps/" not in error] == []
