"""Miniature benchmarks in exactly the published layouts, made from shaded spheres."""

import json
from functools import partial
from pathlib import Path

import cv2
import jax
import numpy as np
from scipy.io import savemat

from unips_jax.models.config import UniPSConfig
from unips_jax.models.network import UniversalNetwork, init_params
from unips_jax.weights import save_weights


def sphere(height, width, *, center=None, radius=None):
    """Mask `[H, W]` and unit normals `[H, W, 3]`, zero outside."""
    center = center or ((height - 1) / 2, (width - 1) / 2)
    radius = radius or 0.4 * min(height, width)
    rows, columns = np.mgrid[:height, :width]
    x = (columns - center[1]) / radius
    y = -(rows - center[0]) / radius
    mask = x**2 + y**2 < 0.98
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    return mask, np.where(mask[..., None], np.stack([x, y, z], -1), 0)


def lights(count, *, seed=0):
    """`[count, 3]` unit directions towards the viewer's side."""
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    directions[:, 2] = 1.5 + np.abs(directions[:, 2])
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def shade(normals, directions, *, albedo=(0.8, 0.6, 0.4)):
    """Lambertian images `[N, H, W, 3]` in [0, 1]."""
    shading = np.maximum(np.einsum("hwc,nc->nhw", normals, directions), 0)
    return shading[..., None] * np.array(albedo)


def to16(values):
    return np.rint(np.clip(values, 0, 1) * 65535).astype(np.uint16)


def encode16(normals, *, background=32768):
    stored = np.rint((normals + 1) * (65535 / 2)).astype(np.uint16)
    stored[~np.any(normals, axis=-1)] = background
    return stored


