"""Training runs for several test files: a small one, in this process or another."""

import contextlib
import dataclasses
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np
from small_networks import SMALL

from unips_jax.training.config import Config, DataConfig, OptimConfig, TrainConfig
from unips_jax.training.loop import train

DATA = DataConfig(
    source="scenes", image_size=16, batch_size=8, num_images=(3,), num_pixels=40
)
CONFIG = Config(
    # The least network: what is tested is training, and each run compiles it.
    model=dataclasses.replace(
        SMALL,
        depths=(1,),
        num_heads=(2,),
        communication="none",
        aggregation="max",
    ),
    data=DATA,
    optim=OptimConfig(learning_rate=1e-2, ema_decay=0.9),
    train=TrainConfig(
        # Validating would compile the scenes' renderer.
        **dict(steps=8, log_every=1, checkpoint_every=3, validation_scenes=0)
    ),
)


def batch(count=8, n=3, size=16):
    """Spheres under directional light."""
    generator = np.random.default_rng(0)
    y, x = np.mgrid[1 : -1 : size * 1j, -1 : 1 : size * 1j]
    mask = x**2 + y**2 < 0.9
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    normals = np.stack([x, y, z], -1) * mask[..., None]
    lights = generator.normal(size=(count, n, 3)) + [0, 0, 2]
    images = np.maximum(np.einsum("hwk,bnk->bnhw", normals, lights), 0)
    return {
        "images": jnp.asarray(np.repeat(images[..., None], 3, -1), jnp.float32),
        "mask": jnp.asarray(np.broadcast_to(mask, (count, size, size))),
        "normals": jnp.asarray(
            np.broadcast_to(normals, (count, size, size, 3)), jnp.float32
        ),
    }


RUN = """
import sys
from pathlib import Path
import jax
jax.config.update("jax_num_cpu_devices", int(sys.argv[2]))
from unips_jax.models.config_json import from_json
from unips_jax.training import sharding
from unips_jax.training.config import Config
from unips_jax.training.loop import train
sharding._MIN_SPLIT = 8  # else the small network's arrays would not be split at all
config = from_json(Config, Path(sys.argv[1], "config.json").read_text())
if len(sys.argv) > 3:
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(sys.argv[3], 2, int(sys.argv[4]))
train(config, Path(sys.argv[1]))
"""


def start(workdir: Path, config: Config, *arguments: str) -> subprocess.Popen:
    workdir.mkdir(exist_ok=True)
    text = json.dumps(dataclasses.asdict(config))
    (workdir / "config.json").write_text(text)
    command = [sys.executable, "-c", RUN, str(workdir), *(arguments or ("1",))]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ)


def finish(process: subprocess.Popen) -> str:
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
    return errors


def trained(workdir: Path, config: Config) -> str:
    """Trains in this process, on one device; what was printed."""
    printed = io.StringIO()
    with contextlib.redirect_stderr(printed):
        train(config, workdir)
    return printed.getvalue()


def write_objects(root: Path) -> str:
    """Five objects with four photographs each, in PS-Wild's layout."""
    for index in range(5):
        folder = root / f"object{index}.data"
        folder.mkdir()
        scene = {k: np.asarray(v[0]) for k, v in batch(1, 4).items()}
        for i, image in enumerate(scene["images"] * (1 + index)):
            image = np.clip(image / 20, 0, 1) * 65535
            cv2.imwrite(str(folder / f"{i:03}.tif"), image.astype(np.uint16))
        normals = np.round((scene["normals"] + 1) / 2 * 65535).astype(np.uint16)
        cv2.imwrite(str(folder / "normal.tif"), normals[..., ::-1])
    return str(root)


def final_params(workdir: Path) -> dict[str, np.ndarray]:
    from safetensors.numpy import load_file

    return load_file(workdir / "last.safetensors")


def largest_file(folder: Path) -> Path:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return max(files, key=lambda path: path.stat().st_size)


def flip_a_bit(file: Path, share: float) -> None:
    """Flips one bit, at this share of a file's length."""
    content = bytearray(file.read_bytes())
    content[int(share * len(content))] ^= 16
    file.write_bytes(content)
