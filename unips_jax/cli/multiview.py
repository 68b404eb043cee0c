"""Results of several views of an object, as programs for whole objects read them.

RESULTS are folders that `unips estimate` wrote, one for each place of the camera. Where
the camera was is in SfMData (.sfm, .json) of AliceVision or Meshroom, whose views of a
pose are its photographs. OUT receives normal/000.png (16 bits), mask/000.png,
albedo/000.png if all results have a base colour, and cameras.npz as IDR describes it,
for RNb-NeuS2 and the like; normals.sfm, masks.sfm and albedos.sfm for Meshroom.
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from unips_jax.console import command, expanded, parse
from unips_jax.errors import InputError
from unips_jax.io.cameras import (
    Camera,
    enclosing_sphere,
    idr_cameras,
    read_sfm_data,
    sfm_data_of,
)
from unips_jax.io.door import new_file, write_json, write_whole
from unips_jax.io.formats.raster import marked_srgb
from unips_jax.io.images import (
    encode_image,
    image_header,
    read_bytes,
    read_image,
    write_image,
)
from unips_jax.io.normal_maps import read_normal_map
from unips_jax.io.normals import encode_normals
from unips_jax.io.orientation import normals_as_stored, turned_back
from unips_jax.io.record import print_line
from unips_jax.io.record_schema import load_record
from unips_jax.io.results import (
    RECORD,
    appearing_at_once,
    check_target,
    file_hash,
    whole_record,
)

FOLDER_RECORD = "views.json"


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `unips multiview`.

    Attributes:
        results: folders that `unips estimate` wrote, a pose each.
        sfm: SfMData with the poses.
        output: folder for the files.
    """

    results: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="RESULTS...", help_behavior_hint=""),
    ]
    sfm: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]


@command
def main(argv: Sequence[str] | None = None) -> None:
    """`unips multiview`."""
    options = parse(Options, argv, prog="unips multiview", description=__doc__)
    if not options.results:
        raise InputError("expected folders of results, a pose each, got none")
    cameras, content = read_sfm_data(options.sfm)
    found: dict[str, tuple[Camera, Path]] = {}
    for folder in expanded(options.results):
        check_target(options.output, folder, record=FOLDER_RECORD)
        camera = _camera_of(folder, cameras, options.sfm)
        if camera.pose in found:
            raise InputError(
                f"{folder}: expected the results of another pose, got {camera.pose} "
                f"again, which {found[camera.pose][1]} is of; leave one out"
            )
        found[camera.pose] = camera, folder
    pairs = sorted(found.values(), key=lambda pair: cameras.index(pair[0]))
    if any(camera.distorted for camera, _ in pairs):
        print(
            f"warning: {options.sfm}: its lenses distort, cameras.npz cannot say so; "
            "estimate from photographs without distortion (Meshroom: ExportImages)",
            file=sys.stderr,
        )
    ours = "normal mask albedo normals.sfm masks.sfm albedos.sfm".split()
    with appearing_at_once(options.output, record=FOLDER_RECORD, ours=ours) as place:
        radius = _write(place, options.output, pairs, content)
    print_line("wrote", f"{options.output}: {len(pairs)} views, radius {radius:.4g}")


def _camera_of(folder: Path, cameras: list[Camera], sfm: Path) -> Camera:
    """The pose whose photographs these are, else that of the folder's name."""
    record = whole_record(folder)
    if record.get("options", {}).get("reader") == "official":
        raise InputError(
            f"{folder}: expected normals of the whole photographs, got those of a "
            "square crop (--reader official); estimate without it"
        )
    source = Path(record["folder"])
    files = {str((source / name).resolve()) for name in record["images"]}
    for camera in cameras:
        if files & set(camera.photographs):
            return camera
    for camera in cameras:
        if camera.pose == folder.resolve().name:
            return camera
    raise InputError(
        f"{folder}: expected photographs of a pose of {sfm}, got those of {source}; "
        "estimate from the files that it lists, or name the folder as the pose"
    )


def _orientation(camera: Camera, folder: Path) -> int:
    """How EXIF turned the photographs: cameras are those of the pictures as stored."""
    record = load_record(folder / RECORD)
    if "orientation" in record:
        return record["orientation"]
    own = Path(record["folder"]) / next(iter(record["images"]))
    for path in (own, *map(Path, camera.photographs)):
        if path.is_file():
            header = image_header(read_bytes(path), path)
            return 1 if header.format == "HEIC" else header.orientation
    print(
        f"warning: {folder}: none of its photographs is there to tell how EXIF turned "
        "them; they are taken as not turned",
        file=sys.stderr,
    )
    return 1


def _size(camera: Camera, folder: Path, mask: np.ndarray) -> tuple[int, int]:
    """Width and height of a result, of the shape that the camera has."""
    (height, width), (across, down) = mask.shape, camera.size
    if abs(width * down - height * across) > max(across, down):
        raise InputError(
            f"{folder}: expected normals of the shape of pose {camera.pose}, {across} "
            f"x {down}, got {width} x {height}; estimate from the files that it lists"
        )
    return width, height


def _write(
    place: Path, target: Path, pairs: list[tuple[Camera, Path]], content: dict[str, Any]
) -> float:
    cameras = [camera for camera, _ in pairs]
    colors = all((folder / "base_color.png").is_file() for _, folder in pairs)
    kinds = ["normal", "mask", *(["albedo"] if colors else [])]
    masks, sizes = [], []
    for index, (camera, folder) in enumerate(pairs):
        turn = _orientation(camera, folder)
        normals = normals_as_stored(read_normal_map(folder).normals, turn)
        mask = (normals != 0).any(axis=-1)
        masks.append(mask)
        sizes.append(_size(camera, folder, mask))
        name = f"{index:03}.png"
        write_image(place / "normal" / name, encode_normals(normals))
        write_image(place / "mask" / name, mask.astype(np.uint8) * 255)
        if colors:
            color = turned_back(read_image(folder / "base_color.png"), turn)
            picture = marked_srgb(encode_image(".png", color))
            write_whole(place / "albedo" / name, picture, sync=False)
    center, radius = enclosing_sphere(cameras, masks)
    arrays: dict[str, Any] = dict(idr_cameras(cameras, sizes, center, radius))
    with new_file(place / "cameras.npz") as file:
        np.savez(file, **arrays)
    for kind in kinds:
        files = [
            str(target.resolve() / kind / f"{index:03}.png")
            for index in range(len(pairs))
        ]
        data = sfm_data_of(content, cameras, files, sizes)
        write_json(place / f"{kind}s.sfm", data, indent=1)
    record = {
        "views": [{"pose": c.pose, "result": str(f)} for c, f in pairs],
        "center": center.tolist(),
        "radius": radius,
        "files": {"cameras.npz": file_hash(place / "cameras.npz")},
    }
    write_json(place / FOLDER_RECORD, record, indent=1)
    return radius


if __name__ == "__main__":
    sys.exit(main())
