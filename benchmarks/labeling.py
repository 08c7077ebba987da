"""How long labelers take for one hand on one core, matching included, whatever runs them.

python -m benchmarks.labeling [--frames 2000] [--cnn RUN]

RUN is a folder that handsim train --labeler cnn wrote; without it the paper's network is timed untrained, so
that it tries every view.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime
import torch

from benchmarks.record import Figures, add_save, describe, save_figures
from train.config import CNNConfig
from train.data.augmentation import Corruption, corrupt
from train.glove_labeler import load_labeler
from train.labelers.depth_image import depth_images
from train.labelers.kinds import labeler_of, new_network
from train.labelers.onnx_labeler import OnnxLabeler, export_onnx
from train.labelers.storage import load_network
from train.labelers.views import principal_axes
from train.simulation.held_out import held_out_markers


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--cnn", type=Path)
    add_save(parser)
    options = parser.parse_args()
    count = options.frames
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    print(describe("torch", "onnxruntime", "scipy"))
    markers = held_out_markers("dense19", count, seed=0)
    cloud = corrupt(markers, Corruption(), rng=np.random.default_rng(0))
    frames = [points[here] for points, here in zip(cloud.points, cloud.present, strict=True)]
    network, card = load_network("dense19")
    names = tuple(card["marker_names"])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "dense19.onnx"
        export_onnx(network, names, path)
        onnx = OnnxLabeler(path)
        cnn = new_network(CNNConfig()) if options.cnn is None else load_network(options.cnn)[0]
        export_onnx(cnn, names, Path(folder) / "cnn.onnx")
        paper_onnx = OnnxLabeler(Path(folder) / "cnn.onnx")
        images = convolutions(cnn, Path(folder) / "cnn.onnx")
    labeler, paper = load_labeler("dense19"), labeler_of(cnn, names)
    few = frames[: max(1, count // 20)]
    runs: dict[str, tuple[Callable[[np.ndarray], object], list[np.ndarray]]] = {
        "set labeler, onnxruntime": (lambda frame: onnx.label_frames([frame]), frames),
        "set labeler, numpy": (lambda frame: labeler.label_frames([frame]), frames),
        "paper's network, torch": (lambda frame: paper.label_frames([frame]), few),
        "paper's network, onnxruntime": (lambda frame: paper_onnx.label_frames([frame]), few),
        "- one image, torch": (lambda _: images["torch"](), few),
        "- one image, onnxruntime": (lambda _: images["onnxruntime"](), few),
        "- eight images, torch": (lambda _: images["torch, eight"](), few),
        "- eight images, onnxruntime": (lambda _: images["onnxruntime, eight"](), few),
    }
    print("one hand at a time, one thread                p50       p99 [ms]")
    figures: Figures = {}
    for name, (label, clouds) in runs.items():
        p50, p99 = np.percentile(measure(label, clouds), [50, 99])
        if name.startswith("set labeler"):
            key = name.split(", ")[1].removesuffix("runtime")
            figures[key] = (f"{name}, one hand on one core: p50 and p99 [ms]", [p50, p99])
        print(f"{name:40} {p50:8.2f} {p99:9.2f}")
    for name, batched in {"onnxruntime": onnx, "torch": labeler}.items():
        start = time.perf_counter()
        batched.label_frames(frames)
        milliseconds = 1e3 * (time.perf_counter() - start) / count
        print(f"set labeler, {name}, in batches: {milliseconds:.2f} ms a hand")
        key = f"batch_{name.removesuffix('runtime')}"
        figures[key] = (f"set labeler in batches, {name} [ms per hand]", milliseconds)
    save_figures(options.save, figures)


def convolutions(cnn: torch.nn.Module, path: Path) -> dict[str, Callable[[], object]]:
    """The paper's network on one image and on eight."""
    points = held_out_markers("dense19", 8, seed=1)
    present = np.ones(points.shape[:2], dtype=bool)
    images = depth_images(points, present, principal_axes(points, present))[0][:, None]
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])

    @torch.inference_mode()
    def torch_run(count: int) -> object:
        return cnn(torch.from_numpy(images[:count]))

    return {
        "torch": lambda: torch_run(1),
        "torch, eight": lambda: torch_run(8),
        "onnxruntime": lambda: session.run(None, {"images": images[:1]}),
        "onnxruntime, eight": lambda: session.run(None, {"images": images}),
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
