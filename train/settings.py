"""Settings of labelers, their training and their evaluation; without torch, so that help is fast."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Final, Literal, get_args

from handsim.errors import ArgumentError
from handsim.settings import Expected, Limits, Settings
from train.data.batches import MAX_CHANGED, BatchRecipe, Corruption, OwnCorruption, paper_corruption

Kind = Literal["set", "cnn"]
"""`set` is the default labeler, `cnn` the paper's (`train.labelers.cnn_network`)."""
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
Preset = Literal["han2018"]
PRESETS: Final[tuple[Preset, ...]] = get_args(Preset)
EPOCHS: Final = 75
"""Passes of the paper's training through its frames."""
Views = Literal["aligned", "random"]
"""`aligned` turns every hand like the mean hand; `random` is the paper's policy: any view in training, and
for labeling the one of ten in which the cloud has the largest extent."""
_MAX_CLOUDS: Final = 1_000_000  # clouds in a batch


@dataclass(frozen=True, slots=True)
class SetLabelerConfig(Settings):
    """Size of the set labeler; a network beyond the limits would not fit into memory."""

    num_labels: Annotated[int, Limits(1, 1000)] = field(default=19, metadata={"follows": "the training set"})
    width: Annotated[int, Limits(1, 4096)] = 64
    """Channels of a point."""
    gates: Annotated[int, Limits(1, 4096)] = 16
    """Groups of message channels; the channels of a group share a gate."""
    depth: Annotated[int, Limits(1, 100)] = 5
    """Rounds of messages."""
    num_distances: Annotated[int, Limits(2, 1000)] = 24
    """Gaussian basis functions that encode a distance."""
    reach: Annotated[float, Limits(0.001, 10.0)] = 0.24
    """Largest distance [m] with a basis function of its own; a hand's markers span about this much."""

    def check(self) -> None:
        """Refuse gate groups of different sizes."""
        if self.width % self.gates:
            raise ArgumentError(f"gates is {self.gates}, expected a divisor of width, {self.width}")


@dataclass(frozen=True, slots=True)
class CNNConfig(Settings):
    """How the paper's network sees a cloud, and how labels follow from its predicted positions."""

    num_labels: Annotated[int, Limits(1, 1000)] = field(default=19, metadata={"follows": "the training set"})
    views: Views = "aligned"
    reject: Annotated[float | None, Limits(0.0, above=True)] = None
    """Cost of a point without a label [m]: no point is matched over a larger distance. Chosen on held-out
    simulated frames when not given."""
    spread: Annotated[float | None, Limits(0.0, above=True)] = None
    """Distance over which a label's weight in the confidence falls by e [m]; chosen likewise."""


NetworkConfig = SetLabelerConfig | CNNConfig


@dataclass(frozen=True, slots=True)
class TrainSettings(Settings):
    """How a labeler is trained; the defaults made the shipped weights."""

    noun = "setting of a training"

    labeler: Kind = "set"
    """Kind of network."""
    samples: Annotated[int, Limits(0)] = 5_000_000
    """Clouds to learn from; rows are used repeatedly, corrupted anew each time. 0 stands for the paper's 75
    epochs of the training set."""
    batch: Annotated[int, Limits(1, _MAX_CLOUDS)] = 256
    optimizer: Literal["adamw", "sgd"] = "adamw"
    learning_rate: Annotated[float, Limits(0.0, 10.0, above=True)] = 2e-3
    """Peak learning rate."""
    schedule: Literal["cosine", "steps"] = "cosine"
    """`cosine` warms up over the first hundredth and falls to zero as a half cosine; `steps` falls tenfold
    at 2/3 and 14/15 of the way, the paper's epochs 50 and 70 of 75."""
    weight_decay: Annotated[float, Limits(0.0, 10.0)] = 0.01
    average: Annotated[float, Limits(0.0, 1.0)] = 0.999
    """Decay of the running mean of the weights, which is what is saved; 0 saves the last weights."""
    average_every: Annotated[int, Limits(1)] = 1
    """Steps between two updates of that mean."""
    precision: Literal["auto", "32", "bf16"] = "32"
    """Precision of the forward pass; bf16 is faster on hardware that has it, and less accurate. `auto` takes
    it there."""
    jitter: Annotated[float, Limits(0.0, 0.1)] = 0.005
    """Largest half width of the uniform noise on each coordinate [m]; every batch draws its own."""
    rig_share: Annotated[float, Limits(0.0, 1.0)] = 0.5
    """Share of batches as seen by the simulated rig; the others get the paper's corruption."""
    occlude: Annotated[int | None, Limits(0, MAX_CHANGED)] = None
    """Most draws of a marker to drop in the paper's corruption; a quarter of the markers when not given, as
    in the paper for its 19 and 13 markers."""
    ghosts: Annotated[int, Limits(0, MAX_CHANGED)] = 2
    """Most ghosts added in the paper's corruption."""
    corruption: Annotated[
        OwnCorruption | str | None, Expected("a function (markers, *, rng), or its module:name")
    ] = None
    """A corruption of your own instead of the paper's: module:name, or the name of an entry point."""
    anisotropy: Annotated[float, Limits(0.0, 1.0)] = 0.06
    """Log standard deviation of the stretch of each hand along three random directions."""
    knee: Annotated[float, Limits(0.0, above=True)] = 0.02
    """Distance at which the loss of the paper's network turns from quadratic to linear [half an image's
    width]."""
    seed: Annotated[int, Limits(0)] = 0
    network: SetLabelerConfig = dataclasses.field(default_factory=SetLabelerConfig)
    cnn: CNNConfig = dataclasses.field(default_factory=CNNConfig)

    @property
    def chosen(self) -> NetworkConfig:
        """Settings of the network of the chosen kind."""
        return self.cnn if self.labeler == "cnn" else self.network

    def check(self) -> None:
        """Refuse settings of the other kind of network, and the paper's corruption besides a user's own."""
        is_given = {
            "network": self.network != SetLabelerConfig(self.network.num_labels),
            "cnn": self.cnn != CNNConfig(self.cnn.num_labels),
            "knee": self.changed("knee"),
        }
        of_others = ("network",) if self.labeler == "cnn" else ("cnn", "knee")
        given = [name for name in of_others if is_given[name]]
        if given:
            kind = next(one for one in KINDS if one != self.labeler)
            raise ArgumentError(
                f"given {' and '.join(given)} with the labeler {self.labeler}, expected the labeler {kind}"
            )
        if self.corruption is not None and self.changed("occlude", "ghosts"):
            raise ArgumentError("given occlude or ghosts beside a corruption, expected one of them")

    def for_set(self, num_markers: int, num_frames: int) -> TrainSettings:
        """The same settings for a training set of this size."""
        return dataclasses.replace(
            self,
            samples=self.samples or EPOCHS * num_frames,
            network=dataclasses.replace(self.network, num_labels=num_markers),
            cnn=dataclasses.replace(self.cnn, num_labels=num_markers),
        )


