"""`unips demo`, with a stand-in for the network."""

import json
import re

import cv2
import numpy as np

from unips_jax import weights
from unips_jax.cli import demo
from unips_jax.estimation import streaming
from unips_jax.models.config import ModelConfig
from unips_jax.models.network import UniversalNetwork

FOLDER = demo.SAMPLE / "obj000.data"


def angles(normals, truth):
    length = np.linalg.norm(normals, axis=-1) * np.linalg.norm(truth, axis=-1)
    cosine = np.sum(normals * truth, axis=-1) / length
    return np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))


def test_what_the_demo_says_of_its_normals_is_true(tmp_path, monkeypatch, capsys):
    coded = cv2.imread(str(FOLDER / "normal.tif"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    truth = 2 * (coded / 65535) - 1
    inside = abs(np.linalg.norm(truth, axis=-1) - 1) < 1e-3
    seen = {}

    def stand_in(network, images, mask, *, transfer, frame, **others):
        seen.update(images=images, mask=mask, transfer=transfer, frame=frame)
        mirrored = truth * [-1, 1, 1] + [0, 0, 0.2]
        mirrored /= np.linalg.norm(mirrored, axis=-1, keepdims=True)
        normals = (mirrored * mask[..., None]).astype(np.float32)
        return streaming.NormalsAndLights(normals, None)

    monkeypatch.setattr(streaming, "estimate_with_lights", stand_in)
    network = UniversalNetwork(ModelConfig.tiny(), {})
    monkeypatch.setattr(weights, "load_weights", lambda name: network)
    target = tmp_path / "out"
    assert demo.main(["-o", str(target)]) == 0
    np.testing.assert_array_equal(seen["mask"], inside)
    first = cv2.imread(str(FOLDER / "L_00.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    np.testing.assert_array_equal(seen["images"][0], first)
    assert (seen["transfer"], seen["frame"]) == ("linear", "mask")

    written = np.load(target / "normals.npy")[inside]
    error = angles(written, truth[inside]).mean()
    constant = angles(np.array([0, 0, 1.0]), truth[inside]).mean()
    record = json.loads((target / "normals.json").read_text())
    np.testing.assert_allclose(record["mae_deg"], error, rtol=1e-3)
    np.testing.assert_allclose(record["constant_mae_deg"], constant, rtol=1e-3)
    printed = re.findall(r"[\d.]*\d", capsys.readouterr().out.splitlines()[-1])
    assert printed == ["8", f"{error:.2f}", f"{constant:.2f}"]
    # In the sheets' middle, red is mirrored between estimate and truth, green is not.
    sheets = [cv2.imread(str(target / f"{name}.png")) for name in ("sheet", "truth")]
    red, true_red = (sheet[84:820, 792:1528, 2].astype(float) for sheet in sheets)
    green, true_green = (sheet[84:820, 792:1528, 1].astype(float) for sheet in sheets)
    bright = sheets[1][84:820, 792:1528, 0] > 120  # the object: blue is high
    assert np.corrcoef(red[bright], true_red[bright])[0, 1] < -0.95
    assert np.corrcoef(green[bright], true_green[bright])[0, 1] > 0.95
    # The truth's own red grows to the right, as on any object that stands out.
    assert np.corrcoef(true_red[bright], np.nonzero(bright)[1])[0, 1] > 0.3
    # The mirrored normals err most where the true ones lean far to either side.
    block = sheets[0][84:820, 28 + 3 * 764 :][:, :736].sum(axis=-1, dtype=float)
    bright[-20:] = False  # the key to the colours
    assert np.corrcoef(block[bright], abs(true_red - 128)[bright])[0, 1] > 0.7
