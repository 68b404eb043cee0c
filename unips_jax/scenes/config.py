"""What scenes are drawn from: the mixture of shapes, materials, lights and cameras."""

import dataclasses
import math

from unips_jax.checks import check_types, require

LIGHT_KINDS = ("directional", "environment", "mixed", "point", "area")
SHAPE_KINDS = ("blob", "composition", "machine", "lathe", "thin", "relief", "plate")
SHAPE_NAMES = (*SHAPE_KINDS, "mesh")  # of `Scene.shape_kind`
MATERIALS = (
    "fabric",
    "concrete",
    "wood",
    "floor",
    "ground",
    "metal",
    "uniform",
    "dark",
    "glossy",
    "painted_metal",
)


@dataclasses.dataclass(frozen=True)
class SceneConfig:
    """Distribution of scenes.

    Attributes:
        light_weights: relative frequency of each kind of light: directional,
            environment, mixed, point, area.
        shape_weights: relative frequency of each kind of shape: blob, composition,
            machine, lathe, thin, relief, plate. Reliefs and plates are exempt from the
            entropy test (they rarely pass it), so their share is the share of exempt
            scenes.
        material_weights: relative frequency of each material: fabric, concrete, wood,
            floor, ground, metal, uniform, dark, glossy, painted_metal.
        perspective_rate: share of perspective cameras; the rest are orthographic.
        focal_range_mm: 35 mm equivalents of perspective cameras before the frame is
            cropped to the object, which multiplies them by about 1.3.
        rotation_candidates: rotations tried for one shape; the first whose normals
            have an entropy above `min_entropy_bits` is taken.
        min_entropy_bits: see `poses.normal_entropy_bits`.
        num_directions: directions in which visibility is tabulated for environments.
        interreflection: whether the object's own light, its mean radiance, reaches it
            from where it hides its surroundings.
        sensor: whether the camera adds noise, response, quantisation, blur and mask
            errors; without it images are linear radiances scaled by the exposure.
        spare_rate: share of scenes whose highlights are hardly ever clipped.
        linear_rate: share of scenes whose response curve is linear.
        eight_bit_rate: share of linear scenes stored in 8 bits instead of 16 (of the
            others four fifths are).
        noise_rate: share of scenes with visible sensor noise.
        blur_rate: share of scenes that are slightly blurred.
        mask_error_rate: share of scenes whose mask lost some of its border.
        rim_rate: share of scenes before a background that most mix with at their
            border, and with masks that are up to 4 pixels too large or 3 too small,
            shifted, uneven or jagged, or exact; `mask_error_rate` is for the others.
        mixed_rate: share, among the others, of scenes whose border pixels are partly
            background, as a photograph's are; their masks are as exact as without.
        far_lamp_rate: share, among lamps that are near (point, area), of those that
            stand 3 to 15 of the object's radii away; the others stand within 4.
        side_rate: share of scenes lit from one side only, or from one quadrant.
        photograph_rate: share of environments that are photographed, wholly or in part.
        whole_frame_rate: share, among objects other than reliefs and plates, of those
            on a table or before a wall, where the mask is everything.
        bounce_rate: share of scenes where the object's own light comes from what is
            near in the image; elsewhere it is the same everywhere.
        paint_rate: share of scenes with spots, lines or bands of another paint.
        carving_rate: share of scenes with a relief that is finer and steeper, and
            darker in its hollows.
        mesh_rate: share of scenes whose shape is a mesh by others; of a batch, as many
            as come nearest to it.
        mesh_file: that holds them, by `tools/fetch_assets.py --shapes`.
        metal_spot_rate: share, among metals, of those with spots of paint or rust.
    """

    light_weights: tuple[float, ...] = (0.3, 0.25, 0.25, 0.1, 0.1)
    shape_weights: tuple[float, ...] = (0.16, 0.22, 0.16, 0.14, 0.08, 0.14, 0.1)
    # fmt: off
    material_weights: tuple[float, ...] = (
        0.12, 0.1, 0.1, 0.09, 0.09, 0.13, 0.14, 0.06, 0.1, 0.07
    )
    # fmt: on
    perspective_rate: float = 0.5
    focal_range_mm: tuple[float, float] = (12.0, 150.0)
    rotation_candidates: int = 3
    min_entropy_bits: float = 4.0
    num_directions: int = 24
    interreflection: bool = True
    sensor: bool = True
    spare_rate: float = 0.5
    linear_rate: float = 0.6
    eight_bit_rate: float = 0.2
    noise_rate: float = 0.6
    blur_rate: float = 0.3
    mask_error_rate: float = 0.15
    rim_rate: float = 0.0
    mixed_rate: float = 0.0
    far_lamp_rate: float = 0.0
    side_rate: float = 0.0
    photograph_rate: float = 0.0
    whole_frame_rate: float = 0.0
    bounce_rate: float = 0.0
    paint_rate: float = 0.0
    carving_rate: float = 0.0
    mesh_rate: float = 0.0
    mesh_file: str = ""
    metal_spot_rate: float = 0.0

    def __post_init__(self) -> None:
        check_types(self)
        for name, kinds in (
            ("light_weights", LIGHT_KINDS),
            ("shape_weights", SHAPE_KINDS),
            ("material_weights", MATERIALS),
        ):
            weights = getattr(self, name)
            require(
                len(weights) == len(kinds)
                and min(weights) >= 0
                and 0 < sum(weights) < math.inf,
                f"{name}: expected {len(kinds)} weights >= 0, not all zero, one for "
                f"each of {kinds}, got {weights}",
            )
        for name, rate in vars(self).items():
            if name.endswith("_rate"):
                require(
                    0 <= rate <= 1, f"{name}: expected a rate in [0, 1], got {rate}"
                )
        require(
            bool(self.mesh_file) or not self.mesh_rate,
            "mesh_file: expected a file of meshes where mesh_rate is above 0, got none",
        )
        low, high = self.focal_range_mm
        require(
            0 < low <= high,
            f"focal_range_mm: expected 0 < low <= high, got {self.focal_range_mm}",
        )
        require(
            1 <= self.rotation_candidates <= 1000,
            f"rotation_candidates: expected 1 to 1000, got {self.rotation_candidates}",
        )
        require(
            8 <= self.num_directions <= 4096,
            f"num_directions: expected 8 to 4096, got {self.num_directions}",
        )
