"""What a folder's results hold beyond normals and depth, each on request.

--lights       lights.json, lights.lp
--base-color   base_color.exr, base_color.png
--rti          relight.ptm; info.json, plane_0.jpg to plane_5.jpg
--confidence   confidence.exr, confidence.png, unreliable.png
"""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from unips_jax.errors import InputError
from unips_jax.estimation.options import FolderOptions
from unips_jax.io.color import Transfer
from unips_jax.io.images import write_exr, write_image
from unips_jax.lighting.light_fit import Lights, estimate_lights
from unips_jax.lighting.near import NearField, places_of

if TYPE_CHECKING:
    from unips_jax.estimation.streaming import NormalsAndLights
    from unips_jax.estimation.writing import Estimate
    from unips_jax.models.network import Lamps, UniversalNetwork

UNRELIABLE_DEG = 15.0  # of spread: a pixel above it is in the mask
# A lamp's share of the light, below which it is not the key light, above which it is.
_LAMPLESS, _LAMPLIT = 0.1, 0.25


class Extras(NamedTuple):
    """What the network has to be asked for; None unless wanted."""

    lights: Lights | None = None  # of the photographs
    confidence: np.ndarray | None = None  # `[H, W]`, the normals' spread in degrees


def estimate_extras(
    network: "UniversalNetwork",
    images: np.ndarray,
    mask: np.ndarray,
    found: "NormalsAndLights",
    transfer: Transfer,
    options: FolderOptions,
    *,
    rig: Lights | np.ndarray | None = None,
    known: np.ndarray | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Extras:
    """Estimates lights and confidence, as far as the options want them.

    `found` is the estimate of `images [N, H, W, 3]`; `rig` are lights, or directions,
    known from elsewhere (`lighting.rig`), `known` what the network was given.
    """
    lights, confidence, near = None, None, None
    if options.lamp_distance is not None:
        near = _near_field(found.normals, mask, options.lamp_distance)
    if isinstance(rig, Lights):
        lights = rig._replace(near=near)
    elif options.lights or options.base_color or options.rti:
        lamps = found.lamps if rig is None else None
        guesses = _with_known(key_lights(found.lights, lamps), known)
        lights = estimate_lights(
            images,
            found.normals,
            mask,
            guesses=guesses if rig is None else rig,
            near=near,
            transfer=transfer,
        )
        if lamps is not None:
            lights = lights._replace(lamp_shares=np.asarray(lamps.shares))
    if options.confidence:
        from unips_jax.estimation.confidence import normal_spread

        confidence = normal_spread(
            network,
            images,
            mask,
            found.normals,
            transfer=transfer,
            frame=options.frame,
            lights=known,
            progress=progress,
        )
    return Extras(lights, confidence)


def key_lights(lights: np.ndarray | None, lamps: "Lamps | None") -> np.ndarray | None:
    """Each photograph's key light `[N, 3]`, as long as it is direct.

    The lamp, as long as its share of all light, where it has a quarter of it or more;
    in surroundings the mean direction of all light.
    """
    if lights is None or lamps is None:
        return lights
    share = np.asarray(lamps.shares)[:, None]
    # Little by little: colours fitted to either differ, and must not jump.
    lamp = np.clip((share - _LAMPLESS) / (_LAMPLIT - _LAMPLESS), 0, 1)
    length = np.linalg.norm(lights, axis=-1, keepdims=True)
    towards = lamp * lamps.directions + (1 - lamp) * lights / np.maximum(length, 1e-6)
    towards /= np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-6)
    return towards * (lamp * share + (1 - lamp) * length)


def _with_known(
    guesses: np.ndarray | None, known: np.ndarray | None
) -> np.ndarray | None:
    """Guesses `[N, 3]`, towards lights that are known exactly, in surroundings too."""
    if guesses is None or known is None:
        return guesses
    exact = np.linalg.norm(known, axis=-1, keepdims=True) > 1 - 1e-4
    length = np.linalg.norm(guesses, axis=-1, keepdims=True)
    return np.where(exact, length * known, guesses)


def _near_field(normals: np.ndarray, mask: np.ndarray, distance: float) -> NearField:
    """Where the surface is, by its normals, next to lamps at that distance."""
    from unips_jax.surface.images import integrate_image

    places = places_of(integrate_image(normals, mask).depth)
    reach = float(np.linalg.norm(places[mask], axis=-1).max())
    if distance <= 1.2 * reach:
        raise InputError(
            f"--lamp-distance {distance}: expected lamps away from the object, which "
            f"reaches {reach:.2f} widths of the photograph from its middle; measure "
            "again, in widths of what the photograph shows"
        )
    return NearField(distance, places)


def write_extras(
    folder: Path, estimate: "Estimate", options: FolderOptions
) -> dict[str, Any]:
    """Writes what the options want into a folder; returns facts for the record."""
    facts: dict[str, Any] = {}
    images, mask, transfer = estimate.images, estimate.mask, estimate.transfer
    to_srgb = estimate.to_srgb
    lights, confidence = estimate.extras
    if lights is not None:
        from unips_jax.lighting import light_files as files
        from unips_jax.lighting.ptm import fit_texture_map, write_planes, write_ptm

        if options.lights:
            files.write_lights(
                folder,
                list(estimate.record["images"]),
                lights,
                orientation=estimate.record.get("exif_orientation", 1),
            )
        if options.base_color:
            color = files.base_color(
                images,
                estimate.normals,
                mask,
                lights,
                transfer=transfer,
                to_srgb=to_srgb,
            )
            facts["base_color"] = files.write_base_color(folder, color)
        if options.rti:
            fit = fit_texture_map(
                images, mask, lights, transfer=transfer, to_srgb=to_srgb
            )
            facts["rti"] = write_ptm(folder / "relight.ptm", fit)
            write_planes(folder, fit)
    if confidence is not None:
        facts["confidence"] = write_confidence(folder, confidence, mask)
    return facts


def write_confidence(
    folder: Path, spread: np.ndarray, mask: np.ndarray
) -> dict[str, Any]:
    """Writes the spread `[H, W]`, in degrees; returns levels' meaning and the mean."""
    comments = "spread of the normals over halves of the photographs, degrees; "
    comments += "NaN: no surface"
    outside = np.where(mask, spread, np.nan)
    write_exr(folder / "confidence.exr", {"Y": outside}, comments)
    levels = np.where(mask, np.clip(np.rint(spread * 100), 1, 65535), 0)
    write_image(folder / "confidence.png", levels.astype(np.uint16))
    bad = mask & (spread > UNRELIABLE_DEG)
    write_image(folder / "unreliable.png", bad.astype(np.uint8) * 255)
    return {
        "confidence.png": "spread of the normals over halves of the photographs = "
        "level / 100 degrees; 0: no surface",
        "unreliable.png": f"255 where the spread is above {UNRELIABLE_DEG:g} degrees",
        "mean_deg": float(spread[mask].mean()),
    }