def batch_recipe(settings: TrainSettings, num_markers: int) -> BatchRecipe:
    """How batches are drawn for a layout of this many markers."""
    occlude = paper_corruption(num_markers).occlude if settings.occlude is None else settings.occlude
    own = settings.corruption
    corruption = Corruption(occlude, settings.ghosts) if own is None else own
    return BatchRecipe(settings.batch, corruption, settings.jitter, settings.rig_share, settings.anisotropy)


def usual_settings(labeler: Kind = "set", preset: Preset | None = None) -> TrainSettings:
    """Default settings of a kind of labeler, or those of a preset.

    `han2018` is section 3.3 of Han et al. 2018: plain SGD from 0.6, batches of 256, 75 epochs, random drops
    and ghosts, views from anywhere, a smooth L1 loss with its usual knee of one, and points matched over at
    most 15 mm. The paper does not give the jitter; ours is that of its published data (±3 mm). 16-bit
    precision, on hardware that has it, is not the paper's either.
    """
    if preset == "han2018":
        return TrainSettings(
            labeler="cnn",
            samples=0,
            optimizer="sgd",
            learning_rate=0.6,
            schedule="steps",
            weight_decay=0.0,
            average=0.0,
            precision="auto",
            jitter=0.003,
            rig_share=0.0,
            anisotropy=0.0,
            knee=1.0,
            cnn=CNNConfig(views="random", reject=0.015),
        )
    if labeler == "set":
        return TrainSettings()
    return TrainSettings(
        labeler="cnn",
        samples=300_000,
        batch=32,
        learning_rate=1e-3,
        average=0.99,
        average_every=16,
        precision="auto",
        jitter=0.003,
        rig_share=0.2,
    )


def train_settings(settings: TrainSettings | None, options: Mapping[str, Any]) -> TrainSettings:
    """Override settings by name; `labeler` alone selects its default settings."""
    if settings is None and options.get("labeler") in KINDS:
        settings = usual_settings(options["labeler"])
    return TrainSettings.of(settings, options)


@dataclass(frozen=True, slots=True)
class EvaluateSettings(Settings):
    """Frames on which a labeler is evaluated, and their corruption."""

    noun = "setting of an evaluation"

    occlude: Annotated[int, Limits(0, MAX_CHANGED)] = 0
    """Up to this many draws of a marker to drop, with replacement (the paper: 5 dense, 3 sparse)."""
    ghosts: Annotated[int, Limits(0, MAX_CHANGED)] = 0
    """Up to this many ghosts, uniform in the frame's box grown by a tenth (the paper: 2)."""
    every: Annotated[int, Limits(1)] = 1
    """Take one frame of this many of captures; 1 takes all."""
    seed: Annotated[int, Limits(0)] = 0
    """Seed of the corruption."""
