"""A Meshroom node: normals of every pose, by the command `unips estimate`.

Needs nothing but the standard library in Meshroom's Python; what computes is the
command, in an environment of its own.
"""

import json
import logging
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from meshroom.core import desc

# What a folder of photographs may hold besides.
MAPS = {"mask", "normal", "normals", "depth", "albedo"}
# As `unips estimate` knows them.
IMAGES = set(
    ".png .jpg .jpeg .jfif .tif .tiff .webp .bmp .exr .hdr .pgm .ppm .pnm .pbm .gif"
    " .tga .mpo .heic .heif .hif .avif .dng .cr2 .cr3 .crw .nef .nrw .arw .srf .sr2"
    " .raf .rw2 .rwl .orf .pef .srw .x3f .3fr .fff .iiq .mrw .kdc .dcr .erf .mef .mos"
    " .raw".split()
)


class UniPSNormals(desc.Node):
    """Normals from photographs of each pose under different, unknown light.

    A pose is a place of the camera: the views of an SfMData file that share a poseId,
    or a folder of photographs. Results have the photographs' size and are named
    POSE_normals.png (16 bits) and POSE_normals.exr. poses.json says how every pose
    went.

    Checked against Meshroom 2026.1.0 (development): its documents "Node Development"
    and "Plugins installation", and the signatures of `meshroom.core.desc`. Not yet run
    in Meshroom itself.
    """

    category = "Photometric Stereo"
    cpu = desc.Level.INTENSIVE
    gpu = desc.Level.NONE

    inputs = [
        desc.File(
            name="input",
            label="Input",
            description="SfMData file (.sfm, .json), or a folder that holds a folder "
            "of photographs for every pose.",
            value="",
        ),
        desc.File(
            name="maskFolder",
            label="Mask Folder",
            description="Masks named POSE.png, or as one of the pose's photographs; "
            "without one, the mask among the photographs is taken.",
            value="",
        ),
        desc.IntParam(
            name="maxImages",
            label="Max Images",
            description="Number of photographs of a pose, drawn with the seed; 0: all.",
            value=0,
            range=(0, 100, 1),
        ),
        desc.IntParam(
            name="seed",
            label="Seed",
            description="Of that draw: the same seed draws the same photographs.",
            value=0,
            range=(0, 1000000, 1),
        ),
        desc.ChoiceParam(
            name="outputFormat",
            label="Format",
            description="PNG of 16 bits, EXR of 32-bit floats, or both.",
            value="both",
            values=["png", "exr", "both"],
            exclusive=True,
        ),
        desc.ChoiceParam(
            name="convention",
            label="Convention",
            description="opengl: y up, z towards the viewer. opencv: y down, z away "
            "from the viewer, the frame of SfMData's cameras. directx: y down.",
            value="opengl",
            values=["opengl", "opencv", "directx"],
            exclusive=True,
        ),
        desc.ChoiceParam(
            name="failurePolicy",
            label="On Failure",
            description="stop: at the first pose that gives no normals. skip: go on, "
            "and fail only if no pose gives any.",
            value="stop",
            values=["stop", "skip"],
            exclusive=True,
        ),
        desc.StringParam(
            name="executable",
            label="Command",
            description="How unips is called, e.g. /opt/unips/bin/unips.",
            value="unips",
            advanced=True,
        ),
        desc.StringParam(
            name="weights",
            label="Weights",
            description="Name of shipped weights, or a .safetensors file.",
            value="tiny",
            advanced=True,
        ),
    ]
    outputs = [
        desc.File(
            name="output",
            label="Normals Folder",
            description="POSE_normals.png, POSE_normals.exr, poses.json.",
            value="{nodeCacheFolder}",
        ),
    ]

    def processChunk(self, chunk: Any) -> None:  # as Meshroom calls it
        """Estimates every pose; called by Meshroom."""
        node = chunk.node
        options = {
            name: getattr(node, name).value
            for name in [attribute.name for attribute in self.inputs]
        }
        log = getattr(chunk, "logger", None) or logging.getLogger("UniPSNormals")
        estimate_poses(options, Path(node.output.value), log)


def estimate_poses(options: dict[str, Any], output: Path, log: Any) -> dict[str, str]:
    """Runs the command for every pose and collects what it wrote.

    Args:
        options: values of the node's inputs, by name.
        output: folder for the results.
        log: a logger.

    Returns:
        What became of each pose: "done", or why not; also in `poses.json`.

    Raises:
        RuntimeError: by the failure policy, or if there are no poses.
    """
    poses = find_poses(Path(options["input"]))
    output.mkdir(parents=True, exist_ok=True)
    outcome: dict[str, str] = {}
    for number, (pose, photographs) in enumerate(poses.items(), 1):
        log.info(f"pose {pose} ({number} of {len(poses)})")
        try:
            _estimate(pose, photographs, options, output)
            outcome[pose] = "done"
        except RuntimeError as error:
            outcome[pose] = str(error)
            log.error(f"pose {pose}: {error}")
        text = json.dumps(outcome, indent=1)
        (output / "poses.json").write_text(text)
        if outcome[pose] != "done" and options["failurePolicy"] == "stop":
            raise RuntimeError(f"pose {pose} gave no normals: {outcome[pose]}")
    if "done" not in outcome.values():
        raise RuntimeError(f"no pose gave normals; see {output / 'poses.json'}")
    return outcome


