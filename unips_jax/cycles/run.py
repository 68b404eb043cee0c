"""Renders a set object by object; whatever stops it, it goes on from there."""

import dataclasses
import json
import sys
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from unips_jax.console import track
from unips_jax.cycles.assets import Job
from unips_jax.cycles.blender_process import Blender, BlenderError
from unips_jax.cycles.environments import draw_environment, read_mean_radiance
from unips_jax.cycles.lighting import automatic_gain, draw_light
from unips_jax.errors import InputError
from unips_jax.io.claims import claim, claimed
from unips_jax.io.door import write_whole
from unips_jax.io.images import write_image
from unips_jax.io.ps_wild import focal_facts, write_folder

_PREVIEW = 64
_ROTATIONS = 20


@dataclasses.dataclass(frozen=True)
class Settings:
    """How a set is rendered."""

    # folders of the set
    lightings: tuple[str, ...] = ("directional", "environment", "mixed")
    images: int = 10  # per object and lighting
    size: int = 512  # side in pixels
    samples: int = 256  # paths per pixel
    denoise: bool = False  # with Open Image Denoise
    # share of objects seen in perspective, 35 mm to 200 mm equivalents
    perspective: float = 0.5
    # of the normals; see `scenes.poses.normal_entropy_bits`
    min_entropy_bits: float = 4.0
    # files as in PS-Wild's training set, `00.tif` (`000.tif` of more than 10), instead
    # of `L_00.png`
    training: bool = False
    environments: tuple[str, ...] = ()  # files; drawn ones if empty
    seed: int = 0  # of the set
    # of the user, by option and name: size or digest. Only recorded.
    files: dict[str, int] = dataclasses.field(default_factory=dict)


class Truth(NamedTuple):
    """What is known of an object's pixels; see `read_truth`."""

    mask: np.ndarray
    normals: np.ndarray
    depth: np.ndarray
    maps: dict[str, np.ndarray]


def read_truth(channels: dict[str, np.ndarray]) -> Truth:
    """Takes the passes of `Studio.truth` apart.

    `mask [H, W]` bool, where there is an object with a unit normal;
    `normals [H, W, 3]`, zero outside; `depth [H, W]`, along the view axis, from the
    camera, 0 outside; `maps`: `baseColor [H, W, 3]`, `roughness` and `metal [H, W]`.
    """

    def stack(name: str, parts: str) -> np.ndarray:
        return np.stack([channels[f"{name}.{part}"] for part in parts], -1)

    normals = stack("Normal", "XYZ")
    unit = np.abs(np.linalg.norm(normals, axis=-1) - 1) < 1e-4
    mask = (channels["Combined.A"] > 0.5) & unit
    maps = {"baseColor": stack("baseColor", "RGB")}
    maps |= {name: channels[f"{name}.X"] for name in ("roughness", "metal")}
    maps = {
        k: v * mask.reshape(mask.shape + (1,) * (v.ndim - 2)) for k, v in maps.items()
    }
    normals = normals * mask[..., None]
    depth = np.where(mask, channels["Depth.Z"], 0)
    return Truth(mask, normals, depth, maps)


def read_photograph(channels: dict[str, np.ndarray], mask: np.ndarray) -> np.ndarray:
    """Radiance `[H, W, 3]` of the object, 0 outside, by premultiplied R, G, B and A.

    Pixels at the outline, which the object covers in part, are divided by that part.
    """
    alpha = channels["A"]
    image = np.stack([channels[c] for c in "RGB"], -1)
    inside = mask & (alpha > 1e-3)
    return np.where(inside[..., None], image / np.maximum(alpha, 1e-3)[..., None], 0)


def entropy_bits(truth: Truth) -> float:
    """Entropy of an object's normals."""
    import jax.numpy as jnp

    from unips_jax.scenes.poses import normal_entropy_bits

    normals, mask = jnp.asarray(truth.normals), jnp.asarray(truth.mask)
    return float(normal_entropy_bits(normals, mask))


