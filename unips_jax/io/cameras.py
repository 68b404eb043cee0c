"""Cameras of several views: SfMData read and written, IDR's cameras.npz written.

A camera takes a point X of the world to the pixel K R (X - C), with x right, y down and
z away from the viewer; (0, 0) and (width, height) are the image's corners. In SfMData
(AliceVision's JSON, versions 1.0 to 1.2.1) `rotation` holds R column by column, and
`principalPoint` is a place, or in 1.2 an offset from the image's middle.
"""

import copy
import dataclasses
import itertools
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.masks import mask_box

_ADVICE = "export what StructureFromMotion gives"


@dataclasses.dataclass(frozen=True)
class Camera:
    """One pose of an SfMData file, with its camera.

    `photographs` are the files of all its views, `view` the number of the first; `size`
    is width and height; `matrix` (K) is `[3, 3]`, `rotation` (R) `[3, 3]`, `center` (C)
    `[3]`. `distorted`: the file gives distortions, which K leaves out.
    """

    pose: str
    view: str
    photographs: tuple[str, ...]
    size: tuple[int, int]
    matrix: np.ndarray
    rotation: np.ndarray
    center: np.ndarray
    distorted: bool

    def scaled(self, size: tuple[int, int]) -> np.ndarray:
        """K for pictures of another size (width, height)."""
        factors = np.array([*np.divide(size, self.size), 1.0])
        return factors[:, None] * self.matrix

    def projection(self, size: tuple[int, int]) -> np.ndarray:
        """K [R | -R C], `[3, 4]`, for pictures of a size."""
        motion = np.column_stack([self.rotation, -self.rotation @ self.center])
        return self.scaled(size) @ motion


def read_sfm_data(file: Path) -> tuple[list[Camera], dict[str, Any]]:
    """The cameras of an SfMData file, at least one, sorted by pose; and its content."""
    try:
        content = json.loads(file.read_text("utf-8"))
        cameras = _cameras(content, file.resolve().parent)
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror}") from None
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{file}: expected SfMData with views, intrinsics and poses, got "
            f"{type(error).__name__} at {error}; {_ADVICE}"
        ) from None
    if not cameras:
        raise InputError(f"{file}: expected poses, got none; {_ADVICE}")
    return cameras, content


def _cameras(content: dict[str, Any], folder: Path) -> list[Camera]:
    intrinsics = {item["intrinsicId"]: item for item in content["intrinsics"]}
    version = [int(part) for part in content.get("version", ())]
    views: dict[str, list[dict[str, Any]]] = {}
    for view in content["views"]:
        views.setdefault(str(view["poseId"]), []).append(view)
    cameras = []
    for item in content.get("poses", []):
        pose = str(item["poseId"])
        if pose not in views:
            continue
        if len({str(view.get("subPoseId", "")) for view in views[pose]}) > 1:
            raise InputError(
                f"expected one camera a pose, got several of a rig in pose {pose}; "
                "give each its own poses: import the photographs without a rig"
            )
        lens = intrinsics[views[pose][0]["intrinsicId"]]
        transform = item["pose"]["transform"]
        rotation = np.array(transform["rotation"], float).reshape(3, 3).T
        paths = (os.path.join(folder, view["path"]) for view in views[pose])
        size = (int(lens["width"]), int(lens["height"]))
        cameras.append(
            Camera(
                pose,
                str(views[pose][0]["viewId"]),
                tuple(os.path.realpath(path) for path in paths),
                size,
                _matrix(lens, size, version >= [1, 2, 1]),
                rotation,
                np.array(transform["center"], float),
                any(float(value) for value in lens.get("distortionParams", ())),
            )
        )
    return sorted(cameras, key=lambda camera: (len(camera.pose), camera.pose))


def _matrix(
    lens: dict[str, Any], size: tuple[int, int], from_middle: bool
) -> np.ndarray:
    """K; files of a focal length in pixels state the point so since version 1.2.1."""
    point = np.array(lens["principalPoint"], float)
    if "pxFocalLength" in lens:
        focal = np.array(lens["pxFocalLength"], float).ravel()
        if from_middle:
            point = point + np.array(size) / 2
    else:
        millimetre = size[0] / float(lens["sensorWidth"])
        focal = np.array([float(lens["focalLength"]) * millimetre])
        ratio = float(lens.get("pixelRatio", 1))
        if abs(ratio - 1) > 1e-4:  # its meaning changed between file versions
            raise InputError(
                f"expected lenses of pixelRatio 1, got {ratio:g}; leave Pixel Ratio 1 "
                "and locked in CameraInit"
            )
        point = point + np.array(size) / 2
    matrix = np.diag([focal[0], focal[-1], 1.0])
    matrix[:2, 2] = point
    return matrix


