"""The browser viewer: layouts, rigs, training sets, captures, takes, users and live trackers in a web page.

Nothing here imports viser, the package that serves the page, but `server`, when it starts one.

`contents`: what a file is, and the view that shows it.
`server`: the web server.
`recordings/`: what is shown over time.
`scene/`: what stands in the page.
`timeline`: which frame is shown.
`status_panel`: its state in words, plots, doubtful frames.
`live_view`: the newest frame of a tracker that runs.
`label_editor`: labels of a tracked take, corrected over a span of frames and saved.
`layout_editor`: a layout whose markers are dragged over the skin.
`video`: a recording as a video file, without a browser.
`user_view`: a calibrated user's hands over those of a named size.
"""
