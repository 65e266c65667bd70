"""Every rule of shared/io/gltf_validate.py against a file that breaks just it, and files that break none."""

import json
import struct

import numpy as np
import pytest
from toy_result import FRAMES, INTRINSICS, SOURCE_SIZE, toy_eyed_surface, toy_gaze, toy_maps, toy_poses

from shared.geometry.eyeballs import eyeballs_of
from shared.geometry.parts import head_parts
from shared.io.gltf import write_glb
from shared.io.gltf_validate import glb_errors
from shared.io.usd_capture import UsdCapture

TARGETS = 2


class Glb:
    """A file taken apart: its JSON, its binary chunk; add appends numbers as an accessor."""

    def __init__(self, path):
        data = path.read_bytes()
        size = struct.unpack_from("<I", data, 12)[0]
        self.content, self.binary = json.loads(data[20:20 + size]), bytearray(data[28 + size:])

    def view(self, data):
        self.binary += bytes(-len(self.binary) % 4)
        self.content["bufferViews"].append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)})
        self.binary += data
        self.content["buffers"][0]["byteLength"] = len(self.binary)
        return len(self.content["bufferViews"]) - 1

    def add(self, values, kind, **more):
        code = {"f": 5126, "u": 5125}[values.dtype.kind]
        self.content["accessors"].append({"bufferView": self.view(values.tobytes()), "componentType": code,
                                          "count": len(values), "type": kind} | more)
        return len(self.content["accessors"]) - 1

    def array(self, index):
        """The accessor's numbers, to be changed in place."""
        row = self.content["accessors"][index]
        start = self.content["bufferViews"][row["bufferView"]]["byteOffset"]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[row["type"]]
        kind = {5126: "<f4", 5125: "<u4"}[row["componentType"]]
        return np.frombuffer(memoryview(self.binary), kind, row["count"] * width, start).reshape(-1, width)

    def attribute(self, name):
        return self.primitive["attributes"][name]

    @property
    def primitive(self):
        return self.content["meshes"][0]["primitives"][0]

    @property
    def material(self):
        return self.content["materials"][0]

    @property
    def tracks(self):
        return self.content["animations"][0]

    def track(self, path):
        """The sampler of the head's track of this path."""
        channel = next(c for c in self.tracks["channels"] if c["target"]["path"] == path)
        return self.tracks["samplers"][channel["sampler"]]

    def write(self, path):
        text = json.dumps(self.content).encode()
        text += b" " * (-len(text) % 4)
        binary = bytes(self.binary) + bytes(-len(self.binary) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path


def with_morphs(glb):
    """Two morph targets, the second one sparse, with their names and a track of weights."""
    count = glb.content["accessors"][glb.attribute("POSITION")]["count"]
    moves = np.zeros((count, 3), np.float32)
    moves[5] = [0.001, -0.002, 0.0]
    bounds = {"min": moves.min(0).tolist(), "max": moves.max(0).tolist()}
    dense = glb.add(moves, "VEC3", **bounds)
    sparse = {"count": 1, "indices": {"bufferView": glb.view(np.array([5], "<u4").tobytes()), "componentType": 5125},
              "values": {"bufferView": glb.view(moves[5].tobytes())}}
    glb.content["accessors"].append({"componentType": 5126, "count": count, "type": "VEC3", "sparse": sparse} | bounds)
    glb.primitive["targets"] = [{"POSITION": dense}, {"POSITION": len(glb.content["accessors"]) - 1}]
    glb.content["meshes"][0] |= {"weights": [0.0] * TARGETS, "extras": {"targetNames": ["jawOpen", "mouthClose"]}}
    clock = glb.track("rotation")["input"]
    weights = glb.add(np.zeros((len(FRAMES) * TARGETS, 1), np.float32), "SCALAR")
    target = {"node": 0, "path": "weights"}
    glb.tracks["channels"].append({"sampler": len(glb.tracks["samplers"]), "target": target})
    glb.tracks["samplers"].append({"input": clock, "output": weights})


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A head with turning eyes, as it is exported."""
    surface, path = toy_eyed_surface(), tmp_path_factory.mktemp("glb") / "head.glb"
    capture = UsdCapture(toy_poses(), FRAMES, 25.0, INTRINSICS, *SOURCE_SIZE, "head", eye_turn=toy_gaze())
    write_glb(path, "toy", head_parts(surface.mesh, eyeballs_of(surface)), toy_maps(), capture)
    return path


@pytest.fixture
def glb(original):
    found = Glb(original)
    with_morphs(found)
    return found


def test_exported_files_are_sound(original, glb, tmp_path):
    assert glb_errors(original) == []
    assert glb_errors(glb.write(tmp_path / "morphs.glb")) == []


def break_bytes(data):
    """Faults of the container: (words of the sentence, bytes)."""
    size = struct.unpack_from("<I", data, 12)[0]
    yield "no binary glTF", b"PK" + data[2:]
    yield "version 1, expected 2", data[:4] + struct.pack("<I", 1) + data[8:]
    yield "cut off, or something was added", data[:-8]
    yield "cut off, or something was added", data + bytes(4)
    yield "not a multiple of 4", data[:12] + struct.pack("<I", size - 1) + data[16:]
    yield "bytes stated", data[:12] + struct.pack("<I", len(data)) + data[16:]
    yield "expected JSON first", data[:16] + b"XXXX" + data[20:]
    yield "not built as glTF", data[:20] + b"[" + data[21:]
    yield "no binary glTF", b"glTF"


def test_faults_of_the_container(original, tmp_path):
    for words, data in break_bytes(original.read_bytes()):
        (tmp_path / "bad.glb").write_bytes(data)
        found = glb_errors(tmp_path / "bad.glb")
        assert len(found) == 1 and words in found[0] and found[0].startswith("bad.glb: "), (words, found)


def put(get, **values):
    """A fault: these values in that object of the file."""
    return lambda glb: get(glb).update(values)


def number(index, value, *place):
    """A fault: one number of an accessor, given by its name among the attributes or by the file."""
    def plant(glb):
        glb.array(glb.attribute(index) if isinstance(index, str) else index(glb))[place] = value
    return plant


def accessor(name, **values):
    return lambda glb: glb.content["accessors"][glb.attribute(name)].update(values)


def narrow_view(glb):
    row = glb.content["accessors"][glb.attribute("NORMAL")]
    glb.content["bufferViews"][row["bufferView"]]["byteLength"] -= 4


def clock(glb):
    return glb.track("rotation")["input"]


def repeat_channel(glb):
    glb.tracks["channels"][1]["target"] = dict(glb.tracks["channels"][0]["target"])


def wrong_magic(glb):
    view = glb.content["bufferViews"][glb.content["images"][0]["bufferView"]]
    glb.binary[view["byteOffset"]] = 0


def bad_tangents(glb):
    count = glb.content["accessors"][glb.attribute("POSITION")]["count"]
    glb.primitive["attributes"]["TANGENT"] = glb.add(np.tile(np.float32([1, 0, 0, 0.5]), (count, 1)), "VEC4")


def two_parents(glb):
    glb.content["nodes"].append({"children": [2]})


def own_ancestor(glb):
    glb.content["nodes"] += [{"children": [len(glb.content["nodes"]) + 1]}, {"children": [len(glb.content["nodes"])]}]


def moved(glb, target):
    """The accessor of a morph target's POSITION."""
    return glb.content["accessors"][glb.primitive["targets"][target]["POSITION"]]


def short_indices(glb):
    glb.content["accessors"][glb.primitive["indices"]]["count"] -= 1


FAULTS = [
    ("/asset/version", put(lambda g: g.content["asset"], version="1.0")),
    ("/buffers/0: ", put(lambda g: g.content["buffers"][0], byteLength=16)),
    ("/buffers: 1 buffers or one outside", put(lambda g: g.content["buffers"][0], uri="head.bin")),
    ("/bufferViews/0: ends at byte", put(lambda g: g.content["bufferViews"][0], byteLength=1 << 30)),
    ("/bufferViews/0: points to buffers 3", put(lambda g: g.content["bufferViews"][0], buffer=3)),
    ("/bufferViews/0: stride 6", put(lambda g: g.content["bufferViews"][0], byteStride=6)),
    ("/bufferViews/0/target: 7", put(lambda g: g.content["bufferViews"][0], target=7)),
    ("/samplers/0/wrapS: 7", put(lambda g: g.content["samplers"][0], wrapS=7)),
    ("/samplers/0/minFilter: 7", put(lambda g: g.content["samplers"][0], minFilter=7)),
    ("/interpolation: CUBIC", lambda g: g.track("rotation").update(interpolation="CUBIC")),
    ("/translation: 2 numbers, expected 3", put(lambda g: g.content["nodes"][0], translation=[0.0, 0.0])),
    ("/normalTexture: points to textures None", put(lambda g: g.material, normalTexture=2)),
    ("/min: [1e+300", accessor("POSITION", min=[1e300, 0.0, 0.0])),
    ("not among those of glTF", accessor("NORMAL", componentType=5124)),
    ("ends at byte", narrow_view),
    ("ends at byte", accessor("NORMAL", count=1 << 20)),
    ("begins at byte 2, not a multiple", accessor("NORMAL", byteOffset=2)),
    ("points to bufferViews 999", accessor("NORMAL", bufferView=999)),
    ("/min: [0.0, 0.0, 0.0] stated", accessor("POSITION", min=[0.0, 0.0, 0.0])),
    ("/max: ", number("POSITION", 9.0, 3, 1)),
    ("1 numbers are not finite", number("TEXCOORD_0", np.nan, 7, 0)),
    ("1 of", number("NORMAL", 2.0, 4, 0)),
    ("handedness", bad_tangents),
    ("no TANGENT, so that", lambda g: g.primitive["attributes"].pop("TANGENT")),
    ("/POSITION: neither min nor max", lambda g: g.content["accessors"][g.attribute("POSITION")].pop("min")),
    ("no POSITION", lambda g: g.primitive["attributes"].pop("POSITION")),
    ("/NORMAL: points to accessors 999", lambda g: g.primitive["attributes"].update(NORMAL=999)),
    ("/NORMAL: VEC2, expected VEC3", lambda g: g.primitive["attributes"].update(NORMAL=g.attribute("TEXCOORD_0"))),
    ("values of", lambda g: g.primitive["attributes"].update(
        NORMAL=g.content["meshes"][1]["primitives"][0]["attributes"]["NORMAL"])),
    ("/indices: up to", number(lambda g: g.primitive["indices"], 1 << 20, 0, 0)),
    ("/indices: not unsigned", lambda g: g.primitive.update(indices=g.attribute("NORMAL"))),
    ("expected whole triangles", short_indices),
    ("expected whole triangles", put(lambda g: g.primitive, mode=1)),
    ("/material: points to materials 7", put(lambda g: g.primitive, material=7)),
    ("no TEXCOORD_1, which", put(lambda g: g.material["normalTexture"], texCoord=1)),
    ("/normalTexture: points to textures 9", put(lambda g: g.material["normalTexture"], index=9)),
    ("extensions/KHR_materials_specular/specularTexture: points to textures 9",
     put(lambda g: g.material["extensions"]["KHR_materials_specular"]["specularTexture"], index=9)),
    ("/roughnessFactor: 1.5", put(lambda g: g.material["pbrMetallicRoughness"], roughnessFactor=1.5)),
    ("/specularColorFactor", put(lambda g: g.material["extensions"]["KHR_materials_specular"],
                                 specularColorFactor=[-1.0, 0.0, 0.0])),
    ("/alphaMode: CUT", put(lambda g: g.material, alphaMode="CUT")),
    ("/alphaMode: OPAQUE with a cutoff of 0.5", put(lambda g: g.material, alphaCutoff=0.5)),
    ("/alphaMode: MASK with a cutoff of -1", put(lambda g: g.material, alphaMode="MASK", alphaCutoff=-1.0)),
    ("/ior: 0.5", put(lambda g: g.content["materials"][1]["extensions"]["KHR_materials_ior"], ior=0.5)),
    ("/images/0: image/jpeg stated", put(lambda g: g.content["images"][0], mimeType="image/jpeg")),
    ("/images/0: image/png stated", wrong_magic),
    ("/images/0: lies outside", lambda g: g.content["images"][0].pop("bufferView")),
    ("/textures/0/source: points to images 8", put(lambda g: g.content["textures"][0], source=8)),
    ("/textures/0/sampler: points to samplers 8", put(lambda g: g.content["textures"][0], sampler=8)),
    ("1 different names of 2 morph targets", put(lambda g: g.content["meshes"][0]["extras"], targetNames=["a", "a"])),
    ("/weights: 1 of 2 morph targets", put(lambda g: g.content["meshes"][0], weights=[0.0])),
    ("expected the same number", lambda g: g.content["meshes"][0]["primitives"].append(
        g.content["meshes"][1]["primitives"][0])),
    ("/targets/0/NORMAL: ", lambda g: g.primitive["targets"][0].update(NORMAL=g.attribute("TEXCOORD_0"))),
    ("/targets/0/POSITION: neither", lambda g: moved(g, 0).pop("max")),
    ("sparse accessor", lambda g: moved(g, 1).update(count=5)),
    ("/nodes/0/mesh: points to meshes 8", put(lambda g: g.content["nodes"][0], mesh=8)),
    ("/rotation: no unit quaternion", put(lambda g: g.content["nodes"][0], rotation=[0, 0, 0, 2])),
    ("both a matrix and its parts", put(lambda g: g.content["nodes"][0], matrix=[0] * 16, scale=[1, 1, 1])),
    ("NaN is no number", put(lambda g: g.content["nodes"][0], translation=[float("nan"), 0, 0])),
    ("has two parents", two_parents),
    ("lies below itself", own_ancestor),
    ("/scene: points to scenes 4", put(lambda g: g.content, scene=4)),
    ("node 2 is no root", lambda g: g.content["scenes"][0]["nodes"].append(2)),
    ("/cameras/0: no lens", put(lambda g: g.content["cameras"][0]["perspective"], yfov=4.0)),
    ("/cameras/0: aspect", put(lambda g: g.content["cameras"][0]["perspective"], aspectRatio=0.0)),
    ("times do not rise strictly", lambda g: g.array(clock(g)).__setitem__((2, 0), g.array(clock(g))[1, 0])),
    ("no times in seconds", lambda g: g.content["accessors"][clock(g)].pop("max")),
    ("no unit quaternions", number(lambda g: g.track("rotation")["output"], 3.0, 1, 0)),
    ("VEC3 for 5 times of translation", lambda g: g.track("translation").update(output=g.track("rotation")["output"])),
    ("expected 10 SCALAR for 5 times of weights", lambda g: g.content["accessors"][
        g.tracks["samplers"][-1]["output"]].update(count=9)),
    ("a second time", repeat_channel),
    ("/channels/0: points to nodes 77", put(lambda g: g.tracks["channels"][0]["target"], node=77)),
    ("/channels/0: sampler 99", put(lambda g: g.tracks["channels"][0], sampler=99)),
    ("/extensionsUsed: does not name KHR_materials_specular", put(lambda g: g.content, extensionsUsed=[
        "KHR_materials_ior"])),
    ("/extensionsRequired", put(lambda g: g.content, extensionsRequired=["KHR_draco"])),
    ("not built as glTF", put(lambda g: g.content, nodes=5)),
    ("not built as glTF", lambda g: g.content.pop("asset")),
]


@pytest.mark.parametrize(("words", "plant"), FAULTS, ids=[f"{k} {words}" for k, (words, _) in enumerate(FAULTS)])
def test_every_fault_is_named(glb, tmp_path, words, plant):
    plant(glb)
    found = glb_errors(glb.write(tmp_path / "head.glb"))
    assert any(words in error for error in found), found
