"""Settings of the labelers and their training; without torch, so that a command's help is fast."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

import numpy as np

from handsim._checks import check_callable, check_choice, check_count, check_number, fill_settings
from handsim._plugins import plugin_name
from handsim.errors import ArgumentError, HandSimError
from train.data.batches import BatchRecipe, Corruption, OwnCorruption, paper_corruption

Kind = Literal["set", "cnn"]
"""`set` is the default labeler (`train.labelers.networks`), `cnn` the paper's
(`train.labelers.cnn_network`)."""

KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
_MOST_CLOUDS: Final = 1_000_000  # in a batch
_MOST_POINTS: Final = 100  # to add to a cloud or drop from it


@dataclass(frozen=True, slots=True)
class SetLabelerConfig:
    """Size of the set labeler."""

    num_labels: int = 19
    width: int = 64
    """Channels of a point."""
    gates: int = 16
    """Groups of message channels; the channels of a group share a gate."""
    depth: int = 5
    """Rounds of messages."""
    num_distances: int = 24
    """Gaussian basis functions that encode a distance."""
    reach: float = 0.24
    """Largest distance [m] with a basis function of its own; a hand's markers span about this much."""

    def __post_init__(self) -> None:
        for name, (low, high) in _SIZES.items():
            check_count(name, getattr(self, name), low, high)
        if self.width % self.gates:
            raise ArgumentError(f"gates is {self.gates}, expected a divisor of width, {self.width}")
        check_number("reach", self.reach, 0.001, 10.0)


_SIZES: Final = {  # least and greatest; a network beyond these would not fit into memory
    "num_labels": (1, 1000),
    "width": (1, 4096),
    "gates": (1, 4096),
    "depth": (1, 100),
    "num_distances": (2, 1000),
}


Views = Literal["aligned", "random"]
"""`aligned` turns every hand like the mean hand; `random` is the paper's policy: any view in training, and
for labeling the one of ten on which the cloud spreads best."""


