"""The command `handsim body`: a rigid body's markers as a file, for `handsim track --body`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from handsim.app.messages import print_line
from handsim.errors import ArgumentError
from handsim.files.outputs import as_text, check_outputs
from handsim.hand.shape import Side
from handsim.space.objects import named_object


def body(
    source: Annotated[Path, tyro.conf.Positional],
    *,
    out: Path,
    markers: tuple[str, ...] = (),
    forearm: Side | None = None,
    elbow: Side | None = None,
    landmarks: tuple[str, ...] = (),
) -> None:
    """Write the markers of a rigid body, from a capture of the moving body and nothing else.

    The body has the name of the file, and its markers are Marker1, Marker2, ...; both may be changed there.

    Args:
        source: A .trc, .c3d, .csv (Motive, Vicon) or .tsv (Qualisys) file, whose names are not used; or the
            .truth.npz of a simulated capture, for its object.
        out: The body's file, .toml.
        markers: Columns of a labeled capture that are the body's markers; all when none is given.
        forearm: The hand whose forearm carries the markers, near the wrist.
        elbow: The hand whose elbow they are at: on the upper arm, where pronation of the forearm does not
            turn them.
        landmarks: Columns of a labeled capture at the forearm's radial styloid, ulnar styloid and one or two
            epicondyles, which give its axes; without them a neutral pose does. An elbow needs those at the
            lateral and the medial epicondyle.
    """
    from gloves.captures.formats import read_capture
    from gloves.takes.take import TRUTH_SUFFIX, load_take
    from track.bodies.forearm import limb_of_landmarks
    from track.bodies.rigid_body import BODY_SUFFIX, RigidTemplate, learn_body, save_body

    check_outputs([source], [out], BODY_SUFFIX)
    if source.name.endswith(TRUTH_SUFFIX):
        if markers or forearm or elbow or landmarks:
            raise ArgumentError(f"{source}: the object of a take has no columns, expected a labeled capture")
        bodies = load_take(source).bodies
        if not bodies:
            raise ArgumentError(
                f"{source}: the take has no object, expected one of handsim simulate --kind hand-controller"
            )
        found = RigidTemplate.of(named_object(bodies[0].name))
    else:
        capture = read_capture(source)
        found = learn_body(capture, as_text(out.stem), markers, forearm=forearm, elbow=elbow)
        if landmarks or elbow:
            found = limb_of_landmarks(found, capture, landmarks)
    save_body(out, found)
    widest = 1e3 * np.max(found.distances)
    print_line(f"{out}: {found.name}, {len(found.positions)} markers, at most {widest:.1f} mm apart")
