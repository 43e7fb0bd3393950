"""Images per second of DINOv2 ViT-S/14 on a CPU, every candidate in one process, and their drift from float32."""

import time
import warnings

import numpy as np
import onnxruntime
import openvino
import torch
from measure import OUT, report

from lerobot_constructskill.features.encode import load_encoder
from lerobot_constructskill.policies.frozen_vit.backbones import IMAGE_SIZE
from lerobot_constructskill.policies.frozen_vit.openvino import OpenVINOEncoder, Traceable
from lerobot_constructskill.policies.frozen_vit.precision import PRECISIONS, is_native

BATCH, ROUNDS = 16, 5
TARGET = 2


def candidates(encoder, pixels):
    """Name to a function that returns the pooled features of `pixels`."""
    model, encode = encoder.model, encoder.spec.encode
    compiled = torch.compile(encode)

    def autocast(function):
        with torch.autocast("cpu", dtype=torch.bfloat16):
            return function(model, pixels)[0].float()

    ours = {p: OpenVINOEncoder(model, encode, IMAGE_SIZE, p) for p in PRECISIONS if is_native(p, "cpu")}
    return {
        "PyTorch float32 eager": lambda: encode(model, pixels)[0],
        "PyTorch bfloat16 autocast": lambda: autocast(encode),
        "torch.compile bfloat16 autocast": lambda: autocast(compiled),
        "ONNX Runtime float32": onnx_runtime(encoder, pixels),
        "OpenVINO float32, the batch at once": openvino_float32(encoder, pixels),
        **{f"OpenVINO {p} (ours)": lambda own=own: own(pixels)[0] for p, own in ours.items()},
    }


def onnx_runtime(encoder, pixels):
    file = OUT / "encoder.onnx"
    torch.onnx.export(Traceable(encoder.model, encoder.spec.encode), (pixels,), file, dynamo=False)
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    name = session.get_inputs()[0].name
    return lambda: torch.from_numpy(session.run(None, {name: pixels.numpy()})[0])


def openvino_float32(encoder, pixels):
    graph = openvino.convert_model(Traceable(encoder.model, encoder.spec.encode), example_input=pixels)
    compiled = openvino.Core().compile_model(graph, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    return lambda: torch.from_numpy(compiled([pixels.numpy()])[0])


def seconds(function) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


@torch.inference_mode()
def main() -> None:
    warnings.simplefilter("ignore")
    encoder, _ = load_encoder("dinov2_vits14")
    images = torch.from_numpy(np.random.default_rng(0).random((BATCH, 3, IMAGE_SIZE, IMAGE_SIZE), dtype=np.float32))
    functions = candidates(encoder, encoder.preprocess(images))
    features = {name: function().clone() for name, function in functions.items()}
    times = {name: min(seconds(function) for _ in range(ROUNDS)) for name, function in functions.items()}
    baseline, *_, ours = functions
    for name in functions:
        drift = (features[name] - features[baseline]).norm() / features[baseline].norm()
        note = f"drift of the features from float32: {drift:.1e}"
        what = f"encoder images/s on CPU, {name}, batch {BATCH}"
        target = TARGET if name == ours else None
        report(what, BATCH / times[name], baseline, BATCH / times[baseline], target, note)


if __name__ == "__main__":
    main()
