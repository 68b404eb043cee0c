"""Makes the page that estimates normals in a browser alone: a folder for any server.

    python tools/build_browser_page.py OUT [--weights NAME|FILE]
    python -m http.server -d OUT

Exports the network, and takes onnxruntime-web and fast-png from npm (`npm` must be
there), pinned: an archive whose hash is not the one below is refused. See
docs/browser.md.
"""

import argparse
import io
import shutil
import tarfile
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import NamedTuple

import numpy as np
from packages import fetch

from unips_jax.console import command
from unips_jax.errors import InputError
from unips_jax.export.files import write_export
from unips_jax.io.results import appearing_at_once, check_target
from unips_jax.viewer.page import page
from unips_jax.viewer.result import Result
from unips_jax.weights import load_weights

SOURCE = Path(__file__).parent / "browser"
RECORD = "network/export.json"


class Package(NamedTuple):
    """What is fetched.

    Attributes:
        name: in the registry.
        version: in the registry.
        sha512: of the archive.
        folder: in the archive, whose files are taken.
        files: names in it; all scripts if empty.
        source: where its licence, MIT, is to be read.
    """

    name: str
    version: str
    sha512: str
    folder: str
    files: tuple[str, ...] = ()
    source: str = ""


PACKAGES = (
    Package(
        "onnxruntime-web",
        "1.30.0",
        "ab4cbe26baedba45d2cec05610c71c55fa97db92d19a8b171c5f8269126683ca"
        "590a5cdc57bb2f35ce2b298de32f4d956fb42644c0ecd528a0a91e025c07ca61",
        "dist",
        (
            "ort.wasm.bundle.min.mjs",
            "ort-wasm-simd-threaded.mjs",
            "ort-wasm-simd-threaded.wasm",
        ),
        source="github.com/microsoft/onnxruntime",
    ),
    Package(
        "fast-png",
        "8.0.0",
        "802cac35ab09f0a10c81f75820a77fc130e8e8434ad4f593d1124eecefb4a609"
        "ae1cfc363bab40d56bddc45449a0b7fd57cc856291b4140d58808f17f7b3a124",
        "lib",
        source="github.com/image-js/fast-png",
    ),
    Package(
        "fflate",
        "0.8.3",
        "b5b64db89acbc06529df3b2106d772e16f8e47166e221f1ae629722044030b9a"
        "d8d5fdd4db424caf2d0b977581cd4e7c1192ac12e2455e16f9830bfc0ac3ef80",
        "esm",
        ("browser.js",),
        source="github.com/101arrowz/fflate",
    ),
    Package(
        "iobuffer",
        "6.0.1",
        "49959891635f8c85c8058483a570d8220b21aad6ce3ec8b896f89ac0011c791d"
        "4aaa4fac1c395c4235abccd42c8a2f34032058d2ae5cf07093363aa8ef8ba5f9",
        "lib",
        source="github.com/image-js/iobuffer",
    ),
)


def unpack(package: Package, archive: bytes, target: Path) -> None:
    """Writes the package's scripts and its licence.

    Args:
        package: what is wanted.
        archive: from `fetch`.
        target: folder.

    Raises:
        InputError: if a file is missing.
    """
    wanted = set(package.files)
    inside = f"package/{package.folder}/"
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        for member in tar.getmembers():
            name = member.name.removeprefix(inside)
            script = member.name.startswith(inside) and name.endswith(".js")
            if member.name.upper() == "PACKAGE/LICENSE":
                name = "LICENSE"
            elif not (name in wanted or (script and not package.files)):
                continue
            file = tar.extractfile(member)
            if file is not None:
                wanted.discard(name)
                (target / name).parent.mkdir(parents=True, exist_ok=True)
                (target / name).write_bytes(file.read())
    if wanted:
        raise InputError(f"{package.name}: expected {min(wanted)}, found none")


def viewer_template() -> str:
    """The viewer's page of a tiny result, called TITLE: the page puts its own in."""
    normals = np.zeros((3, 3, 3), np.float32)
    normals[1, 1] = 0, 0, 1
    return page(Result("TITLE", normals))


@command
def main(argv: Sequence[str] | None = None) -> None:
    """Builds the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("output", metavar="OUT", type=Path, help="folder of the page")
    parser.add_argument("--weights", default="tiny", help="shipped name or file (tiny)")
    arguments = parser.parse_args(argv)
    check_target(arguments.output, SOURCE, record=RECORD)
    network = load_weights(arguments.weights)
    archives = {
        package: fetch(f"{package.name}@{package.version}", package.sha512)
        for package in PACKAGES
    }
    with appearing_at_once(arguments.output, record=RECORD) as place:
        shutil.copytree(SOURCE, place, dirs_exist_ok=True)
        for package, archive in archives.items():
            unpack(package, archive, place / "vendor" / package.name)
        (place / "vendor" / "LICENSES.md").write_text(
            "What is here, unchanged, under the MIT licence:\n\n"
            + "".join(f"- {p.name} {p.version}, https://{p.source}\n" for p in PACKAGES)
            + "\n`network/mask.onnx` is U2-Net's small version (Apache-2.0), "
            "https://github.com/xuebinqin/U-2-Net, trained on DUTS.\n"
        )
        write_export(
            place / "network",
            network,
            format="onnx",
            name=Path(arguments.weights).stem,
            half=True,
            decoder_views=1,
        )
        mask = resources.files("unips_jax") / "assets" / "salient_object.onnx"
        (place / "network" / "mask.onnx").write_bytes(mask.read_bytes())
        (place / "viewer.html").write_text(viewer_template(), "utf-8")
        size = sum(file.stat().st_size for file in place.rglob("*") if file.is_file())
    print(f"wrote {arguments.output}/: {size / 1e6:.0f} MB")


if __name__ == "__main__":
    raise SystemExit(main())
