"""Checks a binary glTF file by the rules of the format that decide whether other programs read it as it is meant.

The container, then every object by what it refers to, then the numbers themselves: ranges, bounds, unit lengths, times.
What no file of ours holds and nothing here needs (external files, cubic splines' tangents, unused objects) is
refused or left alone. Places in the file are named as JSON pointers: /accessors/3.

Reference: glTF 2.0 specification (Khronos Group), sections 3.5 to 3.12 and 4.4; KHR_materials_specular,
KHR_materials_ior. The rules are also those of Khronos' glTF-Validator.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

_JSON, _BIN = 0x4E4F534A, 0x004E4942
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_FLOAT, _INDEX_TYPES = 5126, (5121, 5123, 5125)
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_ATTRIBUTES = {"POSITION": "VEC3", "NORMAL": "VEC3", "TANGENT": "VEC4", "TEXCOORD": "VEC2", "JOINTS": "VEC4",
               "WEIGHTS": "VEC4"}
_MORPHED = ("POSITION", "NORMAL", "TANGENT")
_PATHS = {"translation": "VEC3", "rotation": "VEC4", "scale": "VEC3", "weights": "SCALAR"}
_TRIANGLES = 4
_PLACES = {"translation": 3, "rotation": 4, "scale": 3, "matrix": 16}
_INTERPOLATIONS = ("LINEAR", "STEP", "CUBICSPLINE")
_WRAPS = (33071, 33648, 10497)
_SAMPLING = {"magFilter": (9728, 9729), "minFilter": (9728, 9729, 9984, 9985, 9986, 9987), "wrapS": _WRAPS,
             "wrapT": _WRAPS}
_TARGETS = (34962, 34963)
_MAGIC = {"image/png": b"\x89PNG\r\n\x1a\n", "image/jpeg": b"\xff\xd8\xff"}
_ALPHA_MODES = ("OPAQUE", "MASK", "BLEND")
_UNIT_TOLERANCE = 1e-3
_MISBUILT = (AttributeError, IndexError, KeyError, MemoryError, OverflowError, RecursionError, TypeError, ValueError)


def glb_errors(path: Path | str) -> list[str]:
    """Sentences about everything wrong with the .glb at path, each beginning with its file's name; empty when sound.

    OSError where it cannot be read.
    """
    path = Path(path)
    return [f"{path.name}: {error}" for error in _data_errors(path.read_bytes())]


def _data_errors(data: bytes) -> list[str]:
    errors, chunks = _container(data)
    if errors:
        return errors
    try:
        content = json.loads(chunks[_JSON], parse_float=_number, parse_constant=_number)
        if content["asset"]["version"] != "2.0":
            return [f"/asset/version: glTF {content['asset']['version']}, expected 2.0"]
        for error in _Glb(content, chunks.get(_BIN, b"")).errors():
            errors.append(error)
    except _MISBUILT as error:  # what is built on something that was just named is no fault of its own
        return errors or [f"not built as glTF says: {type(error).__name__} {error}"]
    return errors


def _number(text: str) -> float:
    """A number of the JSON, or what Python's reader takes for one though JSON has none such."""
    value = float(text)
    if not np.isfinite(value):
        raise ValueError(f"{text} is no number")
    return value


def _container(data: bytes) -> tuple[list[str], dict[int, bytes]]:
    """What is wrong with the header and the chunks, and the chunks by type."""
    if len(data) < 20 or data[:4] != b"glTF":
        return ["no binary glTF: other first bytes"], {}
    version, length = struct.unpack_from("<II", data, 4)
    errors = [f"header: version {version}, expected 2"] if version != 2 else []
    if length != len(data):
        errors.append(f"header: {length} bytes stated, {len(data)} there: cut off, or something was added")
    chunks, order, at = {}, [], 12
    while at < len(data) and not errors:
        if at + 8 > len(data):
            errors.append(f"chunk {len(order)}: cut off")
            break
        size, kind = struct.unpack_from("<II", data, at)
        if size % 4:
            errors.append(f"chunk {len(order)}: {size} bytes, not a multiple of 4")
        if at + 8 + size > len(data):
            errors.append(f"chunk {len(order)}: {size} bytes stated, {len(data) - at - 8} there")
        order.append(kind)
        chunks.setdefault(kind, data[at + 8:at + 8 + size])
        at += 8 + size
    if not errors and (order[:1] != [_JSON] or order.count(_JSON) > 1 or _BIN in order[2:]):
        errors.append("chunks: expected JSON first, then the binary one")
    return errors, chunks


