"""How a run went over the samples it saw; kept in its checkpoint, so that a resumed run knows all of it."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(slots=True)
class History:
    """Loss, learning rate and held-out accuracy, and the steps that wait for the next entry."""

    losses: list[tuple[int, float, float]] = field(default_factory=list)
    """Samples done, mean loss of the steps since the entry before, learning rate of the last of them."""
    accuracies: list[tuple[int, float]] = field(default_factory=list)
    """Samples done, slot accuracy on some held-out frames with the paper's corruption."""
    waiting: float = 0.0
    """Sum of the losses of the steps that no entry counts yet."""
    steps: int = 0
    """How many those are."""

    def add(self, loss: float) -> None:
        """Count a step."""
        self.waiting += loss
        self.steps += 1

    def close(self, done: int, rate: float) -> float:
        """Make an entry of the steps since the last one, at least one; their mean loss."""
        mean = self.waiting / self.steps
        self.losses.append((done, mean, rate))
        self.waiting, self.steps = 0.0, 0
        return mean