def write_image(path, image):
    """RGB (or grey) to a file of the suffix's format."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if image.ndim == 3 and image.shape[2] >= 3:
        image = image[..., [2, 1, 0, 3][: image.shape[2]]]
    assert cv2.imwrite(str(path), np.ascontiguousarray(image))


def write_mask(path, mask, *, channels=1):
    image = mask.astype(np.uint8) * 255
    write_image(path, np.dstack([image] * channels) if channels > 1 else image)


def write_table(path, table):
    path.write_text("\n".join(" ".join(f"{x:.7g}" for x in row) for row in table))


PS_WILD_LIGHTINGS = ("directional", "environment", "mixed")


def make_ps_wild(root, *, objects=2, images=4, size=24, lightings=PS_WILD_LIGHTINGS):
    """As `unips render` writes it: masks and meta.json."""
    for lighting in lightings:
        for i in range(objects):
            folder = root / lighting / f"obj{i:03d}.data"
            mask, normals = sphere(size, size, radius=size * (0.3 + 0.05 * i))
            directions = lights(images, seed=i)
            for j, image in enumerate(shade(normals, directions)):
                write_image(folder / f"L_{j:02d}.png", to16(image))
            write_image(folder / "normal.tif", encode16(normals))
            write_mask(folder / "mask.png", mask)
            meta = {"seed": i, "category": ("wood", "metal")[i % 2], "shape": "ball"}
            if lighting == "directional":
                meta["light_directions"] = directions.tolist()
            (folder / "meta.json").write_text(json.dumps(meta))
    return root


def make_ps_wild_test(root, *, objects=50, images=2, size=16):
    """As published: no mask.png, no meta.json."""
    for lighting in PS_WILD_LIGHTINGS:
        for i in range(objects):
            folder = root / lighting / f"{i:02d}.data"
            _, normals = sphere(size, size, radius=6)
            for j, image in enumerate(shade(normals, lights(images, seed=i))):
                write_image(folder / f"L{j:03d}.tif", to16(image))
            write_image(folder / "normal.tif", encode16(normals, background=0))
    return root


def make_ps_wild_train(root, *, size=16):
    for name in ("anvil", "basket"):
        folder = root / f"{name}.data"
        _, normals = sphere(size, size, radius=6)
        for j, image in enumerate(shade(normals, lights(10))):
            write_image(folder / f"{j:03d}.tif", to16(image))
        write_image(folder / "normal.tif", encode16(normals))
        for other in ("baseColor", "roughness", "metal"):
            write_image(folder / f"{other}.tif", to16(np.ones((size, size, 3))))
        (folder / "depth.exr").write_bytes(b"not looked at")
    return root


DILIGENT = (
    "ball",
    "bear",
    "buddha",
    "cat",
    "cow",
    "goblet",
    "harvest",
    "pot1",
    "pot2",
    "reading",
)


def make_directional(folder, *, images, size=(12, 14), seed=0, zero=0, corrupt=0):
    """A folder laid out as an object of DiLiGenT.

    Args:
        folder: where.
        images: how many.
        size: height and width.
        seed: of lights and intensities.
        zero: true normals of zero length inside the mask.
        corrupt: leading images that hold noise.
    """
    folder.mkdir(parents=True, exist_ok=True)
    mask, normals = sphere(*size)
    directions = lights(images, seed=seed)
    rng = np.random.default_rng(seed)
    intensities = rng.uniform(0.5, 1.5, (images, 3))
    rendered = shade(normals, directions) * intensities[:, None, None] / 2
    rendered[:corrupt] = rng.random(rendered[:corrupt].shape)
    names = [f"{j + 1:03d}.png" for j in range(images)]
    for name, image in zip(names, rendered, strict=True):
        write_image(folder / name, to16(image))
    truth = normals.copy()
    rows, columns = np.nonzero(mask)
    truth[rows[:zero], columns[:zero]] = 0
    (folder / "filenames.txt").write_text("\n".join(names) + "\n")
    write_table(folder / "light_directions.txt", directions)
    write_table(folder / "light_intensities.txt", intensities)
    write_mask(folder / "mask.png", mask, channels=3)
    savemat(folder / "Normal_gt.mat", {"Normal_gt": truth})
    return mask, truth, directions, intensities


def make_diligent(root, *, images=4, objects=DILIGENT, **options):
    """`pmsData` with a corrupt bear, an upside-down harvest and zeros in pot2."""
    for i, name in enumerate(objects):
        folder = root / "pmsData" / f"{name}PNG"
        corrupt = 20 if name == "bear" else 0
        _, truth, *_ = make_directional(
            folder,
            images=images + corrupt,
            seed=i,
            zero=7 if name == "pot2" else 0,
            corrupt=corrupt,
            **options,
        )
        if name == "harvest":
            write_table(folder / "normal.txt", truth[::-1].reshape(-1, 3))
    return root


def make_diligent_mv(root, *, objects=("bear", "buddha", "cow", "pot2", "reading")):
    for name in objects:
        folder = root / "mvpmsData" / f"{name}PNG"
        for view in range(1, 21):
            make_directional(folder / f"view_{view:02d}", images=3, seed=view)
        camera = {"KK": np.array([[3700.0, 0, 306], [0, 3710, 256], [0, 0, 1]])}
        for view in range(1, 21):
            camera[f"Rc_{view}"] = np.eye(3)
            camera[f"Tc_{view}"] = np.array([[0.0], [0], [1500 + view]])
        savemat(folder / "Calib_Results.mat", camera)
    return root


def make_diligent102(root, *, objects=("BALL_POM", "NUT_AL")):
    for name in objects:
        make_directional(root / name, images=3, size=(1001, 1001))
        (root / name / "Normal_gt.mat").unlink()
    return root


LUCES = (
    "Ball",
    "Bell",
    "Bowl",
    "Buddha",
    "Bunny",
    "Cup",
    "Die",
    "Hippo",
    "House",
    "Jar",
    "Owl",
    "Queen",
    "Squirrel",
    "Tool",
)


def make_luces(root, *, objects=LUCES, size=(12, 16)):
    for name in objects:
        folder = root / "data" / name
        mask, normals = sphere(*size)
        for j, image in enumerate(shade(normals, lights(52))):
            write_image(folder / f"{j + 1:02d}.png", to16(image))
        write_image(folder / "normals.png", encode16(normals))
        write_mask(folder / "mask.png", mask)
        np.savez(folder / "zgt.npz", zgt=np.where(mask, 300.0, 0))
        lines = ["N_img nrows ncols f x0 y0 mean_distance sfull:[Lpos Ldir Phi mu 0]"]
        lines.append(f"52 {size[0]} {size[1]} 22.5 {size[1] / 2} {size[0] / 2} 300.0")
        for direction in lights(52):
            position = 200 * direction
            fields = [*position, 0, 0, -1, 1, 1, 1, 2.0, 0]
            lines.append(" ".join(f"{x:.4f}" for x in fields))
        (folder / "led_params.txt").write_text("\n".join(lines) + "\n")
    return root


UW = ("buddha", "cat", "gray", "horse", "owl", "rock")


def make_uw(root, *, size=(30, 32), with_lights=True):
    base = root / "psmImages"
    directions = lights(12)
    for name in (*UW, "chrome"):
        mask, normals = sphere(*size)
        for j, image in enumerate(shade(normals, directions)):
            stored = np.rint(255 * image).astype(np.uint8)
            write_image(base / name / f"{name}.{j}.png", stored)
        write_mask(base / name / f"{name}.mask.png", mask, channels=3)
        listed = [f"{name}/{name}.{j}.png" for j in range(12)]
        text = "\n".join(["12", *listed, f"{name}/{name}.mask.png"])
        (base / f"{name}.txt").write_text(text)
    if with_lights:
        rows = "\n".join(" ".join(f"{x:.6f}" for x in row) for row in directions)
        (base / "lights.txt").write_text(f"12\n{rows}\n")
    return root


def make_folder(root, *, size=20, mask=True):
    for i, name in enumerate(("cup", "shoe")):
        folder = root / name
        inside, normals = sphere(size, size + i)
        for j, image in enumerate(shade(normals, lights(5, seed=i))):
            write_image(folder / f"IMG_{j + 8}.PNG", to16(image))
        write_image(folder / "normal.png", encode16(normals))
        if mask:
            write_mask(folder / "mask.png", inside)
    return root


def by_name(benchmark):
    return {benchmark[i].name: benchmark[i] for i in range(len(benchmark))}


def snapshot(root):
    """Every file below a folder, with contents, to show that nothing was touched."""
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in sorted(Path(root).rglob("*"))
        if path.is_file()
    }


def tilted(*degrees):
    angles = np.deg2rad(degrees)
    return np.stack([np.sin(angles), 0 * angles, np.cos(angles)], -1)[None]


def small_weights(path, seed=0):
    config = UniPSConfig(
        canonical_size=32,
        patch_channels=(4, 6),
        embed_dim=8,
        depths=(1,),
        num_heads=(1,),
        communication_heads=2,
        context_dim=8,
        hidden_dim=16,
        aggregation_layers=1,
        aggregation_heads=2,
        aggregation_mlp_dim=16,
        pma_mlp_dim=16,
        predictor_dim=8,
    )
    # Shapes alone are traced: initialising costs compiling for nothing.
    shapes = jax.eval_shape(partial(init_params, config), jax.random.key(0))
    rng = np.random.default_rng(seed)
    params = jax.tree.map(
        lambda leaf: 0.3 * rng.standard_normal(leaf.shape, np.float32), shapes
    )
    save_weights(path, UniversalNetwork(config, params))
    return path


def ps_wild_arguments(root, work, size, *counts):
    """Of `unips eval`: two methods, shown some numbers of images in a crop."""
    named = ["--benchmark", "ps-wild", "--root", str(root), "--workdir", str(work)]
    chosen = ["--method", "woodham", "constant", "--crop-size", str(size)]
    return [*named, *chosen, "--num-images", *counts]
