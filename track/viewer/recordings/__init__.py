"""What the viewer shows over time.

`recording`: frames of hands, points and bodies, made one at a time.
`takes`: a take, simulated or tracked, with its status.
`corrector`: a tracked take whose labels are corrected.
`captures`: a marker file.
`datasets`: a training set, row by row.
"""
