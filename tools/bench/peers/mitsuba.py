"""Mitsuba 3 as an independent path tracer: pictures of one mesh under one environment map.

Optional (`pip install mitsuba`, BSD 3-clause): only tests and benchmarks use it. Light transport, visibility and the
sampling of the light are Mitsuba's. Matte surfaces are its own `diffuse`; our lobe, for whose Schlick term it has no
plugin, is written here as a BSDF of its own, apart from shared.rendering.brdf. The variant is scalar_rgb, which needs
no LLVM; LIMN_MITSUBA_VARIANT names another one.

References: [Jakob2022] (the renderer); [Walter2007] (eqs. 33 to 36).
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from shared.geometry.mesh import Mesh, unique_pairs, vertex_normals
from shared.geometry.transforms import invert_rigid
from shared.rendering.views import ViewCamera

VARIABLE = "LIMN_MITSUBA_VARIANT"
DIRECT, ONE_BOUNCE, ALL_BOUNCES = 2, 3, 12
"""Mitsuba's max_depth: 2 is light that arrives straight from the environment."""


@dataclass(frozen=True)
class Coat:
    """One material all over: albedo [3], specular_intensity, roughness."""

    albedo: tuple[float, float, float]
    specular_intensity: float = 0.0
    roughness: float = 0.5


@cache
def mitsuba():
    """The module, its variant chosen; ImportError where it is not installed."""
    import mitsuba as module

    module.set_variant(os.environ.get(VARIABLE, "scalar_rgb"))
    module.register_bsdf("limn_skin", lambda props: _skin_bsdf()(props))
    module.register_bsdf("limn_skin_maps", lambda props: _mapped_skin_bsdf()(props))
    return module


def path_trace(
    mesh: Mesh, latlong: np.ndarray, camera: ViewCamera, coat: Coat, depth: int, samples: int, seed: int = 0
) -> np.ndarray:
    """Linear radiance [h, w, 3] of the mesh, 0 beside it; the mean of `samples` paths per pixel, box filter.

    latlong [H, 2 H, 3]: radiance in the mesh's space, layout of shared.rendering.envmap; it should be fine (512 rows),
    since Mitsuba's rows reach half a pixel further than ours.
    """
    mi = mitsuba()
    integrator = {"type": "path", "max_depth": depth, "rr_depth": 1000, "hide_emitters": True}
    scene = load_scene(mesh, latlong, camera, _bsdf(coat), integrator, samples)
    return np.array(mi.render(scene, seed=seed, spp=samples))[..., :3]


def load_scene(mesh: Mesh, latlong: np.ndarray, camera: ViewCamera, bsdf: dict, integrator: dict, samples: int):
    """Mitsuba's scene of one mesh, "shape", under one environment map, "light", seen by one "sensor"."""
    mi = mitsuba()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.ply"
        path.write_bytes(_ply(mesh))
        return mi.load_dict(
            {
                "type": "scene",
                "integrator": integrator,
                "sensor": _sensor(mi, camera, samples),
                "light": {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(latlong, np.float32))},
                "shape": {"type": "ply", "filename": str(path), "bsdf": bsdf},
            }
        )


def head_from_camera(camera_from_head: np.ndarray) -> np.ndarray:
    """[4, 4] with the axes of Mitsuba's camera, which has x to the left and y up."""
    return invert_rigid(camera_from_head) @ np.diag([-1.0, -1.0, 1.0, 1.0])


def _sensor(mi, camera: ViewCamera, samples: int) -> dict:
    width, height = camera.size
    film = {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
        "component_format": "float32",
    }
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": float(np.degrees(2.0 * np.arctan(0.5 * width / camera.intrinsics[0, 0]))),
        "near_clip": 1.0,
        "far_clip": 1e5,
        "to_world": mi.ScalarTransform4f(head_from_camera(camera.camera_from_head)),
        "principal_point_offset_x": 0.5 - camera.intrinsics[0, 2] / width,
        "principal_point_offset_y": 0.5 - camera.intrinsics[1, 2] / height,
        "film": film,
        "sampler": {"type": "independent", "sample_count": samples},
    }


def _bsdf(coat: Coat) -> dict:
    if coat.specular_intensity == 0.0:
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(coat.albedo)}}
    red, green, blue = coat.albedo
    lobe = {"specular_intensity": coat.specular_intensity, "roughness": coat.roughness}
    return {"type": "limn_skin", "red": red, "green": green, "blue": blue, **lobe}


