"""The command `handsim body`: a rigid body's markers as a file, for `handsim track --body`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from handsim.app.messages import print_line
from handsim.errors import ArgumentError
from handsim.files.outputs import as_text, check_outputs
from handsim.space.objects import named_object


def body(source: Annotated[Path, tyro.conf.Positional], *, out: Path) -> None:
    """Write the markers of a rigid body, from a capture of the moving body and nothing else.

    The body has the name of the file, and its markers are Marker1, Marker2, ...; both may be changed there.

    Args:
        source: A .trc, .c3d, .csv (Motive, Vicon) or .tsv (Qualisys) file, whose names are not used; or the
            .truth.npz of a simulated capture, for its object.
        out: The body's file, .toml.
    """
    from gloves.captures.formats import read_capture
    from gloves.takes.take import SUFFIX, load_take
    from track.bodies.rigid_body import SUFFIX as TOML
    from track.bodies.rigid_body import RigidTemplate, learn_body, save_body

    check_outputs([source], [out], TOML)
    if source.name.endswith(SUFFIX):
        bodies = load_take(source).bodies
        if not bodies:
            raise ArgumentError(
                f"{source}: the take has no object, expected one of handsim simulate --kind hand-controller"
            )
        found = RigidTemplate.of(named_object(bodies[0].name))
    else:
        found = learn_body(read_capture(source), as_text(out.stem))
    save_body(out, found)
    widest = 1e3 * np.max(found.distances)
    print_line(f"{out}: {found.name}, {len(found.positions)} markers, at most {widest:.1f} mm apart")
