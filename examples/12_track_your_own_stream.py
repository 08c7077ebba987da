"""Track a live stream that comes from a class of your own, and send the hands to another one.

    python examples/12_track_your_own_stream.py

Both are in own_stream.py beside this script and are loaded by name. `handsim track` does the same by
`--live own_stream:Simulated --send own_stream:Fingertips`, and records a take. `natnet://host` instead of the
source, and `osc://host:port` or `ws://:8765` instead of the sink, need no class.
"""

from __future__ import annotations

from contextlib import closing

from gloves import load_layout, nominal_fit
from track import Tracker, open_sinks, open_source, track_stream
from train import load_labeler


def main() -> None:
    hands = [nominal_fit(load_layout("dense19"), "M", side) for side in ("right", "left")]
    tracker = Tracker(hands, load_labeler("dense19"))
    with (
        closing(open_source("own_stream:Simulated?frames=240")) as stream,
        open_sinks(["own_stream:Fingertips"]) as sinks,
    ):
        sinks.start(tracker.hands, tracker.bodies)
        for frame, tracked in track_stream(stream, tracker):
            sinks.send(frame, tracked)
        print(f"frames missing: {stream.counts['missing_frames']}")


if __name__ == "__main__":
    main()