def _ply(mesh: Mesh) -> bytes:
    """Binary PLY with the vertex normals that our renderer shades with; vertices at seams of the texture twice."""
    corners, corner, _ = unique_pairs(np.stack([mesh.faces.ravel(), mesh.face_uvs.ravel()], 1))
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(corners)}\n"
        + "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz", "u", "v"))
        + f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    normals = vertex_normals(mesh.vertices, mesh.faces)
    # Mitsuba's textures start in the upper row.
    uvs = mesh.uvs[corners[:, 1]] * [1.0, -1.0] + [0.0, 1.0]
    columns = np.hstack([mesh.vertices[corners[:, 0]], normals[corners[:, 0]], uvs])
    faces = np.zeros(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, corner.reshape(-1, 3)
    return header.encode() + columns.astype("<f4").tobytes() + faces.tobytes()


@cache
def _skin_bsdf():
    """The class, made once the variant is known."""
    import drjit as dr
    import mitsuba as mi

    class Skin(mi.BSDF):
        """albedo / pi + specular_intensity D G F / (4 cos_i cos_o); half of the samples follow the cosine, half D."""

        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.read(props)
            flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            self.m_components, self.m_flags = [flags], flags

        def read(self, props):
            self.albedo = mi.Color3f(props["red"], props["green"], props["blue"])
            self.intensity, self.alpha = props["specular_intensity"], props["roughness"] ** 2

        def material(self, si, active):
            return self.albedo, self.intensity, self.alpha

        def sample(self, ctx, si, sample1, sample2, active=True):
            alpha = self.material(si, active)[2]
            tangent2 = alpha**2 * sample2.x / dr.maximum(1.0 - sample2.x, 1e-7)
            cosine = 1.0 / dr.sqrt(1.0 + tangent2)
            sine, azimuth = dr.sqrt(dr.maximum(0.0, 1.0 - cosine**2)), 2.0 * dr.pi * sample2.y
            half = mi.Vector3f(sine * dr.cos(azimuth), sine * dr.sin(azimuth), cosine)
            mirrored = 2.0 * dr.dot(si.wi, half) * half - si.wi
            sampled = mi.BSDFSample3f()
            sampled.wo = dr.select(sample1 < 0.5, mi.warp.square_to_cosine_hemisphere(sample2), mirrored)
            value, pdf = self.eval_pdf(ctx, si, sampled.wo, active)
            sampled.pdf, sampled.eta = pdf, 1.0
            sampled.sampled_component, sampled.sampled_type = mi.UInt32(0), mi.UInt32(+self.m_flags)
            return sampled, dr.select(pdf > 0.0, value / dr.maximum(pdf, 1e-20), mi.Color3f(0.0))

        def eval(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[1]

        def eval_pdf(self, ctx, si, wo, active=True):
            albedo, intensity, alpha = self.material(si, active)
            cos_i, cos_o = si.wi.z, wo.z
            above = active & (cos_i > 1e-6) & (cos_o > 1e-6)
            half = dr.normalize(si.wi + wo)
            tangent2 = (half.x**2 + half.y**2) / dr.maximum(half.z**2, 1e-12)
            alpha2, cos_h = alpha**2, dr.maximum(half.z, 1e-6)
            distribution = alpha2 / (dr.pi * cos_h**4 * (alpha2 + tangent2) ** 2)
            masking = 1.0
            for cosine in (cos_i, cos_o):
                steep2 = dr.maximum(1.0 - cosine**2, 0.0) / dr.maximum(cosine**2, 1e-12)
                masking *= 2.0 / (1.0 + dr.sqrt(1.0 + alpha2 * steep2))
            toward = dr.maximum(dr.dot(wo, half), 1e-6)
            fresnel = 0.04 + 0.96 * (1.0 - toward) ** 5
            lobe = intensity * distribution * masking * fresnel / (4.0 * dr.maximum(cos_i, 1e-6))
            value = albedo * (cos_o / dr.pi) + mi.Color3f(lobe)
            pdf = 0.5 * cos_o / dr.pi + 0.5 * distribution * cos_h / (4.0 * toward)
            return dr.select(above, value, mi.Color3f(0.0)), dr.select(above, pdf, 0.0)

        def to_string(self):
            return "Skin[]"

    return Skin


@cache
def _mapped_skin_bsdf():
    """The same with textures: albedo, and specular_intensity and roughness in one channel each."""
    import mitsuba as mi

    class MappedSkin(_skin_bsdf()):
        """Its textures are parameters that can be differentiated."""

        def read(self, props):
            self.maps = {name: props[name] for name in ("albedo", "specular_intensity", "roughness")}

        def traverse(self, callback):
            for name, texture in self.maps.items():
                callback.put(name, texture, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys):
            pass

        def material(self, si, active):
            maps = self.maps
            intensity, roughness = (maps[name].eval_1(si, active) for name in ("specular_intensity", "roughness"))
            return mi.Color3f(maps["albedo"].eval_3(si, active)), intensity, roughness**2

    return MappedSkin
