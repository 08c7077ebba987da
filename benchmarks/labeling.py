"""How long labelers take for one hand on one core, matching included, whatever runs them.

python benchmarks/labeling.py [--frames 2000]
"""

from __future__ import annotations

import argparse
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from machine import describe

from train.config import SetLabelerConfig
from train.labelers.cnn_labeler import TrainedCNNLabeler
from train.labelers.cnn_network import DeepLabelCNN
from train.labelers.kinds import new_network
from train.labelers.onnx_labeler import OnnxLabeler, export_onnx
from train.labelers.set_labeler import TrainedSetLabeler
from train.labelers.set_network import LabelScores
from train.labelers.storage import load_labeler, load_network


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=2000)
    count = parser.parse_args().frames
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    print(describe("torch", "onnxruntime", "scipy"))
    rng = np.random.default_rng(0)
    frames = [rng.uniform(-0.06, 0.06, size=(rng.integers(14, 22), 3)) for _ in range(count)]
    network, card = load_network("dense19")
    names = tuple(card["marker_names"])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "dense19.onnx"
        export_onnx(network, names, path)
        onnx = OnnxLabeler(path)
        cnn = new_network("cnn", SetLabelerConfig())
        images = convolutions(cnn, Path(folder) / "cnn.onnx")
    traced = TrainedSetLabeler(TracedNetwork(network), names)
    labeler, paper = load_labeler("dense19"), TrainedCNNLabeler(cnn, names)
    few = frames[: max(1, count // 20)]
    runs: dict[str, tuple[Callable[[np.ndarray], object], list[np.ndarray]]] = {
        "set labeler, onnxruntime": (lambda frame: onnx.label_frames([frame]), frames),
        "set labeler, torch traced": (lambda frame: traced.label_frames([frame]), frames),
        "set labeler, torch": (lambda frame: labeler.label_frames([frame]), frames),
        "paper's network, torch, both sides": (lambda frame: paper.label_frames([frame]), few),
        "- its convolutions alone, torch": (lambda _: images["torch"](), few),
        "- the same in bf16": (lambda _: images["bf16"](), few),
        "- the same, onnxruntime": (lambda _: images["onnxruntime"](), few),
    }
    print("one hand at a time, one thread                p50       p99 [ms]")
    for name, (label, clouds) in runs.items():
        p50, p99 = np.percentile(measure(label, clouds), [50, 99])
        print(f"{name:40} {p50:8.2f} {p99:9.2f}")
    for name, batched in {"onnxruntime": onnx, "torch": labeler}.items():
        start = time.perf_counter()
        batched.label_frames(frames)
        print(f"set labeler, {name}, in batches: {1e3 * (time.perf_counter() - start) / count:.2f} ms a hand")


class TracedNetwork(torch.nn.Module):
    """The set labeler without Python between its operations."""

    def __init__(self, network: torch.nn.Module) -> None:
        super().__init__()
        example = torch.randn(1, 20, 3), torch.ones(1, 20, dtype=torch.bool)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            traced = torch.jit.trace(network.eval(), example, strict=False, check_trace=False)
            self.traced = torch.jit.freeze(traced)

    def forward(self, points: torch.Tensor, present: torch.Tensor) -> LabelScores:
        """What the network gives."""
        return LabelScores(*self.traced(points, present))


def convolutions(cnn: DeepLabelCNN, path: Path) -> dict[str, Callable[[], object]]:
    """The paper's network on one image, run in three ways."""
    image = torch.rand(1, 1, 52, 52).to(memory_format=torch.channels_last)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(cnn.eval(), (image,), str(path), input_names=["image"], dynamo=False)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])

    def torch_run(bf16: bool) -> object:
        with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            return cnn(image)

    return {
        "torch": lambda: torch_run(False),
        "bf16": lambda: torch_run(True),
        "onnxruntime": lambda: session.run(None, {"image": image.numpy()}),
    }


def measure(label: Callable[[np.ndarray], object], frames: list[np.ndarray]) -> list[float]:
    """Milliseconds of each frame, after a few to warm up."""
    for frame in frames[:50]:
        label(frame)
    times = []
    for frame in frames:
        start = time.perf_counter()
        label(frame)
        times.append(1e3 * (time.perf_counter() - start))
    return times


if __name__ == "__main__":
    main()
