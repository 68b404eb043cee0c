"""What the page for a browser alone computes beside the network, without a browser."""

from pathlib import Path

import numpy as np
import pytest
from node_calls import in_node, printed, typed

from unips_jax.io.masks import lit_pixels

SOURCE = Path(__file__).resolve().parents[2] / "tools" / "browser"


@pytest.mark.parametrize("transfer", ["srgb", "linear"])
@pytest.mark.parametrize(("white", "kept"), [(255, 15), (150, 30)])
def test_black_is_that_of_the_command(transfer, white, kept):
    brightest = np.full((5, 9), white, np.uint8)
    brightest[:, :3], brightest[:, 3:6] = 0, 30
    found = in_node(
        SOURCE / "photographs.js",
        "leaveOut",
        typed(np.ones(45), "Uint8Array"),
        [dict(width=9, height=5, channels=1, top=255, alpha=None)],
        typed(brightest, "Uint8Array"),
        transfer,
    )
    expected = lit_pixels(brightest, transfer, np.ones((5, 9), bool))
    np.testing.assert_array_equal(np.reshape(found, (5, 9)), expected)
    assert expected.sum() == (kept if transfer == "srgb" else 30)


ANSWERED = """
import { readFileSync } from "node:fs";
const [file] = process.argv.slice(1);
const answer = JSON.parse(readFileSync(0, "utf8"));
const listeners = {};
globalThis.self = {
  location: { origin: "http://here" },
  addEventListener: (name, listener) => (listeners[name] = listener),
};
globalThis.fetch = async () => answer;
new Function(readFileSync(file, "utf8"))();
let given;
const event = { request: { url: "http://here/index.html" } };
listeners.fetch({ ...event, respondWith: (promise) => (given = promise) });
const found = await given;
const same = found === answer;
console.log(JSON.stringify([same, same ? 0 : [...found.headers].length]));
"""


@pytest.mark.parametrize(("status", "same"), [(0, True), (200, False)])
def test_a_redirect_passes_the_worker_that_adds_headers(status, same):
    """A navigation's comes with the status 0, which no answer may have."""
    answer = {"type": "opaqueredirect", "status": status, "headers": {}, "body": None}
    arguments = ["--input-type=module", "-e", ANSWERED, str(SOURCE / "isolate.js")]
    found = printed(arguments, answer)
    assert found[0] == same and (same or found[1] == 3)


@pytest.mark.parametrize("transfer", ["srgb", "linear"])
def test_photographs_are_averaged_over_squares_in_linear_light(transfer):
    values = np.random.default_rng(0).integers(0, 256, (2, 5, 7, 3))
    mask = np.random.default_rng(1).random((5, 7)) < 0.6
    files = [
        dict(width=7, height=5, channels=3, top=255, values=typed(v, "Uint8Array"))
        for v in values
    ]
    found = in_node(
        SOURCE / "photographs.js",
        "linearImages",
        files,
        typed(mask, "Uint8Array"),
        transfer,
        2,
    )
    light = values / 255
    if transfer == "srgb":
        high = ((light + 0.055) / 1.055) ** 2.4
        light = np.where(light <= 0.04045, light / 12.92, high)
    expected = light[:, :4, :6].reshape(2, 2, 2, 3, 2, 3).mean(axis=(2, 4))
    np.testing.assert_allclose(found["images"], expected.ravel(), atol=1e-6)
    share = mask[:4, :6].reshape(2, 2, 3, 2).mean(axis=(1, 3))
    assert found["mask"] == (share > 0.5).astype(int).ravel().tolist()
    assert (found["width"], found["height"]) == (3, 2)


def test_the_pages_depth_is_the_surface():
    """Of an ellipsoid beside the middle."""
    rows, columns = np.mgrid[:120, :140]
    x, y = (columns - 60) / 45, -(rows - 70) / 36
    inside = x**2 + y**2 < 0.8
    z = np.sqrt(np.where(inside, 1 - x**2 - y**2, 1))
    normals = np.stack([x, y / 0.8, z], -1)
    normals *= inside[..., None] / np.linalg.norm(normals, axis=-1, keepdims=True)
    found = in_node(SOURCE / "surface.js", "depthOf", typed(normals), 140, 120)
    off = (np.reshape(found, (120, 140)) + 45 * z)[inside]
    assert np.ptp(45 * z[inside]) > 20
    assert np.abs(off - off.mean()).max() < 0.1  # measured: 0.004 in the mean


def test_alpha_that_is_0_everywhere_means_none():
    """As programs that know no alpha write it."""
    brightest, alpha = np.full(45, 200), np.zeros(45)
    for opaque in (0, 15):
        alpha[:opaque] = 255
        file = dict(width=9, height=5, channels=3, top=255)
        found = in_node(
            SOURCE / "photographs.js",
            "leaveOut",
            typed(np.ones(45), "Uint8Array"),
            [file | {"alpha": typed(alpha, "Uint8Array")}],
            typed(brightest, "Uint8Array"),
            "srgb",
        )
        assert sum(found) == (opaque or 45)