def _rotation(rng: np.random.Generator, *, facing: bool) -> list[float]:
    """A quaternion, w first: any, or within 35 degrees of facing the viewer."""
    if facing:
        tilt = rng.uniform(0, np.deg2rad(35)) / 2
        axis, spin = rng.uniform(0, 2 * np.pi), rng.uniform(0, np.pi)
        tilted = [
            np.cos(tilt),
            np.sin(tilt) * np.cos(axis),
            np.sin(tilt) * np.sin(axis),
        ]
        w, x, y = tilted  # times a turn about z
        c, s = np.cos(spin), np.sin(spin)
        return [float(v) for v in (w * c, x * c + y * s, y * c - x * s, w * s)]
    turn = rng.normal(size=4)
    return (turn / np.linalg.norm(turn)).tolist()


def pose(
    blender: Blender, job: Job, settings: Settings, rng: np.random.Generator
) -> dict[str, Any]:
    """Builds an object and turns it until it fits and its normals are varied enough."""
    blender.ask("build", shape=job.shape, material=job.material)
    focal_mm = None
    if rng.random() < settings.perspective:
        focal_mm = float(np.exp(rng.uniform(np.log(35), np.log(200))))
    for _ in range(_ROTATIONS):
        rotation = _rotation(rng, facing=job.facing)
        if not blender.ask("place", rotation=rotation, focal_mm=focal_mm):
            continue
        found = entropy_bits(read_truth(blender.picture("truth", size=_PREVIEW)))
        if found > settings.min_entropy_bits:
            facts: dict[str, Any] = {"rotation": rotation, "entropy_bits": found}
            return facts | focal_facts(focal_mm, settings.size)
    raise BlenderError(
        f"none of {_ROTATIONS} rotations fits the frame with an entropy of the normals "
        f"of more than {settings.min_entropy_bits} bits"
    )


class _Photographs:
    """Renders the photographs of one lighting; `facts` grows with them."""

    def __init__(
        self, blender: Blender, job: Job, lighting: str, settings: Settings
    ) -> None:
        self._blender, self._settings, self._lighting = blender, settings, lighting
        own = (*job.seed, zlib.crc32(lighting.encode()))
        self._rng = np.random.default_rng(own)
        self._file, self._mean = "", 1.0
        if lighting in ("environment", "mixed"):
            self._file, self._mean = self._environment(f"{job.name}-{lighting}")
        self.facts: dict[str, list[Any]] = {"lights": [], "gains": []}

    def _environment(self, name: str) -> tuple[str, float]:
        files = self._settings.environments
        if files:
            path = Path(files[int(self._rng.integers(len(files)))])
        else:
            path = self._blender.folder / f"{name}.hdr"
            picture = draw_environment(self._rng)
            write_image(path, picture)
        return str(path), read_mean_radiance(path)

    def render(self, mask: np.ndarray) -> Iterator[np.ndarray]:
        s = self._settings
        for _ in range(s.images):
            light = draw_light(self._rng, self._lighting, self._file, self._mean)
            channels = self._blender.picture(
                "image",
                size=s.size,
                samples=s.samples,
                denoise=s.denoise,
                seed=int(self._rng.integers(2**31)),
                **light,
            )
            radiance = read_photograph(channels, mask)
            gain = automatic_gain(radiance, mask)
            self.facts["lights"].append(light)
            self.facts["gains"].append(gain)
            yield radiance * gain

    def all_facts(self) -> dict[str, Any]:
        facts: dict[str, Any] = dict(self.facts)
        for light in facts["lights"]:
            if light["environment"]:
                light["environment"]["file"] = Path(self._file).name
        if self._lighting == "directional":
            lamps = [light["lamps"][0] for light in facts["lights"]]
            facts["light_directions"] = [lamp["direction"] for lamp in lamps]
            facts["light_intensities"] = [  # of a Lambertian surface: albedo n.l times
                (np.array(lamp["irradiance"]) / np.pi * gain).tolist()
                for lamp, gain in zip(lamps, facts["gains"], strict=True)
            ]
        return facts