def find_poses(source: Path) -> dict[str, Path | list[Path]]:
    """The folder or the photographs of each pose, by its name, sorted.

    Args:
        source: an SfMData file, or a folder of folders of photographs.

    Raises:
        RuntimeError: if there are none, or two of one name.
    """
    folders: dict[str, Path] = {}
    views: dict[str, list[Path]] = {}
    if source.is_dir():
        for folder in sorted(source.iterdir()):
            if folder.is_dir() and not folder.name.startswith(".") and _images(folder):
                pose = folder.name.removesuffix(".data")
                if pose in folders:
                    raise RuntimeError(
                        f"{source}: expected one folder for the pose {pose}, got "
                        f"{folders[pose].name} and {folder.name}; rename one"
                    )
                folders[pose] = folder
    elif source.is_file():
        try:
            for view in json.loads(source.read_bytes())["views"]:
                path = source.parent / view["path"]
                if not path.name.startswith("."):
                    views.setdefault(str(view["poseId"]), []).append(path)
        except (ValueError, KeyError, TypeError) as error:
            raise RuntimeError(
                f"{source}: expected SfMData with views of path and poseId, got "
                f"{type(error).__name__}: {error}"
            ) from error
    if not folders and not views:
        raise RuntimeError(
            f"{source}: expected an SfMData file, or a folder with a folder of "
            "photographs for every pose; found neither"
        )
    return {**folders, **{pose: sorted(views[pose]) for pose in sorted(views)}}


def _estimate(
    pose: str, given: Path | list[Path], options: dict[str, Any], output: Path
) -> None:
    """One pose: its folder, or one of links, so that only its photographs are read."""
    with tempfile.TemporaryDirectory(dir=output, prefix=f".{pose}-") as scratch:
        links = {}
        if isinstance(given, Path):
            folder = given
        else:
            folder = Path(scratch) / pose
            links = _linked(given, folder)
        command = [*_words(options["executable"]), "estimate", str(folder)]
        command += ["-o", str(Path(scratch) / "out"), "--weights", options["weights"]]
        command += ["--normal-map", options["convention"]]
        if links:  # also what is named as a map or a mask
            command += ["--include", "[0-9][0-9][0-9][0-9]_*"]
        if options["maxImages"]:
            command += ["--max-images", str(options["maxImages"])]
            command += ["--seed", str(options["seed"])]
        mask = _mask(pose, given, options["maskFolder"])
        if mask is not None:
            command += ["--mask", str(mask)]
        if options["outputFormat"] != "png":
            command.append("--exr")
        try:
            _run(command)
        except RuntimeError as error:
            text = str(error)
            for link, path in links.items():
                text = text.replace(link, path)
            raise RuntimeError(text) from None
        record = json.loads(
            (Path(scratch) / "out" / pose / "normals.json").read_bytes()
        )
        if links and record.get("orientation", 1) != 1:
            raise RuntimeError(
                f"pose {pose}: expected photographs as SfMData's cameras saw them, got "
                "some that EXIF turns; remove the tag (exiftool -Orientation= FILES)"
            )
        suffixes = {"both": ("png", "exr")}.get(
            options["outputFormat"], (options["outputFormat"],)
        )
        for suffix in (*suffixes, "json"):
            result = Path(scratch) / "out" / pose / f"normals.{suffix}"
            os.replace(result, output / f"{pose}_normals.{suffix}")


def _words(command: str) -> list[str]:
    """A command's words; those with blanks are quoted, unless it is a file's path."""
    if Path(command).is_file():
        return [command]
    if sys.platform == "win32":  # in its paths backslashes are no escapes
        command = command.replace("\\", "\\\\")
    return shlex.split(command)


def _run(command: list[str]) -> None:
    try:
        run = subprocess.run(
            command,
            env={**os.environ, "PYTHONIOENCODING": "utf-8"},
            capture_output=True,
            encoding="utf-8",
            errors="replace",
        )
    except OSError as error:
        raise RuntimeError(
            f"{command[0]}: expected the command of unips_jax, got: "
            f"{error.strerror}; give its path as Command"
        ) from error
    if run.returncode:
        errors = [line for line in run.stderr.splitlines() if line.startswith("error:")]
        raise RuntimeError(
            " ".join(errors).removeprefix("error: ") or f"exit status {run.returncode}"
        )


def _images(folder: Path) -> list[Path]:
    """Files that may be photographs; `unips estimate` chooses among them."""
    return [
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in IMAGES
        and path.stem.lower() not in MAPS
        and not path.name.startswith(".")
    ]


def _mask(pose: str, given: Path | list[Path], folder: str) -> Path | None:
    """The pose's mask in the mask folder; else one among the photographs of views.

    That of a pose's own folder is found by `unips estimate`.
    """
    photographs = _images(given) if isinstance(given, Path) else given
    if folder:
        if not Path(folder).is_dir():
            raise RuntimeError(f"Mask Folder: expected a folder, got {folder}")
        masks = [
            p for p in sorted(Path(folder).iterdir()) if p.suffix.lower() in IMAGES
        ]
        for stem in (pose, *(path.stem for path in photographs)):
            for path in masks:
                # Dots stand in names, too: `bust.1.png` is no mask of `bust`.
                if os.path.normcase(path.stem) == os.path.normcase(stem):
                    return path
    if isinstance(given, Path):
        return None
    for path in sorted(given[0].parent.iterdir()):
        if path.stem.lower() == "mask" and path.suffix.lower() in IMAGES:
            return path
    return None


def _linked(photographs: list[Path], folder: Path) -> dict[str, str]:
    """Makes a folder of links; returns what they lead to."""
    folder.mkdir()
    links = {}
    for number, path in enumerate(photographs):
        if not path.is_file():
            raise RuntimeError(f"{path}: no such file")
        # Views of different folders may have the same name.
        link = folder / f"{number:04}_{path.name}"
        try:
            link.symlink_to(path.resolve())
        except OSError:  # Windows, without the right to
            shutil.copyfile(path, link)
        links[str(link)] = str(path)
    return links
