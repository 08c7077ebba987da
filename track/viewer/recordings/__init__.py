"""What the viewer shows over time.

`recording`: frames of hands, points and bodies, made one at a time.
`takes`: a tracked take with its status, a simulated one with its truth.
`corrector`: a tracked take whose labels are corrected.
`captures`: a marker file.
`datasets`: a training set, row by row.
"""