@dataclass(frozen=True, slots=True)
class CNNConfig:
    """How the paper's network sees a cloud, and how labels follow from the positions that it predicts."""

    num_labels: int = 19
    views: Views = "aligned"
    reject: float | None = None
    """Cost of a point without a label [m]: no point is matched over a larger distance. Chosen on held-out
    simulated frames when not given."""
    spread: float | None = None
    """Distance over which a label's weight in the confidence falls by a factor of e [m]; chosen likewise."""

    def __post_init__(self) -> None:
        for name in ("reject", "spread"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < np.inf:
                raise HandSimError(f"{name} is {value}, expected more than 0")
        check_count("num_labels", self.num_labels, *_SIZES["num_labels"])
        check_choice(self.views, get_args(Views), noun="views")


NetworkConfig = SetLabelerConfig | CNNConfig


@dataclass(frozen=True, slots=True)
class TrainSettings:
    """How a labeler is trained; the defaults made the shipped weights."""

    labeler: Kind = "set"
    """Kind of network."""
    samples: int = 5_000_000
    """Clouds to learn from; rows are used repeatedly, corrupted anew each time."""
    batch: int = 256
    optimizer: Literal["adamw", "sgd"] = "adamw"
    learning_rate: float = 2e-3
    """Peak learning rate."""
    schedule: Literal["cosine", "steps"] = "cosine"
    """`cosine` warms up over the first hundredth and falls to zero as a half cosine; `steps` falls tenfold
    at 2/3 and 14/15 of the way, the paper's epochs 50 and 70 of 75."""
    weight_decay: float = 0.01
    average: float = 0.999
    """Decay of the running mean of the weights, which is what is saved; 0 saves the last weights."""
    average_every: int = 1
    """Steps between two updates of that mean."""
    precision: Literal["auto", "32", "bf16"] = "32"
    """Precision of the forward pass; bf16 is faster on hardware that has it, and less accurate. `auto` takes
    it there."""
    devices: int = 1
    """GPUs of this machine, or processes where there are none, that share each batch; under torchrun and srun
    these say it."""
    jitter: float = 0.005
    """Largest half width of the uniform noise on each coordinate [m]; every batch draws its own."""
    rig_share: float = 0.5
    """Share of batches that are what the simulated rig sees; the others get the paper's corruption."""
    occlude: int | None = None
    """Most draws of a marker to drop in the paper's corruption; a quarter of the markers when not given, as
    in the paper for its 19 and 13 markers."""
    ghosts: int = 2
    """Most ghosts added in the paper's corruption."""
    corruption: OwnCorruption | str | None = None
    """A corruption of your own instead of the paper's: module:name, or the name of an entry point."""
    anisotropy: float = 0.06
    """Log standard deviation of the stretch of each hand along three random directions."""
    knee: float = 0.02
    """Distance at which the loss of the paper's network turns from quadratic to linear [half an image's
    width]."""
    seed: int = 0
    network: SetLabelerConfig = dataclasses.field(default_factory=SetLabelerConfig)
    cnn: CNNConfig = dataclasses.field(default_factory=CNNConfig)

    @property
    def chosen(self) -> NetworkConfig:
        """The settings of the network of this kind."""
        return self.cnn if self.labeler == "cnn" else self.network

    def record(self) -> dict[str, Any]:
        """The settings as JSON; a corruption by its name."""
        name = None if self.corruption is None else plugin_name(self.corruption)
        return dataclasses.asdict(dataclasses.replace(self, corruption=name))

    def __post_init__(self) -> None:
        fill_settings(self)
        if self.corruption is not None and not isinstance(self.corruption, str):
            check_callable("corruption", self.corruption, "a function (markers, *, rng), or its module:name")
        for name, valid in (
            ("labeler", KINDS),
            ("optimizer", ("adamw", "sgd")),
            ("schedule", ("cosine", "steps")),
            ("precision", ("auto", "32", "bf16")),
        ):
            check_choice(getattr(self, name), valid, noun=name)
        for name in ("samples", "batch", "devices", "average_every"):
            check_count(name, getattr(self, name), 1)
        check_count("seed", self.seed, 0)
        check_count("batch", self.batch, 1, _MOST_CLOUDS)
        check_count("ghosts", self.ghosts, 0, _MOST_POINTS)
        if self.occlude is not None:
            check_count("occlude", self.occlude, 0, _MOST_POINTS)
        check_number("learning_rate", self.learning_rate, 0.0, 10.0, above=True)
        check_number("weight_decay", self.weight_decay, 0.0, 10.0)
        check_number("average", self.average, 0.0, 1.0)
        check_number("jitter", self.jitter, 0.0, 0.1)
        check_number("rig_share", self.rig_share, 0.0, 1.0)
        check_number("anisotropy", self.anisotropy, 0.0, 1.0)
        check_number("knee", self.knee, 0.0, above=True)


def batch_recipe(config: TrainSettings, num_markers: int) -> BatchRecipe:
    """How a labeler's batches are drawn for a layout of this many markers."""
    usual = paper_corruption(num_markers).occlude
    occlude = usual if config.occlude is None else config.occlude
    return BatchRecipe(
        config.batch,
        Corruption(occlude, config.ghosts) if config.corruption is None else config.corruption,
        config.jitter,
        config.rig_share,
        config.anisotropy,
    )


Preset = Literal["han2018"]
PRESETS: Final[tuple[Preset, ...]] = get_args(Preset)
EPOCHS: Final = 75


def preset_config(preset: Preset, num_frames: int) -> TrainSettings:
    """The settings of a published recipe for a training set of `num_frames`.

    `han2018` is section 3.3 of Han et al. 2018: plain SGD from 0.6, batches of 256, 75 epochs, random drops
    and ghosts, views from anywhere, a smooth L1 loss with its usual knee of one, and points matched over
    15 mm at most. The paper does not give the jitter; ours is that of its published data (±3 mm). A 16-bit
    precision on hardware that has it is not the paper's either.
    """
    del preset  # one so far
    return TrainSettings(
        labeler="cnn",
        samples=EPOCHS * num_frames,
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


def default_config(labeler: Kind) -> TrainSettings:
    """The settings that a labeler of this kind is trained with when no others are given."""
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
