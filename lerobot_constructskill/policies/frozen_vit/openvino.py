"""A backbone on a CPU through OpenVINO: faster than PyTorch, and blind to how images are batched."""

import importlib.util
import sys
import warnings
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lerobot_constructskill.threads import threads

from .weights import Encode

HINTS = {"float32": "f32", "bfloat16": "bf16"}


def is_installed() -> bool:
    return importlib.util.find_spec("openvino") is not None


def import_openvino() -> ModuleType:
    """Import OpenVINO without the package that pip installs beside it, which reports conversions over the network."""
    sys.modules.setdefault("openvino_telemetry", None)  # an import of it now fails, which OpenVINO takes for absent
    import openvino

    return openvino


class OpenVINOEncoder:
    """A backbone compiled for this CPU.

    Every image is a request of its own and several are in flight at once. So an image's feature is the same to the
    last bit whatever other images, and however many threads, it is computed with: ten policies in lockstep see what
    each would see alone. `benchmarks/encoders.py` compares it with the alternatives.

    Args:
        model: the backbone, with its weights; later changes of them are not seen.
        encode: `Backbone.encode`.
        image_size: height and width of its input, in pixels.
        precision: one of `precision.PRECISIONS` that this CPU does natively.
    """

    def __init__(self, model: nn.Module, encode: Encode, image_size: int, precision: str):
        openvino = import_openvino()
        example = torch.zeros(1, 3, image_size, image_size)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # tracing warns of every shape that it takes for a constant
            graph = openvino.convert_model(Traceable(model, encode), example_input=example)
        graph.reshape(list(example.shape))
        settings = {
            "INFERENCE_PRECISION_HINT": HINTS[precision],
            "INFERENCE_NUM_THREADS": threads(),
            "PERFORMANCE_HINT": "THROUGHPUT",
        }
        self._requests = openvino.AsyncInferQueue(openvino.Core().compile_model(graph, "CPU", settings))

    def __call__(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Return the pooled features (B, D) and the patch features (B, N, D), float32, of pixels (B, 3, H, W)."""
        images = pixels.numpy()
        shapes = [tuple(output.shape)[1:] for output in self._requests[0].model_outputs]
        outputs = [np.empty((len(images), *shape), dtype=np.float32) for shape in shapes]

        def keep(request: Any, i: int) -> None:
            for number, output in enumerate(outputs):
                output[i] = request.get_output_tensor(number).data[0]

        self._requests.set_callback(keep)
        for i in range(len(images)):
            self._requests.start_async([images[i : i + 1]], i)
        self._requests.wait_all()
        pooled, patches = map(torch.from_numpy, outputs)
        return pooled, patches


class Traceable(nn.Module):
    """A backbone and its `encode` as the one module that tracers want."""

    def __init__(self, model: nn.Module, encode: Encode):
        super().__init__()
        self.model, self.encode = model, encode

    def forward(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        return self.encode(self.model, pixels)
