"""Skin, eyes and hair as materials in USD: UsdPreviewSurface and MaterialX OpenPBR side by side, both fed by the same
maps.

Limn's BRDF is albedo / pi + specular_intensity * GGX with Schlick's F0 = 0.04 and alpha = roughness^2.
OpenPBR takes that as it is: specular_ior 1.5 gives F0 = 0.04, specular_weight scales it, specular_roughness
squares the same way. UsdPreviewSurface has no specular weight. Its specular workflow (specularColor = F0)
would say the same, but importers read specularColor as a tint on top of the index of refraction (Blender) or
ignore it (consumer viewers). OpenPBR defines its weight as a modulated index of refraction, so that index
itself is written as a map and drives `ior`: every conforming renderer shows the same F0, and one that ignores
the map falls back to 1.5, intensity 1.

Both models darken the diffuse layer by what the specular layer reflects (4 to 5 % at F0 = 0.04); Limn's BRDF
does not.

That is the look `measured`. The look `skin` lets the diffuse light into the head: what the clip tells of a surface is
its albedo, not how far light goes below it, so that comes from measurements of skin [Jensen2001].

Eyes share the map of the albedo; over it lies the tear film, one smooth dielectric. OpenPBR's coat would lay a second
interface over that one.

Hair that stands off the head has maps of its own and no highlights. Its alpha is the share of a place where hair is, so
that the surface is not there for the rest of the light: UsdPreviewSurface's opacity mode `presence`, without a
threshold.

References: UsdPreviewSurface specification 2.6 (displacement: scene units along the normal); OpenPBR surface 1.1,
section 3.6 (specular weight); MaterialX 1.39 (displacement).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from pxr import Gf, Sdf, Usd, UsdShade

from shared.geometry.eyeballs import EYE_ROUGHNESS, TEAR_FILM_IOR
from shared.io.export_maps import HAIR_ALBEDO, HAIR_ALPHA

LOOK_SET, MEASURED, SKIN_LOOK = "look", "measured", "skin"
SKIN_MEAN_FREE_PATH_MM = (1.295, 0.952, 0.671)
"""1 / (sigma_s' + sigma_a) in red, green and blue of the sample skin1 [Jensen2001]."""
SEEN_LINEAR, SEEN_SQUARE = 0.8798, 0.1218
"""What a thick medium whose OpenPBR colour is C shows under light from all sides, seen by a cosine of 0.8, about the
mean one over a face from the front: a C + b C^2, to 0.001. From 1 - sqrt(1 - alpha) H(0.8) [Chandrasekhar1960], alpha
of C as the specification has it. A medium is darker face on than along its surface, while a Lambertian surface is as
bright from everywhere."""
IOR = 1.5
"""Index of refraction whose F0, ((n - 1) / (n + 1))^2, is the 0.04 of the BRDF."""

# Limn's map -> (UsdPreviewSurface input, OpenPBR input): the one place where the names meet.
SHADER_INPUTS = {
    "diffuse_albedo": ("diffuseColor", "base_color"),
    "specular_intensity": (None, "specular_weight"),
    "specular_ior": ("ior", None),
    "roughness": ("roughness", "specular_roughness"),
    "normal": ("normal", "geometry_normal"),
}
HAIR_INPUTS = {
    HAIR_ALBEDO: ("diffuseColor", "base_color"),
    HAIR_ALPHA: ("opacity", "geometry_opacity"),
}
"""The same for the maps of hair's own surface."""
_ALL_INPUTS = SHADER_INPUTS | HAIR_INPUTS
SRGB = "srgb_rec709_scene"
_PREVIEW_TYPES = {
    "diffuseColor": (Sdf.ValueTypeNames.Color3f, "rgb"),
    "ior": (Sdf.ValueTypeNames.Float, "r"),
    "roughness": (Sdf.ValueTypeNames.Float, "r"),
    "opacity": (Sdf.ValueTypeNames.Float, "r"),
    "normal": (Sdf.ValueTypeNames.Normal3f, "rgb"),
}
_IMAGE_NODES = {
    "base_color": ("ND_image_color3", Sdf.ValueTypeNames.Color3f, Gf.Vec3f(0.0)),
    "specular_weight": ("ND_image_float", Sdf.ValueTypeNames.Float, 1.0),
    "specular_roughness": ("ND_image_float", Sdf.ValueTypeNames.Float, 0.5),
    "geometry_normal": ("ND_image_vector3", Sdf.ValueTypeNames.Float3, Gf.Vec3f(0.5, 0.5, 1.0)),
    "displacement": ("ND_image_float", Sdf.ValueTypeNames.Float, 0.0),
    "geometry_opacity": ("ND_image_float", Sdf.ValueTypeNames.Float, 1.0),
}
NORMAL_SCALE, NORMAL_BIAS = Gf.Vec4f(2.0, 2.0, 2.0, 1.0), Gf.Vec4f(-1.0, -1.0, -1.0, 0.0)
"""UsdUVTexture has to undo n * 0.5 + 0.5 by itself; the MaterialX normalmap node does it inside."""


@dataclass(frozen=True)
class TextureFile:
    """A map's file (its path relative to the layer) and colour space: "data" or a name such as lin_rec709_scene."""

    path: str
    colour_space: str = "data"

    @property
    def preview_colour_space(self) -> str:
        """What UsdUVTexture can say of it: sRGB or raw."""
        return "sRGB" if self.colour_space == SRGB else "raw"


@dataclass(frozen=True)
class Finish:
    """What no map says of a surface: its index of refraction, its roughness, None: the shaders' own, and whether it has
    highlights."""

    ior: float = IOR
    roughness: float | None = None
    shines: bool = True


SKIN, EYE = Finish(), Finish(TEAR_FILM_IOR, EYE_ROUGHNESS)
MATT = Finish(ior=1.0, roughness=0.5, shines=False)
"""Hair: an index of 1 reflects nothing."""
EYE_MAPS = ("diffuse_albedo",)
"""Those of SHADER_INPUTS that the eyes read: intensity, roughness and relief of the others are skin's."""


def modulated_ior(specular_intensity: np.ndarray) -> np.ndarray:
    """[...] specular intensity -> [...] index of refraction whose F0 is 0.04 times the intensity.

    OpenPBR 1.1, specular weight: eta' = (1 + e) / (1 - e), e = sqrt(weight) (eta - 1) / (eta + 1).
    Intensities below zero count as zero; F0 is kept below 1.
    """
    root = np.sqrt(np.maximum(specular_intensity, 0.0)) * ((IOR - 1.0) / (IOR + 1.0))
    root = np.minimum(root, 0.99)
    return ((1.0 + root) / (1.0 - root)).astype(np.float32)


def define_material(
    stage: Usd.Stage, path: str, maps: Mapping[str, TextureFile], finish: Finish = SKIN
) -> UsdShade.Material:
    """Defines the material from maps {name of SHADER_INPUTS or HAIR_INPUTS: texture}; for absent ones the finish or
    the input's default counts."""
    material = UsdShade.Material.Define(stage, path)
    _preview_surface(stage, material, maps, finish)
    _open_pbr(stage, material, maps, finish)
    return material


def define_scattering(stage: Usd.Stage, material: UsdShade.Material) -> None:
    """Lets light into a material of define_material, as into skin: OpenPBR's subsurface in place of its diffuse base.

    Its colour is inverted from the albedo A so that both look alike from the front: C with a C + b C^2 = A, which is
    sqrt(A / b + k^2) - k with k = a / (2 b).
    Reference: OpenPBR surface 1.1, Subsurface.
    """
    path, types = material.GetPath(), Sdf.ValueTypeNames
    surface = UsdShade.Shader.Get(stage, path.AppendChild("openpbr_surface"))
    albedo = UsdShade.Shader.Get(stage, path.AppendChild("openpbr_diffuse_albedo")).GetOutput("out")
    half = 0.5 * SEEN_LINEAR / SEEN_SQUARE
    for name, kind, number in (("scaled", "multiply", 1.0 / SEEN_SQUARE), ("raised", "add", half**2),
                               ("root", "power", 0.5), ("inverted", "subtract", half)):
        node = _shader(stage, material, f"openpbr_albedo_{name}", f"ND_{kind}_color3FA")
        node.CreateInput("in1", types.Color3f).ConnectToSource(albedo)
        node.CreateInput("in2", types.Float).Set(number)
        albedo = node.CreateOutput("out", types.Color3f)
    farthest = max(SKIN_MEAN_FREE_PATH_MM)
    surface.CreateInput("subsurface_weight", types.Float).Set(1.0)
    surface.CreateInput("subsurface_color", types.Color3f).ConnectToSource(albedo)
    surface.CreateInput("subsurface_radius", types.Float).Set(farthest)
    scale = Gf.Vec3f(*(own / farthest for own in SKIN_MEAN_FREE_PATH_MM))
    surface.CreateInput("subsurface_radius_scale", types.Color3f).Set(scale)
    surface.CreateInput("subsurface_scatter_anisotropy", types.Float).Set(0.0)


def define_displacement(stage: Usd.Stage, material: UsdShade.Material, heights: TextureFile) -> None:
    """Moves the surface of a material of define_material along its normal by a map in units of the stage, for both
    models: P' = P + height N, neither scaled nor shifted."""
    path, types = material.GetPath(), Sdf.ValueTypeNames
    coordinates = UsdShade.Shader.Get(stage, path.AppendChild("preview_st")).GetOutput("result")
    texture = _preview_texture(stage, material, "displacement", heights, coordinates)
    surface = UsdShade.Shader.Get(stage, path.AppendChild("preview_surface"))
    surface.CreateInput("displacement", types.Float).ConnectToSource(texture.CreateOutput("r", types.Float))
    moved = surface.CreateOutput("displacement", types.Token)
    material.CreateDisplacementOutput().ConnectToSource(moved)

    coordinates = UsdShade.Shader.Get(stage, path.AppendChild("openpbr_st")).GetOutput("out")
    height = _image_node(stage, material, "displacement", "displacement", heights, coordinates)
    node = _shader(stage, material, "openpbr_displace", "ND_displacement_float")
    node.CreateInput("displacement", types.Float).ConnectToSource(height)
    node.CreateInput("scale", types.Float).Set(1.0)
    material.CreateDisplacementOutput("mtlx").ConnectToSource(node.CreateOutput("out", types.Token))


def define_plate_material(stage: Usd.Stage, path: str, files: Mapping[int, str]) -> UsdShade.Material:
    """Shows files {time code: path relative to the layer}, sRGB pictures, as they are whatever the light."""
    material = UsdShade.Material.Define(stage, path)
    surface = _shader(stage, material, "surface", "UsdPreviewSurface")
    for name, value in (("roughness", 1.0), ("ior", 1.0)):  # an index of 1 reflects nothing
        surface.CreateInput(name, Sdf.ValueTypeNames.Float).Set(value)
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(0.0))
    reader = _shader(stage, material, "st", "UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    coordinates = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    texture = _shader(stage, material, "picture", "UsdUVTexture")
    texture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(coordinates)
    file = texture.CreateInput("file", Sdf.ValueTypeNames.Asset)
    file.GetAttr().SetColorSpace(SRGB)
    file.Set(Sdf.AssetPath(next(iter(files.values()))))  # for readers that know no animated pictures
    for time, picture in files.items():
        file.Set(Sdf.AssetPath(picture), float(time))
    for name, value in (("sourceColorSpace", "sRGB"), ("wrapS", "clamp"), ("wrapT", "clamp")):
        texture.CreateInput(name, Sdf.ValueTypeNames.Token).Set(value)
    output = texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    surface.CreateInput("emissiveColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(output)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    return material


def _preview_surface(
    stage: Usd.Stage, material: UsdShade.Material, maps: Mapping[str, TextureFile], finish: Finish
) -> None:
    surface = _shader(stage, material, "preview_surface", "UsdPreviewSurface")
    surface.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(0.0)
    surface.CreateInput("useSpecularWorkflow", Sdf.ValueTypeNames.Int).Set(0)
    surface.CreateInput("ior", Sdf.ValueTypeNames.Float).Set(finish.ior)
    if finish.roughness is not None:
        surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(finish.roughness)
    if HAIR_ALPHA in maps:
        surface.CreateInput("opacityMode", Sdf.ValueTypeNames.Token).Set("presence")
        surface.CreateInput("opacityThreshold", Sdf.ValueTypeNames.Float).Set(0.0)
    reader = _shader(stage, material, "preview_st", "UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    coordinates = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    for name, (preview_input, _) in _ALL_INPUTS.items():
        if preview_input is None or name not in maps:
            continue
        texture = _preview_texture(stage, material, name, maps[name], coordinates)
        if name == "normal":
            texture.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set(NORMAL_SCALE)
            texture.CreateInput("bias", Sdf.ValueTypeNames.Float4).Set(NORMAL_BIAS)
        value_type, channel = _PREVIEW_TYPES[preview_input]
        output_type = Sdf.ValueTypeNames.Float if channel == "r" else Sdf.ValueTypeNames.Float3
        output = texture.CreateOutput(channel, output_type)
        surface.CreateInput(preview_input, value_type).ConnectToSource(output)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))


def _open_pbr(
    stage: Usd.Stage, material: UsdShade.Material, maps: Mapping[str, TextureFile], finish: Finish
) -> None:
    surface = _shader(stage, material, "openpbr_surface", "ND_open_pbr_surface_surfaceshader")
    surface.CreateInput("specular_ior", Sdf.ValueTypeNames.Float).Set(finish.ior)
    if finish.roughness is not None:
        surface.CreateInput("specular_roughness", Sdf.ValueTypeNames.Float).Set(finish.roughness)
    if not finish.shines:
        surface.CreateInput("specular_weight", Sdf.ValueTypeNames.Float).Set(0.0)
    surface.CreateInput("base_diffuse_roughness", Sdf.ValueTypeNames.Float).Set(0.0)
    reader = _shader(stage, material, "openpbr_st", "ND_geompropvalue_vector2")
    reader.CreateInput("geomprop", Sdf.ValueTypeNames.String).Set("st")
    coordinates = reader.CreateOutput("out", Sdf.ValueTypeNames.Float2)
    for name, (_, open_pbr_input) in _ALL_INPUTS.items():
        if open_pbr_input is None or name not in maps:
            continue
        value_type = _IMAGE_NODES[open_pbr_input][1]
        output = _image_node(stage, material, name, open_pbr_input, maps[name], coordinates)
        if name == "normal":
            bend = _shader(stage, material, "openpbr_normalmap", "ND_normalmap_float")
            bend.CreateInput("in", value_type).ConnectToSource(output)
            output = bend.CreateOutput("out", value_type)
        surface.CreateInput(open_pbr_input, value_type).ConnectToSource(output)
    terminal = surface.CreateOutput("out", Sdf.ValueTypeNames.Token)
    material.CreateSurfaceOutput("mtlx").ConnectToSource(terminal)


def _preview_texture(
    stage: Usd.Stage, material: UsdShade.Material, name: str, file: TextureFile, coordinates: UsdShade.Output
) -> UsdShade.Shader:
    """Reads a map for UsdPreviewSurface; its outputs are left to the caller."""
    texture = _shader(stage, material, f"preview_{name}", "UsdUVTexture")
    texture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(coordinates)
    _file_input(texture, file)
    texture.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set(file.preview_colour_space)
    for axis in ("wrapS", "wrapT"):
        texture.CreateInput(axis, Sdf.ValueTypeNames.Token).Set("clamp")
    return texture


def _image_node(
    stage: Usd.Stage, material: UsdShade.Material, name: str, wanted: str, file: TextureFile,
    coordinates: UsdShade.Output,
) -> UsdShade.Output:
    """Reads a map as MaterialX does for the input wanted, one of _IMAGE_NODES."""
    node, value_type, default = _IMAGE_NODES[wanted]
    image = _shader(stage, material, f"openpbr_{name}", node)
    image.CreateInput("texcoord", Sdf.ValueTypeNames.Float2).ConnectToSource(coordinates)
    _file_input(image, file)
    image.CreateInput("default", value_type).Set(default)
    for axis in ("uaddressmode", "vaddressmode"):
        image.CreateInput(axis, Sdf.ValueTypeNames.String).Set("clamp")
    return image.CreateOutput("out", value_type)


def _shader(stage: Usd.Stage, material: UsdShade.Material, name: str, shader_id: str) -> UsdShade.Shader:
    shader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild(name))
    shader.CreateIdAttr(shader_id)
    return shader


def _file_input(shader: UsdShade.Shader, texture: TextureFile) -> None:
    attribute = shader.CreateInput("file", Sdf.ValueTypeNames.Asset)
    attribute.Set(Sdf.AssetPath(texture.path))
    attribute.GetAttr().SetColorSpace(texture.colour_space)
