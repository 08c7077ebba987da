"""Train a network that finds 21 keypoints of a hand on pictures that are drawn while it learns.

    python examples/14_train_a_keypoint_network.py [STEPS]     # 20 by default, too few to learn much

No picture touches the disk. docs/picture_quality.md has figures of longer trainings, on photographs.
"""

from __future__ import annotations

import itertools
import sys

import torch
from torch import nn
from torch.nn import functional
from torch.utils.data import DataLoader

from render import PictureStream, RenderConfig

SIZE, BATCH = 64, 16  # pixels of a picture each way, pictures of a step


def pictures(seed: int, workers: int) -> DataLoader[dict[str, torch.Tensor]]:
    """Batches without end: another person, light, background and view in every picture."""
    stream = PictureStream(config=RenderConfig(passes=("rgb",)), crop=SIZE, batch=BATCH, seed=seed)
    return DataLoader(stream, batch_size=BATCH, num_workers=workers)


def network() -> nn.Module:
    """From pictures (B, 3, 64, 64) to heat maps (B, 21, 16, 16)."""
    widths, layers = (3, 32, 64, 128), []
    for number, (inside, outside) in enumerate(itertools.pairwise(widths)):
        stride = 2 if number < 2 else 1
        layers += [nn.Conv2d(inside, outside, 5, stride, 2), nn.BatchNorm2d(outside), nn.ReLU()]
    return nn.Sequential(*layers, nn.Conv2d(widths[-1], 21, 5, 1, 2))


def find(model: nn.Module, batch: dict[str, torch.Tensor]) -> torch.Tensor:
    """Keypoints (B, 21, 2) [px]: the mean place of each heat map."""
    heat = model(batch["noisy_rgb"].float() / 255.0 - 0.5)
    share = functional.softmax(heat.flatten(2), dim=2).unflatten(2, heat.shape[2:])
    at = (torch.arange(heat.shape[3]) + 0.5) * (SIZE / heat.shape[3])
    return torch.stack([(share.sum(2) * at).sum(2), (share.sum(3) * at).sum(2)], dim=2)


def main() -> None:
    steps = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    torch.manual_seed(0)
    model = network()
    optimizer = torch.optim.AdamW(model.parameters(), lr=2e-3)
    for step, batch in enumerate(itertools.islice(pictures(seed=0, workers=2), steps), start=1):
        loss = functional.smooth_l1_loss(find(model, batch), batch["keypoints"])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % max(1, steps // 4) == 0:
            print(f"{step * BATCH} pictures, loss {loss.item():.2f}")
    others = next(iter(pictures(seed=1, workers=0)))
    with torch.inference_mode():
        off = (find(model.eval(), others) - others["keypoints"]).norm(dim=2)
    print(f"keypoints of other hands: {off.mean():.1f} of {SIZE} px off")


if __name__ == "__main__":
    main()
