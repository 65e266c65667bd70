"""Embree as compiled loops call it: a ray at a time, without the interpreter between two rays and without its lock.

embreex brings the library and calls it under the interpreter's lock; its functions are taken from the same file.
A ray is RAY_WORDS 32-bit words, embree's RTCRayHit: origin, nearest distance, direction, time, farthest distance, mask,
id, flags; then what it met: normal, u, v, face, geometry, instances.
"""

from __future__ import annotations

import ctypes
import weakref
from functools import cache

import numpy as np
from embreex import rtcore_scene
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

RAY_WORDS, _ALIGNMENT = 24, 64
"""As embree lays it out, and a little more: newer versions add words at the end. Where it wants it, in bytes."""
FAR = np.float32(1e30)
MASK, FACE, GEOMETRY, FARTHEST = 9, 17, 18, 8
"""Places of words in a ray."""

_TRIANGLES, _INDICES, _PLACES, _UINT3, _FLOAT3, _WATERTIGHT = 0, 0, 1, 0x5003, 0x9003, 4
"""Embree's numbers for a geometry's type, its buffers, their formats, and scenes in which no ray slips between faces.
"""


@cache
def _library() -> ctypes.CDLL:
    """The library that embreex is linked with."""
    library, pointer, number = ctypes.CDLL(rtcore_scene.__file__), ctypes.c_void_p, ctypes.c_uint
    declared = {
        "rtcNewDevice": (pointer, ctypes.c_char_p),
        "rtcGetDeviceError": (ctypes.c_int, pointer),
        "rtcNewScene": (pointer, pointer),
        "rtcSetSceneFlags": (None, pointer, ctypes.c_int),
        "rtcNewGeometry": (pointer, pointer, ctypes.c_int),
        "rtcSetNewGeometryBuffer":
            (pointer, pointer, ctypes.c_int, number, ctypes.c_int, ctypes.c_size_t, ctypes.c_size_t),
        "rtcCommitGeometry": (None, pointer),
        "rtcAttachGeometry": (number, pointer, pointer),
        "rtcReleaseGeometry": (None, pointer),
        "rtcCommitScene": (None, pointer),
        "rtcReleaseScene": (None, pointer),
    }
    for name, (result, *arguments) in declared.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


@cache
def _device() -> int:
    """One for the process. It builds on the caller's thread alone: a mesh takes it a twentieth of a second."""
    device = _library().rtcNewDevice(b"threads=1")
    if not device:
        raise RuntimeError(f"embree does not start: error {_library().rtcGetDeviceError(None)}")
    return device


class Triangles:
    """An acceleration structure over vertices [V, 3] and faces [F, 3], freed with the object. scene: its address;
    intersect, occluded: those of embree's functions, for call_embree."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        library, device = _library(), _device()
        geometry = library.rtcNewGeometry(device, _TRIANGLES)
        for buffer, layout, values in (
            (_PLACES, _FLOAT3, np.ascontiguousarray(vertices, np.float32)),
            (_INDICES, _UINT3, np.ascontiguousarray(faces, np.uint32)),
        ):
            place = library.rtcSetNewGeometryBuffer(geometry, buffer, 0, layout, values.itemsize * 3, len(values))
            if place and len(values):
                ctypes.memmove(place, values.ctypes.data, values.nbytes)
        library.rtcCommitGeometry(geometry)
        scene = library.rtcNewScene(device)
        weakref.finalize(self, library.rtcReleaseScene, scene)
        library.rtcSetSceneFlags(scene, _WATERTIGHT)
        library.rtcAttachGeometry(scene, geometry)
        library.rtcReleaseGeometry(geometry)
        library.rtcCommitScene(scene)
        if fault := library.rtcGetDeviceError(device):
            raise RuntimeError(f"embree cannot take {len(vertices)} vertices and {len(faces)} faces: error {fault}")
        self.scene, self.intersect, self.occluded = (
            np.uint64(address) for address in (scene, _address("rtcIntersect1"), _address("rtcOccluded1"))
        )


def ray_buffer() -> tuple[np.ndarray, np.ndarray, np.uint64]:
    """A ray's words as floats and as integers, the same memory, and its address; for one thread."""
    block = np.zeros(RAY_WORDS + _ALIGNMENT // 4, np.float32)
    first = -block.ctypes.data % _ALIGNMENT // 4
    ray = block[first : first + RAY_WORDS]
    return ray, ray.view(np.int32), np.uint64(ray.ctypes.data)


def _address(name: str) -> int:
    return ctypes.cast(getattr(_library(), name), ctypes.c_void_p).value


@intrinsic
def call_embree(typingctx, function, scene, ray):
    """For compiled loops: embree's function on a scene and the address of a ray's words, all three uint64."""
    word = types.uint64

    def generate(context, builder, signature, arguments):
        pointer = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [pointer] * 3)
        called = builder.inttoptr(arguments[0], kind.as_pointer())
        given = [builder.inttoptr(argument, pointer) for argument in arguments[1:]]
        builder.call(called, [*given, ir.Constant(pointer, None)])
        return context.get_dummy_value()

    return types.void(word, word, word), generate
