"""Mitsuba 3 as an independent path tracer: pictures of one mesh under one environment map.

Optional (`pip install mitsuba`, BSD 3-clause): only tests and benchmarks use it. Light transport, visibility and the
sampling of the light are Mitsuba's. Matte surfaces are its own `diffuse`; our lobe, for whose Schlick term it has no
plugin, is written here as a BSDF of its own, apart from shared.brdf. The variant is scalar_rgb, which needs no LLVM;
LIMN_MITSUBA_VARIANT names another one.

References: Jakob et al., Mitsuba 3 renderer, 2022; Walter et al., Microfacet models for refraction through rough
surfaces, EGSR 2007 (eqs. 33 to 36).
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from shared.geometry import invert_rigid
from shared.mesh import Mesh, vertex_normals
from shared.solve.views import Camera

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
    return module


def path_trace(
    mesh: Mesh, latlong: np.ndarray, camera: Camera, coat: Coat, depth: int, samples: int, seed: int = 0
) -> np.ndarray:
    """Linear radiance [h, w, 3] of the mesh, 0 beside it; the mean of `samples` paths per pixel, box filter.

    latlong [H, 2 H, 3]: radiance in the mesh's space, layout of shared.envmap; it should be fine (512 rows), since
    Mitsuba's rows reach half a pixel further than ours.
    """
    mi = mitsuba()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.ply"
        path.write_bytes(_ply(mesh))
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "path", "max_depth": depth, "rr_depth": 1000, "hide_emitters": True},
                "sensor": _sensor(mi, camera, samples),
                "light": {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(latlong, np.float32))},
                "shape": {"type": "ply", "filename": str(path), "bsdf": _bsdf(coat)},
            }
        )
        return np.array(mi.render(scene, seed=seed, spp=samples))[..., :3]


def _sensor(mi, camera: Camera, samples: int) -> dict:
    width, height = camera.size
    # Mitsuba's camera has x to the left and y up.
    head_from_camera = invert_rigid(camera.camera_from_head) @ np.diag([-1.0, -1.0, 1.0, 1.0])
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
        "to_world": mi.ScalarTransform4f(head_from_camera),
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
    """Binary PLY with the vertex normals that our renderer shades with."""
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(mesh.vertices)}\n"
        + "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
        + f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    normals = vertex_normals(mesh.vertices, mesh.faces)
    faces = np.zeros(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    return header.encode() + np.hstack([mesh.vertices, normals]).astype("<f4").tobytes() + faces.tobytes()


@cache
def _skin_bsdf():
    """The class, made once the variant is known."""
    import drjit as dr
    import mitsuba as mi

    class Skin(mi.BSDF):
        """albedo / pi + specular_intensity D G F / (4 cos_i cos_o); half of the samples follow the cosine, half D."""

        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.albedo = mi.Color3f(props["red"], props["green"], props["blue"])
            self.intensity, self.alpha = props["specular_intensity"], props["roughness"] ** 2
            flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            self.m_components, self.m_flags = [flags], flags

        def sample(self, ctx, si, sample1, sample2, active=True):
            tangent2 = self.alpha**2 * sample2.x / dr.maximum(1.0 - sample2.x, 1e-7)
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
            cos_i, cos_o = si.wi.z, wo.z
            above = active & (cos_i > 1e-6) & (cos_o > 1e-6)
            half = dr.normalize(si.wi + wo)
            tangent2 = (half.x**2 + half.y**2) / dr.maximum(half.z**2, 1e-12)
            alpha2, cos_h = self.alpha**2, dr.maximum(half.z, 1e-6)
            distribution = alpha2 / (dr.pi * cos_h**4 * (alpha2 + tangent2) ** 2)
            masking = 1.0
            for cosine in (cos_i, cos_o):
                steep2 = dr.maximum(1.0 - cosine**2, 0.0) / dr.maximum(cosine**2, 1e-12)
                masking *= 2.0 / (1.0 + dr.sqrt(1.0 + alpha2 * steep2))
            toward = dr.maximum(dr.dot(wo, half), 1e-6)
            fresnel = 0.04 + 0.96 * (1.0 - toward) ** 5
            lobe = self.intensity * distribution * masking * fresnel / (4.0 * dr.maximum(cos_i, 1e-6))
            value = self.albedo * (cos_o / dr.pi) + mi.Color3f(lobe)
            pdf = 0.5 * cos_o / dr.pi + 0.5 * distribution * cos_h / (4.0 * toward)
            return dr.select(above, value, mi.Color3f(0.0)), dr.select(above, pdf, 0.0)

        def to_string(self):
            return "Skin[]"

    return Skin
