"""Track a live stream that comes from a class of your own, send the hands to another one, and record a take.

    python examples/12_track_your_own_stream.py

Both classes are in own_stream.py beside this script and are loaded by name. `handsim track` does the same by
`--live own_stream:Simulated --send own_stream:Fingertips`. `natnet://host` instead of the source, and
`osc://host:port` or `ws://:8765` instead of the sink, need no class.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from gloves import attach, load_take
from handsim import HandModel
from track import Recorder, Tracker, open_sinks, open_source
from train import load_labeler


def main() -> None:
    hands = [attach("dense19", HandModel.named("M", side=side)) for side in ("right", "left")]
    tracker = Tracker(hands, load_labeler("dense19"))
    tracker.warm_up()  # the first frames would otherwise wait, and be dropped
    with TemporaryDirectory() as folder:
        with (
            open_source("own_stream:Simulated?frames=240") as source,
            open_sinks(["own_stream:Fingertips"]) as sinks,
            Recorder(Path(folder) / "live.npz", tracker) as recorder,
        ):
            sinks.start(tracker.hands, tracker.bodies)
            for frame in source:
                tracked = tracker.step(frame.points, frame.ids, frame.time)
                sinks.send(frame, tracked)
                recorder.add(frame, tracked)
        counts, recorded = source.counts, load_take(Path(folder) / "live.npz").num_frames
        print(f"{recorded} of {counts['received_frames']} frames that came were recorded")
        print(f"{counts['dropped_frames']} were not kept up with, {counts['missing_frames']} never came")


if __name__ == "__main__":
    main()