class _Glb:
    """One file's content with its binary chunk; errors() goes through all of it."""

    def __init__(self, content: Mapping, binary: bytes):
        self.content, self.binary = content, binary
        self.values: dict[int, np.ndarray] = {}

    def all(self, name: str) -> list:
        """Objects of one kind, none where the file has none."""
        return self.content.get(name, [])

    def errors(self) -> Iterator[str]:
        yield from self._buffers()
        yield from self._accessors()
        yield from self._images()
        yield from self._materials()
        for place, mesh in enumerate(self.all("meshes")):
            yield from self._mesh(f"/meshes/{place}", mesh)
        yield from self._nodes()
        yield from self._cameras()
        for place, animation in enumerate(self.all("animations")):
            yield from self._animation(f"/animations/{place}", animation)
        yield from self._extensions()

    def missing(self, where: str, kind: str, index: object) -> list[str]:
        """A sentence where there is no object of this kind and number."""
        count = len(self.all(kind))
        if isinstance(index, int) and not isinstance(index, bool) and 0 <= index < count:
            return []
        return [f"{where}: points to {kind} {index}, there are {count}"]

    # ------------------------------------------------------------------ bytes

    def _buffers(self) -> Iterator[str]:
        buffers = self.all("buffers")
        if len(buffers) != 1 or "uri" in buffers[0]:
            yield f"/buffers: {len(buffers)} buffers or one outside of the file, expected the binary chunk alone"
        elif not 0 <= len(self.binary) - buffers[0]["byteLength"] <= 3:
            yield f"/buffers/0: {buffers[0]['byteLength']} bytes stated, the binary chunk has {len(self.binary)}"
        for place, view in enumerate(self.all("bufferViews")):
            where, stride = f"/bufferViews/{place}", view.get("byteStride", 4)
            yield from self.missing(where, "buffers", view["buffer"])
            end = view.get("byteOffset", 0) + view["byteLength"]
            if view.get("byteOffset", 0) < 0 or view["byteLength"] < 1 or end > len(self.binary):
                yield f"{where}: ends at byte {end} of {len(self.binary)}"
            if view.get("target", _TARGETS[0]) not in _TARGETS:
                yield f"{where}/target: {view['target']}, not among those of glTF"
            if stride % 4 or not 4 <= stride <= 252:
                yield f"{where}: stride {stride}, expected a multiple of 4 from 4 to 252"

    def _accessors(self) -> Iterator[str]:
        for place, accessor in enumerate(self.all("accessors")):
            where = f"/accessors/{place}"
            if accessor["componentType"] not in _TYPES or accessor["type"] not in _WIDTHS or accessor["count"] < 1:
                yield (f"{where}: {accessor['count']} of component type {accessor['componentType']}, "
                       f"{accessor['type']}: not among those of glTF")
                continue
            found = list(self._extent(where, accessor))
            yield from found
            if not found:
                values = self.values[place] = self._read(accessor)
                yield from _number_errors(where, accessor, values)

    def _extent(self, where: str, accessor: Mapping) -> Iterator[str]:
        """Whether the accessor's bytes, and those of its sparse part, lie in their views, aligned."""
        size = np.dtype(_TYPES[accessor["componentType"]]).itemsize
        width = size * _WIDTHS[accessor["type"]]
        if "bufferView" in accessor:
            yield from self._span(where, accessor, accessor["count"], size, width)
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            kind = sparse["indices"]["componentType"]
            if kind not in _INDEX_TYPES or not 1 <= sparse["count"] <= accessor["count"]:
                yield f"{where}/sparse: {sparse['count']} of component type {kind}: not among those of glTF"
                return
            own = np.dtype(_TYPES[kind]).itemsize
            yield from self._span(f"{where}/sparse/indices", sparse["indices"], sparse["count"], own, own)
            yield from self._span(f"{where}/sparse/values", sparse["values"], sparse["count"], size, width)

    def _span(self, where: str, part: Mapping, count: int, size: int, width: int) -> Iterator[str]:
        if absent := self.missing(where, "bufferViews", part["bufferView"]):
            yield from absent
            return
        view, start = self.all("bufferViews")[part["bufferView"]], part.get("byteOffset", 0)
        stride = view.get("byteStride", width)
        if start % size or (start + view.get("byteOffset", 0)) % size:
            yield f"{where}: begins at byte {start}, not a multiple of its components' {size}"
        end = start + stride * (count - 1) + width
        limit = min(view["byteLength"], len(self.binary) - view.get("byteOffset", 0))
        if start < 0 or stride < width or end > limit:
            yield f"{where}: ends at byte {end} of its view's {limit}"

    def _read(self, accessor: Mapping) -> np.ndarray:
        """[count, width] as stored; spans are checked before."""
        kind = np.dtype(_TYPES[accessor["componentType"]])
        count, width = accessor["count"], _WIDTHS[accessor["type"]]
        if "bufferView" not in accessor:
            values = np.zeros((count, width), kind)
        else:
            values = self._array(accessor, count, width, kind)
        if "sparse" in accessor:
            sparse, values = accessor["sparse"], values.copy()
            own = np.dtype(_TYPES[sparse["indices"]["componentType"]])
            places = self._array(sparse["indices"], sparse["count"], 1, own)[:, 0].astype(np.int64)
            if (np.diff(places) <= 0).any() or places[-1] >= count:
                raise ValueError("indices of a sparse accessor do not rise, or leave it")
            values[places] = self._array(sparse["values"], sparse["count"], width, kind)
        return values

    def _array(self, part: Mapping, count: int, width: int, kind: np.dtype) -> np.ndarray:
        view = self.all("bufferViews")[part["bufferView"]]
        start = view.get("byteOffset", 0) + part.get("byteOffset", 0)
        strides = (view.get("byteStride", kind.itemsize * width), kind.itemsize)
        return np.ndarray((count, width), kind, self.binary, start, strides)

    def of(self, where: str, index: object) -> tuple[list[str], Mapping, np.ndarray | None]:
        """What is wrong with a reference to an accessor, the accessor, its values; None where those are at fault."""
        if absent := self.missing(where, "accessors", index):
            return absent, {}, None
        return [], self.all("accessors")[index], self.values.get(index)

    # ------------------------------------------------------------------ looks

    def _images(self) -> Iterator[str]:
        for place, image in enumerate(self.all("images")):
            where = f"/images/{place}"
            if "bufferView" not in image:
                yield f"{where}: lies outside of the file"
                continue
            if absent := self.missing(where, "bufferViews", image["bufferView"]):
                yield from absent
                continue
            view = self.all("bufferViews")[image["bufferView"]]
            start = view.get("byteOffset", 0)
            magic = _MAGIC.get(image.get("mimeType"))
            if magic is None or not self.binary[start:start + view["byteLength"]].startswith(magic):
                yield f"{where}: {image.get('mimeType', 'no type')} stated, its first bytes say otherwise"
        for place, texture in enumerate(self.all("textures")):
            yield from self.missing(f"/textures/{place}/source", "images", texture.get("source"))
            if "sampler" in texture:
                yield from self.missing(f"/textures/{place}/sampler", "samplers", texture["sampler"])

        for place, sampler in enumerate(self.all("samplers")):
            for name, known in _SAMPLING.items():
                if sampler.get(name, known[0]) not in known:
                    yield f"/samplers/{place}/{name}: {sampler[name]}, not among those of glTF"

    def _materials(self) -> Iterator[str]:
        for place, material in enumerate(self.all("materials")):
            where = f"/materials/{place}"
            for name, texture in _texture_references(material):
                yield from self.missing(f"{where}/{name}", "textures", texture.get("index"))
            surface, extensions = material.get("pbrMetallicRoughness", {}), material.get("extensions", {})
            specular = extensions.get("KHR_materials_specular", {})
            factors = {name: surface[name] for name in ("metallicFactor", "roughnessFactor", "baseColorFactor")
                       if name in surface}
            factors |= {"specularFactor": specular.get("specularFactor", 1.0)}
            for name, value in factors.items():
                if not (np.isfinite(value).all() and np.min(value) >= 0.0 and np.max(value) <= 1.0):
                    yield f"{where}/{name}: {value}, expected 0 to 1"
            mode, cutoff = material.get("alphaMode", "OPAQUE"), material.get("alphaCutoff", 0.5)
            if mode not in _ALPHA_MODES or ("alphaCutoff" in material and mode != "MASK") or not cutoff >= 0.0:
                yield f"{where}/alphaMode: {mode} with a cutoff of {cutoff}, which is none or not for it"
            if np.min(specular.get("specularColorFactor", 0.0)) < 0.0:
                yield f"{where}/specularColorFactor: {specular['specularColorFactor']}, expected 0 or more"
            ior = extensions.get("KHR_materials_ior", {}).get("ior", 1.5)
            if ior != 0.0 and ior < 1.0:
                yield f"{where}/ior: {ior}, expected 1 or more"

    # ------------------------------------------------------------------ shape

    def _mesh(self, where: str, mesh: Mapping) -> Iterator[str]:
        counts = {len(primitive.get("targets", ())) for primitive in mesh["primitives"]}
        if len(counts) != 1:
            yield f"{where}: its primitives have {sorted(counts)} morph targets, expected the same number"
            return
        targets = counts.pop()
        names = mesh.get("extras", {}).get("targetNames")
        if names is not None and (len(names) != targets or len(set(names)) != targets):
            yield f"{where}/extras/targetNames: {len(set(names))} different names of {targets} morph targets"
        if len(mesh.get("weights", [0] * targets)) != targets:
            yield f"{where}/weights: {len(mesh['weights'])} of {targets} morph targets"
        for k, primitive in enumerate(mesh["primitives"]):
            yield from self._primitive(f"{where}/primitives/{k}", primitive)

    def _primitive(self, where: str, primitive: Mapping) -> Iterator[str]:
        attributes = primitive["attributes"]
        if "POSITION" not in attributes:
            yield f"{where}: no POSITION"
            return
        count = None
        for name, index in attributes.items():
            own = f"{where}/{name}"
            wrong, accessor, values = self.of(own, index)
            yield from wrong
            if wrong:
                continue
            kind = _ATTRIBUTES.get(name.partition("_")[0])
            if kind is not None and accessor["type"] != kind:
                yield f"{own}: {accessor['type']}, expected {kind}"
                continue
            yield from _attribute_errors(own, name, accessor, values)
            count = accessor["count"] if count is None else count
            if accessor["count"] != count:
                yield f"{own}: {accessor['count']} values of {count} vertices"
        yield from self._faces(where, primitive, count)
        if "material" in primitive:
            yield from self._uses(where, primitive)
        for k, target in enumerate(primitive.get("targets", ())):
            yield from self._target(f"{where}/targets/{k}", target, attributes, count)

    def _faces(self, where: str, primitive: Mapping, count: int | None) -> Iterator[str]:
        corners = count
        if "indices" in primitive:
            wrong, accessor, values = self.of(f"{where}/indices", primitive["indices"])
            yield from wrong
            if values is None:
                return
            if accessor["type"] != "SCALAR" or accessor["componentType"] not in _INDEX_TYPES:
                yield f"{where}/indices: not unsigned integers"
            elif count is not None and values.max() >= count:
                yield f"{where}/indices: up to {values.max()}, there are {count} vertices"
            corners = accessor["count"]
        if primitive.get("mode", _TRIANGLES) != _TRIANGLES or (corners or 0) % 3:
            yield f"{where}: {corners} corners in mode {primitive.get('mode', _TRIANGLES)}, expected whole triangles"

    def _uses(self, where: str, primitive: Mapping) -> Iterator[str]:
        """The material, and whether the texture coordinates and tangents that it reads are there."""
        if absent := self.missing(f"{where}/material", "materials", primitive["material"]):
            yield from absent
            return
        for name, texture in _texture_references(self.all("materials")[primitive["material"]]):
            coordinates = f"TEXCOORD_{texture.get('texCoord', 0)}"
            if coordinates not in primitive["attributes"]:
                yield f"{where}: no {coordinates}, which its material's {name} reads"
            if name == "normalTexture" and "TANGENT" not in primitive["attributes"]:
                yield f"{where}: no TANGENT, so that each program makes its own for its material's {name}"

    def _target(self, where: str, target: Mapping, attributes: Mapping, count: int | None) -> Iterator[str]:
        for name, index in target.items():
            own = f"{where}/{name}"
            if name in _MORPHED and name not in attributes:
                yield f"{own}: moves what the primitive does not have"
            wrong, accessor, _ = self.of(own, index)
            yield from wrong
            if wrong or name not in _MORPHED:
                continue
            if accessor["type"] != "VEC3" or accessor["count"] != count:
                yield f"{own}: {accessor['count']} {accessor['type']} of {count} vertices, expected VEC3"
            if name == "POSITION" and not {"min", "max"} <= accessor.keys():
                yield f"{own}: neither min nor max"

    # ------------------------------------------------------------------ scene

    def _nodes(self) -> Iterator[str]:
        nodes, parents = self.all("nodes"), {}
        for place, node in enumerate(nodes):
            where = f"/nodes/{place}"
            for key, kind in (("mesh", "meshes"), ("camera", "cameras"), ("skin", "skins")):
                if key in node:
                    yield from self.missing(f"{where}/{key}", kind, node[key])
            for child in node.get("children", ()):
                yield from self.missing(f"{where}/children", "nodes", child)
                if parents.setdefault(child, place) != place or child == place:
                    yield f"{where}/children: node {child} has two parents"
            for key, count in _PLACES.items():
                if key in node and np.shape(node[key]) != (count,):
                    yield f"{where}/{key}: {len(node[key])} numbers, expected {count}"
            if "rotation" in node and abs(np.linalg.norm(node["rotation"]) - 1.0) > _UNIT_TOLERANCE:
                yield f"{where}/rotation: no unit quaternion"
            if "matrix" in node and node.keys() & {"translation", "rotation", "scale"}:
                yield f"{where}: both a matrix and its parts"
        yield from _circles(len(nodes), parents)
        if "scene" in self.content:
            yield from self.missing("/scene", "scenes", self.content["scene"])
        for place, scene in enumerate(self.all("scenes")):
            for node in scene.get("nodes", ()):
                yield from self.missing(f"/scenes/{place}", "nodes", node)
                if node in parents:
                    yield f"/scenes/{place}: node {node} is no root"

    def _cameras(self) -> Iterator[str]:
        for place, camera in enumerate(self.all("cameras")):
            lens = camera.get("perspective", {})
            if camera["type"] != "perspective" or not 0.0 < lens["yfov"] < np.pi or not lens["znear"] > 0.0:
                yield f"/cameras/{place}: no lens: type {camera['type']}, field of view {lens.get('yfov')}"
            if not lens.get("aspectRatio", 1.0) > 0.0 or not lens.get("zfar", np.inf) > lens["znear"]:
                yield f"/cameras/{place}: aspect ratio or far plane out of range"

    def _animation(self, where: str, animation: Mapping) -> Iterator[str]:
        seen, samplers = set(), animation["samplers"]
        for k, channel in enumerate(animation["channels"]):
            own, target = f"{where}/channels/{k}", channel["target"]
            if not 0 <= channel["sampler"] < len(samplers) or target["path"] not in _PATHS:
                yield f"{own}: sampler {channel['sampler']} of {len(samplers)}, path {target['path']}"
                continue
            yield from self.missing(own, "nodes", target.get("node"))
            if (target.get("node"), target["path"]) in seen:
                yield f"{own}: the same node's {target['path']} a second time"
            seen.add((target.get("node"), target["path"]))
            yield from self._track(f"{where}/samplers/{channel['sampler']}", samplers[channel["sampler"]], target)

    def _track(self, where: str, sampler: Mapping, target: Mapping) -> Iterator[str]:
        wrong, clock, times = self.of(f"{where}/input", sampler["input"])
        more, output, values = self.of(f"{where}/output", sampler["output"])
        yield from (*wrong, *more)
        if times is None or values is None:
            return
        if clock["type"] != "SCALAR" or clock["componentType"] != _FLOAT or not {"min", "max"} <= clock.keys():
            yield f"{where}/input: no times in seconds with their min and max"
        elif times[0, 0] < 0.0 or (np.diff(times[:, 0]) <= 0.0).any():
            yield f"{where}/input: times do not rise strictly from 0 or later"
        path, interpolation = target["path"], sampler.get("interpolation", "LINEAR")
        if interpolation not in _INTERPOLATIONS:
            yield f"{where}/interpolation: {interpolation}, not among those of glTF"
        spline = interpolation == "CUBICSPLINE"
        width = self._weights_of(target.get("node")) if path == "weights" else 1
        expected = len(times) * width * (3 if spline else 1)
        if output["type"] != _PATHS[path] or output["count"] != expected:
            yield (f"{where}/output: {output['count']} {output['type']}, expected {expected} {_PATHS[path]} "
                   f"for {len(times)} times of {path}")
        elif path == "rotation" and not spline and output["componentType"] == _FLOAT:
            yield from _unit_errors(f"{where}/output", values, "quaternions")

    def _weights_of(self, node: object) -> int:
        """How many morph targets the node's mesh has."""
        mesh = self.all("meshes")[self.all("nodes")[node]["mesh"]]
        return len(mesh["primitives"][0].get("targets", ()))

    def _extensions(self) -> Iterator[str]:
        used, stated = set(_extension_names(self.content)), set(self.all("extensionsUsed"))
        if used - stated:
            yield f"/extensionsUsed: does not name {', '.join(sorted(used - stated))}"
        if set(self.all("extensionsRequired")) - stated:
            yield "/extensionsRequired: names what /extensionsUsed does not"