def render_object(
    blender: Blender, job: Job, settings: Settings, folders: dict[str, Path]
) -> None:
    """Renders an object under several lightings, into folders that do not exist yet."""
    facts = {**job.facts, "seed": list(job.seed), "engine": "cycles"}
    facts["versions"] = blender.ask("version")
    facts |= pose(blender, job, settings, np.random.default_rng(job.seed))
    truth = read_truth(blender.picture("truth", size=settings.size))
    name = "L_{:02d}.png"
    if settings.training:  # they begin with "0", however many
        name = f"0{{:0{len(str(settings.images - 1))}d}}.tif"
    unlit = []
    for lighting, folder in folders.items():
        try:
            photographs = _Photographs(blender, job, lighting, settings)
        except InputError as error:
            unlit.append(f"{lighting}: {error}")
            continue
        images = list(photographs.render(truth.mask))
        rendered = {k: getattr(settings, k) for k in ("size", "samples", "denoise")}
        write_folder(
            folder,
            images,
            truth.mask,
            truth.normals,
            {**facts, "light": lighting, **rendered, **photographs.all_facts()},
            maps=truth.maps,
            depth=truth.depth,
            name=name,
        )
    if unlit:
        raise InputError("; ".join(unlit))


def render_set(
    blender: Blender, jobs: Sequence[Job], settings: Settings, out: Path
) -> list[str]:
    """Renders what is missing of a set; several processes may share the work.

    `out` receives `LIGHTING/NAME.data`, and `failures/NAME.txt` of objects that could
    not be rendered, whose names are returned; the others are complete, also those of
    other processes.
    """
    locks, failures = out / ".locks", out / "failures"
    locks.mkdir(parents=True, exist_ok=True)
    record = {
        **dataclasses.asdict(settings),
        "environments": len(settings.environments),
    }
    record |= record.pop("files")
    path = out / "settings.json"
    with claim(locks / ".settings", wait=True):
        if not path.exists() or "made_by" in json.loads(path.read_text()):
            record["made_by"] = "Blender " + blender.ask("version")["blender"]
        _same_settings(path, record)

    def missing(job: Job) -> dict[str, Path]:
        chosen = job.lightings or settings.lightings
        folders = {name: out / name / f"{job.name}.data" for name in chosen}
        return {name: folder for name, folder in folders.items() if not folder.exists()}

    left = [job for job in jobs if missing(job)]
    failed = []
    ours = claimed(left, lambda job: locks / job.name)
    for job in track(ours, "rendering", total=len(left)):
        folders = missing(job)
        if not folders:  # another process was faster
            continue
        try:
            render_object(blender, job, settings, folders)
            (failures / f"{job.name}.txt").unlink(missing_ok=True)
        except (BlenderError, InputError) as error:
            write_whole(failures / f"{job.name}.txt", f"{error}\n".encode())
            print(f"{job.name}: left out: {error}", file=sys.stderr)
            failed.append(job.name)
        for drawn in blender.folder.glob("*.hdr"):  # of thousands of objects: GB
            drawn.unlink()
    return failed


def _same_settings(path: Path, record: dict[str, Any]) -> None:
    """Refuses to go on with a set in another way than it was begun."""
    if not path.exists() and any(path.parent.glob("*/*.data")):
        raise InputError(
            f"{path.parent}: expected a new folder or a set of Cycles, found objects "
            f"without {path.name}; take another folder"
        )
    record = json.loads(json.dumps(record))
    if not path.exists():
        write_whole(path, (json.dumps(record, indent=1) + "\n").encode())
        return
    before = json.loads(path.read_text())
    changed = {
        name: (before.get(name), record.get(name))
        for name in sorted(before.keys() | record.keys())
        if before.get(name) != record.get(name)
    }
    if changed:
        first = dict(list(changed.items())[:5])
        more = f" and {len(changed) - 5} more" if len(changed) > 5 else ""
        raise InputError(
            f"{path}: the set was begun with other settings (before, now): {first}"
            f"{more}; take another folder, or the same settings"
        )
