"""Sweeps: gloves x rigs x people x seeds, and any setting, as one job that goes on where it was stopped.

`sweep_file`: the file that says what to vary.
`cells`: its cells, and the training set, labeler and capture that each needs.
`steps`: one training or one measurement, in whatever process.
`running`: all steps of a sweep in their order.
`results`: the table of results, as .csv, on the terminal and as a page.
"""