def sfm_data_of(
    content: dict[str, Any],
    cameras: Sequence[Camera],
    files: Sequence[str],
    sizes: Sequence[tuple[int, int]],
) -> dict[str, Any]:
    """SfMData with one view for each camera: its file, of a size (width, height).

    Intrinsics are scaled; left out are those of other views, and observations of
    points, which belong to the photographs.
    """
    lenses: dict[tuple[str, tuple[int, int]], dict[str, Any]] = {}
    views = []
    by_number = {str(view["viewId"]): view for view in content["views"]}
    originals = {str(item["intrinsicId"]): item for item in content["intrinsics"]}
    for camera, file, size in zip(cameras, files, sizes, strict=True):
        view = dict(by_number[camera.view], path=file, metadata={})
        key = (str(view["intrinsicId"]), size)
        if key not in lenses:
            lens = _scaled_lens(originals[key[0]], camera.size, size)
            if any(number == key[0] for number, _ in lenses):  # the same, another size
                taken = {*originals, *(x["intrinsicId"] for x in lenses.values())}
                numbers = map(str, itertools.count(int(key[0]) + 1))
                lens["intrinsicId"] = next(n for n in numbers if n not in taken)
            lenses[key] = lens
        number = lenses[key]["intrinsicId"]
        view |= {"intrinsicId": number, "width": str(size[0]), "height": str(size[1])}
        views.append(view)
    kept = {camera.pose for camera in cameras}
    return {
        "version": content.get("version", ["1", "2", "0"]),
        "views": views,
        "intrinsics": list(lenses.values()),
        "poses": [item for item in content["poses"] if str(item["poseId"]) in kept],
    }


def _scaled_lens(
    lens: dict[str, Any], size: tuple[int, int], new: tuple[int, int]
) -> dict[str, Any]:
    scaled = copy.deepcopy(lens)
    factors = np.divide(new, size)
    scaled["width"], scaled["height"] = (str(length) for length in new)
    point = np.array(lens["principalPoint"], float) * factors
    scaled["principalPoint"] = [str(value) for value in point]
    for name in ("pxFocalLength", "pxInitialFocalLength"):
        if name in lens:
            focal = np.array(lens[name], float) * factors[0]
            scaled[name] = focal.tolist() if focal.ndim else str(focal)
    return scaled


def enclosing_sphere(
    cameras: Sequence[Camera], masks: Sequence[np.ndarray]
) -> tuple[np.ndarray, float]:
    """A sphere around the object, from where masks `[H, W]` see it: middle, radius.

    Its middle is closest to the rays through the middles of the masks' boxes; in every
    view it covers the mask. `InputError` where all views look along one line.
    """
    rays = []
    for camera, mask in zip(cameras, masks, strict=True):
        rows, columns = mask_box(mask)
        middle = [(columns.start + columns.stop) / 2, (rows.start + rows.stop) / 2]
        rays.append(_rays(camera, mask.shape, np.array([middle]))[0])
    across = np.eye(3) - np.einsum("ni,nj->nij", rays, rays)
    system = across.sum(axis=0)
    if np.linalg.cond(system) > 1e4:
        raise InputError(
            f"expected views from different sides, got {len(cameras)} that look along "
            "one line; give the results of more poses"
        )
    origins = np.stack([camera.center for camera in cameras])
    center = np.linalg.solve(system, np.einsum("nij,nj->i", across, origins))
    radius = 0.0
    for camera, mask in zip(cameras, masks, strict=True):
        towards = center - camera.center
        distance = float(np.linalg.norm(towards))
        places = np.argwhere(mask)[:, ::-1] + 0.5
        cosine = (_rays(camera, mask.shape, places) @ towards).min() / distance
        radius = max(radius, distance * np.tan(np.arccos(min(cosine, 1.0))))
    return center, radius


def _rays(camera: Camera, shape: tuple[int, ...], places: np.ndarray) -> np.ndarray:
    """Unit directions of the world to places `[K, 2]` (x, y) of a picture."""
    ends = np.column_stack([places, np.ones(len(places))])
    matrix = camera.scaled((shape[1], shape[0]))
    rays = ends @ np.linalg.inv(matrix).T @ camera.rotation
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def idr_cameras(
    cameras: Sequence[Camera],
    sizes: Sequence[tuple[int, int]],
    center: np.ndarray,
    radius: float,
) -> dict[str, np.ndarray]:
    """Arrays of a `cameras.npz`, `[4, 4]`.

    `world_mat_i` takes points of the world to pixels, `scale_mat_i` the unit sphere to
    the one around the object. Source: https://github.com/lioryariv/idr,
    DATA_CONVENTION.md.
    """
    scale = np.diag([radius, radius, radius, 1.0])
    scale[:3, 3] = center
    arrays = {}
    for index, (camera, size) in enumerate(zip(cameras, sizes, strict=True)):
        world = np.vstack([camera.projection(size), [0, 0, 0, 1]])
        arrays[f"world_mat_{index}"] = world
        arrays[f"scale_mat_{index}"] = scale
    return arrays
