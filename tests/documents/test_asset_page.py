"""docs/asset.md names what an export holds, all of it and nothing else."""

import json
import re
import struct

import pytest
from pxr import Sdf, Usd, UsdShade
from toy_export import write_toy_export

from shared.io.exr_header import read_parts
from tools.documents.readme import DOCS

PAGE = (DOCS / "asset.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def export(tmp_path_factory):
    """With eyes, hair, plates and a near lamp: every prim that there can be."""
    return write_toy_export(tmp_path_factory.mktemp("asset"), lamp=True, hair=True)


@pytest.fixture(scope="module")
def prims(export):
    """{path below the default prim: prim}, the default prim's own is empty."""
    stage = Usd.Stage.Open(str(export / "head.usda"))
    root = stage.GetDefaultPrim()
    length = len(str(root.GetPath())) + 1
    yield {str(prim.GetPath())[length:]: prim for prim in Usd.PrimRange(root)}


def section(title):
    return PAGE.partition(f"\n## {title}\n")[2].partition("\n## ")[0]


def rows(title):
    """The cells of a section's table."""
    lines = [line for line in section(title).splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


def code(cell):
    return re.findall(r"`([^`]+)`", cell)


def shader_rows():
    """{path below the default prim: (id, file that it reads or none)}"""
    found = {}
    for name, shader_id, reads, materials in rows("Shaders"):
        file = [path for path in code(reads) if path.startswith("maps/")]
        for material in materials.split(", "):
            found[f"mtl/{material}/{code(name)[0]}"] = shader_id, file[0] if file else None
    return found


def test_every_prim_is_on_the_page_with_its_type(prims):
    named = {code(path)[0].removeprefix("/<subject>").removeprefix("/"): kind for path, kind, _ in rows("Prims")}
    shaders = shader_rows()
    assert {*named, *shaders} == set(prims)
    kinds = {path: UsdShade.Shader(prim).GetShaderId() if prim.IsA(UsdShade.Shader) else str(prim.GetTypeName())
             for path, prim in prims.items()}
    assert named | {path: shader_id for path, (shader_id, _) in shaders.items()} == kinds


def test_every_shader_reads_the_file_that_the_page_names(prims):
    for path, (_, file) in shader_rows().items():
        port = UsdShade.Shader(prims[path]).GetInput("file")
        assert (port.Get().path.removeprefix("./") if port else None) == file, path


def test_custom_data_has_the_keys_of_the_page(prims):
    sentence = section("Prims").partition("`customData:limn` of the default prim: ")[2].partition(". ")[0]
    facts = prims[""].GetCustomDataByKey("limn")
    assert set(code(sentence)) == {*facts, *facts["clip"]}


def test_layers_variants_and_units(export, prims):
    layers = {code(row[0])[0] for row in rows("USD layers")}
    assert layers == {path.name for path in export.iterdir() if path.suffix in (".usda", ".usdc", ".usdz")}
    sets = prims[""].GetVariantSets()
    words = {word for name in sets.GetNames() for word in (name, *sets.GetVariantSet(name).GetVariantNames())}
    assert {"still", "5k"} < words <= set(re.findall(r"`(\w+)`", section("USD layers")))
    stage = prims[""].GetStage()
    assert f"`metersPerUnit` {stage.GetMetadata('metersPerUnit')}" in PAGE


def test_every_map_is_on_the_page_as_its_header_states_it(export):
    named = {code(file)[0]: rest for file, *rest in rows("Maps")}
    assert set(named) == {path.relative_to(export).as_posix() for path in export.glob("maps/*.exr")}
    for file, (channels, _, colour_space, unit) in named.items():
        (part,) = read_parts(export / file)
        assert set(channels.split(", ")) == {channel.name for channel in part.channels}, file
        assert (colour_space, unit) == (part.values["colorInteropID"], part.values["limn:unit"]), file


def test_constants_of_the_materials_are_those_of_the_page(prims):
    """What the table says of the BRDF, as numbers in the shaders."""
    cells = {row[0]: row[1:] for row in rows("The BRDF in other words")}
    for shader, eye in (("openpbr_surface", 0), ("preview_surface", 1)):
        surface = UsdShade.Shader(prims[f"mtl/eye/{shader}"])
        for name, value in re.findall(r"`(\w+)` ([\d.]+)", cells["eyes: a smooth dielectric over the albedo"][eye]):
            assert surface.GetInput(name).Get() == pytest.approx(float(value))
    skin = UsdShade.Shader(prims["mtl/skin/openpbr_surface"])
    connected = {port.GetBaseName() for port in skin.GetInputs() if port.HasConnectedSource()}
    assert connected == {"base_color", "specular_weight", "specular_roughness", "geometry_normal"}
    assert all(f"`{name}`" in section("The BRDF in other words") for name in connected)
    preview, openpbr = (UsdShade.Shader(prims[f"mtl/hair/{name}_surface"]) for name in ("preview", "openpbr"))
    words = dict(row[:2] for row in rows("Hair"))
    for surface, cell in ((preview, words["UsdPreviewSurface"]), (openpbr, words["OpenPBR"])):
        for name, value in re.findall(r"`(\w+)` (\w+)", cell):
            if name != "opacity":
                assert str(surface.GetInput(name).Get()) in (value, f"{value}.0")


def test_every_name_in_the_glb_is_on_the_page(export):
    data = (export / "head.glb").read_bytes()
    content = json.loads(data[20:20 + struct.unpack_from("<I", data, 12)[0]])
    named = {(kind, name) for kind, names, _ in rows("head.glb") for name in code(names)}
    kinds = {"node": "nodes", "material": "materials", "animation": "animations"}
    assert named == {(kind, item["name"]) for kind, key in kinds.items() for item in content[key]}


def test_pictures_of_the_package(export):
    layer = Sdf.Layer.FindOrOpen(str(export / "head.usdz"))
    inside = {path.removeprefix("./") for path in layer.GetCompositionAssetDependencies()}
    stage = Usd.Stage.Open(layer)
    for prim in stage.Traverse():
        port = UsdShade.Shader(prim).GetInput("file") if prim.IsA(UsdShade.Shader) else None
        inside |= {port.Get().path.removeprefix("./")} if port else set()
    pictures = {file for file in re.findall(r"`(maps/\w+\.png)`", section("Shaders"))}
    assert pictures == {path for path in inside if path.endswith(".png")}
