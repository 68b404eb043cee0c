"""Reads what `.glb` files hold, by the specification."""

import json
import struct

import numpy as np

_TYPES = {5126: "<f4", 5125: "<u4", 5123: "<u2"}
_COUNTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def read_glb(path):
    """The JSON part, and a function of an accessor's number."""
    data = path.read_bytes()
    magic, version, length = struct.unpack("<4sII", data[:12])
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack("<I4s", data[12:20])
    assert kind == b"JSON" and size % 4 == 0
    content, rest = json.loads(data[20 : 20 + size]), data[20 + size :]
    size, kind = struct.unpack("<I4s", rest[:8])
    assert kind == b"BIN\0" and size == len(rest) - 8
    binary = rest[8:]

    def view(index):
        found = content["bufferViews"][index]
        return binary[found["byteOffset"] :][: found["byteLength"]]

    def accessor(index):
        found = content["accessors"][index]
        values = np.frombuffer(
            view(found["bufferView"]), _TYPES[found["componentType"]]
        ).reshape(found["count"], _COUNTS[found["type"]])
        if found.get("normalized"):
            return values / np.iinfo(values.dtype).max
        return values

    content["view"] = view
    return content, accessor
