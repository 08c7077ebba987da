"""The history of a training run; it is kept in the checkpoint, so that a resumed run has all of it."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(slots=True)
class History:
    """Loss, learning rate and held-out accuracy, and the steps since the last entry."""

    losses: list[tuple[int, float, float]] = field(default_factory=list)
    """Samples done, mean loss of the steps since the previous entry, learning rate of the last of them."""
    accuracies: list[tuple[int, float, float]] = field(default_factory=list)
    """Samples done, minutes of steps until then, slot accuracy on some held-out frames with the paper's
    corruption."""
    minutes: float = 0.0
    """Time of all steps."""
    waiting: float = 0.0
    """Sum of the losses of the steps that are in no entry yet."""
    steps: int = 0
    """Number of those steps."""

    def add(self, loss: float) -> None:
        """Count a step."""
        self.waiting += loss
        self.steps += 1

    def close(self, done: int, rate: float) -> float:
        """Make an entry of the steps since the last one (at least one) and return their mean loss."""
        mean = self.waiting / self.steps
        self.losses.append((done, mean, rate))
        self.waiting, self.steps = 0.0, 0
        return mean
