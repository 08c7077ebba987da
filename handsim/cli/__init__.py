"""The command `handsim`: one module a command, above all packages.

`main` parses the first word and calls the command that its table names for it.
"""

from handsim._imports import SIBLINGS, claim

claim(*SIBLINGS)
