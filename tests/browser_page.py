"""The page that runs in a browser alone: built, served, opened, its mask drawn."""

import base64
import contextlib
import functools
import http.server
import mimetypes
import os
import runpy
import shutil
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from browser import ABSENT, messages
from small_networks import SHALLOW_OURS, lively_network

from unips_jax.weights import save_weights

NEEDED = [
    pytest.mark.skipif(ABSENT, reason="chromium and its driver are not installed"),
    pytest.mark.skipif(
        shutil.which("npm") is None and "CI" not in os.environ,
        reason="npm is not installed",
    ),
]
TOOLS = Path(__file__).resolve().parents[1] / "tools"
with pytest.MonkeyPatch.context() as patched:
    patched.syspath_prepend(TOOLS)
    build = runpy.run_path(str(TOOLS / "build_browser_page.py"))["main"]
# Nothing but the test's own server is found.
ALONE = "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"
PATIENCE_S = 1200  # several processes may share two cores
STATUS = "document.getElementById('status').textContent"
SETTLED = f"/found|stands out|is not the object/.test({STATUS})"
DROP = """
const transfer = new DataTransfer();
for (const [name, type, text] of arguments[0]) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  transfer.items.add(new File([bytes], name, { type }));
}
document.getElementById("status").textContent = "";
document.dispatchEvent(
  new DragEvent("drop", { dataTransfer: transfer, cancelable: true }));
"""


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *arguments):
        pass


def build_small(work):
    """The page with small networks: its folder, and the file of its weights."""
    weights = work / "small.safetensors"
    save_weights(weights, lively_network(SHALLOW_OURS), half=True)
    if build([str(work / "out"), "--weights", str(weights)]) != 0:
        assert "CI" not in os.environ
        pytest.skip("npm cannot fetch the page's packages")
    _find_what_is_bright(work / "out" / "network" / "mask.onnx")
    return work / "out", weights


@contextlib.contextmanager
def finding_objects(page):
    """With the network that finds objects as it ships, which takes seconds."""
    shipped = TOOLS.parent / "unips_jax" / "assets" / "salient_object.onnx"
    network = page / "network" / "mask.onnx"
    before = network.read_bytes()
    network.write_bytes(shipped.read_bytes())
    yield
    network.write_bytes(before)


def _find_what_is_bright(path):
    """Writes a network: where all channels are dark is no object."""
    from onnx import TensorProto, helper, save

    graph = helper.make_graph(
        [
            helper.make_node("ReduceMax", ["x"], ["bright"], axes=[1], keepdims=1),
            helper.make_node("Add", ["bright", "at"], ["above"]),
            helper.make_node("Mul", ["above", "steep"], ["sure"]),
            helper.make_node("Sigmoid", ["sure"], ["y"]),
        ],
        "bright",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, 320, 320])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 1, 320, 320])],
        [
            helper.make_tensor("at", TensorProto.FLOAT, [], [1.5]),
            helper.make_tensor("steep", TensorProto.FLOAT, [], [40]),
        ],
    )
    opset = [helper.make_opsetid("", 13)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=8)
    save(model, path)


@contextlib.contextmanager
def opened(driver, page):
    """Opens the page as any static host serves it; nothing kept from another test."""
    handler = functools.partial(Quiet, directory=page)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        messages(driver)
        driver.get(f"http://127.0.0.1:{server.server_port}/")  # a port, a storage
        until(driver, "return crossOriginIsolated && !!window.unips")
        yield
        driver.get("about:blank")
        server.shutdown()


def until(driver, condition):
    end = time.monotonic() + PATIENCE_S
    while not driver.execute_script(condition):
        status = driver.execute_script("return document.body.innerText")
        assert time.monotonic() < end, f"{status}\n{messages(driver)}"
        time.sleep(0.1)


def drop(page, paths):
    files = [
        [
            path.name,
            mimetypes.guess_type(path)[0] or "",
            base64.b64encode(path.read_bytes()).decode(),
        ]
        for path in paths
    ]
    page.execute_script(DROP, files)


def drop_and_wait(page, paths):
    drop(page, paths)
    until(page, f"return {SETTLED}")


def overlap(a, b):
    return (a & b).sum() / (a | b).sum()


def mask_of(driver, shape):
    values = driver.execute_script("return [...unips.state.mask]")
    return np.array(values, bool).reshape(shape)


def drag(driver, tool, *places):
    """Chooses a tool and draws with it, between places in pixels of the photograph."""
    driver.execute_script(
        """
        const [tool, places] = arguments;
        const button = document.querySelector(`[data-tool=${tool}]`);
        if (button.getAttribute("aria-pressed") !== "true") button.click();
        const canvas = document.getElementById("photograph");
        const box = canvas.getBoundingClientRect();
        const send = (kind, [x, y]) => canvas.dispatchEvent(new PointerEvent(kind, {
          pointerId: 1, isPrimary: true, button: 0, bubbles: true, cancelable: true,
          clientX: box.left + x * box.width / canvas.width / unips.editor.step,
          clientY: box.top + y * box.height / canvas.height / unips.editor.step }));
        canvas.setPointerCapture = () => {};
        send("pointerdown", places[0]);
        for (const place of places.slice(1)) send("pointermove", place);
        send("pointerup", places.at(-1));
        """,
        tool,
        [[int(x), int(y)] for x, y in places],
    )
