"""Triangle meshes as binary glTF 2.0 (`.glb`), with normals, colours and textures.

Colours of vertices are linear, of 16 bits: of 8 linear bits a dark photograph's 64
darkest levels would keep 14. Source: Khronos, "glTF 2.0 Specification" (2021), sections
3.6 (buffers), 3.7 (meshes), 3.9 (materials), 4 (GLB).
"""

import json
import struct
from typing import Any, NamedTuple

import numpy as np

_FLOAT, _UINT32, _UINT16 = 5126, 5125, 5123
_ARRAY, _ELEMENTS = 34962, 34963  # what a view of the buffer is for
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_MATT = {"metallicFactor": 0.0, "roughnessFactor": 0.9}


class GltfMesh(NamedTuple):
    """What is written; all but vertices and faces may be missing."""

    vertices: np.ndarray  # `[V, 3]`, metres, y up
    faces: np.ndarray  # `[F, 3]`, counter-clockwise from in front
    normals: np.ndarray | None = None  # `[V, 3]`, unit
    # `[V, 4]`, unit, towards growing u; the last component is the bitangent's sign
    tangents: np.ndarray | None = None
    # `[V, 2]`, texture coordinates, (0, 0) at the picture's upper left
    places: np.ndarray | None = None
    colors: np.ndarray | None = None  # `[V, 3]`, linear, in [0, 1]
    base_color: bytes | None = None  # a PNG or JPEG, sRGB
    normal_map: bytes | None = None  # a PNG, x right, y up, in the tangents' frame


def encode_glb(
    mesh: GltfMesh, *, name: str = "surface", facts: dict[str, Any] | None = None
) -> bytes:
    """The content of a `.glb` file, whose "extras" are the facts, JSON values."""
    buffer = _Buffer()
    attributes = {"POSITION": buffer.add(mesh.vertices, bounds=True)}
    for key, values in (
        ("NORMAL", mesh.normals),
        ("TANGENT", mesh.tangents),
        ("TEXCOORD_0", mesh.places),
    ):
        if values is not None:
            attributes[key] = buffer.add(values)
    if mesh.colors is not None:
        levels = np.full((len(mesh.colors), 4), 65535, np.uint16)
        levels[:, :3] = np.rint(65535 * np.clip(mesh.colors, 0, 1))
        attributes["COLOR_0"] = buffer.add(levels, kind=_UINT16, normalized=True)
    indices = buffer.add(np.ravel(mesh.faces)[:, None], kind=_UINT32, target=_ELEMENTS)
    material: dict[str, Any] = {
        "name": name,
        "doubleSided": True,  # a relief has a back that one may see
        "pbrMetallicRoughness": dict(_MATT),
    }
    images: list[dict[str, Any]] = []
    for picture, place, key in (
        (mesh.base_color, material["pbrMetallicRoughness"], "baseColorTexture"),
        (mesh.normal_map, material, "normalTexture"),
    ):
        if picture is not None:
            place[key] = {"index": len(images)}
            kind = "image/png" if picture.startswith(b"\x89PNG") else "image/jpeg"
            images.append({"bufferView": buffer.view(picture), "mimeType": kind})
    primitive = {"attributes": attributes, "indices": indices, "material": 0}
    content: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "unips_jax", "extras": facts or {}},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": name}],
        "meshes": [{"name": name, "primitives": [primitive]}],
        "materials": [material],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    if images:
        content["images"] = images
        content["samplers"] = [{"wrapS": 33071, "wrapT": 33071}]  # clamped
        content["textures"] = [
            {"source": index, "sampler": 0} for index in range(len(images))
        ]
    return _container(content, bytes(buffer.data))


class _Buffer:
    """The binary part, and what of it means what."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, target: int | None = None) -> int:
        self.views.append(
            {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        )
        if target is not None:
            self.views[-1]["target"] = target
        self.data += data + bytes(-len(data) % 4)
        return len(self.views) - 1

    def add(
        self,
        values: np.ndarray,
        *,
        kind: int = _FLOAT,
        target: int = _ARRAY,
        normalized: bool = False,
        bounds: bool = False,
    ) -> int:
        dtype = {_FLOAT: "<f4", _UINT32: "<u4", _UINT16: "<u2"}[kind]
        values = np.ascontiguousarray(values, dtype)
        accessor: dict[str, Any] = {
            "bufferView": self.view(values.tobytes(), target),
            "componentType": kind,
            "count": len(values),
            "type": _TYPES[values.shape[1]],
        }
        if normalized:
            accessor["normalized"] = True
        if bounds:
            accessor["min"] = values.min(0).tolist()
            accessor["max"] = values.max(0).tolist()
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def _container(content: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(content, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
