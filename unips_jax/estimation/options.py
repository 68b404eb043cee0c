"""The options of `estimate_folder`."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Literal

import tyro

from unips_jax.errors import InputError
from unips_jax.io.images import MAX_PIXELS
from unips_jax.io.normals import NormalMap
from unips_jax.surface.mesh import check_mesh_file
from unips_jax.surface.outputs import MeshFormat, focal_of


@dataclasses.dataclass(frozen=True)
class FolderOptions:
    """How photographs are read, and what is written.

    Attributes:
        mask: an image that is bright on the object, in place of the folder's mask;
            auto: the folder's, else what is found, else the whole image; none: the
            whole image.
        include: patterns such as "img_*.png": the images they fit are the photographs,
            whatever they are called.
        exclude: patterns of files to leave out.
        max_pixels: refuse larger images; all photographs of a folder together may have
            ten times as many.
        max_images: use no more of the photographs than this, drawn with the seed.
        seed: of that draw.
        fast: in 60 to 70 % of the time; the mirrored view is decoded at few pixels, and
            docs/results.md has the price in degrees.
        transfer: how the photographs encode light (auto: by their colour tags; without
            any, 8 bit is srgb and the rest linear).
        dark: a photograph without the lamp, in the folder or elsewhere, whose light is
            subtracted from the others.
        register: bring photographs that moved back to the others' place.
        known_lights: lights that are known: a list of directions (.lp), by the
            photographs' names, or by hand, such as "3: upper left" or
            "photo.jpg: right"; others stay unknown.
        reader: official: the authors' square crop and resize, and all files linear;
            the results have that size.
        size: side in pixels that the official reader resizes to; 512 if not given.
        exr: also write normals.exr.
        mat: also write normals.mat, for MATLAB, key Normal_est.
        normal_map: green of PNG and EXR is up (opengl) or down (directx), down and blue
            away from the viewer (opencv), or red to the left (x-left).
        depth: also write depth.exr, depth.png and height.png; see `unips surface`.
        mesh: also write a mesh, and the depth.
        lights: also write each photograph's light, lights.json and lights.lp.
        base_color: also write base_color.exr and base_color.png, the albedo.
        rti: also write a polynomial texture map, relight.ptm, and for web pages
            info.json and plane_*.jpg.
        lights_from: for these three, the lights of an earlier capture by the same
            lamps, a result with lights.json, or a list of directions (.lp), in place of
            estimated ones; by the photographs' names, or in their order.
        lamp_distance: for the same, how far the lamps are from the photographs' middle,
            in widths of a photograph; lamps nearer than ten light the object unevenly.
        confidence: also write how far normals spread over halves of the photographs,
            confidence.exr and .png, and unreliable.png, a mask; triples the time.
        all: write all of these, the depth, a mesh (GLB) and view.html.
        view: also write view.html, to look at in a browser; see `unips view`.
        focal: focal length of the depth's camera in pixels, or exif, of the first
            photograph; without it the camera is orthographic.
    """

    mask: Annotated[
        Literal["auto", "none"] | Path, tyro.conf.arg(metavar="auto|none|FILE")
    ] = "auto"
    include: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    max_pixels: int = MAX_PIXELS
    max_images: int | None = None
    seed: int = 0
    fast: bool = False
    transfer: Literal["auto", "linear", "srgb"] = "auto"
    dark: Path | None = None
    register: bool = False
    known_lights: Annotated[
        tuple[str, ...], tyro.conf.arg(metavar='FILE.lp|"NAME: WHERE"')
    ] = ()
    reader: Literal["plain", "official"] = "plain"
    size: int | None = None
    exr: bool = False
    mat: bool = False
    normal_map: NormalMap = "opengl"
    depth: bool = False
    mesh: MeshFormat | None = None
    lights: bool = False
    base_color: bool = False
    rti: bool = False
    lights_from: Annotated[Path | None, tyro.conf.arg(metavar="RESULT|FILE.lp")] = None
    lamp_distance: float | None = None
    confidence: bool = False
    all: bool = False
    view: bool = False
    focal: str | None = None

    @property
    def frame(self) -> Literal["image", "mask"]:
        """What the encoder's square surrounds."""
        return "image" if self.reader == "official" else "mask"

    @property
    def looks_for_mask(self) -> bool:
        """Whether the object is looked for where there is no mask."""
        return self.mask == "auto" and self.reader == "plain"

    def spelled_out(self) -> "FolderOptions":
        """The same options with what `all` stands for."""
        if not self.all:
            return self
        return dataclasses.replace(
            self,
            all=False,
            depth=True,
            mesh=self.mesh or "glb",
            lights=True,
            base_color=True,
            rti=True,
            confidence=True,
            view=True,
        )

    def check(self) -> None:
        """Checks what the types do not; an `InputError` names the option."""
        lowest = {"max_images": 1, "max_pixels": 1, "seed": 0, "size": 1}
        for name, least in lowest.items():
            value = getattr(self, name)
            if value is not None and value < least:
                option = name.replace("_", "-")
                raise InputError(f"--{option}: expected {least} or more, got {value}")
        if self.reader == "official" and self.transfer == "srgb":
            raise InputError(
                "--transfer srgb: the authors' reader takes every file as linear; "
                "leave out --reader official"
            )
        if self.reader != "official" and self.size is not None:
            raise InputError(
                f"--size {self.size}: results have the photographs' size; leave it "
                "out, or add --reader official"
            )
        distance = self.lamp_distance
        if distance is not None and not 0 < distance < math.inf:
            raise InputError(
                f"--lamp-distance: expected widths of a photograph, got {distance}"
            )
        for option in ("lights_from", "lamp_distance"):
            used = self.all or self.lights or self.base_color or self.rti
            if getattr(self, option) is not None and not used:
                raise InputError(
                    f"--{option.replace('_', '-')}: expected something to use it for, "
                    "got none; add --base-color, --rti or --lights"
                )
        for option in ("register", "dark", "lamp_distance"):
            if self.reader == "official" and getattr(self, option):
                raise InputError(
                    f"--{option.replace('_', '-')}: the authors' reader takes "
                    "photographs as they are, and resizes them; leave out --reader "
                    "official"
                )
        self._check_surface()

    def _check_surface(self) -> None:
        if self.mesh is not None:
            check_mesh_file(Path(f"mesh.{self.mesh}"))
        if self.focal is None:
            return
        if not (self.all or self.depth or self.mesh):
            raise InputError(
                "--focal: expected a depth to use it for, got none; add --depth"
            )
        if self.reader == "official":
            raise InputError(
                "--focal: the authors' reader resizes the photographs; leave out "
                "--reader official"
            )
        if self.focal != "exif":
            focal_of(self.focal, None, None)
