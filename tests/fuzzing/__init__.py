"""Damaged files for every reader: `make fuzz`, or `python -m tests.fuzzing --cases 20000 --target c3d`.

- mutations: how bytes are damaged
- engine: one case after the other, and what counts as a failure
- targets: the readers, each with the valid files that it starts from
- seeds: those valid files, small and the same each time
- corpus: files that failed once, by target; the tests read them all
"""