def _number_errors(where: str, accessor: Mapping, values: np.ndarray) -> Iterator[str]:
    """Numbers are finite; bounds, where stated, are those of the numbers."""
    if not np.isfinite(values).all():
        yield f"{where}: {np.count_nonzero(~np.isfinite(values))} numbers are not finite"
        return
    for name, found in (("min", values.min(0)), ("max", values.max(0))):
        with np.errstate(over="ignore"):
            stated = np.array(accessor.get(name, found), np.float32)
        if not np.array_equal(stated, found.astype(np.float32)):
            yield f"{where}/{name}: {accessor[name]} stated, {found.tolist()} found"


def _attribute_errors(where: str, name: str, accessor: Mapping, values: np.ndarray | None) -> Iterator[str]:
    if name in _MORPHED and accessor["componentType"] != _FLOAT:
        yield f"{where}: not floats"
    if name == "POSITION" and not {"min", "max"} <= accessor.keys():
        yield f"{where}: neither min nor max"
    if values is None or name not in ("NORMAL", "TANGENT"):
        return
    yield from _unit_errors(where, values[:, :3], "vectors")
    if name == "TANGENT" and (np.abs(values[:, 3]) != 1.0).any():
        yield f"{where}: handedness is not 1 or -1"


def _unit_errors(where: str, vectors: np.ndarray, what: str) -> Iterator[str]:
    """vectors [N, C], or quaternions, of length 1."""
    off = np.abs(np.linalg.norm(vectors.astype(np.float64), axis=1) - 1.0)
    if not off.max() <= _UNIT_TOLERANCE:
        yield f"{where}: {np.count_nonzero(~(off <= _UNIT_TOLERANCE))} of {len(off)} are no unit {what}"


def _texture_references(part: Mapping, name: str = "") -> Iterator[tuple[str, Mapping]]:
    """(name, reference) of every texture that a material or its extensions read."""
    for key, value in part.items():
        if key.endswith("Texture"):
            yield f"{name}{key}", value if isinstance(value, dict) else {}
        elif isinstance(value, dict):
            yield from _texture_references(value, f"{name}{key}/")


def _extension_names(part: object) -> Iterator[str]:
    if isinstance(part, list):
        for item in part:
            yield from _extension_names(item)
    elif isinstance(part, dict):
        for key, value in part.items():
            if key == "extensions":
                yield from value
            if key != "extras":
                yield from _extension_names(value)


def _circles(count: int, parents: Mapping[int, int]) -> Iterator[str]:
    """A sentence for each node that is its own ancestor."""
    for node in range(count):
        at, steps = node, 0
        while at in parents and steps <= count:
            at, steps = parents[at], steps + 1
        if steps > count:
            yield f"/nodes/{node}: lies below itself"
