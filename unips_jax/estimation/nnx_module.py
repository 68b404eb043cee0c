"""The network as a module of `flax.nnx`, and as a folder in the shape of a model hub.

    model = unips_jax.NnxNetwork.from_pretrained("tiny")
    normals = nnx.jit(model)(images, mask)
    model.save_pretrained("my-network")    # config.json, model.safetensors, README.md
    model = unips_jax.NnxNetwork.from_pretrained("my-network")

The folder's weights are read by `load_weights` and by every command's `--weights`, as
`my-network/model.safetensors`. A name such as `user/my-network`, of a model hub, is
fetched where the package huggingface_hub is installed.
"""

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import jax
from flax import nnx
from jax import Array

from unips_jax.errors import InputError
from unips_jax.estimation.pure import estimate_normals
from unips_jax.io.claims import make_folder
from unips_jax.io.door import write_whole
from unips_jax.io.results import filling
from unips_jax.models.config_json import to_json
from unips_jax.models.network import UniversalNetwork
from unips_jax.weights import SHIPPED, load_weights, save_weights, weights_hash

CONFIG, WEIGHTS, CARD = "config.json", "model.safetensors", "README.md"
_CARD = """---
library_name: unips_jax
tags: [photometric-stereo, surface-normals, jax, flax]
license: {license}
---

# {name}

Surface normals from photographs of one object under unknown, changing light: a network
of `unips_jax`, {count:.1f} M parameters, hash `{digest}`.

```
normals = unips_jax.NnxNetwork.from_pretrained("{name}")(images, mask)
```

`images [N, H, W, 3]` are linear, `mask [H, W]` is true on the object; the normals are x
right, y up, z towards the viewer.
"""


class NnxNetwork(nnx.Module):
    """A network as a module of `flax.nnx`: images and mask to normals.

    Its parameters are `nnx.Param`, to be trained or frozen like any; its configuration
    is static.
    """

    def __init__(self, network: UniversalNetwork) -> None:
        """Takes a network, as `load_weights` gives it."""
        self.config = network.config
        self.params = nnx.data(jax.tree.map(nnx.Param, network.params))

    @property
    def network(self) -> UniversalNetwork:
        """The network with the parameters as they are now."""
        params = nnx.to_pure_dict(nnx.state(self.params))
        return UniversalNetwork(self.config, params)

    def __call__(self, images: Array, mask: Array, **options: Any) -> Array:
        """Normals `[H, W, 3]` of `[N, H, W, 3]`, `[H, W]`; see `estimate_normals`."""
        return estimate_normals(self.network, images, mask, **options)

    def save_pretrained(
        self,
        folder: str | os.PathLike[str],
        *,
        license: str = "apache-2.0",
        record: Mapping[str, Any] | None = None,
    ) -> None:
        """Writes `config.json`, `model.safetensors` and, unless there is one, a card.

        `license`, of the weights, is for the card; `record`, how they were made, for
        the weights file.
        """
        folder, network = Path(folder), self.network
        if folder.resolve().name in SHIPPED:
            raise InputError(
                f"{folder}: expected another name than that of shipped weights, which "
                "from_pretrained would read"
            )
        make_folder(folder, "save_pretrained")
        kind = type(network.config).__name__
        text = {"library_name": "unips_jax", "kind": kind}
        text["config"] = json.loads(to_json(network.config))
        data = json.dumps(text, indent=1, sort_keys=True) + "\n"
        with filling(folder) as new:
            write_whole(new / CONFIG, data.encode())
            save_weights(new / WEIGHTS, network, record=record)
            if not (folder / CARD).exists():
                count = sum(leaf.size for leaf in jax.tree.leaves(network.params)) / 1e6
                card = _CARD.format(
                    license=license,
                    name=folder.resolve().name,
                    count=count,
                    digest=weights_hash(network)[:8],
                )
                write_whole(new / CARD, card.encode())

    @classmethod
    def from_pretrained(cls, source: str | os.PathLike[str]) -> Self:
        """Reads shipped weights, a weights file, a folder, or a name of a hub."""
        folder = Path(source)
        a_file = folder.suffix == ".safetensors" or folder.is_file()
        if str(source) in SHIPPED or a_file:
            return cls(load_weights(source))
        if not folder.is_dir():
            folder = _fetched(str(source))
        if not (folder / WEIGHTS).is_file():
            raise InputError(f"{source}: expected a folder with {WEIGHTS}, found none")
        return cls(load_weights(folder / WEIGHTS))


def _fetched(name: str) -> Path:
    """The folder of a model of the hub, `user/name`."""
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", name):
        raise InputError(
            f"{name}: expected one of {', '.join(SHIPPED)}, a weights file, a folder, "
            "or user/name of a model hub; found no such thing"
        )
    try:
        import huggingface_hub
    except ImportError:
        raise InputError(
            f"{name}: expected a folder, found none; a hub's model needs "
            "`pip install huggingface_hub`"
        ) from None
    try:
        wanted = [CONFIG, WEIGHTS, CARD]
        return Path(huggingface_hub.snapshot_download(name, allow_patterns=wanted))
    except Exception as error:  # of many kinds: no network, no such model, no access
        raise InputError(f"{name}: cannot be fetched: {error}") from error
