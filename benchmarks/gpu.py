"""What a graphics card is worth here: labels, training and pictures, on the CPU and on it.

    python -m benchmarks.gpu [--sections labels training pictures]
                             [--clouds 20000] [--samples 100000] [--frames 200]

labels: clouds a second in batches, the default labeler and the paper's network.
training: samples a second of both networks, on the CPU and on the card in 32 bits and in bf16.
pictures: 640 x 480 pictures of two hands a second, painted by compiled code and by OpenGL, in one process and
    in several: each has an OpenGL context of its own.

Where there is no card the same runs on the CPU, and OpenGL is Mesa's software.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import os
import tempfile
import time
import unittest.mock
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import torch

from benchmarks.held_out import held_out_markers
from benchmarks.record import describe
from benchmarks.rendering import COLORS, draw, rate, rate_in_processes
from benchmarks.training_scaling import train
from render.painting.opengl import _renderer_name, opengl_has_hardware
from train.data.batches import Corruption, corrupt
from train.labelers import networks
from train.labelers.networks import labeler_of, new_network
from train.labelers.protocol import Labeler
from train.labelers.storage import load_labeler
from train.settings import CNNConfig
from train.simulation.generation import make_dataset
from train.simulation.training_frames import GenerateSettings

SECTIONS: Final = ("labels", "training", "pictures")
CPU: Final = torch.device("cpu")
PROCESSES: Final = (1, 2, 4, 8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sections", nargs="+", choices=SECTIONS, default=SECTIONS)
    parser.add_argument("--clouds", type=int, default=20_000)
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--frames", type=int, default=200)
    options = parser.parse_args()
    print(describe("torch", "lightning-fabric"))
    card = torch.cuda.get_device_name(0) if torch.cuda.is_available() else "none"
    print(f"torch's card: {card}; OpenGL: {_renderer_name() or 'none'}")
    if "labels" in options.sections:
        labels(options.clouds)
    if "training" in options.sections:
        training(options.samples)
    if "pictures" in options.sections:
        pictures(options.frames)


def devices() -> list[torch.device]:
    return [CPU, torch.device("cuda")] if torch.cuda.is_available() else [CPU]


def labels(count: int) -> None:
    cloud = corrupt(held_out_markers("dense19", count, seed=0), Corruption(), rng=np.random.default_rng(0))
    frames = [points[here] for points, here in zip(cloud.points, cloud.present, strict=True)]
    few = frames[: max(1, count // 20)]  # the untrained network tries every view of a cloud
    names = load_labeler("dense19").marker_names
    makers: dict[str, tuple[Callable[[], Labeler], Sequence[np.ndarray]]] = {
        "default labeler": (lambda: load_labeler("dense19"), frames),
        "paper's network, untrained": (lambda: labeler_of(new_network(CNNConfig()), names), few),
    }
    for name, (make, clouds) in makers.items():
        for device in devices():
            networks.batch_device = lambda device=device: device
            labeler = make()
            labeler.label_frames(clouds[:512])  # to warm up
            start = time.perf_counter()
            labeler.label_frames(clouds)
            speed = len(clouds) / (time.perf_counter() - start)
            print(f"labels, {name}, {device.type}: {speed:.0f} clouds/s")


def training(samples: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        dataset = Path(folder) / "set"
        make_dataset(GenerateSettings(num_frames=20_000), dataset)
        plans = [("cpu", "32"), *((("cuda", "32"), ("cuda", "bf16")) if len(devices()) > 1 else ())]
        for kind, count in (("set", samples), ("cnn", samples // 20)):
            for device, precision in plans:
                options = ["--labeler", kind, "--samples", str(count), "--precision", precision]
                hidden = {"CUDA_VISIBLE_DEVICES": ""} if device == "cpu" else {}
                with unittest.mock.patch.dict(os.environ, hidden):
                    run = train(dataset, Path(folder) / f"{kind}-{device}-{precision}", 1, options)
                print(f"training, {kind}, {device}, precision {precision}: {run.speed:.0f} samples/s")


def pictures(frames: int) -> None:
    cores = os.cpu_count() or 1
    print(f"OpenGL on hardware: {'yes' if opengl_has_hardware() else 'no'}")
    for painter in ("compiled", "opengl"):
        config = dataclasses.replace(COLORS, painter=painter)
        job = functools.partial(draw, config, frames)
        alone = rate(lambda job=job: job(0), frames)
        counts = [count for count in PROCESSES if 1 < count <= cores]
        several = [f"{count}: {rate_in_processes(job, count, frames):.1f}" for count in counts]
        print(f"pictures a second, {painter}, by number of processes: 1: {alone:.1f}, {', '.join(several)}")


if __name__ == "__main__":
    main()
