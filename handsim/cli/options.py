"""Options of several commands: a capture or stream, whose hands are tracked, and the take's file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from handsim._checks import check_number
from handsim.errors import ArgumentError
from handsim.files.inputs import words_numbers
from handsim.hand.shape import Side
from track.config import SizeChoice

if TYPE_CHECKING:
    from gloves.takes.take import Take
    from track.settings import AnyHands, TrackSettings


@dataclass(frozen=True, slots=True)
class TrackerOptions:
    """Options of a tracker."""

    glove: str | None = None
    """Marker layout: a shipped name or the path of a .toml file; that of --shape, or dense19, when not
    given."""
    size: SizeChoice | None = None
    """Size of the hands; auto, which is the default, measures it in the capture, or beside the tracking of a
    stream."""
    shape: Path | None = None
    """The user's file from handsim calibrate: hands and gloves."""
    hands: tuple[Side, ...] | None = None
    """Which hands to track; those of --shape, or all that the glove is made for, when not given."""
    body: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A rigid body to track beside the hands, once per body: a .toml file, see handsim body, or one of
    handsim's own objects."""
    labeler: str | None = None
    """Folder of a trained labeler, an exported .onnx file, or module:name; the shipped one when not given."""

    def files(self) -> tuple[object, ...]:
        """Options that may name files, which no output must overwrite."""
        return self.shape, self.glove, self.labeler, *self.body

    def settings(self, **others: Any) -> TrackSettings:
        """The settings of `track_capture`, the others by their names."""
        from track.settings import TrackSettings
        from track.user import as_user

        if self.shape is not None and self.size is not None:
            raise ArgumentError(f"given --size {self.size} and --shape {self.shape}, expected one of them")
        hands: AnyHands | None = self.shape or self.hands
        if self.shape is not None and self.hands is not None:
            hands = as_user(self.shape).of_sides(self.hands)
        size = self.size or "auto"
        return TrackSettings(self.glove, hands, size, self.labeler, bodies=self.body, **others)


def neutral_pose(given: Sequence[str] | None) -> tuple[float, float] | Take | None:
    """The value of --neutral: two times of the same take [s], or the take of another trial."""
    from gloves.takes.take import load_take

    if not given:
        return None
    if len(given) == 1:
        return load_take(given[0])
    times = words_numbers(given)
    if len(times) != 2:
        raise ArgumentError(f"--neutral is {' '.join(given)}, expected two times [s] or a take (.npz)")
    return times[0], times[1]


def check_source(noun: str, file: object, live: str | None) -> None:
    """Refuse a file (called `noun` in messages) together with --live, or neither of them."""
    if (file is None) == (live is None):
        both = f"a {noun}, {file}, and --live {live}"
        given = f"neither a {noun} nor --live" if file is None else both
        raise ArgumentError(f"given {given}, expected a {noun} or --live natnet://host")


def check_live(live: str | None, seconds: float | None) -> None:
    """Refuse --seconds without a stream, and an invalid address."""
    from track.streams.live_stream import check_address

    if seconds is not None and live is None:
        raise ArgumentError(f"--seconds is {seconds:g} without --live, expected both or neither")
    if seconds is not None:
        check_number("--seconds", seconds, 0.0, above=True)
    if live is not None:
        check_address(live)  # before kernels are compiled, which takes long


def check_take_file(out: Path, *, live: bool) -> None:
    """Refuse an --out that is no .npz, or with --live one whose take has corrections, which would be lost."""
    from gloves.takes.corrections import corrections_path
    from gloves.takes.take import TRUTH_SUFFIX

    if out.suffix.lower() != ".npz" or out.name.endswith(TRUTH_SUFFIX):
        raise ArgumentError(
            f"--out is {out}, expected a file name that ends in .npz and not in {TRUTH_SUFFIX}"
        )
    corrections = corrections_path(out)
    if live and corrections.exists():
        raise ArgumentError(
            f"{corrections} corrects the take that --live would replace, expected another --out than {out}"
        )
