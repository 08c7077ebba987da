"""Commands of `handsim` on tracking, one per module.

`user_options`: the user's hands from a command's options.
`export`: `handsim export`, takes and labelers for other programs.
`hand`: `handsim hand`, a hand for other programs.
`body`: `handsim body`, a rigid body's markers as a file.
`calibrate`: `handsim calibrate`, the user's hands and gloves from a capture.
`track`: `handsim track`, a tracked take from a capture or a live stream.
`live`: its live part.
`replay`: `handsim replay`, a NatNet server that plays a capture.
`view`: `handsim view`, files and live trackers in the browser.
`glove_advice`: `handsim glove score` and `improve`, advice on a layout.
`reproduce`: `handsim reproduce`, the paper's tables.
`benchmark`: `handsim benchmark`, the public benchmark.
`sweep`: `handsim sweep`, gloves x rigs x people x seeds.
`demo`: the step of `handsim demo` that tracks.
"""
