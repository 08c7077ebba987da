"""Fits settings of simulated captures and training sets to the optics of a lab's captures.

The effect of noise, losses and stray reflections on a rig's views has no closed form. Therefore captures are
simulated and measured like the lab's, and the settings are multiplied by the ratios, several times.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar

import numpy as np

from gloves.layout import load_layout
from handsim.callbacks import OnStep, no_step
from handsim.space.rig import load_rig
from poses.motion import RATE
from train.simulation.generation import generate_dataset
from train.simulation.measured_room import AnyTrial, MeasuredRoom, measure_room, measure_simulated
from train.simulation.takes import SimulateSettings, room_of, simulate_take
from train.simulation.training_frames import GenerateSettings

Kind = TypeVar("Kind", SimulateSettings, GenerateSettings)
_CAPTURE_FRAMES: Final = 1200  # number of frames of a simulated capture that is measured
_ROWS, _ROWS_PER_PERSON = 1024, 32  # number of rows of a training set that is measured, and of each person
_ROUNDS: Final = 8  # number of corrections
_MOST_CORRECTION: Final = 4.0  # largest ratio of a correction
_LOST_CAMERAS: Final = 0.375  # share of the cameras that lose pictures together: 6 of the 16 of figure5
_SPOTS_A_HAND: Final = 30.0  # number of reflecting spots on a hand, which flash as often as ghosts require
_MOST_LIT_SHARE: Final = 0.95  # largest share of the time that a spot reflects
_FEWEST_EXPECTED_PAIRS: Final = 30.0  # Points merge if the lab lacks this many nearer, simulated pairs.


@dataclass(frozen=True, slots=True)
class RoomLike(Generic[Kind]):
    """Settings that follow captures of a lab, and how near they come."""

    settings: Kind
    values: Mapping[str, Any]
    """The settings that follow the captures, by their names as options."""
    table: tuple[tuple[str, str, str], ...]
    """Rows of figures with their units, such as [mm]: what, as found, and as simulated."""
    untold: tuple[str, ...]
    """What the captures do not tell; those settings are the defaults."""

    def sentences(self, settings: Kind) -> list[str]:
        """Which values of the settings in use are from the captures, and what these do not tell."""
        kept = [
            f"{name} {_as_words(value)}"
            for name, value in self.values.items()
            if setting(settings, name) == value
        ]
        lines = [f"from the trial: {', '.join(kept) or 'nothing'}"]
        return lines + [f"the trial does not tell {one}" for one in self.untold]


def room_like(
    captures: AnyTrial | Sequence[AnyTrial], settings: Kind, *, on_step: OnStep = no_step
) -> RoomLike[Kind]:
    """Settings of a simulated capture or of a training set whose optics are like those of a lab's captures.

    Args:
        captures: Captures, takes or their paths, labeled or not, of one optical system.
        settings: The other settings, as the glove and the rig. Settings of optics and ghosts that are not
            the defaults are kept.
        on_step: Called with the name of each step.

    Returns:
        The settings, and a table of figures, found and simulated, lengths in [mm].

    Raises:
        CaptureError: A capture cannot be read, or has fewer than two markers.
        ArgumentError: Positions are not in meters.
    """
    on_step("measuring the trial")
    found = measure_room(captures)
    on_step("simulating captures like it")
    if isinstance(settings, GenerateSettings):
        return _fit_training_set(found, settings)
    return _fit_capture(found, settings)


def filled(settings: Kind, values: Mapping[str, Any]) -> Kind:
    """The settings with other values, by their names as options."""
    groups = dict[str, Any]()
    for name, value in values.items():
        group, _, field = name.rpartition(".")
        usual = groups.get(group, getattr(settings, group)) if group else None
        groups[group or name] = value if usual is None else dataclasses.replace(usual, **{field: value})
    return dataclasses.replace(settings, **groups)


def setting(settings: Kind, name: str) -> Any:
    """A setting by its name as an option."""
    group, _, field = name.rpartition(".")
    return getattr(getattr(settings, group) if group else settings, field)


def _of_default_settings(settings: Kind, values: Mapping[str, Any]) -> dict[str, Any]:
    """The values, to four digits, of settings that still have their defaults."""
    usual = type(settings)()
    rounded = {
        name: float(f"{value:.4g}") if isinstance(value, float) else value for name, value in values.items()
    }
    return {name: value for name, value in rounded.items() if setting(settings, name) == setting(usual, name)}


def _as_words(value: Any) -> str:
    return " ".join(f"{one:g}" for one in (value if isinstance(value, tuple) else (value,)))


def _ratio(wanted: float | None, simulated: float | None) -> float:
    """Factor of a setting that turns the `simulated` figure into the `wanted` one, within limits."""
    if wanted is None or simulated is None:
        return 1.0
    return float(np.clip(wanted / max(simulated, 1e-12), 1 / _MOST_CORRECTION, _MOST_CORRECTION))


def _fit_capture(found: MeasuredRoom, settings: SimulateSettings) -> RoomLike[SimulateSettings]:
    """Fit the settings of a simulated capture to measured captures."""
    room, rig = room_of(settings), load_rig(settings.rig)
    found = _per_hand(found, max(1, round(found.num_markers / load_layout(settings.glove).num_markers)))
    noise, shown, lit_share = room.optics.noise, found.ghost_time or room.strays.shown, 0.02
    length = max(1.0, RATE * found.gap_time) if found.gap_time else room.optics.dropout_length
    values = dict[str, Any]()
    if found.shows_losses:
        lost = max(1, round(_LOST_CAMERAS * len(rig.positions)))
        values |= {"optics.blob_loss": 0.0, "optics.dropout": 0.0, "optics.dropout_cameras": lost}
    if found.ghosts is not None:
        values["strays.number"] = _SPOTS_A_HAND if found.ghosts else 0.0
    least = _capture_figures(settings, values)
    untold, merging = list(found.untold), (least.nearest_pairs < found.nearest).mean() * found.num_frames
    if found.nearest < room.optics.min_distance or merging >= _FEWEST_EXPECTED_PAIRS:
        values["optics.min_distance"] = found.nearest
    else:
        untold.append("at which distance points merge: no markers came near enough")
    above = max(0.0, found.missing - least.missing)
    dropout = above / length
    for _ in range(_ROUNDS):
        values["optics.noise"] = noise
        if found.shows_losses:
            values["optics.dropout"] = dropout
        if found.gap_time is not None:
            values["optics.dropout_length"] = length
        if found.ghosts:
            values["strays.hidden"] = shown * (1.0 / lit_share - 1.0)
        if found.ghost_time is not None:
            values["strays.shown"] = shown
        simulated = _capture_figures(settings, values)
        noise *= _ratio(found.noise, simulated.noise)
        shown *= _ratio(found.ghost_time, simulated.ghost_time) ** 0.5
        lit_share = min(_MOST_LIT_SHARE, lit_share * _ratio(found.ghosts, simulated.ghosts))
        if above:
            dropout = min(1.0, dropout * _ratio(above, simulated.missing - least.missing) ** 0.5)
            length = max(1.0, length * _ratio(found.gap_time, simulated.gap_time) ** 0.5)
    values = _of_default_settings(settings, values)
    rows = _table(
        ("noise per axis [mm]", found.noise, simulated.noise, 1e3),
        ("markers missing [%]", found.missing, simulated.missing, 1e2),
        ("mean gap [ms]", found.gap_time, simulated.gap_time, 1e3),
        ("ghosts per frame and hand", found.ghosts, simulated.ghosts, 1.0),
        ("mean time of a ghost [ms]", found.ghost_time, simulated.ghost_time, 1e3),
        ("nearest pair [mm]", found.nearest, simulated.nearest, 1e3),
        ("mean time of an ID [s]", found.id_time, simulated.id_time, 1.0),
        ("frames per second", found.rate, simulated.rate, 1.0),
    )
    return RoomLike(filled(settings, values), values, rows, tuple(untold))


def _capture_figures(settings: SimulateSettings, values: Mapping[str, Any]) -> MeasuredRoom:
    """Simulate a capture with these values, and measure it."""
    chosen = filled(settings, _of_default_settings(settings, values))
    take = simulate_take(settings=dataclasses.replace(chosen, num_frames=_CAPTURE_FRAMES))
    return _per_hand(measure_simulated(take), len(take.hands))


def _per_hand(room: MeasuredRoom, hands: int) -> MeasuredRoom:
    """Divide the number of ghosts by that of the hands."""
    return room if room.ghosts is None else dataclasses.replace(room, ghosts=room.ghosts / hands)


def _fit_training_set(found: MeasuredRoom, settings: GenerateSettings) -> RoomLike[GenerateSettings]:
    """Fit the settings of a training set to measured captures."""
    free = SimulateSettings("free", glove=settings.glove, rig=settings.rig, center=settings.center)
    capture = _fit_capture(found, free)
    found = _per_hand(found, max(1, round(found.num_markers / load_layout(settings.glove).num_markers)))
    shared = {"optics.noise", "optics.min_distance"} & set(capture.values)
    values = {name: capture.values[name] for name in sorted(shared)}
    least, _ = _training_figures(settings, values | _scaled_losses(settings, 0.0))
    losses, ghosts, above = 1.0, 1.0, max(0.0, found.missing - least)
    for _ in range(_ROUNDS):
        if found.shows_losses:
            values |= _scaled_losses(settings, losses if above else 0.0)
        if found.ghosts is not None:
            values |= {
                "ghosts.stray_rate": settings.ghosts.stray_rate * ghosts,
                "ghosts.mirror_rate": min(1.0, settings.ghosts.mirror_rate * ghosts),
            }
        missing, simulated = _training_figures(settings, values)
        losses *= _ratio(above, missing - least) ** 0.5  # several cameras lose a marker together
        ghosts *= _ratio(found.ghosts, simulated)
    values = _of_default_settings(settings, values)
    rows = _table(
        ("markers missing [%]", found.missing, missing, 1e2),
        ("ghosts per frame and hand", found.ghosts, simulated, 1.0),
    )
    optical = [row for row in capture.table if row[0] in ("noise per axis [mm]", "nearest pair [mm]")]
    return RoomLike(filled(settings, values), values, (*optical, *rows), capture.untold)


def _scaled_losses(settings: GenerateSettings, times: float) -> dict[str, Any]:
    """The ranges of losses, scaled by a factor."""
    return {
        name: tuple(min(1.0, float(f"{times * end:.4g}")) for end in setting(settings, name))
        for name in ("blob_loss", "dropout")
    }


def _training_figures(settings: GenerateSettings, values: Mapping[str, Any]) -> tuple[float, float]:
    """Share of markers missing, and ghosts per row, of a small training set with these values."""
    chosen = filled(settings, _of_default_settings(settings, values))
    with tempfile.TemporaryDirectory() as folder:
        rows = generate_dataset(
            folder, chosen, num_frames=_ROWS, frames_per_hand=_ROWS_PER_PERSON, workers=1
        ).rows()
        missing, ghosts = np.isnan(rows["observed"][..., 0]).mean(), np.isfinite(rows["ghosts"][..., 0])
    return float(missing), float(ghosts.sum(axis=1).mean())


def _table(*rows: tuple[str, float | None, float | None, float]) -> tuple[tuple[str, str, str], ...]:
    """Format rows of names, figures found and simulated, and factors from SI to the units shown."""
    return tuple(
        (name, _cell(found, scale), _cell(simulated, scale)) for name, found, simulated, scale in rows
    )


def _cell(figure: float | None, scale: float) -> str:
    return "not told" if figure is None else f"{figure * scale:.3g}"
