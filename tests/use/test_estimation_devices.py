"""Estimates on several devices, in meshes, and by the caller's settings."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from plain_objects import ellipse_photographs
from small_networks import SHALLOW, lively_network

from unips_jax import estimate_normals


@pytest.fixture(scope="module")
def network():
    return lively_network(SHALLOW)


def test_runs_inside_shard_map(network):
    images, masks = (x[None] for x in ellipse_photographs())
    mesh = jax.sharding.Mesh(jax.devices()[:1], "data")
    spec = jax.sharding.PartitionSpec("data")

    def run(images, masks):
        return estimate_normals(network, images[0], masks[0])[None]

    sharded = jax.jit(jax.shard_map(run, mesh=mesh, in_specs=spec, out_specs=spec))
    np.testing.assert_allclose(sharded(images, masks), run(images, masks), atol=1e-5)


def test_decoders_alone_may_differ_over_devices(network):
    """Several on one encoder."""
    images, mask = ellipse_photographs()
    mesh = jax.sharding.Mesh(jax.devices()[:1], "data")
    spec = jax.sharding.PartitionSpec("data")

    def run(decoders):
        decoder = jax.tree.map(lambda x: x[0], decoders)
        params = {**network.params, "decoder": decoder}
        own = dataclasses.replace(network, params=params)
        return estimate_normals(own, images, mask)[None]

    decoders = jax.tree.map(lambda x: x[None], network.params["decoder"])
    sharded = jax.shard_map(run, mesh=mesh, in_specs=spec, out_specs=spec)
    assert jax.eval_shape(sharded, decoders).shape == (1, *mask.shape, 3)


ELSEWHERE = """
import sys
import jax
import numpy as np
jax.config.update("jax_num_cpu_devices", 2)
sys.path.insert(0, sys.argv[1])
from jax.sharding import NamedSharding, PartitionSpec as P
from plain_objects import ellipse_photographs
from small_networks import SHALLOW, lively_network
from unips_jax import estimate_photographs
from unips_jax.estimation import programs

network, (images, mask) = lively_network(SHALLOW), ellipse_photographs()
expected = estimate_photographs(network, images, mask)
second = jax.devices()[1]
mesh = NamedSharding(jax.make_mesh((2,), ("n",)), P())
with jax.default_device(second):
    found = [estimate_photographs(network, images, mask)]
for place in (second, mesh):
    found.append(estimate_photographs(jax.device_put(network, place), images, mask))
for normals in found:
    np.testing.assert_allclose(normals, expected, atol=1e-6)
flags, seen = programs._flags, []
programs._flags = lambda: seen.append(flags()) or seen[-1]
with jax.default_matmul_precision("highest"):
    estimate_photographs(network, images, mask)
assert seen and all("highest" in each for each in seen), seen
"""


def test_photographs_are_estimated_by_the_callers_settings():
    """Its device, wherever the network lies, and its precision, in every thread."""
    here = str(Path(__file__).parents[1])
    run = subprocess.run(
        [sys.executable, "-c", ELSEWHERE, here], capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr


EXPLICIT = """
import sys
import jax
import jax.numpy as jnp
import numpy as np
jax.config.update("jax_num_cpu_devices", 2)
sys.path.insert(0, sys.argv[1])
from jax.sharding import AxisType, NamedSharding, PartitionSpec as P
from small_networks import SHALLOW, lively_network
from unips_jax import estimate_normals

network, mask = lively_network(SHALLOW), jnp.ones((16, 16), bool)
images = jax.random.uniform(jax.random.key(0), (4, 16, 16, 3))
expected = estimate_normals(network, images, mask)
for kind in (AxisType.Auto, AxisType.Explicit):
    mesh = jax.make_mesh((2,), ("n",), axis_types=(kind,))
    split = [jax.device_put(x, NamedSharding(mesh, P("n"))) for x in (images, mask)]
    for given in ((split[0], mask), (images, split[1])):
        try:
            found = estimate_normals(network, *given)
        except ValueError as error:
            print(kind, error)
        else:
            np.testing.assert_allclose(found, expected, atol=1e-5)
            print(kind, "right")
"""


def test_meshes_of_explicit_axes_are_refused_in_one_line():
    here = str(Path(__file__).parents[1])
    run = subprocess.run(
        [sys.executable, "-c", EXPLICIT, here], capture_output=True, text=True
    )
    *auto, of_images, of_mask = run.stdout.splitlines()
    assert len(auto) == 2 and all(line.endswith("Auto right") for line in auto)
    for line, name in ((of_images, "images"), (of_mask, "mask")):
        assert f"{name}: expected a mesh of AxisType.Auto, got Explicit axes" in line
