"""The commands of this package, one per file.

- generate: `handsim generate` makes a training set.
- train: `handsim train` trains a labeler on it.
- label: `handsim label` labels a capture.
- evaluate: `handsim evaluate` measures a labeler.
- simulate: `handsim simulate` simulates a capture with its truth.
- rig: `handsim rig list`, `new` and `check`; rig_advice: `handsim rig score` and `plan`.
- labeling_tables: `handsim reproduce` prints the paper's tables of labeling beside ours.
- demo: the steps of `handsim demo` that generate and label.
"""
