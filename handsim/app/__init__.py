"""The application around the commands.

- cli: the command `handsim`, a table of names, each loaded when it is called
- progress: the progress bar of all commands
- interrupts: Ctrl-C as a flag that a loop reads
- workers: numbered jobs in worker processes
- system_packages: names of system packages that pip cannot install
- page: one HTML page of pictures and figures
"""
