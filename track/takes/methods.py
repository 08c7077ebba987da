"""The paragraph on a take for the methods section of a paper, and the record of the take's origin.

Words in capitals are for the author to fill in.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from gloves.takes.take import Take
from track.config import HandOrigin
from track.user import hand_origin

_ORIGIN_WORDS: Final[dict[HandOrigin, str]] = {
    "named": "mean hands of one of five sizes",
    "measured": "hands whose size and proportions were measured by their markers",
    "calibrated": "hands calibrated for each person and session from S s of motion",
}


def methods_paragraph(take: Take, doubtful: float, *, has_neutral: bool) -> str:
    """The paragraph on a tracked take.

    Args:
        take: The take.
        doubtful: Share of its frames that are listed as doubtful.
        has_neutral: Whether its angles are zero in a recorded pose.
    """
    settings, layout = take.settings, take.hands[0].layout
    origins = [hand_origin(str(settings.get("user", "")), side) for side in take.sides]
    hands = " and ".join(_ORIGIN_WORDS[origin] for origin in dict.fromkeys(origins))
    known = take.rms[np.isfinite(take.rms)]
    residual = f" (median residual {1e3 * np.median(known):.1f} mm)" if len(known) else ""
    cutoffs = [one for side in take.sides for one in settings.get("filter", {}).get(side, ())]
    solved = "Each frame was solved by itself, without a filter."
    if cutoffs:
        solved = (
            "All frames were solved together with a prior of smooth motion, which acts as a zero-lag "
            f"low-pass filter (-6 dB at {min(cutoffs):.1f} to {max(cutoffs):.1f} Hz, by joint)."
        )
    zero = "a recorded flat hand" if has_neutral else "the flat hand of the model"
    return (
        f"Hands were recorded at {take.rate:.4g} Hz by N cameras (SYSTEM) with {layout.num_markers} markers "
        f"of {2e3 * layout.radius:.1f} mm on a glove ({layout.name}). handsim {settings.get('handsim', '')} "
        "labeled the markers and fitted a hand of 16 rigid segments and 20 hinge joints to them by inverse "
        f"kinematics, with joint ranges, a coupling of DIP and PIP, and {hands}{residual}. Angles follow the "
        "ISB (Wu et al. 2005; flexion, ulnar deviation, pronation; left hands mirrored) and are zero in "
        f"{zero}. The first metacarpal is described relative to the rigid dorsum of the hand, not to the "
        f"trapezium. {solved} Frames listed as doubtful ({100.0 * doubtful:.1f} %) were LEFT OUT / CORRECTED "
        "BY HAND."
    )


def made_of(settings: dict[str, Any]) -> str:
    """The version that made a take, its date, and the names and checksums of capture, glove and user."""
    parts = [f"handsim {settings['handsim']}", settings["date"]] if "handsim" in settings else []
    for name in ("capture", "glove", "user"):
        if f"{name}_sha256" in settings:
            parts.append(f"{name} {settings[name]} (SHA-256 {settings[f'{name}_sha256']})")
    return ", ".join(parts)
